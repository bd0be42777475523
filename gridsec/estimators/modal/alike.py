"""Descents among sets of meters with amounts nearly alike, at exact costs.

The amounts of a set J have the prior covariance ``s^2 (share 1 1' + (1 - share) I)``, as in `costs.costs`.
The common amount is integrated out beside a tableau with the rest of the variance. With the posterior mean m
and covariance G of amounts without the common one, and ``w = 1 / (s (1 - share))`` for k meters,

    score a = w_J' m,   information b = k / (1 - share) - w_J' G w_J
    cost(J) = cost by independent amounts + log(1 + share b) - a^2 / (b + 1 / share)

**Pull.** A border row w of the tableau has the value ``u_j = w_j - w_J' G F_Jj`` outside, and ``(G w_J)_j``
inside. By toggling j, with its score v_j and pivot c_j,

    a <- a + u_j v_j / c_j,   b <- b +- 1 / (1 - share) - u_j^2 / c_j

so that all changes by one fault are read off in O(k q), those by an exchange in O(k q) more, and the
beginnings of a sequence of meters from one factor.

**Contiguous sets.** Neighbours that are off by one amount need a step of many meters. False powers of a few
customers explain a part of such a set, and no single meter beside these is worth its penalty. With
independent amounts a group pays for each amount. With one exact amount its own errors count against it.
`search.descend` adds whole groups at the exact cost.

**Sets beside an unknown direction.** An unread power explains the common amount x of many meters nearly: no
group of these helps without the others. `relaxed` adds all at once. Given the set and its common amount, with
the scores v and the information A that are left, the meters g to be added have the relaxation

    minimise  x^2 g' A g / 2 - x v' g,      0 <= g <= 1

which is convex; the meters above `HALF` are added. With nothing chosen, x is the prior standard
deviation with either sign.

References
----------
.. [1] Judice and Pires, A block principal pivoting algorithm for large-scale strictly monotone linear
   complementarity problems, Computers and Operations Research 21, 1994 (the solver).
"""

from __future__ import annotations

from math import inf
from typing import Self

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints, submatrix
from gridsec.estimators.modal.costs import SearchProblem, Tableau, among, common_cost, informed, with_common

HALF = 0.5
"""Share from which on a meter is in the set of the relaxation, and at its start, 1."""
ITERATIONS, TRIES = 300, 5
"""Largest number of pivots of the relaxation, and of those in turn with no fewer violated conditions."""
ROUNDING = 1e-10
"""Least part of the largest value that counts in the relaxation, 1."""


class Alike(Tableau):
    """Sweep tableau of one problem with amounts of meters alike, pivoted on a set.

    Parameters
    ----------
    problem
        The problem.
    share
        Share in common of the meters' variance, above 0 and below 1.
    used : (q,)
        Faults of the problem that sets may contain, all meters among them; None: all. q is then their number.
    """

    def __init__(self, problem: SearchProblem, share: float, used: Bools | None = None) -> None:
        self.charge = float(problem.charge.max(initial=0.0))
        problem = problem if used is None else among(problem, used)
        meter = np.arange(problem.y.size) < problem.meters
        less, self.w = with_common(problem, share)
        super().__init__(less, self.w)
        self.share = share
        self.own = np.where(meter, 1.0 / (1.0 - share), 0.0)

    def copy(self) -> Self:
        """A tableau that can be changed without changing this one."""
        out = super().copy()
        out.share, out.w, out.own, out.charge = self.share, self.w, self.own, self.charge
        return out

    def _common(self) -> tuple[float, float, Floats]:
        """Score and information of the common amount, and the pull of every fault, (q,)."""
        q = self.chosen.size
        pull = self.borders[:, 1]
        return -float(pull[q]), float(self.own[self.chosen].sum() + pull[q + 1]), pull[:q]

    def _term(self, score: Floats | float, information: Floats | float) -> Floats:
        """Cost of the common amount."""
        return common_cost(self.share, score, information)

    def _mean(self, score: Floats | float, information: Floats | float) -> Floats:
        """Posterior mean of the common amount."""
        return np.asarray(score / (np.maximum(information, 0.0) + 1.0 / self.share))

    @property
    def whole(self) -> float:
        """Cost of the set with amounts alike, with the charge of that."""
        score, information, _ = self._common()
        return self.cost + float(self._term(score, information)) + self.charge

    @property
    def amount(self) -> Floats:
        """Posterior means of the amounts of chosen faults, (q,); not defined for others."""
        score, information, pull = self._common()
        return np.asarray(super().amount + pull * self._mean(score, information))

    def steps(self) -> tuple[Floats, Floats]:
        """Change of the cost by toggling each fault, and its amount times its pivot, (q,)."""
        out, v = super().steps()
        a, b, pull = self._common()
        c, more = self.diagonal, np.where(self.chosen, -self.own, self.own)
        score, information = a + pull * v / c, b + more - pull * pull / c
        out += self._term(score, information) - self._term(a, b)
        return out, v + pull * self._mean(score, information)

    def pairs(self, out: Ints) -> tuple[Floats, Floats, Floats]:
        """Change of the cost by exchanges, the amount of the new one times its pivot, and that, (k, q)."""
        both, v, pivot = super().pairs(out)
        c, (a, b, pull) = self.diagonal[out], self._common()
        more = np.where(self.chosen, -self.own, self.own)
        left = pull - self.of(out) * (pull[out] / c)[:, None]
        score = (a + pull[out] * self.columns[out, 0] / c)[:, None] + left * v / pivot
        information = (b - self.own[out] - pull[out] ** 2 / c)[:, None] + more - left * left / pivot
        both += self._term(score, information) - self._term(a, b)
        return both, v + left * self._mean(score, information), pivot

    def group(self, members: Ints, inside: Bools, block: Floats | None = None) -> Floats:
        """Change of the cost by adding the first n meters of sequences, (k, g); inf for one meter or none.

        Parameters
        ----------
        members, inside : (k, g)
            The sequences, filled up to the same length, and where they are members.
        block
            As in `within`.
        """
        a, b, pull = self._common()
        out, free, inner = self.beginnings(members, inside, block, np.stack([super().amount, pull]))
        more = np.cumsum(free * self.own[members], axis=1)
        out += self._term(a + inner[:, 0, 1], b + more - inner[:, 1, 1]) - self._term(a, b)
        return out

    def relaxed(self, common: float | None = None) -> Bools:
        """The set with the meters that the relaxation adds, (q,).

        Parameters
        ----------
        common
            Common amount in prior standard deviations; None: its posterior mean, 0 without a meter.
        """
        p = self.problem.meters
        score, information, pull = self._common()
        common = float(self._mean(score, information)) if common is None else common
        out = self.chosen.copy()
        new = np.flatnonzero(~self.chosen[:p] & ~self.barred[:p] & informed(self.problem))
        if not common or not new.size:
            return out
        x = common * self.w[new] * self.problem.std[new] ** 2.0
        # Without the own variances of the new meters, and with the common amount of the set alone.
        A = self.part(new)
        A[np.diag_indices(new.size)] -= self.problem.std[new] ** -2.0
        left = self.columns[new, 0] + common * (pull - self.w)[new]
        share = bounded_minimum(A * np.outer(x, x), x * left, np.full(new.size, HALF))
        out[new[share > HALF]] = True
        return out


