"""Three-phase model in per unit from a feeder's tables.

Customers have one phase or all three. The model of the monitors, `feeders.model.site.load`, has one customer
for each phase.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from feeders.format.matrices import cells_of, series_ohm, shunt_us
from feeders.format.tables import FeederTables, LineRow, validate
from feeders.format.topology import Edge, Tree, tree
from feeders.model.equipment import (
    LoadModel,
    Referred,
    accuracy,
    digest,
    find,
    inverters,
    load_model,
    metered_customers,
    names,
    of_customers,
    positions,
    refer,
)
from gridsec.arrays import Floats, Ints, Phasors, frozen
from gridsec.errors import FeederInvalid, Problem
from gridsec.grid.droop import Droop
from gridsec.grid.meter import MeterAccuracy
from gridsec.grid.three_phase import PHASES, ThreePhaseFeeder, sequence_matrix

if TYPE_CHECKING:
    from gridsec.arrays import Bools


class Ties(NamedTuple):
    """Lines that close loops, in the form of `grid.meshed.PhasedMesh`: ends, phases, z and charging."""

    ends: Ints
    phases: Bools
    z: Phasors
    charging: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ThreePhaseSite:
    """Feeder in three phases. N customers, p meters, b + 1 buses.

    Attributes
    ----------
    tables
        Content of the files in SI.
    feeder
        The radial tree, pu; powers of single phases in thirds of `base_kva`.
    base_volt : (b + 1, 3)
        1 pu of every phase of every bus, V, see `feeders.model.equipment`.
    nominal_volt : (b + 1,)
        Nominal voltage of every bus, V.
    droop, meters, meter_ids, accuracy, bus_of_file, xy, loads, digest
        As in `feeders.model.site.Site`, in units of `base_kva`: as `gridsec.grid.three_phase.per_customer`.
    """

    tables: FeederTables
    feeder: ThreePhaseFeeder
    droop: Droop
    meters: Ints
    meter_ids: tuple[str, ...]
    accuracy: MeterAccuracy
    bus_of_file: Mapping[str, int]
    xy: Floats | None
    loads: LoadModel
    base_volt: Floats
    nominal_volt: Floats
    digest: str

    @property
    def customer_volt(self) -> Floats:
        """1 pu at each customer, V, (N,): the mean of its phases."""
        return of_customers(self.base_volt[self.feeder.bus], self.feeder.connected)

    @property
    def customer_nominal(self) -> Floats:
        """Nominal voltage of every customer, V, (N,)."""
        return np.asarray(self.nominal_volt[self.feeder.bus])


def load_three_phase(path_or_name: Path | str) -> ThreePhaseSite:
    """Load a feeder in three phases.

    Parameters
    ----------
    path_or_name
        A folder, or the name of a bundled feeder (`feeders.model.site.names`).

    Raises
    ------
    FeederInvalid
        With every problem of the files, or for an unknown feeder.
    """
    return three_phase(find(path_or_name))


def three_phase_names() -> list[str]:
    """Names of the bundled feeders in three phases."""
    return sorted(set(names(balanced=False)) - set(names()))


def three_phase(tables: FeederTables) -> ThreePhaseSite:
    """Build the three-phase model from a feeder's tables.

    A line has the matrix of its columns, or `sequence_matrix` of its positive and zero sequence, which is
    cyclically symmetric. A line of one phase has the self-impedance ``(2 z1 + z0) / 3``, or without
    zero-sequence values ``r_ohm + j x_ohm`` of the conductor and its return together. Charging without a
    matrix is that of cores screened from each other, ``b_us`` in each phase.

    With ``z_base = 3 V^2 / (1000 S)`` ohm for V volts phase to neutral and S kVA of all three phases, as on
    a balanced feeder; a single-phase customer's kW divide by ``S / 3``.

    Parameters
    ----------
    tables
        The feeder's tables.

    Raises
    ------
    FeederInvalid
        For invalid tables, missing zero sequences or matrices, or closed loops.
    """
    site, ties = spanned(tables)
    if ties.ends.size:
        raise FeederInvalid(
            [Problem("not-radial", "lines: closed lines form loops; a radial feeder is required")]
        )
    return site


def spanned(tables: FeederTables) -> tuple[ThreePhaseSite, Ties]:
    """`three_phase` of a tree with every phase of every bus, and the lines that close loops.

    Parameters
    ----------
    tables
        The feeder's tables.

    Raises
    ------
    FeederInvalid
        For invalid tables, or without such a tree.
    """
    problems = validate(tables) or unsupported(tables)
    if problems:
        raise FeederInvalid(problems)
    meta = tables.meta
    closed = [line for line in tables.lines if line.closed]
    edges = [Edge(row.line, row.from_bus, row.to_bus, _fuses(row), phases=len(row.phases)) for row in closed]
    found = tree(meta.busbar, edges)
    base = refer(tables, closed, found)
    beyond = _beyond(base.lines, base.ties, found)
    if beyond:
        raise FeederInvalid(beyond)
    metered = metered_customers(tables)
    site = ThreePhaseSite(
        tables=tables,
        feeder=_feeder(tables, base, found),
        droop=inverters(tables, base.customer / base.customer_nominal),
        meters=metered,
        meter_ids=tuple(tables.customers[k].meter for k in metered),
        accuracy=accuracy(tables, base.customer, base.customer_nominal),
        bus_of_file=found.group,
        xy=positions(tables, found),
        loads=load_model(tables),
        base_volt=frozen(base.bus),
        nominal_volt=frozen(base.nominal),
        digest=digest(tables),
    )
    return site, _ties(tables, base, found)


def _feeder(tables: FeederTables, base: Referred, found: Tree) -> ThreePhaseFeeder:
    meta, lines = tables.meta, base.lines
    side = base.branch
    present, z, charging = _blocks(lines, side, meta.base_kva)
    return ThreePhaseFeeder(
        name=meta.name,
        parent=np.array(found.parent, dtype=np.intp),
        z=z,
        phases=np.vstack([np.ones((1, 3), dtype=np.bool_), present]),
        bus=np.array([found.group[row.bus] for row in tables.customers], dtype=np.intp),
        connected=np.array([_present(row.phases) for row in tables.customers]).reshape(-1, 3),
        customers=tuple(row.customer for row in tables.customers),
        buses=found.buses,
        base_volt=meta.voltage_volt,
        base_kva=meta.base_kva,
        charging=charging,
    )


def _ties(tables: FeederTables, base: Referred, found: Tree) -> Ties:
    ends = [(found.group[tie.from_bus], found.group[tie.to_bus]) for tie in base.ties]
    side = base.tie
    blocks = _blocks(base.ties, side, tables.meta.base_kva)
    return Ties(np.array(ends, dtype=np.intp).reshape(-1, 2), *blocks)


def _blocks(lines: Sequence[LineRow], side: Floats, base_kva: float) -> tuple[Bools, Phasors, Floats]:
    """Phases (L, 3), impedances and susceptances (L, 3, 3) of lines with the voltage bases `side` (L, 3)."""
    z_base = 3.0 * (side[:, :, None] * side[:, None, :]) / (1000.0 * base_kva)
    present = np.array([_present(line.phases) for line in lines], dtype=np.bool_).reshape(-1, 3)
    both = present[:, :, None] & present[:, None, :]
    z = np.array([series_of(line) for line in lines]).reshape(-1, 3, 3) / z_base
    charging = np.array([shunt_of(line) for line in lines]).reshape(-1, 3, 3) * (1e-6 * z_base)
    return present, np.where(both, z, 0.0), np.where(both, charging, 0.0)


def _beyond(lines: Sequence[LineRow], ties: Sequence[LineRow], found: Tree) -> list[Problem]:
    """Phases that reach a bus only through a line that closes a loop, and not through the tree."""
    there = [set(PHASES), *(set(line.phases) for line in lines)]
    return [
        Problem(
            "absent-phase",
            f"lines, line {tie.line!r} closes a loop and brings phase {phase!r} to {bus!r}, which no "
            "line of the "
            "tree has there; expected lines in parallel of single phases as one row with a matrix",
        )
        for tie in ties
        for bus in (tie.from_bus, tie.to_bus)
        for phase in tie.phases
        if phase not in there[found.group[bus]]
    ]


def series_of(line: LineRow) -> Phasors:
    """Impedance matrix of a line in phases, ohm.

    Parameters
    ----------
    line
        Row of the line; only cells of its phases count.
    """
    matrix = series_ohm(cells_of(line))
    if matrix is not None:
        return matrix
    positive = np.array(complex(line.r_ohm, line.x_ohm))
    if line.r0_ohm is None or line.x0_ohm is None:
        return np.asarray(positive * np.eye(3))
    return sequence_matrix(positive, np.array(complex(line.r0_ohm, line.x0_ohm)))


def shunt_of(line: LineRow) -> Floats:
    """Total shunt susceptances of a line in phases, microsiemens; as `series_of`."""
    matrix = shunt_us(cells_of(line))
    return line.b_us * np.eye(3) if matrix is None else matrix


def _present(phases: str) -> Bools:
    return np.array([phase in phases for phase in PHASES])


def _fuses(line: LineRow) -> bool:
    return line.r_ohm == line.x_ohm == 0.0


def _why(tables: FeederTables) -> str:
    """First cause of a model in three phases, as the end of a sentence."""
    causes = [f"customer {row.customer!r}" for row in tables.customers if row.phases != "abc"]
    causes += [f"line {row.line!r}" for row in tables.lines if row.closed and row.in_phases]
    return f" ({causes[0]} makes the feeder one in three phases)" if causes else ""


def unsupported(tables: FeederTables) -> tuple[Problem, ...]:
    """Problems of valid tables that the three-phase model does not support, and missing cells."""
    problems, why = [], _why(tables)
    closed = [line for line in tables.lines if line.closed]
    for line in closed:
        where = f"lines, line {line.line!r}"
        given = (line.r0_ohm is not None) + (line.x0_ohm is not None)
        if _fuses(line):
            if line.phases != "abc":
                problems.append(
                    Problem(
                        "absent-phase",
                        f"{where}: phases {line.phases!r} without impedance; a switch must join all three",
                    )
                )
            if line.r0_ohm or line.x0_ohm:
                problems.append(
                    Problem(
                        "inconsistent",
                        f"{where}: has an impedance only in the zero sequence; expected both or none",
                    )
                )
        elif given == 2 and line.phases == "abc" and line.r0_ohm == line.x0_ohm == 0.0:
            problems.append(
                Problem(
                    "zero-impedance",
                    f"{where}: has no impedance in the zero sequence; expected that of its return",
                )
            )
        elif given == 1 or (given == 0 and len(line.phases) > 1 and series_ohm(cells_of(line)) is None):
            missing = "r0_ohm" if line.r0_ohm is None else "x0_ohm"
            problems.append(
                Problem(
                    "missing",
                    f"{where}, column {missing}: is missing; several phases need the zero sequence or "
                    "a matrix" + why,
                )
            )
    if all(map(_fuses, closed)):
        problems.append(
            Problem(
                "nothing-to-design",
                "lines: no closed line has an impedance; there is nothing to monitor below the busbar",
            )
        )
    return tuple(problems)
