"""Connections: one that writes, some that only read, and words for what the database refuses."""

from __future__ import annotations

import fcntl
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from service.store.records import StoreUnavailable

WAIT_S = 5.0
"""How long to wait for a connection or for the writer before us to end, s."""
BUSY_S = 0.5
"""How long a commit waits for somebody who locks the database; whoever watches must not wait longer, s."""
_ADVISORY_LOCK = 0x6772_6964_7365_6300


class Connections:
    """The one writer and the readers of a database.

    Parameters
    ----------
    url
        As in `Store`.

    Attributes
    ----------
    name
        The address without its password.
    insert
        The family's INSERT, which knows ON CONFLICT.

    Raises
    ------
    StoreUnavailable
        If it cannot be opened, or another process writes it.
    """

    def __init__(self, url: str) -> None:
        self._lock_file: IO[bytes] | None = None
        self._engines: tuple[sa.Engine, ...] = ()
        self._path: Path | None = None
        self._lock_path: Path | None = None
        self._file: tuple[int, int] | None = None
        try:
            parsed = sa.make_url(url)
        except sa.exc.ArgumentError as error:
            raise StoreUnavailable(f"{url!r} is no database address: {error}") from error
        self.name = parsed.render_as_string(hide_password=True)
        family = parsed.get_backend_name()
        if family not in {"sqlite", "postgresql"}:
            raise StoreUnavailable(f"{self.name}: only sqlite and postgresql are supported, not {family}")
        self.insert: Any = sqlite.insert if family == "sqlite" else postgresql.insert
        try:
            with self._guard("open"):
                self._engines = self._open_sqlite(parsed) if family == "sqlite" else _open_postgresql(parsed)
        except StoreUnavailable:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the database. Closing twice is fine."""
        for engine in self._engines:
            engine.dispose()
        if self._lock_file is not None:
            self._lock_file.close()
            self._lock_file = None

    @contextmanager
    def write(self, doing: str = "write") -> Iterator[sa.Connection]:
        """Begin a transaction of the writer; it is on the disk when the block has ended.

        Parameters
        ----------
        doing
            What cannot be done, should it fail.
        """
        with self._guard(doing):
            self._in_place()
            self._locked()
            with self._engines[0].begin() as connection:
                yield connection

    @contextmanager
    def read(self) -> Iterator[sa.Connection]:
        """Open a connection that cannot write."""
        with self._guard("read"):
            self._in_place()
            with self._engines[1].connect() as connection:
                yield connection

    def _in_place(self) -> None:
        """See that the file is where it was: one that was removed takes every commit and keeps none."""
        if self._path is None or self._file is None:
            return
        place = _place(self._path)
        if place != self._file:
            what = "removed" if place is None else "replaced"
            raise OSError(f"the file has been {what}; put it back, or restart to begin with what is there")

    def _locked(self) -> None:
        """See that our lock is the one that others meet: another file of that name keeps nobody away."""
        if self._lock_path is None or self._lock_file is None:
            return
        held = os.fstat(self._lock_file.fileno())
        if _place(self._lock_path) != (held.st_dev, held.st_ino):
            raise OSError(f"{self._lock_path} has been removed or replaced, and others may write; restart")

    @contextmanager
    def _guard(self, doing: str) -> Iterator[None]:
        try:
            yield
        except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError) as error:
            cause = getattr(error, "orig", None) or error
            text = " ".join(str(cause).split()) or type(cause).__name__
            raise StoreUnavailable(f"cannot {doing} {self.name}: {text}") from error

    def _open_sqlite(self, url: sa.URL) -> tuple[sa.Engine, sa.Engine]:
        if not url.database or url.database == ":memory:":
            raise StoreUnavailable(f"{self.name}: name a file; what is in memory does not survive")
        # One file has one lock, under whatever name it was given.
        path = self._path = Path(os.path.realpath(url.database))
        self._lock_path = path.with_name(path.name + ".lock")
        lock = self._lock_file = self._lock_path.open("ab")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StoreUnavailable(f"cannot open {self.name}: another process writes it") from error

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


def _place(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def _open_postgresql(url: sa.URL) -> tuple[sa.Engine, sa.Engine]:
    if url.get_driver_name() != "psycopg":
        url = url.set(drivername="postgresql+psycopg")
    # A server that has vanished from the network must not hold us for as long as TCP would.
    wait = {"connect_timeout": int(WAIT_S), "tcp_user_timeout": int(WAIT_S * 1e3)}
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
