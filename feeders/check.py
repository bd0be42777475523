"""Checks that look at more than one cell: duplicates, references, the graph, doubtful units.

Each takes the cells that could be parsed and returns sentences. A row with a bad cell takes part
wherever that cell does not matter, so that one run names everything there is to mend.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from feeders import profiles
from feeders.topology import Edge, Tree, tree
from gridsec.droop import PRESETS

LOW_VOLTAGE = 1000.0
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
class _Report:
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def feeder(parsed: Parsed) -> tuple[list[str], list[str]]:
    """Return every problem between cells, and notes on what is right but worth knowing."""
    report = _Report()
    for check in (
        _duplicates,
        _limits,
        _power_factors,
        _presets,
        _profiles,
        _voltage,
        _line_units,
        _customer_units,
        _graph,
    ):
        check(parsed, report)
    return report.problems, report.notes


def _rows(records: list[Record] | None, *columns: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows whose cells in these columns could be parsed."""
    for record in records or ():
        if all(column in record.cells for column in columns):
            yield record.where, record.cells


def _some(items: list[str]) -> str:
    """Return a list of ids for a message, cut where it is long."""
    tail = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(items[:SHOWN]) + tail


# --- ids and references -------------------------------------------------------------------------


def _duplicates(parsed: Parsed, report: _Report) -> None:
    for records, column in (
        (parsed.lines, "line"),
        (parsed.customers, "customer"),
        (parsed.customers, "meter"),
    ):
        first: dict[str, str] = {}
        for where, cells in _rows(records, column):
            key = cells[column]
            if key == "":
                continue
            if key in first:
                report.problems.append(
                    f"{where}, column {column}: {key!r} is already the id of {first[key]}; every id must be unique"
                )
            else:
                first[key] = where
    bare = [
        cells["customer"] for _, cells in _rows(parsed.customers, "customer", "meter") if cells["meter"] == ""
    ]
    if bare:
        report.notes.append(f"{len(bare)} customer(s) without a meter: {_some(bare)}")


def _limits(parsed: Parsed, report: _Report) -> None:
    limits = {} if parsed.meta is None else parsed.meta["limits"]
    low, high = limits.get("v_min_pu"), limits.get("v_max_pu")
    if low is not None and high is not None and low >= high:
        report.problems.append(
            f"{parsed.place}, [limits]: v_min_pu {low:g} is not below v_max_pu {high:g}; "
            "expected for example 0.9 and 1.1"
        )


def _power_factors(parsed: Parsed, report: _Report) -> None:
    load = {} if parsed.meta is None else parsed.meta["load"]
    names = ("power_factor_min", "power_factor", "power_factor_max")
    places: list[tuple[str, dict[str, Any], dict[str, Any]]]
    places = [(f"{parsed.place}, [load]", load, {})] if parsed.meta is not None else []
    places += [(where, cells, load) for where, cells in _rows(parsed.customers)]
    for where, cells, defaults in places:
        if defaults and all(cells.get(name) is None for name in names):
            continue
        low, mid, high = (cells[n] if cells.get(n) is not None else defaults.get(n) for n in names)
        if low is not None and mid is not None and high is not None and not low <= mid <= high:
            report.problems.append(
                f"{where}: power_factor {mid:g} is not between power_factor_min {low:g} "
                f"and power_factor_max {high:g}"
            )


def _presets(parsed: Parsed, report: _Report) -> None:
    for where, cells in _rows(parsed.customers, "droop"):
        preset, rating = cells["droop"], cells.get("inverter_kva")
        if preset and preset not in PRESETS:
            report.problems.append(
                f"{where}, column droop: {preset!r} is not known; expected one of {', '.join(PRESETS)}"
            )
        if rating and not preset:
            report.problems.append(
                f"{where}, column droop: is missing although inverter_kva is {rating:g}; "
                f"expected one of {', '.join(PRESETS)}"
            )
        if preset and rating == 0:
            report.notes.append(f"{where}: droop {preset!r} has no effect, inverter_kva is 0")


def _profiles(parsed: Parsed, report: _Report) -> None:
    known = {"load_profile": profiles.load_names(), "pv_profile": profiles.pv_names()}
    for column, names in known.items():
        for where, cells in _rows(parsed.customers, column):
            if cells[column] and cells[column] not in names:
                report.problems.append(
                    f"{where}, column {column}: {cells[column]!r} is not known; "
                    f"expected one of {', '.join(names)}, or nothing"
                )


# --- doubtful units -----------------------------------------------------------------------------


