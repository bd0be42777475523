"""Incidents in the database: stored in the transaction of their alarms, read by filters or event number."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeVar

import sqlalchemy as sa
from pydantic import TypeAdapter

from service.alarms.conditions import AlarmKind, Severity
from service.alarms.incidents import (
    Action,
    Assign,
    Comment,
    Incident,
    IncidentBook,
    IncidentChange,
    IncidentEvent,
    IncidentState,
    IncidentTransition,
    Member,
    PlannedWork,
    Shelf,
    advance,
    applies,
    incident_json,
    incident_of,
)
from service.alarms.state_machine import Alarm, AlarmState, AlarmTransition, Change, from_json
from service.store.schema import ALARM, EVENT, INCIDENT, INCIDENT_EVENT, SHELF, WORK
from service.times import UtcTwins

AT_ONCE = 5000
"""Largest number of values in one statement."""
ENDED_KEPT = 1000
"""Largest number of shelves or planned works in a list."""

T = TypeVar("T")
Read = Callable[[], AbstractContextManager[sa.Connection]]
_SHELF, _WORK = TypeAdapter(Shelf), TypeAdapter(PlannedWork)


@dataclass(frozen=True, slots=True)
class AlarmMark:
    """Properties of an alarm by its incident, its shelves and planned work."""

    incident: str | None = None  # id of its incident
    shelved_until: float | None = None  # end of its shelves while it is active, Unix s
    planned_work: str | None = None  # id of the planned work during which it was raised


@dataclass(frozen=True, slots=True)
class Said(UtcTwins):
    """A comment of an operator."""

    t: float
    feeder: str
    who: str
    change: str  # change that it was given with
    comment: str
    alarm: str | None = None  # id of its alarm, or
    incident: str | None = None  # id of its incident


# --- Write access: one transaction with the alarms ---


Mine = Callable[[str], bool]
"""True for the feeders that this process writes."""


def _due(connection: sa.Connection, mine: Mine) -> dict[str, float]:
    """Return the next time at which a shelf or a planned work of each feeder changes, Unix s."""
    found: dict[str, float] = {}
    for table in (SHELF, WORK):
        query = sa.select(table.c.feeder, sa.func.min(table.c.t_next)).where(table.c.t_next.is_not(None))
        for feeder, t in connection.execute(query.group_by(table.c.feeder)):
            if mine(feeder):
                found[feeder] = min(t, found.get(feeder, t))
    return found


def feeders_due(connection: sa.Connection, now: float, mine: Mine) -> set[str]:
    """Return the feeders with a shelf or a planned work that changes by `now`, Unix s."""
    return {feeder for feeder, t in _due(connection, mine).items() if t <= now}


def next_due(connection: sa.Connection, mine: Mine) -> float | None:
    """Return the next time at which a shelf or a planned work changes, Unix s; None without one."""
    return min(_due(connection, mine).values(), default=None)


def suppression_mark(connection: sa.Connection) -> tuple[tuple[float, ...], ...]:
    """Return numbers that differ after each begin, end and addition of a shelf or a planned work."""
    marks = []
    for table in (SHELF, WORK):
        t_next = table.c.t_next
        query = sa.select(sa.func.count(), sa.func.count(t_next), sa.func.coalesce(sa.func.sum(t_next), 0.0))
        marks.append(tuple(map(float, connection.execute(query.select_from(table)).one())))
    return tuple(marks)


def orphans(connection: sa.Connection) -> list[AlarmTransition]:
    """Return the active alarms without an incident, of a database of an earlier version."""
    a = ALARM.c
    query = sa.select(a.data).where(a.incident.is_(None), a.state != str(AlarmState.CLEARED))
    alarms = [from_json(json.loads(data)) for data in connection.scalars(query.order_by(a.t_raised, a.id))]
    return [AlarmTransition(alarm, Change.RAISED, alarm.t_raised) for alarm in alarms]


@dataclass(frozen=True, slots=True)
class IncidentWrite:
    """Change of the incidents of a feeder by one commit: computed before, and stored after, its alarms."""

    before: IncidentBook
    after: IncidentBook
    happened: tuple[IncidentTransition, ...]


def prepare(
    connection: sa.Connection,
    transitions: Sequence[AlarmTransition],
    actions: Sequence[Action],
    now: float,
    due: Iterable[str] = (),
) -> list[IncidentWrite]:
    """Return the changes of incidents by a commit; its alarms are not stored yet.

    now: wall clock, Unix s.
    due: feeders with a shelf or a planned work that changes.
    """
    alarms: dict[str, list[AlarmTransition]] = {name: [] for name in sorted(due)}
    asked: dict[str, list[Action]] = {}
    for transition in transitions:
        alarms.setdefault(transition.alarm.feeder, []).append(transition)
    for action in actions:
        alarms.setdefault(action.feeder, [])
        asked.setdefault(action.feeder, []).append(action)
    writes = []
    for feeder, own in alarms.items():
        wanted = asked.get(feeder, [])
        before = _book(connection, feeder, own, wanted)
        after, happened = advance(before, own, now, wanted)
        writes.append(IncidentWrite(before, after, happened))
    return writes


def suppressions_change(writes: Iterable[IncidentWrite]) -> bool:
    """True if shelves or planned works change."""
    return any(
        (one.before.shelves, one.before.works) != (one.after.shelves, one.after.works) for one in writes
    )


def store(connection: sa.Connection, insert: Any, writes: Iterable[IncidentWrite]) -> int:
    """Store changes of incidents after their alarms; return the number of the newest event, or 0.

    insert: INSERT of the dialect, with ON CONFLICT.
    """
    newest = 0
    for write in writes:
        before, after = write.before, write.after
        for incident in _changed(before.incidents, after.incidents):
            _upsert(connection, insert, INCIDENT, _row(incident))
        moved = [
            {"number": alarm, "home": member.incident, "during": member.work}
            for alarm, member in after.members.items()
            if _place(before.members.get(alarm)) != _place(member)
        ]
        if moved:
            update = ALARM.update().where(ALARM.c.id == sa.bindparam("number"))
            values: dict[str, Any] = {"incident": sa.bindparam("home"), "work": sa.bindparam("during")}
            connection.execute(update.values(values), moved)
        for shelf in _changed(before.shelves, after.shelves):
            t_next = shelf.until if shelf.t_ended is None else None
            _upsert(connection, insert, SHELF, _suppression(shelf, t_next, _SHELF))
        for work in _changed(before.works, after.works):
            following = work.t_until if work.begun else work.t_from
            t_next = following if work.t_ended is None else None
            _upsert(connection, insert, WORK, _suppression(work, t_next, _WORK))
        for item in write.happened:
            newest = _put_event(connection, item)
    return newest


def published(connection: sa.Connection, numbers: Collection[int]) -> None:
    """Mark events as published on zenoh."""
    for part in _parts(sorted(numbers)):
        update = INCIDENT_EVENT.update().where(INCIDENT_EVENT.c.seq.in_(part))
        connection.execute(update.values(published=True))


def _book(
    connection: sa.Connection,
    feeder: str,
    transitions: Sequence[AlarmTransition],
    actions: Sequence[Action],
) -> IncidentBook:
    """The part of a feeder's book that the changes may concern."""
    concerned = sorted({transition.alarm.id for transition in transitions})
    named = {action.incident for action in actions if isinstance(action, Assign | Comment)}
    members = _members(connection, ALARM.c.id, concerned)
    named |= {member.incident for member in members.values()}
    i = INCIDENT.c
    wanted: list[sa.ColumnElement[bool]] = [i.state != str(IncidentState.CLEARED)]
    if transitions:
        times = [transition.alarm.t_raised for transition in transitions]
        width = max(transition.window_s for transition in transitions)
        near = min(times) - width, max(times) + width
        wanted += [i.t_last.between(*near), i.t_cleared.between(*near)]
    rows = list(connection.scalars(sa.select(i.data).where(i.feeder == feeder, sa.or_(*wanted))))
    for part in _parts(sorted(named)):
        rows += connection.scalars(sa.select(i.data).where(i.id.in_(part), i.feeder == feeder))
    incidents = {one.id: one for one in (incident_of(json.loads(row)) for row in rows)}
    open_ones = sorted(one.id for one in incidents.values() if one.open)
    members |= _members(connection, ALARM.c.incident, open_ones)
    shelves = {one.id: one for one in _standing(connection, SHELF, _SHELF, feeder)}
    works = {one.id: one for one in _standing(connection, WORK, _WORK, feeder)}
    return IncidentBook(feeder, incidents, members, shelves, works)


