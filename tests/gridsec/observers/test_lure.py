"""The closed loop, its time step against solve_ivp, its equilibrium against gradients and long times."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import minimize

from gridsec.arrays import spectral_radius
from gridsec.errors import DesignInfeasible, FeederInvalid, InputInvalid
from gridsec.grid.devices import PRESETS, Droop, fleet
from gridsec.observers.lure import (
    POLICY,
    Lure,
    advance,
    close_loop,
    equilibrium,
    known_input,
    settle,
    step,
    transition,
)
from tests.codes import refused
from tests.gridsec.radial import random_feeder, random_loop, squared_voltages

seeds = st.integers(0, 100_000)
gains = st.sampled_from([0.1, 0.7, 1.0, 1.7, 5.0, 20.0])


def right_side(lure: Lure, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return lure.A @ x + lure.G @ lure.phi(lure.H @ x + lure.F @ u) + lure.B @ u


def integrated(lure: Lure, x: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
    solution = solve_ivp(
        lambda _, x: right_side(lure, x, u), (0.0, h), x, method="LSODA", rtol=1e-10, atol=1e-13
    )
    assert solution.success
    return solution.y[:, -1]


@given(seeds)
def test_outputs_of_the_loop_are_the_voltages_of_the_power_flow(seed: int) -> None:
    feeder = random_feeder(seed)
    rng = np.random.default_rng(seed)
    count = len(feeder.customers)
    # Inverters, meters and customers are different sets, with repetitions.
    own, meters = rng.integers(0, count, 3), rng.integers(0, count, 4)
    droop = fleet(own, list(rng.choice(PRESETS, 3)), rng.uniform(3, 10, 3), 100.0, vbar=1.01)
    lure = close_loop(feeder, droop, meters)
    model = feeder.linear()
    p, q = rng.uniform(-0.1, 0.1, (2, count))
    x = rng.uniform(-0.05, 0.05, 3)
    correction = feeder.loss_correction(p, q, 1.03)[feeder.bus]
    u = known_input(model, 1.01, p, q, 1.03, correction)
    total = q.copy()
    np.add.at(total, own, x)
    z = 1.01**2 - (squared_voltages(model, p, total, 1.03) + correction)
    assert np.allclose(lure.H @ x + lure.F @ u, z[own], rtol=0, atol=1e-14)
    assert np.allclose(lure.C @ x + lure.D @ u, z[meters], rtol=0, atol=1e-14)
    rate = (-x + droop(z[own])) / droop.tau
    assert np.allclose(right_side(lure, x, u), rate, rtol=0, atol=1e-14)
    assert np.array_equal(lure.slope, droop.slope)


def test_known_input_in_batches() -> None:
    model = random_feeder(4).linear()
    rng = np.random.default_rng(0)
    p, q = rng.uniform(-1, 1, (2, 2, 3, len(model.R)))
    v0 = rng.uniform(0.9, 1.1, (2, 3))
    together = known_input(model, 1.0, p, q, v0)
    assert np.allclose(
        together[1, 2], known_input(model, 1.0, p[1, 2], q[1, 2], v0[1, 2]), rtol=0, atol=1e-15
    )


@pytest.mark.canary("0.01", "900.0")
@pytest.mark.parametrize("h", [0.01, 0.1, 1.0, 7.0, 30.0, 59.0, 61.0, 900.0])
@settings(max_examples=12)
@given(seed=seeds, gain=gains, spread=st.sampled_from([1.0, 4.0]))
def test_step_against_solve_ivp(h: float, seed: int, gain: float, spread: float) -> None:
    _, droop, lure = random_loop(seed, gain=gain, spread=spread)
    rng = np.random.default_rng([seed, 3])
    u = rng.uniform(-0.2, 0.2, lure.F.shape[1])
    x = rng.uniform(-1.0, 1.0, droop.tau.size) * droop.limit
    exact = integrated(lure, x, u, h)
    size = float(np.max(droop.limit))
    # One part in a thousand of the largest limit: kinks inside a substep cost the order, not more.
    assert np.max(np.abs(advance(lure, x, u, h) - exact)) < 1e-3 * size


def test_second_order_inside_a_linear_piece() -> None:
    _, droop, lure = random_loop(11, gain=0.8)
    u = np.full(lure.F.shape[1], 0.08)  # on the ramp of IEEE 1547 B: z between 0.0396 and 0.1536
    x = 0.1 * droop.limit
    exact = integrated(lure, x, u, 3.0)
    policies = [replace(POLICY, substep=substep) for substep in (0.1, 0.05, 0.025)]
    assert [transition(lure, 3.0, policy).substeps for policy in policies] == [28, 55, 109]
    errors = [np.max(np.abs(advance(lure, x, u, 3.0, policy) - exact)) for policy in policies]
    assert errors[0] > 3.5 * errors[1] > 3.5**2 * errors[2] > 0.0


@given(seeds)
@settings(max_examples=30)
def test_dense_dynamics_without_feedback_are_exact(seed: int) -> None:
    # With phi constant the scheme is the variation of constants formula, dense A included.
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    A = rng.normal(size=(n, n)) - 1.0 * np.eye(n)
    B = rng.normal(size=(n, 2))
    lure = Lure(
        A, np.eye(n), np.eye(n), np.zeros((n, 2)), B, np.eye(n), np.zeros((n, 2)), np.zeros(n), np.zeros_like
    )
    x, u = rng.normal(size=n), rng.normal(size=2)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = 0.7 * A, 0.7 * (B @ u)
    exact = expm(block) @ np.append(x, 1.0)
    assert np.allclose(advance(lure, x, u, 0.7), exact[:n], rtol=1e-10, atol=1e-12)


def test_dense_dynamics_with_a_smooth_nonlinearity() -> None:
    A = np.array([[0.0, 1.0], [-1.0, -0.2]])
    eye, drive = np.eye(2), np.zeros((2, 1))
    lure = Lure(A, 0.5 * eye, -eye, drive, np.ones((2, 1)), eye, drive, np.ones(2), np.sin)
    x, u = np.array([1.0, -2.0]), np.array([0.3])
    assert transition(lure, 1.0).decay.shape == (2, 2)
    assert np.allclose(advance(lure, x, u, 3.0), integrated(lure, x, u, 3.0), rtol=0, atol=2e-3)
    fine = replace(POLICY, substep=0.01)
    assert np.allclose(advance(lure, x, u, 3.0, fine), integrated(lure, x, u, 3.0), rtol=0, atol=2e-5)


@pytest.mark.parametrize("h", [0.5, 900.0])
def test_batches_equal_single_steps(h: float) -> None:
    _, droop, lure = random_loop(21, gain=1.5)
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (2, 5, droop.tau.size)) * droop.limit
    u = rng.uniform(-0.2, 0.2, (2, 5, lure.F.shape[1]))
    prepared = transition(lure, h)
    together = step(prepared, lure, x, u)
    for i, j in np.ndindex(2, 5):
        assert np.allclose(together[i, j], advance(lure, x[i, j], u[i, j], h), rtol=0, atol=1e-10)


@given(seed=seeds, gain=gains, h=st.floats(0.0, 2000.0))
@settings(max_examples=40)
def test_every_step_length_stays_within_saturation(seed: int, gain: float, h: float) -> None:
    _, droop, lure = random_loop(seed, gain=gain, spread=3.0)
    rng = np.random.default_rng([seed, 4])
    u = rng.uniform(-0.3, 0.3, lure.F.shape[1])
    x = rng.uniform(-1.0, 1.0, droop.tau.size) * droop.limit
    assert np.all(np.abs(advance(lure, x, u, h)) <= droop.limit * (1 + 1e-3) + 1e-12)


def test_no_time_no_change() -> None:
    _, droop, lure = random_loop(2, gain=1.0)
    assert np.array_equal(advance(lure, droop.limit, np.full(lure.F.shape[1], 0.1), 0.0), droop.limit)


def test_long_steps_take_the_equilibrium_and_the_change_is_seamless() -> None:
    _, droop, lure = random_loop(2, gain=2.0)
    u = np.full(lure.F.shape[1], 0.1)
    x = -droop.limit
    border = -np.log(POLICY.settled) * float(np.max(droop.tau))
    before, after = (advance(lure, x, u, border * k) for k in (0.999, 1.001))
    assert transition(lure, border * 0.999).substeps > 0
    assert transition(lure, border * 1.001).substeps == 0
    assert np.max(np.abs(before - after)) < 3e-6 * np.max(droop.limit)
    never = replace(POLICY, settled=0.0)
    assert transition(lure, border * 1.001, never).substeps > 0
    assert np.allclose(
        advance(lure, x, u, border * 1.001, never), after, rtol=0, atol=3e-6 * np.max(droop.limit)
    )


@pytest.mark.canary("0.5")
@pytest.mark.parametrize("h", [0.5, 20.0, 900.0])
@settings(max_examples=12)
@given(seed=seeds, gain=st.sampled_from([0.3, 0.9, 2.0]))
def test_states_far_faster_than_the_step_are_at_rest(h: float, seed: int, gain: float) -> None:
    """Milliseconds beside days cost no more substeps, and what the slow ones see of it is small."""
    _, droop, lure = random_loop(seed, gain=gain)
    rng = np.random.default_rng([seed, 6])
    tau = rng.permutation(np.resize([1e-3, 0.05, 3.0, 1e6], droop.tau.size))
    droop = Droop(droop.customer, droop.v, droop.q, tau, droop.vbar)
    lure = replace(lure, A=-np.diag(1.0 / tau), G=np.diag(1.0 / tau), phi=droop)
    u = rng.uniform(-0.2, 0.2, lure.F.shape[1])
    x = rng.uniform(-1.0, 1.0, tau.size) * droop.limit
    assert transition(lure, h).substeps <= 140 * (1 + 2 * gain)
    after, size = advance(lure, x, u, h), float(np.max(droop.limit))
    exact = solve_ivp(lambda _, s: right_side(lure, s, u), (0.0, h), x, "LSODA", rtol=1e-8, atol=1e-11 * size)
    assert np.max(np.abs(after - exact.y[:, -1])) < 0.07 * gain * size
    still = (tau < 0.07 * h) & (tau < 1.0)
    assert np.max(np.abs(after - droop(lure.H @ after + lure.F @ u))[still], initial=0.0) < 0.01 * size


@pytest.mark.parametrize("base_kva", [1e-1, 1e2, 1e7, 1e12])
def test_the_base_power_is_anybodys_choice(base_kva: float) -> None:
    """Injections in kvar do not depend on it, however small they are in pu."""
    _, droop, lure = random_loop(2, gain=2.0)
    scale = 100.0 / base_kva
    small = Droop(droop.customer, droop.v, droop.q * scale, droop.tau, droop.vbar)
    same = replace(lure, H=lure.H / scale, C=lure.C / scale, slope=small.slope, phi=small)
    u = np.full(lure.F.shape[1], 0.1)
    for h in (1.0, 900.0):
        wanted = advance(lure, -droop.limit, u, h)
        found = advance(same, -small.limit, u, h) / scale
        assert np.max(np.abs(found - wanted)) < 1e-8 * np.max(droop.limit)


@pytest.mark.parametrize("lead", [(), (3,), (2, 3)])
def test_no_inverters_in_batches(lead: tuple[int, ...]) -> None:
    feeder = random_feeder(4)
    no_meters = fleet(np.array([], dtype=np.intp), [], np.array([]), 100.0)
    lure = close_loop(feeder, no_meters, np.array([0]))
    u = np.zeros((*lead, len(feeder.customers)))
    assert equilibrium(lure, u, tol=1e-10, max_iter=5).shape == (*lead, 0)
    empty = np.zeros((*lead, 0))
    found = settle(lure.phi, np.eye(0), lure.H, drive=empty, bias=empty, x0=empty, tol=1e-10, max_iter=5)
    assert found.shape == (*lead, 0)
    for h in (0.0, 1.0, 900.0):
        assert advance(lure, empty, u, h).shape == (*lead, 0)


@pytest.mark.parametrize("h", [-1.0, np.nan, np.inf])
def test_impossible_steps_are_refused(h: float) -> None:
    _, _, lure = random_loop(2, gain=1.0)
    with refused(InputInvalid, "negative"):
        transition(lure, h)


@given(seed=seeds, gain=st.sampled_from([0.5, 0.99, 1.01, 3.0, 30.0, 300.0]))
def test_equilibrium_rests_at_every_loop_gain(seed: int, gain: float) -> None:
    _, droop, lure = random_loop(seed, gain=gain, preset="vde4105")
    rng = np.random.default_rng([seed, 5])
    u = rng.uniform(-0.3, 0.3, (6, lure.F.shape[1]))
    start = rng.uniform(-1, 1, (6, droop.tau.size)) * droop.limit
    tol = 1e-12 * max(1.0, float(np.max(droop.slope)))  # what rounding in z is worth in x
    x = equilibrium(lure, u, start, tol=tol, max_iter=100)
    assert np.max(np.abs(x - droop(x @ lure.H.T + u @ lure.F.T))) <= tol
    # There is one only: another start ends in the same place.
    other = equilibrium(lure, u, tol=tol, max_iter=100)
    assert np.allclose(x, other, rtol=0, atol=100 * gain * tol)


def test_plain_iteration_diverges_where_newton_does_not() -> None:
    _, droop, lure = random_loop(8, gain=1.6, preset="vde4105")
    u = np.full(lure.F.shape[1], 0.1)
    assert spectral_radius(droop.slope[:, None] * lure.H) > 1.0
    x = np.zeros(droop.tau.size)
    for _ in range(2000):
        x = droop(lure.H @ x + lure.F @ u)
    assert np.max(np.abs(x - droop(lure.H @ x + lure.F @ u))) > 1e-3 * np.max(droop.limit)
    rest = equilibrium(lure, u, tol=1e-12, max_iter=50)
    assert np.max(np.abs(right_side(lure, rest, u))) < 1e-11


def test_equilibrium_minimises_the_potential_of_the_droop() -> None:
    # For symmetric S the rest point minimises x^T S x / 2 - u^T x + sum of the curves' inverse integrals.
    # With a smooth saturation the integral is elementary: for tanh it is x atanh x + ln(1 - x^2) / 2.
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5, 5))
    S, u, eye = root @ root.T, rng.normal(size=5), np.eye(5)
    lure = Lure(-eye, eye, -S, eye, np.zeros((5, 5)), eye, 0 * eye, np.ones(5), np.tanh)
    x = equilibrium(lure, u, tol=1e-13, max_iter=100)

    def potential(x: np.ndarray) -> float:
        return float(x @ S @ x / 2 - u @ x + np.sum(x * np.arctanh(x) + np.log(1 - x**2) / 2))

    best = minimize(potential, np.zeros(5), bounds=[(-1 + 1e-9, 1 - 1e-9)] * 5, method="L-BFGS-B", tol=1e-15)
    assert np.allclose(x, best.x, rtol=0, atol=1e-5)


@given(seeds)
def test_equilibrium_without_symmetry(seed: int) -> None:
    # Symmetric part positive definite, strong skew part, as on cables with single-phase customers.
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    root, skew = rng.normal(size=(n, n)), rng.normal(size=(n, n))
    S = root @ root.T + 0.1 * np.eye(n) + 2.0 * (skew - skew.T)
    droop = fleet(np.arange(n), "vde4105", np.full(n, 20.0), 100.0)
    eye = np.eye(n)
    lure = Lure(-eye, eye, -S, eye, 0 * eye, eye, eye, droop.slope, droop)
    u = rng.uniform(-0.5, 0.5, n)
    x = equilibrium(lure, u, tol=1e-12, max_iter=200)
    assert np.allclose(x, droop(u - S @ x), rtol=0, atol=1e-12)


def test_settle_with_another_feedback_for_every_row() -> None:
    # Observers of different trusted sets: row k hears the model only where it does not trust.
    _, droop, lure = random_loop(8, gain=2.0)
    n = droop.tau.size
    rng = np.random.default_rng(1)
    free = (rng.random((7, n)) < 0.5).astype(float)
    drive = rng.uniform(-0.2, 0.2, (7, n))
    none = np.zeros((7, n))
    together = settle(
        droop, np.eye(n), free[:, :, None] * lure.H, drive=drive, bias=none, x0=none, tol=1e-12, max_iter=100
    )
    for k in range(7):
        assert np.allclose(
            together[k], droop(free[k] * (lure.H @ together[k]) + drive[k]), rtol=0, atol=1e-12
        )


def test_what_cannot_settle_says_so() -> None:
    _, droop, lure = random_loop(8, gain=2.0)
    with refused(DesignInfeasible, "not-converged"):
        equilibrium(lure, np.full(lure.F.shape[1], 0.1), tol=0.0, max_iter=1)
    assert droop.tau.size == lure.slope.size


def test_no_inverters_at_all() -> None:
    feeder = random_feeder(6)
    none = fleet(np.array([], dtype=np.intp), [], np.zeros(0), 100.0)
    lure = close_loop(feeder, none, np.arange(len(feeder.customers)))
    u = np.zeros(len(feeder.customers))
    for h in (0.0, 1.0, 900.0):
        assert advance(lure, np.zeros(0), u, h).shape == (0,)
    assert equilibrium(lure, u, tol=1e-9, max_iter=5).shape == (0,)


def test_strangers_are_refused() -> None:
    feeder = random_feeder(6, customers=2)
    droop = fleet(np.array([0, 2]), "vde4105", np.full(2, 5.0), 100.0)
    with refused(FeederInvalid, "unknown-index", "unknown-index") as caught:
        close_loop(feeder, droop, np.array([5]))
    assert [problem.split(":")[0] for problem in caught.value.problems] == ["inverter 1", "meter 0"]


def test_matrices_must_fit() -> None:
    eye = np.eye(2)
    with refused(InputInvalid, "shape"):
        Lure(eye, eye, np.ones((3, 2)), eye, eye, eye, eye, np.ones(2), np.tanh)


def test_droop_is_the_nonlinearity() -> None:
    _, droop, lure = random_loop(0, gain=0.5)
    assert isinstance(lure.phi, Droop)
    assert lure.phi is droop
