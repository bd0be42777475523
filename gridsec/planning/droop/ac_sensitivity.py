"""AC power flow of a feeder, and a proven range of its sensitivities over a box of powers.

With the complex impedances Z between customers and the no-load profile E (charging included), the AC
equations are `V = E v0 + Z conj(s / V)`. From a solution V*, s* in the middle of a box follow, in closed
form, bounds of the distance of any other solution in the box and of its sensitivities `d|V|/dp`, `d|V|/dq`.
The bounds hold for the AC power flow itself, without a linear model or sampling.

In three phases V is turned back by the angles of the busbar, `V_i / a_i` with a = (1, e^{-j 2 pi / 3},
e^{j 2 pi / 3}) by phase, and `Z_ij a_j / a_i` takes the place of Z_ij: the equation is the same, magnitudes
are those of the phases, and without charging Z is `R + j X` of `gridsec.grid.three_phase`. With closed loops
Z is the inverse of the admittance matrix without the busbar (`gridsec.grid.meshed`). Z need not be symmetric,
its parts may be negative, and the feeder need not be a tree.

Source: docs/theory-studies.md, section on the droop fleet; bolognani2016 and wang2018 for this form of the
equation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gridsec.arrays import Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.grid import AnyNetwork
from gridsec.grid.meshed import MeshedFeeder, PhasedMesh
from gridsec.grid.network import below, from_root
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder, common_paths
from gridsec.grid.three_phase import ROTATION

__all__ = [
    "Complex",
    "InjectionBox",
    "PhasorNetwork",
    "Region",
    "Sensitivity",
    "currents",
    "lines",
    "network",
    "neumann",
    "region",
    "sensitivity",
    "solve",
]

Complex = NDArray[np.complex128]

_TOL = 1e-13
"""Largest change of a voltage in a converged fixed-point iteration, pu."""

_ROUNDS = 400

_GROWTH = 1e-3
"""Relative increase of a radius, so that its box is mapped strictly into itself."""

_SLACK = 1e-9
"""Rounding allowance of a solved power flow in a proven voltage, pu."""


@dataclass(frozen=True, slots=True, eq=False)
class PhasorNetwork:
    """Coefficients of `V = E v0 + Z conj(s / V)` at the customers, and at all places. N customers, n places.

    A place is a bus, or in three phases a phase of one. The busbar has k voltages, 1 or 3.
    """

    # Z, E (N, N), (N,): impedances between customers, and their voltages without load for 1 pu at the busbar
    Z: Complex
    E: Complex
    of_busbar: Complex  # (N, k) the same for 1 pu at each of its voltages alone
    # Z_bus, E_bus (n, N), (n,): Z and E for every place
    Z_bus: Complex
    E_bus: Complex


def network(feeder: AnyNetwork) -> PhasorNetwork:
    """Impedances of a feeder, `(I + j Z0 B)^-1 Z0` with series impedances Z0 and charging B.

    Raises DesignInfeasible if the no-load voltage of three phases is not found because of too much charging.
    """
    if isinstance(feeder, PhasedFeeder):
        return _phased(feeder)
    if isinstance(feeder, MeshedFeeder | PhasedMesh):
        return _meshed(feeder)
    everywhere = np.arange(len(feeder.buses))
    Z0 = common_paths(feeder, feeder.r, everywhere) + 1j * common_paths(feeder, feeder.x, everywhere)
    loaded = np.eye(everywhere.size) + 1j * Z0 * feeder.half
    unloaded = np.column_stack([Z0[:, feeder.bus], np.ones(everywhere.size)])
    both = np.asarray(np.linalg.solve(loaded, unloaded), dtype=np.complex128)
    Z_bus, E_bus = both[:, :-1], both[:, -1]
    E = E_bus[feeder.bus]
    return PhasorNetwork(Z_bus[feeder.bus], E, E[:, None], Z_bus, E_bus)


def _meshed(feeder: MeshedFeeder | PhasedMesh) -> PhasorNetwork:
    """Inverses of a meshed feeder, in three phases turned back by the angles of the busbar."""
    idle, Z_bus = feeder.idle.reshape(len(feeder.buses), -1), feeder.transfer
    if isinstance(feeder, PhasedMesh):
        back = np.conj(ROTATION)[np.arange(len(idle)) % 3][:, None]
        idle, Z_bus = back * idle * ROTATION, back * Z_bus * ROTATION[feeder.tree.phase]
    E_bus, own = idle.sum(axis=1), feeder.bus
    return PhasorNetwork(Z_bus[own], E_bus[own], idle[own], Z_bus, E_bus)


def _phased(feeder: PhasedFeeder) -> PhasorNetwork:
    """Impedances by sweeps for each customer's current and each busbar voltage, iterated for the charging."""
    tree, count = feeder.tree, feeder.bus.size
    idle: Complex = np.zeros((count + 3, 3, len(tree.buses)), dtype=np.complex128)
    idle[count:] = np.eye(3)[:, :, None]
    drawn: Complex = np.zeros_like(idle)
    # 1 pu of the power of a phase is a third of S.
    drawn[np.arange(count), tree.phase, tree.at] = -3.0
    V, change = idle, np.inf
    with np.errstate(all="ignore"):
        for _ in range(_ROUNDS if tree.half.any() else 1):
            charged = 1j * np.einsum("kij,cjk->cik", tree.half, V)
            flow = np.einsum("bij,cjb->cib", tree.z, below(tree.walk, drawn + charged)[..., 1:])
            new: Complex = idle - from_root(tree.walk, flow)
            V, change = new, float(np.abs(new - V).max())
            if not change > _TOL:
                break
    if tree.half.any() and not change <= _TOL:
        raise DesignInfeasible("voltages of the feeder without load", "too much charging", code="no-solution")
    source = np.concatenate([ROTATION[tree.phase], ROTATION])
    turned = source[:, None, None] * V / ROTATION[:, None]
    every = turned.transpose(2, 1, 0).reshape(len(feeder.buses), count + 3)
    Z_bus, each = every[:, :count], every[:, count:]
    E_bus, own = np.asarray(each.sum(axis=1)), feeder.bus
    return PhasorNetwork(Z_bus[own], E_bus[own], each[own], Z_bus, E_bus)


