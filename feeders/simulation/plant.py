"""Simulated plant, tick by tick: AC power flow and droop inverters in closed loop, and meters.

    tau_i dx_i/dt = -x_i + K_i(v_i),   v from AC power flow with the injections x

The reactive set-point is taken as linear in time over a step of length h, which gives the implicit
exponential trapezoid

    x+ = e^(-h/tau) x + (1 - e^(-h/tau) - c) K(v) + c K(v+),   c = 1 - (1 - e^(-h/tau)) tau / h.

It is of second order for h << tau and approaches the quasi-static solution x+ = K(v+) for h >> tau, without a
stability limit of h. A step and an equilibrium are the same problem, x = a + c K(v(x)), the latter with a = 0
and c = 1. `ClosedLoop.settle` solves it by plain iteration while that contracts, and otherwise by Newton's
method with the feeder's measured sensitivities.

An honest voltage reading is ``round(v (1 + c) + n)``: a fixed bias c inside the accuracy class, drawn once
per meter, white jitter n, and the step of the register. Powers have a fixed gain error. The channel loses,
delays and duplicates readings, and clocks have offsets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.simulation.demand import Customers, Demand, Stream, generator
from feeders.simulation.powerflow import PlacesFlow, PowerFlow, PowerFlowDiverged, power_flow
from gridsec.arrays import Floats, Ints
from gridsec.attack import InverterAttack
from gridsec.errors import GridsecError, InputInvalid, Problem, raise_if_any
from gridsec.grid.devices import Droop
from gridsec.grid.phased import InPhases

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.simulation.scenario import Scenario


TOLERANCE_PU: Final = 1e-7
"""Tolerance of the solution x, pu of the base power: 0.01 var of 100 kVA."""

MAX_ITERATIONS: Final = 200

CONTRACTS: Final = 0.3
"""Largest ratio of successive residuals with which plain iteration continues."""

SMALLEST_SHARE: Final = 2.0**-7
"""Smallest share of a Newton step."""

PROBE_PU: Final = 1e-3
"""Reactive power of the probes for the sensitivities, pu of the base power."""


class NoEquilibrium(GridsecError):
    """No common solution of the inverters and the feeder was found."""

    code = "not-converged"


@dataclass(frozen=True, slots=True, eq=False)
class Loads:
    """Powers of the customers without their inverters' reactive power. N customers."""

    p_kw: Floats  # (N,): net active import, kW
    q_kvar: Floats  # (N,): reactive import, kvar
    v0_volt: Floats | float  # busbar voltage, V; in three phases (3,)


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """State of the feeder at one instant. N customers, b + 1 buses, m inverters."""

    x: Floats  # (m,): reactive injection of each inverter, pu
    setpoint: Floats  # (m,): set-point of each inverter at this voltage, K(v), pu
    v_volt: Floats  # (N,): voltage at each customer, V
    v_bus_volt: Floats  # (b + 1,): voltage at each bus, V


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A point, its defect in x = kept + new K(v), and the largest absolute entry of the defect, pu."""

    point: Point
    defect: Floats
    size: float


class ClosedLoop:
    """A feeder with its droop inverters; their curves are piecewise linear functions of the voltage.

    `base_kva` and `base_volt` are the base values of `droop`; the voltage is one number, or that of each
    customer, (N,).
    """

    def __init__(
        self, flow: PowerFlow | PlacesFlow, droop: Droop, base_kva: float, base_volt: Floats | float
    ) -> None:
        self.flow = flow
        self.tau = droop.tau
        self.count = droop.tau.size
        self._base_kva = base_kva
        self._base_volt = np.broadcast_to(base_volt, flow.grid.customer_bus.shape)[droop.customer]
        self._customer = droop.customer
        self._owner = np.eye(flow.grid.customer_bus.size)[droop.customer]
        # One ramp between each pair of neighbouring breakpoints, (m, 3).
        self._low, self._high = droop.v[:, :-1], droop.v[:, 1:]
        self._start = droop.q[:, 0]
        width = self._high - self._low
        self._ramp = np.divide(np.diff(droop.q, axis=1), width, out=np.zeros_like(width), where=width > 0.0)
        self._sensitivity: Floats | None = None

    def reactive(self, q_kvar: Floats, x: Floats) -> Floats:
        """Net reactive import (…, N), kvar: the loads' q (…, N) less the inverters' injections x (…, m)."""
        return q_kvar - self._base_kva * (x @ self._owner)

    def setpoint(self, v_volt: Floats) -> Floats:
        """K(v) of every inverter (…, m), pu, from the customers' voltages (…, N), V."""
        v = (v_volt[..., self._customer] / self._base_volt)[..., None]
        climbed: Floats = ((np.clip(v, self._low, self._high) - self._low) * self._ramp).sum(axis=-1)
        return self._start + climbed

    def point(self, loads: Loads, x: Floats) -> Point:
        """Point with given injections x, pu, independent of the droop curves."""
        v_volt, v_bus_volt = self.flow.solve(loads.p_kw, self.reactive(loads.q_kvar, x), loads.v0_volt)
        return Point(x, self.setpoint(v_volt), v_volt, v_bus_volt)

    def held(self, demand: Demand, rows: slice, x: Floats) -> tuple[Floats, Floats, Floats]:
        """Voltages (T, N), (T, b + 1), V, and set-points (T, m), pu, for injections x (T, m), pu."""
        q = self.reactive(demand.q_kvar[rows], x)
        v_volt, v_bus_volt = self.flow.solve_batch(demand.p_kw[rows], q, demand.v0_volt[rows])
        return v_volt, v_bus_volt, self.setpoint(v_volt)

    def equilibrium(self, loads: Loads, start: Floats | None = None) -> Point:
        """Equilibrium of inverters and feeder, x = K(v(x)); the iteration begins at `start` (m,) or zero."""
        zero, one = np.zeros(self.count), np.ones(self.count)
        return self.settle(loads, zero, one, zero if start is None else start)

    def advance(self, loads: Loads, now: Point, before: Point | None, h: float) -> Point:
        """Point h > 0 seconds after `now`, with the loads at the end of the step.

        The point one equal step earlier, `before`, only improves the first guess.
        """
        decay, old, new = self.weights(h)
        kept = decay * now.x + old * now.setpoint
        ahead = now.setpoint if before is None else 2.0 * now.setpoint - before.setpoint
        return self.settle(loads, kept, new, kept + new * ahead)

    def weights(self, h: float) -> tuple[Floats, Floats, Floats]:
        """Weights of x, K(v) and K(v+) in a step of h seconds; each (m,), sum 1."""
        decay = np.exp(-h / self.tau)
        new = 1.0 + np.expm1(-h / self.tau) * self.tau / h
        return decay, 1.0 - decay - new, new

    def settle(self, loads: Loads, kept: Floats, new: Floats, guess: Floats) -> Point:
        """Solve x = kept + new K(v(x)) from a first guess; kept and guess (m,) in pu, new (m,) from 0 to 1.

        Raises NoEquilibrium without a solution within TOLERANCE_PU after MAX_ITERATIONS solves;
            PowerFlowDiverged without a power flow solution for these loads.
        """
        here = self._trial(loads, kept, new, guess)
        for _ in range(MAX_ITERATIONS):
            if here.size <= TOLERANCE_PU:
                return here.point
            there = self._attempt(loads, kept, new, here.point.x + here.defect)
            if there is None or there.size > CONTRACTS * here.size:
                there = self._newton(loads, kept, new, here)
            here = there
        raise NoEquilibrium(
            f"inverters and feeder do not settle: {here.size:.2g} pu of reactive power remain"
        )

    def _trial(self, loads: Loads, kept: Floats, new: Floats, x: Floats) -> _Trial:
        point = self.point(loads, x)
        defect = kept + new * point.setpoint - x
        return _Trial(point, defect, float(np.max(np.abs(defect), initial=0.0)))

    def _attempt(self, loads: Loads, kept: Floats, new: Floats, x: Floats) -> _Trial | None:
        """Trial with possible overshoot: None without a power flow solution."""
        try:
            return self._trial(loads, kept, new, x)
        except PowerFlowDiverged:
            return None

    def _newton(self, loads: Loads, kept: Floats, new: Floats, here: _Trial) -> _Trial:
        """One damped Newton step of `settle`; the curves' slopes are those at the present voltages."""
        if self._sensitivity is None:
            self._sensitivity = self._measure(loads, here.point)
        slope = new * self._slope(here.point.v_volt)
        step = np.linalg.solve(np.eye(self.count) - slope[:, None] * self._sensitivity, here.defect)
        share = 1.0
        while share > SMALLEST_SHARE:
            there = self._attempt(loads, kept, new, here.point.x + share * step)
            if there is not None and there.size < (1.0 - 0.1 * share) * here.size:
                return there
            share *= 0.5
        # Move even if no share reduces the residual, to leave a kink of the curves.
        return self._trial(loads, kept, new, here.point.x + share * step)

    def _slope(self, v_volt: Floats) -> Floats:
        """dK/dv of every inverter, 1, <= 0."""
        v = (v_volt[self._customer] / self._base_volt)[:, None]
        slope: Floats = np.where((v >= self._low) & (v < self._high), self._ramp, 0.0).sum(axis=1)
        return slope

    def _measure(self, loads: Loads, here: Point) -> Floats:
        """dv/dx between all inverters by AC power flow, 1, (m, m)."""
        probes = here.x + PROBE_PU * np.eye(self.count)
        q = self.reactive(loads.q_kvar, probes)
        p = np.broadcast_to(loads.p_kw, q.shape)
        v, _ = self.flow.solve_batch(p, q, np.repeat(np.asarray(loads.v0_volt)[None], self.count, axis=0))
        change = (v - here.v_volt)[:, self._customer]
        return (change / (PROBE_PU * self._base_volt)).T


