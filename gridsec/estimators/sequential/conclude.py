"""Output of one tick: an estimate with its error, and a verdict with its reason.

References
----------
docs/theory-sequential.md, sections 5 and 7.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from gridsec.arrays import Bools, Floats, all_of, any_of, changed
from gridsec.estimators.decision import DecisionInputs, decide
from gridsec.estimators.sequential import words
from gridsec.estimators.sequential.apart import apart
from gridsec.estimators.sequential.bounds import Bounded, Grounds, Powers
from gridsec.estimators.sequential.busbar import Busbar, follow
from gridsec.estimators.sequential.conditional import Prior, judge
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.doubts import checked
from gridsec.estimators.sequential.examine import Examined
from gridsec.estimators.sequential.heard import Heard
from gridsec.estimators.sequential.release import Released, release
from gridsec.estimators.sequential.scales import needed
from gridsec.estimators.sequential.skew import Skew, largest, unusable
from gridsec.estimators.sequential.state import SequentialState, Trust
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, PowerOrigin, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """Results of one tick. N customers, p meters, n buses."""

    frame: Frame  # with possible powers
    heard: Heard  # its measurements
    q: Floats  # (N,) net reactive injections of the model, pu
    v2_bus: Floats  # (n,) squared voltages of the model
    transient: Floats  # (p,) remainder of the unknown initial state, squared pu
    seen: Examined  # identification
    rivals: tuple[Explanation, ...]  # hypotheses about as likely as the best


def conclude(
    design: SequentialDesign, state: SequentialState, tick: Tick
) -> tuple[SequentialState, Estimate, Verdict]:
    """State with the output in it, estimate and verdict, from the state after this tick."""
    trust, heard = state.trust, tick.heard
    beside = apart(state.apart, state.fits, state.doubts)
    state = state if beside is state.apart else changed(state, apart=beside)
    s, moved = _best(design, state)
    estimate, released = _estimate(design, state, tick, s, moved)
    busbar, inverters = _busbar(design, state, heard, estimate), _inverters(design, state)
    score, threshold, judged = _worst(design, tick.seen, heard.live.size)
    if state.skew is not None:
        judged = judged | _judged_seldom(design, state.skew, state)
    live, beyond = judged & heard.live, score > threshold
    attack = np.zeros(live.size)
    if any_of(trust.named):
        off = heard.y - state.learned.bias - estimate.v2_bus[design.prior.meters]
        attack = np.where(trust.named & heard.live, off, 0.0)
    amounts = _amounts(design, state, tick.seen)
    settled = all_of(tick.transient <= design.options.settled * threshold)
    said = _of_meters(
        design, trust, live, beyond, wide=~(threshold <= design.options.widest), settled=settled
    )
    differs = _differs(design, busbar, estimate)
    said = _unvouched(design, heard.busbar, live, differs, said)
    open_ = _open(design, state, said)
    said = _beside_meters(design, inverters, differs, amounts, tick.rivals, open_, said)
    said = _unexplained(tick.seen.misfit, said)
    if not (tick.rivals or open_ or all_of(state.doubts.vouched)):
        said = _unread(design, tick.frame, ~state.doubts.vouched[max(s, 0)], estimate, said)
    said = _untimely(design, tick.frame, live, said)
    decision, cause, reason = said
    verdict = Verdict(
        decision,
        cause,
        reason,
        trust.named,
        score,
        threshold,
        attack,
        inverters=inverters,
        inverter_attack=_injected(design, state, inverters, amounts),
        kinds=state.kinds.kinds,
        explanations=tick.rivals or open_,
        unjudged=design.unseen & ~(state.curves.heard | inverters),
        busbar=differs.named,
        busbar_attack=np.where(differs.named, busbar.off, 0.0),
    )
    last = estimate, verdict
    return changed(state, released=released, busbar=busbar, last=last), estimate, verdict


def _busbar(design: SequentialDesign, state: SequentialState, heard: Heard, estimate: Estimate) -> Busbar:
    """Trust of the busbar's meter after this tick."""
    before = state.busbar
    if all_of(before.believed):
        return before
    fits = (state.fits[s] for s in before.scale.tolist())
    left = np.array([np.nan if fit is None else fit.variance[k] for k, fit in enumerate(fits)])
    judged = heard.says & np.isfinite(left)
    v0_squared = estimate.v2_bus[design.plant.feeder.busbar_places()]
    allowed = float(state.learned.allowed.max())
    return follow(design, before, heard.said, judged, v0_squared, np.where(judged, left, 0.0), allowed)


