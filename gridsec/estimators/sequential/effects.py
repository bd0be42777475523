"""Sensitivities of the squared voltages to every customer's powers: columns of 2R and 2X.

One column takes O(n) (`gridsec.grid.network.columns`). Up to `_KEPT` entries both matrices are kept: a tick
with a search asks for hundreds of columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.grid.network import Network, Power

_KEPT = 1 << 19
"""Largest number of entries of 2R and 2X that are kept, 4 MB."""
_SELECTED_PART = 0.25
"""Part of the table's rows from which the whole product is faster than a selection."""
_BLOCK = 256
"""Columns computed at once where they are not kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivities:
    """Changes of the squared voltages per power. N customers, n places.

    Powers have numbers: active ones first, customer by customer, then reactive ones.
    """

    feeder: Network  # the feeder
    table: Floats | None = field(
        init=False, repr=False
    )  # derived: [2R, 2X], (n, 2 N), on small feeders; else None

    def __post_init__(self) -> None:
        table, every = None, np.arange(self.feeder.bus.size)
        if 2 * len(self.feeder.buses) * every.size <= _KEPT:
            table = frozen(np.hstack([self.feeder.columns(power, every) for power in Power]))
        object.__setattr__(self, "table", table)

    def columns(self, power: Power, customers: Ints) -> Floats:
        """Changes at every place by one power of customers (k,), (n, k)."""
        if self.table is None:
            return self.feeder.columns(power, customers)
        return self.table.take(customers + self.feeder.bus.size * (power is Power.REACTIVE), axis=1)

    def numbered(self, which: Ints) -> Floats:
        """Changes at every place by powers with numbers `which` (k,), (n, k)."""
        if self.table is not None:
            return self.table.take(which, axis=1)
        count, out = self.feeder.bus.size, np.empty((len(self.feeder.buses), which.size))
        for power, some in ((Power.ACTIVE, which < count), (Power.REACTIVE, which >= count)):
            out[:, some] = self.feeder.columns(power, which[some] % count)
        return out

    def weighted(self, customers: Ints, weights: Floats) -> Floats:
        """Change of the weighted sum of the voltages of customers (p,) by each power, (2 N,)."""
        if self.table is None:
            return np.concatenate(
                [self.feeder.weighted_sensitivity(power, customers, weights) for power in Power]
            )
        at = self.feeder.bus[customers]
        if at.size < _SELECTED_PART * len(self.table):
            return np.asarray(weights @ self.table[at])
        # A product with the whole table is faster than a selection of most rows.
        return np.asarray(np.bincount(at, weights=weights, minlength=len(self.table)) @ self.table)

    def rows(self, places: Ints) -> Iterator[Floats]:
        """Changes at places (k,) by all powers in the order of their numbers, in parts (k, …)."""
        if self.table is not None:
            yield self.table[places]
            return
        every = np.arange(self.feeder.bus.size)
        for power in Power:
            for first in range(0, every.size, _BLOCK):
                yield self.feeder.columns(power, every[first : first + _BLOCK])[places]
