"""A pandapower net as a network: its lines, switches and transformers, and its own power flow."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from typing import Any, Final

import numpy as np

from feeders.convert_changes import WHOLE, Change
from feeders.convert_customers import rounded
from feeders.convert_draws import Draw, as_it_stands
from feeders.convert_lines import ALL, by_sequence, capacitor, charging_cells, open_end
from feeders.convert_network import Network
from feeders.convert_pandapower_flow import between_phases, flow_into, phase_powers, solve, unbalanced
from feeders.convert_pandapower_tables import CARRIED, ids, number, problems_of
from feeders.convert_two_ports import TwoPort, coupling_of
from feeders.levels import same_level
from feeders.schema import LineRow
from gridsec.errors import FeederInvalid

FIXED: Final = {"gen": -1.0, "storage": 1.0, "motor": 1.0, "ward": 1.0, "xward": 1.0}
"""Tables of what becomes a customer as the source's power flow has it, and the sign of its results."""

MEASURE: Final = "every customer has a meter of the feeder's own kind instead"
MONEY: Final = "prices change no voltage"
DIRECT: Final = "direct current; what it exchanges with the feeder is left out with its converters"
NOTED: Final = {
    "measurement": MEASURE,
    "controller": "taps and set points stand as the file has them",
    "group": "names of sets; their elements stand for themselves",
    "poly_cost": MONEY,
    "pwl_cost": MONEY,
    "bus_dc": DIRECT,
    "line_dc": DIRECT,
    "load_dc": DIRECT,
    "source_dc": DIRECT,
    "loadcases": "the loads are those of the net's own tables",
}
"""Tables without a place in the network, and what a feeder does without them."""

CURVES: Final = ("characteristic", "capability", "_table", "_spline")
"""Parts of the names of tables that other tables look values up in: those in force are carried over."""

UNLIMITED_KA: Final = 1000.0
SWITCH_RX: Final = 2.0
"""R / X of the impedance of switches between buses, which pandapower's power flow takes by itself."""

SHUNTS: Final = ("gf_pu", "bf_pu", "gt_pu", "bt_pu")
"""Shunts at the two ends of an impedance."""

SIDES: Final = {"trafo": ("hv", "lv"), "trafo3w": ("hv", "mv", "lv")}


def network_of(net: Any) -> Network:
    """Return a net as a network; its loads and static generators are left to `feeders.convert_pandapower`.

    Parameters
    ----------
    net
        A pandapower net; stays as it is.

    Raises
    ------
    FeederInvalid
        With everything that keeps its tables from being read.
    """
    problems = problems_of(net)
    if problems:
        raise FeederInvalid(problems)
    buses = ids(net.bus, "bus")
    nominal = {buses[int(i)]: float(kv) * 1000.0 / math.sqrt(3.0) for i, kv in net.bus.vn_kv.items()}
    dead = _dead(net)
    feeds = net.ext_grid.bus[net.ext_grid.in_service.astype(bool) & ~net.ext_grid.bus.isin(dead)]
    network = Network(
        f"pandapower {version('pandapower')}",
        list(dict.fromkeys(buses[int(bus)] for bus in feeds)),
        nominal,
    )
    network.xy = {buses[int(i)]: place for i in net.bus.index if (place := _place(net, int(i))) is not None}
    off = "out of service in the source"
    network.changes.extend(Change(f"bus {buses[bus]}", WHOLE, "left out", off) for bus in sorted(dead))
    network.lines = [*_line_rows(net, buses, network), *_switch_rows(net, buses, network)]
    _impedances(net, buses, network)
    solved = solve(net, buses, network)
    _transformers(net, solved, buses, network)
    _fixed(net, solved, buses, network)
    _shunts(net, buses, network)
    _rest(net, buses, network)
    _connections(net, buses, network)
    return network


def _dead(net: Any) -> set[int]:
    """Buses that are out of service: whatever ends there is open."""
    return {int(bus) for bus in net.bus.index[~net.bus.in_service.astype(bool)]}


def _place(net: Any, bus: int) -> tuple[float, float] | None:
    geo = net.bus.at[bus, "geo"] if "geo" in net.bus.columns else None
    if not isinstance(geo, str):
        return None
    try:
        x, y = json.loads(geo)["coordinates"][:2]
        return round(float(x), 6), round(float(y), 6)
    except (ValueError, TypeError, KeyError):  # a bus may have a place or none; the network is the same
        return None


# --- lines and switches -------------------------------------------------------------------------


def _line_rows(net: Any, buses: dict[int, str], network: Network) -> Iterator[LineRow]:
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
        _side_effects(row, f"line {names[i]}", buses[ends[0]], closed, network)
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
        yield made
        stub = open_end(made, buses[on[0]], network.nominal[buses[on[0]]]) if len(on) == 1 else None
        if stub is not None:
            yield stub


def _opened(net: Any, kind: str) -> set[tuple[int, int]]:
    """Elements of a kind, each with a bus at which a switch disconnects it."""
    switches = net.switch[(net.switch.et == kind) & ~net.switch.closed.astype(bool)]
    return {(int(element), int(bus)) for element, bus in zip(switches.element, switches.bus, strict=True)}


