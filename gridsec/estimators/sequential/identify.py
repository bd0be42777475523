"""Identification of manipulated meters, and confirmation.

Where a test of a scale fails, a search finds the likeliest manipulated meters. Suspects are named on lasting
evidence without a rival hypothesis about as likely.

References
----------
docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices
from gridsec.estimators.plant import busbar_errors
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.device_checks import (
    BusbarTest,
    HonestErrors,
    InverterChecks,
    busbar_weights,
    contradicted_phases,
    explained_phases,
    largest_sums,
)
from gridsec.estimators.sequential.hypotheses import HypothesisSearch, fault_exchanges, meter_exchanges
from gridsec.estimators.sequential.measurements import PowerErrors
from gridsec.estimators.sequential.posterior import (
    Posterior,
    Prior,
    leave_one_out,
    remove_meter,
    vouched_posterior,
)
from gridsec.estimators.sequential.search import (
    Candidate,
    Candidates,
    DecoderAnswer,
    DecoderInput,
    Hypothesis,
    covers,
)
from gridsec.estimators.sequential.state import MAX_INVERTER_TICKS, SequentialState, TrustState
from gridsec.estimators.sequential.time_scales import (
    ScaleData,
    Scales,
    ScaleTest,
    Window,
    inconsistent,
    load_scores,
    scale_test,
    update_posterior,
)
from gridsec.grid.network import Power
from gridsec.interface import Explanation


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Identification of one tick. s scales."""

    trust: TrustState  # trust state after the tests
    posteriors: tuple[Posterior | None, ...]  # (s,) posteriors of the trusted meters
    full_posteriors: tuple[Posterior | None, ...]  # (s,) kept posteriors of all meters
    tests: tuple[ScaleTest | None, ...]  # (s,) tests; None for a scale without a look at this tick
    candidates: dict[int, Candidates]  # candidates by scale that searched
    inconsistent: tuple[bool, ...]  # (s,) trusted meters inconsistent at the last look, after the search
    rivals: tuple[Explanation, ...] = ()  # hypotheses about as likely as the best, from the confirmation
    busbar: tuple[int, int] | None = None  # busbar phase and scale of a wrong meter: the tick restarts


_SEARCH_INTERVAL = 8
"""Ticks with a search at each before a meter is named, and interval of the searches after them."""


def identify(
    design: SequentialDesign, state: SequentialState, model: Floats, honest: HonestErrors
) -> Identification:
    """Test every meter on every due scale, shortest first.

    state: with the window and uncertainty of this tick, else of the last. model: (p,) largest model error,
    squared pu. honest: bounds of all other honest errors.
    """
    tick = _Tick(design, state, model, honest)
    both = []
    for s in range(len(design.lengths)):
        both.append(tick.scale(s))
        if tick.busbar is not None:
            return Identification(
                trust=state.trust,
                posteriors=state.posteriors,
                full_posteriors=state.full_posteriors,
                tests=(None,) * len(design.lengths),
                candidates={},
                inconsistent=state.inconsistent,
                busbar=tick.busbar,
            )
    posteriors, tests = zip(*both, strict=True)
    kept, misfit = tuple(tick.full_posteriors), tuple(tick.inconsistent)
    return Identification(tick.trust, posteriors, kept, tests, tick.candidates, misfit)


