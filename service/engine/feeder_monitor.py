"""Monitor of one feeder: readings in, reports and alarm transitions out.

The live service, replay and tests all use it. It has no clock, no threads and no input or output. Calls on a
`FeederMonitor` must not overlap.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any
from zlib import crc32

import numpy as np

from feeders import registry
from feeders.model.site import PowerAges, Site, to_frame
from feeders.registry import DesignedEstimator, ObserverMemory, WarmStart
from gridsec.arrays import any_of
from gridsec.estimators.front import SuspicionRecord
from gridsec.interface import Cause
from service.alarms import displayed
from service.alarms.conditions import AlarmKind, Condition, Severity, conditions, identity_mismatches
from service.alarms.state_machine import INCIDENT_S, AlarmBook, AlarmRules, AlarmTransition, advance, hold
from service.engine.commissioning import FeederCommissioning
from service.ingest.align import Aligner, AlignRules, Clock, Placed, ReadingOutcome, Tick, rules
from service.ingest.reading import Known, Reading, Readings
from service.report import feeder_info
from service.report.data_errors import DataErrors
from service.report.report import BUSBAR, FeederReport, busbar_phases, snapshot
from service.report.tick_state import TickState
from service.store.state_codec import (
    KeptInvalid,
    MonitorState,
    StateSnapshot,
    decode_distrust,
    decode_observer,
    encode_distrust,
    encode_observer,
    observer_fingerprint,
)


class Suspicions:
    """Distrusted meters and inverters of one feeder, including the busbar meter.

    known: distrusted devices at the last tick, or at the end of the previous process.
    note: reason why stored state is not used; empty otherwise.
    kept: stored state.
    """

    def __init__(self, site: Site, kept: StateSnapshot | None = None) -> None:
        self.known = SuspicionRecord.empty(len(site.meter_ids), site.droop.tau.size, len(busbar_phases(site)))
        self.note = ""
        self._site = site
        self._watcher: DesignedEstimator | None = None
        self._t: float | None = None
        if kept is not None:
            try:
                self.known = decode_distrust(site, kept)
            except KeptInvalid as error:
                self.note = f"suspicions of {kept.t:.0f} are not used: {error}"
        self._stored: SuspicionRecord | None = None if self.note else self.known

    @property
    def _memory(self) -> WarmStart | None:
        return None if self._watcher is None else self._watcher.family.warm_start

    def install(self, watcher: DesignedEstimator) -> None:
        """Install a finished design."""
        self._watcher = watcher

    def restore(self, state: Any) -> Any:
        """Apply the record to a state, if the monitor supports a warm start."""
        if self._watcher is None or self._memory is None:
            return state
        return self._memory.warm_start(self._watcher.design, state, self.known)

    def follow(self, state: Any, t: float) -> None:
        """Update from the result of a tick."""
        if self._watcher is not None and self._memory is not None:
            self.known, self._t = self._memory.distrusted(self._watcher.design, state), t

    def forget(self, meters: Sequence[str], t: float) -> None:
        """Remove replaced meters from the record. `meters` is empty for all."""
        chosen = set(meters)
        which = [not chosen or meter in chosen for meter in self._site.meter_ids]
        self.known, self._t = self.known.without(np.array(which, dtype=np.bool_)), t

    def now(self) -> StateSnapshot | None:
        """Return the present state for the store; None before the first tick."""
        return None if self._t is None else encode_distrust(self._site, self._t, self.known)

    def due(self) -> tuple[StateSnapshot, ...]:
        """Return the state for the store if it has changed; it counts as stored afterwards."""
        if self._t is None or (self._stored is not None and self._stored.same(self.known)):
            return ()
        self._stored = self.known
        return (encode_distrust(self._site, self._t, self.known),)


# --- Observer of one feeder ---


HANDOVER_S = 3.0
"""Least time from a stored observer to the first tick of the next owner, s."""
RECORDS = 3
"""Stored observers per settling time."""


class ObserverStart(StrEnum):
    """Start of an observer."""

    RESUMED = "resumed"  # from the stored state
    OLD = "old"  # the stored state is too old
    REFUSED = "refused"  # the stored state is damaged, or of another feeder or version
    NEW = "new"  # without stored state


class ObserverHandover:
    """Observer of one feeder across restarts.

    note: reason why stored state is not used; empty otherwise.
    started: the latest start of the observer, until it is counted; None without one.
    kept: stored state.
    """

    def __init__(self, site: Site, kept: StateSnapshot | None = None) -> None:
        self.note = ""
        self.started: ObserverStart | None = None
        self._site, self._kept, self._fingerprint = site, kept, observer_fingerprint(site)
        self._watcher: DesignedEstimator | None = None
        self._memory: ObserverMemory | None = None
        self._every_s = math.inf
        self._state: Any = None
        self._t = self._stored_t = -math.inf

    def install(self, watcher: DesignedEstimator) -> None:
        """Install a finished design."""
        self._watcher, self._memory = watcher, watcher.family.observer_memory
        settling_s = 0.0 if self._memory is None else self._memory.settling_s(watcher.design)
        # A shorter start is over before a stored state could be used.
        self._every_s = settling_s / RECORDS if settling_s >= HANDOVER_S else math.inf

    def restore(self, state: Any) -> Any:
        """Continue the stored observer in a state of `init` at the first tick, if it fits; use it once."""
        kept, self._kept = self._kept, None
        if self._watcher is None or self._memory is None or self._every_s == math.inf:
            return state
        if kept is None:
            self.started = ObserverStart.NEW
            return state
        try:
            record = decode_observer(self._site, self._fingerprint, kept)
        except KeptInvalid as error:
            self.started = ObserverStart.REFUSED
            self.note = f"observer of {kept.t:.0f} is not used: {error}"
            return state
        after = self._memory.resume(self._watcher.design, state, record)
        self.started = ObserverStart.OLD if after is state else ObserverStart.RESUMED
        return after

    def follow(self, state: Any, t: float) -> None:
        """Update from the result of a tick."""
        self._state, self._t = state, t

    def now(self) -> StateSnapshot | None:
        """Return the present state for the store; None before the first tick, and where none is needed."""
        if self._watcher is None or self._memory is None or self._state is None:
            return None
        record = self._memory.observed(self._watcher.design, self._state)
        return None if record is None else encode_observer(self._site.feeder.name, self._fingerprint, record)

    def due(self, *, at_once: bool = False) -> tuple[StateSnapshot, ...]:
        """Return the state for the store if it is due; it counts as stored afterwards.

        Feeders with equal settling times are due at the same ticks: one transaction stores them. With
        `at_once` it includes a state that is not due yet.
        """
        t, every_s = self._t, self._every_s
        if t == self._stored_t or every_s == math.inf:
            return ()
        if not at_once and t // every_s == self._stored_t // every_s:
            return ()
        self._stored_t = t
        kept = self.now()
        return () if kept is None else (kept,)


# --- Monitor of one feeder ---


POWER_MAX_FACTOR = 100.0
"""Largest plausible power over the feeder's base power."""

