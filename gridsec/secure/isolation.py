"""Isolation of manipulated inputs and sensors by banks of unknown-input observers.

A bank compares every large observer, which distrusts q_1 inputs and q_2 sensors, with all those that
distrust twice as many of each. The observer in best agreement with its company is selected. The attacks
follow from its estimate; inputs and sensors with an attack above the estimate's error are named.

Source: yang2021 (4) to (7), (19), (20), (22) to (24), (42) to (47); docs/theory-unknown-input.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints
from gridsec.errors import DesignInfeasible, NotObservable, Problem, no_choice, raise_if_any
from gridsec.interface import Cause, Decision
from gridsec.observers.lmi.unknown_input import Multiplier
from gridsec.observers.unknown_input import (
    Missing,
    Pair,
    UnknownInputObserver,
    UnknownInputObserverState,
    UnknownInputPlant,
)
from gridsec.observers.unknown_input import design as design_family
from gridsec.observers.unknown_input import init as init_family
from gridsec.observers.unknown_input import step as step_family

Measure = Literal["distance", "bounds"]


@dataclass(frozen=True, slots=True, eq=False)
class IsolationDesign:
    """A bank with its comparisons. n states, r inputs, p sensors."""

    family: UnknownInputObserver  # all observers that exist
    large: Ints  # (a,) indices of the large ones, J of (5) or (22)
    company: Ints  # (a, b) for each large observer the small ones within it, padded by repetition
    alone: Bools  # (a,) large observers without any existing company: they cannot be confirmed
    max_inputs: int  # q_1; a complete bank distrusts all inputs: max_inputs = r
    max_sensors: int  # q_2
    missing: tuple[Missing, ...]  # members missing from the bank. Unless empty, the theorems do not apply
    # measure of disagreement. "distance": the Euclidean norm of (5) and (22), with the selection (6), (23).
    # "bounds": the largest difference of an entry relative to the sum of both observers' error bounds, in
    # which a poorly observed state does not mask others; the observer with the best certified estimate is
    # selected
    measure: Measure
    left: Floats  # (r, n) left inverse of the inputs' matrix
    from_now: Floats  # (r, n) gain from the bound of an estimate to that of the reconstructed input attack
    from_before: Floats  # (r, n) gain from the bound of the estimate before
    from_drift: Floats  # (r,) contribution of the drift

    @property
    def guaranteed(self) -> bool:
        """True if every member exists, as required by Assumptions 2 and 3."""
        return not self.missing


def members(inputs: int, sensors: int, max_inputs: int, max_sensors: int) -> tuple[list[Pair], list[Pair]]:
    """The pairs (J_u, J_s) of both banks.

    inputs, sensors: r and p.
    max_inputs, max_sensors: q_1 and q_2. `max_inputs = inputs` selects the complete bank, in which both
        distrust all inputs.
    Returns large, small: (q_1, p - q_2) and (2 q_1, p - 2 q_2) inputs and sensors.
    Raises NotObservable unless p > 2 q_2 and (except for the complete bank) r > 2 q_1, yang2021 (4), (19),
        (20). ValueError if a count is negative.
    """
    counts = {"max_inputs": max_inputs, "max_sensors": max_sensors}
    raise_if_any(
        Problem("negative", f"{name} is {count}; it cannot be negative")
        for name, count in counts.items()
        if count < 0
    )
    if sensors <= 2 * max_sensors:
        why = f"{sensors} sensors, {max_sensors} of them attacked: more than {2 * max_sensors} are needed"
        raise NotObservable(
            range(sensors), sensors, why + " (yang2021, Assumptions 2 and 3)", code="too-few-meters"
        )
    complete = max_inputs == inputs
    if not complete and inputs <= 2 * max_inputs:
        why = f"{inputs} inputs, {max_inputs} of them attacked: more than {2 * max_inputs} are needed"
        raise NotObservable(
            range(inputs),
            inputs,
            why + ", or the complete bank (yang2021, Assumption 3)",
            code="too-few-meters",
        )
    double = inputs if complete else 2 * max_inputs

    def all_pairs(distrusted: int, trusted: int) -> list[Pair]:
        sets = combinations(range(inputs), distrusted)
        return [(u, s) for u in sets for s in combinations(range(sensors), trusted)]

    return all_pairs(max_inputs, sensors - max_sensors), all_pairs(double, sensors - 2 * max_sensors)


def design(
    plant: UnknownInputPlant,
    *,
    max_inputs: int,
    max_sensors: int,
    measure: Measure = "bounds",
    rates: Sequence[float] = (0.5, 0.8, 0.95, 0.995),
    multiplier: Multiplier = "diagonal",
    tolerance: float = 1e-9,
    rounding: float = 1e-9,
) -> IsolationDesign:
    """Design a bank and list its missing members.

    max_inputs, max_sensors: largest numbers of attacked inputs and sensors, q_1 and q_2; `max_inputs = r` is
        the complete bank.
    measure: see `IsolationDesign`. yang2021: "distance".
    rates, multiplier, tolerance, rounding: see `observers.unknown_input.design`.
    Raises NotObservable if there are too few sensors or inputs for the counts. DesignInfeasible if no member
        exists at all. ValueError if a count is negative, `rates` is empty, or `measure` or `multiplier` is
        unknown.
    """
    raise_if_any(no_choice("measure", get_args(Measure), measure))
    r, p = plant.inputs.shape[1], plant.noise.size
    wide, narrow = members(r, p, max_inputs, max_sensors)
    # With zero counts both banks are the same: one observer, compared with itself.
    asked = wide + [pair for pair in narrow if pair not in set(wide)]
    family = design_family(
        plant, asked, rates=rates, multiplier=multiplier, tolerance=tolerance, rounding=rounding
    )
    place = {pair: i for i, pair in enumerate(family.pairs)}
    large = [pair for pair in wide if pair in place]
    if not large:
        raise DesignInfeasible(
            "bank of unknown-input observers",
            f"no large one exists: {family.missing[0].why}",
            code="no-solution",
        )
    inside = [[place[s] for s in narrow if s in place and _within(s, pair)] for pair in large]
    width = max((len(row) for row in inside), default=0) or 1
    company = [(row or [place[pair]]) for pair, row in zip(large, inside, strict=True)]
    padded = [row + [row[-1]] * (width - len(row)) for row in company]
    lone = np.array([not row for row in inside], dtype=np.bool_)
    lone.flags.writeable = False
    system = plant.system
    left = np.asarray(np.linalg.pinv(plant.inputs), dtype=np.float64)
    slack = np.abs(left @ (system.G * plant.half)) @ np.abs(system.H)
    middle = system.A + (system.G * plant.middle) @ system.H
    return IsolationDesign(
        family=family,
        large=frozen_ints(np.array([place[pair] for pair in large], dtype=np.intp)),
        company=frozen_ints(np.array(padded, dtype=np.intp).reshape(len(large), width)),
        alone=lone,
        max_inputs=max_inputs,
        max_sensors=max_sensors,
        missing=family.missing,
        measure=measure,
        left=frozen(left),
        from_now=frozen(np.abs(left)),
        from_before=frozen(np.abs(left @ middle) + slack),
        from_drift=frozen(np.abs(left @ plant.drift).sum(axis=1)),
    )


def _within(small: Pair, large: Pair) -> bool:
    return set(small[0]) >= set(large[0]) and set(small[1]) <= set(large[1])


def disagreement(design: IsolationDesign, state: UnknownInputObserverState) -> Floats:
    """Disagreement pi of every large observer (a,), (5) and (22); infinite without a member to confirm it."""
    if design.measure == "bounds":
        return contradiction(design, state)
    pi = np.linalg.norm(_gap(design, state), axis=2).max(axis=1)
    return np.where(_dead(design, state), np.inf, pi)


def contradiction(design: IsolationDesign, state: UnknownInputObserverState) -> Floats:
    """Largest difference of an entry from that of the company, relative to the sum of both bounds.

    Returns (a,): infinite without a member to confirm it. A finite value above 1 proves that an attack
        affects the observer or one of its company.
    """
    gap = _gap(design, state)
    allowed = state.box[design.large][:, None, :] + state.box[design.company]
    # Equal estimates agree even if both are known exactly.
    pi = np.where(gap > 0.0, gap / np.maximum(allowed, np.finfo(np.float64).tiny), 0.0).max(axis=(1, 2))
    return np.where(_dead(design, state), np.inf, pi)


def _gap(design: IsolationDesign, state: UnknownInputObserverState) -> Floats:
    """Differences of every large observer's estimate from those of its company, (a, b, n)."""
    return np.asarray(np.abs(state.x[design.large][:, None, :] - state.x[design.company]))


