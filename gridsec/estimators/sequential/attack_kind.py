"""Kind of a manipulation: stuck, replayed, of another time, one load's trace, drifting, constant.

Stuck and replaying meters are evidence of their own. The last readings of named meters are compared with
their predictions by the *other* meters, in this order:

    replay         the last readings are an earlier stretch, reading by reading
    clock shift    y(t) = v2(t - lag):  reading and reconstruction agree at another time, level included
    drift          y(t) - v2(t) is a ramp, and no step explains it nearly as well
    offset         y(t) - v2(t) is a constant, perhaps after a step
    coordinated    the offsets of several meters are those that one customer's load would leave

None where nothing fits: an attack without a kind is still an attack.

A reading is ``round((v + n) / step)`` with white jitter n of standard deviation sigma. For every voltage and
every history the next reading equals a given number with a probability of at most

    P(step) = erf(step / (2 sqrt(2) sigma))

so k coincidences in a row with the previous reading (stuck), or with the reading one fixed lag earlier
(replay), have a probability of at most P^k. They are evidence where all meters, ticks and, for a replay, lags
of a year together see them less often than the false-alarm rate.

Meters may be calmer than their data sheets. Among n readings the data sheet expects runs of L with ``n P^L``
at most; a meter with a longest run of less than e^-5 of that is tested by that run as if it were the longest
of twenty: ``P^L = 1 / 20``, since readings near the edge of a step end many runs. Tests start after the first
minutes; a meter without stated jitter is never tested.

Every tick costs O(p): a hash of the last readings is compared with one block of the past, and blocks take
turns. A hit is verified reading by reading.

With a clock shift either the voltage alone is late, or all data of the meter. In the second case the
reconstruction at time t rests on a power of time t - lag as well. Its part in the meter's own voltage,
``own = 2 R_jj p_j + 2 X_jj q_j`` to first order, belongs to the reading:

    y(t)          = v2(t - lag)                   the voltage alone,
    y(t) - own(t) = v2(t - lag) - own(t - lag)    the whole meter.

References
----------
docs/theory-sequential.md, "What a manipulation looks like".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, erf

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed, indices
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


@cache
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


# --- Repeated readings ---


_Codes: TypeAlias = NDArray[np.int32]


_Hashes: TypeAlias = NDArray[np.uint32]


ROWS = 64
"""Ticks of one block of the past."""


BLOCKS = 60
"""Number of kept blocks: a little more than an hour at one reading per second."""


BYTES = 16
"""Memory of one meter's tick, bytes."""


MOST_BYTES = 48e6
"""Largest memory of the history, bytes; more meters have a shorter history."""


SPAN = 32
"""Ticks that a hash covers: one bit leaves it with every tick."""


SILENT = np.iinfo(np.int32).min
"""Code of a tick without a reading."""


_FEWEST = 6
"""Fewest repetitions that are evidence: readings may be sent twice."""


_KNOWN_S, _KNOWN = 300.0, 16
"""Time, s, and fewest readings before a meter's longest run is used."""


_HIGHEST = 1e6
"""Largest distinguished squared reading: codes must fit their integers."""


_UNLIKELY, _FEW_RUNS = 5.0, 3.0
"""Surprise of a run that shows a calm meter; it then counts as the longest of e^3."""


_FINEST = 1e-6
"""Grid of readings without a register step, pu."""


# Multiplier of the hash: 2^32 over the golden ratio.
_ODD, _HALF, _ONE = np.uint32(0x9E3779B1), np.uint32(16), np.uint32(1)


_VERIFIED = 4
"""Hits verified at one tick."""


@dataclass(frozen=True, slots=True, eq=False)
class RepeatLimits:
    """Limits of repetition. p meters."""

    step: Floats  # (p,) step of each register, pu
    surprise: Floats  # (p,) ``-log P`` of one repetition
    stuck: float  # surprise of a run that is evidence
    replay: float  # surprise of a repeated stretch that is evidence
    known: int  # readings before a meter is tested


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """ROWS consecutive ticks of the past. p meters."""

    code: _Codes  # (ROWS, p) readings in steps of the register; SILENT without a reading
    hash: _Hashes  # (ROWS, p) of the SPAN ticks that end here
    model: NDArray[np.float32]  # (ROWS, p) reconstruction by the other meters, squared pu
    own: NDArray[np.float32]  # (ROWS, p) part of that by the meter's own reported powers, squared pu


