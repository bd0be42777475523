"""Fixed errors of single meters, and those that exceed their accuracy class.

The errors that last are ``b = c + H x``: own errors c of the meters, ``c_j ~ N(0, phi_j)``, and the error x
of the busbar's meter at its phases H. With ``K = diag(phi) B^-1`` the own errors are ``c = K b + r``, r
independent of b and of all readings, so that their posterior means and variances are

    m = K E b,    v = phi - diag(K (B - P) K'),    P = cov b

**Class.** A Gaussian prior is a description of many meters. It allows one meter six standard deviations, and
the filter learns such a lie within minutes, if it begins with the first reading. An accuracy class is a
bound: ``|c_j| <= a_j``. What the readings alone say of c_j is a Gaussian likelihood L with the information G
and the score g,

    G = 1 / v - 1 / phi,    g = m / v,    log L(c) = g c - G c^2 / 2

and for any own error within the class, as constant as it may be,

    Lambda_j = integral L(c) N(c; 0, s^2) dc / max over |c| <= a_j of L(c)

has a mean of at most 1 at every tick: the denominator is at least L of the true error [1]_. With
G = 1 / sigma^2 and c^ = g / G,

    2 log Lambda_j = (|c^| - a)+^2 / sigma^2 - c^2 / (sigma^2 + s^2) - log(1 + s^2 / sigma^2)

A meter exceeds its class where ``Lambda_j >= p gamma``. By a union over the p meters, and with Ville's
inequality, that happens by chance in at most one of gamma starts, as long as the other errors have the
model's distributions. With an enlarged covariance, after missing readings and restarts, Lambda is
approximate. The comparison is beside the detector: it says nothing about an onset.

**Errors alike.** The filter takes own errors for independent. Classes do not say so: meters of one kind may
all be at the same end. Such an error looks like one of the busbar's meter in the opposite direction. With the
score y and the information F of the busbar's phase since the start, it gains ``max 2 y c - c^2 F`` over
``|c| <= a``. A fault since the start counts only where it gains more by ``2 log (p gamma)``.

References
----------
.. [1] Wasserman, Ramdas and Balakrishnan, Universal inference, PNAS 117, 2020.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, log

import numpy as np

from gridsec.arrays import Bools, Floats, any_of
from gridsec.estimators.modal.detector import SIZE
from gridsec.estimators.modal.filter import FilterState
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.static import Static

KNOWN = 0.5
"""Part of the prior variance below which an own error counts, 1.

An enlarged covariance of the filter, as after missing readings, inflates the score of a hardly known one.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Classes:
    """Regression of the meters' own errors on all errors that last. p meters, t modes.

    Attributes
    ----------
    own, of_modes : (p, t)
        K, and K on the modes.
    fixed, allowed : (p,)
        phi, squared pu^2, and a, squared pu; infinite for no bound.
    unseen : (p,)
        Variance that no knowledge of b takes away, ``phi - diag(K B K')``, squared pu^2.
    """

    own: Floats = field(repr=False)
    of_modes: Floats = field(repr=False)
    fixed: Floats
    allowed: Floats
    unseen: Floats


def classes(modes: Modes, allowed: Floats) -> Classes:
    """Prepare the own errors of the members; O(t^3).

    Parameters
    ----------
    modes
        The modes.
    allowed : (t,)
        Largest fixed error within the class of each member, squared pu; infinite for no bound.
    """
    fixed = modes.model.fixed[modes.at]
    own = np.asarray(np.linalg.solve(modes.covariance_b, np.diag(fixed)).T, np.float64)
    unseen = fixed - ((own @ modes.covariance_b) * own).sum(axis=1)
    return Classes(own, own @ modes.back, fixed, allowed, np.maximum(unseen, 0.0))


def means(made: Classes, modes: Modes, state: FilterState, static: Static) -> Floats:
    """Posterior means of the own errors, (p,), squared pu at 1 pu.

    Parameters
    ----------
    made, modes
        The own errors, and the modes.
    state, static
        The filter after the last tick, and the information about the directions.
    """
    if state.full is not None:
        return np.asarray(made.own @ state.full.mean[1])
    b = state.mean[1]
    if modes.sign.size:
        b = b + (1.0 - static.signature[1]) * static.constant
    return np.asarray(made.of_modes @ b)


def variances(made: Classes, modes: Modes, state: FilterState, static: Static) -> Floats:
    """Posterior variances of the own errors, (p,), squared pu^2; O(p t), and O(p t^2) with a full covariance.

    Parameters
    ----------
    made, modes, state, static
        As in `means`.
    """
    if state.full is not None:
        known = ((made.own @ state.full.blocks[2]) * made.own).sum(axis=1)
        return np.asarray(np.minimum(made.unseen + known, made.fixed))
    known = (made.of_modes * made.of_modes) @ state.cov[2]
    if static.theta.size:
        moved = made.of_modes @ ((1.0 - static.signature[1])[:, None] * modes.directions)
        known += ((moved @ static.cov) * moved).sum(axis=1)
    return np.asarray(np.minimum(made.unseen + known, made.fixed))


def exceeding(  # noqa: PLR0917  # the filter, and the meters with the limit
    made: Classes, modes: Modes, state: FilterState, static: Static, counted: Bools, limit: float
) -> Bools:
    """Meters with an own error beyond their class, (p,).

    Parameters
    ----------
    made, modes, state, static
        As in `means`.
    counted : (p,)
        Meters that are compared.
    limit
        log gamma.
    """
    return log_lambda(made, modes, state, static, counted) >= limit + log(made.fixed.size)


def common(score: Floats, information: Floats, most: Floats) -> float:
    """Twice the logarithm of the likelihood that errors within the classes gain, alike in each phase.

    Errors of several phases are bounded one by one, so that the gain may be larger.

    Parameters
    ----------
    score, information : (b,), (b, b)
        Score and information of the phases.
    most : (b,)
        Largest error within the class of every meter of a phase, squared pu.
    """
    error = np.clip(np.linalg.lstsq(information, score)[0], -most, most)
    return float(2.0 * (error @ score) - error @ information @ error)


def log_lambda(made: Classes, modes: Modes, state: FilterState, static: Static, counted: Bools) -> Floats:
    """Logarithm of Lambda of each meter, (p,); -inf without a bound, and for a hardly known own error.

    Parameters
    ----------
    made, modes, state, static, counted
        As in `exceeding`.
    """
    v, out = variances(made, modes, state, static), np.full(made.fixed.size, -inf)
    counted = counted & (made.allowed < inf) & (v < KNOWN * made.fixed)
    if not any_of(counted):
        return out
    m = means(made, modes, state, static)[counted]
    v, phi, a = v[counted], made.fixed[counted], made.allowed[counted]
    G, g = 1.0 / v - 1.0 / phi, m / v
    wider = 1.0 + SIZE**2 * G
    beyond = np.maximum(np.abs(g) - a * G, 0.0)
    out[counted] = 0.5 * ((beyond * beyond - g * g / wider) / G - np.log(wider))
    return out
