"""Residual thresholds: how far an honest meter may be from the reconstructed voltage.

A meter is named manipulated when its output residual leaves the largest value that honest meters,
loads known within stated intervals, and the model's own error can produce together. No term is a
matter of taste: each comes from a stated accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.online import Floats


@dataclass(frozen=True, slots=True, eq=False)
class MeterAccuracy:
    """What the data sheets promise about the voltage meters. p meters.

    A reading is ``v (1 + c) + r + n`` with a fixed unknown relative bias ``|c| <= class_fraction``,
    rounding ``|r| <= resolution / 2`` and white jitter ``n`` of standard deviation ``jitter``.

    Attributes
    ----------
    class_fraction : (p,)
        Accuracy class as a fraction of the reading: 0.005 for class 0.5.
    resolution : (p,)
        Step of the register, pu of the nominal voltage.
    jitter : (p,)
        Standard deviation from one reading to the next, pu of the nominal voltage.
    busbar_class
        Class of the busbar meter, fraction of the reading.
    busbar_resolution
        Its resolution, pu.
    busbar_jitter
        Its jitter, pu.
    """

    class_fraction: Floats
    resolution: Floats
    jitter: Floats
    busbar_class: float
    busbar_resolution: float
    busbar_jitter: float

    def __post_init__(self) -> None:
        """Check shapes and signs; a wrong description is a programming error, not an online outcome."""
        p = np.shape(self.class_fraction)
        for name in ("class_fraction", "resolution", "jitter"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, value)
            if value.ndim != 1 or value.shape != p:
                raise ValueError(f"{name} must have one entry per meter, got shape {value.shape}")
            if not (np.isfinite(value).all() and (value >= 0).all()):
                raise ValueError(f"{name} must be finite and not negative")
        for name in ("busbar_class", "busbar_resolution", "busbar_jitter"):
            number = float(getattr(self, name))
            if not (np.isfinite(number) and number >= 0):
                raise ValueError(f"{name} must be finite and not negative, got {number}")
