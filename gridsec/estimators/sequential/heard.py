"""One frame, cleaned: what is believed of it before anybody judges it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from gridsec.arrays import Bools, Floats, all_of, any_of
from gridsec.estimators.inputs import NO_VOLTAGE
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.skew import unusable
from gridsec.estimators.sequential.state import SequentialState
from gridsec.interface import Frame


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """One frame, cleaned. N customers, p meters, b phases, one on a balanced feeder.

    Attributes
    ----------
    live : (p,)
        Which meters have a reading.
    y : (p,)
        Squared voltages, 0 where there is none, pu.
    q : (N,)
        Reactive injections of the loads, or metered net ones where told, pu.
    told : (N,)
        Whose metered net reactive power is used.
    reported : (N,)
        Who tells one.
    v0_squared, busbar
        Squared busbar voltage, the last one that was where there is none now, and whether it is metered and
        believed; in three phases (3,) each.
    said, says : (b,)
        What the busbar's meter reports, and where it does, believed or not.
    """

    live: Bools
    y: Floats
    q: Floats
    told: Bools
    reported: Bools
    v0_squared: Floats | float
    busbar: Bools | bool
    said: Floats
    says: Bools


def possible(design: SequentialDesign, frame: Frame) -> Frame:
    """The frame with powers that can be, and without readings of a moment that no scale covers.

    Parameters
    ----------
    design, frame
        The design, and everything known at one tick.
    """
    far = unusable(design, frame.clock_offset)
    frame = frame if far is None else replace(frame, seen=frame.seen & ~far)
    p, p_error = _possible(frame.p, frame.p_error, design.most_p)
    q, q_error = _possible(frame.q, frame.q_error, design.most_q)
    if p is frame.p and q is frame.q and p_error is frame.p_error and q_error is frame.q_error:
        return frame
    p_std, q_std = _sure(frame.p_std, p == frame.p), _sure(frame.q_std, q == frame.q)
    return replace(frame, p=p, p_error=p_error, q=q, q_error=q_error, p_std=p_std, q_std=q_std)


def _sure(std: Floats | None, same: Bools) -> Floats | None:
    """Standard deviations, but of powers that cannot be."""
    return None if std is None else np.where(same, std, np.nan)


def _possible(power: Floats, error: Floats, most: Floats) -> tuple[Floats, Floats]:
    good = np.abs(power) <= most
    known = good & (error >= 0.0) & (error <= most)
    if all_of(known):
        return power, error
    return np.where(good, power, 0.0), np.where(known, error, most)


def clean(design: SequentialDesign, state: SequentialState, frame: Frame) -> Heard:
    """Clean one frame.

    Parameters
    ----------
    design, state
        The design, and the state before.
    frame
        From `possible`.
    """
    plant = design.plant
    live, y = frame.seen & np.isfinite(frame.y), frame.y
    if all_of(live):
        live = _everybody(live.size)
    else:
        y = np.where(live, y, 0.0)
    told, q = np.zeros(frame.q.size, dtype=np.bool_), frame.q
    # As `possible` has it: who is sure of nothing tells nothing.
    within = (frame.q_net_error >= 0.0) & (frame.q_net_error <= design.most_q)
    reported = (np.abs(frame.q_net) <= design.most_q) & within
    if any_of(reported):
        trusted = np.zeros(frame.q.size, dtype=np.bool_)
        trusted[plant.meters] = live & state.trust.trusted
        least, most = plant.droop.saturated(frame.q.size)
        rest, room = (
            np.where(reported, frame.q_net, 0.0) - frame.q,
            frame.q_error + np.where(reported, frame.q_net_error, 0.0),
        )
        told = trusted & reported & (least - room <= rest) & (rest <= most + room)
        q = np.where(told, frame.q_net, frame.q)
    return Heard(
        live,
        np.minimum(np.maximum(y, 0.0), NO_VOLTAGE),
        q,
        told,
        reported,
        *_busbar(design, state, frame),
    )


@cache
def _everybody(meters: int) -> Bools:
    """The same array whenever all report: who compares it with an earlier one need not look inside."""
    out = np.ones(meters, dtype=np.bool_)
    out.flags.writeable = False
    return out


def _busbar(
    design: SequentialDesign, state: SequentialState, frame: Frame
) -> tuple[Floats | float, Bools | bool, Floats, Bools]:
    """The last four of `Heard`."""
    low, high = design.options.v2_limits
    believed = state.busbar.believed
    if design.plant.feeder.busbar_phases == 1:
        v0 = frame.v0_squared
        there = bool(low <= v0 <= high)  # False for NaN
        metered = there and bool(believed[0])
        return v0 if metered else state.v0_squared, metered, np.array([v0]), np.array([there])
    # One voltage for all phases says where they are, but not how far from it each.
    given = np.broadcast_to(frame.v0_squared if frame.v0_phases is None else frame.v0_phases, 3)
    within = (low <= given) & (given <= high)
    says = within & (frame.v0_phases is not None)
    v0_squared = np.where(within & believed, given, state.v0_squared)
    return v0_squared, says & believed, given, says
