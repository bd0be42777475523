"""State machine of alarms: delays, flapping, acknowledgement. Pure: time is an argument, state is a value.

`conditions` returns the conditions of one tick, `advance` turns a stream of such ticks into transitions::

    book = AlarmBook("village")
    book, transitions = advance(book, AlarmRules(), conditions(report), report.t)

A condition is present, absent, or unknown at a tick, and its state stands until the next one. Unknown
*holds*: the clock of that condition stops, nothing is raised and nothing is cleared, because no answer must
never look like no attack. An alarm is raised once its condition has been present for `on_delay_s` without an
absent tick in between, and cleared once it has been absent for `off_delay_s` without a present tick. Time
after an unknown tick counts for neither. Skipped ticks are unknown (`hold`), and so is a restart (`restore`).

The evidence of an alarm is that of the tick that raised it. It is updated when an error of the feeder's files
is found that explains the condition as well.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from gridsec.errors import GridsecError, InputInvalid, Problem
from service.alarms.conditions import AlarmEvidence, AlarmKind, Condition, Key, Severity, conditions
from service.errors import IdUnknown
from service.times import UtcTwins

INCIDENT_S = 60.0
"""Largest distance in time of alarms of one incident, s; two ticks if these are longer."""


class AlarmState(StrEnum):
    """State of an alarm. Clearing keeps the acknowledgement; raising again requires a new one."""

    RAISED = "raised"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"


class Change(StrEnum):
    """Change of an alarm."""

    RAISED = "raised"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"
    UPDATED = "updated"
    UNACKNOWLEDGED = "unacknowledged"
    COMMENTED = "commented"


class AlarmUnknown(IdUnknown):
    """No alarm has this id."""

    code = "unknown-alarm"
    kind = "alarm"


class AlreadyAcknowledged(GridsecError):
    """The alarm is already acknowledged."""

    code = "already-acknowledged"

    def __init__(self, alarm: Alarm) -> None:
        self.alarm = alarm
        super().__init__(f"alarm {alarm.id} has already been acknowledged by {alarm.acknowledged_by}")


class NotAcknowledged(GridsecError):
    """The alarm is not acknowledged."""

    code = "not-acknowledged"

    def __init__(self, alarm: Alarm) -> None:
        self.alarm = alarm
        super().__init__(f"alarm {alarm.id} is not acknowledged")


class RaisedAgain(GridsecError):
    """The acknowledgement refers to an earlier occurrence than the present one."""

    code = "raised-again"

    def __init__(self, alarm: Alarm, count: int) -> None:
        self.alarm = alarm
        super().__init__(
            f"this answers occurrence {count} of alarm {alarm.id}, which has been "
            f"raised {alarm.count} times by now: {alarm.reason}"
        )


@dataclass(frozen=True, slots=True)
class Alarm(UtcTwins):
    """An alarm. Times are Unix seconds."""

    id: str  # 26 characters, the first ten sort by time; the same data give the same id
    kind: AlarmKind
    feeder: str
    meter: Annotated[
        str | None,
        Field(description="Null for an alarm of the whole feeder; `substation` is the busbar meter."),
    ]
    severity: Severity
    state: AlarmState
    count: Annotated[int, Field(description="Number of occurrences; above 1 the alarm flaps.")]
    t_event: Annotated[float, Field(description="Start of the condition.")]
    t_raised: Annotated[float, Field(description="End of the on-delay.")]
    t_cleared: float | None
    reason: str
    evidence: AlarmEvidence
    acknowledged_by: str | None
    t_acknowledged: float | None
    comment: str | None
    customer: Annotated[
        str | None, Field(description="Customer of the inverter, for an alarm of an inverter.")
    ] = None

    @property
    def subject(self) -> str | None:
        """Subject of the alarm: a customer's inverter, a meter, or (None) the whole feeder."""
        return self.customer or self.meter

    @property
    def active(self) -> bool:
        """True until the alarm is cleared."""
        return self.state is not AlarmState.CLEARED


@dataclass(frozen=True, slots=True)
class AlarmTransition:
    """One change of one alarm: the alarm after it, the change, its time and the operator."""

    alarm: Alarm
    change: Change
    t: float
    who: str | None = None
    comment: str | None = None
    # Largest distance in time of alarms of the feeder with one cause, s.
    window_s: float = INCIDENT_S


_ALARM = TypeAdapter(Alarm)


def to_json(alarm: Alarm, *, stored: bool = False) -> dict[str, Any]:
    """Return the alarm as the JSON object of REST and zenoh, or (`stored`) without twins of times."""
    found: dict[str, Any] = _ALARM.dump_python(alarm, mode="json", round_trip=stored)
    return found


def from_json(data: Mapping[str, Any]) -> Alarm:
    """Return the alarm of `to_json`; further fields are ignored, absent newer ones have their defaults."""
    return _ALARM.validate_python(data)