MISMATCH_S = 60.0
"""Time for which a refused identity is a condition, s; at least two ticks."""
OVERLOAD_REASON = "not monitored: the service is overloaded, and discards the readings of this feeder"

PARTIAL, PARTIAL_S = 2, 10.0
"""Number of ticks after the end of an overload that are not judged, and their largest sum, s.

Some of their readings were discarded. With partial frames `modal` has a full covariance, and takes five times
as long for 17 ticks: the feeders that return would be the next overload.
"""

PATIENCE_MIN_S = 5.0
"""Lower limit of `patience_s`, s."""


class Phase(StrEnum):
    """State of a feeder's monitor."""

    DESIGNING = "designing"
    WATCHING = "watching"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class TickResult:
    """Result of one tick."""

    state: TickState
    transitions: tuple[AlarmTransition, ...]

    @property
    def report(self) -> FeederReport:
        """Its report."""
        return self.state.report


def known_of(site: Site) -> Known:
    """Return the properties of a feeder that the validation of readings uses."""
    meta = site.tables.meta
    nominal = zip(site.meter_ids, site.customer_nominal[site.meters].tolist(), strict=True)
    own = {meter: volt for meter, volt in nominal if volt != meta.voltage_volt}
    return Known(site.meter_ids, meta.voltage_volt, POWER_MAX_FACTOR * meta.base_kva, own)


