"""The bank online: one step at a time, a verdict at the end of every window.

References
----------
yang2019, Algorithms 1 and 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.observers.circle_discrete import advance
from gridsec.online import Decision
from gridsec.windows.design import WindowDesign, consistency
from gridsec.windows.rules import exceeds, isolation

# Value for observers that are never judged again, since their error after a gap has no bound.
_NEVER = np.iinfo(np.intp).max


@dataclass(frozen=True, slots=True, eq=False)
class WindowState:
    """State of the bank within its window.

    Attributes
    ----------
    t
        Time, s.
    x : (o, n)
        All estimates.
    k
        Steps since the start.
    stale : (o,)
        Steps until each observer has settled.
    pi : (i,)
        pi of the window's steps so far; NaN where not judged.
    pi_sets : (i, s)
        Likewise pi_J.
    """

    t: float
    x: Floats
    k: int
    stale: Ints
    pi: Floats
    pi_sets: Floats


@dataclass(frozen=True, slots=True, eq=False)
class WindowVerdict:
    """Result of one window.

    Attributes
    ----------
    t
        Time of its last step, s.
    detection
        Algorithm 1: CLEAN, ATTACKED, or UNDECIDED if a step was not judged and none exceeded.
    isolation
        Algorithm 2: ATTACKED, CLEAN if no meter is suspect and every set was judged at every step, or
        UNDECIDED.
    suspects : (p,)
        Meters named by Algorithm 2.
    score, threshold : (1 + s,)
        Largest pi and pi_J of the window beside their thresholds.
    """

    t: float
    detection: Decision
    isolation: Decision
    suspects: Bools
    score: Floats
    threshold: Floats


def init(design: WindowDesign, t: float, x: Floats) -> WindowState:
    """Initial state of the bank at t, s; every observer starts at x (n,)."""
    count = len(design.observers.masks)
    start = np.repeat(np.asarray(x, dtype=np.float64)[None, :], count, axis=0)
    stale = np.full(count, design.settling, dtype=np.intp)
    return WindowState(float(t), start, 0, stale, np.zeros(0), np.zeros((0, design.sets.count_large)))


def step(
    design: WindowDesign, state: WindowState, y: Floats, u: Floats, seen: Bools
) -> tuple[WindowState, WindowVerdict | None]:
    """Judge the estimates of this step, then advance them with its readings.

    Parameters
    ----------
    y : (p,)
        Readings; ignored where unseen or not finite.
    u : (l,)
        Known input.
    seen : (p,)
        True for existing readings. An observer with an unavailable meter continues without it and is not
        judged until k* steps after the meter is back, provided that its error is then within `start` of
        `design`. Without such a bound (`start` = 0) it is not judged again at all.

    Returns
    -------
    state, verdict
        A verdict at the last step of every window, otherwise None.
    """
    here = np.asarray(seen, dtype=np.bool_) & np.isfinite(y)
    pi, pi_sets = state.pi, state.pi_sets
    if state.k >= design.settling:
        now, now_sets = _judged(design, state)
        pi, pi_sets = np.append(pi, now), np.vstack([pi_sets, now_sets])
    silent = (design.observers.masks & ~here).any(axis=1)
    # Steps until the next estimate is judged.
    stale = np.maximum(state.stale - (state.stale < _NEVER), 0)
    stale = np.where(silent, design.settling if design.settling else _NEVER, stale)
    x = advance(design.observers, state.x, y, u, here)
    after = replace(
        state,
        t=state.t + design.observers.system.h,
        x=x,
        k=state.k + 1,
        stale=stale,
        pi=pi,
        pi_sets=pi_sets,
    )
    if len(pi) < design.length:
        return after, None
    verdict = _verdict(design, state.t, pi, pi_sets)
    return replace(after, pi=np.zeros(0), pi_sets=np.zeros((0, design.sets.count_large))), verdict


def _judged(design: WindowDesign, state: WindowState) -> tuple[float, Floats]:
    """Both measures of the present estimates; NaN if an observer involved has not settled."""
    pi, pi_sets = consistency(design, state.x)
    sets, settled = design.sets, state.stale == 0
    large, small = settled[1 : 1 + sets.count_large], settled[1 + sets.count_large :]
    within = np.broadcast_to(small, sets.parent.shape).ravel()[sets.pairs].all(axis=1)
    whole = bool(settled[0] and large.all())
    return (float(pi) if whole else np.nan), np.where(large & within, pi_sets, np.nan)


def _verdict(design: WindowDesign, t: float, pi: Floats, pi_sets: Floats) -> WindowVerdict:
    masks = design.observers.masks[1 : 1 + design.sets.count_large]
    found = isolation(pi_sets, design.isolate_above, masks, design.length, design.rule)
    seen = bool(np.isfinite(pi).all())
    exceeded = bool(exceeds(pi, design.detect_above).any())
    quiet = Decision.CLEAN if seen else Decision.UNDECIDED
    suspects = np.asarray(found.suspects[0])
    # Steps that were not judged clear no meter.
    whole = bool(found.decided[0] and np.isfinite(pi_sets).all())
    cleared = Decision.CLEAN if whole else Decision.UNDECIDED
    largest = np.concatenate([[_top(pi)], [_top(column) for column in pi_sets.T]])
    return WindowVerdict(
        t=t,
        detection=Decision.ATTACKED if exceeded else quiet,
        isolation=Decision.ATTACKED if suspects.any() else cleared,
        suspects=suspects,
        score=largest,
        threshold=np.concatenate([[design.detect_above], design.isolate_above]),
    )


def _top(values: Floats) -> float:
    """Largest finite entry, NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else float("nan")
