"""Stacked coding matrices: detectability and correctability of errors in a few blocks.

    z = Phi x + v + e,      Phi = [Phi_1; …; Phi_p],    e zero in all but q blocks

Block i belongs to sensor i: one row of an output matrix, an observability matrix, the rows of a
partial observer. Blocks may have different heights, and may be empty.

Source: lee2018, sections 2.1, 2.2.1 and 2.2.2. Corrections: docs/errata/lee2018-chapter-2.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import comb

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints, unit_rows
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.secure.index import Sparsest, fewest, kernel, padded, row_space
from gridsec.secure.subsets import combinations_of

MOST_SUBSETS = 200_000
"""Default limit of enumerated subsets of sensors in a design."""


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """A coding matrix in p blocks of rows.

    Raises ValueError if heights are negative, or do not sum to the rows of the matrix.
    """

    matrix: Floats  # (N, n) Phi
    heights: Ints  # (p,) rows of each block; they sum to N
    membership: Floats = field(init=False)  # (N, p) 1 where a row belongs to a block, else 0. Derived

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", frozen(self.matrix))
        object.__setattr__(self, "heights", frozen_ints(self.heights))
        if self.matrix.ndim != 2 or self.heights.ndim != 1 or np.any(self.heights < 0):
            raise InputInvalid.of(
                "shape", "a stack needs a matrix and one height, not negative, for every block"
            )
        if int(self.heights.sum()) != self.matrix.shape[0]:
            raise InputInvalid.of(
                "shape", f"heights sum to {self.heights.sum()}; the matrix has {self.matrix.shape[0]} rows"
            )
        block = np.repeat(np.arange(self.heights.size), self.heights)
        object.__setattr__(self, "membership", frozen(np.eye(self.heights.size)[block]))

    @classmethod
    def of(cls, blocks: Sequence[Floats] | Floats) -> Stack:
        """A stack from its blocks: p matrices (k_i, n), or one array (p, k, n)."""
        return cls(np.concatenate(list(blocks)), np.array([len(b) for b in blocks], dtype=np.intp))

    @classmethod
    def of_rows(cls, C: Floats) -> Stack:
        """A stack with the single rows of a matrix as blocks: usual vectors, n = 1 in the paper's terms."""
        return cls(C, np.ones(len(C), dtype=np.intp))

    @property
    def count(self) -> int:
        """p, number of blocks."""
        return int(self.heights.size)

    @property
    def unknowns(self) -> int:
        """n, number of columns."""
        return int(self.matrix.shape[1])

    def rows(self, kept: Sequence[int] | Ints) -> Ints:
        """Indices of the rows of some blocks, in the stack's order."""
        return np.flatnonzero(self.membership[:, list(kept)].any(axis=1))

    def blocks(self) -> Floats:
        """The blocks as one array, short ones padded with zero rows; (p, largest height, n)."""
        blocks = np.split(self.matrix, np.cumsum(self.heights)[:-1])
        return np.asarray(padded(blocks, self.unknowns), dtype=np.float64)

    def norms(self, z: Floats) -> Floats:
        """Euclidean norm of every block of a stacked vector, (…, N) -> (…, p)."""
        return np.sqrt(np.square(z) @ self.membership)

    def support(self, z: Floats, tol: float) -> Ints:
        """Blocks of a stacked vector with a norm above `tol`; the stacked support, ascending."""
        return np.flatnonzero(self.norms(z) > tol)


def cospark(stack: Stack, *, tol: float, below: float = 0.0) -> Sparsest:
    """Fewest blocks in which `Phi x` is not zero, over all x != 0.

    stack: Phi. Every block is scaled to norm one first, which changes no support.
    tol: tolerance of zero after that; blocks shorter than this, relative to the longest, count as zero.
    below: as in `gridsec.secure.index.fewest`.
    Source: lee2018, Notation and Symbols; Remark 2.2.1.
    """
    blocks = np.split(stack.matrix, np.cumsum(stack.heights)[:-1])
    size = stack.norms(np.linalg.norm(stack.matrix, axis=1))
    heard = size > tol * np.max(size, initial=0.0)
    rows = [row_space(block if some else block[:0], tol) for block, some in zip(blocks, heard, strict=True)]
    return fewest(rows, np.eye(stack.unknowns), tol=tol, below=below)


def spark(F: Floats, *, tol: float) -> Sparsest:
    """Fewest columns of F that are linearly dependent, with the coefficients of the dependence.

    F (m, p): sensing matrix. Columns are scaled to norm one first.
    tol: tolerance of zero after that; columns shorter than this, relative to the longest, count as zero.
    Returns the columns as `blocks`, and a `direction` (p,) with `F direction = 0`; the count is infinite if
        the columns are independent.
    Source: lee2018 (2.1.2): `cospark(C) = spark(F)` whenever F annihilates C and nothing else.
    """
    unit = unit_rows(F.T, tol=tol).T
    size = np.where(unit.any(axis=0), np.linalg.norm(F, axis=0), 1.0)
    found = fewest([e[None, :] for e in np.eye(F.shape[1])], kernel(unit, tol), tol=tol)
    x = found.direction / size if np.isfinite(found.count) else found.direction
    return Sparsest(found.count, found.blocks, x)