def _members(
    connection: sa.Connection, column: sa.ColumnElement[Any], values: Sequence[str]
) -> dict[str, Member]:
    a = ALARM.c
    query = sa.select(a.id, a.incident, a.kind, a.meter, a.severity, a.state, a.work)
    return {
        row.id: Member(
            row.incident,
            AlarmKind(row.kind),
            row.meter,
            Severity(row.severity),
            AlarmState(row.state),
            row.work,
        )
        for part in _parts(values)
        for row in connection.execute(query.where(column.in_(part), a.incident.is_not(None)))
    }


def _standing(connection: sa.Connection, table: sa.Table, kind: TypeAdapter[T], feeder: str) -> list[T]:
    query = sa.select(table.c.data).where(table.c.feeder == feeder, table.c.t_next.is_not(None))
    return [kind.validate_json(data) for data in connection.scalars(query.order_by(table.c.id))]


def _parts(values: Sequence[T]) -> Iterator[Sequence[T]]:
    for start in range(0, len(values), AT_ONCE):
        yield values[start : start + AT_ONCE]


def _changed(before: Mapping[str, T], after: Mapping[str, T]) -> list[T]:
    return [one for key, one in after.items() if before.get(key) != one]


def _place(member: Member | None) -> tuple[str, str | None] | None:
    return None if member is None else (member.incident, member.work)


