"""What the high-gain estimator answers at one instant.

References
----------
kim2018, section III; docs/theory-high-gain.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gridsec.arrays import Bools, Floats
from gridsec.online import Cause, Decision

Search = Literal["all", "one"]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Answer at one instant.

    Attributes
    ----------
    t
        Time, s.
    x : (n,)
        Estimate of the state; NaN where no set is complete.
    bound
        Bound on its largest error while at most q sensors are attacked; NaN if the design has no
        `lowest`, infinite when no set passed.
    sigma
        Place of the set it rests on, from 0.
    visited
        The sets that were tried, in order; the last is `sigma`.
    trusted : (p,)
        The sensors of that set.
    residual, threshold
        Of that set; NaN where it was not tested.
    decision, cause, reason
        As everywhere in this project: UNDECIDED is an answer of its own.
    suspects : (p,)
        Sensors that are named. If `bound` is known: those that cannot be healthy; otherwise, after an
        alarm, those outside the trusted set.
    reset : (p,)
        Observers that were reset in this step.
    """

    t: float
    x: Floats
    bound: float
    sigma: int
    visited: tuple[int, ...]
    trusted: Bools
    residual: float
    threshold: float
    decision: Decision
    cause: Cause
    reason: str
    suspects: Bools
    reset: Bools


def verdict(
    *,
    heard: int,
    needed: int,
    passed: bool | None,
    alarm: bool,
    settled: bool,
    untested: int,
    search: Search,
) -> tuple[Decision, Cause, str]:
    """Decision, its cause, and one sentence.

    Parameters
    ----------
    heard
        Number of sensors with a reading.
    needed
        Number of sensors of a set.
    passed
        Whether the last set passed its test; None: it was not complete, and not tested.
    alarm
        Whether some test failed or some sensor is named.
    settled
        Whether the bounds of all observers that are heard have come to rest.
    untested
        Number of sensors with a reading that no test has looked at.
    search
        As in the design: with "one", other sets may still pass later.
    """
    if passed is None:
        reason = f"{heard} sensors are heard and no set of {needed} is complete"
        return Decision.UNDECIDED, Cause.TOO_FEW_METERS, reason
    if not passed:
        reason = "no set that was tried explains its own estimates"
        cause = Cause.SETTLING if search == "one" else Cause.TOO_MANY_SUSPECTS
        return Decision.UNDECIDED, cause, reason
    if alarm:
        return Decision.ATTACKED, Cause.RESIDUALS, "estimates disagree by more than honest sensors can"
    if not settled:
        return Decision.UNDECIDED, Cause.SETTLING, "the observers have not settled yet"
    if untested:
        reason = f"the sensors in use agree within their bounds; {untested} more were not tested"
        return Decision.UNDECIDED, Cause.AMBIGUOUS, reason
    return Decision.CLEAN, Cause.AGREEMENT, "all sensors agree within their bounds"
