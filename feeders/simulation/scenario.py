"""Scenarios: a real feeder, its loads, inverters, meters and attackers, tick by tick.

The truth is full AC power flow with the droop inverters in closed loop (`feeders.simulation.plant`). The
output is readings as a service receives them, beside the true values. A scenario has the same numbers every
time; no clock is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from itertools import count
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.model.site import Snapshot
from feeders.profiles import Season
from feeders.simulation.attacks import random_attacks
from feeders.simulation.demand import Variation
from feeders.simulation.plant import (
    BUSBAR,
    Channel,
    Delivery,
    MeterErrors,
    PlantTrajectory,
    Registers,
    SimulatedMeters,
    net_reactive,
    truth,
)
from feeders.util import own_numbers
from gridsec.arrays import Bools, Floats, Ints
from gridsec.attack import Attack, InverterAttack, Reports, apply_all, manipulated, reach
from gridsec.errors import Problem, choice, raise_if_any, require

if TYPE_CHECKING:
    from feeders.model.site import Site

__all__ = [
    "LATEST_S",
    "START",
    "SUNNY_NOON_S",
    "Scenario",
    "Season",
    "SimulatedReading",
    "SimulatedTick",
    "by_arrival",
    "check",
    "random_attacks",
    "simulate",
    "snapshots",
]

START: Final = 1_780_272_000.0
"""Monday, 1 June 2026, 00:00 UTC."""

LATEST_S: Final = 1e10
"""Upper bound of times, s, in the year 2286; larger ones have another unit."""

SUNNY_NOON_S: Final = 216_000.0
"""Noon of the first Wednesday of a season's profiles; in summer a sunny day in June."""

LONGEST_LOOK_BACK_S: Final = 7 * 86_400.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """Simulated run: length, profiles, variation, meter errors, channel and attacks."""

    seed: int = 0  # seed of all random numbers, >= 0
    start: float = START  # Unix time of the first tick, s
    duration_s: float = 600.0  # ticks are at start + k dt_s < start + duration_s; may be infinite
    dt_s: float = 1.0  # interval between readings, s
    # Position within the season's profiles at `start`, s. They begin on a Monday at 00:00, have two weeks in
    # summer and one in the other seasons, and repeat. By default the noon of a Wednesday.
    profile_s: float = SUNNY_NOON_S
    # Longest step of the integrator, s. None: half the smallest time constant of the inverters, or one quasi-
    # static step for a tick of more than QUASI_STATIC_TAUS of the largest.
    substep_s: float | None = None
    # Variation of loads and busbar, errors of the meters, effects of the channel.
    variation: Variation = field(default_factory=Variation)
    errors: MeterErrors = field(default_factory=MeterErrors)
    channel: Channel = field(default_factory=Channel)
    # Attacks on meters, applied in this order. Meters are indices into `Site.meters`.
    attacks: tuple[Attack, ...] = ()
    # Wrong injections of inverters; they add up. Inverters are indices into `Site.droop`.
    inverter_attacks: tuple[InverterAttack, ...] = ()
    season: Season = Season.SUMMER  # season of loads and generation, independent of the date of `start`
    # Attacks on the busbar meter, applied in this order; none may use earlier readings. Their meters are its
    # phases, 0 to 2, or 0 on a balanced feeder.
    busbar_attacks: tuple[Attack, ...] = ()

    def __post_init__(self) -> None:
        own_numbers(self)
        object.__setattr__(self, "season", choice("season", Season, self.season))
        begin, length, step = self.start, self.duration_s, self.substep_s
        require(self.seed >= 0, Problem("negative", f"seed must not be negative, got {self.seed}"))
        finite = Problem("not-finite", f"profile_s must be finite, got {self.profile_s}")
        require(np.isfinite(self.profile_s), finite)
        unix = Problem("out-of-range", f"start must be a Unix time in seconds, got {begin}")
        require(0.0 <= begin < LATEST_S, unix)
        require(length > 0.0, Problem("not-positive", f"duration_s must be positive, got {length}"))
        ticking = Problem("not-positive", f"dt_s must be positive and finite, got {self.dt_s}")
        require(0.0 < self.dt_s < np.inf, ticking)
        substep = Problem("not-positive", f"substep_s must be positive, got {step}")
        require(step is None or step > 0.0, substep)


