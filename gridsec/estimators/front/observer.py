"""Observer of the droop inverters, and prediction of a frame by the model.

The observer is driven by trusted meters or by the model,

    tau x' = -x + K(zeta),   zeta = vbar^2 - y at trusted meters,   H x + w elsewhere.

One certificate covers every trusted set and every switching (docs/theory-certificates.md). With all meters
trusted a step is exact and costs O(m). The prediction of a frame is the loss-corrected model at the observed
injections.

The error e of every observed injection is bounded by a first-order lag of its input error,

    tau_i |e_i|' <= -|e_i| + min(span_i, d_i (input error + hold) + mismatch),

with `hold` the change of the inverter's voltage between frames; saturation keeps it finite. The input is a
reading of a trusted meter or the model. Assumptions: inverters follow their curves, and a voltage stays
between its values at two successive frames (docs/theory-detection.md for the lag and for `mismatch`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices, submatrix
from gridsec.errors import DesignInfeasible
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.measurements import Measurements, PowerErrors
from gridsec.estimators.front.state import (
    FrontState,
    InjectionError,
    ModelDriven,
    Prediction,
    unknown_injections,
)
from gridsec.estimators.plant import NO_VOLTAGE, busbar_errors
from gridsec.grid.network import Power
from gridsec.interface import Frame
from gridsec.observers.lure import POLICY, Lure, transition
from gridsec.observers.lure import advance as advance_loop
from gridsec.observers.lure import step as step_loop

_PATIENT = replace(POLICY, settled=0.0)


_LATE = 1.5
"""Ticks after the last frame from which on the voltages may have moved unseen."""

_RESPONSES = 16
"""Iterations for the inverters' response in a pause; each divides the excess by the loop gain.

