"""Checks between cells: duplicates, references, graph, nominal voltages, line matrices, doubtful units.

`to_volt` of a line is the nominal voltage of its `to_bus`, where that of its `from_bus` differs. It applies
on the way from the busbar; a line that closes a loop must agree with both its ends. The loader uses the same
graph: fused buses, a tree below the busbar, loops, islands.

Each doubt has a name; `accept = ["<name>"]` in feeder.toml turns it into a note. Each check takes the valid
cells. A row with an invalid cell takes part in every check that does not need that cell, so that one run
reports all problems.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from feeders.format.columns import (
    MATRIX_NAMES,
    PAIRS,
    SERIES_NAMES,
    SHUNT_NAMES,
    CheckReport,
    LineRow,
    Parsed,
    rows,
    some,
)
from feeders.profiles import load_names, pv_names
from gridsec.arrays import Bools, Floats, Phasors
from gridsec.errors import Problem
from gridsec.grid.devices import PRESETS

SAME_LEVEL: Final = 1e-6
"""Relative difference of two nominal voltages that count as equal: 230.94 and 400 / sqrt(3)."""


def same_level(one: float, other: float) -> bool:
    """True if two nominal voltages count as equal."""
    return abs(one - other) <= SAME_LEVEL * max(one, other)


def told(nominal_volt: Floats, form: str = ".1f") -> str:
    """Nominal voltages of a feeder for messages: "11547.0 V and 230.9 V"; the busbar's is first."""
    several = dict.fromkeys(f"{volt:{form}} V" for volt in nominal_volt.tolist())
    return " and ".join(several)


def nominal_volts(found: Tree, edges: Sequence[Edge | LineRow], volt: float) -> list[float]:
    """Nominal voltage of every bus of a tree of closed lines, V, phase to neutral; `volt` of the busbar."""
    nominal = _found(found, edges, volt)
    for k, above in enumerate(found.parent):  # missing only where `_levels` reports a line
        nominal.setdefault(k + 1, nominal[above])
    return [nominal[k] for k in range(len(found.buses))]


def _found(found: Tree, edges: Sequence[Edge | LineRow], volt: float) -> dict[int, float]:
    """Nominal voltages along ways from the busbar that pass transformers forwards only."""
    near: dict[int, list[tuple[int, float | None]]] = defaultdict(list)
    for line in edges:
        if line.from_bus in found.group:
            here, there = found.group[line.from_bus], found.group[line.to_bus]
            near[here].append((there, line.to_volt))
            if line.to_volt is None:
                near[there].append((here, None))
    nominal, order = {0: volt}, [0]
    for bus in order:
        for other, changed in near[bus]:
            if other not in nominal:
                nominal[other] = nominal[bus] if changed is None else changed
                order.append(other)
    return nominal


LOW_VOLTAGE = 1000.0
# Nominal voltages between phases; none is a usual voltage to neutral.
PHASE_TO_PHASE = (
    380.0, 400.0, 415.0, 3300.0, 6000.0, 6600.0, 10000.0, 11000.0, 12470.0, 12660.0, 13200.0, 13800.0,
    15000.0, 20000.0, 22000.0, 24900.0, 30000.0, 33000.0, 34500.0,
)  # fmt: skip
# Resistance and reactance per km of the low-voltage lines that are most frequent in grid data sets (VDE cable
# tables; pandapower's standard types). A column that holds only these is per km, not per line.
PER_KM = (
    (0.642, 0.083), (0.6417, 0.0848), (0.225, 0.08), (0.2067, 0.0804), (0.208, 0.08), (0.868, 0.086),
    (0.443, 0.069), (0.868, 0.079), (1.2, 0.088), (0.32, 0.08), (0.253, 0.08), (0.164, 0.08), (0.125, 0.08),
    (1.15, 0.08), (0.524, 0.08), (0.5939, 0.372), (1.4824, 0.4),
)  # fmt: skip

LINE_XR, TRANSFORMER_XR = 20.0, 100.0
"""Ratio of reactance to resistance beyond which a line, or a large transformer, is doubtful."""

