"""Step of the monitor: measurements, prediction, detection, identification, confirmation, output."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed
from gridsec.estimators.inputs import NO_VOLTAGE, nothing_new
from gridsec.estimators.sequential import learning
from gridsec.estimators.sequential.bounds import (
    InjectionError,
    PowerErrors,
    unknown_injections,
    update_injection_error,
)
from gridsec.estimators.sequential.busbar import HonestErrors
from gridsec.estimators.sequential.commission import Learning, gather, learn, ready_meters
from gridsec.estimators.sequential.conclude import Tick, output
from gridsec.estimators.sequential.curves import LONGEST_MEAN, InverterChecks, ReportedPowers, check_inverters
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.doubts import FrameUncertainty, update_uncertainty
from gridsec.estimators.sequential.drive import ModelDriven, advance_inverters, prepare
from gridsec.estimators.sequential.examine import Identification, ended, identify
from gridsec.estimators.sequential.heard import Measurements, measurements, plausible
from gridsec.estimators.sequential.kinds import AttackKinds, classify, ingest, repeat_lags
from gridsec.estimators.sequential.moment import without_shifted_busbar
from gridsec.estimators.sequential.naming import confirm, supported
from gridsec.estimators.sequential.scales import Scales, min_readings
from gridsec.estimators.sequential.skew import update_skew as follow_clocks
from gridsec.estimators.sequential.state import SequentialState, TrustState
from gridsec.estimators.sequential.windows import Window, empty, forget, push, shift
from gridsec.interface import Estimate, Explanation, Frame, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    state: SequentialState
    heard: Measurements
    doubts: FrameUncertainty
    kinds: AttackKinds
    copies: Ints
    x: Floats
    free: ModelDriven | None
    lag: InjectionError
    q: Floats
    v2_bus: Floats
    residual: Floats
    transient: Floats
    now: SequentialState
    seen: Identification


def step(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[SequentialState, Estimate, Verdict]:
    """Process one frame.

    A frame that is not later than the last one changes nothing: it repeats the last estimate, with UNDECIDED.
    """
    if not np.isfinite(frame.t) or (state.x is not None and not frame.t > state.t):
        return state, *_repeated(design, state, frame)
    state, frame = _present(design, state, plausible(design, frame))
    look = _look(design, state, frame)
    while look.seen.busbar is not None:
        # The busbar counts as not metered from this tick on.
        state = changed(state, busbar=state.busbar.suspect(*look.seen.busbar))
        look = _look(design, state, frame)
    return _answer(design, look, frame)


def _look(design: SequentialDesign, state: SequentialState, frame: Frame) -> _Look:
    """Predict by the model, then identify the meters that contradict it."""
    measured = measurements(design, state, frame)
    uncertainty = update_uncertainty(
        design, state.uncertainty, frame, measured.available, measured.busbar_metered
    )
    if uncertainty.priors is not state.uncertainty.priors:
        pairs = zip(state.posteriors, uncertainty.priors, strict=True)
        posteriors = tuple(fit if fit is not None and fit.prior is prior else None for fit, prior in pairs)
        state = changed(state, posteriors=posteriors)
    kinds = ingest(design.references, state.attack_kinds, measured.y, measured.available)
    copies = repeat_lags(kinds) * (design.decoder is None)
    x, free, lag = _inverters(design, state, frame, measured, uncertainty.sizes)
    q, v2_bus = _voltages(design, frame, measured, x)
    if _paused(design, state, frame):
        # Loads before a pause as long as the longest scale say nothing about those after it.
        window = empty(design.lengths, measured.y.size)
        state = changed(state, window=window, posteriors=(None,) * len(state.posteriors), clock_skew=None)
    state = _clocks(design, state, frame, v2_bus[design.prior.meters])
    residual = measured.y - v2_bus[design.prior.meters] - state.learned.bias
    window = push(state.window, design.lengths, residual, measured.available)
    swing = _swing(design, v2_bus, measured.v0_squared)
    if state.ticks % _RENEW_TICKS == 0 or swing > max(_RENEW_RATIO * state.voltage_swing, _LEAST_SWING):
        error = _model_error(design, frame.p, q, measured.v0_squared)
        state = changed(state, model_error=error, voltage_swing=swing)
    transient = _transient(design, 0.0 if state.x is None else frame.t - state.since)
    now = changed(state, trust=_with_repeats(state.trust, copies), window=window, uncertainty=uncertainty)
    powers = PowerErrors(
        frame, q, measured.uses_q, measured.v0_squared, state.trust.trusted, uncertainty.sizes
    )
    identified = identify(design, now, state.model_error + transient, HonestErrors(powers, lag.error))
    return _Look(
        state,
        measured,
        uncertainty,
        kinds,
        copies,
        x,
        free,
        lag,
        q,
        v2_bus,
        residual,
        transient,
        now,
        identified,
    )


def _paused(design: SequentialDesign, state: SequentialState, frame: Frame) -> bool:
    """True if the pause since the last frame is at least as long as the longest scale."""
    return state.x is not None and frame.t - state.t >= design.lengths[-1] * design.step_s


def _present(design: SequentialDesign, state: SequentialState, frame: Frame) -> tuple[SequentialState, Frame]:
    """Frame without a busbar reading of another moment, and the state with the readings of this one."""
    before = None if _paused(design, state, frame) else state.busbar_history
    moment, frame = without_shifted_busbar(design, before, frame, state.trust.trusted, state.v0_squared)
    return state if moment is before is state.busbar_history else changed(state, busbar_history=moment), frame


def _clocks(design: SequentialDesign, state: SequentialState, frame: Frame, v2: Floats) -> SequentialState:
    """State with the voltage changes within clock offsets, and without posteriors of other variances."""
    before = state.clock_skew
    if before is None and frame.clock_offset is None:
        return state
    need = np.array([min_readings(design, s) for s in range(len(design.lengths))])
    noise = design.white / need[:, None] + state.learned.variance
    skew = follow_clocks(design, before, state.ticks, frame.clock_offset, v2, noise)
    none = np.zeros(noise.shape)
    old, new = (none if each is None else each.variance for each in (before, skew))
    # Variances change only at ticks at which their scale is due: no further look follows from that.
    same = (old == new).all(axis=1).tolist()
    posteriors = tuple(fit if one else None for fit, one in zip(state.posteriors, same, strict=True))
    return changed(state, clock_skew=skew, posteriors=posteriors)


def _answer(design: SequentialDesign, look: _Look, frame: Frame) -> tuple[SequentialState, Estimate, Verdict]:
    """Confirm suspects, update the state, and put the output together."""
    state, measured = look.state, look.heard
    identified, window, rivals = _confirmed(design, look, state.trust)
    v2 = look.v2_bus[design.prior.meters]
    own = _own_part(design, frame.p, measured.q)
    after = changed(
        state,
        t=frame.t,
        frame=frame,
        since=frame.t if state.x is None else state.since,
        ticks=state.ticks + 1,
        x=look.x,
        model_driven=_free(design, look, identified.trust, frame.t),
        injection_error=look.lag
        if identified.trust.clear
        else look.lag.reset(_newly_suspect(design, state.trust, identified.trust)),
        v0_squared=measured.v0_squared,
        window=window,
        trust=identified.trust,
        posteriors=identified.posteriors,
        full_posteriors=identified.full_posteriors,
        inconsistent=identified.inconsistent,
        uncertainty=look.doubts,
        inverter_checks=_checked_inverters(design, look, frame, identified),
        attack_kinds=_classified(design, look, identified, window, v2, own),
        learning=_gathered(design, look, frame, identified.trust),
    )
    tick = Tick(frame, measured, look.q, look.v2_bus, look.transient, identified, rivals)
    after, estimate, verdict = output(design, after, tick)
    if after.learning is not state.learning:
        # From the next frame on: this one was tested with the errors known before.
        after = _learned(design, after)
    return after, estimate, verdict


def _free(design: SequentialDesign, look: _Look, trust: TrustState, t: float) -> ModelDriven | None:
    """Prepared loop of the model-driven inverters, renewed where meters have just been suspected."""
    state = look.state
    if state.x is None or not any_of(state.trust.trusted & ~trust.trusted):
        return look.free
    return prepare(design, trust.trusted & look.heard.available, t - state.t, look.free)


def _newly_suspect(design: SequentialDesign, before: TrustState, now: TrustState) -> Bools:
    """Inverters with a meter that was trusted until this tick, (m,)."""
    caught = before.trusted & ~now.trusted
    if not any_of(caught):
        return np.zeros(design.meter_of.size, dtype=np.bool_)
    return (design.meter_of >= 0) & caught[design.meter_of]


def _repeated(design: SequentialDesign, state: SequentialState, frame: Frame) -> tuple[Estimate, Verdict]:
    """Output for a frame that is not later than the last one."""
    none = np.zeros(design.plant.droop.tau.size)
    estimate, verdict = nothing_new(design.plant, frame, state.t, state.last, state.v0_squared, none)
    if state.last is None:
        estimate = replace(estimate, std=estimate.bound)
    return estimate, verdict


def _confirmed(
    design: SequentialDesign, look: _Look, before: TrustState
) -> tuple[Identification, Window, tuple[Explanation, ...]]:
    """Confirmed suspects, the window after it, and rival hypotheses."""
    identified, now = look.seen, look.now
    if identified.trust.clear and now.trust.clear:
        return identified, now.window, ()
    over = ended(design, now.uncertainty.priors, now.trust, identified, now.window)
    trust, rivals = confirm(
        design, now.trust, _without_ended(identified, over), look.heard.available, now.inverter_checks
    )
    model = look.state.model_error + look.transient
    scales = Scales(design, now.uncertainty, now.window, now.learned, model, now.clock_skew)
    trust = supported(scales, now.trust, identified, trust)
    trust = _with_repeats(trust, look.copies)
    rivals = rivals or _last_rivals(design, now.last, before, trust)
    identified = identified if trust is identified.trust else replace(identified, trust=trust)
    return identified, forget(now.window, over), rivals


def _transient(design: SequentialDesign, age: float) -> Floats:
    """Remainder of the unknown initial state at each meter, (p,)."""
    # Without inverters the rate is infinite; infinity times zero is NaN.
    return np.asarray(design.inverter_reach * (np.exp(-design.certificate.rate * age) if age > 0 else 1.0))


def _last_rivals(
    design: SequentialDesign, last: tuple[Estimate, Verdict] | None, before: TrustState, trust: TrustState
) -> tuple[Explanation, ...]:
    """Last explanations while the suspects stay the same: they are not searched at every tick."""
    anybody = not all_of(trust.trusted) or any_of(trust.inverter_ticks)
    if last is None or design.decoder is not None or not anybody:
        return ()
    names = ("trusted", "named", "inverters")
    same = all(np.array_equal(getattr(trust, name), getattr(before, name)) for name in names)
    return last[1].explanations if same else ()


def _without_ended(identified: Identification, over: Bools) -> Identification:
    """Identification without evidence against meters with an ended manipulation."""
    trust = identified.trust
    if not any_of(over):
        return identified
    return replace(
        identified,
        trust=replace(
            trust,
            above_limit=trust.above_limit & ~over,
            above_release_limit=trust.above_release_limit & ~over,
        ),
    )


def _voltages(
    design: SequentialDesign, frame: Frame, measured: Measurements, x: Floats
) -> tuple[Floats, Floats]:
    """Net reactive injections, (N,), and the voltages of the model, (n,)."""
    plant = design.plant
    q = _net_injections(design, measured, x)
    with np.errstate(all="ignore"):
        v2_bus = plant.feeder.bus_voltages(frame.p, q, measured.v0_squared, steps=plant.loss_correction)
        v2_bus = np.minimum(np.maximum(v2_bus, 0.0), NO_VOLTAGE)
    none = np.isnan(v2_bus)
    return q, np.where(none, plant.feeder.broadcast_busbar(measured.v0_squared), v2_bus) if any_of(
        none
    ) else v2_bus


def _net_injections(design: SequentialDesign, measured: Measurements, x: Floats) -> Floats:
    """Net reactive injections, observed for inverters without metered reactive power, (N,)."""
    observed = design.plant.droop.per_customer(x, measured.q.size)
    return measured.q + (np.where(measured.uses_q, 0.0, observed) if any_of(measured.uses_q) else observed)


def _swing(design: SequentialDesign, v2_bus: Floats, v0_squared: Floats | float) -> float:
    """Largest change of a squared voltage by the powers."""
    return float(np.abs(v2_bus - design.plant.feeder.broadcast_busbar(v0_squared)).max())


def _with_repeats(trust: TrustState, copies: Ints) -> TrustState:
    """Trust state in which meters that repeat themselves are named."""
    if not any_of(copies):
        return trust
    which = copies > 0
    return replace(
        trust,
        trusted=trust.trusted & ~which,
        ticks_clear=np.where(which, 0, trust.ticks_clear),
        above_release_limit=trust.above_release_limit | which,
        repeat_lag=np.where(which, copies, trust.repeat_lag),
        named=trust.named | which,
    )


def _checked_inverters(
    design: SequentialDesign, look: _Look, frame: Frame, identified: Identification
) -> InverterChecks:
    """Comparison of metered reactive powers with the droop curves."""
    before, measured = look.state.inverter_checks, look.heard
    if before.idle and not any_of(measured.reports_q):
        return before
    believed = measured.available & identified.trust.trusted & (identified.trust.ticks_suspect == 0)
    s = max(sum(length <= LONGEST_MEAN for length in design.lengths) - 1, 0)
    view = identified.tests[s]
    loo = None if view is None else view.loo
    now = ReportedPowers(
        frame, measured.reports_q, measured.uses_q, believed, look.x, look.lag, identified.posteriors[s], loo
    )
    return check_inverters(design, before, now)


def _classified(  # noqa: PLR0917
    design: SequentialDesign,
    look: _Look,
    identified: Identification,
    window: Window,
    v2: Floats,
    own: Floats,
) -> AttackKinds:
    """Kinds of the manipulations, from the leave-one-out residuals of the shortest scale."""
    state, view = look.state, identified.tests[0]
    expected = v2 + state.learned.bias
    if view is None:
        prior_ = state.uncertainty.priors[0]
        variance = prior_.variance[prior_.meters] + design.white + state.learned.variance
    else:
        std = view.loo.std
        mean = view.loo.m if window is look.now.window else window.sums[0] / np.maximum(window.counts[0], 1)
        expected, variance = expected + mean - view.loo.residual, std * std
    return classify(design.references, look.kinds, expected, own, identified.trust.named, variance)


def _own_part(design: SequentialDesign, p: Floats, q: Floats) -> Floats:
    """Contribution of each meter's own reported powers to its modelled voltage, (p,)."""
    shapes, meters = design.references, design.plant.meters
    return np.asarray(shapes.active * p[meters] + shapes.reactive * q[meters])


