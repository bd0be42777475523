"""One frame in, an estimate and a verdict out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.frames import NO_VOLTAGE, nothing_new
from gridsec.network import InPhases, bus_voltages, by_place, model_error_bound
from gridsec.online import Estimate, Explanation, Frame, Verdict
from gridsec.sequential.bounds import Lag, Powers, follow
from gridsec.sequential.bounds import start as begin
from gridsec.sequential.commission import conclude as learn
from gridsec.sequential.commission import gather, ripe
from gridsec.sequential.conclude import Tick, conclude
from gridsec.sequential.curves import CONFIRM, Evidence, compare
from gridsec.sequential.design import SequentialDesign
from gridsec.sequential.drive import Free, drive
from gridsec.sequential.examine import Examined, ended, examine
from gridsec.sequential.kinds import Kinds, describe, listen, suspicious
from gridsec.sequential.loads import prior
from gridsec.sequential.naming import name
from gridsec.sequential.state import Doubts, SequentialState, Trust
from gridsec.sequential.windows import Window, forget, forget_last, push, shift


@dataclass(frozen=True, slots=True, eq=False)
class _Heard:
    """One frame, cleaned. N customers, p meters, m inverters."""

    live: Bools  # (p,)
    y: Floats  # (p,) 0 where not live
    q: Floats  # (N,) of the loads, or metered net where told
    told: Bools  # (N,)
    reported: Bools  # (N,) who tells the net reactive power
    v0_squared: Floats | float  # in three phases (3,), and so whether it is metered
    busbar: Bools | bool


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
        return state, *_unused(design, state, frame)
    at = design.plant.feeder.bus[design.plant.meters]
    frame = _powers(design, frame)
    heard = _clean(design, state, frame)
    doubts = _doubted(design, state.doubts, frame, heard)
    if doubts is not state.doubts and doubts.prior is not state.doubts.prior:
        state = replace(state, fits=(None,) * len(state.fits))
    kinds = listen(design.shapes, state.kinds, heard.y, heard.live)
    copies = suspicious(kinds) & (design.decoder is None)
    x, free, lag = _inverters(design, state, frame, heard, doubts.sizes)
    q, v2_bus = _voltages(design, frame, heard, x)
    residual = heard.y - v2_bus[at] - state.learned.bias
    window = push(_remembered(design, state, heard.busbar), design.lengths, residual, heard.live)
    swing = _swing(design, v2_bus, heard.v0_squared)
    if state.ticks % _STALE == 0 or swing > max(_GROWN * state.swing, _CALM):
        error = _model_error(design, frame.p, q, heard.v0_squared)
        state = replace(state, model_error=error, swing=swing)
    since = frame.t if state.x is None else state.since
    transient = _transient(design, frame.t - since)
    now = replace(state, trust=_distrust(state.trust, copies), window=window, doubts=doubts)
    seen, window, rivals = _judge(design, now, state.trust, copies, heard.live, transient)
    reports = _reports(design, heard, frame, seen, x, lag)
    after = replace(
        state,
        t=frame.t,
        since=since,
        ticks=state.ticks + 1,
        x=x,
        free=free,
        lag=lag.lied_to(_lied_to(design, state.trust, seen.trust)),
        v0_squared=heard.v0_squared,
        unmetered=np.where(heard.busbar, 0, state.unmetered + 1),
        window=window,
        trust=seen.trust,
        fits=seen.fits,
        doubts=doubts,
        curves=compare(design, state.curves, reports),
        kinds=_kinds(design, state, kinds, seen, window, v2_bus[at], _own(design, frame.p, heard.q)),
    )
    after = _learn(design, after, residual, heard.live, frame.t - state.t)
    given = heard.told, heard.y, heard.live, heard.v0_squared, heard.busbar
    tick = Tick(frame, q, *given, v2_bus, transient, seen, rivals)
    return conclude(design, after, tick)


def _lied_to(design: SequentialDesign, before: Trust, now: Trust) -> Bools:
    """Inverters whose meters were believed until now, (m,)."""
    caught = before.trusted & ~now.trusted
    if not caught.any():
        return np.zeros(design.meter_of.size, dtype=np.bool_)
    return (design.meter_of >= 0) & caught[design.meter_of]


def _unused(design: SequentialDesign, state: SequentialState, frame: Frame) -> tuple[Estimate, Verdict]:
    """What is answered to a frame that is not later than the last one."""
    none = np.zeros(design.plant.droop.tau.size)
    estimate, verdict = nothing_new(design.plant, frame, state.t, state.last, state.v0_squared, none)
    if state.last is None:
        estimate = replace(estimate, std=estimate.bound)
    return estimate, verdict


def _judge(  # noqa: PLR0917  # what there is to judge by
    design: SequentialDesign,
    now: SequentialState,
    before: Trust,
    copies: Bools,
    live: Bools,
    transient: Floats,
) -> tuple[Examined, Window, tuple[Explanation, ...]]:
    """Who is believed and named now, what is remembered then, and rivals of what was found."""
    seen = examine(design, now, now.model_error + transient)
    over = ended(design, now.trust, seen, now.window)
    trust, rivals = name(design, now.trust, _acquit(seen, over), live)
    trust = _distrust(trust, copies)
    rivals = rivals or _undecided(design, now.last, before, trust)
    seen = seen if trust is seen.trust else replace(seen, trust=trust)
    return seen, forget(now.window, over), rivals


def _remembered(design: SequentialDesign, state: SequentialState, busbar: Bools | bool) -> Window:
    """The residuals so far; where the busbar voltage is back, not those of the time without it.

    They are as far off as it had moved meanwhile, and all meters alike.
    """
    if not np.any(state.unmetered):
        return state.window
    since = np.where(busbar, state.unmetered, 0)
    if not since.any():
        return state.window
    feeder, at = design.plant.feeder, design.prior.meters
    return forget_last(state.window, design.lengths, by_place(feeder, since)[at].astype(np.intp))


def _transient(design: SequentialDesign, age: float) -> Floats:
    """What is left of the unknown initial state at each meter, (p,)."""
    # Without inverters the rate is infinite, and times no time at all it would be no number.
    return np.asarray(design.reach * (np.exp(-design.certificate.rate * age) if age > 0 else 1.0))


def _undecided(
    design: SequentialDesign, last: tuple[Estimate, Verdict] | None, before: Trust, trust: Trust
) -> tuple[Explanation, ...]:
    """The last explanations, as long as the same are suspected: they are not looked for at every tick."""
    if last is None or design.decoder is not None or trust.trusted.all():
        return ()
    names = ("trusted", "named", "inverters")
    same = all(np.array_equal(getattr(trust, name), getattr(before, name)) for name in names)
    return last[1].explanations if same else ()


def _acquit(seen: Examined, over: Bools) -> Examined:
    """Evidence against meters whose manipulation is over counts no more."""
    trust = seen.trust
    if not over.any():
        return seen
    return replace(seen, trust=replace(trust, bad=trust.bad & ~over, still=trust.still & ~over))


def _voltages(design: SequentialDesign, frame: Frame, heard: _Heard, x: Floats) -> tuple[Floats, Floats]:
    """Reactive injections, (N,), and what the model makes of all of them, (n,)."""
    plant = design.plant
    q = _net(design, heard, x)
    with np.errstate(all="ignore"):
        v2_bus = bus_voltages(plant.feeder, frame.p, q, heard.v0_squared, steps=plant.loss_correction)
        v2_bus = np.clip(v2_bus, 0.0, NO_VOLTAGE)
    return q, np.where(np.isnan(v2_bus), by_place(plant.feeder, heard.v0_squared), v2_bus)


def _net(design: SequentialDesign, heard: _Heard, x: Floats) -> Floats:
    """Net reactive injections with observed ones of the inverters where they are not metered, (N,)."""
    return heard.q + np.where(heard.told, 0.0, design.plant.droop.per_customer(x, heard.q.size))


def _swing(design: SequentialDesign, v2_bus: Floats, v0_squared: Floats | float) -> float:
    """By how much the powers change a squared voltage at most."""
    return float(np.abs(v2_bus - by_place(design.plant.feeder, v0_squared)).max())


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


def _reports(  # noqa: PLR0917  # everything known of the injections
    design: SequentialDesign, heard: _Heard, frame: Frame, seen: Examined, x: Floats, lag: Lag
) -> Evidence:
    """What the metered reactive powers are compared with the curves by."""
    believed = heard.live & seen.trust.trusted & (seen.trust.age == 0)
    s = sum(length <= CONFIRM for length in design.lengths) - 1
    view = seen.views[s]
    judged = None if view is None else view.judged
    return Evidence(frame, heard.reported, heard.told, believed, x, lag, seen.fits[s], judged)


def _kinds(  # noqa: PLR0917  # everything that lies are compared with
    design: SequentialDesign,
    state: SequentialState,
    kinds: Kinds,
    seen: Examined,
    window: Window,
    v2: Floats,
    own: Floats,
) -> Kinds:
    """What the manipulations look like, by what the other meters say of each."""
    view, prior_ = seen.views[0], state.doubts.prior
    expected = v2 + state.learned.bias
    if view is None:
        variance = prior_.variance[prior_.meters] + design.white + state.learned.variance
    else:
        mean = window.sums[0] / np.maximum(window.counts[0], 1)
        expected, variance = expected + mean - view.judged.offset, view.judged.std**2
    return describe(design.shapes, kinds, expected, own, seen.trust.named, variance)


def _own(design: SequentialDesign, p: Floats, q: Floats) -> Floats:
    """What each meter's own reported powers contribute to what the model says of it, (p,)."""
    shapes, meters = design.shapes, design.plant.meters
    return np.asarray(shapes.active * p[meters] + shapes.reactive * q[meters])


