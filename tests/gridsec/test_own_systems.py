"""Short ways to one's own system: they give what the long ways give, and refuse what does not fit."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.estimators.exact_bank import bank
from gridsec.estimators.exact_bank.bank import StackedState
from gridsec.interface import Cause, Decision
from gridsec.observers import circle as observer
from gridsec.observers import high_gain
from gridsec.observers.gains import CircleGains
from gridsec.observers.high_gain import groups, nearest
from gridsec.observers.lmi import circle, options_for, prove
from gridsec.observers.lmi.sampled import DiscreteLure
from gridsec.observers.lmi.sampled import advance as advance_discrete
from gridsec.observers.lure import Lure, advance
from tests.codes import refused
from tests.gridsec.observers.bent import bent, truth

A, C = [[0, 1], [0, -1]], [[1, 0], [1, 0], [1, 0], [1, 1], [1, 1]]
ALL = np.ones(5, dtype=np.bool_)


def curve(z: Any) -> Any:
    return z + np.sin(z)


def pendulum() -> Lure:
    return Lure.of(A, C, G=[[0], [-1]], H=[[1, 0]], B=[[0], [1]], phi=curve, slope=2)


def test_inputs_that_are_not_given_do_nothing() -> None:
    own = pendulum()
    assert own.F.shape == (1, 1)
    assert own.D.shape == (5, 1)
    assert not own.F.any()
    assert not own.D.any()
    assert own.slope.tolist() == [2.0]
    alone = Lure.of(A, C, G=[[0], [-1]], H=[[1, 0]], phi=curve, slope=[2])
    x = np.array([0.4, -0.2])
    assert np.array_equal(advance(alone, x, np.zeros(0), 0.1), advance(own, x, np.zeros(1), 0.1))


def test_a_discrete_system_moves_as_its_equation_says() -> None:
    own = DiscreteLure.of(
        [[0.8, 0.1], [0, 0.7]],
        C,
        G=[[0], [0.2]],
        H=[[1, 1]],
        D=np.ones((5, 2)),
        phi=np.sin,
        lower=-1,
        upper=1,
    )
    assert own.B.shape == (2, 2)
    assert (own.lower.tolist(), own.upper.tolist()) == ([-1.0], [1.0])
    after = advance_discrete(own, np.array([1.0, 2.0]), np.ones(2))
    assert after == pytest.approx([1.0, 1.4 + 0.2 * np.sin(3.0)], abs=1e-15)


def test_what_does_not_fit_is_refused_by_name() -> None:
    with refused(InputInvalid, "shape", "shape"):
        Lure.of(A, C, G=[[1]], H=[[1, 0]], B=[[1]], phi=curve, slope=2)
    with refused(InputInvalid, "shape"):
        DiscreteLure.of(A, C, G=[[0], [1]], H=[[1, 0]], D=[[1]], phi=curve, lower=0, upper=2)


def test_a_slope_that_no_proof_can_use_is_refused_with_every_other_problem() -> None:
    def own(slope: Any, **more: Any) -> Lure:
        return Lure.of(-np.eye(2), np.eye(2), G=np.eye(2), H=np.eye(2), phi=np.tanh, slope=slope, **more)

    with refused(InputInvalid, "order"):
        own([-3.0, 0.5])
    with refused(InputInvalid, "order"):
        own([1.0, 0.5], lower=[0.0, 0.6])
    with refused(InputInvalid, "not-finite"):
        own([np.nan, 0.5])
    with refused(InputInvalid, "shape", "not-finite", "order"):
        own([np.inf, -1.0], B=[[1.0]])
    with refused(InputInvalid, "shape"):
        Lure.of([1.0, 2.0], np.eye(2), G=np.eye(2), H=np.eye(2), phi=np.tanh, slope=1.0)


def test_falling_curves_are_those_of_the_system_transformed_by_hand() -> None:
    """`x' = -2 x + sin(x + u)` is `x' = -3 x - u + (z + sin z)`, z = x + u, with slopes in [0, 2]."""
    found = Lure.of([[-2]], [[1]], G=[[1]], H=[[1]], F=[[1]], phi=np.sin, slope=1, lower=-1)
    hand = Lure.of([[-3]], [[1]], G=[[1]], H=[[1]], F=[[1]], B=[[-1]], phi=curve, slope=2)
    for name in ("A", "B", "G", "H", "F", "C", "D", "slope"):
        assert np.array_equal(getattr(found, name), getattr(hand, name)), name
    z = np.linspace(-9, 9, 50)[:, None]
    assert np.allclose(found.phi(z), hand.phi(z), rtol=0, atol=1e-14)


def test_a_certificate_of_a_falling_curve_is_kept_where_its_error_grows() -> None:
    """At rest at pi the curve falls with slope -1: the error obeys the proof, or there is none."""

    def own(rate: float, **more: Any) -> Lure:
        return Lure.of([[-rate]], [[1]], G=[[-1]], H=[[1]], B=[[1]], phi=np.sin, slope=1, **more)

    def proof(lure: Lure) -> CircleGains:
        options = options_for(lure, rate=0.2, noise=1.0, load=np.zeros(1), weight=np.eye(1))
        return prove(lure, [0], np.array([[0.01]]), np.zeros((1, 1)), options)

    with refused(DesignInfeasible, "no-solution"):
        proof(own(0.5, lower=-1))  # -0.5 - 0.01 + 1 > 0: it does grow
    lure = own(1.5, lower=-1)
    made, u, x = proof(lure), np.array([1.5 * np.pi]), np.array([np.pi])
    design = observer.design(lure, np.ones(1, dtype=bool), gains=made)
    state = observer.init(design, 0.0, x + 1e-3)
    first = float(observer.error_norm(design, x - state.x))
    for _ in range(100):
        state = observer.step(design, state, x, u, np.ones(1, dtype=bool), 0.05)
    left = float(observer.error_norm(design, x - state.x))
    truth = np.exp(-(1.5 - 1 + 0.01) * 5)  # linearised where both are
    assert left / first == pytest.approx(truth, rel=1e-2)
    assert left <= first * np.exp(-5 * design.rate)


def test_gains_of_a_bank_are_those_of_its_single_observers() -> None:
    own = pendulum()
    wish: Any = {"rate": 0.2, "noise": 0.1, "load": np.zeros((1, 1)), "weight": np.eye(2)}
    gains = bank.lmi_gains(own, 1, options_for(own, **wish))
    masks = bank.subsets(5, 1, most=100).masks()
    assert gains.L.shape == (len(masks), 2, 5)
    for k in (0, len(masks) - 1):
        J = np.flatnonzero(masks[k])
        one = circle(own, J, **wish)
        assert np.allclose(gains.L[k][:, J], one.L, rtol=1e-4, atol=1e-4)
        assert np.allclose(gains.K[k][:, J], one.K, rtol=1e-4, atol=1e-4)
        assert not gains.L[k][:, ~masks[k]].any()


def test_the_believed_estimate_is_right_and_leaves_the_liar_out() -> None:
    own = pendulum()
    wish = options_for(own, rate=0.2, noise=0.1, load=np.zeros((1, 1)), weight=np.eye(2))
    made = bank.design(own, 1, gains=bank.lmi_gains(own, 1, wish))
    x, u = np.array([1.0, 0.0]), np.ones(1)
    state = bank.init(made, own.C @ x, u, ALL)
    for _ in range(600):
        state = bank.step(made, state, own.C @ x + [0, 0, 0, 2.0, 0], u, ALL, h=0.01)
        x = advance(own, x, u, 0.01)
    estimate, trusted = bank.believe(made, state)
    assert estimate == pytest.approx(x, abs=1e-3)
    assert np.flatnonzero(~trusted).tolist() == [3]
    # Two live meters confirm nobody.
    state = bank.step(made, state, own.C @ x, u, np.arange(5) < 2, h=0.01)
    estimate, trusted = bank.believe(made, state)
    assert np.isnan(estimate).all()
    assert not trusted.any()


def test_without_inverses_the_nearest_points_are_taken_for_all_sets_and_the_whole() -> None:
    model, wish = bent(), {"theta": 12.0, "noise": 2e-4, "max_attacked": 1, "u_low": -0.4, "u_high": 0.4}
    short = high_gain.design(model, **wish, step_s=0.02)  # type: ignore[arg-type]  # a mixed dictionary
    accept = min(one.epsilon for one in short.decays)
    long = high_gain.design(
        model,
        [nearest(model, group, accept=accept) for group in groups(3, 1)],
        whole=nearest(model, range(3), accept=accept),
        **wish,  # type: ignore[arg-type]  # likewise
        step_s=0.02,
    )
    t, x, u = truth(3.0)
    y = x[:, [0, 0, 0]] + np.outer(t > 2.0, [0.5, 0.0, 0.0])
    states = [high_gain.init(made, 0.0) for made in (short, long)]
    answers: list[Any] = [None, None]
    for k in range(1, len(t)):
        for i, made in enumerate((short, long)):
            states[i], answers[i] = high_gain.step(made, states[i], y[k], u[k : k + 1], ALL[:3], 0.02)
        assert np.array_equal(answers[0].x, answers[1].x)
        assert answers[0].decision is answers[1].decision
    assert answers[0].decision is Decision.ATTACKED
    assert np.flatnonzero(answers[0].suspects).tolist() == [0]


def test_too_few_sensors_are_refused_without_inverses_too() -> None:
    with refused(NotObservable, "too-few-meters"):
        high_gain.design(bent(), theta=12.0, noise=2e-4, max_attacked=2, u_low=-0.4, u_high=0.4, step_s=0.02)


def test_a_sensor_that_nothing_has_tested_is_not_called_clean() -> None:
    model = bent()
    sets = [nearest(model, group, accept=1e-4) for group in groups(3, 1)]
    made = high_gain.design(
        model, sets, theta=12.0, noise=2e-4, max_attacked=1, u_low=-0.4, u_high=0.4, step_s=0.02
    )
    t, x, u = truth(8.0)
    y = x[:, [0, 0, 0]] + np.outer(t > 6.0, [0.5, 0.0, 0.0])
    state, answers = high_gain.init(made, 0.0), []
    for k in range(1, len(t)):
        state, answer = high_gain.step(made, state, y[k], u[k : k + 1], ALL[:3], 0.02)
        answers.append(answer)
    # Sensors 1 and 2 are in use from the beginning, so that the lie of sensor 0 is in no residual.
    assert all(one.decision is Decision.UNDECIDED for one in answers)
    assert answers[-1].cause is Cause.AMBIGUOUS
    assert answers[-1].x == pytest.approx(x[-1], abs=0.02)
    # Nothing else is heard: what is heard is tested.
    state, answer = high_gain.step(made, state, y[-1], u[-1:], np.array([False, True, True]), 0.02)
    assert answer.decision is Decision.CLEAN


@lru_cache
def small_bank(*, integrator: bool) -> bank.Bank:
    H, phi = ([[0, 1]], np.tanh) if integrator else ([[1, 0]], curve)
    own = Lure.of(A, C, G=[[0], [-1]], H=H, B=[[0], [1]], phi=phi, slope=1 if integrator else 2)
    options = options_for(own, rate=0.2, noise=0.1, load=np.zeros(1), weight=np.eye(2))
    return bank.design(own, 1, gains=bank.lmi_gains(own, 1, options))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_reading_that_is_no_number_is_none(value: float) -> None:
    made, u = small_bank(integrator=False), np.ones(1)
    y = made.lure.C @ np.array([1.0, 0.0])
    told, unseen = np.where(np.arange(5) == 1, value, y), np.arange(5) != 1
    one, other = bank.init(made, told, u, ALL), bank.init(made, y, u, unseen)
    for _ in range(3):
        assert isinstance(one, StackedState)
        assert isinstance(other, StackedState)
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.seen, unseen)
        one, other = (
            bank.step(made, state, read, u, seen, h=0.01)
            for state, read, seen in ((one, told, ALL), (other, y, unseen))
        )
    estimate, trusted = bank.believe(made, one)
    assert np.isfinite(estimate).all()
    assert not trusted[1]


@pytest.mark.parametrize("heard", [[], [0], [0, 1]])
def test_a_bank_starts_where_an_integrator_is_not_heard(heard: list[int]) -> None:
    """Sets that hear nobody have no equilibrium; all others are in theirs."""
    made, u, seen = small_bank(integrator=True), np.ones(1), np.isin(np.arange(5), heard)
    own, gains = made.lure, made.gains
    assert gains is not None
    y = own.C @ np.array([1.0, 0.2])
    state = bank.init(made, y, u, seen)
    assert isinstance(state, StackedState)
    assert np.isfinite(state.x).all()
    for x, L, K, mask in zip(state.x, gains.L, gains.K, made.masks, strict=True):
        e = np.where(seen, y - own.C @ x, 0.0)
        rest = own.A @ x + own.G @ np.tanh(own.H @ x + K @ e) + own.B @ u + L @ e
        if (mask & seen).any():
            assert np.abs(rest).max() <= 1e-6 * max(1.0, np.abs(L).max())
