"""Tables of the database, their migration, and records beside alarms and reports."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import sqlalchemy as sa
from pydantic import Field

from gridsec.errors import GridsecError
from service.alarms.state_machine import Alarm, Change, from_json
from service.times import UtcTwins


class CommissioningChange(StrEnum):
    """Change of a commissioning."""

    BEGUN = "begun"
    LEARNED = "learned"
    RECOMMISSIONED = "recommissioned"


@dataclass(frozen=True, slots=True)
class CommissioningEvent(UtcTwins):
    """One change of a commissioning."""

    feeder: Annotated[str, Field(exclude=True)]
    t: float
    change: CommissioningChange
    meters: tuple[str, ...]
    who: str | None
    reason: str


class StoreUnavailable(GridsecError):
    """The database cannot be opened, read or written."""

    code = "database-unavailable"

    @property
    def public(self) -> str:
        """Sentence for clients, without address and message of the database."""
        text = _PUBLIC.get(self.code, "the database cannot be used")
        return f"{text} ({self.code}); the log of the service has the details"


_PUBLIC = {
    "outcome-unknown": "the outcome of the change is not known yet",
    "stopping": "the service is stopping",
    "write-under-way": "the previous write has not ended",
}
"""Sentences for clients by code."""


class OutcomeUnknown(StoreUnavailable):
    """The connection broke during the commit of a transaction: it is stored as a whole, or not at all."""

    code = "outcome-unknown"


class WriterLost(StoreUnavailable):
    """The writer's lock is lost: another process may have written, and this one must end."""

    code = "writer-lost"


class LeaseLost(StoreUnavailable):
    """Another worker has claimed the shards of these feeders, or may have; nothing was written."""

    code = "lease-lost"

    def __init__(self, worker: str, feeders: Collection[str]) -> None:
        self.feeders = frozenset(feeders)
        super().__init__(f"worker {worker!r} has lost the leases of {', '.join(sorted(feeders))}")


@dataclass(frozen=True, slots=True)
class AlarmEvent(UtcTwins):
    """One event of an alarm, and the alarm after it."""

    seq: int  # increases in the order of commits and is never reused
    t: float
    change: Change
    who: str | None
    comment: str | None
    alarm: Alarm


@dataclass(frozen=True, slots=True)
class Rejected:
    """A rejected reading: arrival time (Unix s), key, reason, and the beginning of its bytes."""

    t: float
    key: str
    reason: str
    payload: bytes = b""


META = sa.MetaData()
SEQ = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

OPEN_S = 60.0
"""Time limit of a call while the database is opened, s: a migration may take longer than a write."""
_MIGRATION_LOCK = 0x6772_6964_6D69_6700