def _learn(
    design: SequentialDesign, state: SequentialState, residual: Floats, live: Bools, h: float
) -> SequentialState:
    """Gather what the meters' fixed errors are, and from some time on rely on it."""
    trust = state.trust
    # While more than meters is suspected, what the others read is not their own error.
    if state.learning is None or state.ticks == 1 or trust.accused:
        return state
    # A pause of the frames is no time in which anything was heard.
    step_s, use = design.step_s, live & trust.trusted & _known(design, state.doubts)
    learning = gather(state.learning, residual, use, h if h <= _PAUSE * step_s else step_s)
    # Whoever is named has no say; suspects that report may yet turn out to be right.
    settled = trust.trusted | trust.named | (state.window.counts[-1] == 0)
    ready = ripe(design, learning) & trust.trusted
    if not ready.any() or not settled.all():
        return replace(state, learning=learning)
    known = learn(design, state.learned, learning, ready, state.t)
    window = shift(state.window, state.learned.bias - known.learned.bias)
    fits = (None,) * len(state.fits)
    return replace(state, learning=known.learning, learned=known.learned, window=window, fits=fits)


def _known(design: SequentialDesign, doubts: Doubts) -> Bools:
    """Where what is not known is about as large as learning supposes, (p,)."""
    variance, at = doubts.prior.variance, doubts.prior.meters
    return np.asarray(variance[at] <= _WIDER**2 * design.prior.variance[at])


