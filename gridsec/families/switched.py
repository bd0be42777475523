"""One observer whose believed meters may change at any moment, with bounds on its error.

It belongs to `gridsec.families.set_search`, which decides who is believed.

References
----------
docs/theory-high-gain.md, section 8; docs/theory-detection.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from gridsec import bank as banks
from gridsec import detect
from gridsec.accuracy import reading_error
from gridsec.arrays import Bools, Floats, Ints
from gridsec.certificates import Certificate, certify
from gridsec.detect import ErrorBound, ErrorModel, Motion, Uncertainty
from gridsec.errors import DesignInfeasible, NotObservable, Problem
from gridsec.families.sets import MOST_SETS
from gridsec.frames import Inputs, injections, reconstruct
from gridsec.judge import Tally
from gridsec.lure import close_loop, rest
from gridsec.online import Estimate, Frame, Verdict
from gridsec.plant import Options, Plant, Setting, check_plant, setting


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
    v0_squared: Floats | float
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
        As `plant.check_plant`, or if `dwell_s` is negative or not finite.
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
        what = f"{p} meters cannot be told apart when {max_attacked} of them may lie"
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


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The feeder as the believed set sees it. N customers, p meters, m inverters.

    Attributes
    ----------
    bank, x, z, bound, level, sure, settled
        As in `SetSearchState`, at this frame.
    v2, v2_bus : (N,), (b + 1,)
        Reconstructed squared voltages, pu.
    base : (N,)
        Error of `v2` if all injections were known, squared pu.
    score, threshold : (p,)
        Residuals, NaN where there is no reading, and their limits if all believed meters are honest.
    over : (p,)
        Whose residual is above its limit.
    """

    bank: banks.BankState
    x: Floats
    z: Floats
    bound: ErrorBound
    level: ErrorBound
    sure: Floats
    settled: bool
    v2: Floats
    v2_bus: Floats
    base: Floats
    score: Floats
    threshold: Floats
    over: Bools


def advance(design: SetSearchDesign, state: SetSearchState, frame: Frame, inputs: Inputs) -> View:
    """Move the observer to a frame, and compare all meters with it.

    Parameters
    ----------
    design, state
        Design and state.
    frame, inputs
        The frame, and what came of it when it was cleaned.
    """
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
    threshold = threshold_of(design, seen.v2[at], error[at])
    score = np.where(inputs.live, np.abs(inputs.y - seen.v2[at]), np.nan)
    return View(
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
        score=score,
        threshold=threshold,
        over=inputs.live & (np.nan_to_num(score) > threshold),
    )


def _slowed(design: SetSearchDesign, h: float) -> Bools:
    """Inverters that the step takes for slower than they are: `lure.transition`, `rest`; (m,)."""
    fast = design.setting.plant.droop.tau * rest(h, design.bank.policy) < 1.0
    return fast & ~fast.all()


def driven_by(design: SetSearchDesign, J: Bools) -> Bools:
    """Inverters that a believed meter drives, (m,).

    Parameters
    ----------
    design
        Design.
    J : (p,)
        The believed meters.
    """
    meter = design.errors.meter_of
    return (meter >= 0) & J[meter]


def _handed_over(design: SetSearchDesign, state: SetSearchState, J: Bools) -> ErrorBound:
    """The bounds when meters fall silent or return: each inverter takes over the other way's error."""
    if state.bank is None:
        return state.bound
    was, now = driven_by(design, state.bank.seen), driven_by(design, J)
    free = np.where(was & ~now, np.maximum(state.bound.free, state.bound.driven), state.bound.free)
    return ErrorBound(np.where(now & ~was, state.bound.free, state.bound.driven), free)


def _sure(design: SetSearchDesign, state: SetSearchState, inputs: Inputs, J: Bools, motion: Motion) -> Floats:
    """Error of each inverter that follows from its own honest meter alone; the span where it has none.

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
    """Largest residual of an honest meter where the estimate is off by no more than `error`.

    Parameters
    ----------
    design
        Design.
    v2 : (p,)
        Reconstructed squared voltages at the meters, pu.
    error : (…, p)
        How far these may be off, squared pu.
    """
    plant, sigmas = design.setting.plant, design.setting.options.sigmas
    return np.asarray(reading_error(plant.accuracy, v2 + error, sigmas) + error)


def _settled(
    design: SetSearchDesign, now: Uncertainty, motion: Motion, error: Floats, threshold: Floats
) -> bool:
    """Whether what is left of the transient does not matter to any threshold."""
    none, at = np.zeros(motion.after.shape), design.setting.plant.meters
    top = detect.ceiling(design.errors, now, motion, ErrorBound(none, none))
    rest_ = detect.gap(design.errors, now, detect.settled(design.errors, now, motion, top))
    return bool(np.all((error - rest_)[at] <= design.setting.options.settled * threshold))


def lost(errors: ErrorModel, sure: Floats) -> Floats:
    """What is lost at every customer without the word of one meter, (N, p): its inverter may be anywhere.

    Parameters
    ----------
    errors
        How errors travel.
    sure : (m,)
        Error of each inverter that follows from its own meter, pu.
    """
    metered, p = errors.meter_of >= 0, errors.meters.size
    more = np.bincount(errors.meter_of[metered], weights=(errors.span - sure)[metered], minlength=p)
    return np.asarray(errors.reach * more)