Doubts = Iterator[tuple[str, str]]


def _units(parsed: Parsed, edges: Sequence[Edge], found: Tree | None, report: CheckReport) -> None:
    """Report every doubtful value, as a problem or, if feeder.toml accepts it, as a note."""
    volt = parsed.top("voltage_volt")
    level: dict[str, float] = {}
    if found is not None and volt is not None:
        nominal = nominal_volts(found, edges, volt)
        level = {bus: nominal[k] for bus, k in found.group.items()}
    doubts = [*_voltage(parsed)]
    if volt is not None:
        doubts += [*_impedances(parsed, level, volt), *_per_km(parsed, level, volt)]
    doubts += [
        *_line_extras(parsed),
        *_powers(parsed, level, math.inf if volt is None else volt),
        *_classes(parsed),
    ]
    if found is not None:
        doubts += _drop(parsed, edges, found, level)
    accepted = parsed.top("accept") or ()
    for name, sentence in doubts:
        if name in accepted:
            report.notes.append(f"accepted: {sentence}")
        else:
            hint = f'(if it is right: accept = ["{name}"] in feeder.toml)'
            report.problem("doubtful", f"{sentence} {hint}")


def _voltage(parsed: Parsed) -> Doubts:
    places = [(f"{parsed.place}, key voltage_volt", parsed.top("voltage_volt"))]
    places += [
        (f"{where}, column to_volt", cells["to_volt"]) for where, cells in rows(parsed.lines, "to_volt")
    ]
    for where, volt in places:
        if volt is None:
            continue
        if volt < 50:
            yield "voltage", f"{where}: {volt:g} V looks like kilovolts; expected volts"
        if any(abs(volt - pair) < 1e-3 * pair for pair in PHASE_TO_PHASE):
            yield (
                "voltage",
                f"{where}: {volt:g} V looks like a phase-to-phase voltage; expected phase to neutral, "
                f"{volt / math.sqrt(3):.2f}",
            )


def _impedances(parsed: Parsed, level: Mapping[str, float], volt: float) -> Doubts:
    """Doubts of impedances, which are those of `to_bus`'s side, at the nominal voltage there."""
    for where, cells in rows(parsed.lines, "r_ohm", "x_ohm"):
        r, x = cells["r_ohm"], cells["x_ohm"]
        transformer = cells.get("to_volt") is not None
        here = cells["to_volt"] if transformer else level.get(cells.get("to_bus", ""), volt)
        largest = 5.0 if here < LOW_VOLTAGE else 100.0
        steep = TRANSFORMER_XR if transformer else LINE_XR
        for name, value in (("r_ohm", r), ("x_ohm", x)):
            if value > largest:
                yield (
                    "impedance",
                    f"{where}, column {name}: {value:g} ohm is very large; in milliohm, perhaps?",
                )
        if x > steep * r:
            yield (
                "ratio",
                f"{where}: x_ohm {x:g} is above {steep:g} times r_ohm {r:g}; columns or units mixed up?",
            )
        elif 0 < x < 0.005 * r:
            yield "ratio", f"{where}: r_ohm {r:g} is above 200 times x_ohm {x:g}; columns or units mixed up?"


def _per_km(parsed: Parsed, level: Mapping[str, float], volt: float) -> Doubts:
    pairs = [
        (cells["r_ohm"], cells["x_ohm"])
        for _, cells in rows(parsed.lines, "r_ohm", "x_ohm")
        if cells.get("to_volt") is None and level.get(cells.get("to_bus", ""), volt) < LOW_VOLTAGE
    ]
    pairs = [(r, x) for r, x in pairs if r > 0 or x > 0]
    standard = all(
        any(abs(r - a) <= 0.005 * a and abs(x - b) <= 0.02 * b for a, b in PER_KM) for r, x in pairs
    )
    if parsed.lines and len(pairs) >= 2 and standard:
        place = parsed.lines[0].where.partition(",")[0]
        yield (
            "impedance",
            f"{place}, columns r_ohm and x_ohm: every row holds a standard cable's values per kilometre; "
            "expected those of the whole line",
        )


