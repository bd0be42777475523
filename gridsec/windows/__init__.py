"""Detection and isolation over windows: a bank of discrete-time observers checked for consistency.

One observer for all p meters, one for every set of p - q, one for every set of p - 2q. Without manipulated
meters all of them stay within a known distance of the true state, hence of each other:

    pi(k)   = max over J of |x_hat - x_hat_J|                 <= 2 (epsilon + gamma m),
    pi_J(k) = max over S within J of |x_hat_J - x_hat_S|      <= 2 (epsilon + gamma_J m)

the latter for every J without a manipulated meter. A value above its bound is evidence; a window of N steps
collects it.

References
----------
yang2019, Algorithms 1 and 2; docs/theory-discrete.md, section 3.
"""

from gridsec.windows.design import WindowDesign, bank, bank_masks, consistency, design
from gridsec.windows.rules import Isolation, Rule, believed, detection, isolation
from gridsec.windows.run import WindowState, WindowVerdict, init, step
from gridsec.windows.trial import Trace, calibrate, simulate

__all__ = [
    "Isolation",
    "Rule",
    "Trace",
    "WindowDesign",
    "WindowState",
    "WindowVerdict",
    "bank",
    "bank_masks",
    "believed",
    "calibrate",
    "consistency",
    "design",
    "detection",
    "init",
    "isolation",
    "simulate",
    "step",
]
