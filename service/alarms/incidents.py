"""Incidents: alarms of one feeder with one cause. Pure: time is an argument, state is a value.

`advance` turns the transitions of alarms into those of incidents::

    book, happened = advance(IncidentBook("village"), transitions, now)

A raised alarm joins the incident that had it, or an incident of the same feeder and cause with an alarm
raised, or the last one cleared, within the alarm's `window_s`. Otherwise it opens an incident. `undecided`
joins a manipulation and a data loss, which take over its incident. The result does not depend on the
division of the transitions into commits.

A *shelf* suppresses notifications of alarms until its end, or until an alarm of a higher severity is
raised. *Planned work* suppresses those of a feeder from its begin to its end. Both leave the states of alarms
and incidents unchanged. Their times refer to the wall clock `now`, all others to the clock of the alarms.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter

from gridsec.errors import GridsecError
from service.alarms.conditions import AlarmKind, Severity
from service.alarms.state_machine import AlarmState, AlarmTransition, Change, ulid
from service.errors import IdUnknown
from service.times import UtcTwins

T = TypeVar("T")


class IncidentKind(StrEnum):
    """Cause of an incident, in descending order of precedence."""

    MANIPULATION = "manipulation"
    IDENTITY_MISMATCH = "identity-mismatch"
    DATA_LOSS = "data-loss"
    VOLTAGE_LIMIT = "voltage-limit"
    UNDECIDED = "undecided"
    CLOCK_OFFSET = "clock-offset"
    LEARNING_STALLED = "learning-stalled"


class IncidentState(StrEnum):
    """State of an incident."""

    RAISED = "raised"  # an active alarm is not acknowledged
    ACKNOWLEDGED = "acknowledged"  # all active alarms are acknowledged
    CLEARED = "cleared"  # no alarm is active


class IncidentChange(StrEnum):
    """Change of an incident."""

    OPENED = "opened"  # its first alarm was raised
    EXTENDED = "extended"  # further alarms were raised
    ESCALATED = "escalated"  # an alarm of a higher severity was raised
    REOPENED = "reopened"  # an alarm was raised after all had cleared
    UPDATED = "updated"  # other changes of its alarms
    CLEARED = "cleared"  # its last active alarm has cleared
    ACKNOWLEDGED = "acknowledged"  # the last active alarm was acknowledged
    UNACKNOWLEDGED = "unacknowledged"  # an acknowledgement was withdrawn
    ASSIGNED = "assigned"  # assigned to a person, or to none
    COMMENTED = "commented"
    SHELVED = "shelved"  # all active alarms are shelved
    UNSHELVED = "unshelved"  # the shelf has ended
    WORK_BEGUN = "work-begun"  # planned work of the feeder has begun
    WORK_ENDED = "work-ended"  # planned work of the feeder has ended


_CAUSE = {
    AlarmKind.METER_MANIPULATED: IncidentKind.MANIPULATION,
    AlarmKind.INVERTER_MANIPULATED: IncidentKind.MANIPULATION,
}
_ORDER = tuple(IncidentKind)
_SEVERITIES = tuple(Severity)
_HOSTS = frozenset({IncidentKind.MANIPULATION, IncidentKind.DATA_LOSS})
"""Causes that explain an undecided verdict."""


def cause_of(kind: AlarmKind) -> IncidentKind:
    """Return the kind of an incident of alarms of this kind."""
    return _CAUSE.get(kind) or IncidentKind(kind.value)


def higher(one: Severity, other: Severity) -> bool:
    """True if the first severity is higher than the second one."""
    return _SEVERITIES.index(one) < _SEVERITIES.index(other)


@dataclass(frozen=True, slots=True)
class Incident(UtcTwins):
    """An incident. Times are Unix seconds."""

    id: str  # 26 characters, the first ten sort by time; the same data give the same id
    kind: IncidentKind
    feeder: str
    severity: Annotated[Severity, Field(description="Highest severity of its alarms so far.")]
    state: IncidentState
    count: Annotated[int, Field(description="Number of raisings of its alarms.")]
    alarms: Annotated[int, Field(description="Number of its alarms, cleared ones included.")]
    active: Annotated[int, Field(description="Number of active alarms.")]
    unacknowledged: Annotated[int, Field(description="Number of active alarms without acknowledgement.")]
    kinds: Annotated[tuple[AlarmKind, ...], Field(description="Kinds of its alarms.")]
    meters: Annotated[tuple[str, ...], Field(description="Meters of its alarms, in the order of raising.")]
    customers: Annotated[tuple[str, ...], Field(description="Customers with alarms of their inverters.")]
    t_first: Annotated[float, Field(description="Start of the first condition.")]
    t_last: Annotated[float, Field(description="Latest raising of one of its alarms.")]
    t_cleared: float | None
    reason: Annotated[str, Field(description="Reason of the first alarm of the highest severity.")]
    acknowledged_by: Annotated[
        str | None, Field(description="Operator of the latest acknowledgement since the last raising.")
    ] = None
    t_acknowledged: float | None = None
    assigned_to: str | None = None
    comments: Annotated[int, Field(description="Number of comments on the incident.")] = 0
    shelved_until: Annotated[
        float | None, Field(description="End of the shelf of all its active alarms; null without one.")
    ] = None
    planned_work: Annotated[
        str | None, Field(description="Id of the latest planned work during which alarms were raised.")
    ] = None
    planned_until: Annotated[
        float | None, Field(description="End of the present planned work; null without one.")
    ] = None

    @property
    def open(self) -> bool:
        """True until its last active alarm is cleared."""
        return self.state is not IncidentState.CLEARED

    @property
    def notify(self) -> bool:
        """True if neither a shelf nor planned work suppresses its notifications."""
        return self.shelved_until is None and self.planned_until is None


@dataclass(frozen=True, slots=True)
class IncidentTransition:
    """One change of one incident: the incident after it, the change, its time and the operator."""

    incident: Incident
    change: IncidentChange
    t: float
    who: str | None = None
    comment: str | None = None
    notify: bool = True  # false while shelved or under planned work


@dataclass(frozen=True, slots=True)
class IncidentEvent(UtcTwins):
    """A stored change of an incident, and the incident after it.

    Readers page through the events by `seq` (`Store.incident_events_after`). A notification begins with the
    first event of an incident with `notify`, continues by the reader's own choice of changes, and ends with
    `cleared`, whatever `notify` states.
    """

    seq: int  # increases in the order of commits and is never reused
    t: float
    change: IncidentChange
    who: str | None
    comment: str | None
    notify: Annotated[bool, Field(description="False while shelved or under planned work.")]
    incident: Incident


_INCIDENT = TypeAdapter(Incident)
_INCIDENT_EVENT = TypeAdapter(IncidentEvent)


def incident_json(incident: Incident, *, stored: bool = False) -> dict[str, Any]:
    """Return the incident as the JSON object of REST, or (`stored`) without twins of times."""
    found: dict[str, Any] = _INCIDENT.dump_python(incident, mode="json", round_trip=stored)
    return found


def incident_of(data: Mapping[str, Any]) -> Incident:
    """Return the incident of `incident_json`; absent newer fields have their defaults."""
    return _INCIDENT.validate_python(data)


def event_json(event: IncidentEvent) -> dict[str, Any]:
    """Return an event as the JSON object of REST and zenoh."""
    found: dict[str, Any] = _INCIDENT_EVENT.dump_python(event, mode="json")
    return found


# --- Shelves and planned work ---


class IncidentUnknown(IdUnknown):
    """No incident has this id."""

    code = "unknown-incident"
    kind = "incident"


class IncidentChanged(GridsecError):
    """The action refers to an earlier state of the incident than the present one."""

    code = "incident-changed"

    def __init__(self, incident: Incident, count: int) -> None:
        self.incident = incident
        super().__init__(
            f"this answers {count} raisings of incident {incident.id}, which has {incident.count} by now: "
            f"{incident.reason}"
        )


class ShelfUnknown(IdUnknown):
    """No shelf has this id."""

    code = "unknown-shelf"
    kind = "shelf"


class WorkUnknown(IdUnknown):
    """No planned work has this id."""

    code = "unknown-planned-work"
    kind = "planned work"


class WrongTime(GridsecError):
    """The time of a shelf or of planned work is outside of its limits."""

    code = "wrong-time"


@dataclass(frozen=True, slots=True)
class Shelf(UtcTwins):
    """Suppression of the notifications of alarms. Times are Unix seconds.

    It applies to the alarms of the feeder that have all given ones of `alarm`, `incident`, `meter`, `kind`.
    """

    id: str
    feeder: str
    alarm: str | None
    incident: str | None
    meter: str | None
    kind: AlarmKind | None
    severity: Annotated[Severity, Field(description="An alarm of a higher severity ends the shelf.")]
    who: str
    reason: str
    t: Annotated[float, Field(description="Begin.")]
    until: Annotated[float, Field(description="End.")]
    t_ended: Annotated[float | None, Field(description="Time of the actual end; null while it applies.")] = (
        None
    )
    ended_by: Annotated[
        str | None, Field(description="Operator of its early end; null for its time or a higher severity.")
    ] = None
    escalated: Annotated[bool, Field(description="An alarm of a higher severity has ended it.")] = False


@dataclass(frozen=True, slots=True)
class PlannedWork(UtcTwins):
    """Planned work on a feeder: its alarms are marked and do not notify. Times are Unix seconds."""

    id: str
    feeder: str
    t_from: Annotated[float, Field(description="Begin.")]
    t_until: Annotated[float, Field(description="End.")]
    who: str
    reason: str
    t: Annotated[float, Field(description="Time of the entry.")]
    begun: bool = False
    t_ended: Annotated[float | None, Field(description="Time of the actual end; null before it.")] = None
    ended_by: Annotated[str | None, Field(description="Operator of its early end; null without one.")] = None


@dataclass(frozen=True, slots=True)
class Assign:
    """Assignment of an incident; `to` None withdraws it."""

    feeder: str
    incident: str
    to: str | None
    who: str
    comment: str = ""


@dataclass(frozen=True, slots=True)
class Comment:
    """Comment on an incident."""

    feeder: str
    incident: str
    who: str
    comment: str


@dataclass(frozen=True, slots=True)
class Unshelve:
    """Early end of a shelf."""

    feeder: str
    shelf: str
    who: str
    comment: str = ""


@dataclass(frozen=True, slots=True)
class EndWork:
    """Early end of planned work."""

    feeder: str
    work: str
    who: str
    comment: str = ""


Action = Assign | Comment | Shelf | Unshelve | PlannedWork | EndWork
"""Action of an operator; a `Shelf` and a `PlannedWork` begin, or announce, themselves."""


# --- State machine ---


@dataclass(frozen=True, slots=True)
class Member:
    """An alarm in an incident."""

    incident: str
    kind: AlarmKind
    meter: str | None
    severity: Severity
    state: AlarmState
    work: str | None = None  # planned work during which it was raised


@dataclass(frozen=True, slots=True)
class IncidentBook:
    """Incidents of one feeder, their alarms by id, its shelves and its planned works. A value.

    Cleared incidents, ended shelves and works may be left out, except those of the alarms that change.
    """

    feeder: str
    incidents: Mapping[str, Incident] = field(default_factory=dict)
    members: Mapping[str, Member] = field(default_factory=dict)
    shelves: Mapping[str, Shelf] = field(default_factory=dict)
    works: Mapping[str, PlannedWork] = field(default_factory=dict)


def advance(
    book: IncidentBook,
    transitions: Iterable[AlarmTransition],
    now: float,
    actions: Iterable[Action] = (),
) -> tuple[IncidentBook, tuple[IncidentTransition, ...]]:
    """Update the book by the changes of alarms, then by actions of operators.

    transitions, actions: of this feeder, in their order.
    now: wall clock, Unix s; shelves and works that end until then end first.
    Returns book, transitions: the new state, and the changes of incidents. Changes by alarms that follow one
        another directly are one change.
    """
    work = _Work(book, now)
    work.expire()
    for transition in transitions:
        work.take(transition)
    for action in actions:
        work.act(action)
    return work.book(), tuple(work.happened)


def due(book: IncidentBook) -> float | None:
    """Return the next time at which a shelf ends, or a work begins or ends; None without one."""
    times = [shelf.until for shelf in book.shelves.values() if shelf.t_ended is None]
    times += [
        work.t_until if work.begun else work.t_from for work in book.works.values() if work.t_ended is None
    ]
    return min(times, default=None)


_GREW = frozenset({IncidentChange.EXTENDED, IncidentChange.ESCALATED})
_BASES = frozenset(
    {
        IncidentChange.OPENED,
        IncidentChange.REOPENED,
        IncidentChange.EXTENDED,
        IncidentChange.ESCALATED,
    }
)


class _Work:
    """Mutable copy of a book during one call of `advance`."""

    def __init__(self, book: IncidentBook, now: float) -> None:
        self.feeder, self.now = book.feeder, now
        self.incidents, self.members = dict(book.incidents), dict(book.members)
        self.shelves, self.works = dict(book.shelves), dict(book.works)
        self.happened: list[IncidentTransition] = []
        self._escalated = False  # an alarm of a higher severity has ended a shelf
        self._last: dict[str, int] = {}  # place in `happened` of the last change of each incident
        self._of: dict[str, list[str]] = {}
        for alarm, member in self.members.items():
            self._of.setdefault(member.incident, []).append(alarm)

    def book(self) -> IncidentBook:
        return IncidentBook(self.feeder, self.incidents, self.members, self.shelves, self.works)

    # ------------------------------------------------------------ changes of alarms

    def take(self, transition: AlarmTransition) -> None:
        """Apply a change of an alarm."""
        if transition.change is Change.COMMENTED:
            return
        alarm = transition.alarm
        old = self.members.get(alarm.id)
        own = None if old is None else self.incidents.get(old.incident)
        if own is None:
            old = None
        home = own or self._home(transition, None)
        raises = transition.change is Change.RAISED or own is None
        # A full queue keeps the newest transition of an alarm only: its raising may be missing.
        raises |= old is not None and old.state is AlarmState.CLEARED and alarm.active
        if raises and not alarm.active:
            begun = replace(alarm, state=AlarmState.RAISED, t_cleared=None)
            self.take(replace(transition, alarm=begun, change=Change.RAISED, t=alarm.t_raised))
            self.take(replace(transition, change=Change.CLEARED))
            return
        if raises and own is not None:
            home = self._home(transition, own)
            if own.id != home.id:
                self._leave(own, alarm.id)
                old = None
        work = None if old is None else old.work
        if raises:
            present = self._work_now()
            work = None if present is None else present.id
        now = Member(home.id, alarm.kind, alarm.meter, alarm.severity, alarm.state, work)
        if old is None:
            self._of.setdefault(home.id, []).append(alarm.id)
        self.members[alarm.id] = now
        grown = _counted(home, old, now)
        if raises:
            grown = self._raised(grown, transition)
        self._put(home, _settled(grown, transition, raises=raises), transition, raises=raises)

    def _home(self, transition: AlarmTransition, own: Incident | None) -> Incident:
        """The incident that a raised alarm belongs to: an open one, its own, a recent one, a new one."""
        if own is not None and own.open:
            return own
        alarm = transition.alarm
        kind, t = cause_of(alarm.kind), alarm.t_raised
        near = [
            one
            for one in self.incidents.values()
            if _joins(kind, one.kind) and _distance(one, t) <= transition.window_s
        ]
        best = max(near, key=lambda one: (one.open, one == own, one.t_last, one.id), default=None)
        if best is not None:
            return best
        if own is not None:
            return own
        return Incident(
            id=ulid(alarm.t_event, "incident", alarm.id),
            kind=kind,
            feeder=alarm.feeder,
            severity=alarm.severity,
            state=IncidentState.CLEARED,
            count=0,
            alarms=0,
            active=0,
            unacknowledged=0,
            kinds=(),
            meters=(),
            customers=(),
            t_first=alarm.t_event,
            t_last=t,
            t_cleared=None,
            reason=alarm.reason,
        )

    def _leave(self, incident: Incident, alarm: str) -> None:
        """Remove an alarm from a cleared incident: it was raised again in another one."""
        self._of[incident.id].remove(alarm)
        self.incidents[incident.id] = replace(incident, alarms=incident.alarms - 1)

    def _raised(self, incident: Incident, transition: AlarmTransition) -> Incident:
        alarm = transition.alarm
        kind, work = cause_of(alarm.kind), self._work_now()
        self._escalate(transition)
        first = incident.count == 0 or higher(alarm.severity, incident.severity)
        return replace(
            incident,
            kind=min(kind, incident.kind, key=_ORDER.index),
            severity=alarm.severity if first else incident.severity,
            reason=alarm.reason if first else incident.reason,
            count=incident.count + 1,
            kinds=_with(incident.kinds, alarm.kind),
            meters=_with(incident.meters, alarm.meter, *alarm.evidence.silent),
            customers=_with(incident.customers, alarm.customer),
            t_first=min(incident.t_first, alarm.t_event),
            t_last=max(incident.t_last, alarm.t_raised),
            planned_work=incident.planned_work if work is None else work.id,
        )

    def _escalate(self, transition: AlarmTransition) -> None:
        """End the shelves of an alarm with a higher severity than theirs."""
        alarm = transition.alarm
        member = self.members[alarm.id]
        for shelf in self._standing():
            if applies(shelf, alarm.id, member) and higher(alarm.severity, shelf.severity):
                self.shelves[shelf.id] = replace(shelf, t_ended=self.now, escalated=True)
                self._escalated = True

    # ------------------------------------------------------- shelves, planned work

    def expire(self) -> None:
        """Begin and end what is due."""
        for shelf in self._standing():
            if shelf.until <= self.now:
                self.shelves[shelf.id] = replace(shelf, t_ended=shelf.until)
        self._renew(IncidentChange.UNSHELVED)
        for work in [*self.works.values()]:
            if work.t_ended is None and not work.begun and work.t_from <= self.now:
                self.works[work.id] = replace(work, begun=True)
                self._renew(IncidentChange.WORK_BEGUN, comment=work.reason)
        for work in [*self.works.values()]:
            if work.t_ended is None and work.t_until <= self.now:
                self.works[work.id] = replace(work, t_ended=work.t_until)
                self._renew(IncidentChange.WORK_ENDED)

    def act(self, action: Action) -> None:
        """Apply an action of an operator. Raises the error of an unknown incident, shelf or work."""
        match action:
            case Assign():
                found = replace(self._known(action.incident), assigned_to=action.to)
                self._say(found, IncidentChange.ASSIGNED, action.who, action.comment)
            case Comment():
                known = self._known(action.incident)
                found = replace(known, comments=known.comments + 1)
                self._say(found, IncidentChange.COMMENTED, action.who, action.comment)
            case Shelf():
                self.shelves[action.id] = action
                self._renew(IncidentChange.SHELVED, action.who, action.reason)
            case Unshelve():
                shelf = self.shelves.get(action.shelf)
                if shelf is None:
                    raise ShelfUnknown(action.shelf)
                if shelf.t_ended is not None:  # it expired meanwhile
                    return
                self.shelves[shelf.id] = replace(shelf, t_ended=self.now, ended_by=action.who)
                self._renew(IncidentChange.UNSHELVED, action.who, action.comment)
            case PlannedWork():
                begun = action.t_from <= self.now
                self.works[action.id] = replace(action, begun=begun)
                if begun:
                    self._renew(IncidentChange.WORK_BEGUN, action.who, action.reason)
            case EndWork():
                work = self.works.get(action.work)
                if work is None:
                    raise WorkUnknown(action.work)
                if work.t_ended is not None:  # it ended meanwhile
                    return
                self.works[work.id] = replace(work, t_ended=self.now, ended_by=action.who)
                self._renew(IncidentChange.WORK_ENDED, action.who, action.comment)

    def _known(self, incident_id: str) -> Incident:
        found = self.incidents.get(incident_id)
        if found is None:
            raise IncidentUnknown(incident_id)
        return found

    def _standing(self) -> list[Shelf]:
        return [shelf for shelf in self.shelves.values() if shelf.t_ended is None]

    def _work_now(self) -> PlannedWork | None:
        """The planned work of this time that ends last."""
        now = [work for work in self.works.values() if work.begun and work.t_ended is None]
        return max(now, key=lambda work: (work.t_until, work.id), default=None)

    def _renew(self, change: IncidentChange, who: str | None = None, comment: str | None = None) -> None:
        """Update the open incidents after a change of shelves or works, with one change of each."""
        for incident in [*self.incidents.values()]:
            renewed = self._suppressed(incident)
            if renewed == incident or not incident.open:
                continue
            # Another shelf, or another work, continues.
            lasts = (change is IncidentChange.UNSHELVED and renewed.shelved_until is not None) or (
                change is IncidentChange.WORK_ENDED and renewed.planned_until is not None
            )
            self._say(renewed, IncidentChange.UPDATED if lasts else change, who, comment)

    def _suppressed(self, incident: Incident) -> Incident:
        """The incident with the ends of the present shelves and of the present work."""
        work = self._work_now()
        return replace(
            incident,
            shelved_until=self._shelved_until(incident) if incident.open else incident.shelved_until,
            planned_until=None if work is None else work.t_until,
        )

    def _shelved_until(self, incident: Incident) -> float | None:
        """Time until which all active alarms are shelved, or None."""
        standing = self._standing()
        if not standing:
            return None
        ends: list[float] = []
        for alarm in self._of.get(incident.id, ()):
            member = self.members[alarm]
            if member.state is not AlarmState.CLEARED:
                mine = [shelf.until for shelf in standing if applies(shelf, alarm, member)]
                if not mine:
                    return None
                ends.append(max(mine))
        return min(ends, default=None)

    # ------------------------------------------------------------------- changes

    def _put(self, before: Incident, after: Incident, transition: AlarmTransition, *, raises: bool) -> None:
        """Note the change of an incident by a change of one of its alarms."""
        change = _change(before, after, transition, raises=raises)
        acts = change in {IncidentChange.ACKNOWLEDGED, IncidentChange.UNACKNOWLEDGED}
        comment = transition.comment if acts or change is IncidentChange.CLEARED else None
        who = transition.who if acts else None
        after = self._suppressed(after)
        if change is IncidentChange.EXTENDED and not before.notify and after.notify:
            change = IncidentChange.UNSHELVED  # one of its alarms is not shelved
        self._say(after, change, who, comment, t=transition.t)
        if self._escalated:
            self._escalated = False
            self._renew(IncidentChange.UNSHELVED)

    def _say(
        self,
        incident: Incident,
        change: IncidentChange,
        who: str | None,
        comment: str | None,
        *,
        t: float | None = None,
    ) -> None:
        """Note a change; one by an alarm is merged with a directly preceding one of the same incident."""
        self.incidents[incident.id] = incident
        new = IncidentTransition(
            incident, change, self.now if t is None else t, who, comment or None, incident.notify
        )
        place = self._last.get(incident.id)
        if place is not None:
            last = self.happened[place]
            if change in _GREW and last.change in _BASES:
                escalated = change is IncidentChange.ESCALATED and last.change is IncidentChange.EXTENDED
                self.happened[place] = replace(new, change=change if escalated else last.change)
                return
            if change is IncidentChange.UPDATED and t is not None:
                self.happened[place] = replace(last, incident=incident, notify=incident.notify)
                return
            if last.change is IncidentChange.UPDATED and t is not None:
                self.happened[place] = new
                return
        self._last[incident.id] = len(self.happened)
        self.happened.append(new)


def _joins(kind: IncidentKind, host: IncidentKind) -> bool:
    """True if alarms of both causes have one incident."""
    undecided = IncidentKind.UNDECIDED in {kind, host}
    return kind is host or (undecided and bool({kind, host} & _HOSTS))


def _distance(incident: Incident, t: float) -> float:
    """Time between a raising and the last raising or the clearing of an incident, s."""
    times = [incident.t_last] if incident.t_cleared is None else [incident.t_last, incident.t_cleared]
    return min(abs(t - each) for each in times)


def applies(shelf: Shelf, alarm: str, member: Member) -> bool:
    """True if a shelf applies to an alarm."""
    return (
        shelf.alarm in {None, alarm}
        and shelf.incident in {None, member.incident}
        and shelf.meter in {None, member.meter}
        and shelf.kind in {None, member.kind}
    )


def _with(known: tuple[T, ...], *more: T | None) -> tuple[T, ...]:
    found = dict.fromkeys((*known, *(one for one in more if one is not None)))
    return known if len(found) == len(known) else tuple(found)


def _counted(incident: Incident, old: Member | None, now: Member) -> Incident:
    """The incident with the numbers of its alarms after a change of one."""
    active = (now.state is not AlarmState.CLEARED) - (old is not None and old.state is not AlarmState.CLEARED)
    raised = (now.state is AlarmState.RAISED) - (old is not None and old.state is AlarmState.RAISED)
    return replace(
        incident,
        alarms=incident.alarms + (old is None),
        active=incident.active + active,
        unacknowledged=incident.unacknowledged + raised,
    )


def _settled(incident: Incident, transition: AlarmTransition, *, raises: bool) -> Incident:
    """The incident with its state, and the times and names of it."""
    state = (
        IncidentState.CLEARED
        if incident.active == 0
        else IncidentState.RAISED
        if incident.unacknowledged
        else IncidentState.ACKNOWLEDGED
    )
    cleared = incident.t_cleared
    if state is not IncidentState.CLEARED:
        cleared = None
    elif incident.open or raises:
        cleared = transition.t
    answered = incident.acknowledged_by, incident.t_acknowledged
    if transition.change is Change.ACKNOWLEDGED:
        answered = transition.who, transition.t
    elif raises or transition.change is Change.UNACKNOWLEDGED:
        answered = None, None
    return replace(
        incident,
        state=state,
        t_cleared=cleared,
        acknowledged_by=answered[0],
        t_acknowledged=answered[1],
    )


def _change(
    before: Incident, after: Incident, transition: AlarmTransition, *, raises: bool
) -> IncidentChange:
    """The change of an incident by a change of one of its alarms."""
    answers = transition.change is Change.ACKNOWLEDGED and after.state is IncidentState.ACKNOWLEDGED
    reopens = before.state is IncidentState.ACKNOWLEDGED and after.state is IncidentState.RAISED
    found = (
        (raises and before.count == 0, IncidentChange.OPENED),
        (raises and not before.open, IncidentChange.REOPENED),
        (raises and higher(after.severity, before.severity), IncidentChange.ESCALATED),
        (raises, IncidentChange.EXTENDED),
        (before.open and not after.open, IncidentChange.CLEARED),
        (answers, IncidentChange.ACKNOWLEDGED),
        (reopens, IncidentChange.UNACKNOWLEDGED),
    )
    return next((change for holds, change in found if holds), IncidentChange.UPDATED)
