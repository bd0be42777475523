"""Full AC power flow of a feeder: the truth of simulations and tests.

It uses only the SI columns of the feeder's files, and power-grid-model as solver. It shares no code with the
linear model in `gridsec`: an error in the per-unit conversion, in fusing buses or in LinDistFlow shows as a
disagreement. Balanced three-phase, slack at the metered busbar, loads of constant power.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from power_grid_model import CalculationMethod, ComponentType, DatasetType, PowerGridModel, initialize_array
from power_grid_model.errors import PowerGridError  # type: ignore[attr-defined]  # documented, but not re-exported
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gridsec.arrays import Floats, Ints
from gridsec.errors import GridsecError

if TYPE_CHECKING:
    from feeders.model.site import Site

Phasors = NDArray[np.complex128]

FREQUENCY_HZ: Final = 50.0
"""Frequency of the conversion from susceptance to capacitance for power-grid-model; it cancels out."""

TOLERANCE_PU: Final = 1e-10
"""Largest voltage correction of the last Newton step; the remaining error is of its square."""

SLACK_VA: Final = 1e16
"""Short-circuit power of the slack: 1 MVA moves it by 1e-10 pu, and double precision suffices."""


class PowerFlowDiverged(GridsecError):
    """The AC equations have no solution, usually because of too much load, or Newton's method failed."""

    code = "not-converged"


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Feeder for AC power flow, in SI. L lines, B buses, N customers."""

    ends: Ints  # (L, 2): the buses at both ends of each line, 0 .. B-1.
    # (L,): series resistance and reactance per phase, ohm; not both zero.
    r_ohm: Floats
    x_ohm: Floats
    b_siemens: Floats  # (L,): total shunt susceptance per phase, S
    busbar: int  # bus of the given voltage
    customer_bus: Ints  # (N,): bus of each customer
    bus_count: int  # number of buses B
    nominal_volt: Floats | float  # scalar or (B,): nominal phase-to-neutral voltage, V; or that of each bus
    # (L,): ratio of an ideal transformer at the first end of each line: the voltage there by that behind it,
    # each relative to its nominal voltage.
    tap: Floats | None = None


class PowerFlow:
    """AC power flow of one feeder, for repeated solutions.

    Voltages are in the order of the feeder's customers and buses. A solve starts flat every time, so that its
    result depends on its arguments alone. An object is not thread-safe: its input arrays are reused.
    """

    def __init__(self, site: Site) -> None:
        grid, order = _grid(site)
        self._prepare(grid, order)

    @classmethod
    def of(cls, grid: Grid) -> Self:
        """Power flow of bare arrays; voltages of buses are in the grid's own order."""
        flow = cls.__new__(cls)
        flow._prepare(grid, np.arange(grid.bus_count))
        return flow

    def _prepare(self, grid: Grid, order: Ints) -> None:
        self.grid = grid
        self._order = order
        self._scale = np.broadcast_to(grid.nominal_volt, (grid.bus_count,))
        self._model = PowerGridModel(_components(grid))
        self._loads, self._source = _updates(grid)

    def solve(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats | float) -> tuple[Floats, Floats]:
        """Voltages of customers (N,) and buses (b + 1,), phase to neutral, V, for one set of loads.

        Loads are three-phase net imports (N,), kW and kvar, `v0_volt` is the busbar's voltage, phase to
        neutral, V. PowerFlowDiverged is raised without a solution, or if Newton's method does not find it.
        """
        by_node = self._solve(p_kw, q_kvar, v0_volt, "u_pu") * self._scale
        return by_node[self.grid.customer_bus], by_node[self._order]

    def phasors(self, p_kw: Floats, q_kvar: Floats, v0_volt: float) -> Phasors:
        """Complex voltage of every bus of `grid`, phase to neutral, V; the busbar has angle 0. As `solve`."""
        magnitude = self._solve(p_kw, q_kvar, v0_volt, "u_pu") * self._scale
        angle = self._solve(p_kw, q_kvar, v0_volt, "u_angle")
        phasors: Phasors = magnitude * np.exp(1j * (angle - angle[self.grid.busbar]))
        return phasors

    def solve_batch(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats) -> tuple[Floats, Floats]:
        """Voltages (T, N) and (T, b + 1), V, for T sets of loads (T, N) and busbar voltages (T,).

        The numbers are those of T calls of `solve`, many times faster. PowerFlowDiverged names the first set
        without a solution.
        """
        count = p_kw.shape[0]
        if count == 0:
            return np.empty((0, p_kw.shape[1])), np.empty((0, self._order.size))
        loads, source = _updates(self.grid, count)
        loads["p_specified"] = p_kw * 1e3
        loads["q_specified"] = q_kvar * 1e3
        source["u_ref"][:, 0] = v0_volt / self._scale[self.grid.busbar]
        by_node = self._calculate(
            "u_pu",
            update_data={ComponentType.sym_load: loads, ComponentType.source: source},
            threading=-1,
        )
        by_node = by_node * self._scale
        return by_node[:, self.grid.customer_bus], by_node[:, self._order]

    def _solve(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats | float, column: str) -> Floats:
        np.multiply(p_kw, 1e3, out=self._loads["p_specified"])
        np.multiply(q_kvar, 1e3, out=self._loads["q_specified"])
        self._source["u_ref"] = v0_volt / self._scale[self.grid.busbar]
        self._model.update(
            update_data={ComponentType.sym_load: self._loads, ComponentType.source: self._source}
        )
        return self._calculate(column)

    def _calculate(self, column: str, **options: Any) -> Floats:
        try:
            result = self._model.calculate_power_flow(
                symmetric=True,
                error_tolerance=TOLERANCE_PU,
                calculation_method=CalculationMethod.newton_raphson,
                output_component_types={ComponentType.node: [column]},
                **options,
            )
        except PowerGridError as error:
            failed = getattr(error, "failed_scenarios", None)
            where = "" if failed is None else f" (set {int(failed[0])})"
            raise PowerFlowDiverged(f"the AC power flow found no solution{where}") from error
        values: Floats = result[ComponentType.node][column]
        return values


