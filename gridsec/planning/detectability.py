"""Sizes of attacks on the statistical core, by its tests of a step: hidden, undetected, found, named.

A step ``a`` (p,) of all readings, n ticks old, moves the scores of `gridsec.estimators.modal.signatures` to

    y = I_n a + xi,   cov xi = I_n,

I_n being the information of all members about a step of this age. It depends on covariances only, so that
residuals zero give it. At the age n the detector accepts the step where no part of M is beyond gamma:

    members          (I_n a)_j,      |y| <= L(F, s, weight capital / p)
    powers, busbar   c_i' I_n a,     |y| <= L(F, s_i, weight capital / q)
    omnibus          a' Q a <= 2 (log gamma - log(weight capital)) + log det
    L^2 = 2 (1 + s^2 F) / s^2 (log gamma - log(weight capital / count) + log(1 + s^2 F) / 2)

F is the information that the detector counts with. The capital of an onset is at least ``1 - RAMPS``: the
onset itself gives that, and what dropped onsets hand over is added. Own errors beyond the accuracy class are
a further row. Honest residuals move a score with the standard deviation ``sqrt(F)``, and an own error by its
class at most.

- *undetected* and *found*: every row below ``1 - ROOM`` of its limit, or one beyond ``1 + ROOM``.
- *noticed*: one row is beyond its limit by ``sqrt(2 ln(1 / risk))`` standard deviations. Scores are linear in
  independent Gaussian and uniform errors, hence sub-Gaussian with the variance F.
- *hidden*: E M_t <= t without a fault. So log M is beyond its limit t ticks after the start with a
  probability of at most ``alpha = t / gamma``, and under the step a, by the lemma of Neyman and Pearson, of
  at most ``Phi(sqrt(a' I_n a) - z_alpha)``, whatever the detector does with the readings.
- *named*: see `NamedSizes`.

References
----------
Lehmann and Romano, Testing Statistical Hypotheses, 2005, theorem 3.2.1.
docs/theory-studies.md, sections 5 to 7; docs/theory-core.md, sections 4 and 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import log, sqrt

import numpy as np
from scipy.special import ndtri

from gridsec.arrays import Floats, Ints, submatrix
from gridsec.estimators.modal import (
    classes,
    detector,
    doubts,
    estimate,
    full,
    replay,
    rivals,
    signatures,
    static,
)
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.core import Core, CoreState
from gridsec.estimators.modal.costs import SearchProblem, Tableau
from gridsec.estimators.modal.detector import RAMPS, SIZE, WEIGHTS
from gridsec.estimators.modal.doubts import Unknown
from gridsec.estimators.modal.filter import FilterState
from gridsec.estimators.modal.search import DOUBT
from gridsec.estimators.modal.signatures import Joint, Onsets
from gridsec.estimators.modal.static import Static
from gridsec.planning.collusion import Corridor, Shift, corridor, furthest
from gridsec.planning.unavoidable import AcceptanceRegion, ConeProgram, Faults, deviations

__all__ = [
    "AGES",
    "HONEST",
    "INITIAL",
    "QUIET",
    "ROOM",
    "SINCE",
    "Known",
    "MonitorTests",
    "NamedSizes",
    "StepTests",
    "Threshold",
    "acceptance_region",
    "hidden_norm",
    "hidden_step",
    "known",
    "noticed",
    "step_tests",
]

ROOM = 0.4
"""Part of every limit for honest residuals, 1: 2.7 standard deviations of a Gaussian one, at every tick."""
AGES = (16, 1024)
"""Ages of a step at which it is tested, ticks: a step of an hour is 3 % smaller than one of the last age."""
INITIAL = (64,)
"""Age at which a step from the first reading on is tested, ticks: its information hardly grows later."""
LONGEST_S = 3600.0
"""Largest age at which a step is tested, s: loads have changed then."""
LEARNING = 288
"""Ticks of a learning run, 1: one in five minutes of a day. With 24, errors of the estimate are 5 % less."""
HONEST = 1024
"""Honest ticks between the learning run and a step, 1: with four times as many, sizes are 2 % smaller."""
QUIET, SINCE = 4, 12
"""Honest readings before a step, and those since, of the sizes before fixed errors are learned, 1.

