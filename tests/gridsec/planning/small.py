"""Small feeders with loads that nobody knows, and brute force over all sets of liars."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from gridsec.arrays import Floats, Ints
from gridsec.grid.devices import fleet
from gridsec.grid.meshed import MeshedFeeder
from gridsec.grid.network import Network
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import ThreePhaseFeeder
from gridsec.observers.lure import Lure, close_loop
from gridsec.planning.redundancy import unknown_pair, unknown_voltages
from gridsec.planning.stealthy_attacks import ErrorBox
from gridsec.secure.index import observable_rows, unstable_subspace

TOL = 1e-9


def tree(seed: int, *, phased: bool = False, ties: int = 0) -> tuple[Network, Lure, Ints, Ints]:
    """A small feeder: 7 customers, 5 of them with meters, 2 inverters, 1 or 2 loads that nobody knows.

    In three phases each customer has one of them, and mutual impedances are a good part of the others. With
    ties, closed loops.
    """
    rng = np.random.default_rng(seed)
    branches = 7
    feeder: Network = Feeder(
        name="small",
        parent=np.array([rng.integers(max(0, k - 2), k + 1) for k in range(branches)]),
        r=rng.uniform(0.01, 0.05, branches),
        x=rng.uniform(0.01, 0.05, branches),
        bus=rng.integers(1, branches + 1, 7),
        customers=tuple(f"c{i}" for i in range(7)),
        buses=tuple(f"b{i}" for i in range(branches + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(branches),
    )
    if phased:
        assert isinstance(feeder, Feeder)
        phase = np.random.default_rng([seed, 3]).integers(0, 3, 7)
        feeder = in_phases(feeder, phase, mutual=0.4)
    if ties:
        assert isinstance(feeder, Feeder)
        other = np.random.default_rng([seed, 4])
        ends = np.array([other.choice(branches + 1, 2, replace=False) for _ in range(ties)])
        r, x = other.uniform(0.01, 0.05, (2, ties))
        feeder = MeshedFeeder(feeder, ends, r, x, np.zeros(ties))
    meters = np.sort(rng.choice(7, 5, replace=False))
    own = np.sort(rng.choice(7, 2, replace=False))
    droop = fleet(own, "ieee1547-b", np.array([5.0, 9.0]), 100.0, tau=np.array([2.0, 3.1]))
    unknown = rng.choice(7, rng.integers(1, 3), replace=False)
    return feeder, close_loop(feeder, droop, meters), meters, unknown


def in_phases(feeder: Feeder, phase: Ints, *, mutual: float) -> PhasedFeeder:
    """The same tree with its customers on single phases; mutual impedances are a part of a phase's own."""
    z = (feeder.r + 1j * feeder.x)[:, None, None]
    return PhasedFeeder(
        ThreePhaseFeeder(
            name=feeder.name,
            parent=feeder.parent,
            z=z * (mutual + (1.0 - mutual) * np.eye(3)),
            phases=np.ones((len(feeder.buses), 3), dtype=np.bool_),
            bus=feeder.bus,
            connected=np.equal.outer(phase, np.arange(3)),
            customers=feeder.customers,
            buses=feeder.buses,
            base_volt=feeder.base_volt,
            base_kva=feeder.base_kva,
            charging=feeder.charging[:, None, None] * np.eye(3),
        )
    )


def system(seed: int, *, busbar: bool = False, phased: bool = False, ties: int = 0) -> tuple[Floats, Floats]:
    feeder, lure, _, unknown = tree(seed, phased=phased, ties=ties)
    W = unknown_voltages(feeder, unknown, busbar=busbar, tol=TOL)
    return unknown_pair(lure, lure.slope, W)


def imitates(rows: tuple[Floats, ...], space: Floats, liars: tuple[int, ...], live: list[int]) -> Floats:
    """What these liars see of the states in a space that no other live meter ever sees."""
    others = [rows[j] @ space for j in live if j not in liars]
    stack = np.vstack([*others, np.zeros((1, space.shape[1]))])
    _, s, vh = np.linalg.svd(stack)
    null = vh[int(np.count_nonzero(s > 1e-7)) :].T
    return np.array([np.linalg.norm(rows[j] @ space @ null) for j in liars])


def brute(
    A: Floats, C: Floats, allowed: list[int], live: list[int], *, persistent: bool, must: int | None = None
) -> float:
    """The fewest liars, by trying all sets of the allowed."""
    rows = observable_rows(A, C, tol=TOL)
    space = unstable_subspace(A, discrete=False, tol=TOL) if persistent else np.eye(A.shape[0])
    if not space.shape[1]:
        return np.inf
    for count in range(1, len(allowed) + 1):
        for liars in combinations(allowed, count):
            if must is not None and must not in liars:
                continue
            effect = imitates(rows, space, liars, live)
            if effect.max() > 1e-7 and (must is None or effect[liars.index(must)] > 1e-7):
                return float(count)
    return np.inf


def street(seed: int, meters: int = 6) -> ErrorBox:
    """A random feeder's paths in common, soft enough for loads and meters to matter alike."""
    rng = np.random.default_rng(seed)
    n = meters + 1
    parent = [int(rng.integers(0, k + 1)) for k in range(n)]
    paths = np.zeros((n, n))
    for k in range(n):
        if parent[k]:
            paths[k] = paths[parent[k] - 1]
        paths[k, k] = 1.0
    R = paths @ np.diag(rng.uniform(0.5, 2.0, n)) @ paths.T
    effect = np.hstack([2 * R * rng.uniform(0.0, 0.004, n), np.full((n, 1), 0.001)])
    at = np.sort(rng.choice(n, meters, replace=False))
    return ErrorBox(effect, at, rng.uniform(0.001, 0.01, meters))
