"""Network model of estimators, uniform for radial, meshed and three-phase feeders, and sums over trees.

A *place* has one squared voltage: a bus of a balanced feeder, a phase of a bus of another. The linear power
flow is ``v^2 = v0^2 + 2 R p + 2 X q`` with rows for places and columns for customers. On a balanced radial
feeder its entries are those of common paths, and all results are sums over the tree. On a meshed feeder it
is still symmetric between customers, but may have negative entries. In three phases, meshed or not, it is
not symmetric either.

`Network` is the interface. `Balanced`, and `gridsec.grid.phased.InPhases`, have the methods that depend on
the number of busbar voltages only, `OfMatrices` those of feeders with matrices R and X. N customers, n
places, b busbar voltages.

Sums over the subtrees and the paths of a radial feeder are running sums along a walk around its tree. Bus 0
is the root, and bus `parent[k] <= k` feeds bus k + 1.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, TypeVar

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, Phasors, frozen, frozen_ints
from gridsec.errors import Problem


class Power(StrEnum):
    """Power that changes a voltage: active through resistances, reactive through reactances."""

    ACTIVE = "p"
    REACTIVE = "q"


@dataclass(frozen=True, slots=True, eq=False)
class LinDistFlow:
    """The linear power flow `v^2 = v0^2 + 2 R p + 2 X q` of one feeder."""

    # R, X (N, N): resistance and reactance common to the paths of two customers to the busbar, pu
    R: Floats
    X: Floats
    # R_bus, X_bus (n, N): the same for a place and a customer
    R_bus: Floats
    X_bus: Floats


class Network(Protocol):
    """Feeder of an estimator."""

    @property
    def name(self) -> str:
        """Name of the feeder."""

    @property
    def customers(self) -> tuple[str, ...]:
        """Identifiers of the customers, (N,)."""

    @property
    def buses(self) -> tuple[str, ...]:
        """Identifiers of the places, those of the busbar first, (n,)."""

    @property
    def bus(self) -> Ints:
        """Place of each customer, (N,)."""

    @property
    def base_volt(self) -> float:
        """Nominal phase-to-neutral voltage (1 pu), V."""

    @property
    def base_kva(self) -> float:
        """Three-phase base power (1 pu), kVA."""

    @property
    def busbar_phases(self) -> int:
        """Number b of busbar voltages: 1, or 3 in three phases."""

    @property
    def extremes_at_ends(self) -> bool:
        """The loss correction is extreme where all powers are at the same end of their intervals."""

    @property
    def customer_bus(self) -> Ints:
        """Bus of each customer, for any phase, (N,)."""

    def busbar_places(self) -> slice:
        """Places of the busbar."""

    def places(self, buses: Ints) -> Ints:
        """Places of some buses, ascending: in three phases those of their phases."""

    def with_customers_at(self, places: Ints) -> Network:
        """The feeder with one customer at each of these places."""

    def same_busbar_phase(self, some: Ints, others: Ints) -> Floats | float:
        """1 for places with the same busbar voltage, else 0; (j, k), or 1 for all."""

    def busbar_incidence(self) -> Floats:
        """1 where a customer is connected to a phase of the busbar, else 0; (N, b)."""

    def broadcast_busbar(self, of_busbar: Floats | float) -> Floats:
        """Busbar value (one number, or in three phases one for each) repeated for every place, (n,)."""

    def bus_voltages(self, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1) -> Floats:
        """Squared voltage of every place, corrected for losses; O(n), on a meshed feeder O(n N).

        p, q (…, N): net active and reactive injection of each customer (generation positive), pu.
        v0_squared: squared busbar voltage, pu; in three phases scalar or (3,).
        steps: corrections of the linear power flow; 0 gives the linear one.
        Returns (…, n): squared voltages, pu.
        """

    def loss_correction(self, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1) -> Floats:
        """Correction of the linear power flow at every place after at least 1 step, (…, n)."""

    def model_error_bound(self, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
        """Bound (…, N) of the error of `v^2` after one correction against the AC power flow, by customer."""

    def correction_bounds(
        self,
        p: Floats,
        q: Floats,
        v0_squared: Floats | float,
        *,
        p_error: Floats,
        q_error: Floats,
        steps: int,
    ) -> tuple[Floats, Floats, Floats]:
        """`loss_correction` of one operating point, and its errors for powers within intervals.

        p, q, v0_squared: as in `bus_voltages`.
        p_error, q_error (N,): largest errors of the powers, pu.
        Returns (n,), (N,), (N,): correction at every place, its change within the intervals, and the distance
            of its first step from the AC power flow, pu; not finite without a bound, as for an invalid busbar
            voltage.
        """

    def reach(self, p: Floats, q: Floats) -> Floats:
        """Largest change of squared voltages by powers of sizes p, q (N,): ``2 |R| p + 2 |X| q``, (n,)."""

    def linear(self) -> LinDistFlow:
        """Matrices of the linear power flow."""

    def columns(self, power: Power, customers: Ints) -> Floats:
        """Sensitivity of every place's squared voltage to the powers of k customers, (n, k).

        Columns of 2 R or 2 X.
        """

    def between(self, power: Power) -> Floats:
        """R or X from every customer's power to every customer's voltage, (N, N)."""

    def self_impedance(self, power: Power) -> Floats:
        """Half the sensitivity of a customer's voltage to its own power: the diagonal of R or X, (N,)."""

    def covariance(self, power: Power, at: Ints, variance: Floats) -> Floats:
        """Columns `at` (p,) of ``4 R V R^T``, or of ``4 X V X^T``, for diagonal V (N,), (n, p)."""

    def variances(self, power: Power, variance: Floats) -> Floats:
        """Diagonal of ``4 R V R^T``, or of ``4 X V X^T``, for diagonal V (N,), (n,)."""


