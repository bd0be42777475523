"""Full AC power flow of a feeder: the truth of simulations and tests.

It uses only the SI columns of the feeder's files. It shares no code with the linear models in `gridsec`: an
error in the per-unit conversion, in fusing buses, in LinDistFlow or in the sweeps shows as a disagreement.

Balanced three-phase by power-grid-model as solver: slack at the metered busbar, loads of constant power.

Unbalanced by nodal admittances in phases: loads of constant power between phase and grounded neutral, slack
at the metered busbar or behind the impedance of the transformer. With V_0 the given voltages and S the powers
of the connections, ``V = A V_0 + B conj(S / V)``. A and B are columns of the inverse of the nodal
admittances, from one sparse factorisation. The iteration is over the voltages of the connections alone, any
number of operating points at once. The feeder need not be radial.

References
----------
.. [1] T.-H. Chen, M.-S. Chen, K.-J. Hwang, P. Kotas, E. A. Chebli, "Distribution system power flow analysis:
   a rigid approach", IEEE Trans. Power Delivery 6(3), 1991: the implicit Z-bus Gauss method.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from power_grid_model import CalculationMethod, ComponentType, DatasetType, PowerGridModel, initialize_array
from power_grid_model.errors import PowerGridError  # type: ignore[attr-defined]  # documented, but not re-exported
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from gridsec.arrays import Bools, Floats, Ints, Phasors
from gridsec.errors import GridsecError, InputInvalid, Problem

if TYPE_CHECKING:
    from feeders.format.tables import FeederTables, LineRow
    from feeders.model.site import Site
    from feeders.model.three_phase import ThreePhaseSite


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


# --- Unbalanced feeders ---


PHASES: Final = "abc"

PHASES_TOLERANCE_PU: Final = 1e-11
"""Largest change of a voltage in the last iteration; each change is a small fraction of the one before."""

ITERATIONS: Final = 200


@dataclass(frozen=True, slots=True, eq=False)
class UnbalancedGrid:
    """Feeder for asymmetric AC power flow, in SI. L lines, B buses, N customers."""

    ends: Ints  # (L, 2): the buses at both ends of each line, 0 .. B-1.
    present: Bools  # (L, 3): phases a, b, c that a line has
    z_ohm: Phasors  # (L, 3, 3): series impedance of each line, ohm; only entries of its phases count
    b_siemens: Floats  # (L, 3, 3): total shunt susceptance of each line, S, half at each end
    busbar: int  # bus of the given voltage
    customer_bus: Ints  # (N,): bus of each customer
    connected: Bools  # (N, 3): phases of each customer; its power is split evenly
    bus_count: int  # number of buses B
    nominal_volt: Floats | float  # scalar or (B,): nominal phase-to-neutral voltage, V; or that of each bus
    # (3, 3): impedance between the given voltage and the busbar, ohm. For a transformer Dyn, `sequence_ohm`
    # of its short-circuit impedance (with that of the grid above) and its zero-sequence impedance, both seen
    # from the low-voltage side: the delta blocks the zero sequence of the grid above.
    source_ohm: Phasors | None = None
    # (L, 3): ratios of an ideal transformer at the first end of each line: the voltages there by those behind
    # it.
    tap: Floats | None = None


class UnbalancedPowerFlow:
    """Asymmetric AC power flow of one feeder, for repeated solutions; voltages are in the order of its buses.

    A solve starts flat every time, so that its result depends on its arguments alone. Without `source_ohm`
    (`UnbalancedGrid`) the given voltage is that of the busbar.
    """

    def __init__(self, site: ThreePhaseSite | Site, source_ohm: Phasors | None = None) -> None:
        grid, node = _phases_grid(site.tables, source_ohm)
        order = np.full(max(site.bus_of_file.values()) + 1, -1, dtype=np.intp)
        for name, bus in site.bus_of_file.items():
            order[bus] = node[name]
        self._prepare(grid, order)

    @classmethod
    def of(cls, grid: UnbalancedGrid) -> Self:
        """Power flow of bare arrays; voltages of buses are in the grid's own order."""
        flow = cls.__new__(cls)
        flow._prepare(grid, np.arange(grid.bus_count))
        return flow

    def _prepare(self, grid: UnbalancedGrid, order: Ints) -> None:
        self.grid = grid
        self._order = order
        Y = _admittances(grid)
        busbar = 3 * grid.busbar + np.arange(3)
        known = np.zeros(3 * grid.bus_count, dtype=np.bool_)
        known[Y.indices] = True
        known[busbar] = True
        self._absent = ~known
        feed: Phasors = np.zeros((known.size, 3), dtype=np.complex128)
        if grid.source_ohm is None:
            known[busbar] = False
            feed = -Y[:, busbar].toarray()
        else:
            feed[busbar] = np.linalg.inv(grid.source_ohm)
        customer, phase = np.nonzero(grid.connected)
        self._of, self._share = customer, 1.0 / grid.connected.sum(axis=1)[customer]
        self._node = 3 * grid.customer_bus[customer] + phase
        if self._absent[self._node].any():
            raise InputInvalid(
                [Problem("absent-phase", "a customer is connected to a phase that its bus does not have")]
            )
        loads: Phasors = np.zeros((known.size, customer.size), dtype=np.complex128)
        loads[self._node, np.arange(customer.size)] = 1.0
        free = np.flatnonzero(known)
        self._idle, self._transfer = np.zeros_like(feed), np.zeros_like(loads)
        if free.size:
            solver = splu(csc_array(Y.tocsr()[free][:, free]))
            self._idle[free] = solver.solve(feed[free])
            self._transfer[free] = solver.solve(loads[free])
        if grid.source_ohm is None:
            self._idle[busbar] = np.eye(3)

    def solve(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats | Phasors | float) -> tuple[Floats, Floats]:
        """Voltages for one set of loads; PowerFlowDiverged if the iteration finds no solution.

        p_kw, q_kvar (N,): net import of each customer, all its phases together, kW and kvar.
        v0_volt scalar, (3,) or complex (3,): given voltage, phase to neutral, V: one for all phases, or one
            for each; real ones have angles of 0, -120 and 120 degrees.
        Returns connections (C,): voltage of each connection, customer by customer, phase by phase, V.
        Returns buses (b + 1, 3): voltage of each phase of each bus, V; NaN where it is absent.
        """
        all_of_them = self.phasors(p_kw[None], q_kvar[None], np.asarray(v0_volt)[None])
        connections, buses = self._magnitudes(all_of_them)
        return connections[0], buses[0]

    def solve_batch(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats | Phasors) -> tuple[Floats, Floats]:
        """Voltages (T, C) and (T, b + 1, 3), V, for T sets of loads at once, many times faster than `solve`.

        Net imports are (T, N), kW and kvar; `v0_volt` is (T,), (T, 3) or complex (T, 3), V. PowerFlowDiverged
        names the first set without a solution.
        """
        return self._magnitudes(self.phasors(p_kw, q_kvar, v0_volt))

    def phasors(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats | Phasors) -> Phasors:
        """Complex voltages (T, B, 3) of every bus of `grid`, phase to neutral, V; as `solve_batch`."""
        given = np.asarray(v0_volt)
        v0 = np.broadcast_to(given[:, None] if given.ndim == 1 else given, (given.shape[0], 3))
        if not np.iscomplexobj(v0):
            v0 = v0 * np.exp(-2j * np.pi / 3.0 * np.arange(3))
        power = (p_kw + 1j * q_kvar)[:, self._of] * (-1e3 * self._share)
        current = self._currents(v0 @ self._idle[self._node].T, power)
        out: Phasors = v0 @ self._idle.T + current @ self._transfer.T
        out[:, self._absent] = np.nan
        return out.reshape(-1, self.grid.bus_count, 3)

    def _currents(self, idle: Phasors, power: Phasors) -> Phasors:
        """Injected currents of the connections, from their powers and their voltages without load."""
        level = np.broadcast_to(self.grid.nominal_volt, (self.grid.bus_count,))
        tolerance = PHASES_TOLERANCE_PU * level[self._node // 3]
        transfer = self._transfer[self._node].T
        v = idle
        failed = np.zeros(idle.shape[0], dtype=np.bool_)
        with np.errstate(all="ignore"):
            for _ in range(ITERATIONS):
                before, v = v, idle + np.conj(power / v) @ transfer
                change = (np.abs(v - before) / tolerance).max(axis=1, initial=0.0)
                failed = ~(change <= 1.0)
                if not failed.any() or not np.isfinite(change).all():
                    break
        if failed.any():
            first = int(np.flatnonzero(failed)[0])
            raise PowerFlowDiverged(f"the AC power flow found no solution (set {first})")
        return np.asarray(np.conj(power / v))

    def _magnitudes(self, phasors: Phasors) -> tuple[Floats, Floats]:
        size = np.abs(phasors)
        flat = size.reshape(size.shape[0], 3 * self.grid.bus_count)
        return flat[:, self._node], size[:, self._order]


class PlacesFlow:
    """Asymmetric power flow by places of a feeder with one phase per customer; methods as of `PowerFlow`."""

    def __init__(self, site: Site) -> None:
        self._flow = UnbalancedPowerFlow(site)
        self.grid = self._flow.grid

    def solve(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats | float) -> tuple[Floats, Floats]:
        """Voltages of the customers (N,) and the places (n,), V; as `UnbalancedPowerFlow.solve`."""
        customers, buses = self._flow.solve(p_kw, q_kvar, v0_volt)
        return customers, buses.ravel()

    def solve_batch(self, p_kw: Floats, q_kvar: Floats, v0_volt: Floats) -> tuple[Floats, Floats]:
        """Voltages for T sets of loads, (T, N) and (T, n), V."""
        customers, buses = self._flow.solve_batch(p_kw, q_kvar, v0_volt)
        return customers, buses.reshape(len(buses), -1)


def power_flow(site: Site) -> PowerFlow | PlacesFlow:
    """AC power flow of a feeder."""
    return PlacesFlow(site) if site.feeder.busbar_phases == 3 else PowerFlow(site)


def sequence_ohm(positive: complex, zero: complex) -> Phasors:
    """3x3 matrix from the positive- and zero-sequence values of a cyclically symmetric element, any unit."""
    own, mutual = (2.0 * positive + zero) / 3.0, (zero - positive) / 3.0
    return np.array([[own if i == j else mutual for j in range(3)] for i in range(3)], dtype=np.complex128)


def _admittances(grid: UnbalancedGrid) -> csc_array:
    """Nodal admittances between phases of buses, node ``3 bus + phase``, without the slack."""
    rows, columns, values = [], [], []

    def stamp(one: int, other: int, here: Ints, block: Phasors) -> None:
        rows.append(np.repeat(3 * one + here, here.size))
        columns.append(np.tile(3 * other + here, here.size))
        values.append(block.ravel())

    taps = np.ones((len(grid.ends), 3)) if grid.tap is None else grid.tap
    lines = zip(grid.ends.tolist(), taps, grid.present, grid.z_ohm, grid.b_siemens, strict=True)
    for (one, other), tap, present, z, b in lines:
        here = np.flatnonzero(present)
        series: Phasors = np.linalg.inv(z[np.ix_(here, here)])
        own: Phasors = series + 0.5j * b[np.ix_(here, here)]
        # Behind the transformer the voltage is v / tap, before it the current is i / tap.
        before, behind = 1.0 / tap[here], np.ones(here.size)
        for end, far, mine, its in ((one, other, before, behind), (other, one, behind, before)):
            stamp(end, end, here, own * np.outer(mine, mine))
            stamp(end, far, here, -series * np.outer(mine, its))
    if grid.source_ohm is not None:
        stamp(
            grid.busbar, grid.busbar, np.arange(3), np.asarray(np.linalg.inv(grid.source_ohm), np.complex128)
        )
    size = 3 * grid.bus_count
    where = (np.concatenate(rows), np.concatenate(columns)) if rows else (np.empty(0, int), np.empty(0, int))
    data = np.concatenate(values) if values else np.empty(0, complex)
    return csc_array(coo_array((data, where), shape=(size, size)))


def _phases_grid(tables: FeederTables, source_ohm: Phasors | None) -> tuple[UnbalancedGrid, dict[str, int]]:
    """SI arrays of a feeder, and the node of each bus of the files."""
    closed = [line for line in tables.lines if line.closed]
    above: dict[str, str] = {}

    def find(bus: str) -> str:
        while above.setdefault(bus, bus) != bus:
            bus = above[bus]
        return bus

    find(tables.meta.busbar)
    for line in closed:
        one, other = find(line.from_bus), find(line.to_bus)
        if line.r_ohm == line.x_ohm == 0.0:
            above[other] = one
    number = {root: k for k, root in enumerate(dict.fromkeys(map(find, list(above))))}
    node = {bus: number[find(bus)] for bus in above}
    lines = [line for line in closed if not line.r_ohm == line.x_ohm == 0.0]
    count, busbar = len(lines), node[tables.meta.busbar]
    ends = np.array([(node[line.from_bus], node[line.to_bus]) for line in lines], dtype=np.intp)
    ends = ends.reshape(-1, 2)
    to_volt = np.array([line.to_volt for line in lines], dtype=np.float64)
    nominal = levels(ends, to_volt, busbar, tables.meta.voltage_volt, len(number))
    taps = np.array([line.taps for line in lines]).reshape(count, 3)
    grid = UnbalancedGrid(
        ends=ends,
        present=np.array([_present(line.phases) for line in lines]),
        z_ohm=np.array([_series(line) for line in lines]).reshape(count, 3, 3),
        b_siemens=np.array([_shunt(line) for line in lines]).reshape(count, 3, 3),
        busbar=busbar,
        customer_bus=np.array([node[row.bus] for row in tables.customers], dtype=np.intp),
        connected=np.array([_present(row.phases) for row in tables.customers]).reshape(-1, 3),
        bus_count=len(number),
        nominal_volt=nominal,
        source_ohm=source_ohm,
        tap=taps * (nominal[ends[:, 0]] / nominal[ends[:, 1]])[:, None],
    )
    return grid, node


def _present(phases: str) -> list[bool]:
    return [phase in phases for phase in PHASES]


def _series(line: LineRow) -> Phasors:
    """Impedances of a line in phases; without zero-sequence values those of a conductor and its return."""
    matrix = _entries(line, "r", "ohm") + 1j * _entries(line, "x", "ohm")
    if matrix.any():
        return np.asarray(matrix)
    positive = complex(line.r_ohm, line.x_ohm)
    if line.r0_ohm is None or line.x0_ohm is None:
        return np.asarray(positive * np.eye(3), dtype=np.complex128)
    return sequence_ohm(positive, complex(line.r0_ohm, line.x0_ohm))


def _shunt(line: LineRow) -> Floats:
    """Total shunt susceptances of a line in phases, S."""
    b = _entries(line, "b", "us")
    return 1e-6 * (b if b.any() else line.b_us * np.eye(3))


def _entries(line: LineRow, symbol: str, unit: str) -> Floats:
    """Symmetric matrix of a line, entry by entry; 0 for empty columns."""
    return np.array(
        [
            [getattr(line, f"{symbol}_{''.join(sorted(one + other))}_{unit}") or 0.0 for other in PHASES]
            for one in PHASES
        ]
    )
