"""Power flow of a meshed feeder through the inverse of its admittances, balanced or in three phases.

``V = W + Z conj(s / V)`` holds for the places of three phases as for the buses of a balanced feeder, with W
the voltages without load by the busbar's phases. Nothing below depends on the number of phases, or needs Z
to be symmetric or of any sign. Derivations: docs/theory-mesh.md.

References
----------
.. [1] C. Wang, A. Bernstein, J.-Y. Le Boudec, M. Paolone, "Explicit conditions on existence and uniqueness
   of load-flow solutions in distribution networks", IEEE Trans. Smart Grid 9(2), 2018: the fixed point.
.. [2] A. Bernstein, C. Wang, E. Dall'Anese, J.-Y. Le Boudec, C. Zhao, "Load flow in multiphase distribution
   networks: existence, uniqueness, non-singularity and linear models", IEEE Trans. Power Systems 33(6), 2018.
"""

from __future__ import annotations

import numpy as np

from gridsec.arrays import Floats, Phasors, frozen
from gridsec.feeder import LinDistFlow
from gridsec.intervals import Sweeps, bounds
from gridsec.mesh.balanced import MeshedFeeder
from gridsec.mesh.phased import PhasedMesh
from gridsec.phases.feeder import PHASES, ROTATION

Meshed = MeshedFeeder | PhasedMesh
"""A feeder with closed loops."""


def bus_voltages(
    feeder: Meshed, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1
) -> Floats:
    """Squared voltage of every place, corrected for losses, charging and, in three phases, unequal phases.

    The fixed-point iteration ``V <- W + Z conj(s / V)`` from ``V = W``: its first iterate has the voltages of
    the linear power flow and the square of its drops, and every step after it gains one order in the load, as
    a step of `gridsec.feeder.loss_correction` does.

    Parameters
    ----------
    p, q : (…, N)
        Net active and reactive injection of each customer (generation positive), pu.
    v0_squared : (…) or scalar
        Squared busbar voltage, pu; in three phases (3,), one for each, or scalar.
    steps
        Steps after the first iterate; 0 gives the linear power flow.

    Returns
    -------
    (…, n)
        Squared voltages, pu; on a balanced feeder n = b + 1.
    """
    if not steps:
        base = np.asarray(v0_squared, dtype=np.float64)[..., None]
        if isinstance(feeder, PhasedMesh):
            base = np.tile(np.broadcast_to(v0_squared, len(PHASES)), len(feeder.tree.buses))
        return np.asarray(base + 2.0 * (p @ feeder.R.T + q @ feeder.X.T))
    s, idle, here = _start(feeder, p, q, v0_squared)
    V = here
    for _ in range(steps):
        V = here + np.conj(s / V) @ feeder.between.T
    V = idle + np.conj(s / V) @ feeder.transfer.T
    return np.asarray(V.real**2 + V.imag**2)


def sensitivities(
    feeder: Meshed, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 4
) -> LinDistFlow:
    """Derivatives of squared voltages at an operating point, halved: R and X under load.

    A change ds of one customer's power changes all currents, because powers are constant. The
    differential of the fixed point,

        dV + Z diag(conj(s / V^2)) conj(dV) = Z conj(ds / V),

    is a real linear system for real and imaginary parts of dV at the customers, solved for all of them at
    once; Re(conj(V) dV) is half the derivative of ``|V|^2``. Without load and charging it is R and X. O(N^3).

    Parameters
    ----------
    p, q : (N,)
        Net active and reactive injection of each customer at the operating point, pu.
    v0_squared
        As in `bus_voltages`.
    steps
        Steps to the voltages of the operating point, as in `bus_voltages`.

    Returns
    -------
    LinDistFlow
        The matrices; ``v^2`` then changes by ``2 R dp + 2 X dq``.
    """
    s, idle, here = _start(feeder, p, q, v0_squared)
    V = here
    for _ in range(steps + 1):
        V = here + feeder.between @ np.conj(s / V)
    turned, alone = feeder.between * np.conj(s / V**2), np.eye(s.size)
    own: Phasors = np.concatenate([np.diag(unit / np.conj(V)) for unit in (1.0, -1j)], axis=1)
    system = np.block([[alone + turned.real, turned.imag], [turned.imag, alone - turned.real]])
    driven = feeder.between @ own
    moved = np.linalg.solve(system, np.concatenate([driven.real, driven.imag]))
    change = moved[: s.size] + 1j * moved[s.size :]
    currents = own - np.conj((s / V**2)[:, None] * change)
    volts = idle + feeder.transfer @ np.conj(s / V)
    R, X = np.split((np.conj(volts)[:, None] * (feeder.transfer @ currents)).real, 2, axis=1)
    return LinDistFlow(*(frozen(each) for each in (R[feeder.bus], X[feeder.bus], R, X)))


