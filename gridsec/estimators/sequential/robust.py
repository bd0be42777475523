"""Robust start of a search, independent of the meters trusted before.

With the readings m, their variances d and the prior covariance S,

    minimise   w^T S^-1 w + sum_j min((m_j - w_j)^2, bound_j^2) / d_j

by graduated non-convexity, from a convex cost to the truncated one. Every round conditions with the variance
d_j / weight_j of meter j; its residual ``r = m - w_hat`` is ``D W^-1 (S + D W^-1)^-1 m`` for positive
weights. With the precision Q of all meters and a = Q m, only the meters K of weights below one are solved:

    r = D (a - Q_:K z) + E_K z,   z = (diag(weight / (d (1 - weight)))_K + Q_KK)^-1 a_K,

which holds for a weight of zero as well, where r_j is z_j alone.

References
----------
Yang, Antonante, Tzoumas and Carlone 2020 (graduated non-convexity, truncated least squares); Woodbury's
identity.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices, submatrix
from gridsec.estimators.sequential.conditional import Posterior, Prior, solve_spd

_HARDENING = 2.5
"""Factor on the hardness of the cost from round to round."""
_ROBUST_ROUNDS = 30
"""Largest number of rounds."""
_LEAST_WEIGHT = 1e-6
"""Weights up to this count as zero, well above the rounding of Cholesky."""
_TINY = float(np.finfo(np.float64).tiny)


def robust_set(  # noqa: PLR0917
    prior: Prior, noise: Floats, m: Floats, available: Bools, bound: Floats, whole: Posterior | None = None
) -> Bools:
    """Trusted meters of a robust fit, (p,); O(p^3).

    available: (p,) meters with a reading. bound: (p,) largest honest difference between reading and truth,
    squared pu. whole: a posterior that `covers` these meters, if there is one; the cube is then that of the
    number of meters with weights below one.
    """
    at = indices(available)
    trusted = np.zeros(m.size, dtype=np.bool_)
    if not at.size:
        return trusted
    limit = bound[at] ** 2
    left: Callable[[Floats], Floats]
    left = (
        partial(_weighted_residual, prior.among(at), noise[at], m[at])
        if whole is None
        else _residual_by_posterior(whole, m, at)
    )
    rest = left(np.ones(at.size))
    largest = float((rest * rest / limit).max())
    if largest <= 1.0:
        trusted[at] = True
        return trusted
    hardness = 1.0 / (2.0 * largest - 1.0)
    for _ in range(_ROBUST_ROUNDS):
        ratio = np.maximum(rest * rest / limit, _TINY)
        soft = np.sqrt(hardness * (hardness + 1.0) / ratio) - hardness
        weight = np.minimum(np.maximum(soft, 0.0), 1.0)
        rest = left(weight)
        if all_of((weight == 0.0) | (weight == 1.0)):
            break
        hardness *= _HARDENING
    trusted[at] = rest * rest <= limit
    return trusted


def covers(whole: Posterior, prior: Prior, noise: Floats, available: Bools) -> bool:
    """True if a posterior gives the residuals of meters `available` (p,) for all weights."""
    # A start must not depend on the rounding of earlier rank-one updates.
    fresh = not whole.updates and not whole.unknowns.shape[1]
    same = fresh and whole.prior is prior and np.array_equal(whole.noise, noise)
    return same and not any_of(available & ~whole.trusted)


def _weighted_residual(signal: Floats, noise: Floats, y: Floats, weight: Floats) -> Floats:
    """``y - w_hat`` of meters with covariance `signal`, their noise, and weights in the fit from 0 to 1."""
    use = indices(weight > _LEAST_WEIGHT)
    # Symmetric: the transpose is the same in the order of LAPACK.
    some = submatrix(signal.T, use, use).T if use.size < y.size else signal.copy(order="F")
    noise = noise[use] / weight[use]
    some.T.flat[:: use.size + 1] += noise
    amount = solve_spd(some, y[use])
    if use.size == y.size:
        return np.asarray(noise * amount)
    weights = np.zeros(y.size)
    weights[use] = amount
    rest = y - signal @ weights
    rest[use] = noise * amount
    return np.asarray(rest)


def _residual_by_posterior(whole: Posterior, m: Floats, at: Ints) -> Callable[[Floats], Floats]:
    """`_weighted_residual` of meters `at` by their weights, from a posterior that covers them."""
    which, Q = whole.precision()
    noise, a = whole.noise[which], Q @ m[which]
    place = np.searchsorted(which, at)

    def left(weight: Floats) -> Floats:
        each = np.zeros(which.size)
        each[place] = np.where(weight > _LEAST_WEIGHT, weight, 0.0)
        less = indices(each < 1.0)
        rest = noise * a
        if less.size:
            # Symmetric: the transpose is the same in the order of LAPACK.
            some, part = submatrix(Q, less, less).T, each[less]
            some.T.flat[:: less.size + 1] += part / (noise[less] * (1.0 - part))
            z = solve_spd(some, a[less])
            rest -= noise * (z @ Q[less])
            rest[less] += z
        return np.asarray(rest[place])

    return left
