"""Partial Luenberger observers: each estimates the part of the state observable by one sensor.

One sensor's reading reaches one observer only, so an attack on q sensors corrupts q estimates and leaves
the others exact. The estimates of all sensors, stacked, are a code word of the state,

    z_hat = Phi x + v + e,    Phi = [Z_1 … Z_p]^T,    e_i = 0 without attack on i,   |v_i| <= bound_i,

which `gridsec.secure.decode.partial_bounded` decodes. Sampled time: x(k+1) = A x(k) + B u(k) + d(k), y(k) = C
x(k) + n(k).

Source: lee2018, sections 4.2.1 and 4.3.1; docs/theory-partial-observers.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen, spectral_radius
from gridsec.errors import DesignInfeasible, InputInvalid, no_choice, raise_if_any
from gridsec.observers.parts import (
    SensorDecomposition,
    StackedDecompositions,
    decompose,
    heard,
    require_stable,
    riccati,
    stack,
)

LONGEST = 1 << 17
"""Largest number of steps within which an observer's error must have halved for good."""

RESIDUAL = 1e-6
"""Largest accepted relative residual of a Riccati equation; its gain is then verified separately."""


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Largest disturbances and noise (lee2018, Assumption 4.3.2)."""

    process: float  # d_max: `d(k) = E w(k)` with `|w(k)|_2 <= process`
    noise: Floats  # (p,) n_max of each sensor: `|n_i(k)| <= noise[i]`, in the sensor's unit
    E: Floats  # (n, l) input matrix of disturbances; the identity in the paper


@dataclass(frozen=True, slots=True, eq=False)
class ErrorEnvelope:
    """Bound of one observer's error without attack: |v(k)| <= |F^k| |v(0)| + limit; lee2018 (4.3.7)."""

    # (K + 1,) |F^j|_2 for j = 0 … K, the last at most half of one over the largest. Beyond: |F^(mK + r)| <=
    # powers[K]^m powers[r]
    powers: Floats
    # w_max: the sum over all j >= 0 of |F^j L| n_max + |F^j Z^T E| d_max, its tail bounded by a geometric
    # series: at most 1 / (1 - powers[K]) times the sum, and the sum is at most the paper's (eta_L n_max +
    # eta_Z d_max) / (1 - beta)
    limit: float

    def growth(self, steps: int) -> float:
        """Bound of |F^steps|_2."""
        whole, rest = divmod(steps, self.powers.size - 1)
        return float(self.powers[-1] ** whole * self.powers[rest])


@dataclass(frozen=True, slots=True, eq=False)
class LuenbergerDesign:
    """p partial observers, stacked. mu stacked states, p sensors, m inputs."""

    stack: StackedDecompositions  # the decomposition
    L: Floats  # (mu, p) injection gains, block diagonal
    F: Floats  # (mu, mu) S - L T, block diagonal and Schur stable
    bounds: Bounds  # disturbances and noise of the envelopes
    envelopes: tuple[ErrorEnvelope, ...]  # one for each sensor
    step_norm: Floats  # (p,) |S_i|_2: largest growth of an error in a step without a reading
    period: float  # sampling time, s


@dataclass(frozen=True, slots=True, eq=False)
class LuenbergerState:
    """State of the observers."""

    t: float  # time of the state that `z` estimates, s
    z: Floats  # (…, mu) stacked estimates; leading axes are independent runs
    origin: Floats  # (p,) bound of |z_i - Z_i^T x| at the last start of sensor i; infinite if unknown
    age: Ints  # (p,) steps since then


def riccati_gain(part: SensorDecomposition, process: Floats, noise: float, *, rate: float) -> Floats:
    """L of the stationary Kalman predictor, with a prescribed decay of the observable part.

    With rate 1 the Riccati equation is that of (S, t). Below 1 it is that of the observable block over
    `rate`, with an error decay of at least rate^k; fading modes keep their own decay and get no gain.

    process (n, n): weight (covariance) of d.
    noise: weight (variance) of n_i, > 0.
    rate: in (0, 1].
    Raises DesignInfeasible if there is no such gain: the process weight leaves a mode on or outside the
        circle of radius `rate` without disturbance. ValueError if `rate` is not in (0, 1].
    Source: B. Anderson, J. Moore, "Optimal filtering", Prentice-Hall, 1979, sections 4.4 and 6.3 (prescribed
        decay).
    """
    if not 0.0 < rate <= 1.0:
        raise InputInvalid.of("out-of-range", f"rate is {rate}; it must lie in (0, 1]")
    size = part.t.size if rate == 1.0 else part.observable.shape[1]
    gain = np.zeros(part.t.size)
    if not size:
        return gain
    basis = part.basis[:, :size]
    S, t = part.S[:size, :size] / rate, part.t[:size] / np.sqrt(noise)
    P = riccati(S, t, basis.T @ process @ basis, 1.0, tol=RESIDUAL)
    gain[:size] = rate * S @ P @ t / (t @ P @ t + 1.0) / np.sqrt(noise)
    closed = part.S[:size, :size] - np.outer(gain[:size], part.t[:size])
    require_stable(closed, f"observer gain for decay like {rate:g}^k", rate=rate)
    return gain


