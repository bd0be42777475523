"""Estimator `modal`: the statistical core as a monitor of a feeder.

    design(plant, doubt=..., step_s=...) -> ModalDesign
    init(design, t) -> ModalState
    step(design, state, frame) -> (ModalState, Estimate, Verdict)

A step, by module:

    front.measurements, observer    front end: plausibility, observer of the inverters with its certificate,
                                    loss-corrected voltages by the model
    drive                           inverters without readings that jump or are accused
    doubts                          directions that the frame leaves unknown
    core                            filter, detector, search, masking
    verdict                         evidence of each meter, decision, explanations

The residual of a meter is its squared reading less the model; fixed errors are states of the filter.
Registers err in proportion to v2: with b at 1 pu, ``b (v2 - 1)`` by the mean of b before the tick is no part
of the residual. A meter is named when one search names it as the only fault with two readings, when
searches in turn accuse it, when it repeats its readings beyond chance, or when it reads more than a voltage
can be. Others of its explanation may delay it (`naming`). Named meters are masked from the onset on, and
released by their readings (`masking`). The busbar's meter is named by searches in turn. Its phase then counts
as not metered, until both agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed
from gridsec.estimators.front import design as front_design
from gridsec.estimators.front import init as front_init
from gridsec.estimators.front import meter_bias
from gridsec.estimators.front import state as front_state
from gridsec.estimators.front.attack_kind import AttackKinds, classify, ingest, repeat_lags
from gridsec.estimators.front.design import FrontDesign, FrontOptions
from gridsec.estimators.front.device_checks import (
    BusbarTrust,
    InverterChecks,
    ReportedPowers,
    check_inverters,
    track_busbar,
)
from gridsec.estimators.front.measurements import (
    Measurements,
    checked,
    impossible,
    measurements,
    plausible,
    update_skew,
    update_uncertainty,
    without_shifted_busbar,
)
from gridsec.estimators.front.meter_bias import (
    Commission,
    Learned,
    Learning,
    LearningProgress,
    LearningTick,
    gather,
    ready_meters,
    usable,
)
from gridsec.estimators.front.output import BoundInputs
from gridsec.estimators.front.posterior import UNMETERED, LoadDoubt
from gridsec.estimators.front.reading_history import forget_readings
from gridsec.estimators.front.state import (
    FrontState,
    InjectionError,
    ObserverRecord,
    Prediction,
    SuspicionRecord,
)
from gridsec.estimators.modal import classes, core, doubts, drive, full, masking, record, verdict
from gridsec.estimators.modal.core import Core, CoreState, Suspicion
from gridsec.estimators.modal.detector import Evidence
from gridsec.estimators.modal.doubts import Movements, Unknown
from gridsec.estimators.modal.estimate import Reconstructed, Spread
from gridsec.estimators.modal.naming import CONFIRM, YOUNG, alone, final, unseen
from gridsec.estimators.modal.record import Record
from gridsec.estimators.modal.search import DOUBT
from gridsec.estimators.plant import Plant
from gridsec.interface import Estimate, Frame, Verdict
from gridsec.observers.certificates import Certificate

LOOKS = 16
"""Searches per age of the suspected onset: explanations change ever more slowly."""
SETTLING = 32
"""Largest number of ticks at the start of a run that the core gives up for complete readings."""
HELD = 8
"""Readings from a jump on for which the verdict is open: log M is evaluated twice in them."""
PAUSE = 60.0
"""Ticks without a frame that count as a pause for the time of commissioning."""


@dataclass(frozen=True, slots=True, eq=False)
class ModalDesign:
    """Offline design. p meters.

    Attributes
    ----------
    front
        Design of the front end.
    core
        The statistical core.
    reach : (2 N,)
        Largest effect of each power on a meter, as in `doubts.reach`.
    negligible : (p,)
        Largest transient of the observer beside the error at which a reading stands out, squared pu.
    """

    front: FrontDesign
    core: Core
    reach: Floats = field(repr=False)
    negligible: Floats = field(repr=False)

    @property
    def plant(self) -> Plant:
        """The feeder."""
        return self.front.plant

    @property
    def options(self) -> FrontOptions:
        """Tuning parameters of the front end; rate of false alarms and time of commissioning of the whole."""
        return self.front.options

    @property
    def certificate(self) -> Certificate:
        """Certificate of the observer of the inverters."""
        return self.front.certificate

    @property
    def max_attacked(self) -> int:
        """Largest number of manipulated meters told apart."""
        return self.front.max_attacked

    @property
    def observers(self) -> int:
        """One observer for every trusted set."""
        return self.front.observers


def design(
    plant: Plant,
    *,
    doubt: LoadDoubt,
    step_s: float,
    options: FrontOptions | None = None,
    max_attacked: int | None = None,
    most: Floats | None = None,
) -> ModalDesign:
    """Design the monitor of a feeder.

    most: (N,) largest active powers that the customers can have, pu. Others as in
    `gridsec.estimators.front.design.design`, and its errors.
    """
    front = front_design(plant, doubt=doubt, step_s=step_s, options=options, max_attacked=max_attacked)
    made = core.design(front, most)
    stands_out = np.maximum(front.allowed, drive.JUMP * made.modes.noise_std)
    return ModalDesign(front, made, doubts.reach(front), front.options.settled * stands_out)


@dataclass(frozen=True, slots=True, eq=False)
class ModalState:
    """State between frames. p meters.

    Attributes
    ----------
    front
        State of the front end: observer, uncertainty, trust, time of commissioning, last output.
    core
        State of the core.
    suspicion
        Explanations of the last search, while they hold.
    streak : (p,)
        Searches in turn with each meter in the likeliest explanation, and replaced by no colluding ones.
    phases : (b,)
        Searches in turn that name each phase of the busbar with a meter.
    inverters : (m,)
        Searches in turn that name each inverter.
    due
        Number of the tick of the next search.
    kept, start
        Record of the learned errors, None before the first tick, and that at the start of the run.
    held : (p,)
        Ticks for which a reading that jumped, and drove no inverter, leaves the verdict open.
    injections
        Errors of the observed injections, as `drive` has them.
    fit
        Readings by the filter after the last tick.
    movements
        Movements of the powers up to the last frame; None before the first.
    unknown
        Directions that the last frame left unknown.
    """

    front: FrontState
    core: CoreState
    suspicion: Suspicion | None
    streak: Ints
    phases: Ints
    inverters: Ints
    due: int
    kept: Record | None
    start: Record | None
    held: Ints
    injections: InjectionError
    fit: drive.Fit
    movements: Movements | None = None
    unknown: Unknown | None = field(default=None, repr=False)

    @property
    def attack_kinds(self) -> AttackKinds:
        """Reading history and kinds of the manipulations."""
        return self.front.attack_kinds

    @property
    def commission(self) -> ModalCommission:
        """Learned errors and the time of commissioning."""
        return ModalCommission(self.front.learned, self.front.learning, self.kept)


@dataclass(frozen=True, slots=True, eq=False)
class ModalCommission(Commission):
    """Commissioning with the record of the filter."""

    kept: Record | None = field(default=None, repr=False)


def init(design: ModalDesign, t: float, commission: Commission | None = None) -> ModalState:
    """Initial state at Unix time t, s, with errors learned before."""
    known = commission or meter_bias.initial(design.front, t)
    before = known.kept if isinstance(known, ModalCommission) else None
    front = front_init(design.front, t, known.learned, known.learning)
    kernel, phases = design.core, design.core.faults
    begun = _begun(kernel, before, t)
    p = kernel.modes.size
    counts = np.zeros(phases.std.size - p - phases.powers, dtype=np.intp)
    none, inverters = np.zeros(p, dtype=np.intp), np.zeros(design.plant.droop.tau.size, dtype=np.intp)
    injections, fit = front.injection_error, drive.fitted(kernel, begun)
    return ModalState(front, begun, None, none, counts, inverters, 0, before, before, none, injections, fit)


def _begun(kernel: Core, before: Record | None, t: float) -> CoreState:
    """Core before its first reading at Unix time t, s, with the errors of a record."""
    begun = core.init(kernel, t)
    if before is None:
        return begun
    # Time may have been set back since the record.
    known = replace(before.filter, t=min(before.filter.t, t))
    parts = known, before.known, begun.detector, ()
    return replace(begun, filter=known, static=before.known, history=replace(begun.history, start=parts))


def step(design: ModalDesign, state: ModalState, frame: Frame) -> tuple[ModalState, Estimate, Verdict]:
    """Process one frame.

    A frame that is not later than the last one changes nothing: it repeats the last estimate, with UNDECIDED.
    """
    front, given = design.front, state.front
    repeated = front_state.repeated(front, given, frame)
    if repeated is not None:
        return state, *repeated
    false, frame = impossible(front, frame, given.trust.named)
    history, frame = without_shifted_busbar(
        front, given.busbar_history, plausible(front, frame), given.trust.trusted, given.v0_squared
    )
    measured = measurements(front, frame, given.trust.trusted, given.busbar.trusted, given.v0_squared)
    uncertainty = update_uncertainty(
        front, given.uncertainty, frame, measured.available, measured.busbar_metered
    )
    trusted = given.trust.trusted
    given, measured, predicted = drive.driven(
        front, design.core, state.core, given, measured, uncertainty, state.injections, state.fit
    )
    h, free = frame.t - given.t, front.inverters_of(~given.trust.trusted)
    injections = drive.followed(front, state.injections, given, predicted, free, h)
    held = state.held
    if given.trust.trusted is not trusted or any_of(held):
        jumps = trusted & ~given.trust.trusted
        held = np.where(jumps, HELD, np.maximum(held - measured.available, 0))
    v2 = predicted.v2_bus[front.prior.meters]
    last = None
    # A power that comes back is no step of the voltage.
    if given.model is not None and given.frame is not None and uncertainty.knows_as(state.front.uncertainty):
        last = given.model, given.frame
    skew = update_skew(front, given.clock_skew, frame.clock_offset, measured, v2, last=last)
    moved = doubts.earlier(front, skew)
    if skew is not None and moved is not None:
        wider = core.widened(design.core, state.core, moved)
        state, skew = _unsuspected(replace(state, core=wider)), skew.replayed
    kinds = ingest(front.references, given.attack_kinds, measured.y, measured.available)
    now = changed(
        given,
        uncertainty=uncertainty,
        model=v2,
        clock_skew=skew,
        busbar_history=history,
        attack_kinds=kinds,
        v0_squared=measured.v0_squared,
    )
    open_ = doubts.unknown(front, measured, uncertainty, injections.error, free, skew)
    jump, movements = doubts.jump(front, design.reach, state.movements, measured, h)
    seen, whole = measured.available, all_of(measured.available)
    m = measured.y - drive.expected(v2, state.fit.own)
    if not whole:
        m = np.where(seen, m, 0.0)
    kernel = _begun_anew(design, state, frame.t) if open_ is None and whole else state.core
    kernel, evidence = core.step(
        design.core,
        _without(kernel, (repeat_lags(kinds) > 0) | (false & measured.available)),
        frame.t,
        m,
        None if whole else seen,
        None if open_ is None else open_.wide,
        jump,
    )
    after = changed(state, front=now, core=kernel, movements=movements)
    after, evidence = _identified(design, after, evidence, measured.uses_q)
    if after.front.busbar is not now.busbar:
        # A phase named at this tick is not metered any more.
        metered = np.asarray(measured.busbar_metered) & after.front.busbar.trusted
        measured = replace(measured, busbar_metered=metered if metered.size > 1 else bool(metered[0]))
        open_ = doubts.unknown(front, measured, uncertainty, injections.error, free, skew)
    tick = _Tick(measured, predicted, injections, open_, evidence, m, held)
    return _answered(design, after, tick)


@dataclass(frozen=True, slots=True, eq=False)
class _Tick:
    """One tick after the core."""

    measured: Measurements
    predicted: Prediction
    injections: InjectionError
    unknown: Unknown | None
    evidence: Evidence
    m: Floats  # (p,) residuals, 0 without a reading
    held: Ints  # (p,) ticks for which a reading that jumped leaves the verdict open


def _begun_anew(design: ModalDesign, state: ModalState, t: float) -> CoreState:
    """Core at the first complete tick: the few ticks before it are not worth a full covariance."""
    kernel = state.core
    early = 0 < state.front.ticks <= SETTLING and kernel.filter.full is not None
    if not early or any_of(kernel.masked.meters) or any_of(kernel.detector.pinned):
        return kernel
    return _begun(design.core, state.kept, t)


def _without(state: CoreState, which: Bools) -> CoreState:
    """Core with meters masked by their readings alone, (p,); their release begins anew."""
    return replace(state, masked=masking.added(state.masked, which)) if any_of(which) else state


# --- Identification ---


def _identified(
    design: ModalDesign, state: ModalState, evidence: Evidence, uses_q: Bools
) -> tuple[ModalState, Evidence]:
    """State after a search, if one is due, with the confirmed meters masked."""
    kernel, tick = design.core, state.front.ticks
    suspicion, pinned = state.suspicion, state.core.detector.pinned
    models = max(1, len(state.core.rivals))
    if suspicion is not None and not (pinned[suspicion.row] and len(suspicion.found.problems) == models):
        suspicion = None
    if not any_of(pinned):
        return _unsuspected(state), evidence
    if tick < state.due or not core.alarmed(kernel, evidence):
        return replace(state, suspicion=suspicion), evidence
    now, found = _searched(kernel, state.core, evidence, suspicion)
    over = core.passed(kernel, now, found)
    if over is not None:
        return _unsuspected(replace(state, core=over[0])), over[1]
    return _named(design, replace(state, core=now, suspicion=suspicion), found, evidence, uses_q)


def _named(
    design: ModalDesign, state: ModalState, suspicion: Suspicion, evidence: Evidence, uses_q: Bools
) -> tuple[ModalState, Evidence]:
    """State after a search with explanations, with the confirmed meters masked."""
    kernel, tick, masked = design.core, state.front.ticks, state.core.masked.meters
    age = int(state.core.detector.onsets.age[suspicion.row])
    named = suspicion.found.named & ~masked
    streak = np.where(suspicion.accused[: named.size], state.streak + 1, 0)
    certain = verdict.certain_phases(kernel, suspicion) & suspicion.fits
    phases = np.where(certain, state.phases + 1, 0)
    certain = verdict.certain_inverters(design.front, kernel, suspicion, uses_q) & suspicion.fits
    inverters = np.where(certain, state.inverters + 1, 0)
    # A fault with a first naming is searched again at the next tick.
    first = any((each == 1).any() for each in (streak[named], phases, inverters))
    wait = 1 if first else max(1, age // LOOKS)
    due, earlier = tick + wait, suspicion.earlier(state.suspicion)
    after = replace(state, suspicion=suspicion, streak=streak, phases=phases, inverters=inverters, due=due)
    since = () if any_of(masked) else state.core.history.readings[-age:]
    settled = suspicion.settled or age <= YOUNG
    sure = final(suspicion.found, earlier, named, streak, since, kernel.near.laterals, settled=settled)
    if suspicion.fits and not any_of(sure):
        # Masked meters alone may have been manipulated before they were masked.
        sure = alone(suspicion.found, masked)
    skew = state.front.clock_skew
    if skew is not None and state.core.spell <= skew.wait:
        off = core.amounts(kernel, state.core, suspicion)[: named.size]
        if unseen(design.front, kernel.effect, kernel.bound / core.MOST_POWER, skew.lead, off):
            return after, evidence
    if any_of(sure):
        found = replace(suspicion.found, named=sure)
        now, evidence = core.mask(kernel, state.core, replace(suspicion, found=found))
        return replace(after, core=now, suspicion=None, streak=0 * streak, due=tick + 1), evidence
    if any_of(phases >= CONFIRM):
        return _without_busbar(design, after, suspicion, phases >= CONFIRM)
    faulty = suspicion.found.chosen.any(axis=1)
    if float(suspicion.found.weight[faulty].sum()) < DOUBT:
        # Loads have changed, and no explanation of weight has a false reading of any kind.
        adopted = core.adopt(kernel, state.core, suspicion)
        if adopted is not state.core:
            return replace(after, core=adopted, suspicion=None), evidence
    return after, evidence


def _searched(
    kernel: Core, state: CoreState, evidence: Evidence, before: Suspicion | None
) -> tuple[CoreState, Suspicion]:
    """Explanations, with a transition as a rival where that settles the misfit."""
    suspicion = core.identify(kernel, state, evidence, before)
    with_transition = core.transition(kernel, state, suspicion)
    if with_transition is not state:
        beside = core.identify(kernel, with_transition, evidence, suspicion)
        # A transition takes the evidence of a single false reading away.
        if beside.settled or not suspicion.fits:
            return with_transition, beside
    return state, suspicion


def _unsuspected(state: ModalState) -> ModalState:
    """State without a suspicion and without the counts of searches."""
    if state.suspicion is None and not state.due:
        return state
    zero = 0 * state.streak, 0 * state.phases, 0 * state.inverters
    return replace(state, suspicion=None, streak=zero[0], phases=zero[1], inverters=zero[2], due=0)


def _without_busbar(
    design: ModalDesign, state: ModalState, suspicion: Suspicion, which: Bools
) -> tuple[ModalState, Evidence]:
    """State without the readings of some phases of the busbar since the onset.

    which: phases among those with a meter. The kept readings are replayed with a busbar voltage that is
    unknown from the onset on. Where the run has no more ticks before the onset than since, the filter begins
    at the first kept reading with the record at the start of the run, and the busbar is unknown at all of
    them: errors learned beside a false busbar would be those of the meters.
    """
    kernel, modes = state.core, design.core.modes
    H = modes.model.phases(modes.at)
    named = np.zeros(H.shape[1], dtype=np.bool_)
    named[H.any(axis=0)] = which
    columns = doubts.WIDER * UNMETERED * H[:, named]
    count, age = len(kernel.history.readings), int(kernel.detector.onsets.age[suspicion.row])
    first = count - age
    if 2 * age > state.front.ticks:
        # Records of this run have the same errors.
        state = replace(state, kept=state.start)
        readings = kernel.history.readings
        anew = _begun(design.core, state.kept, readings[0][0])
        kernel, first = replace(kernel, history=replace(anew.history, readings=readings)), 0
    now, evidence = core.beside_unknown(design.core, kernel, first, (count - first) * [columns])
    after = replace(
        state,
        front=changed(state.front, busbar=state.front.busbar.suspecting(named)),
        core=now,
        suspicion=None,
        phases=0 * state.phases,
        due=state.front.ticks + 1,
    )
    return after, evidence


# --- Estimate and verdict ---


def _answered(design: ModalDesign, state: ModalState, tick: _Tick) -> tuple[ModalState, Estimate, Verdict]:
    """State, estimate and verdict after a tick."""
    front, kernel, now = design.front, state.core, state.front
    named, seen, beyond = kernel.masked.meters, tick.measured.available, kernel.exceeding
    suspected = any_of(kernel.detector.pinned)
    doubtful = suspected or any_of(beyond)
    trust = _trust(design, now, named, state.suspicion)
    # While the readings disagree and no search has settled it, no reading bounds a voltage.
    unsure = doubtful or _hidden(kernel, tick.unknown)
    sure = np.zeros_like(seen) if unsure else trust.trust.trusted & seen
    estimate, spread = _estimate(design, state if trust is now else changed(state, front=trust), tick, sure)
    busbar = _busbar(design, now, tick, estimate, spread)
    evidence = verdict.meter_evidence(
        design.core, kernel, tick.evidence, (tick.m, seen), front.options.widest, state.suspicion
    )
    rivals = verdict.explanations(front, design.core, state.suspicion, tick.measured.uses_q)
    checks = _checked_inverters(design, state, trust, tick)
    inverters = state.inverters >= CONFIRM
    if not checks.idle:
        inverters = (inverters & ~checks.consistent(front)) | checks.named(front)
    given = verdict.Inputs(
        frame=tick.measured.frame,
        skew=now.clock_skew,
        seen=seen,
        named=named,
        unread=np.zeros(seen.size, dtype=np.bool_) if tick.unknown is None else tick.unknown.unchecked,
        jumps=tick.held > 0,
        beyond=beyond,
        evidence=evidence,
        suspected=suspected,
        explanations=rivals,
        suspicion=state.suspicion,
        settled=all_of(tick.predicted.transient <= design.negligible),
        inverters=inverters,
        busbar=busbar.named,
        metered=now.busbar.trusted & tick.measured.busbar_metered,
        busbar_off=np.where(busbar.named, busbar.off, 0.0),
    )
    kinds = _kinds(design, state, tick, estimate, named)
    finding = verdict.verdict(front, given, estimate)
    open_cases = checks.explanations(front, named)
    answer = verdict.Answer.later(
        verdict.with_open_cases(front, finding, open_cases),
        named,
        evidence.amounts,
        _attack(design, state, tick, estimate, named),
        inverters=inverters,
        inverter_attack=_injected(design, state, checks, inverters),
        kinds=kinds.kinds,
        explanations=verdict.combined(rivals, open_cases, inverters) if suspected else open_cases,
        unjudged=front.inverter_undetectable & ~(checks.observable | inverters),
        busbar=given.busbar,
        busbar_attack=given.busbar_off,
    )
    calm = not (doubtful or any_of(named) or any_of(~busbar.trusted))
    kept = (
        record.kept(design.core.modes, state.kept, kernel.filter, kernel.static, now.ticks) if calm else None
    )
    learning = _gathered(design, trust, tick, suspected=doubtful)
    error, injections = tick.predicted.injection_error, tick.injections
    if trust is not now:
        # A false reading has driven the inverters of meters that lose their trust.
        fed = front.inverters_of(now.trust.trusted & ~trust.trust.trusted)
        error, injections = error.reset(fed), injections.reset(fed)
    after = changed(
        trust,
        t=tick.measured.frame.t,
        frame=tick.measured.frame,
        ticks=now.ticks + 1,
        x=tick.predicted.x,
        transient=tick.predicted.transient,
        model_driven=tick.predicted.model_driven,
        injection_error=error,
        inverter_checks=checks,
        attack_kinds=kinds,
        busbar=busbar,
        learning=learning,
        last=(estimate, answer),
    )
    mean = (estimate.v2_bus - tick.predicted.v2_bus)[front.prior.meters]
    out = changed(
        state,
        front=after,
        kept=kept or state.kept,
        held=tick.held,
        injections=injections,
        unknown=tick.unknown,
        fit=drive.fitted(design.core, kernel, state.fit, now.ticks, None if state.suspicion else mean),
    )
    return (out if learning is None else _learned(design, out)), estimate, answer


def _hidden(kernel: CoreState, unknown: Unknown | None) -> bool:
    """Meters that collude with suspected or named ones may hide behind powers without a reading."""
    open_ = unknown is not None and any_of(unknown.unchecked)
    return open_ and (any_of(kernel.detector.pinned) or any_of(kernel.masked.meters))


def _doubtful(kernel: CoreState) -> bool:
    """The readings disagree, or a meter exceeds its class: nothing is learned, and no reading is a bound."""
    return any_of(kernel.detector.pinned) or any_of(kernel.exceeding)


def _trust(design: ModalDesign, now: FrontState, named: Bools, suspicion: Suspicion | None) -> FrontState:
    """Front end that trusts all meters but those that are named or that a likely explanation accuses."""
    trust, out = now.trust, named
    if suspicion is None and trust.clear and not any_of(named):
        return now
    if suspicion is not None:
        out = named | verdict.accused(design.core, suspicion)
    if np.array_equal(trust.named, named) and np.array_equal(trust.trusted, ~out):
        return now
    return changed(now, trust=replace(trust, trusted=~out, named=named))


def _busbar(
    design: ModalDesign, now: FrontState, tick: _Tick, estimate: Estimate, spread: Callable[[], Floats]
) -> BusbarTrust:
    """Trust of the busbar's meter: a named phase is compared with the estimate until both agree."""
    if all_of(now.busbar.trusted):
        return now.busbar
    measured, front = tick.measured, design.front
    first = front.plant.feeder.busbar_places()
    v0_squared, variance = estimate.v2_bus[first], np.atleast_1d(spread()[first])
    there = measured.busbar_available & np.isfinite(variance)
    return track_busbar(front, now.busbar, measured.busbar_reading, there, v0_squared, variance)


