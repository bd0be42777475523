"""What every customer's powers do to the squared voltages: columns of 2R and 2X, kept or made when asked for.

One column of a balanced feeder takes O(n) (`gridsec.network.columns`), and no matrix of a large feeder is
kept. But the ticks in which liars are found and named ask for hundreds of columns, and on a feeder of
ordinary size all of them together take little room: there they are made once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.network import Network, Power, along, columns

# Entries of 2R and 2X together up to which both are kept: 4 MB.
_KEPT = 1 << 19
# Part of the rows of a table from which on none are picked.
_SOME = 0.25
# Columns that are made together where they are not kept.
_PART = 256


@dataclass(frozen=True, slots=True, eq=False)
class Effects:
    """Changes of the squared voltages per customer's power. N customers, n places.

    Attributes
    ----------
    feeder
        The feeder.
    tables
        Derived. 2R and 2X, (n, N) each, where they are small enough to be kept; else None.
    """

    feeder: Network
    tables: tuple[Floats, Floats] | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        customers, tables = self.feeder.bus.size, None
        if 2 * len(self.feeder.buses) * customers <= _KEPT:
            every = np.arange(customers)
            active, reactive = (frozen(columns(self.feeder, power, every)) for power in Power)
            tables = active, reactive
        object.__setattr__(self, "tables", tables)

    def columns(self, power: Power, customers: Ints) -> Floats:
        """What some customers' powers do at every place, (n, k).

        Parameters
        ----------
        power
            Which power.
        customers : (k,)
            The customers.
        """
        if self.tables is None:
            return columns(self.feeder, power, customers)
        return self.tables[power is Power.REACTIVE].take(customers, axis=1)

    def along(self, power: Power, customers: Ints, weights: Floats) -> Floats:
        """What each customer's power does to the weighted sum of some customers' voltages, (N,).

        Parameters
        ----------
        power
            Which power.
        customers, weights : (p,)
            The customers whose voltages are summed, each once, and their weights.
        """
        if self.tables is None:
            return along(self.feeder, power, customers, weights)
        table, at = self.tables[power is Power.REACTIVE], self.feeder.bus[customers]
        if at.size < _SOME * len(table):
            return np.asarray(weights @ table[at])
        # A product with all of it costs less than picking most of it.
        return np.asarray(np.bincount(at, weights=weights, minlength=len(table)) @ table)

    def at(self, places: Ints) -> Iterator[Floats]:
        """What all powers do at some places, active ones first, (k, …) each, in parts that are small.

        Parameters
        ----------
        places : (k,)
            The places.
        """
        if self.tables is not None:
            yield from (table[places] for table in self.tables)
            return
        every = np.arange(self.feeder.bus.size)
        for power in Power:
            for first in range(0, every.size, _PART):
                yield columns(self.feeder, power, every[first : first + _PART])[places]
