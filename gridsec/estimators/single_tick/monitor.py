"""Monitor of the decoders: one prediction, one decoder, confirmation over ticks.

    design(plant, decoder, doubt=..., step_s=..., max_attacked=...) -> SingleTickDesign
    init(design, t) -> SingleTickState
    step(design, state, frame) -> (SingleTickState, Estimate, Verdict)

A step, in this order:

1. *Prediction.* Plausible measurements, injections of the inverters by their observer, and loss-corrected
   voltages. With the covariance S of the voltages and the variances D of the meters the innovation is
   ``m = y - prediction ~ N(a, S + D)``.
2. *Decoder.* It accuses a set of meters. Where an accused reading has driven an inverter, prediction and
   decoder are repeated without that reading.
3. *Confirmation.* An accusation counts if no rival does without it and the reading is beyond its limit by the
   meters that are left. A false reading of the busbar is a rival where it explains all others. The
   `confirm`-th accusation names the meter. `release` readings in turn without an accusation clear it. A
   single accusation is an impulse, or chance.
4. *Estimate.* Posterior of the voltages by the meters without any accusation, with its standard deviation
   and bound.
5. *Verdict.* CLEAN only if all meters are read, no answer has accused one for `release` readings, the rest
   fits the feeder (chi-square, largest leave-one-out residual), and the observer has settled. UNDECIDED has
   a cause.

The limits of all meters and the test of chi-square have equal shares of `alarms_per_year`:

    2 p P(|z| > sigmas) = alarms_per_year step_s / year

Nothing is learned: a restart is `init`.

Source: lee2018, chapter 2; docs/theory-snapshot.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.special import ndtri

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed
from gridsec.errors import DesignInfeasible
from gridsec.estimators.detection import Counters, DecisionInputs, count, decide, no_counts
from gridsec.estimators.front import FrontDesign, FrontOptions, FrontState, LoadDoubt
from gridsec.estimators.front import design as front_design
from gridsec.estimators.front import init as front_init
from gridsec.estimators.front.design import YEAR_S
from gridsec.estimators.front.measurements import (
    ClockSkew,
    FrameUncertainty,
    Measurements,
    PowerErrors,
    checked,
    frame_prior,
    measurements,
    plausible,
    update_skew,
    update_uncertainty,
    without_shifted_busbar,
)
from gridsec.estimators.front.observer import predict
from gridsec.estimators.front.output import (
    BoundedEstimate,
    BoundInputs,
    Finding,
    explanations_sentence,
    imprecise,
    unvouched,
    with_clock_offsets,
)
from gridsec.estimators.front.posterior import (
    UNMETERED,
    LeaveOneOut,
    Posterior,
    Prior,
    condition,
    leave_one_out,
)
from gridsec.estimators.front.state import Prediction, repeated
from gridsec.estimators.plant import NO_VOLTAGE, Options, Plant, busbar_errors, usual_options
from gridsec.estimators.single_tick.decoders import (
    RIVAL_RATIO,
    Decoder,
    DecoderAnswer,
    DecoderInput,
    Limits,
    check,
    fewest,
    misfits,
)
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, Verdict
from gridsec.observers.certificates import Certificate

# --- Design and state ---


@dataclass(frozen=True, slots=True, eq=False)
class SingleTickDesign:
    """Offline design. p meters."""

    front: FrontDesign  # prior of the voltages, observer of the inverters, accuracy of the meters
    decoder: Decoder
    noise: Floats = field(repr=False)  # (p,) variance of a reading, fixed error included, squared pu^2
    options: Options = field(repr=False)  # sigmas, confirm, release, settled and widest count

    @property
    def plant(self) -> Plant:
        """The feeder."""
        return self.front.plant

    @property
    def certificate(self) -> Certificate:
        """Certificate of the observer of the inverters."""
        return self.front.certificate

    @property
    def max_attacked(self) -> int:
        """M, largest number of manipulated meters told apart."""
        return self.front.max_attacked

    @property
    def observers(self) -> int:
        """One observer for every trusted set."""
        return 1


@dataclass(frozen=True, slots=True, eq=False)
class SingleTickState:
    """State between frames."""

    front: FrontState  # observer, trusted meters, uncertainty of the frame, last output
    tally: Counters  # counters of accusations, and the named meters
    since: Ints  # (p,) readings since an answer accused the meter
    whole: Posterior | None  # posterior of all meters with a reading; None before the first frame


def design(
    plant: Plant,
    decoder: Decoder,
    *,
    doubt: LoadDoubt,
    step_s: float,
    max_attacked: int,
    alarms_per_year: float = 1.0,
    unread_std_percent: float = 0.5,
) -> SingleTickDesign:
    """Design the monitor of a feeder with a decoder.

    step_s: expected interval between frames, s. max_attacked: M, largest number of accusations.
    alarms_per_year: accusations of honest meters expected in a year. unread_std_percent: largest standard
    deviation of the voltage beside an unread power with CLEAN, % of nominal.

    Raises NotObservable for fewer than three meters; DesignInfeasible if no certificate holds, or the decoder
        has too many sets to try; ValueError as `plant.check_plant`, or if `doubt` is that of other customers.
    """
    chosen = FrontOptions(
        alarms_per_year=alarms_per_year,
        commission_s=0.0,
        unread_std_percent=unread_std_percent,
        # No mean follows that averages a step of the voltage.
        largest_offset_s=0.0,
    )
    front = front_design(plant, doubt=doubt, step_s=step_s, options=chosen, max_attacked=max_attacked)
    p = plant.meters.size
    if decoder is fewest:
        check(p, max_attacked)
    tail = min(alarms_per_year * step_s / (YEAR_S * 2 * p), 0.5)
    return SingleTickDesign(
        front=front,
        decoder=decoder,
        noise=front.white + front.fixed,
        options=replace(usual_options(step_s), sigmas=-float(ndtri(0.5 * tail))),
    )


def init(design: SingleTickDesign, t: float) -> SingleTickState:
    """Initial state at Unix time t, s; the observer starts at the first frame and trusts all meters."""
    p = design.noise.size
    never = np.full(p, design.options.release, dtype=np.intp)
    return SingleTickState(front_init(design.front, t), no_counts(p), never, None)


# --- Step ---


def step(
    design: SingleTickDesign, state: SingleTickState, frame: Frame
) -> tuple[SingleTickState, Estimate, Verdict]:
    """Process one frame.

    A frame that is not later than the last one changes nothing: it repeats the last estimate, with UNDECIDED.
    """
    front, given = design.front, state.front
    answered = repeated(front, given, frame)
    if answered is not None:
        return state, *answered
    trusted = given.trust.trusted
    history, frame = without_shifted_busbar(
        front, given.busbar_history, plausible(front, frame), trusted, given.v0_squared
    )
    tick = _decoded(design, state, frame, trusted)
    driving = tick.possible & front.drives & trusted
    if any_of(driving):
        # The injections follow these readings, and the residuals of all other meters follow the injections.
        tick = _decoded(design, state, frame, trusted & ~driving)
    left = _left(front, tick, (state.since < design.options.release) | tick.possible)
    tally, since = _counted(design, state, tick, left)
    suspect = since < design.options.release
    estimate = _estimate(design, tick, left)
    answer = _verdict(design, tick, left, (tally.named, suspect), estimate)
    after = ~suspect
    now, new = tick.predicted, trusted & ~after
    given = changed(
        _trusting(given, after),
        t=frame.t,
        frame=frame,
        ticks=given.ticks + 1,
        x=now.x,
        transient=now.transient,
        model_driven=now.model_driven,
        # Earlier false readings have driven these inverters.
        injection_error=now.injection_error.reset(front.inverters_of(new)),
        v0_squared=tick.measured.v0_squared,
        uncertainty=tick.uncertainty,
        clock_skew=tick.skew,
        busbar_history=history,
        last=(estimate, answer),
    )
    return SingleTickState(given, tally, since, tick.whole), estimate, answer


def _trusting(given: FrontState, trusted: Bools) -> FrontState:
    """Front end with inverters that follow the `trusted` meters (p,)."""
    if np.array_equal(given.trust.trusted, trusted):
        return given
    return changed(given, trust=replace(given.trust, trusted=trusted))


@dataclass(frozen=True, slots=True, eq=False)
class _Tick:
    """One frame by one prediction, decoded. p meters."""

    measured: Measurements
    predicted: Prediction
    uncertainty: FrameUncertainty
    skew: ClockSkew | None  # changes of the voltages within clock offsets; None while no offset is measured
    m: Floats  # (p,) innovations, squared pu; 0 without a reading
    limits: Limits
    whole: Posterior  # posterior of all meters with a reading
    answers: tuple[DecoderAnswer, ...]  # best first; empty if the decoder finds no solution

    @property
    def possible(self) -> Bools:
        """Meters that some answer accuses, (p,)."""
        out = np.zeros(self.m.size, dtype=np.bool_)
        for answer in self.answers:
            out = out | answer.meters
        return out

    @property
    def common(self) -> Bools:
        """Meters that every answer accuses, (p,)."""
        out = self.possible
        for answer in self.answers:
            out = out & answer.meters
        return out


def _decoded(design: SingleTickDesign, state: SingleTickState, frame: Frame, trusted: Bools) -> _Tick:
    """Prediction with inverters driven by the `trusted` meters (p,), and the decoder's answers."""
    front, given = design.front, state.front
    measured = measurements(front, frame, trusted, given.busbar.trusted, given.v0_squared)
    available = measured.available
    uncertainty = update_uncertainty(front, given.uncertainty, frame, available, measured.busbar_metered)
    predicted = predict(front, _trusting(given, trusted), measured, uncertainty.sizes)
    v2, noise, skew = predicted.v2_bus[front.prior.meters], design.noise, given.clock_skew
    if skew is not None or frame.clock_offset is not None:
        skew = update_skew(front, skew, frame.clock_offset, measured, v2)
    if skew is not None:
        noise = noise + skew.change**2
    whole = _posterior(state.whole, _prior(front, state, uncertainty), noise, available)
    model = _model_error(front, predicted.powers) + predicted.transient
    limits = Limits(design.options.sigmas, model, front.allowed, front.fixed)
    m, most = np.where(available, measured.y - v2, 0.0), front.most_among(int(np.count_nonzero(available)))
    try:
        answers = design.decoder(DecoderInput(whole, m, available, limits, most))
    except DesignInfeasible:
        # A solver without a solution is no evidence, neither for nor against a meter.
        answers = ()
    return _Tick(measured, predicted, uncertainty, skew, m, limits, whole, answers)


