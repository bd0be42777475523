"""Fault dictionary: wrong powers and inverters as directions of the voltages, and the gain of each.

An unknown amplitude of direction a with standard deviation s lowers the chi-square ``m^T Q m`` by

    (a^T Q m)^2 / (1 / s^2 + a^T Q a),

removing meter j as well by ``g^T G^-1 g`` with g and G the weights and the precision of both. A manipulated
voltage may come with false powers of the same customer, so the pair is one move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.sequential.conditional import Fit, Judged, Move, drop, loosen

_OF_A_LIAR, _FEW, _OF_MANY = 2.0, 3, 0.5
"""Charge of a suspect's false power: up to `_FEW` suspects, and least, in accusations."""


def of_a_liar(liars: int) -> float:
    """Charge for the false power of a suspect meter's customer, in accusations of a meter.

    The charge is 2 up to three suspects, then inversely proportional to their number, at least 0.5. Among
    many suspects a high charge would accuse honest neighbours instead.
    """
    return max(_OF_A_LIAR * min(1.0, _FEW / max(liars, 1)), _OF_MANY)


@dataclass(frozen=True, slots=True, eq=False)
class Dictionary:
    """Directions of possible faults. n buses, p meters, k directions."""

    std: Floats  # (k,) standard deviation of each amplitude, pu
    charge: Floats  # (k,) cost of accusing it, in accusations of a meter
    size: Floats  # (k,) sum over the meters of its squared changes
    meter: Ints  # (k,) meter of its customer, charged at most `false_power_charge` as a suspect; -1 for none
    columns: Callable[[Ints], Floats]  # `columns(which)`: changes of every squared voltage per unit, (n, …)
    along: Callable[[Floats], Floats]  # `along(weights)`: weighted sum of its changes at the meters, (k,)

    def charges(self, which: Ints, trusted: Bools, liars: int) -> Floats:
        """Cost of accusing directions (c,), in accusations of a meter; liars: number of suspects."""
        charge, of_liar = self.charge[which], (self.meter[which] >= 0) & ~trusted[self.meter[which]]
        return np.where(of_liar, np.minimum(charge, of_a_liar(liars)), charge)

    def doubtful(self) -> Dictionary:
        """Fault dictionary with reduced charges, for searching alternative explanations."""
        return replace(self, charge=np.minimum(self.charge, _OF_A_LIAR))


_CANDIDATES = 64
"""Directions that a search tries, those of the largest gradient."""
_TINY = 1e-6

Step = Callable[[], Move]
"""Changes a posterior when called."""


class Powers:
    """Gains of the directions during a search: Q A follows Q by rank one, diag(A^T Q A) by squares.

    The moves of the search change the posterior `now`. weights: (p,) Q m. live: (p,) meters with a reading.
    innocent: (k,) meters that stay trusted.
    """

    def __init__(
        self, now: Fit, dictionary: Dictionary, weights: Floats, live: Bools, innocent: Ints
    ) -> None:
        towards = dictionary.along(weights) ** 2 / np.maximum(dictionary.size, _TINY)
        self.dictionary, self.now, self.live = dictionary, now, live
        self.index = (-towards).argsort()[:_CANDIDATES]
        self.columns = dictionary.columns(self.index)
        self.seen = self.columns[now.prior.meters]
        self.std, self.meter = dictionary.std[self.index], dictionary.meter[self.index]
        at, Q = now.trusting()
        seen = self.seen[at]
        self.spread = np.zeros_like(self.seen)
        self.spread[at] = spread = Q @ seen
        self.form = np.einsum("ij,ij->j", spread, seen)
        self.innocent = np.isin(self.meter, innocent) if innocent.size else None
        self.accused: list[int] = []

    @property
    def loosened(self) -> tuple[int, ...]:
        """Accused directions, indices of the dictionary."""
        return tuple(self.index[self.accused].tolist())

    def best(self, judged: Judged, penalty: float, than: float) -> list[Step]:
        """Steps of the best direction, alone or with its meter removed, if it gains more than `than`.

        penalty: least gain of an accusation.
        """
        trusted = self.now.trusted
        liars = int(np.count_nonzero(self.live & ~trusted))
        alone = self._alone(judged.weights) - penalty * self.dictionary.charges(self.index, trusted, liars)
        both = self._with_meter(judged.weights) - penalty * (1.0 + of_a_liar(liars))
        if self.innocent is not None:
            both[self.innocent] = -np.inf
        alone[self.accused] = both[self.accused] = -np.inf
        k, pair = int(alone.argmax()), int(both.argmax())
        if max(alone[k], both[pair]) <= than:
            return []
        if alone[k] >= both[pair]:
            return [lambda: self._loosen(k)]
        return [lambda: self._loosen(pair), lambda: self.follow(drop(self.now, int(self.meter[pair])))]

    def follow(self, move: Move) -> Move:
        """Update the gains after a change of the posterior."""
        along = move.q @ self.seen
        self.spread += np.multiply.outer(move.factor * move.q, along)
        self.form += move.factor * along**2
        return move

    def _alone(self, weights: Floats) -> Floats:
        """Fall of the chi-square by each direction, (k,)."""
        return np.asarray((weights @ self.seen) ** 2 / (self.std**-2.0 + self.form))

    def _with_meter(self, weights: Floats) -> Floats:
        """The same with its meter removed, (k,); -inf without a trusted meter."""
        at = self.meter
        a, b = self.std**-2.0 + self.form, self.now.diagonal()[at]
        c = self.spread[at, np.arange(at.size)]
        u, v = weights @ self.seen, weights[at]
        free = (at >= 0) & self.now.trusted[at]
        determinant = np.where(free, a * b - c * c, 1.0)
        return np.where(free, (b * u * u - 2.0 * c * u * v + a * v * v) / determinant, -np.inf)

    def _loosen(self, k: int) -> Move:
        self.accused.append(k)
        return self.follow(loosen(self.now, self.columns[:, k], float(self.std[k])))
