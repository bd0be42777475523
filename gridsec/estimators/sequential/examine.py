"""Who is believed: every scale judges, and where one finds evidence the likeliest liars are looked for.

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
    """The outcome of one tick. s scales.

    Attributes
    ----------
    trust
        Who is believed now.
    fits, wholes, views : (s,)
        By scale, as in the state; a view is None where the scale was not looked at.
    found
        The likeliest explanation that a search came to, and the others, by scale.
    misfit : (s,)
        Scales whose trusted meters were inconsistent at the last look, after the search.
    busbar
        The phase of the busbar whose meter lies, and the scale that found it: then nothing else counts, and
        the tick has to begin anew without it.
    """

    trust: Trust
    fits: tuple[Fit | None, ...]
    wholes: tuple[Fit | None, ...]
    views: tuple[View | None, ...]
    found: dict[int, Found]
    misfit: tuple[bool, ...]
    busbar: tuple[int, int] | None = None


# For so many ticks it is asked at each who could be honest, after that once in so many.
_AGAIN = 8


def examine(design: SequentialDesign, state: SequentialState, model: Floats, honest: Honest) -> Examined:
    """Judge every meter on every scale that is due, shortest first.

    Parameters
    ----------
    design
        The design.
    state
        With this tick's window and doubts, and all else from the last tick.
    model : (p,)
        What the model may be off, squared pu.
    honest
        What all other errors are bounded by.
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
                # Where no meter was beyond chance nobody is suspected for what is said of the busbar.
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


# Meters up to which it is kept what all of them said: 4 MB for each scale, and what they rest on.
_REMEMBERED = 724


def _whole(kept: Fit | None, before: Fit | None, now: Fit, here: Scale) -> Fit | None:
    """A fit that `covers` all that report, or what is kept of one."""
    if now is before:
        return kept
    if kept is not None and not covers(kept, here.prior, here.noise, np.zeros_like(here.enough)):
        kept = None
    if here.enough.size > _REMEMBERED or not covers(now, here.prior, here.noise, here.enough):
        return kept
    # Who is silent for a tick will be heard again.
    if kept is not None and any_of(kept.trusted & ~now.trusted) and not any_of(now.trusted & ~kept.trusted):
        return kept
    return now


def _own(trust: Trust) -> Trust:
    """The same, with evidence that can be written into."""
    return replace(trust, bad=trust.bad.copy(), still=trust.still.copy())


def _all_alike(design: SequentialDesign, here: Scale, now: Fit, view: View, honest: Honest) -> bool:
    """True where honest errors at their ends, all in the direction Q m, explain ``m^T Q m``."""
    at = indices(now.trusted)
    v = view.judged.weights[at, None]
    error = busbar_errors(design.plant, honest.powers.v0_squared, design.sigmas[0])
    busbar = np.abs(v.T @ design.hangs_on[at]) @ np.atleast_1d(error)
    fixed = here.limits.model + here.limits.allowed
    return bool(view.judged.misfit <= (room(design, at, v, fixed, honest) + busbar)[0])


def _phases(  # noqa: PLR0917  # the scale, and what it rests on
    design: SequentialDesign, scales: Scales, s: int, now: Fit, view: View, honest: Honest
) -> list[int]:
    """Phases of the busbar that the meters contradict by more than honest errors that are all alike."""
    here, doubt = scales[s], Doubt(design.sigmas[s], scales.model, scales.doubts.busbar[s])
    phases = opposed(design, doubt, now, view.judged)
    if not phases:
        return phases
    could = aligned(design, now, here.m, here.limits.model + here.limits.allowed, honest)
    return [phase for phase in phases if not could[phase]]


def _disputed(search: Search, best: Solution, powers: Powers, phases: list[int]) -> list[int]:
    """Phases of which the busbar's meter may be what an explanation accuses other meters for.

    Its trusted meters contradict it too, it accuses many meters of the phase, or, in three phases, a few.
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
    """Customers who claim much, and whose powers are false if an explanation is right or may be, (N,)."""
    design = search.design
    out = np.zeros(design.customers, dtype=np.bool_)
    out[design.plant.meters[search.here.enough & ~best.trusted]] = True
    out[[k for k in best.loosened if k < design.customers]] = True
    return out & (search.book.std[: design.customers] > design.options.hidden_power)


# More than one in so many must be accused on a phase before its busbar's meter is doubted by that alone, or
# no more than this: one wrong busbar meter looks like some wrong meters close to it.
_MANY, _CLOSE = 3, 8


def _without_busbar(
    search: Search, found: Found, now: Fit, powers: Powers, phases: list[int]
) -> tuple[Found, int | None]:
    """What was found, and the phase of the busbar of which it is far likelier that its meter lies.

    If that is about as likely it is one of the other explanations. It is none if it accuses more meters than
    can be told apart where the others do without.
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
    # All meters that speak against it may be manipulated themselves, or are suspected for the most part.
    if vouching < design.most or (worse < -like and suspects[0] > design.most):
        return replace(found, others=(*found.others, lying)), None
    if worse < -like:
        # A false power may look the same: it need not be as unlikely as to accuse somebody of it.
        power = search.beside_powers(now)
        if power.cost > lying.cost + like:
            return found, phases[best]
        return replace(found, others=(*found.others, lying, power)), None
    return replace(found, others=(*found.others, lying)) if worse <= like else found, None


def ended(
    design: SequentialDesign, priors: tuple[Prior, ...], trust: Trust, seen: Examined, window: Window
) -> Bools:
    """Distrusted meters whose manipulation is over, though long means still contain it.

    What a short scale sees of them is honest, and further from what a longer one sees than the short one's
    noise and the wandering of loads, and of a busbar that is not read, explain.

    Parameters
    ----------
    design
        The design.
    priors : (s,)
        What is known on each scale without any meter.
    trust
        From the last tick.
    seen, window
        What this tick brought.
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
    """Whether what is believed is looked into again, though nothing new speaks against it.

    Before a meter is named, and now and then while that is in doubt; while more is suspected than meters;
    and from time to time, at ticks at which no shorter scale has just searched.
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
    """What the design's decoder says, as explanations, and whom that leaves trusted."""
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