# --- State machine ---


__all__ = [
    "Alarm",
    "AlarmBook",
    "AlarmEvidence",
    "AlarmKind",
    "AlarmRules",
    "AlarmState",
    "AlarmTransition",
    "AlarmUnknown",
    "AlreadyAcknowledged",
    "Change",
    "Condition",
    "NotAcknowledged",
    "RaisedAgain",
    "Severity",
    "acknowledged",
    "advance",
    "carried",
    "carry",
    "close",
    "commented",
    "conditions",
    "from_json",
    "hold",
    "restore",
    "to_json",
    "unacknowledged",
]


@dataclass(frozen=True, slots=True)
class AlarmRules:
    """Delays of alarms."""

    # on_delay_s, off_delay_s: time that a condition must be present before its alarm is raised, and absent
    # before it is cleared, s.
    on_delay_s: float = 2.0
    off_delay_s: float = 5.0
    # on_delays_s, off_delays_s: other delays for single kinds, s.
    on_delays_s: Mapping[AlarmKind, float] = field(default_factory=dict)
    off_delays_s: Mapping[AlarmKind, float] = field(default_factory=dict)
    # A condition that returns within this time after it cleared raises the same alarm again, s.
    memory_s: float = 600.0
    # A condition caused only by missing readings must be present for longer than this to raise an alarm, s.
    silence_s: float = 0.0
    # Largest distance in time of alarms of the feeder with one cause, s.
    incident_s: float = INCIDENT_S

    def __post_init__(self) -> None:
        times = (
            self.on_delay_s,
            self.off_delay_s,
            self.memory_s,
            self.silence_s,
            self.incident_s,
            *self.on_delays_s.values(),
            *self.off_delays_s.values(),
        )
        if not all(math.isfinite(s) and s >= 0.0 for s in times):
            raise InputInvalid([Problem("negative", f"delays must be finite and not negative: {self}")])

    def on(self, kind: AlarmKind) -> float:
        """Return the on-delay of a kind, s."""
        return self.on_delays_s.get(kind, self.on_delay_s)

    def off(self, kind: AlarmKind) -> float:
        """Return the off-delay of a kind, s."""
        return self.off_delays_s.get(kind, self.off_delay_s)


@dataclass(frozen=True, slots=True)
class Entry:
    """State of one condition in the book."""

    present: bool  # state at the last known tick
    onset: float  # start of the present run of equal states, s
    since: float  # the same, moved forward by every hold, so that t - since is the time that counts, s
    # End of the validity of the last known state: the last known tick, or the first unknown one after it, s.
    t_known: float
    held: bool  # True if unknown ticks followed
    # Its alarm: active, or cleared and remembered; None while the condition is only pending.
    alarm: Alarm | None


@dataclass(frozen=True, slots=True)
class AlarmBook:
    """Alarm state of one feeder. A value: `advance` and `carry` return a new one."""

    feeder: str
    t: float | None = None  # time of the last tick, s; None before the first one
    entries: Mapping[Key, Entry] = field(default_factory=dict)  # by kind and subject

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """All alarms that are active, or cleared and still remembered; oldest first."""
        found = (e.alarm for e in self.entries.values() if e.alarm is not None)
        return tuple(sorted(found, key=lambda alarm: alarm.id))

    @property
    def active(self) -> tuple[Alarm, ...]:
        """All active alarms; oldest first."""
        return tuple(alarm for alarm in self.alarms if alarm.active)


def advance(
    book: AlarmBook, rules: AlarmRules, conditions: Iterable[Condition], t: float
) -> tuple[AlarmBook, tuple[AlarmTransition, ...]]:
    """Update the book by one tick.

    `conditions` are those of this tick: one that is not in it is absent. A tick before the last one holds
    every clock. Raises ValueError if a condition belongs to another feeder.

    Returns book, transitions: the new state, and the transitions, in a reproducible order.
    """
    seen: dict[Key, Condition] = {}
    for condition in conditions:
        if condition.feeder != book.feeder:
            text = f"a condition of {condition.feeder!r} in the book of {book.feeder!r}"
            raise InputInvalid([Problem("other-feeder", text)])
        seen[condition.kind, condition.subject] = condition
    backwards = book.t is not None and t < book.t
    entries: dict[Key, Entry] = {}
    transitions: list[AlarmTransition] = []
    for key in sorted({*book.entries, *seen}, key=_order):
        old, condition_now = book.entries.get(key), seen.get(key)
        if condition_now is not None and not condition_now.known:
            entry = None if old is None else _hold(old, t)
        else:
            entry, transition = _settle(
                _timed(old, condition_now is not None, t, backwards), condition_now, rules, key, t
            )
            transitions.extend(transition)
        if entry is not None:
            entries[key] = entry
    return AlarmBook(book.feeder, t, entries), tuple(transitions)


