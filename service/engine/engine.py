"""State of the service and its cycle: decode, align, estimate, alarm, store, publish.

A tick is stale when a later tick of the same feeder is due as well. Stale ticks are evaluated oldest first,
within a time budget. With the wall clock the remaining ones are skipped: an old tick is worth less than the
next one. With `Clock.EVENTS` no tick is stale, and the remaining ones wait for the next round.

Everything here is synchronous and called from one thread at a time, as `runtime` ensures. Readers on other
threads (REST, metrics) only take references to immutable reports. Monitoring never waits for the database:
see `service.store.committer`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any, TypeVar

import msgspec
import numpy as np
import structlog

from feeders.model.site import Site
from gridsec.errors import GridsecError
from gridsec.interface import Cause
from service.access.signing import MeterKeys
from service.alarms.incidents import IncidentEvent, event_json
from service.alarms.state_machine import (
    Alarm,
    AlarmRules,
    AlarmUnknown,
    acknowledged,
    carry,
    close,
    restore,
)
from service.alarms.state_machine import to_json as alarm_json
from service.engine.commissioning import CommissioningProgress
from service.engine.feeder_monitor import (
    FeederMonitor,
    TickResult,
    align_rules,
    known_of,
)
from service.engine.load import FeederLoad, LoadControl
from service.engine.operators import SHELVE_MOST_S, Operators
from service.engine.orphans import Orphans, Standing, read_standing
from service.errors import FeederUnknown
from service.ingest.align import Clock
from service.ingest.decode import Wire
from service.ingest.queues import Inbox, Sample
from service.ingest.reading import BadReading, BadReason, Known, Reading, Readings, head_of
from service.metrics import Metrics
from service.report.feeder_info import Ownership
from service.report.report import BUSBAR, Kept
from service.report.tick_state import TickState
from service.store import Rejected, Store
from service.store.committer import Committer, Executor, Wish, alarm_key, incident_key, inline
from service.store.schema import CommissioningEvent
from service.store.series import Mark, mark, worth_keeping
from service.store.state_codec import KeptInvalid, MonitorState, StateSnapshot, decode_signed, encode_signed

BAD_PER_SOURCE = 5
"""Bad readings of one round, key and reason that are stored separately; the others become one entry."""
BAD_PER_ROUND = 50
"""Largest number of entries for bad readings of a round."""

SAMPLES_AT_ONCE = 4096
"""Payloads that are decoded together; a stop of the service waits for no more."""

T = TypeVar("T")


def some_of_each(bad: Iterable[Rejected]) -> tuple[list[Rejected], int]:
    """Sample the rejected readings of a round fairly over their sources.

    Entries are taken by reason and key in turn, so that the largest source leaves room for the others.

    Returns entries, left_out: entries in the order of arrival; number of rejected readings without an entry.
    """
    sources: dict[str, dict[str, list[tuple[int, Rejected]]]] = {}
    for number, one in enumerate(bad):
        reason = one.reason.partition(":")[0]
        sources.setdefault(reason, {}).setdefault(one.key, []).append((number, one))
    turns = [_in_turn([_entries(found) for found in keys.values()]) for keys in sources.values()]
    entries = _in_turn(turns)
    kept = sorted(entries[:BAD_PER_ROUND], key=lambda entry: entry[0])
    return [one for _, one, _ in kept], sum(count for _, _, count in entries[BAD_PER_ROUND:])


_Entry = tuple[int, Rejected, int]


def _entries(found: Sequence[tuple[int, Rejected]]) -> list[_Entry]:
    """Entries for the bad readings of one key and reason: position, entry, number of readings."""
    entries = [(number, one, 1) for number, one in found[:BAD_PER_SOURCE]]
    more = len(found) - BAD_PER_SOURCE
    if more > 0:
        number, last = found[-1]
        reason = f"{last.reason.partition(':')[0]}: {more} more on this key at the same time"
        entries.append((number, Rejected(last.t, last.key, reason), more))
    return entries


def _in_turn(queues: Iterable[Sequence[T]]) -> list[T]:
    return [item for row in zip_longest(*queues) for item in row if item is not None]


BUDGET_S = 1.0
"""Time budget for stale ticks, s, until all feeders are up to date again."""

CALM_S = 60.0
"""Time without a skipped tick, s, after which the next one is logged again."""

ORDER_S = 2.0
"""Interval of writes of the order of signed readings, s: `kill -9` loses the order of this time."""

SHOWN = 5
"""Largest number of feeders in one line of the log."""

_log = structlog.get_logger("gridsec.runtime")


class CatchUp:
    """Time budget for stale ticks, and log of skipped ones.

    clock: monotonic time, s.
    waits: True if ticks beyond the budget wait (`Clock.EVENTS`) instead of being skipped.
    """

    def __init__(self, clock: Callable[[], float], *, waits: bool) -> None:
        self._clock, self._waits = clock, waits
        self._left_s = BUDGET_S
        self._skipped: Counter[str] = Counter()
        self._calm_at: float | None = None

    def judge(
        self,
        monitors: Iterable[FeederMonitor],
        judge: Callable[[FeederMonitor], None],
        go_on: Callable[[], bool],
    ) -> None:
        """Evaluate the pending ticks.

        `judge` evaluates the oldest pending tick of a feeder. `go_on` is checked before each tick; if False,
        the remaining ticks stay pending.
        """
        due = [monitor for monitor in monitors if monitor.pending]
        stale = [monitor for monitor in due if len(monitor.pending) > 1]
        if self._waits or not stale:
            self._left_s = BUDGET_S
        begun = self._clock()
        end = begun + self._left_s
        while stale and go_on() and self._clock() < end:
            first = min(stale, key=lambda monitor: monitor.pending[0].t)
            judge(first)
            if len(first.pending) < 2:
                stale.remove(first)
        self._left_s -= self._clock() - begun
        if stale and self._waits:
            return
        for monitor in stale if go_on() else ():
            monitor.skip(len(monitor.pending) - 1)
        for monitor in due:
            if monitor.pending and go_on():
                judge(monitor)

    def skipped(self, feeder: str, count: int) -> None:
        """Log the first skipped ticks, and their number after `CALM_S` without one."""
        if self._calm_at is None:
            _log.warning("ticks are skipped: the service was behind by more than it can judge", feeder=feeder)
        self._skipped[feeder] += count
        self._calm_at = self._clock() + CALM_S

    def calm(self) -> None:
        """Log the end of an episode, if it is over."""
        if self._calm_at is None or self._clock() < self._calm_at:
            return
        names = [name for name, _ in self._skipped.most_common(SHOWN)]
        total, feeders = self._skipped.total(), len(self._skipped)
        _log.warning("ticks were skipped", ticks=total, feeders=feeders, most=names, calm_s=CALM_S)
        self._calm_at = None
        self._skipped.clear()


NOT_WATCHED = "the feeder is not monitored any more"
TOLD_TWICE = "duplicate of another alarm"


@dataclass(frozen=True, slots=True)
class RuntimeConfig:
    """Configuration of the service, apart from its feeders."""

    prefix: str = "gridsec"  # first chunks of every zenoh key
    clock: Clock = Clock.WALL  # source of the present time
    # max_skew_s, grace_s: as in `align.rules`; None for the values of the feeder's tick.
    max_skew_s: float | None = None
    grace_s: float | None = None
    max_payload: int = 256 * 1024  # size of the largest accepted payload, bytes
    max_samples: int = 20_000  # length of the queue before the runtime, samples
    max_feeders: int = 100  # largest number of feeders added at run time, besides those given at the start
    shelve_most_s: float = SHELVE_MOST_S  # longest time of a shelf, s
    meter_keys: MeterKeys | None = None  # keys of meters; None accepts readings without signature
    # Worker and lease of a feeder; None without workers.
    ownership: Callable[[str], Ownership | None] = lambda _: None
    # False: readings of feeders that are not monitored are discarded; some arrive at each hand-over.
    rejects_unknown: bool = True
    # False while the leases of this process may have expired: it must not act.
    acts: Callable[[], bool] = lambda: True


@dataclass(frozen=True, slots=True)
class Handover:
    """State of a feeder for its next owner, as stored."""

    state: PersistedState
    open_incidents: tuple[IncidentEvent, ...]


@dataclass(frozen=True, slots=True)
class PersistedState:
    """State of a feeder for the warm start: alarms, state of the monitor, order of signed readings."""

    alarms: tuple[Alarm, ...]
    monitor: MonitorState
    signed: StateSnapshot | None = None


class Engine:
    """All state of the service.

    sites: the monitored feeders.
    wall: wall clock, Unix s.
    stored: called after alarms have been stored.
    apart: executor of writes: called with the write, for any thread, and with the handler of its result, for
        the time between two rounds.
    unloaded: stored feeders that cannot be loaded, with the reason.
    clock: monotonic time, s.
    go_on: checked between two payloads and between two ticks; if False, the round ends early.
    """

    def __init__(
        self,
        config: RuntimeConfig,
        store: Store,
        sites: Iterable[Site],
        *,
        wall: Callable[[], float],
        stored: Callable[[], None],
        apart: Executor = inline,
        unloaded: Mapping[str, str] | None = None,
        clock: Callable[[], float] = time.monotonic,
        go_on: Callable[[], bool] = lambda: True,
    ) -> None:
        self.config = config
        self.store = store
        self.metrics = Metrics()
        self.monitors: dict[str, FeederMonitor] = {}
        self.unloaded = dict(unloaded or {})
        self.reported: dict[str, float] = {}
        self._wall, self._stored, self._continues = wall, stored, go_on
        self._catch_up = CatchUp(clock, waits=config.clock is Clock.EVENTS)
        self.committer = Committer(store, self.metrics, stored, self._count_stored, apart, wall=wall)
        self.operators = Operators(self, wall, config.shelve_most_s)
        self._wire = Wire({}, config.prefix, config.max_payload, config.meter_keys)
        self._marks: dict[str, Mark] = {}
        self._wakes: dict[str, float] = {}
        self._until = self._order_kept = -math.inf
        self.load = LoadControl(clock, lambda name: bool(self.metrics.active(name)))
        self.metrics.shed.set_function(self.shed_displayed)
        self._clock, self._orphans = clock, Orphans()
        for site in sites:
            self.add(site)

    def add(self, site: Site, past: PersistedState | None = None) -> FeederMonitor:
        """Start monitoring a feeder, or restart it with other tables; its alarms stay.

        `past` is the state for the warm start; None: read from the database at once.
        """
        config, name = self.config, site.feeder.name
        past = past or self._past(name, self.store)
        rules = align_rules(
            site, config.clock, max_skew_s=config.max_skew_s, grace_s=config.grace_s, live=True
        )
        book = restore(name, past.alarms)
        monitor = FeederMonitor(site, rules, book, past.monitor)
        held = {alarm.id for alarm in book.alarms}
        twice = [alarm for alarm in past.alarms if alarm.id not in held]
        self.committer.waiting.add(transitions=close(twice, self._wall(), TOLD_TWICE))
        self.monitors = {**self.monitors, name: monitor}
        self._wakes[name] = -math.inf
        settings = site.tables.meta.monitor
        old = self.load.feeders.get(name)
        load = self.load.feeders[name] = FeederLoad(settings.tick_s, len(site.meter_ids) + 1)
        if old is not None:
            load.offered, load.dropped = old.offered, old.dropped
        if name in self.load.shed:
            monitor.set_shed(True, self._wall())
        self.unloaded.pop(name, None)
        self._restore_order(name, past.signed)
        self._learn({**self._wire.known, name: known_of(site)})
        return monitor

    def _restore_order(self, name: str, kept: StateSnapshot | None) -> None:
        """Continue the order of a feeder's signed readings."""
        if kept is None or self.config.meter_keys is None:
            return
        try:
            self.config.meter_keys.restore(name, decode_signed(name, kept))
        except KeptInvalid as error:
            _log.error("the stored order of signed readings is not used", feeder=name, problem=str(error))

    def _past(self, name: str, store: Store) -> PersistedState:
        # With `Clock.EVENTS` the latest tick may be long ago; `advance` drops alarms that are too old.
        latest = min([self._wall(), *(tick["t"] for tick in store.history(name, limit=1))])
        alarms = store.active(name, cleared_since=latest - AlarmRules().memory_s)
        signed = None if self.config.meter_keys is None else store.signed(name)
        state = MonitorState(store.commission(name), store.distrust(name), store.observer(name))
        return PersistedState(tuple(alarms), state, signed)

    def put(
        self, site: Site, tables: Mapping[str, Any], installed: Callable[[FeederMonitor], None]
    ) -> Future[None]:
        """Store a feeder's tables and start monitoring it, or restart it with other tables.

        Raises StoreUnavailable if the tables cannot be stored; the feeder stays unchanged.
        """
        answer: Future[None] = Future()
        name = site.feeder.name

        def store(past: PersistedState) -> None:
            self.committer.store(
                Wish(put=(name, tables)),
                _landing(answer, lambda: installed(self.add(site, self._go_on(name, past)))),
                partial(_refuse, answer),
            )

        self.keep_states(at_once=True)
        self.committer.look(partial(self._past, name), _then(answer, store), partial(_refuse, answer))
        return answer

    def _go_on(self, name: str, stored: PersistedState) -> PersistedState:
        """Return the latest state of a feeder: a monitored one has had ticks since it was stored."""
        monitor = self.monitors.get(name)
        if monitor is None:
            return stored
        return PersistedState(monitor.book.alarms, monitor.now(stored.monitor), stored.signed)

    def remove(self, name: str) -> Future[None]:
        """Stop monitoring a feeder: its alarms are cleared, its tables deleted, its history stays.

        Raises FeederUnknown, StoreUnavailable if it does not exist, or the change cannot be stored;
        monitoring then continues.
        """
        answer: Future[None] = Future()
        monitor = self.monitors.get(name)
        if monitor is None and name not in self.unloaded:
            raise FeederUnknown(name)

        def store(standing: Iterable[Alarm]) -> None:
            t = self._wall() if monitor is None or monitor.book.t is None else monitor.book.t
            self.committer.store(
                Wish(close(standing, t, NOT_WATCHED), without=name),
                _landing(answer, partial(self._removed, name)),
                partial(_refuse, answer),
            )

        if monitor is None:
            self.committer.look(lambda db: db.active(name), _then(answer, store), partial(_refuse, answer))
        else:
            store(monitor.book.active)
        return answer

    def _removed(self, name: str) -> None:
        self.committer.waiting.forget(name)
        self._drop(name)

    def _drop(self, name: str) -> None:
        """Forget a feeder; what waits for the database is stored."""
        self.unloaded.pop(name, None)
        self.monitors = {other: kept for other, kept in self.monitors.items() if other != name}
        for table in (self._wakes, self._marks, self.reported, self.load.feeders):
            table.pop(name, None)
        self._learn({other: known for other, known in self._wire.known.items() if other != name})
        self.metrics.forget(name)
        if self.committer.publisher is not None:
            self.committer.publisher.withdraw(name)

    # ---------------------------------------------------------------- feeders of a worker

    def adopt(
        self, sites: Sequence[Site], installed: Callable[[FeederMonitor], None]
    ) -> Future[list[FeederMonitor]]:
        """Go on with feeders of another owner: their state and standing alarms.

        A feeder that is monitored by then keeps its monitor: its tables are the same or newer. `installed`
        is called with each new monitor. Raises StoreUnavailable if the database cannot be read; no feeder is
        taken over then.
        """
        answer: Future[list[FeederMonitor]] = Future()

        def take(found: Sequence[Handover]) -> None:
            made = []
            for site, handover in zip(sites, found, strict=True):
                if site.feeder.name in self.monitors:
                    continue
                made.append(self.add(site, handover.state))
                self._take_over(handover)
                installed(made[-1])
            self.committer.commit()
            answer.set_result(made)

        def read(db: Store) -> list[Handover]:
            return [self._handover(site.feeder.name, db) for site in sites]

        self.committer.look(read, _then(answer, take), partial(_refuse, answer))
        return answer

    def _handover(self, name: str, store: Store) -> Handover:
        return Handover(
            self._past(name, store),
            tuple(store.open_incident_events(feeder=name)),
        )

    def _take_over(self, handover: Handover) -> None:
        """Set the replies for standing alarms and incidents."""
        publisher = self.committer.publisher
        if publisher is not None:
            for alarm in (one for one in handover.state.alarms if one.active):
                publisher.answer(alarm_key(alarm), msgspec.json.encode(alarm_json(alarm)))
            for event in handover.open_incidents:
                publisher.answer(incident_key(event.incident), msgspec.json.encode(event_json(event)))

    def resign(self, names: Collection[str]) -> Future[None]:
        """End the monitoring of feeders for their next owner: their state is stored, their alarms stay.

        Raises StoreUnavailable if the database is known to be unavailable; monitoring then continues.
        """
        answer: Future[None] = Future()
        leaving = [self.monitors[name] for name in names if name in self.monitors]
        self.keep_states(leaving, at_once=True)
        landed = _landing(answer, partial(self._withdraw, names))

        def refused(error: GridsecError) -> None:
            self._withdraw(names)
            _refuse(answer, error)

        self.committer.look(lambda _: None, lambda _: landed(), refused)
        for monitor in leaving:
            self._drop(monitor.name)
        return answer

    def _withdraw(self, names: Collection[str]) -> None:
        """Remove the replies to queries for left feeders, also those of their last commit."""
        for name in names:
            if self.committer.publisher is not None and name not in self.monitors:
                self.committer.publisher.withdraw(name)

    def expects(self, key: str) -> bool:
        """True for a zenoh key of single readings of a monitored meter."""
        return self._wire.expects(key)

    def _learn(self, known: Mapping[str, Known]) -> None:
        """Decode readings of these feeders from now on."""
        self._wire = Wire(known, self.config.prefix, self.config.max_payload, self.config.meter_keys)

    def begin(self, given: Collection[str] = ()) -> None:
        """Set the replies for standing alarms; publish the stored alarms of an earlier process.

        Alarms of feeders that are neither monitored nor stored any more are cleared here: no monitor does it.
        `given` are further feeders, which this process monitors later. A worker has no feeders yet: `adopt`
        and `_clear_orphans` follow its claims.
        """
        if self.store.shared:
            return
        ours, t = {*self.monitors, *self.unloaded, *self.store.feeders(), *given}, self._wall()
        standing = self.store.active()
        left_out = [alarm for alarm in standing if alarm.feeder not in ours]
        self.committer.waiting.add(transitions=close(left_out, t, NOT_WATCHED))
        if self.committer.publisher is not None:
            for alarm in standing:
                if alarm.feeder in ours:
                    self.committer.publisher.answer(alarm_key(alarm), msgspec.json.encode(alarm_json(alarm)))
            for event in self.store.open_incident_events():
                if event.incident.feeder in ours:
                    payload = msgspec.json.encode(event_json(event))
                    self.committer.publisher.answer(incident_key(event.incident), payload)
        for name in self.unloaded:
            self.metrics.alarms.labels(name).set(sum(alarm.feeder == name for alarm in standing))
        self.committer.commit()

    def _clear_orphans(self) -> None:
        """Start a read of the alarms of removed feeders, if one is due after a claim; they are cleared."""
        committer = self.committer
        if not self.store.shared or committer.storing or committer.problem is not None:
            return

        def clear(read: Standing) -> None:
            left_out = self._orphans.found(read, self.monitors)
            committer.waiting.add(transitions=close(left_out, self._wall(), NOT_WATCHED))

        if self._orphans.due(self.store.held, self._clock()):
            committer.look(read_standing, clear, lambda _: None)

    # ---------------------------------------------------------------- one round

    def cycle(self, samples: list[Sample], oldest: Callable[[], Mapping[str, float]] = dict) -> bool:
        """Process samples and due ticks, store, publish.

        `oldest` returns the arrival time of the oldest waiting sample of feeders, Unix s. Returns True if
        there is a new report.
        """
        started, begun = time.perf_counter(), time.thread_time()
        self._clear_orphans()
        bad = self._place(samples)
        self._keep_order(at_once=False)
        placed = time.thread_time()
        self._reach(self._wall(), oldest())
        results = self._judge()
        entries, left_out = some_of_each(bad)
        self.committer.waiting.add(rejected=entries)
        self.metrics.forgotten.labels("bad-reading").inc(left_out)
        for result in results:
            monitor = self.monitors[result.state.feeder]
            reports = self._guarded(monitor, partial(self._history, result.state)) or ()
            if result.transitions or reports:
                self.committer.waiting.add(transitions=result.transitions, reports=reports)
            self.metrics.count_tick(result.state, len(monitor.book.active))
            self.reported[monitor.name] = time.monotonic()
            self.keep_states((monitor,))
            self._count_start(monitor)
        self.committer.commit()
        self._publish_estimates(results)
        lasted = time.perf_counter() - started
        if samples or results:
            self.metrics.cycle.observe(lasted)
        spent = time.thread_time() - begun
        self.load.count_round(lasted, spent, placed - begun, len(samples))
        return bool(results)

    def control(self, inbox: Inbox) -> None:
        """Under lasting overload, stop monitoring some feeders, and begin again as soon as the load fits."""
        if self.load.update(inbox.counts):
            self.follow_load(inbox)

    def follow_load(self, inbox: Inbox) -> None:
        """Begin and end the monitoring of feeders as `load.shed` states."""
        shed = frozenset(self.load.shed)
        changed = sorted(shed ^ inbox.shed)
        inbox.shed = shed
        for name in changed:
            inbox.forget(name)
            monitor = self.monitors.get(name)
            if monitor is None:  # a removed feeder
                continue
            self.metrics.count_passed_over(name, monitor.set_shed(name in shed, self._wall()))
            self._set_wake(monitor)
        told = {"feeders": len(shed), "changed": changed[:SHOWN], **self.load.figures()}
        _log.warning("feeders are shed because of overload", **told)

    def shed_displayed(self) -> int:
        """Number of feeders that are displayed as not monitored because of overload, as in their list."""
        return sum(monitor.shows_overload for monitor in self.monitors.values())

    def _reach(self, now: float, waiting: Mapping[str, float]) -> None:
        """Add the ticks that are due at the wall time `now`, Unix s, to the pending ones.

        A tick must not end before samples that arrived in time have left the queue: `waiting` as in `cycle`.
        """
        back, before, self._until = now < self._until, self._until, now
        for name, monitor in self.monitors.items():
            until = min(now, waiting.get(name, now))
            if back or self._wakes[name] <= until:
                started = time.thread_time()
                if back:
                    # The alignment detects a clock that is set back by the latest time that it has reached.
                    self._guarded(monitor, partial(monitor.reach, before))
                self._guarded(monitor, partial(monitor.reach, until))
                self._set_wake(monitor)
                self.load.count_forming(name, time.thread_time() - started)

    def _set_wake(self, monitor: FeederMonitor) -> None:
        """Note the latest time of a monitor's next tick; at `Clock.EVENTS` only readings cause one."""
        wake = monitor.wake
        self._wakes[monitor.name] = math.inf if wake is None else wake

    @property
    def wake(self) -> float:
        """Latest wall time of the next tick, Unix s; infinite if only readings can cause one."""
        return min(self._wakes.values(), default=math.inf)

    def _history(self, state: TickState) -> tuple[Kept, ...]:
        """The part of the report that the history keeps, if any: the store selects by the same rule."""
        now = mark(state)
        if not worth_keeping(self._marks.get(state.feeder), now, self.store.history_rules):
            self._count_delay(state.feeder, state.t)
            return ()
        self._marks[state.feeder] = now
        return (state.kept(),)

    @property
    def behind(self) -> bool:
        """True while due ticks wait for the next round."""
        return any(monitor.pending for monitor in self.monitors.values())

    def _place(self, samples: Sequence[Sample]) -> list[Rejected]:
        """Decode and align samples without evaluation; return the unusable readings."""
        bad: list[Rejected] = []
        for begin in range(0, len(samples), SAMPLES_AT_ONCE):
            if not self._continues():
                break
            gathered = self._wire.gather(samples[begin : begin + SAMPLES_AT_ONCE])
            bad.extend(self._note(*one) for one in gathered.bad if self._rejects(one[0]))
            self._refuse_identities(problem for problem, _ in gathered.bad)
            for name, readings in gathered.readings.items():
                bad.extend(self._align(self.monitors[name], readings))
        # Rejected readings are stored in the order of their arrival.
        return sorted(bad, key=lambda one: one.t)

    def _rejects(self, problem: BadReading) -> bool:
        return self.config.rejects_unknown or problem.reason is not BadReason.UNKNOWN_FEEDER

    def _align(self, monitor: FeederMonitor, readings: Readings) -> Iterable[Rejected]:
        """Align the readings of a feeder; yield those with a wrong clock."""
        name, lost = monitor.name, monitor.aligner.lost
        placed = self._guarded(monitor, partial(monitor.place_all, readings))
        self._set_wake(monitor)
        self.metrics.count_lost(name, monitor.aligner.lost - lost)
        if placed is None:
            return
        self.metrics.count_readings(name, placed.counts)
        known = self._wire.known[name]
        for k in placed.clock_off:
            yield self._clock_off(readings.reading(k, known), float(readings.arrival[k]))
        for refused in monitor.aligner.refused():
            reading = msgspec.structs.replace(refused, feeder=name)
            yield self._clock_off(reading, float(readings.arrival[-1]))

    def _refuse_identities(self, bad: Iterable[BadReading]) -> None:
        """Pass readings with a wrong signature or sender to the monitors of their feeders."""
        for problem in bad:
            monitor = self.monitors.get(problem.feeder or "")
            if problem.reason is not BadReason.SIGNATURE or monitor is None:
                continue
            for meter in problem.refused or (problem.meter,):
                if meter is not None:
                    monitor.refuse(meter, problem.problems[0])
                elif problem.refused or "/substation/" in problem.key:
                    monitor.refuse(BUSBAR, problem.problems[0])

    def _judge(self) -> list[TickResult]:
        """Evaluate the pending ticks within the time budget; count skipped ones."""
        results: list[TickResult] = []

        def judge(monitor: FeederMonitor) -> None:
            skipped, begun = monitor.skipped, time.thread_time()
            result = self._guarded(monitor, monitor.judge)
            judged = result is None or result.state.cause is not Cause.OVERLOAD
            self.load.count_tick(monitor.name, time.thread_time() - begun, judged=judged)
            if monitor.skipped > skipped:
                self.load.count_skipped(monitor.skipped - skipped)
                self.metrics.skipped.labels(monitor.name).inc(monitor.skipped - skipped)
                self._catch_up.skipped(monitor.name, monitor.skipped - skipped)
            if result is not None:
                results.append(result)

        self._catch_up.judge(self.monitors.values(), judge, self._continues)
        self._catch_up.calm()
        return results

    def keep_states(self, monitors: Iterable[FeederMonitor] | None = None, *, at_once: bool = False) -> None:
        """Queue the commissioning, suspicions and observers of feeders for the database, if they are due.

        `monitors` None: all. With `at_once` it includes those that are not due yet.
        """
        self._keep_order(at_once=at_once)
        for monitor in self.monitors.values() if monitors is None else monitors:
            kept, happened = monitor.commissioning.due(at_once=at_once)
            kept = (*kept, *monitor.suspicions.due(), *monitor.observer.due(at_once=at_once))
            if kept or happened:
                self.committer.waiting.add(kept=kept, happened=happened)
            for one in happened:
                _say(one)
            if happened:
                self._count_learned(monitor)

    def _keep_order(self, *, at_once: bool) -> None:
        """Queue the order of new signed readings for the database; without `at_once` every `ORDER_S`."""
        keys, now = self.config.meter_keys, time.monotonic()
        if keys is None or not keys.changed or (now - self._order_kept < ORDER_S and not at_once):
            return
        t, self._order_kept = self._wall(), now
        self.committer.waiting.add(kept=[encode_signed(name, t, keys.orders(name)) for name in keys.changed])
        keys.changed.clear()

    def _count_learned(self, monitor: FeederMonitor) -> None:
        known = monitor.commissioning.known
        if known is not None:
            self.metrics.learned.labels(monitor.name).set(np.isfinite(known.learned.at).sum())

    def _count_start(self, monitor: FeederMonitor) -> None:
        """Count and log the start of an observer."""
        observer, started = monitor.observer, monitor.observer.started
        if started is None:
            return
        observer.started = None
        self.metrics.observers.labels(monitor.name, started).inc()
        _log.info("the observer starts", feeder=monitor.name, state=started, problem=observer.note or None)

    def _guarded(self, monitor: FeederMonitor, run: Callable[[], T]) -> T | None:
        """Run a step of one feeder; a defect stops this feeder, visibly, and no other."""
        found: T | None = None
        try:
            found = run()
        except Exception as error:  # noqa: BLE001 - the other feeders stay monitored
            monitor.break_down(error)
        if monitor.defect is not None:
            _log.error("a feeder's monitor failed", feeder=monitor.name, exc_info=monitor.defect)
            monitor.defect = None
        return found

    def _note(self, problem: BadReading, sample: Sample) -> Rejected:
        self.metrics.bad.labels(problem.feeder or "", problem.reason).inc(problem.count)
        reason = f"{problem.reason}: {'; '.join(problem.problems)}"[:1000]
        return Rejected(sample.arrival, problem.key, reason, problem.head.encode())

    def _clock_off(self, reading: Reading, arrival: float) -> Rejected:
        self.metrics.bad.labels(reading.feeder, BadReason.CLOCK_OFF).inc()
        source = "substation" if reading.meter is None else f"meter/{reading.meter}"
        key = f"{self.config.prefix}/{reading.feeder}/{source}/reading"
        reason = f"{BadReason.CLOCK_OFF}: t = {reading.t:.3f} is too far from now"
        return Rejected(arrival, key, reason, head_of(reading).encode())

    def _count_stored(self, reports: tuple[Kept, ...]) -> None:
        for report in reports:
            self._count_delay(report.feeder, report.t)

    def _count_delay(self, feeder: str, t: float) -> None:
        if self.config.clock is Clock.WALL:
            self.metrics.count_delay(feeder, max(0.0, self._wall() - t))

    # ---------------------------------------------------------------- publishing

    def _publish_estimates(self, results: list[TickResult]) -> None:
        if self.committer.publisher is None or not self.config.acts():
            return
        for result in results:
            name = result.state.feeder
            owned = self.config.ownership(name)
            text = result.state.text if owned is None else partial(_stamped, result.state, owned)
            self.committer.publisher.telemetry(f"{name}/estimate", text)
        self.metrics.count_bus(self.committer.publisher.counts)

    # ---------------------------------------------------------------- operators

    def acknowledge(
        self, alarm_id: str, who: str, comment: str, *, count: int | None = None
    ) -> Future[Alarm]:
        """Acknowledge an alarm. The result is the stored alarm; the book follows after the commit.

        Repeating the same acknowledgement of the same occurrence gives the same result.

        `count` is the occurrence; None: the latest. Raises AlarmUnknown, RaisedAgain, AlreadyAcknowledged,
        StoreUnavailable if it cannot be acknowledged, at once or as the result; nothing is changed then.
        Raises OutcomeUnknown: as the result, if it is not known to be stored.
        """
        answer: Future[Alarm] = Future()
        t = self._wall()

        def store(alarm: Alarm | None) -> None:
            if alarm is None:
                raise AlarmUnknown(alarm_id)
            occurrence = alarm.count if count is None else count
            if (alarm.acknowledged_by, alarm.comment, alarm.count) == (who, comment, occurrence):
                answer.set_result(alarm)
                return
            transition = acknowledged(alarm, who, comment, t, count=count)

            def landed() -> Alarm:
                self.carry_over(transition.alarm)
                return transition.alarm

            self.committer.store(Wish((transition,)), _landing(answer, landed), partial(_refuse, answer))

        books = (alarm for monitor in self.monitors.values() for alarm in monitor.book.alarms)
        held = next((alarm for alarm in books if alarm.id == alarm_id), None)
        if held is None:
            self.committer.look(lambda db: db.alarm(alarm_id), _then(answer, store), partial(_refuse, answer))
        else:
            store(held)
        return answer

    def carry_over(self, alarm: Alarm) -> None:
        """Copy a stored acknowledgement, or its withdrawal, to the book and to later results."""
        self.committer.waiting.carry(alarm)
        monitor = self.monitors.get(alarm.feeder)
        if monitor is None:
            return
        if (book := carry(monitor.book, alarm)) is not None:
            monitor.book = book
        else:
            _log.info("the acknowledged occurrence is over", feeder=alarm.feeder, id=alarm.id)

    def recommission(
        self, name: str, meters: Sequence[str], who: str, reason: str
    ) -> Future[CommissioningProgress]:
        """Restart the learning of meters' errors. The result is the stored progress.

        `meters` is empty for all. Raises FeederUnknown, NothingToLearn, StoreUnavailable if it is not
        possible, at once or as the result; nothing is changed then. Raises OutcomeUnknown: as in
        `acknowledge`.
        """
        answer: Future[CommissioningProgress] = Future()
        monitor = self.monitors.get(name)
        if monitor is None:
            raise FeederUnknown(name)
        t = self._wall() if monitor.book.t is None else monitor.book.t
        take_back = monitor.recommission(meters, t, who, reason)
        kept, happened = monitor.commissioning.due()
        kept, wanted = (*kept, *monitor.suspicions.due()), happened[-1:]
        take_back()

        def landed() -> CommissioningProgress:
            # Ticks since then have changed the state: the restart is repeated from the present state, stored
            # with the next batch.
            monitor.recommission(meters, t, who, reason)
            kept, happened = monitor.commissioning.due()
            kept = (*kept, *monitor.suspicions.due())
            self.committer.waiting.add(kept=kept, happened=happened[:-1])
            for one in wanted:
                _say(one)
            self._count_learned(monitor)
            return monitor.commissioning.progress()

        wish = Wish(kept=kept, happened=wanted)
        self.committer.store(wish, _landing(answer, landed), partial(_refuse, answer))
        return answer


def _stamped(state: TickState, owned: Ownership) -> bytes:
    """Report as JSON text, with its owner and epoch."""
    owner = msgspec.json.encode({"owner": owned.worker, "epoch": owned.epoch})
    return state.text().rstrip()[:-1] + b"," + owner[1:]


def _then(answer: Future[Any], store: Callable[[T], None]) -> Callable[[T], None]:
    """Return the second step of a command; its errors become the command's result."""

    def run(found: T) -> None:
        try:
            store(found)
        except GridsecError as error:
            _refuse(answer, error)

    return run


def _landing(answer: Future[T], run: Callable[[], T]) -> Callable[[], None]:
    """Return the last step of a command; it sets the result unless the outcome was reported as unknown."""

    def landed() -> None:
        result = run()
        if not answer.done():
            answer.set_result(result)

    return landed


def _refuse(answer: Future[Any], error: GridsecError) -> None:
    if not answer.done():
        answer.set_exception(error)


def _say(happened: CommissioningEvent) -> None:
    """Log a change of a commissioning."""
    _log.info(
        "commissioning",
        feeder=happened.feeder,
        change=str(happened.change),
        meters=len(happened.meters),
        who=happened.who,
        reason=happened.reason or None,
        t=happened.t,
    )
