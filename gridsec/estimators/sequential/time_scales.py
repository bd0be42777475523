"""Running means of the residuals on several time scales, their limits, and the tests of a posterior.

The window of a scale needs a minimum of readings to test a meter. Beside each meter's limit, the misfit
``m_T^T Q m_T`` of all trusted meters T is tested: for honest meters it is chi-square with |T| degrees of
freedom, and a manipulation below every single limit still raises it. An error of the model of at most e_j at
meter j adds at most ``sup ||e||_Q <= sqrt(e^T |Q| e)`` to its root, so that its limit is

    (sqrt(q) + sqrt(e^T |Q| e))^2

with q the quantile of chi-square at half of the false-alarm rate. The other half is for the scores of the
customers' active powers: ``R_k^T Q m`` has the variance ``i_k = R_k^T Q R_k`` for honest meters, R_k being
the effect of one power. A manipulation that looks like loads raises them far before the misfit. The same
error of the model adds at most ``sqrt(i_k e^T |Q| e)`` to a score.

References
----------
docs/theory-sequential.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import ceil

import numpy as np
from scipy.special import chdtri, ndtri

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.measurements import ClockSkew, FrameUncertainty
from gridsec.estimators.sequential.meter_bias import Learned
from gridsec.estimators.sequential.posterior import (
    LeaveOneOut,
    Posterior,
    Prior,
    add_meter,
    condition,
    remove_meter,
    remove_meters,
    well_conditioned,
)
from gridsec.estimators.sequential.search import FaultDictionary, Limits


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Residuals of the last ticks. p meters, s scales."""

    residuals: tuple[Floats, ...]  # (longest,) of (p,), the newest last; 0 without a reading
    available: tuple[Bools, ...]  # (longest,) of (p,): meters with a reading
    since_resum: int  # ticks since the sums were computed from the residuals
    sums: Floats  # (s, p) sum of the residuals of each scale
    counts: Ints  # (s, p) number of these residuals


def empty(lengths: tuple[int, ...], meters: int) -> Window:
    """Window before the first tick; lengths: ticks of each scale."""
    longest = max(lengths)
    return Window(
        residuals=(np.zeros(meters),) * longest,
        available=(np.zeros(meters, dtype=np.bool_),) * longest,
        since_resum=0,
        sums=np.zeros((len(lengths), meters)),
        counts=np.zeros((len(lengths), meters), dtype=np.intp),
    )


def push(window: Window, lengths: tuple[int, ...], residual: Floats, available: Bools) -> Window:
    """Window with the residuals (p,) of one more tick, squared pu, and the meters with a reading, (p,)."""
    before, marks, turn = window.residuals, window.available, window.since_resum + 1
    # While every meter reports, the same array enters and leaves.
    steady = all(marks[-length] is available for length in lengths)
    values = residual if all_of(available) else np.where(available, residual, 0.0)
    after = (*before[1:], values)
    if turn == len(after):
        # Differences of running sums gather rounding errors; a new sum every `longest` ticks bounds them.
        sums, turn = np.stack([np.sum(after[-length:], axis=0) for length in lengths]), 0
    else:
        sums = window.sums + values - np.array([before[-length] for length in lengths])
    counts = window.counts
    if not steady:
        counts = counts + available - np.array([marks[-length] for length in lengths])
    return Window(after, (*marks[1:], available), turn, sums, counts)


def forget(window: Window, meters: Bools) -> Window:
    """Window without the residuals of some meters, (p,)."""
    if not any_of(meters):
        return window
    residuals = tuple(np.where(meters, 0.0, each) for each in window.residuals)
    marks = tuple(each & ~meters for each in window.available)
    sums = np.where(meters, 0.0, window.sums)
    counts = np.where(meters, 0, window.counts)
    return Window(residuals, marks, window.since_resum, sums, counts)


def shift(window: Window, change: Floats) -> Window:
    """Window with all residuals increased by `change` (p,), squared pu."""
    pairs = zip(window.residuals, window.available, strict=True)
    residuals = tuple(np.where(available, each + change, 0.0) for each, available in pairs)
    return Window(
        residuals, window.available, window.since_resum, window.sums + window.counts * change, window.counts
    )


# --- Tests of the scales ---