def _side_effects(row: dict[str, Any], label: str, bus: str, closed: bool, network: Network) -> None:
    """Say what a row of lines.csv cannot hold."""
    length, parallel = float(row["length_km"]), float(row["parallel"])
    if row["g_us_per_km"] > 0 and closed:
        effect = f"{row['g_us_per_km'] * length * parallel:.3g} microsiemens"
        network.of_bus.append((bus, Change(label, "shunt conductance", "left out", effect)))


def _zero_sequence(row: dict[str, Any], column: str, factor: float) -> float | None:
    value = float(row.get(column, math.nan))
    return rounded(value * factor) if math.isfinite(value) else None


def _switch_rows(net: Any, buses: dict[int, str], network: Network) -> Iterator[LineRow]:
    names, dead = _switch_names(net), _dead(net)
    for i in map(int, net.switch.index):
        row = net.switch.loc[i]
        if row.et == "b":
            ends = int(row.bus), int(row.element)
            ohm = float(row.z_ohm) if "z_ohm" in row and row.z_ohm > 0 else 0.0
            r, x = (rounded(ohm * part / math.hypot(1.0, SWITCH_RX)) for part in (SWITCH_RX, 1.0))
            made = LineRow(names[i], buses[ends[0]], buses[ends[1]], r, x)
            zero = (r, x) if ohm else (None, None)  # three conductors that know nothing of each other
            closed = bool(row.closed) and dead.isdisjoint(ends)
            if ohm and closed and unbalanced(net):
                effect = "as it stands; pandapower's own power flow of three phases takes a third of it"
                change = Change(f"switch {names[i]}", "impedance", "changed", effect)
                network.of_bus.append((buses[ends[0]], change))
            yield replace(made, r0_ohm=zero[0], x0_ohm=zero[1], closed=closed)


def _switch_names(net: Any) -> dict[int, str]:
    return ids(net.switch, "switch", ids(net.line, "line").values())


def _impedances(net: Any, buses: dict[int, str], network: Network) -> None:
    """Impedances between buses: a line, if it is the same seen from both ends and has no shunts."""
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
            effect = "its two ends are not alike, or it has shunts; has no place in a feeder"
            change = Change(f"impedance {names[i]}", WHOLE, "left out", effect)
            network.of_bus.extend((bus, change) for bus in (a, b))
            continue
        ohm = float(net.bus.at[ends[0], "vn_kv"]) ** 2 / float(row["sn_mva"])
        r, x, r0, x0 = (ohm * value for value in (r, x, *_series(row, "ft0")))
        made = LineRow(names[i], a, b, rounded(r), rounded(x))
        made = replace(made, closed=bool(row["in_service"]) and dead.isdisjoint(ends))
        known = math.isfinite(r0) and math.isfinite(x0) and _series(row, "tf0") == _series(row, "ft0")
        network.lines.append(replace(made, r0_ohm=rounded(r0), x0_ohm=rounded(x0)) if known else made)


def _series(row: dict[str, Any], way: str) -> tuple[float, float]:
    """R and X of an impedance, pu of its own base; NaN where they are not known."""
    r, x = (number(row.get(f"{part}{way}_pu")) for part in "rx")
    return r, x


# --- transformers ---------------------------------------------------------------------------------


def _transformers(net: Any, solved: Any, buses: dict[int, str], network: Network) -> None:
    ports, dead = _two_ports(net), _dead(net)
    for table, sides in SIDES.items():
        names = ids(net[table], table)
        opened = _opened(net, "t" if table == "trafo" else "t3")
        for i, row in net[table].iterrows():
            ends = [(side, int(row[f"{side}_bus"])) for side in sides]
            ends = [(side, bus) for side, bus in ends if (int(i), bus) not in opened and bus not in dead]
            label = f"{'transformer' if table == 'trafo' else 'three-winding transformer'} {names[int(i)]}"
            if not row.in_service or len(ends) < 2:
                network.changes.append(Change(label, WHOLE, "left out", "switched off in the source"))
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
    """Every transformer of two windings alone: between a source and nothing, and between a source and a load.

    A net without a balanced power flow has none, and neither has one whose tables pandapower does not take.
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
    except Exception:  # noqa: BLE001  # whatever the foreign solver raises on foreign tables
        return {}
    return {
        int(i): TwoPort.measured(idle[:2], loaded) for i, idle, loaded in zip(own.index, *found, strict=True)
    }


def _alone(bench: Any, *, loaded: bool) -> list[tuple[complex, complex, complex]]:
    """Voltages at both ends of each transformer, V, and the current out of it, A."""
    import pandapower

    bench.shunt["in_service"] = loaded
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pandapower.runpp(bench, numba=False, init="dc", calculate_voltage_angles=True, tolerance_mva=1e-11)
    rated = bench.bus.vn_kv.to_numpy() * 1e3 / math.sqrt(3.0)
    angle = np.deg2rad(bench.res_bus.va_degree.to_numpy())
    v = (rated * bench.res_bus.vm_pu.to_numpy() * np.exp(1j * angle)).reshape(-1, 2)
    power = 1e6 * (bench.res_trafo.p_lv_mw + 1j * bench.res_trafo.q_lv_mvar).to_numpy()
    current = -np.conj(power / 3.0 / v[:, 1])
    return [(complex(a), complex(b), complex(i)) for (a, b), i in zip(v, current, strict=True)]


def _fixed(net: Any, solved: Any, buses: dict[int, str], network: Network) -> None:
    """What draws or feeds in by rules of its own becomes a customer at the source's operating point."""
    for table, sign in FIXED.items():
        names = ids(net[table], table)
        for i in map(int, net[table].index):
            bus, label = buses[int(net[table].at[i, "bus"])], f"{table} {names[i]}"
            power = sign * flow_into(solved, table, i, "")
            if not np.isfinite(power).all():
                effect = (
                    "its power is not known; the check shows what that does"
                    if solved is not None
                    else "unknown"
                )
                network.of_bus.append((bus, Change(label, WHOLE, "left out", effect)))
                network.connected.append((bus, label))
                continue
            plant = table == "gen" and power.real.sum() < 0
            network.draws.append(Draw(label, bus, power, rating_kva=0.0 if plant else None, noun="customer"))
            network.of_bus.append((bus, Change(label, "control", "changed", as_it_stands(power))))
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


