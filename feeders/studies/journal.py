"""Journal of a long study: a table of its finished pieces of work in an SQLite file, from which it resumes.

Every piece is a transaction of its own. One process at a time has the file, by SQLite's exclusive lock, which
ends with the process.
"""

from __future__ import annotations

import errno
import hashlib
import json
import platform
import sqlite3
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import cache
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Any, Protocol, Self

from feeders.format.columns import GROUP
from feeders.util import plain
from gridsec.errors import GridsecError

__all__ = [
    "InUse",
    "Journal",
    "Keeper",
    "OtherStudy",
    "Progress",
    "Where",
    "remove",
    "run_pieces",
    "versions",
    "worked",
]

Progress = Callable[[int, int], None]
"""Called with the number of finished pieces of work, and of all."""


class OtherStudy(GridsecError):
    """A journal of another study, feeder, version or other arguments, or not a journal."""

    code = "other-origin"


class InUse(GridsecError):
    """Another process has the journal."""

    code = "in-use"


class Keeper:
    """Owner of the journals of several studies; by itself of one file, or of none."""

    def __init__(self, path: Path | str | None) -> None:
        self._path = None if path is None else Path(path)

    def file(self, study: str, digest: str) -> Path | None:  # noqa: ARG002  # one file for all
        """Path of the journal of a study; None: no file."""
        return self._path

    def opened(self, journal: Journal) -> None:
        """A journal is open: its `path`, the number `done`, and the total."""

    def refused(self, path: Path, why: OSError | OtherStudy | InUse) -> bool:  # noqa: ARG002  # for others
        """A journal cannot be used (any more). True: try again; False: continue without it; or raise."""
        raise why


Work = Callable[[int], Any]
"""Result of a piece of work by its number, in plain JSON types."""

Made = Generator[tuple[int, Any], None, None]


class Runner(Protocol):
    """Runner of pieces of work."""

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """Work on all pieces; yield each with its result when finished."""


Where = Path | str | Keeper | None
"""Journal file, or owner of journals; None: no file."""


@cache
def versions() -> dict[str, str]:
    """Versions of all libraries that numbers depend on, packages with estimators included."""
    names = ["gridsec", "numpy", "scipy", "power-grid-model", "cvxpy", "clarabel"]
    names += sorted({point.dist.name for point in entry_points(group=GROUP) if point.dist} - {*names})
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


