"""Search for the likeliest set of manipulated meters and faults, without swamping honest or masking others.

A fault is a direction of the voltages: a wrong power or inverter. An unknown amplitude of direction a with
standard deviation s lowers the chi-square ``m^T Q m`` by

    (a^T Q m)^2 / (1 / s^2 + a^T Q a),

removing meter j as well by ``g^T G^-1 g`` with g and G the weights and the precision of both. A manipulated
voltage may come with false powers of the same customer, so the pair is one move.

A hypothesis removes some meters and accuses some directions of the fault dictionary. Its cost is

    J = m_T^T Q m_T + 2 ln binom(p, k) + charges of the directions,

up to a constant minus twice the logarithm of its posterior probability, if every number k of manipulated
meters is equally likely, and every set of k among those of k. Each of many accusations is thus cheaper than a
single one.

Removing trusted meter j lowers the chi-square by ``residual_j^2 / std_j^2``; adding a meter raises it
likewise. Steepest descent therefore needs no refitting. It removes and adds meters with residuals beyond, or
back within, the limits.

Descent alone swamps where many meters are off alike: their neighbours look wrong. It therefore starts from
the set trusted before and from a robust one; the cheaper hypothesis wins. With the readings m, their
variances d and the prior covariance S, the robust start is

    minimise   w^T S^-1 w + sum_j min((m_j - w_j)^2, bound_j^2) / d_j

by graduated non-convexity, from a convex cost to the truncated one. Every round conditions with the variance
d_j / weight_j of meter j; its residual ``r = m - w_hat`` is ``D W^-1 (S + D W^-1)^-1 m`` for positive
weights. With the precision Q of all meters and a = Q m, only the meters K of weights below one are solved:

    r = D (a - Q_:K z) + E_K z,   z = (diag(weight / (d (1 - weight)))_K + Q_KK)^-1 a_K,

which holds for a weight of zero as well, where r_j is z_j alone.

A decoder replaces the search: same feeder, inverters and limits. It gets the mean residuals of one tick with
their covariance, and returns accused meters.

References
----------
Chen and Chen 2008 (the prior over sets); Yang, Antonante, Tzoumas and Carlone 2020 (graduated non-convexity,
truncated least squares); Woodbury's identity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, frozen_ints, indices, submatrix
from gridsec.estimators.sequential.posterior import (
    ExcludedMeters,
    LeaveOneOut,
    Posterior,
    Prior,
    RankOneUpdate,
    add_meter,
    add_unknown,
    leave_one_out,
    remove_meter,
    remove_meters,
    solve_spd,
    updated,
    well_conditioned,
)

# --- Directions of possible faults ---


_SUSPECT_CHARGE, _FEW_SUSPECTS, _LEAST_CHARGE = 2.0, 3, 0.5
"""Charge of a suspect's false power: up to `_FEW_SUSPECTS` suspects, and least, in accusations."""


def false_power_charge(suspects: int) -> float:
    """Charge for the false power of a suspect meter's customer, in accusations of a meter.

    The charge is 2 up to three suspects, then inversely proportional to their number, at least 0.5. Among
    many suspects a high charge would accuse honest neighbours instead.
    """
    return max(_SUSPECT_CHARGE * min(1.0, _FEW_SUSPECTS / max(suspects, 1)), _LEAST_CHARGE)


@dataclass(frozen=True, slots=True, eq=False)
class FaultDictionary:
    """Directions of possible faults. n buses, p meters, k directions."""

    std: Floats  # (k,) standard deviation of each amplitude, pu
    charge: Floats  # (k,) cost of accusing it, in accusations of a meter
    size: Floats  # (k,) sum over the meters of its squared changes
    meter: Ints  # (k,) meter of its customer, charged at most `false_power_charge` as a suspect; -1 for none
    columns: Callable[[Ints], Floats]  # `columns(which)`: changes of every squared voltage per unit, (n, …)
    weighted: Callable[[Floats], Floats]  # `along(weights)`: weighted sum of its changes at the meters, (k,)

    def charges(self, which: Ints, trusted: Bools, suspects: int) -> Floats:
        """Cost of accusing directions (c,), in accusations of a meter; suspects: number of suspect meters."""
        charge, own = self.charge[which], self.beside_suspect(which, trusted)
        return np.where(own, np.minimum(charge, false_power_charge(suspects)), charge)

    def beside_suspect(self, which: Ints, trusted: Bools) -> Bools:
        """Directions (c,) that are the power of a customer with a suspect meter, (c,)."""
        return np.asarray((self.meter[which] >= 0) & ~trusted[self.meter[which]])

    def reduced(self) -> FaultDictionary:
        """Fault dictionary with reduced charges, for searching alternative explanations."""
        return replace(self, charge=np.minimum(self.charge, _SUSPECT_CHARGE))


