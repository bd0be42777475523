"""Redundant observability and detectability, and the security indices (lee2018, chapter 3).

A block is a matrix with n columns; it *sees* a direction x unless it maps x to zero. `fewest` finds the
direction that the fewest blocks see: with single rows as blocks, the cospark of a matrix; with observability
matrices of single sensors, the dynamic security index; in an eigenspace, the minimum of Proposition 3.2.2.

In n dimensions a direction seen by the fewest rows is alone in the kernel of the rows that do not see it:
otherwise one more of them could be made not to. So it is among the kernels of all choices of n - 1 rows. If
these are not too many, `fewest_rows` examines all of them together, faster than the branch and bound.

In floating point a repeated eigenvalue comes back as a cluster. An m-fold one of a Jordan block spreads by
`eps^(1/m)`, far more than the distance of distinct ones can be, so no threshold on distances separates the
two. The restriction of A to the invariant subspace of a cluster does: minus its mean eigenvalue it is
nilpotent and singular if the cluster is one eigenvalue, and not if it is several.

Everything has two independent forms: by ranks of observability matrices, and by eigenvectors. The
latter minimise over each whole eigenspace, which covers repeated eigenvalues, defective or not.

For `x(k+1) = A x + B a`, `y = C x + D a` with an unknown a. With B = 0 and D the identity on the
manipulated sensors this is a system under attack, which ties chapter 3 of lee2018 to the geometric theory.

Source: lee2018, chapter 3; chong2020 (9). Corrections: docs/errata/lee2018-chapter-3.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, islice
from math import comb
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, schur

from gridsec.arrays import Bools, Floats, Ints, frozen_ints, unit_rows
from gridsec.errors import DesignInfeasible, no_choice, raise_if_any
from gridsec.observers.lure import Lure
from gridsec.observers.parts import krylov

Complexes = NDArray[np.complex128]
Matrix = NDArray[np.inexact[Any]]
Scalar = TypeVar("Scalar", bound=np.inexact[Any])

MOST_NODES = 1_000_000
"""Largest number of nodes of a search; beyond it the search stops with an error."""


@dataclass(frozen=True, slots=True, eq=False)
class Sparsest:
    """A direction and the blocks that see it."""

    count: float  # number of those blocks; infinite without any direction
    blocks: Ints  # (count,) indices of these blocks, ascending; empty without any direction
    direction: Matrix  # (n,) unit vector; empty if there is none. Complex only if the blocks or the space are


def row_space(block: NDArray[Scalar], tol: float) -> NDArray[Scalar]:
    """Orthonormal rows (rank, n) with the row space of a matrix; `tol` is relative to its norm."""
    if not np.any(block):
        return block[:0]
    _, s, vh = np.linalg.svd(block, full_matrices=False)
    return np.asarray(vh[: int(np.count_nonzero(s > tol * s[0]))])


def kernel(matrix: NDArray[Scalar], tol: float) -> NDArray[Scalar]:
    """Orthonormal basis of `{x : M x = 0}` in columns; singular values up to `tol` count as zero."""
    columns = matrix.shape[1]
    if matrix.shape[0] == 0:
        return np.eye(columns, dtype=matrix.dtype)
    _, s, vh = np.linalg.svd(matrix, full_matrices=True)
    return np.asarray(vh[int(np.count_nonzero(s > tol)) :].conj().T)


def span(columns: NDArray[Scalar], tol: float) -> NDArray[Scalar]:
    """Orthonormal basis of the range of columns of norm near one or zero; `tol` as in `kernel`."""
    if columns.shape[1] == 0:
        return columns
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, : int(np.count_nonzero(s > tol))])


def fewest(
    rows: Sequence[Matrix],
    space: Matrix,
    *,
    tol: float,
    most: int = MOST_NODES,
    below: float = 0.0,
    must: int | None = None,
) -> Sparsest:
    """Minimise, over the x != 0 of a space, the number of blocks that see x.

    Exact branch and bound over flats. At a node the remaining directions are a subspace N; blocks that vanish
    on all of N are free, and a generic x of N is seen by every other block, which gives an upper bound. One
    of the others is then either made to vanish (N shrinks) or counted. A path has at most n of the former,
    and fewer of the latter than the best count so far.

    rows (p times (k_i, n)): orthonormal rows of each block, from `row_space`.
    space (n, d): orthonormal basis of the space in its columns.
    tol: a block does not see a unit vector if the norm of their product is at most this.
    below: decide only if fewer blocks than this see some direction: if so, the count is below it, otherwise
        any upper bound. Takes at most C(n + below, n) nodes. 0 for the minimum.
    must: restrict to directions that this block sees; if there are none, the count is infinite.
    Of several optimal directions, returns the first found.
    Raises DesignInfeasible if more than `most` nodes are needed. The general problem is NP-hard.
    """
    blocks = padded(rows, space.shape[0])
    if space.shape[1] == 0 or not _sees(blocks, must, space, tol):
        return Sparsest(np.inf, np.zeros(0, dtype=np.intp), np.zeros(0))
    best, best_space, nodes = np.inf, space, 0
    todo = [(space, np.arange(len(rows)), 0)]
    if must is not None:
        todo = [(space, np.delete(np.arange(len(rows)), must), 1)]
    while todo:
        here, undecided, paid = todo.pop()
        enough = min(best, below) if below > 0 else best
        if paid >= enough or not _sees(blocks, must, here, tol):
            continue
        nodes += 1
        if nodes > most:
            what = f"direction that the fewest of {len(rows)} blocks see"
            raise DesignInfeasible(
                what, f"more than {most} nodes of the search; best so far: {best:g} blocks", code="too-many"
            )
        seen = blocks[undecided] @ here
        sizes = np.linalg.svd(seen, compute_uv=False) if seen.size else np.zeros((len(undecided), 1))
        live = sizes[:, 0] > tol
        count = paid + int(np.count_nonzero(live))
        if count < best:
            best, best_space = count, here
            if best < below:
                break
        if not np.any(live) or here.shape[1] == 1:
            continue
        left, ranks = undecided[live], np.count_nonzero(sizes[live] > tol, axis=1)
        pick = int(np.argmin(ranks))
        rest = np.delete(left, pick)
        if paid + 1 < enough:
            todo.append((here, rest, paid + 1))
        smaller = here @ kernel(seen[live][pick], tol)
        if smaller.shape[1] > 0:
            # Pushed last, hence visited first: it lowers the bound soonest.
            todo.append((smaller, rest, paid))
    return _generic(blocks, best_space, tol)


def _sees(blocks: Matrix, block: int | None, space: Matrix, tol: float) -> bool:
    """True if no block is given, or the block sees a direction of the space."""
    return block is None or bool(np.linalg.norm(blocks[block] @ space, 2) > tol)


def _generic(blocks: Matrix, space: Matrix, tol: float) -> Sparsest:
    """A direction of the space outside every block's kernel, unless the kernel contains the whole space."""
    if space.shape[1] == 1:
        x = space[:, 0]
    else:
        # Any fixed generic mixture serves; the fixed seed makes the search reproducible.
        mixture = np.random.default_rng(0).standard_normal(space.shape[1])
        x = space @ (mixture / np.linalg.norm(mixture))
    where = np.flatnonzero(np.linalg.norm(blocks @ x, axis=1) > tol)
    return Sparsest(float(where.size), where, x)


