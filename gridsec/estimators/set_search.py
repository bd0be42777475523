"""Switched observer that searches for another set of trusted meters when its own test fails.

kim2018 and lee2018, chapter 5, do not run an observer for every set. They trust one set of meters while
all of its readings agree with its estimate, and search for another one only if they do not:

1. *One observer.* Inverters with a trusted meter are driven by that meter's reading, all others by the
   model; the set may change at any moment (`gridsec.observers.certificates`).
2. *Test.* `|y_j - yhat_j| <= threshold_j(t)` for every trusted meter j. The threshold is the worst case of
   `gridsec.estimators.detection` for exactly this set. After a switch it starts from the saturation bound
   and falls as the transient of the observer decays.
3. *Search.* If the test fails, every set D of at most M dropped meters is tried, the smallest first, and
   among equals the one with the smallest residuals. D passes if all other meters are within `threshold_j(D)`,
   which uses only their own readings: an inverter with a meter in D, or without one, may be anywhere within
   saturation. Named meters stay dropped as long as possible.
4. *Dwell.* A dropped meter is trusted again once it was within its limit for a time Delta, and for `release`
   consecutive readings.

If at most M meters are manipulated, they are one of the sets that pass. So a meter in *every* passing set is
manipulated, and only such meters are named. If several smallest sets pass, all of them are given as
explanations, and no meter outside one of them is named.

The papers' sets have partial observers of their own, with estimates that can be compared at once. Here a
candidate is judged by the injections that its members' readings alone imply, which needs no observer.
Metered net reactive power is not used: that of a dropped meter would have to be removed, too.

Source: kim2018, section III.D, Theorem 2; lee2018, section 5.4, Theorem 5.4.3; docs/theory-high-gain.md,
section 8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible, NotObservable, Problem
from gridsec.estimators import detection
from gridsec.estimators.detection import (
    Counters,
    DecisionInputs,
    ErrorBound,
    ErrorModel,
    Motion,
    TickUncertainty,
    count,
    decide,
    no_counts,
)
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.plant import (
    EstimatorContext,
    Inputs,
    Options,
    Plant,
    PreviousStep,
    Reconstruction,
    check_plant,
    clean,
    estimator_context,
    injections,
    known,
    nothing_new,
    reconstruct,
    usual_options,
)
from gridsec.estimators.single_tick import MOST_SETS
from gridsec.grid.devices import reading_error
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, Verdict
from gridsec.observers.certificates import Certificate, certify
from gridsec.observers.lure import close_loop

__all__ = [
    "SetSearchDesign",
    "SetSearchState",
    "TrustedEstimate",
    "advance",
    "design",
    "driven_by",
    "init",
    "lost",
    "step",
    "threshold_of",
]


@dataclass(frozen=True, slots=True, eq=False)
class SetSearchDesign:
    """Design of the switched observer. p meters, c candidate sets."""

    setting: EstimatorContext
    bank: banks.Bank  # the observer: a bank for M = 0, with the trusted meters as its available meters
    errors: ErrorModel  # propagation of errors in an observer without manipulated meters
    certificate: Certificate  # proof that the observer converges for every set and every switching
    dropped: Bools  # (c, p) sets of dropped meters, the smallest first
    dwell_s: float  # Delta, s

    @property
    def observers(self) -> int:
        """Number of observers."""
        return 1


@dataclass(frozen=True, slots=True, eq=False)
class SetSearchState:
    """State between frames. m inverters, p meters."""

    t: float  # time of the last used frame, s; that of `init` before the first one
    bank: banks.BankState | None  # the observer; None before the first frame
    x: Floats  # (m,) its estimate, pu
    z: Floats  # (m,) its z at the inverters, squared pu
    y: Floats  # (p,) last readings as z, squared pu; NaN where missing
    # bound, level: bounds on its error if no trusted meter is manipulated, see `detection.advance`
    bound: ErrorBound
    level: ErrorBound
    # (m,) bound on the error of inverters with an unmanipulated own meter, under any other attack, pu
    sure: Floats
    settled: bool  # True once the transient of the start, or of the last switch, has decayed
    dropped: Bools  # (p,) meters that are not trusted
    innocent: Floats  # (p,) time since which a dropped meter is within its limit, s; infinite where it is not
    readings: Ints  # (p,) number of these readings
    tally: Counters  # counters of accusations, and the named meters
    v0_squared: Floats | float  # last squared busbar voltage, pu
    last: tuple[Estimate, Verdict] | None  # last estimate and verdict; None before the first frame


def design(
    plant: Plant,
    *,
    max_attacked: int,
    step_s: float,
    dwell_s: float | None = None,
    options: Options | None = None,
) -> SetSearchDesign:
    """Design the observer and the candidate sets for one feeder.

    max_attacked: M, largest number of simultaneously manipulated meters.
    step_s: expected interval between frames, s. Other intervals work, too.
    dwell_s: Delta, s; by default the time in which the observer's transient decays to the fraction
        `options.settled`.
    Raises NotObservable unless there are more than 2M meters; DesignInfeasible if no closed-form certificate
        holds, or there are too many sets to search; ValueError as `plant.check_plant`, or if `dwell_s` is
        negative or not finite.
    """
    p = plant.meters.size
    wrong = dwell_s is not None and not 0.0 <= dwell_s < np.inf
    more = (
        [Problem("negative", f"dwell_s is {dwell_s}; it must be a number of seconds that is not negative")]
        if wrong
        else []
    )
    check_plant(plant, max_attacked=max_attacked, step_s=step_s, more=more)
    if p <= 2 * max_attacked:
        what = f"{p} meters cannot be told apart when {max_attacked} of them may be manipulated"
        raise NotObservable(range(p), p, what, code="too-few-meters")
    sets = sum(comb(p, k) for k in range(1, max_attacked + 1))
    if sets > MOST_SETS:
        raise DesignInfeasible(
            "search over sets", f"{sets} sets of dropped meters; at most {MOST_SETS}", code="too-many"
        )
    dropped = np.zeros((sets, p), dtype=np.bool_)
    chosen = (D for k in range(1, max_attacked + 1) for D in combinations(range(p), k))
    for row, D in zip(dropped, chosen, strict=True):
        row[list(D)] = True
    options = usual_options(step_s) if options is None else options
    lure = close_loop(plant.feeder, plant.droop, plant.meters)
    proof = certify(lure)
    watched = estimator_context(plant, max_attacked=max_attacked, options=options)
    slowest = float(np.max(plant.droop.tau, initial=0.0))
    dwell = slowest * float(np.log(1.0 / options.settled)) if dwell_s is None else dwell_s
    return SetSearchDesign(
        watched, banks.design(lure, 0), replace(watched.errors, quota=0), proof, dropped, dwell
    )


def init(design: SetSearchDesign, t: float) -> SetSearchState:
    """Initial state at Unix time t, s; the observer starts with the first frame and trusts all meters."""
    plant, widest = design.setting.plant, detection.widest(design.errors)
    m, p = plant.droop.tau.size, plant.meters.size
    return SetSearchState(
        t=t,
        bank=None,
        x=np.zeros(m),
        z=np.zeros(m),
        y=np.full(p, np.nan),
        bound=widest,
        level=widest,
        sure=widest.free,
        settled=False,
        dropped=np.zeros(p, dtype=np.bool_),
        innocent=np.full(p, np.inf),
        readings=np.zeros(p, dtype=np.intp),
        tally=no_counts(p),
        v0_squared=plant.droop.vbar**2,
        last=None,
    )


@dataclass(frozen=True, slots=True, eq=False)
class TrustedEstimate:
    """Estimate of the feeder from the trusted set. N customers, p meters, m inverters."""

    state: SetSearchState  # after the frame, with the trusted meters and the answer before it
    seen: Reconstruction
    base: Floats  # (N,) error of the voltages for known injections, squared pu
    # score, threshold (p,): residuals, NaN without a reading, and their limits if no trusted meter is
    # manipulated
    score: Floats
    threshold: Floats
    over: Bools  # (p,) meters with a residual above its limit


def advance(design: SetSearchDesign, state: SetSearchState, frame: Frame, inputs: Inputs) -> TrustedEstimate:
    """Advance the observer to a frame, and compare all meters with it."""
    watched, errors, at = design.setting, design.errors, design.setting.plant.meters
    plant, droop = watched.plant, watched.plant.droop
    J = inputs.live & ~state.dropped
    h = 0.0 if state.bank is None else frame.t - state.t
    if state.bank is None:
        bank = banks.init(design.bank, inputs.z, inputs.w, J)
    else:
        bank = banks.step(design.bank, state.bank, inputs.z, inputs.w, J, h, adopt=state.x)
    x = banks.estimate(design.bank, bank, -1)
    none = np.zeros(J.size, dtype=np.bool_)
    seen = reconstruct(watched, frame, inputs, injections(plant, frame, x, none))
    z = droop.vbar**2 - seen.v2[droop.customer]
    now = replace(inputs.now, base=inputs.now.base + seen.moved, live=J)
    lag = np.where(detection.slowed(errors, h, design.bank.policy), np.abs(x - state.x), 0.0)
    before = z if state.bank is None else state.z
    motion = Motion(before=before, after=z, offset=np.zeros(x.shape), h=h, lag=lag)
    handed = state.bound
    if state.bank is not None:
        handed = detection.handed_over(errors, handed, state.bank.seen, J)
    bound, level = detection.advance(errors, now, motion, handed, state.level)
    error = detection.gap(errors, now, bound)
    threshold = threshold_of(design, seen.v2[at], error[at])
    score = np.where(inputs.live, np.abs(inputs.y - seen.v2[at]), np.nan)
    after = replace(
        state,
        t=frame.t,
        bank=bank,
        x=x,
        z=z,
        y=np.where(inputs.live, inputs.z, np.nan),
        bound=bound,
        level=level,
        sure=_sure(design, state, inputs, J, motion),
        settled=state.settled or _settled(design, now, motion, error, threshold),
        v0_squared=inputs.v0_squared,
    )
    over = inputs.live & (np.nan_to_num(score) > threshold)
    return TrustedEstimate(after, seen, now.base, score, threshold, over)


def driven_by(design: SetSearchDesign, J: Bools) -> Bools:
    """Mask (m,) of inverters driven by a trusted meter, for the trusted meters J (p,)."""
    meter = design.errors.meter_of
    return (meter >= 0) & J[meter]


def _sure(design: SetSearchDesign, state: SetSearchState, inputs: Inputs, J: Bools, motion: Motion) -> Floats:
    """Error of each inverter that follows from its own unmanipulated meter alone; the span without one.

    During the step its argument was between two readings, each within its accuracy.
    """
    errors, droop = design.errors, design.setting.plant.droop
    meter, driven = errors.meter_of, driven_by(design, J & np.isfinite(state.y))
    z = np.where(driven, inputs.z[meter], 0.0)
    past, off = np.where(driven, state.y[meter], 0.0), np.where(driven, inputs.now.reading[meter], 0.0)
    most, own, least = droop(np.stack([np.maximum(z, past) + off, z, np.minimum(z, past) - off]))
    image = np.minimum(np.maximum(most - own, own - least) + errors.mismatch + motion.lag, errors.span)
    keep = np.exp(-motion.h / droop.tau)
    return np.where(driven, keep * state.sure + (1.0 - keep) * image, errors.span)


def threshold_of(design: SetSearchDesign, v2: Floats, error: Floats) -> Floats:
    """Largest residual of an unmanipulated meter for an estimate with an error of at most `error`.

    v2 (p,): reconstructed squared voltages at the meters, pu.
    error (…, p): their error bounds, squared pu.
    """
    plant, sigmas = design.setting.plant, design.setting.options.sigmas
    return np.asarray(reading_error(plant.accuracy, v2 + error, sigmas) + error)


def _settled(
    design: SetSearchDesign, now: TickUncertainty, motion: Motion, error: Floats, threshold: Floats
) -> bool:
    """True once the remaining transient is negligible against every threshold."""
    rest = detection.gap(design.errors, now, detection.at_rest(design.errors, now, motion))
    transient = (error - rest)[design.setting.plant.meters]
    return bool(np.all(transient <= design.setting.options.settled * threshold))


def lost(errors: ErrorModel, sure: Floats) -> Floats:
    """Additional error at every customer without one meter, (N, p): its inverter may inject anything."""
    metered, p = errors.meter_of >= 0, errors.meters.size
    more = np.bincount(errors.meter_of[metered], weights=(errors.span - sure)[metered], minlength=p)
    return np.asarray(errors.reach * more)


def step(
    design: SetSearchDesign, state: SetSearchState, frame: Frame
) -> tuple[SetSearchState, Estimate, Verdict]:
    """Process one frame; see `gridsec.interface`."""
    if not np.isfinite(frame.t) or (state.bank is not None and not frame.t > state.t):
        plant = design.setting.plant
        return state, *nothing_new(plant, frame, state.t, state.last, state.v0_squared, state.x)
    frame = known(frame)
    inputs = clean(design.setting, PreviousStep(state.x, state.v0_squared, state.tally.named), frame)
    view = advance(design, state, frame, inputs)
    found = _Found(state.dropped, view.over & ~state.dropped, (), False)
    unsure = view.over & state.dropped & ~state.tally.named
    if (view.over & ~state.dropped).any() or unsure.any():
        found = _search(design, inputs, view, state)
    return _conclude(design, state, frame, inputs, view, found)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Result of a search. p meters."""

    dropped: Bools  # (p,) meters not to trust
    accused: Bools  # (p,) meters that are certainly manipulated
    rivals: tuple[Bools, ...]  # several smallest sets
    torn: bool  # no set passes


