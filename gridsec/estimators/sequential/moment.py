"""Readings of the busbar's meter with a measured clock offset: of another moment than those beside them.

With a clock that is o ahead the reading at the tick t is of the moment t - o. It is left out while the
busbar's squared voltage changed lately by more than the meter's accuracy class e allows:

    max over k = 1 .. K of |u(t) - u(t - k h)| > e,   K = ceil(|o| / h) + 1,

h being the interval of the ticks. u is the meter's own reading, which changes first where the clock is
behind, or the median change of the trusted meters of the phase, which changes first where it is ahead.

References
----------
docs/theory-sequential.md, section 3.
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
class Moment:
    """Readings of the last ticks, the newest last, squared pu, NaN where missing. p meters, b phases.

    Attributes
    ----------
    busbar : (k, b)
        Of the busbar's meter.
    y : (k, p)
        Of the meters.
    """

    busbar: Floats
    y: Floats


def present(
    design: SequentialDesign, before: Moment | None, frame: Frame, trusted: Bools, v0_squared: Floats | float
) -> tuple[Moment | None, Frame]:
    """Leave the busbar's reading out while it is of another moment.

    Parameters
    ----------
    design, before
        The design, and the readings of the last ticks; None after a pause.
    frame
        Everything known at one tick.
    trusted : (p,)
        Trusted meters.
    v0_squared
        Last squared busbar voltage that was believed, pu; in three phases (3,).

    Returns
    -------
    Moment or None
        None while the offset is not measured.
    Frame
        Without the busbar's voltage of the phases that changed.
    """
    offset = abs(frame.busbar_offset)
    if not offset > 0.0:  # also for NaN
        return None, frame
    ticks = min(ceil(offset / design.step_s) + 1, _LONGEST)
    said = np.atleast_1d(np.asarray(frame.v0_squared if frame.v0_phases is None else frame.v0_phases))
    y = np.where(frame.seen, frame.y, np.nan)
    if before is None or before.busbar.shape[1] != said.size:
        before = Moment(np.zeros((0, said.size)), np.zeros((0, y.size)))
    allowed = np.atleast_1d(np.asarray(busbar_errors(design.plant, v0_squared, design.sigmas[0])))
    here = (design.hangs_on > 0.0) & trusted[:, None]
    moved: Bools = np.asarray(_beyond(said - before.busbar[-ticks:], allowed).any(axis=0))
    for phase in range(here.shape[1]):
        change = (y - before.y[-ticks:])[:, here[:, phase]]
        known = np.isfinite(change)
        middle = [np.median(row[one]) for row, one in zip(change, known, strict=True) if any_of(one)]
        if any_of(_beyond(np.array(middle), allowed[phase])):
            moved = np.asarray(moved | _is(phase, said.size))
    kept = Moment(np.vstack([before.busbar, said])[-_LONGEST:], np.vstack([before.y, y])[-_LONGEST:])
    if not any_of(moved):
        return kept, frame
    if frame.v0_phases is None:
        return kept, replace(frame, v0_squared=np.nan)
    return kept, replace(frame, v0_squared=np.nan, v0_phases=np.where(moved, np.nan, frame.v0_phases))


def _is(phase: int, phases: int) -> Bools:
    """The phase among those of the busbar's readings; each of them where one reading serves for all."""
    return np.arange(phases) == phase if phases > 1 else np.ones(1, dtype=np.bool_)


def _beyond(change: Floats, allowed: Floats) -> Bools:
    """Changes beyond the class; a missing reading has no change."""
    return np.asarray(np.abs(np.nan_to_num(change, posinf=0.0, neginf=0.0)) > allowed)
