"""Observable part of the state by single sensors: Kalman's decomposition, sensor by sensor.

    z_i = Z_i^T x,    z_i(k+1) = S_i z_i(k) + Z_i^T B u(k) + Z_i^T d(k),    y_i(k) = t_i z_i(k) + n_i(k)

The partial observers of `luenberger` and `kalman` estimate z_i from y_i alone.

Source: lee2018, section 4.2.1; docs/theory-partial-observers.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, block_diag, schur, solve_discrete_are

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints, spectral_radius, unit_rows
from gridsec.errors import DesignInfeasible, InputInvalid


@dataclass(frozen=True, slots=True, eq=False)
class SensorDecomposition:
    """Orthonormal basis of the state for one sensor, in three pieces; lee2018 (4.2.3) to (4.2.5)."""

    observable: Floats  # (n, nu) Z^o, basis of the orthogonal complement of the unobservable subspace N(G_i)
    # (n, mu - nu) Z^d, basis of the unobservable part that a model predicts with decaying error
    fading: Floats
    hidden: Floats  # (n, n - mu) W, basis of the rest: unobservable and not predictable
    S: Floats  # (mu, mu) motion of z = Z^T x with Z = [Z^o Z^d]; block lower triangular
    t: Floats  # (mu,) the sensor's row on z; zero beyond the first nu

    @property
    def basis(self) -> Floats:
        """[Z^o Z^d], (n, mu)."""
        return np.hstack([self.observable, self.fading])


def decompose(A: Floats, C: Floats, *, slowest: float, tol: float) -> tuple[SensorDecomposition, ...]:
    """Kalman decomposition for every single sensor.

    The unobservable motion has eigenvalues of its own. Modes below `slowest` in modulus go into `fading`, the
    others into `hidden`. Hence `slowest=0` gives the Kalman observability decomposition (no unobservable mode
    is kept), and `slowest=1` the detectability decomposition.

    A (n, n), C (p, n): the pair, sampled.
    slowest: in [0, 1], preferably slightly below 1: a mode that decays in 1e6 steps is useless, and rounding
        moves a repeated eigenvalue on the unit circle slightly inside.
    tol: a row of the observability matrix, orthogonalised against those before it, counts as new if longer
        than this times |A|. A large value makes parts smaller; a small one keeps directions that only noise
        determines. A sensor with a row up to this fraction of the longest measures nothing.
    Raises ValueError if `slowest` is not in [0, 1].
    Source: lee2018, section 4.2.1.
    """
    A, C = np.asarray(A, dtype=np.float64), np.asarray(C, dtype=np.float64)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or C.ndim != 2 or C.shape[1] != A.shape[0]:
        raise InputInvalid.of("shape", f"A has shape {A.shape} and C {C.shape}; (n, n) and (p, n) are needed")
    if not 0.0 <= slowest <= 1.0:
        raise InputInvalid.of(
            "out-of-range", f"slowest is {slowest}; it is the modulus of a decaying mode, in [0, 1]"
        )
    return tuple(_part(A, c, row, slowest, tol) for c, row in zip(C, unit_rows(C, tol=tol), strict=True))


def _part(A: Floats, c: Floats, row: Floats, slowest: float, tol: float) -> SensorDecomposition:
    """Decomposition for the sensor with row c, of length one in `row`."""
    seen = krylov(A, row, tol)
    full = np.linalg.qr(seen, mode="complete")[0] if seen.shape[1] else np.eye(len(A))
    unseen = full[:, seen.shape[1] :]
    hidden_count, turn = 0, np.zeros((0, 0))
    if unseen.shape[1]:
        # N(G) is invariant: the leading Schur vectors of its slow modes are invariant too, and the others
        # complete them orthogonally.
        _, turn, hidden_count = schur(
            unseen.T @ A @ unseen, output="real", sort=lambda re, im: np.hypot(re, im) >= slowest
        )
    rest = unseen @ turn
    hidden, fading = rest[:, :hidden_count], rest[:, hidden_count:]
    Z = np.hstack([seen, fading])
    return SensorDecomposition(
        frozen(seen), frozen(fading), frozen(hidden), frozen(Z.T @ A @ Z), frozen(c @ Z)
    )


def krylov(A: Floats, row: Floats, tol: float) -> Floats:
    """Orthonormal basis of span{c, A^T c, …} in columns, without powers of A; c of length one."""
    n = A.shape[0]
    size = float(np.linalg.norm(A, 2)) or 1.0
    basis = np.zeros((n, 0))
    while basis.shape[1] < n and (length := float(np.linalg.norm(row))) > tol:
        basis = np.column_stack([basis, row / length])
        row = A.T @ basis[:, -1] / size
        # Twice, because later rows would inherit the rounding errors of a single pass.
        for _ in range(2):
            row = row - basis @ (basis.T @ row)
    return basis


@dataclass(frozen=True, slots=True, eq=False)
class StackedDecompositions:
    """All parts, stacked; lee2018 (4.2.5), (4.2.9), (4.2.10). mu is the sum of the parts' sizes."""

    parts: tuple[SensorDecomposition, ...]  # one for each sensor
    first: Ints  # (p + 1,) sensor i has the rows `first[i]:first[i + 1]` of the stacked arrays
    phi: Floats  # (mu, n) Phi = [Z_1 … Z_p]^T, without the zero rows of the paper
    S: Floats  # (mu, mu) motion of the stacked z; block diagonal
    T: Floats  # (p, mu) outputs of the stacked z; block diagonal
    G: Floats  # (mu, m) Phi B

    def rows(self, sensor: int) -> slice:
        """Rows of one sensor."""
        return slice(int(self.first[sensor]), int(self.first[sensor + 1]))

    @property
    def blocks(self) -> tuple[Floats, ...]:
        """Z_i^T of each sensor, (mu_i, n)."""
        return tuple(self.phi[self.rows(i)] for i in range(len(self.parts)))


