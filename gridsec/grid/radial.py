"""Radial feeder in per unit, its linear power flow, and the correction for losses and charging.

Everything is balanced three-phase, per phase, in per unit of the base voltage (phase to neutral) and
of the three-phase base power, so that powers in kW of all phases together divide by `base_kva`.

Source: baranwu1989 (branch equations); chong2020 (15), the linear form, with service drops as leaf edges of
the tree.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from gridsec.arrays import Floats, Ints, Phasors, all_of, any_of, frozen, frozen_ints, put
from gridsec.errors import FeederInvalid, InputInvalid, Problem, wrong_shapes
from gridsec.grid.network import (
    Balanced,
    LinDistFlow,
    Power,
    Walk,
    at_ends,
    base_problems,
    duplicates,
    shrinking,
    walk,
)


@dataclass(frozen=True, slots=True, eq=False)
class Feeder(Balanced):
    """Radial feeder: a tree of b branches and b + 1 buses, rooted at the metered busbar (bus 0).

    Raises FeederInvalid with every problem found.
    """

    name: str  # name of the feeder
    parent: Ints  # (b,) bus that feeds bus k + 1; `parent[k] <= k`, so buses are in topological order
    # r, x (b,): series resistance and reactance of the branch into bus k + 1, pu
    r: Floats
    x: Floats
    bus: Ints  # (N,) Bus of each customer. Several customers may share one; bus 0 is allowed.
    customers: tuple[str, ...]  # (N,) identifiers of the customers
    buses: tuple[str, ...]  # (b + 1,) identifiers of the buses, the busbar first
    base_volt: float  # nominal phase-to-neutral voltage (1 pu), V
    base_kva: float  # three-phase base power (1 pu), kVA
    charging: Floats  # (b,) total shunt susceptance of the branch into bus k + 1, pu; half of it at each end
    walk: Walk = field(init=False, repr=False)  # around the tree
    half: Floats = field(init=False, repr=False)  # (b + 1,) shunt susceptance at the buses, pu
    charges: bool = field(init=False, repr=False)  # True if any bus has charging
    squared: Floats = field(init=False, repr=False)  # (b,) ``r^2 + x^2``, pu
    sweep: _Sweep = field(init=False, repr=False)  # the feeder in the order of the walk

    def __post_init__(self) -> None:
        put(self, r=frozen(self.r), x=frozen(self.x), charging=frozen(self.charging))
        put(self, parent=frozen_ints(self.parent), bus=frozen_ints(self.bus))
        problems = _problems(self)
        if problems:
            raise FeederInvalid(problems)
        half = at_ends(self.parent, self.charging)
        put(self, walk=walk(self.parent), half=half, charges=any_of(half), squared=self.r**2 + self.x**2)
        put(self, sweep=_sweep(self))

    def linear(self) -> LinDistFlow:
        """Matrices of the linear power flow of a feeder.

        `R_bus[k, j] = sum of r over the branches on both paths to the busbar`, from bus k and from the bus of
        customer j.

        Source: chong2020, equation (15), for any tree.
        """
        R_bus = common_paths(self, self.r, self.bus)
        X_bus = common_paths(self, self.x, self.bus)
        return LinDistFlow(
            R=frozen(R_bus[self.bus]), X=frozen(X_bus[self.bus]), R_bus=frozen(R_bus), X_bus=frozen(X_bus)
        )

    def bus_voltages(self, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1) -> Floats:
        """Squared voltage of every bus, corrected for losses and charging; O(b), without the N x N matrices.

        p, q, v0_squared, steps: as in `loss_correction`; `steps` = 0 gives LinDistFlow.
        """
        flows = _linear_flows(self, p, q, v0_squared)
        return _lossy(self, flows, flows, steps).v2.take(self.walk.start, axis=-1)

    def loss_correction(self, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1) -> Floats:
        """Correction of the linear squared voltage of every bus for branch losses and charging.

        From the linear flows `P, Q` (towards the child, at its end of the branch) and the linear `v^2`:
        the squared current `l = (P^2 + Q^2) / v^2`, the losses `r l`, `x l`, and

            v_child^2 = v_parent^2 - 2 (r P + x Q) - (r^2 + x^2) l

        with the losses of the branches below added to `P` and `Q`. This is one step of the fixed-point
        iteration with the AC power flow of a balanced radial feeder as its limit; `steps` repeats it. O(b)
        for each operating point.

        p, q (…, N): net active and reactive injection of each customer (generation positive, droop inverters
            included), pu.
        v0_squared (…) or scalar: squared busbar voltage, pu.
        steps: number of fixed-point steps, at least 1.
        Returns (…, b + 1): additive correction of `v^2`, pu; 0 at the busbar.
        Raises ValueError if `steps` is below 1.
        Source: Baran and Wu 1989, the DistFlow equations. Derivation: docs/theory-model.md.
        """
        if steps < 1:
            raise InputInvalid([Problem("out-of-range", f"steps is {steps}; it must be at least 1")])
        flows = _linear_flows(self, p, q, v0_squared)
        return (_lossy(self, flows, flows, steps).v2 - flows.v2).take(self.walk.start, axis=-1)

    def corrected(
        self, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1
    ) -> tuple[Floats, Floats]:
        """`loss_correction` and `model_error_bound` of the same operating points, faster than separately.

        Returns (…, b + 1), (…, N): additive correction of `v^2`, and a bound on the error that remains after
            its first step, pu.
        Raises ValueError if `steps` is below 1.
        """
        if steps < 1:
            raise InputInvalid([Problem("out-of-range", f"steps is {steps}; it must be at least 1")])
        flows = _linear_flows(self, p, q, v0_squared)
        once = _lossy(self, flows, flows, 1)
        correction = _lossy(self, flows, once, steps - 1).v2 - flows.v2
        return correction.take(self.walk.start, axis=-1), _remainder(self, flows, once)

    def model_error_bound(self, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
        """Bound of the error of `v^2` after one loss correction against the AC power flow.

        Twice the size of the second fixed-point step, with magnitudes summed: the steps shrink geometrically,
        and twice the next step bounds the sum of all later ones while each is at most half its predecessor
        (in practice a few hundredths). Under heavy loads the quotients grow from step to step, so the second
        step must be below a fifth of the first. Otherwise, towards voltage collapse, the bound is infinite.

        Returns (…, N): bound on the remaining error of `v^2`, pu.
        """
        flows = _linear_flows(self, p, q, v0_squared)
        with np.errstate(all="ignore"):
            return _remainder(self, flows, _lossy(self, flows, flows, 1))

    def reach(self, p: Floats, q: Floats) -> Floats:
        """Largest change of the squared voltages by powers of given sizes: ``2 |R| p + 2 |X| q``; O(b).

        p, q (…, N): sizes of the customers' active and reactive powers, not negative, pu.
        Returns (…, b + 1): change at every bus, pu.
        """
        drop = -_drop(self.sweep, _flows(self.sweep, p, q))
        return _along_paths(self.sweep, drop).take(self.walk.start, axis=-1)

    def with_customers_at(self, places: Ints) -> Feeder:
        """See `Network`."""
        return replace(self, bus=places, customers=tuple(map(str, range(places.size))))

    @property
    def extremes_at_ends(self) -> bool:
        """See `Network`. The correction is nearly quadratic in the loads."""
        return True

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
        """See `Network`. Extremes lie where all errors have the same sign."""
        ends = np.array([0.0, -1.0, 1.0])[:, None]
        with np.errstate(all="ignore"):
            three, left = self.corrected(p + ends * p_error, q + ends * q_error, v0_squared, steps=steps)
        if not all_of(np.isfinite(three)):
            three = np.where(np.isfinite(three), three, 0.0)
        # The remainder grows with the cube of the load, so the centre does not bound the ends.
        return three[0], np.abs(three[1:] - three[0]).max(axis=0)[self.bus], left.max(axis=0)

    def columns(self, power: Power, customers: Ints) -> Floats:
        """See `Network`."""
        return 2.0 * common_paths(self, self._branch(power), self.bus[customers])

    def between(self, power: Power) -> Floats:
        """See `Network`."""
        return 0.5 * self.columns(power, np.arange(self.bus.size))[self.bus]

    def self_impedance(self, power: Power) -> Floats:
        """See `Network`."""
        return path_sums(self, self._branch(power))[self.bus]

    def covariance(self, power: Power, at: Ints, variance: Floats) -> Floats:
        """See `Network`; O(n p).

        A voltage is that of the bus above less the drop on the branch between. The drop depends on the flow,
        the sum of the powers below. So covariances with flows are summed up the tree, those with voltages
        down.
        """
        branch = self._branch(power)
        there = np.bincount(self.bus, weights=variance, minlength=len(self.buses))
        parent, double = self.parent.tolist(), (2.0 * branch).tolist()
        out: Floats = np.multiply(common_paths(self, branch, at), 2.0 * there[:, None], order="C")
        for k in range(len(parent), 0, -1):
            out[parent[k - 1]] += out[k]
        out[0] = 0.0
        for k, (above, factor) in enumerate(zip(parent, double, strict=True), 1):
            out[k] *= factor
            out[k] += out[above]
        return out

    def variances(self, power: Power, variance: Floats) -> Floats:
        """See `Network`; O(n): a power below a bus shares all of that bus's path."""
        below = np.bincount(self.bus, weights=variance, minlength=len(self.buses))
        for k in range(self.parent.size, 0, -1):
            below[self.parent[k - 1]] += below[k]
        whole = path_sums(self, self._branch(power))
        return path_sums(self, 4.0 * below[1:] * (whole[1:] ** 2 - whole[self.parent] ** 2))

    def _branch(self, power: Power) -> Floats:
        return self.r if power is Power.ACTIVE else self.x


