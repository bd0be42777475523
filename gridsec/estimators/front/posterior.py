"""Prior and posterior of the voltages given trusted meters: Gaussian conditioning.

Errors dp, dq of all customers move all voltages by ``2 R dp + 2 X dq``, neighbours nearly alike. This
correlation makes a manipulated meter visible among its neighbours (docs/theory-front.md, section 1).

The unknown part of the buses' squared voltages is w ~ N(0, S) with S from `voltage_prior`; a meter at bus b
reads ``m = w_b + e``, ``e ~ N(0, d)``. For trusted meters T

    Q = (S_TT + D_TT)^-1                      precision of the readings, zero elsewhere
    w_hat = S_:T Q m_T                        posterior mean
    M = S - S_:T Q S_T:                       posterior covariance

Each meter is tested by the others: the leave-one-out residual of a trusted meter is ``(Q m)_j / Q_jj`` with
variance ``1 / Q_jj``, that of any other meter ``m_j - w_hat_j`` with variance ``M_jj + d_j``. Removing a
meter changes Q by a matrix of rank one: O(n p), no factorisation.

References
----------
Dubrule 1983 (leave-one-out by one inverse), the Schur complement otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints, indices, submatrix
from gridsec.errors import Problem, raise_if_any
from gridsec.grid.devices import Droop, MeterAccuracy
from gridsec.grid.network import Network, Power

# --- Prior ---


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Covariance of the voltages without any meter. n buses, p meters."""

    covariance: Floats  # (n, p) between every bus's squared voltage and those at the meters, squared pu^2
    meters: Ints  # (p,) bus of each meter
    variance: Floats  # (n,) variance at every bus

    def among(self, at: Ints) -> Floats:
        """Covariance between the buses of meters `at` (k,), (k, k), in the order of LAPACK."""
        # Symmetric: the transpose is the same in the order of LAPACK.
        return submatrix(self.covariance, self.meters[at], at).T


EXACT = 1e-6
"""Least standard deviation of a power, pu."""


UNMETERED = 0.1
"""Standard deviation of an unmetered squared busbar voltage, squared pu."""


