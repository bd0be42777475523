"""Probability that Gaussian noise keeps its bound, against sampling and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.secure.decode import Stack, design, sensors_in_error
from gridsec.secure.decode.noise import (
    bound_for,
    bound_probability,
    correct,
    correction_constants,
    detect,
    detection_constants,
    quadratic_probability,
)
from tests.codes import refused


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


@pytest.mark.canary("0.001-0.01", "0.5-0.01", "3.0-0.01", "3.0-1e-30", "40.0-1e-30", "1000000000.0-1e-30")
@pytest.mark.parametrize("small", [1e-2, 1e-3, 1e-4, 1e-8, 1e-30])
@pytest.mark.parametrize("limit", [1e-3, 0.5, 3.0, 40.0, 1e9])
def test_weights_of_very_different_size(small: float, limit: float) -> None:
    """Oracle: the distribution of the large part, averaged over the small one by Gauss-Hermite."""
    node, weight = np.polynomial.hermite_e.hermegauss(180)
    share = weight / weight.sum()
    rest = np.maximum(limit - small * node**2, 0.0)
    want = float(share @ chi2.cdf(rest, 3))
    got = quadratic_probability(np.array([1.0, 1.0, 1.0, small]), limit, tol=1e-9)
    assert -2e-9 <= got - want <= 1e-9 or limit < 30.0 * small
    alone = chi2.cdf(limit, 3)
    assert got <= alone + 1e-12
    assert got == pytest.approx(alone, abs=1e-9 + small)


def test_many_weights_over_sixteen_decades() -> None:
    """Pairs make exponentials: `1 - sum of a_i^(n-1) exp(-t / 2 a_i) / prod(a_i - a_j)`."""
    a = np.geomspace(1e-16, 1.0, 9)
    for t in (0.1, 1.0, 5.0):
        apart = a[:, None] - a[None, :]
        np.fill_diagonal(apart, 1.0)
        share = np.prod(np.where(np.eye(9) > 0, 1.0, a[:, None] / apart), axis=1)
        want = 1.0 - share @ np.exp(-t / (2.0 * a))
        got = quadratic_probability(np.repeat(a, 2), t, tol=1e-10)
        assert got == pytest.approx(want, abs=2e-10)
    # Where neither method is near its end: hundreds of weights, a few of them small.
    values, rng = np.concatenate([np.ones(200), np.full(4, 1e-5)]), np.random.default_rng(4)
    assert quadratic_probability(values, 210.0, tol=1e-9) == pytest.approx(chi2.cdf(210.0, 200), abs=1e-5)
    mixed = rng.uniform(1e-6, 1.0, 12)
    sample = float((rng.standard_normal((100_000, 12)) ** 2 @ mixed <= 5.0).mean())
    assert quadratic_probability(mixed, 5.0, tol=1e-9) == pytest.approx(sample, abs=0.007)


def test_weights_of_zero_add_nothing() -> None:
    got = quadratic_probability(np.array([0.0, 2.0, 0.0]), 3.0, tol=1e-12)
    assert got == pytest.approx(chi2.cdf(1.5, 1), abs=1e-12)
    assert quadratic_probability(np.zeros(3), 0.0, tol=1e-12) == 1.0
    stack = Stack.of([np.eye(2)])
    want = norm.ppf(0.995)
    for small in (0.0, 1e-12):
        assert bound_for(stack, np.diag([1.0, small]), 0.99, tol=1e-9) == pytest.approx(want, abs=1e-6)
    assert bound_for(stack, np.zeros((2, 2)), 0.99, tol=1e-9) == 0.0


def test_what_is_no_probability_or_covariance_is_refused() -> None:
    stack = Stack.of([np.eye(2)])
    for wrong in (0.0, 1.0, 1.5, -1.0, np.nan):
        with refused(InputInvalid, "out-of-range"):
            bound_for(stack, np.eye(2), wrong, tol=1e-9)
    with refused(DesignInfeasible, "not-converged"):
        bound_for(stack, np.diag([1.0, 1e-6]), 1.0 - 1e-15, tol=1e-6)
    for values, limit in (([1.0, -0.1], 1.0), ([np.nan], 1.0), ([1.0], np.nan), ([1.0], -1.0)):
        with refused(InputInvalid, "negative"):
            quadratic_probability(np.array(values), limit, tol=1e-9)
    with refused(InputInvalid, "negative"):
        bound_probability(stack, np.eye(2), -1.0, tol=1e-9)
    with refused(DesignInfeasible, "not-converged"):
        quadratic_probability(np.array([1.0, 1e-6]), 1.0, tol=0.0)


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


def test_all_implications_hold_whenever_the_noise_keeps_its_bound() -> None:
    """lee2018, Corollaries 2.2.13 (ii), 2.2.14 and 2.2.15 as corrected: all at once, at least at rate p_v."""
    rng, q, runs = np.random.default_rng(3), 1, 4000
    stack = Stack.of(rng.standard_normal((5, 2, 2)))
    P = np.diag(rng.uniform(0.5, 2.0, 10))
    v_max = bound_for(stack, P, 0.8, tol=1e-12)
    silent, far = detection_constants(stack, q, tol=1e-9), correction_constants(stack, q, tol=1e-9)
    x, v = rng.standard_normal((runs, 2)), rng.standard_normal((runs, 10)) * np.sqrt(np.diagonal(P))
    where = np.eye(5)[rng.integers(0, 5, runs)] @ stack.membership.T
    e = where * rng.standard_normal((runs, 10)) * v_max * 10.0 ** rng.uniform(-1, 2, (runs, 1))
    z = x @ stack.matrix.T + v + e
    kept = np.all(stack.norms(v) <= v_max, axis=1)
    assert abs(kept.mean() - 0.8) < 4.0 * np.sqrt(0.16 / runs)
    found = detect(stack, z, v_max=v_max)
    calm = kept & ~found.alarm
    assert calm.sum() > 100
    assert np.all(np.linalg.norm(found.x - x, axis=1)[calm] <= silent.kappa_d * v_max)
    assert np.all(stack.norms(e)[calm] <= silent.kappa_e * v_max)
    got = correct(design(stack, q, tol=1e-9), far, z, v_max=v_max)
    assert np.all(got.credible[kept])
    assert np.all(np.linalg.norm(got.x - x, axis=1)[kept] <= far.kappa_c * v_max)
    # An estimate that leaves more than q sensors unexplained is far off (2.2.15 (ii)).
    guess = x + rng.standard_normal((runs, 2)) * v_max
    many = sensors_in_error(stack, z, guess, far.theta * v_max) > q
    assert np.any(kept & many)
    assert np.all(np.linalg.norm(guess - x, axis=1)[kept & many] > far.kappa_far * v_max)