def _upsert(connection: sa.Connection, insert: Any, table: sa.Table, row: dict[str, Any]) -> None:
    connection.execute(insert(table).values(row).on_conflict_do_update(index_elements=["id"], set_=row))


def _row(incident: Incident) -> dict[str, Any]:
    words = (
        incident.feeder,
        incident.kind,
        *incident.kinds,
        *incident.meters,
        *incident.customers,
        incident.reason,
        incident.assigned_to or "",
        incident.acknowledged_by or "",
    )
    return {
        "id": incident.id,
        "kind": str(incident.kind),
        "feeder": incident.feeder,
        "severity": str(incident.severity),
        "state": str(incident.state),
        "t_first": incident.t_first,
        "t_last": incident.t_last,
        "t_cleared": incident.t_cleared,
        "shelved_until": incident.shelved_until,
        "planned_until": incident.planned_until,
        "assigned_to": incident.assigned_to,
        "words": " ".join(words).lower(),
        "data": json.dumps(incident_json(incident, stored=True), allow_nan=False),
    }


def _suppression(one: Shelf | PlannedWork, t_next: float | None, kind: TypeAdapter[Any]) -> dict[str, Any]:
    data = kind.dump_json(one, round_trip=True).decode()
    return {"id": one.id, "feeder": one.feeder, "t_next": t_next, "data": data}


def _put_event(connection: sa.Connection, item: IncidentTransition) -> int:
    row = {
        "incident_id": item.incident.id,
        "feeder": item.incident.feeder,
        "t": item.t,
        "change": str(item.change),
        "who": item.who,
        "comment": item.comment,
        "notify": item.notify,
        "data": json.dumps(incident_json(item.incident, stored=True), allow_nan=False),
        "published": False,
    }
    statement = INCIDENT_EVENT.insert().values(row).returning(INCIDENT_EVENT.c.seq)
    return int(connection.execute(statement).scalar_one())


# --- Read access ---


_RANK: Mapping[str, int] = {str(severity): rank for rank, severity in enumerate(reversed(Severity), 1)}
"""Order of severities: the higher the more severe."""


