"""Readings with a measured clock offset, hence of another moment than the model and the readings beside them.

A meter with a clock that is o ahead reports at tick t its reading of t - o. Its residual is off by at most
the change of its voltage meanwhile, by the model

    c_j(t) = max over k = 1 .. K_j of |v2_j(t) - v2_j(t - k h)|,   K_j = ceil(|o_j| / h) + 1,

h being the interval of the ticks. The squared mean of c_j over a scale is added to the variance of the
meter's mean. Around a step of the busbar's voltage all these meters are off together, so a scale shorter than
`_OFFSETS` offsets does not test the meter. A reading that no scale tests counts as missing.

A busbar reading with an offset o is left out while the busbar's squared voltage u changed within K ticks by
more than the meter's accuracy class. u is the meter's own reading, which changes first where the clock is
behind, or the median change of the trusted meters of the phase, which changes first where it is ahead.

References
----------
docs/theory-sequential.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.estimators.inputs import busbar_errors
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.interface import Frame

_OFFSETS = 4.0
"""Shortest scale that tests a meter, in offsets of its clock."""
_NEGLIGIBLE = 0.1
"""Variance of a change, as a part of that of a mean, below which it is left out."""
_VARIANCE_RANGE = 4.0
"""Largest ratio of a used variance to the found one: each other one is a new factorisation."""
_FALL_TICKS = 4
"""Smallest number of ticks from one fall of the variances of a scale to the next."""


def largest_offset(design: SequentialDesign) -> float:
    """Largest clock offset with a scale that tests the meter, s."""
    return design.lengths[-1] * design.step_s / _OFFSETS


def unusable_offsets(design: SequentialDesign, offset_s: Floats | None) -> Bools | None:
    """Meters with clock offsets (p,), s, that no scale covers, (p,); None for none. NaN: not measurable."""
    if offset_s is None:
        return None
    far: Bools = np.asarray(np.abs(offset_s) > largest_offset(design))  # False for NaN
    return far if any_of(far) else None


@dataclass(frozen=True, slots=True, eq=False)
class ClockSkew:
    """Changes of the voltages within the clock offsets. p meters, s scales."""

    model: Floats  # (k, p) squared voltages of the model at the last ticks, the newest last, pu
    change: Floats  # (longest, p) c at the last ticks, the newest last, squared pu
    variance: Floats  # (s, p) added variance of the means, squared pu^2
    aside: Bools  # (s, p) meters that a scale does not test

    def tested(self, counts: Ints, needed: Ints) -> Bools:
        """Meters with enough readings, (s, p) counts and (s,) needed, on a scale that tests them, (p,)."""
        enough = (counts >= needed[:, None]) & ~self.aside
        return np.asarray(enough.any(axis=0) & self.aside.any(axis=0))


def update_skew(  # noqa: PLR0917
    design: SequentialDesign,
    before: ClockSkew | None,
    tick: int,
    offset_s: Floats | None,
    v2: Floats,
    noise: Floats,
) -> ClockSkew | None:
    """Changes with one more tick; None while no offset is measured and no added variance is left.

    tick: its number; variances of a scale change only when it is due. offset_s: (p,) lead of each clock, s,
    NaN if not measurable; offsets beyond `largest_offset` count as none. v2: (p,) voltages of the model,
    squared pu. noise: (s, p) variances of the means without offsets, squared pu^2.
    """
    size = np.zeros(v2.size) if offset_s is None else np.abs(np.nan_to_num(offset_s))
    size = np.where(size <= largest_offset(design), size, 0.0)
    if not any_of(size) and (before is None or not any_of(before.variance)):
        return None
    lengths, step = np.array(design.lengths), design.step_s
    ticks = np.where(size > 0.0, np.ceil(size / step) + 1.0, 0.0)
    old = np.zeros((0, v2.size)) if before is None else before.model
    change = np.zeros(v2.size)
    for k in range(1, min(int(ticks.max()), len(old)) + 1):
        change = np.where(ticks >= k, np.maximum(change, np.abs(v2 - old[-k])), change)
    change_history = np.zeros((lengths[-1], v2.size)) if before is None else before.change
    change_history = np.vstack([change_history[1:], change])
    aside = lengths[:, None] * step < _OFFSETS * size
    variance = np.zeros_like(noise) if before is None else before.variance.copy()
    for s, length in enumerate(design.lengths):
        if tick % design.look_every[s] == 0:
            mean = change_history[-length:].mean(axis=0)
            # The variance of a meter that the scale does not test is not used.
            found = np.where((size > 0.0) & ~aside[s], mean * mean, 0.0)
            looks = -(-_FALL_TICKS // design.look_every[s])
            falls = tick % (looks * design.look_every[s]) == 0
            variance[s] = _variance(found, noise[s], variance[s], falls=falls)
    kept = ceil(largest_offset(design) / step) + 1
    return ClockSkew(np.vstack([old, v2])[-kept:], change_history, variance, aside)


def _variance(found: Floats, noise: Floats, before: Floats, *, falls: bool) -> Floats:
    """Variances of one scale: the present ones while they are 1 to `_VARIANCE_RANGE` times those found, (p,).

    Each other variance is a new factorisation of the scale. One out of its range therefore renews all of
    them, to the middle of the range, and a variance falls at most once in `_FALL_TICKS` ticks.
    """
    little = _NEGLIGIBLE * noise
    wanted = np.where(found > np.where(before > 0.0, little / _VARIANCE_RANGE, little), found, 0.0)
    rises, removed = wanted > before, wanted * _VARIANCE_RANGE < before
    if not any_of(rises) and not (falls and any_of(removed)):
        return before
    wanted = wanted * np.sqrt(_VARIANCE_RANGE)
    return np.asarray(wanted if falls else np.maximum(wanted, before))


# --- Busbar readings ---


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
