"""Time of commissioning of the meters, and the record of their fixed errors.

A meter of class 0.5 may be off by a constant 0.5 %, and a manipulation of that size is not evidence. Over a
long time load errors cancel, and the mean residual is the meter's own error. Afterwards a meter is
manipulated when it *changes*, even within its class. The estimator estimates the errors; here are the times
over which it may, and the persistent form.

A tick counts for a meter if the meter has a reading, is trusted, and if the voltage there is known about as
well as the design supposes. Every other tick is lost for one reason, `LearningReason`. With T the time of
commissioning and h the interval of the frames, learning without lost ticks takes

    expected = (1 + ceil(T / h)) h,

since the first frame has no interval before it. A meter that is not learned after twice that time is stalled.

References
----------
docs/theory-front.md, section 5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import lru_cache

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.measurements import FrameUncertainty, frame_variance
from gridsec.estimators.front.posterior import EXACT, UNMETERED
from gridsec.grid.network import Power
from gridsec.interface import Frame, PowerOrigin


class LearningReason(StrEnum):
    """Reason why a tick adds nothing to the learning of a meter; the order is that of `Learning.lost_s`."""

    SILENT = "silent"
    SUSPECTED = "suspected"
    OTHERS_SUSPECTED = "others-suspected"
    NO_BUSBAR = "no-busbar"
    UNREAD_POWERS = "unread-powers"
    LOAD_BEYOND_DECLARED = "load-beyond-declared"
    ACTIVE_UNCERTAINTY = "active-uncertainty"
    REACTIVE_UNCERTAINTY = "reactive-uncertainty"


REASONS = tuple(LearningReason)


COUNTED = -1
"""Value in place of an index of `REASONS` for a tick that counts."""


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """Known fixed errors. p meters."""

    bias: Floats  # (p,) expected fixed error, squared pu
    variance: Floats  # (p,) its variance
    allowed: Floats  # (p,) largest honest change from it, squared pu
    at: Floats  # (p,) Unix time of learning, s; NaN where only the class is known
    hidden: Floats  # (p,) variance of lasting load errors in records of earlier versions, squared pu^2


@dataclass(frozen=True, slots=True, eq=False)
class Learning:
    """Sums and times of a commissioning. p meters, r reasons."""

    total: Floats  # (p,) sum of the residuals while trusted, squared pu
    count: Ints  # (p,) number of these residuals
    time_s: Floats  # (p,) time over which they were gathered, s
    since: Floats  # (p,) start of the meter's learning, Unix s; NaN for witnesses of the loads
    watched_s: Floats  # (p,) time of all ticks since then without pauses of the frames, s
    lost_s: Floats  # (r, p) time of ticks without progress, s, by reason in the order of `REASONS`

    @property
    def open(self) -> Bools:
        """Meters that are being learned, (p,)."""
        return np.isfinite(self.since)


@dataclass(frozen=True, slots=True, eq=False)
class Commission:
    """Results of the commissioning."""

    learned: Learned  # known errors
    learning: Learning | None  # sums so far; None once complete


def class_only(design: FrontDesign) -> Learned:
    """Fixed errors by the accuracy class alone."""
    p = design.allowed.size
    return Learned(np.zeros(p), design.fixed, design.allowed, np.full(p, np.nan), np.zeros(p))


def no_readings(which: Bools, t: float) -> Learning:
    """Empty sums for meters `which` (p,) from Unix time t, s."""
    p = which.size
    return Learning(
        total=np.zeros(p),
        count=np.zeros(p, dtype=np.intp),
        time_s=np.zeros(p),
        since=np.where(which, t, np.nan),
        watched_s=np.zeros(p),
        lost_s=np.zeros((len(REASONS), p)),
    )


def initial(design: FrontDesign, t: float) -> Commission:
    """Commissioning of a new feeder by classes alone; ``commission_s = 0`` learns nothing."""
    learns = design.options.commission_s > 0
    every = np.ones(design.allowed.size, dtype=np.bool_)
    return Commission(class_only(design), no_readings(every, t) if learns else None)


def renew(design: FrontDesign, before: Commission, which: Bools, t: float) -> Commission:
    """Commissioning with meters `which` (p,) to be learned anew; all others stay."""
    if not any_of(which) or not design.options.commission_s > 0:
        return before
    known, blank = before.learned, class_only(design)
    learned = Learned(
        *(np.where(which, getattr(blank, f.name), getattr(known, f.name)) for f in fields(Learned))
    )
    start = no_readings(which, t)
    if before.learning is None:
        return Commission(learned, start)
    so_far = before.learning
    learning = Learning(
        *(np.where(which, getattr(start, f.name), getattr(so_far, f.name)) for f in fields(Learning))
    )
    return Commission(learned, learning)


def gather(before: Learning, residual: Floats, use: Bools, h: float, why: Ints) -> Learning:
    """Sums after one tick of h seconds.

    residual: (p,) readings minus the model and the known errors. use: (p,) meters to gather from. why: (p,)
    index of `REASONS` for a tick without progress, else `COUNTED`.
    """
    lost_s = before.lost_s
    if any_of(why != COUNTED):
        lost_s = lost_s + h * np.equal.outer(np.arange(len(REASONS)), why)
    return Learning(
        total=before.total + np.where(use, residual, 0.0),
        count=before.count + use,
        time_s=before.time_s + h * use,
        since=before.since,
        watched_s=before.watched_s + h,
        lost_s=lost_s,
    )


def ready_meters(design: FrontDesign, gathered: Learning) -> Bools:
    """Meters with enough time, (p,).

    Once one open meter reaches `commission_s`, all with the part `enough` of it are ready: together they
    separate load errors from their own.
    """
    needed = design.options.commission_s
    if not gathered.time_s.max(initial=0.0) >= needed > 0:
        return np.zeros(gathered.since.size, dtype=np.bool_)
    time_s = np.where(gathered.open, gathered.time_s, 0.0)
    if not time_s.max(initial=0.0) >= needed > 0:
        return np.zeros_like(gathered.open)
    return np.asarray(time_s >= design.options.enough * needed)


_KNOWN = tuple(f.name for f in fields(Learned))


_GATHERED = ("total", "count", "time_s", "since")


# Absent in texts of earlier versions.
_WATCHED = "watched_s"


_LOST = tuple(f"lost_s.{reason}" for reason in REASONS)


def to_arrays(commission: Commission) -> dict[str, Floats]:
    """Persistent form of a commissioning: arrays of p numbers by name."""
    learned = commission.learned
    none = np.zeros(learned.at.size, dtype=np.bool_)
    learning = commission.learning or no_readings(none, 0.0)
    known = {name: getattr(learned, name) for name in _KNOWN}
    gathered = {
        name: np.asarray(getattr(learning, name), dtype=np.float64) for name in (*_GATHERED, _WATCHED)
    }
    return known | gathered | dict(zip(_LOST, learning.lost_s, strict=True))


def from_arrays(design: FrontDesign, arrays: Mapping[str, Floats]) -> Commission:
    """Commissioning from the arrays of `to_arrays`.

    Raises
    ------
    ValueError
        If the arrays do not fit the design; the message names every problem.
    """
    problems = _problems(design, arrays)
    raise_if_any(problems)
    learned = Learned(*(arrays[name] for name in _KNOWN))
    if not any_of(np.isfinite(arrays["since"])):
        return Commission(learned, None)
    time_s = arrays["time_s"]
    learning = Learning(
        total=arrays["total"],
        count=arrays["count"].astype(np.intp),
        time_s=time_s,
        since=arrays["since"],
        watched_s=arrays.get(_WATCHED, time_s),
        lost_s=np.stack([arrays.get(name, np.zeros_like(time_s)) for name in _LOST]),
    )
    return Commission(learned, learning)


_STORED_TOLERANCE = 1.0 + 1e-9
"""Tolerance of stored numbers for rounding."""


def _problems(design: FrontDesign, arrays: Mapping[str, Floats]) -> list[Problem]:
    """All problems of the arrays."""
    p, needed, times = design.allowed.size, {*_KNOWN, *_GATHERED}, {_WATCHED, *_LOST}
    problems = [Problem("missing", f"{name} is missing") for name in sorted(needed - arrays.keys())]
    problems += [
        Problem("unknown-name", f"{name} is not known") for name in sorted(arrays.keys() - needed - times)
    ]
    shapes = {name: arrays[name].shape for name in sorted((needed | times) & arrays.keys())}
    problems += [
        Problem("shape", f"{name} has the shape {shape}, not ({p},)")
        for name, shape in shapes.items()
        if shape != (p,)
    ]
    if problems:
        return problems
    widest, at, since = design.allowed * _STORED_TOLERANCE, arrays["at"], arrays["since"]
    count, time_s = arrays["count"], arrays["time_s"]
    idle = np.isnan(since) & (not design.options.commission_s > 0)
    # Comparisons with NaN are false: NaN breaks every rule.
    rules = {
        **{
            Problem("negative", f"{name} is not a time"): np.isfinite(arrays[name]) & (arrays[name] >= 0)
            for name in sorted(times & arrays.keys())
        },
        Problem("out-of-range", "bias is beyond the class"): np.abs(arrays["bias"]) <= widest,
        Problem("out-of-range", "variance is not within that of the class"): (arrays["variance"] >= 0)
        & (arrays["variance"] <= design.fixed * _STORED_TOLERANCE),
        Problem("out-of-range", "allowed is not within the class"): (arrays["allowed"] >= 0)
        & (arrays["allowed"] <= widest),
        Problem("negative", "hidden is no variance"): (arrays["hidden"] >= 0) & np.isfinite(arrays["hidden"]),
        Problem("not-finite", "at is no time"): np.isnan(at) | np.isfinite(at),
        Problem("not-finite", "since is no time"): np.isnan(since) | np.isfinite(since),
        Problem("inconsistent", "neither learned nor being learned"): (np.isfinite(at) ^ np.isfinite(since))
        | (idle & np.isnan(at)),
        Problem("not-finite", "total is no number"): np.isfinite(arrays["total"]),
        Problem("not-integer", "count is no number of readings"): np.isfinite(count)
        & (count >= 0)
        & (count == np.floor(count)),
        Problem("negative", "time_s is no time"): np.isfinite(time_s) & (time_s >= 0),
    }
    return [
        Problem(what.code, f"{what} (meters {', '.join(map(str, np.flatnonzero(~good)))})")
        for what, good in rules.items()
        if not all_of(good)
    ]


# --- Progress ---


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


def expected_s(design: FrontDesign) -> float:
    """Time that learning takes if every tick counts, s."""
    ticks = int(np.ceil(design.options.commission_s / design.step_s - _TIME_TOLERANCE))
    return (1 + ticks) * design.step_s


def progress(design: FrontDesign, commission: Commission) -> LearningProgress:
    """State and reason of each meter."""
    expected, learning = expected_s(design), commission.learning
    p = commission.learned.at.size
    if learning is None:
        return LearningProgress(*_by_number(bytes([3] * p), bytes([len(REASONS)] * p)), expected)
    late = learning.watched_s >= _PATIENCE * expected
    number = np.where(late, 2, learning.time_s > 0)
    number[~learning.open] = 3
    behind = _late(design, learning)
    worst = np.full(p, len(REASONS))
    if any_of(behind):
        worst = np.where(behind, learning.lost_s.argmax(axis=0), worst)
    state, reason = _by_number(number.astype(np.int8).tobytes(), worst.astype(np.int8).tobytes())
    return LearningProgress(state, reason, expected)


_STATES = (LearningState.WAITING, LearningState.LEARNING, LearningState.STALLED, LearningState.LEARNED)


@lru_cache(maxsize=256)
def _by_number(
    states: bytes, reasons: bytes
) -> tuple[tuple[LearningState, ...], tuple[LearningReason | None, ...]]:
    """States and reasons of meters, by their indices in `_STATES` and `REASONS`; None beyond the latter."""
    return tuple(_STATES[k] for k in states), tuple((*REASONS, None)[k] for k in reasons)


def _late(design: FrontDesign, learning: Learning) -> Bools:
    """Meters that are learned later than expected, (p,): too few ticks counted, or nothing is concluded."""
    few = learning.time_s < design.options.enough * learning.watched_s
    held = learning.time_s >= design.options.commission_s
    behind = learning.open & (few | held)
    return behind & (learning.lost_s.max(axis=0) > 0) if any_of(behind) else behind


@dataclass(frozen=True, slots=True, eq=False)
class LearningTick:
    """One frame for learning. p meters."""

    frame: Frame  # the frame
    available: Bools  # (p,) meters with a reading
    trusted: Bools  # (p,) meters trusted after it
    accused: bool  # a customer's power or an inverter is suspect
    uncertainty: FrameUncertainty  # uncertainty of its powers


def usable(design: FrontDesign, before: Learning, tick: LearningTick) -> tuple[Bools, Ints]:
    """Meters to gather from, (p,), and the index of `REASONS`, or `COUNTED`, of each, (p,).

    A meter that has time enough and is not learned waits for others.
    """
    use = tick.available & tick.trusted
    why = np.full(use.size, COUNTED, dtype=np.intp)
    if not (tick.accused or (tick.uncertainty.usual and all_of(tick.uncertainty.busbar))):
        variance, at = frame_variance(design, tick.uncertainty), design.prior.meters
        # About as well as the design supposes.
        known = variance[at] <= _WIDEST**2 * design.prior.variance[at]
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


def _main_uncertainty(design: FrontDesign, tick: LearningTick) -> Ints:
    """Reason that adds most to the variance of the voltage at each meter, (p,), as index of `REASONS`."""
    uncertainty, doubt, at = tick.uncertainty, design.doubt, design.prior.meters
    added: dict[LearningReason, Floats] = {}
    if not all_of(uncertainty.busbar):
        no_voltage = design.busbar_incidence @ np.where(
            uncertainty.busbar, 0.0, UNMETERED**2 - design.busbar**2
        )
        added[LearningReason.NO_BUSBAR] = np.asarray(no_voltage)
    origin = tick.frame.p_origin
    unread = np.zeros(doubt.p.size, dtype=np.bool_) if origin is None else origin == PowerOrigin.UNREAD
    beyond = np.zeros(doubt.p.size, dtype=np.bool_) if origin is None else origin == PowerOrigin.BEYOND
    for power, std, factor, reason in (
        (Power.ACTIVE, doubt.p, uncertainty.p, LearningReason.ACTIVE_UNCERTAINTY),
        (Power.REACTIVE, doubt.q, uncertainty.q, LearningReason.REACTIVE_UNCERTAINTY),
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
