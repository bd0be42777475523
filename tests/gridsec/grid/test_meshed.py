"""Meshed feeders against the inverse of their admittances, against radial ones, and the AC power flow."""

from __future__ import annotations

from dataclasses import fields, replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid
from gridsec.grid.devices import fleet
from gridsec.grid.meshed import MeshedFeeder, admittance, impedances
from gridsec.observers.certificates import certify, verify
from gridsec.observers.lure import close_loop
from tests.codes import refused
from tests.gridsec.derivatives import derivatives_are
from tests.gridsec.meshes import ac, random_mesh
from tests.gridsec.radial import random_feeder

seeds = st.integers(0, 100_000)


def loads(feeder: MeshedFeeder, seed: int, size: float = 0.02) -> tuple[Floats, Floats]:
    """Random injections, more drawn than fed in."""
    p, q = size * np.random.default_rng([seed, 3]).normal([[-0.5], [-0.2]], 1.0, (2, feeder.bus.size))
    return p, q


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_without_ties_it_is_the_radial_feeder(seed: int) -> None:
    feeder = random_mesh(seed, ties=0, charging=0.01)
    model = feeder.tree.linear()
    np.testing.assert_array_equal(feeder.R, model.R_bus)
    np.testing.assert_array_equal(feeder.X, model.X_bus)
    np.testing.assert_array_equal(feeder.half, feeder.tree.half)
    p, q = loads(feeder, seed)
    linear = feeder.tree.bus_voltages(p, q, 1.03, steps=0)
    np.testing.assert_allclose(feeder.bus_voltages(p, q, 1.03, steps=0), linear, rtol=0, atol=1e-12)
    # Both iterations end in the AC power flow.
    far = [feeder.bus_voltages(p, q, 1.03, steps=60), feeder.tree.bus_voltages(p, q, 1.03, steps=60)]
    np.testing.assert_allclose(*far, rtol=0, atol=1e-11)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_impedances_invert_the_admittances(seed: int) -> None:
    feeder = random_mesh(seed)
    lines = zip(feeder.ends, feeder.r + 1j * feeder.x, strict=True)
    tree = feeder.tree
    branches = zip(zip(tree.parent, range(1, 99), strict=False), tree.r + 1j * tree.x, strict=True)
    Y = np.zeros((len(feeder.buses), len(feeder.buses)), dtype=complex)
    for (i, j), z in [*branches, *lines]:
        Y[[i, j], [i, j]] += 1.0 / z
        Y[[i, j], [j, i]] -= 1.0 / z
    np.testing.assert_allclose(admittance(feeder).toarray(), Y, rtol=0, atol=1e-12 * np.abs(Y).max())
    every = np.arange(len(feeder.buses))
    Z = impedances(feeder, every)
    np.testing.assert_array_equal(Z[0], 0.0)
    np.testing.assert_allclose(Z[1:, 1:], np.linalg.inv(Y[1:, 1:]), rtol=0, atol=1e-11)
    for part in (Z.real, Z.imag):
        np.testing.assert_allclose(part, part.T, rtol=0, atol=1e-13)
        assert np.linalg.eigvalsh(0.5 * (part + part.T))[0] >= -1e-13
    np.testing.assert_allclose(feeder.R + 1j * feeder.X, Z[:, feeder.bus], rtol=0, atol=1e-15)


def test_two_equal_lines_in_parallel_are_one_of_half_the_impedance() -> None:
    tree = random_feeder(5)
    ends = np.column_stack([tree.parent, np.arange(1, len(tree.buses))])
    twice = MeshedFeeder(tree, ends, tree.r, tree.x, tree.charging)
    half = replace(tree, r=0.5 * tree.r, x=0.5 * tree.x).linear()
    np.testing.assert_allclose(twice.R, half.R_bus, rtol=0, atol=1e-15)
    np.testing.assert_allclose(twice.X, half.X_bus, rtol=0, atol=1e-15)


def test_a_ring_of_unlike_cables_can_couple_with_a_negative_sign() -> None:
    """The share of a current that flows either way round is complex, and turns a resistance around."""
    base = random_feeder(1, customers=2)
    tree = replace(
        base,
        parent=np.array([0, 1]),
        r=np.array([0.001, 0.05]),
        x=np.array([0.05, 0.001]),
        charging=np.zeros(2),
        buses=("o", "a", "b"),
        bus=np.array([1, 2]),
    )
    feeder = MeshedFeeder(tree, np.array([[0, 2]]), np.array([0.001]), np.array([0.05]), np.zeros(1))
    assert feeder.R[1, 1] < 0.0 < feeder.R[2, 1]
    p, q = np.array([0.0, -0.05]), np.zeros(2)
    assert ac(feeder, p, q, 1.0)[1] > 1.0  # A load at b raises a.
    assert feeder.bus_voltages(p, q, 1.0)[1] == pytest.approx(ac(feeder, p, q, 1.0)[1], abs=1e-5)


