"""Residual thresholds and decisions: from residuals to named meters and a verdict.

A threshold is the largest distance of an unmanipulated reading from the reconstructed voltage. A meter is
named as manipulated if its output residual exceeds the largest value that unmanipulated meters, loads within
stated intervals, the observers' own error and the model's error can produce together. Every term comes from a
stated accuracy. The sum is a worst case, because the errors of loads and meters may be systematic.
docs/theory-detection.md has the derivation and the proof. The decisions contain no physics.

Source: chong2020, section V and Theorem 2 (the estimate's error), equation (19) (the reconstructed voltage).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of, frozen
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.grid.network import LinDistFlow
from gridsec.interface import Cause, Decision
from gridsec.observers.lure import StepPolicy, rest


@dataclass(frozen=True, slots=True, eq=False)
class Majorant:
    """Entrywise bounds for the observers of all sets, with any of their meters unavailable."""

    H: Floats  # (m, m) `|H - K_J C|`
    F: Floats  # (m, N) `|F - K_J D|`
    # K, L (m, p): `|K_J|`, and `T |L_J|`: change of each state's target per pu of output error
    K: Floats
    L: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """Propagation of errors through feeder and observers. N customers, m inverters, p meters."""

    droop: Droop  # the inverters
    quota: int  # 2M: largest number of meters left out by an observer without manipulated meters
    # R2, X2 (N, N): `2 |R|`, `2 |X|`
    R2: Floats
    X2: Floats
    # inverters, reach (N, m), (N, p): columns of X2 at the customers of inverters and of meters
    inverters: Floats
    reach: Floats
    # inverters_own, reach_own (m, m), (m, p): rows of these at the inverters' customers
    inverters_own: Floats
    reach_own: Floats
    meters: Ints  # (p,) customer of each meter
    meter_of: Ints  # (m,) meter that drives each inverter; -1 for none
    span: Floats  # (m,) distance between the saturated values of each curve, pu
    mismatch: Floats  # (m,) largest distance of a real inverter's curve, linear in v, from K, linear in z, pu
    majorant: Majorant | None = None  # for gains other than direct injection


def error_model(droop: Droop, model: LinDistFlow, meters: Ints, max_attacked: int) -> ErrorModel:
    """Coefficients of the bounds for p meters at the customers `meters` (p,) and M = `max_attacked`."""
    at = {int(c): j for j, c in reversed(list(enumerate(meters)))}
    own, X2 = droop.customer, 2.0 * np.abs(model.X)
    return ErrorModel(
        droop=droop,
        quota=2 * max_attacked,
        R2=frozen(2.0 * np.abs(model.R)),
        X2=frozen(X2),
        inverters=frozen(X2[:, own]),
        reach=frozen(X2[:, meters]),
        inverters_own=frozen(X2[np.ix_(own, own)]),
        reach_own=frozen(X2[np.ix_(own, meters)]),
        meters=meters,
        meter_of=np.array([at.get(int(c), -1) for c in droop.customer], dtype=np.intp),
        span=frozen(droop.span),
        mismatch=curve_mismatch(droop),
    )


def curve_mismatch(droop: Droop) -> Floats:
    """Largest distance between the curve in v and its model in z, per inverter; (m,).

    Both agree at the breakpoints. Between two of them, v as a function of z is a parabola against its
    chord: the distance is largest in the middle of the interval of v, `(dv)^2 / 4` in z. Its reactive power
    is computed there, not approximated.
    """
    worst = np.zeros(droop.tau.shape)
    for left in range(3):
        # The sagitta of v^2 over [a, b] is largest at the arithmetic mean.
        middle = 0.5 * (droop.v[:, left] + droop.v[:, left + 1])
        gap = np.abs(voltage_curve(droop, middle) - droop(droop.vbar**2 - middle**2))
        np.maximum(worst, gap, out=worst)
    return worst


@dataclass(frozen=True, slots=True, eq=False)
class TickUncertainty:
    """Uncertainty at one tick."""

    # (N,) error of each customer's squared voltage for known injections of inverters: busbar, loads, model;
    # squared pu
    base: Floats
    reading: Floats  # (p,) error of each unmanipulated reading, squared pu
    live: Bools  # (p,) meters with a usable reading
    told: Bools  # (p,) available meters at customers with metered net reactive power in use
    # (p,) excess of the assumed load's uncertainty over that of the metered net at such a customer, pu
    extra: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ErrorBound:
    """Bounds of the observers' error, inverter by inverter; valid at every time. m inverters."""

    driven: Floats  # (m,) for inverters driven by their own unmanipulated meter, pu
    # (m,) for inverters that run on the model, in every observer without manipulated meters that leaves out
    # at most 2M meters, pu
    free: Floats


