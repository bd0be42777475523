"""What each meter says by itself: scalar observers, and everything of one frame as a code word.

The other half of `gridsec.families.partial`, which explains both.

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
# Bound of a row at least, pu: below rounding, for meters without any error.
_SMALLEST = 1e-9
# What is not known at most, pu, and how far off anything said can be: more than any feeder carries, and few
# enough digits for squares and sums to remain numbers.
_LARGEST, _FARTHEST = 1e4, 1e8


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Where the observers stand. m inverters.

    Attributes
    ----------
    x, z : (m,)
        Injections of the observer that hears no meter, and z at its inverters, pu.
    driven : (m,)
        Injections of the scalar observers; those of `x` where no meter drives.
    bound
        `free` bounds the error of x, `driven` that of the scalar observers of honest meters.
    level
        What the bounds stayed below during the last step.
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
        Rows, their values, and the meter that each belongs to.
    unit : (A,)
        What one unit of each row is, squared pu or pu.
    scale : (n,)
        What one unit of each unknown is, pu: x, p, q, squared busbar voltage.
    reading : (A,)
        Which rows are readings.
    voltage : (N, n)
        What one unit of each unknown does to the customers' squared voltages, pu.
    rest : (N,)
        What these may be off besides, pu.
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
    """Before the first frame: nothing is known but that inverters saturate.

    Parameters
    ----------
    setting
        The feeder.
    """
    zero, widest = np.zeros(setting.plant.droop.tau.size), detect.widest(setting.errors)
    return Parts(zero, zero, zero, widest, widest)


def observe(  # noqa: PLR0917  # the observers, where they were, and what came in
    setting: Setting, model: CircleDesign, before: Parts, frame: Frame, inputs: Inputs, h: float
) -> tuple[Uncertainty, Reconstruction, Parts, bool]:
    """Advance all observers and their bounds to a frame.

    Parameters
    ----------
    setting
        The feeder.
    model
        The observer that hears no meter.
    before
        The observers' state.
    frame, inputs
        The frame, as it came and cleaned.
    h
        Time since the last frame, s; 0: there was none.

    Returns
    -------
    Uncertainty, Reconstruction, Parts, bool
        What is not known without any meter, the voltages that the unheard observer explains, the observers'
        new state, and whether what is left of their unknown initial state no longer counts.
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
    # Where all are that fast, the step ends in the equilibrium.
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
        # Without a reading a scalar observer is the unheard one, and so is its error.
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
    """What the meters say, row by row, each in units of its own bound.

    Parameters
    ----------
    setting, parts, frame, inputs
        The feeder, its observers after this frame, and the frame, as it came and cleaned.
    alone
        What is not known without any meter.
    model
        The voltages that the unheard observer explains.
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
    # What an inverter injects is not its meter's word.
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
    """Whose net reactive power is reported, with a known error; (p,)."""
    return np.asarray(inputs.live & np.isfinite(frame.q_net + frame.q_net_error)[setting.plant.meters])


def disputed(setting: Setting, parts: Parts, frame: Frame, inputs: Inputs) -> Bools:
    """Meters that report a reactive power which their inverters, on their curves, cannot have; (p,).

    Either lies, the meter or its inverter, and nothing here can tell which.

    Parameters
    ----------
    setting, parts, frame, inputs
        As in `code_word`.
    """
    droop, n = setting.plant.droop, frame.q.size
    honest = droop.per_customer(parts.x, n) + frame.q
    most = droop.per_customer(parts.bound.free, n) + frame.q_error + frame.q_net_error + _SMALLEST
    off = np.isin(np.arange(n), droop.customer) & (np.abs(frame.q_net - honest) > most)
    return np.asarray(_told(setting, frame, inputs) & off[setting.plant.meters])


def _split(setting: Setting, frame: Frame, inputs: Inputs, alone: Uncertainty) -> tuple[Floats, Floats]:
    """Error of the busbar voltage, which all (of a phase) share, and what else loads do not explain; (N,)."""
    errors, feeder = setting.errors, setting.plant.feeder
    p_error, q_error = np.minimum(frame.p_error, _LARGEST), np.minimum(frame.q_error, _LARGEST)
    rest_ = np.maximum(alone.base - errors.R2 @ p_error - errors.X2 @ q_error, 0.0)
    rest_ = np.where(alone.base >= NO_VOLTAGE, NO_VOLTAGE, rest_)
    if not inputs.busbar:
        # What the meters imply of it is not told apart from the rest: count it in both.
        return np.full(busbar_places(feeder).stop, rest_.max(initial=0.0)), rest_
    shared = np.atleast_1d(busbar_errors(setting.plant, inputs.v0_squared, setting.options.sigmas))
    own = by_place(feeder, shared)[feeder.bus]
    return np.minimum(shared, NO_VOLTAGE), np.where(rest_ < NO_VOLTAGE, np.maximum(rest_ - own, 0.0), rest_)


def constants(word: CodeWord, meters: int, max_attacked: int, *, tol: float) -> CorrectionConstants:
    """Theta and kappa_c of lee2018 for a frame: block j is what meter j and the model know together.

    Parameters
    ----------
    word
        From `code_word`.
    meters
        p.
    max_attacked
        M.
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
