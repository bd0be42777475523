"""Who lies, from one set of readings alone: the likeliest explanation, and those about as likely.

No time, nothing that was believed before. The error of a liar's reading has the standard deviation A, far
beyond an honest meter's. A customer whose meter lies may report false powers too, which moves the squared
voltages along the columns of ``B_c = std_c [2 R_:c, 2 X_:c]``. With the liars L and, of those, F whose
powers are false too,

    K = S + diag(d) + A^2 sum_{j in L} e_j e_j^T + sum_{c in F} B_c B_c^T
    J = m^T K^-1 m + ln det K + price(|L|) + false |F| + anybody [L not empty]

is minus twice the logarithm of an explanation's probability. ``ln det K`` charges an accusation for the
freedom that it gives: what one meter costs follows from A and from how well the others know its voltage.
Accusing changes K by a matrix of rank one, false powers by one of rank two; the gains of *all* single
accusations come from ``Q = K^-1`` and ``g = Q m`` without solving anything.

The price is that of sets whose members each lie with a probability that is Beta(a, b) distributed: the k-th
liar costs ``2 ln((p - k + b) / (k - 1 + a)) + each``, less the more there are already.

`anybody` is what makes a false alarm as rare as asked for. Nobody is named unless accusing one meter lowers
J, and with it that takes a leave-one-out residual beyond the ``1 - r / (2 p)`` quantile of the normal
distribution; or unless a meter together with its customer's powers explains more than the ``1 - r' / p``
quantile of chi-square with three degrees of freedom. ``r + r'`` is `rate`, an upper bound: where freedom and
price alone cost more, `anybody` is zero and fewer are named. Once one is accused, others lie more probably.

References
----------
George and McCulloch 1993 (spike and slab); Scott and Berger 2010 (the prior over sets).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import chdtri, ndtri

from gridsec.arrays import Bools, Floats, Ints, frozen
from gridsec.sequential.conditional import Prior, inverted

Curved = Callable[[Floats, Bools], Floats]


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
    """

    size: float = 0.2
    each: float = 2.3
    seen: tuple[float, float] = (4.0, 6.0)
    false: float = 3.0
    rate: float = 0.006
    like: float = 1e3


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


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """One explanation. p meters.

    Attributes
    ----------
    liars : (p,)
        Whose readings are manipulated.
    powers : (p,)
        Whose powers are false as well.
    probability
        Among all that are reported.
    cost
        J.
    weights : (p,)
        ``K^-1 m``; what the readings say about any voltage is its covariance with them times this.
    """

    liars: Bools
    powers: Bools
    probability: float
    cost: float
    weights: Floats


@dataclass(slots=True, eq=False)
class _State:
    """An explanation under way: L, F and what follows from them."""

    liars: Bools
    powers: Bools
    m: Floats
    Q: Floats
    g: Floats
    logdet: float
    fit: float

    def copy(self) -> _State:
        return replace(self, liars=self.liars.copy(), powers=self.powers.copy(), Q=self.Q.copy())

    @property
    def key(self) -> bytes:
        return self.liars.tobytes() + self.powers.tobytes()

    @property
    def counts(self) -> tuple[int, int]:
        return int(np.count_nonzero(self.liars)), int(np.count_nonzero(self.powers))


