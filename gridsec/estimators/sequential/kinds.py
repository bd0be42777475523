"""Kind of a manipulation: stuck, replayed, of another time, one load's trace, drifting, constant.

Stuck and replaying meters are evidence of their own (`gridsec.estimators.sequential.repeats`). The last
readings of named meters are compared with their predictions by the *other* meters, in this order:

    replay         the last readings are an earlier stretch, reading by reading
    clock shift    y(t) = v2(t - lag):  reading and reconstruction agree at another time, level included
    drift          y(t) - v2(t) is a ramp, and no step explains it nearly as well
    offset         y(t) - v2(t) is a constant, perhaps after a step
    coordinated    the offsets of several meters are those that one customer's load would leave

None where nothing fits: an attack without a kind is still an attack.

References
----------
docs/theory-sequential.md, "What a manipulation looks like".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import chdtri

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices
from gridsec.estimators.sequential import clocks, repeats
from gridsec.estimators.sequential.effects import Effects
from gridsec.estimators.sequential.repeats import Memory, Rules
from gridsec.interface import ManipulationKind

_EVERY, _EVERY_S = 16, 240.0
"""Interval of the looks at a named meter's readings: ticks, and seconds where ticks are long."""
_SELDOM = 4
"""Interval of the looks at the past, in looks at the last readings."""
_CALLED = 12.0
"""Surprise at which repetition of a named meter is called stuck, or a replay."""
_BINS, _SHORTEST = 32, 8
"""Number of means that describe a shape, and fewest ticks for it."""
_LASTS, _BETTER = 0.25, 0.5
"""Least duration of a drift as a part of the data; largest remainder as a part of the best step's."""
_LEFT = 0.5
"""Largest standard deviation of the remainder, as a part of the size."""
_TRACE = 0.05
"""Relative error of the linear model of a load's trace."""
_SAME = 1e-9
"""Relative difference up to which entries of two columns are equal."""


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Change of the meters' squared voltages per customer's power: columns of 2R, then of 2X. p meters."""

    effects: Effects  # sensitivities of the feeder
    at: Ints  # (p,) bus of each meter

    def of(self, meters: Ints) -> Iterator[Floats]:
        """All traces at some meters, (k, …) each, in small parts."""
        return self.effects.at(self.at[meters])

    def trace(self, which: int) -> Floats:
        """Trace of one power, (p,)."""
        return np.asarray(self.effects.of(np.array([which]))[self.at, 0])


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """References of the kinds. p meters."""

    rules: Rules  # limits of repetition
    traces: Traces  # effect of each customer's power at the meters
    noise: Floats  # (p,) variance of a squared reading from tick to tick, squared pu^2
    active: Floats  # (p,) 2 R_jj of each meter's own customer
    reactive: Floats  # (p,) 2 X_jj likewise
    every: int  # ticks between two looks at a named meter


@dataclass(frozen=True, slots=True, eq=False)
class Kinds:
    """Reading history and kinds found. p meters."""

    memory: Memory  # past readings and reconstructions
    since: Ints  # (p,) tick at which each named meter was named; -1 for others
    alone: tuple[ManipulationKind | None, ...]  # (p,) kind of each named meter by itself
    told: Bools  # (p,) meters that together show a load that does not exist

    @property
    def kinds(self) -> tuple[ManipulationKind | None, ...]:
        """Kind of each named meter's manipulation, (p,)."""
        if not any_of(self.told):
            return self.alone
        return tuple(
            ManipulationKind.COORDINATED if told and kind is ManipulationKind.OFFSET else kind
            for kind, told in zip(self.alone, self.told.tolist(), strict=True)
        )


def empty(meters: int) -> Kinds:
    """No readings yet."""
    return Kinds(
        repeats.empty(meters),
        np.full(meters, -1, dtype=np.intp),
        (None,) * meters,
        np.zeros(meters, dtype=np.bool_),
    )


