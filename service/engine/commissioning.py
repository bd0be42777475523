"""Commissioning of one feeder: learning of its meters' fixed errors, with storage across restarts.

`FeederCommissioning` has no clock and no input or output, like the `FeederMonitor` that owns it: time comes
from the ticks, stored texts are passed as values. Readers on other threads only take references.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from feeders.model.site import Site
from feeders.registry import BiasLearning, DesignedEstimator
from gridsec.arrays import Bools, Floats
from gridsec.errors import GridsecError, Problem
from gridsec.estimators.front import (
    Commission,
    Learning,
    LearningProgress,
    LearningReason,
    LearningState,
    to_arrays,
)
from service.report.report import LearningReport, StalledMeter
from service.store.schema import CommissioningChange, CommissioningEvent
from service.store.state_codec import KeptInvalid, StateSnapshot, decode, encode, fingerprint
from service.times import UtcTwins

SAVE_S = 60.0
"""Interval of storing the learning in progress, s; all other changes are stored at once."""


class NothingToLearn(GridsecError):
    """The feeder's monitor does not learn its meters' errors."""

    code = "nothing-to-learn"

    def __init__(self, feeder: str, why: Problem) -> None:
        super().__init__(f"feeder {feeder!r}: {why}", code=why.code)


class Stage(StrEnum):
    """State of the commissioning of a feeder, or of a meter."""

    OFF = "off"
    WAITING = "waiting"
    LEARNING = "learning"
    LEARNED = "learned"


@dataclass(frozen=True, slots=True)
class MeterCommissioning(UtcTwins):
    """Commissioning of one meter: its fixed error."""

    meter: str
    state: Stage
    since: Annotated[
        float | None, Field(description="Start of the learning, Unix s; null for a learned meter.")
    ]
    learned_at: Annotated[
        float | None, Field(description="Time at which it was learned, Unix s; null before.")
    ]
    gathered_s: Annotated[
        float | None,
        Field(description="Time with usable readings of a trusted meter since the start, s."),
    ]
    expected: Annotated[
        float | None, Field(description="Expected end of the learning if every tick counts, Unix s.")
    ]
    error_volt: Annotated[
        float | None, Field(description="Fixed error at nominal voltage, V; 0 before it is learned.")
    ]
    error_volt_std: Annotated[
        float | None, Field(description="Standard deviation of the error, ageing included, V.")
    ]
    allowed_volt: Annotated[
        float | None, Field(description="Largest deviation of an honest meter from its error, V.")
    ]
    learning_state: Annotated[
        LearningState,
        Field(
            description="`waiting`: no tick counted yet. `learning`. `stalled`: not learned after twice "
            "`expected_s`. `learned`."
        ),
    ]
    learning_reason: Annotated[
        LearningReason | None,
        Field(
            description="Reason that took most of the time that did not count; null on schedule.",
        ),
    ]
    watched_s: Annotated[
        float | None,
        Field(description="Time of all ticks since the start, s; null for a learned meter."),
    ]
    lost_s: Annotated[
        dict[LearningReason, float], Field(description="Time that did not count, s, by reason.")
    ]


@dataclass(frozen=True, slots=True)
class CommissioningProgress(UtcTwins):
    """Commissioning of a feeder: learning of its meters' fixed errors."""

    feeder: str
    estimator: str
    state: Annotated[
        Stage,
        Field(
            description="`off`: this monitor does not learn. `waiting`: no monitor or no tick yet. "
            "`learning`: at least one meter is being learned. `learned`: all are."
        ),
    ]
    t: Annotated[float | None, Field(description="Tick of the data, Unix s.")]
    tick_s: Annotated[float, Field(description="Interval of the monitor's steps, s.")]
    needed_s: Annotated[float, Field(description="`commission_s`: required time with usable readings, s.")]
    gathered_s: Annotated[
        float | None,
        Field(description="Least time with usable readings of the meters that are being learned, s."),
    ]
    since: Annotated[float | None, Field(description="Earliest start of the learning, Unix s.")]
    expected: Annotated[
        float | None, Field(description="Expected end of the learning, Unix s; null if `held`.")
    ]
    learned_at: Annotated[float | None, Field(description="Time of the latest learned meter, Unix s.")]
    # A suspect meter is not learned; until it is named as manipulated no meter is.
    held: Annotated[bool, Field(description="Enough time has passed, but a suspect prevents learning.")]
    restored: Annotated[bool, Field(description="The commissioning continues from stored state.")]
    note: Annotated[str, Field(description="Reason why stored state is not used; empty otherwise.")]
    expected_s: Annotated[float | None, Field(description="Time of learning if every tick counts, s.")]
    stalled: Annotated[int, Field(description="Meters that are not learned after twice that time.")]
    meters: tuple[MeterCommissioning, ...]


