"""Mirror images of explanations: the believed meters of a neighbourhood accused, not the accused ones.

Let J be a set of faults and g a neighbourhood: meters of a lateral, or of a phase with the busbar's meter.
Where the meters ``J & g`` are off by one amount x, the meters ``g - J`` differ from them by x, and only what
lies outside of g tells which of both are right. Unread powers, unlearned classes and large loads hide that.
No prior of meters may decide then: the mirror image has the penalty of J,

    cost(J') = cost(J) + L(J') - min(L(J), L_one(J)),     L = -y' (F + V^-1)^-1 y + log det(1 + V F)

with L(J') and L_one(J) of one amount for the exchanged meters. So readings alone decide between both. L is
the mean of the likelihoods with independent amounts V and with amounts alike, as in `search`, for all sets.

**Laterals.** ``J' = J xor g``, with and without the false powers of J, for every group of neighbours but the
whole feeder, and for all other meters where J and J' keep the promise. A majority of a lateral that agrees is
believed only as far as others confirm it. Beside the busbar's meter J' has at most M meters.

**Phases.** A phase of the busbar off by x, with meters A of the phase off by -x, has the same residuals as
the other meters of the phase off by -x: L is the same. The promise "at most M manipulated meters" excludes
images with more meters where J keeps it, the busbar's meter included. Masked meters count in both numbers.
From meters to the busbar's meter with others, J' has its own penalty, if that is larger: one meter that is
off is no reason to doubt all others of its phase.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from math import inf

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of, keys_of
from gridsec.estimators.modal.costs import SearchProblem, among, costs, informed, mean_likelihood, penalties
from gridsec.estimators.modal.laterals import clusters, coded
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.search import ALIKE, Identification, costs_of, extended

REFLECTED = 0.01
"""Weight from which on an explanation has mirror images, 1: that of reported explanations."""
STAYS = 0.003
"""The same for sets of an earlier search, 1: an image does not vanish where its set loses some weight."""
TOGETHER = 512
"""Sets that are weighed together, 1: their columns have as many products with each other."""
APART = 20.0
"""Cost of one amount in place of several from which on meters are not off alike, 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhoods:
    """Neighbourhoods of p meters.

    Attributes
    ----------
    laterals : (g, p)
        Members of the groups of neighbours, without the whole feeder.
    phases : (p, b)
        Meters of each phase of the busbar.
    most
        Largest number of manipulated meters that is promised.
    powers : (p,)
        Fault of the active power of each meter's customer.
    """

    laterals: Bools = field(repr=False)
    phases: Bools
    most: int
    powers: Ints


def neighbourhoods(modes: Modes, most: int, customers: Ints | None = None) -> Neighbourhoods:
    """Neighbourhoods of the members of some modes; customer of each (p,), None for the same order."""
    some = [each for each in clusters(modes) if each.size < modes.size]
    laterals = np.zeros((len(some), modes.size), dtype=np.bool_)
    for k, each in enumerate(some):
        laterals[k, each] = True
    customers = np.arange(modes.size) if customers is None else customers
    return Neighbourhoods(laterals, modes.phases > 0.0, most, modes.size + customers)


def reflected(
    found: Identification, near: Neighbourhoods, masked: Bools, known: Bools | None = None
) -> Identification:
    """Explanations with the mirror images of those that weigh at least `REFLECTED`, or `STAYS` if known.

    Parameters
    ----------
    found
        The explanations.
    near
        Neighbourhoods, and the largest number of manipulated meters that is promised.
    masked : (p,)
        Masked meters: they count in that number.
    known : (k, q)
        Explanations of an earlier search.
    """
    found_by, likelier = costs_of(found), False
    before = set() if known is None else set(keys_of(known))
    stays = np.array([each in before for each in keys_of(found.chosen)])
    some = found.weight >= np.where(stays, STAYS, REFLECTED)
    for model in np.unique(found.model[some]).tolist():
        sets, cost = found.chosen[some & (found.model == model)], found_by[model]
        for of, images in zip(sets, _images(found.problems[model], sets, near, masked), strict=True):
            own = cost[of.tobytes()]
            for image, more in images:
                key = image.tobytes()
                if own + more < cost.get(key, inf):
                    cost[key], likelier = own + more, True
    return extended(found, found_by) if likelier else found