def model_error_bound(feeder: Meshed, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Bound of the error of `v^2` after one correction against the AC power flow, for every customer.

    V1 and V2 are the iterates of `bus_voltages`, ``d = |V2 - V1|``, and ``M_ij = |Z_ij| |s_j| / (c_j
    min(|V1_j|, c_j))`` with ``c = 0.9 |V2|``. A step maps all voltages within ``rho <= 0.1 |V2|`` of V2 to a
    distance of at most ``M (rho + d)`` from V2. So if ``M M d <= theta M d`` for a theta below 1, and ``rho =
    M d / (1 - theta)``, the disks of radius rho around V2 are mapped into themselves. They contain a solution
    of the AC power flow (Brouwer), and only one, because theta also bounds the contraction there. If theta is
    1 or more, or rho above 0.1 |V2|, the bound is infinite.

    Parameters
    ----------
    feeder, p, q, v0_squared
        As in `bus_voltages`.

    Returns
    -------
    (…, N)
        Bound on the error of `v^2`, pu.

    References
    ----------
    Wang et al. 2018, for the existence of the solution; the componentwise bound: docs/theory-mesh.md.
    """
    with np.errstate(all="ignore"):
        s, _, idle = _start(feeder, p, q, v0_squared)
        first = idle + np.conj(s / idle) @ feeder.between.T
        second = idle + np.conj(s / first) @ feeder.between.T
        low = (1.0 - _NEAR) * np.abs(second)
        weight = np.abs(s) / (low * np.minimum(low, np.abs(first)))
        once = (weight * np.abs(second - first)) @ feeder.size.T
        twice = (weight * once) @ feeder.size.T
        theta = np.max(np.where(twice > 0.0, twice / once, 0.0), axis=-1, keepdims=True, initial=0.0)
        rho = once / (1.0 - theta)
        holds = (theta < 1.0) & np.all(rho <= _NEAR * np.abs(second), axis=-1, keepdims=True)
        bound = np.where(holds, rho * (2.0 * np.abs(second) + rho), np.inf)
    return np.asarray(bound)


def interval_bounds(
    feeder: Meshed,
    p: Floats,
    q: Floats,
    v0_squared: Floats | float,
    *,
    p_error: Floats,
    q_error: Floats,
) -> tuple[Floats, Floats]:
    """Error bounds of the correction of `bus_voltages` for powers within intervals.

    Parameters
    ----------
    feeder, p, q : (N,), v0_squared
        As in `bus_voltages`, one operating point.
    p_error, q_error : (N,)
        Largest errors of the powers, pu.

    Returns
    -------
    (N,), (N,)
        Change of the correction, and distance of its first step from the AC power flow, pu:
        `gridsec.intervals.bounds`.
    """
    with np.errstate(all="ignore"):
        s, _, idle = _start(feeder, p, q, v0_squared)
        first = idle + np.conj(s / idle) @ feeder.between.T
        second = idle + np.conj(s / first) @ feeder.between.T
    error = np.hypot(p_error, q_error)
    sweeps = Sweeps(idle, first, second, np.abs(s), lambda current: feeder.size @ current, np.zeros_like)
    moved, rest = bounds(sweeps, error)
    # The linear power flow assumes no charging and equal phases of the busbar; the first sweep has the actual
    # ones.
    linear = (feeder.R + 1j * feeder.X)[feeder.bus]
    apart = np.abs(np.conj(idle)[:, None] * feeder.between / np.conj(idle) - linear)
    return np.asarray(moved + 2.0 * (apart @ error)), rest


# Radius around the second iterate, as a fraction of it, within which a solution is located.
_NEAR = 0.1


def _start(
    feeder: Meshed, p: Floats, q: Floats, v0_squared: Floats | float
) -> tuple[Phasors, Phasors, Phasors]:
    """Powers of the customers (…, N), and voltages without load of all places (…, n) and of the customers."""
    v0 = np.sqrt(np.asarray(v0_squared, dtype=np.float64))
    idle = feeder.idle @ (v0 * ROTATION) if isinstance(feeder, PhasedMesh) else v0[..., None] * feeder.idle
    return np.asarray(p + 1j * q), np.asarray(idle), np.asarray(idle[..., feeder.bus])
