"""The state of the service and what one round does to it: decode, align, estimate, alarm, store, publish.

Everything here is synchronous and called from one thread at a time; `runtime` sees to that. Readers on other
threads (REST, metrics) only ever take references to immutable reports.

If the database refuses a commit, watching goes on: transitions are kept and tried again, and alarms are
published when they are stored, not before.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

import msgspec
import structlog

from feeders.load import Site
from service.alarms import Alarm, AlarmRules, Transition, restore
from service.alarms import to_json as alarm_json
from service.align import Clock, Outcome
from service.bus import BusCounts, Sample
from service.metrics import Metrics
from service.reading import BadReading, BadReason, Reading, head_of
from service.report import FeederReport
from service.report import to_json as report_json
from service.store import Rejected, Store, StoreUnavailable
from service.watch import TickResult, Watch, align_rules, known_of
from service.wire import Wire

BAD_PER_ROUND = 50
"""So many bad readings of one round are stored; the others are only counted."""
RETRY_S = 1.0
RECORDS_KEPT = 3600
"""So many history rows and bad readings wait for a database that is away; then the oldest go, counted."""

T = TypeVar("T")
_log = structlog.get_logger("gridsec.runtime")


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


@dataclass(frozen=True, slots=True)
class RuntimeConfig:
    """How the service works, apart from its feeders.

    Attributes
    ----------
    prefix
        First chunks of every zenoh key.
    clock
        Who says what time it is.
    max_skew_s, grace_s
        As in `align.rules`; None: from the feeder's tick.
    max_payload
        Largest payload that is read, bytes.
    max_samples
        Length of the queue before the runtime.
    """

    prefix: str = "gridsec"
    clock: Clock = Clock.WALL
    max_skew_s: float | None = None
    grace_s: float | None = None
    max_payload: int = 256 * 1024
    max_samples: int = 20_000


class Rounds:
    """All state of the service.

    Parameters
    ----------
    config
        How the service works.
    store
        The database.
    sites
        The feeders to watch.
    wall
        The wall clock, Unix s.
    stored
        Called after alarms have been stored.
    """

    def __init__(
        self,
        config: RuntimeConfig,
        store: Store,
        sites: Iterable[Site],
        *,
        wall: Callable[[], float],
        stored: Callable[[], None],
    ) -> None:
        self.config = config
        self.store = store
        self.metrics = Metrics()
        self.publisher: Publisher | None = None
        self.watches: dict[str, Watch] = {}
        self.store_problem: str | None = None
        self._wall = wall
        self._stored = stored
        self._wire = Wire({}, config.prefix, config.max_payload)
        self._transitions: list[Transition] = []
        self._reports: deque[FeederReport] = deque(maxlen=RECORDS_KEPT)
        self._rejected: deque[Rejected] = deque(maxlen=RECORDS_KEPT)
        self._published: deque[int] = deque()
        self._unpublished: deque[tuple[int, Alarm]] = deque()
        self._retry_at = 0.0
        for site in sites:
            self.add(site)

    def add(self, site: Site) -> Watch:
        """Begin to watch a feeder, or begin anew with other tables; its alarms stay.

        Parameters
        ----------
        site
            The feeder.
        """
        config, name = self.config, site.feeder.name
        stored = self.store.active(name, cleared_since=self._wall() - AlarmRules().memory_s)
        rules = align_rules(site, config.clock, max_skew_s=config.max_skew_s, grace_s=config.grace_s)
        watch = Watch(site, rules, restore(name, stored))
        self.watches = {**self.watches, name: watch}
        known = {name: known_of(watch.site) for name, watch in self.watches.items()}
        self._wire = Wire(known, config.prefix, config.max_payload)
        return watch

    def begin(self) -> None:
        """Publish what an earlier process stored and did not publish; answer queries for what stands."""
        try:
            waiting = self.store.outbox_pending()
        except StoreUnavailable as error:
            self._refused(error)
            return
        if self.publisher is not None:
            for watch in self.watches.values():
                for alarm in watch.book.active:
                    self.publisher.answer(_alarm_key(alarm), msgspec.json.encode(alarm_json(alarm)))
        self._unpublished.extend((event.seq, event.alarm) for event in waiting)
        self._publish_alarms()

    # ---------------------------------------------------------------- one round

    def round(self, samples: list[Sample]) -> bool:
        """Take samples in, do what is due, store, publish.

        Parameters
        ----------
        samples
            In the order of arrival.

        Returns
        -------
        bool
            Whether there is a new report.
        """
        started = time.perf_counter()
        results: list[TickResult] = []
        bad: list[Rejected] = []
        for sample in samples:
            decoded = self._wire.decode(sample.key, sample.payload, sample.encoding, size=sample.size)
            bad.extend(self._note(problem, sample) for problem in decoded.bad)
            for reading in decoded.readings:
                results.extend(self._take(reading, sample, bad))
        now = self._wall()
        for watch in self.watches.values():
            skipped = watch.aligner.skipped
            results.extend(self._guarded(watch, partial(watch.due, now)))
            self.metrics.skipped.labels(watch.name).inc(watch.aligner.skipped - skipped)
        for rejected in bad[:BAD_PER_ROUND]:
            self._keep(self._rejected, rejected, "bad-reading")
        for result in results:
            self._keep(self._reports, result.report, "report")
            self._transitions.extend(result.transitions)
            self._count_tick(result.report, now)
        self.commit()
        self._publish_estimates(results)
        if samples or results:
            self.metrics.cycle.observe(time.perf_counter() - started)
        return bool(results)

    def _take(self, reading: Reading, sample: Sample, bad: list[Rejected]) -> list[TickResult]:
        watch = self.watches[reading.feeder]
        lost, skipped = watch.aligner.lost, watch.aligner.skipped

        def take() -> list[TickResult]:
            outcome, found = watch.take(reading, sample.arrival)
            self.metrics.readings.labels(watch.name, outcome).inc()
            if outcome is Outcome.CLOCK_OFF:
                bad.append(self._clock_off(reading, sample.arrival))
            return found

        results = self._guarded(watch, take)
        bad.extend(self._clock_off(refused, sample.arrival) for refused in watch.aligner.refused())
        self.metrics.lost.labels(watch.name).inc(watch.aligner.lost - lost)
        self.metrics.skipped.labels(watch.name).inc(watch.aligner.skipped - skipped)
        return results

    def _guarded(self, watch: Watch, run: Callable[[], list[TickResult]]) -> list[TickResult]:
        """Let a defect in one feeder's chain stop that feeder, visibly, and no other."""
        try:
            return run()
        except Exception as error:  # noqa: BLE001 - whatever it is, it must not blind the other feeders
            _log.exception("a feeder's monitor failed", feeder=watch.name)
            watch.fail(f"{type(error).__name__}: {error}")
            return []

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

    def _keep(self, queue: deque[T], item: T, what: str) -> None:
        if len(queue) == queue.maxlen:
            self.metrics.forgotten.labels(what).inc()
        queue.append(item)

    def _count_tick(self, report: FeederReport, now: float) -> None:
        metrics, name = self.metrics, report.feeder
        metrics.ticks.labels(name, report.verdict).inc()
        metrics.seen.labels(name).set(sum(meter.seen for meter in report.meters))
        metrics.suspects.labels(name).set(sum(meter.suspect for meter in report.meters))
        metrics.alarms.labels(name).set(len(self.watches[name].book.active))
        if self.config.clock is Clock.WALL:
            metrics.delay.labels(name).observe(max(0.0, now - report.t))

    # ---------------------------------------------------------------- storing

    def commit(self, *, at_once: bool = False) -> None:
        """Store what has been gathered; on failure keep it, say so, and try again later.

        Parameters
        ----------
        at_once
            Do not wait after a failure.
        """
        if time.monotonic() < self._retry_at and not at_once:
            return
        try:
            if self.store_problem is not None:
                self.store.check()
            self.store_all()
            done = tuple(self._published)
            if done:
                self.store.outbox_done(done)
                for _ in done:
                    self._published.popleft()
        except StoreUnavailable as error:
            self._refused(error)
        else:
            if self.store_problem is not None:
                _log.info("the database is back")
            self.store_problem, self._retry_at = None, 0.0
        self.metrics.unstored.set(len(self._transitions))
        self._publish_alarms()

    def store_all(self, more: tuple[Transition, ...] = ()) -> None:
        """Commit everything gathered and `more`, all or nothing.

        Parameters
        ----------
        more
            Transitions that are only wanted if they can be stored now.

        Raises
        ------
        StoreUnavailable
            If nothing was stored.
        """
        transitions = (*self._transitions, *more)
        numbers = self.store.commit(transitions, reports=tuple(self._reports), rejected=tuple(self._rejected))
        self._transitions.clear()
        self._reports.clear()
        self._rejected.clear()
        for number, transition in zip(numbers, transitions, strict=True):
            alarm = transition.alarm
            self._unpublished.append((number, alarm))
            self.metrics.transitions.labels(alarm.feeder, alarm.kind, transition.change).inc()
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
        if self.store_problem is None:
            _log.error("the database cannot be used; alarms are kept and tried again", problem=str(error))
        self.store_problem = str(error)
        self._retry_at = time.monotonic() + RETRY_S
        self.metrics.store_failures.inc()

    # ---------------------------------------------------------------- publishing

    def _publish_estimates(self, results: list[TickResult]) -> None:
        if self.publisher is None:
            return
        for result in results:
            key = f"{result.report.feeder}/estimate"
            self.publisher.telemetry(key, msgspec.json.encode(report_json(result.report)))
        self.metrics.count_bus(self.publisher.counts)

    def _publish_alarms(self) -> None:
        while self._unpublished:
            number, alarm = self._unpublished[0]
            done = partial(self._published.append, number)
            if self.publisher is None:
                done()
            else:
                payload = msgspec.json.encode(alarm_json(alarm))
                if not self.publisher.event(_alarm_key(alarm), payload, last=not alarm.active, done=done):
                    return
            self._unpublished.popleft()

    # ---------------------------------------------------------------- operators

    def acknowledge(self, alarm_id: str, who: str, comment: str) -> dict[str, Any]:
        """Answer an alarm; it is on the disk when this returns.

        Parameters
        ----------
        alarm_id, who, comment
            Which alarm, who answers it, and with what words.

        Raises
        ------
        AlarmUnknown, AlreadyAcknowledged, StoreUnavailable
            If it cannot be answered; nothing has changed then.
        """
        t = self._wall()
        for watch in self.watches.values():
            if all(alarm.id != alarm_id for alarm in watch.book.alarms):
                continue
            before = watch.book
            transitions = watch.acknowledge(alarm_id, who, comment, t)
            try:
                self.store_all(transitions)
            except StoreUnavailable:
                watch.book = before
                raise
            self._publish_alarms()
            return alarm_json(transitions[-1].alarm)
        alarm = self.store.acknowledge(alarm_id, who, comment, t).alarm
        self._unpublished.append((self.store.last_event, alarm))
        self._publish_alarms()
        self._stored()
        return alarm_json(alarm)


def _alarm_key(alarm: Alarm) -> str:
    return f"{alarm.feeder}/alarm/{alarm.id}"
