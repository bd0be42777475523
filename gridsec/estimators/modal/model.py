"""Statistical model of the meters' residuals, and the modes in which it falls apart.

The residual of a meter is its squared reading minus the loss-corrected model at the frame's powers:

    m_t = w_t + b_t + e_t + f_t                                            (p,), squared pu

    w   errors of the loads: vector AR(1), covariance S, factor exp(-h / T)
    b   errors that last: covariance B = diag(fixed) + s0^2 H H'
    e   white: D = diag(white) + phi H H'
    f   faults

``S`` is the covariance of the voltages at the meters due to wrong powers, ``H`` the incidence of meters and
busbar phases, ``s0`` the class of the busbar's meter, ``phi`` its jitter.

**Modes.** ``U' D U = I`` and ``U' S U = diag(lam)``. In the coordinates ``z = U' m`` the white part is the
identity, w is diagonal, and b is diagonal if B is proportional to D. In general

    B = kappa D + G diag(sign) G'

with directions ``G``: one for each phase of the busbar, with ``|s0^2 - kappa phi|``, and one for each meter
with a ratio fixed / white above kappa, the least of these ratios. The filter runs with ``kappa D``,
which is diagonal, and `gridsec.estimators.modal.static` adds ``G theta``, ``theta ~ N(0, diag(sign))``,
exactly. The first part ages as an AR(1) process with the factor exp(-h / T_b); theta is constant.

References
----------
Golub and Van Loan, Matrix Computations, 8.7 (simultaneous diagonalisation of a definite pair).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, eigh, solve_triangular

from gridsec.arrays import Floats, Ints, submatrix
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators.front.design import YEAR_S, FrontDesign
from gridsec.estimators.front.posterior import voltage_prior

FIXED_S = YEAR_S
"""Time constant of fixed errors, s. Meters age over years; with a day, lies of 0.5 %/h stay hidden."""
REPORTED_S = 3600.0
"""Least correlation time where errors of reported powers last, s: parts of loads, which change in an hour."""
_LEAST_FIXED = 1e-12
"""Least variance of a fixed error, squared pu^2: a meter without one makes the covariance B singular."""
SAME = 1e-9
"""Relative difference below which two ratios or two eigenvalues are equal, 1: rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualModel:
    """Covariances of the residuals. n places, p meters, b phases of the busbar, one on a balanced feeder.

    Attributes
    ----------
    of_meters : (n, p)
        Covariance S of the squared voltage at every place with those at the meters, errors of the busbar's
        meter excluded, squared pu^2.
    variance : (n,)
        Variance at every place, squared pu^2.
    meters : (p,)
        Place of each meter.
    white, fixed : (p,)
        Variance of each meter's white error, > 0, and of its fixed error, squared pu^2.
    busbar, flicker
        Variance of the fixed and of the white error of the busbar's meter, squared pu^2.
    busbar_of : (n, b)
        1 where a place hangs on a phase of the busbar, else 0.
    time_s, fixed_s
        Time constants of w and of the part of b that ages, s; infinite for constants.

    Raises
    ------
    ValueError
        For shapes that do not fit and for numbers out of range; names every problem.
    """

    of_meters: Floats
    variance: Floats
    meters: Ints
    white: Floats
    fixed: Floats
    busbar: float
    flicker: float
    busbar_of: Floats
    time_s: float
    fixed_s: float = FIXED_S

    def __post_init__(self) -> None:
        n, p = self.variance.size, self.meters.size
        shapes = (
            ("of_meters", self.of_meters.shape, (n, p)),
            ("white", self.white.shape, (p,)),
            ("fixed", self.fixed.shape, (p,)),
            ("busbar_of", self.busbar_of.shape[:1], (n,)),
        )
        problems = [
            Problem("shape", f"{name} has the shape {got}, not {wanted}")
            for name, got, wanted in shapes
            if got != wanted
        ]
        ranges = (
            ("white", bool((self.white > 0.0).all()), "positive"),
            ("fixed", bool((self.fixed >= 0.0).all()), "at least 0"),
            ("busbar", self.busbar >= 0.0, "at least 0"),
            ("flicker", self.flicker >= 0.0, "at least 0"),
            ("time_s", self.time_s > 0.0, "positive"),
            ("fixed_s", self.fixed_s > 0.0, "positive"),
        )
        problems += [
            Problem("out-of-range", f"{name} must be {wanted}") for name, good, wanted in ranges if not good
        ]
        raise_if_any(problems)

    def loads(self, at: Ints) -> Floats:
        """Covariance S between some meters, (k, k).

        Parameters
        ----------
        at : (k,)
            The meters.
        """
        return submatrix(self.of_meters, self.meters[at], at)

    def phases(self, at: Ints) -> Floats:
        """Incidence H of some meters and the busbar's phases, (k, b).

        Parameters
        ----------
        at : (k,)
            The meters.
        """
        return self.busbar_of[self.meters[at]]

    def noise(self, at: Ints) -> Floats:
        """Covariance D of the white errors of some meters, (k, k).

        Parameters
        ----------
        at : (k,)
            The meters.
        """
        H = self.phases(at)
        return np.diag(self.white[at]) + self.flicker * (H @ H.T)

    def aging(self, at: Ints) -> Floats:
        """Covariance ``kappa D`` of the part of B that ages, (k, k).

        Parameters
        ----------
        at : (k,)
            The meters.
        """
        return self.kappa(at) * self.noise(at)

    def kappa(self, at: Ints) -> float:
        """Least ratio of fixed to white variance.

        Parameters
        ----------
        at : (k,)
            The meters.
        """
        return float((self.fixed[at] / self.white[at]).min())

    def static(self, at: Ints) -> Floats:
        """Covariance B of the errors of some meters that last, (k, k).

        Parameters
        ----------
        at : (k,)
            The meters.
        """
        H = self.phases(at)
        return np.diag(self.fixed[at]) + self.busbar * (H @ H.T)


