"""Alignment of readings to the ticks of a feeder, and clock offsets of their sources.

A reading with the stamp t that arrives at the wall time a has the delay ``a - t``: transmission time plus
clock error. The median delay of a source, less that of all sources, is the negative offset of its clock if
transmission times are equal. A longer transmission time looks like a clock that is behind.

Readings of one source that arrive at one instant count once, with the newest stamp: a concentrator sends a
backlog at once, and its age is not an offset.

A tick is a multiple of the feeder's `tick_s`. A meter is available at a tick if its latest reading at or
before it is younger than `max_age_s`; at short ticks a single lost reading has no effect. A tick is emitted
as soon as every source that is not silent has reported for it, and at the latest `grace_s` after it. Later
readings are late: counted, and used for the next tick if still fresh. Silence does not stop the ticks.

The alignment has no clock. `now` is an argument (the wall clock) or follows from the readings
(`Clock.EVENTS`: the latest time that at least half of the sources have reached, so that a few wrong clocks
cannot move it; for replay and for accelerated time). The same readings in the same order, with the same
`now`, give the same ticks, whatever happens in between.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import zip_longest
from statistics import median
from typing import Final

from gridsec.errors import InputInvalid, Problem
from service.ingest.reading import Reading

KEPT: Final = 64
"""Newest arrivals of a source that its median delay uses."""
FEWEST: Final = 16
"""Smallest number of arrivals of a source for a measurable offset."""
SOURCES: Final = 3
"""Smallest number of sources with measurable delays for the median of all sources."""
LEAST_S: Final = 0.5
"""Smallest reported offset, s."""
LEAST_TICKS: Final = 0.1
"""Smallest reported offset, in ticks: readings up to this much after a tick belong to it."""
SURE: Final = 4.0
"""Smallest reported offset in standard errors of the median of a source's delays."""
KEEPS: Final = 0.5
"""Factor on the limits for an offset that is already reported (hysteresis)."""
_NORMAL, _MEDIAN = 1.4826, 1.2533
"""Standard deviation over median absolute deviation, and standard error of a median over that of a mean."""


class ClockOffsets:
    """Delays of the sources of one feeder.

    sources: meters, and None for the busbar meter.
    tick_s: interval of the ticks, s.
    silence_s: time without an arrival after which the delays of a source are deleted, s. The service's clock
        may be set meanwhile: delays of sources that no longer report would shift the median of all.
    """

    def __init__(self, sources: Iterable[str | None], tick_s: float, silence_s: float) -> None:
        self._delays: dict[str | None, deque[float]] = {source: deque(maxlen=KEPT) for source in sources}
        self._arrived: dict[str | None, float] = {}
        self._least = max(LEAST_S, LEAST_TICKS * tick_s)
        self._silence = silence_s
        self._reported: set[str | None] = set()

    def note(self, source: str | None, t: float, arrival: float) -> None:
        """Add the delay of one reading. `source` is the meter, None for the busbar meter; times in Unix s."""
        delays = self._delays[source]
        if self._arrived.get(source) == arrival:
            delays[-1] = min(delays[-1], arrival - t)
            return
        self._arrived[source] = arrival
        delays.append(arrival - t)

    def forget(self) -> None:
        """Delete all delays: the wall clock was set."""
        for delays in self._delays.values():
            delays.clear()
        self._arrived.clear()
        self._reported.clear()

    def measured(self, now: float) -> Mapping[str | None, float]:
        """Return the measurable offsets, s; positive if the clock is ahead.

        Delays of sources that are silent at `now`, Unix s, are deleted.
        """
        for source in [each for each, last in self._arrived.items() if now - last > self._silence]:
            del self._arrived[source]
            self._delays[source].clear()
        middle = {source: median(delays) for source, delays in self._delays.items() if len(delays) >= FEWEST}
        if len(middle) < SOURCES:
            self._reported.clear()
            return {}
        fleet = median(middle.values())
        least = KEEPS * self._least
        found = {
            source: fleet - one
            for source, one in middle.items()
            # `least` is the lower bound of all limits and is cheaper.
            if abs(fleet - one) >= least and abs(fleet - one) >= self._limit(source, one)
        }
        self._reported = set(found)
        return found

    def _limit(self, source: str | None, middle: float) -> float:
        """Smallest reported offset of a source, s."""
        delays = self._delays[source]
        spread = _NORMAL * median(abs(delay - middle) for delay in delays)
        limit = max(self._least, SURE * _MEDIAN * spread / math.sqrt(len(delays)))
        return KEEPS * limit if source in self._reported else limit


