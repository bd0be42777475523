"""Index tables of the two banks: omitted meters of each observer, and the compared pairs.

A set of meters is represented by the meters it *omits*: chong2020's S leaves out M of p meters, P leaves out
2M, and P lies within S exactly if S leaves out M of the 2M meters that P leaves out. That makes both the
sets and all their comparisons plain tables, computed once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, combinations
from math import comb

import numpy as np

from gridsec.arrays import Bools, Ints
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable


@dataclass(frozen=True, slots=True, eq=False)
class Subsets:
    """Sensor subsets of chong2020's two banks. p meters, at most M attacked."""

    meters: int  # p
    max_attacked: int  # M
    out_large: Ints  # (C(p, M), M) meters that each large set S leaves out, ascending
    out_small: Ints  # (C(p, 2M), 2M) meters that each small set P leaves out, ascending
    choices: Ints  # (C(2M, M), M) the choices of M of the 2M places of `out_small`
    # (C(2M, M), C(p, 2M)) `parent[c, P]`: the S that leaves out those of P's meters that choice c picks
    parent: Ints
    # (C(p, M), C(p - M, M)) for each S, positions of its comparisons in an array of shape `parent.shape`,
    # flattened
    pairs: Ints

    @property
    def count_large(self) -> int:
        """Number of large sets S."""
        return int(self.out_large.shape[0])

    @property
    def count_small(self) -> int:
        """Number of small sets P."""
        return int(self.out_small.shape[0])

    def masks(self) -> Bools:
        """Membership (C(p, M) + C(p, 2M), p) of the meters, large sets first."""
        rows = []
        for out in (self.out_large, self.out_small):
            mask = np.ones((out.shape[0], self.meters), dtype=np.bool_)
            np.put_along_axis(mask, out, values=False, axis=1)
            rows.append(mask)
        return np.concatenate(rows)


def subsets(meters: int, max_attacked: int, *, most: int) -> Subsets:
    """Tables for p meters with at most M manipulated.

    meters: p, number of meters.
    max_attacked: M, largest number of simultaneously manipulated meters.
    Raises NotObservable unless p > 2M. DesignInfeasible if the banks need more than `most` observers.
        ValueError if M is negative.
    Source: chong2020, Theorem 1 (ii), equations (5) and (6).
    """
    if max_attacked < 0:
        raise InputInvalid.of("negative", f"max_attacked is {max_attacked}; it cannot be negative")
    if meters <= 2 * max_attacked:
        raise NotObservable(
            range(meters),
            meters,
            f"{meters} meters cannot be told apart when {max_attacked} of them may be manipulated: "
            f"more than {2 * max_attacked} meters are needed (chong2020, Theorem 1), because two groups of "
            f"{max_attacked} manipulated meters could otherwise give two different, equally credible states",
            code="too-few-meters",
        )
    count = comb(meters, max_attacked) + comb(meters, 2 * max_attacked)
    if count > most:
        raise DesignInfeasible(
            f"exact bank for {meters} meters, {max_attacked} of them manipulated",
            f"it needs {count} observers, and at most {most} are allowed; allow fewer manipulated meters",
            code="too-many",
        )
    out_large = combinations_of(meters, max_attacked)
    out_small = combinations_of(meters, 2 * max_attacked)
    choices = combinations_of(2 * max_attacked, max_attacked)
    parent = np.stack([_rank(out_small[:, pick], meters) for pick in choices])
    pairs = np.argsort(parent, axis=None, kind="stable").reshape(out_large.shape[0], -1)
    return Subsets(meters, max_attacked, out_large, out_small, choices, parent, pairs)


def most_attacked(meters: int, works: Callable[[Ints], bool]) -> int:
    """Largest M such that every set of at least p - 2M > 0 meters suffices: the q of the papers.

    All sets are tried, the largest first, until one fails. If the criterion is observability of the pair (A,
    C_J), `index.dynamic_index(A, C).correctable` gives the same result without trials.

    meters: p, number of meters.
    works: criterion for the meters J, ascending: True if an observer exists or can be designed for them.
    Returns -1 if not even all meters suffice.
    Source: yang2019, before (3); yang2021, before (4); chong2020, Theorem 1 (ii) and Corollary 1.
    """
    everybody = np.arange(meters)
    lost = 0
    while lost < meters and all(works(np.delete(everybody, out)) for out in combinations_of(meters, lost)):
        lost += 1
    return (lost - 1) // 2


def combinations_of(n: int, k: int) -> Ints:
    """All k-element subsets of range(n), each ascending, in lexicographic order; (C(n, k), k)."""
    count = comb(n, k)
    flat = np.fromiter(chain.from_iterable(combinations(range(n), k)), dtype=np.intp, count=count * k)
    return flat.reshape(count, k)


def _rank(rows: Ints, n: int) -> Ints:
    """Position of each ascending row among `combinations_of(n, k)`; (r,).

    `C(n, k) - 1 - sum_i C(n - 1 - row_i, k - i)`: the rows after a row exceed it in the first place in which
    they differ.
    """
    k = rows.shape[1]
    after = np.zeros(rows.shape[0], dtype=np.intp)
    for i in range(k):
        table = np.array([comb(n - 1 - value, k - i) for value in range(n)], dtype=np.intp)
        after += table[rows[:, i]]
    return comb(n, k) - 1 - after
