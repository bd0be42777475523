"""Errors that last and are not diagonal in the modes: directions with a Gaussian amount, exactly.

The filter of `gridsec.estimators.modal.filter` runs with ``B = kappa D + c S``. The rest of B is that of ``G
theta`` with ``theta ~ N(0, diag(sign))``. Its effect on the innovations since the start is known, mode by
mode: with the signature of a constant unit error,

    gamma = 1 - rho g_w - rho_b g_b,   g <- (rho g_w, rho_b g_b) + k phi gamma

the innovations are ``gamma * (Gamma theta) + white``, ``Gamma = U' G``. So

    a += gamma nu / v,   i += gamma^2 phi / v
    N = (diag(sign) + Gamma' diag(i) Gamma)^-1,   theta = N Gamma' a

is the posterior of theta, and ``nu - gamma Gamma theta`` with the covariance ``diag(v) + gamma Gamma N
Gamma' gamma`` the innovation of the exact filter: that of the filter with all states, to rounding.

With few directions N is computed at every tick. With many, theta follows from an earlier N by iterative
refinement, and N is computed anew only where three refinements do not suffice: its information saturates, so
that happens ever more rarely.

References
----------
Friedland, Treatment of bias in recursive filtering, IEEE Trans. Automatic Control 14, 1969.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Floats
from gridsec.estimators.modal.filter import Update
from gridsec.estimators.modal.model import Modes

FEW = 6
"""Number of directions up to which N is computed at every tick: that costs less than a refinement."""
REFINEMENTS = 3
"""Refinements of theta per tick before N is computed anew."""
CLOSE = 1e-10
"""Relative residual at which theta is exact enough, 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Static:
    """Information about the directions since the start. t modes, r directions.

    Attributes
    ----------
    signature : (2, t)
        g of w and of b, after the last update.
    gamma : (t,)
        Effect of a unit error on the last innovation.
    score, information : (t,)
        a and i.
    theta : (r,)
        Posterior mean of the amounts.
    cov : (r, r)
        N of the tick at which it was computed last.
    """

    signature: Floats
    gamma: Floats
    score: Floats
    information: Floats
    theta: Floats
    cov: Floats = field(repr=False)


def start(modes: Modes) -> Static:
    """No information yet.

    Parameters
    ----------
    modes
        The modes.
    """
    zero = np.zeros(modes.size)
    prior = np.diag(modes.sign)
    return Static(np.zeros((2, modes.size)), zero, zero, zero, np.zeros(modes.sign.size), prior)


def follow(modes: Modes, before: Static, update: Update) -> Static:
    """Take in one step of the filter; O(t r).

    Parameters
    ----------
    modes
        The modes.
    before
        So far.
    update
        The filter's step.
    """
    if not modes.sign.size:
        return before
    rho, rho_b = update.decay
    g = before.signature * np.array([[rho], [rho_b]])
    gamma = 1.0 - g[0] - g[1]
    g += update.gain * (gamma if update.kept is None else gamma * update.kept)
    score = before.score + gamma * update.innovation / update.variance
    information = before.information + gamma * gamma * update.precision
    now = Static(g, gamma, score, information, before.theta, before.cov)
    if modes.sign.size <= FEW:
        return _anew(modes, now)
    right, theta = score @ modes.directions, before.theta
    near = CLOSE * float(np.abs(right).max(initial=0.0))
    for _ in range(REFINEMENTS):
        rest = right - modes.sign * theta - (information * (modes.directions @ theta)) @ modes.directions
        if float(np.abs(rest).max()) <= near:
            return replace(now, theta=theta)
        theta = theta + before.cov @ rest
    return _anew(modes, now)


def _anew(modes: Modes, now: Static) -> Static:
    """The same with N and theta of this tick."""
    G = modes.directions
    if modes.sign.size == 1:
        one = G[:, 0]
        single = np.array([[1.0 / (modes.sign[0] + one @ (now.information * one))]])
        return replace(now, cov=single, theta=single[0] * (now.score @ one))
    cov = np.asarray(np.linalg.inv(np.diag(modes.sign) + (G.T * now.information) @ G), np.float64)
    return replace(now, cov=cov, theta=cov @ (now.score @ G))


def offset(modes: Modes, static: Static) -> Floats:
    """Posterior mean of ``Gamma theta`` in the modes, (t,).

    Parameters
    ----------
    modes, static
        The modes, and the information so far.
    """
    return modes.directions @ static.theta
