"""Isolation of attacked inputs and sensors: banks of unknown-input observers, selection, reconstruction.

A bank compares every large observer, which distrusts q_1 inputs and q_2 sensors, with all those that
distrust twice as many of each. The observer in best agreement with its company is selected. The attacks
follow from its estimate; inputs and sensors with an attack above the estimate's error are named.

    design(plant, ...) -> IsolationDesign
    init(design, t) -> IsolationState
    step(design, state, y, u, seen) -> (IsolationState, Isolation)

References
----------
yang2021 (5) to (7), (22) to (24), (42) to (47); docs/theory-unknown-input.md.
"""

from gridsec.isolation.design import IsolationDesign, Measure, design, members
from gridsec.isolation.run import Isolation, IsolationState, init, input_attack, step, support
from gridsec.isolation.selection import bounds, disagreement, estimate

__all__ = [
    "Isolation",
    "IsolationDesign",
    "IsolationState",
    "Measure",
    "bounds",
    "design",
    "disagreement",
    "estimate",
    "init",
    "input_attack",
    "members",
    "step",
    "support",
]
