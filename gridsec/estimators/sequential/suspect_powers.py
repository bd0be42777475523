"""Posterior in which the powers reported by suspects are doubted.

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

Posterior without the readings of meters that withhold their customer's power.

A voltage reading beside an unread power has no check of its own: each error within the load's range is a
load. With w and M of all trusted meters, and w', M' of the vouched ones, the variance at every bus is

    M' + (w - w')^2

about w. It covers the truth if the other readings are false, and is M' plus little if they are true
(docs/theory-sequential.md, section 7).

References
----------
Sherman, Morrison and Woodbury's identity; Mitchell and Beauchamp 1988 (spike and slab). Each customer is
tested as if all other powers were true, and the mixture is replaced by the normal distribution of the same
variance. docs/theory-sequential.md, section 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack
from scipy.special import expit

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices, submatrix
from gridsec.estimators.sequential.error_bounds import FALSE_Q
from gridsec.estimators.sequential.fault_dictionary import Sensitivities
from gridsec.estimators.sequential.posterior import (
    LeaveOneOut,
    Posterior,
    condition,
    leave_one_out,
    remove_meters,
    well_conditioned,
)
from gridsec.grid.network import Power


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


_ROWS = 256
"""Rows of one block of a product."""


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
