"""Exact bank monitor of one feeder: from a frame of readings to an estimate and a verdict.

Offline, `design` turns a plant into a bank of observers with a certificate; online, `init` and `step`
run it. A step never raises on data: outcomes are values.

1. The known input w comes from the busbar voltage, the loads, and the loss correction at the last
   estimate; chong2020 (19).
2. The bank takes one step; chong2020 (5). The set with the best agreement between its estimate and those
   of its subsets is selected, (6) and (7), among the sets without a named meter.
3. The residuals of *all* meters against the selected estimate are compared with the largest value of an
   unmanipulated meter (`gridsec.estimators.detection`). Attacks inside a droop curve's deadband do not move
   any estimate, so that agreement alone would not detect them.
4. A meter is named with its `confirm`-th reading above the threshold, and until `release` consecutive
   readings are below it; the selection is repeated without the named meters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible
from gridsec.estimators import detection
from gridsec.estimators.detection import (
    Counters,
    DecisionInputs,
    ErrorBound,
    ErrorModel,
    Majorant,
    Motion,
    count,
    decide,
    no_counts,
    residual_excess,
)
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.exact_bank.bank import StackedState
from gridsec.estimators.plant import (
    EstimatorContext,
    Inputs,
    Options,
    Plant,
    PreviousStep,
    Reconstruction,
    check_plant,
    clean,
    injections,
    known,
    nothing_new,
    reconstruct,
    usual_options,
)
from gridsec.grid.devices import reading_error
from gridsec.grid.network import LinDistFlow
from gridsec.interface import Estimate, Frame, Verdict
from gridsec.observers.certificates import Certificate, certify, small_gain, verify
from gridsec.observers.lmi import contraction
from gridsec.observers.lure import Lure, close_loop

__all__ = ["MonitorDesign", "MonitorState", "design", "init", "step"]


@dataclass(frozen=True, slots=True, eq=False)
class MonitorDesign:
    """Design of the exact bank monitor."""

    plant: Plant
    model: LinDistFlow  # linear power flow of the plant
    bank: banks.Bank  # the observers
    errors: ErrorModel  # propagation of errors
    certificate: Certificate  # proof that the observers converge, for all sensor sets at once
    proven: Lure  # system of the certificate: the closed loop, or a majorant of all observers
    step_s: float  # expected interval between frames, s
    options: Options

    @property
    def setting(self) -> EstimatorContext:
        """Setting for the preparation of frames."""
        return EstimatorContext(
            self.plant,
            self.model,
            self.errors,
            self.options,
            self.bank.sets.max_attacked,
            self.bank.gains is None,
        )

    @property
    def observers(self) -> int:
        """Number of observers."""
        return len(self.bank.masks)


@dataclass(frozen=True, slots=True, eq=False)
class MonitorState:
    """State between frames."""

    t: float  # time of the last used frame, s; that of `init` before the first one
    valid: bool  # True if the certificate was verified
    bank: banks.BankState | None  # the observers; None before the first frame
    x: Floats  # (m,) last selected estimate of the injections, pu
    z: Floats  # (m,) its z at the inverters, pu
    spread: Floats  # (m,) largest distance of it from that of an observer without manipulated meters, pu
    # bound, level: bounds on the observers' error, and their upper level during the last step
    bound: ErrorBound
    level: ErrorBound
    settled: bool  # True once the initial transient has decayed
    tally: Counters  # counters of readings above and below the thresholds, and the named meters
    v0_squared: Floats | float  # last squared busbar voltage, pu; in three phases (3,)
    # last estimate and verdict, returned for unusable frames; None before the first one
    last: tuple[Estimate, Verdict] | None


def design(
    plant: Plant,
    *,
    max_attacked: int,
    step_s: float,
    gains: Literal["direct"] | banks.Gains = "direct",
    options: Options | None = None,
    certificate: Certificate | None = None,
) -> MonitorDesign:
    """Design the bank, its certificate and its error bounds for one feeder.

    max_attacked: M, largest number of simultaneously manipulated meters.
    step_s: expected interval between frames, s. Other intervals work too. Above 30 s, four consecutive
        readings below the threshold clear a meter in place of six, unless `options` are given.
    gains: `direct`: the inverter of a trusted meter is driven by that meter's reading. Or stacked gains of
        circle-criterion observers in the order of `bank.subsets(p, M).masks()`; an entrywise majorant of all
        of them must then satisfy the small-gain condition.
    certificate: an external proof; by default the best closed form, or the solver's where none applies. It is
        verified here.
    Raises NotObservable unless there are more than 2M meters; DesignInfeasible if no certificate holds, the
        bank would be too large, or the gains detect nothing; ValueError as `plant.check_plant`; or if `gains`
        is another text.
    Source: chong2020, Corollary 1, for any feeder and with the corrections of its errata.
    """
    meters = plant.meters
    check_plant(plant, max_attacked=max_attacked, step_s=step_s)
    options = usual_options(step_s) if options is None else options
    lure = close_loop(plant.feeder, plant.droop, meters)
    model = plant.feeder.linear()
    reactive = -2.0 * model.X[:, meters] if isinstance(gains, str) else None
    bank = banks.design(lure, max_attacked, gains=gains, reactive=reactive)
    errors = detection.error_model(plant.droop, model, meters, max_attacked)
    proven = lure
    if bank.gains is not None:
        big = _majorant(lure, bank.gains)
        errors = replace(errors, majorant=big, quota=meters.size)
        proven = replace(lure, H=-_loop(lure, big))
    proof = certificate
    if proof is None:
        proof = _proof(proven) if bank.gains is None else small_gain(proven)
    margin = verify(proof, proven)
    if not margin > 0:
        raise DesignInfeasible(
            f"{proof.kind} certificate", "the verification fails", margin, code="not-verified"
        )
    return MonitorDesign(plant, model, bank, errors, proof, proven, step_s, options)


# Decay rate requested from the solver, as a fraction of the slowest inverter's rate.
_RATE = 0.1


def _proof(lure: Lure) -> Certificate:
    """The best closed-form certificate, or the solver's where none applies."""
    try:
        return certify(lure)
    except DesignInfeasible:
        return contraction(lure, rate=_RATE * float(np.min(-np.diagonal(lure.A))))