def _search(design: SetSearchDesign, inputs: Inputs, view: TrustedEstimate, state: SetSearchState) -> _Found:
    """Test all sets of at most M dropped meters by the injections that their own readings imply."""
    errors, at, live = design.errors, design.setting.plant.meters, inputs.live
    sets = design.dropped[~(design.dropped & ~live).any(axis=1)]
    sure = view.state.sure
    error = (view.base + errors.inverters @ sure)[at] + sets @ lost(errors, sure)[at].T
    limit = threshold_of(design, view.seen.v2[at], error)
    excess = np.where(live & ~sets, np.nan_to_num(view.score) / limit, 0.0).max(axis=1, initial=0.0)
    fine = np.flatnonzero(excess <= 1.0)
    if not fine.size:
        return _Found(state.dropped, np.zeros_like(live), (), True)
    accused = np.asarray(sets[fine].all(axis=0))
    known = fine[(sets[fine] >= (state.tally.named & live)).all(axis=1)]
    pool = known if known.size else fine
    sizes = sets[pool].sum(axis=1)
    smallest = pool[sizes == sizes[0]]
    best = sets[smallest[np.argmin(excess[smallest])]]
    rivals = tuple(sets[smallest]) if smallest.size > 1 else ()
    # A missing reading does not clear a meter: dropped and unavailable meters stay dropped.
    return _Found(best | (state.dropped & ~live), accused, rivals, False)


