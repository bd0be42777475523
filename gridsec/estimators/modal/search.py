"""Identification: the likeliest sets of manipulated meters, by exact likelihoods of subsets.

At one onset, the scores y (q,) and the information F (q, q) of `gridsec.estimators.modal.signatures` say
everything about the amounts of q possible faults: meters, false powers, busbar. For a subset J with amounts
N(0, s_j^2), twice the negative logarithm of its posterior probability, up to a constant, is

    cost(J) = -y_J' (F_JJ + diag(1 / s_J^2))^-1 y_J + log det(I + diag(s_J^2) F_JJ) + penalty(J)
    penalty = 2 log binom(p, k) for k of p meters, plus a charge for every other fault

Every number of meters is as likely as any other, and every set of one size as any other of that size.

**Search.** The sweep operator keeps ``[F + 1 / s^2, y; y', 0]`` pivoted on J, so that the costs of all sets
that differ by one addition, removal or exchange are read off, O(q) to O(k q); a step is O(q^2). A group of
neighbours is added or removed at once. The descent starts from nothing, and from the meters that stand out
when every one of them has a variance of its own (automatic relevance determination). The prior size of the
meters' faults is then estimated from the set found, and the descent is repeated.

A whole lateral may be manipulated at once, with some exceptions: such a set has the penalty of `coded`, if
that is less. A set of meters that are off by nearly the same amount needs one size instead of k. The
likelihood of a set is the mean of that with independent amounts and that with amounts alike, which has the
charge of a false power: loads without a report move neighbours alike as well. Sets with amounts alike have a
descent of their own, with one amount for all (`Common`): one amount at a time, none is worth its penalty.

**Rivals.** Loads may change in ways that no report shows. The search is also made under each model of
`gridsec.estimators.modal.rivals`, with the cost of that model by itself. A model that is far from the best
one is not explored further. A set without meter j is looked for from the best set by removing j. The sets
that differ by one whole group are tried, and those that differ by one meter from each of the likeliest sets.
All sets met count with the weight exp(-cost / 2). A meter is named if the sets without it have together less
than `DOUBT` of the weight.

References
----------
.. [1] Goodnight, A tutorial on the SWEEP operator, The American Statistician 33, 1979.
.. [2] Chen and Chen, Extended Bayesian information criteria, Biometrika 95, 2008.
.. [3] Tipping, Sparse Bayesian learning and the relevance vector machine, JMLR 1, 2001.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import inf, log

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.linalg import blas, cho_solve, cholesky, lapack
from scipy.special import gammaln

from gridsec.arrays import Bools, Floats, Ints, frozen, submatrix
from gridsec.estimators.modal.model import Modes

DOUBT = 1e-3
"""Largest weight of all explanations without a meter that is named, 1."""
MAJORITY = 9.0
"""Least penalty of a meter beyond a third of all, in units of the cost: three standard deviations."""
BELIEVED = 1e-8
"""Weight below which a set is not kept, 1: far below `DOUBT`."""
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
"""Cost above the best one, after one change, from which on a set without a meter is not followed, 1."""
STEPS = 4
"""Largest number of steps of a descent, in meters: each may be added, removed and exchanged."""
RELEVANCE = 12
"""Iterations of the start by relevance: variances of irrelevant meters halve in each."""
STANDS_OUT = 9.0
"""Squared standard deviations from which a meter is in that start, 1."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchProblem:
    """Scores and information of q faults at one onset; the meters come first.

    Attributes
    ----------
    y : (q,)
        Scores.
    F : (q, q)
        Information.
    std : (q,)
        Prior standard deviations of the amounts.
    meters
        Number of meters, p.
    charge : (q,)
        Penalty of each fault that is not a meter, in units of the cost; 0 for meters.
    bound : (q,)
        Largest amount that is possible; infinite for none.
    """

    y: Floats
    F: Floats = field(repr=False)
    std: Floats
    meters: int
    charge: Floats
    bound: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A set of faults.

    Attributes
    ----------
    chosen : (q,)
        The set.
    cost
        Its cost.
    """

    chosen: Bools
    cost: float


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
        Meters without which nothing explains the readings.
    problems
        The problem with the estimated prior size, and those of the rivals.
    """

    chosen: Bools
    model: Ints
    weight: Floats
    named: Bools
    problems: tuple[SearchProblem, ...]


