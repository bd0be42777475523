"""Droop curves against plain interpolation, the slopes of chong2020 (18), and the presets' numbers."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given

from gridsec.errors import FeederInvalid
from gridsec.estimators.detection import curve_mismatch
from gridsec.grid.devices import PRESETS, Droop, capped, fleet, preset, voltage_curve
from gridsec.planning.droop.stability import enlarged, steepened
from tests.codes import refused

seeds = st.integers(0, 100_000)


def random_fleet(seed: int, *, deadband: bool = False) -> Droop:
    rng = np.random.default_rng(seed)
    m = int(rng.integers(1, 8))
    v = np.sort(rng.uniform(0.85, 1.15, (m, 4)), axis=1)
    q = -np.sort(-rng.uniform(-0.2, 0.2, (m, 4)), axis=1)
    if deadband or seed % 2:
        q[:, 1:3] = 0.0
        q[:, 0], q[:, 3] = np.abs(q[:, 0]), -np.abs(q[:, 3])
    if seed % 3 == 0:
        v[:], q[:] = v[0], q[0]
    return Droop(rng.integers(0, 5, m), v, q, rng.uniform(0.5, 20.0, m), float(rng.uniform(0.95, 1.05)))


def interpolated(droop: Droop, z: np.ndarray) -> np.ndarray:
    """The same curve by NumPy's interpolation between the mapped breakpoints."""
    columns = [
        np.interp(z[:, i], (droop.vbar**2 - droop.v[i] ** 2)[::-1], droop.q[i][::-1])
        for i in range(droop.tau.size)
    ]
    return np.stack(columns, axis=1)


@given(seeds)
def test_curve_is_linear_between_mapped_breakpoints(seed: int) -> None:
    droop = random_fleet(seed)
    z = np.random.default_rng(seed).uniform(-0.5, 0.5, (50, droop.tau.size))
    z = np.vstack([z, (droop.vbar**2 - droop.v**2).T])
    assert np.allclose(droop(z), interpolated(droop, z), rtol=0, atol=1e-13)


@given(seeds)
def test_gathered_evaluation(seed: int) -> None:
    droop = random_fleet(seed)
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, droop.tau.size, (3, 4))
    z = rng.uniform(-0.5, 0.5, (3, 4))
    everywhere = droop(np.repeat(z[..., None], droop.tau.size, axis=-1))
    expected = np.take_along_axis(everywhere, rows[..., None], axis=-1)[..., 0]
    assert np.array_equal(droop(z, rows), expected)
    assert np.allclose(droop.take(rows.ravel())(z.ravel()), expected.ravel(), rtol=0, atol=1e-15)


@given(seeds)
def test_slopes_lie_in_the_sector_and_the_bound_is_attained(seed: int) -> None:
    droop = random_fleet(seed)
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-0.5, 0.5, (2, 200, droop.tau.size))
    quotient = (droop(a) - droop(b)) / (a - b)
    assert np.all(quotient >= -1e-9)
    assert np.all(quotient <= droop.slope * (1 + 1e-9) + 1e-9)
    z = droop.vbar**2 - droop.v**2
    steepest = np.max(np.diff(droop.q, axis=1) / np.diff(z, axis=1), axis=1)
    assert np.allclose(droop.slope, steepest, rtol=1e-9)


def test_slope_bound_is_the_larger_one() -> None:
    # Erratum of chong2020 (18): with the smaller slope the sector condition fails on the steep side.
    droop = fleet(np.array([0]), "asnzs4777-a", np.array([10.0]), 100.0)
    z = 1.0 - droop.v[0] ** 2
    absorbing, injecting = 0.06 / (z[2] - z[3]), 0.044 / (z[0] - z[1])
    assert droop.slope[0] == pytest.approx(max(absorbing, injecting))
    a, b = np.array([0.9 * z[0] + 0.1 * z[1]]), np.array([0.1 * z[0] + 0.9 * z[1]])
    assert (droop(a) - droop(b))[0] > 1.1 * min(absorbing, injecting) * (a - b)[0]


