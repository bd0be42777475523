"""Manipulated inverters and meters at once: yang2021 on a feeder.

A candidate is a pair (suspected meters, suspected inverters) of bounded size. Its unknown-input observer uses
neither. Unmanipulated inverters follow their curves (`gridsec.estimators.unknown_input.pairs`). The
injections of the suspected inverters are unknown inputs, up to their rating, determined by the trusted
readings through 2X. The remainder must be possible for unmanipulated readings. Thresholds are worst cases of
all uncertainties, so that unmanipulated readings never contradict the true pair. Hence:

1. The true pair is never refuted while no more meters and inverters are attacked than assumed.
2. Members of every pair that is not refuted are attacked: *named*.
3. If the named members alone are such a pair, the answer is ATTACKED, or CLEAN without any. Otherwise meters
   and inverters explain the readings alike: UNDECIDED, with the smallest pairs as explanations.
4. If all pairs are refuted, more is attacked than assumed: UNDECIDED.

A pair is refuted by its `confirm`-th contradiction, until `release` consecutive ticks do not contradict it.
Active powers are trusted, as in all banks. An inverter with an effect on the readings below their errors
cannot be judged, and then the answer is not CLEAN. Meters of class 0.5 alone judge only the largest
inverters; with reported net reactive power of customers, most are judged.

Source: yang2021 (2), (5) to (7), (17), (22) to (24), (42) to (47); docs/theory-unknown-input.md, section 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, frozen
from gridsec.errors import NotObservable, Problem
from gridsec.estimators.detection import Counters, DecisionInputs, count, decide, no_counts
from gridsec.estimators.plant import (
    NO_VOLTAGE,
    EstimatorContext,
    Inputs,
    Options,
    Plant,
    PreviousStep,
    busbar_errors,
    check_plant,
    clean,
    estimator_context,
    known,
    nothing_new,
    reconstruct,
    usual_options,
)
from gridsec.estimators.unknown_input.pairs import (
    AttackAssumption,
    Believed,
    PairResult,
    Pairs,
    Relation,
    Seen,
    Tube,
    Tubes,
    Unseen,
    advance,
    believe,
    pairs,
    spread,
    try_pair,
)
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, Verdict

__all__ = [
    "TickRelations",
    "UnknownInputDesign",
    "UnknownInputState",
    "answer",
    "deaf_inverters",
    "design",
    "explain",
    "init",
    "observe",
    "step",
]


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputDesign:
    """Design of the unknown-input estimator. N customers, m inverters, p meters."""

    setting: EstimatorContext
    max_inverters: int  # largest number of simultaneously attacked inverters, q_1 of yang2021
    pairs: Pairs  # the candidates
    within: Bools  # (c, c) True if the suspects of the first candidate are a subset of those of the second
    # pairs with inverters that voltages alone do not distinguish; they are tried as well
    missing: tuple[Unseen, ...]
    doubt: AttackAssumption  # assumed number and size of attacks
    gain: Floats  # (N, m) 2X from inverters to all customers

    @property
    def observers(self) -> int:
        """Number of pairs."""
        return len(self.pairs.meters)


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputState:
    """State between frames. m inverters, p meters."""

    # t, began: time of the last used frame, and of the first one, s; that of `init` before
    t: float
    began: float
    tubes: Tubes | None  # intervals of unmanipulated inverters; None before the first frame
    contradicted: Counters  # counters of contradictions of each pair; pairs named there are refuted
    x: Floats  # (m,) estimated injections including attacks, pu
    v0_squared: Floats | float  # last squared busbar voltage, pu; in three phases (3,)
    # named, inverters (p,), (m,): meters and inverters named as manipulated
    named: Bools
    inverters: Bools
    last: tuple[Estimate, Verdict] | None  # last estimate and verdict, returned for unusable frames


@dataclass(frozen=True, slots=True, eq=False)
class TickRelations:
    """One tick as linear relations; the suspected meters determine the intervals of inverters."""

    # design, frame, inputs: design, received frame, and prepared frame
    design: UnknownInputDesign
    frame: Frame
    inputs: Inputs
    tubes: Tubes  # intervals of unmanipulated inverters
    # v2, error (N,): squared voltages without injections of inverters, and their error, squared pu
    v2: Floats
    error: Floats
    rest: Floats  # (N,) the part of that error from neither loads nor busbar

    def tube(self, meters: Bools) -> Tube:
        """Intervals of unmanipulated inverters if the meters in the mask (p,) are manipulated."""
        meter = self.design.setting.errors.meter_of
        believed = self.tubes.metered.copy()
        if meters.size:
            believed &= ~meters[meter]
        return self.tubes.driven.where(believed, self.tubes.free)

    def relation(self, meters: Bools) -> Relation:
        """Relation of the readings if the meters in the mask (p,) are manipulated."""
        now, frame, inputs = self.design.setting, self.frame, self.inputs
        plant, tube = now.plant, self.tube(meters)
        live = np.flatnonzero(inputs.live)
        told = live[np.isfinite(frame.q_net[plant.meters[live]])]
        at, of = plant.meters[live], plant.meters[told]
        own = (of[:, None] == plant.droop.customer).astype(np.float64)
        gain = self.design.gain[at]
        net = (np.arange(frame.q.size) == of[:, None]).astype(np.float64)
        v, q, v0 = at.size, of.size, plant.feeder.busbar_incidence()[at]
        E = np.block(
            [
                [
                    2.0 * now.model.R[at],
                    2.0 * now.model.X[at],
                    gain,
                    np.eye(v),
                    np.zeros((v, q)),
                    v0,
                ],
                [
                    np.zeros((q, frame.p.size)),
                    net,
                    own,
                    np.zeros((q, v)),
                    np.eye(q),
                    np.zeros((q, v0.shape[1])),
                ],
            ]
        )
        busbar = np.atleast_1d(busbar_errors(plant, inputs.v0_squared, now.options.sigmas))
        half = np.concatenate(
            [
                frame.p_error,
                frame.q_error,
                tube.half,
                inputs.now.reading[live] + self.rest[at],
                frame.q_net_error[of],
                np.minimum(busbar, NO_VOLTAGE),
            ]
        )
        readings = slice(half.size - busbar.size - v - q, half.size - busbar.size)
        half[readings] = np.maximum(half[readings], _EXACT)
        r = np.concatenate(
            [
                inputs.y[live] - self.v2[at] - gain @ tube.middle,
                frame.q_net[of] - frame.q[of] - own @ tube.middle,
            ]
        )
        voltage = np.arange(v + q) < v
        return Relation(r, np.vstack([gain, own]), E, half, np.concatenate([live, told]), voltage)

    def believe(self, meters: Bools) -> Believed:
        """Readings of all meters outside the mask (p,)."""
        return believe(self.relation(meters), meters)

    def room(self, tube: Tube) -> Floats:
        """Largest wrong injection of each inverter (m,), for unmanipulated ones within `tube`."""
        return self.design.doubt.reach + np.abs(tube.middle) + tube.half

    def trial(self, meters: Bools, inverters: Bools) -> PairResult:
        """Result of the pair of suspected meters (p,) and inverters (m,) for the tick."""
        return try_pair(self.believe(meters), inverters, self.room(self.tube(meters)))


# Smallest error of a reading, pu.
_EXACT = 1e-9


def observe(design: UnknownInputDesign, state: UnknownInputState, frame: Frame) -> TickRelations:
    """Prepare a frame, and advance the intervals of unmanipulated inverters."""
    inputs = clean(design.setting, PreviousStep(state.x, state.v0_squared, state.named), frame)
    h = 0.0 if state.tubes is None else frame.t - state.t
    v2, error, rest = _without_inverters(design, state, frame, inputs)
    seen = _seen(design, inputs, inputs.live & ~state.named, v2, error)
    tubes = advance(design.setting.errors, design.doubt, state.tubes, seen, h)
    return TickRelations(design, frame, inputs, tubes, v2, error, rest)


def _without_inverters(
    design: UnknownInputDesign, state: UnknownInputState, frame: Frame, inputs: Inputs
) -> tuple[Floats, Floats, Floats]:
    """Squared voltages (N,) without injections of inverters, their error, and its part from the model."""
    now, plant = design.setting, design.setting.plant
    rest = inputs.now.base - now.errors.R2 @ frame.p_error - now.errors.X2 @ frame.q_error
    moved = np.zeros(rest.shape)
    if plant.loss_correction and state.x.size:
        moved = _with_inverters(design, state, frame, inputs)
    # The busbar shifts all places (of a phase) alike, and has an error of its own.
    busbar = plant.feeder.broadcast_busbar(busbar_errors(plant, inputs.v0_squared, now.options.sigmas))
    rest = rest - busbar[plant.feeder.bus]
    rest = np.where(inputs.now.base < NO_VOLTAGE, np.maximum(rest, 0.0), NO_VOLTAGE)
    error = np.minimum(inputs.now.base + moved, NO_VOLTAGE)
    return plant.droop.vbar**2 - inputs.w, error, rest + moved


def _with_inverters(
    design: UnknownInputDesign, state: UnknownInputState, frame: Frame, inputs: Inputs
) -> Floats:
    """Largest change of the loss correction by possible injections, attacked or not; (N,)."""
    plant, reach = design.setting.plant, design.doubt.reach
    feeder, droop, steps = plant.feeder, plant.droop, plant.loss_correction
    if not feeder.extremes_at_ends:
        count_ = frame.q.size
        q = frame.q + droop.per_customer(state.x, count_)
        room = droop.per_customer(reach + np.abs(state.x), count_)
        _, moved, rest = feeder.correction_bounds(
            frame.p, q, inputs.v0_squared, p_error=frame.p_error, q_error=frame.q_error + room, steps=1
        )
        return np.minimum(moved + 3.0 * rest, NO_VOLTAGE)
    # Losses depend on the injections of inverters: all at either end, one beyond.
    ends = np.vstack([droop.limit, -droop.limit, state.x + np.diag(reach), state.x - np.diag(reach)])
    customers = np.zeros((droop.customer.size, frame.q.size))
    customers[np.arange(droop.customer.size), droop.customer] = 1.0
    with np.errstate(all="ignore"):
        found = feeder.loss_correction(frame.p, frame.q + ends @ customers, inputs.v0_squared, steps=steps)
    far_off = np.nan_to_num(np.abs(found - inputs.correction), nan=NO_VOLTAGE, posinf=NO_VOLTAGE)
    moved = far_off[:2].max(axis=0) + max(design.max_inverters, 1) * far_off[2:].max(axis=0)
    return np.asarray(moved[feeder.bus])


def _seen(design: UnknownInputDesign, inputs: Inputs, believed: Bools, v2: Floats, error: Floats) -> Seen:
    """Tick at the inverters' places; readings of named meters would mislead even after their clearance."""
    now, own = design.setting, design.setting.plant.droop.customer
    meter = now.errors.meter_of
    if not inputs.live.size:
        nothing = np.zeros(own.size)
        metered = np.zeros(own.size, dtype=np.bool_)
        return Seen(nothing, nothing, metered, now.plant.droop.vbar**2 - v2[own], error[own])
    return Seen(
        z=inputs.z[meter],
        z_error=inputs.now.reading[meter],
        metered=(meter >= 0) & believed[meter],
        rest=now.plant.droop.vbar**2 - v2[own],
        rest_error=error[own],
    )


