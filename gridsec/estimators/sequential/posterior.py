"""Prior and posterior of the voltages given trusted meters: Gaussian conditioning, one meter at a time.

Errors dp, dq of all customers move all voltages by ``2 R dp + 2 X dq``, neighbours nearly alike. This
correlation makes a manipulated meter visible among its neighbours (docs/theory-sequential.md, section 1).

The unknown part of the buses' squared voltages is w ~ N(0, S) with S from `voltage_prior`; a meter at bus b
reads ``m = w_b + e``, ``e ~ N(0, d)``. For trusted meters T

    Q = (S_TT + D_TT)^-1                      precision of the readings, zero elsewhere
    w_hat = S_:T Q m_T                        posterior mean
    M = S - S_:T Q S_T:                       posterior covariance

Each meter is tested by the others: the leave-one-out residual of a trusted meter is ``(Q m)_j / Q_jj`` with
variance ``1 / Q_jj``, that of any other meter ``m_j - w_hat_j`` with variance ``M_jj + d_j``. Removing or
adding a meter changes Q by a matrix of rank one: O(p^2), no factorisation.

Several meters change at once by one update of the rank of their number. With D the removed ones and K = T
without D,

    Q' = Q_KK - Q_KD Q_DD^-1 Q_DK,

and the chi-square falls by ``b^T Q_DD^-1 b`` with ``b = Q_D: m``, whatever m is at D. With added meters A,
``X = Q S_TA``, and L the Cholesky factor of ``S_AA + D_AA - S_AT X`` in the order of addition,

    Q' = Q + F^T F,   F = L^-1 [-X^T  I].

Every row of F is one of the rank-one updates of `add_meter`.

A suspect meter may report false powers: the active power of customer k is uniformly false within the size of
its fault, the reactive power within half of that, with prior odds of one. With a the column of 2R times the
standard deviation of a false power, the trusted meters give the Bayes factor

    log B_k = (a_T^T Q m)^2 / (2 (1 + a_T^T Q a_T)) - log(1 + a_T^T Q a_T) / 2,

and the variance of k's false power is that of a false one times ``B_k / (1 + B_k)``. A power that no trusted
meter feels stays doubted; one that many feel without a contradiction is used again. With U the columns of 2R
and 2X of all these customers, each times its standard deviation, the prior covariance is ``S + U U^T``, hence

    C = U - S_:T Q U_T,   G = I + U_T^T Q U_T,
    w' = w + C G^-1 U_T^T Q m,   M' = M + C G^-1 C^T.

At the buses of trusted meters, with variances D of the readings, ``S_TT Q = I - D Q`` gives ``C = D Q U_T``.

A voltage reading beside an unread power has no check of its own: each error within the load's range is a
load. With w and M of all trusted meters, and w', M' of the vouched ones, the variance at every bus is

    M' + (w - w')^2

about w. It covers the truth if the other readings are false, and is M' plus little if they are true
(docs/theory-sequential.md, section 7).

References
----------
Dubrule 1983 (leave-one-out by one inverse), the Schur complement otherwise; Sherman, Morrison and Woodbury's
identity; Mitchell and Beauchamp 1988 (spike and slab). Each customer is tested as if all other powers were
true, and the mixture is replaced by the normal distribution of the same variance. docs/theory-sequential.md,
section 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from scipy.linalg import blas, lapack
from scipy.special import expit

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices, submatrix
from gridsec.estimators.front.posterior import LoadDoubt
from gridsec.grid.devices import Droop, MeterAccuracy
from gridsec.grid.network import Network, Power, Sensitivities


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Covariance of the voltages without any meter. n buses, p meters."""

    covariance: Floats  # (n, p) between every bus's squared voltage and those at the meters, squared pu^2
    meters: Ints  # (p,) bus of each meter
    variance: Floats  # (n,) variance at every bus
    total: float = field(init=False)  # derived: its sum

    def __post_init__(self) -> None:
        object.__setattr__(self, "total", float(self.variance.sum()))

    @property
    def between(self) -> Floats:
        """Covariance between the meters' buses, (p, p)."""
        return np.asarray(self.covariance[self.meters])

    def with_direction(self, direction: Floats) -> Prior:
        """Prior with one more unknown direction d (n,), times its standard deviation: ``S + d d^T``."""
        open_ = self.covariance + np.multiply.outer(direction, direction[self.meters])
        return Prior(open_, self.meters, self.variance + direction**2)

    def among(self, at: Ints) -> Floats:
        """Covariance between the buses of meters `at` (k,), (k, k), in the order of LAPACK."""
        # Symmetric: the transpose is the same in the order of LAPACK.
        return submatrix(self.covariance, self.meters[at], at).T


