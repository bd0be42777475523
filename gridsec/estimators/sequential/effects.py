"""What every customer's powers do to the squared voltages: columns of 2R and 2X, kept or made when asked for.

One column of a balanced feeder takes O(n) (`gridsec.grid.network.columns`), and no matrix of a large feeder
is kept. But the ticks in which liars are found and named ask for hundreds of columns, and on a feeder of
ordinary size all of them together take little room: there they are made once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.grid.network import Network, Power

# Entries of 2R and 2X together up to which both are kept: 4 MB.
_KEPT = 1 << 19
# Part of the rows of a table from which on none are picked.
_SOME = 0.25
# Columns that are made together where they are not kept.
_PART = 256


@dataclass(frozen=True, slots=True, eq=False)
class Effects:
    """Changes of the squared voltages per customer's power. N customers, n places.

    Powers have numbers: the active ones come first, customer by customer, then the reactive ones.

    Attributes
    ----------
    feeder
        The feeder.
    table
        Derived. 2R and 2X side by side, (n, 2 N), where they are small enough to be kept; else None.
    """

    feeder: Network
    table: Floats | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        table, every = None, np.arange(self.feeder.bus.size)
        if 2 * len(self.feeder.buses) * every.size <= _KEPT:
            table = frozen(np.hstack([self.feeder.columns(power, every) for power in Power]))
        object.__setattr__(self, "table", table)

    def columns(self, power: Power, customers: Ints) -> Floats:
        """What some customers' powers do at every place, (n, k).

        Parameters
        ----------
        power
            Which power.
        customers : (k,)
            The customers.
        """
        if self.table is None:
            return self.feeder.columns(power, customers)
        return self.table.take(customers + self.feeder.bus.size * (power is Power.REACTIVE), axis=1)

    def of(self, which: Ints) -> Floats:
        """The same of some powers by their numbers, (n, k).

        Parameters
        ----------
        which : (k,)
            The numbers.
        """
        if self.table is not None:
            return self.table.take(which, axis=1)
        count, out = self.feeder.bus.size, np.empty((len(self.feeder.buses), which.size))
        for power, some in ((Power.ACTIVE, which < count), (Power.REACTIVE, which >= count)):
            out[:, some] = self.feeder.columns(power, which[some] % count)
        return out

    def along(self, customers: Ints, weights: Floats) -> Floats:
        """What each power does to the weighted sum of some customers' voltages, (2 N,).

        Parameters
        ----------
        customers, weights : (p,)
            The customers whose voltages are summed, each once, and their weights.
        """
        if self.table is None:
            return np.concatenate(
                [self.feeder.weighted_sensitivity(power, customers, weights) for power in Power]
            )
        at = self.feeder.bus[customers]
        if at.size < _SOME * len(self.table):
            return np.asarray(weights @ self.table[at])
        # A product with all of it costs less than picking most of it.
        return np.asarray(np.bincount(at, weights=weights, minlength=len(self.table)) @ self.table)

    def at(self, places: Ints) -> Iterator[Floats]:
        """What all powers do at some places, by number, (k, …) each, in parts that are small.

        Parameters
        ----------
        places : (k,)
            The places.
        """
        if self.table is not None:
            yield self.table[places]
            return
        every = np.arange(self.feeder.bus.size)
        for power in Power:
            for first in range(0, every.size, _PART):
                yield self.feeder.columns(power, every[first : first + _PART])[places]