# Voltages known this many times less well than the design supposes say nothing of a meter's own error.
_WIDER = 2.0
# Ticks without a frame after which there was a pause.
_PAUSE = 60.0
# The model's error is bounded anew every so many ticks, and where powers change a voltage by so many times
# what they did then, and by so much, squared pu: it grows with the cube of that.
_STALE, _GROWN, _CALM = 16, 1.1, 0.01


def _powers(design: SequentialDesign, frame: Frame) -> Frame:
    """The frame with powers that can be: all others are not known."""
    p, p_error = _possible(frame.p, frame.p_error, design.most_p)
    q, q_error = _possible(frame.q, frame.q_error, design.most_q)
    if p is frame.p and q is frame.q and p_error is frame.p_error and q_error is frame.q_error:
        return frame
    return replace(frame, p=p, p_error=p_error, q=q, q_error=q_error)


def _possible(power: Floats, error: Floats, most: Floats) -> tuple[Floats, Floats]:
    good = np.abs(power) <= most
    known = good & (np.abs(error) <= most)
    if known.all():
        return power, error
    return np.where(good, power, 0.0), np.where(known, error, most)


def _clean(design: SequentialDesign, state: SequentialState, frame: Frame) -> _Heard:
    plant = design.plant
    live = frame.seen & np.isfinite(frame.y)
    v0_squared, busbar = _busbar(design, state, frame)
    told = np.zeros(frame.q.size, dtype=np.bool_)
    # As `_possible` has it: who is sure of nothing tells nothing.
    reported = (np.abs(frame.q_net) <= design.most_q) & (np.abs(frame.q_net_error) <= design.most_q)
    if reported.any():
        trusted = np.zeros(frame.q.size, dtype=np.bool_)
        trusted[plant.meters] = live & state.trust.trusted
        least, most = plant.droop.saturated(frame.q.size)
        rest, room = (
            np.where(reported, frame.q_net, 0.0) - frame.q,
            frame.q_error + np.where(reported, frame.q_net_error, 0.0),
        )
        told = trusted & reported & (least - room <= rest) & (rest <= most + room)
    return _Heard(
        live=live,
        y=np.clip(np.where(live, frame.y, 0.0), 0.0, NO_VOLTAGE),
        q=np.where(told, frame.q_net, frame.q),
        told=told,
        reported=reported,
        v0_squared=v0_squared,
        busbar=busbar,
    )


