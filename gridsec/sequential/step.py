"""One frame in, an estimate and a verdict out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.feeder import bus_voltages, model_error_bound
from gridsec.judge import Situation, decide
from gridsec.lure import known_input
from gridsec.online import Cause, Decision, Estimate, Explanation, Frame, Verdict
from gridsec.sequential.commission import conclude, gather
from gridsec.sequential.conditional import judge
from gridsec.sequential.design import SequentialDesign
from gridsec.sequential.drive import drive
from gridsec.sequential.examine import Examined, confirm, examine
from gridsec.sequential.kinds import Kinds, describe, listen, suspicious
from gridsec.sequential.loads import prior
from gridsec.sequential.search import Explanation as Found
from gridsec.sequential.search import swaps
from gridsec.sequential.state import Doubts, SequentialState, Trust
from gridsec.sequential.windows import Window, push, shift


@dataclass(frozen=True, slots=True, eq=False)
class _Heard:
    """One frame, cleaned. N customers, p meters, m inverters."""

    live: Bools  # (p,)
    y: Floats  # (p,) 0 where not live
    q: Floats  # (N,) of the loads, or metered net where told
    told: Bools  # (N,)
    v0_squared: float
    busbar: bool


def step(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[SequentialState, Estimate, Verdict]:
    """Take one frame in.

    Parameters
    ----------
    design, state
        From `design`, and from `init` or the last step.
    frame
        Everything known at one tick. A frame that is not later than the last one changes nothing: it
        gets the last estimate again, and UNDECIDED.

    Returns
    -------
    SequentialState, Estimate, Verdict
        As every estimator's step; see `gridsec.online`.
    """
    if not np.isfinite(frame.t) or (state.x is not None and not frame.t > state.t):
        return _unusable(design, state, frame)
    plant = design.plant
    at = plant.feeder.bus[plant.meters]
    heard = _clean(design, state, frame)
    doubts = _doubts(design, state.doubts, frame, heard.busbar)
    if doubts is not state.doubts and doubts.prior is not state.doubts.prior:
        state = replace(state, fits=(None,) * len(state.fits))
    kinds = listen(design.shapes, state.kinds, heard.y, heard.live)
    copies = suspicious(kinds) & (design.decoder is None)
    begun = _distrust(state.trust, copies)
    x = _inverters(design, state, frame, heard)
    q, v2_bus = _voltages(design, frame, heard, x)
    residual = heard.y - v2_bus[at] - state.learned.bias
    window = push(state.window, design.lengths, residual, heard.live)
    model = state.model_error
    if state.ticks % _STALE == 0:
        model = _model_error(design, frame.p, q, heard.v0_squared)
    since = frame.t if state.x is None else state.since
    # Without inverters the rate is infinite, and times no time at all it would be no number.
    left = np.exp(-design.certificate.rate * (frame.t - since)) if frame.t > since else 1.0
    transient = design.reach * left
    seen = examine(
        design,
        begun,
        state.fits,
        window,
        prior=doubts.prior,
        learned=state.learned,
        tick=state.ticks,
        model=model + transient,
    )
    trust, doubtful = _name(design, begun, seen)
    trust = _distrust(trust, copies)
    seen = replace(seen, trust=trust)
    after = replace(
        state,
        t=frame.t,
        since=since,
        ticks=state.ticks + 1,
        x=x,
        v0_squared=heard.v0_squared,
        window=window,
        trust=trust,
        fits=seen.fits,
        doubts=doubts,
        model_error=model,
        kinds=_kinds(design, state, kinds, seen, window, v2_bus[at]),
    )
    after = _learn(design, after, residual, heard.live & trust.trusted, frame.t - state.t)
    estimate, verdict = _conclude(design, after, heard, seen, v2_bus, transient, doubtful)
    return replace(after, last=(estimate, verdict)), estimate, verdict


def _voltages(design: SequentialDesign, frame: Frame, heard: _Heard, x: Floats) -> tuple[Floats, Floats]:
    """Reactive injections, (N,), and what the model makes of all of them, (n,)."""
    plant = design.plant
    q = heard.q + np.where(
        heard.told, 0.0, np.bincount(plant.droop.customer, weights=x, minlength=heard.q.size)
    )
    with np.errstate(all="ignore"):
        v2_bus = bus_voltages(plant.feeder, frame.p, q, heard.v0_squared, steps=plant.loss_correction)
    return q, np.where(np.isfinite(v2_bus), v2_bus, heard.v0_squared)


def _distrust(trust: Trust, copies: Bools) -> Trust:
    """Meters that repeat themselves are named, whatever the others say."""
    if not copies.any():
        return trust
    return replace(
        trust,
        trusted=trust.trusted & ~copies,
        quiet=np.where(copies, 0, trust.quiet),
        still=trust.still | copies,
        named=trust.named | copies,
    )


def _kinds(  # noqa: PLR0917  # everything that lies are compared with
    design: SequentialDesign, state: SequentialState, kinds: Kinds, seen: Examined, window: Window, v2: Floats
) -> Kinds:
    """What the manipulations look like, by what the other meters say of each."""
    view, prior_ = seen.views[0], state.doubts.prior
    expected = v2 + state.learned.bias
    if view is None:
        variance = prior_.variance[prior_.meters] + design.white + state.learned.variance
    else:
        mean = window.sums[0] / np.maximum(window.counts[0], 1)
        expected, variance = expected + mean - view.judged.offset, view.judged.std**2
    return describe(design.shapes, kinds, expected, seen.trust.named, variance)


def _learn(
    design: SequentialDesign, state: SequentialState, residual: Floats, use: Bools, h: float
) -> SequentialState:
    """Gather what the meters' fixed errors are, and from some time on rely on it."""
    if state.learning is None or state.ticks == 1:
        return state
    learning = gather(state.learning, residual, use, h)
    if learning.time_s < design.options.commission_s or not state.trust.trusted.all():
        return replace(state, learning=learning)
    learned = conclude(design, learning)
    window = shift(state.window, state.learned.bias - learned.bias)
    return replace(state, learning=None, learned=learned, window=window, fits=(None,) * len(state.fits))


