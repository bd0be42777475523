"""Discrete-time circle-criterion observers: one observer, or a stack of them advanced at once.

    x_hat+ = A x_hat + G phi(zeta) + B u + L r,   zeta = H x_hat + F u + K r,   r = y - C x_hat - D u

with zero columns of L and K for meters outside the trusted set J. Every design has proven constants of

    |e(k)| <= c lambda^k |e(0)| + gamma sup |n_J| + gamma_delta sup |delta|          (yang2019 (5)).

`monte_carlo` simulates them as the paper does, with a statement on the validity of such numbers.

Source: yang2019, section II; docs/theory-discrete.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gridsec.arrays import Bools, Floats, frozen
from gridsec.errors import DesignInfeasible, InputInvalid, Problem, no_choice, raise_if_any
from gridsec.observers.circle import CircleState, direct_gain, meter_mask, require_meters
from gridsec.observers.lmi.discrete import (
    DiscreteGains,
    DiscreteOptions,
    direct_gain_bound,
    discrete_circle,
    discrete_margin,
    growth,
    noise_gain,
    unknown_gain,
)
from gridsec.observers.lmi.sampled import DiscreteLure, measure
from gridsec.observers.lmi.sampled import advance as advance_plant


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteDesign:
    """One observer. n states, m nonlinearities, p meters."""

    system: DiscreteLure  # plant
    trusted: Bools  # (p,) J as a mask
    L: Floats  # (n, p) gain into the state; zero columns for meters outside J
    K: Floats  # (m, p) gain into the arguments of the nonlinearities; zero columns likewise
    decay: float  # lambda, per step
    growth: float  # c
    noise_gain: float  # gamma, with respect to the Euclidean norm of the trusted meters' errors
    unknown_gain: float  # gamma_delta; for direct injection with respect to the error of the arguments z
    certificate: DiscreteGains  # the proof


def design(
    system: DiscreteLure,
    trusted: Bools,
    *,
    gains: Literal["lmi"] | DiscreteGains = "lmi",
    options: DiscreteOptions | None = None,
) -> DiscreteDesign:
    """Design one observer, with a verified proof.

    trusted (p,).
    gains: "lmi": by `discrete_circle`. Or an existing design, verified again; that of `discrete_contraction`,
        without meters, is the proof of direct injection for every set.
    options: specification of an LMI design; required by "lmi".
    Raises DesignInfeasible if there is no proof, or the given one does not hold here. ValueError if `trusted`
        has the wrong length, or contradicts the given design, or `gains` is another text.
    """
    trusted = meter_mask(trusted, len(system.C))
    if isinstance(gains, str):
        raise_if_any(no_choice("gains", ("lmi",), gains))
    meters = np.flatnonzero(trusted)
    if isinstance(gains, DiscreteGains):
        made = gains
        if made.J.size:
            require_meters(made.J, meters)
        held = discrete_margin(system, made.J, made)
        if not held > 0.0:
            what = f"discrete observer of the meters {meters.tolist()}"
            raise DesignInfeasible(what, "does not hold here", held, code="not-verified")
    elif options is None:
        raise InputInvalid.of(
            "missing", 'gains="lmi" needs options: gridsec.observers.lmi.discrete.discrete_options'
        )
    else:
        made = discrete_circle(system, meters, options)
    if not made.J.size:
        return _direct(system, trusted, made)
    L, K = np.zeros((len(system.A), trusted.size)), np.zeros((len(system.lower), trusted.size))
    L[:, made.J], K[:, made.J] = made.L, made.K
    bounds = (made.decay, growth(made), noise_gain(made), unknown_gain(made))
    return DiscreteDesign(system, trusted, frozen(L), frozen(K), *bounds, made)


def _direct(system: DiscreteLure, trusted: Bools, proof: DiscreteGains) -> DiscreteDesign:
    n, m = len(system.A), len(system.lower)
    L, K = np.zeros((n, trusted.size)), direct_gain(system, trusted)
    noise, unknown = (direct_gain_bound(system, proof, rows) for rows in (K, np.eye(m)))
    bounds = (proof.decay, growth(proof), noise, unknown)
    return DiscreteDesign(system, trusted, frozen(L), frozen(K), *bounds, proof)


def init(design: DiscreteDesign, t: float, x: Floats | None = None) -> CircleState:
    """Initial state at t, s; the estimate starts at x (n,), by default at zero."""
    start = np.zeros(len(design.system.A)) if x is None else np.array(x, dtype=np.float64)
    return CircleState(float(t), start)


def step(design: DiscreteDesign, state: CircleState, y: Floats, u: Floats, seen: Bools) -> CircleState:
    """One step of one observer.

    y (p,): readings at the beginning of the step; ignored where unseen or not finite.
    u (l,): known input during the step.
    seen (p,): True for existing readings. The others have no influence.
    """
    x = _ahead(design.system, design.L, design.K, state.x, y=y, u=u, seen=seen)
    return CircleState(state.t + design.system.h, x)


def outputs(design: DiscreteDesign, state: CircleState, u: Floats) -> Floats:
    """Expected reading of every meter of the plant, trusted or not: `C x_hat + D u`, (p,)."""
    return measure(design.system, state.x, u)


def error_bound(design: DiscreteDesign, k: int, *, start: float, noise: float, unknown: float = 0.0) -> float:
    """Right side of yang2019 (5) after k steps.

    start: |e(0)|.
    noise: supremum of the Euclidean norm of the trusted meters' errors (attacks included).
    unknown: supremum of the Euclidean norm of delta, or of the arguments' errors for direct injection.
    """
    first = design.growth * design.decay**k * start
    return first + design.noise_gain * noise + design.unknown_gain * unknown


def settling_steps(design: DiscreteDesign, *, start: float, epsilon: float) -> int:
    """Smallest k with `c lambda^k |e(0)| <= epsilon`: k* of yang2019.

    start: bound on |e(0)|; 0 for a start in the true state.
    epsilon: its largest remainder.
    Raises ValueError if `epsilon` is not positive and the start is not the true state.
    """
    if design.growth * start <= epsilon:
        return 0
    if epsilon <= 0.0:
        raise InputInvalid.of(
            "not-positive", "epsilon must be positive unless the observers start in the true state"
        )
    return int(np.ceil(np.log(epsilon / (design.growth * start)) / np.log(design.decay)))


@dataclass(frozen=True, slots=True, eq=False)
class StackedObservers:
    """Several observers of one plant, on a leading axis. o observers."""

    system: DiscreteLure  # plant
    masks: Bools  # (o, p) trusted sets
    L: Floats  # (o, n, p) gains
    K: Floats  # (o, m, p)


def stack(designs: Sequence[DiscreteDesign]) -> StackedObservers:
    """Observers of one plant as stacked arrays; ValueError if they belong to different plants."""
    if any(one.system is not designs[0].system for one in designs):
        raise InputInvalid.of("wrong-design", "the observers belong to different plants")
    return StackedObservers(
        designs[0].system,
        np.stack([one.trusted for one in designs]),
        frozen(np.stack([one.L for one in designs])),
        frozen(np.stack([one.K for one in designs])),
    )


def advance(stack: StackedObservers, x: Floats, y: Floats, u: Floats, seen: Bools) -> Floats:
    """One step of all observers.

    x (…, o, n): their estimates.
    y (…, p): readings; ignored where unseen or not finite.
    u (…, l), seen (p,).
    Returns (…, o, n): estimates one step later.
    """
    y, u = np.asarray(y)[..., None, :], np.asarray(u)[..., None, :]
    return _ahead(stack.system, stack.L, stack.K, x, y=y, u=u, seen=seen)


def _ahead(
    system: DiscreteLure, L: Floats, K: Floats, x: Floats, *, y: Floats, u: Floats, seen: Bools
) -> Floats:
    """The observer equation, for one observer or for a stack with a leading axis of gains."""
    r = np.where(seen & np.isfinite(y), y - measure(system, x, u), 0.0)[..., None]
    zeta = x @ system.H.T + u @ system.F.T + (K @ r)[..., 0]
    pushed = x @ system.A.T + system.phi(zeta) @ system.G.T + u @ system.B.T
    return np.asarray(pushed + (L @ r)[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class MonteCarlo:
    """Gains by simulation: the largest observed ones, lower bounds of the true gains."""

    # (o,) `max |e_J(k)| / sup_{j < k} |n_J(j)|` over all runs and steps, starting from e(0) = 0
    gains: Floats
    runs: int  # number of independent runs
    # with the stated confidence, one more run of the same kind exceeds a given entry of `gains` with at most
    # this probability: `1 - (1 - confidence)^(1 / runs)`. It does not cover noise of another kind; see
    # docs/theory-discrete.md, section 4
    exceedance: float
    confidence: float  # requested confidence


def monte_carlo(
    stack: StackedObservers,
    *,
    half_width: Floats | float,
    start: Floats,
    u: Floats,
    seed: int,
    confidence: float = 0.99,
) -> MonteCarlo:
    """ISS gains with respect to noise by simulation, as in yang2019's example.

    Noise is independent and uniform between plus and minus `half_width`; every observer starts in the
    plant's state.

    half_width (p,) or scalar: half-width of each meter's noise.
    start (R, n): initial states, one for each run.
    u (T, l): known input of the T steps.
    confidence: confidence of `exceedance`.
    Raises ValueError with every number out of range; an observer without noisy meters has no gain.
    """
    system, rng = stack.system, np.random.default_rng(seed)
    runs, p = len(start), len(system.C)
    width = np.broadcast_to(np.asarray(half_width, dtype=np.float64), (p,))
    problems = []
    if not (runs and 0.0 < confidence < 1.0):
        problems.append(Problem("out-of-range", "at least one run, and a confidence between 0 and 1"))
    if not np.all(np.isfinite(width) & (width >= 0.0)):
        problems.append(
            Problem("negative", f"half_width must be finite and not negative, got {width.tolist()}")
        )
    elif not np.all(stack.masks @ width > 0.0):
        problems.append(
            Problem(
                "not-positive",
                "every observer needs a meter with noise: half_width is 0 for all meters of some observer",
            )
        )
    raise_if_any(problems)
    everyone, truth = np.ones(p, dtype=np.bool_), np.asarray(start, dtype=np.float64)
    x = np.repeat(truth[:, None, :], len(stack.masks), axis=1)
    loudest, worst = np.zeros((runs, len(stack.masks))), np.zeros(len(stack.masks))
    for now in u:
        noise = rng.uniform(-width, width, (runs, p))
        loudest = np.maximum(loudest, np.linalg.norm(noise[:, None] * stack.masks, axis=-1))
        x = advance(stack, x, measure(system, truth, now) + noise, now, everyone)
        truth = advance_plant(system, truth, now)
        size = np.linalg.norm(x - truth[:, None], axis=-1)
        worst = np.maximum(worst, np.max(size / loudest, axis=0))
    exceedance = 1.0 - (1.0 - confidence) ** (1.0 / runs)
    return MonteCarlo(worst, runs, float(exceedance), confidence)
