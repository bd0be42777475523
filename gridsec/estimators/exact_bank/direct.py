"""Direct-injection observers of all sensor subsets at once: storage, time steps, equilibria.

The observer of the set J of trusted meters is `tau_i x_i' = -x_i + K_i(zeta_i)`, with zeta_i the
reading of the inverter's own meter if that meter is in J, and `z_i = H_i x + F_i u` otherwise. An
inverter with a trusted meter therefore moves the same way in *every* observer that trusts the meter: one
common `driven` trajectory serves all of them. Observer J is described by its *slots*, the few inverters
with an omitted meter or without a meter:

    z_i^J = z_i + sum over slots k of H_ik (x_k^J - s_k),     z = H s + F u,

where s is the driven trajectory. One step of n observers with k slots each costs O(n k^2) instead of
O(n m^2). docs/theory-detection.md proves the identity.

Metered net reactive power modifies this: while the customer's meter is trusted, s_k is the metered value
minus the assumed load in place of the observer's x_k. A customer without an inverter, but with a meter that
reports reactive power, gets a slot with state zero for that correction alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import InputInvalid, Problem
from gridsec.grid.devices import Droop
from gridsec.observers.lure import Lure, LureTransition, StepPolicy, transition, unit
from gridsec.secure.subsets import Subsets

# Size limit of stored feedback blocks, bytes; larger ones are replaced by a dense product.
_BLOCK_BYTES = 64 << 20
_KEPT_PLANS = 4


@dataclass(frozen=True, slots=True, eq=False)
class SlotLayout:
    """Units of the slots: inverters 0 … n-1, then meters without an inverter; e units in all.

    Index e is the padding: row, column and state are zero.
    """

    lure: Lure  # the plant
    droop: Droop  # its nonlinearity
    of_meter: Ints  # (p, r) units behind each meter, padded with e
    free: Ints  # (f,) inverters without a meter
    driver: Ints  # (n,) meter of each inverter; 0 where there is none (see `metered`)
    metered: Bools  # (n,) True where the inverter has a meter
    H: Floats  # (e + 1, e + 1) effect of each unit's injection on z at each inverter
    rows: Ints  # (e + 1,) inverter of each unit's curve; 0 for units without a curve
    real: Bools  # (e + 1,) True where the unit is an inverter

    @property
    def units(self) -> int:
        """e, the number of units without the padding."""
        return int(self.rows.size - 1)


def layout(lure: Lure, reactive: Floats | None) -> SlotLayout:
    """Assign meters to the inverters that they drive.

    A meter is at an inverter's customer exactly if its output is that inverter's:
    `(C_j, D_j) = (H_i, F_i)`.

    lure: a plant made by `close_loop`: `A = -T^-1`, `G = T^-1`, `B = 0`, phi a Droop.
    reactive (l, p): change of u per pu of reactive injection at each meter's customer. Needed where net
        reactive power may be metered at customers without an inverter.
    Raises TypeError, ValueError if the plant is not of that form.
    """
    droop = lure.phi
    if not isinstance(droop, Droop):
        raise TypeError("direct injection needs a plant with a Droop as nonlinearity; see close_loop")
    rate = 1.0 / droop.tau
    if not (
        np.allclose(lure.A, -np.diag(rate), rtol=1e-12, atol=0.0)
        and np.allclose(lure.G, np.diag(rate), rtol=1e-12, atol=0.0)
        and not lure.B.any()
    ):
        raise InputInvalid(
            [Problem("wrong-form", "direct injection needs A = -T^-1, G = T^-1 and B = 0; see close_loop")]
        )
    n, p = lure.A.shape[0], lure.C.shape[0]
    own, seen_by = np.hstack([lure.H, lure.F]), np.hstack([lure.C, lure.D])
    same = (own[:, None, :] == seen_by[None, :, :]).all(axis=-1).reshape(n, p)
    metered = same.any(axis=1)
    driver = same.argmax(axis=1) if p else np.zeros(n, dtype=np.intp)
    behind = [np.flatnonzero(metered & (driver == j)).tolist() for j in range(p)]
    extra = [j for j in range(p) if not behind[j]] if reactive is not None else []
    for number, j in enumerate(extra):
        behind[j] = [n + number]
    e = n + len(extra)
    width = max((len(units) for units in behind), default=0)
    of_meter = np.full((p, width), e, dtype=np.intp)
    for j, units in enumerate(behind):
        of_meter[j, : len(units)] = units
    H = np.zeros((e + 1, e + 1))
    H[:n, :n] = lure.H
    if reactive is not None and extra:
        H[:n, n:e] = lure.F @ reactive[:, extra]
    real = np.arange(e + 1) < n
    return SlotLayout(
        lure=lure,
        droop=droop,
        of_meter=of_meter,
        free=np.flatnonzero(~metered),
        driver=driver,
        metered=metered,
        H=H,
        rows=np.where(real, np.arange(e + 1), 0),
        real=real,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SlotBlock:
    """Slots of one bank. n observers, k slots each."""

    units: Ints  # (k, n) unit of each slot
    rows: Ints  # (k, n) inverter of its curve
    real: Bools | None  # (k, n) or None: True where the slot is an inverter; None if all are
    H: Floats | None  # (k, k, n) or None: feedback between the slots; None if above `_BLOCK_BYTES`


@dataclass(frozen=True, slots=True, eq=False)
class AvailabilityIndex:
    """Index arrays for one pattern of available meters."""

    seen: Bools  # (p,) the available meters
    driven: Bools  # (n,) inverters driven by an available meter
    trailing: Ints  # (t,) units that no observer can drive, for lack of an available meter
    # large, small: the two banks
    large: SlotBlock
    small: SlotBlock
    # for each choice of `Subsets.choices`: the slots of P that S drives; the slots to look up in S; and their
    # positions in a table (number of S, e + 1), flattened
    compare: tuple[tuple[Ints, Ints, Ints], ...]


def make_plan(lay: SlotLayout, sets: Subsets, seen: Bools) -> AvailabilityIndex:
    """Index arrays for one pattern of available meters, `seen` (p,)."""
    silent = lay.of_meter[~seen]
    quiet = silent[silent < lay.units]
    trailing = np.concatenate([lay.free, quiet]).astype(np.intp)
    # Meter behind a trailing unit; -1 for none. An unavailable meter that an observer leaves out anyway
    # already has its slot there, and must not get a second one.
    of_unit = np.full(lay.units + 1, -1, dtype=np.intp)
    meters, _ = np.nonzero(lay.of_meter < lay.units)
    of_unit[lay.of_meter[lay.of_meter < lay.units]] = meters
    meter = of_unit[trailing]
    large = _block(lay, _slots(lay, sets.out_large, trailing, meter))
    small = _block(lay, _slots(lay, sets.out_small, trailing, meter))
    return AvailabilityIndex(
        seen=seen.copy(),
        driven=lay.metered & seen[lay.driver] if seen.size else lay.metered,
        trailing=trailing,
        large=large,
        small=small,
        compare=_comparisons(lay, sets, small.units, all_slots=not bool(seen.all())),
    )


def _slots(lay: SlotLayout, out: Ints, trailing: Ints, meter: Ints) -> Ints:
    """Units (k, n) in the slots of observers that leave out the meters `out` (n, s)."""
    count = out.shape[0]
    own = lay.of_meter[out].reshape(count, -1).T
    rest = np.repeat(trailing[:, None], count, axis=1)
    for place, j in enumerate(meter):
        if j >= 0:
            rest[place, (out == j).any(axis=1)] = lay.units
    return np.ascontiguousarray(np.concatenate([own, rest]))


def _block(lay: SlotLayout, units: Ints) -> SlotBlock:
    k, n = units.shape
    real = lay.real[units]
    H = lay.H[units[:, None, :], units[None, :, :]] if 8 * k * k * n <= _BLOCK_BYTES else None
    return SlotBlock(units, lay.rows[units], None if real.all() else real, H)


def _comparisons(
    lay: SlotLayout, sets: Subsets, units: Ints, *, all_slots: bool
) -> tuple[tuple[Ints, Ints, Ints], ...]:
    """Lookups of equation (6) for each choice of the meters that S leaves out as well."""
    width = lay.of_meter.shape[1]
    places = 2 * sets.max_attacked
    last = np.arange(places * width, units.shape[0])
    out = []
    for pick, parent in zip(sets.choices, sets.parent, strict=True):
        # S has the driven value for a slot with a meter that it trusts, unless that meter is unavailable.
        chosen = np.zeros(places, dtype=np.bool_)
        chosen[pick] = True
        mine = np.repeat(chosen, width)
        if all_slots:
            mine[:] = True
        look = np.concatenate([np.flatnonzero(mine), last])
        table = parent * (lay.units + 1) + units[look]
        out.append((np.flatnonzero(~mine), look, table))
    return tuple(out)


@dataclass(frozen=True, slots=True, eq=False)
class SlotState:
    """State of all observers at one time."""

    driven: Floats  # (e + 1,) the observer that trusts every available meter; padded
    # large, small (k, n): the slots of the two banks; empty while too few meters are available
    large: Floats
    small: Floats
    # index arrays of the current pattern of available meters; None while there are too few
    plan: AvailabilityIndex | None
    plans: tuple[AvailabilityIndex, ...]  # plans of the latest patterns, newest first
    seen: Bools  # (p,) the current pattern
    prepared: LureTransition  # coefficients of the last step's length


def start(lay: SlotLayout, sets: Subsets, base: AvailabilityIndex, policy: StepPolicy) -> SlotState:
    """All observers at zero injection with all meters available, for the plan `base` of all meters."""
    return SlotState(
        driven=np.zeros(lay.units + 1),
        large=np.zeros(base.large.units.shape),
        small=np.zeros(base.small.units.shape),
        plan=base,
        plans=(base,),
        seen=np.ones(sets.meters, dtype=np.bool_),
        prepared=transition(lay.lure, 0.0, policy),
    )


def follow(lay: SlotLayout, sets: Subsets, state: SlotState, seen: Bools, adopt: Floats | None) -> SlotState:
    """The same observers under another pattern of available meters.

    A meter that becomes unavailable frees its inverter in every observer, from its last value. A meter that
    returns drives its inverter again, from `adopt` in all observers at once. With 2M or fewer available
    meters only the driven observer continues, on the model alone.

    adopt (n,): initial injections of inverters with a returning meter; by default those of the driven
        observer.
    """
    if np.array_equal(seen, state.seen):
        return state
    driven = state.driven.copy()
    if adopt is not None:
        back = lay.metered & seen[lay.driver] & ~state.seen[lay.driver]
        driven[: back.size][back] = adopt[back]
    if np.count_nonzero(seen) <= 2 * sets.max_attacked:
        none = np.zeros((0, 0))
        return replace(state, driven=driven, large=none, small=none, plan=None, seen=seen.copy())
    plan = next((known for known in state.plans if np.array_equal(known.seen, seen)), None)
    if plan is None:
        plan = make_plan(lay, sets, seen)
    others = tuple(known for known in state.plans if known is not plan)
    return SlotState(
        driven=driven,
        large=_carry(state.plan, plan, plan.large, state.large, driven),
        small=_carry(state.plan, plan, plan.small, state.small, driven),
        plan=plan,
        plans=(plan, *others[: _KEPT_PLANS - 1]),
        seen=seen.copy(),
        prepared=state.prepared,
    )


def _carry(
    before: AvailabilityIndex | None, after: AvailabilityIndex, block: SlotBlock, x: Floats, driven: Floats
) -> Floats:
    """Slots of `x` under the plan `before`, in the order of `block` of the plan `after`."""
    fresh = np.asarray(driven[block.units])
    if before is None:
        return fresh
    own = block.units.shape[0] - after.trailing.size
    fresh[:own] = x[:own]
    for place, trailing in enumerate(after.trailing):
        was = np.flatnonzero(before.trailing == trailing)
        if was.size:
            fresh[own + place] = x[own + was[0]]
    return fresh


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Prepared inputs of one step, without NaN."""

    base: Floats  # (e + 1,) F u at each inverter
    reading: Floats  # (n,) reading of each inverter's meter as z; 0 without an available meter
    driven: Bools  # (n,) True where an available meter drives the inverter
    net_unit: Ints  # (c,) first unit of each available meter with reported net reactive power
    net: Floats  # (c,) its metered net reactive injection minus the assumed load
    net_rest: Ints  # (c, r - 1) the other units behind these meters

    def reference(self, driven: Floats) -> Floats:
        """s, the injections in an observer that trusts every available meter; (e + 1,)."""
        if not self.net_unit.size:
            return driven
        s = driven.copy()
        s[self.net_unit] = self.net - driven[self.net_rest].sum(axis=1)
        return s


