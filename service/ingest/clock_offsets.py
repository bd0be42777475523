"""Clock offsets of the sources of a feeder, from the delays of their readings.

A reading with the stamp t that arrives at the wall time a has the delay ``a - t``: transmission time plus
clock error. The median delay of a source, less that of all sources, is the negative offset of its clock if
transmission times are equal. A longer transmission time looks like a clock that is behind.

Readings of one source that arrive at one instant count once, with the newest stamp: a concentrator sends a
backlog at once, and its age is not an offset.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np

from gridsec.arrays import Bools, Floats, Ints

KEPT: Final = 64
"""Newest arrivals of a source that its median delay uses."""
FEWEST: Final = 16
"""Smallest number of arrivals of a source for a measurable offset."""
SOURCES: Final = 3
"""Smallest number of sources with measurable delays for the median of all sources."""
LEAST_S: Final = 0.5
"""Smallest reported offset, s."""
LEAST_TICKS: Final = 0.1
"""Smallest reported offset, in ticks: readings up to this much after a tick belong to it."""
SURE: Final = 4.0
"""Smallest reported offset in standard errors of the median of a source's delays."""
KEEPS: Final = 0.5
"""Factor on the limits for an offset that is already reported (hysteresis)."""
_NORMAL, _MEDIAN = 1.4826, 1.2533
"""Standard deviation over median absolute deviation, and standard error of a median over that of a mean."""


class ClockOffsets:
    """Delays of the sources of one feeder.

    sources: meters, and None for the busbar meter.
    tick_s: interval of the ticks, s.
    silence_s: time without an arrival after which the delays of a source are deleted, s. The service's clock
        may be set meanwhile: delays of sources that no longer report would shift the median of all.
    known: sources with enough delays at the latest measurement.
    """

    def __init__(self, sources: Iterable[str | None], tick_s: float, silence_s: float) -> None:
        self._sources = tuple(sources)
        size = len(self._sources)
        self._index = {source: k for k, source in enumerate(self._sources)}
        # Rings of the newest delays: column k holds `count[k]` of them, infinity elsewhere.
        self._delays = np.full((KEPT, size), np.inf)
        self._count = np.zeros(size, dtype=np.intp)
        self._newest = np.full(size, KEPT - 1)
        self._arrived = np.full(size, np.nan)
        self._least = max(LEAST_S, LEAST_TICKS * tick_s)
        self._silence = silence_s
        self._reported = np.zeros(size, dtype=np.bool_)
        self.known: frozenset[str | None] = frozenset()

    def note(self, source: str | None, t: float, arrival: float) -> None:
        """Add the delay of one reading. `source` is the meter, None for the busbar meter; times in Unix s."""
        k = self._index[source]
        self.note_all(np.array([k]), np.array([t]), np.array([arrival]))

    def note_all(self, source: Ints, t: Floats, arrival: Floats) -> None:
        """Add the delays of readings, (n,), grouped by source, those of each in the order of arrival."""
        of, arrived, delay = source, arrival, arrival - t
        again = source[1:] == source[:-1]
        if again.any():
            at = np.flatnonzero(np.concatenate(([True], ~again | (arrival[1:] != arrival[:-1]))))
            of, arrived, delay = source[at], arrival[at], np.minimum.reduceat(delay, at)
        # The first instant of a source may go on with its newest one.
        same = self._arrived[of] == arrived
        if same.any():
            same[1:] &= of[1:] != of[:-1]
            old = of[same]
            newest = self._newest[old]
            self._delays[newest, old] = np.minimum(self._delays[newest, old], delay[same])
            of, arrived, delay = of[~same], arrived[~same], delay[~same]
        if of.size:
            place = (self._newest[of] + 1 + rank(of)) % KEPT
            self._delays[place, of] = delay
            self._newest[of], self._arrived[of] = place, arrived
            self._count += np.bincount(of, minlength=self._count.size)
            np.minimum(self._count, KEPT, out=self._count)

    def forget(self) -> None:
        """Delete all delays: the wall clock was set."""
        self._delete(np.ones(self._count.size, dtype=np.bool_))
        self._reported[:] = False
        self.known = frozenset()

    def _delete(self, which: Bools) -> None:
        self._delays[:, which] = np.inf
        self._count[which] = 0
        self._arrived[which] = np.nan

    def measured(self, now: float) -> Mapping[str | None, float]:
        """Return the measurable offsets, s; positive if the clock is ahead.

        Delays of sources that are silent at `now`, Unix s, are deleted.
        """
        gone = now - self._arrived > self._silence
        if gone.any():
            self._delete(gone)
        enough = np.flatnonzero(self._count >= FEWEST)
        if enough.size < SOURCES:
            self._reported[:] = False
            self.known = frozenset()
            return {}
        self.known = frozenset(self._sources[k] for k in enough)
        middle = _medians(self._delays[:, enough], self._count[enough])
        off = float(np.median(middle)) - middle
        # Half of `least` is the lower bound of all limits and is cheaper.
        maybe = np.flatnonzero(np.abs(off) >= KEEPS * self._least)
        found = {
            int(enough[k]): float(off[k])
            for k in maybe
            if abs(off[k]) >= self._limit(int(enough[k]), float(middle[k]))
        }
        self._reported[:] = False
        self._reported[list(found)] = True
        return {self._sources[k]: offset for k, offset in found.items()}

    def _limit(self, source: int, middle: float) -> float:
        """Smallest reported offset of a source, s."""
        delays = self._delays[:, source]
        delays = delays[np.isfinite(delays)]
        spread = _NORMAL * float(np.median(np.abs(delays - middle)))
        limit = max(self._least, SURE * _MEDIAN * spread / math.sqrt(delays.size))
        return KEEPS * limit if self._reported[source] else limit


def _medians(columns: Floats, count: Ints) -> Floats:
    """Median of the `count` finite numbers of each column; all others are infinite."""
    low, high, each = (count - 1) // 2, count // 2, np.arange(count.size)
    ordered = np.partition(columns, np.union1d(low, high), axis=0)
    return np.asarray((ordered[low, each] + ordered[high, each]) / 2.0)


def rank(grouped: Ints) -> Ints:
    """Position of each element among the equal ones before it; equal elements are side by side."""
    again = grouped[1:] == grouped[:-1]
    if not again.any():
        return np.zeros(grouped.size, dtype=np.intp)
    each = np.arange(grouped.size)
    begins = np.concatenate(([True], ~again))
    return each - np.maximum.accumulate(np.where(begins, each, 0))
