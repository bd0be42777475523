"""A start for the search that owes nothing to whom it believed before: a robust fit.

With the readings m of the meters, their variances d, and the prior covariance S of
`gridsec.estimators.sequential.conditional`:

    minimise   w^T S^-1 w + sum_j min((m_j - w_j)^2, bound_j^2) / d_j

by graduated non-convexity, which first fits with a convex cost and hardens it step by step: every round is a
fit with weights, in which the variance of meter j is d_j / weight_j. What such a fit leaves of the readings,
``r = m - w_hat``, is ``D W^-1 (S + D W^-1)^-1 m`` for weights above zero.

Where the inverse covariance Q of all meters is known already, the meters K of smaller weights are all that is
worked on. With a = Q m,

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
from gridsec.estimators.sequential.conditional import Fit, Prior, solved

_HARDER = 2.5
_ROUNDS = 30
# Weights up to this are zero to the fit; well above where Cholesky would notice.
_FEATHER = 1e-6
_TINY = float(np.finfo(np.float64).tiny)


def robust(  # noqa: PLR0917  # a prior, readings, and what is known of them
    prior: Prior, noise: Floats, m: Floats, live: Bools, bound: Floats, whole: Fit | None = None
) -> Bools:
    """Meters that a robust fit trusts, whatever was trusted before; O(p^3).

    Parameters
    ----------
    prior, noise
        As in `conditional.fit`.
    m : (p,)
        Readings minus what the model explains.
    live : (p,)
        Which meters have a reading.
    bound : (p,)
        Largest honest difference between a reading and the truth, squared pu.
    whole
        A fit of the same that `covers` these meters, if there is one: the cube is then that of the number of
        those which are not fully believed.

    Returns
    -------
    (p,)
        The trusted ones.
    """
    at = indices(live)
    trusted = np.zeros(m.size, dtype=np.bool_)
    if not at.size:
        return trusted
    limit = bound[at] ** 2
    left: Callable[[Floats], Floats]
    left = partial(_residual, prior.among(at), noise[at], m[at]) if whole is None else _beside(whole, m, at)
    rest = left(np.ones(at.size))
    largest = float((rest * rest / limit).max())
    if largest <= 1.0:
        trusted[at] = True
        return trusted
    hardness = 1.0 / (2.0 * largest - 1.0)
    for _ in range(_ROUNDS):
        ratio = np.maximum(rest * rest / limit, _TINY)
        soft = np.sqrt(hardness * (hardness + 1.0) / ratio) - hardness
        weight = np.minimum(np.maximum(soft, 0.0), 1.0)
        rest = left(weight)
        if all_of((weight == 0.0) | (weight == 1.0)):
            break
        hardness *= _HARDER
    trusted[at] = rest * rest <= limit
    return trusted


def covers(whole: Fit, prior: Prior, noise: Floats, live: Bools) -> bool:
    """Whether a fit tells the residuals of some meters, whatever their weights.

    Parameters
    ----------
    whole
        The fit.
    prior, noise, live
        As in `robust`.
    """
    # Changes of rank one leave rounding, which a start that owes nothing to what was believed must not owe.
    fresh = not whole.changes and not whole.loose.shape[1]
    same = fresh and whole.prior is prior and np.array_equal(whole.noise, noise)
    return same and not any_of(live & ~whole.trusted)


def _residual(signal: Floats, noise: Floats, y: Floats, weight: Floats) -> Floats:
    """``y - w_hat`` of meters with covariance `signal`, their noise, and weights in the fit from 0 to 1."""
    use = indices(weight > _FEATHER)
    # Symmetric: the transpose is the same in the order of LAPACK.
    some = submatrix(signal.T, use, use).T if use.size < y.size else signal.copy(order="F")
    noise = noise[use] / weight[use]
    some.T.flat[:: use.size + 1] += noise
    amount = solved(some, y[use])
    if use.size == y.size:
        return np.asarray(noise * amount)
    weights = np.zeros(y.size)
    weights[use] = amount
    rest = y - signal @ weights
    rest[use] = noise * amount
    return np.asarray(rest)


def _beside(whole: Fit, m: Floats, at: Ints) -> Callable[[Floats], Floats]:
    """The same of meters `at` by their weights, from a fit of all of them and perhaps of others."""
    who, Q = whole.trusting()
    noise, a = whole.noise[who], Q @ m[who]
    place = np.searchsorted(who, at)

    def left(weight: Floats) -> Floats:
        each = np.zeros(who.size)
        each[place] = np.where(weight > _FEATHER, weight, 0.0)
        less = indices(each < 1.0)
        rest = noise * a
        if less.size:
            # Symmetric: the transpose is the same in the order of LAPACK.
            some, part = submatrix(Q, less, less).T, each[less]
            some.T.flat[:: less.size + 1] += part / (noise[less] * (1.0 - part))
            z = solved(some, a[less])
            rest -= noise * (z @ Q[less])
            rest[less] += z
        return np.asarray(rest[place])

    return left
