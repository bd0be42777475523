"""Design by optimisation over matrices, the only package that uses a solver.

One module is one problem: `circle_criterion` (chong2020), `unknown_input` (yang2021) and others.
Every result of a solver is rebuilt in NumPy before it is used.
"""

from gridsec.observers.gains import options_for
from gridsec.observers.lmi.circle_criterion import circle, contraction, prove, settle, solve_many
from gridsec.observers.lmi.solver import BACKOFF

__all__ = ["BACKOFF", "circle", "contraction", "options_for", "prove", "settle", "solve_many"]
