"""Queue of data for the database, and its committer: alarm transitions are stored, then published on zenoh.

The results of a round are collected in `WriteQueue` and passed to `apart`, which the runtime sets to a
separate thread with the wall clock. One write is in progress at a time. After a failed write its contents are
kept and written again. Alarms are published after they are stored, not before.

A command stores a `Wish` in the same way and gets the result between two rounds. A commit without an answer
is repeated with its key until the database confirms it.

Reports, bad readings and changes of commissionings are records: a full queue drops the oldest. Transitions
are state: beyond the limit, each alarm keeps its newest one, which contains its whole state. If that does not
suffice, alarms are dropped that were raised and cleared without the database. Active alarms, alarms that are
active in the database and acknowledgements are kept in any case; their number is bounded by a few alarms for
each meter.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any, Protocol, TypeVar

import msgspec
import structlog

from service.alarms.incidents import Action, Incident, IncidentEvent, event_json
from service.alarms.state_machine import Alarm, AlarmTransition, Change, carried
from service.alarms.state_machine import to_json as alarm_json
from service.ingest.queues import BusCounts, StoredEvent, Value
from service.metrics import Metrics
from service.report.report import Kept
from service.store import AlarmEvent, OutcomeUnknown, Rejected, Store, StoreUnavailable
from service.store.schema import CommissioningEvent, LeaseLost
from service.store.state_codec import SnapshotKind, StateSnapshot
from service.store.store import Reader

TRANSITIONS_KEPT = 10_000
"""Number of waiting transitions beyond which they are thinned out."""
RECORDS_KEPT = 3600
"""Largest number of waiting records of each kind; a full queue drops the oldest."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Batch:
    """Contents of one transaction."""

    transitions: tuple[AlarmTransition, ...] = ()
    reports: tuple[Kept, ...] = ()
    rejected: tuple[Rejected, ...] = ()
    kept: tuple[StateSnapshot, ...] = ()
    happened: tuple[CommissioningEvent, ...] = ()

    def __bool__(self) -> bool:
        """True if it has any contents."""
        return any((self.transitions, self.reports, self.rejected, self.kept, self.happened))


