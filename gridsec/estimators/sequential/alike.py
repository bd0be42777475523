"""The lies of one attack are alike: what that says about who lies.

Liars that act together read high by the same amount, or as if one of them drew more power than it does: their
lies are one number times a shape. With u the shape, s its amplitude's standard deviation and d the part by
which each may differ from it,

    a_L ~ N(0, C_L),   C_L = A^2 I   or   s^2 (u u^T + d^2 diag(u)^2),   u = 1 or u_j = R_jc / R_cc,  c in L

The second has one large number to explain all lies with, and so pays for one freedom instead of |L|: weak
lies that fit to strong ones are named, and readings that err by chance into another direction are not.
Who tells of a load that is not there has no choice of whose meters to use: any honest one that the load would
move more than a lying one contradicts the story. So whose load it is says who lies, and such a set costs the
choice of one of p customers, not that of |L| of p meters; other sets do not tell stories.
With ``Q = K^-1`` and ``z = Q m`` of the same explanation without liars,

    J(L, C) - J({}) = ln det C_L + ln det(C_L^-1 + Q_LL) - z_L^T (C_L^-1 + Q_LL)^-1 z_L + price

All shapes of many sets are judged at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from math import comb, log

import numpy as np
from scipy.special import binom

from gridsec.arrays import Bools, Floats, Ints, frozen, submatrix
from gridsec.estimators.sequential.conditional import solved
from gridsec.estimators.sequential.rises import MOST, Lies, Problem, State

__all__ = ["MOST", "Set", "alike", "worth"]

# So many sets, no more than so much worse than the best, are gone on from.
_WIDTH, _NEAR = 2, 6.0
_ROUNDS = 6
# No explanation that is so much worse becomes the best because its lies are alike.
_WORSE = 30.0
# Any two of so many meters may be where a search begins.
_PAIRED = 8
# Shapes of lies: independent, all the same; others are stories, by the number of the customer.
_ALONE, _SAME = -1, -2
# Who is not off by this part of what liars have in common, or not unusually, by the square, is none of them.
_LIKE, _UNUSUAL = 0.5, 2.0
# Loads this much alike, as a part, are felt alike.
_ALIKE = 1e-9
# Pivots are positive; rounding may make them less.
_TINY = float(np.finfo(np.float64).tiny)


Ranked = list[tuple[float, State]]


@dataclass(frozen=True, slots=True, eq=False)
class Set:
    """One explanation, its lies alike or not. p meters.

    Attributes
    ----------
    liars, powers : (p,)
        Whose readings are manipulated, and whose powers are false as well.
    cost
        J.
    weights : (p,)
        ``K^-1 m``.
    lies : (p,)
        What each liar's reading is expected to be off by; 0 elsewhere.
    """

    liars: Bools
    powers: Bools
    cost: float
    weights: Floats
    lies: Floats


class _Base:
    """Explanations with the same false powers, by what they say without liars."""

    def __init__(self, problem: Problem, at: State, m: Floats) -> None:
        self.problem, self.powers = problem, at.powers
        self.honest = honest = at.copy() if at.liars.any() else at
        for j in np.flatnonzero(at.liars).tolist():
            problem.toggle(honest, j)
        # Linearised about the likeliest of them.
        self.z, self.diagonal = honest.times(m), honest.diagonal
        self.nobody = float(m @ self.z) + honest.logdet + problem.lies.false * at.counts[1]
        self.known: dict[tuple[int, ...], tuple[float, int]] = {}
        self.told: dict[tuple[int, ...], Set] = {}
        # Rows of Q are made where somebody asks. Place 0 is nobody, who fills up the smaller sets.
        self.place, self.members = np.zeros(self.z.size, dtype=np.intp), np.zeros(0, dtype=np.intp)
        self.rows, self.Q, self.at = np.empty((0, self.z.size)), np.zeros((1, 1)), np.zeros(1)

    @property
    def limit(self) -> float:
        """What costs more is neither reported nor gone on from."""
        lowest, _ = min(self.known.values())
        return lowest + max(_NEAR, 2.0 * log(self.problem.lies.like))

    def costs(self, sets: Iterable[tuple[int, ...]]) -> None:
        """Learn J of some sets, and the likeliest shape of each."""
        new = [each for each in dict.fromkeys(sets) if each not in self.known]
        if () in new:
            new.remove(())
            self.known[()] = self.nobody, _ALONE
        if not new:
            return
        for k, shape, cost in zip(*(each.tolist() for each in self.shapes(new)), strict=True):
            if cost < self.known.get(new[k], (np.inf, 0))[0]:
                self.known[new[k]] = cost, shape

    def shapes(self, sets: list[tuple[int, ...]]) -> tuple[Ints, Ints, Floats]:
        """J of all shapes that some sets' lies may have: which set, which shape, and J, (s,) each."""
        sizes = np.array([len(each) for each in sets])
        L = np.array([each + each[:1] * (sizes.max() - len(each)) for each in sets])
        at, every, plain = self._places(L, sizes), np.arange(sizes.size), np.zeros(2 * sizes.size)
        of, shape = np.concatenate((every, every)), np.repeat((_ALONE, _SAME), sizes.size)
        price, u = plain, np.ones((1, 1))
        if self.problem.false is not None and L.shape[1] > 1:
            rows, about, chosen = self._stories(L, sizes)
            if rows.size:
                of, shape = np.concatenate((of, rows)), np.concatenate((shape, about))
                price, u = np.concatenate((plain, chosen)), np.ones((of.size, L.shape[1]))
                u[plain.size :] = self._moved(L[rows], about)
        table, like, size = _table(self.problem.lies, L.shape[1]), np.minimum(shape, 0), sizes[of]
        gain, freedom = self._judged(at[of], u, table.inverse[size, like])
        J = self.nobody + self.problem.prices[size] + table.cost[size, like] + price + freedom - gain
        return of, shape, J

    def explained(self, liars: tuple[int, ...]) -> Set:
        """All about a set whose cost is known."""
        if liars in self.told:
            return self.told[liars]
        cost, shape = self.known[liars]
        out, lies, weights = np.zeros(self.z.size, dtype=np.bool_), np.zeros(self.z.size), self.z
        if liars:
            L, u = np.array(liars), np.ones(len(liars))
            at = self.place[L]
            if shape >= 0:
                u = self._moved(L[None], np.array([shape]))[0]
            inverse = _table(self.problem.lies, L.size).inverse[L.size, min(shape, 0)]
            M = inverse + submatrix(self.Q, at, at) * np.multiply.outer(u, u)
            out[L], lies[L] = True, u * solved(M.T, u * self.z[L])
            weights = self.z - lies[L] @ self.rows[at - 1]
        self.told[liars] = Set(out, self.powers, cost, weights, lies)
        return self.told[liars]

    def without(self, liars: tuple[int, ...]) -> tuple[Floats, Floats]:
        """What follows of a set where its lies are free: a bound of J without each, and variances.

        With ``H = Q_LL^-1`` no lies explain more than ``z^T H z``, and without the i-th ``(H z)_i^2 / H_ii``
        less, (k,). The variances are those of everybody's weights, (p,): the diagonal of Q without the set.
        """
        lies, L, k = self.problem.lies, list(liars), len(liars) - 1
        Q = self.rows[self.place[L] - 1]
        H = np.linalg.inv(Q[:, L])
        by, own = H @ self.z[L], H.diagonal()
        gain = float(self.z[L] @ by) - by**2 / own
        # Some one of them is free by as much at least as the others leave open.
        freedom = float(np.log1p(min(lies.size, lies.amplitude) ** 2 / own.max()))
        least = self.nobody + self.problem.prices[k] + freedom + self._extra(k) - gain
        return least, np.asarray(self.diagonal - np.einsum("kj,kj->j", H @ Q, Q))

    def _extra(self, k: int) -> float:
        """What the shape of k lies costs at least beside their freedom and the price of the set."""
        lies, p = self.problem.lies, self.problem.size
        if k < 2:
            return 0.0
        told = lies.story + 2.0 * (log(p) - log(comb(p, k)))
        return min(lies.apart * (k - 1), lies.pair + lies.more * (k - 2), told)

    def _places(self, L: Ints, sizes: Ints) -> Ints:
        """Where the members of each set have their row of Q, (b, k), 0 where a set is smaller."""
        unknown = self.place[L] == 0
        if unknown.any():
            new = np.unique(L[unknown])
            members = self.members = np.concatenate((self.members, new))
            self.place[members] = np.arange(1, members.size + 1)
            self.rows = np.concatenate((self.rows, self.honest.rows(new)))
            self.Q, self.at = np.zeros((members.size + 1, members.size + 1)), np.append(0.0, self.z[members])
            self.Q[1:, 1:] = self.rows[:, members]
        return self.place[L] * (np.arange(L.shape[1]) < sizes[:, None])

    def _moved(self, L: Ints, c: Ints) -> Floats:
        """How far one customer's load moves each of a set, its own voltage by one, (b, k)."""
        false = self.problem.false
        assert false is not None  # noqa: S101  # the callers have looked
        return np.asarray(false.R[L, c[:, None]] / false.R[c, c][:, None])

    def _stories(self, L: Ints, sizes: Ints) -> tuple[Ints, Ints, Floats]:
        """Which of some sets tell a story, whose, and what that costs, (s,) each.

        `L` are the sets, (b, k), the smaller ones filled up with their first member.
        """
        problem, p = self.problem, self.problem.size
        assert problem.false is not None  # noqa: S101  # the caller has looked
        R, real = problem.false.R, np.arange(L.shape[1]) < sizes[:, None]
        among = R[L[:, :, None], L[:, None, :]]
        weakest = among.min(axis=1)
        # Whom the load does not move, as at the busbar, or moves the other way tells nothing of it.
        enough = weakest >= problem.felt[sizes[:, None] - 1, L] * (1.0 - _ALIKE)
        rows, of = np.nonzero(enough & real & (weakest > 0.0) & (sizes > 1)[:, None])
        if not rows.size:
            return rows, rows, weakest[rows, of]
        low, high = (weakest[rows, of] * (1.0 + side) for side in (-_ALIKE, _ALIKE))
        c, more = L[rows, of], ((among[rows, :, of] > high[:, None]) & real[rows]).sum(axis=1)
        # Others who feel it as little as some of a set may be many, but none of them feels it more.
        tells = (problem.felt[:, c] > high).sum(axis=0) == more
        rows, c, more, low, high = (each[tells] for each in (rows, c, more, low, high))
        # Of those that would feel it alike, some are chosen; whose story it is belongs to it.
        own, k = R[c, c] <= high, sizes[rows]
        ties = (R[:, c] >= low).sum(axis=0) - more - own
        choices = np.log(p * binom(ties, k - more - own)) - np.log(binom(p, k))
        return rows, c, problem.lies.story + 2.0 * choices

    def _judged(self, at: Ints, u: Floats, inverse: Floats) -> tuple[Floats, Floats]:
        """``z^T (C^-1 + Q_LL)^-1 z`` and ``ln det(E^-1 + U Q_LL U)`` of many sets, (s,) each.

        By their places, (s, k); ``C = U E U`` with U = diag(u), and `inverse` is ``E^-1``, (s, k, k). By
        elimination: the matrix is bordered by z, and what is left in the corner is what z explains.
        """
        L, u, k = at.T, u.T, at.shape[1]
        T = np.zeros((k + 1, k + 1, len(at)))
        T[:k, :k] = self.Q[L[:, None], L] * (u[:, None] * u) + inverse.T
        T[k, :k] = T[:k, k] = self.at[L] * u
        for i in range(k):
            T[i + 1 :, i + 1 :] -= T[i + 1 :, i, None] * (T[i, i + 1 :] / T[i, i])
        return -T[k, k], np.log(np.maximum(np.einsum("iis->is", T)[:k], _TINY)).sum(axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """E of sets of 0, 1, … k lies, by their shape: a story, independent, all the same.

    Attributes
    ----------
    inverse : (k + 1, 3, k, k)
        ``E^-1``: ``1 / A^2``, or that of ``s^2 (1 1^T + d^2)``; of those there are not, 1.
    cost : (k + 1, 3)
        ``ln det E`` with what lies cost beside the price of the set.
    """

    inverse: Floats
    cost: Floats


@cache
def _table(lies: Lies, most: int) -> _Table:
    d2, s2, sizes = lies.differ**2, lies.amplitude**2, np.arange(most + 1)
    inverse = np.tile(np.eye(most), (most + 1, 3, 1, 1))
    for k in range(1, most + 1):
        alone, same = np.eye(k) / lies.size**2, (np.eye(k) - 1.0 / (d2 + k)) / (s2 * d2)
        inverse[k, :, :k, :k] = same, same, alone
    alike = sizes * np.log(s2) + (sizes - 1) * np.log(d2) + np.log(d2 + sizes)
    same = np.where(sizes > 1, alike + lies.pair + lies.more * (sizes - 2), np.inf)
    alone = 2.0 * sizes * np.log(lies.size) + lies.apart * (sizes - 1)
    cost = np.column_stack([alike, same, alone])
    return _Table(frozen(inverse), frozen(cost))


def worth(problem: Problem, ranked: Ranked) -> bool:
    """Whether anything could change.

    It could not where nobody else's reading is odd, every accusation is beyond doubt, and no other
    explanation comes near.

    Parameters
    ----------
    problem, ranked
        As in `alike`.
    """
    lowest, best = ranked[0]
    count = best.counts[0]
    if not 0 < count <= MOST:
        return False
    if ((best.g**2 > least(problem, count + 1) * best.diagonal) & ~best.liars).any():
        return True
    if count > 1 and (problem.meters(best)[best.liars] <= _WORSE).any():
        return True
    if _like_all(problem, best) or (problem.false is not None and _continued(problem, best)):
        return True
    return any(each.counts[0] > 1 and cost - lowest <= _WORSE for cost, each in ranked[1:])


def _like_all(problem: Problem, best: State) -> bool:
    """Whether somebody else reads about as far off as the liars do on average."""
    others = np.flatnonzero((best.g**2 > _UNUSUAL * best.diagonal) & ~best.liars)
    expected = problem.a2 * float(best.g[best.liars].mean())
    off = best.g[others] / best.diagonal[others]
    return bool((off * expected >= _LIKE * expected**2).any())


def _continued(problem: Problem, best: State) -> bool:
    """Whether somebody reads as off as who comes next in a story that all liars tell about one of them."""
    assert problem.false is not None  # noqa: S101  # the caller has looked
    p, k, R = problem.size, best.counts[0] + 1, problem.false.R
    if k > min(MOST, p):
        return False
    # Several tell a story already, and one more has no choice; one alone does not.
    price = float(problem.prices[k] - problem.prices[k - 1]) - 2.0 * float(np.log((p - k + 1.0) / k))
    price += problem.lies.story if k == 2 else 0.0
    odd = np.flatnonzero((best.g**2 > max(price, 0.0) * best.diagonal) & ~best.liars)
    liars = np.flatnonzero(best.liars)
    liars = liars[R[liars, liars] > 0.0]
    if not odd.size or not liars.size:
        return False
    column = R[:, liars]
    told = column >= problem.felt[k - 1, liars] * (1.0 - _ALIKE)
    off = best.g[odd] / best.diagonal[odd]
    expected = column[odd] * (problem.a2 * best.g[liars] / R[liars, liars])
    like = off[:, None] * expected >= _LIKE * expected**2
    return bool((told[best.liars].all(axis=0) & (told[odd] & like).any(axis=0)).any())


def least(problem: Problem, k: int) -> float:
    """What the k-th liar costs at least; no accusation explains more than the square of its residual."""
    lies, prices, k = problem.lies, problem.prices, min(k, problem.size)
    return max(float(prices[k] - prices[k - 1]) + (lies.pair if k == 2 else lies.more), 0.0)


def alike(problem: Problem, ranked: Ranked) -> list[Set]:
    """The explanations that were found, and what is likelier still because lies are alike.

    Parameters
    ----------
    problem
        The readings, and what may be wrong with them.
    ranked
        Explanations with J, the best first; those of more than `MOST` liars stay out.

    Returns
    -------
    list of Set
        In no order, none twice.
    """
    bases: dict[bytes, _Base] = {}
    likely: dict[bytes, list[State]] = {}
    for cost, at in ranked:
        if cost - ranked[0][0] <= _WORSE and at.counts[0] <= MOST:
            likely.setdefault(at.powers.tobytes(), []).append(at)
    first = ranked[0][1]
    for key, some in likely.items():
        # Other powers matter where they say something else about who lies.
        if not any(at is first or _differs(problem, first, at) for at in some):
            continue
        same = [at for _, at in ranked if at.powers.tobytes() == key]
        base = bases[key] = _Base(problem, min(same, key=lambda at: at.counts[0]), some[0].m)
        sets = [_members(at.liars) for at in some]
        if not (base.powers.any() or ranked[0][1].counts[1]):
            # Likely the best ones; they are asked for at once.
            sets += [*combinations(_strongest(base), 2), *_stories(base, sets[0])]
        base.costs(sets)
    best = min(bases.values(), key=lambda base: min(base.known.values())[0])
    if not best.powers.any():
        best.costs(combinations(_strongest(best), 2))
        best.costs(_stories(best, min(best.known, key=lambda each: best.known[each][0])))
    _descend(best)
    within = min(best.known.values())[0] + 2.0 * np.log(problem.lies.like)
    return [
        base.explained(liars)
        for base in bases.values()
        for liars, (cost, _) in base.known.items()
        if cost <= within
    ]


def _differs(problem: Problem, first: State, at: State) -> bool:
    """Whether another explanation may be likelier than the first, or close to it, with other liars."""
    if at.counts[0] > 1:
        return not np.array_equal(at.liars, first.liars)
    # One lie is like no other.
    most = problem.cost(first) + problem.lies.apart * (first.counts[0] - 1)
    return bool(problem.cost(at) <= most + max(_NEAR, 2.0 * log(problem.lies.like)))


def _stories(base: _Base, liars: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Stories about one of the likeliest liars, about as long as that explanation."""
    if base.problem.false is None:
        return
    R, size = base.problem.false.R, base.z**2 / base.diagonal
    for c in (c for c in liars if R[c, c] > 0.0):
        felt = np.round(R[:, c] / R[c, c], 9)
        felt[c] = np.inf
        order = np.lexsort((-size, -felt)).tolist()
        for k in range(max(2, len(liars) - 1), min(MOST, len(liars) + 2, len(order)) + 1):
            yield tuple(sorted(order[:k]))


def _strongest(base: _Base) -> list[int]:
    """Meters whose readings fit worst while nobody is accused."""
    size = base.z**2 / base.diagonal
    far = np.flatnonzero(size > least(base.problem, 2))
    return [int(j) for j in np.sort(far[np.argsort(-size[far])[:_PAIRED]])]


def _members(some: Bools) -> tuple[int, ...]:
    return tuple(np.flatnonzero(some).tolist())


def _descend(base: _Base) -> None:
    """Accuse one more, trust one again, exchange two: from the best few sets, until they stay the best."""
    done: set[tuple[int, ...]] = set()
    for _ in range(_ROUNDS):
        best = sorted(base.known, key=lambda each: base.known[each][0])[:_WIDTH]
        least = base.known[best[0]][0]
        near = [each for each in best if each not in done and base.known[each][0] - least <= _NEAR]
        if not near:
            return
        done.update(near)
        base.costs([new for each in near for new in _neighbours(base, each)])


def _neighbours(base: _Base, at: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    if not at:
        return
    now, (least_without, left) = base.explained(at), base.without(at)
    beyond = now.weights**2 > least(base.problem, len(at) + 1) * left
    beyond[list(at)] = False
    others = np.flatnonzero(beyond).tolist()
    for i, cost in zip(at, least_without.tolist(), strict=True):
        rest = tuple(k for k in at if k != i)
        if rest and not base.powers[i]:
            if cost <= base.limit:
                yield rest
            for j in others:
                yield tuple(sorted([*rest, j]))
    if len(at) < min(MOST, base.z.size):
        for j in others:
            yield tuple(sorted([*at, j]))