With 4 the rest was larger than the response of a calm pause, and left the verdict open.
"""


def predict(design: FrontDesign, state: FrontState, measured: Measurements, sizes: Floats) -> Prediction:
    """Prediction of a frame, with the sizes (N,) of false powers, pu."""
    x, model_driven, error = _inverters(design, state, measured, sizes)
    powers = _powers(design, state, measured, x, sizes)
    transient = state.transient if state.x is None else _transient(design, state, error.input, measured.frame)
    return Prediction(x, model_driven, error, powers, _voltages(design, powers), transient)


def _transient(design: FrontDesign, state: FrontState, given: Floats, frame: Frame) -> Floats:
    """Remainder of unknown injections in the squared voltages of the meters, (p,).

        u' = -rate u + |2 X| |K(z) - K(z_end)| / tau

    The second term counts in a pause of the frames only. The observer is driven by the voltages at its end,
    `given` (m,), squared pu.
    """
    rate, h, droop = design.certificate.rate, frame.t - state.t, design.plant.droop
    decay = math.exp(-rate * h)
    left = state.transient * decay
    if h <= _LATE * design.step_s or not droop.tau.size:
        return left
    change = _unseen(design, state, given)
    unknown = np.minimum((1.0 - decay) / (rate * droop.tau) * change, 2.0 * droop.limit)
    effect = np.abs(design.sensitivities.columns(Power.REACTIVE, droop.customer)[design.prior.meters])
    return np.asarray(np.minimum(left + effect @ unknown, design.inverter_reach))


def _unseen(design: FrontDesign, state: FrontState, given: Floats) -> Floats:
    """Range of the set-points in a pause, (m,), pu: ``K(z_high) - K(z_low)``.

    Assumption: loads and busbar keep the voltages between those before and after the pause, `given` (m,),
    squared pu. The inverters' own response adds ``|H| (range of x)``. The map is monotone: from above, its
    images stay above that range.
    """
    droop, x = design.plant.droop, state.x
    assert x is not None  # noqa: S101  # before the first frame there is no pause
    ends = droop.vbar**2 - np.stack([given, state.injection_error.input])
    z, moved, response = (ends.min(axis=0), ends.max(axis=0)), droop.span, np.abs(design.loop)
    low = high = x
    for _ in range(_RESPONSES):
        more = response @ moved
        low, high = droop(z[0] - more), droop(z[1] + more)
        moved = np.maximum(high, x) - np.minimum(low, x)
    return np.asarray(high - low)


def _powers(
    design: FrontDesign, state: FrontState, measured: Measurements, x: Floats, sizes: Floats
) -> PowerErrors:
    """Powers of a frame with net reactive injections, observed for inverters without metered power."""
    observed = design.plant.droop.per_customer(x, measured.q.size)
    q = measured.q + (np.where(measured.uses_q, 0.0, observed) if any_of(measured.uses_q) else observed)
    return PowerErrors(measured.frame, q, measured.uses_q, measured.v0_squared, state.trust.trusted, sizes)


def _voltages(design: FrontDesign, powers: PowerErrors) -> Floats:
    """Squared voltages by the loss-corrected model, (n,)."""
    plant, v0 = design.plant, powers.v0_squared
    with np.errstate(all="ignore"):
        v2_bus = plant.feeder.bus_voltages(powers.frame.p, powers.q, v0, steps=plant.loss_correction)
        v2_bus = np.minimum(np.maximum(v2_bus, 0.0), NO_VOLTAGE)
    none = np.isnan(v2_bus)
    return np.where(none, plant.feeder.broadcast_busbar(v0), v2_bus) if any_of(none) else v2_bus


def _inverters(
    design: FrontDesign, state: FrontState, measured: Measurements, sizes: Floats
) -> tuple[Floats, ModelDriven | None, InjectionError]:
    """Injections at this frame, the prepared loop, and errors; at rest at the first frame."""
    droop, meter, feeder, frame = design.plant.droop, design.meter_of, design.plant.feeder, measured.frame
    driven = design.inverters_of(state.trust.trusted & measured.available)
    y = measured.y[meter] if meter.size else np.zeros(0)
    if not all_of(driven):
        y = np.where(driven, y, feeder.broadcast_busbar(measured.v0_squared)[feeder.bus[droop.customer]])
    if state.x is None:
        return np.asarray(droop(droop.vbar**2 - y)), None, unknown_injections(design.plant, y)
    w, follows, h = None, None, frame.t - state.t
    if not all_of(driven):
        injected = droop.per_customer(state.x, frame.q.size)
        now, v2 = _linear(design, frame.p, np.stack([frame.q + injected, frame.q]), measured.v0_squared)
        if state.last is not None and state.frame is not None:
            before = state.frame
            # Losses and the correction by the meters hardly change between two frames.
            v2 += state.last[0].v2 - _linear(design, before.p, before.q + injected, state.v0_squared)
        w, y = droop.vbar**2 - v2, np.where(driven, y, now[droop.customer])
        follows = ~driven, _powers(design, state, measured, state.x, sizes), measured.busbar_metered
    error = update_injection_error(design, state.injection_error, y, follows, h)
    return *advance_inverters(design, state.x, y, driven, w, h, state.model_driven), error


def _linear(design: FrontDesign, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
    """Squared voltages of the customers by the linear model, (…, N) as q."""
    feeder = design.plant.feeder
    return np.asarray(feeder.bus_voltages(p, q, v0_squared, steps=0)[..., feeder.bus])


def advance_inverters(  # noqa: PLR0917
    design: FrontDesign,
    x: Floats,
    y: Floats,
    driven: Bools,
    w: Floats | None,
    h: float,
    before: ModelDriven | None = None,
) -> tuple[Floats, ModelDriven | None]:
    """Injections a time h later, and the prepared loop; chong2020 (5) with K = E_J, L = 0.

    x, y, driven: (m,) injections, squared voltages of the inverters' meters, and use of these. w: (N,) input
    of the model-driven inverters; None if all are driven.
    """
    droop = design.plant.droop
    decay = np.exp(-h / droop.tau)
    target = droop(droop.vbar**2 - y)
    if w is None or all_of(driven):
        return np.asarray(target + decay * (x - target)), before
    out = np.where(driven, target + decay * (x - target), x)
    free = _prepared(design, indices(~driven), h, before)
    # Driven inverters enter by the mean of x and out.
    held = np.where(driven, 0.5 * (x + out), 0.0)
    at = w[droop.customer[free.rows]] + design.loop[free.rows] @ held
    try:
        out[free.rows] = step_loop(free.transition, free.loop, x[free.rows], at)
    except DesignInfeasible:
        out[free.rows] = advance_loop(free.loop, x[free.rows], at, h, _PATIENT)
    return out, free


def _prepared(design: FrontDesign, rows: Ints, h: float, before: ModelDriven | None) -> ModelDriven:
    if before is None or not np.array_equal(before.rows, rows):
        loop = _loop(design, rows)
        return ModelDriven(rows, loop, transition(loop, h))
    return before if before.transition.h == h else replace(before, transition=transition(before.loop, h))


def _loop(design: FrontDesign, rows: Ints) -> Lure:
    droop = design.plant.droop
    H = submatrix(design.loop, rows, rows)
    rate, size = 1.0 / droop.tau[rows], rows.size
    return Lure(
        A=-np.diag(rate),
        G=np.diag(rate),
        H=H,
        F=np.eye(size),
        B=np.zeros((size, size)),
        C=H,
        D=np.eye(size),
        slope=droop.slope[rows],
        phi=droop.take(rows),
    )


# --- Errors of the injections ---


_ITERATIONS = 2
"""Iterations of the monotone map of the model-driven inverters, from above."""


def update_injection_error(
    design: FrontDesign,
    before: InjectionError,
    given: Floats,
    free: tuple[Bools, PowerErrors, Bools | bool] | None,
    h: float,
) -> InjectionError:
    """Errors a time h later.

    given: (m,) squared voltage at each input, pu. free: inverters that follow the model, (m,), power errors,
    and metered busbar phases; None where all follow their meters.
    """
    plant, droop, span = design.plant, design.plant.droop, before.span
    width = design.reading_errors.of(given)
    target = injection_target(design, before, given, width)
    if free is not None:
        (which, powers, metered), size = free, plant.feeder.bus.size
        # The map is monotone: from above its images stay above the error.
        top = np.where(which, span, np.maximum(before.error, target))
        lost, _ = powers.loss_error(plant, droop.per_customer(top, size))
        meter = np.minimum(busbar_errors(plant, powers.v0_squared, design.sigmas), NO_VOLTAGE)
        known = np.where(metered, meter, NO_VOLTAGE)
        busbar = plant.feeder.broadcast_busbar(known)[plant.feeder.bus]
        for _ in range(_ITERATIONS):
            model = powers.linear_error(plant, droop.per_customer(top, size)) + lost + busbar
            width = np.where(which, model[droop.customer], width)
            image = injection_target(design, before, given, width)
            target = np.where(which, image, target)
            top = np.where(which, np.maximum(before.error, image), top)
    return relaxed(design, before, given, width, target, h)


def injection_target(design: FrontDesign, before: InjectionError, given: Floats, width: Floats) -> Floats:
    """Largest errors of the set-points between two frames, (m,), pu.

    given, width: (m,) squared voltage at each input and its largest error, squared pu.
    """
    wider, hold = np.maximum(width, before.width), np.abs(given - before.input)
    return np.asarray(np.minimum(before.span, design.plant.droop.slope * (wider + hold) + design.mismatch))


def relaxed(  # noqa: PLR0917
    design: FrontDesign,
    before: InjectionError,
    given: Floats,
    width: Floats,
    target: Floats,
    h: float,
) -> InjectionError:
    """Errors a time h later with those of the set-points, `target` (m,), pu, in between."""
    error = target + np.exp(-h / design.plant.droop.tau) * (before.error - target)
    return InjectionError(error, given, width, before.span)
