"""Database of access control: API keys, sessions of the web page, and the audit log.

It is apart from the service's database, since the command line writes it while the service runs: the file
`<database>.access`, or tables in a PostgreSQL database. Entries of the audit log are appended one at a
time, under `BEGIN IMMEDIATE` or an advisory lock of the transaction.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any, Final

import sqlalchemy as sa

from service.access.audit import AuditEntry, chained
from service.access.identity import Role
from service.access.keys import KeyRecord
from service.store.schema import SEQ
from service.store.shared import SharedDatabase

SESSION_S: Final = 12 * 3600.0
"""Life of a session of the web page, s: a shift and its hand-over."""
SUFFIX: Final = ".access"
"""Suffix of the file beside an SQLite database."""
_AUDIT_LOCK: Final = 0x6772_6964_6175_6400
_LENGTHS: Final = (64, 256, 256, 1024, 2000)
"""Largest lengths of identity, credential, action, target and detail of an audit entry, characters."""

_META = sa.MetaData()
_SCHEMA = sa.Table("access_version", _META, sa.Column("version", sa.Integer, primary_key=True))
_KEY = sa.Table(
    "access_key",
    _META,
    sa.Column("id", sa.String(16), primary_key=True),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("name", sa.String(64), nullable=False),
    sa.Column("role", sa.String(16), nullable=False),
    sa.Column("feeders", sa.Text),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("expires", sa.Double),
    sa.Column("revoked", sa.Double),
)
_SESSION = sa.Table(
    "access_session",
    _META,
    sa.Column("digest", sa.String(64), primary_key=True),
    sa.Column("key_id", sa.String(16), sa.ForeignKey("access_key.id"), nullable=False),
    sa.Column("expires", sa.Double, nullable=False),
)
_AUDIT = sa.Table(
    "audit",
    _META,
    sa.Column("seq", SEQ, primary_key=True, autoincrement=False),
    sa.Column("t", sa.Double, nullable=False),
    sa.Column("identity", sa.Text, nullable=False),
    sa.Column("credential", sa.Text, nullable=False),
    sa.Column("action", sa.Text, nullable=False),
    sa.Column("target", sa.Text, nullable=False),
    sa.Column("detail", sa.Text, nullable=False),
    sa.Column("previous", sa.String(64), nullable=False),
    sa.Column("hash", sa.String(64), nullable=False),
)


class AccessStore(SharedDatabase):
    """Keys, sessions and audit log of one service. Methods block and are thread-safe.

    database: address of the service's database.
    Raises StoreUnavailable if the database cannot be opened, or is newer than this program.
    """

    def __init__(self, database: str) -> None:
        super().__init__(database, SUFFIX, _META, _SCHEMA, lock=_AUDIT_LOCK)

    def __enter__(self) -> AccessStore:
        """Return the store."""
        return self

    # ------------------------------------------------------------------ keys

    def add_key(self, record: KeyRecord) -> None:
        """Store a key."""
        feeders = None if record.feeders is None else json.dumps(sorted(record.feeders))
        row = {
            "id": record.id,
            "digest": record.digest,
            "name": record.name,
            "role": str(record.role),
            "feeders": feeders,
            "created": record.created,
            "expires": record.expires,
            "revoked": record.revoked,
        }
        with self._write() as connection:
            connection.execute(_KEY.insert().values(row))

    def keys(self) -> list[KeyRecord]:
        """All keys, the oldest first."""
        with self._read() as connection:
            return [_record(row) for row in connection.execute(sa.select(_KEY).order_by(_KEY.c.created))]

    def key(self, key_id: str) -> KeyRecord | None:
        """Return a key by its id."""
        with self._read() as connection:
            row = connection.execute(sa.select(_KEY).where(_KEY.c.id == key_id)).one_or_none()
        return None if row is None else _record(row)

    def any_key(self) -> bool:
        """True if a key was ever added; a revoked or expired key does not open the service again."""
        with self._read() as connection:
            return bool(connection.scalar(sa.select(sa.exists().select_from(_KEY))))

    def revoke(self, key_id: str, now: float) -> bool:
        """Revoke a key, and with it its sessions; False if there is no such valid key.

        key_id: id of the key.
        now: Unix time, s.
        """
        with self._write() as connection:
            change = _KEY.update().where(_KEY.c.id == key_id, _KEY.c.revoked.is_(None)).values(revoked=now)
            return connection.execute(change).rowcount == 1

    # -------------------------------------------------------------- sessions

    def open_session(self, token: str, key_id: str, now: float) -> float:
        """Store a session of the web page, and return its end, Unix s.

        token: random text of the cookie; its SHA-256 is stored.
        key_id: key that the session stands for.
        now: Unix time, s.
        """
        with self._write() as connection:
            connection.execute(_SESSION.delete().where(_SESSION.c.expires <= now))
            row = {"digest": _digest(token), "key_id": key_id, "expires": now + SESSION_S}
            connection.execute(_SESSION.insert().values(row))
        return now + SESSION_S

    def session(self, token: str, now: float) -> KeyRecord | None:
        """Key of a session, or None if the session has ended.

        token: text of the cookie.
        now: Unix time, s.
        """
        query = sa.select(_KEY).join(_SESSION, _SESSION.c.key_id == _KEY.c.id)
        query = query.where(_SESSION.c.digest == _digest(token), _SESSION.c.expires > now)
        with self._read() as connection:
            row = connection.execute(query).one_or_none()
        return None if row is None else _record(row)

    def close_session(self, token: str) -> None:
        """End a session."""
        with self._write() as connection:
            connection.execute(_SESSION.delete().where(_SESSION.c.digest == _digest(token)))

    # ----------------------------------------------------------------- audit

    def append(  # noqa: PLR0917  # the columns of an entry
        self, t: float, identity: str, credential: str, action: str, target: str, detail: str = ""
    ) -> AuditEntry:
        """Append an entry to the audit log; durable when this returns.

        t, identity, credential, action, target, detail: as in `AuditEntry`.
        """
        given = (identity, credential, action, target, detail)
        with self._write() as connection:
            self._serialise(connection)
            texts = [printable(each, most) for each, most in zip(given, _LENGTHS, strict=True)]
            last = connection.execute(sa.select(_AUDIT).order_by(_AUDIT.c.seq.desc()).limit(1)).one_or_none()
            before = None if last is None else AuditEntry(*last)
            entry = chained(before, t, *texts)
            connection.execute(_AUDIT.insert().values(entry.to_json()))
        return entry

    def audit(self, *, after: int = 0, limit: int | None = None) -> list[AuditEntry]:
        """Return entries of the audit log, the oldest first.

        after: restrict to entries with a higher number.
        limit: largest number of entries; None for all.
        """
        query = sa.select(_AUDIT).where(_AUDIT.c.seq > after).order_by(_AUDIT.c.seq).limit(limit)
        with self._read() as connection:
            return [AuditEntry(*row) for row in connection.execute(query)]


def printable(text: str, most: int) -> str:
    """Text with escaped control, format and surrogate characters, cut to a length."""
    return "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text[:most])[: 2 * most]


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _record(row: Any) -> KeyRecord:
    feeders = None if row.feeders is None else frozenset(json.loads(row.feeders))
    return KeyRecord(
        row.id, row.digest, row.name, Role(row.role), feeders, row.created, row.expires, row.revoked
    )
