"""Direction that the fewest blocks of rows, or the fewest single rows, see.

A block is a matrix with n columns; it *sees* a direction x unless it maps x to zero. With single rows as
blocks the result is the cospark of a matrix; with the observability matrices of single sensors as
blocks it is the dynamic security index; within an eigenspace, the minimum of Proposition 3.2.2 of lee2018.

In n dimensions a direction seen by the fewest rows is alone in the kernel of the rows that do not see it:
otherwise one more of them could be made not to. So it is among the kernels of all choices of n - 1 rows. If
these are not too many, linear algebra on all of them together is faster than the branch and bound of
`gridsec.secure.index.blocks`, with its cost for every row that sees the result.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, islice
from math import comb
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gridsec.arrays import Bools, Ints
from gridsec.errors import DesignInfeasible

__all__ = [
    "MOST_CHOICES",
    "MOST_NODES",
    "Matrix",
    "Scalar",
    "Sparsest",
    "fewest",
    "fewest_rows",
    "kernel",
    "row_space",
    "span",
]


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
    """Orthonormal rows (rank, n) that span the rows of a matrix; they have the same kernel.

    block (k, n).
    tol: singular values up to `tol` times the largest count as zero.
    """
    if not np.any(block):
        return block[:0]
    _, s, vh = np.linalg.svd(block, full_matrices=False)
    return np.asarray(vh[: int(np.count_nonzero(s > tol * s[0]))])


def kernel(matrix: NDArray[Scalar], tol: float) -> NDArray[Scalar]:
    """Orthonormal basis of `{x : M x = 0}` in columns, (n, n - rank).

    matrix (k, n).
    tol: singular values up to this size, absolutely, count as zero.
    """
    columns = matrix.shape[1]
    if matrix.shape[0] == 0:
        return np.eye(columns, dtype=matrix.dtype)
    _, s, vh = np.linalg.svd(matrix, full_matrices=True)
    return np.asarray(vh[int(np.count_nonzero(s > tol)) :].conj().T)


def span(columns: NDArray[Scalar], tol: float) -> NDArray[Scalar]:
    """Orthonormal basis of the range of a matrix with column norms near one or zero.

    columns (n, k).
    tol: singular values up to this size, absolutely, count as zero.
    """
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
    blocks = _padded(rows, space.shape[0])
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


def _padded(rows: Sequence[Matrix], n: int) -> Matrix:
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
