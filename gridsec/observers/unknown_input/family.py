"""Family of unknown-input observers of one plant: designed with proofs, stepped together.

Observer i trusts the sensors J_s and uses no knowledge of the inputs J_u:

    x_hat+ = Gbar (A x_hat + G phi(H x_hat + F u) + B u) + K (y - C x_hat - D u)_J + b H (y+ - D u+)_J

Besides its estimate every observer has two bounds of its error that hold while J_u contains all
attacked inputs and J_s no attacked sensor: `level`, of `sqrt(e^T P e)` by the design's certificate, and
`box`, entry by entry, by comparison with a non-negative system. The smaller one is used.

References
----------
yang2021 (35), (36), with the injection of y+ in (35) corrected: docs/errata/yang2021.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, frozen
from gridsec.errors import DesignInfeasible, Problem, refuse
from gridsec.lmi.unknown_input import ErrorSystem, Multiplier, UnknownInputGains, UnknownInputTemplate
from gridsec.observers.unknown_input.plant import (
    Missing,
    Pair,
    UnknownInputPlant,
    error_system,
    obstruction,
    projection,
)


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputDesign:
    """Stacked observers. c observers, n states, r inputs, p sensors.

    Attributes
    ----------
    pairs
        (J_u, J_s) of each observer.
    missing
        Requested observers that do not exist or were not found.
    sensors : (c, p)
        J_s as masks.
    blind : (c, n, n)
        Gbar.
    inject, K : (c, n, p)
        `b H` and the gain, zero in the columns of sensors outside J_s.
    gains
        Gain and proof of each observer, as designed.
    rate, push, slip : (c,)
        `level+ <= sqrt((rate level)^2 + push^2) + slip`.
    reach : (c, n)
        `|e_i| <= reach_i level`.
    shrink, floor : (c, n, n), (c, n)
        `box+ <= shrink box + floor`.
    """

    plant: UnknownInputPlant
    pairs: tuple[Pair, ...]
    missing: tuple[Missing, ...]
    sensors: Bools
    blind: Floats
    inject: Floats
    K: Floats
    gains: tuple[UnknownInputGains, ...]
    rate: Floats
    push: Floats
    slip: Floats
    reach: Floats
    shrink: Floats
    floor: Floats


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputState:
    """State of the observers. c observers, n states, p sensors, l inputs.

    Attributes
    ----------
    t
        Time, s.
    x : (c, n)
        Estimates.
    level, box : (c,), (c, n)
        Bounds of their errors.
    y, u, seen : (p,), (l,), (p,) or None
        The last readings; None before the first ones.
    live : (c,)
        True if the observer had all its readings in the last step.
    """

    t: float
    x: Floats
    level: Floats
    box: Floats
    y: Floats | None
    u: Floats | None
    seen: Bools | None
    live: Bools


def design(
    plant: UnknownInputPlant,
    pairs: Sequence[Pair],
    *,
    rates: Sequence[float] = (0.5, 0.8, 0.95, 0.995),
    multiplier: Multiplier = "diagonal",
    tolerance: float = 1e-9,
    rounding: float = 1e-9,
) -> UnknownInputDesign:
    """Design the observers of several pairs; impossible ones are reported in `missing`.

    Parameters
    ----------
    pairs
        (J_u, J_s) of each observer, indices from 0.
    rates
        Contractions per step to try, ascending; the first one with a gain is used.
    multiplier
        "diagonal" uses a slope for every nonlinearity, "scalar" only the common Lipschitz constant, as (34)
        does. The latter needs equal half-widths and `H = I`.
    tolerance
        For the conditions of existence, see `obstruction`.
    rounding
        Added to the bound of every entry at every step, in the unit of x: allowance for floating point and
        the solver's accuracy.

    Raises
    ------
    DesignInfeasible
        If none of the observers exists.
    ValueError
        If `rates` is empty, or `multiplier` is unknown.
    """
    refuse([] if len(rates) else [Problem("missing", "rates are empty; at least one contraction is needed")])
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
) -> UnknownInputDesign:
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
    return UnknownInputDesign(
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
    design: UnknownInputDesign, t: float, x: Floats | None = None, radius: Floats | None = None
) -> UnknownInputState:
    """Initial state of all observers, at the same estimate.

    Parameters
    ----------
    t
        Time, s.
    x : (n,)
        Initial estimate; zero by default.
    radius : (n,)
        Bound of its error, entry by entry; by default |x| plus the plant's span.
    """
    count, n = len(design.pairs), len(design.plant.span)
    start = np.zeros(n) if x is None else np.asarray(x, dtype=np.float64)
    away = np.abs(start) + design.plant.span if radius is None else np.asarray(radius, dtype=np.float64)
    level = _levels(design, np.tile(away, (count, 1)))
    return UnknownInputState(
        t=float(t),
        x=np.tile(start, (count, 1)),
        level=level,
        box=np.tile(away, (count, 1)),
        y=None,
        u=None,
        seen=None,
        live=np.ones(count, dtype=np.bool_),
    )


def _levels(design: UnknownInputDesign, box: Floats) -> Floats:
    """Upper bound of `sqrt(e^T P e)` in each box; (c,)."""
    out = np.empty(len(box))
    for i, (gains, half) in enumerate(zip(design.gains, box, strict=True)):
        out[i] = np.sqrt(half @ np.abs(gains.P) @ half) if np.all(np.isfinite(half)) else np.inf
    return out


def step(
    design: UnknownInputDesign, state: UnknownInputState, y: Floats, u: Floats, seen: Bools
) -> UnknownInputState:
    """Process the readings of one tick. The first ones are only stored: an observer needs two.

    Parameters
    ----------
    y : (p,)
        Readings at this tick; arbitrary where unseen.
    u : (l,)
        Known input from this tick on, and of this tick's readings; finite.
    seen : (p,)
        True for existing readings. Unseen ones have no influence. An observer without a reading of one of its
        sensors, now or at the last tick, runs on the model with all attacks at zero; its error bound is then
        the plant's span.

    Returns
    -------
    UnknownInputState
        One tick later. Never raises on data.
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
    return UnknownInputState(state.t + system.h, x, level, box, now, drive, heard, able)


def _grown(design: UnknownInputDesign, box: Floats) -> Floats:
    """`shrink box + floor`, with infinite entries kept out of products with zero."""
    endless = ~np.isfinite(box)
    image = np.einsum("cij,cj->ci", design.shrink, np.where(endless, 0.0, box))
    reached = np.any((design.shrink > 0.0) & endless[:, None, :], axis=2)
    return np.where(reached, np.inf, image + design.floor)


def outputs(design: UnknownInputDesign, state: UnknownInputState, u: Floats) -> Floats:
    """Expected reading of every sensor by every observer, `C x_hat + D u`; (c, p).

    Parameters
    ----------
    u : (l,)
        Known input of the tick.
    """
    system = design.plant.system
    return np.asarray(state.x @ system.C.T + system.D @ u)
