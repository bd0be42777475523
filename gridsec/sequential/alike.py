"""The lies of one attack are alike: what that says about who lies.

Liars that act together read high by the same amount, or as if one of them drew more power than it does: their
lies are one number times a shape. With u the shape, s its amplitude's standard deviation and d the part by
which each may differ from it,

    a_L ~ N(0, C_L),   C_L = A^2 I   or   s^2 (u u^T + d^2 diag(u)^2),   u = 1 or u_j = R_jc / R_cc,  c in L

The second has one large number to explain all lies with, and so pays for one freedom instead of |L|: weak
lies that fit to strong ones are named, and readings that err by chance into another direction are not.
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
            J, _ = self._judged(L, self._shapes(L))
            J += self._prices(size)
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
            C = self._shapes(L)[:, k : k + 1]
            _, by = self._judged(L, C)
            out[L[0]], lies[L[0]] = True, by[0, 0]
            weights = self.z - self.Q[:, L[0]] @ by[0, 0]
        self.told[liars] = Set(out, self.powers, cost, weights, lies)
        return self.told[liars]

    def _shapes(self, L: Ints) -> Floats:
        """C of each set, (b, shapes, k, k): independent, all the same, and as if one of them drew more."""
        lies, (count, k) = self.problem.lies, L.shape
        apart = np.broadcast_to(lies.size**2 * np.eye(k), (count, 1, k, k))
        if k == 1:
            return apart
        u = np.ones((count, 1, k))
        if self.problem.false is not None:
            R = self.problem.false.R[L[:, None, :], L[:, :, None]]
            u = np.concatenate([u, R / np.diagonal(R, axis1=1, axis2=2)[:, :, None]], axis=1)
        about = 1.0 + lies.differ**2 * np.eye(k)
        return np.concatenate([apart, lies.amplitude**2 * about * u[..., None] * u[..., None, :]], axis=1)

    def _prices(self, k: int) -> Floats:
        """What each shape costs a set of k beside its freedom, (shapes,)."""
        lies = self.problem.lies
        price = float(self.problem.prices[k])
        apart = price + lies.apart * (k - 1)
        if k == 1:
            return np.array([apart])
        same = price + lies.pair + lies.more * (k - 2)
        drawn = np.full(k if self.problem.false is not None else 0, same + 2.0 * np.log(k))
        return np.concatenate([[apart, same], drawn])

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
    return any(each.counts[0] > 1 and cost - lowest <= _WORSE for cost, each in ranked[1:])


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
    _descend(best)
    within = min(best.known.values())[0] + 2.0 * np.log(problem.lies.like)
    return [
        base.explained(liars)
        for base in bases.values()
        for liars, (cost, _) in base.known.items()
        if cost <= within
    ]


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
