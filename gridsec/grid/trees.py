"""Sums over the subtrees and the paths of a radial feeder, as running sums along a walk around its tree.

Bus 0 is the root, and bus `parent[k] <= k` feeds bus k + 1.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, Phasors, frozen, frozen_ints
from gridsec.errors import Problem

Values = TypeVar("Values", Floats, Phasors)


class Named(Protocol):
    """Names and per-unit bases of a feeder."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def customers(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def base_volt(self) -> float: ...  # noqa: D102
    @property
    def base_kva(self) -> float: ...  # noqa: D102
    @property
    def buses(self) -> tuple[str, ...]: ...  # noqa: D102


def base_problems(feeder: Named) -> list[Problem]:
    """Problems of the per-unit bases."""
    bases = (("base_volt", feeder.base_volt), ("base_kva", feeder.base_kva))
    return [
        Problem("not-positive", f"{what} is {value}; it must be a positive number")
        for what, value in bases
        if not (math.isfinite(value) and value > 0)
    ]


def duplicates(feeder: Named) -> list[Problem]:
    """Problems of identifiers that occur several times."""
    return [
        Problem("duplicate", f"{what} {name!r} is named {times} times")
        for what, names in (("customer", feeder.customers), ("bus", feeder.buses))
        for name, times in Counter(names).items()
        if times > 1
    ]


def at_ends(parent: Ints, charging: Floats) -> Floats:
    """Charging (b, …) of the branches, half of it at each end, by bus (b + 1, …)."""
    out: Floats = np.zeros((parent.size + 1, *charging.shape[1:]))
    np.add.at(out, parent, 0.5 * charging)
    out[1:] += 0.5 * charging
    return frozen(out)


class OnTree:
    """A feeder with the customers and the per-unit bases of a radial one, its `tree`."""

    __slots__ = ()
    tree: Named

    @property
    def name(self) -> str:
        """Name of the feeder."""
        return self.tree.name

    @property
    def customers(self) -> tuple[str, ...]:
        """Identifiers of the customers, (N,)."""
        return self.tree.customers

    @property
    def base_volt(self) -> float:
        """Nominal phase-to-neutral voltage (1 pu), V."""
        return self.tree.base_volt

    @property
    def base_kva(self) -> float:
        """Three-phase base power (1 pu), kVA."""
        return self.tree.base_kva


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A walk around a tree of b + 1 buses, children in order."""

    # start, stop (b + 1,): depth-first numbering: the subtree of bus k is the buses with `start` in
    # `[start[k], stop[k])`
    start: Ints
    stop: Ints
    order: Ints  # (b + 1,) the buses by these numbers
    depth: Ints  # (b + 1,) number of branches between bus k and the root
    # enter, leave (b + 1,): steps at which the walk reaches a bus first, and has left it
    enter: Ints
    leave: Ints
    # (b + 1, b + 1) or None: 1 where the bus of the row lies in the subtree of that of the column, else 0;
    # None for trees so large that sums along the walk cost less than a product with this matrix
    inside: Floats | None


# _DENSE: largest number of buses for sums as matrix products. _FEW: largest number of values per bus for
# them.
_DENSE, _FEW = 200, 8


def walk(parent: Ints) -> Walk:
    """Walk around a tree.

    parent (b,): bus that feeds bus k + 1, at most k.
    """
    count = parent.size + 1
    size = np.ones(count, dtype=np.intp)
    for k in range(count - 1, 0, -1):
        size[parent[k - 1]] += size[k]
    start = np.zeros(count, dtype=np.intp)
    depth = np.zeros(count, dtype=np.intp)
    free = np.ones(count, dtype=np.intp)  # next free number among the children of a bus
    for k in range(1, count):
        above = parent[k - 1]
        start[k] = free[above]
        free[above] += size[k]
        free[k] = start[k] + 1
        depth[k] = depth[above] + 1
    enter = 2 * start - depth
    stop = start + size
    inside: Floats | None = None
    if count <= _DENSE:
        inside = frozen(np.where((start <= start[:, None]) & (start[:, None] < stop), 1.0, 0.0))
    leave = enter + 2 * size - 1
    start, stop, order, depth, enter, leave = map(
        frozen_ints, (start, stop, np.argsort(start), depth, enter, leave)
    )
    return Walk(start, stop, order, depth, enter, leave, inside)


def below(tree: Walk, values: Values) -> Values:
    """Sum of bus values (…, b + 1) over the subtree of each bus, itself included; O(b)."""
    inside = _dense(tree, values)
    if inside is not None:
        return np.asarray(values @ inside)
    total = np.zeros((*values.shape[:-1], values.shape[-1] + 1), dtype=values.dtype)
    # Depth-first order makes a subtree one interval, and its sum the difference of two running sums.
    np.cumsum(values.take(tree.order, axis=-1), axis=-1, out=total[..., 1:])
    out = total.take(tree.stop, axis=-1)
    out -= total.take(tree.start, axis=-1)
    return np.asarray(out)


def from_root(tree: Walk, values: Values) -> Values:
    """Sum of branch values (…, b) over the path from the root to each bus, (…, b + 1); O(b)."""
    inside = _dense(tree, values)
    if inside is not None:
        return np.asarray(values @ inside[:, 1:].T)
    # A branch counts from the step that enters its bus to the step that leaves it.
    tour = np.zeros((*values.shape[:-1], 2 * tree.enter.size), dtype=values.dtype)
    tour[..., tree.enter[1:]] = values
    tour[..., tree.leave[1:]] = -values
    return np.asarray(np.cumsum(tour, axis=-1, out=tour).take(tree.enter, axis=-1))


def _dense(tree: Walk, values: Values) -> Floats | None:
    """Summation matrix for few real values of a small tree; None where the walk is faster."""
    inside = tree.inside
    if inside is None or values.dtype != np.float64 or values.size > _FEW * len(inside):
        return None
    return inside


def meetings(parent: Ints, tree: Walk, buses: Ints) -> Ints:
    """Bus at which the paths to the root of every bus and of each of `buses` meet; O(b k).

    buses (k,): the second bus of each pair.
    Returns (b + 1, k): the lowest bus on both paths, themselves included.
    """
    out = np.zeros((parent.size + 1, buses.size), dtype=np.intp)
    at = tree.start[buses]
    for k, above in enumerate(parent.tolist(), start=1):
        out[k] = np.where((tree.start[k] <= at) & (at < tree.stop[k]), k, out[above])
    return out


# Largest ratio of the second to the first step for which all later ones shrink by half or more.
_SHRINK = 0.2


def shrinking(first: Floats, second: Floats, axis: tuple[int, ...]) -> Bools:
    """Mask of sweeps with steps that shrink fast enough for all later ones to be at most the second.

    first, second (…): changes in the first two steps.
    axis: axes of the buses; kept, with one entry.
    """
    largest = np.max(first, axis=axis, keepdims=True)
    return np.asarray(np.max(second, axis=axis, keepdims=True) <= _SHRINK * largest)
