"""Search for the likeliest set of manipulated meters, without swamping honest or masking manipulated ones.

A hypothesis removes some meters and accuses some directions of the fault dictionary. Its cost is

    J = m_T^T Q m_T + 2 ln binom(p, k) + charges of the directions,

up to a constant minus twice the logarithm of its posterior probability, if every number k of manipulated
meters is equally likely, and every set of k among those of k. Each of many accusations is thus cheaper than a
single one.

Removing trusted meter j lowers the chi-square by ``residual_j^2 / std_j^2``, an unknown amplitude of
direction a by ``(a^T Q m)^2 / (1 / std_a^2 + a^T Q a)``; adding a meter raises it likewise. Steepest descent
therefore needs no refitting. It removes and adds meters with residuals beyond, or back within, the limits.

Descent alone swamps where many meters are off alike: their neighbours look wrong. It therefore starts from
the set trusted before and from a robust one (`gridsec.estimators.sequential.robust`); the cheaper hypothesis
wins.

References
----------
Chen and Chen 2008 (the prior over sets).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints, frozen_ints, indices, submatrix
from gridsec.estimators.sequential.blocks import Outside, sound, without
from gridsec.estimators.sequential.conditional import Fit, Judged, Move, admit, drop, follow, judge
from gridsec.estimators.sequential.dictionary import Dictionary, Powers, Step


class Recent:
    """Last result of `Limits.limit`, which repeats while no meter is suspect."""

    __slots__ = ("answer",)

    def __init__(self) -> None:
        self.answer: tuple[float, Floats, Floats] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Rule of the limits of honest residuals. p meters."""

    sigmas: float  # standard deviations within chance
    model: Floats  # (p,) largest error of the model, squared pu
    allowed: Floats  # (p,) honest offset of any probability, the accuracy class, squared pu
    certain: Floats  # (p,) variance within the meters' noise that `allowed` replaces
    most: int | None = None  # largest number of manipulated meters told apart; None for no limit
    late: Floats | None = None  # (p,) additional variance of the residuals, squared pu^2; None for none
    recent: Recent | None = None  # last result for these `allowed`, `certain` and `late`

    @property
    def penalty(self) -> float:
        """Least gain of removing a meter."""
        return self.sigmas**2

    def of(self, std: Floats, part: float = 1.0) -> Floats:
        """Largest honest residual for its standard deviation (p,): by chance, or by class and chance.

        part: used part of `sigmas`.
        """
        sigmas, recent = part * self.sigmas, self.recent
        last = None if recent is None else recent.answer
        if last is None or last[0] != sigmas or last[1] is not std:
            last = sigmas, std, self._within(std, sigmas)
            if recent is not None and part == 1.0:
                recent.answer = last
        return np.asarray(self.model + last[2])

    def _within(self, std: Floats, sigmas: float) -> Floats:
        if self.late is not None:
            std = np.sqrt(std * std + self.late)
        rest = np.sqrt(np.maximum(std * std - self.certain, 0.0))
        return np.asarray(np.minimum(sigmas * std, self.allowed + sigmas * rest))

    def some(self, at: Ints) -> Limits:
        """The same for meters `at` (k,)."""
        late = None if self.late is None else self.late[at]
        return Limits(self.sigmas, self.model[at], self.allowed[at], self.certain[at], self.most, late)


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Hypothesis of a search. p meters."""

    trusted: Bools  # (p,) meters that it does not accuse
    loosened: tuple[int, ...]  # accused directions, indices of the fault dictionary
    charge: float  # cost of these
    cost: float  # J


@dataclass(frozen=True, slots=True, eq=False)
class Solution(Explanation):
    """Hypothesis with its posterior."""

    fit: Fit  # posterior of the trusted meters
    judged: Judged  # leave-one-out residuals

    def bare(self) -> Explanation:
        """The hypothesis without its posterior, which is large."""
        return Explanation(self.trusted, self.loosened, self.charge, self.cost)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Results of several searches."""

    best: Solution  # the likeliest
    others: tuple[Explanation, ...] = ()  # the rest, in no order


def likelier(one: Found | None, other: Found) -> Found:
    """Union of the results; the first best one stays where both are equally likely."""
    if one is None:
        return other
    first, second = (other, one) if other.best.cost < one.best.cost else (one, other)
    return Found(first.best, (*first.others, second.best.bare(), *second.others))


NOBODY = frozen_ints(np.zeros(0, dtype=np.intp))
_MOVES_PER_METER = 4
"""Largest number of moves of a descent per meter."""