def _grid(site: Site) -> tuple[Grid, Ints]:
    """SI arrays of a feeder, and the node of each bus of the model."""
    tables = site.tables
    closed = [line for line in tables.lines if line.closed]
    names = sorted({tables.meta.busbar} | {bus for line in closed for bus in (line.from_bus, line.to_bus)})
    number = {name: i for i, name in enumerate(names)}
    ends = np.array([(number[line.from_bus], number[line.to_bus]) for line in closed], dtype=np.intp)
    ends = ends.reshape(-1, 2)
    r = np.array([line.r_ohm for line in closed], dtype=np.float64)
    x = np.array([line.x_ohm for line in closed], dtype=np.float64)
    b = np.array([line.b_us for line in closed], dtype=np.float64) * 1e-6
    tap = np.array([line.tap for line in closed], dtype=np.float64)
    to_volt = np.array([line.to_volt for line in closed], dtype=np.float64)
    solid = (r == 0.0) & (x == 0.0)
    node, count = _fuse(ends[solid], len(names))
    busbar, ends = int(node[number[tables.meta.busbar]]), node[ends]
    grid = Grid(
        ends=ends[~solid],
        r_ohm=r[~solid],
        x_ohm=x[~solid],
        b_siemens=b[~solid],
        busbar=busbar,
        customer_bus=node[np.array([number[row.bus] for row in tables.customers], dtype=np.intp)],
        bus_count=count,
        nominal_volt=levels(ends, to_volt, busbar, tables.meta.voltage_volt, count),
        tap=tap[~solid],
    )
    order = np.full(len(site.feeder.buses), -1, dtype=np.intp)
    for name, i in number.items():
        order[site.bus_of_file[name]] = node[i]
    return grid, order


