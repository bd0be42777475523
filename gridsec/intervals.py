"""How far the sweeps of a power flow lead for *all* powers within intervals, not only for those at hand.

A sweep sends voltages V to ``W + Z conj(s / V)``, less what charging draws. From the start ``V0 = W`` the
first, V1, is linear in the powers s, and V2 is what estimators take the loss correction from. For other
powers s', ``|s' - s| <= e``, everything that changes is bounded by sums of magnitudes: no sign of R or X is
needed and no symmetry, of which three phases have neither and loops only one. Derivation:
docs/theory-three-phase.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Phasors


@dataclass(frozen=True, slots=True, eq=False)
class Sweeps:
    """The first two sweeps at one operating point, for places in an array of any shape.

    Attributes
    ----------
    flat, first, second
        V0, V1 and V2.
    power
        |s| of each place, pu.
    reach
        From the magnitudes of currents to the largest change of the voltages that they can make.
    charge
        From changes of voltages to those of the currents that charge the lines, as far as `reach` has no
        charging in it.
    """

    flat: Phasors
    first: Phasors
    second: Phasors
    power: Floats
    reach: Callable[[Floats], Floats]
    charge: Callable[[Floats], Floats]


def bounds(sweeps: Sweeps, error: Floats) -> tuple[Floats, Floats]:
    """How far the correction moves within the intervals, and how far it stays from the AC power flow there.

    With ``d = Z (e / |V0|)``, which bounds ``|V1' - V1|`` and is linear in the powers, and
    ``l = |V1| - d``, the rest of what V2 moves is at most

        c = Z (e (|V1 - V0| + d) / (l |V0|) + |s| d / (l |V1|)),

    and its square moves, apart from what is linear, by ``2 |V2 - V0| d + 2 |V2| c + (d + c)^2``. All further
    sweeps are within ``m = 0.9 (|V2| - d - c)`` of no voltage: each changes by at most
    ``M = Z (|s| + e) / (m min(m, l))`` times the change before it, the first of them by ``|V2 - V1| + c``. If
    M shrinks every change, their sum is finite, and the AC power flow is where they end (Banach).

    Parameters
    ----------
    sweeps
        The operating point.
    error
        e, the largest change of the power of each place, pu.

    Returns
    -------
    Floats, Floats
        For every place: bounds on the change of ``|V2|^2`` less its linear part, and on
        ``| |V|^2 - |V2|^2 |`` anywhere in the intervals, pu; infinite
        where M does not shrink, near voltage collapse.
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


# How near to V2, as a part of it, the power flow is looked for.
_NEAR = 0.1
# Sweeps that are summed up place by place before the largest change anywhere bounds all that follow.
_TERMS = 4
