"""Redundant observability and detectability of a pair (A, C), and the security indices.

Everything has two independent forms: by ranks of observability matrices, and by eigenvectors. The
latter minimise over each whole eigenspace, which covers repeated eigenvalues, defective or not.

References
----------
lee2018, chapter 3. Corrections: docs/errata/lee2018-chapter-3.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from gridsec.arrays import Floats, Ints, frozen_ints, unit_rows
from gridsec.choices import no_choice
from gridsec.errors import refuse
from gridsec.index.blocks import Matrix, fewest, kernel, row_space, span
from gridsec.index.spectrum import eigenspaces, unstable_subspace

By = Literal["eigenvectors", "rank"]


@dataclass(frozen=True, slots=True, eq=False)
class Index:
    """Smallest set of sensors of an invisible attack, and its direction.

    Attributes
    ----------
    count
        The index; infinite if no number of sensors suffices.
    sensors : (count,)
        A smallest set of sensors; empty if there is none.
    direction : (n,)
        Apparent displacement of the state; empty if there is none. Complex directions stand for their real
        part, which is seen by the same sensors and has a norm of at least sqrt(1/2).
    """

    count: float
    sensors: Ints
    direction: Matrix

    @property
    def correctable(self) -> float:
        """Largest number of correctable manipulated sensors: `ceil(count / 2) - 1`.

        It is -1 for a system that is not observable, and infinite for an infinite index.
        """
        return float(np.ceil(self.count / 2.0) - 1.0)

    @property
    def detectable(self) -> float:
        """Largest number of manipulated sensors that are always detectable: `count - 1`."""
        return self.count - 1.0


def observability(A: Floats, C: Floats, steps: int | None = None) -> Floats:
    """Observability matrices of the single sensors, `G_i = [c_i; c_i A; …; c_i A^(k-1)]`.

    Parameters
    ----------
    A : (n, n)
    C : (p, n)
        The pair.
    steps
        k; n by default.

    Returns
    -------
    (p, k, n)
        G_i in `[i]`; reshaped to (p k, n) it is the stacked G of the paper.

    References
    ----------
    lee2018 (3.1.3), (3.1.4).
    """
    k = A.shape[0] if steps is None else steps
    out = np.empty((C.shape[0], k, A.shape[0]))
    row = np.asarray(C, dtype=np.float64)
    for j in range(k):
        out[:, j] = row
        row = row @ A
    return out


def observable_rows(A: Floats, C: Floats, *, tol: float) -> tuple[Floats, ...]:
    """Orthonormal rows that span the rows of each sensor's observability matrix.

    By Arnoldi's method on A^T, which does not form powers of A, so that ranks stay decidable if G_i itself is
    badly scaled. The kernel is the unobservable subspace of the pair (A, c_i).

    Parameters
    ----------
    A, C : (n, n), (p, n)
        The pair.
    tol
        A new row shorter than this times |A| counts as dependent. A sensor with a row up to this fraction of
        the longest measures nothing.

    Returns
    -------
    p times (rank G_i, n)
        Empty for a sensor that measures nothing.
    """
    size = float(np.linalg.norm(A, 2)) or 1.0
    rows = unit_rows(np.asarray(C, dtype=np.float64), tol=tol)
    return tuple(_arnoldi(A.T / size, row, tol) for row in rows)


def _arnoldi(step: Floats, row: Floats, tol: float) -> Floats:
    basis = np.zeros((0, row.size))
    while np.linalg.norm(row) > tol and len(basis) < row.size:
        basis = np.vstack([basis, row / np.linalg.norm(row)])
        row = step @ basis[-1]
        # Twice: a single pass leaves rounding errors that a third of the rows would inherit.
        for _ in range(2):
            row = row - basis.T @ (basis @ row)
    return basis


def _sensors(C: Floats, tol: float) -> list[Matrix]:
    """Row of each sensor, scaled to length one: the unit of a sensor is not a property of the system."""
    rows = unit_rows(np.asarray(C, dtype=np.float64), tol=tol)
    return [row_space(row[None, :], 0.0) for row in rows]


def static_index(C: Floats, *, tol: float) -> Index:
    """alpha_s(C) = cospark(C), the index of one snapshot of readings.

    Parameters
    ----------
    C : (p, n)
        Output matrix.
    tol
        A product of a sensor's unit row with a unit state up to this counts as zero. A sensor with a row up
        to this fraction of the longest measures nothing.

    References
    ----------
    lee2018 (3.2.2).
    """
    found = fewest(_sensors(C, tol), np.eye(C.shape[1]), tol=tol)
    return Index(found.count, frozen_ints(found.blocks), found.direction)


def dynamic_index(A: Floats, C: Floats, *, tol: float, by: By = "eigenvectors") -> Index:
    """Smallest number of sensors of an attack that stays invisible for all time, alpha_d(A, C).

        min over x != 0 of |G x|_{0^n}   =   min over eigenvectors v of A of |C v|_0

    The same number for sampled and for continuous time.

    Parameters
    ----------
    A, C : (n, n), (p, n)
        The pair.
    tol
        Tolerance of zero, relative to unit vectors, |A| and the longest row of C.
    by
        "eigenvectors": over every eigenspace, (3.2.4). "rank": over all states, (3.2.3).

    Raises
    ------
    ValueError
        If `by` is another text.

    References
    ----------
    lee2018 (3.2.3), Proposition 3.2.2.
    """
    refuse(no_choice("by", get_args(By), by))
    if by == "rank":
        found = fewest(observable_rows(A, C, tol=tol), np.eye(A.shape[0]), tol=tol)
        return Index(found.count, frozen_ints(found.blocks), found.direction)
    return _over(tuple(e.vectors for e in eigenspaces(A, tol=tol)), C, tol)


def asymptotic_index(A: Floats, C: Floats, *, discrete: bool, tol: float, by: By = "eigenvectors") -> Index:
    """`dynamic_index` for attacks with an effect that does not decay, alpha_a(A, C).

        min over x outside X_s(A) of |G x|_{0^n}   =   min over unstable eigenvectors v of |C v|_0

    Parameters
    ----------
    A, C : (n, n), (p, n)
        The pair.
    discrete
        True if A is the matrix of a sampled system (unstable: |lambda| >= 1), False for that of a
        differential equation (Re lambda >= 0).
    tol
        Tolerance of zero. An eigenvalue within this of the border counts as unstable.
    by
        As in `dynamic_index`.

    Returns
    -------
    Index
        Infinite for a stable A.

    Raises
    ------
    ValueError
        If `by` is another text.

    References
    ----------
    lee2018 (3.2.5), Proposition 3.2.4.
    """
    refuse(no_choice("by", get_args(By), by))
    if by == "rank":
        # An invariant kernel is the sum of its stable and its unstable part: searching X_u suffices.
        space = unstable_subspace(A, discrete=discrete, tol=tol)
        found = fewest(observable_rows(A, C, tol=tol), space, tol=tol)
        return Index(found.count, frozen_ints(found.blocks), found.direction)
    spaces = eigenspaces(A, tol=tol)
    return _over(tuple(e.vectors for e in spaces if e.unstable(discrete=discrete, tol=tol)), C, tol)


def _over(spaces: Sequence[Matrix], C: Floats, tol: float, *, below: float = 0.0) -> Index:
    rows = _sensors(C, tol)
    best = fewest(rows, np.zeros((C.shape[1], 0)), tol=tol)
    for space in spaces:
        found = fewest(rows, space, tol=tol, below=below)
        if found.count < best.count:
            best = found
    return Index(best.count, frozen_ints(best.blocks), _turned(best.direction))


def _turned(direction: Matrix) -> Matrix:
    """The same direction with the longest possible real part: an eigenvector's phase is arbitrary."""
    square = np.sum(direction * direction)
    return direction if square == 0.0 else direction * np.exp(-0.5j * np.angle(square))


