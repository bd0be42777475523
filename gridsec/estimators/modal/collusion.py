"""Check of a naming under collusion: other meters, off by one amount, in place of the accused ones.

The penalty of a set of meters is a prior: few are likelier than many. It may decide as long as one fault
alone explains the readings. Where an explanation has several faults, or meters are masked already, an
adversary has chosen the meters, and its choice has no prior. Let C be the accused meters of one sign in the
likeliest explanation J, or a phase of the busbar, and L the cost without the penalty of meters. A set g of
meters with one amount in place of C is an explanation of its own, at ``max(0, L((J - C) + g) - L(J))`` beyond
J. It has other meters than C, or also some of C with the reverse sign. Let A be the faults of C that g lacks.
They are not named where that is less than

    max(2 log(1 / DOUBT), e (L(J - A) - L(J))),   e = min(MISFIT, 2 share of the misfit that J leaves)

Beside the other liars, one that lies by less seems off by the reverse, as honest meters do. It is in both C
and g. The sets without any of C are taken first, then by their L. Each that keeps further names counts as an
explanation.

Steps and ramps describe a drift of unknown onset and shape to a share of its evidence only, `MISFIT`. Where
they describe it better, J leaves less of the misfit of the readings, chance included. The promise limits g:
(J - C) + g and the masked meters are at most M or a third, whichever is larger. J is the likeliest set
of that number. Where none weighs `DOUBT`, none names a meter.

**Amounts of any size.** An adversary chooses the amounts, too. A set g of at most `MORE` meters for each
fault of J, the masked ones included, has the fit ``E = y_g' (F_gg + V^-1)^-1 y_g`` with wide priors V. It
contests the faults of C that it lacks where ``E(J) - E(g)`` is below `_LEAST`, and so is the gain by each of
them beside g. Such sets are ends of descents by the fit, from the rest without C and from all of J, these
also without one meter, and the sets of earlier searches. Where most powers are read, only explanations with
faults that are no meters are doubted so: loads leave little room for others.

**Decoys.** A meter of C that no g replaces must not protect the others. Where no g keeps a name, the lateral
with the most of C, but not all, splits it. Both parts are checked by themselves, and split again up to
`SPLITS` times: honest meters that seem off together are neighbours.

**False powers.** A coalition of customers that also report false powers can imitate a false power elsewhere
beside an honest meter. Where J has faults that are no meters, customers with a false reading and a false
power each, without a charge, are looked for in place of C and of these faults, the busbar and inverters
included. The customer with possible amounts that lowers L most is added until none lowers it.

**Search of g.** Given the amounts of the rest J - C, g has the information F and the scores y. One amount x
has the relaxation

    minimise  x^2 g' F g / 2 - x y' g,      0 <= g <= 1

which is convex (`alike.bounded_minimum`). With any amounts of the sign, and independent ones of the rest, it
is a minimum over z >= 0 of all usable meters, ``z' F z / 2 - z' y``, a bound. Where that is above the limit
of a naming, the meters with the largest z are the only g. Elsewhere the relaxation's solution orders the
meters, and the best beginning of this order is improved by single meters and by exchanges, and so are the
best of the laterals and of such sets of earlier searches. x is first the mean amount of C, then that of the
set found. Where that gains nothing and the solution has more meters than the promise, x is larger. Where the
best g has meters of C, the best one without them is also found. g is also looked for in place of the rest's
meters of its own sign, since colluding meters may share one amount, and of its faults that are no meters.

Before all that, one bound of L excludes most C (`_Loose`): any amounts of all other meters, and amounts of
the reverse sign of C. It takes one inverse of F for all C, and a problem of the size of C each.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import inf, log
from typing import Self

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints, any_of, submatrix
from gridsec.estimators.modal.alike import HALF, bounded_minimum
from gridsec.estimators.modal.costs import (
    SearchProblem,
    Tableau,
    among,
    informed,
    mean_amounts,
    penalties,
)
from gridsec.estimators.modal.laterals import GAIN, OneAmount
from gridsec.estimators.modal.mirrors import Neighbourhoods
from gridsec.estimators.modal.search import DOUBT, Identification, costs_of, descend, extended, mixed

MISFIT = 0.1
"""Largest share of an explanation's evidence that steps and ramps leave open, 1."""
SPLITS = 2
"""Largest number of times that accused meters of one sign are split, 1: at most seven checks."""
ROUNDS, WORTH = 4, 1.0
"""Largest number of amounts for which the relaxation is solved, and least gain of the cost by one more, 1."""
LARGER = 1.5
"""Next amount over the largest one tried where the relaxation has more meters than are promised, 1."""
_LEAST = -2.0 * log(DOUBT)
"""Difference of L below which a set contests a name in any case, 1: the limit of a naming."""
_COUNTS = -2.0 * log(2.0 * DOUBT)
"""Largest cost of a set that contests a name: twice the weight from which on a set counts in the variance."""
OPEN = 2.0
"""Share that a true set leaves open, in that of the set that suits the readings best, 1."""
STARTS = 4
"""Sets of earlier searches and laterals that are improved besides those of the relaxation, 1."""
WIDE = 0.02
"""Prior standard deviation of amounts of any size, squared pu: 1 % of the voltage. Larger ones cost more."""
MORE = 2
"""Meters with amounts of any size for each fault of J, 1: where far more are needed, their number decides."""
PARAMETER = 2.0
"""Cost of one amount in a descent by the fit, 1: twice the gain by chance (Akaike's criterion)."""
_BEYOND = 1e9
"""Penalty of a meter beyond the promise, 1: above every misfit."""
ALIKE_LESS = 3.0
"""Amount by which L with amounts alike may be below the bound of independent ones, 1: 2 log 2, and more."""


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """Explanations after the check. p meters, q faults.

    Attributes
    ----------
    found
        The explanations, with the sets that keep names.
    contested : (q,)
        Meters and phases of the busbar that keep no name.
    replacing : (q,) each
        The sets that keep names.
    """

    found: Identification
    contested: Bools
    replacing: tuple[Bools, ...] = ()