def _prior(front: FrontDesign, state: SingleTickState, now: FrameUncertainty) -> Prior:
    """Prior of the frame: that of the last one where its powers and busbar are known alike."""
    before = state.front.uncertainty
    if state.whole is not None and now.knows_as(before):
        return state.whole.prior
    return frame_prior(front, now)


def _posterior(before: Posterior | None, prior: Prior, noise: Floats, trusted: Bools) -> Posterior:
    """Posterior of the meters `trusted` (p,); the one before where it is the same."""
    if before is None or before.prior is not prior or not np.array_equal(before.trusted, trusted):
        return condition(prior, noise, trusted)
    return before if np.array_equal(before.noise, noise) else condition(prior, noise, trusted)


def _model_error(front: FrontDesign, powers: PowerErrors) -> Floats:
    """Largest error of the loss-corrected model at each meter, (p,), squared pu."""
    plant = front.plant
    with np.errstate(all="ignore"):
        error = plant.feeder.model_error_bound(powers.frame.p, powers.q, powers.v0_squared)[plant.meters]
    # Towards voltage collapse the bound is infinite.
    return np.where(error < NO_VOLTAGE, error, NO_VOLTAGE)


# --- Evidence of the meters that are left ---


@dataclass(frozen=True, slots=True, eq=False)
class _Left:
    """Posterior of the meters without any accusation. n buses, p meters, b busbar phases."""

    suspect: Bools  # (p,) accused meters
    posterior: Posterior  # posterior of all other meters with a reading
    loo: LeaveOneOut  # leave-one-out residuals of all meters
    limit: Floats  # (p,) largest honest residual, squared pu
    beyond: Bools  # (p,) readings beyond their limit
    supported: Bools  # (p,) readings beyond their limit also by the meters with a known power
    added: Floats  # (n,) variance by meters without a known power, squared pu^2
    misfit: bool  # the meters together disagree with the feeder beyond chance
    phases: Bools  # (b,) phases of the busbar with a reading that explains all others if it is false
    worse: Floats  # (b,) misfit of these above that of the posterior, 1

    @property
    def fits(self) -> bool:
        """True where the meters agree with the feeder."""
        return not (self.misfit or any_of(self.beyond & self.posterior.trusted))