_CANDIDATES = 64
"""Directions that a search tries, those of the largest gradient."""


_LEAST_SIZE = 1e-6


Move = Callable[[], RankOneUpdate]
"""Changes a posterior when called."""


class FaultGains:
    """Gains of the directions during a search: Q A follows Q by rank one, diag(A^T Q A) by squares.

    The moves of the search change the posterior `now`. weights: (p,) Q m. available: (p,) meters with a
    reading. protected: (k,) meters that stay trusted.
    """

    def __init__(
        self, now: Posterior, dictionary: FaultDictionary, weights: Floats, available: Bools, protected: Ints
    ) -> None:
        towards = dictionary.weighted(weights) ** 2 / np.maximum(dictionary.size, _LEAST_SIZE)
        self.faults, self.now, self.available = dictionary, now, available
        self.index = (-towards).argsort()[:_CANDIDATES]
        self.columns = dictionary.columns(self.index)
        self.at_meters = self.columns[now.prior.meters]
        self.std, self.meter = dictionary.std[self.index], dictionary.meter[self.index]
        at, Q = now.precision()
        at_meters = self.at_meters[at]
        self.spread = np.zeros_like(self.at_meters)
        self.spread[at] = spread = Q @ at_meters
        self.form = np.einsum("ij,ij->j", spread, at_meters)
        self.protected = np.isin(self.meter, protected) if protected.size else None
        self.accused: list[int] = []

    @property
    def accused_faults(self) -> tuple[int, ...]:
        """Accused directions, indices of the dictionary."""
        return tuple(self.index[self.accused].tolist())

    def best_move(self, loo: LeaveOneOut, penalty: float, than: float) -> list[Move]:
        """Steps of the best direction, alone or with its meter removed, if it gains more than `than`.

        penalty: least gain of an accusation.
        """
        trusted = self.now.trusted
        suspects = int(np.count_nonzero(self.available & ~trusted))
        alone = self._gains(loo.weights) - penalty * self.faults.charges(self.index, trusted, suspects)
        both = self._gains_with_meter(loo.weights) - penalty * (1.0 + false_power_charge(suspects))
        if self.protected is not None:
            both[self.protected] = -np.inf
        alone[self.accused] = both[self.accused] = -np.inf
        k, pair = int(alone.argmax()), int(both.argmax())
        if max(alone[k], both[pair]) <= than:
            return []
        if alone[k] >= both[pair]:
            return [lambda: self._accuse(k)]
        return [
            lambda: self._accuse(pair),
            lambda: self.update(remove_meter(self.now, int(self.meter[pair]))),
        ]

    def update(self, update: RankOneUpdate) -> RankOneUpdate:
        """Update the gains after a change of the posterior."""
        along = update.q @ self.at_meters
        self.spread += np.multiply.outer(update.factor * update.q, along)
        self.form += update.factor * along**2
        return update

    def _gains(self, weights: Floats) -> Floats:
        """Fall of the chi-square by each direction, (k,)."""
        return np.asarray((weights @ self.at_meters) ** 2 / (self.std**-2.0 + self.form))

    def _gains_with_meter(self, weights: Floats) -> Floats:
        """The same with its meter removed, (k,); -inf without a trusted meter."""
        at = self.meter
        a, b = self.std**-2.0 + self.form, self.now.diagonal()[at]
        c = self.spread[at, np.arange(at.size)]
        u, v = weights @ self.at_meters, weights[at]
        free = (at >= 0) & self.now.trusted[at]
        determinant = np.where(free, a * b - c * c, 1.0)
        return np.where(free, (b * u * u - 2.0 * c * u * v + a * v * v) / determinant, -np.inf)

    def _accuse(self, k: int) -> RankOneUpdate:
        self.accused.append(k)
        return self.update(add_unknown(self.now, self.columns[:, k], float(self.std[k])))


# --- Descent ---