def _line_extras(parsed: Parsed) -> Doubts:
    for where, cells in rows(parsed.lines, "rating_a"):
        rating = cells["rating_a"]
        if rating is not None and rating < 1.0:
            yield "rating", f"{where}, column rating_a: {rating:g} A is very small; in kA, perhaps?"
    for where, cells in rows(parsed.lines, "b_us"):
        if cells["b_us"] > 1e5:
            yield "impedance", f"{where}, column b_us: {cells['b_us']:g} microsiemens is very large; in nS?"
    for name in ("tap", "tap_a", "tap_b", "tap_c"):
        for where, cells in rows(parsed.lines, name):
            if cells[name] is not None and not 0.5 <= cells[name] <= 2.0:
                yield "ratio", f"{where}, column {name}: {cells[name]:g} is not near 1; 5 % up is 0.95"


def _powers(parsed: Parsed, level: Mapping[str, float], volt: float) -> Doubts:
    for column in ("load_kw", "pv_kw", "inverter_kva"):
        for where, cells in rows(parsed.customers, column):
            largest = 1000.0 if level.get(cells.get("bus", ""), volt) < LOW_VOLTAGE else 1e5
            if cells[column] > largest:
                yield "load", f"{where}, column {column}: {cells[column]:g} is very large; in W or VA?"


def _classes(parsed: Parsed) -> Doubts:
    meters = parsed.section("meters")
    places = [
        (f"{parsed.place}, [meters], key class_percent", meters.get("class_percent")),
        (f"{parsed.place}, key busbar_class_percent", parsed.top("busbar_class_percent")),
    ]
    places += [
        (f"{where}, column class_percent", cells["class_percent"])
        for where, cells in rows(parsed.customers, "class_percent")
    ]
    for where, value in places:
        if value is not None and not 0.02 <= value <= 10.0:
            hint = "a fraction instead of percent?" if value < 0.02 else "no voltage meter is that bad"
            yield "class", f"{where}: {value:g} % is doubtful; {hint}"


def _drop(parsed: Parsed, edges: Sequence[Edge], found: Tree, level: Mapping[str, float]) -> Doubts:
    """Check the voltage drop with every load at its peak: ``sum of r p / (3 V^2)`` on the worst path."""
    ohm = {cells["line"]: cells["r_ohm"] for _, cells in rows(parsed.lines, "line", "r_ohm")}
    if not level or found.loops or any(edges[k].line not in ohm for k in found.branch):
        return
    below = [0.0] * len(found.buses)
    for _, cells in rows(parsed.customers, "bus", "load_kw"):
        if cells["bus"] in found.group:
            below[found.group[cells["bus"]]] += cells["load_kw"] * 1000.0
    for k in range(len(found.parent) - 1, -1, -1):
        below[found.parent[k]] += below[k + 1]
    drop = [0.0] * len(found.buses)
    for k, above in enumerate(found.parent):
        line = edges[found.branch[k]]
        drop[k + 1] = drop[above] + ohm[line.line] * below[k + 1] / (3.0 * level[line.to_bus] ** 2)
    worst = max(range(len(drop)), key=drop.__getitem__)
    if drop[worst] > 1.0:
        yield (
            "impedance",
            f"with every load at load_kw the voltage at bus {found.buses[worst]!r} would fall by "
            f"{100 * drop[worst]:.0f} %; expected far below 100; r_ohm per km or in milliohm? load_kw in W?",
        )


RESERVED_METER = "substation"
"""Name of the busbar meter on the wire and in alarms."""


def check(parsed: Parsed, report: CheckReport) -> None:
    """Report every problem between cells, and notable content."""
    for each in (_duplicates, _reserved, _limits, _power_factors, _presets, _profiles, _positions, _taps):
        each(parsed, report)
    check_matrices(parsed, report)
    edges, found = _graph(parsed, report)
    _units(parsed, edges, found, report)


# --- ids and references -------------------------------------------------------------------------


