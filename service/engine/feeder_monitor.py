"""One feeder being watched: readings in, reports and alarm transitions out.

The live service, replay and tests all run this. It has no clock, no threads and no input or output; whoever
owns a `Watch` calls it from one place at a time.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

from feeders.model.site import Site, to_frame
from feeders.registry import registry
from gridsec.interface import Cause
from service.alarms.conditions import conditions
from service.alarms.state_machine import AlarmBook, AlarmRules, Transition, acknowledge, advance, hold
from service.engine.commissioning import Commissioning
from service.engine.suspicions import Suspicions
from service.ingest.align import Aligner, AlignRules, Clock, Outcome, Tick, rules
from service.ingest.reading import Known, Reading
from service.report import feeder_info
from service.report.reasons import DataErrors
from service.report.report import FeederReport, blind, build, with_data_error, with_learning
from service.report.voltages import snapshot

POWER_MAX_FACTOR = 100.0
"""Powers beyond this many times the feeder's base power are no readings."""

PATIENCE_MIN_S = 5.0
"""A younger report is never stale."""


class Phase(StrEnum):
    """Whether a feeder has a monitor."""

    DESIGNING = "designing"
    WATCHING = "watching"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class TickResult:
    """What one tick brought."""

    report: FeederReport
    transitions: tuple[Transition, ...]


def known_of(site: Site) -> Known:
    """Return what the wire has to know of a feeder.

    Parameters
    ----------
    site
        The feeder.
    """
    meta = site.tables.meta
    nominal = zip(site.meter_ids, site.customer_nominal[site.meters].tolist(), strict=True)
    own = {meter: volt for meter, volt in nominal if volt != meta.voltage_volt}
    return Known(frozenset(site.meter_ids), meta.voltage_volt, POWER_MAX_FACTOR * meta.base_kva, own)


def align_rules(
    site: Site,
    clock: Clock,
    *,
    max_skew_s: float | None = None,
    grace_s: float | None = None,
    live: bool = False,
) -> AlignRules:
    """Return the times by which a feeder's readings are aligned.

    Parameters
    ----------
    site
        The feeder.
    clock, max_skew_s, grace_s, live
        As in `align.rules`.
    """
    settings = site.tables.meta.monitor
    return rules(
        settings.tick_s, settings.silence_s, clock=clock, max_skew_s=max_skew_s, grace_s=grace_s, live=live
    )


def alarm_rules(site: Site, times: AlignRules) -> AlarmRules:
    """Return the delays of a feeder's alarms.

    Parameters
    ----------
    site, times
        The feeder, and the times by which its readings are aligned.
    """
    settings = site.tables.meta.monitor
    return AlarmRules(settings.on_delay_s, settings.off_delay_s, silence_s=times.silence_s)


def design(site: Site, progress: Callable[[int, int], None] | None = None) -> registry.Watcher:
    """Return the design of the estimator that a feeder's file names; takes its time on large ones.

    Parameters
    ----------
    site
        The feeder.
    progress
        Called with (done, total) where the design has many parts.

    Raises
    ------
    NotObservable, DesignInfeasible
        If the feeder cannot be watched as its file asks for.
    """
    return registry.design(site, workers=os.cpu_count() or 1, progress=progress)