def widest(model: ErrorModel, x: Floats | None = None) -> ErrorBound:
    """Bound without any knowledge: the true injections lie between the saturated values.

    x (…, m): the observers' states, needed where they can leave the range of the curves (gains L); by default
        they lie in it.
    """
    if x is None:
        return ErrorBound(model.span.copy(), model.span.copy())
    far = np.abs(x).reshape(-1, model.span.size).max(axis=0, initial=0.0) + model.droop.limit
    return ErrorBound(far, far.copy())


def gap(model: ErrorModel, now: TickUncertainty, bound: ErrorBound, *, own: bool = False) -> Floats:
    """Error of squared voltages in any observer without manipulated meters and at most 2M meters left out.

    `base_i + sum over undriven inverters 2 X_ik free_k + sum over meters 2 X_ij driven_j
    + the 2M largest of 2 X_ij (free_j - driven_j)`: the worst choice of 2M omitted meters.

    Returns (N,) or (m,): bounds, squared pu.
    """
    inverters, column = (model.inverters_own, model.reach_own) if own else (model.inverters, model.reach)
    base = now.base[model.droop.customer] if own else now.base
    metered = (model.meter_of >= 0) & now.live[model.meter_of] if now.live.size else model.meter_of >= 0
    out = base + inverters @ np.where(metered, 0.0, bound.free)
    p, at = now.live.size, model.meter_of[metered]
    driven = np.bincount(at, weights=bound.driven[metered], minlength=p)
    free = np.bincount(at, weights=bound.free[metered], minlength=p)
    # While the net is metered and trusted, the inverter's own state has no effect on the voltage.
    driven = np.where(now.told, 0.0, driven)
    swing = np.maximum(np.where(now.told, free + now.extra, free) - driven, 0.0)
    return np.asarray(out + column @ driven + largest(column * swing, model.quota))


def largest(values: Floats, count: int) -> Floats:
    """Sum of the `count` largest entries of each row of `values` (r, p), which are not negative; (r,)."""
    p = values.shape[1]
    if count >= p:
        return np.asarray(values.sum(axis=1))
    if count == 0:
        return np.zeros(values.shape[0])
    return np.asarray(np.partition(values, p - count, axis=1)[:, p - count :].sum(axis=1))


def handed_over(
    model: ErrorModel, bound: ErrorBound, before: Bools, live: Bools, *, spread: Floats | float = 0.0
) -> ErrorBound:
    """The bounds when meters become unavailable or return: each inverter takes the other mode's error.

    before, live (p,): meters that drive inverters before and after the change.
    spread (m,): distance of the state that a returning inverter starts from to that of the observer, pu.
    """
    if not live.size:
        return bound
    metered = model.meter_of >= 0
    was, now = metered & before[model.meter_of], metered & live[model.meter_of]
    free = np.where(was & ~now, np.maximum(bound.free, bound.driven), bound.free)
    return ErrorBound(np.where(now & ~was, bound.free + spread, bound.driven), free)


