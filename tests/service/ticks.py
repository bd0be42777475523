"""Ticks of the alignment from readings, and the readings of a tick."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.ingest.align import Tick
from service.ingest.decode import DecodedPayload
from service.ingest.reading import BadReading, Known, Reading

_NONE = (math.nan,) * 5


def _column(one: Reading | None) -> tuple[float, ...]:
    return _NONE if one is None else (one.t, one.v_volt, one.p_kw, one.q_kvar, one.t_power)


def tick_of(
    t: float,
    readings: Sequence[Reading | None],
    busbar: Reading | None,
    silent: tuple[tuple[str | None, float], ...],
    **more: Any,
) -> Tick:
    """Return the tick with a usable reading of each meter, or None, and of the busbar meter."""
    # Simulated readings have None where nothing is reported.
    values = np.array([_column(one) for one in (*readings, busbar)], dtype=np.float64).T
    return Tick(t, values, silent, v_phases=None if busbar is None else busbar.v_phases, **more)


def readings_of(tick: Tick, meters: Sequence[str] | None = None) -> tuple[Reading | None, ...]:
    """Return the usable reading of each meter, and last of the busbar meter."""
    names = (*(meters or [str(k) for k in range(tick.seen.size)]), None)
    return tuple(
        None if math.isnan(v) else Reading("", name, t, v, p, q, None, None, tp)
        for name, (t, v, p, q, tp) in zip(names, tick.values.T.tolist(), strict=True)
    )


def plain(ticks: Sequence[Tick]) -> list[Any]:
    """Return everything in ticks, for comparison."""
    return [
        (
            one.t,
            repr(one.values.tolist()),
            one.silent,
            one.skipped,
            one.clock_offset,
            one.busbar_offset,
            one.v_phases,
        )
        for one in ticks
    ]


@dataclass(frozen=True)
class Listed:
    """A decoded payload with its readings one by one."""

    readings: tuple[Reading, ...]
    bad: tuple[BadReading, ...]


def listed(decoded: DecodedPayload, known: Known) -> Listed:
    """Return the readings of a payload one by one."""
    columns = decoded.readings
    each = () if columns is None else tuple(columns.reading(k, known) for k in range(len(columns)))
    return Listed(each, decoded.bad)
