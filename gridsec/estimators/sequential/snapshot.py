"""Who lies, from one set of readings alone: the likeliest explanation, and those about as likely.

No time, nothing that was believed before. The error of a liar's reading has the standard deviation A, far
beyond an honest meter's. A customer whose meter lies may report false powers too, which moves the squared
voltages along the columns of ``B_c = std_c [2 R_:c, 2 X_:c]``. With the liars L and, of those, F whose
powers are false too,

    K = S + diag(d) + A^2 sum_{j in L} e_j e_j^T + sum_{c in F} B_c B_c^T
    J = m^T K^-1 m + ln det K + price(|L|) + false |F| + anybody [L not empty]

is minus twice the logarithm of an explanation's probability. ``ln det K`` charges an accusation for the
freedom that it gives: what one meter costs follows from A and from how well the others know its voltage.
What *all* single accusations change follows from ``Q = K^-1`` and ``g = Q m``:
`gridsec.estimators.sequential.rises`.

The price is that of sets whose members each lie with a probability that is Beta(a, b) distributed: the k-th
liar costs ``2 ln((p - k + b) / (k - 1 + a)) + each``, less the more there are already. Up to eight liars
whose lies are alike have fewer freedoms, and independent ones cost more:
`gridsec.estimators.sequential.alike`.

`anybody` is what makes a false alarm as rare as asked for. Nobody is named unless accusing one meter lowers
J, and with it that takes a leave-one-out residual beyond the ``1 - r / (2 p)`` quantile of the normal
distribution; or unless a meter together with its customer's powers explains more than the ``1 - r' / p``
quantile of chi-square with three degrees of freedom. ``r + r'`` is `rate`, an upper bound: where freedom and
price alone cost more, `anybody` is zero and fewer are named. Once one is accused, others lie more probably.

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

# Rises of J below this are rounding.
_LEAST = 1e-9
# A fit this many standard deviations above its expectation leaves something unexplained.
_MISFIT = 3.0
_MOVES = 4
# So many customers, those whose meters are most suspicious, are where a search with false powers may begin.
_STARTS = 8
# After so many starts, the rest only where the best explanation is implausible: many accused, or a bad fit.
_BEGUN = 2
_MANY = 0.25


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
    lies : (p,)
        What each liar's reading is expected to be off by, squared pu; 0 elsewhere.
    """

    liars: Bools
    powers: Bools
    probability: float
    cost: float
    weights: Floats
    lies: Floats


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
        What false powers do to voltages, and how false they may be; none by default. From snapshot to
        snapshot `FalsePowers.claimed` hands on what depends on the feeder alone.
    curved
        The power flow is not linear, and false powers may be large: `curved(weights, powers)` is `m` for the
        live meters linearised about the powers of an explanation, by its weights and who reports false ones,
        (p_live,) each. Without it, `m` is good for all.

    Returns
    -------
    tuple of Explained
        The likeliest first; there is always one.

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
    # Symmetric: its transpose is the same in the order that LAPACK wants.
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
        for k, c in enumerate(_doubtful(problem, start, anybody=first is not start)):
            if k >= _BEGUN and _plausible(problem, known):
                break
            _descend(problem, _doubted(problem, start, c), known, false)
    if len(known) == 1:
        return [start]
    if false and not _plausible(problem, known):
        # False powers may lead astray: who lies if all powers are true, and only then whose are false.
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


def _doubtful(problem: Problem, at: State, *, anybody: bool) -> list[int]:
    """Customers whose false powers explain more than their lying meter alone, the best first.

    Unless `anybody` is named anyway, only those whose meters are suspicious and who explain so much that it
    is rare.
    """
    if anybody:
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


def _best(problem: Problem, at: State, false: bool) -> State | None:
    """The state after the move that lowers J most, or None where none does."""
    rise = problem.meters(at)
    j = int(rise.argmin())
    least, move = float(rise[j]), "meter"
    if false and at.counts[0]:
        # Whose powers are false, and who might be next.
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
    """Trust each liar again, and see what explains the readings instead."""
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
    """The explanation that trusts a liar and its customer's powers again."""
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
    """Accuse one more, although that alone does not lower J, and go on from there."""
    rise = np.where(at.liars, np.inf, problem.meters(at))
    for j in np.flatnonzero(rise <= 2.0 * np.log(problem.lies.like)).tolist():
        after = at.copy()
        problem.toggle(after, j)
        if after.key not in known:
            _descend(problem, after, known, false)


def _reported(problem: Problem, found: list[State], live: Bools, lies: Lies) -> tuple[Explained, ...]:
    """The likeliest of them as explanations of all meters, one for each set of liars."""
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
    """An explanation of the live meters as one of all."""
    weights, lies = np.zeros(live.size), np.zeros(live.size)
    weights[live], lies[live] = each.weights, each.lies
    liars, powers = _spread(each.liars, live), _spread(each.powers, live)
    return Explained(liars, powers, probability, each.cost, weights, lies)


def _spread(some: Bools, live: Bools) -> Bools:
    out = np.zeros(live.size, dtype=np.bool_)
    out[live] = some
    return out
