"""Design of discrete-time unknown-input observers by linear matrix inequalities.

An observer that is decoupled from its unknown inputs has the error system

    e+ = (M - K C) e + S psi + W w + K N n,     |psi_i| <= half_i |(H e)_i|

and `unknown_input` finds the K, with its proof, for which the error contracts by `rate` at every step,
for any nonlinearity within its bounds, with the smallest effect of `(w, n)`. The proof is the
quadratic `V = e^T P e` with

    V+ <= rate^2 V + mu (|w|^2 + |n|^2).

The inequality is rebuilt in NumPy before a design leaves this module.

Source: yang2021 (33) to (36); Witczak, Korbicz, Puig, "An LMI approach to designing observers and unknown
input observers for nonlinear systems", 2006. Derivation: docs/theory-unknown-input.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from gridsec.arrays import Floats, frozen
from gridsec.errors import InputInvalid, Problem, no_choice, raise_if_any
from gridsec.observers.lmi.solver import cvxpy_late, first_proven, solve

Multiplier = Literal["diagonal", "scalar"]

# Slack of the scaled inequality, with entries of order one: a hundred times the solver's tolerance.
_SLACK = 1e-6
# Relaxations of mu tried, in order, if the rebuilt inequality is violated.
_BACKOFF = (0.0, 1e-3, 1e-2, 1e-1)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSystem:
    """Error of an unknown-input observer without its gain. n states, m bounds, k sensors.

    Raises ValueError if shapes are inconsistent, an error scale is not positive, or a half-width negative.
    """

    M: Floats  # (n, n) error map without gain, at the middle of the slopes
    S: Floats  # (n, m) input matrix of psi, the rest of the nonlinearity
    H: Floats  # (m, n) argument matrix of psi
    # (m,) half-width of the slopes: `|psi_i| <= half_i |(H e)_i|`. With the "scalar" multiplier: `|psi| <=
    # |half * H e|`, which is yang2021 (34) for H = I and half = gamma
    half: Floats
    C: Floats  # (k, n) the sensors' rows
    # (n, d) input matrix of errors of size one that the gain does not weigh: next readings, drift of the
    # plant
    W: Floats
    N: Floats  # (k,) size of the error of each sensor's reading, positive

    def __post_init__(self) -> None:
        for name in ("M", "S", "H", "half", "C", "W", "N"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        n, m, k, d = len(self.M), self.half.size, self.N.size, self.W.shape[-1]
        wanted = {"M": (n, n), "S": (n, m), "H": (m, n), "half": (m,), "C": (k, n), "W": (n, d), "N": (k,)}
        wrong = [
            Problem("shape", f"{name} has shape {getattr(self, name).shape}; expected {shape}")
            for name, shape in wanted.items()
            if getattr(self, name).shape != shape
        ]
        raise_if_any(wrong)
        if not np.all(self.N > 0.0):
            raise InputInvalid.of("not-positive", "every sensor must have a positive error scale N")
        if np.any(self.half < 0.0):
            raise InputInvalid.of("negative", "half-widths of slopes cannot be negative")


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputGains:
    """A gain with its proof. n states, m bounds, k sensors."""

    K: Floats  # (n, k) gain from the sensors' residuals
    P: Floats  # (n, n) `V = e^T P e`
    # (m,) multiplier of the bounds on the nonlinearity; all entries equal for the "scalar" one
    Lambda: Floats
    mu: float  # `V+ <= rate^2 V + mu (|w|^2 + |n|^2)`
    rate: float  # certified contraction of sqrt(V) per step
    margin: float  # margin of the rebuilt inequality, see `unknown_input_margin`; it holds if positive
    status: str  # status of the solver; not a proof


def unknown_input_matrix(system: ErrorSystem, gains: UnknownInputGains) -> Floats:
    """The design inequality as a plain matrix: it holds if the largest eigenvalue is not positive.

    With `Mc = M - K C`, `J = [Mc, S, W, K N]` and `T = (half H)^T Lambda (half H)`, the matrix is

        J^T P J + blockdiag(T - rate^2 P, -Lambda, -mu I, -mu I),

    the increment of V minus its bound, plus the multiplier times `|half H e|^2 - |psi|^2 >= 0`. Without a
    Schur complement, this is the statement itself, not the form given to the solver.

    Returns (n + m + d + k, n + m + d + k): symmetric.
    """
    s, g = system, gains
    n, m, d, k = len(s.M), s.half.size, s.W.shape[1], s.N.size
    jump = np.hstack([s.M - g.K @ s.C, s.S, s.W, g.K * s.N])
    out = np.asarray(jump.T @ g.P @ jump)
    sector = s.half[:, None] * s.H
    out[:n, :n] += sector.T @ (g.Lambda[:, None] * sector) - g.rate**2 * g.P
    out[n : n + m, n : n + m] -= np.diag(g.Lambda)
    out[n + m :, n + m :] -= g.mu * np.eye(d + k)
    return 0.5 * (out + out.T)


def unknown_input_margin(system: ErrorSystem, gains: UnknownInputGains) -> float:
    """Margin of the design inequality; proven if positive.

    Smallest eigenvalue of the negated matrix, with rows and columns scaled by its subtracted diagonal terms
    (rate^2 P, Lambda, mu), so that units have no effect. Negative infinity if P is not positive definite or a
    multiplier is negative. Bounds of half-width zero do not count: their psi is zero.

    system, gains: as in `unknown_input_matrix`.
    """
    live = system.half > 0.0
    lowest = float(np.min(np.linalg.eigvalsh(gains.P)))
    if not (lowest > 0.0 and gains.mu >= 0.0 and np.all(gains.Lambda[live] > 0.0)):
        return -np.inf
    n, m = len(system.M), system.half.size
    keep = np.concatenate([np.ones(n, bool), live, np.ones(system.W.shape[1] + system.N.size, bool)])
    size = np.concatenate(
        [
            gains.rate**2 * np.diagonal(gains.P),
            gains.Lambda,
            np.full(keep.size - n - m, gains.mu if gains.mu > 0.0 else 1.0),
        ]
    )[keep]
    scale = 1.0 / np.sqrt(size)
    matrix = unknown_input_matrix(system, gains)[np.ix_(keep, keep)]
    return float(-np.max(np.linalg.eigvalsh(scale[:, None] * matrix * scale)))


class UnknownInputTemplate:
    """The scaled inequality for error systems of one shape, canonicalised once and solved for several.

    Units: readings in their error scales N, states in the change that moves the readings by one such unit,
    psi_i in its largest value for an error of one unit. All entries are then of order one.

    states, sensors, bounds: n, k, and the number of bounds with a half-width above zero.
    multiplier: "diagonal": every nonlinearity has a bound of its own. "scalar": one bound of their norm, the
        Lipschitz condition (34) of yang2021; it proves less.
    Raises ValueError if `multiplier` is unknown.
    """

    def __init__(self, states: int, sensors: int, bounds: int, multiplier: Multiplier) -> None:
        raise_if_any(no_choice("multiplier", get_args(Multiplier), multiplier))
        cp = cvxpy_late()
        n, k, m = states, sensors, bounds
        self.shape = (n, k, m)
        self.M, self.C, self.W = cp.Parameter((n, n)), cp.Parameter((k, n)), cp.Parameter((n, n))
        self.square = cp.Parameter(nonneg=True)
        P, Y, mu = cp.Variable((n, n), symmetric=True), cp.Variable((n, k)), cp.Variable()
        PM, PW = P @ self.M - Y @ self.C, P @ self.W
        rows: list[list[Any]] = [
            [-self.square * P, np.zeros((n, n)), np.zeros((n, k)), PM.T],
            [np.zeros((n, n)), -mu * np.eye(n), np.zeros((n, k)), PW.T],
            [np.zeros((k, n)), np.zeros((k, n)), -mu * np.eye(k), Y.T],
            [PM, PW, Y, -P],
        ]
        constraints = [P >> np.eye(n)]
        self.S = self.sector = lam = None
        if m:
            self.S = cp.Parameter((n, m))
            # One matrix per bound, flattened: a parameter times a variable stays affine in both.
            self.sector = cp.Parameter((n * n, m))
            one = cp.Variable()
            lam = cp.Variable(m) if multiplier == "diagonal" else one * np.ones(m)
            rows[0][0] = rows[0][0] + cp.reshape(self.sector @ lam, (n, n), order="C")
            PS = P @ self.S
            for row, block in zip(
                rows, (np.zeros((n, m)), np.zeros((n, m)), np.zeros((k, m)), PS), strict=True
            ):
                row.insert(1, block)
            middle = [np.zeros((m, n)), -cp.diag(lam), np.zeros((m, n)), np.zeros((m, k)), PS.T]
            rows.insert(1, middle)
        size = 3 * n + m + k
        constraints.append(cp.bmat(rows) << -_SLACK * np.eye(size))
        self.problem = cp.Problem(cp.Minimize(mu), constraints)
        self.variables = (P, Y, mu, lam)

    def solve(self, system: ErrorSystem, rate: float, what: str) -> UnknownInputGains:
        """Design for one error system, verified.

        system: the error system, of the shape of this template.
        rate: required contraction, in (0, 1).
        Raises DesignInfeasible if the inequality has no solution, or is violated when rebuilt. ValueError if
            the rate is not inside (0, 1).
        """
        if not 0.0 < rate < 1.0:
            raise InputInvalid.of(
                "out-of-range", f"the rate is {rate:g}; it is a contraction per step, between 0 and 1"
            )
        live = system.half > 0.0
        x = state_units(system)
        psi = system.half[live] * np.linalg.norm(system.H[live] * x, axis=1)
        psi = np.where(psi > 0.0, psi, 1.0)
        self.M.value = system.M * x / x[:, None]
        self.C.value = system.C * x / system.N[:, None]
        left, spread, _ = np.linalg.svd(system.W / x[:, None], full_matrices=False)
        full = np.zeros((x.size, x.size))
        full[:, : spread.size] = left * spread
        self.W.value = full
        self.square.value = rate**2
        if self.S is not None and self.sector is not None:
            self.S.value = system.S[:, live] * psi / x[:, None]
            bound = system.half[live, None] * system.H[live] * x / psi[:, None]
            self.sector.value = np.einsum("ma,mb->abm", bound, bound).reshape(x.size**2, -1)
        solve(self.problem, what)
        P, Y, mu = (np.asarray(v.value, dtype=np.float64) for v in self.variables[:3])
        Lambda = np.zeros(system.half.size)
        if self.variables[3] is not None:
            Lambda[live] = np.asarray(self.variables[3].value, dtype=np.float64) / psi**2
        found = UnknownInputGains(
            K=frozen(np.linalg.solve(P, Y) * x[:, None] / system.N),
            P=frozen(0.5 * (P + P.T) / x[:, None] / x),
            Lambda=frozen(Lambda),
            mu=float(mu),
            rate=rate,
            margin=np.nan,
            status=str(self.problem.status),
        )
        tries = (replace(found, mu=found.mu * (1.0 + part)) for part in _BACKOFF)
        made, held = first_proven(
            tries, lambda tried: unknown_input_margin(system, tried), what, found.status
        )
        return replace(made, margin=held)


def state_units(system: ErrorSystem) -> Floats:
    """Unit of each state, (n,): change that moves the readings by one error scale; 1 for unread states."""
    heard = np.linalg.norm(system.C / system.N[:, None], axis=0)
    deaf = heard <= _DEAF * np.max(heard, initial=0.0)
    loudest = np.max(heard, initial=0.0)
    return np.asarray(1.0 / np.where(deaf, loudest if loudest > 0.0 else 1.0, heard))


# Relative reading below which a state has no unit of its own.
_DEAF = 1e-6


def unknown_input(
    system: ErrorSystem,
    *,
    rate: float,
    multiplier: Multiplier = "diagonal",
    what: str = "unknown-input observer",
) -> UnknownInputGains:
    """Design the gain of one unknown-input observer.

    Minimises mu over (P, P K, Lambda) with `P >= I` in scaled coordinates, subject to the inequality in
    the module's head.

    rate: required contraction of sqrt(V) per step, in (0, 1).
    multiplier: see `UnknownInputTemplate`.
    Raises DesignInfeasible if there is no such gain, or the rebuilt inequality is violated.
    """
    shape = (len(system.M), system.N.size, int(np.count_nonzero(system.half > 0.0)))
    return UnknownInputTemplate(*shape, multiplier).solve(system, rate, what)
