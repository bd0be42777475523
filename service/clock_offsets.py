"""Clock offsets of the sources of one feeder, from the delays between time stamps and arrivals.

A reading with the stamp t that arrives at the wall time a has the delay ``a - t``: the way of the reading
plus the error of the clock. The median delay of a source, less that of all sources, is the negative offset of
its clock if the ways are alike. A longer way looks like a clock that is behind.

Readings of one source that arrive at one instant count once, with the newest stamp: a concentrator sends a
backlog at once, and its age is not an offset.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from statistics import median
from typing import Final

KEPT: Final = 64
"""Arrivals of a source that count, the newest."""
FEWEST: Final = 16
"""Arrivals of a source below which its offset is not measurable."""
SOURCES: Final = 3
"""Sources with enough arrivals below which the delay of the fleet is not known."""
LEAST_S: Final = 0.5
"""Smallest reported offset, s."""
LEAST_TICKS: Final = 0.1
"""Smallest reported offset, as a part of a tick: readings up to this much after a tick belong to it."""
SURE: Final = 4.0
"""Smallest reported offset in standard errors of the median of a source's delays."""
KEEPS: Final = 0.5
"""Part of the limits above which a reported offset stays reported."""
_NORMAL, _MEDIAN = 1.4826, 1.2533
"""Standard deviation over median absolute deviation, and standard error of a median over that of a mean."""


class ClockOffsets:
    """Delays of the sources of one feeder.

    Parameters
    ----------
    sources
        Meters, and None for the busbar's meter.
    tick_s
        Interval of the ticks, s.
    silence_s
        Time without an arrival after which the delays of a source are forgotten, s. The service's clock may
        be set meanwhile: delays of sources that no longer report would shift the median of all.
    """

    def __init__(self, sources: Iterable[str | None], tick_s: float, silence_s: float) -> None:
        self._delays: dict[str | None, deque[float]] = {source: deque(maxlen=KEPT) for source in sources}
        self._arrived: dict[str | None, float] = {}
        self._least = max(LEAST_S, LEAST_TICKS * tick_s)
        self._silence = silence_s
        self._reported: set[str | None] = set()

    def note(self, source: str | None, t: float, arrival: float) -> None:
        """Take in the delay of one reading.

        Parameters
        ----------
        source
            The meter, or None.
        t, arrival
            Time stamp and wall time of its arrival, Unix s.
        """
        delays = self._delays[source]
        if self._arrived.get(source) == arrival:
            delays[-1] = min(delays[-1], arrival - t)
            return
        self._arrived[source] = arrival
        delays.append(arrival - t)

    def forget(self) -> None:
        """Forget everything: the wall clock was set."""
        for delays in self._delays.values():
            delays.clear()
        self._arrived.clear()
        self._reported.clear()

    def measured(self, now: float) -> Mapping[str | None, float]:
        """Return the measurable offsets, s; positive where a clock is ahead.

        Parameters
        ----------
        now
            Wall time, Unix s. Delays of silent sources are forgotten.
        """
        for source in [each for each, last in self._arrived.items() if now - last > self._silence]:
            del self._arrived[source]
            self._delays[source].clear()
        middle = {source: median(delays) for source, delays in self._delays.items() if len(delays) >= FEWEST}
        if len(middle) < SOURCES:
            self._reported.clear()
            return {}
        fleet = median(middle.values())
        least = KEEPS * self._least
        found = {
            source: fleet - one
            for source, one in middle.items()
            # No limit is smaller than the first.
            if abs(fleet - one) >= least and abs(fleet - one) >= self._limit(source, one)
        }
        self._reported = set(found)
        return found

    def _limit(self, source: str | None, middle: float) -> float:
        """Smallest offset of a source that is reported, s."""
        delays = self._delays[source]
        spread = _NORMAL * median(abs(delay - middle) for delay in delays)
        limit = max(self._least, SURE * _MEDIAN * spread / math.sqrt(len(delays)))
        return KEEPS * limit if source in self._reported else limit