class _Tick:
    """Progress of the identification over the scales of one tick."""

    def __init__(
        self, design: SequentialDesign, state: SequentialState, model: Floats, honest: HonestErrors
    ) -> None:
        self.design, self.state, self.model, self.honest = design, state, model, honest
        self.clear = state.trust.clear
        self.trust = state.trust if self.clear else state.trust.writable()
        self.full_posteriors, self.inconsistent = list(state.full_posteriors), list(state.inconsistent)
        self.candidates: dict[int, Candidates] = {}
        self.busbar: tuple[int, int] | None = None
        self.scales = Scales(design, state.uncertainty, state.window, state.learned, model, state.clock_skew)

    def scale(self, s: int) -> tuple[Posterior | None, ScaleTest | None]:
        """Posterior and tests of a scale; the posterior before and None where it is not due."""
        design, before = self.design, self.state.posteriors[s]
        stale = before is None or (not self.trust.clear and any_of(before.trusted & ~self.trust.trusted))
        if self.state.ticks % design.look_every[s] and not stale:
            return before, None
        here, unknowns = self.scales[s], self.scales.unknowns(self.trust.accused)
        now = update_posterior(before, here, self.trust.trusted & here.enough, unknowns)
        test = scale_test(design, here, leave_one_out(now, here.m))
        if design.decoder is not None:
            self.candidates[s], self.trust = _by_decoder(design, here, now, self.trust, s)
        else:
            self.full_posteriors[s] = _kept_posterior(self.full_posteriors[s], before, now, here)
            self._search(s, now, test)
        if s in self.candidates:
            self.trust, self.clear = self.trust.writable() if self.clear else self.trust, False
            best = self.candidates[s].best
            now, test = best.posterior, scale_test(design, here, best.loo)
            busbar_weights(design, now)
            left = design.decoder is None and self._inconsistent(s, now, test)
            self.inconsistent[s] = left
        if not self.clear:
            self.trust.record(s, test.enough, test.above_limit, test.above_release_limit)
        return now, test

    def _inconsistent(self, s: int, now: Posterior, test: ScaleTest) -> bool:
        """Trusted meters are inconsistent together."""
        scores = load_scores(self.design, now, self.full_posteriors[s], test.loo)
        return inconsistent(now, test.loo, self.model, self.design.tails[s], scores)

    def _search(self, s: int, now: Posterior, test: ScaleTest) -> None:
        """Search a scale with a failed test, or one that is due again."""
        design, here, tick = self.design, self.scales[s], self.state.ticks
        due = _search_due(design, self.trust, test, s, tick, searched=bool(self.candidates))
        single = due or any_of(test.above_limit & self.trust.trusted)
        left = self._inconsistent(s, now, test)
        # A misfit that no search explains is searched again from time to time only.
        again = left and (not self.inconsistent[s] or tick % _SEARCH_INTERVAL == 0)
        over = single or (again and not _aligned_misfit(design, here, now, test, self.honest))
        self.inconsistent[s] = left
        phases = [] if single else _contradicted_phases(design, self.scales, s, now, test, self.honest)
        if not (over or phases):
            return
        search = HypothesisSearch(design, self.scales, tuple(self.full_posteriors), self.trust, s)
        # Once something is beyond chance, less is suspected too.
        phases = search.contradicted_phases(now, test.loo) if single else phases
        outcome, trust = search(now, test) if over else (search.likeliest(now, test), self.trust)
        outcome, phase = _busbar_hypothesis(search, outcome, now, self.honest.powers, phases)
        if phase is not None:
            self.busbar = phase, s
        # With no meter beyond its limit the test of the busbar makes no suspect.
        elif over:
            self.candidates[s], self.trust = outcome, trust


_MAX_KEPT = 724
"""Largest number of meters for a kept posterior of all of them: 4 MB for each scale."""


def _kept_posterior(
    kept: Posterior | None, before: Posterior | None, now: Posterior, here: ScaleData
) -> Posterior | None:
    """Posterior that `covers` all meters with a reading, or the one kept before."""
    if now is before:
        return kept
    if kept is not None and not covers(kept, here.prior, here.noise, np.zeros_like(here.enough)):
        kept = None
    if here.enough.size > _MAX_KEPT or not covers(now, here.prior, here.noise, here.enough):
        return kept
    # A meter silent for one tick will report again.
    if kept is not None and any_of(kept.trusted & ~now.trusted) and not any_of(now.trusted & ~kept.trusted):
        return kept
    return now


def _aligned_misfit(
    design: SequentialDesign, here: ScaleData, now: Posterior, test: ScaleTest, honest: HonestErrors
) -> bool:
    """True where honest errors at their ends, all in the direction Q m, explain ``m^T Q m``."""
    at = indices(now.trusted)
    v = test.loo.weights[at, None]
    error = busbar_errors(design.plant, honest.powers.v0_squared, design.sigmas[0])
    busbar = np.abs(v.T @ design.busbar_incidence[at]) @ np.atleast_1d(error)
    fixed = here.limits.model + here.limits.allowed
    return bool(test.loo.chi_square <= (largest_sums(design, at, v, fixed, honest) + busbar)[0])


