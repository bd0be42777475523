"""Whether a named meter's readings are of another time: its clock is behind, or ahead.

Two things may be late: the voltage alone, played with some delay, or all of what a meter says where it is
its clock that is off. In the second case the reconstruction of time t rests on a power of time t - lag as
well. Its part in the meter's own voltage, ``own = 2 R_jj p_j + 2 X_jj q_j`` to first order, belongs to the
reading, so that

    y(t)          = v2(t - lag)                   the voltage alone,
    y(t) - own(t) = v2(t - lag) - own(t - lag)    the whole meter.

References
----------
docs/theory-sequential.md, "What a manipulation looks like".
"""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Floats

WINDOWS = (32, 128, 512)
"""So many of the last readings are looked for at other times, one of these numbers at each look."""

# Readings follow each other slowly: so many count as one. And surprise asked for beyond the number of lags.
_ALIKE, _SURE = 4.0, 5.0
# A reading belongs to the tick that it is nearest to.
_BETWEEN = 0.5


def shifted(y: Floats, model: Floats, own: Floats, heard: int, room: float, most: float) -> int:  # noqa: PLR0917
    """Lag in ticks at which readings agree with the reconstruction, far better than in any other way.

    At each lag the mean square of ``y(t) - v2(t - lag)`` about a level within what a meter's fixed error
    allows is compared with the least that can be had without one: about *any* level and slope up to half a
    tick behind or ahead, ``v2(t) + theta (v2(t - 1) - v2(t))`` with ``0 <= theta <= 1/2``, and about a
    constant reading. n readings that follow each other slowly count as n / 4. The lag is believed if what is
    left there is no more than an honest meter leaves, and

        (n / 8) log(least without a lag / left at lag) > log(lags) + 5

    Parameters
    ----------
    y, model, own : (n,)
        Readings, NaN where there is none; what the others say; and what the meter's own reported powers
        contribute to that; squared pu, up to now.
    heard
        How many of the last are looked for, < n.
    room
        Largest difference of the levels that a fixed error explains, squared pu.
    most
        Largest mean square that an honest meter leaves, squared pu^2.

    Returns
    -------
    int
        Negative where readings are ahead of their time; 0 for none.
    """
    if np.isnan(y[-heard:]).mean() > 1.0 / _ALIKE:
        return 0
    y = _filled(y)
    ways = ((y, model), (y - own, model - own))
    left, lag, lags = np.inf, 0, 0
    for says, other in ways:
        for sign, new, old in ((1, says, other), (-1, other, says)):
            each = _lags(new[-heard:], old, room)[1:]
            best = int(each.argmin())
            lags += each.size
            if each[best] < left:
                left, lag = float(each[best]), sign * (best + 1)
    if left > most:
        return 0
    # Readings that are early are the older ones: the same have to be explained by the other ways.
    stop = y.size + min(lag, 0)
    least = min(
        float(y[stop - heard : stop].var()),
        *(_in_time(says[stop - heard : stop], other[stop - heard : stop]) for says, other in ways),
    )
    tiny = np.finfo(np.float64).tiny
    surprise = 0.5 * heard / _ALIKE * np.log(max(least, tiny) / max(left, tiny))
    return lag if surprise > np.log(lags) + _SURE else 0


def _in_time(y: Floats, model: Floats) -> float:
    """Least mean square of readings in their own tick, about any level and slope."""
    lie, later = y - model, np.diff(model)
    lies = _straightened(lie)
    best = float(lies @ lies) / lies.size
    # Late towards the tick before, which the oldest does not have; early towards the one after.
    for part, way in ((lie[1:], -later), (lie[:-1], later)):
        rest, towards = _straightened(part), _straightened(way)
        size = max(float(towards @ towards), np.finfo(np.float64).tiny)
        rest = rest - np.clip(float(towards @ rest) / size, 0.0, _BETWEEN) * towards
        best = min(best, float(rest @ rest) / rest.size)
    return best


def _straightened(x: Floats) -> Floats:
    """Less its level and slope."""
    at = np.arange(x.size) - 0.5 * (x.size - 1)
    return np.asarray(x - x.mean() - at * (at @ x) / (at @ at))


def _lags(short: Floats, long: Floats, room: float) -> Floats:
    """Mean square of the difference of `short` and each stretch of `long`, the newest first."""
    n = short.size
    level = long.mean()
    short, long = short - level, long - level
    sums = np.cumsum(np.concatenate([[0.0], long]))
    squares = np.cumsum(np.concatenate([[0.0], long**2]))
    mean = short.mean() - (sums[n:] - sums[:-n]) / n
    whole = (short @ short + squares[n:] - squares[:-n] - 2.0 * np.correlate(long, short, "valid")) / n
    # About the level that is nearest to the mean and within the room.
    return np.asarray(whole - mean**2 + np.maximum(np.abs(mean) - room, 0.0) ** 2)[::-1]


def _filled(y: Floats) -> Floats:
    """Missing readings repeat the one before; those at the beginning the first one."""
    there = np.isfinite(y)
    last = np.maximum.accumulate(np.where(there, np.arange(y.size), 0))
    return np.where(there[last], y[last], y[there.argmax()])
