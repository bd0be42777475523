"""Running means over several time scales: the longer, the smaller a lie that stands out.

References
----------
docs/theory-sequential.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The last ticks. p meters, s scales.

    Attributes
    ----------
    residual : (longest, p)
        Ring buffer of residuals; 0 where there was none.
    heard : (longest, p)
        Where there was one.
    head
        Row of the next tick.
    sums : (s, p)
        Sum of the residuals within each scale.
    counts : (s, p)
        How many they are.
    """

    residual: Floats
    heard: Bools
    head: int
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
        residual=np.zeros((longest, meters)),
        heard=np.zeros((longest, meters), dtype=np.bool_),
        head=0,
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
    values = np.where(heard, residual, 0.0)
    ring, marks, head = window.residual.copy(), window.heard.copy(), window.head
    longest = len(ring)
    leaving = [(head - length) % longest for length in lengths]
    sums = window.sums + values - ring[leaving]
    counts = window.counts + heard - marks[leaving]
    ring[head], marks[head] = values, heard
    head = (head + 1) % longest
    if head == 0:
        # Differences of running sums gather rounding errors; one round's worth is all there ever is.
        sums = np.stack([ring[longest - length :].sum(axis=0) for length in lengths])
    return Window(ring, marks, head, sums, counts)


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
    ring, marks = window.residual.copy(), window.heard.copy()
    ring[:, meters], marks[:, meters] = 0.0, False
    sums = np.where(meters, 0.0, window.sums)
    counts = np.where(meters, 0, window.counts)
    return Window(ring, marks, window.head, sums, counts)


def forget_last(window: Window, lengths: tuple[int, ...], ticks: Ints) -> Window:
    """Forget the last ticks of some meters.

    Parameters
    ----------
    window
        So far; not changed.
    lengths : (s,)
        Ticks of each scale.
    ticks : (p,)
        How many of each meter.
    """
    if not any_of(ticks):
        return window
    age = (window.head - 1 - np.arange(len(window.residual))) % len(window.residual)
    kept = window.heard & (age[:, None] >= ticks)
    ring = np.where(kept, window.residual, 0.0)
    sums = np.stack([ring[age < length].sum(axis=0) for length in lengths])
    counts = np.stack([kept[age < length].sum(axis=0, dtype=np.intp) for length in lengths])
    return Window(ring, kept, window.head, sums, counts)


def shift(window: Window, change: Floats) -> Window:
    """Express all residuals relative to something else.

    Parameters
    ----------
    window
        So far; not changed.
    change : (p,)
        What every residual gains, squared pu.
    """
    ring = np.where(window.heard, window.residual + change, 0.0)
    return Window(ring, window.heard, window.head, window.sums + window.counts * change, window.counts)
