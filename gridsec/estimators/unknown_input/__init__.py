"""Manipulated inverters and meters at once by unknown-input observers: yang2021 on a feeder."""

from gridsec.estimators.unknown_input.step import (
    UnknownInputDesign,
    UnknownInputState,
    design,
    init,
    step,
)

__all__ = ["UnknownInputDesign", "UnknownInputState", "design", "init", "step"]
