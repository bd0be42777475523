"""Which meters lie: the likeliest set, without swamping honest meters or masking liars.

An explanation drops some meters and loosens some directions (a customer's powers, an inverter). Its cost is

    J = m_T^T Q m_T + 2 ln binom(p, k) + what the loosened directions are charged

which is, up to a constant, minus twice the logarithm of its posterior probability when every number k of
liars is as likely as any other, and every set of k as any other of k. Many accusations at once are thus
cheaper, each, than a single one: where a third of the meters lies, the next liar is no surprise.

Dropping trusted meter j lowers the misfit by ``offset_j^2 / std_j^2`` exactly, loosening direction a by
``(a^T Q m)^2 / (1 / std_a^2 + a^T Q a)``; admitting a meter raises it likewise. So steepest descent needs no
refitting. It drops and admits where an offset is beyond, or back within, what chance explains.

Descent alone swamps when many lie in the same way: their neighbours look wrong. So there are two starts:
the set that was trusted before, and a robust one (`gridsec.estimators.sequential.robust`). The cheaper
explanation wins.

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
    """The last answer of `Limits.of`: in calm the same is asked at every tick."""

    __slots__ = ("answer",)

    def __init__(self) -> None:
        self.answer: tuple[float, Floats, Floats] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """What is evidence. p meters.

    Attributes
    ----------
    sigmas
        Standard deviations beyond which an offset is none of chance.
    model : (p,)
        What the model's own error may add, squared pu.
    allowed : (p,)
        Offsets that are honest whatever their probability, the accuracy class, squared pu.
    certain : (p,)
        Variance within the meters' noise that `allowed` stands for.
    most
        How many liars can be told apart; None: however many.
    late : (p,)
        Variance of offsets beside that by which they are judged, squared pu^2; None for none.
    recent
        The last answer where `allowed`, `certain` and `late` were these very ones; None where none is kept.
    """

    sigmas: float
    model: Floats
    allowed: Floats
    certain: Floats
    most: int | None = None
    late: Floats | None = None
    recent: Recent | None = None

    @property
    def penalty(self) -> float:
        """What dropping a meter must gain at least."""
        return self.sigmas**2

    def of(self, std: Floats, part: float = 1.0) -> Floats:
        """Largest honest offset: by chance alone, or by the class and chance for the rest; the smaller.

        Parameters
        ----------
        std : (p,)
            Standard deviation of each offset.
        part
            Of `sigmas`, how many count.
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
        """The same of some meters.

        Parameters
        ----------
        at : (k,)
            Which.
        """
        late = None if self.late is None else self.late[at]
        return Limits(self.sigmas, self.model[at], self.allowed[at], self.certain[at], self.most, late)


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """What a search came to. p meters.

    Attributes
    ----------
    trusted : (p,)
        The meters that it does not accuse.
    loosened
        What else it accuses, indices into the dictionary.
    charge
        What that costs.
    cost
        J.
    """

    trusted: Bools
    loosened: tuple[int, ...]
    charge: float
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Solution(Explanation):
    """An explanation with all that follows from it.

    Attributes
    ----------
    fit
        The trusted meters.
    judged
        Every meter, judged by them.
    """

    fit: Fit
    judged: Judged

    def bare(self) -> Explanation:
        """The explanation alone: fits are large."""
        return Explanation(self.trusted, self.loosened, self.charge, self.cost)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What several searches came to.

    Attributes
    ----------
    best
        The likeliest.
    others
        The rest, in no order.
    """

    best: Solution
    others: tuple[Explanation, ...] = ()


def likelier(one: Found | None, other: Found) -> Found:
    """Both together.

    Parameters
    ----------
    one, other
        The first one's best is kept where both are equally likely.
    """
    if one is None:
        return other
    first, second = (other, one) if other.best.cost < one.best.cost else (one, other)
    return Found(first.best, (*first.others, second.best.bare(), *second.others))


# No meters.
NOBODY = frozen_ints(np.zeros(0, dtype=np.intp))
_MOVES_PER_METER = 4


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
    """Drop, admit and loosen until no move makes the explanation better.

    Parameters
    ----------
    start
        Where to begin; not changed unless `fresh`, and the fit of the solution where it needs no change.
    m : (p,)
        Readings minus what the model explains, squared pu.
    live : (p,)
        Which meters have a reading.
    limits
        What is evidence.
    keep : (p,)
        Meters that must not be admitted.
    dictionary
        Directions that may be loosened; none by default.
    innocent : (k,)
        Meters that must be believed.
    pairs
        Whether two meters may be dropped at once. Two that tell the same story vouch for each other, so that
        dropping either of them gains little; O(p^2) per move.
    fresh
        `start` is of no further use.
    judged
        Every meter judged by `start`, where that is known.
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
        now = start  # and what is kept with it
    else:
        now.shrink()
    if now.changes > before and not anew:
        judged = judge(now, m)  # without what rounding has left
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
    """What accusing so many of so many meters costs: `2 ln binom(meters, liars)`, but always rising.

    Parameters
    ----------
    meters, liars
        p and k.
    most
        How many lie at most, if that is supposed: whoever else is accused costs far more.
    """
    k = np.arange(liars)
    least = np.where(k < (meters if most is None else most), _LEAST, _BEYOND)
    return float(np.sum(np.maximum(2.0 * np.log((meters - k) / (k + 1.0)), least)))