def hold(book: AlarmBook, t: float) -> AlarmBook:
    """Return the book after skipped ticks: every clock stops, as at an unknown tick.

    `t` is the time of the first skipped tick.
    """
    return replace(book, entries={key: _hold(entry, t) for key, entry in book.entries.items()})


def _order(key: Key) -> tuple[str, str]:
    return key[0].value, key[1] or ""


def _hold(old: Entry, t: float) -> Entry:
    """Return the entry after an unknown tick; its clock stops here."""
    # The clock stops at the first unknown tick, not at the last known one: otherwise a meter available at
    # every other tick would never raise an alarm.
    if old.held:
        return old
    return replace(old, held=True, t_known=max(old.t_known, t))


def _timed(old: Entry | None, present: bool, t: float, backwards: bool) -> Entry:
    """Return the entry after a known tick, with its clock advanced."""
    if old is None or old.present != present:
        return Entry(present, t, t, t, held=False, alarm=None if old is None else old.alarm)
    pause = t - old.t_known if old.held or backwards else 0.0
    return replace(old, since=old.since + pause, t_known=t, held=False)


def _settle(
    entry: Entry, condition: Condition | None, rules: AlarmRules, key: Key, t: float
) -> tuple[Entry | None, tuple[AlarmTransition, ...]]:
    """Raise, clear or drop the alarm of an entry if it is due."""
    kind, alarm = key[0], entry.alarm
    lasted = t - entry.since
    if condition is not None:
        return _present(entry, condition, rules, t)
    if alarm is None:
        return None, ()
    if alarm.active:
        if lasted < rules.off(kind):
            return entry, ()
        alarm = replace(alarm, state=AlarmState.CLEARED, t_cleared=t)
        return replace(entry, alarm=alarm), (AlarmTransition(alarm, Change.CLEARED, t),)
    return (entry if _remembered(alarm, rules, t) else None), ()


def _present(
    entry: Entry, condition: Condition, rules: AlarmRules, t: float
) -> tuple[Entry, tuple[AlarmTransition, ...]]:
    """Raise the alarm of a present condition when it is due, and update its evidence."""
    alarm, lasted = entry.alarm, t - entry.since
    if alarm is None or not alarm.active:
        due = lasted >= rules.on(condition.kind) and (not condition.unheard or lasted > rules.silence_s)
        if not due:
            return entry, ()
        alarm, change = _raise(alarm, condition, rules, entry.onset, t), Change.RAISED
    elif _explains_more(condition.evidence, alarm.evidence):
        alarm, change = replace(alarm, reason=condition.reason, evidence=condition.evidence), Change.UPDATED
    else:
        return entry, ()
    return replace(entry, alarm=alarm), (AlarmTransition(alarm, change, t, window_s=rules.incident_s),)


def _explains_more(now: AlarmEvidence, before: AlarmEvidence) -> bool:
    """True if an error of the feeder's files explains the condition and is new to the alarm."""
    error, told = now.data_error, before.data_error
    if error is None or told is None:
        return error is not None
    return (error.kind, set(error.customers), error.proposed) != (
        told.kind,
        set(told.customers),
        told.proposed,
    )


def _remembered(alarm: Alarm, rules: AlarmRules, t: float) -> bool:
    # With the clock set back, or a repeated recording, the clearing is in the future: the difference counts
    # in both directions.
    return alarm.t_cleared is not None and abs(t - alarm.t_cleared) <= rules.memory_s


def _raise(old: Alarm | None, condition: Condition, rules: AlarmRules, onset: float, t: float) -> Alarm:
    again = old is not None and _remembered(old, rules, onset)
    return Alarm(
        id=old.id if old is not None and again else alarm_id(condition, onset),
        kind=condition.kind,
        feeder=condition.feeder,
        meter=condition.meter,
        severity=condition.severity,
        state=AlarmState.RAISED,
        count=old.count + 1 if old is not None and again else 1,
        t_event=onset,
        t_raised=t,
        t_cleared=None,
        reason=condition.reason,
        evidence=condition.evidence,
        acknowledged_by=None,
        t_acknowledged=None,
        comment=None,
        customer=condition.customer,
    )


_CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


def alarm_id(condition: Condition, onset: float) -> str:
    """Return the id of the alarm of a condition that began at `onset`.

    In the form of a ULID: ten characters of Crockford's base 32 for the milliseconds, then sixteen, which are
    a hash instead of random bits, so that a replay gives the same ids.
    """
    return ulid(onset, condition.kind, condition.feeder, condition.subject or "", repr(onset))


def ulid(t: float, *parts: str) -> str:
    """Return an id in the form of a ULID, with a hash of the parts instead of random bits."""
    tail = int.from_bytes(hashlib.sha256("\0".join(parts).encode()).digest()[:10], "big")
    number = (max(0, int(t * 1000.0)) % (1 << 48)) << 80 | tail
    return "".join(_CROCKFORD[number >> shift & 31] for shift in range(125, -1, -5))


