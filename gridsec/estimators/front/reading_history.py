"""History of the meters' readings: repeated readings of stuck meters and replays.

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

References
----------
docs/theory-front.md, section 8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, changed, indices

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