def _left(front: FrontDesign, tick: _Tick, suspect: Bools) -> _Left:
    """Tests without the meters `suspect` (p,)."""
    whole, m, limits, available = tick.whole, tick.m, tick.limits, tick.measured.available
    now = _posterior(whole, whole.prior, whole.noise, whole.trusted & ~suspect)
    loo = leave_one_out(now, m)
    limit = limits.limit(loo.std)
    beyond = available & (np.abs(loo.residual) > limit)
    supported, added = beyond, np.zeros(now.variance.size)
    vouched = tick.uncertainty.vouched
    if any_of(now.trusted & ~vouched):
        # A reading beside an unread power has no check of its own.
        beside = condition(now.prior, now.noise, now.trusted & vouched)
        other = leave_one_out(beside, m)
        supported = beyond & (np.abs(other.residual) > limits.limit(other.std))
        added = np.maximum(beside.variance - now.variance, 0.0) + (loo.mean - other.mean) ** 2
    misfit, worse = misfits(now, loo, limits), np.zeros(front.busbar_incidence.shape[1])
    phases = np.zeros(worse.size, dtype=np.bool_)
    if misfit or any_of(tick.possible) or any_of(beyond):
        phases, worse = _false_busbar(front, tick, loo.chi_square)
    return _Left(suspect, now, loo, limit, beyond, supported, added, misfit, phases, worse)


