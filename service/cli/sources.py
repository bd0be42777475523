"""Studies of another tool's network: it becomes a feeder's folder first."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rich.markup import escape

from feeders.util import command_line
from gridsec.errors import FeederInvalid, Problem
from service.cli import console

if TYPE_CHECKING:
    from feeders.convert.convert import Conversion

__all__ = ["FOLDER", "converted", "show_check", "spared"]

FOLDER: Final = "feeder"
"""Name of a converted feeder's folder within that of the results."""


def converted(feeder: str, out: Path | None) -> str:
    """Return a feeder as `model.site.load` takes it; another tool's network is converted, and that is told.

    It is converted again each time: an OpenDSS file may lead to others that have changed while it has not.
    What an earlier conversion left there is kept under another name unless it is the same, see `spared`.

    Parameters
    ----------
    feeder
        A folder, the name of a feeder that comes with the project, or any source of
        `feeders.convert.convert`.
    out
        Folder of the results, in which the feeder's becomes `feeder`; None: a folder for temporary files,
        which stays, so that what was not carried over can be read.

    Raises
    ------
    FeederInvalid, BusbarUnclear
        If there is no feeder in it, or more than one; with how to choose.
    GridsecError
        If it cannot be read.
    FileExistsError
        If there is something else where the feeder is to be written.
    """
    from feeders.convert.convert import convert
    from feeders.convert.provenance import CHANGES_FILE, BusbarUnclear
    from feeders.format.reader import FOREIGN

    if Path(feeder).is_dir() or not FOREIGN.fullmatch(feeder):
        return feeder
    temporary = None if out is not None else Path(tempfile.mkdtemp(prefix="gridsec-"))
    folder = (out or temporary or Path()) / FOLDER
    if folder.exists() and not (folder / CHANGES_FILE).is_file():
        raise FileExistsError(f"{folder}: already there, and no converted feeder; {feeder} would become it")
    command = command_line(("gridsec", "feeders", "convert", feeder, "FOLDER"))
    advice = (
        f"to choose: {command}, with --root BUS (the metered busbar) and "
        "--open LINE (to cut a loop) or --meshed (to keep loops closed); then study FOLDER"
    )
    done: Conversion | None = None
    fresh = not folder.exists()
    try:
        with spared(folder):
            done = convert(feeder, folder, name=_name(feeder))
    except FeederInvalid as error:
        raise FeederInvalid([*error.problems, Problem("advice", advice)]) from error
    except BusbarUnclear as error:
        raise BusbarUnclear(f"{error}\n{advice}") from error
    finally:
        if done is None and fresh:
            shutil.rmtree(temporary or folder, ignore_errors=True)
    fates = Counter(change.done for change in done.changes)
    counts = ", ".join(f"{times} {fate}" for fate, times in fates.items()) or "nothing changed"
    console.out.print(escape(f"{feeder} becomes {folder}: {counts}; the list: {folder / CHANGES_FILE}"))
    show_check(done)
    return str(folder)


@contextmanager
def spared(folder: Path) -> Iterator[None]:
    """Keep a copy of an earlier conversion, as `FOLDER-1`, unless what is written over it is the same.

    A copy, since the folder may be the source, hold its files, or be the one that the command runs in.

    Parameters
    ----------
    folder
        Where a conversion is written.
    """
    from feeders.convert.convert import WRITTEN

    old = {name: folder / name for name in WRITTEN if (folder / name).is_file()}
    if not old:
        yield
        return
    place = folder.resolve()
    names = (place.with_name(f"{place.name}-{k}") for k in count(1))
    kept = next(name for name in names if not name.exists())
    kept.mkdir()
    try:
        for name, path in old.items():
            shutil.copyfile(path, kept / name)
        yield
    finally:
        if all((folder / name).read_bytes() == (kept / name).read_bytes() for name in old):
            shutil.rmtree(kept)
        else:
            console.out.print(escape(f"what was in {folder} before is not the same; it is now in {kept}"))


def _name(feeder: str) -> str:
    """A feeder's name: that of the file, or of the network within its collection."""
    path = Path(feeder)
    name = path.stem if path.is_file() else feeder.partition(":")[2] or feeder
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name)[:64]


def show_check(done: Conversion) -> None:
    """Print how a conversion compares with its source's power flow.

    Parameters
    ----------
    done
        The conversion.
    """
    if done.check is None:
        console.err.print(f"[yellow]not checked: {escape(done.unchecked)}[/]")
        return
    colour = "green" if done.check.exact else "yellow"
    console.out.print(f"[{colour}]{escape(done.check.sentence)}[/]")