def padded(rows: Sequence[Matrix], n: int) -> Matrix:
    """The blocks as one array, short ones padded with zero rows; (p, largest k_i, n)."""
    tall = max((len(r) for r in rows), default=0)
    out = np.zeros((len(rows), max(tall, 1), n), dtype=np.result_type(np.float64, *(r.dtype for r in rows)))
    for i, r in enumerate(rows):
        out[i, : len(r)] = r
    return out


MOST_CHOICES = 200_000
"""Largest number of choices of rows; above it, branch and bound is used."""

_TOGETHER = 4096


def fewest_rows(seen: Matrix, *, tol: float, must: int | None = None) -> Sparsest | None:
    """Minimise the number of rows that see a direction; None if there are too many choices.

    Of several minimisers the first one of `gridsec.secure.index.fewest`: where two differ first, it does not
    see the earlier row.

    seen (p, n): image of a basis in each row; together the rows see everything, n >= 2.
    tol: products of unit vectors up to this count as zero.
    must: a row, not zero, that must see the direction; None for any.
    Source: lee2018, Proposition 3.2.2: the sensors that see an eigenvector.
    """
    count, n = seen.shape
    if comb(count, n - 1) > MOST_CHOICES:
        return None
    best, hit, answer = count + 1, np.ones(count, dtype=np.bool_), seen[0]
    for choice in _choices(count, n - 1):
        _, s, vh = np.linalg.svd(seen[choice])
        x = vh[:, -1].conj()
        sees = np.abs(x @ seen.T) > tol
        np.put_along_axis(sees, choice, False, axis=1)
        fits = s[:, -1] > tol if must is None else (s[:, -1] > tol) & sees[:, must]
        size = np.where(fits, np.count_nonzero(sees, axis=1), count + 1)
        for k in np.flatnonzero(size == size.min()):
            if size[k] < best or (size[k] == best and _earlier(sees[k], hit)):
                best, hit, answer = int(size[k]), sees[k], x[k]
    if best > count:
        return Sparsest(np.inf, np.zeros(0, dtype=np.intp), np.zeros(0))
    return Sparsest(float(best), np.flatnonzero(hit), answer)


