"""Rows of the history, their selection and roll-ups, and extremes of each bucket of a time series.

A row holds all meters of one kept tick: columns of float32 (NaN for None), then one byte of flags per meter,
compressed. A roll-up holds the extremes of all rows of `ROLLUP_S`. A series merges rows, or roll-ups and the
rows after them, to buckets. The cost of fourteen days is that of their roll-ups, about 10 000.

Both merge to the same numbers: a roll-up is itself the result of `merge`.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.interface import Decision
from service.report.report import BUSBAR, HISTORY_COLUMNS, HistoryRow, Marked, finite

# --- Rows ---

_VERSION_1: Final = HISTORY_COLUMNS[:4]
_COLUMNS: Final = HISTORY_COLUMNS
_VERSION: Final = b"\x02"
"""First byte of a row. A row of version 1 has none, and begins with zlib's 0x78."""
_SEEN, _SUSPECT, _MODEL_ONLY = 1, 2, 4
_REPORTED, _ESTIMATED, _STD = (_COLUMNS.index(f"v_volt_{name}") for name in ("reported", "estimated", "std"))


def pack(row: HistoryRow) -> bytes:
    """Pack the meters of a tick: five float32 columns, then one byte of flags each."""
    seen, suspect, model_only = row.flags.astype(np.uint8)
    flags = _SEEN * seen | _SUSPECT * suspect | _MODEL_ONLY * model_only
    return _VERSION + zlib.compress(row.values.astype("<f4").tobytes() + flags.tobytes(), 6)


def _opened(data: bytes) -> tuple[bytes, int]:
    """Return the bytes of a row and its number of columns."""
    if data.startswith(_VERSION):
        return zlib.decompress(data[1:]), len(_COLUMNS)
    return zlib.decompress(data), len(_VERSION_1)


def unpack(data: bytes, meters: Sequence[str], only: str | None = None) -> dict[str, Any]:
    """Return the values of a kept row for the feeder and, on request, for one of its meters.

    `meters` are the ids of the row's meters, in order; `only` is the requested meter. Returns `seen` (number
    of meters), `suspects`, `v_volt_lowest`, `v_volt_highest`, `model_only`, and `meter`: its fields as in
    REST's `state`, or None. The busbar meter may be among the suspects; `seen` and the extremes leave it out.
    The extremes leave out model-only values; rows of earlier versions mark none. A row of version 1 has no
    standard deviation.
    """
    raw, columns = _opened(data)
    size = len(meters)
    table = np.frombuffer(raw, dtype="<f4", count=columns * size).reshape(columns, size)
    flags = np.frombuffer(raw, dtype=np.uint8, offset=4 * columns * size)
    volts = table[_ESTIMATED]
    others = np.array([meter != BUSBAR for meter in meters], dtype=np.bool_)
    alone = (flags & _MODEL_ONLY) > 0
    volts = volts[np.isfinite(volts) & others & ~alone]
    one = None
    if only in meters:
        k = meters.index(only)
        numbers = [_short(float(value)) for value in table[:, k]]
        one = {
            "meter": only,
            "seen": bool(flags[k] & _SEEN),
            "suspect": bool(flags[k] & _SUSPECT),
            **dict(zip(_COLUMNS, numbers + [None] * (len(_COLUMNS) - columns), strict=True)),
            "model_only": bool(alone[k]),
        }
    return {
        "seen": int(np.count_nonzero((flags & _SEEN) * others)),
        "suspects": [meters[int(k)] for k in np.flatnonzero(flags & _SUSPECT)],
        "v_volt_lowest": _short(float(volts.min())) if volts.size else None,
        "v_volt_highest": _short(float(volts.max())) if volts.size else None,
        "model_only": bool(alone.size and alone.all()),
        "meter": one,
    }


def _short(value: float) -> float | None:
    """Return a single-precision number without insignificant digits."""
    return finite(float(f"{value:.7g}"))


# --- Buckets ---

