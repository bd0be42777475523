"""Kind of a manipulation: stuck, replayed, of another time, one load's trace, drifting, constant.

Stuck and replaying meters are evidence of their own. The last readings of named meters are compared with
their predictions by the *other* meters, in this order:

    replay         the last readings are an earlier stretch, reading by reading
    clock shift    y(t) = v2(t - lag):  reading and reconstruction agree at another time, level included
    drift          y(t) - v2(t) is a ramp, and no step explains it nearly as well
    offset         y(t) - v2(t) is a constant, perhaps after a step
    coordinated    the offsets of several meters are those that one customer's load would leave

None where nothing fits: an attack without a kind is still an attack.

With a clock shift either the voltage alone is late, or all data of the meter. In the second case the
reconstruction at time t rests on a power of time t - lag as well. Its part in the meter's own voltage,
``own = 2 R_jj p_j + 2 X_jj q_j`` to first order, belongs to the reading:

    y(t)          = v2(t - lag)                   the voltage alone,
    y(t) - own(t) = v2(t - lag) - own(t - lag)    the whole meter.

References
----------
docs/theory-front.md, section 8.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from scipy.special import chdtri

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices
from gridsec.estimators.front.reading_history import (
    ReadingHistory,
    RepeatLimits,
    no_history,
    own_part,
    past,
    record_readings,
    recurring,
    store,
    surprise,
    verified_lags,
)
from gridsec.grid.network import Sensitivities
from gridsec.interface import ManipulationKind

_EVERY, _EVERY_S = 16, 240.0
"""Interval of the looks at a named meter's readings: ticks, and seconds where ticks are long."""


_PAST_LOOKS = 4
"""Interval of the looks at the past, in looks at the last readings."""


_CALLED_SURPRISE = 12.0
"""Surprise at which repetition of a named meter is called stuck, or a replay."""


_BINS, _SHORTEST = 32, 8
"""Number of means that describe a shape, and fewest ticks for it."""


_LEAST_DURATION, _RAMP_REMAINDER = 0.25, 0.5
"""Least duration of a drift as a part of the data; largest remainder as a part of the best step's."""


_REMAINDER = 0.5
"""Largest standard deviation of the remainder, as a part of the size."""


_TRACE = 0.05
"""Relative error of the linear model of a load's trace."""


_SAME = 1e-9
"""Relative difference up to which entries of two columns are equal."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadTraces:
    """Change of the meters' squared voltages per customer's power: columns of 2R, then of 2X. p meters."""

    sensitivities: Sensitivities  # sensitivities of the feeder
    at: Ints  # (p,) bus of each meter

    def of(self, meters: Ints) -> Iterator[Floats]:
        """All traces at some meters, (k, …) each, in small parts."""
        return self.sensitivities.rows(self.at[meters])

    def trace(self, which: int) -> Floats:
        """Trace of one power, (p,)."""
        return np.asarray(self.sensitivities.numbered(np.array([which]))[self.at, 0])


@dataclass(frozen=True, slots=True, eq=False)
class KindReferences:
    """References of the kinds. p meters."""

    limits: RepeatLimits  # limits of repetition
    traces: LoadTraces  # effect of each customer's power at the meters
    noise: Floats  # (p,) variance of a squared reading from tick to tick, squared pu^2
    active: Floats  # (p,) 2 R_jj of each meter's own customer
    reactive: Floats  # (p,) 2 X_jj likewise
    interval: int  # ticks between two looks at a named meter


@dataclass(frozen=True, slots=True, eq=False)
class AttackKinds:
    """Reading history and kinds found. p meters."""

    history: ReadingHistory  # past readings and reconstructions
    since: Ints  # (p,) tick at which each named meter was named; -1 for others
    single: tuple[ManipulationKind | None, ...]  # (p,) kind of each named meter by itself
    coordinated: Bools  # (p,) meters that together show a load that does not exist

    @property
    def kinds(self) -> tuple[ManipulationKind | None, ...]:
        """Kind of each named meter's manipulation, (p,)."""
        if not any_of(self.coordinated):
            return self.single
        return tuple(
            ManipulationKind.COORDINATED if shared and kind is ManipulationKind.OFFSET else kind
            for kind, shared in zip(self.single, self.coordinated.tolist(), strict=True)
        )


def no_kinds(meters: int) -> AttackKinds:
    """No readings yet."""
    return AttackKinds(
        no_history(meters),
        np.full(meters, -1, dtype=np.intp),
        (None,) * meters,
        np.zeros(meters, dtype=np.bool_),
    )


