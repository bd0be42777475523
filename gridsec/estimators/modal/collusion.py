"""Check of a naming under collusion: other meters, off by one amount, in place of the accused ones.

The penalty of a set of meters is a prior: few are likelier than many. It may decide as long as one fault
alone explains the readings. Where an explanation has several faults, or meters are masked already, an
adversary has chosen the meters, and its choice has no prior. Let C be the accused meters of one sign in the
likeliest explanation J, and L the cost without the penalty of meters. A set g of other meters in place of C
is an explanation of its own, at ``max(0, L((J - C) + g) - L(J))`` beyond J. C is not named where that is less
than

    max(2 log(1 / DOUBT), MISFIT (L(J - C) - L(J)))

Steps and ramps describe a drift of unknown onset and shape to a share of its evidence only, `MISFIT`. The
promise limits g: (J - C) + g and the masked meters are at most M or a third, whichever is larger. An
explanation of more meters names none. Meters of one sign are on trial together: one that nothing replaces
protects the others.

**Search of g.** Given the amounts of the rest J - C, g has the information F and the scores y. One amount x
has the relaxation

    minimise  x^2 g' F g / 2 - x y' g,      0 <= g <= 1,      g = 0 on C

which is convex [1]_. Its solution orders the meters. The best beginning of this order is improved by single
meters. x is first the mean amount of C, then that of the set found. g is also looked for in place of the
rest's meters of its own sign, since colluding meters may share one amount.

References
----------
.. [1] Byrd, Lu, Nocedal and Zhu, A limited memory algorithm for bound constrained optimization, SIAM Journal
   on Scientific Computing 16, 1995 (the solver).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf, log

import numpy as np
from scipy.optimize import minimize

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.estimators.modal.costs import SearchProblem, costs, informed, mean_amounts, penalties
from gridsec.estimators.modal.search import ALIKE, DOUBT, Identification, costs_of, identified

MISFIT = 0.1
"""Share of an explanation's evidence that steps and ramps leave open, 1."""
ROUNDS, GAIN = 4, 1.0
"""Largest number of amounts for which the relaxation is solved, and least gain of the cost by one more, 1."""
ITERATIONS = 300
"""Largest number of iterations of the relaxation; most take below 100."""
HALF = 0.5
"""Share from which on a meter is in the set of the relaxation, and at its start, 1."""
LEAST = 1e-9
"""Least change of the cost that counts, 1: rounding."""