def align_rules(
    site: Site,
    clock: Clock,
    *,
    max_skew_s: float | None = None,
    grace_s: float | None = None,
    live: bool = False,
) -> AlignRules:
    """Return the times of the alignment of a feeder's readings."""
    settings = site.tables.meta.monitor
    return rules(
        settings.tick_s, settings.silence_s, clock=clock, max_skew_s=max_skew_s, grace_s=grace_s, live=live
    )


def alarm_rules(site: Site, times: AlignRules) -> AlarmRules:
    """Return the delays of a feeder's alarms."""
    settings = site.tables.meta.monitor
    return AlarmRules(
        settings.on_delay_s,
        settings.off_delay_s,
        silence_s=times.silence_s,
        incident_s=max(INCIDENT_S, 2.0 * times.tick_s),
    )


def design(site: Site, progress: Callable[[int, int], None] | None = None) -> registry.DesignedEstimator:
    """Return the design of a feeder's estimator; slow on large feeders.

    `progress` is called with (done, total) if the design has many parts. Raises NotObservable,
    DesignInfeasible if the feeder does not satisfy the conditions of its estimator.
    """
    return registry.design(site, workers=os.cpu_count() or 1, progress=progress)


class FeederMonitor:
    """Monitor of one feeder.

    phase, problem: state of the monitor, and the reason of a failure.
    latest: result of the latest tick, or None before the first one.
    pending: ticks that are due and not evaluated, oldest first.
    skipped: number of skipped ticks.
    shed: True while it is not monitored because of overload.
    defect: error that ended the monitor, until it is logged; None without one.
    rules: times of its alignment.
    book: its alarms so far.
    commissioning: state of the meters' errors.
    suspicions: distrusted devices.
    observer: observer of the inverters across restarts.
    """

    def __init__(
        self, site: Site, rules: AlignRules, book: AlarmBook, past: MonitorState | None = None
    ) -> None:
        past = past or MonitorState()
        self.site = site
        self.name = site.feeder.name
        self.max_attacked = 0  # M of the design; none is guaranteed without one
        self.aligner = Aligner(site.meter_ids, rules)
        self.book = book
        self.commissioning = FeederCommissioning(site, past.commission)
        self.suspicions = Suspicions(site, past.distrust)
        self.observer = ObserverHandover(site, past.observer)
        self.phase = Phase.DESIGNING
        self.problem = ""
        self.latest: TickState | None = None
        self.pending: deque[Tick] = deque()
        self.skipped = 0
        self.shed = False
        self._partial = 0  # next ticks with a part of the readings
        self.defect: Exception | None = None
        self._alarm_rules = alarm_rules(site, rules)
        self._display: displayed.Display[TickState] | None = None
        self._data_errors = DataErrors(site)
        self._power_ages = PowerAges(site)
        # Meters that have had no reading since the start and are not silent yet.
        self._connecting = {BUSBAR, *site.meter_ids}
        # Problems of refused identities by meter: since the last tick, and with the tick of the latest one.
        self._refused: dict[str, str] = {}
        self._mismatches: dict[str, tuple[float, str]] = {}
        self._watcher: registry.DesignedEstimator | None = None
        self._state: Any = None
        self._read = False  # True from the first usable reading on

    def now(self, stored: MonitorState) -> MonitorState:
        """Return the present state for the store, with `stored` where there is none yet."""
        return MonitorState(
            self.commissioning.now() or stored.commission,
            self.suspicions.now() or stored.distrust,
            self.observer.now() or stored.observer,
        )

    @property
    def report(self) -> FeederReport | None:
        """The latest report, or None before the first tick."""
        return None if self.latest is None else self.latest.report

    @property
    def patience_s(self) -> float:
        """Age beyond which a report is stale, s: three ticks and the grace."""
        rules = self.aligner.rules
        return max(PATIENCE_MIN_S, 3.0 * rules.tick_s + rules.grace_s)

    @property
    def shows_overload(self) -> bool:
        """True while the list of feeders states `overload` as its cause."""
        return self.latest is not None and self.latest.summary["cause"] is Cause.OVERLOAD

    def stale(self, age_s: float) -> bool:
        """True if the latest tick, of this age, s, is late; those that display the overload are rare."""
        patience_s = self.patience_s
        if self.shows_overload:
            patience_s = feeder_info.patience_shed_s(patience_s, self.aligner.rules.tick_s)
        return age_s > patience_s

    @cached_property
    def revision(self) -> str:
        """Revision in its reports, against reading them with the meters of other tables."""
        revision: str = feeder_info.detail(self.site, self.patience_s)["revision"]
        return revision

    def install(self, finished: registry.DesignedEstimator) -> None:
        """Start monitoring with a finished design."""
        self._watcher, self._state = finished, None
        self._data_errors.renew()
        self.max_attacked = finished.max_attacked
        self.commissioning.install(finished)
        self.suspicions.install(finished)
        self.observer.install(finished)
        self.phase, self.problem = Phase.WATCHING, ""

    def fail(self, problem: str) -> None:
        """End monitoring; ticks continue and are undecided."""
        self._watcher = self._state = None
        self.max_attacked = 0
        self.phase, self.problem = Phase.FAILED, problem

    def break_down(self, defect: Exception) -> None:
        """End monitoring because of a defect, and keep the defect until it is logged."""
        self.fail(f"{type(defect).__name__}: {defect}")
        self.defect = defect

    def place(self, reading: Reading, now: float) -> ReadingOutcome:
        """Align one reading; ticks that become due are pending."""
        outcome, ticks = self.aligner.take(reading, now)
        self.pending.extend(ticks)
        return outcome

    def refuse(self, meter: str, problem: str) -> None:
        """Note a reading that was refused for its identity; a condition from the next tick on."""
        self._refused[meter] = problem

    def _mismatched(self, t: float) -> dict[str, str]:
        """Problems of refused identities within the last `MISMATCH_S` before a tick, by meter."""
        self._mismatches |= {meter: (t, problem) for meter, problem in self._refused.items()}
        self._refused.clear()
        hold_s = max(MISMATCH_S, 2.0 * self.aligner.rules.tick_s)
        # After the clock was set back, a later time would hold the condition for longer.
        self._mismatches = {
            meter: (at, problem)
            for meter, (at, problem) in self._mismatches.items()
            if 0.0 <= t - at <= hold_s
        }
        return {meter: problem for meter, (_, problem) in self._mismatches.items()}

    def place_all(self, readings: Readings) -> Placed:
        """Align readings in the order of their arrival; ticks that become due are pending."""
        placed = self.aligner.take_all(readings)
        self.pending.extend(placed.ticks)
        return placed

    @property
    def _rests(self) -> bool:
        """True while it is shed, the display states it, and no alarm waits for its delay."""
        if not self.shed or not self.shows_overload:
            return False
        return any(alarm.kind is AlarmKind.UNDECIDED for alarm in self.book.active)

    @property
    def wake(self) -> float | None:
        """Latest wall time of the next tick, Unix s; None if only readings can cause one."""
        wake, tick_s = self.aligner.wake(), self.aligner.rules.tick_s
        every = feeder_info.rare_ticks(tick_s)
        if wake is None or every == 1 or not self._rests:
            return wake
        # Shed feeders have their ticks in different seconds.
        return wake + tick_s * ((crc32(self.name.encode()) - math.floor(wake / tick_s)) % every)

    def reach(self, now: float) -> None:
        """Add the ticks that are due without a new reading to the pending ones.

        At rest only the newest: it stands for those since the last one. Beyond the interval of such ticks, as
        after a leap of the clock, ticks are skipped.
        """
        rests = self._rests
        passed = self.aligner.pass_over(now) if rests else 0
        ticks = list(self.aligner.due(now))
        if rests and ticks:
            passed += len(ticks) - 1
            rare = min(passed, 2 * feeder_info.rare_ticks(self.aligner.rules.tick_s))
            last = ticks[-1]
            ticks = [replace(last, passed_over=rare, skipped=last.skipped + passed - rare)]
        self.pending.extend(ticks)

    def skip(self, count: int) -> None:
        """Drop the oldest pending ticks without evaluation; the next one counts them.

        `count` is less than the number of pending ticks.
        """
        dropped = [self.pending.popleft() for _ in range(count)]
        gone = sum(tick.skipped + tick.passed_over + 1 for tick in dropped)
        following = self.pending[0]
        self.pending[0] = replace(following, skipped=following.skipped + gone)

    def judge(self) -> TickResult:
        """Evaluate the oldest pending tick. Raises IndexError if no tick is pending."""
        tick = self.pending.popleft()
        self.skipped += tick.skipped
        return self._result(tick)

    def set_shed(self, shed: bool, now: float) -> int:
        """Begin or end the time without monitoring at the wall time, Unix s; it is no evidence of silence.

        The next `PARTIAL` ticks after it are not judged. Returns the number of ticks that are passed over.
        """
        passed = self.aligner.pass_over(now) if self._rests else 0
        self.shed = shed
        self._partial = 0 if shed else min(PARTIAL, int(PARTIAL_S / self.aligner.rules.tick_s))
        self.aligner.excuse()
        # Nothing is decoded meanwhile: problems of refused identities last from the return on.
        self._refused = {meter: problem for meter, (_, problem) in self._mismatches.items()} | self._refused
        return passed

    def finish(self) -> None:
        """Add all ticks that the time has reached to the pending ones: the input has ended."""
        self.pending.extend(self.aligner.flush())

    def recommission(self, meters: Sequence[str], t: float, who: str, reason: str) -> Callable[[], None]:
        """Restart the learning of meters' errors, after their replacement.

        Returns a function that undoes the restart, if nothing else has happened since.
        """
        state, before, believed = self._state, copy(self.commissioning), copy(self.suspicions)
        self._state = self.commissioning.renew(state, meters, t, who, reason)
        self._data_errors.renew()
        self.suspicions.forget(meters, t)

        def take_back() -> None:
            self._state, self.commissioning, self.suspicions = state, before, believed

        return take_back

    def _result(self, tick: Tick) -> TickResult:
        """Evaluate a tick; a defect costs its verdict, but no alarm of earlier ticks."""
        book = self.book
        if tick.skipped:
            book = hold(book, tick.t - tick.skipped * self.aligner.rules.tick_s)
        mismatches = (
            self._unread(book) if self.shed else identity_mismatches(self.name, self._mismatched(tick.t))
        )
        for _ in range(2):  # monitored, then failed
            try:
                state, display = self._complete(self._judge(tick))
                subjects = {subject for _, subject in book.entries}
                notable = state.notable(subjects)
                connecting = self._connects(tick)
                found = []
                if notable is not None:
                    keys = book.entries.keys()
                    found = conditions(notable, connecting=connecting, keys=keys, counts=state.counts)
                held = self._unmeasured(book, tick)
                after, transitions = advance(book, self._alarm_rules, [*found, *mismatches, *held], state.t)
            except Exception as error:  # noqa: BLE001 - ticks before and after keep their verdicts
                self.break_down(error)
            else:
                self.latest, self.book, self._display = state, after, display
                return TickResult(state, transitions)
        self.latest, self._display = self._complete(self._judge(tick))
        return TickResult(self.latest, ())

    def _unread(self, book: AlarmBook) -> list[Condition]:
        """Unknown conditions of alarms that depend on payloads which a shed feeder does not decode."""
        kinds = (AlarmKind.IDENTITY_MISMATCH, AlarmKind.CLOCK_OFFSET)
        return self._unknown(key for key in book.entries if key[0] in kinds)

    def _unmeasured(self, book: AlarmBook, tick: Tick) -> list[Condition]:
        """Unknown conditions of alarms of clocks without a measured offset, as after a restart."""
        measured = tick.clocks_known
        if measured is None:
            return []
        entries = (key for key in book.entries if key[0] is AlarmKind.CLOCK_OFFSET)
        return self._unknown(key for key in entries if (None if key[1] == BUSBAR else key[1]) not in measured)

    def _unknown(self, keys: Iterable[tuple[AlarmKind, str | None]]) -> list[Condition]:
        return [Condition(kind, self.name, meter, Severity.MAJOR, known=False) for kind, meter in keys]

    def _connects(self, tick: Tick) -> bool:
        """True while a meter has had no reading since the start and is not silent yet."""
        if self._connecting:
            self._connecting -= {self.site.meter_ids[k] for k in np.flatnonzero(tick.seen)}
            self._connecting -= {BUSBAR if meter is None else meter for meter, _ in tick.silent}
            if math.isfinite(tick.busbar_volt):
                self._connecting.discard(BUSBAR)
        return bool(self._connecting)

    def _complete(self, state: TickState) -> tuple[TickState, displayed.Display[TickState]]:
        """The result with revision, newest tick with a reading, and start and display of the verdict."""
        before = self.latest
        last = None if before is None else before.t_measured
        goes_on = before is not None and before.verdict is state.verdict and before.t < state.t
        since = before.since if before is not None and goes_on else state.t
        # After the clock was set back, an earlier time of measurement would be in the future.
        measured = (last if last is None or last <= state.t else None) if state.model_only else state.t
        state = state.completed(revision=self.revision, t_measured=measured, since=since)
        display = displayed.advance(self._display, self._alarm_rules, state)
        return state.completed(displayed=(display.newest, display.since)), display

    def _judge(self, tick: Tick) -> TickState:
        if self.shed or self._partial:
            self._partial = max(0, self._partial - 1)
            # Its readings are discarded unread: no meter is silent.
            return TickState(
                self.site, replace(tick, silent=()), self.max_attacked, Cause.OVERLOAD, OVERLOAD_REASON
            )
        if self._watcher is None:
            if self.phase is Phase.FAILED:
                cause, reason = Cause.DESIGN_INVALID, f"not monitored: {self.problem}"
            else:
                cause, reason = Cause.SETTLING, "the design of the monitor is not finished"
            return TickState(self.site, tick, self.max_attacked, cause, reason)
        self._read = self._read or any_of(np.isfinite(tick.values))
        if not self._read and self.latest is not None and self.latest.judgement is not None:
            # Without a reading since the start every tick has the same result; the estimator has a pause.
            return replace(self.latest, tick=tick)
        if self._state is None or (self.latest is not None and tick.t <= self.latest.t):
            # The first tick, or the clock was set back: earlier readings belong to another time.
            begun = self._watcher.init(tick.t, self.commissioning.known)
            self._state = self.suspicions.restore(self.observer.restore(begun))
            self._data_errors.renew()
            self._power_ages = PowerAges(self.site)
        frame = to_frame(self.site, self._power_ages.apply(snapshot(self.site, tick)))
        self._state, estimate, verdict = self._watcher.step(self._state, frame)
        self.commissioning.follow(self._state, tick.t)
        self.suspicions.follow(self._state, tick.t)
        self.observer.follow(self._state, tick.t)
        return TickState(
            self.site,
            tick,
            self.max_attacked,
            verdict.cause,
            estimate=estimate,
            judgement=verdict,
            learning=self.commissioning.report(),
            data_error=self._data_errors.follow(frame, estimate, verdict),
        )