def weighed(
    found: Identification,
    masked: Bools,
    near: Neighbourhoods,
    left: float = inf,
    known: Sequence[Bools] = (),
    *,
    unread: bool = True,
) -> Weighed:
    """Explanations with sets of meters that may replace accused ones.

    Parameters
    ----------
    found
        The explanations.
    masked : (p,)
        Masked meters: they count in the promised number.
    near
        Laterals, and the largest number of manipulated meters that is promised.
    left
        Share of the misfit that the likeliest explanation leaves.
    known : (q,) each
        Such sets of earlier searches.
    unread
        Many powers are unread: amounts of any size also contest meters that are accused alone.
    """
    p, one = found.named.size, found.chosen[0]
    first = one.size - near.phases.shape[1]
    named = np.zeros_like(one)
    named[:p] = found.named & ~masked
    named[first:] = found.certain[first:]
    if not any_of(named) or (np.count_nonzero(one) == 1 and not any_of(masked)):
        return Weighed(found, np.zeros_like(one))
    most = max(near.most, p // 3)
    kept = np.count_nonzero(found.chosen[:, :p] | masked, axis=1) <= most
    likely = np.flatnonzero(kept & (found.weight >= DOUBT))
    if not likely.size:
        return Weighed(replace(found, named=found.named & masked), named)
    J, model = found.chosen[likely[0]], int(found.model[likely[0]])
    problem, amount = found.problems[model], np.zeros(J.size)
    amount[J] = mean_amounts(problem, J)
    by_model, contested, replacing = costs_of(found), np.zeros_like(J), list[Bools]()
    # The onset may be older than that of a masked meter, which J then has, too.
    fresh = J & (np.arange(J.size) < p)
    fresh[:p] &= ~masked
    sets = [fresh & (sign * amount > 0.0) for sign in _SIGNS]
    sets += [np.arange(J.size) == k for k in np.flatnonzero(J[first:]) + first]
    whole, loose = float(_evidence(problem, J[None])[0]), _Loose.of(problem, J)
    begun = np.vstack([near.laterals, *(each[:p] for each in known)])
    silent = np.append(~informed(problem), np.zeros(J.size - p, dtype=np.bool_))
    every = _Case(
        problem,
        J,
        amount,
        J,
        masked,
        most,
        near.powers,
        begun,
        tuple(each & ~silent for each in known),
        min(MISFIT, OPEN * left),
        whole,
        _fit(problem, J),
        loose,
    )

    def contest(accused: Bools, others: Iterable[tuple[float, Bools]]) -> None:
        for more, other in others:
            kept = accused & named & ~other & ~contested
            if any_of(kept):
                contested[kept] = True
                replacing.append(other)
                # No more than J: few meters are likelier than many. What keeps names counts in the estimate.
                cost = min(by_model[model][J.tobytes()] + max(more, GAIN), _COUNTS)
                key = other.tobytes()
                by_model[model][key] = min(cost, by_model[model].get(key, inf))

    any_size = unread or any_of(J[p:])
    if any_size:
        contest(J, every.singly(named))
    cases = [(replace(every, accused=each), SPLITS) for each in sets]
    while cases:
        case, splits = cases.pop()
        accused = case.accused
        if not any_of(accused & named & ~contested):
            continue
        least = case.bound()
        contest(accused, chain(case.contesting(least), case.graded(least) if any_size else ()))
        if splits and not any_of(accused & contested):
            cases += [(replace(case, accused=part), splits - 1) for part in _split(accused, near.laterals)]
    if not any_of(contested):
        return Weighed(found, contested)
    out = extended(found, by_model)
    return Weighed(replace(out, named=out.named & ~contested[:p]), contested, tuple(replacing))


_SIGNS = (1.0, -1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """Accused faults C in an explanation: meters of one sign, or a phase of the busbar. p meters, q faults.

    Attributes
    ----------
    problem
        The problem of its model.
    J, amount : (q,), (q,)
        The explanation, and its amounts.
    accused : (q,)
        The faults C.
    masked : (p,)
        Masked meters.
    most
        Largest number of manipulated meters that is promised.
    powers : (p,)
        Fault of each meter's customer that is its false power.
    known : (k, p)
        Sets of meters from which g is looked for, besides those of the relaxation.
    sets : (q,) each
        Sets of earlier searches, without masked meters.
    left
        Share of the evidence that J leaves open.
    whole, fit
        L of J, and its fit with amounts of any size.
    loose
        Bound of L without some faults; None for none.
    """

    problem: SearchProblem
    J: Bools
    amount: Floats
    accused: Bools
    masked: Bools
    most: int
    powers: Ints
    known: Bools
    sets: tuple[Bools, ...]
    left: float
    whole: float
    fit: float
    loose: _Loose | None

    @property
    def rest(self) -> Bools:
        """The explanation without C, (q,)."""
        return self.J & ~self.accused

    @property
    def meters(self) -> Bools:
        """The meters of C, (p,)."""
        return self.accused[: self.problem.meters]

    @property
    def sign(self) -> float:
        """Sign of their amounts."""
        return float(np.sign(self.amount[self.accused][0]))

    def bound(self) -> float:
        """Bound of L and of the reverse of the fit, without C or with the reverse sign of its meters."""
        return -inf if self.loose is None else self.loose.without(self.accused, self.sign)

    def contesting(self, least: float) -> list[tuple[float, Bools]]:
        """Differences of L from J, and sets (q,) that keep names of C: those without any of C, then by L.

        Parameters
        ----------
        least
            The bound.
        """
        without = float(_evidence(self.problem, self.rest[None])[0])
        excluded = least > self._limit(self.whole, without) + ALIKE_LESS
        if excluded and not any_of(self.J[self.problem.meters :]):
            return []
        own = self.own(without)
        limit = self._limit(own, without)
        sets = chain(() if excluded else self.instead(without, limit), self.customers())
        found = [(any_of(self.accused & one[1]), *one) for one in sets if one[0] < limit]
        if not found:
            return []
        found.sort(key=lambda one: one[:2])
        lacking = [self.J & ~(self.accused & ~other) for *_, other in found]
        more = [max(0.0, each - own) for _, each, _ in found]
        alone = _evidence(self.problem, np.stack(lacking)) - own
        near = more < np.maximum(_LEAST, self.left * alone)
        return [(one, other) for one, (*_, other), some in zip(more, found, near, strict=True) if some]

    def _limit(self, own: float, without: float) -> float:
        """Limit that L of a set is to fall below, by L of the explanation and of that without C."""
        return own + max(_LEAST, self.left * (without - own))

    def own(self, without: float) -> float:
        """L of the explanation, with one amount of C where that is less; `without`: L without C."""
        problem, rest = self.problem, self.rest
        if not any_of(self.meters):
            return self.whole
        at, y, F = _beside(problem, rest, self.meters)
        every = np.ones((1, at.size), dtype=np.bool_)
        alike = _OneSign(self.sign * y, F, float(problem.std[0]) ** 2, every).cost[0]
        return min(self.whole, without + float(alike))

    def instead(self, without: float, limit: float) -> Iterator[tuple[float, Bools]]:
        """L of sets without C, or with the reverse sign of some, and the sets, (q,).

        Parameters
        ----------
        without, limit
            L of the explanation without C, and the limit that L of a set is to fall below.
        """
        problem, p, rest, masked = self.problem, self.problem.meters, self.rest, self.masked
        size = float(np.abs(self.amount[self.accused]).mean())
        yield without, rest
        kept = []
        for each, signs in self._beginnings():
            at, y, F = _beside(problem, each, ~each[:p])
            room = self.most - int(np.count_nonzero(each[:p] | masked))
            begun = without if np.array_equal(each, rest) else float(_evidence(problem, each[None])[0])
            s2, own = float(problem.std[0]) ** 2, self.meters[at]
            for sign in signs:
                relaxed = _Relaxed(sign * y, F, s2, ~masked[at], room, self.known[:, at])
                # The best set without any of them may keep more names.
                for barred in (np.zeros_like(own), own) if sign == -self.sign else (own,):
                    least, inside = relaxed.found(size, barred, limit + ALIKE_LESS - begun)
                    if any_of(inside):
                        both = each.copy()
                        both[at[inside]] = True
                        kept.append(both)
                        yield begun + least, both
                    if least == inf or not any_of(inside & own):
                        break
        if kept:
            yield from zip(_evidence(problem, np.stack(kept)).tolist(), kept, strict=True)

    def customers(self) -> Iterator[tuple[float, Bools]]:
        """L of customers with false readings and powers in place of C, and the sets, (q,)."""
        problem, rest, masked, powers = self.problem, self.rest, self.masked, self.powers
        p = problem.meters
        if not any_of(self.J[p:]):
            return
        charge = problem.charge.copy()
        charge[powers] = 0.0
        free, chosen = replace(problem, charge=charge), rest & (np.arange(rest.size) < p)
        # The powers of masked customers are free, too.
        least, usable = float(_evidence(free, chosen[None])[0]), (informed(problem) | masked) & ~self.meters
        while True:
            added = np.flatnonzero(usable & ~chosen[powers])
            sets = np.repeat(chosen[None], added.size, axis=0)
            sets[np.arange(added.size), added] = sets[np.arange(added.size), powers[added]] = True
            sets = sets[np.count_nonzero(sets[:, :p] | masked, axis=1) <= self.most]
            each = _evidence(free, sets) if len(sets) else np.zeros(0)
            order = [k for k in np.argsort(each, kind="stable").tolist() if each[k] < least - GAIN]
            possible = (
                k for k in order if not any_of(np.abs(mean_amounts(free, sets[k])) > free.bound[sets[k]])
            )
            best = next(possible, None)
            if best is None:
                return
            chosen, least = sets[best], float(each[best])
            yield least, chosen

    def graded(self, least: float) -> Iterator[tuple[float, Bools]]:
        """Differences of the fits from that of J, and a set of meters with amounts of any size, (q,).

        A descent by the fit begins at the meters of the rest, and has none of C.

        Parameters
        ----------
        least
            The bound.
        """
        if least + self.fit < _LEAST:
            meter = np.arange(self.J.size) < self.problem.meters
            yield from self._fitting(self._descended(self.rest & meter, ~meter | self.accused, 0), ())

    def singly(self, named: Bools) -> Iterator[tuple[float, Bools]]:
        """Such sets without one of the meters named, (q,): earlier ones, and the end of a descent from J."""
        meter = np.arange(self.J.size) < self.problem.meters
        each = named & meter
        if self.loose is not None:
            each &= self.loose.without_each(np.sign(self.amount)) + self.fit < _LEAST
        if any_of(each):
            for one in (self._descended(self.J & meter, ~meter, 1), *self.sets):
                yield from self._fitting(one, np.flatnonzero(each).tolist())

    def _fitting(self, other: Bools, single: Sequence[int]) -> Iterator[tuple[float, Bools]]:
        """A set (q,) and those without one of some meters, if they fit and keep the promise.

        Where J leaves a misfit, a set of many meters fits better: it also has the faults of C that it needs.
        """
        for j in (-1, *(j for j in single if other[j])):
            one = other & (np.arange(other.size) != j)
            one |= self.accused & (_Fit(self.problem).gained(one) >= _LEAST)
            if np.count_nonzero(one[: self.masked.size] | self.masked) <= self.largest:
                more = self.fit - _fit(self.problem, one)
                if more < _LEAST:
                    yield max(0.0, more), one

    @property
    def largest(self) -> int:
        """Largest number of meters of a set with amounts of any size, the masked ones included."""
        p = self.masked.size
        own = np.count_nonzero(self.J[:p] | self.masked) + np.count_nonzero(self.J[p:])
        return min(self.most, MORE * int(own))

    def _descended(self, start: Bools, barred: Bools, beyond: int) -> Bools:
        """End of a descent by the fit, with some meters beyond the promise at most, (q,)."""
        p = self.problem.meters
        room = self.largest + beyond - int(np.count_nonzero(self.masked & ~start[:p]))
        return descend(_Fit(self.problem, barred, room).pivot(start)).chosen

    def _beginnings(self) -> list[tuple[Bools, tuple[float, ...]]]:
        """Sets that others are added to, (q,), and the signs of these: the rest, and parts of it."""
        rest, meter = self.rest, np.arange(self.J.size) < self.problem.meters
        fewer: list[tuple[Bools, tuple[float, ...]]] = [(rest & meter, _SIGNS)]
        fewer += [(rest & ~(meter & (sign * self.amount > 0.0)), (sign,)) for sign in _SIGNS]
        return [(rest, _SIGNS), *(one for one in fewer if not np.array_equal(one[0], rest))]


@dataclass(frozen=True, slots=True, eq=False)
class _Loose:
    """Bound of L of all sets of meters beside the other faults of an explanation.

    The amounts of meters have no prior. With the amounts m that fit best and their covariance G, amounts f of
    some of these leave ``(f - m)' G^-1 (f - m)`` more of the misfit.

    Attributes
    ----------
    place : (q,)
        Number of each fault among the k usable ones; -1 for others.
    mean, cov : (k,), (k, k)
        m and G of the usable faults.
    least
        The bound.
    """

    place: Ints
    mean: Floats
    cov: Floats
    least: float

    @classmethod
    def of(cls, problem: SearchProblem, J: Bools) -> Self | None:
        """Bound beside the faults of J that are no meters, (q,); None where readings are too few."""
        meter = np.arange(J.size) < problem.meters
        at = np.flatnonzero(np.append(informed(problem), J[problem.meters :]))
        A, place = submatrix(problem.F, at, at), np.full(J.size, -1)
        A[np.diag_indices(at.size)] += np.where(meter, 0.0, problem.std**-2.0)[at]
        half, failed = lapack.dpotrf(A, lower=True, overwrite_a=True)
        if failed:
            return None
        inverse, _ = lapack.dpotri(half, lower=True)
        cov = np.tril(inverse) + np.tril(inverse, -1).T
        place[at], mean = np.arange(at.size), cov @ problem.y[at]
        return cls(place, mean, cov, -float(problem.y[at] @ mean))

    def without(self, accused: Bools, sign: float) -> float:
        """Bound of sets without some faults (q,), or with their meters' amounts of the reverse sign."""
        at = self.place[accused]
        at = at[at >= 0]
        if not at.size:
            return self.least
        mean = sign * self.mean[at]
        precision = np.asarray(np.linalg.inv(submatrix(self.cov, at, at)), np.float64)
        off = mean + bounded_minimum(precision, -(precision @ mean), np.zeros(at.size), inf)
        return self.least + float(off @ precision @ off)

    def without_each(self, sign: Floats) -> Floats:
        """The same without one fault, or with its amount of the reverse sign, for each fault, (q,).

        Parameters
        ----------
        sign : (q,)
            Sign of each amount; 0 for faults that stay.
        """
        off = np.maximum(sign * self.mean[self.place], 0.0)
        return np.where(self.place >= 0, self.least + off * off / self.cov.diagonal()[self.place], self.least)


def _split(accused: Bools, laterals: Bools) -> tuple[Bools, ...]:
    """Accused faults (q,) inside and outside of the lateral (g, p) with most meters of them, but not all.

    () for none.
    """
    p = laterals.shape[1]
    inside = np.count_nonzero(laterals & accused[:p], axis=1)
    inside[inside == np.count_nonzero(accused)] = 0
    if not any_of(inside):
        return ()
    one = np.zeros_like(accused)
    one[:p] = laterals[inside.argmax()]
    return accused & one, accused & ~one


def _evidence(problem: SearchProblem, sets: Bools) -> Floats:
    """L of sets, (k,), with amounts of their own and with amounts alike, the mean of both likelihoods."""
    count = np.count_nonzero(sets[:, : problem.meters], axis=1)
    return np.asarray(mixed(problem, sets) - penalties(problem.meters)[count])


class _Fit(Tableau):
    """Tableau with the fit as its cost: amounts of any size, and `PARAMETER` for each.

    Parameters
    ----------
    problem
        The problem.
    barred : (q,)
        Faults that stay outside; None: none.
    room
        Largest number of meters; None: all.
    """

    def __init__(self, problem: SearchProblem, barred: Bools | None = None, room: int | None = None) -> None:
        p, q = problem.meters, problem.y.size
        super().__init__(replace(problem, std=_wide(problem)))
        self.barred |= np.zeros(q, dtype=np.bool_) if barred is None else barred
        room = p if room is None else room
        self.penalty = PARAMETER * np.arange(p + 1.0) + np.where(np.arange(p + 1) > room, _BEYOND, 0.0)

    def gained(self, chosen: Bools) -> Floats:
        """Gain of the fit by each fault beside a set, (q,); 0 for its own."""
        self.pivot(chosen)
        return np.where(chosen, 0.0, self.columns[: chosen.size, 0] ** 2 / self.diagonal)

    def steps(self) -> tuple[Floats, Floats]:
        """Change of the cost by toggling each fault, and its amount times its pivot, (q,)."""
        out, v = super().steps()
        sign = np.where(self.chosen, -1.0, 1.0)
        return out - np.log(np.abs(self.diagonal)) - sign * self.size, v

    def pairs(self, out: Ints) -> tuple[Floats, Floats, Floats]:
        """Change of the cost by pairs, as in `Tableau`."""
        both, pull, pivot = super().pairs(out)
        both -= np.log(np.abs(pivot)) + np.where(self.chosen, -1.0, 1.0) * self.size
        both -= (np.log(-self.diagonal[out]) - self.size[out])[:, None]
        return both, pull, pivot


def _wide(problem: SearchProblem) -> Floats:
    """Prior standard deviations with amounts of any size for meters, (q,)."""
    meter = np.arange(problem.y.size) < problem.meters
    return np.where(meter, WIDE, problem.std)


def _fit(problem: SearchProblem, chosen: Bools) -> float:
    """Part ``y' (F + V^-1)^-1 y`` of the misfit that a set (q,) takes away, with amounts of any size."""
    return float(problem.y[chosen] @ mean_amounts(replace(problem, std=_wide(problem)), chosen))


def _beside(problem: SearchProblem, own: Bools, meters: Bools) -> tuple[Ints, Floats, Floats]:
    """Some meters (p,) with readings, their scores (k,) and information (k, k), for any amounts of `own`."""
    at, used = np.flatnonzero(informed(problem) & meters), own.copy()
    used[at] = True
    few, place = among(problem, used), np.cumsum(used)[at] - 1
    left = Tableau(few).pivot(own[used])
    F = left.part(place)
    F[np.diag_indices(at.size)] -= problem.std[at] ** -2.0
    return at, left.columns[place, 0], F


class _OneSign(OneAmount):
    """Sets with one amount of a sign: an amount of the other sign gains nothing."""

    def fit(self, a: Floats, b: Floats) -> Floats:
        """Fits of sets with scores a and information b."""
        return super().fit(np.maximum(a, 0.0), b)


class _Limited(_OneSign):
    """Sets of at least one meter, and at most `room` of those that count, (k,)."""

    def __init__(self, relaxed: _Relaxed, inside: Bools) -> None:
        super().__init__(relaxed.y, relaxed.F, relaxed.s2, inside)
        self.counted, self.room = relaxed.counted, relaxed.room

    def toggled(self) -> Floats:
        """Costs after toggling each meter, (n, k)."""
        sign, fit = self.moved()
        counted = np.count_nonzero(self.inside & self.counted, axis=1)[:, None] + sign * self.counted
        return np.where((self.count[:, None] + sign > 0) & (counted <= self.room), fit, inf)

    def descend(self) -> Self:
        """Lower the costs by single meters and by exchanges until none of them helps."""
        for _ in range(self.y.size):
            super().descend()
            exchanged = [self._exchange(row) for row in range(len(self.inside))]
            if not any(exchanged):
                break
        return self

    def _exchange(self, row: int) -> bool:
        """Make the best exchange of a member for another, if one helps."""
        inside = self.inside[row]
        out, into = np.flatnonzero(inside), np.flatnonzero(~inside)
        if not out.size or not into.size:
            return False
        own, rows = self.own, self.rows[row]
        a = self.a[row] + np.subtract.outer(-self.y[out], -self.y[into])
        b = self.b[row] + np.add.outer(own[out] - 2.0 * rows[out], own[into] + 2.0 * rows[into])
        b -= 2.0 * submatrix(self.F, out, into)
        counted = int(np.count_nonzero(inside & self.counted))
        more = np.subtract.outer(-self.counted[out].astype(np.intp), -self.counted[into].astype(np.intp))
        fit = np.where(counted + more <= self.room, self.fit(a, b), inf)
        i, j = np.unravel_index(int(fit.argmin()), fit.shape)
        if not fit[i, j] < self.cost[row] - GAIN:
            return False
        for one in (out[i], into[j]):
            self.toggle(np.array([row]), np.array([one]))
        return True


@dataclass(frozen=True, slots=True, eq=False)
class _Relaxed:
    """Sets of meters with one amount beside faults with amounts of their own.

    Attributes
    ----------
    y, F : (k,), (k, k)
        Scores of the meters, for an amount of the sign, and their information, for any amounts of the faults.
    s2
        Prior variance of the amount.
    counted : (k,)
        Meters that count in the size of a set.
    room
        Largest number of these.
    known : (n, k)
        Sets that are improved besides the relaxation's.
    """

    y: Floats
    F: Floats
    s2: float
    counted: Bools
    room: int
    known: Bools

    def found(self, amount: float, barred: Bools, limit: float) -> tuple[float, Bools]:
        """Least fit without the meters barred, (k,), and its set; infinite where the bound excludes all."""
        n, out = np.flatnonzero(~barred), np.zeros_like(barred)
        F, known = submatrix(self.F, n, n), self.known[:, n]
        part = _Relaxed(self.y[n], F, self.s2, self.counted[n], self.room, known)
        least, inside = part.bound()
        least, inside = part.best(amount) if least < limit else (inf, inside)
        out[n[inside]] = True
        return least, out

    def best(self, amount: float) -> tuple[float, Bools]:
        """Least fit of one amount, at most 0, and its set, (k,)."""
        least, best = 0.0, np.zeros(self.y.size, dtype=np.bool_)
        if not best.size or self.room <= 0:
            return least, best
        start, tried = np.full(best.size, HALF), amount
        known = self._known()
        for _ in range(ROUNDS):
            share, before, now = self._share(amount, start), least, 0.0
            end = _Limited(self, np.vstack([self._rounded(share), known])).descend()
            known = known[:0]
            one = int(end.cost.argmin())
            if end.cost[one] < least:
                least, best = float(end.cost[one]), end.inside[one]
                now = float(end.a[one] / (end.b[one] + 1.0 / self.s2))
            if not (least < before - WORTH and now > 0.0):
                if share @ self.counted <= self.room:
                    break
                # Sets within the promise have larger amounts.
                now = LARGER * tried
            start, amount = np.clip(share * amount / now, 0.0, 1.0), now
            tried = max(tried, now)
        return least, best

    def _known(self) -> Bools:
        """Known sets with the best fits, (n, k)."""
        count = np.count_nonzero(self.known & self.counted, axis=1)
        some = np.unique(self.known[(count <= self.room) & self.known.any(axis=1)], axis=0)
        one = _OneSign(self.y, self.F, self.s2, some[:0])
        fit = one.fit(some @ self.y, np.vecdot(some @ self.F, some))
        return np.asarray(some[np.argsort(fit, kind="stable")[:STARTS]])

    def _rounded(self, share: Floats) -> Bools:
        """Beginnings of the order by the shares: the best one, the larger half, and the longest, (n, k)."""
        order = np.argsort(-share, kind="stable")
        order = order[np.cumsum(self.counted[order]) <= self.room]
        F = submatrix(self.F, order, order)
        one = _OneSign(self.y, self.F, self.s2, np.zeros((1, share.size), dtype=np.bool_))
        nested = one.fit(np.cumsum(self.y[order]), np.cumsum(np.cumsum(F, 0), 1).diagonal())
        half = max(1, int((share[order] > HALF).sum()))
        each = np.unique([int(nested.argmin()) + 1, half, order.size])
        out = np.zeros((each.size, share.size), dtype=np.bool_)
        out[:, order] = np.arange(order.size) < each[:, None]
        return out

    def bound(self) -> tuple[float, Bools]:
        """Bound of the fits of all sets with amounts of the sign, at most 0, and meters with the largest."""
        z = bounded_minimum(self.F, self.y, np.zeros(self.y.size), inf)
        order = np.argsort(-z, kind="stable")
        inside = np.zeros(z.size, dtype=np.bool_)
        inside[order[np.cumsum(self.counted[order]) <= self.room]] = True
        return float(z @ (self.F @ z) - 2.0 * (self.y @ z)), inside & (z > 0.0)

    def _share(self, amount: float, start: Floats) -> Floats:
        """Solution of the relaxation, (k,)."""
        return bounded_minimum(amount * amount * self.F, amount * self.y, start)
