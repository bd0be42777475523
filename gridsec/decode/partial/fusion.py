"""Estimates and chi-square tests from correlated partial estimates, with possibly singular covariances.

    z = Phi x + v + e,    v ~ N(0, P),  P >= 0

The joint covariance of partial filters is usually singular: at the start all of them have the same initial
error, and modes that several sensors cannot observe are predicted by all of them with exactly the same error.
P^-1 then does not exist. Parity space avoids it: with N the annihilator of Phi, `N z` has covariance
`V = N P N^T`, and

    g = (N z)^T V^+ (N z),     x_hat = Phi^+ (I - P N^T V^+ N) z

are the test and the minimum-variance estimate of `gridsec.decode.gaussian` wherever P > 0. A parity with
variance zero is not random: it vanishes exactly unless there is an attack.

References
----------
lee2018, section 4.3.2, with the corrections of its errata; docs/theory-partial-observers.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Floats, Ints, frozen, frozen_ints
from gridsec.decode.stacks import Stack, annihilator
from gridsec.errors import NotObservable


@dataclass(frozen=True, slots=True, eq=False)
class Parity:
    """Part of the fusion of one set of sensors that does not depend on covariances. k rows are kept of N.

    Attributes
    ----------
    kept
        The sensors.
    rows : (k,)
        Their rows.
    checks : (k - n, k)
        Orthonormal N with N Phi = 0 on these rows.
    inverse : (n, k)
        Phi^+ on these rows.
    """

    kept: Ints
    rows: Ints
    checks: Floats
    inverse: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """Fusion of one set of sensors under one covariance. N stacked rows.

    Attributes
    ----------
    estimator : (n, N)
        Psi: the estimate is `Psi z`.
    covariance : (n, n)
        Covariance of the estimate's error.
    standardise : (k - n, N)
        `g = |W z|^2`. Rows of exactly vanishing parities are divided by `sqrt(tol)` of their scale.
    freedom
        Degrees of freedom of g: rank of V.
    """

    estimator: Floats
    covariance: Floats
    standardise: Floats
    freedom: int


def parity(stack: Stack, kept: Ints, *, tol: float) -> Parity:
    """Prepare the fusion of some sensors.

    Parameters
    ----------
    stack
        Phi.
    tol
        Singular values up to this, times the largest, count as zero.

    Raises
    ------
    NotObservable
        If these sensors do not determine x, or determine it without redundancy, so that no reading could
        contradict it.
    """
    rows = stack.rows(kept)
    phi = stack.matrix[rows]
    checks = annihilator(phi, tol=tol)
    rank = rows.size - len(checks)
    if rank < stack.unknowns or rows.size <= stack.unknowns:
        lack, code = "determine without redundancy", "no-redundancy"
        if rank < stack.unknowns:
            lack, code = "determine only", "not-observable"
        names = np.asarray(kept).tolist()
        why = f"sensors {names} {lack} {rank} of {stack.unknowns} unknowns"
        raise NotObservable(names, rank, why, code=code)
    inverse: Floats = np.asarray(np.linalg.pinv(phi), dtype=np.float64)
    return Parity(frozen_ints(kept), frozen_ints(rows), frozen(checks), frozen(inverse))


def fuse(prepared: Parity, P: Floats, *, tol: float) -> Fused:
    """Minimum-variance estimate and standardised residual under a covariance.

    Parameters
    ----------
    P : (N, N)
        Covariance of v; positive semidefinite.
    tol
        Largest variance of an exact parity, in units in which every row of z has variance one. Also the
        squared allowance for an exact parity, in the same units.

    References
    ----------
    lee2018 (2.2.16) to (2.2.20), Algorithm 4.2 with the rank as degrees of freedom; C. R. Rao, "Linear
    statistical inference and its applications", Wiley, 1973, section 4i (singular covariance).
    """
    at = prepared.rows
    part = P[np.ix_(at, at)]
    size = np.sqrt(np.maximum(np.diagonal(part), 0.0))
    size = np.where(size > 0.0, size, float(size.max(initial=0.0)) or 1.0)
    # N z = (N D)(D^-1 z): the same parities, orthonormal in units in which rows have variance one.
    turn, _ = np.linalg.qr((prepared.checks * size).T)
    variances, axes = np.linalg.eigh(turn.T @ (part / np.outer(size, size)) @ turn)
    # Floored, not dropped: violated exact parities must count, but not as degrees of freedom.
    W = (turn @ (axes / np.sqrt(np.maximum(variances, tol)))).T / size
    gain = part @ W.T
    correction = prepared.inverse @ gain
    n, N = prepared.inverse.shape[0], P.shape[0]
    estimator, standardise = np.zeros((n, N)), np.zeros((len(W), N))
    estimator[:, at] = prepared.inverse - correction @ W
    standardise[:, at] = W
    covariance = prepared.inverse @ part @ prepared.inverse.T - correction @ correction.T
    return Fused(
        frozen(estimator),
        frozen(0.5 * (covariance + covariance.T)),
        frozen(standardise),
        int(np.count_nonzero(variances > tol)),
    )