def _busbar(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[Floats | float, Bools | bool]:
    """Squared voltage of the busbar, the last one where there is none now, and whether it is metered."""
    low, high = design.options.v2_limits
    if not isinstance(design.plant.feeder, InPhases):
        metered = bool(np.isfinite(frame.v0_squared) and low <= frame.v0_squared <= high)
        return frame.v0_squared if metered else state.v0_squared, metered
    # One voltage for all phases says where they are, but not how far from it each.
    given = np.broadcast_to(frame.v0_squared if frame.v0_phases is None else frame.v0_phases, 3)
    there = (low <= given) & (given <= high)  # False for NaN
    return np.where(there, given, state.v0_squared), there & (frame.v0_phases is not None)


# Frames that claim to know loads so much less well than the design assumes are believed.
_MUCH_LESS = 4.0
# Squared busbar voltage that is not metered: its standard deviation, squared pu.
_UNMETERED = 0.1


def _doubted(design: SequentialDesign, before: Doubts, frame: Frame, heard: _Heard) -> Doubts:
    """What is not known at this frame, and of the residuals that are remembered.

    Where no meter is heard there is no residual that was made with what this frame does not know: once one is
    heard again, doubts go on as they were before.
    """
    last = before if before.heard is None else before.heard
    if heard.live.any():
        return _doubts(design, last, frame, heard.busbar)
    found = _doubts(design, before, frame, heard.busbar)
    return found if found.heard is last else replace(found, heard=last)


def _doubts(design: SequentialDesign, before: Doubts, frame: Frame, busbar: Bools | bool) -> Doubts:
    """What this frame does not know; a new prior only where that changed."""
    longest = design.lengths[-1]
    p, p_calm = _factors(frame.p_error, design.doubt.p, before.p, before.p_calm, longest)
    q, q_calm = _factors(frame.q_error, design.doubt.q, before.q, before.q_calm, longest)
    sizes = _claims(np.abs(frame.p), design.options.hidden_power, before.sizes)
    same = (new is old or np.array_equal(new, old) for new, old in ((p, before.p), (q, before.q)))
    if np.array_equal(busbar, before.busbar) and all(same):
        if sizes is before.sizes and p_calm is before.p_calm and q_calm is before.q_calm:
            return before
        return replace(before, sizes=sizes, p_calm=p_calm, q_calm=q_calm)
    doubt = replace(
        design.doubt,
        p=np.where(p > 1.0, np.maximum(design.doubt.p, _EXACT) * p, design.doubt.p),
        q=np.where(q > 1.0, np.maximum(design.doubt.q, _EXACT) * q, design.doubt.q),
    )
    plain = bool(np.all(busbar) and (p == 1.0).all() and (q == 1.0).all())
    found = (
        design.prior
        if plain
        else prior(
            design.plant.feeder,
            design.prior.meters,
            doubt,
            busbar=design.busbar if np.all(busbar) else np.where(busbar, design.busbar, _UNMETERED),
            inverters=design.injections,
        )
    )
    return Doubts(p, q, p_calm, q_calm, busbar, found, sizes)


def _claims(power: Floats, least: float, before: Floats) -> Floats:
    """False powers as large as what is claimed, in powers of two, and kept while they are close to that."""
    old = before[: power.size]
    fine = (power <= old) & ((old <= least) | (4.0 * power >= old))
    if fine.all():
        return before
    new = np.where(fine, old, np.exp2(np.ceil(np.log2(np.maximum(power, least)))))
    return np.concatenate([new, before[power.size :]])


# Powers are known no better than this, pu.
_EXACT = 1e-6


def _factors(error: Floats, std: Floats, old: Floats, calm: Ints, longest: int) -> tuple[Floats, Ints]:
    """`_factor`, but as long as residuals are remembered that were made with a larger one, that one."""
    new = _factor(error, std, old)
    if new is old:
        return old, calm
    held = (new < old) & (calm + 1 < longest)
    return np.where(held, old, new), np.where(held, calm + 1, 0)


def _factor(error: Floats, std: Floats, old: Floats) -> Floats:
    """Power of two by which a frame knows a power less well than the design assumes, with hysteresis."""
    ratio = error / np.sqrt(3.0) / np.maximum(std, _EXACT)
    if ratio.max(initial=0.0) <= _MUCH_LESS and old.max(initial=1.0) <= 1.0:
        return old
    keep = (ratio <= old * _MUCH_LESS) & (ratio * _MUCH_LESS >= old) & (old > 1.0)
    raised = np.exp2(np.ceil(np.log2(np.maximum(ratio, 1.0))))
    return np.where(keep, old, np.where(ratio > _MUCH_LESS, raised, 1.0))


def _inverters(
    design: SequentialDesign, state: SequentialState, frame: Frame, heard: _Heard, sizes: Floats
) -> tuple[Floats, Free | None, Lag]:
    """The injections at this frame, at rest at the first one and a step later at any other; their errors."""
    droop, meter = design.plant.droop, design.meter_of
    believed = state.trust.trusted & heard.live
    driven = (meter >= 0) & believed[meter]
    here = by_place(design.plant.feeder, heard.v0_squared)[design.plant.feeder.bus[droop.customer]]
    y = np.where(driven, heard.y[meter], here) if meter.size else np.zeros(0)
    if state.x is None:
        return np.asarray(droop(droop.vbar**2 - y)), None, begin(design.plant, y)
    w, follows, h = None, None, frame.t - state.t
    if not driven.all():
        now = _linear(design, frame, state.x, heard)
        v2 = _linear(design, frame, np.zeros(droop.tau.size), heard)
        if state.last is not None:
            # What losses took off at the last frame is close enough for inverters without a meter.
            v2 += state.last[0].v2 - now
        w, y = droop.vbar**2 - v2, np.where(driven, y, now[droop.customer])
        follows = ~driven, _given(design, state, frame, heard, sizes), heard.busbar
    lag = follow(design, state.lag, y, follows, h)
    return *drive(design, state.x, y, driven, w, h, state.free), lag


def _given(
    design: SequentialDesign, state: SequentialState, frame: Frame, heard: _Heard, sizes: Floats
) -> Powers:
    """The powers that inverters follow which follow the model."""
    x = np.zeros(0) if state.x is None else state.x
    return Powers(frame, _net(design, heard, x), heard.told, heard.v0_squared, state.trust.trusted, sizes)


def _linear(design: SequentialDesign, frame: Frame, x: Floats, heard: _Heard) -> Floats:
    """Squared voltages by the linear model with injections x, (N,)."""
    feeder = design.plant.feeder
    q = frame.q + design.plant.droop.per_customer(x, frame.q.size)
    return np.asarray(bus_voltages(feeder, frame.p, q, heard.v0_squared, steps=0)[feeder.bus])


def _model_error(design: SequentialDesign, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """What the loss-corrected model may be off at each meter, (p,)."""
    plant = design.plant
    with np.errstate(all="ignore"):
        error = model_error_bound(plant.feeder, p, q, v0_squared)[plant.meters]
    return np.where(np.isfinite(error), error, design.options.widest)