LONGEST_S = 1e12
"""Longest correlation time of power errors, s: longer ones leave nothing to learn."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadDoubt:
    """Uncertainty of the powers in the frames. N customers.

    Attributes
    ----------
    p, q : (N,)
        Standard deviations of the errors of active and reactive power, pu. Larger `p_error`, `q_error` of a
        frame take precedence.
    time_s
        Correlation time of these errors, s; means over much less time contain all of them.
    common_p, common_q
        Shares of the variances common to all customers (weather, time of day), 0 to 1.
    lasting
        Share of the variances that no mean reduces, 0 to 1: a wrong power factor lasts for years.
    together : (N,) or one for all
        Share of both variances in phase with that of all others, 0 to 1: unmetered loads are low together by
        night, active and reactive.
    sudden_p, sudden_q : (N,)
        Parts of p and q that may come and go within a tick, as a power older than its voltage, pu; None for
        none. `gridsec.estimators.modal.doubts` takes them as unknown at every tick.
    even_p, even_q : (N,)
        Derived: half-widths of uniform errors with standard deviations p and q, pu.
    smooth_p, smooth_q : (N,)
        Derived: p and q without their sudden parts, pu.

    Raises
    ------
    ValueError
        If a number is not finite, negative, or a share outside [0, 1]; names every problem.
    """

    p: Floats
    q: Floats
    time_s: float
    common_p: float = 0.0
    common_q: float = 0.0
    lasting: float = 0.0
    together: Floats | float = 0.0
    sudden_p: Floats | None = None
    sudden_q: Floats | None = None
    even_p: Floats = field(init=False, repr=False)
    even_q: Floats = field(init=False, repr=False)
    smooth_p: Floats = field(init=False, repr=False)
    smooth_q: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        problems = [
            Problem("negative", f"{name} must be finite and not negative")
            for name in ("p", "q", "sudden_p", "sudden_q")
            if not _sizes(getattr(self, name))
        ]
        if (self.sudden_p is None) != (self.sudden_q is None):
            problems.append(Problem("missing", "sudden_p and sudden_q belong together"))
        problems += [
            Problem("out-of-range", f"sudden_{name} must have the shape of {name}, and be at most {name}")
            for name, part, whole in (("p", self.sudden_p, self.p), ("q", self.sudden_q, self.q))
            if part is not None and (part.shape != whole.shape or (part > whole).any())
        ]
        if not 0 < self.time_s <= LONGEST_S:
            most = f"at most {LONGEST_S:g}; what never changes is `lasting`"
            problems.append(
                Problem("out-of-range", f"time_s is {self.time_s}; it must be positive and {most}")
            )
        problems += [
            Problem("out-of-range", f"{name} is {getattr(self, name)}; it must be from 0 to 1")
            for name in ("common_p", "common_q", "lasting", "together")
            if not (np.greater_equal(getattr(self, name), 0) & np.less_equal(getattr(self, name), 1)).all()
        ]
        raise_if_any(problems)
        for name, std, sudden in (("p", self.p, self.sudden_p), ("q", self.q, self.sudden_q)):
            object.__setattr__(self, f"even_{name}", np.sqrt(3.0) * np.maximum(std, EXACT))
            smooth = std if sudden is None else np.sqrt(std**2 - sudden**2)
            object.__setattr__(self, f"smooth_{name}", smooth)

    @property
    def smooth(self) -> LoadDoubt:
        """The same without the sudden parts."""
        if self.sudden_p is None:
            return self
        return replace(self, p=self.smooth_p, q=self.smooth_q, sudden_p=None, sudden_q=None)

    @property
    def own(self) -> Floats:
        """Standard deviations of the parts of p and q that are independent of other customers, (2, N), pu."""
        alone = np.sqrt(1.0 - self.together)
        p, q = np.maximum(self.p, EXACT), np.maximum(self.q, EXACT)
        return np.stack([np.sqrt(1.0 - self.common_p) * alone * p, np.sqrt(1.0 - self.common_q) * alone * q])


def _sizes(values: Floats | None) -> bool:
    """All finite and not negative."""
    return values is None or bool(np.isfinite(values).all() and (values >= 0).all())


def voltage_prior(
    feeder: Network, at: Ints, doubt: LoadDoubt, *, busbar: Floats | float, inverters: Floats | None = None
) -> Prior:
    """Covariance of the buses' squared voltages without any meter.

    ``S = 4 R V_p R^T + 4 X V_q X^T + u u^T + busbar^2 1 1^T`` with ``u = 2 R g s_p + 2 X g s_q``,
    ``g^2 = together``, and for the rest, s being ``sqrt(1 - together) s``,
    ``V = (1 - common) diag(s^2) + common s s^T``. In three phases places stand for buses, and only those of
    one phase share the busbar's error.

    at: (p,) bus of each meter. busbar: standard deviation of its squared voltage, squared pu; one or (3,).
    inverters: (N,) standard deviation of the observed injections, pu.
    """
    own, shared = _load_errors(feeder, doubt, inverters)
    of_busbar = feeder.broadcast_busbar(busbar**2)
    of_meters: Floats = np.repeat(of_busbar[:, None], at.size, axis=1)
    of_meters *= feeder.same_busbar_phase(np.arange(of_busbar.size), at)
    for power, variance in own:
        of_meters += feeder.covariance(power, at, variance)
    for direction in shared:
        of_meters += np.multiply.outer(direction, direction[at])
    return Prior(of_meters, at, _variance(feeder, own, shared, busbar))


def prior_variance(
    feeder: Network, doubt: LoadDoubt, *, busbar: Floats | float, inverters: Floats | None = None
) -> Floats:
    """Diagonal of `voltage_prior`, (n,), without the covariances."""
    return _variance(feeder, *_load_errors(feeder, doubt, inverters), busbar)


def _variance(
    feeder: Network, own: list[tuple[Power, Floats]], shared: list[Floats], busbar: Floats | float
) -> Floats:
    """Variance of every squared voltage by the errors of `_load_errors` and of the busbar, (n,)."""
    out = feeder.broadcast_busbar(busbar**2)
    for power, variance in own:
        out = out + feeder.variances(power, variance)
    for direction in shared:
        out = out + direction**2
    return out


def _load_errors(
    feeder: Network, doubt: LoadDoubt, inverters: Floats | None
) -> tuple[list[tuple[Power, Floats]], list[Floats]]:
    """Variances of the customers' independent errors, (N,) each, and directions of common ones, (n,) each."""
    alone, together = (np.sqrt(part) for part in (1.0 - doubt.together, doubt.together))
    p, q = alone * doubt.p, alone * doubt.q
    q = q if inverters is None else np.hypot(q, inverters)
    none = np.zeros_like(q)
    shared = [
        np.sqrt(common) * feeder.bus_voltages(*injected, 0.0, steps=0)
        for common, injected in ((doubt.common_p, (p, none)), (doubt.common_q, (none, q)))
        if common
    ]
    if np.any(together):
        shared.append(feeder.bus_voltages(together * doubt.p, together * doubt.q, 0.0, steps=0))
    own = [(Power.ACTIVE, (1.0 - doubt.common_p) * p**2), (Power.REACTIVE, (1.0 - doubt.common_q) * q**2)]
    return own, shared