def weighed(found: Identification, masked: Bools, most: int) -> Identification:
    """Explanations with sets of other meters that may replace accused ones.

    Parameters
    ----------
    found
        The explanations.
    masked : (p,)
        Masked meters: they count in the promised number.
    most
        Largest number of manipulated meters that is promised.
    """
    p, J = found.named.size, found.chosen[0]
    named = found.named & ~masked
    if not any_of(named) or (np.count_nonzero(J) == 1 and not any_of(masked)):
        return found
    most = max(most, p // 3)
    if np.count_nonzero(J[:p] | masked) > most:
        return replace(found, named=found.named & masked)
    model = int(found.model[0])
    problem, amount = found.problems[model], np.zeros(J.size)
    amount[J] = mean_amounts(problem, J)
    by_model, least = costs_of(found), -2.0 * log(DOUBT)
    contested = np.zeros(p, dtype=np.bool_)
    for sign in (1.0, -1.0):
        # The onset may be older than that of a masked meter, which J then has, too.
        accused = J[:p] & ~masked & (sign * amount[:p] > 0.0)
        if not any_of(accused & named):
            continue
        own, without = _own(problem, J, accused, sign, masked)
        each, other = min(_instead(problem, J, amount, accused, masked, most), key=lambda pair: pair[0])
        more = max(0.0, each - own)
        if more < max(least, MISFIT * (without - own)):
            contested |= accused & named
            key = other.tobytes()
            # No more than J: few meters are likelier than many.
            cost = by_model[model][J.tobytes()] + max(more, LEAST)
            by_model[model][key] = min(cost, by_model[model].get(key, inf))
    if not any_of(contested):
        return found
    out = identified(found.problems, by_model)
    return replace(out, named=out.named & ~contested)


def _own(problem: SearchProblem, J: Bools, accused: Bools, sign: float, masked: Bools) -> tuple[float, float]:
    """L of the explanation, with one amount of the meters accused where that is less, and without them."""
    rest = J.copy()
    rest[: problem.meters] &= ~accused
    whole, without = _evidence(problem, np.stack([J, rest])).tolist()
    one = _relaxed(problem, rest, ~accused, sign, masked)
    every = np.ones((1, one.at.size))
    alike = one.costs(every @ one.y, ((every @ one.F) * every).sum(axis=1))
    return min(whole, without + float(alike[0])), without


def _instead(  # noqa: PLR0917  # one explanation
    problem: SearchProblem, J: Bools, amount: Floats, accused: Bools, masked: Bools, most: int
) -> Iterator[tuple[float, Bools]]:
    """L of sets without the meters accused, (p,), and the sets, (q,)."""
    p, rest = problem.meters, J.copy()
    rest[:p] &= ~accused
    size = float(np.abs(amount[:p][accused]).mean())
    kept = [rest]
    for sign in (1.0, -1.0):
        without = rest.copy()
        without[:p] &= ~(sign * amount[:p] > 0.0)
        for each in (rest,) if np.array_equal(without, rest) else (rest, without):
            one = _relaxed(problem, each, accused, sign, masked)
            room = most - int(np.count_nonzero(each[:p] | masked))
            cost, inside = one.best(size, room)
            if any_of(inside):
                both = each.copy()
                both[one.at[inside]] = True
                yield float(_evidence(problem, each[None])[0]) + cost, both
                kept.append(both)
    yield from zip(_evidence(problem, np.stack(kept)).tolist(), kept, strict=True)


def _evidence(problem: SearchProblem, sets: Bools) -> Floats:
    """L of sets, (k,), with amounts of their own and with amounts alike, the mean of both likelihoods."""
    count = np.count_nonzero(sets[:, : problem.meters], axis=1)
    out = costs(problem, sets)
    several = np.flatnonzero(count > 1)
    if several.size:
        alike = costs(problem, sets[several], ALIKE)
        out[several] = -2.0 * (np.logaddexp(-0.5 * out[several], -0.5 * alike) - log(2.0))
    return np.asarray(out - penalties(problem.meters)[count])


def _relaxed(problem: SearchProblem, own: Bools, barred: Bools, sign: float, masked: Bools) -> _Relaxed:
    """Sets of one amount of a sign, of meters that are neither in `own` (q,) nor `barred` (p,)."""
    p = problem.meters
    at, beside = np.flatnonzero(informed(problem) & ~own[:p] & ~barred), np.flatnonzero(own)
    y, F = problem.y[at], problem.F[np.ix_(at, at)]
    if beside.size:
        A = problem.F[np.ix_(beside, beside)] + np.diag(problem.std[beside] ** -2.0)
        cross = problem.F[np.ix_(beside, at)]
        gain = np.linalg.solve(A, cross).T
        y, F = y - gain @ problem.y[beside], F - gain @ cross
    return _Relaxed(at, ~masked[at], sign * y, F, float(problem.std[0]) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Relaxed:
    """Sets of meters with one amount beside faults with amounts of their own.

    Attributes
    ----------
    at : (k,)
        The meters.
    counted : (k,)
        Those that count in the size of a set.
    y, F : (k,), (k, k)
        Their scores, for an amount of the sign, and information for any amounts of the faults.
    s2
        Prior variance of the amount.
    """

    at: Ints
    counted: Bools
    y: Floats
    F: Floats
    s2: float

    def best(self, amount: float, room: int) -> tuple[float, Bools]:
        """Least cost of one amount, at most 0, and its set, (k,); at most `room` counted meters."""
        least, best = 0.0, np.zeros(self.at.size, dtype=np.bool_)
        if not best.size or room <= 0:
            return least, best
        start = np.full(self.at.size, HALF)
        for _ in range(ROUNDS):
            share, before = self._share(amount, start), least
            order = np.argsort(-share, kind="stable")
            order = order[np.cumsum(self.counted[order]) <= room]
            nested = self.costs(
                np.cumsum(self.y[order]), np.cumsum(np.cumsum(self.F[np.ix_(order, order)], 0), 1).diagonal()
            )
            for k in {int(nested.argmin()), max(1, int((share[order] > HALF).sum())) - 1, order.size - 1}:
                inside = np.zeros(self.at.size, dtype=np.bool_)
                inside[order[: k + 1]] = True
                cost, inside = self._improved(float(nested[k]), inside, room)
                if cost < least:
                    least, best = cost, inside
            rows = self.F @ best
            now = float(self.y @ best) / (float(rows @ best) + 1.0 / self.s2)
            if not (least < before - GAIN and now > 0.0):
                break
            start, amount = np.clip(share * amount / now, 0.0, 1.0), now
        return least, best

    def _share(self, amount: float, start: Floats) -> Floats:
        """Solution of the relaxation, (k,)."""
        F, y = amount * amount * self.F, amount * self.y

        def cost(g: Floats) -> tuple[float, Floats]:
            rows = F @ g
            return float(0.5 * (g @ rows) - y @ g), rows - y

        bounds = [(0.0, 1.0)] * y.size
        found = minimize(
            cost, start, jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": ITERATIONS}
        )
        return np.asarray(found.x)

    def costs(self, a: Floats, b: Floats) -> Floats:
        """Cost of one amount with scores a and information b; an amount of the other sign gains nothing."""
        a, b = np.maximum(a, 0.0), np.maximum(b, 0.0)
        return np.asarray(np.log1p(self.s2 * b) - a * a / (b + 1.0 / self.s2))

    def _improved(self, cost: float, inside: Bools, room: int) -> tuple[float, Bools]:
        """Descent by single meters."""
        for _ in range(4 * inside.size):
            sign, rows = np.where(inside, -1.0, 1.0), self.F @ inside
            count = int(np.count_nonzero(inside & self.counted)) + sign * self.counted
            some = np.count_nonzero(inside) + sign > 0
            b = float(rows @ inside) + 2.0 * sign * rows + self.F.diagonal()
            each = self.costs(float(self.y @ inside) + sign * self.y, b)
            each = np.where(some & (count <= room), each, inf)
            j = int(each.argmin())
            if not each[j] < cost - LEAST:
                break
            inside[j] = not inside[j]
            cost = float(each[j])
        return cost, inside
