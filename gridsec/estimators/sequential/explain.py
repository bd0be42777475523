"""Hypotheses of several starts on one scale, and their comparison over all scales.

References
----------
docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, product

import numpy as np
from scipy.linalg import lapack
from scipy.special import binom

from gridsec.arrays import Bools, Floats, Ints, any_of, indices, submatrix
from gridsec.estimators.sequential import search
from gridsec.estimators.sequential.blocks import misfit_without, sound, without
from gridsec.estimators.sequential.busbar import Doubt, opposed
from gridsec.estimators.sequential.conditional import Fit, Judged, fit, judge, misfit
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.dictionary import Dictionary
from gridsec.estimators.sequential.loads import UNMETERED
from gridsec.estimators.sequential.robust import covers, robust
from gridsec.estimators.sequential.scales import Scales, View, adapt, believe, view_of
from gridsec.estimators.sequential.search import Explanation, Found, Limits, Solution, likelier
from gridsec.estimators.sequential.state import Trust

_FEW = 32
"""Largest number of meters beyond their limits for a start from the trusted set."""
_CLOSE = 8
"""Largest number of suspects for a search with each of them honest."""
_TOGETHER = 0.5
"""Least prior correlation of two meters moved by the same loads."""
_TURNS = 6
"""Largest number of rounds of reversed groups."""
_EFFORT = 4e9
"""Limits group searches so that count x p^3 <= _EFFORT (about 2 s)."""
_BESIDE = 3
"""Sets of suspects beside which false powers, and neighbourhoods that, are searched."""
_NEAR = 8.0
"""Largest distance from the best cost for a closer comparison, in log(like)."""
_PART = 2
"""Downdate a larger posterior only if it has at most 1/_PART extra meters."""
_SEEDS, _STREET = 32, 64
"""Number of centres of neighbourhoods, and largest size."""
_MOST = 724
"""Largest number of meters for neighbourhoods: each start takes a matrix of 8 bytes x meters^2, 4 MB."""
_PARTS = 2
"""Groups with a common offset in one hypothesis."""
_SIMILAR = 2
"""Largest ratio of the sizes of similar groups."""
_CHANCE, _ANY_LIE = 4.0, 0.2
"""Standard deviations of chi-square within chance; standard deviation of a common offset, squared pu."""


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Neighbourhood with one common offset: meters (p,), gain and charge of the offset."""

    meters: Bools
    gain: float
    charge: float


