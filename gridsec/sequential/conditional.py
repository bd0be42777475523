"""What trusted meters say about the others: Gaussian conditioning, one meter at a time.

The unknown part of the buses' squared voltages is w ~ N(0, S) with S from `gridsec.sequential.loads`; a
meter at bus b reads ``m = w_b + e``, ``e ~ N(0, d)``. For trusted meters T

    Q = (S_TT + D_TT)^-1                      inverse covariance, zero elsewhere
    w_hat = S_:T Q m_T                        what the trusted meters say about every bus
    M = S - S_:T Q S_T:                       what they leave open

Meter j alone is judged by what the *others* say about it: the leave-one-out residual of a trusted meter is
``(Q m)_j / Q_jj`` with variance ``1 / Q_jj``, that of any other meter ``m_j - w_hat_j`` with variance
``M_jj + d_j``. Dropping or admitting a meter changes Q by a matrix of rank one: O(p^2), no factorisation.

References
----------
Dubrule 1983 (leave-one-out by one inverse), the Schur complement otherwise; docs/theory-sequential.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known without any meter. n buses, p meters.

    Attributes
    ----------
    of_meters : (n, p)
        Covariance between every bus's squared voltage and those of the meters' buses, squared pu^2.
    meters : (p,)
        Bus of each meter.
    variance : (n,)
        Variance at every bus.
    """

    of_meters: Floats
    meters: Ints
    variance: Floats

    @property
    def between(self) -> Floats:
        """Covariance between the meters' buses, (p, p)."""
        return np.asarray(self.of_meters[self.meters])


