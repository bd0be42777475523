"""From residuals to a verdict: who is named, and what the answer is. Pure bookkeeping, no physics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.online import Cause, Decision


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """What each meter's latest readings were like. p meters.

    Attributes
    ----------
    above : (p,)
        Readings above the threshold since the meter fell under suspicion; 0: it is under none.
    below : (p,)
        Readings in a row not above the threshold.
    named : (p,)
        Meters named as manipulated.
    """

    above: Ints
    below: Ints
    named: Bools


def count(tally: Tally, over: Bools, live: Bools, *, confirm: int, release: int) -> Tally:
    """Take the residuals of one frame into account.

    A reading above the threshold puts a meter under suspicion; only `release` readings in a row below it
    end that. The meter is named with the `confirm`-th reading above, whether or not there were others in
    between: who lies on every second reading only is not better off. A silent meter stays what it
    was: who was named and then falls silent has not been cleared.

    Parameters
    ----------
    tally
        So far.
    over : (p,)
        Whose residual is above the threshold.
    live : (p,)
        Who has a residual at all.
    confirm, release
        Readings above the threshold after which a meter is named, and readings in a row below it after
        which it is neither named nor suspected any more.
    """
    below = np.where(live, np.where(over, 0, tally.below + 1), tally.below)
    above = np.where(below >= release, 0, tally.above + (live & over))
    named = (tally.named & (below < release)) | (above >= confirm)
    return Tally(above, below, named)


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """What a verdict depends on. p meters.

    Attributes
    ----------
    names : (p,)
        How to call the meters in sentences.
    max_attacked
        M.
    live, suspected, named : (p,)
        Who reports, who was above the threshold lately, who is named.
    wide : (p,)
        Whose threshold is too wide for an answer, or is none.
    valid, settled, busbar
        Whether the design holds, the initial state is forgotten, and the busbar voltage is known.
    """

    names: tuple[str, ...]
    max_attacked: int
    live: Bools
    suspected: Bools
    named: Bools
    wide: Bools
    valid: bool
    settled: bool
    busbar: bool


def decide(now: Situation) -> tuple[Decision, Cause, str]:
    """The answer, its cause, and one sentence for an operator.

    In this order: what makes every other answer worthless comes first, and CLEAN is what is left when
    nothing speaks against it.

    Parameters
    ----------
    now
        The situation.
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


def _blind(now: Situation) -> tuple[Cause, str] | None:
    """What keeps anybody from being named."""
    # Who is silent, named or not, neither says anything nor contradicts anybody.
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


def _doubt(now: Situation) -> tuple[Cause, str] | None:
    """What keeps the feeder from being called clean though nobody is named."""
    silent, pending = ~now.live, now.suspected & ~now.named
    if any_of(silent):
        return Cause.SILENT_METERS, f"No reading from {_list(now, silent)}."
    if not now.settled:
        return Cause.SETTLING, "The observers have not forgotten their initial state yet."
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


def _list(now: Situation, which: Bools) -> str:
    """The meters' names, the first few of many."""
    if not any_of(which):
        return ""
    names = [now.names[j] for j in np.flatnonzero(which).tolist()]
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest


def residual_excess(score: Floats, threshold: Floats, live: Bools) -> Floats:
    """How far residuals are above their thresholds, in thresholds; 0 where they are not.

    Parameters
    ----------
    score, threshold : (p,)
        Residuals and thresholds, squared pu.
    live : (p,)
        Who has a residual.
    """
    ratio = np.divide(score, threshold, out=np.zeros_like(threshold), where=live & (threshold > 0))
    return np.asarray(np.maximum(ratio - 1.0, 0.0))
