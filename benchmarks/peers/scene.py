"""Snapshots of a feeder with known liars: AC power flow is the truth, and every reading has noise.

A voltage meter at every customer and at the busbar, active and reactive power of every customer as
pseudo-measurements. Loads and generation are random. Three attacks of size 3 %:

`bias`
    k random meters read 3 % high.
`coord`
    A fake load that would drop one customer's voltage by 3 %; the k most affected meters report just the
    voltages that it would cause, the customer's own first.
`coord+pq`
    The same, and that customer's active and reactive power are reported as if the load were there.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace

import numpy as np

from feeders.convert.convert import convert
from feeders.model.site import Site, load
from feeders.simulation.powerflow import Grid, PowerFlow
from gridsec.arrays import Bools, Floats
from gridsec.grid.radial import Feeder

SIZE = 0.03
"""Size of every attack, of the voltage."""

ATTACKS = ("bias", "coord", "coord+pq")
FEEDERS = {"rural1": "simbench-lv-rural1", "rural3": "simbench-lv-rural3"}
HELD_OUT = {
    "rural2": "simbench:1-LV-rural2--0-sw",
    "semiurb4": "simbench:1-LV-semiurb4--0-sw",
    "semiurb5": "simbench:1-LV-semiurb5--0-sw",
    "urban6": "simbench:1-LV-urban6--0-sw",
    "landnetz_f2": "pandapower:create_kerber_landnetz_freileitung_2",
    "landnetz_k1": "pandapower:create_kerber_landnetz_kabel_1",
    "landnetz_k2": "pandapower:create_kerber_landnetz_kabel_2",
    "vorstadt_k2": "pandapower:create_kerber_vorstadtnetz_kabel_2",
}
"""Sources of networks on which no parameter of any method was chosen; see `feeders.convert`."""
POWER_FACTOR_TAN = 0.33
# No power is known better than this part of the feeder's mean connected load.
FLOOR = 0.5


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of the table: a feeder, the quality of its readings, and the manipulated meters.

    Attributes
    ----------
    feeder
        Key of `FEEDERS` or `HELD_OUT`.
    std_v, std_pq
        Standard deviation of a voltage reading, and of the powers, as fractions.
    attack, liars
        One of `ATTACKS` and k; "clean" and 0.
    """

    feeder: str
    std_v: float
    std_pq: float
    attack: str = "clean"
    liars: int = 0


@dataclass(frozen=True, slots=True)
class Transformer:
    """The one that feeds the feeder: rated power, kVA, and short-circuit voltages, %."""

    kva: float
    vk_percent: float
    vkr_percent: float


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A feeder, ready to make snapshots and to be estimated. N customers.

    Attributes
    ----------
    feeder
        The feeder, behind its transformer if it has one.
    flow
        Its AC power flow.
    load, sun : (N,)
        Connected load and generation, pu.
    """

    feeder: Feeder
    flow: PowerFlow
    load: Floats
    sun: Floats

    @property
    def kw(self) -> float:
        """1 pu of power, kW."""
        return self.feeder.base_kva

    @property
    def volt(self) -> float:
        """1 pu of voltage, V."""
        return self.feeder.base_volt


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Readings of all methods, and the truth. T readings each, N customers.

    Attributes
    ----------
    v : (T, N)
        Voltage readings, pu.
    v0 : (T,)
        Voltage readings of the busbar, pu.
    p, q : (T, N)
        Net imports as reported, pu.
    std_v
        Standard deviation of a voltage reading, pu.
    std_p, std_q : (N,)
        Standard deviations of `p` and `q`, pu.
    liars : (N,)
        Customers with a manipulated voltage reading.
    true_v : (N,)
        The voltages, pu.
    """

    v: Floats
    v0: Floats
    p: Floats
    q: Floats
    std_v: float
    std_p: Floats
    std_q: Floats
    liars: Bools
    true_v: Floats


TRANSFORMERS = {
    "rural1": Transformer(160.0, 4.0, 1.46875),
    "rural2": Transformer(250.0, 6.0, 1.32),
    "rural3": Transformer(400.0, 6.0, 1.2),
    "semiurb4": Transformer(400.0, 6.0, 1.2),
    "semiurb5": Transformer(630.0, 6.0, 1.09524),
    "urban6": Transformer(630.0, 6.0, 1.09524),
    "landnetz_f2": Transformer(100.0, 4.0, 1.2),
    "landnetz_k1": Transformer(100.0, 4.0, 1.2),
    "landnetz_k2": Transformer(160.0, 4.0, 1.2),
    "vorstadt_k2": Transformer(630.0, 4.0, 1.0794),
}
"""Those of the sources."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What every method is told: one reading, or the mean of several. Fields as in `Snapshot`."""

    v: Floats
    v0: float
    p: Floats
    q: Floats
    std_v: float
    std_p: Floats
    std_q: Floats


def reading(told: Snapshot, t: int) -> Reading:
    """One of a snapshot's readings."""
    return Reading(told.v[t], float(told.v0[t]), told.p[t], told.q[t], told.std_v, told.std_p, told.std_q)


def mean(told: Snapshot) -> Reading:
    """The mean of a snapshot's readings; its noise is smaller, the powers' error is not."""
    means = (told.v.mean(axis=0), float(told.v0.mean()), told.p.mean(axis=0), told.q.mean(axis=0))
    return Reading(*means, told.std_v / float(np.sqrt(len(told.v))), told.std_p, told.std_q)


