"""Partial high-gain observers for uniformly observable nonlinear systems (kim2018; lee2018, chapter 5)."""

from gridsec.observers.high_gain.form import Partial, Polynomial, System, affine, defects, linear
from gridsec.observers.high_gain.observer import (
    HighGainDesign,
    HighGainEstimate,
    HighGainState,
    design,
    error_bounds,
    init,
    step,
)
from gridsec.observers.high_gain.redundancy import Inverse, given, groups, nearest, redundancy

__all__ = [
    "HighGainDesign",
    "HighGainEstimate",
    "HighGainState",
    "Inverse",
    "Partial",
    "Polynomial",
    "System",
    "affine",
    "defects",
    "design",
    "error_bounds",
    "given",
    "groups",
    "init",
    "linear",
    "nearest",
    "redundancy",
    "step",
]