def drive(lay: SlotLayout, y: Floats, u: Floats, seen: Bools, net: Floats | None) -> Drive:
    """Prepare the inputs of a step.

    y (p,): readings as z; arbitrary where not seen.
    u (l,): known input.
    net (p,): metered net reactive injection minus the assumed load; NaN where not reported.
    """
    n = lay.driver.size
    base = np.zeros(lay.units + 1)
    base[:n] = lay.lure.F @ u
    driven = lay.metered & seen[lay.driver] if seen.size else lay.metered
    clean = np.where(seen, y, 0.0)
    reading = np.where(driven, clean[lay.driver], 0.0) if seen.size else np.zeros(n)
    units = lay.of_meter
    told = np.zeros(0, dtype=np.intp)
    if net is not None and units.shape[1]:
        told = np.flatnonzero(seen & np.isfinite(net) & (units[:, 0] < lay.units))
    values = net[told] if net is not None else np.zeros(0)
    if not told.size:
        units = np.zeros((seen.size, 1), dtype=np.intp)
    return Drive(base, reading, driven, units[told, 0], values, units[told, 1:])


# Entries of the Newton systems that are solved together.
_NEWTON_ENTRIES = 1 << 20
_QUOTIENT = 1e-7
_HALVINGS = 30
# Relaxation rounds where Newton has not converged.
_RELAX = 2000


