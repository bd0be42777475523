"""Voltages at all places from the filter, corrected for suspected faults.

The squared voltage at place x exceeds the front end's model by ``w_x + b_x + e_x``: errors of loads that
come and go, what lasts (loads, and the class of the busbar's meter), and the flicker of the busbar's meter.
Given the states w, b and the white errors e of the members, in their modes,

    E w_x = S_xT U lam^-1 w        E b_x = C_x B^-1 b,  C = c S + s0^2 H H'        E e_x = phi H_x H' U e

and what is left is independent of all readings: the loads have one correlation time, so that w_x beyond
S_xT is another AR(1) process. With ``e = z - w - b``, z being the readings in the modes, the estimate is
linear in the posterior of (w, b, theta), and its variance follows.

A fault f at an onset moves the filter by its signature g and the residuals by u f; false powers and a false
busbar voltage move the model as well, by ``effect``. With amounts of the mean f and the covariance of
`gridsec.estimators.modal.search`, the estimate moves by ``T f`` and its variance grows by ``diag(T cov T')``.
Several explanations are mixed with their weights; their disagreement is part of the variance.

References
----------
Särkkä, Bayesian Filtering and Smoothing, 2013, A.1 (Gaussian conditioning).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gridsec.arrays import Bools, Floats, indices, submatrix
from gridsec.estimators.modal.filter import FilterState, Full, Update
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.search import Identification, SearchProblem, amounts
from gridsec.estimators.modal.signatures import Joint
from gridsec.estimators.modal.static import Static

COUNTED = 1e-5
"""Weight from which on an explanation counts in the estimate, 1: 100 deviations apart, it adds a tenth."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimator:
    """Regression of the places on the modes. n places, t modes.

    Attributes
    ----------
    of_w, of_b, of_e : (n, t)
        Regression of the error of the model at each place on w, b and e.
    rest : (n,)
        Variance that no reading takes away, squared pu^2.
    rest_w : (n,)
        Part of it that varies with the loads, squared pu^2.
    """

    of_w: Floats = field(repr=False)
    of_b: Floats = field(repr=False)
    of_e: Floats = field(repr=False)
    rest: Floats
    rest_w: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Estimated:
    """Errors of the model at n places.

    Attributes
    ----------
    mean, variance : (n,)
        Expected true squared voltage minus that of the model, squared pu, and its variance.
    """

    mean: Floats
    variance: Floats


def estimator(modes: Modes) -> Estimator:
    """Prepare the estimate at all places; O(n t^2).

    Parameters
    ----------
    modes
        The modes.
    """
    model, at = modes.model, modes.at
    S, H = model.of_meters[:, at], model.phases(at)
    known = modes.loads > 0.0
    h = S @ modes.U
    ratio = h * np.where(known, 1.0 / np.where(known, modes.loads, 1.0), 0.0)
    C = model.lasting * S + model.busbar * (model.busbar_of @ H.T)
    by_b = np.linalg.solve(model.static(at), C.T).T if C.any() else np.zeros_like(C)
    by_e = model.flicker * (model.busbar_of @ (H.T @ modes.U))
    phases = (model.busbar_of**2).sum(axis=1)
    rest_w = (1.0 - model.lasting) * (model.variance - (ratio * h).sum(axis=1))
    rest = rest_w + model.lasting * model.variance + model.busbar * phases - (by_b * C).sum(axis=1)
    rest += model.flicker * phases - (by_e * by_e).sum(axis=1)
    return Estimator(ratio, by_b @ modes.back, by_e, np.maximum(rest, 0.0), np.maximum(rest_w, 0.0))


def honest(
    modes: Modes,
    made: Estimator,
    state: FilterState,
    static: Static,
    update: Update,
    *,
    loads: float = 1.0,
) -> Estimated:
    """Estimate without a fault; O(n t).

    Parameters
    ----------
    modes, made
        The modes, and the estimator of them.
    state, static, update
        The filter after the last tick, the information about the directions, and the filter's last step.
    loads
        Variance of the loads' errors that vary, in those of the model, 1.
    """
    more = (loads - 1.0) * made.rest_w
    if state.full is not None:
        return _full(modes, made, state.full, static.score, more)
    w, b = state.mean
    e = update.innovation / update.variance
    by_w, by_b = made.of_w - made.of_e, made.of_b - made.of_e
    variance = (by_w * by_w) @ state.cov[0] + (by_b * by_b) @ state.cov[2]
    variance += 2.0 * ((by_w * by_b) @ state.cov[1]) + made.rest + more
    mean = made.of_w @ w + made.of_b @ b + made.of_e @ e
    if modes.sign.size:
        moved = _theta(modes, made, static)
        mean += moved @ static.theta
        variance += np.einsum("xr,rs,xs->x", moved, static.cov, moved)
    return Estimated(mean, np.maximum(variance, 0.0))


