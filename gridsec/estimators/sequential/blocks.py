"""Many meters dropped or admitted at once: one change of the rank of their number.

Dropping or admitting one meter after the other takes some passes over all matrices for each. With Q the
inverse covariance of trusted meters T, and D those of them that fall,

    Q' = Q_KK - Q_KD Q_DD^-1 Q_DK,        K = T without D,

and what is left unexplained falls by ``b^T Q_DD^-1 b`` with ``b = Q_D: m``, where m may be anything at D.
With A meters that are not trusted, ``X = Q S_TA``, and what is left open of their readings,
``S_AA + D_AA - S_AT X``, of which L is the Cholesky factor in the order in which they are admitted,

    Q' = Q + F^T F,   F = L^-1 [-X^T  I],

and every row of F is one of the changes of rank one by which `conditional.admit` comes to the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, lapack

from gridsec.arrays import Bools, Floats, Ints, indices, submatrix
from gridsec.estimators.sequential.conditional import MUCH_NOISE, Fit, Prior, fit, solved

# Rows that are worked on together.
_ROWS = 256
# A row of a product takes so many times less than picking a column of its factor.
_SEVERAL = 8
# Part of the largest variance that noise must be at least: less, as of exact meters while nobody reads the
# busbar, and what many changes at once take off one another would be lost in rounding.
_LEAST = 1e-6


def sound(prior: Prior, noise: Floats) -> bool:
    """Whether numbers are such that many changes at once come to what one after the other comes to.

    Parameters
    ----------
    prior
        What is known without meters.
    noise : (p,)
        Variance of each meter's reading.
    """
    return bool(noise.min(initial=np.inf) >= _LEAST * prior.variance.max(initial=0.0))


def without(now: Fit, fallen: Bools) -> Fit:
    """A fit of all that another one trusts but for some; O(p^2 k) for k of these.

    Parameters
    ----------
    now
        The other one; not changed.
    fallen : (p,)
        Those it trusts and the new one does not; whom it does not trust counts for nothing.
    """
    at, Q = now.trusting()
    gone, stay = indices(fallen[at]), indices(~fallen[at])
    if not gone.size:
        return now.copy()
    if not stay.size:
        nobody = fit(now.prior, now.noise, np.zeros_like(now.trusted), now.loose)
        nobody.changes = now.changes + gone.size
        return nobody
    factor = _factor(submatrix(Q, gone, gone).T)
    # Symmetric: the transpose is the same in the order of LAPACK.
    half, _ = lapack.dtrtrs(factor, submatrix(Q, stay, gone).T, lower=True, overwrite_b=True)
    inverse = submatrix(Q, stay, stay)
    inverse = blas.dgemm(-1.0, half, half, beta=1.0, c=inverse.T, trans_a=True, overwrite_c=True).T
    variance = _opened(now, at, Q, gone, factor)
    buses = now.prior.meters[at[stay]]
    # Of the meters themselves ``S_TT Q = I - D Q`` leaves nothing to be summed up.
    variance[buses] = now.variance[buses] + now.noise[at[stay]] ** 2 * np.einsum("ij,ij->j", half, half)
    trusted = now.trusted & ~fallen
    return Fit(now.prior, now.noise, trusted, inverse, variance, now.loose, now.changes + gone.size)


def _factor(matrix: Floats) -> Floats:
    """Cholesky factor, lower triangle; `matrix` is in the order of LAPACK, and lost."""
    factor, failed = lapack.dpotrf(matrix, lower=True, clean=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray(factor)


def _opened(now: Fit, at: Ints, Q: Floats, gone: Ints, factor: Floats) -> Floats:
    """Variance at every bus without some of the trusted, but at the buses of those who stay."""
    who, prior, out = at[gone], now.prior, now.variance.copy()
    noise, buses, left = now.noise[who], prior.meters[who], np.ones(out.size, dtype=np.bool_)
    # What the others leave open of a reading is its noise and what they leave open at its bus.
    upper, _ = lapack.dtrtri(factor, lower=True)
    good = noise < MUCH_NOISE * prior.variance[buses]
    own = np.einsum("ij,ij->j", upper, upper) - noise
    out[buses[good]] = np.maximum(out[buses], own)[good]
    left[prior.meters[at]] = False
    left[buses[~good]] = True
    # Where two meters share a bus one good one is enough.
    left[buses[good]] = False
    rows = indices(left)
    for first in range(0, rows.size, _ROWS):
        some = rows[first : first + _ROWS]
        between = submatrix(prior.of_meters, some, at)
        if now.loose.shape[1]:
            between += now.loose[some] @ now.loose[prior.meters[at]].T
        # A product with all of Q costs less than picking most of it.
        whole = some.size * _SEVERAL < gone.size
        known = (between @ Q).take(gone, axis=1) if whole else between @ Q.take(gone, axis=1)
        part, _ = lapack.dtrtrs(factor, known.T, lower=True)
        out[some] += np.einsum("ij,ij->j", part, part)
    return out


def misfit_without(whole: Fit, m: Floats, fallen: Bools) -> float:
    """``m^T Q m`` of those whom a fit trusts but for some; O(p^2 + k^3) for k of these.

    Parameters
    ----------
    whole
        The fit.
    m : (p,)
        As in `conditional.judge`; anything at those that fall.
    fallen : (p,)
        Those it trusts that do not count.
    """
    gone = indices(fallen & whole.trusted)
    m = np.where(whole.trusted & ~fallen, m, 0.0)
    weights = whole.weights(m)
    left = float(m @ weights)
    if not gone.size:
        return left
    at = gone if len(whole.inverse) == m.size else np.searchsorted(indices(whole.trusted), gone)
    b = weights[gone]
    return left - float(b @ solved(submatrix(whole.inverse, at, at).T, b))


@dataclass(frozen=True, slots=True, eq=False)
class Outside:
    """Some meters that are not trusted beside those that are. n buses, p meters, k of them outside.

    Attributes
    ----------
    fit
        The trusted ones.
    at : (k,)
        The others.
    columns : (n, k)
        Prior covariance of every bus with them.
    seen : (t, k)
        Q S_TA: what the trusted ones make of that.
    open : (k, k)
        What these leave open at the buses of the others.
    apart : (k, k)
        And of their readings.
    """

    fit: Fit
    at: Ints
    columns: Floats
    seen: Floats
    open: Floats
    apart: Floats

    @staticmethod
    def of(now: Fit, at: Ints) -> Outside:
        """The same, worked out; O(p^2 k).

        Parameters
        ----------
        now, at
            As above.
        """
        prior, (who, Q) = now.prior, now.trusting()
        columns = prior.of_meters.take(at, axis=1)
        if now.loose.shape[1]:
            columns += now.loose @ now.loose[prior.meters[at]].T
        inside = columns[prior.meters[who]]
        seen = Q @ inside
        left = columns[prior.meters[at]] - inside.T @ seen
        apart = left.copy()
        apart[np.diag_indices(at.size)] += now.noise[at]
        return Outside(now, at, columns, seen, left, apart)

    def factor(self, order: Ints) -> Floats:
        """Cholesky factor of what is open of some of them, in an order, lower triangle, (r, r).

        Parameters
        ----------
        order : (r,)
            Places in `at`, one at least.
        """
        return _factor(submatrix(self.apart, order, order).T)

    def changes(self, order: Ints, factor: Floats) -> Floats:
        """F: what admitting them in an order does to Q one by one, each as its square, (r, p).

        Parameters
        ----------
        order : (r,)
            As in `factor`.
        factor : (r, r)
            From there.
        """
        out = np.zeros((order.size, self.fit.noise.size))
        out[:, self.fit.trusted] = -self.seen.take(order, axis=1).T
        out[np.arange(order.size), self.at[order]] = 1.0
        return np.asarray(lapack.dtrtrs(factor, out, lower=True)[0])

    def admit(self, order: Ints, factor: Floats, changes: Floats) -> None:
        """Trust the first of them from now on; O(p^2 r), and nothing here is true any more.

        Parameters
        ----------
        order : (r,)
            Whom: the first of those that `factor` and `changes` were made for, in that order.
        factor, changes
            From above; what belongs to those that come later counts for nothing.
        """
        now, r = self.fit, order.size
        spread, _ = lapack.dtrtrs(factor[:r, :r], self._open(order).T, lower=True)
        some = changes[:r]
        # In place: Q is symmetric, and its transpose in the order of BLAS.
        now.inverse = blas.dgemm(1.0, some, some, beta=1.0, c=now.Q.T, trans_a=True, overwrite_c=True).T
        now.variance = np.maximum(now.variance - np.einsum("ij,ij->j", spread, spread), 0.0)
        now.trusted[self.at[order]] = True
        now.changes += r
        now.pivot = now.std = now.together = now.left = None

    def _open(self, order: Ints) -> Floats:
        """What the trusted ones leave open between every bus and some of the others, (n, r)."""
        now, prior, r = self.fit, self.fit.prior, order.size
        who, seen = indices(now.trusted), self.seen.take(order, axis=1)
        out, left = np.empty((now.variance.size, r)), np.ones(now.variance.size, dtype=np.bool_)
        # Of the meters themselves it is known, or ``S_TT Q = I - D Q`` leaves nothing to be summed up.
        out[prior.meters[self.at]] = self.open.take(order, axis=1)
        out[prior.meters[who]] = now.noise[who, None] * seen
        left[prior.meters[self.at]] = left[prior.meters[who]] = False
        rows = indices(left)
        between = submatrix(prior.of_meters, rows, who)
        if now.loose.shape[1]:
            between += now.loose[rows] @ now.loose[prior.meters[who]].T
        out[rows] = self.columns[np.ix_(rows, order)] - between @ seen
        return out
