"""Output of one tick: estimate with its error, verdict with its reason, sentences for the operator.

The bound of the estimate covers all honest errors within their stated limits: an interval, not a probability.
Accuracy classes and power factors err in one direction for years, and all of them may err together. The
bound is a sum of worst cases:

    |v2 - model| <= 2 |R| dp + 2 |X| (dq + e) + losses + busbar      everywhere
    |v2 - y|     <= error of the reading                             at trusted meters

e is the error of the observed injections. Powers reported by customers of suspect meters may be false by the
sizes of the fault dictionary. The busbar voltage is metered, or eliminated by the trusted meters.

References
----------
docs/theory-sequential.md, sections 5 and 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gridsec.arrays import PENDING, Bools, Floats, Ints, all_of, any_of, changed, deferred
from gridsec.estimators.detection import DecisionInputs, decide
from gridsec.estimators.plant import NO_VOLTAGE, Plant, busbar_errors
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.device_checks import BusbarTrust, track_busbar
from gridsec.estimators.sequential.identify import Identification
from gridsec.estimators.sequential.measurements import (
    ClockSkew,
    Measurements,
    PowerErrors,
    checked,
    largest_offset,
    unusable_offsets,
)
from gridsec.estimators.sequential.posterior import (
    DoubtedPowers,
    Prior,
    doubt_powers,
    leave_one_out,
    vouched_posteriors,
)
from gridsec.estimators.sequential.state import Prediction, SequentialState, TrustState
from gridsec.estimators.sequential.time_scales import min_readings
from gridsec.grid.devices import told_error
from gridsec.grid.three_phase import PHASES
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, PowerOrigin, Verdict


def output(
    design: SequentialDesign,
    state: SequentialState,
    measured: Measurements,
    predicted: Prediction,
    identified: Identification,
) -> tuple[SequentialState, Estimate, Verdict]:
    """State with the output in it, estimate and verdict, from the state after this tick."""
    beside = vouched_posteriors(state.vouched_posteriors, state.posteriors, state.uncertainty.vouched)
    state = state if beside is state.vouched_posteriors else changed(state, vouched_posteriors=beside)
    estimate, doubted = _estimate(design, state, measured, predicted, identified)
    busbar, named, available = (
        _busbar(design, state, measured, estimate),
        state.trust.named,
        measured.available,
    )
    score, threshold, tested = _strongest(design, identified, available.size)
    if state.clock_skew is not None:
        tested = tested | _tested_seldom(design, state.clock_skew, state)
    attack = np.zeros(available.size)
    if any_of(named):
        off = measured.y - state.learned.bias - estimate.v2_bus[design.prior.meters]
        attack = np.where(named & available, off, 0.0)
    settled = all_of(predicted.transient <= design.options.settled * threshold)
    finding = _of_meters(design, state.trust, tested & available, score, threshold, settled=settled)
    deviation = _busbar_finding(design, busbar, estimate)
    finding = _unvouched(design, measured.busbar_metered, tested & available, deviation, finding)
    inverters, amounts = _inverters(design, state), _amounts(design, state, identified)
    open_cases = _open_checks(design, state, finding)
    finding = _beside_meters(design, inverters, deviation, amounts, identified.rivals, open_cases, finding)
    finding = _unexplained(identified.inconsistent, finding)
    if not (identified.rivals or open_cases or all_of(state.uncertainty.vouched)):
        unread = ~state.uncertainty.vouched[max(_best_scale(design, state)[0], 0)]
        finding = _unread_powers(design, measured.frame, unread, estimate, finding)
    verdict = Verdict(
        *_clock_offsets(design, measured.frame, tested & available, finding),
        named,
        score,
        threshold,
        attack,
        inverters=inverters,
        inverter_attack=_injected(design, state, inverters, amounts),
        kinds=state.attack_kinds.kinds,
        explanations=identified.rivals or open_cases,
        unjudged=design.inverter_undetectable & ~(state.inverter_checks.observable | inverters),
        busbar=deviation.named,
        busbar_attack=np.where(deviation.named, busbar.off, 0.0),
    )
    last = estimate, verdict
    return changed(state, doubted_powers=doubted, busbar=busbar, last=last), estimate, verdict


def _busbar(
    design: SequentialDesign, state: SequentialState, measured: Measurements, estimate: Estimate
) -> BusbarTrust:
    """Trust of the busbar's meter after this tick."""
    before = state.busbar
    if all_of(before.trusted):
        return before
    posteriors = (state.posteriors[s] for s in before.scale.tolist())
    left = np.array([np.nan if fit is None else fit.variance[k] for k, fit in enumerate(posteriors)])
    loo = measured.busbar_available & np.isfinite(left)
    v0_squared = estimate.v2_bus[design.plant.feeder.busbar_places()]
    allowed = float(state.learned.allowed.max())
    return track_busbar(
        design, before, measured.busbar_reading, loo, v0_squared, np.where(loo, left, 0.0), allowed
    )


