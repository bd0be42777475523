"""What a long study has done so far, in a file: interrupted at half, it goes on where it was.

JSON lines: first what is studied and with which program, then one line for each piece of work that is done.
A line that was cut off while it was written is done again. One process at a time writes a journal.
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

from feeders.registry.plugins import GROUP
from feeders.util import plain
from gridsec.errors import GridsecError, Problem

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["InUse", "Journal", "Keeper", "OtherStudy", "Progress", "Where", "remove", "versions", "worked"]

Progress = Callable[[int, int], None]
"""Told how many pieces of work are done, and of how many."""


class OtherStudy(GridsecError):
    """A journal belongs to another study, feeder, version or to other arguments, or is no journal."""

    code = "other-origin"


class InUse(GridsecError):
    """Another process is writing a journal."""

    code = "in-use"


class Keeper(Protocol):
    """Who has journals for several studies, and looks after them."""

    def file(self, study: str, digest: str) -> Path | None:
        """Where the journal of a study is, or is to be; None: nothing is kept."""

    def opened(self, journal: Journal) -> None:
        """A journal is open: its `path`, what is `done` of it, and of how much."""

    def refused(self, path: Path, why: OSError | OtherStudy | InUse) -> bool:
        """It cannot be used, or no more. True: try again; False: go on without it; or raise."""


Where = Path | str | Keeper | None
"""A journal's file, or who has one; None: nothing is kept."""


def versions() -> dict[str, str]:
    """Versions of everything that numbers depend on."""
    names = ("gridsec", "numpy", "scipy", "power-grid-model", "cvxpy", "clarabel")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


@cache
def edition() -> str:
    """Digest of the code, others' estimators included: it may be edited while its version stays the same."""
    content = hashlib.sha256()
    for name in sorted(
        {"gridsec", "feeders"} | {point.module.split(".")[0] for point in entry_points(group=GROUP)}
    ):
        content.update(name.encode() + b"\0")
        for path in _sources(name):
            content.update(path.name.encode() + b"\0" + path.read_bytes())
    return content.hexdigest()[:16]


def _sources(name: str) -> list[Path]:
    """The files of a package or module, without running it."""
    found = find_spec(name)
    if found is None:
        return []
    if found.submodule_search_locations is None:
        return [Path(found.origin)] if found.origin and Path(found.origin).is_file() else []
    return sorted(path for root in found.submodule_search_locations for path in Path(root).rglob("*.py"))


class Journal:
    """Results by key; kept in memory, and in a file if there is one. To be closed, as by `with`.

    Parameters
    ----------
    where
        The file, which is made if it does not exist; or who has one. None: nothing is kept.
    subject
        What is studied, with every argument that changes a result; `study` is its name.
    of
        How many pieces of work there are, if that is known.

    Attributes
    ----------
    path
        The file; None: there is none.
    of
        As above.

    Raises
    ------
    OtherStudy
        If the file is about something else.
    InUse
        If another process is writing it.
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
        """Let others write the file; what is done stays known."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def __del__(self) -> None:
        self.close()

    @property
    def done(self) -> int:
        """How many pieces of work are done."""
        return len(self._done)

    def __contains__(self, key: str) -> bool:
        return key in self._done

    def __getitem__(self, key: str) -> Any:
        return self._done[key]

    def get(self, key: str, work: Callable[[], Any]) -> Any:
        """Return the result of a piece of work, which is done now if it was not before.

        Parameters
        ----------
        key
            Its name, of this study's.
        work
            Makes it; its result survives JSON.
        """
        if key not in self._done:
            self.put(key, work())
        return self._done[key]

    def put(self, key: str, value: Any) -> None:
        """Keep the result of a piece of work that was done elsewhere.

        Parameters
        ----------
        key, value
            Its name, and its result, which survives JSON.

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
        """Ask whose journal it is whether to try again; nobody's is an error."""
        if self._keeper is None:
            raise error
        return self._keeper.refused(path, error)


# A place far beyond the end, which stands for the file: what is locked on Windows nobody else can read.
_FAR: Final = 1 << 40


def _opened(path: Path, head: str) -> tuple[int, dict[str, Any]]:
    """Open a journal for this process alone, and read it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o666)
        try:
            _lock(handle, path)
            # Who had it until now may have come to an end, and removed it.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), path.stat()):
                    return handle, _read(handle, path, head)
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _lock(handle: int, path: Path) -> None:
    """Keep others out until the file is closed, be it by the death of this process."""
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
    """What is in a journal; one that is empty, or was interrupted in its first line, is begun."""
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
        raise OtherStudy(f"{path}: a line is no result of a study: {error}") from error
    # What follows the last end of line was cut off: it goes, and so the next line begins a new one.
    if lines[-1]:
        os.ftruncate(handle, len(content) - len(lines[-1]))
    return done


def _write(handle: int, line: str) -> None:
    with open(handle, "ab", closefd=False) as file:
        file.write(line.encode() + b"\n")


def remove(path: Path) -> None:
    """Remove a journal, unless somebody is writing it or it cannot be.

    Parameters
    ----------
    path
        The file.
    """
    with suppress(InUse, OSError):
        handle = os.open(path, os.O_RDWR)
        try:
            _lock(handle, path)
            path.unlink()
        finally:
            os.close(handle)


def _other(found: str, expected: str) -> Problem:
    """In what a journal's first line is not the one expected."""
    try:
        theirs, ours = json.loads(found), json.loads(expected)
        same = {key: ours[key] for key in ("versions", "edition")}
        if {**theirs, **same} == ours:
            if theirs.get("versions") == ours["versions"]:
                return Problem(
                    "other-version", "written before this program was changed; begin a new journal"
                )
            made = ", ".join(f"{name} {each}" for name, each in theirs.get("versions", {}).items())
            made = made or "which, it does not say"
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
    """Do pieces of work in order, and tell how far it is.

    Parameters
    ----------
    where, subject
        As in `Journal`.
    tasks
        Key and work of each.
    progress
        Told before the first and after each.

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
