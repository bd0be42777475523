"""Random feeders with closed ties, and their AC power flow by power-grid-model."""

from __future__ import annotations

import numpy as np

from feeders.simulation.powerflow import Grid, PowerFlow
from gridsec.arrays import Floats
from gridsec.grid.meshed import MeshedFeeder
from tests.gridsec.radial import random_feeder


def random_mesh(
    seed: int, *, ties: int | None = None, customers: int | None = None, charging: float = 0.0
) -> MeshedFeeder:
    """A random tree with ties between random buses, parallel lines among them."""
    rng = np.random.default_rng([seed, 7])
    tree = random_feeder(seed, customers=customers, charging=charging)
    count = int(rng.integers(1, 5)) if ties is None else ties
    ends = [rng.choice(len(tree.buses), 2, replace=False) for _ in range(count)]
    return MeshedFeeder(
        tree=tree,
        ends=np.array(ends, dtype=np.intp).reshape(-1, 2),
        r=rng.uniform(0.001, 0.05, count),
        x=rng.uniform(0.0005, 0.05, count),
        charging=charging * rng.uniform(0.0, 1.0, count),
    )


def ac(feeder: MeshedFeeder, p: Floats, q: Floats, v0_squared: float) -> Floats:
    """Squared voltages (b + 1,) of the AC power flow, from the lines alone; generation positive, pu."""
    tree = feeder.tree
    z_base = 3.0 * tree.base_volt**2 / (1000.0 * tree.base_kva)
    ends = np.column_stack([tree.parent, np.arange(1, len(tree.buses))])
    grid = Grid(
        ends=np.vstack([ends, feeder.ends]),
        r_ohm=z_base * np.concatenate([tree.r, feeder.r]),
        x_ohm=z_base * np.concatenate([tree.x, feeder.x]),
        b_siemens=np.concatenate([tree.charging, feeder.charging]) / z_base,
        busbar=0,
        customer_bus=tree.bus,
        bus_count=len(tree.buses),
        nominal_volt=tree.base_volt,
    )
    base = tree.base_kva
    _, buses = PowerFlow.of(grid).solve(-base * p, -base * q, float(np.sqrt(v0_squared)) * tree.base_volt)
    return (buses / tree.base_volt) ** 2
