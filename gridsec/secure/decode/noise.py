"""Detection and correction under bounded noise, and the probability of these bounds for Gaussian noise.

Every block of the noise has norm at most v_max. Then, for errors in at most q blocks, `detect` never alarms
without an error, and without an alarm errors and estimate are within `kappa_e v_max` and `kappa_d v_max`;
`correct` is within `kappa_c v_max` for any errors. Under Gaussian noise all this holds with at least the
probability `bound_probability`.

Source: lee2018, section 2.2.3.1, (2.2.15). Proofs and corrections: docs/theory-decoding.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtr

from gridsec.arrays import Bools, Floats, Ints, not_negative
from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.secure.decode.search import Decoder, DecodeResult, bounded, cheapest
from gridsec.secure.decode.stacks import MOST_SUBSETS, Stack, masked, require, residual, subsets


@dataclass(frozen=True, slots=True)
class DetectionConstants:
    """Constants of Theorem 2.2.9, for p blocks with at most q in error."""

    rho: float  # `rho_(p,q)`: smallest singular value of any `Phi_Lambda`, |Lambda| = p - q
    eta: float  # `eta_(p,q)`: largest `|Phi_i Phi_Lambda^+|` over i outside Lambda; 0 for q = 0
    threshold: float  # `sqrt(p)`: an alarm is a block residual above `threshold v_max`
    kappa_d: float  # `(sqrt(p) + 1) sqrt(p - q) / rho`: bound of the estimate's error, over v_max
    kappa_e: float  # `(eta sqrt(p - q) + 1) (sqrt(p) + 1)`: bound of every block of e, over v_max


@dataclass(frozen=True, slots=True)
class CorrectionConstants:
    """Constants of Theorems 2.2.11 and 2.2.12, for candidates that ignore r blocks."""

    rho: float  # `rho_(p,2q)`
    # `eta'_(p,q,r)`: over the sets of p - q blocks, the worst prediction of the others by the best subset of
    # p - r blocks; 0 for r = q
    eta: float
    theta: float  # `max(eta sqrt(p - r) + 1, sqrt(p - r))`: a block is explained up to `theta v_max`
    kappa_c: float  # `(theta + 1) sqrt(p - 2q) / rho`: bound of the decoded estimate's error, over v_max
    # `kappa^c'`, `(theta - 1) / max |Phi_i|`: smallest error of an estimate with more than q unexplained
    # blocks, over v_max
    kappa_far: float


@dataclass(frozen=True, slots=True, eq=False)
class Detected:
    """Result of the detection for a batch of measurements."""

    x: Floats  # (…, n) least-squares estimate
    residuals: Floats  # (…, p) norms of the blocks of the residual
    alarm: Bools  # (…) True if there certainly is an error


def detection_constants(stack: Stack, q: int, *, tol: float, most: int = MOST_SUBSETS) -> DetectionConstants:
    """rho, eta, kappa^d and kappa^e.

    stack: Phi; must be q-error detectable.
    tol: tolerance of that test.
    Raises NotObservable if Phi is not q-error detectable. DesignInfeasible if there are more than `most`
        subsets.
    Source: lee2018, before Theorem 2.2.9.
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

    stack: Phi; must be q-error correctable.
    q, tol, most: as in `detection_constants`.
    left_out: r; by default the cheapest, as in `search.design`.
    Raises NotObservable if Phi is not q-error correctable. DesignInfeasible if there are more than `most`
        subsets. ValueError unless q <= r <= 2 q.
    Source: lee2018 (2.2.9), before Theorem 2.2.11, Theorem 2.2.12.
    """
    require(stack, 2 * q, tol, f"undoing {q} errors")
    p = stack.count
    r = cheapest(p, q) if left_out is None else left_out
    if not q <= r <= 2 * q:
        raise InputInvalid.of("out-of-range", f"r = {r} with q = {q}; expected q <= r <= 2 q")
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

    stack: Phi of full column rank.
    z (…, N).
    v_max (scalar or (…)): largest norm of a block of the noise, not negative.
    Raises ValueError if a `v_max` is negative or NaN.
    Source: lee2018, Theorem 2.2.9.
    """
    sizes = stack.norms(residual(stack, z))
    x = z @ np.linalg.pinv(stack.matrix).T
    limit = np.sqrt(stack.count) * not_negative("v_max", v_max)[..., None]
    # Negated comparison: a residual of NaN alarms.
    return Detected(np.asarray(x), sizes, np.any(~(sizes <= limit), axis=-1))


