"""Removal and addition of several meters at once: one update of the rank of their number.

With Q the precision of trusted meters T, D the removed ones and K = T without D,

    Q' = Q_KK - Q_KD Q_DD^-1 Q_DK,

and the chi-square falls by ``b^T Q_DD^-1 b`` with ``b = Q_D: m``, whatever m is at D. With added meters A,
``X = Q S_TA``, and L the Cholesky factor of ``S_AA + D_AA - S_AT X`` in the order of addition,

    Q' = Q + F^T F,   F = L^-1 [-X^T  I].

Every row of F is one of the rank-one updates of `add_meter`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, lapack

from gridsec.arrays import Bools, Floats, Ints, indices, submatrix
from gridsec.estimators.sequential.conditional import MAX_NOISE_RATIO, Posterior, Prior, condition, solve_spd

_ROWS = 256
"""Rows of one block of a product."""
_COLUMN_COST = 8
"""Cost of selecting a column of a matrix, in rows of a product with it."""
_LEAST_NOISE = 1e-6
"""Least ratio of noise to the largest prior variance for block updates; below it rounding dominates."""


def well_conditioned(prior: Prior, noise: Floats) -> bool:
    """True if rounding leaves block updates as exact as a factorisation."""
    return bool(noise.min(initial=np.inf) >= _LEAST_NOISE * prior.variance.max(initial=0.0))


def remove_meters(now: Posterior, removed: Bools) -> Posterior:
    """Posterior without meters `removed` (p,), k of them trusted; O(p^2 k). The given one is not changed."""
    at, Q = now.precision()
    gone, stay = indices(removed[at]), indices(~removed[at])
    if not gone.size:
        return now.copy()
    if not stay.size:
        empty = condition(now.prior, now.noise, np.zeros_like(now.trusted), now.unknowns)
        empty.updates = now.updates + gone.size
        return empty
    factor = _cholesky(submatrix(Q, gone, gone).T)
    # Symmetric: the transpose is the same in the order of LAPACK.
    half, _ = lapack.dtrtrs(factor, submatrix(Q, stay, gone).T, lower=True, overwrite_b=True)
    inverse = submatrix(Q, stay, stay)
    inverse = blas.dgemm(-1.0, half, half, beta=1.0, c=inverse.T, trans_a=True, overwrite_c=True).T
    variance = _released_variance(now, at, Q, gone, factor)
    buses = now.prior.meters[at[stay]]
    # At the meters themselves ``S_TT Q = I - D Q`` replaces a sum.
    variance[buses] = now.variance[buses] + now.noise[at[stay]] ** 2 * np.einsum("ij,ij->j", half, half)
    trusted = now.trusted & ~removed
    return Posterior(now.prior, now.noise, trusted, inverse, variance, now.unknowns, now.updates + gone.size)


def _cholesky(matrix: Floats) -> Floats:
    """Cholesky factor, lower triangle; `matrix` is in the order of LAPACK, and lost."""
    factor, failed = lapack.dpotrf(matrix, lower=True, clean=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray(factor)


def _released_variance(now: Posterior, at: Ints, Q: Floats, gone: Ints, factor: Floats) -> Floats:
    """Variance at every bus without some trusted meters, except at the buses of the remaining ones."""
    which, prior, out = at[gone], now.prior, now.variance.copy()
    noise, buses, left = now.noise[which], prior.meters[which], np.ones(out.size, dtype=np.bool_)
    # The posterior variance of a reading is its noise plus the variance at its bus.
    upper, _ = lapack.dtrtri(factor, lower=True)
    good = noise < MAX_NOISE_RATIO * prior.variance[buses]
    own = np.einsum("ij,ij->j", upper, upper) - noise
    out[buses[good]] = np.maximum(out[buses], own)[good]
    left[prior.meters[at]] = False
    left[buses[~good]] = True
    # Where two meters share a bus, one of low noise is enough.
    left[buses[good]] = False
    rows = indices(left)
    for first in range(0, rows.size, _ROWS):
        some = rows[first : first + _ROWS]
        between = submatrix(prior.covariance, some, at)
        if now.unknowns.shape[1]:
            between += now.unknowns[some] @ now.unknowns[prior.meters[at]].T
        # A product with all of Q costs less than picking most of it.
        whole = some.size * _COLUMN_COST < gone.size
        known = (between @ Q).take(gone, axis=1) if whole else between @ Q.take(gone, axis=1)
        part, _ = lapack.dtrtrs(factor, known.T, lower=True)
        out[some] += np.einsum("ij,ij->j", part, part)
    return out


def chi_square_without(whole: Posterior, m: Floats, removed: Bools) -> float:
    """``m^T Q m`` without meters `removed` (p,), k of them; O(p^2 + k^3). m: anything at these."""
    gone = indices(removed & whole.trusted)
    m = np.where(whole.trusted & ~removed, m, 0.0)
    weights = whole.weights(m)
    left = float(m @ weights)
    if not gone.size:
        return left
    at = gone if len(whole.inverse) == m.size else np.searchsorted(indices(whole.trusted), gone)
    b = weights[gone]
    return left - float(b @ solve_spd(submatrix(whole.inverse, at, at).T, b))


@dataclass(frozen=True, slots=True, eq=False)
class ExcludedMeters:
    """Excluded meters beside a posterior. n buses, t trusted and k excluded meters."""

    fit: Posterior  # posterior of the trusted meters
    at: Ints  # (k,) excluded meters
    columns: Floats  # (n, k) prior covariance of every bus with them
    explained: Floats  # (t, k) Q S_TA
    open: Floats  # (k, k) posterior covariance at their buses
    apart: Floats  # (k, k) posterior covariance of their readings

    @staticmethod
    def of(now: Posterior, at: Ints) -> ExcludedMeters:
        """Excluded meters `at` (k,) of a posterior; O(p^2 k)."""
        prior, (which, Q) = now.prior, now.precision()
        columns = prior.covariance.take(at, axis=1)
        if now.unknowns.shape[1]:
            columns += now.unknowns @ now.unknowns[prior.meters[at]].T
        inside = columns[prior.meters[which]]
        seen = Q @ inside
        left = columns[prior.meters[at]] - inside.T @ seen
        apart = left.copy()
        apart[np.diag_indices(at.size)] += now.noise[at]
        return ExcludedMeters(now, at, columns, seen, left, apart)

    def factor(self, order: Ints) -> Floats:
        """Cholesky factor of `apart` in an order (r,) of places in `at`, r > 0, lower triangle, (r, r)."""
        return _cholesky(submatrix(self.apart, order, order).T)

    def changes(self, order: Ints, factor: Floats) -> Floats:
        """F for an order (r,) and its factor: the rank-one updates, each as its square, (r, p)."""
        out = np.zeros((order.size, self.fit.noise.size))
        out[:, self.fit.trusted] = -self.explained.take(order, axis=1).T
        out[np.arange(order.size), self.at[order]] = 1.0
        return np.asarray(lapack.dtrtrs(factor, out, lower=True)[0])

    def add(self, order: Ints, factor: Floats, changes: Floats) -> None:
        """Add meters `order`, the first ones of `factor` and `changes`; O(p^2 r). Not usable afterwards."""
        now, r = self.fit, order.size
        spread, _ = lapack.dtrtrs(factor[:r, :r], self._open(order).T, lower=True)
        some = changes[:r]
        # In place: Q is symmetric, and its transpose in the order of BLAS.
        now.inverse = blas.dgemm(1.0, some, some, beta=1.0, c=now.Q.T, trans_a=True, overwrite_c=True).T
        now.variance = np.maximum(now.variance - np.einsum("ij,ij->j", spread, spread), 0.0)
        now.trusted[self.at[order]] = True
        now.updates += r
        now.pivot = now.std = now.busbar_weights = now.variance_sum = None

    def _open(self, order: Ints) -> Floats:
        """Posterior covariance between every bus and excluded meters `order`, (n, r)."""
        now, prior, r = self.fit, self.fit.prior, order.size
        which, seen = indices(now.trusted), self.explained.take(order, axis=1)
        out, left = np.empty((now.variance.size, r)), np.ones(now.variance.size, dtype=np.bool_)
        # At the meters it is known, or ``S_TT Q = I - D Q`` replaces a sum.
        out[prior.meters[self.at]] = self.open.take(order, axis=1)
        out[prior.meters[which]] = now.noise[which, None] * seen
        left[prior.meters[self.at]] = left[prior.meters[which]] = False
        rows = indices(left)
        between = submatrix(prior.covariance, rows, which)
        if now.unknowns.shape[1]:
            between += now.unknowns[rows] @ now.unknowns[prior.meters[which]].T
        out[rows] = self.columns[np.ix_(rows, order)] - between @ seen
        return out