Up to 18 onsets none is dropped, so that the capital of the step's onset is exact.
"""
HIDDEN_S = 600.0
"""Time since the start of the detector within which *hidden* holds, s: the longest scenario of a campaign."""
OTHERS = 2.0
"""Largest size of the other manipulated meters of *named*, in their own sizes alone, 1."""
PARTNERS = 3
"""Partners of a manipulated meter that are compared for *named*, 1: those with the closest scores."""
ROUNDS = 2
"""Rounds in which the prior size of the faults follows the size of *named*, 1."""
MOST = 0.2
"""Largest step, squared pu: beyond about 10 % of the voltage no reading is plausible."""
RIVALS = 8
"""Largest number of faults that a rival explanation of *named* has, 1: each costs an accusation."""
_TINY = float(np.finfo(np.float64).tiny)


# --- The core before a step ---


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Filter of the core before a step.

    Attributes
    ----------
    filter, static
        The filter, and the information about the directions.
    unknown
        Directions that every frame leaves unknown; None for none.
    """

    filter: FilterState = field(repr=False)
    static: Static = field(repr=False)
    unknown: Unknown | None = field(default=None, repr=False)

    @property
    def wide(self) -> Floats | None:
        """Unknown directions for the filter, (p, k)."""
        return None if self.unknown is None else self.unknown.wide

    def variance(self, core: Core) -> Floats:
        """Variance of the estimate at all places, (n,), squared pu^2."""
        out = estimate.honest(core.modes, core.estimator, self.filter, self.static).variance
        whole, p = self.filter.full, core.modes.size
        if self.unknown is None or whole is None:
            return out
        noise, every = core.modes.noise + whole.whole, np.ones(p, dtype=np.bool_)
        return np.asarray(out + doubts.regressed(noise, self.unknown, np.zeros(p), every)[1])


def known(
    core: Core, ticks: int, step_s: float, *, learned_s: float = 0.0, unknown: Unknown | None = None
) -> Known:
    """Filter after a number of honest ticks; without any, fixed errors are known by their class only.

    Parameters
    ----------
    core
        The core.
    ticks, step_s
        Number of ticks, and their interval, s.
    learned_s
        Time before them in which fixed errors are learned by `LEARNING` ticks, s; 0 for none.
    unknown
        Directions that every frame leaves unknown; None for none.
    """
    made, wide = core.modes, None if unknown is None else unknown.wide
    state, info, zero = modal.start(made, 0.0), static.start(made), np.zeros(made.size)
    intervals = [learned_s / LEARNING] * (LEARNING if learned_s > 0.0 else 0) + [step_s] * ticks
    for h in intervals:
        state, info, _ = full.step(made, state, info, state.t + h, zero, stay=True, unknown=wide)
    return Known(state, info, unknown)


# --- Tests of one age ---


@dataclass(frozen=True, slots=True, eq=False)
class StepTests:
    """Tests of a step of one age. n places, p meters, r rows.

    Attributes
    ----------
    age
        Ticks since the onset, its own included.
    information : (p, p)
        I of a step.
    rows : (r, p)
        Change of each statistic per step: scores of members, of powers and busbar, and means of own errors.
    limits : (r,)
        Limit of each statistic.
    noise, bias : (r,)
        Standard deviation of each honest statistic, and its largest value by an error within the class.
    form : (k, p)
        Omnibus, in units of its limit.
    weights : (n, p)
        Change of the estimate at each place per step.
    """

    age: int
    information: Floats = field(repr=False)
    rows: Floats = field(repr=False)
    limits: Floats = field(repr=False)
    noise: Floats = field(repr=False)
    bias: Floats = field(repr=False)
    form: Floats = field(repr=False)
    weights: Floats = field(repr=False)

    @property
    def region(self) -> AcceptanceRegion:
        """Steps that the core accepts, if honest residuals are zero."""
        return AcceptanceRegion(self.rows / self.limits[:, None], (self.form,), self.weights)