def _images(
    problem: SearchProblem, sets: Bools, near: Neighbourhoods, masked: Bools
) -> list[list[tuple[Bools, float]]]:
    """Mirror images of each of some sets (k, q), and their costs beyond its own."""
    read, (p, b) = informed(problem), near.phases.shape
    likelihood, out = _Likelihood(problem, sets), list[list[tuple[Bools, float]]]([] for _ in sets)
    phases = list(_of_phases(problem, sets, near, read, masked))
    rows, parts, inside, outside = _of_laterals(sets, near, read, masked)
    # One amount of the meters that are off, in place of theirs.
    at = np.concatenate([np.array([k for k, *_ in phases], dtype=np.intp), rows])
    rest = np.vstack([*(sets[k] & image for k, image, *_ in phases), parts])
    more = likelihood(at, rest, np.vstack([*(column for *_, column in phases), inside])) - likelihood.own[at]
    for (k, image, less, _), one in zip(phases, more, strict=False):
        out[k].append((image, less + max(float(one), 0.0) if one <= APART else inf))
    alike = more[len(phases) :] <= APART
    rows, parts, outside = rows[alike], parts[alike], outside[alike]
    own = likelihood.own[rows] + np.minimum(more[len(phases) :][alike], 0.0)
    # Each image with the false powers of its set, and without them.
    without = np.flatnonzero(parts[:, p:-b].any(axis=1))
    dropped = np.concatenate([np.zeros(rows.size), parts[without, p:-b] @ problem.charge[p:-b]])
    every = np.concatenate([np.arange(rows.size), without])
    images = parts[every]
    images[rows.size :, p:-b] = False
    more = likelihood(rows[every], images, outside[every]) - own[every] - dropped
    images[:, :p] |= outside[every]
    for k, image, one in zip(rows[every].tolist(), images, more.tolist(), strict=True):
        out[k].append((image, one))
    return out


def _of_phases(
    problem: SearchProblem, sets: Bools, near: Neighbourhoods, read: Bools, masked: Bools
) -> Iterator[tuple[int, Bools, float, Bools]]:
    """Number of a set, its image by a phase of the busbar, the charge of that, and the meters off in both."""
    p, b = near.phases.shape
    laterals = (near.laterals & read).astype(np.float64)
    for k, phase in product(range(len(sets)), range(b)):
        chosen = sets[k]
        image, column = _of_phase(chosen, near, phase, read, masked)
        if image is None:
            continue
        more = 0.0
        if not chosen[phase - b]:
            both = coded(np.stack([chosen[:p], image[:p]]), laterals, read)
            more = float(both[1] - both[0] + problem.charge[image].sum() - problem.charge[chosen].sum())
        yield k, image, max(more, 0.0), column


def _of_phase(
    chosen: Bools, near: Neighbourhoods, phase: int, read: Bools, masked: Bools
) -> tuple[Bools | None, Bools]:
    """Mirror image by one phase of the busbar, None for none, and the meters that are off in both, (p,)."""
    p, b = near.phases.shape
    of_phase, at = near.phases[:, phase] & read, chosen.size - b + phase
    accused, others = chosen[:p] & of_phase, of_phase & ~chosen[:p]
    image = chosen.copy()
    image[:p] = (chosen[:p] & ~of_phase) | others
    image[at] = not chosen[at]
    own = _manipulated(chosen, masked, b)
    if own <= near.most < np.count_nonzero(image[:p] | masked):
        return None, accused
    column = others if chosen[at] else accused
    return (image if any_of(column) else None), column


def _of_laterals(
    sets: Bools, near: Neighbourhoods, read: Bools, masked: Bools
) -> tuple[Ints, Bools, Bools, Bools]:
    """Sets and laterals with accused and with other meters.

    Number of the set, its faults elsewhere (n, q), accused meters and others, (n, p) each. The meters outside
    of a lateral are a neighbourhood within the promise. A majority beside the busbar's meter is no image: the
    level of all meters is unknown there.
    """
    p, b = near.phases.shape
    inside, outside = near.laterals & read, ~near.laterals & read
    few, others = (_exchanged(sets[:, :p], each, masked) <= near.most for each in (inside, outside))
    busbar = np.logical_or.reduce(sets[:, -b:], axis=1)
    kept = _manipulated(sets, masked, b) <= near.most
    (row, at), (other, apart) = np.nonzero(few | ~busbar[:, None]), np.nonzero(kept[:, None] & others)
    rows, region = np.concatenate([row, other]), np.vstack([inside[at], outside[apart]])
    both = region & sets[rows, :p], region & ~sets[rows, :p]
    some = np.flatnonzero(both[0].any(axis=1) & both[1].any(axis=1))
    keys = np.hstack([rows[some, None], *(np.packbits(each[some], axis=1) for each in both)])
    some = some[np.unique(keys, axis=0, return_index=True)[1]]
    rows, accused, others = rows[some], both[0][some], both[1][some]
    rest = sets[rows]
    rest[:, :p] &= ~accused
    return rows, rest, accused, others


