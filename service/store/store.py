"""Store: read access, and write access with one transaction per commit.

History of a feeder: a report of 146 meters has 30 kB of JSON and comes every second. The history keeps ticks
on a coarser grid and every tick with a change of the verdict, its cause or its suspects. A row contains the
verdict, and of every meter the reported and the reconstructed voltage with its standard deviation, score and
threshold, as compressed single-precision columns (volts to 2e-5), about 2.5 kB. `series` has the encoding.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeVar

import sqlalchemy as sa
import structlog

from service.alarms.incidents import Action, IncidentEvent, Shelf
from service.alarms.state_machine import Alarm, AlarmState, AlarmTransition, Change, from_json, to_json
from service.report.report import Kept
from service.store import incidents
from service.store.connect import Connections
from service.store.incidents import IncidentReader
from service.store.leases import Lease, Leases, shard_of
from service.store.rollups import (
    AlarmSpan,
    add_rollups,
    feeders_in,
    layout_ids,
    prune_rollups,
    read_alarm_spans,
    read_series,
)
from service.store.schema import (
    ALARM,
    BAD,
    COMMISSION,
    COMMISSION_EVENT,
    DISTRUST,
    EVENT,
    FEEDER,
    FEEDER_CHANGES,
    HISTORY,
    INCIDENT_EVENT,
    LAYOUT,
    OBSERVER,
    OUTBOX,
    ROLLUP,
    SIGNED,
    AlarmEvent,
    CommissioningChange,
    CommissioningEvent,
    Rejected,
    StoreUnavailable,
    WriterLost,
    migrate,
    words_of,
)
from service.store.series import HistoryRules, Mark, Series, mark, pack, unpack, worth_keeping
from service.store.state_codec import SnapshotKind, StateSnapshot

T = TypeVar("T", bound="AlarmEvent | IncidentEvent")


@dataclass(frozen=True, slots=True)
class AlarmCounts:
    """Numbers of alarms of one feeder."""

    active: int  # raised or acknowledged
    raised: int  # active without an acknowledgement


class Reader(IncidentReader):
    """Read access to a store. Its connections cannot write."""

    def __init__(self, connections: Connections) -> None:
        self._connections = connections
        self._read = connections.read
        self.name = connections.name
        self.history_step_s = HistoryRules().step_s

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
        incident: str | None = None,
        text: str | None = None,
        shelved: bool | None = None,
        sort: str = "onset",
        cursor: str | None = None,
        limit: int = 100,
    ) -> tuple[list[Alarm], str | None]:
        """Return a page of alarms.

        state, kind, severity: permitted values; empty for all.
        feeder, among, meter: restrict to this feeder, to these feeders, and to this meter; None for all.
        since, until: restrict to alarms raised in [since, until), Unix s.
        incident: restrict to alarms of this incident.
        text: restrict to alarms with each of these words, whatever their case.
        shelved: restrict to active alarms that are shelved, or to all others.
        sort: `onset` (latest first), `severity` (highest first) or `raised` (latest raising first).
        cursor: end of the previous page; pages stay correct while alarms are added or change.
        limit: length of a page.
        Returns alarms, cursor: the cursor is None on the last page.
        """
        a = ALARM.c
        given = {"state": state, "kind": kind, "severity": severity, "feeder": feeder}
        given |= {"meter": meter, "incident": incident}
        wanted = incidents.filters(a, among, text, (since, until), (a.t_raised, a.t_raised), **given)
        if shelved is not None:
            any_shelf = sa.or_(sa.false(), *(_shelved_by(shelf) for shelf in self.shelves(standing=True)))
            now = sa.and_(a.state != str(AlarmState.CLEARED), any_shelf)
            wanted.append(now if shelved else sa.not_(now))
        keys = {"onset": None, "severity": incidents.rank_of(a.severity), "raised": a.t_raised}
        rows, following = incidents.page(self._read, a, wanted, keys[sort], cursor, limit)
        return [from_json(data) for data in rows], following

    def raised(self, *, among: Collection[str] | None = None) -> int:
        """Number of active alarms without an acknowledgement, of some feeders or (None) of all."""
        query = sa.select(sa.func.count()).where(ALARM.c.state == str(AlarmState.RAISED))
        if among is not None:
            query = query.where(ALARM.c.feeder.in_(among))
        with self._read() as connection:
            return int(connection.execute(query).scalar_one())

    def alarms_by_feeder(self) -> dict[str, AlarmCounts]:
        """Number of active alarms of the feeders that have any."""
        new = sa.func.sum(sa.case((ALARM.c.state == str(AlarmState.RAISED), 1), else_=0))
        query = sa.select(ALARM.c.feeder, sa.func.count(), new).where(
            ALARM.c.state.in_([str(AlarmState.RAISED), str(AlarmState.ACKNOWLEDGED)])
        )
        with self._read() as connection:
            rows = connection.execute(query.group_by(ALARM.c.feeder))
            return {name: AlarmCounts(int(active), int(raised)) for name, active, raised in rows}

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

    def events(self, alarm_id: str, after: int = 0, *, limit: int = 1000) -> list[AlarmEvent]:
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

    def series(
        self, feeder: str, meters: Sequence[str], *, since: float, until: float, buckets: int = 600
    ) -> Series:
        """Return the time series of some meters of a feeder in [since, until), Unix s.

        `buckets` is the largest number of buckets, extended by one at an end. A longer time than
        `series.ROWS_S` is merged from roll-ups, and from the rows after the newest one.
        """
        with self._read() as connection:
            return read_series(
                connection,
                feeder,
                meters,
                since=since,
                until=until,
                buckets=buckets,
                step_s=self.history_step_s,
            )

    def alarm_spans(
        self, feeder: str, *, since: float, until: float, limit: int = 200
    ) -> tuple[list[AlarmSpan], bool]:
        """Return the occurrences of the alarms of a feeder that overlap [since, until), oldest first.

        Returns spans, more: `more` if there are further alarms than the `limit` newest ones.
        """
        with self._read() as connection:
            return read_alarm_spans(connection, feeder, since=since, until=until, limit=limit)

    def history_meters(self, feeder: str) -> set[str]:
        """Return the meters of all kept ticks of a feeder."""
        kept = sa.select(HISTORY.c.layout).where(HISTORY.c.feeder == feeder).distinct()
        query = sa.select(LAYOUT.c.meters).where(LAYOUT.c.id.in_(kept))
        with self._read() as connection:
            return {meter for layout in connection.scalars(query) for meter in json.loads(layout)}

    def rejected(self, limit: int = 100) -> list[Rejected]:
        """Return the newest rejected readings, newest first."""
        columns = (BAD.c.t, BAD.c.key, BAD.c.reason, BAD.c.payload)
        query = sa.select(*columns).order_by(BAD.c.seq.desc()).limit(limit)
        with self._read() as connection:
            return [Rejected(*row) for row in connection.execute(query)]

    def feeders(self, names: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
        """Return the tables of the feeders added over REST, or of those with these names, by name."""
        chosen = sa.true() if names is None else FEEDER.c.name.in_(names)
        query = sa.select(FEEDER.c.name, FEEDER.c.tables).where(chosen).order_by(FEEDER.c.name)
        with self._read() as connection:
            return {name: json.loads(tables) for name, tables in connection.execute(query)}

    def feeder_changes(self) -> int:
        """Number of changes of the feeders added over REST: it differs after each one, in any process."""
        with self._read() as connection:
            return int(connection.scalar(sa.select(FEEDER_CHANGES.c.number)) or 0)

    def feeder_versions(self) -> dict[str, int]:
        """Number of the last change of each feeder added over REST, by name."""
        with self._read() as connection:
            rows = connection.execute(sa.select(FEEDER.c.name, FEEDER.c.version).order_by(FEEDER.c.name))
            return {row.name: row.version for row in rows}

    def commission(self, feeder: str) -> StateSnapshot | None:
        """Return the stored commissioning of a feeder, or None."""
        return self._kept(COMMISSION, feeder, SnapshotKind.COMMISSION)

    def distrust(self, feeder: str) -> StateSnapshot | None:
        """Return the stored suspicions of a feeder, or None."""
        return self._kept(DISTRUST, feeder, SnapshotKind.DISTRUST)

    def observer(self, feeder: str) -> StateSnapshot | None:
        """Return the stored observer of a feeder, or None."""
        return self._kept(OBSERVER, feeder, SnapshotKind.OBSERVER)

    def signed(self, feeder: str) -> StateSnapshot | None:
        """Return the stored order of a feeder's signed readings, or None."""
        return self._kept(SIGNED, feeder, SnapshotKind.SIGNED)

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


