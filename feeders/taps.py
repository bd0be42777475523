"""Taps and transformers inside a feeder: ideal ones of fixed ratio, referred to the busbar's side.

Behind a tap t, ``V_from = t V``, every voltage has another base: ``a_k V_k`` with V_k the nominal voltage of
bus k, which transformers may have changed on the way, and a_k the product of ``1 / t`` over the taps between
the busbar and bus k. With the impedances in the base of their own side, ``3 (a V)^2 / (1000 S)``, the ideal
transformer is gone: in per unit this is a feeder without it. Each phase may have a tap of its own; a mutual
impedance is then in ``3 a_φ a_ψ V^2 / (1000 S)``, so that matrices stay symmetric. Only what goes between
volts and per unit, customer by customer, needs a_k V_k; what is standardised in parts of the nominal voltage
needs V_k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from feeders.levels import nominal_volts
from feeders.schema import FeederTables, LineRow
from feeders.topology import Tree
from gridsec.arrays import Bools, Floats
from gridsec.errors import FeederInvalid, Problem


@dataclass(frozen=True, slots=True, eq=False)
class Referred:
    """A feeder's tree with its voltages. N customers, b + 1 buses.

    Attributes
    ----------
    lines
        The line that feeds bus k + 1.
    ties
        The t lines that close loops.
    nominal : (b + 1,)
        Nominal voltage of every bus, V.
    bus : (b + 1, 3)
        Voltage base of every phase of every bus, V.
    branch : (b, 3)
        That of each line's impedance and charging, which are behind its tap as seen from `from_bus`.
    tie : (t, 3)
        The same of each tie.
    customer, customer_nominal : (N,)
        Voltage base of every customer, the mean of its phases, and its nominal voltage, V.
    """

    lines: list[LineRow]
    ties: list[LineRow]
    nominal: Floats
    bus: Floats
    branch: Floats
    tie: Floats
    customer: Floats
    customer_nominal: Floats


def refer(tables: FeederTables, closed: Sequence[LineRow], found: Tree) -> Referred:
    """Refer a feeder to its busbar.

    Parameters
    ----------
    tables
        The feeder.
    closed, found
        Its closed lines, and their tree.

    Raises
    ------
    FeederInvalid
        If a tap is where it cannot be.
    """
    lines, ties = [closed[k] for k in found.branch], [closed[k] for k in found.ties]
    nominal = np.array(nominal_volts(found, closed, tables.meta.voltage_volt))
    bus, branch = _factors(lines, found)
    tie = np.array([bus[found.group[line.from_bus]] / line.taps for line in ties]).reshape(-1, 3)
    there = np.array([bus[found.group[line.to_bus]] for line in ties]).reshape(-1, 3)
    problems = [*_problems(closed), *_around(ties, tie / there)]
    if problems:
        raise FeederInvalid(problems)
    at = np.array([found.group[row.bus] for row in tables.customers], dtype=np.intp)
    own_phases = [[phase in row.phases for phase in "abc"] for row in tables.customers]

    def own(rows: Sequence[LineRow]) -> Floats:
        return nominal[[found.group[line.to_bus] for line in rows], None]

    base = bus * nominal[:, None]
    customer = of_customers(base[at], np.array(own_phases, dtype=np.bool_).reshape(-1, 3))
    return Referred(lines, ties, nominal, base, branch * own(lines), tie * own(ties), customer, nominal[at])


def of_customers(base: Floats, connected: Bools) -> Floats:
    """Return what 1 pu of each customer is, V, (N,): the mean of its phases, which is what its meter reads.

    Parameters
    ----------
    base : (N, 3)
        Voltage bases of the phases of their buses, V.
    connected : (N, 3)
        Which phases they have.
    """
    first = np.take_along_axis(base, connected.argmax(axis=1)[:, None], axis=1)
    # Where all are the same the mean is, to the last bit.
    apart = np.where(connected, base - first, 0.0).sum(axis=1) / connected.sum(axis=1)
    return np.asarray(first[:, 0] + apart)


def _factors(lines: Sequence[LineRow], found: Tree) -> tuple[Floats, Floats]:
    """The products of taps, ``a`` of every bus and of every line's impedance, in each phase."""
    bus, branch = np.ones((len(found.buses), 3)), np.ones((len(lines), 3))
    for k, (line, above) in enumerate(zip(lines, found.parent, strict=True)):
        if found.group[line.from_bus] == above:
            bus[k + 1] = branch[k] = bus[above] / line.taps
        else:
            branch[k] = bus[above]
            bus[k + 1] = bus[above] * line.taps
    return bus, branch


def _problems(closed: Sequence[LineRow]) -> list[Problem]:
    out = []
    for line in (line for line in closed if set(line.taps) != {1.0}):
        where = (
            f"lines, line {line.line!r}, column tap: {' '.join(f'{tap:g}' for tap in sorted({*line.taps}))}"
        )
        if line.r_ohm == line.x_ohm == 0.0:
            out.append(
                Problem(
                    "zero-impedance",
                    f"{where} on a line without impedance; expected the transformer's r_ohm and x_ohm",
                )
            )
    return out


def _around(ties: Sequence[LineRow], ratio: Floats) -> list[Problem]:
    """Loops whose taps drive a current around without any load, which the model does not have."""
    return [
        Problem(
            "inconsistent",
            f"lines, line {line.line!r} closes a loop around which the taps multiply to {far:.6g}; "
            "expected 1",
        )
        for line, own in zip(ties, ratio, strict=True)
        if abs((far := _farthest(own[["abc".index(phase) for phase in line.phases]])) - 1.0) > _ROUNDING
    ]


def _farthest(ratio: Floats) -> float:
    """The one that is the least 1."""
    return float(ratio[np.abs(ratio - 1.0).argmax()])


# Ratios around a loop are products of a few numbers of the files.
_ROUNDING = 1e-9
