"""Network of another tool in SI, as its reader builds it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final

from feeders.convert.customers import Draw
from feeders.convert.lines import Coupling, capacitor, open_end
from feeders.convert.provenance import WHOLE, Changes, ConversionChange, Done
from feeders.format.tables import CustomerRow, LineRow
from gridsec.arrays import Floats, Phasors
from gridsec.errors import GridsecError

OFF: Final = "switched off in the source"
MEASURE: Final = "every customer has a meter of the feeder's own kind instead"
UNLIKE: Final = "has no place in a feeder; the check shows the effect"
CONSTANT: Final = "depends on the voltage in the source; taken as constant power"
IN_STAR: Final = "in star, with its phases' powers of the source's power flow; exact at these loads only"
"""Effects of changes that several tools share."""


@dataclass(slots=True)
class SourceNetwork:
    """Network in SI, with the state by its own tool."""

    tool: str  # The source's tool and its version
    sources: list[str]  # Buses with a voltage source
    nominal: dict[str, float]  # Nominal voltage of each bus, phase to neutral, V
    lines: list[LineRow] = field(default_factory=list)  # Rows of lines.csv, in any direction
    # Loads, generators and transformers
    draws: list[Draw] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    xy: dict[str, tuple[float, float]] = field(default_factory=dict)  # Positions
    # (3,), complex voltages of the buses, V; NaN where a phase is absent. Loads of constant power
    volts: dict[str, Phasors] = field(default_factory=dict)
    # (3,), the same with the loads' dependence on the voltage; empty without one
    as_found: dict[str, Phasors] = field(default_factory=dict)
    changes: Changes = field(default_factory=Changes)  # Inexact conversions so far
    # Changes that count if their bus is in the feeder
    of_bus: list[tuple[str, ConversionChange]] = field(default_factory=list)
    # Buses and labels of loads and generators that the reader itself converts to customers
    connected: list[tuple[str, str]] = field(default_factory=list)
    unsolved: str = ""  # Reason for missing voltages of the source's own power flow

    def note_at(self, bus: str, element: str, prop: str, done: Done, effect: str) -> None:
        """Add a change that counts if the bus is in the feeder."""
        self.of_bus.append((bus, ConversionChange(element, prop, done, effect)))

    def leave_out(self, element: str, effect: str, *buses: str) -> None:
        """Report an element that is left out, at its buses or in any case."""
        for bus in buses:
            self.note_at(bus, element, WHOLE, "left out", effect)
        if not buses:
            self.changes.note(element, WHOLE, "left out", effect)

    def add_line(self, row: LineRow, connected: Collection[str]) -> None:
        """Add a line; with one of its ends connected, its charging there too."""
        self.lines.append(row)
        if len(connected) == 1:
            (bus,) = connected
            stub = open_end(row, bus, self.nominal[bus])
            self.lines += [stub] if stub else []

    def add_capacitor(
        self,
        name: str,
        bus: str,
        siemens: float | Floats,
        kvar: float,
        *,
        phases: str = "abc",
        label: str = "",
    ) -> None:
        """Add a capacitor, S per phase or a matrix of its phases, with its power for the report."""
        self.lines.append(capacitor(name, bus, siemens, phases))
        effect = f"{kvar:.4g} kvar as the charging of a line to nowhere"
        self.note_at(bus, label or name, "connection", "changed", effect)

    def busbar(self, root: str | None) -> str | None:
        """Bus that becomes the busbar; None without a request: the first with lines below the source."""
        return None if root is None else named_bus(self.nominal, root)

    def customers(
        self, inside: Collection[str], droop: str | None, changes: Changes
    ) -> tuple[list[CustomerRow], dict[str, complex]]:
        """Customers of the buses inside that are not draws, and their powers, kVA."""
        del inside, droop, changes
        return [], {}


def named_bus(buses: Collection[str], root: str) -> str:
    """Bus of this name, in any case if unique; `GridsecError` for an unknown or ambiguous one."""
    hits = [bus for bus in buses if bus == root] or [bus for bus in buses if bus.lower() == root.lower()]
    if len(hits) != 1:
        raise GridsecError(f"bus {root!r} does not exist", code="unknown-name")
    return hits[0]
