"""Decision and operator sentence from the pairs that remain possible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.families.pair_tick import Tick, UnknownInputDesign, UnknownInputState
from gridsec.families.pairs import Pairs, Trial
from gridsec.judge import Situation, decide
from gridsec.online import Cause, Decision, Explanation

Answer = tuple[Decision, Cause, str]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of the pairs of one tick. p meters, m inverters.

    Attributes
    ----------
    meters, inverters : (p,), (m,)
        Members of every possible pair.
    threshold : (p,)
        Largest score of each meter without manipulation, squared pu.
    trial
        Result of the likeliest pair.
    explanations
        The smallest possible pairs where there are several.
    """

    meters: Bools
    inverters: Bools
    threshold: Floats
    trial: Trial
    explanations: tuple[Explanation, ...]


_SHOWN = 8


def explain(pairs: Pairs, trials: dict[int, Trial], order: list[int]) -> tuple[Explanation, ...]:
    """The smallest possible pairs, likeliest first, with probabilities for normal errors."""
    best = trials[order[0]].misfit
    weights = np.exp([-0.5 * (trials[k].misfit - best) for k in order])
    shares = weights / weights.sum()
    return tuple(
        Explanation(pairs.meters[k].copy(), pairs.inverters[k].copy(), float(share))
        for k, share in list(zip(order, shares, strict=True))[:_SHOWN]
    )


def deaf_inverters(design: UnknownInputDesign, trial: Trial) -> Bools:
    """Mask (m,) of inverters with possible undetected wrong injections above their curve's span."""
    return np.asarray(trial.attack_error > design.setting.plant.droop.span)


def answer(
    design: UnknownInputDesign,
    state: UnknownInputState,
    tick: Tick,
    found: Found,
) -> Answer:
    """Decision, cause and one sentence; `gridsec.judge` decides on meters as for every estimator."""
    now, live = design.setting, tick.inputs.live
    plant = now.plant
    meters, inverters, explanations = found.meters, found.inverters, found.explanations
    customers = plant.feeder.customers
    names = [customers[c] for c in plant.meters]
    owners = [customers[c] for c in plant.droop.customer]
    pending = (state.contradicted.above > 0) & ~state.contradicted.named
    memory = np.exp(-(state.t - state.began) / plant.droop.tau.max(initial=_SHORT))
    base = decide(
        Situation(
            names=tuple(names),
            max_attacked=now.max_attacked,
            live=live,
            suspected=np.zeros(live.size, dtype=np.bool_),
            named=meters,
            wide=live & ~(found.threshold <= now.options.widest),
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
        deaf = deaf_inverters(design, found.trial)
        unjudged = _list(np.zeros_like(live), deaf, names, owners)
        base = (
            (*ambiguous, f"No meter disagrees, but readings are too coarse to judge {unjudged}.")
            if deaf.any()
            else (*base[:2], _agreement(design, found.trial, owners))
        )
    return base


_SHORT = 1e-3
_NAMED = 4


def _agreement(design: UnknownInputDesign, trial: Trial, owners: list[str]) -> str:
    """Sentence of CLEAN with the undetectable remainder: injections above twice their error are detected."""
    said = "All meters and inverters agree with the feeder"
    if not owners:
        return f"{said}."
    unseen = 2.0 * trial.attack_error * design.setting.plant.feeder.base_kva
    most = int(np.argmax(unseen))
    return f"{said}; up to {unseen[most]:.0f} kvar of the inverter of {owners[most]} could go unseen."


def _list(meters: Bools, inverters: Bools, names: list[str], owners: list[str]) -> str:
    parts = [names[j] for j in np.flatnonzero(meters)]
    parts += [f"the inverter of {owners[i]}" for i in np.flatnonzero(inverters)]
    rest = f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else ""
    return " and ".join(parts[:_NAMED]) + rest
