"""Intervals, Lipschitz constants, left inverses and redundancy, against closed forms and brute force."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares, linprog

from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.observers.high_gain import System, linear, nearest, redundancy
from gridsec.observers.high_gain import given as given_inverse
from gridsec.observers.high_gain.form import sat
from gridsec.observers.high_gain.intervals import Interval, interval, supremum
from gridsec.observers.high_gain.redundancy import (
    block_distance,
    check,
    corners_and_interior,
    correctable,
    detectable,
    extend,
    groups,
    kappa_detect,
    kappa_error,
    lower_from_inverse,
    lower_proven,
    lower_sampled,
    upper_proven,
    upper_sampled,
)
from gridsec.papers import kim2018 as example
from tests.codes import refused

FUNCTIONS: list[Callable[[Any, Any], Any]] = [
    lambda a, b: a + b * a - 3.0,
    lambda a, b: np.sin(3.0 * a) * np.cos(b) - a**3,
    lambda a, b: np.exp(-(a**2)) / (2.0 + np.tanh(b)),
    lambda a, b: np.absolute(a - b) ** 2 + np.square(b) - np.arctan(a),
    lambda a, b: np.maximum(a, -b) * np.minimum(a * b, 0.5),
    lambda a, b: (1.5 + np.sinh(b)) ** -2 + (+a) * (-b),
    lambda a, b: np.cos(40.0 * a) + np.sin(a - 25.0 * b),
]


@settings(max_examples=200, deadline=None)
@given(
    which=st.integers(0, len(FUNCTIONS) - 1),
    ends=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
    place=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
)
def test_intervals_hold_every_value_inside(
    which: int, ends: tuple[float, ...], place: tuple[float, float]
) -> None:
    (a, b), (c, d) = sorted(ends[:2]), sorted(ends[2:])
    box = FUNCTIONS[which](Interval(np.array(a), np.array(b)), Interval(np.array(c), np.array(d)))
    x, y = min(a + place[0] * (b - a), b), min(c + place[1] * (d - c), d)
    value = FUNCTIONS[which](np.float64(x), np.float64(y))
    assert box.lo <= value <= box.hi


def test_intervals_are_tight_where_they_can_be() -> None:
    wave = np.sin(Interval(np.array(0.0), np.array(np.pi)))
    assert wave.hi == 1.0
    assert wave.lo == pytest.approx(0.0, abs=1e-15)
    square = Interval(np.array(-2.0), np.array(1.0)) ** 2
    assert (square.lo, square.hi) == (0.0, pytest.approx(4.0))
    zero = 1.0 / Interval(np.array(-1.0), np.array(1.0))
    assert (zero.lo, zero.hi) == (-np.inf, np.inf)
    assert "Interval" in repr(interval(1.0))


def test_what_is_not_covered_is_refused() -> None:
    with pytest.raises(TypeError):
        np.log(Interval(np.array(1.0), np.array(2.0)))
    with refused(InputInvalid, "not-integer"):
        Interval(np.array(1.0), np.array(2.0)) ** 0.5


def test_suprema_against_closed_forms() -> None:
    peak = supremum(lambda x: x[0] * np.sin(x[0]), np.array([0.0]), np.array([3.0]), gap=1e-6)
    # d/dx (x sin x) = 0 at tan x = -x: x = 2.02875783811043, value 1.81970574115965.
    assert peak.lower <= 1.81970574115965 * (1.0 + 1e-12)
    assert peak.upper >= 1.81970574115965
    assert peak.upper - peak.lower <= 2e-6 * peak.lower
    saddle = supremum(lambda x: x[0] * x[1] - x[2] ** 2, -np.ones(3), np.ones(3), gap=1e-3)
    assert saddle.upper == pytest.approx(1.0, rel=2e-3)
    assert saddle.upper >= 1.0
    few = supremum(lambda x: x[0] - x[0], -np.ones(1), np.ones(1), gap=1e-9, most=4)
    assert few.upper >= 0.0  # stopped early: wide, but right


def test_lipschitz_constants_of_a_linear_map() -> None:
    rng = np.random.default_rng(0)
    T = rng.normal(size=(5, 3))
    box = np.ones(3)
    exact = np.abs(T).sum(axis=1).max()
    assert upper_proven(lambda _: T.tolist(), -box, box).upper == pytest.approx(exact, rel=1e-9)
    seen = upper_sampled(lambda x: x @ T.T, -box, box)
    assert seen.lower <= exact * (1.0 + 1e-9)
    assert seen.lower >= 0.95 * exact
    # Lip_ of T in the largest-entry norm, by linear programming over the faces |d_k| = 1.
    lowest = np.inf
    for k in range(3):
        A = np.vstack([np.hstack([T, -np.ones((5, 1))]), np.hstack([-T, -np.ones((5, 1))])])
        bounds = [(1.0, 1.0) if j == k else (-1.0, 1.0) for j in range(3)] + [(0.0, None)]
        lowest = min(lowest, linprog([0, 0, 0, 1], A_ub=A, b_ub=np.zeros(10), bounds=bounds).fun)
    proven = lower_proven(lambda _: T.tolist(), -box, box).lower
    sampled = lower_sampled(lambda x: x @ T.T, -box, box).upper
    assert 0.0 < proven <= lowest * (1.0 + 1e-9)
    assert sampled >= lowest * (1.0 - 1e-6)
    B = np.linalg.pinv(T)
    assert lower_from_inverse(upper_proven(lambda _: B.tolist(), -np.ones(5), np.ones(5))).lower <= lowest
    x = rng.uniform(-1.0, 1.0, (50, 3))
    assert np.allclose(sat(x @ T.T @ B.T, 1.0), x), "sat(T^+ y, 1) is a Lipschitz-extended left inverse"


def test_lower_constant_of_a_bent_map_is_right_or_says_nothing() -> None:
    def rows(x: Any) -> Any:
        return [[1.0, 0.2 * np.cos(x[1])], [-0.2 * np.sin(x[0]), 1.0]]

    def bent(x: np.ndarray) -> np.ndarray:
        return np.stack([x[:, 0] + 0.2 * np.sin(x[:, 1]), 0.2 * np.cos(x[:, 0]) + x[:, 1]], axis=-1)

    box = np.ones(2)
    proven = lower_proven(rows, -box, box)
    assert 0.3 < proven.lower <= lower_sampled(bent, -box, box).upper
    folded = lower_proven(lambda x: [[2.0 * x[0]]], -np.ones(1), np.ones(1))
    assert folded.lower == 0.0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_extensions_keep_the_constant_and_the_values(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (30, 3))
    values = np.stack([np.sin(points.sum(axis=1)), points[:, 0] * points[:, 1]], axis=-1)
    constants = np.array([3.0, 2.0])  # row sums of the derivatives on the box
    f = extend(points, values, constants)
    assert np.allclose(f(points), values, atol=1e-12)
    z, w = rng.normal(scale=3.0, size=(2, 200, 3))
    far = np.abs(z - w).max(axis=1)
    assert np.all(np.abs(f(z) - f(w)) <= constants * far[:, None] * (1.0 + 1e-12))


def test_kappas_by_hand() -> None:
    assert kappa_detect(4.0, 0.5) == 10.0
    assert kappa_error(4.0, 0.5, 3.0) == 35.0


# Left inverses by the nearest point.


def _off(model: System, group: tuple[int, ...], goal: np.ndarray, x: np.ndarray) -> np.ndarray:
    return model.phi(x, group) - goal


def test_nearest_points_are_global_minima() -> None:
    model, rng = example.system(), np.random.default_rng(0)
    for group in groups(4, 1):
        psi = nearest(model, group)
        z = rng.uniform(-2.5, 2.5, (12, int(model.pick(group).sum())))
        ours = psi(z)
        assert np.all(np.abs(ours) <= model.x_bound + 1e-15)
        for goal, x in zip(np.clip(z, -2.0, 2.0), ours, strict=True):
            cost = np.linalg.norm(model.phi(x, group) - goal)
            for start in rng.uniform(-0.5, 0.5, (6, 3)):
                other = least_squares(
                    lambda q, goal=goal, group=group: model.phi(q, group) - goal,
                    start,
                    bounds=(-0.5, 0.5),
                    xtol=1e-12,
                )
                assert cost <= np.linalg.norm(other.fun) + 1e-7


def test_nearest_points_invert_phi_and_agree_with_the_table() -> None:
    model = example.system()
    x = corners_and_interior(model, samples=200, seed=3)
    for group, printed in zip(groups(4, 1), example.printed_inverses(model), strict=True):
        psi = nearest(model, group)
        assert check(model, psi, x, tolerance=1e-7) < 1e-7
        z = model.phi(x, group)
        assert np.allclose(psi(z), printed(z), atol=1e-7)
        assert psi.factor == pytest.approx(np.sqrt(z.shape[1]))
        assert psi(z[0]).shape == (3,)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.floats(1e-6, 1.0))
def test_residual_of_the_nearest_point_is_at_most_root_n_times_the_error(seed: int, size: float) -> None:
    rng, model = np.random.default_rng(seed), example.system()
    group = groups(4, 1)[seed % 4]
    x = rng.uniform(-0.5, 0.5, 3)
    z = model.phi(x, group)
    e = rng.choice([-size, size], z.shape)
    psi = nearest(model, group, accept=size if seed % 2 else 0.0)
    back = psi(z + e)
    residual = np.abs(z + e - model.phi(back, group)).max()
    assert residual <= psi.factor * size * (1.0 + 1e-6)
    # Theorem 1, part 2, with one error-free pair: |x - xhat| <= (factor + 1) / Lip_ * size.
    assert np.abs(back - x).max() <= kappa_detect(psi.factor, example.lowest()) * size * (1.0 + 1e-6)


@pytest.mark.acceptance
@settings(max_examples=120, deadline=None)
@given(
    seed=st.integers(0, 100_000),
    exponent=st.floats(-6.0, 1.0),
    kind=st.sampled_from(["table", "nearest", "whole"]),
)
def test_theorem_1_and_its_corollary(seed: int, exponent: float, kind: str) -> None:
    rng, model, delta = np.random.default_rng(seed), example.system(), 1e-4
    which = seed % 4
    psi = {
        "table": example.printed_inverses(model)[which],
        "nearest": nearest(model, groups(4, 1)[which]),
        "whole": nearest(model, (0, 1, 2, 3)),
    }[kind]
    # The corollary tests all sensors; the groups that can be free of attacks are then the triples.
    lowest, steepest = example.lowest(), example.lip_phi().upper
    x = rng.uniform(-0.5, 0.5, 3)
    z = model.phi(x, psi.sensors)
    r = rng.uniform(-delta, delta, z.shape)
    owner = np.repeat(range(4), example.SIZES)[model.pick(psi.sensors)]
    liar = rng.choice(psi.sensors)
    e = np.where(owner == liar, 10.0**exponent * rng.normal(size=z.shape), 0.0)

    def test(code: np.ndarray) -> tuple[np.ndarray, bool]:
        back = psi(code)
        return back, bool(np.abs(code - model.phi(back, psi.sensors)).max() <= psi.factor * delta)

    assert test(z + r)[1]  # part (i): without an attack the test passes
    back, passed = test(z + r + np.where(owner == liar, e - r, 0.0))
    if passed:  # part (ii)
        assert np.abs(back - x).max() <= kappa_detect(psi.factor, lowest) * delta
        assert np.abs(e).max() <= kappa_error(psi.factor, lowest, steepest) * delta


def test_remark_2_without_2q_redundancy_a_set_passes_its_test_with_a_wrong_state() -> None:
    """Three sensors of two constant states: any two see both states, no one alone does; q = 1."""
    C = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    model = linear(np.zeros((2, 2)), np.ones((2, 1)), C, 1.0)
    assert redundancy(model, 1).singular > 0.1
    with refused(NotObservable, "too-few-meters"):
        redundancy(model, 2)
    psi = nearest(model, (0, 1))
    x, other = np.array([0.2, -0.3]), np.array([0.2, 0.6])
    e = model.phi(other, (0, 1)) - model.phi(x, (0, 1))
    assert np.count_nonzero(e) == 1
    z = model.phi(x, (0, 1)) + e
    assert np.allclose(model.phi(psi(z), (0, 1)), z, atol=1e-9), "no residual"
    assert np.allclose(psi(z), other, atol=1e-9), "and the wrong state"


def test_saturated_inverses_are_left_inverses_with_the_stated_constant() -> None:
    model = example.system()
    rng = np.random.default_rng(5)
    for psi, bracket in zip(example.printed_inverses(model), example.lip_inverses(), strict=True):
        n = int(model.pick(psi.sensors).sum())
        near = upper_sampled(psi, -3.0 * np.ones(n), 3.0 * np.ones(n), samples=20_000, seed=1)
        assert near.lower <= bracket.upper * (1.0 + 1e-9)

        def rest(z: np.ndarray, psi: Any = psi) -> np.ndarray:
            return z - model.phi(psi(z), psi.sensors)

        assert upper_sampled(rest, -3.0 * np.ones(n), 3.0 * np.ones(n)).lower <= psi.factor
        assert np.all(np.abs(psi(rng.normal(scale=50.0, size=(100, n)))) <= 0.5)
        z = rng.uniform(-6.0, 6.0, (50, n))
        raw = example.table()[groups(4, 1).index(psi.sensors)]
        by_hand = np.clip(raw(np.clip(z, -2.0, 2.0)), -0.5, 0.5)  # (10), (11)
        assert np.allclose(psi(z), by_hand)
        assert not np.allclose(np.clip(raw(z), -0.5, 0.5), by_hand), "the inner saturation matters"
    own = given_inverse(model, (1, 2, 3), example.table()[0], factor=1.0)
    assert np.allclose(own(model.phi(np.zeros(3), (1, 2, 3))), 0.0)


def test_what_is_no_left_inverse_is_refused() -> None:
    model = example.system()
    wrong = given_inverse(model, (1, 2, 3), lambda z: 0.0 * z[..., :3], factor=1.0)
    with refused(DesignInfeasible, "not-verified"):
        check(model, wrong, corners_and_interior(model), tolerance=1e-6)


# Redundancy: the propositions of lee2018, section 5.1.3, by enumeration.


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 100_000), p=st.integers(2, 5))
def test_detectable_means_every_remaining_group_is_injective(seed: int, p: int) -> None:
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 2 + seed % 3, (5, p, 2)).astype(float)
    states = range(len(codes))
    for q in range(p):
        # (i) from the definition: no error vector with at most q blocks turns one code into another.
        confused = any(
            np.count_nonzero(np.any(codes[a] != codes[b], axis=1)) <= q for a, b in combinations(states, 2)
        )
        # (ii) every group of p - q blocks or more tells all states apart.
        injective = all(
            len({codes[s][list(group)].tobytes() for s in states}) == len(codes)
            for size in range(p - q, p + 1)
            for group in combinations(range(p), size)
        )
        assert detectable(codes, q) == injective == (not confused)
        assert correctable(codes, q) == detectable(codes, 2 * q)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_correctable_means_no_two_errors_collide(seed: int) -> None:
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 2, (3, 4, 1)).astype(float)
    # All words reachable from a code by changing one block to any value of a small alphabet.
    alphabet = (-1.0, 0.0, 1.0, 2.0)

    def ball(code: np.ndarray) -> set[bytes]:
        out = {code.tobytes()}
        for block in range(4):
            for value in alphabet:
                changed = code.copy()
                changed[block] = value
                out.add(changed.tobytes())
        return out

    balls = [ball(code) for code in codes]
    apart = all(not (a & b) for a, b in combinations(balls, 2))
    assert correctable(codes, 1) == apart


def test_block_distance_ignores_padding_and_small_differences() -> None:
    codes = np.array([[[0.0, 9.0], [1.0, 2.0]], [[0.0, 8.0], [1.0, 2.5]]])
    mask = np.array([[True, False], [True, True]])
    assert block_distance(codes)[0, 1] == 2.0
    assert block_distance(codes, mask)[0, 1] == 1.0
    assert block_distance(codes, mask, tolerance=0.6)[0, 1] == 0.0


def test_redundancy_of_linear_systems_is_the_rank_test() -> None:
    rng = np.random.default_rng(7)
    for trial in range(12):
        A = np.diag([-1.0, -2.0])
        C = rng.integers(0, 2, (4, 2)).astype(float)
        C[~C.any(axis=1)] = [1.0, 1.0]
        model = linear(A, np.ones((2, 1)), C, 1.0)
        for missing in range(3):
            rank = min(
                np.linalg.matrix_rank(np.vstack([C[list(g)], C[list(g)] @ A]))
                for g in combinations(range(4), 4 - missing)
            )
            try:
                found = redundancy(model, missing, samples=200, seed=trial)
            except NotObservable:
                assert rank < 2
                continue
            assert (found.singular > 1e-9) == (rank == 2)
            assert found.injective > 0.05 or rank < 2
    with refused(NotObservable, "too-few-meters"):
        redundancy(example.system(), 3)


def test_partial_binding_of_groups_uses_every_group() -> None:
    # A model whose only weak group is the last one.
    model = linear(
        np.diag([-1.0, -2.0]), np.ones((2, 1)), np.array([[1.0, 1.0], [1.0, 0.0], [1e-3, 1e-3]]), 1.0
    )
    found = redundancy(model, 1, samples=100)
    assert found.weakest == (1, 2)
    direct = lower_sampled(partial(model.phi, sensors=(1, 2)), -np.ones(2), np.ones(2), samples=100)
    assert found.injective == direct.upper
