"""Feeder in three phases with closed ties: a tree of 3x3 blocks and the lines that close loops in it.

The voltages of its places are ``V = W + Z conj(s / V)`` as on a balanced mesh, with Z the inverse of the
admittances between phases of buses. With the busbar's phases a third of a turn apart, a = 1, e^{-j 2 pi / 3},
e^{j 2 pi / 3}, the derivative of ``|V|^2`` at no load is ``2 Re(Z_kl a_l / a_k conj(s_l))``: on a tree
LinDist3Flow. Z is symmetric; the rotated matrix is not. Derivations: docs/theory-mesh.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from gridsec.arrays import Bools, Floats, Ints, Phasors, frozen, frozen_ints
from gridsec.errors import FeederInvalid, Problem
from gridsec.phases import PHASES, ROTATION, PhasedFeeder, ThreePhaseFeeder
from gridsec.phases.feeder import line_problems, named
from gridsec.phases.flow import common_paths
from gridsec.trees import OnTree


@dataclass(frozen=True, slots=True, eq=False)
class PhasedMesh(OnTree):
    """Feeder of single-phase customers with closed ties. N customers, t ties, n = 3 (b + 1) places.

    Attributes
    ----------
    tree
        The feeder without the ties, with customers of one phase; it contains every phase of every bus.
    ends : (t, 2)
        Buses at both ends of each tie.
    phases : (t, 3)
        Phases a, b, c of each tie.
    z : (t, 3, 3)
        Series impedance of each tie, pu; symmetric, rows and columns of absent phases are 0.
    charging : (t, 3, 3)
        Total shunt susceptance of each tie, pu; half of it at each end.
    bus : (N,)
        Derived. Place of each customer.
    buses : (n,)
        Derived. Identifiers of the places, the busbar's three first.
    half : (b + 1, 3, 3)
        Derived. Shunt susceptance at the buses, pu.
    R, X : (n, N)
        Derived. The linear power flow ``v^2 = v0^2 + 2 R p + 2 X q``: from a customer's power, in units of
        the three-phase base S, to the squared voltage of every place, pu. For an absent phase, that of its
        end in the tree.
    idle : (n, 3)
        Derived. Voltage of every place without load, per voltage of the busbar; without charging that of its
        phase.
    transfer : (n, N)
        Derived. From an injected current of a customer, in units of S, to the voltage of every place,
        charging included, pu.
    between : (N, N)
        Derived. The same to the customers' voltages.
    size : (N, N)
        Derived. Its absolute values.

    Raises
    ------
    FeederInvalid
        With every problem found.
    """

    tree: ThreePhaseFeeder
    ends: Ints
    phases: Bools
    z: Phasors
    charging: Floats
    bus: Ints = field(init=False, repr=False)
    buses: tuple[str, ...] = field(init=False, repr=False)
    half: Floats = field(init=False, repr=False)
    R: Floats = field(init=False, repr=False)
    X: Floats = field(init=False, repr=False)
    idle: Phasors = field(init=False, repr=False)
    transfer: Phasors = field(init=False, repr=False)
    between: Phasors = field(init=False, repr=False)
    size: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

        put("ends", frozen_ints(self.ends))
        put("phases", np.array(self.phases, dtype=np.bool_))
        put("z", np.array(self.z, dtype=np.complex128))
        put("charging", frozen(self.charging))
        problems = _problems(self)
        if problems:
            raise FeederInvalid(problems)
        radial = PhasedFeeder(self.tree)
        put("bus", radial.bus)
        put("buses", radial.buses)
        half = self.tree.half.copy()
        np.add.at(half, self.ends, 0.5 * self.charging[:, None])
        put("half", half)
        Z = _impedances(self)
        turned = Z * (ROTATION[self.tree.phase] / np.tile(ROTATION, len(self.tree.buses))[:, None])
        put("R", frozen(turned.real))
        put("X", frozen(turned.imag))
        quiet = np.tile(np.eye(3, dtype=np.complex128), (len(self.tree.buses), 1))
        idle, transfer = _charged(self) if half.any() else (quiet, Z)
        put("idle", idle)
        put("transfer", transfer)
        put("between", transfer[self.bus])
        put("size", np.abs(self.between))


def _problems(feeder: PhasedMesh) -> list[Problem]:
    """Problems of the ties against the tree."""
    count, tree = len(feeder.ends), feeder.tree
    expected = (
        ("ends", feeder.ends.shape, (count, 2)),
        ("phases", feeder.phases.shape, (count, 3)),
        ("z", feeder.z.shape, (count, 3, 3)),
        ("charging", feeder.charging.shape, (count, 3, 3)),
    )
    out = [
        Problem("shape", f"{what} has shape {has}; expected {wants}")
        for what, has, wants in expected
        if has != wants
    ]
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
        lines = line_problems(feeder.z[k], feeder.charging[k], here)
        out.extend(Problem(problem.code, f"{where}: {problem}") for problem in lines)
    return out


def _impedances(feeder: PhasedMesh) -> Phasors:
    """Matrix (n, N) from the customers' currents to all places, the inverse admittances without charging.

    As `gridsec.mesh.impedances`, with a loop for every phase of every tie: ``Z = T - T C (z + C^T T C)^-1 C^T
    T``, T the sums of common paths in the tree. Three times that, as 1 pu of the power of a phase is S / 3.
    """
    tree = feeder.tree

    def paths(bus: Ints, phase: Ints) -> Phasors:
        found = common_paths(tree, tree.z, bus, phase)
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


def admittance(feeder: PhasedMesh) -> csc_array:
    """Admittance matrix of all places, charging included, (n, n), pu; rows of absent phases are empty.

    Raises
    ------
    FeederInvalid
        If the impedances of a line have no inverse.
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


def _charged(feeder: PhasedMesh) -> tuple[Phasors, Phasors]:
    """Voltages without load, and effects of the customers' currents, charging included."""
    Y, tree = admittance(feeder).tocsr(), feeder.tree
    free = np.flatnonzero(tree.phases.ravel())
    free = free[free >= len(PHASES)]
    solver = splu(csc_array(Y[free][:, free]))
    idle = np.zeros((len(feeder.buses), 3), dtype=np.complex128)
    idle[:3] = np.eye(3)
    idle[free] = solver.solve(-Y[free][:, :3].toarray())
    transfer, injected = np.zeros((2, len(idle), feeder.bus.size), dtype=np.complex128)
    injected[feeder.bus, np.arange(feeder.bus.size)] = 3.0
    transfer[free] = solver.solve(injected[free])
    # Beyond the end of a phase, its voltage is that at the end.
    stands = np.arange(len(idle)).reshape(-1, 3)
    for k, above in enumerate(tree.parent.tolist(), 1):
        stands[k] = np.where(tree.phases[k], stands[k], stands[above])
    return idle[stands.ravel()], transfer[stands.ravel()]
