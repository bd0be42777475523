"""Database of notifications: the position of each target, and messages that were given up.

It is apart from the service's database: deliveries never wait for the writer of alarms, and the command line
reads and resends messages while the service runs. With SQLite it is the file `<database>.notify`, with
PostgreSQL its tables are in the same database.
"""

from __future__ import annotations

import threading
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final

import sqlalchemy as sa

from service.store.connect import IDLE_S
from service.store.schema import SEQ
from service.store.shared import SharedDatabase

SUFFIX: Final = ".notify"
"""Suffix of the file beside an SQLite database."""
LETTERS_KEPT: Final = 10_000
"""Largest number of dead letters of a target; the oldest are dropped."""
PROBLEM_CHARACTERS: Final = 500
"""Largest length of a stored problem, characters."""
_LOCK: Final = 0x6772_6964_6E6F_7400
_SENDER: Final = 0x6772_6964_6E6F_7401

_META = sa.MetaData()
_SCHEMA = sa.Table("notify_version", _META, sa.Column("version", sa.Integer, primary_key=True))
_TARGET = sa.Table(
    "notify_target",
    _META,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("position", SEQ, nullable=False),
    sa.Column("delivered", sa.Double),
    sa.Column("failing_since", sa.Double),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("problem", sa.Text),
)
_LETTER = sa.Table(
    "dead_letter",
    _META,
    sa.Column("id", SEQ, primary_key=True, autoincrement=True),
    sa.Column("target", sa.String(64), nullable=False, index=True),
    sa.Column("number", SEQ, nullable=False),
    sa.Column("message_id", sa.String(80), nullable=False),
    sa.Column("type", sa.String(64), nullable=False),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("died", sa.Double, nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("problem", sa.Text, nullable=False),
    sa.Column("body", sa.Text, nullable=False),
    sa.Column("resend", sa.Boolean, nullable=False),
    sqlite_autoincrement=True,
)


@dataclass(frozen=True, slots=True)
class Position:
    """State of the deliveries to a target. Times are Unix seconds."""

    position: int  # number of the last event that was delivered, given up or not selected
    delivered: float | None = None  # last successful request
    failing_since: float | None = None  # first failed request after it
    attempts: int = 0  # failed attempts of the next message
    problem: str | None = None  # problem of the last attempt


@dataclass(frozen=True, slots=True)
class DeadLetter:
    """Message that was given up. Times are Unix seconds."""

    target: str
    number: int  # number of the event
    message_id: str  # id of the message, the same at every attempt
    type: str
    t: float  # time of the event
    died: float  # time at which it was given up
    attempts: int
    problem: str  # problem of the last attempt
    body: str  # the message, JSON
    id: int = 0  # number of the dead letter; 0 before it is stored
    resend: bool = False  # requested to be sent again


class DeliveryStore(SharedDatabase):
    """Positions and dead letters of one service. Methods block and are thread-safe.

    database: address of the service's database.
    shared: several processes may send notifications; one of them does at a time (`sends`).
    Raises StoreUnavailable if the database cannot be opened, or is newer than this program.
    """

    def __init__(self, database: str, *, shared: bool = False) -> None:
        super().__init__(database, SUFFIX, _META, _SCHEMA, lock=_LOCK)
        self._shared = shared and not self._sqlite
        self._change, self._closed = threading.Lock(), False
        self._sender: sa.Connection | None = None
        self._sends = False

    def __enter__(self) -> DeliveryStore:
        """Return the store."""
        return self

    def close(self) -> None:
        """Close all connections; idempotent."""
        with self._change:
            self._closed = True
            self._end_session()
        super().close()

    def sends(self) -> bool:
        """True if this process sends notifications: it holds an advisory lock, or has just taken it.

        The server ends the session of a stopped process after `IDLE_S` without a call.
        """
        if not self._shared:
            return True
        with self._change, self._guard("read"):
            if self._closed:
                return False
            try:
                if self._sender is None:
                    made = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
                    self._sender = made
                    made.exec_driver_sql(f"SET idle_session_timeout = '{IDLE_S:g}s'")
                if self._sends:
                    self._sender.scalar(sa.select(1))
                else:
                    self._sends = bool(self._sender.scalar(sa.select(sa.func.pg_try_advisory_lock(_SENDER))))
            except sa.exc.DBAPIError:
                self._end_session()
            return self._sends

    def _end_session(self) -> None:
        self._sends = False
        if self._sender is not None:
            self._sender.invalidate()
            self._sender.close()
            self._sender = None

    # ------------------------------------------------------------- positions

    def positions(self) -> dict[str, Position]:
        """Positions by target."""
        with self._read() as connection:
            rows = connection.execute(sa.select(_TARGET).order_by(_TARGET.c.name)).all()
        return {name: Position(*rest) for name, *rest in rows}

    def keep(self, target: str, position: Position, dead: Collection[DeadLetter] = ()) -> None:
        """Store a position, and the messages given up before it, in one transaction."""
        row = {
            "position": position.position,
            "delivered": position.delivered,
            "failing_since": position.failing_since,
            "attempts": position.attempts,
            "problem": position.problem and position.problem[:PROBLEM_CHARACTERS],
        }
        with self._write() as connection:
            change = _TARGET.update().where(_TARGET.c.name == target).values(row)
            if connection.execute(change).rowcount == 0:
                connection.execute(_TARGET.insert().values(name=target, **row))
            for letter in dead:
                connection.execute(_LETTER.insert().values(_row(letter)))
            if dead:
                _drop_oldest(connection, target)

    def forget(self, target: str) -> bool:
        """Delete the position of a target; False without one. Its dead letters stay."""
        with self._write() as connection:
            return connection.execute(_TARGET.delete().where(_TARGET.c.name == target)).rowcount == 1

    # ---------------------------------------------------------- dead letters

    def letters(
        self,
        *,
        target: str | None = None,
        after: int = 0,
        resend: bool | None = None,
        limit: int | None = None,
    ) -> list[DeadLetter]:
        """Return dead letters, the oldest first.

        target: restrict to this target; None for all.
        after: restrict to higher numbers.
        resend: restrict to those requested to be sent again, or (False) not requested.
        limit: largest number of letters; None for all.
        """
        c = _LETTER.c
        query = sa.select(_LETTER).where(c.id > after).order_by(c.id).limit(limit)
        if target is not None:
            query = query.where(c.target == target)
        if resend is not None:
            query = query.where(c.resend.is_(resend))
        with self._read() as connection:
            return [_letter(row) for row in connection.execute(query).mappings()]

    def counts(self) -> dict[str, int]:
        """Number of dead letters by target, of the targets that have any."""
        query = sa.select(_LETTER.c.target, sa.func.count()).group_by(_LETTER.c.target)
        with self._read() as connection:
            return {name: int(count) for name, count in connection.execute(query)}

    def resend(self, *, target: str | None = None, ids: Collection[int] | None = None) -> int:
        """Request dead letters to be sent again; return their number.

        target, ids: restrict to this target and to these numbers; None for all.
        """
        change = _LETTER.update().values(resend=True)
        with self._write() as connection:
            return int(connection.execute(_selected(change, target, ids)).rowcount)

    def discard(self, *, target: str | None = None, ids: Collection[int] | None = None) -> int:
        """Delete dead letters; return their number. `target` and `ids` as in `resend`."""
        with self._write() as connection:
            return int(connection.execute(_selected(_LETTER.delete(), target, ids)).rowcount)

    def failed_again(self, letter: DeadLetter, problem: str) -> None:
        """Note that a letter that was sent again was given up again."""
        values = {
            "resend": False,
            "attempts": letter.attempts + 1,
            "problem": problem[:PROBLEM_CHARACTERS],
        }
        with self._write() as connection:
            connection.execute(_LETTER.update().where(_LETTER.c.id == letter.id).values(values))


def _selected(statement: Any, target: str | None, ids: Collection[int] | None) -> Any:
    if target is not None:
        statement = statement.where(_LETTER.c.target == target)
    return statement if ids is None else statement.where(_LETTER.c.id.in_(ids))


def _drop_oldest(connection: sa.Connection, target: str) -> None:
    newest = sa.select(_LETTER.c.id).where(_LETTER.c.target == target).order_by(_LETTER.c.id.desc())
    oldest = connection.scalar(newest.offset(LETTERS_KEPT).limit(1))
    if oldest is not None:
        connection.execute(_LETTER.delete().where(_LETTER.c.target == target, _LETTER.c.id <= oldest))


def _row(letter: DeadLetter) -> dict[str, Any]:
    return {
        "target": letter.target,
        "number": letter.number,
        "message_id": letter.message_id,
        "type": letter.type,
        "t": letter.t,
        "died": letter.died,
        "attempts": letter.attempts,
        "problem": letter.problem[:PROBLEM_CHARACTERS],
        "body": letter.body,
        "resend": letter.resend,
    }


def _letter(row: sa.RowMapping) -> DeadLetter:
    return DeadLetter(**row)
