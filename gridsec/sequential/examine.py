"""Who is believed: every scale judges, and where one finds evidence the likeliest liars are looked for.

References
----------
docs/theory-sequential.md, sections 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.sequential import search
from gridsec.sequential.commission import Learned
from gridsec.sequential.conditional import Fit, Judged, Prior, admit, drop, fit, judge, misfit
from gridsec.sequential.decoder import Accused, Evidence
from gridsec.sequential.design import SequentialDesign
from gridsec.sequential.dictionary import Dictionary
from gridsec.sequential.search import Explanation, Found, Limits, Solution, likelier
from gridsec.sequential.state import Doubts, SequentialState, Trust
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
    over : (p,)
        Whose offset is larger.
    limits, lower
        How the limits come about, and the part of `sigmas` that is expected of a meter that is to be
        trusted again.
    """

    judged: Judged
    enough: Bools
    limit: Floats
    over: Bools
    limits: Limits
    lower: float

    @property
    def still(self) -> Bools:
        """Whose offset is larger than what is expected of a meter that is to be trusted again, (p,)."""
        judged = self.judged
        return self.enough & (np.abs(judged.offset) > self.limits.of(judged.std, self.lower))


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
        The likeliest explanation that a search came to, and the others, by scale.
    """

    trust: Trust
    fits: tuple[Fit | None, ...]
    views: tuple[View | None, ...]
    found: dict[int, Found]


# A long scale hardly changes from tick to tick: it is looked at this many times per length.
_LOOKS = 8
# With more meters than this beyond their limits at once, moving one after the other is no good start.
_FEW = 32
# With no more suspects than this, whether each of them could be honest is looked into by a search.
_CLOSE = 8
# A fit is made anew when that part of its meters changed, or after so many changes (rounding).
_ANEW = 6
_MOST_CHANGES = 400


def examine(design: SequentialDesign, state: SequentialState, model: Floats) -> Examined:
    """Judge every meter on every scale that is due, shortest first.

    Parameters
    ----------
    design
        The design.
    state
        With this tick's window and doubts, and all else from the last tick.
    model : (p,)
        What the model may be off, squared pu.
    """
    fits, window, prior, tick = state.fits, state.window, state.doubts.prior, state.ticks
    bad, still = state.trust.bad.copy(), state.trust.still.copy()
    trust = replace(state.trust, bad=bad, still=still)
    views: list[View | None] = []
    after: list[Fit | None] = []
    found: dict[int, Found] = {}
    scales = _Scales(design, prior, window, state.learned, model)
    book = suspicions(design, state.doubts)
    for s, length in enumerate(design.lengths):
        before = fits[s]
        stale = before is None or bool((before.trusted & ~trust.trusted).any())
        if tick % max(1, round(length / _LOOKS)) and not stale:
            views.append(None)
            after.append(before)
            continue
        here = scales[s]
        now = adapt(before, prior, here.noise, trust.trusted & here.enough, _directions(book, trust.accused))
        view = _view(design, here, now)
        if design.decoder is not None:
            found[s], trust = _decoded(design, here, now, trust, s)
            now = found[s].best.fit
            view = _view(design, here, now)
        elif (view.over & trust.trusted).any() or _due(design, trust, view, s, tick):
            found[s], trust = _Search(design, scales, book, fits, trust, s)(now, view)
            now = found[s].best.fit
            view = _view(design, here, now)
        bad[s] = still[s] = False
        if not trust.trusted.all():
            bad[s], still[s] = view.over & ~trust.trusted, view.still & ~trust.trusted
        views.append(view)
        after.append(now)
    return Examined(trust, tuple(after), tuple(views), found)


def suspicions(design: SequentialDesign, doubts: Doubts) -> Dictionary:
    """What else but meters can be wrong now: false powers are of the size of what is claimed.

    Parameters
    ----------
    design, doubts
        The design, and what the frame claims.
    """
    rest = design.book.std[design.customers :]
    return replace(design.book, std=np.concatenate([doubts.claims, rest]))


def ended(design: SequentialDesign, trust: Trust, seen: Examined, window: Window) -> Bools:
    """Distrusted meters whose manipulation is over, though long means still contain it.

    What a short scale sees of them is honest, and further from what a longer one sees than the short one's
    noise and the loads' wandering explain.

    Parameters
    ----------
    design
        The design.
    trust
        From the last tick.
    seen, window
        What this tick brought.
    """
    out = np.zeros_like(trust.trusted)
    suspected = ~trust.trusted & ~seen.trust.trusted
    if not suspected.any():
        return out
    means = window.sums / np.maximum(window.counts, 1)
    wander = 2.0 * design.prior.variance[design.prior.meters] * design.step_s / design.doubt.time_s
    for s, short in enumerate(seen.views[:-1]):
        if short is None:
            continue
        quiet = suspected & short.enough & ~short.still
        for later in range(s + 1, len(design.lengths)):
            variance = design.white / np.maximum(window.counts[s], 1) + wander * design.lengths[later]
            far = np.abs(means[later] - means[s]) > design.sigmas[s] * np.sqrt(variance)
            out |= quiet & seen.trust.still[later] & far
    return out


def _due(design: SequentialDesign, trust: Trust, view: View, s: int, tick: int) -> bool:
    """Whether what is believed is looked into again, though nothing new speaks against it.

    Before a meter is named; while more is suspected than meters; and from time to time.
    """
    if any(scale <= s for _, scale in trust.accused):
        return True
    if trust.trusted.all():
        return False
    about = ~trust.trusted & ~trust.named & view.over
    if (about & (trust.age + 1 >= confirmed(design)[trust.scale])).any():
        return True
    last = len(design.lengths) - 1
    return s == last and tick % design.lengths[last] == 0


def confirm(length: int) -> int:
    """Ticks that evidence on a scale must last before a meter is named.

    Parameters
    ----------
    length
        Ticks of the scale.
    """
    return 2 + length // 6


def confirmed(design: SequentialDesign) -> Ints:
    """The same for every scale, (s,).

    Parameters
    ----------
    design
        The design.
    """
    return np.array([confirm(length) for length in design.lengths])


@dataclass(frozen=True, slots=True, eq=False)
class _Scale:
    """What one scale has to judge by."""

    noise: Floats
    m: Floats
    enough: Bools
    limits: Limits


class _Scales:
    """All scales at one tick."""

    def __init__(
        self, design: SequentialDesign, prior: Prior, window: Window, learned: Learned, model: Floats
    ) -> None:
        self.design, self.prior, self.window, self.model = design, prior, window, model
        self.learned = learned

    def __getitem__(self, s: int) -> _Scale:
        design, counts = self.design, self.window.counts[s]
        need = max(1, int(np.ceil(design.options.enough * design.lengths[s])))
        return _Scale(
            noise=design.white / need + self.learned.variance,
            m=self.window.sums[s] / np.maximum(counts, 1),
            enough=counts >= need,
            limits=Limits(design.sigmas[s], self.model, self.learned.allowed, self.learned.variance),
        )


def _view(design: SequentialDesign, here: _Scale, now: Fit) -> View:
    judged = judge(now, here.m)
    limit = here.limits.of(judged.std)
    over = here.enough & (np.abs(judged.offset) > limit)
    return View(judged, here.enough, limit, over, here.limits, design.options.lower)


def _directions(book: Dictionary, accused: tuple[tuple[int, int], ...]) -> Floats | None:
    """Loosened directions, (n, k)."""
    if not accused:
        return None
    which = np.array([k for k, _ in accused])
    return np.asarray(book.columns(which) * book.std[which])


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
    if before is None or before.prior is not prior:
        return fit(prior, noise, wanted, loose)
    if before.loose.shape[1] if loose is None else not np.array_equal(before.loose, loose):
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


class _Search:
    """The explanations that several starts lead to on one scale.

    The starts: what was believed, without what this scale and shorter ones suspect besides meters; where
    several meters are suspected, a robust fit and all meters close to the model; and where any is, what was
    believed with suspicions besides meters. Where few are, everybody is believed once more, and meters may
    fall in pairs; then for each suspect the likeliest explanation in which it is honest. Longer means know
    better, so they decide anew about what shorter ones suspected.

    Meters against which other scales have evidence are not admitted, or lies that have just begun would
    be believed again. Unless the explanation that does admit them is cheaper over all scales together.
    """

    def __init__(  # noqa: PLR0917  # what is known, in the order it becomes known
        self,
        design: SequentialDesign,
        scales: _Scales,
        book: Dictionary,
        fits: tuple[Fit | None, ...],
        trust: Trust,
        s: int,
    ) -> None:
        self.design, self.scales, self.book = design, scales, book
        self.fits, self.trust, self.s = fits, trust, s
        here = scales[s]
        sigmas = min(design.suspect, here.limits.sigmas)
        self.here = replace(here, limits=replace(here.limits, sigmas=sigmas))
        self.keep = _held(trust, s)
        self.accused = tuple(suspicion for suspicion in trust.accused if suspicion[1] > s)

    def __call__(self, now: Fit, view: View) -> tuple[Found, Trust]:
        """What is found, and whom that leaves trusted."""
        start = now if len(self.accused) == len(self.trust.accused) else self._fit(now.trusted)
        few = np.count_nonzero(view.over & now.trusted) <= _FEW
        found = Found(self._descend(start, self.keep)) if few else None
        free = None
        if found is None or self._suspected(found) > self.design.options.several:
            free = self._free()
            if (free.best.trusted & self.keep).any():
                held = self._fit(free.best.trusted & ~self.keep)
                found = likelier(found, Found(self._descend(held, self.keep, fresh=True)))
            else:
                found, free = likelier(found, free), None
        if few and self._suspected(found) > 0:
            found = likelier(found, Found(self._descend(start, self.keep, self.book)))
            if self._suspected(found) <= _CLOSE:
                nobody, all_ = np.zeros_like(self.keep), self._fit(self.here.enough)
                close = self._descend(all_, nobody, self.book, pairs=True, fresh=True)
                free = likelier(free, Found(close))
        best = found.best
        if free is not None:
            better = free.best.cost < best.cost and self._total(free.best) < self._total(best)
            first, second = (free, found) if better else (found, free)
            found = Found(first.best, (second.best.bare(), *first.others, *second.others))
        rivals = (*found.others, *self._instead(found.best))
        found = replace(found, others=tuple(self._compared(found.best, other) for other in rivals))
        return found, self._believe(found.best)

    def _instead(self, best: Solution) -> list[Explanation]:
        """Explanations in which one of those who might be named is honest."""
        fresh = self.here.enough & ~best.trusted & ~self.trust.named
        if np.count_nonzero(fresh) > _CLOSE:
            return []
        out, keep = [], self.keep & self.trust.named
        # Nobody is named by this: whatever makes an explanation cheaper is worth trying.
        fair = float(np.sqrt(search.price(fresh.size, 1)))
        limits = replace(self.here.limits, sigmas=min(self.here.limits.sigmas, fair))
        for j in np.flatnonzero(fresh).tolist():
            other = self._descend(best.fit, keep, self.book, innocent=j, pairs=True, limits=limits)
            if np.count_nonzero(self.here.enough & ~other.trusted) <= self.design.most:
                charge = best.charge + other.charge
                cost, loosened = best.charge + other.cost, best.loosened + other.loosened
                out.append(Explanation(other.trusted, loosened, charge, cost))
        return out

    def _compared(self, best: Solution, other: Explanation) -> Explanation:
        """A rival, at what it costs on the scale that speaks most against it.

        Long means hardly know yet of a lie that has just begun, short ones hardly see a small one.
        """
        same = other.loosened == best.loosened and np.array_equal(other.trusted, best.trusted)
        if same or other.cost - best.cost > 2.0 * np.log(self.design.options.like):
            return other
        prices = self._prices(other) - self._prices(best)
        both = zip(self._misfits(other), self._misfits(best), strict=True)
        return replace(other, cost=best.cost + prices + max(theirs - ours for theirs, ours in both))

    def _suspected(self, found: Found) -> int:
        """How many meters are suspected at least."""
        enough = self.here.enough
        return min(int(np.count_nonzero(enough & ~each.trusted)) for each in (found.best, *found.others))

    def _free(self) -> Found:
        """What is found from starts that owe nothing to what was believed."""
        found: Found | None = None
        for chosen in self._starts():
            # A descent stays where another one has ended.
            if found is None or not np.array_equal(chosen & self.here.enough, found.best.trusted):
                new = self._descend(self._fit(chosen), np.zeros_like(chosen), fresh=True)
                found = likelier(found, Found(new))
        assert found is not None  # noqa: S101  # there is a start
        return found

    def _starts(self) -> tuple[Bools, Bools]:
        """A robust fit, and the meters close to the model."""
        here, prior = self.here, self.scales.prior
        focus, std = self.design.options.focus, np.sqrt(here.noise)
        chosen = search.robust(prior, here.noise, here.m, here.enough, here.limits.model + focus * std)
        alone = np.sqrt(prior.variance[prior.meters] + here.noise)
        return chosen, here.enough & (np.abs(here.m) <= here.limits.model + focus * alone)

    def _descend(
        self,
        start: Fit,
        keep: Bools,
        book: Dictionary | None = None,
        *,
        innocent: int | None = None,
        pairs: bool = False,
        limits: Limits | None = None,
        fresh: bool = False,
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
        )

    def _fit(self, trusted: Bools) -> Fit:
        loose = _directions(self.book, self.accused)
        return fit(self.scales.prior, self.here.noise, trusted & self.here.enough, loose)

    def _total(self, found: Explanation) -> float:
        """The misfit on all scales and, once, what the accusations cost."""
        return self._prices(found) + sum(self._misfits(found))

    def _prices(self, found: Explanation) -> float:
        suspects = int(np.count_nonzero(~self._trusted(found)))
        return found.charge + search.price(self.keep.size, suspects)

    def _trusted(self, found: Explanation) -> Bools:
        return np.where(self.here.enough, found.trusted, self.trust.trusted)

    def _misfits(self, found: Explanation) -> list[float]:
        """What an explanation leaves unexplained on each scale."""
        trusted, out = self._trusted(found), []
        loose = _directions(self.book, (*self.accused, *((k, self.s) for k in found.loosened)))
        for s in range(len(self.fits)):
            there = self.scales[s]
            if s == self.s and isinstance(found, Solution):
                out.append(found.judged.misfit)
            else:
                wanted = trusted & there.enough
                out.append(misfit(self.scales.prior, there.noise, there.m, wanted, loose))
        return out

    def _believe(self, best: Explanation) -> Trust:
        trust = self.trust
        trusted = np.where(self.here.enough, best.trusted, trust.trusted)
        fallen = trust.trusted & ~trusted
        return replace(
            trust,
            trusted=trusted,
            scale=np.where(fallen, self.s, trust.scale),
            age=np.where(fallen, 0, trust.age),
            quiet=np.where(fallen, 0, trust.quiet),
            accused=(*self.accused, *((k, self.s) for k in best.loosened)),
        )


def _decoded(design: SequentialDesign, here: _Scale, now: Fit, trust: Trust, s: int) -> tuple[Found, Trust]:
    """What the design's decoder says, as explanations, and whom that leaves trusted."""
    judged = judge(now, here.m)
    over = here.enough & (np.abs(judged.offset) > here.limits.of(judged.std))
    tight = now if not now.loose.shape[1] else None
    whole = adapt(tight, now.prior, here.noise, here.enough, None)
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
    trusted = np.where(here.enough, ~best.meters, trust.trusted)
    fallen = trust.trusted & ~trusted
    return found, replace(
        trust,
        trusted=trusted,
        scale=np.where(fallen, s, trust.scale),
        age=np.where(fallen, 0, trust.age),
        quiet=np.where(fallen, 0, trust.quiet),
        accused=(),
    )


def _solution(here: _Scale, whole: Fit, answer: Accused) -> Solution:
    now = whole.copy()
    for j in np.flatnonzero(answer.meters & here.enough).tolist():
        drop(now, j)
    return Solution(now.trusted, (), 0.0, answer.worse, now, judge(now, here.m))


def _held(trust: Trust, s: int) -> Bools:
    """Meters that must stay distrusted: named ones, and those other scales have evidence against."""
    other = np.delete(trust.still, s, axis=0).any(axis=0)
    return np.asarray(~trust.trusted & (other | (trust.named & trust.still[s])))
