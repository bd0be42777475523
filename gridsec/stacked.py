"""Circle-criterion observers with arbitrary gains, one for each sensor subset, as stacked arrays.

    x_J' = A x_J + G phi(zeta_J) + B u + L_J e_J,   zeta_J = H x_J + F u + K_J e_J,   e_J = y - C x_J - D u

with the columns of L_J and K_J outside J equal to zero. Direct injection is the special case L = 0 and
K_J = 1 from a meter to the inverters at its customer; `gridsec.slots` computes it faster.

References
----------
chong2020, equation (11).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.certificates import feeds
from gridsec.lure import Lure, StepPolicy, Transition, transition, unit

_QUOTIENT = 1e-7
_HALVINGS = 30
# Entries of the Jacobians that are solved together.
_NEWTON_ENTRIES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Stacked observer gains. o observers, n states, m nonlinearities, p meters.

    Attributes
    ----------
    L : (o, n, p)
        Output injection into the states; zero columns for meters outside an observer's set.
    K : (o, m, p)
        Output injection into the nonlinearities' arguments; likewise.
    """

    L: Floats
    K: Floats


def direct_gains(lure: Lure, masks: Bools) -> Gains:
    """Direct injection as explicit gains for subsets (o, p): L = 0, K = 1 to the inverters of a meter."""
    same = feeds(lure)
    # One meter drives an inverter, even if there are two.
    first = same & (np.cumsum(same, axis=1) == 1)
    return Gains(
        L=np.zeros((masks.shape[0], lure.A.shape[0], masks.shape[1])),
        K=first[None] * masks[:, None, :].astype(np.float64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class StackedState:
    """State of all observers at one time.

    Attributes
    ----------
    x : (o, n)
        Estimates.
    seen : (p,)
        Available meters of the last step.
    prepared
        Coefficients of the last step's length.
    """

    x: Floats
    seen: Bools
    prepared: Transition


def start(lure: Lure, gains: Gains, policy: StepPolicy) -> StackedState:
    """All observers at zero, with all meters available."""
    o, n, p = gains.L.shape
    return StackedState(np.zeros((o, n)), np.ones(p, dtype=np.bool_), transition(lure, 0.0, policy))


@dataclass(frozen=True, slots=True, eq=False)
class _Inputs:
    """Inputs of one step. Unseen meters have zero weight in every observer and a finite reading."""

    zeta: Floats  # (o, m) F u + K (y - D u)
    push: Floats  # (o, n) B u + L (y - D u)
    seen: Floats  # (p,) 1.0 or 0.0


def _inputs(lure: Lure, gains: Gains, y: Floats, u: Floats, seen: Bools) -> _Inputs:
    given = np.where(seen, y - lure.D @ u, 0.0)
    return _Inputs(lure.F @ u + gains.K @ given, lure.B @ u + gains.L @ given, seen.astype(np.float64))


def advance(
    lure: Lure,
    gains: Gains,
    state: StackedState,
    *,
    y: Floats,
    u: Floats,
    seen: Bools,
    h: float,
    policy: StepPolicy,
) -> StackedState:
    """All observers a time h later, under constant inputs.

    Parameters
    ----------
    y : (p,)
        Readings; arbitrary where not seen.
    u : (l,)
        Known input.
    seen : (p,)
        Available meters.
    h
        Length of the step, s.
    policy
        Accuracy of the time step.
    """
    inputs = _inputs(lure, gains, y, u, seen)
    prepared = state.prepared if state.prepared.h == h else transition(lure, h, policy)
    state = replace(state, seen=seen.copy(), prepared=prepared)
    if prepared.substeps == 0:
        return settle(lure, gains, state, y=y, u=u, seen=seen, policy=policy)

    def feedback(x: Floats) -> Floats:
        heard = (x @ lure.C.T) * inputs.seen
        zeta = x @ lure.H.T + inputs.zeta - _times(gains.K, heard)
        return np.asarray(lure.phi(zeta) @ lure.G.T + inputs.push - _times(gains.L, heard))

    x = state.x
    for _ in range(prepared.substeps):
        here = feedback(x)
        ahead = _linear(prepared.decay, x) + _linear(prepared.first, here)
        x = ahead + _linear(prepared.second, feedback(ahead) - here)
    return replace(state, x=x)


def settle(
    lure: Lure,
    gains: Gains,
    state: StackedState,
    *,
    y: Floats,
    u: Floats,
    seen: Bools,
    policy: StepPolicy,
) -> StackedState:
    """All observers in their equilibria, by a damped semismooth Newton method.

    Observers that do not converge keep their last iterate.
    """
    inputs = _inputs(lure, gains, y, u, seen)
    x = state.x.copy()
    n = x.shape[1]
    size = max(1, _NEWTON_ENTRIES // max(1, n * n))
    for i in range(0, x.shape[0], size):
        part = slice(i, i + size)
        C = lure.C * inputs.seen[:, None]
        H = lure.H - gains.K[part] @ C
        A = lure.A - gains.L[part] @ C
        x[part] = _newton(
            lure, x[part], A=A, H=H, zeta=inputs.zeta[part], push=inputs.push[part], policy=policy
        )
    return replace(state, x=x, seen=seen.copy())


def _newton(
    lure: Lure, x: Floats, *, A: Floats, H: Floats, zeta: Floats, push: Floats, policy: StepPolicy
) -> Floats:
    """Solve `A x + G phi(H x + zeta) + push = 0` for a batch of observers."""
    # In units of the state: divided by the open loop, as in `lure.equilibrium`.
    scale = np.abs(np.diagonal(lure.A))
    scale = np.where(scale > 0, scale, 1.0)
    tol = policy.tol * unit(lure.phi)

    def residual(now: Floats) -> Floats:
        phi = lure.phi(_times(H, now) + zeta)
        return np.asarray((_times(A, now) + phi @ lure.G.T + push) / scale)

    for _ in range(policy.max_iter):
        rest = residual(x)
        rough = np.abs(rest).max(axis=1, initial=0.0) > tol
        if not rough.any():
            break
        z = _times(H, x) + zeta
        width = _QUOTIENT * np.maximum(1.0, np.abs(z))
        slope = (lure.phi(z + width) - lure.phi(z - width)) / (2.0 * width)
        jacobian = (A + (lure.G * slope[:, None, :]) @ H) / scale[:, None]
        step = -_solve(jacobian, rest)
        length = rough.astype(np.float64)
        norm = np.linalg.norm(rest, axis=1)
        for _ in range(_HALVINGS):
            trial = np.linalg.norm(residual(x + length[:, None] * step), axis=1)
            worse = rough & (trial > (1.0 - 1e-4 * length) * norm)
            if not worse.any():
                break
            length = np.where(worse, 0.5 * length, length)
        x = x + length[:, None] * step
    return x


def _solve(matrices: Floats, rest: Floats) -> Floats:
    """`matrices[o]^-1 rest[o]` for every observer o, by least squares if a matrix is singular."""
    try:
        return np.asarray(np.linalg.solve(matrices, rest[..., None])[..., 0])
    except np.linalg.LinAlgError:
        # An observer with too little information about an integrator may have many equilibria or none.
        return _times(np.asarray(np.linalg.pinv(matrices), dtype=np.float64), rest)


def _times(matrices: Floats, x: Floats) -> Floats:
    """`matrices[o] @ x[o]` for every observer o."""
    return np.asarray((matrices @ x[..., None])[..., 0])


def _linear(matrix: Floats, x: Floats) -> Floats:
    """`matrix @ x`; a vector stands for a diagonal matrix."""
    return np.asarray(x * matrix if matrix.ndim == 1 else x @ matrix.T)
