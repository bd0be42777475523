"""Step of the monitor: measurements, prediction, detection, identification, confirmation, output.

Prediction: the observer of the droop inverters, driven by trusted meters or by the model,

    tau x' = -x + K(zeta),   zeta = vbar^2 - y at trusted meters,   H x + w elsewhere.

One certificate covers every trusted set and every switching (docs/theory-certificates.md). With all meters
trusted a step is exact and costs O(m). The prediction of a frame is the loss-corrected model at the observed
injections.

The error e of every observed injection is bounded by a first-order lag of its input error,

    tau_i |e_i|' <= -|e_i| + min(span_i, d_i (input error + hold) + mismatch),

with `hold` the change of the inverter's voltage between frames; saturation keeps it finite. The input is a
reading of a trusted meter or the model. Assumptions: inverters follow their curves, and a voltage stays
between its values at two successive frames (docs/theory-detection.md for the lag and for `mismatch`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed, indices, submatrix
from gridsec.errors import DesignInfeasible
from gridsec.estimators.plant import NO_VOLTAGE, busbar_errors, nothing_new
from gridsec.estimators.sequential.attack_kind import AttackKinds, classify, ingest, repeat_lags
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.device_checks import (
    LONGEST_MEAN,
    HonestErrors,
    InverterChecks,
    ReportedPowers,
    check_inverters,
    posterior_share,
)
from gridsec.estimators.sequential.identify import Identification, confirm, ended, identify, supported
from gridsec.estimators.sequential.measurements import (
    ClockSkew,
    FrameUncertainty,
    Measurements,
    PowerErrors,
    measurements,
    plausible,
    update_skew,
    update_uncertainty,
    without_shifted_busbar,
)
from gridsec.estimators.sequential.meter_bias import (
    Learning,
    LearningTick,
    gather,
    learn,
    ready_meters,
    usable,
)
from gridsec.estimators.sequential.output import output
from gridsec.estimators.sequential.posterior import Posterior
from gridsec.estimators.sequential.state import (
    InjectionError,
    ModelDriven,
    Prediction,
    SequentialState,
    TrustState,
    unknown_injections,
)
from gridsec.estimators.sequential.time_scales import Scales, Window, empty, forget, min_readings, push, shift
from gridsec.grid.network import Power
from gridsec.interface import Estimate, Explanation, Frame, Verdict
from gridsec.observers.lure import POLICY, Lure, transition
from gridsec.observers.lure import advance as advance_loop
from gridsec.observers.lure import step as step_loop

_PATIENT = replace(POLICY, settled=0.0)

_PAUSE = 60.0
"""Ticks without a frame that count as a pause."""

_LATE = 1.5
"""Ticks after the last frame from which on the voltages may have moved unseen."""

_RESPONSES = 4
"""Iterations for the inverters' response in a pause; each divides the excess by the loop gain."""


_RENEW_TICKS, _RENEW_RATIO, _LEAST_SWING = 16, 1.1, 0.01
"""Renewal of the model error: ticks, ratio of the largest voltage change, and least change, squared pu."""


