"""Identification: the likeliest sets of manipulated meters, by exact likelihoods of subsets.

Costs are those of `gridsec.estimators.modal.costs`, neighbourhoods those of `laterals` beside it.

**Search.** A descent adds, removes and exchanges faults, and adds groups of neighbours at once. It starts
from nothing, and from the meters that stand out when each has a variance of its own (automatic
relevance determination [1]_). The prior size of the meters' faults is then estimated from the set found, and
the descent is repeated.

A set of meters that are off by nearly the same amount needs one size instead of k. The likelihood of a set is
the mean of that with independent amounts and that with amounts alike, which has the charge of a false power:
loads without a report move neighbours alike as well. Sets with amounts alike have a descent of their own.

**Rivals.** Loads may change in ways that no report shows. The search is also made under each model of
`gridsec.estimators.modal.rivals`, with the cost of that model by itself. A model that is far from the best
one is not explored further. A set without meter j is looked for from the best set by removing j. The sets
that differ by one whole group are tried, and those that differ by one meter from each of the likeliest sets.
All sets met count with the weight exp(-cost / 2). A meter is named if the sets without it have together less
than `DOUBT` of the weight, and if the likeliest set under the loads as stated has it, too: loads that vary
far more than stated explain most of a manipulation that is no step, and little is left to find meters by.

References
----------
.. [1] Tipping, Sparse Bayesian learning and the relevance vector machine, JMLR 1, 2001.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf, log
from typing import TypeVar

import numpy as np
from scipy.linalg import cho_solve, lapack

from gridsec.arrays import Bools, Floats, Ints, keys_of, sets_of
from gridsec.estimators.modal.alike import Alike, opposed
from gridsec.estimators.modal.costs import (
    BELIEVED,
    SearchProblem,
    Tableau,
    costs,
    informed,
    mean_amounts,
    mean_likelihood,
    similar,
    sizes,
)
from gridsec.estimators.modal.laterals import GAIN, Groups, excess, filled, in_common, together

AnyTableau = TypeVar("AnyTableau", bound=Tableau)

DOUBT = 1e-3
"""Largest weight of all explanations without a meter that is named, 1."""
UNLIKELY = 1e-4
"""Weight below which a set beside one that is not the best is not kept, 1: a tenth of `DOUBT`."""
ALIKE = 0.99
"""Share of the variance of amounts that meters have in common where they are manipulated alike, 1."""
SOME = 200
"""Number of sets that are also tried with amounts alike, the cheapest ones first."""
HOPELESS = 30.0
"""Cost above the best of all from which on a model of the loads is not explored further, 1."""
NEAR, EXPANDED = 10.0, 6
"""Cost above the best one up to which the sets beside a set are looked at as well, and their number."""
FAR = 60.0
"""Cost above the best one from which on a set is not followed, 1: that of a descent under a model of the
loads, or one without a meter after one change."""
STEPS = 4
"""Largest number of steps of a descent, in meters: each may be added, removed and exchanged."""
RELEVANCE = 12
"""Iterations of the start by relevance: variances of irrelevant meters halve in each."""
SUITED = 0.1
"""Weight of the size that suits a set of an earlier search, 1: it is chosen by the readings."""
STANDS_OUT = 9.0
"""Squared standard deviations from which a meter is in that start, 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Sets of faults that explain the readings, the likeliest first.

    Attributes
    ----------
    chosen : (k, q)
        The sets.
    model : (k,)
        Number of the problem of each: 0, or that of a rival model of the loads.
    weight : (k,)
        Their posterior weights; they sum to 1.
    named : (p,)
        Meters that are `certain`.
    problems
        The problem with the estimated prior size, and those of the rivals.
    plain : (q,)
        The likeliest set under the model of the loads as stated; None for all faults.
    """

    chosen: Bools
    model: Ints
    weight: Floats
    named: Bools
    problems: tuple[SearchProblem, ...]
    plain: Bools | None = None

    @property
    def certain(self) -> Bools:
        """Faults without which nothing explains the readings, and that `plain` has, (q,)."""
        return _certain(self.chosen, self.weight, self.plain)


def descend(tableau: AnyTableau, groups: Groups = (), met: set[bytes] | None = None) -> AnyTableau:
    """Lower the cost by additions, removals, exchanges and groups until none of them helps.

    A fault with an amount that other changes have made impossible is removed and barred.

    Parameters
    ----------
    tableau
        Where to start; it is changed and returned.
    groups
        Groups of neighbours.
    met
        Sets that descents have passed; it is changed. The descent stops at any of them.
    """
    for _ in range(STEPS * tableau.problem.meters):
        if met is not None:
            here = tableau.chosen.tobytes() + tableau.barred.tobytes()
            if here in met:
                break
            met.add(here)
        change = tableau.changes()
        j = int(change.argmin())
        if change[j] < -GAIN:
            tableau.toggle(j)
        elif not (_possible(tableau) or _exchanged(tableau) or _grouped(tableau, groups)):
            break
    return tableau


def _possible(tableau: Tableau) -> bool:
    """Bar the faults with impossible amounts, if there are any."""
    beyond = np.flatnonzero(tableau.chosen & (np.abs(tableau.amount) > tableau.problem.bound))
    for j in beyond:
        tableau.bar(int(j))
    return bool(beyond.size)


def _exchanged(tableau: Tableau) -> bool:
    """Make the best exchange of two faults, if one helps."""
    out = np.flatnonzero(tableau.chosen)
    if not out.size:
        return False
    both = tableau.exchanges(out)
    i, j = np.unravel_index(int(both.argmin()), both.shape)
    if not both[i, j] < -GAIN:
        return False
    tableau.toggle(int(out[i]))
    tableau.toggle(int(j))
    return True


def _grouped(tableau: Tableau, groups: Groups) -> bool:
    """Add the rest of the best group, if one helps."""
    best, least, block = None, -GAIN, tableau.part(np.arange(tableau.problem.meters))
    for members, inside, ends in groups:
        change = np.where(ends, tableau.group(members, inside, block), inf)
        k, n = np.unravel_index(int(change.argmin()), change.shape)
        if change[k, n] < least:
            best, least = members[k, : n + 1], float(change[k, n])
    if best is None:
        return False
    for j in best[~tableau.chosen[best]]:
        tableau.toggle(int(j))
    return True


def relevant(problem: SearchProblem) -> Bools:
    """Meters that stand out when each has a prior variance of its own, (q,); O(p^3) per iteration.

    Parameters
    ----------
    problem
        The problem.
    """
    p = problem.meters
    F, y, alpha = problem.F[:p, :p], problem.y[:p], problem.std[:p] ** 2.0
    least = 1e-8 * alpha
    for _ in range(RELEVANCE):
        A = F.copy()
        A[np.diag_indices(p)] += 1.0 / alpha
        half, _ = lapack.dpotrf(A, lower=True, overwrite_a=True)
        mean = cho_solve((half, True), y, check_finite=False)
        inverse, _ = lapack.dpotri(half, lower=True, overwrite_c=True)
        variance = inverse.diagonal()
        alpha = np.maximum(mean * mean + variance, least)
    out = np.zeros(problem.y.size, dtype=np.bool_)
    out[:p] = mean * mean > STANDS_OUT * variance
    return out


def search(
    problem: SearchProblem,
    groups: tuple[Ints, ...] = (),
    rivals: Sequence[tuple[SearchProblem, float]] = (),
    laterals: Bools | None = None,
    known: Bools | None = None,
) -> Identification:
    """Find the likeliest sets and the meters without which nothing explains the readings.

    Parameters
    ----------
    problem
        The problem.
    groups
        Groups of neighbours, places of meters.
    rivals
        The problem under other models of the loads, and the cost of each by itself.
    laterals : (G, p)
        Members of the laterals that may be manipulated as a whole; None: none.
    known : (k, q)
        More sets that count, as those of an earlier search, which descents may miss; None: none.
    """
    read = informed(problem)
    groups = tuple(each[read[each]] for each in groups if read[each].any())
    batches = together(groups)
    whole = np.zeros((0, problem.meters)) if laterals is None else (laterals & read).astype(np.float64)
    start, nothing = relevant(problem), np.zeros(problem.y.size, dtype=np.bool_)
    ends, one_amount, least = list[Tableau](), list[Bools](), list[float]()
    for other, cost in ((problem, 0.0), *rivals):
        starts = _different((nothing, ends[0].chosen if ends else start))
        end = _best(tuple(_at(other, each) for each in starts), batches)
        sets = end.chosen[None]
        if not least or _reach(end, starts[-1], whole, read) + cost < min(least) + FAR:
            end = _resized(end, starts[-1], batches)
            sets = np.vstack(
                [in_common(end.problem, whole, end.chosen), _nearly_alike(end, batches, whole, read)]
            )
        alike = costs(end.problem, sets, ALIKE) - excess(sets, whole, read)
        least.append(min(end.cost, float(alike.min())) + cost)
        ends.append(end)
        one_amount.append(sets)
    more = (0.0, *(cost for _, cost in rivals))
    found, problems = [], list[SearchProblem]()
    for end, sets, best, cost in zip(ends, one_amount, least, more, strict=True):
        if best < min(least) + HOPELESS:
            met = _explored(end, sets, groups, batches)
        else:
            met = {end.chosen.tobytes(): end.cost}
            _with_amounts_alike(end.problem, met, sets[:1])
        problems.append(end.problem if known is None else _recalled(end.problem, met, known))
        less = excess(sets_of(met, end.chosen.size), whole, read)
        each = np.fromiter(met.values(), np.float64, len(met)) + cost - less
        found.append(dict(zip(met, each.tolist(), strict=True)))
    plain = np.frombuffer(min(found[0], key=lambda key: found[0][key]), dtype=np.bool_)
    return identified(tuple(problems), tuple(found), plain)


def _reach(end: Tableau, start: Bools, whole: Floats, read: Bools) -> float:
    """Least cost of the end of a descent and of a start, with any size that suits one, and amounts alike."""
    sets = np.stack(_different((end.chosen, start)))
    problems = end.problem, *(_sized(end.problem, each) for each in sets)
    each = [costs(problem, sets, share) for problem in problems for share in (0.0, ALIKE)]
    return float((np.stack(each) - excess(sets, whole, read)).min())


def _resized(best: Tableau, start: Bools, groups: Groups) -> Tableau:
    """The cheapest set by descents with the sizes of the end of a descent, and of one of its starts."""
    again = _different((best.chosen, start))
    ends = [
        _best(tuple(_at(sized, each) for each in again), groups)
        for sized in (_sized(best.problem, each) for each in again)
        if sized is not best.problem
    ]
    return min(ends, key=lambda end: end.cost) if ends else best


def _different(sets: tuple[Bools, ...]) -> tuple[Bools, ...]:
    """The sets without those that are equal to an earlier one."""
    return tuple({each.tobytes(): each for each in sets}.values())


def _explored(
    best: Tableau, one_amount: Bools, groups: tuple[Ints, ...], batches: Groups
) -> dict[bytes, float]:
    """All sets that were met from the best one on, and those with one amount, with their costs."""
    problem, found = best.problem, {best.chosen.tobytes(): best.cost}

    def keep(tableau: Tableau) -> None:
        found[tableau.chosen.tobytes()] = min(tableau.cost, found.get(tableau.chosen.tobytes(), inf))

    met = {best.chosen.tobytes() + best.barred.tobytes()}
    for tableau in _flipped(best, groups):
        keep(descend(tableau, batches, met))
    top = min(found, key=lambda key: found[key])
    if top != best.chosen.tobytes():
        best = _at(problem, np.frombuffer(top, dtype=np.bool_))
    _neighbours(best, found)
    if best.chosen[problem.meters :].any():
        # The best set of meters alone, which amounts alike may favour.
        only = Tableau(problem)
        only.barred[problem.meters :] = True
        only = descend(only, batches)
        keep(only)
        _neighbours(only, found)
    for rival in _without_each(best, best.cost + FAR):
        keep(descend(rival, batches))
    likely = sorted((each, key) for key, each in found.items() if each < best.cost + NEAR)
    for _, key in likely[: EXPANDED + 1]:
        if key != best.chosen.tobytes():
            _neighbours(_at(problem, np.frombuffer(key, dtype=np.bool_)), found, UNLIKELY)
    _with_amounts_alike(problem, found, one_amount)
    return found


def _without_each(best: AnyTableau, limit: float) -> Iterator[AnyTableau]:
    """Tableaus without each meter of a set that are below a limit, alone or with one more change."""
    out = np.flatnonzero(best.chosen[: best.problem.meters])
    if not out.size:
        return
    least = np.minimum(best.changes()[out], best.seconds(out).min(axis=1))
    for j in out[best.whole + least < limit]:
        rival = best.copy()
        rival.bar(int(j))
        yield rival


def _nearly_alike(best: Tableau, groups: Groups, whole: Floats, read: Bools) -> Bools:
    """Ends of descents with amounts alike, sets beside them, and those without each meter, (k, q).

    The descents start with the best set, and without faults other than meters: with its meters, and with
    the relaxations of one prior standard deviation. Powers explain a part of a group, and no step beside
    them is worth its penalty then. The best end is continued from its relaxation. One that costs `FAR` more
    than the best set, as where amounts differ, is not followed. Where `opposed` shows that of all sets of
    meters, and the best one has no other faults, none is looked for.

    Parameters
    ----------
    best
        The best set with independent amounts.
    groups
        Groups of neighbours.
    whole, read
        Laterals that may be manipulated as a whole, (G, p), and meters with readings, (p,).
    """
    problem, q, met = best.problem, best.chosen.size, set[bytes]()
    meters, every = np.arange(q) < problem.meters, np.ones(q, dtype=np.bool_)
    if not best.chosen[~meters].any():
        amount = (best.amount * best.chosen)[meters]
        if min(opposed(problem, ALIKE, sign * amount < 0.0, sign) for sign in (1.0, -1.0)) > best.cost + FAR:
            return best.chosen[None]

    def end(start: Bools, used: Bools) -> Alike:
        return descend(Alike(problem, ALIKE, used).pivot(start), groups, met)

    nothing = Alike(problem, ALIKE, meters)
    starts = _different((best.chosen[meters], nothing.relaxed(1.0), nothing.relaxed(-1.0)))
    ends = [end(start, meters) for start in starts]
    if best.chosen[~meters].any():
        ends.append(end(best.chosen, every))
    least = min(ends, key=lambda each: each.whole)
    more = end(least.relaxed(), meters if least.chosen.size < q else every)
    least = min(least, more, key=lambda each: each.whole)
    chosen = np.pad(least.chosen, (0, q - least.chosen.size))
    if least.whole - float(excess(chosen[None], whole, read)[0]) > best.cost + FAR:
        return chosen[None]
    return _beside_alike(Alike(problem, ALIKE).pivot(chosen), groups)


def _beside_alike(end: Alike, groups: Groups) -> Bools:
    """A set with amounts alike, those beside it, and those that descents find without each meter, (k, q)."""
    limit = end.whole - 2.0 * log(UNLIKELY)
    found = {end.chosen.tobytes(): end.whole}
    _neighbours(end, found, UNLIKELY)
    for rival in _without_each(end, limit):
        descend(rival, groups)
        found.setdefault(rival.chosen.tobytes(), rival.whole)
    keys = sorted(found, key=lambda key: found[key])[:SOME]
    return sets_of(keys, end.chosen.size)


def _with_amounts_alike(problem: SearchProblem, found: dict[bytes, float], more: Bools) -> None:
    """Mix both priors of the amounts in more sets, and in the cheapest ones with more than one meter."""
    for chosen, each in zip(more, costs(problem, more), strict=True):
        found.setdefault(chosen.tobytes(), float(each))
    keys = sorted(found, key=lambda key: found[key])[:SOME]
    keys = list(dict.fromkeys([*keys, *(each.tobytes() for each in more)]))
    sets = sets_of(keys, more.shape[1])
    found.update(
        zip(keys, mixed(problem, sets, np.array([found[key] for key in keys])).tolist(), strict=True)
    )


def mixed(
    problem: SearchProblem, sets: Bools, own: Floats | None = None, *, std: Floats | None = None
) -> Floats:
    """Costs of sets with both priors of the amounts mixed, (k,): independent amounts and amounts alike.

    Parameters
    ----------
    problem
        The problem.
    sets : (k, q)
        The sets; those of one meter have one prior.
    own : (k,)
        Their costs with independent amounts; None: computed here.
    std : (k, q)
        As in `costs`.
    """
    out = costs(problem, sets, 0.0, std) if own is None else own.copy()
    several = np.flatnonzero(np.count_nonzero(sets[:, : problem.meters], axis=1) > 1)
    if several.size:
        alike = costs(problem, sets[several], ALIKE, None if std is None else std[several])
        out[several] = mean_likelihood(np.stack([out[several], alike]))
    return out


def _recalled(problem: SearchProblem, found: dict[bytes, float], known: Bools) -> SearchProblem:
    """Add sets of an earlier search, (k, q); the problem, with the size of one of them if it is best of all.

    The size of the problem is that of its best set. It speaks against sets of far larger or smaller amounts.
    So these sets have the mean of both likelihoods, with it and, at the weight `SUITED`, with the size that
    suits them. Sets with impossible amounts do not count.
    """
    out, least = problem, min(found.values())
    known = known.copy()
    known[:, : problem.meters] &= informed(problem)
    std = np.tile(problem.std, (len(known), 1))
    std[:, : problem.meters] = sizes(problem, known)[:, None]
    shared, suited = mixed(problem, known), mixed(problem, known, std=std)
    both = -2.0 * np.logaddexp(log(1.0 - SUITED) - 0.5 * shared, log(SUITED) - 0.5 * suited)
    limited = np.logical_or.reduce(known & (problem.bound < inf), axis=1)
    for k, (chosen, cost) in enumerate(zip(known, both.tolist(), strict=True)):
        own = replace(problem, std=std[k])
        if limited[k] and (np.abs(mean_amounts(own, chosen)) > own.bound[chosen]).any():
            continue
        found[chosen.tobytes()] = min(cost, found.get(chosen.tobytes(), inf))
        if cost < least:
            out, least = own, cost
    return out


def _best(starts: tuple[Tableau, ...], groups: Groups) -> Tableau:
    """The cheapest end of descents."""
    met = set[bytes]()
    return min((descend(start, groups, met) for start in starts), key=lambda end: end.cost)


def _at(problem: SearchProblem, chosen: Bools) -> Tableau:
    """A tableau pivoted on a set."""
    return Tableau(problem).pivot(chosen)


def _sized(problem: SearchProblem, chosen: Bools) -> SearchProblem:
    """The problem with the prior size of the meters' faults estimated from a set of them."""
    if not chosen[: problem.meters].any():
        return problem
    std = problem.std.copy()
    std[: problem.meters] = sizes(problem, chosen[None])[0]
    return replace(problem, std=std)