@dataclass(frozen=True, slots=True, eq=False)
class ReadingHistory:
    """History of the readings. p meters."""

    tick: int  # number of the newest tick, from 0; -1 before the first
    kept: int  # number after that of the newest tick in the past
    code: _Codes  # (p,) last reading of each meter, steps
    now: _Codes  # (p,) the same at the newest tick, SILENT without a reading
    hash: _Hashes  # (p,) of the last SPAN ticks
    count: Ints  # (p,) number of readings
    run: Ints  # (p,) repetitions of the last reading so far
    longest: Ints  # (p,) longest run that was not evidence
    stuck: Bools  # (p,) evidence of a stuck meter
    lag: Ints  # (p,) ticks after which the meter repeats itself, with evidence; 0 for none
    blocks: tuple[Block, ...]  # the past, oldest first; at most BLOCKS and MOST_BYTES
    tail: tuple[
        tuple[_Codes, _Hashes, NDArray[np.float32], NDArray[np.float32]], ...
    ]  # rows after the last whole block

    @property
    def first(self) -> int:
        """Number of the oldest tick kept."""
        return self.kept - len(self.tail) - ROWS * len(self.blocks)


def forget_readings(history: ReadingHistory, meters: Bools) -> ReadingHistory:
    """History without the statistics and repetitions of some meters, (p,)."""
    none = ~meters
    return replace(
        history,
        count=history.count * none,
        run=history.run * none,
        longest=history.longest * none,
        stuck=history.stuck & none,
        lag=history.lag * none,
    )


def repeat_limits(resolution: Floats, jitter: Floats, chance: float, step_s: float) -> RepeatLimits:
    """Limits of repetition.

    resolution, jitter: (p,) register step and standard deviation of the jitter, pu. chance: probability per
    meter and tick that honest readings become evidence of one kind.
    """
    step = np.maximum(resolution, _FINEST)
    with np.errstate(divide="ignore"):
        once = erf(step / (np.sqrt(8.0) * jitter))
        surprise = 0.0 - np.log(once)
    budget = -float(np.log(chance))
    return RepeatLimits(
        step=step,
        surprise=surprise,
        stuck=budget,
        replay=budget + float(np.log(ROWS * BLOCKS)),
        known=max(_KNOWN, int(np.ceil(_KNOWN_S / step_s))),
    )


def no_history(meters: int) -> ReadingHistory:
    """History before the first tick."""
    silent = np.full(meters, SILENT, dtype=np.int32)
    zero = np.zeros(meters, dtype=np.intp)
    no = np.zeros(meters, dtype=np.bool_)
    return ReadingHistory(
        -1, 0, silent, silent, np.zeros(meters, dtype=np.uint32), zero, zero, zero, no, zero, (), ()
    )


def record_readings(
    limits: RepeatLimits, before: ReadingHistory, y: Floats, available: Bools
) -> ReadingHistory:
    """History with the readings y (p,), squared pu, of one tick; `store` has to follow before the next."""
    tick = before.tick + 1
    steps = np.sqrt(np.minimum(np.maximum(y, 0.0), _HIGHEST))
    steps /= limits.step
    code = now = hashed = np.rint(steps, out=steps).astype(np.int32)
    same = code == before.code
    run, longest = before.run + same, before.longest
    run *= same
    if not all_of(available):
        run = np.where(available, run, before.run)
        # A silent tick has a code of its own in the hash.
        hashed = np.where(available, code, np.int32(tick % 2**31))
        now, code = np.where(available, code, np.int32(SILENT)), np.where(available, code, before.code)
    # Rare, hence the test first.
    longer = before.run > longest
    if any_of(longer):
        longest = np.where(longer & (run == 0) & ~before.stuck, before.run, longest)
    count, stuck = before.count + available, run >= _FEWEST
    if any_of(stuck):
        stuck &= (run * _surprise(limits, count, longest) >= limits.stuck) & (count >= limits.known)
    after = ReadingHistory(
        tick=tick,
        kept=before.kept,
        code=code,
        now=now,
        hash=_rolled(before.hash, hashed),
        count=count,
        run=run,
        longest=longest,
        stuck=stuck,
        lag=_continued_lags(before, now, tick),
        blocks=before.blocks,
        tail=before.tail,
    )
    return _find_repeats(limits, after)


