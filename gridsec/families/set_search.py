"""One switched observer that searches for another set of meters when its own test fails.

kim2018 and lee2018, chapter 5, do not run an observer for every set. They believe one set of meters as long
as all of its readings agree with its estimate, and look for another one only when they do not:

1. *One observer.* Inverters with a believed meter are driven by that meter's reading, all others by the
   model; the set may change at any moment (`gridsec.certificates`).
2. *Test.* `|y_j - yhat_j| <= threshold_j(t)` for every believed meter j. The threshold is the worst case of
   `gridsec.detect` for just this set. After a switch it starts from what saturation allows and falls, as the
   observer forgets.
3. *Search.* Where the test fails, every set D of at most M dropped meters is tried, the smallest first, and
   of equals the one that leaves the smallest residuals. D passes if all other meters are within
   `threshold_j(D)`, which takes nothing for granted but their own readings: an inverter whose meter is in
   D, or that has none, may be anywhere within saturation. Who was named is left out as long as possible.
4. *Dwell.* A dropped meter is believed again once it was within its limit for a time Delta, and for `release`
   readings in a row.

The true liars, if they are at most M, are one of the sets that pass. So a meter that *every* passing set
holds lies, whatever else is true, and only such meters are named. Where several smallest sets pass, all of
them are given as explanations, and nobody is named whom one of them acquits.

The papers' sets come with their own partial observers, whose estimates can be compared at once. Here a
candidate is judged by what its members' readings alone imply for their inverters, which costs no observer.
Metered net reactive power is not used: a dropped meter's would have to be forgotten, too.

References
----------
kim2018, section IV; lee2018, section 5.3; docs/theory-high-gain.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from gridsec import bank as banks
from gridsec import detect
from gridsec.arrays import Bools, Floats, Ints
from gridsec.certificates import Certificate, certify
from gridsec.detect import ErrorBound, ErrorModel, Motion, Uncertainty
from gridsec.errors import DesignInfeasible, NotObservable
from gridsec.frames import NO_VOLTAGE, Inputs, Past, clean, injections, reconstruct
from gridsec.judge import Situation, Tally, count, decide
from gridsec.lure import close_loop, rest
from gridsec.online import Cause, Decision, Estimate, Explanation, Frame, Verdict
from gridsec.plant import Options, Plant, Setting, setting

MOST_SETS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class SetSearchDesign:
    """Everything that is prepared offline. p meters, c candidate sets.

    Attributes
    ----------
    setting
        What a frame is cleaned with.
    bank
        The observer; a bank for no liar at all, whose live meters are the believed ones.
    errors
        How errors travel in an observer whose meters are all honest.
    certificate
        Why the observer converges for every set and every switching.
    dropped : (c, p)
        Sets of dropped meters, the smallest first.
    dwell_s
        Delta, s.
    """

    setting: Setting
    bank: banks.Bank
    errors: ErrorModel
    certificate: Certificate
    dropped: Bools
    dwell_s: float

    @property
    def observers(self) -> int:
        """How many observers run."""
        return 1


@dataclass(frozen=True, slots=True, eq=False)
class SetSearchState:
    """What is carried from frame to frame. m inverters, p meters.

    Attributes
    ----------
    t
        Time of the last frame that was used, s; of `init` before the first one.
    bank
        The observer; None before the first frame.
    x : (m,)
        Its estimate, pu.
    z : (m,)
        What it says at the inverters, squared pu.
    y : (p,)
        Last readings as z, squared pu; NaN where there was none.
    bound, level
        Bounds on its error if all believed meters are honest, see `detect.advance`.
    sure : (m,)
        Bound on the error of inverters whose own meter is honest, whoever else lies, pu.
    settled
        Whether what was unknown at the start, or at the last switch, is forgotten.
    dropped : (p,)
        Meters that are not believed.
    innocent : (p,)
        Since when a dropped meter has been within its limit, s; infinite where it has not.
    readings : (p,)
        For how many readings.
    tally
        Who is suspected, and who is named.
    v0_squared
        Last squared busbar voltage, pu.
    last
        The last estimate and verdict; None before the first frame.
    """

    t: float
    bank: banks.BankState | None
    x: Floats
    z: Floats
    y: Floats
    bound: ErrorBound
    level: ErrorBound
    sure: Floats
    settled: bool
    dropped: Bools
    innocent: Floats
    readings: Ints
    tally: Tally
    v0_squared: float
    last: tuple[Estimate, Verdict] | None


def design(
    plant: Plant,
    *,
    max_attacked: int,
    step_s: float,
    dwell_s: float | None = None,
    options: Options | None = None,
) -> SetSearchDesign:
    """Prepare to watch a feeder.

    Parameters
    ----------
    plant
        What is watched.
    max_attacked
        M, how many meters may be manipulated at the same time.
    step_s
        Expected interval between frames, s. Other intervals work, too.
    dwell_s
        Delta, s; by default the time in which the observer forgets all but the part `options.settled` of
        what it did not know.
    options
        The numbers that decide.

    Raises
    ------
    NotObservable
        Unless there are more than 2M meters.
    DesignInfeasible
        If no closed-form certificate holds, or there are too many sets to search.
    ValueError
        If a number is out of range.
    """
    p = plant.meters.size
    if not (np.isfinite(step_s) and step_s > 0 and max_attacked >= 0):
        raise ValueError("step_s must be a positive number of seconds, and max_attacked not negative")
    if p <= 2 * max_attacked:
        what = f"{p} meters cannot be told apart when {max_attacked} of them may lie"
        raise NotObservable(range(p), p, what)
    sets = sum(comb(p, k) for k in range(1, max_attacked + 1))
    if sets > MOST_SETS:
        raise DesignInfeasible("search over sets", f"{sets} sets of dropped meters; at most {MOST_SETS}")
    dropped = np.zeros((sets, p), dtype=np.bool_)
    chosen = (D for k in range(1, max_attacked + 1) for D in combinations(range(p), k))
    for row, D in zip(dropped, chosen, strict=True):
        row[list(D)] = True
    if options is None:
        options = Options() if step_s <= 30.0 else Options(release=4)
    lure = close_loop(plant.feeder, plant.droop, plant.meters)
    proof = certify(lure)
    watched = setting(plant, max_attacked=max_attacked, options=options)
    slowest = float(np.max(plant.droop.tau, initial=0.0))
    dwell = slowest * float(np.log(1.0 / options.settled)) if dwell_s is None else dwell_s
    return SetSearchDesign(
        watched, banks.design(lure, 0), replace(watched.errors, quota=0), proof, dropped, dwell
    )


def init(design: SetSearchDesign, t: float) -> SetSearchState:
    """Begin to watch; the observer starts with the first frame, and believes all meters.

    Parameters
    ----------
    design
        From `design`.
    t
        Unix time, s.
    """
    plant, widest = design.setting.plant, detect.widest(design.errors)
    m, p = plant.droop.tau.size, plant.meters.size
    nobody, zero = np.zeros(p, dtype=np.bool_), np.zeros(p, dtype=np.intp)
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
        dropped=nobody,
        innocent=np.full(p, np.inf),
        readings=zero,
        tally=Tally(zero, zero, nobody),
        v0_squared=plant.droop.vbar**2,
        last=None,
    )


def step(
    design: SetSearchDesign, state: SetSearchState, frame: Frame
) -> tuple[SetSearchState, Estimate, Verdict]:
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
    SetSearchState, Estimate, Verdict
        As every estimator's step; see `gridsec.online`.
    """
    if not np.isfinite(frame.t) or (state.bank is not None and not frame.t > state.t):
        return _unusable(design, state, frame)
    inputs = clean(design.setting, Past(state.x, state.v0_squared, state.tally.named), frame)
    view = _advance(design, state, frame, inputs)
    found = _Found(state.dropped, view.over & ~state.dropped, (), False)
    unsure = view.over & state.dropped & ~state.tally.named
    if (view.over & ~state.dropped).any() or unsure.any():
        found = _search(design, inputs, view, state)
    return _conclude(design, state, frame, inputs, view, found)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """The feeder as the believed set sees it. N customers, p meters, m inverters."""

    bank: banks.BankState
    x: Floats
    z: Floats
    bound: ErrorBound
    level: ErrorBound
    sure: Floats
    settled: bool
    v2: Floats
    v2_bus: Floats
    base: Floats  # (N,)
    error: Floats  # (N,)
    score: Floats  # (p,) NaN where not live
    threshold: Floats  # (p,)
    over: Bools  # (p,)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a search came to. p meters."""

    dropped: Bools  # (p,) whom not to believe
    accused: Bools  # (p,) who lies for sure
    rivals: tuple[Bools, ...]  # several smallest sets
    torn: bool  # no set passes


