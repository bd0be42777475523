"""Running means of the residuals over several time scales (docs/theory-sequential.md, section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Residuals of the last ticks. p meters, s scales."""

    residuals: tuple[Floats, ...]  # (longest,) of (p,), the newest last; 0 without a reading
    available: tuple[Bools, ...]  # (longest,) of (p,): meters with a reading
    since_resum: int  # ticks since the sums were computed from the residuals
    sums: Floats  # (s, p) sum of the residuals of each scale
    counts: Ints  # (s, p) number of these residuals


def empty(lengths: tuple[int, ...], meters: int) -> Window:
    """Window before the first tick; lengths: ticks of each scale."""
    longest = max(lengths)
    return Window(
        residuals=(np.zeros(meters),) * longest,
        available=(np.zeros(meters, dtype=np.bool_),) * longest,
        since_resum=0,
        sums=np.zeros((len(lengths), meters)),
        counts=np.zeros((len(lengths), meters), dtype=np.intp),
    )


def push(window: Window, lengths: tuple[int, ...], residual: Floats, available: Bools) -> Window:
    """Window with the residuals (p,) of one more tick, squared pu, and the meters with a reading, (p,)."""
    before, marks, turn = window.residuals, window.available, window.since_resum + 1
    # While every meter reports, the same array enters and leaves.
    steady = all(marks[-length] is available for length in lengths)
    values = residual if all_of(available) else np.where(available, residual, 0.0)
    after = (*before[1:], values)
    if turn == len(after):
        # Differences of running sums gather rounding errors; a new sum every `longest` ticks bounds them.
        sums, turn = np.stack([np.sum(after[-length:], axis=0) for length in lengths]), 0
    else:
        sums = window.sums + values - np.array([before[-length] for length in lengths])
    counts = window.counts
    if not steady:
        counts = counts + available - np.array([marks[-length] for length in lengths])
    return Window(after, (*marks[1:], available), turn, sums, counts)


def forget(window: Window, meters: Bools) -> Window:
    """Window without the residuals of some meters, (p,)."""
    if not any_of(meters):
        return window
    residuals = tuple(np.where(meters, 0.0, each) for each in window.residuals)
    marks = tuple(each & ~meters for each in window.available)
    sums = np.where(meters, 0.0, window.sums)
    counts = np.where(meters, 0, window.counts)
    return Window(residuals, marks, window.since_resum, sums, counts)


def shift(window: Window, change: Floats) -> Window:
    """Window with all residuals increased by `change` (p,), squared pu."""
    pairs = zip(window.residuals, window.available, strict=True)
    residuals = tuple(np.where(available, each + change, 0.0) for each, available in pairs)
    return Window(
        residuals, window.available, window.since_resum, window.sums + window.counts * change, window.counts
    )
