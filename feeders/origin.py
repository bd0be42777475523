"""What a converted feeder's folder tells of its source: what was not carried over, and how it was checked."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from feeders.convert_changes import CHANGES_FILE, COLUMNS
from feeders.convert_source import SOURCE_FILE
from feeders.equipment import folder_of
from gridsec.errors import GridsecError

__all__ = ["Origin", "origin"]


@dataclass(frozen=True, slots=True, eq=False)
class Origin:
    """Where a converted feeder is from.

    Attributes
    ----------
    source
        What was converted, with the package that holds or reads it; empty if that is not told.
    check
        How the feeder's AC power flow compares with the source's, or why it was not compared; the same.
    changes
        What was left out, approximated, added or changed; one row each, as in conversion.csv.
    about, command
        What the network is, and the command line that made the folder; empty if that is not told.
    """

    source: str
    check: str
    changes: pd.DataFrame
    about: str = ""
    command: str = ""


def origin(path_or_name: Path | str) -> Origin | None:
    """Return where a feeder is from; None if it was not converted.

    Parameters
    ----------
    path_or_name
        Its folder, or the name of a feeder that comes with the project.

    Raises
    ------
    GridsecError
        If its conversion.csv is not what `feeders.convert` writes.
    """
    folder = folder_of(path_or_name)
    if folder is None or not (folder / CHANGES_FILE).is_file():
        return None
    try:
        changes = pd.read_csv(folder / CHANGES_FILE, dtype=str, keep_default_na=False)
    except ValueError as error:
        raise GridsecError(f"{folder / CHANGES_FILE}: {error}", code="unreadable") from error
    if tuple(changes.columns) != COLUMNS:
        raise GridsecError(
            f"{folder / CHANGES_FILE}: expected the columns {', '.join(COLUMNS)}", code="unreadable"
        )
    told = folder / SOURCE_FILE
    text = told.read_text(encoding="utf-8", errors="replace") if told.is_file() else ""
    source = re.search(r"^- Source: `(.*)`(.*)$", text, re.MULTILINE)
    check = re.search(r"^## Checked\n\n(.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    about = re.search(r"^# .*\n\n(.*?)\n\n- Source: ", text, re.DOTALL)
    command = re.search(r"^- Made by: `(.*)`$", text, re.MULTILINE)
    return Origin(
        "".join(source.groups()) if source else "",
        " ".join(check[1].split()) if check else "",
        changes,
        about[1] if about else "",
        command[1] if command else "",
    )
