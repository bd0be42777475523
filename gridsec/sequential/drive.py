"""The one observer: inverters of trusted meters follow their readings, all others the model.

    tau x' = -x + K(zeta),   zeta = vbar^2 - y at trusted meters,   H x + w elsewhere

It converges for every trusted set and every switching between them by one certificate
(docs/theory-certificates.md). Where everything is trusted, a step is exact and costs O(m).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible
from gridsec.lure import POLICY, Lure, advance
from gridsec.sequential.design import SequentialDesign

_PATIENT = replace(POLICY, settled=0.0)


def drive(  # noqa: PLR0917  # state, what drives it, and for how long
    design: SequentialDesign, x: Floats, y: Floats, driven: Bools, w: Floats | None, h: float
) -> Floats:
    """The injections a time h later.

    Parameters
    ----------
    design
        The design.
    x : (m,)
        Injections, pu.
    y : (m,)
        Squared voltage that each inverter's meter reads, pu; any finite value where not driven.
    driven : (m,)
        Which inverters follow their meters.
    w : (N,)
        Known input of the others; None where all are driven.
    h
        Step, s.

    References
    ----------
    chong2020 (5) with K = E_J, L = 0.
    """
    droop = design.plant.droop
    decay = np.exp(-h / droop.tau)
    target = droop(droop.vbar**2 - y)
    if w is None or driven.all():
        return np.asarray(target + decay * (x - target))
    out = np.where(driven, target + decay * (x - target), x)
    free = np.flatnonzero(~driven)
    H = design.loop[np.ix_(free, free)]
    own = droop.customer[free]
    # The driven ones take the mean of their way from x to out.
    held = np.where(driven, 0.5 * (x + out), 0.0)
    at = w[own] + design.loop[free] @ held
    rate = 1.0 / droop.tau[free]
    size = free.size
    loop = Lure(
        A=-np.diag(rate),
        G=np.diag(rate),
        H=H,
        F=np.eye(size),
        B=np.zeros((size, size)),
        C=H,
        D=np.eye(size),
        slope=droop.slope[free],
        phi=droop.take(free),
    )
    try:
        out[free] = advance(loop, x[free], at, h)
    except DesignInfeasible:
        out[free] = advance(loop, x[free], at, h, _PATIENT)
    return out
