"""Result of one tick of a feeder, from which its report is built on request.

A calm tick needs no report: nothing is stored or published of it unless it is asked for.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from feeders.model.site import Site, volts
from gridsec.arrays import Bools, Floats, any_of
from gridsec.interface import Cause, Decision, Estimate, Verdict
from service.ingest.align import Tick
from service.ingest.reading import V_VOLT
from service.report.data_errors import DataErrorReport
from service.report.report import (
    BUSBAR,
    DisplayedVerdict,
    FeederReport,
    KeptTick,
    LearningReport,
    ReferenceVoltages,
    Silence,
    blind,
    build,
    busbar_report,
    explanations,
    finite,
    grounds,
    history_row,
    in_words,
    inverter_states,
    meter_states,
    reason_of,
    std_volts,
    to_text,
    with_data_error,
    with_learning,
)

MOST_SILENT = 0.5
"""Share of a feeder's meters beyond which their silence is one condition of the feeder."""
FEW_METERS = 3
"""Number of silent meters below which each one has its own condition."""


@dataclass(frozen=True, slots=True)
class MeterCounts:
    """Numbers of a feeder's meters.

    total: all meters of customers.
    unread: those without a usable reading.
    """

    total: int
    unread: int

    def mostly(self, count: int) -> bool:
        """True if a number of meters is most of the feeder's."""
        return count >= FEW_METERS and count > MOST_SILENT * self.total


