"""Detection of faults with a bounded rate of false alarms: an e-detector over onsets, faults and sizes.

For an onset k and a distribution pi of faults, the mixture of likelihood ratios

    Lambda_k(t) = integral exp(y' f - f' I f / 2) d pi(f)

of `gridsec.estimators.modal.signatures` is a martingale with mean 1 while there is no fault. With f ~ N(0,
s^2) in one column

    log Lambda = s^2 y^2 / (2 (1 + s^2 I)) - log(1 + s^2 I) / 2

and with f ~ N(0, s^2 D / d) in all members, d the mean of D's diagonal (the omnibus, which feels faults
that are small everywhere), the same sum over the modes, corrected for theta by a determinant of r rows. The
detector is

    M_t = sum_j weight_j sum_k capital_jk Lambda_jk(t)         alarm at M_t >= gamma

over the kinds j: members, omnibus, powers with busbar.

**Average run length.** Assumptions: the model of `gridsec.estimators.modal.model` with Gaussian errors, and
no fault. (1) Every Lambda_jk is a likelihood ratio of a mixture against the model, hence a nonnegative
martingale from its onset on, with mean 1. (2) At each tick each kind is given the capital 1: by an onset of
that tick, or for onsets at every n-th tick by the capital n at the last of the n ticks; the weights sum to 1.
(3) A dropped onset gives its capital to another one so that the sum stays, ``c_2 += c_1 Lambda_1 /
Lambda_2``; which one may depend on the readings so far. So M_t - t is a supermartingale, and for every
stopping time with a finite mean E[M_tau] <= E[tau]. The alarm has M_tau >= gamma, so that ``E[tau] >= gamma``
ticks. (4) What is not evaluated at a tick counts as zero, which only makes M smaller, whatever decides it.
With more than `static.FEW` directions, and where readings are missing, Lambda of members and omnibus are no
martingales, but have means of at most 1 at each fixed tick. Missing readings: exact for powers and busbar;
for members and omnibus up to the scaling of `signatures` and `omnibus`, exact for white errors.

References
----------
.. [1] Shin, Ramdas and Rinaldo, E-detectors: a nonparametric framework for sequential change detection,
   arXiv:2203.03532, 2022.
.. [2] Pollak, Average run lengths of an optimal method of detecting a change in distribution, Annals of
   Statistics 15, 1987.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import exp, gcd, inf, log, log1p, sqrt

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed, indices
from gridsec.estimators.modal import signatures
from gridsec.estimators.modal.filter import Update
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.signatures import Columns, Onsets, Scores
from gridsec.estimators.modal.static import Static

SIZE = 0.01
"""Prior standard deviation of a fault, squared pu: 0.5 % of the voltage, the class of ordinary meters."""
WEIGHTS = (0.5, 0.35, 0.15)
"""Weights of members, omnibus, and powers with busbar, 1. A weight w delays an alarm by log(1 / w) nats."""
RAMPS = 0.1
"""Share of ramps in all weights, 1: a ramp is also seen by steps, later."""
STEP_ROWS, RAMP_ROWS = 18, 6
"""Onsets of steps and of ramps that are kept. Ages grow by about 1.7 from row to row up to `OLDEST`."""
EVERY, RARELY = 4, 16
"""Ticks from one evaluation of young onsets to the next, and from one of all onsets."""
LATE = 6
"""Least age of an onset in the ticks from one evaluation to the next, 1: alarms are late by a sixth of it."""
RAMP_EVERY = RARELY
"""Ticks from one onset of a ramp to the next: a ramp of fewer ticks is not told from a step."""
JUMP = 12.25
"""Squared standardised score of one innovation that has M evaluated at once, 1: 3.5 standard deviations."""
OLDEST = 14400
"""Largest age of an onset, ticks: beyond it the filter has learned a step as a fixed error."""
PINS = 3
"""Onsets that are kept while they are suspected. The likeliest one at the alarm may be a tick or two off."""

_TINY = float(np.finfo(np.float64).tiny)
_LOG_WEIGHTS = np.log(np.array(WEIGHTS))[:, None]
# Pinned rows are kept besides. One row more: a row that is given back is free at the next tick only.
_STEPS = STEP_ROWS + EVERY + PINS + 1
_RAMPS = RAMP_ROWS + 1 + PINS + 1


@dataclass(frozen=True, slots=True, eq=False)
class Detector:
    """State of the detector. k rows.

    Attributes
    ----------
    onsets
        The onsets: rows of steps, then rows of ramps.
    capital : (3, k)
        Logarithm of the capital of each kind and row; -inf for none.
    ticks
        Ticks since the start.
    ratio : (3, k) or None
        Log Lambda of each kind and row after a full evaluation, -inf where not evaluated; the next tick thins
        the evaluated onsets by it.
    pinned : (k,)
        Rows that are evaluated at every tick and not dropped.
    log_m
        log M when it was evaluated last.
    precision
        Precision of the last innovation at each member; None before the first tick.
    waiting
        Ticks since the last evaluation, which onsets and capital do not contain yet: the rows pass the cache
        once for all of them. None of them is waiting while an onset is pinned or a reading is missing.
    """

    onsets: Onsets
    capital: Floats
    ticks: int
    ratio: Floats | None
    pinned: Bools
    log_m: float
    precision: Precision | None = None
    waiting: tuple[Tick, ...] = field(default=(), repr=False)


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """One step of the filter, the information about the directions with it, and the interval, s."""

    update: Update
    static: Static
    h: float


@dataclass(frozen=True, slots=True, eq=False)
class Precision:
    """Lower bound of the diagonal of ``V^-1`` at the members. t modes.

    Attributes
    ----------
    variance : (t,)
        v of the modes for which the bound is exact. It holds for all smaller ones.
    least : (t,)
        The bound.
    """

    variance: Floats
    least: Floats

    def exact(self, modes: Modes, update: Update, which: Bools | None = None) -> Floats:
        """The diagonal itself at a tick, for some members (t,) or for all."""
        which = np.ones(modes.size, dtype=np.bool_) if which is None else which
        if update.exact is not None:
            return update.exact.precision[which]
        return np.asarray(modes.squares[which] @ (1.0 / update.variance))


def precision(modes: Modes, before: Precision | None, update: Update) -> Precision:
    """Bound of a tick: that of an earlier one while the variances of the modes fall.

    Parameters
    ----------
    modes, before
        The modes, and the earlier bound.
    update
        The filter's step.
    """
    if update.exact is not None:
        return Precision(np.zeros(modes.size), update.exact.precision)
    if before is not None and all_of(update.variance <= before.variance):
        return before
    return Precision(update.variance, modes.squares @ (1.0 / update.variance))


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Answer of one tick. k rows.

    Attributes
    ----------
    log_m
        log M; -inf where not evaluated at this tick.
    by_row : (3, k)
        Logarithm of the part of each kind and row in M; -inf where not evaluated at this tick.
    """

    log_m: float
    by_row: Floats

    @property
    def rows(self) -> Ints:
        """Rows of the onsets with the largest parts in M, the largest first, (`PINS`,)."""
        return np.asarray(np.argsort(-self.by_row.max(axis=0), kind="stable")[:PINS])