def store(history: ReadingHistory, model: Floats, own: Floats) -> ReadingHistory:
    """History with the tick last ingested, its reconstruction and the own part of that, (p,), squared pu."""
    tail = (*history.tail, (history.now, history.hash, model.astype(np.float32), own.astype(np.float32)))
    if len(tail) < ROWS:
        return changed(history, kept=history.kept + 1, tail=tail)
    block = Block(*(np.stack(rows) for rows in zip(*tail, strict=True)))
    blocks = (*history.blocks, block)[-_max_blocks(history.now.size) :]
    return changed(history, kept=history.kept + 1, blocks=blocks, tail=())


def _max_blocks(meters: int) -> int:
    """Number of blocks that are kept."""
    return int(min(BLOCKS, max(1, MOST_BYTES // (BYTES * ROWS * max(meters, 1)))))


def verified_lags(history: ReadingHistory) -> Ints:
    """Ticks after which each meter repeats itself beyond chance, (p,): 1 if stuck, 0 for none."""
    return np.where(history.stuck, 1, history.lag)


def detection_readings(limits: RepeatLimits, lag: Ints) -> Ints:
    """Readings until a repetition with lag (p,) is detected from an empty history, (p,).

    A calm meter takes longer than its data sheet states: twice the time is granted.
    """
    replays, loo = lag > 1, np.maximum(limits.surprise, np.finfo(np.float64).tiny)
    run = np.where(replays, np.maximum(np.ceil(limits.replay / loo), SPAN), np.ceil(limits.stuck / loo))
    # The repeated stretch has to be in a whole block, and blocks take turns.
    past = np.where(replays, lag + ROWS + lag // ROWS + 2, 0)
    most = np.minimum(np.maximum(limits.known, past) + 2.0 * run, ROWS * BLOCKS)
    return np.where(lag > 0, most, 0).astype(np.intp)


def past(history: ReadingHistory, meter: int | Ints, start: int, stop: int) -> tuple[Floats, Floats]:
    """Readings in steps, NaN if missing, and models of one meter or some, at ticks start to stop - 1."""
    code, model = (
        _column(history, name, meter, start, stop).astype(np.float64) for name in ("code", "model")
    )
    code[code == SILENT] = np.nan
    return code, model


def own_part(history: ReadingHistory, meter: int) -> Floats:
    """Part of the models by a meter's own powers at all kept ticks, squared pu, (n,)."""
    return _column(history, "own", meter, history.first, history.kept).astype(np.float64)


def recurring(code: Floats) -> int:
    """Number of last readings, (n,), that repeat an earlier stretch without a difference, at the best lag.

    Pairs with a missing reading are passed over; at most SPAN are counted.
    """
    lags = np.arange(1, code.size)
    count, best = np.zeros(lags.size, dtype=np.intp), 0
    for newest in range(code.size - 1, 0, -1):
        within = lags <= newest
        lags, count = lags[within], count[within]
        if not lags.size or best >= SPAN:
            break
        old = code[newest - lags]
        differ = (old != code[newest]) & np.isfinite(old) & np.isfinite(code[newest])
        count = count + (old == code[newest])
        best = max(best, int(count.max()))
        lags, count = lags[~differ], count[~differ]
    return best


def surprise(limits: RepeatLimits, history: ReadingHistory) -> Floats:
    """Surprise of one repetition by each meter's data sheet and past, (p,)."""
    return _surprise(limits, history.count, history.longest)


def _surprise(limits: RepeatLimits, count: Ints, longest: Ints) -> Floats:
    """The data sheet's, or, for a calmer meter, that of its longest run; (p,)."""
    calm = longest * limits.surprise > np.log(np.maximum(count, 1)) + _UNLIKELY
    return np.where(calm, np.minimum(_FEW_RUNS / np.maximum(longest, 1), limits.surprise), limits.surprise)


def _rolled(before: _Hashes, hashed: _Codes) -> _Hashes:
    """Hash of the last SPAN ticks: older ones have been shifted out (a gear hash)."""
    mixed = hashed.view(np.uint32) * _ODD
    mixed ^= mixed >> _HALF
    return (before << _ONE) + mixed


def _continued_lags(before: ReadingHistory, now: _Codes, tick: int) -> Ints:
    """Lags at which meters still repeat themselves."""
    if not any_of(before.lag):
        return before.lag
    lag = before.lag.copy()
    for j in indices(lag).tolist():
        at = tick - int(lag[j])
        if at < before.first:
            lag[j] = 0
            continue
        (then,) = _column(before, "code", j, at, at + 1).tolist()
        if SILENT not in (then, int(now[j])) and then != now[j]:
            lag[j] = 0
    return lag


def _find_repeats(limits: RepeatLimits, history: ReadingHistory) -> ReadingHistory:
    """History with repetitions of the newest stretch found in one block of the past."""
    if not history.blocks:
        return history
    turn = history.tick % len(history.blocks)
    hit = history.blocks[turn].hash == history.hash
    if not any_of(hit):
        return history
    rows, meters = np.nonzero(hit)
    ask = (
        (history.lag == 0) & (history.now != SILENT) & (history.run < SPAN) & (history.count >= limits.known)
    )
    with np.errstate(divide="ignore"):
        need = np.maximum(np.ceil(limits.replay / _surprise(limits, history.count, history.longest)), _FEWEST)
    ask &= need <= ROWS * BLOCKS // 2
    wanted = indices(ask[meters])
    begin = history.first + ROWS * turn
    lag = history.lag.copy()
    for k in np.roll(wanted, -history.tick)[:_VERIFIED].tolist():
        j, back = int(meters[k]), history.tick - begin - int(rows[k])
        if matching_readings(history, j, back, int(need[j])) >= need[j]:
            lag[j] = back
    return replace(history, lag=lag)


def matching_readings(history: ReadingHistory, meter: int, lag: int, most: int) -> int:
    """Number of a meter's last readings that equal those one lag earlier without a difference between.

    most: largest number of ticks to look back. Pairs with a missing reading are passed over.
    """
    # Twice as many ticks make up for missing readings.
    start = max(history.tick + 1 - 2 * most, history.first + lag)
    if start > history.tick:
        return 0
    new = history.now[meter : meter + 1]
    if start < history.tick:
        new = np.append(_column(history, "code", meter, start, history.tick), new)
    old = _column(history, "code", meter, start - lag, history.tick - lag + 1)
    both = (new != SILENT) & (old != SILENT)
    differ = indices(both & (new != old))
    return int(np.count_nonzero(both[differ[-1] + 1 if differ.size else 0 :]))


def _column(history: ReadingHistory, name: str, meter: int | Ints, start: int, stop: int) -> NDArray[Any]:
    """Past of one meter or some at ticks start to stop - 1, from the blocks and the tail."""
    place, one = ("code", "hash", "model", "own").index(name), isinstance(meter, int)
    begin, tail = history.first, history.kept - len(history.tail)
    skip, last = (start - begin) // ROWS, (stop - 1 - begin) // ROWS
    parts = [getattr(block, name)[:, meter] for block in history.blocks[skip : last + 1]]
    skipped = begin + ROWS * skip if parts else start
    if stop > tail:
        rows = [row[place] for row in history.tail[max(start - tail, 0) : stop - tail]]
        parts.append(np.array([row[meter] for row in rows]) if one else np.array(rows)[:, meter])
    return np.concatenate(parts)[start - skipped : stop - skipped]


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
