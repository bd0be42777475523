"""Logarithms of chi-square probabilities against SciPy and against arithmetic of 60 digits."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.stats import chi2

from gridsec.arrays import Floats
from gridsec.secure.decode.gaussian import log_density, log_tail

FREEDOM = np.array([1.0, 2.0, 3.0, 5.0, 20.0, 57.0, 146.0, 300.0])


def tail(g: float, k: float) -> float:
    with mpmath.workdps(60):
        half, x = mpmath.mpf(k) / 2, mpmath.mpf(g) / 2
        below = mpmath.gammainc(half, 0, x, regularized=True)
        if below < 0.5:
            return float(mpmath.log1p(-below))
        return float(mpmath.log(mpmath.gammainc(half, x, mpmath.inf, regularized=True)))


@pytest.mark.parametrize(
    "g", [0.0, 0.1, 3.0, 30.0, 100.0, 600.0, 1400.0, 1416.0, 1420.0, 1500.0, 3e3, 1e5, 1e8]
)
def test_tail_is_right_also_where_it_underflows(g: float) -> None:
    expected = [tail(g, k) for k in FREEDOM]
    np.testing.assert_allclose(log_tail(np.full(FREEDOM.size, g), FREEDOM), expected, rtol=1e-12, atol=0)


def test_a_larger_value_is_always_less_likely() -> None:
    g: Floats = np.geomspace(1.0, 1e6, 20_000)
    for k in FREEDOM:
        assert np.all(np.diff(log_tail(g, np.full(g.size, k))) <= 0)
        assert np.all(np.diff(log_tail(g[g > k], k)) < 0)


def test_nothing_is_less_likely_than_infinity() -> None:
    for of in (log_density, log_tail):
        assert np.all(of(np.full(FREEDOM.size, np.inf), FREEDOM) < -1e299)


def test_density_is_scipys() -> None:
    g = np.array([0.0, 0.1, 3.0, 30.0, 100.0, 3e3])[:, None]
    np.testing.assert_allclose(log_density(g, FREEDOM), chi2.logpdf(g, FREEDOM), rtol=1e-12)
