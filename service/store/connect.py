"""Connections to SQLite and PostgreSQL: one writer, read-only readers, errors of the database.

The server releases the advisory lock at the end of the session. `IDLE_S` ends the session of a stopped
process; the heartbeat of a running one is due every `BEAT_S`. With `CALL_S + 2 BEAT_S < IDLE_S` a stopped
server, continued later, never ends a session that this process still uses.
"""

from __future__ import annotations

import fcntl
import os
import sqlite3
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar
from urllib.parse import quote

import psycopg
import sqlalchemy as sa
from psycopg.abc import PQGen
from psycopg.waiting import Ready
from sqlalchemy.dialects import postgresql, sqlite

from service.store.schema import OPEN_S, SHARD, WORKER, WRITER, OutcomeUnknown, StoreUnavailable, WriterLost

CALL_S = 5.0
"""Time limit of a call without any response of the server, s."""
BEAT_S = 2.0
"""Interval of the heartbeat of the writer's session, s."""
IDLE_S = 10.0
"""Time without a call after which the server ends a writer's session, s."""
LOCK_S = 12.0
"""Wait for the lock at the start, s; above `IDLE_S`, so that the session of a stopped writer ends first."""
RELOCK_S = 3.0
"""Wait for the lock after a broken connection, s; below `CALL_S`."""
HELD_S = 4.0
"""Time without a call after which the server ends a transaction of a worker, and with it its locks, s; below
`leases.EXPIRY_S`."""
ADVISORY_LOCK = 0x6772_6964_7365_6300
_ENDED_BY_SERVER = frozenset({"57P01", "57P05", "25P03"})
"""SQLSTATE of an ended session: by an administrator, idle, idle in a transaction."""

_CODES = {"55P03": "database-locked", "25006": "read-only"}
"""Code by SQLSTATE: a lock not available, a transaction that may not write."""

T = TypeVar("T")


class NoAnswer(psycopg.OperationalError):
    """The server did not respond within the time limit of a call; the connection is closed."""

    code = "no-answer"


class Timed(psycopg.Connection[Any]):
    """A connection that closes when the server sends nothing for `limit_s`, s.

    Neither `statement_timeout` nor `tcp_user_timeout` ends a call to a stopped server: its kernel still
    acknowledges what it receives.
    """

    limit_s = CALL_S

    def wait(self, gen: PQGen[T], *args: Any, **kwargs: Any) -> T:
        """Run a call. psycopg resumes it every 0.1 s while the server sends nothing."""
        return super().wait(self._limited(gen), *args, **kwargs)

    def _limited(self, gen: PQGen[T]) -> PQGen[T]:
        end = time.monotonic() + self.limit_s
        try:
            wanted = next(gen)
            while True:
                ready = yield wanted
                if ready != Ready.NONE:
                    end = time.monotonic() + self.limit_s
                elif time.monotonic() > end:
                    gen.close()
                    self.pgconn.finish()
                    raise NoAnswer(f"no answer within {self.limit_s:g} s")
                wanted = gen.send(ready)
        except StopIteration as result:
            return result.value  # type: ignore[no-any-return]


def share_database(made: Timed, name: str, wait_s: float) -> None:
    """Hold the lock of the database together with other workers, for the rest of the session.

    Raises StoreUnavailable if a service without workers holds it for longer than `wait_s`.
    """
    made.limit_s = wait_s + CALL_S
    made.execute("SELECT set_config('lock_timeout', %s, false)", (f"{wait_s * 1e3:.0f}ms",))
    try:
        made.execute("SELECT pg_advisory_lock_shared(%s)", (ADVISORY_LOCK,))
    except psycopg.errors.LockNotAvailable as error:
        text = f"cannot open {name} for workers: a service without workers writes it; stop that service first"
        raise StoreUnavailable(text, code="single-process") from error
    made.execute("SELECT set_config('lock_timeout', %s, false)", (f"{RELOCK_S * 1e3:.0f}ms",))
    made.commit()
    made.limit_s = CALL_S


