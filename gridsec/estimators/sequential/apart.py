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
from gridsec.estimators.sequential.blocks import remove_meters, well_conditioned
from gridsec.estimators.sequential.conditional import LeaveOneOut, Posterior, condition, leave_one_out


@dataclass(frozen=True, slots=True, eq=False)
class VouchedPosterior:
    """Posterior without some meters. p meters."""

    whole: Posterior  # posterior with them
    removed: Bools  # (p,) trusted meters without a check
    vouched: Posterior  # posterior without them

    def added_variance(self, loo: LeaveOneOut) -> Floats:
        """Variance to be added to the posterior with all meters, (n,), squared pu^2."""
        moved = loo.mean - leave_one_out(self.vouched, loo.m).mean
        return np.asarray(np.maximum(self.vouched.variance - self.whole.variance, 0.0) + moved**2)


def vouched_posteriors(
    before: tuple[VouchedPosterior | None, ...],
    posteriors: tuple[Posterior | None, ...],
    vouched: Bools,
) -> tuple[VouchedPosterior | None, ...]:
    """Posteriors without meters that are not vouched, by scale; None where all are. `before` is reused."""
    if all_of(vouched):
        return before if not any(before) else (None,) * len(posteriors)
    pairs = zip(before, posteriors, vouched, strict=True)
    return tuple(None if now is None else _reused(kept, now, vouched) for kept, now, vouched in pairs)


def _reused(kept: VouchedPosterior | None, now: Posterior, vouched: Bools) -> VouchedPosterior | None:
    removed = now.trusted & ~vouched
    if kept is not None and kept.whole is now and np.array_equal(kept.removed, removed):
        return kept
    return vouched_posterior(now, vouched)


def vouched_posterior(now: Posterior, vouched: Bools) -> VouchedPosterior | None:
    """Posterior without meters that are not vouched (p,); None if all are."""
    removed = now.trusted & ~vouched
    if not any_of(removed):
        return None
    if well_conditioned(now.prior, now.noise):
        return VouchedPosterior(now, removed, remove_meters(now, removed))
    return VouchedPosterior(
        now, removed, condition(now.prior, now.noise, now.trusted & ~removed, now.unknowns)
    )