# The model's error is bounded anew every so many ticks.
_STALE = 16


def _clean(design: SequentialDesign, state: SequentialState, frame: Frame) -> _Heard:
    plant = design.plant
    live = frame.seen & np.isfinite(frame.y)
    low, high = design.options.v2_limits
    busbar = bool(np.isfinite(frame.v0_squared) and low <= frame.v0_squared <= high)
    told = np.zeros(frame.q.size, dtype=np.bool_)
    reported = np.isfinite(frame.q_net)
    if reported.any():
        trusted = np.zeros(frame.q.size, dtype=np.bool_)
        trusted[plant.meters] = live & state.trust.trusted
        count = frame.q.size
        most = np.bincount(plant.droop.customer, weights=plant.droop.q[:, 0], minlength=count)
        least = np.bincount(plant.droop.customer, weights=plant.droop.q[:, 3], minlength=count)
        rest, room = np.nan_to_num(frame.q_net) - frame.q, frame.q_error + np.nan_to_num(frame.q_net_error)
        told = trusted & reported & (least - room <= rest) & (rest <= most + room)
    return _Heard(
        live=live,
        y=np.where(live, frame.y, 0.0),
        q=np.where(told, np.nan_to_num(frame.q_net), frame.q),
        told=told,
        v0_squared=frame.v0_squared if busbar else state.v0_squared,
        busbar=busbar,
    )


# Frames that claim to know loads so much less well than the design assumes are believed.
_MUCH_LESS = 4.0
# Squared busbar voltage that is not metered: its standard deviation, squared pu.
_UNMETERED = 0.1


def _doubts(design: SequentialDesign, before: Doubts, frame: Frame, busbar: bool) -> Doubts:
    """What this frame does not know; a new prior only where that changed."""
    p, q = (
        _factor(error, std, old)
        for error, std, old in (
            (frame.p_error, design.doubt.p, before.p),
            (frame.q_error, design.doubt.q, before.q),
        )
    )
    if busbar == before.busbar and np.array_equal(p, before.p) and np.array_equal(q, before.q):
        return before
    doubt = replace(design.doubt, p=design.doubt.p * p, q=design.doubt.q * q)
    plain = busbar and bool((p == 1.0).all() and (q == 1.0).all())
    found = (
        design.prior
        if plain
        else prior(
            design.model,
            design.prior.meters,
            doubt,
            busbar=design.busbar if busbar else _UNMETERED,
            inverters=design.injections,
        )
    )
    return Doubts(p, q, busbar, found)


def _factor(error: Floats, std: Floats, old: Floats) -> Floats:
    """Power of two by which a frame knows a power less well than the design assumes, with hysteresis."""
    ratio = error / np.sqrt(3.0) / np.maximum(std, np.finfo(np.float64).tiny)
    keep = (ratio <= old * _MUCH_LESS) & (ratio * _MUCH_LESS >= old) & (old > 1.0)
    raised = np.exp2(np.ceil(np.log2(np.maximum(ratio, 1.0))))
    return np.where(keep, old, np.where(ratio > _MUCH_LESS, raised, 1.0))