def _advance(design: SetSearchDesign, state: SetSearchState, frame: Frame, inputs: Inputs) -> _View:
    """Move the observer to the frame, and compare all meters with it."""
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
    moved = np.abs(seen.correction - inputs.correction)[plant.feeder.bus]
    now = replace(inputs.now, base=inputs.now.base + moved, live=J)
    lag = np.where(_slowed(design, h), np.abs(x - state.x), 0.0)
    before = z if state.bank is None else state.z
    motion = Motion(before=before, after=z, offset=np.zeros(x.shape), h=h, lag=lag)
    handed = _handed_over(design, state, J)
    bound, level = detect.advance(errors, now, motion, handed, state.level)
    error = detect.gap(errors, now, bound)
    threshold = _threshold(design, seen.v2[at], error[at])
    score = np.where(inputs.live, np.abs(inputs.y - seen.v2[at]), np.nan)
    return _View(
        bank=bank,
        x=x,
        z=z,
        bound=bound,
        level=level,
        sure=_sure(design, state, inputs, J, motion),
        settled=state.settled or _settled(design, now, motion, error, threshold),
        v2=seen.v2,
        v2_bus=seen.v2_bus,
        base=now.base,
        error=error,
        score=score,
        threshold=threshold,
        over=inputs.live & (np.nan_to_num(score) > threshold),
    )


