"""Online isolation: attacks by the selected estimate, and named inputs and sensors.

References
----------
yang2021 (42) to (47); docs/theory-unknown-input.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.isolation.design import IsolationDesign
from gridsec.isolation.selection import contradiction, disagreement, estimate, select
from gridsec.observers.unknown_input import Pair, UnknownInputState
from gridsec.observers.unknown_input import init as init_family
from gridsec.observers.unknown_input import step as step_family
from gridsec.online import Cause, Decision


@dataclass(frozen=True, slots=True, eq=False)
class IsolationState:
    """State between ticks. n states, r inputs, p sensors, l known inputs.

    Attributes
    ----------
    family
        The observers.
    x, bound : (n,) or None
        Selected estimate and bound of its error at the last tick.
    u : (l,) or None
        Known input of the last tick.
    inputs, sensors : (r,), (p,)
        Named so far: by Assumption 1 the attacked sets do not change.
    """

    family: UnknownInputState
    x: Floats | None
    bound: Floats | None
    u: Floats | None
    inputs: Bools
    sensors: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Isolation:
    """Result of one tick. n states, r inputs, p sensors, a large observers.

    Attributes
    ----------
    t
        Time of the tick, s.
    decision, cause, reason
        As in `gridsec.online.Verdict`. UNDECIDED if members of the bank are missing.
    x, bound : (n,)
        Estimate (7), (24) and a bound of its error, valid under the theorems' assumptions.
    selected
        (J_u, J_s) of the selected observer.
    disagreement : (a,)
        pi of (5) or (22) for each large observer, infinite if it cannot be confirmed. With "bounds", a value
        above 1 proves that an attack affects the observer or one of its company.
    input_attack, input_threshold : (r,)
        (42), of the *last* tick, and its largest value without attack. NaN and infinite at the first tick.
    sensor_attack, sensor_threshold : (p,)
        (43), NaN where unseen, and its largest value without attack.
    inputs_now, sensors_now : (r,), (p,)
        (46), (47) with these thresholds, for this tick alone.
    inputs, sensors : (r,), (p,)
        Named at this tick or before.
    """

    t: float
    decision: Decision
    cause: Cause
    reason: str
    x: Floats
    bound: Floats
    selected: Pair
    disagreement: Floats
    input_attack: Floats
    input_threshold: Floats
    sensor_attack: Floats
    sensor_threshold: Floats
    inputs_now: Bools
    sensors_now: Bools
    inputs: Bools
    sensors: Bools


def init(
    design: IsolationDesign, t: float, x: Floats | None = None, radius: Floats | None = None
) -> IsolationState:
    """Initial state of a bank.

    Parameters
    ----------
    t
        Time of the first readings, s.
    x, radius : (n,)
        Initial estimate of all observers, and the bound of its error, see `observers.unknown_input.init`.
    """
    r, p = len(design.left), len(design.family.plant.noise)
    nobody = np.zeros(r, dtype=np.bool_), np.zeros(p, dtype=np.bool_)
    return IsolationState(init_family(design.family, t, x, radius), None, None, None, *nobody)


def input_attack(design: IsolationDesign, x: Floats, before: Floats, u: Floats) -> Floats:
    """Attack on the inputs at the last tick, (42): `B_a^+ (x_hat - A x_hat- - G phi(z_hat-) - B u-)`.

    Parameters
    ----------
    x, before : (n,)
        Estimates at this tick and at the last.
    u : (l,)
        Known input of the last tick.

    Returns
    -------
    Floats
        (r,).
    """
    s = design.family.plant.system
    expected = s.A @ before + s.G @ s.phi(s.H @ before + s.F @ u) + s.B @ u
    return np.asarray(design.left @ (x - expected))


def support(attack: Floats, threshold: Floats | float) -> Bools:
    """Attacked entries, (46) and (47): those of a reconstructed attack above their threshold.

    The printed `supp` requires exact zeros, which no estimate has after finitely many steps.

    Parameters
    ----------
    attack : (…)
        From (42) or (43); NaN counts as not attacked.
    threshold : (…) or scalar
        Largest value without attack.
    """
    return np.asarray(np.abs(np.nan_to_num(attack)) > threshold)


def step(
    design: IsolationDesign, state: IsolationState, y: Floats, u: Floats, seen: Bools
) -> tuple[IsolationState, Isolation]:
    """Process one tick and name attacked inputs and sensors.

    Parameters
    ----------
    y : (p,)
        Readings; arbitrary where unseen.
    u : (l,)
        Known input of this tick; finite.
    seen : (p,)
        True for existing readings.

    Returns
    -------
    state, answer
        Never raises on data.
    """
    plant, s = design.family.plant, design.family.plant.system
    family = step_family(design.family, state.family, y, u, seen)
    pi = disagreement(design, family)
    best = select(design, family, pi)
    x, bound, torn = estimate(design, family, best)
    heard = np.asarray(seen, dtype=np.bool_) & np.isfinite(y)
    sensor_attack = np.where(heard, np.where(heard, y, 0.0) - s.C @ x - s.D @ u, np.nan)
    sensor_threshold = _times(np.abs(s.C), bound) + plant.noise
    input_attack_, input_threshold = _inputs(design, state, x, bound)
    inputs_now = support(input_attack_, input_threshold)
    sensors_now = support(sensor_attack, sensor_threshold)
    inputs, sensors = state.inputs | inputs_now, state.sensors | sensors_now
    excess = pi if design.measure == "bounds" else contradiction(design, family)
    told = np.isfinite(excess)
    evidence = _Evidence(
        torn=torn,
        contradicted=bool(np.any(told & (excess > 1.0))),
        # At the first tick no observer has used a reading yet, for any prior knowledge.
        confirmed=state.x is not None and bool(np.any(told)),
        settled=bool(np.all(bound < plant.span)),
        silent=~heard,
    )
    decision, cause, reason = _decide(design, evidence, inputs, sensors)
    answer = Isolation(
        t=family.t,
        decision=decision,
        cause=cause,
        reason=reason,
        x=x,
        bound=bound,
        selected=design.family.pairs[design.large[best]],
        disagreement=pi,
        input_attack=input_attack_,
        input_threshold=input_threshold,
        sensor_attack=sensor_attack,
        sensor_threshold=sensor_threshold,
        inputs_now=inputs_now,
        sensors_now=sensors_now,
        inputs=inputs,
        sensors=sensors,
    )
    kept = np.asarray(u, dtype=np.float64)
    return IsolationState(family, x, bound, kept, inputs, sensors), answer


def _inputs(
    design: IsolationDesign, state: IsolationState, x: Floats, bound: Floats
) -> tuple[Floats, Floats]:
    """Reconstructed input attack of the last tick, and its largest value without attack."""
    if state.x is None or state.bound is None or state.u is None:
        return np.full(len(design.left), np.nan), np.full(len(design.left), np.inf)
    threshold = _times(design.from_now, bound) + _times(design.from_before, state.bound) + design.from_drift
    return input_attack(design, x, state.x, state.u), threshold


def _times(matrix: Floats, bound: Floats) -> Floats:
    """`matrix @ bound` for a non-negative matrix and a possibly infinite bound; 0 times infinity is 0."""
    endless = ~np.isfinite(bound)
    reached = np.any((matrix > 0.0) & endless, axis=1)
    return np.where(reached, np.inf, matrix @ np.where(endless, 0.0, bound))


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """Evidence for an answer besides the named inputs and sensors.

    Attributes
    ----------
    torn
        True if the large observers' intervals do not intersect.
    contradicted
        True if an observer differs from its company by more than the sum of both bounds.
    confirmed
        True if an observer and its company have used readings.
    settled
        True if the estimate's bound is below the prior one.
    silent : (p,)
        Sensors without a reading.
    """

    torn: bool
    contradicted: bool
    confirmed: bool
    settled: bool
    silent: Bools


def _decide(
    design: IsolationDesign, evidence: _Evidence, inputs: Bools, sensors: Bools
) -> tuple[Decision, Cause, str]:
    names = f"inputs {np.flatnonzero(inputs).tolist()}, sensors {np.flatnonzero(sensors).tolist()}"
    if not design.guaranteed:
        count = len(design.missing)
        reason = f"{count} members of the bank do not exist, nothing is proven; suspected: {names}"
        return Decision.UNDECIDED, Cause.DESIGN_INVALID, reason
    if evidence.torn:
        reason = "no set of trusted inputs and sensors agrees with itself: more are attacked than assumed"
        return Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS, reason
    if np.count_nonzero(inputs) > design.max_inputs or np.count_nonzero(sensors) > design.max_sensors:
        return Decision.UNDECIDED, Cause.TOO_MANY_SUSPECTS, f"more are named than assumed: {names}"
    if np.any(inputs) or np.any(sensors):
        return Decision.ATTACKED, Cause.RESIDUALS, f"attacked: {names}"
    return _quiet(evidence)


def _quiet(evidence: _Evidence) -> tuple[Decision, Cause, str]:
    """Answer without named inputs or sensors."""
    silent = np.flatnonzero(evidence.silent).tolist()
    if evidence.contradicted:
        reason = "observers contradict each other, and no attack can be isolated"
        reason += f"; sensors {silent} are silent" if silent else ""
        return Decision.UNDECIDED, Cause.AMBIGUOUS, reason
    if not evidence.confirmed:
        reason = "no observer and its company have readings of all their sensors at two consecutive ticks"
        reason += f"; sensors {silent} are silent" if silent else ""
        return Decision.UNDECIDED, Cause.SETTLING, reason
    if not evidence.settled:
        reason = "the estimate's error bound is not below the prior bound"
        return Decision.UNDECIDED, Cause.SETTLING, reason
    reason = "every input and sensor is within its bounds"
    if silent:
        reason = f"all available sensors are within their bounds; sensors {silent} are silent"
    return Decision.CLEAN, Cause.AGREEMENT, reason