def _conclude(  # noqa: PLR0917  # design, state and frame, then the results of this step
    design: SetSearchDesign,
    state: SetSearchState,
    frame: Frame,
    inputs: Inputs,
    view: TrustedEstimate,
    found: _Found,
) -> tuple[SetSearchState, Estimate, Verdict]:
    options, live = design.setting.options, inputs.live
    held = state.tally.named & view.over & found.dropped
    accused = found.accused | held
    tally = count(state.tally, accused, live, confirm=options.confirm, release=options.release)
    quiet = found.dropped & live & ~view.over
    innocent = np.where(quiet, np.minimum(state.innocent, frame.t), np.where(live, np.inf, state.innocent))
    readings = np.where(quiet, state.readings + 1, np.where(live, 0, state.readings))
    back = quiet & (frame.t - innocent >= design.dwell_s) & (readings >= options.release)
    dropped = found.dropped & ~back
    tally = replace(tally, named=tally.named & dropped, above=np.where(back, 0, tally.above))
    switched = bool((dropped & ~state.dropped).any())
    # Effect of an attack on the meter's own inverter and, through the model, on those without a trusted
    # meter.
    bound, level, settled = view.state.bound, view.state.level, view.state.settled
    if switched:
        free = np.where(driven_by(design, live & ~dropped), bound.free, design.errors.span)
        bound, level, settled = ErrorBound(view.state.sure, free), detection.widest(design.errors), False
    after = replace(
        view.state,
        bound=bound,
        level=level,
        settled=settled,
        dropped=dropped,
        innocent=np.where(dropped, innocent, np.inf),
        readings=np.where(dropped, readings, 0),
        tally=tally,
    )
    error = _error(design, view, found.torn)
    estimate = Estimate(frame.t, view.seen.v2, error, view.seen.v2_bus, live & ~dropped, after.x)
    verdict = _verdict(design, after, inputs, view, found)
    return replace(after, last=(estimate, verdict)), estimate, verdict