def descend(
    start: Fit,
    m: Floats,
    live: Bools,
    limits: Limits,
    *,
    keep: Bools,
    dictionary: Dictionary | None = None,
    innocent: Ints = NOBODY,
    pairs: bool = False,
    fresh: bool = False,
    judged: Judged | None = None,
) -> Solution:
    """Remove, add and accuse until no move lowers the cost.

    start: changed in place only if `fresh`; the posterior of the result where no move helps. live: (p,)
    meters with a reading. keep: (p,) meters that are not added. innocent: (k,) meters that stay trusted.
    judged: the residuals of `start` if known. pairs: remove two meters at once as well, O(p^2) per move; two
    meters of equal error support each other, and removing either gains little.
    """
    now, changed = start if fresh else start.copy(), start.changes
    barred = ~live | keep
    for j in innocent[~now.trusted[innocent]].tolist():
        admit(now, j)
    for j in indices(now.trusted & ~live):
        drop(now, int(j))
    if judged is None or now.changes != changed:
        judged = judge(now, m)
    before, moves, anew = now.changes, 0, True
    many = dictionary is None and not pairs and sound(now.prior, now.noise)
    powers = None if dictionary is None else Powers(now, dictionary, judged.weights, live, innocent)
    while moves < _MOVES_PER_METER * m.size:
        steps = _best(_Place(now, judged, limits, barred, innocent, pairs, powers, many))
        if not steps:
            break
        moves, changed = moves + 1, now.changes
        for step in steps:
            move = step()
            anew = move is None
            judged = judge(now, m) if move is None else follow(now, m, judged, move)
        moves += now.changes - changed - 1 if anew else 0
    if not fresh and now.changes == start.changes:
        now = start  # with its cached values
    else:
        now.shrink()
    if now.changes > before and not anew:
        judged = judge(now, m)  # without accumulated rounding
    dropped = int(np.count_nonzero(live & ~now.trusted))
    loosened = () if powers is None else powers.loosened
    size = int(np.count_nonzero(live))
    charge = 0.0
    if dictionary is not None and loosened:
        charges = dictionary.charges(np.array(loosened, dtype=np.intp), now.trusted, dropped)
        charge = float(charges.sum()) * price(size, 1)
    cost = judged.misfit + price(size, dropped, limits.most) + charge
    return Solution(now.trusted, loosened, charge, cost, now, judged)


@cache
def price(meters: int, liars: int, most: int | None = None) -> float:
    """Cost of k accusations among p meters: `2 ln binom(p, k)`, always rising, steeply beyond `most`."""
    k = np.arange(liars)
    least = np.where(k < (meters if most is None else most), _LEAST, _BEYOND)
    return float(np.sum(np.maximum(2.0 * np.log((meters - k) / (k + 1.0)), least)))


