"""Readings of meters with a measured clock offset: of another moment than the model beside them.

A meter with a clock that is o ahead reports at the tick t what it measured at t - o. Its residual is off by
at most the change of its voltage meanwhile, by the model

    c_j(t) = max over k = 1 .. K_j of |v2_j(t) - v2_j(t - k h)|,   K_j = ceil(|o_j| / h) + 1,

h being the interval of the ticks. The mean over a scale is off by at most the mean of c_j, whose square is
added to the variance of the meter's mean. Around a step of the busbar's voltage all these meters are off
together, so no scale shorter than `_OFFSETS` offsets judges the meter. A reading with an offset that no scale
judges is used like a missing one.

References
----------
docs/theory-sequential.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.estimators.sequential.design import SequentialDesign

_OFFSETS = 4.0
"""Shortest scale that judges a meter, in offsets of its clock."""
_LITTLE = 0.1
"""Variance of a change, as a part of that of a mean, below which it is left out."""
_STEP = 4.0
"""Largest ratio of a variance that is used to the one found: each other one is a new factorisation."""
_HOLD = 4
"""Smallest number of ticks from one fall of the variances of a scale to the next."""


def largest(design: SequentialDesign) -> float:
    """Largest clock offset with a scale that judges the meter, s."""
    return design.lengths[-1] * design.step_s / _OFFSETS


def unusable(design: SequentialDesign, offset_s: Floats | None) -> Bools | None:
    """Meters with a clock offset that no scale judges, (p,); None for none.

    Parameters
    ----------
    design
        The design.
    offset_s : (p,)
        By how much each meter's clock is ahead, s; NaN where that is not measurable.
    """
    if offset_s is None:
        return None
    far: Bools = np.asarray(np.abs(offset_s) > largest(design))  # False for NaN
    return far if any_of(far) else None


@dataclass(frozen=True, slots=True, eq=False)
class Skew:
    """Changes of the voltages within the clock offsets. p meters, s scales.

    Attributes
    ----------
    model : (k, p)
        Squared voltages by the model at the last ticks, the newest last, pu; k covers `largest`.
    moved : (longest, p)
        c at the last ticks, the newest last, squared pu.
    variance : (s, p)
        Variance that is added to those of the means, squared pu^2, at most `_STEP` times what is found.
    aside : (s, p)
        Meters that a scale does not judge.
    """

    model: Floats
    moved: Floats
    variance: Floats
    aside: Bools

    def judged(self, counts: Ints, needed: Ints) -> Bools:
        """Meters with enough readings on a scale that judges them, (p,).

        Parameters
        ----------
        counts : (s, p)
            Readings on each scale.
        needed : (s,)
            Readings that a scale judges a meter by at least.
        """
        enough = (counts >= needed[:, None]) & ~self.aside
        return np.asarray(enough.any(axis=0) & self.aside.any(axis=0))


def follow(  # noqa: PLR0917  # the tick, and what it brings
    design: SequentialDesign,
    before: Skew | None,
    tick: int,
    offset_s: Floats | None,
    v2: Floats,
    noise: Floats,
) -> Skew | None:
    """Take in one tick; None while no offset is measured and no variance is left to take back.

    Parameters
    ----------
    design, before
        The design, and the changes so far.
    tick
        Number of the tick: variances of a scale change only at ticks at which it is due.
    offset_s : (p,)
        By how much each meter's clock is ahead, s; NaN where that is not measurable. Offsets above `largest`
        count as none: these meters are not read.
    v2 : (p,)
        Squared voltages by the model at the meters, pu.
    noise : (s, p)
        Variances of the means without offsets, squared pu^2.
    """
    size = np.zeros(v2.size) if offset_s is None else np.abs(np.nan_to_num(offset_s))
    size = np.where(size <= largest(design), size, 0.0)
    if not any_of(size) and (before is None or not any_of(before.variance)):
        return None
    lengths, step = np.array(design.lengths), design.step_s
    ticks = np.where(size > 0.0, np.ceil(size / step) + 1.0, 0.0)
    old = np.zeros((0, v2.size)) if before is None else before.model
    change = np.zeros(v2.size)
    for k in range(1, min(int(ticks.max()), len(old)) + 1):
        change = np.where(ticks >= k, np.maximum(change, np.abs(v2 - old[-k])), change)
    moved = np.zeros((lengths[-1], v2.size)) if before is None else before.moved
    moved = np.vstack([moved[1:], change])
    aside = lengths[:, None] * step < _OFFSETS * size
    variance = np.zeros_like(noise) if before is None else before.variance.copy()
    for s, length in enumerate(design.lengths):
        if tick % design.every[s] == 0:
            mean = moved[-length:].mean(axis=0)
            # The variance of a meter that the scale does not judge is in no result.
            found = np.where((size > 0.0) & ~aside[s], mean * mean, 0.0)
            looks = -(-_HOLD // design.every[s])
            falls = tick % (looks * design.every[s]) == 0
            variance[s] = _variance(found, noise[s], variance[s], falls=falls)
    kept = ceil(largest(design) / step) + 1
    return Skew(np.vstack([old, v2])[-kept:], moved, variance, aside)


def _variance(found: Floats, noise: Floats, before: Floats, *, falls: bool) -> Floats:
    """Variances of one scale: the present ones while they are 1 to `_STEP` times those found, (p,).

    Each other variance is a new factorisation of the scale. One out of its range therefore renews all of
    them, to the middle of the range, and a variance falls at most once in `_HOLD` ticks.
    """
    little = _LITTLE * noise
    wanted = np.where(found > np.where(before > 0.0, little / _STEP, little), found, 0.0)
    rises, fallen = wanted > before, wanted * _STEP < before
    if not any_of(rises) and not (falls and any_of(fallen)):
        return before
    wanted = wanted * np.sqrt(_STEP)
    return np.asarray(wanted if falls else np.maximum(wanted, before))
