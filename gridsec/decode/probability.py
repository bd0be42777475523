"""From Gaussian to bounded noise: probability that every block of the noise is within v_max.

The guarantees for bounded noise hold with at least that probability.

References
----------
lee2018 (2.2.15), Corollaries 2.2.13 to 2.2.15.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtr

from gridsec.arrays import Floats, not_negative
from gridsec.decode.stacks import Stack
from gridsec.errors import DesignInfeasible, InputInvalid, Problem

# Ruben's series: largest number of terms, and its index in units of the spread beyond which the rest is
# negligible.
_TERMS = 2000
_SPREAD = 30.0
# Numbers of nodes on the contour; more for more weights.
_NODES = (24, 32, 40, 48, 64, 96, 128, 192, 256)
_ROUNDING = 1e-15
_DOUBLINGS = 64


def bound_probability(stack: Stack, P: Floats, v_max: float, *, tol: float) -> float:
    """Lower bound of `p_v = Pr(|v_i| <= v_max for all i)`, exact up to `tol` for independent blocks.

    The product of the blocks' own probabilities, which by the Gaussian correlation inequality (the
    events are symmetric and convex) never exceeds p_v, for any correlation between blocks.

    Parameters
    ----------
    stack
        Defines the blocks.
    P : (N, N)
        Covariance of the noise.
    v_max
        Bound, not negative.
    tol
        Largest error per block, downwards, of `quadratic_probability`.

    Raises
    ------
    ValueError
        If `v_max` is negative or NaN, or P is not a covariance.
    DesignInfeasible
        If the probability of a block cannot be computed within `tol`.

    References
    ----------
    lee2018 (2.2.15); T. Royen, "A simple proof of the Gaussian correlation conjecture extended to some
    multivariate gamma distributions", Far East Journal of Theoretical Statistics 48(2), 2014.
    """
    not_negative("v_max", v_max)
    at = np.split(np.arange(P.shape[0]), np.cumsum(stack.heights)[:-1])
    total = 1.0
    for rows in at:
        values = np.asarray(np.linalg.eigvalsh(P[np.ix_(rows, rows)]), dtype=np.float64)
        total *= quadratic_probability(values, v_max**2, tol=tol)
    return total


def bound_for(stack: Stack, P: Floats, probability: float, *, tol: float) -> float:
    """Smallest v_max for which `bound_probability` reaches a probability.

    Parameters
    ----------
    stack, P, tol
        As in `bound_probability`; `tol` should be well below `1 - probability`.
    probability
        Required p_v, strictly between 0 and 1.

    Raises
    ------
    ValueError
        If `probability` is outside (0, 1).
    DesignInfeasible
        If it is not reached, because `tol` is too coarse.
    """
    if not 0.0 < probability < 1.0:
        raise InputInvalid([Problem("out-of-range", f"probability is {probability}; it must lie in (0, 1)")])
    size = float(np.sqrt(max(float(np.max(np.linalg.eigvalsh(P))), 0.0)))
    if size == 0.0:
        return 0.0
    for doublings in range(_DOUBLINGS):
        high = 2.0**doublings * size
        if bound_probability(stack, P, high, tol=tol) >= probability:
            break
    else:
        raise DesignInfeasible(
            "bound of the noise", f"{probability} is not reached up to {high:g}", code="not-converged"
        )
    found, result = brentq(
        lambda v: bound_probability(stack, P, v, tol=tol) - probability, 0.0, high, full_output=True
    )
    # Slightly upwards, so that rounding is on the safe side.
    return float(found) * (1.0 + 1e-9) if result.converged else high


def quadratic_probability(values: Floats, limit: float, *, tol: float) -> float:
    """Lower bound of `Pr(sum_j values_j u_j^2 <= limit)` for independent standard normal u.

    By Ruben's series if it is short, else by the inverse of the Laplace transform.

    Parameters
    ----------
    values : (k,)
        Weights: the eigenvalues of a covariance. Zeros, up to rounding, have no effect.
    limit
        Not negative.
    tol
        Largest error, downwards.

    Raises
    ------
    ValueError
        If a weight is negative or not finite, or the limit is negative or NaN.
    DesignInfeasible
        If neither method reaches `tol`.
    """
    top = float(np.max(values, initial=0.0))
    if not np.all(np.isfinite(values) & (values >= -_ROUNDING * top)):
        raise InputInvalid([Problem("negative", "weights must be finite and not negative")])
    not_negative("limit", limit)
    used = values[values > 0.0]
    if limit == 0.0 or used.size == 0:
        return float(used.size == 0)
    # The series ends when its index passes the spread of the weights or half the limit over the smallest.
    soon = min(limit, _SPREAD * top) <= 2.0 * _TERMS * float(used.min())
    found = _series(used, limit, tol) if soon else None
    return _integral(used, limit, tol) if found is None else found


def _series(values: Floats, limit: float, tol: float) -> float | None:
    """Ruben's mixture of chi-square distributions; None if it does not end within `_TERMS`.

    Weights are positive and sum to one: a partial sum is a lower bound, with an error of at most the omitted
    weight times the next distribution's value.

    References
    ----------
    H. Ruben, "Probability content of regions under spherical normal distributions, IV", Annals of
    Mathematical Statistics 33(2), 1962.
    """
    k, scale = values.size, float(values.min())
    ratio = 1.0 - scale / values
    weights = [float(np.sqrt(np.prod(scale / values)))]
    powers = ratio.copy()
    sums: list[float] = []
    total, used = weights[0] * float(chdtr(k, limit / scale)), weights[0]
    for j in range(1, _TERMS):
        sums.append(float(powers.sum()))
        powers = powers * ratio
        weights.append(float(np.dot(sums[::-1], weights)) / (2.0 * j))
        tail = float(chdtr(k + 2 * j, limit / scale))
        total, used = total + weights[j] * tail, used + weights[j]
        if (1.0 - used) * tail <= tol:
            return min(total, 1.0)
    return None


def _integral(values: Floats, limit: float, tol: float) -> float:
    """Inverse of the Laplace transform `prod (1 + 2 values p)^(-1/2) / p`, less the error.

    All its singularities lie on the negative half axis. On a parabola around it the midpoint rule converges
    geometrically, for any spread of the weights; two successive rules estimate the error.

    References
    ----------
    L. N. Trefethen, J. A. C. Weideman, T. Schmelzer, "Talbot quadratures and rational approximations",
    BIT Numerical Mathematics 46, 2006.
    """
    before, error = np.inf, np.inf
    for nodes in _NODES:
        angle = (2.0 * np.arange(nodes) + 1.0) * np.pi / nodes - np.pi
        z = nodes * (0.1309 - 0.1194 * angle**2 + 0.25j * angle)
        slope = 0.25j - 0.2388 * angle
        logarithm = np.log1p(2.0 * np.multiply.outer(z / limit, values)).sum(axis=1)
        terms = np.exp(z - 0.5 * logarithm) * slope / z
        now = float(np.sum(terms).imag)
        error = abs(now - before) + _ROUNDING * float(np.sum(np.abs(terms)))
        if error <= tol:
            return min(max(now - error, 0.0), 1.0)
        before = now
    raise DesignInfeasible(
        "probability of a quadratic form",
        f"known up to {error:.1e} only, not {tol:.1e}",
        code="not-converged",
    )
