"""What a manipulation looks like: stuck, replayed, of another time, one load's trace, drifting, constant.

Stuck and replaying meters are evidence of their own and come from `gridsec.estimators.sequential.repeats`.
For meters that are named, whatever the evidence, the last readings are compared with what the *other* meters
say, by the question that explains most first:

    replay         the last readings are an earlier stretch, reading by reading
    clock shift    y(t) = v2(t - lag):  reading and reconstruction agree at another time, level included
    drift          y(t) - v2(t) is a ramp, and no step explains it nearly as well
    offset         y(t) - v2(t) is a constant, perhaps after a step
    coordinated    the offsets of several meters are those that one customer's load would leave

None where nothing fits: no kind is not no attack.

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

# A named meter's readings are looked at every so many ticks, and every so many seconds where ticks are long.
_EVERY, _EVERY_S = 16, 240.0
# So many times more seldom they are looked for in the past.
_SELDOM = 4
# Surprise from which repetition of a meter that is named anyway is called stuck, or a replay.
_CALLED = 12.0
# Means that the shape of a lie is judged by, and fewest ticks for it.
_BINS, _SHORTEST = 32, 8
# A drift must last this part of what is seen, and a ramp leave this part of what the best step leaves.
_LASTS, _BETTER = 0.25, 0.5
# A shape explains a lie if this part of its size is the most that is left, as a standard deviation.
_LEFT = 0.5
# The linear model of a load's trace is off by this part.
_TRACE = 0.05
# Entries of two columns this close, as a part, are equal.
_SAME = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Traces:
    """Change of the meters' squared voltages per customer's power: columns of 2R, then of 2X. p meters.

    Attributes
    ----------
    effects
        Of the feeder.
    at : (p,)
        Bus of each meter.
    """

    effects: Effects
    at: Ints

    def of(self, meters: Ints) -> Iterator[Floats]:
        """All traces at some meters, (k, …) each, in parts that are small."""
        return self.effects.at(self.at[meters])

    def trace(self, which: int) -> Floats:
        """One of them, (p,)."""
        return np.asarray(self.effects.of(np.array([which]))[self.at, 0])


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """What lies are compared with. p meters, K traces.

    Attributes
    ----------
    rules
        When repetition is evidence.
    traces
        What each customer's power would do to the meters.
    noise : (p,)
        Variance of a squared reading from tick to tick, squared pu^2.
    active, reactive : (p,)
        What the squared voltage at a meter changes by per power of its own customer, 2 R_jj and 2 X_jj.
    every
        Ticks between two looks at a named meter.
    """

    rules: Rules
    traces: Traces
    noise: Floats
    active: Floats
    reactive: Floats
    every: int


@dataclass(frozen=True, slots=True, eq=False)
class Kinds:
    """What is remembered, and what was found. p meters.

    Attributes
    ----------
    memory
        Past readings and reconstructions.
    since : (p,)
        Tick at which each named meter was named; -1 for others.
    alone : (p,)
        What each named meter's manipulation looks like by itself.
    told : (p,)
        Meters that together tell of a load that is not there.
    """

    memory: Memory
    since: Ints
    alone: tuple[ManipulationKind | None, ...]
    told: Bools

    @property
    def kinds(self) -> tuple[ManipulationKind | None, ...]:
        """What each named meter's manipulation looks like, (p,)."""
        if not any_of(self.told):
            return self.alone
        return tuple(
            ManipulationKind.COORDINATED if told and kind is ManipulationKind.OFFSET else kind
            for kind, told in zip(self.alone, self.told.tolist(), strict=True)
        )


def empty(meters: int) -> Kinds:
    """Nothing seen yet.

    Parameters
    ----------
    meters
        p.
    """
    return Kinds(
        repeats.empty(meters),
        np.full(meters, -1, dtype=np.intp),
        (None,) * meters,
        np.zeros(meters, dtype=np.bool_),
    )