HELD_PER_SOURCE = 512
"""Largest number of readings of a source ahead of the ticks; further ones overflow."""

BACKLOG_TICKS = 3600
"""Ticks formed after one step of the time where ticks may wait (`Clock.EVENTS`, replay); older: skipped."""

LEAP_TICKS = 60
"""Ticks formed after one step of the wall clock of a running service, where old ticks are stale."""

BRIDGED_TICK_S = 2.0
"""Largest tick at which the previous reading replaces a lost one, s."""

GAP_MAX = 1_000_000
"""Largest gap of sequence numbers that counts as lost readings; a larger one is a restart of the counter."""

OFFSETS_TICKS = 16
"""Ticks from one measurement of the clock offsets to the next."""

_ACTIVE_ROUNDS = 4


class Clock(StrEnum):
    """Source of the present time."""

    WALL = "wall"
    EVENTS = "events"


class ReadingOutcome(StrEnum):
    """Result of the alignment of a well-formed reading."""

    ACCEPTED = "accepted"
    OUT_OF_ORDER = "out-of-order"
    LATE = "late"
    DUPLICATE = "duplicate"
    OVERFLOW = "overflow"
    CLOCK_OFF = "clock-off"


@dataclass(frozen=True, slots=True)
class AlignRules:
    """Times of the alignment of one feeder."""

    tick_s: float  # interval between ticks, s
    max_age_s: float  # age of a reading at a tick, s, from which it is not usable
    grace_s: float  # longest wait after a tick for sources that have not reported, s
    # A reading up to this much after a tick still belongs to it, s: meters that read at the tick miss it
    # slightly in both directions.
    lead_s: float
    max_skew_s: float  # largest difference of a reading's time from now, s; beyond it the reading is refused
    silence_s: float  # age of the last usable reading, s, beyond which a source is silent
    clock: Clock = Clock.WALL  # source of the present time
    # Ticks formed after one step of the time; older ones are skipped and counted.
    backlog: int = BACKLOG_TICKS
    skips_empty: bool = False  # skip all ticks after such a step if none of them has a usable reading

    def __post_init__(self) -> None:
        times = (self.tick_s, self.max_age_s, self.max_skew_s, self.silence_s)
        if not all(math.isfinite(s) and s > 0.0 for s in times):
            raise InputInvalid([Problem("not-positive", f"times must be finite and positive: {self}")])
        if not all(math.isfinite(s) and s >= 0.0 for s in (self.grace_s, self.lead_s)):
            raise InputInvalid([Problem("negative", f"times must be finite and not negative: {self}")])


def rules(
    tick_s: float,
    silence_s: float,
    *,
    clock: Clock = Clock.WALL,
    max_skew_s: float | None = None,
    grace_s: float | None = None,
    live: bool = False,
) -> AlignRules:
    """Return the rules that follow from a feeder's tick.

    Up to `BRIDGED_TICK_S` a reading serves for two and a half ticks, which bridges single losses. At longer
    ticks it serves for one tick: a voltage of a quarter of an hour ago is not evidence of the present one.

    tick_s, silence_s: as in the feeder's file.
    clock: source of the present time.
    max_skew_s: None: one minute, or two ticks if they are longer.
    grace_s: None: half a tick, at most one minute.
    live: with the wall clock at most `LEAP_TICKS` missed ticks are formed, and none if no reading serves
        them.
    """
    lead_s = min(0.1 * tick_s, 1.0)
    leaps = live and clock is Clock.WALL
    max_age_s = 2.5 * tick_s if tick_s <= BRIDGED_TICK_S else tick_s - lead_s
    return AlignRules(
        tick_s=tick_s,
        max_age_s=max_age_s,
        grace_s=min(0.5 * tick_s, 60.0) if grace_s is None else grace_s,
        lead_s=lead_s,
        max_skew_s=max(60.0, 2.0 * tick_s) if max_skew_s is None else max_skew_s,
        # A source is silent after two ticks without a reading at the earliest; silent sources are not waited
        # for.
        silence_s=max(silence_s, tick_s + max_age_s),
        clock=clock,
        backlog=LEAP_TICKS if leaps else BACKLOG_TICKS,
        skips_empty=leaps,
    )