def look_interval(step_s: float) -> int:
    """Ticks between two looks at a named meter."""
    return int(np.clip(_EVERY_S // step_s, 1, _EVERY))


def ingest(references: KindReferences, before: AttackKinds, y: Floats, available: Bools) -> AttackKinds:
    """History with the readings y (p,), squared pu; `classify` has to follow before the next."""
    return AttackKinds(
        record_readings(references.limits, before.history, y, available),
        before.since,
        before.single,
        before.coordinated,
    )


def repeat_lags(kinds: AttackKinds) -> Ints:
    """Ticks after which readings repeat beyond chance, (p,): 1 for a stuck meter, 0 for none."""
    return verified_lags(kinds.history)


def classify(  # noqa: PLR0917
    references: KindReferences,
    ingested: AttackKinds,
    model: Floats,
    own: Floats,
    named: Bools,
    variance: Floats,
) -> AttackKinds:
    """Kind of the manipulation of every named meter, (p,).

    model, variance: (p,) prediction of each meter by the *others*, its fixed error included, squared pu, and
    its variance. own: (p,) part of `model` by the meter's own reported powers, squared pu.
    """
    history = store(ingested.history, model, own)
    if not any_of(named):
        return AttackKinds(history, *(_none_named(named.size)))
    tick = history.tick
    since = np.where(named, np.where(ingested.since < 0, tick, ingested.since), -1)
    alone = [kind if there else None for kind, there in zip(ingested.single, named.tolist(), strict=True)]
    shared, new = ingested.coordinated & named, any_of(since == tick)
    stuck = named & (history.stuck | (history.run * references.limits.surprise >= _CALLED_SURPRISE))
    replays = named & ~stuck & (history.lag > 0)
    for kind, which in ((ManipulationKind.STUCK, stuck), (ManipulationKind.REPLAY, replays)):
        for j in indices(which).tolist():
            alone[j] = kind
    others, meters = named & ~stuck & ~replays, np.arange(named.size)
    numbers, back = _past_looks(references, tick, since)
    for j in indices(others & back).tolist():
        window = WINDOWS[numbers[j] % len(WINDOWS)]
        alone[j] = _of_the_past(references, history, j, float(variance[j]), window, alone[j])
    due, before = (
        others & (_due_again(references, tick, meters) | _first_looks(since, tick, references.interval)),
        tuple(alone),
    )
    for age in sorted(set((tick - since[due]).tolist())):
        meters = indices(due & (since == tick - age))
        found = _single_kinds(references, history, meters, age, before)
        for j, looks in zip(meters.tolist(), found, strict=True):
            alone[j] = looks
    if new or tick % references.interval == 0:
        shared = _coordinated(references, history, since, variance)
    return AttackKinds(history, since, tuple(alone), shared)


_GROUPS = 4
"""Groups of named meters that take turns: a look at several takes hardly longer than at one."""


_FIRST_LOOKS = 16
"""Newly named meters with a look at the same tick; as many of the others at each of the next."""


def _first_looks(since: Ints, tick: int, every: int) -> Bools:
    """Meters with their first look at this tick, (p,): after `every` ticks all have had it."""
    out = np.zeros(since.size, dtype=np.bool_)
    for start in set(since[since > tick - every].tolist()):
        first = (tick - start) * _FIRST_LOOKS
        out[indices(since == start)[first : first + _FIRST_LOOKS]] = start >= 0
    return out


@cache
def _none_named(meters: int) -> tuple[Ints, tuple[ManipulationKind | None, ...], Bools]:
    none = no_kinds(meters)
    return none.since, none.single, none.coordinated


def _single_kinds(
    references: KindReferences,
    history: ReadingHistory,
    meters: Ints,
    age: int,
    before: tuple[ManipulationKind | None, ...],
) -> Iterator[ManipulationKind | None]:
    """Kinds of meters named at the same time, each by itself."""
    start = max(history.first, history.tick - 2 * age - 4 * _BINS)
    code, model = past(history, meters, start, history.kept)
    deviations = (code * references.limits.step[meters]) ** 2 - model
    found = _shapes(deviations, np.sqrt(references.noise[meters]), age)
    moves = _restarts(references, meters, code)
    for meter, begin, deviation, looks in zip(
        meters.tolist(), moves.tolist(), deviations.T, found, strict=True
    ):
        # A kind that needs a long look stays: a drift that has ended, a clock shift at constant voltage.
        if before[meter] in _LASTING:
            yield before[meter]
        else:
            yield _after_stuck(references, meter, deviation[begin:], age) if begin else looks


def _restarts(references: KindReferences, meters: Ints, code: Floats) -> Ints:
    """First of the readings (n, k) after the last stuck stretch; 0 for others, (k,)."""
    out, surprise = np.zeros(meters.size, dtype=np.intp), references.limits.surprise[meters]
    for k in indices(_longest(code) * surprise >= _CALLED_SURPRISE).tolist():
        readings = indices(np.isfinite(code[:, k]))
        read = code[readings, k]
        ends = np.concatenate([[-1], indices(read[1:] != read[:-1]), [readings.size - 1]])
        stuck = indices((np.diff(ends) - 1) * surprise[k] >= _CALLED_SURPRISE)
        if stuck.size:
            out[k] = readings[ends[stuck[-1] + 1]] + 1
    return out


def _longest(code: Floats) -> Ints:
    """Longest run of equal readings in a row, (n, k); silence continues a run."""
    same = (code[1:] == code[:-1]) | np.isnan(code[1:]) | np.isnan(code[:-1])
    count = np.cumsum(same, axis=0)
    run = count - np.maximum.accumulate(np.where(same, 0, count), axis=0)
    return np.asarray(run.max(axis=0, initial=0))


def _after_stuck(
    references: KindReferences, meter: int, deviation: Floats, age: int
) -> ManipulationKind | None:
    """Kind of a formerly stuck meter since it moves, if that is long enough."""
    readings = int(np.isfinite(deviation).sum())
    if readings < max(references.interval, _SHORTEST):
        return ManipulationKind.STUCK
    return shape(deviation, float(np.sqrt(references.noise[meter])), min(age, deviation.size))


def _due_again(references: KindReferences, tick: int, meters: Ints) -> Bools:
    """Meters with a repeated look at this tick."""
    early = (tick + meters % _GROUPS * -(-references.interval // _GROUPS)) % references.interval
    return np.asarray(early == 0)


def _past_looks(references: KindReferences, tick: int, since: Ints) -> tuple[Ints, Bools]:
    """Number of the look at each meter's past, and the meters with one at this tick, (p,) each.

    `since`: tick of naming. A past is long, so every meter has its own tick. On short ticks a look that
    coincides with the tick of naming is left to the next, since that tick has the most to compute.
    """
    number, early = np.divmod(tick + np.arange(since.size), references.interval * _PAST_LOOKS)
    if references.interval == 1:
        return number, early == 0
    age = tick - since
    return number, (early == 0) & (age > 0) | (early == 1) & (age == 1)


_LASTING = (ManipulationKind.REPLAY, ManipulationKind.CLOCK_SHIFT, ManipulationKind.DRIFT)


def _of_the_past(  # noqa: PLR0917
    references: KindReferences,
    history: ReadingHistory,
    meter: int,
    spread: float,
    window: int,
    before: ManipulationKind | None,
) -> ManipulationKind | None:
    """Replay or clock shift if a meter's readings are of another time; else the kind before.

    A wrong clock never repeats readings, so replay is tested first.
    """
    if before is ManipulationKind.REPLAY:
        return before
    code, model = past(history, meter, history.first, history.kept)
    same = recurring(code) * surprise(references.limits, history)[meter]
    if same >= _CALLED_SURPRISE + np.log(code.size):
        return ManipulationKind.REPLAY
    readings = min(window, code.size // 2)
    if before is ManipulationKind.CLOCK_SHIFT or readings < WINDOWS[0]:
        return before
    y = (code * references.limits.step[meter]) ** 2
    own = own_part(history, meter)
    lag = clock_shift(y, model, own, readings, 3.0 * np.sqrt(spread), spread + float(references.noise[meter]))
    return ManipulationKind.CLOCK_SHIFT if lag else before


def shape(deviation: Floats, noise: float, age: int) -> ManipulationKind | None:
    """Kind of a manipulation by its shape: drift, offset or None.

    deviation: (n,) readings minus reconstruction, squared pu, NaN if missing. noise: its standard deviation
    from tick to tick. age: ticks since the meter was named. Ramps from zero to full size between any two of
    `_BINS` moments are fitted by least squares; one of no duration is a step. A drift lasts and leaves far
    less than the best step.
    """
    readings = deviation[np.isfinite(deviation)]
    if readings.size and _drifts(readings[:, None], np.array([noise]))[0]:
        return ManipulationKind.DRIFT
    now = deviation[-(age + 2) :]
    now = now[np.isfinite(now)]
    return ManipulationKind.OFFSET if now.size and now.std() < _REMAINDER * abs(now.mean()) + noise else None


def _shapes(deviations: Floats, noise: Floats, age: int) -> list[ManipulationKind | None]:
    """`shape` of several meters, (n, k)."""
    if not all_of(np.isfinite(deviations)):
        return [
            shape(deviation, std, age) for deviation, std in zip(deviations.T, noise.tolist(), strict=True)
        ]
    now = deviations[-(age + 2) :]
    constant = now.std(axis=0) < _REMAINDER * np.abs(now.mean(axis=0)) + noise
    both = zip(_drifts(deviations, noise).tolist(), constant.tolist(), strict=True)
    return [
        ManipulationKind.DRIFT if drifts else ManipulationKind.OFFSET if rests else None
        for drifts, rests in both
    ]


def _drifts(deviations: Floats, noise: Floats) -> Bools:
    """Columns of `deviations` (n, k) that grow, by means over equal parts."""
    width = max(1, len(deviations) // _BINS)
    count = len(deviations) // width
    if count < _SHORTEST:
        return np.zeros(noise.size, dtype=np.bool_)
    means = deviations[len(deviations) - count * width :].reshape(count, width, -1).mean(axis=1)
    ramps, size, lasts = _ramps(count)
    centred = means - means.mean(axis=0)
    along = ramps @ centred
    explained, whole = along * along, np.einsum("ij,ij->j", centred, centred)
    best, at = explained.argmax(axis=0), np.arange(noise.size)
    least, grown = np.maximum(whole - explained[best, at], 0.0), along[best, at] / size[best]
    by_step = np.maximum(whole - explained[lasts <= 1].max(axis=0), 0.0)
    floor = count * noise**2 / width
    lasting = lasts[best] >= _LEAST_DURATION * count
    lasting &= least + floor < _RAMP_REMAINDER * (by_step + floor)
    # The remainder must be small against the growth.
    return np.asarray(lasting & (np.sqrt(least / count) < _REMAINDER * np.abs(grown)))


@lru_cache(maxsize=4)  # up to 1 MB each
def _ramps(n: int) -> tuple[Floats, Floats, Ints]:
    """All ramps from 0 to 1 over n bins, centred and of norm 1; their norms, and durations in bins."""
    begin, end = np.triu_indices(n, 1)
    at = np.arange(n)
    ramps = np.clip((at - begin[:, None]) / (end - begin)[:, None], 0.0, 1.0)
    ramps -= ramps.mean(axis=1, keepdims=True)
    size = np.linalg.norm(ramps, axis=1)
    return ramps / size[:, None], size, np.asarray(end - begin)


def _coordinated(references: KindReferences, history: ReadingHistory, since: Ints, variance: Floats) -> Bools:
    """Named meters with deviations that are one load's trace."""
    named = since >= 0
    which = indices(named)
    if which.size < 2:  # one meter has no common trace
        return np.zeros_like(named)
    # Since all of them are named; evidence is one tick older than a name.
    start = max(history.first, history.kept - _EVERY, int(since.max()) - 1)
    code, model = past(history, which, start, history.kept)
    deviations = (code * references.limits.step[which]) ** 2 - model
    readings = np.isfinite(deviations).sum(axis=0)
    if not all_of(readings):
        return np.zeros_like(named)
    spread = variance[which] + references.noise[which] / readings
    same = is_load_trace(references.traces, which, np.nansum(deviations, axis=0) / readings, spread)
    return named if same else np.zeros_like(named)


def is_load_trace(traces: LoadTraces, which: Ints, deviations: Floats, variance: Floats) -> bool:
    """True if the deviations of several meters are the trace of one customer's load.

    They must be proportional to a column of 2R or 2X within their errors; the meters must be among those that
    the load affects most, at most twice their number; and a common constant must fit worse by more than the
    number of columns explains. Shapes (k,): meters, readings minus reconstruction, squared pu,
    and variance of these.
    """
    weight = 1.0 / (variance + (_TRACE * deviations) ** 2)
    whole = float(weight @ deviations**2)

    def misfit(of: Floats) -> Floats:
        explained = ((weight * deviations) @ of) ** 2 / np.maximum(weight @ of**2, np.finfo(np.float64).tiny)
        return np.maximum(whole - explained, 0.0)

    same = misfit(np.ones((which.size, 1)))[0]
    most = min(_quantile(which.size - 1), same - 2.0 * np.log(2 * traces.sensitivities.feeder.bus.size))
    if most < 0.0:
        return False
    posteriors = np.concatenate([misfit(part) for part in traces.of(which)])
    for k in indices(posteriors <= most).tolist():
        # In three phases a load lowers its own phase and moves the others either way: the size counts.
        felt = np.abs(traces.trace(k))
        weakest = felt[which].min()
        # Meters behind the same branch are affected alike: only more affected ones are counted.
        if weakest > 0.0 and np.count_nonzero(felt > weakest * (1.0 + _SAME)) <= 2 * which.size:
            return True
    return False


@cache
def _quantile(freedom: int) -> float:
    """Misfit that the right trace exceeds with a probability of 1 %."""
    return float(chdtri(freedom, 0.01))


# --- Clock shifts ---


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