_SHOWN = 8


def explain(pairs: Pairs, trials: dict[int, PairResult], order: list[int]) -> tuple[Explanation, ...]:
    """The smallest possible pairs, likeliest first, with probabilities for normal errors."""
    best = trials[order[0]].misfit
    weights = np.exp([-0.5 * (trials[k].misfit - best) for k in order])
    shares = weights / weights.sum()
    return tuple(
        Explanation(pairs.meters[k].copy(), pairs.inverters[k].copy(), float(share))
        for k, share in list(zip(order, shares, strict=True))[:_SHOWN]
    )


def deaf_inverters(design: UnknownInputDesign, trial: PairResult) -> Bools:
    """Mask (m,) of inverters with possible undetected wrong injections above their curve's span."""
    return np.asarray(trial.attack_error > design.setting.plant.droop.span)


def answer(
    design: UnknownInputDesign,
    state: UnknownInputState,
    tick: TickRelations,
    *,
    trial: PairResult,
    threshold: Floats,
    explanations: tuple[Explanation, ...],
) -> tuple[Decision, Cause, str]:
    """Decision, cause and one sentence; `estimators.decision` decides on meters as for every estimator.

    state: after the tick, with the members of every possible pair named. trial: result of the likeliest pair.
    threshold (p,): largest score of each meter without manipulation, squared pu.
    explanations: the smallest possible pairs where there are several.
    """
    now, live = design.setting, tick.inputs.live
    plant, meters, inverters = now.plant, state.named, state.inverters
    customers = plant.feeder.customers
    names = plant.meter_names
    owners = [customers[c] for c in plant.droop.customer]
    pending = (state.contradicted.above > 0) & ~state.contradicted.named
    memory = np.exp(-(state.t - state.began) / plant.droop.tau.max(initial=_SHORT))
    base = decide(
        DecisionInputs(
            names=names,
            max_attacked=now.max_attacked,
            live=live,
            suspected=np.zeros(live.size, dtype=np.bool_),
            named=meters,
            wide=live & ~(threshold <= now.options.widest),
            valid=True,
            settled=bool(memory <= now.options.settled),
            busbar=tick.inputs.busbar,
        )
    )
    if base[1] in {Cause.TOO_FEW_METERS, Cause.NO_BUSBAR}:
        return base
    ambiguous = Decision.UNDECIDED, Cause.AMBIGUOUS
    if state.contradicted.named.all():
        reason = (
            f"No {now.max_attacked} meters and {design.max_inverters} inverters explain the readings. "
            "A wrong busbar reading, switch or line in the model looks the same."
        )
        base = Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS, reason
    elif explanations:
        texts = [_list(e.meters, e.inverters, names, owners) for e in explanations[:_NAMED]]
        more = f" or {len(explanations) - _NAMED} more" if len(explanations) > _NAMED else ""
        base = *ambiguous, f"Manipulated is {' or else '.join(texts)}{more}."
    elif meters.any() or inverters.any():
        accused = _list(meters, inverters, names, owners)
        reason = f"Manipulated: {accused}; further off than meter accuracy and load uncertainty allow."
        base = Decision.ATTACKED, Cause.RESIDUALS, reason
    elif base[0] is Decision.CLEAN and pending.any():
        base = *ambiguous, "Readings were further off than allowed lately, but not often enough."
    elif base[0] is Decision.CLEAN:
        deaf = deaf_inverters(design, trial)
        unjudged = _list(np.zeros_like(live), deaf, names, owners)
        base = (
            (*ambiguous, f"No meter disagrees, but readings are too coarse to judge {unjudged}.")
            if deaf.any()
            else (*base[:2], _agreement(design, trial, owners))
        )
    return base


