"""Accuracy of meters and the largest error of a consistent reading.

Source: IEC 62053 for accuracy classes; docs/theory-detection.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Ints, frozen, put
from gridsec.errors import Problem, raise_if_any


@dataclass(frozen=True, slots=True, eq=False)
class MeterAccuracy:
    """Accuracy of the voltage meters by their data sheets. p meters.

    A reading is ``v (1 + c) + r + n`` with a fixed unknown relative bias ``|c| <= class_fraction``,
    rounding ``|r| <= resolution / 2`` and white jitter ``n`` of standard deviation ``jitter``.

    Raises ValueError with every problem found.
    """

    class_fraction: Floats  # (p,) accuracy class as a fraction of the reading: 0.005 for class 0.5
    resolution: Floats  # (p,) step of the register, pu of the nominal voltage
    jitter: Floats  # (p,) standard deviation from one reading to the next, pu of the nominal voltage
    busbar_class: float  # class of the busbar meter, fraction of the reading
    busbar_resolution: float  # its resolution, pu
    busbar_jitter: float  # its jitter, pu

    def __post_init__(self) -> None:
        """Check shapes and signs; a wrong description is a programming error, not an online outcome."""
        p, problems = np.shape(self.class_fraction), []
        for name in ("class_fraction", "resolution", "jitter"):
            value = frozen(getattr(self, name))
            put(self, **{name: value})
            if value.ndim != 1 or value.shape != p:
                problems.append(
                    Problem("shape", f"{name} must have one entry per meter, got shape {value.shape}")
                )
            if not (np.isfinite(value).all() and (value >= 0).all()):
                problems.append(Problem("negative", f"{name} must be finite and not negative"))
        for name in ("busbar_class", "busbar_resolution", "busbar_jitter"):
            number = float(getattr(self, name))
            if not (np.isfinite(number) and number >= 0):
                problems.append(Problem("negative", f"{name} must be finite and not negative, got {number}"))
        raise_if_any(problems)


def steady_rounding(accuracy: MeterAccuracy) -> Floats:
    """Largest rounding error that persists while the voltage is constant and that jitter does not average.

    To steps D, ``round(x) - x`` is ``sum_k (-1)^k D / (pi k) sin(2 pi k x / D)``; in the mean over jitter of
    standard deviation s its k-th harmonic shrinks by ``exp(-2 pi^2 k^2 s^2 / D^2)``. So the error is at most
    ``D / pi sum_k exp(-2 pi^2 k^2 s^2 / D^2) / k``, and never more than half a step.

    Returns (p,): bounds, pu of the nominal voltage; at the level of floating-point rounding for 0.1 V and
        0.05 %.
    """
    step = accuracy.resolution
    ratio = accuracy.jitter / np.where(step > 0.0, step, 1.0)
    # Where further harmonics matter, the sum exceeds half a step anyway.
    k = np.arange(1.0, 13.0)
    harmonics = (np.exp(-2.0 * (np.pi * np.multiply.outer(ratio, k)) ** 2) / (np.pi * k)).sum(axis=-1)
    return np.asarray(step * np.minimum(0.5, harmonics))


def reading_error(accuracy: MeterAccuracy, v2: Floats, sigmas: float) -> Floats:
    """Largest error of a squared reading without manipulation, per meter.

    `(v + e)^2 - v^2 = 2 v e + e^2` with `e = class v + resolution / 2 + sigmas jitter`.

    v2 (p,): largest possible squared voltage at the meter, pu.
    sigmas: jitter allowance in standard deviations.
    Returns (p,): bounds, squared pu.
    """
    v = np.sqrt(np.maximum(v2, 0.0))
    e = accuracy.class_fraction * v + 0.5 * accuracy.resolution + sigmas * accuracy.jitter
    return np.asarray(e * (2.0 * v + e))


def busbar_error(accuracy: MeterAccuracy, v0_squared: float, sigmas: float) -> float:
    """Largest error of the squared busbar voltage without manipulation.

    The class is relative to the true voltage, and only the reading r is known: `r = v (1 + c) + n` gives
    `|r - v| = |c r + n| / (1 + c) <= e = (class |r| + resolution / 2 + sigmas jitter) / (1 - class)`,
    and `|r^2 - v^2| <= e (2 r + e)`.

    v0_squared: squared reading, pu.
    """
    if accuracy.busbar_class >= 1.0:
        return float("inf")  # no bound from a class of 100 % or more
    v = float(np.sqrt(max(v0_squared, 0.0)))
    e = accuracy.busbar_class * v + 0.5 * accuracy.busbar_resolution + sigmas * accuracy.busbar_jitter
    e /= 1.0 - accuracy.busbar_class
    return e * (2.0 * v + e)


def told_error(accuracy: MeterAccuracy, y: Floats, sigmas: float) -> Floats:
    """Largest distance of the true voltage from a squared reading, per meter; compare `busbar_error`.

    y (p,): squared readings, pu.
    Returns (p,): bounds, squared pu; larger than any voltage for a class of 100 % or more.
    """
    return ToldError.over(accuracy, np.arange(y.size), sigmas).of(y)


# Voltage error assumed for an accuracy class of 100 % or more, pu.
_NOTHING = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class ToldError:
    """Bound of the true voltage around readings, prepared for repeated use; k meters."""

    # slope, floor (k,): voltage error in pu: `slope v + floor` for a reading v
    slope: Floats
    floor: Floats

    @classmethod
    def over(cls, accuracy: MeterAccuracy, which: Ints, sigmas: float) -> ToldError:
        """Prepare the bound for a selection of meters.

        which (k,): indices of meters; repetitions allowed.
        """
        part = accuracy.class_fraction[which]
        even = 0.5 * accuracy.resolution[which] + sigmas * accuracy.jitter[which]
        told = part < 1.0
        rest = np.where(told, 1.0 - part, 1.0)
        return cls(np.where(told, part / rest, 0.0), np.where(told, even / rest, _NOTHING))

    def of(self, y: Floats) -> Floats:
        """Bounds, squared pu, for squared readings `y` (k,), pu."""
        v = np.sqrt(np.maximum(y, 0.0))
        e = self.slope * v + self.floor
        return np.asarray(e * (2.0 * v + e))
