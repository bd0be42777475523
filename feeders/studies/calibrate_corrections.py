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
        Place of the customer. In an exchange `phases` has one letter for each name and then for each line;
        otherwise all of them are on the same phases.
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

    @property
    def exchange(self) -> bool:
        """Exchange of the phases of two customers or laterals: each has a letter of its own."""
        return self.kind is Kind.PHASE and len(self.phases) > 1

    @property
    def on(self) -> tuple[dict[str, str], dict[str, str]]:
        """Phases of each name and of each line, for a correction of phases."""
        n = len(self.names)
        each = self.phases if self.exchange else (self.phases,) * (n + len(self.lines))
        return dict(zip(self.names, each, strict=False)), dict(zip(self.lines, each[n:], strict=True))


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
        on, lines_on = wrong.on
        customers |= {name: replace(customers[name], phases=phases) for name, phases in on.items()}
        lines = (_on(row, lines_on[row.line]) if row.line in lines_on else row for row in tables.lines)
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
        # No customer is left on the lateral to confirm the phase of its lines.
        return _without_lines(earlier)
    if earlier.kind is not later.kind or later.kind not in PLACES:
        return earlier
    on, lines_on = earlier.on
    on = {name: phases for name, phases in on.items() if name not in later.names}
    lines_on = {name: phases for name, phases in lines_on.items() if name not in later.lines}
    return _of_phases(earlier, on, lines_on) if on else None


def _without_lines(earlier: Correction) -> Correction:
    return _of_phases(earlier, earlier.on[0], {})


def _of_phases(earlier: Correction, on: dict[str, str], lines_on: dict[str, str]) -> Correction:
    """The correction of these names and lines alone."""
    phases = earlier.phases
    if earlier.exchange:
        phases = "".join((*on.values(), *lines_on.values()))
        phases = phases if len(set(phases)) > 1 else phases[:1]
    return replace(earlier, names=tuple(on), lines=tuple(lines_on), phases=phases)


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
    on, lines_on = wrong.on
    here = all(rows[name].phases == phases for name, phases in on.items())
    return here and all(lines[name].phases == phases for name, phases in lines_on.items())
