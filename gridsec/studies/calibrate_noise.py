"""Noise of readings under a correct model: errors of loads, correlated in time and place, and meter noise.

The errors of the powers of N customers are independent Ornstein-Uhlenbeck processes of correlation time tau.
At the p meters they give a field of covariance ``S exp(-abs(dt) / tau)``, ``S = k_p S_p + k_q S_q + S_0``.
Meters add white noise; that of the busbar is common to all meters on its phase. A Kalman filter over the few
modes of S above the meters' noise whitens readings and regressors alike; missing readings are left out
exactly.

References
----------
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from gridsec.arrays import Bools, Floats

__all__ = ["Field", "Increments", "LoadErrors", "Whitening", "increments", "learn", "whitening"]

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
    """Covariances at p meters, squared pu^2.

    Attributes
    ----------
    active, reactive : (p, p)
        Of unit errors of all customers' powers: ``4 R R^T`` and ``4 X X^T``.
    known : (p, p)
        Of errors of known size.
    """

    active: Floats
    reactive: Floats
    known: Floats


@dataclass(frozen=True, slots=True, eq=False)
class LoadErrors:
    """Errors of the customers' powers, and factor on the stated noise of the meters.

    Attributes
    ----------
    p, q
        Standard deviations in the unit of the `Field`.
    time_s
        Correlation time, s.
    white
        Factor on the standard deviation of the meters' noise.
    std : (4,)
        Standard errors of the logarithms of ``p, q, time_s, white``, see `learn`.
    """

    p: float
    q: float
    time_s: float
    white: float
    std: Floats

    def covariance(self, field: Field) -> Floats:
        """S, (p, p)."""
        return np.asarray(self.p**2 * field.active + self.q**2 * field.reactive + field.known)


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """Whitening filter of T frames, computed once and applied to any number of columns.

    Attributes
    ----------
    modes : (p, m)
        L with ``S = L L^T``.
    decay : (T,)
        Autocorrelation of the modes from each frame to the next.
    inverse : (T, p, p)
        Inverse Cholesky factor of the innovations' covariance; rows and columns of missing readings are 0.
    gain : (T, m, p)
        Kalman gain.
    log_det
        Logarithm of the determinant of the readings' covariance.
    """

    modes: Floats
    decay: Floats
    inverse: Floats
    gain: Floats
    log_det: float

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

    Parameters
    ----------
    t : (T,)
        Times of the frames, s, ascending.
    seen : (T, p)
        True where there is a reading.
    S : (p, p)
        Covariance of the field, squared pu^2.
    time_s
        Its correlation time, s.
    white : (T, p)
        Variance of each reading's own noise.
    common : (T, p, f)
        Common errors of a frame's readings, one column each, in standard deviations: the noise of the
        busbar's f voltages.
    gaps : T times (p, g)
        Effects of unknown powers of single frames, one column each, in standard deviations.
    """
    L = _modes(S, white.mean(axis=0))
    p, m = L.shape
    decay = np.append(np.exp(-np.diff(t) / time_s), 0.0)
    inverse, gain = np.zeros((t.size, p, p)), np.zeros((t.size, m, p))
    P, log_det = np.eye(m), 0.0
    for k in range(t.size):
        rows = np.flatnonzero(seen[k])
        if rows.size:
            own, extra = L[rows], np.hstack([common[k], gaps[k]])[rows]
            cross = P @ own.T
            covariance = own @ cross + extra @ extra.T
            covariance[np.diag_indices_from(covariance)] += white[k, rows]
            C = np.linalg.cholesky(covariance)
            half = solve_triangular(C, np.eye(rows.size), lower=True)
            inverse[k][np.ix_(rows, rows)] = half
            K = cross @ half.T @ half
            gain[k][:, rows] = K
            P = P - K @ cross.T
            P = 0.5 * (P + P.T)
            log_det += 2.0 * float(np.log(C.diagonal()).sum())
        P = decay[k] ** 2 * P + (1.0 - decay[k] ** 2) * np.eye(m)
    return Whitening(L, decay, inverse, gain, log_det)


def _modes(S: Floats, white: Floats) -> Floats:
    """L with ``L L^T = S`` up to modes below the noise."""
    scale = np.sqrt(white)
    values, vectors = np.linalg.eigh(S / np.outer(scale, scale))
    kept = values > _FAINT
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """Sums of products of increments over some lags, by blocks of time. B blocks, H lags.

    Attributes
    ----------
    dt : (H,)
        The lags, s.
    total : (B, H, p, p)
        Sums of products of increments.
    count : (B, H, p, p)
        Numbers of products.
    """

    dt: Floats
    total: Floats
    count: Floats


def increments(t: Floats, seen: Bools, residual: Floats) -> Increments:
    """Products of increments of residuals, free of constants in time.

    Parameters
    ----------
    t : (T,)
        Times, s.
    seen : (T, p)
        True where there is a reading.
    residual : (T, p)
        Readings minus model, squared pu.
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

    Parameters
    ----------
    white : (p,)
        Stated variance of the meters' noise, squared pu^2.
    common : (p, p)
        Covariance of the busbar noise's effect at the meters, squared pu^2.
    guess
        Centre of the prior.
    errors
        Compute standard errors.
    start
        Initial value of the search; by default `guess`.
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