def _false_busbar(front: FrontDesign, tick: _Tick, least: float) -> tuple[Bools, Floats]:
    """Phases of the busbar with a reading that explains all others if it is false, and their misfits, (b,).

    The busbar voltage of the phase counts as unmetered. All meters are then within their limits, and together
    as well. The busbar voltage by the meters is further from the reading than an honest error. The misfit
    exceeds that of the meters that are left, `least`, by at most ``2 log RIVAL_RATIO``. The misfits are given
    above `least`.
    """
    plant, metered = front.plant, np.atleast_1d(tick.measured.busbar_metered)
    rivals, worse = np.zeros(metered.size, dtype=np.bool_), np.zeros(metered.size)
    whole, m, limits = tick.whole, tick.m, tick.limits
    honest = np.atleast_1d(busbar_errors(plant, tick.measured.v0_squared, limits.sigmas))
    for k in np.flatnonzero(metered).tolist():
        level = plant.feeder.broadcast_busbar(np.where(np.arange(metered.size) == k, UNMETERED, 0.0))
        now = condition(_with_direction(whole.prior, level), whole.noise, whole.trusted)
        loo = leave_one_out(now, m)
        worse[k] = loo.chi_square - least
        beyond = any_of(whole.trusted & (np.abs(loo.residual) > limits.limit(loo.std)))
        false = abs(loo.mean[plant.feeder.busbar_places()][k]) > honest[k]
        likely = worse[k] <= 2.0 * np.log(RIVAL_RATIO)
        rivals[k] = false and likely and not beyond and not misfits(now, loo, limits)
    return rivals, worse