def _doubt(parsed: Parsed, report: _Report, suspicion: str, sentence: str) -> None:
    """Report a doubtful value unless feeder.toml says that it was checked."""
    if parsed.accepted(suspicion):
        report.notes.append(f"accepted: {sentence}")
    else:
        report.problems.append(f'{sentence} (if it is right: accept = ["{suspicion}"] in feeder.toml)')


def _voltage(parsed: Parsed, report: _Report) -> None:
    volt = parsed.top("voltage_volt")
    where = f"{parsed.place}, key voltage_volt"
    if volt is None:
        return
    if volt < 50:
        _doubt(parsed, report, "voltage", f"{where}: {volt:g} V looks like kilovolts; expected volts")
    for pair in (380.0, 400.0, 415.0):
        if abs(volt - pair) < 0.5:
            _doubt(
                parsed,
                report,
                "voltage",
                f"{where}: {volt:g} V looks like a phase-to-phase voltage; "
                f"expected phase to neutral, {pair / math.sqrt(3):.2f}",
            )


# Resistance and reactance per km of the low-voltage lines that grid data sets use most (VDE cable
# tables; pandapower's standard types). A column full of them is a column per km, not per line.
PER_KM = (
    (0.642, 0.083), (0.6417, 0.0848), (0.225, 0.08), (0.2067, 0.0804), (0.208, 0.08), (0.868, 0.086),
    (0.443, 0.069), (0.868, 0.079), (1.2, 0.088), (0.32, 0.08), (0.253, 0.08), (0.164, 0.08), (0.125, 0.08),
    (1.15, 0.08), (0.524, 0.08), (0.5939, 0.372), (1.4824, 0.4),
)  # fmt: skip


def _per_km(r: float, x: float) -> bool:
    return any(abs(r - a) <= 0.005 * a and abs(x - b) <= 0.02 * b for a, b in PER_KM)


def _line_units(parsed: Parsed, report: _Report) -> None:
    volt = parsed.top("voltage_volt")
    low = volt is not None and volt < LOW_VOLTAGE
    largest = 5.0 if low else 100.0
    doubt: Callable[[str, str], None] = lambda suspicion, text: _doubt(parsed, report, suspicion, text)  # noqa: E731
    per_km, counted = 0, 0
    for where, cells in _rows(parsed.lines, "r_ohm", "x_ohm"):
        r, x = cells["r_ohm"], cells["x_ohm"]
        if r == 0 and x == 0:
            continue
        counted += 1
        per_km += _per_km(r, x)
        for name, value in (("r_ohm", r), ("x_ohm", x)):
            if volt is not None and value > largest:
                doubt(
                    "impedance", f"{where}, column {name}: {value:g} ohm is very large; in milliohm, perhaps?"
                )
        if x > 20 * r:
            doubt(
                "ratio", f"{where}: x_ohm {x:g} is more than 20 times r_ohm {r:g}; columns or units mixed up?"
            )
        elif 0 < x < 0.005 * r:
            doubt(
                "ratio",
                f"{where}: r_ohm {r:g} is more than 200 times x_ohm {x:g}; columns or units mixed up?",
            )
    if low and counted >= 2 and per_km == counted:
        place = parsed.lines[0].where.partition(",")[0] if parsed.lines else ""
        doubt(
            "impedance",
            f"{place}, columns r_ohm and x_ohm: every row holds a standard cable's values per kilometre; "
            "expected those of the whole line",
        )
    for where, cells in _rows(parsed.lines, "rating_a"):
        rating = cells["rating_a"]
        if rating is not None and rating < 1.0:
            doubt("rating", f"{where}, column rating_a: {rating:g} A is very small; in kA, perhaps?")
    for where, cells in _rows(parsed.lines, "b_us"):
        if cells["b_us"] > 1e5:
            doubt("impedance", f"{where}, column b_us: {cells['b_us']:g} microsiemens is very large; in nS?")
    for where, cells in _rows(parsed.lines, "tap"):
        if not 0.5 <= cells["tap"] <= 2.0:
            doubt("ratio", f"{where}, column tap: {cells['tap']:g} is no ratio near 1; 5 % up is 1.05")


