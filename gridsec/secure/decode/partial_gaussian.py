"""Partial Kalman filters with fusion, chi-square test and choice among hypotheses: lee2018, Algorithm 4.2.

    z = Phi x + v + e,    v ~ N(0, P),  P >= 0

The joint covariance of partial filters is usually singular: their initial errors are equal, and so are those
of modes that several sensors cannot observe. In place of P^-1, with N the annihilator of Phi and
`V = N P N^T`,

    g = (N z)^T V^+ (N z),     x_hat = Phi^+ (I - P N^T V^+ N) z

are the test and the minimum-variance estimate of `gridsec.secure.decode.gaussian` wherever P > 0. A parity
with variance zero is not random: it vanishes exactly unless there is an attack.

The trusted sensors are fused and tested at every step. After an alarm every set of p - q sensors is tested,
and the most likely one is trusted from then on.

Corrected: degrees of freedom are the rank of the residual's covariance, that covariance may be singular,
and the estimate of an alarming step is that of the newly chosen set: docs/errata/lee2018-chapter-4.md.

Source: lee2018, section 4.3.2; docs/theory-partial-observers.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints
from gridsec.errors import InputInvalid, NotObservable
from gridsec.observers import kalman
from gridsec.observers.kalman import KalmanDesign, KalmanState, Steady
from gridsec.observers.parts import heard
from gridsec.secure.decode.gaussian import Hypotheses, Rule, choose
from gridsec.secure.decode.stacks import MOST_SUBSETS, Stack, annihilator, require, subsets


@dataclass(frozen=True, slots=True, eq=False)
class Parity:
    """Part of the fusion of one set of sensors that does not depend on covariances. k rows are kept of N."""

    kept: Ints  # the sensors
    rows: Ints  # (k,) their rows
    checks: Floats  # (k - n, k) orthonormal N with N Phi = 0 on these rows
    inverse: Floats  # (n, k) Phi^+ on these rows


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """Fusion of one set of sensors under one covariance. N stacked rows."""

    estimator: Floats  # (n, N) Psi: the estimate is `Psi z`
    covariance: Floats  # (n, n) covariance of the estimate's error
    # (k - n, N) `g = |W z|^2`. Rows of exactly vanishing parities are divided by `sqrt(tol)` of their scale
    standardise: Floats
    freedom: int  # degrees of freedom of g: rank of V


def parity(stack: Stack, kept: Ints, *, tol: float) -> Parity:
    """Prepare the fusion of some sensors.

    tol: singular values up to this, times the largest, count as zero.
    Raises NotObservable if these sensors do not determine x, or determine it without redundancy, so that no
        reading could contradict it.
    """
    rows = stack.rows(kept)
    phi = stack.matrix[rows]
    checks = annihilator(phi, tol=tol)
    rank = rows.size - len(checks)
    if rank < stack.unknowns or rows.size <= stack.unknowns:
        lack, code = "determine without redundancy", "no-redundancy"
        if rank < stack.unknowns:
            lack, code = "determine only", "not-observable"
        names = np.asarray(kept).tolist()
        why = f"sensors {names} {lack} {rank} of {stack.unknowns} unknowns"
        raise NotObservable(names, rank, why, code=code)
    inverse: Floats = np.asarray(np.linalg.pinv(phi), dtype=np.float64)
    return Parity(frozen_ints(kept), frozen_ints(rows), frozen(checks), frozen(inverse))


def fuse(prepared: Parity, P: Floats, *, tol: float) -> Fused:
    """Minimum-variance estimate and standardised residual under a covariance.

    P (N, N): covariance of v; positive semidefinite.
    tol: largest variance of an exact parity, in units in which every row of z has variance one. Also the
        squared allowance for an exact parity, in the same units.
    Source: lee2018 (2.2.16) to (2.2.20), Algorithm 4.2 with the rank as degrees of freedom; C. R. Rao,
        "Linear statistical inference and its applications", Wiley, 1973, section 4i (singular covariance).
    """
    at = prepared.rows
    part = P[np.ix_(at, at)]
    size = np.sqrt(np.maximum(np.diagonal(part), 0.0))
    size = np.where(size > 0.0, size, float(size.max(initial=0.0)) or 1.0)
    # N z = (N D)(D^-1 z): the same parities, orthonormal in units in which rows have variance one.
    turn, _ = np.linalg.qr((prepared.checks * size).T)
    variances, axes = np.linalg.eigh(turn.T @ (part / np.outer(size, size)) @ turn)
    # Floored, not dropped: violated exact parities must count, but not as degrees of freedom.
    W = (turn @ (axes / np.sqrt(np.maximum(variances, tol)))).T / size
    gain = part @ W.T
    correction = prepared.inverse @ gain
    n, N = prepared.inverse.shape[0], P.shape[0]
    estimator, standardise = np.zeros((n, N)), np.zeros((len(W), N))
    estimator[:, at] = prepared.inverse - correction @ W
    standardise[:, at] = W
    covariance = prepared.inverse @ part @ prepared.inverse.T - correction @ correction.T
    return Fused(
        frozen(estimator),
        frozen(0.5 * (covariance + covariance.T)),
        frozen(standardise),
        int(np.count_nonzero(variances > tol)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class GaussianDesign:
    """Filters and decoder."""

    filters: KalmanDesign  # the partial filters
    steady: Steady | None  # their stationary gain and covariance, if used; None for time-varying ones
    sets: tuple[Parity, ...]  # all sensors first, then every set of p - q
    # (N + 1,) Delta_TH for every number of degrees of freedom. With none, the statistic is not random, and a
    # violation of size 1 alarms
    thresholds: Floats
    # choice of the set after an alarm, see `gridsec.secure.decode.gaussian.choose`. "density" is the paper's,
    # which prefers sets with few rows if observable parts differ in size; "tail" does not
    rule: Rule
    # consecutive passed tests of all sensors together, after an alarm, until all of them are trusted again; 0
    # for never, as printed
    readmit: int
    # change of an entry of the covariance, relative to the standard deviations of its row and column, above
    # which the fusion is recomputed; 0 for every step
    refresh: float
    tol: float  # as in `partial_gaussian.fuse`


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """Fusions computed so far under one covariance."""

    P: Floats  # (mu, mu) the covariance
    fused: tuple[Fused | None, ...]  # one entry for each set; None until needed


@dataclass(frozen=True, slots=True, eq=False)
class GaussianState:
    """State of filters and decoder."""

    filters: KalmanState  # the filters' state
    current: int  # index of the trusted set among the design's sets
    passed: int  # consecutive tests passed by all sensors together since the last alarm
    tables: Tables  # fusion in use


@dataclass(frozen=True, slots=True, eq=False)
class GaussianOutcome:
    """Result of one step."""

    t: float  # time of the estimated state, s
    x: Floats  # (n,) estimate
    covariance: Floats  # (n, n) covariance of its error, if the trusted sensors are unmanipulated
    trusted: Bools  # (p,) the sensors in use
    alarm: bool  # f: True if the set trusted before failed its test in this step
    g: float  # statistic of the set trusted *before* this step
    threshold: float  # its threshold
    freedom: int  # its degrees of freedom
    # True if the set trusted now passes its own test. Otherwise more than q sensors are attacked, or this
    # step is one of the expected false alarms of all sets
    credible: bool


def design(
    filters: KalmanDesign,
    max_attacked: int,
    *,
    false_alarm: float,
    tol: float,
    steady: Steady | None = None,
    rule: Rule = "tail",
    readmit: int = 0,
    refresh: float = 0.0,
    most: int = MOST_SUBSETS,
) -> GaussianDesign:
    """Prepare Algorithm 4.2.

    max_attacked: q, at least 1.
    false_alarm: delta, in (0, 1).
    tol: as in `partial_gaussian.fuse`; its square root is the tolerance of observability.
    steady: from `kalman.steady`, for filters in steady state.
    rule, readmit, refresh: as in `GaussianDesign`.
    Raises NotObservable unless the pair is 2q-redundant detectable (lee2018, Proposition 4.3.1) and every set
        of p - q sensors is redundant by itself. DesignInfeasible if there are more than `most` sets.
        ValueError if `max_attacked` is below 1, or `false_alarm` not inside (0, 1).
    """
    if max_attacked < 1 or not 0.0 < false_alarm < 1.0:
        raise InputInvalid.of(
            "out-of-range", f"max_attacked is {max_attacked} (>= 1), false_alarm {false_alarm} (in (0, 1))"
        )
    stacked = Stack.of(filters.stack.blocks)
    zero = float(np.sqrt(tol))
    require(stacked, 2 * max_attacked, zero, f"undoing {max_attacked} errors")
    p = stacked.count
    kept = [np.arange(p), *subsets(p, p - max_attacked, most)]
    prepared = tuple(parity(stacked, k, tol=zero) for k in kept)
    freedom = np.arange(1, stacked.matrix.shape[0] + 1)
    thresholds = frozen(np.concatenate([[1.0], chdtri(freedom, false_alarm)]))
    return GaussianDesign(filters, steady, prepared, thresholds, rule, readmit, refresh, tol)


def init(
    design: GaussianDesign,
    t: float,
    mean: Floats,
    covariance: Floats,
    y: Floats,
    *,
    seen: Bools | None = None,
) -> tuple[GaussianState, GaussianOutcome]:
    """Initial state from the prior of the state and the first readings, with all sensors trusted.

    t: time of those readings, s.
    mean (n,), covariance (n, n): prior of the state; the covariance is not used by stationary filters.
    y (p,), seen (p,): as in `kalman.correct`.
    Raises ValueError if a stationary filter has no reading, or one is not finite.
    """
    first = kalman.init(design.filters, t, mean, covariance)
    if design.steady is None:
        first = kalman.correct(design.filters, first, y, seen)
    else:
        _require_all(y, seen)
        z = first.z + (y - first.z @ design.filters.stack.T.T) @ design.steady.K.T
        first = KalmanState(t, z, design.steady.P, design.steady.K)
    return decode(design, GaussianState(first, 0, 0, _none(design, first.P)))


def step(
    design: GaussianDesign, state: GaussianState, y: Floats, u: Floats, seen: Bools | None = None
) -> tuple[GaussianState, GaussianOutcome]:
    """Step from the input u(k) and the readings y(k+1) to the estimate of x(k+1).

    y (p,), u (m,), seen (p,): as in `kalman.step`. Stationary filters need every reading.
    Raises ValueError if a stationary filter has no reading, or one is not finite.
    """
    if design.steady is not None:
        _require_all(y, seen)
        filters = kalman.step_steady(design.filters, design.steady, state.filters, y, u)
    else:
        filters = kalman.step(design.filters, state.filters, y, u, seen)
    tables = state.tables
    if filters.P is not tables.P and _moved(filters.P, tables.P) > design.refresh:
        tables = _none(design, filters.P)
    return decode(design, GaussianState(filters, state.current, state.passed, tables))


def decode(design: GaussianDesign, state: GaussianState) -> tuple[GaussianState, GaussianOutcome]:
    """Test the trusted set, choose another if it fails, and estimate; lee2018, Algorithm 4.2."""
    z, now = state.filters.z, state.current
    tables, tested = _fused(design, state.tables, now)
    g, threshold = _score(tested, z), float(design.thresholds[tested.freedom])
    # Negated comparison: a statistic of NaN alarms.
    alarm = not g <= threshold
    chosen, passed, used = now, state.passed, tested
    if alarm:
        for i in range(1, len(design.sets)):
            tables, _ = _fused(design, tables, i)
        chosen = 1 + int(choose(_hypotheses(design, tables), z, rule=design.rule).hypothesis)
        tables, used = _fused(design, tables, chosen)
        passed = 0
    elif now != 0 and design.readmit > 0:
        tables, every = _fused(design, tables, 0)
        passed = passed + 1 if _score(every, z) <= design.thresholds[every.freedom] else 0
        if passed >= design.readmit:
            chosen, passed, used = 0, 0, every
    trusted = np.zeros(len(design.filters.stack.parts), dtype=np.bool_)
    trusted[design.sets[chosen].kept] = True
    credible = not alarm or bool(_score(used, z) <= design.thresholds[used.freedom])
    outcome = GaussianOutcome(
        state.filters.t,
        used.estimator @ z,
        used.covariance,
        trusted,
        alarm,
        g,
        threshold,
        tested.freedom,
        credible,
    )
    return GaussianState(state.filters, chosen, passed, tables), outcome


def _require_all(y: Floats, seen: Bools | None) -> None:
    if not np.all(heard(y, seen)):
        raise InputInvalid.of(
            "missing", "filters with stationary gains need every reading; design without `steady`"
        )


def _score(fused: Fused, z: Floats) -> float:
    """Statistic of one set."""
    return float(np.square(fused.standardise @ z).sum())


def _moved(P: Floats, old: Floats) -> float:
    """Largest change of a covariance, in units of its standard deviations."""
    size = np.sqrt(np.maximum(np.maximum(np.diagonal(P), np.diagonal(old)), 0.0))
    scale = np.outer(size, size)
    return float(np.max(np.abs(P - old) / np.where(scale > 0.0, scale, 1.0), initial=0.0))


def _none(design: GaussianDesign, P: Floats) -> Tables:
    """Empty tables for a new covariance."""
    return Tables(P, (None,) * len(design.sets))


def _fused(design: GaussianDesign, tables: Tables, index: int) -> tuple[Tables, Fused]:
    """Fusion of one set, stored in the tables for later steps."""
    found = tables.fused[index]
    if found is not None:
        return tables, found
    made = fuse(design.sets[index], tables.P, tol=design.tol)
    return Tables(tables.P, (*tables.fused[:index], made, *tables.fused[index + 1 :])), made


def _hypotheses(design: GaussianDesign, tables: Tables) -> Hypotheses:
    """The fused sets of p - q sensors in the form of `gridsec.secure.decode.gaussian.choose`."""
    small = [f for f in tables.fused[1:] if f is not None]
    wide = np.zeros((len(small), max(len(f.standardise) for f in small), len(tables.P)))
    for i, f in enumerate(small):
        wide[i, : len(f.standardise)] = f.standardise
    return Hypotheses(
        frozen_ints(np.stack([prepared.kept for prepared in design.sets[1:]])),
        frozen(np.stack([f.estimator for f in small])),
        frozen(wide),
        frozen_ints(np.array([max(f.freedom, 1) for f in small])),
    )