class LimitCache:
    """Last result of `Limits.limit`, which repeats while no meter is suspect."""

    __slots__ = ("last",)

    def __init__(self) -> None:
        self.last: tuple[float, Floats, Floats] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Rule of the limits of honest residuals. p meters."""

    sigmas: float  # standard deviations within chance
    model: Floats  # (p,) largest error of the model, squared pu
    allowed: Floats  # (p,) honest offset of any probability, the accuracy class, squared pu
    replaced: Floats  # (p,) variance within the meters' noise that `allowed` replaces
    max_attacked: int | None = None  # largest number of manipulated meters told apart; None for no limit
    added: Floats | None = None  # (p,) additional variance of the residuals, squared pu^2; None for none
    cache: LimitCache | None = None  # last result for these `allowed`, `certain` and `late`

    @property
    def penalty(self) -> float:
        """Least gain of removing a meter."""
        return self.sigmas**2

    def limit(self, std: Floats, part: float = 1.0) -> Floats:
        """Largest honest residual for its standard deviation (p,): by chance, or by class and chance.

        part: used part of `sigmas`.
        """
        sigmas, recent = part * self.sigmas, self.cache
        last = None if recent is None else recent.last
        if last is None or last[0] != sigmas or last[1] is not std:
            last = sigmas, std, self._within(std, sigmas)
            if recent is not None and part == 1.0:
                recent.last = last
        return np.asarray(self.model + last[2])

    def _within(self, std: Floats, sigmas: float) -> Floats:
        if self.added is not None:
            std = np.sqrt(std * std + self.added)
        rest = np.sqrt(np.maximum(std * std - self.replaced, 0.0))
        return np.asarray(np.minimum(sigmas * std, self.allowed + sigmas * rest))

    def subset(self, at: Ints) -> Limits:
        """The same for meters `at` (k,)."""
        late = None if self.added is None else self.added[at]
        return Limits(
            self.sigmas, self.model[at], self.allowed[at], self.replaced[at], self.max_attacked, late
        )


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Hypothesis of a search. p meters."""

    trusted: Bools  # (p,) meters that it does not accuse
    faults: tuple[int, ...]  # accused directions, indices of the fault dictionary
    charge: float  # cost of these
    cost: float  # J


