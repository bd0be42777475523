"""Estimates without the readings of meters that withhold their customer's power.

A voltage reading beside a power that is not read has no check of its own: each lie within the load's range is
a load. With w and M of all trusted meters, and w', M' of those that are vouched for (`Doubts.vouched`), the
variance at every bus is

    M' + (w - w')^2

about w. It covers the truth if the other readings are false, and is M' plus little if they are true.

References
----------
docs/theory-sequential.md, section 7.
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
    """A fit without some of its meters. p meters.

    Attributes
    ----------
    whole
        The fit with them.
    fallen : (p,)
        Trusted meters that are not vouched for.
    rest
        The fit without them.
    """

    whole: Fit
    fallen: Bools
    rest: Fit

    def added(self, judged: Judged) -> Floats:
        """Variance that the fit with all meters is short of at every bus, (n,), squared pu^2.

        Parameters
        ----------
        judged
            What the fit with all meters says.
        """
        moved = judged.w - judge(self.rest, judged.m).w
        return np.asarray(np.maximum(self.rest.variance - self.whole.variance, 0.0) + moved**2)


def apart(
    before: tuple[Apart | None, ...], fits: tuple[Fit | None, ...], doubts: Doubts
) -> tuple[Apart | None, ...]:
    """Fits without the meters that are not vouched for, by scale; None where all are.

    Parameters
    ----------
    before
        From the last tick, used again for the same meters.
    fits : (s,)
        The trusted meters.
    doubts
        Of this tick.
    """
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
    """A fit without the meters that are not vouched for; None where it has none.

    Parameters
    ----------
    now
        The trusted meters.
    vouched : (p,)
        Meters with a check by their customer's power.
    """
    fallen = now.trusted & ~vouched
    if not any_of(fallen):
        return None
    if sound(now.prior, now.noise):
        return Apart(now, fallen, without(now, fallen))
    return Apart(now, fallen, fit(now.prior, now.noise, now.trusted & ~fallen, now.loose))
