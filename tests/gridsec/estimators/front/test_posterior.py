"""Priors against power flow and matrices; posteriors against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.front.posterior import (
    Posterior,
    Prior,
    condition,
    injection_doubt,
    invert_spd,
    leave_one_out,
    prior_variance,
    remove_meter,
    solve_spd,
    voltage_prior,
)
from gridsec.grid.devices import fleet
from tests.codes import refused
from tests.gridsec.street import ac_voltages, accuracy, random_tree

SEEDS = st.integers(0, 2**32 - 1)


class TestPriors:
    def test_the_prior_is_the_covariance_of_what_power_flow_makes_of_load_errors(self) -> None:
        """Monte Carlo through AC power flow; common parts and the busbar's error included."""
        rng = np.random.default_rng(1)
        tree = random_tree(6, rng, drop=0.004)
        p, q = np.full(6, 0.01), np.full(6, 0.02)
        doubt = LoadDoubt(p, q, 600.0, common_p=0.5, common_q=0.3)
        found = voltage_prior(tree, np.arange(1, 7), doubt, busbar=1e-3)
        base = ac_voltages(tree, np.zeros(6, dtype=complex), 1.0) ** 2
        draws = []
        for _ in range(6000):
            dp = p * (np.sqrt(0.5) * rng.normal(size=6) + np.sqrt(0.5) * rng.normal())
            dq = q * (np.sqrt(0.7) * rng.normal(size=6) + np.sqrt(0.3) * rng.normal())
            v2 = ac_voltages(tree, dp + 1j * dq, 1.0) ** 2 + 1e-3 * rng.normal()
            draws.append(v2 - base)
        sample = np.cov(np.array(draws).T)
        scale = np.sqrt(np.outer(found.variance, found.variance))
        np.testing.assert_allclose(found.covariance / scale[:, 1:], sample[:, 1:] / scale[:, 1:], atol=0.06)
        np.testing.assert_allclose(found.variance, np.diagonal(sample), rtol=0.08, atol=1e-7)
        between = found.covariance[found.meters]
        np.testing.assert_allclose(between, between.T)

    def test_the_prior_is_that_of_the_matrices(self) -> None:
        rng = np.random.default_rng(2)
        tree = random_tree(12, rng, drop=0.04)
        model, doubt = tree.linear(), LoadDoubt(rng.random(12), rng.random(12), 1.0, 0.3, 0.6)
        at, inverters = rng.permutation(13)[:7], rng.random(12)
        found = voltage_prior(tree, at, doubt, busbar=0.01, inverters=inverters)
        expected = np.full((13, 13), 1e-4)
        for R, s, c in (
            (model.R_bus, doubt.p, 0.3),
            (model.X_bus, np.hypot(doubt.q, inverters), 0.6),
        ):
            expected += 4.0 * R @ ((1.0 - c) * np.diag(s**2) + c * np.outer(s, s)) @ R.T
        np.testing.assert_allclose(found.covariance, expected[:, at], rtol=1e-12)
        np.testing.assert_allclose(found.variance, np.diagonal(expected), rtol=1e-12)
        np.testing.assert_array_equal(
            prior_variance(tree, doubt, busbar=0.01, inverters=inverters), found.variance
        )

    def test_every_problem_is_named(self) -> None:
        with refused(InputInvalid, "negative", "negative", "out-of-range", "out-of-range", "out-of-range"):
            LoadDoubt(np.array([-1.0]), np.array([np.nan]), 0.0, common_p=2.0, common_q=-1.0)
        for time_s in (np.inf, np.nan, 1e200):
            with refused(InputInvalid, "out-of-range"):
                LoadDoubt(np.ones(1), np.ones(1), time_s)

    def test_inverters_follow_their_meters_errors_up_to_saturation(self) -> None:
        droop = fleet(np.array([0, 2, 2]), ["ieee1547-b"] * 3, np.array([5.0, 5.0, 8.0]), 100.0)
        found = injection_doubt(droop, accuracy(2), np.array([0, 1]), 3)
        std = 2.0 * np.sqrt(0.005**2 / 3.0 + (0.1 / 230.0) ** 2 / 12.0 + 0.0005**2)
        assert found[0] == pytest.approx(min(droop.slope[0] * std, droop.limit[0]))
        np.testing.assert_array_equal(found[1:], 0.0)


