"""Circle-criterion observers: one set of trusted meters, one observer.

    x_hat' = A x_hat + G phi(zeta) + B u + L r,   zeta = H x_hat + F u + K r,   r = (y - C x_hat - D u)_J

Readings are held over a step. Whatever the gains, the observer between two readings is itself a
Lur'e system, with `A - L C` and `H - K C` in the place of A and H, so that one exponential
integrator (and one equilibrium, for steps far above every time constant) serves plant and observers.

Everything is in z coordinates: `y = vbar^2 - v^2`.

References
----------
chong2020 (11), with G, B and the decay rate made explicit; docs/theory-observers.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen
from gridsec.certificates import Certificate, certify
from gridsec.errors import DesignInfeasible
from gridsec.gains import CircleGains, CircleOptions, margin, same_place, sensitivity, state_bound
from gridsec.lmi import circle
from gridsec.lure import POLICY, Lure, advance


@dataclass(frozen=True, slots=True, eq=False)
class CircleDesign:
    """One observer. n states, m nonlinearities, p meters.

    Attributes
    ----------
    lure
        Plant.
    trusted : (p,)
        J as a mask.
    L, K : (n, p), (m, p)
        Gains; the columns of meters outside J are zero.
    certificate
        Why its error decays.
    sensitivity : (p,)
        How strongly each meter moves the estimate, see `gains.sensitivity`. A trusted meter without
        an inverter has 0 under direct injection: its lies show in its output residual only.
    gains
        The design by LMI with its multipliers; None for direct injection.
    """

    lure: Lure
    trusted: Bools
    L: Floats
    K: Floats
    certificate: Certificate
    sensitivity: Floats
    gains: CircleGains | None


@dataclass(frozen=True, slots=True, eq=False)
class CircleState:
    """Where an observer stands.

    Attributes
    ----------
    t
        Time, s.
    x : (n,)
        Estimated state.
    """

    t: float
    x: Floats


def direct_gain(lure: Lure, trusted: Bools) -> Floats:
    """K of direct injection: the inverter of a trusted meter is driven by that meter.

    `K = E_J`: `K_ij = 1` where the argument of nonlinearity i is the output of the trusted meter j,
    by the rows of the matrices; the first such meter where a customer has several. L is zero.

    Parameters
    ----------
    lure
        Plant.
    trusted : (p,)
        J as a mask.

    Returns
    -------
    Floats
        (m, p).
    """
    meters = np.flatnonzero(trusted)
    match = same_place(lure, meters)
    K = np.zeros((len(lure.slope), len(trusted)))
    driven = np.flatnonzero(match.any(axis=1))
    K[driven, meters[np.argmax(match[driven], axis=1)]] = 1.0
    return K


def design(
    lure: Lure,
    trusted: Bools,
    *,
    gains: Literal["direct", "lmi"] | CircleGains = "direct",
    options: CircleOptions | None = None,
) -> CircleDesign:
    """Design one observer, with a proof that holds.

    Parameters
    ----------
    lure
        Plant.
    trusted : (p,)
        J as a mask.
    gains
        "direct": K = E_J, L = 0, proven in closed form for every J at once. "lmi": gains and proof
        by `lmi.circle`. Or a design that was made before; it is verified again.
    options
        What an LMI design is asked for; required by "lmi".

    Raises
    ------
    DesignInfeasible
        If there is no certificate, or if the design listens to no meter.
    ValueError
        If `trusted` has the wrong length, or contradicts the given design.
    """
    trusted = np.asarray(trusted, dtype=np.bool_)
    if trusted.shape != (len(lure.C),):
        raise ValueError(f"trusted has shape {trusted.shape}; the plant has {len(lure.C)} meters")
    if isinstance(gains, str) and gains == "direct":
        return _direct(lure, trusted)
    meters = np.flatnonzero(trusted)
    if isinstance(gains, CircleGains):
        made = gains
        if sorted(made.J.tolist()) != meters.tolist():
            raise ValueError(f"the design is for the meters {made.J.tolist()}, not {meters.tolist()}")
        held = margin(lure, made.J, made)
        if not held > 0.0:
            raise DesignInfeasible(f"observer of the meters {meters.tolist()}", "does not hold here", held)
        made = replace(made, margin=held)
    elif options is None:
        raise ValueError('gains="lmi" needs options: gridsec.lmi.options_for')
    else:
        made = circle(
            lure,
            meters,
            rate=options.rate,
            noise=options.noise,
            load=options.load,
            weight=options.weight,
            floor=options.floor,
        )
    return _from_gains(lure, trusted, made)


def _direct(lure: Lure, trusted: Bools) -> CircleDesign:
    K = direct_gain(lure, trusted)
    L = np.zeros((len(lure.A), len(trusted)))
    heard = sensitivity(lure, L, K)
    return CircleDesign(lure, _mask(trusted), frozen(L), frozen(K), certify(lure), frozen(heard), None)


def _from_gains(lure: Lure, trusted: Bools, made: CircleGains) -> CircleDesign:
    L, K = np.zeros((len(lure.A), len(trusted))), np.zeros((len(lure.slope), len(trusted)))
    L[:, made.J], K[:, made.J] = made.L, made.K
    heard = sensitivity(lure, L, K)
    return CircleDesign(lure, _mask(trusted), frozen(L), frozen(K), certificate_of(made), frozen(heard), made)


def _mask(trusted: Bools) -> Bools:
    out = np.array(trusted, dtype=np.bool_)
    out.flags.writeable = False
    return out


def certificate_of(gains: CircleGains) -> Certificate:
    """The proof of an LMI design in the form that all proofs share.

    From `V' <= -2 alpha V + mu |n / noise|^2 + mu_delta |delta|^2` the steady norm `sqrt(e^T P e)`
    is at most `sqrt(mu sum_j noise_j^-2 / (2 alpha))` per unit of the largest meter error, and
    `sqrt(mu_delta l / (2 alpha)) |load^-1|` per unit of the largest load error (infinite where
    `load` leaves some direction out, because nothing was proven for that direction).

    Parameters
    ----------
    gains
        A design whose margin is positive.
    """
    with np.errstate(divide="ignore"):
        meter = float(np.sqrt(gains.mu * np.sum(gains.noise**-2.0) / (2.0 * gains.alpha)))
    reach = np.sqrt(gains.mu_delta * len(gains.load) / (2.0 * gains.alpha))
    return Certificate(
        kind="lmi",
        P=gains.P,
        rate=gains.alpha,
        noise=meter,
        load=float(reach) * _stretch(gains.load),
        attack=meter,
        margin=gains.margin,
        status=f"corrected inequality (12) rebuilt and verified for the meters {gains.J.tolist()}",
    )


def _stretch(load: Floats) -> float:
    """Largest |delta| for one unit of |load @ delta| over the directions of the plant's input."""
    if len(load) == 0:
        return 0.0
    smallest = np.linalg.svd(load, compute_uv=False)
    complete = (
        load.shape[1] >= len(load) and smallest[-1] > len(load) * np.finfo(np.float64).eps * smallest[0]
    )
    return float(1.0 / smallest[-1]) if complete else np.inf