class IncidentReader:
    """Read access to incidents, shelves and planned works."""

    _read: Read

    def incident(self, incident_id: str) -> Incident | None:
        """Return an incident by its id."""
        with self._read() as connection:
            data = connection.scalar(sa.select(INCIDENT.c.data).where(INCIDENT.c.id == incident_id))
        return None if data is None else incident_of(json.loads(data))

    def incidents(
        self,
        *,
        state: Collection[str] = (),
        kind: Collection[str] = (),
        severity: Collection[str] = (),
        feeder: str | None = None,
        among: Collection[str] | None = None,
        meter: str | None = None,
        since: float | None = None,
        until: float | None = None,
        text: str | None = None,
        assigned_to: str | None = None,
        shelved: bool | None = None,
        planned: bool | None = None,
        sort: str = "onset",
        cursor: str | None = None,
        limit: int = 100,
    ) -> tuple[list[Incident], str | None]:
        """Return a page of incidents.

        state, kind, severity: permitted values; empty for all.
        feeder, among, meter: restrict to this feeder, these feeders, alarms of this meter; None for all.
        since, until: restrict to incidents with an alarm raised in [since, until), Unix s.
        text: restrict to incidents with each of these words, whatever their case.
        assigned_to: restrict to incidents of this person; "" for those of none.
        shelved, planned: restrict to those that are, or are not, shelved or under planned work.
        sort: `onset` (newest first), `severity` (those to act on first, then the highest severity) or `last`
            (latest raising first).
        cursor, limit: end of the previous page, and length of a page.
        Returns incidents, cursor: the cursor is None on the last page.
        """
        i = INCIDENT.c
        allowed = {"state": state, "kind": kind, "severity": severity, "feeder": feeder}
        wanted = filters(i, among, text, (since, until), (i.t_first, i.t_last), **allowed)
        if meter is not None:
            wanted.append(i.id.in_(sa.select(ALARM.c.incident).where(ALARM.c.meter == meter)))
        if assigned_to is not None:
            wanted.append(i.assigned_to == assigned_to if assigned_to else i.assigned_to.is_(None))
        for column, given in ((i.shelved_until, shelved), (i.planned_until, planned)):
            open_now = i.state != str(IncidentState.CLEARED)
            if given is not None:
                suppressed = sa.and_(column.is_not(None), open_now)
                wanted.append(suppressed if given else sa.not_(suppressed))
        to_do = sa.and_(
            i.state == str(IncidentState.RAISED), i.shelved_until.is_(None), i.planned_until.is_(None)
        )
        worst = rank_of(i.severity) + sa.case((to_do, len(_RANK)), else_=0)
        keys = {"onset": None, "severity": worst, "last": i.t_last}
        rows, following = page(self._read, i, wanted, keys[sort], cursor, limit)
        return [incident_of(data) for data in rows], following

    def open_incidents(self, *, among: Collection[str] | None = None) -> int:
        """Number of incidents with an alarm that is neither acknowledged, shelved nor under planned work."""
        i = INCIDENT.c
        query = sa.select(sa.func.count()).where(
            i.state == str(IncidentState.RAISED), i.shelved_until.is_(None), i.planned_until.is_(None)
        )
        if among is not None:
            query = query.where(i.feeder.in_(among))
        with self._read() as connection:
            return int(connection.execute(query).scalar_one())

    def incidents_by_feeder(self) -> dict[str, int]:
        """Number of incidents with an active alarm, of the feeders that have any."""
        i = INCIDENT.c
        query = sa.select(i.feeder, sa.func.count()).where(i.state != str(IncidentState.CLEARED))
        with self._read() as connection:
            return {name: int(count) for name, count in connection.execute(query.group_by(i.feeder))}

    def incident_events(self, incident_id: str, after: int = 0, *, limit: int = 1000) -> list[IncidentEvent]:
        """Return the events of an incident, oldest first. `after` restricts to a higher number."""
        e = INCIDENT_EVENT.c
        query = sa.select(INCIDENT_EVENT).where(e.incident_id == incident_id, e.seq > after)
        with self._read() as connection:
            rows = connection.execute(query.order_by(e.seq).limit(limit)).mappings()
            return [_event(row) for row in rows]

    def incident_events_after(
        self, number: int, *, feeder: str | None = None, limit: int = 100
    ) -> list[IncidentEvent]:
        """Return the events of incidents after a number, oldest first. `number` is the last known event."""
        e = INCIDENT_EVENT.c
        query = sa.select(INCIDENT_EVENT).where(e.seq > number).order_by(e.seq).limit(limit)
        if feeder is not None:
            query = query.where(e.feeder == feeder)
        with self._read() as connection:
            return [_event(row) for row in connection.execute(query).mappings()]

    def open_incident_events(self, *, feeder: str | None = None) -> list[IncidentEvent]:
        """Return the newest event of each open incident, of one feeder or (None) of all."""
        e, i = INCIDENT_EVENT.c, INCIDENT.c
        open_ones = sa.select(i.id).where(i.state != str(IncidentState.CLEARED))
        if feeder is not None:
            open_ones = open_ones.where(i.feeder == feeder)
        newest = sa.select(sa.func.max(e.seq)).where(e.incident_id.in_(open_ones)).group_by(e.incident_id)
        with self._read() as connection:
            rows = connection.execute(sa.select(INCIDENT_EVENT).where(e.seq.in_(newest)).order_by(e.seq))
            return [_event(row) for row in rows.mappings()]

    def incidents_unpublished(self, *, after: int = 0, limit: int = 1000) -> list[IncidentEvent]:
        """Return the events of incidents that are not published on zenoh, oldest first."""
        e = INCIDENT_EVENT.c
        query = sa.select(INCIDENT_EVENT).where(e.published.is_(False), e.seq > after)
        with self._read() as connection:
            return [_event(row) for row in connection.execute(query.order_by(e.seq).limit(limit)).mappings()]

    def alarms_of(self, incident_id: str) -> list[Alarm]:
        """Return the alarms of an incident, oldest first."""
        query = sa.select(ALARM.c.data).where(ALARM.c.incident == incident_id).order_by(ALARM.c.id)
        with self._read() as connection:
            return [from_json(json.loads(data)) for data in connection.scalars(query)]

    def alarm_marks(self, alarms: Iterable[str]) -> dict[str, AlarmMark]:
        """Return incident, shelves and planned work of alarms, by their ids."""
        a, found = ALARM.c, dict[str, AlarmMark]()
        query = sa.select(a.id, a.feeder, a.incident, a.kind, a.meter, a.severity, a.state, a.work)
        standing = self.shelves(standing=True)
        with self._read() as connection:
            for part in _parts(sorted(alarms)):
                for row in connection.execute(query.where(a.id.in_(part))):
                    member = Member(
                        row.incident or "", row.kind, row.meter, row.severity, AlarmState(row.state)
                    )
                    until = [
                        shelf.until
                        for shelf in standing
                        if shelf.feeder == row.feeder
                        and member.state is not AlarmState.CLEARED
                        and applies(shelf, row.id, member)
                    ]
                    found[row.id] = AlarmMark(row.incident, max(until, default=None), row.work)
        return found

    def shelf(self, shelf_id: str) -> Shelf | None:
        """Return a shelf by its id."""
        with self._read() as connection:
            data = connection.scalar(sa.select(SHELF.c.data).where(SHELF.c.id == shelf_id))
        return None if data is None else _SHELF.validate_json(data)

    def work(self, work_id: str) -> PlannedWork | None:
        """Return a planned work by its id."""
        with self._read() as connection:
            data = connection.scalar(sa.select(WORK.c.data).where(WORK.c.id == work_id))
        return None if data is None else _WORK.validate_json(data)

    def shelves(
        self, *, standing: bool = False, feeder: str | None = None, among: Collection[str] | None = None
    ) -> list[Shelf]:
        """Return the shelves, newest first. `standing` leaves out those that have ended."""
        return self._suppressions(SHELF, _SHELF, standing, feeder, among)

    def works(
        self, *, standing: bool = False, feeder: str | None = None, among: Collection[str] | None = None
    ) -> list[PlannedWork]:
        """Return the planned works, newest first. `standing` leaves out those that have ended."""
        return self._suppressions(WORK, _WORK, standing, feeder, among)

    def _suppressions(
        self,
        table: sa.Table,
        kind: TypeAdapter[T],
        standing: bool,
        feeder: str | None,
        among: Collection[str] | None,
    ) -> list[T]:
        query = sa.select(table.c.data).order_by(table.c.id.desc())
        query = query.where(table.c.t_next.is_not(None)) if standing else query.limit(ENDED_KEPT)
        if feeder is not None:
            query = query.where(table.c.feeder == feeder)
        if among is not None:
            query = query.where(table.c.feeder.in_(among))
        with self._read() as connection:
            return [kind.validate_json(data) for data in connection.scalars(query)]

    def said(self, since: float, *, among: Collection[str] | None = None, limit: int = 1000) -> list[Said]:
        """Return the newest comments of operators at or after a time (Unix s), oldest first.

        An action on several alarms with one comment is one of them: that of their incident, if it has one.
        """
        found: dict[tuple[object, ...], Said] = {}
        with self._read() as connection:
            for table in (INCIDENT_EVENT, EVENT):
                c = table.c
                query = sa.select(table).where(c.t >= since, c.who.is_not(None), c.comment != "")
                if among is not None:
                    query = query.where(c.feeder.in_(among))
                rows = connection.execute(query.order_by(c.seq.desc()).limit(limit)).mappings()
                for one in map(_said, rows):
                    found.setdefault((one.t, one.feeder, one.who, one.change, one.comment), one)
        return sorted(found.values(), key=lambda one: one.t)[-limit:]


