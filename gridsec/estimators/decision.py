"""Decision logic: from residuals to named meters and a verdict, without physics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.interface import Cause, Decision


@dataclass(frozen=True, slots=True, eq=False)
class Counters:
    """Counters of each meter's latest readings. p meters."""

    above: Ints  # (p,) readings above the threshold since the meter became suspect; 0 for meters not suspect
    below: Ints  # (p,) consecutive readings not above the threshold
    named: Bools  # (p,) meters named as manipulated


def no_counts(size: int) -> Counters:
    """Counters before the first reading."""
    zero = np.zeros(size, dtype=np.intp)
    return Counters(zero, zero, np.zeros(size, dtype=np.bool_))


def count(tally: Counters, over: Bools, live: Bools, *, confirm: int, release: int) -> Counters:
    """Update the counters with the residuals of one frame.

    A reading above the threshold makes a meter suspect; only `release` consecutive readings below it end
    that. The meter is named with the `confirm`-th reading above, with or without others in between: attacking
    every second reading does not avoid detection. An unavailable meter keeps its state: a named meter is not
    cleared by silence.

    confirm, release: readings above the threshold until a meter is named, and consecutive readings below it
        until it is neither named nor suspect.
    """
    below = np.where(live, np.where(over, 0, tally.below + 1), tally.below)
    above = np.where(below >= release, 0, tally.above + (live & over))
    named = (tally.named & (below < release)) | (above >= confirm)
    return Counters(above, below, named)


@dataclass(frozen=True, slots=True, eq=False)
class DecisionInputs:
    """Inputs of a verdict. p meters."""

    names: tuple[str, ...]  # (p,) names of the meters in sentences
    max_attacked: int  # M
    # live, suspected, named (p,): meters that are available, suspect, and named
    live: Bools
    suspected: Bools
    named: Bools
    wide: Bools  # (p,) meters with a threshold that is too wide for an answer or not finite
    # valid, settled, busbar: True if the design holds, if the initial transient has decayed, and if the
    # busbar voltage is known
    valid: bool
    settled: bool
    busbar: bool


def decide(now: DecisionInputs) -> tuple[Decision, Cause, str]:
    """The answer, its cause, and one sentence for an operator.

    Causes that invalidate every other answer come first; CLEAN is the answer if no other cause applies.
    """
    blind = _blind(now)
    if blind is not None:
        return Decision.UNDECIDED, *blind
    if any_of(now.named):
        far = "further off than meter accuracy and load uncertainty allow"
        return Decision.ATTACKED, Cause.RESIDUALS, f"Manipulated: {_list(now, now.named)}; {far}."
    doubt = _doubt(now)
    if doubt is not None:
        return Decision.UNDECIDED, *doubt
    return Decision.CLEAN, Cause.AGREEMENT, "All meters agree with the feeder."


def _blind(now: DecisionInputs) -> tuple[Cause, str] | None:
    """Cause and reason that prevent naming any meter; None if there are none."""
    # Unavailable meters, named or not, count neither for nor against others.
    live, named = int(np.count_nonzero(now.live)), int(np.count_nonzero(now.named & now.live))
    need = 2 * now.max_attacked + 1
    if not now.valid:
        reason = "The design's certificate does not hold for this feeder; nothing is guaranteed."
        return Cause.DESIGN_INVALID, reason
    if live < need:
        reason = (
            f"{live} of {now.live.size} meters report; at least {need} are needed to tell "
            f"{_liars(now.max_attacked)}."
        )
        return Cause.TOO_FEW_METERS, reason
    if not now.busbar:
        reason = (
            "The busbar voltage is missing; it is replaced by what most meters imply, which is less exact."
        )
        return Cause.NO_BUSBAR, reason
    if named > now.max_attacked:
        reason = (
            f"{named} meters disagree with the feeder ({_list(now, now.named)}), and at most "
            f"{now.max_attacked} can be told apart. A wrong busbar reading, switch or line in the model "
            "looks the same."
        )
        return Cause.TOO_MANY_SUSPECTS, reason
    return None


def _doubt(now: DecisionInputs) -> tuple[Cause, str] | None:
    """Cause and reason against CLEAN while no meter is named; None if there are none."""
    silent, pending = ~now.live, now.suspected & ~now.named
    if any_of(silent):
        return Cause.SILENT_METERS, f"No reading from {_list(now, silent)}."
    if not now.settled:
        return Cause.SETTLING, "The observers have not settled yet."
    if any_of(pending):
        reason = f"{_list(now, pending)}: further off than allowed lately, but not often enough to be named."
        return Cause.AMBIGUOUS, reason
    if any_of(now.wide):
        return Cause.AMBIGUOUS, f"The loads are not known well enough to judge {_list(now, now.wide)}."
    return None


def _liars(most: int) -> str:
    return (
        "one manipulated meter from the others" if most == 1 else f"{most} manipulated meters from the others"
    )


_SHOWN = 5


def _list(now: DecisionInputs, which: Bools) -> str:
    """Names of the meters, at most `_SHOWN` of them."""
    if not any_of(which):
        return ""
    names = [now.names[j] for j in np.flatnonzero(which).tolist()]
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest


def residual_excess(score: Floats, threshold: Floats, live: Bools) -> Floats:
    """Relative excess of residuals over their thresholds; 0 below them.

    score, threshold (p,): residuals and thresholds, squared pu.
    """
    ratio = np.divide(score, threshold, out=np.zeros_like(threshold), where=live & (threshold > 0))
    return np.asarray(np.maximum(ratio - 1.0, 0.0))