class _Problem:
    """Readings, and what may be wrong with them."""

    def __init__(self, lies: Lies, Q: Floats, false: FalsePowers | None, curved: Curved | None) -> None:
        self.lies, self.false, self.curved = lies, false, curved
        self.size = p = len(Q)
        self.a2 = lies.size**2
        self.prices = _prices(p, *lies.seen) + lies.each * np.arange(p + 1)
        if p:
            # The meter that the others know least well is accused for the least freedom.
            least = ndtri(lies.rate * (1.0 - _OF_PAIRS) / (2.0 * p)) ** 2 - self.prices[1]
            self.prices[1:] += max(0.0, float(least - np.log1p(self.a2 * Q.diagonal().min())))
            self.rare = float(chdtri(3, lies.rate * _OF_PAIRS / p))

    def charge(self, count: int, false: int) -> float:
        return float(self.prices[count]) + self.lies.false * false

    def cost(self, at: _State) -> float:
        return at.fit + at.logdet + self.charge(*at.counts)

    def meters(self, at: _State) -> Floats:
        """Rise of J by accusing each meter, or by trusting it again, (p,)."""
        on = at.liars
        delta = np.where(on, -self.a2, self.a2)
        pivot = np.maximum(1.0 + delta * at.Q.diagonal(), np.finfo(np.float64).tiny)
        k, _ = at.counts
        now = self.prices[k]
        more, less = self.prices[min(k + 1, self.size)] - now, self.prices[max(k - 1, 0)] - now
        rise = np.log(pivot) - delta * at.g**2 / pivot + np.where(on, less, more)
        # Powers are false only where the meter lies.
        return np.where(at.powers, np.inf, rise)

    def pairs(self, at: _State, who: Ints) -> tuple[Floats, Floats]:
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

    def believed(self, at: _State, who: Ints) -> Floats:
        """Rise of J by believing the powers of some customers again, (k,)."""
        _, M, h = self._against(at, who)
        det, gain = _by_two(M, h, -1.0)
        return np.log(det) - gain - self.lies.false

    def _against(self, at: _State, who: Ints) -> tuple[Floats, Floats, Floats]:
        """Q B, B^T Q B and B^T g of some customers."""
        B = self._columns(who)
        QB = (at.Q @ B.reshape(self.size, -1)).reshape(B.shape)
        return QB, np.einsum("jci,jck->cik", B, QB), (at.g @ B.reshape(self.size, -1)).reshape(-1, 2)

    def _columns(self, who: Ints) -> Floats:
        if self.false is None:
            raise ValueError("there are no false powers")
        return self.false.columns(who)

    def settle(self, at: _State) -> None:
        """Linearise about what this explanation says of the powers."""
        if self.curved is None:
            return
        for _ in range(_PASSES):
            at.m = self.curved(at.g, at.powers)
            at.g = at.Q @ at.m
        at.fit = float(at.m @ at.g)

    def toggle(self, at: _State, j: int) -> None:
        """Accuse a meter, or trust it again."""
        delta = -self.a2 if at.liars[j] else self.a2
        q = at.Q[:, j].copy()
        pivot = 1.0 + delta * q[j]
        at.fit -= delta * at.g[j] ** 2 / pivot
        at.logdet += float(np.log(pivot))
        at.g = at.g - q * (delta * at.g[j] / pivot)
        at.Q -= np.multiply.outer(q, q * (delta / pivot))
        at.liars[j] = not at.liars[j]

    def powers(self, at: _State, c: int, sign: float = 1.0) -> None:
        """Doubt a customer's powers, or with `sign` -1 believe them again."""
        u = self._columns(np.array([c]))[:, 0]
        Qu, h = at.Q @ u, u.T @ at.g
        (a, b), (_, d) = sign * np.eye(2) + u.T @ Qu
        det = a * d - b * b
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


def _by_two(M: Floats, h: Floats, sign: float) -> tuple[Floats, Floats]:
    """``det(sign I + M)`` and ``h^T (sign I + M)^-1 h`` of many, (k, 2, 2) and (k, 2)."""
    a, b, c = M[:, 0, 0] + sign, M[:, 0, 1], M[:, 1, 1] + sign
    det = np.maximum(a * c - b * b, np.finfo(np.float64).tiny)
    return det, (c * h[:, 0] ** 2 - 2.0 * b * h[:, 0] * h[:, 1] + a * h[:, 1] ** 2) / det


_PASSES = 2
# Rises of J below this are rounding.
_LEAST = 1e-9
# A fit this many standard deviations above its expectation leaves something unexplained.
_MISFIT = 3.0
_MOVES = 4
# So many customers, those whose meters are most suspicious, are where a search with false powers may begin.
_STARTS = 8
# Where nobody is named, meters beyond so many standard deviations are.
_SUSPICIOUS = 3.0
# Of the false alarms that are allowed, for false powers where no meter alone is suspicious enough.
_OF_PAIRS = 0.2


def identify(
    prior: Prior,
    noise: Floats,
    m: Floats,
    live: Bools,
    *,
    lies: Lies | None = None,
    false: FalsePowers | None = None,
    curved: Curved | None = None,
) -> tuple[Explained, ...]:
    """The likeliest explanations of one set of readings.

    Parameters
    ----------
    prior
        What is known without meters.
    noise : (p,)
        Variance of each meter's reading, > 0.
    m : (p,)
        Readings minus what the model explains, squared pu; any finite value where there is none.
    live : (p,)
        Which meters have a reading.
    lies
        What lies are expected to be like; the defaults of `Lies` by default.
    false
        What false powers do to voltages, and how false they may be; none by default.
    curved
        The power flow is not linear, and false powers may be large: `curved(weights, powers)` is `m` for the
        live meters linearised about the powers of an explanation, by its weights and who reports false ones,
        (p_live,) each. Without it, `m` is good for all.

    Returns
    -------
    tuple of Explained
        The likeliest first; there is always one.
    """
    lies = Lies() if lies is None else lies
    if live.all():
        d, y, K = noise, m, prior.between
    else:
        at = np.flatnonzero(live)
        d, y, K = noise[at], m[at], prior.of_meters[np.ix_(prior.meters[at], at)]
        false = None if false is None else false.of(at)
    K.ravel()[:: d.size + 1] += d
    Q = inverted(K)
    problem = _Problem(lies, Q, false, curved)
    none = np.zeros(d.size, dtype=np.bool_)
    g = Q @ y
    start = _State(none, none.copy(), y, Q, g, 0.0, float(y @ g))
    found = _explanations(problem, start, false is not None)
    return _reported(problem, found, live, lies)


