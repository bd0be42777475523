"""Unknown-input observers: existence by independent oracles, certificates by trajectories."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eig

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers.lmi.sampled import advance
from gridsec.observers.lmi.unknown_input import (
    ErrorSystem,
    UnknownInputGains,
    unknown_input,
    unknown_input_margin,
    unknown_input_matrix,
)
from gridsec.observers.unknown_input import (
    Pair,
    UnknownInputObserver,
    UnknownInputPlant,
    design,
    error_system,
    exact,
    init,
    obstruction,
    outputs,
    projection,
    step,
    worst_zero,
)
from gridsec.papers import yang2021, yang2021_feeder
from tests.codes import refused

TOLERANCE = 1e-9


def pairs_of(plant: UnknownInputPlant, inputs: int, sensors: int) -> list[Pair]:
    u = itertools.combinations(range(plant.inputs.shape[1]), inputs)
    return [(a, b) for a in u for b in itertools.combinations(range(len(plant.noise)), sensors)]


@pytest.fixture(scope="module")
def partial() -> UnknownInputObserver:
    """All thirty partial observers of the corrected Example 2."""
    plant = yang2021.plant(2, corrected=True)
    return design(plant, pairs_of(plant, 1, 3) + pairs_of(plant, 2, 2))


@pytest.fixture(scope="module")
def noisy() -> UnknownInputObserver:
    """Observers of a feeder, with noise, drift and a span."""
    plant = yang2021_feeder.plant(yang2021_feeder.AT, yang2021_feeder.METERS, 1e-5)
    plant = replace(plant, drift=plant.inputs * 1e-4)
    asked: list[Pair] = [((0,), tuple(range(7))), ((1, 2), tuple(range(2, 8))), ((), tuple(range(8)))]
    return design(plant, asked)


# Existence.


def test_which_members_of_the_printed_banks_have_no_rank() -> None:
    """Brute force over all subsets, with minors instead of singular values."""

    def deficient(plant: UnknownInputPlant, pair: Pair) -> bool:
        seen = plant.system.C[list(pair[1])] @ plant.inputs[:, list(pair[0])]
        size = len(pair[0])
        rows = itertools.combinations(range(len(pair[1])), size)
        return all(abs(np.linalg.det(seen[list(pick)])) < 1e-9 for pick in rows)

    found: dict[int, list[Pair]] = {}
    for example, shapes in ((1, [(2, 3), (2, 2)]), (2, [(1, 3), (2, 2)])):
        plant = yang2021.plant(example)
        pairs = [pair for shape in shapes for pair in pairs_of(plant, *shape)]
        reported = [obstruction(plant, pair, tolerance=TOLERANCE) for pair in pairs]
        ours = [r.pair for r in reported if r is not None and r.reason == "rank"]
        assert ours == [pair for pair in pairs if deficient(plant, pair)]
        found[example] = ours
    assert found == {1: [((0, 1), (0, 1))], 2: [((0, 1), (0, 1)), ((0, 2), (1, 3))]}


def test_zeros_are_those_of_the_rosenbrock_pencil() -> None:
    """Finite generalised eigenvalues of the system matrix, for every corner of the slopes."""
    plant = yang2021.plant(2)
    system = plant.system
    unstable = []
    for pair in pairs_of(plant, 2, 2):
        if abs(np.linalg.det(system.C[list(pair[1])] @ plant.inputs[:, list(pair[0])])) < 1e-9:
            continue
        C, b, sizes = system.C[list(pair[1])], plant.inputs[:, list(pair[0])], []
        for ends in itertools.product((-0.5, 0.5), repeat=3):
            left = np.block([[system.A + np.diag(ends), b], [C, np.zeros((2, 2))]])
            right = np.block([[np.eye(3), np.zeros((3, 2))], [np.zeros((2, 5))]])
            alpha, beta = eig(left, right, right=False, homogeneous_eigvals=True)
            finite = np.abs(beta) > 1e-9
            assert np.count_nonzero(finite) == 1
            sizes.append(abs(alpha[finite][0] / beta[finite][0]))
        assert worst_zero(plant, pair) == pytest.approx(max(sizes), rel=1e-7)
        if max(sizes) > 1.0:
            unstable.append(pair)
    assert unstable == [((0, 1), (1, 2)), ((0, 1), (1, 3)), ((0, 2), (1, 2)), ((1, 2), (1, 2))]


@pytest.mark.parametrize("pair", [((0, 1), (1, 2)), ((0, 1), (1, 3)), ((0, 2), (1, 2)), ((1, 2), (1, 2))])
def test_a_zero_outside_the_circle_hides_a_diverging_error(pair: Pair) -> None:
    """Two trajectories that the sensors cannot tell apart, one attacked inside J_u, and do not meet."""
    plant = yang2021.plant(2)
    system, C, b = plant.system, plant.system.C[list(pair[1])], plant.inputs[:, list(pair[0])]
    corner = max(
        itertools.product((0.0, np.pi), repeat=3),
        key=lambda at: max(
            abs(np.linalg.eigvals(projection(plant, pair)[0] @ (system.A + np.diag(0.5 * np.cos(at)))))
        ),
    )
    rest = np.array(corner)
    u = np.linalg.solve(system.B, rest - advance(replace(system, B=0 * system.B), rest, np.zeros(3)))
    hidden = np.linalg.svd(C)[2][-1]
    x = rest + 1e-6 * hidden
    for _ in range(600):
        free = advance(system, x, u)
        x = free - b @ np.linalg.solve(C @ b, C @ (free - rest))
        np.testing.assert_allclose(C @ x, C @ rest, atol=1e-9)
    np.testing.assert_allclose(advance(system, rest, u), rest, atol=1e-12)
    assert np.linalg.norm(x - rest) > 0.1


def test_no_rank_no_observer_of_any_kind() -> None:
    """Readings up to and including a tick agree, states at that tick are as far apart as one likes."""
    plant = yang2021.plant(2)
    for pair, direction in ((((0, 1), (0, 1)), (1.0, -1.0)), (((0, 2), (1, 3)), (1.0, -1.0))):
        push = plant.inputs[:, list(pair[0])] @ np.array(direction)
        np.testing.assert_allclose(plant.system.C[list(pair[1])] @ push, 0.0, atol=1e-12)
        assert np.linalg.norm(push) > 1.0


def test_example_2_has_no_complete_observer_of_two_sensors() -> None:
    assert len(yang2021.missing_complete()) == 6
    assert {one.rank for one in yang2021.missing_complete()} <= {1, 2}


def test_which_inverters_of_the_whole_line_cannot_be_told_apart() -> None:
    """Kerber's line, seven inverters, a meter everywhere, two distrusted: the pairs at either end."""
    plant = yang2021_feeder.plant((0, 2, 4, 6, 8, 10, 12), tuple(range(13)), 1e-6)
    found = [
        one.pair
        for pair in pairs_of(plant, 2, 11)
        if (one := obstruction(plant, pair, tolerance=TOLERANCE)) is not None
    ]
    assert found == [((0, 1), tuple(range(2, 13))), ((5, 6), tuple(range(11)))]