def _gathered(design: SequentialDesign, look: _Look, frame: Frame, trust: TrustState) -> Learning | None:
    """Sums and times of the commissioning after this frame."""
    state = look.state
    if state.learning is None or not state.ticks:
        return state.learning
    this = learning.LearningTick(frame, look.heard.available, trust.trusted, bool(trust.accused), look.doubts)
    use, why = learning.usable(design, state.learning, this)
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
    ready = ready_meters(design, gathered) & trust.trusted
    # Meters that are suspect and not yet named may turn out to be honest.
    if not any_of(ready) or not all_of(trust.trusted | trust.named | (state.window.counts[-1] == 0)):
        return state
    known = learn(design, state.learned, gathered, ready, state.t)
    window = shift(state.window, state.learned.bias - known.learned.bias)
    posteriors = (None,) * len(state.posteriors)
    return changed(
        state, learning=known.learning, learned=known.learned, window=window, posteriors=posteriors
    )


_PAUSE = 60.0
"""Ticks without a frame that count as a pause."""
_RENEW_TICKS, _RENEW_RATIO, _LEAST_SWING = 16, 1.1, 0.01
"""Renewal of the model error: ticks, ratio of the largest voltage change, and least change, squared pu."""


def _inverters(
    design: SequentialDesign, state: SequentialState, frame: Frame, measured: Measurements, sizes: Floats
) -> tuple[Floats, ModelDriven | None, InjectionError]:
    """Injections at this frame, their errors, and the prepared loop; at rest at the first frame."""
    droop, meter = design.plant.droop, design.meter_of
    believed = state.trust.trusted & measured.available
    driven = (meter >= 0) & believed[meter]
    y = measured.y[meter] if meter.size else np.zeros(0)
    if not all_of(driven):
        here = design.plant.feeder.broadcast_busbar(measured.v0_squared)[
            design.plant.feeder.bus[droop.customer]
        ]
        y = np.where(driven, y, here)
    if state.x is None:
        return np.asarray(droop(droop.vbar**2 - y)), None, unknown_injections(design.plant, y)
    w, follows, h = None, None, frame.t - state.t
    if not all_of(driven):
        injected = droop.per_customer(state.x, frame.q.size)
        now, v2 = _linear(design, frame.p, np.stack([frame.q + injected, frame.q]), measured.v0_squared)
        if state.last is not None and state.frame is not None:
            before = state.frame
            # Losses and the correction by the meters hardly change between two frames.
            v2 += state.last[0].v2 - _linear(design, before.p, before.q + injected, state.v0_squared)
        w, y = droop.vbar**2 - v2, np.where(driven, y, now[droop.customer])
        follows = ~driven, _power_errors(design, state, frame, measured, sizes), measured.busbar_metered
    lag = update_injection_error(design, state.injection_error, y, follows, h)
    return *advance_inverters(design, state.x, y, driven, w, h, state.model_driven), lag


def _power_errors(
    design: SequentialDesign, state: SequentialState, frame: Frame, measured: Measurements, sizes: Floats
) -> PowerErrors:
    """Power errors for the model-driven inverters."""
    x = np.zeros(0) if state.x is None else state.x
    return PowerErrors(
        frame,
        _net_injections(design, measured, x),
        measured.uses_q,
        measured.v0_squared,
        state.trust.trusted,
        sizes,
    )


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
