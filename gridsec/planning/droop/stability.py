"""Proofs that a fleet of droop inverters settles from every initial state on the AC feeder.

Inverters sample their voltage every h seconds, with d whole intervals of dead time, and hold their set-point:

    x_i(k + 1) = (1 - alpha_i) x_i(k) + alpha_i K_i(v_i(k - d)),    alpha_i = 1 - exp(-h / tau_i);

h = 0 is the first-order filter in continuous time. Two trajectories with the same loads differ by e with
`e+ = (I - A) e + A psi`, `psi = -Delta Jt e`, where the slopes Delta lie between 0 and D and Jt, a chord of
the AC power flow, within an error of J (`gridsec.planning.droop.ac_sensitivity.region`).

Source: docs/theory-studies.md, section on the droop fleet, with proofs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import LinAlgError, solve_continuous_are, solve_discrete_are

from gridsec.arrays import Floats, Ints, spectral_radius
from gridsec.errors import InputInvalid, Problem
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.planning.droop.ac_sensitivity import Complex, InjectionBox, PhasorNetwork, Region, region

__all__ = [
    "Loop",
    "Proof",
    "Reach",
    "Update",
    "enlarged",
    "factor",
    "growth",
    "loop",
    "proof",
    "reach",
    "slopes",
    "steepened",
    "verified",
]


@dataclass(frozen=True, slots=True)
class Update:
    """Timing of the inverters' updates.

    Raises ValueError if the interval is negative or not finite, the dead time is negative, or a continuous
        filter has a dead time.
    """

    interval_s: float = 1.0  # sampling interval h, s; 0: continuous filters
    dead: int = 0  # dead time d, whole intervals

    def __post_init__(self) -> None:
        if not (np.isfinite(self.interval_s) and self.interval_s >= 0.0):
            raise InputInvalid(
                [
                    Problem(
                        "negative",
                        f"interval is {self.interval_s} s; it must be a number that is not negative",
                    )
                ]
            )
        if self.dead < 0:
            raise InputInvalid(
                [Problem("negative", f"dead time is {self.dead} intervals; it must not be negative")]
            )
        if self.dead and not self.interval_s:
            raise InputInvalid(
                [
                    Problem(
                        "inconsistent",
                        "continuous filters have no dead time here; give a short interval instead",
                    )
                ]
            )

    def share(self, tau: Floats) -> Floats:
        """`alpha`, the fraction of the step to the set-point in one interval, (m,)."""
        return np.asarray(-np.expm1(-self.interval_s / tau))


# --- reachable set ----------------------------------------------------------------------------------------

_SHRINKS: Final = 0.98
"""Factor by which another round of `reach` must shrink the injections at least."""

_REACH_ROUNDS: Final = 12

_ROOM: Final = 1e-6
"""Fraction of the old range added to injections, so that a smaller box is entered in finite time."""


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Box of injections that every trajectory enters and does not leave."""

    # x_low, x_high (m,): injections of the inverters, pu
    x_low: Floats
    x_high: Floats
    region: Region  # bounds of the AC power flow in it


def reach(net: PhasorNetwork, droop: Droop, loads: InjectionBox, *, rounds: int = _REACH_ROUNDS) -> Reach:
    """Shrink the box of the inverters' injections: voltages bound set-points, and set-points voltages.

    loads: injections without the droop inverters; a point, or a box in which they move arbitrarily.
    rounds: largest number of rounds; 0 for the saturation of the curves.
    Raises DesignInfeasible if the box is too large for a bound.
    """
    low, high = droop.q[:, 3], droop.q[:, 0]
    found = region(net, _with(loads, droop, low, high))
    for _ in range(rounds):
        asked_low = voltage_curve(droop, found.high[droop.customer])
        asked_high = voltage_curve(droop, found.low[droop.customer])
        room = _ROOM * (high - low)
        new = np.maximum(low, asked_low - room), np.minimum(high, asked_high + room)
        if not np.sum(new[1] - new[0]) < _SHRINKS * np.sum(high - low):
            break
        low, high = new
        found = region(net, _with(loads, droop, low, high))
    return Reach(low, high, found)


