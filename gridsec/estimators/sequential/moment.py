"""Busbar readings with a measured clock offset, hence of another moment than the readings beside them.

With a clock that is o ahead, the reading at tick t is of the moment t - o. It is left out while the busbar's
squared voltage changed lately by more than the meter's accuracy class e:

    max over k = 1 .. K of |u(t) - u(t - k h)| > e,   K = ceil(|o| / h) + 1,

h being the interval of the ticks. u is the meter's own reading, which changes first where the clock is
behind, or the median change of the trusted meters of the phase, which changes first where it is ahead
(docs/theory-sequential.md, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from gridsec.arrays import Bools, Floats, any_of
from gridsec.estimators.inputs import busbar_errors
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.interface import Frame

_LONGEST = 64
"""Largest number of ticks over which changes are taken."""


@dataclass(frozen=True, slots=True, eq=False)
class BusbarHistory:
    """Readings of the last k ticks, the newest last, squared pu, NaN where missing. p meters, b phases."""

    busbar: Floats  # (k, b) of the busbar's meter
    y: Floats  # (k, p) of the meters


def without_shifted_busbar(
    design: SequentialDesign,
    history_before: BusbarHistory | None,
    frame: Frame,
    trusted: Bools,
    v0_squared: Floats | float,
) -> tuple[BusbarHistory | None, Frame]:
    """Frame without busbar phases that changed within the clock offset, and history; None if not measured.

    trusted: (p,) meters. v0_squared: last trusted squared busbar voltage, pu; (3,) in three phases.
    """
    offset = abs(frame.busbar_offset)
    if not offset > 0.0:  # also for NaN
        return None, frame
    ticks = min(ceil(offset / design.step_s) + 1, _LONGEST)
    reading = np.atleast_1d(np.asarray(frame.v0_squared if frame.v0_phases is None else frame.v0_phases))
    y = np.where(frame.seen, frame.y, np.nan)
    if history_before is None or history_before.busbar.shape[1] != reading.size:
        history_before = BusbarHistory(np.zeros((0, reading.size)), np.zeros((0, y.size)))
    allowed = np.atleast_1d(np.asarray(busbar_errors(design.plant, v0_squared, design.sigmas[0])))
    here = (design.busbar_incidence > 0.0) & trusted[:, None]
    moved: Bools = np.asarray(_beyond(reading - history_before.busbar[-ticks:], allowed).any(axis=0))
    for phase in range(here.shape[1]):
        change = (y - history_before.y[-ticks:])[:, here[:, phase]]
        known = np.isfinite(change)
        middle = [np.median(row[one]) for row, one in zip(change, known, strict=True) if any_of(one)]
        if any_of(_beyond(np.array(middle), allowed[phase])):
            moved = np.asarray(moved | _phase_mask(phase, reading.size))
    history = BusbarHistory(
        np.vstack([history_before.busbar, reading])[-_LONGEST:], np.vstack([history_before.y, y])[-_LONGEST:]
    )
    if not any_of(moved):
        return history, frame
    if frame.v0_phases is None:
        return history, replace(frame, v0_squared=np.nan)
    return history, replace(frame, v0_squared=np.nan, v0_phases=np.where(moved, np.nan, frame.v0_phases))


def _phase_mask(phase: int, phases: int) -> Bools:
    """Phase among those of the busbar's readings; all of them where one reading serves for all."""
    return np.arange(phases) == phase if phases > 1 else np.ones(1, dtype=np.bool_)


def _beyond(change: Floats, allowed: Floats) -> Bools:
    """Changes beyond the accuracy class; a missing reading has none."""
    return np.asarray(np.abs(np.nan_to_num(change, posinf=0.0, neginf=0.0)) > allowed)
