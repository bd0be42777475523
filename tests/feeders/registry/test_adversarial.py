"""Every stated error at its end and aligned, against AC power flow, on every feeder of the data set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, Snapshot, from_tables, load, names, plant, to_frame
from feeders.registry import DIRECT, MODAL, DesignedEstimator, choose, design
from feeders.simulation.plant import ClosedLoop, Loads, Point
from feeders.simulation.powerflow import PowerFlow
from gridsec.estimators import exact_bank
from gridsec.interface import Cause, Decision, Estimate, Frame, Verdict

JITTERS = 3.9  # standard deviations; the monitor allows for 4


@cache
def site(name: str) -> Site:
    return load(name)


@cache
def default(name: str, step_s: float) -> DesignedEstimator:
    tables = choose(site(name), estimator=MODAL).tables
    meta = replace(tables.meta, monitor=replace(tables.meta.monitor, tick_s=step_s))
    return design(from_tables(replace(tables, meta=meta)))


@cache
def designed(name: str, step_s: float) -> exact_bank.MonitorDesign:
    attacked = site(name).tables.meta.monitor.max_attacked
    return exact_bank.design(plant(site(name)), max_attacked=attacked, step_s=step_s)


@dataclass(frozen=True)
class Ends:
    """Which end of its interval each error is at, +1 or -1.

    meters, busbar: their readings are high. power: metered imports are high. reactive: loads draw the most
    reactive power that the file allows them.
    """

    meters: int
    busbar: int
    power: int
    reactive: int


HIGH = Ends(meters=1, busbar=-1, power=1, reactive=-1)  # meters above whatever the model predicts
LOW = Ends(meters=-1, busbar=1, power=-1, reactive=1)


class World:
    """A feeder in closed loop with its inverters, seen through meters at the ends of their classes."""

    def __init__(self, name: str, ends: Ends, *, v0: float, load: float, sun: float) -> None:
        self.site = site(name)
        self.ends = ends
        self.volt = self.site.feeder.base_volt
        self.loop = ClosedLoop(PowerFlow(self.site), self.site.droop, self.site.feeder.base_kva, self.volt)
        self.t = 1e9
        self.v0 = v0
        self.demand(load, sun)
        self.now: Point = self.loop.equilibrium(self.loads())

    def demand(self, load: float, sun: float) -> None:
        rows, model = self.site.tables.customers, self.site.loads
        drawn = load * np.array([row.load_kw for row in rows], dtype=np.float64)
        self.p = drawn - sun * np.array([row.pv_kw for row in rows], dtype=np.float64)
        floor = model.q_floor * self.site.feeder.base_kva
        tan = model.tan_max if self.ends.reactive > 0 else model.tan_min
        self.q = drawn * tan + self.ends.reactive * floor

    def loads(self) -> Loads:
        return Loads(self.p, self.q, self.v0 * self.volt)

    def run(self, h: float) -> None:
        self.t += h
        if h > 100.0:
            self.now = self.loop.equilibrium(self.loads())
            return
        steps = max(1, int(np.ceil(h / 0.25)))
        self.now = self.loop.point(self.loads(), self.now.x)  # what jumped has jumped at the beginning
        for _ in range(steps):
            self.now = self.loop.advance(self.loads(), self.now, None, h / steps)

    def snapshot(self, lies: dict[int, float]) -> Snapshot:
        ends, accuracy, at = self.ends, self.site.accuracy, self.site.meters
        v = self.now.v_volt[at] * (1.0 + ends.meters * accuracy.class_fraction)
        v += ends.meters * JITTERS * accuracy.jitter * self.volt
        step = accuracy.resolution * self.volt
        v = np.round(v / step) * step
        for j, lie in lies.items():
            v[j] *= 1.0 + lie
        fraction = self.site.loads.p_fraction[at] / (1.0 + self.site.loads.p_fraction[at])
        grain = self.site.tables.meta.meters.p_resolution_kw
        p = self.p[at] / (1.0 - ends.power * np.sign(self.p[at]) * fraction)
        v0 = self.v0 * (1.0 + ends.busbar * accuracy.busbar_class)
        v0 += ends.busbar * JITTERS * accuracy.busbar_jitter
        tick = accuracy.busbar_resolution
        return Snapshot(
            t=self.t,
            v_volt=v,
            p_kw=np.round(p / grain) * grain,
            q_kvar=np.full(at.size, np.nan),
            v0_volt=float(np.round(v0 / tick) * tick * self.volt),
        )


class Watch:
    """A monitor that is never wrong: the truth checks every frame."""

    def __init__(self, world: World, step_s: float, *, monitor: str = DIRECT) -> None:
        self.world = world
        name = world.site.tables.meta.name
        self.step: Callable[[Any, Frame], tuple[Any, Estimate, Verdict]]
        if monitor == DIRECT:
            self.step = partial(exact_bank.step, designed(name, step_s))
            self.state: Any = exact_bank.init(designed(name, step_s), world.t)
        else:
            self.step = default(name, step_s).step
            self.state = default(name, step_s).init(world.t)

    def look(self, lies: dict[int, float] | None = None) -> Verdict:
        world, lies = self.world, lies or {}
        frame = to_frame(world.site, world.snapshot(lies))
        self.state, estimate, verdict = self.step(self.state, frame)
        true = (world.now.v_volt / world.volt) ** 2
        assert np.all(np.abs(estimate.v2 - true) <= estimate.bound)
        honest = np.ones(verdict.suspects.size, dtype=bool)
        honest[list(lies)] = False
        assert not np.any(verdict.suspects & honest)
        return verdict


@pytest.mark.canary("900.0-simbench-lv-rural1-exact-bank", "900.0-cigre-lv-modal")
@pytest.mark.parametrize("monitor", [DIRECT, MODAL])
@pytest.mark.parametrize("name", names())
@pytest.mark.parametrize("step_s", [1.0, 900.0])
def test_no_alignment_of_honest_errors_is_an_attack(name: str, step_s: float, monitor: str) -> None:
    """Droop curves at work (0.95 and 1.05 pu) or at rest, full load or full sun."""
    for ends in (HIGH, LOW, Ends(1, 1, 1, 1), Ends(-1, -1, -1, 1)):
        for v0 in (0.95, 1.0, 1.05):
            for demand in ((1.0, 0.0), (0.1, 1.0)):
                watch = Watch(
                    World(name, ends, v0=v0, load=demand[0], sun=demand[1]), step_s, monitor=monitor
                )
                for _ in range(4):
                    watch.world.run(step_s)
                    verdict = watch.look()
                    assert verdict.decision is not Decision.ATTACKED
                    # The others take honest errors for independent: all at their ends, they are a misfit.
                    more = set() if monitor == DIRECT else {Cause.MISFIT}
                    assert verdict.cause in {Cause.AGREEMENT, Cause.SETTLING} | more


SMALL = ("cigre-lv", "kerber-landnetz", "simbench-lv-rural1")


@pytest.mark.canary("simbench-lv-rural1-exact-bank")
@pytest.mark.parametrize(
    ("name", "monitor"),
    [(name, DIRECT) for name in names()] + [(name, MODAL) for name in SMALL],
)
def test_no_jump_between_two_readings_is_an_attack(name: str, monitor: str) -> None:
    """A tap step of 2.5 %, all loads or all the sun at once, just before a reading or long before."""
    for ends in (HIGH, LOW):
        for v0 in (0.96, 1.04):
            for jump in ("up", "down", "load", "sun"):
                for ago in (0.05, 0.95):
                    watch = Watch(World(name, ends, v0=v0, load=0.4, sun=0.5), 1.0, monitor=monitor)
                    world = watch.world
                    for _ in range(10):
                        world.run(1.0)
                        watch.look()
                    world.run(1.0 - ago)
                    if jump in {"up", "down"}:
                        world.v0 += 0.025 if jump == "up" else -0.025
                    else:
                        world.demand(float(jump == "load"), float(jump == "sun"))
                    world.run(ago)
                    for _ in range(4):
                        watch.look()
                        world.run(1.0)


# A lie, in percent, that is named whatever the honest errors: more where the loads are known less well.
NAMED_PERCENT = {
    "case33bw": 5.5,
    "cigre-lv": 3.25,
    "kerber-dorfnetz": 3.25,
    "kerber-landnetz": 3.0,
    "kerber-vorstadtnetz": 3.0,
    "simbench-lv-rural1": 2.5,
    "simbench-lv-rural3": 3.0,
}


def hidden(name: str, percent: float) -> int:
    """In how many alignments a lie by M neighbours is not named, or taken for CLEAN before it is.

    They lie together in the direction that hides best: against their own bias.
    """
    reactance = designed(name, 1.0).model.X[np.ix_(site(name).meters, site(name).meters)]
    attacked = site(name).tables.meta.monitor.max_attacked
    depth = np.argsort(np.diag(reactance), kind="stable")
    missed = 0
    for ends in (HIGH, LOW):
        for v0 in (0.95, 1.0, 1.05):
            for leader in {int(depth[-1]), int(depth[depth.size // 2]), int(depth[0]), 0}:
                watch = Watch(World(name, ends, v0=v0, load=0.5, sun=0.3), 1.0)
                for _ in range(10):
                    watch.world.run(1.0)
                    watch.look()
                together = np.argsort(-reactance[leader], kind="stable")[:attacked]
                lies = {int(j): -percent / 100.0 * ends.meters for j in together}
                answers = []
                for _ in range(4):
                    watch.world.run(1.0)
                    answers.append(watch.look(lies))
                missed += any(verdict.decision is Decision.CLEAN for verdict in answers) or not all(
                    answers[-1].suspects[j] for j in lies
                )
    return missed


@pytest.mark.canary("cigre-lv")
@pytest.mark.parametrize("name", names())
def test_smallest_lie_that_is_named_in_every_alignment(name: str) -> None:
    """Droop curves at work and at rest, at head, middle and end. Half a percent less can hide."""
    assert hidden(name, NAMED_PERCENT[name]) == 0
    assert hidden(name, NAMED_PERCENT[name] - 0.5) > 0


def test_wide_load_intervals_on_a_long_feeder(monkeypatch: pytest.MonkeyPatch) -> None:
    """One meter, no inverter: loads at their intervals' far end, where losses are largest."""
    tables = load("case33bw").tables
    rows = tuple(
        replace(c, meter=c.meter if i == 0 else "", inverter_kva=0.0, droop="")
        for i, c in enumerate(tables.customers)
    )
    tables = replace(
        tables,
        meta=replace(tables.meta, monitor=replace(tables.meta.monitor, max_attacked=0)),
        customers=rows,
    )
    made = from_tables(tables)
    monkeypatch.setattr(f"{__name__}.site", lambda _: made)
    monkeypatch.setattr(
        f"{__name__}.designed", lambda _, h: exact_bank.design(plant(made), max_attacked=0, step_s=h)
    )
    watch = Watch(World("case33bw", LOW, v0=0.95, load=1.0, sun=0.0), 900.0)
    for _ in range(2):
        watch.world.run(900.0)
        watch.look()