ROLLUP_S: Final = 120.0
"""Duration of a roll-up, s: 24 hours have 720, one per pixel column."""
ROWS_S: Final = 6 * 3600.0
"""Longest series that is merged from rows, s; a longer one uses roll-ups."""
MAX_ROWS: Final = 25_000
"""Largest number of rows of one series, 60 MB at 146 meters: those of `ROWS_S` at one row per second."""
LONGEST_S: Final = 15 * 86400.0
"""Longest series, s."""
BAND_STD: Final = 3.0
"""Half-width of the uncertainty band in standard deviations, as in the alarms of voltage limits."""
VERDICTS: Final = (Decision.CLEAN, Decision.ATTACKED, Decision.UNDECIDED)
"""Order of the columns of `Buckets.verdict_s`."""
EXTREMES: Final = tuple(
    f"v_volt_{value}_{end}" for value in ("reported", "estimated", "band") for end in ("min", "max")
)
"""Order of the columns of `Buckets.extremes`, V."""
STEPS_S: Final = (1, 2, 5, 10, 20, 30, 60, 120, 240, 360, 600, 1200, 1800, 2400, 3600, 7200, 14400, 43200)
"""Durations of a bucket, s. From 120 s on they are multiples of `ROLLUP_S`."""
_AT_ONCE: Final = 2000
"""Number of rows that are decoded together: 6 MB at 146 meters."""