def pace(step_s: float) -> int:
    """Ticks between two looks at a named meter.

    Parameters
    ----------
    step_s
        Expected time between readings, s.
    """
    return int(np.clip(_EVERY_S // step_s, 1, _EVERY))


def listen(shapes: Shapes, before: Kinds, y: Floats, live: Bools) -> Kinds:
    """Take readings in; `describe` has to follow before the next.

    Parameters
    ----------
    shapes
        What lies are compared with.
    before
        So far; not changed.
    y : (p,)
        Squared readings, pu; any finite numbers where not live.
    live : (p,)
        Where there is a reading.
    """
    return Kinds(
        repeats.listen(shapes.rules, before.memory, y, live), before.since, before.alone, before.told
    )


def repeated(kinds: Kinds) -> Ints:
    """Ticks after which readings repeat that are evidence by themselves, whatever the others say, (p,).

    Parameters
    ----------
    kinds
        From `listen`.

    Returns
    -------
    (p,)
        1 for a stuck meter, 0 for one that does not repeat itself.
    """
    return repeats.lags(kinds.memory)


def describe(  # noqa: PLR0917  # what each meter says, and what the others say of it
    shapes: Shapes, heard: Kinds, model: Floats, own: Floats, named: Bools, variance: Floats
) -> Kinds:
    """Say what the manipulation of every named meter looks like.

    Parameters
    ----------
    shapes
        What lies are compared with.
    heard
        From `listen`.
    model : (p,)
        What each meter should read by what the *others* say, its fixed error included, squared pu.
    own : (p,)
        What each meter's own reported powers contribute to `model`, squared pu.
    named : (p,)
        Who is named.
    variance : (p,)
        Of `model`, fixed errors included, squared pu^2.
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


# Parts of the named meters that take turns: one look at several takes hardly longer than one at one.
_PARTS = 4
# Meters named at once that are looked at in the same tick; of the others as many in each of the next.
_FIRST = 16


def _turns(since: Ints, tick: int, every: int) -> Bools:
    """Whose turn it is to be looked at for the first time, (p,): after so many ticks everybody has been."""
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
    """What the lies of meters named at the same time look like, each by itself."""
    start = max(memory.first, memory.tick - 2 * age - 4 * _BINS)
    code, model = repeats.past(memory, meters, start, memory.kept)
    lies = (code * shapes.rules.step[meters]) ** 2 - model
    found = _shapes(lies, np.sqrt(shapes.noise[meters]), age)
    moves = _moves(shapes, meters, code)
    for meter, begin, lie, looks in zip(meters.tolist(), moves.tolist(), lies.T, found, strict=True):
        # What takes a long look to see stays true when the lie rests: a drift that has arrived, a clock in
        # calm.
        if before[meter] in _LASTING:
            yield before[meter]
        else:
            yield _again(shapes, meter, lie[begin:], age) if begin else looks


def _moves(shapes: Shapes, meters: Ints, code: Floats) -> Ints:
    """Since which of the readings (n, k) meters move that have been stuck before; 0 for others, (k,)."""
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
    """How often each of several meters' readings, (n, k), repeats itself in a row at most; silence does."""
    same = (code[1:] == code[:-1]) | np.isnan(code[1:]) | np.isnan(code[:-1])
    count = np.cumsum(same, axis=0)
    run = count - np.maximum.accumulate(np.where(same, 0, count), axis=0)
    return np.asarray(run.max(axis=0, initial=0))


def _again(shapes: Shapes, meter: int, lie: Floats, age: int) -> ManipulationKind | None:
    """What the lie of a meter that was stuck looks like since it moves, if that is for long enough."""
    heard = int(np.isfinite(lie).sum())
    if heard < max(shapes.every, _SHORTEST):
        return ManipulationKind.STUCK
    return shape(lie, float(np.sqrt(shapes.noise[meter])), min(age, lie.size))


def _turn(shapes: Shapes, tick: int, meters: Ints) -> Bools:
    """Which of some meters are looked at again."""
    early = (tick + meters % _PARTS * -(-shapes.every // _PARTS)) % shapes.every
    return np.asarray(early == 0)


def _backward(shapes: Shapes, tick: int, since: Ints) -> tuple[Ints, Bools]:
    """Number of the look at each meter's past, and whose turn it is, (p,) each; `since` when each was named.

    A past is long, and each takes its own time: every meter has its own turn, or number, whenever it is
    named. The tick of naming has the most to do: where ticks are short, what would fall on it is left to the
    next.
    """
    number, early = np.divmod(tick + np.arange(since.size), shapes.every * _SELDOM)
    if shapes.every == 1:
        return number, early == 0
    age = tick - since
    return number, (early == 0) & (age > 0) | (early == 1) & (age == 1)


_LASTING = (ManipulationKind.REPLAY, ManipulationKind.CLOCK_SHIFT, ManipulationKind.DRIFT)


def _of_the_past(  # noqa: PLR0917  # one meter, and where to look
    shapes: Shapes, memory: Memory, meter: int, spread: float, window: int, before: ManipulationKind | None
) -> ManipulationKind | None:
    """Replay or clock shift if a meter's readings are of another time; else what it was before.

    A clock that is off, or set wrong, never makes a meter say again what it has said: that comes first.
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
    """Whether a lie is constant or grows.

    A ramp from nothing to its full size that begins and ends at any two of `_BINS` moments is fitted by
    least squares; one of no duration is a step. The ramp is a drift where it lasts, and leaves far less
    than the best step.

    Parameters
    ----------
    lie : (n,)
        Readings minus reconstruction, squared pu; NaN where there is none.
    noise
        Its standard deviation from tick to tick, squared pu.
    age
        How many ticks ago the meter was named.
    """
    heard = lie[np.isfinite(lie)]
    if heard.size and _drifts(heard[:, None], np.array([noise]))[0]:
        return ManipulationKind.DRIFT
    now = lie[-(age + 2) :]
    now = now[np.isfinite(now)]
    return ManipulationKind.OFFSET if now.size and now.std() < _LEFT * abs(now.mean()) + noise else None


def _shapes(lies: Floats, noise: Floats, age: int) -> list[ManipulationKind | None]:
    """`shape` of several meters' lies, (n, k)."""
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
    """Which lies, (n, k), grow; by means over equal parts of what was heard."""
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
    # What is left must be small against what has grown, or this is just a wild lie.
    return np.asarray(lasting & (np.sqrt(least / count) < _LEFT * np.abs(grown)))


@cache
def _ramps(n: int) -> tuple[Floats, Floats, Ints]:
    """All ramps from 0 to 1 over n bins, less their means and of size 1; their sizes, and bins they last."""
    begin, end = np.triu_indices(n, 1)
    at = np.arange(n)
    ramps = np.clip((at - begin[:, None]) / (end - begin)[:, None], 0.0, 1.0)
    ramps -= ramps.mean(axis=1, keepdims=True)
    size = np.linalg.norm(ramps, axis=1)
    return ramps / size[:, None], size, np.asarray(end - begin)


def _together(shapes: Shapes, memory: Memory, since: Ints, variance: Floats) -> Bools:
    """Named meters whose lies are one load's trace."""
    named = since >= 0
    who = indices(named)
    if who.size < 2:  # one meter has no story to share
        return np.zeros_like(named)
    # From when all of them are named; evidence is a tick older than a name.
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
    """Whether several meters' lies are the trace of one customer's load, rather than anything else.

    The lies must be proportional to a column of 2R or 2X within their errors; the meters must be among
    those that this load affects most, twice their number at most, since it is these a consistent story
    needs; and one constant for all must fit worse by more than the number of columns explains.

    Parameters
    ----------
    traces
        Columns of 2R and 2X.
    who : (k,)
        The meters.
    lies : (k,)
        Readings minus reconstruction, squared pu.
    variance : (k,)
        Of them.
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
        # In three phases a load lowers its own phase and moves the others either way: how much counts.
        felt = np.abs(traces.trace(k))
        weakest = felt[who].min()
        # Meters beyond the same branch feel it alike: only those that feel more are counted.
        if weakest > 0.0 and np.count_nonzero(felt > weakest * (1.0 + _SAME)) <= 2 * who.size:
            return True
    return False


@cache
def _quantile(freedom: int) -> float:
    """Misfit that the right trace exceeds with a probability of 1 %."""
    return float(chdtri(freedom, 0.01))