def redundant_observable(A: Floats, C: Floats, q: int, *, tol: float, by: By = "eigenvectors") -> bool:
    """True if (A, C) stays observable after the loss of any q sensors.

    Parameters
    ----------
    A, C : (n, n), (p, n)
        The pair.
    q
        Number of sensors lost.
    tol
        As in `dynamic_index`.
    by
        "eigenvectors": `|C v|_0 > q` for every eigenvector. "rank": all C(p, q) stacked matrices.

    Raises
    ------
    ValueError
        If `by` is another text.

    References
    ----------
    lee2018, Definition 3.1.1, Propositions 3.1.1 (iii) and 3.1.2 (ii).
    """
    refuse(no_choice("by", get_args(By), by))
    if by == "eigenvectors":
        return _over([e.vectors for e in eigenspaces(A, tol=tol)], C, tol, below=q + 1).count > q
    rows = observable_rows(A, C, tol=tol)
    return all(_lost(rows, kept, A.shape[0], tol).shape[1] == 0 for kept in _survivors(len(rows), q))


def redundant_detectable(
    A: Floats, C: Floats, q: int, *, discrete: bool, tol: float, by: By = "eigenvectors"
) -> bool:
    """True if (A, C) stays detectable after the loss of any q sensors.

    Parameters
    ----------
    A, C, q, tol, by
        As in `redundant_observable`.
    discrete
        As in `asymptotic_index`.

    Raises
    ------
    ValueError
        If `by` is another text.

    References
    ----------
    lee2018, Definition 3.1.3, Propositions 3.1.8 (ii) and 3.1.9 (ii).
    """
    refuse(no_choice("by", get_args(By), by))
    if by == "eigenvectors":
        spaces = [e.vectors for e in eigenspaces(A, tol=tol) if e.unstable(discrete=discrete, tol=tol)]
        return _over(spaces, C, tol, below=q + 1).count > q
    rows = observable_rows(A, C, tol=tol)
    space = unstable_subspace(A, discrete=discrete, tol=tol)
    return all(_lost(rows, kept, 0, tol, space).shape[1] == 0 for kept in _survivors(len(rows), q))