@pytest.mark.canary(
    "cigre-lv-0.955-ends0-load-exact-bank",
    "cigre-lv-0.955-ends1-sun-exact-bank",
    "cigre-lv-0.99-ends0-sun-modal",
    "cigre-lv-1.03-ends0-load-modal",
    "cigre-lv-1.03-ends1-sun-exact-bank",
    "cigre-lv-1.045-ends1-load-exact-bank",
    "kerber-landnetz-0.955-ends0-sun-exact-bank",
    "kerber-landnetz-0.955-ends1-sun-modal",
    "kerber-landnetz-0.99-ends1-load-modal",
    "kerber-landnetz-1.03-ends0-sun-exact-bank",
    "kerber-landnetz-1.045-ends0-load-exact-bank",
    "kerber-landnetz-1.045-ends1-load-modal",
    "case33bw-0.955-ends0-sun-modal",
    "case33bw-0.99-ends0-load-modal",
    "case33bw-0.99-ends1-sun-exact-bank",
    "case33bw-1.03-ends1-load-exact-bank",
    "case33bw-1.045-ends0-load-modal",
    "case33bw-1.045-ends1-sun-modal",
)
@pytest.mark.parametrize("monitor", [DIRECT, MODAL])
@pytest.mark.parametrize("jump", ["load", "sun"])
@pytest.mark.parametrize("ends", [HIGH, LOW])
@pytest.mark.parametrize("v0", [0.955, 0.99, 1.03, 1.045])
@pytest.mark.parametrize("name", ["cigre-lv", "kerber-landnetz", "case33bw"])
def test_a_jump_just_before_a_quarter_hourly_reading(
    name: str, v0: float, ends: Ends, jump: str, monitor: str
) -> None:
    watch = Watch(World(name, ends, v0=v0, load=0.4, sun=0.5), 900.0, monitor=monitor)
    world = watch.world
    for _ in range(4):
        world.run(900.0)
        watch.look()
    world.run(899.5)
    world.demand(float(jump == "load"), float(jump == "sun"))
    world.run(0.5)
    watch.look()