def _contradicted_phases(  # noqa: PLR0917
    design: SequentialDesign, scales: Scales, s: int, now: Posterior, test: ScaleTest, honest: HonestErrors
) -> list[int]:
    """Busbar phases that the meters contradict by more than honest errors of one direction."""
    here, doubt = scales[s], BusbarTest(design.sigmas[s], scales.model, scales.uncertainty.busbar[s])
    phases = contradicted_phases(design, doubt, now, test.loo)
    if not phases:
        return phases
    could = explained_phases(design, now, here.m, here.limits.model + here.limits.allowed, honest)
    return [phase for phase in phases if not could[phase]]


def _disputed_phases(
    search: HypothesisSearch, best: Candidate, powers: PowerErrors, phases: list[int]
) -> list[int]:
    """Busbar phases with a meter that may be wrong instead of the accused meters.

    The trusted meters contradict it too, many meters of the phase are accused, or, in three phases, few.
    """
    if not phases:
        return phases
    design, here = search.design, search.here
    doubt = search.busbar_test
    accused = here.enough & ~best.trusted
    if np.count_nonzero(accused) > design.max_attacked:
        return phases
    bent = powers.report_effect(design.plant, _large_claims(search, best))
    left = contradicted_phases(design, replace(doubt, model=doubt.model + bent), best.posterior, best.loo)
    suspects = accused @ design.busbar_incidence
    few = (suspects > 0) & (suspects <= _FEW_ACCUSED) & (suspects.size > 1)
    open_ = few | (_ACCUSED_PART * suspects > here.enough @ design.busbar_incidence)
    return [phase for phase in phases if phase in left or open_[phase]]


def _large_claims(search: HypothesisSearch, best: Candidate) -> Bools:
    """Customers with a large reported power that a hypothesis takes for false or may, (N,)."""
    design = search.design
    out = np.zeros(design.customers, dtype=np.bool_)
    out[design.plant.meters[search.here.enough & ~best.trusted]] = True
    out[[k for k in best.faults if k < design.customers]] = True
    return out & (search.faults.std[: design.customers] > design.options.hidden_power)


_ACCUSED_PART, _FEW_ACCUSED = 3, 8
"""Accused meters of a phase that dispute its busbar meter: more than 1 / 3 of it, or up to 8."""


def _busbar_hypothesis(
    search: HypothesisSearch, candidates: Candidates, now: Posterior, powers: PowerErrors, phases: list[int]
) -> tuple[Candidates, int | None]:
    """Candidates, and the busbar phase with a meter that is far likelier manipulated than they are.

    About equally likely it is one of the other hypotheses. It is not, if it accuses more than `max_attacked`
    meters and the others do not.
    """
    design, here = search.design, search.scales[search.s]
    phases = _disputed_phases(search, candidates.best, powers, phases)
    if not phases:
        return candidates, None
    each = [search.with_busbar(now, phase) for phase in phases]
    best = min(range(len(each)), key=lambda k: each[k].cost)
    suspects = [int(np.count_nonzero(here.enough & ~one.trusted)) for one in (each[best], candidates.best)]
    if suspects[0] > max(design.max_attacked, suspects[1]):
        return candidates, None
    like = 2.0 * float(np.log(design.options.like))
    rival = replace(each[best], cost=each[best].cost - search.relief(candidates.best, each[best]))
    worse = rival.cost - candidates.best.cost
    vouching = (here.enough & each[best].trusted) @ design.busbar_incidence[:, phases[best]]
    # All meters that contradict it may be manipulated themselves, or are suspects for the most part.
    if vouching < design.max_attacked or (worse < -like and suspects[0] > design.max_attacked):
        return replace(candidates, others=(*candidates.others, rival)), None
    if worse < -like:
        # A false power may look the same; as an alternative it has a reduced charge.
        power = search.with_false_powers(now)
        if power.cost > rival.cost + like:
            return candidates, phases[best]
        return replace(candidates, others=(*candidates.others, rival, power)), None
    return replace(candidates, others=(*candidates.others, rival)) if worse <= like else candidates, None