def advance(lay: SlotLayout, state: SlotState, inputs: Drive, h: float, policy: StepPolicy) -> SlotState:
    """All observers a time h later, under constant inputs.

    The same exponential Runge-Kutta substeps, and the same equilibrium after long steps, as those of
    `gridsec.observers.lure.advance` for each observer alone.
    """
    prepared = state.prepared
    if prepared.h != h:
        prepared = transition(lay.lure, h, policy)
    if prepared.substeps == 0:
        return replace(settle(lay, state, inputs, policy), prepared=prepared)
    n = lay.driver.size
    keep, first, second = np.zeros((3, lay.units + 1))
    keep[:n] = prepared.decay
    first[:n] = prepared.first / lay.droop.tau
    second[:n] = prepared.second / lay.droop.tau
    blocks = () if state.plan is None else (state.plan.large, state.plan.small)
    scale = [(keep, first, second)] + [
        (_gather(keep, n, b.units), _gather(first, n, b.units), _gather(second, n, b.units)) for b in blocks
    ]
    now = [state.driven, state.large, state.small][: len(scale)]
    for _ in range(prepared.substeps):
        here = _targets(lay, inputs, blocks, now)
        ahead = [a * x + b * k for (a, b, _), x, k in zip(scale, now, here, strict=True)]
        there = _targets(lay, inputs, blocks, ahead)
        now = [
            np.add(x, np.multiply(np.subtract(k1, k0, out=k1), c, out=k1), out=x)
            for (_, _, c), x, k0, k1 in zip(scale, ahead, here, there, strict=True)
        ]
    if not blocks:
        return replace(state, driven=now[0], prepared=prepared)
    return replace(state, driven=now[0], large=now[1], small=now[2], prepared=prepared)


