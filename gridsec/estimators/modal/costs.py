"""Exact posterior costs of sets of faults.

At one onset, the scores y (q,) and the information F (q, q) of `gridsec.estimators.modal.signatures` say
everything about the amounts of q possible faults: meters, false powers, busbar. For a subset J with amounts
N(0, s_j^2), twice the negative logarithm of its posterior probability, up to a constant, is

    cost(J) = -y_J' (F_JJ + diag(1 / s_J^2))^-1 y_J + log det(I + diag(s_J^2) F_JJ) + penalty(J)
    penalty = 2 log binom(p, k) for k of p meters, plus a charge for every other fault

Every number of meters is as likely as any other, and every set of one size as any other of that size.

**Tableau.** The sweep operator keeps ``[F + 1 / s^2, y; y', 0]`` pivoted on J, so that the costs of all sets
that differ by one addition, removal or exchange are read off, O(q) to O(k q); a step is O(q k). A group of
neighbours is added or removed at once.

References
----------
.. [1] Goodnight, A tutorial on the SWEEP operator, The American Statistician 33, 1979.
.. [2] Chen and Chen, Extended Bayesian information criteria, Biometrika 95, 2008.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import inf, log, sqrt
from typing import Self

import numpy as np
from scipy.linalg import blas, lapack

from gridsec.arrays import Bools, Floats, Ints, frozen, submatrix

MAJORITY = 9.0
"""Least penalty of a meter beyond a third of all, in units of the cost: three standard deviations."""
BELIEVED = 1e-8
"""Weight below which a set is not kept, 1: far below the doubt at which a meter is not named."""


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


def informed(problem: SearchProblem) -> Bools:
    """Meters with readings since the onset, (p,): the information about others is zero."""
    return np.asarray(problem.F.diagonal()[: problem.meters] > np.finfo(np.float64).tiny)


def cost(problem: SearchProblem, chosen: Bools, share: float = 0.0) -> float:
    """Cost of one set; O(k^3).

    Parameters
    ----------
    problem
        The problem.
    chosen : (q,)
        The set.
    share
        As in `costs`.
    """
    return float(_dense(problem, chosen[None], problem.std, share)[0])


def costs(problem: SearchProblem, sets: Bools, share: float = 0.0, std: Floats | None = None) -> Floats:
    """Costs of some sets with a share of the meters' variance in common, (k,).

    The amounts have the prior covariance ``s^2 (share 1 1' + (1 - share) I)``. With a share, a set bears the
    largest charge besides: an unreported load moves neighbours alike as well. With the posterior mean m and
    covariance G of amounts without the common one, and ``w = 1 / (s (1 - share))`` for k meters, the score
    and the information of the common amount are ``w' m`` and ``k / (1 - share) - w' G w``. A set takes O(n^3)
    for the n faults in which it differs from those beside it; up to `FEW` sets have factors of their own.

    Parameters
    ----------
    problem
        The problem.
    sets : (k, q)
        The sets.
    share
        Share in common, 0 to 1.
    std : (k, q)
        Prior standard deviations of each set; None: those of the problem.
    """
    if std is not None or len(sets) <= FEW:
        return _dense(problem, sets, problem.std if std is None else std, share)
    meters = np.count_nonzero(sets[:, : problem.meters], axis=1)
    out = penalties(problem.meters)[meters] + (problem.charge.max(initial=0.0) if share else 0.0)
    used = np.logical_or.reduce(sets, axis=0)
    problem, w = with_common(among(problem, used), share)
    q, borders = problem.y.size, (w,) if share else ()
    for base, rows, at, inside in _tableaus(problem, sets[:, used], borders):
        log_det, inner = base.block(at, inside)
        sign = np.where(base.chosen[at], -1.0, 1.0) * inside
        out[rows] += base.cost - base.penalty[base.count] + log_det - inner[:, 0, 0]
        out[rows] += (sign * base.weight[at]).sum(axis=1)
        if share:
            score = inner[:, 0, 1] - base.borders[q, 1]
            information = meters[rows] / (1.0 - share) + base.borders[q + 1, 1] - inner[:, 1, 1]
            out[rows] += common_cost(share, score, information)
    return np.asarray(out)


def _dense(problem: SearchProblem, sets: Bools, std: Floats, share: float) -> Floats:
    """Costs of some sets by a Cholesky factor of each, (k,); std: (q,) or (k, q)."""
    p, count = problem.meters, np.count_nonzero(sets[:, : problem.meters], axis=1)
    out = penalties(p)[count] + sets @ problem.charge + (problem.charge.max(initial=0.0) if share else 0.0)
    std = np.broadcast_to(std, sets.shape)
    for some in similar(np.count_nonzero(sets, axis=1)):
        at, inside = padded(sets[some])
        size, meter = np.take_along_axis(std[some], at, axis=1), inside & (at < p)
        own = np.where(inside, np.where(meter, sqrt(1.0 - share), 1.0) * size, 1.0)
        rows = [problem.y[at] * inside]
        if share:
            rows.append(np.where(meter, 1.0 / (size * (1.0 - share)), 0.0))
        half, n = _bordered(_definite(problem.F, at, inside, own), np.stack(rows, axis=1)), at.shape[1]
        inner = half[:, n:, :n] @ half[:, n:, :n].transpose(0, 2, 1)
        diagonal = np.einsum("kii->ki", half)[:, :n]
        out[some] += 2.0 * np.log(diagonal * own).sum(axis=1) - inner[:, 0, 0]
        if share:
            information = count[some] / (1.0 - share) - inner[:, 1, 1]
            out[some] += common_cost(share, -inner[:, 0, 1], information)
    return np.asarray(out)


def _definite(F: Floats, at: Ints, inside: Bools, std: Floats) -> Floats:
    """``F_JJ + diag(1 / std^2)`` of some sets, (k, n, n), filled up by the identity; std: (k, n), 1 there."""
    A, n = F[at[:, :, None], at[:, None, :]], np.arange(at.shape[1])
    A *= inside[:, :, None] & inside[:, None, :]
    A[:, n, n] += std**-2.0
    return A


def sizes(problem: SearchProblem, sets: Bools) -> Floats:
    """Prior size of the meters' faults that suits each set, (k,); that of the problem for none of meters.

    It is the root of the mean square of their posterior amounts.

    Parameters
    ----------
    problem
        The problem.
    sets : (k, q)
        The sets.
    """
    out = np.full(len(sets), problem.std[0])
    for some in similar(np.count_nonzero(sets, axis=1)):
        at, inside = padded(sets[some])
        cov = np.linalg.inv(_definite(problem.F, at, inside, np.where(inside, problem.std[at], 1.0)))
        mean = np.vecdot(cov, (problem.y[at] * inside)[:, None, :])
        meter = inside & (at < problem.meters)
        square = ((mean * mean + np.einsum("kii->ki", cov)) * meter).sum(axis=1)
        count = np.count_nonzero(meter, axis=1)
        out[some] = np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), out[some])
    return out


def similar(counts: Sequence[int] | Ints) -> Iterator[Ints]:
    """Places of similar counts together: from the least to the largest they double at most.

    Parameters
    ----------
    counts : (k,)
        Numbers of members.
    """
    doubles = np.ceil(np.log2(np.maximum(counts, SMALL)))
    for one in np.unique(doubles):
        yield np.flatnonzero(doubles == one)


def with_common(problem: SearchProblem, share: float) -> tuple[SearchProblem, Floats]:
    """The problem without the common part of the variance of its meters, and the row w of that, (q,).

    Parameters
    ----------
    problem, share
        As in `costs`; a share below 1.
    """
    meter = np.arange(problem.y.size) < problem.meters
    less = replace(problem, std=np.where(meter, np.sqrt(1.0 - share), 1.0) * problem.std)
    return less, np.where(meter, 1.0 / (problem.std * (1.0 - share)), 0.0)


def common_cost(share: float, score: Floats | float, information: Floats | float) -> Floats:
    """Cost of a common amount by its score and information; a share above 0."""
    b = np.maximum(information, 0.0)
    return np.asarray(np.log1p(share * b) - score * score / (b + 1.0 / share))


def _tableaus(
    problem: SearchProblem, sets: Bools, borders: Sequence[Floats] = ()
) -> Iterator[tuple[Tableau, Ints, Ints, Bools]]:
    """Tableaus, rows of sets (k, q) beside their sets, and the faults in which these differ, (j, n).

    One is pivoted on the faults of most sets. Those that differ in more than `TOGGLED` are beside the faults
    that all of them have. n doubles at most from the fewest to the most of the sets that come together.
    """
    most = 2 * np.count_nonzero(sets, axis=0) > len(sets)
    near = np.count_nonzero(sets ^ most, axis=1) <= TOGGLED
    for which, own in ((near, most), (~near, np.logical_and.reduce(sets[~near], axis=0))):
        if not which.any():
            continue
        base, rows, differ = Tableau(problem, *borders).pivot(own), np.flatnonzero(which), sets[which] ^ own
        for some in similar(np.count_nonzero(differ, axis=1)):
            yield base, rows[some], *padded(differ[some])


def explained(problem: SearchProblem, sets: Bools, weight: Floats, T: Floats) -> tuple[Floats, Floats]:
    """Means of ``T f`` by the amounts f of some sets, (k, n), and the sum of the variances by weight, (n,).

    With T as borders of the tableau of a set, ``T f`` and its covariance are entries of the tableau. A set
    that differs from it by the faults D changes them by ``U_D A_DD^-1 v_D`` and ``U_D A_DD^-1 U_D'``.

    Parameters
    ----------
    problem
        The problem.
    sets : (k, q)
        The sets.
    weight : (k,)
        Their weights.
    T : (n, q)
        Effects of the faults.
    """
    used = np.logical_or.reduce(sets, axis=0)
    problem, sets, T = among(problem, used), sets[:, used], T[:, used]
    q, mean, variance = problem.y.size, np.zeros((len(sets), len(T))), np.zeros(len(T))
    for base, rows, at, inside in _tableaus(problem, sets):
        J, v = base.order, base.borders[:, 0]
        U = np.where(base.chosen, 0.0, T) - T[:, J] @ base.beside[:q].T
        inverse = np.linalg.inv(base.within(at, inside)) * (inside[:, :, None] & inside[:, None, :])
        along, turn = np.zeros((rows.size, q)), np.zeros((q, q))
        np.add.at(along, (np.arange(rows.size)[:, None], at), np.vecdot(inverse, v[at][:, None, :]))
        np.add.at(turn, (at[:, :, None], at[:, None, :]), weight[rows, None, None] * inverse)
        mean[rows] = T[:, J] @ v[J] + along @ U.T
        variance += weight[rows].sum() * (U[:, J] * T[:, J]).sum(axis=1) + ((U @ turn) * U).sum(axis=1)
    return mean, variance


def mean_likelihood(each: Floats, counted: Bools | None = None) -> Floats:
    """Costs of the mean of the likelihoods, (...); `each` has the costs of one likelihood per row.

    counted: likelihoods that count, in the shape of `each`; None: all.
    """
    counted = np.ones(each.shape, dtype=np.bool_) if counted is None else counted
    log_sum = np.logaddexp.reduce(np.where(counted, -0.5 * each, -inf), axis=0)
    return np.asarray(-2.0 * (log_sum - np.log(np.count_nonzero(counted, axis=0))))


def among(problem: SearchProblem, used: Bools) -> SearchProblem:
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
    """``log det A`` (k, n) and ``v A^-1 v'`` (k, r, r, n) of leading blocks of stacked definite matrices.

    v: (k, r, n) rows; the products of two rows are those of their beginnings.
    """
    # The last rows of the Cholesky factor of [A, v'; v, c] are (half^-1 v')', for any c that is large enough.
    half = _bordered(A, v)
    n = v.shape[2]
    white, diagonal = half[:, n:, :n], np.einsum("kii->ki", half)[:, :n]
    return 2.0 * np.cumsum(np.log(diagonal), axis=1), np.cumsum(white[:, :, None] * white[:, None], axis=3)


def _bordered(A: Floats, v: Floats) -> Floats:
    """Cholesky factors of stacked definite matrices with rows v (k, r, n) below them, (k, n + r, n + r)."""
    k, r, n = v.shape
    bordered = np.empty((k, n + r, n + r))
    bordered[:, :n, :n] = A
    bordered[:, n:, :n], bordered[:, :n, n:] = v, v.transpose(0, 2, 1)
    bordered[:, n:, n:] = _HUGE * np.eye(r)
    return np.linalg.cholesky(bordered)


TOGGLED = 16
"""Faults in which a set differs from another one up to which its cost is that of a few toggles, 1."""
FEW = 8
"""Number of sets up to which each has a factor of its own, 1: a tableau takes ten times as long as one."""
SMALL = 8
"""Number of faults up to which sets come together, 1: the calls take longer than the products."""
ROOM = 16
"""Columns of a tableau that are free for more faults, 1."""
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

    Of the tableau A only the diagonal, the borders and the columns of chosen faults are kept, O(q k): all
    other entries follow from these, ``A_ij = F_ij - A_iJ F_Jj``.

    Parameters
    ----------
    problem
        The problem.
    borders : (q,) each
        Rows beside the scores that are pivoted with these.
    """

    def __init__(self, problem: SearchProblem, *borders: Floats) -> None:
        q, self.rows = problem.y.size, np.stack([problem.y, *borders])
        r = len(self.rows)
        self.problem, self.penalty = problem, penalties(problem.meters)
        self.prior = problem.std**-2.0
        self.diagonal = problem.F.diagonal() + self.prior
        # Columns of the borders, then those of the faults in `order`; the rest is room for more.
        self.columns = np.zeros((q + r, r + ROOM), order="F")
        self.columns[:q, :r] = self.rows.T
        self.order = np.zeros(0, dtype=np.intp)
        self.chosen = np.zeros(q, dtype=np.bool_)
        # Meters without a reading explain nothing.
        self.barred = np.zeros(q, dtype=np.bool_)
        self.barred[: problem.meters] = ~informed(problem)
        # Number of chosen meters.
        self.cost, self.count = 0.0, 0
        self.size = 2.0 * np.log(problem.std)
        self.weight, self.bounded = self.size + problem.charge, np.flatnonzero(problem.bound < inf)

    def pivot(self, chosen: Bools) -> Self:
        """The same, pivoted on a set in place of none; O(q k^2).

        Parameters
        ----------
        chosen : (q,)
            The set.
        """
        J, q, r = np.flatnonzero(chosen), chosen.size, len(self.rows)
        if not J.size:
            return self
        beside = np.empty((q + r, J.size), order="F")
        beside.T[:, :q], beside[q:] = self.problem.F.take(J, axis=0), self.rows[:, J]
        A = beside[J]
        A[np.diag_indices(J.size)] += self.prior[J]
        half, _ = lapack.dpotrf(A, lower=True, clean=True)
        white = blas.dtrsm(1.0, half, beside, side=1, lower=1, trans_a=1, overwrite_b=1)
        inner = white[q:]
        self.columns = np.zeros((q + r, r + J.size + ROOM), order="F")
        borders = self.columns[:, :r]
        borders[:q] = self.rows.T
        borders -= white @ inner.T
        self.diagonal -= np.vecdot(white[:q], white[:q])
        self.cost = 2.0 * float(np.log(half.diagonal()).sum()) - float(inner[0] @ inner[0])
        self.cost += float(self.size[J].sum() + self.problem.charge[J].sum())
        beside = blas.dtrsm(1.0, half, white, side=1, lower=1, overwrite_b=1)
        inverse, _ = lapack.dpotri(half, lower=True)
        beside[J] = -np.tril(inverse) - np.tril(inverse, -1).T
        self.columns[:, r : r + J.size], borders[J] = beside, beside[q:].T
        self.diagonal[J] = -inverse.diagonal()
        self.order, self.chosen = J, chosen.copy()
        self.count = int(np.count_nonzero(chosen[: self.problem.meters]))
        self.cost += float(self.penalty[self.count])
        return self

    def copy(self) -> Self:
        """A tableau that can be changed without changing this one."""
        out = object.__new__(type(self))
        out.problem, out.penalty, out.size = self.problem, self.penalty, self.size
        out.weight, out.bounded = self.weight, self.bounded
        out.rows, out.prior, out.order = self.rows, self.prior, self.order
        out.columns, out.diagonal = self.columns.copy(order="F"), self.diagonal.copy()
        out.chosen, out.barred = self.chosen.copy(), self.barred.copy()
        out.cost, out.count = self.cost, self.count
        return out

    @property
    def beside(self) -> Floats:
        """Columns of the chosen faults, in their order, (q + r, k)."""
        r = len(self.rows)
        return self.columns[:, r : r + self.order.size]

    @property
    def borders(self) -> Floats:
        """Columns of the scores and of the rows beside them, (q + r, r)."""
        return self.columns[:, : len(self.rows)]

    def of(self, out: Ints) -> Floats:
        """Rows of chosen faults, (n, q)."""
        at = np.empty(self.chosen.size, dtype=np.intp)
        at[self.order] = np.arange(self.order.size)
        return self.beside[: self.chosen.size].T.take(at[out], axis=0)

    def part(self, at: Ints) -> Floats:
        """Entries between some faults, (n, n); O(n^2 k)."""
        F, inside = self.problem.F, self.chosen[at]
        A = submatrix(F, at, at)
        A[np.diag_indices(at.size)] += self.prior[at]
        if self.order.size:
            A -= self.beside[at] @ submatrix(F, self.order, at)
        if inside.any():
            A[inside] = self.of(at[inside])[:, at]
            A[:, inside] = A[inside].T
        return A

    @property
    def whole(self) -> float:
        """Cost of the set, with all that the amounts have in common."""
        return self.cost

    @property
    def amount(self) -> Floats:
        """Posterior means of the amounts of chosen faults, (q,); not defined for others."""
        return self.columns[: self.chosen.size, 0]

    def changes(self) -> Floats:
        """Change of the cost by toggling each fault, (q,); inf where it is barred or would be impossible."""
        (out, v), a, b = self.steps(), self.diagonal, self.bounded
        out[(self.barred & ~self.chosen) | ((a <= 0.0) != self.chosen)] = inf
        impossible = ~self.chosen[b] & (np.abs(v[b]) > self.problem.bound[b] * np.abs(a[b]))
        out[b[impossible]] = inf
        return out

    def steps(self) -> tuple[Floats, Floats]:
        """Change of the cost by toggling each fault, and its amount times its pivot, (q,)."""
        k, p, a, v = self.count, self.problem.meters, self.diagonal, self.columns[: self.chosen.size, 0]
        out = np.log(np.abs(a))
        out += np.where(self.chosen, -self.weight, self.weight)
        out -= v * v / a
        up = self.penalty[min(k + 1, p)] - self.penalty[k]
        down = self.penalty[max(k - 1, 0)] - self.penalty[k]
        out[:p] += np.where(self.chosen[:p], down, up)
        return out, v

    def exchanges(self, out: Ints) -> Floats:
        """Change of the cost by exchanging chosen faults `out` for others, (k, q); inf for itself.

        Parameters
        ----------
        out : (k,)
            Chosen faults.
        """
        return np.where(self.chosen, inf, self.seconds(out))

    def seconds(self, out: Ints) -> Floats:
        """Change of the cost by removing chosen faults `out` and toggling others, (k, q); inf for itself.

        Parameters
        ----------
        out : (k,)
            Chosen faults.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            both, pull, pivot = self.pairs(out)
            impossible = self.barred | (np.abs(pull) > self.problem.bound * np.abs(pivot))
        both[(impossible & ~self.chosen) | ~(np.where(self.chosen, -pivot, pivot) > 0.0)] = inf
        both[np.arange(out.size), out] = inf
        return both

    def pairs(self, out: Ints) -> tuple[Floats, Floats, Floats]:
        """Change of the cost by such pairs, the amount of the new one times its pivot, and that, (k, q)."""
        p, q, k = self.problem.meters, self.chosen.size, self.count
        a, v, own = self.diagonal, self.columns[:q, 0], self.of(out)
        rows = own / a[out][:, None]
        pivot = a - rows * own
        pull = v - rows * v[out][:, None]
        first = -(v[out] ** 2) / a[out] + np.log(-a[out]) - self.weight[out]
        sign, meter = np.where(self.chosen, -1, 1), np.arange(q) < p
        both = first[:, None] - pull**2 / pivot + np.log(np.abs(pivot))
        both += sign * self.weight
        count = k - meter[out][:, None] + sign * meter
        both += self.penalty[np.minimum(count, p)] - self.penalty[k]
        return both, pull, pivot

    def within(self, members: Ints, inside: Bools, block: Floats | None = None) -> Floats:
        """Blocks of the tableau for some sets, (k, g, g), filled up by the identity; as in `toggled`.

        block: entries between the first faults, all members among them; None: computed here.
        """
        n, place = np.arange(members.shape[1]), members
        if block is None:
            every, place = np.unique(members, return_inverse=True)
            block = self.part(every)
        A = block[place[:, :, None], place[:, None, :]]
        A *= inside[:, :, None] & inside[:, None, :]
        A[:, n, n] += ~inside
        return A

    def block(self, members: Ints, inside: Bools) -> tuple[Floats, Floats]:
        """``log |det A|`` (k,) and ``v A^-1 v'`` (k, r, r) of these blocks and the rows v of the borders."""
        A, v = self.within(members, inside), self.borders[members].transpose(0, 2, 1)
        v = v * inside[:, None, :]
        return np.linalg.slogdet(A)[1], v @ np.linalg.solve(A, v.transpose(0, 2, 1))

    def toggled(self, members: Ints, inside: Bools) -> Floats:
        """Change of the cost by toggling sets of meters, (k,).

        With A and v of the set, ``-v' A^-1 v + log |det A|`` generalises that of one meter.

        Parameters
        ----------
        members, inside : (k, g)
            The sets, filled up to the same size, and where they are members.
        """
        p, (log_det, inner) = self.problem.meters, self.block(members, inside)
        sign = np.where(self.chosen[members], -1.0, 1.0) * inside
        out = log_det - inner[:, 0, 0] + (sign * self.size[members]).sum(axis=1)
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
        """Add a fault to the set, or remove it; O(q k).

        Parameters
        ----------
        j
            The fault.
        """
        k, q, r, n = self.count, self.chosen.size, len(self.rows), self.order.size
        column, inside = self._column(j), bool(self.chosen[j])
        d = float(column[j])
        if r + n == self.columns.shape[1]:
            self.columns = np.hstack([self.columns, np.zeros((q + r, n + ROOM))])
            self.columns = np.asfortranarray(self.columns)
        at, live = np.concatenate([np.arange(q, q + r), self.order]), self.columns[:, : r + n]
        blas.dger(-1.0 / d, column, column[at], a=live, overwrite_a=True)
        self.diagonal -= column[:q] ** 2 / d
        pivot = column / (-d if inside else d)
        pivot[j] = self.diagonal[j] = -1.0 / d
        live[j] = pivot[at]
        size = log(abs(d)) + (-self.size[j] if inside else self.size[j])
        self.cost += size - column[q] ** 2 / d + (-1 if inside else 1) * self.problem.charge[j]
        if inside:
            place = int(np.flatnonzero(self.order == j)[0])
            live[:, r + place] = live[:, -1]
            self.order = np.where(self.order == j, self.order[-1], self.order)[:-1]
        else:
            self.columns[:, r + n] = pivot
            self.order = np.append(self.order, j)
        self.chosen[j] = not inside
        if j < self.problem.meters:
            self.count += -1 if inside else 1
        self.cost += self.penalty[self.count] - self.penalty[k]

    def _column(self, j: int) -> Floats:
        """Column of one fault, (q + r,)."""
        if self.chosen[j]:
            return np.asarray(self.beside[:, self.order == j][:, 0])
        column = np.concatenate([self.problem.F[j], self.rows[:, j]])
        column -= self.beside @ column[self.order]
        column[self.order], column[j] = self.beside[j], self.diagonal[j]
        return column

    def group(self, members: Ints, inside: Bools, block: Floats | None = None) -> Floats:
        """Change of the cost by adding the first n meters of sequences, (k, g); inf for one meter or none.

        The factor of a sequence contains those of its beginnings. Chosen meters stay chosen.

        Parameters
        ----------
        members, inside : (k, g)
            The sequences, filled up to the same length, and where they are members.
        block
            As in `within`.
        """
        return self.beginnings(members, inside, block, self.columns[: self.chosen.size, :1].T)[0]

    def beginnings(
        self, members: Ints, inside: Bools, block: Floats | None, rows: Floats
    ) -> tuple[Floats, Bools, Floats]:
        """The same, new members (k, g), and the products of rows (r, q) over the new members, (k, r, r, g).

        Parameters
        ----------
        members, inside, block
            As in `group`.
        rows : (r, q)
            The scores, and other rows beside the tableau.
        """
        p, free, k = self.problem.meters, inside & ~self.chosen[members], self.count
        count = np.cumsum(free, axis=1)
        v = rows[:, members].transpose(1, 0, 2) * free[:, None]
        log_det, inner = _fits(self.within(members, free, block), v)
        size = np.cumsum(free * self.size[members], axis=1)
        out = log_det + size - inner[:, 0, 0] + self.penalty[np.minimum(k + count, p)] - self.penalty[k]
        barred = np.logical_or.accumulate(free & self.barred[members], axis=1)
        return np.where((count > 1) & ~barred, out, inf), free, inner