def _slowed(design: SetSearchDesign, h: float) -> Bools:
    """Inverters that the step takes for slower than they are: `lure.transition`, `rest`; (m,)."""
    fast = design.setting.plant.droop.tau * rest(h, design.bank.policy) < 1.0
    return fast & ~fast.all()


def _driven(design: SetSearchDesign, J: Bools) -> Bools:
    """Inverters that a meter of J drives, (m,)."""
    meter = design.errors.meter_of
    return (meter >= 0) & J[meter]


def _handed_over(design: SetSearchDesign, state: SetSearchState, J: Bools) -> ErrorBound:
    """The bounds when meters fall silent or return: each inverter takes over the other way's error."""
    if state.bank is None:
        return state.bound
    was, now = _driven(design, state.bank.seen), _driven(design, J)
    free = np.where(was & ~now, np.maximum(state.bound.free, state.bound.driven), state.bound.free)
    return ErrorBound(np.where(now & ~was, state.bound.free, state.bound.driven), free)


def _sure(design: SetSearchDesign, state: SetSearchState, inputs: Inputs, J: Bools, motion: Motion) -> Floats:
    """Error of each inverter that follows from its own honest meter alone; the span where it has none.

    During the step its argument was between two readings, each within its accuracy.
    """
    errors, droop = design.errors, design.setting.plant.droop
    meter, driven = errors.meter_of, _driven(design, J & np.isfinite(state.y))
    z = np.where(driven, inputs.z[meter], 0.0)
    past, off = np.where(driven, state.y[meter], 0.0), np.where(driven, inputs.now.reading[meter], 0.0)
    most, own, least = droop(np.stack([np.maximum(z, past) + off, z, np.minimum(z, past) - off]))
    image = np.minimum(np.maximum(most - own, own - least) + errors.mismatch + motion.lag, errors.span)
    keep = np.exp(-motion.h / droop.tau)
    return np.where(driven, keep * state.sure + (1.0 - keep) * image, errors.span)


def _threshold(design: SetSearchDesign, v2: Floats, error: Floats) -> Floats:
    """Largest residual of an honest meter where the estimate is off by no more than `error`."""
    plant, sigmas = design.setting.plant, design.setting.options.sigmas
    return np.asarray(detect.reading_error(plant.accuracy, v2 + error, sigmas) + error)


def _settled(
    design: SetSearchDesign, now: Uncertainty, motion: Motion, error: Floats, threshold: Floats
) -> bool:
    """Whether what is left of the transient does not matter to any threshold."""
    none, at = np.zeros(motion.after.shape), design.setting.plant.meters
    top = detect.ceiling(design.errors, now, motion, ErrorBound(none, none))
    rest_ = detect.gap(design.errors, now, detect.settled(design.errors, now, motion, top))
    return bool(np.all((error - rest_)[at] <= design.setting.options.settled * threshold))


def _search(design: SetSearchDesign, inputs: Inputs, view: _View, state: SetSearchState) -> _Found:
    """Try all sets of at most M dropped meters against what their own readings imply."""
    errors, at, live = design.errors, design.setting.plant.meters, inputs.live
    sets = design.dropped[~(design.dropped & ~live).any(axis=1)]
    error = (view.base + errors.inverters @ view.sure)[at] + sets @ _lost(errors, view.sure)[at].T
    limit = _threshold(design, view.v2[at], error)
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
    # Silence is no acquittal: who was dropped and reports no more stays so.
    return _Found(best | (state.dropped & ~live), accused, rivals, False)


