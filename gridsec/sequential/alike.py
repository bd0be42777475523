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

Sets of the same size are judged at once. No lies, whatever their shape, explain more than
``z_L^T Q_LL^-1 z_L``: where even that leaves a set far behind the best, nobody asks for its stories.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from scipy.special import binom

from gridsec.arrays import Bools, Floats, Ints, frozen, submatrix
from gridsec.sequential.rises import Lies, Problem, State

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
        honest = at.copy() if at.liars.any() else at
        for j in np.flatnonzero(at.liars).tolist():
            problem.toggle(honest, j)
        # Linearised about the likeliest of them.
        self.Q, self.z, self.diagonal = honest.Q, honest.times(m), honest.diagonal
        self.nobody = float(m @ self.z) + honest.logdet + problem.lies.false * at.counts[1]
        self.known: dict[tuple[int, ...], tuple[float, int]] = {}
        self.told: dict[tuple[int, ...], Set] = {}
        self.felt: dict[int, Floats] = {}

    @property
    def limit(self) -> float:
        """What costs more neither is reported nor gone on from."""
        lowest = min((cost for cost, _ in self.known.values()), default=np.inf)
        return float(lowest + max(_NEAR, 2.0 * np.log(self.problem.lies.like)))

    def costs(self, sets: Iterable[tuple[int, ...]]) -> None:
        """Learn J of some sets, and the likeliest shape of each; of hopeless ones a bound of it."""
        by_size: dict[int, list[tuple[int, ...]]] = {}
        for each in sets:
            if each not in self.known:
                by_size.setdefault(len(each), []).append(each)
        for size, some in by_size.items():
            if not size:
                self.known[()] = (self.nobody, 0)
                continue
            L = np.array(some)
            J, least = self._plain(L)
            for each, cost, k in zip(some, J.min(axis=0).tolist(), J.argmin(axis=0).tolist(), strict=True):
                self.known[each] = (cost, k)
            if size > 1 and self.problem.false is not None:
                # Whatever story it tells.
                left = np.flatnonzero(least + self._chosen(size) <= self.limit)
                if left.size:
                    self._tell(L[left])

    def _tell(self, L: Ints) -> None:
        """What some sets cost that tell a story, where that is less."""
        stories = self._stories(L)
        if stories is None:
            return
        best, costs = np.argmin(stories, axis=1).tolist(), (self.nobody + stories.min(axis=1)).tolist()
        for each, k, cost in zip(map(tuple, L.tolist()), best, costs, strict=True):
            if cost < self.known[each][0]:
                self.known[each] = (cost, _PLAIN + k)

    def explained(self, liars: tuple[int, ...]) -> Set:
        """All about a set whose cost is known."""
        if liars in self.told:
            return self.told[liars]
        cost, k = self.known[liars]
        out, lies, weights = np.zeros(self.z.size, dtype=np.bool_), np.zeros(self.z.size), self.z
        if liars:
            L, u, shapes = np.array(liars), np.ones(len(liars)), _shapes(self.problem.lies, len(liars))
            if k >= _PLAIN:
                u = self._moved(L[None], L[None, k - _PLAIN])[0]
            M = shapes.inverse[min(k, 1)] + submatrix(self.Q, L, L) * np.multiply.outer(u, u)
            out[L], lies[L] = True, u * np.linalg.solve(M, u * self.z[L])
            weights = self.z - lies[L] @ self.Q[L]
        self.told[liars] = Set(out, self.powers, cost, weights, lies)
        return self.told[liars]

    def _plain(self, L: Ints) -> tuple[Floats, Floats]:
        """J of each set where lies are independent and where all are the same, (1 or 2, b).

        And no less than which it is for lies of any shape, (b,), without what the choice of the set costs.
        """
        k, shapes = L.shape[1], _shapes(self.problem.lies, L.shape[1])
        gain, freedom = self._judged(L, np.ones(1), np.concatenate([shapes.inverse, np.zeros((1, k, k))]))
        some = min(k, _PLAIN)
        J = freedom[:some] + shapes.logdet[:some, None] - gain[:some]
        J += (self.problem.prices[k] + shapes.price[:some] + self.nobody)[:, None]
        return J, self.nobody + self.problem.prices[k] - gain.max(axis=0)

    def _chosen(self, k: int) -> float:
        """What a story costs at least: there is one customer whose story it is, and one way to tell it."""
        p = self.problem.size
        return self.problem.lies.story + 2.0 * float(np.log(p / binom(p, k)))

    def _moved(self, L: Ints, c: Ints) -> Floats:
        """How far one customer's load moves each of a set, its own voltage by one, (b, k)."""
        false = self.problem.false
        assert false is not None  # noqa: S101  # the callers have looked
        return np.asarray(false.R[L, c[:, None]] / false.R[c, c][:, None])

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
        out, shapes = np.full(L.shape, np.inf), _shapes(problem.lies, k)
        gain, freedom = self._judged(L[rows], self._moved(L[rows], c).T, shapes.inverse[1:])
        J = freedom[0] + shapes.logdet[1] - gain[0]
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

    def _judged(self, L: Ints, u: Floats, inverse: Floats) -> tuple[Floats, Floats]:
        """``z^T (C^-1 + Q_LL)^-1 z`` and ``ln det(E^-1 + U Q_LL U)`` of many sets, (s, b) each.

        ``C = U E U`` with U = diag(u), (k, b), and ``E^-1`` one of `inverse`, (s, k, k). By elimination: the
        matrix is bordered by z, and what is left in the corner is what z explains.
        """
        b, k = L.shape
        T = np.empty((k + 1, k + 1, len(inverse), b))
        at = L.T
        T[:k, :k] = (self.Q[at[:, None], at] * u[:, None] * u)[:, :, None]
        T[:k, :k] += inverse.transpose(1, 2, 0)[..., None]
        T[k, :k] = T[:k, k] = (self.z[at] * u)[:, None]
        T[k, k] = 0.0
        for i in range(k):
            T[i + 1 :, i + 1 :] -= T[i + 1 :, i, None] * (T[i, i + 1 :] / T[i, i])
        return -T[k, k], np.log(np.maximum(np.einsum("iisb->isb", T)[:k], _TINY)).sum(axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class _Shapes:
    """E of so many lies, without the direction of a story: independent, and alike.

    Attributes
    ----------
    inverse : (2, k, k)
        ``E^-1``: ``1 / A^2``, and that of ``s^2 (1 1^T + d^2)``.
    logdet : (2,)
        ``ln det E``.
    price : (2,)
        What lies cost beside their freedom and the price of the set, where all are the same.
    """

    inverse: Floats
    logdet: Floats
    price: Floats


@cache
def _shapes(lies: Lies, k: int) -> _Shapes:
    one, d2, s2 = np.eye(k), lies.differ**2, lies.amplitude**2
    inverse = np.stack([one / lies.size**2, (one - 1.0 / (d2 + k)) / (s2 * d2)])
    alike = k * np.log(s2) + (k - 1) * np.log(d2) + np.log(d2 + k)
    logdet = np.array([2.0 * k * np.log(lies.size), alike])
    price = np.array([lies.apart * (k - 1), lies.pair + lies.more * (k - 2)])
    return _Shapes(frozen(inverse), frozen(logdet), frozen(price))


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
    told = column >= np.partition(column, p - k, axis=0)[p - k] * (1.0 - _SAME)
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
    R, size = base.problem.false.R, base.z**2 / base.diagonal
    liars = min(base.known, key=lambda each: base.known[each][0])
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
    L = np.array(at)
    Q = base.Q[L]
    return np.asarray(base.diagonal - np.einsum("kj,kj->j", Q, np.linalg.solve(Q[:, L], Q)))