def ended(
    design: SequentialDesign,
    priors: tuple[Prior, ...],
    trust: TrustState,
    identified: Identification,
    window: Window,
) -> Bools:
    """Suspects with an ended manipulation that long means still contain, (p,).

    The short scale finds them honest, and further from a longer one than its noise and the wandering of
    loads, and of an unmetered busbar, explain.
    """
    out = np.zeros_like(trust.trusted)
    suspected = ~trust.trusted & ~identified.trust.trusted
    if not any_of(suspected):
        return out
    means = window.sums / np.maximum(window.counts, 1)
    at, rate = design.prior.meters, 2.0 * design.step_s / design.doubt.time_s
    for s, short in enumerate(identified.tests[:-1]):
        if short is None:
            continue
        quiet = suspected & short.enough & ~short.above_release_limit
        for later in range(s + 1, len(design.lengths)):
            if not any_of(quiet & identified.trust.above_release_limit[later]):
                continue
            wander = priors[later].variance[at] * rate * design.lengths[later]
            variance = design.white / np.maximum(window.counts[s], 1) + wander
            far = np.abs(means[later] - means[s]) > design.sigmas[s] * np.sqrt(variance)
            out |= quiet & identified.trust.above_release_limit[later] & far
    return out


def _search_due(
    design: SequentialDesign, trust: TrustState, test: ScaleTest, s: int, tick: int, *, searched: bool
) -> bool:
    """True if a scale searches again without new evidence.

    Before a meter is named, at intervals while that is open, while other faults are suspected, and at long
    intervals at ticks without a search on a shorter scale.
    """
    if trust.clear:
        return False
    if any(scale <= s for _, scale in trust.accused):
        return True
    if all_of(trust.trusted):
        return False
    since = trust.ticks_suspect + 1 - design.confirmed[trust.scale]
    about = ~trust.trusted & ~trust.named & test.above_limit & (since >= 0)
    first = (since < max(design.look_every[s], _SEARCH_INTERVAL)) | ~trust.above_limit[s]
    if any_of(about & first) or (tick % _SEARCH_INTERVAL == 0 and any_of(about)):
        return True
    last = len(design.lengths) - 1
    return s == last and tick % design.lengths[last] == 0 and not searched


def _by_decoder(
    design: SequentialDesign, here: ScaleData, now: Posterior, trust: TrustState, s: int
) -> tuple[Candidates, TrustState]:
    """Candidates of the design's decoder, and the resulting trust state."""
    loo = leave_one_out(now, here.m)
    over = here.enough & (np.abs(loo.residual) > here.limits.limit(loo.std))
    tight = now if not now.unknowns.shape[1] else None
    whole = update_posterior(tight, here, here.enough, None)
    evidence = DecoderInput(
        whole=whole,
        m=here.m,
        available=here.enough,
        limits=here.limits,
        trusted=trust.trusted,
        above_limit=over,
        max_attacked=design.max_attacked,
        like=design.options.like,
    )
    assert design.decoder is not None  # noqa: S101  # the caller has looked
    answers = design.decoder(evidence)
    best = answers[0]
    others = (Hypothesis(here.enough & ~each.meters, (), 0.0, each.worse) for each in answers[1:])
    candidates = Candidates(_candidate(here, whole, best), tuple(others))
    return candidates, trust.suspected(np.where(here.enough, ~best.meters, trust.trusted), s, ())


def _candidate(here: ScaleData, whole: Posterior, answer: DecoderAnswer) -> Candidate:
    now = whole.copy()
    for j in np.flatnonzero(answer.meters & here.enough).tolist():
        remove_meter(now, j)
    return Candidate(now.trusted, (), 0.0, answer.worse, now, leave_one_out(now, here.m))


# --- Confirmation ---