def step_tests(
    core: Core,
    before: Known,
    ages: Sequence[int],
    step_s: float,
    *,
    jump: float = 0.0,
) -> tuple[StepTests, ...]:
    """Tests of a step at some ages; O(p^2) per tick, and O(p^3) with unknown directions.

    Parameters
    ----------
    core, before
        The core, and its filter before the step.
    ages
        Ticks since the onset, growing.
    step_s
        Interval of the ticks, s.
    jump
        Variance of a jump of the loads at the onset, in that of the loads, 1.
    """
    made, state, info = core.modes, before.filter, before.static
    onsets, exact, out = signatures.empty(made, 1), replay.begun(made, 0, ramp=False), list[StepTests]()
    begun, zero = state.t, np.zeros(made.size)
    capital = np.full(len(WEIGHTS), log(1.0 - RAMPS))
    for n in range(1, max(ages) + 1):
        first = n == 1
        state, info, update = full.step(
            made,
            state,
            info,
            begun + n * step_s,
            zero,
            stay=True,
            unknown=before.wide,
            jump=jump if first else 0.0,
        )
        onsets = signatures.follow(made, onsets, update, info, update.gap.h, begun=[0] if first else ())
        if update.exact is not None:
            exact = replay.follow(made, exact, update.exact, update.gap)
        if n in ages:
            joint = signatures.joint(made, onsets, info, 0) if update.exact is None else exact.joint(made)
            out.append(_tests(core, Known(state, info, before.unknown), onsets, 0, joint, capital))
    return tuple(out)


def acceptance_region(core: Core, state: CoreState, row: int) -> AcceptanceRegion:
    """Steps since a kept onset that the core accepts, all readings complete; by the capital of the onset.

    Parameters
    ----------
    core, state
        The core, and its state after honest ticks.
    row
        Row of the onset.
    """
    test = detector.followed(core.modes, state.detector)
    joint = signatures.joint(core.modes, test.onsets, state.static, row)
    before = Known(state.filter, state.static)
    return _tests(core, before, test.onsets, row, joint, test.capital[:, row]).region


def _tests(  # noqa: PLR0917  # the core, and one onset
    core: Core, now: Known, onsets: Onsets, row: int, joint: Joint, capital: Floats
) -> StepTests:
    made, faults, p = core.modes, core.faults, core.modes.size
    scored = joint.information @ made.U.T
    information = made.U @ scored
    told = signatures.scores(made, onsets, now.static, np.array([row]))
    left = core.limit - np.log(np.array(WEIGHTS)) - capital
    _, F = told.of_members(made)
    members = _limit(F[0], faults.variance[:p], left[0] + log(p))
    W, squares = faults.others
    _, F = told.of(W, squares)
    others = _limit(F[0], faults.variance[p:], left[2] + log(max(1, W.shape[1])))
    scores = np.vstack([information, W.T @ scored])
    noise = np.sqrt(np.concatenate([information.diagonal(), np.vecdot(W.T @ joint.information, W.T)]))
    rows = scores, *_class_rows(core, now, joint)
    quadratic, offset = _omnibus(told, SIZE**2 / made.white)
    half = np.linalg.cholesky(quadratic).T @ scored / sqrt(2.0 * left[1] + offset)
    n, whole = len(core.effect), now.filter.full
    # The estimate moves as its correction, and with the unknown errors by the rest of the residuals.
    moved = estimate.moves(made, core.estimator, now.filter, joint, np.eye(p), np.zeros((n, p)))
    weights = -moved[:n]
    if now.unknown is not None and whole is not None:
        gain, _ = doubts.regression(made.noise + whole.whole, now.unknown, np.arange(p))
        weights = weights - gain.T @ moved[n:]
    limits = np.concatenate([members, others, rows[2]])
    counted = np.isfinite(limits)
    return StepTests(
        age=int(onsets.age[row]),
        information=information,
        rows=np.vstack(rows[:2])[counted],
        limits=limits[counted],
        noise=np.concatenate([noise, rows[3]])[counted],
        bias=np.concatenate([np.zeros(noise.size), rows[4]])[counted],
        form=half,
        weights=weights,
    )


