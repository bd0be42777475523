"""Voltages at all places from the filter, corrected for suspected faults.

The squared voltage at place x exceeds the front end's model by ``w_x + b_x + e_x``: errors of loads that
come and go, what lasts (the class of the busbar's meter), and the flicker of the busbar's meter.
Given the states w, b and the white errors e of the members, in their modes,

    E w_x = S_xT U lam^-1 w        E b_x = C_x B^-1 b,  C = s0^2 H H'        E e_x = phi H_x H' U e

and what is left is independent of all readings: the loads have one correlation time, so that w_x beyond
S_xT is another AR(1) process. With ``e = z - w - b``, z being the readings in the modes, the estimate is
linear in the posterior of (w, b, theta), and its variance follows. With A the unknown directions of the tick,

    E e_x = phi H_x H' (D + A A')^-1 (z - w - b)

in the coordinates of the meters: most of the rest is that of the unknown directions.

A fault f at an onset moves the filter by its signature g and the residuals by u f; false powers and a false
busbar voltage move the model as well, by ``effect``. With amounts of the mean f and the covariance of
`gridsec.estimators.modal.costs`, the estimate moves by ``T f`` and its variance grows by ``diag(T cov T')``.
Several explanations are mixed with their weights; their disagreement is part of the variance. The weights
are only as right as the model. An explanation of at least the weight `DOUBT` keeps meters from being named;
it counts in the variance with at least the share `POSSIBLE`.

Where no explanation fits, the model is wrong for some ticks. The stated variance is that of the model times
the mean square of the innovations since the onset that the best explanation and chance leave, at least 1.

References
----------
Särkkä, Bayesian Filtering and Smoothing, 2013, A.1 (Gaussian conditioning).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from gridsec.arrays import PENDING, Floats, deferred, indices, submatrix
from gridsec.estimators.front.output import BoundedEstimate, BoundInputs
from gridsec.estimators.modal.costs import explained
from gridsec.estimators.modal.filter import FilterState, Full
from gridsec.estimators.modal.model import Modes
from gridsec.estimators.modal.replay import Suspected
from gridsec.estimators.modal.search import DOUBT, Identification
from gridsec.estimators.modal.signatures import Joint
from gridsec.estimators.modal.static import Static
from gridsec.interface import Estimate

ROUNDING = 1e-12
"""Relative size of singular values that are rounding, 1."""
POSSIBLE = 0.05
"""Least share in the variance of an explanation that is not beyond doubt, 1: it is within 4.5 deviations."""
COUNTED = 1e-5
"""Weight from which on an explanation counts in the estimate, 1: 100 deviations apart, it adds a tenth."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimator:
    """Regression of the places on the modes. n places, t modes.

    Attributes
    ----------
    of_parts : (n, t + k)
        Covariance h of the loads at each place with the modes, and L.
    by_w : (t,)
        Regression of each mode's loads on w: that of the places is ``h diag(by_w)``.
    right : (k, 2 t)
        R of the regression ``L R`` of the places on (b, e), of a few directions: the busbar's phases.
    rest : (n,)
        Variance that no reading takes away, squared pu^2.
    rest_w : (n,)
        Part of it that varies with the loads, squared pu^2.
    """

    of_parts: Floats = field(repr=False)
    by_w: Floats = field(repr=False)
    right: Floats = field(repr=False)
    rest: Floats
    rest_w: Floats

    @property
    def of_w(self) -> Floats:
        """Regression of the error of the model at each place on w, (n, t)."""
        return self.of_parts[:, : self.by_w.size] * self.by_w

    @property
    def of_b(self) -> Floats:
        """The same on b, (n, t)."""
        return np.asarray(self.of_parts[:, self.by_w.size :] @ self.right[:, : self.by_w.size])

    @property
    def of_e(self) -> Floats:
        """The same on the white errors, (n, t)."""
        return np.asarray(self.of_parts[:, self.by_w.size :] @ self.right[:, self.by_w.size :])


@dataclass(frozen=True, eq=False)
class Estimated:
    """Errors of the model at n places.

    Attributes
    ----------
    mean : (n,)
        Expected true squared voltage minus that of the model, squared pu.
    spread
        The variance of the mean, (n,), squared pu^2. It takes longer than the rest of a step.
    rest : (t,) or None
        Residuals of the last tick less the means of w, b and the faults, squared pu; None without unknown
        directions.
    beyond
        Mean square of the whitened innovations that the explanations leave, at least 1: the errors have about
        that variance, in the stated one.
    """

    mean: Floats
    spread: Callable[[], Floats] = field(repr=False)
    rest: Floats | None = None
    beyond: float = 1.0

    @cached_property
    def variance(self) -> Floats:
        """Variance of the mean, (n,), squared pu^2, computed on first access."""
        return self.spread()


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
    by_w = np.where(known, 1.0 / np.where(known, modes.loads, 1.0), 0.0)
    ratio = h * by_w
    C = model.busbar * (model.busbar_of @ H.T)
    by_b = np.linalg.solve(model.static(at), C.T).T if C.any() else np.zeros_like(C)
    by_e = model.flicker * (model.busbar_of @ (H.T @ modes.U))
    phases = (model.busbar_of**2).sum(axis=1)
    rest_w = model.variance - (ratio * h).sum(axis=1)
    rest = rest_w + model.busbar * phases - (by_b * C).sum(axis=1)
    rest += model.flicker * phases - (by_e * by_e).sum(axis=1)
    left, right = _factors(np.hstack([by_b @ modes.back, by_e]))
    return Estimator(
        of_parts=np.hstack([h, left]),
        by_w=by_w,
        right=right,
        rest=np.maximum(rest, 0.0),
        rest_w=np.maximum(rest_w, 0.0),
    )