@dataclass(slots=True, eq=False)
class Posterior:
    """Posterior given trusted meters, changed in place by `remove_meter`, `add_meter` and `add_unknown`."""

    prior: Prior  # prior of the voltages
    noise: Floats  # (p,) variance d of each reading
    trusted: Bools  # (p,) meters conditioned on
    inverse: Floats  # (t, t), or (p, p) with zeros elsewhere: precision of the trusted meters
    variance: Floats  # (n,) diagonal of M
    unknowns: Floats  # (n, k) directions of unknown amplitude, times its standard deviation
    updates: int = 0  # rank-one updates since the last factorisation
    pivot: Floats | None = None  # (p,) diagonal of Q, 1 where not trusted; None until computed
    std: Floats | None = None  # (p,) standard deviations of the residuals; None until computed
    busbar_weights: Floats | None = (
        None  # (b,) sums of Q between meters of one busbar phase; None until computed
    )
    variance_sum: float | None = None  # sum of `variance`; None until computed
    score_rows: Floats | None = (
        None  # (k, p) ``R_k / sqrt(R_k' Q R_k)`` of customers' powers; None until computed
    )

    @property
    def Q(self) -> Floats:  # noqa: N802  # its name in the theory
        """Precision of the trusted meters, zero elsewhere, (p, p)."""
        if len(self.inverse) == self.noise.size:
            return self.inverse
        at, size = indices(self.trusted), self.noise.size
        rows, out = np.zeros((at.size, size)), np.zeros((size, size))
        # Columns, then rows: far faster than both at once.
        rows[:, at] = self.inverse
        out[at] = rows
        return out

    def precision(self) -> tuple[Ints, Floats]:
        """Trusted meters, (t,), and their precision, (t, t)."""
        at = indices(self.trusted)
        return at, self.inverse if len(self.inverse) == at.size else submatrix(self.inverse, at, at)

    @property
    def count(self) -> int:
        """Number of trusted meters."""
        return int(np.count_nonzero(self.trusted))

    def total_variance(self) -> float:
        """Sum of the posterior variances of all buses."""
        if self.variance_sum is None:
            self.variance_sum = float(self.variance.sum())
        return self.variance_sum

    def weights(self, m: Floats) -> Floats:
        """Q m, (p,)."""
        if len(self.inverse) == self.noise.size:
            return np.asarray(self.inverse @ m)
        out = np.zeros(self.noise.size)
        out[self.trusted] = self.inverse @ m[self.trusted]
        return out

    def diagonal(self) -> Floats:
        """Diagonal of Q, (p,)."""
        if len(self.inverse) == self.noise.size:
            return self.inverse.diagonal()
        out = np.zeros(self.noise.size)
        out[self.trusted] = self.inverse.diagonal()
        return out

    def compact(self) -> None:
        """Remove the zeros of untrusted meters where that makes the matrix much smaller."""
        at = indices(self.trusted)
        if at.size**2 < _COMPACT_PART * len(self.inverse) ** 2:
            self.inverse = submatrix(self.inverse, at, at)

    def copy(self) -> Posterior:
        """Copy that can be changed alone."""
        return Posterior(
            self.prior,
            self.noise,
            self.trusted.copy(),
            self.inverse.copy(),
            self.variance.copy(),
            self.unknowns,
            self.updates,
            self.pivot,
            self.std,
            self.busbar_weights,
            self.variance_sum,
            self.score_rows,
        )


_COMPACT_PART = 0.8
"""Largest part of the entries for which the smaller matrix is made."""


@dataclass(frozen=True, slots=True, eq=False)
class LeaveOneOut:
    """Leave-one-out residuals of all meters. n buses, p meters."""

    weights: Floats  # (p,) Q m
    residual: Floats  # (p,) reading minus its prediction by the trusted others, squared pu
    std: Floats  # (p,) its standard deviation for an honest meter
    m: Floats  # (p,) readings minus the model, squared pu
    prior: Prior  # prior of the voltages
    unknowns: Floats  # directions of unknown amplitude
    cached_mean: Floats | None = None  # (n,) posterior mean; None until computed

    @property
    def chi_square(self) -> float:
        """m^T Q m: chi-square with one degree of freedom per trusted meter."""
        return float(self.m @ self.weights)

    @property
    def mean(self) -> Floats:
        """Posterior mean of every bus, (n,)."""
        if self.cached_mean is None:
            object.__setattr__(self, "cached_mean", _mean(self.prior, self.unknowns, self.weights))
        return cast("Floats", self.cached_mean)


