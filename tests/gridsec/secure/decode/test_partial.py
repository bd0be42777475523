"""Decoders on partial observers: bounds that hold, tests that keep their rate, singular covariances."""

from __future__ import annotations

from itertools import combinations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.stats import binom, chi2, kstest

from gridsec.errors import InputInvalid, NotObservable
from gridsec.observers import kalman, luenberger
from gridsec.observers.luenberger import Bounds
from gridsec.secure.decode import Stack, partial_bounded, partial_gaussian
from gridsec.secure.decode.gaussian import design_test
from tests.codes import refused
from tests.gridsec.observers.modal import modal

seeds = st.integers(0, 100_000)
TOL, INSIDE = 1e-8, 1.0 - 1e-6


def plant(seed: int, n: int = 3, p: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """2-redundant detectable: no sensor is blind to more than the fading modes, at most two to others."""
    for shift in range(1000):
        A, B, C = modal(seed + 7919 * shift, n, p, blind=0.25, growth=1.1)
        try:
            bounds = Bounds(0.01, np.full(p, 0.02), np.eye(n))
            observers = luenberger.design(A, B, C, bounds, slowest=INSIDE, tol=TOL, rate=0.9)
            partial_bounded.design(observers, 1, tol=1e-4)
        except NotObservable:
            continue
        return A, B, C
    raise AssertionError("no redundant plant among the draws")


def bounded_design(
    seed: int, *, left_out: int | None = None, scale: np.ndarray | None = None
) -> tuple[partial_bounded.BoundedDesign, np.ndarray, np.ndarray, np.ndarray]:
    A, B, C = plant(seed)
    bounds = Bounds(0.01, np.full(6, 0.02), np.eye(3))
    observers = luenberger.design(A, B, C, bounds, slowest=INSIDE, tol=TOL, rate=0.9)
    return partial_bounded.design(observers, 1, tol=1e-4, left_out=left_out, scale=scale), A, B, C


@given(seeds, st.sampled_from([None, 2]), st.booleans(), st.floats(0.01, 100.0))
@settings(max_examples=30, deadline=None)
def test_theorem_4_3_2_bound_holds_under_every_attack(
    seed: int, left_out: int | None, scaled: bool, size: float
) -> None:
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.5, 3.0, 6) if scaled else None
    made, A, B, C = bounded_design(seed, left_out=left_out, scale=scale)
    liar = int(rng.integers(6))
    x = rng.standard_normal(3)
    guess = x + 0.1 * rng.standard_normal(3)
    state, out = partial_bounded.init(made, 0.0, guess, float(np.linalg.norm(guess - x)))
    for k in range(25):
        assert np.linalg.norm(out.x - x) <= out.bound * (1.0 + 1e-9) + 1e-9 * np.abs(x).max()
        assert out.credible
        assert out.faults <= 1
        d, n = rng.standard_normal(3), rng.uniform(-0.02, 0.02, 6)
        d *= 0.01 / np.linalg.norm(d)
        u = -0.5 * rng.standard_normal(1)
        y = C @ x + n
        # Aimed attacks too: pretend that the state were elsewhere.
        y[liar] += size * rng.standard_normal() if k % 2 else size * (C[liar] @ A @ x)
        state, out = partial_bounded.step(made, state, y, u)
        x = A @ x + B @ u + d


def test_large_attack_is_named_and_small_one_is_harmless() -> None:
    made, A, _, C = bounded_design(3)
    for size, named in ((1e-4, False), (50.0, True)):
        x = np.ones(3)
        state, out = partial_bounded.init(made, 0.0, x, 0.0)
        searched = 0
        for _ in range(30):
            y = C @ x
            y[4] += size
            state, out = partial_bounded.step(made, state, y, np.zeros(1))
            x = A @ x
            searched += out.searched
            assert np.linalg.norm(out.x - x) <= out.bound + 1e-9 * np.abs(x).max()
        assert bool(out.disagree[4]) == named
        assert not np.any(np.delete(out.disagree, 4))
        # Once the liar is out of the trusted set no search is needed any more (Remark 4.4.1).
        assert searched <= 2
        assert np.array_equal(state.trusted, ~out.disagree)


