"""Manipulated meters from one set of readings: the likeliest hypothesis, and those about as likely.

No time, no earlier trust. The error of a manipulated reading has the standard deviation A, far beyond an
honest meter's. Its customer may report false powers too, which move the squared voltages along the columns of
``B_c = std_c [2 R_:c, 2 X_:c]``. With the manipulated meters L and, of those, F with false powers,

    K = S + diag(d) + A^2 sum_{j in L} e_j e_j^T + sum_{c in F} B_c B_c^T
    J = m^T K^-1 m + ln det K + price(|L|) + false |F| + first [L not empty]

is minus twice the logarithm of a hypothesis's probability. ``ln det K`` charges an accusation for its
freedom, which follows from A and the precision of the meter's prediction. The change of J by *all* single
accusations follows from ``Q = K^-1`` and ``g = Q m``: `gridsec.estimators.snapshot.likelihood`.

The price is that of sets with members manipulated at a Beta(a, b) distributed probability: the k-th costs
``2 ln((p - k + b) / (k - 1 + a)) + each``, less the more there are already. Up to eight errors that are alike
have fewer freedoms, and independent ones cost more: `gridsec.estimators.snapshot.collusion`.

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
from gridsec.arrays import Bools, Floats, Ints, submatrix
from gridsec.estimators.front.posterior import Prior
from gridsec.estimators.snapshot.collusion import ErrorSet, likely_sets, may_change
from gridsec.estimators.snapshot.likelihood import (
    Curved,
    ErrorPrior,
    FalsePowers,
    LikelihoodProblem,
    SnapshotHypothesis,
    suspicious,
)

__all__ = ["Curved", "ErrorPrior", "FalsePowers", "SnapshotExplanation", "identify"]

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
_PAIRS = 32
"""Pairs of customers that are extended to triples, and kept triples."""
_TOGETHER = 4
"""Pairs, and triples, of customers with false powers, from which a search starts."""
_MANY = 0.25
"""Part of the meters that counts as many."""


@dataclass(frozen=True, slots=True, eq=False)
class SnapshotExplanation:
    """One hypothesis. p meters."""

    meters: Bools  # (p,) manipulated readings
    powers: Bools  # (p,) false powers as well
    probability: float  # among all that are reported
    cost: float  # J
    weights: Floats  # (p,) ``K^-1 m``; covariance with the readings times this predicts any voltage
    errors: Floats  # (p,) expected error of each manipulated reading, squared pu; 0 elsewhere


def identify(
    prior: Prior,
    noise: Floats,
    m: Floats,
    available: Bools,
    *,
    error_prior: ErrorPrior | None = None,
    false: FalsePowers | None = None,
    curved: Curved | None = None,
) -> tuple[SnapshotExplanation, ...]:
    """Likeliest hypotheses of one set of readings, the best first; there is always one.

    noise, m, available: (p,) variance of each reading, > 0; readings minus the model, squared pu, finite;
    meters with a reading. error_prior: that of the manipulations. false: effects of false powers; none by
    default. `FalsePowers.claimed` reuses values that depend on the feeder alone. curved: for large false
    powers, `curved(weights, powers)` is `m` of the live meters linearised about the powers of a hypothesis,
    by its weights and false powers, (p_live,) each.

    Raises
    ------
    ValueError
        If `false` is of other meters.
    """
    if false is not None and false.p.size != available.size:
        raise errors.InputInvalid(
            [
                errors.Problem(
                    "shape", f"false powers of {false.p.size} meters cannot explain {available.size}"
                )
            ]
        )
    error_prior = ErrorPrior() if error_prior is None else error_prior
    if not available.any():
        none = np.zeros(0, dtype=np.bool_)
        return (_explained(ErrorSet(none, none, 0.0, m[:0], m[:0]), 1.0, available),)
    if available.all():
        d, y, K = noise, m, np.asarray(prior.covariance[prior.meters])
    else:
        at = np.flatnonzero(available)
        d, y, K = noise[at], m[at], submatrix(prior.covariance, prior.meters[at], at)
        false = None if false is None else false.of(at)
    K.ravel()[:: d.size + 1] += d
    start = SnapshotHypothesis.without_accusations(y, _whitening(K))
    problem = LikelihoodProblem(error_prior, start, false, curved)
    quiet = problem.quiet(start.g, start.diagonal)
    found = [start] if quiet else _explanations(problem, start, false is not None)
    return _reported(problem, found, available, error_prior)


def _whitening(K: Floats) -> Floats:
    """W, lower triangular, with ``W^T W = K^-1``; destroys K."""
    # Symmetric: the transpose is the same in the order of LAPACK.
    factor, failed = lapack.dpotrf(K.T, lower=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    W, _ = lapack.dtrtri(factor, lower=True, overwrite_c=True)
    return np.asarray(W)


def _explanations(
    problem: LikelihoodProblem, start: SnapshotHypothesis, false: bool
) -> list[SnapshotHypothesis]:
    """Local minima of J from several starts, and their neighbours."""
    known: dict[bytes, SnapshotHypothesis] = {start.key: start}
    first = _descend(problem, start, known, false)
    if false and (first is start or _misfits(problem, first)):
        for k, c in enumerate(_doubtful(problem, start, accused=first is not start)):
            if k >= _BEGUN and _plausible(problem, known):
                break
            _descend(problem, _doubted(problem, start, c), known, false)
    if len(known) == 1:
        return [start]
    if false and not _plausible(problem, known):
        for customers in _together(problem, start):
            at = start
            for c in customers:
                at = _doubted(problem, at, c)
            _descend(problem, at, known, false)
    if false and not _plausible(problem, known):
        # False powers may mislead: first the meters with all powers true, then the powers.
        apart: dict[bytes, SnapshotHypothesis] = {}
        _descend(problem, _descend(problem, start, apart, False), known, false)
        known.update(apart)
    _exchange(problem, min(known.values(), key=problem.cost), known, false)
    _more(problem, min(known.values(), key=problem.cost), known, false)
    return list(known.values())


def _misfits(problem: LikelihoodProblem, at: SnapshotHypothesis) -> bool:
    return at.fit > problem.size + _MISFIT * float(np.sqrt(2.0 * problem.size))


def _plausible(problem: LikelihoodProblem, known: dict[bytes, SnapshotHypothesis]) -> bool:
    best = min(known.values(), key=problem.cost)
    return best.counts[0] <= _MANY * problem.size and not _misfits(problem, best)


def _doubtful(problem: LikelihoodProblem, at: SnapshotHypothesis, *, accused: bool) -> list[int]:
    """Customers with false powers that explain more than their manipulated meter alone, the best first.

    Before any accusation (`accused` False), only those with suspicious meters and rare evidence.
    """
    if accused:
        single = problem.meter_rises(at)
        which = np.argsort(single)[:_STARTS]
        rise, _ = problem.power_rises(at, which)
        worth = rise < single[which]
    else:
        which = np.flatnonzero(suspicious(at.g, at.diagonal))
        if not which.size:
            return []
        rise, gain = problem.power_rises(at, which)
        worth = (rise < 0.0) & (gain > problem.rare)
    order = np.argsort(rise)
    return [int(c) for c in which[order][worth[order]]]


def _doubted(problem: LikelihoodProblem, at: SnapshotHypothesis, c: int) -> SnapshotHypothesis:
    after = at.copy()
    if not after.meters[c]:
        problem.toggle(after, c)
    problem.doubt_powers(after, c)
    problem.linearise(after)
    return after


def _together(problem: LikelihoodProblem, start: SnapshotHypothesis) -> list[tuple[int, ...]]:
    """Likeliest pairs and triples of customers with manipulated meters and false powers.

    Two customers that coordinate their meters and powers hide each other: the powers of each alone explain
    little. J of all pairs follows from products of the columns ``[A e_c, B_c]``. The best pairs are extended
    by each other customer.
    """
    p = problem.size
    meters = problem.prior.size * np.eye(p)
    rows = np.concatenate([np.vstack([meters[c], problem.columns(c)]) for c in range(p)])
    white = rows @ problem.W.T
    G, h = white @ white.T + np.eye(3 * p), white @ (problem.W @ start.m)

    def best(sets: Ints) -> Ints:
        at = (3 * sets[:, :, None] + np.arange(3)).reshape(len(sets), -1)
        half = np.linalg.cholesky(G[at[:, :, None], at[:, None, :]])
        v = np.linalg.solve(half, h[at][:, :, None])[:, :, 0]
        cost = 2.0 * np.log(np.einsum("kii->ki", half)).sum(axis=1) - (v * v).sum(axis=1)
        return sets[np.argsort(cost, kind="stable")[:_PAIRS]]

    pairs = best(np.stack(np.triu_indices(p, 1), axis=1)) if p > 1 else np.zeros((0, 2), np.intp)
    more = [np.append(pair, c) for pair in pairs for c in range(p) if c not in pair]
    triples = best(np.unique(np.sort(np.stack(more), axis=1), axis=0)) if more else np.zeros((0, 3), np.intp)
    return [tuple(each) for some in (pairs, triples) for each in some[:_TOGETHER].tolist()]


def _descend(
    problem: LikelihoodProblem, at: SnapshotHypothesis, known: dict[bytes, SnapshotHypothesis], false: bool
) -> SnapshotHypothesis:
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


def _best(problem: LikelihoodProblem, at: SnapshotHypothesis, false: bool) -> SnapshotHypothesis | None:
    """State after the move that lowers J most, or None where none does."""
    rise = problem.meter_rises(at)
    j = int(rise.argmin())
    least, update = float(rise[j]), "meter"
    if false and at.counts[0]:
        # Powers to be trusted again, and further false powers.
        for which, what in ((at.powers, "believe"), (at.meters & ~at.powers, "powers")):
            if (some := which.nonzero()[0]).size:
                rise = (
                    problem.trust_rises(at, some) if what == "believe" else problem.power_rises(at, some)[0]
                )
                c = int(rise.argmin())
                if rise[c] < least:
                    j, least, update = int(some[c]), float(rise[c]), what
    if least >= -_LEAST:
        return None
    if update == "powers":
        return _doubted(problem, at, j)
    after = at.copy()
    if update == "believe":
        problem.doubt_powers(after, j, -1.0)
    else:
        problem.toggle(after, j)
    return after


def _exchange(
    problem: LikelihoodProblem, at: SnapshotHypothesis, known: dict[bytes, SnapshotHypothesis], false: bool
) -> None:
    """Trust each accused meter again, and search from the best replacement."""
    least, within = problem.cost(at), 2.0 * np.log(problem.prior.like)
    for j in at.meters.nonzero()[0].tolist():
        after = _without(problem, at, j, known)
        rise = problem.meter_rises(after).copy()
        rise[j] = np.inf
        k = int(rise.argmin())
        if problem.cost(after) + rise[k] - least <= within:
            after = after.copy()
            problem.toggle(after, k)
            if after.key not in known:
                _descend(problem, after, known, false)


def _without(
    problem: LikelihoodProblem, at: SnapshotHypothesis, j: int, known: dict[bytes, SnapshotHypothesis]
) -> SnapshotHypothesis:
    """Hypothesis that trusts an accused meter and its customer's powers again."""
    after = at.copy()
    if at.counts[1]:
        if at.powers[j]:
            problem.doubt_powers(after, j, -1.0)
    else:
        after.meters[j] = False
        if after.key in known:
            return known[after.key]
        after.meters[j] = True
    problem.toggle(after, j)
    return after


