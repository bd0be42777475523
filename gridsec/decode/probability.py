"""From Gaussian to bounded noise: how likely every block of the noise keeps within v_max.

With that probability, and not less, the guarantees for bounded noise hold.

References
----------
lee2018 (2.2.15), Corollaries 2.2.13 to 2.2.15.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtr

from gridsec.arrays import Floats
from gridsec.decode.stacks import Stack

_TERMS = 2000


def bound_probability(stack: Stack, P: Floats, v_max: float, *, tol: float) -> float:
    """A lower bound of `p_v = Pr(|v_i| <= v_max for all i)`, exact up to `tol` for independent blocks.

    The product of the blocks' own probabilities, which by the Gaussian correlation inequality (the
    events are symmetric and convex) never exceeds p_v, whatever the correlation between blocks.

    Parameters
    ----------
    stack
        Gives the blocks.
    P : (N, N)
        Covariance of the noise.
    v_max
        Bound, not negative.
    tol
        Largest error per block, downwards, of the series of `quadratic_probability`.

    References
    ----------
    lee2018 (2.2.15); T. Royen, "A simple proof of the Gaussian correlation conjecture extended to some
    multivariate gamma distributions", Far East Journal of Theoretical Statistics 48(2), 2014.
    """
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
        Wanted p_v, between 0 and 1.
    """
    high = float(np.sqrt(np.max(np.linalg.eigvalsh(P))))
    while bound_probability(stack, P, high, tol=tol) < probability:
        high *= 2.0
    found, result = brentq(
        lambda v: bound_probability(stack, P, v, tol=tol) - probability, 0.0, high, full_output=True
    )
    # A hair upwards, so that rounding falls on the safe side.
    return float(found) * (1.0 + 1e-9) if result.converged else high


def quadratic_probability(values: Floats, limit: float, *, tol: float) -> float:
    """`Pr(sum_j values_j u_j^2 <= limit)` for independent standard normal u, from below.

    Ruben's mixture of chi-square distributions, whose weights are positive and sum to one: a partial
    sum errs downwards, by at most the weight left out times the next distribution's value.

    Parameters
    ----------
    values : (k,)
        Positive weights: the eigenvalues of a covariance.
    limit
        Not negative.
    tol
        Stop when the error is below this.

    References
    ----------
    H. Ruben, "Probability content of regions under spherical normal distributions, IV", Annals of
    Mathematical Statistics 33(2), 1962.
    """
    k = values.size
    if limit <= 0.0 or k == 0:
        return float(k == 0)
    scale = float(values.min())
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
            break
    return min(total, 1.0)
