"""pandapower net as a network: tables, lines, switches, transformers, power flow."""

from __future__ import annotations

import copy
import json
import math
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from importlib.metadata import version
from numbers import Real
from typing import Any, Final

import numpy as np

from feeders.convert.customers import Draw, as_it_stands, in_star, rounded
from feeders.convert.lines import ALL, by_sequence, charging_cells
from feeders.convert.provenance import ConversionChange
from feeders.convert.source import IN_STAR, MEASURE, OFF, SourceNetwork
from feeders.convert.transformers import TwoPort, coupling_of
from feeders.format.tables import LineRow
from feeders.format.validation import same_level
from gridsec.arrays import Phasors
from gridsec.errors import FeederInvalid, Problem
from gridsec.grid.three_phase import ROTATION

# Tables that are carried over, or reported one by one; every row of another table in the feeder is reported.
CARRIED: Final = {
    "bus", "line", "load", "asymmetric_load", "asymmetric_sgen", "sgen", "switch", "trafo", "trafo3w",
    "ext_grid", "gen", "storage", "motor", "ward", "xward", "shunt", "impedance",
}  # fmt: skip

COLUMNS: Final = {
    "bus": "name vn_kv in_service",
    "line": "name from_bus to_bus length_km r_ohm_per_km x_ohm_per_km c_nf_per_km g_us_per_km max_i_ka df "
    "parallel in_service",
    "switch": "name bus element et closed",
    "load": "name bus p_mw q_mvar scaling in_service",
    "asymmetric_load": "name bus p_a_mw p_b_mw p_c_mw q_a_mvar q_b_mvar q_c_mvar scaling in_service",
    "sgen": "name bus p_mw q_mvar sn_mva scaling in_service",
    "asymmetric_sgen": "name bus p_a_mw p_b_mw p_c_mw q_a_mvar q_b_mvar q_c_mvar scaling in_service",
    "ext_grid": "bus in_service",
    "trafo": "name hv_bus lv_bus in_service",
    "trafo3w": "name hv_bus mv_bus lv_bus in_service",
    "shunt": "name bus p_mw q_mvar vn_kv step in_service",
}
"""Required columns of a net's tables."""

LEAST: Final = {"a number": -math.inf, "at least 0": 0.0, "at least 1": 1.0, "above 0": math.ulp(0.0)}
"""Smallest value of a number, by its description."""

POWERS: Final = dict.fromkeys(("p_mw", "q_mvar", "scaling"), "a number")
PHASE_POWERS: Final = dict.fromkeys(
    (
        "scaling",
        *(f"{part}_{phase}_{unit}" for part, unit in (("p", "mw"), ("q", "mvar")) for phase in "abc"),
    ),
    "a number",
)

NUMBERS: Final = {
    "bus": {"vn_kv": "above 0"},
    "line": {
        **dict.fromkeys(("length_km", "r_ohm_per_km", "x_ohm_per_km", "c_nf_per_km"), "at least 0"),
        "parallel": "at least 1",
    },
    "load": POWERS,
    "sgen": POWERS,
    "asymmetric_load": PHASE_POWERS,
    "asymmetric_sgen": PHASE_POWERS,
    "shunt": {**dict.fromkeys(("p_mw", "q_mvar", "step"), "a number"), "vn_kv": "above 0"},
}
"""Required numbers of a row, and their ranges."""

TRUTHS: Final = ("in_service", "closed")
"""Columns of truth values, in every table."""


def ids(table: Any, noun: str, taken: Iterable[str] = ()) -> dict[int, str]:
    """Id of each row: the source's name if unique, otherwise the name or noun with its index.

    `taken` are names in use elsewhere.
    """
    given = {int(i): _clean(name) for i, name in zip(table.index, table["name"], strict=True)}
    count = Counter([*given.values(), *taken])
    found: dict[int, str] = {}
    for i, name in given.items():
        own = name if name and count[name] == 1 else f"{name or noun}-{i}"
        while own != name and count[own]:
            own += "'"
        found[i] = own
        count[own] += own != name
    return found


def _clean(name: object) -> str:
    text = "" if name is None or name != name else str(name)  # noqa: PLR0124  # NaN is the table's None
    return "".join(c if c.isprintable() else " " for c in text).strip()[:100]