def _conclude(  # noqa: PLR0917  # the chain's three values, then what this step added
    design: SetSearchDesign, state: SetSearchState, frame: Frame, inputs: Inputs, view: _View, found: _Found
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
    # What a liar did to its own inverter and, through the model, to those without a believed meter.
    driven = _driven(design, live & ~dropped)
    free = np.where(driven, view.bound.free, design.errors.span)
    estimate = Estimate(
        frame.t, view.v2, _error(design, view, found.torn), view.v2_bus, live & ~dropped, view.x
    )
    verdict = _verdict(design, inputs, view, found, tally, dropped, switched)
    after = SetSearchState(
        t=frame.t,
        bank=view.bank,
        x=view.x,
        z=view.z,
        y=np.where(live, inputs.z, np.nan),
        bound=ErrorBound(view.sure, free) if switched else view.bound,
        level=detect.widest(design.errors) if switched else view.level,
        sure=view.sure,
        settled=view.settled and not switched,
        dropped=dropped,
        innocent=np.where(dropped, innocent, np.inf),
        readings=np.where(dropped, readings, 0),
        tally=tally,
        v0_squared=inputs.v0_squared,
        last=(estimate, verdict),
    )
    return after, estimate, verdict


def _lost(errors: ErrorModel, sure: Floats) -> Floats:
    """What is lost at every customer without the word of one meter, (N, p): its inverter may be anywhere."""
    metered, p = errors.meter_of >= 0, errors.meters.size
    more = np.bincount(errors.meter_of[metered], weights=(errors.span - sure)[metered], minlength=p)
    return np.asarray(errors.reach * more)


def _error(design: SetSearchDesign, view: _View, torn: bool) -> Floats:
    """Half-width of the estimate that holds whichever M meters lie, found out or not; (N,)."""
    errors = design.errors
    if torn:
        return np.asarray(view.base + errors.inverters @ errors.span)
    most = detect.largest(_lost(errors, view.sure), design.setting.max_attacked)
    return np.asarray(view.base + errors.inverters @ view.sure + most)


def _verdict(  # noqa: PLR0917  # everything one tick brought
    design: SetSearchDesign,
    inputs: Inputs,
    view: _View,
    found: _Found,
    tally: Tally,
    dropped: Bools,
    switched: bool,
) -> Verdict:
    plant, live = design.setting.plant, inputs.live
    decision, cause, reason = decide(
        Situation(
            names=tuple(plant.feeder.customers[c] for c in plant.meters),
            max_attacked=design.setting.max_attacked,
            live=live,
            suspected=(tally.above > 0) | dropped,
            named=tally.named,
            wide=live & (view.threshold > design.setting.options.widest),
            valid=True,
            settled=view.settled and not switched,
            busbar=inputs.busbar,
        )
    )
    if found.torn and cause not in {Cause.TOO_FEW_METERS, Cause.NO_BUSBAR}:
        decision, cause = Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS
        reason = (
            f"Whichever {design.setting.max_attacked} meters are left out, the others contradict each other: "
            "more are manipulated, or the busbar reading, a switch or a line in the model is wrong."
        )
    attack = np.where(tally.named & live, inputs.y - view.v2[plant.meters], 0.0)
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


def _unusable(
    design: SetSearchDesign, state: SetSearchState, frame: Frame
) -> tuple[SetSearchState, Estimate, Verdict]:
    """The answer to a frame that is not later than the last one: nothing new, and certainly not CLEAN."""
    plant = design.setting.plant
    p, n = plant.meters.size, plant.feeder.bus.size
    reason = f"A frame of time {frame.t} is not later than the last one, {state.t}; it was not used."
    if state.last is not None:
        estimate, verdict = state.last
        return (
            state,
            estimate,
            replace(verdict, decision=Decision.UNDECIDED, cause=Cause.SETTLING, reason=reason),
        )
    v2 = np.full(len(plant.feeder.buses), state.v0_squared)
    nobody = np.zeros(p, dtype=np.bool_)
    estimate = Estimate(state.t, v2[plant.feeder.bus], np.full(n, NO_VOLTAGE), v2, nobody, state.x)
    far = np.full(p, NO_VOLTAGE)
    verdict = Verdict(
        Decision.UNDECIDED, Cause.SETTLING, reason, nobody, np.full(p, np.nan), far, np.zeros(p)
    )
    return state, estimate, verdict