class WriteQueue:
    """Queue of data that wait for the database. Used by one thread at a time.

    given_up: transitions dropped since the last successful write.
    forgotten: called with the kind (a label) and the number of dropped data.
    """

    def __init__(self, forgotten: Callable[[str, int], None]) -> None:
        self.given_up = 0
        self._forgotten = forgotten
        self._transitions: list[AlarmTransition] = []
        self._reports: deque[Kept] = deque()
        self._rejected: deque[Rejected] = deque()
        self._kept: dict[tuple[str, SnapshotKind], StateSnapshot] = {}
        self._happened: deque[CommissioningEvent] = deque()
        # Alarms that are not in the database; those of the batch in progress may be stored at any moment.
        self._unheard: set[str] = set()
        self._on_the_way: set[str] = set()
        self._taken = 0
        self._thin_at = TRANSITIONS_KEPT

    def __len__(self) -> int:
        """Number of waiting transitions, including those of the batch in progress."""
        return len(self._transitions) + self._taken

    def add(
        self,
        *,
        transitions: Iterable[AlarmTransition] = (),
        reports: Iterable[Kept] = (),
        rejected: Iterable[Rejected] = (),
        kept: Iterable[StateSnapshot] = (),
        happened: Iterable[CommissioningEvent] = (),
    ) -> None:
        """Add data."""
        for item in transitions:
            if item.change is Change.RAISED and item.alarm.count == 1:
                self._unheard.add(item.alarm.id)
            self._transitions.append(item)
        self._reports.extend(reports)
        self._rejected.extend(rejected)
        self._kept.update(((item.feeder, item.matter), item) for item in kept)
        self._happened.extend(happened)
        self._bound()

    def take(self) -> Batch:
        """Remove and return all data; `stored` or `give_back` must follow."""
        batch = Batch(
            tuple(self._transitions),
            tuple(self._reports),
            tuple(self._rejected),
            tuple(self._kept.values()),
            tuple(self._happened),
        )
        self._transitions.clear()
        self._reports.clear()
        self._rejected.clear()
        self._kept.clear()
        self._happened.clear()
        self._unheard, self._on_the_way = set(), self._unheard
        self._taken = len(batch.transitions)
        return batch

    def stored(self) -> None:
        """Confirm that the batch of `take` is stored."""
        self._on_the_way = set()
        self._taken = 0
        self.given_up, self._thin_at = 0, TRANSITIONS_KEPT

    def give_back(self, batch: Batch) -> None:
        """Put a batch that was not stored before all later data."""
        self._unheard |= self._on_the_way
        self._on_the_way = set()
        self._taken = 0
        self._transitions[:0] = batch.transitions
        self._reports.extendleft(reversed(batch.reports))
        self._rejected.extendleft(reversed(batch.rejected))
        # Only the newest text of each feeder and subject is needed.
        self._kept = {(item.feeder, item.matter): item for item in batch.kept} | self._kept
        self._happened.extendleft(reversed(batch.happened))
        self._bound()

    def carry(self, answered: Alarm) -> None:
        """Copy a stored acknowledgement to the transitions collected since the start of its write."""
        self._transitions = [replace(item, alarm=carried(item.alarm, answered)) for item in self._transitions]

    def forget(self, feeder: str) -> None:
        """Drop all data of a feeder: its stored removal is its last change."""
        self.keep(lambda name: name != feeder)

    def keep(self, wanted: Callable[[str], bool]) -> None:
        """Drop the data of all other feeders."""
        self._transitions = [item for item in self._transitions if wanted(item.alarm.feeder)]
        self._reports = deque(item for item in self._reports if wanted(item.feeder))
        self._kept = {key: item for key, item in self._kept.items() if wanted(item.feeder)}
        self._happened = deque(item for item in self._happened if wanted(item.feeder))

    def _bound(self) -> None:
        self._drop_oldest(self._reports, "report")
        self._drop_oldest(self._rejected, "bad-reading")
        self._drop_oldest(self._happened, "commissioning")
        if len(self._transitions) > self._thin_at:
            before = len(self._transitions)
            most = TRANSITIONS_KEPT * 3 // 4
            self._thin(most)
            gone = before - len(self._transitions)
            self.given_up += gone
            self._forgotten("transition", gone)
            left = len(self._transitions)
            self._thin_at = TRANSITIONS_KEPT if left <= most else max(TRANSITIONS_KEPT, 2 * left)

    def _drop_oldest(self, queue: deque[T], what: str) -> None:
        over = len(queue) - RECORDS_KEPT
        for _ in range(over):
            queue.popleft()
        if over > 0:
            self._forgotten(what, over)

    def _thin(self, most: int) -> None:
        newest = {item.alarm.id: index for index, item in enumerate(self._transitions)}
        kept = [
            item
            for index, item in enumerate(self._transitions)
            if newest[item.alarm.id] == index or item.change is Change.ACKNOWLEDGED
        ]
        passed = [
            item.alarm.id
            for item in kept
            if item.alarm.id in self._unheard and not item.alarm.active and item.alarm.acknowledged_by is None
        ]
        gone = set(passed[: max(0, len(kept) - most)])
        self._unheard -= gone
        self._transitions = [item for item in kept if item.alarm.id not in gone]


# --- Committer ---


RETRY_S = 1.0
SLOW_S = 15.0
"""Duration of a write, s, beyond which it is reported to the operator."""
OUTBOX_PAGE = 1000
"""Number of events in one read of the outbox."""
UNPUBLISHED_KEPT = 10_000
"""Largest number of stored events in memory before zenoh; the others are read from the outbox later."""
_log = structlog.get_logger("gridsec.keeper")