def start(modes: Modes) -> Detector:
    """Detector before the first tick.

    Parameters
    ----------
    modes
        The modes.
    """
    onsets = signatures.empty(modes, _STEPS, _RAMPS)
    return Detector(onsets, np.full((3, onsets.age.size), -inf), 0, None, np.zeros_like(onsets.used), -inf)


def pin(detector: Detector, rows: Ints) -> Detector:
    """Keep some onsets, and no others.

    Parameters
    ----------
    detector
        The detector after a tick.
    rows
        Rows in use, at most `PINS`; () to keep none.
    """
    pinned = np.zeros_like(detector.pinned)
    pinned[rows[:PINS]] = True
    return changed(detector, pinned=pinned & detector.onsets.used)


def step(
    modes: Modes,
    columns: Columns,
    before: Detector,
    update: Update,
    static: Static,
    *,
    h: float,
    alert: float,
) -> tuple[Detector, Evidence]:
    """Take in one step of the filter and evaluate M, if that is due.

    All onsets are evaluated at the first `EVERY` ticks, at every `RARELY`-th, and while log M was above
    `alert`. An onset of up to `LATE` n ticks is evaluated at the multiples of n, n being `EVERY` and its
    doubles. Pinned and young ones are evaluated at every tick while an onset is pinned. Powers are evaluated
    with all these: the hand-over of capital needs their Lambda. Young onsets are evaluated without powers
    where a reading is missing, and where one innovation stands out by itself. What is evaluated may depend on
    the readings: what is left out only makes M smaller.

    Parameters
    ----------
    modes, columns
        The modes, and columns of faults in them.
    before
        So far.
    update, static
        The filter's step, and the information about the directions with it.
    h
        Interval, s.
    alert
        log M from which on it is evaluated at every tick.
    """
    ticks, waiting = before.ticks + 1, (*before.waiting, Tick(update, static, h))
    regular, suspected = ticks <= EVERY or ticks % EVERY == 0, any_of(before.pinned)
    # The variances fall: an old bound is too low to be of use.
    least = precision(modes, None if regular else before.precision, update)
    alerted = suspected or before.log_m >= alert
    due = regular or alerted or update.seen is not None or _stands_out(modes, update, static, least)
    before = changed(before, ticks=ticks, precision=least, waiting=waiting)
    if not due and update.exact is None:
        return before, _NO_EVIDENCE
    now = followed(modes, before)
    if not due:
        return now, _NO_EVIDENCE
    every = gcd(ticks, RARELY) if regular else EVERY
    if ticks <= EVERY or (alerted and not suspected):
        every = RARELY
    now, evidence = evaluated(modes, columns, now, static, every, powers=regular or every == RARELY)
    return now if regular else changed(now, ratio=None), evidence


