"""Chi-square test of all trusted meters together.

For trusted meters T with mean residuals m and precision Q, the misfit ``m_T^T Q m_T`` of honest meters is
chi-square with |T| degrees of freedom. A manipulation below every single limit still raises it.

The error of the model is not chance. An error of at most e_j at meter j adds at most
``sup ||e||_Q <= sqrt(e^T |Q| e)`` to the root of the misfit, and the limit is

    (sqrt(q) + sqrt(e^T |Q| e))^2

with q the quantile of chi-square at the false-alarm rate (docs/theory-sequential.md, section 3).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from gridsec.arrays import Floats
from gridsec.estimators.sequential.conditional import LeaveOneOut, Posterior


def inconsistent(now: Posterior, loo: LeaveOneOut, model: Floats, tail: float) -> bool:
    """True where the chi-square of the trusted meters is beyond its limit; O(p), O(p^2) close to the limit.

    model: (p,) largest model errors, squared pu. tail: probability of a false alarm.
    """
    root, chance = np.sqrt(max(loo.chi_square, 0.0)), np.sqrt(chi_square_limit(now.count, tail))
    if root <= chance:
        return False
    at, Q = now.precision()
    return bool(root > chance + np.sqrt(model[at] @ np.abs(Q) @ model[at]))


@lru_cache(maxsize=4096)
def chi_square_limit(freedom: int, tail: float) -> float:
    """Quantile of chi-square with `freedom` degrees of freedom at the upper tail."""
    return float(chdtri(freedom, tail)) if freedom else 0.0