def _shelved_by(shelf: Shelf) -> sa.ColumnElement[bool]:
    """Condition that a shelf applies to an alarm."""
    a = ALARM.c
    given = ((a.id, shelf.alarm), (a.incident, shelf.incident), (a.meter, shelf.meter), (a.kind, shelf.kind))
    return sa.and_(
        a.feeder == shelf.feeder,
        *(sa.and_(column.is_not(None), column == str(value)) for column, value in given if value is not None),
    )


def _event(row: sa.RowMapping) -> AlarmEvent:
    return AlarmEvent(
        row["seq"],
        row["t"],
        Change(row["change"]),
        row["who"],
        row["comment"],
        from_json(json.loads(row["data"])),
    )


# --- Write access ---


BAD_READINGS_KEPT = 1000
_PAYLOAD_KEPT = 256
_PRUNE_EVERY = 500
_PRUNED_AT_ONCE = 5000
"""Largest number of history rows that one transaction deletes: ten times those added until the next pruning.
"""
ALONE_S = 5.0
"""Wait of a write for the previous one, s."""
_NO_LEASES: Mapping[int, Lease] = MappingProxyType({})
_STEADY_S = 86_400.0
"""Time for which a feeder must have reported before anything is deleted, s."""
_log = structlog.get_logger("gridsec.store")
_KEPT = {
    SnapshotKind.COMMISSION: COMMISSION,
    SnapshotKind.DISTRUST: DISTRUST,
    SnapshotKind.OBSERVER: OBSERVER,
    SnapshotKind.SIGNED: SIGNED,
}


