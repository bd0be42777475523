"""PostgreSQL sessions: a time limit on every call, and the session that holds the writer's lock.

The server drops the advisory lock when the session ends. `IDLE_S` ends the session of a stopped process, so
its heartbeat is due every `BEAT_S`. `CALL_S + 2 BEAT_S < IDLE_S`: a stopped server, continued later, never
ends a session that this process still uses.
"""

from __future__ import annotations

import time
from typing import Any, TypeVar

import psycopg
import sqlalchemy as sa
from psycopg.abc import PQGen
from psycopg.waiting import Ready

from service.store.records import WriterLost

CALL_S = 5.0
"""Time limit of a call without any answer of the server, s."""
BEAT_S = 2.0
"""Interval of the heartbeat of the writer's session, s."""
IDLE_S = 10.0
"""The server ends a writer's session after this time without a call, s."""
LOCK_S = 12.0
"""Wait for the lock at the start, s; above `IDLE_S`, so that the session of a stopped writer ends first."""
RELOCK_S = 3.0
"""Wait for the lock after a broken connection, s; below `CALL_S`."""
OPEN_S = 60.0
"""Time limit of a call while the database is opened, s: a migration may take longer than a write."""
_ADVISORY_LOCK = 0x6772_6964_7365_6300
_ENDED_BY_SERVER = frozenset({"57P01", "57P05", "25P03"})
"""SQLSTATE of an ended session: by an administrator, idle, idle in a transaction."""

_CODES = {"55P03": "database-locked", "25006": "read-only"}
"""Code by SQLSTATE: a lock not available, a transaction that may not write."""

T = TypeVar("T")


class NoAnswer(psycopg.OperationalError):
    """The server has not answered within the time limit of a call; the connection is closed."""

    code = "no-answer"


class Timed(psycopg.Connection[Any]):
    """A connection that is closed when the server sends nothing for `limit_s`, s.

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


class WriterSession:
    """The session that may write.

    Attributes
    ----------
    up
        Whether it is open.
    """

    def __init__(self) -> None:
        self.up = False
        self._limit_s = OPEN_S
        self._connection: Timed | None = None
        self._server: str | None = None
        self._ended = False

    def opened(self) -> None:
        """Note that the database is open: from here on calls have the limit `CALL_S`."""
        self._limit_s = CALL_S
        if self._connection is not None:
            self._connection.limit_s = CALL_S

    def connect(self, _dialect: object, _record: object, arguments: Any, options: Any) -> Timed:
        """Connect and take the lock.

        Raises
        ------
        WriterLost
            If the server that still runs has ended the session before.
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
                "the server has ended the session that holds the writer's lock, and others may have written",
                code="session-ended",
            )
        wait = LOCK_S if self._server is None else RELOCK_S
        made.limit_s = wait + CALL_S
        made.execute("SELECT set_config('lock_timeout', %s, false)", (f"{wait * 1e3:.0f}ms",))
        made.execute("SELECT pg_advisory_lock(%s)", (_ADVISORY_LOCK,))
        made.execute("SELECT set_config('lock_timeout', %s, false)", (f"{RELOCK_S * 1e3:.0f}ms",))
        made.commit()
        self._server = server

    def note(self, error: sa.exc.DBAPIError) -> None:
        """Note how a call failed.

        Parameters
        ----------
        error
            Its error.
        """
        if error.connection_invalidated:
            self.up = False
            self._ended = getattr(error.orig, "sqlstate", None) in _ENDED_BY_SERVER


def code_of(cause: BaseException) -> str:
    """Return the code of a failed call; empty if it has none of its own.

    Parameters
    ----------
    cause
        The driver's error.
    """
    if isinstance(cause, NoAnswer):
        return cause.code
    return _CODES.get(getattr(cause, "sqlstate", None) or "", "")


def engines(url: sa.URL, session: WriterSession) -> tuple[sa.Engine, sa.Engine]:
    """Return the engine that writes and the one that reads.

    Parameters
    ----------
    url
        Address of the database.
    session
        The session that may write.
    """
    if url.get_driver_name() != "psycopg":
        url = url.set(drivername="postgresql+psycopg")
    wait = {"connect_timeout": int(CALL_S), "tcp_user_timeout": int(CALL_S * 1e3)}
    # The server ends calls whose client has gone; otherwise an abandoned one keeps its locks.
    gone = f"-c client_connection_check_interval={BEAT_S * 1e3:.0f}"
    silent = " ".join(
        f"-c {name}={IDLE_S * 1e3:.0f}"
        for name in ("idle_session_timeout", "idle_in_transaction_session_timeout")
    )
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