def _majorant(lure: Lure, gains: banks.Gains) -> Majorant:
    H, F = np.abs(lure.H), np.abs(lure.F)
    for K in gains.K:
        np.maximum(H, _extreme(lure.H, K, lure.C), out=H)
        np.maximum(F, _extreme(lure.F, K, lure.D), out=F)
    tau = -1.0 / np.diagonal(lure.A)
    return Majorant(H, F, np.abs(gains.K).max(axis=0), tau[:, None] * np.abs(gains.L).max(axis=0))


def _loop(lure: Lure, big: Majorant) -> Floats:
    """Feedback with a small-gain condition that covers all observers: the effect of L counts as H / slope."""
    through = big.L @ np.abs(lure.C)
    deaf = lure.slope <= 0
    if through[deaf].any():
        raise DesignInfeasible(
            "observer bank",
            "gains inject into the state of an inverter with slope 0",
            None,
            code="wrong-form",
        )
    return np.asarray(big.H + through / np.where(deaf, 1.0, lure.slope)[:, None])


def _extreme(M: Floats, K: Floats, N: Floats) -> Floats:
    """Largest `|M - K N|`, entry by entry, over all choices of columns of K set to zero."""
    terms = -K[:, :, None] * N
    high, low = np.maximum(terms, 0.0).sum(axis=1), np.minimum(terms, 0.0).sum(axis=1)
    return np.asarray(np.maximum(np.abs(M + high), np.abs(M + low)))


def init(design: MonitorDesign, t: float) -> MonitorState:
    """Initial state; the observers start with the first frame.

    design: from `design`. Its certificate is verified again, because a stored or hand-made design may be
        wrong.
    """
    m = design.plant.droop.tau.size
    try:
        valid = verify(design.certificate, design.proven) > 0
    except DesignInfeasible:
        valid = False
    widest = detection.widest(design.errors)
    return MonitorState(
        t=t,
        valid=valid,
        bank=None,
        x=np.zeros(m),
        z=np.zeros(m),
        spread=np.zeros(m),
        bound=widest,
        level=widest,
        settled=False,
        tally=no_counts(design.plant.meters.size),
        v0_squared=design.plant.droop.vbar**2,
        last=None,
    )