def _with_direction(prior: Prior, direction: Floats) -> Prior:
    """``S + d d^T``: the prior with an unknown direction d (n,) times its standard deviation, squared pu."""
    more = np.multiply.outer(direction, direction[prior.meters])
    return Prior(prior.covariance + more, prior.meters, prior.variance + direction**2)


def _counted(
    design: SingleTickDesign, state: SingleTickState, tick: _Tick, left: _Left
) -> tuple[Counters, Ints]:
    """Counters after the accusations of a tick, and readings since an answer accused each meter, (p,).

    An accusation that some rival does without counts neither for nor against a meter; a named one stays
    named while any answer accuses it.
    """
    options, named, possible = design.options, state.tally.named, tick.possible
    certain = left.supported & tick.common
    if any_of(left.phases):
        certain = np.zeros_like(certain)
    over, read = certain | (possible & named), tick.measured.available
    if not tick.answers:
        read = np.zeros_like(read)
    tally = count(
        state.tally, over, read & (over | ~possible), confirm=options.confirm, release=options.release
    )
    return tally, np.where(possible, 0, state.since + read)


# --- Estimate ---


def _estimate(design: SingleTickDesign, tick: _Tick, left: _Left) -> Estimate:
    """Voltages by the model and the meters that are left."""
    front, measured, predicted = design.front, tick.measured, tick.predicted
    plant, trusted = front.plant, left.posterior.trusted
    first, metered = plant.feeder.busbar_places(), np.atleast_1d(measured.busbar_metered)
    v2_bus, variance = predicted.v2_bus + left.loo.mean, left.posterior.variance + left.added
    v2_bus[first] = np.where(metered, measured.v0_squared, v2_bus[first])
    # This is a reading; the posterior of the others does not lower its variance.
    variance[first] = np.maximum(variance[first], np.where(metered, front.busbar**2, 0.0))
    inputs = BoundInputs(
        plant=plant,
        # Customers of accused meters may report false powers.
        powers=changed(predicted.powers, trusted=~left.suspect),
        injected=predicted.injection_error.error,
        model=predicted.v2_bus[plant.feeder.bus],
        busbar=metered & left.fits & ~left.phases,
        y=measured.y,
        trusted=trusted,
        # Where the readings disagree, none of them bounds a voltage, that of the busbar included.
        checked=partial(checked, front, measured.frame) if left.fits else partial(np.zeros_like, trusted),
        sigmas=design.options.sigmas,
    )
    return BoundedEstimate.of(inputs, measured.frame.t, v2_bus, variance, predicted.x)


# --- Verdict ---


def _verdict(
    design: SingleTickDesign, tick: _Tick, left: _Left, accused: tuple[Bools, Bools], estimate: Estimate
) -> Verdict:
    """Verdict of a tick; accused: named and suspect meters, (p,) each."""
    front, measured, named = design.front, tick.measured, accused[0]
    residual, busbar = np.abs(left.loo.residual), front.busbar_incidence.shape[1]
    finding = _of_meters(design, tick, left, *accused)
    finding = _unsolved(tick, finding)
    rivals = _rivals(design, tick, left)
    if rivals and finding[1] in (Cause.AGREEMENT, Cause.AMBIGUOUS):
        finding = Decision.UNDECIDED, Cause.AMBIGUOUS, explanations_sentence(front, rivals)
    finding = _unexplained(left, finding)
    if finding[0] is Decision.CLEAN:
        finding = unvouched(front, np.atleast_1d(measured.busbar_metered), left.posterior.trusted) or finding
    if finding[0] is Decision.CLEAN and measured.frame.p_origin is not None:
        unread = ~tick.uncertainty.vouched & measured.available
        finding = imprecise(front, measured.frame, unread, estimate) or finding
    off = measured.y - estimate.v2_bus[front.prior.meters]
    return Verdict(
        *with_clock_offsets(front, measured.frame, measured.available, tick.skew, finding),
        named,
        np.where(measured.available, residual, np.nan),
        left.limit,
        np.where(named & measured.available, off, 0.0),
        explanations=rivals,
        # The busbar's meter is a rival and never named: all meters of its phase explain as much.
        busbar=np.zeros(busbar, dtype=np.bool_),
        busbar_attack=np.zeros(busbar),
    )


