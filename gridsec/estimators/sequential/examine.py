"""Identification: tests on every scale, and a search for the likeliest manipulated meters where one fails.

References
----------
docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, all_of, any_of, indices
from gridsec.estimators.inputs import busbar_errors
from gridsec.estimators.sequential.bounds import Powers
from gridsec.estimators.sequential.busbar import Doubt, Honest, aligned, opposed, room, weight
from gridsec.estimators.sequential.conditional import Fit, Prior, drop, judge
from gridsec.estimators.sequential.consistency import inconsistent
from gridsec.estimators.sequential.decoder import Accused, Evidence
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.explain import Search
from gridsec.estimators.sequential.robust import covers
from gridsec.estimators.sequential.scales import Scale, Scales, View, adapt, believe, view_of
from gridsec.estimators.sequential.search import Explanation, Found, Solution
from gridsec.estimators.sequential.state import SequentialState, Trust
from gridsec.estimators.sequential.windows import Window


@dataclass(frozen=True, slots=True, eq=False)
class Examined:
    """Identification of one tick. s scales."""

    trust: Trust  # trust state after the tests
    fits: tuple[Fit | None, ...]  # (s,) posteriors of the trusted meters
    wholes: tuple[Fit | None, ...]  # (s,) kept posteriors of all meters
    views: tuple[View | None, ...]  # (s,) tests; None for a scale without a look at this tick
    found: dict[int, Found]  # candidates by scale that searched
    misfit: tuple[bool, ...]  # (s,) trusted meters inconsistent at the last look, after the search
    busbar: tuple[int, int] | None = None  # busbar phase and scale of a wrong meter: the tick restarts


_AGAIN = 8
"""Ticks with a search at each before a meter is named, and interval of the searches after them."""


def examine(design: SequentialDesign, state: SequentialState, model: Floats, honest: Honest) -> Examined:
    """Test every meter on every due scale, shortest first.

    state: with the window and uncertainty of this tick, else of the last. model: (p,) largest model error,
    squared pu. honest: bounds of all other honest errors.
    """
    fits, tick, trust = state.fits, state.ticks, state.trust
    calm = trust.calm
    trust = trust if calm else _own(trust)
    views: list[View | None] = []
    after: list[Fit | None] = []
    wholes = list(state.wholes)
    found: dict[int, Found] = {}
    misfit = list(state.misfit)
    scales = Scales(design, state.doubts, state.window, state.learned, model, state.skew)
    for s, every in enumerate(design.every):
        before = fits[s]
        stale = before is None or (not trust.calm and any_of(before.trusted & ~trust.trusted))
        if tick % every and not stale:
            views.append(None)
            after.append(before)
            continue
        here = scales[s]
        now = adapt(before, here, trust.trusted & here.enough, scales.loosened(trust.accused))
        view = view_of(design, here, judge(now, here.m))
        if design.decoder is not None:
            found[s], trust = _decoded(design, here, now, trust, s)
        else:
            wholes[s] = _whole(wholes[s], before, now, here)
            due = _due(design, trust, view, s, tick, searched=bool(found))
            alone = due or any_of(view.over & trust.trusted)
            left = inconsistent(now, view.judged, model, design.tails[s])
            # A misfit that no search explains is searched again from time to time only.
            again = left and (not misfit[s] or tick % _AGAIN == 0)
            over = alone or (again and not _all_alike(design, here, now, view, honest))
            misfit[s] = left
            phases = [] if alone else _phases(design, scales, s, now, view, honest)
            if over or phases:
                search = Search(design, scales, tuple(wholes), trust, s)
                # Once something is beyond chance, less is suspected too.
                phases = search.opposed(now, view.judged) if alone else phases
                outcome, believed = search(now, view) if over else (search.likeliest(now, view), trust)
                outcome, liar = _without_busbar(search, outcome, now, honest.powers, phases)
                if liar is not None:
                    none = (None,) * len(fits)
                    return Examined(state.trust, fits, state.wholes, none, {}, state.misfit, (liar, s))
                # With no meter beyond its limit the test of the busbar makes no suspect.
                if over:
                    found[s], trust = outcome, believed
        if s in found:
            trust, calm = _own(trust) if calm else trust, False
            now = found[s].best.fit
            view = view_of(design, here, found[s].best.judged)
            weight(design, now)
            misfit[s] = design.decoder is None and inconsistent(now, view.judged, model, design.tails[s])
        if not calm:
            _note(trust, view, s)
        views.append(view)
        after.append(now)
    return Examined(trust, tuple(after), tuple(wholes), tuple(views), found, tuple(misfit))


def _note(trust: Trust, view: View, s: int) -> None:
    """Write the evidence of a scale; one with too few readings keeps its earlier detection."""
    owed = (trust.owed > 0) & (trust.scale == s)
    stands = np.where(view.enough, view.still, trust.still[s]) | owed
    trust.bad[s], trust.still[s] = view.over & ~trust.trusted, stands & ~trust.trusted


_REMEMBERED = 724
"""Largest number of meters for a kept posterior of all of them: 4 MB for each scale."""


def _whole(kept: Fit | None, before: Fit | None, now: Fit, here: Scale) -> Fit | None:
    """Posterior that `covers` all meters with a reading, or the one kept before."""
    if now is before:
        return kept
    if kept is not None and not covers(kept, here.prior, here.noise, np.zeros_like(here.enough)):
        kept = None
    if here.enough.size > _REMEMBERED or not covers(now, here.prior, here.noise, here.enough):
        return kept
    # A meter silent for one tick will report again.
    if kept is not None and any_of(kept.trusted & ~now.trusted) and not any_of(now.trusted & ~kept.trusted):
        return kept
    return now


def _own(trust: Trust) -> Trust:
    """Trust state with evidence that can be written."""
    return replace(trust, bad=trust.bad.copy(), still=trust.still.copy())


def _all_alike(design: SequentialDesign, here: Scale, now: Fit, view: View, honest: Honest) -> bool:
    """True where honest errors at their ends, all in the direction Q m, explain ``m^T Q m``."""
    at = indices(now.trusted)
    v = view.judged.weights[at, None]
    error = busbar_errors(design.plant, honest.powers.v0_squared, design.sigmas[0])
    busbar = np.abs(v.T @ design.hangs_on[at]) @ np.atleast_1d(error)
    fixed = here.limits.model + here.limits.allowed
    return bool(view.judged.misfit <= (room(design, at, v, fixed, honest) + busbar)[0])


def _phases(  # noqa: PLR0917
    design: SequentialDesign, scales: Scales, s: int, now: Fit, view: View, honest: Honest
) -> list[int]:
    """Busbar phases that the meters contradict by more than honest errors of one direction."""
    here, doubt = scales[s], Doubt(design.sigmas[s], scales.model, scales.doubts.busbar[s])
    phases = opposed(design, doubt, now, view.judged)
    if not phases:
        return phases
    could = aligned(design, now, here.m, here.limits.model + here.limits.allowed, honest)
    return [phase for phase in phases if not could[phase]]


def _disputed(search: Search, best: Solution, powers: Powers, phases: list[int]) -> list[int]:
    """Busbar phases with a meter that may be wrong instead of the accused meters.

    The trusted meters contradict it too, many meters of the phase are accused, or, in three phases, few.
    """
    if not phases:
        return phases
    design, here = search.design, search.here
    doubt = search.doubt
    accused = here.enough & ~best.trusted
    if np.count_nonzero(accused) > design.most:
        return phases
    bent = powers.bent(design.plant, _claimed(search, best))
    left = opposed(design, replace(doubt, model=doubt.model + bent), best.fit, best.judged)
    suspects = accused @ design.hangs_on
    few = (suspects > 0) & (suspects <= _CLOSE) & (suspects.size > 1)
    open_ = few | (_MANY * suspects > here.enough @ design.hangs_on)
    return [phase for phase in phases if phase in left or open_[phase]]


def _claimed(search: Search, best: Solution) -> Bools:
    """Customers with a large reported power that a hypothesis takes for false or may, (N,)."""
    design = search.design
    out = np.zeros(design.customers, dtype=np.bool_)
    out[design.plant.meters[search.here.enough & ~best.trusted]] = True
    out[[k for k in best.loosened if k < design.customers]] = True
    return out & (search.book.std[: design.customers] > design.options.hidden_power)


_MANY, _CLOSE = 3, 8
"""Accused meters of a phase that dispute its busbar meter: more than 1 / `_MANY` of it, or up to `_CLOSE`."""


def _without_busbar(
    search: Search, found: Found, now: Fit, powers: Powers, phases: list[int]
) -> tuple[Found, int | None]:
    """Candidates, and the busbar phase with a meter that is far likelier manipulated than they are.

    About equally likely it is one of the other hypotheses. It is not, if it accuses more than `max_attacked`
    meters and the others do not.
    """
    design, here = search.design, search.scales[search.s]
    phases = _disputed(search, found.best, powers, phases)
    if not phases:
        return found, None
    each = [search.beside_busbar(now, phase) for phase in phases]
    best = min(range(len(each)), key=lambda k: each[k].cost)
    suspects = [int(np.count_nonzero(here.enough & ~one.trusted)) for one in (each[best], found.best)]
    if suspects[0] > max(design.most, suspects[1]):
        return found, None
    like = 2.0 * float(np.log(design.options.like))
    lying = replace(each[best], cost=each[best].cost - search.relief(found.best, each[best]))
    worse = lying.cost - found.best.cost
    vouching = (here.enough & each[best].trusted) @ design.hangs_on[:, phases[best]]
    if vouching < design.most:
        # All meters that contradict it may be manipulated themselves.
        return replace(found, others=(*found.others, lying)), None
    if worse < -like:
        # A false power may look the same; as an alternative it has a reduced charge.
        power = search.beside_powers(now)
        if power.cost > lying.cost + like:
            return found, phases[best]
        return replace(found, others=(*found.others, lying, power)), None
    return replace(found, others=(*found.others, lying)) if worse <= like else found, None


def ended(
    design: SequentialDesign, priors: tuple[Prior, ...], trust: Trust, seen: Examined, window: Window
) -> Bools:
    """Suspects with an ended manipulation that long means still contain, (p,).

    The short scale finds them honest, and further from a longer one than its noise and the wandering of
    loads, and of an unmetered busbar, explain.
    """
    out = np.zeros_like(trust.trusted)
    suspected = ~trust.trusted & ~seen.trust.trusted
    if not any_of(suspected):
        return out
    means = window.sums / np.maximum(window.counts, 1)
    at, rate = design.prior.meters, 2.0 * design.step_s / design.doubt.time_s
    for s, short in enumerate(seen.views[:-1]):
        if short is None:
            continue
        quiet = suspected & short.enough & ~short.still
        for later in range(s + 1, len(design.lengths)):
            if not any_of(quiet & seen.trust.still[later]):
                continue
            wander = priors[later].variance[at] * rate * design.lengths[later]
            variance = design.white / np.maximum(window.counts[s], 1) + wander
            far = np.abs(means[later] - means[s]) > design.sigmas[s] * np.sqrt(variance)
            out |= quiet & seen.trust.still[later] & far
    return out


def _due(design: SequentialDesign, trust: Trust, view: View, s: int, tick: int, *, searched: bool) -> bool:
    """True if a scale searches again without new evidence.

    Before a meter is named, at intervals while that is open, while other faults are suspected, and at long
    intervals at ticks without a search on a shorter scale.
    """
    if trust.calm:
        return False
    if any(scale <= s for _, scale in trust.accused):
        return True
    if all_of(trust.trusted):
        return False
    since = trust.age + 1 - design.confirmed[trust.scale]
    about = ~trust.trusted & ~trust.named & view.over & (since >= 0)
    first = (since < max(design.every[s], _AGAIN)) | ~trust.bad[s]
    if any_of(about & first) or (tick % _AGAIN == 0 and any_of(about)):
        return True
    last = len(design.lengths) - 1
    return s == last and tick % design.lengths[last] == 0 and not searched


def _decoded(design: SequentialDesign, here: Scale, now: Fit, trust: Trust, s: int) -> tuple[Found, Trust]:
    """Candidates of the design's decoder, and the resulting trust state."""
    judged = judge(now, here.m)
    over = here.enough & (np.abs(judged.offset) > here.limits.of(judged.std))
    tight = now if not now.loose.shape[1] else None
    whole = adapt(tight, here, here.enough, None)
    evidence = Evidence(
        whole=whole,
        m=here.m,
        live=here.enough,
        limits=here.limits,
        believed=trust.trusted,
        over=over,
        most=design.most,
        like=design.options.like,
    )
    assert design.decoder is not None  # noqa: S101  # the caller has looked
    answers = design.decoder(evidence)
    best = answers[0]
    others = (Explanation(here.enough & ~each.meters, (), 0.0, each.worse) for each in answers[1:])
    found = Found(_solution(here, whole, best), tuple(others))
    return found, believe(trust, np.where(here.enough, ~best.meters, trust.trusted), s, ())


def _solution(here: Scale, whole: Fit, answer: Accused) -> Solution:
    now = whole.copy()
    for j in np.flatnonzero(answer.meters & here.enough).tolist():
        drop(now, j)
    return Solution(now.trusted, (), 0.0, answer.worse, now, judge(now, here.m))