def _inverters(design: SequentialDesign, state: SequentialState, frame: Frame, heard: _Heard) -> Floats:
    """The injections at this frame: at rest at the first one, a step later at every other."""
    droop, meter = design.plant.droop, design.meter_of
    believed = heard.live if design.own else state.trust.trusted & heard.live
    driven = (meter >= 0) & believed[meter]
    y = np.where(driven, heard.y[meter], heard.v0_squared) if meter.size else np.zeros(0)
    if state.x is None:
        return np.asarray(droop(droop.vbar**2 - y))
    w = None
    if not driven.all():
        correction = np.zeros(heard.q.size)
        if state.last is not None:
            # What losses took off at the last frame is close enough for inverters without a meter.
            correction = state.last[0].v2 - _linear(design, frame, state, heard)
        w = known_input(design.model, droop.vbar, frame.p, frame.q, heard.v0_squared, correction)
    return drive(design, state.x, y, driven, w, frame.t - state.t)


def _linear(design: SequentialDesign, frame: Frame, state: SequentialState, heard: _Heard) -> Floats:
    """Squared voltages by the linear model at the last injections, (N,)."""
    plant, model = design.plant, design.model
    x = np.zeros(plant.droop.tau.size) if state.x is None else state.x
    q = frame.q + np.bincount(plant.droop.customer, weights=x, minlength=frame.q.size)
    return np.asarray(heard.v0_squared + 2.0 * (model.R @ frame.p + model.X @ q))


def _model_error(design: SequentialDesign, p: Floats, q: Floats, v0_squared: float) -> Floats:
    """What the loss-corrected model may be off at each meter, (p,)."""
    plant = design.plant
    with np.errstate(all="ignore"):
        error = model_error_bound(plant.feeder, p, q, v0_squared)[plant.meters]
    return np.where(np.isfinite(error), error, design.options.widest)


def _name(design: SequentialDesign, before: Trust, seen: Examined) -> tuple[Trust, tuple[Explanation, ...]]:
    """Who is named now; and explanations that fit about as well where a meter would have been named."""
    trust = seen.trust
    quiet = np.where(trust.still.any(axis=0), 0, trust.quiet + 1)
    trusted = (trust.trusted & ~before.named) | (quiet >= design.options.release)
    age = np.where(trusted, 0, trust.age + 1)
    need = np.array([confirm(length) for length in design.lengths])[trust.scale]
    fresh = ~trusted & ~before.named & trust.bad.any(axis=0) & (age >= need)
    named = before.named & (quiet < design.options.release)
    rivals = _rivals(design, seen, fresh) if fresh.any() else ()
    for rival in rivals:
        fresh = fresh & rival.meters
    return replace(trust, trusted=trusted, age=age, quiet=quiet, named=named | fresh), rivals


def _rivals(design: SequentialDesign, seen: Examined, fresh: Bools) -> tuple[Explanation, ...]:
    """All explanations about as likely as the best, where one leaves out a meter about to be named."""
    within = 2.0 * float(np.log(design.options.like))
    out: list[tuple[Bools, Bools, float]] = []
    for found in seen.found.values():
        best = found[0]
        near = [(_meters(each), each, each.cost - best.cost) for each in found]
        for swap in swaps(best, np.isfinite(best.judged.offset), within):
            other = near[0][0].copy()
            other[swap.accused], other[swap.innocent] = False, True
            near.append((other, best, swap.worse))
        out += [
            (meters, _inverters_of(design, each.loosened), float(np.exp(-0.5 * worse)))
            for meters, each, worse in near
            if each is best or (worse <= within and (fresh & ~meters).any())
        ]
    if not any((fresh & ~meters).any() for meters, _, _ in out):
        return ()
    total = sum(weight for _, _, weight in out)
    return tuple(Explanation(meters, inverters, weight / total) for meters, inverters, weight in out)


def _meters(found: Found) -> Bools:
    return ~found.fit.trusted


