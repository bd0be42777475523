"""Clock shift of a named meter: its readings are of another time.

Either the voltage alone is late, or all data of the meter. In the second case the reconstruction at time t
rests on a power of time t - lag as well. Its part in the meter's own voltage,
``own = 2 R_jj p_j + 2 X_jj q_j`` to first order, belongs to the reading:

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
"""Numbers of last readings compared with other times, one at each look."""

_CORRELATED, _EVIDENCE = 4.0, 5.0
"""Correlated readings that count as one; evidence required beyond the number of lags, nats."""
_WITHIN_TICK = 0.5
"""Largest shift of a reading within its own tick, ticks."""
_TINY = float(np.finfo(np.float64).tiny)


def clock_shift(  # noqa: PLR0917
    y: Floats, model: Floats, own: Floats, count: int, room: float, most: float
) -> int:
    """Lag in ticks at which readings agree with the reconstruction, far better than without one; 0 for none.

    At each lag the mean square of ``y(t) - v2(t - lag)`` about a level within the meter's fixed error is
    compared with the least one without a lag: about *any* level and slope up to half a tick behind or ahead,
    ``v2(t) + theta (v2(t - 1) - v2(t))`` with ``0 <= theta <= 1/2``, and about a constant reading. n
    correlated readings count as n / 4. The lag is accepted if an honest meter may leave its remainder, and

        (n / 8) log(least without a lag / left at lag) > log(lags) + 5

    y, model, own: (n,) readings, NaN if missing, reconstruction, and the own part of it, squared pu. count:
    number of last readings, < n. room: largest difference of the levels by a fixed error, squared pu. most:
    largest mean square of an honest meter, squared pu^2. A negative lag means readings ahead of their time.
    """
    if _CORRELATED * np.count_nonzero(np.isnan(y[-count:])) > count:
        return 0
    y = _filled(y)
    left, lag, lags = np.inf, 0, 4 * (y.size - count)
    for says, other in ((y, model), (y - own, model - own)):
        for sign, new, old in ((1, says, other), (-1, other, says)):
            each = _lags(new[-count:], old, room, most)
            ago = int(each.argmin())
            if each[ago] < left:
                left, lag = float(each[ago]), sign * (ago + 1)
    if left > most:
        return 0
    # Early readings are the older ones: the alternatives are tested on the same readings.
    same = slice(y.size + min(lag, 0) - count, y.size + min(lag, 0))
    deviation, models = y[same] - model[same], np.array([model[same], model[same] - own[same]])
    most_left = max(left, _TINY) * np.exp(2.0 * _CORRELATED / count * (np.log(lags) + _EVIDENCE))
    # The slowest test comes last.
    if not min(float(y[same].var()), float(deviation.var())) > most_left:
        return 0
    return lag if _in_time(deviation, np.diff(models)) > most_left else 0


def _in_time(deviation: Floats, later: Floats) -> float:
    """Least mean square of readings in their own tick, about any level and slope.

    later: (k, n - 1) changes of some models from tick to tick.
    """
    deviations, ways = _straightened(deviation), _straightened(later)
    best = float(deviations @ deviations) / deviations.size
    size = np.maximum(np.einsum("ij,ij->i", ways, ways), _TINY)[:, None]
    # Late towards the tick before, which the oldest does not have; early towards the one after.
    for part, sign in ((deviation[1:], -1.0), (deviation[:-1], 1.0)):
        rest = _straightened(part)
        amount = np.clip(sign * (ways @ rest)[:, None] / size, 0.0, _WITHIN_TICK)
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

    Infinite for all if the levels alone exceed `most`.
    """
    n, level = short.size, float(long.mean())
    short, long = short - level, long - level
    # The last stretch has lag zero.
    mean = float(short.mean()) - _moving_sums(long, n) / n
    # About the level that is nearest to the mean and within the room.
    beyond = np.maximum(np.abs(mean) - room, 0.0)
    if beyond.min() ** 2 > most:
        return np.full(mean.size, np.inf)
    whole = _moving_sums(long * long, n) - 2.0 * np.correlate(long, short, "valid")[:-1]
    whole += float(short @ short)
    whole /= n
    whole += beyond * beyond - mean * mean
    return whole[::-1]


def _moving_sums(x: Floats, n: int) -> Floats:
    """Sum of each n successive values, without the last n."""
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
