"""Circle-criterion observers: one set of trusted meters, one observer.

    x_hat' = A x_hat + G phi(zeta) + B u + L r,   zeta = H x_hat + F u + K r,   r = (y - C x_hat - D u)_J

Readings are held over a step. For any gains, the observer between two readings is itself a Lur'e system, with
`A - L C` and `H - K C` in the place of A and H. So one exponential integrator (and one equilibrium, for steps
far above every time constant) serves plant and observers. Everything is in z coordinates: `y = vbar^2 - v^2`.

Source: chong2020 (11), with G, B and the decay rate made explicit; docs/theory-observers.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen
from gridsec.errors import DesignInfeasible, InputInvalid, no_choice, raise_if_any
from gridsec.observers.certificates import Certificate, certify, error_bound, feeds
from gridsec.observers.gains import CircleGains, CircleOptions, margin, sensitivity, state_bound
from gridsec.observers.lmi import contraction, solve_many
from gridsec.observers.lure import POLICY, Lure, Matrices, StepPolicy, advance


@dataclass(frozen=True, slots=True, eq=False)
class CircleDesign:
    """One observer. n states, m nonlinearities, p meters."""

    lure: Lure  # plant
    trusted: Bools  # (p,) J as a mask
    L: Floats  # (n, p) gain into the state; zero columns for meters outside J
    K: Floats  # (m, p) gain into the arguments of the nonlinearities; zero columns likewise
    rate: float  # certified decay rate of the error without disturbances, 1/s, in `error_norm`
    # (p,) influence of each meter on the estimate, see `gains.sensitivity`. A trusted meter without an
    # inverter has 0 under direct injection: attacks on it appear in its output residual only
    sensitivity: Floats
    # the proof: for direct injection a `Certificate` of all trusted sets at once, otherwise the design by LMI
    # itself
    certificate: Certificate | CircleGains


@dataclass(frozen=True, slots=True, eq=False)
class CircleState:
    """State of an observer."""

    t: float  # time, s
    x: Floats  # (n,) estimated state


def direct_gain(lure: Matrices, trusted: Bools) -> Floats:
    """K of direct injection, (m, p): the inverter of a trusted meter is driven by that meter.

    `K = E_J`: `K_ij = 1` where the argument of nonlinearity i is the output of the trusted meter j;
    the first such meter where a customer has several. L is zero. `trusted` is (p,).
    """
    match = feeds(lure) & trusted
    K = np.zeros(match.shape)
    driven = np.flatnonzero(match.any(axis=1))
    K[driven, np.argmax(match[driven], axis=1)] = 1.0
    return K


def design(
    lure: Lure,
    trusted: Bools,
    *,
    gains: Literal["direct", "lmi"] | CircleGains = "direct",
    options: CircleOptions | None = None,
) -> CircleDesign:
    """Design one observer, with a verified proof.

    trusted (p,).
    gains: "direct": K = E_J, L = 0, proven for every J at once, in closed form or by `lmi.contraction`.
        "lmi": gains and proof by `lmi.circle`. Or an existing design; it is verified again.
    options: specification of an LMI design; required by "lmi".
    Raises DesignInfeasible if there is no certificate, or if the design uses no meter. ValueError if
        `trusted` has the wrong length, or contradicts the given design, or `gains` is another text.
    """
    trusted = meter_mask(trusted, len(lure.C))
    if isinstance(gains, str):
        raise_if_any(no_choice("gains", ("direct", "lmi"), gains))
    if gains == "direct":
        return _direct(lure, trusted, options)
    meters = np.flatnonzero(trusted)
    if isinstance(gains, CircleGains):
        made = gains
        require_meters(made.J, meters)
        held = margin(lure, made.J, made)
        if not held > 0.0:
            raise DesignInfeasible(
                f"observer of the meters {meters.tolist()}", "does not hold here", held, code="not-verified"
            )
        made = replace(made, margin=held)
    elif options is None:
        raise InputInvalid.of("missing", 'gains="lmi" needs options: gridsec.observers.lmi.options_for')
    else:
        made = solve_many(lure, [meters.tolist()], options, workers=1)[0]
    L, K = np.zeros((len(lure.A), len(trusted))), np.zeros((len(lure.slope), len(trusted)))
    L[:, made.J], K[:, made.J] = made.L, made.K
    heard = frozen(sensitivity(lure, L, K))
    return CircleDesign(lure, trusted, frozen(L), frozen(K), made.alpha, heard, made)


def meter_mask(trusted: Bools, meters: int) -> Bools:
    """Copy of `trusted` that is read-only; refused unless it is (p,) for p `meters`."""
    mask = np.array(trusted, dtype=np.bool_)
    if mask.shape != (meters,):
        raise InputInvalid.of("shape", f"trusted has shape {mask.shape}; the plant has {meters} meters")
    mask.flags.writeable = False
    return mask


def require_meters(J: Ints, meters: Ints) -> None:
    """Refuse a design for the meters J unless these are `meters`."""
    if sorted(J.tolist()) != meters.tolist():
        raise InputInvalid.of(
            "wrong-design", f"the design is for the meters {J.tolist()}, not {meters.tolist()}"
        )


def _direct(lure: Lure, trusted: Bools, options: CircleOptions | None) -> CircleDesign:
    K = direct_gain(lure, trusted)
    L = np.zeros((len(lure.A), len(trusted)))
    try:
        proof = certify(lure)
    except DesignInfeasible:
        if not np.isfinite(rate := _fallback_rate(lure, options)):
            raise
        proof = contraction(lure, rate=rate)
    heard = sensitivity(lure, L, K)
    return CircleDesign(lure, trusted, frozen(L), frozen(K), proof.rate, frozen(heard), proof)


def _fallback_rate(lure: Lure, options: CircleOptions | None) -> float:
    """Rate requested from the solver without a closed form; NaN if the plant is not a droop loop."""
    if lure.A.shape != lure.G.shape or not np.array_equal(lure.G, -lure.A):
        return np.nan
    return options.rate if options is not None else _MODEST * float(np.min(np.diagonal(lure.G)))


# Fraction of the slowest inverter's rate that the solver is asked to prove for direct injection.
_MODEST = 0.1


def error_norm(design: CircleDesign, e: Floats) -> Floats:
    """Norm of errors e (…, n) of the certified decay: `sqrt(e^T P e)`, or `max |e_i| / P_i` (small gain)."""
    P = design.certificate.P
    if P.ndim == 1:
        return np.asarray(np.max(np.abs(e) / P, axis=-1, initial=0.0))
    return np.asarray(np.sqrt(np.einsum("...i,ij,...j->...", e, P, e)))


def init(design: CircleDesign, t: float, x: Floats | None = None) -> CircleState:
    """Initial state at t, s; the estimate starts at x (n,), by default with all inverters at zero."""
    start = np.zeros(len(design.lure.A)) if x is None else np.array(x, dtype=np.float64)
    return CircleState(float(t), start)


def between_readings(design: CircleDesign, y: Floats, u: Floats, seen: Bools) -> tuple[Lure, Floats]:
    """Observer between two readings as a Lur'e system with a constant input.

    `A - L C` and `H - K C` with the columns of unseen meters removed; the input is
    `(c, b) = (F u + K (y - D u), B u + L (y - D u))`.

    y (p,): readings; arbitrary where unseen, also NaN.
    u (l,), seen (p,).
    Returns system, held: `system` with input (c, b) of length m + n, and that input.
    """
    lure = design.lure
    heard = np.asarray(seen, dtype=np.bool_) & design.trusted & np.isfinite(y)
    # Columns and readings are removed, not multiplied by zero: 0 * NaN is not zero.
    L, K = np.where(heard, design.L, 0.0), np.where(heard, design.K, 0.0)
    ahead = np.where(heard, y, 0.0) - np.where(heard, lure.D @ u, 0.0)
    n, m = len(lure.A), len(lure.slope)
    held = np.concatenate([lure.F @ u + K @ ahead, lure.B @ u + L @ ahead])
    pick = np.eye(m + n)
    system = Lure(
        A=lure.A - L @ lure.C,
        G=lure.G,
        H=lure.H - K @ lure.C,
        F=pick[:m],
        B=pick[m:],
        C=lure.C,
        D=np.zeros((len(lure.C), m + n)),
        slope=lure.slope,
        phi=lure.phi,
    )
    return system, held


def step(  # noqa: PLR0917  # the border that all observer families share
    design: CircleDesign,
    state: CircleState,
    y: Floats,
    u: Floats,
    seen: Bools,
    h: float,
    policy: StepPolicy = POLICY,
) -> CircleState:
    """Advance an observer over one step of any length.

    y (p,): readings `vbar^2 - v^2`, held over the step; ignored where unseen or not finite.
    u (l,): known input w, held over the step; finite.
    seen (p,): True for existing readings. The others have no influence: the observer runs on its model there.
    h: length of the step, s.
    Returns the state at `t + h`; never raises on data.
    """
    system, held = between_readings(design, y, u, seen)
    try:
        x = advance(system, state.x, held, h, policy)
    except DesignInfeasible:
        # No equilibrium found for a long step (possible only without a certificate for the remaining meters):
        # integrate through it.
        x = advance(system, state.x, held, h, replace(policy, settled=0.0))
    return CircleState(state.t + h, x)


def outputs(design: CircleDesign, state: CircleState, u: Floats) -> Floats:
    """Expected reading of every meter of the plant, trusted or not: `C x_hat + D u`, (p,)."""
    return np.asarray(design.lure.C @ state.x + design.lure.D @ u)


def margin_without(design: CircleDesign, silent: Ints) -> float:
    """Margin of the proof while some trusted meters are unavailable; the rate still holds if positive.

    Direct injection is proven for every set of meters, so its margin does not depend on them.

    silent (s,): meters without readings.
    """
    proof = design.certificate
    if isinstance(proof, CircleGains):
        return margin(design.lure, np.setdiff1d(proof.J, silent), proof)
    return proof.margin


def residual_bound(design: CircleDesign, y_error: Floats, u_error: Floats) -> Floats:
    """Largest distance of an unmanipulated meter from the settled observer's `outputs`.

    `|y - y_hat| <= |C e| + |D| |u - u_hat| + |n|`, with the ultimate bound on C e from the proof:
    the ellipsoid of the LMI, or the componentwise bounds of direct injection.

    y_error (p,): largest error of each meter, squared pu.
    u_error (l,): largest error of each entry of the known input.
    Returns (p,): infinite where the design gives no bound for such errors.
    """
    lure, proof = design.lure, design.certificate
    rest = np.abs(lure.D) @ u_error + y_error
    if isinstance(proof, CircleGains):
        return np.asarray(state_bound(proof, lure.C, *_sizes(proof, y_error, u_error)) + rest)
    bound = error_bound(lure, design.trusted, y_error, u_error, certificate=proof)
    return np.asarray(np.abs(lure.C) @ bound + rest)


def _sizes(gains: CircleGains, y_error: Floats, u_error: Floats) -> tuple[float, float]:
    """Largest norms of (n + a)_J / noise and of delta, for errors within a box."""
    own = y_error[gains.J]
    quiet = gains.noise == 0.0
    if np.any(own[quiet] > 0.0):
        return np.inf, np.inf
    noise = float(np.linalg.norm(own[~quiet] / gains.noise[~quiet]))
    # |delta| over the box |u_i| <= u_error_i is at most the sum over its edges, provided that
    # `load` spans every direction of the box.
    inverse = np.linalg.pinv(gains.load)
    box = np.diag(u_error)
    missed = np.max(np.abs(gains.load @ (inverse @ box) - box), initial=0.0)
    if missed > _REACH * np.max(u_error, initial=0.0):
        return noise, np.inf
    return noise, float(np.sum(np.linalg.norm(inverse, axis=0) * u_error))


# Largest relative part of a load error outside the span of `load` that counts as rounding.
_REACH = 1e-9
