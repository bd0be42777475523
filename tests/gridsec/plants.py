"""Small feeders with droop inverters that several tests share; every number is made up here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Ints
from gridsec.grid.devices import fleet
from gridsec.grid.radial import Feeder
from gridsec.observers.lure import Lure, close_loop


@dataclass(frozen=True)
class Street:
    """A feeder with its closed loop and what its loads may be wrong by."""

    feeder: Feeder
    lure: Lure
    meters: Ints
    # Square root of the covariance of the known input's error: load @ load.T = 4 R S_p R + 4 X S_q X.
    load: Floats
    # Largest error of each entry of the known input.
    load_size: Floats


def street(  # noqa: PLR0917
    parent: list[int],
    bus: list[int],
    inverters: list[int],
    meters: list[int],
    seed: int = 0,
    tau: tuple[float, float] = (2.0, 2.0),
    kva: float = 20.0,
    base_kva: float = 100.0,
    preset: str = "ieee1547-b",
) -> Street:
    """A feeder of cable (about 0.4 ohm and 0.1 ohm per km, spans of 40 to 120 m)."""
    rng = np.random.default_rng(seed)
    branches = len(parent)
    km = rng.uniform(0.04, 0.12, branches)
    ohm = 3.0 * 230.0**2 / (1e3 * base_kva)
    feeder = Feeder(
        name="street",
        parent=np.array(parent),
        r=0.4 * km / ohm,
        x=0.1 * km / ohm,
        bus=np.array(bus),
        customers=tuple(f"c{i}" for i in range(len(bus))),
        buses=tuple(f"b{i}" for i in range(branches + 1)),
        base_volt=230.0,
        base_kva=base_kva,
        charging=np.zeros(branches),
    )
    droop = fleet(
        np.array(inverters),
        preset,
        np.full(len(inverters), kva),
        base_kva,
        tau=rng.uniform(*tau, len(inverters)),
    )
    model = feeder.linear()
    shape = 2.0 * np.hstack([model.R * (0.6 / base_kva), model.X * (0.2 / base_kva)])
    values, vectors = np.linalg.eigh(shape @ shape.T)
    load = vectors * np.sqrt(np.maximum(values, 0.0))
    where = np.array(meters)
    size = 3.0 * np.abs(shape).sum(axis=1)
    return Street(feeder, close_loop(feeder, droop, where), where, load, size)


def line(count: int, **more: object) -> Street:
    """`count` customers in a row, each with an inverter and a meter."""
    every = list(range(count))
    return street(every, [i + 1 for i in every], every, every, **more)  # type: ignore[arg-type]


def tree() -> Street:
    """Two branches; unequal time constants; a customer without a meter, one without an inverter."""
    return street(
        parent=[0, 1, 2, 1, 4, 5],
        bus=[1, 2, 3, 4, 5, 6],
        inverters=[0, 1, 2, 4, 5],
        meters=[0, 1, 3, 4, 5],
        seed=1,
        tau=(1.6, 2.4),
    )


def shared() -> Street:
    """Two customers on one bus and one on the busbar: X is singular."""
    return street(
        parent=[0, 1, 1], bus=[1, 2, 2, 3, 0], inverters=[0, 1, 2, 3], meters=[0, 1, 2, 3, 4], seed=2
    )
