"""Read access to the store."""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Any

import sqlalchemy as sa

from service.alarms.state_machine import Alarm, AlarmState, Change, from_json
from service.store.connect import Connections
from service.store.history import unpack
from service.store.schema import (
    ALARM,
    BAD,
    COMMISSION,
    COMMISSION_EVENT,
    DISTRUST,
    EVENT,
    FEEDER,
    HISTORY,
    LAYOUT,
    OUTBOX,
    AlarmEvent,
    CommissioningChange,
    CommissioningEvent,
    Rejected,
)
from service.store.state_codec import SnapshotKind, StateSnapshot


class Reader:
    """Read access to a store. Its connections cannot write."""

    def __init__(self, connections: Connections) -> None:
        self._connections = connections
        self._read = connections.read
        self.name = connections.name

    def alarm(self, alarm_id: str) -> Alarm | None:
        """Return an alarm by its id."""
        with self._read() as connection:
            data = connection.scalar(sa.select(ALARM.c.data).where(ALARM.c.id == alarm_id))
        return None if data is None else from_json(json.loads(data))

    def alarms(
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
        cursor: str | None = None,
        limit: int = 100,
    ) -> tuple[list[Alarm], str | None]:
        """Return a page of alarms, those with the latest onset first.

        state, kind, severity: permitted values; empty for all.
        feeder, among, meter: restrict to this feeder, to these feeders, and to this meter; None for all.
        since, until: restrict to alarms raised in [since, until), Unix s.
        cursor: end of the previous page; pages stay correct while alarms are added or change.
        limit: length of a page.
        Returns alarms, cursor: the cursor is None on the last page.
        """
        a = ALARM.c
        query = sa.select(a.id, a.data).order_by(a.id.desc()).limit(limit + 1)
        for column, allowed in ((a.state, state), (a.kind, kind), (a.severity, severity)):
            if allowed:
                query = query.where(column.in_([str(value) for value in allowed]))
        for column, wanted in ((a.feeder, feeder), (a.meter, meter)):
            if wanted is not None:
                query = query.where(column == wanted)
        if among is not None:
            query = query.where(a.feeder.in_(among))
        if since is not None:
            query = query.where(a.t_raised >= since)
        if until is not None:
            query = query.where(a.t_raised < until)
        if cursor is not None:
            query = query.where(a.id < cursor)
        with self._read() as connection:
            rows = connection.execute(query).all()
        page = [from_json(json.loads(row.data)) for row in rows[:limit]]
        return page, (page[-1].id if len(rows) > limit else None)

    def raised(self, *, among: Collection[str] | None = None) -> int:
        """Number of active alarms without an acknowledgement, of some feeders or (None) of all."""
        query = sa.select(sa.func.count()).where(ALARM.c.state == str(AlarmState.RAISED))
        if among is not None:
            query = query.where(ALARM.c.feeder.in_(among))
        with self._read() as connection:
            return int(connection.execute(query).scalar_one())

    def raised_by_feeder(self) -> dict[str, int]:
        """Number of active alarms without an acknowledgement, of the feeders that have any."""
        query = sa.select(ALARM.c.feeder, sa.func.count()).where(ALARM.c.state == str(AlarmState.RAISED))
        with self._read() as connection:
            return {name: int(count) for name, count in connection.execute(query.group_by(ALARM.c.feeder))}

    def active(self, feeder: str | None = None, *, cleared_since: float | None = None) -> list[Alarm]:
        """Return the alarms that `state_machine.restore` needs.

        `feeder` None: all feeders. With `cleared_since`, Unix s, it includes alarms that cleared at or after
        this time.
        """
        a = ALARM.c
        stands: sa.ColumnElement[bool] = a.state != str(AlarmState.CLEARED)
        if cleared_since is not None:
            stands = stands | (a.t_cleared >= cleared_since)
        query = sa.select(a.data).where(stands).order_by(a.id)
        if feeder is not None:
            query = query.where(a.feeder == feeder)
        with self._read() as connection:
            return [from_json(json.loads(data)) for data in connection.scalars(query)]

    def events(self, alarm_id: str, *, after: int = 0, limit: int = 1000) -> list[AlarmEvent]:
        """Return the events of an alarm, oldest first. `after` restricts to events with a higher number."""
        query = sa.select(EVENT).where(EVENT.c.alarm_id == alarm_id, EVENT.c.seq > after)
        query = query.order_by(EVENT.c.seq).limit(limit)
        with self._read() as connection:
            return [_event(row) for row in connection.execute(query).mappings()]

    def events_after(self, number: int, *, feeder: str | None = None, limit: int = 100) -> list[AlarmEvent]:
        """Return the events after a number, oldest first. `number` is the last known event."""
        query = sa.select(EVENT).where(EVENT.c.seq > number).order_by(EVENT.c.seq).limit(limit)
        if feeder is not None:
            query = query.where(EVENT.c.feeder == feeder)
        with self._read() as connection:
            return [_event(row) for row in connection.execute(query).mappings()]

    def outbox_pending(self, limit: int = 1000, *, after: int = 0) -> list[AlarmEvent]:
        """Return the unpublished events, oldest first. `after` restricts to events with a higher number."""
        query = sa.select(EVENT).join(OUTBOX, OUTBOX.c.seq == EVENT.c.seq).where(OUTBOX.c.seq > after)
        query = query.order_by(EVENT.c.seq)
        with self._read() as connection:
            return [_event(row) for row in connection.execute(query.limit(limit)).mappings()]

    def history(
        self,
        feeder: str,
        *,
        since: float | None = None,
        until: float | None = None,
        meter: str | None = None,
        limit: int = 1000,
    ) -> list[dict[str, Any]]:
        """Return the newest kept ticks of a feeder in [since, until), oldest first.

        Numbers of `meter` are included; None at ticks without such a meter. Times are Unix s. Returns `t`,
        `verdict`, `cause`, and the result of `history.unpack`.
        """
        h = HISTORY.c
        query = (
            sa.select(h.t, h.verdict, h.cause, h.data, LAYOUT.c.meters)
            .join(LAYOUT, LAYOUT.c.id == h.layout)
            .where(h.feeder == feeder)
            .order_by(h.t.desc())
            .limit(limit)
        )
        if since is not None:
            query = query.where(h.t >= since)
        if until is not None:
            query = query.where(h.t < until)
        with self._read() as connection:
            rows = connection.execute(query).all()
        return [
            {"t": t, "verdict": verdict, "cause": cause, **unpack(data, json.loads(layout), meter)}
            for t, verdict, cause, data, layout in reversed(rows)
        ]

    def history_meters(self, feeder: str) -> set[str]:
        """Return the meters of all kept ticks of a feeder."""
        kept = sa.select(HISTORY.c.layout).where(HISTORY.c.feeder == feeder).distinct()
        query = sa.select(LAYOUT.c.meters).where(LAYOUT.c.id.in_(kept))
        with self._read() as connection:
            return {meter for layout in connection.scalars(query) for meter in json.loads(layout)}

    def rejected(self, limit: int = 100) -> list[Rejected]:
        """Return the newest rejected readings, newest first."""
        b = BAD.c
        query = sa.select(b.t, b.key, b.reason, b.payload).order_by(b.seq.desc()).limit(limit)
        with self._read() as connection:
            return [Rejected(*row) for row in connection.execute(query)]

    def feeders(self) -> dict[str, dict[str, Any]]:
        """Return the tables of the feeders added over REST, by name."""
        with self._read() as connection:
            rows = connection.execute(sa.select(FEEDER.c.name, FEEDER.c.tables).order_by(FEEDER.c.name))
            return {name: json.loads(tables) for name, tables in rows}

    def commission(self, feeder: str) -> StateSnapshot | None:
        """Return the stored commissioning of a feeder, or None."""
        return self._kept(COMMISSION, feeder, SnapshotKind.COMMISSION)

    def distrust(self, feeder: str) -> StateSnapshot | None:
        """Return the stored suspicions of a feeder, or None."""
        return self._kept(DISTRUST, feeder, SnapshotKind.DISTRUST)

    def _kept(self, table: sa.Table, feeder: str, matter: SnapshotKind) -> StateSnapshot | None:
        c = table.c
        with self._read() as connection:
            row = connection.execute(sa.select(c.feeder, c.t, c.data).where(c.feeder == feeder)).first()
            return None if row is None else StateSnapshot(*row, matter)

    def commission_events(self, feeder: str, limit: int = 100) -> list[CommissioningEvent]:
        """Return the newest entries of a feeder's record of commissioning, oldest first."""
        c = COMMISSION_EVENT.c
        query = sa.select(COMMISSION_EVENT).where(c.feeder == feeder).order_by(c.seq.desc()).limit(limit)
        with self._read() as connection:
            rows = connection.execute(query).mappings().all()
        return [
            CommissioningEvent(
                feeder,
                row["t"],
                CommissioningChange(row["change"]),
                tuple(json.loads(row["meters"])),
                row["who"],
                row["reason"],
            )
            for row in reversed(rows)
        ]


def _event(row: sa.RowMapping) -> AlarmEvent:
    return AlarmEvent(
        row["seq"],
        row["t"],
        Change(row["change"]),
        row["who"],
        row["comment"],
        from_json(json.loads(row["data"])),
    )