def _estimate(
    design: ModalDesign, state: ModalState, tick: _Tick, sure: Bools
) -> tuple[Estimate, Callable[[], Floats]]:
    """Voltages by the model and the core, with standard deviation and bound, and the variance, (n,).

    sure: (p,) meters with a reading that bounds a voltage.
    """
    front, kernel, measured = design.front, design.core, tick.measured
    plant, now = front.plant, state.front
    errors = core.estimate(kernel, state.core, state.suspicion)
    mean, whole, more, metered = errors.mean, state.core.filter.full, None, measured.busbar_metered
    if tick.unknown is not None and whole is not None:
        read, hidden = whole.seen, _hidden(state.core, tick.unknown)
        rest = tick.m - whole.mean.sum(axis=0) if errors.rest is None else errors.rest
        if state.suspicion is not None:
            read = read & ~verdict.accused(kernel, state.suspicion)
        noise = kernel.modes.noise + whole.whole
        off, more = doubts.estimated(noise, tick.unknown, rest, read, hidden=hidden)
        mean = mean + off
    v2_bus, first = tick.predicted.v2_bus + mean, plant.feeder.busbar_places()
    least: Floats | float = front.busbar**2
    if all_of(np.asarray(metered)):
        v2_bus[first] = measured.v0_squared
    else:
        v2_bus[first] = np.where(metered, measured.v0_squared, v2_bus[first])
        least = np.where(metered, least, 0.0)
    spread = Spread(errors, 0.0 if more is None else more, first, least)
    powers = tick.predicted.powers
    inputs = BoundInputs(
        plant=plant,
        powers=powers if powers.trusted is now.trust.trusted else changed(powers, trusted=now.trust.trusted),
        injected=tick.predicted.injection_error.error,
        model=tick.predicted.v2_bus[plant.feeder.bus],
        busbar=verdict.bounding(kernel, state.core, state.suspicion, metered),
        y=measured.y,
        trusted=sure,
        checked=partial(checked, front, measured.frame),
        sigmas=front.sigmas,
    )
    # A named phase of the busbar is compared with the variance of an explained estimate.
    stated = replace(spread, scale=errors.beyond)
    return Reconstructed.later(inputs, measured.frame.t, v2_bus, stated, tick.predicted.x), spread