def problems_of(net: Any) -> list[Problem]:
    """All problems of a net's tables."""
    missing = [
        Problem("missing", f"the table {table!r} is missing")
        for table in COLUMNS
        if not hasattr(net.get(table), "columns")
    ]
    if missing:
        return missing
    problems = [
        Problem("missing", f"{table}: the column {column!r} is missing")
        for table, columns in COLUMNS.items()
        for column in columns.split()
        if column not in net[table].columns
    ]
    if problems:
        return problems
    for table, columns in COLUMNS.items():
        ends = [name for name in columns.split() if name == "bus" or name.endswith("_bus")]
        for column in ends:
            strange = net[table].index[~net[table][column].isin(net.bus.index)]
            problems += [
                Problem("unknown-index", f"{table} {i}: {column} {net[table].at[i, column]} is not a bus")
                for i in strange
            ]
    for kind, table in (("b", "bus"), ("l", "line")):
        given = net.switch[net.switch.et == kind]
        strange = given.index[~given.element.isin(net[table].index)]
        problems += [
            Problem("unknown-index", f"switch {i}: element {net.switch.at[i, 'element']} is not a {table}")
            for i in strange
        ]
    return [*problems, *_numbers(net)]


def _numbers(net: Any) -> Iterator[Problem]:
    """Cells that are not numbers or truth values of the valid range."""
    if not isinstance(net.get("f_hz"), Real) or not 0.0 < net.f_hz < math.inf:
        yield Problem("not-positive", f"f_hz is {net.get('f_hz')}; expected a frequency")
    for table, columns in NUMBERS.items():
        for column, wanted in columns.items():
            values = np.asarray([number(cell) for cell in net[table][column]], dtype=np.float64)
            bad = net[table].index[~((values >= LEAST[wanted]) & np.isfinite(values))]
            for i in bad:
                yield Problem(
                    "out-of-range", f"{table} {i}: {column} is {net[table].at[i, column]}; expected {wanted}"
                )
    for table, column in _truths(net):
        for i, cell in net[table][column].items():
            if not _is_truth(cell):
                yield Problem("wrong-type", f"{table} {i}: {column} is {cell}; expected true or false")


def with_truths(net: Any) -> Any:
    """Net with truth values in place of 0 and 1, as pandapower itself reads them; the net is not changed."""
    numeric = [
        (table, column)
        for table, column in _truths(net)
        if net[table][column].dtype != bool and all(map(_is_truth, net[table][column]))
    ]
    if numeric:
        net = copy.deepcopy(net)
    for table, column in numeric:
        net[table][column] = net[table][column].astype(bool)
    return net


def _truths(net: Any) -> Iterator[tuple[str, str]]:
    for table in sorted(CARRIED):
        for column in TRUTHS:
            if column in getattr(net.get(table), "columns", ()):
                yield table, column


def _is_truth(cell: object) -> bool:
    return number(cell) in (0.0, 1.0)


def number(cell: object) -> float:
    """Number of a cell; NaN without one."""
    return float(cell) if isinstance(cell, Real | np.bool_) else math.nan


CONNECTED: Final = ("load", "sgen", "asymmetric_load", "asymmetric_sgen")
CONNECTIONS: Final = ("wye", "delta")
"""Tables with connections in star or between phases, and the names of their types."""

BASE_MVA: Final = 0.1
"""Base power of three-phase power flows, MVA: pandapower ends them at a mismatch of 3e-8 pu of it."""


def unbalanced(net: Any) -> bool:
    """True for a net with loads or generators of single phases."""
    return any(
        len(net[table]) and net[table].in_service.any() for table in ("asymmetric_load", "asymmetric_sgen")
    )


def solve(net: Any, buses: dict[int, str], network: SourceNetwork) -> Any:
    """Run the net's own power flow; the solved copy, or None with the reason in the network.

    The network receives the voltages; `buses` are the ids of its buses.
    """
    import pandapower

    solved = copy.deepcopy(net)
    dependent = [
        column for column in net.load.columns if column.startswith("const_") and (net.load[column] > 0).any()
    ]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if unbalanced(net):
                _named_connections(solved, network)
                _three_phases(solved)
            else:
                if dependent:
                    pandapower.runpp(solved, numba=False, tolerance_mva=1e-10)
                    network.as_found = _volts(solved, buses)
                pandapower.runpp(solved, numba=False, tolerance_mva=1e-10, voltage_depend_loads=False)
        volts = _volts(solved, buses)
    except Exception as error:  # noqa: BLE001  # external solvers may raise anything
        text = " ".join(str(error).split()) or type(error).__name__
        network.unsolved = f"pandapower's own power flow fails: {text[:200]}"
        return None
    if not any(np.isfinite(v).all() for v in volts.values()):
        network.as_found, network.unsolved = {}, "pandapower's own power flow gives no voltages, NaN only"
        return None
    network.volts = volts
    return solved


