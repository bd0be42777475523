"""Logarithms of the chi-square density and of its tail, also where both underflow."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtr, chdtrc, gammaln, xlogy

from gridsec.arrays import Floats

# Terms of the continued fraction; for arguments beyond the largest double's logarithm two would suffice.
_TERMS = 20
# Upper limit of the argument.
_MOST = 1e300


def log_density(g: Floats, k: Floats) -> Floats:
    """Logarithm of the density of a chi-square variable.

    Parameters
    ----------
    g : (…)
        Argument, >= 0.
    k : (…)
        Degrees of freedom.

    Returns
    -------
    (…)
        ``(k / 2 - 1) ln g - g / 2 - (k / 2) ln 2 - ln Gamma(k / 2)``.
    """
    g, half = np.minimum(g, _MOST), 0.5 * k
    return np.asarray(xlogy(half - 1.0, g) - 0.5 * g - half * np.log(2.0) - gammaln(half))


def log_tail(g: Floats, k: Floats) -> Floats:
    """Logarithm of the probability that a chi-square variable exceeds g.

    Parameters
    ----------
    g : (…)
        The bound, >= 0.
    k : (…)
        Degrees of freedom.

    Returns
    -------
    (…)
        If the probability itself underflows, by the continued fraction of the incomplete gamma function.

    References
    ----------
    NIST Digital Library of Mathematical Functions, 8.9.2.
    """
    g = np.minimum(g, _MOST)
    above, below = chdtrc(k, g), chdtr(k, g)
    with np.errstate(divide="ignore"):
        likely = np.where(below < 0.5, np.log1p(-below), np.log(above))
    return np.where(above > np.finfo(np.float64).tiny, likely, _far(0.5 * g, 0.5 * k))


def _far(x: Floats, a: Floats) -> Floats:
    """``ln(Gamma(a, x) / Gamma(a))`` for x far beyond a."""
    x = np.maximum(x, a + 2.0 * _TERMS)
    fraction = np.zeros(np.broadcast(x, a).shape)
    for j in range(_TERMS, 0, -1):
        fraction = j * (j - a) / (x + 2.0 * j + 1.0 - a - fraction)
    return np.asarray(xlogy(a, x) - x - gammaln(a) - np.log(x + 1.0 - a - fraction))
