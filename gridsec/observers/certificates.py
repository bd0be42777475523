"""Closed-form proofs that the direct-injection observer converges, for all meter sets at once.

The plant is `T x' = -x + K(z)`, `z = w - S x`, `S = -H`. The observer runs the same equations; the
inverter of a trusted meter is driven by that meter's reading in place of the model. With Pi the
projection on the other inverters, and Delta(t) the unknown slopes, `0 <= Delta_i <= d_i`,

    T e' = -(I + Delta Pi S) e + Delta u,     u_i = load error of z_i, or minus noise and attack of meter i.

The set of trusted meters may change at any moment; every statement here holds for all of it. Proofs:
docs/theory-certificates.md.

Source: chong2020, Proposition 1 and equation (12), as corrected there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Bools, Floats, frozen
from gridsec.errors import DesignInfeasible
from gridsec.grid.devices import Droop
from gridsec.observers.lure import Lure, Matrices

# Shares of 1 / slope on the diagonal of P that `reactance` tries, see Theorem 1.
SHARES = (0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
# Fraction of the best rate that is given up for slack in the claims. The weights of the small-gain norm
# need more: at the best rate itself, weakly coupled inverters have weight zero.
BACKOFF = 0.01
WEIGHT_BACKOFF = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """Decay of the direct-injection observer's error and its steady level under disturbances."""

    kind: str  # `reactance` and `lmi`: the norm is `sqrt(e^T P e)`. `small-gain`: it is `max_i |e_i| / P_i`
    P: Floats  # (n, n) or (n,) matrix or weights of the norm
    rate: float  # without disturbances the error decays in that norm at least like `exp(-rate t)`, 1/s
    noise: float  # steady error in that norm per pu of the largest entry of the meter noise
    load: float  # the same for the error of the known input w
    attack: float  # the same for the attack
    # slack of the condition at the claimed rate, as recomputed by `verify`, relative to the rate of the
    # slowest inverter; a positive margin proves the claim
    margin: float
    status: str  # origin of the certificate, one sentence
    # steady error in that norm under any attack, by saturation of the droop curves; infinite without
    # saturation
    saturation: float = np.inf
    # (m,) or (0,) the multipliers Lambda of the quadratic kinds
    multiplier: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "P", frozen(self.P))
        object.__setattr__(self, "multiplier", frozen(self.multiplier))


def reactance(lure: Lure) -> Certificate:
    """Certificate from the symmetry of the reactance matrix.

    `V = e^T P e`, `P = (S + S^T) / 2 + kappa D^-1`, `Lambda = T^-1`. With
    `b = P T^-1 - S^T Lambda`, V falls at the rate 2 alpha for every trusted set, every switching and
    every slope if

        P T^-1 + T^-1 P - b D Lambda^-1 b^T  >=  2 alpha P  >  0.

    For symmetric S and one common tau this always holds, with `alpha = (1 - kappa / 2) / tau`; kappa
    makes P positive definite where S is singular (customers on one bus or on the busbar). Other
    systems are tried with the shares `SHARES`; asymmetry costs margin.

    Raises DesignInfeasible if the condition fails for every share, or the system is not of this form.
    """
    form = _droop_form(lure, "reactance certificate")
    if form.tau.size == 0:
        return _nothing("reactance")
    S, slope, multiplier = form.S, form.slope, 1.0 / form.tau
    # A larger bound on a slope is still a bound; it keeps D^-1 finite for inverters of slope zero.
    top = float(np.max(slope, initial=0.0)) or 1.0
    floor = np.maximum(slope, 1e-3 * top)
    best, chosen = -np.inf, np.zeros_like(S)
    for share in SHARES:
        P = 0.5 * (S + S.T) + np.diag(share / floor)
        rate = _quadratic_rate(P, multiplier, form)
        if rate > best:
            best, chosen = rate, P
    if not best > 0:
        raise DesignInfeasible(
            "reactance certificate S T^-1 + T^-1 S > 0",
            "the error can grow in this norm: time constants too far apart, or S too far from symmetric",
            best * float(np.max(form.tau)),
            code="unstable",
        )
    status = "closed form; S + kappa / D with the best of the shares"
    return quadratic(lure, chosen, multiplier, (1.0 - BACKOFF) * best, kind="reactance", status=status)


