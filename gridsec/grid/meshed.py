"""Feeders with closed ties, balanced or in three phases, and their power flow.

`MeshedFeeder` and `PhasedMesh` are a tree and the lines that close loops in it. With W the voltage without
load by the busbar, and ``Z = R + j X`` the inverse of the admittance matrix without the busbar, powers s and
voltages V of the other places obey

    V = W + Z conj(s / V).

To first order in s, and without charging, ``|V|^2 = v0^2 + 2 Re(Z conj(s)) = v0^2 + 2 R p + 2 X q``. On a
tree Z has the sums of common paths, so that this is LinDistFlow. With ties its entries may be negative, but
it stays symmetric, and both parts positive semidefinite.

In three phases Z is the inverse of the admittances between phases of buses. With the busbar's phases a third
of a turn apart, a = 1, e^{-j 2 pi / 3}, e^{j 2 pi / 3}, the derivative of ``|V|^2`` at no load is ``2 Re(Z_kl
a_l / a_k conj(s_l))``: on a tree LinDist3Flow. Z is symmetric; the rotated matrix is not. The methods of
`Meshed` depend neither on the number of phases nor on symmetry or signs of Z.

Source: docs/theory-mesh.md; bolognani2016 for the model of networks of any form; wang2018 for the fixed
point; in three phases A. Bernstein, C. Wang, E. Dall'Anese, J.-Y. Le Boudec, C. Zhao, "Load flow in
multiphase distribution networks", IEEE Trans. Power Systems 33(6), 2018.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from gridsec.arrays import Bools, Floats, Ints, Phasors, frozen, frozen_ints, put
from gridsec.errors import FeederInvalid, Problem, wrong_shapes
from gridsec.grid import three_phase
from gridsec.grid.intervals import Sweeps, bounds
from gridsec.grid.network import Balanced, LinDistFlow, OfMatrices, OnTree, WithMatrices, unbounded
from gridsec.grid.phased import InPhases, PhasedFeeder
from gridsec.grid.radial import Feeder, common_paths, line_problems
from gridsec.grid.three_phase import PHASES, ROTATION, ThreePhaseFeeder, customers_at, named


class _Admittances(WithMatrices, Protocol):
    @property
    def idle(self) -> Phasors: ...
    @property
    def transfer(self) -> Phasors: ...
    @property
    def transfer_between(self) -> Phasors: ...
    @property
    def size(self) -> Floats: ...
    def without_load(self, v0_squared: Floats | float) -> Phasors: ...
    def without_drop(self, v0_squared: Floats | float) -> Floats: ...


class Meshed(OfMatrices):
    """Methods of feeders with closed loops, by the inverse of their admittances."""

    __slots__ = ()

    def bus_voltages(
        self: _Admittances, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1
    ) -> Floats:
        """Squared voltage of every place, corrected for losses, charging and unequal phases.

        The fixed-point iteration ``V <- W + Z conj(s / V)`` from ``V = W``: its first iterate has the
        voltages of the linear power flow and the square of its drops, and every step after it gains one order
        in the load, as a step of `Feeder.loss_correction` does.

        p, q (…, N): net active and reactive injection of each customer (generation positive), pu.
        v0_squared (…) or scalar: squared busbar voltage, pu; in three phases (3,), one for each, or scalar.
        steps: steps after the first iterate; 0 gives the linear power flow.
        Returns (…, n): squared voltages, pu; on a balanced feeder n = b + 1.
        """
        if not steps:
            base = self.without_drop(v0_squared)
            return np.asarray(base + 2.0 * (p @ self.R.T + q @ self.X.T))
        s, idle, here = _start(self, p, q, v0_squared)
        V = here
        for _ in range(steps):
            V = here + np.conj(s / V) @ self.transfer_between.T
        V = idle + np.conj(s / V) @ self.transfer.T
        return np.asarray(V.real**2 + V.imag**2)

    def sensitivities(
        self: _Admittances, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 4
    ) -> LinDistFlow:
        """Derivatives of squared voltages at an operating point, halved: R and X under load.

        A change ds of one customer's power changes all currents, because powers are constant. The
        differential of the fixed point,

            dV + Z diag(conj(s / V^2)) conj(dV) = Z conj(ds / V),

        is a real linear system for real and imaginary parts of dV at the customers, solved for all of them at
        once; Re(conj(V) dV) is half the derivative of ``|V|^2``. Without load and charging it is R and X.
        O(N^3).

        p, q (N,): net active and reactive injection of each customer at the operating point, pu.
        v0_squared: as in `bus_voltages`.
        steps: steps to the voltages of the operating point, as in `bus_voltages`.
        Returns LinDistFlow: the matrices; ``v^2`` then changes by ``2 R dp + 2 X dq``.
        """
        s, idle, here = _start(self, p, q, v0_squared)
        V = here
        for _ in range(steps + 1):
            V = here + self.transfer_between @ np.conj(s / V)
        turned, alone = self.transfer_between * np.conj(s / V**2), np.eye(s.size)
        own: Phasors = np.concatenate([np.diag(unit / np.conj(V)) for unit in (1.0, -1j)], axis=1)
        system = np.block([[alone + turned.real, turned.imag], [turned.imag, alone - turned.real]])
        driven = self.transfer_between @ own
        moved = np.linalg.solve(system, np.concatenate([driven.real, driven.imag]))
        change = moved[: s.size] + 1j * moved[s.size :]
        currents = own - np.conj((s / V**2)[:, None] * change)
        volts = idle + self.transfer @ np.conj(s / V)
        R, X = np.split((np.conj(volts)[:, None] * (self.transfer @ currents)).real, 2, axis=1)
        return LinDistFlow(*(frozen(each) for each in (R[self.bus], X[self.bus], R, X)))

    def model_error_bound(self: _Admittances, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
        """Bound of the error of `v^2` after one correction against the AC power flow, for every customer.

        V1 and V2 are the iterates of `bus_voltages`, ``d = |V2 - V1|``, and ``M_ij = |Z_ij| |s_j| / (c_j
        min(|V1_j|, c_j))`` with ``c = 0.9 |V2|``. A step maps all voltages within ``rho <= 0.1 |V2|`` of V2
        to a distance of at most ``M (rho + d)`` from V2. So if ``M M d <= theta M d`` for a theta below 1,
        and ``rho = M d / (1 - theta)``, the disks of radius rho around V2 are mapped into themselves. They
        contain a solution of the AC power flow (Brouwer), and only one, because theta also bounds the
        contraction there. If theta is 1 or more, or rho above 0.1 |V2|, the bound is infinite.

        p, q, v0_squared: as in `bus_voltages`.
        Returns (…, N): bound on the error of `v^2`, pu.
        Source: Wang et al. 2018, for the existence of the solution; the componentwise bound:
            docs/theory-mesh.md.
        """
        with np.errstate(all="ignore"):
            s, _, idle = _start(self, p, q, v0_squared)
            first = idle + np.conj(s / idle) @ self.transfer_between.T
            second = idle + np.conj(s / first) @ self.transfer_between.T
            low = (1.0 - _NEAR) * np.abs(second)
            weight = np.abs(s) / (low * np.minimum(low, np.abs(first)))
            once = (weight * np.abs(second - first)) @ self.size.T
            twice = (weight * once) @ self.size.T
            theta = np.max(np.where(twice > 0.0, twice / once, 0.0), axis=-1, keepdims=True, initial=0.0)
            rho = once / (1.0 - theta)
            holds = (theta < 1.0) & np.all(rho <= _NEAR * np.abs(second), axis=-1, keepdims=True)
            bound = np.where(holds, rho * (2.0 * np.abs(second) + rho), np.inf)
        return np.asarray(bound)

    def interval_bounds(
        self: _Admittances,
        p: Floats,
        q: Floats,
        v0_squared: Floats | float,
        *,
        p_error: Floats,
        q_error: Floats,
    ) -> tuple[Floats, Floats]:
        """See `gridsec.grid.network.WithMatrices`; by `gridsec.grid.intervals.bounds`."""
        with np.errstate(all="ignore"):  # NaN gets an infinite bound without a warning
            s, _, idle = _start(self, p, q, v0_squared)
            first = idle + np.conj(s / idle) @ self.transfer_between.T
            second = idle + np.conj(s / first) @ self.transfer_between.T
            error = np.hypot(p_error, q_error)
            sweeps = Sweeps(
                idle, first, second, np.abs(s), lambda current: self.size @ current, np.zeros_like
            )
            moved, rest = bounds(sweeps, error)
            # The linear power flow assumes no charging and equal phases; the first sweep has the actual ones.
            linear = (self.R + 1j * self.X)[self.bus]
            apart = np.abs(np.conj(idle)[:, None] * self.transfer_between / np.conj(idle) - linear)
            moved = moved + 2.0 * (apart @ error)
        return unbounded(moved), unbounded(rest)


@dataclass(frozen=True, slots=True, eq=False)
class MeshedFeeder(Balanced, Meshed, OnTree):
    """Feeder with closed loops. N customers, b + 1 buses, t ties.

    Raises FeederInvalid with every problem found.
    """

    tree: Feeder  # the feeder without the ties: a radial feeder that reaches every bus
    ends: Ints  # (t, 2) buses at both ends of each tie
    # r, x (t,): series resistance and reactance of each tie, pu
    r: Floats
    x: Floats
    charging: Floats  # (t,) total shunt susceptance of each tie, pu; half of it at each end
    half: Floats = field(init=False, repr=False)  # (b + 1,) shunt susceptance at the buses, pu
    # R, X (b + 1, N): the linear power flow ``v^2 = v0^2 + 2 R p + 2 X q``, from a customer's power to every
    # bus
    R: Floats = field(init=False, repr=False)
    X: Floats = field(init=False, repr=False)
    # (b + 1,) voltage of every bus without load, per voltage of the busbar; 1 without charging
    idle: Phasors = field(init=False, repr=False)
    # (b + 1, N) from an injected current of a customer to the voltage of every bus, charging included, pu
    transfer: Phasors = field(init=False, repr=False)
    transfer_between: Phasors = field(init=False, repr=False)  # (N, N) the same to the customers' voltages
    size: Floats = field(init=False, repr=False)  # (N, N) its absolute values

    def __post_init__(self) -> None:
        put(self, r=frozen(self.r), x=frozen(self.x), charging=frozen(self.charging))
        put(self, ends=frozen_ints(self.ends))
        problems = _problems(self)
        if problems:
            raise FeederInvalid(problems)
        put(self, half=_shunts(self.tree.half, self.ends, self.charging))
        Z = impedances(self, self.bus)
        idle, transfer = np.ones((len(Z), 1), dtype=np.complex128), Z
        if self.half.any():
            injected = np.zeros(Z.shape, dtype=np.complex128)
            injected[self.bus, np.arange(self.bus.size)] = 1.0
            idle, transfer = _charged(admittance(self), np.arange(1, len(Z)), 1, injected)
        put(self, R=frozen(Z.real), X=frozen(Z.imag), idle=idle[:, 0], transfer=transfer)
        put(self, transfer_between=transfer[self.bus], size=np.abs(transfer[self.bus]))

    @property
    def bus(self) -> Ints:
        """Bus of each customer, (N,)."""
        return self.tree.bus

    @property
    def buses(self) -> tuple[str, ...]:
        """Identifiers of the buses, the busbar first, (b + 1,)."""
        return self.tree.buses

    def without_load(self, v0_squared: Floats | float) -> Phasors:
        """Voltage of every place without load, (…, n), pu."""
        return np.asarray(np.sqrt(np.asarray(v0_squared, dtype=np.float64))[..., None] * self.idle)

    def with_customers_at(self, places: Ints) -> MeshedFeeder:
        """See `Network`."""
        return replace(self, tree=self.tree.with_customers_at(places))

    def without_drop(self, v0_squared: Floats | float) -> Floats:
        """Squared busbar voltage for every place, by broadcasting."""
        return np.asarray(v0_squared, dtype=np.float64)[..., None]


def _problems(feeder: MeshedFeeder) -> list[Problem]:
    """Problems of the ties against the tree."""
    count, buses = feeder.r.size, len(feeder.tree.buses)
    out = wrong_shapes(
        ("ends", feeder.ends.shape, (count, 2)),
        ("r", feeder.r.shape, (count,)),
        ("x", feeder.x.shape, (count,)),
        ("charging", feeder.charging.shape, (count,)),
    )
    if out:
        return out
    for k, (one, other) in enumerate(feeder.ends.tolist()):
        missing = [end for end in (one, other) if not 0 <= end < buses]
        out.extend(
            Problem("unknown-index", f"tie {k}: bus {end} does not exist; expected 0 to {buses - 1}")
            for end in missing
        )
        if one == other:
            out.append(Problem("self-loop", f"tie {k}: both ends are bus {one}; a line needs two"))
        out.extend(line_problems(f"tie {k}", feeder.r[k], feeder.x[k], feeder.charging[k]))
    return out


def impedances(feeder: MeshedFeeder, buses: Ints) -> Phasors:
    """Columns of the inverse of the reduced admittance matrix, without charging; O(b k t).

    The ties, with ends C (+1 at one, -1 at the other) and impedances z, add ``C z^-1 C^T`` to the admittances
    of the tree, with the common paths T as inverse. The inverse of the sum is (Woodbury)

        Z = T - T C (z + C^T T C)^-1 C^T T,

    with the impedances of the t loops in the middle: no linear system of the feeder's size is solved.

    Returns (b + 1, k): rise of the voltage of every bus for each of them, pu; 0 at the busbar.
    """
    tree = feeder.tree

    def paths(some: Ints) -> Phasors:
        return common_paths(tree, tree.r, some) + 1j * common_paths(tree, tree.x, some)

    Z = paths(buses)
    if feeder.r.size:
        one, other = feeder.ends.T
        across = paths(one) - paths(other)  # T C
        loops = np.diag(feeder.r + 1j * feeder.x) + across[one] - across[other]
        Z = Z - across @ np.linalg.solve(loops, across[buses].T)
    return Z


def admittance(feeder: MeshedFeeder) -> csc_array:
    """Admittance matrix of all buses, charging included, (b + 1, b + 1), pu."""
    tree = feeder.tree
    lines = np.vstack([np.column_stack([tree.parent, np.arange(1, len(tree.buses))]), feeder.ends])
    z = np.concatenate([tree.r, feeder.r]) + 1j * np.concatenate([tree.x, feeder.x])
    signs = np.repeat([1.0, -1.0], len(lines))
    rows = np.tile(np.arange(len(lines)), 2)
    incidence = csc_array((signs, (rows, lines.T.ravel())), shape=(len(lines), len(tree.buses)))
    return csc_array(incidence.T @ diags_array(1.0 / z) @ incidence + diags_array(1j * feeder.half))


def _shunts(of_tree: Floats, ends: Ints, charging: Floats) -> Floats:
    """Shunt susceptance at the buses, with half the charging of each tie at each end."""
    half = of_tree.copy()
    np.add.at(half, ends, 0.5 * charging[:, None])
    return half


def _charged(Y: csc_array, free: Ints, busbar: int, injected: Phasors) -> tuple[Phasors, Phasors]:
    """Voltages without load (n, b), and effects of the customers' currents `injected` (n, N), with charging.

    Y: admittances (n, n). free: places with a voltage to solve for; the first b = `busbar` are given.
    """
    rows = Y.tocsr()[free]
    solver = splu(csc_array(rows[:, free]))
    idle: Phasors = np.eye(injected.shape[0], busbar, dtype=np.complex128)
    idle[free] = solver.solve(-rows[:, :busbar].toarray())
    transfer = np.zeros(injected.shape, dtype=np.complex128)
    transfer[free] = solver.solve(injected[free])
    return idle, transfer


@dataclass(frozen=True, slots=True, eq=False)
class PhasedMesh(InPhases, Meshed, OnTree):
    """Feeder of single-phase customers with closed ties. N customers, t ties, n = 3 (b + 1) places.

    Raises FeederInvalid with every problem found.
    """

    # the feeder without the ties, with customers of one phase; it contains every phase of every bus
    tree: ThreePhaseFeeder
    ends: Ints  # (t, 2) buses at both ends of each tie
    phases: Bools  # (t, 3) phases a, b, c of each tie
    # (t, 3, 3) series impedance of each tie, pu; symmetric, rows and columns of absent phases are 0
    z: Phasors
    charging: Floats  # (t, 3, 3) total shunt susceptance of each tie, pu; half of it at each end
    bus: Ints = field(init=False, repr=False)  # (N,) place of each customer
    # (n,) identifiers of the places, the busbar's three first
    buses: tuple[str, ...] = field(init=False, repr=False)
    half: Floats = field(init=False, repr=False)  # (b + 1, 3, 3) shunt susceptance at the buses, pu
    # R, X (n, N): The linear power flow ``v^2 = v0^2 + 2 R p + 2 X q``: from a customer's power, in units of
    # the three-phase base S, to the squared voltage of every place, pu. For an absent phase, that of its end
    # in the tree.
    R: Floats = field(init=False, repr=False)
    X: Floats = field(init=False, repr=False)
    # (n, 3) voltage of every place without load, per voltage of the busbar; without charging that of its
    # phase
    idle: Phasors = field(init=False, repr=False)
    # (n, N) from an injected current of a customer, in units of S, to the voltage of every place, charging
    # included, pu
    transfer: Phasors = field(init=False, repr=False)
    transfer_between: Phasors = field(init=False, repr=False)  # (N, N) the same to the customers' voltages
    size: Floats = field(init=False, repr=False)  # (N, N) its absolute values

    def __post_init__(self) -> None:
        put(self, ends=frozen_ints(self.ends), phases=np.array(self.phases, dtype=np.bool_))
        put(self, z=np.array(self.z, dtype=np.complex128), charging=frozen(self.charging))
        problems = _phased_problems(self)
        if problems:
            raise FeederInvalid(problems)
        radial = PhasedFeeder(self.tree)
        put(self, bus=radial.bus, buses=radial.buses)
        put(self, half=_shunts(self.tree.half, self.ends, self.charging))
        Z = _impedances(self)
        turned = Z * (ROTATION[self.tree.phase] / np.tile(ROTATION, len(self.tree.buses))[:, None])
        idle, transfer = np.tile(np.eye(3, dtype=np.complex128), (len(self.tree.buses), 1)), Z
        if self.half.any():
            idle, transfer = _phased_charged(self)
        put(self, R=frozen(turned.real), X=frozen(turned.imag), idle=idle, transfer=transfer)
        put(self, transfer_between=transfer[self.bus], size=np.abs(transfer[self.bus]))

    def without_load(self, v0_squared: Floats | float) -> Phasors:
        """Voltage of every place without load, (n,), pu."""
        return np.asarray(self.idle @ (np.sqrt(np.asarray(v0_squared, dtype=np.float64)) * ROTATION))

    def with_customers_at(self, places: Ints) -> PhasedMesh:
        """See `Network`."""
        return replace(self, tree=customers_at(self.tree, places))

    def without_drop(self, v0_squared: Floats | float) -> Floats:
        """Squared busbar voltage of its phase for every place, (n,)."""
        return self.broadcast_busbar(v0_squared)


def _phased_problems(feeder: PhasedMesh) -> list[Problem]:
    """Problems of the ties against the tree."""
    count, tree = len(feeder.ends), feeder.tree
    out = wrong_shapes(
        ("ends", feeder.ends.shape, (count, 2)),
        ("phases", feeder.phases.shape, (count, 3)),
        ("z", feeder.z.shape, (count, 3, 3)),
        ("charging", feeder.charging.shape, (count, 3, 3)),
    )
    if out:
        return out
    last = len(tree.buses) - 1
    for k, (one, other) in enumerate(feeder.ends.tolist()):
        here, where = feeder.phases[k], f"tie {k}"
        for end in (one, other):
            if not 0 <= end <= last:
                out.append(
                    Problem("unknown-index", f"{where}: bus {end} does not exist; expected 0 to {last}")
                )
            elif (here & ~tree.phases[end]).any():
                out.append(
                    Problem(
                        "absent-phase",
                        f"{where}: phases {named(here)!r} but the other lines bring only "
                        f"{named(tree.phases[end])!r} to {tree.buses[end]!r}",
                    )
                )
        if one == other:
            out.append(Problem("self-loop", f"{where}: both ends are bus {one}; a line needs two"))
        if not here.any():
            out.append(Problem("no-phase", f"{where}: it has no phase; expected one, two or three"))
        lines = three_phase.line_problems(feeder.z[k], feeder.charging[k], here)
        out.extend(Problem(problem.code, f"{where}: {problem}") for problem in lines)
    return out


def _impedances(feeder: PhasedMesh) -> Phasors:
    """Matrix (n, N) from the customers' currents to all places, the inverse admittances without charging.

    As `gridsec.grid.meshed.impedances`, with a loop for every phase of every tie: ``Z = T - T C (z + C^T T
    C)^-1 C^T T``, T the sums of common paths in the tree. Three times that, as 1 pu of the power of a phase
    is S / 3.
    """
    tree = feeder.tree

    def paths(bus: Ints, phase: Ints) -> Phasors:
        found = three_phase.common_paths(tree, tree.z, bus, phase)
        return np.moveaxis(found, 0, 1).reshape(3 * len(tree.buses), bus.size)

    Z = paths(tree.at, tree.phase)
    tie, phase = np.nonzero(feeder.phases)
    if tie.size:
        one, other = feeder.ends[tie].T
        across = paths(one, phase) - paths(other, phase)  # T C
        own = np.equal.outer(tie, tie) * feeder.z[tie[:, None], phase[:, None], phase]
        loops = own + across[3 * one + phase] - across[3 * other + phase]
        size = np.sqrt(np.abs(np.diagonal(loops)))
        if not size.all() or np.linalg.cond(loops / np.outer(size, size)) > _SINGULAR:
            raise FeederInvalid([Problem("singular", "ties: the impedances around a loop add up to zero")])
        Z = Z - across @ np.linalg.solve(loops, across[feeder.bus].T)
    return np.asarray(3.0 * Z)


# Impedances of passive lines do not cancel, but those in a faulty table may.
_SINGULAR = 1e13


def phased_admittance(feeder: PhasedMesh) -> csc_array:
    """Admittance matrix of all places, charging included, (n, n), pu; rows of absent phases are empty.

    Raises FeederInvalid if the impedances of a line have no inverse.
    """
    tree = feeder.tree
    lines = np.vstack([np.column_stack([tree.parent, np.arange(1, len(tree.buses))]), feeder.ends])
    series = np.zeros((len(lines), 3, 3), dtype=np.complex128)
    present = np.vstack([tree.phases[1:], feeder.phases])
    for k, (out, z, here) in enumerate(zip(series, [*tree.z, *feeder.z], present, strict=True)):
        some = np.ix_(here, here)
        if np.linalg.cond(z[some]) > _SINGULAR:
            where = f"branch {k}" if k < len(tree.z) else f"tie {k - len(tree.z)}"
            raise FeederInvalid(
                [Problem("singular", f"{where}: z is singular; with charging it must be regular")]
            )
        out[some] = np.linalg.inv(z[some])
    one, other = lines.T
    every = np.arange(len(tree.buses))
    at = np.concatenate([one, other, one, other, every])
    to = np.concatenate([one, other, other, one, every])
    blocks = np.concatenate([series, series, -series, -series, 1j * feeder.half])
    rows = np.broadcast_to(3 * at[:, None, None] + np.arange(3)[:, None], blocks.shape)
    columns = np.broadcast_to(3 * to[:, None, None] + np.arange(3), blocks.shape)
    there = blocks != 0.0
    size = 3 * len(tree.buses)
    return csc_array(coo_array((blocks[there], (rows[there], columns[there])), shape=(size, size)))


def _phased_charged(feeder: PhasedMesh) -> tuple[Phasors, Phasors]:
    """Voltages without load, and effects of the customers' currents, charging included."""
    tree, free = feeder.tree, np.flatnonzero(feeder.tree.phases.ravel())
    injected = np.zeros((len(feeder.buses), feeder.bus.size), dtype=np.complex128)
    injected[feeder.bus, np.arange(feeder.bus.size)] = 3.0
    idle, transfer = _charged(phased_admittance(feeder), free[free >= len(PHASES)], len(PHASES), injected)
    # Beyond the end of a phase, its voltage is that at the end.
    stands = np.arange(len(idle)).reshape(-1, 3)
    for k, above in enumerate(tree.parent.tolist(), 1):
        stands[k] = np.where(tree.phases[k], stands[k], stands[above])
    return idle[stands.ravel()], transfer[stands.ravel()]


# Radius around the second iterate, as a fraction of it, within which a solution is located.
_NEAR = 0.1


def _start(
    feeder: _Admittances, p: Floats, q: Floats, v0_squared: Floats | float
) -> tuple[Phasors, Phasors, Phasors]:
    """Powers of the customers (…, N), and voltages without load of all places (…, n) and of the customers."""
    idle = feeder.without_load(v0_squared)
    return np.asarray(p + 1j * q), idle, np.asarray(idle[..., feeder.bus])
