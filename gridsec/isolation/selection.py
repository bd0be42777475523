"""Which observer of a bank is believed, and how far the truth may be from what it says.

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
    """Disagreement pi of every large observer, (5) and (22); infinite where no member is left to confirm it.

    Parameters
    ----------
    design
        The bank.
    state
        Where its observers stand.

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
    """The largest difference of an entry from that of its company, in parts of the sum of both bounds.

    Parameters
    ----------
    design
        The bank.
    state
        Where its observers stand.

    Returns
    -------
    Floats
        (a,); infinite where no member is left to confirm it. A finite value above 1 proves that the
        observer or one of its company is deceived.
    """
    gap = _gap(design, state)
    allowed = state.box[design.large][:, None, :] + state.box[design.company]
    # Equal estimates agree even where both are known exactly.
    pi = np.where(gap > 0.0, gap / np.maximum(allowed, np.finfo(np.float64).tiny), 0.0).max(axis=(1, 2))
    return np.where(_dead(design, state), np.inf, pi)


def _gap(design: IsolationDesign, state: UnknownInputState) -> Floats:
    """Differences of every large observer's estimate from those of its company, (a, b, n)."""
    return np.asarray(np.abs(state.x[design.large][:, None, :] - state.x[design.company]))


def _dead(design: IsolationDesign, state: UnknownInputState) -> Bools:
    """Large observers that nothing can confirm, (a,)."""
    dead = design.alone | ~state.live[design.large] | ~state.live[design.company].all(axis=1)
    return np.asarray(dead)


def bounds(design: IsolationDesign, state: UnknownInputState) -> Floats:
    """Bounds of the errors of all large observers, whoever lies.

    Some small observer S within J is free of attacks, by Lemmas 1 to 3, so
    `|e_J,i| <= max_S (|x_hat_J,i - x_hat_S,i| + box_S,i)`, for every J: those that trust a liar are told by
    their company. Nor is an error above what the plant's span leaves possible.

    Parameters
    ----------
    design
        The bank.
    state
        Where its observers stand.

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

    The truth is within the bounds of every large observer, so in the intersection of all these intervals.

    Parameters
    ----------
    design
        The bank.
    state
        Where its observers stand.
    index
        Place among the large observers.

    Returns
    -------
    x, bound : (n,)
    torn
        Whether intervals do not intersect: then more is attacked than assumed, and the bound is infinite
        where they do not.
    """
    x, wide = state.x[design.large], bounds(design, state)
    low, high = np.max(x - wide, axis=0), np.min(x + wide, axis=0)
    bound = np.maximum(high - x[index], x[index] - low)
    return x[index], np.where(low <= high, bound, np.inf), bool(np.any(low > high))


def select(design: IsolationDesign, state: UnknownInputState, pi: Floats) -> int:
    """Which large observer is believed, its place among them: (6), (23), or the one that is certified best.

    Parameters
    ----------
    design
        The bank.
    state
        Where its observers stand.
    pi : (a,)
        Their disagreement.
    """
    if design.measure == "distance":
        return int(np.argmin(pi))
    wide = bounds(design, state)
    best = wide.min(axis=0)
    known = np.isfinite(best)
    return int(np.argmin((wide[:, known] / best[known]).max(axis=1, initial=0.0)))
