"""Selection of a bank's observer, and the error bound of its estimate.

References
----------
yang2021 (5) to (7), (22) to (24); docs/theory-unknown-input.md.
"""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.isolation.design import IsolationDesign
from gridsec.observers.unknown_input import UnknownInputState


def disagreement(design: IsolationDesign, state: UnknownInputState) -> Floats:
    """Disagreement pi of every large observer, (5) and (22); infinite without a member to confirm it.

    Returns
    -------
    Floats
        (a,).
    """
    if design.measure == "bounds":
        return contradiction(design, state)
    pi = np.linalg.norm(_gap(design, state), axis=2).max(axis=1)
    return np.where(_dead(design, state), np.inf, pi)


def contradiction(design: IsolationDesign, state: UnknownInputState) -> Floats:
    """Largest difference of an entry from that of the company, relative to the sum of both bounds.

    Returns
    -------
    Floats
        (a,); infinite without a member to confirm it. A finite value above 1 proves that an attack affects
        the observer or one of its company.
    """
    gap = _gap(design, state)
    allowed = state.box[design.large][:, None, :] + state.box[design.company]
    # Equal estimates agree even if both are known exactly.
    pi = np.where(gap > 0.0, gap / np.maximum(allowed, np.finfo(np.float64).tiny), 0.0).max(axis=(1, 2))
    return np.where(_dead(design, state), np.inf, pi)


def _gap(design: IsolationDesign, state: UnknownInputState) -> Floats:
    """Differences of every large observer's estimate from those of its company, (a, b, n)."""
    return np.asarray(np.abs(state.x[design.large][:, None, :] - state.x[design.company]))


def _dead(design: IsolationDesign, state: UnknownInputState) -> Bools:
    """Mask (a,) of large observers that cannot be confirmed."""
    dead = design.alone | ~state.live[design.large] | ~state.live[design.company].all(axis=1)
    return np.asarray(dead)


def bounds(design: IsolationDesign, state: UnknownInputState) -> Floats:
    """Bounds of the errors of all large observers, under any attack.

    Some small observer S within J is free of attacks, by Lemmas 1 to 3, so
    `|e_J,i| <= max_S (|x_hat_J,i - x_hat_S,i| + box_S,i)`, for every J: the company also bounds observers
    with attacked sensors. The plant's span limits every error.

    Returns
    -------
    Floats
        (a, n).
    """
    x = state.x[design.large]
    gap = np.abs(x[:, None, :] - state.x[design.company]) + state.box[design.company]
    return np.asarray(np.minimum(gap.max(axis=1), np.abs(x) + design.family.plant.span))


def estimate(design: IsolationDesign, state: UnknownInputState, index: int) -> tuple[Floats, Floats, bool]:
    """Estimate (7), (24) of one large observer with a bound of its error.

    The true state is within the bounds of every large observer, so in the intersection of all these
    intervals.

    Parameters
    ----------
    index
        Index among the large observers.

    Returns
    -------
    x, bound : (n,)
    torn
        True if intervals do not intersect: then more is attacked than assumed, and the bound is infinite
        there.
    """
    x, wide = state.x[design.large], bounds(design, state)
    low, high = np.max(x - wide, axis=0), np.min(x + wide, axis=0)
    bound = np.maximum(high - x[index], x[index] - low)
    return x[index], np.where(low <= high, bound, np.inf), bool(np.any(low > high))


def select(design: IsolationDesign, state: UnknownInputState, pi: Floats) -> int:
    """Index of the selected large observer: by (6), (23), or the one with the best certified estimate.

    Parameters
    ----------
    pi : (a,)
        Disagreement of the large observers.
    """
    if design.measure == "distance":
        return int(np.argmin(pi))
    wide = bounds(design, state)
    best = wide.min(axis=0)
    known = np.isfinite(best)
    return int(np.argmin((wide[:, known] / best[known]).max(axis=1, initial=0.0)))
