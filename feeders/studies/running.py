"""Running of a long study: journal of its finished pieces of work, and runners of the pieces.

The journal is a table in an SQLite file, from which the study resumes. Every piece is a transaction of its
own. One process at a time has the file, by SQLite's exclusive lock, which ends with the process.

A runner is this process, processes of this machine, or a Dask cluster. It has a function and numbers, and
yields each number with its result, in any order. When a worker dies, its pieces are repeated, RETRIES times
at most.
"""

from __future__ import annotations

import errno
import hashlib
import json
import multiprocessing
import os
import platform
import sqlite3
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points, version
from pathlib import Path
from threading import Thread
from typing import Any, Final, Protocol, Self

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # has no stubs

from feeders.format.columns import GROUP
from feeders.util import extra, plain
from gridsec.errors import GridsecError
from gridsec.processes import deaf, listen, stop

__all__ = [
    "ClusterUnusable",
    "Dask",
    "Here",
    "InUse",
    "Journal",
    "Keeper",
    "OtherStudy",
    "Processes",
    "Progress",
    "Runner",
    "Where",
    "WorkerLost",
    "agree",
    "cores",
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


# --- Runners ---


RETRIES: Final = 3  # largest number of repetitions of a piece after the death of its worker


class WorkerLost(GridsecError):
    """The workers of a piece died repeatedly."""

    code = "worker-lost"


class ClusterUnusable(GridsecError):
    """No usable Dask cluster."""

    code = "cluster-unusable"


@dataclass(frozen=True, slots=True)
class Here:
    """One piece after the other, in this process."""

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`."""
        for piece in pieces:
            # Several threads sum in another order, with other last bits.
            with threadpool_limits(limits=1):
                made = work(piece)
            yield piece, made


@dataclass(frozen=True, slots=True)
class Processes:
    """Processes of this machine, spawned rather than forked: equal on every system."""

    count: int  # number of processes
    retries: int = RETRIES  # repetitions of a piece after the death of its process

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`.

        Raises WorkerLost if the processes of a piece died repeatedly.
        """
        waiting, lost = deque(pieces), Counter[int]()
        while waiting:
            died = yield from self._until_one_dies(work, waiting)
            lost.update(died)
            for piece in died:
                if lost[piece] > self.retries:
                    raise WorkerLost(f"the processes that worked on piece {piece} died {lost[piece]} times")
            waiting.extendleft(reversed(died))

    def _until_one_dies(self, work: Work, waiting: deque[int]) -> Generator[tuple[int, Any], None, list[int]]:
        """Work until all pieces are finished, or a process has died; returns the unfinished pieces."""
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(min(self.count, len(waiting)), context, initializer=_begin)
        running: dict[Future[Any], int] = {}
        try:
            while waiting or running:
                # Pieces in work, and one more for each process: little is lost with a process.
                while waiting and len(running) < 2 * self.count:
                    with deaf():
                        running[pool.submit(_single, work, waiting[0])] = waiting[0]
                    waiting.popleft()
                done = wait(running, return_when=FIRST_COMPLETED).done
                for future in done:
                    if not isinstance(future.exception(), BrokenProcessPool):
                        yield running.pop(future), future.result()
                if any(future in running for future in done):
                    break
        except BrokenProcessPool:
            pass  # during a submission; the piece is still waiting
        finally:
            stop(pool)
        return sorted(running.values())


def cores(count: int | None = None) -> Runner:
    """`count` processes of this machine, by default one for each core; this process if there is one core."""
    count = count or os.cpu_count() or 1
    return Processes(count) if count > 1 else Here()


def _begin() -> None:
    """Prepare a process: it ignores interruptions, and ends with the first process."""
    listen()
    Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End with the parent process, even after its forced end."""
    first = multiprocessing.parent_process()
    if first is not None:
        first.join()
        os._exit(1)


def _single(work: Work, piece: int) -> Any:
    """Work on a piece in a separate process, with one thread; all libraries are loaded by now."""
    threadpool_limits(limits=1)
    return work(piece)


@dataclass(frozen=True, slots=True)
class Dask:
    """Dask cluster; requires the extra `cluster`, and gridsec on its workers.

    The scheduler repeats the pieces of a dead worker, up to `distributed.scheduler.allowed-failures` times
    (3).
    """

    address: str  # of the scheduler, such as tcp://10.0.0.1:8786
    timeout_s: float = 10.0  # longest wait for its answer

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`.

        Raises ClusterUnusable without `distributed`, a scheduler at the address, or workers, or for workers
            with other versions of the libraries that numbers depend on; WorkerLost if the workers of a piece
            died repeatedly.
        """
        try:
            dask: Any = import_module("distributed")
        except ImportError as error:
            raise ClusterUnusable(f"a Dask cluster needs {extra('cluster')}", code="not-installed") from error
        try:
            client = dask.Client(self.address, timeout=self.timeout_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ClusterUnusable(f"no Dask scheduler answers at {self.address}: {error}") from error
        with client:
            self._check(client)
            waiting, running = deque(pieces), dict[Any, int]()
            done = dask.as_completed(loop=client.loop)

            def hand_out() -> None:
                # Each piece contains the feeder: the scheduler has a few per worker, and at least one, which
                # waits for a worker if there is none.
                while waiting and len(running) < max(4 * sum(client.nthreads().values()), 1):
                    future = client.submit(_one, work, waiting[0], pure=False)
                    running[future] = waiting.popleft()
                    done.add(future)

            try:
                hand_out()
                for future in done:
                    theirs, made = future.result()
                    agree("a worker", theirs)
                    yield running.pop(future), made
                    hand_out()
            except dask.KilledWorker as error:
                raise WorkerLost(str(error)) from error
            finally:
                client.cancel(list(running))

    def _check(self, client: Any) -> None:
        """Check that there are workers with equal versions; later ones are checked with their results."""
        try:
            client.wait_for_workers(1, timeout=self.timeout_s)
        except TimeoutError as error:
            raise ClusterUnusable(f"the Dask cluster at {self.address} has no workers") from error
        for worker, theirs in client.run(versions, on_error="return").items():
            agree(worker, theirs)


def agree(worker: str, theirs: Any) -> None:
    """Reject a worker with other versions than those of this process, or with an error in their place.

    Raises ClusterUnusable for other versions.
    """
    mine = versions()
    if theirs != mine:
        raise ClusterUnusable(f"the versions of Dask worker {worker} are {theirs!r}, not {mine!r}")


def _one(work: Work, piece: int) -> tuple[dict[str, str], Any]:
    """Work on a piece in an external worker."""
    return versions(), _single(work, piece)
