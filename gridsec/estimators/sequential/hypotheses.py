"""Hypotheses of several starts on one scale, their comparison over all scales, and exchanges.

An exchange of one accused meter or direction for another follows from the posterior of the likeliest
hypothesis, without a new factorisation.

References
----------
docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product

import numpy as np
from scipy.linalg import lapack
from scipy.special import binom

from gridsec.arrays import Bools, Floats, Ints, any_of, indices, submatrix
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.device_checks import BusbarTest, contradicted_phases
from gridsec.estimators.sequential.posterior import (
    UNMETERED,
    LeaveOneOut,
    Posterior,
    chi_square,
    chi_square_without,
    condition,
    leave_one_out,
    remove_meters,
    well_conditioned,
)
from gridsec.estimators.sequential.search import (
    NO_METERS,
    Candidate,
    Candidates,
    FaultDictionary,
    Hypothesis,
    Limits,
    covers,
    descend,
    merged,
    robust_set,
    set_cost,
)
from gridsec.estimators.sequential.state import TrustState
from gridsec.estimators.sequential.time_scales import Scales, ScaleTest, scale_test, update_posterior

_FEW = 32
"""Largest number of meters beyond their limits for a start from the trusted set."""


_CLOSE = 8
"""Largest number of suspects for a search with each of them honest."""


_TOGETHER = 0.5
"""Least prior correlation of two meters moved by the same loads."""


_REVERSALS = 6
"""Largest number of rounds of reversed groups."""


_EFFORT = 4e9
"""Limits group searches so that count x p^3 <= _EFFORT (about 2 s)."""


_BESIDE = 3
"""Number of sets of suspects searched for false powers, and of neighbourhoods searched."""


_NEAR = 8.0
"""Largest distance from the best cost for a closer comparison, in log(like)."""


_PART = 2
"""Downdate a larger posterior only if it has at most 1/_PART extra meters."""


_SEEDS, _LARGEST = 32, 64
"""Number of centres of neighbourhoods, and largest size."""


_MOST = 724
"""Largest number of meters for neighbourhoods: each start takes a matrix of 8 bytes x meters^2, 4 MB."""


_PARTS = 2
"""Groups with a common offset in one hypothesis."""


_SIMILAR = 2
"""Largest ratio of the sizes of similar groups."""


_CHANCE, _OFFSET_STD = 4.0, 0.2
"""Standard deviations of chi-square within chance; standard deviation of a common offset, squared pu."""


@dataclass(frozen=True, slots=True, eq=False)
class _OffsetGroup:
    """Neighbourhood with one common offset: meters (p,), gain and charge of the offset."""

    meters: Bools
    gain: float
    charge: float


class HypothesisSearch:
    """Hypotheses from several starts on one scale.

    Starts: the set trusted before, without faults suspected on this scale and shorter ones; with several
    suspects a robust set and all meters close to the model; with any suspect the trusted set with the fault
    dictionary. With few suspects, all meters are trusted once more and removed in pairs; then, for each
    suspect, the likeliest hypothesis in which it is honest. Longer means know more, so they decide again
    about faults suspected on shorter ones.

    Meters with evidence on other scales are not added, or a manipulation that has just begun would be trusted
    again. A hypothesis that adds them wins if it is cheaper over all scales together and the detecting scales
    have enough readings.

    full_posteriors: (s,) kept posteriors of all meters. s: the scale.
    """

    def __init__(
        self,
        design: SequentialDesign,
        scales: Scales,
        full_posteriors: tuple[Posterior | None, ...],
        trust: TrustState,
        s: int,
    ) -> None:
        self.design, self.scales, self.faults = design, scales, scales.faults
        self.full_posteriors, self.trust, self.s = full_posteriors, trust, s
        here = scales[s]
        sigmas = min(design.suspect, here.limits.sigmas)
        self.here = replace(here, limits=replace(here.limits, sigmas=sigmas))
        self.barred = _barred(trust, s)
        self.readings_owed = ~trust.trusted & (trust.readings_owed > 0)
        self.accused = tuple(suspicion for suspicion in trust.accused if suspicion[1] > s)
        self.reversed: list[Hypothesis] = []
        self.covering: dict[int, Posterior | None] = {}
        self.busbar_disputed = False
        self.chi_squares: dict[tuple[bytes, tuple[int, ...]], list[float]] = {}

    def __call__(self, now: Posterior, test: ScaleTest) -> tuple[Candidates, TrustState]:
        """Candidates with compared rivals, and the resulting trust state."""
        candidates = self.likeliest(now, test)
        rivals = (*candidates.others, *self.reversed, *self._exonerations(candidates.best))
        others = (*self._compared(candidates.best, rivals), *self._common_offsets(candidates.best))
        return replace(candidates, others=others), self._trust(candidates.best)

    def likeliest(self, now: Posterior, test: ScaleTest) -> Candidates:
        """Candidates before the comparison with rivals."""
        start = now if len(self.accused) == len(self.trust.accused) else self._condition(now.trusted)
        few = np.count_nonzero(test.above_limit & now.trusted) <= _FEW
        loo = test.loo if start is now else None
        candidates = Candidates(self._descend(start, self.barred, loo=loo)) if few else None
        free = None
        if candidates is None or self._suspects(candidates) > self.design.options.several:
            free = self._independent(candidates)
            if any_of(free.best.trusted & self.barred):
                trusted = free.best.trusted & ~self.barred
                # A descent from an earlier start would end at the same set.
                if candidates is None or not np.array_equal(trusted & self.here.enough, start.trusted):
                    held = self._descend(self._condition(trusted), self.barred, fresh=True)
                    candidates = merged(candidates, Candidates(held))
            else:
                candidates, free = merged(candidates, free), None
        if few and self._suspects(candidates) > 0:
            candidates = merged(
                candidates, Candidates(self._descend(start, self.barred, self.faults, loo=loo))
            )
            if self._suspects(candidates) <= _CLOSE:
                no_meters, all_ = np.zeros_like(self.barred), self._condition(self.here.enough)
                close = self._descend(all_, no_meters, self.faults, pairs=True, fresh=True)
                free = merged(free, Candidates(close))
        if self._unexplained(candidates.best):
            for trusted in self._cheapest_sets(candidates):
                beside = self._descend(self._condition(trusted), self.barred, self.faults, fresh=True)
                candidates = merged(candidates, Candidates(beside))
        best = candidates.best
        for other in chain(self._reversals(best), self._neighbourhood_starts(best)):
            free = merged(free, Candidates(other))
        if free is not None:
            unknown = any_of(self.readings_owed & self._trusted(free.best))
            better = (
                not unknown
                and free.best.cost < best.cost
                and self._total_cost(free.best) < self._total_cost(best)
            )
            first, second = (free, candidates) if better else (candidates, free)
            candidates = Candidates(first.best, (second.best.hypothesis(), *first.others, *second.others))
        return candidates

    @property
    def busbar_test(self) -> BusbarTest:
        """Limits of the busbar's meter on this scale during a search."""
        return BusbarTest(self.here.limits.sigmas, self.scales.model, self.scales.uncertainty.busbar[self.s])

    def contradicted_phases(self, now: Posterior, loo: LeaveOneOut) -> list[int]:
        """Busbar phases that the trusted meters contradict, now or before some became suspects."""
        doubt = self.busbar_test
        out = contradicted_phases(self.design, doubt, now, loo)
        self.busbar_disputed = bool(out)
        # On a balanced feeder all meters contradict a wrong busbar, in a phase only some.
        if self.design.busbar_incidence.shape[1] > 1 and any_of(
            self.here.enough & ~now.trusted & ~self.trust.named
        ):
            every = self._condition(self.here.enough & ~(self.trust.named & ~now.trusted))
            out = sorted(
                {*out, *contradicted_phases(self.design, doubt, every, leave_one_out(every, self.here.m))}
            )
        return out

    def with_busbar(self, now: Posterior, phase: int) -> Hypothesis:
        """Likeliest hypothesis with a manipulated busbar meter; the phase is numbered after the faults."""
        design, trust = self.design, self.trust
        here = np.arange(design.busbar_incidence.shape[1]) == phase
        scales = self.scales.with_direction(UNMETERED * design.plant.feeder.broadcast_busbar(here))
        wide = scales[self.s]
        there = update_posterior(None, wide, now.trusted, self.scales.unknowns(trust.accused))
        wider = HypothesisSearch(design, scales, self.full_posteriors, trust, self.s)
        best = wider.likeliest(there, scale_test(design, wide, leave_one_out(there, wide.m))).best
        # Meters that are suspects only beside an honest busbar meter are trusted again.
        honest = wider._descend(wider._condition(wide.enough), np.zeros_like(wide.enough), fresh=True)
        best = min(best, honest, key=lambda one: one.cost)
        charge = set_cost(int(np.count_nonzero(self.here.enough)), 1)
        accused = (*best.faults, self.faults.std.size + phase)
        return Hypothesis(best.trusted, accused, best.charge + charge, best.cost + charge)

    def with_false_powers(self, now: Posterior) -> Hypothesis:
        """Likeliest hypothesis with false powers at the reduced charges of an alternative."""
        return self._descend(now, self.barred, self.faults.reduced()).hypothesis()

    def _exonerations(self, best: Candidate) -> list[Hypothesis]:
        """Hypotheses in which one of the meters about to be named is honest."""
        fresh = self.here.enough & ~best.trusted & ~self.trust.named
        if np.count_nonzero(fresh) > _CLOSE:
            return []
        out, keep, limits = [], self.barred & self.trust.named, self._lowered_limits()
        for j in indices(fresh).tolist():
            faults, one = self.faults.reduced(), np.array([j])
            other = self._descend(best.posterior, keep, faults, protected=one, pairs=True, limits=limits)
            honest = self.scales[self.s].limits.limit(other.loo.std)[j]
            if self._admissible(other) and abs(other.loo.residual[j]) <= honest:
                charge = best.charge + other.charge
                cost, accused = best.charge + other.cost, best.faults + other.faults
                out.append(Hypothesis(other.trusted, accused, charge, cost))
        return out

    def _reversals(self, best: Candidate) -> list[Candidate]:
        """Hypotheses in which a group accused of the same offset is honest and its opponents are manipulated.

        With many meters of a street or phase off alike, two groups contradict each other. No move of a single
        meter leads from one hypothesis to the other.
        """
        out: list[Candidate] = []
        left = int(_EFFORT / best.trusted.size**3)
        for _ in range(_REVERSALS):
            groups = sorted(self._accused_groups(best), key=len, reverse=True)[:left]
            pairs = [(group, other) for group in groups for other in self._exonerated(best, group)]
            out += [other for _, other in pairs]
            left -= len(groups)
            near = best.cost + _NEAR * np.log(self.design.options.like)
            self.reversed += [self._relaxed(group, other) for group, other in pairs if other.cost <= near]
            cheapest = min((other for _, other in pairs), key=lambda other: other.cost, default=best)
            if not cheapest.cost < best.cost:
                break
            best = cheapest
        return out

    def _exonerated(self, best: Candidate, group: Ints) -> list[Candidate]:
        """Nearest hypothesis in which a group accused by `best` is honest; none if it accuses too many."""
        here, prior, unknowns = self.here, self.here.prior, best.posterior.unknowns
        # As many meters stay trusted as may be manipulated.
        most = int(np.count_nonzero(here.enough)) - self.design.max_attacked
        if np.count_nonzero(self._contradicting(group[group.size // 2], unknowns)) > most:
            return []
        among = np.zeros_like(best.trusted)
        among[group] = True
        # Further meters can only raise the chi-square of these.
        most_left = best.cost - best.charge + 2.0 * np.log(self.design.options.like)
        if chi_square(prior, here.noise, here.m, among, unknowns) > most_left:
            return []
        loo = leave_one_out(condition(prior, here.noise, among, unknowns), here.m)
        start = among | (best.trusted & (np.abs(loo.residual) <= here.limits.limit(loo.std)))
        if np.count_nonzero(here.enough & ~start) > most:
            return []
        now = condition(prior, here.noise, start, unknowns) if unknowns.shape[1] else self._condition(start)
        other = self._descend(now, np.zeros_like(among), protected=group, fresh=True)
        return [self._charged(best, other)] if self._admissible(other) else []

    def _neighbourhood_starts(self, best: Candidate) -> Iterator[Candidate]:
        """Hypotheses that start by accusing the neighbourhoods of the largest gain.

        A street that is off alike is consistent within itself: removing any of its meters gains little, and a
        descent accuses its honest neighbours. With b = Q m and G = Q of a group, removing the group gains
        ``b^T G^-1 b`` at once; one Cholesky factor gives it for all groups of the k meters nearest to one.
        """
        here = self.here
        if not self._near_confirmation(best):
            return
        every = self._condition(here.enough)
        weights, (at, Q) = every.weights(here.m), every.precision()
        largest = min(self.design.max_attacked, _LARGEST, at.size - 1)
        if largest < 1:
            return
        b, between = weights[at], here.prior.among(at)
        std = np.sqrt(np.maximum(between.diagonal(), np.finfo(np.float64).tiny))
        prices = np.array([set_cost(at.size, k) for k in range(1, largest + 1)])
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
            yield self._descend(self._condition(start), np.zeros_like(start), fresh=True)

    def _near_confirmation(self, best: Candidate) -> bool:
        """True where the evidence against an accused meter has lasted, or the busbar meter is disputed."""
        here, trust = self.here, self.trust
        lasting = (
            ~trust.trusted & ~trust.named & (trust.ticks_suspect + 1 >= self.design.confirmed[trust.scale])
        )
        return here.enough.size <= _MOST and any_of(
            here.enough & ~best.trusted & (lasting | self.busbar_disputed)
        )

    def _common_offsets(self, best: Candidate) -> Iterator[Hypothesis]:
        """Hypotheses in which one neighbourhood, or two, have one common offset each.

        Such a group is one hypothesis: it costs ``2 ln(p K)`` for its centre and its size of at most K
        meters, and ``2 ln binom(k, e)`` for e honest ones among its k. Its meters keep informing by their
        differences.
        """
        if not self._near_confirmation(best):
            return
        base = self.here.enough & ~self.trust.named
        taken: list[Bools] = []
        for first in self._neighbourhoods(self._condition(base), best):
            if len(taken) == _BESIDE:
                return
            if any(
                2 * np.count_nonzero(each & first.meters) > np.count_nonzero(first.meters) for each in taken
            ):
                continue
            taken.append(first.meters)
            end, other = self._with_offsets(best, base, [first])
            seconds = self._neighbourhoods(end.posterior, best)[: _PARTS - 1]
            more = (self._with_offsets(best, base, [first, second])[1] for second in seconds)
            yield from (each for each in (other, *more) if self._admissible(each))

    def _neighbourhoods(self, every: Posterior, best: Candidate) -> list[_OffsetGroup]:
        """Groups of nearest meters that gain more than they cost, best first.

        With the sums b of Q m and q of Q over a group, its offset gains ``b^2 / q``. Groups are taken whole,
        and without accused meters: a single meter may differ from its street.
        """
        (at, Q), prior = every.precision(), self.here.prior
        # As many meters stay trusted as may be manipulated.
        largest = min(at.size - self.design.max_attacked, _LARGEST, at.size - 1)
        if largest < 2:
            return []
        b, between, place = every.weights(self.here.m)[at], prior.among(at), prior.meters[at]
        std = np.sqrt(np.maximum(between.diagonal(), np.finfo(np.float64).tiny))
        whole, honest = np.ones(at.size, dtype=np.bool_), best.trusted[at]
        count = np.arange(1, largest + 1)
        centre = 2.0 * np.log(at.size * largest)
        out: list[_OffsetGroup] = []
        for j in np.argsort(-(b * b) / Q.diagonal())[:_SEEDS].tolist():
            # Correlation orders along a street, covariance by the bus they are behind.
            for likeness, some in product((between[j] / std, between[j]), (whole, honest)):
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
                    out.append(_OffsetGroup(among, float(gain[k]), float(charge[k])))
        return sorted(out, key=lambda one: one.charge - one.gain)

    def _with_offsets(
        self, best: Candidate, base: Bools, groups: list[_OffsetGroup]
    ) -> tuple[Candidate, Hypothesis]:
        """Candidate that starts with groups off by one amount each, and its hypothesis on all scales."""
        here = self.here
        directions = np.zeros((here.prior.variance.size, len(groups)))
        for k, group in enumerate(groups):
            directions[here.prior.meters[group.meters], k] = _OFFSET_STD
        accused = self.scales.unknowns(self.accused)
        unknowns = directions if accused is None else np.hstack([accused, directions])
        end = self._descend(
            condition(here.prior, here.noise, base, unknowns), here.enough & ~base, fresh=True
        )
        dropped = int(np.count_nonzero(here.enough & ~end.trusted))
        alike = np.where(end.trusted[:, None], directions[here.prior.meters], 0.0)
        kept, charge = np.asarray(alike.any(axis=1)), sum(group.charge for group in groups)
        other = Hypothesis(end.trusted & ~kept, (), charge, 0.0)
        theirs = self._chi_squares(other, kept, alike)
        worse = max(more - less for more, less in zip(theirs, self._chi_squares(best), strict=True))
        price = charge + set_cost(self.barred.size, dropped, self.design.max_attacked)
        return end, replace(other, cost=best.cost + price - self._accusation_cost(best) + worse)

    def _admissible(self, hypothesis: Hypothesis) -> bool:
        """True where at least `max_attacked` meters stay trusted."""
        return bool(np.count_nonzero(self.here.enough & hypothesis.trusted) >= self.design.max_attacked)

    def _relaxed(self, group: Ints, other: Candidate) -> Hypothesis:
        """Candidate that trusts the group, with the lower limits of alternatives."""
        no_meters = np.zeros_like(other.trusted)
        fair, loo = self._lowered_limits(), other.loo
        closer = self._descend(other.posterior, no_meters, protected=group, limits=fair, loo=loo)
        return (self._charged(other, closer) if self._admissible(closer) else other).hypothesis()

    def _charged(self, before: Candidate, hypothesis: Candidate) -> Candidate:
        """Candidate of a descent without dictionary, charged for the directions of the one before."""
        accused, available = before.faults, self.here.enough
        if not accused:
            return hypothesis
        suspects = int(np.count_nonzero(available & ~hypothesis.trusted))
        charges = self.faults.charges(np.array(accused, dtype=np.intp), hypothesis.trusted, suspects)
        charge = float(charges.sum()) * set_cost(int(np.count_nonzero(available)), 1)
        return replace(hypothesis, faults=accused, charge=charge, cost=hypothesis.cost + charge)

    def _lowered_limits(self) -> Limits:
        """Limits of alternatives: every accusation that lowers the cost is tried; none names a meter."""
        fair = float(np.sqrt(set_cost(self.barred.size, 1)))
        return replace(self.here.limits, sigmas=min(self.here.limits.sigmas, fair))

    def _contradicting(self, j: int, unknowns: Floats) -> Bools:
        """Meters that cannot be honest if meter j is, from the two readings alone, (p,)."""
        here, prior = self.here, self.here.prior
        more = unknowns[prior.meters]
        column = prior.covariance[prior.meters, j] + more @ more[j]
        own = prior.variance[prior.meters] + here.noise + (more * more).sum(axis=1)
        apart = np.maximum(own + own[j] - 2.0 * column, 0.0)
        return np.asarray(here.enough & (np.abs(here.m - here.m[j]) > here.limits.limit(np.sqrt(apart))))

    def _accused_groups(self, best: Candidate) -> list[Ints]:
        """Accused meters of one kind: too high, or too low, and moved by the same loads."""
        accused, out = self.here.enough & ~best.trusted, []
        for sign in (accused & (best.loo.residual > 0.0), accused & (best.loo.residual < 0.0)):
            at = indices(sign)
            out += [at[group] for group in _components(self._linked(at)) if group.size > 1]
        return out

    def _compared(self, best: Candidate, rivals: tuple[Hypothesis, ...]) -> tuple[Hypothesis, ...]:
        """Rivals, each once, at the cost on the scale with the strongest evidence against it.

        Long means hardly contain a manipulation that has just begun, short ones hardly show a small one.
        """
        like, ours = np.log(self.design.options.like), None
        out: dict[tuple[bytes, tuple[int, ...]], Hypothesis] = {}
        for other in sorted(rivals, key=lambda rival: rival.cost):
            which = other.trusted.tobytes(), other.faults
            if which in out or which == (best.trusted.tobytes(), best.faults):
                continue
            cost = other.cost
            if cost - best.cost <= 2.0 * like:
                ours = self._chi_squares(best) if ours is None else ours
                cost = self._relative_cost(best, other, ours, self._chi_squares(other))
            if other.cost - best.cost <= _NEAR * like:
                cost = min(cost, self._reversal_cost(best, other))
            out[which] = replace(other, cost=cost - self.relief(best, other))
        return tuple(out.values())

    def relief(self, best: Hypothesis, other: Hypothesis) -> float:
        """Part of another hypothesis's cost that does not count beside the best one of similar size.

        The surcharge beyond `max_attacked` keeps the estimate on the side of the majority; it is not evidence
        against a manipulated majority. The charge of a suspect's false power beyond one accusation keeps the
        search from explaining noise; it is not evidence against a device with false voltage and power. A
        hypothesis that accuses more meters beside the power keeps the whole charge.
        """
        available = self.here.enough
        ours, theirs = (int(np.count_nonzero(available & ~each.trusted)) for each in (best, other))
        fewer, more = sorted((ours + len(best.faults), theirs + len(other.faults)))
        if more > _SIMILAR * fewer:
            return 0.0
        size, most = int(np.count_nonzero(available)), self.design.max_attacked

        def surcharge(suspects: int) -> float:
            return set_cost(size, suspects, most) - set_cost(size, suspects)

        if theirs > ours:
            return surcharge(theirs) - surcharge(ours)
        own = np.array([k for k in other.faults if k < self.faults.std.size], dtype=np.intp)
        own = own[self.faults.beside_suspect(own, other.trusted)]
        beyond = np.maximum(self.faults.charges(own, other.trusted, theirs) - 1.0, 0.0)
        return surcharge(theirs) - surcharge(ours) + float(beyond.sum()) * set_cost(size, 1)

    def _reversal_cost(self, best: Candidate, other: Hypothesis) -> float:
        """Cost of a rival where groups change sides and each group has one common offset; infinite elsewhere.

        Removing a group removes its chance residuals too, which differ between groups by more than the
        hypotheses. Both are therefore compared on the meters that either trusts, with one unknown amount per
        accused group.
        """
        here = self.here
        honest = here.enough & other.trusted & ~best.trusted
        accused = here.enough & best.trusted & ~other.trusted
        if min(np.count_nonzero(honest), np.count_nonzero(accused)) < 2:
            return np.inf
        ours, freedom = self._offset_chi_squares(best, honest)
        if _beyond_chance(ours[self.s] - best.loo.chi_square, freedom):
            return np.inf  # the accused meters have no common offset
        theirs, _ = self._offset_chi_squares(other, accused)
        return self._relative_cost(best, other, ours, theirs)

    def _relative_cost(
        self, best: Candidate, other: Hypothesis, ours: list[float], theirs: list[float]
    ) -> float:
        """Cost of another hypothesis beside the best, on the scale of the largest chi-square difference."""
        worse = max(more - less for more, less in zip(theirs, ours, strict=True))
        return best.cost + self._accusation_cost(other) - self._accusation_cost(best) + worse

    def _offset_chi_squares(self, hypothesis: Hypothesis, group: Bools) -> tuple[list[float], int]:
        """Chi-square of a hypothesis, by scale, with one common offset per street of an accused group.

        And the number of its meters less that of the offsets.
        """
        at = indices(group)
        parts = _components(self._linked(at))
        alike = np.zeros((group.size, len(parts)))
        for k, part in enumerate(parts):
            alike[at[part], k] = _OFFSET_STD
        return self._chi_squares(hypothesis, group, alike), at.size - len(parts)

    def _linked(self, at: Ints) -> Bools:
        """Pairs of meters moved by the same loads, (k, k)."""
        prior = self.here.prior
        between = prior.among(at)
        std = np.sqrt(between.diagonal())
        limit = _TOGETHER * np.multiply.outer(std, std)
        return np.asarray((between >= limit) & (limit > 0.0) | np.eye(at.size, dtype=np.bool_))

    def _unexplained(self, best: Candidate) -> bool:
        """True if the chi-square of the trusted meters is beyond chance."""
        return _beyond_chance(best.loo.chi_square, int(np.count_nonzero(best.trusted)))

    def _cheapest_sets(self, candidates: Candidates) -> list[Bools]:
        """Trusted meters of the cheapest hypotheses, each set once.

        A false power changes voltages far and near. Accused first, it hides the manipulated meters; with
        these known it stands out.
        """
        each = sorted((candidates.best, *candidates.others), key=lambda one: one.cost)
        sets = {one.trusted.tobytes(): one.trusted for one in each if not any_of(one.trusted & self.barred)}
        return list(sets.values())[:_BESIDE]

    def _suspects(self, candidates: Candidates) -> int:
        """Least number of suspects in the candidates."""
        enough = self.here.enough
        return min(
            int(np.count_nonzero(enough & ~each.trusted)) for each in (candidates.best, *candidates.others)
        )

    def _independent(self, held: Candidates | None) -> Candidates:
        """Candidates of starts that do not depend on the meters trusted before.

        A descent stays where another one ended: `held` counts too, unless a meter was only kept from being
        added.
        """
        candidates: Candidates | None = None
        ends = [] if held is None or self._holds_back(held.best) else [held.best]
        for chosen in self._starts():
            end = next((end for end in ends if np.array_equal(chosen & self.here.enough, end.trusted)), None)
            if end is None:
                end = self._descend(self._condition(chosen), np.zeros_like(chosen), fresh=True)
                ends.append(end)
            if candidates is None or end is not candidates.best:
                candidates = merged(candidates, Candidates(end))
        assert candidates is not None  # noqa: S101  # there is a start
        return candidates

    def _holds_back(self, hypothesis: Candidate) -> bool:
        """True if a meter that must stay suspect would be added."""
        loo, which = hypothesis.loo, self.barred & self.here.enough & ~hypothesis.trusted
        return any_of(which & (np.abs(loo.residual) < self.here.limits.limit(loo.std)))

    def _starts(self) -> tuple[Bools, Bools]:
        """Robust set, and the meters close to the model."""
        here, prior = self.here, self.here.prior
        focus, std = self.design.options.focus, np.sqrt(here.noise)
        bound = here.limits.model + focus * std
        chosen = robust_set(prior, here.noise, here.m, here.enough, bound, self._full_posterior(self.s))
        alone = np.sqrt(prior.variance[prior.meters] + here.noise)
        return chosen, here.enough & (np.abs(here.m) <= here.limits.model + focus * alone)

    def _descend(
        self,
        start: Posterior,
        keep: Bools,
        faults: FaultDictionary | None = None,
        *,
        protected: Ints = NO_METERS,
        pairs: bool = False,
        limits: Limits | None = None,
        fresh: bool = False,
        loo: LeaveOneOut | None = None,
    ) -> Candidate:
        here = self.here
        return descend(
            start,
            here.m,
            here.enough,
            here.limits if limits is None else limits,
            keep=keep,
            faults=faults,
            protected=protected,
            pairs=pairs,
            fresh=fresh,
            loo=loo,
        )

    def _condition(self, trusted: Bools) -> Posterior:
        unknowns, wanted = self.scales.unknowns(self.accused), trusted & self.here.enough
        near = self._close_posterior(self.s, wanted) if unknowns is None else None
        return (
            condition(self.here.prior, self.here.noise, wanted, unknowns)
            if near is None
            else remove_meters(*near)
        )

    def _close_posterior(self, s: int, wanted: Bools) -> tuple[Posterior, Bools] | None:
        """Fresh posterior of few more meters than wanted, and these; None for none."""
        whole = self._full_posterior(s)
        if whole is None or not well_conditioned(whole.prior, whole.noise):
            return None
        more = whole.trusted & ~wanted
        return (whole, more) if np.count_nonzero(more) * _PART <= np.count_nonzero(wanted) else None

    def _full_posterior(self, s: int) -> Posterior | None:
        """Kept posterior that covers all meters with readings on a scale."""
        if s not in self.covering:
            whole, here = self.full_posteriors[s], self.scales[s]
            good = whole is not None and covers(whole, here.prior, here.noise, here.enough)
            self.covering[s] = whole if good else None
        return self.covering[s]

    def _total_cost(self, hypothesis: Hypothesis) -> float:
        """Chi-square on all scales plus the cost of the accusations."""
        return self._accusation_cost(hypothesis) + sum(self._chi_squares(hypothesis))

    def _accusation_cost(self, hypothesis: Hypothesis) -> float:
        suspects = int(np.count_nonzero(~self._trusted(hypothesis)))
        return hypothesis.charge + set_cost(self.barred.size, suspects, self.design.max_attacked)

    def _trusted(self, hypothesis: Hypothesis) -> Bools:
        return np.where(self.here.enough, hypothesis.trusted, self.trust.trusted)

    def _chi_squares(
        self, hypothesis: Hypothesis, more: Bools | None = None, alike: Floats | None = None
    ) -> list[float]:
        """Chi-square on each scale, with `more` meters that may have common offsets."""
        trusted, out = self._trusted(hypothesis), []
        which = trusted.tobytes(), hypothesis.faults
        if more is None and which in self.chi_squares:
            return self.chi_squares[which]
        trusted = trusted if more is None else trusted | more
        unknowns = self.scales.unknowns((*self.accused, *((k, self.s) for k in hypothesis.faults)))
        for s in range(len(self.design.lengths)):
            there = self.scales[s]
            wanted = trusted & there.enough
            near = self._close_posterior(s, wanted) if unknowns is None and more is None else None
            if s == self.s and more is None and isinstance(hypothesis, Candidate):
                out.append(hypothesis.loo.chi_square)
            elif near is not None:
                out.append(chi_square_without(near[0], there.m, near[1]))
            else:
                out.append(chi_square(there.prior, there.noise, there.m, wanted, unknowns, alike))
        if more is None:
            self.chi_squares[which] = out
        return out

    def _trust(self, best: Hypothesis) -> TrustState:
        accused = (*self.accused, *((k, self.s) for k in best.faults))
        return self.trust.suspected(self._trusted(best), self.s, accused)


def _beyond_chance(left: float, freedom: int) -> bool:
    """True if a chi-square is beyond chance for its degrees of freedom."""
    return bool(left > freedom + _CHANCE * np.sqrt(2.0 * freedom))


def _components(link: Bools) -> list[Ints]:
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


def _barred(trust: TrustState, s: int) -> Bools:
    """Meters that must stay suspect: named ones, and those with evidence on other scales."""
    other = trust.above_release_limit[:s].any(axis=0) | trust.above_release_limit[s + 1 :].any(axis=0)
    return np.asarray(~trust.trusted & (other | (trust.named & trust.above_release_limit[s])))


# --- Exchanges ---


@dataclass(frozen=True, slots=True)
class Exchange:
    """Exchange of an accused meter or direction for an innocent one; J rises by `worse`."""

    accused: int
    innocent: int
    worse: float


_COLUMNS = 64
"""Accused meters of one block of a product."""


def meter_exchanges(found: Candidate, available: Bools, within: float, limits: Limits) -> list[Exchange]:
    """Best exchange of each accused meter for a trusted one, rise at most `within`; O(p^2) per accused.

    With accused k back, ``Q' = Q + v v^T / s`` with ``v = Q S_:k - e_k`` and ``s = M_kk + d_k``, and then
    meter j gains ``(Q' m)_j^2 / Q'_jj``. Without j, k is off by ``(Q'' m)_k / Q''_kk`` with
    ``Q'' = Q' - Q'_:j Q'_j: / Q'_jj``; the exchange counts only if that is within k's limit. Cheapest first.
    """
    now, loo = found.posterior, found.loo
    prior, accused, out = now.prior, indices(available & ~now.trusted), []
    inside, (at, Q) = now.unknowns[prior.meters], now.precision()
    for first in range(0, accused.size if at.size else 0, _COLUMNS):
        which = accused[first : first + _COLUMNS]
        columns = submatrix(prior.covariance, prior.meters[at], which)
        if inside.shape[1]:
            columns += inside[at] @ inside[which].T
        v, s = Q @ columns, loo.std[which] ** 2
        weights = loo.weights[at, None] - v * (loo.residual[which] / s)
        gain = weights**2 / (Q.diagonal()[:, None] + v**2 / s)
        best, each = gain.argmax(axis=0), np.arange(which.size)
        worse = loo.residual[which] ** 2 / s - gain[best, each]
        v, weight = v[best, each], weights[best, each]
        pivot = Q.diagonal()[best] + v**2 / s
        precision = 1.0 / s - (v / s) ** 2 / pivot
        offset = (loo.residual[which] + v * weight / pivot) / (s * precision)
        std = np.ones(now.trusted.size)
        std[which] = 1.0 / np.sqrt(precision)
        near = indices((worse <= within) & (np.abs(offset) <= limits.limit(std)[which]))
        out += [Exchange(int(which[k]), int(at[best[k]]), max(float(worse[k]), 0.0)) for k in near.tolist()]
    return sorted(out, key=lambda swap: swap.worse)


def fault_exchanges(
    found: Candidate, faults: FaultDictionary, accused: Sequence[int], instead: Ints, within: float
) -> list[Exchange]:
    """Exchanges of an accused direction for one of `instead` (k,) of the same charge, rise at most `within`.

    With the accused direction, u times its standard deviation, removed, ``Q' = Q + c c^T / d`` with ``c = Q
    u`` and ``d = 1 - u^T c``; then direction b lowers the chi-square by ``(b^T Q' m)^2 / (1 / s_b^2 + b^T Q'
    b)``. O(p^2) per direction, cheapest first. accused: directions to be exchanged.
    """
    now, weights = found.posterior, found.loo.weights
    out: list[Exchange] = []
    which = [k for k in accused if k in found.faults]
    others = instead[~np.isin(instead, found.faults)]
    if not which or not others.size:
        return out
    at, Q = now.precision()
    buses, w = now.prior.meters[at], weights[at]
    # The directions of this hypothesis come last, in its order.
    first = now.unknowns.shape[1] - len(found.faults)
    seen = faults.columns(others)[buses]
    along, form = w @ seen, np.einsum("ij,ij->j", seen, Q @ seen)
    for k in which:
        u = now.unknowns[buses, first + found.faults.index(k)]
        c = Q @ u
        d, own = max(1.0 - float(u @ c), np.finfo(np.float64).tiny), float(u @ w)
        both = c @ seen
        gain = (along + both * own / d) ** 2 / (faults.std[others] ** -2.0 + form + both**2 / d)
        # Of the accused itself: (u^T Q' m)^2 / (1 + u^T Q' u) with u^T Q' m = own / d, 1 + u^T Q' u = 1 / d.
        worse = np.maximum(own**2 / d - gain, 0.0)
        out += [Exchange(k, int(others[j]), float(worse[j])) for j in indices(worse <= within).tolist()]
    return sorted(out, key=lambda swap: swap.worse)