def _problems(feeder: Feeder) -> list[Problem]:
    """Problems of the fields of `feeder`."""
    branches = feeder.parent.size
    out = wrong_shapes(
        ("parent", feeder.parent.shape, (branches,)),
        ("r", feeder.r.shape, (branches,)),
        ("x", feeder.x.shape, (branches,)),
        ("charging", feeder.charging.shape, (branches,)),
        ("buses", (len(feeder.buses),), (branches + 1,)),
        ("bus", feeder.bus.shape, (len(feeder.customers),)),
    )
    if out:
        return out
    out = base_problems(feeder)
    for k in range(branches):
        where = f"branch {k} into bus {feeder.buses[k + 1]!r}"
        if not 0 <= feeder.parent[k] <= k:
            out.append(
                Problem(
                    "not-radial", f"{where}: parent {feeder.parent[k]} does not precede it; expected 0 to {k}"
                )
            )
        out.extend(line_problems(where, feeder.r[k], feeder.x[k], feeder.charging[k]))
    for j, bus in enumerate(feeder.bus):
        if not 0 <= bus <= branches:
            out.append(
                Problem(
                    "unknown-index",
                    f"customer {feeder.customers[j]!r}: bus {bus} does not exist; expected 0 to {branches}",
                )
            )
    return out + duplicates(feeder)


