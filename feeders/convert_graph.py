"""What is connected to what in a network of another tool."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from feeders.convert_draws import Draw
from feeders.schema import LineRow
from gridsec.arrays import Phasors


@dataclass(frozen=True, slots=True, eq=False)
class Coupling:
    """A transformer, or anything else that joins buses and is no line.

    Attributes
    ----------
    name, buses
        Its name, with its kind, and the buses it joins.
    power_kva
        What flows into it from each of them, by phase, kVA.
    line
        The line from the first of its two buses to the second that it may be, with its tap relative to their
        nominal voltages, and `to_volt` still open; None: it is none.
    idle
        What it takes without load, beside that line.
    turn
        Degrees by which it turns the phases from the first bus to the second.
    """

    name: str
    buses: tuple[str, ...]
    power_kva: tuple[Phasors, ...]
    line: LineRow | None = None
    idle: Draw | None = None
    turn: float = 0.0


def reached(start: str, rows: Iterable[LineRow], without: Collection[str] = ()) -> dict[str, int]:
    """Return the buses that closed lines connect, with how many lines away; nothing passes `without`.

    Parameters
    ----------
    start
        The bus to begin with.
    rows
        Lines.
    without
        Buses that end a way.
    """
    near: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        if row.closed:
            near[row.from_bus].append(row.to_bus)
            near[row.to_bus].append(row.from_bus)
    level = {start: 0}
    order = [start]
    for bus in order:
        for other in near[bus]:
            if other not in level and bus not in without:
                level[other] = level[bus] + 1
                order.append(other)
    return level


def fused_with(bus: str, rows: Iterable[LineRow]) -> dict[str, int]:
    """Return the buses that closed switches make one with a bus."""
    return reached(bus, (row for row in rows if row.r_ohm == row.x_ohm == 0.0))


def as_rows(couplings: Iterable[Coupling]) -> list[LineRow]:
    """Return couplings as lines, where only what is connected matters."""
    return [
        LineRow(each.name, each.buses[0], other, 0.0, 0.0) for each in couplings for other in each.buses[1:]
    ]


def above_busbar(
    busbar: str, sources: Iterable[str], rows: list[LineRow], couplings: Iterable[Coupling]
) -> set[str]:
    """Return what is connected to the sources without passing a busbar.

    Parameters
    ----------
    busbar, sources
        The busbar, and the buses with a voltage source.
    rows, couplings
        All that joins buses.
    """
    fused = fused_with(busbar, rows)
    everything = [*rows, *as_rows(couplings)]
    return {bus for source in sources for bus in reached(source, everything, without=fused)}
