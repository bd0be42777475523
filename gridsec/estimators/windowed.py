"""Windows of consistency, yang2019, on a feeder.

One observer with direct injection trusts all meters, one every p - M of them, one every p - 2M. Without
manipulated meters in either, two observers J and S differ at inverter i by at most the sum of their errors:

    |x_J,i - x_S,i| <= level_J,i + level_S,i,    level_J,i = driven_i if J has the meter of i, else free_i.

`driven` and `free` are the worst-case bounds of `gridsec.estimators.detection`: meters at the limits of
their class, loads anywhere in their intervals, remainders of losses and sampling, and the transient. They
belong to the frame, so that the thresholds of yang2019 (10) and (19), one number each, become one for every
inverter and tick; pi and pi_J are measured in them, and evidence is a value above 1. A window of N readings
then

- detects if pi exceeded 1 at any of them (Algorithm 1), and
- names the meters outside every set J that passes (Algorithm 2, or its sound variant "survivors").

The estimate is that of the J with the smallest disagreement. The lags of the inverters are discretised again
for every interval, so that readings may be 1 s or 15 min apart; a window counts readings, not seconds.

An attack inside the dead band of a curve, beyond its saturation, or on a meter without an inverter moves no
injection: windows cannot detect it, at any size. Output residuals can. If they contradict the windows, the
answer is UNDECIDED. CLEAN needs both.

Source: yang2019, Algorithms 1 and 2, (8), (10), (17), (19); docs/theory-discrete.md, sections 3 and 6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible, Problem, no_choice, raise_if_any
from gridsec.estimators import exact_bank
from gridsec.estimators.detection import ErrorBound
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.exact_bank.direct import SlotState
from gridsec.estimators.exact_bank.step import MonitorDesign, MonitorState
from gridsec.estimators.plant import Plant
from gridsec.interface import Cause, Decision, Estimate, Frame, Verdict
from gridsec.secure.windows import Rule, detection, isolation

LENGTHS = (50, 100, 200)
"""Readings in a window, as in the paper's example."""

LENGTH = LENGTHS[0]
"""Default length: the shortest.

A window answers at its end only, so that an attack is reported up to two lengths after its begin, 100 s at
one reading a second. Longer windows name the same meters later (`benchmarks.windowed`): worst-case
thresholds do not tighten with time.
"""


@dataclass(frozen=True, slots=True, eq=False)
class WindowedDesign:
    """Design of the windowed estimator."""

    # design of the exact bank: observers, certificate, preparation of frames, reconstruction
    chain: MonitorDesign
    length: int  # N, readings in a window
    rule: Rule  # "survivors" or "majority", see `gridsec.secure.windows.isolation`

    @property
    def observers(self) -> int:
        """Number of observers: those of both banks, and the one that trusts all meters."""
        return 1 + self.chain.observers


@dataclass(frozen=True, slots=True, eq=False)
class WindowResult:
    """Result of one full window. p meters."""

    judged: bool  # True if enough meters were available at every reading
    detected: bool  # Algorithm 1: True if pi exceeded its threshold
    decided: bool  # Algorithm 2: True if there is an answer
    suspects: Bools  # (p,) Algorithm 2: its answer


@dataclass(frozen=True, slots=True, eq=False)
class WindowedState:
    """State between frames. s large sets."""

    chain: MonitorState  # state of the exact bank
    pi: Floats  # (i,) pi of the window's readings so far, in thresholds; NaN where not judged
    pi_sets: Floats  # (i, s) likewise pi_J
    said: WindowResult | None  # result of the last full window; None before the first one


