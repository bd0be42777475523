"""Design by optimisation over matrices, the only package that uses a solver.

One module is one problem: `circle_criterion` (chong2020), `unknown_input` (yang2021) and others.
Every result of a solver is rebuilt in NumPy before it is used.
"""

from gridsec.observers.gains import (
    CircleGains,
    CircleOptions,
    circle_matrix,
    margin,
    options_for,
    sensitivity,
    stacked,
    state_bound,
)
from gridsec.observers.lmi.circle_criterion import BACKOFF, circle, contraction, prove, settle, solve_many
from gridsec.observers.lmi.unknown_input import (
    ErrorSystem,
    UnknownInputGains,
    UnknownInputTemplate,
    unknown_input_margin,
    unknown_input_matrix,
)

__all__ = [
    "BACKOFF",
    "CircleGains",
    "CircleOptions",
    "ErrorSystem",
    "UnknownInputGains",
    "UnknownInputTemplate",
    "circle",
    "circle_matrix",
    "contraction",
    "margin",
    "options_for",
    "prove",
    "sensitivity",
    "settle",
    "solve_many",
    "stacked",
    "state_bound",
    "unknown_input_margin",
    "unknown_input_matrix",
]
