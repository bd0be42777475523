"""Bounds of the sweeps of a power flow for *all* powers within intervals.

A sweep maps voltages V to ``W + Z conj(s / V)``, less the drop by charging. From the start ``V0 = W`` the
first, V1, is linear in the powers s; estimators take the loss correction from the second, V2. For other
powers s', ``|s' - s| <= e``, every change is bounded by sums of magnitudes. This needs no sign of R or X
and no symmetry: three phases have neither, loops only one. Derivation: docs/theory-three-phase.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Phasors


@dataclass(frozen=True, slots=True, eq=False)
class Sweeps:
    """The first two sweeps at one operating point, for places in an array of any shape."""

    # flat, first, second: V0, V1 and V2
    flat: Phasors
    first: Phasors
    second: Phasors
    power: Floats  # |s| of each place, pu
    # maps magnitudes of currents to the largest voltage changes that they can cause
    reach: Callable[[Floats], Floats]
    # maps voltage changes to changes of the charging currents, as far as `reach` does not contain them
    charge: Callable[[Floats], Floats]


def bounds(sweeps: Sweeps, error: Floats) -> tuple[Floats, Floats]:
    """Bounds of the loss correction's change within the intervals and of its distance from the AC power flow.

    With ``d = Z (e / |V0|)``, which bounds ``|V1' - V1|`` and is linear in the powers, and ``l = |V1| - d``,
    the nonlinear part of the change of V2 is at most

        c = Z (e (|V1 - V0| + d) / (l |V0|) + |s| d / (l |V1|)),

    and its square changes, apart from the linear part, by ``2 |V2 - V0| d + 2 |V2| c + (d + c)^2``. All
    further sweeps have magnitudes of at least ``m = 0.9 (|V2| - d - c)``: each changes by at most ``M = Z
    (|s| + e) / (m min(m, l))`` times the change before it, the first of them by ``|V2 - V1| + c``. If M
    shrinks every change, their sum is finite, and the AC power flow is their limit (Banach).

    error: e, the largest change of the power of each place, pu.
    Returns Floats, Floats: for every place: bounds on the change of ``|V2|^2`` less its linear part, and on
        ``| |V|^2 - |V2|^2 |`` anywhere in the intervals, pu; infinite where M does not shrink, near voltage
        collapse.
    """
    flat, first, second = np.abs(sweeps.flat), np.abs(sweeps.first), np.abs(sweeps.second)
    with np.errstate(all="ignore"):
        linear = sweeps.reach(error / flat)
        low = first - linear
        far = np.abs(sweeps.first - sweeps.flat) + linear
        currents = error * far / (low * flat) + sweeps.power * linear / (low * first)
        more = sweeps.reach(currents + sweeps.charge(linear))
        moved = linear + more
        least = second - moved
        near = (1.0 - _NEAR) * least
        weight = (sweeps.power + error) / (near * np.minimum(near, low))

        def after(change: Floats) -> Floats:
            return sweeps.reach(weight * change + sweeps.charge(change))

        each = after(np.ones(flat.shape))
        shrink = np.max(each, initial=0.0)
        off, change = np.zeros(flat.shape), after(np.abs(sweeps.second - sweeps.first) + more)
        for _ in range(_TERMS):
            off, change = off + change, after(change)
        off = off + change + each * np.max(change, initial=0.0) / (1.0 - shrink)
        correction = 2.0 * np.abs(sweeps.second - sweeps.flat) * linear + 2.0 * second * more + moved**2
        rest = off * (2.0 * (second + moved) + off)
        holds = shrink < 1.0 and bool(np.all((low > 0.0) & (least > 0.0) & (off <= _NEAR * least)))
    if not holds:
        nothing = np.full(flat.shape, np.inf)
        return nothing, nothing
    return np.asarray(correction), np.asarray(rest)


# Radius around V2, as a fraction of it, within which the power flow is located.
_NEAR = 0.1
# Number of sweeps summed place by place before the largest change anywhere bounds all later ones.
_TERMS = 4
