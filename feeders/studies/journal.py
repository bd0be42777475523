"""Journal of a long study, in a file; an interrupted study resumes from it.

JSON lines: first the subject of the study and the versions of the program, then one line for each finished
piece of work. An incomplete last line is repeated. One process at a time writes a journal.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import entry_points, version
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self

from feeders.format.columns import GROUP
from feeders.util import plain
from gridsec.errors import GridsecError, Problem

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["InUse", "Journal", "Keeper", "OtherStudy", "Progress", "Where", "remove", "versions", "worked"]

Progress = Callable[[int, int], None]
"""Called with the number of finished pieces of work, and of all."""


class OtherStudy(GridsecError):
    """A journal of another study, feeder, version or other arguments, or not a journal."""

    code = "other-origin"


class InUse(GridsecError):
    """Another process writes the journal."""

    code = "in-use"


class Keeper(Protocol):
    """Owner of the journals of several studies."""

    def file(self, study: str, digest: str) -> Path | None:
        """Path of the journal of a study; None: no file."""

    def opened(self, journal: Journal) -> None:
        """A journal is open: its `path`, the number `done`, and the total."""

    def refused(self, path: Path, why: OSError | OtherStudy | InUse) -> bool:
        """A journal cannot be used (any more). True: try again; False: continue without it; or raise."""


Where = Path | str | Keeper | None
"""Journal file, or owner of journals; None: no file."""


def versions() -> dict[str, str]:
    """Versions of all libraries that numbers depend on."""
    names = ("gridsec", "numpy", "scipy", "power-grid-model", "cvxpy", "clarabel")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


@cache
def edition() -> str:
    """Digest of the code, external estimators included: it may change without a new version."""
    content = hashlib.sha256()
    for name in sorted(
        {"gridsec", "feeders"} | {point.module.split(".")[0] for point in entry_points(group=GROUP)}
    ):
        content.update(name.encode() + b"\0")
        for path in _sources(name):
            content.update(path.name.encode() + b"\0" + path.read_bytes())
    return content.hexdigest()[:16]


def _sources(name: str) -> list[Path]:
    """Files of a package or module, without running it."""
    found = find_spec(name)
    if found is None:
        return []
    if found.submodule_search_locations is None:
        return [Path(found.origin)] if found.origin and Path(found.origin).is_file() else []
    return sorted(path for root in found.submodule_search_locations for path in Path(root).rglob("*.py"))


class Journal:
    """Results by key, in memory and optionally in a file. Close it, for example by `with`.

    Parameters
    ----------
    where
        The file, created if it does not exist; or the owner of journals. None: no file.
    subject
        Subject of the study, with every argument that changes a result; `study` is its name.
    of
        Number of pieces of work, if known.

    Attributes
    ----------
    path
        The file; None without one.
    of
        As above.

    Raises
    ------
    OtherStudy
        If the file is that of another study.
    InUse
        If another process writes it.
    OSError
        If it cannot be written.
    """

    def __init__(self, where: Where, subject: Mapping[str, Any], *, of: int | None = None) -> None:
        self._handle: int | None = None
        self.path: Path | None = None
        self.of = of
        self._done: dict[str, Any] = {}
        where = Path(where) if isinstance(where, str) else where
        self._keeper = None if isinstance(where, Path) else where
        told = {**subject, "versions": versions(), "edition": edition()}
        head = json.dumps(plain(told), sort_keys=True)
        digest = hashlib.sha256(head.encode()).hexdigest()[:16]
        path = where if isinstance(where, Path) or where is None else where.file(subject["study"], digest)
        trying = path is not None
        while trying and path is not None:
            try:
                self._handle, self._done = _opened(path, head)
            except (OSError, OtherStudy, InUse) as error:
                trying = self._again(path, error)
            else:
                self.path, trying = path, False
        if self._keeper is not None:
            self._keeper.opened(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the file for other processes; results stay in memory."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def __del__(self) -> None:
        self.close()

    @property
    def done(self) -> int:
        """Number of finished pieces of work."""
        return len(self._done)

    def __contains__(self, key: str) -> bool:
        return key in self._done

    def __getitem__(self, key: str) -> Any:
        return self._done[key]

    def get(self, key: str, work: Callable[[], Any]) -> Any:
        """Result of a piece of work, computed now if it is not in the journal.

        Parameters
        ----------
        key
            Key of the piece, unique in this study.
        work
            Computes the result, in plain JSON types.
        """
        if key not in self._done:
            self.put(key, work())
        return self._done[key]

    def put(self, key: str, value: Any) -> None:
        """Store the result of a piece of work.

        Parameters
        ----------
        key, value
            Key of the piece, and its result, in plain JSON types.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        self._done[key] = value
        if self._handle is None or self.path is None:
            return
        try:
            _write(self._handle, json.dumps([key, value]))
        except OSError as error:
            path = self.path
            self.close()
            self.path = None
            self._again(path, error)

    def _again(self, path: Path, error: OSError | OtherStudy | InUse) -> bool:
        """Retry by the owner's decision; without an owner the error is raised."""
        if self._keeper is None:
            raise error
        return self._keeper.refused(path, error)