class Journal:
    """Results by key, in memory and optionally in a file. Close it, for example by `with`.

    `subject` holds the name of the `study` and every argument that changes a result; `of` is the number of
    pieces of work, if known. `path` is the file, created if it does not exist; None without one.

    Raises OtherStudy if the file is that of another study; InUse if another process has it; OSError if it
        cannot be written.
    """

    def __init__(self, where: Where, subject: Mapping[str, Any], *, of: int | None = None) -> None:
        self.path: Path | None = None
        self.of = of
        self._database: sqlite3.Connection | None = None
        self._done: dict[str, Any] = {}
        self._keeper = where if isinstance(where, Keeper) else Keeper(where)
        head = json.dumps(plain({**subject, "versions": versions()}), sort_keys=True)
        digest = hashlib.sha256(head.encode()).hexdigest()[:16]
        path = self._keeper.file(subject["study"], digest)
        while path is not None and self.path is None:
            try:
                self._database, self._done = _opened(path, head)
                self.path = path
            except (OSError, OtherStudy, InUse) as error:
                if not self._keeper.refused(path, error):
                    break
        self._keeper.opened(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the file for other processes; results stay in memory."""
        if self._database is not None:
            self._database.close()
            self._database = None

    @property
    def done(self) -> int:
        """Number of finished pieces of work."""
        return len(self._done)

    def __contains__(self, key: str) -> bool:
        return key in self._done

    def __getitem__(self, key: str) -> Any:
        return self._done[key]

    def get(self, key: str, work: Callable[[], Any]) -> Any:
        """Result of a piece of work in plain JSON types, computed now if it is not in the journal."""
        if key not in self._done:
            self.put(key, work())
        return self._done[key]

    def put(self, key: str, value: Any) -> None:
        """Store the result of a piece of work, in plain JSON types.

        Raises OSError if it cannot be written.
        """
        self._done[key] = value
        if self._database is None or self.path is None:
            return
        path = self.path
        try:
            with _errors_of(path):
                self._database.execute("INSERT INTO journal VALUES (?, ?)", (key, json.dumps(value)))
        except OSError as error:
            self.close()
            self.path = None
            self._keeper.refused(path, error)


def _opened(path: Path, head: str) -> tuple[sqlite3.Connection, dict[str, Any]]:
    """Open a journal for this process alone, and read it; an empty file becomes the journal of this study."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with _errors_of(path):
        database = sqlite3.connect(path, timeout=0.0, isolation_level=None)
        try:
            _lock(database)
            if database.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,):
                database.execute("CREATE TABLE study (subject TEXT NOT NULL)")
                database.execute("CREATE TABLE journal (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
                database.execute("INSERT INTO study VALUES (?)", (head,))
            ((subject,),) = database.execute("SELECT subject FROM study").fetchall()
            _compare(path, subject, head)
            rows = database.execute("SELECT key, value FROM journal").fetchall()
            database.execute("COMMIT")
            return database, {key: json.loads(value) for key, value in rows}
        except BaseException:
            database.close()
            raise


def _lock(database: sqlite3.Connection) -> None:
    """Begin a transaction, and exclude other processes until the connection or the process ends."""
    database.execute("PRAGMA locking_mode = EXCLUSIVE")
    database.execute("BEGIN EXCLUSIVE")


@contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    """Raise SQLite's errors as those of a journal."""
    try:
        yield
    except sqlite3.Error as error:
        if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
            raise InUse(f"{path}: another command is writing this journal") from error
        if error.sqlite_errorcode in (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT):
            raise OtherStudy(f"{path}: not the journal of this study; {error}") from error
        raise OSError(errno.EIO, str(error), str(path)) from error


def _compare(path: Path, found: str, expected: str) -> None:
    """Refuse the journal of another subject, or of other versions."""
    if found == expected:
        return
    with suppress(ValueError, AttributeError):
        theirs, ours = json.loads(found), json.loads(expected)
        if {**theirs, "versions": ours["versions"]} == ours:
            made = ", ".join(f"{name} {each}" for name, each in theirs["versions"].items())
            raise OtherStudy(
                f"{path}: written with other versions ({made}); begin a new journal", code="other-version"
            )
    raise OtherStudy(f"{path}: not the journal of this study; it begins with {found[:200]!r}")


def remove(path: Path) -> None:
    """Remove a journal, unless another process has it or the removal fails."""
    with suppress(InUse, OtherStudy, OSError), _errors_of(path):
        with closing(
            sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=0.0)
        ) as database:
            _lock(database)
            path.unlink()
        Path(f"{path}-journal").unlink(missing_ok=True)


def worked(
    where: Where,
    subject: Mapping[str, Any],
    tasks: Iterable[tuple[str, Callable[[], Any]]],
    progress: Progress | None,
) -> dict[str, Any]:
    """Do pieces of work, given by key and function, in order in this process; as `run_pieces`."""
    todo = dict(tasks)
    calls = list(todo.values())
    found = run_pieces(where, subject, list(todo), lambda piece: calls[piece](), progress=progress)
    return dict(zip(todo, found, strict=True))


def run_pieces(
    where: Where,
    subject: Mapping[str, Any],
    keys: Sequence[str],
    work: Work,
    *,
    runner: Runner | None = None,
    progress: Progress | None = None,
) -> list[Any]:
    """Do the pieces of work that the journal lacks, and return the results of all in the order of the keys.

    `runner` calls `work`, by default in this process in order. `progress` is called before the first piece
    and after each.

    Raises OtherStudy, InUse, OSError as `Journal`; ClusterUnusable, WorkerLost from the runner; finished
        pieces are in the journal.
    """
    report_progress = progress or (lambda *_: None)
    with Journal(where, subject, of=len(keys)) as journal:
        todo = [piece for piece, key in enumerate(keys) if key not in journal]
        done = len(keys) - len(todo)
        report_progress(done, len(keys))
        made = runner.run(work, todo) if runner else ((piece, work(piece)) for piece in todo)
        with closing(made) as results:
            for piece, result in results:
                journal.put(keys[piece], result)
                done += 1
                report_progress(done, len(keys))
        return [journal[key] for key in keys]