BLOCK_TICKS: Final = 256

SUBSTEPS_PER_TAU: Final = 2.0
"""Substeps per smallest time constant; docs/simulation.md states the remaining error."""

SHORTEST_STRETCH: Final = 8
LONGEST_STRETCH: Final = 64
"""Limits of the number of steps that are solved together."""

MAX_SWEEPS: Final = 12
"""Largest number of sweeps over a stretch."""

VANISHED_PU: Final = 1e-30
"""Smaller values are set to zero; otherwise they become denormal, and arithmetic slow."""

QUASI_STATIC_TAUS: Final = 10.0
"""Tick length, in the largest time constant, from which on a tick is one quasi-static step."""


@dataclass(frozen=True, slots=True, eq=False)
class PlantTrajectory:
    """True state at T consecutive ticks. N customers, m inverters, b + 1 buses."""

    ticks: Ints  # (T,): numbers of the ticks
    t: Floats  # (T,): times of the ticks, Unix s
    v_volt: Floats  # (T, N): voltage at each customer, V
    v_bus_volt: Floats  # (T, b + 1): voltage of each bus, V; in three phases of each phase of each bus
    x: Floats  # (T, m): reactive injection of each inverter by its droop curve, pu
    demand: Demand  # powers without the inverters' reactive power, and the busbar voltage
    shown_kw: Floats  # (T, N): active power without hidden powers: the basis of the readings


