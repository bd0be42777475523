"""Alignment of readings to the ticks of a feeder.

A tick is a multiple of the feeder's `tick_s`. A meter is available at a tick if its latest reading at or
before it is younger than `max_age_s`; at short ticks a single lost reading has no effect. A tick is emitted
as soon as every source that is not silent has reported for it, and at the latest `grace_s` after it. Later
readings are late: counted, and used for the next tick if still fresh. Silence does not stop the ticks.

The readings of a round are columns (`Readings`). Runs of readings in order, between two ticks, are placed
together, and fastest a scan: one reading of each source. Any other reading is placed alone. The result does
not depend on the way.

The alignment has no clock. `now` is an argument (the wall clock) or follows from the readings
(`Clock.EVENTS`: the latest time that at least half of the sources have reached, so that a few wrong clocks
cannot move it; for replay and for accelerated time). The same readings in the same order, with the same
`now`, give the same ticks, whatever happens in between.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import zip_longest

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices
from gridsec.errors import InputInvalid, Problem
from service.ingest.clock_offsets import ClockOffsets, rank
from service.ingest.reading import COLUMNS, NO_SEQ, V_VOLT, Reading, Readings, T

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


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """Readings that belong to one tick. p meters."""

    t: float  # Unix time, s
    # (5, p + 1): rows as in `Readings.values`: usable reading of each meter, and last of the busbar meter;
    # NaN if unavailable.
    values: Floats
    # Silent sources as (meter, seconds since the last usable reading); None is the busbar meter, infinity a
    # source without any usable reading.
    silent: tuple[tuple[str | None, float], ...]
    skipped: int = 0  # number of skipped ticks directly before this one
    # (p,) or (): Lead of each meter's clock, s; None if not measurable, () if none is.
    clock_offset: tuple[float | None, ...] = ()
    busbar_offset: float | None = None  # lead of the busbar meter's clock, s; None if not measurable
    v_phases: tuple[float, ...] | None = None  # voltages of the busbar's phases, V, as in `Reading`
    # Sources with a measured clock offset, None for the busbar meter; None where the clock measures none.
    clocks_known: frozenset[str | None] | None = None
    passed_over: int = 0  # number of ticks of a shed feeder directly before this one, which stands for them

    @property
    def seen(self) -> Bools:
        """Meters with a usable reading, (p,)."""
        return np.asarray(np.isfinite(self.values[V_VOLT, :-1]))

    @property
    def busbar_volt(self) -> float:
        """Voltage of the busbar meter's usable reading, V; NaN if unavailable."""
        return float(self.values[V_VOLT, -1])


@dataclass(frozen=True, slots=True)
class Placed:
    """Result of the alignment of several readings."""

    counts: Mapping[ReadingOutcome, int]  # readings by outcome
    clock_off: tuple[int, ...]  # positions of those with a wrong clock
    ticks: list[Tick]  # ticks that became due, in order


SLOTS = 4
"""Readings of each source that the table holds at first; it grows to `HELD_PER_SOURCE`."""

SCANS_KEPT = 32
"""Number of orders of sources with kept scans, for each feeder."""