def unobservable_subspace(A: Floats, C: Floats, q: int = 0, *, tol: float) -> Floats:
    """The q-redundant unobservable subspace: span of all states made unobservable by the loss of q sensors.

        sum over |Lambda| = p - q of N(G_Lambda)

    Parameters
    ----------
    A, C, q, tol
        As in `redundant_observable`. The whole space for q >= p. Costs C(p, q) kernels.

    Returns
    -------
    (n, d)
        Orthonormal basis. Its orthogonal complement is the redundant observable subspace.

    References
    ----------
    lee2018, Definition 3.1.2, Propositions 3.1.4 and 3.1.6.
    """
    return _summed(A, C, q, np.eye(A.shape[0]), tol)


def undetectable_subspace(A: Floats, C: Floats, q: int = 0, *, discrete: bool, tol: float) -> Floats:
    """The q-redundant undetectable subspace: the unstable part of the redundant unobservable one.

        sum over |Lambda| = p - q of N(G_Lambda) ∩ X_u(A)

    Parameters
    ----------
    A, C, q, discrete, tol
        As in `redundant_detectable`.

    Returns
    -------
    (n, d)
        Orthonormal basis. Its orthogonal complement is the redundant detectable subspace.

    References
    ----------
    lee2018, Definition 3.1.4, Propositions 3.1.11 and 3.1.13.
    """
    return _summed(A, C, q, unstable_subspace(A, discrete=discrete, tol=tol), tol)


def _summed(A: Floats, C: Floats, q: int, space: Floats, tol: float) -> Floats:
    rows = observable_rows(A, C, tol=tol)
    total = np.zeros((A.shape[0], 0))
    for kept in _survivors(len(rows), q):
        lost = _lost(rows, kept, A.shape[0], tol, space)
        # Only new directions are added, so that the basis never exceeds n columns.
        total = np.asarray(span(np.hstack([total, lost]), np.sqrt(tol)))
        if total.shape[1] == space.shape[1]:
            break
    return total


def _survivors(p: int, q: int) -> list[tuple[int, ...]]:
    return list(combinations(range(p), max(p - q, 0)))


def _lost(
    rows: Sequence[Floats], kept: Sequence[int], n: int, tol: float, space: Floats | None = None
) -> Floats:
    """Basis of the directions of a space that are invisible to all kept sensors."""
    start = np.eye(n) if space is None else space
    if not kept:
        return start
    return np.asarray(start @ kernel(np.vstack([rows[i] for i in kept]) @ start, tol))
