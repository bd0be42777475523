"""Result of the high-gain estimator at one instant.

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
    """Result at one instant.

    Attributes
    ----------
    t
        Time, s.
    x : (n,)
        Estimate of the state; NaN if no set is complete.
    bound
        Bound on its largest error while at most q sensors are attacked; NaN if the design has no `lowest`,
        infinite if no set passed.
    sigma
        Index of the set in use, from 0.
    visited
        The tested sets, in order; the last is `sigma`.
    trusted : (p,)
        The sensors of that set.
    residual, threshold
        Of that set; NaN if not tested.
    decision, cause, reason
        As in `gridsec.online`; UNDECIDED is an answer of its own.
    suspects : (p,)
        Sensors named as manipulated. With a known `bound`: those that cannot be unmanipulated; otherwise,
        after an alarm, those outside the trusted set.
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
    """Decision, cause, and one sentence.

    Parameters
    ----------
    heard
        Number of sensors with a reading.
    needed
        Number of sensors of a set.
    passed
        True if the last set passed its test; None if it was not complete, and not tested.
    alarm
        True if a test failed or a sensor is named.
    settled
        True if the bounds of all observers with readings have settled.
    untested
        Number of sensors with a reading but without a test.
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