def residual_model(design: FrontDesign) -> ResidualModel:
    """Model of the residuals of the front end.

    Parameters
    ----------
    design
        Design of the front end. Its prior counts the class of the busbar's meter among the loads; here it is
        an error that lasts. Parts of powers that change within a tick are no part of the model, but unknown
        directions of every frame (`gridsec.estimators.modal.doubts`).
    """
    feeder, doubt, meters = design.plant.feeder, design.doubt.smooth, design.prior.meters
    loads = voltage_prior(feeder, meters, doubt, busbar=0.0, inverters=design.injections)
    phases = design.busbar_incidence.shape[1]
    places = np.arange(loads.variance.size)
    return ResidualModel(
        of_meters=loads.covariance,
        variance=loads.variance,
        meters=meters,
        white=design.white,
        fixed=np.maximum(design.fixed, _LEAST_FIXED),
        busbar=design.busbar**2,
        flicker=design.busbar_noise,
        busbar_of=np.equal.outer(places % phases, np.arange(phases)).astype(np.float64),
        time_s=max(doubt.time_s, REPORTED_S) if doubt.lasting > 0.0 else doubt.time_s,
    )


@dataclass(frozen=True, eq=False)
class Modes:
    """Coordinates of t members in which the filter falls apart. r directions.

    Attributes
    ----------
    model
        The model.
    at : (t,)
        Members: the meters in use.
    U, back : (t, t)
        ``z = U' m`` and ``m = back z``; ``back = D U``.
    loads : (t,)
        Eigenvalues lam of S, in units of the white variance.
    varying, lasting : (t,)
        Variance of w and of the filter's part of b in each mode: lam and kappa.
    directions : (t, r)
        ``U' G``; those of the busbar come first.
    sign : (r,)
        +1 or -1, the prior variance of theta.
    busbar
        Number of directions of the busbar.
    white
        Mean white variance of the members, squared pu^2.
    """

    model: ResidualModel
    at: Ints
    U: Floats = field(repr=False)
    back: Floats = field(repr=False)
    loads: Floats
    varying: Floats
    lasting: Floats
    directions: Floats = field(repr=False)
    sign: Floats
    busbar: int
    white: float

    @cached_property
    def squares(self) -> Floats:
        """Squares of U, (t, t)."""
        return np.asarray(self.U * self.U)

    @cached_property
    def volume(self) -> float:
        """``log |det U|``: logarithm of a density of the readings less that of their values in the modes."""
        return float(np.linalg.slogdet(self.U)[1])

    @cached_property
    def noise(self) -> Floats:
        """Covariance D of the white errors of the members, (t, t)."""
        return self.model.noise(self.at)

    @cached_property
    def precision(self) -> Floats:
        """Inverse of `noise`, ``U U'``, (t, t)."""
        return self.U @ self.U.T

    @cached_property
    def covariance_w(self) -> Floats:
        """Covariance of w at the members, (t, t)."""
        return (self.back * self.varying) @ self.back.T

    @cached_property
    def jumps(self) -> Floats:
        """Covariance S of a change of the loads at the members, (t, t)."""
        return self.model.loads(self.at)

    @cached_property
    def covariance_b(self) -> Floats:
        """Covariance B of the members, (t, t)."""
        return self.model.static(self.at)

    @cached_property
    def phases(self) -> Floats:
        """Incidence of the members and those phases of the busbar that have any, (t, b)."""
        H = self.model.phases(self.at)
        return H[:, H.any(axis=0)]

    @cached_property
    def phase_squares(self) -> Floats:
        """Squares of the phases of the busbar in the modes, (b, t)."""
        return np.asarray((self.phases_in_modes**2).T)

    @cached_property
    def phases_in_modes(self) -> Floats:
        """Columns of the phases of the busbar in the modes, (t, b)."""
        return self.U.T @ self.phases

    @cached_property
    def crossed(self) -> Floats:
        """Products of the directions and the phases of the busbar in the modes, (t, r b)."""
        W = self.phases_in_modes
        return (self.directions[:, :, None] * W[:, None, :]).reshape(self.size, -1)

    @cached_property
    def noise_std(self) -> Floats:
        """Standard deviation of the white errors of the members, (t,)."""
        return np.asarray(np.sqrt(self.noise.diagonal()))

    @property
    def size(self) -> int:
        """Number of members and of modes, t."""
        return self.at.size