def solve(net: PhasorNetwork, s: Complex, v0: Floats | float) -> Complex:
    """Voltages of the customers by AC power flow; NaN where the iteration does not converge.

    s (…, N): net complex injections (generation positive), pu.
    v0 (…) or scalar: voltage of the busbar, pu.
    Returns (…, N): complex voltages, pu; the busbar has angle 0.
    """
    base = np.asarray(v0, dtype=np.float64)[..., None] * net.E
    V = np.array(np.broadcast_to(base, np.broadcast_shapes(base.shape, s.shape)))
    flown, through = np.conj(s), net.Z.T
    change = np.full(V.shape[:-1], np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_ROUNDS):
            new = base + (flown / np.conj(V)) @ through
            change = np.max(np.abs(new - V), axis=-1, initial=0.0)
            V = new
            if not np.any(change > _TOL):
                break
    V[~(change <= _TOL)] = np.nan
    return V


def currents(feeder: AnyNetwork, net: PhasorNetwork, s: Complex, V: Complex, v0: Floats | float) -> Floats:
    """Largest current at either end of every conductor of every line, pu. L lines: branches, then ties.

    feeder, net, s, V, v0: as in `solve`, with its result.
    Returns (…, L, k): magnitudes, in units of `base_kva / (3 base_volt)` with the base of the line's
        impedance; k is 1, or in three phases 3.
    """
    at = np.asarray(v0, dtype=np.float64)[..., None] * net.E_bus + np.conj(s / V) @ net.Z_bus.T
    if isinstance(feeder, PhasedFeeder):
        return _phase_currents(feeder, np.conj(s / V), at)
    if isinstance(feeder, PhasedMesh):
        return _mesh_currents(feeder, at)
    ends, z, charging = lines(feeder)
    above, here = at[..., ends[:, 0]], at[..., ends[:, 1]]
    series, shunt = (above - here) / z, 0.5j * charging
    return np.maximum(np.abs(series + shunt * above), np.abs(series - shunt * here))[..., None]


def lines(feeder: Feeder | MeshedFeeder) -> tuple[Ints, Complex, Floats]:
    """Ends (L, 2), impedance (L,) and charging (L,) of every branch, and then of every tie, pu."""
    tree = feeder if isinstance(feeder, Feeder) else feeder.tree
    ends, z = np.column_stack([tree.parent, np.arange(1, len(tree.buses))]), tree.r + 1j * tree.x
    if isinstance(feeder, Feeder):
        return ends, z, tree.charging
    return (
        np.vstack([ends, feeder.ends]),
        np.concatenate([z, feeder.r + 1j * feeder.x]),
        np.concatenate([tree.charging, feeder.charging]),
    )


def _phase_currents(feeder: PhasedFeeder, injected: Complex, at: Complex) -> Floats:
    """`currents` of the phases, from the injections (…, N) and the voltages of the places (…, n)."""
    tree = feeder.tree
    V = ROTATION[:, None] * np.moveaxis(at.reshape(*at.shape[:-1], len(tree.buses), 3), -1, -2)
    drawn = 1j * np.einsum("kij,...jk->...ik", tree.half, V)
    flat = drawn.reshape(-1, 3, len(tree.buses))
    for row, each in zip(flat, injected.reshape(-1, tree.at.size), strict=True):
        np.add.at(row, (tree.phase, tree.at), -3.0 * ROTATION[tree.phase] * each)
    series = below(tree.walk, flat.reshape(V.shape))[..., 1:]
    shunt = 0.5j * tree.charging
    above, here = (
        np.einsum("bij,...jb->...ib", shunt, V[..., ends]) for ends in (tree.parent, slice(1, None))
    )
    return np.asarray(np.swapaxes(np.maximum(np.abs(series + above), np.abs(series - here)), -1, -2))