def _said(row: sa.RowMapping) -> Said:
    return Said(
        row["t"],
        row["feeder"],
        row["who"],
        row["change"],
        row["comment"],
        row.get("alarm_id"),
        row.get("incident_id"),
    )


def _event(row: sa.RowMapping) -> IncidentEvent:
    return IncidentEvent(
        row["seq"],
        row["t"],
        IncidentChange(row["change"]),
        row["who"],
        row["comment"],
        bool(row["notify"]),
        incident_of(json.loads(row["data"])),
    )


Columns = sa.sql.base.ReadOnlyColumnCollection[str, sa.Column[Any]]


def filters(
    c: Columns,
    among: Collection[str] | None,
    text: str | None,
    span: tuple[float | None, float | None],
    times: tuple[sa.Column[float], sa.Column[float]],
    **allowed: Collection[str] | str | None,
) -> list[sa.ColumnElement[bool]]:
    """Return the conditions of filters that alarms and incidents share; c has the columns.

    among, text, span: as in `incidents`; span is (since, until), Unix s.
    times: columns of the first and last raising, Unix s.
    allowed: permitted value or values by column; None or empty for all.
    """
    found: list[sa.ColumnElement[bool]] = [
        c[name] == value if isinstance(value, str) else c[name].in_([str(each) for each in value])
        for name, value in allowed.items()
        if value
    ]
    found += [] if among is None else [c.feeder.in_(among)]
    found += [] if span[0] is None else [times[1] >= span[0]]
    found += [] if span[1] is None else [times[0] < span[1]]
    return found + [c.words.contains(word, autoescape=True) for word in (text or "").lower().split()]