def opposed(problem: SearchProblem, share: float, against: Bools, sign: float) -> float:
    """Lower bound of the costs of sets of meters with amounts alike, by the amounts that oppose these.

    Amounts have the variance v around the common one. A set costs at least its charge and the minimum of

        f' F f - 2 y' f + sum f_j^2 / v_j

    with the sum over amounts of the sign opposite to the common one. The minimum is at least ``-y' f`` for
    ``f = (F + D)^-1 y``, with ``D_jj = 1 / v_j`` for any meters where f has that sign, and 0 for others.
    Determinants and penalties are at least 0.

    Parameters
    ----------
    problem, share
        The problem, and the share of the meters' variance in common, below 1.
    against : (p,)
        Meters of D. Those where f has the sign of the common amount are left out.
    sign
        Sign of the common amount.
    """
    at = np.flatnonzero(informed(problem))
    y, some = sign * problem.y[at], against[at]
    information, own = submatrix(problem.F, at, at), 1.0 / (problem.std[at] ** 2 * (1.0 - share))
    for _ in range(TRIES):
        A = information.copy()
        A[np.diag_indices(at.size)] += np.where(some, own, 0.0)
        _, f, failed = lapack.dposv(A, y, lower=True, overwrite_a=True)
        if failed:
            break
        wrong = some & (f > 0.0)
        if not wrong.any():
            return float(problem.charge.max(initial=0.0) - y @ f)
        some = some & ~wrong
    return -inf


def bounded_minimum(A: Floats, v: Floats, start: Floats, most: float = 1.0) -> Floats:
    """Minimum of ``g' A g / 2 - v' g`` over 0 <= g <= most, (k,), by block principal pivoting [1]_.

    Components are at a bound, or free with ``(A g - v) = 0``. All that violate the conditions of the minimum
    change at once, and only the last one of them where their number does not fall any more.

    Parameters
    ----------
    A, v : (k, k), (k,)
        The positive semidefinite matrix and the vector.
    start : (k,)
        Where to start: components inside the bounds are free at first.
    most
        The upper bound.
    """
    k = v.size
    if not k:
        return start
    B = A + ROUNDING * float(A.diagonal().max()) * np.eye(k)
    low, high, fewest, left = start <= 0.0, start >= most, k + 1, TRIES
    for _ in range(ITERATIONS):
        at, g = np.flatnonzero(~(low | high)), np.zeros(k)
        g[high] = most
        if at.size:
            g[at] = lapack.dposv(submatrix(B, at, at), v[at] - (B[at] @ g), lower=True)[1]
        slope, inside = B @ g - v, ROUNDING * float(np.abs(g).max())
        steep, free = ROUNDING * float(np.abs(v).max()), ~(low | high)
        below, above = free & (g < -inside), free & (g > most + inside)
        wrong = below | above | (low & (slope < -steep)) | (high & (slope > steep))
        count = int(np.count_nonzero(wrong))
        if not count:
            break
        fewest, left = (count, TRIES) if count < fewest else (fewest, left - 1)
        if left < 0:
            wrong &= np.arange(k) == np.flatnonzero(wrong)[-1]
        low, high = np.where(wrong, below, low), np.where(wrong, above, high)
    return np.clip(g, 0.0, most)
