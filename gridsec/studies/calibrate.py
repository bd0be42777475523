"""Evidence of recorded readings for errors of a feeder's files: mixed regression and Bayes factors.

Whitened readings are ``y = A b + n`` with white n of variance 1 and independent coefficients ``b_k ~ N(0,
s_k^2)``: biases within the class of their meters, gains within the class of the registers, power factors
within their limits, lengths within their tolerance. A hypothesis adds a column z: an error of the files,
either with the coefficient 1 (a customer is at another bus) or with a prior spread (a line is longer, a
meter's error has changed). With ``P = I - A S (I + S A^T A S)^-1 S A^T`` and

    g = z^T P y,   h = z^T P z

its logarithmic Bayes factor against files without that error is ``g - h / 2``, or for a spread s ``(g^2 / (h
+ 1 / s^2) - log(1 + h s^2)) / 2``. Without any error the expectation of a Bayes factor is 1. So a mean of M
factors exceeds ``1 / risk`` with at most the probability `risk`, for any dependence between them.

References
----------
.. [1] V. Vovk, R. Wang, "E-values: calibration, combination and applications", Annals of Statistics 2021.
docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from gridsec.arrays import Bools, Floats, Ints

__all__ = ["Evidence", "Fit", "Weighed", "evidence", "explain", "fit", "weigh"]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Regression without any error of the files. n readings, K coefficients.

    Attributes
    ----------
    explained : (n, K)
        Whitened regressors, each times the standard deviation of its prior, times ``L^-T`` with
        ``L L^T = I + A^T A``: ``P = I - explained explained^T``.
    residual : (n,)
        ``P y``.
    estimate, std : (K,)
        Coefficients and their standard errors, the prior included.
    scale
        ``y^T P y / n``, at least 1: residuals above the noise weaken all evidence.
    """

    explained: Floats
    residual: Floats
    estimate: Floats
    std: Floats
    scale: float


def fit(y: Floats, columns: Floats, spread: Floats, count: int) -> Fit:
    """Fit the regression without any error of the files.

    Parameters
    ----------
    y : (n,)
        Whitened readings minus model.
    columns : (n, K)
        Whitened regressors.
    spread : (K,)
        Standard deviation of each coefficient before any reading.
    count
        Number of readings; missing ones are zeros in `y` and `columns`.
    """
    A = columns * spread
    normal = A.T @ A
    normal[np.diag_indices_from(normal)] += 1.0
    half = solve_triangular(np.linalg.cholesky(normal), np.eye(spread.size), lower=True)
    explained = A @ half.T
    scaled = explained.T @ y
    residual = y - explained @ scaled
    return Fit(
        explained=explained,
        residual=residual,
        estimate=spread * (half.T @ scaled),
        std=spread * np.sqrt(np.einsum("ij,ij->j", half, half)),
        scale=max(1.0, float(y @ residual) / max(count, 1)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Evidence of the readings for H hypotheses.

    Attributes
    ----------
    g, h : (H,)
        Score and information of each coefficient.
    log_factor : (H,)
        Logarithm of the Bayes factor against files without the error.
    """

    g: Floats
    h: Floats
    log_factor: Floats


def evidence(given: Fit, z: Floats, spread: Floats) -> Evidence:
    """Compute the Bayes factor of each hypothesis.

    Parameters
    ----------
    z : (n, H)
        Whitened effect of each hypothesis.
    spread : (H,)
        Prior standard deviation of its coefficient; 0 for the coefficient 1.
    """
    projected = given.explained.T @ z
    g = z.T @ given.residual / given.scale
    h = np.einsum("ij,ij->j", z, z) - np.einsum("ij,ij->j", projected, projected)
    h = np.maximum(h, 0.0) / given.scale
    s2 = spread**2
    free = 0.5 * (g**2 * s2 / (1.0 + h * s2) - np.log1p(h * s2))
    return Evidence(g, h, np.where(spread > 0.0, free, g - 0.5 * h))


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """Joint evidence of hypotheses of several kinds.

    Attributes
    ----------
    confidence : (H,)
        Probability of each, for equal prior probabilities of some error and of none.
    any
        Logarithm of the mean Bayes factor: above ``log(1 / risk)`` there is an error; minus infinity without
        any hypothesis.
    kept : (k,)
        The best hypotheses, best first, with all but `risk` of the probability.
    """

    confidence: Floats
    any: float
    kept: Ints


def weigh(log_factor: Floats, kind: Ints, risk: float) -> Weighed:
    """Compare hypotheses; all kinds have equal weight, and within a kind all hypotheses.

    Parameters
    ----------
    log_factor : (H,)
        From `evidence`.
    kind : (H,)
        Kind of each, as a number.
    risk
        Probability of a proposal for files without errors.
    """
    _, where, count = np.unique(kind, return_inverse=True, return_counts=True)
    log_share = log_factor - np.log(count.size * count[where])
    total = float(logsumexp(log_share)) if log_share.size else -np.inf
    order = np.argsort(-log_share, kind="stable")
    among = np.cumsum(np.exp(log_share[order] - total))
    kept = order[: int(np.searchsorted(among, 1.0 - risk)) + 1]
    return Weighed(np.exp(log_share - np.logaddexp(total, 0.0)), total, kept)


def explain(given: Fit, z: Floats, own: Floats, like: float) -> tuple[Floats, Floats, Bools]:
    """Estimate each coefficient alone, and mark effects that cannot be distinguished.

    Parameters
    ----------
    z : (n, H)
        Whitened effects.
    own : (H,)
        Standard deviation of the coefficient among the regressors; it is removed.
    like
        Smallest correlation of two effects, 1, that count as equal.

    Returns
    -------
    estimate, std : (H,)
        Least squares without prior for this coefficient; infinite errors where not determined.
    same : (H, H)
        Pairs with equal effects after projection on the other regressors' complement.
    """
    projected = given.explained.T @ z
    inner = z.T @ z - projected.T @ projected
    inner = 0.5 * (inner + inner.T) / given.scale
    g, h = z.T @ given.residual / given.scale, inner.diagonal()
    with np.errstate(divide="ignore", invalid="ignore"):
        estimate = np.where(h > 0.0, g / h, 0.0)
        std = np.where(h > 0.0, np.sqrt(np.maximum(1.0 / h - own**2, 0.0)), np.inf)
        alike = np.abs(inner) / np.sqrt(np.outer(h, h))
    return estimate, std, np.asarray(np.nan_to_num(alike) >= like)
