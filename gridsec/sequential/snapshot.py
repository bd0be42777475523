"""Who lies, from one set of readings alone: the likeliest explanation, and those about as likely.

No time, nothing that was believed before. The error of a liar's reading has the standard deviation A, far
beyond an honest meter's. A customer whose meter lies may report false powers too, which moves the squared
voltages along the columns of ``B_c = std_c [2 R_:c, 2 X_:c]``. With the liars L and, of those, F whose
powers are false too,

    K = S + diag(d) + A^2 sum_{j in L} e_j e_j^T + sum_{c in F} B_c B_c^T
    J = m^T K^-1 m + ln det K + 2 ln binom(p, |L|) + false |F| + anybody [L not empty]

is minus twice the logarithm of an explanation's probability. ``ln det K`` charges an accusation for the
freedom that it gives: what one meter costs follows from A and from how well the others know its voltage.
Accusing changes K by a matrix of rank one, false powers by one of rank two; the gains of *all* single
accusations come from ``Q = K^-1`` and ``g = Q m`` without solving anything.

`anybody` is what makes a false alarm as rare as asked for: nobody is named unless accusing one meter lowers
J, and with it that takes a leave-one-out residual beyond the ``1 - rate / (2 p)`` quantile of the normal
distribution. `rate` is an upper bound: where the freedom and the prior alone cost more, `anybody` is zero and
fewer are named. Once one is accused, others lie more probably.

References
----------
George and McCulloch 1993 (spike and slab); Chen and Chen 2008 (the prior over sets).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from gridsec.arrays import Bools, Floats, Ints
from gridsec.sequential.conditional import Prior, inverted
from gridsec.sequential.search import price

Curved = Callable[[Floats, Bools], Floats]


@dataclass(frozen=True, slots=True)
class Lies:
    """What lies are expected to be like.

    Attributes
    ----------
    size
        Standard deviation A of a lie, squared pu: 0.2 is 10 % of the voltage.
    each
        What every accusation costs beside its freedom and the number of such sets.
    false
        What false powers cost beside their freedom, as minus twice a logarithm.
    rate
        At most this part of clean snapshots names somebody, where errors are what the model says.
    like
        Explanations no more than this factor less likely than the best are reported.
    """

    size: float = 0.2
    each: float = 1.4
    false: float = 3.0
    rate: float = 0.005
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


class _Problem:
    """Readings, and what may be wrong with them."""

    def __init__(self, lies: Lies, Q: Floats, false: FalsePowers | None, curved: Curved | None) -> None:
        self.lies, self.false, self.curved = lies, false, curved
        self.size = p = len(Q)
        self.a2 = lies.size**2
        self.anybody = 0.0
        if p:
            # The meter that the others know least well is accused for the least freedom.
            least = ndtri(lies.rate / (2.0 * p)) ** 2 - price(p, 1) - lies.each
            self.anybody = max(0.0, float(least - np.log1p(self.a2 * Q.diagonal().min())))

    def charge(self, count: int, false: int) -> float:
        return (
            price(self.size, count)
            + self.lies.each * count
            + self.lies.false * false
            + self.anybody * (count > 0)
        )

    def charges(self, at: _State) -> float:
        return self.charge(int(at.liars.sum()), int(at.powers.sum()))

    def cost(self, at: _State) -> float:
        return at.fit + at.logdet + self.charges(at)

    def meters(self, at: _State) -> Floats:
        """Rise of J by accusing each meter, or by trusting it again, (p,)."""
        on = at.liars
        delta = np.where(on, -self.a2, self.a2)
        pivot = np.maximum(1.0 + delta * at.Q.diagonal(), np.finfo(np.float64).tiny)
        k, f, now = int(on.sum()), int(at.powers.sum()), self.charges(at)
        more, less = self.charge(k + 1, f) - now, self.charge(max(k - 1, 0), f) - now
        rise = np.log(pivot) - delta * at.g**2 / pivot + np.where(on, less, more)
        # Powers are false only where the meter lies.
        return np.where(at.powers, np.inf, rise)

    def pairs(self, at: _State, who: Ints) -> Floats:
        """Rise of J by false powers of some customers, their meters included where trusted, (k,)."""
        k, f, now = int(at.liars.sum()), int(at.powers.sum()), self.charges(at)
        B = self._columns(who)
        QB = (at.Q @ B.reshape(self.size, -1)).reshape(B.shape)
        # The meter first, which changes Q and g by rank one; then its customer's powers.
        own = np.where(at.liars[who], 0.0, self.a2)
        pivot = 1.0 + own * at.Q[who, who]
        row, g = QB[who, np.arange(who.size)], at.g[who]
        M = np.einsum("jci,jck->cik", B, QB) - (own / pivot)[:, None, None] * row[:, :, None] * row[:, None]
        h = np.einsum("j,jci->ci", at.g, B) - (own / pivot * g)[:, None] * row
        det, gain = _by_two(M, h, 1.0)
        more = np.where(at.liars[who], self.charge(k, f + 1), self.charge(k + 1, f + 1)) - now
        return np.where(at.powers[who], np.inf, np.log(pivot * det) - own / pivot * g**2 - gain + more)

    def believed(self, at: _State, who: Ints) -> Floats:
        """Rise of J by believing the powers of some customers again, (k,)."""
        k, f = int(at.liars.sum()), int(at.powers.sum())
        B = self._columns(who)
        M = np.einsum("jci,jl,lck->cik", B, at.Q, B, optimize=True)
        det, gain = _by_two(M, np.einsum("j,jci->ci", at.g, B), -1.0)
        return np.log(det) - gain + self.charge(k, f - 1) - self.charge(k, f)

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
        M = sign * np.eye(2) + u.T @ Qu
        solved = np.linalg.solve(M, np.column_stack([Qu.T, h]))
        at.fit -= float(h @ solved[:, -1])
        at.logdet += float(np.linalg.slogdet(M)[1])
        at.g = at.g - Qu @ solved[:, -1]
        at.Q -= Qu @ solved[:, :-1]
        at.powers[c] = sign > 0


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
# So many customers, those that explain most, are where a search with false powers begins.
_STARTS = 6


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
    K[np.diag_indices(d.size)] += d
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
    if first is start:
        return [start]
    if false and first.fit > problem.size + _MISFIT * np.sqrt(2.0 * problem.size):
        for c in _doubtful(problem, start):
            _descend(problem, _doubted(problem, start, c), known, false)
    _exchange(problem, min(known.values(), key=problem.cost), known, false)
    return list(known.values())


def _doubtful(problem: _Problem, at: _State) -> list[int]:
    """Customers whose false powers explain more than their lying meter alone, the best first."""
    rise = problem.pairs(at, np.arange(problem.size))
    order = np.argsort(rise)[:_STARTS]
    return [int(c) for c in order[(rise < problem.meters(at))[order]]]


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
        doubts = problem.pairs(at, who)
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
        problem.toggle(after, k)
        if after.key not in known and problem.cost(after) - least <= within:
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