def problem(rng: np.random.Generator, buses: int, meters: int) -> tuple[Floats, Prior, Floats, Floats]:
    """Covariance of all buses, the prior of it, variances of the readings, and readings."""
    root = rng.normal(size=(buses, buses))
    S = root @ root.T
    at = rng.permutation(buses)[:meters]
    noise = np.exp(rng.uniform(-6.0, 1.0, meters))
    return S, Prior(S[:, at], at, np.diag(S).copy()), noise, rng.normal(size=meters)


def agrees(S: Floats, now: Posterior, m: Floats) -> None:
    """Mean, variance and leave-one-out residuals of dense conditioning, one meter left out at a time."""
    at, T = now.prior.meters, np.flatnonzero(now.trusted)
    loo = leave_one_out(now, m)

    def dense(some: np.ndarray) -> tuple[Floats, Floats]:
        gain = S[:, at[some]] @ np.linalg.inv(S[np.ix_(at[some], at[some])] + np.diag(now.noise[some]))
        return gain @ m[some], np.diag(S - gain @ S[at[some]])

    mean, variance = dense(T)
    np.testing.assert_allclose(loo.mean, mean, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(now.variance, variance, rtol=1e-5, atol=1e-8)
    for j in range(m.size):
        w, M = dense(T[j != T])
        np.testing.assert_allclose(loo.residual[j], m[j] - w[at[j]], rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(loo.std[j] ** 2, M[at[j]] + now.noise[j], rtol=1e-5)
    K = S[np.ix_(at[T], at[T])] + np.diag(now.noise[T])
    np.testing.assert_allclose(loo.chi_square, m[T] @ np.linalg.solve(K, m[T]), rtol=1e-6, atol=1e-9)


@settings(max_examples=60)
@given(seed=SEEDS, meters=st.integers(1, 9), extra=st.integers(0, 6))
def test_leave_one_out_is_leaving_one_out(seed: int, meters: int, extra: int) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, meters + extra, meters)
    trusted = rng.random(meters) < 0.7
    agrees(S, condition(prior, noise, trusted), m)


@settings(max_examples=60)
@given(seed=SEEDS, removals=st.integers(1, 6))
def test_removals_one_by_one_are_conditioning_on_what_is_left(seed: int, removals: int) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, 12, 8)
    now = condition(prior, noise, np.ones(8, dtype=np.bool_))
    for j in rng.permutation(8)[:removals].tolist():
        before = leave_one_out(now, m)
        remove_meter(now, j)
        after = leave_one_out(now, m)
        # The chi-square falls by the square of the normalised residual.
        fall = (before.residual[j] / before.std[j]) ** 2
        np.testing.assert_allclose(before.chi_square - after.chi_square, fall, rtol=1e-5, atol=1e-8)
    agrees(S, now, m)
    anew = condition(prior, noise, now.trusted)
    np.testing.assert_allclose(now.Q, anew.Q, rtol=1e-5, atol=1e-7 * np.abs(anew.Q).max())


def test_a_copy_does_not_change_with_its_original() -> None:
    S, prior, noise, m = problem(np.random.default_rng(4), 9, 6)
    now = condition(prior, noise, np.ones(6, dtype=np.bool_))
    kept = now.copy()
    remove_meter(now, 2)
    assert kept.trusted.all()
    agrees(S, kept, m)


def test_without_a_trusted_meter_the_prior_is_left() -> None:
    _, prior, noise, m = problem(np.random.default_rng(5), 9, 6)
    now = condition(prior, noise, np.zeros(6, dtype=np.bool_))
    np.testing.assert_array_equal(now.variance, prior.variance)
    loo = leave_one_out(now, m)
    assert loo.chi_square == 0.0
    np.testing.assert_array_equal(loo.residual, m)


def test_inverse_and_solution_are_those_of_dense_algebra() -> None:
    root = np.random.default_rng(6).normal(size=(40, 40))
    matrix, right = root @ root.T + np.eye(40), root[0]
    found = np.asfortranarray(matrix)
    invert_spd(found)
    np.testing.assert_allclose(found, np.linalg.inv(matrix), rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(
        solve_spd(np.asfortranarray(matrix), right), np.linalg.solve(matrix, right), rtol=1e-9
    )
    for function in (invert_spd, lambda given: solve_spd(given, np.ones(2))):
        with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
            function(np.asfortranarray(-np.eye(2)))