def truth(site: Site, scenario: Scenario, first: int, end: float) -> Iterator[PlantTrajectory]:
    """True state from tick `first` up to tick `end`, which may be infinite; begins in equilibrium."""
    customers = Customers.of(site, scenario)
    loop = ClosedLoop(power_flow(site), site.droop, site.feeder.base_kva, site.customer_volt)
    steps = substeps(site, scenario)
    course = _Course(loop, scenario.dt_s / steps)
    begin = first
    while begin < end:
        ticks = np.arange(begin, min(begin + BLOCK_TICKS, end), dtype=np.intp)
        t = scenario.start + ticks.astype(np.float64) * scenario.dt_s
        back = scenario.dt_s * np.arange(steps - 1, -1, -1) / steps
        # The course begins at the very first tick, without substeps before it.
        skip = steps - 1 if begin == first else 0
        moments = (t[:, None] - back).ravel()[skip:]
        told = customers.at(moments)
        p, q = customers.hidden(moments)
        q = q - site.feeder.base_kva * injected(site, scenario.inverter_attacks, moments)
        fine = Demand(told.p_kw + p, told.q_kvar + q, told.v0_volt)
        v_volt, v_bus_volt, x = course.run(fine)
        at = slice(steps - 1 - skip, None, steps)
        demand = Demand(fine.p_kw[at], fine.q_kvar[at], fine.v0_volt[at])
        yield PlantTrajectory(ticks, t, v_volt[at], v_bus_volt[at], x[at], demand, told.p_kw[at])
        begin += ticks.size


def injected(site: Site, attacks: tuple[InverterAttack, ...], t: Floats) -> Floats | float:
    """Injections of attacked inverters beyond their droop curves at times t (T,), pu per customer, (T, N)."""
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
    """Closed loop in equal steps of h seconds, from equilibrium on.

    Many power flows at once take little longer than one. So all steps of a stretch are solved together from a
    first guess. The inverters' course follows from the voltages, until it no longer changes. Where that
    converges slowly, the same equations are solved step by step.
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
        """Advance one step per row: voltages (T, N) and (T, b + 1), V, and injections x (T, m), pu."""
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
        """Solve a stretch of steps together; None if it requires single steps."""
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
            self._single = BLOCK_TICKS  # slow convergence: skip the attempt for BLOCK_TICKS steps
        return None

    def _follow(self, now: Point, setpoint: Floats) -> Floats:
        """Course x (T, m) of the inverters from `now` on, for given set-points (T, m)."""
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
    """Number of integration steps per tick, at least 1."""
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


def net_reactive(site: Site, block: PlantTrajectory) -> Floats:
    """Net reactive import of every customer, inverter included, kvar, (T, N)."""
    owner = np.eye(len(site.tables.customers))[site.droop.customer]
    return block.demand.q_kvar - site.feeder.base_kva * (block.x @ owner)


# --- Meters and the channel of their readings ---


BUSBAR: Final = ""
"""Meter id of the busbar meter; ids of customers' meters have at least one character."""