def _mesh_currents(feeder: PhasedMesh, at: Complex) -> Floats:
    """`currents` of the phases, from the voltages of the places (…, n) over the impedances between them."""
    tree = feeder.tree
    V = (at * np.tile(ROTATION, len(tree.buses))).reshape(*at.shape[:-1], len(tree.buses), 3)
    ends = np.vstack([np.column_stack([tree.parent, np.arange(1, len(tree.buses))]), feeder.ends])
    y: Complex = np.zeros((len(ends), 3, 3), dtype=np.complex128)
    for out, z, there in zip(y, [*tree.z, *feeder.z], [*tree.phases[1:], *feeder.phases], strict=True):
        out[np.ix_(there, there)] = np.linalg.inv(z[np.ix_(there, there)])
    shunt = 0.5j * np.concatenate([tree.charging, feeder.charging])
    above, here = V[..., ends[:, 0], :], V[..., ends[:, 1], :]

    def over(matrices: Complex, v: Complex) -> Complex:
        return np.asarray(np.einsum("lij,...lj->...li", matrices, v))

    series = over(y, above - here)
    return np.maximum(np.abs(series + over(shunt, above)), np.abs(series - over(shunt, here)))


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """Linearised AC power flow at a solution, relative voltages `xi = dV / V`."""

    # a, b (N, N): `xi = a c + b conj(c)` for a change c of the conjugate injections
    a: Complex
    b: Complex
    busbar: Complex  # (N, k) xi per pu of each voltage of the busbar
    v: Floats  # (N,) voltage magnitudes, pu

    @property
    def p(self) -> Complex:
        """Relative voltages xi per pu of active injection, (N, N)."""
        return self.a + self.b

    @property
    def q(self) -> Complex:
        """Relative voltages xi per pu of reactive injection, (N, N)."""
        return -1j * (self.a - self.b)

    @property
    def dv_dq(self) -> Floats:
        """Voltage magnitudes per pu of reactive injection, (N, N)."""
        return np.asarray(self.v[:, None] * self.q.real)


def sensitivity(net: PhasorNetwork, s: Complex, V: Complex) -> Sensitivity:
    """Linearise the AC power flow at a solution.

    `xi + M conj(xi) = Zr c` with `Zr_ij = Z_ij / (V_i conj(V_j))` and `M = Zr diag(conj(s))`, hence
    `(I - M conj(M)) xi = Zr c - M conj(Zr c)`.

    net, s, V: as in `solve`, one operating point, with its result.
    Raises DesignInfeasible if there is no solution at this point.
    """
    if not np.isfinite(V).all():
        raise DesignInfeasible(
            "sensitivities of the feeder",
            "the AC power flow has no solution at this point",
            code="no-solution",
        )
    relative = net.Z / V[:, None] / np.conj(V)
    M = relative * np.conj(s)
    sources = [each / V for each in net.of_busbar.T]
    inverse = np.linalg.inv(np.eye(V.size) - M @ np.conj(M))
    return Sensitivity(
        a=inverse @ relative,
        b=-inverse @ M @ np.conj(relative),
        busbar=np.column_stack([inverse @ (source - M @ np.conj(source)) for source in sources]),
        v=np.abs(V),
    )