def _error(design: SetSearchDesign, view: TrustedEstimate, torn: bool) -> Floats:
    """Half-width of the estimate for any M manipulated meters, detected or not; (N,)."""
    errors, sure = design.errors, view.state.sure
    if torn:
        return np.asarray(view.base + errors.inverters @ errors.span)
    most = detection.largest(lost(errors, sure), design.setting.max_attacked)
    return np.asarray(view.base + errors.inverters @ sure + most)


def _verdict(
    design: SetSearchDesign, after: SetSearchState, inputs: Inputs, view: TrustedEstimate, found: _Found
) -> Verdict:
    plant, live, tally = design.setting.plant, inputs.live, after.tally
    decision, cause, reason = decide(
        DecisionInputs(
            names=plant.meter_names,
            max_attacked=design.setting.max_attacked,
            live=live,
            suspected=(tally.above > 0) | after.dropped,
            named=tally.named,
            wide=live & ~(view.threshold <= design.setting.options.widest),
            valid=True,
            settled=after.settled,
            busbar=inputs.busbar,
        )
    )
    if found.torn and cause not in {Cause.TOO_FEW_METERS, Cause.NO_BUSBAR}:
        decision, cause = Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS
        reason = (
            f"Without any {design.setting.max_attacked} meters, the others contradict each other: "
            "more are manipulated, or the busbar reading, a switch or a line in the model is wrong."
        )
    attack = np.where(tally.named & live, inputs.y - view.seen.v2[plant.meters], 0.0)
    none = np.zeros(plant.droop.tau.size, dtype=np.bool_)
    share = 1.0 / max(len(found.rivals), 1)
    return Verdict(
        decision,
        cause,
        reason,
        tally.named,
        view.score,
        view.threshold,
        attack,
        explanations=tuple(Explanation(meters, none, share) for meters in found.rivals),
    )