def line_problems(where: str, r: float, x: float, charging: float) -> list[Problem]:
    """Problems of the impedance and the susceptance of a line, pu."""
    out = [
        Problem("negative", f"{where}: {what} is {value}; it must be finite and not negative")
        for what, value in (("r", r), ("x", x), ("charging", charging))
        if not (np.isfinite(value) and value >= 0)
    ]
    if r == 0 and x == 0:
        out.append(Problem("zero-impedance", f"{where}: r and x are both 0; fuse the two buses"))
    return out


def common_paths(feeder: Feeder, branch: Floats, buses: Ints) -> Floats:
    """Sum of a branch quantity over the common part of the paths of two buses to the busbar; O(n k).

    In depth-first order it is the minimum over consecutive buses between the two of their common sum: the sum
    up to the parent of the later bus.

    branch (b,): quantity of each branch, not negative; for example `feeder.r`.
    Returns (b + 1, k): for every bus and each of `buses`.
    """
    start, whole = feeder.walk.start, path_sums(feeder, branch)
    between = np.zeros(start.size)
    between[start[1:]] = whole[feeder.parent]
    out, count = np.empty((buses.size, start.size)), np.arange(start.size)
    together = max(1, _TOGETHER // start.size)
    for first in range(0, buses.size, together):
        some = buses[first : first + together]
        at = start[some][:, None]
        later = np.where(count > at, between, np.inf)
        later[count == at] = whole[some]
        np.minimum.accumulate(later, axis=1, out=later)
        earlier = np.where(count[1:] <= at, between[1:], np.inf)[:, ::-1]
        earlier = np.minimum.accumulate(earlier, axis=1)[:, ::-1]
        np.minimum(later[:, :-1], earlier, out=later[:, :-1])
        out[first : first + together] = later[:, start]
    return out.T


# Entries per block, chosen for the processor's cache.
_TOGETHER = 16384


def path_sums(feeder: Feeder, branch: Floats) -> Floats:
    """Sum of a branch quantity over the path from the busbar to each bus, with one rounding per branch.

    Returns (b + 1,): 0 at the busbar.
    """
    out = [0.0]
    for above, more in zip(feeder.parent.tolist(), branch.tolist(), strict=True):
        out.append(out[above] + more)
    return np.array(out)


@dataclass(frozen=True, slots=True, eq=False)
class _Sweep:
    """The feeder in the depth-first order of its walk: subtrees are intervals. N customers, b + 1 buses.

    Arrays of branches have an entry for the root, which is 0.
    """

    # z, twice (b + 1,): r + j x, and 2 (r - j x), so that the real part of its product with P + j Q is a drop
    z: Phasors
    twice: Phasors
    squared: Floats  # (b + 1,)
    half: Floats  # (b + 1,)
    order: Ints  # (N + 1,) a leading zero, then the customers in this order
    # first, last (b + 1,): the customers below each branch are those numbered from `first` to `last` - 1
    first: Ints
    last: Ints
    end: Ints  # (b + 1,) the last bus below each branch
    # steps, sign (2 b + 2,): branch of each step of the walk around the tree, -1 where the walk leaves it
    steps: Ints
    sign: Floats
    enter: Ints  # (b + 1,) step that enters each branch
    at: Ints  # (N,) number of each customer's bus


def _sweep(feeder: Feeder) -> _Sweep:
    tree, count = feeder.walk, len(feeder.buses)
    at, branch, number = tree.start[feeder.bus], tree.order[1:] - 1, np.arange(count)
    start, stop, enter, leave = (of[tree.order] for of in (tree.start, tree.stop, tree.enter, tree.leave))
    order = np.argsort(at, kind="stable")
    first, last = (np.searchsorted(at[order], end) for end in (start, stop))
    steps, sign = np.empty(2 * count, dtype=np.intp), np.ones(2 * count)
    steps[enter], steps[leave], sign[leave] = number, number, -1.0
    z, squared = np.zeros(count, dtype=np.complex128), np.zeros(count)
    z[1:], squared[1:] = feeder.r[branch] + 1j * feeder.x[branch], feeder.squared[branch]
    order = np.concatenate([[0], order + 1])
    first, last, end, steps, enter, at = map(frozen_ints, (first, last, stop - 1, steps, enter, at))
    half, squared, order = frozen(feeder.half[tree.order]), frozen(squared), frozen_ints(order)
    return _Sweep(z, 2.0 * z.conj(), squared, half, order, first, last, end, steps, frozen(sign), enter, at)


def _flows(sweep: _Sweep, p: Floats, q: Floats) -> Phasors:
    """P + j Q into each branch without losses, minus the injections (…, N) below it, (…, b + 1)."""
    both = np.zeros((*np.broadcast(p, q).shape[:-1], sweep.order.size), dtype=np.complex128)
    both.real[..., 1:], both.imag[..., 1:] = p, q
    total = both.take(sweep.order, axis=-1).cumsum(axis=-1)
    out = total.take(sweep.first, axis=-1)
    out -= total.take(sweep.last, axis=-1)
    return out


def _drop(sweep: _Sweep, flows: Phasors) -> Floats:
    """``2 (r P + x Q)`` of flows, (…, b + 1)."""
    return np.asarray((flows * sweep.twice).real)


def _along_paths(sweep: _Sweep, values: Floats) -> Floats:
    """Sums of branch values (…, b + 1) over the path from the root to each bus, (…, b + 1)."""
    walked = values.take(sweep.steps, axis=-1)
    walked *= sweep.sign
    return walked.cumsum(axis=-1).take(sweep.enter, axis=-1)


_Values = TypeVar("_Values", Floats, Phasors)


def _farther(sweep: _Sweep, values: _Values) -> _Values:
    """Sums of values (…, b + 1) below each branch, without its own, (…, b + 1)."""
    total = values.cumsum(axis=-1)
    out = total.take(sweep.end, axis=-1)
    out -= total
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _Flows:
    """Power flow in the order of the sweep, (…, b + 1) each with an entry for the root."""

    flows: Phasors  # P + j Q at the end of the branches
    charged: Floats  # Q less the supply from charging below
    v2: Floats  # squared voltages


def _linear_flows(feeder: Feeder, p: Floats, q: Floats, v0_squared: Floats | float) -> _Flows:
    """Linear power flow from the injections of the customers."""
    sweep = feeder.sweep
    flows = _flows(sweep, p, q)
    base = np.asarray(v0_squared, dtype=np.float64)[..., None]
    v2 = base - _along_paths(sweep, _drop(sweep, flows))
    charged = flows.imag
    if feeder.charges:
        supply = sweep.half * v2
        charged = charged - _farther(sweep, supply)
        charged -= supply
    return _Flows(flows, charged, v2)


def _lossy(feeder: Feeder, flows: _Flows, now: _Flows, steps: int) -> _Flows:
    """The linear power flow with the losses of the flows `now`, repeated `steps` times."""
    sweep = feeder.sweep
    for _ in range(steps):
        P = now.flows.real
        current = (P * P + now.charged * now.charged) / now.v2
        lost = _farther(sweep, sweep.z * current)
        if feeder.charges:
            if now is flows:
                lost.imag += now.charged - now.flows.imag
            else:
                supply = sweep.half * now.v2
                lost.imag -= _farther(sweep, supply) + supply
        drop = _drop(sweep, lost)
        drop += sweep.squared * current
        lost += flows.flows
        # The losses include charging.
        now = _Flows(lost, lost.imag, flows.v2 - _along_paths(sweep, drop))
    return now


def _remainder(feeder: Feeder, flows: _Flows, once: _Flows) -> Floats:
    sweep = feeder.sweep
    with np.errstate(all="ignore"):
        # Increments of the first and of the second step.
        current, charge = np.empty((2, *flows.v2.shape)), np.empty((2, *flows.v2.shape))
        np.divide(flows.flows.real**2 + flows.charged**2, flows.v2, out=current[0])
        np.subtract((once.flows.real**2 + once.flows.imag**2) / once.v2, current[0], out=current[1])
        np.abs(current, out=current)
        lost = _farther(sweep, sweep.z * current)
        if feeder.charges:
            charge[0], charge[1] = flows.v2, once.v2 - flows.v2
            supply = np.abs(sweep.half * charge)
            lost.imag += _farther(sweep, supply) + supply
        first, second = _along_paths(sweep, _drop(sweep, lost) + sweep.squared * current)
        shrinks = shrinking(first, second, (-1,))
        shrinks &= np.all((flows.v2 > 0) & (once.v2 > 0), axis=-1, keepdims=True)
        bound = np.where(shrinks, 2.0 * second, np.inf)
    return bound.take(sweep.at, axis=-1)
