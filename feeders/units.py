"""Doubtful units: values that are numbers, but hardly in the unit of their column.

Each doubt has a name; `accept = ["<name>"]` in feeder.toml says that the value was checked and is right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from feeders.levels import nominal_volts
from feeders.records import Parsed, Report, rows
from feeders.topology import Edge, Tree
from gridsec.errors import Problem

LOW_VOLTAGE = 1000.0
# Nominal voltages between phases; nobody's voltage to neutral is called like that.
PHASE_TO_PHASE = (
    380.0, 400.0, 415.0, 3300.0, 6000.0, 6600.0, 10000.0, 11000.0, 12470.0, 12660.0, 13200.0, 13800.0,
    15000.0, 20000.0, 22000.0, 24900.0, 30000.0, 33000.0, 34500.0,
)  # fmt: skip
# Resistance and reactance per km of the low-voltage lines that grid data sets use most (VDE cable
# tables; pandapower's standard types). A column full of them is a column per km, not per line.
PER_KM = (
    (0.642, 0.083), (0.6417, 0.0848), (0.225, 0.08), (0.2067, 0.0804), (0.208, 0.08), (0.868, 0.086),
    (0.443, 0.069), (0.868, 0.079), (1.2, 0.088), (0.32, 0.08), (0.253, 0.08), (0.164, 0.08), (0.125, 0.08),
    (1.15, 0.08), (0.524, 0.08), (0.5939, 0.372), (1.4824, 0.4),
)  # fmt: skip

LINE_XR, TRANSFORMER_XR = 20.0, 100.0
"""Reactance by resistance beyond which a line, or a large transformer, has neither."""

Doubts = Iterator[tuple[str, str]]


def check(parsed: Parsed, edges: Sequence[Edge], found: Tree | None, report: Report) -> None:
    """Report every doubtful value, as a problem or, where feeder.toml accepts it, as a note.

    Parameters
    ----------
    parsed
        The tables.
    edges, found
        The closed lines and their tree, or None where the graph could not be had.
    report
        Takes the sentences.
    """
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
    for name, sentence in doubts:
        _doubt(parsed, report, name, sentence)


def _doubt(parsed: Parsed, report: Report, name: str, sentence: str) -> None:
    if parsed.accepted(name):
        report.notes.append(f"accepted: {sentence}")
    else:
        report.problems.append(
            Problem("doubtful", f'{sentence} (if it is right: accept = ["{name}"] in feeder.toml)')
        )


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
    """A line's impedance is that of its `to_bus`'s side, at the nominal voltage there."""
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
                yield "ratio", f"{where}, column {name}: {cells[name]:g} is no ratio near 1; 5 % up is 0.95"


def _powers(parsed: Parsed, level: Mapping[str, float], volt: float) -> Doubts:
    for column in ("load_kw", "pv_kw", "inverter_kva"):
        for where, cells in rows(parsed.customers, column):
            largest = 1000.0 if level.get(cells.get("bus", ""), volt) < LOW_VOLTAGE else 1e5
            if cells[column] > largest:
                yield "load", f"{where}, column {column}: {cells[column]:g} is very large; in W or VA?"


def _classes(parsed: Parsed) -> Doubts:
    meters = {} if parsed.meta is None else parsed.meta["meters"]
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
    """Whether the lines could carry the loads at all: ``sum of r p / (3 V^2)`` along the worst path."""
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