@dataclass(frozen=True, slots=True)
class SimulatedReading:
    """One reading on its way to a service; net import positive."""

    meter: str  # id of the meter; BUSBAR (the empty string) for the busbar meter
    t: float  # time by the meter's clock, Unix s
    # Number of the reading; rises by one with every tick, also without an arrival. None in external
    # recordings without numbers.
    seq: int | None
    arrival: float  # arrival time, Unix s
    v_volt: float  # voltage, phase to neutral, V; for several phases their mean
    # Net import, kW and kvar; None where not reported.
    p_kw: float | None
    q_kvar: float | None
    v_phases: tuple[float, ...] | None = None  # busbar voltage of each phase, V; None on a balanced feeder
    t_power: float | None = None  # time of the powers by the meter's clock, Unix s; None for `t`


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTick:
    """One tick: the truth, and the reports. N customers, m inverters, p meters, b + 1 buses."""

    t: float  # Unix time, s
    seq: int  # number of the tick, from 0
    meter_ids: tuple[str, ...]  # (p,): ids of the meters
    v_volt: Floats  # (N,): true voltage at each customer, V
    # (b + 1,): true voltage of each bus, the busbar first, V; in three phases (3 (b + 1),), the phases of a
    # bus side by side, NaN for an absent one.
    v_bus_volt: Floats
    x_kvar: Floats  # (m,): reactive injection of each inverter by its droop curve, kvar, without attacks
    # (N,): true net import of each customer, inverter included, kW and kvar.
    p_kw: Floats
    q_kvar: Floats
    manipulated: Bools  # (p,): mask of the meters under attack
    shift_volt: Floats  # (p,): reported minus honest reading, V; 0 for honest meters
    reported: Registers  # reports of the meters, manipulations included, as one row, with or without arrival
    delivery: Delivery  # arrival times, as one row

    @property
    def readings(self) -> list[SimulatedReading]:
        """Arriving readings of this tick, duplicates included, in the order of their arrival."""
        out = [
            self._reading(j, meter, float(arrival))
            for j, meter in enumerate((*self.meter_ids, BUSBAR))
            for arrival in (self.delivery.arrival[0, j], self.delivery.copy[0, j])
            if np.isfinite(arrival)
        ]
        return sorted(out, key=lambda reading: reading.arrival)

    def _reading(self, j: int, meter: str, arrival: float) -> SimulatedReading:
        stamp, registers = float(self.delivery.stamp[0, j]), self.reported
        if meter == BUSBAR:
            v0 = registers.v0_volt[0]
            phases = tuple(v0.tolist()) if np.ndim(v0) else None
            return SimulatedReading(meter, stamp, self.seq, arrival, float(np.mean(v0)), None, None, phases)
        q = float(registers.q_kvar[0, j])
        return SimulatedReading(
            meter,
            stamp,
            self.seq,
            arrival,
            float(registers.v_volt[0, j]),
            float(registers.p_kw[0, j]),
            None if np.isnan(q) else q,
        )


def simulate(site: Site, scenario: Scenario) -> Iterator[SimulatedTick]:
    """Simulate a scenario, tick by tick.

    Raises PowerFlowDiverged, NoEquilibrium without a power flow solution, or without a common solution of
        inverters and feeder; ValueError for an attack on, or the silence of, an unknown meter, or an attack
        that uses too old readings.
    """
    check(site, scenario)
    meters = SimulatedMeters(site, scenario.errors, scenario.channel, scenario.seed)
    nominal = site.customer_nominal[site.meters]
    past = _Past(site.meters.size, scenario)
    if past.first < 0:
        for block in truth(site, scenario, past.first, 0):
            past.add(block.ticks, _honest(site, meters, block).v_volt / nominal)
    ticks = float(np.ceil(scenario.duration_s / scenario.dt_s - 1e-9))
    for block in truth(site, scenario, 0, ticks):
        honest = _honest(site, meters, block)
        past.add(block.ticks, honest.v_volt / nominal)
        lies = manipulated(scenario.attacks, block.t, site.meters.size)
        reported = _attacked(site, scenario, block.t, honest, past=past, lies=lies)
        reported = _busbar_attacked(site, scenario, block.t, reported)
        delivery = meters.deliver(block.ticks, block.t)
        yield from _samples(site, block, honest, reported, delivery=delivery, lies=lies)