def small_gain(lure: Lure) -> Certificate:
    """Certificate from a loop gain below 1.

    In the norm `max_i |e_i| / c_i` the error decays at the rate alpha for every trusted set, every
    switching and every slope if, entry by entry,

        T^-1 (I - D |S|) c  >=  alpha c,     c > 0.

    Such c exists exactly if the spectral radius of `D |S|` is below 1; `max_i d_i sum_j |S_ij| < 1`
    is the case `c = 1`. S need not be symmetric, nor the time constants equal.

    Raises DesignInfeasible if the loop gain is 1 or more, or the system is not of this form.
    """
    form = _droop_form(lure, "small-gain certificate")
    tau, slope = form.tau, form.slope
    if tau.size == 0:
        return _nothing("small-gain")
    comparison = (np.eye(tau.size) - slope[:, None] * np.abs(form.S)) / tau[:, None]
    best = float(np.min(np.linalg.eigvals(comparison).real))
    if not best > 0:
        worst = best * float(np.max(tau))
        raise DesignInfeasible(
            "small-gain certificate rho(D |S|) < 1", "the loop gain is too large", worst, code="unstable"
        )
    rate = (1.0 - WEIGHT_BACKOFF) * best
    weights = np.asarray(np.linalg.solve(comparison - rate * np.eye(tau.size), 1.0 / tau), dtype=np.float64)
    weights /= np.max(weights)
    gain = float(np.max(slope / (tau * weights))) / rate
    margin = _small_gain_margin(weights, rate, form)
    saturation = float(np.max(_span(lure) / (tau * weights))) / rate
    status = "closed form; weights from one linear solve"
    return _checked(Certificate("small-gain", weights, rate, gain, gain, gain, margin, status, saturation))


def quadratic(
    lure: Lure, P: Floats, multiplier: Floats, rate: float, *, kind: str, status: str
) -> Certificate:
    """Certificate for a given norm matrix, multiplier and rate, verified and with its gains.

    Turns a solution of the linear matrix inequality for *no* trusted meter into a certificate for all sets at
    once (docs/theory-certificates.md, Theorem 1).

    P (n, n): matrix of the norm, symmetric positive definite.
    multiplier (m,): Lambda, positive.
    rate: claimed decay rate, 1/s, positive.
    kind, status: as in `Certificate`.
    Raises DesignInfeasible if the verification fails.
    """
    form = _droop_form(lure, f"{kind} certificate")
    none, one = np.zeros(form.tau.size), np.ones(form.tau.size)
    made = Certificate(kind, P, rate, 0.0, 0.0, 0.0, _quadratic_margin(P, multiplier, rate, form), status)
    made = _checked(replace(made, multiplier=multiplier))
    noise = float(_level(made, form, form.slope / form.tau, none))
    load = min(noise, float(_level(made, form, none, one)))
    saturation = float(_level(made, form, _span(lure) / form.tau, none))
    return replace(made, noise=noise, load=load, attack=noise, saturation=saturation)


def certify(lure: Lure) -> Certificate:
    """Closed-form certificate with the highest rate; DesignInfeasible with the reasons if there is none."""
    found: list[Certificate] = []
    failed: list[DesignInfeasible] = []
    for attempt in (reactance, small_gain):
        try:
            found.append(attempt(lure))
        except DesignInfeasible as error:
            failed.append(error)
    if not found:
        best = max((error.margin for error in failed if error.margin is not None), default=None)
        raise DesignInfeasible(
            "closed-form certificate", "; ".join(map(str, failed)), best, code="no-certificate"
        )
    return max(found, key=lambda certificate: certificate.rate)


def verify(certificate: Certificate, lure: Lure, trusted: Bools | None = None) -> float:
    """Recompute the margin of a certificate from its numbers alone, in NumPy.

    lure: the closed loop of the claim.
    trusted (p,): verify for this set only; by default for all sets at once. That claim is stronger: a trusted
        meter only removes terms from the condition.
    Returns the slack of the condition at the claimed rate, relative to the rate of the slowest inverter, less
        the rounding of the computation; positive: proven. Minus infinity without a positive finite rate.
    Raises DesignInfeasible if the kind is unknown, or the system does not have the form of the certificates.
    """
    form = _droop_form(lure, f"{certificate.kind} certificate")
    if trusted is not None:
        form = replace(form, slope=np.where(np.any(feeds(lure) & trusted, axis=1), 0.0, form.slope))
    P, multiplier, count = certificate.P, certificate.multiplier, form.tau.size
    if count == P.size == 0:
        return 1.0
    if certificate.kind == "small-gain" and P.shape == (count,):
        return _small_gain_margin(P, certificate.rate, form)
    shaped = P.shape == (count, count) and multiplier.shape == (count,)
    if certificate.kind in {"reactance", "lmi"} and shaped:
        return _quadratic_margin(P, multiplier, certificate.rate, form)
    raise DesignInfeasible(
        f"{certificate.kind} certificate", "its numbers do not fit the system", code="wrong-form"
    )


def feeds(lure: Matrices) -> Bools:
    """Meters that can drive inverters of the observer, (m, p): the rows of `(H, F)` and `(C, D)` agree."""
    inverters, meters = np.hstack([lure.H, lure.F]), np.hstack([lure.C, lure.D])
    same: Bools = np.all(inverters[:, None, :] == meters[None, :, :], axis=2)
    return same