def _limit(F: Floats, s2: Floats, left: float) -> Floats:
    """Limit of scores with the information F and prior variances s2, (q,); infinite without information."""
    more = 1.0 + s2 * F
    with np.errstate(divide="ignore"):
        return np.where(F > 0.0, np.sqrt(2.0 * more / s2 * (left + 0.5 * np.log(more))), np.inf)


def _class_rows(core: Core, now: Known, joint: Joint) -> tuple[Floats, Floats, Floats, Floats]:
    """Rows, limits, noise and bias of the comparison of own errors with their classes.

    With g, G, a of `gridsec.estimators.modal.classes` and ``w = 1 + s^2 G`` the limit of g is the larger root
    of ``(g - a G)^2 - g^2 / w = G (2 log(p gamma) + log w)``.
    """
    made, p = core.classes, core.modes.size
    rows = made.of_modes @ (joint.shift[1] @ core.modes.U.T)
    v, phi = classes.variances(made, core.modes, now.filter, now.static), made.fixed
    tested = (made.allowed < np.inf) & (v < classes.KNOWN * phi)
    v, a = np.where(tested, v, 0.5 * phi), np.where(tested, made.allowed, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        G = 1.0 / v - 1.0 / phi
        wider = 1.0 + SIZE**2 * G
        part, pull = 1.0 - 1.0 / wider, a * G
        rest = pull**2 - G * (2.0 * (core.limit + log(p)) + np.log(wider))
        g = (pull + np.sqrt(pull**2 - part * rest)) / part
    return rows, np.where(tested, g * v, np.inf), v * np.sqrt(np.maximum(G, 0.0)), v * G * a


def _omnibus(told: signatures.Scores, s2: float) -> tuple[Floats, float]:
    """M and d of ``2 log Lambda = Y' M Y - d`` of `gridsec.estimators.modal.detector.omnibus`, one row."""
    i, side, count = told.information[0], told.side[0], 1.0
    if told.share is not None:
        peak = float(told.share[0].max())
        count = float(told.share[0].mean()) / max(peak, _TINY)
        i, side = peak * i, sqrt(peak) * side
    more = 1.0 + s2 * i
    weight = s2 / more
    M, offset = np.diag(weight), count * float(np.log(more).sum())
    if told.cov.size:
        pull = side * weight
        rest = np.eye(len(told.cov)) - told.cov @ (pull @ side.T)
        M += pull.T @ np.linalg.solve(rest, told.cov) @ pull
        offset += float(np.linalg.slogdet(rest)[1])
    return M, offset


# --- Sizes by single tests ---


def noticed(tests: StepTests, liars: int, *, risk: float, error: Floats | None = None) -> Corridor:
    """Steps of at most M meters that may stay unnoticed at one moment.

    Every other one moves a statistic beyond its limit with a probability of at least ``1 - risk``.

    Parameters
    ----------
    tests
        Tests of one age.
    liars
        M, at least 1.
    risk
        Probability that the honest part of one statistic is in the way.
    error : (p,)
        Largest error of the model, squared pu; None for none.
    """
    p = tests.information.shape[0]
    away = sqrt(2.0 * log(1.0 / risk)) * tests.noise + tests.bias
    away = away if error is None else away + np.abs(tests.rows) @ error
    rows = tests.rows / (tests.limits + away)[:, None]
    return corridor(rows, liars, reach=_reach(rows[:p]))


def _reach(block: Floats) -> Floats:
    """Bound of each of p steps that p rows (p, p) keep within 1, (p,): ``|a| <= |R^-1| |R a|``."""
    return np.asarray(np.abs(np.linalg.inv(block)).sum(axis=1))


def hidden_norm(alarms_per_year: float, step_s: float, risk: float) -> float:
    """Norm ``sqrt(a' I a)`` of steps that stay hidden with probability ``1 - risk``; 0 for none.

    Log M stays below its limit at one moment within `HIDDEN_S` of the start of the detector, or at the first
    tick.

    Parameters
    ----------
    alarms_per_year
        False alarms in a year.
    step_s
        Interval of the ticks, s.
    risk
        The risk.
    """
    return max(0.0, deviations(alarms_per_year, max(HIDDEN_S, step_s)) + float(ndtri(risk)))


def hidden_step(information: Floats, meter: int, liars: int, norm: float) -> Floats:
    """Largest step of a meter with ``a' I a`` up to a norm, and steps of M - 1 others, (p,).

    For two meters the largest one. More are added one after another, so that larger ones may exist.

    Parameters
    ----------
    information : (p, p)
        I.
    meter
        The meter.
    liars
        M.
    norm
        The norm.
    """
    chosen = np.array([meter])
    while chosen.size < min(liars, len(information)):
        rest = np.delete(np.arange(len(information)), chosen)
        inner = np.linalg.solve(submatrix(information, chosen, chosen), information[chosen][:, rest])
        left = information[rest, rest] - np.vecdot(information[rest][:, chosen], inner.T)
        chosen = np.append(chosen, rest[np.argmax(inner[0] ** 2 / left)])
    out, block = np.zeros(len(information)), submatrix(information, chosen, chosen)
    along = np.linalg.solve(block, (chosen == meter).astype(np.float64))
    out[chosen] = norm * along / sqrt(along[0])
    return out


# --- Sizes by all tests ---


@dataclass(frozen=True, slots=True, eq=False)
class Threshold:
    """Size of a step at which the core stops being CLEAN. All sizes squared pu.

    undetected: reached by `lies`; every statistic is at most ``1 - ROOM`` of its limit.
    found: every larger step by as many meters has a statistic beyond ``1 + ROOM`` of its limit.
    unavoidable: a step of this size by the meters of `lies` is missed at least every second time by every
        test with the same rate of false alarms.
    """

    undetected: float
    found: float
    unavoidable: float
    lies: Floats  # (p,)


@dataclass(frozen=True, slots=True, eq=False)
class MonitorTests:
    """All tests of a step at all ages. n places, p meters.

    Attributes
    ----------
    quiet
        Steps that stay undetected, with the weights of the last age.
    loud : (r, p)
        Statistics in units of the limits of *found*.
    reach : (p,)
        Largest step of each meter in any collusion, squared pu.
    information : (p, p)
        I of the last age.
    z
        Standard deviations of one test of the last age, with the monitor's rate of false alarms.
    """

    quiet: AcceptanceRegion
    loud: Floats = field(repr=False)
    reach: Floats
    information: Floats = field(repr=False)
    z: float

    @staticmethod
    def of(steps: Sequence[StepTests], alarms_per_year: float, step_s: float) -> MonitorTests:
        """Tests of some ages, all meters trusted.

        Parameters
        ----------
        steps
            Tests of each age, the largest last.
        alarms_per_year, step_s
            False alarms in a year, and the interval of the ticks, s.
        """
        last, p = steps[-1], len(steps[-1].information)
        low = [each.rows / ((1.0 - ROOM) * (each.limits - each.bias))[:, None] for each in steps]
        high = [each.rows / ((1.0 + ROOM) * (each.limits + each.bias))[:, None] for each in steps]
        forms = tuple(each.form / (1.0 - ROOM) for each in steps)
        # ``a' Q a <= 1`` bounds a_j by the root of (Q^-1)_jj.
        norms = (1.0 + ROOM) * np.linalg.norm(np.linalg.inv(last.form), axis=1)
        return MonitorTests(
            quiet=AcceptanceRegion(np.vstack(low), forms, last.weights),
            loud=np.vstack(high),
            reach=np.minimum(_reach(high[-1][:p]), norms),
            information=last.information,
            z=deviations(alarms_per_year, last.age * step_s),
        )

    def corridor(self, liars: int) -> Corridor:
        """Linear tests for at most M manipulated meters, for `threshold`."""
        return corridor(self.loud, liars, reach=self.reach)

    def threshold(self, within: Corridor, along: Floats, *, must: int | None = None) -> Threshold:
        """Threshold of steps along a direction.

        Parameters
        ----------
        within
            Of `corridor`.
        along : (p,)
            A unit vector for the step of one meter, or the weights of a reconstruction.
        must
            A meter that is manipulated in any case.
        """
        linear: Shift = furthest(within, along, must=must)
        meters = np.flatnonzero(linear.lies)
        lies = np.zeros(along.size)
        if not meters.size:
            return Threshold(0.0, linear.bound, 0.0, lies)
        hidden = ConeProgram(*self._among(meters))(along[meters])
        lies[meters] = hidden.amounts
        F = submatrix(self.information, meters, meters)
        least = self.z * sqrt(float(along[meters] @ np.linalg.solve(F, along[meters])))
        return Threshold(hidden.size, linear.bound, least, lies)

    def _among(self, meters: Ints) -> tuple[AcceptanceRegion, Faults]:
        """Tests of steps of some meters only, without rows that these cannot bring to their limits."""
        most, rows = self.reach[meters], self.quiet.rows[:, meters]
        rows = rows[np.abs(rows) @ most > 1.0]
        forms = tuple(form[:, meters] for form in self.quiet.forms)
        q, places = meters.size, self.quiet.weights[:, meters]
        # Finite ranges: no step is beyond the reach.
        return AcceptanceRegion(rows, forms, places), Faults(np.eye(q), 0.0 * places, -most, most)


# --- Names ---


class NamedSizes:
    """Smallest steps of single meters that the search names, by its costs; simulated, not proved.

    With ``x = a e_k + e``, ``cov e = P = I^-1``, a set J of faults C_J with variances S_J costs
    (`gridsec.estimators.modal.costs`)

        x' A_J x + log det(1 + S_J F_JJ) + penalty(J),   A_J = (P + C_J S_J C_J')^-1,

    up to what all sets have in common. The true set {k} costs ``2 log p + log(1 + s^2 F_kk)`` besides its
    misfit. With ``D = A_J - A_k`` the step moves the difference by ``a^2 D_kk``, and the honest part by at
    most ``2 a t sqrt((D P D)_kk)`` beside ``e' D e``, with the probability ``1 - risk``, ``t = sqrt(2 ln(1 /
    risk))``. The set J is out of the question from the step on that solves

        a^2 D_kk - 2 a t sqrt((D P D)_kk) = b_J,   b_J = 2 log(q / DOUBT) + cost of {k} - cost of J

    without misfits.

    Rivals J are those of a descent without k, under the model of the loads, and under a jump of all loads at
    the onset. With M meters the M - 1 others have any amounts, and J may do without them: b_J grows by
    their penalties, for amounts up to `OTHERS` times their own sizes. The other meters of a phase, with the
    busbar's, are an image of the meter. Where they are no more than promised, they are a rival of any step.

    Parameters
    ----------
    core
        The core.
    plain, jumped
        Tests of the step by the model of the loads, and by a jump of them at the onset.
    risk
        The risk.
    """

    def __init__(self, core: Core, plain: StepTests, jumped: StepTests, risk: float) -> None:
        made, faults = core.modes, core.faults
        self.meters, self.bound = made.size, core.bound
        self.away = sqrt(2.0 * log(1.0 / risk))
        columns = made.back @ faults.W
        phases = made.phases > 0.0
        self.alike, self.promised = phases @ np.count_nonzero(phases, axis=0), core.near.most
        self.F = [columns.T @ each.information @ columns for each in (plain, jumped)]
        self.covariance = np.linalg.inv(plain.information)
        volume = [float(np.linalg.slogdet(each.information)[1]) for each in (plain, jumped)]
        # Twice the logarithm of the prior and of the volume that a jump costs.
        self.jump = volume[0] - volume[1] - 2.0 * log(rivals.RATE)
        self.std = faults.std
        self.charge = np.where(np.arange(faults.std.size) < made.size, 0.0, 2.0 * log(made.size))

    def __call__(self, meter: int, liars: int, least: float) -> float:
        """Smallest step of a meter that is named, alone and with M - 1 others, squared pu.

        Parameters
        ----------
        meter, liars
            The meter, and M.
        least
            Size at which the step is noticed, squared pu.
        """
        if self.alike[meter] - 1 <= self.promised:
            return np.inf
        size = self._size(meter, np.zeros(0, np.intp), least)
        if liars > 1:
            F = self.F[0][: self.meters, : self.meters]
            close = F[meter] ** 2 / F.diagonal()
            close[meter] = -np.inf
            near = np.argsort(-close)[: max(PARTNERS, liars - 1)]
            near = near[near != meter]
            for first in range(0, min(PARTNERS, near.size), liars - 1):
                size = max(size, self._size(meter, near[first : first + liars - 1], size))
        return size

    def _size(self, k: int, others: Ints, least: float) -> float:
        """The size with some others; the prior size of the faults is that of the step."""
        size = least
        for _ in range(ROUNDS):
            if not np.isfinite(size):
                break
            sets = self._tableau(k, others, size, 0)
            true = sets.copy()
            true.toggle(k)
            v, own = _split(true, size)
            spared = others.size * ((OTHERS * min(1.0, size / SIZE)) ** 2 + 2.0 * log(self.meters))
            b = 2.0 * log(self.std.size / DOUBT) + own + spared
            found = self._against(k, sets, size, v, b)
            found = max(found, self._against(k, self._tableau(k, others, size, 1), size, v, b - self.jump))
            size = max(least, found)
        return size

    def _against(self, k: int, rival: Tableau, size: float, v: Floats, b: float) -> float:
        """Smallest step at which no set of a descent without the meter is left; the sets are changed.

        v: (p,) column of A_k. b: cost that a set has to exceed.
        """
        found = 0.0
        rival.bar(k)
        for _ in range(RIVALS):
            u, constant = _split(rival, size)
            found = max(found, self._solved(u - v, k, b - constant))
            change = np.where(rival.chosen, np.inf, rival.changes())
            best = int(np.argmin(change))
            if not np.isfinite(change[best]):
                break
            rival.toggle(best)
        return found

    def _tableau(self, k: int, others: Ints, size: float, model: int) -> Tableau:
        """Sets that contain the others, with the scores of a step of meter k."""
        F, q, p = self.F[model], self.std.size, self.meters
        std, within = self.std.copy(), np.zeros(q, dtype=np.bool_)
        std[:p], within[others] = max(SIZE, size), True
        return Tableau(SearchProblem(size * F[:, k], F, std, p, self.charge, self.bound)).pivot(within)

    def _solved(self, D: Floats, k: int, b: float) -> float:
        """Least a from which on ``a^2 D_kk - 2 a t sqrt((D P D)_kk) >= b`` up to `MOST`; infinite for none.

        D: a column, (p,).
        """
        away, own = self.away * sqrt(max(0.0, float(D @ self.covariance @ D))), float(D[k])
        if own <= 0.0:
            return 0.0 if MOST * MOST * own - 2.0 * MOST * away >= b else np.inf
        root = away * away + b * own
        return (away + sqrt(root)) / own if root >= 0.0 else 0.0


def _split(found: Tableau, size: float) -> tuple[Floats, float]:
    """``A_J e_k``, (p,), and the cost of a set without its misfit, for the scores of a step of meter k."""
    p, column, chosen = found.problem.meters, found.borders[:-1, 0], found.chosen
    felt = np.where(chosen, column / found.problem.std**2, column)[:p] / size
    return felt, found.cost - float(found.borders[-1, 0])
