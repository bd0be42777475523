"""Between volts and per unit of a study: customer by customer, because of taps.

A limit or a curve is in parts of the nominal voltage, the model in parts of each place's own base
(`feeders.taps`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from feeders.topology import Edge, tree
from gridsec.arrays import Floats

if TYPE_CHECKING:
    from feeders.load import Site
    from feeders.load_phases import ThreePhaseSite

__all__ = ["Bases", "line_rows"]


@dataclass(frozen=True, slots=True, eq=False)
class Bases:
    """What 1 pu is, for N customers.

    Attributes
    ----------
    volt : (N,)
        1 pu at every customer, V.
    nominal : (N,)
        The nominal voltage there, V: 1 in limits and curves.
    """

    volt: Floats
    nominal: Floats

    @classmethod
    def of(cls, site: Site) -> Self:
        """The bases of a feeder."""
        return cls(site.customer_volt, site.customer_nominal)

    @property
    def ratio(self) -> Floats:
        """What 1 pu is of the nominal voltage, (N,): 1 but for taps."""
        return np.asarray(self.volt / self.nominal)

    def band(self, low: float, high: float) -> tuple[Floats, Floats]:
        """Limits in parts of the nominal voltage as pu of every customer, (N,) each."""
        return low / self.ratio, high / self.ratio

    def extremes(self, v: Floats) -> tuple[float, float]:
        """The voltages that are lowest and highest of their nominal voltage, V.

        Parameters
        ----------
        v : (…, N)
            Voltages, pu; NaN is that of both.
        """
        told = (v * self.ratio).reshape(-1, self.volt.size)
        lows, highs = told.min(axis=0), told.max(axis=0)
        lowest, highest = int(np.argmin(lows)), int(np.argmax(highs))
        return (
            float(lows[lowest] * self.nominal[lowest]),
            float(highs[highest] * self.nominal[highest]),
        )


def line_rows(site: Site | ThreePhaseSite) -> list[int]:
    """Row in lines.csv of every branch of the feeder's tree, and then of every line that closes a loop.

    Parameters
    ----------
    site
        The feeder.
    """
    rows, group = site.tables.lines, site.bus_of_file
    closed = [k for k, line in enumerate(rows) if line.closed]
    lines = [rows[k] for k in closed]
    # Buses that are one for the model are joined by lines without impedance.
    joins = [group[row.from_bus] == group[row.to_bus] for row in lines]
    edges = [
        Edge(row.line, row.from_bus, row.to_bus, zero, phases=len(row.phases))
        for row, zero in zip(lines, joins, strict=True)
    ]
    found = tree(site.tables.meta.busbar, edges)
    return [closed[k] for k in (*found.branch, *found.ties)]