def _flipped(best: Tableau, groups: tuple[Ints, ...]) -> list[Tableau]:
    """Tableaus in which the meters of one group are accused in place of the believed and the reverse."""
    p, out, change = best.problem.meters, list[Bools](), list[Floats]()
    accused, most = best.chosen[:p], max(1, p // 2)
    some = [each for each in groups if each.size > 1 and accused[each].any()]
    some = [each for each in some if best.count + each.size - 2 * np.count_nonzero(accused[each]) <= most]
    if not some:
        return []
    for places in similar([each.size for each in some]):
        members, inside = filled([some[k] for k in places])
        change.append(best.toggled(members, inside))
        for at, there in zip(members, inside, strict=True):
            chosen = best.chosen.copy()
            chosen[at[there]] = ~chosen[at[there]]
            out.append(chosen)
    order = np.argsort(np.concatenate(change), kind="stable")
    return [_at(best.problem, out[k]) for k in order[:_FLIPS]]


_FLIPS = 4
"""Number of flipped groups from which a descent starts: the cheapest ones."""


def _neighbours(best: Tableau, found: dict[bytes, float], least: float = BELIEVED) -> None:
    """Add the sets that differ from the best by one addition, removal or exchange, if they weigh anything."""
    limit = min(found.values()) - 2.0 * log(least) - best.whole
    change, out = best.changes(), np.flatnonzero(best.chosen)
    one = np.flatnonzero(change < limit)
    both = best.exchanges(out) if out.size else np.zeros((0, change.size))
    i, j = np.nonzero(both < limit)
    sets = np.tile(best.chosen, (one.size + j.size, 1))
    rows = np.arange(one.size, len(sets))
    sets[np.arange(one.size), one] ^= True
    sets[rows, out[i]], sets[rows, j] = False, True
    more = np.concatenate([change[one], both[i, j]]) + best.whole
    for key, each in zip(keys_of(sets), more.tolist(), strict=True):
        found.setdefault(key, each)


def costs_of(found: Identification) -> list[dict[bytes, float]]:
    """Costs of explanations under each model of the loads, by their bytes; the weights sum to a cost of 0."""
    out: list[dict[bytes, float]] = [{} for _ in found.problems]
    each = (-2.0 * np.log(found.weight)).tolist()
    for model, key, cost in zip(found.model.tolist(), keys_of(found.chosen), each, strict=True):
        out[model][key] = cost
    return out


def identified(
    problems: tuple[SearchProblem, ...], found: Sequence[dict[bytes, float]], plain: Bools | None = None
) -> Identification:
    """Weights of sets, and the meters that are certain.

    Parameters
    ----------
    problems
        The problem under each model of the loads.
    found
        Costs of the sets under each model, by their bytes.
    plain : (q,)
        As in `Identification`: no other faults are certain.
    """
    every = [(cost, k, key) for k, each in enumerate(found) for key, cost in each.items()]
    least = min(cost for cost, _, _ in every)
    weights = np.exp(-0.5 * (np.array([cost for cost, _, _ in every]) - least))
    kept = np.flatnonzero(weights >= BELIEVED * weights.sum()).tolist()
    every = sorted(every[k] for k in kept)
    weight = np.exp(-0.5 * (np.array([cost for cost, _, _ in every]) - least))
    weight /= weight.sum()
    chosen = sets_of([key for *_, key in every], problems[0].y.size)
    model = np.array([k for _, k, _ in every])
    named = _certain(chosen, weight, plain)[: problems[0].meters]
    return Identification(chosen, model, weight, named, problems, plain)


def extended(found: Identification, costs: Sequence[dict[bytes, float]]) -> Identification:
    """Explanations with more sets, by the costs of all: these take weight from others, and name no more."""
    out = identified(found.problems, costs, found.plain)
    return replace(out, named=found.named & out.named)


def _certain(chosen: Bools, weight: Floats, plain: Bools | None) -> Bools:
    """Faults that sets of no more than `DOUBT` are without, and that the set `plain` has, (q,)."""
    without = weight @ ~chosen < DOUBT
    return np.asarray(without if plain is None else without & plain)