def _inverters(design: SequentialDesign, state: SequentialState) -> Bools:
    """Named inverters: by the voltages unless their metered power follows the curve, or by that power."""
    named, curves = state.trust.inverters, state.curves
    return named if curves.idle else (named & ~curves.agrees(design)) | curves.named(design)


def _injected(
    design: SequentialDesign, state: SequentialState, inverters: Bools, amounts: dict[int, float]
) -> Floats:
    """Deviation of named inverters from their curves, as metered where it is, (m,)."""
    out = np.zeros(inverters.size)
    if any_of(inverters):
        for k, amount in amounts.items():
            if k >= design.customers:
                out[k - design.customers] = amount
        metered = state.curves.amounts(design)
        out = np.where(inverters, np.where(metered != 0.0, metered, out), 0.0)
    return out


def _estimate(
    design: SequentialDesign, state: SequentialState, tick: Tick, s: int, moved: float
) -> tuple[Estimate, Released | None]:
    """Estimate by scale s, with a mean that lacks a part `moved` of the loads' variance."""
    plant = design.plant
    heard = tick.heard
    w, variance, released = _reconstructed(design, state, tick, s, moved)
    v2_bus = tick.v2_bus + w
    first = plant.feeder.busbar_places()
    v2_bus[first] = np.where(heard.busbar, heard.v0_squared, v2_bus[first])
    # This is a reading; the posterior of the others does not lower its variance.
    variance = variance.copy()
    variance[first] = np.maximum(variance[first], np.where(heard.busbar, design.busbar**2, 0.0))
    trusted = state.trust.trusted & heard.live
    grounds = Grounds(
        plant=plant,
        powers=Powers(
            tick.frame, tick.q, heard.told, heard.v0_squared, state.trust.trusted, state.doubts.sizes
        ),
        injected=state.lag.error,
        model=tick.v2_bus[plant.feeder.bus],
        busbar=heard.busbar,
        y=heard.y,
        trusted=trusted,
        reads=partial(checked, design, tick.frame),
        sigmas=design.sigmas[0],
    )
    x = np.zeros(0) if state.x is None else state.x
    return Bounded.on(grounds, state.t, v2_bus, variance, x), released


_Said = tuple[Decision, Cause, str]
_MILD = (Cause.AGREEMENT, Cause.AMBIGUOUS)
"""Causes that findings on inverters and loads replace."""