def _factors(matrix: Floats) -> tuple[Floats, Floats]:
    """Factors (n, k) and (k, m) of a matrix of rank k, to rounding."""
    left, size, right = np.linalg.svd(matrix, full_matrices=False)
    k = int(np.count_nonzero(size > ROUNDING * size.max(initial=0.0)))
    return left[:, :k] * size[:k], right[:k].copy()


def honest(
    modes: Modes,
    made: Estimator,
    state: FilterState,
    static: Static,
    *,
    loads: float = 1.0,
) -> Estimated:
    """Estimate without a fault; O(n t).

    The white errors e are the score of the innovation: their covariance is the identity.

    Parameters
    ----------
    modes, made
        The modes, and the estimator of them.
    state, static
        The filter after the last tick, and the information about the directions.
    loads
        Variance of the loads' errors that vary, in those of the model, 1.
    """
    if state.full is not None:
        w, b = state.full.mean @ modes.U
        spread = partial(_full_variance, modes, made, state.full, loads)
        return Estimated(_mean(made, w, b, static.score), spread, state.full.rest)
    w, b = state.mean
    if modes.sign.size:
        g_w, g_b = static.signature
        w, b = w - g_w * static.constant, b + (1.0 - g_b) * static.constant
    mean = _mean(made, w, b, static.score)
    return Estimated(mean, partial(_variance, modes, made, state.cov, static, loads))


def _mean(made: Estimator, w: Floats, b: Floats, e: Floats) -> Floats:
    """Regression of all places on w, b and e, (n,); or on columns of these."""
    parts = np.concatenate([(made.by_w * w.T).T, made.right @ np.concatenate([b, e])])
    return np.asarray(made.of_parts @ parts)


def _variance(modes: Modes, made: Estimator, cov: Floats, static: Static, loads: float) -> Floats:
    """Variance by the covariance of the modes (3, t) and of the directions, (n,).

    With e = z - w - b the regression is ``h diag(by_w) - L R_e`` on w and ``L (R_b - R_e)`` on b. Its squares
    are those of h and a few products, so that no array but h has n t entries.
    """
    t, (var_w, both, var_b), G, (g_w, g_b) = made.by_w.size, cov, modes.directions, static.signature
    h, L, D = made.of_parts[:, :t], made.of_parts[:, t:], made.by_w
    R_b, R_e = made.right[:, :t], made.right[:, t:]
    S = R_b - R_e
    inner = (R_e * var_w) @ R_e.T + (S * var_b) @ S.T
    mixed = (R_e * both) @ S.T
    inner -= mixed + mixed.T
    of_h = h @ np.hstack([D[:, None] * (S * both - R_e * var_w).T, (D * g_w)[:, None] * G])
    out = (h * h) @ (D * D * var_w) + ((2.0 * of_h[:, : L.shape[1]] + L @ inner) * L).sum(axis=1)
    # Change of the estimate per amount of each direction, (n, r).
    moved = R_b @ (G * (1.0 - g_b)[:, None]) - R_e @ (G * (1.0 - g_w - g_b)[:, None])
    moved = L @ moved - of_h[:, L.shape[1] :]
    out += made.rest + (loads - 1.0) * made.rest_w + ((moved @ static.cov) * moved).sum(axis=1)
    return np.asarray(np.maximum(out, 0.0))


def _full_variance(modes: Modes, made: Estimator, full: Full, loads: float) -> Floats:
    """Variance by the full covariance, (n,): the flicker is seen by the members with a reading only."""
    model, by_e = modes.model, np.matmul(*_flicker(modes, full))
    read = ((by_e @ model.phases(modes.at)) * model.busbar_of).sum(axis=1)
    unread = (made.of_e**2).sum(axis=1) - model.flicker * read
    by = np.hstack([made.of_w @ modes.U.T - by_e, made.of_b @ modes.U.T - by_e])
    more = (loads - 1.0) * made.rest_w + unread
    out = ((by @ full.cov) * by).sum(axis=1) + made.rest + more
    return np.asarray(np.maximum(out, 0.0))