@dataclass(frozen=True, slots=True, eq=False)
class Buckets:
    """Extremes of n buckets and k meters, in order of time; a bucket without a stored tick is left out.

    t (n,): beginning, Unix s.
    ticks (n,): number of stored ticks.
    verdict_s (n, 3): time of each of `VERDICTS`, s: from each stored tick to the next one, at most to the end
        of its bucket and of its `ROLLUP_S`.
    extremes (n, 6, k): `EXTREMES` of each meter, V, float32; NaN without a value. Model-only values are left
        out.
    flags (n, k): bits of the meter in any tick: 1 seen, 2 suspect, 4 model only.
    """

    t: Floats
    ticks: Floats
    verdict_s: Floats
    extremes: Any
    flags: Any

    @property
    def seen(self) -> Bools:
        """Meters with a usable reading in the bucket, (n, k)."""
        return np.asarray((self.flags & _SEEN) > 0, dtype=np.bool_)

    @property
    def suspect(self) -> Bools:
        """Meters that the verdict names at some tick of the bucket, (n, k)."""
        return np.asarray((self.flags & _SUSPECT) > 0, dtype=np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Time series of some meters of a feeder.

    since, until: covered time, extended to whole buckets, Unix s.
    bucket_s: duration of a bucket, s.
    step_s: grid of the stored ticks, s.
    complete: False if older ticks are left out, see `MAX_ROWS`.
    """

    since: float
    until: float
    bucket_s: float
    step_s: float
    meters: tuple[str, ...]
    buckets: Buckets
    complete: bool = True


def bucket_of(window_s: float, most: int) -> float:
    """Return the duration of a bucket: the shortest of `STEPS_S` with at most `most` buckets, s.

    Beyond `ROWS_S` it is at least `ROLLUP_S`.
    """
    least = max(window_s / most, ROLLUP_S if window_s > ROWS_S else 0.0)
    return float(next((step for step in STEPS_S if step >= least), STEPS_S[-1]))


def floor_to(t: float, bucket_s: float) -> float:
    """Return the beginning of the bucket that contains a time, Unix s."""
    return math.floor(t / bucket_s) * bucket_s


def nothing(meters: int) -> Buckets:
    """Return no buckets."""
    none = np.zeros(0)
    return Buckets(
        none,
        none,
        np.zeros((0, 3)),
        np.zeros((0, len(EXTREMES), meters), dtype=np.float32),
        np.zeros((0, meters), dtype=np.uint8),
    )


def of_rows(
    found: Sequence[tuple[float, str, bytes, Sequence[str]]],
    wanted: Sequence[str],
    bucket_s: float,
    until: float,
) -> Buckets:
    """Return rows as buckets of one tick each, for `merge`.

    found: time, verdict, data and meters of each row, in order of time.
    bucket_s: duration of the buckets that `merge` makes next, s.
    until: end of the last tick's verdict, Unix s.
    """
    if not found:
        return nothing(len(wanted))
    t = np.array([row[0] for row in found])
    following = np.append(t[1:], max(until, t[-1]))
    within = min(bucket_s, ROLLUP_S)
    ends = (np.floor(t / within) + 1.0) * within
    lasted = np.minimum(following, ends) - t
    codes = [VERDICTS.index(Decision(row[1])) for row in found]
    verdict_s = np.zeros((t.size, len(VERDICTS)))
    verdict_s[np.arange(t.size), codes] = lasted
    columns = np.full((t.size, len(_COLUMNS), len(wanted)), math.nan, dtype=np.float32)
    flags = np.zeros((t.size, len(wanted)), dtype=np.uint8)
    at = 0
    for meters, same in groupby(found, key=lambda row: row[3]):
        data = [row[2] for row in same]
        for first in range(0, len(data), _AT_ONCE):
            part = data[first : first + _AT_ONCE]
            _decode(part, meters, wanted, columns[at : at + len(part)], flags[at : at + len(part)])
            at += len(part)
    columns[~np.isfinite(columns)] = math.nan
    estimated = np.where(flags & _MODEL_ONLY, np.float32(math.nan), columns[:, _ESTIMATED])
    half = np.float32(BAND_STD) * columns[:, _STD]
    reported = columns[:, _REPORTED]
    extremes = np.stack(
        [reported, reported, estimated, estimated, estimated - half, estimated + half], axis=1
    )
    return Buckets(t, np.ones(t.size), verdict_s, extremes, flags)


def _decode(
    data: Sequence[bytes], meters: Sequence[str], wanted: Sequence[str], columns: Any, flags: Any
) -> None:
    """Write the wanted meters of rows with the same meters to `columns` and `flags`."""
    to, of = _places(meters, wanted)
    size, opened = len(meters), [_opened(each) for each in data]
    for count in {count for _, count in opened}:
        at = [k for k, (_, own) in enumerate(opened) if own == count]
        raw = np.frombuffer(b"".join(opened[k][0] for k in at), dtype=np.uint8).reshape(len(at), -1)
        table = np.ascontiguousarray(raw[:, : 4 * count * size]).view("<f4").reshape(len(at), count, size)
        columns[np.ix_(at, range(count), to)] = table[:, :, of]
        flags[np.ix_(at, to)] = raw[:, 4 * count * size :][:, of]


def _places(meters: Sequence[str], wanted: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the indices of the wanted meters that occur: among the wanted ones, and in the row."""
    index = {meter: k for k, meter in enumerate(meters)}
    found = [(k, index[meter]) for k, meter in enumerate(wanted) if meter in index]
    return [k for k, _ in found], [k for _, k in found]


def _among(each: Buckets, which: Bools) -> Buckets:
    """Return some of the buckets."""
    return Buckets(
        each.t[which], each.ticks[which], each.verdict_s[which], each.extremes[which], each.flags[which]
    )


def merge(parts: Iterable[Buckets], bucket_s: float) -> Buckets:
    """Merge buckets, in order of time, to longer ones."""
    every = tuple(parts)
    t, ticks, verdict_s, extremes, flags = (
        np.concatenate([getattr(each, name) for each in every])
        for name in ("t", "ticks", "verdict_s", "extremes", "flags")
    )
    if not t.size:
        return every[0]
    number = np.floor(t / bucket_s)
    starts = np.flatnonzero(np.append(True, number[1:] != number[:-1]))
    merged = np.empty((starts.size, *extremes.shape[1:]), dtype=np.float32)
    merged[:, 0::2] = np.fmin.reduceat(extremes[:, 0::2], starts, axis=0)
    merged[:, 1::2] = np.fmax.reduceat(extremes[:, 1::2], starts, axis=0)
    return Buckets(
        number[starts] * bucket_s,
        np.add.reduceat(ticks, starts),
        np.add.reduceat(verdict_s, starts, axis=0),
        merged,
        np.bitwise_or.reduceat(flags, starts, axis=0),
    )


# --- Roll-ups ---

_ROLLUP_VERSION: Final = b"\x01"
"""First byte of a roll-up."""


def roll_up(found: Sequence[tuple[float, str, int, bytes, str]], until: float) -> list[dict[str, Any]]:
    """Return the roll-ups of rows, as rows of the table `history_rollup` without the feeder.

    found: time, verdict, number of the layout, data and meters (JSON) of each row, in order of time.
    """
    rolled: list[dict[str, Any]] = []
    layouts = {row[2]: row[4] for row in found}
    for layout, text in layouts.items():
        meters: list[str] = json.loads(text)
        # All rows: the verdict of a tick ends with the next one, also after a change of the meters.
        each = of_rows(
            [(t, verdict, data, json.loads(layouts[of])) for t, verdict, of, data, _ in found],
            meters,
            ROLLUP_S,
            until,
        )
        own = np.array([row[2] == layout for row in found])
        made = merge([_among(each, own)], ROLLUP_S)
        for k in range(made.t.size):
            raw = made.extremes[k].tobytes() + made.flags[k].tobytes()
            times = zip(VERDICTS, made.verdict_s[k].tolist(), strict=True)
            rolled.append(
                {
                    "t": float(made.t[k]),
                    "layout": layout,
                    "ticks": int(made.ticks[k]),
                    **{f"{verdict}_s": s for verdict, s in times},
                    "data": _ROLLUP_VERSION + zlib.compress(raw, 6),
                }
            )
    return sorted(rolled, key=lambda row: (row["t"], row["layout"]))


def of_rollups(found: Sequence[Mapping[str, Any]], wanted: Sequence[str]) -> Buckets:
    """Return roll-ups as buckets, for `merge`; `meters` of each is its layout as JSON."""
    if not found:
        return nothing(len(wanted))
    extremes = np.full((len(found), len(EXTREMES), len(wanted)), math.nan, dtype=np.float32)
    flags = np.zeros((len(found), len(wanted)), dtype=np.uint8)
    at = 0
    for text, same in groupby(found, key=lambda row: row["meters"]):
        meters = json.loads(text)
        to, of = _places(meters, wanted)
        for row in same:
            raw = zlib.decompress(row["data"][1:])
            table = np.frombuffer(raw, dtype="<f4", count=len(EXTREMES) * len(meters))
            extremes[at][:, to] = table.reshape(len(EXTREMES), -1)[:, of]
            flags[at, to] = np.frombuffer(raw, dtype=np.uint8, offset=table.nbytes)[of]
            at += 1
    return Buckets(
        np.array([row["t"] for row in found]),
        np.array([row["ticks"] for row in found], dtype=np.float64),
        np.array([[row[f"{verdict}_s"] for verdict in VERDICTS] for row in found]),
        extremes,
        flags,
    )


# --- Selection of the kept ticks ---


@dataclass(frozen=True, slots=True)
class HistoryRules:
    """Grid and duration of the history."""

    step_s: float = 10.0  # grid of the kept ticks, s; 0 keeps all
    keep_s: float = 14 * 86400.0  # time for which they are kept, s


@dataclass(frozen=True, slots=True)
class Mark:
    """The last kept tick, which the selection compares with."""

    t: float
    verdict: str
    cause: str
    suspects: tuple[str, ...]


def mark(report: Marked) -> Mark:
    """Return the mark of a tick."""
    return Mark(report.t, str(report.verdict), str(report.cause), report.suspects)


def worth_keeping(last: Mark | None, now: Mark, rules: HistoryRules) -> bool:
    """True if a tick gets a row."""
    if last is None or now.t < last.t:
        return True
    changed = (last.verdict, last.cause, last.suspects) != (now.verdict, now.cause, now.suspects)
    step = rules.step_s
    return changed or step <= 0.0 or math.floor(now.t / step) > math.floor(last.t / step)
