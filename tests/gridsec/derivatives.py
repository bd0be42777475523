"""Sensitivities against differences of power flows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gridsec.arrays import Floats
from gridsec.grid.network import LinDistFlow

STEP = 1e-3


def derivatives_are(
    found: LinDistFlow, solve: Callable[[Floats, Floats], Floats], p: Floats, q: Floats, *, atol: float
) -> None:
    """Half the derivatives of the squared voltages are R and X, where there is a voltage.

    Parameters
    ----------
    found
        What is claimed.
    solve
        Squared voltages of an AC power flow, NaN at what is not there, for injections.
    p, q : (N,)
        The operating point, pu.
    atol
        How far they may be off.
    """
    for k in range(p.size):
        unit = STEP * (np.arange(p.size) == k)
        for column, up, down in (
            (found.R_bus[:, k], (p + unit, q), (p - unit, q)),
            (found.X_bus[:, k], (p, q + unit), (p, q - unit)),
        ):
            above, below = solve(*up), solve(*down)
            slope, there = (above - below) / (4.0 * STEP), ~np.isnan(above)
            np.testing.assert_allclose(slope[there], column[there], rtol=0, atol=atol)