def followed(modes: Modes, before: Detector) -> Detector:
    """The same with the ticks that are waiting; O(k t) each.

    Parameters
    ----------
    modes, before
        The modes, and the detector after a tick.
    """
    onsets, capital, ratio, ticks = before.onsets, before.capital, before.ratio, before.ticks
    if not before.waiting:
        return before
    capital = capital.copy()
    for number, tick in enumerate(before.waiting, ticks - len(before.waiting)):
        ended = () if ratio is None else _thin(onsets, before.pinned, capital, ratio)
        free, ratio = onsets.used, None
        begun = [int(free[:_STEPS].argmin())]
        capital[:, begun[0]] = log(1.0 - RAMPS)
        if number % RAMP_EVERY == 0:
            begun.append(_STEPS + int(free[_STEPS:].argmin()))
            capital[:, begun[1]] = log(RAMPS * RAMP_EVERY)
        onsets = signatures.follow(
            modes,
            onsets,
            tick.update,
            tick.static,
            tick.h,
            begun=begun,
            ended=ended,
            own=onsets is not before.onsets,
        )
    return changed(before, onsets=onsets, capital=capital, ratio=None, waiting=())


def evaluated(
    modes: Modes, columns: Columns, test: Detector, static: Static, every: int, *, powers: bool
) -> tuple[Detector, Evidence]:
    """M of the onsets that are due by their age, and of the pinned ones.

    Parameters
    ----------
    modes, columns, test, static
        As in `step`; no tick is waiting.
    every
        Ticks since the last evaluation of all of them; `RARELY` for all onsets.
    powers
        With powers also where no onset is pinned.
    """
    onsets, capital, due = test.onsets, test.capital, test.onsets.used
    if every < RARELY:
        due = due & (((onsets.age <= LATE * every) & ~onsets.ramp) | test.pinned)
    rows, ratio = indices(due), np.full(capital.shape, -inf)
    now = signatures.scores(modes, onsets, static, rows)
    ratio[:, rows] = log_ratios(columns, modes, now, powers or any_of(test.pinned))
    by_row = capital + _LOG_WEIGHTS + ratio
    if any_of(due[_STEPS:]):
        # A ramp has its capital at the last tick of those that it stands for.
        by_row[:, onsets.ramp & (onsets.age < RAMP_EVERY)] = -inf
    top = float(by_row.max())
    log_m = top + log(float(np.exp(by_row - top).sum()))
    return changed(test, ratio=ratio, log_m=log_m), Evidence(log_m, by_row)