def _of_meters(design: SingleTickDesign, tick: _Tick, left: _Left, named: Bools, suspect: Bools) -> Finding:
    """Verdict on the meters; named, suspect: (p,)."""
    front, available = design.front, tick.measured.available
    settled = all_of(tick.predicted.transient <= design.options.settled * left.limit)
    finding = decide(
        DecisionInputs(
            names=front.names,
            max_attacked=front.most_among(int(np.count_nonzero(available))),
            live=available,
            suspected=suspect | left.beyond,
            named=named,
            wide=available & ~(left.limit <= design.options.widest),
            valid=True,
            settled=settled,
            # A missing busbar voltage is an unknown of the prior, see `unvouched`.
            busbar=True,
        )
    )
    more = int(np.count_nonzero(left.beyond & ~named))
    if finding[1] is not Cause.RESIDUALS or not more:
        return finding
    if int(np.count_nonzero(named)) + more <= front.max_attacked:
        return finding
    sentence = (
        f"{finding[2][:-1]}; but so are {more} of the others, and at most {front.max_attacked} can be told "
        "apart."
    )
    return Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS, sentence


def _unsolved(tick: _Tick, finding: Finding) -> Finding:
    """UNDECIDED where the decoder finds no solution."""
    if tick.answers or finding[0] is not Decision.CLEAN:
        return finding
    return Decision.UNDECIDED, Cause.AMBIGUOUS, "The decoder finds no solution for the readings of this tick."


def _rivals(design: SingleTickDesign, tick: _Tick, left: _Left) -> tuple[Explanation, ...]:
    """Answers beside each other, likeliest first: sets of meters, or the meter of a busbar phase.

    Their probabilities are in the ratio of the likelihoods of their misfits.
    """
    none, no_phase = np.zeros(left.beyond.size, dtype=np.bool_), np.zeros_like(left.phases)
    sets = [answer for answer in tick.answers if left.fits and any_of(answer.meters)]
    every = [(answer.worse, answer.meters, no_phase) for answer in sets]
    every += [
        (float(left.worse[k]), none, np.arange(no_phase.size) == k)
        for k in np.flatnonzero(left.phases).tolist()
    ]
    if len(every) < 2 and not any_of(left.phases):
        return ()
    every.sort(key=lambda each: each[0])
    weight = np.exp(-0.5 * np.array([each[0] - every[0][0] for each in every]))
    inverters = np.zeros(design.plant.droop.tau.size, dtype=np.bool_)
    pairs = zip(every, (weight / weight.sum()).tolist(), strict=True)
    return tuple(Explanation(meters, inverters, chance, busbar=phase) for (_, meters, phase), chance in pairs)


def _unexplained(left: _Left, finding: Finding) -> Finding:
    """UNDECIDED where the meters that are left disagree with the feeder."""
    decision, cause, reason = finding
    if not left.misfit:
        return finding
    if decision is Decision.ATTACKED:
        return decision, cause, f"{reason} The other meters, taken together, still disagree with the feeder."
    if cause is not Cause.AGREEMENT:
        return finding
    sentence = "The meters, taken together, disagree with the feeder by more than chance."
    return Decision.UNDECIDED, Cause.MISFIT, sentence
