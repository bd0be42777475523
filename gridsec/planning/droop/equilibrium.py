"""Equilibrium of a fleet of droop inverters on the AC feeder, and voltage bounds at rest and at all times.

Source: docs/theory-studies.md, section on the droop fleet; chong2020, (13).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.planning.droop.ac_sensitivity import (
    Complex,
    InjectionBox,
    PhasorNetwork,
    neumann,
    sensitivity,
    solve,
)
from gridsec.planning.droop.stability import Loop, reach, slopes

__all__ = ["Band", "Share", "always", "at_rest", "injected", "rest", "shares", "shares_of_gain"]

_TOL: Final = 1e-11
"""Largest distance of set-points from injections at rest, relative to the largest limit."""

_ROUNDS: Final = 60
_NEWTON: Final = 40
_SLACK: Final = 1e-9
_BESIDE: Final = 1e-7
"""Distance from a breakpoint within which the slopes of both sides count, pu."""


def injected(droop: Droop, s: Complex, x: Floats) -> Complex:
    """Injections of the customers with those of their inverters, (…, N).

    s (…, N): complex injections without the inverters, pu.
    x (…, m): reactive injections of the inverters, pu.
    """
    owner = np.equal.outer(droop.customer, np.arange(s.shape[-1])).astype(np.float64)
    return np.asarray(s + 1j * (x @ owner))


def rest(net: PhasorNetwork, droop: Droop, s: Complex, v0: Floats | float) -> tuple[Floats, Complex]:
    """Injections and voltages with every inverter on its curve; NaN where no equilibrium is found.

    Plain iteration for all operating points together, with damping from the no-load loop gain, and Newton's
    method for points without convergence.

    v0 (…) or scalar: voltage of the busbar, pu.
    Returns (…, m), (…, N): reactive injections, and complex voltages, pu.
    """
    own, everywhere = droop.customer, np.full(droop.tau.size, np.inf)
    root = np.sqrt(slopes(droop, -everywhere, everywhere))
    gain = float(np.linalg.norm(root[:, None] * net.Z.imag[np.ix_(own, own)] * root, 2)) if own.size else 0.0
    x = np.zeros((*s.shape[:-1], own.size))
    v0 = np.broadcast_to(np.asarray(v0, dtype=np.float64), s.shape[:-1])
    tol = _TOL * max(float(np.max(droop.limit, initial=0.0)), 1e-12)
    for _ in range(_ROUNDS):
        V = solve(net, injected(droop, s, x), v0)
        miss = voltage_curve(droop, np.abs(V[..., own])) - x
        open_ = ~(np.max(np.abs(miss), axis=-1, initial=0.0) <= tol)
        if not open_.any():
            return x, V
        x = x + 2.0 / (2.0 + gain) * miss
    for index in np.argwhere(open_):
        at = tuple(index)
        x[at], V[at] = _newton(net, droop, s[at], float(v0[at]), tol)
    return x, V


def _newton(net: PhasorNetwork, droop: Droop, s: Complex, v0: float, tol: float) -> tuple[Floats, Complex]:
    """Solve one point by damped Newton steps with the slopes at the present voltages."""
    own = droop.customer

    def miss(x: Floats) -> tuple[Floats, Complex, float]:
        V = solve(net, injected(droop, s, x), v0)
        off = voltage_curve(droop, np.abs(V[own])) - x
        return off, V, float(np.max(np.abs(off), initial=0.0)) if np.isfinite(off).all() else np.inf

    x = np.zeros(own.size)
    off, V, size = miss(x)
    for _ in range(_NEWTON):
        if size <= tol:
            return x, V
        if not np.isfinite(size):
            break
        v = np.abs(V[own])
        J = sensitivity(net, injected(droop, s, x), V).dv_dq[np.ix_(own, own)]
        step = np.linalg.solve(np.eye(own.size) + slopes(droop, v - _BESIDE, v + _BESIDE)[:, None] * J, off)
        for share in 0.5 ** np.arange(8.0):
            trial = miss(x + share * step)
            if trial[2] < size:
                break
        x, (off, V, size) = x + share * step, trial
    return np.full(own.size, np.nan), np.full(s.size, np.nan + 0j)


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Proven limits of every customer's voltage for loads in a box, pu."""

    # low, high (N,): lower and upper limit
    low: Floats
    high: Floats


def always(net: PhasorNetwork, droop: Droop, loads: InjectionBox) -> Band:
    """Limits at all times, for any motion of the loads in their box, from any reachable state.

    Raises DesignInfeasible if the box is too large for a bound.
    """
    found = reach(net, droop, loads).region
    return Band(found.low, found.high)


