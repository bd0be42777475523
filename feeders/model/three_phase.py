"""Three-phase model in per unit from a feeder's tables.

Customers have one phase or all three. The model of the monitors, `feeders.model.site.load`, has one customer
for each phase.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from feeders.format.columns import FeederTables, LineRow
from feeders.format.tables import validate
from feeders.format.validation import Tree, cells_of, series_ohm, shunt_us
from feeders.model.equipment import (
    Equipment,
    Referred,
    equipment,
    find,
    names,
    not_radial,
    of_customers,
    refer,
    without_impedance,
)
from gridsec.arrays import Bools, Floats, Ints, Phasors, frozen
from gridsec.errors import FeederInvalid, Problem
from gridsec.grid.three_phase import PHASES, ThreePhaseFeeder, sequence_matrix


class Ties(NamedTuple):
    """Lines that close loops, in the form of `grid.meshed.PhasedMesh`: ends, phases, z and charging."""

    ends: Ints
    phases: Bools
    z: Phasors
    charging: Floats


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ThreePhaseSite(Equipment):
    """Feeder in three phases, powers in units of `base_kva`: as `gridsec.grid.three_phase.per_customer`."""

    feeder: ThreePhaseFeeder  # The radial tree, pu; powers of single phases in thirds of `base_kva`
    base_volt: Floats  # (b + 1, 3), 1 pu of every phase of every bus, V, see `feeders.model.equipment`
    nominal_volt: Floats  # (b + 1,), nominal voltage of every bus, V

    @property
    def customer_volt(self) -> Floats:
        """1 pu at each customer, V, (N,): the mean of its phases."""
        return of_customers(self.base_volt[self.feeder.bus], self.feeder.connected)

    @property
    def customer_nominal(self) -> Floats:
        """Nominal voltage of every customer, V, (N,)."""
        return np.asarray(self.nominal_volt[self.feeder.bus])


def load_three_phase(path_or_name: Path | str) -> ThreePhaseSite:
    """Load a feeder in three phases: a folder, or the name of a bundled feeder; errors as `three_phase`."""
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

    Raises FeederInvalid for invalid tables, missing zero sequences or matrices, or closed loops.
    """
    site, ties = spanned(tables)
    if ties.ends.size:
        raise not_radial()
    return site


def spanned(tables: FeederTables) -> tuple[ThreePhaseSite, Ties]:
    """`three_phase` of a tree with every phase of every bus, and the lines that close loops.

    Raises FeederInvalid for invalid tables, or without such a tree.
    """
    problems = validate(tables) or unsupported(tables)
    if problems:
        raise FeederInvalid(problems)
    return spanned_valid(tables)


def spanned_valid(tables: FeederTables) -> tuple[ThreePhaseSite, Ties]:
    """`spanned` of valid and supported tables."""
    base, found = refer(tables)
    beyond = _beyond(base.lines, base.ties, found)
    if beyond:
        raise FeederInvalid(beyond)
    site = ThreePhaseSite(
        feeder=_feeder(tables, base, found),
        base_volt=frozen(base.bus),
        nominal_volt=frozen(base.nominal),
        **equipment(tables, base, found),
    )
    ends = [(found.group[tie.from_bus], found.group[tie.to_bus]) for tie in base.ties]
    blocks = _blocks(base.ties, base.tie, tables.meta.base_kva)
    return site, Ties(np.array(ends, dtype=np.intp).reshape(-1, 2), *blocks)


def _feeder(tables: FeederTables, base: Referred, found: Tree) -> ThreePhaseFeeder:
    meta = tables.meta
    present, z, charging = _blocks(base.lines, base.branch, meta.base_kva)
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
            f"lines, line {tie.line!r} closes a loop and brings phase {phase!r} to {bus!r}, which no line of "
            "the tree has there; expected lines in parallel of single phases as one row with a matrix",
        )
        for tie in ties
        for bus in (tie.from_bus, tie.to_bus)
        for phase in tie.phases
        if phase not in there[found.group[bus]]
    ]


def series_of(line: LineRow) -> Phasors:
    """Impedance matrix of a line in phases, ohm; only entries of its phases count."""
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


def _why(tables: FeederTables) -> str:
    """First cause of a model in three phases, as the end of a sentence."""
    causes = [f"customer {row.customer!r}" for row in tables.customers if row.phases != "abc"]
    causes += [f"line {row.line!r}" for row in tables.lines if row.closed and row.in_phases]
    return f" ({causes[0]} makes the feeder one in three phases)" if causes else ""


def unsupported(tables: FeederTables) -> tuple[Problem, ...]:
    """Problems of valid tables that the three-phase model does not support, and missing cells."""
    return (
        *(problem for line in tables.lines if line.closed for problem in _line_problems(line, tables)),
        *without_impedance(tables),
    )


def _line_problems(line: LineRow, tables: FeederTables) -> Iterator[Problem]:
    where = f"lines, line {line.line!r}"
    given = (line.r0_ohm is not None) + (line.x0_ohm is not None)
    if line.fuses:
        if line.phases != "abc":
            text = f"phases {line.phases!r} without impedance; a switch must join all three"
            yield Problem("absent-phase", f"{where}: {text}")
        if line.r0_ohm or line.x0_ohm:
            text = "has an impedance only in the zero sequence; expected both or none"
            yield Problem("inconsistent", f"{where}: {text}")
    elif given == 2 and line.phases == "abc" and line.r0_ohm == line.x0_ohm == 0.0:
        text = "has no impedance in the zero sequence; expected that of its return"
        yield Problem("zero-impedance", f"{where}: {text}")
    elif given == 1 or (given == 0 and len(line.phases) > 1 and series_ohm(cells_of(line)) is None):
        missing = "r0_ohm" if line.r0_ohm is None else "x0_ohm"
        text = "is missing; several phases need the zero sequence or a matrix"
        yield Problem("missing", f"{where}, column {missing}: {text}{_why(tables)}")