def _stands_out(modes: Modes, update: Update, static: Static, least: Precision) -> bool:
    """A member, a phase of the busbar, or all together, stand out in one innovation of all members."""
    v, exact = update.variance, update.exact
    if static.square > v.size + sqrt(2.0 * JUMP * v.size):
        return True
    if exact is not None:
        sigma = exact.score
        felt, _ = lapack.dtrtrs(exact.half, modes.phases, lower=True)
        of_busbar = (felt * felt).sum(axis=0)
    else:
        sigma = modes.U @ static.score
        of_busbar = modes.phase_squares @ (1.0 / v)
    y = sigma @ modes.phases
    if any_of(y * y > JUMP * of_busbar):
        return True
    sigma = sigma * sigma
    far = sigma > JUMP * least.least
    return any_of(far) and any_of(sigma[far] > JUMP * least.exact(modes, update, far))


def log_ratios(columns: Columns, modes: Modes, now: Scores, powers: bool) -> Floats:
    """Log Lambda of each kind and row, (3, k).

    Parameters
    ----------
    columns, modes
        The columns, and the modes.
    now
        Scores and information.
    powers
        Evaluate the powers as well; else they count as 0.
    """
    t, out = columns.members, np.full((3, len(now.score)), -inf)
    out[0] = log_mean(*now.of_members(modes), columns.variance[:t])
    out[1] = omnibus(now, SIZE**2 / modes.white)
    (W, squares), q = columns.others, columns.std.size - t
    # Without the powers, the phases of the busbar alone: the last columns.
    first = 0 if powers else columns.powers
    if q > first:
        y, F = now.of(W[:, first:], squares[:, first:])
        if now.busbar is not None:
            F[:, F.shape[1] - now.busbar.shape[1] :] = now.busbar
        out[2] = log_mean(y, F, columns.variance[t + first :]) + log((q - first) / q)
    return out


def log_mean(y: Floats, F: Floats, s2: Floats) -> Floats:
    """Logarithm of the mean Lambda of f ~ N(0, s2) in single columns, (k,).

    Parameters
    ----------
    y, F : (k, q)
        Scores and information.
    s2 : (q,)
        Prior variances.
    """
    more = s2 * F
    more += 1.0
    half = y * y
    half *= 0.5 * s2
    half /= more
    top = half.max(axis=1)
    half -= top[:, None]
    np.exp(half, out=half)
    half /= np.sqrt(more, out=more)
    return np.asarray(top + np.log(half.sum(axis=1) / half.shape[1]))