def own_errors(design: ModalDesign, state: CoreState) -> Floats:
    """Posterior means of the meters' own fixed errors, (p,), squared pu at 1 pu.

    Parameters
    ----------
    design, state
        The design, and the state of the core.
    """
    kernel = design.core
    return classes.means(kernel.classes, kernel.modes, state.filter, state.static)


def _attack(design: ModalDesign, state: ModalState, tick: _Tick, estimate: Estimate, named: Bools) -> Floats:
    """Reconstructed manipulations: readings of named meters less own error and estimate, (p,)."""
    if not any_of(named):
        return np.zeros(named.size)
    own = own_errors(design, state.core)
    off = tick.measured.y - (1.0 + own) * estimate.v2_bus[design.front.prior.meters]
    return np.where(named & tick.measured.available, off, 0.0)


def _checked_inverters(
    design: ModalDesign, state: ModalState, now: FrontState, tick: _Tick
) -> InverterChecks:
    """Comparison of metered reactive powers with the droop curves."""
    before, measured, front = now.inverter_checks, tick.measured, design.front
    if before.idle and not any_of(measured.reports_q):
        return before
    residual, std = verdict.deviations(design.core, state.core, tick.m)
    known = np.where(before.named(front), tick.predicted.injection_error.error, tick.injections.error)
    free = front.inverters_of(~now.trust.trusted)
    others = partial(doubts.unknown, front, measured, now.uncertainty, known, free, now.clock_skew)
    return check_inverters(
        front,
        before,
        ReportedPowers(
            measured.frame,
            measured.reports_q,
            measured.uses_q,
            measured.available & now.trust.trusted,
            tick.predicted.x,
            tick.predicted.injection_error.error,
            residual,
            std,
            partial(verdict.share, front, design.core, state.core),
            partial(verdict.unreported, front, design.core, state.core, tick.m, others, before.sure),
        ),
    )


