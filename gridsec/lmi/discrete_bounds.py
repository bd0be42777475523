"""Discrete-time circle-criterion observers: their inequality as a plain matrix, margins, error bounds.

The parts of a design that need no solver.

References
----------
yang2019 (4), (5); docs/theory-discrete.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.errors import InputInvalid, Problem
from gridsec.gains import negativity
from gridsec.lmi.sampled import DiscreteLure, shift


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Input matrices of the unknown delta (r,) besides the meters.

    `x+ = … + state @ delta`, `z = H x + F u + argument @ delta`, `y = … + output @ delta`.

    Attributes
    ----------
    state : (n, r)
    argument : (m, r)
    output : (p, r)
        Scaled so that the entries of delta are about one.

    Raises
    ------
    ValueError
        If the numbers of columns differ.
    """

    state: Floats
    argument: Floats
    output: Floats

    def __post_init__(self) -> None:
        for name in ("state", "argument", "output"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        if not self.state.shape[1] == self.argument.shape[1] == self.output.shape[1]:
            raise InputInvalid(
                [Problem("shape", "state, argument and output must have one column for each entry of delta")]
            )


def nothing_unknown(system: DiscreteLure) -> Uncertainty:
    """No uncertainty but that of the meters; r = 0."""
    sizes = (len(system.A), len(system.lower), len(system.C))
    return Uncertainty(*(np.zeros((size, 0)) for size in sizes))


def input_error(system: DiscreteLure, load: Floats, held: Floats | None = None) -> Uncertainty:
    """Uncertainty of an input known up to `load @ delta`, with arguments that move by `held` within a step.

    Parameters
    ----------
    system
        The plant; l inputs, m nonlinearities.
    load : (l, r) or (l,)
        Shape of the error of the known input; a vector means independent entries.
    held : (m,), optional
        Error of each argument from `sampled.held_error`, independent of all others.
    """
    given = np.asarray(load, dtype=np.float64)
    W = np.diag(given) if given.ndim == 1 else given
    parts = [system.B @ W, system.F @ W, system.D @ W]
    if held is not None:
        extra = (np.zeros((len(system.A), held.size)), np.diag(held), np.zeros((len(system.C), held.size)))
        parts = [np.hstack(pair) for pair in zip(parts, extra, strict=True)]
    return Uncertainty(*parts)


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteGains:
    """One designed observer with its proof. k trusted meters, n states, m nonlinearities.

    With `V = e^T P e`, `e = x - x_hat`: `V+ <= decay^2 V + mu |n / noise|^2 + mu_delta |delta|^2`.

    Attributes
    ----------
    J : (k,)
        The trusted meters.
    L, K : (n, k), (m, k)
        Injection of `r = y - y_hat` into the state and into the arguments of the nonlinearities;
        yang2019 (4) writes the same with the opposite sign of both.
    P : (n, n)
    Lambda : (m,)
        Certificate and multiplier, for the loop-transformed system.
    decay
        lambda of yang2019 (5), per step.
    mu, mu_delta : float
        As above.
    noise : (k,)
        Scale of each trusted meter's error.
    unknown
        Further uncertainty.
    margin
        Margin of the rebuilt inequality; it holds if positive.
    backoff
        Fraction by which mu and mu_delta were enlarged after the solver.
    status
        Status of the solver; not a proof.
    """

    J: Ints
    L: Floats
    K: Floats
    P: Floats
    Lambda: Floats
    decay: float
    mu: float
    mu_delta: float
    noise: Floats
    unknown: Uncertainty
    margin: float
    backoff: float
    status: str


def discrete_matrix(system: DiscreteLure, J: Ints | Sequence[int], gains: DiscreteGains) -> Floats:
    r"""The matrix that must be negative semidefinite, in the order (e, psi, n / noise, delta).

    With `S` zero but for the rows of psi::

        T^T P T - diag(decay^2 P, 0, mu I, mu_delta I) + S + S^T

        T = [ A~ - L~ C_J   G   -L~ N   E_x~ - L~ E_y ]          N = diag(noise_J)
        S = [ Lam (H - K C_J)   -Lam d^-1   -Lam K N   Lam (E_z - K E_y) ]

    and the loop transform `A~ = A + G diag(lower) H`, `E_x~ = E_x + G diag(lower) E_z`,
    `L~ = L + G diag(lower) K`. Nonlinearities of constant slope have no column.

    Parameters
    ----------
    J : (k',)
        Meters with injection, a subset of `gains.J`: the observer while others are unavailable.

    Raises
    ------
    ValueError
        If `J` is not a subset of the design's meters.

    References
    ----------
    docs/theory-discrete.md, Theorem 1.
    """
    keep = np.isin(gains.J, np.asarray(J, dtype=np.intp))
    if np.count_nonzero(keep) != len(J):
        raise InputInvalid(
            [Problem("wrong-design", f"{list(J)} is not a subset of the design's meters {gains.J.tolist()}")]
        )
    rows, L, K, N = gains.J[keep], gains.L[:, keep], gains.K[:, keep], gains.noise[keep]
    moved, lower = shift(system), system.G * system.lower
    L = L + lower @ K
    live = system.slope > 0.0
    C, E_y = system.C[rows], gains.unknown.output[rows]
    E_x, E_z = gains.unknown.state + lower @ gains.unknown.argument, gains.unknown.argument[live]
    P, Lam = gains.P, gains.Lambda[live, None]
    T = np.hstack([moved.A - L @ C, moved.G[:, live], -L * N, E_x - L @ E_y])
    n, m, k, r = len(P), int(live.sum()), len(rows), E_z.shape[1]
    sector = np.zeros((n + m + k + r,) * 2)
    own = np.diag(-1.0 / system.slope[live])
    sector[n : n + m] = Lam * np.hstack(
        [system.H[live] - K[live] @ C, own, -K[live] * N, E_z - K[live] @ E_y]
    )
    supply = np.zeros_like(sector)
    supply[:n, :n] = gains.decay**2 * P
    supply[range(n + m, n + m + k), range(n + m, n + m + k)] = gains.mu
    supply[range(n + m + k, n + m + k + r), range(n + m + k, n + m + k + r)] = gains.mu_delta
    whole = T.T @ P @ T - supply + sector + sector.T
    return np.asarray(0.5 * (whole + whole.T))


def discrete_margin(system: DiscreteLure, J: Ints | Sequence[int], gains: DiscreteGains) -> float:
    """Margin of all conditions of the proof; it holds if positive.

    The smaller one of the negativity of `discrete_matrix` and the positivity of P; minus infinity if a
    sign is wrong.

    Parameters
    ----------
    system, J, gains
        As in `discrete_matrix`.
    """
    live = system.slope > 0.0
    signs = [*gains.Lambda[live], gains.decay, 1.0 - gains.decay]
    signs += [gains.mu] if len(gains.J) else []
    signs += [gains.mu_delta] if gains.unknown.state.shape[1] else []
    if not all(value > 0.0 for value in signs):
        return -np.inf
    return min(negativity(-gains.P), negativity(discrete_matrix(system, J, gains)))


def growth(gains: DiscreteGains) -> float:
    """C of yang2019 (5), `sqrt(lambda_max(P) / lambda_min(P))`: `|e(k)| <= c decay^k |e(0)| + …`.

    Parameters
    ----------
    gains
        A design with a positive margin.
    """
    values = np.linalg.eigvalsh(gains.P)
    return float(np.sqrt(values[-1] / values[0]))


def noise_gain(gains: DiscreteGains) -> float:
    """gamma_J of yang2019 (5): `|e| <= … + gamma_J sup |m_J|` in Euclidean norms.

    `sqrt(mu / ((1 - decay^2) lambda_min(P))) / min noise`.

    Parameters
    ----------
    gains
        A design with a positive margin.
    """
    quietest = float(np.min(gains.noise))
    if quietest == 0.0:
        return np.inf
    lowest = float(np.linalg.eigvalsh(gains.P)[0])
    return float(np.sqrt(gains.mu / ((1.0 - gains.decay**2) * lowest))) / quietest


def unknown_gain(gains: DiscreteGains) -> float:
    """Gain of delta: `|e| <= … + gain sup |delta|`; 0 without delta.

    Parameters
    ----------
    gains
        A design with a positive margin.
    """
    if not gains.unknown.state.shape[1]:
        return 0.0
    lowest = float(np.linalg.eigvalsh(gains.P)[0])
    return float(np.sqrt(gains.mu_delta / ((1.0 - gains.decay**2) * lowest)))


@dataclass(frozen=True, slots=True, eq=False)
class DirectProof:
    """Proof that the errors of direct injection decay, for every set of trusted meters and every switching.

    Attributes
    ----------
    P : (n, n)
        `|e+|_P <= decay |e|_P` without disturbances, `|e|_P = sqrt(e^T P e)`.
    Lambda : (m,)
        Multiplier.
    decay
        Per step.
    margin
        Margin of the inequality without meters; it holds if positive.
    status
        Origin of the proof.
    """

    P: Floats
    Lambda: Floats
    decay: float
    margin: float
    status: str


def direct_gain_bound(system: DiscreteLure, proof: DirectProof, rows: Floats) -> float:
    """Ultimate bound of direct injection: `|e| <= … + bound sup |s|` in Euclidean norms.

    `|P^(1/2) G diag(slope)|_2 |rows|_2 / ((1 - decay) sqrt(lambda_min(P)))`, over the nonlinearities
    that s reaches: besides the part covered by the proof, `|psi_i| <= slope_i |(rows s)_i|`.

    Parameters
    ----------
    system
        The plant; slopes from zero.
    proof
        From `discrete.discrete_contraction`.
    rows : (m, s)
        Matrix from the disturbance s to the arguments of the observer's or the plant's nonlinearities.

    References
    ----------
    docs/theory-discrete.md, Theorem 2.
    """
    used = np.any(rows != 0.0, axis=1)
    if not used.any():
        return 0.0
    root = np.linalg.cholesky(proof.P).T
    push = float(np.linalg.norm(root @ (system.G * system.upper)[:, used], 2))
    lowest = float(np.sqrt(np.linalg.eigvalsh(proof.P)[0]))
    return push * float(np.linalg.norm(rows, 2)) / ((1.0 - proof.decay) * lowest)