_SHORT = 1e-3
_NAMED = 4


def _agreement(design: UnknownInputDesign, trial: PairResult, owners: list[str]) -> str:
    """Sentence of CLEAN with the undetectable remainder: injections above twice their error are detected."""
    said = "All meters and inverters agree with the feeder"
    if not owners:
        return f"{said}."
    unseen = 2.0 * trial.attack_error * design.setting.plant.feeder.base_kva
    most = int(np.argmax(unseen))
    return f"{said}; up to {unseen[most]:.0f} kvar of the inverter of {owners[most]} could go unseen."


def _list(meters: Bools, inverters: Bools, names: Sequence[str], owners: list[str]) -> str:
    parts = [names[j] for j in np.flatnonzero(meters).tolist()]
    parts += [f"the inverter of {owners[i]}" for i in np.flatnonzero(inverters)]
    rest = f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else ""
    return " and ".join(parts[:_NAMED]) + rest


def design(
    plant: Plant,
    *,
    max_attacked: int,
    step_s: float,
    max_inverters: int = 1,
    options: Options | None = None,
) -> UnknownInputDesign:
    """Design the pairs for one feeder.

    max_attacked, max_inverters: largest numbers of simultaneously attacked meters and inverters, q_2 and q_1.
    step_s: expected interval between frames, s; it only selects the default options, others work as well.
    Raises NotObservable unless there are more than 2 max_attacked meters, yang2021 (4) and (20);
        DesignInfeasible if there are too many pairs; ValueError as `plant.check_plant`, if `max_inverters` is
        negative, or if inverters have no rating, the largest injection of an attacked one.
    """
    p, m = plant.meters.size, plant.droop.tau.size
    more = (
        [Problem("negative", f"max_inverters is {max_inverters}; it cannot be negative")]
        if not max_inverters >= 0
        else []
    )
    untold = np.flatnonzero(~np.isfinite(plant.droop.rating)).tolist()
    more += [Problem("missing", f"inverters {untold} have no rating; set `Droop.rating`")] if untold else []
    check_plant(plant, max_attacked=max_attacked, step_s=step_s, more=more)
    if p <= 2 * max_attacked:
        why = f"{p} meters, {max_attacked} of them manipulated: more than {2 * max_attacked} are needed"
        raise NotObservable(range(p), p, why + " (yang2021, Assumption 3)", code="too-few-meters")
    options = usual_options(step_s) if options is None else options
    made = estimator_context(plant, max_attacked=max_attacked, options=options)
    own = plant.droop.customer
    gain = 2.0 * made.model.X[:, own]
    most = min(max_inverters, m)
    found, missing = pairs(gain[plant.meters], max_attacked, most)
    doubt = AttackAssumption(max_attacked, most, plant.droop.rating, frozen(gain[own]))
    return UnknownInputDesign(made, most, found, found.within(), missing, doubt, frozen(gain))