def _choices(count: int, size: int) -> Iterator[Ints]:
    every = combinations(range(count), size)
    while some := list(islice(every, _TOGETHER)):
        yield np.array(some, dtype=np.intp)


def _earlier(sees: Bools, other: Bools) -> bool:
    """True if, of two directions, this one is not seen where they differ first."""
    apart = np.flatnonzero(sees != other)
    return bool(apart.size and not sees[apart[0]])


@dataclass(frozen=True, slots=True, eq=False)
class Eigenspace:
    """One eigenvalue with all its eigenvectors."""

    value: complex  # the eigenvalue: the mean of its cluster, which is more accurate than its members
    vectors: Complexes  # (n, g) orthonormal basis of the eigenspace; g is the geometric multiplicity
    # (n, m) orthonormal basis of the generalised eigenspace; m is the algebraic multiplicity
    invariant: Complexes

    def unstable(self, *, discrete: bool, tol: float) -> bool:
        """True unless `|value| < 1 - tol` in sampled time, `Re value < -tol` in continuous time."""
        return bool(abs(self.value) >= 1.0 - tol if discrete else self.value.real >= -tol)


def eigenspaces(A: Floats, *, tol: float) -> tuple[Eigenspace, ...]:
    """All eigenvalues of a matrix with their eigenspaces, repeated ones once.

    Starting from all eigenvalues as one cluster, a cluster is split at the widest gaps of its single
    linkage until its block T of an ordered Schur form, with `N = T - mean(T)`, satisfies

        |N^m| <= tol |N|^(m-1)   and   the smallest singular value of N is at most tol |A|,

    or N itself is that small. That holds, up to the constant, for any matrix within tol of one with an m-fold
    eigenvalue, and fails for several distinct eigenvalues further apart.

    A (n, n). tol: relative backward error at which eigenvalues count as equal and vectors as eigenvectors.
    Their order is arbitrary; the algebraic multiplicities sum to n.
    """
    return tuple(_eigenspace(cluster, tol) for cluster in _clusters(_Schur.of(A), tol))


def unstable_subspace(A: Floats, *, discrete: bool, tol: float) -> Floats:
    """X_u(A): the span of the generalised eigenvectors of all unstable eigenvalues.

    A (n, n). discrete: sampled time.
    tol: as in `eigenspaces` and `Eigenspace.unstable`.
    Returns (n, d): real orthonormal basis.
    Source: lee2018, Notation and Symbols.
    """
    return _part(A, discrete=discrete, tol=tol, unstable=True)


def stable_subspace(A: Floats, *, discrete: bool, tol: float) -> Floats:
    """X_s(A): the span of the generalised eigenvectors of all stable eigenvalues; see `unstable_subspace`."""
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