def _inverters(design: SequentialDesign, state: SequentialState) -> Bools:
    """Named inverters: by the voltages unless their metered power follows the curve, or by that power."""
    named, curves = state.trust.inverters, state.inverter_checks
    return named if curves.idle else (named & ~curves.consistent(design)) | curves.named(design)


def _injected(
    design: SequentialDesign, state: SequentialState, inverters: Bools, amounts: dict[int, float]
) -> Floats:
    """Deviation of named inverters from their curves, as metered where it is, (m,)."""
    out = np.zeros(inverters.size)
    if any_of(inverters):
        for k, amount in amounts.items():
            if k >= design.customers:
                out[k - design.customers] = amount
        metered = state.inverter_checks.amounts(design)
        out = np.where(inverters, np.where(metered != 0.0, metered, out), 0.0)
    return out


def _estimate(
    design: SequentialDesign,
    state: SequentialState,
    measured: Measurements,
    predicted: Prediction,
    identified: Identification,
) -> tuple[Estimate, DoubtedPowers | None]:
    """Estimate by the best scale."""
    plant = design.plant
    w, variance, doubted = _reconstructed(design, state, measured, identified)
    v2_bus = predicted.v2_bus + w
    first = plant.feeder.busbar_places()
    v2_bus[first] = np.where(measured.busbar_metered, measured.v0_squared, v2_bus[first])
    # This is a reading; the posterior of the others does not lower its variance.
    variance = variance.copy()
    variance[first] = np.maximum(variance[first], np.where(measured.busbar_metered, design.busbar**2, 0.0))
    inputs = BoundInputs(
        plant=plant,
        powers=changed(predicted.powers, trusted=state.trust.trusted),
        injected=state.injection_error.error,
        model=predicted.v2_bus[plant.feeder.bus],
        busbar=measured.busbar_metered,
        y=measured.y,
        trusted=state.trust.trusted & measured.available,
        checked=partial(checked, design, measured.frame),
        sigmas=design.sigmas[0],
    )
    return BoundedEstimate.of(inputs, state.t, v2_bus, variance, predicted.x), doubted


_Finding = tuple[Decision, Cause, str]


_REPLACEABLE = (Cause.AGREEMENT, Cause.AMBIGUOUS)
"""Causes that findings on inverters and loads replace."""