def condition(prior: Prior, noise: Floats, trusted: Bools, unknowns: Floats | None = None) -> Posterior:
    """Posterior of a set of trusted meters (p,) by one factorisation; O(p^3).

    noise: (p,) variance of each reading, > 0. unknowns: (n, k) unknown directions, see `add_unknown`.
    """
    more = np.zeros((prior.variance.size, 0)) if unknowns is None else unknowns
    at = indices(trusted)
    inverse = _reading_covariance(prior, noise[at], at, more)
    invert_spd(inverse)
    now = Posterior(prior, noise, trusted.copy(), inverse.T, _prior_variance(prior, more), more)
    _subtract_information(now, at, inverse)
    return now


def chi_square(  # noqa: PLR0917
    prior: Prior,
    noise: Floats,
    m: Floats,
    trusted: Bools,
    unknowns: Floats | None = None,
    alike: Floats | None = None,
) -> float:
    """``m^T Q m`` alone, in a third of the time of `condition`.

    alike: (p, k) common offsets of some meters, times their standard deviations.
    """
    at = indices(trusted)
    if not at.size:
        return 0.0
    more = np.zeros((prior.variance.size, 0)) if unknowns is None else unknowns
    between = _reading_covariance(prior, noise[at], at, more)
    if alike is not None:
        between += alike[at] @ alike[at].T
    return float(m[at] @ solve_spd(between, m[at]))


