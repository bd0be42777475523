"""Input and output paths of commands, and tables of studies as files."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Final

from feeders.format.columns import META_FILE
from feeders.util import replace_file
from gridsec.errors import GridsecError, InputInvalid, Problem

if TYPE_CHECKING:
    import pandas as pd


A_FEEDER: Final = "a feeder's folder; tables go into another folder"


def is_feeder(folder: Path) -> bool:
    """True if a folder, which need not exist, contains a feeder."""
    return (folder / META_FILE).exists()


def write_tables(folder: Path | None, study: str, tables: Mapping[str, pd.DataFrame]) -> None:
    """Write every table of a study to a folder, as `STUDY-NAME.csv` and `STUDY-NAME.parquet`; None: nothing.

    A file is replaced when its new content is complete: an interruption leaves the old one. Tables of earlier
    runs of the study that the present run does not write are removed.

    Raises ValueError if a name is not a file name; FileExistsError if the folder contains a feeder; OSError
        if the folder cannot be written.
    """
    if folder is None:
        return
    if is_feeder(folder):
        raise FileExistsError(f"{folder}: {A_FEEDER}")
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in tables.items():
        if Path(name).name != name or name in ("", ".."):
            raise InputInvalid([Problem("wrong-name", f"{name!r} is not a name of a table's file")])
        replace_file(folder / f"{study}-{name}.csv", partial(frame.to_csv, index=False))
        replace_file(folder / f"{study}-{name}.parquet", partial(_for_parquet(frame).to_parquet, index=False))
    for old in sorted(folder.glob(f"{study}-*.csv")):
        # A table is a pair of files; a single file is not from a study and stays.
        twin = old.with_suffix(".parquet")
        if old.stem.removeprefix(f"{study}-") not in tables and twin.is_file():
            old.unlink()
            twin.unlink()


def _for_parquet(frame: pd.DataFrame) -> pd.DataFrame:
    """Convert columns of several types to text, as in CSV: Parquet has one type for each column."""
    mixed = [
        name
        for name in frame.columns
        if frame[name].dtype == object and len({type(cell) for cell in frame[name].dropna()}) > 1
    ]
    return frame.assign(**{name: frame[name].map(str, na_action="ignore") for name in mixed})


Given = Mapping[str, Path | None]  # path by option; None for an option that was not given

NONE: Final[Given] = {}


class Unusable(GridsecError):
    """Files or folders of a command cannot be used; `problems` has one sentence each."""

    code = "unusable-path"

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(self.problems))

    @property
    def codes(self) -> tuple[str, ...]:
        """Code of each problem."""
        return tuple(problem.code for problem in self.problems)


def check_paths(
    *,
    folders: Given = NONE,
    over: Given = NONE,
    new: Given = NONE,
    files: Given = NONE,
    replaced: Given = NONE,
    simulated: Given = NONE,
    read: Given = NONE,
) -> None:
    """Check input and output paths before a command starts; raise all problems at once. Leaves no files.

    folders: folders for tables; created if they do not exist.
    over: other output folders, which may contain a feeder.
    new: folders that must not exist yet, or be empty.
    files: files that are written in place; folders above them are created.
    replaced: files that are replaced as a whole, by new files beside them.
    simulated: files of a simulation, also replaced as a whole: only such files are replaced, never
        measurements.
    read: input files.
    Raises Unusable if a path cannot be used.
    """
    checks: list[tuple[Given, Callable[[Path], Problem | None]]] = [
        (folders, partial(_folder, tables=True)),
        (over, _folder),
        (new, partial(_folder, empty=True)),
        (files, _file),
        (replaced, partial(_file, whole=True)),
        (simulated, partial(_file, whole=True, simulated=True)),
        (read, partial(_file, read=True)),
    ]
    problems = [
        Problem(why.code, f"{option} {path}: {why}")
        for given, check in checks
        for option, path in given.items()
        if path is not None and (why := _why(check, path))
    ]
    every = {option: path for given, _ in checks for option, path in given.items()}
    problems += _same(every, {*files, *replaced, *simulated})
    if problems:
        raise Unusable(problems)


def _why(check: Callable[[Path], Problem | None], path: Path) -> Problem | None:
    try:
        return check(path)
    except OSError as error:
        return Problem("no-access", error.strerror or str(error))


def _folder(path: Path, *, tables: bool = False, empty: bool = False) -> Problem | None:
    """Problem of an output folder: for tables, no feeder's folder, or one that must be new or empty."""
    if empty and path.exists() and (not path.is_dir() or any(path.iterdir())):
        return Problem("exists", "exists; expected a new folder")
    if path.exists() and not path.is_dir():
        return Problem("not-folder", "a file; expected a folder")
    if path.is_symlink() and not path.exists() and not empty:
        return Problem("dead-link", "a dead link; expected a folder")
    return _room(path) or (Problem("holds-feeder", A_FEEDER) if tables and is_feeder(path) else None)


def _file(path: Path, *, read: bool = False, whole: bool = False, simulated: bool = False) -> Problem | None:
    """Problem of a file that is read, written in place, or replaced as a whole by a new one beside it."""
    if read and not path.exists():
        return Problem("no-file", "there is no such file")
    if path.is_dir():
        return Problem("not-file", "a folder; expected a file")
    if simulated and path.is_file() and path.stat().st_size and not _is_simulated(path):
        return Problem("not-simulated", "exists and is not from a simulation; expected another file")
    if not path.exists() or (whole and path.is_file()):
        return _room(Path(os.path.realpath(path)).parent if whole else path)
    with path.open("rb" if read else "ab"):
        return None


def _is_simulated(path: Path) -> bool:
    from feeders.simulation.recording import is_simulated

    return is_simulated(path)


def _room(path: Path) -> Problem | None:
    """Reason why no file can be created in a folder, or in its lowest existing parent; None without one."""
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
    """Files with a path that another option also writes or reads."""
    where = {option: Path(os.path.realpath(path)) for option, path in given.items() if path is not None}
    told = set[frozenset[str]]()
    for one, other in permutations(where, 2):
        if one not in files or where[one] not in {where[other], *where[other].parents}:
            continue
        if frozenset((one, other)) not in told:
            told.add(frozenset((one, other)))
            yield Problem("same-path", f"{one} {given[one]}: {other} uses it as well")