def step(design: MonitorDesign, state: MonitorState, frame: Frame) -> tuple[MonitorState, Estimate, Verdict]:
    """Process one frame; see `gridsec.interface`."""
    late = state.bank is not None and not frame.t > state.t
    if late or not np.isfinite(frame.t):
        return state, *nothing_new(design.plant, frame, state.t, state.last, state.v0_squared, state.x)
    frame = known(frame)
    inputs = clean(design.setting, PreviousStep(state.x, state.v0_squared, state.tally.named), frame)
    before = state.bank
    h = 0.0 if before is None else frame.t - state.t
    if before is None:
        bank = banks.init(design.bank, inputs.z, inputs.w, inputs.live, net=inputs.net)
        unknown = _unknown(design, bank)
        state = replace(state, bound=unknown, level=unknown)
    else:
        bank = banks.step(
            design.bank, before, inputs.z, inputs.w, inputs.live, h, net=inputs.net, adopt=state.x
        )
        if banks.decided(design.bank, bank) and not banks.decided(design.bank, before):
            # The observers restart from one without trusted meters.
            unknown = _unknown(design, bank)
            state = replace(state, bound=unknown, level=unknown, settled=False)
        else:
            bound = detection.handed_over(
                design.errors, state.bound, before.seen, inputs.live, spread=state.spread
            )
            state = replace(state, bound=bound)
    return _conclude(design, state, frame, inputs, bank, h)


