"""Sensitivities of the voltages to the powers, and the dictionary of faults: wrong powers and inverters.

One column of 2R or 2X takes O(n) (`gridsec.grid.network.columns`). Up to `_KEPT` entries both matrices are
kept: a tick with a search asks for hundreds of columns.

A fault is a direction of the voltages. An unknown amplitude of direction a with standard deviation s lowers
the chi-square ``m^T Q m`` by

    (a^T Q m)^2 / (1 / s^2 + a^T Q a),

removing meter j as well by ``g^T G^-1 g`` with g and G the weights and the precision of both. A manipulated
voltage may come with false powers of the same customer, so the pair is one move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen
from gridsec.estimators.sequential.posterior import (
    LeaveOneOut,
    Posterior,
    RankOneUpdate,
    add_unknown,
    remove_meter,
)
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


# --- Directions of possible faults ---


_SUSPECT_CHARGE, _FEW_SUSPECTS, _LEAST_CHARGE = 2.0, 3, 0.5
"""Charge of a suspect's false power: up to `_FEW_SUSPECTS` suspects, and least, in accusations."""


def false_power_charge(suspects: int) -> float:
    """Charge for the false power of a suspect meter's customer, in accusations of a meter.

    The charge is 2 up to three suspects, then inversely proportional to their number, at least 0.5. Among
    many suspects a high charge would accuse honest neighbours instead.
    """
    return max(_SUSPECT_CHARGE * min(1.0, _FEW_SUSPECTS / max(suspects, 1)), _LEAST_CHARGE)


@dataclass(frozen=True, slots=True, eq=False)
class FaultDictionary:
    """Directions of possible faults. n buses, p meters, k directions."""

    std: Floats  # (k,) standard deviation of each amplitude, pu
    charge: Floats  # (k,) cost of accusing it, in accusations of a meter
    size: Floats  # (k,) sum over the meters of its squared changes
    meter: Ints  # (k,) meter of its customer, charged at most `false_power_charge` as a suspect; -1 for none
    columns: Callable[[Ints], Floats]  # `columns(which)`: changes of every squared voltage per unit, (n, …)
    weighted: Callable[[Floats], Floats]  # `along(weights)`: weighted sum of its changes at the meters, (k,)

    def charges(self, which: Ints, trusted: Bools, suspects: int) -> Floats:
        """Cost of accusing directions (c,), in accusations of a meter; suspects: number of suspect meters."""
        charge, own = self.charge[which], self.beside_suspect(which, trusted)
        return np.where(own, np.minimum(charge, false_power_charge(suspects)), charge)

    def beside_suspect(self, which: Ints, trusted: Bools) -> Bools:
        """Directions (c,) that are the power of a customer with a suspect meter, (c,)."""
        return np.asarray((self.meter[which] >= 0) & ~trusted[self.meter[which]])

    def reduced(self) -> FaultDictionary:
        """Fault dictionary with reduced charges, for searching alternative explanations."""
        return replace(self, charge=np.minimum(self.charge, _SUSPECT_CHARGE))


_CANDIDATES = 64
"""Directions that a search tries, those of the largest gradient."""
_TINY = 1e-6

Move = Callable[[], RankOneUpdate]
"""Changes a posterior when called."""


class FaultGains:
    """Gains of the directions during a search: Q A follows Q by rank one, diag(A^T Q A) by squares.

    The moves of the search change the posterior `now`. weights: (p,) Q m. available: (p,) meters with a
    reading. protected: (k,) meters that stay trusted.
    """

    def __init__(
        self, now: Posterior, dictionary: FaultDictionary, weights: Floats, available: Bools, protected: Ints
    ) -> None:
        towards = dictionary.weighted(weights) ** 2 / np.maximum(dictionary.size, _TINY)
        self.faults, self.now, self.available = dictionary, now, available
        self.index = (-towards).argsort()[:_CANDIDATES]
        self.columns = dictionary.columns(self.index)
        self.at_meters = self.columns[now.prior.meters]
        self.std, self.meter = dictionary.std[self.index], dictionary.meter[self.index]
        at, Q = now.precision()
        at_meters = self.at_meters[at]
        self.spread = np.zeros_like(self.at_meters)
        self.spread[at] = spread = Q @ at_meters
        self.form = np.einsum("ij,ij->j", spread, at_meters)
        self.protected = np.isin(self.meter, protected) if protected.size else None
        self.accused: list[int] = []

    @property
    def accused_faults(self) -> tuple[int, ...]:
        """Accused directions, indices of the dictionary."""
        return tuple(self.index[self.accused].tolist())

    def best_move(self, loo: LeaveOneOut, penalty: float, than: float) -> list[Move]:
        """Steps of the best direction, alone or with its meter removed, if it gains more than `than`.

        penalty: least gain of an accusation.
        """
        trusted = self.now.trusted
        suspects = int(np.count_nonzero(self.available & ~trusted))
        alone = self._gains(loo.weights) - penalty * self.faults.charges(self.index, trusted, suspects)
        both = self._gains_with_meter(loo.weights) - penalty * (1.0 + false_power_charge(suspects))
        if self.protected is not None:
            both[self.protected] = -np.inf
        alone[self.accused] = both[self.accused] = -np.inf
        k, pair = int(alone.argmax()), int(both.argmax())
        if max(alone[k], both[pair]) <= than:
            return []
        if alone[k] >= both[pair]:
            return [lambda: self._accuse(k)]
        return [
            lambda: self._accuse(pair),
            lambda: self.update(remove_meter(self.now, int(self.meter[pair]))),
        ]

    def update(self, update: RankOneUpdate) -> RankOneUpdate:
        """Update the gains after a change of the posterior."""
        along = update.q @ self.at_meters
        self.spread += np.multiply.outer(update.factor * update.q, along)
        self.form += update.factor * along**2
        return update

    def _gains(self, weights: Floats) -> Floats:
        """Fall of the chi-square by each direction, (k,)."""
        return np.asarray((weights @ self.at_meters) ** 2 / (self.std**-2.0 + self.form))

    def _gains_with_meter(self, weights: Floats) -> Floats:
        """The same with its meter removed, (k,); -inf without a trusted meter."""
        at = self.meter
        a, b = self.std**-2.0 + self.form, self.now.diagonal()[at]
        c = self.spread[at, np.arange(at.size)]
        u, v = weights @ self.at_meters, weights[at]
        free = (at >= 0) & self.now.trusted[at]
        determinant = np.where(free, a * b - c * c, 1.0)
        return np.where(free, (b * u * u - 2.0 * c * u * v + a * v * v) / determinant, -np.inf)

    def _accuse(self, k: int) -> RankOneUpdate:
        self.accused.append(k)
        return self.update(add_unknown(self.now, self.columns[:, k], float(self.std[k])))
