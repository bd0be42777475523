"""Chi-square test of all trusted meters together.

For trusted meters T with mean residuals m and inverse covariance Q, the misfit ``m_T^T Q m_T`` of honest
meters is chi-square with |T| degrees of freedom. A manipulation below every limit of a single meter raises it
all the same: the misfit is what all meters leave unexplained together.

The error of the model is no chance. The misfit is the square of a norm, so an error of at most e_j at meter j
adds at most ``sup ||e||_Q <= sqrt(e^T |Q| e)`` to its root, and the limit is

    (sqrt(q) + sqrt(e^T |Q| e))^2

with q the quantile of chi-square that the false-alarm rate asks for.

References
----------
docs/theory-sequential.md, section 3.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from gridsec.arrays import Floats
from gridsec.estimators.sequential.conditional import Fit, Judged


def inconsistent(now: Fit, judged: Judged, model: Floats, tail: float) -> bool:
    """True where the misfit of the trusted meters is beyond its limit; O(p), O(p^2) close to the limit.

    Parameters
    ----------
    now, judged
        The trusted meters, and their residuals.
    model : (p,)
        Largest error of the model at each meter, squared pu.
    tail
        Probability that honest meters exceed the limit by chance.
    """
    root, chance = np.sqrt(max(judged.misfit, 0.0)), np.sqrt(misfit_limit(now.count, tail))
    if root <= chance:
        return False
    at, Q = now.trusting()
    return bool(root > chance + np.sqrt(model[at] @ np.abs(Q) @ model[at]))


@lru_cache(maxsize=4096)
def misfit_limit(freedom: int, tail: float) -> float:
    """Quantile of chi-square.

    Parameters
    ----------
    freedom
        Degrees of freedom.
    tail
        Probability beyond it.
    """
    return float(chdtri(freedom, tail)) if freedom else 0.0
