"""Unknown-input observers for Lipschitz nonlinearities, batched in stacked arrays.

References
----------
yang2021 (2), (17), (33) to (36); docs/theory-unknown-input.md.
"""

from gridsec.observers.unknown_input.family import (
    UnknownInputDesign,
    UnknownInputState,
    design,
    init,
    outputs,
    step,
)
from gridsec.observers.unknown_input.plant import (
    Missing,
    Pair,
    UnknownInputPlant,
    error_system,
    exact,
    inverters,
    obstruction,
    pairs_text,
    projection,
    worst_zero,
)

__all__ = [
    "Missing",
    "Pair",
    "UnknownInputDesign",
    "UnknownInputPlant",
    "UnknownInputState",
    "design",
    "error_system",
    "exact",
    "init",
    "inverters",
    "obstruction",
    "outputs",
    "pairs_text",
    "projection",
    "step",
    "worst_zero",
]