_WITNESS_PART = 0.25
"""Part of an inverter's largest effect that makes a meter its witness."""


def confirm(
    design: SequentialDesign,
    before: TrustState,
    identified: Identification,
    available: Bools,
    curves: InverterChecks,
) -> tuple[TrustState, tuple[Explanation, ...]]:
    """Trust state with named meters and inverters, and rival hypotheses where one prevents a name.

    available: (p,) meters with a reading; silence releases none. curves: an inverter that follows its curve
    is not a rival.
    """
    trust = identified.trust
    if trust.clear and before.clear:
        return trust, ()
    lately = any_of(trust.ticks_suspect) or any_of(before.named) or any_of(before.inverter_ticks)
    if all_of(trust.trusted) and not (trust.accused or lately):
        return trust, ()
    now = trust.counted(before.named, available, design.options.release, design.lengths[-1])
    lasting = trust.above_limit.any(axis=0) & (now.ticks_suspect >= design.confirmed[trust.scale])
    fresh = ~now.trusted & ~before.named & lasting & _accused(identified, available.size)
    count, inverters = _inverter_counts(design, before, trust, identified, available)
    new = inverters & ~before.inverters
    rivals: tuple[Explanation, ...] = ()
    if any_of(fresh) or any_of(new):
        found = _Rivals(design, fresh, new, curves.consistent(design))
        found.collect(identified)
        for meters, accused in found.accusations():
            fresh, inverters = fresh & meters, inverters & (before.inverters | accused)
        rivals = found.explanations(available | before.named)
    return now.with_names(fresh, count, inverters), rivals


def supported(
    scales: Scales, before: TrustState, identified: Identification, trust: TrustState
) -> TrustState:
    """Trust state without new names that rest on meters that withhold powers."""
    fresh, vouched = trust.named & ~before.named, scales.uncertainty.vouched
    if all_of(vouched) or not any_of(fresh):
        return trust
    out = np.zeros_like(fresh)
    for s, now in enumerate(identified.posteriors):
        which = fresh & (trust.scale == s)
        beside = None if now is None or not any_of(which) else vouched_posterior(now, vouched[s])
        if beside is not None:
            here = scales[s]
            loo = leave_one_out(beside.vouched, here.m)
            out |= which & (np.abs(loo.residual) <= here.limits.limit(loo.std))
    return trust.without_names(out)


def _accused(identified: Identification, meters: int) -> Bools:
    """Meters accused by the likeliest candidate of a scale that searched at this tick, (p,)."""
    out = np.zeros(meters, dtype=np.bool_)
    for found in identified.candidates.values():
        out |= ~found.best.trusted
    return out


def _inverter_counts(
    design: SequentialDesign,
    before: TrustState,
    trust: TrustState,
    identified: Identification,
    available: Bools,
) -> tuple[Ints, Bools]:
    """Ticks that accuse each inverter, and the named ones, (m,) each.

    An accusation counts at ticks with a search that accuses it; silence releases none.
    """
    accused = [k for k, _ in trust.accused]
    if not accused and not any_of(before.inverter_ticks):
        return before.inverter_ticks, before.inverters
    now = accused_inverters(design, accused)
    less = np.where(_witnessed(design, before.inverter_ticks > 0, available & trust.trusted), -1, 0)
    # An inverter named before a restart starts above that and counts down.
    most = np.maximum(MAX_INVERTER_TICKS, before.inverter_ticks + less)
    count = np.clip(before.inverter_ticks + np.where(now, 1, less), 0, most)
    need, confirmed = np.full(now.size, MAX_INVERTER_TICKS), design.confirmed
    for k, s in trust.accused:
        if k >= design.customers:
            need[k - design.customers] = min(confirmed[s], MAX_INVERTER_TICKS)
    sought = accused_inverters(
        design, [k for found in identified.candidates.values() for k in found.best.faults]
    )
    return count, (before.inverters & (count > 0)) | (now & sought & (count >= need))