class Balanced:
    """Methods of feeders with one busbar voltage."""

    __slots__ = ()

    @property
    def busbar_phases(self) -> int:
        """See `Network`."""
        return 1

    @property
    def customer_bus(self: Network) -> Ints:
        """See `Network`."""
        return self.bus

    def busbar_places(self) -> slice:
        """See `Network`."""
        return slice(0, 1)

    def places(self, buses: Ints) -> Ints:
        """See `Network`."""
        return buses

    def same_busbar_phase(self, some: Ints, others: Ints) -> float:  # noqa: ARG002  # all places have it
        """See `Network`."""
        return 1.0

    def busbar_incidence(self: Network) -> Floats:
        """See `Network`."""
        return np.ones((self.bus.size, 1))

    def broadcast_busbar(self: Network, of_busbar: Floats | float) -> Floats:
        """See `Network`."""
        return np.full(len(self.buses), of_busbar)


class WithMatrices(Network, Protocol):
    """Network with the matrices of the linear power flow, (n, N), pu, and bounds by intervals."""

    @property
    def R(self) -> Floats: ...  # noqa: D102, N802
    @property
    def X(self) -> Floats: ...  # noqa: D102, N802

    def interval_bounds(
        self, p: Floats, q: Floats, v0_squared: Floats | float, *, p_error: Floats, q_error: Floats
    ) -> tuple[Floats, Floats]:
        """Error bounds of the loss correction for powers within intervals.

        p, q: as in `bus_voltages`, one operating point.
        p_error, q_error (N,): largest errors of the powers, pu.
        Returns (N,), (N,): change of the correction, and distance of its first step from the AC power flow,
            pu; infinite without a bound.
        """


