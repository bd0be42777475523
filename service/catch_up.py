"""Ticks that are due: which of them are judged in one round, and which are skipped.

A tick is stale when a later tick of the same feeder is due as well. Stale ticks are judged oldest first, in a
limited time. By the wall clock the others are skipped: an old tick is worth less than the next one. Where
the readings tell the time, nothing is stale, and the others wait for the next round.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

import structlog

from service.watch import Watch

BUDGET_S = 1.0
"""Time for stale ticks, from the first one until all feeders are up to date again, s."""

CALM_S = 60.0
"""Time without a skipped tick after which the next one is logged again, s."""

SHOWN = 5
"""Feeders named in one line of the log."""

_log = structlog.get_logger("gridsec.runtime")


class CatchUp:
    """Time budget for stale ticks, and the log of those that were skipped.

    Parameters
    ----------
    clock
        Monotonic time, s.
    waits
        Whether ticks beyond the budget wait (`Clock.EVENTS`) instead of being skipped.
    """

    def __init__(self, clock: Callable[[], float], *, waits: bool) -> None:
        self._clock, self._waits = clock, waits
        self._left_s = BUDGET_S
        self._skipped: Counter[str] = Counter()
        self._calm_at: float | None = None

    def judge(
        self, watches: Iterable[Watch], judge: Callable[[Watch], None], go_on: Callable[[], bool]
    ) -> None:
        """Judge what is pending.

        Parameters
        ----------
        watches
            The feeders.
        judge
            Judges the oldest pending tick of a feeder.
        go_on
            Asked before each tick; where it answers False, what is left stays pending.
        """
        due = [watch for watch in watches if watch.pending]
        stale = [watch for watch in due if len(watch.pending) > 1]
        if self._waits or not stale:
            self._left_s = BUDGET_S
        begun = self._clock()
        end = begun + self._left_s
        while stale and go_on() and self._clock() < end:
            first = min(stale, key=lambda watch: watch.pending[0].t)
            judge(first)
            if len(first.pending) < 2:
                stale.remove(first)
        self._left_s -= self._clock() - begun
        if stale and self._waits:
            return
        for watch in stale if go_on() else ():
            watch.skip(len(watch.pending) - 1)
        for watch in due:
            if watch.pending and go_on():
                judge(watch)

    def skipped(self, feeder: str, count: int) -> None:
        """Log the first skipped ticks, and their number once there have been none for `CALM_S`.

        Parameters
        ----------
        feeder, count
            Its name, and the number of ticks.
        """
        if self._calm_at is None:
            _log.warning("ticks are skipped: the service was behind by more than it can judge", feeder=feeder)
        self._skipped[feeder] += count
        self._calm_at = self._clock() + CALM_S

    def calm(self) -> None:
        """Log the end of an episode, if it is over."""
        if self._calm_at is None or self._clock() < self._calm_at:
            return
        names = [name for name, _ in self._skipped.most_common(SHOWN)]
        total, feeders = self._skipped.total(), len(self._skipped)
        _log.warning("ticks were skipped", ticks=total, feeders=feeders, most=names, calm_s=CALM_S)
        self._calm_at = None
        self._skipped.clear()