By = Literal["eigenvectors", "rank"]


@dataclass(frozen=True, slots=True, eq=False)
class Index:
    """Smallest set of sensors of an invisible attack, and its direction."""

    count: float  # the index; infinite if no number of sensors suffices
    sensors: Ints  # (count,) a smallest set of sensors; empty if there is none
    # (n,) apparent displacement of the state; empty if there is none. Complex directions stand for their real
    # part, which is seen by the same sensors and has a norm of at least sqrt(1/2)
    direction: Matrix

    @property
    def correctable(self) -> float:
        """Largest number of correctable manipulated sensors, `ceil(count / 2) - 1`; -1 if not observable."""
        return float(np.ceil(self.count / 2.0) - 1.0)

    @property
    def detectable(self) -> float:
        """Largest number of manipulated sensors that are always detectable: `count - 1`."""
        return self.count - 1.0


def observability(A: Floats, C: Floats, steps: int | None = None) -> Floats:
    """Observability matrices of the single sensors, `G_i = [c_i; c_i A; …; c_i A^(k-1)]`.

    A (n, n), C (p, n).
    steps: k; n by default.
    Returns (p, k, n): G_i in `[i]`; reshaped to (p k, n) it is the stacked G of the paper.
    Source: lee2018 (3.1.3), (3.1.4).
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

    A (n, n), C (p, n).
    tol: a new row shorter than this times |A| counts as dependent. A sensor with a row up to this fraction of
        the longest measures nothing.
    Returns p times (rank G_i, n): empty for a sensor that measures nothing.
    """
    rows = unit_rows(np.asarray(C, dtype=np.float64), tol=tol)
    return tuple(np.asarray(krylov(A, row, tol).T) for row in rows)


def _sensors(C: Floats, tol: float) -> list[Matrix]:
    """Row of each sensor, scaled to length one: the unit of a sensor is not a property of the system."""
    rows = unit_rows(np.asarray(C, dtype=np.float64), tol=tol)
    return [row_space(row[None, :], 0.0) for row in rows]


def static_index(C: Floats, *, tol: float) -> Index:
    """alpha_s(C) = cospark(C), the index of one snapshot of readings.

    C (p, n).
    tol: a product of a sensor's unit row with a unit state up to this counts as zero. A sensor with a row up
        to this fraction of the longest measures nothing.
    Source: lee2018 (3.2.2).
    """
    found = fewest(_sensors(C, tol), np.eye(C.shape[1]), tol=tol)
    return Index(found.count, frozen_ints(found.blocks), found.direction)


def dynamic_index(A: Floats, C: Floats, *, tol: float, by: By = "eigenvectors") -> Index:
    """Smallest number of sensors of an attack that stays invisible for all time, alpha_d(A, C).

        min over x != 0 of |G x|_{0^n}   =   min over eigenvectors v of A of |C v|_0

    The same number for sampled and for continuous time.

    A (n, n), C (p, n).
    tol: tolerance of zero, relative to unit vectors, |A| and the longest row of C.
    by: "eigenvectors": over every eigenspace, (3.2.4). "rank": over all states, (3.2.3).
    Raises ValueError if `by` is another text.
    Source: lee2018 (3.2.3), Proposition 3.2.2.
    """
    return _index(A, C, None, tol, by)


def asymptotic_index(A: Floats, C: Floats, *, discrete: bool, tol: float, by: By = "eigenvectors") -> Index:
    """`dynamic_index` for attacks with an effect that does not decay, alpha_a(A, C).

        min over x outside X_s(A) of |G x|_{0^n}   =   min over unstable eigenvectors v of |C v|_0

    A (n, n), C (p, n).
    discrete: True if A is the matrix of a sampled system (unstable: |lambda| >= 1), False for that of a
        differential equation (Re lambda >= 0).
    tol: tolerance of zero. An eigenvalue within this of the border counts as unstable.
    by: as in `dynamic_index`.
    The index of a stable A is infinite.
    Raises ValueError if `by` is another text.
    Source: lee2018 (3.2.5), Proposition 3.2.4.
    """
    return _index(A, C, discrete, tol, by)