# Lock position far beyond the end: on Windows a locked range cannot be read by other processes.
_FAR: Final = 1 << 40


def _opened(path: Path, head: str) -> tuple[int, dict[str, Any]]:
    """Open a journal for this process alone, and read it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o666)
        try:
            _lock(handle, path)
            # The previous process may have finished and removed the file.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), path.stat()):
                    return handle, _read(handle, path, head)
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _lock(handle: int, path: Path) -> None:
    """Lock the file until it is closed, also by the end of this process."""
    try:
        if sys.platform == "win32":
            os.lseek(handle, _FAR, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError) as error:
        raise InUse(f"{path}: another command is writing this journal") from error
    except OSError:
        return  # a file system without locks


def _read(handle: int, path: Path, head: str) -> dict[str, Any]:
    """Content of a journal; an empty one, or one with an incomplete first line, is initialised."""
    with open(handle, "rb", closefd=False) as file:
        file.seek(0)
        content = file.read()
    lines = content.split(b"\n")
    if len(lines) == 1 and head.encode().startswith(content):
        os.ftruncate(handle, 0)
        _write(handle, head)
        return {}
    if lines[0] != head.encode():
        why = _other(lines[0].decode(errors="replace"), head)
        raise OtherStudy(f"{path}: {why}", code=why.code)
    try:
        done = dict(json.loads(line) for line in lines[1:-1])
    except (ValueError, TypeError) as error:
        raise OtherStudy(f"{path}: a line is not a result of a study: {error}") from error
    # An incomplete line after the last line end is removed, so that the next line begins a new one.
    if lines[-1]:
        os.ftruncate(handle, len(content) - len(lines[-1]))
    return done


def _write(handle: int, line: str) -> None:
    with open(handle, "ab", closefd=False) as file:
        file.write(line.encode() + b"\n")


def remove(path: Path) -> None:
    """Remove a journal, unless another process writes it or the removal fails."""
    with suppress(InUse, OSError):
        handle = os.open(path, os.O_RDWR)
        try:
            _lock(handle, path)
            path.unlink()
        finally:
            os.close(handle)


def _other(found: str, expected: str) -> Problem:
    """Difference between a journal's first line and the expected one."""
    try:
        theirs, ours = json.loads(found), json.loads(expected)
        same = {key: ours[key] for key in ("versions", "edition")}
        if {**theirs, **same} == ours:
            if theirs.get("versions") == ours["versions"]:
                return Problem(
                    "other-version", "written before this program was changed; begin a new journal"
                )
            made = ", ".join(f"{name} {each}" for name, each in theirs.get("versions", {}).items())
            made = made or "unknown"
            return Problem("other-version", f"written with other versions ({made}); begin a new journal")
    except (ValueError, TypeError, AttributeError):
        pass
    return Problem("other-origin", f"not the journal of this study; it begins with {found[:200]!r}")


def worked(
    where: Where,
    subject: Mapping[str, Any],
    tasks: Iterable[tuple[str, Callable[[], Any]]],
    progress: Progress | None,
) -> dict[str, Any]:
    """Do pieces of work in order, and report progress.

    Parameters
    ----------
    where, subject
        As in `Journal`.
    tasks
        Key and function of each piece.
    progress
        Called before the first piece and after each.

    Raises
    ------
    OtherStudy, InUse, OSError
        As `Journal`.
    """
    todo = dict(tasks)
    with Journal(where, subject, of=len(todo)) as journal:
        done = sum(key in journal for key in todo)
        if progress is not None:
            progress(done, len(todo))
        for key in (key for key in todo if key not in journal):
            journal.put(key, todo[key]())
            done += 1
            if progress is not None:
                progress(done, len(todo))
        return {key: journal[key] for key in todo}