@given(seeds)
def test_saturation(seed: int) -> None:
    droop = random_fleet(seed)
    assert np.array_equal(droop.limit, np.max(np.abs(droop.q), axis=1))
    far = np.full(droop.tau.size, np.inf)
    assert np.allclose(droop(far), droop.q[:, 0], rtol=0, atol=1e-15)
    assert np.allclose(droop(-far), droop.q[:, 3], rtol=0, atol=1e-15)


@given(seeds)
def test_deadband_is_exactly_zero(seed: int) -> None:
    droop = random_fleet(seed, deadband=True)
    inside = droop.vbar**2 - np.linspace(droop.v[:, 1], droop.v[:, 2], 9)[1:-1] ** 2
    assert not droop(inside).any()


@given(seeds)
def test_two_readings_of_a_curve_stay_within_the_gap(seed: int) -> None:
    droop = random_fleet(seed)
    v = np.linspace(0.8, 1.2, 801)[:, None] * np.ones(droop.tau.size)
    apart = np.abs(droop(droop.vbar**2 - v**2) - voltage_curve(droop, v))
    # docs/theory-model.md: the bound is attained half-way (in v) between the worst pair of breakpoints.
    widths = (droop.v[:, 1:] - droop.v[:, :-1]) / (droop.v[:, 1:] + droop.v[:, :-1])
    gap = np.max((droop.q[:, :-1] - droop.q[:, 1:]) * widths / 4.0, axis=1)
    assert np.all(apart <= gap + 1e-14)
    assert np.allclose(curve_mismatch(droop), gap, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", PRESETS)
def test_gap_of_the_presets_is_small(name: str) -> None:
    # docs/theory-model.md quotes this: at most 0.55 % of the rating, 1.4 % of the limit.
    droop = fleet(np.array([0]), name, np.array([100.0]), 100.0)
    assert curve_mismatch(droop)[0] < 0.0055
    assert curve_mismatch(droop)[0] < 0.014 * droop.limit[0] + 1e-12


@given(seeds)
def test_voltage_curve_interpolates_in_the_voltage(seed: int) -> None:
    droop = random_fleet(seed)
    v = np.random.default_rng(seed).uniform(0.8, 1.2, (30, droop.tau.size))
    expected = np.stack([np.interp(v[:, i], droop.v[i], droop.q[i]) for i in range(droop.tau.size)], axis=1)
    assert np.allclose(voltage_curve(droop, v), expected, rtol=0, atol=1e-13)


@given(seeds)
def test_cap_keeps_slopes_and_limits_the_output(seed: int) -> None:
    droop = random_fleet(seed, deadband=True)
    rng = np.random.default_rng([seed, 1])
    cap = rng.uniform(0.0, 1.2, droop.tau.size) * droop.limit
    tight = capped(droop, cap)
    v = np.linspace(0.8, 1.2, 401)[:, None] * np.ones(droop.tau.size)
    expected = np.clip(voltage_curve(droop, v), -cap, cap)
    assert np.allclose(voltage_curve(tight, v), expected, rtol=0, atol=1e-13)
    assert np.all(tight.limit <= cap + 1e-15)


def test_cap_of_zero_switches_the_inverter_off() -> None:
    tight = capped(fleet(np.array([0]), "vde4105", np.array([10.0]), 100.0), np.zeros(1))
    assert not tight(np.linspace(-0.5, 0.5, 11)[:, None]).any()
    assert tight.slope[0] == tight.limit[0] == 0.0


def test_cap_below_a_curve_without_deadband_at_zero() -> None:
    # The whole curve lies above the cap: what is left is the cap, everywhere.
    droop = Droop(
        np.array([0]), np.array([[0.9, 1.0, 1.0, 1.1]]), np.array([[0.4, 0.3, 0.3, 0.2]]), np.ones(1)
    )
    tight = capped(droop, np.array([0.1]))
    assert np.allclose(tight(np.linspace(-0.5, 0.5, 11)[:, None]), 0.1)


def test_circular_capability() -> None:
    own, rated = np.array([0, 1]), np.array([5.0, 5.0])
    p = np.array([0.03, 0.05])
    droop = fleet(own, "ieee1547-b", rated, 100.0, capability="circular", p_gen=p)
    assert droop.limit[0] == pytest.approx(0.022)  # sqrt(0.05^2 - 0.03^2) = 0.04 does not bind
    assert droop.limit[1] == 0.0
    p = np.array([0.048, 0.0])
    droop = fleet(own, "ieee1547-b", rated, 100.0, capability="circular", p_gen=p)
    fixed = fleet(own, "ieee1547-b", rated, 100.0)
    assert droop.limit[0] == pytest.approx(0.014)
    assert droop.slope[0] == pytest.approx(fixed.slope[0], rel=0.02)
    assert np.array_equal(droop.q[1], fixed.q[1])


def test_ratings_stay_with_their_inverters_whatever_caps_the_curve() -> None:
    droop = fleet(np.array([0, 3]), "ieee1547-b", np.array([5.0, 20.0]), 100.0)
    assert droop.rating.tolist() == [0.05, 0.2]
    assert droop.take(np.array([1, 1, 0])).rating.tolist() == [0.2, 0.2, 0.05]
    assert capped(droop, np.array([0.01, 0.0])).rating.tolist() == [0.05, 0.2]
    assert enlarged(droop, 3.0).rating == pytest.approx([0.15, 0.6])
    assert steepened(droop, 2.0).rating.tolist() == [0.05, 0.2]
    untold = Droop(droop.customer, droop.v, droop.q, droop.tau)
    assert untold.rating.tolist() == enlarged(untold, 0.0).rating.tolist() == [np.inf, np.inf]
    assert replace(untold, rating=np.array(0.3)).rating.tolist() == [0.3, 0.3]


# name, voltages, injections, time constant; from the tables that droop.py cites.
TABLE = [
    ("ieee1547-a", [0.90, 1.00, 1.00, 1.10], [0.25, 0, 0, -0.25], 4.3429),
    ("ieee1547-b", [0.92, 0.98, 1.02, 1.08], [0.44, 0, 0, -0.44], 2.1715),
    ("asnzs4777-a", [0.9, 0.956522, 1.043478, 1.121739], [0.44, 0, 0, -0.60], 3.3333),
    ("asnzs4777-b", [0.891304, 0.956522, 1.021739, 1.108696], [0.30, 0, 0, -0.40], 3.3333),
    ("asnzs4777-c", [0.934783, 1.0, 1.043478, 1.108696], [0.44, 0, 0, -0.60], 3.3333),
    ("vde4105", [0.93, 0.97, 1.03, 1.07], [0.436, 0, 0, -0.436], 3.3333),
    ("vde4105-small", [0.93, 0.97, 1.03, 1.07], [0.312, 0, 0, -0.312], 3.3333),
]


@pytest.mark.parametrize(("name", "v", "q", "tau"), TABLE)
def test_presets(name: str, v: list[float], q: list[float], tau: float) -> None:
    curve = preset(name)
    assert curve.v == pytest.approx(v, abs=1e-6)
    assert curve.q == pytest.approx(q)
    assert curve.tau == pytest.approx(tau, abs=1e-4)
    assert curve.source


def test_all_presets_are_in_the_table() -> None:
    assert sorted(row[0] for row in TABLE) == sorted(PRESETS)


def test_open_loop_response_time_is_ninety_percent() -> None:
    assert 1 - np.exp(-10.0 / preset("ieee1547-a").tau) == pytest.approx(0.9)
    assert 1 - np.exp(-10.0 / preset("vde4105").tau) == pytest.approx(0.95, abs=0.001)


def test_fleet_scales_to_the_base_of_the_feeder() -> None:
    droop = fleet(
        np.array([2, 0]), ["ieee1547-b", "vde4105"], np.array([10.0, 4.0]), 400.0, tau=np.array([np.nan, 7.0])
    )
    assert droop.q[0, 0] == pytest.approx(0.44 * 10 / 400)
    assert droop.q[1, 3] == pytest.approx(-0.436 * 4 / 400)
    assert droop.tau == pytest.approx([5 / np.log(10), 7.0])
    assert droop.customer.tolist() == [2, 0]


def test_no_inverters_at_all() -> None:
    droop = fleet(np.array([], dtype=np.intp), [], np.zeros(0), 100.0)
    assert droop(np.zeros((3, 0))).shape == (3, 0)
    assert voltage_curve(droop, np.zeros((3, 0))).shape == (3, 0)
    assert curve_mismatch(droop).shape == (0,)


@pytest.mark.parametrize(
    ("change", "codes"),
    [
        ({"v": [[0.9, 1.0, 0.95, 1.1]]}, ("order",)),
        ({"v": [[0.0, 0.9, 1.0, 1.1]]}, ("order",)),
        ({"q": [[0.1, 0.2, 0.0, -0.1]]}, ("not-monotone",)),
        ({"v": [[0.9, 0.9, 1.0, 1.1]]}, ("not-monotone",)),
        ({"q": [[0.1, 0.0, 0.0, np.nan]]}, ("not-finite",)),
        ({"tau": [0.0]}, ("not-positive",)),
        ({"tau": [np.inf]}, ("not-positive",)),
        ({"tau": [1.0, 1.0]}, ("shape", "shape")),
        ({"vbar": 0.0}, ("not-positive",)),
        ({"rating": [0.09]}, ("above-rating",)),
        ({"rating": [np.nan]}, ("above-rating",)),
        ({"rating": [0.2, 0.2]}, ("shape",)),
        ({"customer": [-1]}, ("unknown-index",)),
    ],
)
def test_impossible_curves_are_refused(change: dict[str, object], codes: tuple[str, ...]) -> None:
    good: dict[str, object] = {
        "customer": [0],
        "v": [[0.9, 0.98, 1.02, 1.1]],
        "q": [[0.1, 0.0, 0.0, -0.1]],
        "tau": [2.0],
        "vbar": 1.0,
    }
    with refused(FeederInvalid, *codes):
        Droop(**(good | change))


def test_every_problem_of_a_fleet_is_named_at_once() -> None:
    v, q = np.array([[0.9, 0.98, 1.02, 1.1]] * 3), np.array([[0.1, 0.0, 0.0, -0.1]] * 3)
    v[1] = v[1, ::-1]
    q[2, 0] = np.inf
    with refused(FeederInvalid, "not-finite", "order", "not-positive", "not-positive") as caught:
        Droop(np.arange(3), v, q, np.array([0.0, 1.0, -1.0]))
    assert [problem.split(":")[0] for problem in caught.value.problems] == [
        "inverter 2",
        "inverter 1",
        "inverter 0",
        "inverter 2",
    ]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ({"names": "ieee1547-x"}, "unknown-name"),
        ({"names": ["vde4105"] * 3}, "shape"),
        ({"rated_kva": np.array([5.0, 0.0])}, "not-positive"),
        ({"capability": "square"}, "unknown-name"),
        ({"capability": "circular"}, "missing"),
        ({"capability": "circular", "p_gen": np.array([0.0, 0.06])}, "above-rating"),
    ],
)
def test_impossible_fleets_are_refused(arguments: dict[str, object], code: str) -> None:
    good: dict[str, object] = {"customer": np.array([0, 1]), "names": "vde4105", "rated_kva": np.full(2, 5.0)}
    with refused(FeederInvalid, code):
        fleet(base_kva=100.0, **(good | arguments))


@given(st.floats(0.8, 1.2), st.floats(0.8, 1.2))
def test_curves_never_inject_more_at_a_higher_voltage(low: float, high: float) -> None:
    assume(low < high)
    droop = fleet(np.arange(len(PRESETS)), list(PRESETS), np.full(len(PRESETS), 5.0), 100.0)
    z = 1.0 - np.array([[low], [high]]) ** 2 * np.ones(len(PRESETS))
    at_low, at_high = droop(z)
    assert np.all(at_low >= at_high)
