"""Manipulated meters from one set of readings: the likeliest hypothesis, and those about as likely.

No time, no earlier trust. The error of a manipulated reading has the standard deviation A, far beyond an
honest meter's. Its customer may report false powers too, which move the squared voltages along the columns of
``B_c = std_c [2 R_:c, 2 X_:c]``. With the manipulated meters L and, of those, F with false powers,

    K = S + diag(d) + A^2 sum_{j in L} e_j e_j^T + sum_{c in F} B_c B_c^T
    J = m^T K^-1 m + ln det K + price(|L|) + false |F| + first [L not empty]

is minus twice the logarithm of a hypothesis's probability. ``ln det K`` charges an accusation for its
freedom, which follows from A and the precision of the meter's prediction. The change of J by *all* single
accusations follows from ``Q = K^-1`` and ``g = Q m``: `gridsec.estimators.sequential.rises`.

The price is that of sets with members manipulated at a Beta(a, b) distributed probability: the k-th costs
``2 ln((p - k + b) / (k - 1 + a)) + each``, less the more there are already. Up to eight errors that are alike
have fewer freedoms, and independent ones cost more: `gridsec.estimators.sequential.alike`.

`first` sets the false-alarm rate. No meter is accused unless accusing one lowers J, which takes a
leave-one-out residual beyond the ``1 - r / (2 p)`` quantile of the normal distribution; or unless a meter
with its customer's powers explains more than the ``1 - r' / p`` quantile of chi-square with three degrees of
freedom. ``r + r'`` is `rate`, an upper bound: where freedom and price alone cost more, `first` is zero and
fewer are accused. Once one is accused, further ones are likelier.

References
----------
George and McCulloch 1993 (spike and slab); Scott and Berger 2010 (the prior over sets).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from gridsec import errors
from gridsec.arrays import Bools, Floats, submatrix
from gridsec.estimators.sequential.alike import Set, alike, worth
from gridsec.estimators.sequential.conditional import Prior
from gridsec.estimators.sequential.rises import Curved, FalsePowers, Lies, Problem, State, suspicious

__all__ = ["Curved", "Explained", "FalsePowers", "Lies", "identify"]

_LEAST = 1e-9
"""Change of J within rounding."""
_MISFIT = 3.0
"""Standard deviations of the chi-square above its expectation that leave something unexplained."""
_MOVES = 4
"""Largest number of moves of a descent per meter."""
_STARTS = 8
"""Customers of the most suspicious meters, at which a search with false powers may start."""
_BEGUN = 2
"""Starts before the rest depends on an implausible best hypothesis: many accused, or a bad fit."""
_MANY = 0.25
"""Part of the meters that counts as many."""


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """One hypothesis. p meters."""

    liars: Bools  # (p,) manipulated readings
    powers: Bools  # (p,) false powers as well
    probability: float  # among all that are reported
    cost: float  # J
    weights: Floats  # (p,) ``K^-1 m``; covariance with the readings times this predicts any voltage
    lies: Floats  # (p,) expected error of each manipulated reading, squared pu; 0 elsewhere


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
    """Likeliest hypotheses of one set of readings, the best first; there is always one.

    noise, m, live: (p,) variance of each reading, > 0; readings minus the model, squared pu, finite; meters
    with a reading. lies: prior of the manipulations. false: effects of false powers; none by default.
    `FalsePowers.claimed` reuses values that depend on the feeder alone. curved: for large false powers,
    `curved(weights, powers)` is `m` of the live meters linearised about the powers of a hypothesis, by its
    weights and false powers, (p_live,) each.

    Raises
    ------
    ValueError
        If `false` is of other meters.
    """
    if false is not None and false.p.size != live.size:
        raise errors.InputInvalid(
            [errors.Problem("shape", f"false powers of {false.p.size} meters cannot explain {live.size}")]
        )
    lies = Lies() if lies is None else lies
    if not live.any():
        none = np.zeros(0, dtype=np.bool_)
        return (_explained(Set(none, none, 0.0, m[:0], m[:0]), 1.0, live),)
    if live.all():
        d, y, K = noise, m, prior.between
    else:
        at = np.flatnonzero(live)
        d, y, K = noise[at], m[at], submatrix(prior.of_meters, prior.meters[at], at)
        false = None if false is None else false.of(at)
    K.ravel()[:: d.size + 1] += d
    start = State.nobody(y, _whitening(K))
    problem = Problem(lies, start, false, curved)
    quiet = problem.quiet(start.g, start.diagonal)
    found = [start] if quiet else _explanations(problem, start, false is not None)
    return _reported(problem, found, live, lies)


def _whitening(K: Floats) -> Floats:
    """W, lower triangular, with ``W^T W = K^-1``; destroys K."""
    # Symmetric: the transpose is the same in the order of LAPACK.
    factor, failed = lapack.dpotrf(K.T, lower=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    W, _ = lapack.dtrtri(factor, lower=True, overwrite_c=True)
    return np.asarray(W)


def _explanations(problem: Problem, start: State, false: bool) -> list[State]:
    """Local minima of J from several starts, and their neighbours."""
    known: dict[bytes, State] = {start.key: start}
    first = _descend(problem, start, known, false)
    if false and (first is start or _misfits(problem, first)):
        for k, c in enumerate(_doubtful(problem, start, accused=first is not start)):
            if k >= _BEGUN and _plausible(problem, known):
                break
            _descend(problem, _doubted(problem, start, c), known, false)
    if len(known) == 1:
        return [start]
    if false and not _plausible(problem, known):
        # False powers may mislead: first the meters with all powers true, then the powers.
        apart: dict[bytes, State] = {}
        _descend(problem, _descend(problem, start, apart, False), known, false)
        known.update(apart)
    _exchange(problem, min(known.values(), key=problem.cost), known, false)
    _more(problem, min(known.values(), key=problem.cost), known, false)
    return list(known.values())


def _misfits(problem: Problem, at: State) -> bool:
    return at.fit > problem.size + _MISFIT * float(np.sqrt(2.0 * problem.size))


def _plausible(problem: Problem, known: dict[bytes, State]) -> bool:
    best = min(known.values(), key=problem.cost)
    return best.counts[0] <= _MANY * problem.size and not _misfits(problem, best)


def _doubtful(problem: Problem, at: State, *, accused: bool) -> list[int]:
    """Customers with false powers that explain more than their manipulated meter alone, the best first.

    Before any accusation (`accused` False), only those with suspicious meters and rare evidence.
    """
    if accused:
        single = problem.meters(at)
        who = np.argsort(single)[:_STARTS]
        rise, _ = problem.pairs(at, who)
        worth = rise < single[who]
    else:
        who = np.flatnonzero(suspicious(at.g, at.diagonal))
        if not who.size:
            return []
        rise, gain = problem.pairs(at, who)
        worth = (rise < 0.0) & (gain > problem.rare)
    order = np.argsort(rise)
    return [int(c) for c in who[order][worth[order]]]


def _doubted(problem: Problem, at: State, c: int) -> State:
    after = at.copy()
    if not after.liars[c]:
        problem.toggle(after, c)
    problem.powers(after, c)
    problem.settle(after)
    return after


def _descend(problem: Problem, at: State, known: dict[bytes, State], false: bool) -> State:
    """Steepest descent; remembers every hypothesis that it passes."""
    known.setdefault(at.key, at)
    for _ in range(_MOVES * at.g.size):
        after = _best(problem, at, false)
        if after is None:
            return at
        if after.key in known:
            return known[after.key]
        known[after.key] = at = after
    return at


def _best(problem: Problem, at: State, false: bool) -> State | None:
    """State after the move that lowers J most, or None where none does."""
    rise = problem.meters(at)
    j = int(rise.argmin())
    least, move = float(rise[j]), "meter"
    if false and at.counts[0]:
        # Powers to be trusted again, and further false powers.
        for who, what in ((at.powers, "believe"), (at.liars & ~at.powers, "powers")):
            if (some := who.nonzero()[0]).size:
                rise = problem.believed(at, some) if what == "believe" else problem.pairs(at, some)[0]
                c = int(rise.argmin())
                if rise[c] < least:
                    j, least, move = int(some[c]), float(rise[c]), what
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


def _exchange(problem: Problem, at: State, known: dict[bytes, State], false: bool) -> None:
    """Trust each accused meter again, and search from the best replacement."""
    least, within = problem.cost(at), 2.0 * np.log(problem.lies.like)
    for j in at.liars.nonzero()[0].tolist():
        after = _without(problem, at, j, known)
        rise = problem.meters(after).copy()
        rise[j] = np.inf
        k = int(rise.argmin())
        if problem.cost(after) + rise[k] - least <= within:
            after = after.copy()
            problem.toggle(after, k)
            if after.key not in known:
                _descend(problem, after, known, false)


def _without(problem: Problem, at: State, j: int, known: dict[bytes, State]) -> State:
    """Hypothesis that trusts an accused meter and its customer's powers again."""
    after = at.copy()
    if at.counts[1]:
        if at.powers[j]:
            problem.powers(after, j, -1.0)
    else:
        after.liars[j] = False
        if after.key in known:
            return known[after.key]
        after.liars[j] = True
    problem.toggle(after, j)
    return after


