"""What Prometheus sees. One registry per service, so that several can live in one process."""

from __future__ import annotations

from dataclasses import asdict

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from service.bus import BusCounts

_STEP_BUCKETS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_DELAY_BUCKETS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0)


class Metrics:
    """The counters and gauges of one service; every name begins with `gridsec_`."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        registry = self._registry
        self.samples = Counter("gridsec_samples", "Payloads received over zenoh.", registry=registry)
        self.dropped = Counter(
            "gridsec_samples_dropped", "Payloads dropped because the queue was full.", registry=registry
        )
        self.readings = Counter(
            "gridsec_readings",
            "Well-formed readings, by what became of them.",
            ["feeder", "outcome"],
            registry=registry,
        )
        self.bad = Counter(
            "gridsec_bad_readings",
            "Readings that could not be used, by reason; no feeder if it is unknown.",
            ["feeder", "reason"],
            registry=registry,
        )
        self.lost = Counter(
            "gridsec_readings_lost",
            "Readings missing by their running numbers.",
            ["feeder"],
            registry=registry,
        )
        self.ticks = Counter("gridsec_ticks", "Ticks, by verdict.", ["feeder", "verdict"], registry=registry)
        self.skipped = Counter(
            "gridsec_ticks_skipped",
            "Ticks skipped because the backlog was too long.",
            ["feeder"],
            registry=registry,
        )
        self.seen = Gauge(
            "gridsec_meters_seen", "Meters seen at the latest tick.", ["feeder"], registry=registry
        )
        self.suspects = Gauge(
            "gridsec_suspects", "Meters under suspicion at the latest tick.", ["feeder"], registry=registry
        )
        self.learned = Gauge(
            "gridsec_meters_learned", "Meters whose own error is known.", ["feeder"], registry=registry
        )
        self.alarms = Gauge("gridsec_alarms_active", "Alarms that stand.", ["feeder"], registry=registry)
        self.transitions = Counter(
            "gridsec_alarm_transitions",
            "Stored alarm transitions.",
            ["feeder", "kind", "change"],
            registry=registry,
        )
        self.cycle = Histogram(
            "gridsec_cycle_seconds",
            "One round of the runtime: decode, align, estimate, store.",
            buckets=_STEP_BUCKETS,
            registry=registry,
        )
        self.delay = Histogram(
            "gridsec_report_delay_seconds",
            "Wall time from a tick to its stored report.",
            ["feeder"],
            buckets=_DELAY_BUCKETS,
            registry=registry,
        )
        self.queue = Gauge("gridsec_queue_length", "Payloads waiting for the runtime.", registry=registry)
        self.unstored = Gauge(
            "gridsec_transitions_unstored", "Alarm transitions waiting for the database.", registry=registry
        )
        self.store_failures = Counter(
            "gridsec_store_failures", "Commits that the database refused.", registry=registry
        )
        self.forgotten = Counter(
            "gridsec_records_forgotten",
            "What was given up because the database stayed away: reports, bad readings, transitions.",
            ["what"],
            registry=registry,
        )
        self.bus = Counter("gridsec_zenoh", "What went through zenoh.", ["what"], registry=registry)
        self._bus_before = asdict(BusCounts())

    def count_bus(self, counts: BusCounts) -> None:
        """Take over the counts of the zenoh bus.

        Parameters
        ----------
        counts
            Its running totals.
        """
        now = asdict(counts)
        for what, total in now.items():
            self.bus.labels(what.replace("_", "-")).inc(total - self._bus_before[what])
        self._bus_before = now

    def forget(self, feeder: str) -> None:
        """Show the present state of a feeder no more; what has been counted stays.

        Parameters
        ----------
        feeder
            Its name.
        """
        for gauge in (self.seen, self.suspects, self.learned, self.alarms):
            if (feeder,) in {tuple(sample.labels.values()) for m in gauge.collect() for sample in m.samples}:
                gauge.remove(feeder)

    def exposition(self) -> bytes:
        """Return everything in Prometheus's text format."""
        return generate_latest(self._registry)