def design(
    A: Floats,
    B: Floats,
    C: Floats,
    bounds: Bounds,
    *,
    slowest: float,
    tol: float,
    gains: Literal["riccati"] | Sequence[Floats] = "riccati",
    rate: float = 1.0,
    period: float = 1.0,
) -> LuenbergerDesign:
    """Design one partial observer for each sensor.

    A (n, n), B (n, m), C (p, n).
    bounds: bounds of disturbance and noise; also the weights of the Riccati gains.
    slowest, tol: as in `decompose`.
    gains: "riccati": `riccati_gain` with weights `process^2 E E^T` and `noise^2`. Or L_i (mu_i,) for each
        sensor.
    rate: as in `riccati_gain`.
    period: sampling time, s.
    Raises DesignInfeasible if some F_i = S_i - L_i t_i is not Schur stable, or errors may not have halved for
        good after `LONGEST` steps. ValueError if shapes are inconsistent, a bound is negative or NaN, `gains`
        is another text, or "riccati" without noise.
    Source: lee2018 (4.3.1), (4.3.3), (4.3.7).
    """
    parts = decompose(A, C, slowest=slowest, tol=tol)
    E, noise = np.asarray(bounds.E, dtype=np.float64), np.asarray(bounds.noise, dtype=np.float64)
    if E.ndim != 2 or E.shape[0] != len(A) or noise.shape != (len(parts),):
        raise InputInvalid.of(
            "shape", f"E has shape {E.shape} and noise {noise.shape} for n = {len(A)}, p = {len(parts)}"
        )
    if not (bounds.process >= 0.0 and np.all(noise >= 0.0)):
        raise InputInvalid.of(
            "negative", "bounds of disturbance and noise must be numbers and cannot be negative"
        )
    if isinstance(gains, str):
        raise_if_any(no_choice("gains", ("riccati",), gains))
        weight = bounds.process**2 * E @ E.T
        if np.any(noise == 0.0):
            raise InputInvalid.of(
                "not-positive", 'gains="riccati" needs positive bounds of the noise; give the gains otherwise'
            )
        chosen = [
            riccati_gain(part, weight, float(size) ** 2, rate=rate)
            for part, size in zip(parts, noise, strict=True)
        ]
    else:
        chosen = [np.asarray(gain, dtype=np.float64) for gain in gains]
    if [gain.shape for gain in chosen] != [part.t.shape for part in parts]:
        raise InputInvalid.of("shape", f"gains must have the lengths {[part.t.size for part in parts]}")
    whole = stack(parts, B)
    L = np.zeros((whole.phi.shape[0], len(parts)))
    for i, gain in enumerate(chosen):
        L[whole.rows(i), i] = gain
    envelopes = tuple(
        envelope(part, gain, bounds.process, float(size), E)
        for part, gain, size in zip(parts, chosen, noise, strict=True)
    )
    step_norm = [float(np.linalg.norm(part.S, 2)) if part.t.size else 0.0 for part in parts]
    kept = Bounds(float(bounds.process), frozen(noise), frozen(E))
    return LuenbergerDesign(
        whole, frozen(L), frozen(whole.S - L @ whole.T), kept, envelopes, frozen(np.array(step_norm)), period
    )


def envelope(
    part: SensorDecomposition, gain: Floats, process: float, noise: float, E: Floats
) -> ErrorEnvelope:
    """Bound of one partial observer's error without attack.

    part, gain: the sensor's part and L_i (mu_i,).
    process, noise, E: as in `Bounds`, with the noise of this sensor.
    Raises DesignInfeasible as `design`.
    """
    F = part.S - np.outer(gain, part.t)
    require_stable(F, "partial observer, S - L t")
    if not part.t.size:
        return ErrorEnvelope(frozen(np.array([1.0, 0.0])), 0.0)
    powers, sizes = _powers(F)
    by_noise = np.linalg.norm(powers[:-1] @ gain, axis=1) * noise
    by_process = np.linalg.norm(powers[:-1] @ (part.basis.T @ E), 2, axis=(1, 2)) * process
    limit = float(np.sum(by_noise + by_process) / (1.0 - sizes[-1]))
    return ErrorEnvelope(frozen(sizes), limit)


