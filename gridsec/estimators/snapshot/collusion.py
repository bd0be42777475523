"""Sets of manipulations that are alike, and the evidence in it.

Meters attacked together read high by the same amount, or as if one customer drew more power: their errors
are one number times a shape. With u the shape, s the standard deviation of its amplitude and d the part by
which each may differ from it,

    a_L ~ N(0, C_L),   C_L = A^2 I   or   s^2 (u u^T + d^2 diag(u)^2),   u = 1 or u_j = R_jc / R_cc,  c in L

The second has one large number for all errors and pays for one freedom instead of |L|: weak errors that fit
to strong ones are accused, and readings that err by chance in another direction are not. A load that does
not exist determines its meters: an honest meter that the load would move more than a manipulated one
contradicts it. Such a set therefore costs the choice of one of p customers, not that of |L| of p meters.
With ``Q = K^-1`` and ``z = Q m`` of the same hypothesis without manipulated meters,

    J(L, C) - J({}) = ln det C_L + ln det(C_L^-1 + Q_LL) - z_L^T (C_L^-1 + Q_LL)^-1 z_L + price

All shapes of many sets are evaluated at once.
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
from gridsec.estimators.front.posterior import solve_spd
from gridsec.estimators.snapshot.likelihood import MOST, ErrorPrior, LikelihoodProblem, SnapshotHypothesis

__all__ = ["MOST", "ErrorSet", "likely_sets", "may_change"]

_WIDTH, _NEAR = 2, 6.0
"""Number of continued sets, and their largest distance from the best cost."""
_ROUNDS = 6
"""Largest number of rounds of a descent."""
_WORSE = 30.0
"""Largest fall of J by likeness of the errors."""
_PAIRED = 8
"""Meters of which any two may start a search."""
# Shapes of errors: independent, all the same; others are loads, by the number of the customer.
_ALONE, _SAME = -1, -2
_LIKE, _UNUSUAL = 0.5, 2.0
"""Least part of the common error, and least squared residual, of a further member."""
_ALIKE = 1e-9
"""Relative difference up to which effects of a load are equal."""
# Pivots are positive; rounding may make them less.
_TINY = float(np.finfo(np.float64).tiny)


Ranked = list[tuple[float, SnapshotHypothesis]]


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSet:
    """One hypothesis, with errors alike or not. p meters."""

    meters: Bools  # (p,) manipulated readings
    powers: Bools  # (p,) false powers as well
    cost: float  # J
    weights: Floats  # (p,) ``K^-1 m``
    errors: Floats  # (p,) expected error of each manipulated reading; 0 elsewhere


class _SamePowers:
    """Hypotheses with the same false powers, relative to the one without manipulated meters."""

    def __init__(self, problem: LikelihoodProblem, at: SnapshotHypothesis, m: Floats) -> None:
        self.problem, self.powers = problem, at.powers
        self.honest = honest = at.copy() if at.meters.any() else at
        for j in np.flatnonzero(at.meters).tolist():
            problem.toggle(honest, j)
        # Linearised about the likeliest hypothesis.
        self.z, self.diagonal = honest.times(m), honest.diagonal
        self.honest_cost = float(m @ self.z) + honest.logdet + problem.prior.false * at.counts[1]
        self.costed: dict[tuple[int, ...], tuple[float, int]] = {}
        self.details: dict[tuple[int, ...], ErrorSet] = {}
        # Rows of Q on demand. Place 0 is empty and fills up the smaller sets.
        self.place, self.members = np.zeros(self.z.size, dtype=np.intp), np.zeros(0, dtype=np.intp)
        self.rows, self.Q, self.at = np.empty((0, self.z.size)), np.zeros((1, 1)), np.zeros(1)

    @property
    def limit(self) -> float:
        """Largest cost of a hypothesis that is reported or continued."""
        lowest, _ = min(self.costed.values())
        return lowest + max(_NEAR, 2.0 * log(self.problem.prior.like))

    def evaluate(self, sets: Iterable[tuple[int, ...]]) -> None:
        """Compute J of some sets, and the likeliest shape of each."""
        new = [each for each in dict.fromkeys(sets) if each not in self.costed]
        if () in new:
            new.remove(())
            self.costed[()] = self.honest_cost, _ALONE
        if not new:
            return
        for k, shape, cost in zip(*(each.tolist() for each in self.shapes(new)), strict=True):
            if cost < self.costed.get(new[k], (np.inf, 0))[0]:
                self.costed[new[k]] = cost, shape

    def shapes(self, sets: list[tuple[int, ...]]) -> tuple[Ints, Ints, Floats]:
        """J of all shapes of some sets: index of the set, shape, and J, (s,) each."""
        sizes = np.array([len(each) for each in sets])
        L = np.array([each + each[:1] * (sizes.max() - len(each)) for each in sets])
        at, every, plain = self._places(L, sizes), np.arange(sizes.size), np.zeros(2 * sizes.size)
        of, shape = np.concatenate((every, every)), np.repeat((_ALONE, _SAME), sizes.size)
        price, u = plain, np.ones((1, 1))
        if self.problem.false is not None and L.shape[1] > 1:
            rows, about, chosen = self._load_shapes(L, sizes)
            if rows.size:
                of, shape = np.concatenate((of, rows)), np.concatenate((shape, about))
                price, u = np.concatenate((plain, chosen)), np.ones((of.size, L.shape[1]))
                u[plain.size :] = self._load_effects(L[rows], about)
        table, like, size = _table(self.problem.prior, L.shape[1]), np.minimum(shape, 0), sizes[of]
        gain, freedom = self._log_terms(at[of], u, table.inverse[size, like])
        J = self.honest_cost + self.problem.prices[size] + table.cost[size, like] + price + freedom - gain
        return of, shape, J

    def detail(self, suspects: tuple[int, ...]) -> ErrorSet:
        """Details of a set with known cost."""
        if suspects in self.details:
            return self.details[suspects]
        cost, shape = self.costed[suspects]
        out, error_prior, weights = np.zeros(self.z.size, dtype=np.bool_), np.zeros(self.z.size), self.z
        if suspects:
            L, u = np.array(suspects), np.ones(len(suspects))
            at = self.place[L]
            if shape >= 0:
                u = self._load_effects(L[None], np.array([shape]))[0]
            inverse = _table(self.problem.prior, L.size).inverse[L.size, min(shape, 0)]
            M = inverse + submatrix(self.Q, at, at) * np.multiply.outer(u, u)
            out[L], error_prior[L] = True, u * solve_spd(M.T, u * self.z[L])
            weights = self.z - error_prior[L] @ self.rows[at - 1]
        self.details[suspects] = ErrorSet(out, self.powers, cost, weights, error_prior)
        return self.details[suspects]

    def without(self, suspects: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Lower bound of J without each member of a set with free errors, (k,), and variances, (p,).

        With ``H = Q_LL^-1`` free errors explain at most ``z^T H z``, and without the i-th ``(H z)_i^2 /
        H_ii`` less. The variances are those of all weights: the diagonal of Q without the set.
        """
        error_prior, L, k = self.problem.prior, list(suspects), len(suspects) - 1
        Q = self.rows[self.place[L] - 1]
        H = np.linalg.inv(Q[:, L])
        by, own = H @ self.z[L], H.diagonal()
        gain = float(self.z[L] @ by) - by**2 / own
        # One of the errors has at least the freedom left by the others.
        freedom = float(np.log1p(min(error_prior.size, error_prior.amplitude) ** 2 / own.max()))
        least = self.honest_cost + self.problem.prices[k] + freedom + self._extra(k) - gain
        return least, np.asarray(self.diagonal - np.einsum("kj,kj->j", H @ Q, Q))

    def _extra(self, k: int) -> float:
        """Least cost of the shape of k errors beside their freedom and the price of the set."""
        error_prior, p = self.problem.prior, self.problem.size
        if k < 2:
            return 0.0
        of_load = error_prior.load + 2.0 * (log(p) - log(comb(p, k)))
        return min(error_prior.apart * (k - 1), error_prior.pair + error_prior.more * (k - 2), of_load)

    def _places(self, L: Ints, sizes: Ints) -> Ints:
        """Rows of Q of the members of each set, (b, k), 0 where a set is smaller."""
        unknown = self.place[L] == 0
        if unknown.any():
            new = np.unique(L[unknown])
            members = self.members = np.concatenate((self.members, new))
            self.place[members] = np.arange(1, members.size + 1)
            self.rows = np.concatenate((self.rows, self.honest.rows(new)))
            self.Q, self.at = np.zeros((members.size + 1, members.size + 1)), np.append(0.0, self.z[members])
            self.Q[1:, 1:] = self.rows[:, members]
        return self.place[L] * (np.arange(L.shape[1]) < sizes[:, None])

    def _load_effects(self, L: Ints, c: Ints) -> Floats:
        """Change of each member of a set by one customer's load, its own voltage by one, (b, k)."""
        false = self.problem.false
        assert false is not None  # noqa: S101  # the callers have looked
        return np.asarray(false.R[L, c[:, None]] / false.R[c, c][:, None])

    def _load_shapes(self, L: Ints, sizes: Ints) -> tuple[Ints, Ints, Floats]:
        """Sets that show one customer's load, the customer, and the cost, (s,) each.

        `L` are the sets, (b, k), the smaller ones filled up with their first member.
        """
        problem, p = self.problem, self.problem.size
        assert problem.false is not None  # noqa: S101  # the caller has looked
        R, real = problem.false.R, np.arange(L.shape[1]) < sizes[:, None]
        among = R[L[:, :, None], L[:, None, :]]
        weakest = among.min(axis=1)
        # Meters that the load does not move, or moves the other way, show nothing of it.
        enough = weakest >= problem.felt[sizes[:, None] - 1, L] * (1.0 - _ALIKE)
        rows, of = np.nonzero(enough & real & (weakest > 0.0) & (sizes > 1)[:, None])
        if not rows.size:
            return rows, rows, weakest[rows, of]
        low, high = (weakest[rows, of] * (1.0 + side) for side in (-_ALIKE, _ALIKE))
        c, more = L[rows, of], ((among[rows, :, of] > high[:, None]) & real[rows]).sum(axis=1)
        # Meters outside may be affected as little as a member, but not more.
        tells = (problem.felt[:, c] > high).sum(axis=0) == more
        rows, c, more, low, high = (each[tells] for each in (rows, c, more, low, high))
        # Of the equally affected meters some are chosen; the customer's own meter belongs to the set.
        own, k = R[c, c] <= high, sizes[rows]
        ties = (R[:, c] >= low).sum(axis=0) - more - own
        choices = np.log(p * binom(ties, k - more - own)) - np.log(binom(p, k))
        return rows, c, problem.prior.load + 2.0 * choices

    def _log_terms(self, at: Ints, u: Floats, inverse: Floats) -> tuple[Floats, Floats]:
        """``z^T (C^-1 + Q_LL)^-1 z`` and ``ln det(E^-1 + U Q_LL U)`` of many sets, (s,) each.

        By their places, (s, k); ``C = U E U`` with U = diag(u), and `inverse` is ``E^-1``, (s, k, k). By
        elimination: the matrix is bordered by z, and the corner left is explained by z.
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
    """E of sets of 0, 1, … k errors, by their shape: one load, independent, all the same."""

    inverse: Floats  # (k + 1, 3, k, k) ``E^-1``: ``1 / A^2``, or that of ``s^2 (1 1^T + d^2)``, padded with 1
    cost: Floats  # (k + 1, 3) ``ln det E`` plus the cost of the errors beside the price of the set


@cache
def _table(error_prior: ErrorPrior, most: int) -> _Table:
    d2, s2, sizes = error_prior.differ**2, error_prior.amplitude**2, np.arange(most + 1)
    inverse = np.tile(np.eye(most), (most + 1, 3, 1, 1))
    for k in range(1, most + 1):
        alone, same = np.eye(k) / error_prior.size**2, (np.eye(k) - 1.0 / (d2 + k)) / (s2 * d2)
        inverse[k, :, :k, :k] = same, same, alone
    alike = sizes * np.log(s2) + (sizes - 1) * np.log(d2) + np.log(d2 + sizes)
    same = np.where(sizes > 1, alike + error_prior.pair + error_prior.more * (sizes - 2), np.inf)
    alone = 2.0 * sizes * np.log(error_prior.size) + error_prior.apart * (sizes - 1)
    cost = np.column_stack([alike, same, alone])
    return _Table(frozen(inverse), frozen(cost))


def may_change(problem: LikelihoodProblem, ranked: Ranked) -> bool:
    """True if likeness could change the result.

    It could not where no other reading is odd, every accusation is beyond doubt, and no other hypothesis
    comes near.
    """
    lowest, best = ranked[0]
    count = best.counts[0]
    if not 0 < count <= MOST:
        return False
    if ((best.g**2 > least(problem, count + 1) * best.diagonal) & ~best.meters).any():
        return True
    if count > 1 and (problem.meter_rises(best)[best.meters] <= _WORSE).any():
        return True
    if _like_others(problem, best) or (problem.false is not None and _continued(problem, best)):
        return True
    return any(each.counts[0] > 1 and cost - lowest <= _WORSE for cost, each in ranked[1:])


def _like_others(problem: LikelihoodProblem, best: SnapshotHypothesis) -> bool:
    """True if another meter is about as far off as the manipulated ones on average."""
    others = np.flatnonzero((best.g**2 > _UNUSUAL * best.diagonal) & ~best.meters)
    expected = problem.a2 * float(best.g[best.meters].mean())
    off = best.g[others] / best.diagonal[others]
    return bool((off * expected >= _LIKE * expected**2).any())


def _continued(problem: LikelihoodProblem, best: SnapshotHypothesis) -> bool:
    """True if another meter is as odd as the next one of a load that all manipulated meters show."""
    assert problem.false is not None  # noqa: S101  # the caller has looked
    p, k, R = problem.size, best.counts[0] + 1, problem.false.R
    if k > min(MOST, p):
        return False
    # A load shown by several determines the next meter; one alone does not show a load.
    price = float(problem.prices[k] - problem.prices[k - 1]) - 2.0 * float(np.log((p - k + 1.0) / k))
    price += problem.prior.load if k == 2 else 0.0
    odd = np.flatnonzero((best.g**2 > max(price, 0.0) * best.diagonal) & ~best.meters)
    suspects = np.flatnonzero(best.meters)
    suspects = suspects[R[suspects, suspects] > 0.0]
    if not odd.size or not suspects.size:
        return False
    column = R[:, suspects]
    shown = column >= problem.felt[k - 1, suspects] * (1.0 - _ALIKE)
    off = best.g[odd] / best.diagonal[odd]
    expected = column[odd] * (problem.a2 * best.g[suspects] / R[suspects, suspects])
    like = off[:, None] * expected >= _LIKE * expected**2
    return bool((shown[best.meters].all(axis=0) & (shown[odd] & like).any(axis=0)).any())


def least(problem: LikelihoodProblem, k: int) -> float:
    """Least cost of the k-th manipulated meter; an accusation explains at most the square of its residual."""
    error_prior, prices, k = problem.prior, problem.prices, min(k, problem.size)
    return max(float(prices[k] - prices[k - 1]) + (error_prior.pair if k == 2 else error_prior.more), 0.0)


def likely_sets(problem: LikelihoodProblem, ranked: Ranked) -> list[ErrorSet]:
    """Hypotheses found so far, and likelier ones with errors that are alike, in no order.

    ranked: hypotheses with J, the best first; those of more than `MOST` manipulated meters stay out.
    """
    bases: dict[bytes, _SamePowers] = {}
    likely: dict[bytes, list[SnapshotHypothesis]] = {}
    for cost, at in ranked:
        if cost - ranked[0][0] <= _WORSE and at.counts[0] <= MOST:
            likely.setdefault(at.powers.tobytes(), []).append(at)
    first = ranked[0][1]
    for key, some in likely.items():
        # Other powers matter where they change the accused meters.
        if not any(at is first or _differs(problem, first, at) for at in some):
            continue
        same = [at for _, at in ranked if at.powers.tobytes() == key]
        base = bases[key] = _SamePowers(problem, min(same, key=lambda at: at.counts[0]), some[0].m)
        sets = [_members(at.meters) for at in some]
        if not (base.powers.any() or ranked[0][1].counts[1]):
            # Likely the best ones, computed at once.
            sets += [*combinations(_strongest(base), 2), *_load_sets(base, sets[0])]
        base.evaluate(sets)
    best = min(bases.values(), key=lambda base: min(base.costed.values())[0])
    if not best.powers.any():
        best.evaluate(combinations(_strongest(best), 2))
        best.evaluate(_load_sets(best, min(best.costed, key=lambda each: best.costed[each][0])))
    _descend(best)
    within = min(best.costed.values())[0] + 2.0 * np.log(problem.prior.like)
    return [
        base.detail(suspects)
        for base in bases.values()
        for suspects, (cost, _) in base.costed.items()
        if cost <= within
    ]


def _differs(problem: LikelihoodProblem, first: SnapshotHypothesis, at: SnapshotHypothesis) -> bool:
    """True if another hypothesis may be likelier than the first, or close to it, with other meters."""
    if at.counts[0] > 1:
        return not np.array_equal(at.meters, first.meters)
    # One error alone has no likeness.
    most = problem.cost(first) + problem.prior.apart * (first.counts[0] - 1)
    return bool(problem.cost(at) <= most + max(_NEAR, 2.0 * log(problem.prior.like)))


def _load_sets(base: _SamePowers, suspects: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Load shapes about one of the likeliest manipulated meters, about as many members."""
    if base.problem.false is None:
        return
    R, size = base.problem.false.R, base.z**2 / base.diagonal
    for c in (c for c in suspects if R[c, c] > 0.0):
        felt = np.round(R[:, c] / R[c, c], 9)
        felt[c] = np.inf
        order = np.lexsort((-size, -felt)).tolist()
        for k in range(max(2, len(suspects) - 1), min(MOST, len(suspects) + 2, len(order)) + 1):
            yield tuple(sorted(order[:k]))


def _strongest(base: _SamePowers) -> list[int]:
    """Meters with the worst residuals in the hypothesis without accusations."""
    size = base.z**2 / base.diagonal
    far = np.flatnonzero(size > least(base.problem, 2))
    return [int(j) for j in np.sort(far[np.argsort(-size[far])[:_PAIRED]])]


def _members(some: Bools) -> tuple[int, ...]:
    return tuple(np.flatnonzero(some).tolist())


def _descend(base: _SamePowers) -> None:
    """Accuse one more, trust one again, exchange two: from the best few sets, until they stay the best."""
    done: set[tuple[int, ...]] = set()
    for _ in range(_ROUNDS):
        best = sorted(base.costed, key=lambda each: base.costed[each][0])[:_WIDTH]
        least = base.costed[best[0]][0]
        near = [each for each in best if each not in done and base.costed[each][0] - least <= _NEAR]
        if not near:
            return
        done.update(near)
        base.evaluate([new for each in near for new in _neighbours(base, each)])


def _neighbours(base: _SamePowers, at: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    if not at:
        return
    now, (least_without, left) = base.detail(at), base.without(at)
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
