"""Plants with attackable inputs: existence of their observers, and the error systems.

    x+ = A x + G phi(H x + F u) + B u + B_a a_u + E d,      y = C x + D u + a_y + n

The attack a_u is an unknown input of any size. An observer that trusts the sensors J_s and uses no knowledge
of the inputs J_u needs `rank(C_Js b_Ju) = |J_u|`, and its zeros inside the unit circle.

References
----------
yang2021 (1), (16), (18), (33); docs/theory-unknown-input.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.errors import DesignInfeasible, InputInvalid, Problem, refuse
from gridsec.lmi.sampled import DiscreteLure, sample
from gridsec.lmi.unknown_input import ErrorSystem
from gridsec.lure import Lure

Pair = tuple[tuple[int, ...], tuple[int, ...]]
"""(J_u, J_s): distrusted inputs, trusted sensors."""


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputPlant:
    """A sampled plant with inputs and sensors that may be attacked. n states, r inputs, p sensors.

    Attributes
    ----------
    system
        The plant without attacks.
    inputs : (n, r)
        B_a, full column rank. For yang2021 (33) also the B of the known input.
    noise : (p,)
        Largest error of each unmanipulated reading; either all positive or all zero.
    drift : (n, d)
        E: deviation of the plant from its model, with |d_i| <= 1.
    span : (n,)
        Largest possible |x_i|, or infinity. The only knowledge at the start.

    Raises
    ------
    ValueError
        If shapes are inconsistent, the columns of `inputs` are dependent, or `noise` or `span` is invalid;
        lists every problem.
    """

    system: DiscreteLure
    inputs: Floats
    noise: Floats
    drift: Floats
    span: Floats

    def __post_init__(self) -> None:
        """Freeze the arrays and refuse invalid values."""
        for name in ("inputs", "noise", "drift", "span"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        n, p = len(self.system.A), len(self.system.C)
        problems = []
        if self.inputs.ndim != 2 or len(self.inputs) != n or not self.inputs.shape[1]:
            problems.append(
                Problem("shape", f"inputs has shape {self.inputs.shape}; expected ({n}, r) with r > 0")
            )
        elif np.linalg.matrix_rank(self.inputs) < self.inputs.shape[1]:
            problems.append(
                Problem(
                    "singular", "the columns of inputs are dependent: no reconstruction could tell them apart"
                )
            )
        if self.noise.shape != (p,) or not (np.all(self.noise > 0.0) or np.all(self.noise == 0.0)):
            problems.append(
                Problem("not-positive", f"noise must be of shape ({p},), all positive or all zero")
            )
        if self.drift.ndim != 2 or len(self.drift) != n:
            problems.append(Problem("shape", f"drift has shape {self.drift.shape}; expected ({n}, d)"))
        if self.span.shape != (n,) or not np.all(self.span > 0.0):
            problems.append(Problem("not-positive", f"span must be positive, of shape ({n},)"))
        refuse(problems)

    @property
    def scale(self) -> Floats:
        """Error scale of each sensor, (p,): its noise, or 1 for all without noise."""
        return self.noise if np.all(self.noise > 0.0) else np.ones(self.noise.size)

    @property
    def middle(self) -> Floats:
        """Middle of each slope interval, (m,)."""
        return 0.5 * (self.system.lower + self.system.upper)

    @property
    def half(self) -> Floats:
        """Half-width of each slope interval, (m,)."""
        return 0.5 * (self.system.upper - self.system.lower)


def exact(system: DiscreteLure, inputs: Floats) -> UnknownInputPlant:
    """Plant with exact readings and an exact model, as in yang2021."""
    n, p = len(system.A), len(system.C)
    return UnknownInputPlant(system, inputs, np.zeros(p), np.zeros((n, 0)), np.full(n, np.inf))


def inverters(
    lure: Lure,
    h: float,
    attackable: Ints,
    *,
    reading_error: Floats,
    u_error: Floats,
    curve_error: Floats,
    span: Floats,
    reports: Ints | None = None,
    report_error: Floats | None = None,
) -> UnknownInputPlant:
    """Loop of a feeder with attackable set points of inverters.

    An attacked inverter follows `tau x' = -x + K(z) + a_u`: a_u is the error of its set point, and any course
    of its reactive injection corresponds to some a_u. Sampled at h with `lmi.sampled.sample`. Sensors are the
    voltage meters, then the reported reactive injections of inverters.

    Parameters
    ----------
    lure
        Closed loop of a feeder, from `close_loop`.
    h
        Time between readings, s.
    attackable : (r,)
        Inverters with an attackable set point.
    reading_error : (p',)
        Largest error of each voltage meter, squared pu.
    u_error : (l,)
        Largest error of each entry of the known input, squared pu. It adds to the readings' errors
        through D and to the set points' through the steepest slope of the curve.
    curve_error : (m,)
        Largest further error of each inverter's set point, pu: motion of z within a step, difference between
        the curve and the model's.
    span : (m,)
        Largest reactive injection of each inverter, attacked or not, pu.
    reports : (k,)
        Inverters with a reported reactive injection.
    report_error : (k,)
        Largest error of each report, pu.

    Raises
    ------
    ValueError
        As `UnknownInputPlant`, or if reports and their errors differ in number.
    """
    system = sample(lure, h)
    n, inputs = system.B.shape
    told = np.zeros(0, dtype=np.intp) if reports is None else np.asarray(reports, dtype=np.intp)
    error = np.zeros(0) if report_error is None else np.asarray(report_error, dtype=np.float64)
    if told.size != error.size:
        raise InputInvalid(
            [Problem("shape", f"{told.size} inverters report, but {error.size} errors of reports are given")]
        )
    whole = DiscreteLure(
        A=system.A,
        G=system.G,
        H=system.H,
        F=system.F,
        B=system.B,
        C=np.vstack([system.C, np.eye(n)[told]]),
        D=np.vstack([system.D, np.zeros((told.size, inputs))]),
        lower=system.lower,
        upper=system.upper,
        phi=system.phi,
        h=h,
    )
    off = curve_error + lure.slope * (np.abs(lure.F) @ u_error)
    drift = system.G * off
    noise = np.concatenate([reading_error + np.abs(lure.D) @ u_error, error])
    return UnknownInputPlant(whole, system.G[:, attackable], noise, drift[:, off > 0.0], span)


@dataclass(frozen=True, slots=True)
class Missing:
    """An observer missing from a bank.

    Attributes
    ----------
    pair
        (J_u, J_s).
    reason
        "rank": the sensors do not observe every unknown input. "zero": a zero outside the unit circle. Either
        proves that no observer satisfies (3) or (21) of yang2021. "design": no gain was found; others may
        exist.
    rank
        Rank of `C_Js b_Ju`.
    value
        Smallest singular value relative to the largest; modulus of the zero; or the design's margin.
    why
        One sentence.
    """

    pair: Pair
    reason: Literal["rank", "zero", "design"]
    rank: int
    value: float
    why: str


def obstruction(plant: UnknownInputPlant, pair: Pair, *, tolerance: float) -> Missing | None:
    """Proof that the observer of (J_u, J_s) cannot exist, if one of the two necessary conditions fails.

    Rank: `rank(C_Js b_Ju) = |J_u|`, by singular values of the sensors' rows in units of their errors. Zeros:
    if J_s has as many sensors as J_u inputs, some slopes at the ends of their intervals give the linearised
    plant a zero of modulus above 1. (Proofs: docs/theory-unknown-input.md, sections 2 and 3; the latter
    presumes that the known input can hold the plant where its slopes are these.)

    Parameters
    ----------
    pair
        (J_u, J_s).
    tolerance
        Singular values below this part of the largest count as zero.

    Returns
    -------
    Missing or None
        None if both conditions hold; a design may still not exist.
    """
    unknown, sensors = list(pair[0]), list(pair[1])
    seen = plant.system.C[sensors] / plant.scale[sensors, None] @ plant.inputs[:, unknown]
    values = np.linalg.svd(seen, compute_uv=False)
    size = float(np.max(values, initial=0.0))
    rank = int(np.count_nonzero(values > tolerance * size))
    if rank < len(unknown):
        least = float(values[-1] / size) if size and values.size >= len(unknown) else 0.0
        why = f"the sensors {sensors} see the inputs {unknown} with rank {rank}, not {len(unknown)}"
        return Missing(pair, "rank", rank, least, why)
    if len(sensors) != len(unknown):
        return None
    worst = worst_zero(plant, pair)
    if worst > 1.0 + tolerance:
        why = f"blind to the inputs {unknown}, the sensors {sensors} leave a zero of modulus {worst:.4g}"
        return Missing(pair, "zero", rank, worst, why)
    return None


def worst_zero(plant: UnknownInputPlant, pair: Pair) -> float:
    """Largest modulus of a zero from J_u to J_s over the corners of the slope intervals; 0 without zeros.

    Only for as many sensors as unknown inputs: then the error invisible to the sensors moves inside
    `ker C_Js` by `Gbar (A + G diag(d) H)`, and its eigenvalues there are the zeros.

    Parameters
    ----------
    pair
        (J_u, J_s), with `C_Js b_Ju` square and regular.

    Raises
    ------
    DesignInfeasible
        If there are too many nonlinearities to visit all corners.
    """
    system, sensors = plant.system, list(pair[1])
    blind, _ = projection(plant, pair)
    hidden = np.linalg.svd(system.C[sensors])[2][len(sensors) :].T
    if not hidden.size:
        return 0.0
    live = np.flatnonzero(system.slope > 0.0)
    if live.size > _CORNERS:
        raise DesignInfeasible(
            "zeros at all corners of the slopes", f"{live.size} nonlinearities are too many", code="too-many"
        )
    worst = 0.0
    for ends in product((0, 1), repeat=live.size):
        d = system.lower.copy()
        d[live] = np.where(ends, system.upper[live], system.lower[live])
        zeros = np.linalg.eigvals(hidden.T @ blind @ (system.A + (system.G * d) @ system.H) @ hidden)
        worst = max(worst, float(np.max(np.abs(zeros))))
    return worst


# 2^12 corners of the slope intervals take a second.
_CORNERS = 12


def projection(plant: UnknownInputPlant, pair: Pair) -> tuple[Floats, Floats]:
    """`Gbar = I - b H C_J` and `b H` of yang2021 (35), (36).

    H is the left inverse of `C_J b` that is least squares in units of the sensors' errors; with equal
    errors this is the Moore-Penrose inverse of the paper.

    Parameters
    ----------
    plant, pair
        As in `obstruction`, which must return None.

    Returns
    -------
    blind, inject : (n, n), (n, |J_s|)
        `blind @ b = 0`.
    """
    unknown, sensors = list(pair[0]), list(pair[1])
    n = len(plant.system.A)
    if not unknown:
        return np.eye(n), np.zeros((n, len(sensors)))
    b, C, N = plant.inputs[:, unknown], plant.system.C[sensors], plant.scale[sensors]
    inject = b @ np.linalg.pinv(C @ b / N[:, None]) / N
    return np.eye(n) - inject @ C, inject


def error_system(plant: UnknownInputPlant, pair: Pair) -> ErrorSystem:
    """Error system of the observer without its gain.

    `e+ = (Gbar (A + G mid H) - K C_J) e + Gbar G psi + [b H N, Gbar E] w + K N n` with `e = x_hat - x`.

    Parameters
    ----------
    plant, pair
        As in `projection`.
    """
    system, sensors = plant.system, list(pair[1])
    blind, inject = projection(plant, pair)
    N = plant.scale[sensors]
    return ErrorSystem(
        M=blind @ (system.A + (system.G * plant.middle) @ system.H),
        S=blind @ system.G,
        H=system.H,
        half=plant.half,
        C=system.C[sensors],
        W=np.hstack([inject * N, blind @ plant.drift]),
        N=N,
    )


def pairs_text(pairs: Sequence[Pair]) -> str:
    """Pairs with indices counted from 1, as in the papers; for messages."""
    return "; ".join(
        "({" + ",".join(str(i + 1) for i in u) + "},{" + ",".join(str(j + 1) for j in s) + "})"
        for u, s in pairs
    )