@pytest.mark.parametrize("charging", [0.0, 0.02])
@given(seed=seeds, size=st.sampled_from([0.003, 0.02, 0.08]))
@settings(max_examples=40, deadline=None)
def test_the_power_flow_is_within_the_bound(charging: float, seed: int, size: float) -> None:
    feeder = random_mesh(seed, charging=charging)
    p, q = loads(feeder, seed, size)
    v0 = float(np.random.default_rng(seed).uniform(0.95, 1.05) ** 2)
    bound = feeder.model_error_bound(p, q, v0)
    assert np.isfinite(bound).all()
    exact, found = ac(feeder, p, q, v0), feeder.bus_voltages(p, q, v0)
    error = np.abs(found - exact)[feeder.bus]
    assert (error <= bound + 2e-9).all()
    reach = float((feeder.size @ np.hypot(p, q)).max())
    assert (bound <= 10.0 * reach**3 + 1e-12).all()
    far = feeder.bus_voltages(p, q, v0, steps=40)
    np.testing.assert_allclose(far, exact, rtol=0, atol=2e-9)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_a_correction_gains_an_order(seed: int) -> None:
    feeder = random_mesh(seed)
    p, q = loads(feeder, seed, 0.01)
    exact = feeder.bus_voltages(p, q, 1.0, steps=60)
    errors = [np.abs(feeder.bus_voltages(p, q, 1.0, steps=k) - exact).max() for k in range(3)]
    reach = float((feeder.size @ np.hypot(p, q)).max())
    for k, error in enumerate(errors):
        assert error <= 6.0 * reach ** (k + 2) + 1e-13


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_the_matrices_are_the_derivatives_of_the_power_flow(seed: int) -> None:
    feeder = random_mesh(seed)
    step, none = 1e-3, np.zeros(feeder.bus.size)
    for k in range(feeder.bus.size):
        unit = step * (np.arange(none.size) == k)
        for column, up, down in (
            (feeder.R[:, k], (unit, none), (-unit, none)),
            (feeder.X[:, k], (none, unit), (none, -unit)),
        ):
            slope = (ac(feeder, *up, 1.0) - ac(feeder, *down, 1.0)) / (2.0 * step)
            np.testing.assert_allclose(slope, 2.0 * column, rtol=0, atol=1e-5)


def test_operating_points_are_taken_together() -> None:
    feeder = random_mesh(11, charging=0.01)
    p, q = (np.stack([each, 0.5 * each, 0.0 * each]) for each in loads(feeder, 11))
    v0 = np.array([1.0, 1.02, 0.97])
    for steps in (0, 1, 3):
        many = feeder.bus_voltages(p, q, v0, steps=steps)
        one = [feeder.bus_voltages(p[k], q[k], v0[k], steps=steps) for k in range(3)]
        np.testing.assert_allclose(many, one, rtol=0, atol=1e-14)
    many = feeder.model_error_bound(p, q, v0)
    np.testing.assert_allclose(
        many, [feeder.model_error_bound(p[k], q[k], v0[k]) for k in range(3)], atol=1e-15
    )
    assert (many[2] == 0.0).all()


@pytest.mark.parametrize("charging", [0.0, 0.02])
@given(seed=seeds)
@settings(max_examples=8, deadline=None)
def test_sensitivities_are_the_derivatives_under_load(charging: float, seed: int) -> None:
    feeder = random_mesh(seed, charging=charging)
    p, q = loads(feeder, seed, 0.01)
    v0 = 1.02
    found = feeder.sensitivities(p, q, v0, steps=20)
    derivatives_are(found, lambda p, q: ac(feeder, p, q, v0), p, q, atol=2e-5)
    none = feeder.sensitivities(0.0 * p, 0.0 * q, 1.0)
    if not charging:
        np.testing.assert_allclose(none.R_bus, feeder.R, rtol=0, atol=1e-12)
        np.testing.assert_allclose(none.X_bus, feeder.X, rtol=0, atol=1e-12)


def test_beyond_what_the_feeder_carries_nothing_is_promised() -> None:
    feeder = random_mesh(11)
    p, q = np.full((2, feeder.bus.size), -50.0)
    assert np.isinf(feeder.model_error_bound(p, q, 1.0)).all()
    assert np.isinf(feeder.model_error_bound(np.full(p.shape, np.nan), q, 1.0)).all()


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_a_loop_of_inverters_has_the_certificate_of_symmetric_reactances(seed: int) -> None:
    feeder = random_mesh(seed)
    every = np.arange(feeder.bus.size)
    droop = fleet(every, "ieee1547-b", np.full(every.size, 10.0), 100.0)
    lure = close_loop(feeder, droop, every)
    found = certify(lure)
    assert verify(found, lure) > 0.0
    np.testing.assert_allclose(lure.H, lure.H.T, rtol=0, atol=1e-13)


def test_arrays_cannot_be_changed() -> None:
    feeder = random_mesh(2)
    for each in fields(feeder):
        value = getattr(feeder, each.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0


def test_every_problem_is_named() -> None:
    tree = random_feeder(3)
    with refused(FeederInvalid, "shape", "shape", "shape"):
        MeshedFeeder(tree, np.array([[0, 1], [0, 1]]), np.ones(1), np.ones(2), np.ones(2))
    ends = np.array([[0, 99], [1, 1], [0, 1]])
    with refused(FeederInvalid, "unknown-index", "self-loop", "negative", "zero-impedance"):
        MeshedFeeder(tree, ends, np.array([0.1, -1.0, 0.0]), np.array([0.1, 0.1, 0.0]), np.zeros(3))