NOISE_TICKS: Final = 256
"""Ticks per draw of random numbers."""

EARLIEST_TICK: Final = 2**40
"""Ticks from minus this number on have random numbers of their own."""


@dataclass(frozen=True, slots=True)
class MeterErrors:
    """Errors of the simulated meters relative to those of the feeder's files; 0: none."""

    bias: float = 1.0  # limit of the fixed biases relative to the class, 1; uniform
    jitter: float = 1.0  # factor on the jitter, 1
    resolution: float = 1.0  # factor on the registers' steps, 1
    power: float = 1.0  # limit of the fixed gain errors of p and q relative to the stated error, 1; uniform
    report_q: bool = False  # True: meters report reactive power


@dataclass(frozen=True, slots=True)
class MeterOutage:
    """Silence of a meter for t_on <= t < t_off."""

    meter: str  # id of the meter; BUSBAR for the busbar's
    # Unix time, s.
    t_on: float
    t_off: float


@dataclass(frozen=True, slots=True)
class Channel:
    """Loss, delay and duplication of readings, clock offsets and silences; ValueError for invalid numbers."""

    loss: float = 0.0  # probability of the loss of a reading, 1
    delay_s: float = 0.0  # shortest delay, s
    delay_mean_s: float = 0.0  # mean of the exponentially distributed delay on top of it, s
    # Probability (1) of an additional delay `late_s`; more than a tick reorders readings.
    late: float = 0.0
    late_s: float = 0.0
    duplicate: float = 0.0  # probability of a second arrival of a reading, 1; the copy has a delay of its own
    clock_s: float = 0.0  # limit of the constant clock offset of each meter, s; uniform
    # Intervals without readings of a meter; its sequence numbers count on.
    silences: tuple[MeterOutage, ...] = ()

    def __post_init__(self) -> None:
        chances = {name: getattr(self, name) for name in ("loss", "late", "duplicate")}
        times = {name: getattr(self, name) for name in ("delay_s", "delay_mean_s", "late_s", "clock_s")}
        raise_if_any(
            [
                Problem("out-of-range", f"{name} is a probability, got {value}")
                for name, value in chances.items()
                if not 0.0 <= value <= 1.0
            ]
            + [
                Problem("negative", f"{name} must be finite and not negative, got {value}")
                for name, value in times.items()
                if not 0.0 <= value < np.inf
            ]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Registers:
    """Readings of the meters at T ticks, before any manipulation. p meters."""

    v_volt: Floats  # (T, p): voltage, V
    # (T, p): net import, kW and kvar; q is NaN unless reported.
    p_kw: Floats
    q_kvar: Floats
    v0_volt: Floats  # (T,) or (T, 3): busbar voltage, V; in three phases that of each


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """Arrival times of readings. p meters and, as the last column, the busbar meter."""

    stamp: Floats  # (T, p + 1): time by the meter's clock, Unix s
    arrival: Floats  # (T, p + 1): Unix time, s; infinite for a lost reading
    copy: Floats  # (T, p + 1): arrival of a duplicate; infinite without one


class SimulatedMeters:
    """All meters of a feeder and their channel; ValueError for the silence of an unknown meter.

    Random numbers of a tick depend on the seed and its number alone.

    bias (p,): fixed relative bias of each voltage register, 1.
    busbar_bias: the same for the busbar meter; in three phases (3,).
    p_gain, q_gain (p,): fixed relative errors of the power registers, 1: the true power is the reading times
        1 + gain. Data sheets state the error as a fraction of the reading.
    """

    def __init__(self, site: Site, errors: MeterErrors, channel: Channel, seed: int) -> None:
        accuracy, customer = site.accuracy, site.meters
        self.count = customer.size
        self._busbars = 3 if isinstance(site.feeder, InPhases) else 1
        self._channel = channel
        self._errors = errors
        self._seed = seed
        self._customer = customer
        self._ids = (*site.meter_ids, BUSBAR)
        unknown = {silence.meter for silence in channel.silences} - set(self._ids)
        if unknown:
            raise InputInvalid(
                [Problem("unknown-name", f"silences of unknown meters: {', '.join(sorted(unknown))}")]
            )

        random = generator(seed, Stream.METER)
        draw = random.uniform(-1.0, 1.0, (3, self.count))
        self.bias = errors.bias * accuracy.class_fraction * draw[0]
        self.p_gain = errors.power * site.loads.p_fraction[customer] * draw[1]
        self.q_gain = errors.power * site.loads.q_fraction[customer] * draw[2]
        self.busbar_bias = errors.bias * accuracy.busbar_class * random.uniform(-1.0, 1.0, self._busbars)
        self._clock = channel.clock_s * random.uniform(-1.0, 1.0, self.count + 1)

        def registers(customers: Floats, busbar: float) -> Floats:
            """Values of all voltage registers, those of the busbar meter last."""
            return np.append(customers, [busbar] * self._busbars)

        base = registers(site.customer_volt[customer], site.tables.meta.voltage_volt)
        self._jitter = errors.jitter * base * registers(accuracy.jitter, accuracy.busbar_jitter)
        self._step = errors.resolution * base * registers(accuracy.resolution, accuracy.busbar_resolution)
        self._p_step = errors.resolution * site.tables.meta.meters.p_resolution_kw

    def read(self, ticks: Ints, v_volt: Floats, p_kw: Floats, q_kvar: Floats, v0_volt: Floats) -> Registers:
        """Read all registers at consecutive ticks (T,), from true values in V, kW and kvar (net imports).

        True values are (T, N) of the customers, and (T,) or (T, 3) of the busbar.
        """
        true = np.column_stack(
            [
                v_volt[:, self._customer] * (1.0 + self.bias),
                v0_volt.reshape(-1, self._busbars) * (1.0 + self.busbar_bias),
            ]
        )
        normal = self._draws(Stream.JITTER, ticks, self.count + self._busbars)
        shown = _round(true + self._jitter * normal, self._step)
        p = _round(p_kw[:, self._customer] / (1.0 + self.p_gain), np.full(self.count, self._p_step))
        if self._errors.report_q:
            q = _round(q_kvar[:, self._customer] / (1.0 + self.q_gain), np.full(self.count, self._p_step))
        else:
            q = np.full(p.shape, np.nan)
        return Registers(shown[:, : self.count], p, q, shown[:, self.count :].reshape(v0_volt.shape))

    def deliver(self, ticks: Ints, t: Floats) -> Delivery:
        """Arrival times of the readings of consecutive ticks (T,) at times t (T,), Unix s."""
        channel, width = self._channel, self.count + 1
        uniform = self._draws(Stream.CHANNEL, ticks, 5 * width).reshape(ticks.size, 5, width)
        lost = uniform[:, 0] < channel.loss
        for silence in channel.silences:
            lost[(t >= silence.t_on) & (t < silence.t_off), self._ids.index(silence.meter)] = True
        late = np.where(uniform[:, 1] < channel.late, channel.late_s, 0.0)
        waits = -channel.delay_mean_s * np.log1p(-uniform[:, 2:4])  # exponential
        arrival = t[:, None] + channel.delay_s + late + waits[:, 0]
        copy = arrival + waits[:, 1]
        return Delivery(
            stamp=t[:, None] + self._clock,
            arrival=np.where(lost, np.inf, arrival),
            copy=np.where(lost | (uniform[:, 4] >= channel.duplicate), np.inf, copy),
        )

    def _draws(self, stream: Stream, ticks: Ints, width: int) -> Floats:
        """Random numbers of each tick: normal for JITTER, uniform on [0, 1) otherwise."""
        block, row = np.divmod(ticks + EARLIEST_TICK, NOISE_TICKS)
        out = np.empty((ticks.size, width))
        for number in np.unique(block):
            random = generator(self._seed, stream, int(number))
            shape = (NOISE_TICKS, width)
            draw = random.standard_normal(shape) if stream is Stream.JITTER else random.random(shape)
            out[block == number] = draw[row[block == number]]
        return out


def _round(values: Floats, step: Floats) -> Floats:
    """Round to the nearest multiple of each column's step; a step of 0 leaves values unchanged."""
    rounded = values.copy()
    some = step > 0.0
    # The second rounding removes the last bits: 230.1 instead of 230.10000000000002.
    rounded[:, some] = np.round(np.round(values[:, some] / step[some]) * step[some], 9)
    return rounded
