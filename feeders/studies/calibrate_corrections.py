"""Errors of a feeder's files in their own words, and files without them.

References
----------
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from feeders.columns import MATRIX_NAMES, PHASE_NAMES
from feeders.schema import LineRow

if TYPE_CHECKING:
    from collections.abc import Mapping

    from feeders.schema import FeederTables

__all__ = ["PLACES", "Correction", "Kind", "apply", "as_filed", "left", "longer"]


class Kind(StrEnum):
    """What may be wrong."""

    BUS = "bus"
    PHASE = "phase"
    SWAP = "swap"
    LENGTH = "length"
    METER = "meter"


PLACES: Final = (Kind.BUS, Kind.PHASE)
"""Errors about where a customer is: of one customer there is at most one of each."""


@dataclass(frozen=True, slots=True)
class Correction:
    """An error of the files in their own words.

    Attributes
    ----------
    kind
        What it is.
    names
        The customer, both customers of a swap, the meter, or the lines; all customers on a lateral.
    bus, phases
        Where the customer is.
    factor
        On the lines' length.
    lines
        The lines of a single-phase lateral that is on these phases with all its customers, its first one
        first; none, if only the customer is.
    """

    kind: Kind
    names: tuple[str, ...]
    bus: str = ""
    phases: str = ""
    factor: float = 1.0
    lines: tuple[str, ...] = ()


def apply(tables: FeederTables, wrong: Correction) -> FeederTables:
    """Correct the files.

    Parameters
    ----------
    tables
        The files.
    wrong
        Their error; that of a meter changes nothing in them.
    """
    if wrong.kind is Kind.METER:
        return tables
    if wrong.kind is Kind.LENGTH:
        rows = (longer(row, wrong.factor) if row.line in wrong.names else row for row in tables.lines)
        return replace(tables, lines=tuple(rows))
    customers = {row.customer: row for row in tables.customers}
    if wrong.kind is Kind.PHASE:
        customers |= {name: replace(customers[name], phases=wrong.phases) for name in wrong.names}
        lines = (_on(row, wrong.phases) if row.line in wrong.lines else row for row in tables.lines)
        return replace(tables, lines=tuple(lines), customers=tuple(customers.values()))
    one = customers[wrong.names[0]]
    if wrong.kind is Kind.SWAP:
        other = customers[wrong.names[1]]
        changed = [replace(one, meter=other.meter), replace(other, meter=one.meter)]
    else:
        changed = [replace(one, bus=wrong.bus)]
    customers |= {row.customer: row for row in changed}
    return replace(tables, customers=tuple(customers.values()))


def longer(line: LineRow, factor: float) -> LineRow:
    """A line of another length.

    Parameters
    ----------
    line
        The line.
    factor
        On its length.
    """
    scaled: dict[str, Any] = {
        name: None if (value := getattr(line, name)) is None else value * factor
        for name in ("r_ohm", "x_ohm", "r0_ohm", "x0_ohm", "b_us", *MATRIX_NAMES)
    }
    return replace(line, **scaled)


def _on(line: LineRow, phase: str) -> LineRow:
    """A line of one phase on another one, its own columns with it."""
    own = {name: name.split("_") for name in PHASE_NAMES}
    cells: dict[str, Any] = {name: None for name, parts in own.items() if set(parts[1]) == {line.phases}}
    there = {
        "_".join((symbol, phase * len(letters), *unit)): getattr(line, name)
        for name, (symbol, letters, *unit) in own.items()
        if name in cells
    }
    return replace(line, phases=phase, **(cells | there))


def left(earlier: Correction, later: Correction) -> Correction | None:
    """What a later correction leaves of an earlier one; None: nothing.

    Parameters
    ----------
    earlier, later
        Both about one feeder; of a customer's place the later one holds.
    """
    if later.kind is Kind.BUS and set(earlier.names) <= set(later.names) and earlier.lines:
        return replace(earlier, lines=())  # nobody is left whose readings speak for them
    if earlier.kind is not later.kind or later.kind not in PLACES:
        return earlier
    names = tuple(name for name in earlier.names if name not in later.names)
    lines = tuple(name for name in earlier.lines if name not in later.lines)
    return replace(earlier, names=names, lines=lines) if names else None


def as_filed(tables: FeederTables, wrong: Correction, bus_of_file: Mapping[str, int]) -> bool:
    """Whether files already say what a correction of a customer's place does.

    Parameters
    ----------
    tables
        The files.
    wrong
        The correction.
    bus_of_file
        Bus of the model of each bus of the files.
    """
    rows = {row.customer: row for row in tables.customers}
    if wrong.kind is Kind.BUS:
        return all(bus_of_file[rows[name].bus] == bus_of_file[wrong.bus] for name in wrong.names)
    if wrong.kind is not Kind.PHASE:
        return False
    lines = {row.line: row for row in tables.lines}
    phases = {rows[name].phases for name in wrong.names} | {lines[name].phases for name in wrong.lines}
    return phases == {wrong.phases}
