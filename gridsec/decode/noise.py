"""Bounded noise: guarantees of detection and correction, with every constant.

Every block of the noise has norm at most v_max. Then, for errors in at most q blocks:

- `detect` never alarms without an error; without an alarm, errors and estimate are within
  `kappa_e v_max` and `kappa_d v_max`;
- `correct` is within `kappa_c v_max` for any errors.

References
----------
lee2018, section 2.2.3.1. Proofs and corrections: docs/theory-decoding.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, not_negative
from gridsec.decode.search import Decoded, Decoder, bounded, cheapest
from gridsec.decode.stacks import MOST_SUBSETS, Stack, masked, require, residual, subsets
from gridsec.errors import InputInvalid, Problem


@dataclass(frozen=True, slots=True)
class DetectionConstants:
    """Constants of Theorem 2.2.9, for p blocks with at most q in error.

    Attributes
    ----------
    rho
        `rho_(p,q)`: smallest singular value of any `Phi_Lambda`, |Lambda| = p - q.
    eta
        `eta_(p,q)`: largest `|Phi_i Phi_Lambda^+|` over i outside Lambda; 0 for q = 0.
    threshold
        `sqrt(p)`: an alarm is a block residual above `threshold v_max`.
    kappa_d
        `(sqrt(p) + 1) sqrt(p - q) / rho`: bound of the estimate's error, over v_max.
    kappa_e
        `(eta sqrt(p - q) + 1) (sqrt(p) + 1)`: bound of every block of e, over v_max.
    """

    rho: float
    eta: float
    threshold: float
    kappa_d: float
    kappa_e: float


@dataclass(frozen=True, slots=True)
class CorrectionConstants:
    """Constants of Theorems 2.2.11 and 2.2.12, for candidates that ignore r blocks.

    Attributes
    ----------
    rho
        `rho_(p,2q)`.
    eta
        `eta'_(p,q,r)`: over the sets of p - q blocks, the worst prediction of the others by the best subset
        of p - r blocks; 0 for r = q.
    theta
        `max(eta sqrt(p - r) + 1, sqrt(p - r))`: a block is explained up to `theta v_max`.
    kappa_c
        `(theta + 1) sqrt(p - 2q) / rho`: bound of the decoded estimate's error, over v_max.
    kappa_far
        `kappa^c'`, `(theta - 1) / max |Phi_i|`: smallest error of an estimate with more than q unexplained
        blocks, over v_max.
    """

    rho: float
    eta: float
    theta: float
    kappa_c: float
    kappa_far: float


@dataclass(frozen=True, slots=True, eq=False)
class Detected:
    """Result of the detection for a batch of measurements.

    Attributes
    ----------
    x : (…, n)
        Least-squares estimate.
    residuals : (…, p)
        Norms of the blocks of the residual.
    alarm : (…)
        True if there certainly is an error.
    """

    x: Floats
    residuals: Floats
    alarm: Bools


def detection_constants(stack: Stack, q: int, *, tol: float, most: int = MOST_SUBSETS) -> DetectionConstants:
    """rho, eta, kappa^d and kappa^e.

    Parameters
    ----------
    stack
        Phi; must be q-error detectable.
    q
        Largest number of blocks in error.
    tol
        Tolerance of that test.

    Raises
    ------
    NotObservable
        If Phi is not q-error detectable.
    DesignInfeasible
        If there are more than `most` subsets.

    References
    ----------
    lee2018, before Theorem 2.2.9.
    """
    require(stack, q, tol, f"detecting {q} errors")
    p = stack.count
    kept = subsets(p, p - q, most)
    rho, predicted = _subset_norms(stack, kept)
    np.put_along_axis(predicted, kept, 0.0, axis=1)
    smallest, eta, root = float(rho.min()), float(predicted.max(initial=0.0)), float(np.sqrt(p))
    return DetectionConstants(
        rho=smallest,
        eta=eta,
        threshold=root,
        kappa_d=(root + 1.0) * float(np.sqrt(p - q)) / smallest,
        kappa_e=(eta * float(np.sqrt(p - q)) + 1.0) * (root + 1.0),
    )


def correction_constants(
    stack: Stack, q: int, *, tol: float, left_out: int | None = None, most: int = MOST_SUBSETS
) -> CorrectionConstants:
    """rho, eta', theta, kappa^c and kappa^c'.

    Parameters
    ----------
    stack
        Phi; must be q-error correctable.
    q, tol, most
        As in `detection_constants`.
    left_out
        r; by default the cheapest, as in `search.design`.

    Raises
    ------
    NotObservable
        If Phi is not q-error correctable.
    DesignInfeasible
        If there are more than `most` subsets.
    ValueError
        Unless q <= r <= 2 q.

    References
    ----------
    lee2018 (2.2.9), before Theorem 2.2.11, Theorem 2.2.12.
    """
    require(stack, 2 * q, tol, f"undoing {q} errors")
    p = stack.count
    r = cheapest(p, q) if left_out is None else left_out
    if not q <= r <= 2 * q:
        raise InputInvalid([Problem("out-of-range", f"r = {r} with q = {q}; expected q <= r <= 2 q")])
    rho, _ = _subset_norms(stack, subsets(p, p - 2 * q, most))
    smallest = float(rho.min())
    eta = _best_prediction(stack, q, r, most)
    theta = max(eta * float(np.sqrt(p - r)) + 1.0, float(np.sqrt(p - r)))
    largest = float(np.max(np.linalg.norm(stack.blocks(), 2, axis=(1, 2))))
    return CorrectionConstants(
        rho=smallest,
        eta=eta,
        theta=theta,
        kappa_c=(theta + 1.0) * float(np.sqrt(p - 2 * q)) / smallest,
        kappa_far=(theta - 1.0) / largest,
    )


def detect(stack: Stack, z: Floats, *, v_max: Floats | float) -> Detected:
    """Alarm if a block of the least-squares residual exceeds `sqrt(p) v_max`.

    Parameters
    ----------
    stack
        Phi of full column rank.
    z : (…, N)
        Measurements.
    v_max : scalar or (…)
        Largest norm of a block of the noise, not negative.

    Raises
    ------
    ValueError
        If a `v_max` is negative or NaN.

    References
    ----------
    lee2018, Theorem 2.2.9.
    """
    sizes = stack.norms(residual(stack, z))
    x = z @ np.linalg.pinv(stack.matrix).T
    limit = np.sqrt(stack.count) * not_negative("v_max", v_max)[..., None]
    # Negated comparison: a residual of NaN alarms.
    return Detected(np.asarray(x), sizes, np.any(~(sizes <= limit), axis=-1))


def correct(decoder: Decoder, constants: CorrectionConstants, z: Floats, *, v_max: Floats | float) -> Decoded:
    """Decode with the limit `theta v_max`; the result is within `kappa_c v_max`.

    Parameters
    ----------
    decoder
        From `search.design`.
    constants
        From `correction_constants`, with the same q and r.
    z : (…, N)
        Measurements.
    v_max : scalar or (…)
        Largest norm of a block of the noise, not negative.

    Raises
    ------
    ValueError
        If a `v_max` is negative or NaN.

    References
    ----------
    lee2018 (2.2.8'), Theorem 2.2.11.
    """
    return bounded(decoder, z, limit=constants.theta * not_negative("v_max", v_max)[..., None])


def _subset_norms(stack: Stack, kept: Ints) -> tuple[Floats, Floats]:
    """sigma_min(Phi_Lambda), (S,), and |Phi_i Phi_Lambda^+| for every block i, (S, p)."""
    _, s, vh = np.linalg.svd(masked(stack, kept), full_matrices=False)
    # Phi_i Phi_Lambda^+ = Phi_i V s^-1 U^T, and U has orthonormal columns.
    inverse = np.swapaxes(vh, 1, 2) / s[:, None, :]
    image = stack.blocks()[None] @ inverse[:, None]
    return s[:, -1], np.linalg.norm(image, 2, axis=(2, 3))


def _best_prediction(stack: Stack, q: int, r: int, most: int) -> float:
    """eta'_(p,q,r): max over |Lambda| = p - q of min over its subsets of p - r of max over the rest.

    In terms of omitted blocks: Lambda ignores a set of q, its subset ignores r, and the rest is the
    difference.
    """
    p = stack.count
    if r == q:
        return 0.0
    ignored = subsets(p, r, most)
    everything = np.broadcast_to(np.arange(p), (len(ignored), p))
    outside = np.ones((len(ignored), p), dtype=bool)
    np.put_along_axis(outside, ignored, values=False, axis=1)
    _, predicted = _subset_norms(stack, everything[outside].reshape(len(ignored), p - r))
    # Of the r ignored blocks, q stay ignored by Lambda and r - q form the rest.
    between = subsets(r, r - q, most)
    stay = np.stack([np.setdiff1d(np.arange(r), b) for b in between])
    worst = np.take_along_axis(predicted, ignored, axis=1)[:, between].max(axis=2)
    sets = ignored[:, stay].reshape(-1, q)
    _, name = np.unique(sets, axis=0, return_inverse=True)
    name = name.ravel()
    best = np.full(int(name.max()) + 1, np.inf)
    np.minimum.at(best, name, worst.ravel())
    return float(best.max())