@lru_cache(maxsize=16)
def penalties(meters: int) -> Floats:
    """Penalty of k of p meters, for k = 0 to p, (p + 1,).

    Parameters
    ----------
    meters
        p.
    """
    k = np.arange(meters)
    more = 2.0 * np.log((meters - k) / (k + 1.0))
    more = np.where(k >= max(1, meters // 3), np.maximum(more, MAJORITY), more)
    return frozen(np.concatenate([[0.0], np.cumsum(more)]))


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


@lru_cache(maxsize=16)
def _log_binomials(p: int) -> Floats:
    """Logarithms of binom(n, k) for n and k up to p, (p + 1, p + 1); infinite for k above n."""
    n, k = np.ogrid[: p + 1, : p + 1]
    with np.errstate(invalid="ignore"):
        return frozen(
            np.where(k > n, inf, gammaln(n + 1.0) - gammaln(k + 1.0) - gammaln(np.maximum(n - k, 0) + 1.0))
        )


def penalty(problem: SearchProblem, chosen: Bools) -> float:
    """Penalty of one set, (q,)."""
    count = int(np.count_nonzero(chosen[: problem.meters]))
    return float(penalties(problem.meters)[count] + problem.charge[chosen].sum())


def cost(problem: SearchProblem, chosen: Bools) -> float:
    """Cost of one set; O(k^3).

    Parameters
    ----------
    problem
        The problem.
    chosen : (q,)
        The set.
    """
    at = np.flatnonzero(chosen)
    out = penalty(problem, chosen)
    if at.size:
        half = cholesky(problem.F[np.ix_(at, at)] + np.diag(problem.std[at] ** -2.0), lower=True)
        out -= float(problem.y[at] @ cho_solve((half, True), problem.y[at]))
        out += 2.0 * float(np.log(np.diag(half)).sum() + np.log(problem.std[at]).sum())
    return out


def costs(problem: SearchProblem, sets: Bools, share: float = 0.0) -> Floats:
    """Costs of some sets with a share of the meters' variance in common, (k,).

    The amounts have the prior covariance ``s^2 (share 1 1' + (1 - share) I)``. With a share, a set bears the
    largest charge besides: an unreported load moves neighbours alike as well. With the posterior mean m and
    covariance G of amounts without the common one, and ``w = 1 / (s (1 - share))`` for k meters, the score
    and the information of the common amount are ``w' m`` and ``k / (1 - share) - w' G w``. The factor of the
    faults that all sets have is computed once; each set then takes O(n^3) for n others.

    Parameters
    ----------
    problem
        The problem.
    sets : (k, q)
        The sets.
    share
        Share in common, 0 to 1.
    """
    meters = np.count_nonzero(sets[:, : problem.meters], axis=1)
    out = penalties(problem.meters)[meters] + (problem.charge.max(initial=0.0) if share else 0.0)
    problem, sets = _among(problem, np.logical_or.reduce(sets, axis=0)), sets[:, sets.any(axis=0)]
    p, q, shared = problem.meters, problem.y.size, np.logical_and.reduce(sets, axis=0)
    std = np.where(np.arange(q) < p, np.sqrt(1.0 - share), 1.0) * problem.std
    base = Tableau(replace(problem, std=std)).pivot(shared)
    at, inside = padded(sets & ~shared)
    n, J = np.arange(at.shape[1]), np.flatnonzero(shared[:p])
    A = base.A[at[:, :, None], at[:, None, :]] * (inside[:, :, None] & inside[:, None, :])
    A[:, n, n] += ~inside
    pulls = [np.where(inside, base.A[at, q], 0.0)]
    if share:
        w = np.where(np.arange(q) < p, 1.0 / (problem.std * (1.0 - share)), 0.0)
        felt = w - w[J] @ base.A[J, :q]
        pulls.append(np.where(inside, felt[at], 0.0))
    log_det, inner = _inner(A, np.stack(pulls, axis=1))
    out = out + base.cost - base.penalty[base.count] + log_det - inner[:, 0, 0]
    out += np.where(inside, (base.size + problem.charge)[at], 0.0).sum(axis=1)
    if share:
        score = w[J] @ base.A[J, q] + inner[:, 0, 1]
        information = meters / (1.0 - share) + w[J] @ base.A[np.ix_(J, J)] @ w[J] - inner[:, 1, 1]
        information = np.maximum(information, 0.0)
        out += np.log1p(share * information) - score * score / (information + 1.0 / share)
    return np.asarray(out)


def _among(problem: SearchProblem, used: Bools) -> SearchProblem:
    """The problem with some faults (q,) only."""
    at = np.flatnonzero(used)
    return SearchProblem(
        problem.y[at],
        submatrix(problem.F, at, at),
        problem.std[at],
        int(np.count_nonzero(used[: problem.meters])),
        problem.charge[at],
        problem.bound[at],
    )


def padded(sets: Bools) -> tuple[Ints, Bools]:
    """Members of sets, filled up to the same number, and where they are members, (k, n) each.

    Parameters
    ----------
    sets : (k, q)
        The sets.
    """
    count = np.count_nonzero(sets, axis=1)
    inside = np.arange(int(count.max(initial=0))) < count[:, None]
    at = np.zeros(inside.shape, dtype=np.intp)
    at[inside] = np.nonzero(sets)[1]
    return at, inside


def _fits(A: Floats, v: Floats) -> tuple[Floats, Floats]:
    """``log det A`` and ``v' A^-1 v`` of leading blocks of stacked definite matrices, (k, n) each."""
    # The last row of the Cholesky factor of [A, v; v', c] is (half^-1 v)', for any c that is large enough.
    k, n = v.shape
    bordered = np.empty((k, n + 1, n + 1))
    bordered[:, :n, :n] = A
    bordered[:, n, :n] = bordered[:, :n, n] = v
    bordered[:, n, n] = _HUGE
    half = np.linalg.cholesky(bordered)
    white, diagonal = half[:, n, :n], np.einsum("kii->ki", half)[:, :n]
    return 2.0 * np.cumsum(np.log(diagonal), axis=1), np.cumsum(white * white, axis=1)


def _inner(A: Floats, v: Floats) -> tuple[Floats, Floats]:
    """``log det A`` (k,) and ``v A^-1 v'`` (k, r, r) of stacked definite matrices and rows v (k, r, n)."""
    k, r, n = v.shape
    bordered = np.empty((k, n + r, n + r))
    bordered[:, :n, :n] = A
    bordered[:, n:, :n], bordered[:, :n, n:] = v, v.transpose(0, 2, 1)
    bordered[:, n:, n:] = _HUGE * np.eye(r)
    half = np.linalg.cholesky(bordered)
    white, diagonal = half[:, n:, :n], np.einsum("kii->ki", half)[:, :n]
    return 2.0 * np.log(diagonal).sum(axis=1), white @ white.transpose(0, 2, 1)


_HUGE = 1e200
"""Above all ``v' A^-1 v``."""


def amounts(problem: SearchProblem, chosen: Bools) -> tuple[Floats, Floats]:
    """Posterior mean (k,) and covariance (k, k) of the amounts of a set.

    Parameters
    ----------
    problem
        The problem.
    chosen : (q,)
        The set.
    """
    at = np.flatnonzero(chosen)
    cov = np.asarray(np.linalg.inv(problem.F[np.ix_(at, at)] + np.diag(problem.std[at] ** -2.0)), np.float64)
    return cov @ problem.y[at], cov


def mean_amounts(problem: SearchProblem, chosen: Bools) -> Floats:
    """Posterior mean of the amounts of a set, (k,): a third of the time of `amounts`."""
    at = np.flatnonzero(chosen)
    if not at.size:
        return np.zeros(0)
    A = problem.F[np.ix_(at, at)]
    A[np.diag_indices(at.size)] += problem.std[at] ** -2.0
    return np.asarray(lapack.dposv(A, problem.y[at], lower=True)[1])


class Tableau:
    """Sweep tableau of one problem, pivoted on a set.

    Parameters
    ----------
    problem
        The problem.
    """

    def __init__(self, problem: SearchProblem) -> None:
        q = problem.y.size
        self.problem, self.penalty = problem, penalties(problem.meters)
        self.A = np.empty((q + 1, q + 1), order="F")
        self.A.T[:q, :q] = problem.F
        self.A[np.arange(q), np.arange(q)] += problem.std**-2.0
        self.A[q, :q] = self.A[:q, q] = problem.y
        self.A[q, q] = 0.0
        self.chosen = np.zeros(q, dtype=np.bool_)
        self.barred = np.zeros(q, dtype=np.bool_)
        self.cost = 0.0
        self.size = 2.0 * np.log(problem.std)

    def pivot(self, chosen: Bools) -> Tableau:
        """The same, pivoted on a set in place of none; O(q^2 k).

        Parameters
        ----------
        chosen : (q,)
            The set.
        """
        J = np.flatnonzero(chosen)
        if not J.size:
            return self
        columns = self.A[:, J]
        half, _ = lapack.dpotrf(columns[J], lower=True, clean=True)
        white = blas.dtrsm(1.0, half, columns, side=1, lower=1, trans_a=1)
        beside = blas.dtrsm(1.0, half, white, side=1, lower=1)
        inverse, _ = lapack.dpotri(half, lower=True)
        beside[J] = -np.tril(inverse) - np.tril(inverse, -1).T
        self.A -= white @ white.T
        self.A[:, J], self.A[J] = beside, beside.T
        self.cost = 2.0 * float(np.log(half.diagonal()).sum()) - float(white[-1] @ white[-1])
        self.cost += float(self.size[J].sum() + self.problem.charge[J].sum())
        self.chosen = chosen.copy()
        self.cost += float(self.penalty[self.count])
        return self

    def copy(self) -> Tableau:
        """A tableau that can be changed without changing this one."""
        out = object.__new__(Tableau)
        out.problem, out.penalty, out.size = self.problem, self.penalty, self.size
        out.A, out.chosen, out.cost = self.A.copy(order="F"), self.chosen.copy(), self.cost
        out.barred = self.barred.copy()
        return out

    @property
    def count(self) -> int:
        """Number of chosen meters."""
        return int(np.count_nonzero(self.chosen[: self.problem.meters]))

    def changes(self) -> Floats:
        """Change of the cost by toggling each fault, (q,); inf where it is barred or would be impossible."""
        q, k = self.chosen.size, self.count
        a, v = self.A.diagonal()[:q], self.A[:q, q]
        sign = np.where(self.chosen, -1.0, 1.0)
        out = -v * v / a + np.where(self.chosen, np.log(np.abs(a)) - self.size, np.log(np.abs(a)) + self.size)
        p = self.problem.meters
        up = self.penalty[min(k + 1, p)] - self.penalty[k]
        down = self.penalty[max(k - 1, 0)] - self.penalty[k]
        out[:p] += np.where(self.chosen[:p], down, up)
        out += sign * self.problem.charge
        impossible = ~self.chosen & (np.abs(v) > self.problem.bound * np.abs(a))
        return np.where(impossible | (self.barred & ~self.chosen) | (sign * a <= 0.0), inf, out)

    def exchanges(self, out: Ints) -> Floats:
        """Change of the cost by exchanging chosen faults `out` for others, (k, q); inf for itself.

        Parameters
        ----------
        out : (k,)
            Chosen faults.
        """
        p, q, k = self.problem.meters, self.chosen.size, self.count
        a, v = self.A.diagonal()[:q], self.A[:q, q]
        rows = self.A[out, :q] / a[out][:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            pivot = a - rows * self.A[out, :q]
            pull = v - rows * v[out][:, None]
            first = -(v[out] ** 2) / a[out] + np.log(-a[out]) - self.size[out] - self.problem.charge[out]
            both = first[:, None] - pull**2 / pivot + np.log(pivot) + self.size + self.problem.charge
            impossible = np.abs(pull) > self.problem.bound * np.abs(pivot)
        meter = np.arange(q) < p
        count = k - meter[out][:, None] + meter
        both += self.penalty[np.minimum(count, p)] - self.penalty[k]
        return np.where(self.chosen | self.barred | impossible | ~(pivot > 0.0), inf, both)

    def toggled(self, members: Ints, inside: Bools) -> Floats:
        """Change of the cost by toggling sets of meters, (k,).

        With A and v of the set, ``-v' A^-1 v + log |det A|`` generalises that of one meter.

        Parameters
        ----------
        members, inside : (k, g)
            The sets, filled up to the same size, and where they are members.
        """
        q, p, n = self.chosen.size, self.problem.meters, np.arange(members.shape[1])
        A = self.A[members[:, :, None], members[:, None, :]] * (inside[:, :, None] & inside[:, None, :])
        A[:, n, n] += ~inside
        v = np.where(inside, self.A[members, q], 0.0)
        sign = np.where(self.chosen[members], -1.0, 1.0) * inside
        out = np.linalg.slogdet(A)[1] + (sign * self.size[members]).sum(axis=1)
        out -= (v * np.linalg.solve(A, v[:, :, None])[:, :, 0]).sum(axis=1)
        count = self.count + sign.sum(axis=1).astype(np.intp)
        return np.asarray(out + self.penalty[np.minimum(count, p)] - self.penalty[self.count])

    def bar(self, j: int) -> None:
        """Keep a fault outside from now on, and remove it if it is inside.

        Parameters
        ----------
        j
            The fault.
        """
        self.barred[j] = True
        if self.chosen[j]:
            self.toggle(j)

    def toggle(self, j: int) -> None:
        """Add a fault to the set, or remove it; O(q^2).

        Parameters
        ----------
        j
            The fault.
        """
        k, column, d = self.count, self.A[:, j].copy(), self.A[j, j]
        self.A = blas.dger(-1.0 / d, column, column, a=self.A, overwrite_a=True)
        pivot = column / (-d if self.chosen[j] else d)
        self.A[j] = self.A[:, j] = pivot
        self.A[j, j] = -1.0 / d
        size = log(abs(d)) + (-self.size[j] if self.chosen[j] else self.size[j])
        added = -1 if self.chosen[j] else 1
        self.cost += size - column[-1] ** 2 / d + added * self.problem.charge[j]
        self.chosen[j] = not self.chosen[j]
        self.cost += self.penalty[self.count] - self.penalty[k]

    def group(self, members: Ints, inside: Bools) -> Floats:
        """Change of the cost by adding the first n meters of sequences, (k, g); inf for one meter or none.

        The factor of a sequence contains those of its beginnings. Chosen meters stay chosen.

        Parameters
        ----------
        members, inside : (k, g)
            The sequences, filled up to the same length, and where they are members.
        """
        q, p = self.chosen.size, self.problem.meters
        free = inside & ~self.chosen[members]
        count, k = np.cumsum(free, axis=1), self.count
        both = free[:, :, None] & free[:, None, :]
        A = np.where(both, self.A[members[:, :, None], members[:, None, :]], 0.0)
        A[:, np.arange(members.shape[1]), np.arange(members.shape[1])] += ~free
        log_det, fit = _fits(A, np.where(free, self.A[members, q], 0.0))
        size = np.cumsum(free * self.size[members], axis=1)
        out = log_det + size - fit + self.penalty[np.minimum(k + count, p)] - self.penalty[k]
        barred = np.logical_or.accumulate(free & self.barred[members], axis=1)
        return np.where((count > 1) & ~barred, out, inf)


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
    for some in _similar([len(each) for each, _ in chains]):
        at_, inside = _filled([np.array(chains[k][0]) for k in some])
        final = np.zeros_like(inside)
        for row, k in enumerate(some):
            final[row, chains[k][1]] = True
        out.append((at_, inside, final))
    return tuple(out)


def _similar(sizes: Sequence[int]) -> list[list[int]]:
    """Places of similar sizes together."""
    class_of = np.ceil(np.log2(np.maximum(sizes, 1)))
    return [np.flatnonzero(class_of == one).tolist() for one in np.unique(class_of)]


def _filled(sets: Sequence[Ints]) -> tuple[Ints, Bools]:
    """Members of sets, filled up to the same number, and where they are members, (k, n) each."""
    members = np.zeros((len(sets), max(each.size for each in sets)), dtype=np.intp)
    inside = np.zeros(members.shape, dtype=np.bool_)
    for k, each in enumerate(sets):
        members[k, : each.size], inside[k, : each.size] = each, True
    return members, inside


def descend(tableau: Tableau, groups: Groups = (), met: set[bytes] | None = None) -> Tableau:
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
        if change[j] < -_GAIN:
            tableau.toggle(j)
        elif not (_possible(tableau) or _exchanged(tableau) or _grouped(tableau, groups)):
            break
    return tableau


def _possible(tableau: Tableau) -> bool:
    """Bar the faults with impossible amounts, if there are any."""
    amount = tableau.A[:-1, -1]
    beyond = np.flatnonzero(tableau.chosen & (np.abs(amount) > tableau.problem.bound))
    for j in beyond:
        tableau.bar(int(j))
    return bool(beyond.size)


_GAIN = 1e-9
"""Least change of the cost that counts, 1: rounding."""


def _exchanged(tableau: Tableau) -> bool:
    """Make the best exchange of two faults, if one helps."""
    out = np.flatnonzero(tableau.chosen)
    if not out.size:
        return False
    both = tableau.exchanges(out)
    i, j = np.unravel_index(int(both.argmin()), both.shape)
    if not both[i, j] < -_GAIN:
        return False
    tableau.toggle(int(out[i]))
    tableau.toggle(int(j))
    return True


def _grouped(tableau: Tableau, groups: Groups) -> bool:
    """Add the rest of the best group, if one helps."""
    best, least = None, -_GAIN
    for members, inside, ends in groups:
        change = np.where(ends, tableau.group(members, inside), inf)
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
    """
    batches = together(groups)
    read = informed(problem)
    whole = np.zeros((0, problem.meters)) if laterals is None else (laterals & read).astype(np.float64)
    start = relevant(problem)
    ends = [_descended(problem, (np.zeros_like(start), start), batches)]
    for other, _ in rivals:
        ends.append(_descended(other, (np.zeros_like(start), ends[0].chosen), batches))
    one_amount = [in_common(end.problem, whole, end.chosen) for end in ends]
    more = (0.0, *(cost for _, cost in rivals))
    least = [
        min(end.cost, float((costs(end.problem, sets, ALIKE) - _less(sets, whole, read)).min(initial=inf)))
        + cost
        for end, sets, cost in zip(ends, one_amount, more, strict=True)
    ]
    found = []
    for end, sets, best, cost in zip(ends, one_amount, least, more, strict=True):
        if best < min(least) + HOPELESS:
            met = _explored(end, sets, groups, batches)
        else:
            met = {end.chosen.tobytes(): end.cost}
            _with_amounts_alike(end.problem, met, sets[:1])
        keys = list(met)
        less = _less(np.stack([np.frombuffer(key, dtype=np.bool_) for key in keys]), whole, read)
        found.append({key: met[key] + cost - float(one) for key, one in zip(keys, less, strict=True)})
    return _identified(tuple(end.problem for end in ends), tuple(found))


def _less(sets: Bools, laterals: Floats, read: Bools) -> Floats:
    """Excess of the penalties by numbers of meters over `coded`, (k,)."""
    meters = sets[:, : read.size]
    return np.asarray(penalties(read.size)[np.count_nonzero(meters, axis=1)] - coded(meters, laterals, read))


def informed(problem: SearchProblem) -> Bools:
    """Meters with readings since the onset, (p,): the information about others is zero."""
    return np.asarray(problem.F.diagonal()[: problem.meters] > np.finfo(np.float64).tiny)


def _descended(problem: SearchProblem, starts: tuple[Bools, ...], groups: Groups) -> Tableau:
    """The cheapest set from some starts, with the prior size that it has."""
    starts = _different(starts)
    best = _best(tuple(_at(problem, start) for start in starts), groups)
    again = _different((best.chosen, starts[-1]))
    ends = [
        _best(tuple(_at(sized, start) for start in again), groups)
        for sized in (_sized(problem, each) for each in again)
        if sized is not problem
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
    for j in np.flatnonzero(best.chosen[: problem.meters]):
        rival = best.copy()
        rival.bar(int(j))
        if rival.cost + min(0.0, float(rival.changes().min())) < best.cost + FAR:
            keep(descend(rival, batches))
    likely = sorted((each, key) for key, each in found.items() if each < best.cost + NEAR)
    for _, key in likely[: EXPANDED + 1]:
        if key != best.chosen.tobytes():
            _neighbours(_at(problem, np.frombuffer(key, dtype=np.bool_)), found, UNLIKELY)
    _with_amounts_alike(problem, found, one_amount)
    return found


def _with_amounts_alike(problem: SearchProblem, found: dict[bytes, float], more: Bools) -> None:
    """Mix both priors of the amounts in more sets, and in the cheapest ones with more than one meter."""
    for chosen, each in zip(more, costs(problem, more), strict=True):
        found.setdefault(chosen.tobytes(), float(each))
    keys = sorted(found, key=lambda key: found[key])[:SOME]
    keys = list(dict.fromkeys([*keys, *(each.tobytes() for each in more)]))
    sets = np.stack([np.frombuffer(key, dtype=np.bool_) for key in keys])
    several = np.flatnonzero(np.count_nonzero(sets[:, : problem.meters], axis=1) > 1)
    if several.size:
        for k, other in zip(several, costs(problem, sets[several], ALIKE), strict=True):
            # Twice the logarithm of the mean of both likelihoods.
            both = np.logaddexp(-0.5 * found[keys[k]], -0.5 * other)
            found[keys[k]] = 2.0 * (log(2.0) - float(both))


class Common:
    """A lateral with exceptions that is off by one amount, and the costs of all sets near it.

    The scores and the information of the one amount are ``a = 1' y_J`` and ``b = 1' F_JJ 1``:

        cost(J) = -a^2 / (b + 1 / s^2) + log(1 + s^2 b) + penalty(J)

    with the penalty of `coded` for this lateral, or that of the number of meters.

    Parameters
    ----------
    problem
        The problem.
    lateral : (p,)
        Members of the lateral; none: the penalty of the number counts.
    inside : (p,)
        The set.
    """

    def __init__(self, problem: SearchProblem, lateral: Bools, inside: Bools) -> None:
        p = problem.meters
        self.y, self.F, self.s2 = problem.y[:p], problem.F[:p, :p], float(problem.std[0]) ** 2
        self.penalty, self.lateral, self.inside = penalties(p), lateral, inside.copy()
        self.size, self.choices = int(lateral.sum()), _log_binomials(p)
        self.read = informed(problem)
        self.others = int(np.count_nonzero(self.read & ~lateral))
        self.rows = self.F @ self.inside
        self.a, self.b = float(self.y @ self.inside), float(self.rows @ self.inside)
        self.count = int(self.inside.sum())
        self.kept = int(np.count_nonzero(self.inside & lateral))

    def _costs(self, a: Floats, b: Floats, count: Ints, kept: Ints) -> Floats:
        b = np.maximum(b, 0.0)
        out = -a * a / (b + 1.0 / self.s2) + np.log1p(self.s2 * b)
        if self.size:
            left, other = self.choices[self.size], self.choices[self.others]
            out += 2.0 * (left[self.size - kept] + other[count - kept])
        else:
            out += self.penalty[count]
        return np.where(count > 0, out, inf)

    @property
    def cost(self) -> float:
        """Cost of the set, without that of the choice of the lateral."""
        each = np.array([self.a]), np.array([self.b]), np.array([self.count]), np.array([self.kept])
        return float(self._costs(*each)[0])

    def toggled(self) -> Floats:
        """Cost after toggling each meter, (p,)."""
        sign = np.where(self.inside, -1, 1)
        b = self.b + 2.0 * sign * self.rows + self.F.diagonal()
        out = self._costs(self.a + sign * self.y, b, self.count + sign, self.kept + sign * self.lateral)
        return np.where(self.read, out, inf)

    def descend(self) -> Common:
        """Lower the cost by single meters until none of them helps."""
        cost = self.cost
        for _ in range(4 * self.inside.size):
            one = self.toggled()
            j = int(one.argmin())
            if not one[j] < cost - _GAIN:
                break
            self._toggle(j)
            cost = float(one[j])
        return self

    def _toggle(self, j: int) -> None:
        sign = -1.0 if self.inside[j] else 1.0
        self.a += sign * float(self.y[j])
        self.b += 2.0 * sign * float(self.rows[j]) + float(self.F[j, j])
        self.rows += sign * self.F[j]
        self.count += int(sign)
        self.kept += int(sign * self.lateral[j])
        self.inside[j] = not self.inside[j]


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
    none = np.zeros(p, dtype=np.bool_)
    starts = [Common(problem, none, best[:p] & informed(problem))] if best[:p].any() else []
    if len(laterals):
        a, b = laterals @ problem.y[:p], ((laterals @ problem.F[:p, :p]) * laterals).sum(axis=1)
        first = a * a / (np.maximum(b, 0.0) + problem.std[0] ** -2.0)
        for k in np.argsort(-first, kind="stable")[:_COMMON]:
            lateral = laterals[k] > 0.0
            starts.append(Common(problem, lateral, lateral))
    for start in starts:
        end = start.descend()
        near = end.toggled() < end.cost - 2.0 * log(BELIEVED)
        for j in (-1, *np.flatnonzero(near)):
            chosen = np.zeros(problem.y.size, dtype=np.bool_)
            chosen[:p] = end.inside
            if j >= 0:
                chosen[j] = not chosen[j]
            out[chosen.tobytes()] = chosen
    return np.stack(list(out.values())) if out else np.zeros((0, problem.y.size), dtype=np.bool_)


_COMMON = 8
"""Number of laterals from which a descent with one amount starts: those with the best fit."""


def _best(starts: tuple[Tableau, ...], groups: Groups) -> Tableau:
    """The cheapest end of descents."""
    met = set[bytes]()
    return min((descend(start, groups, met) for start in starts), key=lambda end: end.cost)


def _at(problem: SearchProblem, chosen: Bools) -> Tableau:
    """A tableau pivoted on a set."""
    return Tableau(problem).pivot(chosen)


def _sized(problem: SearchProblem, chosen: Bools) -> SearchProblem:
    """The problem with the prior size of the meters' faults estimated from a set of them."""
    p = problem.meters
    if not chosen[:p].any():
        return problem
    mean, cov = amounts(problem, chosen)
    count = int(np.count_nonzero(chosen[:p]))
    size = float(np.sqrt(np.mean((mean**2 + cov.diagonal())[:count])))
    std = problem.std.copy()
    std[:p] = size
    return replace(problem, std=std)


def _flipped(best: Tableau, groups: tuple[Ints, ...]) -> list[Tableau]:
    """Tableaus in which the meters of one group are accused in place of the believed and the reverse."""
    p, out, change = best.problem.meters, list[Bools](), list[Floats]()
    accused, most = best.chosen[:p], max(1, p // 2)
    some = [each for each in groups if each.size > 1 and accused[each].any()]
    some = [each for each in some if best.count + each.size - 2 * np.count_nonzero(accused[each]) <= most]
    if not some:
        return []
    for places in _similar([each.size for each in some]):
        members, inside = _filled([some[k] for k in places])
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
    limit = min(found.values()) - 2.0 * log(least)
    change = best.changes()
    for j in np.flatnonzero(best.cost + change < limit):
        chosen = best.chosen.copy()
        chosen[j] = not chosen[j]
        found.setdefault(chosen.tobytes(), best.cost + float(change[j]))
    out = np.flatnonzero(best.chosen)
    if not out.size:
        return
    both = best.exchanges(out)
    for i, j in zip(*np.nonzero(best.cost + both < limit), strict=True):
        chosen = best.chosen.copy()
        chosen[out[i]], chosen[j] = False, True
        found.setdefault(chosen.tobytes(), best.cost + float(both[i, j]))


def _identified(problems: tuple[SearchProblem, ...], found: tuple[dict[bytes, float], ...]) -> Identification:
    """Weights of the sets found, and the meters without which nothing is left."""
    every = sorted((each[key], k, key) for k, each in enumerate(found) for key in each)
    costs = np.array([one for one, _, _ in every])
    weight = np.exp(-0.5 * (costs - costs[0]))
    weight /= weight.sum()
    kept = weight >= BELIEVED
    chosen = np.stack([np.frombuffer(key, dtype=np.bool_) for _, _, key in every])[kept]
    weight = weight[kept] / weight[kept].sum()
    without = weight @ ~chosen[:, : problems[0].meters]
    model = np.array([k for _, k, _ in every])[kept]
    return Identification(chosen, model, weight, np.asarray(without < DOUBT), problems)


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
