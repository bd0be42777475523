"""Errors of a feeder's files from recorded readings: regressors, noise model, Bayes factors.

Squared voltages at Q places (a bus, or a phase of a bus), from power flow with the losses, and linear
sensitivities from powers at one place to the voltage at another. One class serves balanced feeders and those
of three phases: a customer is connected to places with weights that add up to 1.

With U the squared voltages by the files and the metered powers, the readings less U are to first order

    2 y_j b_j                       bias b_j of meter j, relative to the busbar's
    -(drop of U along branch l)     per unit of its length, at the places behind it
    A_ji p_i, B_ji q_i              errors of the gain of power registers
    -B_ji load_i                    error of tan(phi) where q is not metered; -B_ji: q at p = 0
    -B_ji roof_i (1, cos, sin, ...) load hidden by generation, with its daily course

and for customers at other places, exactly in the linear flow, ``W'(U + dU) - W U`` with W, W' the weights.
On closed loops a place has a complex share of a line's drop, rather than being behind the line or not.
Behind transformers places have bases of their own. A meter's readings are in the base of its place in the
files: a customer at another place reads the volts of that place. Means of phases weigh each by its base.

The errors of the powers of N customers are independent Ornstein-Uhlenbeck processes of correlation time tau.
At the p meters they give a field of covariance ``S exp(-abs(dt) / tau)``, ``S = k_p S_p + k_q S_q + S_0``.
Meters add white noise; that of the busbar is common to all meters on its phase. A Kalman filter over the few
modes of S above the meters' noise whitens readings and regressors alike; missing readings are left out
exactly.

Whitened readings are ``y = A b + n`` with white n of variance 1 and independent coefficients ``b_k ~ N(0,
s_k^2)``: biases within the class of their meters, gains within the class of the registers, power factors
within their limits, lengths within their tolerance. A hypothesis adds a column z: an error of the files,
either with the coefficient 1 (a customer is at another bus) or with a prior spread (a line is longer, a
meter's error has changed). With ``P = I - A S (I + S A^T A S)^-1 S A^T`` and

    g = z^T P y,   h = z^T P z

its logarithmic Bayes factor against files without that error is ``g - h / 2``, or for a spread s ``(g^2 / (h
+ 1 / s^2) - log(1 + h s^2)) / 2``. Without any error the expectation of a Bayes factor is 1. So a mean of M
factors exceeds ``1 / risk`` with at most the probability `risk`, for any dependence between them.

Source: docs/theory-studies.md, Calibration; V. Vovk, R. Wang, "E-values: calibration, combination and
applications", Annals of Statistics 2021.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.special import logsumexp

from gridsec.arrays import Bools, Floats, Ints, Phasors

__all__ = [
    "Field",
    "HypothesisEvidence",
    "Increments",
    "LoadErrors",
    "Places",
    "PriorUncertainty",
    "RegressionFit",
    "Regressors",
    "Series",
    "Weighed",
    "Whitening",
    "evidence",
    "explain",
    "fit",
    "increments",
    "learn",
    "regressors",
    "steps",
    "weigh",
    "whitening",
]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Model of a feeder for readings. Q places, N customers, p meters, L branches, F phases (1 or 3)."""

    # active, reactive (Q, Q): change of the squared voltage at a place per power injected at another, pu, the
    # factor 2 included
    active: Floats
    reactive: Floats
    phase: Ints  # (Q,) phase of each place, 0 to F - 1
    # (Q, L) share of a line's drop at a place: 1 behind a branch of a tree and 0 elsewhere, complex in loops
    share: Floats | Phasors
    weight: Floats  # (N, Q) connections of each customer; rows add up to 1
    meters: Ints  # (p,) customer of each meter
    volt: Floats  # (Q,) 1 pu of each place, V
    unit: Floats  # (p,) 1 pu of each meter's readings, V

    def read(self, weight: Floats) -> Floats:
        """Matrix from the places' squared voltages to the readings of meters with these weights, (p, Q) both.

        ``(mean of a v)^2 / unit^2`` with a the bases, linear in v^2 near 1 pu.
        """
        own = weight * self.volt
        return np.asarray(own * (own.sum(axis=1) / self.unit**2)[:, None])

    @property
    def of_phases(self) -> Floats:
        """Effect of a squared voltage of each phase, common to all places, at the meters, (p, F)."""
        W = self.read(self.weight[self.meters])
        return np.stack([W[:, self.phase == f].sum(axis=1) for f in range(self.phase.max() + 1)], axis=1)

    @property
    def at_meters(self) -> tuple[Floats, Floats]:
        """Sensitivities of the meters to the customers' powers, (p, N) each."""
        W = self.read(self.weight[self.meters])
        return W @ self.active @ self.weight.T, W @ self.reactive @ self.weight.T

    def moved(self, series: Series, change: Mapping[int, Floats]) -> Floats:
        """Change of the meters' squared voltages for customers at other places, (T, p).

        change: new weights (Q,) of each moved customer.
        """
        weight = self.weight[self.meters]
        before = self.read(weight)
        for j, customer in enumerate(self.meters.tolist()):
            if customer in change:
                weight[j] = change[customer]
        W = self.read(weight)
        away: Floats = np.zeros((series.t.size, W.shape[0]))
        moves = np.flatnonzero(np.isin(self.meters, list(change)))
        away[:, moves] = series.places @ (W - before)[moves].T
        used = np.flatnonzero(W.any(axis=0))
        for customer, new in change.items():
            shift = new - self.weight[customer]
            some = np.flatnonzero(shift)
            for matrix, power in ((self.active, series.p), (self.reactive, series.q)):
                gain = W[:, used] @ (matrix[np.ix_(used, some)] @ shift[some])
                away += np.outer(power[:, customer], gain)
        return away

    def rephased(self, series: Series, parts: Sequence[tuple[Ints, int, int]]) -> Floats:
        """Change of the meters' squared voltages for parts of one phase that are on another phase, (T, p).

        The customers' powers move from the place that feeds a part to another phase of its bus. The drop
        along the part stays, and so do the ratios of its bases. Several parts change together.

        parts: for each part: its customers, the place that feeds it, and the place on the other phase.
        """
        W = self.read(self.weight[self.meters])
        shift: Floats = np.zeros_like(series.places)
        for customers, one, other in parts:
            for matrix, power in ((self.active, series.p), (self.reactive, series.q)):
                shift += np.outer(power[:, customers].sum(axis=1), matrix[:, other] - matrix[:, one])
        away = shift @ W.T
        for customers, one, other in parts:
            on = np.flatnonzero(np.isin(self.meters, customers))
            was = series.places @ W[on].T
            rise = series.places[:, other] + shift[:, other] - series.places[:, one]
            base = (self.volt[other] / self.volt[one]) ** 2
            away[:, on] = base * (was + np.outer(rise, W[on].sum(axis=1))) - was
        return np.asarray(away)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Readings and the files' model of them. T frames."""

    t: Floats  # (T,) times, s
    y: Floats  # (T, p) squared voltages read, pu; arbitrary where not seen
    seen: Bools  # (T, p) True where there is a reading
    # p, q (T, N): net injections, pu
    p: Floats
    q: Floats
    load: Floats  # (T, N) loads with reactive power by a power factor, pu
    # (T, N) reactive power of the load that generation may hide, where only the difference is metered, pu
    roof: Floats
    # (T, N) derivative of the inverter's q in the squared voltage read; 0 without one, or with q metered
    steep: Floats
    places: Floats  # (T, Q) squared voltages by power flow, pu
    # (T, F, L) their drop along each line, pu; in loops ``2 conj(V) (V_one - V_other)`` with V in its middle
    drop: Floats | Phasors

    def residual(self, places: Places) -> Floats:
        """Readings less power flow, (T, p); 0 without a reading."""
        model = self.places @ places.read(places.weight[places.meters]).T
        return np.where(self.seen, self.y - model, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class PriorUncertainty:
    """Prior standard deviations of uncertain quantities; 0 for known ones."""

    bias: Floats  # (p,) fixed error of each meter, relative to the busbar's, 1
    # p_gain, q_gain (N,): relative error of the power registers, 1
    p_gain: Floats
    q_gain: Floats
    tan: Floats  # (N,) error of tan(phi) where q is not metered, 1
    roof: Floats  # (N,) actual share of `Series.roof`, its mean and its daily course, 1
    # p_level, q_level (N,): constant error of the powers, pu
    p_level: Floats
    q_level: Floats
    length: Floats  # (L,) relative tolerance of a branch's length, 1


@dataclass(frozen=True, slots=True, eq=False)
class Regressors:
    """Regressors by kind, one after the other."""

    columns: Floats  # (T, p, K) effect of a unit of each coefficient, squared pu
    spread: Floats  # (K,) prior standard deviations
    # kind -> (k,) indices of columns by the names of `PriorUncertainty`; k depends on the kind
    where: dict[str, Ints]


def regressors(places: Places, series: Series, doubts: PriorUncertainty) -> Regressors:
    """All regressors of a feeder with correct files."""
    A, B = places.at_meters
    seen = series.seen[:, :, None]

    def spatial(matrix: Floats, power: Floats) -> Floats:
        return np.asarray(matrix[None] * power[:, None, :])

    p, T = series.y.shape[1], series.t.size
    bias = np.zeros((T, p, p))
    twice = np.where(series.seen, 2.0 * series.y, 0.0)
    bias[:, np.arange(p), np.arange(p)] = twice
    # The assumed reactive power of an inverter follows its own meter's reading.
    bias -= spatial(B[:, places.meters], twice * series.steep[:, places.meters])
    parts = {
        "bias": bias,
        "p_gain": spatial(A, series.p),
        "q_gain": spatial(B, series.q),
        "tan": spatial(B, -series.load),
        "roof": np.concatenate([spatial(B, -shape * series.roof) for shape in _day(series.t)], axis=2),
        "p_level": spatial(A, np.ones_like(series.p)),
        "q_level": spatial(B, np.ones_like(series.p)),
        "length": lengthened(places, series),
    }
    count = np.cumsum([0, *(part.shape[2] for part in parts.values())])
    return Regressors(
        columns=np.where(seen, np.concatenate(list(parts.values()), axis=2), 0.0),
        spread=np.concatenate([np.tile(getattr(doubts, name), 5 if name == "roof" else 1) for name in parts]),
        where={name: np.arange(a, b) for name, a, b in zip(parts, count[:-1], count[1:], strict=True)},
    )


def _day(t: Floats) -> list[Floats]:
    """Mean and daily course in two harmonics, (T, 1) each: sufficient for the course of solar generation."""
    turn = 2.0 * np.pi / 86400.0 * t[:, None]
    return [np.ones_like(turn), *(wave(k * turn) for k in (1.0, 2.0) for wave in (np.cos, np.sin))]


def lengthened(places: Places, series: Series) -> Floats:
    """Change of the meters' squared voltages if a line's length doubles, negative, (T, p, L)."""
    W = places.read(places.weight[places.meters])
    phases = series.drop.shape[1]
    by_phase = [W[:, places.phase == f] @ places.share[places.phase == f] for f in range(phases)]
    return -sum(
        ((part[None] * series.drop[:, f, None, :]).real for f, part in enumerate(by_phase)),
        np.zeros((1, 1, 1)),
    )


def steps(series: Series, meter: int, pieces: int) -> tuple[Floats, list[tuple[float, float]]]:
    """Intervals in which one meter's error may differ from its usual: parts of the recording, and rests.

    Returns (T, p, H), [H pairs]: effect of a relative error in each interval, and its begin and end, s.
    """
    T, p = series.y.shape
    cuts = np.linspace(0, T, pieces + 1).astype(np.intp)
    spans = [(cuts[a], cuts[a + 1]) for a in range(pieces)] + [(cuts[a], T) for a in range(1, pieces - 1)]
    spans += [(cuts[a], cuts[a + 2]) for a in range(pieces - 2)]
    out = np.zeros((T, p, len(spans)))
    twice = np.where(series.seen[:, meter], 2.0 * series.y[:, meter], 0.0)
    for h, (first, end) in enumerate(spans):
        out[first:end, meter, h] = twice[first:end]
    times = [(float(series.t[first]), float(series.t[end - 1])) for first, end in spans]
    return out, times


# Modes of the field with a variance below this share of the meters' own count as white noise.
_FAINT = 1e-3
# Lags of increments, in frames, and number of time blocks with separate scores.
_LAGS = (1, 2, 4, 8, 16, 32)
_BLOCKS = 8
# Step of the derivative of the score, in logarithms.
_DIFFERENCE = 1e-3
# Prior standard deviations of the logarithms: powers within a factor e^3 of their prior, the correlation time
# within e^2, and the noise of the meters within e^0.5.
_SPREAD = np.array([3.0, 3.0, 2.0, 0.5])


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Covariances at p meters, squared pu^2."""

    # active, reactive (p, p): of unit errors of all customers' powers: ``4 R R^T`` and ``4 X X^T``
    active: Floats
    reactive: Floats
    known: Floats  # (p, p) of errors of known size


@dataclass(frozen=True, slots=True, eq=False)
class LoadErrors:
    """Errors of the customers' powers, and factor on the stated noise of the meters."""

    # p, q: standard deviations in the unit of the `Field`
    p: float
    q: float
    time_s: float  # correlation time, s
    white: float  # factor on the standard deviation of the meters' noise
    std: Floats  # (4,) standard errors of the logarithms of ``p, q, time_s, white``, see `learn`

    def covariance(self, field: Field) -> Floats:
        """S, (p, p)."""
        return np.asarray(self.p**2 * field.active + self.q**2 * field.reactive + field.known)


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """Whitening filter of T frames, computed once and applied to any number of columns."""

    modes: Floats  # (p, m) L with ``S = L L^T``
    decay: Floats  # (T,) autocorrelation of the modes from each frame to the next
    # (T, p, p) inverse Cholesky factor of the innovations' covariance; rows and columns of missing readings
    # are 0
    inverse: Floats
    gain: Floats  # (T, m, p) Kalman gain

    def __call__(self, columns: Floats) -> Floats:
        """Whiten columns (T, p, k): normalised innovations, in standard deviations."""
        out = np.empty_like(columns)
        state: Floats = np.zeros((self.modes.shape[1], columns.shape[2]))
        for k, column in enumerate(columns):
            innovation = column - self.modes @ state
            np.matmul(self.inverse[k], innovation, out=out[k])
            state += self.gain[k] @ innovation
            state *= self.decay[k]
        return out


def whitening(
    t: Floats,
    seen: Bools,
    S: Floats,
    *,
    time_s: float,
    white: Floats,
    common: Floats,
    gaps: Sequence[Floats],
) -> Whitening:
    """Compute the whitening filter.

    t (T,): times of the frames, s, ascending.
    S (p, p): covariance of the field, squared pu^2.
    white (T, p): variance of each reading's own noise.
    common (T, p, f): common errors of a frame's readings, one column each, in standard deviations: the noise
        of the busbar's f voltages.
    gaps T times (p, g): effects of unknown powers of single frames, one column each, in standard deviations.
    """
    L = _modes(S, white.mean(axis=0))
    p, m = L.shape
    decay = np.append(np.exp(-np.diff(t) / time_s), 0.0)
    inverse, gain = np.zeros((t.size, p, p)), np.zeros((t.size, m, p))
    P = np.eye(m)
    for k in range(t.size):
        rows = np.flatnonzero(seen[k])
        if rows.size:
            own, extra = L[rows], np.hstack([common[k], gaps[k]])[rows]
            cross = P @ own.T
            covariance = own @ cross + extra @ extra.T
            covariance[np.diag_indices_from(covariance)] += white[k, rows]
            half = solve_triangular(np.linalg.cholesky(covariance), np.eye(rows.size), lower=True)
            inverse[k][np.ix_(rows, rows)] = half
            K = cross @ half.T @ half
            gain[k][:, rows] = K
            P = P - K @ cross.T
            P = 0.5 * (P + P.T)
        P = decay[k] ** 2 * P + (1.0 - decay[k] ** 2) * np.eye(m)
    return Whitening(L, decay, inverse, gain)


def _modes(S: Floats, white: Floats) -> Floats:
    """L with ``L L^T = S`` up to modes below the noise."""
    scale = np.sqrt(white)
    values, vectors = np.linalg.eigh(S / np.outer(scale, scale))
    kept = values > _FAINT
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """Sums of products of increments over some lags, by blocks of time. B blocks, H lags."""

    dt: Floats  # (H,) the lags, s
    total: Floats  # (B, H, p, p) sums of products of increments
    count: Floats  # (B, H, p, p) numbers of products


def increments(t: Floats, seen: Bools, residual: Floats) -> Increments:
    """Products of increments of residuals, free of constants in time.

    t (T,): times, s.
    residual (T, p): readings minus model, squared pu.
    """
    step, p = float(np.median(np.diff(t))), residual.shape[1]
    lags = [lag for lag in _LAGS if 4 * lag <= t.size]
    total, count = np.zeros((2, _BLOCKS, len(lags), p, p))
    block = np.minimum(np.arange(t.size) * _BLOCKS // t.size, _BLOCKS - 1)
    for h, lag in enumerate(lags):
        even = np.abs(t[lag:] - t[:-lag] - lag * step) < 0.1 * step
        both = seen[lag:] & seen[:-lag] & even[:, None]
        change = np.where(both, residual[lag:] - residual[:-lag], 0.0)
        there = both.astype(np.float64)
        for b in range(_BLOCKS):
            some = block[lag:] == b
            total[b, h] = change[some].T @ change[some]
            count[b, h] = there[some].T @ there[some]
    return Increments(step * np.array(lags, dtype=np.float64), total, count)


def learn(
    given: Increments,
    field: Field,
    white: Floats,
    common: Floats,
    guess: LoadErrors,
    *,
    errors: bool = True,
    start: LoadErrors | None = None,
) -> LoadErrors:
    """Sizes and correlation time of the loads' errors by the composite likelihood of the increments.

    The increment over a lag h has the covariance ``2 (1 - exp(-h / tau)) S + 2 D``; its Gaussian likelihood,
    summed over the lags, is maximised over ``k_p, k_q, tau`` and a factor on D.

    white (p,): stated variance of the meters' noise, squared pu^2.
    common (p, p): covariance of the busbar noise's effect at the meters, squared pu^2.
    start: initial value of the search; by default `guess`.
    """
    base, begin = (np.log([n.p, n.q, n.time_s, n.white]) for n in (guess, start or guess))
    problem = _Composite(given.dt, field, white, common, base)
    count = given.count.sum(axis=0)
    mean = given.total.sum(axis=0) / np.maximum(count, 1.0)
    found = minimize(
        problem.value,
        begin - base,
        args=(mean, count),
        jac=True,
        method="L-BFGS-B",
        options={"ftol": 1e-11, "gtol": 1e-3, "maxiter": 200},
    )
    x = np.asarray(found.x)
    std = _errors(problem, x, given) if errors else np.full(4, np.nan)
    p, q, time_s, factor = np.exp(base + x).tolist()
    return replace(guess, p=p, q=q, time_s=time_s, white=factor, std=std)


def _errors(problem: _Composite, x: Floats, given: Increments) -> Floats:
    """Standard errors ``H^-1 (J + P) H^-1``: curvature, scores of blocks of time, the prior."""
    count = given.count.sum(axis=0)
    mean = given.total.sum(axis=0) / np.maximum(count, 1.0)
    H = np.array(
        [
            problem.value(x + step, mean, count)[1] - problem.value(x - step, mean, count)[1]
            for step in _DIFFERENCE * np.eye(4)
        ]
    ) / (2.0 * _DIFFERENCE)
    scores = []
    for total, some in zip(given.total, given.count, strict=True):
        scores.append(problem.value(x, total / np.maximum(some, 1.0), some)[1] - x / _SPREAD**2)
    J = np.cov(np.array(scores).T, ddof=1) * len(scores)
    # A flat likelihood may have slightly negative curvature: no direction is less certain than in the prior.
    values, vectors = np.linalg.eigh(0.5 * (H + H.T))
    inverse = (vectors / np.maximum(values, (1.0 / _SPREAD**2).min())) @ vectors.T
    return np.asarray(np.sqrt((inverse @ (J + np.diag(1.0 / _SPREAD**2)) @ inverse).diagonal()))


@dataclass(frozen=True, slots=True, eq=False)
class _Composite:
    """Minus the composite log-likelihood in logarithms relative to `base`, and its gradient."""

    dt: Floats
    field: Field
    white: Floats
    common: Floats
    base: Floats

    def value(self, x: Floats, mean: Floats, count: Floats) -> tuple[float, Floats]:
        p, q, time_s, factor = np.exp(self.base + np.clip(x, -20.0, 20.0)).tolist()
        active, reactive = p**2 * self.field.active, q**2 * self.field.reactive
        S = active + reactive + self.field.known
        D = np.diag(factor**2 * self.white) + self.common
        weight = np.mean(count, axis=(1, 2)) / 2.0
        # Overlapping increments count once: the lags share the readings.
        weight = weight / max(self.dt.size, 1)
        total, gradient = float(0.5 * np.sum((x / _SPREAD) ** 2)), x / _SPREAD**2
        for h, lag in enumerate(self.dt.tolist()):
            share = -np.expm1(-lag / time_s)
            covariance = 2.0 * (share * S + D)
            inverse = np.linalg.inv(covariance)
            fit = inverse @ mean[h]
            total += weight[h] * (np.linalg.slogdet(covariance)[1] + np.trace(fit))
            slope = inverse - fit @ inverse
            turned = -lag / time_s * np.exp(-lag / time_s) * S
            for k, part in enumerate((share * 2.0 * active, share * 2.0 * reactive, turned)):
                gradient[k] += weight[h] * 2.0 * np.sum(slope * part)
            gradient[3] += weight[h] * 4.0 * factor**2 * float(slope.diagonal() @ self.white)
        return total, gradient


@dataclass(frozen=True, slots=True, eq=False)
class RegressionFit:
    """Regression without any error of the files. n readings, K coefficients."""

    # (n, K) whitened regressors, each times the standard deviation of its prior, times ``L^-T`` with ``L L^T
    # = I + A^T A``: ``P = I - explained explained^T``
    explained: Floats
    residual: Floats  # (n,) ``P y``
    # estimate, std (K,): coefficients and their standard errors, the prior included
    estimate: Floats
    std: Floats
    scale: float  # ``y^T P y / n``, at least 1: residuals above the noise weaken all evidence


def fit(y: Floats, columns: Floats, spread: Floats, count: int) -> RegressionFit:
    """Fit the regression without any error of the files.

    y (n,): whitened readings minus model.
    columns (n, K): whitened regressors.
    spread (K,): standard deviation of each coefficient before any reading.
    count: number of readings; missing ones are zeros in `y` and `columns`.
    """
    A = columns * spread
    normal = A.T @ A
    normal[np.diag_indices_from(normal)] += 1.0
    half = solve_triangular(np.linalg.cholesky(normal), np.eye(spread.size), lower=True)
    explained = A @ half.T
    scaled = explained.T @ y
    residual = y - explained @ scaled
    return RegressionFit(
        explained=explained,
        residual=residual,
        estimate=spread * (half.T @ scaled),
        std=spread * np.sqrt(np.einsum("ij,ij->j", half, half)),
        scale=max(1.0, float(y @ residual) / max(count, 1)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisEvidence:
    """Evidence of the readings for H hypotheses."""

    # g, h (H,): score and information of each coefficient
    g: Floats
    h: Floats
    log_factor: Floats  # (H,) logarithm of the Bayes factor against files without the error


def evidence(given: RegressionFit, z: Floats, spread: Floats) -> HypothesisEvidence:
    """Compute the Bayes factor of each hypothesis.

    spread (H,): prior standard deviation of its coefficient; 0 for the coefficient 1.
    """
    projected = given.explained.T @ z
    g = z.T @ given.residual / given.scale
    h = np.einsum("ij,ij->j", z, z) - np.einsum("ij,ij->j", projected, projected)
    h = np.maximum(h, 0.0) / given.scale
    s2 = spread**2
    free = 0.5 * (g**2 * s2 / (1.0 + h * s2) - np.log1p(h * s2))
    return HypothesisEvidence(g, h, np.where(spread > 0.0, free, g - 0.5 * h))


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """Joint evidence of hypotheses of several kinds."""

    confidence: Floats  # (H,) probability of each, for equal prior probabilities of some error and of none
    # logarithm of the mean Bayes factor: above ``log(1 / risk)`` there is an error; minus infinity without
    # any hypothesis
    any: float
    kept: Ints  # (k,) the best hypotheses, best first, with all but `risk` of the probability


def weigh(log_factor: Floats, kind: Ints, risk: float) -> Weighed:
    """Compare hypotheses; all kinds have equal weight, and within a kind all hypotheses.

    kind (H,): kind of each, as a number.
    risk: probability of a proposal for files without errors.
    """
    _, where, count = np.unique(kind, return_inverse=True, return_counts=True)
    log_share = log_factor - np.log(count.size * count[where])
    total = float(logsumexp(log_share)) if log_share.size else -np.inf
    order = np.argsort(-log_share, kind="stable")
    among = np.cumsum(np.exp(log_share[order] - total))
    kept = order[: int(np.searchsorted(among, 1.0 - risk)) + 1]
    return Weighed(np.exp(log_share - np.logaddexp(total, 0.0)), total, kept)


def explain(given: RegressionFit, z: Floats, own: Floats, like: float) -> tuple[Floats, Floats, Bools]:
    """Estimate each coefficient alone, and mark effects that cannot be distinguished.

    own (H,): standard deviation of the coefficient among the regressors; it is removed.
    like: smallest correlation of two effects, 1, that count as equal.
    Returns estimate, std (H,): least squares without prior for this coefficient; infinite errors where not
        determined.
    Returns same (H, H): pairs with equal effects after projection on the other regressors' complement.
    """
    projected = given.explained.T @ z
    inner = z.T @ z - projected.T @ projected
    inner = 0.5 * (inner + inner.T) / given.scale
    g, h = z.T @ given.residual / given.scale, inner.diagonal()
    with np.errstate(divide="ignore", invalid="ignore"):
        estimate = np.where(h > 0.0, g / h, 0.0)
        std = np.where(h > 0.0, np.sqrt(np.maximum(1.0 / h - own**2, 0.0)), np.inf)
        alike = np.abs(inner) / np.sqrt(np.outer(h, h))
    return estimate, std, np.asarray(np.nan_to_num(alike) >= like)
