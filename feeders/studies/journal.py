"""What a long study has done so far, in a file: interrupted at half, it goes on where it was.

JSON lines: first what is studied and with which versions, then one line for each piece of work that is done.
A line that was cut off while it was written is done again.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gridsec.errors import GridsecError

__all__ = ["Journal", "OtherStudy", "Progress", "versions", "worked"]

Progress = Callable[[int, int], None]
"""Told how many pieces of work are done, and of how many."""


class OtherStudy(GridsecError):
    """A journal belongs to another study, feeder, version or to other arguments, or is no journal."""


def versions() -> dict[str, str]:
    """Versions of everything that numbers depend on."""
    found = {name: version(name) for name in ("gridsec", "numpy", "scipy", "power-grid-model")}
    return {"python": platform.python_version(), **found}


class Journal:
    """Results by key; kept in memory, and in a file if there is one.

    Parameters
    ----------
    path
        The file; it is made if it does not exist. None: nothing is kept.
    subject
        What is studied, with every argument that changes a result.

    Raises
    ------
    OtherStudy
        If the file is about something else.
    """

    def __init__(self, path: Path | None, subject: Mapping[str, Any]) -> None:
        self._path = path
        self._done: dict[str, Any] = {}
        if path is None:
            return
        head = json.dumps({**subject, "versions": versions()}, sort_keys=True)
        if not path.exists() or not path.stat().st_size:
            path.write_text(head + "\n", encoding="utf-8")
            return
        lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
        if lines[0] != head:
            raise OtherStudy(f"{path}: {_other(lines[0], head)}")
        try:
            self._done = dict(json.loads(line) for line in lines[1:-1])
        except (ValueError, TypeError) as error:
            raise OtherStudy(f"{path}: a line is no result of a study: {error}") from error
        # What follows the last end of line was cut off: it goes, and so the next line begins a new one.
        if lines[-1] or len(lines) == 1:
            path.write_text("\n".join([*lines[:-1], ""] if len(lines) > 1 else [head, ""]), encoding="utf-8")

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
        """
        self._done[key] = value
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps([key, value]) + "\n")


def _other(found: str, expected: str) -> str:
    """In what a journal's first line is not the one expected."""
    try:
        theirs, ours = json.loads(found), json.loads(expected)
        if {**theirs, "versions": ours["versions"]} == ours:
            made = ", ".join(f"{name} {each}" for name, each in theirs.get("versions", {}).items())
            return f"written with other versions ({made or 'which, it does not say'}); begin a new journal"
    except (ValueError, TypeError, AttributeError):
        pass
    return f"not the journal of this study; it begins with {found[:200]!r}"


def worked(
    journal: Journal, tasks: Iterable[tuple[str, Callable[[], Any]]], progress: Progress | None
) -> dict[str, Any]:
    """Do pieces of work in order, and tell how far it is.

    Parameters
    ----------
    journal
        What is done already.
    tasks
        Key and work of each.
    progress
        Told before the first and after each.
    """
    todo = list(tasks)
    found: dict[str, Any] = {}
    for count, (key, work) in enumerate(todo):
        if progress is not None:
            progress(count, len(todo))
        found[key] = journal.get(key, work)
    if progress is not None:
        progress(len(todo), len(todo))
    return found
