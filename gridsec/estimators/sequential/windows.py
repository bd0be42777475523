"""Running means over several time scales: the longer, the smaller a lie that stands out.

References
----------
docs/theory-sequential.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The last ticks. p meters, s scales.

    Attributes
    ----------
    residuals : (longest,) of (p,)
        Residuals of each tick, the newest last; 0 where there was none.
    heard : (longest,) of (p,)
        Where there was one.
    turn
        Ticks since the sums were last added up from the beginning.
    sums : (s, p)
        Sum of the residuals within each scale.
    counts : (s, p)
        How many they are.
    """

    residuals: tuple[Floats, ...]
    heard: tuple[Bools, ...]
    turn: int
    sums: Floats
    counts: Ints


def empty(lengths: tuple[int, ...], meters: int) -> Window:
    """A window before the first tick.

    Parameters
    ----------
    lengths : (s,)
        Ticks of each scale.
    meters
        p.
    """
    longest = max(lengths)
    return Window(
        residuals=(np.zeros(meters),) * longest,
        heard=(np.zeros(meters, dtype=np.bool_),) * longest,
        turn=0,
        sums=np.zeros((len(lengths), meters)),
        counts=np.zeros((len(lengths), meters), dtype=np.intp),
    )


def push(window: Window, lengths: tuple[int, ...], residual: Floats, heard: Bools) -> Window:
    """Take in the residuals of one tick.

    Parameters
    ----------
    window
        So far; not changed.
    lengths : (s,)
        Ticks of each scale.
    residual : (p,)
        Readings minus what the model explains, squared pu.
    heard : (p,)
        Where there is a reading.
    """
    before, marks, turn = window.residuals, window.heard, window.turn + 1
    # In calm the same array comes at every tick: what it was is what drops out.
    steady = all(marks[-length] is heard for length in lengths)
    values = residual if all_of(heard) else np.where(heard, residual, 0.0)
    after = (*before[1:], values)
    if turn == len(after):
        # Differences of running sums gather rounding errors; one round's worth is all there ever is.
        sums, turn = np.stack([np.sum(after[-length:], axis=0) for length in lengths]), 0
    else:
        sums = window.sums + values - np.array([before[-length] for length in lengths])
    counts = window.counts
    if not steady:
        counts = counts + heard - np.array([marks[-length] for length in lengths])
    return Window(after, (*marks[1:], heard), turn, sums, counts)


def forget(window: Window, meters: Bools) -> Window:
    """Forget everything about some meters.

    Parameters
    ----------
    window
        So far; not changed.
    meters : (p,)
        Which.
    """
    if not any_of(meters):
        return window
    residuals = tuple(np.where(meters, 0.0, each) for each in window.residuals)
    marks = tuple(each & ~meters for each in window.heard)
    sums = np.where(meters, 0.0, window.sums)
    counts = np.where(meters, 0, window.counts)
    return Window(residuals, marks, window.turn, sums, counts)


def shift(window: Window, change: Floats) -> Window:
    """Express all residuals relative to something else.

    Parameters
    ----------
    window
        So far; not changed.
    change : (p,)
        What every residual gains, squared pu.
    """
    pairs = zip(window.residuals, window.heard, strict=True)
    residuals = tuple(np.where(heard, each + change, 0.0) for each, heard in pairs)
    return Window(residuals, window.heard, window.turn, window.sums + window.counts * change, window.counts)
