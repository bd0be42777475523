"""Backup of a database to a file while a service writes it, and restore into an empty database.

SQLite: the online backup API copies one consistent state by a read-only connection; in WAL mode commits
continue. `<database>.access` is copied to `FILE.access`, `<database>.notify` to `FILE.notify`. PostgreSQL:
`pg_dump` and `pg_restore`.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import psycopg
import sqlalchemy as sa

from feeders.util import replace_file
from service.store.connect import ADVISORY_LOCK, CALL_S
from service.store.schema import MIGRATIONS, VERSION, StoreUnavailable

ACCESS, NOTIFY = ".access", ".notify"
"""Suffixes of files beside an SQLite database and its backup: keys and audit log, notifications."""
NEWEST = 1 + len(MIGRATIONS)
"""Schema version of this program."""
_SQLITE, _PG_DUMP = b"SQLite format 3\x00", b"PGDMP"


@dataclass(frozen=True, slots=True)
class Copy:
    """A written file or database."""

    name: str
    size: int  # bytes
    version: int | None  # schema version; None of a file of keys


def parsed(url: str) -> sa.URL:
    """Return an address of SQLite or PostgreSQL; raises StoreUnavailable for any other."""
    try:
        found = sa.make_url(url)
    except sa.exc.ArgumentError as error:
        text = f"{url!r} is not a database address: {error}"
        raise StoreUnavailable(text, code="wrong-address") from error
    name, family = found.render_as_string(hide_password=True), found.get_backend_name()
    if family not in {"sqlite", "postgresql"}:
        text = f"{name}: only sqlite and postgresql are supported, not {family}"
        raise StoreUnavailable(text, code="unsupported")
    if family == "sqlite" and found.database in {None, "", ":memory:"}:
        raise StoreUnavailable(f"{name}: expected a file", code="in-memory")
    return found


def path_of(url: sa.URL) -> Path:
    """Return the file of an SQLite database."""
    return Path(os.path.realpath(url.database or ""))


def backup(url: str, file: Path) -> list[Copy]:
    """Write a backup; an incomplete one leaves an older file in its place.

    Raises StoreUnavailable if the database cannot be read, OSError if the file cannot be written.
    """
    source = parsed(url)
    if source.get_backend_name() == "postgresql":
        version = _version_of_server(source)
        replace_file(file, lambda new: _run("pg_dump", source, "--format=custom", f"--file={new}"))
        return [Copy(str(file), file.stat().st_size, version)]
    path = path_of(source)
    if not path.is_file():
        raise StoreUnavailable(f"cannot open {path}: there is no such file", code="open-failed")
    # Positions of notifications first: they are then not beyond the copied events.
    positions = _copied_beside(path, file, NOTIFY)
    return [_copied(path, file, schema_version), *positions, *_copied_beside(path, file, ACCESS)]


def _copied_beside(path: Path, file: Path, suffix: str) -> list[Copy]:
    """Copy the file beside a database, if there is one, to the file beside its backup."""
    source, target = path.with_name(path.name + suffix), file.with_name(file.name + suffix)
    if source.is_file():
        return [_copied(source, target, lambda _: None)]
    target.unlink(missing_ok=True)  # of an earlier backup: it does not belong to this one
    return []


def restore(url: str, file: Path) -> list[Copy]:
    """Restore a backup into a database that is empty or does not exist.

    Raises StoreUnavailable if the file is no backup of this kind of database, the database is not empty, or a
    service writes it.
    """
    target = parsed(url)
    with file.open("rb") as opened:
        start = opened.read(len(_SQLITE))
    expected = _SQLITE if target.get_backend_name() == "sqlite" else _PG_DUMP
    if not start.startswith(expected):
        text = f"{file} is not a backup of a {target.get_backend_name()} database"
        raise StoreUnavailable(text, code="not-a-backup")
    if expected is _PG_DUMP:
        return [_restored_server(target, file)]
    path = path_of(target)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _writer_lock(path):
        _refuse_content(path)
        for suffix in (ACCESS, NOTIFY):
            beside, copied = path.with_name(path.name + suffix), file.with_name(file.name + suffix)
            if copied.is_file() and beside.exists():
                raise StoreUnavailable(f"{beside} exists; move it away first", code="not-empty")
        with closing(_reader(file)) as source:
            version = schema_version(source)
        if version > NEWEST:
            text = f"{file} has schema version {version}; this program supports versions up to {NEWEST}"
            raise StoreUnavailable(text, code="newer-schema")
        # The keys first: a database without its keys would be open to the network.
        copies = [
            each
            for suffix in (ACCESS, NOTIFY)
            if file.with_name(file.name + suffix).is_file()
            for each in _copied_beside(file, path, suffix)
        ]
        return [_copied(file, path, schema_version), *copies]


def schema_version(connection: sqlite3.Connection) -> int:
    """Return the schema version of a database of the service; raises StoreUnavailable for any other."""
    try:
        row = connection.execute(f"SELECT version FROM {VERSION.name}").fetchone()  # noqa: S608 - a constant
        return int(row[0])
    except (sqlite3.Error, TypeError) as error:
        name = connection.execute("PRAGMA database_list").fetchone()[2]
        raise StoreUnavailable(f"{name} is not a database of gridsec", code="not-a-backup") from error


def _reader(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro", uri=True, timeout=CALL_S)


def _copied(source: Path, target: Path, version: Callable[[sqlite3.Connection], int | None]) -> Copy:
    found: list[int | None] = []
    try:
        replace_file(target, lambda new: found.append(_copy(source, new, version)))
    except sqlite3.Error as error:
        text = f"cannot copy {source} to {target}: {error}"
        raise StoreUnavailable(text, code="copy-failed") from error
    folder = os.open(os.path.realpath(target.parent), os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return Copy(str(target), target.stat().st_size, found[0])


def _copy(source: Path, new: Path, version: Callable[[sqlite3.Connection], int | None]) -> int | None:
    """Copy a database in one transaction, check the copy, and write it to the disk."""
    new.unlink(missing_ok=True)
    # Keys and alarms are not readable by other users; the mode of the original applies at least.
    new.touch(mode=0o600)
    with closing(_reader(source)) as read, closing(sqlite3.connect(new)) as write:
        found = version(read)
        read.backup(write)
        # A single file, without -wal and -shm beside it.
        write.execute("PRAGMA journal_mode = DELETE")
        (state,) = write.execute("PRAGMA quick_check(1)").fetchone()
    if state != "ok":
        raise StoreUnavailable(f"the copy of {source} is damaged: {state}", code="copy-failed")
    new.chmod(source.stat().st_mode & 0o777)
    with new.open("rb") as opened:
        os.fsync(opened.fileno())
    return found


@contextmanager
def _writer_lock(path: Path) -> Iterator[None]:
    """Hold the lock of the writer of an SQLite database."""
    with path.with_name(path.name + ".lock").open("ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = f"cannot restore {path}: another process writes it; stop the service first"
            raise StoreUnavailable(text, code="other-writer") from error
        yield


def _refuse_content(path: Path) -> None:
    """Refuse a database with content, and remains of one that would be applied to the restored file."""
    for each in (path, path.with_name(path.name + "-wal"), path.with_name(path.name + "-journal")):
        if each.exists() and each.stat().st_size:
            text = f"{each} is not empty; restore into a new file, or move it away first"
            raise StoreUnavailable(text, code="not-empty")


# ---------------------------------------------------------------- PostgreSQL


def _plain(url: sa.URL, *, password: bool) -> str:
    """Return an address for libpq."""
    changed = url.set(drivername="postgresql")
    return (changed if password else changed._replace(password=None)).render_as_string(hide_password=False)


def _run(tool: str, url: sa.URL, *arguments: str) -> None:
    """Run a tool of PostgreSQL; the password is not among its arguments, which other users can read."""
    found = shutil.which(tool)
    if found is None:
        text = f"{tool} is not installed; install PostgreSQL's client tools of the server's version or later"
        raise StoreUnavailable(text, code="no-tool")
    environment = os.environ | ({"PGPASSWORD": str(url.password)} if url.password else {})
    command = [found, "--no-owner", "--no-privileges", f"--dbname={_plain(url, password=False)}", *arguments]
    done = subprocess.run(  # noqa: S603 - a fixed tool, without a shell
        command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise StoreUnavailable(f"{tool}: {done.stderr.strip()}", code="tool-failed")


@contextmanager
def connected(url: sa.URL) -> Iterator[psycopg.Connection[tuple[object, ...]]]:
    """Connect to a server; raises StoreUnavailable for its errors."""
    name = url.render_as_string(hide_password=True)
    try:
        with psycopg.connect(
            _plain(url, password=True), connect_timeout=int(CALL_S), autocommit=True
        ) as connection:
            yield connection
    except psycopg.Error as error:
        text = f"cannot read {name}: {' '.join(str(error).split())}"
        raise StoreUnavailable(text, code="read-failed") from error


def server_version(connection: psycopg.Connection[tuple[object, ...]]) -> int | None:
    """Return the schema version of a database of the service; None without its tables."""
    row = connection.execute("SELECT to_regclass(%s)", (VERSION.name,)).fetchone()
    if row is None or row[0] is None:
        return None
    version = connection.execute(f"SELECT version FROM {VERSION.name}").fetchone()  # noqa: S608
    return None if version is None else int(str(version[0]))


def _version_of_server(url: sa.URL) -> int:
    with connected(url) as connection:
        version = server_version(connection)
    if version is None:
        name = url.render_as_string(hide_password=True)
        raise StoreUnavailable(f"{name} is not a database of gridsec", code="not-a-backup")
    return version


def _restored_server(url: sa.URL, file: Path) -> Copy:
    """Restore in one transaction, with the writer's lock held."""
    name = url.render_as_string(hide_password=True)
    with connected(url) as connection:
        row = connection.execute("SELECT pg_try_advisory_lock(%s)", (ADVISORY_LOCK,)).fetchone()
        if row is None or not row[0]:
            text = f"cannot restore {name}: another process writes it; stop the service first"
            raise StoreUnavailable(text, code="other-writer")
        tables = "SELECT count(*) FROM pg_tables WHERE schemaname = current_schema()"
        row = connection.execute(tables).fetchone()
        if row is None or row[0]:
            text = f"{name} is not empty; restore into a new database"
            raise StoreUnavailable(text, code="not-empty")
        _run("pg_restore", url, "--single-transaction", "--exit-on-error", str(file))
        version = server_version(connection)
    if version is None or version > NEWEST:
        text = f"{file} has schema version {version}; this program supports versions up to {NEWEST}"
        raise StoreUnavailable(text, code="newer-schema")
    return Copy(name, file.stat().st_size, version)