def _exchanged(sets: Bools, regions: Bools, masked: Bools) -> Floats:
    """Numbers of meters of sets (k, p) in which the meters of regions (n, p) are exchanged, (k, n).

    Masked meters count in any case.
    """
    own, other = (each[:, ~masked].astype(np.float64) for each in (sets, regions))
    both = own.sum(axis=1)[:, None] + other.sum(axis=1) - 2.0 * own @ other.T
    return np.asarray(both + np.count_nonzero(masked))


def _manipulated(chosen: Bools, masked: Bools, phases: int) -> Ints:
    """Manipulated meters of sets (..., q) in the promise: with masked ones, or with the busbar's."""
    own, busbar = chosen[..., : masked.size], chosen[..., chosen.shape[-1] - phases :]
    both = np.count_nonzero(own, axis=-1) + np.count_nonzero(busbar, axis=-1)
    return np.asarray(np.maximum(np.count_nonzero(own | masked, axis=-1), both))


class _Likelihood:
    """L of parts of sets with one more column, with the priors of the amounts that count for each set.

    A prior that is far worse for a set is so for its images.

    Parameters
    ----------
    problem, sets
        The problem, and the sets, (k, q).
    """

    def __init__(self, problem: SearchProblem, sets: Bools) -> None:
        self.problem, every = problem, np.ones(len(sets), dtype=np.bool_)
        each = self._each(sets, np.zeros((len(sets), problem.meters), dtype=np.bool_), every)
        self.counted = each <= each.min(axis=0) + APART
        self.own = mean_likelihood(each, self.counted)

    def __call__(self, rows: Ints, rest: Bools, columns: Bools) -> Floats:
        """L of parts (n, q) of sets `rows` (n,) with meters `columns` (n, p) that have one amount, (n,)."""
        counted, out = self.counted[:, rows], np.empty(rows.size)
        for first in range(0, rows.size, TOGETHER):
            part = slice(first, first + TOGETHER)
            each = self._each(rest[part], columns[part], counted[1, part])
            out[part] = mean_likelihood(each, counted[:, part])
        return out

    def _each(self, sets: Bools, columns: Bools, alike: Bools) -> Floats:
        """L with independent amounts, and with amounts alike where these count, (2, n).

        A column is a fault of its own beside the meters; it has the largest charge, which `costs` adds for
        amounts alike. One meter has no amount in common with others.
        """
        problem, p, used = self.problem, self.problem.meters, np.logical_or.reduce(sets, axis=0)
        charge, few = float(problem.charge.max(initial=0.0)), among(problem, used)
        count = np.count_nonzero(sets[:, :p], axis=1)
        own = penalties(few.meters)[count] + sets @ problem.charge + charge
        distinct, which = np.unique(columns, axis=0, return_inverse=True)
        g, c = distinct.astype(np.float64), len(distinct)
        side = g @ problem.F[:p]
        few = replace(
            few,
            y=np.concatenate([few.y, g @ problem.y[:p]]),
            F=np.block([[few.F, side[:, used].T], [side[:, used], side[:, :p] @ g.T]]),
            std=np.append(few.std, np.full(c, problem.std[0])),
            charge=np.append(few.charge, np.full(c, charge)),
            bound=np.append(few.bound, np.full(c, inf)),
        )
        sets = np.hstack([sets[:, used], which.reshape(-1, 1) == np.arange(c)])
        plain, several = costs(few, sets), np.flatnonzero(alike & (count > 1))
        out = np.stack([plain, plain])
        if several.size:
            out[1, several] = costs(few, sets[several], ALIKE)
        return np.asarray(out - own)