@dataclass(frozen=True, slots=True, eq=False)
class InjectionBox:
    """Box of injections and busbar voltages, pu."""

    # p_low, p_high, q_low, q_high (N,): limits of the net injections (generation positive), inverters
    # included
    p_low: Floats
    p_high: Floats
    q_low: Floats
    q_high: Floats
    # v0_low, v0_high: limits of the busbar's voltage; in three phases of each of the three, independently
    v0_low: float
    v0_high: float


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Bounds of the AC power flow in a box.

    Every chord of the AC power flow in the box, `v - v' = Jp (p - p') + Jq (q - q') + J0 (v0 - v0')`, has
    coefficients within the given errors of the given ones.
    """

    # dv_dp, dv_dq (N, N): sensitivities of the voltage magnitudes in the middle of the box
    dv_dp: Floats
    dv_dq: Floats
    # p_error, q_error (N, N): largest differences of those anywhere in the box, entry by entry
    p_error: Floats
    q_error: Floats
    # dv_dv0, v0_error (N, k): the same for the voltages of the busbar
    dv_dv0: Floats
    v0_error: Floats
    # low, high (N,): proven limits of the voltage magnitudes in the box, pu
    low: Floats
    high: Floats


def region(net: PhasorNetwork, box: InjectionBox) -> Region:
    """Bound voltages and sensitivities of the AC power flow over a box of injections.

    Raises DesignInfeasible if the box is too large, or too near collapse, for a bound.
    """
    middle, half = _split(box)
    s, v0 = middle[0] + 1j * middle[1], 0.5 * (box.v0_low + box.v0_high)
    at = sensitivity(net, s, solve(net, s, v0))
    swing = 0.5 * (box.v0_high - box.v0_low)
    gain, away = np.abs(at.a) + np.abs(at.b), np.hypot(*half)
    r = _radius(gain, np.abs(s), away, np.abs(at.busbar).sum(axis=1) * swing)
    feedback = gain * ((away + np.abs(s) * (2.0 + r) * r) / (1.0 - r) ** 2)
    amplify = neumann(feedback)
    if amplify is None:
        raise DesignInfeasible(
            "sensitivities over all powers in the box", "it reaches too near to collapse", code="no-solution"
        )
    tilt = gain * (r / (1.0 - r))

    def error(xi: Complex, own: Floats) -> Floats:
        # Change of d xi, and rotation of the direction in which a voltage's magnitude grows.
        change = own + feedback @ (amplify @ (np.abs(xi) + own))
        turned = (1.0 - np.sqrt(1.0 - r**2))[:, None] * np.abs(xi.real) + r[:, None] * np.abs(xi.imag)
        return np.asarray(at.v[:, None] * (change + turned))

    columns = [(at.p, tilt), (at.q, tilt), (at.busbar, np.zeros(at.busbar.shape))]
    J = np.hstack([at.v[:, None] * xi.real for xi, _ in columns])
    off = np.hstack([error(xi, own) for xi, own in columns])
    low, high = _limits(net, box, at.v, J, off)
    n = r.size
    p, q, busbar = slice(n), slice(n, 2 * n), slice(2 * n, None)
    return Region(
        dv_dp=J[:, p],
        dv_dq=J[:, q],
        p_error=off[:, p],
        q_error=off[:, q],
        dv_dv0=J[:, busbar],
        v0_error=off[:, busbar],
        low=low,
        high=high,
    )


def _split(box: InjectionBox) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Middles and half-widths of p and q."""
    return (
        (0.5 * (box.p_low + box.p_high), 0.5 * (box.q_low + box.q_high)),
        (0.5 * (box.p_high - box.p_low), 0.5 * (box.q_high - box.q_low)),
    )


def _radius(gain: Floats, s: Floats, away: Floats, source: Floats) -> Floats:
    """A radius r with `gain (away + |s| r^2) / (1 - r) + source <= r < 1`: no solution is further away."""

    def reach(r: Floats) -> Floats:
        return np.asarray(gain @ ((away + s * r**2) / (1.0 - r)) + source)

    r = source
    for _ in range(_ROUNDS):
        larger = reach(r)
        settled = bool(np.all(larger <= (1.0 + 0.1 * _GROWTH) * r))
        r = larger
        if settled or not np.all(r < 0.9):
            break
    r = (1.0 + _GROWTH) * r
    if not (np.all(r < 0.9) and np.all(reach(r) <= r)):
        raise DesignInfeasible(
            "voltages over all powers in the box", "it reaches too near to collapse", code="no-solution"
        )
    return r


def neumann(feedback: Floats) -> Floats | None:
    """`(I - feedback)^-1`, which exists and is not negative exactly if the spectral radius is below 1."""
    size = feedback.shape[0]
    inverse = np.linalg.inv(np.eye(size) - feedback)
    # x = (I - F)^-1 1 with x >= 1 and F x < x proves it, by Perron and Frobenius.
    x = inverse @ np.ones(size)
    return np.maximum(inverse, 0.0) if np.all(x >= 0.5) and np.all(feedback @ x < x) else None


def _limits(
    net: PhasorNetwork, box: InjectionBox, middle: Floats, J: Floats, off: Floats
) -> tuple[Floats, Floats]:
    """Better of two bounds: from the middle, and from the corner that is extreme without negative J."""
    swing = np.full(net.of_busbar.shape[1], box.v0_high - box.v0_low)
    width = np.concatenate([box.p_high - box.p_low, box.q_high - box.q_low, swing])
    spread = (np.abs(J) + off) @ (0.5 * width)
    fall = np.minimum(J - off, 0.0) @ width
    bottom = np.abs(solve(net, box.p_low + 1j * box.q_low, box.v0_low))
    top = np.abs(solve(net, box.p_high + 1j * box.q_high, box.v0_high))
    low = np.fmax(middle - spread, bottom + fall) - _SLACK
    high = np.fmin(middle + spread, top - fall) + _SLACK
    return low, high
