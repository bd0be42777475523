"""A street for tests: AC power flow by complex sweeps, inverters that follow np.interp, meters with flaws.

Nothing here uses the model that it tests: voltages are complex, currents are injected, curves are
interpolated in v.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gridsec.estimators.plant import Plant
from gridsec.grid.devices import Droop, MeterAccuracy, fleet
from gridsec.grid.radial import Feeder
from gridsec.interface import Frame

BASE_KVA = 100.0
BASE_VOLT = 230.0
CLASS, RESOLUTION, JITTER = 0.005, 0.1 / BASE_VOLT, 0.0005
BUSBAR_CLASS = 0.001
P_CLASS = 0.01
TAN_MIN, TAN_MAX = 0.0, 0.5


def random_tree(customers: int, rng: np.random.Generator, *, drop: float, ratio: float = 0.4) -> Feeder:
    """A random tree whose voltage drop at 5 kW per customer is about `drop`."""
    parent = np.array([rng.integers(max(0, k - 3), k + 1) for k in range(customers)])
    r = rng.uniform(0.5, 1.5, customers)
    depth = np.zeros(customers + 1)
    below = np.ones(customers + 1)
    for k in range(customers, 0, -1):
        below[parent[k - 1]] += below[k]
    for k in range(1, customers + 1):
        depth[k] = depth[parent[k - 1]] + r[k - 1] * below[k] * 5.0 / BASE_KVA
    r *= drop / depth.max()
    return Feeder(
        name="street",
        parent=parent,
        r=r,
        x=r * ratio * rng.uniform(0.7, 1.3, customers),
        bus=np.arange(1, customers + 1),
        customers=tuple(f"c{i}" for i in range(customers)),
        buses=tuple(f"b{i}" for i in range(customers + 1)),
        base_volt=BASE_VOLT,
        base_kva=BASE_KVA,
        charging=np.zeros(customers),
    )


def accuracy(meters: int) -> MeterAccuracy:
    return MeterAccuracy(
        class_fraction=np.full(meters, CLASS),
        resolution=np.full(meters, RESOLUTION),
        jitter=np.full(meters, JITTER),
        busbar_class=BUSBAR_CLASS,
        busbar_resolution=RESOLUTION,
        busbar_jitter=0.0,
    )


def make_plant(
    rng: np.random.Generator,
    *,
    customers: int = 9,
    drop: float = 0.02,
    inverters: np.ndarray | None = None,
    meters: np.ndarray | None = None,
    presets: tuple[str, ...] = ("ieee1547-a", "ieee1547-b", "vde4105"),
    **options: int,
) -> Plant:
    own = np.arange(customers) if inverters is None else inverters
    where = np.arange(customers) if meters is None else meters
    droop = fleet(
        own, [presets[i % len(presets)] for i in range(own.size)], rng.uniform(3, 10, own.size), BASE_KVA
    )
    return Plant(random_tree(customers, rng, drop=drop), droop, where, accuracy(where.size), **options)


def ac_voltages(feeder: Feeder, s: np.ndarray, v0: float) -> np.ndarray:
    """|v| of every bus for complex net injections s (N,), by backward and forward sweeps."""
    buses = len(feeder.buses)
    v = np.full(buses, complex(v0))
    z = feeder.r + 1j * feeder.x
    at = np.zeros(buses, dtype=complex)
    np.add.at(at, feeder.bus, s)
    for _ in range(60):
        current = np.conj(-at / v)
        for k in range(buses - 1, 0, -1):
            current[feeder.parent[k - 1]] += current[k]
        new = v.copy()
        for k in range(1, buses):
            new[k] = new[feeder.parent[k - 1]] - z[k - 1] * current[k]
        done = np.abs(new - v).max() < 1e-12
        v = new
        if done:
            return np.abs(v)
    raise AssertionError("the sweeps did not converge")


def curves(droop: Droop, v: np.ndarray) -> np.ndarray:
    return np.array([np.interp(v[i], droop.v[i], droop.q[i]) for i in range(v.size)])


@dataclass
class Street:
    """The truth, step by step, and the frames it is seen through.

    `extreme`: meters sit at the ends of their classes and loads at the ends of their intervals, all of
    them in the same direction or each by a coin; otherwise errors are anywhere inside.
    """

    plant: Plant
    rng: np.random.Generator
    extreme: bool = False
    metered_q: np.ndarray | None = None
    load_kw: float = 4.0
    wobble: float = 0.02
    t: float = 1000.0
    x: np.ndarray = field(init=False)
    p: np.ndarray = field(init=False)
    usual: np.ndarray = field(init=False)
    level: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng, n = self.rng, len(self.plant.feeder.customers)
        meters = self.plant.meters.size
        self.x = np.zeros(self.plant.droop.tau.size)
        self.usual = -rng.uniform(0.2, 1.8, n) * self.load_kw / BASE_KVA
        self.p, self.level = self.usual, np.zeros(n)
        together = rng.random() < 0.5

        def draw(k: int) -> np.ndarray:
            if not self.extreme:
                return rng.uniform(-1.0, 1.0, k)
            return np.full(k, rng.choice([-1.0, 1.0])) if together else rng.choice([-1.0, 1.0], k)

        self.bias = CLASS * draw(meters)
        self.busbar_bias = BUSBAR_CLASS * draw(1)[0]
        self.p_bias = P_CLASS * draw(n)
        self.tan = 0.5 * (TAN_MIN + TAN_MAX) + 0.5 * (TAN_MAX - TAN_MIN) * 0.98 * draw(n)
        self.q_bias = draw(n)
        self.v0 = 1.0 + 0.01 * rng.uniform(-1.0, 1.0)
        self.rest()

    def voltages(self) -> np.ndarray:
        q = self.p * self.tan
        np.add.at(q, self.plant.droop.customer, self.x)
        return ac_voltages(self.plant.feeder, self.p + 1j * q, self.v0)

    def rest(self) -> None:
        """Let the inverters come to rest."""
        for _ in range(400):
            v = self.voltages()[self.plant.feeder.bus]
            aim = curves(self.plant.droop, v[self.plant.droop.customer])
            if np.abs(aim - self.x).max(initial=0.0) < 1e-10:
                return
            self.x = self.x + 0.4 * (aim - self.x)

    def advance(self, h: float) -> None:
        """Loads wobble and hold; the inverters follow in small steps, or come to rest in a long one."""
        droop = self.plant.droop
        self.t += h
        self.level = 0.9 * self.level + self.wobble * self.rng.normal(0.0, 1.0, self.p.size)
        self.p = self.usual * (1.0 + np.clip(self.level, -0.8, 1.0))
        if h > 60.0:
            self.rest()
            return
        steps = 4
        for _ in range(steps):
            v = self.voltages()[self.plant.feeder.bus][droop.customer]
            keep = np.exp(-h / steps / droop.tau)
            self.x = keep * self.x + (1.0 - keep) * curves(droop, v)

    def frame(self, lies: dict[int, float] | None = None, silent: tuple[int, ...] = ()) -> Frame:
        """What is known of the present. `lies`: relative displacement of meters."""
        rng, at = self.rng, self.plant.meters
        v = self.voltages()
        jitter = np.clip(rng.normal(0.0, JITTER, at.size), -3.9 * JITTER, 3.9 * JITTER)
        reading = v[self.plant.feeder.bus][at] * (1.0 + self.bias) + jitter
        reading = np.round(reading / RESOLUTION) * RESOLUTION
        for j, lie in (lies or {}).items():
            reading[j] *= 1.0 + lie
        v0 = np.round(self.v0 * (1.0 + self.busbar_bias) / RESOLUTION) * RESOLUTION
        p = self.p * (1.0 + self.p_bias)
        n = self.p.size
        q_net, q_net_error = np.full(n, np.nan), np.full(n, 1e-3)
        if self.metered_q is not None:
            q = self.p * self.tan
            np.add.at(q, self.plant.droop.customer, self.x)
            q_net[self.metered_q] = (q + 1e-3 * self.q_bias)[self.metered_q]
        seen = np.ones(at.size, dtype=bool)
        seen[list(silent)] = False
        return Frame(
            t=self.t,
            y=np.where(seen, reading**2, np.nan),
            seen=seen,
            v0_squared=float(v0**2),
            p=p,
            p_error=1.02 * P_CLASS * np.abs(p),
            q=0.5 * (TAN_MIN + TAN_MAX) * p,
            q_error=0.5 * (TAN_MAX - TAN_MIN) * 1.02 * np.abs(p),
            q_net=q_net,
            q_net_error=q_net_error,
        )

    def truth(self) -> np.ndarray:
        """True squared voltage of every customer."""
        return self.voltages()[self.plant.feeder.bus] ** 2