def _of_meters(
    design: SequentialDesign, trust: Trust, live: Bools, beyond: Bools, *, wide: Bools, settled: bool
) -> _Said:
    """Verdict on the meters: available, beyond their limits, with too wide limits, (p,) each."""
    said = decide(
        DecisionInputs(
            names=design.names,
            max_attacked=max(1, min(design.most, int(np.count_nonzero(live)) // 3)),
            live=live,
            suspected=~trust.trusted | beyond,
            named=trust.named,
            wide=live & wide,
            valid=True,
            settled=settled,
            busbar=True,
        )
    )
    return _contradicted(design, beyond & ~trust.named, trust.named, said)


def _judged_seldom(design: SequentialDesign, skew: Skew, state: SequentialState) -> Bools:
    """Meters with a clock offset, (p,), on scales that test them without a look at this tick."""
    need = np.array([needed(design, s) for s in range(len(design.lengths))])
    return skew.judged(state.window.counts, need)


def _contradicted(design: SequentialDesign, beyond: Bools, named: Bools, said: _Said) -> _Said:
    """Verdict, UNDECIDED if a decoder leaves more than `max_attacked` meters beyond their limits."""
    if design.decoder is None or said[1] is not Cause.RESIDUALS:
        return said
    more, most = int(np.count_nonzero(beyond)), design.most
    if not more or int(np.count_nonzero(named)) + more <= most:
        return said
    sentence = f"{said[2][:-1]}; but so are {more} of the others, and at most {most} can be told apart."
    return Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS, sentence


@dataclass(frozen=True, slots=True, eq=False)
class _Differs:
    """Findings on the busbar's meter: named phases (b,), meter and deviation in words, empty if trusted."""

    named: Bools
    meter: str = ""
    off: str = ""


def _differs(design: SequentialDesign, busbar: Busbar, estimate: Estimate) -> _Differs:
    if all_of(busbar.believed):
        return _Differs(busbar.named)
    doubted, v0_squared = ~busbar.believed, estimate.v2_bus[design.plant.feeder.busbar_places()]
    off = words.busbar_off(busbar.off, v0_squared, doubted)
    return _Differs(busbar.named, words.busbar_meter(doubted), off)


def _unvouched(
    design: SequentialDesign, busbar: Bools | bool, live: Bools, differs: _Differs, said: _Said
) -> _Said:
    """Verdict, UNDECIDED if too few meters of a phase without a busbar voltage report.

    On a balanced feeder most meters are honest and determine the busbar. In three phases those of one phase
    do, which takes more than twice as many as may be manipulated.
    """
    if said[0] is not Decision.CLEAN or all_of(np.asarray(busbar)):
        return said
    feeder, meters = design.plant.feeder, design.prior.meters[live]
    heard = feeder.same_busbar_phase(np.arange(np.size(busbar)), meters) * np.ones(meters.size)
    count = np.where(busbar, meters.size, heard.sum(axis=-1)).min()
    most = max(1, min(design.most, meters.size // 3))
    if count > 2 * most:
        return said
    why = "The busbar voltage of a phase is missing"
    if differs.meter:
        why = f"{differs.meter.capitalize()} {differs.off}"
    sentence = (
        f"{why}, and {count:.0f} meters report from there; "
        f"at least {2 * most + 1} are needed to tell {most} manipulated from the others."
    )
    return Decision.UNDECIDED, Cause.TOO_FEW_METERS, sentence


def _unexplained(misfit: tuple[bool, ...], said: _Said) -> _Said:
    """Verdict, with the misfit of the trusted meters on a scale that no search explains."""
    decision, cause, reason = said
    if not any(misfit):
        return said
    if decision is Decision.ATTACKED:
        return decision, cause, f"{reason} The other meters, taken together, still disagree with the feeder."
    # Silent meters do not outweigh this evidence.
    if cause not in (Cause.AGREEMENT, Cause.SILENT_METERS):
        return said
    sentence = (
        "The meters, taken together, disagree with the feeder by more than chance, though none of them does "
        "by itself."
    )
    return Decision.UNDECIDED, Cause.MISFIT, sentence


def _unread(design: SequentialDesign, frame: Frame, unread: Bools, estimate: Estimate, said: _Said) -> _Said:
    """Verdict, UNDECIDED if a voltage beside an unread power is too uncertain."""
    if said[1] not in _MILD or not any_of(unread):
        return said
    at, limit = design.plant.meters, design.options.unread_std_percent
    v = np.sqrt(np.maximum(estimate.v2[at], _DEAD))
    percent = 50.0 * estimate.std[at] / (v * design.plant.droop.vbar)
    wide = unread & ~(percent <= limit)
    if not any_of(wide):
        return said
    origins = np.zeros(frame.p.size, dtype=np.intp) if frame.p_origin is None else frame.p_origin
    sentence = words.unread(design.names, wide, origins[at], percent, limit)
    return Decision.UNDECIDED, Cause.MISSING_POWERS, sentence


def _untimely(design: SequentialDesign, frame: Frame, live: Bools, said: _Said) -> _Said:
    """Verdict, with the meters that count as silent for a clock offset that no scale covers."""
    decision, cause, reason = said
    far = unusable(design, frame.clock_offset)
    if far is None or cause not in (Cause.SILENT_METERS, Cause.TOO_FEW_METERS):
        return said
    sentence = words.untimely(design.names, far, largest(design))
    if cause is Cause.SILENT_METERS and not any_of(~live & ~far):
        return decision, Cause.CLOCK_OFFSET, sentence
    return decision, cause, f"{reason} {sentence}"


_DEAD = 1e-2
"""Least squared voltage that relates a standard deviation to the voltage, pu."""


def _open(design: SequentialDesign, state: SequentialState, said: _Said) -> tuple[Explanation, ...]:
    """Hypotheses about metered reactive powers that the voltages leave open."""
    if state.curves.idle:
        return ()
    sure = state.trust.named if said[1] is Cause.RESIDUALS else np.zeros_like(state.trust.named)
    return state.curves.explanations(design, sure) if said[1] in (*_MILD, Cause.RESIDUALS) else ()


def _beside_meters(  # noqa: PLR0917
    design: SequentialDesign,
    inverters: Bools,
    differs: _Differs,
    amounts: dict[int, float],
    rivals: tuple[Explanation, ...],
    open_: tuple[Explanation, ...],
    said: _Said,
) -> _Said:
    """Verdict, with findings other than meters."""
    decision, cause, reason = said
    plant, found = design.plant, []
    if any_of(inverters):
        owners = ", ".join(plant.feeder.customers[c] for c in plant.droop.customer[inverters])
        found.append((f"the inverters of {owners}", "their reactive power is not that of their curves"))
    if any_of(differs.named):
        found.append((differs.meter, f"it {differs.off}"))
    if cause is Cause.RESIDUALS:
        reason = f"{reason[:-1]}; and {' and '.join(each for each, _ in found)}." if found else reason
        return decision, cause, f"{reason} {words.ways(design, open_)}" if open_ else reason
    # Silent meters do not outweigh this evidence.
    if cause not in ((*_MILD, Cause.SILENT_METERS) if found else _MILD):
        return said
    if found:
        sentence = f"Manipulated: {'; and '.join('; '.join(each) for each in found)}."
        return Decision.ATTACKED, Cause.RESIDUALS, sentence
    sentence = ""
    if differs.meter:
        sentence = f"{differs.meter.capitalize()} {differs.off}; it is not believed."
    elif rivals or open_:
        sentence = words.ways(design, rivals or open_)
    elif amounts:
        sentence = words.doubt(design, *next(iter(amounts.items())))
    return (Decision.UNDECIDED, Cause.AMBIGUOUS, sentence) if sentence else said


def _amounts(design: SequentialDesign, state: SequentialState, seen: Examined) -> dict[int, float]:
    """Amount of each accused fault, by index of the dictionary, pu.

    With prior variance s^2 and direction a the posterior mean is ``s^2 a^T Q m``.
    """
    out: dict[int, float] = {}
    book, std = design.book, state.doubts.sizes
    for k, s in state.trust.accused:
        view, now = seen.views[s], state.fits[s]
        if view is not None:
            weights = view.judged.weights
        elif now is not None:
            weights = now.weights(_mean(state, s))
        else:
            continue
        out[k] = float(std[k] ** 2 * book.along(weights)[k])
    return out


def _mean(state: SequentialState, s: int) -> Floats:
    """Mean residuals on a scale, (p,)."""
    return np.asarray(state.window.sums[s] / np.maximum(state.window.counts[s], 1))


def _reconstructed(
    design: SequentialDesign, state: SequentialState, tick: Tick, s: int, moved: float
) -> tuple[Floats, Floats, Released | None]:
    """Correction of the model by the trusted meters at every bus, its variance, and the doubted powers."""
    prior_, told = state.doubts.priors[max(s, 0)], tick.frame.p_std
    now, view = (None, None) if s < 0 else (state.fits[s], tick.seen.views[s])
    if now is None:
        return np.zeros_like(prior_.variance), prior_.variance, None
    judged = judge(now, _mean(state, s)) if view is None else view.judged
    # The model starts at this busbar reading; a mean removes only its part of the jitter.
    jitter = (1.0 - 1.0 / design.lengths[s]) * design.flicker
    flicker = design.plant.feeder.broadcast_busbar(np.where(tick.heard.busbar, jitter, 0.0))
    after = moved * prior_.variance + _hidden(state, prior_) + flicker
    beside = state.apart[s]
    if beside is not None:
        after = after + beside.added(judged)
    liars = design.plant.meters[~state.trust.trusted]
    # Unreported powers, known by a standard deviation, are not false.
    liars = liars if told is None else liars[np.isnan(told[liars]) | _late(tick.frame)[liars]]
    if not liars.size:
        return judged.w, now.variance + after, None
    sizes, released = state.doubts.sizes[liars], state.released
    if released is None or not released.about(now, liars, sizes):
        released = release(design.effects, now, liars, sizes, judged)
    elif s in tick.seen.found or not released.holds(judged):
        released = released.anew(judged)
    return released.said(judged), released.variance + after, released


def _late(frame: Frame) -> Bools:
    """Customers with a power that is read and has a standard deviation all the same, (N,)."""
    if frame.p_origin is None:
        return np.zeros(frame.p.size, dtype=np.bool_)
    return np.asarray(frame.p_origin != PowerOrigin.UNREAD)


def _best(design: SequentialDesign, state: SequentialState) -> tuple[int, float]:
    """Scale of the least posterior variance, -1 for none, and the part of the loads' variance it lacks.

    A mean over many ticks does not contain the present loads.
    """
    at, least, moved = -1, np.inf, 0.0
    for s, (now, length) in enumerate(zip(state.fits, design.lengths, strict=True)):
        if now is None:
            continue
        lag, beside = min(1.0, length * design.step_s / design.doubt.time_s) * (length > 1), state.apart[s]
        total = (now if beside is None else beside.rest).total() + lag * now.prior.total
        if total < least:
            at, least, moved = s, total, lag
    return at, moved


def _hidden(state: SequentialState, prior_: Prior) -> Floats:
    """Variance of lasting load errors that learning cannot separate, at every bus, (n,)."""
    hidden, late = state.learned.hidden, state.learned.late
    if not any_of(hidden):
        return np.zeros(prior_.variance.size)
    out = np.full(prior_.variance.size, hidden.max(initial=0.0))
    out[prior_.meters] = hidden if late is None else np.maximum(hidden, late)
    return np.asarray(np.minimum(out, prior_.variance))


def _worst(design: SequentialDesign, seen: Examined, p: int) -> tuple[Floats, Floats, Bools]:
    """Residual and limit of each meter on the scale with the strongest evidence; tested meters."""
    views = [view for view in seen.views if view is not None]
    if not views:
        return np.full(p, np.nan), np.full(p, design.options.widest), np.zeros(p, dtype=np.bool_)
    score, limit, judged = np.abs(views[0].judged.offset), views[0].limit, views[0].enough
    ratio = score / limit if all_of(judged) else np.where(judged, score / limit, -1.0)
    for view in views[1:]:
        offset = np.abs(view.judged.offset)
        here = offset / view.limit
        more = view.enough & (here > ratio)
        ratio = np.where(more, here, ratio)
        score, limit = np.where(more, offset, score), np.where(more, view.limit, limit)
        judged = judged | view.enough
    if all_of(judged):
        return score, limit, judged
    return np.where(judged, score, np.nan), np.where(judged, limit, design.options.widest), judged
