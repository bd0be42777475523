"""The same unbalanced feeder in power-grid-model, from the rows of the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from power_grid_model import ComponentType, DatasetType, PowerGridModel, initialize_array

from feeders.format.tables import FeederTables
from feeders.model.site import find
from gridsec.arrays import Floats


def unbalanced(name: str) -> FeederTables:
    """A balanced feeder of the project with zero-sequence values, its customers dealt out to the phases."""
    tables = find(name)
    return replace(
        tables,
        lines=tuple(replace(line, r0_ohm=3.7 * line.r_ohm, x0_ohm=3.1 * line.x_ohm) for line in tables.lines),
        customers=tuple(
            replace(row, phases=("a", "b", "c", "abc")[k % 4]) for k, row in enumerate(tables.customers)
        ),
    )


def solve(
    tables: FeederTables,
    p_kw: Floats,
    q_kvar: Floats,
    v0_pu: float,
    transformer: Mapping[str, Any] | None = None,
) -> dict[str, Floats]:
    """Voltage of every bus by power-grid-model's asymmetric power flow, (3,) pu.

    A transformer stands between the source and the busbar; its bus comes back as "source".
    """
    closed = [line for line in tables.lines if line.closed]
    names = list(dict.fromkeys([tables.meta.busbar, *(b for x in closed for b in (x.from_bus, x.to_bus))]))
    number = {name: k for k, name in enumerate(names)}
    count = len(names) + (transformer is not None)
    node = initialize_array(DatasetType.input, ComponentType.node, count)
    node["id"] = np.arange(count)
    node["u_rated"] = tables.meta.voltage_volt * np.sqrt(3.0)

    line = initialize_array(DatasetType.input, ComponentType.line, len(closed))
    line["id"] = count + np.arange(len(closed))
    line["from_node"] = [number[row.from_bus] for row in closed]
    line["to_node"] = [number[row.to_bus] for row in closed]
    line["from_status"] = line["to_status"] = 1
    for column, key in (("r1", "r_ohm"), ("x1", "x_ohm"), ("r0", "r0_ohm"), ("x0", "x0_ohm")):
        line[column] = [getattr(row, key) for row in closed]
    line["c1"] = line["c0"] = np.array([row.b_us for row in closed]) * 1e-6 / (2 * np.pi * 50.0)
    line["tan1"] = line["tan0"] = 0.0

    customers = len(tables.customers)
    load = initialize_array(DatasetType.input, ComponentType.asym_load, customers)
    load["id"] = 10**6 + np.arange(customers)
    load["node"] = [number[row.bus] for row in tables.customers]
    load["status"], load["type"] = 1, 0
    share = np.array([[phase in row.phases for phase in "abc"] for row in tables.customers], dtype=float)
    share /= share.sum(axis=1, keepdims=True)
    load["p_specified"], load["q_specified"] = 1e3 * p_kw[:, None] * share, 1e3 * q_kvar[:, None] * share

    source = initialize_array(DatasetType.input, ComponentType.source, 1)
    source["id"], source["status"], source["u_ref"] = 2 * 10**6, 1, v0_pu
    source["node"] = number[tables.meta.busbar] if transformer is None else count - 1
    source["sk"] = 1e15
    parts = {
        ComponentType.node: node,
        ComponentType.line: line,
        ComponentType.asym_load: load,
        ComponentType.source: source,
    }
    if transformer is not None:
        node["u_rated"][-1] = transformer["u1"]
        part = initialize_array(DatasetType.input, ComponentType.transformer, 1)
        part["id"], part["from_node"], part["to_node"] = 3 * 10**6, count - 1, number[tables.meta.busbar]
        part["from_status"] = part["to_status"] = 1
        for key, value in transformer.items():
            part[key] = value
        parts[ComponentType.transformer] = part
    result = PowerGridModel(parts).calculate_power_flow(
        symmetric=False, error_tolerance=1e-11, max_iterations=60
    )
    return dict(zip([*names, "source"], result[ComponentType.node]["u_pu"], strict=False))