def test_scalar_multiplier_proves_less() -> None:
    plant = yang2021.plant(2)
    ball = design(plant, pairs_of(plant, 2, 2), multiplier="scalar")
    each = design(plant, pairs_of(plant, 2, 2))
    assert set(ball.pairs) < set(each.pairs)
    assert {one.reason for one in each.missing} == {"rank", "zero"}
    assert [one.pair for one in ball.missing if one.reason == "design"] == [
        ((0, 1), (0, 2)),
        ((0, 1), (0, 3)),
        ((0, 1), (2, 3)),
    ]


# Certificates.


def independent(system: ErrorSystem, gains: UnknownInputGains) -> float:
    """Smallest pivot of a Cholesky factorisation of the Schur form, written out by hand."""
    s, g = system, gains
    n, k, d = len(s.M), s.N.size, s.W.shape[1]
    live = s.half > 0.0
    m = int(np.count_nonzero(live))
    T = sum((lam * h**2 * np.outer(row, row) for lam, h, row in zip(g.Lambda, s.half, s.H, strict=True)))
    top = [g.P @ (s.M - g.K @ s.C), g.P @ s.S[:, live], g.P @ s.W, g.P @ g.K * s.N]
    diagonal = np.zeros((n + m + d + k, n + m + d + k))
    diagonal[:n, :n] = g.rate**2 * g.P - T
    diagonal[n:, n:] = np.diag([*g.Lambda[live], *[g.mu] * (d + k)])
    row = np.hstack(top)
    whole = np.block([[diagonal, -row.T], [-row, g.P]])
    scale = 1.0 / np.sqrt(np.diagonal(whole))
    return float(np.min(np.diagonal(np.linalg.cholesky(scale[:, None] * whole * scale))))