def init(design: UnknownInputDesign, t: float) -> UnknownInputState:
    """Initial state at Unix time t, s."""
    plant = design.setting.plant
    return UnknownInputState(
        t=t,
        began=t,
        tubes=None,
        contradicted=no_counts(design.observers),
        x=np.zeros(plant.droop.tau.size),
        v0_squared=plant.droop.vbar**2,
        named=np.zeros(plant.meters.size, dtype=np.bool_),
        inverters=np.zeros(plant.droop.tau.size, dtype=np.bool_),
        last=None,
    )


def step(
    design: UnknownInputDesign, state: UnknownInputState, frame: Frame
) -> tuple[UnknownInputState, Estimate, Verdict]:
    """Process one frame; see `gridsec.interface`."""
    if not np.isfinite(frame.t) or (state.tubes is not None and not frame.t > state.t):
        plant = design.setting.plant
        estimate, verdict = nothing_new(plant, frame, state.t, state.last, state.v0_squared, state.x)
        if state.last is None:
            none = np.zeros(plant.droop.tau.size)
            verdict = replace(verdict, inverters=none.astype(np.bool_), inverter_attack=none)
        return state, estimate, verdict
    tick = observe(design, state, known(frame))
    after = replace(
        state,
        t=frame.t,
        began=frame.t if state.tubes is None else state.began,
        tubes=tick.tubes,
        contradicted=_contradicted(design, state, tick),
    )
    return _conclude(design, after, tick)


