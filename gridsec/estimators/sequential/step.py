"""Step of the monitor: measurements, prediction, detection, identification, confirmation, output."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed
from gridsec.estimators.inputs import NO_VOLTAGE, nothing_new
from gridsec.estimators.sequential import learning
from gridsec.estimators.sequential.bounds import Lag, Powers, follow
from gridsec.estimators.sequential.bounds import start as begin
from gridsec.estimators.sequential.busbar import Honest
from gridsec.estimators.sequential.commission import Learning, gather, ripe
from gridsec.estimators.sequential.commission import conclude as learn
from gridsec.estimators.sequential.conclude import Tick, conclude
from gridsec.estimators.sequential.curves import CONFIRM, Curves, Evidence, compare
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.doubts import Doubts, doubted
from gridsec.estimators.sequential.drive import Free, ahead, drive
from gridsec.estimators.sequential.examine import Examined, ended, examine
from gridsec.estimators.sequential.heard import Heard, clean, possible
from gridsec.estimators.sequential.kinds import Kinds, describe, listen, repeated
from gridsec.estimators.sequential.moment import present
from gridsec.estimators.sequential.naming import name, supported
from gridsec.estimators.sequential.scales import Scales, needed
from gridsec.estimators.sequential.skew import follow as follow_clocks
from gridsec.estimators.sequential.state import SequentialState, Trust
from gridsec.estimators.sequential.windows import Window, empty, forget, push, shift
from gridsec.interface import Estimate, Explanation, Frame, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    state: SequentialState
    heard: Heard
    doubts: Doubts
    kinds: Kinds
    copies: Ints
    x: Floats
    free: Free | None
    lag: Lag
    q: Floats
    v2_bus: Floats
    residual: Floats
    transient: Floats
    now: SequentialState
    seen: Examined


def step(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[SequentialState, Estimate, Verdict]:
    """Process one frame.

    A frame that is not later than the last one changes nothing: it repeats the last estimate, with UNDECIDED.
    """
    if not np.isfinite(frame.t) or (state.x is not None and not frame.t > state.t):
        return state, *_unused(design, state, frame)
    state, frame = _present(design, state, possible(design, frame))
    look = _look(design, state, frame)
    while look.seen.busbar is not None:
        # The busbar counts as not metered from this tick on.
        state = changed(state, busbar=state.busbar.caught(*look.seen.busbar))
        look = _look(design, state, frame)
    return _answer(design, look, frame)


def _look(design: SequentialDesign, state: SequentialState, frame: Frame) -> _Look:
    """Predict by the model, then identify the meters that contradict it."""
    heard = clean(design, state, frame)
    doubts = doubted(design, state.doubts, frame, heard.live, heard.busbar)
    if doubts.priors is not state.doubts.priors:
        pairs = zip(state.fits, doubts.priors, strict=True)
        fits = tuple(fit if fit is not None and fit.prior is prior else None for fit, prior in pairs)
        state = changed(state, fits=fits)
    kinds = listen(design.shapes, state.kinds, heard.y, heard.live)
    copies = repeated(kinds) * (design.decoder is None)
    x, free, lag = _inverters(design, state, frame, heard, doubts.sizes)
    q, v2_bus = _voltages(design, frame, heard, x)
    if _paused(design, state, frame):
        # Loads before a pause as long as the longest scale say nothing about those after it.
        window = empty(design.lengths, heard.y.size)
        state = changed(state, window=window, fits=(None,) * len(state.fits), skew=None)
    state = _clocks(design, state, frame, v2_bus[design.prior.meters])
    residual = heard.y - v2_bus[design.prior.meters] - state.learned.bias
    window = push(state.window, design.lengths, residual, heard.live)
    swing = _swing(design, v2_bus, heard.v0_squared)
    if state.ticks % _STALE == 0 or swing > max(_GROWN * state.swing, _CALM):
        error = _model_error(design, frame.p, q, heard.v0_squared)
        state = changed(state, model_error=error, swing=swing)
    transient = _transient(design, 0.0 if state.x is None else frame.t - state.since)
    now = changed(state, trust=_distrust(state.trust, copies), window=window, doubts=doubts)
    powers = Powers(frame, q, heard.told, heard.v0_squared, state.trust.trusted, doubts.sizes)
    seen = examine(design, now, state.model_error + transient, Honest(powers, lag.error))
    return _Look(state, heard, doubts, kinds, copies, x, free, lag, q, v2_bus, residual, transient, now, seen)


def _paused(design: SequentialDesign, state: SequentialState, frame: Frame) -> bool:
    """True if the pause since the last frame is at least as long as the longest scale."""
    return state.x is not None and frame.t - state.t >= design.lengths[-1] * design.step_s


def _present(design: SequentialDesign, state: SequentialState, frame: Frame) -> tuple[SequentialState, Frame]:
    """Frame without a busbar reading of another moment, and the state with the readings of this one."""
    before = None if _paused(design, state, frame) else state.moment
    moment, frame = present(design, before, frame, state.trust.trusted, state.v0_squared)
    return state if moment is before is state.moment else changed(state, moment=moment), frame


def _clocks(design: SequentialDesign, state: SequentialState, frame: Frame, v2: Floats) -> SequentialState:
    """State with the voltage changes within clock offsets, and without posteriors of other variances."""
    before = state.skew
    if before is None and frame.clock_offset is None:
        return state
    need = np.array([needed(design, s) for s in range(len(design.lengths))])
    noise = design.white / need[:, None] + state.learned.variance
    skew = follow_clocks(design, before, state.ticks, frame.clock_offset, v2, noise)
    none = np.zeros(noise.shape)
    old, new = (none if each is None else each.variance for each in (before, skew))
    # Variances change only at ticks at which their scale is due: no further look follows from that.
    same = (old == new).all(axis=1).tolist()
    fits = tuple(fit if one else None for fit, one in zip(state.fits, same, strict=True))
    return changed(state, skew=skew, fits=fits)


def _answer(design: SequentialDesign, look: _Look, frame: Frame) -> tuple[SequentialState, Estimate, Verdict]:
    """Confirm suspects, update the state, and put the output together."""
    state, heard = look.state, look.heard
    seen, window, rivals = _judge(design, look, state.trust)
    v2 = look.v2_bus[design.prior.meters]
    own = _own(design, frame.p, heard.q)
    after = changed(
        state,
        t=frame.t,
        frame=frame,
        since=frame.t if state.x is None else state.since,
        ticks=state.ticks + 1,
        x=look.x,
        free=_free(design, look, seen.trust, frame.t),
        lag=look.lag if seen.trust.calm else look.lag.lied_to(_lied_to(design, state.trust, seen.trust)),
        v0_squared=heard.v0_squared,
        window=window,
        trust=seen.trust,
        fits=seen.fits,
        wholes=seen.wholes,
        misfit=seen.misfit,
        doubts=look.doubts,
        curves=_curves(design, look, frame, seen),
        kinds=_kinds(design, look, seen, window, v2, own),
        learning=_gathered(design, look, frame, seen.trust),
    )
    tick = Tick(frame, heard, look.q, look.v2_bus, look.transient, seen, rivals)
    after, estimate, verdict = conclude(design, after, tick)
    if after.learning is not state.learning:
        # From the next frame on: this one was tested with the errors known before.
        after = _learned(design, after)
    return after, estimate, verdict


def _free(design: SequentialDesign, look: _Look, trust: Trust, t: float) -> Free | None:
    """Prepared loop of the model-driven inverters, renewed where meters have just been suspected."""
    state = look.state
    if state.x is None or not any_of(state.trust.trusted & ~trust.trusted):
        return look.free
    return ahead(design, trust.trusted & look.heard.live, t - state.t, look.free)


def _lied_to(design: SequentialDesign, before: Trust, now: Trust) -> Bools:
    """Inverters with a meter that was trusted until this tick, (m,)."""
    caught = before.trusted & ~now.trusted
    if not any_of(caught):
        return np.zeros(design.meter_of.size, dtype=np.bool_)
    return (design.meter_of >= 0) & caught[design.meter_of]


def _unused(design: SequentialDesign, state: SequentialState, frame: Frame) -> tuple[Estimate, Verdict]:
    """Output for a frame that is not later than the last one."""
    none = np.zeros(design.plant.droop.tau.size)
    estimate, verdict = nothing_new(design.plant, frame, state.t, state.last, state.v0_squared, none)
    if state.last is None:
        estimate = replace(estimate, std=estimate.bound)
    return estimate, verdict


def _judge(
    design: SequentialDesign, look: _Look, before: Trust
) -> tuple[Examined, Window, tuple[Explanation, ...]]:
    """Confirmed suspects, the window after it, and rival hypotheses."""
    seen, now = look.seen, look.now
    if seen.trust.calm and now.trust.calm:
        return seen, now.window, ()
    over = ended(design, now.doubts.priors, now.trust, seen, now.window)
    trust, rivals = name(design, now.trust, _acquit(seen, over), look.heard.live, now.curves)
    model = look.state.model_error + look.transient
    scales = Scales(design, now.doubts, now.window, now.learned, model, now.skew)
    trust = supported(scales, now.trust, seen, trust)
    trust = _distrust(trust, look.copies)
    rivals = rivals or _undecided(design, now.last, before, trust)
    seen = seen if trust is seen.trust else replace(seen, trust=trust)
    return seen, forget(now.window, over), rivals


def _transient(design: SequentialDesign, age: float) -> Floats:
    """Remainder of the unknown initial state at each meter, (p,)."""
    # Without inverters the rate is infinite; infinity times zero is NaN.
    return np.asarray(design.reach * (np.exp(-design.certificate.rate * age) if age > 0 else 1.0))


def _undecided(
    design: SequentialDesign, last: tuple[Estimate, Verdict] | None, before: Trust, trust: Trust
) -> tuple[Explanation, ...]:
    """Last explanations while the suspects stay the same: they are not searched at every tick."""
    anybody = not all_of(trust.trusted) or any_of(trust.counted)
    if last is None or design.decoder is not None or not anybody:
        return ()
    names = ("trusted", "named", "inverters")
    same = all(np.array_equal(getattr(trust, name), getattr(before, name)) for name in names)
    return last[1].explanations if same else ()


def _acquit(seen: Examined, over: Bools) -> Examined:
    """Identification without evidence against meters with an ended manipulation."""
    trust = seen.trust
    if not any_of(over):
        return seen
    return replace(seen, trust=replace(trust, bad=trust.bad & ~over, still=trust.still & ~over))


def _voltages(design: SequentialDesign, frame: Frame, heard: Heard, x: Floats) -> tuple[Floats, Floats]:
    """Net reactive injections, (N,), and the voltages of the model, (n,)."""
    plant = design.plant
    q = _net(design, heard, x)
    with np.errstate(all="ignore"):
        v2_bus = plant.feeder.bus_voltages(frame.p, q, heard.v0_squared, steps=plant.loss_correction)
        v2_bus = np.minimum(np.maximum(v2_bus, 0.0), NO_VOLTAGE)
    none = np.isnan(v2_bus)
    return q, np.where(none, plant.feeder.broadcast_busbar(heard.v0_squared), v2_bus) if any_of(
        none
    ) else v2_bus


def _net(design: SequentialDesign, heard: Heard, x: Floats) -> Floats:
    """Net reactive injections, observed for inverters without metered reactive power, (N,)."""
    observed = design.plant.droop.per_customer(x, heard.q.size)
    return heard.q + (np.where(heard.told, 0.0, observed) if any_of(heard.told) else observed)


def _swing(design: SequentialDesign, v2_bus: Floats, v0_squared: Floats | float) -> float:
    """Largest change of a squared voltage by the powers."""
    return float(np.abs(v2_bus - design.plant.feeder.broadcast_busbar(v0_squared)).max())


def _distrust(trust: Trust, copies: Ints) -> Trust:
    """Trust state in which meters that repeat themselves are named."""
    if not any_of(copies):
        return trust
    which = copies > 0
    return replace(
        trust,
        trusted=trust.trusted & ~which,
        quiet=np.where(which, 0, trust.quiet),
        still=trust.still | which,
        lag=np.where(which, copies, trust.lag),
        named=trust.named | which,
    )


def _curves(design: SequentialDesign, look: _Look, frame: Frame, seen: Examined) -> Curves:
    """Comparison of metered reactive powers with the droop curves."""
    before, heard = look.state.curves, look.heard
    if before.idle and not any_of(heard.reported):
        return before
    believed = heard.live & seen.trust.trusted & (seen.trust.age == 0)
    s = max(sum(length <= CONFIRM for length in design.lengths) - 1, 0)
    view = seen.views[s]
    judged = None if view is None else view.judged
    now = Evidence(frame, heard.reported, heard.told, believed, look.x, look.lag, seen.fits[s], judged)
    return compare(design, before, now)


def _kinds(  # noqa: PLR0917
    design: SequentialDesign,
    look: _Look,
    seen: Examined,
    window: Window,
    v2: Floats,
    own: Floats,
) -> Kinds:
    """Kinds of the manipulations, from the leave-one-out residuals of the shortest scale."""
    state, view = look.state, seen.views[0]
    expected = v2 + state.learned.bias
    if view is None:
        prior_ = state.doubts.priors[0]
        variance = prior_.variance[prior_.meters] + design.white + state.learned.variance
    else:
        std = view.judged.std
        mean = (
            view.judged.m if window is look.now.window else window.sums[0] / np.maximum(window.counts[0], 1)
        )
        expected, variance = expected + mean - view.judged.offset, std * std
    return describe(design.shapes, look.kinds, expected, own, seen.trust.named, variance)


def _own(design: SequentialDesign, p: Floats, q: Floats) -> Floats:
    """Contribution of each meter's own reported powers to its modelled voltage, (p,)."""
    shapes, meters = design.shapes, design.plant.meters
    return np.asarray(shapes.active * p[meters] + shapes.reactive * q[meters])


