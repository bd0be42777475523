"""Hidden attacks against brute force over all sets of liars, by ranks of observability matrices."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
from gridsec.grid.devices import fleet
from gridsec.grid.meshed import MeshedFeeder
from gridsec.grid.network import Network
from gridsec.grid.radial import Feeder
from gridsec.observers.lure import close_loop
from gridsec.planning.redundancy import (
    Patterns,
    fewest_meters,
    meter_redundancy,
    part_redundancy,
    parts,
    patterns,
    unknown_pair,
    unknown_voltages,
)
from gridsec.secure.index import redundant_detectable, redundant_observable
from tests.codes import refused
from tests.gridsec.planning.small import TOL, brute, in_phases, system, tree


def given(A: Floats, C: Floats, *, persistent: bool) -> Patterns:
    return patterns(A, C, persistent=persistent, tol=TOL)


NONE = np.zeros((0, 2), dtype=np.intp)

FEEDERS = pytest.mark.parametrize(
    ("seed", "phased"),
    [*((seed, False) for seed in range(25)), *((seed, True) for seed in range(10))],
)
"""Balanced feeders, and some in three phases."""


@pytest.mark.canary(
    "0-False-True",
    "2-False-False",
    "4-False-False",
    "7-False-True",
    "9-False-True",
    "11-False-False",
    "14-False-True",
    "16-False-True",
    "18-False-False",
    "20-False-False",
    "23-False-True",
    "0-True-False",
    "2-True-False",
    "5-True-True",
    "7-True-True",
    "9-True-False",
)
@pytest.mark.parametrize("persistent", [True, False])
@FEEDERS
def test_indices_of_all_and_of_each_meter_equal_brute_force(
    seed: int, persistent: bool, phased: bool
) -> None:
    A, C = system(seed, busbar=seed % 3 == 0, phased=phased)
    found = given(A, C, persistent=persistent)
    every = list(range(len(C)))
    empty = np.zeros(len(C), dtype=np.bool_)
    assert fewest_meters(found).count == brute(A, C, every, every, persistent=persistent)
    for j in every:
        meter = meter_redundancy(found, j, empty)
        assert meter.own.count == brute(A, C, every, every, persistent=persistent, must=j)
        assert meter.critical == (meter.own.count == 1)
        if np.isfinite(meter.own.count):
            assert j in meter.own.sensors
            assert meter.own.sensors.size == meter.own.count
        rest = [k for k in every if k != j]
        assert meter.without.count == brute(A, C, rest, rest, persistent=persistent)


@pytest.mark.parametrize("persistent", [True, False])
@FEEDERS
def test_parts_and_silent_meters_equal_brute_force(seed: int, persistent: bool, phased: bool) -> None:
    feeder, _, meters, _ = tree(seed, phased=phased)
    whole = feeder if isinstance(feeder, Feeder) else feeder.tree
    A, C = system(seed, phased=phased)
    found = given(A, C, persistent=persistent)
    silent = np.arange(len(C)) == seed % len(C)
    live = np.flatnonzero(~silent).tolist()
    for part in parts(whole, feeder.customer_bus[meters], NONE):
        inside = [j for j in part.meters.tolist() if not silent[j]]
        counted = part_redundancy(found, part, silent).count
        assert counted == brute(A, C, inside, live, persistent=persistent)


def cut_off(mesh: MeshedFeeder, bus: int) -> set[int]:
    """Buses that a walk from the busbar does not reach around one."""
    lines = [*enumerate(mesh.tree.parent.tolist(), 1), *map(tuple, mesh.ends.tolist())]
    reached, grows = {0}, True
    while grows:
        more = {b for one, other in lines for a, b in ((one, other), (other, one)) if a in reached} - {bus}
        grows = not more <= reached
        reached |= more
    return set(range(len(mesh.buses))) - reached


@pytest.mark.parametrize("persistent", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_parts_of_a_mesh_are_fed_through_one_bus_and_equal_brute_force(seed: int, persistent: bool) -> None:
    mesh, _, meters, _ = tree(seed, ties=1 + seed % 2)
    assert isinstance(mesh, MeshedFeeder)
    A, C = system(seed, ties=1 + seed % 2)
    found, every = given(A, C, persistent=persistent), list(range(len(C)))
    at = mesh.bus[meters].tolist()
    inside = [[j for j in every if at[j] in cut_off(mesh, bus)] for bus in range(1, len(mesh.buses))]
    pieces = parts(mesh.tree, mesh.bus[meters], mesh.ends)
    assert sorted(part.meters.tolist() for part in pieces) == sorted(
        map(list, {tuple(k) for k in inside if k})
    )
    for part in pieces:
        assert part.meters.tolist() == inside[part.bus - 1]
        one = {0, part.bus}
        assert part.branch == any({a, b} == one for a, b in [*enumerate(mesh.tree.parent, 1), *mesh.ends])
        counted = part_redundancy(found, part, np.zeros(len(C), dtype=np.bool_)).count
        assert counted == brute(A, C, part.meters.tolist(), every, persistent=persistent)


@FEEDERS
def test_index_is_redundant_observability_where_nobody_is_blind(seed: int, phased: bool) -> None:
    A, C = system(seed, phased=phased)
    live = np.ones(len(C), dtype=np.bool_)
    for persistent in (True, False):
        found = given(A, C, persistent=persistent)
        index = fewest_meters(found).count
        blind = found.blind(live).shape[1] > 0
        for q in range(len(C)):
            expected = not blind and q < index
            if persistent:
                assert redundant_detectable(A, C, q, discrete=False, tol=TOL, by="rank") == expected
            else:
                assert redundant_observable(A, C, q, tol=TOL, by="rank") == expected


def test_the_liars_of_an_index_do_imitate_a_pattern() -> None:
    A, C = system(3)
    found = given(A, C, persistent=True)
    index = fewest_meters(found)
    reading = C @ np.real(index.direction)
    others = np.delete(reading, index.sensors)
    np.testing.assert_allclose(others, 0.0, atol=1e-8)
    assert np.abs(reading[index.sensors]).min() > 1e-6
    # It stays: the state of this direction does not move.
    np.testing.assert_allclose(A @ index.direction, 0.0, atol=1e-8)


def test_known_loads_leave_nothing_that_stays() -> None:
    feeder, lure, _, _ = tree(1)
    W = unknown_voltages(feeder, np.zeros(0, dtype=np.intp), busbar=False, tol=TOL)
    A, C = unknown_pair(lure, lure.slope, W)
    assert fewest_meters(given(A, C, persistent=True)).count == np.inf


def test_an_unknown_busbar_moves_every_meter() -> None:
    feeder, lure, _, _ = tree(1)
    none = np.zeros(0, dtype=np.intp)
    W = unknown_voltages(feeder, none, busbar=True, tol=TOL)
    A, C = unknown_pair(lure, 0.0 * lure.slope, W)
    found = fewest_meters(given(A, C, persistent=True))
    assert found.count == len(C)


def test_an_unknown_busbar_in_three_phases_moves_the_meters_of_a_phase() -> None:
    feeder, lure, meters, _ = tree(1, phased=True)
    none = np.zeros(0, dtype=np.intp)
    W = unknown_voltages(feeder, none, busbar=True, tol=TOL)
    A, C = unknown_pair(lure, 0.0 * lure.slope, W)
    each = np.bincount(feeder.bus[meters] % 3, minlength=3)
    found = fewest_meters(given(A, C, persistent=True))
    assert found.count == each[each > 0].min() < meters.size


@pytest.mark.parametrize("form", ["radial", "phases", "meshed"])
@pytest.mark.parametrize("seed", range(5))
def test_a_meter_that_no_unknown_load_moves_has_no_index(seed: int, form: str) -> None:
    """At the busbar, and on a street that has nothing in common with that of the unknown load."""
    rng = np.random.default_rng(seed)
    feeder: Network = Feeder(
        name="streets",
        parent=np.array([0, 1, 0, 3, 4, 3]),
        r=rng.uniform(0.01, 0.2, 6),
        x=rng.uniform(0.005, 0.05, 6),
        bus=np.array([0, 1, 2, 3, 4, 5, 6]),
        customers=tuple(f"c{i}" for i in range(7)),
        buses=tuple(f"b{i}" for i in range(7)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(6),
    )
    assert isinstance(feeder, Feeder)
    if form == "phases":
        feeder = in_phases(feeder, np.zeros(7, dtype=np.intp), mutual=0.4)
    elif form == "meshed":
        feeder = MeshedFeeder(feeder, np.array([[5, 6]]), np.array([0.07]), np.array([0.02]), np.zeros(1))
    droop = fleet(np.array([2, 4]), "ieee1547-b", np.array([5.0, 9.0]), 100.0, tau=np.array([2.0, 3.1]))
    lure = close_loop(feeder, droop, np.arange(7))
    W = unknown_voltages(feeder, np.array([5]), busbar=False, tol=TOL)
    np.testing.assert_allclose(W.T @ W, np.eye(2), atol=1e-12)
    A, C = unknown_pair(lure, lure.slope, W)
    found, empty = given(A, C, persistent=True), np.zeros(7, dtype=np.bool_)
    counts = [meter_redundancy(found, j, empty).own.count for j in range(7)]
    assert counts[:3] == [np.inf] * 3
    every = list(range(7))
    # Oracle: ranks of what stays, without the meters that hear nothing.
    assert min(counts[3:]) == brute(A, C[3:], every[:4], every[:4], persistent=True)
    # Nobody with a meter feels it: there is nothing to imitate, however it is rounded.
    lure = close_loop(feeder, droop, np.arange(3))
    A, C = unknown_pair(lure, lure.slope, W)
    assert fewest_meters(given(A, C, persistent=True)).count == np.inf


def test_a_liar_must_be_there() -> None:
    A, C = system(0)
    found = given(A, C, persistent=False)
    with refused(InputInvalid, "inconsistent"):
        fewest_meters(found, silent=np.arange(len(C)) == 1, must=1)
