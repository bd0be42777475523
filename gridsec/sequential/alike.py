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

    J(L, C) - J({}) = ln det(I + C_L Q_LL) - z_L^T (I + C_L Q_LL)^-1 C_L z_L + price

Sets of the same size are judged at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import binom

from gridsec.arrays import Bools, Floats, Ints
from gridsec.sequential.rises import Problem, State

__all__ = ["MOST", "Set", "alike", "worth"]

# Larger sets are left as they are: what is gained is little, and there are too many of them.
MOST = 8
# So many sets, no more than so much worse than the best, are gone on from.
_WIDTH, _NEAR = 2, 6.0
_ROUNDS = 6
# No explanation that is so much worse becomes the best because its lies are alike.
_WORSE = 30.0
# Any two of so many meters may be where a search begins.
_PAIRED = 8
# Independent, all the same: other shapes are stories.
_PLAIN = 2
# Who is not off by this part of what liars have in common, or not unusually, by the square, is none of them.
_LIKE, _UNUSUAL = 0.5, 2.0
# Loads this much alike, as a part, are felt alike.
_SAME = 1e-9


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
        honest = at.copy() if at.liars.any() else at
        for j in np.flatnonzero(at.liars).tolist():
            problem.toggle(honest, j)
        # Linearised about the likeliest of them.
        self.Q, self.z = honest.Q, honest.Q @ m
        self.nobody = float(m @ self.z) + honest.logdet + problem.lies.false * at.counts[1]
        self.known: dict[tuple[int, ...], tuple[float, int]] = {}
        self.told: dict[tuple[int, ...], Set] = {}
        self.felt: dict[int, Floats] = {}

    def costs(self, sets: Iterable[tuple[int, ...]]) -> None:
        """Learn J of some sets, and the likeliest shape of each."""
        by_size: dict[int, list[tuple[int, ...]]] = {}
        for each in sets:
            if each not in self.known:
                by_size.setdefault(len(each), []).append(each)
        for size, some in by_size.items():
            if not size:
                self.known[()] = (self.nobody, 0)
                continue
            L = np.array(some)
            J = self._judged(L, self._plain(L))[0] + self._prices(size)
            stories = self._stories(L) if size > 1 and self.problem.false is not None else None
            if stories is not None:
                J = np.concatenate([J, stories], axis=1)
            best = np.argmin(J, axis=1)
            for each, k, cost in zip(some, best.tolist(), J.min(axis=1).tolist(), strict=True):
                self.known[each] = (self.nobody + cost, k)

    def explained(self, liars: tuple[int, ...]) -> Set:
        """All about a set whose cost is known."""
        if liars in self.told:
            return self.told[liars]
        cost, k = self.known[liars]
        out, lies, weights = np.zeros(self.z.size, dtype=np.bool_), np.zeros(self.z.size), self.z
        if liars:
            L = np.array([liars])
            C = self._plain(L)[:, k : k + 1] if k < _PLAIN else self._told_of(L, L[:, k - _PLAIN])
            _, by = self._judged(L, C)
            out[L[0]], lies[L[0]] = True, by[0, 0]
            weights = self.z - self.Q[:, L[0]] @ by[0, 0]
        self.told[liars] = Set(out, self.powers, cost, weights, lies)
        return self.told[liars]

    def _plain(self, L: Ints) -> Floats:
        """C of each set where lies are independent, and where they are all the same, (b, 1 or 2, k, k)."""
        lies, (count, k) = self.problem.lies, L.shape
        C = lies.size**2 * np.eye(k)[None]
        if k > 1:
            C = np.stack([C[0], lies.amplitude**2 * (1.0 + lies.differ**2 * np.eye(k))])
        return np.broadcast_to(C, (count, *C.shape))

    def _prices(self, k: int) -> Floats:
        """What both cost a set of k beside their freedom, (1 or 2,)."""
        lies, price = self.problem.lies, float(self.problem.prices[k])
        apart = price + lies.apart * (k - 1)
        return np.array([apart, price + lies.pair + lies.more * (k - 2)][: min(k, _PLAIN)])

    def _told_of(self, L: Ints, c: Ints) -> Floats:
        """C of each set as the story of one customer, (b, 1, k, k)."""
        lies, false = self.problem.lies, self.problem.false
        assert false is not None  # noqa: S101  # the callers have looked
        u = false.R[L, c[:, None]] / false.R[c, c][:, None]
        about = 1.0 + lies.differ**2 * np.eye(L.shape[1])
        return np.asarray(lies.amplitude**2 * about * u[:, :, None] * u[:, None, :])[:, None]

    def _stories(self, L: Ints) -> Floats | None:
        """Rise of J with the price where each of a set is whom the story is about, (b, k); inf for none."""
        problem, (p, k) = self.problem, (self.problem.size, L.shape[1])
        assert problem.false is not None  # noqa: S101  # the caller has looked
        R = problem.false.R
        among = R[L[:, :, None], L[:, None, :]]
        weakest = among.min(axis=1)
        # Whom the load does not move, as at the busbar, or moves the other way tells nothing of it.
        rows, of = np.nonzero((weakest >= self._felt(k, L) * (1.0 - _SAME)) & (weakest > 0.0))
        low, high = (weakest[rows, of] * (1.0 + side) for side in (-_SAME, _SAME))
        c, more = L[rows, of], (among[rows, :, of] > high[:, None]).sum(axis=1)
        # Others who feel it as little as some of a set may be many, but none of them feels it more.
        tells = (R[:, c] > high).sum(axis=0) == more
        rows, of, c, more, low, high = (each[tells] for each in (rows, of, c, more, low, high))
        if not rows.size:
            return None
        # Of those that would feel it alike, some are chosen; whose story it is belongs to it.
        own = R[c, c] <= high
        ties = (R[:, c] >= low).sum(axis=0) - more - own
        choices = np.log(p * binom(ties, k - more - own)) - np.log(binom(p, k))
        out = np.full(L.shape, np.inf)
        J = self._judged(L[rows], self._told_of(L[rows], c))[0][:, 0]
        out[rows, of] = J + problem.prices[k] + problem.lies.story + 2.0 * choices
        return out

    def _felt(self, k: int, c: Ints) -> Floats:
        """How much at least the k meters feel some customers' loads that feel them most, the shape of c."""
        false, p = self.problem.false, self.problem.size
        assert false is not None  # noqa: S101  # the callers have looked
        known = self.felt.setdefault(k, np.full(p, np.nan))
        new = np.unique(c[np.isnan(known[c])])
        if new.size:
            known[new] = np.partition(false.R[:, new], p - k, axis=0)[p - k]
        return np.asarray(known[c])

    def _judged(self, L: Ints, C: Floats) -> tuple[Any, Any]:
        """Rise of J without the price, (b, shapes), and the lies, (b, shapes, k)."""
        M = C @ self.Q[L[:, :, None], L[:, None, :]][:, None]
        M += np.eye(L.shape[1])
        z = self.z[L][:, None]
        by = np.linalg.solve(M, C @ z[..., None])[..., 0]
        return np.linalg.slogdet(M)[1] - np.einsum("...k,...k", z, by), by


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
    if ((best.g**2 > least(problem, count + 1) * best.Q.diagonal()) & ~best.liars).any():
        return True
    if count > 1 and (problem.meters(best)[best.liars] <= _WORSE).any():
        return True
    if _like_all(problem, best) or (problem.false is not None and _continued(problem, best)):
        return True
    return any(each.counts[0] > 1 and cost - lowest <= _WORSE for cost, each in ranked[1:])


