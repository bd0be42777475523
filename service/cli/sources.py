"""Conversion of another tool's network to a feeder's folder before a study."""

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

FOLDER: Final = "feeder"  # name of a converted feeder's folder within the folder of the results


def converted(feeder: str, out: Path | None) -> str:
    """Return a feeder for `model.site.load`; another tool's network is converted, with a message.

    The conversion is repeated each time: an OpenDSS file may refer to others that have changed. A different
    earlier conversion in the folder is kept under another name, see `spared`. The feeder's folder is `feeder`
    in the folder of the results; without one, in a temporary folder, which stays.

    Raises FeederInvalid, BusbarUnclear if the network contains no feeder, or more than one; with advice on
        the choice; GridsecError if the network cannot be read; FileExistsError if the destination exists and
        is not a converted feeder.
    """
    from feeders.convert.convert import convert
    from feeders.convert.provenance import CHANGES_FILE, BusbarUnclear
    from feeders.format.columns import FOREIGN

    if Path(feeder).is_dir() or not FOREIGN.fullmatch(feeder):
        return feeder
    temporary = None if out is not None else Path(tempfile.mkdtemp(prefix="gridsec-"))
    folder = (out or temporary or Path()) / FOLDER
    if folder.exists() and not (folder / CHANGES_FILE).is_file():
        raise FileExistsError(
            f"{folder}: exists and is not a converted feeder; {feeder} would be converted to it"
        )
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
    console.say(f"{feeder} becomes {folder}: {counts}; the list: {folder / CHANGES_FILE}")
    show_check(done)
    return str(folder)


@contextmanager
def spared(folder: Path) -> Iterator[None]:
    """Keep a copy of an earlier conversion, as `FOLDER-1`, unless the new one is equal.

    A copy, since the folder may be the source, contain its files, or be the working directory.
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
            console.say(f"the earlier content of {folder} differs; it is now in {kept}")


def _name(feeder: str) -> str:
    """Name of a feeder: that of the file, or of the network within its collection."""
    path = Path(feeder)
    name = path.stem if path.is_file() else feeder.partition(":")[2] or feeder
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name)[:64]


def show_check(done: Conversion) -> None:
    """Print the comparison of a conversion with its source's power flow."""
    if done.check is None:
        console.err.print(f"[yellow]not checked: {escape(done.unchecked)}[/]")
        return
    colour = "green" if done.check.exact else "yellow"
    console.out.print(f"[{colour}]{escape(done.check.sentence)}[/]")