def _more(problem: Problem, at: State, known: dict[bytes, State], false: bool) -> None:
    """Accuse one more, although that alone does not lower J, and descend from there."""
    rise = np.where(at.liars, np.inf, problem.meters(at))
    for j in np.flatnonzero(rise <= 2.0 * np.log(problem.lies.like)).tolist():
        after = at.copy()
        problem.toggle(after, j)
        if after.key not in known:
            _descend(problem, after, known, false)


def _reported(problem: Problem, found: list[State], live: Bools, lies: Lies) -> tuple[Explained, ...]:
    """The likeliest ones as hypotheses of all meters, one for each set of manipulated meters."""
    ranked = sorted(((problem.cost(each), each) for each in found), key=lambda pair: pair[0])
    if worth(problem, ranked):
        sets = alike(problem, ranked)
    else:
        sets = [
            Set(each.liars, each.powers, cost, each.g, problem.a2 * each.liars * each.g)
            for cost, each in ranked
        ]
    sets.sort(key=lambda each: each.cost)
    best: dict[bytes, Set] = {}
    for each in sets:
        if each.cost - sets[0].cost <= 2.0 * np.log(lies.like):
            best.setdefault(each.liars.tobytes(), each)
    likely = {key: float(np.exp(-0.5 * (each.cost - sets[0].cost))) for key, each in best.items()}
    total = sum(likely.values())
    return tuple(_explained(each, likely[key] / total, live) for key, each in best.items())


def _explained(each: Set, probability: float, live: Bools) -> Explained:
    """Hypothesis of the live meters as one of all."""
    weights, lies = np.zeros(live.size), np.zeros(live.size)
    weights[live], lies[live] = each.weights, each.lies
    liars, powers = _spread(each.liars, live), _spread(each.powers, live)
    return Explained(liars, powers, probability, each.cost, weights, lies)


def _spread(some: Bools, live: Bools) -> Bools:
    out = np.zeros(live.size, dtype=np.bool_)
    out[live] = some
    return out