def _full(modes: Modes, made: Estimator, full: Full, score: Floats, more: Floats) -> Estimated:
    """Estimate by the full covariance: the flicker is seen by the members with a reading only."""
    model, by_e = modes.model, _flicker(modes, full)
    by_w, by_b = made.of_w @ modes.U.T, made.of_b @ modes.U.T
    mean = by_w @ full.mean[0] + by_b @ full.mean[1] + made.of_e @ score
    read = ((by_e @ model.phases(modes.at)) * model.busbar_of).sum(axis=1)
    unread = (made.of_e**2).sum(axis=1) - model.flicker * read
    by = np.hstack([by_w - by_e, by_b - by_e])
    return Estimated(mean, np.maximum(((by @ full.cov) * by).sum(axis=1) + made.rest + more + unread, 0.0))


def _theta(modes: Modes, made: Estimator, static: Static) -> Floats:
    """Change of the estimate per amount of each direction, (n, r)."""
    g_w, g_b = static.signature
    by = made.of_w * -g_w + made.of_b * (1.0 - g_b) - made.of_e * (1.0 - g_w - g_b)
    return np.asarray(by @ modes.directions)


def moves(  # noqa: PLR0917  # the state, and the faults
    modes: Modes, made: Estimator, state: FilterState, joint: Joint, W: Floats, effect: Floats
) -> Floats:
    """Change T of the honest estimate per amount of each fault at one onset, (n, q).

    Parameters
    ----------
    modes, made, state
        The modes, the estimator of them, and the filter after the last tick.
    joint
        Joint scores of the onset.
    W : (t, q)
        Columns of the faults in the modes.
    effect : (n, q)
        Change of the model at each place by the faults: zero for meters.
    """
    felt = joint.level * np.eye(modes.size) - joint.shift[0] - joint.shift[1]
    by_e = made.of_e
    if state.full is not None:
        by_e = _flicker(modes, state.full) @ modes.back
    by = made.of_w @ joint.shift[0] + made.of_b @ joint.shift[1] + by_e @ felt
    return np.asarray(effect - by @ W)


def _flicker(modes: Modes, full: Full) -> Floats:
    """Regression of the flicker at all places on the white errors of the members with a reading, (n, t)."""
    model, n = modes.model, indices(full.seen)
    by_e = np.zeros((len(model.busbar_of), modes.size))
    if n.size:
        own = np.linalg.solve(submatrix(modes.noise, n, n), model.phases(modes.at[n]))
        by_e[:, n] = model.flicker * (model.busbar_of @ own.T)
    return by_e


def corrected(before: Sequence[Estimated], T: Sequence[Floats], found: Identification) -> Estimated:
    """Estimate mixed over the explanations.

    Parameters
    ----------
    before
        The honest estimate under each model of the loads.
    T : (n, q) each
        From `moves`, of all faults of the problem, under each model.
    found
        The explanations.
    """
    counted = found.weight >= COUNTED
    weight = found.weight[counted] / found.weight[counted].sum()
    each = [
        _one(before[model], T[model], found.problems[model], chosen)
        for model, chosen in zip(found.model[counted], found.chosen[counted], strict=True)
    ]
    means = np.stack([one.mean for one in each])
    mean = weight @ means
    spread = weight @ (np.stack([one.variance for one in each]) + (means - mean) ** 2)
    return Estimated(mean, spread)


def _one(before: Estimated, T: Floats, problem: SearchProblem, chosen: Bools) -> Estimated:
    """Estimate under one explanation."""
    at = np.flatnonzero(chosen)
    if not at.size:
        return before
    mean, cov = amounts(problem, chosen)
    moved = T[:, at]
    more = np.einsum("xq,qr,xr->x", moved, cov, moved)
    return Estimated(before.mean + moved @ mean, before.variance + more)
