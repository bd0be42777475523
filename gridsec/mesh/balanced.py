"""Balanced feeder with closed ties: a radial feeder and the lines that close loops in it, in its per unit.

With W the voltage without load by the busbar, and ``Z = R + j X`` the inverse of the admittance
matrix without the busbar, powers s and voltages V of the other buses obey

    V = W + Z conj(s / V).

To first order in s, and without charging, ``|V|^2 = v0^2 + 2 Re(Z conj(s)) = v0^2 + 2 R p + 2 X q``. On a
tree Z has the sums of common paths, so that this is LinDistFlow. With ties its entries may be negative, but
it stays symmetric, and both parts positive semidefinite. Derivations: docs/theory-mesh.md.

References
----------
.. [1] S. Bolognani, S. Zampieri, "On the existence and linear approximation of the power flow solution in
   power distribution networks", IEEE Trans. Power Systems 31(1), 2016: the model, for networks of any form.
.. [2] C. Wang, A. Bernstein, J.-Y. Le Boudec, M. Paolone, "Explicit conditions on existence and uniqueness
   of load-flow solutions in distribution networks", IEEE Trans. Smart Grid 9(2), 2018: the fixed point.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from gridsec.arrays import Floats, Ints, Phasors, frozen, frozen_ints
from gridsec.errors import FeederInvalid, Problem
from gridsec.feeder import Feeder, common_paths
from gridsec.trees import OnTree


@dataclass(frozen=True, slots=True, eq=False)
class MeshedFeeder(OnTree):
    """Feeder with closed loops. N customers, b + 1 buses, t ties.

    Attributes
    ----------
    tree
        The feeder without the ties: a radial feeder that reaches every bus.
    ends : (t, 2)
        Buses at both ends of each tie.
    r, x : (t,)
        Series resistance and reactance of each tie, pu.
    charging : (t,)
        Total shunt susceptance of each tie, pu; half of it at each end.
    half : (b + 1,)
        Derived. Shunt susceptance at the buses, pu.
    R, X : (b + 1, N)
        Derived. The linear power flow ``v^2 = v0^2 + 2 R p + 2 X q``, from a customer's power to every bus.
    idle : (b + 1,)
        Derived. Voltage of every bus without load, per voltage of the busbar; 1 without charging.
    transfer : (b + 1, N)
        Derived. From an injected current of a customer to the voltage of every bus, charging included, pu.
    between : (N, N)
        Derived. The same to the customers' voltages.
    size : (N, N)
        Derived. Its absolute values.

    Raises
    ------
    FeederInvalid
        With every problem found.
    """

    tree: Feeder
    ends: Ints
    r: Floats
    x: Floats
    charging: Floats
    half: Floats = field(init=False, repr=False)
    R: Floats = field(init=False, repr=False)
    X: Floats = field(init=False, repr=False)
    idle: Phasors = field(init=False, repr=False)
    transfer: Phasors = field(init=False, repr=False)
    between: Phasors = field(init=False, repr=False)
    size: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        for name in ("r", "x", "charging"):
            put(name, frozen(getattr(self, name)))
        put("ends", frozen_ints(self.ends))
        problems = _problems(self)
        if problems:
            raise FeederInvalid(problems)
        half = self.tree.half.copy()
        np.add.at(half, self.ends, 0.5 * self.charging[:, None])
        put("half", frozen(half))
        Z = impedances(self, self.bus)
        put("R", frozen(Z.real))
        put("X", frozen(Z.imag))
        idle, transfer = _charged(self) if half.any() else (np.ones(half.size, np.complex128), Z)
        for name, values in (("idle", idle), ("transfer", transfer), ("between", transfer[self.bus])):
            values.flags.writeable = False
            put(name, values)
        put("size", frozen(np.abs(self.between)))

    @property
    def bus(self) -> Ints:
        """Bus of each customer, (N,)."""
        return self.tree.bus

    @property
    def buses(self) -> tuple[str, ...]:
        """Identifiers of the buses, the busbar first, (b + 1,)."""
        return self.tree.buses


def _problems(feeder: MeshedFeeder) -> list[Problem]:
    """Problems of the ties against the tree."""
    count, buses = feeder.r.size, len(feeder.tree.buses)
    expected = (
        ("ends", feeder.ends.shape, (count, 2)),
        ("r", feeder.r.shape, (count,)),
        ("x", feeder.x.shape, (count,)),
        ("charging", feeder.charging.shape, (count,)),
    )
    out = [
        Problem("shape", f"{what} has shape {has}; expected {wants}")
        for what, has, wants in expected
        if has != wants
    ]
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
        for what in ("r", "x", "charging"):
            value = getattr(feeder, what)[k]
            if not (np.isfinite(value) and value >= 0):
                out.append(
                    Problem("negative", f"tie {k}: {what} is {value}; it must be finite and not negative")
                )
        if feeder.r[k] == 0 and feeder.x[k] == 0:
            out.append(Problem("zero-impedance", f"tie {k}: r and x are both 0; fuse the two buses"))
    return out


def impedances(feeder: MeshedFeeder, buses: Ints) -> Phasors:
    """Columns of the inverse of the reduced admittance matrix, without charging; O(b k t).

    The ties, with ends C (+1 at one, -1 at the other) and impedances z, add ``C z^-1 C^T`` to the admittances
    of the tree, with the common paths T as inverse. The inverse of the sum is (Woodbury)

        Z = T - T C (z + C^T T C)^-1 C^T T,

    with the impedances of the t loops in the middle: no linear system of the feeder's size is solved.

    Parameters
    ----------
    buses : (k,)
        Buses of injected currents.

    Returns
    -------
    (b + 1, k)
        Rise of the voltage of every bus for each of them, pu; 0 at the busbar.
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


def _charged(feeder: MeshedFeeder) -> tuple[Phasors, Phasors]:
    """Voltages without load, and effects of the customers' currents, charging included."""
    Y = admittance(feeder)
    below = splu(csc_array(Y[1:, 1:]))
    idle = np.ones(len(feeder.buses), dtype=np.complex128)
    idle[1:] = below.solve(-Y[1:, [0]].toarray().ravel())
    transfer, injected = np.zeros((2, idle.size, feeder.bus.size), dtype=np.complex128)
    injected[feeder.bus, np.arange(feeder.bus.size)] = 1.0
    transfer[1:] = below.solve(injected[1:])
    return idle, transfer