def _with(loads: InjectionBox, droop: Droop, low: Floats, high: Floats) -> InjectionBox:
    """The box with the inverters' reactive power added to that of the loads."""
    q_low, q_high = loads.q_low.copy(), loads.q_high.copy()
    np.add.at(q_low, droop.customer, low)
    np.add.at(q_high, droop.customer, high)
    return replace(loads, q_low=q_low, q_high=q_high)


def slopes(droop: Droop, low: Floats, high: Floats) -> Floats:
    """Steepest slope of every curve between two voltages, `-dq/dv`, pu.

    low, high (m,): voltages at the inverters, pu.
    """
    width, fall = np.diff(droop.v, axis=1), -np.diff(droop.q, axis=1)
    ramp = np.divide(fall, width, out=np.zeros_like(fall), where=width > 0.0)
    touched = (droop.v[:, 1:] > low[:, None]) & (droop.v[:, :-1] < high[:, None])
    return np.asarray(np.max(np.where(touched, ramp, 0.0), axis=1, initial=0.0))


def steepened(droop: Droop, times: float) -> Droop:
    """Fleet with all ramps steeper by a factor, with the same limits and deadband.

    Outer ramps are compressed towards the inner breakpoints; where those do not enclose a deadband, the
    whole curve is compressed towards the middle between them.

    Raises FeederInvalid if the first breakpoint of a curve would not be positive.
    """
    v = droop.v.copy()
    flat = (droop.q[:, 1] == droop.q[:, 2])[:, None]
    middle = 0.5 * (v[:, 1] + v[:, 2])[:, None]
    inner = np.where(flat, v[:, 1:3], middle + (v[:, 1:3] - middle) / times)
    v[:, 0] = inner[:, 0] - (v[:, 1] - v[:, 0]) / times
    v[:, 3] = inner[:, 1] + (v[:, 3] - v[:, 2]) / times
    v[:, 1:3] = inner
    return replace(droop, v=v)


def enlarged(droop: Droop, times: float) -> Droop:
    """Fleet with all limits, and with them all slopes, scaled by `times` (not negative): larger inverters."""
    # An infinite rating stays infinite, also for `times` = 0.
    rating = np.multiply(times, droop.rating, out=droop.rating.copy(), where=np.isfinite(droop.rating))
    return replace(droop, q=times * droop.q, rating=rating)


# --- certificates ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Closed loop in units with all slopes between 0 and 1. m inverters that react to voltages."""

    S: Floats  # (m, m) `D^1/2 J D^1/2`
    error: Floats  # (m, m) largest error of S, entry by entry
    tau: Floats  # (m,) time constants, s
    update: Update  # timing of the updates
    # (m,) their indices in the fleet; the other inverters do not react to the voltages within reach
    rows: Ints

    @property
    def gain(self) -> float:
        """Largest gain of the loop at rest within its bounds."""
        return spectral_radius(np.abs(self.S) + self.error) if self.tau.size else 0.0

    @property
    def covers_shorter(self) -> bool:
        """True if a certificate for inverters that jump to their set-points holds for every interval.

        All responses then lie in the unit disk, with those of jumping inverters on its rim. The circle
        criterion is linear in a response that is common to all, so that the rim decides. Different responses
        need `|S| < 1` besides. The small-gain certificate does not depend on the interval.
        """
        alike = bool(np.all(self.tau == self.tau[:1]))
        size = float(np.linalg.norm(self.S, 2) + np.linalg.norm(self.error, 2)) if self.tau.size else 0.0
        return alike or size < 1.0 - _SURE or self.gain < 1.0 - _SURE