def acknowledged(
    alarm: Alarm, who: str, comment: str, t: float, *, count: int | None = None
) -> AlarmTransition:
    """Return the transition by which an operator acknowledges an alarm.

    A cleared alarm without an acknowledgement can still be acknowledged; it stays cleared.

    `count` is the occurrence that the operator refers to; None: the latest. Raises RaisedAgain if the alarm
    has been raised again: the acknowledgement refers to an earlier occurrence. Raises AlreadyAcknowledged if
    the same occurrence is already acknowledged.
    """
    if count is not None and count != alarm.count:
        raise RaisedAgain(alarm, count)
    if alarm.acknowledged_by is not None:
        raise AlreadyAcknowledged(alarm)
    answered = replace(
        alarm,
        state=AlarmState.ACKNOWLEDGED if alarm.active else alarm.state,
        acknowledged_by=who,
        t_acknowledged=t,
        comment=comment,
    )
    return AlarmTransition(answered, Change.ACKNOWLEDGED, t, who, comment)


def unacknowledged(alarm: Alarm, who: str, comment: str, t: float) -> AlarmTransition:
    """Return the transition by which an operator withdraws the acknowledgement of an alarm.

    Raises NotAcknowledged if there is none.
    """
    if alarm.acknowledged_by is None:
        raise NotAcknowledged(alarm)
    open_again = replace(
        alarm,
        state=AlarmState.RAISED if alarm.active else alarm.state,
        acknowledged_by=None,
        t_acknowledged=None,
        comment=None,
    )
    return AlarmTransition(open_again, Change.UNACKNOWLEDGED, t, who, comment)


def commented(alarm: Alarm, who: str, comment: str, t: float) -> AlarmTransition:
    """Return the transition by which an operator adds a comment; the alarm stays as it is."""
    return AlarmTransition(alarm, Change.COMMENTED, t, who, comment)


def carried(alarm: Alarm, answered: Alarm) -> Alarm:
    """Return an alarm with the acknowledgement, or its withdrawal, that was stored while it changed.

    `answered` is ignored for another alarm or occurrence.
    """
    if (alarm.id, alarm.count) != (answered.id, answered.count):
        return alarm
    now = AlarmState.RAISED if answered.acknowledged_by is None else AlarmState.ACKNOWLEDGED
    return replace(
        alarm,
        state=now if alarm.active else alarm.state,
        acknowledged_by=answered.acknowledged_by,
        t_acknowledged=answered.t_acknowledged,
        comment=answered.comment,
    )


def carry(book: AlarmBook, answered: Alarm) -> AlarmBook | None:
    """Return the book with a stored acknowledgement; None if its occurrence is over."""
    for key, entry in book.entries.items():
        alarm = entry.alarm
        if alarm is not None and (alarm.id, alarm.count) == (answered.id, answered.count):
            entries = {**book.entries, key: replace(entry, alarm=carried(alarm, answered))}
            return replace(book, entries=entries)
    return None


def close(alarms: Iterable[Alarm], t: float, why: str) -> tuple[AlarmTransition, ...]:
    """Return the transitions that clear alarms without a monitor.

    `why` is the reason for the event; cleared alarms are left out.
    """
    cleared = (replace(alarm, state=AlarmState.CLEARED, t_cleared=t) for alarm in alarms if alarm.active)
    return tuple(AlarmTransition(alarm, Change.CLEARED, t, None, why) for alarm in cleared)


def restore(feeder: str, alarms: Iterable[Alarm]) -> AlarmBook:
    """Return the book of a feeder from its stored alarms, after a restart.

    The restart is a hold: no tick is known. Alarms keep their id, count, state and acknowledgement. A running
    clock (a pending condition, an alarm about to clear) restarts from zero. A transition may therefore come
    later than without the restart, by less than its delay, and never earlier.

    `alarms` are the active ones and those that cleared within the memory of the rules, in any order. Of
    several with the same kind and subject one counts: an active one before cleared ones, then the one raised
    last.
    """
    entries: dict[Key, Entry] = {}
    # Ids follow a clock that may have been set back since, so that they do not tell which alarm is active.
    for alarm in sorted(alarms, key=lambda alarm: (alarm.active, alarm.t_raised, alarm.id)):
        if alarm.feeder != feeder:
            text = f"an alarm of {alarm.feeder!r} in the book of {feeder!r}"
            raise InputInvalid([Problem("other-feeder", text)])
        t = alarm.t_raised if alarm.t_cleared is None else alarm.t_cleared
        entries[alarm.kind, alarm.subject] = Entry(alarm.active, t, t, t, held=True, alarm=alarm)
    return AlarmBook(feeder, None, entries)
