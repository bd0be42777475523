"""Probability that Gaussian noise keeps its bound, against sampling and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from gridsec.decode import Stack
from gridsec.decode.noise import detect
from gridsec.decode.probability import bound_for, bound_probability, quadratic_probability


def test_closed_forms() -> None:
    assert quadratic_probability(np.array([4.0]), 9.0, tol=1e-12) == pytest.approx(
        norm.cdf(1.5) - norm.cdf(-1.5), abs=1e-12
    )
    assert quadratic_probability(np.full(5, 2.0), 7.0, tol=1e-12) == pytest.approx(
        chi2.cdf(3.5, 5), abs=1e-12
    )
    # Two weights: sum of two exponentials' halves in pairs, P = 1 - (a e^(-t/2a) - b e^(-t/2b)) / (a - b).
    a, b, t = 3.0, 0.5, 4.0
    want = 1.0 - (a * np.exp(-t / (2 * a)) - b * np.exp(-t / (2 * b))) / (a - b)
    got = quadratic_probability(np.array([a, a, b, b]), t, tol=1e-12)
    assert got == pytest.approx(want, abs=1e-10)
    assert quadratic_probability(np.array([1.0]), 0.0, tol=1e-9) == 0.0
    assert quadratic_probability(np.zeros(0), 0.0, tol=1e-9) == 1.0


@pytest.mark.parametrize("spread", [1.0, 30.0, 1000.0])
def test_the_series_errs_downwards_and_little(spread: float) -> None:
    rng = np.random.default_rng(0)
    values = np.geomspace(1.0, spread, 4)
    sample = (rng.standard_normal((200_000, 4)) ** 2 @ values) <= 2.0 * spread
    got = quadratic_probability(values, 2.0 * spread, tol=1e-10)
    error = 4.0 * np.sqrt(sample.mean() * (1 - sample.mean()) / 200_000)
    assert abs(got - sample.mean()) < error
    assert quadratic_probability(values, 2.0 * spread, tol=1e-2) <= got + 1e-12


def test_lower_bound_under_correlation_and_exact_without() -> None:
    """lee2018 (2.2.15): the product never exceeds p_v."""
    rng = np.random.default_rng(1)
    stack = Stack.of(rng.standard_normal((4, 2, 2)))
    root = rng.standard_normal((8, 8))
    for P, tight in ((root @ root.T, False), (np.diag(rng.uniform(0.5, 2.0, 8)), True)):
        v_max = 1.7 * float(np.sqrt(np.trace(P) / 8))
        v = rng.standard_normal((200_000, 8)) @ np.linalg.cholesky(P).T
        inside = float(np.all(stack.norms(v) <= v_max, axis=1).mean())
        got = bound_probability(stack, P, v_max, tol=1e-9)
        error = 4.0 * np.sqrt(inside * (1 - inside) / 200_000)
        assert got <= inside + error
        if tight:
            assert abs(got - inside) < error


def test_bound_for_a_probability_and_what_corollary_2_2_13_means() -> None:
    """The false-alarm rate is at most 1 - p_v. The printed 'Pr(e != 0) >= p_v given an alarm' is not so."""
    rng = np.random.default_rng(2)
    stack = Stack.of(rng.standard_normal((4, 3, 2)))
    P = 0.3 * np.eye(12)
    v_max = bound_for(stack, P, 0.6, tol=1e-12)
    assert bound_probability(stack, P, v_max, tol=1e-12) == pytest.approx(0.6, abs=1e-6)
    assert bound_probability(stack, P, v_max, tol=1e-12) >= 0.6 - 1e-9
    # A small bound, so that alarms without any error do occur.
    v_max = bound_for(stack, P, 1e-4, tol=1e-12)
    v = rng.standard_normal((20_000, 12)) * np.sqrt(0.3)
    alarm = detect(stack, v, v_max=v_max).alarm
    assert alarm.sum() > 0, "alarms, all of them with e = 0: given an alarm, Pr(e != 0) is 0 here"
    assert alarm.mean() <= 1.0 - 1e-4