def correct(
    decoder: Decoder, constants: CorrectionConstants, z: Floats, *, v_max: Floats | float
) -> DecodeResult:
    """Decode with the limit `theta v_max`; the result is within `kappa_c v_max`.

    constants: from `correction_constants`, with the same q and r.
    z (…, N).
    v_max (scalar or (…)): largest norm of a block of the noise, not negative.
    Raises ValueError if a `v_max` is negative or NaN.
    Source: lee2018 (2.2.8'), Theorem 2.2.11.
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


# Ruben's series: largest number of terms, and its index in units of the spread beyond which the rest is
# negligible.
_TERMS = 2000
_SPREAD = 30.0
# Numbers of nodes on the contour; more for more weights.
_NODES = (24, 32, 40, 48, 64, 96, 128, 192, 256)
_ROUNDING = 1e-15
_DOUBLINGS = 64


def bound_probability(stack: Stack, P: Floats, v_max: float, *, tol: float) -> float:
    """Lower bound of `p_v = Pr(|v_i| <= v_max for all i)`, exact up to `tol` for independent blocks.

    The product of the blocks' own probabilities, which by the Gaussian correlation inequality (the
    events are symmetric and convex) never exceeds p_v, for any correlation between blocks.

    stack: defines the blocks.
    P (N, N): covariance of the noise.
    v_max: bound, not negative.
    tol: largest error per block, downwards, of `quadratic_probability`.
    Raises ValueError if `v_max` is negative or NaN, or P is not a covariance. DesignInfeasible if the
        probability of a block cannot be computed within `tol`.
    Source: lee2018 (2.2.15); T. Royen, "A simple proof of the Gaussian correlation conjecture extended to
        some multivariate gamma distributions", Far East Journal of Theoretical Statistics 48(2), 2014.
    """
    not_negative("v_max", v_max)
    at = np.split(np.arange(P.shape[0]), np.cumsum(stack.heights)[:-1])
    total = 1.0
    for rows in at:
        values = np.asarray(np.linalg.eigvalsh(P[np.ix_(rows, rows)]), dtype=np.float64)
        total *= quadratic_probability(values, v_max**2, tol=tol)
    return total


def bound_for(stack: Stack, P: Floats, probability: float, *, tol: float) -> float:
    """Smallest v_max for which `bound_probability` reaches a probability.

    stack, P, tol: as in `bound_probability`; `tol` should be well below `1 - probability`.
    probability: required p_v, strictly between 0 and 1.
    Raises ValueError if `probability` is outside (0, 1). DesignInfeasible if it is not reached, because `tol`
        is too coarse.
    """
    if not 0.0 < probability < 1.0:
        raise InputInvalid.of("out-of-range", f"probability is {probability}; it must lie in (0, 1)")
    size = float(np.sqrt(max(float(np.max(np.linalg.eigvalsh(P))), 0.0)))
    if size == 0.0:
        return 0.0
    for doublings in range(_DOUBLINGS):
        high = 2.0**doublings * size
        if bound_probability(stack, P, high, tol=tol) >= probability:
            break
    else:
        raise DesignInfeasible(
            "bound of the noise", f"{probability} is not reached up to {high:g}", code="not-converged"
        )
    found, result = brentq(
        lambda v: bound_probability(stack, P, v, tol=tol) - probability, 0.0, high, full_output=True
    )
    # Slightly upwards, so that rounding is on the safe side.
    return float(found) * (1.0 + 1e-9) if result.converged else high


def quadratic_probability(values: Floats, limit: float, *, tol: float) -> float:
    """Lower bound of `Pr(sum_j values_j u_j^2 <= limit)` for independent standard normal u.

    By Ruben's series if it is short, else by the inverse of the Laplace transform.

    values (k,): weights: the eigenvalues of a covariance. Zeros, up to rounding, have no effect.
    limit: not negative.
    tol: largest error, downwards.
    Raises ValueError if a weight is negative or not finite, or the limit is negative or NaN. DesignInfeasible
        if neither method reaches `tol`.
    """
    top = float(np.max(values, initial=0.0))
    if not np.all(np.isfinite(values) & (values >= -_ROUNDING * top)):
        raise InputInvalid.of("negative", "weights must be finite and not negative")
    not_negative("limit", limit)
    used = values[values > 0.0]
    if limit == 0.0 or used.size == 0:
        return float(used.size == 0)
    # The series ends when its index passes the spread of the weights or half the limit over the smallest.
    soon = min(limit, _SPREAD * top) <= 2.0 * _TERMS * float(used.min())
    found = _series(used, limit, tol) if soon else None
    return _integral(used, limit, tol) if found is None else found


def _series(values: Floats, limit: float, tol: float) -> float | None:
    """Ruben's mixture of chi-square distributions; None if it does not end within `_TERMS`.

    Weights are positive and sum to one: a partial sum is a lower bound, with an error of at most the omitted
    weight times the next distribution's value.

    Source: H. Ruben, "Probability content of regions under spherical normal distributions, IV", Annals of
        Mathematical Statistics 33(2), 1962.
    """
    k, scale = values.size, float(values.min())
    ratio = 1.0 - scale / values
    weights = [float(np.sqrt(np.prod(scale / values)))]
    powers = ratio.copy()
    sums: list[float] = []
    total, used = weights[0] * float(chdtr(k, limit / scale)), weights[0]
    for j in range(1, _TERMS):
        sums.append(float(powers.sum()))
        powers = powers * ratio
        weights.append(float(np.dot(sums[::-1], weights)) / (2.0 * j))
        tail = float(chdtr(k + 2 * j, limit / scale))
        total, used = total + weights[j] * tail, used + weights[j]
        if (1.0 - used) * tail <= tol:
            return min(total, 1.0)
    return None


def _integral(values: Floats, limit: float, tol: float) -> float:
    """Inverse of the Laplace transform `prod (1 + 2 values p)^(-1/2) / p`, less the error.

    All its singularities lie on the negative half axis. On a parabola around it the midpoint rule converges
    geometrically, for any spread of the weights; two successive rules estimate the error.

    Source: L. N. Trefethen, J. A. C. Weideman, T. Schmelzer, "Talbot quadratures and rational
        approximations", BIT Numerical Mathematics 46, 2006.
    """
    before, error = np.inf, np.inf
    for nodes in _NODES:
        angle = (2.0 * np.arange(nodes) + 1.0) * np.pi / nodes - np.pi
        z = nodes * (0.1309 - 0.1194 * angle**2 + 0.25j * angle)
        slope = 0.25j - 0.2388 * angle
        logarithm = np.log1p(2.0 * np.multiply.outer(z / limit, values)).sum(axis=1)
        terms = np.exp(z - 0.5 * logarithm) * slope / z
        now = float(np.sum(terms).imag)
        error = abs(now - before) + _ROUNDING * float(np.sum(np.abs(terms)))
        if error <= tol:
            return min(max(now - error, 0.0), 1.0)
        before = now
    raise DesignInfeasible(
        "probability of a quadratic form",
        f"known up to {error:.1e} only, not {tol:.1e}",
        code="not-converged",
    )