def _gather(values: Floats, n: int, units: Ints) -> Floats:
    """`values[units]`, or one number if all inverters share it; padding stays zero with any factor."""
    if n and np.all(values[:n] == values[0]):
        return values[:1]
    return np.asarray(values[units])


def _targets(lay: SlotLayout, inputs: Drive, blocks: tuple[SlotBlock, ...], x: list[Floats]) -> list[Floats]:
    """K(zeta) of the driven observer and of every slot of the banks."""
    n = lay.driver.size
    s = inputs.reference(x[0])
    z = lay.H @ s + inputs.base
    own = np.zeros(lay.units + 1)
    if n:
        own[:n] = lay.droop(np.where(inputs.driven, inputs.reading, z[:n]))
    out = [own]
    for block, states in zip(blocks, x[1:], strict=True):
        out.append(_curve(lay, block, _outputs(lay, block, z, s, states)))
    return out


def _curve(lay: SlotLayout, block: SlotBlock, z: Floats) -> Floats:
    if not lay.driver.size:
        return np.zeros_like(z)
    k = lay.droop(z, block.rows)
    return k if block.real is None else np.where(block.real, k, 0.0)


def _outputs(lay: SlotLayout, block: SlotBlock, z: Floats, s: Floats, x: Floats) -> Floats:
    """Outputs z (k, n) of every slot: the common z plus the effect of the slots' own deviations."""
    apart = x - s[block.units]
    out = np.asarray(z[block.units])
    if block.H is not None:
        for place, feedback in enumerate(block.H):
            for h, d in zip(feedback, apart, strict=True):
                out[place] += h * d
        return out
    wide = _scatter(lay, block.units, apart)
    return np.asarray(out + np.take_along_axis(wide @ lay.H.T, block.units.T, axis=1).T)