def injection_doubt(droop: Droop, accuracy: MeterAccuracy, meters: Ints, customers: int) -> Floats:
    """Standard deviation of the observed injections by the meters' own errors, (N,) in pu.

    An inverter driven by its meter follows the fixed error of the reading through the steepest part of its
    curve, at most up to saturation.
    """
    error = np.zeros(customers)
    error[meters] = 2.0 * np.sqrt(
        accuracy.class_fraction**2 / 3.0 + accuracy.resolution**2 / 12.0 + accuracy.jitter**2
    )
    own = np.minimum(droop.slope * error[droop.customer], droop.limit)
    return np.asarray(np.sqrt(droop.per_customer(own**2, customers)))


# --- Posterior ---


@dataclass(slots=True, eq=False)
class Posterior:
    """Posterior given trusted meters, changed in place by `remove_meter`. n buses, p meters."""

    prior: Prior  # prior of the voltages
    noise: Floats  # (p,) variance d of each reading
    trusted: Bools  # (p,) meters conditioned on
    Q: Floats  # (p, p) precision of the trusted meters, zero elsewhere
    variance: Floats  # (n,) diagonal of M

    def copy(self) -> Posterior:
        """Copy that can be changed alone."""
        return replace(self, trusted=self.trusted.copy(), Q=self.Q.copy(), variance=self.variance.copy())


@dataclass(frozen=True, slots=True, eq=False)
class LeaveOneOut:
    """Leave-one-out residuals of all meters. n buses, p meters."""

    weights: Floats  # (p,) Q m
    residual: Floats  # (p,) reading minus its prediction by the trusted others, squared pu
    std: Floats  # (p,) its standard deviation for an honest meter
    m: Floats  # (p,) readings minus the model, squared pu
    mean: Floats  # (n,) posterior mean of every bus

    @property
    def chi_square(self) -> float:
        """m^T Q m: chi-square with one degree of freedom per trusted meter."""
        return float(self.m @ self.weights)


def condition(prior: Prior, noise: Floats, trusted: Bools) -> Posterior:
    """Posterior of a set of trusted meters (p,) by one factorisation; O(p^3 + n p^2).

    noise: (p,) variance of each reading, > 0.
    """
    at = indices(trusted)
    inverse = prior.among(at)
    inverse[np.diag_indices(at.size)] += noise[at]
    invert_spd(inverse)
    Q = np.zeros((noise.size, noise.size))
    Q[np.ix_(at, at)] = inverse
    known = prior.covariance[:, at]
    variance = prior.variance - np.einsum("ij,ij->i", known @ inverse, known)
    return Posterior(prior, noise, trusted.copy(), Q, np.maximum(variance, 0.0))


def leave_one_out(now: Posterior, m: Floats) -> LeaveOneOut:
    """Leave-one-out residuals of all meters; O(n p). m: (p,) finite everywhere."""
    weights, trusted, at = now.Q @ m, now.trusted, now.prior.meters
    pivot = np.where(trusted, now.Q.diagonal(), 1.0)
    mean = now.prior.covariance @ weights
    std = np.sqrt(np.where(trusted, 1.0 / pivot, now.variance[at] + now.noise))
    return LeaveOneOut(weights, np.where(trusted, weights / pivot, m - mean[at]), std, m, mean)


def remove_meter(now: Posterior, j: int) -> None:
    """Remove trusted meter j from a posterior in place; O(n p)."""
    q = now.Q[:, j].copy()
    spread = now.prior.covariance @ q
    now.variance += spread * spread / q[j]
    now.Q -= np.multiply.outer(q, q / q[j])
    now.Q[j] = now.Q[:, j] = 0.0
    now.trusted[j] = False


# --- Linear algebra ---


def solve_spd(matrix: Floats, right: Floats) -> Floats:
    """Solution of a symmetric positive definite system; `matrix` is in the order of LAPACK, and lost."""
    if not right.size:
        return right.copy()
    _, out, failed = lapack.dposv(matrix, right, lower=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray(out)


def invert_spd(matrix: Floats) -> None:
    """Invert a symmetric positive definite matrix in LAPACK's (Fortran's) order in place, by Cholesky."""
    if not matrix.size:
        return
    _, failed = lapack.dpotrf(matrix, lower=True, clean=False, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    lapack.dpotri(matrix, lower=True, overwrite_c=True)
    upper = np.triu_indices(len(matrix), 1)
    matrix[upper] = matrix.T[upper]
