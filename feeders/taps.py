"""Taps: ideal transformers of fixed ratio inside a feeder, referred to the busbar's side.

Behind a tap t, ``V_from = t V``, every voltage has another base: ``a_k V`` with V the nominal voltage and a_k
the product of ``1 / t`` over the taps on the way from the busbar to bus k. With the impedances in the base of
their own side, ``3 (a V)^2 / (1000 S)``, the ideal transformer is gone: in per unit this is a feeder without
it. Each phase may have a tap of its own; a mutual impedance is then in ``3 a_φ a_ψ V^2 / (1000 S)``, so that
matrices stay symmetric. Only what goes between volts and per unit, customer by customer, needs a_k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from feeders.schema import FeederTables, LineRow
from feeders.topology import Tree
from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.load_phases import ThreePhaseSite


@dataclass(frozen=True, slots=True, eq=False)
class Referred:
    """A feeder's tree with its voltage bases, as factors on the nominal voltage. N customers, b + 1 buses.

    Attributes
    ----------
    lines
        The line that feeds bus k + 1.
    bus : (b + 1, 3)
        a of every phase of every bus, 1 at the busbar.
    branch : (b, 3)
        That of each line's impedance and charging, which are behind its tap as seen from `from_bus`.
    customer : (N,)
        That of every customer, in the first of its phases.
    """

    lines: list[LineRow]
    bus: Floats
    branch: Floats
    customer: Floats


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
    problems = _problems(closed, found)
    if problems:
        raise FeederInvalid(problems)
    lines = [closed[k] for k in found.branch]
    bus, branch = np.ones((len(found.buses), 3)), np.ones((len(lines), 3))
    for k, (line, above) in enumerate(zip(lines, found.parent, strict=True)):
        if found.group[line.from_bus] == above:
            bus[k + 1] = branch[k] = bus[above] / line.taps
        else:
            branch[k] = bus[above]
            bus[k + 1] = bus[above] * line.taps
    at = np.array([found.group[row.bus] for row in tables.customers], dtype=np.intp)
    phase = np.array(["abc".index(row.phases[0]) for row in tables.customers], dtype=np.intp)
    return Referred(lines, bus, branch, bus[at, phase])


def refuse(site: Site | ThreePhaseSite) -> None:
    """Raise `FeederInvalid` if a feeder has taps, for what knows one voltage base only."""
    if (site.base_volt != site.feeder.base_volt).any():
        raise FeederInvalid(["lines, column tap: not 1 everywhere, and this takes feeders without taps only"])


def _problems(closed: Sequence[LineRow], found: Tree) -> list[str]:
    out = []
    for line in (line for line in closed if set(line.taps) != {1.0}):
        where = (
            f"lines, line {line.line!r}, column tap: {' '.join(f'{tap:g}' for tap in sorted({*line.taps}))}"
        )
        if line.r_ohm == line.x_ohm == 0.0:
            out.append(f"{where} on a line without impedance; expected the transformer's r_ohm and x_ohm")
        if found.ties:
            out.append(f"{where} where closed lines form loops; expected 1 everywhere, or a radial feeder")
    return out