@dataclass(frozen=True, slots=True, eq=False)
class ScaleTest:
    """Tests of all meters on one scale. p meters."""

    loo: LeaveOneOut  # leave-one-out residuals
    enough: Bools  # (p,) meters with enough readings on this scale
    limit: Floats  # (p,) largest honest residual, squared pu
    above_limit: Bools  # (p,) residual above the limit
    limits: Limits  # rule of the limits
    release_factor: float  # factor on `sigmas` of the release limit

    @property
    def above_release_limit(self) -> Bools:
        """Residual above the release limit, (p,)."""
        loo = self.loo
        return self.enough & (np.abs(loo.residual) > self.limits.limit(loo.std, self.release_factor))


_REFACTORISE = 6
"""A posterior is factorised again when more than one in `_REFACTORISE` of its meters changed."""


_BLOCK_REMOVAL = 3
"""Fewer than one in `_BLOCK_REMOVAL` meters leave a fresh posterior by one block update instead."""


_MAX_UPDATES = 400
"""Largest number of rank-one updates since a factorisation (rounding)."""


@dataclass(frozen=True, slots=True, eq=False)
class ScaleData:
    """Data and limits of one scale. p meters."""

    prior: Prior  # prior of the voltages
    noise: Floats  # (p,) variance of each meter's mean, squared pu^2
    m: Floats  # (p,) mean residual, squared pu
    enough: Bools  # (p,) meters with enough readings
    limits: Limits  # rule of the limits


def min_readings(design: SequentialDesign, s: int) -> int:
    """Least number of readings of a meter that scale s tests."""
    return max(1, ceil(design.options.enough * design.lengths[s]))


class Scales:
    """All scales of one tick, computed on access. model: (p,) largest model error, squared pu."""

    def __init__(  # noqa: PLR0917
        self,
        design: SequentialDesign,
        uncertainty: FrameUncertainty,
        window: Window,
        learned: Learned,
        model: Floats,
        skew: ClockSkew | None = None,
    ) -> None:
        self.design, self.uncertainty, self.window, self.model = design, uncertainty, window, model
        self.learned, self.clock_skew, self.made = learned, skew, dict[int, ScaleData]()

    @cached_property
    def faults(self) -> FaultDictionary:
        """Fault dictionary with the sizes of this tick."""
        return replace(self.design.faults, std=self.uncertainty.sizes)

    def __getitem__(self, s: int) -> ScaleData:
        if s not in self.made:
            self.made[s] = self._scale(s)
        return self.made[s]

    def _scale(self, s: int) -> ScaleData:
        design, counts, learned = self.design, self.window.counts[s], self.learned
        need = min_readings(design, s)
        noise, enough = design.white / need + learned.variance, counts >= need
        if self.clock_skew is not None:
            noise, enough = noise + self.clock_skew.variance[s], enough & ~self.clock_skew.aside[s]
        return ScaleData(
            prior=self.uncertainty.priors[s],
            noise=noise,
            m=self.window.sums[s] / np.maximum(counts, 1),
            enough=enough,
            limits=Limits(
                *(
                    design.sigmas[s],
                    self.model,
                    learned.allowed,
                    learned.variance,
                    design.max_attacked,
                    learned.late,
                ),
                learned.recent[s],
            ),
        )

    def unknowns(self, accused: tuple[tuple[int, int], ...]) -> Floats | None:
        """Unknown directions of accused faults times their standard deviations, (n, k); None for none."""
        if not accused:
            return None
        which = np.array([k for k, _ in accused])
        return np.asarray(self.faults.columns(which) * self.faults.std[which])

    def with_direction(self, direction: Floats) -> Scales:
        """Scales with one more unknown direction (n,) in their priors."""
        each = {id(prior): prior.with_direction(direction) for prior in self.uncertainty.priors}
        uncertainty = replace(
            self.uncertainty, priors=tuple(each[id(prior)] for prior in self.uncertainty.priors)
        )
        return Scales(self.design, uncertainty, self.window, self.learned, self.model, self.clock_skew)


def scale_test(design: SequentialDesign, here: ScaleData, loo: LeaveOneOut) -> ScaleTest:
    """Tests of a scale by the leave-one-out residuals of a posterior."""
    limit = here.limits.limit(loo.std)
    over = here.enough & (np.abs(loo.residual) > limit)
    return ScaleTest(loo, here.enough, limit, over, here.limits, design.options.lower)


