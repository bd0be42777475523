"""What trusted meters say about the others: Gaussian conditioning, one meter at a time.

The unknown part of the buses' squared voltages is w ~ N(0, S) with S from
`gridsec.estimators.sequential.loads`; a meter at bus b reads ``m = w_b + e``, ``e ~ N(0, d)``. For trusted
meters T

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

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from scipy.linalg import blas, lapack

from gridsec.arrays import Bools, Floats, Ints, all_of, indices, submatrix


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
    total
        Derived. Its sum.
    """

    of_meters: Floats
    meters: Ints
    variance: Floats
    total: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "total", float(self.variance.sum()))

    @property
    def between(self) -> Floats:
        """Covariance between the meters' buses, (p, p)."""
        return np.asarray(self.of_meters[self.meters])

    def wider(self, direction: Floats) -> Prior:
        """The same with one more direction left open: ``S + d d^T``.

        Parameters
        ----------
        direction : (n,)
            d, times the standard deviation of the amount.
        """
        open_ = self.of_meters + np.multiply.outer(direction, direction[self.meters])
        return Prior(open_, self.meters, self.variance + direction**2)

    def among(self, at: Ints) -> Floats:
        """Covariance between the buses of some meters, (k, k), in the order of LAPACK.

        Parameters
        ----------
        at : (k,)
            The meters.
        """
        # Symmetric: the transpose is the same in the order of LAPACK.
        return submatrix(self.of_meters, self.meters[at], at).T


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
    inverse : (t, t) or (p, p)
        Inverse covariance of the trusted meters; where it is that of all meters, zero elsewhere.
    variance : (n,)
        Diagonal of M: what is left open at every bus.
    loose : (n, k)
        Directions that were loosened, each times the standard deviation it was given.
    changes
        Changes of rank one since the last factorisation.
    pivot, std : (p,) or None
        Diagonal of Q, 1 where not trusted, and the standard deviation of each offset; None until asked for.
    together : (b,) or None
        Sum of the entries of Q between meters of one phase of the busbar; None until asked for.
    left
        Sum of `variance`; None until asked for.
    """

    prior: Prior
    noise: Floats
    trusted: Bools
    inverse: Floats
    variance: Floats
    loose: Floats
    changes: int = 0
    pivot: Floats | None = None
    std: Floats | None = None
    together: Floats | None = None
    left: float | None = None

    @property
    def Q(self) -> Floats:  # noqa: N802  # its name in the theory
        """Inverse covariance of the trusted meters, zero elsewhere, (p, p)."""
        if len(self.inverse) == self.noise.size:
            return self.inverse
        at, size = indices(self.trusted), self.noise.size
        rows, out = np.zeros((at.size, size)), np.zeros((size, size))
        # Columns, then rows: far faster than both at once.
        rows[:, at] = self.inverse
        out[at] = rows
        return out

    def trusting(self) -> tuple[Ints, Floats]:
        """The trusted meters, and the inverse covariance of these alone, (t,) and (t, t)."""
        at = indices(self.trusted)
        return at, self.inverse if len(self.inverse) == at.size else submatrix(self.inverse, at, at)

    @property
    def count(self) -> int:
        """Number of trusted meters."""
        return int(np.count_nonzero(self.trusted))

    def total(self) -> float:
        """Sum of what is left open at every bus."""
        if self.left is None:
            self.left = float(self.variance.sum())
        return self.left

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

    def shrink(self) -> None:
        """Keep nothing about meters that are not trusted, where that saves much."""
        at = indices(self.trusted)
        if at.size**2 < _MUCH * len(self.inverse) ** 2:
            self.inverse = submatrix(self.inverse, at, at)

    def copy(self) -> Fit:
        """A fit that can be changed without changing this one."""
        return Fit(
            self.prior,
            self.noise,
            self.trusted.copy(),
            self.inverse.copy(),
            self.variance.copy(),
            self.loose,
            self.changes,
            self.pivot,
            self.std,
            self.together,
            self.left,
        )


# Part that a smaller matrix must have at most.
_MUCH = 0.8


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
    m : (p,)
        The readings that were judged, minus what the model explains, squared pu.
    prior, loose
        What is known without meters, and the directions that were loosened, as in the fit.
    said : (n,) or None
        `w`; None until asked for.
    """

    weights: Floats
    offset: Floats
    std: Floats
    m: Floats
    prior: Prior
    loose: Floats
    said: Floats | None = None

    @property
    def misfit(self) -> float:
        """m^T Q m, chi-square with as many degrees of freedom as there are trusted meters."""
        return float(self.m @ self.weights)

    @property
    def w(self) -> Floats:
        """What the trusted meters say about every bus, (n,)."""
        if self.said is None:
            object.__setattr__(self, "said", _said(self.prior, self.loose, self.weights))
        return cast("Floats", self.said)


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
    more = np.zeros((prior.variance.size, 0)) if loose is None else loose
    at = indices(trusted)
    inverse = _between(prior, noise[at], at, more)
    invert(inverse)
    now = Fit(prior, noise, trusted.copy(), inverse.T, _whole(prior, more), more)
    _narrow(now, at, inverse)
    return now