class Publisher(Protocol):
    """Destination of estimates and alarms, such as `zenoh_bus.Bus`."""

    failure: str | None
    counts: BusCounts

    def telemetry(self, key: str, payload: Value) -> None:
        """Publish the newest value of a key."""

    def event(
        self,
        key: str,
        payload: bytes,
        *,
        last: bool,
        number: int,
        done: Callable[[], None] | None = None,
    ) -> bool:
        """Publish an event that must not be lost; False if the queue is full."""

    def answer(self, key: str, payload: bytes) -> None:
        """Store the reply to queries for a key."""

    def withdraw(self, feeder: str) -> None:
        """Remove the replies to queries for all keys of a feeder."""


@dataclass(frozen=True, slots=True)
class Wish:
    """Contents of a command's write: all of it is stored, or the command fails."""

    # transitions, kept, happened, without, put, actions: as in `Store.commit`.
    transitions: tuple[AlarmTransition, ...] = ()
    kept: tuple[StateSnapshot, ...] = ()
    happened: tuple[CommissioningEvent, ...] = ()
    without: str | None = None
    put: tuple[str, Mapping[str, Any]] | None = None
    actions: tuple[Action, ...] = ()


@dataclass(frozen=True, slots=True)
class Command:
    """Command part of a job."""

    wish: Wish
    read: Callable[[Store], Any]  # called after the commit, in the writing thread
    landed: Callable[[Any], None]  # called between two rounds after it is stored, with the result of `read`
    # Called between two rounds if it is not stored, or its outcome is unknown; `landed` may follow the
    # latter.
    refused: Callable[[StoreUnavailable], None]


@dataclass(frozen=True, slots=True)
class WriteJob:
    """One write: data, published events, and the next part of the outbox."""

    key: int
    batch: Batch
    now: float = 0.0  # wall clock, Unix s
    published: tuple[int, ...] = ()
    probe: bool = False
    page_after: int | None = None
    incidents: tuple[int, ...] = ()  # published events of incidents
    incidents_after: int = 0  # newest event of an incident that was read for publication
    command: Command | None = None

    @property
    def transitions(self) -> tuple[AlarmTransition, ...]:
        """All transitions, in the order of their event numbers."""
        own = () if self.command is None else self.command.wish.transitions
        return (*self.batch.transitions, *own)


@dataclass(frozen=True, slots=True)
class WriteResult:
    """Result of a job: event numbers of a stored one, values read, or the error."""

    numbers: tuple[int, ...] | None = None
    # Unpublished events of feeders that this process has taken over from another one.
    taken: tuple[tuple[AlarmEvent, ...], tuple[IncidentEvent, ...]] = ((), ())
    marked: bool = False
    page: tuple[AlarmEvent, ...] | None = None
    incidents: tuple[IncidentEvent, ...] = ()
    incidents_after: int | None = None  # number until which they are read
    incidents_marked: bool = False
    found: Any = None
    error: StoreUnavailable | None = None


Executor = Callable[[Callable[[], WriteResult], Callable[[WriteResult], None]], None]


def inline(write: Callable[[], WriteResult], then: Callable[[WriteResult], None]) -> None:
    """Write, and process the result, before returning."""
    then(write())


