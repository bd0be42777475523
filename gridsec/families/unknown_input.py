"""Simultaneous attacks on inverters and on meters: yang2021 on a feeder.

A candidate is a pair (suspected meters, suspected inverters) of bounded size. Its unknown-input observer uses
neither. Unmanipulated inverters follow their curves (`gridsec.families.tubes`). The injections of the
suspected inverters are unknown inputs, up to their rating, determined by the trusted readings through 2X. The
remainder must be possible for unmanipulated readings (`gridsec.families.pairs`). Thresholds are worst cases
of all uncertainties, so that unmanipulated readings never contradict the true pair. Hence:

1. The true pair is never refuted while no more meters and inverters are attacked than assumed.
2. Members of every pair that is not refuted are attacked: *named*.
3. If the named members alone are such a pair, the answer is ATTACKED, or CLEAN without any. Otherwise meters
   and inverters explain the readings alike: UNDECIDED, with the smallest pairs as explanations.
4. If all pairs are refuted, more is attacked than assumed: UNDECIDED.

A pair is refuted by its `confirm`-th contradiction, until `release` consecutive ticks do not contradict it.
Active powers are trusted, as in all banks. An inverter with an effect on the readings below their errors
cannot be judged, and then the answer is not CLEAN. Meters of class 0.5 alone judge only the largest
inverters; with reported net reactive power of customers, most are judged.

References
----------
yang2021 (2), (5) to (7), (17), (22) to (24), (42) to (47); docs/theory-unknown-input.md, section 6.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gridsec.arrays import Bools, Floats, frozen
from gridsec.errors import NotObservable, Problem
from gridsec.families.pair_tick import Tick, UnknownInputDesign, UnknownInputState, observe
from gridsec.families.pair_verdict import Found, answer, deaf_inverters, explain
from gridsec.families.pairs import Trial, pairs, try_pair
from gridsec.families.tubes import Doubt, spread
from gridsec.frames import NO_VOLTAGE, known, nothing_new, reconstruct
from gridsec.judge import Tally, count
from gridsec.online import Estimate, Frame, Verdict
from gridsec.plant import Options, Plant, check_plant, setting

__all__ = ["UnknownInputDesign", "UnknownInputState", "design", "init", "step"]


def design(
    plant: Plant,
    *,
    max_attacked: int,
    step_s: float,
    max_inverters: int = 1,
    options: Options | None = None,
) -> UnknownInputDesign:
    """Design the pairs for one feeder.

    Parameters
    ----------
    max_attacked, max_inverters
        Largest numbers of simultaneously attacked meters and inverters, q_2 and q_1.
    step_s
        Expected interval between frames, s; it only selects the default options, others work as well.

    Raises
    ------
    NotObservable
        Unless there are more than 2 max_attacked meters, yang2021 (4) and (20).
    DesignInfeasible
        If there are too many pairs.
    ValueError
        As `plant.check_plant`, if `max_inverters` is negative, or if inverters have no rating, the largest
        injection of an attacked one.
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
    if options is None:
        options = Options() if step_s <= 30.0 else Options(release=4)
    made = setting(plant, max_attacked=max_attacked, options=options)
    own = plant.droop.customer
    gain = 2.0 * made.model.X[:, own]
    most = min(max_inverters, m)
    found, missing = pairs(gain[plant.meters], max_attacked, most)
    doubt = Doubt(max_attacked, most, plant.droop.rating, frozen(gain[own]))
    return UnknownInputDesign(made, most, found, found.within(), missing, doubt, frozen(gain))


def init(design: UnknownInputDesign, t: float) -> UnknownInputState:
    """Initial state at Unix time t, s."""
    plant, c = design.setting.plant, design.observers
    none = np.zeros(c, dtype=np.intp)
    return UnknownInputState(
        t=t,
        began=t,
        tubes=None,
        contradicted=Tally(none, none, np.zeros(c, dtype=np.bool_)),
        x=np.zeros(plant.droop.tau.size),
        v0_squared=plant.droop.vbar**2,
        named=np.zeros(plant.meters.size, dtype=np.bool_),
        inverters=np.zeros(plant.droop.tau.size, dtype=np.bool_),
        last=None,
    )


def step(
    design: UnknownInputDesign, state: UnknownInputState, frame: Frame
) -> tuple[UnknownInputState, Estimate, Verdict]:
    """Process one frame.

    Parameters
    ----------
    frame
        Data of one tick. A frame that is not later than the last one changes nothing: it returns the last
        estimate and UNDECIDED.
    """
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


def _contradicted(design: UnknownInputDesign, state: UnknownInputState, tick: Tick) -> Tally:
    """Test the pairs, as far as necessary, and count contradictions."""
    options, both, tally = design.setting.options, design.pairs, state.contradicted
    over = np.zeros(design.observers, dtype=np.bool_)
    few = np.count_nonzero(tick.inputs.live) <= 2 * design.setting.max_attacked
    if few or not tick.inputs.busbar:
        return tally
    # Readings that the empty pair explains are explained by all other pairs as well.
    nobody = tick.trial(both.meters[0], both.inverters[0])
    if not nobody.fits:
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
    deaf = deaf_inverters(design, nobody)
    silent = state.named & ~tick.inputs.live
    hold = (silent & ~both.meters).any(axis=1) | (state.inverters & deaf & ~both.inverters).any(axis=1)
    return count(tally, over, np.asarray(~hold), confirm=options.confirm, release=options.release)


def _conclude(
    design: UnknownInputDesign, state: UnknownInputState, tick: Tick
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
    verdict = Verdict(
        *answer(design, state, tick, Found(meters, inverters, threshold, trial, explanations)),
        meters,
        score,
        threshold,
        np.where(meters & inputs.live, inputs.y - v2, 0.0),
        inverters,
        np.where(inverters, trial.attack, 0.0),
        (),
        explanations,
    )
    after = replace(
        state, x=x, v0_squared=inputs.v0_squared, named=meters, inverters=inverters, last=(estimate, verdict)
    )
    return after, estimate, verdict


def _estimate(
    design: UnknownInputDesign, tick: Tick, trial: Trial, chosen: int | None, *, certain: bool
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
        more = Doubt(
            doubt.meters - (int(meters.sum()) if certain else 0),
            doubt.inverters - (int(accused.sum()) if certain else 0),
            doubt.reach,
            doubt.coupling,
        )
        sure = certain and more.meters == 0 and more.inverters == 0
        known = np.minimum(trial.attack_error if sure else np.inf, doubt.reach + np.abs(x))
        bound = spread(now.errors, more, tube, tick.tubes.free, gain) + gain @ np.where(accused, known, 0.0)
    moved = np.abs(seen.correction - inputs.correction)[plant.feeder.bus]
    estimate = Estimate(
        t=tick.frame.t,
        v2=seen.v2,
        bound=np.minimum(tick.error + moved + bound, NO_VOLTAGE),
        v2_bus=seen.v2_bus,
        trusted=inputs.live & ~meters,
        x=x,
    )
    return x, estimate


def _scores(tick: Tick, meters: Bools, inverters: Bools, trial: Trial) -> tuple[Floats, Floats]:
    """Scores of meters against all others of the chosen pair; of suspected ones against the trusted ones."""
    score, threshold = trial.score.copy(), trial.threshold.copy()
    for j in np.flatnonzero(meters & tick.inputs.live).tolist():
        others = meters.copy()
        others[j] = False
        found = tick.trial(others, inverters)
        score[j], threshold[j] = found.score[j], found.threshold[j]
    return score, np.minimum(threshold, NO_VOLTAGE)
