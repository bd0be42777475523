"""How much an accusation changes the probability of an explanation, for all meters at once.

J, K, Q and g are those of `gridsec.sequential.snapshot`. Accusing a meter changes K by a matrix of rank one,
false powers by one of rank two: by the determinant lemma and Woodbury's formula every rise of J follows from
Q and g without solving anything larger than two by two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import chdtri, ndtri

from gridsec.arrays import Bools, Floats, Ints, frozen

# Determinants are positive; rounding may make them less.
_TINY = float(np.finfo(np.float64).tiny)
Curved = Callable[[Floats, Bools], Floats]
# How often an explanation is linearised about itself.
_PASSES = 2
# Where nobody is named, meters beyond so many standard deviations are.
_SUSPICIOUS = 3.0
# Of the false alarms that are allowed, for false powers where no meter alone is suspicious enough.
_OF_PAIRS = 0.2


@dataclass(frozen=True, slots=True)
class Lies:
    """What lies are expected to be like.

    Attributes
    ----------
    size
        Standard deviation A of a lie, squared pu: 0.2 is 10 % of the voltage.
    each
        What every accusation costs beside its freedom and the price of the set.
    seen
        Liars and honest meters as if seen before, a and b.
    false
        What false powers cost beside their freedom, as minus twice a logarithm.
    rate
        At most this part of clean snapshots names somebody, where errors are what the model says.
    like
        Explanations no more than this factor less likely than the best are reported.
    amplitude, differ
        Of lies that are alike: standard deviation of what they have in common, squared pu, and the part of
        it by which each differs.
    apart
        What each liar after the first costs more where lies are independent.
    pair, more
        What the second liar, and each further one, costs more where they read off by the same amount.
    story
        What liars cost who tell of one customer's load, beside the choice of the customer.
    """

    size: float = 0.2
    each: float = 2.3
    seen: tuple[float, float] = (4.0, 6.0)
    false: float = 3.0
    rate: float = 0.0095
    like: float = 20.0
    amplitude: float = 0.06
    differ: float = 0.15
    apart: float = 4.0
    pair: float = 5.0
    more: float = 2.0
    story: float = 5.5


@dataclass(frozen=True, slots=True, eq=False)
class FalsePowers:
    """What false powers of customers do to squared voltages. p meters, each at its customer's bus.

    Attributes
    ----------
    R, X : (p, p)
        Squared voltages by active and reactive powers, 2R and 2X of the feeder.
    p, q : (p,)
        How false the powers of each may be, standard deviations, pu.
    """

    R: Floats
    X: Floats
    p: Floats
    q: Floats

    def columns(self, who: Ints) -> Floats:
        """B of some customers, (p, k, 2)."""
        B = np.empty((len(self.R), who.size, 2))
        np.multiply(self.R[:, who], self.p[who], out=B[:, :, 0])
        np.multiply(self.X[:, who], self.q[who], out=B[:, :, 1])
        return B

    def of(self, live: Ints) -> FalsePowers:
        """For some of the meters alone."""
        both = np.ix_(live, live)
        return FalsePowers(self.R[both], self.X[both], self.p[live], self.q[live])


@dataclass(slots=True, eq=False)
class State:
    """An explanation under way: L, F and what follows from them."""

    liars: Bools
    powers: Bools
    m: Floats
    Q: Floats
    g: Floats
    logdet: float
    fit: float

    def copy(self) -> State:
        """A state that can be changed without changing this one."""
        return replace(self, liars=self.liars.copy(), powers=self.powers.copy(), Q=self.Q.copy())

    @property
    def key(self) -> bytes:
        """L and F as a key of dictionaries."""
        return self.liars.tobytes() + self.powers.tobytes()

    @property
    def counts(self) -> tuple[int, int]:
        """|L| and |F|."""
        return int(np.count_nonzero(self.liars)), int(np.count_nonzero(self.powers))


class Problem:
    """Readings, and what may be wrong with them."""

    def __init__(
        self, lies: Lies, diagonal: Floats, false: FalsePowers | None, curved: Curved | None
    ) -> None:
        self.lies, self.false, self.curved = lies, false, curved
        self.size = p = diagonal.size
        self.a2 = lies.size**2
        self.prices = _prices(p, *lies.seen) + lies.each * np.arange(p + 1)
        # The meter that the others know least well is accused for the least freedom.
        least = ndtri(lies.rate * (1.0 - _OF_PAIRS) / (2.0 * p)) ** 2 - self.prices[1]
        self.prices[1:] += max(0.0, float(least - np.log1p(self.a2 * diagonal.min())))
        self.rare = float(chdtri(3, lies.rate * _OF_PAIRS / p))

    def quiet(self, g: Floats, diagonal: Floats) -> bool:
        """Whether nobody would be accused or doubted, from the diagonal of Q alone."""
        pivot = 1.0 + self.a2 * diagonal
        accused = self.a2 * g**2 / pivot > np.log(pivot) + self.prices[1]
        return not (accused.any() or (self.false is not None and suspicious(g, diagonal).any()))

    def charge(self, count: int, false: int) -> float:
        """What so many liars and false powers cost beside their freedom."""
        return float(self.prices[count]) + self.lies.false * false

    def cost(self, at: State) -> float:
        """J."""
        return at.fit + at.logdet + self.charge(*at.counts)

    def meters(self, at: State) -> Floats:
        """Rise of J by accusing each meter, or by trusting it again, (p,)."""
        on = at.liars
        delta = np.where(on, -self.a2, self.a2)
        pivot = np.maximum(1.0 + delta * at.Q.diagonal(), _TINY)
        k, _ = at.counts
        now = self.prices[k]
        more, less = self.prices[min(k + 1, self.size)] - now, self.prices[max(k - 1, 0)] - now
        rise = np.log(pivot) - delta * at.g**2 / pivot + np.where(on, less, more)
        # Powers are false only where the meter lies.
        return np.where(at.powers, np.inf, rise)

    def pairs(self, at: State, who: Ints) -> tuple[Floats, Floats]:
        """Rise of J by false powers of some customers, and how much they explain, (k,) each.

        Their meters are accused with them where they are trusted.
        """
        QB, M, h = self._against(at, who)
        # The meter first, which changes Q and g by rank one; then its customer's powers.
        own = np.where(at.liars[who], 0.0, self.a2)
        pivot = 1.0 + own * at.Q[who, who]
        row, g, by = QB[who, np.arange(who.size)], at.g[who], own / pivot
        M -= by[:, None, None] * row[:, :, None] * row[:, None]
        det, gain = _by_two(M, h - (by * g)[:, None] * row, 1.0)
        k, _ = at.counts
        more = np.where(at.liars[who], 0.0, self.prices[min(k + 1, self.size)] - self.prices[k])
        gain += by * g**2
        rise = np.log(pivot * det) - gain + more + self.lies.false
        return np.where(at.powers[who], np.inf, rise), gain

    def believed(self, at: State, who: Ints) -> Floats:
        """Rise of J by believing the powers of some customers again, (k,)."""
        _, M, h = self._against(at, who)
        det, gain = _by_two(M, h, -1.0)
        return np.log(det) - gain - self.lies.false

    def _against(self, at: State, who: Ints) -> tuple[Floats, Floats, Floats]:
        """Q B, B^T Q B and B^T g of some customers."""
        B = self._columns(who)
        QB = (at.Q @ B.reshape(self.size, -1)).reshape(B.shape)
        return QB, np.einsum("jci,jck->cik", B, QB), (at.g @ B.reshape(self.size, -1)).reshape(-1, 2)

    def _columns(self, who: Ints) -> Floats:
        if self.false is None:
            raise ValueError("there are no false powers")
        return self.false.columns(who)

    def settle(self, at: State) -> None:
        """Linearise about what this explanation says of the powers."""
        if self.curved is None:
            return
        for _ in range(_PASSES):
            at.m = self.curved(at.g, at.powers)
            at.g = at.Q @ at.m
        at.fit = float(at.m @ at.g)

    def toggle(self, at: State, j: int) -> None:
        """Accuse a meter, or trust it again."""
        delta = -self.a2 if at.liars[j] else self.a2
        q = at.Q[:, j].copy()
        pivot = max(1.0 + delta * q[j], _TINY)
        at.fit -= delta * at.g[j] ** 2 / pivot
        at.logdet += float(np.log(pivot))
        at.g = at.g - q * (delta * at.g[j] / pivot)
        at.Q -= np.multiply.outer(q, q * (delta / pivot))
        at.liars[j] = not at.liars[j]

    def powers(self, at: State, c: int, sign: float = 1.0) -> None:
        """Doubt a customer's powers, or with `sign` -1 believe them again."""
        u = self._columns(np.array([c]))[:, 0]
        Qu, h = at.Q @ u, u.T @ at.g
        (a, b), (_, d) = sign * np.eye(2) + u.T @ Qu
        det = max(a * d - b * b, _TINY)
        inverse = np.array([[d, -b], [-b, a]]) / det
        by = Qu @ inverse
        at.fit -= float(h @ inverse @ h)
        at.logdet += float(np.log(det))
        at.g = at.g - by @ h
        at.Q -= by @ Qu.T
        at.powers[c] = sign > 0


@cache
def _prices(meters: int, liars: float, honest: float) -> Floats:
    """What naming 0, 1, 2, … of so many meters costs, but always rising."""
    k = np.arange(meters)
    each = np.maximum(2.0 * np.log((meters - 1 - k + honest) / (k + liars)), 0.0)
    return frozen(np.concatenate([[0.0], np.cumsum(each)]))


def suspicious(g: Floats, diagonal: Floats) -> Bools:
    """Which meters' leave-one-out residuals are large enough to doubt their customers' powers."""
    return np.asarray(g**2 > _SUSPICIOUS**2 * diagonal)


def _by_two(M: Floats, h: Floats, sign: float) -> tuple[Floats, Floats]:
    """``det(sign I + M)`` and ``h^T (sign I + M)^-1 h`` of many, (k, 2, 2) and (k, 2)."""
    a, b, c = M[:, 0, 0] + sign, M[:, 0, 1], M[:, 1, 1] + sign
    det = np.maximum(a * c - b * b, _TINY)
    return det, (c * h[:, 0] ** 2 - 2.0 * b * h[:, 0] * h[:, 1] + a * h[:, 1] ** 2) / det
