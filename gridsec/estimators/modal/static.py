"""Errors that last and are not diagonal in the modes: directions with a Gaussian amount, exactly.

The filter of `gridsec.estimators.modal.filter` runs with ``B = kappa D``. The rest of B is that of ``G
theta`` with ``theta ~ N(0, diag(sign))``. Its effect on the innovations since the start is known, mode by
mode: with the signature of a constant unit error,

    gamma = 1 - rho g_w - rho_b g_b,   g <- (rho g_w, rho_b g_b) + k gamma

the innovations are ``gamma * (Gamma theta) + white``, ``Gamma = U' G``. So

    a += gamma nu / v,   i += gamma^2 / v
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

from gridsec.arrays import Floats, changed
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
    pull : (r,)
        ``Gamma' a``.
    information : (t,)
        i.
    theta : (r,)
        Posterior mean of the amounts.
    cov : (r, r)
        N of the tick at which it was computed last.
    score : (t,)
        ``V^-1`` times the exact innovation of the last tick, in the modes.
    constant : (t,)
        ``Gamma theta``.
    square
        Squares of the whitened innovation of the last tick, 1: their number is expected without a fault.
    """

    signature: Floats
    gamma: Floats
    pull: Floats
    information: Floats
    theta: Floats
    cov: Floats = field(repr=False)
    score: Floats
    constant: Floats
    square: float = 0.0


def start(modes: Modes) -> Static:
    """No information yet.

    Parameters
    ----------
    modes
        The modes.
    """
    zero = np.zeros(modes.size)
    none, prior = np.zeros(modes.sign.size), np.diag(modes.sign)
    return Static(np.zeros((2, modes.size)), zero, none, zero, none, prior, zero, zero)


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
    exact, nu = update.exact, update.innovation
    square = 0.0 if exact is None else float(exact.white @ exact.white)
    if not modes.sign.size:
        score = nu / update.variance if update.score is None else update.score
        return changed(before, score=score, square=float(nu @ score) if exact is None else square)
    rho, rho_b = update.decay
    g = before.signature * np.array((rho, rho_b))[:, None]
    gamma = 1.0 - g[0] - g[1]
    g += update.gain * gamma
    relative = gamma / update.variance
    information = before.information + relative * gamma
    if update.score is not None:
        # The innovation is exact without theta, which says only how a fault would have been learned.
        now = changed(before, information=information)
        cov, turn = before.cov, np.zeros(modes.sign.size)
        if modes.sign.size <= FEW:
            cov, turn = current(modes, now).cov, cov @ ((gamma * update.score) @ modes.directions)
        elif modes.busbar:
            G = modes.directions[:, : modes.busbar]
            turn[: modes.busbar] = of_busbar(modes, now) @ ((gamma * update.score) @ G)
        theta = before.theta + turn
        constant = modes.directions @ theta
        return Static(g, gamma, before.pull, information, theta, cov, update.score, constant, square)
    pull = before.pull + (relative * nu) @ modes.directions
    theta, cov = _learned(modes, before, information, pull)
    score, constant = nu / update.variance, modes.directions @ theta
    score -= relative * constant
    # The exact innovation is that less the amounts before this tick.
    square = float((nu - gamma * before.constant) @ score)
    return Static(g, gamma, pull, information, theta, cov, score, constant, square)


def _learned(modes: Modes, before: Static, information: Floats, pull: Floats) -> tuple[Floats, Floats]:
    """Theta of this tick, (r,), and N of this tick or an earlier one, (r, r)."""
    if modes.sign.size > FEW:
        theta, near = before.theta, CLOSE * float(np.abs(pull).max(initial=0.0))
        for _ in range(REFINEMENTS):
            rest = pull - _precision_times(modes, information, theta)
            if float(np.abs(rest).max()) <= near:
                return theta, before.cov
            theta = theta + before.cov @ rest
    cov = _covariance(modes, information)
    return cov @ pull, cov


def _precision_times(modes: Modes, information: Floats, theta: Floats) -> Floats:
    """``N^-1 theta`` by the information (t,), (r,)."""
    G = modes.directions
    return np.asarray(modes.sign * theta + (information * (G @ theta)) @ G)


def current(modes: Modes, now: Static) -> Static:
    """The same with N of this tick; O(t r^2).

    Parameters
    ----------
    modes, now
        The modes, and the information so far.
    """
    return replace(now, cov=_covariance(modes, now.information))


def _covariance(modes: Modes, information: Floats) -> Floats:
    """N by the information, (r, r)."""
    G = modes.directions
    if modes.sign.size == 1:
        one = G[:, 0]
        return np.array([[1.0 / (modes.sign[0] + one @ (information * one))]])
    return np.asarray(np.linalg.inv(np.diag(modes.sign) + (G.T * information) @ G), np.float64)


def of_busbar(modes: Modes, now: Static) -> Floats:
    """N of this tick with the directions of the busbar alone, (b, b)."""
    sign, G = modes.sign[: modes.busbar], modes.directions[:, : modes.busbar]
    return np.asarray(np.linalg.inv(np.diag(sign) + (G.T * now.information) @ G), np.float64)


def restored(modes: Modes, now: Static) -> Static:
    """The same with the pull and the constant errors that belong to theta: the modal filter goes on with it.

    Parameters
    ----------
    modes, now
        The modes, and the information so far.
    """
    if not modes.sign.size:
        return now
    pull = _precision_times(modes, now.information, now.theta)
    return replace(now, pull=pull, constant=modes.directions @ now.theta)
