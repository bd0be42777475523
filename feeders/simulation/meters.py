"""Meters with the errors of data sheets, and the channel of their readings.

An honest voltage reading is ``round(v (1 + c) + n)``: a fixed bias c inside the accuracy class, drawn once
per meter, white jitter n, and the step of the register. Powers have a fixed gain error. The channel loses,
delays and duplicates readings, and clocks have offsets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.simulation.demand import Stream, generator
from gridsec.arrays import Floats, Ints
from gridsec.errors import InputInvalid, Problem, raise_if_any
from gridsec.grid.network import InPhases

if TYPE_CHECKING:
    from feeders.model.site import Site

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
