"""Observer of the droop inverters, driven by trusted meters or by the model.

    tau x' = -x + K(zeta),   zeta = vbar^2 - y at trusted meters,   H x + w elsewhere

One certificate covers every trusted set and every switching (docs/theory-certificates.md). With all meters
trusted a step is exact and costs O(m).
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
class ModelDriven:
    """Prepared loop of the model-driven inverters, reused for the same inverters and step."""

    rows: Ints  # (k,) inverters
    loop: Lure  # their mutual loop; its input is the effect of all other injections and loads
    transition: LureTransition  # of the loop, for the last step's length


def advance_inverters(  # noqa: PLR0917
    design: SequentialDesign,
    x: Floats,
    y: Floats,
    driven: Bools,
    w: Floats | None,
    h: float,
    before: ModelDriven | None = None,
) -> tuple[Floats, ModelDriven | None]:
    """Injections a time h later, and the prepared loop; chong2020 (5) with K = E_J, L = 0.

    x, y, driven: (m,) injections, squared voltages of the inverters' meters, and use of these. w: (N,) input
    of the model-driven inverters; None if all are driven.
    """
    droop = design.plant.droop
    decay = np.exp(-h / droop.tau)
    target = droop(droop.vbar**2 - y)
    if w is None or all_of(driven):
        return np.asarray(target + decay * (x - target)), before
    out = np.where(driven, target + decay * (x - target), x)
    free = _prepared(design, indices(~driven), h, before)
    # Driven inverters enter by the mean of x and out.
    held = np.where(driven, 0.5 * (x + out), 0.0)
    at = w[droop.customer[free.rows]] + design.loop[free.rows] @ held
    try:
        out[free.rows] = step(free.transition, free.loop, x[free.rows], at)
    except DesignInfeasible:
        out[free.rows] = advance(free.loop, x[free.rows], at, h, _PATIENT)
    return out, free


def prepare(
    design: SequentialDesign, believed: Bools, h: float, before: ModelDriven | None
) -> ModelDriven | None:
    """Loop for the next step if the trusted meters with a reading, (p,), stay the same.

    Prepared at the tick of a suspicion, since the tick after it has more to compute.
    """
    driven = (design.meter_of >= 0) & believed[design.meter_of]
    return before if all_of(driven) else _prepared(design, indices(~driven), h, before)


def _prepared(design: SequentialDesign, rows: Ints, h: float, before: ModelDriven | None) -> ModelDriven:
    if before is None or not np.array_equal(before.rows, rows):
        loop = _loop(design, rows)
        return ModelDriven(rows, loop, transition(loop, h))
    return before if before.transition.h == h else replace(before, transition=transition(before.loop, h))


def _loop(design: SequentialDesign, rows: Ints) -> Lure:
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
