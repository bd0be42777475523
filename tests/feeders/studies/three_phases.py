"""A balanced feeder's tree with customers on single phases; each phase as a balanced feeder of its own."""

from __future__ import annotations

from dataclasses import replace

from feeders.format.tables import FeederTables
from feeders.model.equipment import find
from feeders.model.site import Site, from_tables

PHASES = "abc"


def mixed(name: str, *, coupled: bool) -> FeederTables:
    """Its customers take turns on the phases; without coupling the zero sequence is the positive one."""
    tables = find(name)
    r0, x0 = (4.0, 3.0) if coupled else (1.0, 1.0)
    lines = [
        replace(row, r0_ohm=r0 * row.r_ohm, x0_ohm=x0 * row.x_ohm, b_us=0.0, phases="abc")
        for row in tables.lines
    ]
    rows = [replace(row, phases=PHASES[k % 3]) for k, row in enumerate(tables.customers)]
    return replace(tables, lines=tuple(lines), customers=tuple(rows))


def apart(name: str) -> tuple[Site, list[Site]]:
    """Three phases that do not touch, and three balanced feeders that do the same.

    A kW in one phase does what three of them do that are spread over all phases: hence three times the
    impedances.
    """
    whole = mixed(name, coupled=False)
    lines = tuple(
        replace(row, r_ohm=3.0 * row.r_ohm, x_ohm=3.0 * row.x_ohm, r0_ohm=None, x0_ohm=None)
        for row in whole.lines
    )
    alone = [
        replace(
            whole,
            lines=lines,
            customers=tuple(replace(row, phases="abc") for row in whole.customers if row.phases == phase),
        )
        for phase in PHASES
    ]
    return from_tables(whole), [from_tables(tables) for tables in alone]
