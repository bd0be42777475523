"""How far the monitor of one feeder knows its meters' own errors: followed, kept, and begun anew.

`Commissioning` has no clock and no input or output, like the `Watch` that owns it: time comes from the
ticks, texts that are kept come and go as values. Readers on other threads only take references.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from feeders.model.site import Site
from feeders.registry.registry import Learner, Watcher
from gridsec.arrays import Bools, Floats
from gridsec.errors import GridsecError, Problem
from gridsec.estimators.sequential import (
    Commission,
    Learning,
    LearningProgress,
    LearningReason,
    LearningState,
    to_arrays,
)
from service.report.report import LearningReport, StalledMeter
from service.store.schema import Happened, Step
from service.store.state_codec import Kept, KeptInvalid, decode, encode, fingerprint

SAVE_S = 60.0
"""What is gathered is kept this often, s; all else at once."""


class NothingToLearn(GridsecError):
    """The feeder's monitor does not learn its meters' errors."""

    code = "nothing-to-learn"

    def __init__(self, feeder: str, why: Problem) -> None:
        super().__init__(f"feeder {feeder!r}: {why}", code=why.code)


class Stage(StrEnum):
    """Where the commissioning of a feeder, or of a meter, stands."""

    OFF = "off"
    WAITING = "waiting"
    LEARNING = "learning"
    LEARNED = "learned"


@dataclass(frozen=True, slots=True)
class MeterStage:
    """One meter.

    Attributes
    ----------
    meter
        Its id.
    state
        Learning or learned.
    since, learned_at
        Since when it is being learned, or when it was learned, Unix s.
    gathered_s
        For how long it was heard and trusted while being learned, s.
    expected
        When it will be learned if it is heard and trusted from now on, Unix s.
    error_volt, error_volt_std
        Its own fixed error at the nominal voltage, and the standard deviation of that, V.
    allowed_volt
        By how much it may honestly differ from that error, V.
    learning_state, learning_reason
        As in `gridsec.estimators.sequential.LearningProgress`.
    watched_s
        Time of all ticks since learning began, s; None once the meter is learned.
    lost_s
        Time that did not count, s, by reason; reasons without any are left out.
    """

    meter: str
    state: Stage
    since: float | None
    learned_at: float | None
    gathered_s: float | None
    expected: float | None
    error_volt: float
    error_volt_std: float
    allowed_volt: float
    learning_state: LearningState
    learning_reason: LearningReason | None
    watched_s: float | None
    lost_s: dict[LearningReason, float]


@dataclass(frozen=True, slots=True)
class Progress:
    """A feeder.

    Attributes
    ----------
    feeder, estimator
        Its name, and what watches it.
    state
        Learning as long as one meter is.
    t
        Unix time of the tick that this is about, s.
    tick_s
        Interval of the monitor's steps, s.
    needed_s, gathered_s
        For how long meters have to be heard, and for how long the last one was, s.
    since, expected, learned_at
        The earliest begin, the latest expected end, and when the last one was learned, Unix s.
    held
        Time enough has gone by, but somebody is suspected: such a meter is not learned, and as long as it is
        not named nobody is.
    restored
        Whether this goes on from what was kept by an earlier run.
    note
        Why it does not, if something was kept.
    expected_s
        Time that learning takes if every tick counts, s; None without a monitor that learns.
    stalled
        Number of meters that are not learned after twice that time.
    meters
        One by one.
    """

    feeder: str
    estimator: str
    state: Stage
    t: float | None
    tick_s: float
    needed_s: float
    gathered_s: float | None
    since: float | None
    expected: float | None
    learned_at: float | None
    held: bool
    restored: bool
    note: str
    expected_s: float | None
    stalled: int
    meters: tuple[MeterStage, ...]


class Commissioning:
    """The commissioning of one feeder.

    Parameters
    ----------
    site
        The feeder.
    kept
        What the store has of it.

    Attributes
    ----------
    known
        What is known of the meters' errors; None before the first tick, unless something was kept.
    restored, note
        As in `Progress`.
    """

    def __init__(self, site: Site, kept: Kept | None = None) -> None:
        self.known: Commission | None = None
        self.restored = False
        self.note = ""
        self._site, self._kept, self._fingerprint = site, kept, fingerprint(site)
        self._watcher: Watcher | None = None
        self._t: float | None = None
        self._saved_t: float | None = None
        self._happened: tuple[Happened, ...] = ()

    @property
    def learner(self) -> Learner | None:
        """How the present monitor learns; None where it does not, or where there is none yet."""
        return None if self._watcher is None else self._watcher.learner

    def install(self, watcher: Watcher) -> None:
        """Take a finished design, and what was kept if it fits.

        Parameters
        ----------
        watcher
            The design.
        """
        self._watcher = watcher
        if self.learner is None:
            self.known = None
        elif self.known is None and self._kept is not None:
            try:
                self.known = self.learner.read(
                    watcher.design, decode(self._site, self._fingerprint, self._kept)
                )
            except (KeptInvalid, ValueError) as error:
                self.note = f"what was learned until {self._kept.t:.0f} is not used: {error}"
            else:
                self._t = self._saved_t = self._kept.t
                self.restored = True

    def follow(self, state: Any, t: float) -> None:
        """Take over what a tick brought.

        Parameters
        ----------
        state
            The monitor's, after the tick.
        t
            Unix time of the tick, s.
        """
        if self.learner is None:
            return
        before, self.known, self._t = self.known, self.learner.commission(state), t
        if before is None:
            every = np.ones(len(self._site.meter_ids), dtype=np.bool_)
            self._note(Step.BEGUN, every, t, reason=self.note)
        elif self.known.learned is not before.learned:
            self._note(Step.LEARNED, self.known.learned.at == t, t)

    def renew(self, state: Any, meters: Sequence[str], t: float, who: str, reason: str) -> Any:
        """Learn meters anew.

        Parameters
        ----------
        state
            The monitor's; None before the first tick.
        meters
            Which; none for all.
        t, who, reason
            When (Unix s), who wants it, and why.

        Returns
        -------
        Any
            The monitor's new state; None if it was None.

        Raises
        ------
        NothingToLearn
            If the monitor does not learn.
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
        self._note(Step.RECOMMISSIONED, which, t, who=who, reason=reason)
        return None if state is None else after

    def _why_not(self) -> Problem:
        if self._watcher is None:
            return Problem("no-monitor", "there is no monitor yet, or it could not be designed")
        family = self._watcher.family
        if family.learner is None:
            text = f"its estimator, {family.name}, does not learn meters' errors"
            return Problem("never-learns", text)
        return Problem("learning-off", "commission_s is 0: nothing is learned")

    def _note(
        self, change: Step, which: Bools, t: float, *, who: str | None = None, reason: str = ""
    ) -> None:
        meters = tuple(meter for meter, one in zip(self._site.meter_ids, which, strict=True) if one)
        one_more = Happened(self._site.feeder.name, t, change, meters, who, reason)
        # Never changed in place: whoever took a copy of all this can go back to it.
        self._happened = (*self._happened, one_more)

    # ---------------------------------------------------------------- to keep

    def now(self) -> Kept | None:
        """Return the present state as it is stored; None before the first tick."""
        if self.known is None or self._t is None:
            return None
        return encode(self._site, self._fingerprint, self._t, to_arrays(self.known))

    def due(self, *, at_once: bool = False) -> tuple[tuple[Kept, ...], tuple[Happened, ...]]:
        """Return what is to be stored now; it counts as stored from here on.

        Parameters
        ----------
        at_once
            Also what could wait.
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

    # ---------------------------------------------------------------- to show

    def report(self) -> LearningReport:
        """Return the learning of the meters as a tick's report shows it."""
        known = self.known
        found = self._found(known)
        if known is None or found is None:
            return LearningReport()
        gathered = np.zeros(len(found.state)) if known.learning is None else known.learning.time_s
        stalled = tuple(
            StalledMeter(meter, found.reason[k], float(gathered[k]))
            for k, meter in enumerate(self._site.meter_ids)
            if found.state[k] is LearningState.STALLED
        )
        return LearningReport(found.state, found.reason, found.expected_s, stalled)

    def _found(self, known: Commission | None) -> LearningProgress | None:
        """Progress by the estimator; None without one that learns, and before the first tick."""
        watcher = self._watcher
        if known is None or watcher is None or watcher.learner is None:
            return None
        return watcher.learner.progress(watcher.design, known)

    def progress(self) -> Progress:
        """Return how far it is."""
        known, learner, monitor = self.known, self.learner, self._site.tables.meta.monitor
        found = self._found(known)
        meters = () if known is None or found is None else self._meters(known, found)
        still = [m for m in meters if m.state is Stage.LEARNING]
        if self._watcher is not None and learner is None:
            state = Stage.OFF
        elif known is None:
            state = Stage.WAITING
        else:
            state = Stage.LEARNING if still else Stage.LEARNED
        needed = monitor.commission_s
        held = any(m.gathered_s is not None and m.gathered_s >= needed for m in still)
        return Progress(
            feeder=self._site.feeder.name,
            estimator=monitor.estimator,
            state=state,
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

    def _meters(self, known: Commission, found: LearningProgress) -> tuple[MeterStage, ...]:
        learned, learning = known.learned, known.learning
        base = self._site.customer_volt[self._site.meters]
        needed, t = self._site.tables.meta.monitor.commission_s, self._t
        none = np.full(learned.at.size, np.nan)
        since, gathered = (none, none) if learning is None else (learning.since, learning.time_s)
        error = base * (np.sqrt(1.0 + learned.bias) - 1.0)
        std, allowed = 0.5 * base * np.sqrt(learned.variance), 0.5 * base * learned.allowed
        return tuple(
            MeterStage(
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


def to_json(progress: Progress) -> dict[str, Any]:
    """Return the JSON object that REST shows.

    Parameters
    ----------
    progress
        How far it is.
    """
    return asdict(progress)


def _lost(learning: Learning | None, k: int) -> dict[LearningReason, float]:
    """Time that did not count for one meter, s, by reason."""
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
