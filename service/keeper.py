"""Storing and publishing alarms: in this order, without holding up whoever watches, and losing none.

What a round brings is gathered in `Waiting` and handed to `apart`, which the runtime sets to a thread of its
own where time does not wait; one write is on its way at a time. If the database refuses it, what it held is
kept and tried again. Alarms are published when they are stored, not before.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import msgspec
import structlog

from service.alarms import Alarm, Transition
from service.alarms import to_json as alarm_json
from service.bus import BusCounts
from service.commissioning import Happened
from service.kept import Kept
from service.metrics import Metrics
from service.report import FeederReport
from service.store import Event, Store, StoreUnavailable
from service.waiting import Batch, Waiting

RETRY_S = 1.0
SLOW_S = 15.0
"""A write that takes longer is told to the operator."""
OUTBOX_PAGE = 1000
"""So many events are read from the outbox at once."""
UNPUBLISHED_KEPT = 10_000
"""So many stored events wait in memory for zenoh; the others are read from the outbox later."""
_log = structlog.get_logger("gridsec.keeper")


class Publisher(Protocol):
    """Where estimates and alarms go; `ingest.Bus` is one."""

    failure: str | None
    counts: BusCounts

    def telemetry(self, key: str, payload: bytes) -> None:
        """Publish the newest value of a key."""

    def event(self, key: str, payload: bytes, *, last: bool, done: Callable[[], None] | None = None) -> bool:
        """Publish something that must not be lost; False if there is no room."""

    def answer(self, key: str, payload: bytes) -> None:
        """Let queries find a value."""

    def withdraw(self, key: str) -> None:
        """Let queries find nothing any more."""


@dataclass(frozen=True, slots=True)
class Job:
    """One visit to the database: what to store, what has been published, whether to read the outbox on."""

    batch: Batch
    published: tuple[int, ...] = ()
    probe: bool = False
    page_after: int | None = None
    without: str | None = None


@dataclass(frozen=True, slots=True)
class Done:
    """What came of a job: event numbers if the batch was stored, a page of the outbox, or what went wrong."""

    numbers: tuple[int, ...] | None = None
    marked: bool = False
    page: tuple[Event, ...] | None = None
    error: StoreUnavailable | None = None


Apart = Callable[[Callable[[], Done], Callable[[Done], None]], None]


def at_once(write: Callable[[], Done], then: Callable[[Done], None]) -> None:
    """Write, and take the outcome in, before going on.

    Parameters
    ----------
    write, then
        What to do, and who wants to know the outcome.
    """
    then(write())


class Keeper:
    """The way of alarms from the rounds to the database and from there to zenoh.

    Parameters
    ----------
    store
        The database.
    metrics
        Where failures and transitions are counted.
    stored
        Called after alarms have been stored.
    kept
        Called with the reports that have been stored.
    apart
        How writing is done apart from judging: called with what to do, in any thread, and with what to do
        with the outcome, between two rounds.

    Attributes
    ----------
    waiting
        What waits for the database.
    publisher
        Where alarms go; None: nowhere.
    problem
        Why the database cannot be used, or None.
    storing
        Whether a write is on its way; only `waiting` and `commit` may be used then.
    """

    def __init__(
        self,
        store: Store,
        metrics: Metrics,
        stored: Callable[[], None],
        kept: Callable[[tuple[FeederReport, ...]], None],
        apart: Apart = at_once,
    ) -> None:
        self.waiting = Waiting(lambda what, count: metrics.forgotten.labels(what).inc(count))
        self.publisher: Publisher | None = None
        self.problem: str | None = None
        self.storing = False
        self._store = store
        self._metrics = metrics
        self._stored, self._kept = stored, kept
        self._apart = apart
        self._retry_at = self._began = 0.0
        self._published: deque[int] = deque()
        self._unpublished: deque[tuple[int, Alarm]] = deque()
        # The outbox holds events after this number that are not in `_unpublished`; None: it holds none.
        self._outbox_after: int | None = 0

    def commit(self, *, at_once: bool = False) -> None:
        """Have what has been gathered stored; on failure it is kept and tried again later.

        Parameters
        ----------
        at_once
            Do not wait after a failure.
        """
        self._publish_waiting()
        if self.storing or (time.monotonic() < self._retry_at and not at_once):
            return
        more = self._outbox_after is not None and len(self._unpublished) < OUTBOX_PAGE
        job = Job(
            self.waiting.take(),
            tuple(self._published),
            probe=self.problem is not None,
            page_after=self._outbox_after if more else None,
        )
        if job.batch or job.published or job.probe or more:
            self.storing, self._began = True, time.monotonic()
            self._metrics.unstored.set(len(self.waiting))
            self._apart(partial(_write, self._store, job), partial(self._written, job))

    def store_now(
        self,
        more: tuple[Transition, ...] = (),
        *,
        kept: tuple[Kept, ...] = (),
        happened: tuple[Happened, ...] = (),
        without: str | None = None,
    ) -> None:
        """Commit everything gathered and what is given, all or nothing, before this returns.

        Parameters
        ----------
        more, kept, happened
            What is only wanted if it can be stored now.
        without
            Forget the tables of this feeder.

        Raises
        ------
        StoreUnavailable
            If nothing was stored. A database that is known to be away is not asked again.
        """
        if self.problem is not None:
            raise StoreUnavailable(self.problem)
        gathered = self.waiting.take()
        batch = replace(
            gathered,
            transitions=(*gathered.transitions, *more),
            kept=(*gathered.kept, *kept),
            happened=(*gathered.happened, *happened),
        )
        done = _write(self._store, Job(batch, without=without))
        self._written(Job(gathered if done.numbers is None else batch), done)
        if done.error is not None:
            raise done.error

    def _written(self, job: Job, done: Done) -> None:
        """Take in what came of a job."""
        self.storing = False
        if done.numbers is None:
            self.waiting.give_back(job.batch)
        else:
            self.waiting.stored()
            self._kept(job.batch.reports)
            self._tell(job.batch.transitions, done.numbers)
        if done.marked:
            for _ in job.published:
                self._published.popleft()
        if done.page is not None:
            self._unpublished.extend((event.seq, event.alarm) for event in done.page)
            full = len(done.page) == OUTBOX_PAGE
            self._outbox_after = done.page[-1].seq if full else None
        if done.error is not None:
            self._refused(done.error)
        elif self.problem is not None:
            _log.info("the database is back")
            self.problem, self._retry_at = None, 0.0
        self._metrics.unstored.set(len(self.waiting))
        self._publish_waiting()

    def _tell(self, transitions: tuple[Transition, ...], numbers: tuple[int, ...]) -> None:
        """Say what has been stored, and let it be published."""
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
        if self.problem is None:
            _log.error("the database cannot be used; alarms are kept and tried again", problem=str(error))
        self.problem = str(error)
        self._retry_at = time.monotonic() + RETRY_S
        self._metrics.store_failures.inc()

    def problems(self) -> list[str]:
        """Return what is wrong with the database and what that costs, for the operator."""
        under_way = time.monotonic() - self._began if self.storing else 0.0
        if self.problem is None and under_way < SLOW_S:
            return []
        problems = [] if self.problem is None else [f"database: {self.problem}"]
        if under_way >= SLOW_S:
            problems.append(f"database: a write has been under way for {under_way:.0f} s")
        if waiting := len(self.waiting):
            problems.append(f"{waiting} changes of alarms wait for the database")
        if gone := self.waiting.given_up:
            problems.append(f"{gone} changes of alarms were given up; what stands now is kept")
        return problems

    def publish(self, number: int, alarm: Alarm) -> None:
        """Let a stored event be published after those before it.

        Parameters
        ----------
        number, alarm
            The event's number, and the alarm as it was then.
        """
        if self._outbox_after is not None:
            return  # It is read from the outbox when its turn comes.
        if len(self._unpublished) >= UNPUBLISHED_KEPT:
            self._outbox_after = self._unpublished[-1][0]
        else:
            self._unpublished.append((number, alarm))

    def _publish_waiting(self) -> None:
        while self._unpublished:
            number, alarm = self._unpublished[0]
            done = partial(self._published.append, number)
            if self.publisher is None:
                done()
            else:
                payload = msgspec.json.encode(alarm_json(alarm))
                if not self.publisher.event(alarm_key(alarm), payload, last=not alarm.active, done=done):
                    return
            self._unpublished.popleft()


def _write(store: Store, job: Job) -> Done:
    """Do a job; called in any thread, it changes nothing but the database, and it always returns."""
    done = Done()
    try:
        if job.probe:
            store.check()
        batch = job.batch
        numbers = store.commit(
            batch.transitions,
            reports=batch.reports,
            rejected=batch.rejected,
            kept=batch.kept,
            happened=batch.happened,
            without=job.without,
        )
        done = Done(numbers)
        store.outbox_done(job.published)
        done = Done(numbers, marked=True)
        if job.page_after is not None:
            page = store.outbox_pending(OUTBOX_PAGE, after=job.page_after)
            done = replace(done, page=tuple(page))
    except StoreUnavailable as error:
        return replace(done, error=error)
    except Exception as error:  # noqa: BLE001 - shown to the operator as the database's problem, and tried again
        _log.exception("storing failed")
        return replace(done, error=StoreUnavailable(f"{type(error).__name__}: {error}"))
    return done


def alarm_key(alarm: Alarm) -> str:
    """Return the zenoh key of an alarm, without the prefix."""
    return f"{alarm.feeder}/alarm/{alarm.id}"
