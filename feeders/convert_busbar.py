"""What of a network becomes a feeder, as it was asked for: the busbar, and lines to open."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from feeders.convert_changes import BusbarUnclear, Change
from feeders.convert_graph import fused_with
from feeders.schema import LineRow
from gridsec.arrays import Phasors
from gridsec.droop import preset
from gridsec.errors import FeederInvalid, GridsecError, Problem
from gridsec.phases import ROTATION

if TYPE_CHECKING:
    from feeders.convert_network import Network

__all__ = ["angles_of", "below_source", "busbar_of", "chosen", "named_bus", "one_busbar", "opened_rows"]

Busbar = TypeVar("Busbar")

TURNED: Final = 1.0
"""Degrees up to which the angles between a busbar's phases may be others than those of a feeder."""


def chosen(network: Network, find: Callable[[], Busbar], opened: Sequence[str], droop: str | None) -> Busbar:
    """Return the busbar that was chosen, unless something else that was chosen does not exist either.

    Parameters
    ----------
    network
        The network.
    find
        Finds the busbar; raises a GridsecError if there is none.
    opened, droop
        As `feeder_of` takes them.

    Raises
    ------
    FeederInvalid
        With all that does not exist.
    GridsecError
        As `find`, if nothing else is wrong.
    """
    problems = _unknown(network.lines, opened)
    try:
        if droop is not None:
            preset(droop)
    except FeederInvalid as error:
        problems += error.problems
    try:
        busbar = find()
    except GridsecError as error:
        if not problems:
            raise
        raise FeederInvalid([Problem(error.code, str(error)), *problems]) from error
    if problems:
        raise FeederInvalid(problems)
    return busbar


def opened_rows(lines: Iterable[LineRow], opened: Sequence[str], changes: list[Change]) -> list[LineRow]:
    """Open the lines that were asked for.

    Parameters
    ----------
    lines
        Rows of lines.csv.
    opened
        Names of lines.
    changes
        Takes what was opened.

    Raises
    ------
    FeederInvalid
        With every line that does not exist.
    """
    rows = list(lines)
    if unknown := _unknown(rows, opened):
        raise FeederInvalid(unknown)
    changes.extend(
        Change(f"line {line}", "closed", "changed", "open, as asked for; the check shows what that does")
        for line in opened
    )
    return [replace(row, closed=False) if row.line in opened else row for row in rows]


def busbar_of(network: Network, rows: list[LineRow], root: str | None) -> str:
    """Return the bus asked for, or the first from the source on that has lines.

    Parameters
    ----------
    network
        The network.
    rows
        Its lines, with those open that shall be.
    root
        The bus asked for.

    Raises
    ------
    GridsecError
        If there is no such bus.
    BusbarUnclear
        If none was asked for, and it is not clear which one is meant.
    """
    if root is not None:
        return named_bus(network, root)
    if len(network.sources) != 1:
        names = ", ".join(network.sources) or "none"
        raise BusbarUnclear(f"the busbar is not clear, voltage sources at: {names}; name it with root")
    way = _way_down(network, rows)
    if not _has_lines(way[-1], rows):
        beyond = ", ".join(sorted(_beyond(network, way))) or "none"
        raise BusbarUnclear(f"the busbar is not clear, candidates: {beyond}; name it with root")
    return way[-1]


def named_bus(network: Network, root: str) -> str:
    """Return the bus asked for.

    Parameters
    ----------
    network, root
        The network, and the bus's name.

    Raises
    ------
    GridsecError
        If there is no such bus, or more than one that could be meant.
    """
    hits = [bus for bus in network.nominal if bus == root] or [
        bus for bus in network.nominal if bus.lower() == root.lower()
    ]
    if len(hits) != 1:
        raise GridsecError(f"there is no bus {root!r}", code="unknown-name")
    return hits[0]


def _unknown(lines: Iterable[LineRow], opened: Sequence[str]) -> list[str]:
    return [
        Problem("unknown-name", f"there is no line {line!r} to open")
        for line in sorted(set(opened) - {row.line for row in lines})
    ]


def below_source(network: Network) -> str | None:
    """Return the bus of the only source's only transformer on its other side; None if there is no such bus.

    Parameters
    ----------
    network
        The network.
    """
    way = _way_down(network, network.lines) if len(network.sources) == 1 else []
    return way[-1] if len(way) > 1 and _has_lines(way[-1], network.lines) else None


def angles_of(volts: Phasors, busbar: str, changes: list[Change]) -> Phasors:
    """Return the busbar's voltages as the feeder can have them.

    The busbar's meter reads magnitudes; simulations and monitors take angles of 0, -120 and 120 degrees.

    Parameters
    ----------
    volts : (3,)
        The source's, V; NaN where a phase is absent.
    busbar
        The bus.
    changes
        Takes a row where phases are turned otherwise against each other.

    Returns
    -------
    (3,)
        The same, turned where they have to be.
    """
    there = np.isfinite(volts)
    if not there.any():
        return volts
    first = volts[there][0]
    of_feeder = ROTATION / ROTATION[there][0]
    if np.ptp(np.angle((volts / first / of_feeder)[there], deg=True)) <= TURNED:
        return volts
    theirs, ours = (_degrees(each[there]) for each in (volts / first, of_feeder))
    effect = f"{ours} degrees, in the source {theirs}; the check shows what that does"
    changes.append(Change(f"bus {busbar}", "angles between its phases", "approximated", effect))
    return np.asarray(np.abs(volts) * of_feeder)


def _degrees(phasors: Phasors) -> str:
    angles = np.round(np.angle(phasors, deg=True), 1) + 0.0
    return " and ".join(", ".join(f"{angle:g}" for angle in angles).rsplit(", ", 1))


def one_busbar(buses: Collection[str], rows: Iterable[LineRow]) -> bool:
    """Return whether buses are one, joined by closed switches.

    Parameters
    ----------
    buses
        Some buses.
    rows
        The network's lines.
    """
    return bool(buses) and fused_with(min(buses), rows).keys() >= set(buses)


def _way_down(network: Network, rows: list[LineRow]) -> list[str]:
    """Follow transformers from the source, as long as there is only one way and no line."""
    way = [network.sources[0]]
    while not _has_lines(way[-1], rows):
        beyond = _beyond(network, way)
        if not one_busbar(beyond, rows):
            break
        way.append(min(beyond))
    return way


def _has_lines(bus: str, rows: list[LineRow]) -> bool:
    return any(row.closed and bus in (row.from_bus, row.to_bus) for row in rows)


def _beyond(network: Network, way: list[str]) -> set[str]:
    return {bus for each in network.couplings if way[-1] in each.buses for bus in each.buses} - set(way)
