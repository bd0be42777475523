"""Partial high-gain observers, detection with a time-varying threshold, and the switching search.

Each sensor has an observer of its own, so that an attack affects only one; sensor i occupies the first n_i of
n_max places of its row, the rest is zero. A set of p - q sensors is trusted while its left inverse explains
all its estimates; the search continues only if it does not.

Source: kim2018, section III; lee2018, sections 5.2 and 5.4; docs/theory-high-gain.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.linalg import expm

from gridsec.arrays import Bools, Floats, frozen, not_negative
from gridsec.errors import DesignInfeasible, NotObservable, Problem, no_choice, raise_if_any
from gridsec.interface import Cause, Decision
from gridsec.observers.high_gain.constants import (
    Decay,
    decay_componentwise,
    decay_kim,
    decay_lee,
    gain,
    margin,
)
from gridsec.observers.high_gain.form import Partial, Polynomial, System, sat, slopes
from gridsec.observers.high_gain.redundancy import (
    Inverse,
    check,
    corners_and_interior,
    groups,
    kappa_detect,
    nearest,
    upper_proven,
)

Search = Literal["all", "one"]


@dataclass(frozen=True, slots=True, eq=False)
class HighGainEstimate:
    """Result at one instant."""

    t: float  # time, s
    x: Floats  # (n,) estimate of the state; NaN if no set is complete
    # bound on its largest error while at most q sensors are attacked; NaN if the design has no `lowest`,
    # infinite if no set passed
    bound: float
    sigma: int  # index of the set in use, from 0
    visited: tuple[int, ...]  # the tested sets, in order; the last is `sigma`
    trusted: Bools  # (p,) the sensors of that set
    residual: float  # of that set; NaN if not tested
    threshold: float  # of that set; NaN if not tested
    decision: Decision  # as in `gridsec.interface`; UNDECIDED is an answer of its own
    cause: Cause
    reason: str
    # (p,) sensors named as manipulated. With a known `bound`: those that cannot be unmanipulated; otherwise,
    # after an alarm, those outside the trusted set
    suspects: Bools
    reset: Bools  # (p,) observers that were reset in this step


def verdict(
    *,
    heard: int,
    needed: int,
    passed: bool | None,
    alarm: bool,
    settled: bool,
    untested: int,
    search: Search,
) -> tuple[Decision, Cause, str]:
    """Decision, cause, and one sentence.

    heard: number of sensors with a reading. needed: number of sensors of a set.
    passed: True if the last set passed its test; None if it was not complete, and not tested.
    alarm: True if a test failed or a sensor is named.
    settled: True if the bounds of all observers with readings have settled.
    untested: number of sensors with a reading but without a test.
    search: with "one", other sets may still pass later.
    """
    if passed is None:
        reason = f"{heard} sensors are heard and no set of {needed} is complete"
        return Decision.UNDECIDED, Cause.TOO_FEW_METERS, reason
    if not passed:
        reason = "no set that was tried explains its own estimates"
        cause = Cause.SETTLING if search == "one" else Cause.TOO_MANY_SUSPECTS
        return Decision.UNDECIDED, cause, reason
    if alarm:
        return Decision.ATTACKED, Cause.RESIDUALS, "estimates disagree by more than honest sensors can"
    if not settled:
        return Decision.UNDECIDED, Cause.SETTLING, "the observers have not settled yet"
    if untested:
        reason = f"the sensors in use agree within their bounds; {untested} more were not tested"
        return Decision.UNDECIDED, Cause.AMBIGUOUS, reason
    return Decision.CLEAN, Cause.AGREEMENT, "all sensors agree within their bounds"


Field = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, slots=True, eq=False)
class HighGainTransition:
    """One step of the linear parts, exact for forcing that is linear in time."""

    h: float  # length of the step, s
    whole: Floats  # (p, n_max, n_max) `e^{M h}` with `M = A - K C`
    held: Floats  # (p, n_max, n_max) `z(h) = whole z(0) + held g(0) + slope (g(h) - g(0))`
    slope: Floats  # (p, n_max, n_max)


def gains(system: System, theta: Floats) -> Floats:
    """K of every sensor for `theta` (p,), 1/s, padded with zeros; (p, n_max)."""
    out = np.zeros(system.mask.shape)
    for i, partial in enumerate(system.partials):
        out[i, : partial.size] = gain(partial.size, float(theta[i]))
    return out


def transition(system: System, K: Floats, h: float) -> HighGainTransition:
    """Matrices of one step of length h, s, for the gains K (p, n_max)."""
    p, n = K.shape
    M = np.zeros((p, n, n))
    M[:, np.arange(n - 1), np.arange(1, n)] = system.mask[:, 1:]
    M[:, :, 0] -= K
    block = np.zeros((p, 3 * n, 3 * n))
    block[:, :n, :n] = M * h
    block[:, :n, n : 2 * n] = np.eye(n) * h
    block[:, n : 2 * n, 2 * n :] = np.eye(n)
    out = np.asarray(expm(block), dtype=np.float64)
    return HighGainTransition(h, out[:, :n, :n], out[:, :n, n : 2 * n], out[:, :n, 2 * n :])


def field(system: System) -> Field:
    """`e alpha(sat(z)) + beta(sat(z)) u` of all sensors as one function of z (p, n_max) and u (m,).

    If every alpha and beta is a `Polynomial`, all sensors share one table of monomials and one
    product; otherwise they are evaluated one after the other.
    """
    functions = [
        *(partial.alpha for partial in system.partials),
        *(entry for partial in system.partials for row in partial.beta for entry in row),
    ]
    if all(isinstance(function, Polynomial) for function in functions):
        return _stacked(system)
    return _looped(system)


def _stacked(system: System) -> Field:
    (p, n), m = system.mask.shape, system.partials[0].inputs
    places: dict[tuple[int, ...], int] = {}
    entries: list[tuple[int, int, int, int, float]] = []

    def collect(i: int, row: int, column: int, function: object) -> None:
        if not isinstance(function, Polynomial):
            raise TypeError("only polynomials can be stacked")
        for powers, factor in zip(function.exponents.tolist(), function.coefficients.tolist(), strict=True):
            key = (*powers, *[0] * (n - len(powers)))
            entries.append((i, places.setdefault(key, len(places)), row, column, factor))

    for i, partial in enumerate(system.partials):
        collect(i, partial.size - 1, 0, partial.alpha)
        for row, functions in enumerate(partial.beta):
            for column, function in enumerate(functions):
                collect(i, row, column + 1, function)
    table = np.zeros((p, len(places), n, m + 1))
    for i, place, row, column, factor in entries:
        table[i, place, row, column] += factor
    powers = np.array(list(places), dtype=np.intp)
    level = system.z_bound[:, None]

    def evaluate(z: Floats, u: Floats) -> Floats:
        monomials = np.prod(sat(z, level)[:, None, :] ** powers, axis=-1)
        rows = np.einsum("pk,pknc->pnc", monomials, table)
        return np.asarray(rows @ np.concatenate([[1.0], u]))

    return evaluate


def _looped(system: System) -> Field:
    def one(partial: Partial, z: Floats, u: Floats) -> list[float]:
        parts = list(sat(z[: partial.size], partial.bound))
        rows = [sum(float(f(parts)) * v for f, v in zip(row, u, strict=True)) for row in partial.beta]
        rows[-1] += float(partial.alpha(parts))
        return rows

    def evaluate(z: Floats, u: Floats) -> Floats:
        out = np.zeros(z.shape)
        for i, partial in enumerate(system.partials):
            out[i, : partial.size] = one(partial, z[i], u)
        return out

    return evaluate


def advance(
    right: Field,
    K: Floats,
    move: HighGainTransition,
    z: Floats,
    *,
    y: tuple[Floats, Floats],
    u: tuple[Floats, Floats],
) -> Floats:
    """One step of the observers (5): exponential, of second order in the nonlinear part.

    Readings and inputs are interpolated linearly between the two instants. The stiff linear part is exact for
    every `theta h`.

    K (p, n_max). z (p, n_max): estimates at the start.
    y (pair of (p,)): readings at the start and the end.
    u (pair of (m,)): inputs at the start and the end.
    Returns (p, n_max): estimates at the end; not finite on overflow by extreme readings.
    Source: kim2018 (5); lee2018 (5.2.6).
    """
    before = right(z, u[0])
    forced = before + K * y[0][:, None]
    rise = K * (y[1] - y[0])[:, None]
    # Products row by row: the overflow of one sensor must not affect the others.
    trial = _apply(move.whole, z) + _apply(move.held, forced) + _apply(move.slope, rise)
    return trial + _apply(move.slope, right(trial, u[1]) - before)


def _apply(matrices: Floats, rows: Floats) -> Floats:
    return np.asarray(np.einsum("pij,pj->pi", matrices, rows))


_DECAYS = {"componentwise": decay_componentwise, "kim2018": decay_kim, "lee2018": decay_lee}


@dataclass(frozen=True, slots=True, eq=False)
class HighGainDesign:
    """Design of the observers. p sensors, s sets of p - q sensors."""

    system: System  # the system and its decomposition
    inverses: tuple[Inverse, ...]  # Psi of the sets Lambda(1), …, Lambda(s), in the order of the search
    # Psi of all sensors, for the test of Corollary 1; without it there is no such test, and no CLEAN unless
    # `lowest` is known
    whole: Inverse | None
    theta: Floats  # (p,) high-gain parameters, 1/s
    decays: tuple[Decay, ...]  # constants of every sensor's observer
    # (p,) margin of every sensor's Lyapunov inequality; Lemma 1 holds at this theta if positive
    margins: Floats
    proven: bool  # True if the margins use proven ranges of derivatives only
    limit: Floats  # (p,) size of an estimate at which it is reset (7)
    # lower bound on Lip_(Phi_J) over all sets of p - 2q sensors; NaN if unknown, and so is the error bound
    lowest: float
    steep: Floats  # (p,) upper bounds on Lip^(Phi_i)
    # "all": sets are tried at once until one passes. "one": one change of set per step, for limited computing
    # time (the papers' simulations)
    search: Search
    K: Floats  # (p, n_max) gains
    field: Field  # right-hand side of the observers
    move: HighGainTransition  # matrices of the nominal substep
    substeps: int  # number of substeps of a step


@dataclass(frozen=True, slots=True, eq=False)
class HighGainState:
    """State of the observers."""

    t: float  # time, s
    z: Floats  # (p, n_max) estimates; zero where a sensor has no such entry or is unavailable
    y: Floats  # (p,) readings at t; NaN where unavailable
    u: Floats  # (m,) input at t
    age: Floats  # (p,) time of each observer with readings without a gap, s
    sigma: int  # place of the set in use, from 0


def design(
    system: System,
    inverses: Sequence[Inverse] | None = None,
    *,
    theta: Floats | float,
    noise: Floats | float,
    max_attacked: int,
    u_low: Floats | float,
    u_high: Floats | float,
    step_s: float,
    whole: Inverse | None = None,
    decay: Literal["componentwise", "kim2018", "lee2018"] | Sequence[Decay] = "componentwise",
    lowest: float = np.nan,
    search: Search = "all",
    reset: bool = True,
    substeps: int = 1,
    tolerance: float = 1e-6,
) -> HighGainDesign:
    """Design observers, thresholds and search, and verify their conditions.

    inverses: a left inverse for each set of p - q sensors, in the order of the search. By default the nearest
        points, for these sets and for `whole`.
    theta: high-gain parameters, 1/s, at least 1; scalar or (p,).
    noise: M_v: largest measurement error of unmanipulated sensors, interpolation included; scalar or (p,).
    u_low, u_high: range of the inputs; scalar or (m,).
    step_s: nominal time between readings, s.
    whole: left inverse of all sensors for the test of Corollary 1.
    decay: derivation of eta, epsilon and rate; or these constants, one for each sensor.
    lowest: lower bound on Lip_(Phi_J) for every set J of p - 2q sensors, at least 0; NaN if unknown. At 0 or
        NaN the estimate has no error bound.
    search: see `HighGainDesign`.
    reset: apply the reset rule (7); lee2018 has none. Estimates that are not finite are reset anyway.
    substeps: number of substeps of a step, for accuracy.
    tolerance: largest error of a left inverse at its check points.
    Raises NotObservable if p <= 2q, or the sets are not all sets of p - q sensors. DesignInfeasible if theta
        is too small for Lemma 1, or a left inverse fails its check. ValueError if `noise` or `lowest` is
        negative, or `decay` or `search` is unknown.
    """
    p, m = len(system.partials), system.partials[0].inputs
    if not p > 2 * max_attacked >= 0:
        raise NotObservable(
            range(p),
            p,
            f"{p} sensors, {max_attacked} attacked: more than twice are needed",
            code="too-few-meters",
        )
    problems = no_choice("search", get_args(Search), search)
    problems += no_choice("decay", _DECAYS, decay) if isinstance(decay, str) else []
    if lowest < 0.0:
        problems.append(Problem("negative", f"lowest is {lowest}; a lower bound of gains is not negative"))
    raise_if_any(problems)
    thetas = np.broadcast_to(np.asarray(theta, dtype=np.float64), (p,))
    noises = np.broadcast_to(not_negative("noise", noise), (p,))
    if isinstance(decay, str):
        parts = zip(system.partials, thetas, noises, strict=True)
        decays = tuple(_DECAYS[decay](part.size, float(th), float(v)) for part, th, v in parts)
    else:
        decays = tuple(decay)
    inverses, whole = _inverses(system, inverses, whole, decays, max_attacked)
    low, high = (np.broadcast_to(np.asarray(end, dtype=np.float64), (m,)) for end in (u_low, u_high))
    margins, proven = _margins(system, thetas, low, high)
    points = corners_and_interior(system, samples=100)
    for inverse in (*inverses, *(() if whole is None else (whole,))):
        check(system, inverse, points, tolerance=tolerance)
    eta, rest = (np.array([getattr(d, name) for d in decays]) for name in ("eta", "epsilon"))
    limit = np.maximum(2.0 * eta * system.z_bound, rest) + system.z_bound if reset else np.full(p, np.inf)
    ends = (-system.x_bound, system.x_bound)
    steep = np.array([upper_proven(part.jacobian, *ends, gap=1e-2).upper for part in system.partials])
    K = gains(system, thetas)
    return HighGainDesign(
        system=system,
        inverses=inverses,
        whole=whole,
        theta=frozen(thetas),
        decays=decays,
        margins=frozen(margins),
        proven=proven,
        limit=frozen(limit),
        lowest=lowest,
        steep=frozen(steep),
        search=search,
        K=frozen(K),
        field=field(system),
        move=transition(system, K, step_s / substeps),
        substeps=substeps,
    )


def _inverses(
    system: System,
    given: Sequence[Inverse] | None,
    whole: Inverse | None,
    decays: tuple[Decay, ...],
    max_attacked: int,
) -> tuple[tuple[Inverse, ...], Inverse | None]:
    """Left inverses of all sets of p - q sensors and of all sensors: the given ones, or nearest points."""
    p = len(system.partials)
    wanted = groups(p, max_attacked)
    if given is None:
        # Below every threshold in use, so that it affects time only.
        accept = min(one.epsilon for one in decays)
        whole = nearest(system, range(p), accept=accept) if whole is None else whole
        return tuple(nearest(system, group, accept=accept) for group in wanted), whole
    if len(given) != len(set(wanted)) or {inverse.sensors for inverse in given} != set(wanted):
        raise NotObservable(
            range(p),
            p,
            f"a left inverse for each set of {p - max_attacked} sensors is needed",
            code="missing",
        )
    return tuple(given), whole


def _margins(system: System, theta: Floats, low: Floats, high: Floats) -> tuple[Floats, bool]:
    if np.any(theta < 1.0):
        raise DesignInfeasible(
            "partial high-gain observers",
            "theta must be at least 1",
            float(theta.min()) - 1.0,
            code="out-of-range",
        )
    ranges = [slopes(partial, low, high) for partial in system.partials]
    margins = np.array([margin(part, float(th)) for part, th in zip(ranges, theta, strict=True)])
    if not np.all(margins > 0.0):
        bad = int(np.argmin(margins))
        what = f"partial observer of sensor {bad}"
        raise DesignInfeasible(
            what, f"theta = {theta[bad]:g} is too small for Lemma 1", float(margins[bad]), code="unstable"
        )
    return margins, all(part.proven for part in ranges)


def init(
    design: HighGainDesign,
    t: float,
    y: Floats | None = None,
    u: Floats | None = None,
    z: Floats | None = None,
) -> HighGainState:
    """Initial state of all observers.

    t: time, s.
    y (p,): readings at t, NaN where missing; without them every observer starts with its first reading.
    u (m,): input at t; zero by default.
    z (p, n_max): initial estimates of the sensors with a reading, at most M_z in size; zero by default.
    """
    system = design.system
    p, m = len(system.partials), system.partials[0].inputs
    start = np.zeros(system.mask.shape) if z is None else np.where(system.mask, z, 0.0)
    return HighGainState(
        t=float(t),
        z=frozen(start),
        y=frozen(np.full(p, np.nan) if y is None else np.where(np.isfinite(y), y, np.nan)),
        u=frozen(np.zeros(m) if u is None else np.atleast_1d(u)),
        age=frozen(np.zeros(p)),
        sigma=0,
    )


def step(  # noqa: PLR0917  # the border that all observer families share
    design: HighGainDesign, state: HighGainState, y: Floats, u: Floats, seen: Bools, h: float
) -> tuple[HighGainState, HighGainEstimate]:
    """Advance all observers to the next readings, and decide.

    y (p,): readings at `t + h`; ignored where unseen or not finite.
    u (m,): input at `t + h`; finite.
    seen (p,): True for existing readings. An unseen sensor drops out, and returns with a new observer.
    h: length of the step, s.
    Returns state and estimate at `t + h`; never raises on data.
    Source: kim2018 (5), (7), Theorem 2.
    """
    live = np.asarray(seen, dtype=np.bool_) & np.isfinite(y)
    going = live & np.isfinite(state.y)
    now = np.atleast_1d(np.asarray(u, dtype=np.float64))
    # Attacks may have any size: overflowing estimates are reset below.
    with np.errstate(all="ignore"):
        z = _advance(design, state, np.where(going, y, 0.0), now, going=going, h=h)
        large = ~(np.max(np.abs(z), axis=1) <= design.limit) & going
    z = np.where((going & ~large)[:, None], z, 0.0)
    age = np.where(going, state.age + h, 0.0)
    sigma, outcome = _judge(design, state, z, age, live, large, state.t + h)
    after = HighGainState(
        state.t + h, frozen(z), frozen(np.where(live, y, np.nan)), frozen(now), frozen(age), sigma
    )
    return after, outcome


def _advance(
    design: HighGainDesign, state: HighGainState, y: Floats, u: Floats, *, going: Bools, h: float
) -> Floats:
    move, parts = design.move, design.substeps
    if abs(h - parts * move.h) > 1e-12 * h:
        move = transition(design.system, design.K, h / parts)
    old, z = np.where(going, state.y, 0.0), state.z
    for k in range(parts):
        a, b = k / parts, (k + 1) / parts
        readings = old + a * (y - old), old + b * (y - old)
        inputs = state.u + a * (u - state.u), state.u + b * (u - state.u)
        z = advance(design.field, design.K, move, z, y=readings, u=inputs)
    return z


def error_bounds(design: HighGainDesign, age: Floats) -> Floats:
    """Bounds `max(2 M_z eta e^{-rate age}, epsilon)` (p,) of the errors without attack, after `age` (p,), s.

    Source: kim2018 (12), (14); lee2018 (5.4.2).
    """
    pairs = zip(design.decays, design.system.z_bound, age, strict=True)
    return np.array([float(d.bound(2.0 * bound, a)) for d, bound, a in pairs])


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    x: Floats
    residual: float
    delta: float
    threshold: float

    @property
    def passed(self) -> bool:
        return self.residual <= self.threshold


def _test(design: HighGainDesign, inverse: Inverse, z: Floats, delta: Floats) -> _Trial:
    """Inequality (15), (17) or (21)."""
    system = design.system
    own = z[system.mask][system.pick(inverse.sensors)]
    x = inverse(own)
    residual = float(np.max(np.abs(own - system.phi(x, inverse.sensors))))
    reach = float(np.max(delta[list(inverse.sensors)]))
    return _Trial(x, residual, reach, inverse.factor * reach)


def _judge(  # noqa: PLR0917  # the whole state
    design: HighGainDesign, state: HighGainState, z: Floats, age: Floats, live: Bools, large: Bools, t: float
) -> tuple[int, HighGainEstimate]:
    delta = error_bounds(design, age)
    sigma, visited, trial, alarm = _search(design, state.sigma, z, delta, live, large)
    trusted = np.zeros(len(live), dtype=np.bool_)
    trusted[list(design.inverses[sigma].sensors)] = True
    nothing = np.full(design.system.n, np.nan)
    passed = trial is not None and trial.passed
    # Lemma 1: an observer without attack never reaches its limit.
    bound, named, tested = np.inf, large.copy(), trusted
    if trial is not None and passed:
        bound = kappa_detect(design.inverses[sigma].factor, design.lowest) * trial.delta
        named |= _unhealthy(design, z, trial.x, delta, bound) & live
        whole = design.whole is not None and bool(live.all())
        tested = live if whole or np.isfinite(bound) else trusted
        if design.whole is not None and whole:
            alarm |= not _test(design, design.whole, z, delta).passed
    rest = np.array([decay.epsilon for decay in design.decays])
    settled = bool(np.all(delta[live] <= rest[live]))
    decision, cause, reason = verdict(
        heard=int(live.sum()),
        needed=len(design.inverses[0].sensors),
        passed=None if trial is None else trial.passed,
        alarm=alarm or bool(named.any()),
        settled=settled,
        untested=int(np.count_nonzero(live & ~tested)),
        search=design.search,
    )
    guessed = live & ~trusted if alarm and passed and not named.any() else named
    return sigma, HighGainEstimate(
        t=t,
        x=nothing if trial is None else trial.x,
        bound=float(bound),
        sigma=sigma,
        visited=visited,
        trusted=trusted,
        residual=np.nan if trial is None else trial.residual,
        threshold=np.nan if trial is None else trial.threshold,
        decision=decision,
        cause=cause,
        reason=reason,
        suspects=guessed,
        reset=large,
    )


def _search(  # noqa: PLR0917  # the inputs of a test, and the first set
    design: HighGainDesign, sigma: int, z: Floats, delta: Floats, live: Bools, large: Bools
) -> tuple[int, tuple[int, ...], _Trial | None, bool]:
    """Update rule (20): next set whenever the present one fails or is incomplete."""
    count = len(design.inverses)
    visited: list[int] = []
    trial: _Trial | None = None
    alarm = False
    for change in range(count if design.search == "all" else 2):
        place = (sigma + change) % count
        visited.append(place)
        members = list(design.inverses[place].sensors)
        trial = _test(design, design.inverses[place], z, delta) if live[members].all() else None
        if trial is not None and large[members].any():
            # A sensor that has just been reset is attacked, for any new estimate.
            trial = replace(trial, residual=np.inf)
        if trial is not None and trial.passed:
            break
        alarm |= trial is not None
    return visited[-1], tuple(visited), trial, alarm


def _unhealthy(design: HighGainDesign, z: Floats, x: Floats, delta: Floats, bound: float) -> Bools:
    """Sensors that cannot be unmanipulated: `|zhat_i - Phi_i(xhat)| > delta_i + Lip^(Phi_i) bound`."""
    if not np.isfinite(bound):
        return np.zeros(len(delta), dtype=np.bool_)
    off = np.zeros(z.shape)
    off[design.system.mask] = z[design.system.mask] - design.system.phi(x)
    with np.errstate(invalid="ignore"):  # an infinite bound times the zero constant of a constant sensor
        return np.asarray(np.max(np.abs(off), axis=1) > delta + design.steep * bound)
