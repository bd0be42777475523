"""How far converted feeders are from the power flow of the tool that they are from.

    python -m benchmarks.converters [word ...]

Every distribution feeder that pandapower brings along, SimBench's of low, of medium and of both voltages, and
three feeders that OpenDSS and power-grid-model have solved and saved themselves (`save circuit`,
`json_serialize_to_file`); with words only those whose source contains one. Each is converted, read again and
solved at the source's loads. A table says what was left out or approximated on the way. Limits: voltages
within 1e-6 pu where all is balanced and 1e-5 pu where it is not, on twelve feeders at least, three of them
of more than 500 buses. Transmission grids, and networks that several sources feed, are no feeders: not tried.
"""

from __future__ import annotations

import logging
import math
import os
import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from power_grid_model import ComponentType, DatasetType, initialize_array
from power_grid_model.utils import json_serialize_to_file

from benchmarks._arguments import arguments
from feeders.convert.convert import Conversion, convert
from feeders.convert.provenance import WHOLE, ConversionChange
from feeders.format.tables import FeederTables, LineRow, read
from feeders.model.site import load
from gridsec.errors import GridsecError

FEWEST, LARGE, FEWEST_LARGE = 12, 500, 3
HZ = 50.0
NF_PER_US = 1e3 / (2.0 * math.pi * HZ)
SAVED = ("kerber-vorstadtnetz", "simbench-lv-rural3", "ieee-european-lv")

PANDAPOWER = {
    "create_kerber_landnetz_freileitung_1": "", "create_kerber_landnetz_freileitung_2": "",
    "create_kerber_landnetz_kabel_1": "", "create_kerber_landnetz_kabel_2": "",
    "create_kerber_dorfnetz": "", "create_kerber_vorstadtnetz_kabel_1": "",
    "create_kerber_vorstadtnetz_kabel_2": "", "kb_extrem_landnetz_freileitung": "",
    "kb_extrem_landnetz_kabel": "", "kb_extrem_landnetz_freileitung_trafo": "",
    "kb_extrem_landnetz_kabel_trafo": "", "kb_extrem_dorfnetz": "", "kb_extrem_dorfnetz_trafo": "",
    "kb_extrem_vorstadtnetz_1": "", "kb_extrem_vorstadtnetz_2": "", "kb_extrem_vorstadtnetz_trafo_1": "",
    "kb_extrem_vorstadtnetz_trafo_2": "", "create_cigre_network_lv": "Bus R1,Bus I1,Bus C1",
    "create_cigre_network_mv": "Bus 1,Bus 12", "mv_oberrhein": "Bus 19,Bus 178", "case33bw": "",
    "create_dickert_lv_network": "", "create_synthetic_voltage_control_lv_network": "",
    "lv_schutterwald": "NS_bus_idx_47,NS_bus_idx_45,NS_bus_idx_35", "example_simple": "",
    "panda_four_load_branch": "", "four_loads_with_branches_out": "", "simple_four_bus_system": "",
    "simple_mv_open_ring_net": "", "ieee_european_lv_asymmetric": "",
}  # fmt: skip
"""Networks of pandapower, each with its busbars where there are several."""

