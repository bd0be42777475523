"""What the pairs that are left mean: the decision, and one sentence for an operator."""

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
    """What one tick's pairs say. p meters, m inverters.

    Attributes
    ----------
    meters, inverters : (p,), (m,)
        Who is in every pair that is possible.
    threshold : (p,)
        Largest honest score of each meter, squared pu.
    trial
        What the likeliest pair makes of the tick.
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
    """The smallest pairs that are possible, with their likelihoods for normal errors of the same spread.

    Parameters
    ----------
    pairs
        All candidates.
    trials
        What those make of the tick.
    order
        The likeliest first.
    """
    best = trials[order[0]].misfit
    weights = np.exp([-0.5 * (trials[k].misfit - best) for k in order])
    shares = weights / weights.sum()
    return tuple(
        Explanation(pairs.meters[k].copy(), pairs.inverters[k].copy(), float(share))
        for k, share in list(zip(order, shares, strict=True))[:_SHOWN]
    )


def deaf_inverters(design: UnknownInputDesign, trial: Trial) -> Bools:
    """Inverters whose wrong injections may be as large as their curves reach without being seen; (m,).

    Parameters
    ----------
    design, trial
        What watches, and what a pair makes of the tick.
    """
    return np.asarray(trial.attack_error > design.setting.plant.droop.span)


def answer(
    design: UnknownInputDesign,
    state: UnknownInputState,
    tick: Tick,
    found: Found,
) -> Answer:
    """The decision, its cause, and one sentence; what every estimator says of meters is `gridsec.judge`'s.

    Parameters
    ----------
    design, state, tick
        What watches, where it stands, and what came.
    found
        Who is accused.
    """
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
        texts = [_who(e.meters, e.inverters, names, owners) for e in explanations[:_NAMED]]
        more = f" or {len(explanations) - _NAMED} more" if len(explanations) > _NAMED else ""
        base = *ambiguous, f"Manipulated is {' or else '.join(texts)}{more}."
    elif meters.any() or inverters.any():
        who = _who(meters, inverters, names, owners)
        reason = f"Manipulated: {who}; further off than meter accuracy and load uncertainty allow."
        base = Decision.ATTACKED, Cause.RESIDUALS, reason
    elif base[0] is Decision.CLEAN and pending.any():
        base = *ambiguous, "Readings were further off than allowed lately, but not often enough."
    elif base[0] is Decision.CLEAN:
        deaf = deaf_inverters(design, found.trial)
        who = _who(np.zeros_like(live), deaf, names, owners)
        base = (
            (*ambiguous, f"No meter disagrees, but readings are too coarse to judge {who}.")
            if deaf.any()
            else (*base[:2], _agreement(design, found.trial, owners))
        )
    return base


_SHORT = 1e-3
_NAMED = 4


def _agreement(design: UnknownInputDesign, trial: Trial, owners: list[str]) -> str:
    """What CLEAN says, and how much it leaves open: an injection of twice its error is seen for certain."""
    said = "All meters and inverters agree with the feeder"
    if not owners:
        return f"{said}."
    unseen = 2.0 * trial.attack_error * design.setting.plant.feeder.base_kva
    most = int(np.argmax(unseen))
    return f"{said}; up to {unseen[most]:.0f} kvar of the inverter of {owners[most]} could go unseen."


def _who(meters: Bools, inverters: Bools, names: list[str], owners: list[str]) -> str:
    parts = [names[j] for j in np.flatnonzero(meters)]
    parts += [f"the inverter of {owners[i]}" for i in np.flatnonzero(inverters)]
    rest = f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else ""
    return " and ".join(parts[:_NAMED]) + rest