def at_rest(net: PhasorNetwork, droop: Droop, loads: InjectionBox) -> Band:
    """Limits while the fleet is at rest: loads in the box that move slowly against the time constants.

    The AC equilibria of the two corners, widened by the largest effect of closed-loop sensitivities of the
    wrong sign. Two equilibria differ by `dv = Jw dw - Jq Delta dv`; with `|dv| <= U |dw|`,
    `U = (I - |Jq| D)^-1 |Jw|`, the lower end of every sensitivity is `L = Jw - |Jq| D U`.

    Raises DesignInfeasible if the box is too large for a bound, or the loop gain is 1 or more.
    """
    found, own = reach(net, droop, loads), droop.customer
    given = found.region
    J, off = np.hstack([given.dv_dp, given.dv_dq]), np.hstack([given.p_error, given.q_error])
    D = slopes(droop, given.low[own], given.high[own])
    back = np.zeros((J.shape[0], J.shape[0]))
    columns = D * (np.abs(given.dv_dq) + given.q_error)[:, own]
    for k, customer in enumerate(own):
        back[:, customer] += columns[:, k]
    inverse = neumann(back)
    if inverse is None:
        raise DesignInfeasible(
            "voltages of the fleet at rest", "the loop gain may be 1 or more", code="unstable"
        )
    # A rise of the busbar lifts all voltages; the fleet's reaction to it counts like that to a load.
    busbar_high = np.abs(given.dv_dv0) + given.v0_error
    U = inverse @ np.column_stack([np.abs(J) + off, busbar_high])
    L = np.column_stack([J - off, given.dv_dv0 - given.v0_error]) - back @ U
    swing = np.full(net.of_busbar.shape[1], loads.v0_high - loads.v0_low)
    width = np.concatenate([loads.p_high - loads.p_low, loads.q_high - loads.q_low, swing])
    wrong = np.minimum(L, 0.0) @ width
    ends = np.stack([loads.p_low + 1j * loads.q_low, loads.p_high + 1j * loads.q_high])
    v = np.abs(rest(net, droop, ends, np.array([loads.v0_low, loads.v0_high]))[1])
    if not np.isfinite(v).all():
        raise DesignInfeasible(
            "voltages of the fleet at rest", "no equilibrium at a corner of the box", code="no-solution"
        )
    return Band(np.maximum(v[0] + wrong - _SLACK, given.low), np.minimum(v[1] - wrong + _SLACK, given.high))


@dataclass(frozen=True, slots=True, eq=False)
class Share:
    """Shares of the inverters in the loop gain. One entry for each inverter of a `Loop`."""

    part: Floats  # (m,) share of each inverter: its squared entry in the leading mode; the sum is 1
    factor: Floats  # (m,) largest factor on its slope alone within the allowed gain; infinity if any


def shares(given: Loop, allowed: float) -> Share:
    """Attribute the gain of a loop to its inverters, with the largest factor on each slope alone.

    `lambda_max(D^1/2 S D^1/2) <= a` is `a D^-1 - S >= 0`. A larger d_i subtracts a multiple of `e_i e_i'`, so
    with `w_i = [(a I - D^1/2 S D^1/2)^-1]_ii` the largest factor is `1 / (1 - 1 / (a w_i))`.

    allowed: a, the allowed gain.
    """
    S = 0.5 * (given.S + given.S.T)
    if not S.size:
        return Share(np.zeros(0), np.zeros(0))
    values, modes = np.linalg.eigh(S)
    part = modes[:, -1] ** 2
    if values[-1] >= allowed:
        return Share(part, np.ones(part.size))
    return Share(part, _factor(allowed * np.sum(modes**2 / (allowed - values), axis=1)))


def _factor(own: Floats) -> Floats:
    """`1 / (1 - 1 / own)`, the largest factor on the slopes; infinite where own is 1."""
    with np.errstate(divide="ignore"):
        return np.where(own > 1.0, 1.0 / (1.0 - 1.0 / np.maximum(own, 1.0 + 1e-15)), np.inf)


def shares_of_gain(given: Loop) -> Share:
    """Attribute the gain of loops of any sign and symmetry, by the small-gain certificate.

    With `M = |S| + error`, the gain `rho(M)` below 1 and `w_i = [(I - M)^-1]_ii`, a column i of M that is
    multiplied by f leaves it below 1 up to `f = 1 / (1 - 1 / w_i)`. The part is the product of an inverter's
    entries in the leading left and right vectors: the growth of the gain with its slope alone.

    Returns Share: factors are NaN where the gain may be 1 or more, so that there is no certificate.
    """
    M = np.abs(given.S) + given.error
    if not M.size:
        return Share(np.zeros(0), np.zeros(0))
    left, right = (_leading(each) for each in (M.T, M))
    part = left * right / float(left @ right)
    inverse = neumann(M)
    return Share(part, np.full(len(M), np.nan) if inverse is None else _factor(np.diagonal(inverse)))


def _leading(M: Floats) -> Floats:
    """Vector of the largest eigenvalue of a matrix without negative entries."""
    values, vectors = np.linalg.eig(M)
    return np.asarray(np.abs(vectors[:, int(np.argmax(values.real))]))