def _injected(design: ModalDesign, state: ModalState, checks: InverterChecks, inverters: Bools) -> Floats:
    """Injections of named inverters beyond their curves, as metered where they are, (m,), pu."""
    if not any_of(inverters):
        return np.zeros(inverters.size)
    metered = checks.amounts(design.front)
    found = verdict.inverter_amounts(design.front, design.core, state.suspicion)
    return np.where(inverters, np.where(metered != 0.0, metered, found), 0.0)


def _kinds(
    design: ModalDesign, state: ModalState, tick: _Tick, estimate: Estimate, named: Bools
) -> AttackKinds:
    """Kinds of the named manipulations."""
    front, measured, kernel = design.front, tick.measured, state.core
    references, meters = front.references, front.plant.meters
    own = np.asarray(references.active * measured.frame.p[meters] + references.reactive * measured.q[meters])
    expected = estimate.v2_bus[front.prior.meters]
    variance = front.white
    if any_of(named):
        expected = (1.0 + own_errors(design, kernel)) * expected
        variance = verdict.deviations(design.core, kernel, tick.m)[1] ** 2
    return classify(references, state.front.attack_kinds, expected, own, named, variance)


# --- Commissioning ---


def _gathered(design: ModalDesign, now: FrontState, tick: _Tick, *, suspected: bool) -> Learning | None:
    """Time of commissioning after a tick; the errors themselves are states of the filter."""
    learning, front = now.learning, design.front
    if learning is None or not now.ticks:
        return learning
    frame, available = tick.measured.frame, tick.measured.available
    state = LearningTick(frame, available, now.trust.trusted, suspected, now.uncertainty)
    use, why = usable(front, learning, state)
    h = frame.t - now.t
    h = h if h <= PAUSE * front.step_s else front.step_s
    return gather(learning, tick.m, use, h, why)


