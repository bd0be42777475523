"""Checks that look at more than one cell: duplicates, references, the graph, doubtful units.

Each takes the cells that could be parsed and returns sentences. A row with a bad cell takes part
wherever that cell does not matter, so that one run names everything there is to mend.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from feeders import levels, matrices, profiles, units
from feeders.records import Parsed, Report, rows, some
from feeders.topology import Edge, Tree, tree
from gridsec.droop import PRESETS
from gridsec.errors import Problem

if TYPE_CHECKING:
    from feeders.schema import LineRow

RESERVED_METER = "substation"
"""What the busbar meter is called on the wire and in alarms."""


def feeder(parsed: Parsed) -> tuple[list[Problem], list[str]]:
    """Return every problem between cells, and notes on what is right but worth knowing."""
    report = Report()
    for check in (_duplicates, _reserved, _limits, _power_factors, _presets, _profiles, _positions, _taps):
        check(parsed, report)
    matrices.check(parsed, report)
    edges, found = _graph(parsed, report)
    units.check(parsed, edges, found, report)
    return report.problems, report.notes


# --- ids and references -------------------------------------------------------------------------


def _duplicates(parsed: Parsed, report: Report) -> None:
    for records, column in (
        (parsed.lines, "line"),
        (parsed.customers, "customer"),
        (parsed.customers, "meter"),
    ):
        first: dict[str, str] = {}
        for where, cells in rows(records, column):
            key = cells[column]
            if key == "":
                continue
            if key in first:
                report.problems.append(
                    Problem(
                        "duplicate",
                        f"{where}, column {column}: {key!r} is already the id of {first[key]}; "
                        "every id must be unique",
                    )
                )
            else:
                first[key] = where
    bare = [
        cells["customer"] for _, cells in rows(parsed.customers, "customer", "meter") if cells["meter"] == ""
    ]
    if bare:
        report.notes.append(f"{len(bare)} customer(s) without a meter: {some(bare)}")


def _reserved(parsed: Parsed, report: Report) -> None:
    for where, cells in rows(parsed.customers, "meter"):
        if cells["meter"] == RESERVED_METER:
            report.problems.append(
                Problem(
                    "duplicate",
                    f"{where}, column meter: {RESERVED_METER!r} is what the busbar meter is called; "
                    "expected another id",
                )
            )


def _limits(parsed: Parsed, report: Report) -> None:
    limits = {} if parsed.meta is None else parsed.meta["limits"]
    low, high = limits.get("v_min_pu"), limits.get("v_max_pu")
    if low is not None and high is not None and low >= high:
        report.problems.append(
            Problem(
                "order",
                f"{parsed.place}, [limits]: v_min_pu {low:g} is not below v_max_pu {high:g}; "
                "expected for example 0.9 and 1.1",
            )
        )


def _power_factors(parsed: Parsed, report: Report) -> None:
    load = {} if parsed.meta is None else parsed.meta["load"]
    names = ("power_factor_min", "power_factor", "power_factor_max")
    places: list[tuple[str, dict[str, Any], dict[str, Any]]]
    places = [(f"{parsed.place}, [load]", load, {})] if parsed.meta is not None else []
    places += [(where, cells, load) for where, cells in rows(parsed.customers)]
    for where, cells, defaults in places:
        if defaults and all(cells.get(name) is None for name in names):
            continue
        low, mid, high = (cells[n] if cells.get(n) is not None else defaults.get(n) for n in names)
        if low is not None and mid is not None and high is not None and not low <= mid <= high:
            report.problems.append(
                Problem(
                    "order",
                    f"{where}: power_factor {mid:g} is not between power_factor_min {low:g} "
                    f"and power_factor_max {high:g}",
                )
            )


def _presets(parsed: Parsed, report: Report) -> None:
    for where, cells in rows(parsed.customers, "droop"):
        preset, rating = cells["droop"], cells.get("inverter_kva")
        if preset and preset not in PRESETS:
            report.problems.append(
                Problem(
                    "unknown-name",
                    f"{where}, column droop: {preset!r} is not known; expected one of {', '.join(PRESETS)}",
                )
            )
        if rating and not preset:
            report.problems.append(
                Problem(
                    "missing",
                    f"{where}, column droop: is missing although inverter_kva is {rating:g}; "
                    f"expected one of {', '.join(PRESETS)}",
                )
            )
        if preset and rating == 0:
            report.notes.append(f"{where}: droop {preset!r} has no effect, inverter_kva is 0")


def _profiles(parsed: Parsed, report: Report) -> None:
    known = {"load_profile": profiles.load_names(), "pv_profile": profiles.pv_names()}
    for column, names in known.items():
        for where, cells in rows(parsed.customers, column):
            if cells[column] and cells[column] not in names:
                report.problems.append(
                    Problem(
                        "unknown-name",
                        f"{where}, column {column}: {cells[column]!r} is not known; "
                        f"expected one of {', '.join(names)}, or nothing",
                    )
                )


# --- the graph ----------------------------------------------------------------------------------


def loops(busbar: str, lines: Iterable[LineRow]) -> list[Problem]:
    """Return what is wrong with the loops of a radial feeder's lines.

    Parameters
    ----------
    busbar, lines
        The busbar, and rows of lines.csv.
    """
    edges = [
        Edge(row.line, row.from_bus, row.to_bus, row.r_ohm == row.x_ohm == 0.0, phases=len(row.phases))
        for row in lines
        if row.closed
    ]
    report = Report()
    _loops(tree(busbar, edges), edges, meshed=False, report=report)
    return report.problems


def _graph(parsed: Parsed, report: Report) -> tuple[list[Edge], Tree | None]:
    """Check the graph; return its closed lines and its tree, None if its buses are not all known."""
    busbar = parsed.top("busbar")
    known: dict[str, None] = {} if busbar is None else {busbar: None}
    edges: list[Edge] = []
    for where, cells in rows(parsed.lines, "from_bus", "to_bus"):
        one, other = cells["from_bus"], cells["to_bus"]
        known.update({one: None, other: None})
        if one == other:
            report.problems.append(
                Problem("self-loop", f"{where}: from_bus and to_bus are both {one!r}; a line needs two buses")
            )
        elif cells.get("closed", False):
            zero = cells.get("r_ohm") == 0 and cells.get("x_ohm") == 0
            phases = len(cells.get("phases") or "abc")
            edges.append(Edge(cells.get("line", "?"), one, other, zero, cells.get("to_volt"), phases=phases))
    found = tree(busbar if busbar is not None else next(iter(known), ""), edges, known)
    _loops(found, edges, parsed.top("meshed") is True, report)
    whole = all({"from_bus", "to_bus", "closed"} <= row.cells.keys() for row in parsed.lines or ())
    if parsed.lines is None or busbar is None or not whole:
        return edges, None
    for where, cells in rows(parsed.customers, "bus"):
        if cells["bus"] not in known:
            report.problems.append(
                Problem(
                    "unknown-name",
                    f"{where}, column bus: {cells['bus']!r} is not known; no line leads there, "
                    f"and it is not the busbar {busbar!r}",
                )
            )
    if any(busbar in (edge.from_bus, edge.to_bus) for edge in edges):
        _islands(found, parsed, report)
    else:
        report.problems.append(
            Problem("not-connected", f"{parsed.place}, key busbar: no closed line is connected to {busbar!r}")
        )
    _fused(found, report)
    _levels(found, edges, parsed, report)
    return edges, found


def _levels(found: Tree, edges: list[Edge], parsed: Parsed, report: Report) -> None:
    volt = parsed.top("voltage_volt")
    places = {cells["line"]: where for where, cells in rows(parsed.lines, "line")}
    for k, problem in levels.problems(found, edges, volt) if volt is not None else ():
        where = places.get(edges[k].line, "lines")
        report.problems.append(Problem(problem.code, f"{where}, column to_volt: {problem}"))


def _loops(found: Tree, edges: list[Edge], meshed: bool, report: Report) -> None:
    for loop in found.loops:
        names = some([edges[k].line for k in loop])
        if len(loop) == 1:
            report.problems.append(
                Problem(
                    "self-loop",
                    f"lines: {names} is short-circuited, lines without impedance join its two buses; "
                    "set closed to false on one of them",
                )
            )
        elif meshed:
            report.notes.append(f"lines: {names} form a loop; {edges[loop[0]].line!r} is drawn as a tie")
        else:
            report.problems.append(
                Problem(
                    "not-radial",
                    f"lines: {names} form a loop; the feeder must be radial: set closed to false on "
                    "one of them (or merge parallel lines into one row), or meshed to true in feeder.toml "
                    "(converters: --meshed) if the loop is really closed",
                )
            )


def _islands(found: Tree, parsed: Parsed, report: Report) -> None:
    loads: dict[str, list[str]] = defaultdict(list)
    for _, cells in rows(parsed.customers, "bus", "customer"):
        loads[cells["bus"]].append(cells["customer"])
    ends: dict[str, list[str]] = defaultdict(list)
    for _, cells in rows(parsed.lines, "closed", "line", "from_bus", "to_bus"):
        if not cells["closed"]:
            ends[cells["from_bus"]].append(cells["line"])
            ends[cells["to_bus"]].append(cells["line"])
    for island in found.islands:
        customers = [customer for bus in island for customer in loads[bus]]
        ties = list(dict.fromkeys(line for bus in island for line in ends[bus]))
        text = f"lines: no closed line connects {'bus' if len(island) == 1 else 'buses'} {some(list(island))}"
        text += f" (with {some(customers)})" if customers else ""
        text += f" to the busbar {parsed.top('busbar')!r}"
        text += f"; open here: {some(ties)}" if ties else ""
        report.problems.append(Problem("not-connected", text))


def _fused(found: Tree, report: Report) -> None:
    members: dict[int, list[str]] = defaultdict(list)
    for bus, index in found.group.items():
        members[index].append(bus)
    for buses in members.values():
        if len(buses) > 1:
            report.notes.append(f"buses {some(buses)} are one: lines without impedance join them")


def _positions(parsed: Parsed, report: Report) -> None:
    for where, cells in rows(parsed.lines, "to_x", "to_y"):
        if (cells["to_x"] is None) != (cells["to_y"] is None):
            report.problems.append(
                Problem(
                    "missing",
                    f"{where}, columns to_x and to_y: one of them is missing; expected both or none",
                )
            )


def _taps(parsed: Parsed, report: Report) -> None:
    names = {phase: f"tap_{phase}" for phase in "abc"}
    for where, cells in rows(parsed.lines, "phases", "tap", *names.values()):
        given = [name for name in names.values() if cells[name] is not None]
        wanted = [name for phase, name in names.items() if phase in cells["phases"]]
        if given and (given != wanted or cells["tap"] != 1.0):
            report.problems.append(
                Problem(
                    "inconsistent",
                    f"{where}, columns {', '.join(given)}: expected {', '.join(wanted)}, those of phases "
                    f"{cells['phases']!r}, and no tap beside them; or tap alone, of all of them",
                )
            )
