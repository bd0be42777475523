"""Partial Kalman filters: one filter per sensor, with the covariances between all of them.

The filters do not exchange data, but one disturbance drives all of them and noise may be common, so
their errors are correlated. Fusion and comparison need the joint covariance

    P = E[v v^T],    z_hat = Phi x + v + e,

with all blocks P_ij. One recursion gives all blocks at once: with S, T and K block diagonal,

    P(k+1|k)   = S P(k|k) S^T + Phi Q Phi^T
    P(k+1|k+1) = (I - K T) P(k+1|k) (I - K T)^T + K R K^T,

with the usual covariances as diagonal blocks, because each K_i is optimal for its own sensor.

Source: lee2018, section 4.3.2; docs/theory-partial-observers.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, solve_discrete_lyapunov

from gridsec.arrays import Bools, Floats, frozen, symmetry_defect
from gridsec.errors import Problem, raise_if_any
from gridsec.observers.parts import StackedDecompositions, decompose, heard, require_stable, riccati, stack

RESIDUAL = 1e-8
"""Largest accepted relative residual of a Riccati equation."""


@dataclass(frozen=True, slots=True, eq=False)
class KalmanDesign:
    """p partial filters, stacked. mu stacked states, p sensors, m inputs."""

    stack: StackedDecompositions  # the decomposition
    process: Floats  # (mu, mu) Phi Q Phi^T, covariance of the disturbance of the filters
    noise: Floats  # (p, p) R, covariance of the sensors' noise; need not be diagonal
    own: Floats  # (mu, p) 1 where a row belongs to a sensor, else 0
    period: float  # sampling time, s


@dataclass(frozen=True, slots=True, eq=False)
class KalmanState:
    """State of the filters."""

    t: float  # time of the state that `z` estimates, s
    z: Floats  # (…, mu) stacked estimates; leading axes are independent runs with the same covariance
    P: Floats  # (mu, mu) joint covariance of their errors without attack
    K: Floats  # (mu, p) gain of the last correction; zero for sensors without a reading


@dataclass(frozen=True, slots=True, eq=False)
class Steady:
    """Stationary covariance and gain with every reading available."""

    P: Floats  # (mu, mu) P(k|k) for k to infinity
    K: Floats  # (mu, p) gain, block diagonal
    F: Floats  # (mu, mu) (I - K T) S, Schur stable: motion of the errors


def design(
    A: Floats,
    B: Floats,
    C: Floats,
    Q: Floats,
    R: Floats,
    *,
    slowest: float,
    tol: float,
    period: float = 1.0,
) -> KalmanDesign:
    """Design one filter for each sensor.

    A (n, n), B (n, m), C (p, n).
    Q (n, n), R (p, p): covariances of disturbance and noise, symmetric and positive semidefinite.
    slowest, tol: as in `parts.decompose`.
    period: sampling time, s.
    Raises ValueError if Q or R has the wrong shape or is not a covariance.
    Source: lee2018, Assumption 4.3.3, (4.3.8), (4.3.9).
    """
    Q, R = np.asarray(Q, dtype=np.float64), np.asarray(R, dtype=np.float64)
    problems: list[Problem] = []
    for name, M, size in (("Q", Q, len(A)), ("R", R, len(C))):
        if M.shape != (size, size):
            problems.append(Problem("shape", f"{name} has shape {M.shape}; ({size}, {size}) is needed"))
            continue
        scale = float(np.max(np.abs(M), initial=0.0))
        if not np.all(np.isfinite(M)):
            problems.append(Problem("not-finite", f"{name} is not finite"))
        elif not symmetry_defect(M) <= 1e-12 or float(np.linalg.eigvalsh(M)[0]) < -1e-12 * scale:
            problems.append(
                Problem(
                    "not-definite", f"{name} is not a covariance: not symmetric, or not positive semidefinite"
                )
            )
    raise_if_any(problems)
    whole = stack(decompose(A, C, slowest=slowest, tol=tol), B)
    own = block_diag(*(np.ones((part.t.size, 1)) for part in whole.parts))
    process = whole.phi @ Q @ whole.phi.T
    return KalmanDesign(whole, frozen(0.5 * (process + process.T)), frozen(R), frozen(own), period)


def init(design: KalmanDesign, t: float, mean: Floats, covariance: Floats) -> KalmanState:
    """State before the first reading: z(0|-1) = Phi x_0, P(0|-1) = Phi P_0 Phi^T.

    t: time, s.
    mean (…, n): expected state; leading axes are independent runs.
    covariance (n, n): P_0, covariance of the state.
    Source: lee2018, after (4.3.9).
    """
    phi = design.stack.phi
    P = phi @ np.asarray(covariance) @ phi.T
    return KalmanState(t, mean @ phi.T, 0.5 * (P + P.T), np.zeros(design.own.shape))


def predict(design: KalmanDesign, state: KalmanState, u: Floats) -> KalmanState:
    """Prediction from (k|k) to (k+1|k), with the input u (…, m); lee2018 (4.3.9b), (4.3.9d), (4.3.15)."""
    S, G = design.stack.S, design.stack.G
    P = S @ state.P @ S.T + design.process
    return KalmanState(state.t + design.period, state.z @ S.T + u @ G.T, P, state.K)


def correct(design: KalmanDesign, state: KalmanState, y: Floats, seen: Bools | None = None) -> KalmanState:
    """Correction from (k|k-1) to (k|k): each filter uses its own sensor's reading.

    y (…, p): readings; ignored where not seen or not finite. Runs share their covariance: a sensor without a
        reading in one run is not used in any.
    seen (p,): True for existing readings; all by default.
    Source: lee2018 (4.3.9a), (4.3.9c), (4.3.9e), (4.3.15), all blocks of P in Joseph's form.
    """
    T, R = design.stack.T, design.noise
    M = (state.P @ T.T) * design.own
    s = np.einsum("im,mi->i", T, M) + np.diagonal(R)
    use = (s > 0.0) & heard(y, seen)
    K = M * np.where(use, 1.0 / np.where(use, s, 1.0), 0.0)
    J = np.eye(len(K)) - K @ T
    P = J @ state.P @ J.T + K @ R @ K.T
    surprise = np.where(use, y - state.z @ T.T, 0.0)
    return KalmanState(state.t, state.z + surprise @ K.T, 0.5 * (P + P.T), K)


def step(
    design: KalmanDesign, state: KalmanState, y: Floats, u: Floats, seen: Bools | None = None
) -> KalmanState:
    """Step from (k|k) to (k+1|k+1), with the input u(k) and the readings y(k+1).

    y (…, p): readings at the end of the step; ignored where not seen or not finite.
    u (…, m). seen (p,): as in `correct`.
    Source: lee2018 (4.3.8).
    """
    return correct(design, predict(design, state, u), y, seen)


def step_steady(
    design: KalmanDesign, steady: Steady, state: KalmanState, y: Floats, u: Floats
) -> KalmanState:
    """`step` with the gain and covariance of `steady`; every reading must be available."""
    z = state.z @ design.stack.S.T + u @ design.stack.G.T
    z = z + (y - z @ design.stack.T.T) @ steady.K.T
    return KalmanState(state.t + design.period, z, steady.P, steady.K)


def steady(design: KalmanDesign) -> Steady:
    """Stationary gain and joint covariance.

    The gains solve one Riccati equation for each sensor, the joint covariance one Lyapunov equation.

    Raises DesignInfeasible if a filter has no stable stationary gain: a mode on the unit circle has no
        disturbance.
    Source: lee2018 (4.3.14), (4.3.15).
    """
    whole = design.stack
    gains = np.zeros(design.own.shape)
    for i, part in enumerate(whole.parts):
        if not part.t.size:
            continue
        at = whole.rows(i)
        M = riccati(part.S, part.t, design.process[at, at], float(design.noise[i, i]), tol=RESIDUAL)
        gains[at, i] = M @ part.t / (part.t @ M @ part.t + design.noise[i, i])
    J = np.eye(len(gains)) - gains @ whole.T
    F = J @ whole.S
    require_stable(F, "stationary filters")
    P = np.asarray(
        solve_discrete_lyapunov(F, J @ design.process @ J.T + gains @ design.noise @ gains.T),
        dtype=np.float64,
    )
    return Steady(frozen(0.5 * (P + P.T)), frozen(gains), frozen(F))