def _contradicted(design: UnknownInputDesign, state: UnknownInputState, tick: TickRelations) -> Counters:
    """Test the pairs, as far as necessary, and count contradictions."""
    options, both, tally = design.setting.options, design.pairs, state.contradicted
    over = np.zeros(design.observers, dtype=np.bool_)
    few = np.count_nonzero(tick.inputs.live) <= 2 * design.setting.max_attacked
    if few or not tick.inputs.busbar:
        return tally
    # Readings that the empty pair explains are explained by all other pairs as well.
    unattacked = tick.trial(both.meters[0], both.inverters[0])
    if not unattacked.fits:
        over[0] = True
        # Pairs with the same meters share nearly all of the work.
        groups: dict[bytes, list[int]] = {}
        for k in range(1, over.size):
            groups.setdefault(both.meters[k].tobytes(), []).append(k)
        for group in groups.values():
            meters = both.meters[group[0]]
            believed, room = tick.believe(meters), tick.room(tick.tube(meters))
            over[group] = [not try_pair(believed, both.inverters[k], room).fits for k in group]
    # Evidence against a pair stays while members outside the pair cannot be judged.
    deaf = deaf_inverters(design, unattacked)
    silent = state.named & ~tick.inputs.live
    hold = (silent & ~both.meters).any(axis=1) | (state.inverters & deaf & ~both.inverters).any(axis=1)
    return count(tally, over, np.asarray(~hold), confirm=options.confirm, release=options.release)


