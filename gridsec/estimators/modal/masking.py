"""Masking of named meters, and their release.

A masked meter is unread by the filter and by the detector, from the onset of its fault on. The filter keeps
the posterior of its fixed error, so that the reading r of a masked meter is compared with its own past:

    r - (w + b)   has the variance   P + d   at one tick, and   P + d / n   as a mean of n ticks

with P the variance of w + b, which changes slowly, and d the white variance. A meter is released after n
readings in turn within `OUTLIER` standard deviations, if their mean is within `AGREES` of its own. n is at
least `RELEASE`, and ``d <= n P``: more readings would hardly sharpen the comparison. After `MOST` readings
the mean decides at the latest, and the count begins anew.
A lie that passes is smaller than that. After the release it is subject to the detector as any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.modal.filter import Full
from gridsec.estimators.modal.model import Modes

RELEASE, MOST = 6, 12
"""Least readings that agree before a release, and readings from which on the mean decides at the latest."""
OUTLIER = 4.0
"""Standard deviations of a single reading that disagrees, 1."""
AGREES = 3.0
"""Standard deviations of a mean that agrees, 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Masked:
    """Masked meters. t members.

    Attributes
    ----------
    meters : (t,)
        The masked ones.
    count : (t,)
        Readings in turn that agree.
    total : (t,)
        Sum of their deviations, squared pu.
    """

    meters: Bools
    count: Ints
    total: Floats


def none(modes: Modes) -> Masked:
    """No masked meter."""
    t = modes.size
    return Masked(np.zeros(t, dtype=np.bool_), np.zeros(t, dtype=np.intp), np.zeros(t))


def added(masked: Masked, meters: Bools) -> Masked:
    """The same with more meters (t,); their count starts at 0."""
    return Masked(
        masked.meters | meters, np.where(meters, 0, masked.count), np.where(meters, 0.0, masked.total)
    )


def follow(modes: Modes, masked: Masked, full: Full, m: Floats, seen: Bools | None) -> Masked:
    """Take in the readings of one tick, and release the meters that agree.

    Parameters
    ----------
    modes, masked
        The modes, and the masked meters.
    full
        The exact filter after the tick, without their readings.
    m, seen : (t,)
        Residuals, and members with a reading, the masked ones included; None: all.
    """
    slow, d = full.variance, modes.noise.diagonal()
    read = masked.meters if seen is None else masked.meters & seen
    off = m - full.mean[0] - full.mean[1]
    fits = off * off <= OUTLIER**2 * (slow + d)
    count = np.where(read, np.where(fits, masked.count + 1, 0), masked.count)
    total = np.where(read, np.where(fits, masked.total + off, 0.0), masked.total)
    n = np.maximum(count, 1)
    sharp = (count >= RELEASE) & (d <= n * slow)
    agrees = (total / n) ** 2 <= AGREES**2 * (slow + d / n)
    full_count = count >= MOST
    return Masked(
        masked.meters & ~((full_count | sharp) & agrees),
        np.where(full_count, 0, count),
        np.where(full_count, 0.0, total),
    )
