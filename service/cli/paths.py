"""Input and output paths of commands, and tables of studies as files."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Final

from feeders.format.reader import META_FILE
from feeders.util import replace_file
from gridsec.errors import GridsecError, InputInvalid, Problem

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["A_FEEDER", "Unusable", "is_feeder", "see", "write_tables"]


A_FEEDER: Final = "a feeder's folder; tables go into another folder"


def is_feeder(folder: Path) -> bool:
    """Return whether a folder holds a feeder.

    Parameters
    ----------
    folder
        A folder, or what may become one.
    """
    return (folder / META_FILE).exists()


def write_tables(folder: Path | None, study: str, tables: Mapping[str, pd.DataFrame]) -> None:
    """Write every table of a study into a folder, as `STUDY-NAME.csv` and `STUDY-NAME.parquet`.

    A file is replaced when its new content is complete: an interruption leaves the old one. Tables that the
    study has written there before, and that are no answer to the present question, are removed.

    Parameters
    ----------
    folder
        Where to; it is made if it does not exist. None: nothing is written.
    study
        The study's name.
    tables
        Table by name. Names are those of files, without ending.

    Raises
    ------
    ValueError
        If a name is not that of a file in the folder.
    FileExistsError
        If the folder is a feeder's.
    OSError
        If the folder cannot be written.
    """
    if folder is None:
        return
    if is_feeder(folder):
        raise FileExistsError(f"{folder}: {A_FEEDER}")
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in tables.items():
        if Path(name).name != name or name in ("", ".."):
            raise InputInvalid([Problem("wrong-name", f"{name!r} is no name of a table's file")])
        replace_file(folder / f"{study}-{name}.csv", partial(frame.to_csv, index=False))
        replace_file(folder / f"{study}-{name}.parquet", partial(_for_parquet(frame).to_parquet, index=False))
    for old in sorted(folder.glob(f"{study}-*.csv")):
        # A table is two files: one alone is somebody's own.
        twin = old.with_suffix(".parquet")
        if old.stem.removeprefix(f"{study}-") not in tables and twin.is_file():
            old.unlink()
            twin.unlink()


def _for_parquet(frame: pd.DataFrame) -> pd.DataFrame:
    """Parquet has one type for each column: values of several types become text, as CSV shows them."""
    mixed = [
        name
        for name in frame.columns
        if frame[name].dtype == object and len({type(cell) for cell in frame[name].dropna()}) > 1
    ]
    return frame.assign(**{name: frame[name].map(str, na_action="ignore") for name in mixed})


Given = Mapping[str, Path | None]
"""Path by option; None where the option was not given."""

NONE: Final[Given] = {}


class Unusable(GridsecError):
    """Files or folders of a command cannot be used; `problems` names everything that is wrong with them.

    Parameters
    ----------
    problems
        One sentence each: option, path, and what is wrong.
    """

    code = "unusable-path"

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(self.problems))

    @property
    def codes(self) -> tuple[str, ...]:
        """Code of each problem."""
        return tuple(problem.code for problem in self.problems)


def see(
    *,
    folders: Given = NONE,
    over: Given = NONE,
    new: Given = NONE,
    files: Given = NONE,
    replaced: Given = NONE,
    simulated: Given = NONE,
    read: Given = NONE,
) -> None:
    """Refuse, all at once, what could not be read or written after the work. Nothing is left behind.

    Parameters
    ----------
    folders
        Into which tables are written; made where they do not exist.
    over
        Other folders into which something is written, be it over a feeder.
    new
        Folders that must not be there yet, or be empty.
    files
        That are written as they are; folders above them are made.
    replaced
        Files that are replaced as a whole, by others made beside them.
    simulated
        Files of a simulation, likewise: they replace only such files, never what was measured.
    read
        Files that are read.

    Raises
    ------
    Unusable
        If there is something that cannot be used.
    """
    written = {**folders, **over, **new, **files, **replaced, **simulated}
    checks: list[tuple[Given, Callable[[Path], Problem | None]]] = [
        (folders, _folder),
        (over, _over),
        (new, _new),
        (files, _file),
        (replaced, _replaced),
        (simulated, _simulated),
        (read, _read),
    ]
    problems = [
        Problem(why.code, f"{option} {path}: {why}")
        for given, check in checks
        for option, path in given.items()
        if path is not None and (why := _why(check, path))
    ]
    problems += _same({**written, **read}, {*files, *replaced, *simulated})
    if problems:
        raise Unusable(problems)


def _why(check: Callable[[Path], Problem | None], path: Path) -> Problem | None:
    try:
        return check(path)
    except OSError as error:
        return Problem("no-access", error.strerror or str(error))


def _folder(path: Path) -> Problem | None:
    return _over(path) or (Problem("holds-feeder", A_FEEDER) if is_feeder(path) else None)


def _over(path: Path) -> Problem | None:
    if path.exists() and not path.is_dir():
        return Problem("not-folder", "a file; expected a folder")
    if path.is_symlink() and not path.exists():
        return Problem("dead-link", "a link to what does not exist; expected a folder")
    return _room(path)


def _new(path: Path) -> Problem | None:
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        return Problem("exists", "already there; expected a new folder")
    return _room(path)


def _file(path: Path) -> Problem | None:
    if not path.exists():
        return _room(path)
    if path.is_dir():
        return Problem("not-file", "a folder; expected a file")
    with path.open("ab"):
        return None


def _replaced(path: Path) -> Problem | None:
    if path.exists() and not path.is_file():
        return _file(path)
    return _room(Path(os.path.realpath(path)).parent)


def _simulated(path: Path) -> Problem | None:
    from feeders.simulation.recording import is_simulated

    if path.is_file() and path.stat().st_size and not is_simulated(path):
        return Problem("not-simulated", "already there, and not of a simulation; expected another file")
    return _replaced(path)


def _read(path: Path) -> Problem | None:
    if not path.exists():
        return Problem("no-file", "there is no such file")
    if path.is_dir():
        return Problem("not-file", "a folder; expected a file")
    with path.open("rb"):
        return None


def _room(path: Path) -> Problem | None:
    """Why nothing can be made in a folder, or in one that is made for it."""
    above = path.absolute()
    there = next(each for each in (above, *above.parents) if each.exists())
    if not there.is_dir():
        return Problem("not-folder", f"{there} is a file")
    try:
        with tempfile.TemporaryFile(dir=there):
            return None
    except OSError as error:
        return Problem("not-writable", f"{there} cannot be written: {error.strerror or error}")


def _same(given: Given, files: set[str]) -> Iterator[Problem]:
    """Files that something else is written into, or read from, as well."""
    where = {option: Path(os.path.realpath(path)) for option, path in given.items() if path is not None}
    told = set[frozenset[str]]()
    for one, other in permutations(where, 2):
        if one not in files or where[one] not in {where[other], *where[other].parents}:
            continue
        if frozenset((one, other)) not in told:
            told.add(frozenset((one, other)))
            yield Problem("same-path", f"{one} {given[one]}: {other} needs it as well")