def solve_spd(matrix: Floats, right: Floats) -> Floats:
    """Solution of a symmetric positive definite system; `matrix` is in the order of LAPACK, and lost."""
    if not right.size:
        return right.copy()
    _, out, failed = lapack.dposv(matrix, right, lower=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray(out)


def _reading_covariance(prior: Prior, noise: Floats, at: Ints, more: Floats) -> Floats:
    """Covariance of the readings of meters `at`, in the order of LAPACK."""
    out = prior.among(at)
    if more.shape[1]:
        out += more[prior.meters[at]] @ more[prior.meters[at]].T
    out[np.diag_indices(at.size)] += noise
    return out


def _prior_variance(prior: Prior, more: Floats) -> Floats:
    return np.asarray(prior.variance + np.einsum("ij,ij->i", more, more))


def _subtract_information(now: Posterior, at: Ints, inverse: Floats) -> None:
    """Reduce the variances by the information of meters `at`, from their precision."""
    buses, noise, before = now.prior.meters[at], now.noise[at], now.variance
    # At a meter's own bus the variance follows from its pivot.
    good = noise < MAX_NOISE_RATIO * before[buses]
    own = noise[good] * (1.0 - noise[good] * inverse.diagonal()[good])
    left = np.ones(before.size, dtype=np.bool_)
    left[buses[good]] = False
    others = indices(left)
    for first in range(0, others.size if at.size else 0, _ROWS):
        some = others[first : first + _ROWS]
        K = submatrix(now.prior.covariance, some, at)
        if now.unknowns.shape[1]:
            K += now.unknowns[some] @ now.unknowns[now.prior.meters[at]].T
        before[some] -= np.einsum("ij,ij->i", K @ inverse, K)
    before[buses[good]] = own
    np.maximum(before, 0.0, out=before)


MAX_NOISE_RATIO = 10.0
"""Ratio of noise to prior variance above which the shortcut at meters' buses loses more than one digit."""


_ROWS = 256
"""Rows of one block of a product."""


_LOWER = np.tri(_ROWS, dtype=np.bool_)


def invert_spd(matrix: Floats) -> None:
    """Invert a symmetric positive definite matrix in LAPACK's (Fortran's) order in place, by Cholesky."""
    if not matrix.size:
        return
    _, failed = lapack.dpotrf(matrix, lower=True, clean=False, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    lapack.dpotri(matrix, lower=True, overwrite_c=True)
    for first in range(0, len(matrix), _ROWS):
        last = first + _ROWS
        corner = matrix[first:last, first:last]
        corner[:] = np.where(_LOWER[: len(corner), : len(corner)], corner, corner.T)
        matrix[first:last, last:] = matrix[last:, first:last].T


def leave_one_out(now: Posterior, m: Floats) -> LeaveOneOut:
    """Leave-one-out residuals of all meters; O(n p). m: (p,) finite everywhere."""
    return _leave_one_out(now, m, now.weights(m), None)


def _leave_one_out(now: Posterior, m: Floats, weights: Floats, w: Floats | None) -> LeaveOneOut:
    trusted, at = now.trusted, now.prior.meters
    if now.pivot is None or now.std is None:
        now.pivot = np.where(trusted, now.diagonal(), 1.0)
        now.std = np.sqrt(np.where(trusted, 1.0 / now.pivot, now.variance[at] + now.noise))
    offset = weights / now.pivot
    # The posterior mean matters for untrusted meters only.
    if not all_of(trusted):
        w = _mean(now.prior, now.unknowns, weights) if w is None else w
        offset = np.where(trusted, offset, m - w[at])
    return LeaveOneOut(weights, offset, now.std, m, now.prior, now.unknowns, w)


def _mean(prior: Prior, unknowns: Floats, weights: Floats) -> Floats:
    """Covariance of all buses' w with a combination of the meters' w, (n,)."""
    out = prior.covariance @ weights
    if unknowns.shape[1]:
        out += unknowns @ (weights @ unknowns[prior.meters])
    return np.asarray(out)


@dataclass(frozen=True, slots=True, eq=False)
class RankOneUpdate:
    """Rank-one update of Q by ``factor q q^T``. n buses, p meters."""

    factor: float  # of the update
    q: Floats  # (p,) direction of the update
    spread: Floats  # (n,) covariance of every bus with q


def remove_meter(now: Posterior, j: int) -> RankOneUpdate:
    """Remove trusted meter j from a posterior in place; O(n p)."""
    now.inverse = now.Q
    q = now.inverse[:, j].copy()
    update = RankOneUpdate(-1.0 / q[j], q, _mean(now.prior, now.unknowns, q))
    _update(now, update)
    now.inverse[j] = now.inverse[:, j] = 0.0
    now.trusted[j] = False
    return update


def add_meter(now: Posterior, j: int) -> RankOneUpdate:
    """Add meter j to a posterior in place; O(n p)."""
    column = _prior_column(now, j)
    now.inverse = now.Q
    q = now.inverse @ column[now.prior.meters]
    open_ = column - _mean(now.prior, now.unknowns, q)
    pivot = max(open_[now.prior.meters[j]], 0.0) + now.noise[j]
    q[j] -= 1.0
    update = RankOneUpdate(1.0 / pivot, q, -open_)
    _update(now, update)
    now.trusted[j] = True
    return update


def add_unknown(now: Posterior, direction: Floats, std: float) -> RankOneUpdate:
    """Add a direction (n,) of unknown amplitude, with its standard deviation, in place; O(n p).

    For example `2 R[:, c]` for the active power of one customer, pu.
    """
    u = std * direction
    now.inverse = now.Q
    q = now.inverse @ u[now.prior.meters]
    pivot = 1.0 + float(u[now.prior.meters] @ q)
    update = RankOneUpdate(-1.0 / pivot, q, _mean(now.prior, now.unknowns, q) - u)
    _update(now, update)
    now.unknowns = np.column_stack([now.unknowns, u])
    return update


def _update(now: Posterior, update: RankOneUpdate) -> None:
    # In place: Q is symmetric, and its transpose in the order of BLAS.
    now.inverse = blas.dger(update.factor, update.q, update.q, a=now.inverse.T, overwrite_a=True).T
    now.variance -= update.factor * update.spread * update.spread
    np.maximum(now.variance, 0.0, out=now.variance)
    now.updates += 1
    now.pivot = now.std = now.busbar_weights = now.variance_sum = now.score_rows = None


def updated(now: Posterior, m: Floats, loo: LeaveOneOut, update: RankOneUpdate) -> LeaveOneOut:
    """Leave-one-out residuals after an update, from those before it; O(n)."""
    amount = update.factor * float(update.q @ m)
    weights = np.where(now.trusted, loo.weights + amount * update.q, 0.0)
    return _leave_one_out(now, m, weights, loo.mean + amount * update.spread)


def _prior_column(now: Posterior, j: int) -> Floats:
    """Prior covariance of all buses with meter j, unknown directions included, (n,)."""
    out = now.prior.covariance[:, j]
    if now.unknowns.shape[1]:
        out = out + now.unknowns @ now.unknowns[now.prior.meters[j]]
    return np.asarray(out)


# --- Several meters at once ---


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
        now.pivot = now.std = now.busbar_weights = now.variance_sum = now.score_rows = None

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


# --- Prior ---


EXACT = 1e-6
"""Least standard deviation of a power, pu."""


UNMETERED = 0.1
"""Standard deviation of an unmetered squared busbar voltage, squared pu."""


def voltage_prior(
    feeder: Network, at: Ints, doubt: LoadDoubt, *, busbar: Floats | float, inverters: Floats | None = None
) -> Prior:
    """Covariance of the buses' squared voltages without any meter.

    ``S = 4 R V_p R^T + 4 X V_q X^T + u u^T + busbar^2 1 1^T`` with ``u = 2 R g s_p + 2 X g s_q``,
    ``g^2 = together``, and for the rest, s being ``sqrt(1 - together) s``,
    ``V = (1 - common) diag(s^2) + common s s^T``. In three phases places stand for buses, and only those of
    one phase share the busbar's error.

    at: (p,) bus of each meter. busbar: standard deviation of its squared voltage, squared pu; one or (3,).
    inverters: (N,) standard deviation of the observed injections, pu.
    """
    alone, together = (np.sqrt(part) for part in (1.0 - doubt.together, doubt.together))
    p, q = alone * doubt.p, alone * doubt.q
    q = q if inverters is None else np.hypot(q, inverters)
    variance = feeder.broadcast_busbar(busbar**2)
    of_meters: Floats = np.repeat(variance[:, None], at.size, axis=1)
    of_meters *= feeder.same_busbar_phase(np.arange(variance.size), at)
    none = np.zeros_like(q)
    for power, std, common, shared in (
        (Power.ACTIVE, p, doubt.common_p, feeder.bus_voltages(p, none, 0.0, steps=0)),
        (Power.REACTIVE, q, doubt.common_q, feeder.bus_voltages(none, q, 0.0, steps=0)),
    ):
        of_meters += feeder.covariance(power, at, (1.0 - common) * std**2)
        variance += feeder.variances(power, (1.0 - common) * std**2)
        if common:
            of_meters += np.multiply.outer(common * shared, shared[at])
            variance += common * shared**2
    if np.any(together):
        shared = feeder.bus_voltages(together * doubt.p, together * doubt.q, 0.0, steps=0)
        of_meters += np.multiply.outer(shared, shared[at])
        variance += shared**2
    return Prior(of_meters, at, variance)


def injection_doubt(droop: Droop, accuracy: MeterAccuracy, meters: Ints, customers: int) -> Floats:
    """Standard deviation of the observed injections by the meters' own errors, (N,) in pu.

    An inverter driven by its meter follows the fixed error of the reading through the steepest part of its
    curve, at most up to saturation.
    """
    error = np.zeros(customers)
    error[meters] = 2.0 * np.sqrt(
        accuracy.class_fraction**2 / 3.0 + accuracy.resolution**2 / 12.0 + accuracy.jitter**2
    )
    own = np.minimum(droop.slope * error[droop.customer], droop.limit)
    return np.asarray(np.sqrt(droop.per_customer(own**2, customers)))


# --- False powers of suspects ---


FALSE_Q = 0.5
"""Largest reactive power per active power of a false report."""


@dataclass(frozen=True, slots=True, eq=False)
class DoubtedPowers:
    """Posterior with doubted powers. n buses, t trusted meters, l suspects."""

    fit: Posterior  # posterior with all powers used
    customers: Ints  # (l,) suspects' customers
    sizes: Floats  # (l,) largest false active powers, pu
    share: Floats  # (l,) used part of the standard deviation of a false power
    effects: Floats  # (t, 2 l) effects of false powers at the trusted meters, active ones first
    gram: Floats  # (2 l, 2 l) U_T^T Q U_T of whole standard deviations
    C: Floats  # (n, 2 l) posterior covariance with such false powers
    factor: Floats  # (2 l, 2 l) Cholesky factor of G for the used parts, lower triangle
    variance: Floats  # (n,) diagonal of M'

    def mean(self, loo: LeaveOneOut) -> Floats:
        """w', (n,)."""
        both = np.tile(self.share, 2)
        along = both * (loo.weights[self.fit.trusted] @ self.effects)
        amount, _ = lapack.dpotrs(self.factor, along, lower=True)
        return np.asarray(loo.mean + self.C @ (both * amount))

    def matches(self, fit: Posterior, customers: Ints, sizes: Floats) -> bool:
        """True if `doubt_powers` would start from the same posterior, customers and sizes."""
        same = fit is self.fit and np.array_equal(customers, self.customers)
        return same and np.array_equal(sizes, self.sizes)

    def is_current(self, loo: LeaveOneOut) -> bool:
        """True if the used parts are close to those of the present residuals."""
        share = _share(self.effects, self.gram, loo.weights[self.fit.trusted])
        return all_of((share <= _MORE * self.share) & (share >= _LESS * self.share))

    def renewed(self, loo: LeaveOneOut) -> DoubtedPowers:
        """The same with the parts of the present residuals."""
        share = _share(self.effects, self.gram, loo.weights[self.fit.trusted])
        factor, variance = _factorised(self.fit, self.gram, self.C, share)
        return replace(self, share=share, factor=factor, variance=variance)


_MORE, _LESS, _LEAST_SHARE = 1.25, 0.5, 0.125
"""Range of parts that are reused, as ratios to the wanted ones, and the least part."""


def doubt_powers(
    sensitivities: Sensitivities, fit: Posterior, customers: Ints, sizes: Floats, loo: LeaveOneOut
) -> DoubtedPowers:
    """Doubt the powers of customers (l,) by at most `sizes` (l,), pu; O(n p l)."""
    prior, (at, inverse), std = fit.prior, fit.precision(), sizes / np.sqrt(3.0)
    U = np.empty((prior.variance.size, 2 * sizes.size))
    U[:, : sizes.size] = sensitivities.columns(Power.ACTIVE, customers) * std
    U[:, sizes.size :] = sensitivities.columns(Power.REACTIVE, customers) * (FALSE_Q * std)
    seen = U[prior.meters[at]]
    known = inverse @ seen
    gram = seen.T @ known
    _conditioned(fit, U, known)
    share = _share(seen, gram, loo.weights[at])
    return DoubtedPowers(fit, customers, sizes, share, seen, gram, U, *_factorised(fit, gram, U, share))


def _factorised(fit: Posterior, gram: Floats, C: Floats, share: Floats) -> tuple[Floats, Floats]:
    """Cholesky factor of G and diagonal of M' for powers false by parts of their sizes."""
    both = np.tile(share, 2)
    G = gram * np.multiply.outer(both, both)
    G[np.diag_indices(both.size)] += 1.0
    # Symmetric: the transpose is the same in the order of LAPACK.
    factor, failed = lapack.dpotrf(G.T, lower=True, clean=False, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    variance = fit.variance.copy()
    for first in range(0, len(C), _ROWS):
        rows = slice(first, first + _ROWS)
        half, _ = lapack.dtrtrs(factor, (C[rows] * both).T, lower=True, overwrite_b=True)
        variance[rows] += np.einsum("ij,ij->j", half, half)
    return factor, variance


def _conditioned(fit: Posterior, U: Floats, known: Floats) -> None:
    """Replace U by C in place, in blocks of rows."""
    prior, at = fit.prior, indices(fit.trusted)
    buses, left = prior.meters[at], np.ones(len(U), dtype=np.bool_)
    left[buses] = False
    others, loose = indices(left), fit.unknowns[buses].T @ known
    for first in range(0, others.size, _ROWS):
        rows = others[first : first + _ROWS]
        U[rows] -= submatrix(prior.covariance, rows, at) @ known + fit.unknowns[rows] @ loose
    U[buses] = fit.noise[at, None] * known


def _share(seen: Floats, gram: Floats, weights: Floats) -> Floats:
    """Root of the probability that each power is false, (l,)."""
    count = len(gram) // 2
    form, along = gram.diagonal()[:count], weights @ seen[:, :count]
    odds = 0.5 * (along**2 / (1.0 + form) - np.log1p(form))
    return np.asarray(np.maximum(np.sqrt(expit(odds)), _LEAST_SHARE))


# --- Withheld powers ---


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