# Beyond half of the meters, each further accusation still costs this; beyond those that lie at most, this.
_LEAST, _BEYOND = 1.0, 9.0


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Where a descent stands."""

    fit: Fit
    judged: Judged
    limits: Limits
    barred: Bools
    innocent: Ints
    pairs: bool
    powers: Powers | None
    many: bool


def _best(here: _Place) -> Sequence[Callable[[], Move | None]]:
    """The next move in steps; none where none helps. A step that is no single change returns None."""
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


# From so many on that might be admitted, or dropped, it is faster to follow them beside each other, unless so
# many times more are asked; and at most so many at once, or there would be large matrices of large feeders.
_MANY, _ASKED, _AT_ONCE = 6, 8, 64


def _admit_many(here: _Place, at: Ints, first: int) -> Move | None:
    """Admit one after the other as long as the nearest is close enough and nobody is to be dropped.

    What is open of those outside is followed alone; whether anybody inside would have had to be dropped is
    then asked for all moves at once, and the moves from there on are taken back. `first` alone is admitted
    where rounding has it that nobody is.
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
    # Not to be remembered: it is asked for once.
    limit = replace(here.limits, recent=None).of(np.sqrt(1.0 / pivot))
    beyond = inside & (np.abs(weights) > pivot * limit)
    beyond[:, here.innocent] = False
    wrong = indices(beyond.any(axis=1))
    outside.admit(order[: wrong[0] + 1] if wrong.size else order, factor, changes)
    return None


def _nearest(apart: Floats, offset: Floats, limits: Limits) -> Ints:
    """The order in which meters outside are admitted, each time the one that is closest, places, (r,).

    `apart` (k, k): what the trusted leave open of their readings.
    """
    order: list[int] = []
    open_, done = apart.diagonal().copy(), np.zeros(offset.size)
    # Rows of the Cholesky factor, as far as it is known.
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
    """Drop one after the other as long as the worst is beyond chance; only what they leave is followed.

    `first` alone where rounding has it that nobody is.
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


# Pairs are looked for among so many meters, those that dropping alone gains most for.
_PAIRED = 256


def _pair(here: _Place, than: float) -> tuple[tuple[int, ...], float]:
    """Two meters that it pays to drop together, and what that gains; none unless more than `than`.

    With b = Q m and G = Q of the two, ``b^T G^-1 b``; their offsets judged by all others are ``G^-1 b``.
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