def _three_phases(solved: Any) -> None:
    """Solve in three phases; if lines to buses out of service make every voltage NaN, without these lines."""
    import pandapower

    solved.sn_mva = BASE_MVA
    pandapower.runpp_3ph(solved, numba=False, tolerance_mva=1e-11)
    dead = solved.bus.index[~solved.bus.in_service.astype(bool)]
    ending = solved.line.from_bus.isin(dead) | solved.line.to_bus.isin(dead)
    if ending.any() and solved.res_bus_3ph.vm_a_pu.isna().all():
        solved.line.loc[ending, "in_service"] = False
        pandapower.runpp_3ph(solved, numba=False, tolerance_mva=1e-11)


def _named_connections(solved: Any, network: SourceNetwork) -> None:
    """Set unknown connection types to star: pandapower ignores such rows."""
    for table in CONNECTED:
        others = ~solved[table].type.isin(CONNECTIONS)
        if others.any():
            solved[table].loc[others, "type"] = "wye"
            effect = "in star; pandapower's own three-phase power flow ignores other types"
            network.changes.note(f"{others.sum()} {table}(s)", "type", "changed", effect)


def _volts(net: Any, buses: dict[int, str]) -> dict[str, Phasors]:
    base = net.bus.vn_kv.to_numpy()[:, None] * 1000.0 / math.sqrt(3.0)
    if unbalanced(net):
        found = net.res_bus_3ph.loc[net.bus.index]
        size = found[[f"vm_{phase}_pu" for phase in "abc"]].to_numpy()
        angle = found[[f"va_{phase}_degree" for phase in "abc"]].to_numpy()
        v = base * size * np.exp(1j * np.deg2rad(angle))
    else:
        found = net.res_bus.loc[net.bus.index]
        one = found.vm_pu.to_numpy() * np.exp(1j * np.deg2rad(found.va_degree.to_numpy()))
        v = base * one[:, None] * ROTATION
    return {buses[int(i)]: row for i, row in zip(net.bus.index, v, strict=True)}


def _flow(solved: Any, table: str, index: int, side: str) -> Phasors:
    """Power into an element, by phase, kVA."""
    tail = f"_{side}" if side else ""
    if unbalanced(solved):
        row = solved[f"res_{table}_3ph"].loc[index]
        s = [complex(row[f"p_{phase}{tail}_mw"], row[f"q_{phase}{tail}_mvar"]) for phase in "abc"]
        return np.asarray(np.array(s) * 1e3, dtype=np.complex128)
    row = solved[f"res_{table}"].loc[index]
    return np.full(3, complex(row[f"p{tail}_mw"], row[f"q{tail}_mvar"]) * 1e3 / 3.0)


def flow_into(solved: Any, table: str, index: int, side: str) -> Phasors:
    """Power into an element, by phase, kVA; NaN if unknown.

    `solved` is the solved net or None; `side` is the end, as in result columns, empty for a single end.
    """
    unknown: Phasors = np.full(3, np.nan, dtype=np.complex128)
    if solved is None:
        return unknown
    try:
        return _flow(solved, table, index, side)
    except KeyError:  # not every table has results in three phases
        return unknown


def between_phases(net: Any, row: Any) -> bool:
    """True for a load or generator between phases in a three-phase power flow."""
    return row.get("type") == "delta" and unbalanced(net)


