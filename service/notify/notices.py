"""Notices: stored events in the order of their numbers, in the form that every target shares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from service.alarms.state_machine import Alarm, Change, Severity, to_json
from service.store import AlarmEvent, Store


@dataclass(frozen=True, slots=True)
class Notice:
    """One event. Times are Unix seconds."""

    number: int  # number of the event: increases in the order of commits
    subject: str  # id of the alarm
    type: str  # such as `alarm.raised`
    t: float
    change: str
    feeder: str
    kind: str
    severity: str
    active: bool  # the alarm is active after the event
    began: float  # start of the condition
    ended: float | None  # time at which it was cleared
    summary: str  # one sentence
    labels: Mapping[str, str]  # identity of the alarm at Alertmanager, beside kind, feeder and severity
    data: Mapping[str, Any]  # the event as in REST

    @property
    def message_id(self) -> str:
        """Id of the message, the same at every attempt and for every target."""
        return f"msg_{self.subject}_{self.number}"


class Source(Protocol):
    """Numbered stored events. Thread-safe."""

    @property
    def newest(self) -> int:
        """Number of the newest event; without a call to the database."""

    def after(self, number: int, limit: int) -> list[Notice]:
        """Return the events after a number, oldest first."""

    def active(self) -> list[Notice]:
        """Return the present state of all active subjects; `number` is 0."""


class AlarmSource:
    """Events of alarms."""

    def __init__(self, store: Store) -> None:
        self._store = store

    @property
    def newest(self) -> int:
        """Number of the newest event."""
        return self._store.last_event

    def after(self, number: int, limit: int) -> list[Notice]:
        """Return the events after a number, oldest first."""
        return [_notice(event) for event in self._store.events_after(number, limit=limit)]

    def active(self) -> list[Notice]:
        """Return the active alarms."""
        found = self._store.active()
        return [
            _notice(AlarmEvent(0, alarm.t_raised, Change.RAISED, None, None, alarm))
            for alarm in found
            if alarm.active
        ]


def _notice(event: AlarmEvent) -> Notice:
    alarm = event.alarm
    return Notice(
        number=event.seq,
        subject=alarm.id,
        type=f"alarm.{event.change}",
        t=event.t,
        change=str(event.change),
        feeder=alarm.feeder,
        kind=str(alarm.kind),
        severity=str(alarm.severity),
        active=alarm.active,
        began=alarm.t_event,
        ended=alarm.t_cleared,
        summary=_summary(alarm),
        labels={name: text for name, text in (("meter", alarm.meter), ("customer", alarm.customer)) if text},
        data={
            "seq": event.seq,
            "t": event.t,
            "change": str(event.change),
            "who": event.who,
            "comment": event.comment,
            "alarm": to_json(alarm),
        },
    )


def _summary(alarm: Alarm) -> str:
    where = alarm.feeder if alarm.meter is None else f"{alarm.feeder}, {alarm.meter}"
    return f"{where}: {alarm.reason or alarm.kind}"


def trial_notice(now: float) -> Notice:
    """Return the notice of `gridsec notify test`. `now` is the Unix time, s."""
    return Notice(
        number=0,
        subject=f"test{int(now * 1e3)}",
        type="test",
        t=now,
        change="test",
        feeder="test",
        kind="test",
        severity=str(Severity.MINOR),
        active=False,
        began=now,
        ended=now,
        summary="Test message of gridsec",
        labels={},
        data={"t": now, "text": "Test message of gridsec"},
    )
