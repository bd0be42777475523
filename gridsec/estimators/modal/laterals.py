"""Neighbourhoods of meters: groups, laterals that are manipulated as a whole, and their sets with one amount.

**Groups.** Nested clusters of the members by the correlation of their voltages: on a radial feeder nearly
the subtrees. The search adds and removes them at once. `together` arranges them in a few sequences, of which
every group is a beginning.

**Laterals.** A whole lateral may be manipulated at once, with some exceptions: such a set has the penalty of
`coded`, if that is less than that of its number of meters.

**One amount.** Meters that are off by nearly one amount need one size instead of k. A descent by independent
amounts does not find them: one amount at a time, none is worth its penalty. `OneAmount` descends with one
amount for all, from the best set and from the laterals with the best fit, in step. A change of a set by one
meter costs O(1).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import inf, log
from typing import Self

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.special import gammaln

from gridsec.arrays import Bools, Floats, Ints, frozen
from gridsec.estimators.modal.costs import BELIEVED, SearchProblem, informed, penalties, similar
from gridsec.estimators.modal.model import Modes

GAIN = 1e-9
"""Least change of the cost that counts, 1: rounding."""


def coded(sets: Bools, laterals: Floats, read: Bools) -> Floats:
    """Penalties of sets of meters, by their number or as a lateral with exceptions, (k,).

    A manipulation of a whole lateral, as by its concentrator, with i members left out and o other meters, has

        2 log G + 2 log binom(|g|, i) + 2 log binom(p - |g|, o)

    for G laterals g. The least of these and of `penalties` counts, for sets of at most a third.

    Parameters
    ----------
    sets : (k, p)
        The sets.
    laterals : (G, p)
        Members of the laterals, those with readings.
    read : (p,)
        Meters with readings: others are no exceptions.
    """
    count = np.count_nonzero(sets, axis=1)
    out, sets, p = penalties(read.size)[count], sets & read, int(np.count_nonzero(read))
    if not len(laterals):
        return np.asarray(out)
    count = np.count_nonzero(sets, axis=1)
    size = laterals.sum(axis=1).astype(np.intp)
    inside = (sets @ laterals.T).astype(np.intp)
    choices = _log_binomials(p)
    of_lateral = choices[size, size - inside] + choices[p - size, count[:, None] - inside]
    whole = 2.0 * (log(len(laterals)) + of_lateral.min(axis=1))
    return np.asarray(np.where(count <= max(1, read.size // 3), np.minimum(out, whole), out))


def excess(sets: Bools, laterals: Floats, read: Bools) -> Floats:
    """Excess of the penalties by numbers of meters over `coded`, (k,)."""
    meters = sets[:, : read.size]
    return np.asarray(penalties(read.size)[np.count_nonzero(meters, axis=1)] - coded(meters, laterals, read))


@lru_cache(maxsize=16)
def _log_binomials(p: int) -> Floats:
    """Logarithms of binom(n, k) for n and k up to p, (p + 1, p + 1); infinite for k above n."""
    n, k = np.ogrid[: p + 1, : p + 1]
    with np.errstate(invalid="ignore"):
        return frozen(
            np.where(k > n, inf, gammaln(n + 1.0) - gammaln(k + 1.0) - gammaln(np.maximum(n - k, 0) + 1.0))
        )


class OneAmount:
    """Sets of meters with one amount each, and the fits of all sets near them. n sets of k meters.

    The score and the information of the amount are ``a = 1' y_J`` and ``b = 1' F_JJ 1``:

        fit(J) = -a^2 / (b + 1 / s^2) + log(1 + s^2 b)

    Parameters
    ----------
    y, F : (k,), (k, k)
        Scores and information of the meters.
    s2
        Prior variance s^2 of the amounts.
    inside : (n, k)
        The sets.
    """

    def __init__(self, y: Floats, F: Floats, s2: float, inside: Bools) -> None:
        self.y, self.F, self.s2, self.inside = y, F, s2, inside.copy()
        self.own, self.rows = F.diagonal(), inside @ F
        self.a, self.b = inside @ y, np.vecdot(self.rows, inside)
        self.count = np.count_nonzero(inside, axis=1)

    def fit(self, a: Floats, b: Floats) -> Floats:
        """Fits of sets with scores a and information b."""
        b = np.maximum(b, 0.0)
        return np.asarray(np.log1p(self.s2 * b) - a * a / (b + 1.0 / self.s2))

    def moved(self) -> tuple[Ints, Floats]:
        """Change of the numbers by toggling each meter, 1 or -1, and the fits after it, (n, k)."""
        sign = np.where(self.inside, -1, 1)
        b = self.b[:, None] + 2.0 * sign * self.rows + self.own
        return sign, self.fit(self.a[:, None] + sign * self.y, b)

    @property
    def cost(self) -> Floats:
        """Costs of the sets, (n,)."""
        return self.fit(self.a, self.b)

    def toggled(self) -> Floats:
        """Costs after toggling each meter, (n, k)."""
        return self.moved()[1]

    def descend(self) -> Self:
        """Lower the costs by single meters until none of them helps any set."""
        cost, every = self.cost, np.arange(len(self.inside))
        for _ in range(4 * self.y.size):
            one = self.toggled()
            j = one.argmin(axis=1)
            least = one[every, j]
            at = np.flatnonzero(least < cost - GAIN)
            if not at.size:
                break
            self.toggle(at, j[at])
            cost[at] = least[at]
        return self

    def toggle(self, at: Ints, j: Ints) -> None:
        """Add meters j (m,) to the sets `at` (m,), or remove them; each set once."""
        sign = np.where(self.inside[at, j], -1, 1)
        self.a[at] += sign * self.y[j]
        self.b[at] += 2.0 * sign * self.rows[at, j] + self.own[j]
        self.rows[at] += sign[:, None] * self.F[j]
        self.count[at] += sign
        self.inside[at, j] ^= True


class Common(OneAmount):
    """Laterals with exceptions that are off by one amount each, and the costs of all sets near them.

    The cost is the fit with the penalty of `coded` for the lateral, without that of its choice, or with that
    of the number of meters.

    Parameters
    ----------
    problem
        The problem.
    laterals : (n, p)
        Members of the lateral of each set; none: the penalty of the number counts.
    inside : (n, p)
        The sets.
    """

    def __init__(self, problem: SearchProblem, laterals: Bools, inside: Bools) -> None:
        p = problem.meters
        super().__init__(problem.y[:p], problem.F[:p, :p], float(problem.std[0]) ** 2, inside)
        self.penalty, self.laterals = penalties(p), laterals
        self.size, self.choices = np.count_nonzero(laterals, axis=1), _log_binomials(p)
        self.read = informed(problem)
        self.others = np.count_nonzero(self.read & ~laterals, axis=1)
        self.kept = np.count_nonzero(inside & laterals, axis=1)

    def _charged(self, fit: Floats, count: Ints, kept: Ints) -> Floats:
        """Costs by fits, numbers of meters, and numbers of those of the laterals, (n, l) each."""
        size, others = self.size[:, None], self.others[:, None]
        choice = 2.0 * (self.choices[size, size - kept] + self.choices[others, count - kept])
        out = fit + np.where(size > 0, choice, self.penalty[count])
        return np.where(count > 0, out, inf)

    @property
    def cost(self) -> Floats:
        """Costs of the sets, without those of the choice of the laterals, (n,)."""
        return self._charged(super().cost[:, None], self.count[:, None], self.kept[:, None])[:, 0]

    def toggled(self) -> Floats:
        """Costs after toggling each meter, (n, p)."""
        sign, fit = self.moved()
        out = self._charged(fit, self.count[:, None] + sign, self.kept[:, None] + sign * self.laterals)
        return np.where(self.read, out, inf)

    def toggle(self, at: Ints, j: Ints) -> None:
        """Add meters, or remove them."""
        self.kept[at] += self.laterals[at, j] * np.where(self.inside[at, j], -1, 1)
        super().toggle(at, j)


def in_common(problem: SearchProblem, laterals: Floats, best: Bools) -> Bools:
    """Sets of meters that are off by nearly one amount, with those that differ by one meter, (k, q).

    Parameters
    ----------
    problem
        The problem.
    laterals : (G, p)
        Members of the laterals.
    best : (q,)
        The best set with independent amounts.
    """
    p, out = problem.meters, dict[bytes, Bools]()
    some = np.zeros((0, p), dtype=np.bool_)
    starts = (best[None, :p] & informed(problem))[: int(best[:p].any())]
    if len(laterals):
        a, b = laterals @ problem.y[:p], ((laterals @ problem.F[:p, :p]) * laterals).sum(axis=1)
        first = a * a / (np.maximum(b, 0.0) + problem.std[0] ** -2.0)
        some = laterals[np.argsort(-first, kind="stable")[:_COMMON]] > 0.0
    end = Common(problem, np.vstack([np.zeros_like(starts), some]), np.vstack([starts, some])).descend()
    near = end.toggled() < (end.cost - 2.0 * log(BELIEVED))[:, None]
    for inside, others in zip(end.inside, near, strict=True):
        for j in (-1, *np.flatnonzero(others)):
            chosen = np.zeros(problem.y.size, dtype=np.bool_)
            chosen[:p] = inside
            if j >= 0:
                chosen[j] = not chosen[j]
            out[chosen.tobytes()] = chosen
    return np.stack(list(out.values())) if out else np.zeros((0, problem.y.size), dtype=np.bool_)


_COMMON = 8
"""Number of laterals from which a descent with one amount starts: those with the best fit."""


def groups(modes: Modes) -> tuple[Ints, ...]:
    """Groups of neighbours of at most half of the members."""
    return tuple(each for each in clusters(modes) if each.size <= modes.size // 2)


def clusters(modes: Modes) -> tuple[Ints, ...]:
    """Nested clusters of members by the correlation of their voltages, O(t^2 log t); the last has all.

    Any network has them; on a radial feeder they are nearly the subtrees.
    """
    if modes.size < _FEWEST:
        return ()
    S = modes.model.loads(modes.at)
    var = S.diagonal()
    # Squared distance of two voltages: the variance of their difference.
    distance = np.sqrt(np.maximum(var[:, None] + var - 2.0 * S, 0.0))
    tree = linkage(distance[np.triu_indices(modes.size, 1)], method="average")
    inside: list[Ints] = [np.array([k]) for k in range(modes.size)]
    for one, other in tree[:, :2].astype(np.intp):
        inside.append(np.sort(np.concatenate([inside[one], inside[other]])))
    return tuple(inside[modes.size :])


_FEWEST = 3

Groups = tuple[tuple[Ints, Bools, Bools], ...]
"""Sequences of meters: members, places in use, and places where a group ends, (k, g) each."""


def together(groups: Sequence[Ints]) -> Groups:
    """Sequences of which all groups are beginnings, those of similar lengths together.

    A group is continued by the smallest group around it, unless a larger group in that one is. With nested
    groups, the sequences are few, and most of them are short.

    Parameters
    ----------
    groups
        Groups of meters.
    """
    chains, last = list[tuple[list[int], list[int]]](), list[set[int]]()
    for each in sorted((set(one.tolist()) for one in groups), key=len):
        # The largest group inside is continued: it was added last.
        at = max((k for k, one in enumerate(last) if one <= each), key=lambda k: len(last[k]), default=None)
        if at is None:
            at = len(chains)
            chains.append(([], []))
            last.append(set())
        members, ends = chains[at]
        members += sorted(each - last[at])
        ends.append(len(members) - 1)
        last[at] = each
    out = list[tuple[Ints, Bools, Bools]]()
    for some in similar([len(each) for each, _ in chains]):
        at_, inside = filled([np.array(chains[k][0]) for k in some])
        final = np.zeros_like(inside)
        for row, k in enumerate(some):
            final[row, chains[k][1]] = True
        out.append((at_, inside, final))
    return tuple(out)


def filled(sets: Sequence[Ints]) -> tuple[Ints, Bools]:
    """Members of sets, filled up to the same number, and where they are members, (k, n) each."""
    members = np.zeros((len(sets), max(each.size for each in sets)), dtype=np.intp)
    inside = np.zeros(members.shape, dtype=np.bool_)
    for k, each in enumerate(sets):
        members[k, : each.size], inside[k, : each.size] = each, True
    return members, inside
