"""Posterior without the readings of meters that withhold their customer's power.

A voltage reading beside an unread power has no check of its own: each error within the load's range is a
load. With w and M of all trusted meters, and w', M' of the vouched ones, the variance at every bus is

    M' + (w - w')^2

about w. It covers the truth if the other readings are false, and is M' plus little if they are true
(docs/theory-sequential.md, section 7).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, all_of, any_of
from gridsec.estimators.sequential.blocks import sound, without
from gridsec.estimators.sequential.conditional import Fit, Judged, fit, judge
from gridsec.estimators.sequential.doubts import Doubts


@dataclass(frozen=True, slots=True, eq=False)
class Apart:
    """Posterior without some meters. p meters."""

    whole: Fit  # posterior with them
    fallen: Bools  # (p,) trusted meters without a check
    rest: Fit  # posterior without them

    def added(self, judged: Judged) -> Floats:
        """Variance to be added to the posterior with all meters, (n,), squared pu^2."""
        moved = judged.w - judge(self.rest, judged.m).w
        return np.asarray(np.maximum(self.rest.variance - self.whole.variance, 0.0) + moved**2)


def apart(
    before: tuple[Apart | None, ...], fits: tuple[Fit | None, ...], doubts: Doubts
) -> tuple[Apart | None, ...]:
    """Posteriors without meters that are not vouched, by scale; None where all are. `before` is reused."""
    if all_of(doubts.vouched):
        return before if not any(before) else (None,) * len(fits)
    pairs = zip(before, fits, doubts.vouched, strict=True)
    return tuple(None if now is None else _apart(kept, now, vouched) for kept, now, vouched in pairs)


def _apart(kept: Apart | None, now: Fit, vouched: Bools) -> Apart | None:
    fallen = now.trusted & ~vouched
    if kept is not None and kept.whole is now and np.array_equal(kept.fallen, fallen):
        return kept
    return set_apart(now, vouched)


def set_apart(now: Fit, vouched: Bools) -> Apart | None:
    """Posterior without meters that are not vouched (p,); None if all are."""
    fallen = now.trusted & ~vouched
    if not any_of(fallen):
        return None
    if sound(now.prior, now.noise):
        return Apart(now, fallen, without(now, fallen))
    return Apart(now, fallen, fit(now.prior, now.noise, now.trusted & ~fallen, now.loose))