def _unknown(design: MonitorDesign, bank: banks.BankState) -> ErrorBound:
    """Bound on the error of observers that just started."""
    return detection.widest(design.errors, bank.x if isinstance(bank, StackedState) else None)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Estimate of the feeder from one selected set of meters, with residuals and bounds."""

    index: int
    state: MonitorState  # after the frame, with the counters and the answer before it
    seen: Reconstruction
    error: Floats  # (N,)
    score: Floats  # (p,) NaN where unavailable
    threshold: Floats  # (p,)
    over: Bools  # (p,) meters with a score above their threshold


def _conclude(  # noqa: PLR0917  # design, state and frame, then the results of this step
    design: MonitorDesign,
    state: MonitorState,
    frame: Frame,
    inputs: Inputs,
    bank: banks.BankState,
    h: float,
) -> tuple[MonitorState, Estimate, Verdict]:
    plant, options, live = design.plant, design.options, inputs.live
    view = _select(design, state, frame, inputs, bank, h)
    after, v2, tally = view.state, view.seen.v2, state.tally
    if banks.decided(design.bank, bank):
        tally = count(tally, view.over, live, confirm=options.confirm, release=options.release)
    decision, cause, reason = decide(
        DecisionInputs(
            names=plant.meter_names,
            max_attacked=design.bank.sets.max_attacked,
            live=live,
            suspected=tally.above > 0,
            named=tally.named,
            wide=live & ~(view.threshold <= options.widest),
            valid=state.valid,
            settled=after.settled,
            busbar=inputs.busbar,
        )
    )
    trusted = np.zeros(live.size, dtype=np.bool_)
    if view.index >= 0:
        trusted = design.bank.masks[view.index] & live & ~tally.named
    error = view.error
    if np.count_nonzero(tally.named) > design.bank.sets.max_attacked:
        # More manipulated meters than the bank covers: only saturation bounds their effect on the estimate.
        error = _saturated(design, inputs, frame, after.x)
    estimate = Estimate(frame.t, v2, error, view.seen.v2_bus, trusted, after.x)
    attack = np.where(tally.named & live, inputs.y - v2[plant.meters], 0.0)
    verdict = Verdict(decision, cause, reason, tally.named, view.score, view.threshold, attack)
    return replace(after, tally=tally, last=(estimate, verdict)), estimate, verdict


def _select(  # noqa: PLR0917  # as _conclude
    design: MonitorDesign,
    state: MonitorState,
    frame: Frame,
    inputs: Inputs,
    bank: banks.BankState,
    h: float,
) -> _View:
    """Select a set, detect meters above their thresholds, and select again without them."""
    sets, live = design.bank.sets, inputs.live
    pi = banks.consistency(design.bank, bank)
    tie = design.options.tie * float(np.max(design.plant.droop.limit, initial=0.0))
    masks = design.bank.masks[: sets.count_large]
    named = state.tally.named
    excluded = named if np.count_nonzero(named) <= sets.max_attacked else np.zeros_like(named)
    penalty: Floats | None = None
    while True:
        index = -1
        if pi.size:
            allowed = np.asarray(~(masks & excluded).any(axis=1))
            index = banks.select(pi, allowed=allowed, penalty=penalty, tie=tie)
        view = _view(design, state, frame, inputs, bank, index, h)
        if index < 0 or not view.over.any():
            return view
        wanted = excluded | view.over
        if np.count_nonzero(wanted) <= sets.max_attacked:
            if not (masks[index] & wanted).any():
                return view
            excluded = wanted
        elif penalty is None:
            penalty = masks @ residual_excess(np.nan_to_num(view.score), view.threshold, live)
        else:
            return view


def _view(  # noqa: PLR0917  # as _conclude
    design: MonitorDesign,
    state: MonitorState,
    frame: Frame,
    inputs: Inputs,
    bank: banks.BankState,
    index: int,
    h: float,
) -> _View:
    plant, errors = design.plant, design.errors
    own, at = plant.droop.customer, plant.meters
    x = banks.estimate(design.bank, bank, index)
    spread = banks.spread(design.bank, bank, index) if index >= 0 else np.zeros(x.shape)
    told = inputs.now.told & (design.bank.masks[index] if index >= 0 else False)
    seen = reconstruct(design.setting, frame, inputs, injections(plant, frame, x, told))
    v2 = seen.v2
    z = plant.droop.vbar**2 - v2[own]
    # Difference of the selected set to a subset without manipulated meters: the estimates differ by
    # `spread`, and metered reactive power of at most M meters is replaced.
    offset = errors.inverters @ spread
    if told.any():
        held = np.bincount(own, weights=x, minlength=v2.size)[at] + inputs.q[at]
        doubt = np.where(told, np.abs(frame.q_net[at] - held), 0.0)
        offset = offset + detection.largest(errors.reach * np.nan_to_num(doubt), errors.quota // 2)
    now = replace(inputs.now, base=inputs.now.base + seen.moved)
    before = z if state.bank is None else state.z
    lag = detection.slowed(errors, h, design.bank.policy) * (np.abs(x - state.x) + spread)
    motion = Motion(before=before, after=z, offset=offset[own], h=h, lag=lag)
    if index >= 0:
        bound, level = detection.advance(errors, now, motion, state.bound, state.level)
        error = detection.gap(errors, now, bound) + offset
    else:
        bound, level = state.bound, state.level
        error = _saturated(design, inputs, frame, x)
    threshold = reading_error(plant.accuracy, v2[at] + error[at], design.options.sigmas) + error[at]
    score = np.where(inputs.live, np.abs(inputs.y - v2[at]), np.nan)
    settled = state.settled
    if index >= 0 and not settled:
        rest = detection.gap(errors, now, detection.at_rest(errors, now, motion))
        transient = detection.gap(errors, now, bound)[at] - rest[at]
        settled = bool(np.all(transient <= design.options.settled * threshold))
    after = replace(
        state,
        t=frame.t,
        bank=bank,
        x=x,
        z=z,
        spread=spread,
        bound=bound,
        level=level,
        settled=settled,
        v0_squared=inputs.v0_squared,
    )
    over = inputs.live & (np.nan_to_num(score) > threshold)
    return _View(index, after, seen, error, score, threshold, over)


def _saturated(design: MonitorDesign, inputs: Inputs, frame: Frame, x: Floats) -> Floats:
    """Error of the estimate (N,) under any attack: inverters saturate, and used reports are plausible."""
    errors = design.errors
    told = np.where(inputs.now.told, 2.0 * frame.q_error[design.plant.meters], 0.0)
    far = detection.widest(errors, None if design.bank.gains is None else x).free
    return np.asarray(inputs.now.base + errors.inverters @ far + errors.reach @ told)