def stack(parts: Sequence[SensorDecomposition], B: Floats) -> StackedDecompositions:
    """Stack the parts, for the input matrix B (n, m)."""
    phi = np.vstack([part.basis.T for part in parts])
    first = np.concatenate([[0], np.cumsum([part.t.size for part in parts])])
    T = np.zeros((len(parts), phi.shape[0]))
    for i, part in enumerate(parts):
        T[i, first[i] : first[i + 1]] = part.t
    S = block_diag(*(part.S for part in parts))
    return StackedDecompositions(
        tuple(parts), frozen_ints(first), frozen(phi), frozen(S), frozen(T), frozen(phi @ np.asarray(B))
    )


def riccati(S: Floats, t: Floats, Q: Floats, r: float, *, tol: float) -> Floats:
    """Covariance of the stationary prediction of z from one sensor.

        M = S M S^T + Q - S M t t^T M S^T / (t^T M t + r)

    S (mu, mu), t (mu,): the sensor's part.
    Q (mu, mu): covariance of the disturbance of z.
    r: variance of the sensor's noise, > 0.
    tol: largest residual of the equation, relative to its largest term.
    Raises DesignInfeasible if no stabilising solution within `tol` is found.
    """
    best, worst, said = S, np.inf, "no stabilising solution"
    # SciPy's balancing fails by orders of magnitude for zeros in t, as with fading modes; without it badly
    # scaled plants are inaccurate. The residual decides.
    for balanced in (False, True):
        try:
            M = np.asarray(solve_discrete_are(S.T, t[:, None], Q, np.array([[r]]), balanced=balanced))
        except (LinAlgError, ValueError) as problem:
            said = str(problem)
            continue
        moved, gain = S @ M @ S.T, S @ M @ t
        left = moved + Q - M - np.outer(gain, gain) / (t @ M @ t + r)
        size = max(float(np.max(np.abs(moved))), float(np.max(np.abs(Q))), float(np.max(np.abs(M))))
        off = float(np.max(np.abs(left))) / (size or 1.0)
        if off < worst:
            best, worst = M, off
    if not worst <= tol:
        raise DesignInfeasible("Riccati equation of one sensor", said, -worst, code="no-solution")
    return np.asarray(0.5 * (best + best.T))


def require_stable(F: Floats, what: str, *, rate: float = 1.0) -> None:
    """Raise DesignInfeasible unless the spectral radius of F is below `rate` by more than rounding.

    Computed eigenvalues are those of a matrix within about n eps |F| of F (backward stability). A mode on the
    circle itself is refused on every processor.
    """
    radius = spectral_radius(F)
    rounding = len(F) * np.finfo(np.float64).eps * float(np.linalg.norm(F)) if F.size else 0.0
    if not radius < rate - rounding:
        raise DesignInfeasible(what, f"spectral radius {radius:.6g}", rate - radius, code="unstable")


def heard(y: Floats, seen: Bools | None) -> Bools:
    """Sensors with usable readings y (…, p): `seen` (p,), if given, and finite in all runs; (p,)."""
    finite = np.isfinite(y)
    live = finite.all(axis=tuple(range(finite.ndim - 1)))
    return np.asarray(live if seen is None else live & np.asarray(seen, dtype=np.bool_))