def phase_powers(
    net: Any, row: Any, label: str, volts: Phasors | None
) -> tuple[Phasors, list[ConversionChange]]:
    """Powers of a load from each phase, or of a generator into it, (3,), kVA, and approximations.

    A row of all three phases has a third in each. `volts` (3,) are those at its bus by pandapower's power
    flow, V; None without one.
    """
    scale = 1e3 * float(row.scaling) * float(row.in_service)
    if "p_mw" in row:
        given = [complex(row.p_mw, row.q_mvar) / 3.0] * 3
    else:
        given = [complex(row[f"p_{phase}_mw"], row[f"q_{phase}_mvar"]) for phase in "abc"]
    power: Phasors = scale * np.array(given, dtype=np.complex128)
    if not between_phases(net, row):
        return power, []
    known = volts is not None and bool(np.isfinite(volts).all())
    change = ConversionChange(label, "delta", "approximated", IN_STAR)
    return in_star(power, volts if known and volts is not None else ROTATION), [change]


FIXED: Final = {"gen": -1.0, "storage": 1.0, "motor": 1.0, "ward": 1.0, "xward": 1.0}
"""Tables of elements that become customers with the source's power, and the sign of their results."""

MONEY: Final = "prices change no voltage"
DIRECT: Final = "direct current; left out with its converters"
NOTED: Final = {
    "measurement": MEASURE,
    "controller": "taps and set points as in the file",
    "group": "names of sets; their elements are converted one by one",
    "poly_cost": MONEY,
    "pwl_cost": MONEY,
    "bus_dc": DIRECT,
    "line_dc": DIRECT,
    "load_dc": DIRECT,
    "source_dc": DIRECT,
    "loadcases": "the loads are those of the net's own tables",
}
"""Tables without a place in the network, and their replacement in a feeder."""

CURVES: Final = ("characteristic", "capability", "_table", "_spline")
"""Parts of the names of lookup tables; their values in force are carried over."""

UNLIMITED_KA: Final = 1000.0
SWITCH_RX: Final = 2.0
"""R / X of the impedance of switches between buses, the default of pandapower's power flow."""

SHUNTS: Final = ("gf_pu", "bf_pu", "gt_pu", "bt_pu")
"""Shunts at the two ends of an impedance."""

SIDES: Final = {"trafo": ("hv", "lv"), "trafo3w": ("hv", "mv", "lv")}


def read_net(net: Any, network: SourceNetwork) -> None:
    """Fill a network from a net, without loads and static generators; the net is not changed.

    Raises FeederInvalid with all problems of its tables.
    """
    problems = problems_of(net)
    if problems:
        raise FeederInvalid(problems)
    buses = ids(net.bus, "bus")
    dead = _dead(net)
    feeds = net.ext_grid.bus[net.ext_grid.in_service.astype(bool) & ~net.ext_grid.bus.isin(dead)]
    network.tool = f"pandapower {version('pandapower')}"
    network.sources = list(dict.fromkeys(buses[int(bus)] for bus in feeds))
    network.nominal = {buses[int(i)]: float(kv) * 1000.0 / math.sqrt(3.0) for i, kv in net.bus.vn_kv.items()}
    network.xy = {buses[int(i)]: place for i in net.bus.index if (place := _place(net, int(i))) is not None}
    for bus in sorted(dead):
        network.leave_out(f"bus {buses[bus]}", "out of service in the source")
    _lines(net, buses, network)
    _switches(net, buses, network)
    _impedances(net, buses, network)
    solved = solve(net, buses, network)
    _transformers(net, solved, buses, network)
    _fixed(net, solved, buses, network)
    _shunts(net, buses, network)
    _rest(net, buses, network)
    _connections(net, buses, network)


def _dead(net: Any) -> set[int]:
    """Buses out of service: every element that ends there is open."""
    return {int(bus) for bus in net.bus.index[~net.bus.in_service.astype(bool)]}


def _place(net: Any, bus: int) -> tuple[float, float] | None:
    geo = net.bus.at[bus, "geo"] if "geo" in net.bus.columns else None
    if not isinstance(geo, str):
        return None
    try:
        x, y = json.loads(geo)["coordinates"][:2]
        return round(float(x), 6), round(float(y), 6)
    except (ValueError, TypeError, KeyError):  # a bus without a position leaves the network unchanged
        return None


# --- lines and switches -------------------------------------------------------------------------


