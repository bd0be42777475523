"""Partial filters against textbook filters, a dense joint recursion, Riccati equations and draws."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
from hypothesis import given, settings
from scipy.linalg import solve_discrete_are
from scipy.stats import chi2

from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers import kalman
from gridsec.observers.kalman import KalmanDesign, KalmanState
from tests.codes import refused
from tests.gridsec.observers.modal import modal

seeds = st.integers(0, 100_000)
TOL, INSIDE = 1e-8, 1.0 - 1e-6


def covariance(rng: np.random.Generator, n: int, rank: int | None = None) -> np.ndarray:
    root = rng.standard_normal((n, n if rank is None else rank))
    return root @ root.T / n


def case(
    seed: int, *, slowest: float = INSIDE
) -> tuple[KalmanDesign, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    A, B, C = modal(seed)
    rng = np.random.default_rng(seed)
    Q, R = covariance(rng, 5), covariance(rng, 5) + 0.1 * np.eye(5)
    return kalman.design(A, B, C, Q, R, slowest=slowest, tol=TOL, period=2.0), A, B, C, Q, R


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_joint_covariance_is_that_of_plant_and_filters_as_one_system(seed: int) -> None:
    made, A, _, C, Q, R = case(seed)
    phi, mu = made.stack.phi, len(made.stack.phi)
    rng = np.random.default_rng(seed + 1)
    first = covariance(rng, 5)
    state = kalman.correct(made, kalman.init(made, 0.0, np.zeros(5), first), np.zeros(5))
    # Covariance of (x, z_hat) of the plant and all filters as one linear system.
    K, H = state.K, C
    lift = np.vstack([np.eye(5), K @ H])
    joint = lift @ first @ lift.T
    joint[5:, 5:] += K @ R @ K.T
    for _ in range(12):
        state = kalman.step(made, state, np.zeros(5), np.zeros(1))
        K = state.K
        # x+ = A x + d;  z+ = (I - K T) S z + K (C (A x + d) + n)
        move = np.block([[A, np.zeros((5, mu))], [K @ C @ A, (np.eye(mu) - K @ made.stack.T) @ made.stack.S]])
        push = np.vstack([np.eye(5), K @ C])
        joint = move @ joint @ move.T + push @ Q @ push.T
        joint[5:, 5:] += K @ R @ K.T
        error = np.hstack([-phi, np.eye(mu)])
        expected = error @ joint @ error.T
        # The oracle subtracts covariances of a growing state: its own rounding grows with them.
        slack = 1e-9 * float(np.max(np.abs(joint))) + 1e-9 * float(np.max(np.abs(expected)))
        assert np.allclose(state.P, expected, rtol=0.0, atol=slack)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_every_filter_is_the_textbook_filter_of_its_sensor(seed: int) -> None:
    made, _, B, _, Q, R = case(seed)
    rng = np.random.default_rng(seed)
    mean, first = rng.standard_normal(5), covariance(rng, 5)
    y, u = rng.standard_normal((6, 5)), rng.standard_normal((6, 1))
    state = kalman.correct(made, kalman.init(made, 4.0, mean, first), y[0])
    for k in range(1, 6):
        state = kalman.step(made, state, y[k], u[k - 1])
    assert np.isclose(state.t, 14.0)
    for i, part in enumerate(made.stack.parts):
        Z, t = part.basis, part.t
        z, P = Z.T @ mean, Z.T @ first @ Z
        for k in range(6):
            if k:
                z, P = part.S @ z + Z.T @ B @ u[k - 1], part.S @ P @ part.S.T + Z.T @ Q @ Z
            gain = P @ t / (t @ P @ t + R[i, i])
            # The printed (4.3.9e), not Joseph's form.
            z, P = z + gain * (y[k, i] - t @ z), (np.eye(t.size) - np.outer(gain, t)) @ P
        at = made.stack.rows(i)
        assert np.allclose(state.z[at], z, rtol=1e-6, atol=1e-7)
        assert np.allclose(state.P[at, at], P, rtol=1e-6, atol=1e-7)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_steady_state_solves_the_riccati_equations_and_is_a_fixed_point(seed: int) -> None:
    made, _, _, _, _, R = case(seed)
    found = kalman.steady(made)
    scale = float(np.max(np.abs(found.P)))
    for i, part in enumerate(made.stack.parts):
        if not part.t.size:
            continue
        at = made.stack.rows(i)
        # Without balancing, which fails for modes that a sensor does not see.
        M = solve_discrete_are(
            part.S.T, part.t[:, None], made.process[at, at], R[i : i + 1, i : i + 1], balanced=False
        )
        expected = M - M @ np.outer(part.t, part.t) @ M / (part.t @ M @ part.t + R[i, i])
        assert np.allclose(found.P[at, at], expected, rtol=1e-6, atol=1e-7 * scale)
    # Off-diagonal blocks too: one more time-varying step changes nothing.
    state = KalmanState(0.0, np.zeros(len(found.P)), found.P, found.K)
    after = kalman.step(made, state, np.ones(5), np.ones(1))
    assert np.allclose(after.P, found.P, rtol=0.0, atol=1e-7 * scale)
    assert np.allclose(after.K, found.K, rtol=0.0, atol=1e-6 * max(1.0, float(np.max(np.abs(found.K)))))
    held = kalman.step_steady(made, found, state, np.ones(5), np.ones(1))
    assert np.allclose(held.z, after.z, rtol=1e-6, atol=1e-6)
    assert held.P is found.P
    assert held.t == after.t


def test_consistency_over_draws() -> None:
    """NEES of every filter and of all together, and independence in time of one filter's innovations."""
    made, A, B, C, Q, R = case(4)
    rng = np.random.default_rng(0)
    runs, first = 4000, np.eye(5)
    x = rng.multivariate_normal(np.ones(5), first, runs)
    noise = np.linalg.cholesky(R)
    state = kalman.init(made, 0.0, np.tile(np.ones(5), (runs, 1)), first)
    state = kalman.correct(made, state, x @ C.T + rng.standard_normal((runs, 5)) @ noise.T)
    drive = np.linalg.cholesky(Q)
    for _ in range(15):
        u = rng.standard_normal((runs, 1))
        x = x @ A.T + u @ B.T + rng.standard_normal((runs, 5)) @ drive.T
        state = kalman.step(made, state, x @ C.T + rng.standard_normal((runs, 5)) @ noise.T, u)
    error = state.z - x @ made.stack.phi.T
    blocks = [made.stack.rows(i) for i in range(5)] + [slice(None)]
    for at in blocks:
        values, axes = np.linalg.eigh(state.P[at, at])
        use = values > 1e-8 * values.max()
        nees = np.sum(np.square(error[:, at] @ axes[:, use]) / values[use], axis=1)
        rank = int(np.count_nonzero(use))
        # 99.9 % interval of the sum over independent runs.
        low, high = chi2.ppf([5e-4, 1.0 - 5e-4], rank * runs) / runs
        assert low < nees.mean() < high