def test_decoding_finds_the_fewest_disagreements_of_all_subsets() -> None:
    made, A, _, C = bounded_design(5, left_out=2)
    x = np.array([1.0, -1.0, 0.5])
    state, _ = partial_bounded.init(made, 0.0, np.zeros(3), 2.0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        y = C @ x + np.where(np.arange(6) == 2, 100.0 * rng.standard_normal(), 0.0)
        state, out = partial_bounded.step(made, state, y, np.zeros(1))
        x = A @ x
        stacked, z = made.decoder.stack, state.observers.z
        fewest = 6
        for size in (4, 5, 6):
            for kept in combinations(range(6), size):
                rows = stacked.rows(kept)
                fit = np.linalg.lstsq(stacked.matrix[rows], z[rows], rcond=None)[0]
                sizes = [
                    np.linalg.norm((z - stacked.matrix @ fit)[stacked.rows([i])]) > out.limits[i]
                    for i in range(6)
                ]
                fewest = min(fewest, sum(sizes))
        assert fewest <= out.faults <= max(1, fewest)


def test_more_liars_than_assumed_are_not_passed_over_in_silence() -> None:
    made, A, _, C = bounded_design(3)
    x, rng = np.ones(3), np.random.default_rng(0)
    state, out = partial_bounded.init(made, 0.0, x, 0.0)
    for _ in range(10):
        y = C @ x + np.where(np.arange(6) < 4, 1e3 * rng.standard_normal(6), 0.0)
        state, out = partial_bounded.step(made, state, y, np.zeros(1))
        x = A @ x
    assert not out.credible
    assert out.faults > 1
    assert np.all(state.trusted)


def test_plants_without_redundancy_are_refused() -> None:
    bounds = Bounds(0.1, np.ones(2), np.eye(2))
    observers = luenberger.design(
        1.1 * np.eye(2), np.zeros((2, 1)), np.eye(2), bounds, slowest=INSIDE, tol=TOL
    )
    with refused(NotObservable, "not-observable"):
        partial_bounded.design(observers, 1, tol=TOL)
    with refused(InputInvalid, "not-positive"):
        partial_bounded.design(observers, 1, tol=TOL, scale=np.zeros(2))
    filters = kalman.design(
        1.1 * np.eye(2), np.zeros((2, 1)), np.eye(2), np.eye(2), np.eye(2), slowest=INSIDE, tol=TOL
    )
    with refused(NotObservable, "not-observable"):
        partial_gaussian.design(filters, 1, false_alarm=0.01, tol=1e-10)
    with refused(InputInvalid, "out-of-range"):
        partial_gaussian.design(filters, 1, false_alarm=0.0, tol=1e-10)
    # Two sensors that agree by construction: each alone fixes x, and nothing can contradict it.
    with refused(NotObservable, "no-redundancy"):
        partial_gaussian.parity(Stack.of([np.eye(2), np.eye(2)]), np.array([0]), tol=TOL)
    with refused(NotObservable, "not-observable"):
        partial_gaussian.parity(Stack.of([np.eye(2)[:1], np.eye(2)[:1]]), np.array([0, 1]), tol=TOL)


def random_stack(rng: np.random.Generator) -> Stack:
    return Stack.of([rng.standard_normal((int(rng.integers(1, 4)), 3)) for _ in range(5)])


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_fusion_is_the_minimum_variance_estimate_where_the_covariance_is_regular(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stacked = random_stack(rng)
    N = stacked.matrix.shape[0]
    root = rng.standard_normal((N, N)) * rng.uniform(0.1, 10.0, N)[:, None]
    P = root @ root.T + 1e-2 * np.eye(N)
    for kept in (np.arange(5), np.array([0, 1, 3, 4])):
        if stacked.rows(kept).size <= 3:
            continue
        expected = design_test(stacked, P, kept)
        ours = partial_gaussian.fuse(partial_gaussian.parity(stacked, kept, tol=TOL), P, tol=1e-13)
        assert ours.freedom == expected.freedom
        assert np.allclose(ours.estimator, expected.estimator, rtol=1e-5, atol=1e-6)
        assert np.allclose(ours.covariance, expected.covariance, rtol=1e-5, atol=1e-6)
        z = rng.standard_normal(N)
        one, other = np.sum((ours.standardise @ z) ** 2), np.sum((expected.standardise @ z) ** 2)
        assert np.isclose(one, other, rtol=1e-5)


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_fusion_with_singular_covariance_against_constrained_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stacked = random_stack(rng)
    N = stacked.matrix.shape[0]
    if N < 7:
        return
    root = rng.standard_normal((N, N - 2))
    P = root @ root.T
    ours = partial_gaussian.fuse(partial_gaussian.parity(stacked, np.arange(5), tol=TOL), P, tol=1e-12)
    # Oracle: minimise |u| over x, u with z = Phi x + root u, by its KKT system.
    z = stacked.matrix @ rng.standard_normal(3) + root @ rng.standard_normal(N - 2)
    m = N - 2
    kkt = np.block(
        [
            [np.eye(m), np.zeros((m, 3)), root.T],
            [np.zeros((3, m)), np.zeros((3, 3)), stacked.matrix.T],
            [root, stacked.matrix, np.zeros((N, N))],
        ]
    )
    solution = np.linalg.lstsq(kkt, np.concatenate([np.zeros(m + 3), z]), rcond=1e-13)[0]
    assert np.allclose(ours.estimator @ z, solution[m : m + 3], rtol=1e-5, atol=1e-5)
    g = float(np.sum((ours.standardise @ z) ** 2))
    assert np.isclose(g, solution[:m] @ solution[:m], rtol=1e-4, atol=1e-5)
    # [Phi root] has full rank: no parity is exact, and the rank is that of the parities.
    assert ours.freedom == N - 3


def test_exact_parities_are_no_degrees_of_freedom_and_catch_every_violation() -> None:
    stacked = Stack.of([np.eye(1)] * 4)
    # Sensors 0 and 1 make the same error.
    P = np.eye(4)
    P[0, 1] = P[1, 0] = 1.0
    ours = partial_gaussian.fuse(partial_gaussian.parity(stacked, np.arange(4), tol=TOL), P, tol=1e-10)
    assert ours.freedom == 2
    assert np.allclose(ours.estimator, [[1 / 6, 1 / 6, 1 / 3, 1 / 3]])
    assert np.isclose(ours.covariance[0, 0], 1 / 3)
    rng = np.random.default_rng(0)
    errors = rng.standard_normal((20_000, 4))
    errors[:, 1] = errors[:, 0]
    g = np.sum((errors @ ours.standardise.T) ** 2, axis=1)
    assert kstest(g, chi2(2).cdf).pvalue > 1e-3
    spoiled = errors[0] + np.array([1e-3, 0.0, 0.0, 0.0])
    assert np.sum((ours.standardise @ spoiled) ** 2) > 1e3


def gaussian_case(
    seed: int, **options: object
) -> tuple[partial_gaussian.GaussianDesign, kalman.KalmanDesign, np.ndarray, np.ndarray, np.ndarray]:
    A, B, C = plant(seed)
    filters = kalman.design(A, B, C, 0.01 * np.eye(3), 0.04 * np.eye(6), slowest=INSIDE, tol=TOL)
    made = partial_gaussian.design(filters, 1, tol=1e-10, **{"false_alarm": 0.01, **options})  # type: ignore[arg-type]
    return made, filters, A, B, C


def test_false_alarm_rate_is_the_one_asked_for_and_the_printed_degrees_of_freedom_miss_it() -> None:
    made, filters, A, B, C = gaussian_case(1)
    runs, steps, delta = 4000, 6, 0.05
    rng = np.random.default_rng(1)
    x = rng.standard_normal((runs, 3))
    state = kalman.correct(
        filters,
        kalman.init(filters, 0.0, np.zeros((runs, 3)), np.eye(3)),
        x @ C.T + 0.2 * rng.standard_normal((runs, 6)),
    )
    alarms = printed = total = 0
    for _ in range(steps):
        u = rng.standard_normal((runs, 1))
        x = x @ A.T + u @ B.T + 0.1 * rng.standard_normal((runs, 3))
        state = kalman.step(filters, state, x @ C.T + 0.2 * rng.standard_normal((runs, 6)), u)
        fused = partial_gaussian.fuse(made.sets[0], state.P, tol=1e-10)
        g = np.sum((state.z @ fused.standardise.T) ** 2, axis=1)
        here = int(np.count_nonzero(g > chi2.isf(delta, fused.freedom)))
        # Runs are independent of each other, steps of a run are not.
        assert binom.ppf(1e-4, runs, delta) <= here <= binom.isf(1e-4, runs, delta)
        alarms, total = alarms + here, total + runs
        printed += int(np.count_nonzero(g > chi2.isf(delta, state.z.shape[1])))
        errors = state.z @ fused.estimator.T - x
        nees = np.einsum("ri,ij,rj->r", errors, np.linalg.inv(fused.covariance), errors)
        low, high = chi2.ppf([5e-4, 1.0 - 5e-4], 3 * runs) / runs
        assert low < nees.mean() < high
    assert abs(alarms / total - delta) < 0.1 * delta
    assert printed < 0.5 * alarms


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_no_fusion_beats_the_filter_of_all_sensors_and_it_beats_every_smaller_set(seed: int) -> None:
    made, filters, A, _, C = gaussian_case(seed)
    state = kalman.correct(filters, kalman.init(filters, 0.0, np.zeros(3), np.eye(3)), np.zeros(6))
    best = np.eye(3)
    for k in range(8):
        if k:
            state = kalman.step(filters, state, np.zeros(6), np.zeros(1))
            best = A @ best @ A.T + 0.01 * np.eye(3)
        gain = best @ C.T @ np.linalg.inv(C @ best @ C.T + 0.04 * np.eye(6))
        best = (np.eye(3) - gain @ C) @ best
        every = partial_gaussian.fuse(made.sets[0], state.P, tol=1e-10).covariance
        # The floor of exact parities costs the square root of its size.
        slack = 1e-4 * np.max(np.abs(every))
        assert np.linalg.eigvalsh(every - best)[0] > -slack
        for smaller in made.sets[1:]:
            fewer = partial_gaussian.fuse(smaller, state.P, tol=1e-10).covariance
            assert np.linalg.eigvalsh(fewer - every)[0] > -slack


@pytest.mark.parametrize("rule", ["density", "tail"])
def test_attack_is_noticed_left_out_and_readmitted_afterwards(rule: str) -> None:
    made, _, A, B, C = gaussian_case(6, false_alarm=1e-6, readmit=10, refresh=1e-3, rule=rule)
    assert made.filters.stack.parts[3].t.size > 0
    rng = np.random.default_rng(5)
    x = np.zeros(3)
    state, out = partial_gaussian.init(made, 0.0, x, 0.01 * np.eye(3), C @ x + 0.2 * rng.standard_normal(6))
    named = []
    for k in range(120):
        u = np.zeros(1)
        x = A @ x + B @ u + 0.1 * rng.standard_normal(3)
        y = C @ x + 0.2 * rng.standard_normal(6)
        if 40 <= k < 60:
            y[3] += 10.0 * (1.0 + 0.1 * k)
        state, out = partial_gaussian.step(made, state, y, u)
        named.append(np.flatnonzero(~out.trusted).tolist())
        error = out.x - x
        assert error @ np.linalg.solve(out.covariance, error) < chi2.isf(1e-7, 3)
        assert out.credible
        assert out.threshold == pytest.approx(chi2.isf(1e-6, out.freedom))
        assert out.alarm == (out.g > out.threshold)
        if k < 40:
            # While the test passes nothing else is computed (Remark 4.4.1).
            assert all(other is None for other in state.tables.fused[1:])
        if k == 40:
            # The estimate of the alarming step is already the new set's.
            assert out.alarm
    assert all(n == [] for n in named[:40])
    assert all(n == [3] for n in named[40:60])
    assert named[-1] == []


def test_tables_are_refreshed_as_asked_and_steady_filters_keep_them() -> None:
    made, filters, _, _, C = gaussian_case(2, refresh=0.0)
    lazy, *_ = gaussian_case(2, refresh=0.05)
    long = kalman.steady(filters)
    fixed, *_ = gaussian_case(2, steady=long)
    rng = np.random.default_rng(0)
    y = [0.2 * rng.standard_normal(6) for _ in range(40)]
    states = []
    for design in (made, lazy, fixed):
        state, _ = partial_gaussian.init(design, 0.0, np.zeros(3), 0.01 * np.eye(3), y[0])
        before, rebuilt = state.tables, 0
        for reading in y[1:]:
            state, out = partial_gaussian.step(design, state, reading, np.zeros(1))
            rebuilt += state.tables.P is not before.P
            before = state.tables
        states.append((rebuilt, state, out))
    (every, exact, sharp), (some, _, rough), (none, at_rest, settled) = states
    assert every >= some > none == 0
    # Within the tolerance of the refresh; and both filters have converged to the same.
    assert np.isclose(sharp.g, rough.g, rtol=0.2)
    assert np.allclose(exact.filters.P, at_rest.filters.P, rtol=1e-3, atol=1e-6)
    assert np.allclose(sharp.covariance, settled.covariance, rtol=1e-2)
    with refused(InputInvalid, "missing"):
        partial_gaussian.step(fixed, at_rest, C @ np.zeros(3), np.zeros(1), np.arange(6) > 0)
    with refused(InputInvalid, "missing"):
        partial_gaussian.init(fixed, 0.0, np.zeros(3), np.eye(3), y[0], seen=np.arange(6) > 0)
    with refused(InputInvalid, "missing"):
        partial_gaussian.step(fixed, at_rest, np.where(np.arange(6) > 0, 0.0, np.nan), np.zeros(1))


def test_silent_sensor_does_not_alarm_and_its_reading_does_not_matter() -> None:
    made, _, A, _, C = gaussian_case(2, false_alarm=1e-6)
    outs = []
    for junk in (np.nan, 1e6):
        rng = np.random.default_rng(8)
        x = np.zeros(3)
        state, out = partial_gaussian.init(made, 0.0, x, 0.01 * np.eye(3), 0.2 * rng.standard_normal(6))
        for k in range(30):
            x = A @ x + 0.1 * rng.standard_normal(3)
            y = C @ x + 0.2 * rng.standard_normal(6)
            seen = np.arange(6) != (2 if 10 <= k < 20 else 9)
            state, out = partial_gaussian.step(made, state, np.where(seen, y, junk), np.zeros(1), seen)
            assert not out.alarm
        outs.append(out)
    assert np.array_equal(outs[0].x, outs[1].x)


def test_one_reading_that_is_no_number_silences_nobody() -> None:
    """The next gross lie is found as if the reading had only been missing."""
    gauss, *_ = gaussian_case(2, false_alarm=1e-6)
    bound, *_ = bounded_design(3)
    first, _ = partial_gaussian.init(gauss, 0.0, np.zeros(3), 0.01 * np.eye(3), np.zeros(6))
    second, _ = partial_bounded.init(bound, 0.0, np.zeros(3), 0.1)
    at = np.arange(6)
    for y in (np.where(at == 0, np.nan, 0.0), np.zeros(6), np.where(at == 1, 500.0, 0.0)):
        first, out = partial_gaussian.step(gauss, first, y, np.zeros(1))
        second, other = partial_bounded.step(bound, second, y, np.zeros(1))
        lie = bool(y[1])
        assert out.alarm == lie
        assert out.trusted[1] != lie
        assert other.disagree[1] == lie
        for one in (out, other):
            assert np.all(np.isfinite(one.x))
            assert one.credible


def test_an_estimate_that_is_no_number_is_not_credible() -> None:
    gauss, *_ = gaussian_case(2)
    bound, *_ = bounded_design(3)
    first, _ = partial_gaussian.init(gauss, 0.0, np.zeros(3), 0.01 * np.eye(3), np.zeros(6))
    second, _ = partial_bounded.init(bound, 0.0, np.zeros(3), 0.1)
    _, out = partial_gaussian.step(gauss, first, np.zeros(6), np.array([np.nan]))
    _, other = partial_bounded.step(bound, second, np.zeros(6), np.array([np.nan]))
    assert out.alarm
    assert not out.credible
    assert other.disagree.all()
    assert not other.credible
