"""Scalar observers of single meters, and one frame as a code word.

Part of `gridsec.families.partial`, which explains both.

References
----------
lee2018, sections 4.2.1 and 4.3.1, for droop inverters: docs/theory-partial-observers.md, section 8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec import detect
from gridsec.arrays import Bools, Floats, Ints
from gridsec.decode.noise import CorrectionConstants, correction_constants
from gridsec.decode.stacks import Stack
from gridsec.detect import ErrorBound, Motion, Uncertainty
from gridsec.frames import NO_VOLTAGE, Inputs, Reconstruction, busbar_errors, injections, reconstruct
from gridsec.lure import POLICY, rest
from gridsec.network import busbar_places, by_place, hangs_on
from gridsec.observers import circle
from gridsec.observers.circle import CircleDesign
from gridsec.online import Frame
from gridsec.plant import Setting

_LONG_S = 3600.0
# Smallest bound of a row, pu: below rounding, for meters without any error.
_SMALLEST = 1e-9
# Largest uncertainty of an unknown, and largest deviation of a value, pu: more than any feeder has, and small
# enough for finite squares and sums.
_LARGEST, _FARTHEST = 1e4, 1e8


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """State of the observers. m inverters.

    Attributes
    ----------
    x, z : (m,)
        Injections of the observer without meters, and z at its inverters, pu.
    driven : (m,)
        Injections of the scalar observers; those of `x` without a driving meter.
    bound
        `free` bounds the error of x, `driven` that of the scalar observers of unmanipulated meters.
    level
        Upper level of the bounds during the last step.
    """

    x: Floats
    z: Floats
    driven: Floats
    bound: ErrorBound
    level: ErrorBound


@dataclass(frozen=True, slots=True, eq=False)
class CodeWord:
    """One frame as a code word in units of its bounds. A rows, n unknowns.

    Attributes
    ----------
    B, s, block : (A, n), (A,), (A,)
        Rows, their values, and the meter of each.
    unit : (A,)
        Unit of each row, squared pu or pu.
    scale : (n,)
        Unit of each unknown, pu: x, p, q, squared busbar voltage.
    reading : (A,)
        True for rows that are readings.
    voltage : (N, n)
        Sensitivity of the customers' squared voltages to one unit of each unknown, pu.
    rest : (N,)
        Their remaining error, pu.
    """

    B: Floats
    s: Floats
    block: Ints
    unit: Floats
    scale: Floats
    reading: Bools
    voltage: Floats
    rest: Floats


def start(setting: Setting) -> Parts:
    """State before the first frame: only the saturation of the inverters is known."""
    zero, widest = np.zeros(setting.plant.droop.tau.size), detect.widest(setting.errors)
    return Parts(zero, zero, zero, widest, widest)


def observe(  # noqa: PLR0917  # the observers, their state, and the inputs
    setting: Setting, model: CircleDesign, before: Parts, frame: Frame, inputs: Inputs, h: float
) -> tuple[Uncertainty, Reconstruction, Parts, bool]:
    """Advance all observers and their bounds to a frame.

    Parameters
    ----------
    model
        The observer without meters.
    frame, inputs
        The frame, received and prepared.
    h
        Time since the last frame, s; 0 for the first one.

    Returns
    -------
    Uncertainty, Reconstruction, Parts, bool
        Uncertainty without any meter, voltages by the observer without meters, new state of the observers,
        and True once their initial transient is negligible.
    """
    plant, errors = setting.plant, setting.errors
    own, nobody = plant.droop.customer, np.zeros_like(inputs.live)
    # The first state is the equilibrium of the first frame.
    x = circle.step(
        model, circle.CircleState(0.0, before.x), inputs.z, inputs.w, nobody, h if h > 0 else _LONG_S
    ).x
    seen = reconstruct(setting, frame, inputs, injections(plant, frame, x, nobody))
    moved = np.abs(seen.correction - inputs.correction)[plant.feeder.bus]
    base = np.minimum(inputs.now.base + moved, NO_VOLTAGE)
    alone = replace(inputs.now, base=base, live=nobody, told=nobody)
    z = plant.droop.vbar**2 - seen.v2[own]
    fast = plant.droop.tau * rest(h, POLICY) < 1.0
    # If all are that fast, the step ends in the equilibrium.
    lag = np.where(fast & ~fast.all(), np.abs(x - before.x), 0.0)
    motion = Motion(before.z if h > 0 else z, z, np.zeros(x.shape), h, lag)
    bound, level = detect.advance(errors, alone, motion, before.bound, before.level)
    heard = np.zeros(x.shape, dtype=np.bool_)
    driven = x
    if inputs.live.size:
        heard = (errors.meter_of >= 0) & inputs.live[errors.meter_of]
        keep = np.exp(-h / plant.droop.tau)
        was = before.driven if h > 0 else x
        aim = plant.droop(inputs.z[errors.meter_of])
        # Without a reading a scalar observer equals the one without meters, and so does its error.
        driven = np.where(heard, keep * was + (1.0 - keep) * aim, x)
    bound = ErrorBound(np.where(heard, bound.driven, bound.free), bound.free)
    return alone, seen, Parts(x, z, driven, bound, level), _settled(setting, alone, motion, bound)


def _settled(setting: Setting, alone: Uncertainty, motion: Motion, bound: ErrorBound) -> bool:
    errors = setting.errors
    none = np.zeros(bound.free.shape)
    top = detect.ceiling(errors, alone, motion, ErrorBound(none, none))
    at_rest = detect.settled(errors, alone, motion, top)
    excess = errors.inverters[errors.meters] @ np.maximum(bound.free - at_rest.free, 0.0)
    allowed = alone.reading + alone.base[errors.meters]
    return bool(np.all(excess <= setting.options.settled * allowed))


def code_word(  # noqa: PLR0917  # as _conclude
    setting: Setting,
    parts: Parts,
    frame: Frame,
    inputs: Inputs,
    alone: Uncertainty,
    model: Reconstruction,
) -> CodeWord:
    """Rows of all meters, each in units of its own bound.

    Parameters
    ----------
    setting, parts, frame, inputs
        The feeder, its observers after this frame, and the frame, received and prepared.
    alone
        Uncertainty without any meter.
    model
        Voltages by the observer without meters.
    """
    plant, errors, lines = setting.plant, setting.errors, setting.model
    own, n, m = plant.droop.customer, frame.p.size, parts.x.size
    shared, rest_ = _split(setting, frame, inputs, alone)
    scale = np.concatenate([parts.bound.free, frame.p_error, frame.q_error, shared])
    scale = np.minimum(scale, _LARGEST)
    voltage = np.hstack([2.0 * lines.X[:, own], 2.0 * lines.R, 2.0 * lines.X, hangs_on(plant.feeder)])
    at = np.flatnonzero(inputs.live)
    where = plant.meters[at]
    driven = inputs.live[errors.meter_of] if at.size else np.zeros(m, dtype=np.bool_)
    inverters = np.flatnonzero(driven & (errors.meter_of >= 0))
    # A net power with an inverter behind it is not determined by its meter alone.
    net = np.flatnonzero(_told(setting, frame, inputs) & ~np.isin(plant.meters, own))
    of_x, of_q = np.eye(m, scale.size), np.eye(n, scale.size, k=m + n)
    rows = np.vstack([voltage[where], of_x[inverters], of_q[plant.meters[net]]])
    value = np.concatenate(
        [
            inputs.y[at] - model.v2[where],
            (parts.driven - parts.x)[inverters],
            (frame.q_net - frame.q)[plant.meters[net]],
        ]
    )
    unit = np.concatenate(
        [
            alone.reading[at] + rest_[where],
            parts.bound.driven[inverters],
            frame.q_net_error[plant.meters[net]],
        ]
    )
    unit, value = np.clip(unit, _SMALLEST, _FARTHEST), np.clip(value, -_FARTHEST, _FARTHEST)
    block = np.concatenate([at, errors.meter_of[inverters], net]).astype(np.intp)
    reading = np.arange(block.size) < at.size
    B = rows * scale / unit[:, None]
    return CodeWord(B, value / unit, block, unit, scale, reading, voltage * scale, rest_)


def _told(setting: Setting, frame: Frame, inputs: Inputs) -> Bools:
    """Mask (p,) of meters that report net reactive power with a known error."""
    return np.asarray(inputs.live & np.isfinite(frame.q_net + frame.q_net_error)[setting.plant.meters])


def disputed(setting: Setting, parts: Parts, frame: Frame, inputs: Inputs) -> Bools:
    """Mask (p,) of meters with a reported reactive power that their inverters cannot have on their curves.

    Either the meter or its inverter is manipulated; these data do not tell which.
    """
    droop, n = setting.plant.droop, frame.q.size
    honest = droop.per_customer(parts.x, n) + frame.q
    most = droop.per_customer(parts.bound.free, n) + frame.q_error + frame.q_net_error + _SMALLEST
    off = np.isin(np.arange(n), droop.customer) & (np.abs(frame.q_net - honest) > most)
    return np.asarray(_told(setting, frame, inputs) & off[setting.plant.meters])


def _split(setting: Setting, frame: Frame, inputs: Inputs, alone: Uncertainty) -> tuple[Floats, Floats]:
    """Error of the busbar voltage, common to all (of a phase), and the error not explained by loads, (N,)."""
    errors, feeder = setting.errors, setting.plant.feeder
    p_error, q_error = np.minimum(frame.p_error, _LARGEST), np.minimum(frame.q_error, _LARGEST)
    rest_ = np.maximum(alone.base - errors.R2 @ p_error - errors.X2 @ q_error, 0.0)
    rest_ = np.where(alone.base >= NO_VOLTAGE, NO_VOLTAGE, rest_)
    if not inputs.busbar:
        # The implied busbar voltage has no separate error: count the rest in both.
        return np.full(busbar_places(feeder).stop, rest_.max(initial=0.0)), rest_
    shared = np.atleast_1d(busbar_errors(setting.plant, inputs.v0_squared, setting.options.sigmas))
    own = by_place(feeder, shared)[feeder.bus]
    return np.minimum(shared, NO_VOLTAGE), np.where(rest_ < NO_VOLTAGE, np.maximum(rest_ - own, 0.0), rest_)


def constants(word: CodeWord, meters: int, max_attacked: int, *, tol: float) -> CorrectionConstants:
    """Theta and kappa_c of lee2018 for a frame: block j is the rows of meter j with the model.

    Parameters
    ----------
    tol
        As in `gridsec.decode.noise.correction_constants`.

    Returns
    -------
    CorrectionConstants
        In units of the code word: v_max is the root of the number of unknowns and of rows of a meter.

    References
    ----------
    lee2018, Theorem 2.2.11, with the fading part of section 4.2.1 in every block.
    """
    alone = np.eye(word.scale.size)
    blocks = [np.vstack([alone, word.B[word.block == j]]) for j in range(meters)]
    return correction_constants(Stack.of(blocks), max_attacked, tol=tol)