def _duplicates(parsed: Parsed, report: CheckReport) -> None:
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
                report.problem(
                    "duplicate",
                    f"{where}, column {column}: {key!r} is already the id of {first[key]}; "
                    "every id must be unique",
                )
            else:
                first[key] = where
    bare = [
        cells["customer"] for _, cells in rows(parsed.customers, "customer", "meter") if cells["meter"] == ""
    ]
    if bare:
        report.notes.append(f"{len(bare)} customer(s) without a meter: {some(bare)}")


def _reserved(parsed: Parsed, report: CheckReport) -> None:
    for where, cells in rows(parsed.customers, "meter"):
        if cells["meter"] == RESERVED_METER:
            report.problem(
                "duplicate",
                f"{where}, column meter: {RESERVED_METER!r} is the name of the busbar meter; "
                "expected another id",
            )


def _limits(parsed: Parsed, report: CheckReport) -> None:
    limits = parsed.section("limits")
    low, high = limits.get("v_min_pu"), limits.get("v_max_pu")
    if low is not None and high is not None and low >= high:
        report.problem(
            "order",
            f"{parsed.place}, [limits]: v_min_pu {low:g} is not below v_max_pu {high:g}; "
            "expected for example 0.9 and 1.1",
        )


def _power_factors(parsed: Parsed, report: CheckReport) -> None:
    load = parsed.section("load")
    names = ("power_factor_min", "power_factor", "power_factor_max")
    places: list[tuple[str, dict[str, Any], dict[str, Any]]]
    places = [(f"{parsed.place}, [load]", load, {})] if parsed.meta is not None else []
    places += [(where, cells, load) for where, cells in rows(parsed.customers)]
    for where, cells, defaults in places:
        if defaults and all(cells.get(name) is None for name in names):
            continue
        low, mid, high = (cells[n] if cells.get(n) is not None else defaults.get(n) for n in names)
        if low is not None and mid is not None and high is not None and not low <= mid <= high:
            report.problem(
                "order",
                f"{where}: power_factor {mid:g} is not between power_factor_min {low:g} "
                f"and power_factor_max {high:g}",
            )


def _presets(parsed: Parsed, report: CheckReport) -> None:
    for where, cells in rows(parsed.customers, "droop"):
        preset, rating = cells["droop"], cells.get("inverter_kva")
        if preset and preset not in PRESETS:
            report.problem(
                "unknown-name",
                f"{where}, column droop: {preset!r} is not known; expected one of {', '.join(PRESETS)}",
            )
        if rating and not preset:
            report.problem(
                "missing",
                f"{where}, column droop: is missing although inverter_kva is {rating:g}; "
                f"expected one of {', '.join(PRESETS)}",
            )
        if preset and rating == 0:
            report.notes.append(f"{where}: droop {preset!r} has no effect, inverter_kva is 0")


def _profiles(parsed: Parsed, report: CheckReport) -> None:
    known = {"load_profile": load_names(), "pv_profile": pv_names()}
    for column, names in known.items():
        for where, cells in rows(parsed.customers, column):
            if cells[column] and cells[column] not in names:
                report.problem(
                    "unknown-name",
                    f"{where}, column {column}: {cells[column]!r} is not known; "
                    f"expected one of {', '.join(names)}, or nothing",
                )


# --- the graph ----------------------------------------------------------------------------------


def loops(busbar: str, lines: Iterable[LineRow]) -> list[Problem]:
    """Problems of the loops of a radial feeder's lines."""
    report = CheckReport()
    closed, found = closed_tree(busbar, lines)
    _loops(found, closed, meshed=False, report=report)
    return report.problems