def _samples(
    site: Site,
    block: PlantTrajectory,
    honest: Registers,
    reported: Registers,
    *,
    delivery: Delivery,
    lies: Bools,
) -> Iterator[SimulatedTick]:
    """Split a block into ticks."""
    shift = reported.v_volt - honest.v_volt
    q_net = net_reactive(site, block)
    x_kvar = block.x * site.feeder.base_kva
    for k in range(block.t.size):
        row = slice(k, k + 1)
        yield SimulatedTick(
            t=float(block.t[k]),
            seq=int(block.ticks[k]),
            meter_ids=site.meter_ids,
            v_volt=block.v_volt[k],
            v_bus_volt=block.v_bus_volt[k],
            x_kvar=x_kvar[k],
            p_kw=block.demand.p_kw[k],
            q_kvar=q_net[k],
            manipulated=lies[k],
            shift_volt=shift[k],
            reported=Registers(
                reported.v_volt[row], reported.p_kw[row], reported.q_kvar[row], reported.v0_volt[row]
            ),
            delivery=Delivery(delivery.stamp[row], delivery.arrival[row], delivery.copy[row]),
        )


def snapshots(samples: Iterable[SimulatedTick]) -> Iterator[Snapshot]:
    """Convert samples to the input of `feeders.model.site.to_frame`: one row of readings per tick.

    Lost readings and silences are missing. Delays and clock errors have no effect.
    """
    for sample in samples:
        there = np.isfinite(sample.delivery.arrival[0])
        meters, registers = there[:-1], sample.reported
        yield Snapshot(
            t=sample.t,
            v_volt=np.where(meters, registers.v_volt[0], np.nan),
            p_kw=np.where(meters, registers.p_kw[0], np.nan),
            q_kvar=np.where(meters, registers.q_kvar[0], np.nan),
            v0_volt=np.where(there[-1], registers.v0_volt[0], np.nan)[()],
        )


def by_arrival(samples: Iterable[SimulatedTick]) -> Iterator[SimulatedReading]:
    """Readings of many ticks in the order of arrival; equal ones in the order of time and meters."""
    waiting: list[tuple[float, int, SimulatedReading]] = []
    number = count()
    for sample in samples:
        # Readings of this tick or a later one arrive no earlier than their own time.
        while waiting and waiting[0][0] < sample.t:
            yield heappop(waiting)[2]
        for reading in sample.readings:
            heappush(waiting, (reading.arrival, next(number), reading))
    while waiting:
        yield heappop(waiting)[2]


class _Past:
    """Honest voltage reports that attacks may still use, pu, in blocks of consecutive ticks.

    `first` is the first tick that any attack uses, 0 or negative. Ticks before 0 are simulated before the
    scenario.
    """

    def __init__(self, meters: int, scenario: Scenario) -> None:
        self._meters = meters
        self._scenario = scenario
        self._blocks: dict[int, Floats] = {}
        self._attacks = [attack for attack in scenario.attacks if reach(attack, attack.t_off) > 0.0]
        self.first = min(self._oldest(scenario.start), 0)

    def add(self, ticks: Ints, honest: Floats) -> None:
        """Add the reports (T, p) of some ticks and remove those that no attack can use any more."""
        if not self._attacks:
            return
        self._blocks[int(ticks[0])] = honest
        oldest = self._oldest(self._scenario.start + float(ticks[0]) * self._scenario.dt_s)
        for start in [start for start, v in self._blocks.items() if start + len(v) <= oldest]:
            del self._blocks[start]

    def __call__(self, t: Floats) -> Floats:
        """Reports at the ticks at or just before times t (T,): (T, p)."""
        wanted = np.array([self._tick(float(when)) for when in t], dtype=np.intp)
        out = np.full((t.size, self._meters), np.nan)
        for start, v in self._blocks.items():
            rows = (wanted >= start) & (wanted < start + len(v))
            out[rows] = v[wanted[rows] - start]
        return out

    def _oldest(self, now: float) -> int:
        """Oldest tick that an attack can use from time `now` on."""
        looks = []
        for attack in self._attacks:
            if attack.t_off > now:
                then = max(now, attack.t_on)
                looks.append(self._tick(then - reach(attack, then)))
        return min(looks, default=self._tick(now))

    def _tick(self, t: float) -> int:
        # Half a microsecond of slack: t - delay is rarely a representable multiple of dt.
        return int(np.floor((t - self._scenario.start + 5e-7) / self._scenario.dt_s))