class Store(Reader):
    """The database of one service.

    url: `sqlite:///file`, `sqlite:////absolute/file` or `postgresql+psycopg://user@host/name`.
    history: grid and duration of the history.
    leases: leases of this process, which writes the feeders of its shards beside other workers; before
        `Leases.register` it writes nothing. None: this process is the only writer.
    Raises StoreUnavailable if the database cannot be opened and written, if another process writes it, or if
        it is newer than this program.
    """

    def __init__(
        self, url: str, *, history: HistoryRules | None = None, leases: Leases | None = None
    ) -> None:
        super().__init__(Connections(url, worker=None if leases is None else leases.number))
        self._leases = leases
        # Leases at the last change of `_due` and of the caches, and at the last take-over.
        self._known = self._taken = self.held
        self._history_rules = history or HistoryRules()
        self.history_step_s = self._history_rules.step_s
        self._lock = threading.RLock()
        self._marks: dict[str, Mark] = {}
        self._since_prune: dict[str, int] = {}
        # End of the roll-ups of each feeder, Unix s: all older rows are rolled up.
        self._rolled: dict[str, float] = {}
        self._closed = threading.Event()
        try:
            with self._connections.opening() as connection:
                migrate(connection, self.name)
                self._connections.own(connection)
                standing = incidents.orphans(connection)
                if standing:
                    now = max(item.t for item in standing)
                    found = incidents.prepare(connection, standing, (), now)
                    self._number_events(connection)
                    incidents.store(connection, self._connections.insert, found)
                newest = connection.scalar(sa.select(sa.func.max(EVENT.c.seq)))
                newest_incident = connection.scalar(sa.select(sa.func.max(INCIDENT_EVENT.c.seq)))
                self._due = incidents.next_due(connection, self.mine)
        except BaseException:
            self._connections.close()
            raise
        self._last_event = int(newest or 0)
        self._last_incident_event = int(newest_incident or 0)
        self._suppression_changes = 0
        # Key of the last commit, and the newest event before its first attempt.
        self._attempt: tuple[int | None, int] = None, self._last_event
        if (beat_s := self._connections.beat_s) is not None:
            threading.Thread(
                target=self._beat, args=(beat_s,), name="gridsec-store-beat", daemon=True
            ).start()

    def __enter__(self) -> Store:
        """Return the store."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Close the database; idempotent."""
        self._closed.set()
        alone = self._lock.acquire(timeout=ALONE_S)
        try:
            self._connections.close()
        finally:
            if alone:
                self._lock.release()

    @property
    def lost(self) -> WriterLost | None:
        """Reason why this store writes nothing more, or None; without a call to the database."""
        return self._connections.lost

    def _beat(self, every_s: float) -> None:
        """Keep the writer's session. A write in progress keeps it, too."""
        while not self._closed.wait(every_s):
            if self._lock.acquire(blocking=False):
                try:
                    if not self._closed.is_set():
                        self._connections.beat()
                except StoreUnavailable as error:
                    _log.warning("the writer's session is broken", problem=str(error))
                finally:
                    self._lock.release()

    @property
    def history_rules(self) -> HistoryRules:
        """Grid and duration of the history."""
        return self._history_rules

    @property
    def last_event(self) -> int:
        """Number of the newest event; without a call to the database."""
        return self._last_event

    @property
    def last_incident_event(self) -> int:
        """Number of the newest event of an incident; without a call to the database."""
        return self._last_incident_event

    @property
    def suppression_changes(self) -> int:
        """Number of commits of this store that may have changed shelves or planned works."""
        return self._suppression_changes

    @property
    def shared(self) -> bool:
        """True if other workers write beside this process."""
        return self._leases is not None

    @property
    def held(self) -> Mapping[int, Lease]:
        """Leases of this process by shard; another object after each change. Empty without workers."""
        return _NO_LEASES if self._leases is None else self._leases.held

    def mine(self, feeder: str) -> bool:
        """True if this process writes a feeder; without a call to the database."""
        return self._leases is None or self._leases.lease_of(feeder) is not None

    def due(self, now: float) -> bool:
        """True if a commit is due by `now`, Unix s, without other reason; without a call to the database.

        A shelf or a planned work changes, or the leases have changed.
        """
        return self.held is not self._known or (self._due is not None and self._due <= now)

    def refresh(self) -> None:
        """Read `last_event` and `last_incident_event`: other processes add events, too."""
        newest, newest_incident = self.newest()
        self._last_event = max(self._last_event, newest)
        self._last_incident_event = max(self._last_incident_event, newest_incident)

    def newest(self) -> tuple[int, int]:
        """Return the numbers of the newest events of alarms and incidents in the database.

        A reader of the database sees a commit earlier than `last_event` has its number.
        """
        with self._read() as connection:
            found = [connection.scalar(sa.select(sa.func.max(one.c.seq))) for one in (EVENT, INCIDENT_EVENT)]
        return found[0] or 0, found[1] or 0

    def outbox_pending(self, limit: int = 1000, *, after: int = 0) -> list[AlarmEvent]:
        """Return the unpublished events of the feeders of this process, as `Reader.outbox_pending`."""
        read = super().outbox_pending
        return _selected(
            lambda limit, after: read(limit, after=after),
            lambda item: self.mine(item.alarm.feeder),
            limit,
            after,
        )

    def incidents_unpublished(self, *, after: int = 0, limit: int = 1000) -> list[IncidentEvent]:
        """Return the unpublished events of incidents of the feeders of this process, oldest first."""
        read = super().incidents_unpublished
        return _selected(
            lambda limit, after: read(after=after, limit=limit),
            lambda item: self.mine(item.incident.feeder),
            limit,
            after,
        )

    def take_over(self) -> tuple[list[AlarmEvent], list[IncidentEvent]]:
        """Return the unpublished events of the shards that were claimed since the last call."""
        held = self.held
        new = {shard for shard, lease in held.items() if self._taken.get(shard) != lease}
        if not new:
            self._taken = held
            return [], []
        self.refresh()
        alarms = [item for item in self.outbox_pending(_ALL) if shard_of(item.alarm.feeder) in new]
        events = self.incidents_unpublished(limit=_ALL)
        self._taken = held
        return alarms, [item for item in events if shard_of(item.incident.feeder) in new]

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Wait for the previous write, within a time limit."""
        if not self._lock.acquire(timeout=ALONE_S):
            raise StoreUnavailable(
                f"cannot write {self.name}: the previous write has not ended within {ALONE_S:g} s",
                code="write-under-way",
            )
        try:
            yield
        finally:
            self._lock.release()

    @contextmanager
    def _write(self) -> Iterator[sa.Connection]:
        with self._alone(), self._connections.write() as connection:
            yield connection

    def _check(self, connection: sa.Connection, feeders: Collection[str]) -> None:
        if self._leases is not None:
            self._leases.check(connection, feeders)

    def _number_events(self, connection: sa.Connection) -> None:
        """Let no other worker number events until the end of the transaction.

        Otherwise a reader could see a number before a lower one of a transaction in progress, and miss
        the lower one.
        """
        if self._leases is not None:
            connection.execute(sa.select(self._numbering()))

    @staticmethod
    def _numbering() -> sa.ColumnElement[Any]:
        return sa.func.pg_advisory_xact_lock(_EVENT_LOCK)

    def _forget_others(self) -> None:
        """Forget the feeders of released and lost shards: other workers continue their history."""
        for cache in (self._marks, self._rolled, self._since_prune):
            for feeder in [name for name in cache if not self.mine(name)]:
                cache.pop(feeder)

    def commit(
        self,
        transitions: Iterable[AlarmTransition] = (),
        *,
        reports: Iterable[Kept] = (),
        rejected: Iterable[Rejected] = (),
        kept: Iterable[StateSnapshot] = (),
        happened: Iterable[CommissioningEvent] = (),
        without: str | None = None,
        put: tuple[str, Mapping[str, Any]] | None = None,
        actions: Iterable[Action] = (),
        now: float | None = None,
        key: int | None = None,
    ) -> tuple[int, ...]:
        """Store the results of a tick in one transaction; durable when this returns.

        transitions: changed alarms: state, event and outbox entry of each, and changes of their incidents.
        reports: reports of the feeders; the history selects from them.
        rejected: rejected readings; the newest `BAD_READINGS_KEPT` are kept. Readings that the database
            cannot represent are dropped and logged.
        kept, happened: state of the feeders' commissioning, suspicions, observers and signed readings, and
            changes of the first.
        without: delete the tables of this feeder, its commissioning, suspicions and observer.
        put: a feeder and the columns of its files as JSON, which replace the stored ones.
        actions: actions of operators on incidents, shelves and planned works.
        now: wall clock, Unix s, for shelves and works; None: the latest time of the transitions.
        key: positive number of this commit, different from that of the previous commit. After
            `OutcomeUnknown` the same call with the same key stores it, or finds it stored.
        Returns tuple of int: the event number of each transition.
        Raises OutcomeUnknown if the connection broke during the commit; StoreUnavailable if nothing was
            stored.
        """
        transitions, rejected = tuple(transitions), tuple(rejected)
        kept, happened, actions = tuple(kept), tuple(happened), tuple(actions)
        if now is None:
            now = max((item.t for item in transitions), default=-math.inf)
        with self._alone():
            held, due_now = self.held, self.due(now)
            grouped = bool(transitions or actions or due_now)
            if held is not self._known:
                self._forget_others()
            marks, rolled = dict(self._marks), dict(self._rolled)
            worthy = [report for report in reports if self._worth(marks, report)]
            if not (grouped or worthy or rejected or kept or happened or without or put):
                return ()
            feeders = {item.alarm.feeder for item in transitions} | {item.feeder for item in actions}
            feeders |= {item.feeder for item in worthy} | {item.feeder for item in kept}
            feeders |= {item.feeder for item in happened}
            feeders |= {name for name in (without, put and put[0]) if name is not None}
            newest, following = self._last_incident_event, self._due
            if key is None or key != self._attempt[0]:
                self._attempt = key, self._last_event
            suppressions = self._suppression_changes + bool(actions or due_now)
            with self._connections.write_once(key) as (connection, stored):
                if stored:
                    numbers = self._numbers_of(connection, transitions)
                    newest = connection.scalar(sa.select(sa.func.max(INCIDENT_EVENT.c.seq))) or 0
                    moved = True
                else:
                    due = incidents.feeders_due(connection, now, self.mine) if due_now else set[str]()
                    self._check(connection, feeders | due)
                    self._put_history(connection, worthy, rolled)
                    if rejected:
                        _put_rejected(connection, rejected)
                    self._put_kept(connection, kept)
                    if happened:
                        connection.execute(COMMISSION_EVENT.insert(), [_happened(item) for item in happened])
                    if without is not None:
                        _forget_feeder(connection, without)
                    if put is not None:
                        self._put_feeder(connection, *put)
                    # Last: other workers wait for the numbers.
                    grouping = incidents.prepare(connection, transitions, actions, now, due)
                    numbers, newest = self._put_events(connection, transitions, grouping)
                    moved = due_now or incidents.suppressions_change(grouping)
                if moved:
                    following = incidents.next_due(connection, self.mine)
            self._marks, self._rolled = marks, rolled
            self._known, self._due = held, following
            self._last_incident_event = max(self._last_incident_event, newest)
            self._suppression_changes = suppressions
            self._last_event = max((self._last_event, *numbers))
            return numbers

    def outbox_done(self, numbers: Collection[int]) -> None:
        """Delete the outbox entries of published events; those of other workers stay."""
        if numbers:
            with self._write() as connection:
                own = self._own_events(connection, EVENT, numbers)
                connection.execute(OUTBOX.delete().where(OUTBOX.c.seq.in_(own)))

    def incidents_published(self, numbers: Collection[int]) -> None:
        """Mark events of incidents as published on zenoh; those of other workers stay."""
        if numbers:
            with self._write() as connection:
                incidents.published(connection, self._own_events(connection, INCIDENT_EVENT, numbers))

    def _own_events(
        self, connection: sa.Connection, table: sa.Table, numbers: Collection[int]
    ) -> Collection[int]:
        """Return those of some events that belong to feeders of this process."""
        if self._leases is None:
            return numbers
        c = table.c
        found = connection.execute(sa.select(c.seq, c.feeder).where(c.seq.in_(numbers))).all()
        own = self._leases.among(connection, {feeder for _, feeder in found})
        return [number for number, feeder in found if feeder in own]

    def check(self) -> None:
        """Test a write. Raises StoreUnavailable if the database cannot be written."""
        with self._write() as connection:
            self._connections.count_check(connection)

    def _numbers_of(
        self, connection: sa.Connection, transitions: Sequence[AlarmTransition]
    ) -> tuple[int, ...]:
        """Return the numbers of the events of a commit that was stored before."""
        e, feeders = EVENT.c, {item.alarm.feeder for item in transitions}
        # `refresh` may have moved `_last_event` beyond them since.
        newer = sa.select(e.seq).where(e.seq > self._attempt[1], e.feeder.in_(feeders)).order_by(e.seq)
        return tuple(connection.scalars(newer.limit(len(transitions))))

    def _put_events(
        self,
        connection: sa.Connection,
        transitions: Sequence[AlarmTransition],
        grouping: Sequence[incidents.IncidentWrite],
    ) -> tuple[tuple[int, ...], int]:
        """Store transitions and the changes of their incidents.

        Returns numbers, newest: the number of the event of each transition, and that of the newest event of
        an incident or 0.
        """
        if not transitions and grouping:
            self._number_events(connection)
        numbers = tuple(self._put_transition(connection, item) for item in transitions)
        return numbers, incidents.store(connection, self._connections.insert, grouping)

    def _put_transition(self, connection: sa.Connection, transition: AlarmTransition) -> int:
        alarm = transition.alarm
        data = json.dumps(to_json(alarm, stored=True), allow_nan=False)
        row = {
            "id": alarm.id,
            "kind": str(alarm.kind),
            "feeder": alarm.feeder,
            "meter": alarm.meter,
            "severity": str(alarm.severity),
            "state": str(alarm.state),
            "t_raised": alarm.t_raised,
            "t_cleared": alarm.t_cleared,
            "words": words_of(alarm),
            "data": data,
        }
        statement = self._connections.insert(ALARM).values(row)
        statement = statement.on_conflict_do_update(index_elements=["id"], set_=row)
        if self._leases is not None:
            # The lock of `_number_events`, in the call before the number.
            statement = statement.returning(self._numbering())
        connection.execute(statement)
        event = {
            "alarm_id": alarm.id,
            "feeder": alarm.feeder,
            "t": transition.t,
            "change": str(transition.change),
            "who": transition.who,
            "comment": transition.comment,
            "data": data,
        }
        number = int(connection.execute(EVENT.insert().values(event).returning(EVENT.c.seq)).scalar_one())
        connection.execute(OUTBOX.insert().values(seq=number))
        return number

    def _put_feeder(self, connection: sa.Connection, name: str, tables: Mapping[str, Any]) -> None:
        version = _count_change(connection)
        row = {"name": name, "tables": json.dumps(tables, allow_nan=False), "version": version}
        statement = self._connections.insert(FEEDER).values(row)
        connection.execute(statement.on_conflict_do_update(index_elements=["name"], set_=row))

    def _put_kept(self, connection: sa.Connection, kept: Iterable[StateSnapshot]) -> None:
        subjects: dict[SnapshotKind, list[dict[str, Any]]] = {}
        for item in kept:
            row = {"feeder": item.feeder, "t": item.t, "data": item.text}
            subjects.setdefault(item.matter, []).append(row)
        for matter, new in subjects.items():
            connection.execute(self._connections.upsert(_KEPT[matter], "feeder"), new)

    def _worth(self, marks: dict[str, Mark], report: Kept) -> bool:
        """True if a report gets a row; later ones are then compared with it."""
        now = mark(report)
        worth = worth_keeping(marks.get(report.feeder), now, self._history_rules)
        if worth:
            marks[report.feeder] = now
        return worth

    def _put_history(
        self, connection: sa.Connection, reports: Sequence[Kept], rolled: dict[str, float]
    ) -> None:
        found = [(report, report.row) for report in reports]
        layouts = layout_ids(connection, self._connections.insert, {row.meters for _, row in found})
        rows = [
            {
                "feeder": report.feeder,
                "t": report.t,
                "verdict": str(report.verdict),
                "cause": str(report.cause),
                "layout": layouts[row.meters],
                "data": pack(row),
            }
            for report, row in found
        ]
        if rows:
            connection.execute(self._connections.upsert(HISTORY, "feeder", "t"), rows)
        for report in reports:
            self._prune(connection, report)
            add_rollups(connection, self._connections.upsert, rolled, report)

    def _prune(self, connection: sa.Connection, report: Kept) -> None:
        """Delete old history, with the first row after a start and then every `_PRUNE_EVERY` rows."""
        before = self._since_prune.get(report.feeder)
        count = 0 if before is None or before + 1 >= _PRUNE_EVERY else before + 1
        self._since_prune[report.feeder] = count
        h, keep = HISTORY.c, self._history_rules.keep_s
        # A leaping clock must not cost the history: the feeder must have reported steadily for a while.
        steady = min(_STEADY_S, 0.5 * keep)
        lately = h.t.between(report.t - 2.0 * steady, report.t - steady)
        if count or not connection.scalar(sa.select(sa.exists().where(h.feeder == report.feeder, lately))):
            return

        def pruned(table: sa.Table) -> list[str]:
            # Feeders without reports since start-up are pruned by this feeder's clock.
            others = [] if before is None else feeders_in(connection, table)
            silent = [name for name in others if name not in self._marks and self.mine(name)]
            return [report.feeder, *silent]

        # The number of rows fits the time limit of a call.
        oldest = sa.select(h.feeder, h.t).where(h.feeder.in_(pruned(HISTORY)), h.t < report.t - keep)
        connection.execute(
            HISTORY.delete().where(sa.tuple_(h.feeder, h.t).in_(oldest.limit(_PRUNED_AT_ONCE)))
        )
        prune_rollups(connection, pruned(ROLLUP), report.t - keep, limit=_PRUNED_AT_ONCE)


_ALL = 1_000_000
"""Limit of a read of all unpublished events."""
_EVENT_LOCK = 0x6772_6964_6576_7400


def _selected(
    read: Callable[[int, int], list[T]], wanted: Callable[[T], bool], limit: int, after: int
) -> list[T]:
    """Read pages until `limit` wanted events are found."""
    found: list[T] = []
    while True:
        page = read(limit, after)
        found += [item for item in page if wanted(item)]
        if len(page) < limit or len(found) >= limit:
            return found[:limit]
        after = page[-1].seq


def _count_change(connection: sa.Connection) -> int:
    """Return the number of this change of the feeders added over REST."""
    count = FEEDER_CHANGES.update().values(number=FEEDER_CHANGES.c.number + 1)
    return int(connection.execute(count.returning(FEEDER_CHANGES.c.number)).scalar_one())


def _forget_feeder(connection: sa.Connection, name: str) -> None:
    _count_change(connection)
    connection.execute(FEEDER.delete().where(FEEDER.c.name == name))
    # The order of signed readings stays: a feeder that is put again must not accept a repetition.
    for table in (COMMISSION, DISTRUST, OBSERVER):
        connection.execute(table.delete().where(table.c.feeder == name))


def _happened(item: CommissioningEvent) -> dict[str, Any]:
    return {
        "feeder": item.feeder,
        "t": item.t,
        "change": str(item.change),
        "meters": json.dumps(item.meters),
        "who": item.who,
        "reason": item.reason,
    }


def _put_rejected(connection: sa.Connection, rejected: Iterable[Rejected]) -> None:
    """Store rejected readings; their contents must not cost the alarms of this transaction."""
    rows = [
        {"t": item.t, "key": item.key, "reason": item.reason, "payload": item.payload[:_PAYLOAD_KEPT]}
        for item in tuple(rejected)[-BAD_READINGS_KEPT:]
    ]
    try:
        with connection.begin_nested():
            connection.execute(BAD.insert(), rows)
    except (sa.exc.DataError, UnicodeError) as error:
        problem = " ".join(str(getattr(error, "orig", error)).split())
        _log.error("bad readings could not be kept", count=len(rows), problem=problem)
        return
    newest = sa.select(sa.func.max(BAD.c.seq)).scalar_subquery()
    connection.execute(BAD.delete().where(BAD.c.seq <= newest - BAD_READINGS_KEPT))