def slowed(model: ErrorModel, h: float, policy: StepPolicy) -> Bools:
    """Mask (m,) of inverters that a step treats as slower than they are: `lure.transition`, `lure.rest`."""
    fast = model.droop.tau * rest(h, policy) < 1.0
    # If all are that fast, the step ends in the equilibrium.
    return np.asarray(fast & ~fast.all())


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Estimate before and after one step."""

    # before, after (m,): estimated z at the inverters at the beginning and the end, pu
    before: Floats
    after: Floats
    # (m,) largest distance of the selected estimate's z from that of an observer without manipulated meters,
    # pu
    offset: Floats
    h: float  # length of the step, s
    # (m,) motion of the inverters that the observers' step treats as slower than they are
    # (`lure.transition`), pu; 0 for the others
    lag: Floats | float = 0.0


def settled(model: ErrorModel, now: TickUncertainty, motion: Motion, start: ErrorBound) -> ErrorBound:
    """Level to which the bounds converge, given that they never exceed `start`.

    Iterates the monotone map of `docs/theory-detection.md` downwards from `start`. Every iterate is a bound;
    the iteration may stop at any time.

    start: an upper bound that the map does not exceed.
    """
    level = start
    for _ in range(_ROUNDS):
        image = _image(model, now, motion, level)
        lower = ErrorBound(np.minimum(level.driven, image.driven), np.minimum(level.free, image.free))
        done = np.all(lower.free >= (1.0 - _TIGHTENING) * level.free)
        level = lower
        if done:
            break
    return level


def at_rest(model: ErrorModel, now: TickUncertainty, motion: Motion) -> ErrorBound:
    """Level to which the bounds converge from any initial state."""
    none = np.zeros(model.span.size)
    return settled(model, now, motion, ceiling(model, now, motion, ErrorBound(none, none)))


def _image(model: ErrorModel, now: TickUncertainty, motion: Motion, bound: ErrorBound) -> ErrorBound:
    """Largest difference of the curves' values for errors within `bound`."""
    droop = model.droop
    # Readings and loads are held over the step; their motion within it is part of the error. All of it may
    # have occurred just before the reading, so a long step gets no discount.
    hold = np.abs(motion.after - motion.before)
    around = gap(model, now, bound, own=True) + hold
    injected: Floats | float = 0.0
    if model.majorant is None:
        through = around
        own = (now.reading[model.meter_of] if now.reading.size else np.zeros(hold.shape)) + hold
    else:
        big = model.majorant
        through = own = big.H @ bound.free + big.F @ now.base + big.K @ now.reading + hold
        # Voltages at meters change within the step by at most the largest change at the inverters.
        seen = now.base[model.meters] + now.reading + np.max(hold, initial=0.0)
        injected = big.L @ (model.inverters[model.meters] @ bound.free + seen)
    low = np.minimum(motion.before, motion.after) - motion.offset - around
    high = np.maximum(motion.before, motion.after) + motion.offset + around

    radius = np.stack([own, through])
    over, under = droop(np.stack([high + radius, low - radius]))
    steep = np.minimum(droop.slope * radius, over - under)
    driven, free = np.minimum(steep + model.mismatch + motion.lag, model.span) + injected
    return ErrorBound(driven, free)


# Rounds of the iteration, and the relative gain below which it stops. Both trade tightness for time only.
_ROUNDS = 40
_TIGHTENING = 1e-3
# Factor on the last bound for the first guess of the next, before a restart from saturation.
_ROOM = 1.05


