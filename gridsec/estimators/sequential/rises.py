"""How much an accusation changes the probability of an explanation, for all meters at once.

J, K, Q and g are those of `gridsec.estimators.sequential.snapshot`. Accusing a meter changes K by a matrix of
rank one, false powers by one of rank two: by the determinant lemma and Woodbury's formula every rise of J
follows from Q and g without solving anything larger than two by two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import log

import numpy as np
from scipy.special import chdtri, ndtri

from gridsec import errors
from gridsec.arrays import Bools, Floats, Ints, frozen, submatrix

# Determinants are positive; rounding may make them less.
_TINY = float(np.finfo(np.float64).tiny)
# So many liars may be alike: of larger sets there are too many, and what is gained is little.
MOST = 8
Curved = Callable[[Floats, Bools], Floats]
# How often an explanation is linearised about itself; not again where that changed J by less than this: what
# is left is about a tenth of it.
_PASSES, _LITTLE = 2, 1.0
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

    Raises
    ------
    ValueError
        If `size`, `amplitude` or `differ` is not positive.
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

    def __post_init__(self) -> None:
        if min(self.size, self.amplitude, self.differ) <= 0.0:
            raise errors.InputInvalid(
                [errors.Problem("not-positive", "size, amplitude and differ must be positive")]
            )


@dataclass(frozen=True, slots=True, eq=False)
class FalsePowers:
    """What false powers of customers do to squared voltages. p meters, each at its customer's bus.

    Attributes
    ----------
    R, X : (p, p)
        Squared voltages by active and reactive powers, 2R and 2X of the feeder.
    p, q : (p,)
        How false the powers of each may be, standard deviations, pu.
    felt : (MOST, p)
        Entries of each column of R that are largest, the largest first: how much those feel a customer's
        load who feel it most. Made where it is not given; `claimed` hands it on.

    Raises
    ------
    ValueError
        If these are not all of the same p meters.
    """

    R: Floats
    X: Floats
    p: Floats
    q: Floats
    felt: Floats | None = None

    def __post_init__(self) -> None:
        count = self.p.size
        square = self.R.shape == self.X.shape == (count, count)
        felt = self.felt is None or self.felt.shape == (min(MOST, count), count)
        if not (square and self.q.shape == self.p.shape and felt):
            raise errors.InputInvalid(
                [errors.Problem("shape", "R, X, p, q and felt must be of the same meters")]
            )

    def claimed(self, p: Floats, q: Floats) -> FalsePowers:
        """For the same meters, other powers: what depends on the feeder alone is prepared once for all.

        Parameters
        ----------
        p, q : (p,)
            As the attributes.
        """
        return FalsePowers(self.R, self.X, p, q, strongest(self.R) if self.felt is None else self.felt)

    def of(self, live: Ints) -> FalsePowers:
        """For some of the meters alone."""
        R, X = (submatrix(each, live, live) for each in (self.R, self.X))
        return FalsePowers(R, X, self.p[live], self.q[live])


@dataclass(slots=True, eq=False)
class State:
    """An explanation under way: L, F and what follows from them. p meters.

    Q itself is never needed: every change takes a matrix of rank one off it,

        Q = W^T W - V^T U

    so that a change costs O(p) beside one product with Q, and a copy almost nothing.

    Attributes
    ----------
    liars, powers : (p,)
        L and F.
    m : (p,)
        Readings minus what the model explains.
    W : (p, p)
        Whitens the readings where nobody lies.
    g, diagonal : (p,)
        ``Q m``, and the diagonal of Q.
    logdet
        ``ln det K`` beside that of nobody.
    fit
        ``m^T Q m``.
    U, V : (r, p)
        What was taken off; each row of V is the same of U times a number.
    counts
        |L| and |F|.
    rise : (p,)
        `Problem.meters`, once somebody has asked for it.
    """

    liars: Bools
    powers: Bools
    m: Floats
    W: Floats
    g: Floats
    diagonal: Floats
    logdet: float
    fit: float
    U: Floats
    V: Floats
    counts: tuple[int, int] = (0, 0)
    rise: Floats | None = None

    @classmethod
    def nobody(cls, m: Floats, W: Floats) -> State:
        """Everybody is believed."""
        none, white = np.zeros(m.size, dtype=np.bool_), W @ m
        diagonal, nothing = np.einsum("ij,ij->j", W, W), np.empty((0, m.size))
        fit = float(white @ white)
        return cls(none, none.copy(), m, W, white @ W, diagonal, 0.0, fit, nothing, nothing)

    def copy(self) -> State:
        """A state that can be changed without changing this one."""
        return replace(self, liars=self.liars.copy(), powers=self.powers.copy())

    @property
    def key(self) -> bytes:
        """L and F as a key of dictionaries."""
        return self.liars.tobytes() + self.powers.tobytes()

    def times(self, x: Floats) -> Floats:
        """Q x, (p,)."""
        return np.asarray((self.W @ x) @ self.W - (self.V @ x) @ self.U)

    def column(self, j: int) -> Floats:
        """Q e_j, (p,)."""
        return np.asarray(self.W[:, j] @ self.W - self.V[:, j] @ self.U)

    def rows(self, who: Ints) -> Floats:
        """Rows of Q of some meters, (k, p)."""
        return np.asarray(self.W[:, who].T @ self.W - self.V[:, who].T @ self.U)

    def change(self, q: Floats, delta: float, u_q: float, u_g: float) -> None:
        """Add ``delta u u^T`` to K, by q = Q u, ``u^T q`` and ``u^T g``."""
        pivot = max(1.0 + delta * u_q, _TINY)
        by = q * (delta / pivot)
        self.fit -= delta * u_g**2 / pivot
        self.logdet += log(pivot)
        self.g = self.g - u_g * by
        self.diagonal = self.diagonal - by * q
        self.U, self.V = np.concatenate((self.U, q[None])), np.concatenate((self.V, by[None]))
        self.rise = None


class Problem:
    """Readings, and what may be wrong with them."""

    def __init__(self, lies: Lies, start: State, false: FalsePowers | None, curved: Curved | None) -> None:
        self.lies, self.false, self.curved = lies, false, curved
        diagonal, self.W = start.diagonal, start.W
        self.size, self.a2 = diagonal.size, lies.size**2
        # Of customers that were asked about: B, and what follows from it while everybody is believed.
        self.known: dict[int, tuple[Floats, Floats, Floats]] = {}
        prices, least, self.rare = _charges(lies, self.size)
        # The meter that the others know least well is accused for the least freedom.
        anybody = max(0.0, least - float(prices[1]) - float(np.log1p(self.a2 * diagonal.min())))
        self.prices = prices + anybody
        self.prices[0] = 0.0

    @cached_property
    def felt(self) -> Floats:
        """How much those feel each customer's load who feel it most; see `FalsePowers`.

        Raises
        ------
        ValueError
            If there are no false powers.
        """
        if self.false is None:
            raise errors.InputInvalid([errors.Problem("missing", "there are no false powers")])
        return strongest(self.false.R) if self.false.felt is None else self.false.felt

    def quiet(self, g: Floats, diagonal: Floats) -> bool:
        """Whether nobody would be accused or doubted."""
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
        """Rise of J by accusing each meter, or by trusting it again, (p,); to be read only."""
        if at.rise is not None:
            return at.rise
        k, _ = at.counts
        now = self.prices[k]
        pivot = 1.0 + self.a2 * at.diagonal
        rise: Floats = np.log(pivot) - self.a2 * at.g**2 / pivot + (self.prices[min(k + 1, self.size)] - now)
        if k:
            on = at.liars.nonzero()[0]
            pivot = np.maximum(1.0 - self.a2 * at.diagonal[on], _TINY)
            less = np.log(pivot) + self.a2 * at.g[on] ** 2 / pivot + (self.prices[k - 1] - now)
            # Powers are false only where the meter lies.
            rise[on] = less
            if at.counts[1]:
                rise[at.powers] = np.inf
        at.rise = rise
        return rise

    def pairs(self, at: State, who: Ints) -> tuple[Floats, Floats]:
        """Rise of J by false powers of some customers, and how much they explain, (k,) each.

        Their meters are accused with them where they are trusted.
        """
        k, _ = at.counts
        accused = float(self.prices[min(k + 1, self.size)] - self.prices[k])
        out = np.empty((2, who.size))
        # Few are asked about: numbers are faster than short arrays.
        for n, c in enumerate(who.tolist()):
            (a, b, d), (s, t), (h, i) = self._against(at, c)
            pivot, rise, gain = 1.0, self.lies.false, 0.0
            if not at.liars[c]:
                # The meter first, which changes Q and g by rank one; then its customer's powers.
                g, pivot = float(at.g[c]), 1.0 + self.a2 * float(at.diagonal[c])
                by = self.a2 / pivot
                a, b, d = a - by * s * s, b - by * s * t, d - by * t * t
                h, i = h - by * g * s, i - by * g * t
                rise, gain = rise + accused, by * g * g
            det, more = _by_two(a + 1.0, b, d + 1.0, h, i)
            gain += more
            out[:, n] = np.inf if at.powers[c] else log(pivot * det) - gain + rise, gain
        return out[0], out[1]

    def believed(self, at: State, who: Ints) -> Floats:
        """Rise of J by believing the powers of some customers again, (k,)."""
        out = np.empty(who.size)
        for n, c in enumerate(who.tolist()):
            (a, b, d), _, (h, i) = self._against(at, c)
            det, gain = _by_two(a - 1.0, b, d - 1.0, h, i)
            out[n] = log(det) - gain - self.lies.false
        return out

    def _against(self, at: State, c: int) -> tuple[list[float], list[float], list[float]]:
        """``B^T Q B``, its three numbers, ``e^T Q B`` of the customer's own meter, and ``B^T g``."""
        if c not in self.known:
            B = self._columns(c)
            white = np.array([self.W @ u for u in B])
            self.known[c] = B, white @ white.T, white @ self.W[:, c]
        B, M, own = self.known[c]
        if len(at.U):
            off, by = at.U @ B.T, B @ at.V.T
            M, own = M - by @ off, own - by @ at.U[:, c]
        (a, b), (_, d) = M.tolist()
        return [a, b, d], own.tolist(), (B @ at.g).tolist()

    def _columns(self, c: int) -> Floats:
        """B of a customer, a row for each power, (2, p)."""
        if self.false is None:
            raise errors.InputInvalid([errors.Problem("missing", "there are no false powers")])
        return np.stack([self.false.R[:, c] * self.false.p[c], self.false.X[:, c] * self.false.q[c]])

    def settle(self, at: State) -> None:
        """Linearise about what this explanation says of the powers.

        And once more about that where it changed much.
        """
        if self.curved is None:
            return
        for _ in range(_PASSES):
            before = at.fit
            at.m = self.curved(at.g, at.powers)
            at.g = at.times(at.m)
            at.fit, at.rise = float(at.m @ at.g), None
            if abs(at.fit - before) <= _LITTLE:
                return

    def toggle(self, at: State, j: int) -> None:
        """Accuse a meter, or trust it again."""
        at.change(at.column(j), -self.a2 if at.liars[j] else self.a2, float(at.diagonal[j]), float(at.g[j]))
        at.liars[j] = not at.liars[j]
        at.counts = at.counts[0] + (1 if at.liars[j] else -1), at.counts[1]

    def powers(self, at: State, c: int, sign: float = 1.0) -> None:
        """Doubt a customer's powers, or with `sign` -1 believe them again."""
        for u in self.known[c][0] if c in self.known else self._columns(c):
            q = at.times(u)
            at.change(q, sign, float(u @ q), float(u @ at.g))
        at.powers[c] = sign > 0
        at.counts = at.counts[0], at.counts[1] + int(sign)