def loop(droop: Droop, within: Reach, update: Update) -> Loop:
    """Loop of a fleet in the box `within`."""
    own = droop.customer
    slope = slopes(droop, within.region.low[own], within.region.high[own])
    rows = np.flatnonzero(slope > 0.0)
    root, at = np.sqrt(slope[rows]), np.ix_(own[rows], own[rows])
    both = root[:, None] * root
    return Loop(
        both * within.region.dv_dq[at], both * within.region.q_error[at], droop.tau[rows], update, rows
    )


_ANGLES: Final = 97
"""Frequencies of the circle criterion before its proof."""

_LOPSIDED: Final = 0.2
"""Relative asymmetry above which all frequencies are examined, because the loop's phase matters as well."""


def factor(given: Loop) -> float:
    """Largest factor on all slopes, in the same box, that keeps the circle criterion satisfied.

    For all `|z| = 1`, with `H = diag(alpha_i z^-d / (z - 1 + alpha_i))` and eps the norm of the error:
    `2 I + k (S H + H* S^T - eps (I + H* H)) > 0`. It is linear in k, so every frequency gives its largest k.
    """
    if not given.tau.size:
        return np.inf
    eps, worst = float(np.linalg.norm(given.error, 2)), 0.0
    for H in _responses(given):
        through = given.S * H
        against = eps * (np.eye(H.size) + np.diag(np.abs(H) ** 2)) - through - through.conj().T
        worst = max(worst, 0.5 * float(np.linalg.eigvalsh(against)[-1]))
    return 1.0 / worst if worst > 0.0 else np.inf


def _responses(given: Loop) -> list[Complex]:
    """Response of every inverter, (m,), at frequencies up to half the sampling rate."""
    if given.update.interval_s == 0.0:
        rates = np.concatenate(
            [[0.0], np.logspace(-3.0, 3.0, _ANGLES - 1) / np.max(given.tau, initial=1e-300)]
        )
        return [1.0 / (1.0 + 1j * rate * given.tau) for rate in rates]
    alpha = given.update.share(given.tau)
    angles = np.pi * np.linspace(0.0, 1.0, _ANGLES * (1 + given.update.dead))
    lopsided = np.linalg.norm(given.S - given.S.T) > _LOPSIDED * np.linalg.norm(given.S)
    if np.all(alpha == alpha[:1]) and alpha.size and not lopsided:
        # A common response: its leftmost points decide, or those with the largest weight of errors.
        h = alpha[0] * np.exp(-1j * angles * given.update.dead) / (np.exp(1j * angles) - 1.0 + alpha[0])
        angles = angles[[0, *np.argsort(h.real)[:3], *np.argsort(h.real - np.abs(h) ** 2)[:3]]]
    return [alpha * np.exp(-1j * w * given.update.dead) / (np.exp(1j * w) - 1.0 + alpha) for w in angles]


_SIGMA: Final = 1e-6
"""Slack of the Riccati equation in the inequality, relative to its scale."""


def verified(given: Loop, times: float = 1.0) -> bool:
    """Prove that the loop contracts with all slopes scaled by a factor.

    With a state w of e and delayed set-points, `w+ = F w + G psi`, `e = C w`, and eps the norm of the error,
    contraction follows from a norm P > 0, found by a Riccati equation, with

        [F' P F - P + eps C'C      F' P G - C' S'     ]
        [*                         G' P G - (2 - eps) ]  <  0,

    which is verified here on the numbers.
    """
    m, d = given.tau.size, given.update.dead
    if not m:
        return True
    eps = times * float(np.linalg.norm(given.error, 2))
    if not eps < 2.0:
        return False
    F, G, C = _realised(given)
    S = times * given.S @ C
    q = -(eps + _SIGMA) * C.T @ C - _SIGMA * np.eye(m * (1 + d))
    r = (2.0 - eps - _SIGMA) * np.eye(m)
    solver = solve_discrete_are if given.update.interval_s else solve_continuous_are
    try:
        P = -solver(F, G, q, r, s=S.T)
    except (LinAlgError, ValueError):
        return False
    P = 0.5 * (P + P.T)
    if given.update.interval_s:
        blocks = (F.T @ P @ F - P, F.T @ P @ G, G.T @ P @ G)
    else:
        blocks = (F.T @ P + P @ F, P @ G, np.zeros((m, m)))
    corner = blocks[1] - S.T
    inequality = np.block(
        [[blocks[0] + eps * C.T @ C, corner], [corner.T, blocks[2] - (2.0 - eps) * np.eye(m)]]
    )
    rounding = 100.0 * np.finfo(np.float64).eps * len(inequality) * max(1.0, float(np.abs(P).max()))
    top = float(np.linalg.eigvalsh(0.5 * (inequality + inequality.T))[-1])
    return bool(top < -rounding and np.linalg.eigvalsh(P)[0] > rounding)


