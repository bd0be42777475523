"""Estimators of single ticks: four decoders with a monitor that confirms over ticks.

design(plant, decoder, doubt=..., step_s=..., max_attacked=...) -> SingleTickDesign
init(design, t) -> SingleTickState
step(design, state, frame) -> (SingleTickState, Estimate, Verdict)
"""

from gridsec.estimators.single_tick.decoders import (
    MOST_SETS,
    Decoder,
    fewest,
    least_squares,
    match,
    pursue,
)
from gridsec.estimators.single_tick.monitor import SingleTickDesign, SingleTickState, design, init, step

__all__ = [
    "MOST_SETS",
    "Decoder",
    "SingleTickDesign",
    "SingleTickState",
    "design",
    "fewest",
    "init",
    "least_squares",
    "match",
    "pursue",
    "step",
]
