"""Feeders of the project with their open ties closed, or with a tie of our own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from feeders.load import Site, from_tables, load
from feeders.schema import FeederTables, LineRow


def closed(tables: FeederTables, *ties: LineRow) -> FeederTables:
    """The same feeder with every line closed, and some more lines."""
    lines = tuple(replace(row, closed=True) for row in (*tables.lines, *ties))
    return replace(tables, meta=replace(tables.meta, meshed=True), lines=lines)


@cache
def landnetz() -> Site:
    """A line of thirteen houses, closed to a ring: its far end is connected to the busbar as well."""
    return from_tables(
        closed(load("kerber-landnetz").tables, LineRow("ring", "bus_1_13", "main_busbar", 0.05, 0.01))
    )


@cache
def rural3() -> Site:
    """The village of 118 customers, the ends of its two longest lines joined."""
    site = load("simbench-lv-rural3")
    x, y = site.xy[site.bus_of_file["LV3.101 Bus 125"]] if site.xy is not None else (0.0, 0.0)
    tie = LineRow("ring", "LV3.101 Bus 36", "LV3.101 Bus 125", 0.01, 0.004, to_x=float(x), to_y=float(y))
    return from_tables(closed(site.tables, tie))


@cache
def baran_wu() -> Site:
    """The feeder of Baran and Wu with its five tie switches closed."""
    return from_tables(closed(load("case33bw").tables))
