"""Direction seen by the fewest single rows, in spaces of few dimensions: all flats at once.

In n dimensions a direction seen by the fewest rows is alone in the kernel of the rows that do not see it:
otherwise one more of them could be made not to. So it is among the kernels of all choices of n - 1 rows. If
these are not too many, linear algebra on all of them together is faster than the branch and bound of
`gridsec.index.blocks`, with its cost for every row that sees the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, islice
from math import comb

import numpy as np

from gridsec.arrays import Bools, Ints
from gridsec.index.blocks import Matrix, Sparsest

__all__ = ["MOST_CHOICES", "fewest_rows"]

MOST_CHOICES = 200_000
"""Largest number of choices of rows; above it, branch and bound is used."""

_TOGETHER = 4096


def fewest_rows(seen: Matrix, *, tol: float, must: int | None = None) -> Sparsest | None:
    """Minimise the number of rows that see a direction; None if there are too many choices.

    Of several minimisers the first one of `gridsec.index.fewest`: where two differ first, it does not see the
    earlier row.

    Parameters
    ----------
    seen : (p, n)
        Image of a basis in each row; together the rows see everything, n >= 2.
    tol
        Products of unit vectors up to this count as zero.
    must
        A row, not zero, that must see the direction; None for any.

    References
    ----------
    lee2018, Proposition 3.2.2: the sensors that see an eigenvector.
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