class Committer:
    """Writes alarm transitions to the database, then publishes them on zenoh.

    waiting: data that wait for the database.
    publisher: destination of alarms, or None.
    problem, public: reason why the database cannot be used, or None; the sentence of it for clients.
    storing: True while a write is in progress; only `waiting` and `commit` may be used then.
    metrics: counters of failures and transitions.
    stored: called after alarms have been stored.
    kept: called with the stored reports.
    apart: executor of writes: called with the write, for any thread, and with the handler of its result, for
        the time between two rounds.
    """

    def __init__(
        self,
        store: Store,
        metrics: Metrics,
        stored: Callable[[], None],
        kept: Callable[[tuple[Kept, ...]], None],
        apart: Executor = inline,
        *,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.waiting = WriteQueue(lambda what, count: metrics.forgotten.labels(what).inc(count))
        self.publisher: Publisher | None = None
        self.problem: str | None = None
        self.public = ""
        self.storing = False
        self._store = store
        self._metrics = metrics
        self._stored, self._kept = stored, kept
        self._apart, self._wall = apart, wall
        self._retry_at = self._began = 0.0
        self._keys = count(1)
        # A job with an unknown outcome; nothing else is stored before it.
        self._unknown: WriteJob | None = None
        self._published: deque[int] = deque()
        self._unpublished: deque[tuple[int, Alarm]] = deque()
        self._incidents_done: deque[int] = deque()
        self._incidents: deque[IncidentEvent] = deque()
        self._incidents_after = 0
        # The outbox has events after this number that are not in `_unpublished`; None: it has none.
        self._outbox_after: int | None = 0

    def commit(self, *, at_once: bool = False) -> None:
        """Start storing the collected data; after a failure they are kept and stored later.

        With `at_once` it skips the wait after a failure.
        """
        self._publish_waiting()
        if self.storing or (time.monotonic() < self._retry_at and not at_once):
            return
        job = self._unknown or self._job()
        due = self._store.due(job.now) or self._unread_incidents
        marks = job.published or job.incidents or job.page_after is not None
        if due or marks or job.batch or job.command or job.probe:
            self._send(job)

    @property
    def _unread_incidents(self) -> bool:
        """True if stored events of incidents wait for publication and there is room for them."""
        behind = self._store.last_incident_event > self._incidents_after
        return behind and len(self._incidents) < OUTBOX_PAGE

    @property
    def takes_commands(self) -> bool:
        """True if a command can be sent, or is refused at once: the database is unavailable."""
        return self.problem is not None or not self.storing

    def store(
        self, wish: Wish, landed: Callable[[], None], refused: Callable[[StoreUnavailable], None]
    ) -> None:
        """Start storing all collected data and a command's wish, all or nothing.

        Raises StoreUnavailable if the database is known to be unavailable; no call is made then.
        """
        self._command(Command(wish, lambda _: None, lambda _: landed(), refused))

    def store_and_read(
        self,
        wish: Wish,
        read: Callable[[Store], T],
        landed: Callable[[T], None],
        refused: Callable[[StoreUnavailable], None],
    ) -> None:
        """Start storing as in `store`, and a read after the commit."""
        self._command(Command(wish, read, landed, refused))

    def look(
        self,
        read: Callable[[Store], T],
        landed: Callable[[T], None],
        refused: Callable[[StoreUnavailable], None],
    ) -> None:
        """Start a read after all collected data are stored. Raises StoreUnavailable: as in `store`."""
        self._command(Command(Wish(), read, landed, refused))

    def _command(self, command: Command) -> None:
        if self.problem is not None:
            raise StoreUnavailable(self.problem, code="writes-fail")
        self._send(replace(self._job(), command=command))

    def _job(self) -> WriteJob:
        # Of released and lost feeders, nothing is stored any more.
        self.waiting.keep(self._store.mine)
        more = self._outbox_after is not None and len(self._unpublished) < OUTBOX_PAGE
        return WriteJob(
            next(self._keys),
            self.waiting.take(),
            self._wall(),
            tuple(self._published),
            probe=self.problem is not None,
            page_after=self._outbox_after if more else None,
            incidents=tuple(self._incidents_done),
            incidents_after=self._incidents_after,
        )

    def _send(self, job: WriteJob) -> None:
        self.storing, self._began = True, time.monotonic()
        self._metrics.unstored.set(len(self.waiting))
        self._apart(partial(_write, self._store, job), partial(self._written, job))

    def _written(self, job: WriteJob, done: WriteResult) -> None:
        """Process the result of a job."""
        self.storing, lost = False, isinstance(done.error, LeaseLost)
        self._take_over(job, done)
        if done.numbers is not None:
            self._unknown = None
            self.waiting.stored()
            self._kept(job.batch.reports)
            self._publish_stored(job.transitions, done.numbers)
        elif not lost and (isinstance(done.error, OutcomeUnknown) or job is self._unknown):
            self._unknown = job
        else:
            self._unknown = None
            self.waiting.give_back(job.batch)
        self._note_publication(job, done)
        if lost:
            _log.warning("leases are lost; the data of their feeders are dropped", problem=str(done.error))
        elif done.error is not None:
            self._refused(done.error)
        elif self.problem is not None:
            _log.info("the database is back")
            self.problem, self._retry_at = None, 0.0
        self._metrics.unstored.set(len(self.waiting))
        self._publish_waiting()
        if job.command is not None:
            self._answer(job.command, done)

    def _take_over(self, job: WriteJob, done: WriteResult) -> None:
        """Queue the unpublished events of feeders that this process has taken over from another one."""
        alarms, incidents = done.taken
        # Later ones are read from the outbox in their order.
        behind = math.inf if self._outbox_after is None else self._outbox_after
        self._unpublished.extend((event.seq, event.alarm) for event in alarms if event.seq <= behind)
        self._incidents.extend(event for event in incidents if event.seq <= job.incidents_after)

    def _note_publication(self, job: WriteJob, done: WriteResult) -> None:
        """Drop the marked events, and queue those that were read for publication."""
        if done.marked:
            for _ in job.published:
                self._published.popleft()
        if done.incidents_marked:
            for _ in job.incidents:
                self._incidents_done.popleft()
        if done.incidents_after is not None:
            self._incidents.extend(done.incidents)
            if done.incidents:
                self._stored()
            self._incidents_after = done.incidents_after
        if done.page is not None:
            self._unpublished.extend((event.seq, event.alarm) for event in done.page)
            full = len(done.page) == OUTBOX_PAGE
            self._outbox_after = done.page[-1].seq if full else None

    def _answer(self, command: Command, done: WriteResult) -> None:
        """Pass a command its result. Stored data stay stored, whatever failed afterwards."""
        if done.numbers is not None and (done.error is None or command.wish != Wish()):
            command.landed(done.found)
        elif done.error is not None:
            command.refused(done.error)

    def _publish_stored(self, transitions: tuple[AlarmTransition, ...], numbers: tuple[int, ...]) -> None:
        """Log stored transitions, and queue them for publication."""
        for number, transition in zip(numbers, transitions, strict=True):
            alarm = transition.alarm
            self.publish(number, alarm)
            self._metrics.transitions.labels(alarm.feeder, alarm.kind, transition.change).inc()
            _log.info(
                "alarm",
                change=str(transition.change),
                kind=str(alarm.kind),
                feeder=alarm.feeder,
                meter=alarm.meter,
                id=alarm.id,
                t=transition.t,
            )
        if numbers:
            self._stored()

    def _refused(self, error: StoreUnavailable) -> None:
        if self.problem is None or error.public != self.public:
            _log.error("the database cannot be used; alarms are kept and tried again", problem=str(error))
        self.problem, self.public = str(error), error.public
        self._retry_at = time.monotonic() + RETRY_S
        self._metrics.store_failures.inc()

    def problems(self) -> list[str]:
        """Return the problems of the database and their consequences, for the operator."""
        under_way = time.monotonic() - self._began if self.storing else 0.0
        if self.problem is None and under_way < SLOW_S:
            return []
        problems = [] if self.problem is None else [self.public]
        if under_way >= SLOW_S:
            problems.append(f"database: a write has been under way for {under_way:.0f} s")
        if waiting := len(self.waiting):
            problems.append(f"{waiting} changes of alarms wait for the database")
        if gone := self.waiting.given_up:
            problems.append(
                f"{gone} changes of alarms were dropped; the present state of active alarms is kept"
            )
        return problems

    def publish(self, number: int, alarm: Alarm) -> None:
        """Queue a stored event for publication, after earlier ones."""
        if self._outbox_after is not None:
            return  # It is read from the outbox in its order.
        if len(self._unpublished) >= UNPUBLISHED_KEPT:
            self._outbox_after = max(queued for queued, _ in self._unpublished)
        else:
            self._unpublished.append((number, alarm))

    def _publish_waiting(self) -> None:
        while self._unpublished:
            number, alarm = self._unpublished[0]
            done = partial(self._published.append, number)
            if not self._store.mine(alarm.feeder):
                pass  # Its worker publishes it.
            elif self.publisher is None:
                done()
            else:
                payload = msgspec.json.encode(alarm_json(alarm))
                key, last = alarm_key(alarm), not alarm.active
                if not self.publisher.event(key, payload, last=last, number=number, done=done):
                    return
            self._unpublished.popleft()
        while self._incidents:
            event = self._incidents[0]
            done = partial(self._incidents_done.append, event.seq)
            if not self._store.mine(event.incident.feeder):
                pass
            elif self.publisher is None:
                done()
            else:
                payload = msgspec.json.encode(event_json(event))
                key, last = incident_key(event.incident), not event.incident.open
                if not self.publisher.event(key, payload, last=last, number=event.seq, done=done):
                    return
            self._incidents.popleft()


def _write(store: Store, job: WriteJob) -> WriteResult:
    """Execute a job in any thread: it changes only the database, and raises nothing."""
    done = WriteResult()
    try:
        if job.probe:
            store.check()
        # Before the commit, which adds events.
        alarms, events = store.take_over()
        done = WriteResult(taken=(tuple(alarms), tuple(events)))
        batch, wish = job.batch, Wish() if job.command is None else job.command.wish
        numbers = store.commit(
            job.transitions,
            reports=batch.reports,
            rejected=batch.rejected,
            kept=(*batch.kept, *wish.kept),
            happened=(*batch.happened, *wish.happened),
            without=wish.without,
            put=wish.put,
            actions=wish.actions,
            now=job.now,
            key=job.key,
        )
        done = replace(done, numbers=numbers)
        if job.command is not None:
            done = replace(done, found=job.command.read(store))
        store.outbox_done(job.published)
        done = replace(done, marked=True)
        store.incidents_published(job.incidents)
        done = replace(done, incidents_marked=True)
        if store.last_incident_event > job.incidents_after:
            newest = store.last_incident_event
            events = store.incidents_unpublished(after=job.incidents_after, limit=OUTBOX_PAGE)
            read = events[-1].seq if len(events) == OUTBOX_PAGE else newest
            done = replace(done, incidents=tuple(events), incidents_after=read)
        if job.page_after is not None:
            page = store.outbox_pending(OUTBOX_PAGE, after=job.page_after)
            done = replace(done, page=tuple(page))
    except StoreUnavailable as error:
        return replace(done, error=error)
    except Exception as error:  # noqa: BLE001 - reported as the database's problem, and repeated
        _log.exception("storing failed")
        return replace(done, error=StoreUnavailable(f"{type(error).__name__}: {error}", code="defect"))
    return done


def incident_key(incident: Incident) -> str:
    """Return the zenoh key of an incident, without the prefix."""
    return f"{incident.feeder}/incident/{incident.id}"


def alarm_key(alarm: Alarm) -> str:
    """Return the zenoh key of an alarm, without the prefix."""
    return f"{alarm.feeder}/alarm/{alarm.id}"


def missed(store: Reader, kind: str, after: int, limit: int) -> list[StoredEvent]:
    """Return the stored events after a number for subscribers that missed them, oldest first.

    kind: `alarm` or `incident`, with the keys and payloads of their publication.
    Raises StoreUnavailable, with a sentence for clients, if the database cannot be read.
    """
    try:
        if kind == "alarm":
            return [
                StoredEvent(alarm_key(event.alarm), msgspec.json.encode(alarm_json(event.alarm)), event.seq)
                for event in store.events_after(after, limit=limit)
            ]
        return [
            StoredEvent(incident_key(event.incident), msgspec.json.encode(event_json(event)), event.seq)
            for event in store.incident_events_after(after, limit=limit)
        ]
    except StoreUnavailable as error:
        _log.warning("missed events cannot be read", problem=str(error))
        raise StoreUnavailable(error.public, code=error.code) from error
