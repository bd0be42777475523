"""Gains of circle-criterion observers and their matrix inequality.

The parts of a design that need no solver: the corrected inequality (12) of chong2020 rebuilt as a plain
matrix, its margin, the error bounds that follow from it, and the sensitivity of the observer to its meters.

Source: chong2020, section VI; the correction and all proofs are in docs/theory-observers.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Ints, frozen
from gridsec.errors import DesignInfeasible, InputInvalid, Problem, raise_if_any
from gridsec.observers.lure import Lure

# Sensitivity below which a meter counts as ignored.
_BLIND = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class CircleOptions:
    """Specification of a design. n states, p meters, l inputs, r directions of uncertainty.

    Raises ValueError if a number is NaN, negative or out of its range, or no meter has noise; lists every
        problem.
    """

    rate: float  # alpha, certified decay rate of the error, 1/s
    noise: Floats  # (p,) scale of each meter's error n_j, squared pu. The attack enters like the noise
    # (l, r) shape of the error of the known input, u - u_hat = load @ delta with |delta_i| about 1. It
    # contains correlations between customers; a diagonal matrix has none
    load: Floats
    weight: Floats  # (n, n) Q, weight of an error: e^T Q e
    floor: float  # smallest gain, 0 … 1, from a trusted meter to the curve of an inverter at the same place

    def __post_init__(self) -> None:
        for name in ("noise", "load", "weight"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        noise, load, weight = self.noise, self.load, self.weight
        held = {
            Problem("not-positive", "the rate must be positive"): np.isfinite(self.rate) and self.rate > 0.0,
            Problem("negative", "noise must be finite, >= 0, of shape (p,)"): noise.ndim == 1
            and bool(np.all(np.isfinite(noise) & (noise >= 0.0))),
            Problem("not-finite", "load must be finite, of shape (l, r)"): load.ndim == 2
            and bool(np.isfinite(load).all()),
            Problem("shape", "the weight must be a finite square matrix"): weight.ndim == 2
            and weight.shape[0] == weight.shape[1]
            and bool(np.isfinite(weight).all()),
            Problem("out-of-range", "the floor must lie in [0, 1)"): 0.0 <= self.floor < 1.0,
        }
        problems = [text for text, holds in held.items() if not holds]
        if not np.any(self.noise > 0.0):
            problems.append(Problem("not-positive", "at least one meter must have a noise scale above zero"))
        raise_if_any(problems)


@dataclass(frozen=True, slots=True, eq=False)
class CircleGains:
    """One designed observer with its proof. k trusted meters, n states, m nonlinearities."""

    J: Ints  # (k,) the trusted meters
    L: Floats  # (n, k) injection into the state
    K: Floats  # (m, k) injection into the arguments of the nonlinearities
    P: Floats  # (n, n) V = e^T P e is the certificate
    Lambda: Floats  # (m,) diagonal multiplier of the slope restriction
    nu: float  # V' <= -2 alpha V - nu e^T Q e + mu |n / noise|^2 + mu_delta |delta|^2
    mu: float
    mu_delta: float
    alpha: float  # certified decay rate, 1/s
    noise: Floats  # (k,) scale of each trusted meter's error, squared pu
    load: Floats  # (l, r) as in `CircleOptions`
    weight: Floats  # (n, n) as in `CircleOptions`
    margin: float  # margin of the rebuilt inequality, see `margin`; positive if it holds
    sensitivity: Floats  # (k,) influence of each trusted meter on the observer, see `sensitivity`
    backoff: float  # fraction by which alpha, nu, mu and mu_delta were relaxed after the solver
    status: str  # status of the solver; not a proof


def options_for(
    lure: Lure,
    *,
    rate: float,
    noise: Floats | float,
    load: Floats,
    weight: Floats | None = None,
    floor: float = 0.0,
) -> CircleOptions:
    """Options of a design, with short forms filled in for a plant.

    lure: plant; p meters, l inputs, n states.
    rate: alpha, 1/s.
    noise (p,) or scalar: scale of the meters' errors, squared pu.
    load (l, r) or (l,): error of the known input; a vector means independent entries.
    weight (n, n): Q; by default H^T H, the squared error of z at the inverters.
    floor: smallest gain from a trusted meter to the curve at the same place.
    Raises ValueError as `CircleOptions`, or if shapes are inconsistent with the plant.
    """
    load = np.asarray(load, dtype=np.float64)
    options = CircleOptions(
        rate=float(rate),
        noise=np.array(np.broadcast_to(np.asarray(noise, dtype=np.float64), (len(lure.C),))),
        load=np.diag(load) if load.ndim == 1 else load,
        weight=lure.H.T @ lure.H if weight is None else np.asarray(weight, dtype=np.float64),
        floor=float(floor),
    )
    if len(options.load) != lure.F.shape[1] or len(options.weight) != len(lure.A):
        raise InputInvalid.of(
            "shape", f"load {options.load.shape} or weight {options.weight.shape} do not fit the plant"
        )
    return options


def circle_matrix(lure: Lure, J: Ints | Sequence[int], gains: CircleGains) -> Floats:
    r"""Rebuild the corrected inequality (12): the matrix that must be negative semidefinite.

    With `e = x - x_hat`, `psi` the difference of the nonlinearities and the columns in the order
    (e, psi, n / noise, delta)::

        [ E   P G + (H - K C_J)^T Lam   -P L N     P (B - L D_J) W    ]
        [ *   -2 Lam d^-1               -Lam K N   Lam (F - K D_J) W  ]      N = diag(noise_J)
        [ *   *                         -mu I      0                  ]      W = load
        [ *   *                         *          -mu_delta I        ]

        E = P (A - L C_J) + (A - L C_J)^T P + 2 alpha P + nu Q

    Nonlinearities of slope bound 0 are constant and have no column.

    lure: plant; n states, m nonlinearities, p meters, l inputs.
    J (k',): meters with injection, a subset of `gains.J`. A smaller set gives the matrix of the same observer
        while the other meters are unavailable.
    Raises ValueError if `J` is not a subset of the design's meters.
    Source: chong2020 (12), corrected: docs/theory-observers.md, section 2.
    """
    keep = np.isin(gains.J, np.asarray(J, dtype=np.intp))
    if np.count_nonzero(keep) != len(J):
        raise InputInvalid.of(
            "wrong-design", f"{list(J)} is not a subset of the design's meters {gains.J.tolist()}"
        )
    rows, L, K, N = gains.J[keep], gains.L[:, keep], gains.K[:, keep], gains.noise[keep]
    live = lure.slope > 0.0
    G, H, F, K = lure.G[:, live], lure.H[live], lure.F[live], K[live]
    P, Lam, W = gains.P, gains.Lambda[live], gains.load
    C, D = lure.C[rows], lure.D[rows]
    drift = P @ (lure.A - L @ C)
    ee = drift + drift.T + 2.0 * gains.alpha * P + gains.nu * gains.weight
    ep = P @ G + (H - K @ C).T * Lam
    en, ed = -P @ L * N, P @ (lure.B - L @ D) @ W
    pp = np.diag(-2.0 * Lam / lure.slope[live])
    pn, pd = -(Lam[:, None] * K) * N, Lam[:, None] * ((F - K @ D) @ W)
    nn, nd, dd = (
        -gains.mu * np.eye(len(rows)),
        np.zeros((len(rows), W.shape[1])),
        -gains.mu_delta * np.eye(W.shape[1]),
    )
    return np.block([[ee, ep, en, ed], [ep.T, pp, pn, pd], [en.T, pn.T, nn, nd], [ed.T, pd.T, nd.T, dd]])


def negativity(matrix: Floats) -> float:
    """Scale-free margin of negative definiteness of a symmetric matrix; positive if negative definite.

    Minus the largest eigenvalue of `S M S`, with the diagonal `S` that makes the diagonal of `M` minus one,
    minus a bound on the rounding error. By Sylvester's law `S M S` has the signs of `M`. Its entries are of
    order one, so that the result stays accurate when the blocks of `M` differ by many orders of magnitude. A
    diagonal entry that is not negative disproves definiteness.

    matrix (s, s): symmetric.
    """
    if not np.isfinite(matrix).all():
        return -np.inf
    if matrix.size == 0:
        return np.inf
    diagonal = np.diagonal(matrix)
    size = float(np.max(np.abs(matrix)))
    if np.any(diagonal >= 0.0):
        return -float(np.max(diagonal)) / size if size > 0.0 and np.max(diagonal) > 0.0 else -np.inf
    scale = 1.0 / np.sqrt(-diagonal)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = scale[:, None] * matrix * scale
    if not np.isfinite(scaled).all():
        return -np.inf  # an entry this large beside its two diagonal entries gives a positive direction
    eigenvalues = np.linalg.eigvalsh(0.5 * (scaled + scaled.T))
    rounding = 4.0 * len(matrix) * np.finfo(np.float64).eps * float(np.max(np.abs(eigenvalues)))
    return float(-eigenvalues[-1]) - rounding


def margin(lure: Lure, J: Ints | Sequence[int], gains: CircleGains) -> float:
    """Margin of all conditions of the proof; the certificate holds if it is positive.

    The smallest of: the negativity of `circle_matrix`, the positivity of P, and the signs of
    Lambda, mu, mu_delta, nu and alpha.

    lure, J, gains: as in `circle_matrix`.
    """
    live = lure.slope > 0.0
    signs = np.array([*gains.Lambda[live], gains.mu, gains.mu_delta, gains.nu, gains.alpha])
    if not np.all(signs > 0.0):
        return -np.inf
    return min(negativity(-gains.P), negativity(circle_matrix(lure, J, gains)))


def sensitivity(lure: Lure, L: Floats, K: Floats) -> Floats:
    """Influence of each meter on an observer: 0 for none, 1 for the most direct one.

    `s_j = max(max_i |K_ij|, max_i |L_ij| / (|G| d)_i)`: the part of a meter's error that reaches the argument
    of some curve, or its effect on some state relative to the largest effect of the curves.

    L (n, k), K (m, k). Returns (k,), dimensionless.
    """
    drive = np.abs(lure.G) @ lure.slope
    live = lure.slope > 0.0
    through_K = np.max(np.abs(K[live]), axis=0, initial=0.0)
    # A state without input from a curve is compared with its own decay over one unit of output.
    reference = np.where(drive > 0.0, drive, np.abs(np.diagonal(lure.A)))
    with np.errstate(divide="ignore", invalid="ignore"):
        pushed = np.where(L == 0.0, 0.0, np.abs(L) / reference[:, None])
    return np.asarray(np.maximum(through_K, np.max(pushed, axis=0, initial=0.0)), dtype=np.float64)


def refuse_blind(J: Ints, heard: Floats) -> None:
    """Refuse a design that ignores every one of its meters.

    J (k,). heard (k,): their `sensitivity`.
    Raises DesignInfeasible if every sensitivity is below `_BLIND`; the message states reason and remedies.
    """
    if np.max(heard, initial=0.0) < _BLIND:
        raise DesignInfeasible(
            f"circle-criterion observer of the meters {J.tolist()}",
            "degenerate: the best gains are L = K = 0, an observer that ignores its meters. The plant "
            "converges by itself, so using a meter only costs when noise or attacks are large against "
            "the load uncertainty. Every observer of such a bank gives the same estimate and no attack is "
            "visible in it. State the uncertainty of the loads (`load`), or smaller meter noise, or demand a "
            "smallest gain (`floor`)",
            float(np.max(heard, initial=0.0)) - _BLIND,
            code="degenerate",
        )


def state_bound(gains: CircleGains, rows: Floats, noise: float, delta: float) -> Floats:
    r"""Ultimate bound on linear functions of the error.

    `|c^T e| <= sqrt(c^T P^{-1} c) sqrt((mu s_n^2 + mu_delta s_d^2) / (2 alpha))`, after the initial
    error has decayed with `exp(-alpha t)`.

    gains: a design with a positive margin.
    rows (k, n): functions c^T of the error, for example the rows of H.
    noise: s_n, supremum over time of the Euclidean norm of (n + a)_J / noise.
    delta: s_d, supremum over time of the Euclidean norm of delta.
    Returns (k,): in the units of `rows @ e`.
    """
    level = (gains.mu * noise**2 + gains.mu_delta * delta**2) / (2.0 * gains.alpha)
    spread = np.sum(rows * np.linalg.solve(gains.P, rows.T).T, axis=1)
    return np.asarray(np.sqrt(spread * level), dtype=np.float64)


def stacked(gains: Sequence[CircleGains], meters: int) -> tuple[Floats, Floats]:
    """Gains of several observers on a leading axis, with zero columns for the meters that each one ignores.

    gains: B designs of one plant.
    meters: p, number of meters of the plant.
    Returns L (B, n, p), K (B, m, p): every observer of the bank injects `L @ r` and `K @ r` with the same r.
    """
    first = gains[0]
    L = np.zeros((len(gains), len(first.L), meters))
    K = np.zeros((len(gains), len(first.K), meters))
    for index, one in enumerate(gains):
        L[index][:, one.J] = one.L
        K[index][:, one.J] = one.K
    return L, K