class WriterSession:
    """Session of the writer.

    name: address of the database, for messages.
    up: True while the session is open.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.up = False
        self._limit_s = OPEN_S
        self._connection: Timed | None = None
        self._server: str | None = None
        self._ended = False

    def opened(self) -> None:
        """Set the time limit of calls to `CALL_S` after the database is open."""
        self._limit_s = CALL_S
        if self._connection is not None:
            self._connection.limit_s = CALL_S

    def connect(self, _dialect: object, _record: object, arguments: Any, options: Any) -> Timed:
        """Connect and take the lock.

        Raises WriterLost if the server, still running, has ended the previous session.
        """
        made = Timed.connect(*arguments, **options)
        try:
            self._take_lock(made)
        except BaseException:
            made.close()
            raise
        made.limit_s = self._limit_s
        self._connection, self.up, self._ended = made, True, False
        return made

    def _take_lock(self, made: Timed) -> None:
        row = made.execute("SELECT pg_postmaster_start_time()::text").fetchone()
        server = None if row is None else str(row[0])
        if self._ended and server == self._server:
            raise WriterLost(
                "the server has ended the session that holds the writer's lock, and other processes may have "
                "written",
                code="session-ended",
            )
        wait = LOCK_S if self._server is None else RELOCK_S
        made.limit_s = wait + CALL_S
        made.execute("SELECT set_config('lock_timeout', %s, false)", (f"{wait * 1e3:.0f}ms",))
        try:
            made.execute("SELECT pg_advisory_lock(%s)", (ADVISORY_LOCK,))
        except psycopg.errors.LockNotAvailable:
            made.rollback()
            self._refuse_workers(made)
            raise
        made.execute("SELECT set_config('lock_timeout', %s, false)", (f"{RELOCK_S * 1e3:.0f}ms",))
        made.commit()
        self._server = server

    def _refuse_workers(self, made: Timed) -> None:
        """Raise StoreUnavailable if workers hold the lock: they share it."""
        shared = made.execute("SELECT pg_try_advisory_lock_shared(%s)", (ADVISORY_LOCK,)).fetchone()
        if shared is not None and shared[0]:
            text = f"cannot open {self.name}: workers write it; stop all of them and the front first"
            raise StoreUnavailable(text, code="workers-running")

    def note(self, error: sa.exc.DBAPIError) -> None:
        """Update the state of the session after a failed call."""
        if error.connection_invalidated:
            self.up = False
            self._ended = getattr(error.orig, "sqlstate", None) in _ENDED_BY_SERVER


class WorkerSession(WriterSession):
    """Session of a worker. Its end is no loss: the epochs of the leases decide about every transaction."""

    def _take_lock(self, made: Timed) -> None:
        share_database(made, self.name, LOCK_S if self._server is None else RELOCK_S)
        self._server = ""


def code_of(cause: BaseException) -> str:
    """Return the code of a failed call; empty without a specific one."""
    if isinstance(cause, NoAnswer):
        return cause.code
    return _CODES.get(getattr(cause, "sqlstate", None) or "", "")


def engines(url: sa.URL, session: WriterSession) -> tuple[sa.Engine, sa.Engine]:
    """Return the engine of the writer and that of the readers."""
    if url.get_driver_name() != "psycopg":
        url = url.set(drivername="postgresql+psycopg")
    wait = {"connect_timeout": int(CALL_S), "tcp_user_timeout": int(CALL_S * 1e3)}
    # The server ends calls of disconnected clients; otherwise an abandoned call keeps its locks.
    gone = f"-c client_connection_check_interval={BEAT_S * 1e3:.0f}"
    held_s = HELD_S if isinstance(session, WorkerSession) else IDLE_S
    silent = f"-c idle_session_timeout={IDLE_S * 1e3:.0f} "
    silent += f"-c idle_in_transaction_session_timeout={held_s * 1e3:.0f}"
    writer = sa.create_engine(
        url,
        pool_size=1,
        max_overflow=0,
        pool_timeout=CALL_S,
        connect_args={**wait, "options": f"-c synchronous_commit=on {gone} {silent}"},
    )
    sa.event.listen(writer, "do_connect", session.connect)
    reader = sa.create_engine(
        url,
        pool_size=4,
        pool_timeout=CALL_S,
        pool_pre_ping=True,
        connect_args={**wait, "options": f"-c default_transaction_read_only=on {gone}"},
    )
    sa.event.listen(
        reader,
        "do_connect",
        lambda _dialect, _record, arguments, options: Timed.connect(*arguments, **options),
    )
    return writer, reader


WAIT_S = 5.0
"""Wait for a free connection of the readers, s."""
BUSY_S = 0.5
"""Wait of a commit while another process locks an SQLite file, s."""
_VERB_CODES = {"open": "open-failed", "read": "read-failed"}
"""Code of a failure without a more specific one, by the verb of its message; otherwise `write-failed`."""
_SQLITE_CODES = {
    sqlite3.SQLITE_BUSY: "database-locked",
    sqlite3.SQLITE_LOCKED: "database-locked",
    sqlite3.SQLITE_NOTADB: "not-a-database",
    sqlite3.SQLITE_READONLY: "read-only",
}
"""Code by SQLite's primary result."""


