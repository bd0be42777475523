"""The one observer: inverters of trusted meters follow their readings, all others the model.

    tau x' = -x + K(zeta),   zeta = vbar^2 - y at trusted meters,   H x + w elsewhere

It converges for every trusted set and every switching between them by one certificate
(docs/theory-certificates.md). Where everything is trusted, a step is exact and costs O(m).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, indices, submatrix
from gridsec.errors import DesignInfeasible
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.observers.lure import POLICY, Lure, LureTransition, advance, step, transition

_PATIENT = replace(POLICY, settled=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Free:
    """The inverters that follow the model, prepared: they stay the same for many steps.

    Attributes
    ----------
    rows : (k,)
        Which inverters.
    loop
        They among themselves; its input is what all others and the loads do to their voltages.
    transition
        Of the loop, for the last step's length.
    """

    rows: Ints
    loop: Lure
    transition: LureTransition


def drive(  # noqa: PLR0917  # state, what drives it, and for how long
    design: SequentialDesign,
    x: Floats,
    y: Floats,
    driven: Bools,
    w: Floats | None,
    h: float,
    before: Free | None = None,
) -> tuple[Floats, Free | None]:
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
    before
        What the last step prepared; used again while it fits.

    Returns
    -------
    (m,), Free or None
        The injections, and what the next step may use.

    References
    ----------
    chong2020 (5) with K = E_J, L = 0.
    """
    droop = design.plant.droop
    decay = np.exp(-h / droop.tau)
    target = droop(droop.vbar**2 - y)
    if w is None or all_of(driven):
        return np.asarray(target + decay * (x - target)), before
    out = np.where(driven, target + decay * (x - target), x)
    free = _prepared(design, indices(~driven), h, before)
    # The driven ones take the mean of their way from x to out.
    held = np.where(driven, 0.5 * (x + out), 0.0)
    at = w[droop.customer[free.rows]] + design.loop[free.rows] @ held
    try:
        out[free.rows] = step(free.transition, free.loop, x[free.rows], at)
    except DesignInfeasible:
        out[free.rows] = advance(free.loop, x[free.rows], at, h, _PATIENT)
    return out, free


def ahead(design: SequentialDesign, believed: Bools, h: float, before: Free | None) -> Free | None:
    """What the next step needs if the same meters are believed then and it is as long.

    The step after that at which somebody is suspected has the most to do.

    Parameters
    ----------
    design
        The design.
    believed : (p,)
        Meters that are heard and trusted.
    h
        Step, s.
    before
        What was prepared so far.
    """
    driven = (design.meter_of >= 0) & believed[design.meter_of]
    return before if all_of(driven) else _prepared(design, indices(~driven), h, before)


def _prepared(design: SequentialDesign, rows: Ints, h: float, before: Free | None) -> Free:
    if before is None or not np.array_equal(before.rows, rows):
        loop = _among(design, rows)
        return Free(rows, loop, transition(loop, h))
    return before if before.transition.h == h else replace(before, transition=transition(before.loop, h))


def _among(design: SequentialDesign, rows: Ints) -> Lure:
    droop = design.plant.droop
    H = submatrix(design.loop, rows, rows)
    rate, size = 1.0 / droop.tau[rows], rows.size
    return Lure(
        A=-np.diag(rate),
        G=np.diag(rate),
        H=H,
        F=np.eye(size),
        B=np.zeros((size, size)),
        C=H,
        D=np.eye(size),
        slope=droop.slope[rows],
        phi=droop.take(rows),
    )
