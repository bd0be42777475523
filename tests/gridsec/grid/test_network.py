"""What estimators ask of a feeder, balanced or not, against dense matrices and the AC power flow."""

from __future__ import annotations

from collections.abc import Callable

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid
from gridsec.grid.meshed import MeshedFeeder, impedances
from gridsec.grid.network import Network, Power
from gridsec.grid.phased import InPhases, PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import PHASES
from tests.codes import refused
from tests.gridsec.meshes import ac, random_mesh
from tests.gridsec.radial import random_feeder
from tests.gridsec.unbalanced import ac_places, random_phased_mesh, random_three_phase

seeds = st.integers(0, 100_000)


def phased(seed: int) -> PhasedFeeder:
    """A random feeder in three phases with customers of one."""
    return PhasedFeeder(random_three_phase(seed, single=True))


def dense(feeder: Network, power: Power) -> Floats:
    """R or X from customers to places: by `lindistflow`, `impedances`, or differences of AC power flows."""
    if isinstance(feeder, Feeder):
        model = feeder.linear()
        return model.R_bus if power is Power.ACTIVE else model.X_bus
    if isinstance(feeder, MeshedFeeder):
        Z = impedances(feeder, feeder.bus)
        return Z.real if power is Power.ACTIVE else Z.imag
    step, none, out = 1e-5, np.zeros(feeder.bus.size), []
    for c in range(feeder.bus.size):
        unit = step * (np.arange(feeder.bus.size) == c)
        one = (unit, none) if power is Power.ACTIVE else (none, unit)
        up, down = (ac_places(feeder, *(sign * each for each in one), 1.0) for sign in (1, -1))
        out.append((up - down) / (4.0 * step))
    return np.array(out).T


@pytest.mark.parametrize("kind", [random_feeder, random_mesh, phased, random_phased_mesh])
@given(seed=seeds)
@settings(max_examples=15, deadline=None)
def test_every_word_is_that_of_the_dense_matrix(kind: object, seed: int) -> None:
    assert callable(kind)
    feeder: Network = kind(seed)
    rng, count = np.random.default_rng(seed), feeder.bus.size
    metered = np.sort(rng.choice(count, max(1, count // 2), replace=False))
    variance = rng.uniform(0.0, 2.0, count)
    tol = 1e-7 if feeder.busbar_phases == 3 else 1e-9
    for power in Power:
        M = dense(feeder, power)
        there = ~np.isnan(M).any(axis=1)
        size = max(1.0, np.abs(M[there]).max(initial=0.0)) ** 2 * count

        def same(found: Floats, expected: Floats, size: float = size) -> None:
            np.testing.assert_allclose(found, expected, rtol=0, atol=tol * size)

        same(feeder.columns(power, metered)[there], 2.0 * M[np.ix_(there, metered)])
        rows = M[feeder.bus]
        same(feeder.self_impedance(power), rows.diagonal())
        whole = 4.0 * (M * variance) @ M.T
        places = feeder.bus[metered]
        same(feeder.covariance(power, places, variance)[there], whole[np.ix_(there, places)])
        same(feeder.variances(power, variance)[there], whole.diagonal()[there])


@pytest.mark.parametrize("kind", [phased, random_phased_mesh])
@given(seed=seeds)
@settings(max_examples=30, deadline=None)
def test_voltages_of_the_places_within_their_bound_of_the_power_flow(
    kind: Callable[[int], InPhases], seed: int
) -> None:
    feeder = kind(seed)
    rng = np.random.default_rng(seed)
    p, q = 0.01 * rng.normal(-0.5, 1.0, (2, feeder.bus.size)) / 3.0
    v0 = rng.uniform(0.95, 1.05, 3) ** 2
    exact = ac_places(feeder, p, q, v0)
    found, bound = feeder.bus_voltages(p, q, v0), feeder.model_error_bound(p, q, v0)
    np.testing.assert_allclose(found[feeder.busbar_places()], v0, rtol=1e-14)
    assert (np.abs(found - exact)[feeder.bus] <= bound + 1e-12).all()
    many = feeder.bus_voltages(np.stack([p, 0.0 * p]), np.stack([q, 0.0 * q]), v0)
    np.testing.assert_allclose(many[0], found, rtol=0, atol=1e-14)
    linear = feeder.broadcast_busbar(v0) + 2.0 * (feeder.R @ p + feeder.X @ q)
    np.testing.assert_allclose(feeder.bus_voltages(p, q, v0, steps=0), linear, rtol=0, atol=1e-12)


def test_voltages_of_a_meshed_feeder_within_their_bound_of_the_power_flow() -> None:
    feeder = random_mesh(4, charging=0.01)
    p, q = 0.01 * np.random.default_rng(4).normal(-0.5, 1.0, (2, feeder.bus.size))
    exact = ac(feeder, p, q, 1.04)
    found, bound = feeder.bus_voltages(p, q, 1.04), feeder.model_error_bound(p, q, 1.04)
    assert found[feeder.busbar_places()] == pytest.approx(1.04, abs=1e-14)
    assert (np.abs(found - exact)[feeder.bus] <= bound + 2e-9).all()
    linear = feeder.broadcast_busbar(1.04) + 2.0 * (feeder.R @ p + feeder.X @ q)
    np.testing.assert_allclose(feeder.bus_voltages(p, q, 1.04, steps=0), linear, rtol=0, atol=1e-12)
    assert feeder.same_busbar_phase(feeder.bus, feeder.bus) == 1.0


def test_places_know_their_bus_and_their_phase() -> None:
    feeder = phased(3)
    for name, place, phase, bus in zip(
        feeder.customers, feeder.bus.tolist(), feeder.tree.phase, feeder.tree.bus, strict=True
    ):
        assert feeder.buses[place] == f"{feeder.tree.buses[bus]}.{PHASES[phase]}", name
    same = np.asarray(feeder.same_busbar_phase(feeder.bus, feeder.bus))
    np.testing.assert_array_equal(same, np.equal.outer(feeder.tree.phase, feeder.tree.phase))
    np.testing.assert_array_equal(
        feeder.broadcast_busbar(np.array([1.0, 2.0, 3.0]))[feeder.bus], feeder.tree.phase + 1.0
    )
    np.testing.assert_array_equal(feeder.broadcast_busbar(4.0), np.full(len(feeder.buses), 4.0))


def test_what_is_refused() -> None:
    several = next(
        tree for tree in map(random_three_phase, range(100)) if (tree.connected.sum(axis=1) > 1).any()
    )
    with refused(FeederInvalid, "several-phases"):
        PhasedFeeder(several)
