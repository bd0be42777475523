"""Databases beside that of the service, written by several processes: the command line and a service.

With SQLite such a database is a file of its own, `<database><suffix>`, with a rollback journal: unlike a WAL,
several processes write it safely. With PostgreSQL its tables are in the service's database.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from urllib.parse import quote

import sqlalchemy as sa

from service.store.connect import CALL_S, Timed
from service.store.schema import StoreUnavailable

BUSY_S: Final = 5.0
"""Wait of a write for the lock of the database, s."""
_VERSION: Final = 1


class SharedDatabase:
    """Connections of one such database. Methods block and are thread-safe.

    database: address of the service's database.
    suffix: suffix of the SQLite file.
    tables: all tables.
    version: the table of them with the schema version, one row.
    lock: number of the advisory lock that serialises transactions on PostgreSQL.
    Raises StoreUnavailable if the database cannot be opened, or is newer than this program.
    """

    def __init__(
        self, database: str, suffix: str, tables: sa.MetaData, version: sa.Table, *, lock: int
    ) -> None:
        try:
            url = sa.make_url(database)
        except sa.exc.ArgumentError as error:
            text = f"{database!r} is not a database address: {error}"
            raise StoreUnavailable(text, code="wrong-address") from error
        self._sqlite, self._lock = url.get_backend_name() == "sqlite", lock
        self.name = url.render_as_string(hide_password=True) + (suffix if self._sqlite else "")
        self._engine = _sqlite(url, suffix) if self._sqlite else _postgresql(url)
        try:
            self._create(tables, version)
        except BaseException:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Close all connections; idempotent."""
        self._engine.dispose()

    def _create(self, tables: sa.MetaData, schema: sa.Table) -> None:
        with self._write() as connection:
            # Two processes may create the tables at once.
            self._serialise(connection)
            if not sa.inspect(connection).has_table(schema.name):
                tables.create_all(connection)
                connection.execute(schema.insert().values(version=_VERSION))
            version = int(connection.scalar(sa.select(schema.c.version)) or 0)
        if version > _VERSION:
            text = f"{self.name} has version {version}; this program supports versions up to {_VERSION}"
            raise StoreUnavailable(text, code="newer-schema")

    def _serialise(self, connection: sa.Connection) -> None:
        """Wait for other transactions that were serialised; on SQLite every write is."""
        if not self._sqlite:
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(self._lock)))

    @contextmanager
    def _write(self) -> Iterator[sa.Connection]:
        with self._guard("write"), self._engine.begin() as connection:
            if self._sqlite:
                # A deferred transaction that reads first and then writes fails at once if another one writes.
                connection.exec_driver_sql("BEGIN IMMEDIATE")
            yield connection

    @contextmanager
    def _read(self) -> Iterator[sa.Connection]:
        with self._guard("read"), self._engine.connect() as connection:
            yield connection

    @contextmanager
    def _guard(self, doing: str) -> Iterator[None]:
        try:
            yield
        except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError) as error:
            cause = " ".join(str(getattr(error, "orig", None) or error).split())
            code = "read-failed" if doing == "read" else "write-failed"
            raise StoreUnavailable(f"cannot {doing} {self.name}: {cause}", code=code) from error


def _sqlite(url: sa.URL, suffix: str) -> sa.Engine:
    if not url.database or url.database == ":memory:":
        text = f"{url}: expected a file; a database in memory is lost at the end"
        raise StoreUnavailable(text, code="in-memory")
    path = Path(os.path.realpath(url.database) + suffix)
    try:
        # For the owner alone, from the first moment.
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600))
    except FileExistsError:
        pass
    except OSError as error:
        raise StoreUnavailable(f"cannot write {path}: {error.strerror}", code="write-failed") from error

    def connect() -> sqlite3.Connection:
        made = sqlite3.connect(
            f"file:{quote(str(path))}?mode=rw",
            uri=True,
            timeout=BUSY_S,
            isolation_level=None,
            check_same_thread=False,
        )
        made.execute("PRAGMA foreign_keys = ON")
        made.execute("PRAGMA journal_mode = DELETE")
        made.execute("PRAGMA synchronous = FULL")
        return made

    engine = sa.create_engine("sqlite://", creator=connect, poolclass=sa.QueuePool, pool_size=4)
    sa.event.listen(engine, "connect", lambda _, record: record.info.update(place=_place(path)))
    sa.event.listen(engine, "checkout", lambda _, record, __: _in_place(path, record.info["place"]))
    return engine


def _place(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_dev, found.st_ino


def _in_place(path: Path, place: tuple[int, int]) -> None:
    """Give up connections to a removed or replaced file: its contents are not the service's."""
    if not path.exists() or _place(path) != place:
        raise sa.exc.DisconnectionError(f"{path} has been removed or replaced")


def _postgresql(url: sa.URL) -> sa.Engine:
    if url.get_driver_name() != "psycopg":
        url = url.set(drivername="postgresql+psycopg")
    wait = {"connect_timeout": int(CALL_S), "tcp_user_timeout": int(CALL_S * 1e3)}
    limit = f"-c statement_timeout={CALL_S * 1e3:.0f} -c synchronous_commit=on"
    engine = sa.create_engine(
        url, pool_size=4, pool_timeout=CALL_S, pool_pre_ping=True, connect_args={**wait, "options": limit}
    )
    # A server that stops answering ends neither by its own time limit nor by that of TCP.
    sa.event.listen(engine, "do_connect", lambda _, __, given, options: Timed.connect(*given, **options))
    return engine
