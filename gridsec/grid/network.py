"""Network model of estimators, uniform for radial, meshed and three-phase feeders.

A *place* has one squared voltage: a bus of a balanced feeder, a phase of a bus of another. The linear power
flow is ``v^2 = v0^2 + 2 R p + 2 X q`` with rows for places and columns for customers. On a balanced radial
feeder its entries are those of common paths, and all results are sums over the tree. On a meshed feeder it
is still symmetric between customers, but may have negative entries. In three phases, meshed or not, it is
not symmetric either.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.grid import meshed, phased
from gridsec.grid import radial as balanced
from gridsec.grid.meshed import Meshed, PhasedMesh
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder, LinDistFlow, common_paths, lindistflow, path_sums

InPhases = PhasedFeeder | PhasedMesh
"""A feeder in three phases, with three voltages of the busbar."""

Network = Feeder | Meshed | InPhases
"""A feeder supported by the estimators."""


class Power(StrEnum):
    """Power that changes a voltage: active through resistances, reactive through reactances."""

    ACTIVE = "p"
    REACTIVE = "q"


def busbar_places(feeder: Network) -> slice:
    """Places of the busbar: one, or one for each phase."""
    return slice(0, 3 if isinstance(feeder, InPhases) else 1)


def one_busbar(feeder: Network, some: Ints, others: Ints) -> Floats | float:
    """1 for places with the same busbar voltage, else 0; (j, k), or 1 for all."""
    if not isinstance(feeder, InPhases):
        return 1.0
    return np.equal.outer(some % 3, others % 3).astype(np.float64)


def hangs_on(feeder: Network) -> Floats:
    """1 where a customer is connected to a phase of the busbar, else 0; (N, 3), or (N, 1) when balanced."""
    if not isinstance(feeder, InPhases):
        return np.ones((feeder.bus.size, 1))
    return np.equal.outer(feeder.bus % 3, np.arange(3)).astype(np.float64)


def by_place(feeder: Network, of_busbar: Floats | float) -> Floats:
    """Busbar value (one number, or in three phases one for each) repeated for every place, (n,)."""
    if not isinstance(feeder, InPhases):
        return np.full(len(feeder.buses), of_busbar)
    return np.tile(np.broadcast_to(np.asarray(of_busbar, dtype=np.float64), 3), len(feeder.tree.buses))


def over_places(feeder: Network, of_busbar: Floats | float) -> Floats | float:
    """As `by_place`, but one number where all places have the same."""
    return by_place(feeder, of_busbar) if isinstance(feeder, InPhases) else of_busbar


def bus_voltages(
    feeder: Network, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1
) -> Floats:
    """Squared voltage of every place, corrected for losses; O(n), on a meshed feeder O(n N).

    Parameters
    ----------
    p, q : (…, N)
        Net active and reactive injection of each customer (generation positive), pu.
    v0_squared
        Squared busbar voltage, pu; in three phases scalar or (3,).
    steps
        Corrections of the linear power flow; 0 gives the linear one.

    Returns
    -------
    (…, n)
        Squared voltages, pu.
    """
    if isinstance(feeder, Feeder):
        return balanced.bus_voltages(feeder, p, q, v0_squared, steps=steps)
    if isinstance(feeder, Meshed):
        return meshed.bus_voltages(feeder, p, q, v0_squared, steps=steps)
    return phased.bus_voltages(feeder, p, q, v0_squared, steps=steps)


def model_error_bound(feeder: Network, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Bound (…, N) of the error of `v^2` after one correction against the AC power flow, by customer."""
    if isinstance(feeder, Feeder):
        return balanced.model_error_bound(feeder, p, q, v0_squared)
    if isinstance(feeder, Meshed):
        return meshed.model_error_bound(feeder, p, q, v0_squared)
    return phased.model_error_bound(feeder, p, q, v0_squared)


def reach(feeder: Network, p: Floats, q: Floats) -> Floats:
    """Largest change of the squared voltages by powers of given sizes: ``2 |R| p + 2 |X| q``, (n,).

    Parameters
    ----------
    p, q : (N,)
        Sizes of the customers' active and reactive powers, not negative, pu.
    """
    if isinstance(feeder, Feeder):
        return balanced.reach(feeder, p, q)
    return np.asarray(2.0 * (np.abs(feeder.R) @ p + np.abs(feeder.X) @ q))


def linear(feeder: Network) -> LinDistFlow:
    """Matrices of the linear power flow, rows for places in `R_bus` and `X_bus`."""
    if isinstance(feeder, Feeder):
        return lindistflow(feeder)
    return LinDistFlow(frozen(feeder.R[feeder.bus]), frozen(feeder.X[feeder.bus]), feeder.R, feeder.X)


def loss_correction(
    feeder: Network, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int
) -> Floats:
    """Correction of the linear power flow at every place, (…, n).

    Parameters
    ----------
    feeder, p, q, v0_squared
        As in `bus_voltages`.
    steps
        Corrections, at least 1.
    """
    if isinstance(feeder, Feeder):
        return balanced.loss_correction(feeder, p, q, v0_squared, steps=steps)
    found = bus_voltages(feeder, p, q, v0_squared, steps=steps)
    return found - bus_voltages(feeder, p, q, v0_squared, steps=0)


