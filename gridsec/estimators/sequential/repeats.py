"""Meters that repeat themselves: stuck ones, and such that play an earlier stretch again.

A reading is ``round((v + n) / step)`` with white jitter n of standard deviation sigma. Whatever the voltage
does and whatever was read before, the next reading equals any given number with a probability of at most

    P(step) = erf(step / (2 sqrt(2) sigma))

so k coincidences in a row with the previous reading (stuck), or with the reading one fixed lag earlier
(replay), have a probability of at most P^k. That is evidence once it is so small that all meters, ticks
and, for a replay, lags of a year together see it less often than the false-alarm rate says.

Meters may be calmer than their data sheets promise. Among n readings the data sheet expects runs of L with
``n P^L`` at most; a meter whose longest run has less than e^-5 of that is judged by that run, as if it
were the longest of twenty: ``P^L = 1 / 20``, since readings near the edge of a step end many runs and say
little of those in its middle. A meter is judged after the first minutes, when that is known; one without
promised jitter is never judged.

Every tick costs O(p): a hash of the last readings is compared with one block of the past; blocks take
turns. A hit is verified reading by reading.

References
----------
docs/theory-sequential.md, "What a manipulation looks like".
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
"""Blocks that are kept: a little more than an hour at one reading per second."""

BYTES = 16
"""What one meter's tick costs."""

MOST_BYTES = 48e6
"""What the past may cost: very many meters are remembered for less long."""

SPAN = 32
"""Ticks that a hash covers: one bit leaves it with every tick."""

SILENT = np.iinfo(np.int32).min
"""Code of a tick without a reading."""

# Fewer repetitions than this are no evidence whatever their probability: readings may be sent twice.
_FEWEST = 6
# Time after which a meter's own longest run says something, s, and fewest readings.
_KNOWN_S, _KNOWN = 300.0, 16
# Squared readings above are all alike: codes must fit their integers.
_HIGHEST = 1e6
# A run this unlikely by the data sheet shows a calm meter; it then counts as the longest of e^3.
_UNLIKELY, _FEW_RUNS = 5.0, 3.0
# Readings without a register step are compared on this grid, pu.
_FINEST = 1e-6
# A good multiplier for hashes: 2^32 over the golden ratio.
_ODD, _HALF, _ONE = np.uint32(0x9E3779B1), np.uint32(16), np.uint32(1)
# Hits that are verified at one tick.
_VERIFIED = 4


