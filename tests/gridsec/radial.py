"""Random radial feeders, and an AC power flow that shares no code and no equation with the package."""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Floats
from gridsec.grid.devices import Droop, fleet
from gridsec.grid.network import LinDistFlow
from gridsec.grid.radial import Feeder
from gridsec.observers.lure import Lure, close_loop


def random_feeder(seed: int, *, customers: int | None = None, charging: float = 0.0) -> Feeder:
    """A random tree; customers share buses and sit on the busbar as it happens."""
    rng = np.random.default_rng(seed)
    branches = int(rng.integers(1, 16))
    count = int(rng.integers(1, 13)) if customers is None else customers
    return Feeder(
        name="random",
        parent=np.array([rng.integers(max(0, k - 3), k + 1) for k in range(branches)]),
        r=rng.uniform(0.001, 0.05, branches),
        x=rng.uniform(0.0005, 0.05, branches),
        bus=rng.integers(0, branches + 1, count),
        customers=tuple(f"c{i}" for i in range(count)),
        buses=tuple(f"b{i}" for i in range(branches + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=charging * rng.uniform(0.0, 1.0, branches),
    )


def squared_voltages(model: LinDistFlow, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Squared voltage of every customer by the linear power flow, chong2020 (15)."""
    base = np.asarray(v0_squared, dtype=np.float64)[..., None]
    return base + 2.0 * (p @ model.R.T + q @ model.X.T)


def random_loop(
    seed: int, *, gain: float, spread: float = 1.0, preset: str = "ieee1547-b"
) -> tuple[Feeder, Droop, Lure]:
    """A closed loop with an inverter and a meter at every customer of a random feeder.

    `gain` is the spectral radius of D S; `spread` the largest ratio of two time constants.
    """
    rng = np.random.default_rng([seed, 1])
    feeder = random_feeder(seed)
    count = len(feeder.customers)
    own = np.arange(count)
    rated = rng.uniform(3.0, 15.0, count)
    tau = 2.0 * spread ** rng.uniform(-0.5, 0.5, count)
    droop = fleet(own, preset, rated, 100.0, tau=tau)
    lure = close_loop(feeder, droop, own)
    radius = np.max(np.linalg.eigvals(-droop.slope[:, None] * lure.H).real, initial=0.0)
    if radius > 0.0:
        droop = fleet(own, preset, rated * gain / radius, 100.0, tau=tau)
        lure = close_loop(feeder, droop, own)
    return feeder, droop, lure


def sweep(feeder: Feeder, p: Floats, q: Floats, v0_squared: float) -> Floats:
    """Squared voltages (b + 1,) by backward and forward sweeps on complex currents."""
    count = len(feeder.buses)
    power = np.zeros(count, dtype=np.complex128)
    for j, bus in enumerate(feeder.bus):
        power[bus] += p[j] + 1j * q[j]
    shunt = np.zeros(count)
    for k, above in enumerate(feeder.parent):
        shunt[k + 1] += feeder.charging[k] / 2
        shunt[above] += feeder.charging[k] / 2
    voltage = np.full(count, np.sqrt(v0_squared), dtype=np.complex128)
    for _ in range(1000):
        current = np.conj(-power / voltage) + 1j * shunt * voltage
        for k in range(count - 1, 0, -1):
            current[feeder.parent[k - 1]] += current[k]
        before = voltage.copy()
        for k in range(1, count):
            z = feeder.r[k - 1] + 1j * feeder.x[k - 1]
            voltage[k] = voltage[feeder.parent[k - 1]] - z * current[k]
        if np.max(np.abs(voltage - before)) < 1e-15:
            break
    else:
        raise RuntimeError("the sweeps do not converge: no operating point")
    return np.abs(voltage) ** 2