def interval_bounds(
    feeder: Meshed | PhasedFeeder,
    p: Floats,
    q: Floats,
    v0_squared: Floats | float,
    *,
    p_error: Floats,
    q_error: Floats,
) -> tuple[Floats, Floats]:
    """Error bounds of `loss_correction` for powers within intervals, see `gridsec.grid.intervals`.

    Parameters
    ----------
    feeder, p, q : (N,)
        As in `bus_voltages`, one operating point.
    v0_squared
        As in `bus_voltages`.
    p_error, q_error : (N,)
        Largest errors of the powers, pu.

    Returns
    -------
    (N,), (N,)
        Change of the correction, and distance of its first step from the AC power flow, pu; infinite without
        a bound, as for an invalid busbar voltage.
    """
    with np.errstate(all="ignore"):  # NaN gets an infinite bound without a warning
        if isinstance(feeder, Meshed):
            moved, rest = meshed.interval_bounds(feeder, p, q, v0_squared, p_error=p_error, q_error=q_error)
        else:
            moved, rest = phased.interval_bounds(feeder, p, q, v0_squared, p_error=p_error, q_error=q_error)
    return np.where(np.isnan(moved), np.inf, moved), np.where(np.isnan(rest), np.inf, rest)


def columns(feeder: Network, power: Power, customers: Ints) -> Floats:
    """Sensitivity of every place's squared voltage to the powers of k customers: columns of 2 R or 2 X.

    Shape (n, k).
    """
    if isinstance(feeder, Feeder):
        return 2.0 * common_paths(feeder, _branch(feeder, power), feeder.bus[customers])
    return 2.0 * _matrix(feeder, power)[:, customers]


def between(feeder: Network, power: Power) -> Floats:
    """R or X from every customer's power to every customer's voltage, (N, N)."""
    return 0.5 * columns(feeder, power, np.arange(feeder.bus.size))[feeder.bus]


def along(feeder: Network, power: Power, customers: Ints, weights: Floats) -> Floats:
    """Sensitivity of a weighted sum of p different customers' voltages to every customer's power, (N,)."""
    if not isinstance(feeder, Feeder):
        return 2.0 * (weights @ _matrix(feeder, power)[feeder.bus[customers]])
    # R and X are symmetric on a radial feeder.
    injected = np.zeros((2, feeder.bus.size))
    injected[0, customers] = weights
    p, q = injected if power is Power.ACTIVE else injected[::-1]
    return np.asarray(balanced.bus_voltages(feeder, p, q, 0.0, steps=0)[feeder.bus])


def sizes(feeder: Network, power: Power, customers: Ints) -> Floats:
    """Sum over the voltages at `customers` (p,) of squared sensitivities to each customer's power, (N,)."""
    if not isinstance(feeder, Feeder):
        return np.asarray(4.0 * (_matrix(feeder, power)[feeder.bus[customers]] ** 2).sum(axis=0))
    weight = np.zeros(feeder.bus.size)
    weight[customers] = 1.0
    return variances(feeder, power, weight)[feeder.bus]


def own(feeder: Network, power: Power) -> Floats:
    """Sensitivity of a customer's voltage to its own power: the diagonal of R or X, (N,)."""
    if isinstance(feeder, Feeder):
        return path_sums(feeder, _branch(feeder, power))[feeder.bus]
    return np.asarray(_matrix(feeder, power)[feeder.bus, np.arange(feeder.bus.size)])


def covariance(feeder: Network, power: Power, at: Ints, variance: Floats) -> Floats:
    """Columns `at` of ``4 R V R^T``, or of ``4 X V X^T``, for diagonal V, (n, p).

    On a balanced radial feeder O(n p): a voltage is that of the bus above less the drop on the branch
    between. The drop depends on the flow, the sum of the powers below. So covariances with flows are summed
    up the tree, those with voltages down.

    Parameters
    ----------
    at : (p,)
        Places.
    variance : (N,)
        Diagonal of V.
    """
    if not isinstance(feeder, Feeder):
        matrix = _matrix(feeder, power)
        return np.asarray(4.0 * (matrix @ (variance * matrix[at]).T))
    branch = _branch(feeder, power)
    there = np.bincount(feeder.bus, weights=variance, minlength=len(feeder.buses))
    parent, double = feeder.parent.tolist(), (2.0 * branch).tolist()
    out: Floats = np.multiply(common_paths(feeder, branch, at), 2.0 * there[:, None], order="C")
    for k in range(len(parent), 0, -1):
        out[parent[k - 1]] += out[k]
    out[0] = 0.0
    for k, (above, factor) in enumerate(zip(parent, double, strict=True), 1):
        out[k] *= factor
        out[k] += out[above]
    return out


def variances(feeder: Network, power: Power, variance: Floats) -> Floats:
    """Diagonal of ``4 R V R^T``, or of ``4 X V X^T``, for diagonal V (N,), (n,).

    On a balanced radial feeder O(n): a power below a bus shares all of that bus's path.
    """
    if not isinstance(feeder, Feeder):
        return np.asarray(4.0 * (_matrix(feeder, power) ** 2 @ variance))
    below = np.bincount(feeder.bus, weights=variance, minlength=len(feeder.buses))
    for k in range(feeder.parent.size, 0, -1):
        below[feeder.parent[k - 1]] += below[k]
    branch = _branch(feeder, power)
    whole = path_sums(feeder, branch)
    return path_sums(feeder, 4.0 * below[1:] * (whole[1:] ** 2 - whole[feeder.parent] ** 2))


def _branch(feeder: Feeder, power: Power) -> Floats:
    return feeder.r if power is Power.ACTIVE else feeder.x


def _matrix(feeder: Meshed | PhasedFeeder, power: Power) -> Floats:
    return feeder.R if power is Power.ACTIVE else feeder.X