def _powers(F: Floats) -> tuple[Floats, Floats]:
    """F^0 … F^K and their norms; K is the first power of two with |F^K| max_j |F^j| <= 1/2."""
    powers = np.stack([np.eye(len(F)), F])
    sizes = np.linalg.norm(powers, 2, axis=(1, 2))
    while sizes[-1] * sizes.max() > 0.5:
        if len(powers) > LONGEST:
            raise DesignInfeasible(
                "partial observer", f"errors may not have halved after {LONGEST} steps", code="not-converged"
            )
        more = powers[1:] @ powers[-1]
        powers = np.concatenate([powers, more])
        sizes = np.concatenate([sizes, np.linalg.norm(more, 2, axis=(1, 2))])
    return powers, sizes


def geometric(
    part: SensorDecomposition, gain: Floats, process: float, noise: float, E: Floats, *, beta: float
) -> ErrorEnvelope:
    """The paper's own bound, with the smallest constants eta_F, eta_L, eta_Z for a given beta.

    part, gain, process, noise, E: as in `envelope`.
    beta: between the spectral radius of F and 1.
    Returns `growth(k) = eta_F beta^k` and `limit = (eta_L n_max + eta_Z d_max) / (1 - beta)`.
    Raises DesignInfeasible if beta is too close to the spectral radius to find the constants in `LONGEST`
        steps. ValueError if beta is not between the spectral radius of F and 1.
    Source: lee2018 (4.3.7).
    """
    F = part.S - np.outer(gain, part.t)
    if not spectral_radius(F) < beta < 1.0:
        raise InputInvalid.of(
            "out-of-range", f"beta is {beta}; it must lie between {spectral_radius(F):.6g} and 1"
        )
    # |F^j M| beta^-j is largest within the first K powers: later ones are shorter than those K before.
    powers, sizes = _powers(F / beta)
    eta_f = float(sizes.max())
    eta_l = float(np.max(np.linalg.norm(powers @ gain, axis=1)))
    eta_z = float(np.max(np.linalg.norm(powers @ (part.basis.T @ E), 2, axis=(1, 2))))
    return ErrorEnvelope(frozen(np.array([eta_f, beta])), (eta_l * noise + eta_z * process) / (1.0 - beta))


def init(design: LuenbergerDesign, t: float, x: Floats, error: float = np.inf) -> LuenbergerState:
    """Initial state of all observers from a guess of the state.

    t: time, s.
    x (…, n): guess; leading axes are independent runs.
    error: bound of |guess - x|_2. Without it all bounds stay infinite.
    """
    p = len(design.stack.parts)
    # |Z_i^T| = 1 unless the part is empty.
    origin = np.array([error if part.t.size else 0.0 for part in design.stack.parts])
    return LuenbergerState(t, x @ design.stack.phi.T, origin, np.zeros(p, dtype=np.intp))


def step(
    design: LuenbergerDesign, state: LuenbergerState, y: Floats, u: Floats, seen: Bools | None = None
) -> LuenbergerState:
    """Step from z_hat(k), with the readings y(k) and the input u(k), to z_hat(k+1).

        z_hat_i(k+1) = S_i z_hat_i(k) + Z_i^T B u(k) + L_i (y_i(k) - t_i z_hat_i(k))

    y (…, p): readings; ignored where not seen or not finite. Runs share their bounds: a sensor without a
        reading in one run is not used in any.
    u (…, m): inputs.
    seen (p,): True for existing readings; all by default. An observer without a reading predicts, and the
        bound of its error restarts from the enlarged one.
    Source: lee2018 (4.3.1).
    """
    stack = design.stack
    live = heard(y, seen)
    if np.all(live):
        z = state.z @ design.F.T + y @ design.L.T + u @ stack.G.T
        return LuenbergerState(state.t + design.period, z, state.origin, state.age + 1)
    surprise = np.where(live, y - state.z @ stack.T.T, 0.0)
    z = state.z @ stack.S.T + surprise @ design.L.T + u @ stack.G.T
    pushed = design.bounds.process * float(np.linalg.norm(design.bounds.E, 2))
    grown = np.where(design.step_norm > 0.0, design.step_norm * bound(design, state) + pushed, 0.0)
    origin = np.where(live, state.origin, grown)
    return LuenbergerState(state.t + design.period, z, origin, np.where(live, state.age + 1, 0))


def bound(design: LuenbergerDesign, state: LuenbergerState) -> Floats:
    """Bound of |z_hat_i - Z_i^T x|_2 for every sensor without attack, (p,); the largest is v_max(k).

    Source: lee2018 (4.3.7).
    """
    out = np.empty(state.origin.size)
    for i, (env, origin, age) in enumerate(zip(design.envelopes, state.origin, state.age, strict=True)):
        # An unknown start stays unknown, even if the growth underflows to zero.
        out[i] = env.growth(int(age)) * origin + env.limit if np.isfinite(origin) else np.inf
    return out