@dataclass(frozen=True, slots=True, eq=False)
class Candidate(Hypothesis):
    """Hypothesis with its posterior."""

    posterior: Posterior  # posterior of the trusted meters
    loo: LeaveOneOut  # leave-one-out residuals

    def hypothesis(self) -> Hypothesis:
        """The hypothesis without its posterior, which is large."""
        return Hypothesis(self.trusted, self.faults, self.charge, self.cost)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Results of several searches."""

    best: Candidate  # the likeliest
    others: tuple[Hypothesis, ...] = ()  # the rest, in no order


def merged(one: Candidates | None, other: Candidates) -> Candidates:
    """Union of the results; the first best one stays where both are equally likely."""
    if one is None:
        return other
    first, second = (other, one) if other.best.cost < one.best.cost else (one, other)
    return Candidates(first.best, (*first.others, second.best.hypothesis(), *second.others))


NO_METERS = frozen_ints(np.zeros(0, dtype=np.intp))


_MOVES_PER_METER = 4
"""Largest number of moves of a descent per meter."""


def descend(
    start: Posterior,
    m: Floats,
    available: Bools,
    limits: Limits,
    *,
    keep: Bools,
    faults: FaultDictionary | None = None,
    protected: Ints = NO_METERS,
    pairs: bool = False,
    fresh: bool = False,
    loo: LeaveOneOut | None = None,
) -> Candidate:
    """Remove, add and accuse until no move lowers the cost.

    start: changed in place only if `fresh`; the posterior of the result where no move helps. available: (p,)
    meters with a reading. keep: (p,) meters that are not added. protected: (k,) meters that stay trusted.
    loo: the residuals of `start` if known. pairs: remove two meters at once as well, O(p^2) per move; two
    meters of equal error support each other, and removing either gains little.
    """
    now, changed = start if fresh else start.copy(), start.updates
    barred = ~available | keep
    for j in protected[~now.trusted[protected]].tolist():
        add_meter(now, j)
    for j in indices(now.trusted & ~available):
        remove_meter(now, int(j))
    if loo is None or now.updates != changed:
        loo = leave_one_out(now, m)
    before, moves, anew = now.updates, 0, True
    many = faults is None and not pairs and well_conditioned(now.prior, now.noise)
    gains = None if faults is None else FaultGains(now, faults, loo.weights, available, protected)
    while moves < _MOVES_PER_METER * m.size:
        steps = _next_move(_Descent(now, loo, limits, barred, protected, pairs, gains, many))
        if not steps:
            break
        moves, changed = moves + 1, now.updates
        for step in steps:
            update = step()
            anew = update is None
            loo = leave_one_out(now, m) if update is None else updated(now, m, loo, update)
        moves += now.updates - changed - 1 if anew else 0
    if not fresh and now.updates == start.updates:
        now = start  # with its cached values
    else:
        now.compact()
    if now.updates > before and not anew:
        loo = leave_one_out(now, m)  # without accumulated rounding
    dropped = int(np.count_nonzero(available & ~now.trusted))
    accused_faults = () if gains is None else gains.accused_faults
    size = int(np.count_nonzero(available))
    charge = 0.0
    if faults is not None and accused_faults:
        charges = faults.charges(np.array(accused_faults, dtype=np.intp), now.trusted, dropped)
        charge = float(charges.sum()) * set_cost(size, 1)
    cost = loo.chi_square + set_cost(size, dropped, limits.max_attacked) + charge
    return Candidate(now.trusted, accused_faults, charge, cost, now, loo)


@cache
def set_cost(meters: int, suspects: int, most: int | None = None) -> float:
    """Cost of k accusations among p meters: `2 ln binom(p, k)`, always rising, steeply beyond `most`."""
    k = np.arange(suspects)
    least = np.where(k < (meters if most is None else most), _LEAST_COST, _EXCESS_COST)
    return float(np.sum(np.maximum(2.0 * np.log((meters - k) / (k + 1.0)), least)))


_LEAST_COST, _EXCESS_COST = 1.0, 9.0
"""Least cost of an accusation beyond half of the meters, and of one beyond the largest number told apart."""


@dataclass(frozen=True, slots=True, eq=False)
class _Descent:
    """Position of a descent."""

    posterior: Posterior
    loo: LeaveOneOut
    limits: Limits
    barred: Bools
    protected: Ints
    pairs: bool
    gains: FaultGains | None
    blocks: bool


def _next_move(here: _Descent) -> Sequence[Callable[[], RankOneUpdate | None]]:
    """Steps of the next move; none if none helps. A step that is not a rank-one update returns None."""
    now, loo, gains = here.posterior, here.loo, here.gains
    excess = np.abs(loo.residual) / here.limits.limit(loo.std)
    inside = np.where(now.trusted, excess, -np.inf)
    inside[here.protected] = -np.inf
    worst = int(inside.argmax())
    drops = bool(inside[worst] > 1.0)
    if drops and here.blocks and np.count_nonzero(inside > 1.0) >= _MANY:
        return [partial(_remove_block, here, worst)]
    steps: list[Move] = [partial(_remove, now, worst, gains)] if drops else []
    if here.pairs or gains is not None:
        gain = (loo.residual[worst] / loo.std[worst]) ** 2 - here.limits.penalty if drops else 0.0
        gain = max(float(gain), 0.0)
        if here.pairs:
            pair, gain = _best_pair(here, gain)
            steps = [partial(_remove, now, j, gains) for j in pair] or steps
        if gains is not None:
            steps = gains.best_move(loo, here.limits.penalty, gain) or steps
    if steps:
        return steps
    outside = np.where(now.trusted | here.barred, np.inf, excess)
    nearest = int(outside.argmin())
    if not outside[nearest] < 1.0:
        return []
    if here.blocks:
        at = indices(outside < np.inf)
        if np.count_nonzero(outside < 1.0) >= max(_MANY, at.size / _EXAMINED):
            return [partial(_add_block, here, at, nearest)]
    return [lambda: _noted(add_meter(now, nearest), gains)]


_MANY, _EXAMINED, _AT_ONCE = 6, 8, 64
"""Block moves: least candidates, least share of the examined meters (1 / `_EXAMINED`), and largest block."""


def _add_block(here: _Descent, at: Ints, first: int) -> RankOneUpdate | None:
    """Add meters one after the other while the nearest is within its limit and no trusted one is beyond.

    Only the covariance of the excluded meters is followed. The trusted ones are tested for all moves at once,
    and the moves after the first violation are taken back. Where rounding leaves no move, `first` alone is
    added.
    """
    now, loo = here.posterior, here.loo
    outside = ExcludedMeters.of(now, at)
    order = _addition_order(outside.apart, loo.residual[at], here.limits.subset(at))
    if not order.size:
        return add_meter(now, first)
    factor = outside.factor(order)
    changes = outside.changes(order, factor)
    error, _ = lapack.dtrtrs(factor, loo.residual[at[order]], lower=True)
    pivot = now.diagonal() + np.cumsum(changes * changes, axis=0)[:-1]
    weights = loo.weights + np.cumsum(changes * error[:, None], axis=0)[:-1]
    inside = pivot > 0.0
    pivot = np.where(inside, pivot, 1.0)
    # Not kept: it is used once.
    limit = replace(here.limits, cache=None).limit(np.sqrt(1.0 / pivot))
    beyond = inside & (np.abs(weights) > pivot * limit)
    beyond[:, here.protected] = False
    wrong = indices(beyond.any(axis=1))
    outside.add(order[: wrong[0] + 1] if wrong.size else order, factor, changes)
    return None


def _addition_order(apart: Floats, offset: Floats, limits: Limits) -> Ints:
    """Order in which excluded meters are added, the closest first, places, (r,); `apart`: (k, k)."""
    order: list[int] = []
    open_, done = apart.diagonal().copy(), np.zeros(offset.size)
    # Rows of the Cholesky factor so far.
    rows = np.empty((min(offset.size, _AT_ONCE), offset.size))
    for k in range(len(rows)):
        excess = np.abs(offset) / limits.limit(np.sqrt(open_)) + done
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


def _remove_block(here: _Descent, first: int) -> RankOneUpdate | None:
    """Remove meters one after the other while the worst is beyond its limit; only precision is followed.

    Where rounding leaves no move, `first` alone is removed.
    """
    now, (at, Q) = here.posterior, here.posterior.precision()
    limits, weights = here.limits.subset(at), here.loo.weights[at]
    pivot, kept = Q.diagonal().copy(), np.where(np.isin(at, here.protected), np.inf, 0.0)
    rows = np.empty((min(at.size, _AT_ONCE), at.size))
    removed = np.zeros_like(now.trusted)
    for k in range(len(rows)):
        excess = np.abs(weights / pivot) / limits.limit(np.sqrt(1.0 / pivot)) - kept
        j = int(excess.argmax())
        row = Q[j] - rows[:k, j] @ rows[:k]
        if not (excess[j] > 1.0 and row[j] > 0.0):
            break
        removed[at[j]] = True
        root = float(row[j]) ** 0.5
        rows[k] = row = row / root
        weights = weights - row * (weights[j] / root)
        pivot -= row * row
        pivot[j], kept[j] = 1.0, np.inf
    if not removed.any():
        return remove_meter(now, first)
    after = remove_meters(now, removed)
    now.inverse, now.variance, now.updates = after.inverse, after.variance, after.updates
    now.trusted[removed] = False
    now.pivot = now.std = now.busbar_weights = now.variance_sum = now.score_rows = None
    return None


_PAIR_METERS = 256
"""Meters among which pairs are searched, those of the largest single gains."""


def _best_pair(here: _Descent, than: float) -> tuple[tuple[int, ...], float]:
    """Two meters to be removed together and their gain; none unless the gain is above `than`.

    With b = Q m and G = Q of the two the gain is ``b^T G^-1 b``; their residuals without both are ``G^-1 b``.
    """
    now, weights = here.posterior, here.loo.weights
    free = now.trusted.copy()
    free[here.protected] = False
    at = indices(free)
    if at.size > _PAIR_METERS:
        at = np.sort(at[np.argsort(-(weights[at] ** 2) / now.Q[at, at])[:_PAIR_METERS]])
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
    if not (np.abs(left_open @ b[pick]) > here.limits.limit(std)[at[pick]]).all():
        return (), than
    return tuple(at[pick].tolist()), net


def _remove(now: Posterior, j: int, gains: FaultGains | None) -> RankOneUpdate:
    return _noted(remove_meter(now, j), gains)


def _noted(update: RankOneUpdate, gains: FaultGains | None) -> RankOneUpdate:
    return update if gains is None else gains.update(update)


# --- Robust start ---


_HARDENING = 2.5
"""Factor on the hardness of the cost from round to round."""


_ROBUST_ROUNDS = 30
"""Largest number of rounds."""


_LEAST_WEIGHT = 1e-6
"""Weights up to this count as zero, well above the rounding of Cholesky."""


_TINY = float(np.finfo(np.float64).tiny)


def robust_set(  # noqa: PLR0917
    prior: Prior, noise: Floats, m: Floats, available: Bools, bound: Floats, whole: Posterior | None = None
) -> Bools:
    """Trusted meters of a robust fit, (p,); O(p^3).

    available: (p,) meters with a reading. bound: (p,) largest honest difference between reading and truth,
    squared pu. whole: a posterior that `covers` these meters, if there is one; the cube is then that of the
    number of meters with weights below one.
    """
    at = indices(available)
    trusted = np.zeros(m.size, dtype=np.bool_)
    if not at.size:
        return trusted
    limit = bound[at] ** 2
    left: Callable[[Floats], Floats]
    left = (
        partial(_weighted_residual, prior.among(at), noise[at], m[at])
        if whole is None
        else _residual_by_posterior(whole, m, at)
    )
    rest = left(np.ones(at.size))
    largest = float((rest * rest / limit).max())
    if largest <= 1.0:
        trusted[at] = True
        return trusted
    hardness = 1.0 / (2.0 * largest - 1.0)
    for _ in range(_ROBUST_ROUNDS):
        ratio = np.maximum(rest * rest / limit, _TINY)
        soft = np.sqrt(hardness * (hardness + 1.0) / ratio) - hardness
        weight = np.minimum(np.maximum(soft, 0.0), 1.0)
        rest = left(weight)
        if all_of((weight == 0.0) | (weight == 1.0)):
            break
        hardness *= _HARDENING
    trusted[at] = rest * rest <= limit
    return trusted


def covers(whole: Posterior, prior: Prior, noise: Floats, available: Bools) -> bool:
    """True if a posterior gives the residuals of meters `available` (p,) for all weights."""
    # A start must not depend on the rounding of earlier rank-one updates.
    fresh = not whole.updates and not whole.unknowns.shape[1]
    same = fresh and whole.prior is prior and np.array_equal(whole.noise, noise)
    return same and not any_of(available & ~whole.trusted)


def _weighted_residual(signal: Floats, noise: Floats, y: Floats, weight: Floats) -> Floats:
    """``y - w_hat`` of meters with covariance `signal`, their noise, and weights in the fit from 0 to 1."""
    use = indices(weight > _LEAST_WEIGHT)
    # Symmetric: the transpose is the same in the order of LAPACK.
    some = submatrix(signal.T, use, use).T if use.size < y.size else signal.copy(order="F")
    noise = noise[use] / weight[use]
    some.T.flat[:: use.size + 1] += noise
    amount = solve_spd(some, y[use])
    if use.size == y.size:
        return np.asarray(noise * amount)
    weights = np.zeros(y.size)
    weights[use] = amount
    rest = y - signal @ weights
    rest[use] = noise * amount
    return np.asarray(rest)


def _residual_by_posterior(whole: Posterior, m: Floats, at: Ints) -> Callable[[Floats], Floats]:
    """`_weighted_residual` of meters `at` by their weights, from a posterior that covers them."""
    which, Q = whole.precision()
    noise, a = whole.noise[which], Q @ m[which]
    place = np.searchsorted(which, at)

    def left(weight: Floats) -> Floats:
        each = np.zeros(which.size)
        each[place] = np.where(weight > _LEAST_WEIGHT, weight, 0.0)
        less = indices(each < 1.0)
        rest = noise * a
        if less.size:
            # Symmetric: the transpose is the same in the order of LAPACK.
            some, part = submatrix(Q, less, less).T, each[less]
            some.T.flat[:: less.size + 1] += part / (noise[less] * (1.0 - part))
            z = solve_spd(some, a[less])
            rest -= noise * (z @ Q[less])
            rest[less] += z
        return np.asarray(rest[place])

    return left


# --- Decoders ---


@dataclass(frozen=True, slots=True, eq=False)
class DecoderInput:
    """Input of a decoder. p meters."""

    whole: Posterior  # posterior of all meters with a reading, not to be changed
    m: Floats  # (p,) readings minus the model, squared pu; any finite value without a reading
    available: Bools  # (p,) meters with a reading
    limits: Limits  # rule of the limits
    trusted: Bools  # (p,) meters trusted before
    above_limit: Bools  # (p,) residual above the limit with these
    max_attacked: int  # largest number of accusations
    like: float  # least likelihood ratio that decides against a rival


@dataclass(frozen=True, slots=True, eq=False)
class DecoderAnswer:
    """Answer of a decoder."""

    meters: Bools  # (p,) accused meters
    worse: float = 0.0  # cost above that of the best answer


Decoder = Callable[[DecoderInput], tuple[DecoderAnswer, ...]]
"""The best answer first, then those about as good."""