def _learned(design: ModalDesign, state: ModalState) -> ModalState:
    """State with the errors of meters that have been read for the time of commissioning."""
    front, now = design.front, state.front
    gathered = now.learning
    if gathered is None or _doubtful(state.core):
        return state
    done = ready_meters(front, gathered) & gathered.open & now.trust.trusted & (gathered.count > 0)
    if not any_of(done):
        return state
    rest = gathered.open & ~done
    left = None
    if any_of(rest):
        left = replace(gathered, since=np.where(rest, gathered.since, np.nan))
    return replace(state, front=changed(now, learned=_errors(design, state, done), learning=left))


def _errors(design: ModalDesign, state: ModalState, done: Bools) -> Learned:
    """Fixed errors of the filter, for the meters `done` (p,)."""
    front, known, kernel = design.front, state.front.learned, state.core
    variance = classes.variances(design.core.classes, design.core.modes, kernel.filter, kernel.static)
    aging = front.options.stability * (front.allowed - front.rounded)
    allowed = np.minimum(aging + 3.0 * np.sqrt(variance) + front.rounded, front.allowed)
    bias = np.clip(own_errors(design, kernel), -front.allowed, front.allowed)
    return Learned(
        bias=np.where(done, bias, known.bias),
        variance=np.where(done, variance, known.variance),
        allowed=np.where(done, allowed, known.allowed),
        at=np.where(done, state.front.t, known.at),
        hidden=known.hidden,
    )