def _scatter(lay: SlotLayout, units: Ints, apart: Floats) -> Floats:
    """Deviations of the slots (k, n) as full vectors (n, e + 1)."""
    wide = np.zeros((units.shape[1], lay.units + 1))
    np.put_along_axis(wide, units.T, apart.T, axis=1)
    wide[:, lay.units] = 0.0
    return wide


def settle(lay: SlotLayout, state: SlotState, inputs: Drive, policy: StepPolicy) -> SlotState:
    """All observers in their equilibria."""
    n = lay.driver.size
    driven = state.driven.copy()
    if n:
        driven[:n] = np.where(inputs.driven, lay.droop(inputs.reading), driven[:n])
    loose = np.flatnonzero(~inputs.driven)
    if loose.size:
        alone = SlotBlock(loose[:, None], lay.rows[loose][:, None], None, None)
        driven[loose] = _equilibrium(
            lay, alone, inputs, driven[loose][:, None], driven=driven, policy=policy
        )[:, 0]
    if state.plan is None:
        return replace(state, driven=driven)
    large, small = (
        _equilibrium(lay, block, inputs, x, driven=driven, policy=policy)
        for block, x in ((state.plan.large, state.large), (state.plan.small, state.small))
    )
    return replace(state, driven=driven, large=large, small=small)


