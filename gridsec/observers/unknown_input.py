"""Unknown-input observers for Lipschitz nonlinearities: existence, proofs, error bounds, steps.

    x+ = A x + G phi(H x + F u) + B u + B_a a_u + E d,      y = C x + D u + a_y + n

The attack a_u is an unknown input of any size. An observer that trusts the sensors J_s and uses no knowledge
of the inputs J_u needs `rank(C_Js b_Ju) = |J_u|`, and its zeros inside the unit circle:

    x_hat+ = Gbar (A x_hat + G phi(H x_hat + F u) + B u) + K (y - C x_hat - D u)_J + b H (y+ - D u+)_J

Besides its estimate every observer has two bounds of its error that hold while J_u contains all
attacked inputs and J_s no attacked sensor: `level`, of `sqrt(e^T P e)` by the design's certificate, and
`box`, entry by entry, by comparison with a non-negative system. The smaller one is used.

Source: yang2021 (1), (2), (16) to (18), (33) to (36), with the injection of y+ in (35) corrected:
docs/errata/yang2021.md. Theory: docs/theory-unknown-input.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen
from gridsec.errors import DesignInfeasible, InputInvalid, Problem, raise_if_any
from gridsec.observers.lmi.sampled import DiscreteLure, sample
from gridsec.observers.lmi.unknown_input import (
    ErrorSystem,
    Multiplier,
    UnknownInputGains,
    UnknownInputTemplate,
)
from gridsec.observers.lure import Lure

Pair = tuple[tuple[int, ...], tuple[int, ...]]
"""(J_u, J_s): distrusted inputs, trusted sensors."""


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputPlant:
    """A sampled plant with inputs and sensors that may be attacked. n states, r inputs, p sensors.

    Raises ValueError if shapes are inconsistent, the columns of `inputs` are dependent, or `noise` or `span`
        is invalid; lists every problem.
    """

    system: DiscreteLure  # the plant without attacks
    inputs: Floats  # (n, r) B_a, full column rank. For yang2021 (33) also the B of the known input
    noise: Floats  # (p,) largest error of each unmanipulated reading; either all positive or all zero
    drift: Floats  # (n, d) E: deviation of the plant from its model, with |d_i| <= 1
    span: Floats  # (n,) largest possible |x_i|, or infinity. The only knowledge at the start

    def __post_init__(self) -> None:
        for name in ("inputs", "noise", "drift", "span"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        n, p = len(self.system.A), len(self.system.C)
        problems = []
        if self.inputs.ndim != 2 or len(self.inputs) != n or not self.inputs.shape[1]:
            problems.append(
                Problem("shape", f"inputs has shape {self.inputs.shape}; expected ({n}, r) with r > 0")
            )
        elif np.linalg.matrix_rank(self.inputs) < self.inputs.shape[1]:
            problems.append(
                Problem(
                    "singular", "the columns of inputs are dependent: no reconstruction could tell them apart"
                )
            )
        if self.noise.shape != (p,) or not (np.all(self.noise > 0.0) or np.all(self.noise == 0.0)):
            problems.append(
                Problem("not-positive", f"noise must be of shape ({p},), all positive or all zero")
            )
        if self.drift.ndim != 2 or len(self.drift) != n:
            problems.append(Problem("shape", f"drift has shape {self.drift.shape}; expected ({n}, d)"))
        if self.span.shape != (n,) or not np.all(self.span > 0.0):
            problems.append(Problem("not-positive", f"span must be positive, of shape ({n},)"))
        raise_if_any(problems)

    @property
    def scale(self) -> Floats:
        """Error scale of each sensor, (p,): its noise, or 1 for all without noise."""
        return self.noise if np.all(self.noise > 0.0) else np.ones(self.noise.size)

    @property
    def middle(self) -> Floats:
        """Middle of each slope interval, (m,)."""
        return 0.5 * (self.system.lower + self.system.upper)

    @property
    def half(self) -> Floats:
        """Half-width of each slope interval, (m,)."""
        return 0.5 * (self.system.upper - self.system.lower)


def exact(system: DiscreteLure, inputs: Floats) -> UnknownInputPlant:
    """Plant with exact readings and an exact model, as in yang2021."""
    n, p = len(system.A), len(system.C)
    return UnknownInputPlant(system, inputs, np.zeros(p), np.zeros((n, 0)), np.full(n, np.inf))


def inverters(
    lure: Lure,
    h: float,
    attackable: Ints,
    *,
    reading_error: Floats,
    u_error: Floats,
    curve_error: Floats,
    span: Floats,
    reports: Ints | None = None,
    report_error: Floats | None = None,
) -> UnknownInputPlant:
    """Loop of a feeder with attackable set points of inverters.

    An attacked inverter follows `tau x' = -x + K(z) + a_u`: a_u is the error of its set point, and any course
    of its reactive injection corresponds to some a_u. Sampled at h with `lmi.sampled.sample`. Sensors are the
    voltage meters, then the reported reactive injections of inverters.

    lure: closed loop of a feeder, from `close_loop`.
    h: time between readings, s.
    attackable (r,): inverters with an attackable set point.
    reading_error (p',): largest error of each voltage meter, squared pu.
    u_error (l,): largest error of each entry of the known input, squared pu. It adds to the readings' errors
        through D and to the set points' through the steepest slope of the curve.
    curve_error (m,): largest further error of each inverter's set point, pu: motion of z within a step,
        difference between the curve and the model's.
    span (m,): largest reactive injection of each inverter, attacked or not, pu.
    reports (k,): inverters with a reported reactive injection.
    report_error (k,): largest error of each report, pu.
    Raises ValueError as `UnknownInputPlant`, or if reports and their errors differ in number.
    """
    system = sample(lure, h)
    n, inputs = system.B.shape
    told = np.zeros(0, dtype=np.intp) if reports is None else np.asarray(reports, dtype=np.intp)
    error = np.zeros(0) if report_error is None else np.asarray(report_error, dtype=np.float64)
    if told.size != error.size:
        raise InputInvalid.of(
            "shape", f"{told.size} inverters report, but {error.size} errors of reports are given"
        )
    C, D = np.vstack([system.C, np.eye(n)[told]]), np.vstack([system.D, np.zeros((told.size, inputs))])
    off = curve_error + lure.slope * (np.abs(lure.F) @ u_error)
    drift = system.G * off
    noise = np.concatenate([reading_error + np.abs(lure.D) @ u_error, error])
    whole = replace(system, C=C, D=D)
    return UnknownInputPlant(whole, system.G[:, attackable], noise, drift[:, off > 0.0], span)


@dataclass(frozen=True, slots=True)
class Missing:
    """An observer missing from a bank."""

    pair: Pair  # (J_u, J_s)
    # "rank": the sensors do not observe every unknown input. "zero": a zero outside the unit circle. Either
    # proves that no observer satisfies (3) or (21) of yang2021. "design": no gain was found; others may exist
    reason: Literal["rank", "zero", "design"]
    rank: int  # rank of `C_Js b_Ju`
    # smallest singular value relative to the largest; modulus of the zero; or the design's margin
    value: float
    why: str  # one sentence


def obstruction(plant: UnknownInputPlant, pair: Pair, *, tolerance: float) -> Missing | None:
    """Proof that the observer of (J_u, J_s) cannot exist, if one of the two necessary conditions fails.

    Rank: `rank(C_Js b_Ju) = |J_u|`, by singular values of the sensors' rows in units of their errors. Zeros:
    if J_s has as many sensors as J_u inputs, some slopes at the ends of their intervals give the linearised
    plant a zero of modulus above 1. (Proofs: docs/theory-unknown-input.md, sections 2 and 3; the latter
    presumes that the known input can hold the plant where its slopes are these.)

    pair: (J_u, J_s).
    tolerance: singular values below this part of the largest count as zero.
    Returns None if both conditions hold; a design may still not exist.
    """
    unknown, sensors = list(pair[0]), list(pair[1])
    seen = plant.system.C[sensors] / plant.scale[sensors, None] @ plant.inputs[:, unknown]
    values = np.linalg.svd(seen, compute_uv=False)
    size = float(np.max(values, initial=0.0))
    rank = int(np.count_nonzero(values > tolerance * size))
    if rank < len(unknown):
        least = float(values[-1] / size) if size and values.size >= len(unknown) else 0.0
        why = f"the sensors {sensors} see the inputs {unknown} with rank {rank}, not {len(unknown)}"
        return Missing(pair, "rank", rank, least, why)
    if len(sensors) != len(unknown):
        return None
    worst = worst_zero(plant, pair)
    if worst > 1.0 + tolerance:
        why = f"blind to the inputs {unknown}, the sensors {sensors} leave a zero of modulus {worst:.4g}"
        return Missing(pair, "zero", rank, worst, why)
    return None


def worst_zero(plant: UnknownInputPlant, pair: Pair) -> float:
    """Largest modulus of a zero from J_u to J_s over the corners of the slope intervals; 0 without zeros.

    Only for as many sensors as unknown inputs: then the error invisible to the sensors moves inside
    `ker C_Js` by `Gbar (A + G diag(d) H)`, and its eigenvalues there are the zeros.

    pair: (J_u, J_s), with `C_Js b_Ju` square and regular.
    Raises DesignInfeasible if there are too many nonlinearities to visit all corners.
    """
    system, sensors = plant.system, list(pair[1])
    blind, _ = projection(plant, pair)
    hidden = np.linalg.svd(system.C[sensors])[2][len(sensors) :].T
    if not hidden.size:
        return 0.0
    live = np.flatnonzero(system.slope > 0.0)
    if live.size > _CORNERS:
        raise DesignInfeasible(
            "zeros at all corners of the slopes", f"{live.size} nonlinearities are too many", code="too-many"
        )
    worst = 0.0
    for ends in product((0, 1), repeat=live.size):
        d = system.lower.copy()
        d[live] = np.where(ends, system.upper[live], system.lower[live])
        zeros = np.linalg.eigvals(hidden.T @ blind @ (system.A + (system.G * d) @ system.H) @ hidden)
        worst = max(worst, float(np.max(np.abs(zeros))))
    return worst


# 2^12 corners of the slope intervals take a second.
_CORNERS = 12


def projection(plant: UnknownInputPlant, pair: Pair) -> tuple[Floats, Floats]:
    """`Gbar = I - b H C_J` and `b H` of yang2021 (35), (36).

    H is the left inverse of `C_J b` that is least squares in units of the sensors' errors; with equal
    errors this is the Moore-Penrose inverse of the paper.

    plant, pair: as in `obstruction`, which must return None.
    Returns blind (n, n), inject (n, |J_s|): `blind @ b = 0`.
    """
    unknown, sensors = list(pair[0]), list(pair[1])
    n = len(plant.system.A)
    if not unknown:
        return np.eye(n), np.zeros((n, len(sensors)))
    b, C, N = plant.inputs[:, unknown], plant.system.C[sensors], plant.scale[sensors]
    inject = b @ np.linalg.pinv(C @ b / N[:, None]) / N
    return np.eye(n) - inject @ C, inject


def error_system(plant: UnknownInputPlant, pair: Pair) -> ErrorSystem:
    """Error system of the observer without its gain.

    `e+ = (Gbar (A + G mid H) - K C_J) e + Gbar G psi + [b H N, Gbar E] w + K N n` with `e = x_hat - x`.

    plant, pair: as in `projection`.
    """
    system, sensors = plant.system, list(pair[1])
    blind, inject = projection(plant, pair)
    N = plant.scale[sensors]
    return ErrorSystem(
        M=blind @ (system.A + (system.G * plant.middle) @ system.H),
        S=blind @ system.G,
        H=system.H,
        half=plant.half,
        C=system.C[sensors],
        W=np.hstack([inject * N, blind @ plant.drift]),
        N=N,
    )


def pairs_text(pairs: Sequence[Pair]) -> str:
    """Pairs with indices counted from 1, as in the papers; for messages."""
    return "; ".join(
        "({" + ",".join(str(i + 1) for i in u) + "},{" + ",".join(str(j + 1) for j in s) + "})"
        for u, s in pairs
    )


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputObserver:
    """Stacked observers. c observers, n states, r inputs, p sensors."""

    plant: UnknownInputPlant
    pairs: tuple[Pair, ...]  # (J_u, J_s) of each observer
    missing: tuple[Missing, ...]  # requested observers that do not exist or were not found
    sensors: Bools  # (c, p) J_s as masks
    blind: Floats  # (c, n, n) Gbar
    inject: Floats  # (c, n, p) `b H`; zero columns for sensors outside J_s
    K: Floats  # (c, n, p) gain; zero columns likewise
    gains: tuple[UnknownInputGains, ...]  # gain and proof of each observer, as designed
    rate: Floats  # (c,) `level+ <= sqrt((rate level)^2 + push^2) + slip`
    push: Floats  # (c,)
    slip: Floats  # (c,)
    reach: Floats  # (c, n) `|e_i| <= reach_i level`
    shrink: Floats  # (c, n, n) `box+ <= shrink box + floor`
    floor: Floats  # (c, n)


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputObserverState:
    """State of the observers. c observers, n states, p sensors, l inputs."""

    t: float  # time, s
    x: Floats  # (c, n) estimates
    level: Floats  # (c,) bound of each error in the norm `sqrt(e^T P e)`
    box: Floats  # (c, n) bound of each entry of the errors
    y: Floats | None  # (p,) the last readings; None before the first ones
    u: Floats | None  # (l,) input of the same tick
    seen: Bools | None  # (p,) mask of these readings
    live: Bools  # (c,) True if the observer had all its readings in the last step


def design(
    plant: UnknownInputPlant,
    pairs: Sequence[Pair],
    *,
    rates: Sequence[float] = (0.5, 0.8, 0.95, 0.995),
    multiplier: Multiplier = "diagonal",
    tolerance: float = 1e-9,
    rounding: float = 1e-9,
) -> UnknownInputObserver:
    """Design the observers of several pairs; impossible ones are reported in `missing`.

    pairs: (J_u, J_s) of each observer, indices from 0.
    rates: contractions per step to try, ascending; the first one with a gain is used.
    multiplier: "diagonal" uses a slope for every nonlinearity, "scalar" only the common Lipschitz constant,
        as (34) does. The latter needs equal half-widths and `H = I`.
    tolerance: for the conditions of existence, see `obstruction`.
    rounding: added to the bound of every entry at every step, in the unit of x: allowance for floating point
        and the solver's accuracy.
    Raises DesignInfeasible if none of the observers exists. ValueError if `rates` is empty, or `multiplier`
        is unknown.
    """
    raise_if_any(
        [] if len(rates) else [Problem("missing", "rates are empty; at least one contraction is needed")]
    )
    templates: dict[tuple[int, int], UnknownInputTemplate] = {}
    made: list[tuple[Pair, ErrorSystem, UnknownInputGains]] = []
    missing: list[Missing] = []
    for pair in pairs:
        found = obstruction(plant, pair, tolerance=tolerance)
        if found is None:
            system = error_system(plant, pair)
            outcome = _gain(templates, system, pair, rates, multiplier)
            if isinstance(outcome, UnknownInputGains):
                made.append((pair, system, outcome))
                continue
            found = outcome
        missing.append(found)
    if not made:
        raise DesignInfeasible(
            "bank of unknown-input observers", f"no member exists: {missing[0].why}", code="no-solution"
        )
    return _stack(plant, made, tuple(missing), rounding)


def _gain(
    templates: dict[tuple[int, int], UnknownInputTemplate],
    system: ErrorSystem,
    pair: Pair,
    rates: Sequence[float],
    multiplier: Multiplier,
) -> UnknownInputGains | Missing:
    bounds = int(np.count_nonzero(system.half > 0.0))
    key = (system.N.size, bounds)
    if key not in templates:
        templates[key] = UnknownInputTemplate(len(system.M), system.N.size, bounds, multiplier)
    what = f"unknown-input observer of {pair}"
    for rate in rates:
        try:
            return templates[key].solve(system, rate, what)
        except DesignInfeasible as failure:
            last = failure
    margin = np.nan if last.margin is None else last.margin
    why = f"no gain of the observer {pair} was found for contractions up to {max(rates):g}: {last.status}"
    return Missing(pair, "design", len(pair[0]), margin, why)


def _stack(
    plant: UnknownInputPlant,
    made: Sequence[tuple[Pair, ErrorSystem, UnknownInputGains]],
    missing: tuple[Missing, ...],
    rounding: float,
) -> UnknownInputObserver:
    c, n, p = len(made), len(plant.system.A), len(plant.noise)
    sensors = np.zeros((c, p), dtype=np.bool_)
    inject, K, blind = np.zeros((c, n, p)), np.zeros((c, n, p)), np.zeros((c, n, n))
    push, slip, reach = np.zeros(c), np.zeros(c), np.zeros((c, n))
    shrink, floor = np.zeros((c, n, n)), np.zeros((c, n))
    noisy = bool(np.any(plant.noise > 0.0))
    for i, (pair, system, gains) in enumerate(made):
        own = list(pair[1])
        sensors[i, own] = True
        blind[i], inject[i][:, own] = projection(plant, pair)
        K[i][:, own] = gains.K
        # Without noise the readings' channels have a scale but no content.
        count = len(own)
        W = system.W if noisy else system.W[:, count:]
        unit = W.shape[1] + (count if noisy else 0)
        push[i] = np.sqrt(gains.mu * unit)
        reach[i] = np.sqrt(np.diagonal(np.linalg.inv(gains.P)))
        widths = np.abs(system.S) @ (system.half[:, None] * np.abs(system.H))
        shrink[i] = np.abs(system.M - gains.K @ system.C) + widths
        floor[i] = np.sum(np.abs(W), axis=1) + noisy * (np.abs(gains.K) @ system.N) + rounding
        slip[i] = rounding * np.sqrt(np.sum(np.abs(gains.P)))
    masks = np.array(sensors)
    masks.flags.writeable = False
    return UnknownInputObserver(
        plant=plant,
        pairs=tuple(pair for pair, _, _ in made),
        missing=missing,
        sensors=masks,
        blind=frozen(blind),
        inject=frozen(inject),
        K=frozen(K),
        gains=tuple(gains for _, _, gains in made),
        rate=frozen(np.array([gains.rate for _, _, gains in made])),
        push=frozen(push),
        slip=frozen(slip),
        reach=frozen(reach),
        shrink=frozen(shrink),
        floor=frozen(floor),
    )


def init(
    design: UnknownInputObserver, t: float, x: Floats | None = None, radius: Floats | None = None
) -> UnknownInputObserverState:
    """Initial state of all observers, at the same estimate.

    t: time, s.
    x (n,): initial estimate; zero by default.
    radius (n,): bound of its error, entry by entry; by default |x| plus the plant's span.
    """
    count, n = len(design.pairs), len(design.plant.span)
    start = np.zeros(n) if x is None else np.asarray(x, dtype=np.float64)
    away = np.abs(start) + design.plant.span if radius is None else np.asarray(radius, dtype=np.float64)
    level = _levels(design, np.tile(away, (count, 1)))
    return UnknownInputObserverState(
        t=float(t),
        x=np.tile(start, (count, 1)),
        level=level,
        box=np.tile(away, (count, 1)),
        y=None,
        u=None,
        seen=None,
        live=np.ones(count, dtype=np.bool_),
    )


def _levels(design: UnknownInputObserver, box: Floats) -> Floats:
    """Upper bound of `sqrt(e^T P e)` in each box; (c,)."""
    out = np.empty(len(box))
    for i, (gains, half) in enumerate(zip(design.gains, box, strict=True)):
        out[i] = np.sqrt(half @ np.abs(gains.P) @ half) if np.all(np.isfinite(half)) else np.inf
    return out


def step(
    design: UnknownInputObserver, state: UnknownInputObserverState, y: Floats, u: Floats, seen: Bools
) -> UnknownInputObserverState:
    """Process the readings of one tick. The first ones are only stored: an observer needs two.

    y (p,): readings at this tick; arbitrary where unseen.
    u (l,): known input from this tick on, and of this tick's readings; finite.
    seen (p,): True for existing readings. Unseen ones have no influence. An observer without a reading of one
        of its sensors, now or at the last tick, runs on the model with all attacks at zero; its error bound
        is then the plant's span.
    Never raises on data.
    """
    plant, system = design.plant, design.plant.system
    heard = np.asarray(seen, dtype=np.bool_) & np.isfinite(y)
    now = np.where(heard, y, 0.0)
    drive = np.asarray(u, dtype=np.float64)
    if state.y is None or state.u is None or state.seen is None:
        # The estimates are of this tick already: time starts with the first readings.
        return replace(state, y=now, u=drive, seen=heard)
    z = state.x @ system.H.T + system.F @ state.u
    free = state.x @ system.A.T + system.phi(z) @ system.G.T + system.B @ state.u
    able = ~np.any(design.sensors & ~(heard & state.seen), axis=1)
    residual = np.where(state.seen, state.y - system.D @ state.u, 0.0) - state.x @ system.C.T
    fresh = np.where(heard, now - system.D @ drive, 0.0)
    led = (
        np.einsum("cij,cj->ci", design.blind, free)
        + np.einsum("cij,cj->ci", design.K, residual)
        + design.inject @ fresh
    )
    x = np.where(able[:, None], led, free)
    level = np.sqrt((design.rate * state.level) ** 2 + design.push**2) + design.slip
    box = np.minimum(_grown(design, state.box), design.reach * level[:, None])
    if not np.all(able):
        lost = np.abs(free[~able]) + plant.span
        box[~able] = lost
        level[~able] = _levels(design, box)[~able]
    return UnknownInputObserverState(state.t + system.h, x, level, box, now, drive, heard, able)


def _grown(design: UnknownInputObserver, box: Floats) -> Floats:
    """`shrink box + floor`, with infinite entries kept out of products with zero."""
    endless = ~np.isfinite(box)
    image = np.einsum("cij,cj->ci", design.shrink, np.where(endless, 0.0, box))
    reached = np.any((design.shrink > 0.0) & endless[:, None, :], axis=2)
    return np.where(reached, np.inf, image + design.floor)


def outputs(design: UnknownInputObserver, state: UnknownInputObserverState, u: Floats) -> Floats:
    """Expected reading of every sensor by every observer, `C x_hat + D u`, for the tick's u (l,); (c, p)."""
    system = design.plant.system
    return np.asarray(state.x @ system.C.T + system.D @ u)
