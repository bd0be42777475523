"""Connections: one that writes, some that only read, and words for what the database refuses."""

from __future__ import annotations

import fcntl
import os
import sqlite3
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from service.store.records import OutcomeUnknown, StoreUnavailable, WriterLost
from service.store.schema import WRITER

if TYPE_CHECKING:
    from service.store.postgresql import WriterSession

WAIT_S = 5.0
"""Wait for a free connection of the readers, s."""
BUSY_S = 0.5
"""Wait of a commit for another process that locks an SQLite file, s."""
_VERB_CODES = {"open": "open-failed", "read": "read-failed"}
"""Code of a failure without a more specific one, by the verb of its message; of others `write-failed`."""
_SQLITE_CODES = {
    sqlite3.SQLITE_BUSY: "database-locked",
    sqlite3.SQLITE_LOCKED: "database-locked",
    sqlite3.SQLITE_NOTADB: "not-a-database",
    sqlite3.SQLITE_READONLY: "read-only",
}
"""Code by SQLite's primary result."""


class _FileMoved(OSError):
    """The database's file is not at its place.

    Parameters
    ----------
    text
        What happened to it.
    code
        Code of the reason.
    """

    def __init__(self, text: str, *, code: str) -> None:
        self.code = code
        super().__init__(text)


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
    lost
        Why nothing more may be written, or None.

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
        self._session: WriterSession | None = None
        self._owner = uuid.uuid4().hex
        self.lost: WriterLost | None = None
        try:
            parsed = sa.make_url(url)
        except sa.exc.ArgumentError as error:
            text = f"{url!r} is no database address: {error}"
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
            The verb of the message, should it fail.

        Raises
        ------
        WriterLost
            If another process may have written since this one opened the database.
        OutcomeUnknown
            If the connection broke during the commit.
        StoreUnavailable
            If nothing was written.
        """
        with self._guard(doing), self._begin(self._check_owner) as connection:
            yield connection

    @contextmanager
    def opening(self) -> Iterator[sa.Connection]:
        """Begin the first transaction of the writer; `own` must be called in it."""
        with self._guard("open"), self._begin(lambda _: None) as connection:
            yield connection
        if self._session is not None:
            self._session.opened()

    def own(self, connection: sa.Connection) -> None:
        """Become the one that may write.

        Parameters
        ----------
        connection
            A transaction of the writer.
        """
        connection.execute(WRITER.delete())
        connection.execute(WRITER.insert().values(owner=self._owner, commits=0, checks=0))

    @property
    def beat_s(self) -> float | None:
        """Interval at which `beat` is due, s; None if the lock needs no heartbeat."""
        if self._session is None:
            return None
        from service.store.postgresql import BEAT_S

        return BEAT_S

    def beat(self) -> None:
        """Keep the session that holds the lock, or note its loss."""
        if self._session is not None and self._session.up:
            with self.write("keep the session of"):
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
                        f"{self.name}: the connection broke during a commit ({_text(error)}); whether it is "
                        "stored is not known yet"
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
        """Return a connection in a transaction; once more if it turns out to be closed."""
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
        """True if a call failed at once because its connection had been closed."""
        if not error.connection_invalidated:
            return False
        from service.store.postgresql import NoAnswer

        return not isinstance(error.orig, NoAnswer)

    def _check_owner(self, connection: sa.Connection) -> None:
        if connection.scalar(sa.select(WRITER.c.owner)) != self._owner:
            raise WriterLost("another process has opened it to write since", code="other-writer")

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
            raise _FileMoved(
                f"the file has been {what}; put it back, or restart to begin with what is there",
                code="file-removed" if place is None else "file-replaced",
            )

    def _locked(self) -> None:
        """See that our lock is the one that others meet: another file of that name keeps nobody away."""
        if self._lock_path is None or self._lock_file is None:
            return
        held = os.fstat(self._lock_file.fileno())
        if _place(self._lock_path) != (held.st_dev, held.st_ino):
            text = f"{self._lock_path} has been removed or replaced, and others may write"
            raise WriterLost(text, code="lock-moved")

    @contextmanager
    def _guard(self, doing: str) -> Iterator[None]:
        try:
            yield
        except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError) as error:
            text = f"cannot {doing} {self.name}: {_text(error)}"
            raise StoreUnavailable(text, code=self._code(doing, error)) from error

    def _code(self, doing: str, error: BaseException) -> str:
        """Code of a failure: by its cause, or else by the verb of its message."""
        cause = getattr(error, "orig", None) or error
        found = cause.code if isinstance(cause, _FileMoved) else ""
        if isinstance(cause, sqlite3.Error):
            found = _SQLITE_CODES.get(getattr(cause, "sqlite_errorcode", 0) & 0xFF, "")
        elif self._session is not None:
            from service.store.postgresql import code_of

            found = code_of(cause)
        return found or _VERB_CODES.get(doing, "write-failed")

    def _open_sqlite(self, url: sa.URL) -> tuple[sa.Engine, sa.Engine]:
        if not url.database or url.database == ":memory:":
            text = f"{self.name}: name a file; what is in memory does not survive"
            raise StoreUnavailable(text, code="in-memory")
        # One file has one lock, under whatever name it was given.
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
        from service.store.postgresql import WriterSession, engines

        self._session = WriterSession()
        return engines(url, self._session)


def _place(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def _text(error: BaseException) -> str:
    """Return the words of the database in one line."""
    cause = getattr(error, "orig", None) or error
    return " ".join(str(cause).split()) or type(cause).__name__