_LEAST, _BEYOND = 1.0, 9.0
"""Least cost of an accusation beyond half of the meters, and of one beyond the largest number told apart."""


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Position of a descent."""

    fit: Fit
    judged: Judged
    limits: Limits
    barred: Bools
    innocent: Ints
    pairs: bool
    powers: Powers | None
    many: bool


def _best(here: _Place) -> Sequence[Callable[[], Move | None]]:
    """Steps of the next move; none if none helps. A step that is not a rank-one update returns None."""
    now, judged, powers = here.fit, here.judged, here.powers
    excess = np.abs(judged.offset) / here.limits.of(judged.std)
    inside = np.where(now.trusted, excess, -np.inf)
    inside[here.innocent] = -np.inf
    worst = int(inside.argmax())
    drops = bool(inside[worst] > 1.0)
    if drops and here.many and np.count_nonzero(inside > 1.0) >= _MANY:
        return [partial(_drop_many, here, worst)]
    steps: list[Step] = [partial(_drop, now, worst, powers)] if drops else []
    if here.pairs or powers is not None:
        gain = (judged.offset[worst] / judged.std[worst]) ** 2 - here.limits.penalty if drops else 0.0
        gain = max(float(gain), 0.0)
        if here.pairs:
            pair, gain = _pair(here, gain)
            steps = [partial(_drop, now, j, powers) for j in pair] or steps
        if powers is not None:
            steps = powers.best(judged, here.limits.penalty, gain) or steps
    if steps:
        return steps
    outside = np.where(now.trusted | here.barred, np.inf, excess)
    nearest = int(outside.argmin())
    if not outside[nearest] < 1.0:
        return []
    if here.many:
        at = indices(outside < np.inf)
        if np.count_nonzero(outside < 1.0) >= max(_MANY, at.size / _ASKED):
            return [partial(_admit_many, here, at, nearest)]
    return [lambda: _moved(admit(now, nearest), powers)]


_MANY, _ASKED, _AT_ONCE = 6, 8, 64
"""Block moves: least candidates, least share of the examined meters (1 / `_ASKED`), and largest block."""


def _admit_many(here: _Place, at: Ints, first: int) -> Move | None:
    """Add meters one after the other while the nearest is within its limit and no trusted one is beyond.

    Only the covariance of the excluded meters is followed. The trusted ones are tested for all moves at once,
    and the moves after the first violation are taken back. Where rounding leaves no move, `first` alone is
    added.
    """
    now, judged = here.fit, here.judged
    outside = Outside.of(now, at)
    order = _nearest(outside.apart, judged.offset[at], here.limits.some(at))
    if not order.size:
        return admit(now, first)
    factor = outside.factor(order)
    changes = outside.changes(order, factor)
    error, _ = lapack.dtrtrs(factor, judged.offset[at[order]], lower=True)
    pivot = now.diagonal() + np.cumsum(changes * changes, axis=0)[:-1]
    weights = judged.weights + np.cumsum(changes * error[:, None], axis=0)[:-1]
    inside = pivot > 0.0
    pivot = np.where(inside, pivot, 1.0)
    # Not kept: it is used once.
    limit = replace(here.limits, recent=None).of(np.sqrt(1.0 / pivot))
    beyond = inside & (np.abs(weights) > pivot * limit)
    beyond[:, here.innocent] = False
    wrong = indices(beyond.any(axis=1))
    outside.admit(order[: wrong[0] + 1] if wrong.size else order, factor, changes)
    return None


def _nearest(apart: Floats, offset: Floats, limits: Limits) -> Ints:
    """Order in which excluded meters are added, the closest first, places, (r,); `apart`: (k, k)."""
    order: list[int] = []
    open_, done = apart.diagonal().copy(), np.zeros(offset.size)
    # Rows of the Cholesky factor so far.
    rows = np.empty((min(offset.size, _AT_ONCE), offset.size))
    for k in range(len(rows)):
        excess = np.abs(offset) / limits.of(np.sqrt(open_)) + done
        j = int(excess.argmin())
        row = apart[j] - rows[:k, j] @ rows[:k] if k else apart[j]
        if not (excess[j] < 1.0 and row[j] > 0.0):
            break
        order.append(j)
        std = float(row[j]) ** 0.5
        rows[k] = row = row / std
        offset = offset - row * (offset[j] / std)
        open_ -= row * row
        open_[j], done[j] = 1.0, np.inf
    return np.array(order, dtype=np.intp)


def _drop_many(here: _Place, first: int) -> Move | None:
    """Remove meters one after the other while the worst is beyond its limit; only precision is followed.

    Where rounding leaves no move, `first` alone is removed.
    """
    now, (at, Q) = here.fit, here.fit.trusting()
    limits, weights = here.limits.some(at), here.judged.weights[at]
    pivot, kept = Q.diagonal().copy(), np.where(np.isin(at, here.innocent), np.inf, 0.0)
    rows = np.empty((min(at.size, _AT_ONCE), at.size))
    fallen = np.zeros_like(now.trusted)
    for k in range(len(rows)):
        excess = np.abs(weights / pivot) / limits.of(np.sqrt(1.0 / pivot)) - kept
        j = int(excess.argmax())
        row = Q[j] - rows[:k, j] @ rows[:k]
        if not (excess[j] > 1.0 and row[j] > 0.0):
            break
        fallen[at[j]] = True
        root = float(row[j]) ** 0.5
        rows[k] = row = row / root
        weights = weights - row * (weights[j] / root)
        pivot -= row * row
        pivot[j], kept[j] = 1.0, np.inf
    if not fallen.any():
        return drop(now, first)
    after = without(now, fallen)
    now.inverse, now.variance, now.changes = after.inverse, after.variance, after.changes
    now.trusted[fallen] = False
    now.pivot = now.std = now.together = now.left = None
    return None


_PAIRED = 256
"""Meters among which pairs are searched, those of the largest single gains."""


def _pair(here: _Place, than: float) -> tuple[tuple[int, ...], float]:
    """Two meters to be removed together and their gain; none unless the gain is above `than`.

    With b = Q m and G = Q of the two the gain is ``b^T G^-1 b``; their residuals without both are ``G^-1 b``.
    """
    now, weights = here.fit, here.judged.weights
    free = now.trusted.copy()
    free[here.innocent] = False
    at = indices(free)
    if at.size > _PAIRED:
        at = np.sort(at[np.argsort(-(weights[at] ** 2) / now.Q[at, at])[:_PAIRED]])
    if at.size < 2:
        return (), than
    Q, b = submatrix(now.Q, at, at), weights[at]
    d = Q.diagonal()
    determinant = np.multiply.outer(d, d) - Q * Q
    np.fill_diagonal(determinant, np.inf)
    squares = np.multiply.outer(b * b, d)
    gain = (squares + squares.T - 2.0 * np.multiply.outer(b, b) * Q) / determinant
    first, second = divmod(int(np.argmax(gain)), at.size)
    net = float(gain[first, second]) - 2.0 * here.limits.penalty
    if not net > than:
        return (), than
    pick = np.array([first, second])
    left_open, std = np.linalg.inv(Q[np.ix_(pick, pick)]), np.zeros(weights.size)
    std[at[pick]] = np.sqrt(left_open.diagonal())
    if not (np.abs(left_open @ b[pick]) > here.limits.of(std)[at[pick]]).all():
        return (), than
    return tuple(at[pick].tolist()), net


def _drop(now: Fit, j: int, powers: Powers | None) -> Move:
    return _moved(drop(now, j), powers)


def _moved(move: Move, powers: Powers | None) -> Move:
    return move if powers is None else powers.follow(move)
