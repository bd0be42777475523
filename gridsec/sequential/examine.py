"""Who is believed: every scale judges, and where one finds evidence the likeliest liars are looked for.

References
----------
docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from gridsec.arrays import Bools, Floats, all_of, any_of
from gridsec.sequential.bounds import Powers
from gridsec.sequential.busbar import Doubt, Honest, aligned, opposed, weight
from gridsec.sequential.conditional import Fit, Prior, drop, judge
from gridsec.sequential.decoder import Accused, Evidence
from gridsec.sequential.design import SequentialDesign
from gridsec.sequential.explain import Search
from gridsec.sequential.robust import covers
from gridsec.sequential.scales import Scale, Scales, View, adapt, believe, view_of
from gridsec.sequential.search import Explanation, Found, Solution
from gridsec.sequential.state import SequentialState, Trust
from gridsec.sequential.windows import Window


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
    busbar
        The phase of the busbar whose meter lies, and the scale that found it: then nothing else counts, and
        the tick has to begin anew without it.
    """

    trust: Trust
    fits: tuple[Fit | None, ...]
    wholes: tuple[Fit | None, ...]
    views: tuple[View | None, ...]
    found: dict[int, Found]
    busbar: tuple[int, int] | None = None


# A long scale hardly changes from tick to tick: it is looked at this many times per length.
_LOOKS = 8
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
    scales = Scales(design, state.doubts, state.window, state.learned, model)
    for s, length in enumerate(design.lengths):
        before = fits[s]
        stale = before is None or (not trust.calm and any_of(before.trusted & ~trust.trusted))
        if tick % _every(length) and not stale:
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
            over = any_of(view.over & trust.trusted)
            over = over or _due(design, trust, view, s, tick, searched=bool(found))
            # Once something is beyond chance, less is suspected too.
            sigmas = min(design.suspect, design.sigmas[s]) if over else design.sigmas[s]
            doubt = Doubt(sigmas, model, state.doubts.busbar[s])
            phases = opposed(design, doubt, now, view.judged)
            phases = phases if over else _beyond(design, here, now, honest, phases)
            if over or phases:
                search = Search(design, scales, tuple(wholes), trust, s)
                outcome, believed = search(now, view) if over else (search.likeliest(now, view), trust)
                outcome, liar = _without_busbar(search, outcome, now, (doubt, honest.powers), phases)
                if liar is not None:
                    return Examined(state.trust, fits, state.wholes, (None,) * len(fits), {}, (liar, s))
                # Where no meter was beyond chance nobody is suspected for what is said of the busbar.
                if over:
                    found[s], trust = outcome, believed
        if s in found:
            trust, calm = _own(trust) if calm else trust, False
            now = found[s].best.fit
            view = view_of(design, here, found[s].best.judged)
            weight(design, now)
        if not calm:
            # A scale that has caught somebody and does not know enough, yet or any more, stands by it.
            owed = (trust.owed > 0) & (trust.scale == s)
            stands = np.where(view.enough, view.still, trust.still[s]) | owed
            trust.bad[s], trust.still[s] = view.over & ~trust.trusted, stands & ~trust.trusted
        views.append(view)
        after.append(now)
    return Examined(trust, tuple(after), tuple(wholes), tuple(views), found)


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


def _beyond(design: SequentialDesign, here: Scale, now: Fit, honest: Honest, phases: list[int]) -> list[int]:
    """Phases of the busbar where honest errors that are all alike do not explain what the meters say."""
    if not phases:
        return phases
    could = aligned(design, now, here.m, here.limits.model + here.limits.allowed, honest)
    return [phase for phase in phases if not could[phase]]


def _disputed(search: Search, best: Solution, beyond: tuple[Doubt, Powers], phases: list[int]) -> list[int]:
    """Phases whose busbar those whom an explanation believes contradict too, or where it accuses many."""
    if not phases:
        return phases
    design, here, (doubt, powers) = search.design, search.here, beyond
    accused = here.enough & ~best.trusted
    if np.count_nonzero(accused) > design.most:
        return phases
    bent = powers.bent(design.plant, _claimed(search, best))
    left = opposed(design, replace(doubt, model=doubt.model + bent), best.fit, best.judged)
    many = _MANY * (accused @ design.hangs_on) > here.enough @ design.hangs_on
    return [phase for phase in phases if phase in left or many[phase]]


def _claimed(search: Search, best: Solution) -> Bools:
    """Customers who claim much, and whose powers are false if an explanation is right or may be, (N,)."""
    design = search.design
    out = np.zeros(design.customers, dtype=np.bool_)
    out[design.plant.meters[search.here.enough & ~best.trusted]] = True
    out[[k for k in best.loosened if k < design.customers]] = True
    return out & (search.book.std[: design.customers] > design.options.hidden_power)


# More than one in so many must be accused on a phase before its busbar's meter is doubted by that alone.
_MANY = 3


def _without_busbar(
    search: Search, found: Found, now: Fit, beyond: tuple[Doubt, Powers], phases: list[int]
) -> tuple[Found, int | None]:
    """What was found, and the phase of the busbar of which it is far likelier that its meter lies.

    If that is about as likely it is one of the other explanations. It is none if it accuses more meters than
    can be told apart where the others do without.
    """
    design, here = search.design, search.scales[search.s]
    phases = _disputed(search, found.best, beyond, phases)
    if not phases:
        return found, None
    each = [search.beside_busbar(now, phase) for phase in phases]
    best = min(range(len(each)), key=lambda k: each[k].cost)
    suspects = [int(np.count_nonzero(here.enough & ~one.trusted)) for one in (each[best], found.best)]
    if suspects[0] > max(design.most, suspects[1]):
        return found, None
    worse, like = each[best].cost - found.best.cost, 2.0 * float(np.log(design.options.like))
    if worse < -like:
        # A false power may look the same: it need not be as unlikely as to accuse somebody of it.
        power = search.beside_powers(now)
        if power.cost > each[best].cost + like:
            return found, phases[best]
        return replace(found, others=(*found.others, each[best], power)), None
    return replace(found, others=(*found.others, each[best])) if worse <= like else found, None


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
    first = (since < max(_every(design.lengths[s]), _AGAIN)) | ~trust.bad[s]
    if any_of(about & first) or (tick % _AGAIN == 0 and any_of(about)):
        return True
    last = len(design.lengths) - 1
    return s == last and tick % design.lengths[last] == 0 and not searched


@cache
def _every(length: int) -> int:
    """Ticks from one look at a scale to the next."""
    return max(1, round(length / _LOOKS))


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