def error_bound(
    lure: Lure,
    trusted: Bools,
    y_error: Floats,
    u_error: Floats,
    *,
    z: Floats | None = None,
    certificate: Certificate | None = None,
) -> Floats:
    """Bound of the distance of the observer's state from the plant's, inverter by inverter.

    Every entry of `e` is a first-order lag of its input, so that the monotone map

        bound_i <- min(span_i, k_i(u_i + free_i sum_j |S_ij| bound_j)),     k_i(r) = d_i r

    maps bounds to bounds. It starts from the saturation of the curves, at most `2 limit`; every iterate is
    valid after the transient. Without `certificate` the bound also holds for all times if it holds at the
    beginning. Under attack, `y_error` contains the size of the attack, infinity included.

    trusted (…, p): meters that drive their inverters.
    y_error (…, p): largest error of each reading (noise and attack), squared pu.
    u_error (…, l): largest error of each entry of the known input w, squared pu.
    z (…, m): the observer's own outputs. If given, `k_i(r)` is the variation of the curve within r of `z_i`,
        zero inside the deadband. The bound then holds for observer and plant at rest, or moving slowly
        against the time constants, provided that a certificate holds.
    certificate: a certificate of the system. The norm of a quadratic one with its multiplier gives a start of
        the iteration that may be tighter than saturation; other kinds are not used. That start is the box
        around an ellipsoid: an error in a corner of the box can leave it temporarily.
    Returns (…, n): bound of `|x - xhat|`, pu.
    """
    form = _droop_form(lure, "error bound")
    driven = feeds(lure) & trusted[..., None, :]
    free = ~np.any(driven, axis=-1)
    metered = np.max(np.where(driven, y_error[..., None, :], 0.0), axis=-1, initial=0.0)
    direct = np.where(free, u_error @ np.abs(lure.F).T, metered)
    span = np.broadcast_to(_span(lure), direct.shape)
    bound = span
    if certificate is not None and certificate.multiplier.size:
        kick = np.where(free, 0.0, _reach(lure, direct, None, span)) / form.tau
        level = _level(certificate, form, kick, np.where(free, direct, 0.0))
        spread = np.sqrt(np.diagonal(np.linalg.inv(certificate.P)))
        bound = np.minimum(bound, level[..., None] * spread)
    coupling = np.abs(form.S).T

    def drive(bound: Floats) -> Floats:
        known = np.isfinite(bound)
        through = np.where(known, bound, 0.0) @ coupling
        # Unbounded entries matter only where they couple: infinity times zero is zero here.
        through[~known @ (coupling > 0)] = np.inf
        return _reach(lure, np.where(free, direct + through, direct), z, span)

    for _ in range(_ROUNDS):
        tighter = np.minimum(bound, drive(bound))
        settled = np.all(tighter >= (1.0 - _TIGHTENING) * bound)
        bound = tighter
        if settled:
            break
    return np.array(bound if z is None else np.minimum(bound, _from_below(drive, span)))


def _from_below(drive: Callable[[Floats], Floats], span: Floats) -> Floats:
    """Smallest bound that the monotone map cannot leave; infinite where none is found.

    At rest, and with any certificate in force, the error depends continuously on the size of the
    disturbances and starts from zero with them: it cannot pass a bound that the map takes below itself.
    """
    bound = np.zeros_like(span)
    for _ in range(_ROUNDS):
        larger = drive(bound)
        settled = np.all(larger <= (1.0 + _TIGHTENING) * bound)
        bound = larger
        if settled:
            break
    # Room for the map to be strictly inside; the claim is checked in every case.
    bound = (1.0 + 10.0 * _TIGHTENING) * bound + np.finfo(np.float64).tiny
    inside = np.all(drive(bound) < bound, axis=-1, keepdims=True)
    return np.where(inside, bound, np.inf)


# Rounds of the monotone iteration, and the relative gain below which it stops. Both trade tightness for time
# only: every iterate is a bound.
_ROUNDS = 200
_TIGHTENING = 1e-4


def _reach(lure: Lure, radius: Floats, z: Floats | None, span: Floats) -> Floats:
    """Largest change of the set-points for arguments within `radius` (around `z`, if given)."""
    if z is None:
        # A curve of slope zero has a constant value, even under an unbounded attack.
        return np.minimum(
            span, np.multiply(lure.slope, radius, out=np.zeros_like(radius), where=lure.slope > 0)
        )
    here = lure.phi(z)
    return np.minimum(span, np.maximum(lure.phi(z + radius) - here, here - lure.phi(z - radius)))


@dataclass(frozen=True, slots=True, eq=False)
class _Form:
    """Coefficients of `T x' = -x + phi(w - S x)`."""

    tau: Floats
    S: Floats
    slope: Floats


