"""Partial observers on a feeder, stacked and decoded: lee2018, Algorithm 4.1.

A single meter determines little. The part of the state x (the injections of the inverters) that belongs
to meter j is

- ``x_i`` of the inverter at its place: a scalar observer driven by its own reading,
  ``tau x_hat_i' = -x_hat_i + K_i(vbar^2 - v_j^2)``, with an error bounded by that of the unmanipulated
  reading;
- the reading, one linear combination of all injections and loads;
- its customer's net reactive power, where reported and without an inverter: an injection is not determined
  by its meter alone. If meter and inverter cannot both be unmanipulated, the answer is not CLEAN, but
  neither is named for it.

Everything else of x decays without it (section 4.2.1, the detectable part): an observer without any meter,
common to all and out of reach of an attack. Likewise the loads and the busbar voltage are known within
intervals. So the code word is

    s = B xi + v + e,    xi = ((x - x_0) / free, d_p / p_error, d_q / q_error, d_v0 / error),    |xi| <= 1,

with the rows of meter j as block j, each in units of its own worst-case bound from
`gridsec.estimators.detection`. All C(p, M) fits without M meters are computed at every frame
(`gridsec.secure.decode.search`). Shared errors are one unknown, not one for every meter; this provides the
evidence.

A fit is credible if it explains every meter in it, as the observer without meters must by itself. A meter is
named if it is in no credible fit. An unmanipulated meter belongs to some set of p - M unmanipulated ones, and
that set's fit is credible. So, with at most M manipulated meters, no unmanipulated meter is ever named, and
the true state is within the union of the credible fits. The price is power: with more allowed manipulations,
more fits can explain a small attack differently. Then the answer is UNDECIDED, with these explanations.

The paper's own constants (theta, kappa) are available from `constants`; on feeders they guarantee less than
is known without any meter. docs/theory-partial-observers.md, section 8, has the proof and the numbers.

Source: lee2018, sections 4.2.1 and 4.3.1, Algorithm 4.1, Theorems 2.2.11 and 4.3.2; for droop inverters
docs/theory-partial-observers.md, section 8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible, NotObservable
from gridsec.estimators import detection
from gridsec.estimators.detection import (
    Counters,
    DecisionInputs,
    ErrorBound,
    Motion,
    TickUncertainty,
    count,
    decide,
    no_counts,
)
from gridsec.estimators.plant import (
    NO_VOLTAGE,
    EstimatorContext,
    Inputs,
    Options,
    Plant,
    PreviousStep,
    Reconstruction,
    busbar_errors,
    check_plant,
    clean,
    estimator_context,
    injections,
    known,
    nothing_new,
    reconstruct,
    usual_options,
)
from gridsec.grid.devices import reading_error
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, Verdict
from gridsec.observers import circle
from gridsec.observers.certificates import Certificate, verify
from gridsec.observers.circle import CircleDesign
from gridsec.observers.lure import POLICY, close_loop
from gridsec.secure.decode.noise import CorrectionConstants, correction_constants
from gridsec.secure.decode.search import Fits, fits
from gridsec.secure.decode.stacks import MOST_SUBSETS, Stack

__all__ = [
    "CodeWord",
    "PartialDesign",
    "PartialState",
    "Parts",
    "code_word",
    "constants",
    "design",
    "disputed",
    "init",
    "observe",
    "start",
    "step",
]


_LONG_S = 3600.0
# Smallest bound of a row, pu: below rounding, for meters without any error.
_SMALLEST = 1e-9
# Largest uncertainty of an unknown, and largest deviation of a value, pu: more than any feeder has, and small
# enough for finite squares and sums.
_LARGEST, _FARTHEST = 1e4, 1e8


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """State of the observers. m inverters."""

    # x, z (m,): injections of the observer without meters, and z at its inverters, pu
    x: Floats
    z: Floats
    driven: Floats  # (m,) injections of the scalar observers; those of `x` without a driving meter
    # `free` bounds the error of x, `driven` that of the scalar observers of unmanipulated meters
    bound: ErrorBound
    level: ErrorBound  # upper level of the bounds during the last step


@dataclass(frozen=True, slots=True, eq=False)
class CodeWord:
    """One frame as a code word in units of its bounds. A rows, n unknowns."""

    # B, s, block (A, n), (A,), (A,): rows, their values, and the meter of each
    B: Floats
    s: Floats
    block: Ints
    unit: Floats  # (A,) unit of each row, squared pu or pu
    scale: Floats  # (n,) unit of each unknown, pu: x, p, q, squared busbar voltage
    reading: Bools  # (A,) True for rows that are readings
    voltage: Floats  # (N, n) sensitivity of the customers' squared voltages to one unit of each unknown, pu
    rest: Floats  # (N,) their remaining error, pu


def start(setting: EstimatorContext) -> Parts:
    """State before the first frame: only the saturation of the inverters is known."""
    zero, widest = np.zeros(setting.plant.droop.tau.size), detection.widest(setting.errors)
    return Parts(zero, zero, zero, widest, widest)


def observe(  # noqa: PLR0917  # the observers, their state, and the inputs
    setting: EstimatorContext, model: CircleDesign, before: Parts, frame: Frame, inputs: Inputs, h: float
) -> tuple[TickUncertainty, Reconstruction, Parts, bool]:
    """Advance all observers and their bounds to a frame.

    Returns Uncertainty, Reconstruction, Parts, bool: uncertainty without any meter, voltages by the observer
        without meters, new state of the observers, and True once their initial transient is negligible.
    """
    plant, errors = setting.plant, setting.errors
    own, no_meters = plant.droop.customer, np.zeros_like(inputs.live)
    # The first state is the equilibrium of the first frame.
    x = circle.step(
        model, circle.CircleState(0.0, before.x), inputs.z, inputs.w, no_meters, h if h > 0 else _LONG_S
    ).x
    seen = reconstruct(setting, frame, inputs, injections(plant, frame, x, no_meters))
    base = np.minimum(inputs.now.base + seen.moved, NO_VOLTAGE)
    alone = replace(inputs.now, base=base, live=no_meters, told=no_meters)
    z = plant.droop.vbar**2 - seen.v2[own]
    lag = np.where(detection.slowed(errors, h, POLICY), np.abs(x - before.x), 0.0)
    motion = Motion(before.z if h > 0 else z, z, np.zeros(x.shape), h, lag)
    bound, level = detection.advance(errors, alone, motion, before.bound, before.level)
    heard = np.zeros(x.shape, dtype=np.bool_)
    driven = x
    if inputs.live.size:
        heard = (errors.meter_of >= 0) & inputs.live[errors.meter_of]
        keep = np.exp(-h / plant.droop.tau)
        was = before.driven if h > 0 else x
        aim = plant.droop(inputs.z[errors.meter_of])
        # Without a reading a scalar observer equals the one without meters, and so does its error.
        driven = np.where(heard, keep * was + (1.0 - keep) * aim, x)
    bound = ErrorBound(np.where(heard, bound.driven, bound.free), bound.free)
    return alone, seen, Parts(x, z, driven, bound, level), _settled(setting, alone, motion, bound)


def _settled(setting: EstimatorContext, alone: TickUncertainty, motion: Motion, bound: ErrorBound) -> bool:
    errors = setting.errors
    transient = np.maximum(bound.free - detection.at_rest(errors, alone, motion).free, 0.0)
    excess = errors.inverters[errors.meters] @ transient
    allowed = alone.reading + alone.base[errors.meters]
    return bool(np.all(excess <= setting.options.settled * allowed))


def code_word(  # noqa: PLR0917  # as _conclude
    setting: EstimatorContext,
    parts: Parts,
    frame: Frame,
    inputs: Inputs,
    alone: TickUncertainty,
    model: Reconstruction,
) -> CodeWord:
    """Rows of all meters, each in units of its own bound.

    setting, parts, frame, inputs: the feeder, its observers after this frame, and the frame, received and
        prepared.
    alone: uncertainty without any meter.
    model: voltages by the observer without meters.
    """
    plant, errors, lines = setting.plant, setting.errors, setting.model
    own, n, m = plant.droop.customer, frame.p.size, parts.x.size
    shared, rest_ = _split(setting, frame, inputs, alone)
    scale = np.concatenate([parts.bound.free, frame.p_error, frame.q_error, shared])
    scale = np.minimum(scale, _LARGEST)
    voltage = np.hstack(
        [2.0 * lines.X[:, own], 2.0 * lines.R, 2.0 * lines.X, plant.feeder.busbar_incidence()]
    )
    at = np.flatnonzero(inputs.live)
    where = plant.meters[at]
    driven = inputs.live[errors.meter_of] if at.size else np.zeros(m, dtype=np.bool_)
    inverters = np.flatnonzero(driven & (errors.meter_of >= 0))
    # A net power with an inverter behind it is not determined by its meter alone.
    net = np.flatnonzero(_told(setting, frame, inputs) & ~np.isin(plant.meters, own))
    of_x, of_q = np.eye(m, scale.size), np.eye(n, scale.size, k=m + n)
    rows = np.vstack([voltage[where], of_x[inverters], of_q[plant.meters[net]]])
    value = np.concatenate(
        [
            inputs.y[at] - model.v2[where],
            (parts.driven - parts.x)[inverters],
            (frame.q_net - frame.q)[plant.meters[net]],
        ]
    )
    unit = np.concatenate(
        [
            alone.reading[at] + rest_[where],
            parts.bound.driven[inverters],
            frame.q_net_error[plant.meters[net]],
        ]
    )
    unit, value = np.clip(unit, _SMALLEST, _FARTHEST), np.clip(value, -_FARTHEST, _FARTHEST)
    block = np.concatenate([at, errors.meter_of[inverters], net]).astype(np.intp)
    reading = np.arange(block.size) < at.size
    B = rows * scale / unit[:, None]
    return CodeWord(B, value / unit, block, unit, scale, reading, voltage * scale, rest_)


def _told(setting: EstimatorContext, frame: Frame, inputs: Inputs) -> Bools:
    """Mask (p,) of meters that report net reactive power with a known error."""
    return np.asarray(inputs.live & np.isfinite(frame.q_net + frame.q_net_error)[setting.plant.meters])


def disputed(setting: EstimatorContext, parts: Parts, frame: Frame, inputs: Inputs) -> Bools:
    """Mask (p,) of meters with a reported reactive power that their inverters cannot have on their curves.

    Either the meter or its inverter is manipulated; these data do not tell which.
    """
    droop, n = setting.plant.droop, frame.q.size
    honest = droop.per_customer(parts.x, n) + frame.q
    most = droop.per_customer(parts.bound.free, n) + frame.q_error + frame.q_net_error + _SMALLEST
    off = np.isin(np.arange(n), droop.customer) & (np.abs(frame.q_net - honest) > most)
    return np.asarray(_told(setting, frame, inputs) & off[setting.plant.meters])


def _split(
    setting: EstimatorContext, frame: Frame, inputs: Inputs, alone: TickUncertainty
) -> tuple[Floats, Floats]:
    """Error of the busbar voltage, common to all (of a phase), and the error not explained by loads, (N,)."""
    errors, feeder = setting.errors, setting.plant.feeder
    p_error, q_error = np.minimum(frame.p_error, _LARGEST), np.minimum(frame.q_error, _LARGEST)
    rest_ = np.maximum(alone.base - errors.R2 @ p_error - errors.X2 @ q_error, 0.0)
    rest_ = np.where(alone.base >= NO_VOLTAGE, NO_VOLTAGE, rest_)
    if not inputs.busbar:
        # The implied busbar voltage has no separate error: count the rest in both.
        return np.full(feeder.busbar_places().stop, rest_.max(initial=0.0)), rest_
    shared = np.atleast_1d(busbar_errors(setting.plant, inputs.v0_squared, setting.options.sigmas))
    own = feeder.broadcast_busbar(shared)[feeder.bus]
    return np.minimum(shared, NO_VOLTAGE), np.where(rest_ < NO_VOLTAGE, np.maximum(rest_ - own, 0.0), rest_)


def constants(word: CodeWord, meters: int, max_attacked: int, *, tol: float) -> CorrectionConstants:
    """Theta and kappa_c of lee2018 for a frame: block j is the rows of meter j with the model.

    Returns CorrectionConstants: in units of the code word: v_max is the root of the number of unknowns and of
        rows of a meter.
    Source: lee2018, Theorem 2.2.11, with the fading part of section 4.2.1 in every block.
    """
    alone = np.eye(word.scale.size)
    blocks = [np.vstack([alone, word.B[word.block == j]]) for j in range(meters)]
    return correction_constants(Stack.of(blocks), max_attacked, tol=tol)


MOST_WORK = 3e7
"""Limit of the entries of all fits together per second of interval: about half of the capacity of one core.
"""

_SHOWN = 8


@dataclass(frozen=True, slots=True, eq=False)
class PartialDesign:
    """Design of the partial-observer estimator."""

    setting: EstimatorContext
    model: CircleDesign  # the observer without meters
    step_s: float  # expected interval between frames, s

    @property
    def observers(self) -> int:
        """Number of observers: one per inverter with a meter, and the one without meters."""
        return 1 + int(np.count_nonzero(self.setting.errors.meter_of >= 0))


@dataclass(frozen=True, slots=True, eq=False)
class PartialState:
    """State between frames."""

    t: float  # time of the last used frame, s; that of `init` before the first one
    valid: bool  # True if the certificate was verified
    started: bool  # True after the first frame
    parts: Parts  # the observers
    settled: bool  # True once the initial transient has decayed
    tally: Counters  # counters of accusations, and the named meters
    v0_squared: Floats | float  # last squared busbar voltage, pu
    last: tuple[Estimate, Verdict] | None  # last estimate and verdict; None before the first one


def design(
    plant: Plant, *, max_attacked: int, step_s: float, options: Options | None = None
) -> PartialDesign:
    """Design the observers and fits for one feeder.

    max_attacked: M, largest number of simultaneously manipulated meters.
    step_s: expected interval between frames, s; others work, too.
    Raises NotObservable unless there are more than 2M meters; DesignInfeasible if the initial transient does
        not decay, or there are too many sets of M meters; ValueError as `plant.check_plant`.
    """
    meters, p = plant.meters, plant.meters.size
    check_plant(plant, max_attacked=max_attacked, step_s=step_s)
    if p <= 2 * max_attacked:
        why = f"{p} meters, {max_attacked} of them manipulated; more than {2 * max_attacked} are needed"
        raise NotObservable(range(p), p, why, code="too-few-meters")
    sets, rows = comb(p, max_attacked), 3 * p
    unknowns = plant.droop.tau.size + 2 * len(plant.feeder.customers) + plant.feeder.busbar_places().stop
    if sets > MOST_SUBSETS or sets * rows * (rows + unknowns) > MOST_WORK * step_s:
        said = f"{sets} sets of up to {rows} rows every {step_s:g} s are too many"
        raise DesignInfeasible(f"fits without every {max_attacked} of {p} meters", said, code="too-many")
    options = usual_options(step_s) if options is None else options
    model = circle.design(close_loop(plant.feeder, plant.droop, meters), np.zeros(p, dtype=np.bool_))
    return PartialDesign(estimator_context(plant, max_attacked=max_attacked, options=options), model, step_s)


def init(design: PartialDesign, t: float) -> PartialState:
    """Initial state at Unix time t, s; the observers start with the first frame.

    The certificate of the design is verified again.
    """
    plant, proof = design.setting.plant, design.model.certificate
    try:
        valid = isinstance(proof, Certificate) and verify(proof, design.model.lure) > 0
    except DesignInfeasible:
        valid = False
    return PartialState(
        t=t,
        valid=valid,
        started=False,
        parts=start(design.setting),
        settled=False,
        tally=no_counts(plant.meters.size),
        v0_squared=plant.droop.vbar**2,
        last=None,
    )


def step(design: PartialDesign, state: PartialState, frame: Frame) -> tuple[PartialState, Estimate, Verdict]:
    """Process one frame; see `gridsec.interface`.

    Score and threshold are those of the readings in the fit of the estimate, or of the observer without
        meters where that is stricter. All fits and all rows decide on named meters: a small attack may be
        named below this threshold.
    """
    if (state.started and not frame.t > state.t) or not np.isfinite(frame.t):
        plant = design.setting.plant
        return state, *nothing_new(plant, frame, state.t, state.last, state.v0_squared, state.parts.x)
    setting, frame = design.setting, known(frame)
    inputs = clean(setting, PreviousStep(state.parts.x, state.v0_squared, state.tally.named), frame)
    h = frame.t - state.t if state.started else 0.0
    alone, model, parts, at_rest = observe(setting, design.model, state.parts, frame, inputs, h)
    word = code_word(setting, parts, frame, inputs, alone, model)
    after = replace(
        state,
        t=frame.t,
        started=True,
        parts=parts,
        settled=state.settled or at_rest,
        v0_squared=inputs.v0_squared,
    )
    return _conclude(design, after, frame, inputs, alone, model, word)


def _conclude(  # noqa: PLR0917  # the chain's values, in the order in which they come about
    design: PartialDesign,
    after: PartialState,
    frame: Frame,
    inputs: Inputs,
    alone: TickUncertainty,
    model: Reconstruction,
    word: CodeWord,
) -> tuple[PartialState, Estimate, Verdict]:
    setting, options, live = design.setting, design.setting.options, inputs.live
    plant, most = setting.plant, setting.max_attacked
    found = fits(word.B, word.s, word.block, live.size, most, word.voltage)
    everyone = fits(word.B, word.s, word.block, live.size, 0, word.voltage)
    index = _choose(found, word, after.tally.named)
    estimate = _estimate(design, after, frame, alone, model, word, found, index)
    score, threshold = _scores(design, inputs, word, found, index, estimate)
    accused = found.certain
    contradicted = found.contradicted | everyone.contradicted
    hopeless = not found.credible.any()
    if hopeless and np.count_nonzero(contradicted) > most:
        accused = contradicted
    tally = after.tally
    if np.count_nonzero(live) > 2 * most:
        tally = count(tally, accused & live, live, confirm=options.confirm, release=options.release)
    # A contradiction has a cause, even if no single meter can be named: never CLEAN.
    doubtful = contradicted if not found.certain.any() else np.zeros_like(live)
    decision, cause, reason = decide(
        DecisionInputs(
            names=plant.meter_names,
            max_attacked=most,
            live=live,
            suspected=(tally.above > 0) | doubtful,
            named=tally.named,
            wide=live & ~(threshold <= options.widest),
            valid=after.valid,
            settled=after.settled,
            busbar=inputs.busbar,
        )
    )
    if hopeless and decision is Decision.ATTACKED:
        decision, cause = Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS
        reason = f"No {live.size - most} meters agree with each other: more than {most} are manipulated."
    torn = disputed(setting, after.parts, frame, inputs)
    if decision is Decision.CLEAN and torn.any():
        decision, cause = Decision.UNDECIDED, Cause.AMBIGUOUS
        reason = _either([plant.feeder.customers[c] for c in plant.meters[torn]])
    estimate = replace(estimate, trusted=estimate.trusted & ~tally.named)
    attack = np.where(tally.named & live, inputs.y - estimate.v2[plant.meters], 0.0)
    verdict = Verdict(
        decision,
        cause,
        reason,
        tally.named,
        score,
        threshold,
        attack,
        explanations=_explanations(found) if contradicted.any() else (),
    )
    return replace(after, tally=tally, last=(estimate, verdict)), estimate, verdict


def _either(names: list[str]) -> str:
    shown = ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
    return (
        f"{shown}: the reactive power reported is off the inverter's curve; either of the two is manipulated."
    )


def _choose(found: Fits, word: CodeWord, named: Bools) -> int:
    """The fit of the estimate: credible, with few disagreeing and named meters, and small residuals."""
    misfit = np.where(found.left_out[:, word.block], 0.0, found.residual) @ word.s
    order = np.lexsort(
        (
            misfit,
            np.count_nonzero(named & ~found.left_out, axis=1),
            np.count_nonzero(found.disagree, axis=1),
            ~found.credible,
        )
    )
    return int(order[0])


def _estimate(  # noqa: PLR0917  # as _conclude
    design: PartialDesign,
    after: PartialState,
    frame: Frame,
    alone: TickUncertainty,
    model: Reconstruction,
    word: CodeWord,
    found: Fits,
    index: int,
) -> Estimate:
    """The voltages of one fit, and the largest distance of the true ones from them."""
    plant, lines, m = design.setting.plant, design.setting.model, after.parts.x.size
    own, n = plant.droop.customer, frame.p.size
    step_ = word.scale * found.xi[index]
    dx, dp, dq, d0 = np.split(step_, [m, m + n, m + 2 * n])
    dq = dq + np.bincount(own, weights=dx, minlength=n)
    v2_bus = model.v2_bus + 2.0 * (lines.R_bus @ dp + lines.X_bus @ dq) + plant.feeder.broadcast_busbar(d0)
    v2 = v2_bus[plant.feeder.bus]
    # Under any attack, the bound of the observer without meters holds; and so does that of one credible fit.
    gap = detection.gap(design.setting.errors, alone, after.parts.bound)
    low, high = model.v2 - gap, model.v2 + gap
    fine = found.credible
    if fine.any():
        fitted, error = model.v2 + found.xi[fine] @ word.voltage.T, found.error[fine] + word.rest
        low = np.maximum(low, (fitted - error).min(axis=0))
        high = np.minimum(high, (fitted + error).max(axis=0))
    # Empty intersection: more meters are manipulated than assumed, and only the observer without meters
    # holds.
    bound = np.where(low <= high, np.maximum(high - v2, v2 - low), gap + np.abs(v2 - model.v2))
    trusted = np.zeros(plant.meters.size, dtype=np.bool_)
    trusted[word.block] = True
    trusted &= ~found.left_out[index] & ~found.disagree[index]
    return Estimate(t=frame.t, v2=v2, bound=bound, v2_bus=v2_bus, trusted=trusted, x=after.parts.x + dx)


def _scores(  # noqa: PLR0917  # as _conclude
    design: PartialDesign,
    inputs: Inputs,
    word: CodeWord,
    found: Fits,
    index: int,
    estimate: Estimate,
) -> tuple[Floats, Floats]:
    """Residuals of the readings in one fit, or without any, and their limits without manipulation; (p,)."""
    plant, options = design.setting.plant, design.setting.options
    around = estimate.bound[plant.meters]
    top = np.maximum(estimate.v2[plant.meters], 0.0) + around
    threshold = reading_error(plant.accuracy, top, options.sigmas) + around
    score = np.where(inputs.live, 0.0, np.nan)
    at = word.block[word.reading]
    fitted, alone = np.abs(found.residual[index]), np.abs(word.s)
    worse = alone * found.limit[index] > fitted * found.reach
    score[at] = (np.where(worse, alone, fitted) * word.unit)[word.reading]
    threshold[at] = (np.where(worse, found.reach, found.limit[index]) * word.unit)[word.reading]
    return score, threshold


def _explanations(found: Fits) -> tuple[Explanation, ...]:
    """Sets of manipulated meters that explain all readings; worst-case bounds imply no probabilities."""
    sets = found.left_out[found.credible]
    if not 1 < len(sets) <= _SHOWN:
        return ()
    return tuple(Explanation(meters, np.zeros(0, dtype=np.bool_), 1.0 / len(sets)) for meters in sets)