def test_masked_sensor_has_no_influence_and_batch_equals_single() -> None:
    made, *_ = case(5)
    rng = np.random.default_rng(2)
    start = kalman.init(made, 0.0, rng.standard_normal((3, 5)), np.eye(5))
    y, u = rng.standard_normal((3, 5)), rng.standard_normal((3, 1))
    seen = np.array([True, True, False, True, True])
    batch = kalman.correct(made, start, np.where(seen, y, np.nan), seen)
    assert np.all(np.isfinite(batch.z))
    at = made.stack.rows(2)
    assert np.array_equal(batch.z[:, at], start.z[:, at])
    assert np.array_equal(batch.P[at, at], start.P[at, at])
    for r in range(3):
        alone = KalmanState(0.0, start.z[r], start.P, start.K)
        one = kalman.step(made, kalman.correct(made, alone, np.where(seen, y[r], 7.0), seen), y[r], u[r])
        many = kalman.step(made, batch, y, u)
        assert np.allclose(one.z, many.z[r], rtol=1e-12, atol=1e-12)
        assert np.array_equal(one.P, many.P)


def test_noiseless_certain_sensor_corrects_nothing() -> None:
    made = kalman.design(
        np.eye(1), np.zeros((1, 1)), np.eye(1), np.zeros((1, 1)), np.zeros((1, 1)), slowest=0.0, tol=TOL
    )
    state = kalman.init(made, 0.0, np.array([2.0]), np.zeros((1, 1)))
    after = kalman.step(made, state, np.array([3.0]), np.zeros(1))
    assert np.array_equal(after.P, np.zeros((1, 1)))
    assert np.isclose(abs(after.z[0]), 2.0)


def test_covariances_that_are_none_are_refused() -> None:
    A, B, C = np.eye(2), np.zeros((2, 1)), np.eye(2)
    for Q, R, code in (
        (np.eye(3), np.eye(2), "shape"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), np.eye(2), "not-definite"),
        (np.eye(2), np.diag([1.0, -1.0]), "not-definite"),
        (np.array([[np.nan, 0.0], [0.0, 1.0]]), np.eye(2), "not-finite"),
        (np.eye(2), np.diag([np.inf, 1.0]), "not-finite"),
    ):
        with refused(InputInvalid, code):
            kalman.design(A, B, C, Q, R, slowest=0.0, tol=TOL)
    with refused(InputInvalid, "not-finite", "shape"):
        kalman.design(A, B, C, np.full((2, 2), np.nan), np.eye(3), slowest=0.0, tol=TOL)


def test_a_reading_that_is_not_finite_counts_as_unseen() -> None:
    made, *_ = case(5)
    start = kalman.init(made, 0.0, np.arange(5.0), np.eye(5))
    y, seen = np.arange(5.0), np.array([True, True, False, True, True])
    expected = kalman.correct(made, start, y, seen)
    for junk in (np.nan, np.inf):
        found = kalman.correct(made, start, np.where(seen, y, junk))
        assert np.array_equal(found.z, expected.z)
        assert np.array_equal(found.P, expected.P)


def test_steady_filter_that_does_not_exist_is_refused() -> None:
    # A constant that nothing disturbs: its gain goes to zero and no gain is stationary and stable.
    made = kalman.design(
        np.eye(1), np.zeros((1, 1)), np.eye(1), np.zeros((1, 1)), np.eye(1), slowest=0.0, tol=TOL
    )
    with refused(DesignInfeasible, "unstable"):
        kalman.steady(made)