class FeederCommissioning:
    """Commissioning of one feeder.

    known: present state of the meters' errors; None before the first tick without stored state.
    restored, note: as in `CommissioningProgress`.
    kept: stored state.
    """

    def __init__(self, site: Site, kept: StateSnapshot | None = None) -> None:
        self.known: Commission | None = None
        self.restored = False
        self.note = ""
        self._site, self._kept, self._fingerprint = site, kept, fingerprint(site)
        self._watcher: DesignedEstimator | None = None
        self._t: float | None = None
        self._saved_t: float | None = None
        self._happened: tuple[CommissioningEvent, ...] = ()
        self._reported = LearningReport()

    @property
    def learner(self) -> BiasLearning | None:
        """Learning functions of the present monitor; None if it does not learn, or before its design."""
        return None if self._watcher is None else self._watcher.bias_learning

    def install(self, watcher: DesignedEstimator) -> None:
        """Install a finished design, and the stored state if it fits."""
        self._watcher, self._reported = watcher, LearningReport()
        if self.learner is None:
            self.known = None
        elif self.known is None and self._kept is not None:
            try:
                self.known = self.learner.read(
                    watcher.design, decode(self._site, self._fingerprint, self._kept)
                )
            except (KeptInvalid, ValueError) as error:
                self.note = f"meter errors learned until {self._kept.t:.0f} are not used: {error}"
            else:
                self._t = self._saved_t = self._kept.t
                self.restored = True

    def follow(self, state: Any, t: float) -> None:
        """Update from the result of a tick."""
        if self.learner is None:
            return
        before, self.known, self._t = self.known, self.learner.commission(state), t
        if before is None:
            every = np.ones(len(self._site.meter_ids), dtype=np.bool_)
            self._note(CommissioningChange.BEGUN, every, t, reason=self.note)
        elif self.known.learned is not before.learned:
            self._note(CommissioningChange.LEARNED, self.known.learned.at == t, t)

    def renew(self, state: Any, meters: Sequence[str], t: float, who: str, reason: str) -> Any:
        """Restart the learning of meters.

        `meters` is empty for all; `state` is None before the first tick, as is then the result. Raises
        NothingToLearn if the monitor does not learn.
        """
        learner, watcher = self.learner, self._watcher
        if learner is None or watcher is None:
            raise NothingToLearn(self._site.feeder.name, self._why_not())
        chosen = set(meters)
        which = np.array([not chosen or meter in chosen for meter in self._site.meter_ids], dtype=np.bool_)
        begun = watcher.init(t, self.known) if state is None else state
        after = learner.renew(watcher.design, begun, which)
        self.known = learner.commission(after)
        self._t = t if self._t is None else self._t
        self._note(CommissioningChange.RECOMMISSIONED, which, t, who=who, reason=reason)
        return None if state is None else after

    def _why_not(self) -> Problem:
        if self._watcher is None:
            return Problem("no-monitor", "the monitor has no design yet, or the design failed")
        family = self._watcher.family
        if family.bias_learning is None:
            text = f"its estimator, {family.name}, does not learn meters' errors"
            return Problem("never-learns", text)
        return Problem("learning-off", "commission_s is 0: learning is off")

    def _note(
        self, change: CommissioningChange, which: Bools, t: float, *, who: str | None = None, reason: str = ""
    ) -> None:
        meters = tuple(meter for meter, one in zip(self._site.meter_ids, which, strict=True) if one)
        one_more = CommissioningEvent(self._site.feeder.name, t, change, meters, who, reason)
        # Never changed in place: a copy of this object stays valid for an undo.
        self._happened = (*self._happened, one_more)

    # ---------------------------------------------------------------- storage

    def now(self) -> StateSnapshot | None:
        """Return the present state for the store; None before the first tick."""
        if self.known is None or self._t is None:
            return None
        return encode(self._site, self._fingerprint, self._t, self._arrays(self.known))

    def _arrays(self, known: Commission) -> dict[str, Floats]:
        """Persistent form of a commissioning; the restored one before the design is that of the store."""
        learner, watcher = self.learner, self._watcher
        if learner is None or watcher is None:
            return to_arrays(known)
        return learner.arrays(watcher.design, known)

    def due(
        self, *, at_once: bool = False
    ) -> tuple[tuple[StateSnapshot, ...], tuple[CommissioningEvent, ...]]:
        """Return the state that is due for the store; it counts as stored afterwards.

        With `at_once` it includes state that is not due yet.
        """
        happened, self._happened = self._happened, ()
        if self.known is None or self._t is None:
            return (), happened
        far = self._saved_t is None or abs(self._t - self._saved_t) >= SAVE_S
        wanted = self.known.learning is not None and (far or at_once) and self._t != self._saved_t
        if not (happened or wanted):
            return (), happened
        self._saved_t = self._t
        kept = self.now()
        return () if kept is None else (kept,), happened

    # ---------------------------------------------------------------- display

    def report(self) -> LearningReport:
        """Return the learning of the meters for a tick's report."""
        known = self.known
        found = self._found(known)
        if known is None or found is None:
            return LearningReport()
        last = self._reported
        if found.state is last.states and found.reason is last.reasons and not last.stalled:
            return last
        if LearningState.STALLED not in found.state:
            self._reported = LearningReport(found.state, found.reason, found.expected_s)
            return self._reported
        gathered = np.zeros(len(found.state)) if known.learning is None else known.learning.time_s
        stalled = tuple(
            StalledMeter(meter, found.reason[k], float(gathered[k]))
            for k, meter in enumerate(self._site.meter_ids)
            if found.state[k] is LearningState.STALLED
        )
        return LearningReport(found.state, found.reason, found.expected_s, stalled)

    def _found(self, known: Commission | None) -> LearningProgress | None:
        """Progress of the estimator; None if it does not learn, and before the first tick."""
        watcher = self._watcher
        if known is None or watcher is None or watcher.bias_learning is None:
            return None
        return watcher.bias_learning.progress(watcher.design, known)

    @property
    def stage(self) -> Stage:
        """State of the learning, without the numbers of the meters."""
        if self._watcher is not None and self.learner is None:
            return Stage.OFF
        if self.known is None:
            return Stage.WAITING
        learning = self.known.learning
        still = learning is not None and bool(np.isfinite(learning.since).any())
        return Stage.LEARNING if still else Stage.LEARNED

    def progress(self) -> CommissioningProgress:
        """Return the progress."""
        known, monitor = self.known, self._site.tables.meta.monitor
        found = self._found(known)
        meters = () if known is None or found is None else self._meters(known, found)
        still = [m for m in meters if m.state is Stage.LEARNING]
        needed = monitor.commission_s
        held = any(m.gathered_s is not None and m.gathered_s >= needed for m in still)
        return CommissioningProgress(
            feeder=self._site.feeder.name,
            estimator=monitor.estimator,
            state=self.stage,
            t=self._t,
            tick_s=monitor.tick_s,
            needed_s=needed,
            gathered_s=_least(m.gathered_s for m in still),
            since=_least(m.since for m in still),
            expected=None if held else _most(m.expected for m in still),
            learned_at=_most(m.learned_at for m in meters),
            held=held,
            restored=self.restored,
            note=self.note,
            expected_s=None if found is None else found.expected_s,
            stalled=sum(m.learning_state is LearningState.STALLED for m in meters),
            meters=meters,
        )

    def _meters(self, known: Commission, found: LearningProgress) -> tuple[MeterCommissioning, ...]:
        learned, learning = known.learned, known.learning
        base = self._site.customer_volt[self._site.meters]
        needed, t = self._site.tables.meta.monitor.commission_s, self._t
        none = np.full(learned.at.size, np.nan)
        since, gathered = (none, none) if learning is None else (learning.since, learning.time_s)
        error = base * (np.sqrt(1.0 + learned.bias) - 1.0)
        std, allowed = 0.5 * base * np.sqrt(learned.variance), 0.5 * base * learned.allowed
        return tuple(
            MeterCommissioning(
                meter=meter,
                state=Stage.LEARNING if np.isfinite(since[k]) else Stage.LEARNED,
                since=_time(since, k),
                learned_at=_time(learned.at, k),
                gathered_s=float(gathered[k]) if np.isfinite(since[k]) else None,
                expected=t + max(needed - float(gathered[k]), 0.0)
                if t is not None and np.isfinite(since[k])
                else None,
                error_volt=float(error[k]),
                error_volt_std=float(std[k]),
                allowed_volt=float(allowed[k]),
                learning_state=found.state[k],
                learning_reason=found.reason[k],
                watched_s=None if learning is None or np.isnan(since[k]) else float(learning.watched_s[k]),
                lost_s=_lost(learning, k) if np.isfinite(since[k]) else {},
            )
            for k, meter in enumerate(self._site.meter_ids)
        )


def _lost(learning: Learning | None, k: int) -> dict[LearningReason, float]:
    """Time that does not count for one meter, s, by reason."""
    if learning is None:
        return {}
    each = zip(LearningReason, learning.lost_s[:, k].tolist(), strict=True)
    return {reason: lost for reason, lost in each if lost > 0.0}


def _time(values: Floats, k: int) -> float | None:
    return float(values[k]) if np.isfinite(values[k]) else None


def _least(values: Any) -> float | None:
    return min((value for value in values if value is not None), default=None)


def _most(values: Any) -> float | None:
    return max((value for value in values if value is not None), default=None)
