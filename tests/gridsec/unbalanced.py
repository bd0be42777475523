"""Random three-phase feeders, and an AC power flow by nodal admittances independent of the package."""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Floats, Phasors
from gridsec.grid.meshed import PhasedMesh
from gridsec.grid.phased import InPhases
from gridsec.grid.three_phase import ThreePhaseFeeder


def random_three_phase(
    seed: int, *, branches: int | None = None, charging: float = 0.0, single: bool = False
) -> ThreePhaseFeeder:
    """A random tree with full impedance matrices and laterals; customers of one phase each if `single`."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 14)) if branches is None else branches
    parent = np.array([rng.integers(max(0, k - 3), k + 1) for k in range(count)])
    phases = np.ones((count + 1, 3), dtype=bool)
    z = np.zeros((count, 3, 3), dtype=complex)
    b = np.zeros((count, 3, 3))
    for k in range(count):
        here = phases[parent[k]].copy()
        if rng.random() < 0.4 and here.sum() > 1:
            here[rng.choice(np.flatnonzero(here))] = False
        phases[k + 1] = here
        both = np.outer(here, here)
        own = np.diag(rng.uniform(0.002, 0.03, 3) + 1j * rng.uniform(0.001, 0.03, 3))
        earth = np.full((3, 3), rng.uniform(0.0, 0.01) + 1j * rng.uniform(0.0, 0.02))
        z[k] = both * (own + earth)
        b[k] = both * charging * (np.diag(rng.uniform(0.5, 1.0, 3)) - 0.1)
    customers = int(rng.integers(1, 12))
    bus = rng.integers(0, count + 1, customers)
    connected = np.zeros((customers, 3), dtype=bool)
    for j in range(customers):
        if rng.random() < 0.3 and not single:
            connected[j] = phases[bus[j]]
        else:
            connected[j, rng.choice(np.flatnonzero(phases[bus[j]]))] = True
    return ThreePhaseFeeder(
        name="random",
        parent=parent,
        z=z,
        phases=phases,
        bus=bus,
        connected=connected,
        customers=tuple(f"c{j}" for j in range(customers)),
        buses=tuple(f"b{k}" for k in range(count + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=b,
    )


def random_phased_mesh(seed: int, *, ties: int | None = None, charging: float = 0.0) -> PhasedMesh:
    """Such a tree with ties between random buses, of some of the phases that both have."""
    rng = np.random.default_rng([seed, 7])
    tree = random_three_phase(seed, charging=charging, single=True)
    ends, phases, z, b = [], [], [], []
    for _ in range(int(rng.integers(1, 5)) if ties is None else ties):
        pair = rng.choice(len(tree.buses), 2, replace=False)
        common = np.flatnonzero(tree.phases[pair].all(axis=0))
        if not common.size:
            continue
        here = np.isin(np.arange(3), rng.choice(common, rng.integers(1, common.size + 1), replace=False))
        both = np.outer(here, here)
        own = np.diag(rng.uniform(0.002, 0.03, 3) + 1j * rng.uniform(0.001, 0.03, 3))
        ends.append(pair)
        phases.append(here)
        z.append(both * (own + rng.uniform(0.0, 0.01) + 1j * rng.uniform(0.0, 0.02)))
        b.append(both * charging * (np.diag(rng.uniform(0.5, 1.0, 3)) - 0.1))
    return PhasedMesh(
        tree,
        np.array(ends, dtype=np.intp).reshape(-1, 2),
        np.array(phases, dtype=bool).reshape(-1, 3),
        np.array(z, dtype=complex).reshape(-1, 3, 3),
        np.array(b, dtype=float).reshape(-1, 3, 3),
    )


def ac_places(feeder: InPhases, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Squared voltages of the places (n,) by `power_flow`; powers in units of the three-phase base."""
    ties = feeder if isinstance(feeder, PhasedMesh) else None
    v0 = np.broadcast_to(np.asarray(v0_squared, dtype=float), 3)
    return np.asarray((np.abs(power_flow(feeder.tree, 3.0 * p, 3.0 * q, v0, ties)) ** 2).T.ravel())


def admittances(feeder: ThreePhaseFeeder, ties: PhasedMesh | None = None) -> Phasors:
    """Dense nodal admittances (b + 1, 3, b + 1, 3)."""
    count = len(feeder.buses)
    Y = np.zeros((count, 3, count, 3), dtype=complex)
    lines = [
        (k + 1, above, feeder.phases[k + 1], feeder.z[k], feeder.charging[k])
        for k, above in enumerate(feeder.parent)
    ]
    if ties is not None:
        lines += [
            (*pair, *rest) for pair, *rest in zip(ties.ends, ties.phases, ties.z, ties.charging, strict=True)
        ]
    for one, other, present, z, b in lines:
        here = np.flatnonzero(present)
        y = np.linalg.inv(z[np.ix_(here, here)])
        for i, row in enumerate(here):
            for j, column in enumerate(here):
                half = 0.5j * b[row, column]
                Y[one, row, one, column] += y[i, j] + half
                Y[other, row, other, column] += y[i, j] + half
                Y[one, row, other, column] -= y[i, j]
                Y[other, row, one, column] -= y[i, j]
    return Y


def power_flow(
    feeder: ThreePhaseFeeder, p: Floats, q: Floats, v0_squared: Floats, ties: PhasedMesh | None = None
) -> Phasors:
    """Phasors (3, b + 1) from dense nodal admittances; NaN where a bus lacks the phase."""
    count = len(feeder.buses)
    Y = admittances(feeder, ties)
    power = np.zeros((count, 3), dtype=complex)
    for j in range(feeder.of.size):
        power[feeder.at[j], feeder.phase[j]] += p[j] + 1j * q[j]
    free = feeder.phases.copy()
    free[0] = False
    v0 = np.sqrt(v0_squared) * np.exp(-2j * np.pi / 3 * np.arange(3))
    inverse = np.linalg.inv(Y[free][:, free])
    idle = -inverse @ (Y[free][:, 0] @ v0)
    v = idle.copy()
    for _ in range(200):
        before, v = v, idle + inverse @ np.conj(power[free] / v)
        if np.max(np.abs(v - before), initial=0.0) < 1e-15:
            break
    assert np.max(np.abs(v - before), initial=0.0) < 1e-13
    out = np.full((count, 3), np.nan, dtype=complex)
    out[0] = v0
    out[free] = v
    return out.T
