"""The whole estimator of gridsec.observers.high_gain on a small nonlinear system with three equal sensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gridsec.errors import DesignInfeasible, NotObservable
from gridsec.interface import Cause, Decision
from gridsec.observers import high_gain
from gridsec.observers.high_gain import groups, nearest
from tests.codes import refused
from tests.gridsec.observers.bent import bent, estimator, truth


def watch(made: high_gain.HighGainDesign, added: Any, seconds: float = 8.0, seed: int = 0) -> tuple[Any, ...]:
    t, x, u = truth(seconds)
    y = x[:, [0, 0, 0]] + np.random.default_rng(seed).uniform(-1e-4, 1e-4, (len(t), 3)) + added(t)
    state = high_gain.init(made, 0.0, y[0], u[:1])
    outcomes, states = [], []
    for k in range(1, len(t)):
        state, outcome = high_gain.step(made, state, y[k], u[k : k + 1], np.ones(3, dtype=bool), 0.02)
        outcomes.append(outcome)
        states.append(state)
    return t[1:], x[1:], outcomes, states


def nothing(t: np.ndarray) -> np.ndarray:
    return np.zeros((len(t), 3))


def on_second(size: float, start: float = 4.0) -> Any:
    def added(t: np.ndarray) -> np.ndarray:
        out = np.zeros((len(t), 3))
        out[t >= start, 1] = size
        return out

    return added


@pytest.mark.canary("componentwise")
@pytest.mark.parametrize("decay", ["componentwise", "kim2018"])
def test_honest_sensors_are_never_suspected_and_bounds_hold(decay: Any) -> None:
    made = estimator(decay=decay)
    t, x, outcomes, states = watch(made, nothing)
    assert all(outcome.decision is not Decision.ATTACKED for outcome in outcomes)
    assert all(outcome.visited == (0,) for outcome in outcomes)
    assert outcomes[-1].decision is Decision.CLEAN
    assert outcomes[0].cause is Cause.SETTLING
    for state, outcome, truth_x in zip(states, outcomes, x, strict=True):
        limits = high_gain.error_bounds(made, state.age)
        assert np.all(np.abs(state.z - truth_x).max(axis=1) <= limits)
        assert np.abs(outcome.x - truth_x).max() <= outcome.bound
    assert t[-1] == pytest.approx(states[-1].t)
    assert made.proven


@pytest.mark.parametrize("decay", ["componentwise", "kim2018", "lee2018"])
def test_bounds_are_those_of_12_and_14(decay: Any) -> None:
    """`max(2 M_z eta e^(-rate age), eps)`: an estimate and a state within M_z are at most 2 M_z apart."""
    made = estimator(decay=decay)
    ages = np.array([0.0, 0.3, 1e3])
    got = high_gain.error_bounds(made, ages)
    for d, size, age, bound in zip(made.decays, made.system.z_bound, ages, got, strict=True):
        assert bound == pytest.approx(max(2.0 * size * d.eta * np.exp(-d.rate * age), d.epsilon))
    assert got[0] == pytest.approx(2.0 * made.decays[0].eta)


@pytest.mark.canary("10000.0")
@pytest.mark.parametrize("size", [0.02, -0.3, 1e4, 1e300])
def test_attacks_are_seen_named_and_left_out(size: float) -> None:
    made = estimator()
    t, x, outcomes, states = watch(made, on_second(size))
    after = [outcome for moment, outcome in zip(t, outcomes, strict=True) if moment > 4.5]
    assert all(outcome.decision is Decision.ATTACKED for outcome in after)
    assert all(outcome.suspects.tolist() == [False, True, False] for outcome in after)
    assert after[-1].trusted.tolist() == [True, False, True]
    for state, outcome in zip(states, outcomes, strict=True):
        # Theorem 2 of kim2018 for the set in use: (Lip^ + 1) / min Lip_ times delta.
        chosen = made.inverses[outcome.sigma]
        delta = high_gain.error_bounds(made, state.age)[list(chosen.sensors)].max()
        assert outcome.threshold == pytest.approx(chosen.factor * delta)
        assert outcome.bound == pytest.approx((chosen.factor + 1.0) / made.lowest * delta)
    error = np.array([np.abs(o.x - truth_x).max() for o, truth_x in zip(outcomes, x, strict=True)])
    assert np.all(error <= np.array([outcome.bound for outcome in outcomes]))
    assert np.all(np.abs(np.array([state.z for state in states])) <= made.limit[:, None] + 1e-9)
    assert any(outcome.reset[1] for outcome in after) == (abs(size) > made.limit[1])


def test_a_sensor_is_named_only_beyond_what_the_error_of_the_estimate_explains() -> None:
    """`|zhat_i - Phi_i(xhat)| > delta_i + Lip^(Phi_i) bound`: an honest sensor cannot be further off."""
    made = estimator()
    state = high_gain.init(made, 0.0, np.full(3, 0.2), np.zeros(1))
    state = replace(state, age=np.full(3, 100.0))
    y, seen = np.full(3, 0.2), np.ones(3, dtype=bool)
    _, calm = high_gain.step(made, state, y, np.zeros(1), seen, 0.02)
    reach = made.decays[1].epsilon + made.steep[1] * calm.bound
    assert made.steep[1] * calm.bound > made.decays[1].epsilon
    for share, named in ((0.8, [False] * 3), (1.3, [False, True, False])):
        # The second observer stands apart: within what two honest errors can do, and beyond.
        apart = np.array(state.z)
        apart[:, 0] = 0.2
        apart[1, 0] += share * reach
        _, out = high_gain.step(made, replace(state, z=apart), y, np.zeros(1), seen, 1e-9)
        assert out.suspects.tolist() == named


@pytest.mark.acceptance
def test_search_walks_through_the_sets_at_once_or_one_by_one() -> None:
    # Sensor 2 is in the first two sets, {1, 2} and {0, 2}.
    added = lambda t: 0.5 * (t[:, None] >= 4.0) * np.array([0.0, 0.0, 1.0])  # noqa: E731
    _, _, together, _ = watch(estimator(), added)
    _, _, singly, _ = watch(estimator(search="one"), added)
    assert {o.visited for o in together if len(o.visited) > 1} == {(0, 1, 2)}
    assert [o.visited for o in singly if len(o.visited) > 1][:2] == [(0, 1), (1, 2)]
    assert together[-1].sigma == singly[-1].sigma == 2


@pytest.mark.acceptance
def test_two_liars_leave_no_answer_and_say_so() -> None:
    added = lambda t: (t[:, None] >= 4.0) * np.array([0.5, -0.7, 0.0])  # noqa: E731
    _, _, outcomes, _ = watch(estimator(), added)
    assert outcomes[-1].decision is Decision.UNDECIDED
    assert outcomes[-1].cause is Cause.TOO_MANY_SUSPECTS
    assert outcomes[-1].bound == np.inf


@pytest.mark.acceptance
def test_unseen_sensors_have_no_influence_and_come_back() -> None:
    made = estimator()
    t, x, u = truth(8.0)
    runs = []
    for junk in (np.nan, 1e9, 0.0):
        state, sigma = high_gain.init(made, 0.0, x[0, [0, 0, 0]], u[:1]), []
        for k in range(1, len(t)):
            silent = 3.0 < t[k] < 5.0
            y = x[k, [0, 0, 0]].copy()
            y[0] = junk if silent else y[0]
            state, outcome = high_gain.step(
                made, state, y, u[k : k + 1], np.array([not silent, True, True]), 0.02
            )
            sigma.append((outcome.sigma, outcome.decision, tuple(outcome.x), outcome.bound))
            assert np.abs(outcome.x - x[k]).max() <= outcome.bound
            assert outcome.decision is not Decision.ATTACKED
            if silent:
                assert not outcome.trusted[0]
                assert state.age[0] == 0.0
        assert state.age[0] == pytest.approx(t[-1] - 5.0, abs=0.05)
        assert state.age[1] == pytest.approx(t[-1])
        runs.append(sigma)
    assert runs[0] == runs[1] == runs[2]


def test_too_few_sensors_give_no_answer() -> None:
    made = estimator()
    state = high_gain.init(made, 0.0)
    state, outcome = high_gain.step(
        made, state, np.full(3, np.nan), np.zeros(1), np.ones(3, dtype=bool), 0.02
    )
    assert outcome.decision is Decision.UNDECIDED
    assert outcome.cause is Cause.TOO_FEW_METERS
    assert np.all(np.isnan(outcome.x))
    _, outcome = high_gain.step(made, state, np.zeros(3), np.zeros(1), np.array([True, False, False]), 0.02)
    assert outcome.cause is Cause.TOO_FEW_METERS


def test_steps_of_another_length_give_the_same_path() -> None:
    made = estimator()
    start = high_gain.init(made, 0.0, np.array([0.2, 0.1, 0.0]), np.zeros(1))
    y, u, seen = np.array([0.25, 0.1, 0.05]), np.array([0.1]), np.ones(3, dtype=bool)
    twice = estimator(step_s=0.04, substeps=2)
    long, _ = high_gain.step(made, start, y, u, seen, 0.04)
    parts, _ = high_gain.step(twice, start, y, u, seen, 0.04)
    half, _ = high_gain.step(made, start, start.y + 0.5 * (y - start.y), 0.5 * u, seen, 0.02)
    full, _ = high_gain.step(made, half, y, u, seen, 0.02)
    assert np.allclose(full.z, parts.z, rtol=1e-12, atol=1e-12)
    assert np.allclose(long.z, parts.z, rtol=0.0, atol=2e-3)


def test_designs_that_do_not_hold_are_refused() -> None:
    model = bent()
    sets = [nearest(model, group) for group in groups(3, 1)]
    rest: dict[str, Any] = {"noise": 1e-3, "max_attacked": 1, "u_low": -1.0, "u_high": 1.0, "step_s": 0.02}
    with refused(DesignInfeasible, "unstable"):
        high_gain.design(model, sets, theta=1.5, **rest)
    with refused(DesignInfeasible, "out-of-range"):
        high_gain.design(model, sets, theta=0.5, **rest)
    with refused(NotObservable, "missing"):
        high_gain.design(model, sets[:2], theta=12.0, **rest)
    with refused(NotObservable, "too-few-meters"):
        high_gain.design(model, sets, theta=12.0, **{**rest, "max_attacked": 2})
    wrong = replace(sets[0], function=lambda z: 0.9 * sets[0].function(z))
    with refused(DesignInfeasible, "not-verified"):
        high_gain.design(model, [wrong, *sets[1:]], theta=12.0, **rest)