def test_every_proof_survives_another_factorisation(
    partial: UnknownInputObserver, noisy: UnknownInputObserver
) -> None:
    assert len(partial.pairs) == 30
    for family in (partial, noisy):
        assert not family.missing
        for pair, gains in zip(family.pairs, family.gains, strict=True):
            system = error_system(family.plant, pair)
            assert gains.margin > 0.0
            assert unknown_input_margin(system, gains) == gains.margin
            assert independent(system, gains) > 0.0


def test_the_matrix_is_the_statement(partial: UnknownInputObserver) -> None:
    """Its quadratic form equals increment of V minus bound plus multiplier, evaluated by hand."""
    rng = np.random.default_rng(0)
    system, g = error_system(partial.plant, partial.pairs[3]), partial.gains[3]
    n, m, d, k = 3, 3, system.W.shape[1], system.N.size
    for _ in range(20):
        e, psi, w, r = (rng.standard_normal(size) for size in (n, m, d, k))
        after = (system.M - g.K @ system.C) @ e + system.S @ psi + system.W @ w + g.K @ (system.N * r)
        value = after @ g.P @ after - g.rate**2 * e @ g.P @ e - g.mu * (w @ w + r @ r)
        value += g.Lambda @ ((system.half * (system.H @ e)) ** 2 - psi**2)
        v = np.concatenate([e, psi, w, r])
        assert v @ unknown_input_matrix(system, g) @ v == pytest.approx(value, rel=1e-9)


def test_false_proofs_have_negative_margins(partial: UnknownInputObserver) -> None:
    system, g = error_system(partial.plant, partial.pairs[0]), partial.gains[0]
    assert unknown_input_margin(system, replace(g, rate=0.1 * g.rate)) < 0.0
    assert unknown_input_margin(system, replace(g, mu=0.1 * g.mu)) < 0.0
    assert unknown_input_margin(system, replace(g, P=-g.P)) == -np.inf
    assert unknown_input_margin(system, replace(g, Lambda=-g.Lambda)) == -np.inf
    with refused(DesignInfeasible, "no-solution"):
        unknown_input(replace(system, M=3.0 * np.eye(3), C=0.0 * system.C), rate=0.9)
    with refused(InputInvalid, "out-of-range"):
        unknown_input(system, rate=1.0)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), size=st.floats(0.1, 100.0))