def misfit(  # noqa: PLR0917  # as `fit`, and what is asked
    prior: Prior,
    noise: Floats,
    m: Floats,
    trusted: Bools,
    loose: Floats | None = None,
    alike: Floats | None = None,
) -> float:
    """``m^T Q m`` alone, in a third of the time of `fit`.

    Parameters
    ----------
    prior, noise, trusted, loose
        As in `fit`.
    m : (p,)
        As in `judge`.
    alike : (p, k)
        Amounts by which some meters are off together, each times its standard deviation.
    """
    at = indices(trusted)
    if not at.size:
        return 0.0
    more = np.zeros((prior.variance.size, 0)) if loose is None else loose
    between = _between(prior, noise[at], at, more)
    if alike is not None:
        between += alike[at] @ alike[at].T
    return float(m[at] @ solved(between, m[at]))


def solved(matrix: Floats, right: Floats) -> Floats:
    """Solution of a symmetric positive definite system.

    Parameters
    ----------
    matrix : (k, k)
        In the order of LAPACK (Fortran's); lost.
    right : (k,)
        Right-hand side.
    """
    if not right.size:
        return right.copy()
    _, out, failed = lapack.dposv(matrix, right, lower=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray(out)


def _between(prior: Prior, noise: Floats, at: Ints, more: Floats) -> Floats:
    """Covariance of the readings of meters `at`, in the order of LAPACK."""
    out = prior.among(at)
    if more.shape[1]:
        out += more[prior.meters[at]] @ more[prior.meters[at]].T
    out[np.diag_indices(at.size)] += noise
    return out


def _whole(prior: Prior, more: Floats) -> Floats:
    return np.asarray(prior.variance + np.einsum("ij,ij->i", more, more))


def _narrow(now: Fit, at: Ints, inverse: Floats) -> None:
    """Take off the variances what meters `at` know, with their inverse covariance."""
    buses, noise, before = now.prior.meters[at], now.noise[at], now.variance
    # What a meter knows of its own bus follows from what it leaves open of its reading.
    good = noise < MUCH_NOISE * before[buses]
    own = noise[good] * (1.0 - noise[good] * inverse.diagonal()[good])
    left = np.ones(before.size, dtype=np.bool_)
    left[buses[good]] = False
    others = indices(left)
    for first in range(0, others.size if at.size else 0, _ROWS):
        some = others[first : first + _ROWS]
        K = submatrix(now.prior.of_meters, some, at)
        if now.loose.shape[1]:
            K += now.loose[some] @ now.loose[now.prior.meters[at]].T
        before[some] -= np.einsum("ij,ij->i", K @ inverse, K)
    before[buses[good]] = own
    np.maximum(before, 0.0, out=before)


# Unless its noise is so many times as large: rounding would take more than a digit off what it leaves open.
MUCH_NOISE = 10.0
# Rows that are worked on together, and where such a block has its lower triangle.
_ROWS = 256
_LOWER = np.tri(_ROWS, dtype=np.bool_)


def invert(matrix: Floats) -> None:
    """Invert a symmetric positive definite matrix in place, by Cholesky.

    Parameters
    ----------
    matrix : (k, k)
        In the order of LAPACK (Fortran's).
    """
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


def judge(now: Fit, m: Floats) -> Judged:
    """Judge every meter by the trusted others; O(n p).

    Parameters
    ----------
    now
        The trusted meters.
    m : (p,)
        Readings minus what the model explains, squared pu; any finite value where not trusted.
    """
    return _judged(now, m, now.weights(m), None)


def _judged(now: Fit, m: Floats, weights: Floats, w: Floats | None) -> Judged:
    trusted, at = now.trusted, now.prior.meters
    if now.pivot is None or now.std is None:
        now.pivot = np.where(trusted, now.diagonal(), 1.0)
        now.std = np.sqrt(np.where(trusted, 1.0 / now.pivot, now.variance[at] + now.noise))
    offset = weights / now.pivot
    # What the meters say of the buses matters for the others only.
    if not all_of(trusted):
        w = _said(now.prior, now.loose, weights) if w is None else w
        offset = np.where(trusted, offset, m - w[at])
    return Judged(weights, offset, now.std, m, now.prior, now.loose, w)


def _said(prior: Prior, loose: Floats, weights: Floats) -> Floats:
    """Covariance of all buses' w with a combination of the meters' w, (n,)."""
    out = prior.of_meters @ weights
    if loose.shape[1]:
        out += loose @ (weights @ loose[prior.meters])
    return np.asarray(out)


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A change of rank one: Q has gained ``factor q q^T``. n buses, p meters.

    Attributes
    ----------
    factor, q : (p,)
        The change.
    spread : (n,)
        What weights q say about every bus.
    """

    factor: float
    q: Floats
    spread: Floats


def drop(now: Fit, j: int) -> Move:
    """Trust meter j no more; O(n p).

    Parameters
    ----------
    now
        Changed in place.
    j
        A trusted meter.
    """
    now.inverse = now.Q
    q = now.inverse[:, j].copy()
    move = Move(-1.0 / q[j], q, _said(now.prior, now.loose, q))
    _change(now, move)
    now.inverse[j] = now.inverse[:, j] = 0.0
    now.trusted[j] = False
    return move


def admit(now: Fit, j: int) -> Move:
    """Trust meter j from now on; O(n p).

    Parameters
    ----------
    now
        Changed in place.
    j
        A meter that is not trusted.
    """
    column = _column(now, j)
    now.inverse = now.Q
    q = now.inverse @ column[now.prior.meters]
    open_ = column - _said(now.prior, now.loose, q)
    pivot = max(open_[now.prior.meters[j]], 0.0) + now.noise[j]
    q[j] -= 1.0
    move = Move(1.0 / pivot, q, -open_)
    _change(now, move)
    now.trusted[j] = True
    return move


def loosen(now: Fit, direction: Floats, std: float) -> Move:
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
    now.inverse = now.Q
    q = now.inverse @ u[now.prior.meters]
    pivot = 1.0 + float(u[now.prior.meters] @ q)
    move = Move(-1.0 / pivot, q, _said(now.prior, now.loose, q) - u)
    _change(now, move)
    now.loose = np.column_stack([now.loose, u])
    return move


def _change(now: Fit, move: Move) -> None:
    # In place: Q is symmetric, and its transpose in the order of BLAS.
    now.inverse = blas.dger(move.factor, move.q, move.q, a=now.inverse.T, overwrite_a=True).T
    now.variance -= move.factor * move.spread * move.spread
    np.maximum(now.variance, 0.0, out=now.variance)
    now.changes += 1
    now.pivot = now.std = now.together = now.left = None


def follow(now: Fit, m: Floats, judged: Judged, move: Move) -> Judged:
    """Judge anew after a move; O(n).

    Parameters
    ----------
    now
        After the move.
    m : (p,)
        As in `judge`.
    judged, move
        What was judged before the move, and the move.
    """
    amount = move.factor * float(move.q @ m)
    weights = np.where(now.trusted, judged.weights + amount * move.q, 0.0)
    return _judged(now, m, weights, judged.w + amount * move.spread)


def _column(now: Fit, j: int) -> Floats:
    """Prior covariance of all buses with meter j, loosened directions included, (n,)."""
    out = now.prior.of_meters[:, j]
    if now.loose.shape[1]:
        out = out + now.loose @ now.loose[now.prior.meters[j]]
    return np.asarray(out)