def renew(design: ModalDesign, state: ModalState, which: Bools) -> ModalState:
    """State after meters `which` (p,) were replaced: trusted again, with their errors to be learned.

    With K of `classes`, a meter's own error is ``K b + r``, r independent of readings. A new error
    in its place gives, with A the identity less the rows K of the replaced meters,

        b <- A b,   cov b <- A cov b A' + 2 diag(fixed) - K B K'     in their rows and columns.

    The evidence of all onsets is given up.
    """
    front, modes, kernel = design.front, design.core.modes, state.core
    known = meter_bias.renew(
        front, Commission(state.front.learned, state.front.learning), which, state.front.t
    )
    whole = kernel.filter.full or full.expanded(modes, kernel.filter, kernel.static)
    t, at = modes.size, np.flatnonzero(which)
    A, K = np.eye(2 * t), design.core.classes.own[at]
    A[t + at, t:] -= K
    cov, fixed = A @ whole.cov @ A.T, design.core.model.fixed[at]
    cov[np.ix_(t + at, t + at)] += 2.0 * np.diag(fixed) - K @ modes.covariance_b @ K.T
    mean = (A @ whole.mean.ravel()).reshape(2, t)
    blank = core.init(design.core, kernel.filter.t)
    opened = replace(kernel.filter, full=replace(whole.changed(mean, cov), complete=0))
    parts = opened, kernel.static, blank.detector
    masked = masking.without(kernel.masked, which)
    begun = replace(
        blank,
        filter=opened,
        static=kernel.static,
        update=kernel.update,
        history=replace(blank.history, start=(*parts, ())),
        masked=masked,
    )
    kinds = state.front.attack_kinds
    now = changed(
        state.front,
        learned=known.learned,
        learning=known.learning,
        inverter_checks=state.front.inverter_checks.without_meters(which),
        attack_kinds=replace(kinds, history=forget_readings(kinds.history, which)),
        trust=state.front.trust.replaced(which),
    )
    kept = record.made(modes, opened, kernel.static)
    return replace(
        state,
        front=now,
        core=begun,
        suspicion=None,
        streak=0 * state.streak,
        phases=0 * state.phases,
        inverters=0 * state.inverters,
        due=0,
        kept=kept,
        start=kept,
        held=np.where(which, 0, state.held),
        fit=drive.fitted(design.core, begun),
    )