def _honest(site: Site, meters: SimulatedMeters, block: PlantTrajectory) -> Registers:
    return meters.read(
        block.ticks, block.v_volt, block.shown_kw, net_reactive(site, block), block.demand.v0_volt
    )


def _attacked(
    site: Site, scenario: Scenario, t: Floats, honest: Registers, *, past: _Past, lies: Bools
) -> Registers:
    """Reported values; honest meters keep their registers to the last bit."""
    if not lies.any():
        return honest
    nominal = site.customer_nominal[site.meters]
    before = Reports(honest.v_volt / nominal, honest.p_kw, honest.q_kvar)
    after = apply_all(scenario.attacks, t, before, past)
    v = np.where(lies, after.v * nominal, honest.v_volt)
    return Registers(v, after.p, after.q, honest.v0_volt)


def _busbar_attacked(site: Site, scenario: Scenario, t: Floats, reported: Registers) -> Registers:
    """Reported values with attacks on the busbar meter."""
    nominal = site.nominal_volt[site.feeder.busbar_places()]
    lies = manipulated(scenario.busbar_attacks, t, nominal.size)
    if not lies.any():
        return reported
    honest = reported.v0_volt.reshape(lies.shape)
    none = np.zeros_like(honest)
    after = apply_all(scenario.busbar_attacks, t, Reports(honest / nominal, none, none), lambda _: none)
    v0_volt = np.where(lies, after.v * nominal, honest).reshape(reported.v0_volt.shape)
    return replace(reported, v0_volt=v0_volt)


def check(site: Site, scenario: Scenario) -> None:
    """Check the attacks of a scenario against the feeder; ValueError with all problems."""
    name, phases = site.feeder.name, site.feeder.busbar_places().stop
    problems = [
        Problem("unknown-index", f"an attack names {what} {index}, but {name} has {count}")
        for what, index, count in (
            *(("inverter", each.inverters.max(), site.droop.tau.size) for each in scenario.inverter_attacks),
            *(("meter", each.meters.max(), site.meters.size) for each in scenario.attacks),
        )
        if index >= count
    ]
    if any(
        attack.meters.max() >= phases or reach(attack, attack.t_off) > 0.0
        for attack in scenario.busbar_attacks
    ):
        problems.append(
            Problem(
                "unknown-index",
                f"an attack on the busbar meter uses earlier readings, or phases that {name} does not have",
            )
        )
    for attack in scenario.attacks:
        then = max(attack.t_on, scenario.start)
        back = reach(attack, then)
        if attack.t_off > then and back > LONGEST_LOOK_BACK_S:
            problems.append(
                Problem(
                    "out-of-range",
                    f"an attack uses readings {back:.0f} s old, more than the simulation supports",
                )
            )
    problems += [
        Problem(
            "out-of-range",
            f"an attack begins {each.t_on - scenario.start:g} s after the start, when the scenario of "
            f"{scenario.duration_s:g} s is over",
        )
        for each in (*scenario.attacks, *scenario.busbar_attacks, *scenario.inverter_attacks)
        if each.t_on >= scenario.start + scenario.duration_s
    ]
    raise_if_any(problems)
