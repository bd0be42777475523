"""Mirror images of explanations: the believed meters of a neighbourhood accused, not the accused ones.

Let J be a set of faults and g a neighbourhood: meters of a lateral, or of a phase with the busbar's meter.
Where the meters ``J & g`` are off by one amount x, the meters ``g - J`` differ from them by x, and only what
lies outside of g tells which of both are right. Unread powers, unlearned classes and large loads hide that.
No prior of meters may decide then: the mirror image has the penalty of J,

    cost(J') = cost(J) + L(J') - min(L(J), L_one(J)),     L = -y' (F + V^-1)^-1 y + log det(1 + V F)

with L(J') and L_one(J) of one amount for the exchanged meters. So readings alone decide between both. L is
the mean of the likelihoods with independent amounts V and with amounts alike, as in `search`, for all sets.

**Laterals.** ``J' = J xor g``, with and without the false powers of J, for every group of neighbours but the
whole feeder, and for all others where J' has no more meters than are promised. A majority of a lateral that
agrees is believed only as far as others confirm it.

**Phases.** A phase of the busbar off by x, with meters A of the phase off by -x, has the same residuals as
the other meters of the phase off by -x: L is the same. The promise "at most M manipulated meters" excludes
images with more meters where J keeps it, the busbar's meter included. From meters to the busbar's meter with
others, J' has its own penalty, if that is larger: one meter that is off is no reason to doubt all others of
its phase.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Ints, any_of, submatrix
from gridsec.estimators.modal.costs import SearchProblem, informed, mean_likelihood
from gridsec.estimators.modal.laterals import clusters, coded
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.search import ALIKE, Identification, costs_of, identified

REFLECTED = 0.01
"""Weight from which on an explanation has mirror images, 1: that of reported explanations."""
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
    """

    laterals: Bools = field(repr=False)
    phases: Bools
    most: int


def neighbourhoods(modes: Modes, most: int) -> Neighbourhoods:
    """Neighbourhoods of the members of some modes, with the promised number of manipulated ones."""
    some = [each for each in clusters(modes) if each.size < modes.size]
    laterals = np.zeros((len(some), modes.size), dtype=np.bool_)
    for k, each in enumerate(some):
        laterals[k, each] = True
    return Neighbourhoods(laterals, modes.phases > 0.0, most)


def reflected(found: Identification, near: Neighbourhoods) -> Identification:
    """Explanations with the mirror images of those that weigh at least `REFLECTED`."""
    found_by, likelier = costs_of(found), False
    for k in np.flatnonzero(found.weight >= REFLECTED).tolist():
        cost = found_by[int(found.model[k])]
        own = cost[found.chosen[k].tobytes()]
        for image, more in _images(found.problems[int(found.model[k])], found.chosen[k], near):
            key = image.tobytes()
            if own + more < cost.get(key, np.inf):
                cost[key], likelier = own + more, True
    return identified(found.problems, found_by, found.plain) if likelier else found


def _images(problem: SearchProblem, chosen: Bools, near: Neighbourhoods) -> Iterator[tuple[Bools, float]]:
    """Mirror images of a set, (q,), and their costs beyond its own."""
    p, b = near.phases.shape
    read = informed(problem)
    likelihood = _Likelihood(problem, chosen)
    for phase in range(b):
        image, column = _of_phase(chosen, near, phase, read)
        if image is not None:
            more = 0.0
            if not chosen[phase - b]:
                both = coded(
                    np.stack([chosen[:p], image[:p]]), (near.laterals & read).astype(np.float64), read
                )
                more = float(both[1] - both[0] + problem.charge[image].sum() - problem.charge[chosen].sum())
            yield image, max(more, 0.0) + _apart(likelihood, chosen & image, column)
    done = set[bytes]()
    # What lies outside of a lateral is one, too: that of more meters than are promised has no image.
    outside = ~near.laterals & read
    few = np.count_nonzero(outside ^ chosen[:p], axis=1) <= near.most
    for lateral in np.vstack([near.laterals & read, outside[few]]):
        accused, others = lateral & chosen[:p], lateral & ~chosen[:p]
        key = others.tobytes() + accused.tobytes()
        if key in done or not any_of(accused) or not any_of(others):
            continue
        done.add(key)
        rest = chosen.copy()
        rest[:p] &= ~lateral
        own = likelihood(rest, accused)
        if own - likelihood.own > APART:
            continue
        for powers in (True, False) if any_of(rest[p:-b]) else (True,):
            dropped = 0.0
            if not powers:
                dropped, rest = float(problem.charge[p:-b] @ rest[p:-b]), rest.copy()
                rest[p:-b] = False
            image = rest.copy()
            image[:p] |= others
            yield image, likelihood(rest, others) - min(likelihood.own, own) - dropped