def _gathered(design: SequentialDesign, look: _Look, frame: Frame, trust: Trust) -> Learning | None:
    """Sums and times of the commissioning after this frame."""
    state = look.state
    if state.learning is None or not state.ticks:
        return state.learning
    this = learning.Tick(frame, look.heard.live, trust.trusted, bool(trust.accused), look.doubts)
    use, why = learning.counts(design, state.learning, this)
    h = frame.t - state.t
    # A pause of the frames is not time with readings.
    return gather(
        state.learning, look.residual, use, h if h <= _PAUSE * design.step_s else design.step_s, why
    )


def _learned(design: SequentialDesign, state: SequentialState) -> SequentialState:
    """State that uses the learned fixed errors once they are known."""
    trust, gathered = state.trust, state.learning
    if gathered is None or trust.accused:
        return state
    ready = ripe(design, gathered) & trust.trusted
    # Meters that are suspect and not yet named may turn out to be honest.
    if not any_of(ready) or not all_of(trust.trusted | trust.named | (state.window.counts[-1] == 0)):
        return state
    known = learn(design, state.learned, gathered, ready, state.t)
    window = shift(state.window, state.learned.bias - known.learned.bias)
    fits = (None,) * len(state.fits)
    return changed(state, learning=known.learning, learned=known.learned, window=window, fits=fits)