def _conclude(
    design: UnknownInputDesign, state: UnknownInputState, tick: TickRelations
) -> tuple[UnknownInputState, Estimate, Verdict]:
    both, inputs = design.pairs, tick.inputs
    possible = ~state.contradicted.named
    meters = np.asarray(both.meters[possible].all(axis=0) & possible.any())
    inverters = np.asarray(both.inverters[possible].all(axis=0) & possible.any())
    smallest = possible & ~(design.within[possible] & ~np.eye(len(possible), dtype=np.bool_)[possible]).any(
        axis=0
    )
    trials = {int(k): tick.trial(both.meters[k], both.inverters[k]) for k in np.flatnonzero(smallest)}
    order = sorted(trials, key=lambda k: trials[k].misfit)
    chosen = order[0] if order else 0
    trial = trials[chosen] if order else tick.trial(both.meters[0], both.inverters[0])
    x, estimate = _estimate(design, tick, trial, chosen if order else None, certain=len(order) == 1)
    score, threshold = _scores(tick, both.meters[chosen], both.inverters[chosen], trial)
    explanations = explain(design.pairs, trials, order) if len(order) > 1 else ()
    v2 = estimate.v2[design.setting.plant.meters]
    after = replace(state, x=x, v0_squared=inputs.v0_squared, named=meters, inverters=inverters)
    verdict = Verdict(
        *answer(design, after, tick, trial=trial, threshold=threshold, explanations=explanations),
        meters,
        score,
        threshold,
        np.where(meters & inputs.live, inputs.y - v2, 0.0),
        inverters,
        np.where(inverters, trial.attack, 0.0),
        (),
        explanations,
    )
    return replace(after, last=(estimate, verdict)), estimate, verdict


def _estimate(
    design: UnknownInputDesign, tick: TickRelations, trial: PairResult, chosen: int | None, *, certain: bool
) -> tuple[Floats, Estimate]:
    """Estimate of the chosen pair, with a bound that holds for every possible pair."""
    now, inputs, both = design.setting, tick.inputs, design.pairs
    plant, doubt = now.plant, design.doubt
    meters = both.meters[0 if chosen is None else chosen]
    accused = both.inverters[0 if chosen is None else chosen]
    tube = tick.tube(meters)
    wrong = np.where(accused, np.clip(trial.attack, -tick.room(tube), tick.room(tube)), 0.0)
    x = tube.middle + wrong
    q = tick.frame.q + plant.droop.per_customer(x, tick.frame.q.size)
    seen = reconstruct(now, tick.frame, inputs, q)
    gain = np.abs(design.gain)
    if chosen is None:
        bound = gain @ (doubt.reach + np.abs(x))
    else:
        # Further undetected attacks are possible; the reconstructed one may then be due to them.
        more = AttackAssumption(
            doubt.meters - (int(meters.sum()) if certain else 0),
            doubt.inverters - (int(accused.sum()) if certain else 0),
            doubt.reach,
            doubt.coupling,
        )
        sure = certain and more.meters == 0 and more.inverters == 0
        known = np.minimum(trial.attack_error if sure else np.inf, doubt.reach + np.abs(x))
        bound = spread(now.errors, more, tube, tick.tubes.free, gain) + gain @ np.where(accused, known, 0.0)
    estimate = Estimate(
        t=tick.frame.t,
        v2=seen.v2,
        bound=np.minimum(tick.error + seen.moved + bound, NO_VOLTAGE),
        v2_bus=seen.v2_bus,
        trusted=inputs.live & ~meters,
        x=x,
    )
    return x, estimate


def _scores(tick: TickRelations, meters: Bools, inverters: Bools, trial: PairResult) -> tuple[Floats, Floats]:
    """Scores of meters against all others of the chosen pair; of suspected ones against the trusted ones."""
    score, threshold = trial.score.copy(), trial.threshold.copy()
    for j in np.flatnonzero(meters & tick.inputs.live).tolist():
        others = meters.copy()
        others[j] = False
        found = tick.trial(others, inverters)
        score[j], threshold[j] = found.score[j], found.threshold[j]
    return score, np.minimum(threshold, NO_VOLTAGE)