def rank_of(severity: sa.ColumnElement[str]) -> sa.ColumnElement[int]:
    """Return the rank of a column of severities, the highest one for `critical`."""
    return sa.case(_RANK, value=severity, else_=0)


def page(  # noqa: PLR0917  # query, order and end of the previous page
    read: Read,
    c: Columns,
    wanted: Iterable[sa.ColumnElement[bool]],
    key: sa.ColumnElement[Any] | None,
    cursor: str | None,
    limit: int,
) -> tuple[list[Any], str | None]:
    """Return the JSON objects of a page of alarms or incidents, and its cursor; None on the last page.

    key: order before that of the id, both descending; None: by id only.
    """
    value, _, last = (cursor or "").rpartition("~")
    query, after = sa.select(c.id, c.data).where(*wanted), c.id < last
    if key is not None:
        query = query.add_columns(key.label("key")).order_by(key.desc())
        at = float(value or 0.0)
        after = sa.or_(key < at, sa.and_(key == at, after))
    if cursor is not None:
        query = query.where(after)
    with read() as connection:
        rows = connection.execute(query.order_by(c.id.desc()).limit(limit + 1)).all()
    following = None
    if len(rows) > limit:
        row = rows[limit - 1]
        following = str(row.id) if key is None else f"{float(row.key)!r}~{row.id}"
    return [json.loads(row.data) for row in rows[:limit]], following