def advance(
    model: ErrorModel, now: TickUncertainty, motion: Motion, bound: ErrorBound, last: ErrorBound
) -> tuple[ErrorBound, ErrorBound]:
    """Bounds at the end of a step.

    Every error is a first-order lag of its input, `tau |e|' <= -|e| + reach(e)`, and reach is
    monotone: with any G that is at least the present bound and at least its own image, the error stays
    below G during the step, and `bound+ = exp(-h/tau) bound + (1 - exp(-h/tau)) reach(G)`.

    last: the G of the previous step, as first guess.
    Returns ErrorBound, ErrorBound: bound at the end, and this step's G.
    """
    keep = np.exp(-motion.h / model.droop.tau)
    top = ErrorBound(np.maximum(bound.driven, _ROOM * last.driven), np.maximum(bound.free, _ROOM * last.free))
    image = _image(model, now, motion, top)
    if not (np.all(image.free <= top.free) and np.all(image.driven <= top.driven)):
        top = ceiling(model, now, motion, bound)
        image = _image(model, now, motion, top)
    # Lower it while it stays above the bound and above its own image.
    for _ in range(_ROUNDS):
        lower = ErrorBound(
            np.minimum(top.driven, np.maximum(image.driven, bound.driven)),
            np.minimum(top.free, np.maximum(image.free, bound.free)),
        )
        done = np.all(lower.free >= (1.0 - _TIGHTENING) * top.free)
        top = lower
        # The image of the level before is a bound too: it is not below that of the lower level.
        if done:
            break
        image = _image(model, now, motion, top)
    after = ErrorBound(
        keep * bound.driven + (1.0 - keep) * image.driven, keep * bound.free + (1.0 - keep) * image.free
    )
    return after, top


def ceiling(model: ErrorModel, now: TickUncertainty, motion: Motion, floor: ErrorBound) -> ErrorBound:
    """A level above `floor` that the map of the bounds does not exceed.

    Without output injection, the saturation of the curves. With it, the map is at most `r + A bound` with a
    matrix A of spectral radius below 1 (the certificate), and `(I - A)^-1 r` plus any multiple of
    `(I - A)^-1 1` is such a level.
    """
    big = model.majorant
    if big is None or not big.L.any():
        top = widest(model)
        return ErrorBound(np.maximum(top.driven, floor.driven), np.maximum(top.free, floor.free))
    count = model.span.size
    loop = np.eye(count) - model.droop.slope[:, None] * big.H - big.L @ model.inverters[model.meters]
    hold = np.abs(motion.after - motion.before)
    fixed = model.droop.slope * (big.F @ now.base + big.K @ now.reading + hold) + model.mismatch + motion.lag
    fixed = fixed + big.L @ (now.base[model.meters] + now.reading + np.max(hold, initial=0.0))
    level, weights = np.linalg.solve(loop, np.stack([fixed, np.ones(count)], axis=1)).T
    lift = np.max((np.maximum(floor.free, floor.driven) - level) / weights, initial=0.0)
    high = level + lift * weights
    return ErrorBound(high, high.copy())


# --- Decisions ---


@dataclass(frozen=True, slots=True, eq=False)
class Counters:
    """Counters of each meter's latest readings. p meters."""

    above: Ints  # (p,) readings above the threshold since the meter became suspect; 0 for meters not suspect
    below: Ints  # (p,) consecutive readings not above the threshold
    named: Bools  # (p,) meters named as manipulated


def no_counts(size: int) -> Counters:
    """Counters before the first reading."""
    zero = np.zeros(size, dtype=np.intp)
    return Counters(zero, zero, np.zeros(size, dtype=np.bool_))


def count(tally: Counters, over: Bools, live: Bools, *, confirm: int, release: int) -> Counters:
    """Update the counters with the residuals of one frame.

    A reading above the threshold makes a meter suspect; only `release` consecutive readings below it end
    that. The meter is named with the `confirm`-th reading above, with or without others in between: attacking
    every second reading does not avoid detection. An unavailable meter keeps its state: a named meter is not
    cleared by silence.

    confirm, release: readings above the threshold until a meter is named, and consecutive readings below it
        until it is neither named nor suspect.
    """
    below = np.where(live, np.where(over, 0, tally.below + 1), tally.below)
    above = np.where(below >= release, 0, tally.above + (live & over))
    named = (tally.named & (below < release)) | (above >= confirm)
    return Counters(above, below, named)


