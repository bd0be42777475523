"""Notices: stored events of incidents in the order of their numbers, in the form that every target shares.

One incident groups the alarms of one cause, so that forty alarms of one attack are one notification. A shelf
and planned work suppress the notices of an incident. The end of an incident is a notice if any earlier event
of it was one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

from service.alarms.incidents import (
    Incident,
    IncidentChange,
    IncidentEvent,
    IncidentState,
    event_json,
)
from service.alarms.state_machine import Severity
from service.store import Store

MAIN_CHANGES: Final = (
    IncidentChange.OPENED,
    IncidentChange.ESCALATED,
    IncidentChange.REOPENED,
    IncidentChange.UNSHELVED,
    IncidentChange.WORK_ENDED,
    IncidentChange.CLEARED,
)
"""Changes that a webhook receives without a filter: begin and end of an incident, and of its suppression."""
_PAGE: Final = 500
"""Number of open incidents in one read."""


@dataclass(frozen=True, slots=True)
class Notice:
    """One event of an incident. Times are Unix seconds."""

    number: int  # number of the event: increases in the order of commits
    subject: str  # id of the incident
    type: str  # such as `incident.opened`
    t: float
    change: str
    feeder: str
    kind: str
    severity: str
    active: bool  # the incident is open and not suppressed
    notify: bool  # the event is a notice; false while suppressed by a shelf or by planned work
    began: float  # start of the first condition
    ended: float | None  # time at which it was cleared
    summary: str  # one sentence
    meters: tuple[str, ...]  # meters and customers
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
        """Return the present state of all active incidents; `number` is 0."""


class IncidentSource:
    """Events of incidents in the service's database."""

    def __init__(self, store: Store) -> None:
        self._store = store

    @property
    def newest(self) -> int:
        """Number of the newest event."""
        return self._store.last_incident_event

    def after(self, number: int, limit: int) -> list[Notice]:
        """Return the events after a number, oldest first."""
        found = self._store.incident_events_after(number, limit=limit)
        return [_notice(event, notify=event.notify or self._ends_a_notice(event)) for event in found]

    def _ends_a_notice(self, event: IncidentEvent) -> bool:
        """True for the end of an incident with an earlier notice."""
        if event.change is not IncidentChange.CLEARED:
            return False
        earlier = self._store.incident_events(event.incident.id)
        return any(each.notify for each in earlier if each.seq < event.seq)

    def active(self) -> list[Notice]:
        """Return the open incidents that neither a shelf nor planned work suppresses."""
        found: list[Incident] = []
        cursor: str | None = None
        while True:
            page, cursor = self._store.incidents(
                state=(IncidentState.RAISED, IncidentState.ACKNOWLEDGED),
                shelved=False,
                planned=False,
                cursor=cursor,
                limit=_PAGE,
            )
            found += page
            if cursor is None:
                break
        opened = IncidentChange.OPENED
        return [
            _notice(IncidentEvent(0, each.t_first, opened, None, None, True, each), notify=True)
            for each in found
        ]


def _notice(event: IncidentEvent, *, notify: bool) -> Notice:
    incident = event.incident
    return Notice(
        number=event.seq,
        subject=incident.id,
        type=f"incident.{event.change}",
        t=event.t,
        change=str(event.change),
        feeder=incident.feeder,
        kind=str(incident.kind),
        severity=str(incident.severity),
        active=incident.open and event.notify,
        notify=notify,
        began=incident.t_first,
        ended=incident.t_cleared,
        summary=_summary(incident),
        meters=(*incident.meters, *incident.customers),
        data=event_json(event),
    )


def _summary(incident: Incident) -> str:
    count = f"{incident.alarms} alarms, " if incident.alarms > 1 else ""
    return f"{incident.feeder}: {incident.kind}: {count}{incident.reason or incident.severity}"


def trial_notice(now: float) -> Notice:
    """Return the notice of `gridsec notify test`. `now` is the Unix time, s."""
    text = "Test message of gridsec"
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
        notify=True,
        began=now,
        ended=now,
        summary=text,
        meters=(),
        data={"t": now, "text": text},
    )