def _dead(design: IsolationDesign, state: UnknownInputObserverState) -> Bools:
    """Mask (a,) of large observers that cannot be confirmed."""
    dead = design.alone | ~state.live[design.large] | ~state.live[design.company].all(axis=1)
    return np.asarray(dead)


def bounds(design: IsolationDesign, state: UnknownInputObserverState) -> Floats:
    """Bounds of the errors of all large observers (a, n), under any attack.

    Some small observer S within J is free of attacks, by Lemmas 1 to 3, so
    `|e_J,i| <= max_S (|x_hat_J,i - x_hat_S,i| + box_S,i)`, for every J: the company also bounds observers
    with attacked sensors. The plant's span limits every error.
    """
    x = state.x[design.large]
    gap = np.abs(x[:, None, :] - state.x[design.company]) + state.box[design.company]
    return np.asarray(np.minimum(gap.max(axis=1), np.abs(x) + design.family.plant.span))


def estimate(
    design: IsolationDesign, state: UnknownInputObserverState, index: int
) -> tuple[Floats, Floats, bool]:
    """Estimate (7), (24) of one large observer with a bound of its error.

    The true state is within the bounds of every large observer, so in the intersection of all these
    intervals.

    index: index among the large observers.
    Returns x (n,), bound (n,), and True if intervals do not intersect: then more is attacked than assumed,
        and the bound is infinite there.
    """
    x, wide = state.x[design.large], bounds(design, state)
    low, high = np.max(x - wide, axis=0), np.min(x + wide, axis=0)
    bound = np.maximum(high - x[index], x[index] - low)
    return x[index], np.where(low <= high, bound, np.inf), bool(np.any(low > high))