def pace(step_s: float) -> int:
    """Ticks between two looks at a named meter."""
    return int(np.clip(_EVERY_S // step_s, 1, _EVERY))


def listen(shapes: Shapes, before: Kinds, y: Floats, live: Bools) -> Kinds:
    """History with the readings y (p,), squared pu; `classify` has to follow before the next."""
    return Kinds(
        repeats.listen(shapes.rules, before.memory, y, live), before.since, before.alone, before.told
    )


def repeated(kinds: Kinds) -> Ints:
    """Ticks after which readings repeat beyond chance, (p,): 1 for a stuck meter, 0 for none."""
    return repeats.lags(kinds.memory)


def describe(  # noqa: PLR0917
    shapes: Shapes, heard: Kinds, model: Floats, own: Floats, named: Bools, variance: Floats
) -> Kinds:
    """Kind of the manipulation of every named meter, (p,).

    model, variance: (p,) prediction of each meter by the *others*, its fixed error included, squared pu, and
    its variance. own: (p,) part of `model` by the meter's own reported powers, squared pu.
    """
    memory = repeats.keep(heard.memory, model, own)
    if not any_of(named):
        return Kinds(memory, *(_nobody(named.size)))
    tick = memory.tick
    since = np.where(named, np.where(heard.since < 0, tick, heard.since), -1)
    alone = [kind if there else None for kind, there in zip(heard.alone, named.tolist(), strict=True)]
    told, new = heard.told & named, any_of(since == tick)
    stuck = named & (memory.stuck | (memory.run * shapes.rules.surprise >= _CALLED))
    replays = named & ~stuck & (memory.lag > 0)
    for kind, which in ((ManipulationKind.STUCK, stuck), (ManipulationKind.REPLAY, replays)):
        for j in indices(which).tolist():
            alone[j] = kind
    others, meters = named & ~stuck & ~replays, np.arange(named.size)
    numbers, back = _backward(shapes, tick, since)
    for j in indices(others & back).tolist():
        window = clocks.WINDOWS[numbers[j] % len(clocks.WINDOWS)]
        alone[j] = _of_the_past(shapes, memory, j, float(variance[j]), window, alone[j])
    due, before = others & (_turn(shapes, tick, meters) | _turns(since, tick, shapes.every)), tuple(alone)
    for age in sorted(set((tick - since[due]).tolist())):
        meters = indices(due & (since == tick - age))
        found = _alone(shapes, memory, meters, age, before)
        for j, looks in zip(meters.tolist(), found, strict=True):
            alone[j] = looks
    if new or tick % shapes.every == 0:
        told = _together(shapes, memory, since, variance)
    return Kinds(memory, since, tuple(alone), told)


_PARTS = 4
"""Groups of named meters that take turns: a look at several takes hardly longer than at one."""
_FIRST = 16
"""Newly named meters with a look at the same tick; as many of the others at each of the next."""


def _turns(since: Ints, tick: int, every: int) -> Bools:
    """Meters with their first look at this tick, (p,): after `every` ticks all have had it."""
    out = np.zeros(since.size, dtype=np.bool_)
    for start in set(since[since > tick - every].tolist()):
        first = (tick - start) * _FIRST
        out[indices(since == start)[first : first + _FIRST]] = start >= 0
    return out


@cache
def _nobody(meters: int) -> tuple[Ints, tuple[ManipulationKind | None, ...], Bools]:
    none = empty(meters)
    return none.since, none.alone, none.told


def _alone(
    shapes: Shapes, memory: Memory, meters: Ints, age: int, before: tuple[ManipulationKind | None, ...]
) -> Iterator[ManipulationKind | None]:
    """Kinds of meters named at the same time, each by itself."""
    start = max(memory.first, memory.tick - 2 * age - 4 * _BINS)
    code, model = repeats.past(memory, meters, start, memory.kept)
    lies = (code * shapes.rules.step[meters]) ** 2 - model
    found = _shapes(lies, np.sqrt(shapes.noise[meters]), age)
    moves = _moves(shapes, meters, code)
    for meter, begin, lie, looks in zip(meters.tolist(), moves.tolist(), lies.T, found, strict=True):
        # A kind that needs a long look stays: a drift that has ended, a clock shift at constant voltage.
        if before[meter] in _LASTING:
            yield before[meter]
        else:
            yield _again(shapes, meter, lie[begin:], age) if begin else looks


def _moves(shapes: Shapes, meters: Ints, code: Floats) -> Ints:
    """First of the readings (n, k) after the last stuck stretch; 0 for others, (k,)."""
    out, surprise = np.zeros(meters.size, dtype=np.intp), shapes.rules.surprise[meters]
    for k in indices(_longest(code) * surprise >= _CALLED).tolist():
        heard = indices(np.isfinite(code[:, k]))
        read = code[heard, k]
        ends = np.concatenate([[-1], indices(read[1:] != read[:-1]), [heard.size - 1]])
        stuck = indices((np.diff(ends) - 1) * surprise[k] >= _CALLED)
        if stuck.size:
            out[k] = heard[ends[stuck[-1] + 1]] + 1
    return out


def _longest(code: Floats) -> Ints:
    """Longest run of equal readings in a row, (n, k); silence continues a run."""
    same = (code[1:] == code[:-1]) | np.isnan(code[1:]) | np.isnan(code[:-1])
    count = np.cumsum(same, axis=0)
    run = count - np.maximum.accumulate(np.where(same, 0, count), axis=0)
    return np.asarray(run.max(axis=0, initial=0))


def _again(shapes: Shapes, meter: int, lie: Floats, age: int) -> ManipulationKind | None:
    """Kind of a formerly stuck meter since it moves, if that is long enough."""
    heard = int(np.isfinite(lie).sum())
    if heard < max(shapes.every, _SHORTEST):
        return ManipulationKind.STUCK
    return shape(lie, float(np.sqrt(shapes.noise[meter])), min(age, lie.size))


def _turn(shapes: Shapes, tick: int, meters: Ints) -> Bools:
    """Meters with a repeated look at this tick."""
    early = (tick + meters % _PARTS * -(-shapes.every // _PARTS)) % shapes.every
    return np.asarray(early == 0)


def _backward(shapes: Shapes, tick: int, since: Ints) -> tuple[Ints, Bools]:
    """Number of the look at each meter's past, and the meters with one at this tick, (p,) each.

    `since`: tick of naming. A past is long, so every meter has its own tick. On short ticks a look that
    coincides with the tick of naming is left to the next, since that tick has the most to compute.
    """
    number, early = np.divmod(tick + np.arange(since.size), shapes.every * _SELDOM)
    if shapes.every == 1:
        return number, early == 0
    age = tick - since
    return number, (early == 0) & (age > 0) | (early == 1) & (age == 1)


_LASTING = (ManipulationKind.REPLAY, ManipulationKind.CLOCK_SHIFT, ManipulationKind.DRIFT)


def _of_the_past(  # noqa: PLR0917
    shapes: Shapes, memory: Memory, meter: int, spread: float, window: int, before: ManipulationKind | None
) -> ManipulationKind | None:
    """Replay or clock shift if a meter's readings are of another time; else the kind before.

    A wrong clock never repeats readings, so replay is tested first.
    """
    if before is ManipulationKind.REPLAY:
        return before
    code, model = repeats.past(memory, meter, memory.first, memory.kept)
    same = repeats.recurring(code) * repeats.surprise(shapes.rules, memory)[meter]
    if same >= _CALLED + np.log(code.size):
        return ManipulationKind.REPLAY
    heard = min(window, code.size // 2)
    if before is ManipulationKind.CLOCK_SHIFT or heard < clocks.WINDOWS[0]:
        return before
    y = (code * shapes.rules.step[meter]) ** 2
    own = repeats.own_part(memory, meter)
    lag = clocks.shifted(y, model, own, heard, 3.0 * np.sqrt(spread), spread + float(shapes.noise[meter]))
    return ManipulationKind.CLOCK_SHIFT if lag else before


def shape(lie: Floats, noise: float, age: int) -> ManipulationKind | None:
    """Kind of a manipulation by its shape: drift, offset or None.

    lie: (n,) readings minus reconstruction, squared pu, NaN if missing. noise: its standard deviation from
    tick to tick. age: ticks since the meter was named. Ramps from zero to full size between any two of
    `_BINS` moments are fitted by least squares; one of no duration is a step. A drift lasts and leaves far
    less than the best step.
    """
    heard = lie[np.isfinite(lie)]
    if heard.size and _drifts(heard[:, None], np.array([noise]))[0]:
        return ManipulationKind.DRIFT
    now = lie[-(age + 2) :]
    now = now[np.isfinite(now)]
    return ManipulationKind.OFFSET if now.size and now.std() < _LEFT * abs(now.mean()) + noise else None


def _shapes(lies: Floats, noise: Floats, age: int) -> list[ManipulationKind | None]:
    """`shape` of several meters, (n, k)."""
    if not all_of(np.isfinite(lies)):
        return [shape(lie, std, age) for lie, std in zip(lies.T, noise.tolist(), strict=True)]
    now = lies[-(age + 2) :]
    constant = now.std(axis=0) < _LEFT * np.abs(now.mean(axis=0)) + noise
    both = zip(_drifts(lies, noise).tolist(), constant.tolist(), strict=True)
    return [
        ManipulationKind.DRIFT if drifts else ManipulationKind.OFFSET if rests else None
        for drifts, rests in both
    ]


def _drifts(lies: Floats, noise: Floats) -> Bools:
    """Columns of `lies` (n, k) that grow, by means over equal parts."""
    width = max(1, len(lies) // _BINS)
    count = len(lies) // width
    if count < _SHORTEST:
        return np.zeros(noise.size, dtype=np.bool_)
    means = lies[len(lies) - count * width :].reshape(count, width, -1).mean(axis=1)
    ramps, size, lasts = _ramps(count)
    centred = means - means.mean(axis=0)
    along = ramps @ centred
    explained, whole = along * along, np.einsum("ij,ij->j", centred, centred)
    best, at = explained.argmax(axis=0), np.arange(noise.size)
    least, grown = np.maximum(whole - explained[best, at], 0.0), along[best, at] / size[best]
    by_step = np.maximum(whole - explained[lasts <= 1].max(axis=0), 0.0)
    floor = count * noise**2 / width
    lasting = lasts[best] >= _LASTS * count
    lasting &= least + floor < _BETTER * (by_step + floor)
    # The remainder must be small against the growth.
    return np.asarray(lasting & (np.sqrt(least / count) < _LEFT * np.abs(grown)))


@cache
def _ramps(n: int) -> tuple[Floats, Floats, Ints]:
    """All ramps from 0 to 1 over n bins, centred and of norm 1; their norms, and durations in bins."""
    begin, end = np.triu_indices(n, 1)
    at = np.arange(n)
    ramps = np.clip((at - begin[:, None]) / (end - begin)[:, None], 0.0, 1.0)
    ramps -= ramps.mean(axis=1, keepdims=True)
    size = np.linalg.norm(ramps, axis=1)
    return ramps / size[:, None], size, np.asarray(end - begin)


def _together(shapes: Shapes, memory: Memory, since: Ints, variance: Floats) -> Bools:
    """Named meters with deviations that are one load's trace."""
    named = since >= 0
    who = indices(named)
    if who.size < 2:  # one meter has no common trace
        return np.zeros_like(named)
    # Since all of them are named; evidence is one tick older than a name.
    start = max(memory.first, memory.kept - _EVERY, int(since.max()) - 1)
    code, model = repeats.past(memory, who, start, memory.kept)
    lies = (code * shapes.rules.step[who]) ** 2 - model
    heard = np.isfinite(lies).sum(axis=0)
    if not all_of(heard):
        return np.zeros_like(named)
    spread = variance[who] + shapes.noise[who] / heard
    same = traced(shapes.traces, who, np.nansum(lies, axis=0) / heard, spread)
    return named if same else np.zeros_like(named)


def traced(traces: Traces, who: Ints, lies: Floats, variance: Floats) -> bool:
    """True if the deviations of several meters are the trace of one customer's load.

    They must be proportional to a column of 2R or 2X within their errors; the meters must be among those that
    the load affects most, at most twice their number; and a common constant must fit worse by more than the
    number of columns explains. Shapes (k,): meters, readings minus reconstruction, squared pu,
    and variance of these.
    """
    weight = 1.0 / (variance + (_TRACE * lies) ** 2)
    whole = float(weight @ lies**2)

    def misfit(of: Floats) -> Floats:
        explained = ((weight * lies) @ of) ** 2 / np.maximum(weight @ of**2, np.finfo(np.float64).tiny)
        return np.maximum(whole - explained, 0.0)

    same = misfit(np.ones((who.size, 1)))[0]
    most = min(_quantile(who.size - 1), same - 2.0 * np.log(2 * traces.effects.feeder.bus.size))
    if most < 0.0:
        return False
    fits = np.concatenate([misfit(part) for part in traces.of(who)])
    for k in indices(fits <= most).tolist():
        # In three phases a load lowers its own phase and moves the others either way: the size counts.
        felt = np.abs(traces.trace(k))
        weakest = felt[who].min()
        # Meters behind the same branch are affected alike: only more affected ones are counted.
        if weakest > 0.0 and np.count_nonzero(felt > weakest * (1.0 + _SAME)) <= 2 * who.size:
            return True
    return False


@cache
def _quantile(freedom: int) -> float:
    """Misfit that the right trace exceeds with a probability of 1 %."""
    return float(chdtri(freedom, 0.01))