def design(
    plant: Plant, *, max_attacked: int, step_s: float, length: int = LENGTH, rule: Rule = "survivors"
) -> WindowedDesign:
    """Design the observers and windows for one feeder.

    max_attacked: M, at least 1.
    step_s: expected interval between frames, s.
    length: N, readings in a window; one of `LENGTHS`, or any other.
    rule: isolation rule of a window. The thresholds are bounds, so that one exceedance counts: "survivors".
        The paper's vote, "majority", requires exceedances at more than half of the readings.
    Raises NotObservable unless there are more than 2M meters; DesignInfeasible if no certificate holds, the
        bank would be too large, there is no droop inverter, or M is 0; ValueError if `length` is below 1, or
        `rule` is unknown.
    """
    if not plant.droop.tau.size:
        raise DesignInfeasible(
            "windows of consistency",
            "no droop inverter to estimate",
            code="nothing-to-design",
        )
    if max_attacked < 1:
        raise DesignInfeasible(
            "windows of consistency",
            "with no manipulated meter assumed, nothing is isolated",
            code="nothing-to-design",
        )
    wrong = [Problem("out-of-range", "a window has at least one reading")] if length < 1 else []
    raise_if_any((*wrong, *no_choice("rule", get_args(Rule), rule)))
    return WindowedDesign(exact_bank.design(plant, max_attacked=max_attacked, step_s=step_s), length, rule)


def init(design: WindowedDesign, t: float) -> WindowedState:
    """Initial state at Unix time t, s; the observers start with the first frame."""
    return WindowedState(exact_bank.init(design.chain, t), *_empty(design), None)


def _empty(design: WindowedDesign) -> tuple[Floats, Floats]:
    return np.zeros(0), np.zeros((0, design.chain.bank.sets.count_large))


def step(
    design: WindowedDesign, state: WindowedState, frame: Frame
) -> tuple[WindowedState, Estimate, Verdict]:
    """Process one frame; see `gridsec.interface`.

    Returns WindowedState, Estimate, Verdict: as every estimator's step. The result of a window holds until
        the next one is full.
    """
    before = state.chain
    if state.said is not None:
        # No estimate uses a meter named by a window.
        tally = replace(before.tally, named=before.tally.named | state.said.suspects)
        before = replace(before, tally=tally)
    chain, estimate, verdict = exact_bank.step(design.chain, before, frame)
    off = (
        np.where(frame.seen & np.isfinite(frame.y), frame.y, np.nan) - estimate.v2[design.chain.plant.meters]
    )
    if chain is before:
        held = np.zeros_like(verdict.suspects) if state.said is None else state.said.suspects
        return state, estimate, replace(verdict, suspects=held, attack=np.where(held, verdict.attack, 0.0))
    now, now_sets = consistency(design.chain, chain.bank, chain.bound)
    pi, pi_sets, said = np.append(state.pi, now), np.vstack([state.pi_sets, now_sets]), state.said
    if pi.size == design.length:
        said = _judge(design, pi, pi_sets)
        pi, pi_sets = _empty(design)
    if said is not None:
        estimate = replace(estimate, trusted=estimate.trusted & ~said.suspects)
    return WindowedState(chain, pi, pi_sets, said), estimate, _combine(design, verdict, said, off)


def consistency(
    design: MonitorDesign, bank: banks.BankState | None, bound: ErrorBound
) -> tuple[float, Floats]:
    """Measures of disagreement, pi and pi_J, over their thresholds.

    Returns pi, pi_J scalar, (s,): values above 1 are evidence. NaN while 2M or fewer meters are available.
    Source: yang2019 (8), (17), each entry over the sum of both observers' levels.
    """
    sets, count = design.bank.sets, design.bank.sets.count_large
    if not isinstance(bank, SlotState) or bank.plan is None or design.bank.layout is None:
        return np.nan, np.full(count, np.nan)
    lay, plan, m = design.bank.layout, bank.plan, bound.free.size
    x = []
    for block, slots in ((plan.large, bank.large), (plan.small, bank.small)):
        whole = np.tile(bank.driven, (slots.shape[1], 1))
        np.put_along_axis(whole, block.units.T, slots.T, axis=1)
        x.append(whole[:, :m])
    holds = design.bank.masks[:, lay.driver] & lay.metered & bank.seen[lay.driver]
    rounding = design.options.tie * design.plant.droop.limit
    level = np.where(holds, bound.driven, bound.free) + rounding
    every = np.where(lay.metered & bank.seen[lay.driver], bound.driven, bound.free) + rounding
    pi = np.max(np.abs(x[0] - bank.driven[:m]) / (level[:count] + every), initial=0.0)
    gaps = np.stack(
        [
            np.max(np.abs(x[1] - x[0][parent]) / (level[count:] + level[parent]), axis=1, initial=0.0)
            for parent in sets.parent
        ]
    )
    return float(pi), np.asarray(gaps.ravel()[sets.pairs].max(axis=1))


