"""State of a database for `gridsec doctor`: read without changing it, beside a running service."""

from __future__ import annotations

import fcntl
import os
import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import sqlalchemy as sa

from service.store.backup import NEWEST, connected, parsed, path_of, schema_version, server_version
from service.store.connect import CALL_S
from service.store.schema import EVENT, FEEDER, HISTORY, StoreUnavailable

OLDEST_SERVER = 140000
"""Oldest version of PostgreSQL with `idle_session_timeout`."""


@dataclass(frozen=True, slots=True)
class DatabaseState:
    """State of a database."""

    name: str
    version: int | None  # schema version; None of a database that does not exist yet
    newest: float | None = None  # newest tick or event, Unix s
    size: int = 0  # bytes
    free: int | None = None  # free bytes of the file system; None of a server
    running: bool = False  # a service holds the writer's lock
    read_only: str | None = None  # reason why the service cannot write
    feeders: Mapping[str, str] = field(default_factory=dict)  # JSON of the tables of feeders put over REST


def inspect(url: str) -> DatabaseState:
    """Read the state of a database; raises StoreUnavailable if it cannot be read, or is newer."""
    address = parsed(url)
    state = _file(path_of(address)) if address.get_backend_name() == "sqlite" else _server(address)
    if state.version is not None and state.version > NEWEST:
        text = (
            f"{state.name} has schema version {state.version}; this program supports versions up to {NEWEST}"
        )
        raise StoreUnavailable(text, code="newer-schema")
    return state


def _file(path: Path) -> DatabaseState:
    folder = next(each for each in path.parents if each.exists())
    free = shutil.disk_usage(folder).free
    locked = [] if os.access(folder, os.W_OK) else [f"the folder {folder} cannot be written"]
    if path.parent != folder:
        locked.append(f"the folder {path.parent} does not exist")
    beside = [path.with_name(path.name + suffix) for suffix in ("", "-wal", "-shm", ".lock")]
    locked += [
        f"{each} cannot be written" for each in beside if each.exists() and not os.access(each, os.W_OK)
    ]
    version, newest, size, feeders = None, None, 0, dict[str, str]()
    if path.exists() and path.stat().st_size:
        size = sum(each.stat().st_size for each in beside[:2] if each.exists())
        try:
            made = sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True, timeout=CALL_S)
            with closing(made) as connection:
                version = schema_version(connection)
                newest = connection.execute(_NEWEST).fetchone()[0]
                feeders = dict(connection.execute(_FEEDERS).fetchall())
        except sqlite3.Error as error:
            raise StoreUnavailable(f"cannot read {path}: {error}", code="read-failed") from error
    reasons = "; ".join(locked) or None
    return DatabaseState(str(path), version, newest, size, free, _locked(beside[3]), reasons, feeders)


_NEWEST = (
    f"SELECT max(t) FROM (SELECT max(t) AS t FROM {HISTORY.name} "  # noqa: S608 - constants
    f"UNION ALL SELECT max(t) FROM {EVENT.name}) AS times"
)
_FEEDERS = f"SELECT name, tables FROM {FEEDER.name} ORDER BY name"  # noqa: S608 - a constant


def _locked(lock: Path) -> bool:
    """True if another process holds the writer's lock."""
    if not lock.exists() or not os.access(lock, os.R_OK):
        return False
    with lock.open("rb") as opened:
        try:
            fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _server(url: sa.URL) -> DatabaseState:
    name = url.render_as_string(hide_password=True)
    with connected(url) as connection:
        version = server_version(connection)
        locks = "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND database = "
        locks += "(SELECT oid FROM pg_database WHERE datname = current_database())"
        query = "SELECT current_setting('server_version_num')::int, pg_database_size(current_database()), "
        query += "pg_is_in_recovery(), has_schema_privilege(current_schema(), 'CREATE'), "
        row = connection.execute(f"{query}({locks}) > 0").fetchone()
        newest = None if version is None else connection.execute(_NEWEST).fetchone()
        stored = [] if version is None else connection.execute(_FEEDERS).fetchall()
    server, size, replica, may_create, running = row or (0, 0, False, False, False)
    problems = []
    if int(str(server)) < OLDEST_SERVER:
        problems.append("the server is older than PostgreSQL 14")
    if replica:
        problems.append("the server is a replica; give the address of the primary one")
    if not may_create:
        problems.append("the user may not create tables; GRANT CREATE ON SCHEMA public")
    when = None if not newest or newest[0] is None else float(str(newest[0]))
    reasons, feeders = "; ".join(problems) or None, {str(row[0]): str(row[1]) for row in stored}
    return DatabaseState(name, version, when, int(str(size)), None, bool(running), reasons, feeders)
