"""Time steps, equilibria and comparisons of the observers that `gridsec.slots` stores."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.lure import StepPolicy, transition, unit
from gridsec.slots import Block, Drive, Layout, SlotState
from gridsec.subsets import Subsets

# Entries of the Newton systems that are solved together.
_NEWTON_ENTRIES = 1 << 20
_QUOTIENT = 1e-7
_HALVINGS = 30
# Relaxation rounds where Newton has not converged.
_RELAX = 2000


def advance(lay: Layout, state: SlotState, inputs: Drive, h: float, policy: StepPolicy) -> SlotState:
    """All observers a time h later, under constant inputs.

    The same exponential Runge-Kutta substeps, and the same equilibrium after long steps, as those of
    `gridsec.lure.advance` for each observer alone.
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


def _targets(lay: Layout, inputs: Drive, blocks: tuple[Block, ...], x: list[Floats]) -> list[Floats]:
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


def _curve(lay: Layout, block: Block, z: Floats) -> Floats:
    if not lay.driver.size:
        return np.zeros_like(z)
    k = lay.droop(z, block.rows)
    return k if block.real is None else np.where(block.real, k, 0.0)


def _outputs(lay: Layout, block: Block, z: Floats, s: Floats, x: Floats) -> Floats:
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


def _scatter(lay: Layout, units: Ints, apart: Floats) -> Floats:
    """Deviations of the slots (k, n) as full vectors (n, e + 1)."""
    wide = np.zeros((units.shape[1], lay.units + 1))
    np.put_along_axis(wide, units.T, apart.T, axis=1)
    wide[:, lay.units] = 0.0
    return wide


def settle(lay: Layout, state: SlotState, inputs: Drive, policy: StepPolicy) -> SlotState:
    """All observers in their equilibria."""
    n = lay.driver.size
    driven = state.driven.copy()
    if n:
        driven[:n] = np.where(inputs.driven, lay.droop(inputs.reading), driven[:n])
    loose = np.flatnonzero(~inputs.driven)
    if loose.size:
        alone = Block(loose[:, None], lay.rows[loose][:, None], None, None)
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
    lay: Layout, block: Block, inputs: Drive, x: Floats, *, driven: Floats, policy: StepPolicy
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

    lay: Layout
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
        """Damped semismooth Newton, as in `gridsec.newton.settle`; then, if necessary, plain integration."""
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


def consistency(lay: Layout, sets: Subsets, state: SlotState) -> Floats:
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


def spread(lay: Layout, sets: Subsets, state: SlotState, index: int) -> Floats:
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


def estimate(lay: Layout, sets: Subsets, state: SlotState, index: int) -> Floats:
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
