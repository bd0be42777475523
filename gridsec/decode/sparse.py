"""Sparse recovery without enumeration: basis pursuit and orthogonal matching pursuit.

Both recover the error from `F z = F e`, F an annihilator of Phi, fast, but under stronger conditions than
correctability; otherwise they may fail. `gridsec.decode.search` has no such conditions.

References
----------
lee2018, section 2.1.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from gridsec.arrays import Floats, Ints
from gridsec.decode.stacks import MOST_SUBSETS, Stack, annihilator, subsets
from gridsec.errors import DesignInfeasible
from gridsec.lmi.pursuit import group_pursuit


def restricted_isometry(F: Floats, k: int, *, most: int = MOST_SUBSETS) -> float:
    """Smallest delta_k with `(1 - delta) |e|^2 <= |F e|^2 <= (1 + delta) |e|^2` for all k-sparse e.

    Parameters
    ----------
    F : (m, p)
        Sensing matrix. Its scale matters.
    k
        Order.
    most
        Largest number of subsets of columns.

    References
    ----------
    lee2018, Definition 2.1.1.
    """
    columns = subsets(F.shape[1], min(k, F.shape[1]), most)
    gram = F.T @ F
    values = np.linalg.eigvalsh(gram[columns[:, :, None], columns[:, None, :]])
    return float(np.max(np.abs(values - 1.0), initial=0.0))


def basis_pursuit(F: Floats, y: Floats) -> Floats:
    """Minimise `|e|_1` subject to `F e = y`, as a linear program.

    Parameters
    ----------
    F : (m, p)
        Sensing matrix.
    y : (m,)
        Observation.

    Returns
    -------
    (p,)
        e; the sparse one if `delta_2q < sqrt(2) - 1`.

    Raises
    ------
    DesignInfeasible
        If no e satisfies the constraint.

    References
    ----------
    lee2018 (2.1.4), Theorem 2.1.1.
    """
    p = F.shape[1]
    size = float(np.max(np.abs(y), initial=0.0))
    if size == 0.0:
        return np.zeros(p)
    # Scaled, because the solver's tolerances are absolute.
    found = linprog(np.ones(2 * p), A_eq=np.hstack([F, -F]), b_eq=y / size, method="highs")
    if not found.success or found.x is None:
        raise DesignInfeasible("basis pursuit", f"linear program: {found.message}", code="no-solution")
    return np.asarray(size * (found.x[:p] - found.x[p:]))


def matching_pursuit(F: Floats, y: Floats, q: int, *, heights: Ints | None = None) -> tuple[Floats, Ints]:
    """Orthogonal matching pursuit: q times the block of columns that explains the residual best.

    Parameters
    ----------
    F : (m, N)
        Sensing matrix.
    y : (m,)
        Observation.
    q
        Number of blocks to choose.
    heights : (p,)
        Columns per block; single columns by default, which is the paper's algorithm. A block's
        correlation is the norm of the projection of the residual on its columns.

    Returns
    -------
    e : (N,)
        Least squares on the chosen blocks, zero elsewhere.
    chosen : (q,)
        The blocks, in the order of their choice; fewer if the residual vanishes or all are chosen earlier.

    References
    ----------
    lee2018, Algorithm 2.1, Theorem 2.1.2.
    """
    sizes = np.ones(F.shape[1], dtype=np.intp) if heights is None else heights
    parts = np.split(np.arange(F.shape[1]), np.cumsum(sizes)[:-1])
    bases = [np.linalg.qr(F[:, part])[0] for part in parts]
    chosen: list[int] = []
    e, rest = np.zeros(F.shape[1]), y
    while len(chosen) < min(q, len(parts)) and np.any(rest):
        match = np.array([np.linalg.norm(b.T @ rest) for b in bases])
        # Prevents a second choice of a block by rounding.
        match[chosen] = -1.0
        chosen.append(int(np.argmax(match)))
        at = np.concatenate([parts[i] for i in chosen])
        e = np.zeros(F.shape[1])
        e[at] = np.linalg.lstsq(F[:, at], y, rcond=None)[0]
        rest = y - F @ e
    return e, np.array(chosen, dtype=np.intp)


def decode_by_pursuit(stack: Stack, z: Floats, *, tol: float) -> Floats:
    """Decode by basis pursuit: rows as single errors, or whole blocks by their Euclidean norms.

    A stack of single rows is solved as a linear program; otherwise `sum_i |e_i|_2` is minimised, a
    second-order cone program, because an attack has no pattern within the block of its sensor.

    Parameters
    ----------
    stack
        Phi of full column rank.
    z : (N,)
        Measurements.
    tol
        As in `annihilator`.

    Returns
    -------
    (n,)
        `Phi^+ (z - e)`.

    References
    ----------
    lee2018 (2.1.4); Remark 2.2.2.
    """
    F = annihilator(stack.matrix, tol=tol)
    single = bool(np.all(stack.heights == 1))
    e = basis_pursuit(F, F @ z) if single else group_pursuit(F, F @ z, stack.heights)
    return np.asarray(np.linalg.lstsq(stack.matrix, z - e, rcond=None)[0])


def decode_by_matching(stack: Stack, z: Floats, q: int, *, tol: float) -> tuple[Floats, Ints]:
    """Decode by orthogonal matching pursuit; x and the blocks assumed in error.

    Parameters
    ----------
    stack, z, tol
        As in `decode_by_pursuit`.
    q
        Number of blocks in error.
    """
    F = annihilator(stack.matrix, tol=tol)
    e, chosen = matching_pursuit(F, F @ z, q, heights=stack.heights)
    return np.asarray(np.linalg.lstsq(stack.matrix, z - e, rcond=None)[0]), chosen