def progress(design: ModalDesign, commission: Commission) -> LearningProgress:
    """State and reason of each meter's learning."""
    return meter_bias.progress(design.front, commission)


def to_arrays(design: ModalDesign, commission: Commission) -> dict[str, Floats]:
    """Persistent form of a commissioning: arrays of p numbers by name."""
    kept = commission.kept if isinstance(commission, ModalCommission) else None
    return meter_bias.to_arrays(commission) | record.to_arrays(design.core.modes, kept)


def from_arrays(design: ModalDesign, arrays: Mapping[str, Floats]) -> ModalCommission:
    """Commissioning from the arrays of `to_arrays`.

    Raises
    ------
    ValueError
        If the arrays do not fit the design; the message names every problem.
    """
    rest = {name: values for name, values in arrays.items() if not record.is_own(name)}
    known = meter_bias.from_arrays(design.front, rest)
    return ModalCommission(known.learned, known.learning, record.from_arrays(design.core.modes, arrays))


# --- Suspects over a restart ---


def distrusted(design: ModalDesign, state: ModalState) -> SuspicionRecord:
    """Suspects of a state after a tick."""
    return front_state.distrusted(design.front, state.front)


def warm_start(design: ModalDesign, state: ModalState, before: SuspicionRecord) -> ModalState:
    """State from `init` with the named meters of an earlier run: masked from the first reading on."""
    before = replace(before, scale_s=np.where(before.named, before.scale_s, np.nan))
    if before.is_empty:
        return state
    front = front_state.warm_start(design.front, state.front, before)
    return replace(
        state,
        front=front,
        core=replace(state.core, masked=masking.added(state.core.masked, ~front.trust.trusted)),
    )


# --- Observer over a restart ---


def observed(design: ModalDesign, state: ModalState) -> ObserverRecord | None:
    """Observer of a state, that of the front end."""
    return front_state.observed(design.front, state.front)


def resume(design: ModalDesign, state: ModalState, before: ObserverRecord) -> ModalState:
    """State from `init` with the observer of an earlier run, that of the front end.

    The injections have the errors of a pause: voltages stay between those at both ends of it.
    """
    front = front_state.resume(design.front, state.front, before)
    if front is state.front:
        return state
    error = front.injection_error
    return replace(state, front=front, injections=replace(error, width=0.0 * error.width))