class _FileMoved(OSError):
    """The database file is not in its place."""

    def __init__(self, text: str, *, code: str) -> None:
        self.code = code
        super().__init__(text)


class Connections:
    """The writer and the readers of a database.

    worker: number of the worker that writes together with others; 0 for an observer that writes nothing; None
        for one writer.
    name: address without the password.
    insert: INSERT of the dialect, with ON CONFLICT.
    lost: reason why nothing more may be written, or None.
    url: as in `Store`.
    Raises StoreUnavailable if it cannot be opened, or another process writes it.
    """

    def __init__(self, url: str, *, worker: int | None = None) -> None:
        self._worker = worker
        self._lock_file: IO[bytes] | None = None
        self._engines: tuple[sa.Engine, ...] = ()
        self._path: Path | None = None
        self._lock_path: Path | None = None
        self._file: tuple[int, int] | None = None
        self._session: WriterSession | None = None
        self._owner = uuid.uuid4().hex
        self.lost: WriterLost | None = None
        self._upserts: dict[str, Any] = {}
        try:
            parsed = sa.make_url(url)
        except sa.exc.ArgumentError as error:
            text = f"{url!r} is not a database address: {error}"
            raise StoreUnavailable(text, code="wrong-address") from error
        self.name = parsed.render_as_string(hide_password=True)
        family = parsed.get_backend_name()
        if family not in {"sqlite", "postgresql"}:
            text = f"{self.name}: only sqlite and postgresql are supported, not {family}"
            raise StoreUnavailable(text, code="unsupported")
        self.insert: Any = sqlite.insert if family == "sqlite" else postgresql.insert
        try:
            with self._guard("open"):
                self._engines = (
                    self._open_sqlite(parsed) if family == "sqlite" else self._open_postgresql(parsed)
                )
        except StoreUnavailable:
            self.close()
            raise

    def upsert(self, table: sa.Table, *keys: str) -> Any:
        """Return the INSERT of a row with all columns of `table`; it updates the row with the same `keys`.

        The values are parameters of `execute`: the statement is built and compiled once.
        """
        found = self._upserts.get(table.name)
        if found is None:
            statement, names = self.insert(table), [column.name for column in table.columns]
            values = {name: statement.excluded[name] for name in names if name not in keys}
            found = statement.on_conflict_do_update(index_elements=keys, set_=values)
            self._upserts[table.name] = found
        return found

    def close(self) -> None:
        """Close all connections and release the lock; idempotent."""
        for engine in self._engines:
            engine.dispose()
        if self._lock_file is not None:
            self._lock_file.close()
            self._lock_file = None

    @contextmanager
    def write(self, doing: str = "write") -> Iterator[sa.Connection]:
        """Begin a transaction of the writer; it is durable after the block.

        `doing` is the verb of the message after a failure.

        Raises WriterLost if another process may have written since this one opened the database;
            OutcomeUnknown if the connection broke during the commit; StoreUnavailable if nothing was written.
        """
        with self._guard(doing), self._begin(self._check_owner) as connection:
            yield connection

    @contextmanager
    def write_once(self, key: int | None) -> Iterator[tuple[sa.Connection, bool]]:
        """Begin a transaction as `write`; it sets the key of the last commit.

        Returns connection, stored: True if the last commit had this key; the block then must not write.
        """
        stored = False

        def check(connection: sa.Connection) -> None:
            nonlocal stored
            stored = False
            if key is not None:
                other = WRITER.update().where(WRITER.c.owner == self._owner, WRITER.c.commits != key)
                if connection.execute(other.values(commits=key)).rowcount:
                    return
                stored = True
            self._check_owner(connection)

        with self._guard("write"), self._begin(check) as connection:
            yield connection, stored

    @contextmanager
    def opening(self) -> Iterator[sa.Connection]:
        """Begin the first transaction of the writer; `own` must be called in it."""
        with self._guard("open"), self._begin(lambda _: None) as connection:
            yield connection
        if self._session is not None:
            self._session.opened()

    def own(self, connection: sa.Connection) -> None:
        """Register this store as the writer, or as one of the workers; end the rights of all others."""
        w = WRITER.c
        if self._worker is None:
            connection.execute(WRITER.delete())
            connection.execute(WORKER.delete())
            claimed = SHARD.update().where(SHARD.c.owner.is_not(None))
            connection.execute(claimed.values(owner=None, epoch=SHARD.c.epoch + 1))
        else:
            workers = sa.select(WORKER.c.number)
            connection.execute(WRITER.delete().where(sa.or_(w.worker.is_(None), w.worker.not_in(workers))))
        if self._worker != 0:
            row = {"owner": self._owner, "commits": 0, "checks": 0, "worker": self._worker}
            connection.execute(WRITER.insert().values(row))

    def count_check(self, connection: sa.Connection) -> None:
        """Write a counter."""
        own = WRITER.update().where(WRITER.c.owner == self._owner)
        connection.execute(own.values(checks=WRITER.c.checks + 1))

    @property
    def beat_s(self) -> float | None:
        """Interval at which `beat` is due, s; None if the lock needs no heartbeat."""
        if self._session is None:
            return None

        return BEAT_S

    def beat(self) -> None:
        """Keep the session of the lock, or note its loss."""
        check = self._check_owner if self._worker != 0 else lambda _: None
        if self._session is not None and self._session.up:
            with self._guard("keep the session of"), self._begin(check):
                pass

    @contextmanager
    def _begin(self, check: Callable[[sa.Connection], None]) -> Iterator[sa.Connection]:
        if self.lost is not None:
            raise WriterLost(str(self.lost), code=self.lost.code)
        self._in_place()
        try:
            self._locked()
            with self._begun(check) as connection:
                yield connection
                try:
                    connection.commit()
                except sa.exc.DBAPIError as error:
                    if not error.connection_invalidated:
                        raise
                    self._note(error)
                    raise OutcomeUnknown(
                        f"{self.name}: the connection broke during a commit ({_text(error)}); its outcome is "
                        "not known yet"
                    ) from error
        except WriterLost as error:
            self.lost = WriterLost(f"cannot write {self.name}: {error}", code=error.code)
            raise self.lost from error
        except sa.exc.DBAPIError as error:
            self._note(error)
            raise

    def _note(self, error: sa.exc.DBAPIError) -> None:
        if self._session is not None:
            self._session.note(error)

    def _begun(self, check: Callable[[sa.Connection], None], *, again: bool = True) -> sa.Connection:
        """Return a connection in a transaction; a second attempt follows if the connection was closed."""
        connection = self._engines[0].connect()
        try:
            connection.begin()
            check(connection)
        except sa.exc.DBAPIError as error:
            connection.close()
            self._note(error)
            if not (again and self._closed_before(error)):
                raise
        except BaseException:
            connection.close()
            raise
        else:
            return connection
        return self._begun(check, again=False)

    @staticmethod
    def _closed_before(error: sa.exc.DBAPIError) -> bool:
        """True if a call failed at once because its connection was closed."""
        if not error.connection_invalidated:
            return False

        return not isinstance(error.orig, NoAnswer)

    def _check_owner(self, connection: sa.Connection) -> None:
        if self._worker == 0:
            raise StoreUnavailable(
                f"{self.name}: this process is no worker and writes nothing", code="read-only"
            )
        own = sa.select(WRITER.c.owner).where(WRITER.c.owner == self._owner)
        if connection.scalar(own) is None:
            raise WriterLost("another process has opened it for writing since", code="other-writer")

    @contextmanager
    def read(self) -> Iterator[sa.Connection]:
        """Open a connection that cannot write."""
        with self._guard("read"):
            self._in_place()
            with self._engines[1].connect() as connection:
                yield connection

    def _in_place(self) -> None:
        """Check that the database file is in its place: a removed file accepts every commit and loses it."""
        if self._path is None or self._file is None:
            return
        place = _place(self._path)
        if place != self._file:
            what = "removed" if place is None else "replaced"
            raise _FileMoved(
                f"the file has been {what}; put it back, or restart with the present files",
                code="file-removed" if place is None else "file-replaced",
            )

    def _locked(self) -> None:
        """Check that the held lock file is in its place: another file of that name locks out no process."""
        if self._lock_path is None or self._lock_file is None:
            return
        held = os.fstat(self._lock_file.fileno())
        if _place(self._lock_path) != (held.st_dev, held.st_ino):
            text = f"{self._lock_path} has been removed or replaced, and other processes may write"
            raise WriterLost(text, code="lock-moved")

    @contextmanager
    def _guard(self, doing: str) -> Iterator[None]:
        try:
            yield
        except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError) as error:
            text = f"cannot {doing} {self.name}: {_text(error)}"
            raise StoreUnavailable(text, code=self._code(doing, error)) from error

    def _code(self, doing: str, error: BaseException) -> str:
        """Code of a failure: by its cause, otherwise by the verb of its message."""
        cause = getattr(error, "orig", None) or error
        found = cause.code if isinstance(cause, _FileMoved) else ""
        if isinstance(cause, sqlite3.Error):
            found = _SQLITE_CODES.get(getattr(cause, "sqlite_errorcode", 0) & 0xFF, "")
        elif self._session is not None:
            found = code_of(cause)
        return found or _VERB_CODES.get(doing, "write-failed")

    def _open_sqlite(self, url: sa.URL) -> tuple[sa.Engine, sa.Engine]:
        if not url.database or url.database == ":memory:":
            text = f"{self.name}: expected a file; a database in memory is lost at the end"
            raise StoreUnavailable(text, code="in-memory")
        # One file has one lock, independent of the name in the address.
        path = self._path = Path(os.path.realpath(url.database))
        self._lock_path = path.with_name(path.name + ".lock")
        lock = self._lock_file = self._lock_path.open("ab")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = f"cannot open {self.name}: another process writes it"
            raise StoreUnavailable(text, code="other-writer") from error

        def connect(mode: str) -> Callable[[], sqlite3.Connection]:
            def connection() -> sqlite3.Connection:
                made = sqlite3.connect(
                    f"file:{quote(str(path))}?mode={mode}",
                    uri=True,
                    timeout=BUSY_S,
                    isolation_level=None,
                    check_same_thread=False,
                )
                made.execute("PRAGMA foreign_keys = ON")
                if mode == "rwc":
                    made.execute("PRAGMA journal_mode = WAL")
                    made.execute("PRAGMA synchronous = FULL")
                    self._file = self._file or _place(path)
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

    def _open_postgresql(self, url: sa.URL) -> tuple[sa.Engine, sa.Engine]:

        self._session = (WriterSession if self._worker is None else WorkerSession)(self.name)
        return engines(url, self._session)


def _place(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def _text(error: BaseException) -> str:
    """Return the message of the database in one line."""
    cause = getattr(error, "orig", None) or error
    return " ".join(str(cause).split()) or type(cause).__name__
