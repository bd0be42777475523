"""The truth behind a scenario: AC power flow and droop inverters, carried from tick to tick."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.inverters import TOLERANCE_PU, ClosedLoop, Loads, Point
from feeders.powerflow_unbalanced import power_flow
from feeders.variation import Customers, Demand
from gridsec.arrays import Floats, Ints
from gridsec.attack import InverterAttack

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.scenario import Scenario

BLOCK_TICKS: Final = 256

SUBSTEPS_PER_TAU: Final = 2.0
"""Substeps per smallest time constant; see docs/simulation.md for the error that this leaves."""

SHORTEST_STRETCH: Final = 8
LONGEST_STRETCH: Final = 64
"""Fewest and most steps that are solved together."""

MAX_SWEEPS: Final = 12
"""Sweeps over a stretch before it is given up."""

VANISHED_PU: Final = 1e-30
"""What decays below this is zero; otherwise it would become denormal, and arithmetic slow."""

QUASI_STATIC_TAUS: Final = 10.0
"""A tick longer than this many of the largest time constants is one quasi-static step."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The truth at T consecutive ticks. N customers, m inverters, b + 1 buses.

    Attributes
    ----------
    ticks : (T,)
        Their numbers.
    t : (T,)
        Their times, Unix s.
    v_volt : (T, N)
        Voltage at each customer, V.
    v_bus_volt : (T, b + 1)
        Voltage of each bus, V; in three phases of each phase of each.
    x : (T, m)
        Reactive injection of each inverter as its droop curve has it, pu.
    demand
        What customers draw without their inverters' reactive power, and the busbar's voltage.
    shown_kw : (T, N)
        The active power that readings show.
    """

    ticks: Ints
    t: Floats
    v_volt: Floats
    v_bus_volt: Floats
    x: Floats
    demand: Demand
    shown_kw: Floats


def truth(site: Site, scenario: Scenario, first: int, end: float) -> Iterator[Block]:
    """The truth from tick `first` up to tick `end`, which may be infinite; begins in equilibrium."""
    customers = Customers(
        site, scenario.variation, scenario.seed, scenario.start, scenario.profile_s, season=scenario.season
    )
    loop = ClosedLoop(power_flow(site), site.droop, site.feeder.base_kva, site.customer_volt)
    steps = substeps(site, scenario)
    course = _Course(loop, scenario.dt_s / steps)
    begin = first
    while begin < end:
        ticks = np.arange(begin, min(begin + BLOCK_TICKS, end), dtype=np.intp)
        t = scenario.start + ticks.astype(np.float64) * scenario.dt_s
        back = scenario.dt_s * np.arange(steps - 1, -1, -1) / steps
        # The very first tick is where the course begins: nothing has to lead up to it.
        skip = steps - 1 if begin == first else 0
        moments = (t[:, None] - back).ravel()[skip:]
        told = customers.at(moments)
        p, q = customers.hidden(moments)
        q = q - site.feeder.base_kva * injected(site, scenario.inverter_attacks, moments)
        fine = Demand(told.p_kw + p, told.q_kvar + q, told.v0_volt)
        v_volt, v_bus_volt, x = course.run(fine)
        at = slice(steps - 1 - skip, None, steps)
        demand = Demand(fine.p_kw[at], fine.q_kvar[at], fine.v0_volt[at])
        yield Block(ticks, t, v_volt[at], v_bus_volt[at], x[at], demand, told.p_kw[at])
        begin += ticks.size


def injected(site: Site, attacks: tuple[InverterAttack, ...], t: Floats) -> Floats | float:
    """What attacked inverters inject beside their droop curves at times t (T,), pu per customer, (T, N)."""
    if not attacks:
        return 0.0
    count = len(site.tables.customers)
    out = np.zeros((t.size, count))
    for attack in attacks:
        at = site.droop.customer[attack.inverters]
        on = (attack.t_on <= t) & (t < attack.t_off)
        out[on] += np.bincount(at, weights=attack.q, minlength=count)
    return out


class _Course:
    """The closed loop carried forward in equal steps of h seconds; begins in equilibrium.

    Solving many power flows at once costs little more than solving one. So a stretch of steps is guessed
    first, all of it is solved, the inverters' course is computed from the voltages found, and so on until it
    no longer changes. Where that does not converge quickly, the same equations are solved step by step.
    """

    def __init__(self, loop: ClosedLoop, h: float) -> None:
        self._loop = loop
        self._h = h
        self._weights = loop.weights(h)
        self._now: Point | None = None
        self._before: Point | None = None
        self._stretch = LONGEST_STRETCH
        self._single = 0

    def run(self, demand: Demand) -> tuple[Floats, Floats, Floats]:
        """One step to each row of `demand`.

        Returns
        -------
        v_volt (T, N), v_bus_volt (T, b + 1)
            Voltages after each step, V.
        x (T, m)
            Injections of the inverters, pu.
        """
        steps = len(demand.v0_volt)
        parts: list[tuple[Floats, Floats, Floats]] = []
        k = 0
        while k < steps:
            part = self._relax(demand, slice(k, min(k + self._stretch, steps)))
            if part is None:
                part = self._step(Loads(demand.p_kw[k], demand.q_kvar[k], demand.v0_volt[k]))
            parts.append(part)
            k += len(part[0])
        v_volt, v_bus_volt, x = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return v_volt, v_bus_volt, x

    def _step(self, loads: Loads) -> tuple[Floats, Floats, Floats]:
        if self._now is None:
            after = self._loop.equilibrium(loads)
        else:
            after = self._loop.advance(loads, self._now, self._before, self._h)
        self._before, self._now = self._now, after
        return after.v_volt[None], after.v_bus_volt[None], after.x[None]

    def _relax(self, demand: Demand, rows: slice) -> tuple[Floats, Floats, Floats] | None:
        """A stretch of steps at once; None where it has to be done step by step."""
        now = self._now
        if now is None or self._single > 0:
            self._single = max(self._single - 1, 0)
            return None
        length = rows.stop - rows.start
        course = self._follow(now, np.broadcast_to(now.setpoint, (length, self._loop.count)))
        for _ in range(MAX_SWEEPS):
            v_volt, v_bus_volt, setpoint = self._loop.held(demand, rows, course)
            found = self._follow(now, setpoint)
            if np.max(np.abs(found - course), initial=0.0) <= TOLERANCE_PU:
                self._before = None
                self._now = Point(course[-1], setpoint[-1], v_volt[-1], v_bus_volt[-1])
                self._stretch = min(2 * self._stretch, LONGEST_STRETCH)
                return v_volt, v_bus_volt, course
            course = found
        self._stretch = max(self._stretch // 2, SHORTEST_STRETCH)
        if self._stretch == SHORTEST_STRETCH:
            self._single = BLOCK_TICKS  # hopeless for now: do not pay for the attempt before every step
        return None

    def _follow(self, now: Point, setpoint: Floats) -> Floats:
        """The course x (T, m) of the inverters from `now` on, for given set-points (T, m)."""
        decay, old, new = self._weights
        drive = new * setpoint
        drive[0] += old * now.setpoint
        drive[1:] += old * setpoint[:-1]
        course = np.empty_like(drive)
        x = np.where(np.abs(now.x) < VANISHED_PU, 0.0, now.x)
        for k in range(len(drive)):
            x = decay * x + drive[k]
            course[k] = x
        return course


def substeps(site: Site, scenario: Scenario) -> int:
    """How many steps the integrator takes per tick, at least 1."""
    tau = site.droop.tau
    if tau.size == 0:
        return 1
    if scenario.substep_s is not None:
        longest = scenario.substep_s
    elif scenario.dt_s > QUASI_STATIC_TAUS * float(tau.max()):
        return 1
    else:
        longest = float(tau.min()) / SUBSTEPS_PER_TAU
    return max(int(np.ceil(scenario.dt_s / longest - 1e-9)), 1)


def net_reactive(site: Site, block: Block) -> Floats:
    """Net reactive import of every customer, inverter included, kvar, (T, N)."""
    owner = np.eye(len(site.tables.customers))[site.droop.customer]
    return block.demand.q_kvar - site.feeder.base_kva * (block.x @ owner)
