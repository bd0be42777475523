"""A feeder's folder as a source: it keeps what it tells of where it is from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from feeders.convert_busbar import opened_rows
from feeders.convert_changes import Change
from feeders.convert_network import Converted
from feeders.convert_source import feeder_source, versioned
from feeders.origin import Origin, origin
from feeders.schema import FeederTables, read
from gridsec.errors import FeederInvalid, Problem

__all__ = ["from_folder", "source_again"]

UNCHECKED: Final = "it was a feeder's folder already"
AGAIN: Final = "Before the folder was written again: "


def from_folder(
    folder: Path,
    name: str,
    *,
    root: str | None = None,
    opened: Sequence[str] = (),
    droop: str | None = None,
    one_voltage: bool = False,
    meshed: bool = False,
) -> Converted:
    """Return a feeder of our own form, with all that an earlier conversion had changed.

    Parameters
    ----------
    folder
        The feeder's.
    name
        Its new name; empty: it keeps its own.
    opened
        Lines to take as open.
    root, droop, one_voltage
        As `feeders.convert.convert` takes them: only for networks of other tools.
    meshed
        Whether loops stay closed, whatever it says itself.

    Raises
    ------
    FeederInvalid
        If it is no feeder, or with every option that makes nothing of one.
    GridsecError
        If its conversion.csv is none.
    """
    tables = read(folder)
    given = {"root": root is not None, "droop": droop is not None, "one_voltage": one_voltage}
    problems: list[str] = [
        Problem(
            "inconsistent", f"{option} is for networks of other tools; {folder} is a feeder's folder already"
        )
        for option, value in given.items()
        if value
    ]
    changes: list[Change] = []
    try:
        lines = opened_rows(tables.lines, opened, changes)
    except FeederInvalid as error:
        problems += error.problems
    if problems:
        raise FeederInvalid(problems)
    before = origin(folder)
    earlier = [] if before is None else [Change(*row) for row in before.changes.itertuples(index=False)]
    meta = tables.meta
    if name:
        meta = replace(meta, name=name, title=name if meta.title == meta.name else meta.title)
    meta = replace(meta, meshed=meshed or meta.meshed)
    tables = replace(tables, meta=meta, lines=tuple(lines))
    return Converted(tables, (*earlier, *changes), None, UNCHECKED)


def source_again(
    before: Origin | None, tables: FeederTables, folder: Path, command: str, notes: tuple[str, ...]
) -> str:
    """Return the SOURCE.md of a feeder's folder that was written again.

    Parameters
    ----------
    before
        What the folder told of its source before it was written.
    tables
        The feeder.
    folder, command
        The folder, and the command line that wrote it again.
    notes
        What was left out, added or changed, earlier and now.
    """
    if before is None or not before.source:
        about, source, package = "A feeder in the project's own form.", str(folder), versioned("gridsec")
        check = f"Not checked: {UNCHECKED}"
    else:
        about, (source, _, package) = before.about, before.source.rpartition(", ")
        told = before.check.removeprefix(AGAIN).removesuffix(".")
        check = f"{AGAIN}{told or 'not told'}"
        command = f"{before.command}`, then `{command}" if before.command else command
    return feeder_source(
        tables, about=about, origin=source, package=package, command=command, notes=notes, check=check
    )