def select(design: IsolationDesign, state: UnknownInputObserverState, pi: Floats) -> int:
    """Index of the selected large observer: by (6), (23), or the one with the best certified estimate."""
    if design.measure == "distance":
        return int(np.argmin(pi))
    wide = bounds(design, state)
    best = wide.min(axis=0)
    known = np.isfinite(best)
    return int(np.argmin((wide[:, known] / best[known]).max(axis=1, initial=0.0)))


@dataclass(frozen=True, slots=True, eq=False)
class IsolationState:
    """State between ticks. n states, r inputs, p sensors, l known inputs."""

    family: UnknownInputObserverState  # the observers
    x: Floats | None  # (n,) selected estimate of the last tick
    bound: Floats | None  # (n,) bound of its error
    u: Floats | None  # (l,) known input of the last tick
    inputs: Bools  # (r,) inputs named so far: by Assumption 1 the attacked sets do not change
    sensors: Bools  # (p,) sensors named so far


@dataclass(frozen=True, slots=True, eq=False)
class IsolationStep:
    """Result of one tick. n states, r inputs, p sensors, a large observers."""

    t: float  # time of the tick, s
    decision: Decision  # as in `gridsec.interface.Verdict`. UNDECIDED if members of the bank are missing
    cause: Cause
    reason: str
    x: Floats  # (n,) estimate (7), (24)
    bound: Floats  # (n,) bound of its error under the theorems' assumptions
    selected: Pair  # (J_u, J_s) of the selected observer
    # (a,) pi of (5) or (22) for each large observer, infinite if it cannot be confirmed. With "bounds", a
    # value above 1 proves that an attack affects the observer or one of its company
    disagreement: Floats
    input_attack: Floats  # (r,) (42), of the *last* tick; NaN at the first tick
    input_threshold: Floats  # (r,) its largest value without attack; infinite at the first tick
    sensor_attack: Floats  # (p,) (43); NaN where unseen
    sensor_threshold: Floats  # (p,) its largest value without attack
    inputs_now: Bools  # (r,) (46) with these thresholds, for this tick alone
    sensors_now: Bools  # (p,) (47) likewise
    inputs: Bools  # (r,) inputs named at this tick or before
    sensors: Bools  # (p,) sensors named at this tick or before


def init(
    design: IsolationDesign, t: float, x: Floats | None = None, radius: Floats | None = None
) -> IsolationState:
    """Initial state of a bank.

    t: time of the first readings, s.
    x, radius (n,): initial estimate of all observers, and the bound of its error, see
        `observers.unknown_input.init`.
    """
    r, p = len(design.left), len(design.family.plant.noise)
    none_attacked = np.zeros(r, dtype=np.bool_), np.zeros(p, dtype=np.bool_)
    return IsolationState(init_family(design.family, t, x, radius), None, None, None, *none_attacked)


def input_attack(design: IsolationDesign, x: Floats, before: Floats, u: Floats) -> Floats:
    """Attack on the inputs at the last tick, (42): `B_a^+ (x_hat - A x_hat- - G phi(z_hat-) - B u-)`.

    x, before (n,): estimates at this tick and at the last. u (l,): known input of the last tick.
    """
    s = design.family.plant.system
    expected = s.A @ before + s.G @ s.phi(s.H @ before + s.F @ u) + s.B @ u
    return np.asarray(design.left @ (x - expected))


def support(attack: Floats, threshold: Floats | float) -> Bools:
    """Attacked entries, (46) and (47): those of a reconstructed attack above their threshold.

    The printed `supp` requires exact zeros, which no estimate has after finitely many steps.

    attack (…): from (42) or (43); NaN counts as not attacked.
    threshold (…) or scalar: largest value without attack.
    """
    return np.asarray(np.abs(np.nan_to_num(attack)) > threshold)


def step(
    design: IsolationDesign, state: IsolationState, y: Floats, u: Floats, seen: Bools
) -> tuple[IsolationState, IsolationStep]:
    """Process one tick and name attacked inputs and sensors.

    y (p,): readings; arbitrary where unseen.
    u (l,): known input of this tick; finite, seen (p,).
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
    answer = IsolationStep(
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
    """Evidence for an answer besides the named inputs and sensors."""

    torn: bool  # True if the large observers' intervals do not intersect
    contradicted: bool  # True if an observer differs from its company by more than the sum of both bounds
    confirmed: bool  # True if an observer and its company have used readings
    settled: bool  # True if the estimate's bound is below the prior one
    silent: Bools  # (p,) sensors without a reading


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