def moves(  # noqa: PLR0917  # the state, and the faults
    modes: Modes, made: Estimator, state: FilterState, since: Joint | Suspected, x: Floats, effect: Floats
) -> Floats:
    """Change of the honest estimate by some faults since one onset, (n, k).

    With unknown directions, t rows follow: the change of `Estimated.rest` when the faults are taken away.

    Parameters
    ----------
    modes, made, state
        The modes, the estimator of them, and the filter after the last tick.
    since
        Scores of the onset.
    x : (t, k)
        The faults at the members.
    effect : (n, k)
        Change of the model at each place by the faults: zero for meters.
    """
    w, b = since.moved(modes, x)
    felt = since.level * (modes.U.T @ x) - w - b
    if state.full is None:
        return np.asarray(effect - _mean(made, w, b, felt))
    (places, by_e), felt = _flicker(modes, state.full), modes.back @ felt
    moved = effect - _mean(made, w, b, np.zeros_like(felt)) - places @ (by_e @ felt)
    return np.asarray(moved if state.full.unknown is None else np.vstack([moved, -felt]))


def _flicker(modes: Modes, full: Full) -> tuple[Floats, Floats]:
    """Factors of the regression of the flicker at all places on z - w - b of the members, (n, b), (b, t).

    Of members with a reading.
    """
    model, n = modes.model, indices(full.seen)
    by_e = np.zeros((modes.size, model.busbar_of.shape[1]))
    if n.size:
        noise = submatrix(modes.noise, n, n)
        if full.unknown is not None:
            noise = noise + full.unknown[n] @ full.unknown[n].T
        by_e[n] = np.linalg.solve(noise, model.phases(modes.at[n]))
    return model.flicker * model.busbar_of, by_e.T


def corrected(before: Sequence[Estimated], T: Sequence[Floats], found: Identification) -> Estimated:
    """Estimate mixed over the explanations.

    Parameters
    ----------
    before
        The honest estimate under each model of the loads.
    T : (n, q) each
        From `moves`, of all faults of the problem, under each model; any value for faults of none of weight.
    found
        The explanations.
    """
    counted = found.weight >= COUNTED
    weight = found.weight[counted] / found.weight[counted].sum()
    model, chosen = found.model[counted], found.chosen[counted]
    means, by_amounts = np.empty((weight.size, len(T[0]))), np.zeros(len(T[0]))
    models, n = np.unique(model).tolist(), before[0].mean.size
    for k in models:
        of = model == k
        moved, variance = explained(found.problems[k], chosen[of], weight[of], T[k])
        parts = [before[k].mean, before[k].rest]
        means[of] = np.concatenate([each for each in parts if each is not None]) + moved
        by_amounts += variance
    mean, rest = np.split(weight @ means, [n])
    means, by_amounts = means[:, :n], by_amounts[:n]

    def spread() -> Floats:
        before_each = sum(weight[model == k].sum() * before[k].variance for k in models)
        apart = (means - mean) ** 2
        possible = apart[weight >= DOUBT].max(axis=0)
        return np.asarray(np.maximum(before_each + by_amounts + weight @ apart, POSSIBLE * possible))

    return Estimated(mean, spread, rest if rest.size else None)


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Variance of the voltages at all places, (n,), evaluated where asked for.

    Attributes
    ----------
    errors
        Errors of the model.
    more : (n,)
        Variance of unknown directions, squared pu^2.
    places, least
        The busbar, and its least variance, squared pu^2; None for no limit.
    scale
        Factor of the variance of the errors, 1.
    """

    errors: Estimated
    more: Floats | float = 0.0
    places: slice | None = None
    least: Floats | float = 0.0
    scale: float = 1.0

    def __call__(self) -> Floats:
        """The variance, (n,), squared pu^2."""
        out = self.scale * self.errors.variance + self.more
        if self.places is not None:
            out[self.places] = np.maximum(out[self.places], self.least)
        return out


class Reconstructed(BoundedEstimate):
    """Estimate with a standard deviation computed on first access, which takes longer than a step."""

    __slots__ = ("_variance",)
    _variance: Callable[[], Floats]

    @classmethod
    def later(
        cls, grounds: BoundInputs, t: float, v2_bus: Floats, variance: Callable[[], Floats], x: Floats
    ) -> Reconstructed:
        """Estimate at Unix time t, s, with the function `variance` of the variance at every place, (n,)."""
        made = cls(t, v2_bus[grounds.plant.feeder.bus], PENDING, v2_bus, grounds.trusted, x, PENDING)
        object.__setattr__(made, "_grounds", grounds)
        object.__setattr__(made, "_variance", variance)
        return made

    @deferred(Estimate)
    def std(self) -> Floats:
        """Standard deviation of `v2`, (N,)."""
        return np.sqrt(self._variance()[self._grounds.plant.feeder.bus])