_PAUSE = 60.0
"""Ticks without a frame that count as a pause."""
_STALE, _GROWN, _CALM = 16, 1.1, 0.01
"""Renewal of the model error: ticks, ratio of the largest voltage change, and least change, squared pu."""


def _inverters(
    design: SequentialDesign, state: SequentialState, frame: Frame, heard: Heard, sizes: Floats
) -> tuple[Floats, Free | None, Lag]:
    """Injections at this frame, their errors, and the prepared loop; at rest at the first frame."""
    droop, meter = design.plant.droop, design.meter_of
    believed = state.trust.trusted & heard.live
    driven = (meter >= 0) & believed[meter]
    y = heard.y[meter] if meter.size else np.zeros(0)
    if not all_of(driven):
        here = design.plant.feeder.broadcast_busbar(heard.v0_squared)[design.plant.feeder.bus[droop.customer]]
        y = np.where(driven, y, here)
    if state.x is None:
        return np.asarray(droop(droop.vbar**2 - y)), None, begin(design.plant, y)
    w, follows, h = None, None, frame.t - state.t
    if not all_of(driven):
        injected = droop.per_customer(state.x, frame.q.size)
        now, v2 = _linear(design, frame.p, np.stack([frame.q + injected, frame.q]), heard.v0_squared)
        if state.last is not None and state.frame is not None:
            before = state.frame
            # Losses and the correction by the meters hardly change between two frames.
            v2 += state.last[0].v2 - _linear(design, before.p, before.q + injected, state.v0_squared)
        w, y = droop.vbar**2 - v2, np.where(driven, y, now[droop.customer])
        follows = ~driven, _given(design, state, frame, heard, sizes), heard.busbar
    lag = follow(design, state.lag, y, follows, h)
    return *drive(design, state.x, y, driven, w, h, state.free), lag


def _given(
    design: SequentialDesign, state: SequentialState, frame: Frame, heard: Heard, sizes: Floats
) -> Powers:
    """Power errors for the model-driven inverters."""
    x = np.zeros(0) if state.x is None else state.x
    return Powers(frame, _net(design, heard, x), heard.told, heard.v0_squared, state.trust.trusted, sizes)


def _linear(design: SequentialDesign, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Squared voltages of the customers by the linear model, (…, N) as q."""
    feeder = design.plant.feeder
    return np.asarray(feeder.bus_voltages(p, q, v0_squared, steps=0)[..., feeder.bus])


def _model_error(design: SequentialDesign, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Largest error of the loss-corrected model at each meter, (p,)."""
    plant = design.plant
    with np.errstate(all="ignore"):
        error = plant.feeder.model_error_bound(p, q, v0_squared)[plant.meters]
    return np.where(np.isfinite(error), error, design.options.widest)