@dataclass(frozen=True, slots=True, eq=False)
class DecisionInputs:
    """Inputs of a verdict. p meters."""

    names: tuple[str, ...]  # (p,) names of the meters in sentences
    max_attacked: int  # M
    # live, suspected, named (p,): meters that are available, suspect, and named
    live: Bools
    suspected: Bools
    named: Bools
    wide: Bools  # (p,) meters with a threshold that is too wide for an answer or not finite
    # valid, settled, busbar: True if the design holds, if the initial transient has decayed, and if the
    # busbar voltage is known
    valid: bool
    settled: bool
    busbar: bool


AGREEMENT = Decision.CLEAN, Cause.AGREEMENT, "All meters agree with the feeder."
"""The answer if no other cause applies."""


def decide(now: DecisionInputs) -> tuple[Decision, Cause, str]:
    """The answer, its cause, and one sentence for an operator.

    Causes that invalidate every other answer come first; CLEAN is the answer if no other cause applies.
    """
    blind = _blind(now)
    if blind is not None:
        return Decision.UNDECIDED, *blind
    if any_of(now.named):
        far = "further off than meter accuracy and load uncertainty allow"
        return Decision.ATTACKED, Cause.RESIDUALS, f"Manipulated: {_list(now, now.named)}; {far}."
    doubt = _doubt(now)
    if doubt is not None:
        return Decision.UNDECIDED, *doubt
    return AGREEMENT


def _blind(now: DecisionInputs) -> tuple[Cause, str] | None:
    """Cause and reason that prevent naming any meter; None if there are none."""
    # Unavailable meters, named or not, count neither for nor against others.
    live, named = int(np.count_nonzero(now.live)), int(np.count_nonzero(now.named & now.live))
    need = 2 * now.max_attacked + 1
    if not now.valid:
        reason = "The design's certificate does not hold for this feeder; nothing is guaranteed."
        return Cause.DESIGN_INVALID, reason
    if live < need:
        reason = (
            f"{live} of {now.live.size} meters report; at least {need} are needed to tell "
            f"{_liars(now.max_attacked)}."
        )
        return Cause.TOO_FEW_METERS, reason
    if not now.busbar:
        reason = (
            "The busbar voltage is missing; it is replaced by what most meters imply, which is less exact."
        )
        return Cause.NO_BUSBAR, reason
    if named > now.max_attacked:
        reason = (
            f"{named} meters disagree with the feeder ({_list(now, now.named)}), and at most "
            f"{now.max_attacked} can be told apart. A wrong busbar reading, switch or line in the model "
            "looks the same."
        )
        return Cause.TOO_MANY_SUSPECTS, reason
    return None


def _doubt(now: DecisionInputs) -> tuple[Cause, str] | None:
    """Cause and reason against CLEAN while no meter is named; None if there are none."""
    silent, pending = ~now.live, now.suspected & ~now.named
    if any_of(silent):
        return Cause.SILENT_METERS, f"No reading from {_list(now, silent)}."
    if not now.settled:
        return Cause.SETTLING, "The observers have not settled yet."
    if any_of(pending):
        reason = f"{_list(now, pending)}: further off than allowed lately, but not often enough to be named."
        return Cause.AMBIGUOUS, reason
    if any_of(now.wide):
        return Cause.AMBIGUOUS, f"The loads are not known well enough to judge {_list(now, now.wide)}."
    return None


def _liars(most: int) -> str:
    return (
        "one manipulated meter from the others" if most == 1 else f"{most} manipulated meters from the others"
    )


_SHOWN = 5


def _list(now: DecisionInputs, which: Bools) -> str:
    """Names of the meters, at most `_SHOWN` of them."""
    if not any_of(which):
        return ""
    names = [now.names[j] for j in np.flatnonzero(which).tolist()]
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest


def residual_excess(score: Floats, threshold: Floats, live: Bools) -> Floats:
    """Relative excess of residuals over their thresholds; 0 below them.

    score, threshold (p,): residuals and thresholds, squared pu.
    """
    ratio = np.divide(score, threshold, out=np.zeros_like(threshold), where=live & (threshold > 0))
    return np.asarray(np.maximum(ratio - 1.0, 0.0))
