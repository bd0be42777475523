"""Secret of a cluster: random, made once in its PostgreSQL database, known to the processes that read it."""

from __future__ import annotations

import secrets
from typing import Final

import sqlalchemy as sa

from service.store.shared import SharedDatabase

BYTES: Final = 32
"""Length of the secret, bytes."""
_LOCK: Final = 0x6772_6964_7365_6372
_META = sa.MetaData()
_VERSION = sa.Table("cluster_version", _META, sa.Column("version", sa.Integer, primary_key=True))
_SECRET = sa.Table(
    "cluster_secret",
    _META,
    sa.Column("id", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("secret", sa.LargeBinary, nullable=False),
)


class _SecretDatabase(SharedDatabase):
    def __init__(self, database: str) -> None:
        super().__init__(database, ".cluster", _META, _VERSION, lock=_LOCK)

    def secret(self) -> bytes:
        with self._write() as connection:
            self._serialise(connection)
            found = connection.scalar(sa.select(_SECRET.c.secret))
            if found is None:
                found = secrets.token_bytes(BYTES)
                connection.execute(_SECRET.insert().values(id=1, secret=found))
            return bytes(found)


def cluster_secret(database: str) -> bytes:
    """Return the secret of the cluster of a database; the first call makes it.

    Raises StoreUnavailable if the database cannot be used.
    """
    made = _SecretDatabase(database)
    try:
        return made.secret()
    finally:
        made.close()
