"""Eigenspaces that stay correct for repeated eigenvalues, by clusters of eigenvalues.

In floating point a repeated eigenvalue comes back as a cluster. An m-fold one of a Jordan block spreads by
`eps^(1/m)`, far more than the distance of distinct ones can be, so no threshold on distances separates the
two. The restriction of A to the invariant subspace of a cluster does: minus its mean eigenvalue it is
nilpotent and singular if the cluster is one eigenvalue, and not if it is several.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, schur

from gridsec.arrays import Bools, Floats, Ints
from gridsec.index.blocks import Matrix, kernel

Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class Eigenspace:
    """One eigenvalue with all its eigenvectors.

    Attributes
    ----------
    value
        The eigenvalue: the mean of its cluster, which is more accurate than its members.
    vectors : (n, g)
        Orthonormal basis of the eigenspace; g is the geometric multiplicity.
    invariant : (n, m)
        Orthonormal basis of the generalised eigenspace; m is the algebraic multiplicity.
    """

    value: complex
    vectors: Complexes
    invariant: Complexes

    def unstable(self, *, discrete: bool, tol: float) -> bool:
        """True for an unstable eigenvalue: `|value| >= 1`, or `Re value >= 0` in continuous time.

        Parameters
        ----------
        discrete
            Sampled time.
        tol
            Distance from the border within which it counts as unstable.
        """
        return bool(abs(self.value) >= 1.0 - tol if discrete else self.value.real >= -tol)


def eigenspaces(A: Floats, *, tol: float) -> tuple[Eigenspace, ...]:
    """All eigenvalues of a matrix with their eigenspaces, repeated ones once.

    Starting from all eigenvalues as one cluster, a cluster is split at the widest gaps of its single
    linkage until its block T of an ordered Schur form, with `N = T - mean(T)`, satisfies

        |N^m| <= tol |N|^(m-1)   and   the smallest singular value of N is at most tol |A|,

    or N itself is that small. That holds, up to the constant, for any matrix within tol of one with an m-fold
    eigenvalue, and fails for several distinct eigenvalues further apart.

    Parameters
    ----------
    A : (n, n)
        Real matrix.
    tol
        Relative backward error at which eigenvalues count as equal and vectors as eigenvectors.

    Returns
    -------
    tuple of Eigenspace
        In no particular order; the algebraic multiplicities sum to n.
    """
    return tuple(_eigenspace(cluster, tol) for cluster in _clusters(_Schur.of(A), tol))


def unstable_subspace(A: Floats, *, discrete: bool, tol: float) -> Floats:
    """X_u(A): the span of the generalised eigenvectors of all unstable eigenvalues.

    Parameters
    ----------
    A : (n, n)
        Real matrix.
    discrete
        Sampled time.
    tol
        As in `eigenspaces` and `Eigenspace.unstable`.

    Returns
    -------
    (n, d)
        Real orthonormal basis.

    References
    ----------
    lee2018, Notation and Symbols.
    """
    return _part(A, discrete=discrete, tol=tol, unstable=True)


def stable_subspace(A: Floats, *, discrete: bool, tol: float) -> Floats:
    """X_s(A): the span of the generalised eigenvectors of all other eigenvalues.

    Parameters and result as in `unstable_subspace`.
    """
    return _part(A, discrete=discrete, tol=tol, unstable=False)


def _part(A: Floats, *, discrete: bool, tol: float, unstable: bool) -> Floats:
    """Real basis of the sum of the generalised eigenspaces on one side of the border."""
    form = _Schur.of(A)
    chosen = np.zeros(form.values.size, dtype=bool)
    for cluster in _clusters(form, tol):
        chosen[cluster.members] = _eigenspace(cluster, tol).unstable(discrete=discrete, tol=tol) == unstable
    count = int(np.count_nonzero(chosen))
    basis, _ = form.invariant(chosen)
    # The space equals its conjugate, so real and imaginary parts span it over the reals: rank = count.
    u, _, _ = np.linalg.svd(np.hstack([basis.real, basis.imag]), full_matrices=False)
    return np.asarray(u[:, :count])


@dataclass(frozen=True, slots=True, eq=False)
class _Schur:
    """A = Z T Z^H with T upper triangular, and |A|."""

    Z: Complexes
    T: Complexes
    size: float

    @classmethod
    def of(cls, A: Floats) -> _Schur:
        T, Z = schur(np.asarray(A, dtype=np.float64), output="complex")
        return cls(Z, T, float(np.linalg.norm(A, 2)) or 1.0)

    @property
    def values(self) -> Complexes:
        return np.diagonal(self.T)

    def invariant(self, chosen: Bools) -> tuple[Complexes, Complexes]:
        """Basis of the invariant subspace of the chosen eigenvalues, and A restricted to it (triangular)."""
        count = int(np.count_nonzero(chosen))
        T, Z, *_ = lapack.ztrsen(chosen.astype(np.int32), self.T, self.Z, job="N")
        return np.asarray(Z[:, :count]), np.asarray(T[:count, :count])


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    """Eigenvalues that count as one; `rest` is A restricted to their space, minus their mean, over |A|."""

    members: Ints
    mean: complex
    basis: Complexes
    rest: Complexes


def _clusters(form: _Schur, tol: float) -> list[_Cluster]:
    found: list[_Cluster] = []
    todo = [np.arange(form.values.size)] if form.values.size else []
    while todo:
        members = todo.pop()
        chosen = np.zeros(form.values.size, dtype=bool)
        chosen[members] = True
        basis, block = form.invariant(chosen)
        mean = complex(np.trace(block) / members.size)
        rest = np.asarray((block - mean * np.eye(members.size)) / form.size, dtype=np.complex128)
        if members.size == 1 or _one_eigenvalue(rest, tol):
            found.append(_Cluster(members, mean, basis, rest))
        else:
            todo.extend(_split(form.values, members))
    return found


def _eigenspace(cluster: _Cluster, tol: float) -> Eigenspace:
    return Eigenspace(cluster.mean, cluster.basis @ kernel(cluster.rest, tol), cluster.basis)


def _one_eigenvalue(rest: Matrix, tol: float) -> bool:
    size = float(np.linalg.norm(rest, 2))
    if size <= tol:
        return True
    m = rest.shape[0]
    power = float(np.linalg.norm(np.linalg.matrix_power(rest / size, m), 2))
    smallest = float(np.linalg.svd(rest, compute_uv=False)[-1])
    return power * size <= tol and smallest <= tol


def _split(values: Complexes, members: Ints) -> list[Ints]:
    """Cut the widest edges of the minimum spanning tree of the members' eigenvalues."""
    points = values[members]
    away = np.abs(points[:, None] - points[None, :])
    reached, edges = [0], []
    distance, source = away[0].copy(), np.zeros(members.size, dtype=np.intp)
    distance[0] = np.inf
    for _ in range(members.size - 1):
        new = int(np.argmin(distance))
        edges.append((float(distance[new]), int(source[new]), new))
        reached.append(new)
        closer = away[new] < distance
        distance[closer], source[closer] = away[new][closer], new
        distance[reached] = np.inf
    widest = max(length for length, _, _ in edges)
    label = np.arange(members.size)
    for length, one, other in edges:
        if length < widest * (1.0 - 1e-12):
            label[label == label[other]] = label[one]
    return [members[label == name] for name in np.unique(label)]