def _realised(given: Loop) -> tuple[Floats, Floats, Floats]:
    """F, G, C of the inverters with their delayed set-points."""
    m, d = given.tau.size, given.update.dead
    if given.update.interval_s == 0.0:
        return -np.diag(1.0 / given.tau), np.diag(1.0 / given.tau), np.eye(m)
    alpha = given.update.share(given.tau)
    F, G = np.zeros((m * (1 + d), m * (1 + d))), np.zeros((m * (1 + d), m))
    F[:m, :m] = np.diag(1.0 - alpha)
    if d:
        # The newest set-point enters the last block, the oldest leaves from the one after e.
        F[:m, m : 2 * m] = np.diag(alpha)
        F[m:-m, 2 * m :] = np.eye(m * (d - 1))
        G[-m:] = np.eye(m)
    else:
        G[:m] = np.diag(alpha)
    return F, G, np.eye(m, m * (1 + d))


@dataclass(frozen=True, slots=True)
class Proof:
    """Proof that a fleet settles."""

    # `deadband`: no inverter reacts within reach; `small-gain`: for every interval and dead time; `circle`;
    # empty without a proof
    kind: str
    gain: float  # largest gain of the loop at rest, 1
    factor: float  # largest proven factor on all slopes in the same box of voltages


_MOST: Final = 1e6
"""Largest factor; larger ones are not distinguished."""

_SURE: Final = 1e-9
"""Margin by which a gain must be below 1, larger than its rounding."""

_BACKOFF: Final = (0.999, 0.99, 0.95, 0.8)
"""Fractions of the factor from the frequencies that are tried in its proof."""


def proof(given: Loop) -> Proof:
    """Prove that a loop contracts, by the simplest certificate that holds."""
    if not given.tau.size:
        return Proof("deadband", 0.0, np.inf)
    gain = given.gain
    best, found = 1.0 / max(gain, 1.0 / _MOST), min(factor(given), _MOST)
    for share in _BACKOFF:
        if share * found > best and verified(given, share * found):
            best = share * found
            break
    kind = "small-gain" if gain < 1.0 - _SURE else "circle" if best >= 1.0 else ""
    return Proof(kind, gain, best)


# --- linearised -----------------------------------------------------------------------------------------


def growth(J: Floats, slope: Floats, tau: Floats, update: Update) -> float:
    """Largest factor by which a small deviation from rest grows in one update; above 1 the loop is unstable.

    J (m, m): sensitivities `d|v|/dq` between the inverters at rest, pu.
    slope (m,): slopes of the curves there, `-dq/dv`.
    update: timing. For continuous filters: growth in the smallest time constant.
    """
    if not tau.size:
        return 0.0
    F, G, C = _realised(Loop(J, np.zeros_like(J), tau, update, np.arange(tau.size)))
    closed = np.linalg.eigvals(F - G @ (slope[:, None] * J) @ C)
    if update.interval_s == 0.0:
        return float(np.exp(np.max(closed.real) * np.min(tau)))
    return float(np.max(np.abs(closed)))