def _judge(design: WindowedDesign, pi: Floats, pi_sets: Floats) -> WindowResult:
    """Both algorithms on one full window."""
    bank = design.chain.bank
    masks = bank.masks[: bank.sets.count_large]
    detected = bool(detection(np.nan_to_num(pi), 1.0, design.length)[0])
    found = isolation(pi_sets, np.ones(len(masks)), masks, design.length, design.rule)
    return WindowResult(
        bool(np.isfinite(pi).all()), detected, bool(found.decided[0]), np.asarray(found.suspects[0])
    )


def _answer(
    verdict: Verdict, said: WindowResult | None, names: tuple[str, ...]
) -> tuple[Decision, Cause, str]:
    """Answer of the windows, where that of the residuals leaves one; earlier entries override later ones."""
    undecided, open_ = Decision.UNDECIDED, verdict.decision is Decision.UNDECIDED
    first = verdict.cause in {Cause.DESIGN_INVALID, Cause.TOO_FEW_METERS, Cause.NO_BUSBAR}
    known = WindowResult(True, False, True, np.zeros(len(names), dtype=np.bool_)) if said is None else said
    named = ", ".join(name for name, bad in zip(names, known.suspects, strict=True) if bad)
    answers = (
        (first or (said is None and open_), undecided, verdict.cause, verdict.reason),
        (said is None, undecided, Cause.SETTLING, "The first window of readings is not full yet."),
        (
            bool(named),
            Decision.ATTACKED,
            Cause.RESIDUALS,
            f"Manipulated: {named}; no set of meters that holds them agreed over a window of readings.",
        ),
        (
            not known.judged,
            undecided,
            Cause.TOO_FEW_METERS,
            "Too few meters reported during a part of the last window of readings.",
        ),
        (
            not known.decided,
            undecided,
            Cause.TOO_MANY_SUSPECTS,
            "No set of meters agreed over a window of readings: more are manipulated than assumed.",
        ),
        (
            verdict.decision is Decision.ATTACKED,
            undecided,
            Cause.AMBIGUOUS,
            f"{verdict.reason} No window of readings confirms it, and only windows name meters.",
        ),
        (open_, undecided, verdict.cause, verdict.reason),
        (
            known.detected,
            undecided,
            Cause.AMBIGUOUS,
            "The readings of a window contradict each other, and every set of meters agrees with itself.",
        ),
    )
    for holds, decision, cause, reason in answers:
        if holds:
            return decision, cause, reason
    return Decision.CLEAN, Cause.AGREEMENT, "All meters agree over a window of readings."


def _combine(design: WindowedDesign, verdict: Verdict, said: WindowResult | None, off: Floats) -> Verdict:
    """Verdict of the windows; `off` is the signed distance of each reading from the reconstruction."""
    decision, cause, reason = _answer(verdict, said, design.chain.plant.meter_names)
    suspects = np.zeros_like(verdict.suspects) if said is None else said.suspects
    attack = np.where(suspects, np.nan_to_num(off), 0.0)
    return replace(verdict, decision=decision, cause=cause, reason=reason, suspects=suspects, attack=attack)