def _connections(net: Any, buses: dict[int, str], network: Network) -> None:
    """Whose customers `feeders.convert_pandapower` makes, by the names that it tells of them."""
    loads = ids(net.load, "load")
    for table, noun, label in (
        ("load", "load", "load"),
        ("asymmetric_load", "phase load", "load"),
        ("sgen", "generator", "generator"),
    ):
        names = loads if table == "load" else ids(net[table], noun, loads.values())
        known = [(i, int(bus)) for i, bus in net[table].bus.items()]
        network.connected.extend((buses[bus], f"{label} {names[int(i)]}") for i, bus in known)


def _shunts(net: Any, buses: dict[int, str], network: Network) -> None:
    """Capacitors become the charging of lines to nowhere."""
    names = ids(net.shunt, "shunt")
    for i in map(int, net.shunt.index):
        row = net.shunt.loc[i]
        bus, label = buses[int(row.bus)], f"shunt {names[i]}"
        if not row.in_service:
            network.of_bus.append((bus, Change(label, WHOLE, "left out", "switched off in the source")))
            continue
        p, q = _at_its_step(net, row)
        if p == q == 0.0:
            network.of_bus.append((bus, Change(label, WHOLE, "left out", "draws nothing at its step")))
        if p != 0:
            network.of_bus.append((bus, Change(label, "conductance", "left out", f"{1e3 * p:.4g} kW")))
        if q > 0:
            network.of_bus.append((bus, Change(label, "inductance", "left out", f"{1e3 * q:.4g} kvar")))
        elif q < 0:
            network.lines.append(capacitor(label, bus, -q / float(row.vn_kv) ** 2))
            effect = f"{-1e3 * q:.4g} kvar as the charging of a line to nowhere"
            network.of_bus.append((bus, Change(label, "connection", "changed", effect)))


def _at_its_step(net: Any, row: Any) -> tuple[float, float]:
    """Powers of a shunt at nominal voltage, MW and Mvar: so many steps, or what a table has for its step."""
    by_table = row.get("step_dependency_table")  # NaN in files of older versions
    if isinstance(by_table, bool | np.bool_) and by_table and "shunt_characteristic_table" in net:
        table = net.shunt_characteristic_table
        hits = table[(table.id_characteristic == row.id_characteristic_table) & (table.step == row.step)]
        return float(hits.p_mw.sum()), float(hits.q_mvar.sum())
    return float(row.p_mw) * float(row.step), float(row.q_mvar) * float(row.step)


def _rest(net: Any, buses: dict[int, str], network: Network) -> None:
    """Name every other table with rows: what is there has no place in the format."""
    for i, row in net.ext_grid[~net.ext_grid.in_service.astype(bool)].iterrows():
        off = Change(f"ext_grid {i}", WHOLE, "left out", "switched off in the source")
        network.of_bus.append((buses[int(row.bus)], off))
    for table in sorted(net.keys()):
        content = net[table]
        if table in CARRIED or not hasattr(content, "columns") or table.startswith(("res_", "_")):
            continue
        ends = [column for column in ("bus", "from_bus", "to_bus") if column in content.columns]
        if table in NOTED or not ends:
            effect = NOTED.get(table, "no table of a feeder")
            if len(content) and not any(part in table for part in CURVES):
                label = f"table {table}, {len(content)} row{'s' if len(content) > 1 else ''}"
                network.changes.append(Change(label, WHOLE, "left out", effect))
            continue
        for i, row in content.iterrows():
            known = [buses[int(row[end])] for end in ends if row[end] in buses]
            change = Change(f"{table} {i}", WHOLE, "left out", "has no place in a feeder")
            network.of_bus.extend((bus, change) for bus in known)