def _graph(parsed: Parsed, report: CheckReport) -> tuple[list[Edge], Tree | None]:
    """Check the graph; its closed lines and its tree, the tree None if some buses are unknown."""
    busbar = parsed.top("busbar")
    known: dict[str, None] = {} if busbar is None else {busbar: None}
    edges: list[Edge] = []
    for where, cells in rows(parsed.lines, "from_bus", "to_bus"):
        one, other = cells["from_bus"], cells["to_bus"]
        known.update({one: None, other: None})
        if one == other:
            report.problem(
                "self-loop", f"{where}: from_bus and to_bus are both {one!r}; a line needs two buses"
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
            report.problem(
                "unknown-name",
                f"{where}, column bus: {cells['bus']!r} is not known; no line leads there, "
                f"and it is not the busbar {busbar!r}",
            )
    if any(busbar in (edge.from_bus, edge.to_bus) for edge in edges):
        _islands(found, parsed, report)
    else:
        report.problem(
            "not-connected", f"{parsed.place}, key busbar: no closed line is connected to {busbar!r}"
        )
    _fused(found, report)
    _levels(found, edges, parsed, report)
    return edges, found


def _levels(found: Tree, edges: list[Edge], parsed: Parsed, report: CheckReport) -> None:
    """Lines with a `to_volt` that contradicts the tree."""
    volt = parsed.top("voltage_volt")
    if volt is None:
        return
    nominal, known = nominal_volts(found, edges, volt), _found(found, edges, volt).keys()
    above = dict(zip(found.branch, found.parent, strict=True))
    places = {cells["line"]: where for where, cells in rows(parsed.lines, "line")}
    for k, line in enumerate(edges):
        if line.from_bus not in found.group:
            continue
        where = f"{places.get(line.line, 'lines')}, column to_volt"
        here, there = found.group[line.from_bus], found.group[line.to_bus]
        told = nominal[here] if line.to_volt is None else line.to_volt
        backwards = line.to_volt is not None and above.get(k) == there
        if here == there and not same_level(told, nominal[here]):
            expected = "expected the transformer's r_ohm and x_ohm"
            report.problem("zero-impedance", f"{where}: {told:g} on a line without impedance; {expected}")
        elif backwards and (here not in known or not same_level(told, nominal[there])):
            report.problem(
                "backwards",
                f"{where}: {told:g}, but {line.to_bus!r} is on the side of the busbar; expected from_bus and "
                "to_bus exchanged, with the impedances of the other side: a transformer leads away from the "
                "busbar",
            )
        elif not same_level(told, nominal[there]):
            around = f"{nominal[there]:g} V around the loop; expected the same"
            report.problem("inconsistent", f"{where}: {told:g} V at {line.to_bus!r}, {around}")


def _loops(found: Tree, edges: Sequence[Edge | LineRow], meshed: bool, report: CheckReport) -> None:
    for loop in found.loops:
        names = some([edges[k].line for k in loop])
        if len(loop) == 1:
            report.problem(
                "self-loop",
                f"lines: {names} is short-circuited, lines without impedance join its two buses; "
                "set closed to false on one of them",
            )
        elif meshed:
            report.notes.append(f"lines: {names} form a loop; {edges[loop[0]].line!r} is drawn as a tie")
        else:
            report.problem(
                "not-radial",
                f"lines: {names} form a loop; the feeder must be radial: set closed to false on "
                "one of them (or merge parallel lines into one row), or meshed to true in feeder.toml "
                "(converters: --meshed) if the loop is really closed",
            )


def _islands(found: Tree, parsed: Parsed, report: CheckReport) -> None:
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
        report.problem("not-connected", text)


def _fused(found: Tree, report: CheckReport) -> None:
    members: dict[int, list[str]] = defaultdict(list)
    for bus, index in found.group.items():
        members[index].append(bus)
    for buses in members.values():
        if len(buses) > 1:
            report.notes.append(f"buses {some(buses)} are one: lines without impedance join them")


def _positions(parsed: Parsed, report: CheckReport) -> None:
    for where, cells in rows(parsed.lines, "to_x", "to_y"):
        if (cells["to_x"] is None) != (cells["to_y"] is None):
            report.problem(
                "missing", f"{where}, columns to_x and to_y: one of them is missing; expected both or none"
            )


def _taps(parsed: Parsed, report: CheckReport) -> None:
    names = {phase: f"tap_{phase}" for phase in "abc"}
    for where, cells in rows(parsed.lines, "phases", "tap", *names.values()):
        given = [name for name in names.values() if cells[name] is not None]
        wanted = [name for phase, name in names.items() if phase in cells["phases"]]
        if given and (given != wanted or cells["tap"] != 1.0):
            report.problem(
                "inconsistent",
                f"{where}, columns {', '.join(given)}: expected {', '.join(wanted)}, those of phases "
                f"{cells['phases']!r}, and no tap beside them; or tap alone, of all of them",
            )


# --- Graph of the feeder ---


LOOPS_SHOWN = 20


@dataclass(frozen=True, slots=True)
class Edge:
    """Closed line: id, buses, impedance zero or not, nominal voltage at its end, number of phases."""

    line: str
    from_bus: str
    to_bus: str
    zero: bool
    to_volt: float | None = None
    phases: int = 3


@dataclass(frozen=True, slots=True)
class Tree:
    """Part of the feeder that is connected to the busbar, in topological order."""

    group: dict[str, int]  # Fused bus index of every connected bus; 0 is the busbar
    buses: tuple[str, ...]  # One id per fused bus: the first of its members in the order of the input
    parent: tuple[int, ...]  # Fused bus that feeds bus k + 1; always at most k
    branch: tuple[int, ...]  # Index (into the edges given) of the line that feeds bus k + 1
    # Indices of the edges that close loops: each joins two buses that are connected without it
    ties: tuple[int, ...]
    # Indices of the edges of each loop: of every tie that joins a bus to itself, and of at most LOOPS_SHOWN
    # others. A radial feeder has none
    loops: tuple[tuple[int, ...], ...]
    islands: tuple[tuple[str, ...], ...]  # Unconnected buses, one tuple for each connected piece


class _Sets:
    """Disjoint sets of buses; the representative is the first member in the order of the input."""

    def __init__(self, order: Iterable[str]) -> None:
        self.rank = {bus: k for k, bus in enumerate(dict.fromkeys(order))}
        self.above = {bus: bus for bus in self.rank}

    def find(self, bus: str) -> str:
        root = bus
        while self.above[root] != root:
            root = self.above[root]
        while self.above[bus] != root:
            self.above[bus], bus = root, self.above[bus]
        return root

    def join(self, one: str, other: str) -> bool:
        """Unite the sets of two buses; False if both are in one set already."""
        a, b = self.find(one), self.find(other)
        if a == b:
            return False
        first, second = (a, b) if self.rank[a] < self.rank[b] else (b, a)
        self.above[second] = first
        return True


def closed_tree(busbar: str, lines: Iterable[LineRow]) -> tuple[list[LineRow], Tree]:
    """Closed lines of a feeder, and their tree."""
    closed = [row for row in lines if row.closed]
    edges = [Edge(row.line, row.from_bus, row.to_bus, row.fuses, phases=len(row.phases)) for row in closed]
    return closed, tree(busbar, edges)


def tree(busbar: str, edges: Sequence[Edge], others: Iterable[str] = ()) -> Tree:
    """Fuse the buses at both ends of closed lines without impedance and walk the others from the busbar.

    `others` are further buses that need a connection, such as ends of open lines.
    """
    order = [busbar, *(bus for edge in edges for bus in (edge.from_bus, edge.to_bus)), *others]
    fused, connected = _Sets(order), _Sets(order)
    for edge in edges:
        if edge.zero:
            fused.join(edge.from_bus, edge.to_bus)
            connected.join(edge.from_bus, edge.to_bus)
    neighbours: dict[str, list[tuple[int, str]]] = {bus: [] for bus in fused.rank}
    closing = _closing(edges, connected)
    for k, edge in enumerate(edges):
        if not edge.zero and k not in closing:
            a, b = fused.find(edge.from_bus), fused.find(edge.to_bus)
            neighbours[a].append((k, b))
            neighbours[b].append((k, a))
    index, parent, branch = _walk(fused.find(busbar), neighbours)
    short = [k for k in closing if fused.find(edges[k].from_bus) == fused.find(edges[k].to_bus)]
    shown = sorted([*short, *[k for k in closing if k not in short][:LOOPS_SHOWN]])
    loops = tuple(_loop(k, edges[k], fused, neighbours) for k in shown)
    pieces: dict[str, list[str]] = {}
    for bus in fused.rank:
        if fused.find(bus) not in index:
            pieces.setdefault(connected.find(bus), []).append(bus)
    return Tree(
        {bus: index[fused.find(bus)] for bus in fused.rank if fused.find(bus) in index},
        tuple(index),
        parent,
        branch,
        tuple(closing),
        loops,
        tuple(map(tuple, pieces.values())),
    )


def _closing(edges: Sequence[Edge], connected: _Sets) -> list[int]:
    """Edges that close loops, preferably those of fewer phases and the later ones (Kruskal).

    The tree of the other edges has the largest possible sum of phases. If any tree brings every phase of each
    bus, this one does: such a tree has that sum, the number of buses with the phase less one, over the
    phases.
    """
    order = sorted((k for k, edge in enumerate(edges) if not edge.zero), key=lambda k: -edges[k].phases)
    return sorted(k for k in order if not connected.join(edges[k].from_bus, edges[k].to_bus))


def _walk(
    root: str, neighbours: dict[str, list[tuple[int, str]]]
) -> tuple[dict[str, int], tuple[int, ...], tuple[int, ...]]:
    """Number the buses depth first, branch by branch, as in an operator's diagram."""
    index: dict[str, int] = {}
    parent: list[int] = []
    branch: list[int] = []
    stack = [(root, -1, -1)]
    while stack:
        bus, above, line = stack.pop()
        index[bus] = len(index)
        if above >= 0:
            parent.append(above)
            branch.append(line)
        stack.extend((b, index[bus], k) for k, b in reversed(neighbours[bus]) if b not in index)
    return index, tuple(parent), tuple(branch)


def _loop(
    closing: int, edge: Edge, fused: _Sets, neighbours: dict[str, list[tuple[int, str]]]
) -> tuple[int, ...]:
    """Edges of the loop that one more edge closes: that edge and the path between its ends."""
    start, goal = fused.find(edge.from_bus), fused.find(edge.to_bus)
    came: dict[str, tuple[int, str] | None] = {start: None}
    stack = [start]
    while stack and goal not in came:
        bus = stack.pop()
        for k, other in neighbours[bus]:
            if other not in came:
                came[other] = (k, bus)
                stack.append(other)
    path = [closing]
    step = came.get(goal)
    while step is not None:
        path.append(step[0])
        step = came[step[1]]
    return tuple(path)


# --- Matrices of lines ---


MATRIX_PHASES: Final = "abc"

ROUNDING: Final = 1e-6
"""Tolerance of passivity and singularity, relative to the largest entry of a matrix."""

AGREEMENT: Final = 1e-3
"""Tolerance of r_ohm, x_ohm and b_us against the positive sequence, relative to the largest entry."""

UPPER: Final = np.triu_indices(3)


def cells_of(line: LineRow) -> dict[str, float | None]:
    """Matrix cells of a row by column name."""
    return {name: getattr(line, name) for name in MATRIX_NAMES}


def series_ohm(cells: Mapping[str, Any]) -> Phasors | None:
    """Impedance matrix of a row in phases, ohm, with 0 in absent ones; None without a matrix."""
    r, x = _symmetric(cells, "r", "ohm"), _symmetric(cells, "x", "ohm")
    return None if r is None or x is None else r + 1j * x


def shunt_us(cells: Mapping[str, Any]) -> Floats | None:
    """Matrix of the total shunt susceptances of a row in phases, microsiemens; as `series_ohm`."""
    return _symmetric(cells, "b", "us")


def _symmetric(cells: Mapping[str, Any], symbol: str, unit: str) -> Floats | None:
    upper = [cells.get(f"{symbol}_{pair}_{unit}") for pair in PAIRS]
    if all(value is None for value in upper):
        return None
    matrix = np.zeros((3, 3))
    matrix[UPPER] = [0.0 if value is None else value for value in upper]
    return np.triu(matrix) + np.triu(matrix, 1).T


def columns_of(symbol: str, unit: str, matrix: Floats, present: Bools) -> dict[str, float]:
    """Cells of a symmetric matrix (3, 3) by column name, without those of absent phases.

    `symbol` and `unit` are "r" and "ohm", "x" and "ohm", or "b" and "us"; `present` (3,) is a mask.
    """
    return {
        f"{symbol}_{pair}_{unit}": float(matrix[i, j])
        for pair, i, j in zip(PAIRS, *UPPER, strict=True)
        if present[i] and present[j]
    }


def positive_sequence(matrix: Phasors | Floats) -> complex:
    """Mean of the diagonal less the mean of the other entries: the value for balanced currents."""
    count = len(matrix)
    own = complex(np.trace(matrix))
    return own / count - (complex(matrix.sum()) - own) / max(count * (count - 1), 1)


def passive(matrix: Floats) -> bool:
    """True for a positive semidefinite matrix, real and symmetric, up to rounding."""
    return bool(np.linalg.eigvalsh(matrix)[0] >= -ROUNDING * np.abs(matrix).max())


def check_matrices(parsed: Parsed, report: CheckReport) -> None:
    """Report every matrix that is incomplete, inconsistent or physically impossible."""
    needed = ("phases", "r_ohm", "x_ohm", "r0_ohm", "x0_ohm", "b_us", *MATRIX_NAMES)
    for where, cells in rows(parsed.lines, *needed):
        for names, matrix in ((SERIES_NAMES, series_ohm(cells)), (SHUNT_NAMES, shunt_us(cells))):
            given = [name for name in names if cells[name] is not None]
            if given and _complete(where, cells, names, given, report) and matrix is not None:
                _content(where, cells, matrix, report)


def _complete(
    where: str, cells: Mapping[str, Any], names: tuple[str, ...], given: list[str], report: CheckReport
) -> bool:
    """True for a matrix without missing and surplus cells."""
    phases = cells["phases"]
    if len(phases) == 1:
        text = f"{where}, column {given[0]}: a matrix, but phases is {phases!r}; expected none"
        report.problem("inconsistent", text)
        return False
    wanted = [name for name in names if set(name.split("_")[1]) <= set(phases)]
    missing = [name for name in wanted if name not in given]
    extra = [name for name in given if name not in wanted]
    if missing:
        expected = "expected the whole matrix or nothing of it"
        report.problem("missing", f"{where}, columns {', '.join(missing)}: missing; {expected}")
    if extra:
        text = f"of a conductor that is not in phases {phases!r}; expected none"
        report.problem("absent-phase", f"{where}, columns {', '.join(extra)}: {text}")
    return not missing and not extra


def _content(where: str, cells: Mapping[str, Any], whole: Phasors | Floats, report: CheckReport) -> None:
    """Report entries that no passive line has, and contradictions to the row's other cells."""
    here = [MATRIX_PHASES.index(phase) for phase in sorted(cells["phases"])]
    matrix = whole[np.ix_(here, here)]
    one, largest = positive_sequence(matrix), float(np.abs(matrix).max())
    series = np.iscomplexobj(matrix)
    parts = [("r_ohm", one.real), ("x_ohm", one.imag)] if series else [("b_us", one.real)]
    for name, value in parts:
        if abs(cells[name] - value) > AGREEMENT * largest:
            report.problem(
                "inconsistent",
                f"{where}, column {name}: {cells[name]:g} is not the positive sequence of the line's matrix; "
                f"expected {value:.6g}, the mean of its diagonal less that of the rest",
            )
    if not passive(matrix.real):
        fault = "r_aa_ohm to r_cc_ohm: generate power" if series else "b_aa_us to b_cc_us: no capacitances"
        report.problem("not-definite", f"{where}, columns {fault}; expected a positive semidefinite matrix")
    if series and (cells["r0_ohm"] is not None or cells["x0_ohm"] is not None):
        report.problem(
            "inconsistent", f"{where}, columns r0_ohm and x0_ohm: beside a matrix; expected one of the two"
        )
    if series and min(np.linalg.svd(matrix, compute_uv=False)[-1], abs(one)) <= ROUNDING * largest:
        expected = "expected conductors with impedances of their own"
        report.problem("singular", f"{where}, columns r_aa_ohm to x_cc_ohm: are singular; {expected}")