class Search:
    """Hypotheses from several starts on one scale.

    Starts: the set trusted before, without faults suspected on this scale and shorter ones; with several
    suspects a robust set and all meters close to the model; with any suspect the trusted set with the fault
    dictionary. With few suspects, all meters are trusted once more and removed in pairs; then, for each
    suspect, the likeliest hypothesis in which it is honest. Longer means know more, so they decide again
    about faults suspected on shorter ones.

    Meters with evidence on other scales are not added, or a manipulation that has just begun would be trusted
    again. A hypothesis that adds them wins if it is cheaper over all scales together and the detecting scales
    have enough readings.

    wholes: (s,) kept posteriors of all meters. s: the scale.
    """

    def __init__(
        self,
        design: SequentialDesign,
        scales: Scales,
        wholes: tuple[Fit | None, ...],
        trust: Trust,
        s: int,
    ) -> None:
        self.design, self.scales, self.book = design, scales, scales.book
        self.wholes, self.trust, self.s = wholes, trust, s
        here = scales[s]
        sigmas = min(design.suspect, here.limits.sigmas)
        self.here = replace(here, limits=replace(here.limits, sigmas=sigmas))
        self.keep = _held(trust, s)
        self.owed = ~trust.trusted & (trust.owed > 0)
        self.accused = tuple(suspicion for suspicion in trust.accused if suspicion[1] > s)
        self.turned: list[Explanation] = []
        self.covering: dict[int, Fit | None] = {}
        self.disputed = False
        self.left: dict[tuple[bytes, tuple[int, ...]], list[float]] = {}

    def __call__(self, now: Fit, view: View) -> tuple[Found, Trust]:
        """Candidates with compared rivals, and the resulting trust state."""
        found = self.likeliest(now, view)
        rivals = (*found.others, *self.turned, *self._instead(found.best))
        others = (*self._compared(found.best, rivals), *self._alike_groups(found.best))
        return replace(found, others=others), self._believe(found.best)

    def likeliest(self, now: Fit, view: View) -> Found:
        """Candidates before the comparison with rivals."""
        start = now if len(self.accused) == len(self.trust.accused) else self._fit(now.trusted)
        few = np.count_nonzero(view.over & now.trusted) <= _FEW
        judged = view.judged if start is now else None
        found = Found(self._descend(start, self.keep, judged=judged)) if few else None
        free = None
        if found is None or self._suspected(found) > self.design.options.several:
            free = self._free(found)
            if any_of(free.best.trusted & self.keep):
                trusted = free.best.trusted & ~self.keep
                # A descent from an earlier start would end at the same set.
                if found is None or not np.array_equal(trusted & self.here.enough, start.trusted):
                    held = self._descend(self._fit(trusted), self.keep, fresh=True)
                    found = likelier(found, Found(held))
            else:
                found, free = likelier(found, free), None
        if few and self._suspected(found) > 0:
            found = likelier(found, Found(self._descend(start, self.keep, self.book, judged=judged)))
            if self._suspected(found) <= _CLOSE:
                nobody, all_ = np.zeros_like(self.keep), self._fit(self.here.enough)
                close = self._descend(all_, nobody, self.book, pairs=True, fresh=True)
                free = likelier(free, Found(close))
        if self._unexplained(found.best):
            for trusted in self._sets(found):
                beside = self._descend(self._fit(trusted), self.keep, self.book, fresh=True)
                found = likelier(found, Found(beside))
        best = found.best
        for other in chain(self._turned(best), self._streets(best)):
            free = likelier(free, Found(other))
        if free is not None:
            unknown = any_of(self.owed & self._trusted(free.best))
            better = not unknown and free.best.cost < best.cost and self._total(free.best) < self._total(best)
            first, second = (free, found) if better else (found, free)
            found = Found(first.best, (second.best.bare(), *first.others, *second.others))
        return found

    @property
    def doubt(self) -> Doubt:
        """Limits of the busbar's meter on this scale during a search."""
        return Doubt(self.here.limits.sigmas, self.scales.model, self.scales.doubts.busbar[self.s])

    def opposed(self, now: Fit, judged: Judged) -> list[int]:
        """Busbar phases that the trusted meters contradict, now or before some became suspects."""
        doubt = self.doubt
        out = opposed(self.design, doubt, now, judged)
        self.disputed = bool(out)
        # On a balanced feeder all meters contradict a wrong busbar, in a phase only some.
        if self.design.hangs_on.shape[1] > 1 and any_of(self.here.enough & ~now.trusted & ~self.trust.named):
            every = self._fit(self.here.enough & ~(self.trust.named & ~now.trusted))
            out = sorted({*out, *opposed(self.design, doubt, every, judge(every, self.here.m))})
        return out

    def beside_busbar(self, now: Fit, phase: int) -> Explanation:
        """Likeliest hypothesis with a manipulated busbar meter; the phase is numbered after the faults."""
        design, trust = self.design, self.trust
        here = np.arange(design.hangs_on.shape[1]) == phase
        scales = self.scales.wider(UNMETERED * design.plant.feeder.broadcast_busbar(here))
        wide = scales[self.s]
        there = adapt(None, wide, now.trusted, self.scales.loosened(trust.accused))
        lying = Search(design, scales, self.wholes, trust, self.s)
        best = lying.likeliest(there, view_of(design, wide, judge(there, wide.m))).best
        # Meters that are suspects only beside an honest busbar meter are trusted again.
        honest = lying._descend(lying._fit(wide.enough), np.zeros_like(wide.enough), fresh=True)
        best = min(best, honest, key=lambda one: one.cost)
        charge = search.price(int(np.count_nonzero(self.here.enough)), 1)
        loosened = (*best.loosened, self.book.std.size + phase)
        return Explanation(best.trusted, loosened, best.charge + charge, best.cost + charge)

    def beside_powers(self, now: Fit) -> Explanation:
        """Likeliest hypothesis with false powers at the reduced charges of an alternative."""
        return self._descend(now, self.keep, self.book.doubtful()).bare()

    def _instead(self, best: Solution) -> list[Explanation]:
        """Hypotheses in which one of the meters about to be named is honest."""
        fresh = self.here.enough & ~best.trusted & ~self.trust.named
        if np.count_nonzero(fresh) > _CLOSE:
            return []
        out, keep, limits = [], self.keep & self.trust.named, self._fair()
        for j in indices(fresh).tolist():
            book, one = self.book.doubtful(), np.array([j])
            other = self._descend(best.fit, keep, book, innocent=one, pairs=True, limits=limits)
            honest = self.scales[self.s].limits.of(other.judged.std)[j]
            if self._admissible(other) and abs(other.judged.offset[j]) <= honest:
                charge = best.charge + other.charge
                cost, loosened = best.charge + other.cost, best.loosened + other.loosened
                out.append(Explanation(other.trusted, loosened, charge, cost))
        return out

    def _turned(self, best: Solution) -> list[Solution]:
        """Hypotheses in which a group accused of the same offset is honest and its opponents are manipulated.

        With many meters of a street or phase off alike, two groups contradict each other. No move of a single
        meter leads from one hypothesis to the other.
        """
        out: list[Solution] = []
        left = int(_EFFORT / best.trusted.size**3)
        for _ in range(_TURNS):
            groups = sorted(self._agreeing(best), key=len, reverse=True)[:left]
            pairs = [(group, other) for group in groups for other in self._believing(best, group)]
            out += [other for _, other in pairs]
            left -= len(groups)
            near = best.cost + _NEAR * np.log(self.design.options.like)
            self.turned += [self._closer(group, other) for group, other in pairs if other.cost <= near]
            cheapest = min((other for _, other in pairs), key=lambda other: other.cost, default=best)
            if not cheapest.cost < best.cost:
                break
            best = cheapest
        return out

    def _believing(self, best: Solution, group: Ints) -> list[Solution]:
        """Nearest hypothesis in which a group accused by `best` is honest; none if it accuses too many."""
        here, prior, loose = self.here, self.here.prior, best.fit.loose
        # As many meters stay trusted as may be manipulated.
        most = int(np.count_nonzero(here.enough)) - self.design.most
        if np.count_nonzero(self._contradict(group[group.size // 2], loose)) > most:
            return []
        among = np.zeros_like(best.trusted)
        among[group] = True
        # Further meters can only raise the chi-square of these.
        most_left = best.cost - best.charge + 2.0 * np.log(self.design.options.like)
        if misfit(prior, here.noise, here.m, among, loose) > most_left:
            return []
        judged = judge(fit(prior, here.noise, among, loose), here.m)
        start = among | (best.trusted & (np.abs(judged.offset) <= here.limits.of(judged.std)))
        if np.count_nonzero(here.enough & ~start) > most:
            return []
        now = fit(prior, here.noise, start, loose) if loose.shape[1] else self._fit(start)
        other = self._descend(now, np.zeros_like(among), innocent=group, fresh=True)
        return [self._after(best, other)] if self._admissible(other) else []

    def _streets(self, best: Solution) -> Iterator[Solution]:
        """Hypotheses that start by accusing the neighbourhoods of the largest gain.

        A street that is off alike is consistent within itself: removing any of its meters gains little, and a
        descent accuses its honest neighbours. With b = Q m and G = Q of a group, removing the group gains
        ``b^T G^-1 b`` at once; one Cholesky factor gives it for all groups of the k meters nearest to one.
        """
        here = self.here
        if not self._about_to_be_named(best):
            return
        every = self._fit(here.enough)
        weights, (at, Q) = every.weights(here.m), every.trusting()
        largest = min(self.design.most, _STREET, at.size - 1)
        if largest < 1:
            return
        b, between = weights[at], here.prior.among(at)
        std = np.sqrt(np.maximum(between.diagonal(), np.finfo(np.float64).tiny))
        prices = np.array([search.price(at.size, k) for k in range(1, largest + 1)])
        groups: list[tuple[float, Ints]] = []
        for j in np.argsort(-(b * b) / Q.diagonal())[:_SEEDS].tolist():
            near = np.argsort(-between[j] / std, kind="stable")[:largest]
            root, failed = lapack.dpotrf(submatrix(Q, near, near), lower=True, clean=True)
            if failed:
                continue
            gain = np.cumsum(lapack.dtrtrs(root, b[near], lower=True)[0] ** 2) - prices
            k = int(gain.argmax())
            groups.append((float(gain[k]), at[near[: k + 1]]))
        del every, Q
        covered, left = np.zeros_like(here.enough), _BESIDE
        for gained, group in sorted(groups, key=lambda each: -each[0]):
            if not left or gained <= 0.0:
                return
            if np.count_nonzero(covered[group]) * 2 > group.size:
                continue
            covered[group], left = True, left - 1
            start = here.enough.copy()
            start[group] = False
            yield self._descend(self._fit(start), np.zeros_like(start), fresh=True)

    def _about_to_be_named(self, best: Solution) -> bool:
        """True where the evidence against an accused meter has lasted, or the busbar meter is disputed."""
        here, trust = self.here, self.trust
        lasting = ~trust.trusted & ~trust.named & (trust.age + 1 >= self.design.confirmed[trust.scale])
        return here.enough.size <= _MOST and any_of(here.enough & ~best.trusted & (lasting | self.disputed))

    def _alike_groups(self, best: Solution) -> Iterator[Explanation]:
        """Hypotheses in which one neighbourhood, or two, have one common offset each.

        Such a group is one hypothesis: it costs ``2 ln(p K)`` for its centre and its size of at most K
        meters, and ``2 ln binom(k, e)`` for e honest ones among its k. Its meters keep informing by their
        differences.
        """
        if not self._about_to_be_named(best):
            return
        base = self.here.enough & ~self.trust.named
        taken: list[Bools] = []
        for first in self._neighbourhoods(self._fit(base), best):
            if len(taken) == _BESIDE:
                return
            if any(
                2 * np.count_nonzero(each & first.meters) > np.count_nonzero(first.meters) for each in taken
            ):
                continue
            taken.append(first.meters)
            end, other = self._off_alike(best, base, [first])
            seconds = self._neighbourhoods(end.fit, best)[: _PARTS - 1]
            more = (self._off_alike(best, base, [first, second])[1] for second in seconds)
            yield from (each for each in (other, *more) if self._admissible(each))

    def _neighbourhoods(self, every: Fit, best: Solution) -> list[_Group]:
        """Groups of nearest meters that gain more than they cost, best first.

        With the sums b of Q m and q of Q over a group, its offset gains ``b^2 / q``. Groups are taken whole,
        and without accused meters: a single meter may differ from its street.
        """
        (at, Q), prior = every.trusting(), self.here.prior
        # As many meters stay trusted as may be manipulated.
        largest = min(at.size - self.design.most, _STREET, at.size - 1)
        if largest < 2:
            return []
        b, between, place = every.weights(self.here.m)[at], prior.among(at), prior.meters[at]
        std = np.sqrt(np.maximum(between.diagonal(), np.finfo(np.float64).tiny))
        whole, believed = np.ones(at.size, dtype=np.bool_), best.trusted[at]
        count = np.arange(1, largest + 1)
        centre = 2.0 * np.log(at.size * largest)
        out: list[_Group] = []
        for j in np.argsort(-(b * b) / Q.diagonal())[:_SEEDS].tolist():
            # Correlation orders along a street, covariance by the bus they are behind.
            for likeness, some in product((between[j] / std, between[j]), (whole, believed)):
                near = np.argsort(-likeness, kind="stable")[: largest + 1]
                part = some[near].astype(np.float64)
                sums = np.cumsum(np.cumsum(submatrix(Q, near, near) * np.multiply.outer(part, part), 0), 1)
                gain = np.cumsum(b[near] * part) ** 2 / np.maximum(sums.diagonal(), np.finfo(np.float64).tiny)
                size = np.cumsum(part)[:-1]
                charge = centre + 2.0 * np.log(binom(count, size))
                # Meters of one bus cannot be told apart by a direction of buses.
                net = np.where((place[near[1:]] == place[near[:-1]]) | (size < 2.0), 0.0, gain[:-1] - charge)
                k = int(net.argmax())
                if net[k] > 0.0:
                    among = np.zeros_like(every.trusted)
                    among[at[near[: k + 1]]] = some[near[: k + 1]]
                    out.append(_Group(among, float(gain[k]), float(charge[k])))
        return sorted(out, key=lambda one: one.charge - one.gain)

    def _off_alike(self, best: Solution, base: Bools, groups: list[_Group]) -> tuple[Solution, Explanation]:
        """Candidate that starts with groups off by one amount each, and its hypothesis on all scales."""
        here = self.here
        directions = np.zeros((here.prior.variance.size, len(groups)))
        for k, group in enumerate(groups):
            directions[here.prior.meters[group.meters], k] = _ANY_LIE
        loosened = self.scales.loosened(self.accused)
        loose = directions if loosened is None else np.hstack([loosened, directions])
        end = self._descend(fit(here.prior, here.noise, base, loose), here.enough & ~base, fresh=True)
        dropped = int(np.count_nonzero(here.enough & ~end.trusted))
        alike = np.where(end.trusted[:, None], directions[here.prior.meters], 0.0)
        kept, charge = np.asarray(alike.any(axis=1)), sum(group.charge for group in groups)
        other = Explanation(end.trusted & ~kept, (), charge, 0.0)
        theirs = self._misfits(other, kept, alike)
        worse = max(his - own for his, own in zip(theirs, self._misfits(best), strict=True))
        price = charge + search.price(self.keep.size, dropped, self.design.most)
        return end, replace(other, cost=best.cost + price - self._prices(best) + worse)

    def _admissible(self, found: Explanation) -> bool:
        """True where at least `max_attacked` meters stay trusted."""
        return bool(np.count_nonzero(self.here.enough & found.trusted) >= self.design.most)

    def _closer(self, group: Ints, other: Solution) -> Explanation:
        """Candidate that trusts the group, with the lower limits of alternatives."""
        nobody = np.zeros_like(other.trusted)
        fair, judged = self._fair(), other.judged
        closer = self._descend(other.fit, nobody, innocent=group, limits=fair, judged=judged)
        return (self._after(other, closer) if self._admissible(closer) else other).bare()

    def _after(self, before: Solution, found: Solution) -> Solution:
        """Candidate of a descent without dictionary, charged for the directions of the one before."""
        loosened, live = before.loosened, self.here.enough
        if not loosened:
            return found
        liars = int(np.count_nonzero(live & ~found.trusted))
        charges = self.book.charges(np.array(loosened, dtype=np.intp), found.trusted, liars)
        charge = float(charges.sum()) * search.price(int(np.count_nonzero(live)), 1)
        return replace(found, loosened=loosened, charge=charge, cost=found.cost + charge)

    def _fair(self) -> Limits:
        """Limits of alternatives: every accusation that lowers the cost is tried; none names a meter."""
        fair = float(np.sqrt(search.price(self.keep.size, 1)))
        return replace(self.here.limits, sigmas=min(self.here.limits.sigmas, fair))

    def _contradict(self, j: int, loose: Floats) -> Bools:
        """Meters that cannot be honest if meter j is, from the two readings alone, (p,)."""
        here, prior = self.here, self.here.prior
        more = loose[prior.meters]
        column = prior.of_meters[prior.meters, j] + more @ more[j]
        own = prior.variance[prior.meters] + here.noise + (more * more).sum(axis=1)
        apart = np.maximum(own + own[j] - 2.0 * column, 0.0)
        return np.asarray(here.enough & (np.abs(here.m - here.m[j]) > here.limits.of(np.sqrt(apart))))

    def _agreeing(self, best: Solution) -> list[Ints]:
        """Accused meters of one kind: too high, or too low, and moved by the same loads."""
        accused, out = self.here.enough & ~best.trusted, []
        for sign in (accused & (best.judged.offset > 0.0), accused & (best.judged.offset < 0.0)):
            at = indices(sign)
            out += [at[group] for group in _linked(self._together(at)) if group.size > 1]
        return out

    def _compared(self, best: Solution, rivals: tuple[Explanation, ...]) -> tuple[Explanation, ...]:
        """Rivals, each once, at the cost on the scale with the strongest evidence against it.

        Long means hardly contain a manipulation that has just begun, short ones hardly show a small one.
        """
        like, ours = np.log(self.design.options.like), None
        out: dict[tuple[bytes, tuple[int, ...]], Explanation] = {}
        for other in sorted(rivals, key=lambda rival: rival.cost):
            who = other.trusted.tobytes(), other.loosened
            if who in out or who == (best.trusted.tobytes(), best.loosened):
                continue
            cost = other.cost
            if cost - best.cost <= 2.0 * like:
                ours = self._misfits(best) if ours is None else ours
                cost = self._beside(best, other, ours, self._misfits(other))
            if other.cost - best.cost <= _NEAR * like:
                cost = min(cost, self._swapped(best, other))
            out[who] = replace(other, cost=cost - self.relief(best, other))
        return tuple(out.values())

    def relief(self, best: Explanation, other: Explanation) -> float:
        """Part of another hypothesis's cost that does not count beside the best one.

        The surcharge beyond `max_attacked` keeps the estimate on the side of the majority. It is not evidence
        against a manipulated majority: it does not count against a hypothesis that accuses a group of similar
        size.
        """
        live = self.here.enough
        ours, theirs = (int(np.count_nonzero(live & ~each.trusted)) for each in (best, other))
        fewer, more = sorted((ours + len(best.loosened), theirs + len(other.loosened)))
        if more > _SIMILAR * fewer:
            return 0.0
        size, most = int(np.count_nonzero(live)), self.design.most

        def surcharge(suspects: int) -> float:
            return search.price(size, suspects, most) - search.price(size, suspects)

        return surcharge(theirs) - surcharge(ours)

    def _swapped(self, best: Solution, other: Explanation) -> float:
        """Cost of a rival where groups change sides and each group has one common offset; infinite elsewhere.

        Removing a group removes its chance residuals too, which differ between groups by more than the
        hypotheses. Both are therefore compared on the meters that either trusts, with one unknown amount per
        accused group.
        """
        here = self.here
        believed = here.enough & other.trusted & ~best.trusted
        accused = here.enough & best.trusted & ~other.trusted
        if min(np.count_nonzero(believed), np.count_nonzero(accused)) < 2:
            return np.inf
        ours, freedom = self._alike(best, believed)
        if _beyond_chance(ours[self.s] - best.judged.misfit, freedom):
            return np.inf  # the accused meters have no common offset
        theirs, _ = self._alike(other, accused)
        return self._beside(best, other, ours, theirs)

    def _beside(self, best: Solution, other: Explanation, ours: list[float], theirs: list[float]) -> float:
        """Cost of another hypothesis beside the best, on the scale of the largest chi-square difference."""
        worse = max(his - own for his, own in zip(theirs, ours, strict=True))
        return best.cost + self._prices(other) - self._prices(best) + worse

    def _alike(self, found: Explanation, group: Bools) -> tuple[list[float], int]:
        """Chi-square of a hypothesis, by scale, with one common offset per street of an accused group.

        And the number of its meters less that of the offsets.
        """
        at = indices(group)
        parts = _linked(self._together(at))
        alike = np.zeros((group.size, len(parts)))
        for k, part in enumerate(parts):
            alike[at[part], k] = _ANY_LIE
        return self._misfits(found, group, alike), at.size - len(parts)

    def _together(self, at: Ints) -> Bools:
        """Pairs of meters moved by the same loads, (k, k)."""
        prior = self.here.prior
        between = prior.among(at)
        std = np.sqrt(between.diagonal())
        limit = _TOGETHER * np.multiply.outer(std, std)
        return np.asarray((between >= limit) & (limit > 0.0) | np.eye(at.size, dtype=np.bool_))

    def _unexplained(self, best: Solution) -> bool:
        """True if the chi-square of the trusted meters is beyond chance."""
        return _beyond_chance(best.judged.misfit, int(np.count_nonzero(best.trusted)))

    def _sets(self, found: Found) -> list[Bools]:
        """Trusted meters of the cheapest hypotheses, each set once.

        A false power changes voltages far and near. Accused first, it hides the manipulated meters; with
        these known it stands out.
        """
        each = sorted((found.best, *found.others), key=lambda one: one.cost)
        sets = {one.trusted.tobytes(): one.trusted for one in each if not any_of(one.trusted & self.keep)}
        return list(sets.values())[:_BESIDE]

    def _suspected(self, found: Found) -> int:
        """Least number of suspects in the candidates."""
        enough = self.here.enough
        return min(int(np.count_nonzero(enough & ~each.trusted)) for each in (found.best, *found.others))

    def _free(self, held: Found | None) -> Found:
        """Candidates of starts that do not depend on the meters trusted before.

        A descent stays where another one ended: `held` counts too, unless a meter was only kept from being
        added.
        """
        found: Found | None = None
        ends = [] if held is None or self._holds_back(held.best) else [held.best]
        for chosen in self._starts():
            end = next((end for end in ends if np.array_equal(chosen & self.here.enough, end.trusted)), None)
            if end is None:
                end = self._descend(self._fit(chosen), np.zeros_like(chosen), fresh=True)
                ends.append(end)
            if found is None or end is not found.best:
                found = likelier(found, Found(end))
        assert found is not None  # noqa: S101  # there is a start
        return found

    def _holds_back(self, found: Solution) -> bool:
        """True if a meter that must stay suspect would be added."""
        judged, who = found.judged, self.keep & self.here.enough & ~found.trusted
        return any_of(who & (np.abs(judged.offset) < self.here.limits.of(judged.std)))

    def _starts(self) -> tuple[Bools, Bools]:
        """Robust set, and the meters close to the model."""
        here, prior = self.here, self.here.prior
        focus, std = self.design.options.focus, np.sqrt(here.noise)
        bound = here.limits.model + focus * std
        chosen = robust(prior, here.noise, here.m, here.enough, bound, self._whole(self.s))
        alone = np.sqrt(prior.variance[prior.meters] + here.noise)
        return chosen, here.enough & (np.abs(here.m) <= here.limits.model + focus * alone)

    def _descend(
        self,
        start: Fit,
        keep: Bools,
        book: Dictionary | None = None,
        *,
        innocent: Ints = search.NOBODY,
        pairs: bool = False,
        limits: Limits | None = None,
        fresh: bool = False,
        judged: Judged | None = None,
    ) -> Solution:
        here = self.here
        return search.descend(
            start,
            here.m,
            here.enough,
            here.limits if limits is None else limits,
            keep=keep,
            dictionary=book,
            innocent=innocent,
            pairs=pairs,
            fresh=fresh,
            judged=judged,
        )

    def _fit(self, trusted: Bools) -> Fit:
        loose, wanted = self.scales.loosened(self.accused), trusted & self.here.enough
        near = self._near(self.s, wanted) if loose is None else None
        return fit(self.here.prior, self.here.noise, wanted, loose) if near is None else without(*near)

    def _near(self, s: int, wanted: Bools) -> tuple[Fit, Bools] | None:
        """Fresh posterior of few more meters than wanted, and these; None for none."""
        whole = self._whole(s)
        if whole is None or not sound(whole.prior, whole.noise):
            return None
        more = whole.trusted & ~wanted
        return (whole, more) if np.count_nonzero(more) * _PART <= np.count_nonzero(wanted) else None

    def _whole(self, s: int) -> Fit | None:
        """Kept posterior that covers all meters with readings on a scale."""
        if s not in self.covering:
            whole, here = self.wholes[s], self.scales[s]
            good = whole is not None and covers(whole, here.prior, here.noise, here.enough)
            self.covering[s] = whole if good else None
        return self.covering[s]

    def _total(self, found: Explanation) -> float:
        """Chi-square on all scales plus the cost of the accusations."""
        return self._prices(found) + sum(self._misfits(found))

    def _prices(self, found: Explanation) -> float:
        suspects = int(np.count_nonzero(~self._trusted(found)))
        return found.charge + search.price(self.keep.size, suspects, self.design.most)

    def _trusted(self, found: Explanation) -> Bools:
        return np.where(self.here.enough, found.trusted, self.trust.trusted)

    def _misfits(
        self, found: Explanation, more: Bools | None = None, alike: Floats | None = None
    ) -> list[float]:
        """Chi-square on each scale, with `more` meters that may have common offsets."""
        trusted, out = self._trusted(found), []
        who = trusted.tobytes(), found.loosened
        if more is None and who in self.left:
            return self.left[who]
        trusted = trusted if more is None else trusted | more
        loose = self.scales.loosened((*self.accused, *((k, self.s) for k in found.loosened)))
        for s in range(len(self.design.lengths)):
            there = self.scales[s]
            wanted = trusted & there.enough
            near = self._near(s, wanted) if loose is None and more is None else None
            if s == self.s and more is None and isinstance(found, Solution):
                out.append(found.judged.misfit)
            elif near is not None:
                out.append(misfit_without(near[0], there.m, near[1]))
            else:
                out.append(misfit(there.prior, there.noise, there.m, wanted, loose, alike))
        if more is None:
            self.left[who] = out
        return out

    def _believe(self, best: Explanation) -> Trust:
        accused = (*self.accused, *((k, self.s) for k in best.loosened))
        return believe(self.trust, self._trusted(best), self.s, accused)


def _beyond_chance(left: float, freedom: int) -> bool:
    """True if a chi-square is beyond chance for its degrees of freedom."""
    return bool(left > freedom + _CHANCE * np.sqrt(2.0 * freedom))


def _linked(link: Bools) -> list[Ints]:
    """Connected components of a small graph in which each node is linked to itself."""
    out, left = [], np.ones(len(link), dtype=np.bool_)
    while any_of(left):
        part, more = link[left.argmax()], True
        while more:
            reached = link[part].any(axis=0)
            more, part = any_of(reached & ~part), reached
        out.append(indices(part))
        left &= ~part
    return out


def _held(trust: Trust, s: int) -> Bools:
    """Meters that must stay suspect: named ones, and those with evidence on other scales."""
    other = trust.still[:s].any(axis=0) | trust.still[s + 1 :].any(axis=0)
    return np.asarray(~trust.trusted & (other | (trust.named & trust.still[s])))
