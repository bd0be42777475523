"""Decomposition against ranks, eigenvectors and indices; observers and bounds against plain recursions."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.linalg import null_space

from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers import luenberger
from gridsec.observers.luenberger import Bounds, envelope, geometric, riccati_gain
from gridsec.observers.parts import decompose, stack
from gridsec.secure.decode import Stack, cospark
from gridsec.secure.index import asymptotic_index, dynamic_index, observable_rows, undetectable_subspace
from tests.codes import refused
from tests.gridsec.observers.modal import modal

seeds = st.integers(0, 100_000)
TOL = 1e-8
INSIDE = 1.0 - 1e-6


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """Distance of the spaces spanned by two orthonormal bases; 1 if their dimensions differ."""
    if one.shape[1] != other.shape[1]:
        return 1.0
    return float(np.linalg.norm(one @ one.T - other @ other.T, 2))


@given(seeds, st.sampled_from([0.0, 0.4, 0.7, INSIDE]))
@settings(max_examples=60, deadline=None)
def test_decomposition_has_the_blocks_of_the_paper(seed: int, slowest: float) -> None:
    A, _, C = modal(seed)
    for c, part in zip(C, decompose(A, C, slowest=slowest, tol=TOL), strict=True):
        whole = np.hstack([part.observable, part.fading, part.hidden])
        assert np.allclose(whole.T @ whole, np.eye(5), atol=1e-12)
        o, d, w = part.observable, part.fading, part.hidden
        for zero in (o.T @ A @ d, o.T @ A @ w, d.T @ A @ w, c[None] @ d, c[None] @ w):
            assert np.allclose(zero, 0.0, atol=1e-6)
        # Nothing seen is lost, nothing kept unseen is slow, nothing hidden is fast.
        assert np.linalg.matrix_rank(observable_rows(A, c[None], tol=TOL)[0]) == o.shape[1]
        unseen = np.linalg.eigvals(d.T @ A @ d) if d.size else np.zeros(0)
        assert np.all(np.abs(unseen) < slowest)
        slow = np.linalg.eigvals(w.T @ A @ w) if w.size else np.zeros(0)
        assert np.all(np.abs(slow) >= slowest - 1e-6)
        assert np.array_equal(part.S, part.basis.T @ A @ part.basis)
        assert np.array_equal(part.t, c @ part.basis)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_hidden_part_is_the_unobservable_or_the_undetectable_subspace(seed: int) -> None:
    A, _, C = modal(seed)
    # Powers of A, which this project's code avoids, are the definition.
    for c, part in zip(C, decompose(A, C, slowest=0.0, tol=TOL), strict=True):
        G = np.stack([c @ np.linalg.matrix_power(A, k) for k in range(5)])
        assert angle(part.hidden, null_space(G, rcond=1e-7)) < 1e-5
    for c, part in zip(C, decompose(A, C, slowest=INSIDE, tol=TOL), strict=True):
        expected = undetectable_subspace(A, c[None], discrete=True, tol=1e-7)
        assert angle(part.hidden, expected) < 1e-5


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_proposition_4_3_1_fewest_observers_that_see_a_state_is_the_security_index(seed: int) -> None:
    A, B, C = modal(seed)
    fading = stack(decompose(A, C, slowest=INSIDE, tol=TOL), B)
    assert (
        cospark(Stack.of(fading.blocks), tol=1e-6).count
        == asymptotic_index(A, C, discrete=True, tol=1e-7).count
    )
    plain = stack(decompose(A, C, slowest=0.0, tol=TOL), B)
    assert cospark(Stack.of(plain.blocks), tol=1e-6).count == dynamic_index(A, C, tol=1e-7).count


def test_stack_holds_each_sensor_apart() -> None:
    A, B, C = modal(3)
    C[2] = 0.0
    parts = decompose(A, C, slowest=0.0, tol=TOL)
    whole = stack(parts, B)
    assert parts[2].t.size == 0
    assert whole.blocks[2].shape == (0, 5)
    for i, part in enumerate(parts):
        at = whole.rows(i)
        assert np.array_equal(whole.phi[at], part.basis.T)
        assert np.array_equal(whole.S[at, at], part.S)
        assert np.array_equal(whole.T[i, at], part.t)
    assert np.count_nonzero(whole.S) <= sum(part.t.size**2 for part in parts)
    assert np.array_equal(whole.G, whole.phi @ B)


def test_bad_pairs_are_refused() -> None:
    with refused(InputInvalid, "shape"):
        decompose(np.eye(3), np.ones((2, 4)), slowest=0.0, tol=TOL)
    with refused(InputInvalid, "out-of-range"):
        decompose(np.eye(3), np.ones((2, 3)), slowest=1.1, tol=TOL)


@given(st.floats(0.2, 2.0), st.floats(0.1, 3.0), st.floats(0.01, 10.0), st.floats(0.01, 10.0))
def test_scalar_riccati_gain_has_its_closed_form(a: float, c: float, q: float, r: float) -> None:
    part = decompose(np.array([[a]]), np.array([[c]]), slowest=0.0, tol=TOL)[0]
    gain = riccati_gain(part, np.array([[q]]), r, rate=1.0)
    # c^2 P^2 + (r - a^2 r - q c^2) P - q r = 0
    middle = r - a**2 * r - q * c**2
    P = (-middle + np.sqrt(middle**2 + 4.0 * c**2 * q * r)) / (2.0 * c**2)
    expected = a * P * c / (c**2 * P + r)
    assert np.isclose((part.basis @ gain)[0], expected, rtol=1e-6)


@given(seeds, st.sampled_from([0.95, 0.7, 0.4]))
@settings(max_examples=30, deadline=None)
def test_prescribed_decay_is_met_by_what_is_seen(seed: int, rate: float) -> None:
    A, _, C = modal(seed)
    for part in decompose(A, C, slowest=INSIDE, tol=TOL):
        gain = riccati_gain(part, np.eye(5), 1.0, rate=rate)
        nu = part.observable.shape[1]
        F = part.S - np.outer(gain, part.t)
        assert np.max(np.abs(np.linalg.eigvals(F[:nu, :nu])), initial=0.0) < rate
        assert np.all(gain[nu:] == 0.0)
        assert np.max(np.abs(np.linalg.eigvals(F)), initial=0.0) < 1.0


def designed(seed: int, *, slowest: float = INSIDE, rate: float = 0.9) -> luenberger.LuenbergerDesign:
    A, B, C = modal(seed)
    E = np.random.default_rng(seed + 1).standard_normal((5, 2))
    bounds = Bounds(0.3, np.linspace(0.1, 0.5, 5), E)
    return luenberger.design(A, B, C, bounds, slowest=slowest, tol=TOL, rate=rate, period=0.5)


def test_observers_follow_the_printed_recursion_and_attacks_stay_where_they_are() -> None:
    A, B, C = modal(7)
    made = luenberger.design(
        A, B, C, Bounds(0.3, np.full(5, 0.1), np.eye(5)), slowest=INSIDE, tol=TOL, rate=0.9, period=0.5
    )
    rng = np.random.default_rng(0)
    honest = attacked = luenberger.init(made, 10.0, np.zeros(5))
    single = [made.stack.phi[made.stack.rows(i)] @ np.zeros(5) for i in range(5)]
    for _ in range(20):
        y, u = rng.standard_normal(5), rng.standard_normal(1)
        lie = np.array([0.0, 0.0, 5.0, 0.0, 0.0])
        for i, part in enumerate(made.stack.parts):
            L = made.L[made.stack.rows(i), i]
            single[i] = part.S @ single[i] + part.basis.T @ B @ u + L * (y[i] - part.t @ single[i])
        honest = luenberger.step(made, honest, y, u)
        attacked = luenberger.step(made, attacked, y + lie, u)
    assert np.allclose(honest.z, np.concatenate(single), rtol=1e-10, atol=1e-10)
    assert np.isclose(honest.t, 20.0)
    for i in range(5):
        same = np.array_equal(honest.z[made.stack.rows(i)], attacked.z[made.stack.rows(i)])
        assert same == (i != 2)


@given(seeds, st.booleans(), st.booleans())
@settings(max_examples=25, deadline=None)
def test_honest_errors_stay_within_the_bound_also_with_readings_missing(
    seed: int, worst: bool, missing: bool
) -> None:
    A, B, C = modal(seed)
    made = designed(seed)
    rng = np.random.default_rng(seed)
    runs = 20
    x = rng.standard_normal((runs, 5))
    guess = x + rng.standard_normal((runs, 5))
    start = float(np.max(np.linalg.norm(guess - x, axis=1)))
    state = luenberger.init(made, 0.0, guess, start)
    always = np.tile([0.18, 0.24], (runs, 1))
    for _ in range(80):
        wobble = rng.standard_normal((runs, 2))
        wobble *= 0.3 / np.linalg.norm(wobble, axis=1, keepdims=True)
        n = rng.choice([-1.0, 1.0], (runs, 5)) * made.bounds.noise
        if worst:
            # Always push the same way.
            wobble, n = always, np.broadcast_to(made.bounds.noise, (runs, 5))
        seen = rng.uniform(size=5) < 0.8 if missing else None
        u = rng.standard_normal((runs, 1))
        y = x @ C.T + n
        if seen is not None:
            y = np.where(seen, y, np.nan)
        state = luenberger.step(made, state, y, u, seen)
        x = x @ A.T + u @ B.T + wobble @ made.bounds.E.T
        error = state.z - x @ made.stack.phi.T
        limit = luenberger.bound(made, state)
        for i in range(5):
            sizes = np.linalg.norm(error[:, made.stack.rows(i)], axis=1)
            assert sizes.max() <= limit[i] * (1.0 + 1e-9) + 1e-7 * np.abs(x).max()


@pytest.mark.acceptance
@given(seeds)
@settings(max_examples=20, deadline=None)
def test_envelope_and_the_papers_own_bound_all_powers_and_sums(seed: int) -> None:
    made = designed(seed)
    for i, (part, env) in enumerate(zip(made.stack.parts, made.envelopes, strict=True)):
        if not part.t.size:
            assert env.limit == 0.0
            continue
        L = made.L[made.stack.rows(i), i]
        F = part.S - np.outer(L, part.t)
        for k in (0, 1, 2, 5, 17, 64, 129, 300):
            size = float(np.linalg.norm(np.linalg.matrix_power(F, k), 2))
            assert size <= env.growth(k) * (1.0 + 1e-9) + 1e-15
        tail, into, drift = 0.0, L, part.basis.T @ made.bounds.E
        for _ in range(400):
            tail += np.linalg.norm(into) * made.bounds.noise[i] + np.linalg.norm(drift, 2) * 0.3
            into, drift = F @ into, F @ drift
        assert tail <= env.limit * (1.0 + 1e-9)
        assert env.limit <= 2.0 * tail
        radius = float(np.max(np.abs(np.linalg.eigvals(F))))
        for share in (0.3, 0.8):
            beta = radius + share * (1.0 - radius)
            printed = geometric(part, L, 0.3, float(made.bounds.noise[i]), made.bounds.E, beta=beta)
            assert tail <= printed.limit * (1.0 + 1e-9)
            assert env.limit <= printed.limit / (1.0 - env.powers[-1]) * (1.0 + 1e-9)
            # eta_F, eta_L, eta_Z by their definition: the smallest that fit beta.
            eta, power = np.zeros(3), np.eye(len(F))
            for k in range(120):
                sizes = [np.linalg.norm(power, 2), np.linalg.norm(power @ L)]
                sizes.append(np.linalg.norm(power @ part.basis.T @ made.bounds.E, 2))
                eta, power = np.maximum(eta, np.array(sizes) / beta**k), power @ F
            assert printed.growth(0) == pytest.approx(eta[0], rel=1e-9)
            limit = (eta[1] * made.bounds.noise[i] + eta[2] * 0.3) / (1.0 - beta)
            assert printed.limit == pytest.approx(limit, rel=1e-9)
            for k in (0, 3, 40, 200):
                size = float(np.linalg.norm(np.linalg.matrix_power(F, k), 2))
                assert size <= printed.growth(k) * (1.0 + 1e-9) + 1e-15


def test_limit_is_reached_by_a_scalar_observer() -> None:
    part = decompose(np.array([[0.9]]), np.array([[1.0]]), slowest=0.0, tol=TOL)[0]
    env = envelope(part, np.array([0.5]) * part.basis[0], 0.2, 0.1, np.eye(1))
    # |v| -> (0.5 * 0.1 + 0.2) / (1 - 0.4)
    assert np.isclose(env.limit, 0.25 / 0.6, rtol=1e-9)
    with refused(InputInvalid, "out-of-range"):
        geometric(part, np.array([0.5]), 0.2, 0.1, np.eye(1), beta=0.1)


def test_a_step_without_a_reading_costs_what_the_model_says() -> None:
    """A scalar: the bound is |S| times the last one plus d_max, and that is reached."""
    bounds = Bounds(0.2, np.array([0.1]), np.eye(1))
    made = luenberger.design(np.array([[0.9]]), np.zeros((1, 1)), np.eye(1), bounds, slowest=0.0, tol=TOL)
    state, error = luenberger.init(made, 0.0, np.zeros(1), 0.5), 0.5
    before = luenberger.bound(made, state)
    after = luenberger.step(made, state, np.full(1, np.nan), np.zeros(1), np.zeros(1, dtype=bool))
    assert after.origin == pytest.approx(0.9 * before + 0.2)
    assert np.all(after.origin >= 0.9 * error + 0.2)
    assert luenberger.bound(made, after) == pytest.approx(after.origin + made.envelopes[0].limit)


def test_masked_sensor_has_no_influence_and_batch_equals_single() -> None:
    made = designed(11)
    rng = np.random.default_rng(1)
    guesses, y, u = rng.standard_normal((3, 5)), rng.standard_normal((3, 5)), rng.standard_normal((3, 1))
    seen = np.array([True, False, True, True, True])
    gaps = np.where(seen, y, np.nan)
    batch = luenberger.step(made, luenberger.init(made, 0.0, guesses, 1.0), gaps, u, seen)
    for r in range(3):
        other = y[r].copy()
        other[1] = 1e9
        one = luenberger.step(made, luenberger.init(made, 0.0, guesses[r], 1.0), other, u[r], seen)
        assert np.allclose(one.z, batch.z[r], rtol=1e-12, atol=1e-12)
    assert np.all(np.isfinite(batch.z))
    full = luenberger.step(made, luenberger.init(made, 0.0, guesses, 1.0), y, u, np.ones(5, dtype=bool))
    assert np.allclose(full.z, luenberger.step(made, luenberger.init(made, 0.0, guesses, 1.0), y, u).z)


def test_a_reading_that_is_not_finite_counts_as_unseen() -> None:
    made = designed(11)
    start = luenberger.init(made, 0.0, np.arange(5.0), 1.0)
    y, seen = np.arange(5.0), np.array([True, False, True, True, True])
    expected = luenberger.step(made, start, y, np.zeros(1), seen)
    for junk in (np.nan, -np.inf):
        found = luenberger.step(made, start, np.where(seen, y, junk), np.zeros(1))
        assert np.array_equal(found.z, expected.z)
        assert np.array_equal(found.origin, expected.origin)


def test_unknown_start_has_no_bound_ever() -> None:
    made = designed(11)
    state = luenberger.init(made, 0.0, np.zeros(5))
    for _ in range(3):
        state = luenberger.step(made, state, np.zeros(5), np.zeros(1))
    far = luenberger.LuenbergerState(state.t, state.z, state.origin, np.full(5, 10**9))
    assert np.all(np.isinf(luenberger.bound(made, far)) | (np.diff(made.stack.first) == 0))


def test_designs_that_do_not_work_are_refused() -> None:
    A, B, C = np.diag([1.1, 0.5]), np.zeros((2, 1)), np.array([[1.0, 1.0]])
    bounds = Bounds(0.1, np.array([0.1]), np.eye(2))
    with refused(DesignInfeasible, "unstable"):
        luenberger.design(A, B, C, bounds, slowest=0.0, tol=TOL, gains=[np.zeros(2)])
    with refused(InputInvalid, "shape"):
        luenberger.design(A, B, C, bounds, slowest=0.0, tol=TOL, gains=[np.zeros(1)])
    with refused(InputInvalid, "negative"):
        luenberger.design(A, B, C, Bounds(-1.0, np.array([0.1]), np.eye(2)), slowest=0.0, tol=TOL)
    with refused(InputInvalid, "negative"):
        luenberger.design(A, B, C, Bounds(0.1, np.array([np.nan]), np.eye(2)), slowest=0.0, tol=TOL)
    with refused(InputInvalid, "not-positive"):
        luenberger.design(A, B, C, Bounds(0.1, np.zeros(1), np.eye(2)), slowest=0.0, tol=TOL)
    with refused(InputInvalid, "shape"):
        luenberger.design(A, B, C, Bounds(0.1, np.ones(2), np.eye(2)), slowest=0.0, tol=TOL)
    with refused(InputInvalid, "out-of-range"):
        riccati_gain(decompose(A, C, slowest=0.0, tol=TOL)[0], np.eye(2), 1.0, rate=0.0)
    # A mode on the circle that no disturbance moves: the Riccati gain vanishes there.
    still = Bounds(0.0, np.array([0.1]), np.eye(2))
    with refused(DesignInfeasible, "unstable"):
        luenberger.design(np.diag([1.0, 0.5]), B, C, still, slowest=0.0, tol=TOL)
    # Errors that take a million steps to fade.
    crawl = [np.array([1e-7])]
    with refused(DesignInfeasible, "not-converged"):
        luenberger.design(
            np.array([[1.0]]),
            B[:1],
            np.eye(1),
            Bounds(0.1, np.ones(1), np.eye(1)),
            slowest=0.0,
            tol=TOL,
            gains=crawl,
        )
