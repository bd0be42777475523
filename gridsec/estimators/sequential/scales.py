"""Tests of each scale: means and limits, views of a posterior, and cheap updates of posteriors.

The window of a scale needs a minimum of readings to test a meter (docs/theory-sequential.md, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil

import numpy as np

from gridsec.arrays import Bools, Floats, any_of, indices
from gridsec.estimators.sequential.blocks import sound, without
from gridsec.estimators.sequential.commission import Learned
from gridsec.estimators.sequential.conditional import Fit, Judged, Prior, admit, drop, fit
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.dictionary import Dictionary
from gridsec.estimators.sequential.doubts import Doubts
from gridsec.estimators.sequential.search import Limits
from gridsec.estimators.sequential.skew import Skew
from gridsec.estimators.sequential.state import Trust
from gridsec.estimators.sequential.windows import Window


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Tests of all meters on one scale. p meters."""

    judged: Judged  # leave-one-out residuals
    enough: Bools  # (p,) meters with enough readings on this scale
    limit: Floats  # (p,) largest honest residual, squared pu
    over: Bools  # (p,) residual above the limit
    limits: Limits  # rule of the limits
    lower: float  # factor on `sigmas` of the release limit

    @property
    def still(self) -> Bools:
        """Residual above the release limit, (p,)."""
        judged = self.judged
        return self.enough & (np.abs(judged.offset) > self.limits.of(judged.std, self.lower))


_ANEW = 6
"""A posterior is factorised again when more than one in `_ANEW` of its meters changed."""
_WHOLE = 3
"""Fewer than one in `_WHOLE` meters leave a fresh posterior by one block update instead."""
_MOST_CHANGES = 400
"""Largest number of rank-one updates since a factorisation (rounding)."""


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """Data and limits of one scale. p meters."""

    prior: Prior  # prior of the voltages
    noise: Floats  # (p,) variance of each meter's mean, squared pu^2
    m: Floats  # (p,) mean residual, squared pu
    enough: Bools  # (p,) meters with enough readings
    limits: Limits  # rule of the limits


def needed(design: SequentialDesign, s: int) -> int:
    """Least number of readings of a meter that scale s tests."""
    return max(1, ceil(design.options.enough * design.lengths[s]))


class Scales:
    """All scales of one tick, computed on access. model: (p,) largest model error, squared pu."""

    def __init__(  # noqa: PLR0917
        self,
        design: SequentialDesign,
        doubts: Doubts,
        window: Window,
        learned: Learned,
        model: Floats,
        skew: Skew | None = None,
    ) -> None:
        self.design, self.doubts, self.window, self.model = design, doubts, window, model
        self.learned, self.skew, self.made = learned, skew, dict[int, Scale]()

    @cached_property
    def book(self) -> Dictionary:
        """Fault dictionary with the sizes of this tick."""
        return replace(self.design.book, std=self.doubts.sizes)

    def __getitem__(self, s: int) -> Scale:
        if s not in self.made:
            self.made[s] = self._scale(s)
        return self.made[s]

    def _scale(self, s: int) -> Scale:
        design, counts, learned = self.design, self.window.counts[s], self.learned
        need = needed(design, s)
        noise, enough = design.white / need + learned.variance, counts >= need
        if self.skew is not None:
            noise, enough = noise + self.skew.variance[s], enough & ~self.skew.aside[s]
        return Scale(
            prior=self.doubts.priors[s],
            noise=noise,
            m=self.window.sums[s] / np.maximum(counts, 1),
            enough=enough,
            limits=Limits(
                *(design.sigmas[s], self.model, learned.allowed, learned.variance, design.most, learned.late),
                learned.recent[s],
            ),
        )

    def loosened(self, accused: tuple[tuple[int, int], ...]) -> Floats | None:
        """Unknown directions of accused faults times their standard deviations, (n, k); None for none."""
        if not accused:
            return None
        which = np.array([k for k, _ in accused])
        return np.asarray(self.book.columns(which) * self.book.std[which])

    def wider(self, direction: Floats) -> Scales:
        """Scales with one more unknown direction (n,) in their priors."""
        each = {id(prior): prior.wider(direction) for prior in self.doubts.priors}
        doubts = replace(self.doubts, priors=tuple(each[id(prior)] for prior in self.doubts.priors))
        return Scales(self.design, doubts, self.window, self.learned, self.model, self.skew)


def view_of(design: SequentialDesign, here: Scale, judged: Judged) -> View:
    """View of a scale from the leave-one-out residuals of a posterior."""
    limit = here.limits.of(judged.std)
    over = here.enough & (np.abs(judged.offset) > limit)
    return View(judged, here.enough, limit, over, here.limits, design.options.lower)


def adapt(before: Fit | None, here: Scale, wanted: Bools, loose: Floats | None) -> Fit:
    """Posterior of wanted meters (p,) with unknown directions (n, k), from the last one where cheaper."""
    prior, noise = here.prior, here.noise
    if before is None or before.prior is not prior:
        return fit(prior, noise, wanted, loose)
    if before.loose.shape[1] if loose is None else not np.array_equal(before.loose, loose):
        return fit(prior, noise, wanted, loose)
    differs = before.trusted != wanted
    if not any_of(differs):
        return before
    change = indices(differs)
    many = change.size * _ANEW > wanted.size
    few = not before.changes and change.size * _WHOLE < wanted.size and not any_of(wanted[change])
    if many and few and sound(prior, before.noise):
        return without(before, differs)
    if many or before.changes + change.size > _MOST_CHANGES:
        return fit(prior, noise, wanted, loose)
    now = before.copy()
    for j in change.tolist():
        (admit if wanted[j] else drop)(now, j)
    return now


def believe(trust: Trust, trusted: Bools, s: int, accused: tuple[tuple[int, int], ...]) -> Trust:
    """Trust state after a search on scale s: `trusted` (p,) meters, and accused faults with their scales."""
    fallen = trust.trusted & ~trusted
    scale, quiet = np.where(fallen, s, trust.scale), np.where(fallen, 0, trust.quiet)
    return replace(trust, trusted=trusted, scale=scale, quiet=quiet, accused=accused)