def _more(
    problem: LikelihoodProblem, at: SnapshotHypothesis, known: dict[bytes, SnapshotHypothesis], false: bool
) -> None:
    """Accuse one more, although that alone does not lower J, and descend from there."""
    rise = np.where(at.meters, np.inf, problem.meter_rises(at))
    for j in np.flatnonzero(rise <= 2.0 * np.log(problem.prior.like)).tolist():
        after = at.copy()
        problem.toggle(after, j)
        if after.key not in known:
            _descend(problem, after, known, false)


def _reported(
    problem: LikelihoodProblem, found: list[SnapshotHypothesis], available: Bools, error_prior: ErrorPrior
) -> tuple[SnapshotExplanation, ...]:
    """The likeliest ones as hypotheses of all meters, one for each set of manipulated meters."""
    ranked = sorted(((problem.cost(each), each) for each in found), key=lambda pair: pair[0])
    if may_change(problem, ranked):
        sets = likely_sets(problem, ranked)
    else:
        sets = [
            ErrorSet(each.meters, each.powers, cost, each.g, problem.a2 * each.meters * each.g)
            for cost, each in ranked
        ]
    sets.sort(key=lambda each: each.cost)
    best: dict[bytes, ErrorSet] = {}
    for each in sets:
        if each.cost - sets[0].cost <= 2.0 * np.log(error_prior.like):
            best.setdefault(each.meters.tobytes(), each)
    likely = {key: float(np.exp(-0.5 * (each.cost - sets[0].cost))) for key, each in best.items()}
    total = sum(likely.values())
    return tuple(_explained(each, likely[key] / total, available) for key, each in best.items())


def _explained(each: ErrorSet, probability: float, available: Bools) -> SnapshotExplanation:
    """Hypothesis of the live meters as one of all."""
    weights, errors_ = np.zeros(available.size), np.zeros(available.size)
    weights[available], errors_[available] = each.weights, each.errors
    suspects, powers = _spread(each.meters, available), _spread(each.powers, available)
    return SnapshotExplanation(suspects, powers, probability, each.cost, weights, errors_)


def _spread(some: Bools, available: Bools) -> Bools:
    out = np.zeros(available.size, dtype=np.bool_)
    out[available] = some
    return out
