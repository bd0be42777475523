"""Virtual meters: readings of a scenario onto zenoh, at any speed, or in step with the service."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count

import msgspec

from feeders.model.site import Site
from feeders.simulation.plant import BUSBAR
from feeders.simulation.scenario import Scenario, SimulatedReading, SimulatedTick, simulate
from service.ingest.zenoh_bus import MeterClient

# A service on a busy machine may pause for seconds.
WAIT_S = 20.0
_POLL_S = 0.0005


@dataclass(frozen=True, slots=True)
class Pace:
    """Speed of virtual time."""

    speed: float = 1.0  # virtual seconds per second; 1 is real time, infinity without limit
    # In step with the service: largest lead over its published estimates, ticks (the feeder's ticks, or the
    # intervals of readings if longer). None: not in step.
    ahead: int | None = None


class OutOfStep(Exception):
    """The service has published no estimate within `WAIT_S`."""


def key_of(feeder: str, meter: str) -> str:
    """Return the zenoh key of a meter's readings, without the prefix."""
    source = "substation" if meter == BUSBAR else f"meter/{meter}"
    return f"{feeder}/{source}/reading"


def payload_of(reading: SimulatedReading) -> bytes:
    """Return a reading as transmitted JSON."""
    fields = {
        "t": reading.t,
        "seq": reading.seq,
        "v_volt": reading.v_volt,
        "p_kw": reading.p_kw,
        "q_kvar": reading.q_kvar,
        "v_phases": reading.v_phases,
        "t_power": reading.t_power,
    }
    return msgspec.json.encode({name: value for name, value in fields.items() if value is not None})


def play(
    site: Site,
    scenario: Scenario,
    meters: MeterClient,
    pace: Pace,
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[SimulatedTick]:
    """Publish a scenario's readings, tick by tick, each at its time.

    Yields each tick after its readings have been published. Raises OutOfStep if the service does not keep up.
    Raises BusUnavailable if zenoh is closed.
    """
    name = site.feeder.name
    steps = _Steps(meters, site, pace.ahead, scenario.dt_s) if pace.ahead is not None else None
    begin = clock()
    waiting: list[tuple[float, int, SimulatedReading]] = []
    number = count()

    def send_until(t: float) -> None:
        while waiting and waiting[0][0] < t:
            arrival, _, reading = heappop(waiting)
            wait = begin + (arrival - scenario.start) / pace.speed - clock()
            if wait > 0.0:
                sleep(wait)
            meters.put(key_of(name, reading.meter), payload_of(reading))

    for sample in simulate(site, scenario):
        for reading in sample.readings:
            heappush(waiting, (reading.arrival, next(number), reading))
        send_until(sample.t + scenario.dt_s)
        if steps is not None:
            steps.wait(sample.t, clock, sleep)
        yield sample
    send_until(math.inf)


class _Steps:
    """Keeps a simulation in step with the published estimates of a feeder.

    Readings every d seconds, the last of them at t, let the service publish the latest tick that is not after
    t; of ticks every s seconds that is one of less than s ago. The wait until t minus the published time is
    less than a max(d, s) therefore always ends, for any d, s, start, and a >= 1.
    """

    def __init__(self, meters: MeterClient, site: Site, ahead: int, dt_s: float) -> None:
        tick_s = site.tables.meta.monitor.tick_s
        self._meters = meters
        # Sums of many steps are not exact: a thousandth of a step is the tolerance.
        self._ahead_s = ahead * max(dt_s, tick_s) - 1e-3 * min(dt_s, tick_s)
        self._reached: float | None = None
        self._first: float | None = None
        meters.watch(site.feeder.name)

    def wait(self, t: float, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """Wait until the estimates are near t."""
        if self._first is None:
            self._first = t
        give_up = clock() + WAIT_S
        while True:
            for payload in self._meters.estimates():
                self._reached = float(msgspec.json.decode(payload)["t"])
            reached = self._first if self._reached is None else self._reached
            if t - reached < self._ahead_s:
                return
            if clock() > give_up:
                raise OutOfStep(f"no estimate for t = {t - self._ahead_s:.0f} within {WAIT_S:g} s")
            sleep(_POLL_S)