@dataclass(frozen=True, slots=True)
class Tick:
    """Readings that belong to one tick."""

    t: float  # Unix time, s
    # The usable reading of each meter, in the order of the feeder's meters; None if unavailable.
    readings: tuple[Reading | None, ...]
    busbar: Reading | None  # the usable reading of the busbar meter, or None
    # Silent sources as (meter, seconds since the last usable reading); None is the busbar meter, infinity a
    # source without any usable reading.
    silent: tuple[tuple[str | None, float], ...]
    skipped: int = 0  # number of skipped ticks directly before this one
    # (p,) or (): Lead of each meter's clock, s; None if not measurable, () if none is.
    clock_offset: tuple[float | None, ...] = ()
    busbar_offset: float | None = None  # lead of the busbar meter's clock, s; None if not measurable


@dataclass(slots=True)
class _Source:
    held: list[Reading] = field(default_factory=list)
    last_t: float = -math.inf
    last_heard: float = -math.inf
    last_used: float = -math.inf
    heard: int = 0
    seq: int | None = None


def _time_of(reading: Reading) -> float:
    return reading.t


class Aligner:
    """Alignment of one feeder. Only one task may use it.

    counts: readings by outcome.
    lost: number of lost readings, from gaps of the sequence numbers.
    restarts: number of steps of the clock back by more than `silence_s`; each restarts the ticks.
    meters: ids of the feeder's meters, in order. The busbar meter is added.
    """

    def __init__(self, meters: Iterable[str], rules: AlignRules) -> None:
        self.meters = tuple(meters)
        self.rules = rules
        self.counts: Counter[ReadingOutcome] = Counter()
        self.lost = 0
        self.restarts = 0
        self._skipped = 0
        self._sources: dict[str | None, _Source] = {meter: _Source() for meter in (*self.meters, None)}
        self._waiting: set[str | None] = set()
        self._next: int | None = None
        self._first: int | None = None
        self._resumed = -math.inf
        self._refused: list[Reading] = []
        self._now: float | None = None
        self._latest = -math.inf
        self._arrivals = 0
        self._active: OrderedDict[str | None, float] = OrderedDict()
        self._claims: list[float] = []
        self._clocks = ClockOffsets((*self.meters, None), rules.tick_s, rules.silence_s)
        self._offsets: tuple[float | None, ...] = ()
        self._busbar_offset: float | None = None

    # ---------------------------------------------------------------- in

    def take(self, reading: Reading, now: float) -> tuple[ReadingOutcome, list[Tick]]:
        """Align one reading, and emit the ticks that are due.

        `now` is the wall time of its arrival, Unix s; ignored for `Clock.EVENTS`.

        Returns outcome, ticks: result for the reading; the ticks, in order.
        """
        # A reading that waited in the queue arrived before the present time; the clock was not set back.
        self._latest = max(self._latest, now)
        ticks = list(self._emit_ticks(self._latest))
        source = self._sources[reading.meter]
        if self.rules.clock is Clock.EVENTS:
            self._hear(reading, source)
            ticks.extend(self._emit_ticks(self._latest))
        outcome = self._place(reading, source, self.now(now))
        self.counts[outcome] += 1
        ticks.extend(self._emit_ticks(self._latest))
        return outcome, ticks

    def refused(self) -> tuple[Reading, ...]:
        """Return, once, the readings that were accepted before the time was known and have a wrong clock."""
        refused, self._refused = tuple(self._refused), []
        return refused

    def _place(self, reading: Reading, source: _Source, now: float | None) -> ReadingOutcome:
        t = reading.t
        if now is not None and abs(t - now) > self.rules.max_skew_s:
            return ReadingOutcome.CLOCK_OFF
        index = bisect_left(source.held, t, key=_time_of)
        if index < len(source.held) and source.held[index].t == t:
            return ReadingOutcome.DUPLICATE
        if now is not None and self.rules.clock is Clock.WALL:
            self._clocks.note(reading.meter, t, now)
        self._count_gap(reading, source)
        late = self._next is not None and t <= self._time(self._next - 1) + self.rules.lead_s
        if late and t <= source.last_t:
            return ReadingOutcome.LATE
        if len(source.held) >= HELD_PER_SOURCE:
            self._thin(source)
            if len(source.held) >= HELD_PER_SOURCE:
                return ReadingOutcome.OVERFLOW
            index = bisect_left(source.held, t, key=_time_of)
        source.held.insert(index, reading)
        in_order = t > source.last_t
        source.last_t = max(source.last_t, t)
        # A time stamp in the future does not prove that the meter still reports then.
        source.last_heard = t if now is None or self.rules.clock is Clock.EVENTS else now
        if self._next is not None:
            self._wait_for(reading.meter, source, self._next)
        if late:
            return ReadingOutcome.LATE
        return ReadingOutcome.ACCEPTED if in_order else ReadingOutcome.OUT_OF_ORDER

    def _thin(self, source: _Source) -> None:
        """Keep only the last reading between two ticks: no tick uses the others."""
        numbers = [self._serves(held) for held in source.held]
        pairs = zip(source.held, numbers, [*numbers[1:], None], strict=True)
        source.held = [held for held, number, after in pairs if number != after]

    def _count_gap(self, reading: Reading, source: _Source) -> None:
        # A decreasing number is a restart or a changed order, not a loss. The ring of the subscription drops
        # the oldest samples, which only this gap shows. A reading overtaken by a later one is not evidence of
        # a loss.
        if reading.seq is None or reading.t < source.last_t:
            return
        if source.seq is not None and 0 < (gap := reading.seq - source.seq - 1) <= GAP_MAX:
            self.lost += gap
        source.seq = reading.seq

    # ---------------------------------------------------------------- time

    def now(self, wall: float) -> float | None:
        """Return the present time of the alignment, s; None until the readings determine it.

        `wall` is the wall time, Unix s.
        """
        return wall if self.rules.clock is Clock.WALL else self._now

    def wake(self) -> float | None:
        """Return the latest wall time of the next tick of `due`, s; None if only readings can cause one."""
        if self.rules.clock is Clock.EVENTS or self._next is None:
            return None
        return self._time(self._next) + (self.rules.grace_s if self._waiting else 0.0)

    def _hear(self, reading: Reading, source: _Source) -> None:
        """Update the time from a reading."""
        # The count leaves out clocks far ahead: frequent readings of such a clock must not expire the other
        # sources.
        if self._now is None or reading.t - self._now <= self.rules.max_skew_s:
            self._arrivals += 1
        meter = reading.meter
        if meter in self._active:
            self._claims.pop(bisect_left(self._claims, self._active.pop(meter)))
        source.heard = self._arrivals
        self._active[meter] = reading.t
        insort(self._claims, reading.t)
        window = max(_ACTIVE_ROUNDS * len(self._sources), 64)
        while self._sources[next(iter(self._active))].heard <= self._arrivals - window:
            _, claim = self._active.popitem(last=False)
            self._claims.pop(bisect_left(self._claims, claim))
        if self._now is None and 2 * len(self._active) < len(self._sources) and self._arrivals < window:
            return
        count = len(self._claims)
        reached = self._claims[count - (count + 1) // 2]
        if self._now is None:
            self._now = reached
            self._sweep(reached)
        else:
            self._now = max(self._now, reached)

    def _sweep(self, now: float) -> None:
        """Remove the readings that were accepted before the time was known and do not fit it."""
        for source in self._sources.values():
            wild = [r for r in source.held if abs(r.t - now) > self.rules.max_skew_s]
            if wild:
                self._refused.extend(wild)
                self.counts[ReadingOutcome.ACCEPTED] -= len(wild)
                self.counts[ReadingOutcome.CLOCK_OFF] += len(wild)
                source.held = [r for r in source.held if abs(r.t - now) <= self.rules.max_skew_s]
                source.last_t = source.held[-1].t if source.held else -math.inf

    def _time(self, number: int) -> float:
        return number * self.rules.tick_s

    # ---------------------------------------------------------------- out

    def due(self, wall: float) -> Iterator[Tick]:
        """Emit the ticks that are due, in order.

        All arrivals up to the wall time `wall`, Unix s, are aligned; ignored for `Clock.EVENTS`.
        """
        if self.rules.clock is Clock.WALL and wall < self._latest - self.rules.silence_s:
            # The clock was set back: without a restart there would be no tick until it reaches its previous
            # time.
            self.restarts += 1
            for source in self._sources.values():
                source.held.clear()
                source.last_t = source.last_heard = source.last_used = -math.inf
            self._clocks.forget()
            self._offsets, self._busbar_offset = (), None
            self._latest = wall
            self._begin(wall)
        self._latest = max(self._latest, wall)
        yield from self._emit_ticks(wall)

    def _emit_ticks(self, wall: float) -> Iterator[Tick]:
        now = self.now(wall)
        if now is None:
            return
        if self._next is None:
            self._begin(now)
        first = self._number()
        behind = math.floor(now / self.rules.tick_s) - first
        if behind > self.rules.backlog:
            self._skip(first, self._resume(first + behind))
            # A skipped tick was not formed and is not evidence of silence.
            self._resumed = self._time(self._number())
        while True:
            t = self._time(self._number())
            if now < t or (self._waiting and now < t + self.rules.grace_s):
                return
            tick = self._tick(t)
            self._turn_to(self._number() + 1)
            yield tick

    def flush(self) -> Iterator[Tick]:
        """Emit every tick that the time has reached, without grace: the input has ended."""
        if self._now is None and self._claims:
            self._now = self._claims[len(self._claims) // 2]
            self._sweep(self._now)
        now = self.now(self._latest)
        if now is None or now == -math.inf:
            return
        yield from self.due(now)
        while self._time(self._number()) <= now:
            tick = self._tick(self._time(self._number()))
            self._turn_to(self._number() + 1)
            yield tick

    def _resume(self, now: int) -> int:
        """Number of the first tick to form after a step of the time to tick number `now`."""
        first = now - self.rules.backlog
        newest = [source.held[-1] for source in self._sources.values() if source.held]
        starts = ((max(first, self._serves(reading)), reading.t) for reading in newest)
        serving = any(n < now and self._time(n) - t < self.rules.max_age_s for n, t in starts)
        return first if serving or not self.rules.skips_empty else now

    def _skip(self, first: int, following: int) -> None:
        """Continue with the tick `following`; readings serve as if the skipped ticks had been formed."""
        for source in self._sources.values():
            for reading, later in zip_longest(source.held, source.held[1:]):
                begin = max(first, self._serves(reading))
                end = following if later is None else min(following, self._serves(later))
                if begin < end and self._time(begin) - reading.t < self.rules.max_age_s:
                    source.last_used = max(source.last_used, reading.t)
        self._skipped += following - first
        self._turn_to(following)

    def _serves(self, reading: Reading) -> int:
        """Return the number of the first tick that may use a reading."""
        return math.ceil((reading.t - self.rules.lead_s) / self.rules.tick_s)

    def _begin(self, now: float) -> None:
        self._first = math.ceil(now / self.rules.tick_s)
        self._resumed = -math.inf
        self._skipped = 0
        self._turn_to(self._first)

    def _number(self) -> int:
        if self._next is None:
            raise RuntimeError("no tick before the time is known")
        return self._next

    def _turn_to(self, number: int) -> None:
        self._next = number
        before = self._time(number - 1) + self.rules.lead_s
        self._waiting.clear()
        for meter, source in self._sources.items():
            # The newest reading at or before the last tick may serve the next one; older ones never will.
            done = bisect_left(source.held, math.nextafter(before, math.inf), key=_time_of)
            if done > 1:
                del source.held[: done - 1]
            self._wait_for(meter, source, number)

    def _wait_for(self, meter: str | None, source: _Source, number: int) -> None:
        """Wait for a source at a tick if it is not silent and has not reported for it."""
        reported = source.last_t > self._time(number - 1) + self.rules.lead_s
        # Independent of usability: with long ticks the last source would otherwise be late at every tick, and
        # silent.
        if reported or self._silent_for(source, source.last_t, self._time(number)):
            self._waiting.discard(meter)
        else:
            self._waiting.add(meter)

    def _silent_for(self, source: _Source, last: float, t: float) -> float:
        """Return the duration of a source's silence at t since `last`, s; 0 if it is not silent."""
        if t - self._resumed <= self.rules.silence_s:
            return 0.0
        since = min(last, source.last_heard)
        if since == -math.inf and self._first is not None:
            since = self._time(self._first)
            return math.inf if t - since > self.rules.silence_s else 0.0
        return t - since if t - since > self.rules.silence_s else 0.0

    def _tick(self, t: float) -> Tick:
        seen = {meter: self._usable(source, t) for meter, source in self._sources.items()}
        for meter, reading in seen.items():
            if reading is not None:
                self._sources[meter].last_used = reading.t
        silent = tuple(
            (meter, seconds)
            for meter, source in self._sources.items()
            if (seconds := self._silent_for(source, source.last_used, t)) > 0.0
        )
        skipped, self._skipped = self._skipped, 0
        if self._number() % OFFSETS_TICKS == 0:
            found = self._clocks.measured(t)
            self._busbar_offset = found.get(None)
            offsets = tuple(found.get(meter) for meter in self.meters)
            self._offsets = offsets if any(offsets) else ()
        readings = tuple(seen[meter] for meter in self.meters)
        return Tick(t, readings, seen[None], silent, skipped, self._offsets, self._busbar_offset)

    def _usable(self, source: _Source, t: float) -> Reading | None:
        index = bisect_left(source.held, math.nextafter(t + self.rules.lead_s, math.inf), key=_time_of)
        if index == 0:
            return None
        reading = source.held[index - 1]
        return reading if t - reading.t < self.rules.max_age_s else None