def _equilibrium(
    lay: SlotLayout, block: SlotBlock, inputs: Drive, x: Floats, *, driven: Floats, policy: StepPolicy
) -> Floats:
    """Slots (k, n) with `x = K(z(x))`, computed in parts of a few thousand observers."""
    k, n = x.shape
    s = inputs.reference(driven).copy()
    z = lay.H @ s + inputs.base
    out = x.copy()
    size = max(1, _NEWTON_ENTRIES // max(1, k * k))
    for i in range(0, n if k else 0, size):
        part = slice(i, i + size)
        units = block.units[:, part].T
        H = lay.H[units[:, :, None], units[:, None, :]]
        fixed = z[units] - np.einsum("nij,nj->ni", H, s[units])
        loop = _Loops(lay, lay.rows[units], lay.real[units], H, fixed)
        out[:, part] = loop.solve(x[:, part].T, policy).T
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _Loops:
    """The equations `x = K(H x + fixed)` of n observers with k slots."""

    lay: SlotLayout
    rows: Ints
    real: Bools
    H: Floats
    fixed: Floats

    def take(self, keep: Ints) -> _Loops:
        return _Loops(self.lay, self.rows[keep], self.real[keep], self.H[keep], self.fixed[keep])

    def outputs(self, x: Floats) -> Floats:
        return np.asarray(np.einsum("nij,nj->ni", self.H, x) + self.fixed)

    def curve(self, z: Floats) -> Floats:
        return np.where(self.real, self.lay.droop(z, self.rows), 0.0)

    def residual(self, x: Floats) -> Floats:
        return np.asarray(x - self.curve(self.outputs(x)))

    def solve(self, x: Floats, policy: StepPolicy) -> Floats:
        """Damped semismooth Newton, as in `lure.settle`; then, if necessary, plain integration."""
        x = x.copy()
        left = np.arange(x.shape[0])
        tol = policy.tol * unit(self.lay.droop)
        for _ in range(policy.max_iter):
            loops, now = self.take(left), x[left]
            residual = loops.residual(now)
            rough = np.abs(residual).max(axis=1) > tol
            left = left[rough]
            if not left.size:
                return x
            x[left] = loops.take(np.flatnonzero(rough)).newton(now[rough], residual[rough])
        # An online step may not fail. Every loop of droop inverters is attractive, so integration converges.
        loops, now = self.take(left), x[left]
        shrink = 1.0 / (1.0 + np.abs(self.H[left]).sum(axis=2).max(axis=1) * self.lay.droop.slope.max())
        for _ in range(_RELAX):
            now -= shrink[:, None] * loops.residual(now)
        x[left] = now
        return x

    def newton(self, x: Floats, residual: Floats) -> Floats:
        z = self.outputs(x)
        width = _QUOTIENT * np.maximum(1.0, np.abs(z))
        slope = (self.curve(z + width) - self.curve(z - width)) / (2.0 * width)
        jacobian = np.eye(x.shape[1]) - slope[:, :, None] * self.H
        step = -np.linalg.solve(jacobian, residual[..., None])[..., 0]
        size = np.linalg.norm(residual, axis=1)
        length = np.ones(x.shape[0])
        for _ in range(_HALVINGS):
            trial = self.residual(x + length[:, None] * step)
            worse = np.linalg.norm(trial, axis=1) > (1.0 - 1e-4 * length) * size
            if not worse.any():
                break
            length = np.where(worse, 0.5 * length, length)
        return np.asarray(x + length[:, None] * step)


def consistency(lay: SlotLayout, sets: Subsets, state: SlotState) -> Floats:
    """pi_S of every large set; chong2020 (6). Empty while too few meters are available."""
    plan = state.plan
    if plan is None:
        return np.zeros(0)
    apart = state.small - state.driven[plan.small.units]
    size = np.abs(apart)
    wide = _scatter(lay, plan.large.units, state.large - state.driven[plan.large.units]).ravel()
    worst = np.zeros((len(plan.compare), sets.count_small))
    for row, (kept, look, table) in zip(worst, plan.compare, strict=True):
        for slot in kept:
            np.maximum(row, size[slot], out=row)
        for slot, where in zip(look, table, strict=True):
            gap = wide[where]
            gap -= apart[slot]
            np.maximum(row, np.abs(gap, out=gap), out=row)
    return np.asarray(worst.ravel()[sets.pairs].max(axis=1))


def spread(lay: SlotLayout, sets: Subsets, state: SlotState, index: int) -> Floats:
    """Largest deviation of the compared estimates from that of one S, inverter by inverter; (n,)."""
    n = lay.driver.size
    plan = state.plan
    if plan is None:
        return np.zeros(n)
    members = sets.pairs[index] % sets.count_small
    units = plan.small.units[:, members]
    wide = _scatter(lay, units, state.small[:, members] - state.driven[units])
    own = np.zeros(lay.units + 1)
    mine = plan.large.units[:, index]
    own[mine] = state.large[:, index] - state.driven[mine]
    own[lay.units] = 0.0
    return np.asarray(np.abs(wide - own)[:, :n].max(axis=0, initial=0.0))


def estimate(lay: SlotLayout, sets: Subsets, state: SlotState, index: int) -> Floats:
    """Estimate (n,) of one observer: large sets first, then small ones; -1 for the driven observer."""
    x = state.driven.copy()
    if index >= 0 and state.plan is not None:
        block, slots, i = (
            (state.plan.large, state.large, index)
            if index < sets.count_large
            else (state.plan.small, state.small, index - sets.count_large)
        )
        mine = block.units[:, i]
        x[mine] = slots[:, i]
    return np.asarray(x[: lay.driver.size])
