"""Mixed regression and Bayes factors against dense Gaussian densities and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from gridsec.planning.calibration import evidence, explain, fit, weigh

N, K = 24, 5


@settings(max_examples=25, deadline=None)
@drawn(st.integers(0, 10_000))
def test_estimates_and_factors_are_those_of_dense_densities(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, z, s = rng.standard_normal((N, K)), rng.standard_normal((N, 2)), rng.uniform(0.1, 2.0, K)
    y = A @ (s * rng.standard_normal(K)) + 0.8 * rng.standard_normal(N)
    found = fit(y, A, s, N)
    whole = np.eye(N) + A @ np.diag(s**2) @ A.T
    gain = np.diag(s**2) @ A.T @ np.linalg.inv(whole)
    np.testing.assert_allclose(found.estimate, gain @ y, atol=1e-9)
    left = np.diag(s**2) - gain @ A @ np.diag(s**2)
    np.testing.assert_allclose(found.std**2, left.diagonal(), atol=1e-9)
    if found.scale > 1.0:
        return  # evidence is then weakened on purpose
    seen = evidence(found, z, np.array([0.0, 0.7]))
    null = multivariate_normal(np.zeros(N), whole).logpdf
    moved = null(y - z[:, 0]) - null(y)
    wider = multivariate_normal(np.zeros(N), whole + 0.49 * np.outer(z[:, 1], z[:, 1])).logpdf(y) - null(y)
    np.testing.assert_allclose(seen.log_factor, [moved, wider], atol=1e-7)


def test_large_residuals_weaken_the_evidence() -> None:
    rng = np.random.default_rng(0)
    A, y = rng.standard_normal((200, 2)), 3.0 * rng.standard_normal(200)
    found = fit(y, A, np.full(2, 0.1), 200)
    assert found.scale == pytest.approx(9.0, rel=0.2)
    z = y[:, None] / 3.0
    weak = evidence(found, z, np.zeros(1))
    np.testing.assert_allclose(weak.h, z[:, 0] @ z[:, 0] / found.scale, rtol=0.05)


def test_files_without_error_are_seldom_accused() -> None:
    rng = np.random.default_rng(4)
    A, s, risk = rng.standard_normal((60, 4)), np.full(4, 0.5), 0.1
    z, spread = 0.4 * rng.standard_normal((60, 30)), np.repeat([0.0, 1.0], 15)
    kind = np.repeat([0, 1], 15)
    wrong = 0
    for _ in range(400):
        y = A @ (s * rng.standard_normal(4)) + rng.standard_normal(60)
        factor = evidence(fit(y, A, s, 60), z, spread).log_factor
        wrong += weigh(factor, kind, risk).any > np.log(1.0 / risk)
    assert wrong <= 400 * risk


def test_equal_explanations_are_kept_together() -> None:
    found = weigh(np.array([30.0, 30.0, 5.0, -2.0]), np.array([0, 0, 0, 1]), 0.05)
    assert sorted(found.kept.tolist()) == [0, 1]
    np.testing.assert_allclose(found.confidence[:2], 0.5, atol=1e-9)
    # One hypothesis of one kind: probability b / (1 + b), and the mean is the factor itself.
    alone = weigh(np.array([np.log(19.0)]), np.array([0]), 0.05)
    assert alone.confidence[0] == pytest.approx(0.95)
    assert alone.any == pytest.approx(np.log(19.0))


def test_nothing_found_is_no_error() -> None:
    assert weigh(np.full(3, -1e4), np.zeros(3, dtype=np.intp), 0.05).any == pytest.approx(-1e4, rel=1e-2)


def test_lengths_alone_are_least_squares_and_equal_effects_are_named() -> None:
    rng = np.random.default_rng(2)
    z = rng.standard_normal((N, 3))
    z[:, 2] = 2.0 * z[:, 1]
    own = np.array([0.02, 0.02, 0.02])
    y = 0.3 * z[:, 0] + 0.1 * rng.standard_normal(N)
    only = fit(y, z[:, :1], own[:1], 1000)
    estimate, std, _ = explain(only, z[:, :1], own[:1], 0.98)
    least = z[:, 0] @ y / (z[:, 0] @ z[:, 0])
    assert estimate[0] == pytest.approx(least)
    assert std[0] == pytest.approx((z[:, 0] @ z[:, 0]) ** -0.5)
    *_, same = explain(fit(y, z, own, 1000), z, own, 0.98)
    np.testing.assert_array_equal(same, [[1, 0, 0], [0, 1, 1], [0, 1, 1]])
    nothing = explain(only, np.zeros((N, 1)), own[:1], 0.98)
    assert np.isinf(nothing[1][0])