def error_detectable(stack: Stack, q: int, *, tol: float) -> bool:
    """True if no error in q blocks equals the effect of a change of x: `cospark > q`.

    stack, tol: as in `cospark`.
    q: number of blocks in error.
    Source: lee2018, Definition 2.2.2 and Proposition 2.2.2.
    """
    return cospark(stack, tol=tol, below=q + 1).count > q


def error_correctable(stack: Stack, q: int, *, tol: float) -> bool:
    """True if x is determined under any errors in q blocks: `cospark > 2 q`; lee2018, Definition 2.2.3."""
    return error_detectable(stack, 2 * q, tol=tol)


def require(stack: Stack, lost: int, tol: float, purpose: str) -> None:
    """Raise NotObservable, with a proof, unless x stays determined after the loss of any `lost` blocks."""
    found = cospark(stack, tol=tol, below=lost + 1)
    if found.count > lost:
        return
    left = np.setdiff1d(np.arange(stack.count), found.blocks)
    rank = int(np.linalg.matrix_rank(stack.matrix[stack.rows(left)])) if left.size else 0
    raise NotObservable(
        left.tolist(),
        rank,
        f"{purpose} needs a state that stays determined without any {lost} of the {stack.count} sensors; "
        f"without sensors {found.blocks.tolist()} it is not (lee2018, Propositions 2.2.2 and 2.2.3)",
        code="not-observable",
    )


def subsets(p: int, size: int, most: int) -> Ints:
    """All subsets of a size, each ascending, in lexicographic order; (C(p, size), size).

    Raises DesignInfeasible if there are more than `most`.
    """
    count = comb(p, size)
    if count > most:
        raise DesignInfeasible(
            f"enumeration of {size} of {p} sensors",
            f"{count} subsets; at most {most} allowed",
            code="too-many",
        )
    return combinations_of(p, size)


def masked(stack: Stack, kept: Ints) -> Floats:
    """Phi with zero rows outside the blocks `kept` (S, k), the paper's `Phi_Lambda`; (S, N, n)."""
    keep = np.zeros((len(kept), stack.count))
    np.put_along_axis(keep, kept, 1.0, axis=1)
    return (keep @ stack.membership.T)[:, :, None] * stack.matrix


def annihilator(matrix: Floats, *, tol: float) -> Floats:
    """Orthonormal rows F with `F C = 0` and the range of C as kernel.

    matrix (N, n): C.
    tol: singular values up to this, times the largest, count as zero.
    Returns (N - rank C, N): N - n rows for C of full column rank: n (p - 1) for p blocks of n rows, not (n -
        1) p.
    Source: lee2018 (2.1.2) and Corollary 2.2.5, with corrected dimensions: docs/errata/lee2018-chapter-2.md.
    """
    size = float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0
    return np.ascontiguousarray(kernel(matrix.T / (size or 1.0), tol).T)


def residual(stack: Stack, z: Floats) -> Floats:
    """Residual `z - Phi Phi^+ z`, not explained by any x.

    stack: Phi of full column rank.
    z (…, N): stacked measurements.
    Returns (…, N): zero if and only if the error is undetectable.
    Source: lee2018 (2.2.3), Lemmas 2.2.1 and 2.2.4.
    """
    Q, _ = np.linalg.qr(stack.matrix)
    return np.asarray(z - (z @ Q) @ Q.T)


def clean(stack: Stack, z: Floats, *, tol: float) -> Bools:
    """Test that noiseless measurements are free of error, for at most `cospark - 1` blocks in error.

    stack, z: as in `residual`.
    tol: a residual up to this, relative to z, counts as zero.
    Without an error, `Phi^+ z` is x.
    Source: lee2018, Lemma 2.2.4.
    """
    r = np.linalg.norm(residual(stack, z), axis=-1)
    return np.asarray(r <= tol * np.linalg.norm(z, axis=-1))


def sensors_in_error(stack: Stack, z: Floats, x: Floats, limit: Floats | float) -> Ints:
    """Number of blocks that an x does not explain: `|{i : |z_i - Phi_i x| > limit}|`.

    With at most q blocks in error and a q-error correctable Phi, an x is correct if and only if this is at
    most q: exactly for noiseless z and limit 0, approximately for limit `theta v_max`.

    z (…, N), x (…, n): measurements and candidates.
    limit (scalar or (…, p)): largest norm of a residual that counts as explained.
    Source: lee2018, Lemma 2.2.8 and Theorem 2.2.12.
    """
    # Negated comparison: a residual of NaN counts.
    return np.asarray(np.count_nonzero(~(stack.norms(z - x @ stack.matrix.T) <= limit), axis=-1))
