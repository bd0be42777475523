"""Partial observers on a feeder: observers of single meters, stacked and decoded; lee2018, Algorithm 4.1.

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

with the rows of meter j as block j, each in units of its own worst-case bound from `gridsec.detect`. All
C(p, M) fits without M meters are computed at every frame (`gridsec.decode.boxes`). Shared errors are one
unknown, not one for every meter; this provides the evidence.

A fit is credible if it explains every meter in it, as the observer without meters must by itself. A meter is
named if it is in no credible fit. An unmanipulated meter belongs to some set of p - M unmanipulated ones, and
that set's fit is credible. So, with at most M manipulated meters, no unmanipulated meter is ever named, and
the true state is within the union of the credible fits. The price is power: with more allowed manipulations,
more fits can explain a small attack differently. Then the answer is UNDECIDED, with these explanations.

The paper's own constants (theta, kappa) are available from `constants`; on feeders they guarantee less than
is known without any meter. docs/theory-partial-observers.md, section 8, has the proof and the numbers.

References
----------
lee2018, sections 4.2.1 and 4.3.1, Algorithm 4.1, Theorems 2.2.11 and 4.3.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np

from gridsec import detect
from gridsec.accuracy import reading_error
from gridsec.arrays import Bools, Floats
from gridsec.certificates import Certificate, verify
from gridsec.decode.boxes import Fits, fits
from gridsec.decode.stacks import MOST_SUBSETS
from gridsec.detect import Uncertainty
from gridsec.errors import DesignInfeasible, NotObservable
from gridsec.families.codeword import CodeWord, Parts, code_word, constants, disputed, observe, start
from gridsec.frames import Inputs, Past, Reconstruction, clean, known, nothing_new
from gridsec.judge import Situation, Tally, count, decide
from gridsec.lure import close_loop
from gridsec.network import busbar_places, by_place
from gridsec.observers import circle
from gridsec.observers.circle import CircleDesign
from gridsec.online import Cause, Decision, Estimate, Explanation, Frame, Verdict
from gridsec.plant import Options, Plant, Setting, check_plant, setting

__all__ = ["PartialDesign", "PartialState", "constants", "design", "init", "step"]

MOST_WORK = 3e7
"""Limit of the entries of all fits together per second of interval: about half of the capacity of one core.
"""

_SHOWN = 8


@dataclass(frozen=True, slots=True, eq=False)
class PartialDesign:
    """Design of the partial-observer estimator.

    Attributes
    ----------
    model
        The observer without meters.
    step_s
        Expected interval between frames, s.
    """

    setting: Setting
    model: CircleDesign
    step_s: float

    @property
    def observers(self) -> int:
        """Number of observers: one per inverter with a meter, and the one without meters."""
        return 1 + int(np.count_nonzero(self.setting.errors.meter_of >= 0))


@dataclass(frozen=True, slots=True, eq=False)
class PartialState:
    """State between frames.

    Attributes
    ----------
    t
        Time of the last used frame, s; that of `init` before the first one.
    valid
        True if the certificate was verified.
    started
        True after the first frame.
    parts
        The observers.
    settled
        True once the initial transient has decayed.
    tally
        Counters of accusations, and the named meters.
    v0_squared
        Last squared busbar voltage, pu.
    last
        Last estimate and verdict; None before the first one.
    """

    t: float
    valid: bool
    started: bool
    parts: Parts
    settled: bool
    tally: Tally
    v0_squared: Floats | float
    last: tuple[Estimate, Verdict] | None


def design(
    plant: Plant, *, max_attacked: int, step_s: float, options: Options | None = None
) -> PartialDesign:
    """Design the observers and fits for one feeder.

    Parameters
    ----------
    max_attacked
        M, largest number of simultaneously manipulated meters.
    step_s
        Expected interval between frames, s; others work, too.

    Raises
    ------
    NotObservable
        Unless there are more than 2M meters.
    DesignInfeasible
        If the initial transient does not decay, or there are too many sets of M meters.
    ValueError
        As `plant.check_plant`.
    """
    meters, p = plant.meters, plant.meters.size
    check_plant(plant, max_attacked=max_attacked, step_s=step_s)
    if p <= 2 * max_attacked:
        why = f"{p} meters, {max_attacked} of them manipulated; more than {2 * max_attacked} are needed"
        raise NotObservable(range(p), p, why, code="too-few-meters")
    sets, rows = comb(p, max_attacked), 3 * p
    unknowns = plant.droop.tau.size + 2 * len(plant.feeder.customers) + busbar_places(plant.feeder).stop
    if sets > MOST_SUBSETS or sets * rows * (rows + unknowns) > MOST_WORK * step_s:
        said = f"{sets} sets of up to {rows} rows every {step_s:g} s are too many"
        raise DesignInfeasible(f"fits without every {max_attacked} of {p} meters", said, code="too-many")
    if options is None:
        options = Options() if step_s <= 30.0 else Options(release=4)
    model = circle.design(close_loop(plant.feeder, plant.droop, meters), np.zeros(p, dtype=np.bool_))
    return PartialDesign(setting(plant, max_attacked=max_attacked, options=options), model, step_s)


def init(design: PartialDesign, t: float) -> PartialState:
    """Initial state at Unix time t, s; the observers start with the first frame.

    The certificate of the design is verified again.
    """
    plant, proof = design.setting.plant, design.model.certificate
    p = plant.meters.size
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
        tally=Tally(np.zeros(p, dtype=np.intp), np.zeros(p, dtype=np.intp), np.zeros(p, dtype=np.bool_)),
        v0_squared=plant.droop.vbar**2,
        last=None,
    )


def step(design: PartialDesign, state: PartialState, frame: Frame) -> tuple[PartialState, Estimate, Verdict]:
    """Process one frame.

    Parameters
    ----------
    frame
        Data of one tick. A frame that is not later than the last one changes nothing: it returns the last
        estimate and UNDECIDED.

    Returns
    -------
    PartialState, Estimate, Verdict
        As every estimator's step; see `gridsec.online`. Score and threshold are those of the readings in the
        fit of the estimate, or of the observer without meters where that is stricter. All fits and all rows
        decide on named meters: a small attack may be named below this threshold.
    """
    if (state.started and not frame.t > state.t) or not np.isfinite(frame.t):
        plant = design.setting.plant
        return state, *nothing_new(plant, frame, state.t, state.last, state.v0_squared, state.parts.x)
    setting, frame = design.setting, known(frame)
    inputs = clean(setting, Past(state.parts.x, state.v0_squared, state.tally.named), frame)
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
    alone: Uncertainty,
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
        Situation(
            names=tuple(plant.feeder.customers[c] for c in plant.meters),
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
    alone: Uncertainty,
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
    v2_bus = model.v2_bus + 2.0 * (lines.R_bus @ dp + lines.X_bus @ dq) + by_place(plant.feeder, d0)
    v2 = v2_bus[plant.feeder.bus]
    # Under any attack, the bound of the observer without meters holds; and so does that of one credible fit.
    gap = detect.gap(design.setting.errors, alone, after.parts.bound)
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