def levels(ends: Ints, to_volt: Floats, busbar: int, volt: float, count: int) -> Floats:
    """Nominal voltage of every bus, V: from the busbar on, until a transformer changes it.

    `ends` (L, 2) are the buses of each line, `to_volt` (L,) the nominal voltage of the second one, V, NaN
    where it is that of the first.
    """
    if np.isnan(to_volt).all():
        return np.full(count, volt)
    near: dict[int, list[tuple[int, float]]] = defaultdict(list)
    for (one, other), there in zip(ends.tolist(), to_volt.tolist(), strict=True):
        near[one].append((other, there))
        if np.isnan(there):
            near[other].append((one, there))
    found, order = {busbar: volt}, [busbar]
    for bus in order:
        for other, there in near[bus]:
            if other not in found:
                found[other] = found[bus] if np.isnan(there) else there
                order.append(other)
    return np.array([found[bus] for bus in range(count)])


def _fuse(pairs: Ints, count: int) -> tuple[Ints, int]:
    """Number the groups of buses that connections without impedance join."""
    ones = np.ones(len(pairs))
    graph = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    groups, label = connected_components(graph, directed=False)
    return label.astype(np.intp), int(groups)


def _components(grid: Grid) -> dict[ComponentType, Any]:
    """Translate the grid into components; ids are consecutive: nodes, lines, loads, source."""
    lines, customers = len(grid.ends), grid.customer_bus.size
    node = initialize_array(DatasetType.input, ComponentType.node, grid.bus_count)
    node["id"] = np.arange(grid.bus_count)
    level = np.broadcast_to(grid.nominal_volt, (grid.bus_count,))
    node["u_rated"] = level * np.sqrt(3.0)

    number = grid.bus_count + np.arange(lines)
    tap = np.ones(lines) if grid.tap is None else grid.tap
    tapped = (tap != 1.0) | (level[grid.ends[:, 0]] != level[grid.ends[:, 1]])
    line = initialize_array(DatasetType.input, ComponentType.line, int((~tapped).sum()))
    branch = initialize_array(DatasetType.input, ComponentType.generic_branch, int(tapped.sum()))
    for table, rows in ((line, ~tapped), (branch, tapped)):
        table["id"] = number[rows]
        table["from_node"], table["to_node"] = grid.ends[rows].T
        table["from_status"] = table["to_status"] = 1
        table["r1"], table["x1"] = grid.r_ohm[rows], grid.x_ohm[rows]
    line["c1"] = grid.b_siemens[~tapped] / (2.0 * np.pi * FREQUENCY_HZ)
    line["tan1"] = 0.0
    branch["k"], branch["b1"] = tap[tapped], grid.b_siemens[tapped]
    branch["theta"] = branch["g1"] = 0.0

    load = initialize_array(DatasetType.input, ComponentType.sym_load, customers)
    load["id"] = _first_load(grid) + np.arange(customers)
    load["node"] = grid.customer_bus
    load["status"] = 1
    load["type"] = 0  # constant power
    load["p_specified"] = load["q_specified"] = 0.0

    source = initialize_array(DatasetType.input, ComponentType.source, 1)
    source["id"] = _first_load(grid) + customers
    source["node"] = grid.busbar
    source["status"] = 1
    source["u_ref"] = 1.0
    source["sk"] = SLACK_VA
    return {
        ComponentType.node: node,
        ComponentType.line: line,
        ComponentType.generic_branch: branch,
        ComponentType.sym_load: load,
        ComponentType.source: source,
    }


def _first_load(grid: Grid) -> int:
    return grid.bus_count + len(grid.ends)


def _updates(grid: Grid, *shape: int) -> tuple[Any, Any]:
    """Updates of all loads and of the source, one for each set of a batch of the given shape."""
    customers = grid.customer_bus.size
    sizes: Any = (*shape, customers), (*shape, 1)
    load = initialize_array(DatasetType.update, ComponentType.sym_load, sizes[0])
    source = initialize_array(DatasetType.update, ComponentType.source, sizes[1])
    load["id"] = _first_load(grid) + np.arange(customers)
    source["id"] = _first_load(grid) + customers
    return load, source
