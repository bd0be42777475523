"""Measurements of one frame after plausibility checks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from gridsec.arrays import Bools, Floats, all_of, any_of
from gridsec.estimators.inputs import NO_VOLTAGE
from gridsec.estimators.sequential.clock_offsets import unusable_offsets
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.state import SequentialState
from gridsec.interface import Frame


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """Plausible measurements of one frame. N customers, p meters, b busbar phases (1 if balanced)."""

    frame: Frame  # with possible powers
    available: Bools  # (p,) meters with a reading
    y: Floats  # (p,) squared voltages, pu, 0 without a reading
    q: Floats  # (N,) reactive injections of the loads; net ones where `uses_q`, pu
    uses_q: Bools  # (N,) metered net reactive power is used
    reports_q: Bools  # (N,) net reactive power is reported
    v0_squared: Floats | float  # squared busbar voltage, the last trusted one if need be, pu
    busbar_metered: Bools | bool  # busbar voltage is metered and trusted; (3,) in three phases
    busbar_reading: Floats  # (b,) reading of the busbar's meter
    busbar_available: Bools  # (b,) the busbar's meter has a plausible reading


def plausible(design: SequentialDesign, frame: Frame) -> Frame:
    """Frame with physically possible powers, and without readings at clock offsets that no scale covers."""
    far = unusable_offsets(design, frame.clock_offset)
    frame = frame if far is None else replace(frame, seen=frame.seen & ~far)
    p, p_error = _plausible(frame.p, frame.p_error, design.max_p)
    q, q_error = _plausible(frame.q, frame.q_error, design.max_q)
    if p is frame.p and q is frame.q and p_error is frame.p_error and q_error is frame.q_error:
        return frame
    p_std, q_std = _unchanged(frame.p_std, p == frame.p), _unchanged(frame.q_std, q == frame.q)
    return replace(frame, p=p, p_error=p_error, q=q, q_error=q_error, p_std=p_std, q_std=q_std)


def _unchanged(std: Floats | None, same: Bools) -> Floats | None:
    """Standard deviations of unchanged powers; NaN for replaced ones."""
    return None if std is None else np.where(same, std, np.nan)


def _plausible(power: Floats, error: Floats, most: Floats) -> tuple[Floats, Floats]:
    good = np.abs(power) <= most
    known = good & (error >= 0.0) & (error <= most)
    if all_of(known):
        return power, error
    return np.where(good, power, 0.0), np.where(known, error, most)


def measurements(design: SequentialDesign, state: SequentialState, frame: Frame) -> Measurements:
    """Measurements of a frame from `plausible`."""
    plant = design.plant
    available, y = frame.seen & np.isfinite(frame.y), frame.y
    if all_of(available):
        available = _all_available(available.size)
    else:
        y = np.where(available, y, 0.0)
    uses_q, q = np.zeros(frame.q.size, dtype=np.bool_), frame.q
    # An error beyond every possible power makes the report worthless.
    within = (frame.q_net_error >= 0.0) & (frame.q_net_error <= design.max_q)
    reports_q = (np.abs(frame.q_net) <= design.max_q) & within
    if any_of(reports_q):
        trusted = np.zeros(frame.q.size, dtype=np.bool_)
        trusted[plant.meters] = available & state.trust.trusted
        least, most = plant.droop.saturated(frame.q.size)
        rest, room = (
            np.where(reports_q, frame.q_net, 0.0) - frame.q,
            frame.q_error + np.where(reports_q, frame.q_net_error, 0.0),
        )
        uses_q = trusted & reports_q & (least - room <= rest) & (rest <= most + room)
        q = np.where(uses_q, frame.q_net, frame.q)
    return Measurements(
        frame,
        available,
        np.minimum(np.maximum(y, 0.0), NO_VOLTAGE),
        q,
        uses_q,
        reports_q,
        *_busbar(design, state, frame),
    )


@cache
def _all_available(meters: int) -> Bools:
    """The same array for all ticks with every reading: identity replaces comparison."""
    out = np.ones(meters, dtype=np.bool_)
    out.flags.writeable = False
    return out


def _busbar(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[Floats | float, Bools | bool, Floats, Bools]:
    """Last four fields of `Measurements`."""
    low, high = design.options.v2_limits
    trusted = state.busbar.trusted
    if design.plant.feeder.busbar_phases == 1:
        v0 = frame.v0_squared
        there = bool(low <= v0 <= high)  # False for NaN
        metered = there and bool(trusted[0])
        return v0 if metered else state.v0_squared, metered, np.array([v0]), np.array([there])
    # One voltage for all phases is a start value, not a reading of each.
    given = np.broadcast_to(frame.v0_squared if frame.v0_phases is None else frame.v0_phases, 3)
    within = (low <= given) & (given <= high)
    says = within & (frame.v0_phases is not None)
    v0_squared = np.where(within & trusted, given, state.v0_squared)
    return v0_squared, says & trusted, given, says
