"""A feeder's tables after parsing cell by cell, as the checks between cells see them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from gridsec.errors import Problem

SHOWN = 10


@dataclass(frozen=True, slots=True)
class Record:
    """One row: the sentence that names its place, and the cells that could be parsed."""

    where: str
    cells: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Parsed:
    """An input after parsing; what could not be read at all is None.

    Attributes
    ----------
    place
        Name of the file or object that holds the feeder's own keys.
    meta
        Cells of each section of feeder.toml; "" is the top.
    lines, customers
        The tables' rows.
    """

    place: str
    meta: dict[str, dict[str, Any]] | None
    lines: list[Record] | None
    customers: list[Record] | None

    def top(self, key: str) -> Any:
        """Return a key of feeder.toml's top, None where it is bad or absent."""
        return None if self.meta is None else self.meta[""].get(key)

    def accepted(self, suspicion: str) -> bool:
        """Return whether feeder.toml says that this suspicion was checked."""
        return suspicion in (self.top("accept") or ())


@dataclass(slots=True)
class Report:
    """What the checks found so far."""

    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def rows(records: list[Record] | None, *columns: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield place and cells of the rows whose cells in these columns could be parsed."""
    for record in records or ():
        if all(column in record.cells for column in columns):
            yield record.where, record.cells


def some(items: list[str]) -> str:
    """Return a list of ids for a message, cut where it is long."""
    tail = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(items[:SHOWN]) + tail