def scene(feeder: str) -> Scene:
    """Prepare a feeder by its name; one that ends in `-behind` is fed through its transformer."""
    name, _, behind = feeder.partition("-")
    site = load(FEEDERS[name]) if name in FEEDERS else _converted(HELD_OUT[name])
    load_kw, sun_kw = np.array([(c.load_kw, c.pv_kw) for c in site.tables.customers]).T
    kva = site.feeder.base_kva
    flow, tree = PowerFlow(site), site.feeder
    if behind:
        tree, grid = _behind(tree, flow.grid, TRANSFORMERS[name])
        flow = PowerFlow.of(grid)
    return Scene(tree, flow, load_kw / kva, sun_kw / kva)


def _converted(source: str) -> Site:
    with tempfile.TemporaryDirectory() as folder:
        convert(source, folder, name="converted")
        return load(folder)


def _behind(tree: Feeder, grid: Grid, of: Transformer) -> tuple[Feeder, Grid]:
    """The same feeder with one more branch at its root; what was its busbar is a plain bus then."""
    z, r = of.vk_percent / 100.0, of.vkr_percent / 100.0
    x = float(np.sqrt(z * z - r * r))
    pu = tree.base_kva / of.kva
    ohm = 3.0 * tree.base_volt**2 / (of.kva * 1e3)
    feeder = replace(
        tree,
        parent=np.concatenate([[0], tree.parent + 1]),
        r=np.concatenate([[r * pu], tree.r]),
        x=np.concatenate([[x * pu], tree.x]),
        charging=np.concatenate([[0.0], tree.charging]),
        bus=tree.bus + 1,
        buses=("source", *tree.buses),
    )
    source = grid.bus_count
    return feeder, replace(
        grid,
        ends=np.vstack([grid.ends, [source, grid.busbar]]),
        r_ohm=np.append(grid.r_ohm, r * ohm),
        x_ohm=np.append(grid.x_ohm, x * ohm),
        b_siemens=np.append(grid.b_siemens, 0.0),
        tap=None if grid.tap is None else np.append(grid.tap, 1.0),
        busbar=source,
        bus_count=source + 1,
        nominal_volt=tree.base_volt,
    )


def snapshot(here: Scene, cell: Cell, rng: np.random.Generator, seconds: int = 1) -> Snapshot:
    """Draw a snapshot; with `seconds`, as many readings of the same state.

    Noise of voltages is new in every reading. The powers' error is that of profiles and stays.
    """
    n = here.load.size
    use = here.load * rng.uniform(0.1, 1.0, n)
    p = use - here.sun * rng.uniform(0.0, 0.6)
    q = POWER_FACTOR_TAN * use
    v0 = rng.uniform(0.98, 1.03)
    true_v = _voltages(here, p, q, v0)
    says_v, says_p, says_q, liars = _attacked(here, cell, rng, (p, q, v0, true_v))
    std_p, std_q = (
        cell.std_pq * np.maximum(np.abs(x), FLOOR * here.load.mean() * s)
        for x, s in ((says_p, 1.0), (says_q, POWER_FACTOR_TAN))
    )
    says_p = says_p + std_p * rng.normal(size=n)
    says_q = says_q + std_q * rng.normal(size=n)
    return Snapshot(
        v=says_v + cell.std_v * rng.normal(size=(seconds, n)),
        v0=v0 + cell.std_v * rng.normal(size=seconds),
        p=np.tile(says_p, (seconds, 1)),
        q=np.tile(says_q, (seconds, 1)),
        std_v=cell.std_v,
        std_p=std_p,
        std_q=std_q,
        liars=liars,
        true_v=true_v,
    )


def _voltages(here: Scene, p: Floats, q: Floats, v0: float) -> Floats:
    return here.flow.solve(p * here.kw, q * here.kw, v0 * here.volt)[0] / here.volt


def _attacked(
    here: Scene, cell: Cell, rng: np.random.Generator, truth: tuple[Floats, Floats, float, Floats]
) -> tuple[Floats, Floats, Floats, Bools]:
    """Reports before noise: voltages, powers, and manipulated meters."""
    p, q, _, v = truth
    liars = np.zeros(v.size, dtype=np.bool_)
    if cell.attack == "clean":
        return v, p, q, liars
    if cell.attack == "bias":
        liars[rng.choice(v.size, cell.liars, replace=False)] = True
        return v * np.where(liars, 1.0 + SIZE, 1.0), p, q, liars
    customer = int(rng.integers(v.size))
    fake_p, fake_q, fake_v = _fake_load(here, customer, truth)
    drop = v - fake_v
    drop[customer] = np.inf  # those behind it feel the same
    liars[np.argsort(-drop)[: cell.liars]] = True
    says = np.where(liars, fake_v, v)
    return (says, fake_p, fake_q, liars) if cell.attack == "coord+pq" else (says, p, q, liars)


def _fake_load(
    here: Scene, customer: int, truth: tuple[Floats, Floats, float, Floats]
) -> tuple[Floats, Floats, Floats]:
    """Powers and voltages with a load at a customer that drops its voltage by `SIZE`."""
    p, q, v0, v = truth
    add = 0.1
    for _ in range(8):
        fake_p, fake_q = p.copy(), q.copy()
        fake_p[customer] += add
        fake_q[customer] += POWER_FACTOR_TAN * add
        fake_v = _voltages(here, fake_p, fake_q, v0)
        add *= SIZE / float(v[customer] - fake_v[customer])
    return fake_p, fake_q, fake_v