def _droop_form(lure: Lure, what: str) -> _Form:
    """Time constants, S and slopes of a system `T x' = -x + phi(w - S x)`."""
    own = np.diagonal(lure.A)
    # Arrays of different shapes are not equal.
    fits = np.array_equal(lure.G, -lure.A) and np.array_equal(lure.A, np.diag(own)) and np.all(own < 0)
    if not fits or np.any(lure.B):
        raise DesignInfeasible(what, "the system is not T x' = -x + phi(H x + F u)", code="wrong-form")
    return _Form(-1.0 / own, -lure.H, lure.slope)


def _nothing(kind: str) -> Certificate:
    """Certificate of a system without inverters: no state and no error."""
    empty = np.zeros((0, 0) if kind == "reactance" else 0)
    return Certificate(kind, empty, np.inf, 0.0, 0.0, 0.0, 1.0, "no droop inverter, nothing to estimate", 0.0)


def _span(lure: Lure) -> Floats:
    """Distance between the two saturated values of each curve (m,); infinite where unknown."""
    if isinstance(lure.phi, Droop):
        return lure.phi.span
    return np.full(lure.slope.size, np.inf)


def _quadratic_form(P: Floats, multiplier: Floats, form: _Form) -> Floats:
    """`P T^-1 + T^-1 P - b D Lambda^-1 b^T` with `b = P T^-1 - S^T Lambda`; half is left for load errors."""
    scaled = P / form.tau
    b = scaled - form.S.T * multiplier
    return np.asarray(scaled + scaled.T - (b * (form.slope / multiplier)) @ b.T)


def _quadratic_rate(P: Floats, multiplier: Floats, form: _Form) -> float:
    """Largest alpha with `form >= 2 alpha P`, less rounding; minus infinity unless P > 0."""
    try:
        factor = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return -np.inf
    half = np.linalg.solve(factor, _quadratic_form(P, multiplier, form))
    whole = np.linalg.solve(factor, half.T)
    eigenvalues = np.linalg.eigvalsh(0.5 * (whole + whole.T))
    # First-order bound of the rounding in factor, solves and eigenvalues.
    rounding = 10.0 * P.shape[0] * np.finfo(np.float64).eps * np.linalg.cond(factor) ** 2
    return float(eigenvalues[0] - rounding * np.max(np.abs(eigenvalues))) / 2.0


def _quadratic_margin(P: Floats, multiplier: Floats, rate: float, form: _Form) -> float:
    """Slack of `_quadratic_rate` over the claimed rate, relative to the slowest inverter."""
    sound = 0.0 < rate < np.inf and np.all(multiplier > 0) and np.array_equal(P, P.T)
    if not sound:
        return -np.inf
    return (_quadratic_rate(P, multiplier, form) - rate) * float(np.max(form.tau))


def _small_gain_margin(weights: Floats, rate: float, form: _Form) -> float:
    """Slack of `T^-1 (I - D |S|) c >= rate c`, relative to the slowest inverter."""
    if not (0.0 < rate < np.inf and np.all(weights > 0)):
        return -np.inf
    loop = form.slope * (np.abs(form.S) @ weights) / weights
    rounding = 2.0 * weights.size * np.finfo(np.float64).eps * (1.0 + loop)
    return float(np.min((1.0 - loop - rounding) / form.tau) - rate) * float(np.max(form.tau))


def _level(certificate: Certificate, form: _Form, kick: Floats, load: Floats) -> Floats:
    """Steady level of `W = sqrt(e^T P e)` under disturbances.

    From `(W^2)' <= -2 alpha W^2 + 2 N W + L^2`: `W <= (N + sqrt(N^2 + 2 alpha L^2)) / (2 alpha)`.

    certificate: a quadratic certificate: P, Lambda and alpha.
    kick (…, n): largest entries of the direct terms of `e'`, pu/s: `N^2 = kick^T |P| kick`.
    load (…, m): largest load errors at the inverters without a trusted meter: `L^2 = sum d_i lambda_i
        load_i^2`.
    """
    rate = certificate.rate
    known = np.isfinite(kick)
    finite = np.where(known, kick, 0.0)
    direct = np.sum((finite @ np.abs(certificate.P)) * finite, axis=-1)
    direct = np.where(np.all(known, axis=-1), direct, np.inf)
    through = np.sum(form.slope * certificate.multiplier * load**2, axis=-1)
    return np.asarray((np.sqrt(direct) + np.sqrt(direct + 2.0 * rate * through)) / (2.0 * rate))


def _checked(certificate: Certificate) -> Certificate:
    """Return the certificate; refuse it unless its margin is positive."""
    if not certificate.margin > 0:
        raise DesignInfeasible(
            f"{certificate.kind} certificate",
            "the verification fails",
            certificate.margin,
            code="not-verified",
        )
    return certificate