def test_the_error_decays_at_the_certified_rate_whatever_the_inputs_do(
    partial: UnknownInputObserver, seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    system, plant = partial.plant.system, partial.plant
    distrusted = np.array([[i in pair[0] for i in range(3)] for pair in partial.pairs])
    each = rng.integers(len(partial.pairs))
    x = size * rng.standard_normal(3)
    state = init(partial, 0.0, radius=np.abs(x))
    seen = np.ones(4, dtype=np.bool_)
    u = rng.uniform(-5, 5, 3)
    state = step(partial, state, system.C @ x, u, seen)
    for _ in range(15):
        before = np.array([np.sqrt(e @ g.P @ e) for e, g in zip(state.x - x, partial.gains, strict=True)])
        # Attack the inputs that one of the observers distrusts: all with at least these stay exact.
        a = np.where(distrusted[each], size * rng.standard_normal(3), 0.0)
        x = advance(system, x, u) + plant.inputs @ a
        u = rng.uniform(-5, 5, 3)
        state = step(partial, state, system.C @ x, u, seen)
        after = np.array([np.sqrt(e @ g.P @ e) for e, g in zip(state.x - x, partial.gains, strict=True)])
        entitled = np.all(distrusted | (a == 0.0), axis=1)
        assert np.all((after <= partial.rate * before * (1 + 1e-9) + 1e-9 * size)[entitled])
        assert np.all((after <= state.level)[entitled])
        assert np.all((np.abs(state.x - x) <= state.box)[entitled])


def test_the_error_system_is_plant_minus_observer(
    partial: UnknownInputObserver, noisy: UnknownInputObserver
) -> None:
    """e+ of `error_system`, term by term, against a step of every observer beside a step of the plant."""
    rng = np.random.default_rng(11)
    for family in (partial, noisy):
        plant, system = family.plant, family.plant.system
        n, p, inputs = len(system.A), len(plant.noise), system.B.shape[1]
        loud, size = bool(np.any(plant.noise > 0.0)), 1.0 if family is partial else 0.03
        x, u, after = size * rng.standard_normal(n), size * rng.standard_normal(inputs), np.zeros(inputs)
        state = replace(init(family, 0.0), x=size * rng.standard_normal((len(family.pairs), n)))
        before, drift = state.x - x, rng.uniform(-1, 1, plant.drift.shape[1])
        n0, n1 = rng.uniform(-1, 1, (2, p)) if loud else np.zeros((2, p))
        seen = np.ones(p, dtype=np.bool_)
        state = step(family, state, system.C @ x + system.D @ u + plant.noise * n0, u, seen)
        hats = state.x
        ahead = advance(system, x, u) + plant.drift @ drift
        state = step(family, state, system.C @ ahead + system.D @ after + plant.noise * n1, after, seen)
        for i, (pair, gains) in enumerate(zip(family.pairs, family.gains, strict=True)):
            s, own = error_system(plant, pair), list(pair[1])
            z, zhat = (system.H @ at + system.F @ u for at in (x, hats[i]))
            psi = system.phi(zhat) - system.phi(z) - plant.middle * (system.H @ before[i])
            # b H N acts on the new readings' errors, Gbar E on the drift, with the signs of x_hat - x.
            w = np.concatenate([n1[own], -drift])
            expected = (s.M - gains.K @ s.C) @ before[i] + s.S @ psi + s.W @ w + gains.K @ (s.N * n0[own])
            if not loud:
                expected = (s.M - gains.K @ s.C) @ before[i] + s.S @ psi
            np.testing.assert_allclose(state.x[i] - ahead, expected, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), extreme=st.booleans())
def test_noise_and_drift_stay_inside_the_bounds(
    noisy: UnknownInputObserver, seed: int, extreme: bool
) -> None:
    rng = np.random.default_rng(seed)
    plant, system = noisy.plant, noisy.plant.system

    def box(size: int) -> Floats:
        draw = rng.uniform(-1, 1, size)
        return np.sign(draw) if extreme else draw

    x = 0.04 * rng.uniform(-1, 1, 3)
    state = init(noisy, 0.0)
    seen = np.ones(8, dtype=np.bool_)
    for _ in range(25):
        u = 0.07 + 0.03 * rng.uniform(-1, 1, 13)
        y = system.C @ x + system.D @ u + plant.noise * box(8)
        state = step(noisy, state, y, u, seen)
        assert np.all(np.abs(state.x - x) <= state.box)
        x = advance(system, x, u) + plant.drift @ box(plant.drift.shape[1])
    assert np.all(state.box < plant.span)


# The contract of every family.


def test_unknown_inputs_leave_no_trace(partial: UnknownInputObserver) -> None:
    """Started at the truth, an observer stays there whatever its J_u is told, and leaves it otherwise."""
    rng = np.random.default_rng(5)
    plant, system = partial.plant, partial.plant.system
    seen = np.ones(4, dtype=np.bool_)
    for attacked in range(3):
        x, state = rng.standard_normal(3), None
        for _ in range(12):
            u = rng.uniform(-5, 5, 3)
            state = step(partial, state or init(partial, 0.0, x=x), system.C @ x, u, seen)
            error = np.linalg.norm(state.x - x, axis=1)
            x = advance(system, x, u) + 50.0 * plant.inputs[:, attacked] * rng.uniform(0.5, 1.0)
        entitled = np.array([attacked in pair[0] for pair in partial.pairs])
        assert np.all(error[entitled] < 1e-9)
        assert np.all(error[~entitled] > 0.1)


