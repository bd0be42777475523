"""Who is believed: every scale judges, and where one finds evidence the likeliest liars are looked for.

References
----------
docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.sequential import search
from gridsec.sequential.conditional import Fit, Judged, Prior, admit, drop, fit, judge
from gridsec.sequential.design import SequentialDesign, suspicions
from gridsec.sequential.search import Explanation, Limits
from gridsec.sequential.state import Trust
from gridsec.sequential.windows import Window


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one scale says. p meters.

    Attributes
    ----------
    judged
        Every meter, judged by the trusted others.
    enough : (p,)
        Meters with enough readings on this scale.
    limit : (p,)
        Largest honest offset, squared pu.
    """

    judged: Judged
    enough: Bools
    limit: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Examined:
    """The outcome of one tick. s scales.

    Attributes
    ----------
    trust
        Who is believed now.
    fits, views : (s,)
        By scale; a view is None where the scale was not looked at.
    found
        The explanations that searches came to, by scale.
    """

    trust: Trust
    fits: tuple[Fit | None, ...]
    views: tuple[View | None, ...]
    found: dict[int, Explanation]


# A long scale hardly changes from tick to tick: it is looked at this many times per length.
_LOOKS = 8
# A fit is made anew when that part of its meters changed, or after so many changes (rounding).
_ANEW = 6
_MOST_CHANGES = 400


def examine(
    design: SequentialDesign,
    trust: Trust,
    fits: tuple[Fit | None, ...],
    window: Window,
    prior: Prior,
    *,
    tick: int,
    model: Floats,
) -> Examined:
    """Judge every meter on every scale that is due, shortest first.

    Parameters
    ----------
    design
        The design.
    trust, fits
        From the last tick.
    window
        The residuals.
    prior
        What is known without meters.
    tick
        Number of this tick.
    model : (p,)
        What the model may be off, squared pu.
    """
    views: list[View | None] = []
    after: list[Fit | None] = []
    found: dict[int, Explanation] = {}
    for s, length in enumerate(design.lengths):
        if tick % max(1, length // _LOOKS):
            views.append(None)
            after.append(fits[s])
            continue
        need = max(1, int(np.ceil(design.options.enough * length)))
        enough = window.counts[s] >= need
        noise = design.white / need + design.fixed
        now = adapt(fits[s], prior, noise, trust.trusted & enough, _directions(design, trust))
        m = window.sums[s] / np.maximum(window.counts[s], 1)
        limits = Limits(design.sigmas[s], model, design.allowed, design.fixed)
        judged = judge(now, m)
        limit = limits.of(judged.std)
        over = enough & (np.abs(judged.offset) > limit)
        if (over & trust.trusted).any():
            best = _explain(design, now, m, enough, limits, _elsewhere(trust, s))
            trust = _retrust(trust, best, enough, s)
            now, judged = best.fit, best.judged
            limit = limits.of(judged.std)
            over = enough & (np.abs(judged.offset) > limit)
            found[s] = best
        bad = trust.bad.copy()
        bad[s] = over & ~trust.trusted
        trust = replace(trust, bad=bad)
        views.append(View(judged, enough, limit))
        after.append(now)
    return Examined(trust, tuple(after), tuple(views), found)


def _elsewhere(trust: Trust, s: int) -> Bools:
    """Meters against which other scales have evidence."""
    other = np.delete(trust.bad, s, axis=0)
    return np.asarray(other.any(axis=0) & ~trust.trusted)


def _directions(design: SequentialDesign, trust: Trust) -> Floats | None:
    """Loosened directions, (n, k)."""
    if not trust.accused:
        return None
    book = suspicions(design)
    return np.column_stack([book.std[k] * book.column(k) for k in trust.accused])


def adapt(before: Fit | None, prior: Prior, noise: Floats, wanted: Bools, loose: Floats | None) -> Fit:
    """A fit of the wanted meters, from the last one where that is cheaper.

    Parameters
    ----------
    before
        The last fit of this scale.
    prior, noise
        As in `conditional.fit`.
    wanted : (p,)
        The meters to rest on.
    loose : (n, k)
        Loosened directions.
    """
    width = 0 if loose is None else loose.shape[1]
    if before is None or before.prior is not prior or before.loose.shape[1] != width:
        return fit(prior, noise, wanted, loose)
    change = np.flatnonzero(before.trusted != wanted)
    if not change.size:
        return before
    if change.size * _ANEW > wanted.size or before.changes + change.size > _MOST_CHANGES:
        return fit(prior, noise, wanted, loose)
    now = before.copy()
    for j in change.tolist():
        (admit if wanted[j] else drop)(now, j)
    return now


def _explain(  # noqa: PLR0917  # what a search depends on, in the order of its stages
    design: SequentialDesign, now: Fit, m: Floats, live: Bools, limits: Limits, keep: Bools
) -> Explanation:
    """The cheapest explanation that any start leads to."""
    best = search.descend(now, m, live, limits, keep=keep)
    if np.count_nonzero(live & ~best.fit.trusted) > design.options.several:
        std = np.sqrt(now.noise)
        bound = limits.model + design.options.focus * std
        chosen = search.robust(now.prior, now.noise, m, live & ~keep, bound)
        again = fit(now.prior, now.noise, chosen, now.loose)
        best = _cheaper(best, search.descend(again, m, live, limits, keep=keep))
    if np.count_nonzero(live & ~best.fit.trusted) > 1:
        book = suspicions(design)
        best = _cheaper(best, search.descend(now, m, live, limits, keep=keep, dictionary=book))
    return best


def _cheaper(one: Explanation, other: Explanation) -> Explanation:
    return other if other.cost < one.cost else one


def _retrust(trust: Trust, best: Explanation, enough: Bools, s: int) -> Trust:
    trusted = np.where(enough, best.fit.trusted, trust.trusted)
    fallen = trust.trusted & ~trusted
    return replace(
        trust,
        trusted=trusted,
        scale=np.where(fallen, s, trust.scale),
        age=np.where(fallen, 0, trust.age),
        quiet=np.where(fallen, 0, trust.quiet),
        accused=(*trust.accused, *best.loosened),
    )