@dataclass(slots=True, eq=False)
class Fit:
    """Trusted meters and what follows from them. Changed in place by `drop`, `admit`, `loosen`.

    Attributes
    ----------
    prior
        What is known without meters.
    noise : (p,)
        Variance d of each meter's reading.
    trusted : (p,)
        Which meters it rests on.
    Q : (p, p)
        Inverse covariance of the trusted meters; zero elsewhere.
    variance : (n,)
        Diagonal of M: what is left open at every bus.
    loose : (n, k)
        Directions that were loosened, each times the standard deviation it was given.
    changes
        Changes of rank one since the last factorisation.
    """

    prior: Prior
    noise: Floats
    trusted: Bools
    Q: Floats
    variance: Floats
    loose: Floats
    changes: int = 0

    def copy(self) -> Fit:
        """A fit that can be changed without changing this one."""
        return Fit(
            self.prior,
            self.noise,
            self.trusted.copy(),
            self.Q.copy(),
            self.variance.copy(),
            self.loose,
            self.changes,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Every meter judged by the others. n buses, p meters.

    Attributes
    ----------
    weights : (p,)
        Q m.
    offset : (p,)
        Reading minus what the trusted others say, squared pu.
    std : (p,)
        Its standard deviation for an honest meter.
    w : (n,)
        What the trusted meters say about every bus.
    misfit
        m^T Q m, chi-square with as many degrees of freedom as there are trusted meters.
    """

    weights: Floats
    offset: Floats
    std: Floats
    w: Floats
    misfit: float


def fit(prior: Prior, noise: Floats, trusted: Bools, loose: Floats | None = None) -> Fit:
    """Condition on a set of meters at once; O(p^3).

    Parameters
    ----------
    prior
        What is known without meters.
    noise : (p,)
        Variance of each meter's reading, > 0.
    trusted : (p,)
        The set.
    loose : (n, k)
        Additional directions with their standard deviations, see `loosen`.
    """
    p = noise.size
    more = np.zeros((prior.variance.size, 0)) if loose is None else loose
    at = np.flatnonzero(trusted)
    K = prior.of_meters[:, at] + more @ more[prior.meters[at]].T
    Q = np.zeros((p, p))
    variance = prior.variance + np.einsum("ij,ij->i", more, more)
    if at.size:
        inverse = inverted(K[prior.meters[at]] + np.diag(noise[at]))
        Q[np.ix_(at, at)] = inverse
        variance = variance - np.einsum("ij,ij->i", K @ inverse, K)
    return Fit(prior, noise, trusted.copy(), Q, np.maximum(variance, 0.0), more)


def inverted(matrix: Floats) -> Floats:
    """Inverse of a symmetric positive definite matrix, by Cholesky.

    Parameters
    ----------
    matrix : (k, k)
        The matrix.
    """
    factor, failed = lapack.dpotrf(matrix, lower=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    lower, _ = lapack.dpotri(factor, lower=True)
    inverse = lower + lower.T
    inverse[np.diag_indices_from(inverse)] = lower.diagonal()
    return np.asarray(inverse)


def judge(now: Fit, m: Floats) -> Judged:
    """Judge every meter by the trusted others; O(n p).

    Parameters
    ----------
    now
        The trusted meters.
    m : (p,)
        Readings minus what the model explains, squared pu; any finite value where not trusted.
    """
    prior = now.prior
    weights = now.Q @ m
    w = prior.of_meters @ weights
    if now.loose.shape[1]:
        w += now.loose @ (weights @ now.loose[prior.meters])
    diagonal = now.Q.diagonal()
    at = prior.meters
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(now.trusted, weights / diagonal, m - w[at])
        variance = np.where(now.trusted, 1.0 / diagonal, now.variance[at] + now.noise)
    return Judged(weights, offset, np.sqrt(variance), w, float(m @ weights))


def drop(now: Fit, j: int) -> None:
    """Trust meter j no more; O(n p).

    Parameters
    ----------
    now
        Changed in place.
    j
        A trusted meter.
    """
    q = now.Q[:, j].copy()
    pivot = q[j]
    spread = _covariance(now, q)
    now.variance += spread * spread / pivot
    now.Q -= np.multiply.outer(q, q / pivot)
    now.Q[j] = now.Q[:, j] = 0.0
    now.trusted[j] = False
    now.changes += 1


def admit(now: Fit, j: int) -> None:
    """Trust meter j from now on; O(n p).

    Parameters
    ----------
    now
        Changed in place.
    j
        A meter that is not trusted.
    """
    open_ = _left_open(now, j)
    pivot = max(open_[now.prior.meters[j]], 0.0) + now.noise[j]
    v = now.Q @ _column(now, j)[now.prior.meters]
    v[j] -= 1.0
    now.Q += np.multiply.outer(v, v / pivot)
    now.variance -= open_ * open_ / pivot
    np.maximum(now.variance, 0.0, out=now.variance)
    now.trusted[j] = True
    now.changes += 1


def loosen(now: Fit, direction: Floats, std: float) -> None:
    """Let the squared voltages differ in one more direction; O(n p).

    Parameters
    ----------
    now
        Changed in place.
    direction : (n,)
        Change of every squared voltage per unit, for example `2 R[:, c]` for one customer's active power.
    std
        Standard deviation of the amount, pu.
    """
    u = std * direction
    Qu = now.Q @ u[now.prior.meters]
    pivot = 1.0 + float(u[now.prior.meters] @ Qu)
    rest = u - _covariance(now, Qu)
    now.Q -= np.multiply.outer(Qu, Qu / pivot)
    now.variance += rest * rest / pivot
    now.loose = np.column_stack([now.loose, u])
    now.changes += 1


def _covariance(now: Fit, weights: Floats) -> Floats:
    """Covariance of all buses' w with a combination of the meters' w, (n,)."""
    out = now.prior.of_meters @ weights
    if now.loose.shape[1]:
        out += now.loose @ (weights @ now.loose[now.prior.meters])
    return np.asarray(out)


def _column(now: Fit, j: int) -> Floats:
    """Prior covariance of all buses with meter j, loosened directions included, (n,)."""
    out = now.prior.of_meters[:, j]
    if now.loose.shape[1]:
        out = out + now.loose @ now.loose[now.prior.meters[j]]
    return np.asarray(out)


def _left_open(now: Fit, j: int) -> Floats:
    """Column j of M, (n,)."""
    column = _column(now, j)
    return np.asarray(column - _covariance(now, now.Q @ column[now.prior.meters]))