def modes(model: ResidualModel, at: Ints | None = None) -> Modes:
    """Diagonalise the model; O(t^3).

    Parameters
    ----------
    model
        The model.
    at : (t,)
        The members; None: all meters.

    Raises
    ------
    ValueError
        Without a member.
    """
    at = np.arange(model.meters.size) if at is None else np.asarray(at, dtype=np.intp)
    if not at.size:
        raise_if_any([Problem("shape", "modes need at least one meter")])
    D = model.noise(at)
    half = cholesky(D, lower=True)
    S = solve_triangular(half, solve_triangular(half, model.loads(at), lower=True).T, lower=True)
    lam, Q = eigh(0.5 * (S + S.T))
    lam = np.where(lam > SAME * lam[-1], lam, 0.0)
    U = solve_triangular(half, Q, lower=True, trans="T")
    kappa = model.kappa(at)
    G, sign, busbar = _directions(model, at, kappa)
    return Modes(
        model=model,
        at=at,
        U=U,
        back=D @ U,
        loads=lam,
        varying=lam,
        lasting=np.full(lam.size, kappa),
        directions=U.T @ G,
        sign=sign,
        busbar=busbar,
        white=float(model.white[at].mean()),
    )


def _directions(model: ResidualModel, at: Ints, kappa: float) -> tuple[Floats, Floats, int]:
    """Directions G (t, r), signs (r,), and the number of directions of the busbar."""
    ratio = model.fixed[at] / model.white[at]
    of_busbar = model.busbar - kappa * model.flicker
    H = model.phases(at)
    H = H[:, H.any(axis=0)] * np.sqrt(abs(of_busbar))
    if abs(of_busbar) <= SAME * (model.busbar + kappa * model.flicker):
        H = H[:, :0]
    above = np.flatnonzero(ratio > kappa * (1.0 + SAME))
    E = np.zeros((at.size, above.size))
    E[above, np.arange(above.size)] = np.sqrt(model.fixed[at][above] - kappa * model.white[at][above])
    sign = np.concatenate([np.full(H.shape[1], np.sign(of_busbar)), np.ones(above.size)])
    return np.hstack([H, E]), sign, H.shape[1]