def init(design: CircleDesign, t: float, x: Floats | None = None) -> CircleState:
    """Start an observer.

    Parameters
    ----------
    design
        The observer.
    t
        Time, s.
    x : (n,)
        Where the estimate starts; by default all inverters at zero.
    """
    start = np.zeros(len(design.lure.A)) if x is None else np.array(x, dtype=np.float64)
    return CircleState(float(t), start)


def between_readings(design: CircleDesign, y: Floats, u: Floats, seen: Bools) -> tuple[Lure, Floats]:
    """The observer between two readings as a Lur'e system with a constant input.

    `A - L C` and `H - K C` with the columns of unseen meters removed; the input is
    `(c, b) = (F u + K (y - D u), B u + L (y - D u))`.

    Parameters
    ----------
    design
        The observer.
    y : (p,)
        Readings; where unseen, any value, also NaN.
    u : (l,)
        Known input.
    seen : (p,)
        Which readings exist.

    Returns
    -------
    system, held
        `system` with input (c, b) of length m + n, and that input.
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
    design: CircleDesign, state: CircleState, y: Floats, u: Floats, seen: Bools, h: float
) -> CircleState:
    """Advance an observer over one step of any length.

    Parameters
    ----------
    design
        The observer.
    state
        Where it stands.
    y : (p,)
        Readings `vbar^2 - v^2`, held over the step; ignored where unseen or not finite.
    u : (l,)
        Known input w, held over the step; finite.
    seen : (p,)
        Which readings exist. The rest has exactly no influence: the observer runs on its model there.
    h
        Length of the step, s.

    Returns
    -------
    CircleState
        At `t + h`. Never raises on data.
    """
    system, held = between_readings(design, y, u, seen)
    try:
        x = advance(system, state.x, held, h)
    except DesignInfeasible:
        # No equilibrium found for a long step (possible only without a certificate for the meters
        # that are left): then walk through it.
        x = advance(system, state.x, held, h, replace(POLICY, settled=0.0))
    return CircleState(state.t + h, x)


def outputs(design: CircleDesign, state: CircleState, u: Floats) -> Floats:
    """What every meter of the plant should read, `C x_hat + D u`; trusted or not.

    Parameters
    ----------
    design, state
        The observer.
    u : (l,)
        Known input.

    Returns
    -------
    Floats
        (p,), in z coordinates.
    """
    return np.asarray(design.lure.C @ state.x + design.lure.D @ u)


def margin_without(design: CircleDesign, silent: Ints) -> float:
    """Margin of the proof while some trusted meters are silent; positive: the rate still holds.

    Direct injection is proven for every set of meters, so its margin does not depend on them.

    Parameters
    ----------
    design
        The observer.
    silent : (s,)
        Meters without readings.
    """
    if design.gains is None:
        return design.certificate.margin
    return margin(design.lure, np.setdiff1d(design.gains.J, silent), design.gains)


def residual_bound(design: CircleDesign, y_error: Floats, u_error: Floats) -> Floats:
    """How far an honest meter can be from the settled observer's `outputs`.

    `|y - y_hat| <= |C e| + |D (u - u_hat)| + |n|`, with the ultimate bound on C e from the proof.

    Parameters
    ----------
    design
        The observer, by LMI.
    y_error : (p,)
        Largest error of each meter, squared pu.
    u_error : (l,)
        Largest error of each entry of the known input.

    Returns
    -------
    Floats
        (p,).
    """
    lure, gains = design.lure, design.gains
    if gains is None:
        raise ValueError("direct injection has componentwise bounds: gridsec.certificates.error_bound")
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = np.where(y_error[gains.J] == 0.0, 0.0, y_error[gains.J] / gains.noise)
    # |delta| over the box |u_i| <= u_error_i: no more than the sum over its edges.
    inverse = np.linalg.pinv(gains.load)
    delta = float(np.sum(np.linalg.norm(inverse, axis=0) * u_error))
    if not np.isfinite(_stretch(gains.load)) and np.any(u_error > 0.0):
        delta = np.inf
    error = state_bound(gains, lure.C, float(np.linalg.norm(noise)), delta)
    return np.asarray(error + np.abs(lure.D) @ u_error + y_error)