def test_attacks_are_visible(partial: UnknownInputObserver) -> None:
    """Every trusted sensor moves every observer that trusts it, every believed input too."""
    plant, system = partial.plant, partial.plant.system
    seen, u = np.ones(4, dtype=np.bool_), np.zeros(3)

    def run(a_u: Floats, a_y: Floats) -> Floats:
        x, state = np.zeros(3), init(partial, 0.0)
        for _ in range(6):
            state = step(partial, state, system.C @ x + a_y, u, seen)
            predicted, y = outputs(partial, state, u), system.C @ x
            x = advance(system, x, u) + plant.inputs @ a_u
        return np.asarray(np.abs(predicted - y).max(axis=1))

    for i in range(3):
        moved = run(3.0 * (np.arange(3) == i), np.zeros(4))
        distrusts = np.array([i in pair[0] for pair in partial.pairs])
        assert np.all(moved[~distrusts] > 1e-2)
        assert np.all(moved[distrusts] < 0.5)
    for j in range(4):
        moved = run(np.zeros(3), 3.0 * (np.arange(4) == j))
        trusts = np.array([j in pair[1] for pair in partial.pairs])
        assert np.all(moved[trusts] > 1e-2)
        assert np.all(moved[~trusts] == 0.0)


def test_a_silent_sensor_has_exactly_no_influence(partial: UnknownInputObserver) -> None:
    rng = np.random.default_rng(1)
    state = init(partial, 0.0, radius=np.ones(3))
    states = [state, state, state]
    for k in range(6):
        y, u = rng.standard_normal(4), rng.standard_normal(3)
        seen = np.array([True, k != 3, True, True])
        for which, value in enumerate((0.0, 1e300, np.nan)):
            told = y.copy()
            told[1] = value if k == 3 else told[1]
            states[which] = step(partial, states[which], told, u, seen)
    for other in states[1:]:
        np.testing.assert_array_equal(states[0].x, other.x)
        np.testing.assert_array_equal(states[0].box, other.box)
    missed = partial.sensors[:, 1]
    assert np.all(np.isinf(states[0].box[missed]))
    assert np.all(np.isfinite(states[0].box[~missed]))


def test_a_silent_sensor_costs_what_the_span_says(noisy: UnknownInputObserver) -> None:
    """After a gap the bounds start again from the span, and hold."""
    system, x, state = noisy.plant.system, np.array([0.03, -0.02, 0.01]), init(noisy, 0.0)
    u = np.full(13, 0.07)
    for k in range(30):
        seen = np.array([k != 12, *[True] * 7])
        state = step(noisy, state, system.C @ x + system.D @ u, u, seen)
        assert np.all(np.abs(state.x - x) <= state.box)
        x = advance(system, x, u)
        if k == 12:
            reset = state.box[0].copy()
    assert np.all(reset >= noisy.plant.span)
    assert np.all(state.box[0] < 0.5 * reset)


def test_many_at_once_equal_one_at_a_time(partial: UnknownInputObserver) -> None:
    rng = np.random.default_rng(3)
    y, u, seen = rng.standard_normal((8, 4)), rng.standard_normal((8, 3)), np.ones(4, dtype=np.bool_)
    together = init(partial, 0.0, radius=np.ones(3))
    for k in range(8):
        together = step(partial, together, y[k], u[k], seen)
    for i in (0, 7, 20):
        alone = design(partial.plant, [partial.pairs[i]])
        np.testing.assert_allclose(alone.K[0], partial.K[i], atol=1e-6)
        state = init(alone, 0.0, radius=np.ones(3))
        for k in range(8):
            state = step(alone, state, y[k], u[k], seen)
        np.testing.assert_allclose(state.x[0], together.x[i], rtol=1e-5, atol=1e-6)


def test_time_starts_with_the_first_readings(partial: UnknownInputObserver) -> None:
    state = init(partial, 7.0, radius=np.ones(3))
    first = step(partial, state, np.zeros(4), np.zeros(3), np.ones(4, dtype=np.bool_))
    assert first.t == 7.0
    np.testing.assert_array_equal(first.x, state.x)
    assert step(partial, first, np.zeros(4), np.zeros(3), np.ones(4, dtype=np.bool_)).t == 8.0


def test_refusals() -> None:
    plant = yang2021.plant(1)
    with refused(DesignInfeasible, "no-solution"):
        design(plant, [((0, 1), (0, 1))])
    with refused(InputInvalid, "singular"):
        exact(plant.system, np.ones((2, 2)))
    with refused(InputInvalid, "not-positive"):
        replace(plant, noise=np.array([0.0, 1.0, 1.0, 1.0]))
    with refused(InputInvalid, "shape", "not-positive"):
        replace(plant, drift=np.zeros((3, 1)), span=np.zeros(2))
    with refused(InputInvalid, "not-positive"):
        replace(error_system(plant, ((0,), (0, 2))), N=np.zeros(2))
