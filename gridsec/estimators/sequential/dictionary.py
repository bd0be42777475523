"""What else but meters can be wrong: directions that an explanation may loosen, and what that gains.

Loosening direction a with standard deviation s lowers the misfit ``m^T Q m`` by

    (a^T Q m)^2 / (1 / s^2 + a^T Q a),

dropping meter j as well by ``g^T G^-1 g`` with g and G the weights and the precision of both. A customer who
lies about its voltage may lie about its powers, and a made-up load only fits to made-up voltages: so the pair
is one move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.sequential.conditional import Fit, Judged, Move, drop, loosen

_OF_A_LIAR, _FEW, _OF_MANY = 2.0, 3, 0.5


def of_a_liar(liars: int) -> float:
    """What accusing the powers of a customer costs whose meter is accused already, in accusations of a meter.

    Where many lie the next one is no surprise (`search.price`), and neither is that its powers are false as
    well: were that dear, honest neighbours would be accused instead. Two up to three liars, then in inverse
    proportion to their number, half at least.

    Parameters
    ----------
    liars
        How many meters are accused.
    """
    return max(_OF_A_LIAR * min(1.0, _FEW / max(liars, 1)), _OF_MANY)


@dataclass(frozen=True, slots=True, eq=False)
class Dictionary:
    """Directions that can be loosened. n buses, p meters, k directions.

    Attributes
    ----------
    std : (k,)
        How much of what is doubted there may be, pu.
    charge : (k,)
        What accusing it costs, in accusations of a meter.
    size : (k,)
        Sum over the meters of the squares of what a direction changes there.
    columns
        `columns(which)` are the changes of every squared voltage per unit of what is doubted, (n, …).
    meter : (k,)
        Meter of the customer whose powers it doubts; -1 for none. Who is accused of lying about the voltage
        is not believed about powers either: that costs no more than `of_a_liar`.
    along
        `along(weights)` is the weighted sum of each direction's changes at the meters, (k,).
    """

    std: Floats
    charge: Floats
    size: Floats
    meter: Ints
    columns: Callable[[Ints], Floats]
    along: Callable[[Floats], Floats]

    def charges(self, which: Ints, trusted: Bools, liars: int) -> Floats:
        """What accusing some directions costs, in accusations of a meter.

        Parameters
        ----------
        which : (c,)
            The directions.
        trusted : (p,)
            Which meters are believed.
        liars
            How many of those that report are not.
        """
        charge, of_liar = self.charge[which], (self.meter[which] >= 0) & ~trusted[self.meter[which]]
        return np.where(of_liar, np.minimum(charge, of_a_liar(liars)), charge)

    def doubtful(self) -> Dictionary:
        """The book for those who look for reasons not to name anybody."""
        return replace(self, charge=np.minimum(self.charge, _OF_A_LIAR))


# So many directions are tried, those that the residuals point at most.
_CANDIDATES = 64
_TINY = 1e-6

Step = Callable[[], Move]
"""Changes a fit when called."""


class Powers:
    """Gains of loosening, kept up to date: Q A changes with Q by rank one, diag(A^T Q A) by squares.

    Parameters
    ----------
    now
        Where a search begins; its steps change it.
    dictionary
        What may be loosened.
    weights : (p,)
        Q m.
    live : (p,)
        Which meters report.
    innocent : (k,)
        Meters that are not dropped.
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
        """What has been loosened, indices into the dictionary."""
        return tuple(self.index[self.accused].tolist())

    def best(self, judged: Judged, penalty: float, than: float) -> list[Step]:
        """Loosening a direction, alone or with its meter dropped as well; nothing unless it gains more.

        Parameters
        ----------
        judged
            Where the search stands.
        penalty
            What an accusation must gain at least.
        than
            What something else would gain.
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
        """Take note of a change of the fit.

        Parameters
        ----------
        move
            The change.
        """
        along = move.q @ self.seen
        self.spread += np.multiply.outer(move.factor * move.q, along)
        self.form += move.factor * along**2
        return move

    def _alone(self, weights: Floats) -> Floats:
        """How much each direction would lower the misfit, (k,)."""
        return np.asarray((weights @ self.seen) ** 2 / (self.std**-2.0 + self.form))

    def _with_meter(self, weights: Floats) -> Floats:
        """The same if its meter were dropped as well, (k,); -inf where that has none, or is not trusted."""
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
