"""Fixed errors of the meters, learned while no meter is suspect.

A meter of class 0.5 may be off by a constant 0.5 %, and a manipulation of that size is not evidence. Over a
long time load errors cancel, and the mean residual is the meter's own error. With B the prior variance of
the fixed errors and M the long-run means,

    cov M = B + c * S + D / n,      b_hat = B (cov M)^-1 M,      P = B - B (cov M)^-1 B

where ``c_ij`` is the remaining share of load errors, of correlation time tau, in two means over the last
a and b >= a seconds (in units of tau):

    c = (2 a + e^-a + e^-b - e^-(b - a) - 1) / (a b)

and a share `lasting` of the variances stays whole (c = 1). Afterwards a meter is manipulated when it
*changes*, even within its class. A replaced meter is learned anew beside the others, with B their P.

Progress of the commissioning of each meter: state, reason, expected time.

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

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, submatrix
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.measurements import FrameUncertainty
from gridsec.estimators.sequential.posterior import EXACT, UNMETERED, invert_spd
from gridsec.estimators.sequential.search import LimitCache
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


@dataclass(frozen=True, eq=False)
class Learned:
    """Known fixed errors. p meters."""

    bias: Floats  # (p,) expected fixed error, squared pu
    variance: Floats  # (p,) its variance
    allowed: Floats  # (p,) largest honest change from it, squared pu
    at: Floats  # (p,) Unix time of learning, s; NaN where only the class is known
    hidden: Floats  # (p,) variance of lasting load errors, inseparable from the own error, squared pu^2

    @cached_property
    def late(self) -> Floats | None:
        """Variance that `hidden` of learned meters adds at the others, squared pu^2; (p,), zero if learned.

        None where no meter or every meter is learned.
        """
        unknown = np.isnan(self.at)
        if all_of(unknown) or not any_of(unknown):
            return None
        return np.where(unknown, self.hidden.max(), 0.0)

    @cached_property
    def recent(self) -> defaultdict[int, LimitCache]:
        """Last results of the limits, by scale."""
        return defaultdict(LimitCache)

    def __getstate__(self) -> dict[str, Any]:
        # Results can be computed again.
        return {name: each for name, each in vars(self).items() if name != "recent"}


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


def class_only(design: SequentialDesign) -> Learned:
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


def initial(design: SequentialDesign, t: float) -> Commission:
    """Commissioning of a new feeder by classes alone; ``commission_s = 0`` learns nothing."""
    learns = design.options.commission_s > 0
    every = np.ones(design.allowed.size, dtype=np.bool_)
    return Commission(class_only(design), no_readings(every, t) if learns else None)


def renew(design: SequentialDesign, before: Commission, which: Bools, t: float) -> Commission:
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


def gather(before: Learning, residual: Floats, use: Bools, h: float, why: Ints | None = None) -> Learning:
    """Sums after one tick of h seconds.

    residual: (p,) readings minus the model and the known errors. use: (p,) meters to gather from. why: (p,)
    index of `REASONS` for a tick without progress, else `COUNTED`; None for all `COUNTED`.
    """
    lost_s = before.lost_s
    if why is not None and any_of(why != COUNTED):
        lost_s = lost_s + h * np.equal.outer(np.arange(len(REASONS)), why)
    return Learning(
        total=before.total + np.where(use, residual, 0.0),
        count=before.count + use,
        time_s=before.time_s + h * use,
        since=before.since,
        watched_s=before.watched_s + h,
        lost_s=lost_s,
    )


def ready_meters(design: SequentialDesign, gathered: Learning) -> Bools:
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


def learn(design: SequentialDesign, known: Learned, gathered: Learning, which: Bools, t: float) -> Commission:
    """Known errors after learning meters `which` (p,); meters without a reading keep their class."""
    meters = np.flatnonzero(gathered.count * gathered.time_s > 0)
    done = which & (gathered.count > 0) & (gathered.time_s > 0)
    if not any_of(done):
        return Commission(known, gathered)
    B, n = known.variance[meters], gathered.count[meters]
    # One matrix of this size, inverted in place.
    K = design.prior.among(meters)
    time = gathered.time_s[meters] / design.doubt.time_s
    for first in range(0, meters.size, _BLOCK):
        some = slice(first, first + _BLOCK)
        share = _mean_covariance(time, time[some])
        K[:, some] = share * K[:, some] + (1.0 - share) * _lasting(design, meters, some)
    K[np.diag_indices_from(K)] += B + design.white[meters] / n
    invert_spd(K)
    bias, variance, allowed = known.bias.copy(), known.variance.copy(), known.allowed.copy()
    hidden = np.zeros(known.at.size)
    hidden[meters] = _hidden_variance(design, meters, K)
    bias[meters] += B * (K @ (gathered.total[meters] / n))
    left = np.maximum(B - B * B * K.diagonal(), 0.0)
    rounded = design.rounded[meters]
    aging = design.options.stability * (design.allowed[meters] - rounded)
    # A uniform error of half-width a has the variance a^2 / 3; rounding follows the voltage.
    variance[meters] = np.minimum(left + aging**2 / 3.0 + 0.5 * rounded**2, B)
    allowed[meters] = np.minimum(aging + 3.0 * np.sqrt(left) + rounded, design.allowed[meters])
    learned = Learned(
        # Honest meters stay within their class, so a larger bias is not learned.
        bias=np.where(done, np.clip(bias, -design.allowed, design.allowed), known.bias),
        variance=np.where(done, variance, known.variance),
        allowed=np.where(done, allowed, known.allowed),
        at=np.where(done, t, known.at),
        hidden=np.where(done, hidden, known.hidden),
    )
    rest = gathered.open & ~done
    if not any_of(rest):
        return Commission(learned, None)
    # The sums of the others are used; they start again as witnesses of the loads.
    start = no_readings(rest, t)
    left_open = Learning(
        *(np.where(rest, getattr(gathered, f.name), getattr(start, f.name)) for f in fields(Learning))
    )
    return Commission(learned, left_open)


def _lasting(design: SequentialDesign, meters: Ints, some: slice) -> Floats:
    """Covariance at the meters of errors that no mean reduces, some columns, (h, k).

    The fixed error of the busbar's meter is one of them, by phase.
    """
    of_loads = submatrix(design.prior.covariance, design.prior.meters[meters], meters[some])
    lasting = design.doubt.lasting
    places, feeder = design.prior.meters, design.plant.feeder
    same = feeder.same_busbar_phase(places[meters], places[meters[some]])
    return lasting * of_loads + (1.0 - lasting) * design.busbar**2 * same


def _hidden_variance(design: SequentialDesign, meters: Ints, inverse: Floats) -> Floats:
    """Posterior variance ``diag(L - L K^-1 L)`` of lasting errors L, (h,)."""
    out = np.empty(meters.size)
    for first in range(0, meters.size, _BLOCK):
        some = slice(first, first + _BLOCK)
        L = _lasting(design, meters, some)
        own = L[np.arange(meters.size)[some], np.arange(L.shape[1])]
        out[some] = own - np.einsum("ij,ij->j", L, inverse @ L)
    return np.maximum(out, 0.0)


_BLOCK = 128
"""Columns of one block of a product."""


def _mean_covariance(one: Floats, other: Floats) -> Floats:
    """Covariance of two means of an Ornstein-Uhlenbeck process of variance 1 that end together, (j, k).

    The times are in units of its correlation time.
    """
    a, b = np.minimum.outer(one, other), np.maximum.outer(one, other)
    total = 2.0 * a + np.expm1(-a) + np.expm1(-b) - np.expm1(a - b)
    return np.asarray(np.clip(total / (a * b), 0.0, 1.0))


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


def from_arrays(design: SequentialDesign, arrays: Mapping[str, Floats]) -> Commission:
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


def _problems(design: SequentialDesign, arrays: Mapping[str, Floats]) -> list[Problem]:
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


def expected_s(design: SequentialDesign) -> float:
    """Time that learning takes if every tick counts, s."""
    ticks = int(np.ceil(design.options.commission_s / design.step_s - _TIME_TOLERANCE))
    return (1 + ticks) * design.step_s


def progress(design: SequentialDesign, commission: Commission) -> LearningProgress:
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


def _late(design: SequentialDesign, learning: Learning) -> Bools:
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