def _like_all(problem: Problem, best: State) -> bool:
    """Whether somebody else reads about as far off as the liars do on average."""
    others = np.flatnonzero((best.g**2 > _UNUSUAL * best.Q.diagonal()) & ~best.liars)
    expected = problem.a2 * float(best.g[best.liars].mean())
    off = best.g[others] / best.Q[others, others]
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
    odd = np.flatnonzero((best.g**2 > max(price, 0.0) * best.Q.diagonal()) & ~best.liars)
    liars = np.flatnonzero(best.liars)
    liars = liars[R[liars, liars] > 0.0]
    if not odd.size or not liars.size:
        return False
    column = R[:, liars]
    told = column >= np.partition(column, p - k, axis=0)[p - k] * (1.0 - _SAME)
    off = best.g[odd] / best.Q[odd, odd]
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
    for key, some in likely.items():
        same = [at for _, at in ranked if at.powers.tobytes() == key]
        bases[key] = _Base(problem, min(same, key=lambda at: at.counts[0]), some[0].m)
        bases[key].costs(_members(at.liars) for at in some)
    best = min(bases.values(), key=lambda base: min(base.known.values())[0])
    if not best.powers.any():
        best.costs(combinations(_strongest(best), 2))
        best.costs(_stories(best))
    _descend(best)
    within = min(best.known.values())[0] + 2.0 * np.log(problem.lies.like)
    return [
        base.explained(liars)
        for base in bases.values()
        for liars, (cost, _) in base.known.items()
        if cost <= within
    ]


def _stories(base: _Base) -> Iterator[tuple[int, ...]]:
    """Stories about one of the likeliest liars, about as long as that explanation."""
    if base.problem.false is None:
        return
    R, size = base.problem.false.R, base.z**2 / base.Q.diagonal()
    liars = min(base.known, key=lambda each: base.known[each][0])
    for c in (c for c in liars if R[c, c] > 0.0):
        felt = np.round(R[:, c] / R[c, c], 9)
        felt[c] = np.inf
        order = np.lexsort((-size, -felt)).tolist()
        for k in range(max(2, len(liars) - 1), min(MOST, len(liars) + 2, len(order)) + 1):
            yield tuple(sorted(order[:k]))


def _strongest(base: _Base) -> list[int]:
    """Meters whose readings fit worst while nobody is accused."""
    size = base.z**2 / base.Q.diagonal()
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
    now = base.explained(at)
    beyond = now.weights**2 > least(base.problem, len(at) + 1) * _left(base, at)
    beyond[list(at)] = False
    others = np.flatnonzero(beyond).tolist()
    free = [i for i in at if not base.powers[i]]
    for i in free:
        rest = [k for k in at if k != i]
        if rest:
            yield tuple(rest)
            for j in others:
                yield tuple(sorted([*rest, j]))
    if len(at) < min(MOST, base.z.size):
        for j in others:
            yield tuple(sorted([*at, j]))


def _left(base: _Base, at: tuple[int, ...]) -> Floats:
    """Variance of the weights of an explanation, (p,): the diagonal of its Q, its liars left out."""
    L = list(at)
    QL = base.Q[:, L]
    return np.asarray(
        base.Q.diagonal() - np.einsum("jk,jk->j", QL, np.linalg.solve(base.Q[np.ix_(L, L)], QL.T).T)
    )