def _customer_units(parsed: Parsed, report: _Report) -> None:
    volt = parsed.top("voltage_volt")
    largest = 1000.0 if volt is not None and volt < LOW_VOLTAGE else 1e5
    for column in ("load_kw", "pv_kw", "inverter_kva"):
        for where, cells in _rows(parsed.customers, column):
            if cells[column] > largest:
                _doubt(
                    parsed,
                    report,
                    "load",
                    f"{where}, column {column}: {cells[column]:g} is very large; in W or VA?",
                )
    meters = {} if parsed.meta is None else parsed.meta["meters"]
    places = [(f"{parsed.place}, [meters], key class_percent", meters.get("class_percent"))]
    places.append((f"{parsed.place}, key busbar_class_percent", parsed.top("busbar_class_percent")))
    places += [
        (f"{where}, column class_percent", cells["class_percent"])
        for where, cells in _rows(parsed.customers, "class_percent")
    ]
    for where, value in places:
        if value is not None and not 0.02 <= value <= 10.0:
            hint = "a fraction instead of percent?" if value < 0.02 else "no voltage meter is that bad"
            _doubt(parsed, report, "class", f"{where}: {value:g} % is doubtful; {hint}")


# --- the graph ----------------------------------------------------------------------------------


def _graph(parsed: Parsed, report: _Report) -> None:
    busbar = parsed.top("busbar")
    if parsed.lines is None:
        return
    known: dict[str, None] = {} if busbar is None else {busbar: None}
    edges: list[Edge] = []
    ends = ("line", "from_bus", "to_bus", "closed")
    for where, cells in _rows(parsed.lines, "from_bus", "to_bus"):
        known.update({cells["from_bus"]: None, cells["to_bus"]: None})
        if cells["from_bus"] == cells["to_bus"]:
            report.problems.append(
                f"{where}: from_bus and to_bus are both {cells['to_bus']!r}; a line needs two buses"
            )
        elif all(key in cells for key in ends) and cells["closed"]:
            zero = cells.get("r_ohm") == 0 and cells.get("x_ohm") == 0
            edges.append(Edge(cells["line"], cells["from_bus"], cells["to_bus"], zero))
    whole = all("from_bus" in r.cells and "to_bus" in r.cells for r in parsed.lines)
    if whole and busbar is not None:
        for where, cells in _rows(parsed.customers, "bus"):
            if cells["bus"] not in known:
                report.problems.append(
                    f"{where}, column bus: {cells['bus']!r} is not known; no line leads there and it is not the busbar"
                )
        if not any(busbar in (e.from_bus, e.to_bus) for e in edges):
            report.problems.append(f"{parsed.place}, key busbar: no closed line is connected to {busbar!r}")
    _positions(parsed, report)
    found = tree(busbar if busbar is not None else next(iter(known), ""), edges, known)
    _loops(found, edges, report)
    if whole and busbar is not None and all("closed" in r.cells and "line" in r.cells for r in parsed.lines):
        _islands(found, parsed, report)
    _fused(found, report)


def _loops(found: Tree, edges: list[Edge], report: _Report) -> None:
    for loop in found.loops:
        names = _some([edges[k].line for k in loop])
        if len(loop) == 1:
            report.problems.append(
                f"lines: {names} is short-circuited: its two buses are also joined by a line without impedance; "
                "set closed to false on one of them"
            )
        else:
            report.problems.append(
                f"lines: {names} form a loop; the feeder must be radial: set closed to false on one of them "
                "(or merge parallel lines into one row)"
            )


def _islands(found: Tree, parsed: Parsed, report: _Report) -> None:
    loads: dict[str, list[str]] = defaultdict(list)
    for _, cells in _rows(parsed.customers, "bus", "customer"):
        loads[cells["bus"]].append(cells["customer"])
    ends: dict[str, list[str]] = defaultdict(list)
    for _, cells in _rows(parsed.lines, "closed", "line", "from_bus", "to_bus"):
        if not cells["closed"]:
            ends[cells["from_bus"]].append(cells["line"])
            ends[cells["to_bus"]].append(cells["line"])
    for island in found.islands:
        customers = [customer for bus in island for customer in loads[bus]]
        ties = list(dict.fromkeys(line for bus in island for line in ends[bus]))
        text = (
            f"lines: no closed line connects {'bus' if len(island) == 1 else 'buses'} {_some(list(island))}"
        )
        text += f" (with {_some(customers)})" if customers else ""
        text += f" to the busbar {parsed.top('busbar')!r}"
        text += f"; open here: {_some(ties)}" if ties else ""
        report.problems.append(text)


def _fused(found: Tree, report: _Report) -> None:
    members: dict[int, list[str]] = defaultdict(list)
    for bus, index in found.group.items():
        members[index].append(bus)
    for buses in members.values():
        if len(buses) > 1:
            report.notes.append(f"buses {_some(buses)} are one: lines without impedance join them")


def _positions(parsed: Parsed, report: _Report) -> None:
    for where, cells in _rows(parsed.lines, "to_x", "to_y"):
        if (cells["to_x"] is None) != (cells["to_y"] is None):
            report.problems.append(
                f"{where}, columns to_x and to_y: one of them is missing; expected both or none"
            )