def _witnessed(design: SequentialDesign, which: Bools, available: Bools) -> Bools:
    """Inverters that move the voltage of some available meter, (m,)."""
    if all_of(available) or not any_of(which):
        return which
    out, at = which.copy(), indices(which)
    own = design.plant.droop.customer[at]
    effect = np.abs(design.sensitivities.columns(Power.REACTIVE, own)[design.prior.meters])
    most = effect.max(axis=0, initial=0.0)
    out[at] = effect[available].max(axis=0, initial=0.0) >= np.maximum(
        _WITNESS_PART * most, np.finfo(np.float64).tiny
    )
    return out


def accused_inverters(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Inverters among accused faults, (m,)."""
    return _accused_faults(design, accused)[design.customers : design.faults.std.size]


def accused_powers(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Customers with a false power among accused faults, (N,)."""
    return _accused_faults(design, accused)[: design.customers]


def _accused_phases(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Busbar phases among accused faults, (b,)."""
    return _accused_faults(design, accused)[design.faults.std.size :]


def _accused_faults(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Accused powers, inverters and busbar phases, (N + m + b,)."""
    out = np.zeros(design.faults.std.size + design.busbar_incidence.shape[1], dtype=np.bool_)
    out[list(accused)] = True
    return out


class _Rivals:
    """Hypotheses about as likely as the best, if one leaves out a meter or inverter about to be named.

    fresh, new: meters (p,) and inverters (m,) about to be named. agrees: inverters that follow their curves.
    """

    def __init__(self, design: SequentialDesign, fresh: Bools, new: Bools, agrees: Bools) -> None:
        self.design, self.fresh, self.new = design, fresh, new
        self.others = design.customers + indices(~agrees)
        self.within = 2.0 * float(np.log(design.options.like))
        self.found: dict[bytes, tuple[Bools, Bools, float, tuple[int, ...]]] = {}

    def collect(self, identified: Identification) -> None:
        """Take the candidates of every scale that searched."""
        for s, found in identified.candidates.items():
            test = identified.tests[s]
            if test is not None:
                self._collect(found, test)
        if not any(self._differs(meters, inverters) for meters, inverters, *_ in self.found.values()):
            self.found.clear()

    def accusations(self) -> list[tuple[Bools, Bools]]:
        """Meters and inverters that each accuses; meters without a reading are among the former."""
        return [(meters, inverters) for meters, inverters, *_ in self.found.values()]

    def explanations(self, available: Bools) -> tuple[Explanation, ...]:
        """All of them, the likeliest first; meters that are not `available`, (p,), are left out."""
        design, total = self.design, sum(way[2] for way in self.found.values())
        return tuple(
            Explanation(
                meters & available,
                inverters,
                weight / total,
                accused_powers(design, faults),
                _accused_phases(design, faults),
            )
            for meters, inverters, weight, faults in sorted(self.found.values(), key=lambda way: -way[2])
        )

    def _collect(self, found: Candidates, test: ScaleTest) -> None:
        best, within = found.best, self.within
        near = [(~each.trusted, each.faults, each.cost - best.cost) for each in (best, *found.others)]
        for swap in meter_exchanges(best, test.enough, within, test.limits):
            other = near[0][0].copy()
            other[swap.accused], other[swap.innocent] = False, True
            near.append((other, best.faults, swap.worse))
        accused = (self.design.customers + indices(self.new)).tolist()
        for turn in fault_exchanges(best, self.design.faults, accused, self.others, within):
            faults = tuple(turn.innocent if k == turn.accused else k for k in best.faults)
            near.append((near[0][0], faults, turn.worse))
        for k, (meters, faults, worse) in enumerate(near):
            inverters = accused_inverters(self.design, faults)
            if not k or (worse <= within and self._differs(meters, inverters)):
                which, weight = meters.tobytes() + inverters.tobytes(), float(np.exp(-0.5 * worse))
                if which not in self.found or self.found[which][2] < weight:
                    self.found[which] = (meters, inverters, weight, faults)

    def _differs(self, meters: Bools, inverters: Bools) -> bool:
        """True if a meter or inverter about to be named is left out."""
        return any_of(self.fresh & ~meters) or any_of(self.new & ~inverters)