SIMBENCH = {
    "1-LV-rural1--0-sw": "", "1-LV-rural2--0-sw": "", "1-LV-rural3--0-sw": "", "1-LV-semiurb4--1-sw": "",
    "1-LV-semiurb5--2-sw": "", "1-LV-urban6--2-no_sw": "", "1-MV-rural--0-sw": "", "1-MV-semiurb--0-sw": "",
    "1-MV-urban--0-sw": "MV3.101 node1,MV3.101 node2", "1-MV-comm--1-sw": "", "1-MVLV-rural-1.108-0-sw": "",
    "1-MVLV-semiurb-all-0-sw": "", "1-MVLV-rural-all-0-sw": "",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Case:
    """A feeder to convert: what it is called, the tool that it is for, what to read, and its busbar."""

    name: str
    tool: str
    source: str
    root: str | None = None


def cases(folder: Path, words: list[str]) -> Iterator[Case]:
    """All feeders that contain one of some words; those of the other tools are written to a folder first."""
    for tool, networks in (("pandapower", PANDAPOWER), ("simbench", SIMBENCH)):
        for name, roots in networks.items():
            for root in roots.split(",") if _wanted(f"{tool}:{name}", words) else ():
                yield Case(f"{name}{f', {root}' if root else ''}", tool, f"{tool}:{name}", root or None)
    for name in SAVED:
        tables = load(name).tables
        if _wanted(f"OpenDSS:{name}", words):
            yield Case(name, "OpenDSS", str(opendss(folder / f"{name}-dss", tables)))
        if _wanted(f"power-grid-model:{name}", words):
            yield Case(name, "power-grid-model", str(power_grid_model(folder / f"{name}.json", tables)))


def _wanted(source: str, words: list[str]) -> bool:
    return not words or any(word in source for word in words)


def ends(tables: FeederTables) -> Iterator[LineRow]:
    """The lines that carry current, as they are by sequence."""
    for row in tables.lines:
        if row.closed:
            yield row


def zero(row: LineRow) -> tuple[float, float]:
    """Zero-sequence impedance of a line, ohm."""
    return (row.r_ohm if row.r0_ohm is None else row.r0_ohm, row.x_ohm if row.x0_ohm is None else row.x0_ohm)


def opendss(folder: Path, tables: FeederTables) -> Path:
    """A feeder as OpenDSS saves it, once it has been told line by line; return its master file."""
    from opendssdirect import dss

    engine = dss.NewContext()
    engine.Basic.AllowForms(False)
    kv = math.sqrt(3.0) * tables.meta.voltage_volt / 1e3
    tell = engine.Text.Command
    tell("clear")
    tell(f"set defaultbasefrequency={HZ}")
    tell(f"new circuit.{tables.meta.name} basekv={kv} bus1={_id(tables.meta.busbar)} mvasc3=1000 mvasc1=1000")
    for k, row in enumerate(ends(tables)):
        r0, x0 = zero(row)
        nf = row.b_us * NF_PER_US
        tell(
            f"new line.l{k} bus1={_id(row.from_bus)} bus2={_id(row.to_bus)} r1={row.r_ohm} x1={row.x_ohm} "
            f"r0={r0} x0={x0} c1={nf} c0={nf} length=1"
        )
    for k, customer in enumerate(tables.customers):
        node = {"a": ".1", "b": ".2", "c": ".3"}.get(customer.phases, "")
        volt = kv / math.sqrt(3.0) if node else kv
        tell(
            f"new load.c{k} bus1={_id(customer.bus)}{node} phases={1 if node else 3} kv={volt} "
            f"kw={customer.load_kw} pf={customer.power_factor or 0.95} vminpu=0.5"
        )
    tell(f"set voltagebases=[{kv}]")
    tell("calcvoltagebases")
    tell("solve")
    tell(f'save circuit dir="{folder}"')
    engine.Basic.ClearAll()
    return next(path for path in folder.iterdir() if path.name.lower() == "master.dss")


def _id(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]", "_", name)


def power_grid_model(path: Path, tables: FeederTables) -> Path:
    """A feeder as power-grid-model serialises it."""
    data: dict[str, Any] = {}

    def add(kind: ComponentType, count: int, **columns: Any) -> None:
        rows = initialize_array(DatasetType.input, kind, count)
        rows["id"] = sum(map(len, data.values())) + np.arange(count)
        for name, values in columns.items():
            rows[name] = values
        data[kind.value] = rows

    lines, customers = list(ends(tables)), tables.customers
    buses = list(dict.fromkeys([tables.meta.busbar, *(end for r in lines for end in (r.from_bus, r.to_bus))]))
    at = {bus: k for k, bus in enumerate(buses)}
    farad = np.array([row.b_us for row in lines]) * NF_PER_US * 1e-9
    r0, x0 = np.array([zero(row) for row in lines]).T
    add(ComponentType.node, len(buses), u_rated=math.sqrt(3.0) * tables.meta.voltage_volt)
    add(
        ComponentType.line, len(lines), from_node=[at[row.from_bus] for row in lines], from_status=1,
        to_node=[at[row.to_bus] for row in lines], to_status=1, r1=[row.r_ohm for row in lines],
        x1=[row.x_ohm for row in lines], c1=farad, tan1=0.0, r0=r0, x0=x0, c0=farad, tan0=0.0, i_n=1e3,
    )  # fmt: skip
    add(ComponentType.source, 1, node=0, status=1, u_ref=1.02, sk=1e9)
    p = 1e3 * np.array([row.load_kw for row in customers])
    q = p * np.tan(np.arccos([row.power_factor or 0.95 for row in customers]))
    where = [at[row.bus] for row in customers]
    kind = ComponentType.sym_load
    if tables.in_phases:
        share = np.array([[p in row.phases for p in "abc"] for row in customers])
        share = share / share.sum(axis=1, keepdims=True)
        kind, p, q = ComponentType.asym_load, p[:, None] * share, q[:, None] * share
    add(kind, len(customers), node=where, status=1, type=0, p_specified=p, q_specified=q)
    json_serialize_to_file(path, data, DatasetType.input)
    return path


def left_out(changes: tuple[ConversionChange, ...]) -> str:
    """What was left out or approximated, by kind."""
    found: Counter[str] = Counter()
    for each in changes:
        if each.done in {"left out", "approximated"}:
            first, _, rest = each.element.partition(" ")
            count = int(first) if first.isdigit() else 1  # "3 buses", "load Smith", "table group, 1 row"
            noun = rest if first.isdigit() else first
            kind = {"buses": "bus", "table": each.element.partition(",")[0]}.get(noun, noun)
            found[kind if each.prop == WHOLE else f"{each.prop} of {kind}"] += count
    return ", ".join(_counted(what, count) for what, count in found.items()) or "nothing"


def _counted(what: str, count: int) -> str:
    if " " in what:  # a table, or a property
        return what if count == 1 else f"{what} ({count})"
    return f"{count} {what}{'' if count == 1 else 'es' if what.endswith('s') else 's'}"


def line_of(case: Case, done: Conversion, customers: int) -> str:
    """One row of the table."""
    check = done.check
    numbers = ("not checked", "", "") if check is None else (
        str(check.buses), "3" if check.three_phase else "1", f"{check.largest_pu:.1e}"
    )  # fmt: skip
    cells = (case.name, case.tool, numbers[0], str(customers), numbers[1], numbers[2], left_out(done.changes))
    return f"| {' | '.join(cells)} |"


def main(words: list[str]) -> int:
    """Convert all feeders; print the table."""
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    began, tried, large, missed = time.perf_counter(), 0, 0, []
    print(
        "| feeder | from | buses | customers | phases | largest difference, pu | left out or approximated |"
    )
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        for case in cases(Path(scratch), words):
            tried += 1
            folder = Path(scratch) / "feeder"
            try:
                done = convert(case.source, folder, root=case.root)
            except GridsecError as error:
                print(f"| {case.name} | {case.tool} | refused: {' '.join(str(error).split())[:200]} |")
                missed.append(case.name)
                continue
            print(line_of(case, done, len(read(folder).customers)), flush=True)
            if done.check is None or not done.check.exact:
                missed.append(case.name)
            large += done.check is not None and done.check.buses > LARGE
    print(f"\n{tried} feeders, {large} of more than {LARGE} buses, {time.perf_counter() - began:.0f} s")
    if not words and (tried < FEWEST or large < FEWEST_LARGE):
        missed.append("the number of feeders")
    if missed:
        print(f"missed: {', '.join(missed)}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main(list(arguments(__doc__, words=()).words)))