class Watch:
    """One feeder being watched.

    Parameters
    ----------
    site
        The feeder.
    rules
        Its times.
    book
        Its alarms so far.
    commissioning
        What is known of its meters; None: nothing.
    suspicions
        Who was not believed; None: nobody.

    Attributes
    ----------
    phase, problem
        Whether there is a monitor, and if it failed, why.
    report
        The latest report, or None before the first tick.
    pending
        Ticks that are due and not judged, oldest first.
    skipped
        Ticks that were not judged.
    defect
        What made the monitor fail, until somebody has seen to it; None: nothing.
    """

    def __init__(
        self,
        site: Site,
        rules: AlignRules,
        book: AlarmBook,
        commissioning: Commissioning | None = None,
        suspicions: Suspicions | None = None,
    ) -> None:
        self.site = site
        self.name = site.feeder.name
        self.max_attacked = site.tables.meta.monitor.max_attacked
        self.aligner = Aligner(site.meter_ids, rules)
        self.book = book
        self.commissioning = commissioning or Commissioning(site)
        self.suspicions = suspicions or Suspicions(site)
        self.phase = Phase.DESIGNING
        self.problem = ""
        self.report: FeederReport | None = None
        self.pending: deque[Tick] = deque()
        self.skipped = 0
        self.defect: Exception | None = None
        self._alarm_rules = alarm_rules(site, rules)
        self._data_errors = DataErrors(site)
        self._watcher: registry.Watcher | None = None
        self._state: Any = None

    @property
    def patience_s(self) -> float:
        """An older report is stale: three ticks have gone by without one, and the grace, s."""
        rules = self.aligner.rules
        return max(PATIENCE_MIN_S, 3.0 * rules.tick_s + rules.grace_s)

    @cached_property
    def revision(self) -> str:
        """What its reports carry, so that nobody reads them with the meters of other tables."""
        revision: str = feeder_info.detail(self.site, self.patience_s)["revision"]
        return revision

    def install(self, finished: registry.Watcher) -> None:
        """Begin to watch with a finished design.

        Parameters
        ----------
        finished
            The design.
        """
        self._watcher, self._state = finished, None
        self._data_errors.renew()
        self.max_attacked = finished.max_attacked
        self.commissioning.install(finished)
        self.suspicions.install(finished)
        self.phase, self.problem = Phase.WATCHING, ""

    def fail(self, problem: str) -> None:
        """Give up watching; ticks go on and are undecided.

        Parameters
        ----------
        problem
            Why, for the operator.
        """
        self._watcher = self._state = None
        self.phase, self.problem = Phase.FAILED, problem

    def break_down(self, defect: Exception) -> None:
        """Give up watching because of a defect, and keep that for whoever sees to it.

        Parameters
        ----------
        defect
            What was raised.
        """
        self.fail(f"{type(defect).__name__}: {defect}")
        self.defect = defect

    def place(self, reading: Reading, now: float) -> Outcome:
        """Align one reading; the ticks that become due are pending.

        Parameters
        ----------
        reading, now
            As in `Aligner.take`.
        """
        outcome, ticks = self.aligner.take(reading, now)
        self.pending.extend(ticks)
        return outcome

    def reach(self, now: float) -> None:
        """Add the ticks that are due without a new reading to the pending ones.

        Parameters
        ----------
        now
            Wall time, Unix s.
        """
        self.pending.extend(self.aligner.due(now))

    def skip(self, count: int) -> None:
        """Drop the oldest pending ticks without judging them; the next one counts them.

        Parameters
        ----------
        count
            Their number, less than that of the pending ticks.
        """
        gone = sum(self.pending.popleft().skipped + 1 for _ in range(count))
        following = self.pending[0]
        self.pending[0] = replace(following, skipped=following.skipped + gone)

    def judge(self) -> TickResult:
        """Judge the oldest pending tick.

        Raises
        ------
        IndexError
            If no tick is pending.
        """
        tick = self.pending.popleft()
        self.skipped += tick.skipped
        return self._result(tick)

    def take(self, reading: Reading, now: float) -> tuple[Outcome, list[TickResult]]:
        """Align one reading and judge the ticks that become due.

        Parameters
        ----------
        reading, now
            As in `Aligner.take`.
        """
        return self.place(reading, now), self._judged()

    def due(self, now: float) -> list[TickResult]:
        """Judge the ticks that are due without a new reading.

        Parameters
        ----------
        now
            Wall time, Unix s.
        """
        self.reach(now)
        return self._judged()

    def finish(self) -> None:
        """Add all ticks that the time has reached to the pending ones: nothing more will come."""
        self.pending.extend(self.aligner.flush())

    def acknowledge(
        self, alarm_id: str, who: str, comment: str, t: float, *, count: int | None = None
    ) -> tuple[Transition, ...]:
        """Answer an alarm of this feeder.

        Parameters
        ----------
        alarm_id, who, comment, t, count
            As in `state_machine.acknowledge`.
        """
        self.book, transitions = acknowledge(self.book, alarm_id, who, comment, t, count=count)
        return transitions

    def recommission(self, meters: Sequence[str], t: float, who: str, reason: str) -> Callable[[], None]:
        """Learn meters' errors anew, because they were replaced.

        Parameters
        ----------
        meters, t, who, reason
            As in `Commissioning.renew`.

        Returns
        -------
        callable
            Takes it back, as long as nothing else has happened.
        """
        state, before, believed = self._state, copy(self.commissioning), copy(self.suspicions)
        self._state = self.commissioning.renew(state, meters, t, who, reason)
        self._data_errors.renew()
        self.suspicions.forget(meters, t)

        def take_back() -> None:
            self._state, self.commissioning, self.suspicions = state, before, believed

        return take_back

    def _judged(self) -> list[TickResult]:
        return [self.judge() for _ in range(len(self.pending))]

    def _result(self, tick: Tick) -> TickResult:
        """Judge a tick; a defect costs the answer to it, and no alarm of the ticks before."""
        book = self.book
        if tick.skipped:
            book = hold(book, tick.t - tick.skipped * self.aligner.rules.tick_s)
        for _ in range(2):  # watched, and given up
            try:
                report = self._complete(self._judge(tick))
                after, transitions = advance(book, self._alarm_rules, conditions(report), report.t)
            except Exception as error:  # noqa: BLE001 - whatever it is, ticks before and after have their answers
                self.break_down(error)
            else:
                self.report, self.book = report, after
                return TickResult(report, transitions)
        self.report = self._complete(self._judge(tick))
        return TickResult(self.report, ())

    def _complete(self, report: FeederReport) -> FeederReport:
        """The report with the revision of its feeder, and the newest tick that rests on a reading."""
        last = None if self.report is None else self.report.t_measured
        # After the clock was set back, an earlier time of measurement would lie in the future.
        measured = (last if last is None or last <= report.t else None) if report.model_only else report.t
        return replace(report, revision=self.revision, t_measured=measured)

    def _judge(self, tick: Tick) -> FeederReport:
        if self._watcher is None:
            if self.phase is Phase.FAILED:
                cause, reason = Cause.DESIGN_INVALID, f"nobody watches: {self.problem}"
            else:
                cause, reason = Cause.SETTLING, "the monitor is still being designed"
            return blind(self.site, tick, self.max_attacked, cause, reason)
        if self._state is None or (self.report is not None and tick.t <= self.report.t):
            # The first tick, or the clock was set back: readings from before belong to another time.
            begun = self._watcher.init(tick.t, self.commissioning.known)
            self._state = self.suspicions.restore(begun)
            self._data_errors.renew()
        frame = to_frame(self.site, snapshot(self.site, tick))
        self._state, estimate, verdict = self._watcher.step(self._state, frame)
        self.commissioning.follow(self._state, tick.t)
        self.suspicions.follow(self._state, tick.t)
        report = build(self.site, tick, self.max_attacked, estimate, verdict)
        report = with_data_error(report, self._data_errors.follow(frame, estimate, verdict))
        return with_learning(report, self.commissioning.report())