@cache
def _charges(lies: Lies, meters: int) -> tuple[Floats, float, float]:
    """What naming 0, 1, 2, … of so many meters costs, and what evidence is rare of one and of a pair."""
    prices = frozen(_prices(meters, *lies.seen) + lies.each * np.arange(meters + 1))
    least = float(ndtri(lies.rate * (1.0 - _OF_PAIRS) / (2.0 * meters)) ** 2)
    return prices, least, float(chdtri(3, lies.rate * _OF_PAIRS / meters))


def _prices(meters: int, liars: float, honest: float) -> Floats:
    """The same by the prior over sets alone, but always rising."""
    k = np.arange(meters)
    each = np.maximum(2.0 * np.log((meters - 1 - k + honest) / (k + liars)), 0.0)
    return frozen(np.concatenate([[0.0], np.cumsum(each)]))


def suspicious(g: Floats, diagonal: Floats) -> Bools:
    """Which meters' leave-one-out residuals are large enough to doubt their customers' powers."""
    return np.asarray(g**2 > _SUSPICIOUS**2 * diagonal)


def strongest(R: Floats) -> Floats:
    """The largest entries of each column, the largest first, (MOST, p) or all of fewer.

    Parameters
    ----------
    R : (p, p)
        As in `FalsePowers`.
    """
    return frozen(-np.sort(-R, axis=0)[:MOST])


def _by_two(a: float, b: float, d: float, h: float, i: float) -> tuple[float, float]:
    """Determinant of ``[[a, b], [b, d]]``, and ``[h, i]`` times its inverse times ``[h, i]``."""
    det = max(a * d - b * b, _TINY)
    return det, (d * h * h - 2.0 * b * h * i + a * i * i) / det
