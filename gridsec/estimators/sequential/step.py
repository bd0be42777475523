"""Step of the monitor: measurements, prediction, detection, identification, confirmation, output."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gridsec.arrays import Floats, Ints, all_of, any_of, changed
from gridsec.estimators.plant import nothing_new
from gridsec.estimators.sequential.attack_kind import AttackKinds, classify, ingest, repeat_lags
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.device_checks import (
    LONGEST_MEAN,
    HonestErrors,
    InverterChecks,
    ReportedPowers,
    check_inverters,
)
from gridsec.estimators.sequential.identify import Identification, confirm, ended, identify, supported
from gridsec.estimators.sequential.measurements import (
    ClockSkew,
    FrameUncertainty,
    Measurements,
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
from gridsec.estimators.sequential.observer import Prediction, model_error, predict, prepare
from gridsec.estimators.sequential.output import output
from gridsec.estimators.sequential.posterior import Posterior
from gridsec.estimators.sequential.state import SequentialState, TrustState
from gridsec.estimators.sequential.time_scales import Scales, Window, empty, forget, min_readings, push, shift
from gridsec.interface import Estimate, Explanation, Frame, Verdict

_PAUSE = 60.0
"""Ticks without a frame that count as a pause."""


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
        error = error.reset((design.meter_of >= 0) & new[design.meter_of])
        if state.x is not None:
            available = trust.trusted & measured.available
            model_driven = prepare(design, available, frame.t - state.t, model_driven)
    return changed(
        now,
        t=frame.t,
        frame=frame,
        since=frame.t if state.x is None else state.since,
        ticks=state.ticks + 1,
        x=predicted.x,
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
    loo, error = None if test is None else test.loo, predicted.injection_error.error
    frame, reports_q, uses_q = measured.frame, measured.reports_q, measured.uses_q
    now = ReportedPowers(frame, reports_q, uses_q, trusted, predicted.x, error, posterior, loo)
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
