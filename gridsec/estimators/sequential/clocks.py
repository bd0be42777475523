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

from gridsec.arrays import Floats, all_of

WINDOWS = (32, 128, 512)
"""So many of the last readings are looked for at other times, one of these numbers at each look."""

# Readings follow each other slowly: so many count as one. And surprise asked for beyond the number of lags.
_ALIKE, _SURE = 4.0, 5.0
# A reading belongs to the tick that it is nearest to.
_BETWEEN = 0.5
_TINY = float(np.finfo(np.float64).tiny)


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
    if _ALIKE * np.count_nonzero(np.isnan(y[-heard:])) > heard:
        return 0
    y = _filled(y)
    left, lag, lags = np.inf, 0, 4 * (y.size - heard)
    for says, other in ((y, model), (y - own, model - own)):
        for sign, new, old in ((1, says, other), (-1, other, says)):
            each = _lags(new[-heard:], old, room, most)
            ago = int(each.argmin())
            if each[ago] < left:
                left, lag = float(each[ago]), sign * (ago + 1)
    if left > most:
        return 0
    # Readings that are early are the older ones: the same have to be explained by the other ways.
    same = slice(y.size + min(lag, 0) - heard, y.size + min(lag, 0))
    lie, models = y[same] - model[same], np.array([model[same], model[same] - own[same]])
    most_left = max(left, _TINY) * np.exp(2.0 * _ALIKE / heard * (np.log(lags) + _SURE))
    # What takes longest comes last.
    if not min(float(y[same].var()), float(lie.var())) > most_left:
        return 0
    return lag if _in_time(lie, np.diff(models)) > most_left else 0


def _in_time(lie: Floats, later: Floats) -> float:
    """Least mean square of readings in their own tick, about any level and slope.

    `later` is how some models change from tick to tick, (k, n - 1).
    """
    lies, ways = _straightened(lie), _straightened(later)
    best = float(lies @ lies) / lies.size
    size = np.maximum(np.einsum("ij,ij->i", ways, ways), _TINY)[:, None]
    # Late towards the tick before, which the oldest does not have; early towards the one after.
    for part, sign in ((lie[1:], -1.0), (lie[:-1], 1.0)):
        rest = _straightened(part)
        amount = np.clip(sign * (ways @ rest)[:, None] / size, 0.0, _BETWEEN)
        left = rest - sign * amount * ways
        best = min(best, float(np.einsum("ij,ij->i", left, left).min()) / rest.size)
    return best


def _straightened(x: Floats) -> Floats:
    """Less its level and slope; (…, n)."""
    at = np.arange(x.shape[-1]) - 0.5 * (x.shape[-1] - 1)
    level, slope = x.mean(axis=-1, keepdims=True), x @ at / (at @ at)
    return np.asarray(x - level - np.multiply.outer(slope, at))


def _lags(short: Floats, long: Floats, room: float, most: float = np.inf) -> Floats:
    """Mean square of the difference of `short` and each earlier stretch of `long`, by lag from 1.

    Infinite for all where that is more than `most` by the levels alone.
    """
    n, level = short.size, float(long.mean())
    short, long = short - level, long - level
    # The last stretch is that of no lag.
    mean = float(short.mean()) - _sums(long, n) / n
    # About the level that is nearest to the mean and within the room.
    beyond = np.maximum(np.abs(mean) - room, 0.0)
    if beyond.min() ** 2 > most:
        return np.full(mean.size, np.inf)
    whole = _sums(long * long, n) - 2.0 * np.correlate(long, short, "valid")[:-1]
    whole += float(short @ short)
    whole /= n
    whole += beyond * beyond - mean * mean
    return whole[::-1]


def _sums(x: Floats, n: int) -> Floats:
    """Sum of each n values that follow each other, but for the last n."""
    sums = np.cumsum(x)
    out = sums[n - 1 : -1].copy()
    out[1:] -= sums[: -n - 1]
    return out


def _filled(y: Floats) -> Floats:
    """Missing readings repeat the one before; those at the beginning the first one."""
    there = np.isfinite(y)
    if all_of(there):
        return y
    last = np.maximum.accumulate(np.where(there, np.arange(y.size), 0))
    return np.where(there[last], y[last], y[there.argmax()])
