"""Final names: meters that searches in turn accuse, masked together or where nothing depends on it.

    final(found, before, named, streak, since, laterals, settled) -> (p,)      meters to mask
    unseen(design, effect, most, lead, off) -> bool           steps by other clocks may explain them

A search names the meters without which nothing explains the readings. The first explanation of several faults
may be a part of them: names need searches in turn, `confirmed`. A sole fault is named by one search, and two
readings: a step of the busbar is in one reading a tick early or late by clocks that differ by half a tick.
The next reading has nothing of such a fault. Its name waits for as many searches as those of several faults.

**Parts of an explanation.** Masked meters have any amounts. With N the meters to mask, of the scores y and
the information F of the others remain

    y - F_N F_NN^-1 y_N,   F - F_N F_NN^-1 F_N'

Amounts that the others have in common with those of N say nothing any more. False powers may then explain
the rest at a lower cost than the meters that the likeliest explanation has, although the whole evidence is
against such powers, or honest loads do. N is not masked where explanations with the rest of the meters of
the likeliest one weigh at least `SURE`, and less than `KEEPS` in what remains. After `WHOLE` searches in turn
N is masked in any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.measurements import SYNCHRONOUS_S
from gridsec.estimators.modal.costs import SearchProblem, informed
from gridsec.estimators.modal.laterals import excess
from gridsec.estimators.modal.replay import Reading
from gridsec.estimators.modal.search import SOME, Identification, mixed

TAP = 0.05
"""Largest step of a tap changer, squared pu: 2.5 % of the voltage."""
CONFIRM = 2
"""Readings of a sole fault before it is named, and searches in turn that accuse one of several."""
LASTS = 0.5
"""Least part of a sole fault in its last reading, 1: the reading is nearer to the fault than to none."""
SEVERAL = 4
"""Searches in turn before a meter is named beside others that are not confirmed yet."""
YOUNG = 8
"""Age of an onset up to which an explanation may leave misfit, ticks: clocks off by 3 s spread it over 6."""
WHOLE = 4 * SEVERAL
"""Searches in turn after which meters are masked even if others explain the rest without their readings."""
SURE = 0.95
"""Least weight of the rest of an explanation that its masked meters do not leave behind, 1."""
KEEPS = 0.5
"""Least weight of an explanation that is likelier than not, 1."""
FLAT = 1e-6
"""Prior information of the amounts of masked meters, in that of the prior, 1: rounding."""


def final(  # noqa: PLR0917  # two searches, and the counts of both
    found: Identification,
    before: Identification | None,
    named: Bools,
    streak: Ints,
    since: Sequence[Reading],
    laterals: Bools,
    *,
    settled: bool = True,
) -> Bools:
    """Meters to mask now, (p,).

    Parameters
    ----------
    found, before, named, streak, since, settled
        As in `confirmed`.
    laterals : (G, p)
        Members of the laterals that may be manipulated as a whole.
    """
    sure = confirmed(found, before, named, streak, since, settled=settled)
    if not any_of(sure) or streak[sure].max() >= WHOLE or separable(found, sure, laterals):
        return sure
    return np.zeros_like(sure)


def confirmed(
    found: Identification,
    before: Identification | None,
    named: Bools,
    streak: Ints,
    since: Sequence[Reading],
    *,
    settled: bool = True,
) -> Bools:
    """Meters that a search names finally, (p,).

    Parameters
    ----------
    found
        What it found.
    before
        What the search before it found at the same onset; None before the first.
    named : (p,)
        Meters that it names newly.
    streak : (p,)
        Searches in turn with each in the likeliest explanation, and replaced by no others.
    since
        Ticks since the suspected onset; none where meters are masked, and may collude with others.
    settled
        The likeliest explanation takes nearly all of the misfit away, or the onset is `YOUNG`.
    """
    sole = any_of(named) and np.count_nonzero(found.chosen[0]) == 1
    readings = sum(seen is None or all_of(seen[named]) for _, _, seen, *_ in since)
    passing = sole and before is not None and readings <= SEVERAL and _over(found, before, readings)
    if sole and not passing and readings >= CONFIRM:
        return named
    # Without a part of the meters, other faults may explain the rest, and so may what is not found yet: a few
    # more searches may name all.
    least = CONFIRM if settled and all_of(streak[named] >= CONFIRM) and not passing else SEVERAL
    return np.asarray(named & (streak >= least))


def _over(found: Identification, before: Identification, readings: int) -> bool:
    """The last of some readings has less than `LASTS` of the sole fault of the likeliest set.

    With the amounts ``x = y / F`` by n and by n - 1 readings, the last one has ``n x_n - (n - 1) x_(n-1)``.
    """
    model, at = int(found.model[0]), int(np.flatnonzero(found.chosen[0])[0])
    if model >= len(before.problems):
        # A transition is a model of the last search only.
        return False
    now, then = found.problems[model], before.problems[model]
    # Times the information of both: it is 0 before the first reading.
    last = readings * now.y[at] * then.F[at, at] - (readings - 1) * then.y[at] * now.F[at, at]
    return bool(abs(last) < LASTS * abs(then.y[at]) * now.F[at, at])


def alone(found: Identification, masked: Bools) -> Bools:
    """Masked meters that explain the readings by themselves, as the likeliest set has them, (p,).

    None where sets with other faults are likelier. Readings of masked meters are lost, and no others.

    Parameters
    ----------
    found
        What a search found.
    masked : (p,)
        The masked meters.
    """
    others = found.chosen.copy()
    others[:, : masked.size] &= ~masked
    sure = found.weight[~others.any(axis=1)].sum() >= KEEPS
    return np.asarray(masked & found.chosen[0, : masked.size] & sure)


def separable(found: Identification, which: Bools, laterals: Bools) -> bool:
    """The rest of the likeliest explanation is doubtful, or stays likely where some of its meters are masked.

    Parameters
    ----------
    found
        What a search found.
    which : (p,)
        Meters to mask.
    laterals : (G, p)
        Members of the laterals that may be manipulated as a whole.
    """
    p, model = which.size, int(found.model[0])
    rest = found.chosen[0, :p] & ~which

    def with_rest(sets: Bools) -> Bools:
        return np.asarray((sets[:, :p] >= rest).all(axis=1))

    if not any_of(rest) or found.weight[with_rest(found.chosen)].sum() < SURE:
        return True
    problem = without(found.problems[model], which)
    sets = found.chosen[found.model == model].copy()
    sets[:, :p] &= ~which
    sets = np.array(list({each.tobytes(): each for each in sets}.values())[:SOME])
    read = informed(problem)
    costs = mixed(problem, sets) - excess(sets, (laterals & read).astype(np.float64), read)
    weight = np.exp(-0.5 * (costs - costs.min()))
    return bool(weight[with_rest(sets)].sum() >= KEEPS * weight.sum())


def without(problem: SearchProblem, which: Bools) -> SearchProblem:
    """The problem where some meters (p,) have any amounts: nothing is known of them.

    Parameters
    ----------
    problem
        The problem.
    which : (p,)
        The meters.
    """
    N, rest = np.flatnonzero(which), np.ones(problem.y.size, dtype=np.bool_)
    rest[N] = False
    F = problem.F[np.ix_(N, N)] + np.diag(FLAT * problem.std[N] ** -2.0)
    known = np.linalg.solve(F, np.column_stack([problem.F[N], problem.y[N]]))
    left = problem.F - problem.F[:, N] @ known[:, :-1]
    return replace(
        problem,
        y=np.where(rest, problem.y - problem.F[:, N] @ known[:, -1], 0.0),
        F=np.where(np.logical_and.outer(rest, rest), left, 0.0),
    )


def unseen(design: FrontDesign, effect: Floats, most: Floats, lead: Floats, off: Floats) -> bool:
    """Steps that other clocks do not show yet may explain a false reading.

    Loads of the size of their connections, or a step of the tap changer, move the voltage by more than the
    reading is off. Clocks without a measured offset differ by less than a tick: one load at a time.

    Parameters
    ----------
    design
        The front end.
    effect, most : (n, q), (q,)
        Effect of the faults on all places, and the largest connected powers.
    lead, off : (p,)
        Clock offsets, s, and amounts of false readings, squared pu.
    """
    powers = lead.size + design.plant.meters
    power = np.abs(effect[design.prior.meters][:, powers]) * most[powers]
    ahead = np.minimum(lead, 0.0)[:, None] + SYNCHRONOUS_S < lead
    step = np.where(ahead, power, 0.0).sum(axis=1)
    step = np.where(lead < SYNCHRONOUS_S, np.maximum(step, np.maximum(power.max(axis=1), TAP)), step)
    false, beyond = off != 0.0, np.abs(off) > step
    return not any_of(false) or any_of(false & ~beyond)
