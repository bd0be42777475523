"""Progress of the commissioning of each meter: state, reason, expected time.

A tick counts for a meter if the meter has a reading, is trusted, and if the voltage there is known about as
well as the design supposes. Every other tick is lost for one reason, `LearningReason`. With T the time of
commissioning and h the interval of the frames, learning without lost ticks takes

    expected = (1 + ceil(T / h)) h,

since the first frame has no interval before it. A meter that is not learned after twice that time is stalled.

References
----------
docs/theory-sequential.md, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.sequential.commission import COUNTED, REASONS, Commission, Learning, LearningReason
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.doubts import FrameUncertainty
from gridsec.estimators.sequential.loads import EXACT, UNMETERED
from gridsec.grid.network import Power
from gridsec.interface import Frame, PowerOrigin

_WIDEST = 2.0
"""Largest standard deviation of a voltage at a tick that counts, in those of the design."""
_PATIENCE = 2.0
"""Multiple of the expected time after which a meter is stalled."""
_TIME_TOLERANCE = 1e-9
"""Part of an interval by which a quotient of times may exceed a whole number from rounding alone."""


class LearningState(StrEnum):
    """State of a meter's learning: no tick counted, some did, known, late beyond twice the expected time."""

    WAITING = "waiting"
    LEARNING = "learning"
    LEARNED = "learned"
    STALLED = "stalled"


@dataclass(frozen=True, slots=True, eq=False)
class LearningProgress:
    """Progress of all meters. p meters."""

    state: tuple[LearningState, ...]  # (p,) state of each
    reason: tuple[LearningReason | None, ...]  # (p,) reason of most lost time; None if on schedule
    expected_s: float  # time that learning takes if every tick counts, s


def expected_s(design: SequentialDesign) -> float:
    """Time that learning takes if every tick counts, s."""
    ticks = int(np.ceil(design.options.commission_s / design.step_s - _TIME_TOLERANCE))
    return (1 + ticks) * design.step_s


def progress(design: SequentialDesign, commission: Commission) -> LearningProgress:
    """State and reason of each meter."""
    expected, learning = expected_s(design), commission.learning
    p = commission.learned.at.size
    if learning is None:
        return LearningProgress((LearningState.LEARNED,) * p, (None,) * p, expected)
    late = learning.watched_s >= _PATIENCE * expected
    worst = learning.lost_s.argmax(axis=0)
    lags = _late(design, learning)
    state, reason = [], list[LearningReason | None]()
    for k, open_ in enumerate(learning.open):
        if not open_:
            state.append(LearningState.LEARNED)
        elif late[k]:
            state.append(LearningState.STALLED)
        else:
            state.append(LearningState.LEARNING if learning.time_s[k] > 0 else LearningState.WAITING)
        reason.append(REASONS[worst[k]] if lags[k] else None)
    return LearningProgress(tuple(state), tuple(reason), expected)


def _late(design: SequentialDesign, learning: Learning) -> Bools:
    """Meters that are learned later than expected, (p,): too few ticks counted, or nothing is concluded."""
    few = learning.time_s < design.options.enough * learning.watched_s
    held = learning.time_s >= design.options.commission_s
    return np.asarray(learning.open & (few | held) & (learning.lost_s.max(axis=0) > 0))


@dataclass(frozen=True, slots=True, eq=False)
class LearningTick:
    """One frame for learning. p meters."""

    frame: Frame  # the frame
    available: Bools  # (p,) meters with a reading
    trusted: Bools  # (p,) meters trusted after it
    accused: bool  # a customer's power or an inverter is suspect
    uncertainty: FrameUncertainty  # uncertainty of its powers


def usable(design: SequentialDesign, before: Learning, tick: LearningTick) -> tuple[Bools, Ints]:
    """Meters to gather from, (p,), and the index of `REASONS`, or `COUNTED`, of each, (p,).

    A meter that has time enough and is not learned waits for others.
    """
    use = tick.available & tick.trusted
    why = np.full(use.size, COUNTED, dtype=np.intp)
    if not tick.accused and tick.uncertainty.priors[0] is not design.prior:
        known = _well_known(design, tick.uncertainty)
        if any_of(use & ~known):
            why = np.where(known, COUNTED, _main_uncertainty(design, tick))
        use &= known
    ripe = before.time_s >= design.options.commission_s
    for which, reason in (
        (ripe & use, LearningReason.OTHERS_SUSPECTED),
        (np.full(use.size, tick.accused), LearningReason.OTHERS_SUSPECTED),
        (~tick.trusted, LearningReason.SUSPECTED),
        (~tick.available, LearningReason.SILENT),
    ):
        why = np.where(which, REASONS.index(reason), why)
    return use & (not tick.accused), why


def _well_known(design: SequentialDesign, uncertainty: FrameUncertainty) -> Bools:
    """Meters at which the voltage is known about as well as the design supposes, (p,)."""
    variance, at = uncertainty.priors[0].variance, design.prior.meters
    return np.asarray(variance[at] <= _WIDEST**2 * design.prior.variance[at])


def _main_uncertainty(design: SequentialDesign, tick: LearningTick) -> Ints:
    """Reason that adds most to the variance of the voltage at each meter, (p,), as index of `REASONS`."""
    uncertainty, doubt, at = tick.uncertainty, design.doubt, design.prior.meters
    added: dict[LearningReason, Floats] = {}
    if not all_of(uncertainty.busbar[0]):
        no_voltage = design.busbar_incidence @ np.where(
            uncertainty.busbar[0], 0.0, UNMETERED**2 - design.busbar**2
        )
        added[LearningReason.NO_BUSBAR] = np.asarray(no_voltage)
    origin = tick.frame.p_origin
    unread = np.zeros(doubt.p.size, dtype=np.bool_) if origin is None else origin == PowerOrigin.UNREAD
    beyond = np.zeros(doubt.p.size, dtype=np.bool_) if origin is None else origin == PowerOrigin.BEYOND
    for power, std, factor, reason in (
        (Power.ACTIVE, doubt.p, uncertainty.p[0], LearningReason.ACTIVE_UNCERTAINTY),
        (Power.REACTIVE, doubt.q, uncertainty.q[0], LearningReason.REACTIVE_UNCERTAINTY),
    ):
        more = np.where(factor > 1.0, (np.maximum(std, EXACT) * factor) ** 2 - std**2, 0.0)
        for which, cause in (
            (unread, LearningReason.UNREAD_POWERS),
            (beyond, LearningReason.LOAD_BEYOND_DECLARED),
            (~(unread | beyond), reason),
        ):
            part = np.where(which, more, 0.0)
            if any_of(part > 0.0):
                found = design.plant.feeder.variances(power, part)[at]
                added[cause] = added.get(cause, np.zeros(at.size)) + found
    rows = np.array([REASONS.index(cause) for cause in added], dtype=np.intp)
    return np.asarray(rows[np.argmax(np.stack(list(added.values())), axis=0)])
