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
from dataclasses import dataclass, field
from math import inf

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.estimators.modal.alike import Alike
from gridsec.estimators.modal.costs import (
    SearchProblem,
    Tableau,
    among,
    common_cost,
    informed,
    mean_likelihood,
    padded,
)
from gridsec.estimators.modal.laterals import clusters, coded, similar
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.search import ALIKE, Identification, costs_of, extended

REFLECTED = 0.01
"""Weight from which on an explanation has mirror images, 1: that of reported explanations."""
STAYS = 0.003
"""The same for sets of an earlier search, 1: an image does not vanish where its set loses some weight."""
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
    before = set() if known is None else {each.tobytes() for each in known}
    for k in np.flatnonzero(found.weight >= STAYS).tolist():
        if found.weight[k] < REFLECTED and found.chosen[k].tobytes() not in before:
            continue
        cost = found_by[int(found.model[k])]
        own = cost[found.chosen[k].tobytes()]
        for image, more in _images(found.problems[int(found.model[k])], found.chosen[k], near, masked):
            key = image.tobytes()
            if own + more < cost.get(key, np.inf):
                cost[key], likelier = own + more, True
    return extended(found, found_by) if likelier else found


def _images(
    problem: SearchProblem, chosen: Bools, near: Neighbourhoods, masked: Bools
) -> Iterator[tuple[Bools, float]]:
    """Mirror images of a set, (q,), and their costs beyond its own."""
    p, b = near.phases.shape
    read = informed(problem)
    likelihood = _Likelihood(problem, chosen)
    for phase in range(b):
        image, column = _of_phase(chosen, near, phase, read, masked)
        if image is not None:
            more = 0.0
            if not chosen[phase - b]:
                both = coded(
                    np.stack([chosen[:p], image[:p]]), (near.laterals & read).astype(np.float64), read
                )
                more = float(both[1] - both[0] + problem.charge[image].sum() - problem.charge[chosen].sum())
            yield image, max(more, 0.0) + _apart(likelihood, chosen & image, column)
    # The meters outside of a lateral are a neighbourhood within the promise. A majority beside the busbar's
    # meter is no image: the level of all meters is unknown there.
    inside, outside = near.laterals & read, ~near.laterals & read
    few, others = (
        np.count_nonzero((each ^ chosen[:p]) | masked, axis=1) <= near.most for each in (inside, outside)
    )
    busbar = np.count_nonzero(chosen[-b:])
    kept = _manipulated(chosen, masked, b) <= near.most
    laterals = np.vstack([inside[few | (busbar == 0)], outside[kept & others]])
    sets = np.unique(np.hstack([laterals & ~chosen[:p], laterals & chosen[:p]]), axis=0)
    sets = sets[sets[:, :p].any(axis=1) & sets[:, p:].any(axis=1)]
    rest = np.tile(chosen, (len(sets), 1))
    rest[:, :p] &= ~sets[:, p:]
    own = likelihood(rest, sets[:, p:])
    alike = own - likelihood.own <= APART
    rest, own, others = rest[alike], np.minimum(likelihood.own, own[alike]), sets[alike, :p]
    for powers in (True, False) if any_of(chosen[p:-b]) else (True,):
        dropped = 0.0
        if not powers:
            dropped = float(problem.charge[p:-b] @ chosen[p:-b])
            rest[:, p:-b] = False
        images, more_of = rest.copy(), likelihood(rest, others) - own - dropped
        images[:, :p] |= others
        yield from zip(images, more_of.tolist(), strict=True)


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


def _manipulated(chosen: Bools, masked: Bools, phases: int) -> int:
    """Number of manipulated meters that counts in the promise: with masked meters, or with the busbar's."""
    own = chosen[: masked.size]
    return int(
        max(
            np.count_nonzero(own | masked),
            np.count_nonzero(own) + np.count_nonzero(chosen[chosen.size - phases :]),
        )
    )


def _apart(likelihood: _Likelihood, rest: Bools, column: Bools) -> float:
    """Cost of one amount in place of several, at least 0; infinite for `APART`."""
    more = float(likelihood(rest[None], column[None])[0]) - likelihood.own
    return max(more, 0.0) if more <= APART else inf