class OfMatrices:
    """Methods of feeders with matrices R and X: meshed, or in three phases."""

    __slots__ = ()

    @property
    def extremes_at_ends(self) -> bool:
        """See `Network`. Loads on other phases, or around a loop, may raise as well as lower voltages."""
        return False

    def loss_correction(
        self: WithMatrices, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1
    ) -> Floats:
        """See `Network`."""
        found = self.bus_voltages(p, q, v0_squared, steps=steps)
        return found - self.bus_voltages(p, q, v0_squared, steps=0)

    def correction_bounds(
        self: WithMatrices,
        p: Floats,
        q: Floats,
        v0_squared: Floats | float,
        *,
        p_error: Floats,
        q_error: Floats,
        steps: int,
    ) -> tuple[Floats, Floats, Floats]:
        """See `Network`; by `gridsec.grid.intervals.bounds`."""
        with np.errstate(all="ignore"):
            correction = self.loss_correction(p, q, v0_squared, steps=steps)
        moved, rest = self.interval_bounds(p, q, v0_squared, p_error=p_error, q_error=q_error)
        return correction, moved + 2.0 * rest if steps > 1 else moved, rest

    def reach(self: WithMatrices, p: Floats, q: Floats) -> Floats:
        """See `Network`."""
        return np.asarray(2.0 * (np.abs(self.R) @ p + np.abs(self.X) @ q))

    def linear(self: WithMatrices) -> LinDistFlow:
        """See `Network`."""
        return LinDistFlow(frozen(self.R[self.bus]), frozen(self.X[self.bus]), self.R, self.X)

    def columns(self: WithMatrices, power: Power, customers: Ints) -> Floats:
        """See `Network`."""
        return 2.0 * _matrix(self, power)[:, customers]

    def between(self: WithMatrices, power: Power) -> Floats:
        """See `Network`."""
        return _matrix(self, power)[self.bus]

    def self_impedance(self: WithMatrices, power: Power) -> Floats:
        """See `Network`."""
        return np.asarray(_matrix(self, power)[self.bus, np.arange(self.bus.size)])

    def covariance(self: WithMatrices, power: Power, at: Ints, variance: Floats) -> Floats:
        """See `Network`."""
        matrix = _matrix(self, power)
        return np.asarray(4.0 * (matrix @ (variance * matrix[at]).T))

    def variances(self: WithMatrices, power: Power, variance: Floats) -> Floats:
        """See `Network`."""
        return np.asarray(4.0 * (_matrix(self, power) ** 2 @ variance))


def _matrix(feeder: WithMatrices, power: Power) -> Floats:
    return feeder.R if power is Power.ACTIVE else feeder.X


def unbounded(bound: Floats) -> Floats:
    """A bound with infinity in place of NaN."""
    return np.where(np.isnan(bound), np.inf, bound)


_KEPT = 1 << 19
"""Largest number of entries of 2R and 2X that are kept, 4 MB."""


_BLOCK = 256
"""Columns computed at once where they are not kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivities:
    """Changes of the squared voltages per power. N customers, n places.

    Powers have numbers: active ones first, customer by customer, then reactive ones.
    """

    feeder: Network  # the feeder
    table: Floats | None = field(
        init=False, repr=False
    )  # derived: [2R, 2X], (n, 2 N), on small feeders; else None

    def __post_init__(self) -> None:
        table, every = None, np.arange(self.feeder.bus.size)
        if 2 * len(self.feeder.buses) * every.size <= _KEPT:
            table = frozen(np.hstack([self.feeder.columns(power, every) for power in Power]))
        object.__setattr__(self, "table", table)

    def columns(self, power: Power, customers: Ints) -> Floats:
        """Changes at every place by one power of customers (k,), (n, k)."""
        if self.table is None:
            return self.feeder.columns(power, customers)
        return self.table.take(customers + self.feeder.bus.size * (power is Power.REACTIVE), axis=1)

    def numbered(self, which: Ints) -> Floats:
        """Changes at every place by powers with numbers `which` (k,), (n, k)."""
        if self.table is not None:
            return self.table.take(which, axis=1)
        count, out = self.feeder.bus.size, np.empty((len(self.feeder.buses), which.size))
        for power, some in ((Power.ACTIVE, which < count), (Power.REACTIVE, which >= count)):
            out[:, some] = self.feeder.columns(power, which[some] % count)
        return out

    def rows(self, places: Ints) -> Iterator[Floats]:
        """Changes at places (k,) by all powers in the order of their numbers, in parts (k, …)."""
        if self.table is not None:
            yield self.table[places]
            return
        every = np.arange(self.feeder.bus.size)
        for power in Power:
            for first in range(0, every.size, _BLOCK):
                yield self.feeder.columns(power, every[first : first + _BLOCK])[places]


# --- Sums over the tree of a radial feeder ---


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
