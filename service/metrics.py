"""Metrics for Prometheus. One registry per service, so that a process can contain several."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from gridsec.estimators.front import LearningReason, LearningState
from gridsec.interface import Decision
from service.ingest.align import ReadingOutcome
from service.ingest.queues import BusCounts
from service.logs import LineLogger
from service.report.report import LearningReport
from service.report.tick_state import TickState

_STEP_BUCKETS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_DELAY_BUCKETS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0)


class Metrics:
    """Counters and gauges of one service; every name begins with `gridsec_`."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._bus_before = asdict(BusCounts())
        self._children: dict[tuple[Any, ...], Any] = {}
        self._shown: dict[str, tuple[int, ...]] = {}
        self._learning: dict[str, tuple[object, object]] = {}
        self._of_readings(self._registry)
        self._of_ticks(self._registry)
        self._of_storing(self._registry)
        self._of_notification(self._registry)

    def _of_readings(self, registry: CollectorRegistry) -> None:
        """Metrics of the input."""
        counter = partial(Counter, registry=registry)
        self.samples = counter("gridsec_samples", "Payloads received over zenoh.")
        self.dropped = counter("gridsec_samples_dropped", "Payloads dropped from a full or long queue.")
        self.readings = counter(
            "gridsec_readings", "Well-formed readings, by outcome.", ["feeder", "outcome"]
        )
        self.bad = counter(
            "gridsec_bad_readings",
            "Bad readings, by reason; without a feeder if it is unknown.",
            ["feeder", "reason"],
        )
        self.lost = counter(
            "gridsec_readings_lost", "Readings missing by their sequence numbers.", ["feeder"]
        )
        self.queue = Gauge("gridsec_queue_length", "Payloads waiting for the runtime.", registry=registry)
        self.bus = counter("gridsec_zenoh", "Operations on zenoh, by kind.", ["what"])

    def _of_ticks(self, registry: CollectorRegistry) -> None:
        """Metrics of the evaluation."""
        counter, gauge = partial(Counter, registry=registry), partial(Gauge, registry=registry)
        self.ticks = counter(
            "gridsec_ticks",
            "Ticks, by verdict; those passed over while shed are undecided.",
            ["feeder", "verdict"],
        )
        self.skipped = counter("gridsec_ticks_skipped", "Skipped ticks.", ["feeder"])
        self.observers = counter(
            "gridsec_observer_starts",
            "Starts of a feeder's observer of inverters, by its stored state: resumed, old, refused, new.",
            ["feeder", "state"],
        )
        self.seen = gauge("gridsec_meters_seen", "Available meters at the latest tick.", ["feeder"])
        self.suspects = gauge("gridsec_suspects", "Suspects at the latest tick.", ["feeder"])
        self.learned = gauge("gridsec_meters_learned", "Meters with a learned fixed error.", ["feeder"])
        self.learning = gauge("gridsec_meters_learning", "Meters by state of learning.", ["feeder", "state"])
        self.delayed = gauge(
            "gridsec_meters_learning_delayed", "Meters behind schedule, by reason.", ["feeder", "reason"]
        )
        self.alarms = gauge("gridsec_alarms_active", "Active alarms.", ["feeder"])
        self.shed = gauge("gridsec_feeders_shed", "Feeders displayed as not monitored because of overload.")
        self.cycle = Histogram(
            "gridsec_cycle_seconds",
            "One round of the runtime: decode, align, estimate, store.",
            buckets=_STEP_BUCKETS,
            registry=registry,
        )
        self.delay = Histogram(
            "gridsec_report_delay_seconds",
            "Wall time from a tick until its result is known and, if it is kept, stored.",
            ["feeder"],
            buckets=_DELAY_BUCKETS,
            registry=registry,
        )

    def _of_storing(self, registry: CollectorRegistry) -> None:
        """Metrics of the database and the log."""
        counter = partial(Counter, registry=registry)
        self.transitions = counter(
            "gridsec_alarm_transitions", "Stored alarm transitions.", ["feeder", "kind", "change"]
        )
        self.unstored = Gauge(
            "gridsec_transitions_unstored", "Alarm transitions waiting for the database.", registry=registry
        )
        self.store_failures = counter("gridsec_store_failures", "Commits that the database refused.")
        self.forgotten = counter(
            "gridsec_records_forgotten",
            "Dropped records: reports, bad readings and transitions while the database is unavailable, "
            "and bad readings beyond the limit of a round.",
            ["what"],
        )
        unwritten = Gauge(
            "gridsec_log_lines_lost", "Lines of the log that could not be written.", registry=registry
        )
        unwritten.set_function(lambda: LineLogger.lost)

    def _of_notification(self, registry: CollectorRegistry) -> None:
        """Metrics of webhooks and of Alertmanager."""
        gauge = partial(Gauge, registry=registry)
        self.notified = Counter(
            "gridsec_notifications",
            "Messages by outcome: delivered, failed (an attempt), dead (given up), resent.",
            ["target", "outcome"],
            registry=registry,
        )
        self.notices_waiting = gauge(
            "gridsec_notifications_waiting", "Events that a target has not received yet.", ["target"]
        )
        self.dead_letters = gauge("gridsec_dead_letters", "Messages that were given up.", ["target"])
        self.notify_failing = gauge(
            "gridsec_notification_failing_seconds",
            "Time since the first failed request after the last success.",
            ["target"],
        )

    def count_bus(self, counts: BusCounts) -> None:
        """Update from the counters of the zenoh bus."""
        now = asdict(counts)
        for what, total in now.items():
            self.bus.labels(what.replace("_", "-")).inc(total - self._bus_before[what])
        self._bus_before = now

    def count_readings(self, feeder: str, counts: Mapping[ReadingOutcome, int]) -> None:
        """Count well-formed readings by outcome."""
        for outcome, count in counts.items():
            self._child(self.readings, feeder, outcome.value).inc(count)

    def count_lost(self, feeder: str, count: int) -> None:
        """Count readings that are missing by their sequence numbers."""
        self._child(self.lost, feeder).inc(count)

    def count_delay(self, feeder: str, delay_s: float) -> None:
        """Count the time from a tick to its result."""
        self._child(self.delay, feeder).observe(delay_s)

    def count_passed_over(self, feeder: str, count: int) -> None:
        """Count ticks of a shed feeder that are not formed."""
        if count:
            self._child(self.ticks, feeder, Decision.UNDECIDED.value).inc(count)

    def count_tick(self, state: TickState, alarms: int) -> None:
        """Count a tick and those passed over before it, and show its numbers.

        `alarms` is the number of active alarms of its feeder. Gauges are set when they change.
        """
        feeder = state.feeder
        self._child(self.ticks, feeder, state.verdict.value).inc()
        self.count_passed_over(feeder, state.tick.passed_over)
        gauges = (self.seen, self.suspects, self.alarms)
        self._show(feeder, gauges, (int(np.count_nonzero(state.tick.seen)), len(state.suspects), alarms))
        self.count_learning(feeder, state.learning)

    def count_learning(self, feeder: str, learning: LearningReport | None) -> None:
        """Count a feeder's meters by state and reason of learning; unchanged at a tick without a monitor."""
        if learning is None or self._learning.get(feeder) == (learning.states, learning.reasons):
            return
        self._learning[feeder] = learning.states, learning.reasons
        for one in LearningState:
            self.learning.labels(feeder, one).set(learning.states.count(one))
        for reason in LearningReason:
            self.delayed.labels(feeder, reason).set(learning.reasons.count(reason))

    def active(self, feeder: str) -> int:
        """Return the number of active alarms at the latest tick of a feeder."""
        return self._shown[feeder][-1] if feeder in self._shown else 0

    def _show(self, feeder: str, gauges: tuple[Gauge, ...], now: tuple[int, ...]) -> None:
        if self._shown.get(feeder) != now:
            self._shown[feeder] = now
            for gauge, value in zip(gauges, now, strict=True):
                gauge.labels(feeder).set(value)

    def _child(self, metric: Any, *labels: str) -> Any:
        """The metric with these labels; `labels()` of the library costs as much as counting some readings."""
        key = (metric, *labels)
        child = self._children.get(key)
        if child is None:
            child = self._children[key] = metric.labels(*labels)
        return child

    def forget(self, feeder: str) -> None:
        """Remove the gauges of a feeder; counters stay."""
        self._shown.pop(feeder, None)
        self._learning.pop(feeder, None)
        for gauge in (self.seen, self.suspects, self.learned, self.learning, self.delayed, self.alarms):
            for labels in [sample.labels for m in gauge.collect() for sample in m.samples]:
                if labels["feeder"] == feeder:
                    gauge.remove(*labels.values())

    def exposition(self) -> bytes:
        """Return everything in Prometheus's text format."""
        return generate_latest(self._registry)