def update_posterior(
    before: Posterior | None, here: ScaleData, wanted: Bools, unknowns: Floats | None
) -> Posterior:
    """Posterior of wanted meters (p,) with unknown directions (n, k), from the last one where cheaper."""
    prior, noise = here.prior, here.noise
    if before is None or before.prior is not prior:
        return condition(prior, noise, wanted, unknowns)
    if before.unknowns.shape[1] if unknowns is None else not np.array_equal(before.unknowns, unknowns):
        return condition(prior, noise, wanted, unknowns)
    differs = before.trusted != wanted
    if not any_of(differs):
        return before
    change = indices(differs)
    many = change.size * _REFACTORISE > wanted.size
    few = not before.updates and change.size * _BLOCK_REMOVAL < wanted.size and not any_of(wanted[change])
    if many and few and well_conditioned(prior, before.noise):
        return remove_meters(before, differs)
    if many or before.updates + change.size > _MAX_UPDATES:
        return condition(prior, noise, wanted, unknowns)
    now = before.copy()
    for j in change.tolist():
        (add_meter if wanted[j] else remove_meter)(now, j)
    return now


# --- Tests of all trusted meters together ---


def inconsistent(
    now: Posterior, loo: LeaveOneOut, model: Floats, tail: float, scores: LoadScores | None = None
) -> bool:
    """True where the misfit of the trusted meters, or a score of a power, is beyond its limit.

    model: (p,) largest model errors, squared pu. tail: probability of a false alarm. scores: of the powers;
    None to test the misfit alone, with all of the probability. O(p), O(p^2) close to a limit.
    """
    half = tail if scores is None else 0.5 * tail
    beyond = np.sqrt(max(loo.chi_square, 0.0)) - np.sqrt(chi_square_limit(now.count, half))
    if scores is not None:
        beyond = max(beyond, scores.largest - score_limit(scores.count, half))
    if beyond <= 0.0:
        return False
    at, Q = now.precision()
    return bool(beyond > np.sqrt(model[at] @ np.abs(Q) @ model[at]))


@dataclass(frozen=True, slots=True)
class LoadScores:
    """Scores of the customers' active powers, in standard deviations."""

    largest: float  # the largest one
    count: int  # number of customers


MAX_SCORED = 724
"""Largest number of meters and of customers with scores: their information is O(p^2 N)."""


def scored(design: SequentialDesign) -> bool:
    """True if the scores of the customers' powers are tests of the design."""
    return max(design.customers, design.fixed.size) <= MAX_SCORED


def load_scores(
    design: SequentialDesign, now: Posterior, kept: Posterior | None, loo: LeaveOneOut
) -> LoadScores | None:
    """Scores of the residuals of a posterior; None on large feeders.

    kept: posterior of more meters, if any. Its information is computed once, and is at least that of fewer
    meters.
    """
    if not scored(design):
        return None
    if now.score_rows is None:
        full = kept if kept is not None and _contains(kept, now) else now
        if full.score_rows is None:
            full.score_rows = score_rows(design, full.Q)
        now.score_rows = full.score_rows
    return LoadScores(float(np.abs(now.score_rows @ loo.weights).max(initial=0.0)), design.customers)


def score_rows(design: SequentialDesign, Q: Floats) -> Floats:
    """Effects of the powers on the meters over the deviation of honest scores, ``R_k / sqrt(i_k)``, (k, p).

    Customers that move no voltage, at the busbar, are left out. Q: (p, p) precision, zero where not trusted.
    """
    columns = design.faults.columns(np.arange(design.customers))[design.prior.meters]
    information = np.einsum("pk,pk->k", columns, Q @ columns)
    some = information > NO_EFFECT * information.max(initial=0.0)
    return np.asarray(columns[:, some].T / np.sqrt(information[some])[:, None])


NO_EFFECT = 1e-12
"""Information about a power, relative to the largest one, that is rounding."""


def _contains(kept: Posterior, now: Posterior) -> bool:
    """True if a posterior has the prior and the noise of another one, and at least its meters."""
    same = kept.prior is now.prior and kept.unknowns.shape[1] <= now.unknowns.shape[1]
    return same and not any_of(now.trusted & ~kept.trusted) and np.array_equal(kept.noise, now.noise)


@lru_cache(maxsize=4096)
def score_limit(count: int, tail: float) -> float:
    """Two-sided quantile of the largest of `count` Gaussian scores at the tail, by the union bound."""
    return -float(ndtri(0.5 * tail / count)) if count else np.inf


@lru_cache(maxsize=4096)
def chi_square_limit(freedom: int, tail: float) -> float:
    """Quantile of chi-square with `freedom` degrees of freedom at the upper tail."""
    return float(chdtri(freedom, tail)) if freedom else 0.0
