"""The state of the service and what one round does to it: decode, align, estimate, alarm, store, publish.

Everything here is synchronous and called from one thread at a time; `runtime` sees to that. Readers on other
threads (REST, metrics) only ever take references to immutable reports.

Nobody who watches waits for the database: see `keeper`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np
import structlog

from feeders.load import Site
from service.alarms import AlarmRules, close, restore
from service.alarms import to_json as alarm_json
from service.align import Clock, Outcome
from service.bus import Sample
from service.commissioning import Commissioning, Happened
from service.commissioning import to_json as commissioning_json
from service.crowd import some_of_each
from service.errors import FeederUnknown
from service.keeper import Apart, Keeper, alarm_key, at_once
from service.metrics import Metrics
from service.reading import HEAD_BYTES, BadReading, BadReason, Reading, beginning, head_of
from service.report import FeederReport
from service.report import to_json as report_json
from service.store import Rejected, Store, StoreUnavailable
from service.suspicions import Suspicions
from service.watch import TickResult, Watch, align_rules, known_of
from service.wire import Decoded, Wire

NOT_WATCHED = "the feeder is not watched any more"
TOLD_TWICE = "another alarm tells the same"

_log = structlog.get_logger("gridsec.runtime")


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
    max_feeders
        So many feeders may be put while it runs, besides those that were given at the start.
    """

    prefix: str = "gridsec"
    clock: Clock = Clock.WALL
    max_skew_s: float | None = None
    grace_s: float | None = None
    max_payload: int = 256 * 1024
    max_samples: int = 20_000
    max_feeders: int = 100


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
    apart
        How writing is done apart from judging: called with what to do, in any thread, and with what to do
        with the outcome, between two rounds.
    unloaded
        Feeders that are stored but cannot be loaded, and why.
    """

    def __init__(
        self,
        config: RuntimeConfig,
        store: Store,
        sites: Iterable[Site],
        *,
        wall: Callable[[], float],
        stored: Callable[[], None],
        apart: Apart = at_once,
        unloaded: Mapping[str, str] | None = None,
    ) -> None:
        self.config = config
        self.store = store
        self.metrics = Metrics()
        self.watches: dict[str, Watch] = {}
        self.unloaded = dict(unloaded or {})
        self.reported: dict[str, float] = {}
        self._wall, self._stored = wall, stored
        self.keeper = Keeper(store, self.metrics, stored, self._count_stored, apart)
        self._wire = Wire({}, config.prefix, config.max_payload)
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
        # Where the readings tell the time, that may be long ago; `advance` forgets what is too old.
        latest = min([self._wall(), *(tick["t"] for tick in self.store.history(name, limit=1))])
        stored = self.store.active(name, cleared_since=latest - AlarmRules().memory_s)
        rules = align_rules(site, config.clock, max_skew_s=config.max_skew_s, grace_s=config.grace_s)
        commissioning = Commissioning(site, self.store.commission(name))
        suspicions = Suspicions(site, self.store.distrust(name))
        book = restore(name, stored)
        watch = Watch(site, rules, book, commissioning, suspicions)
        held = {alarm.id for alarm in book.alarms}
        twice = [alarm for alarm in stored if alarm.id not in held]
        self.keeper.waiting.add(transitions=close(twice, self._wall(), TOLD_TWICE))
        self.watches = {**self.watches, name: watch}
        self.unloaded.pop(name, None)
        self._learn()
        return watch

    def remove(self, name: str) -> None:
        """Watch a feeder no more: its alarms are cleared, its tables forgotten, its history kept.

        Parameters
        ----------
        name
            Its name.

        Raises
        ------
        FeederUnknown, StoreUnavailable
            If there is none, or that cannot be stored; it is watched as before then.
        """
        watch = self.watches.get(name)
        if watch is None and name not in self.unloaded:
            raise FeederUnknown(name)
        standing = self.store.active(name) if watch is None else watch.book.active
        t = self._wall() if watch is None or watch.book.t is None else watch.book.t
        self.keeper.store_now(close(standing, t, NOT_WATCHED), without=name)
        self.unloaded.pop(name, None)
        self.watches = {other: kept for other, kept in self.watches.items() if other != name}
        self._learn()
        self.metrics.forget(name)
        if self.keeper.publisher is not None:
            self.keeper.publisher.withdraw(f"{name}/estimate")

    def _learn(self) -> None:
        known = {name: known_of(watch.site) for name, watch in self.watches.items()}
        self._wire = Wire(known, self.config.prefix, self.config.max_payload)

    def begin(self) -> None:
        """Answer queries for what stands; publish what an earlier process stored and did not publish.

        Alarms of feeders that are neither watched nor stored any more are cleared: nobody else would.
        """
        ours, t = self.watches.keys() | self.unloaded.keys() | self.store.feeders().keys(), self._wall()
        standing = self.store.active()
        left_out = [alarm for alarm in standing if alarm.feeder not in ours]
        self.keeper.waiting.add(transitions=close(left_out, t, NOT_WATCHED))
        if self.keeper.publisher is not None:
            for alarm in standing:
                if alarm.feeder in ours:
                    self.keeper.publisher.answer(alarm_key(alarm), msgspec.json.encode(alarm_json(alarm)))
        for name in self.unloaded:
            self.metrics.alarms.labels(name).set(sum(alarm.feeder == name for alarm in standing))
        self.keeper.commit()

    # ---------------------------------------------------------------- one round

    def round(self, samples: list[Sample], oldest: Callable[[], float | None] = lambda: None) -> bool:
        """Take samples in, do what is due, store, publish.

        Parameters
        ----------
        samples
            In the order of arrival.
        oldest
            Says when the oldest of those arrived that still wait, Unix s; None if none does.

        Returns
        -------
        bool
            Whether there is a new report.
        """
        started = time.perf_counter()
        results: list[TickResult] = []
        bad: list[Rejected] = []
        for sample in samples:
            decoded = self._decode(sample)
            bad.extend(self._note(problem, sample) for problem in decoded.bad)
            for reading in decoded.readings:
                results.extend(self._take(reading, sample, bad))
        now, waiting = self._wall(), oldest()
        # No tick goes without readings that only wait here.
        until = now if waiting is None else min(now, waiting)
        for watch in self.watches.values():
            skipped = watch.aligner.skipped
            results.extend(self._guarded(watch, partial(watch.due, until)))
            self.metrics.skipped.labels(watch.name).inc(watch.aligner.skipped - skipped)
        entries, left_out = some_of_each(bad)
        self.keeper.waiting.add(rejected=entries)
        self.metrics.forgotten.labels("bad-reading").inc(left_out)
        for result in results:
            self.keeper.waiting.add(transitions=result.transitions, reports=(result.report,))
            self._count_tick(result.report)
            self.reported[result.report.feeder] = time.monotonic()
        self.keep_states()
        self.keeper.commit()
        self._publish_estimates(results)
        if samples or results:
            self.metrics.cycle.observe(time.perf_counter() - started)
        return bool(results)

    def keep_states(self, *, at_once: bool = False) -> None:
        """Let what is known of the meters' errors, and who is not believed, be stored, where it is time.

        Parameters
        ----------
        at_once
            Also what could wait.
        """
        for watch in self.watches.values():
            kept, happened = watch.commissioning.due(at_once=at_once)
            self.keeper.waiting.add(kept=(*kept, *watch.suspicions.due()), happened=happened)
            for one in happened:
                _say(one)
            if happened:
                self._count_learned(watch)

    def _count_learned(self, watch: Watch) -> None:
        known = watch.commissioning.known
        if known is not None:
            self.metrics.learned.labels(watch.name).set(np.isfinite(known.learned.at).sum())

    def _decode(self, sample: Sample) -> Decoded:
        """Decode a payload; a defect of the decoder costs this payload and nothing else."""
        try:
            return self._wire.decode(sample.key, sample.payload, sample.encoding, size=sample.size)
        except Exception as error:  # noqa: BLE001 - whatever it is, one payload must not end the service
            problem = beginning(f"{type(error).__name__}: {error}")
            _log.error("a payload could not be decoded", key=sample.key[:HEAD_BYTES], problem=problem)
            head, key = head_of(sample.payload[:HEAD_BYTES]), beginning(sample.key)
            return Decoded(bad=(BadReading(BadReason.INTERNAL, (problem,), key, head=head),))

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
        results: list[TickResult] = []
        try:
            results = run()
        except Exception as error:  # noqa: BLE001 - whatever it is, it must not blind the other feeders
            watch.break_down(error)
        if watch.defect is not None:
            _log.error("a feeder's monitor failed", feeder=watch.name, exc_info=watch.defect)
            watch.defect = None
        return results

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

    def _count_stored(self, reports: tuple[FeederReport, ...]) -> None:
        if self.config.clock is Clock.WALL:
            now = self._wall()
            for report in reports:
                self.metrics.delay.labels(report.feeder).observe(max(0.0, now - report.t))

    def _count_tick(self, report: FeederReport) -> None:
        metrics, name = self.metrics, report.feeder
        metrics.ticks.labels(name, report.verdict).inc()
        metrics.seen.labels(name).set(sum(meter.seen for meter in report.meters))
        metrics.suspects.labels(name).set(len(report.suspects))
        metrics.alarms.labels(name).set(len(self.watches[name].book.active))

    # ---------------------------------------------------------------- publishing

    def _publish_estimates(self, results: list[TickResult]) -> None:
        if self.keeper.publisher is None:
            return
        for result in results:
            key = f"{result.report.feeder}/estimate"
            self.keeper.publisher.telemetry(key, msgspec.json.encode(report_json(result.report)))
        self.metrics.count_bus(self.keeper.publisher.counts)

    # ---------------------------------------------------------------- operators

    def acknowledge(
        self, alarm_id: str, who: str, comment: str, *, count: int | None = None
    ) -> dict[str, Any]:
        """Answer an alarm; it is on the disk when this returns.

        Parameters
        ----------
        alarm_id, who, comment
            Which alarm, who answers it, and with what words.
        count
            Which occurrence; None: whichever it is.

        Raises
        ------
        AlarmUnknown, RaisedAgain, AlreadyAcknowledged, StoreUnavailable
            If it cannot be answered; nothing has changed then.
        """
        t = self._wall()
        for watch in self.watches.values():
            if all(alarm.id != alarm_id for alarm in watch.book.alarms):
                continue
            before = watch.book
            transitions = watch.acknowledge(alarm_id, who, comment, t, count=count)
            try:
                self.keeper.store_now(transitions)
            except StoreUnavailable:
                watch.book = before
                raise
            return alarm_json(transitions[-1].alarm)
        if self.keeper.problem is not None:
            raise StoreUnavailable(self.keeper.problem)
        alarm = self.store.acknowledge(alarm_id, who, comment, t, count=count).alarm
        self.keeper.publish(self.store.last_event, alarm)
        self.keeper.commit()
        self._stored()
        return alarm_json(alarm)

    def recommission(self, name: str, meters: Sequence[str], who: str, reason: str) -> dict[str, Any]:
        """Learn meters' errors anew; it is on the disk when this returns.

        Parameters
        ----------
        name, meters, who, reason
            The feeder, which of its meters (none for all), who wants it, and why.

        Raises
        ------
        FeederUnknown, NothingToLearn, StoreUnavailable
            If that cannot be; nothing has changed then.
        """
        watch = self.watches.get(name)
        if watch is None:
            raise FeederUnknown(name)
        t = self._wall() if watch.book.t is None else watch.book.t
        take_back = watch.recommission(meters, t, who, reason)
        kept, happened = watch.commissioning.due()
        try:
            self.keeper.store_now(kept=(*kept, *watch.suspicions.due()), happened=happened)
        except StoreUnavailable:
            take_back()
            raise
        for one in happened:
            _say(one)
        self._count_learned(watch)
        return commissioning_json(watch.commissioning.progress())


def _say(happened: Happened) -> None:
    """Tell the log what happened to a commissioning."""
    _log.info(
        "commissioning",
        feeder=happened.feeder,
        change=str(happened.change),
        meters=len(happened.meters),
        who=happened.who,
        reason=happened.reason or None,
        t=happened.t,
    )
