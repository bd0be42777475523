"""Input data of power-grid-model in its JSON format, solved by power-grid-model itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from power_grid_model import (
    CalculationMethod,
    ComponentType,
    DatasetType,
    PowerGridModel,
    WindingType,
    initialize_array,
)
from power_grid_model.utils import json_deserialize  # type: ignore[attr-defined]  # documented, but not re-exported
from power_grid_model.validation import validate_input_data

from feeders.convert.customers import SWITCHED_OFF, Draw, rounded
from feeders.convert.lines import ALL, Coupling, by_sequence, charging_cells, line_row
from feeders.convert.provenance import Changes, SourceUnreadable
from feeders.convert.source import CONSTANT, MEASURE, OFF, UNLIKE, SourceNetwork
from feeders.convert.transformers import TwoPort, coupling_of
from feeders.format.columns import some
from feeders.format.tables import LineRow
from feeders.format.validation import same_level
from gridsec.arrays import Floats, Phasors
from gridsec.errors import FeederInvalid, GridsecError, Problem
from gridsec.grid.three_phase import ROTATION

OMEGA: Final = 2.0 * np.pi * 50.0
"""Angular frequency of power-grid-model; its files state none."""

LOADS: Final = ("sym_load", "asym_load")
GENERATORS: Final = ("sym_gen", "asym_gen")
COUPLINGS: Final = {
    "transformer": (("from_node", "p_from", "q_from"), ("to_node", "p_to", "q_to")),
    "three_winding_transformer": tuple((f"node_{k}", f"p_{k}", f"q_{k}") for k in (1, 2, 3)),
    "generic_branch": (("from_node", "p_from", "q_from"), ("to_node", "p_to", "q_to")),
}
CARRIED: Final = {
    *("node", "source", "line", "asym_line", "link", "shunt"),
    *(*LOADS, *GENERATORS, *COUPLINGS),
}
"""Tables that are reported row by row."""

NOTED: Final = {
    "transformer_tap_regulator": "taps as in the file",
    "fault": "not part of a power flow",
}
"""Tables without a place in the network, and their replacement in a feeder."""

STATUS: Final = ("status", "from_status", "to_status", "status_1", "status_2", "status_3")
TOLERANCES: Final = (1e-11, 1e-9, 1e-7)
"""Largest voltage corrections of the last Newton step, pu; links, almost short circuits, limit them."""
STIFF_VA: Final = 1e20
"""Short-circuit power of a source in front of one transformer, VA."""

Tables = dict[str, Any]


def read_pgm(path: Path) -> SourceNetwork:
    """Read and solve a file of input data: JSON as power-grid-model serialises a dataset of type `input`.

    Raises SourceUnreadable if power-grid-model cannot read it; GridsecError if power-grid-model cannot solve
        it; FeederInvalid with all problems of its data.
    """
    tables = _tables(path)
    symmetric = not any(
        len(tables[kind]) for kind in ("asym_load", "asym_gen", "asym_line") if kind in tables
    )
    problems = validate_input_data(tables, symmetric=symmetric)
    if problems:
        raise FeederInvalid(
            Problem("source-invalid", f"{path.name}: {problem} Ids: {_shown(problem.ids)}")
            for problem in problems
        )
    dependent = [kind for kind in (*LOADS, *GENERATORS) if kind in tables and tables[kind]["type"].any()]
    found = _solve(path, tables, symmetric) if dependent else {}
    network = SourceNetwork(f"power-grid-model {version('power-grid-model')}", [], _nominal(tables))
    for kind in dependent:
        for row in tables[kind][tables[kind]["type"] != 0]:
            law = "impedance" if row["type"] == 1 else "current"
            label = f"{kind} {row['id']}"
            network.note_at(str(row["node"]), label, f"constant {law}", "approximated", CONSTANT)
        tables[kind]["type"] = 0
    solved = _solve(path, tables, symmetric)
    network.volts = _volts(tables, solved)
    network.as_found = _volts(tables, found) if found else {}
    network.sources = [str(row["node"]) for row in _rows(tables, "source") if row["status"]]
    _lines(tables, network)
    _asymmetric_lines(tables, network)
    _couplings(tables, solved, network, symmetric=symmetric)
    _draws(tables, network)
    _shunts(tables, solved, network)
    _rest(tables, network)
    return network


def _tables(path: Path) -> Tables:
    try:
        data = json_deserialize(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SourceUnreadable(f"{path}: cannot be read: {error}") from error
    except Exception as error:  # an external reader may raise anything on an external file
        raise SourceUnreadable(
            f"{path}: power-grid-model cannot read it: {' '.join(str(error).split())}"
        ) from error
    tables = {kind.value: rows for kind, rows in data.items()}
    problems = [
        Problem("missing", f"{path.name}: the table {kind!r} is missing")
        for kind in ("node", "source")
        if kind not in tables
    ]
    if any(not isinstance(rows, np.ndarray) or rows.ndim != 1 for rows in tables.values()):
        problems.append(Problem("shape", f"{path.name}: is a batch; expected one set of input data"))
    elif any("u_rated" not in (rows.dtype.names or ()) for kind, rows in tables.items() if kind == "node"):
        problems.append(
            Problem("wrong-type", f"{path.name}: is not of the type 'input'; expected input data")
        )
    if problems:
        raise FeederInvalid(problems)
    return tables


def _solve(path: Path, tables: Tables, symmetric: bool) -> Tables:
    for tolerance in TOLERANCES:
        try:
            result = PowerGridModel(tables).calculate_power_flow(
                symmetric=symmetric,
                error_tolerance=tolerance,
                max_iterations=30,
                calculation_method=CalculationMethod.newton_raphson,
            )
        except Exception as error:  # an external solver may raise anything on external data
            if tolerance == TOLERANCES[-1]:
                text = " ".join(str(error).split()).partition(" Try ")[0]
                raise GridsecError(
                    f"{path}: power-grid-model's own power flow fails: {text}", code="not-converged"
                ) from error
        else:
            return {kind.value: rows for kind, rows in result.items()}
    raise AssertionError("the last tolerance has returned or raised")


def _shown(ids: Iterable[Any] | None) -> str:
    return some([str(each if isinstance(each, int) else each[-1]) for each in ids or ()])


def _rows(tables: Tables, kind: str) -> list[Any]:
    return list(tables.get(kind, ()))


def _nominal(tables: Tables) -> dict[str, float]:
    return {str(row["id"]): float(row["u_rated"]) / 3.0**0.5 for row in tables["node"]}


def _volts(tables: Tables, solved: Tables) -> dict[str, Phasors]:
    nodes = solved["node"]
    v: Phasors = nodes["u_pu"] * np.exp(1j * nodes["u_angle"])
    if v.ndim == 1:
        v = v[:, None] * ROTATION
    v = v * (tables["node"]["u_rated"] / 3.0**0.5)[:, None]
    fed = nodes["energized"].astype(bool)
    return {
        str(row): volt if on else np.full(3, np.nan + 0j)
        for row, volt, on in zip(nodes["id"], v, fed, strict=True)
    }


def _closed(row: Any) -> bool:
    return bool(row["from_status"] and row["to_status"])


def _finite(value: float) -> float | None:
    return rounded(float(value)) if np.isfinite(value) else None


def _lines(tables: Tables, network: SourceNetwork) -> None:
    for kind in ("line", "link"):
        for row in _rows(tables, kind):
            name, ends = f"{kind} {row['id']}", (str(row["from_node"]), str(row["to_node"]))
            if kind == "link":
                network.lines.append(LineRow(name, *ends, 0.0, 0.0, closed=_closed(row)))
                continue
            b1, b0 = OMEGA * float(row["c1"]), OMEGA * float(row["c0"])
            if row["tan1"] > 0 and b1 > 0:
                effect = f"{1e6 * b1 * float(row['tan1']):.3g} microsiemens"
                network.note_at(ends[0], name, "shunt conductance", "left out", effect)
            limit = _finite(row["i_n"])
            made = LineRow(
                name,
                *ends,
                rounded(float(row["r1"])),
                rounded(float(row["x1"])),
                r0_ohm=_finite(row["r0"]),
                x0_ohm=_finite(row["x0"]),
                **charging_cells(name, ALL, by_sequence(b1, b0), network.changes),
                closed=_closed(row),
                rating_a=limit if limit else None,
            )
            _add_line(row, made, network)


def _add_line(row: Any, made: LineRow, network: SourceNetwork) -> None:
    ends = (("from_status", made.from_bus), ("to_status", made.to_bus))
    network.add_line(made, [bus for status, bus in ends if row[status]])


def _asymmetric_lines(tables: Tables, network: SourceNetwork) -> None:
    """Lines with matrices; a neutral is grounded at both ends and eliminated."""
    for row in _rows(tables, "asym_line"):
        name, ends = f"asym_line {row['id']}", (str(row["from_node"]), str(row["to_node"]))
        letters = "abc" if np.isnan(row["r_na"]) else "abcn"
        z = np.zeros((len(letters),) * 2, dtype=np.complex128)
        for i, one in enumerate(letters):
            for j, other in enumerate(letters[: i + 1]):
                z[i, j] = z[j, i] = complex(row[f"r_{one}{other}"], row[f"x_{one}{other}"])
        if len(letters) > 3:
            z = z[:3, :3] - np.outer(z[:3, 3], z[3, :3]) / z[3, 3]
        changes = Changes()
        made = line_row(name, ends, np.arange(3), series=z, shunt=_capacitances(row), changes=changes)
        network.of_bus.extend((ends[0], change) for change in changes)
        limit = _finite(row["i_n"])
        _add_line(row, replace(made, closed=_closed(row), rating_a=limit if limit else None), network)


def _capacitances(row: Any) -> Floats:
    if np.isnan(row["c_aa"]):
        return OMEGA * by_sequence(float(row["c1"]), float(row["c0"]))
    c = np.zeros((3, 3))
    for i, one in enumerate("abc"):
        for j, other in enumerate("abc"[: i + 1]):
            c[i, j] = c[j, i] = row[f"c_{one}{other}"]
    return np.asarray(OMEGA * c)


def _couplings(tables: Tables, solved: Tables, network: SourceNetwork, *, symmetric: bool) -> None:
    ports = _two_ports(tables, symmetric)
    for kind, sides in COUPLINGS.items():
        for row, flow in zip(_rows(tables, kind), _rows(solved, kind), strict=True):
            label = f"{kind} {row['id']}"
            if kind == "generic_branch" and _plain(row, network.nominal):
                network.lines.append(_plain_line(row, label))
                continue
            on = [bool(row[name]) for name in STATUS[1:3] if name in row.dtype.names] or [
                bool(row[name]) for name in STATUS[3:]
            ]
            joined = [k for k, ok in enumerate(on) if ok]
            if len(joined) < 2:
                network.leave_out(label, OFF)
                continue
            ends = tuple(str(row[sides[k][0]]) for k in joined)
            flows = tuple(_by_phase(flow[sides[k][1]], flow[sides[k][2]]) for k in joined)
            made = Coupling(label, ends, flows)
            if kind == "generic_branch" and _regulator(row):
                made = Coupling(label, ends, flows, _plain_line(row, label))
            elif kind == "transformer":
                limit = float(row["sn"]) / (3.0**0.5 * float(row["u2"]))
                port = ports.get(int(row["id"]))
                made = coupling_of(label, ends, flows, port=port, rating_a=limit, network=network)
            if made.line is not None and not symmetric:
                passing = replace(made.line, r0_ohm=made.line.r_ohm, x0_ohm=made.line.x_ohm)
                made = replace(made, line=passing)
            network.couplings.append(made)


def _two_ports(tables: Tables, symmetric: bool) -> dict[int, TwoPort]:
    """Two-ports of the transformers, each alone: without load, and with a load.

    In three phases only those without a phase shift and with equal zero and positive sequence, both neutrals
    solidly grounded.
    """
    rows = [row for row in _rows(tables, "transformer") if _closed(row) and (symmetric or _passing(row))]
    if not rows:
        return {}
    rated = {int(row["id"]): float(row["u_rated"]) for row in tables["node"]}
    count = len(rows)
    node = initialize_array(DatasetType.input, ComponentType.node, 2 * count)
    node["id"] = np.arange(2 * count)
    node["u_rated"] = [rated[int(row[end])] for row in rows for end in ("from_node", "to_node")]
    transformer = initialize_array(DatasetType.input, ComponentType.transformer, count)
    for name in set(transformer.dtype.names or ()) & set(rows[0].dtype.names):
        transformer[name] = [row[name] for row in rows]
    transformer["from_node"], transformer["to_node"] = 2 * np.arange(count), 2 * np.arange(count) + 1
    source = initialize_array(DatasetType.input, ComponentType.source, count)
    load = initialize_array(DatasetType.input, ComponentType.sym_load, count)
    for table, first, at in ((transformer, 2, 0), (source, 3, 0), (load, 4, 1)):
        table["id"] = first * count + np.arange(count)
        if table is not transformer:
            table["node"], table["status"] = 2 * np.arange(count) + at, 1
    source["u_ref"], source["sk"] = 1.0, STIFF_VA
    load["type"], load["q_specified"] = 1, 0.0
    bench = {
        ComponentType.node: node,
        ComponentType.transformer: transformer,
        ComponentType.source: source,
        ComponentType.sym_load: load,
    }
    found = []
    for share in (0.0, 1.0):
        load["p_specified"] = share * transformer["sn"]
        solved = PowerGridModel(bench).calculate_power_flow(
            symmetric=True, error_tolerance=TOLERANCES[0], calculation_method=CalculationMethod.linear
        )
        nodes = solved[ComponentType.node]
        v = (nodes["u_pu"] * np.exp(1j * nodes["u_angle"]) * node["u_rated"] / 3.0**0.5).reshape(-1, 2)
        power = solved[ComponentType.sym_load]
        found.append((v, np.conj((power["p"] + 1j * power["q"]) / 3.0 / v[:, 1])))
    return TwoPort.measured([row["id"] for row in rows], *found)


def _passing(row: Any) -> bool:
    grounding = [row[f"{part}_grounding_{end}"] for part in "rx" for end in ("from", "to")]
    neutrals = row["winding_from"] == row["winding_to"] == WindingType.wye_n
    return bool(neutrals and row["clock"] % 12 == 0 and not np.nan_to_num(grounding).any())


def _plain(row: Any, nominal: Mapping[str, float]) -> bool:
    if not same_level(nominal[str(row["from_node"])], nominal[str(row["to_node"])]):
        return False
    neutral = all(np.isnan(row[name]) or row[name] == value for name, value in (("k", 1.0), ("theta", 0.0)))
    return bool(neutral and not row["g1"] > 0)


def _regulator(row: Any) -> bool:
    passive = not row["g1"] > 0 and not row["b1"] < 0 and min(row["r1"], row["x1"]) >= 0
    return bool(not row["theta"] and passive)


def _plain_line(row: Any, label: str) -> LineRow:
    return LineRow(
        label,
        str(row["from_node"]),
        str(row["to_node"]),
        rounded(float(row["r1"])),
        rounded(float(row["x1"])),
        b_us=rounded(1e6 * float(np.nan_to_num(row["b1"]))),
        tap=1.0 if np.isnan(row["k"]) else rounded(float(row["k"])),
        closed=_closed(row),
    )


def _by_phase(p: Any, q: Any) -> Phasors:
    s = (np.asarray(p) + 1j * np.asarray(q)) * 1e-3
    return np.asarray(np.full(3, s / 3.0) if s.ndim == 0 else s, dtype=np.complex128)


def _draws(tables: Tables, network: SourceNetwork) -> None:
    for kind in (*LOADS, *GENERATORS):
        sign = -1.0 if kind in GENERATORS else 1.0
        for row in _rows(tables, kind):
            power = sign * float(row["status"]) * _by_phase(row["p_specified"], row["q_specified"])
            even = bool((power == power[0]).all())
            if not row["status"]:
                network.note_at(str(row["node"]), f"{kind} {row['id']}", *SWITCHED_OFF)
            rating = float(np.abs(power.sum())) if kind in GENERATORS else None
            network.draws.append(Draw(f"{kind} {row['id']}", str(row["node"]), power, even, rating))


def _shunts(tables: Tables, solved: Tables, network: SourceNetwork) -> None:
    for row, flow in zip(_rows(tables, "shunt"), _rows(solved, "shunt"), strict=True):
        label, bus = f"shunt {row['id']}", str(row["node"])
        p, q = (1e-3 * float(np.sum(flow[name])) for name in ("p", "q"))
        if not row["status"]:
            network.leave_out(label, OFF, bus)
            continue
        if row["g1"] != 0:
            network.note_at(bus, label, "conductance", "left out", f"{p:.4g} kW")
        if row["b1"] > 0:
            network.add_capacitor(label, bus, by_sequence(float(row["b1"]), float(row["b0"])), -q)
        elif row["b1"] < 0:
            network.note_at(bus, label, "inductance", "left out", f"{q:.4g} kvar")


def _rest(tables: Tables, network: SourceNetwork) -> None:
    """Report sources out of service, and tables without network elements."""
    for row in _rows(tables, "source"):
        if not row["status"]:
            network.leave_out(f"source {row['id']}", OFF, str(row["node"]))
    for kind, rows in tables.items():
        if not len(rows) or kind in CARRIED:
            continue
        effect = MEASURE if kind.endswith("_sensor") else NOTED.get(kind, UNLIKE)
        network.leave_out(f"{len(rows)} {kind}(s)", effect)
