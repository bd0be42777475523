"""Random pairs (A, C) in exact integers, with their security indices by brute force."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import block_diag

from gridsec.arrays import Floats

Exact = np.ndarray  # integers of any size, dtype object


@dataclass(frozen=True)
class Pair:
    """A pair with integer entries: A is half of `twice`, so that eigenvalues 0 and 1/2 are stable."""

    twice: Exact
    C: Exact
    # A polynomial of `twice` whose kernel is the stable subspace (discrete time) of A.
    unstable_part: Exact
    repeated: bool
    defective: bool

    @property
    def a(self) -> Floats:
        return self.twice.astype(float) / 2.0

    @property
    def c(self) -> Floats:
        return self.C.astype(float)


def exact_rank(rows: list[list[int]]) -> int:
    """Rank by elimination without fractions (Bareiss): no rounding, no tolerance."""
    rows = [list(r) for r in rows]
    rank, previous, columns = 0, 1, len(rows[0]) if rows else 0
    for j in range(columns):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][j]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            rows[i] = [
                (rows[rank][j] * a - rows[i][j] * b) // previous
                for a, b in zip(rows[i], rows[rank], strict=True)
            ]
        previous, rank = rows[rank][j], rank + 1
    return rank


def power(matrix: Exact, k: int) -> Exact:
    out = np.array(np.eye(len(matrix), dtype=int), dtype=object)
    for _ in range(k):
        out = out @ matrix
    return out


def unimodular(rng: np.random.Generator, n: int) -> tuple[Exact, Exact]:
    """An integer matrix with an integer inverse."""
    S, inverse = (np.array(np.eye(n, dtype=int), dtype=object) for _ in range(2))
    for _ in range(2 * n):
        i, j = rng.choice(n, 2, replace=False)
        f = int(rng.integers(-1, 2))
        S[i] = S[i] + f * S[j]
        inverse[:, j] = inverse[:, j] - f * inverse[:, i]
    return S, inverse


def random_pair(seed: int, n: int = 4, p: int = 5) -> Pair:
    """Jordan blocks, repeated values, complex pairs by chance, behind an integer change of basis."""
    rng = np.random.default_rng(seed)
    blocks: list[np.ndarray] = []
    unstable, real = [], []
    left = n
    while left:
        if left >= 2 and rng.random() < 0.2:
            k = int(rng.integers(1, 3))
            blocks.append(np.array([[0, -k], [k, 0]]))
            unstable.append(("pair", k, k >= 2))
            left -= 2
            continue
        size = int(rng.choice([1, 1, 2, 3], p=None))
        size = min(size, left)
        value = int(rng.integers(-1, 3))
        blocks.append(value * np.eye(size, dtype=int) + np.eye(size, k=1, dtype=int))
        unstable.append(("real", value, abs(value) >= 2))
        real.append((value, size))
        left -= size
    J = np.array(block_diag(*blocks).astype(int), dtype=object)
    S, inverse = unimodular(rng, n)
    twice = S @ J @ inverse
    eye = np.array(np.eye(n, dtype=int), dtype=object)
    polynomial = eye
    for kind, value, bad in set(unstable):
        if not bad:
            factor = twice @ twice + value**2 * eye if kind == "pair" else twice - value * eye
            polynomial = polynomial @ power(factor, n)
    sparse = np.array(rng.integers(-1, 2, (p, n)) * (rng.random((p, n)) < 0.6), dtype=object)
    values = [v for v, _ in real]
    return Pair(
        twice,
        sparse @ inverse,
        polynomial,
        repeated=len(set(values)) < len(values) or any(size > 1 for _, size in real),
        defective=any(size > 1 for _, size in real),
    )


def brute_force(pair: Pair) -> tuple[int, float]:
    """Dynamic and asymptotic index by definition: over all sets of sensors, by exact ranks.

    The sensors outside a set see nothing of some x != 0 (of some x outside X_s) if and only if their
    stacked observability matrix is rank deficient (loses rank against itself stacked on a matrix
    whose kernel is X_s).
    """
    p, n = pair.C.shape
    G = [np.array([pair.C[i] @ power(pair.twice, k) for k in range(n)], dtype=object) for i in range(p)]
    dynamic, asymptotic = p + 1, np.inf
    for size in range(p + 1):
        for lost in itertools.combinations(range(p), size):
            rows = [list(r) for i in range(p) if i not in lost for r in G[i]]
            rank = exact_rank(rows) if rows else 0
            if rank < n:
                dynamic = min(dynamic, size)
            if size < asymptotic:
                both = exact_rank(rows + [list(r) for r in pair.unstable_part])
                if both > rank:
                    asymptotic = size
    return dynamic, asymptotic


@cache
def cases() -> tuple[tuple[Pair, int, float], ...]:
    pairs = [random_pair(seed) for seed in range(200)]
    return tuple((pair, *brute_force(pair)) for pair in pairs)