@dataclass(frozen=True, slots=True, eq=False)
class Rules:
    """When repetition is evidence. p meters.

    Attributes
    ----------
    step : (p,)
        Step of each register, pu.
    surprise : (p,)
        ``-log P``: how little one repetition is expected of each meter.
    stuck, replay
        Surprise that makes a run, or a repeated stretch, evidence.
    known
        Readings after which a meter is judged.
    """

    step: Floats
    surprise: Floats
    stuck: float
    replay: float
    known: int


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive ticks of the past. p meters.

    Attributes
    ----------
    code : (ROWS, p)
        Readings in steps of the register; SILENT where there was none.
    hash : (ROWS, p)
        Of the SPAN ticks that end here.
    model : (ROWS, p)
        Squared voltage that the others' reconstruction gives each meter, squared pu.
    own : (ROWS, p)
        What each meter's own reported powers contribute to that, squared pu.
    """

    code: _Codes
    hash: _Hashes
    model: NDArray[np.float32]
    own: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """What is remembered of the readings. p meters.

    Attributes
    ----------
    tick
        Number of the newest tick, from 0; -1 before the first.
    kept
        Number after that of the newest tick in the past.
    code : (p,)
        Last reading of each meter, steps.
    now : (p,)
        The same at the newest tick, SILENT where there was none.
    hash : (p,)
        Of the last SPAN ticks.
    count : (p,)
        Readings heard.
    run : (p,)
        How often the last reading was repeated so far.
    longest : (p,)
        Longest run that was no evidence.
    stuck : (p,)
        Evidence that the meter is stuck.
    lag : (p,)
        Ticks after which the meter repeats itself, with evidence; 0 for none.
    blocks
        The past, oldest first; at most BLOCKS, fewer where that would be more than MOST_BYTES.
    tail
        Rows (code, hash, model, own) after the last whole block.
    """

    tick: int
    kept: int
    code: _Codes
    now: _Codes
    hash: _Hashes
    count: Ints
    run: Ints
    longest: Ints
    stuck: Bools
    lag: Ints
    blocks: tuple[Block, ...]
    tail: tuple[tuple[_Codes, _Hashes, NDArray[np.float32], NDArray[np.float32]], ...]

    @property
    def first(self) -> int:
        """Number of the oldest tick kept."""
        return self.kept - len(self.tail) - ROWS * len(self.blocks)


def forget(memory: Memory, meters: Bools) -> Memory:
    """Forget how calm some meters were, and that they repeated themselves.

    Parameters
    ----------
    memory
        So far; not changed.
    meters : (p,)
        Which.
    """
    none = ~meters
    return replace(
        memory,
        count=memory.count * none,
        run=memory.run * none,
        longest=memory.longest * none,
        stuck=memory.stuck & none,
        lag=memory.lag * none,
    )


def rules(resolution: Floats, jitter: Floats, chance: float, step_s: float) -> Rules:
    """When repetition is evidence.

    Parameters
    ----------
    resolution : (p,)
        Step of each register, pu.
    jitter : (p,)
        Standard deviation of the jitter, pu.
    chance
        Probability, per meter and tick, that honest readings may become evidence of one kind.
    step_s
        Expected time between readings, s.
    """
    step = np.maximum(resolution, _FINEST)
    with np.errstate(divide="ignore"):
        once = erf(step / (np.sqrt(8.0) * jitter))
        surprise = 0.0 - np.log(once)
    budget = -float(np.log(chance))
    return Rules(
        step=step,
        surprise=surprise,
        stuck=budget,
        replay=budget + float(np.log(ROWS * BLOCKS)),
        known=max(_KNOWN, int(np.ceil(_KNOWN_S / step_s))),
    )


def empty(meters: int) -> Memory:
    """Nothing remembered.

    Parameters
    ----------
    meters
        p.
    """
    silent = np.full(meters, SILENT, dtype=np.int32)
    zero = np.zeros(meters, dtype=np.intp)
    no = np.zeros(meters, dtype=np.bool_)
    return Memory(
        -1, 0, silent, silent, np.zeros(meters, dtype=np.uint32), zero, zero, zero, no, zero, (), ()
    )


def listen(law: Rules, before: Memory, y: Floats, live: Bools) -> Memory:
    """Take one tick's readings in. `keep` has to follow before the next.

    Parameters
    ----------
    law
        When repetition is evidence.
    before
        So far; not changed.
    y : (p,)
        Squared readings, pu; any finite numbers where not live.
    live : (p,)
        Where there is a reading.
    """
    tick = before.tick + 1
    code = now = told = np.rint(np.sqrt(np.minimum(np.maximum(y, 0.0), _HIGHEST)) / law.step).astype(np.int32)
    same = code == before.code
    run, longest = (before.run + same) * same, before.longest
    if not all_of(live):
        run = np.where(live, run, before.run)
        # A silent tick is like no other in the hash.
        told = np.where(live, code, np.int32(tick % 2**31))
        now, code = np.where(live, code, np.int32(SILENT)), np.where(live, code, before.code)
    # Rare, so only looked at where there is something to see.
    longer = before.run > longest
    if any_of(longer):
        longest = np.where(longer & (run == 0) & ~before.stuck, before.run, longest)
    count, stuck = before.count + live, run >= _FEWEST
    if any_of(stuck):
        stuck &= (run * _surprise(law, count, longest) >= law.stuck) & (count >= law.known)
    after = Memory(
        tick=tick,
        kept=before.kept,
        code=code,
        now=now,
        hash=_roll(before.hash, told),
        count=count,
        run=run,
        longest=longest,
        stuck=stuck,
        lag=_follow(before, now, tick),
        blocks=before.blocks,
        tail=before.tail,
    )
    return _search(law, after)


def keep(memory: Memory, model: Floats, own: Floats) -> Memory:
    """Remember the tick that was just heard, with what the others say of it.

    Parameters
    ----------
    memory
        From `listen`.
    model : (p,)
        Squared voltage that the others' reconstruction gives each meter, squared pu.
    own : (p,)
        What each meter's own reported powers contribute to that, squared pu.
    """
    tail = (*memory.tail, (memory.now, memory.hash, model.astype(np.float32), own.astype(np.float32)))
    if len(tail) < ROWS:
        return changed(memory, kept=memory.kept + 1, tail=tail)
    block = Block(*(np.stack(rows) for rows in zip(*tail, strict=True)))
    blocks = (*memory.blocks, block)[-_kept(memory.now.size) :]
    return changed(memory, kept=memory.kept + 1, blocks=blocks, tail=())


def _kept(meters: int) -> int:
    """How many blocks are kept."""
    return int(min(BLOCKS, max(1, MOST_BYTES // (BYTES * ROWS * max(meters, 1)))))


def lags(memory: Memory) -> Ints:
    """Ticks after which each meter repeats itself beyond chance, (p,): 1 for a stuck one, 0 for the others.

    Parameters
    ----------
    memory
        From `listen`.
    """
    return np.where(memory.stuck, 1, memory.lag)


def unnoticed(law: Rules, lag: Ints) -> Ints:
    """For how many readings a meter may repeat itself until that is noticed, from an empty memory, (p,).

    A calm meter takes longer than its data sheet says: twice as long is granted.

    Parameters
    ----------
    law
        When repetition is evidence.
    lag : (p,)
        Ticks after which each repeats itself, 1 for a stuck one; 0 for those that do not.
    """
    replays, judged = lag > 1, np.maximum(law.surprise, np.finfo(np.float64).tiny)
    run = np.where(replays, np.maximum(np.ceil(law.replay / judged), SPAN), np.ceil(law.stuck / judged))
    # What is repeated has to be in a whole block, and these take turns.
    past = np.where(replays, lag + ROWS + lag // ROWS + 2, 0)
    most = np.minimum(np.maximum(law.known, past) + 2.0 * run, ROWS * BLOCKS)
    return np.where(lag > 0, most, 0).astype(np.intp)


def past(memory: Memory, meter: int | Ints, start: int, stop: int) -> tuple[Floats, Floats]:
    """Readings, in steps, and models of one meter, or some, at the ticks start to stop - 1.

    Parameters
    ----------
    memory
        From `keep`.
    meter
        Which.
    start, stop
        Numbers of ticks, ``memory.first <= start < stop <= memory.kept``.

    Returns
    -------
    code, model : (stop - start, …)
        Readings are NaN where there was none.
    """
    code, model = (_column(memory, name, meter, start, stop).astype(np.float64) for name in ("code", "model"))
    code[code == SILENT] = np.nan
    return code, model


def own_part(memory: Memory, meter: int) -> Floats:
    """What the own powers of a meter contributed to its models at all ticks that are kept, squared pu, (n,).

    Parameters
    ----------
    memory, meter
        As in `past`.
    """
    return _column(memory, "own", meter, memory.first, memory.kept).astype(np.float64)


def recurring(code: Floats) -> int:
    """How many of the last readings are an earlier stretch, without a difference between, at the best lag.

    Parameters
    ----------
    code : (n,)
        Readings, NaN where there was none.

    Returns
    -------
    int
        Pairs of which one reading is missing are passed over; at most SPAN are counted.
    """
    lags = np.arange(1, code.size)
    count, best = np.zeros(lags.size, dtype=np.intp), 0
    for newest in range(code.size - 1, 0, -1):
        heard = lags <= newest
        lags, count = lags[heard], count[heard]
        if not lags.size or best >= SPAN:
            break
        old = code[newest - lags]
        differ = (old != code[newest]) & np.isfinite(old) & np.isfinite(code[newest])
        count = count + (old == code[newest])
        best = max(best, int(count.max()))
        lags, count = lags[~differ], count[~differ]
    return best


def surprise(law: Rules, memory: Memory) -> Floats:
    """How little one repetition is expected of each meter, by its data sheet and its past, (p,).

    Parameters
    ----------
    law
        When repetition is evidence.
    memory
        What is known of the meters.
    """
    return _surprise(law, memory.count, memory.longest)


def _surprise(law: Rules, count: Ints, longest: Ints) -> Floats:
    """What the data sheet says, or, where the meter is calmer than that, what its longest run does; (p,)."""
    calm = longest * law.surprise > np.log(np.maximum(count, 1)) + _UNLIKELY
    return np.where(calm, np.minimum(_FEW_RUNS / np.maximum(longest, 1), law.surprise), law.surprise)


def _roll(before: _Hashes, told: _Codes) -> _Hashes:
    """Hash of the last SPAN ticks: older ones have been shifted out (a gear hash)."""
    mixed = told.view(np.uint32) * _ODD
    mixed ^= mixed >> _HALF
    return (before << _ONE) + mixed


def _follow(before: Memory, now: _Codes, tick: int) -> Ints:
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


def _search(law: Rules, memory: Memory) -> Memory:
    """Look for the newest stretch in one block of the past."""
    if not memory.blocks:
        return memory
    turn = memory.tick % len(memory.blocks)
    hit = memory.blocks[turn].hash == memory.hash
    if not any_of(hit):
        return memory
    rows, meters = np.nonzero(hit)
    ask = (memory.lag == 0) & (memory.now != SILENT) & (memory.run < SPAN) & (memory.count >= law.known)
    with np.errstate(divide="ignore"):
        need = np.maximum(np.ceil(law.replay / _surprise(law, memory.count, memory.longest)), _FEWEST)
    ask &= need <= ROWS * BLOCKS // 2
    wanted = indices(ask[meters])
    begin = memory.first + ROWS * turn
    lag = memory.lag.copy()
    for k in np.roll(wanted, -memory.tick)[:_VERIFIED].tolist():
        j, back = int(meters[k]), memory.tick - begin - int(rows[k])
        if repeated(memory, j, back, int(need[j])) >= need[j]:
            lag[j] = back
    return replace(memory, lag=lag)


def repeated(memory: Memory, meter: int, lag: int, most: int) -> int:
    """How many of a meter's last readings equal those one lag earlier, without a difference between.

    Parameters
    ----------
    memory
        From `listen`, before `keep`.
    meter
        Which.
    lag
        Ticks, >= 1.
    most
        Ticks to look back at most, the newest included.

    Returns
    -------
    int
        Pairs of which one reading is missing are passed over.
    """
    # The missing ones have to be made up for.
    start = max(memory.tick + 1 - 2 * most, memory.first + lag)
    if start > memory.tick:
        return 0
    new = memory.now[meter : meter + 1]
    if start < memory.tick:
        new = np.append(_column(memory, "code", meter, start, memory.tick), new)
    old = _column(memory, "code", meter, start - lag, memory.tick - lag + 1)
    both = (new != SILENT) & (old != SILENT)
    differ = indices(both & (new != old))
    return int(np.count_nonzero(both[differ[-1] + 1 if differ.size else 0 :]))


def _column(memory: Memory, name: str, meter: int | Ints, start: int, stop: int) -> NDArray[Any]:
    """One meter's past, or some meters', at the ticks start to stop - 1, from the blocks and the tail."""
    place, one = ("code", "hash", "model", "own").index(name), isinstance(meter, int)
    begin, tail = memory.first, memory.kept - len(memory.tail)
    skip, last = (start - begin) // ROWS, (stop - 1 - begin) // ROWS
    parts = [getattr(block, name)[:, meter] for block in memory.blocks[skip : last + 1]]
    skipped = begin + ROWS * skip if parts else start
    if stop > tail:
        rows = [row[place] for row in memory.tail[max(start - tail, 0) : stop - tail]]
        parts.append(np.array([row[meter] for row in rows]) if one else np.array(rows)[:, meter])
    return np.concatenate(parts)[start - skipped : stop - skipped]
