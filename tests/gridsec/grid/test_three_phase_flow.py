"""LinDist3Flow and its correction, against walking, nodal admittances, and the balanced feeder."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
from gridsec.grid.three_phase import (
    ThreePhaseFeeder,
    bus_voltages,
    lindist3flow,
    model_error_bound,
    per_customer,
    sensitivities,
    sequence_matrix,
)
from tests.codes import refused
from tests.gridsec.radial import random_feeder
from tests.gridsec.unbalanced import power_flow, random_three_phase

seeds = st.integers(0, 100_000)


def path(feeder: ThreePhaseFeeder, bus: int) -> set[int]:
    out = set()
    while bus > 0:
        out.add(bus - 1)
        bus = int(feeder.parent[bus - 1])
    return out


def powers(feeder: ThreePhaseFeeder, seed: int, size: float) -> tuple[Floats, Floats]:
    rng = np.random.default_rng([seed, 7])
    return size * rng.normal(-0.5, 1.0, feeder.of.size), size * rng.normal(-0.2, 0.5, feeder.of.size)


@given(seeds)
def test_matrices_are_sums_over_common_branches(seed: int) -> None:
    feeder = random_three_phase(seed)
    model = lindist3flow(feeder)
    turn = np.exp(-2j * np.pi / 3 * np.arange(3))
    for k in range(len(feeder.buses)):
        for c in range(feeder.of.size):
            common = sorted(path(feeder, k) & path(feeder, int(feeder.at[c])))
            psi = feeder.phase[c]
            for phi in range(3):
                W = sum(feeder.z[b, phi, psi] * turn[psi] / turn[phi] for b in common)
                assert model.R_bus[phi, k, c] == pytest.approx(np.real(W), abs=1e-15)
                assert model.X_bus[phi, k, c] == pytest.approx(np.imag(W), abs=1e-15)
    np.testing.assert_array_equal(model.R, model.R_bus[feeder.phase, feeder.at])
    np.testing.assert_array_equal(model.X, model.X_bus[feeder.phase, feeder.at])


@given(seeds)
@settings(max_examples=30)
def test_matrices_are_the_derivatives_of_the_power_flow_without_load(seed: int) -> None:
    feeder = random_three_phase(seed)
    model = lindist3flow(feeder)
    none, step = np.zeros(feeder.of.size), 1e-5
    for c in range(feeder.of.size):
        unit = step * (np.arange(feeder.of.size) == c)
        for matrix, up, down in (
            (model.R_bus, (unit, none), (-unit, none)),
            (model.X_bus, (none, unit), (none, -unit)),
        ):
            higher, lower = (np.abs(power_flow(feeder, *at, np.ones(3))) ** 2 for at in (up, down))
            slope = (higher - lower) / (2 * step)
            there = ~np.isnan(slope)
            np.testing.assert_allclose(slope[there], 2 * matrix[..., c][there], rtol=0, atol=1e-8)


@given(seeds, st.sampled_from([0.0, 0.05]))
@settings(max_examples=30)
def test_sensitivities_are_the_derivatives_under_load(seed: int, charging: float) -> None:
    feeder = random_three_phase(seed, charging=charging)
    p, q = powers(feeder, seed, 0.03)
    v0, step = np.array([1.03, 1.0, 0.98]), 1e-5
    model = sensitivities(feeder, p, q, v0, steps=25)
    for c in range(feeder.of.size):
        unit = step * (np.arange(feeder.of.size) == c)
        for matrix, up, down in (
            (model.R_bus, (p + unit, q), (p - unit, q)),
            (model.X_bus, (p, q + unit), (p, q - unit)),
        ):
            higher, lower = (np.abs(power_flow(feeder, *at, v0)) ** 2 for at in (up, down))
            slope = (higher - lower) / (2 * step)
            there = ~np.isnan(slope)
            np.testing.assert_allclose(slope[there], 2 * matrix[..., c][there], rtol=0, atol=1e-8)
    np.testing.assert_array_equal(model.R, model.R_bus[feeder.phase, feeder.at])
    np.testing.assert_array_equal(model.X, model.X_bus[feeder.phase, feeder.at])


@given(seeds)
def test_sensitivities_without_load_are_the_linear_flow(seed: int) -> None:
    feeder = random_three_phase(seed)
    none = np.zeros(feeder.of.size)
    found, expected = sensitivities(feeder, none, none, np.full(3, 1.1), steps=1), lindist3flow(feeder)
    for name in ("R", "X", "R_bus", "X_bus"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=0, atol=1e-14)


@given(seeds)
def test_sweeps_and_matrices_are_the_same_linear_flow(seed: int) -> None:
    feeder = random_three_phase(seed)
    p, q = powers(feeder, seed, 0.05)
    v0 = np.array([1.04, 0.98, 1.01])
    swept = bus_voltages(feeder, p, q, v0, steps=0)
    model = lindist3flow(feeder)
    np.testing.assert_allclose(swept[:, 0], v0, rtol=0, atol=1e-15)
    direct = v0[:, None] + 2 * (model.R_bus @ p + model.X_bus @ q)
    np.testing.assert_allclose(swept, direct, rtol=0, atol=1e-13)
    at = v0[feeder.phase] + 2 * (model.R @ p + model.X @ q)
    np.testing.assert_allclose(swept[feeder.phase, feeder.at], at, rtol=0, atol=1e-13)


@given(seeds, st.sampled_from([0.0, 0.02]))
def test_a_balanced_feeder_is_the_single_phase_equivalent(seed: int, charging: float) -> None:
    one = random_feeder(seed, charging=charging)
    rng = np.random.default_rng(seed)
    count = one.parent.size
    zero = rng.uniform(1.0, 4.0, count) * (one.r + 1j * one.x)
    three = ThreePhaseFeeder(
        name="same",
        parent=one.parent,
        z=sequence_matrix(one.r + 1j * one.x, zero),
        phases=np.ones((count + 1, 3), dtype=bool),
        bus=one.bus,
        connected=np.ones((one.bus.size, 3), dtype=bool),
        customers=one.customers,
        buses=one.buses,
        base_volt=one.base_volt,
        base_kva=one.base_kva,
        charging=sequence_matrix(one.charging, 0.5 * one.charging).real,
    )
    p, q = 0.1 * rng.normal(size=(2, one.bus.size))
    # kW / S on the balanced feeder, kW / (S / 3) here.
    own_p, own_q = three.connections(3 * p), three.connections(3 * q)
    linear = one.bus_voltages(p, q, 1.02, steps=0)
    limit = one.bus_voltages(p, q, 1.02, steps=40)
    v0 = np.full(3, 1.02)
    for phase in range(3):
        got = bus_voltages(three, own_p, own_q, v0, steps=0)[phase]
        np.testing.assert_allclose(got, linear, rtol=0, atol=1e-13)
        got = bus_voltages(three, own_p, own_q, v0, steps=40)[phase]
        np.testing.assert_allclose(got, limit, rtol=0, atol=1e-11)


@given(seeds, st.sampled_from([0.0, 0.05]))
def test_corrections_converge_to_the_power_flow(seed: int, charging: float) -> None:
    feeder = random_three_phase(seed, charging=charging)
    p, q = powers(feeder, seed, 0.05)
    v0 = np.array([1.05, 1.0, 0.97])
    truth = np.abs(power_flow(feeder, p, q, v0)) ** 2
    there = ~np.isnan(truth)
    limit = bus_voltages(feeder, p, q, v0, steps=60)
    np.testing.assert_allclose(limit[there], truth[there], rtol=0, atol=1e-11)


@given(seeds)
def test_the_bound_holds(seed: int) -> None:
    feeder = random_three_phase(seed, charging=0.02 * (seed % 2))
    p, q = powers(feeder, seed, 0.04)
    v0 = np.array([1.02, 1.0, 0.98])
    truth = (np.abs(power_flow(feeder, p, q, v0)) ** 2)[feeder.phase, feeder.at]
    found = bus_voltages(feeder, p, q, v0)[feeder.phase, feeder.at]
    assert (np.abs(found - truth) <= model_error_bound(feeder, p, q, v0) + 1e-13).all()


def test_one_correction_leaves_an_error_of_third_order() -> None:
    feeder = random_three_phase(4, branches=12)
    p, q = powers(feeder, 4, 0.01)
    v0 = np.ones(3)
    errors = []
    for size in (1.0, 2.0, 4.0):
        truth = np.abs(power_flow(feeder, size * p, size * q, v0)) ** 2
        linear = bus_voltages(feeder, size * p, size * q, v0, steps=0)
        once = bus_voltages(feeder, size * p, size * q, v0, steps=1)
        errors.append([np.nanmax(np.abs(v - truth)) for v in (linear, once)])
    (_, _), (second, third) = np.diff(np.log2(errors), axis=0)
    assert 1.9 < second < 2.2
    assert 2.8 < third < 3.3
    assert errors[-1][1] < 0.2 * errors[-1][0]


def test_no_bound_near_collapse() -> None:
    feeder = replace(random_three_phase(3, branches=6))
    p, q = np.full((2, feeder.of.size), -30.0)
    assert np.isinf(model_error_bound(feeder, p, q, np.ones(3))).any()


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8, 1.2, 1.5])
def test_the_bound_holds_up_to_voltage_collapse(angle: float) -> None:
    """Three lines that do not touch, in closed form: ``u^2 - (1 + 2 (r p + x q)) u + |z|^2 |s|^2 = 0``."""
    plain, size = random_three_phase(1, branches=1), np.linspace(0.01, 1.0, 100)
    line = replace(
        plain,
        z=(np.exp(1j * angle) * np.eye(3))[None],
        phases=np.ones((2, 3), dtype=np.bool_),
        charging=np.zeros((1, 3, 3)),
        bus=np.ones(3, dtype=np.intp),
        connected=np.eye(3, dtype=np.bool_),
        customers=("a", "b", "c"),
    )
    for turn in np.linspace(-3.1, 3.1, 21):
        s = size[:, None] * np.exp(1j * (turn + np.array([0.0, 0.4, 0.9])))
        bound = model_error_bound(line, s.real, s.imag, np.ones((size.size, 3)))
        found = bus_voltages(line, s.real, s.imag, np.ones((size.size, 3)))[..., 1]
        there = 1.0 + 2.0 * (np.cos(angle) * s.real + np.sin(angle) * s.imag)
        left = there**2 - 4.0 * np.abs(s) ** 2
        some = np.isfinite(bound)
        assert some[0].all()
        assert (left[some] >= 0.0).all()
        exact = 0.5 * (there + np.sqrt(np.maximum(left, 0.0)))
        assert (np.abs(found - exact)[some] <= bound[some] + 1e-12).all()


@pytest.mark.parametrize(("power", "v0"), [(np.nan, 1.0), (np.inf, 1.0), (-0.1, 0.0), (-0.1, np.nan)])
def test_nothing_is_claimed_where_nothing_is_known(power: float, v0: float) -> None:
    """No exception, no warning, and no finite bound."""
    feeder = random_three_phase(3, branches=6, charging=0.01)
    p = np.full(feeder.of.size, -0.01)
    p[0] = power
    away = feeder.at > 0
    assert away.any()
    assert np.isinf(model_error_bound(feeder, p, 0.1 * p, np.full(3, v0))[away]).all()
    assert bus_voltages(feeder, p, 0.1 * p, np.full(3, v0)).shape == (3, len(feeder.buses))


def test_feeders_without_branches_or_without_customers() -> None:
    bare = ThreePhaseFeeder(
        name="bare",
        parent=np.zeros(0, dtype=np.intp),
        z=np.zeros((0, 3, 3)),
        phases=np.ones((1, 3), dtype=bool),
        bus=np.array([0]),
        connected=np.array([[1, 1, 1]], dtype=bool),
        customers=("kiosk",),
        buses=("busbar",),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros((0, 3, 3)),
    )
    np.testing.assert_array_equal(lindist3flow(bare).R, np.zeros((3, 3)))
    np.testing.assert_allclose(bus_voltages(bare, -np.ones(3), np.zeros(3), np.ones(3)), np.ones((3, 1)))
    empty = replace(
        random_three_phase(5),
        bus=np.zeros(0, dtype=np.intp),
        connected=np.zeros((0, 3), dtype=bool),
        customers=(),
    )
    model = lindist3flow(empty)
    assert per_customer(empty, model).R.shape == model.R.shape == (0, 0)
    assert sensitivities(empty, np.zeros(0), np.zeros(0), np.ones(3)).X.shape == (0, 0)
    idle = bus_voltages(empty, np.zeros(0), np.zeros(0), np.full(3, 1.1))
    np.testing.assert_allclose(idle, np.full((3, len(empty.buses)), 1.1))


def test_a_single_phase_lateral_in_closed_form() -> None:
    z = np.zeros((1, 3, 3), dtype=complex)
    z[0, 1, 1] = 0.03 + 0.02j
    feeder = ThreePhaseFeeder(
        name="lateral",
        parent=np.array([0]),
        z=z,
        phases=np.array([[1, 1, 1], [0, 1, 0]], dtype=bool),
        bus=np.array([1]),
        connected=np.array([[0, 1, 0]], dtype=bool),
        customers=("house",),
        buses=("busbar", "end"),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros((1, 3, 3)),
    )
    p, q, v0 = np.array([-0.4]), np.array([-0.1]), np.array([1.0, 1.1, 1.2])
    model = lindist3flow(feeder)
    np.testing.assert_allclose([model.R[0, 0], model.X[0, 0]], [0.03, 0.02])
    # v^4 + (2 (r P + x Q) - v0^2) v^2 + |z|^2 |S|^2 = 0
    b = 2 * (0.03 * 0.4 + 0.02 * 0.1) - 1.1
    expected = (-b + np.sqrt(b**2 - 4 * (0.03**2 + 0.02**2) * (0.4**2 + 0.1**2))) / 2
    found = bus_voltages(feeder, p, q, v0, steps=40)
    np.testing.assert_allclose(found, [[1.0, 1.0], [1.1, expected], [1.2, 1.2]], rtol=1e-13)


def test_many_operating_points_at_once() -> None:
    feeder = random_three_phase(11, branches=9, charging=0.02)
    rng = np.random.default_rng(0)
    p, q = 0.03 * rng.normal(size=(2, 4, 5, feeder.of.size))
    v0 = rng.uniform(0.95, 1.05, (4, 5, 3))
    found, bound = bus_voltages(feeder, p, q, v0, steps=3), model_error_bound(feeder, p, q, v0)
    assert found.shape == (4, 5, 3, 10)
    for i, j in np.ndindex(4, 5):
        one = p[i, j], q[i, j], v0[i, j]
        np.testing.assert_allclose(found[i, j], bus_voltages(feeder, *one, steps=3), rtol=0, atol=1e-15)
        np.testing.assert_allclose(bound[i, j], model_error_bound(feeder, *one), rtol=1e-9)


def test_sensitivities_have_a_step() -> None:
    feeder = random_three_phase(1)
    none = np.zeros(feeder.of.size)
    with refused(InputInvalid, "out-of-range"):
        sensitivities(feeder, none, none, np.ones(3), steps=0)