def _of_meters(
    design: SequentialDesign,
    trust: TrustState,
    available: Bools,
    score: Floats,
    threshold: Floats,
    *,
    settled: bool,
) -> _Finding:
    """Verdict on the meters: available ones, their residuals and limits, (p,) each."""
    beyond = score > threshold
    finding = decide(
        DecisionInputs(
            names=design.names,
            max_attacked=max(1, min(design.max_attacked, int(np.count_nonzero(available)) // 3)),
            live=available,
            suspected=~trust.trusted | beyond,
            named=trust.named,
            wide=available & ~(threshold <= design.options.widest),
            valid=True,
            settled=settled,
            busbar=True,
        )
    )
    return _contradicted(design, beyond & ~trust.named, trust.named, finding)


def _tested_seldom(design: SequentialDesign, skew: ClockSkew, state: SequentialState) -> Bools:
    """Meters with a clock offset, (p,), on scales that test them without a look at this tick."""
    need = np.array([min_readings(design, s) for s in range(len(design.lengths))])
    return skew.tested(state.window.counts, need)


def _contradicted(design: SequentialDesign, beyond: Bools, named: Bools, finding: _Finding) -> _Finding:
    """Verdict, UNDECIDED if a decoder leaves more than `max_attacked` meters beyond their limits."""
    if design.decoder is None or finding[1] is not Cause.RESIDUALS:
        return finding
    more, most = int(np.count_nonzero(beyond)), design.max_attacked
    if not more or int(np.count_nonzero(named)) + more <= most:
        return finding
    sentence = f"{finding[2][:-1]}; but so are {more} of the others, and at most {most} can be told apart."
    return Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS, sentence


@dataclass(frozen=True, slots=True, eq=False)
class _BusbarFinding:
    """Findings on the busbar's meter: named phases (b,), meter and deviation in words, empty if trusted."""

    named: Bools
    meter: str = ""
    off: str = ""


def _busbar_finding(design: SequentialDesign, busbar: BusbarTrust, estimate: Estimate) -> _BusbarFinding:
    if all_of(busbar.trusted):
        return _BusbarFinding(busbar.named)
    doubted, v0_squared = ~busbar.trusted, estimate.v2_bus[design.plant.feeder.busbar_places()]
    off = busbar_deviation(busbar.off, v0_squared, doubted)
    return _BusbarFinding(busbar.named, busbar_meter(doubted), off)


def _unvouched(
    design: SequentialDesign,
    busbar: Bools | bool,
    available: Bools,
    deviation: _BusbarFinding,
    finding: _Finding,
) -> _Finding:
    """Verdict, UNDECIDED if too few meters of a phase without a busbar voltage report.

    On a balanced feeder most meters are honest and determine the busbar. In three phases those of one phase
    do, which takes more than twice as many as may be manipulated.
    """
    if finding[0] is not Decision.CLEAN or all_of(np.asarray(busbar)):
        return finding
    feeder, meters = design.plant.feeder, design.prior.meters[available]
    measured = feeder.same_busbar_phase(np.arange(np.size(busbar)), meters) * np.ones(meters.size)
    count = np.where(busbar, meters.size, measured.sum(axis=-1)).min()
    most = max(1, min(design.max_attacked, meters.size // 3))
    if count > 2 * most:
        return finding
    why = "The busbar voltage of a phase is missing"
    if deviation.meter:
        why = f"{deviation.meter.capitalize()} {deviation.off}"
    sentence = (
        f"{why}, and {count:.0f} meters report from there; "
        f"at least {2 * most + 1} are needed to tell {most} manipulated from the others."
    )
    return Decision.UNDECIDED, Cause.TOO_FEW_METERS, sentence


def _unexplained(misfit: tuple[bool, ...], finding: _Finding) -> _Finding:
    """Verdict, with the misfit of the trusted meters on a scale that no search explains."""
    decision, cause, reason = finding
    if not any(misfit):
        return finding
    if decision is Decision.ATTACKED:
        return decision, cause, f"{reason} The other meters, taken together, still disagree with the feeder."
    # Silent meters do not outweigh this evidence.
    if cause not in (Cause.AGREEMENT, Cause.SILENT_METERS):
        return finding
    sentence = (
        "The meters, taken together, disagree with the feeder by more than chance, though none of them does "
        "by itself."
    )
    return Decision.UNDECIDED, Cause.MISFIT, sentence


def _unread_powers(
    design: SequentialDesign, frame: Frame, unread: Bools, estimate: Estimate, finding: _Finding
) -> _Finding:
    """Verdict, UNDECIDED if a voltage beside an unread power is too uncertain."""
    if finding[1] not in _REPLACEABLE or not any_of(unread):
        return finding
    at, limit = design.plant.meters, design.options.unread_std_percent
    v = np.sqrt(np.maximum(estimate.v2[at], _LEAST_V2))
    percent = 50.0 * estimate.std[at] / (v * design.plant.droop.vbar)
    wide = unread & ~(percent <= limit)
    if not any_of(wide):
        return finding
    origins = np.zeros(frame.p.size, dtype=np.intp) if frame.p_origin is None else frame.p_origin
    sentence = unread_sentence(design.names, wide, origins[at], percent, limit)
    return Decision.UNDECIDED, Cause.MISSING_POWERS, sentence


def _clock_offsets(design: SequentialDesign, frame: Frame, available: Bools, finding: _Finding) -> _Finding:
    """Verdict, with the meters that count as silent for a clock offset that no scale covers."""
    decision, cause, reason = finding
    far = unusable_offsets(design, frame.clock_offset)
    if far is None or cause not in (Cause.SILENT_METERS, Cause.TOO_FEW_METERS):
        return finding
    sentence = clock_sentence(design.names, far, largest_offset(design))
    if cause is Cause.SILENT_METERS and not any_of(~available & ~far):
        return decision, Cause.CLOCK_OFFSET, sentence
    return decision, cause, f"{reason} {sentence}"


_LEAST_V2 = 1e-2
"""Least squared voltage that relates a standard deviation to the voltage, pu."""


def _open_checks(
    design: SequentialDesign, state: SequentialState, finding: _Finding
) -> tuple[Explanation, ...]:
    """Hypotheses about metered reactive powers that the voltages leave open."""
    if state.inverter_checks.idle:
        return ()
    sure = state.trust.named if finding[1] is Cause.RESIDUALS else np.zeros_like(state.trust.named)
    return (
        state.inverter_checks.explanations(design, sure)
        if finding[1] in (*_REPLACEABLE, Cause.RESIDUALS)
        else ()
    )


def _beside_meters(  # noqa: PLR0917
    design: SequentialDesign,
    inverters: Bools,
    deviation: _BusbarFinding,
    amounts: dict[int, float],
    rivals: tuple[Explanation, ...],
    open_cases: tuple[Explanation, ...],
    finding: _Finding,
) -> _Finding:
    """Verdict, with findings other than meters."""
    decision, cause, reason = finding
    plant, found = design.plant, []
    if any_of(inverters):
        owners = ", ".join(plant.feeder.customers[c] for c in plant.droop.customer[inverters])
        found.append((f"the inverters of {owners}", "their reactive power is not that of their curves"))
    if any_of(deviation.named):
        found.append((deviation.meter, f"it {deviation.off}"))
    if cause is Cause.RESIDUALS:
        reason = f"{reason[:-1]}; and {' and '.join(each for each, _ in found)}." if found else reason
        return (
            decision,
            cause,
            f"{reason} {explanations_sentence(design, open_cases)}" if open_cases else reason,
        )
    # Silent meters do not outweigh this evidence.
    if cause not in ((*_REPLACEABLE, Cause.SILENT_METERS) if found else _REPLACEABLE):
        return finding
    if found:
        sentence = f"Manipulated: {'; and '.join('; '.join(each) for each in found)}."
        return Decision.ATTACKED, Cause.RESIDUALS, sentence
    sentence = ""
    if deviation.meter:
        sentence = f"{deviation.meter.capitalize()} {deviation.off}; it is not believed."
    elif rivals or open_cases:
        sentence = explanations_sentence(design, rivals or open_cases)
    elif amounts:
        sentence = fault_sentence(design, *next(iter(amounts.items())))
    return (Decision.UNDECIDED, Cause.AMBIGUOUS, sentence) if sentence else finding


def _amounts(
    design: SequentialDesign, state: SequentialState, identified: Identification
) -> dict[int, float]:
    """Amount of each accused fault, by index of the dictionary, pu.

    With prior variance s^2 and direction a the posterior mean is ``s^2 a^T Q m``.
    """
    out: dict[int, float] = {}
    faults, std = design.faults, state.uncertainty.sizes
    for k, s in state.trust.accused:
        test, now = identified.tests[s], state.posteriors[s]
        if test is not None:
            weights = test.loo.weights
        elif now is not None:
            weights = now.weights(_mean(state, s))
        else:
            continue
        out[k] = float(std[k] ** 2 * faults.weighted(weights)[k])
    return out


def _mean(state: SequentialState, s: int) -> Floats:
    """Mean residuals on a scale, (p,)."""
    return np.asarray(state.window.sums[s] / np.maximum(state.window.counts[s], 1))


def _reconstructed(
    design: SequentialDesign, state: SequentialState, measured: Measurements, identified: Identification
) -> tuple[Floats, Floats, DoubtedPowers | None]:
    """Correction of the model by the trusted meters at every bus, its variance, and the doubted powers."""
    s, moved = _best_scale(design, state)
    prior, p_std = state.uncertainty.priors[max(s, 0)], measured.frame.p_std
    now, test = (None, None) if s < 0 else (state.posteriors[s], identified.tests[s])
    if now is None:
        return np.zeros_like(prior.variance), prior.variance, None
    loo = leave_one_out(now, _mean(state, s)) if test is None else test.loo
    # The model starts at this busbar reading; a mean removes only its part of the jitter.
    jitter = (1.0 - 1.0 / design.lengths[s]) * design.busbar_noise
    noise = design.plant.feeder.broadcast_busbar(np.where(measured.busbar_metered, jitter, 0.0))
    more = moved * prior.variance + _hidden(state, prior) + noise
    beside = state.vouched_posteriors[s]
    if beside is not None:
        more = more + beside.added_variance(loo)
    suspects = design.plant.meters[~state.trust.trusted]
    # Unreported powers, known by a standard deviation, are not false.
    if p_std is not None:
        suspects = suspects[np.isnan(p_std[suspects]) | _late(measured.frame)[suspects]]
    if not suspects.size:
        return loo.mean, now.variance + more, None
    sizes, doubted = state.uncertainty.sizes[suspects], state.doubted_powers
    if doubted is None or not doubted.matches(now, suspects, sizes):
        doubted = doubt_powers(design.sensitivities, now, suspects, sizes, loo)
    elif s in identified.candidates or not doubted.is_current(loo):
        doubted = doubted.renewed(loo)
    return doubted.mean(loo), doubted.variance + more, doubted


def _late(frame: Frame) -> Bools:
    """Customers with a power that is read and has a standard deviation all the same, (N,)."""
    if frame.p_origin is None:
        return np.zeros(frame.p.size, dtype=np.bool_)
    return np.asarray(frame.p_origin != PowerOrigin.UNREAD)


def _best_scale(design: SequentialDesign, state: SequentialState) -> tuple[int, float]:
    """Scale of the least posterior variance, -1 for none, and the part of the loads' variance it lacks.

    A mean over many ticks does not contain the present loads.
    """
    at, least, moved = -1, np.inf, 0.0
    for s, (now, length) in enumerate(zip(state.posteriors, design.lengths, strict=True)):
        if now is None:
            continue
        lag, beside = (
            min(1.0, length * design.step_s / design.doubt.time_s) * (length > 1),
            state.vouched_posteriors[s],
        )
        total = (now if beside is None else beside.vouched).total_variance() + lag * now.prior.total
        if total < least:
            at, least, moved = s, total, lag
    return at, moved


def _hidden(state: SequentialState, prior: Prior) -> Floats:
    """Variance of lasting load errors that learning cannot separate, at every bus, (n,)."""
    hidden, late = state.learned.hidden, state.learned.late
    if not any_of(hidden):
        return np.zeros(prior.variance.size)
    out = np.full(prior.variance.size, hidden.max(initial=0.0))
    out[prior.meters] = hidden if late is None else np.maximum(hidden, late)
    return np.asarray(np.minimum(out, prior.variance))


def _strongest(design: SequentialDesign, identified: Identification, p: int) -> tuple[Floats, Floats, Bools]:
    """Residual and limit of each meter on the scale with the strongest evidence; tested meters."""
    tests = [test for test in identified.tests if test is not None]
    if not tests:
        return np.full(p, np.nan), np.full(p, design.options.widest), np.zeros(p, dtype=np.bool_)
    score, limit, tested = np.abs(tests[0].loo.residual), tests[0].limit, tests[0].enough
    ratio = score / limit if all_of(tested) else np.where(tested, score / limit, -1.0)
    for test in tests[1:]:
        residual = np.abs(test.loo.residual)
        here = residual / test.limit
        more = test.enough & (here > ratio)
        ratio = np.where(more, here, ratio)
        score, limit = np.where(more, residual, score), np.where(more, test.limit, limit)
        tested = tested | test.enough
    if all_of(tested):
        return score, limit, tested
    return np.where(tested, score, np.nan), np.where(tested, limit, design.options.widest), tested


# --- Sentences ---


def fault_sentence(design: SequentialDesign, k: int, amount: float) -> str:
    """Sentence about accused fault k of the dictionary with its amount, pu."""
    plant = design.plant
    power = f"{abs(amount) * plant.feeder.base_kva:.1f}"
    if k < design.customers:
        way = "feeds in" if amount > 0 else "draws"
        return f"It looks as if {plant.feeder.customers[k]} {way} {power} kW more than its readings say."
    owner = plant.feeder.customers[plant.droop.customer[k - design.customers]]
    return f"The inverter of {owner} may inject {power} kvar that its curve does not ask for."


def busbar_meter(which: Bools) -> str:
    """Name of the busbar's meter, with the phases `which` (b,) in three phases."""
    if which.size == 1:
        return "the meter of the busbar"
    names = [phase for phase, one in zip(PHASES, which, strict=True) if one]
    return f"the meter of the busbar (phase{'s' * (len(names) > 1)} {', '.join(names)})"


def busbar_deviation(off: Floats, v0_squared: Floats, which: Bools) -> str:
    """Largest deviation of the busbar's meter from the others, (b,) `off` beside `v0_squared`, squared pu."""
    parts = 100.0 * (np.sqrt(np.maximum(1.0 + off / v0_squared, 0.0)) - 1.0)[which]
    worst = float(parts[np.abs(parts).argmax()])
    return f"reads {abs(worst):.1f} % {'more' if worst > 0 else 'less'} than the meters of the feeder say"


def unread_sentence(
    names: tuple[str, ...], which: Bools, origins: Ints, percent: Floats, limit: float
) -> str:
    """Customers without a usable active power, and the precision of the voltage there.

    which, origins, percent: (p,) meters in question, `PowerOrigin`, and standard deviation of the voltage in
    % of nominal. limit: largest permitted one.
    """
    parts = []
    for origin, sentence in _ORIGINS.items():
        here = [name for name, one in zip(names, which & (origins == origin), strict=True) if one]
        if here:
            parts.append(sentence.format(_list(here)))
    return (
        f"{' '.join(parts)} The standard deviation of the voltage there is {percent[which].max():.2g} %; "
        f"`[monitor] unread_std_percent` permits {limit:g} %."
    )


_ORIGINS = {
    PowerOrigin.UNREAD: "No active power from {}.",
    PowerOrigin.LATE: "The active power of {} is older than the voltage.",
    PowerOrigin.BEYOND: "The active power of {} is beyond the declared range.",
    PowerOrigin.READ: "The running mean contains earlier ticks without a usable active power of {}.",
}
"""Sentence per origin. `READ`: the power is usable again, and the mean still contains ticks without it."""


def clock_sentence(names: tuple[str, ...], which: Bools, limit_s: float) -> str:
    """Meters `which` (p,) with readings of another moment."""
    found = _list([name for name, one in zip(names, which, strict=True) if one])
    return (
        f"The clock offset of {found} is above {limit_s:g} s: no scale compares the readings with the feeder."
    )


_SHOWN = 5
"""Largest number of explanations in a sentence, and of names in each."""


def explanations_sentence(design: SequentialDesign, explanations: tuple[Explanation, ...]) -> str:
    """Possible explanations in one sentence."""
    shown = [_explanation(design, each) for each in explanations[:_SHOWN]]
    if len(explanations) == 1:
        return f"Wrong is {shown[0]}; nothing else explains the readings."
    more, text = len(explanations) - len(shown), " or else ".join(shown)
    each = "both explain" if len(explanations) == 2 else "each of these explains"
    return f"Wrong are either {text}{f' or {more} more' if more else ''}; {each} the readings."


def _explanation(design: SequentialDesign, explanation: Explanation) -> str:
    customers, owner = design.plant.feeder.customers, design.plant.droop.customer
    accused = (
        ("meter", [name for name, bad in zip(design.names, explanation.meters, strict=True) if bad]),
        ("inverter", [customers[c] for c in owner[explanation.inverters]]),
        ("reported power", [customers[c] for c in np.flatnonzero(explanation.powers)]),
    )
    parts = [f"the {what}{'s' * (len(some) > 1)} of {_list(some)}" for what, some in accused if some]
    if explanation.busbar.any():
        parts.append(busbar_meter(explanation.busbar))
    return " and ".join(parts) if parts else "none of them"


def _list(names: list[str]) -> str:
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest


# --- Bound of the estimate ---


@dataclass(frozen=True, slots=True, eq=False)
class BoundInputs:
    """Inputs of the bound of one estimate. N customers, p meters."""

    plant: Plant  # the feeder
    powers: PowerErrors  # power errors of the frame
    injected: Floats  # (m,) largest errors of the observed injections, pu
    model: Floats  # (N,) voltages of the model, squared pu
    busbar: Bools | bool  # busbar phases that are metered
    y: Floats  # (p,) squared readings
    trusted: Bools  # (p,) meters used by the estimate
    checked: Callable[[], Bools]  # meters with a known customer's power, (p,); evaluated with the bound
    sigmas: float  # standard deviations of jitter within an honest reading

    def half_width(self, v2: Floats) -> Floats:
        """Largest distance of the true squared voltages from v2, (N,), pu."""
        plant, at = self.plant, self.plant.meters
        injected = plant.droop.per_customer(self.injected, plant.feeder.bus.size)
        lost, correction = self.powers.loss_error(plant, injected)
        spread = np.minimum(self.powers.linear_error(plant, injected) + lost, NO_VOLTAGE)
        reading, use = told_error(plant.accuracy, self.y, self.sigmas), self.trusted & self.checked()
        ends = self._busbar(spread, reading, use)
        low, high = (plant.feeder.broadcast_busbar(end)[plant.feeder.bus] for end in ends)
        # The loss correction is that of the assumed busbar voltage.
        moved = np.minimum(np.maximum(np.abs(low), np.abs(high)), NO_VOLTAGE)
        base = plant.feeder.broadcast_busbar(self.powers.v0_squared)[plant.feeder.bus]
        spread = spread + np.abs(correction) * moved / np.maximum(base - moved, _LEAST_BUSBAR)
        low, high = self.model + low - spread, self.model + high + spread
        own = np.where(use, reading, np.inf)
        low[at], high[at] = _intersection(low[at], high[at], self.y - own, self.y + own)
        return np.minimum(np.maximum(high - v2, v2 - low), NO_VOLTAGE)

    def _busbar(self, spread: Floats, reading: Floats, use: Bools) -> tuple[Floats, Floats]:
        """Interval of the busbar's squared voltage about the assumed one: by its meter, and by the others."""
        plant, at = self.plant, self.plant.meters
        known = np.atleast_1d(busbar_errors(plant, self.powers.v0_squared, self.sigmas))
        known = np.where(self.busbar, known, np.inf)
        off, room = self.y - self.model[at], np.where(use, reading + spread[at], np.inf)
        reach = np.where(plant.feeder.busbar_incidence()[at] > 0.0, room[:, None], np.inf)
        low = (off[:, None] - reach).max(axis=0, initial=-np.inf)
        high = (off[:, None] + reach).min(axis=0, initial=np.inf)
        return _intersection(-known, known, low, high)


_LEAST_BUSBAR = 0.1
"""Least squared busbar voltage of the loss correction, pu."""


def _intersection(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> tuple[Floats, Floats]:
    """Intersection of two intervals; their hull where they do not meet."""
    below, above = np.maximum(low, other_low), np.minimum(high, other_high)
    apart = below > above
    return (
        np.where(apart, np.minimum(low, other_low), below),
        np.where(apart, np.maximum(high, other_high), above),
    )


# Placeholder of a bound that is not computed yet.
class BoundedEstimate(Estimate):
    """Estimate with a bound computed on first access, which takes half a step.

    It keeps the arrays of its frame, which must not be changed.
    """

    __slots__ = ("_grounds",)
    _grounds: BoundInputs

    @classmethod
    def of(
        cls, grounds: BoundInputs, t: float, v2_bus: Floats, variance: Floats, x: Floats
    ) -> BoundedEstimate:
        """Estimate at Unix time t, s, with variance (n,) at every place."""
        bus = grounds.plant.feeder.bus
        made = cls(t, v2_bus[bus], PENDING, v2_bus, grounds.trusted, x, np.sqrt(variance[bus]))
        object.__setattr__(made, "_grounds", grounds)
        return made

    @deferred(Estimate)
    def bound(self) -> Floats:
        """Half-width of the interval around `v2` that contains the truth within the stated errors, (N,)."""
        return self._grounds.half_width(self.v2)
