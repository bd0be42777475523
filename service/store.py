"""What must survive: alarms, their events, the outbox, history, rejected readings, feeder tables.

SQLite or PostgreSQL, by SQLAlchemy's Core. One transaction holds an alarm's state, its event and the
outbox entry for its publication, so that none of the three is ever seen without the others.

There is one writer: one connection in one process, held by a lock that ends with the process. SQLite
before 3.51.3 can corrupt a WAL database that two connections write or checkpoint at once; readers here have
connections of their own which cannot write. Every commit is on the disk when `commit` returns
(`synchronous=FULL`, `synchronous_commit=on`).

All methods block; from asynchronous code, call them in a thread. They are safe to call from any thread.
"""

from __future__ import annotations

import fcntl
import json
import sqlite3
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from gridsec.errors import GridsecError
from service.alarms import (
    Alarm,
    AlarmState,
    AlarmUnknown,
    Change,
    Transition,
    acknowledged,
    from_json,
    to_json,
)
from service.history import HistoryRules, Mark, mark, pack, unpack, worth_keeping
from service.report import FeederReport

WAIT_S = 5.0
"""How long to wait for a lock or a connection before saying that the database cannot be used, s."""
BAD_READINGS_KEPT = 1000
_PAYLOAD_KEPT = 256
_PRUNE_EVERY = 500
_ADVISORY_LOCK = 0x6772_6964_7365_6300


class StoreUnavailable(GridsecError):
    """The database cannot be opened, read or written; the message says which one and why."""


@dataclass(frozen=True, slots=True)
class Event:
    """One stored transition. `seq` rises by the order of commits and is never used twice."""

    seq: int
    t: float
    change: Change
    who: str | None
    comment: str | None
    alarm: Alarm


@dataclass(frozen=True, slots=True)
class Rejected:
    """A reading that could not be used: arrival time (Unix s), key, why, and the start of its bytes."""

    t: float
    key: str
    reason: str
    payload: bytes = b""


_META = sa.MetaData()
_SEQ = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

