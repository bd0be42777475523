"""Lur'e systems in discrete time, and the feeder's loop sampled at its readings.

    x(k+1) = A x(k) + G phi(H x(k) + F u(k)) + B u(k),      y(k) = C x(k) + D u(k)

The module is in this package because the inequalities use these systems; no solver is used here.

Source: yang2019 (1), (2), with the known vector rho written as B u; docs/theory-discrete.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from gridsec.arrays import Floats, exponential_integrals, spectral_radius
from gridsec.errors import Problem, raise_if_any
from gridsec.observers.lure import Lure, Matrices, Nonlinearity, freeze, matrices_of, without_lower


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteLure(Matrices):
    """`x+ = A x + G phi(H x + F u) + B u`, `y = C x + D u`.

    A known vector rho(u, y) as in yang2019 (1) is passed as further entries of u.
    Raises ValueError if shapes are inconsistent, an entry is not finite, a lower slope exceeds its upper one,
        or h is not positive; lists every problem.
    """

    lower: Floats  # (m,) lower bound of the slope of each entry of phi
    upper: Floats  # (m,) upper bound, `lower <= upper`
    phi: Nonlinearity  # the nonlinearity, (…, m) -> (…, m), entry by entry
    h: float = 1.0  # time from one step to the next, s

    def __post_init__(self) -> None:
        wrong = freeze(self, "lower", "upper")
        if self.lower.shape == self.upper.shape and np.any(self.lower > self.upper):
            wrong.append(Problem("order", "a lower slope exceeds its upper slope"))
        if not (np.isfinite(self.h) and self.h > 0.0):
            wrong.append(Problem("not-positive", f"h is {self.h}; the time between steps must be positive"))
        raise_if_any(wrong)

    @classmethod
    def of(
        cls,
        A: ArrayLike,
        C: ArrayLike,
        *,
        G: ArrayLike,
        H: ArrayLike,
        phi: Nonlinearity,
        lower: ArrayLike,
        upper: ArrayLike,
        F: ArrayLike | None = None,
        B: ArrayLike | None = None,
        D: ArrayLike | None = None,
        h: float = 1.0,
    ) -> DiscreteLure:
        """System from nested lists or arrays; a missing input matrix is zero.

        A, C, G, H, phi, F, B, D, h: as in the class. Without any of F, B and D there are no inputs, l = 0.
        lower, upper: likewise; one number for all entries of phi.
        Raises ValueError as in the class.
        """
        found = matrices_of(A, C, G, H, F, B, D)
        low, high = (np.broadcast_to(np.asarray(end, np.float64), len(found[2])) for end in (lower, upper))
        return cls(*found, low, high, phi, h)

    @property
    def slope(self) -> Floats:
        """Width of each slope interval, (m,): the slope bound after the loop transform."""
        return np.asarray(self.upper - self.lower)


def shift(system: DiscreteLure) -> DiscreteLure:
    """The same system with slopes in [0, upper - lower]: `gridsec.observers.lure.without_lower`."""
    A, B, phi = without_lower(system, system.phi, system.lower)
    return replace(system, A=A, B=B, lower=np.zeros(system.lower.shape), upper=system.slope, phi=phi)


def advance(system: DiscreteLure, x: Floats, u: Floats) -> Floats:
    """State one step later, for x (…, n) and u (…, l)."""
    z = x @ system.H.T + u @ system.F.T
    return np.asarray(x @ system.A.T + system.phi(z) @ system.G.T + u @ system.B.T)


def measure(system: DiscreteLure, x: Floats, u: Floats) -> Floats:
    """Noiseless outputs `C x + D u`, (…, p), for arguments as in `advance`."""
    return np.asarray(x @ system.C.T + u @ system.D.T)


def sample(lure: Lure, h: float) -> DiscreteLure:
    """Continuous Lur'e system at steps of length h, with constant inputs and nonlinearity over a step.

    The exponential Euler step `x+ = exp(A h) x + h phi_1(A h) (G phi(H x + F u) + B u)`. It is exact for z
    constant over the step. For a droop loop it is exact in general if the argument of inverter i is taken at
    some value of z_i *during* the step; `held_error` bounds the distance of that value from the one at its
    beginning.

    h: length of a step, s, positive.
    Source: docs/theory-discrete.md, section 5.
    """
    n = len(lure.A)
    own = np.diagonal(lure.A)
    if np.count_nonzero(lure.A) == np.count_nonzero(own):
        decay, one, _ = exponential_integrals(own * h)
        A, hold = np.diag(decay), np.diag(h * one)
    else:
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:] = h * lure.A, h * np.eye(n)
        full = expm(block)
        A, hold = full[:n, :n], full[:n, n:]
    lower = np.zeros(lure.slope.shape)
    G, B = hold @ lure.G, hold @ lure.B
    return DiscreteLure(A, G, lure.H, lure.F, B, lure.C, lure.D, lower, lure.slope, lure.phi, h)


def held_error(lure: Lure, h: float, away: Floats) -> Floats:
    """Largest motion of z within one step of a droop loop with constant input.

    Inverter j obeys `tau_j x_j' = -x_j + K_j(z_j)`, so `|x_j(s) - x_j(0)| <= q_j sup |K_j(z_j) - x_j(0)|`
    with `q_j = 1 - exp(-h / tau_j)`. With `away_j >= |K_j(z_j(0)) - x_j(0)|`, the motion m solves
    `m = q (away + d |H| m)`, if the spectral radius of `diag(q d) |H|` is below 1.

    lure: closed loop of a feeder, A and G diagonal with G = -A.
    h: length of the step, s.
    away (m,): distance of each inverter from its set point at the beginning of the step, pu.
    Returns (m,): bound on `|z_i(s) - z_i(0)|`, 0 <= s <= h, squared pu; infinite without a bound.
    Source: docs/theory-discrete.md, section 5.
    """
    q = -np.expm1(np.diagonal(lure.A) * h)
    reach = np.abs(lure.H)
    loop = (q * lure.slope)[:, None] * reach
    if spectral_radius(loop) >= 1.0:
        return np.full(len(reach), np.inf)
    moved = np.linalg.solve(np.eye(len(loop)) - loop, q * away)
    return np.asarray(reach @ moved)


def drift_error(lure: Lure, h: float, jump: Floats) -> Floats:
    """Largest motion of z for a loop that was at rest once, with small input jumps between steps.

    With `|F (u(k+1) - u(k))| <= jump` the motion m of the inverters within any step obeys
    `m <= d ((1 + 2 q) |H| m + jump)`, if the spectral radius of `(1 + 2 q) diag(d) |H|` is below 1.

    lure, h: as in `held_error`.
    jump (m,): largest change of each argument's own input from one step to the next, squared pu.
    Returns (m,): bound on `|z_i(s) - z_i(0)|`, 0 <= s <= h, squared pu; infinite without a bound.
    Source: docs/theory-discrete.md, section 5.
    """
    q = -np.expm1(np.diagonal(lure.A) * h)
    reach = np.abs(lure.H)
    loop = (lure.slope * (1.0 + 2.0 * q))[:, None] * reach
    if spectral_radius(loop) >= 1.0:
        return np.full(len(reach), np.inf)
    moved = np.linalg.solve(np.eye(len(loop)) - loop, lure.slope * jump)
    return np.asarray(reach @ moved)