def _lines(net: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    names = ids(net.line, "line")
    opened = _opened(net, "l")
    dead = _dead(net)
    omega = 2.0 * math.pi * float(net.f_hz)
    for i, row in zip(map(int, net.line.index), net.line.to_dict("records"), strict=True):
        length, parallel = float(row["length_km"]), float(row["parallel"])
        limit = float(row["max_i_ka"]) * float(row["df"]) * parallel
        ends = int(row["from_bus"]), int(row["to_bus"])
        siemens = [
            1e-9 * omega * length * parallel * float(row.get(f"c{k}_nf_per_km", math.nan)) for k in ("", "0")
        ]
        on = [bus for bus in ends if (i, bus) not in opened and bus not in dead and row["in_service"]]
        closed = len(on) == 2
        if row["g_us_per_km"] > 0 and closed:
            effect = f"{row['g_us_per_km'] * length * parallel:.3g} microsiemens"
            network.note_at(buses[ends[0]], f"line {names[i]}", "shunt conductance", "left out", effect)
        made = LineRow(
            line=names[i],
            from_bus=buses[ends[0]],
            to_bus=buses[ends[1]],
            r_ohm=rounded(float(row["r_ohm_per_km"]) * length / parallel),
            x_ohm=rounded(float(row["x_ohm_per_km"]) * length / parallel),
            r0_ohm=_zero_sequence(row, "r0_ohm_per_km", length / parallel),
            x0_ohm=_zero_sequence(row, "x0_ohm_per_km", length / parallel),
            **charging_cells(names[i], ALL, by_sequence(*siemens), network.changes),
            closed=closed,
            rating_a=rounded(limit * 1000.0) if 0.0 < limit < UNLIMITED_KA else None,
        )
        network.add_line(made, [buses[bus] for bus in on])


def _opened(net: Any, kind: str) -> set[tuple[int, int]]:
    """Elements of a kind, each with a bus at which a switch disconnects it."""
    switches = net.switch[(net.switch.et == kind) & ~net.switch.closed.astype(bool)]
    return {(int(element), int(bus)) for element, bus in zip(switches.element, switches.bus, strict=True)}


def _zero_sequence(row: dict[str, Any], column: str, factor: float) -> float | None:
    value = float(row.get(column, math.nan))
    return rounded(value * factor) if math.isfinite(value) else None


def _switches(net: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    names, dead = _switch_names(net), _dead(net)
    for i in map(int, net.switch.index):
        row = net.switch.loc[i]
        if row.et == "b":
            ends = int(row.bus), int(row.element)
            ohm = float(row.z_ohm) if "z_ohm" in row and row.z_ohm > 0 else 0.0
            r, x = (rounded(ohm * part / math.hypot(1.0, SWITCH_RX)) for part in (SWITCH_RX, 1.0))
            made = LineRow(names[i], buses[ends[0]], buses[ends[1]], r, x)
            zero = (r, x) if ohm else (None, None)  # three conductors without coupling
            closed = bool(row.closed) and dead.isdisjoint(ends)
            if ohm and closed and unbalanced(net):
                effect = "as in the table; pandapower's own three-phase power flow takes a third of it"
                network.note_at(buses[ends[0]], f"switch {names[i]}", "impedance", "changed", effect)
            network.lines.append(replace(made, r0_ohm=zero[0], x0_ohm=zero[1], closed=closed))


def _switch_names(net: Any) -> dict[int, str]:
    return ids(net.switch, "switch", ids(net.line, "line").values())


def _impedances(net: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    """Impedances between buses: lines, if equal from both ends and without shunts."""
    table = net.get("impedance")
    if table is None or not len(table):
        return
    names = ids(table, "impedance", [*ids(net.line, "line").values(), *_switch_names(net).values()])
    dead = _dead(net)
    for i, row in zip(map(int, table.index), table.to_dict("records"), strict=True):
        ends = int(row["from_bus"]), int(row["to_bus"])
        a, b = (buses[bus] for bus in ends)
        (r, x), back = _series(row, "ft"), _series(row, "tf")
        plain = (r, x) == back and min(r, x) >= 0 and not any(row.get(name) for name in SHUNTS)
        if not (plain and same_level(network.nominal[a], network.nominal[b])):
            effect = "asymmetric, or with shunts; has no place in a feeder"
            network.leave_out(f"impedance {names[i]}", effect, a, b)
            continue
        ohm = float(net.bus.at[ends[0], "vn_kv"]) ** 2 / float(row["sn_mva"])
        r, x, r0, x0 = (ohm * value for value in (r, x, *_series(row, "ft0")))
        made = LineRow(names[i], a, b, rounded(r), rounded(x))
        made = replace(made, closed=bool(row["in_service"]) and dead.isdisjoint(ends))
        known = math.isfinite(r0) and math.isfinite(x0) and _series(row, "tf0") == _series(row, "ft0")
        network.lines.append(replace(made, r0_ohm=rounded(r0), x0_ohm=rounded(x0)) if known else made)


def _series(row: dict[str, Any], way: str) -> tuple[float, float]:
    """R and X of an impedance, pu of its own base; NaN if unknown."""
    r, x = (number(row.get(f"{part}{way}_pu")) for part in "rx")
    return r, x


# --- transformers ---------------------------------------------------------------------------------


def _transformers(net: Any, solved: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    ports, dead = _two_ports(net), _dead(net)
    for table, sides in SIDES.items():
        names = ids(net[table], table)
        opened = _opened(net, "t" if table == "trafo" else "t3")
        for i, row in net[table].iterrows():
            ends = [(side, int(row[f"{side}_bus"])) for side in sides]
            ends = [(side, bus) for side, bus in ends if (int(i), bus) not in opened and bus not in dead]
            label = f"{'transformer' if table == 'trafo' else 'three-winding transformer'} {names[int(i)]}"
            if not row.in_service or len(ends) < 2:
                network.leave_out(label, OFF)
                continue
            joined = tuple(buses[bus] for _, bus in ends)
            flows = tuple(flow_into(solved, table, int(i), side) for side, _ in ends)
            port, limit = (ports.get(int(i)), _rating(row)) if table == "trafo" else (None, math.nan)
            made = coupling_of(label, joined, flows, port=port, rating_a=limit, network=network)
            network.couplings.append(made)


def _rating(row: Any) -> float:
    """Rated current of a transformer's lower side, A."""
    return float(row.sn_mva) * float(row.parallel) * 1e3 / (math.sqrt(3.0) * float(row.vn_lv_kv))


def _two_ports(net: Any) -> dict[int, TwoPort]:
    """Two-ports of the transformers of two windings, each alone: without load, and with a load.

    Empty for a net without a balanced power flow, and for tables that pandapower does not accept.
    """
    import pandapower

    own = net.trafo[net.trafo.in_service.astype(bool)]
    if unbalanced(net) or not len(own):
        return {}
    bench = pandapower.create_empty_network(f_hz=float(net.f_hz), sn_mva=float(net.sn_mva))
    for k, ends in enumerate(zip(own.hv_bus, own.lv_bus, strict=True)):
        for end in ends:
            pandapower.create_bus(bench, float(net.bus.at[end, "vn_kv"]))
        pandapower.create_ext_grid(bench, 2 * k)
        pandapower.create_shunt(bench, 2 * k + 1, 0.0, float(own.sn_mva.iloc[k]), in_service=False)
    bench.trafo = own.assign(hv_bus=2 * np.arange(len(own)), lv_bus=2 * np.arange(len(own)) + 1)
    if "trafo_characteristic_table" in net:
        bench.trafo_characteristic_table = net.trafo_characteristic_table
    try:
        found = [_alone(bench, loaded=loaded) for loaded in (False, True)]
    except Exception:  # noqa: BLE001  # external solvers may raise anything
        return {}
    return TwoPort.measured(own.index, *found)


def _alone(bench: Any, *, loaded: bool) -> tuple[Phasors, Phasors]:
    """Voltages at both ends of each transformer, (n, 2), V, and the current out of it, (n,), A."""
    import pandapower

    bench.shunt["in_service"] = loaded
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pandapower.runpp(bench, numba=False, init="dc", calculate_voltage_angles=True, tolerance_mva=1e-11)
    rated = bench.bus.vn_kv.to_numpy() * 1e3 / math.sqrt(3.0)
    angle = np.deg2rad(bench.res_bus.va_degree.to_numpy())
    v = (rated * bench.res_bus.vm_pu.to_numpy() * np.exp(1j * angle)).reshape(-1, 2)
    power = 1e6 * (bench.res_trafo.p_lv_mw + 1j * bench.res_trafo.q_lv_mvar).to_numpy()
    return v, -np.conj(power / 3.0 / v[:, 1])


def _fixed(net: Any, solved: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    """Elements with a control of their own become customers with the source's power."""
    for table, sign in FIXED.items():
        names = ids(net[table], table)
        for i in map(int, net[table].index):
            bus, label = buses[int(net[table].at[i, "bus"])], f"{table} {names[i]}"
            power = sign * flow_into(solved, table, i, "")
            if not np.isfinite(power).all():
                effect = (
                    "its power is not known; the check shows the effect" if solved is not None else "unknown"
                )
                network.leave_out(label, effect, bus)
                network.connected.append((bus, label))
                continue
            plant = table == "gen" and power.real.sum() < 0
            network.draws.append(Draw(label, bus, power, rating_kva=0.0 if plant else None, noun="customer"))
            network.note_at(bus, label, "control", "changed", as_it_stands(power))
    for table in ("asymmetric_sgen", "sgen"):
        names = ids(net[table], table)
        for i, row in net[table].iterrows():
            if table == "asymmetric_sgen" or between_phases(net, row):
                power, told = phase_powers(
                    net, row, f"generator {names[i]}", network.volts.get(buses[row.bus])
                )
                draw = Draw(names[i], buses[row.bus], -power, even=False, rating_kva=0.0)
                network.draws.append(draw)
                network.of_bus.extend((draw.bus, change) for change in told)


def _connections(net: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    """Buses and labels of the customers of `feeders.convert.from_pandapower`."""
    loads = ids(net.load, "load")
    for table, noun, label in (
        ("load", "load", "load"),
        ("asymmetric_load", "phase load", "load"),
        ("sgen", "generator", "generator"),
    ):
        names = loads if table == "load" else ids(net[table], noun, loads.values())
        known = [(i, int(bus)) for i, bus in net[table].bus.items()]
        network.connected.extend((buses[bus], f"{label} {names[int(i)]}") for i, bus in known)


def _shunts(net: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    """Capacitors become the charging of lines to nowhere."""
    names = ids(net.shunt, "shunt")
    for i in map(int, net.shunt.index):
        row = net.shunt.loc[i]
        bus, label = buses[int(row.bus)], f"shunt {names[i]}"
        if not row.in_service:
            network.leave_out(label, OFF, bus)
            continue
        p, q = _at_its_step(net, row)
        if p == q == 0.0:
            network.leave_out(label, "draws nothing at its step", bus)
        if p != 0:
            network.note_at(bus, label, "conductance", "left out", f"{1e3 * p:.4g} kW")
        if q > 0:
            network.note_at(bus, label, "inductance", "left out", f"{1e3 * q:.4g} kvar")
        elif q < 0:
            network.add_capacitor(label, bus, -q / float(row.vn_kv) ** 2, -1e3 * q)


def _at_its_step(net: Any, row: Any) -> tuple[float, float]:
    """Powers of a shunt at nominal voltage, MW and Mvar: by the number of steps, or by a table."""
    by_table = row.get("step_dependency_table")  # NaN in files of older versions
    if isinstance(by_table, bool | np.bool_) and by_table and "shunt_characteristic_table" in net:
        table = net.shunt_characteristic_table
        hits = table[(table.id_characteristic == row.id_characteristic_table) & (table.step == row.step)]
        return float(hits.p_mw.sum()), float(hits.q_mvar.sum())
    return float(row.p_mw) * float(row.step), float(row.q_mvar) * float(row.step)


def _rest(net: Any, buses: dict[int, str], network: SourceNetwork) -> None:
    """Report every other table with rows: the format has no place for it."""
    for i, row in net.ext_grid[~net.ext_grid.in_service.astype(bool)].iterrows():
        network.leave_out(f"ext_grid {i}", OFF, buses[int(row.bus)])
    for table in sorted(net.keys()):
        content = net[table]
        if table in CARRIED or not hasattr(content, "columns") or table.startswith(("res_", "_")):
            continue
        ends = [column for column in ("bus", "from_bus", "to_bus") if column in content.columns]
        if table in NOTED or not ends:
            effect = NOTED.get(table, "has no place in a feeder")
            if len(content) and not any(part in table for part in CURVES):
                label = f"table {table}, {len(content)} row{'s' if len(content) > 1 else ''}"
                network.leave_out(label, effect)
            continue
        for i, row in content.iterrows():
            known = [buses[int(row[end])] for end in ends if row[end] in buses]
            for bus in known:
                network.leave_out(f"{table} {i}", "has no place in a feeder", bus)