class _Likelihood:
    """L of parts of a set (q,) with one more column, with the priors of the amounts that count for the set.

    A column x is a row beside the tableau T of the set. Without the faults A of the set, the score, the
    information and the pull of x lose ``T_xA T_AA^-1 T_A``, as those of the set do.
    """

    def __init__(self, problem: SearchProblem, chosen: Bools) -> None:
        self.problem, self.chosen = problem, chosen
        several = np.count_nonzero(chosen[: problem.meters]) > 1
        self.shares: tuple[float, ...] = (0.0, ALIKE) if several else (0.0,)
        few, every = among(problem, chosen), np.ones(int(np.count_nonzero(chosen)), dtype=np.bool_)
        starts = {share: Alike(few, share) if share else Tableau(few) for share in self.shares}
        self.tableaus = {share: start.pivot(every) for share, start in starts.items()}
        own = np.array([self._whole(share) for share in self.shares])
        # A prior that is far worse for the set is so for its images.
        likely = own <= own.min() + APART
        self.shares = tuple(np.array(self.shares)[likely].tolist())
        self.own = float(mean_likelihood(own[likely]))

    def _whole(self, share: float) -> float:
        """L of the set."""
        tableau = self.tableaus[share]
        out = tableau.whole - float(tableau.penalty[tableau.count] + tableau.problem.charge.sum())
        if isinstance(tableau, Alike):
            out += float(self.problem.charge.max(initial=0.0)) - tableau.charge
        return out

    def __call__(self, rest: Bools, columns: Bools) -> Floats:
        """L of faults `rest` (n, q) and of meters `columns` (n, p) with one amount, (n,)."""
        return mean_likelihood(self._each(rest, columns))

    def _each(self, rest: Bools, columns: Bools) -> Floats:
        """L with each prior that counts, (s, n); one meter has no amount in common with others."""
        several = np.count_nonzero(rest[:, : self.problem.meters], axis=1) > 1
        shares = {share for share in self.shares if several.any()}
        each = {s: self._with(rest, columns, s) for s in (shares if several.all() else shares | {0.0})}
        plain = each.get(0.0, np.zeros(len(rest)))
        return np.stack([np.where(several, each.get(share, plain), plain) for share in self.shares])

    def _with(self, rest: Bools, columns: Bools, share: float) -> Floats:
        """L with a share of the variance of the meters in common, (n,)."""
        problem, tableau, p = self.problem, self.tableaus[share], self.problem.meters
        q, r, s2 = len(tableau.order), len(tableau.rows), float(problem.std[0]) ** 2
        lacks, side = ~rest[:, self.chosen], columns @ problem.F[:p]
        own = side[:, self.chosen]
        x = -own @ tableau.beside[:q]
        # Entries of the column with the borders and with itself.
        beside = -x @ tableau.rows.T
        beside[:, 0] += columns @ problem.y[:p]
        pivot = 1.0 / s2 + (side[:, :p] * columns).sum(axis=1) - np.vecdot(x, own)
        meters = np.count_nonzero(rest[:, :p], axis=1)
        out = np.full(len(rest), tableau.cost - float(tableau.penalty[tableau.count]))
        out -= tableau.problem.charge.sum() + lacks @ tableau.size
        information = meters / (1.0 - share) + tableau.borders[q + r - 1, r - 1]
        score = np.full(len(rest), -tableau.borders[q, r - 1])
        for places in similar(np.count_nonzero(lacks, axis=1).tolist()):
            at, inside = padded(lacks[places])
            A, v = tableau.within(at, inside), tableau.borders[at].transpose(0, 2, 1)
            v = np.concatenate([v, np.take_along_axis(x[places], at, axis=1)[:, None]], axis=1)
            v *= inside[:, None, :]
            inner = v @ np.linalg.solve(A, v.transpose(0, 2, 1))
            out[places] += np.linalg.slogdet(A)[1] - inner[:, 0, 0]
            score[places] += inner[:, 0, r - 1]
            information[places] -= inner[:, r - 1, r - 1]
            beside[places] -= inner[:, :r, r]
            pivot[places] -= inner[:, r, r]
        pull = beside[:, 0]
        out += np.log(s2 * pivot) - pull * pull / pivot
        if share:
            left = beside[:, 1]
            score, information = score + left * pull / pivot, information - left * left / pivot
            out += common_cost(share, score, information) + problem.charge.max(initial=0.0)
        return np.asarray(out)