def omnibus(now: Scores, s2: float) -> Floats:
    """Log Lambda of f ~ N(0, s2 I) in the modes, (k,).

    Where readings are missing, the largest share of the members bounds the information. The mean share over
    the largest is then the weight of each mode in the determinant. For one member with the variance r of its
    score, in units of that bound, and ``u = s2 i / (1 + s2 i)``, the mean of Lambda is ``(1 - r u)^(-1/2)
    (1 - u)^(r/2) <= 1``, since ``-log(1 - r u)`` is convex in r. Modes of different information are scaled
    alike: that is exact for white errors.

    Parameters
    ----------
    now
        Scores and information.
    s2
        Prior variance in units of the white variance.
    """
    i, side, count = now.information, now.side, 1.0
    if now.share is not None:
        peak = now.share.max(axis=1)
        count = now.share.mean(axis=1) / np.maximum(peak, _TINY)
        i, side = peak[:, None] * i, np.sqrt(peak)[:, None, None] * side
    more = s2 * i
    more += 1.0
    weight = s2 / more
    A = weight * now.score
    out = np.vecdot(A, now.score) - count * np.log(more, out=more).sum(axis=1)
    if not now.cov.size:
        return np.asarray(0.5 * out)
    # det(I - N X'AX) and (N^-1 - X'AX)^-1 = (I - N X'AX)^-1 N.
    if len(now.cov) == 1:
        along, n = side[:, 0], now.cov[0, 0]
        pull, weight = np.vecdot(along, A), np.multiply(weight, along, out=weight)
        one = 1.0 - n * np.vecdot(weight, along)
        return np.asarray(0.5 * (out + n * pull * pull / one - np.log(one)))
    pull = np.einsum("krt,kt->kr", side, A)
    rest = np.eye(len(now.cov)) - now.cov @ ((side * weight[:, None, :]) @ side.transpose(0, 2, 1))
    gain = np.linalg.solve(rest, (pull @ now.cov.T)[..., None])[..., 0]
    return np.asarray(0.5 * (out + np.einsum("kr,kr->k", pull, gain) - np.linalg.slogdet(rest)[1]))


def _thin(onsets: Onsets, pinned: Bools, capital: Floats, ratio: Floats) -> list[int]:
    """Rows to drop, so that those of the next ticks are free; `capital` is changed: it goes to neighbours."""
    gone = list[int]()
    age, kinds = onsets.age.tolist(), list(zip(capital.tolist(), ratio.tolist(), strict=True))
    usable, known = onsets.used & ~pinned, ratio[0] > -inf
    for kind, all_rows in ((usable & ~onsets.ramp, STEP_ROWS), (usable & onsets.ramp, RAMP_ROWS)):
        most = all_rows - int(np.count_nonzero(kind & ~known))
        order = sorted(indices(kind & known).tolist(), key=lambda row: -age[row])
        ages = [age[row] for row in order]
        # Ratio of the ages beside each onset but the first and the last.
        beside = [ages[k - 1] / ages[k + 1] for k in range(1, len(ages) - 1)]
        while (len(order) > most and beside) or (ages and ages[0] > OLDEST):
            at = 0 if ages[0] > OLDEST else 1 + beside.index(min(beside))
            row = order.pop(at)
            ages.pop(at)
            beside = [ages[k - 1] / ages[k + 1] for k in range(1, len(ages) - 1)]
            # The neighbours are now at the places at - 1 and at.
            _hand_over(kinds, row, order[max(at - 1, 0) : at + 1])
            gone.append(row)
    if gone:
        capital[:] = [each for each, _ in kinds]
    return gone


_NO_EVIDENCE = Evidence(-inf, np.full((len(WEIGHTS), _STEPS + _RAMPS), -inf))


def _hand_over(kinds: list[tuple[list[float], list[float]]], row: int, near: list[int]) -> None:
    """Move the capital of a row to the neighbour with the largest Lambda, kind by kind; M stays.

    near: rows of the neighbours, at most 2.
    kinds: logarithms of capital and Lambda of every row, of each kind. The capitals are changed.
    """
    for capital, ratio in kinds:
        if near:
            to = near[-1] if ratio[near[-1]] > ratio[near[0]] else near[0]
            given, own = capital[row] + ratio[row] - ratio[to], capital[to]
            larger, less = (own, given) if own > given else (given, own)
            capital[to] = larger + log1p(exp(less - larger)) if larger > -inf else larger
        capital[row] = -inf