def _of_phase(chosen: Bools, near: Neighbourhoods, phase: int, read: Bools) -> tuple[Bools | None, Bools]:
    """Mirror image by one phase of the busbar, None for none, and the meters that are off in both, (p,)."""
    p, b = near.phases.shape
    of_phase, at = near.phases[:, phase] & read, chosen.size - b + phase
    accused, others = chosen[:p] & of_phase, of_phase & ~chosen[:p]
    image = chosen.copy()
    image[:p] = (chosen[:p] & ~of_phase) | others
    image[at] = not chosen[at]
    own = int(np.count_nonzero(chosen[:p]) + np.count_nonzero(chosen[-b:]))
    if own <= near.most < np.count_nonzero(image[:p]):
        return None, accused
    column = others if chosen[at] else accused
    return (image if any_of(column) else None), column


def _apart(likelihood: _Likelihood, rest: Bools, column: Bools) -> float:
    """Cost of one amount in place of several, at least 0; infinite for `APART`."""
    more = likelihood(rest, column) - likelihood.own
    return max(more, 0.0) if more <= APART else np.inf


class _Likelihood:
    """L of sets near one, (q,), with the priors of the amounts that count for it."""

    def __init__(self, problem: SearchProblem, chosen: Bools) -> None:
        self.problem, self.charge = problem, float(problem.charge.max(initial=0.0))
        shares = {share: self._with(chosen, None, share) for share in (0.0, ALIKE)}
        least = min(shares.values())
        # A prior that is far worse for the set is so for its images.
        self.shares = [share for share, one in shares.items() if one <= least + APART]
        self.own = self._mean(shares)

    def __call__(self, rest: Bools, column: Bools) -> float:
        """L of the faults `rest` (q,) and of the meters `column` (p,) with one amount."""
        return self._mean({share: self._with(rest, column, share) for share in self.shares})

    def _mean(self, each: Mapping[float, float]) -> float:
        """L of the mean of the likelihoods with the priors that count."""
        return float(mean_likelihood(np.array([each[share] for share in self.shares])))

    def _with(self, rest: Bools, column: Bools | None, share: float) -> float:
        at = np.flatnonzero(rest)
        if np.count_nonzero(at < self.problem.meters) < 2:
            share = 0.0
        return _likelihood(self.problem, at, column, share) + (self.charge if share else 0.0)


def _likelihood(problem: SearchProblem, at: Ints, column: Bools | None, share: float = 0.0) -> float:
    """L of faults `at`, their meters with a share of the variance in common, and of one for `column` (p,)."""
    n, y, std = at.size, problem.y[at], problem.std[at]
    F = submatrix(problem.F, at, at)
    if column is not None:
        together = np.flatnonzero(column)
        side, inner = problem.F[together].sum(axis=0), F
        F = np.empty((n + 1, n + 1))
        F[:n, :n], F[n, :n], F[:n, n], F[n, n] = inner, side[at], side[at], side[together].sum()
        y, std = np.append(y, problem.y[together].sum()), np.append(std, problem.std[0])
    if not y.size:
        return 0.0
    pull, A = std * y, std[:, None] * F * std
    if share:
        # With the root R of the prior's correlation: R y and R F R.
        k = np.count_nonzero(at < problem.meters)
        own = np.sqrt(1.0 - share)
        common = (np.sqrt(1.0 - share + share * k) - own) / k
        for one in (pull, A, A.T):
            one[:k] = own * one[:k] + common * one[:k].sum(axis=0)
    A[np.diag_indices(y.size)] += 1.0
    half, found, failed = lapack.dposv(A, pull, lower=True)
    if failed:
        raise np.linalg.LinAlgError(failed)
    return float(2.0 * np.log(half.diagonal()).sum() - pull @ found)
