"""History of a feeder: selection of ticks, and packing of rows. Pure.

A report of 146 meters has 30 kB of JSON and comes every second. The history keeps ticks on a coarser grid and
every tick with a change of the verdict, its cause or its suspects. A row contains the reported and the
reconstructed voltage, score and threshold of every meter, as compressed single-precision columns (volts to
2e-5), about 2 kB.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.report.report import BUSBAR, FeederReport, MeterState, finite

_COLUMNS = ("v_volt_reported", "v_volt_estimated", "score", "threshold")
_SEEN, _SUSPECT, _MODEL_ONLY = 1, 2, 4


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


def mark(report: FeederReport) -> Mark:
    """Return the mark of a report."""
    return Mark(report.t, str(report.verdict), str(report.cause), report.suspects)


def worth_keeping(last: Mark | None, now: Mark, rules: HistoryRules) -> bool:
    """True if a tick gets a row."""
    if last is None or now.t < last.t:
        return True
    changed = (last.verdict, last.cause, last.suspects) != (now.verdict, now.cause, now.suspects)
    step = rules.step_s
    return changed or step <= 0.0 or math.floor(now.t / step) > math.floor(last.t / step)


def rows(report: FeederReport) -> tuple[MeterState, ...]:
    """Return the meters of a row: those of the report, and the busbar meter as `BUSBAR`, without a score."""
    now = report.busbar
    busbar = MeterState(
        meter=BUSBAR,
        bus=report.buses[0].bus if report.buses else "",
        seen=now.seen,
        suspect=now.suspect,
        score=None,
        threshold=None,
        v_volt_reported=now.v_volt_reported,
        v_volt_estimated=now.v_volt_estimated,
        v_volt_std=None,
        v2_pu_estimated=None,
        attack_volt_estimated=now.attack_volt_estimated,
        model_only=now.model_only,
    )
    return (*report.meters, busbar)


def pack(meters: Sequence[MeterState]) -> bytes:
    """Pack the meters of a report: four float32 columns (NaN for None), then one byte of flags each."""
    none = math.nan
    table = np.array(
        [[none if (v := getattr(m, name)) is None else v for m in meters] for name in _COLUMNS], dtype="<f4"
    )
    flags = bytes(_SEEN * m.seen | _SUSPECT * m.suspect | _MODEL_ONLY * m.model_only for m in meters)
    return zlib.compress(table.tobytes() + flags, 6)


def unpack(data: bytes, meters: Sequence[str], only: str | None = None) -> dict[str, Any]:
    """Return the values of a kept row for the feeder and, on request, for one of its meters.

    `meters` are the ids of the row's meters, in order; `only` is the requested meter. Returns `seen` (number
    of meters), `suspects`, `v_volt_lowest`, `v_volt_highest`, `model_only`, and `meter`: its fields as in
    REST's `state`, or None. The busbar meter may be among the suspects; `seen` and the extremes leave it out.
    The extremes leave out model-only values; rows of earlier versions mark none.
    """
    raw = zlib.decompress(data)
    size = len(meters)
    table = np.frombuffer(raw, dtype="<f4", count=4 * size).reshape(4, size)
    flags = np.frombuffer(raw, dtype=np.uint8, offset=16 * size)
    volts = table[_COLUMNS.index("v_volt_estimated")]
    others = np.array([meter != BUSBAR for meter in meters], dtype=np.bool_)
    alone = (flags & _MODEL_ONLY) > 0
    volts = volts[np.isfinite(volts) & others & ~alone]
    one = None
    if only in meters:
        k = meters.index(only)
        one = {
            "meter": only,
            "seen": bool(flags[k] & _SEEN),
            "suspect": bool(flags[k] & _SUSPECT),
            **{name: _short(float(table[row, k])) for row, name in enumerate(_COLUMNS)},
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