def _explanations(problem: _Problem, start: _State, false: bool) -> list[_State]:
    """Local minima of J from several starts, and their neighbours."""
    if problem.size == 0:
        return [start]
    known: dict[bytes, _State] = {start.key: start}
    first = _descend(problem, start, known, false)
    if false and (first is start or first.fit > problem.size + _MISFIT * np.sqrt(2.0 * problem.size)):
        for c in _doubtful(problem, start, anybody=first is not start):
            _descend(problem, _doubted(problem, start, c), known, false)
    if len(known) == 1:
        return [start]
    _exchange(problem, min(known.values(), key=problem.cost), known, false)
    return list(known.values())


def _doubtful(problem: _Problem, at: _State, *, anybody: bool) -> list[int]:
    """Customers whose false powers explain more than their lying meter alone, the best first.

    Unless `anybody` is named anyway, only those whose meters are suspicious and who explain so much that it
    is rare.
    """
    if anybody:
        single = problem.meters(at)
        who = np.argsort(single)[:_STARTS]
        rise, _ = problem.pairs(at, who)
        worth = rise < single[who]
    else:
        who = np.flatnonzero(at.g**2 > _SUSPICIOUS**2 * at.Q.diagonal())
        if not who.size:
            return []
        rise, gain = problem.pairs(at, who)
        worth = (rise < 0.0) & (gain > problem.rare)
    order = np.argsort(rise)
    return [int(c) for c in who[order][worth[order]][:_STARTS]]


def _doubted(problem: _Problem, at: _State, c: int) -> _State:
    after = at.copy()
    if not after.liars[c]:
        problem.toggle(after, c)
    problem.powers(after, c)
    problem.settle(after)
    return after


def _descend(problem: _Problem, at: _State, known: dict[bytes, _State], false: bool) -> _State:
    """Steepest descent; remembers every explanation that it passes."""
    known.setdefault(at.key, at)
    for _ in range(_MOVES * at.g.size):
        after = _best(problem, at, false)
        if after is None:
            return at
        if after.key in known:
            return known[after.key]
        known[after.key] = at = after
    return at


def _best(problem: _Problem, at: _State, false: bool) -> _State | None:
    """The state after the move that lowers J most, or None where none does."""
    rise = problem.meters(at)
    j = int(np.argmin(rise))
    least, move = float(rise[j]), "meter"
    if false and at.liars.any():
        doubted = np.flatnonzero(at.powers)
        if doubted.size:
            rises = problem.believed(at, doubted)
            c = int(np.argmin(rises))
            if rises[c] < least:
                j, least, move = int(doubted[c]), float(rises[c]), "believe"
        who = np.flatnonzero(at.liars)
        doubts, _ = problem.pairs(at, who)
        c = int(np.argmin(doubts))
        if doubts[c] < least:
            j, least, move = int(who[c]), float(doubts[c]), "powers"
    if least >= -_LEAST:
        return None
    if move == "powers":
        return _doubted(problem, at, j)
    after = at.copy()
    if move == "believe":
        problem.powers(after, j, -1.0)
    else:
        problem.toggle(after, j)
    return after


def _exchange(problem: _Problem, at: _State, known: dict[bytes, _State], false: bool) -> None:
    """Trust each liar again, and see what explains the readings instead."""
    least, within = problem.cost(at), 2.0 * np.log(problem.lies.like)
    for j in np.flatnonzero(at.liars).tolist():
        after = at.copy()
        if after.powers[j]:
            problem.powers(after, j, -1.0)
        problem.toggle(after, j)
        rise = problem.meters(after)
        rise[j] = np.inf
        k = int(np.argmin(rise))
        cost = problem.cost(after) + rise[k]
        after.liars[k] ^= True
        new = after.key not in known
        after.liars[k] ^= True
        if new and cost - least <= within:
            problem.toggle(after, k)
            _descend(problem, after, known, false)


def _reported(problem: _Problem, found: list[_State], live: Bools, lies: Lies) -> tuple[Explained, ...]:
    """The likeliest of them as explanations of all meters, one for each set of liars."""
    costs = sorted(((problem.cost(each), each) for each in found), key=lambda pair: pair[0])
    best: dict[bytes, tuple[float, _State]] = {}
    for cost, each in costs:
        if cost - costs[0][0] <= 2.0 * np.log(lies.like):
            best.setdefault(each.liars.tobytes(), (cost, each))
    total = sum(float(np.exp(-0.5 * (cost - costs[0][0]))) for cost, _ in best.values())
    return tuple(
        Explained(
            _spread(each.liars, live),
            _spread(each.powers, live),
            float(np.exp(-0.5 * (cost - costs[0][0]))) / total,
            cost,
            _weights(each.g, live),
        )
        for cost, each in best.values()
    )


def _spread(some: Bools, live: Bools) -> Bools:
    out = np.zeros(live.size, dtype=np.bool_)
    out[live] = some
    return out


def _weights(g: Floats, live: Bools) -> Floats:
    out = np.zeros(live.size)
    out[live] = g
    return out