def _conclude(  # noqa: PLR0917  # everything one tick brought
    design: SequentialDesign,
    state: SequentialState,
    heard: _Heard,
    seen: Examined,
    v2_bus: Floats,
    transient: Floats,
    rivals: tuple[Explanation, ...],
) -> tuple[Estimate, Verdict]:
    plant, trust = design.plant, state.trust
    at = plant.feeder.bus[plant.meters]
    w, variance = _reconstructed(design, state, seen)
    v2_bus = v2_bus + w
    v2_bus[0] = heard.v0_squared if heard.busbar else v2_bus[0]
    v2, std = v2_bus[plant.feeder.bus], np.sqrt(variance[plant.feeder.bus])
    far = float(np.max(state.model_error + transient, initial=0.0))
    estimate = Estimate(
        t=state.t,
        v2=v2,
        bound=design.sigmas[0] * std + far,
        v2_bus=v2_bus,
        trusted=trust.trusted & heard.live,
        x=np.zeros(0) if state.x is None else state.x,
        std=std,
    )
    score, threshold, judged = _worst(design, seen, heard.live.size)
    settled = bool(np.all(transient <= design.options.settled * threshold))
    attack = np.where(trust.named & heard.live, heard.y - state.learned.bias - v2_bus[at], 0.0)
    decision, cause, reason = decide(
        Situation(
            names=design.names,
            max_attacked=max(1, min(design.most, int(np.count_nonzero(judged)) // 3)),
            live=judged,
            suspected=~trust.trusted | (judged & (np.nan_to_num(score) > threshold)),
            named=trust.named,
            wide=judged & (threshold > design.options.widest),
            valid=True,
            settled=settled,
            busbar=True,
        )
    )
    verdict = Verdict(
        decision,
        cause,
        reason,
        trust.named,
        score,
        threshold,
        attack,
        inverters=_inverters_of(design, [] if design.own else [k for k, _ in trust.accused]),
        inverter_attack=np.zeros(plant.droop.tau.size),
        kinds=state.kinds.kinds,
        explanations=rivals,
    )
    return estimate, verdict


def _inverters_of(design: SequentialDesign, accused: list[int]) -> Bools:
    """Which inverters are among other suspicions, (m,)."""
    out = np.zeros(design.plant.droop.tau.size, dtype=np.bool_)
    customers = design.plant.feeder.bus.size
    out[[k - customers for k in accused if k >= customers]] = True
    return out


def _reconstructed(design: SequentialDesign, state: SequentialState, seen: Examined) -> tuple[Floats, Floats]:
    """What the trusted meters add to the model at every bus, and its variance, on the best scale."""
    prior_ = state.doubts.prior
    best, at, mean = prior_.variance, -1, np.inf
    for s, (now, length) in enumerate(zip(state.fits, design.lengths, strict=True)):
        if now is None:
            continue
        lag = min(1.0, length * design.step_s / design.doubt.time_s) * (length > 1)
        variance = now.variance + lag * prior_.variance
        if variance.sum() < mean:
            best, at, mean = variance, s, float(variance.sum())
    now, view = (None, None) if at < 0 else (state.fits[at], seen.views[at])
    if now is None:
        return np.zeros_like(best), best
    m = state.window.sums[at] / np.maximum(state.window.counts[at], 1)
    return (judge(now, m).w if view is None else view.judged.w), best


def _worst(design: SequentialDesign, seen: Examined, p: int) -> tuple[Floats, Floats, Bools]:
    """Offset and limit of each meter on the scale that speaks most against it; who was judged."""
    score, threshold = np.full(p, np.nan), np.full(p, design.options.widest)
    ratio = np.full(p, -1.0)
    judged = np.zeros(p, dtype=np.bool_)
    for view in seen.views:
        if view is None:
            continue
        judged |= view.enough
        offset = np.abs(view.judged.offset)
        now = np.where(view.enough, offset / view.limit, -1.0)
        more = now > ratio
        score, threshold = np.where(more, offset, score), np.where(more, view.limit, threshold)
        ratio = np.maximum(ratio, now)
    return np.where(judged, score, np.nan), threshold, judged


def _unusable(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[SequentialState, Estimate, Verdict]:
    """The answer to a frame that is not later than the last one: nothing new, and certainly not CLEAN."""
    plant = design.plant
    p, n, m = plant.meters.size, len(plant.feeder.buses), plant.droop.tau.size
    reason = f"A frame of time {frame.t} is not later than the last one, {state.t}; it was not used."
    if state.last is not None:
        estimate, verdict = state.last
        return (
            state,
            estimate,
            replace(verdict, decision=Decision.UNDECIDED, cause=Cause.SETTLING, reason=reason),
        )
    v2_bus = np.full(n, state.v0_squared)
    estimate = Estimate(
        t=state.t,
        v2=v2_bus[plant.feeder.bus],
        bound=np.full(plant.feeder.bus.size, _NO_VOLTAGE),
        v2_bus=v2_bus,
        trusted=np.zeros(p, dtype=np.bool_),
        x=np.zeros(m),
        std=np.full(plant.feeder.bus.size, _NO_VOLTAGE),
    )
    verdict = Verdict(
        Decision.UNDECIDED,
        Cause.SETTLING,
        reason,
        np.zeros(p, dtype=np.bool_),
        np.full(p, np.nan),
        np.full(p, _NO_VOLTAGE),
        np.zeros(p),
    )
    return state, estimate, verdict


# Errors of squared voltages end here: no voltage is above 2 pu.
_NO_VOLTAGE = 4.0