_VERSION = sa.Table("schema_version", _META, sa.Column("version", sa.Integer, nullable=False))
_ALARM = sa.Table(
    "alarm",
    _META,
    sa.Column("id", sa.String(26), primary_key=True),
    sa.Column("kind", sa.String(32), nullable=False),
    sa.Column("feeder", sa.String(64), nullable=False),
    sa.Column("meter", sa.String(64)),
    sa.Column("severity", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("t_raised", sa.Double, nullable=False),
    sa.Column("t_cleared", sa.Double),
    sa.Column("data", sa.Text, nullable=False),
    sa.Index("alarm_by_feeder", "feeder", "state"),
)
_EVENT = sa.Table(
    "event",
    _META,
    sa.Column("seq", _SEQ, primary_key=True, autoincrement=True),
    sa.Column("alarm_id", sa.String(26), sa.ForeignKey("alarm.id"), nullable=False, index=True),
    sa.Column("feeder", sa.String(64), nullable=False),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("change", sa.String(16), nullable=False),
    sa.Column("who", sa.Text),
    sa.Column("comment", sa.Text),
    sa.Column("data", sa.Text, nullable=False),
    sqlite_autoincrement=True,
)
_OUTBOX = sa.Table(
    "outbox",
    _META,
    sa.Column("seq", _SEQ, sa.ForeignKey("event.seq"), primary_key=True, autoincrement=False),
)
_LAYOUT = sa.Table(
    "history_layout",
    _META,
    sa.Column("id", _SEQ, primary_key=True, autoincrement=True),
    sa.Column("meters", sa.Text, nullable=False, unique=True),
)
_HISTORY = sa.Table(
    "history",
    _META,
    sa.Column("feeder", sa.String(64), primary_key=True),
    sa.Column("t", sa.Double, primary_key=True),
    sa.Column("verdict", sa.String(16), nullable=False),
    sa.Column("cause", sa.String(32), nullable=False),
    sa.Column("layout", _SEQ, sa.ForeignKey("history_layout.id"), nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),
)
_BAD = sa.Table(
    "bad_reading",
    _META,
    sa.Column("seq", _SEQ, primary_key=True, autoincrement=True),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("key", sa.Text, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("payload", sa.LargeBinary, nullable=False),
    sqlite_autoincrement=True,
)
_FEEDER = sa.Table(
    "feeder",
    _META,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("tables", sa.Text, nullable=False),
)

MIGRATIONS: tuple[Callable[[sa.Connection], None], ...] = ()
"""Step k leads from schema version k + 1 to k + 2. A new database starts at the newest version."""


class Store:
    """The database of one service.

    Parameters
    ----------
    url
        `sqlite:///file`, `sqlite:////absolute/file` or `postgresql+psycopg://user@host/name`.
    history
        How much of the past is kept.

    Raises
    ------
    StoreUnavailable
        If the database cannot be opened and written, if another process writes it, or if it is newer than
        this program.
    """

    def __init__(self, url: str, *, history: HistoryRules | None = None) -> None:
        self._history_rules = history or HistoryRules()
        self._lock = threading.RLock()
        self._lock_file: IO[bytes] | None = None
        self._marks: dict[str, Mark] = {}
        self._since_prune: dict[str, int] = {}
        try:
            parsed = sa.make_url(url)
        except sa.exc.ArgumentError as error:
            raise StoreUnavailable(f"{url!r} is no database address: {error}") from error
        self.name = parsed.render_as_string(hide_password=True)
        family = parsed.get_backend_name()
        if family not in {"sqlite", "postgresql"}:
            raise StoreUnavailable(f"{self.name}: only sqlite and postgresql are supported, not {family}")
        try:
            with self._guard("open"):
                if family == "sqlite":
                    self._insert: Any = sqlite.insert
                    self._writer, self._reader = self._open_sqlite(parsed)
                else:
                    self._insert = postgresql.insert
                    self._writer, self._reader = _open_postgresql(parsed)
                with self._writer.begin() as connection:
                    _migrate(connection, self.name)
                    newest = connection.scalar(sa.select(sa.func.max(_EVENT.c.seq)))
            self._last_event = int(newest or 0)
        except StoreUnavailable:
            self.close()
            raise

    def __enter__(self) -> Store:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Let go of the database. Closing twice is fine."""
        with self._lock:
            for engine in (getattr(self, "_reader", None), getattr(self, "_writer", None)):
                if engine is not None:
                    engine.dispose()
            if self._lock_file is not None:
                self._lock_file.close()
                self._lock_file = None

    # ---------------------------------------------------------------- writing

    def commit(
        self,
        transitions: Iterable[Transition] = (),
        *,
        reports: Iterable[FeederReport] = (),
        rejected: Iterable[Rejected] = (),
    ) -> tuple[int, ...]:
        """Store what a tick brought, in one transaction; it is on the disk when this returns.

        Parameters
        ----------
        transitions
            Alarms that changed: state, event and outbox entry of each.
        reports
            Reports of the feeders; those worth keeping go into the history.
        rejected
            Readings that could not be used; the newest `BAD_READINGS_KEPT` are kept.

        Returns
        -------
        tuple of int
            The event number of each transition.

        Raises
        ------
        StoreUnavailable
            If nothing was stored.
        """
        transitions, rejected = tuple(transitions), tuple(rejected)
        with self._lock:
            kept = [(now, report) for report in reports if (now := self._keep(report))]
            if not (transitions or kept or rejected):
                return ()
            with self._write() as connection:
                numbers = tuple(self._put_transition(connection, item) for item in transitions)
                for _, report in kept:
                    self._put_history(connection, report)
                if rejected:
                    _put_rejected(connection, rejected)
            self._marks.update({report.feeder: now for now, report in kept})
            self._last_event = max((self._last_event, *numbers))
            return numbers

    def acknowledge(self, alarm_id: str, who: str, comment: str, t: float) -> Transition:
        """Answer an alarm that no book holds any more.

        For an alarm of a running book use `alarms.acknowledge` and `commit`, or the book will not know.

        Parameters
        ----------
        alarm_id, who, comment, t
            Which alarm, who answers it, with what words, and when (Unix s).

        Raises
        ------
        AlarmUnknown, AlreadyAcknowledged
            If there is no such alarm, or somebody was faster.
        """
        with self._lock:
            alarm = self.alarm(alarm_id)
            if alarm is None:
                raise AlarmUnknown(alarm_id)
            transition = acknowledged(alarm, who, comment, t)
            self.commit((transition,))
            return transition

    def outbox_done(self, numbers: Iterable[int]) -> None:
        """Forget outbox entries that have been published.

        Parameters
        ----------
        numbers
            Their event numbers.
        """
        rows = [{"number": number} for number in numbers]
        if rows:
            with self._lock, self._write() as connection:
                connection.execute(_OUTBOX.delete().where(_OUTBOX.c.seq == sa.bindparam("number")), rows)

    def put_feeder(self, name: str, tables: Mapping[str, Any]) -> None:
        """Keep the tables of a feeder, in place of those it had.

        Parameters
        ----------
        name, tables
            The feeder, and JSON of the columns of its files.
        """
        row = {"name": name, "tables": json.dumps(tables, allow_nan=False)}
        statement = self._insert(_FEEDER).values(row)
        with self._lock, self._write() as connection:
            connection.execute(statement.on_conflict_do_update(index_elements=["name"], set_=row))

    def check(self) -> None:
        """Write something and see.

        Raises
        ------
        StoreUnavailable
            If the database cannot be written.
        """
        with self._lock, self._write() as connection:
            connection.execute(_VERSION.update().values(version=_VERSION.c.version))

    def writable(self) -> bool:
        """Whether the database can be written now; `check` says why not."""
        try:
            self.check()
        except StoreUnavailable:
            return False
        return True

    # ---------------------------------------------------------------- reading

    @property
    def last_event(self) -> int:
        """Number of the newest event; costs nothing."""
        return self._last_event

    def alarm(self, alarm_id: str) -> Alarm | None:
        """Return an alarm by its id.

        Parameters
        ----------
        alarm_id
            The id.
        """
        with self._read() as connection:
            data = connection.scalar(sa.select(_ALARM.c.data).where(_ALARM.c.id == alarm_id))
        return None if data is None else from_json(json.loads(data))

    def alarms(
        self,
        *,
        state: Collection[str] = (),
        kind: Collection[str] = (),
        severity: Collection[str] = (),
        feeder: str | None = None,
        meter: str | None = None,
        since: float | None = None,
        until: float | None = None,
        cursor: str | None = None,
        limit: int = 100,
    ) -> tuple[list[Alarm], str | None]:
        """Return a page of alarms, those that began last first.

        Parameters
        ----------
        state, kind, severity
            Only these; empty: all.
        feeder, meter
            Only of these.
        since, until
            Only those raised in [since, until), Unix s.
        cursor
            Where the last page ended; pages stay right while alarms come and change.
        limit
            Length of a page.

        Returns
        -------
        alarms, cursor
            The cursor is None on the last page.
        """
        a = _ALARM.c
        query = sa.select(a.id, a.data).order_by(a.id.desc()).limit(limit + 1)
        for column, allowed in ((a.state, state), (a.kind, kind), (a.severity, severity)):
            if allowed:
                query = query.where(column.in_([str(value) for value in allowed]))
        for column, wanted in ((a.feeder, feeder), (a.meter, meter)):
            if wanted is not None:
                query = query.where(column == wanted)
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

    def active(self, feeder: str, *, cleared_since: float | None = None) -> list[Alarm]:
        """Return what `alarms.restore` needs.

        Parameters
        ----------
        feeder
            Whose alarms.
        cleared_since
            Also those that cleared at or after this time, Unix s.
        """
        a = _ALARM.c
        stands: sa.ColumnElement[bool] = a.state != str(AlarmState.CLEARED)
        if cleared_since is not None:
            stands = stands | (a.t_cleared >= cleared_since)
        query = sa.select(a.data).where(a.feeder == feeder, stands).order_by(a.id)
        with self._read() as connection:
            return [from_json(json.loads(data)) for data in connection.scalars(query)]

    def events(self, alarm_id: str) -> list[Event]:
        """Return everything that happened to an alarm, oldest first.

        Parameters
        ----------
        alarm_id
            The id.
        """
        with self._read() as connection:
            query = sa.select(_EVENT).where(_EVENT.c.alarm_id == alarm_id).order_by(_EVENT.c.seq)
            return [_event(row) for row in connection.execute(query).mappings()]

    def events_after(self, number: int, *, feeder: str | None = None, limit: int = 100) -> list[Event]:
        """Return the events after a number, oldest first.

        Parameters
        ----------
        number
            The last event that is known already.
        feeder
            Only of this one.
        limit
            At most so many.
        """
        query = sa.select(_EVENT).where(_EVENT.c.seq > number).order_by(_EVENT.c.seq).limit(limit)
        if feeder is not None:
            query = query.where(_EVENT.c.feeder == feeder)
        with self._read() as connection:
            return [_event(row) for row in connection.execute(query).mappings()]

    def outbox_pending(self, limit: int = 1000) -> list[Event]:
        """Return the events that have not been published yet, oldest first.

        Parameters
        ----------
        limit
            At most so many.
        """
        query = sa.select(_EVENT).join(_OUTBOX, _OUTBOX.c.seq == _EVENT.c.seq).order_by(_EVENT.c.seq)
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

        Parameters
        ----------
        feeder
            Name.
        since, until
            Unix s.
        meter
            Also this one's numbers; None at ticks at which the feeder had no such meter.
        limit
            At most so many ticks.

        Returns
        -------
        list of dict
            `t`, `verdict`, `cause`, and what `history.unpack` returns.
        """
        h = _HISTORY.c
        query = (
            sa.select(h.t, h.verdict, h.cause, h.data, _LAYOUT.c.meters)
            .join(_LAYOUT, _LAYOUT.c.id == h.layout)
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

    def rejected(self, limit: int = 100) -> list[Rejected]:
        """Return the newest readings that could not be used, newest first.

        Parameters
        ----------
        limit
            At most so many.
        """
        b = _BAD.c
        query = sa.select(b.t, b.key, b.reason, b.payload).order_by(b.seq.desc()).limit(limit)
        with self._read() as connection:
            return [Rejected(*row) for row in connection.execute(query)]

    def feeders(self) -> dict[str, dict[str, Any]]:
        """Return the tables that `put_feeder` kept, by name."""
        with self._read() as connection:
            rows = connection.execute(sa.select(_FEEDER.c.name, _FEEDER.c.tables).order_by(_FEEDER.c.name))
            return {name: json.loads(tables) for name, tables in rows}

    # ---------------------------------------------------------------- inside

    @contextmanager
    def _guard(self, doing: str) -> Iterator[None]:
        try:
            yield
        except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError) as error:
            cause = getattr(error, "orig", None) or error
            text = " ".join(str(cause).split()) or type(cause).__name__
            raise StoreUnavailable(f"cannot {doing} {self.name}: {text}") from error

    @contextmanager
    def _write(self) -> Iterator[sa.Connection]:
        with self._guard("write"), self._writer.begin() as connection:
            yield connection

    @contextmanager
    def _read(self) -> Iterator[sa.Connection]:
        with self._guard("read"), self._reader.connect() as connection:
            yield connection

    def _put_transition(self, connection: sa.Connection, transition: Transition) -> int:
        alarm = transition.alarm
        data = json.dumps(to_json(alarm), allow_nan=False)
        row = {
            "id": alarm.id,
            "kind": str(alarm.kind),
            "feeder": alarm.feeder,
            "meter": alarm.meter,
            "severity": str(alarm.severity),
            "state": str(alarm.state),
            "t_raised": alarm.t_raised,
            "t_cleared": alarm.t_cleared,
            "data": data,
        }
        connection.execute(
            self._insert(_ALARM).values(row).on_conflict_do_update(index_elements=["id"], set_=row)
        )
        event = {
            "alarm_id": alarm.id,
            "feeder": alarm.feeder,
            "t": transition.t,
            "change": str(transition.change),
            "who": transition.who,
            "comment": transition.comment,
            "data": data,
        }
        number = int(connection.execute(_EVENT.insert().values(event).returning(_EVENT.c.seq)).scalar_one())
        connection.execute(_OUTBOX.insert().values(seq=number))
        return number

    def _keep(self, report: FeederReport) -> Mark | None:
        now = mark(report)
        return now if worth_keeping(self._marks.get(report.feeder), now, self._history_rules) else None

    def _put_history(self, connection: sa.Connection, report: FeederReport) -> None:
        row = {
            "feeder": report.feeder,
            "t": report.t,
            "verdict": str(report.verdict),
            "cause": str(report.cause),
            "layout": self._layout(connection, report),
            "data": pack(report.meters),
        }
        statement = self._insert(_HISTORY).values(row)
        connection.execute(statement.on_conflict_do_update(index_elements=["feeder", "t"], set_=row))
        count = self._since_prune.get(report.feeder, 0) + 1
        if count >= _PRUNE_EVERY:
            h, keep = _HISTORY.c, self._history_rules.keep_s
            connection.execute(_HISTORY.delete().where(h.feeder == report.feeder, h.t < report.t - keep))
            count = 0
        self._since_prune[report.feeder] = count

    def _layout(self, connection: sa.Connection, report: FeederReport) -> int:
        meters = json.dumps([meter.meter for meter in report.meters])
        known = connection.scalar(sa.select(_LAYOUT.c.id).where(_LAYOUT.c.meters == meters))
        if known is None:
            inserted = connection.execute(_LAYOUT.insert().values(meters=meters).returning(_LAYOUT.c.id))
            known = inserted.scalar_one()
        return int(known)

    def _open_sqlite(self, url: sa.URL) -> tuple[sa.Engine, sa.Engine]:
        if not url.database or url.database == ":memory:":
            raise StoreUnavailable(f"{self.name}: name a file; what is in memory does not survive")
        path = Path(url.database).absolute()
        lock = self._lock_file = path.with_name(path.name + ".lock").open("ab")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StoreUnavailable(f"cannot open {self.name}: another process writes it") from error

        def connect(mode: str) -> Callable[[], sqlite3.Connection]:
            def connection() -> sqlite3.Connection:
                made = sqlite3.connect(
                    f"file:{quote(str(path))}?mode={mode}",
                    uri=True,
                    timeout=WAIT_S,
                    isolation_level=None,
                    check_same_thread=False,
                )
                made.execute("PRAGMA foreign_keys = ON")
                if mode == "rwc":
                    made.execute("PRAGMA journal_mode = WAL")
                    made.execute("PRAGMA synchronous = FULL")
                return made

            return connection

        writer = sa.create_engine(
            "sqlite://", creator=connect("rwc"), poolclass=sa.QueuePool, pool_size=1, max_overflow=0
        )
        sa.event.listen(writer, "begin", lambda connection: connection.exec_driver_sql("BEGIN IMMEDIATE"))
        reader = sa.create_engine(
            "sqlite://", creator=connect("ro"), poolclass=sa.QueuePool, pool_size=4, pool_timeout=WAIT_S
        )
        return writer, reader


def _open_postgresql(url: sa.URL) -> tuple[sa.Engine, sa.Engine]:
    if url.get_driver_name() != "psycopg":
        url = url.set(drivername="postgresql+psycopg")
    wait = {"connect_timeout": int(WAIT_S)}
    writer = sa.create_engine(
        url,
        pool_size=1,
        max_overflow=0,
        pool_pre_ping=True,
        connect_args={**wait, "options": f"-c synchronous_commit=on -c lock_timeout={int(WAIT_S * 1e3)}"},
    )

    def lock(connection: Any, _record: object) -> None:
        # Held for as long as the connection lives: the one writer.
        with connection.cursor() as cursor:
            cursor.execute("SELECT pg_advisory_lock(%s)", (_ADVISORY_LOCK,))
        connection.commit()

    sa.event.listen(writer, "connect", lock)
    reader = sa.create_engine(
        url,
        pool_size=4,
        pool_timeout=WAIT_S,
        pool_pre_ping=True,
        connect_args={**wait, "options": "-c default_transaction_read_only=on"},
    )
    return writer, reader


def _migrate(connection: sa.Connection, name: str) -> None:
    newest = 1 + len(MIGRATIONS)
    if not sa.inspect(connection).has_table(_VERSION.name):
        _META.create_all(connection)
        connection.execute(_VERSION.insert().values(version=newest))
        return
    version = int(connection.execute(sa.select(_VERSION.c.version)).scalar_one())
    if version > newest:
        raise StoreUnavailable(
            f"{name} has schema version {version}; this program knows {newest} and is too old for it"
        )
    for step in MIGRATIONS[version - 1 :]:
        step(connection)
    connection.execute(_VERSION.update().values(version=newest))


def _put_rejected(connection: sa.Connection, rejected: Iterable[Rejected]) -> None:
    rows = [
        {"t": item.t, "key": item.key, "reason": item.reason, "payload": item.payload[:_PAYLOAD_KEPT]}
        for item in tuple(rejected)[-BAD_READINGS_KEPT:]
    ]
    connection.execute(_BAD.insert(), rows)
    newest = sa.select(sa.func.max(_BAD.c.seq)).scalar_subquery()
    connection.execute(_BAD.delete().where(_BAD.c.seq <= newest - BAD_READINGS_KEPT))


def _event(row: sa.RowMapping) -> Event:
    return Event(
        row["seq"],
        row["t"],
        Change(row["change"]),
        row["who"],
        row["comment"],
        from_json(json.loads(row["data"])),
    )
