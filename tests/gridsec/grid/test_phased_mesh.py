"""Meshes of three phases against dense admittances, radial feeders, balanced meshes and the AC power flow."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid
from gridsec.grid.meshed import MeshedFeeder, PhasedMesh, phased_admittance
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.three_phase import ROTATION, ThreePhaseFeeder, sequence_matrix
from tests.codes import refused
from tests.gridsec.derivatives import derivatives_are
from tests.gridsec.meshes import random_mesh
from tests.gridsec.unbalanced import ac_places, admittances, random_phased_mesh

seeds = st.integers(0, 100_000)
FIELDS = ("tree", "ends", "phases", "z", "charging")


def loads(feeder: PhasedMesh, seed: int, size: float = 0.01) -> tuple[Floats, Floats]:
    """Random injections, more drawn than fed in."""
    p, q = size * np.random.default_rng([seed, 3]).normal([[-0.5], [-0.2]], 1.0, (2, feeder.bus.size))
    return p, q


def in_phases(feeder: MeshedFeeder, zero: complex) -> PhasedMesh:
    """A balanced mesh as one of three phases, every customer on all of them: c0 on a, then c0 on b, ..."""

    def blocks(line: Any) -> Any:
        return sequence_matrix(line.r + 1j * line.x, zero * (line.r + 1j * line.x))

    one = feeder.tree
    tree = ThreePhaseFeeder(
        name="three",
        parent=one.parent,
        z=blocks(one),
        phases=np.ones((len(one.buses), 3), dtype=bool),
        bus=np.repeat(one.bus, 3),
        connected=np.tile(np.eye(3, dtype=bool), (one.bus.size, 1)),
        customers=tuple(f"{name}-{phase}" for name in one.customers for phase in "abc"),
        buses=one.buses,
        base_volt=one.base_volt,
        base_kva=one.base_kva,
        charging=np.multiply.outer(one.charging, np.eye(3)),
    )
    present = np.ones((feeder.r.size, 3), dtype=bool)
    return PhasedMesh(
        tree, feeder.ends, present, blocks(feeder), np.multiply.outer(feeder.charging, np.eye(3))
    )


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_without_ties_it_is_the_radial_feeder(seed: int) -> None:
    feeder = random_phased_mesh(seed, ties=0, charging=0.02)
    radial = PhasedFeeder(feeder.tree)
    assert feeder.buses == radial.buses
    np.testing.assert_array_equal(feeder.bus, radial.bus)
    np.testing.assert_array_equal(feeder.half, feeder.tree.half)
    for name in ("R", "X"):
        np.testing.assert_allclose(getattr(feeder, name), getattr(radial, name), rtol=0, atol=1e-15)
    p, q = loads(feeder, seed, 0.003)
    v0 = np.array([1.03, 1.0, 0.98])
    # Corrections of one step are of the same order, and both iterations end in the AC power flow.
    for steps, atol in ((0, 1e-12), (60, 1e-11)):
        found = [each.bus_voltages(p, q, v0, steps=steps) for each in (feeder, radial)]
        np.testing.assert_allclose(*found, rtol=0, atol=atol)


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_a_tie_that_hardly_conducts_changes_nothing(seed: int) -> None:
    feeder = random_phased_mesh(seed)
    far = replace(feeder, z=1e12 * feeder.z)
    radial = PhasedFeeder(feeder.tree)
    np.testing.assert_allclose(far.R, radial.R, rtol=0, atol=1e-9)
    np.testing.assert_allclose(far.X, radial.X, rtol=0, atol=1e-9)
    p, q = loads(feeder, seed, 0.003)
    found = [each.bus_voltages(p, q, 1.02, steps=40) for each in (far, radial)]
    np.testing.assert_allclose(*found, rtol=0, atol=1e-9)
    # Nor does it where others conduct.
    scale = np.where(np.arange(len(feeder.ends)) % 2, 1.0, 1e12)
    mixed = replace(feeder, z=scale[:, None, None] * feeder.z)
    rest = PhasedMesh(*(getattr(feeder, n)[1::2] if n != "tree" else feeder.tree for n in FIELDS))
    np.testing.assert_allclose(mixed.X, rest.X, rtol=0, atol=1e-9)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_impedances_invert_the_admittances(seed: int) -> None:
    feeder = random_phased_mesh(seed)
    n = len(feeder.buses)
    Y = admittances(feeder.tree, feeder).reshape(n, n)
    np.testing.assert_allclose(phased_admittance(feeder).toarray(), Y, rtol=0, atol=1e-12 * np.abs(Y).max())
    free = feeder.tree.phases.ravel().copy()
    free[:3] = False
    Z = np.zeros((n, n), dtype=complex)
    Z[np.ix_(free, free)] = np.linalg.inv(Y[np.ix_(free, free)])
    there = free.copy()
    there[:3] = True
    found = feeder.transfer[there]
    np.testing.assert_allclose(found, 3.0 * Z[np.ix_(there, feeder.bus)], rtol=0, atol=1e-11)
    a = np.tile(ROTATION, n // 3)
    turned = 3.0 * Z[:, feeder.bus] * (a[feeder.bus] / a[:, None])
    np.testing.assert_allclose((feeder.R + 1j * feeder.X)[there], turned[there], rtol=0, atol=1e-11)


@pytest.mark.parametrize("charging", [0.0, 0.02])
@given(seed=seeds)
@settings(max_examples=12, deadline=None)
def test_equal_loads_in_all_phases_are_the_balanced_mesh(charging: float, seed: int) -> None:
    one = random_mesh(seed, customers=5, charging=charging)
    three = in_phases(one, 3.0 - 0.5j)
    p, q = 0.02 * np.random.default_rng(seed).normal([[-0.5], [-0.2]], 1.0, (2, one.bus.size))
    split = [np.repeat(each / 3.0, 3) for each in (p, q)]
    for steps in (0, 1, 2):
        balanced = one.bus_voltages(p, q, 1.03, steps=steps)
        found = three.bus_voltages(*split, 1.03, steps=steps)
        np.testing.assert_allclose(found, np.repeat(balanced, 3), rtol=0, atol=1e-12)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_phases_that_do_not_touch_are_three_balanced_meshes(seed: int) -> None:
    one = random_mesh(seed, customers=4)
    three = in_phases(one, 1.0)
    for matrix, balanced in ((three.R, one.R), (three.X, one.X)):
        np.testing.assert_allclose(matrix, 3.0 * np.kron(balanced, np.eye(3)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("charging", [0.0, 0.02])
@given(seed=seeds, size=st.sampled_from([0.001, 0.005, 0.02]))
@settings(max_examples=40, deadline=None)
def test_the_power_flow_is_within_the_bound(charging: float, seed: int, size: float) -> None:
    feeder = random_phased_mesh(seed, charging=charging)
    p, q = loads(feeder, seed, size)
    v0 = np.random.default_rng(seed).uniform(0.95, 1.05, 3) ** 2
    bound = feeder.model_error_bound(p, q, v0)
    assert np.isfinite(bound).all()
    exact, found = ac_places(feeder, p, q, v0), feeder.bus_voltages(p, q, v0)
    assert (np.abs(found - exact)[feeder.bus] <= bound + 1e-12).all()
    reach = float((feeder.size @ np.hypot(p, q)).max())
    assert (bound <= 10.0 * reach**3 + 1e-12).all()
    far, there = feeder.bus_voltages(p, q, v0, steps=60), ~np.isnan(exact)
    np.testing.assert_allclose(far[there], exact[there], rtol=0, atol=1e-9)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_a_correction_gains_an_order(seed: int) -> None:
    feeder = random_phased_mesh(seed)
    p, q = loads(feeder, seed, 0.003)
    exact = feeder.bus_voltages(p, q, 1.0, steps=60)
    errors = [np.abs(feeder.bus_voltages(p, q, 1.0, steps=k) - exact).max() for k in range(3)]
    reach = float((feeder.size @ np.hypot(p, q)).max())
    for k, error in enumerate(errors):
        assert error <= 10.0 * reach ** (k + 2) + 1e-13


def test_a_tie_of_one_phase_closes_a_loop_in_that_phase_alone() -> None:
    """Without mutual impedance the other phases know nothing of it."""
    one = random_mesh(5, ties=1, customers=4)
    three = in_phases(one, 1.0)
    only_b = np.array([False, True, False])
    both = np.outer(only_b, only_b)
    single = replace(three, phases=only_b[None], z=three.z * both, charging=three.charging * both)
    radial = PhasedFeeder(three.tree)
    of_b = single.tree.phase == 1
    for name in ("R", "X"):
        ring, tree, found = (getattr(each, name) for each in (three, radial, single))
        np.testing.assert_allclose(found[:, of_b], ring[:, of_b], rtol=0, atol=1e-13)
        np.testing.assert_allclose(found[:, ~of_b], tree[:, ~of_b], rtol=0, atol=1e-13)
    assert np.abs(ring - tree).max() > 1e-3
    # With it they do: what the ring takes off b's current no longer induces a voltage in a and c.
    coupled = in_phases(one, 3.0)
    mixed = replace(coupled, phases=only_b[None], z=coupled.z * both, charging=coupled.charging * both)
    moved = np.abs(mixed.X - PhasedFeeder(coupled.tree).X)
    assert moved[0::3].max() > 1e-4
    p, q = loads(mixed, 5, 0.002)
    exact = ac_places(mixed, p, q, 1.0)
    np.testing.assert_allclose(mixed.bus_voltages(p, q, 1.0, steps=60), exact, rtol=0, atol=1e-12)


def test_two_equal_lines_in_parallel_are_one_of_half_the_impedance() -> None:
    tree = random_phased_mesh(8, ties=0).tree
    ends = np.column_stack([tree.parent, np.arange(1, len(tree.buses))])
    twice = PhasedMesh(tree, ends, tree.phases[1:], tree.z, tree.charging)
    half = PhasedFeeder(replace(tree, z=0.5 * tree.z))
    np.testing.assert_allclose(twice.R, half.R, rtol=0, atol=1e-15)
    np.testing.assert_allclose(twice.X, half.X, rtol=0, atol=1e-15)


def test_customers_hang_on_the_phase_of_the_busbar_that_they_have() -> None:
    feeder = random_phased_mesh(3)
    np.testing.assert_array_equal(feeder.busbar_incidence().argmax(axis=1), feeder.tree.phase)
    same = np.equal.outer(feeder.tree.phase, feeder.tree.phase)
    np.testing.assert_array_equal(feeder.same_busbar_phase(feeder.bus, feeder.bus), same)


@pytest.mark.parametrize("charging", [0.0, 0.02])
@given(seed=seeds)
@settings(max_examples=8, deadline=None)
def test_sensitivities_are_the_derivatives_under_load(charging: float, seed: int) -> None:
    feeder = random_phased_mesh(seed, charging=charging)
    p, q = loads(feeder, seed, 0.01)
    v0 = np.array([1.02, 1.0, 0.97])
    found = feeder.sensitivities(p, q, v0, steps=20)
    derivatives_are(found, lambda p, q: ac_places(feeder, p, q, v0), p, q, atol=1e-6)
    none = feeder.sensitivities(0.0 * p, 0.0 * q, 1.0)
    if not charging:
        np.testing.assert_allclose(none.R_bus, feeder.R, rtol=0, atol=1e-12)
        np.testing.assert_allclose(none.X_bus, feeder.X, rtol=0, atol=1e-12)


def test_beyond_what_the_feeder_carries_nothing_is_promised() -> None:
    feeder = random_phased_mesh(11)
    p, q = np.full((2, feeder.bus.size), -50.0)
    assert np.isinf(feeder.model_error_bound(p, q, 1.0)).all()
    assert np.isinf(feeder.model_error_bound(np.full(p.shape, np.nan), q, 1.0)).all()


def test_arrays_cannot_be_changed() -> None:
    feeder = random_phased_mesh(2, charging=0.01)
    for each in fields(feeder):
        value = getattr(feeder, each.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0


def test_every_problem_is_named() -> None:
    three = in_phases(random_mesh(3, ties=1, customers=3), 3.0)
    with refused(FeederInvalid, "shape"):
        replace(three, z=three.z[:0])
    tree = replace(three.tree, phases=three.tree.phases.copy())
    ends, some = np.array([[0, 99], [1, 1], [0, 1], [0, 1], [0, 1]]), np.ones((5, 3), dtype=bool)
    z = np.repeat(three.z[:1], 5, axis=0)
    some[2] = False
    z[2] = 0.0
    z[3, 0, 0] = 0.0
    z[4, 0, 1] += 1.0
    with refused(
        FeederInvalid,
        "unknown-index",
        "self-loop",
        "no-phase",
        "zero-impedance",
        "not-symmetric",
        "not-definite",
    ) as caught:
        PhasedMesh(tree, ends, some, z, np.zeros((5, 3, 3)))
    ties = [problem.split(":")[0] for problem in caught.value.problems]
    assert ties == ["tie 0", "tie 1", "tie 2", "tie 3", "tie 4", "tie 4"]
    lateral = next(
        each
        for each in (random_phased_mesh(seed, ties=0).tree for seed in range(50))
        if not each.phases[1:].all()
    )
    far = int(np.flatnonzero(~lateral.phases.all(axis=1))[0])
    block = 0.01 * np.eye(3, dtype=complex)[None]
    with refused(FeederInvalid, "absent-phase"):
        PhasedMesh(lateral, np.array([[0, far]]), np.ones((1, 3), dtype=bool), block, np.zeros((1, 3, 3)))
    # Two reactances that cancel around a loop are no lines.
    with refused(FeederInvalid, "singular"):
        PhasedMesh(
            replace(lateral, z=1j * np.abs(lateral.z)),
            np.array([[lateral.parent[0], 1]]),
            lateral.phases[1:2],
            -1j * np.abs(lateral.z[:1]),
            np.zeros((1, 3, 3)),
        )


@pytest.mark.parametrize("nearly", [0.0, 1e-17, 1e-16])
def test_conductors_without_impedances_of_their_own_have_no_charging(nearly: float) -> None:
    """Only what the three carry together meets an impedance; charging needs an admittance."""
    three = in_phases(random_mesh(3, ties=1, customers=3), 3.0)
    block = np.full((1, 3, 3), 0.01 + 0.01j) + nearly * np.eye(3)
    b = np.array([0.01 * np.eye(3)])
    assert np.isfinite(replace(three, z=block).R).all()
    with refused(FeederInvalid, "singular"):
        replace(three, z=block, charging=b)