def step(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[SequentialState, Estimate, Verdict]:
    """Process one frame.

    A frame that is not later than the last one changes nothing: it repeats the last estimate, with UNDECIDED.
    """
    if not np.isfinite(frame.t) or (state.x is not None and not frame.t > state.t):
        return state, *_repeated(design, state, frame)
    state, frame = _without_shifted_busbar(design, state, plausible(design, frame))
    while True:
        measured = measurements(design, frame, state.trust.trusted, state.busbar.trusted, state.v0_squared)
        uncertainty = update_uncertainty(
            design, state.uncertainty, frame, measured.available, measured.busbar_metered
        )
        predicted = predict(design, state, measured, uncertainty.sizes)
        now = _detection(design, state, measured, predicted, uncertainty)
        honest = HonestErrors(predicted.powers, predicted.injection_error.error)
        identified = identify(design, now, now.model_error + predicted.transient, honest)
        if identified.busbar is None:
            break
        # The busbar counts as not metered from this tick on.
        state = changed(state, busbar=state.busbar.suspect(*identified.busbar))
    identified, window = _confirmation(design, state, now, predicted, identified, measured)
    now = now if window is now.window else changed(now, window=window)
    after = _state(design, state, now, measured, predicted, identified)
    after, estimate, verdict = output(design, after, measured, predicted, identified)
    # Errors learned at this tick count from the next frame on.
    return after if after.learning is state.learning else _learned(design, after), estimate, verdict


def _repeated(design: SequentialDesign, state: SequentialState, frame: Frame) -> tuple[Estimate, Verdict]:
    """Output for a frame that is not later than the last one."""
    none = np.zeros(design.plant.droop.tau.size)
    estimate, verdict = nothing_new(design.plant, frame, state.t, state.last, state.v0_squared, none)
    return (replace(estimate, std=estimate.bound) if state.last is None else estimate), verdict


def _paused(design: SequentialDesign, state: SequentialState, frame: Frame) -> bool:
    """True if the pause since the last frame is at least as long as the longest scale."""
    return state.x is not None and frame.t - state.t >= design.lengths[-1] * design.step_s


def _without_shifted_busbar(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[SequentialState, Frame]:
    """Frame without a busbar reading of another moment, and the state with the readings of this one."""
    before = None if _paused(design, state, frame) else state.busbar_history
    history, frame = without_shifted_busbar(design, before, frame, state.trust.trusted, state.v0_squared)
    same = history is before is state.busbar_history
    return state if same else changed(state, busbar_history=history), frame


def _detection(
    design: SequentialDesign,
    state: SequentialState,
    measured: Measurements,
    predicted: Prediction,
    uncertainty: FrameUncertainty,
) -> SequentialState:
    """State with the residuals of this tick, and without posteriors that no longer hold."""
    v2, window, skew = predicted.v2_bus[design.prior.meters], state.window, state.clock_skew
    posteriors = _of_priors(state, uncertainty)
    if _paused(design, state, measured.frame):
        # Loads before a pause as long as the longest scale say nothing about those after it.
        window, posteriors, skew = empty(design.lengths, v2.size), (None,) * len(posteriors), None
    if skew is not None or measured.frame.clock_offset is not None:
        skew, posteriors = _clock_skew(design, state, skew, measured.frame, v2, posteriors)
    kinds = ingest(design.references, state.attack_kinds, measured.y, measured.available)
    residual = measured.y - v2 - state.learned.bias
    now = changed(
        state,
        trust=state.trust.repeating(_repeat_lags(design, kinds)),
        window=push(window, design.lengths, residual, measured.available),
        posteriors=posteriors,
        uncertainty=uncertainty,
        clock_skew=skew,
        attack_kinds=kinds,
    )
    # Largest change of a squared voltage by the powers.
    v0 = design.plant.feeder.broadcast_busbar(measured.v0_squared)
    swing = float(np.abs(predicted.v2_bus - v0).max())
    if state.ticks % _RENEW_TICKS == 0 or swing > max(_RENEW_RATIO * state.voltage_swing, _LEAST_SWING):
        now = changed(now, model_error=model_error(design, predicted.powers), voltage_swing=swing)
    return now


def _of_priors(state: SequentialState, uncertainty: FrameUncertainty) -> tuple[Posterior | None, ...]:
    """Posteriors of unchanged priors; None for others."""
    if uncertainty.priors is state.uncertainty.priors:
        return state.posteriors
    pairs = zip(state.posteriors, uncertainty.priors, strict=True)
    return tuple(now if now is not None and now.prior is prior else None for now, prior in pairs)


def _repeat_lags(design: SequentialDesign, kinds: AttackKinds) -> Ints:
    """Ticks after which meters repeat their readings beyond chance, (p,); 0 for all with a decoder."""
    return repeat_lags(kinds) * (design.decoder is None)


def _clock_skew(  # noqa: PLR0917
    design: SequentialDesign,
    state: SequentialState,
    before: ClockSkew | None,
    frame: Frame,
    v2: Floats,
    posteriors: tuple[Posterior | None, ...],
) -> tuple[ClockSkew | None, tuple[Posterior | None, ...]]:
    """Voltage changes within clock offsets, and the posteriors of unchanged variances."""
    need = np.array([min_readings(design, s) for s in range(len(design.lengths))])
    noise = design.white / need[:, None] + state.learned.variance
    skew = update_skew(design, before, state.ticks, frame.clock_offset, v2, noise)
    none = np.zeros(noise.shape)
    old, new = (none if each is None else each.variance for each in (before, skew))
    # Variances change only at ticks at which their scale is due: no further look follows from that.
    same = (old == new).all(axis=1).tolist()
    return skew, tuple(now if one else None for now, one in zip(posteriors, same, strict=True))


def _confirmation(  # noqa: PLR0917
    design: SequentialDesign,
    state: SequentialState,
    now: SequentialState,
    predicted: Prediction,
    identified: Identification,
    measured: Measurements,
) -> tuple[Identification, Window]:
    """Identification with confirmed suspects and rival hypotheses, and the window after it."""
    if identified.trust.clear and now.trust.clear:
        return identified, now.window
    over = ended(design, now.uncertainty.priors, now.trust, identified, now.window)
    tested = identified
    if any_of(over):
        tested = replace(identified, trust=identified.trust.without_evidence(over))
    trust, rivals = confirm(design, now.trust, tested, measured.available, now.inverter_checks)
    model = now.model_error + predicted.transient
    scales = Scales(design, now.uncertainty, now.window, now.learned, model, now.clock_skew)
    trust = supported(scales, now.trust, identified, trust).repeating(_repeat_lags(design, now.attack_kinds))
    rivals = rivals or _last_rivals(design, state, trust)
    return replace(identified, trust=trust, rivals=rivals), forget(now.window, over)


def _last_rivals(
    design: SequentialDesign, before: SequentialState, trust: TrustState
) -> tuple[Explanation, ...]:
    """Last explanations while the suspects stay the same: they are not searched at every tick."""
    any_suspect = not all_of(trust.trusted) or any_of(trust.inverter_ticks)
    if before.last is None or design.decoder is not None or not any_suspect:
        return ()
    names = ("trusted", "named", "inverters")
    same = all(np.array_equal(getattr(trust, name), getattr(before.trust, name)) for name in names)
    return before.last[1].explanations if same else ()


def _state(  # noqa: PLR0917
    design: SequentialDesign,
    state: SequentialState,
    now: SequentialState,
    measured: Measurements,
    predicted: Prediction,
    identified: Identification,
) -> SequentialState:
    """State after this tick, from those before it and of its detection."""
    frame, trust = measured.frame, identified.trust
    model_driven, error = predicted.model_driven, predicted.injection_error
    new = state.trust.trusted & ~trust.trusted
    if any_of(new):
        # A manipulated meter drove these inverters.
        error = error.reset(design.inverters_of(new))
        if state.x is not None:
            available = trust.trusted & measured.available
            model_driven = prepare(design, available, frame.t - state.t, model_driven)
    return changed(
        now,
        t=frame.t,
        frame=frame,
        ticks=state.ticks + 1,
        x=predicted.x,
        transient=predicted.transient,
        model_driven=model_driven,
        injection_error=error,
        v0_squared=measured.v0_squared,
        trust=trust,
        posteriors=identified.posteriors,
        full_posteriors=identified.full_posteriors,
        inconsistent=identified.inconsistent,
        inverter_checks=_checked_inverters(design, state.inverter_checks, measured, predicted, identified),
        attack_kinds=_classified(design, now, predicted, measured, identified),
        learning=_gathered(design, now, measured, trust),
    )


def _checked_inverters(
    design: SequentialDesign,
    before: InverterChecks,
    measured: Measurements,
    predicted: Prediction,
    identified: Identification,
) -> InverterChecks:
    """Comparison of metered reactive powers with the droop curves."""
    if before.idle and not any_of(measured.reports_q):
        return before
    trusted = measured.available & identified.trust.trusted & (identified.trust.ticks_suspect == 0)
    s = max(sum(length <= LONGEST_MEAN for length in design.lengths) - 1, 0)
    test, posterior = identified.tests[s], identified.posteriors[s]
    if test is None or posterior is None:
        return before
    loo, error = test.loo, predicted.injection_error.error
    frame, reports_q, uses_q = measured.frame, measured.reports_q, measured.uses_q
    share = partial(posterior_share, design, posterior, loo.weights)
    now = ReportedPowers(frame, reports_q, uses_q, trusted, predicted.x, error, loo.residual, loo.std, share)
    return check_inverters(design, before, now)


def _classified(
    design: SequentialDesign,
    now: SequentialState,
    predicted: Prediction,
    measured: Measurements,
    identified: Identification,
) -> AttackKinds:
    """Kinds of the manipulations, from the leave-one-out residuals of the shortest scale."""
    references, meters, window, test = design.references, design.plant.meters, now.window, identified.tests[0]
    assert test is not None  # noqa: S101  # the shortest scale looks at every tick
    # Part of each meter's own reported powers in its modelled voltage.
    own = np.asarray(references.active * measured.frame.p[meters] + references.reactive * measured.q[meters])
    mean = test.loo.m if identified.trust.clear else window.sums[0] / np.maximum(window.counts[0], 1)
    expected = predicted.v2_bus[design.prior.meters] + now.learned.bias + mean - test.loo.residual
    return classify(references, now.attack_kinds, expected, own, identified.trust.named, test.loo.std**2)


def _gathered(
    design: SequentialDesign, now: SequentialState, measured: Measurements, trust: TrustState
) -> Learning | None:
    """Sums and times of the commissioning after this frame."""
    if now.learning is None or not now.ticks:
        return now.learning
    tick = LearningTick(
        measured.frame, measured.available, trust.trusted, bool(trust.accused), now.uncertainty
    )
    use, why = usable(design, now.learning, tick)
    h = measured.frame.t - now.t
    # A pause of the frames is not time with readings.
    h = h if h <= _PAUSE * design.step_s else design.step_s
    return gather(now.learning, now.window.residuals[-1], use, h, why)


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
    window, none = (
        shift(state.window, state.learned.bias - known.learned.bias),
        (None,) * len(state.posteriors),
    )
    return changed(state, learning=known.learning, learned=known.learned, window=window, posteriors=none)


def predict(
    design: SequentialDesign, state: SequentialState, measured: Measurements, sizes: Floats
) -> Prediction:
    """Prediction of a frame, with the sizes (k,) of false powers."""
    x, model_driven, error = _inverters(design, state, measured, sizes)
    powers = _powers(design, state, measured, x, sizes)
    transient = state.transient if state.x is None else _transient(design, state, error.input, measured.frame)
    return Prediction(x, model_driven, error, powers, _voltages(design, powers), transient)


def _transient(design: SequentialDesign, state: SequentialState, given: Floats, frame: Frame) -> Floats:
    """Remainder of unknown injections in the squared voltages of the meters, (p,).

        u' = -rate u + |2 X| |K(z) - K(z_end)| / tau

    The second term counts in a pause of the frames only. The observer is driven by the voltages at its end,
    `given` (m,), squared pu.
    """
    rate, h, droop = design.certificate.rate, frame.t - state.t, design.plant.droop
    decay = math.exp(-rate * h)
    left = state.transient * decay
    if h <= _LATE * design.step_s or not droop.tau.size:
        return left
    change = _unseen(design, state, given)
    unknown = np.minimum((1.0 - decay) / (rate * droop.tau) * change, 2.0 * droop.limit)
    effect = np.abs(design.sensitivities.columns(Power.REACTIVE, droop.customer)[design.prior.meters])
    return np.asarray(np.minimum(left + effect @ unknown, design.inverter_reach))


def _unseen(design: SequentialDesign, state: SequentialState, given: Floats) -> Floats:
    """Range of the set-points in a pause, (m,), pu: ``K(z_high) - K(z_low)``.

    Assumption: loads and busbar keep the voltages between those before and after the pause, `given` (m,),
    squared pu. The inverters' own response adds ``|H| (range of x)``. The map is monotone: from above, its
    images stay above that range.
    """
    droop, x = design.plant.droop, state.x
    assert x is not None  # noqa: S101  # before the first frame there is no pause
    ends = droop.vbar**2 - np.stack([given, state.injection_error.input])
    z, moved, response = (ends.min(axis=0), ends.max(axis=0)), droop.span, np.abs(design.loop)
    low = high = x
    for _ in range(_RESPONSES):
        more = response @ moved
        low, high = droop(z[0] - more), droop(z[1] + more)
        moved = np.maximum(high, x) - np.minimum(low, x)
    return np.asarray(high - low)


def _powers(
    design: SequentialDesign, state: SequentialState, measured: Measurements, x: Floats, sizes: Floats
) -> PowerErrors:
    """Powers of a frame with net reactive injections, observed for inverters without metered power."""
    observed = design.plant.droop.per_customer(x, measured.q.size)
    q = measured.q + (np.where(measured.uses_q, 0.0, observed) if any_of(measured.uses_q) else observed)
    return PowerErrors(measured.frame, q, measured.uses_q, measured.v0_squared, state.trust.trusted, sizes)


def _voltages(design: SequentialDesign, powers: PowerErrors) -> Floats:
    """Squared voltages by the loss-corrected model, (n,)."""
    plant, v0 = design.plant, powers.v0_squared
    with np.errstate(all="ignore"):
        v2_bus = plant.feeder.bus_voltages(powers.frame.p, powers.q, v0, steps=plant.loss_correction)
        v2_bus = np.minimum(np.maximum(v2_bus, 0.0), NO_VOLTAGE)
    none = np.isnan(v2_bus)
    return np.where(none, plant.feeder.broadcast_busbar(v0), v2_bus) if any_of(none) else v2_bus


def model_error(design: SequentialDesign, powers: PowerErrors) -> Floats:
    """Largest error of the loss-corrected model at each meter, (p,)."""
    plant = design.plant
    with np.errstate(all="ignore"):
        error = plant.feeder.model_error_bound(powers.frame.p, powers.q, powers.v0_squared)[plant.meters]
    return np.where(np.isfinite(error), error, design.options.widest)


def _inverters(
    design: SequentialDesign, state: SequentialState, measured: Measurements, sizes: Floats
) -> tuple[Floats, ModelDriven | None, InjectionError]:
    """Injections at this frame, the prepared loop, and errors; at rest at the first frame."""
    droop, meter, feeder, frame = design.plant.droop, design.meter_of, design.plant.feeder, measured.frame
    driven = design.inverters_of(state.trust.trusted & measured.available)
    y = measured.y[meter] if meter.size else np.zeros(0)
    if not all_of(driven):
        y = np.where(driven, y, feeder.broadcast_busbar(measured.v0_squared)[feeder.bus[droop.customer]])
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
        follows = ~driven, _powers(design, state, measured, state.x, sizes), measured.busbar_metered
    error = update_injection_error(design, state.injection_error, y, follows, h)
    return *advance_inverters(design, state.x, y, driven, w, h, state.model_driven), error


def _linear(design: SequentialDesign, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Squared voltages of the customers by the linear model, (…, N) as q."""
    feeder = design.plant.feeder
    return np.asarray(feeder.bus_voltages(p, q, v0_squared, steps=0)[..., feeder.bus])


def advance_inverters(  # noqa: PLR0917
    design: SequentialDesign,
    x: Floats,
    y: Floats,
    driven: Bools,
    w: Floats | None,
    h: float,
    before: ModelDriven | None = None,
) -> tuple[Floats, ModelDriven | None]:
    """Injections a time h later, and the prepared loop; chong2020 (5) with K = E_J, L = 0.

    x, y, driven: (m,) injections, squared voltages of the inverters' meters, and use of these. w: (N,) input
    of the model-driven inverters; None if all are driven.
    """
    droop = design.plant.droop
    decay = np.exp(-h / droop.tau)
    target = droop(droop.vbar**2 - y)
    if w is None or all_of(driven):
        return np.asarray(target + decay * (x - target)), before
    out = np.where(driven, target + decay * (x - target), x)
    free = _prepared(design, indices(~driven), h, before)
    # Driven inverters enter by the mean of x and out.
    held = np.where(driven, 0.5 * (x + out), 0.0)
    at = w[droop.customer[free.rows]] + design.loop[free.rows] @ held
    try:
        out[free.rows] = step_loop(free.transition, free.loop, x[free.rows], at)
    except DesignInfeasible:
        out[free.rows] = advance_loop(free.loop, x[free.rows], at, h, _PATIENT)
    return out, free


def prepare(
    design: SequentialDesign, trusted: Bools, h: float, before: ModelDriven | None
) -> ModelDriven | None:
    """Loop for the next step if the trusted meters with a reading, (p,), stay the same.

    Prepared at the tick of a suspicion, since the tick after it has more to compute.
    """
    driven = design.inverters_of(trusted)
    return before if all_of(driven) else _prepared(design, indices(~driven), h, before)


def _prepared(design: SequentialDesign, rows: Ints, h: float, before: ModelDriven | None) -> ModelDriven:
    if before is None or not np.array_equal(before.rows, rows):
        loop = _loop(design, rows)
        return ModelDriven(rows, loop, transition(loop, h))
    return before if before.transition.h == h else replace(before, transition=transition(before.loop, h))


def _loop(design: SequentialDesign, rows: Ints) -> Lure:
    droop = design.plant.droop
    H = submatrix(design.loop, rows, rows)
    rate, size = 1.0 / droop.tau[rows], rows.size
    return Lure(
        A=-np.diag(rate),
        G=np.diag(rate),
        H=H,
        F=np.eye(size),
        B=np.zeros((size, size)),
        C=H,
        D=np.eye(size),
        slope=droop.slope[rows],
        phi=droop.take(rows),
    )


# --- Errors of the injections ---


_ITERATIONS = 2
"""Iterations of the monotone map of the model-driven inverters, from above."""


def update_injection_error(
    design: SequentialDesign,
    before: InjectionError,
    given: Floats,
    free: tuple[Bools, PowerErrors, Bools | bool] | None,
    h: float,
) -> InjectionError:
    """Errors a time h later.

    given: (m,) squared voltage at each input, pu. free: inverters that follow the model, (m,), power errors,
    and metered busbar phases; None where all follow their meters.
    """
    plant, droop, span = design.plant, design.plant.droop, before.span
    width = design.reading_errors.of(given)
    target = injection_target(design, before, given, width)
    if free is not None:
        (which, powers, metered), size = free, plant.feeder.bus.size
        # The map is monotone: from above its images stay above the error.
        top = np.where(which, span, np.maximum(before.error, target))
        lost, _ = powers.loss_error(plant, droop.per_customer(top, size))
        meter = np.minimum(busbar_errors(plant, powers.v0_squared, design.sigmas[0]), NO_VOLTAGE)
        known = np.where(metered, meter, NO_VOLTAGE)
        busbar = plant.feeder.broadcast_busbar(known)[plant.feeder.bus]
        for _ in range(_ITERATIONS):
            model = powers.linear_error(plant, droop.per_customer(top, size)) + lost + busbar
            width = np.where(which, model[droop.customer], width)
            image = injection_target(design, before, given, width)
            target = np.where(which, image, target)
            top = np.where(which, np.maximum(before.error, image), top)
    return relaxed(design, before, given, width, target, h)


def injection_target(
    design: SequentialDesign, before: InjectionError, given: Floats, width: Floats
) -> Floats:
    """Largest errors of the set-points between two frames, (m,), pu.

    Between the frames the input of the observer is in the range [a, b] of both inputs, and the true one at
    most the larger ``width`` W off this range. The curve is monotone, and with ``z = vbar^2 - v^2``

        max(K(z(a - W)) - K(z(b)), K(z(a)) - K(z(b + W))) + mismatch

    bounds the error: on a flat part of the curve the inputs do not matter.

    given, width: (m,) squared voltage at each input and its largest error, squared pu.
    """
    droop, wider = design.plant.droop, np.maximum(width, before.width)
    low, high = np.minimum(given, before.input), np.maximum(given, before.input)
    above, top, bottom, below = droop(droop.vbar**2 - np.stack([low - wider, low, high, high + wider]))
    return np.asarray(np.minimum(before.span, np.maximum(above - bottom, top - below) + design.mismatch))


def relaxed(  # noqa: PLR0917
    design: SequentialDesign,
    before: InjectionError,
    given: Floats,
    width: Floats,
    target: Floats,
    h: float,
) -> InjectionError:
    """Errors a time h later with those of the set-points, `target` (m,), pu, in between."""
    error = target + np.exp(-h / design.plant.droop.tau) * (before.error - target)
    return InjectionError(error, given, width, before.span)