def _index(A: Floats, C: Floats, discrete: bool | None, tol: float, by: By) -> Index:
    """`asymptotic_index`, or `dynamic_index` for `discrete` None."""
    raise_if_any(no_choice("by", get_args(By), by))
    if by == "eigenvectors":
        return _over(_eigenvectors(A, discrete, tol), C, tol)
    # An invariant kernel is the sum of its stable and its unstable part: searching X_u suffices.
    found = fewest(observable_rows(A, C, tol=tol), _searched(A, discrete, tol), tol=tol)
    return Index(found.count, frozen_ints(found.blocks), found.direction)


def _eigenvectors(A: Floats, discrete: bool | None, tol: float) -> list[Complexes]:
    """Bases of all eigenspaces, or of the unstable ones in sampled or continuous time."""
    spaces = eigenspaces(A, tol=tol)
    return [e.vectors for e in spaces if discrete is None or e.unstable(discrete=discrete, tol=tol)]


def _searched(A: Floats, discrete: bool | None, tol: float) -> Floats:
    """Basis of all states, or of the unstable subspace in sampled or continuous time."""
    return np.eye(A.shape[0]) if discrete is None else unstable_subspace(A, discrete=discrete, tol=tol)


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

    A (n, n), C (p, n).
    q: number of sensors lost.
    tol: as in `dynamic_index`.
    by: "eigenvectors": `|C v|_0 > q` for every eigenvector. "rank": all C(p, q) stacked matrices.
    Raises ValueError if `by` is another text.
    Source: lee2018, Definition 3.1.1, Propositions 3.1.1 (iii) and 3.1.2 (ii).
    """
    return _redundant(A, C, q, None, tol, by)


def redundant_detectable(
    A: Floats, C: Floats, q: int, *, discrete: bool, tol: float, by: By = "eigenvectors"
) -> bool:
    """True if (A, C) stays detectable after the loss of any q sensors.

    A, C, q, tol, by: as in `redundant_observable`.
    discrete: as in `asymptotic_index`.
    Raises ValueError if `by` is another text.
    Source: lee2018, Definition 3.1.3, Propositions 3.1.8 (ii) and 3.1.9 (ii).
    """
    return _redundant(A, C, q, discrete, tol, by)


def _redundant(  # noqa: PLR0917  # the arguments of both public forms
    A: Floats, C: Floats, q: int, discrete: bool | None, tol: float, by: By
) -> bool:
    """`redundant_detectable`, or `redundant_observable` for `discrete` None."""
    raise_if_any(no_choice("by", get_args(By), by))
    if by == "eigenvectors":
        return _over(_eigenvectors(A, discrete, tol), C, tol, below=q + 1).count > q
    rows, space = observable_rows(A, C, tol=tol), _searched(A, discrete, tol)
    return all(_lost(rows, kept, space, tol).shape[1] == 0 for kept in _survivors(len(rows), q))


def unobservable_subspace(A: Floats, C: Floats, q: int = 0, *, tol: float) -> Floats:
    """The q-redundant unobservable subspace: span of all states made unobservable by the loss of q sensors.

        sum over |Lambda| = p - q of N(G_Lambda)

    A, C, q, tol: as in `redundant_observable`. The whole space for q >= p. Costs C(p, q) kernels.
    Returns (n, d): orthonormal basis. Its orthogonal complement is the redundant observable subspace.
    Source: lee2018, Definition 3.1.2, Propositions 3.1.4 and 3.1.6.
    """
    return _summed(A, C, q, _searched(A, None, tol), tol)


def undetectable_subspace(A: Floats, C: Floats, q: int = 0, *, discrete: bool, tol: float) -> Floats:
    """The q-redundant undetectable subspace: the unstable part of the redundant unobservable one.

        sum over |Lambda| = p - q of N(G_Lambda) ∩ X_u(A)

    A, C, q, discrete, tol: as in `redundant_detectable`.
    Returns (n, d): orthonormal basis. Its orthogonal complement is the redundant detectable subspace.
    Source: lee2018, Definition 3.1.4, Propositions 3.1.11 and 3.1.13.
    """
    return _summed(A, C, q, unstable_subspace(A, discrete=discrete, tol=tol), tol)


def _summed(A: Floats, C: Floats, q: int, space: Floats, tol: float) -> Floats:
    rows = observable_rows(A, C, tol=tol)
    total = np.zeros((A.shape[0], 0))
    for kept in _survivors(len(rows), q):
        lost = _lost(rows, kept, space, tol)
        # Only new directions are added, so that the basis never exceeds n columns.
        total = np.asarray(span(np.hstack([total, lost]), np.sqrt(tol)))
        if total.shape[1] == space.shape[1]:
            break
    return total


def _survivors(p: int, q: int) -> list[tuple[int, ...]]:
    return list(combinations(range(p), max(p - q, 0)))


def _lost(rows: Sequence[Floats], kept: Sequence[int], space: Floats, tol: float) -> Floats:
    """Basis of the directions of a space that are invisible to all kept sensors."""
    if not kept:
        return space
    return np.asarray(space @ kernel(np.vstack([rows[i] for i in kept]) @ space, tol))


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """Motions of a system with an unknown input that cannot be distinguished from rest."""

    # (n, d) basis of the initial states with an input that keeps the output zero for ever
    weakly_unobservable: Floats
    # (n, c) basis of those among them that are reached from rest with zero output: the input stays hidden
    # there without any effect on the initial state
    controllable: Floats
    # (d - c,) invariant zeros: the eigenvalues of the remaining motion, which no input can change
    zeros: NDArray[np.complex128]

    @property
    def strongly_observable(self) -> bool:
        """True if zero output implies zero state, for any input."""
        return bool(self.weakly_unobservable.shape[1] == 0)

    def strongly_detectable(self, *, discrete: bool, tol: float) -> bool:
        """True if zero output implies a state that decays, for any input.

        discrete: sampled time: zeros must have modulus below 1; otherwise a negative real part.
        tol: distance from that border within which a zero counts as unstable.
        Source: lee2018, Proposition 3.1.10 (iii), corrected: docs/errata/lee2018-chapter-3.md.
        """
        size = np.abs(self.zeros) - 1.0 if discrete else self.zeros.real
        return bool(self.controllable.shape[1] == 0 and np.all(size < -tol))


def hidden(A: Floats, B: Floats, C: Floats, D: Floats, *, tol: float) -> Hidden:
    """Weakly unobservable subspace, its controllable part, and the invariant zeros.

        V_0 = R^n,  V_(k+1) = {x : exists a with A x + B a in V_k, C x + D a = 0}
        T_0 = 0,    T_(k+1) = {A x + B a : x in T_k, C x + D a = 0},   controllable part = V ∩ T

    A (n, n), B (n, m), C (p, n), D (p, m): the system, preferably in units with entries of order one.
    tol: singular values up to this, times the largest of the system's, count as zero.
    Source: H. Trentelman, A. Stoorvogel, M. Hautus, "Control theory for linear systems", Springer, 2001,
        chapter 7; lee2018, section 3.1.2.
    """
    whole = np.block([[A, B], [C, D]])
    size = float(np.linalg.norm(whole, 2)) or 1.0
    A, B, C, D = A / size, B / size, C / size, D / size
    V = _output_nulling(A, B, C, D, tol)
    T = _reachable(A, B, C, D, tol)
    # V ∩ T: combinations V a = T b.
    meet = kernel(np.hstack([V, -T]), tol)
    R = span(V @ meet[: V.shape[1]], tol)
    # A V - V X + B U = 0 and C V + D U = 0; X is the motion inside V, in a basis that begins with R.
    rest = V @ kernel(R.T @ V, tol) if R.shape[1] else V
    basis = np.hstack([R, rest])
    p, d = C.shape[0], basis.shape[1]
    left = np.block([[basis, -B], [np.zeros((p, d)), -D]])
    X = np.linalg.lstsq(left, np.vstack([A @ basis, C @ basis]), rcond=tol)[0][:d]
    inner = X[R.shape[1] :, R.shape[1] :] * size
    zeros = np.linalg.eigvals(inner) if inner.size else np.zeros(0)
    return Hidden(V, R, zeros.astype(np.complex128))


def under_attack(A: Floats, C: Floats, manipulated: Sequence[int], *, tol: float) -> Hidden:
    """`hidden` for the pair (A, C) with arbitrary reports of the sensors in `manipulated`.

    The system `x+ = A x`, `y = C x + I_manipulated a` of the paper's (3.1.6).

    A (n, n), C (p, n).
    manipulated: sensors under the attacker's control.
    tol: as in `hidden`. A sensor with a row up to this fraction of the longest measures nothing.
    Source: lee2018 (3.1.6), Propositions 3.1.3 and 3.1.10.
    """
    # All blocks scaled to the size of A, so that one tolerance suffices: units change no subspace.
    size = float(np.linalg.norm(A, 2)) or 1.0
    unit = unit_rows(C, tol=tol) * size
    D = size * np.eye(C.shape[0])[:, list(manipulated)]
    return hidden(A, np.zeros((A.shape[0], D.shape[1])), unit, D, tol=tol)


def _output_nulling(A: Floats, B: Floats, C: Floats, D: Floats, tol: float) -> Floats:
    n = A.shape[0]
    V = np.eye(n)
    while V.shape[1] > 0:
        outside = np.eye(n) - V @ V.T
        free = np.vstack([outside @ B, D])
        u = span(free, tol)
        image = np.vstack([outside @ A, C])
        image = image - u @ (u.T @ image)
        smaller = np.asarray(V @ kernel(image @ V, tol))
        if smaller.shape[1] == V.shape[1]:
            break
        V = smaller
    return V


def _reachable(A: Floats, B: Floats, C: Floats, D: Floats, tol: float) -> Floats:
    n = A.shape[0]
    T = np.zeros((n, 0))
    for _ in range(n):
        inputs = kernel(np.hstack([C @ T, D]), tol)
        larger = np.asarray(span(np.hstack([A @ T, B]) @ inputs, tol))
        if larger.shape[1] == T.shape[1]:
            break
        T = larger
    return T


@dataclass(frozen=True, slots=True, eq=False)
class FeederIndex:
    """Smallest numbers of meters in an invisible coordinated attack, for exactly known loads."""

    static: Index  # from one snapshot of readings alone
    dynamic: Index  # from the readings of all time
    asymptotic: Index  # as `dynamic`, for attacks that do not decay; infinite for a stable closed loop
    A: Floats  # (n, n) motion of the linearised loop
    C: Floats  # (p, n) outputs of the linearised loop


def slopes(lure: Lure, z: Floats, *, step: float) -> Floats:
    """Slopes of the nonlinearities at a point, by symmetric differences; (m,).

    z (m,): arguments of the nonlinearities.
    step: half the width of the difference, in the unit of z. Near a kink closer than this, the result is a
        mixture of the slopes on both sides.
    """
    return np.asarray((lure.phi(z + step) - lure.phi(z - step)) / (2.0 * step))


def linearise(lure: Lure, slope: Floats) -> tuple[Floats, Floats]:
    """Pair `(A + G diag(slope) H, C)` of a Lur'e system for slopes (m,), from `slopes` or `lure.slope`."""
    return lure.A + (lure.G * slope) @ lure.H, np.asarray(lure.C)


def feeder_index(lure: Lure, slope: Floats, *, tol: float) -> FeederIndex:
    """Static, dynamic and asymptotic security index of a feeder's linearised closed loop.

    States and meters are scaled to order one first, which changes no index. Inverters of slope zero decay
    independently; those with equal time constants share one eigenspace, on which the dynamic index falls to
    the static one of their columns.

    lure: closed loop, from `close_loop`.
    slope (m,): as in `linearise`.
    tol: as in `dynamic_index`.
    """
    A, C = linearise(lure, slope)
    return FeederIndex(
        static_index(C, tol=tol),
        dynamic_index(A, C, tol=tol),
        asymptotic_index(A, C, discrete=False, tol=tol),
        A,
        C,
    )