VERSION = sa.Table("schema_version", META, sa.Column("version", sa.Integer, nullable=False))
ALARM = sa.Table(
    "alarm",
    META,
    sa.Column("id", sa.String(26), primary_key=True),
    sa.Column("kind", sa.String(32), nullable=False),
    sa.Column("feeder", sa.String(64), nullable=False),
    sa.Column("meter", sa.String(64)),
    sa.Column("severity", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("t_raised", sa.Double, nullable=False),
    sa.Column("t_cleared", sa.Double),
    sa.Column("data", sa.Text, nullable=False),
    sa.Column("incident", sa.String(26)),  # null only for alarms that cleared before schema version 7
    sa.Column("work", sa.String(26)),  # planned work during which it was raised
    sa.Column("words", sa.Text, nullable=False, server_default=""),  # text for searches, in lower case
    sa.Index("alarm_by_feeder", "feeder", "state"),
    sa.Index("alarm_by_incident", "incident"),
)
EVENT = sa.Table(
    "event",
    META,
    sa.Column("seq", SEQ, primary_key=True, autoincrement=True),
    sa.Column("alarm_id", sa.String(26), sa.ForeignKey("alarm.id"), nullable=False, index=True),
    sa.Column("feeder", sa.String(64), nullable=False),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("change", sa.String(16), nullable=False),
    sa.Column("who", sa.Text),
    sa.Column("comment", sa.Text),
    sa.Column("data", sa.Text, nullable=False),
    sqlite_autoincrement=True,
)
OUTBOX = sa.Table(
    "outbox",
    META,
    sa.Column("seq", SEQ, sa.ForeignKey("event.seq"), primary_key=True, autoincrement=False),
)
INCIDENT = sa.Table(
    "incident",
    META,
    sa.Column("id", sa.String(26), primary_key=True),
    sa.Column("kind", sa.String(32), nullable=False),
    sa.Column("feeder", sa.String(64), nullable=False),
    sa.Column("severity", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("t_first", sa.Double, nullable=False),
    sa.Column("t_last", sa.Double, nullable=False),
    sa.Column("t_cleared", sa.Double),
    sa.Column("shelved_until", sa.Double),
    sa.Column("planned_until", sa.Double),
    sa.Column("assigned_to", sa.Text),
    sa.Column("words", sa.Text, nullable=False),
    sa.Column("data", sa.Text, nullable=False),
    sa.Index("incident_by_feeder", "feeder", "state"),
)
INCIDENT_EVENT = sa.Table(
    "incident_event",
    META,
    sa.Column("seq", SEQ, primary_key=True, autoincrement=True),
    sa.Column("incident_id", sa.String(26), sa.ForeignKey("incident.id"), nullable=False, index=True),
    sa.Column("feeder", sa.String(64), nullable=False),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("change", sa.String(16), nullable=False),
    sa.Column("who", sa.Text),
    sa.Column("comment", sa.Text),
    sa.Column("notify", sa.Boolean, nullable=False),
    sa.Column("data", sa.Text, nullable=False),
    sa.Column("published", sa.Boolean, nullable=False),  # on zenoh
    sa.Index("incident_event_by_publication", "published", "seq"),
    sqlite_autoincrement=True,
)


def _suppression(name: str) -> sa.Table:
    """A table of shelves or of planned works."""
    return sa.Table(
        name,
        META,
        sa.Column("id", sa.String(26), primary_key=True),
        sa.Column("feeder", sa.String(64), nullable=False),
        sa.Column("t_next", sa.Double, index=True),  # next time at which it changes; null after its end
        sa.Column("data", sa.Text, nullable=False),
    )


SHELF, WORK = _suppression("shelf"), _suppression("planned_work")
LAYOUT = sa.Table(
    "history_layout",
    META,
    sa.Column("id", SEQ, primary_key=True, autoincrement=True),
    sa.Column("meters", sa.Text, nullable=False),
    # PostgreSQL cannot index a text of more than 2704 bytes.
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Index("history_layout_by_digest", "digest", unique=True),
)
HISTORY = sa.Table(
    "history",
    META,
    sa.Column("feeder", sa.String(64), primary_key=True),
    sa.Column("t", sa.Double, primary_key=True),
    sa.Column("verdict", sa.String(16), nullable=False),
    sa.Column("cause", sa.String(32), nullable=False),
    sa.Column("layout", SEQ, sa.ForeignKey("history_layout.id"), nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),
)
ROLLUP = sa.Table(
    "history_rollup",
    META,
    # Extremes of the stored ticks of a feeder in [t, t + `series.ROLLUP_S`), and the time of each verdict, s.
    sa.Column("feeder", sa.String(64), primary_key=True),
    sa.Column("t", sa.Double, primary_key=True),
    sa.Column("layout", SEQ, sa.ForeignKey("history_layout.id"), primary_key=True, autoincrement=False),
    sa.Column("ticks", sa.Integer, nullable=False),
    sa.Column("clean_s", sa.Double, nullable=False),
    sa.Column("attacked_s", sa.Double, nullable=False),
    sa.Column("undecided_s", sa.Double, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),
)
BAD = sa.Table(
    "bad_reading",
    META,
    sa.Column("seq", SEQ, primary_key=True, autoincrement=True),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("key", sa.Text, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("payload", sa.LargeBinary, nullable=False),
    sqlite_autoincrement=True,
)
FEEDER = sa.Table(
    "feeder",
    META,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("tables", sa.Text, nullable=False),
    sa.Column(
        "version", sa.BigInteger, nullable=False, server_default="0"
    ),  # `FEEDER_CHANGES` after its change
)
FEEDER_CHANGES = sa.Table(
    "feeder_changes",
    META,
    # One row: number of feeders that were added, changed or removed over REST.
    sa.Column("number", sa.BigInteger, nullable=False),
)


def _of_each_feeder(name: str) -> sa.Table:
    """A table of one text per feeder, the newest."""
    return sa.Table(
        name,
        META,
        sa.Column("feeder", sa.String(64), primary_key=True),
        sa.Column("t", sa.Double, nullable=False),
        sa.Column("data", sa.Text, nullable=False),
    )


COMMISSION, DISTRUST = _of_each_feeder("commission"), _of_each_feeder("distrust")
SIGNED, OBSERVER = _of_each_feeder("signed_order"), _of_each_feeder("observer")
COMMISSION_EVENT = sa.Table(
    "commission_event",
    META,
    sa.Column("seq", SEQ, primary_key=True, autoincrement=True),
    sa.Column("feeder", sa.String(64), nullable=False, index=True),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("change", sa.String(16), nullable=False),
    sa.Column("meters", sa.Text, nullable=False),
    sa.Column("who", sa.Text),
    sa.Column("reason", sa.Text, nullable=False),
    sqlite_autoincrement=True,
)

WRITER = sa.Table(
    "writer",
    META,
    # The store that may write; the key of its last commit; its checks.
    sa.Column("owner", sa.String(32), nullable=False),
    sa.Column("commits", sa.BigInteger, nullable=False),
    sa.Column("checks", sa.BigInteger, nullable=False),
    sa.Column("worker", SEQ),  # its number in `worker`; null: the only writer
)
"""One row, or one for each worker. A store without its row writes nothing more."""
WORKER = sa.Table(
    "worker",
    META,
    # Times of the database's clock, Unix s.
    sa.Column("number", SEQ, primary_key=True, autoincrement=True),
    sa.Column("name", sa.String(64), nullable=False),
    sa.Column("registered", sa.Double, nullable=False),
    sa.Column("until", sa.Double, nullable=False),
    sqlite_autoincrement=True,
)
SHARD = sa.Table(
    "shard",
    META,
    sa.Column("shard", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("epoch", sa.BigInteger, nullable=False),  # number of claims
    sa.Column("owner", SEQ),  # number of a worker; null: released
)


def _add_commissioning(connection: sa.Connection) -> None:
    for table in (COMMISSION, COMMISSION_EVENT):
        table.create(connection)


def _add_distrust(connection: sa.Connection) -> None:
    DISTRUST.create(connection)


def words_of(alarm: Alarm) -> str:
    """Return the text of an alarm for searches."""
    parts = (
        alarm.feeder,
        alarm.kind,
        alarm.meter,
        alarm.customer,
        alarm.reason,
        alarm.acknowledged_by,
        alarm.comment,
    )
    return " ".join(part for part in parts if part).lower()


def _add_rollup(connection: sa.Connection) -> None:
    ROLLUP.create(connection)


def digest(meters: str) -> str:
    """Return the lookup key of a layout."""
    return hashlib.sha256(meters.encode()).hexdigest()


def _add_digest(connection: sa.Connection) -> None:
    add = "ALTER TABLE history_layout ADD COLUMN digest VARCHAR(64) NOT NULL DEFAULT ''"
    connection.exec_driver_sql(add)
    if connection.dialect.name == "postgresql":
        # SQLite has no such limit; to drop a constraint there, the table that all history refers to would be
        # rebuilt.
        connection.exec_driver_sql("ALTER TABLE history_layout DROP CONSTRAINT history_layout_meters_key")
    for number, meters in connection.execute(sa.select(LAYOUT.c.id, LAYOUT.c.meters)).all():
        connection.execute(LAYOUT.update().where(LAYOUT.c.id == number).values(digest=digest(meters)))
    connection.exec_driver_sql("CREATE UNIQUE INDEX history_layout_by_digest ON history_layout (digest)")


def _add_writer(connection: sa.Connection) -> None:
    connection.exec_driver_sql(
        "CREATE TABLE writer (owner VARCHAR(32) NOT NULL, commits BIGINT NOT NULL, checks BIGINT NOT NULL)"
    )


def _add_incidents(connection: sa.Connection) -> None:
    for column in ("incident VARCHAR(26)", "work VARCHAR(26)", "words TEXT NOT NULL DEFAULT ''"):
        connection.exec_driver_sql(f"ALTER TABLE alarm ADD COLUMN {column}")
    connection.exec_driver_sql("CREATE INDEX alarm_by_incident ON alarm (incident)")
    for table in (INCIDENT, INCIDENT_EVENT, SHELF, WORK):
        table.create(connection)
    for number, data in connection.execute(sa.select(ALARM.c.id, ALARM.c.data)).all():
        words = words_of(from_json(json.loads(data)))
        connection.execute(ALARM.update().where(ALARM.c.id == number).values(words=words))


def _add_signed(connection: sa.Connection) -> None:
    SIGNED.create(connection)


def _add_workers(connection: sa.Connection) -> None:
    connection.exec_driver_sql("ALTER TABLE writer ADD COLUMN worker BIGINT")
    connection.exec_driver_sql("ALTER TABLE feeder ADD COLUMN version BIGINT NOT NULL DEFAULT 0")
    for table in (WORKER, SHARD, FEEDER_CHANGES):
        table.create(connection)
    connection.execute(FEEDER_CHANGES.insert().values(number=0))


def _add_observer(connection: sa.Connection) -> None:
    OBSERVER.create(connection)


MIGRATIONS: tuple[Callable[[sa.Connection], None], ...] = (
    _add_commissioning,
    _add_distrust,
    _add_digest,
    _add_writer,
    _add_rollup,
    _add_incidents,
    _add_signed,
    _add_workers,
    _add_observer,
)
"""Step k migrates schema version k + 1 to k + 2. A new database starts at the newest version.

Steps after `_add_workers` only add tables, and columns that may be null or have a default of the server.
Workers of the earlier version go on meanwhile.
"""


def migrate(connection: sa.Connection, name: str) -> None:
    """Create the tables, or migrate those of an older version.

    Raises StoreUnavailable if the database is newer than this program.
    """
    newest = 1 + len(MIGRATIONS)
    if connection.dialect.name == "postgresql":
        # Several workers may open the database at once, and a migration takes longer than a write.
        for limit in ("lock_timeout", "idle_in_transaction_session_timeout"):
            connection.exec_driver_sql(f"SET LOCAL {limit} = '{OPEN_S:g}s'")
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_MIGRATION_LOCK)))
    if not sa.inspect(connection).has_table(VERSION.name):
        META.create_all(connection)
        connection.execute(VERSION.insert().values(version=newest))
        connection.execute(FEEDER_CHANGES.insert().values(number=0))
        return
    version = int(connection.execute(sa.select(VERSION.c.version)).scalar_one())
    if version > newest:
        raise StoreUnavailable(
            f"{name} has schema version {version}; this program supports versions up to {newest}",
            code="newer-schema",
        )
    for step in MIGRATIONS[version - 1 :]:
        step(connection)
    connection.execute(VERSION.update().values(version=newest))
