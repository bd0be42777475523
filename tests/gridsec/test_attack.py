"""Attack signals against their equations, and properties that every kind shares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridsec.attack import (
    Attack,
    Bias,
    Coordinated,
    Drift,
    Random,
    Replay,
    Reports,
    Scaling,
    Stuck,
    active,
    apply,
    apply_all,
    coordinate,
    load_pattern,
    manipulated,
    most_affected,
    reach,
)
from gridsec.errors import InputInvalid
from tests.codes import refused

METERS = 5
WHO = np.array([1, 3])
ON, OFF = 100.0, 160.0


def honest(t: np.ndarray) -> np.ndarray:
    """A voltage of its own for every meter at every time: (T, p)."""
    return 1.0 + 0.01 * np.sin(t[:, None] / 17.0 + np.arange(METERS))


def reports(t: np.ndarray) -> Reports:
    shape = (t.size, METERS)
    return Reports(honest(t), np.full(shape, 2.0), np.full(shape, 0.5))


MAKE: dict[str, Callable[[], Attack]] = {
    "bias": lambda: Bias(WHO, ON, OFF, size=np.array([0.03, -0.02])),
    "scaling": lambda: Scaling(WHO, ON, OFF, factor=np.array([0.03, -0.02])),
    "drift": lambda: Drift(WHO, ON, OFF, rate=np.array([0.001, -0.002]), limit=np.array([0.03, 0.02])),
    "stuck": lambda: Stuck(WHO, ON, OFF),
    "replay": lambda: Replay(WHO, ON, OFF, delay_s=60.0),
    "random": lambda: Random(
        WHO, ON, OFF, low=np.array([0.01, 0.02]), high=np.array([0.02, 0.04]), hold_s=3.0, seed=7
    ),
    "coordinated": lambda: Coordinated(
        WHO,
        ON,
        OFF,
        shift=np.array([-0.03, -0.04]),
        p_shift=np.array([0.0, 30.0]),
        q_shift=np.array([0.0, 8.0]),
    ),
}
T = np.arange(90.0, 170.0, 0.5)
DURING = (T >= ON) & (T < OFF)


def lie(name: str) -> np.ndarray:
    """Reported minus honest voltage of the two attacked meters while they lie, (T, 2)."""
    return (apply(MAKE[name](), T, reports(T), honest).v - honest(T))[DURING][:, WHO]


@pytest.mark.parametrize("name", MAKE)
def test_only_the_named_meters_lie_and_only_in_their_interval(name: str) -> None:
    before = reports(T)
    after = apply(MAKE[name](), T, before, honest)
    touched = np.zeros((T.size, METERS), dtype=bool)
    touched[np.ix_(DURING, WHO)] = True
    for quantity in ("v", "p", "q"):
        np.testing.assert_array_equal(getattr(after, quantity)[~touched], getattr(before, quantity)[~touched])
    assert np.any(after.v[touched] != before.v[touched])
    np.testing.assert_array_equal(before.v, honest(T))  # the input is left alone
    np.testing.assert_array_equal(manipulated([MAKE[name]()], T, METERS), touched)


@pytest.mark.parametrize("name", MAKE)
def test_one_tick_at_a_time_gives_the_same(name: str) -> None:
    whole = apply(MAKE[name](), T, reports(T), honest)
    for k in reversed(range(T.size)):
        one = apply(MAKE[name](), T[k : k + 1], reports(T[k : k + 1]), honest)
        for quantity in ("v", "p", "q"):
            np.testing.assert_array_equal(getattr(one, quantity)[0], getattr(whole, quantity)[k])


def test_bias_adds() -> None:
    np.testing.assert_allclose(lie("bias"), np.broadcast_to([0.03, -0.02], (DURING.sum(), 2)), atol=1e-15)


def test_scaling_multiplies() -> None:
    np.testing.assert_allclose(lie("scaling"), honest(T)[DURING][:, WHO] * [0.03, -0.02], atol=1e-15)


def test_drift_grows_at_its_rate_up_to_its_limit() -> None:
    age = T[DURING] - ON
    expected = np.column_stack([np.minimum(0.001 * age, 0.03), -np.minimum(0.002 * age, 0.02)])
    np.testing.assert_allclose(lie("drift"), expected, atol=1e-15)
    assert expected[-1].tolist() == [0.03, -0.02]  # both limits are reached


def test_stuck_repeats_the_value_at_onset() -> None:
    reported = apply(MAKE["stuck"](), T, reports(T), honest).v[DURING][:, WHO]
    np.testing.assert_array_equal(reported, np.broadcast_to(honest(np.array([ON]))[:, WHO], reported.shape))


def test_replay_repeats_the_past() -> None:
    reported = apply(MAKE["replay"](), T, reports(T), honest).v[DURING][:, WHO]
    np.testing.assert_array_equal(reported, honest(T[DURING] - 60.0)[:, WHO])


def test_random_stays_between_its_limits_and_changes_sign() -> None:
    shift = lie("random")
    assert np.all(np.abs(shift) >= [0.01 - 1e-12, 0.02 - 1e-12])
    assert np.all(np.abs(shift) <= [0.02 + 1e-12, 0.04 + 1e-12])
    held = shift.reshape(-1, 6, 2)  # two samples a second, three seconds a draw
    assert np.ptp(held, axis=1).max() < 1e-14
    assert set(np.sign(held[:, 0, 0])) == set(np.sign(held[:, 0, 1])) == {-1.0, 1.0}


def test_random_draws_are_uniform_independent_and_seeded() -> None:
    t = np.arange(20_000.0)
    who = np.arange(2)
    flat = Reports(np.ones((t.size, 2)), np.zeros((t.size, 2)), np.zeros((t.size, 2)))

    def shifts(seed: int) -> np.ndarray:
        attack = Random(who, 0.0, np.inf, low=np.zeros(2), high=np.ones(2), hold_s=1.0, seed=seed)
        return apply(attack, t, flat, honest).v - 1.0

    u = shifts(1)  # uniform on [-1, 1]: mean 0, variance 1/3, fourth moment 1/5
    bound = 5.0 / np.sqrt(t.size)
    assert np.all(np.abs(u.mean(0)) < bound)
    assert np.all(np.abs((u**2).mean(0) - 1 / 3) < bound)
    assert np.all(np.abs((u**4).mean(0) - 1 / 5) < bound)
    pairs = [(u[:, 0], u[:, 1]), (u[:-1, 0], u[1:, 0]), (u[:, 0], shifts(2)[:, 0])]
    for a, b in pairs:
        assert abs(np.corrcoef(a, b)[0, 1]) < bound
    np.testing.assert_array_equal(u, shifts(1))


def test_coordinated_lies_in_power_too_but_invents_no_reactive_power() -> None:
    before = reports(T)
    before.q[:, 3] = np.nan  # this meter reports none
    after = apply(MAKE["coordinated"](), T, before, honest)
    np.testing.assert_allclose(after.p[DURING][:, WHO] - 2.0, np.broadcast_to([0.0, 30.0], (DURING.sum(), 2)))
    assert np.isnan(after.q[:, 3]).all()
    np.testing.assert_array_equal(after.q[:, 1], 0.5)


def test_several_attacks_add_up_in_their_order() -> None:
    both = [
        Bias(np.array([2]), ON, OFF, size=np.array([0.1])),
        Scaling(np.array([2]), ON, OFF, factor=np.array([0.5])),
    ]
    after = apply_all(both, T, reports(T), honest).v
    np.testing.assert_allclose(after[DURING][:, 2], 1.5 * (honest(T)[DURING][:, 2] + 0.1))
    np.testing.assert_array_equal(after[~DURING], honest(T)[~DURING])


def test_reach_covers_every_look_into_the_past() -> None:
    for name, make in MAKE.items():
        attack = make()
        for when in T[active(attack, T)]:
            asked: list[float] = []

            def past(times: np.ndarray, asked: list[float] = asked) -> np.ndarray:
                asked.extend(times)
                return honest(times)

            apply(attack, np.array([when]), reports(np.array([when])), past)
            assert all(when - reach(attack, when) <= earlier <= when for earlier in asked)
            assert bool(asked) == (name in {"stuck", "replay"})


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda: Stuck(np.array([], dtype=np.intp), ON, OFF), "shape"),
        (lambda: Stuck(np.array([1, 1]), ON, OFF), "duplicate"),
        (lambda: Stuck(np.array([-1]), ON, OFF), "unknown-index"),
        (lambda: Stuck(WHO, OFF, ON), "order"),
        (lambda: Stuck(WHO, np.nan, OFF), "order"),
        (lambda: Replay(WHO, ON, OFF, delay_s=0.0), "not-positive"),
        (lambda: Bias(WHO, ON, OFF, size=np.array([0.1])), "shape"),
        (lambda: Bias(WHO, ON, OFF, size=np.array([0.1, np.nan])), "not-finite"),
        (lambda: Scaling(WHO, ON, OFF, factor=np.zeros(3)), "shape"),
        (lambda: Drift(WHO, ON, OFF, rate=np.ones(2), limit=np.array([1.0, -1.0])), "negative"),
        (lambda: Random(WHO, ON, OFF, low=np.ones(2), high=np.zeros(2), hold_s=1.0, seed=0), "order"),
        (lambda: Random(WHO, ON, OFF, low=np.zeros(2), high=np.ones(2), hold_s=0.0, seed=0), "not-positive"),
        (
            lambda: Coordinated(WHO, ON, OFF, shift=np.zeros(2), p_shift=np.zeros(2), q_shift=np.zeros(1)),
            "shape",
        ),
    ],
)
def test_nonsense_is_refused(make: Callable[[], Attack], code: str) -> None:
    with refused(InputInvalid, code):
        make()


@given(
    pattern=st.lists(st.floats(-1.0, 1.0).filter(lambda x: abs(x) > 1e-6), min_size=1, max_size=30),
    count=st.integers(1, 30),
    size=st.floats(1e-3, 0.2),
)
def test_a_sized_pattern_moves_every_chosen_meter_by_at_least_the_size(
    pattern: list[float], count: int, size: float
) -> None:
    values = np.array(pattern)
    chosen = most_affected(values, min(count, values.size))
    moved = np.abs(coordinate(values, chosen, size) * values)
    assert np.min(moved[chosen]) == pytest.approx(size, rel=1e-12)
    others = np.delete(moved, chosen)
    assert np.all(others <= np.min(moved[chosen]) * (1 + 1e-12))  # no other meter is affected more


def test_a_meter_that_feels_nothing_cannot_be_moved() -> None:
    with refused(InputInvalid, "no-effect"):
        coordinate(np.array([0.0, 1.0]), np.array([0, 1]), 0.03)
    with refused(InputInvalid, "out-of-range"):
        most_affected(np.ones(2), 3)


def test_load_pattern_is_the_derivative_of_the_linear_power_flow() -> None:
    random = np.random.default_rng(3)
    R, X = random.uniform(0.0, 0.1, (2, 4, 4))
    p, q = random.normal(0.0, 0.3, (2, 4))
    ratio, h, target = 0.3, 1e-6, 2

    def volts(load: float) -> np.ndarray:
        extra = load * (np.arange(4) == target)
        return np.sqrt(1.02**2 + 2 * R @ (p - extra) + 2 * X @ (q - ratio * extra))

    expected = (volts(h) - volts(-h)) / (2 * h)
    np.testing.assert_allclose(load_pattern(R, X, target, ratio, volts(0.0)), expected, rtol=1e-8)