ALONE = 8
"""Readings placed one by one after a shorter run: the fixed cost of a run is that of about as many."""


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
        size = len(self.meters) + 1
        self._index: dict[str | None, int] = {source: k for k, source in enumerate((*self.meters, None))}
        self._each = np.arange(size)
        self._scans: dict[bytes, _Scans] = {}
        # (5, p + 1): newest reading of each source until the end of the last tick; its time is -inf if none.
        self._served = np.full((COLUMNS, size), -np.inf)
        # (slots, 5, p + 1): later readings by time; the time of an empty slot is infinite.
        self._ahead = _empty(SLOTS, size)
        # Number of later readings of each source, and the largest one.
        self._count = np.zeros(size, dtype=np.intp)
        self._most = 0
        self._phases: dict[float, tuple[float, ...]] = {}
        self._last_t, self._last_heard, self._last_used = np.full((3, size), -np.inf)
        self._seq = np.full(size, NO_SEQ, dtype=np.int64)
        self._waiting = np.zeros(size, dtype=np.bool_)
        self._waits = 0
        self._next: int | None = None
        # Time of the next tick, and the end of the last one: readings until then are late, Unix s.
        self._next_t, self._end = math.inf, -math.inf
        self._first: int | None = None
        self._resumed = -math.inf
        self._refused: list[Reading] = []
        self._now: float | None = None
        self._latest = -math.inf
        self._arrivals = 0
        self._heard = [0] * size
        self._active: OrderedDict[int, float] = OrderedDict()
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
        values = (reading.t, reading.v_volt, reading.p_kw, reading.q_kvar, reading.t_power)
        seq = NO_SEQ if reading.seq is None else reading.seq
        return self._take(self._index[reading.meter], values, seq, reading.v_phases, now)

    def take_all(self, readings: Readings) -> Placed:
        """Align readings as `take` does one after the other."""
        size, begin = len(readings), 0
        ticks: list[Tick] = []
        before, refused, clock_off = self.counts.copy(), len(self._refused), list[int]()
        latest = np.maximum(np.maximum.accumulate(readings.arrival), self._latest)
        scans = self._scans_of(readings.source) if self.rules.clock is Clock.WALL else None
        while begin < size:
            end = begin
            if scans is not None:
                self._latest = float(latest[begin])
                ticks.extend(self._emit_ticks(self._latest))
                end = self._place_scan(readings, latest, begin, scans) or self._run(readings, latest, begin)
            if end - begin >= ALONE:
                self._latest = float(latest[end - 1])
                ticks.extend(self._emit_ticks(self._latest))
                begin = end
                continue
            for k in range(begin, min(begin + ALONE, size)):
                outcome, more = self._take(*readings.row(k), float(readings.arrival[k]))
                ticks.extend(more)
                if outcome is ReadingOutcome.CLOCK_OFF:
                    clock_off.append(k)
            begin = min(begin + ALONE, size)
        return Placed(self._counted(before, len(self._refused) - refused), tuple(clock_off), ticks)

    def _counted(self, before: Counter[ReadingOutcome], refused: int) -> dict[ReadingOutcome, int]:
        """Readings by outcome since `before`, each as at its arrival; `refused` were accepted then."""
        corrected = {ReadingOutcome.ACCEPTED: refused, ReadingOutcome.CLOCK_OFF: -refused}
        counts = {one: self.counts[one] - before[one] + corrected.get(one, 0) for one in ReadingOutcome}
        return {outcome: count for outcome, count in counts.items() if count}

    def _take(
        self,
        source: int,
        values: tuple[float, ...],
        seq: int,
        phases: tuple[float, ...] | None,
        now: float,
    ) -> tuple[ReadingOutcome, list[Tick]]:
        # A reading that waited in the queue arrived before the present time; the clock was not set back.
        self._latest = max(self._latest, now)
        ticks = self._emit_ticks(self._latest)
        if self.rules.clock is Clock.EVENTS:
            self._hear(values[T], source)
            ticks.extend(self._emit_ticks(self._latest))
        outcome = self._place(source, values, seq, phases, self.now(now))
        self.counts[outcome] += 1
        ticks.extend(self._emit_ticks(self._latest))
        return outcome, ticks

    def refused(self) -> tuple[Reading, ...]:
        """Return, once, the readings that were accepted before the time was known and have a wrong clock.

        Feeder and sequence number are left out.
        """
        refused, self._refused = tuple(self._refused), []
        return refused

    def _name(self, source: int) -> str | None:
        return self.meters[source] if source < len(self.meters) else None

    def _run(self, readings: Readings, latest: Floats, begin: int) -> int:
        """Place the run of readings from `begin` that are in order and before the next tick; return its end.

        In a run each reading of a source is later than the one before it, or repeats it.

        latest (n,): newest arrival up to each reading, Unix s. Nothing is placed if the run is shorter than
        `ALONE`.
        """
        rules, latest = self.rules, latest[begin:]
        # From the end of the grace, and from where the backlog ends, a tick may come before a reading.
        limit = self._run_end()
        end = max(1, int(latest.searchsorted(limit)))
        source, arrival = readings.source[begin : begin + end], readings.arrival[begin : begin + end]
        t = readings.values[T, begin : begin + end]
        order = source.argsort(kind="stable")
        by_source, by_t = source[order], t[order]
        repeated = by_source[1:] == by_source[:-1]
        before, room = self._last_t[by_source], HELD_PER_SOURCE - self._held()[by_source]
        if repeated.any():
            before[1:][repeated] = by_t[:-1][repeated]
            room -= rank(by_source)
        plain, fresh = np.empty((2, end), dtype=np.bool_)
        fresh[order] = by_t > before
        plain[order] = (by_t >= before) & (room > 0)
        late = t <= self._end
        plain &= np.abs(t - arrival) <= rules.max_skew_s
        if late.any():
            # A late reading of a source that is not waited for may be the end of its silence. An old one of a
            # source without any other may show its silence.
            silent = self._next_t - np.minimum(t, arrival) > rules.silence_s
            plain &= ~(late & fresh & (silent | ~self._waiting[source]))
        if not plain.all():
            end = int(plain.argmin())
        # The tick comes with the reading of the last source that it waits for, once its time is reached.
        reached = int(latest[:end].searchsorted(self._next_t))
        if reached < end:
            last = self._last_waiting(source[:end], fresh[:end] & ~late[:end])
            end = min(end, max(last + 1, reached))
        if end < ALONE:
            return begin
        chosen = order[(order < end) & fresh[order]]
        self.counts[ReadingOutcome.DUPLICATE] += end - chosen.size
        if chosen.size:
            self._place_run(readings, begin + chosen, late[chosen])
        return begin + end

    def _run_end(self) -> float:
        """Time from which a tick may come before a reading: the end of the grace, or of the backlog."""
        rules = self.rules
        return min(self._next_t + rules.grace_s, self._time(self._number() + rules.backlog))

    def _scans_of(self, source: Ints) -> _Scans:
        """Scans of readings; those of a concentrator repeat and are kept."""
        key = source.tobytes()
        found = self._scans.get(key)
        if found is None:
            if len(self._scans) >= SCANS_KEPT:
                self._scans.clear()
            found = self._scans[key] = _Scans(source)
        return found

    def _place_scan(self, readings: Readings, latest: Floats, begin: int, scans: _Scans) -> int:
        """Place the scan from `begin` if it is a run of accepted readings; return its end, otherwise 0.

        latest (n,): as for `_run`.
        """
        (end, at), rules = scans.at(begin, self._count.size), self.rules
        size, last = end - begin, float(latest[end - 1])
        if size < ALONE or last >= self._run_end() or self._most + 2 > HELD_PER_SOURCE:
            return 0
        arrival, values = readings.arrival[begin:end], readings.values[:, begin:end]
        t = values[T]
        if not t.min() > self._end or not np.abs(t - arrival).max() <= rules.max_skew_s:
            return 0
        if not all_of(t > self._last_t[at]):
            return 0
        awaited = int(np.count_nonzero(self._waiting[at]))
        # The tick comes with the last source that it waits for.
        if last >= self._next_t and size != awaited:
            return 0
        source = readings.source[begin:end]
        self._clocks.note_all(source, t, arrival)
        self._count_gaps(source, readings.seq[begin:end])
        if self._most:
            slot = self._count[source]
            self._extend(int(slot.max()) + 1)
            self._ahead[slot, :, source] = values.T
        else:
            self._most = 1
            self._ahead[0, :, at] = values if isinstance(at, slice) else values.T
        self._count[at] += 1
        self._last_t[at] = t
        self._last_heard[at] = arrival
        if readings.v_phases is not None:
            for k in np.flatnonzero(source == len(self.meters)):
                self._keep_phases(float(t[k]), readings.phases_of(begin + int(k)))
        self.counts[ReadingOutcome.ACCEPTED] += size
        self._waiting[at] = False
        self._waits -= awaited
        return end

    def _last_waiting(self, source: Ints, reports: Bools) -> int:
        """Position of the reading after which no source is waited for; the size if some still are.

        reports (n,): readings that count for the next tick.
        """
        if not self._waits:
            return -1
        first = np.full(self._waiting.size, source.size)
        at = np.flatnonzero(reports)[::-1]
        # Of equal indices the last assignment counts.
        first[source[at]] = at
        return int(first[self._waiting].max())

    def _place_run(self, readings: Readings, at: Ints, late: Bools) -> None:
        """Place readings of a run, grouped by source; `late` are those that the last tick has missed."""
        source, arrival, values = readings.source[at], readings.arrival[at], readings.values[:, at]
        slot = self._count[source] + rank(source)
        self._clocks.note_all(source, values[T], arrival)
        self._count_gaps(source, readings.seq[at])
        self._extend(int(slot.max()) + 1)
        self._ahead[slot, :, source] = values.T
        # Of equal indices the last assignment counts.
        self._count[source] = slot + 1
        self._last_t[source] = values[T]
        self._last_heard[source] = arrival
        if readings.v_phases is not None:
            for k in np.flatnonzero(source == len(self.meters)):
                self._keep_phases(float(values[T, k]), readings.phases_of(int(at[k])))
        missed = int(np.count_nonzero(late))
        self.counts[ReadingOutcome.LATE] += missed
        self.counts[ReadingOutcome.ACCEPTED] += source.size - missed
        self._waiting[source[~late] if missed else source] = False
        self._waits = int(np.count_nonzero(self._waiting))

    def _keep_phases(self, t: float, phases: tuple[float, ...] | None) -> None:
        if phases is not None:
            self._phases[t] = phases

    def _place(
        self,
        source: int,
        values: tuple[float, ...],
        seq: int,
        phases: tuple[float, ...] | None,
        now: float | None,
    ) -> ReadingOutcome:
        t, last_t = values[T], float(self._last_t[source])
        if now is not None and abs(t - now) > self.rules.max_skew_s:
            return ReadingOutcome.CLOCK_OFF
        count = int(self._count[source])
        later = self._ahead[:count, T, source]
        index = int(later.searchsorted(t))
        if t == self._served[T, source] or (index < count and later[index] == t):
            return ReadingOutcome.DUPLICATE
        if now is not None and self.rules.clock is Clock.WALL:
            self._clocks.note_all(np.array([source]), np.array([t]), np.array([now]))
        self._count_gap(source, seq, t)
        late = t <= self._end
        if late and t <= last_t:
            return ReadingOutcome.LATE
        if len(self._times(source)) >= HELD_PER_SOURCE:
            self._thin(source)
            if len(self._times(source)) >= HELD_PER_SOURCE:
                return ReadingOutcome.OVERFLOW
            count = int(self._count[source])
            index = int(self._ahead[:count, T, source].searchsorted(t))
        self._extend(count + 1)
        self._ahead[index + 1 : count + 1, :, source] = self._ahead[index:count, :, source]
        self._ahead[index, :, source] = values
        self._count[source] = count + 1
        if source == len(self.meters):
            self._keep_phases(t, phases)
        in_order = t > last_t
        self._last_t[source] = max(last_t, t)
        # A time stamp in the future does not prove that the meter still reports then.
        self._last_heard[source] = t if now is None or self.rules.clock is Clock.EVENTS else now
        if self._next is not None:
            self._wait_for(source)
        if late:
            return ReadingOutcome.LATE
        return ReadingOutcome.ACCEPTED if in_order else ReadingOutcome.OUT_OF_ORDER

    def _extend(self, most: int) -> None:
        """Make room for `most` later readings of a source."""
        self._most = max(self._most, most)
        slots = self._ahead.shape[0]
        if most > slots:
            more = min(HELD_PER_SOURCE, max(most, 2 * slots)) - slots
            self._ahead = np.concatenate([self._ahead, _empty(more, self._count.size)])

    def _thin(self, source: int) -> None:
        """Keep only the last reading between two ticks: no tick uses the others."""
        numbers = [self._serves(t) for t in self._times(source)]
        self._keep(
            source, [k for k, (one, after) in enumerate(zip_longest(numbers, numbers[1:])) if one != after]
        )

    def _keep(self, source: int, which: list[int]) -> None:
        """Keep only some held readings of a source, by position."""
        served = self._served[T, source] > -math.inf
        held = self._ahead[: self._count[source], :, source]
        held = np.concatenate([self._served[None, :, source], held] if served else [held])[which]
        if served:  # The first one that is kept serves the same tick.
            self._served[:, source], held = held[0], held[1:]
        self._ahead[:, T, source] = np.inf
        self._ahead[: len(held), :, source] = held
        self._count[source] = len(held)
        self._drop_phases()

    def _held(self) -> Ints:
        """Number of held readings of each source, (p + 1,)."""
        return np.asarray(self._count + (self._served[T] > -math.inf))

    def _times(self, source: int) -> list[float]:
        """Times of the held readings of a source, s."""
        times: list[float] = self._ahead[: self._count[source], T, source].tolist()
        served = float(self._served[T, source])
        return times if served == -math.inf else [served, *times]

    def _count_gap(self, source: int, seq: int, t: float) -> None:
        # A decreasing number is a restart or a changed order, not a loss. The ring of the subscription drops
        # the oldest samples, which only this gap shows. A reading overtaken by a later one is not evidence of
        # a loss.
        if seq == NO_SEQ or t < self._last_t[source]:
            return
        before = int(self._seq[source])
        if before != NO_SEQ and 0 < (gap := seq - before - 1) <= GAP_MAX:
            self.lost += gap
        self._seq[source] = seq

    def _count_gaps(self, source: Ints, seq: Ints) -> None:
        """Count the lost readings before readings in order, grouped by source."""
        numbered = seq != NO_SEQ
        if not numbered.any():
            return
        source, seq = source[numbered], seq[numbered]
        before = np.where(rank(source) > 0, np.concatenate(([NO_SEQ], seq[:-1])), self._seq[source])
        gap = seq - before - 1
        self.lost += int(gap[(before != NO_SEQ) & (gap > 0) & (gap <= GAP_MAX)].sum())
        self._seq[source] = seq

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
        return self._time(self._next) + (self.rules.grace_s if self._waits else 0.0)

    def _hear(self, t: float, source: int) -> None:
        """Update the time from the time of a reading, s."""
        # The count leaves out clocks far ahead: frequent readings of such a clock must not expire the other
        # sources.
        if self._now is None or t - self._now <= self.rules.max_skew_s:
            self._arrivals += 1
        if source in self._active:
            self._claims.pop(bisect_left(self._claims, self._active.pop(source)))
        self._heard[source] = self._arrivals
        self._active[source] = t
        insort(self._claims, t)
        sources = len(self._heard)
        window = max(_ACTIVE_ROUNDS * sources, 64)
        while self._heard[next(iter(self._active))] <= self._arrivals - window:
            _, claim = self._active.popitem(last=False)
            self._claims.pop(bisect_left(self._claims, claim))
        if self._now is None and 2 * len(self._active) < sources and self._arrivals < window:
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
        for source in range(self._count.size):
            times = self._times(source)
            fits = [k for k, t in enumerate(times) if abs(t - now) <= self.rules.max_skew_s]
            if len(fits) == len(times):
                continue
            for k in sorted({*range(len(times))} - {*fits}):
                t, v_volt, p_kw, q_kvar, t_power = self._ahead[k, :, source].tolist()
                phases = self._phases.get(t) if source == len(self.meters) else None
                self._refused.append(
                    Reading("", self._name(source), t, v_volt, p_kw, q_kvar, None, phases, t_power)
                )
            self.counts[ReadingOutcome.ACCEPTED] -= len(times) - len(fits)
            self.counts[ReadingOutcome.CLOCK_OFF] += len(times) - len(fits)
            self._keep(source, fits)
            self._last_t[source] = times[fits[-1]] if fits else -math.inf

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
            self._served[T] = -np.inf
            self._ahead = _empty(SLOTS, self._count.size)
            self._phases.clear()
            self._count[:], self._most = 0, 0
            for times in (self._last_t, self._last_heard, self._last_used):
                times[:] = -math.inf
            self._clocks.forget()
            self._offsets, self._busbar_offset = (), None
            self._latest = wall
            self._begin(wall)
        self._latest = max(self._latest, wall)
        yield from self._emit_ticks(wall)

    def _emit_ticks(self, wall: float) -> list[Tick]:
        now, ticks = self.now(wall), list[Tick]()
        if now is None:
            return ticks
        if self._next is None:
            self._begin(now)
        if now < self._next_t:
            return ticks
        first = self._number()
        behind = math.floor(now / self.rules.tick_s) - first
        if behind > self.rules.backlog:
            self._skip(first, self._resume(first + behind))
            # A skipped tick was not formed and is not evidence of silence.
            self._resumed = self._time(self._number())
        while now >= self._next_t + (self.rules.grace_s if self._waits else 0.0):
            ticks.append(self._tick())
        return ticks

    def excuse(self) -> None:
        """Count no time until now as silence: the readings were discarded."""
        if self._next is not None:
            self._resumed = self._time(self._next)
            self._turn_to(self._next)

    def pass_over(self, wall: float) -> int:
        """Pass over the ticks before the newest one due at the wall time, Unix s; return their number."""
        if self._next is None:
            return 0
        newest = math.floor((wall - self.rules.grace_s) / self.rules.tick_s)
        passed = max(0, newest - self._next)
        if passed:
            self._turn_to(newest)
        return passed

    def flush(self) -> Iterator[Tick]:
        """Emit every tick that the time has reached, without grace: the input has ended."""
        if self._now is None and self._claims:
            self._now = self._claims[len(self._claims) // 2]
            self._sweep(self._now)
        now = self.now(self._latest)
        if now is None or now == -math.inf:
            return
        yield from self.due(now)
        while self._next_t <= now:
            yield self._tick()

    def _resume(self, now: int) -> int:
        """Number of the first tick to form after a step of the time to tick number `now`."""
        first = now - self.rules.backlog
        newest = [times[-1] for source in range(self._count.size) if (times := self._times(source))]
        starts = ((max(first, self._serves(t)), t) for t in newest)
        serving = any(n < now and self._time(n) - t < self.rules.max_age_s for n, t in starts)
        return first if serving or not self.rules.skips_empty else now

    def _skip(self, first: int, following: int) -> None:
        """Continue with the tick `following`; readings serve as if the skipped ticks had been formed."""
        for source in range(self._count.size):
            times = self._times(source)
            for t, later in zip_longest(times, times[1:]):
                begin = max(first, self._serves(t))
                end = following if later is None else min(following, self._serves(later))
                if begin < end and self._time(begin) - t < self.rules.max_age_s:
                    self._last_used[source] = max(float(self._last_used[source]), t)
        self._skipped += following - first
        self._turn_to(following)

    def _serves(self, t: float) -> int:
        """Return the number of the first tick that may use a reading of a time, s."""
        return math.ceil((t - self.rules.lead_s) / self.rules.tick_s)

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
        self._next, self._next_t = number, self._time(number)
        self._end = self._time(number - 1) + self.rules.lead_s
        self._serve(self._end)
        # Independent of usability: with long ticks the last source would otherwise be late at every tick, and
        # silent.
        reported = self._last_t > self._end
        self._waiting = ~(reported | (self._silent_for(self._last_t, self._next_t) > 0.0))
        self._waits = int(np.count_nonzero(self._waiting))

    def _serve(self, end: float) -> None:
        """Keep the newest reading of each source until a time, s, and all later ones."""
        if not self._most:
            return
        later = self._ahead[: self._most]
        if self._most == 1:
            newest = later[0]
            done = newest[T] <= end
        else:
            done = np.count_nonzero(later[:, T] <= end, axis=0)
            newest = later[np.maximum(done, 1) - 1, :, self._each].T
        np.copyto(self._served, newest, where=done > 0)
        self._count = self._count - done
        self._most = int(self._count.max())
        if self._most:
            there = np.minimum(np.arange(self._most)[:, None] + done, len(later) - 1)
            left = later[there, :, self._each].transpose(0, 2, 1)
            left[:, T][np.arange(self._most)[:, None] >= self._count] = np.inf
            later[: self._most] = left
        later[self._most :, T] = np.inf
        if len(self._ahead) > max(SLOTS, 2 * self._most):
            self._ahead = self._ahead[: max(SLOTS, self._most)].copy()
        self._drop_phases()

    def _drop_phases(self) -> None:
        """Drop the phases of readings of the busbar that are not held any more."""
        if self._phases:
            times = set(self._times(len(self.meters)))
            self._phases = {t: phases for t, phases in self._phases.items() if t in times}

    def _wait_for(self, source: int) -> None:
        """Wait for a source at the next tick if it is not silent and has not reported for it."""
        last_t = self._last_t[source : source + 1]
        wait = not last_t[0] > self._end
        if wait:
            heard = self._last_heard[source : source + 1]
            wait = not self._silent_for(last_t, self._next_t, heard)[0] > 0.0
        self._waits += int(wait) - int(self._waiting[source])
        self._waiting[source] = wait

    def _silent_for(self, last: Floats, t: float, heard: Floats | None = None) -> Floats:
        """Return the duration of each source's silence at t since `last`, s; 0 if it is not silent.

        `heard` are the latest arrivals of these sources, s; None for all sources.
        """
        silence_s = self.rules.silence_s
        if t - self._resumed <= silence_s:
            return np.zeros(last.size)
        since = t - np.minimum(last, self._last_heard if heard is None else heard)
        if self._first is not None and t - self._time(self._first) <= silence_s:
            since[since == math.inf] = 0.0
        return np.where(since > silence_s, since, 0.0)

    def _tick(self) -> Tick:
        """Form the next tick."""
        t = self._next_t
        self._serve(t + self.rules.lead_s)
        values = self._served.copy()
        usable = t - values[T] < self.rules.max_age_s
        np.copyto(self._last_used, values[T], where=usable)
        if not all_of(usable):
            values[:, ~usable] = np.nan
        seconds = self._silent_for(self._last_used, t)
        silent = tuple((self._name(k), float(seconds[k])) for k in indices(seconds > 0.0).tolist())
        skipped, self._skipped = self._skipped, 0
        if self._number() % OFFSETS_TICKS == 0:
            found = self._clocks.measured(t)
            self._busbar_offset = found.get(None)
            offsets = tuple(found.get(meter) for meter in self.meters)
            self._offsets = offsets if any(offsets) else ()
        phases = self._phases.get(float(values[T, -1])) if self._phases else None
        known = self._clocks.known if self.rules.clock is Clock.WALL else None
        self._turn_to(self._number() + 1)
        return Tick(t, values, silent, skipped, self._offsets, self._busbar_offset, phases, known)


def _empty(slots: int, sources: int) -> Floats:
    """Table of readings without any, (slots, 5, sources)."""
    table = np.full((slots, COLUMNS, sources), np.nan)
    table[:, T] = np.inf
    return table


class _Scans:
    """Scans of readings: successive readings of different sources.

    source (n,): sources of the readings.
    """

    def __init__(self, source: Ints) -> None:
        self._source = source
        order = source.argsort(kind="stable")
        again = source[order[1:]] == source[order[:-1]]
        # Position of the last reading of the same source.
        self._before = np.full(source.size, -1)
        self._before[order[1:][again]] = order[:-1][again]
        self._found: dict[int, tuple[int, slice | Ints]] = {}

    def at(self, begin: int, most: int) -> tuple[int, slice | Ints]:
        """Return the end of the longest scan from a position, and its sources; `most` is their number."""
        found = self._found.get(begin)
        if found is None:
            repeated = self._before[begin : begin + most] >= begin
            end = begin + int(repeated.argmax()) if any_of(repeated) else begin + repeated.size
            first, each = int(self._source[begin]), self._source[begin:end]
            in_order = all_of(each == np.arange(first, first + each.size))
            found = end, slice(first, first + each.size) if in_order else each
            self._found[begin] = found
        return found
