"""Design by linear matrix inequalities, the only place that knows a solver.

One module is one inequality: `circle_criterion` (chong2020). Whatever a solver says is rebuilt in
NumPy before it is believed.
"""

from gridsec.gains import (
    CircleGains,
    CircleOptions,
    circle_matrix,
    margin,
    options_for,
    sensitivity,
    stacked,
    state_bound,
)
from gridsec.lmi.circle_criterion import BACKOFF, circle, contraction, prove, settle, solve_many

__all__ = [
    "BACKOFF",
    "CircleGains",
    "CircleOptions",
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
]
