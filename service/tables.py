"""Tables of studies as files: CSV for people and spreadsheets, Parquet with the types kept."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from feeders.files import replace_file
from feeders.raw import META_FILE
from gridsec.errors import InputInvalid, Problem

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["A_FEEDER", "is_feeder", "write_tables"]

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