@dataclass(frozen=True, eq=False)
class TickState:
    """Result of one tick. It is immutable: any thread may build its report."""

    site: Site
    tick: Tick
    max_attacked: int  # M of the design
    cause: Cause
    # Reason at a tick without a monitor; empty: that of the judgement.
    reason: str = ""
    # estimate, judgement: output of the estimator; None at a tick without a monitor.
    estimate: Estimate | None = None
    judgement: Verdict | None = None
    learning: LearningReport | None = None  # learning of the meters; None at a tick without a monitor
    data_error: DataErrorReport | None = None  # error of the files that explains accused meters
    # revision, t_measured, since: as in `FeederReport`.
    revision: str = ""
    t_measured: float | None = None
    since: float | None = None
    # Newest tick with the displayed verdict, and the start of the time that led to it, Unix s.
    displayed: tuple[TickState, float] | None = None

    @property
    def skipped(self) -> int:
        """Number of skipped ticks directly before."""
        return self.tick.skipped

    @property
    def feeder(self) -> str:
        """Name of the feeder."""
        return self.site.feeder.name

    @property
    def t(self) -> float:
        """Unix time of the tick, s."""
        return self.tick.t

    @property
    def verdict(self) -> Decision:
        """Verdict."""
        return Decision.UNDECIDED if self.judgement is None else self.judgement.decision

    @property
    def suspects(self) -> tuple[str, ...]:
        """Meters that the verdict names as manipulated, as in `FeederReport`."""
        if self.judgement is None:
            return ()
        named = tuple(self.site.meter_ids[k] for k in np.flatnonzero(self.judgement.suspects))
        return (*named, BUSBAR) if self.judgement.busbar.any() else named

    @property
    def inverters(self) -> int:
        """Number of inverters that the verdict names as manipulated."""
        judgement = self.judgement
        if judgement is None or not judgement.inverters.size:
            return 0
        judged = ~judgement.unjudged if judgement.unjudged.size else True
        return int(np.count_nonzero(judgement.inverters & judged))

    @property
    def counts(self) -> MeterCounts:
        """Numbers of meters and of those without a usable reading."""
        seen = self.tick.seen
        return MeterCounts(seen.size, seen.size - int(np.count_nonzero(seen)))

    @property
    def model_only(self) -> bool:
        """True if no value uses a voltage reading of this tick."""
        return not any_of(self.grounds.measured)

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """Numbers of the list of feeders."""
        shown = self.displayed
        return {
            "t": self.t,
            "verdict": self.verdict,
            "model_only": self.model_only,
            "since": self.since,
            "displayed_verdict": None if shown is None else shown[0].verdict,
            "displayed_since": None if shown is None else shown[1],
            "cause": self.cause if shown is None else shown[0].cause,
            "t_measured": self.t_measured,
            "meters": len(self.site.meter_ids),
            "suspects": len(self.suspects) + self.inverters,
            "silent": sum(meter is not None for meter, _ in self.tick.silent),
        }

    @cached_property
    def grounds(self) -> ReferenceVoltages:
        """Readings that the values use."""
        return grounds(self.site, self.tick, self.estimate, self.judgement)

    @cached_property
    def report(self) -> FeederReport:
        """The report."""
        if self.estimate is None or self.judgement is None:
            report = blind(self.site, self.tick, self.max_attacked, self.cause, self.reason)
        else:
            report = build(self.site, self.tick, self.max_attacked, self.estimate, self.judgement)
            report = with_data_error(report, self.data_error)
            report = report if self.learning is None else with_learning(report, self.learning)
        report = replace(report, revision=self.revision, t_measured=self.t_measured, since=self.since)
        if self.displayed is None:
            return report
        tick, since = self.displayed
        return replace(report, displayed=_shown(report if tick.t == self.t else tick.report, since))

    def text(self) -> bytes:
        """Return the report as JSON text."""
        return to_text(self.report)

    def notable(self, subjects: Collection[str | None]) -> FeederReport | None:
        """Return the part of the report that conditions depend on; None if none can be present.

        An unknown condition has an effect only if an alarm, or a pending one, has its subject. `subjects` are
        these: meters, customers of inverters and `BUSBAR`; None for the feeder. All other meters and
        inverters without a condition, the buses and the customers are left out.
        """
        learning, tick, judgement = self.learning, self.tick, self.judgement
        if learning is not None and learning.stalled:
            return self.report
        meters, inverters = self._notable_meters(subjects), self._notable_inverters(subjects)
        busbar = BUSBAR in subjects or tick.busbar_offset is not None
        busbar = busbar or (judgement is not None and bool(judgement.busbar.any()))
        decided = self.verdict is not Decision.UNDECIDED
        # Meters may be unavailable and not silent: an alarm of the feeder's outage is then held.
        outage = bool(tick.silent) or (None in subjects and self.counts.mostly(self.counts.unread))
        nothing = not (meters.any() or inverters.any() or outage or busbar)
        if nothing and decided and learning is not None:
            return None
        report = replace(
            self._part(meters),
            reason="" if decided else self._reason(),
            inverters=inverter_states(
                self.site, self.estimate, judgement, self.grounds.model_only(self.site), inverters
            ),
            explanations=() if judgement is None else explanations(self.site, judgement),
            learning=learning,
        )
        return with_data_error(report, self.data_error)

    def kept(self) -> KeptTick:
        """Return the part of the report that the history keeps: the meters and the busbar meter."""
        site, judgement = self.site, self.judgement
        at = site.meters
        v, std = (values[at] for values in self._volts)
        unknown = np.full(at.size, np.nan)
        score, threshold = (unknown, unknown) if judgement is None else (judgement.score, judgement.threshold)
        suspects = np.zeros(at.size, dtype=np.bool_) if judgement is None else judgement.suspects
        row = history_row(
            busbar_report(site, self.tick, self.estimate, judgement),
            site.meter_ids,
            np.array([self.tick.values[V_VOLT, :-1], v, score, threshold, std]),
            np.array([self.tick.seen, suspects, self.grounds.model_only(site)[at]]),
        )
        return KeptTick(self.feeder, self.t, self.verdict, self.cause, self.suspects, row)

    def _part(self, which: Bools) -> FeederReport:
        """Report of the feeder with its busbar meter and some meters, (p,)."""
        site, tick = self.site, self.tick
        limits, nominal = site.tables.meta.limits, site.tables.meta.voltage_volt
        return FeederReport(
            feeder=self.feeder,
            t=self.t,
            verdict=self.verdict,
            reason="",
            cause=self.cause,
            max_attacked=self.max_attacked,
            meters=meter_states(
                site,
                tick,
                self.estimate,
                self.judgement,
                volts_of=self._volts,
                model_only=self.grounds.model_only(site),
                which=which,
            ),
            buses=(),
            silent=tuple(Silence(BUSBAR if meter is None else meter, finite(s)) for meter, s in tick.silent),
            v_min_volt=limits.v_min_pu * nominal,
            v_max_volt=limits.v_max_pu * nominal,
            busbar=busbar_report(site, tick, self.estimate, self.judgement),
        )

    def _reason(self) -> str:
        """Reason of the verdict, with skipped ticks."""
        if self.judgement is None:
            return in_words(self.reason, self.tick)
        return in_words(reason_of(self.site, self.tick, self.max_attacked, self.judgement), self.tick)

    def completed(self, **fields: Any) -> TickState:
        """Return the result with other values of fields that its readings do not depend on."""
        after = replace(self, **fields)
        vars(after)["grounds"] = self.grounds
        return after

    @property
    def _volts(self) -> tuple[Floats, Floats]:
        """Voltage of every customer and its standard deviation, V, (N,)."""
        if self.estimate is None:
            unknown = np.full(len(self.site.feeder.customers), np.nan)
            return unknown, unknown
        return volts(self.site.customer_volt, self.estimate.v2), std_volts(self.site, self.estimate)

    def _notable_meters(self, subjects: Collection[str | None]) -> Bools:
        """Meters that a condition may depend on, (p,)."""
        site, judgement = self.site, self.judgement
        which = np.zeros(site.meters.size, dtype=np.bool_)
        named, silent = set(subjects) - {None}, {meter for meter, _ in self.tick.silent} - {None}
        # If most meters are silent, the outage is the only condition of those without an alarm.
        if silent and not self.counts.mostly(len(silent)):
            named |= silent
        if named:
            which |= np.array([meter in named for meter in site.meter_ids], dtype=np.bool_)
        if self.tick.clock_offset:
            which |= np.array([offset is not None for offset in self.tick.clock_offset])
        if judgement is None:
            return which
        which |= judgement.suspects
        if self.estimate is not None:
            v, (low, high) = volts(site.meter_volt, self.estimate.v2[site.meters]), site.meter_limits
            which |= (v < low) | (v > high)
        return which

    def _notable_inverters(self, subjects: Collection[str | None]) -> Bools:
        """Inverters that a condition may depend on, (m,)."""
        customers = self.site.droop.customer
        which = np.zeros(customers.size, dtype=np.bool_)
        if subjects and customers.size:
            names = self.site.tables.customers
            which |= np.array([names[k].customer in subjects for k in customers.tolist()], dtype=np.bool_)
        if self.judgement is not None and self.judgement.inverters.size:
            which |= self.judgement.inverters
        return which


def _shown(report: FeederReport, since: float) -> DisplayedVerdict:
    """Displayed verdict of the newest report that has it; since: start of the time that led to it, Unix s."""
    return DisplayedVerdict(
        verdict=report.verdict,
        since=since,
        t=report.t,
        cause=report.cause,
        reason=report.reason,
        suspects=report.suspects,
        inverters=tuple(inverter.customer for inverter in report.inverters if inverter.suspect),
    )
