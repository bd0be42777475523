"""Measurements of one frame: plausibility, clock offsets, and the uncertainty of the powers.

A meter with a clock that is o ahead reports at tick t its reading of t - o. Its residual is off by at most
the change of its voltage meanwhile, by the model

    c_j(t) = max over k = 1 .. K_j of |v2_j(t) - v2_j(t - k h)|,   K_j = ceil(|o_j| / h) + 1,

h being the interval of the ticks. A reading at an offset beyond `largest_offset` counts as missing.

A busbar reading with an offset o is left out while the busbar's squared voltage u changed within K ticks by
more than the meter's accuracy class. u is the meter's own reading, which changes first where the clock is
behind, or the median change of the trusted meters of the phase, which changes first where it is ahead.

References
----------
docs/theory-front.md, sections 1 and 3.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from math import ceil
from operator import is_
from typing import TypeVar

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.posterior import (
    EXACT,
    UNMETERED,
    LoadDoubt,
    Prior,
    prior_variance,
    voltage_prior,
)
from gridsec.estimators.plant import NO_VOLTAGE, Plant, busbar_errors, losses, usual
from gridsec.interface import Frame, PowerOrigin, usable_offset


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


def impossible(design: FrontDesign, frame: Frame, named: Bools) -> tuple[Bools, Frame]:
    """Meters that read more than a voltage can be, (p,), and the frame to use.

    Readings outside `v2_limits` count as missing where their meters and those `named` (p,) are more than the
    number that the other readings tell apart, as in an outage. Elsewhere a reading above the limits is false:
    no load and no outage causes it. One below them may be an outage of one customer, and is judged as others.
    """
    low, high = design.options.v2_limits
    read = frame.seen & np.isfinite(frame.y)
    above = read & (frame.y > high)
    out = above | (read & (frame.y < low))
    if not any_of(out):
        return above, frame
    if np.count_nonzero(out | named) > design.most_among(int(np.count_nonzero(frame.seen & ~out))):
        return np.zeros_like(out), replace(frame, seen=frame.seen & ~out)
    return above, frame


def plausible(design: FrontDesign, frame: Frame) -> Frame:
    """Frame with physically possible powers; no readings at clock offsets beyond `largest_offset`."""
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
    # NaN is not within.
    if all_of(np.maximum(np.abs(power), error) <= most) and all_of(error >= 0.0):
        return power, error
    good = np.abs(power) <= most
    known = good & (error >= 0.0) & (error <= most)
    return np.where(good, power, 0.0), np.where(known, error, most)


def measurements(
    design: FrontDesign, frame: Frame, trusted: Bools, busbar: Bools, v0_before: Floats | float
) -> Measurements:
    """Measurements of a frame from `plausible`.

    trusted, busbar: (p,) trusted meters and (b,) trusted phases of the busbar's meter. v0_before: last
    trusted squared busbar voltage, pu.
    """
    plant = design.plant
    available, y = frame.seen & np.isfinite(frame.y), frame.y
    if all_of(available):
        available = _all_available(available.size)
    else:
        y = np.where(available, y, 0.0)
    uses_q, q = np.zeros(frame.q.size, dtype=np.bool_), frame.q
    reports_q = np.abs(frame.q_net) <= design.max_q
    if any_of(reports_q):
        # An error beyond every possible power makes the report worthless.
        reports_q &= (frame.q_net_error >= 0.0) & (frame.q_net_error <= design.max_q)
    if any_of(reports_q):
        known = np.zeros(frame.q.size, dtype=np.bool_)
        known[plant.meters] = available & trusted
        least, most = plant.droop.saturated(frame.q.size)
        rest, room = (
            np.where(reports_q, frame.q_net, 0.0) - frame.q,
            frame.q_error + np.where(reports_q, frame.q_net_error, 0.0),
        )
        uses_q = known & reports_q & (least - room <= rest) & (rest <= most + room)
        q = np.where(uses_q, frame.q_net, frame.q)
    return Measurements(
        frame,
        available,
        np.minimum(np.maximum(y, 0.0), NO_VOLTAGE),
        q,
        uses_q,
        reports_q,
        *_busbar(design, frame, busbar, v0_before),
    )


@cache
def _all_available(meters: int) -> Bools:
    """The same array for all ticks with every reading: identity replaces comparison."""
    out = np.ones(meters, dtype=np.bool_)
    out.flags.writeable = False
    return out


def _busbar(
    design: FrontDesign, frame: Frame, trusted: Bools, before: Floats | float
) -> tuple[Floats | float, Bools | bool, Floats, Bools]:
    """Last four fields of `Measurements`."""
    low, high = design.options.v2_limits
    if design.plant.feeder.busbar_phases == 1:
        v0 = frame.v0_squared
        there = bool(low <= v0 <= high)  # False for NaN
        metered = there and bool(trusted[0])
        return v0 if metered else before, metered, np.array([v0]), np.array([there])
    # One voltage for all phases is a start value, not a reading of each.
    given = np.broadcast_to(frame.v0_squared if frame.v0_phases is None else frame.v0_phases, 3)
    within = (low <= given) & (given <= high)
    says = within & (frame.v0_phases is not None)
    v0_squared = np.where(within & trusted, given, before)
    return v0_squared, says & trusted, given, says


# --- Powers and their errors ---


@dataclass(frozen=True, slots=True, eq=False)
class PowerErrors:
    """Powers of one frame and their errors. N customers, p meters."""

    frame: Frame  # with possible powers
    q: Floats  # (N,) net reactive injections of the model, observed ones included, pu
    uses_q: Bools  # (N,) metered net reactive power is used: observed injections do not matter
    v0_squared: Floats | float  # squared busbar voltage, pu; (3,) in three phases
    trusted: Bools  # (p,) trusted meters: powers of the other customers may be false
    sizes: Floats  # (N,) standard deviation of each customer's false power, pu

    def linear_error(self, plant: Plant, injected: Floats) -> Floats:
        """Largest error of the linear model at each customer for a known busbar voltage, (N,).

        injected: (N,) largest errors of the inverters' injections, pu; also in `loss_error` and `errors`.
        """
        return plant.feeder.reach(*self.errors(plant, injected))[plant.feeder.bus]

    def loss_error(self, plant: Plant, injected: Floats) -> tuple[Floats, Floats]:
        """Largest error of the loss correction at each customer, (N,), and the correction."""
        p_error, q_error = self.errors(plant, injected)
        v0 = self.v0_squared
        correction, off = losses(plant, self.frame.p, self.q, v0, p_error=p_error, q_error=q_error)
        return off, correction[plant.feeder.bus]

    def errors(self, plant: Plant, injected: Floats) -> tuple[Floats, Floats]:
        """Largest errors of the net powers, (N,) each."""
        frame = self.frame
        p_error, q_error = frame.p_error.copy(), np.where(self.uses_q, frame.q_net_error, frame.q_error)
        suspects = plant.meters[~self.trusted]
        p_error[suspects] += self.sizes[suspects]
        q_error[suspects] += np.abs(frame.q[suspects]) + FALSE_Q * self.sizes[suspects]
        return p_error, q_error + np.where(self.uses_q, 0.0, injected)


FALSE_Q = 0.5
"""Largest reactive power per active power of a false report."""


# --- Clock offsets ---


def largest_offset(design: FrontDesign) -> float:
    """Largest clock offset of a usable reading, s."""
    return usable_offset(design.step_s, design.options.largest_offset_s)


def unusable_offsets(design: FrontDesign, offset_s: Floats | None) -> Bools | None:
    """Meters with clock offsets (p,), s, beyond `largest_offset`, (p,); None for none. NaN: unknown."""
    if offset_s is None:
        return None
    far: Bools = np.asarray(np.abs(offset_s) > largest_offset(design))  # False for NaN
    return far if any_of(far) else None


SYNCHRONOUS_S = 0.5
"""Largest clock offset that is not measured, s; a tick later the reading is that of the others."""
_RESTS = 4
"""Least number of ticks from one replay of readings to the next."""
_SHORT_S = 10.0
"""Longest tick of which `SYNCHRONOUS_S` is a part that counts, s."""
_MOVED = 0.5
"""Least change of a voltage by a power that counts for itself, in white deviations, 1."""
_FOLLOWED = 0.25
"""Least share of a sudden change of the model that the readings show at the same tick, 1."""
LastTick = tuple[Floats, Frame]
"""Voltages of the model at the meters (p,), squared pu, and the frame of a tick."""


@dataclass(frozen=True, slots=True, eq=False)
class ClockSkew:
    """Changes of the voltages within the clock offsets. k ticks, the newest last, p meters.

    The clock of meter j is ahead by o_j. At a tick its reading lags the power of customer i by ``o_j - o_i``,
    and the busbar and all others by o_j. With a positive lag it lacks changes of the last ticks. With a
    negative one it has changes of the next ticks.
    """

    lead: Floats  # (p,) offsets of the clocks, s; 0 where unknown or unusable
    model: Floats  # (k, p) squared voltages of the model, pu
    powers: Floats  # (k, 2 p) active and reactive injections of the metered customers, pu
    change: Floats  # (p,) largest change to the last tick within the lags, squared pu
    later: Floats  # (k, p) largest changes from these ticks to later ones within negative lags, squared pu
    known: Floats  # (k, p) `later` at the last replay, squared pu
    since: int  # ticks since that
    wait: int  # K of the largest offset: ticks until a step of the busbar is known

    @property
    def due(self) -> bool:
        """A replay is due, once in `wait` or `_RESTS` ticks, which bounds its time."""
        return self.since >= max(self.wait, _RESTS)

    @property
    def single(self) -> bool:
        """A sudden change without a measured offset, at most once in `_RESTS` ticks."""
        return self.since == 0 and not any_of(self.lead)

    @property
    def replayed(self) -> ClockSkew:
        """The same after a replay of the readings with `later`."""
        return replace(self, known=self.later, since=0)


def update_skew(
    design: FrontDesign,
    before: ClockSkew | None,
    offset_s: Floats | None,
    measured: Measurements,
    v2: Floats,
    *,
    last: LastTick | None = None,
) -> ClockSkew | None:
    """Changes with one more tick; None without a measured offset or a sudden change.

        change_j(t) = sum over x of max |x_j(t) - x_j(t - k)|,              1 <= k <= K
        later_j(t) = max over k of the sum over x of |x_j(t + k) - x_j(t)|

    ``K = ceil(|lag| / step_s) + 1``, and 1 within `SYNCHRONOUS_S`. x is the contribution of one power with an
    offset, or that of all else. offset_s: (p,) lead of each clock, s, NaN if not measurable; offsets beyond
    `largest_offset` count as none. v2: (p,) voltages of the model, squared pu. last: those of the tick before
    with powers known alike, and its frame; None: not comparable.
    """
    if offset_s is None:
        return _sudden(design, before, measured, v2, last)
    lead = np.nan_to_num(offset_s)
    lead = np.where(np.abs(lead) <= largest_offset(design), lead, 0.0)
    if not any_of(lead):
        return _sudden(design, before, measured, v2, last)
    if before is not None and not any_of(before.lead):
        before = None
    wait, at = int(_window(design, lead).max()), design.plant.meters
    powers = np.concatenate([measured.frame.p[at], measured.q[at]])
    none = np.zeros((1, v2.size))
    if before is None:
        return ClockSkew(lead, v2[None], powers[None], none[0], none, none, max(wait, _RESTS), wait)
    # Row k - 1: changes from k ticks ago.
    rest, moved = v2 - before.model[::-1], powers - before.powers[::-1]
    change, ahead = np.zeros(v2.size), np.zeros_like(rest)
    for i in _moved(design, moved, lead).tolist():
        of_power = moved[:, [i, v2.size + i]] @ _effect(design, i)
        rest = rest - of_power
        change, ahead = _widened(design, (change, ahead), of_power, lead - lead[i])
    # A clock without a measured offset may be behind by less than is measured.
    change, ahead = _widened(design, (change, ahead), rest, np.where(lead == 0.0, -SYNCHRONOUS_S, lead))
    later = np.maximum(before.later, ahead[::-1])
    kept = _window(design, np.array([2.0 * largest_offset(design)]))[0]
    return ClockSkew(
        lead,
        np.vstack([before.model, v2])[-kept:],
        np.vstack([before.powers, powers])[-kept:],
        change,
        np.vstack([later, none])[-kept:],
        np.vstack([before.known, none])[-kept:],
        before.since + 1,
        wait,
    )


def _sudden(
    design: FrontDesign, before: ClockSkew | None, measured: Measurements, v2: Floats, last: LastTick | None
) -> ClockSkew | None:
    """Changes within a tick beyond the accuracy class: clocks within `SYNCHRONOUS_S` show them apart.

    The readings follow the model, ``sum dy dv >= _FOLLOWED sum dv^2``: a false busbar or power moves none.
    """
    since, change = _RESTS if before is None else before.since + 1, np.zeros(v2.size)
    if last is not None and design.step_s <= _SHORT_S:
        moved = v2 - last[0]
        if any_of(np.abs(moved) > design.allowed):
            both = measured.available & last[1].seen & np.isfinite(last[1].y)
            dv, dy = moved[both], (measured.y - last[1].y)[both]
            change = np.abs(moved) if dy @ dv >= _FOLLOWED * (dv @ dv) else change
    if since >= _RESTS and not any_of(change):
        return None
    none, rows = np.zeros((2, v2.size)), v2 if last is None else last[0]
    return ClockSkew(
        none[0], np.stack([rows, v2]), np.tile(none, 2), change, np.stack([change, none[0]]), none, since, 1
    )


def _moved(design: FrontDesign, moved: Floats, lead: Floats) -> Ints:
    """Meters with a clock offset and powers that have moved (k, 2 p) by more than jitter."""
    p = lead.size
    most = np.abs(moved).max(axis=0)
    effect = most[:p] * design.references.active + most[p:] * design.references.reactive
    return np.flatnonzero((lead != 0.0) & (effect > _MOVED * np.sqrt(design.white)))


def _effect(design: FrontDesign, meter: int) -> Floats:
    """Effect of the powers of a metered customer on all meters, (2, p), squared pu per pu."""
    customer = int(design.plant.meters[meter])
    which = np.array([customer, design.customers + customer])
    return np.asarray(design.sensitivities.numbered(which)[design.prior.meters].T)


def _window(design: FrontDesign, lag: Floats) -> Ints:
    """K of each lag, s; 0 without a lag."""
    ticks = np.where(np.abs(lag) > SYNCHRONOUS_S, np.ceil(np.abs(lag) / design.step_s) + 1.0, 1.0)
    return np.where(lag != 0.0, ticks, 0.0).astype(np.intp)


def _widened(
    design: FrontDesign, sums: tuple[Floats, Floats], moved: Floats, lag: Floats
) -> tuple[Floats, Floats]:
    """Sums of changes to the last tick (p,), and from k ticks ago (k, p) within negative lags, with a source.

    moved, lag: (k, p) changes of the source, the newest first, squared pu, and (p,) lags behind it, s. The
    changes of the last ticks stand for those of the next ones as well.
    """
    ago, window = np.arange(1, len(moved) + 1)[:, None], _window(design, lag)
    size = np.where(ago <= window, np.abs(moved), 0.0)
    return sums[0] + size.max(axis=0, initial=0.0), sums[1] + np.where(lag < 0.0, size, 0.0)


# --- Busbar readings ---


_LONGEST = 64
"""Largest number of ticks over which changes are taken."""


@dataclass(frozen=True, slots=True, eq=False)
class BusbarHistory:
    """Readings of the last k ticks, the newest last, squared pu, NaN where missing. p meters, b phases."""

    busbar: Floats  # (k, b) of the busbar's meter
    y: Floats  # (k, p) of the meters


def without_shifted_busbar(
    design: FrontDesign,
    history_before: BusbarHistory | None,
    frame: Frame,
    trusted: Bools,
    v0_squared: Floats | float,
) -> tuple[BusbarHistory | None, Frame]:
    """Frame without busbar phases that changed within the clock offset, and history; None if not measured.

    trusted: (p,) meters. v0_squared: last trusted squared busbar voltage, pu; (3,) in three phases.
    """
    offset = abs(frame.busbar_offset)
    if not offset > 0.0:  # also for NaN
        return None, frame
    ticks = min(ceil(offset / design.step_s) + 1, _LONGEST)
    reading = np.atleast_1d(np.asarray(frame.v0_squared if frame.v0_phases is None else frame.v0_phases))
    y = np.where(frame.seen, frame.y, np.nan)
    if history_before is None or history_before.busbar.shape[1] != reading.size:
        history_before = BusbarHistory(np.zeros((0, reading.size)), np.zeros((0, y.size)))
    allowed = np.atleast_1d(np.asarray(busbar_errors(design.plant, v0_squared, design.sigmas)))
    here = (design.busbar_incidence > 0.0) & trusted[:, None]
    moved: Bools = np.asarray(_beyond(reading - history_before.busbar[-ticks:], allowed).any(axis=0))
    for phase in range(here.shape[1]):
        change = (y - history_before.y[-ticks:])[:, here[:, phase]]
        known = np.isfinite(change)
        middle = [np.median(row[one]) for row, one in zip(change, known, strict=True) if any_of(one)]
        if any_of(_beyond(np.array(middle), allowed[phase])):
            moved = np.asarray(moved | _phase_mask(phase, reading.size))
    history = BusbarHistory(
        np.vstack([history_before.busbar, reading])[-_LONGEST:], np.vstack([history_before.y, y])[-_LONGEST:]
    )
    if not any_of(moved):
        return history, frame
    if frame.v0_phases is None:
        return history, replace(frame, v0_squared=np.nan)
    return history, replace(frame, v0_squared=np.nan, v0_phases=np.where(moved, np.nan, frame.v0_phases))


def _phase_mask(phase: int, phases: int) -> Bools:
    """Phase among those of the busbar's readings; all of them where one reading serves for all."""
    return np.arange(phases) == phase if phases > 1 else np.ones(1, dtype=np.bool_)


def _beyond(change: Floats, allowed: Floats) -> Bools:
    """Changes beyond the accuracy class; a missing reading has none."""
    return np.asarray(np.abs(np.nan_to_num(change, posinf=0.0, neginf=0.0)) > allowed)


# --- Uncertainty of the frames ---


@dataclass(frozen=True, slots=True, eq=False)
class FrameUncertainty:
    """Uncertainty of one frame beyond that of the design. N customers, p meters, b busbar phases."""

    p: Floats  # (N,) factors on the design's standard deviations: exact where withheld, else powers of 2
    q: Floats  # (N,) likewise
    busbar: Bools  # (b,) phases with a trusted busbar voltage
    sizes: Floats  # (N,) standard deviations of false powers, pu: as large as the claims
    vouched: Bools  # (p,) a usable active power of the meter's customer, or no reading of the meter
    read: Bools  # (p,) as `vouched`, with late powers as readings
    usual: bool = field(init=False)  # derived: all powers as in the design

    def __post_init__(self) -> None:
        object.__setattr__(self, "usual", all_of(self.p <= 1.0) and all_of(self.q <= 1.0))

    def knows_as(self, other: FrameUncertainty) -> bool:
        """Powers and busbar are known as in another frame."""
        pairs = (self.p, other.p), (self.q, other.q), (self.busbar, other.busbar), (self.read, other.read)
        return all(one is another for one, another in pairs)


def nominal_uncertainty(design: FrontDesign) -> FrameUncertainty:
    """Uncertainty of the design."""
    one, known = np.ones(design.customers), np.ones(design.busbar_incidence.shape[1], dtype=np.bool_)
    vouched = np.ones(design.plant.meters.size, dtype=np.bool_)
    sizes = np.full(design.customers, design.options.hidden_power)
    return FrameUncertainty(one, one, known, sizes, vouched, vouched)


_WIDER = 4.0
"""Ratio of a frame's uncertainty to the design's beyond which it is used, unless a power is withheld."""


_SAME_RATIO = 1.0 + 1e-9
"""Ratio up to which two uncertainties differ by rounding only."""


_LEAST_EFFECT = 0.5
"""Part of the accuracy class by which late or excessive powers must be able to move a voltage to count."""


COMMON_SHARE = 0.5
"""Common share of the variance of unread powers."""


def update_uncertainty(
    design: FrontDesign, before: FrameUncertainty, frame: Frame, available: Bools, busbar: Bools | bool
) -> FrameUncertainty:
    """Uncertainty of this frame, with hysteresis of the factors and sizes.

    available: (p,) meters with a reading. busbar: a trusted busbar voltage; (3,) in three phases.
    """
    # Intervals in units of the design's standard deviations.
    frame, doubt = usual(frame), design.doubt
    withheld, unread = _withheld(design, frame, available)
    exact = None if unread is None else _customers(design, unread)
    p, q = before.p, before.q
    if not (before.usual and exact is None and _within(design, frame)):
        p = _unless_same(_factor(frame.p_error, doubt.even_p, p, exact), p)
        q = _unless_same(_factor(frame.q_error, doubt.even_q, q, exact), q)
    every = _all_available(available.size)
    after = (
        p,
        q,
        _unless_same(np.atleast_1d(np.asarray(busbar)), before.busbar),
        _claim_sizes(np.abs(frame.p), design.options.hidden_power, before.sizes),
        _unless_same(every if withheld is None else ~withheld, before.vouched),
        _unless_same(every if unread is None else ~unread, before.read),
    )
    old = (before.p, before.q, before.busbar, before.sizes, before.vouched, before.read)
    return before if all(map(is_, after, old)) else FrameUncertainty(*after)


_Array = TypeVar("_Array", Bools, Floats)


def _unless_same(new: _Array, old: _Array) -> _Array:
    """New value; the same array while it does not change: identity replaces comparison."""
    return old if np.array_equal(new, old) else new


def checked(design: FrontDesign, frame: Frame) -> Bools:
    """Meters with an active power known about as well as the design supposes, (p,)."""
    meters = design.plant.meters
    if frame.p_origin is None:
        return np.ones(meters.size, dtype=np.bool_)
    origins = frame.p_origin[meters]
    if not any_of(origins):
        return np.ones(meters.size, dtype=np.bool_)
    least = np.where(origins == PowerOrigin.UNREAD, _SAME_RATIO, _WIDER)
    wide = frame.p_error[meters] > least * design.doubt.even_p[meters]
    return np.asarray((origins == PowerOrigin.READ) | ~wide)


def _withheld(design: FrontDesign, frame: Frame, available: Bools) -> tuple[Bools | None, Bools | None]:
    """Meters with a voltage and no usable active power of its moment; those without a late one; (p,) or None.

    A late power, or one beyond the declared range, counts if all of these together can move the voltage at
    its meter by `_LEAST_EFFECT` of the accuracy class.
    """
    meters = design.plant.meters
    if frame.p_origin is None or not any_of(frame.p_origin[meters]):
        return None, None
    origins, out = frame.p_origin[meters], available & ~checked(design, frame)
    doubted = out & (origins != PowerOrigin.UNREAD)
    if any_of(doubted):
        power = np.where(_customers(design, doubted), frame.p_error, 0.0)
        moved = design.plant.feeder.reach(power, np.zeros_like(power))[design.prior.meters]
        out = out & ~(doubted & (moved <= _LEAST_EFFECT * design.allowed))
    unread = out & (origins != PowerOrigin.LATE)
    return out if any_of(out) else None, unread if any_of(unread) else None


def _within(design: FrontDesign, frame: Frame) -> bool:
    """All powers known about as well as the design supposes."""
    doubt = design.doubt
    return all_of(frame.p_error <= _WIDER * doubt.even_p) and all_of(frame.q_error <= _WIDER * doubt.even_q)


def _customers(design: FrontDesign, meters: Bools) -> Bools:
    """Customers of some meters, (N,)."""
    out = np.zeros(design.customers, dtype=np.bool_)
    out[design.plant.meters] = meters
    return out


def unread_powers(design: FrontDesign, uncertainty: FrameUncertainty) -> Bools:
    """Customers with a power that nothing tells, (N,)."""
    return np.asarray((uncertainty.p > 1.0) & _customers(design, ~uncertainty.read))


def frame_prior(design: FrontDesign, uncertainty: FrameUncertainty) -> Prior:
    """Prior of the voltages by the powers and the busbar of a frame; O(n p)."""
    if uncertainty.usual and all_of(uncertainty.busbar):
        return design.prior
    doubt, busbar = _frame_doubt(design, uncertainty)
    return voltage_prior(
        design.plant.feeder, design.prior.meters, doubt, busbar=busbar, inverters=design.injections
    )


def frame_variance(design: FrontDesign, uncertainty: FrameUncertainty) -> Floats:
    """Variances of `frame_prior`, (n,), squared pu^2, without the covariances."""
    if uncertainty.usual and all_of(uncertainty.busbar):
        return design.prior.variance
    doubt, busbar = _frame_doubt(design, uncertainty)
    return prior_variance(design.plant.feeder, doubt, busbar=busbar, inverters=design.injections)


def _frame_doubt(design: FrontDesign, uncertainty: FrameUncertainty) -> tuple[LoadDoubt, Floats | float]:
    """Uncertainty of the powers of a frame, and standard deviation of the busbar, squared pu; one or (3,)."""
    p, q, doubt, together = uncertainty.p, uncertainty.q, design.doubt, design.doubt.together
    if not all_of(uncertainty.read):
        # Unread powers are low together by night, with a meter as without.
        together = np.where(unread_powers(design, uncertainty), np.maximum(together, COMMON_SHARE), together)
    busbar = np.where(uncertainty.busbar, design.busbar, UNMETERED)
    wider = replace(
        doubt,
        together=together,
        p=np.where(p > 1.0, np.maximum(doubt.p, EXACT) * p, doubt.p),
        q=np.where(q > 1.0, np.maximum(doubt.q, EXACT) * q, doubt.q),
    )
    return wider, busbar if busbar.size > 1 else float(busbar[0])


def _claim_sizes(power: Floats, least: float, before: Floats) -> Floats:
    """Standard deviations of false powers: the claims in powers of two, with hysteresis."""
    fine = (power <= before) & ((before <= least) | (4.0 * power >= before))
    if all_of(fine):
        return before
    return np.where(fine, before, np.exp2(np.ceil(np.log2(np.maximum(power, least)))))


def _factor(error: Floats, known: Floats, old: Floats, exact: Bools | None) -> Floats:
    """Factor by which a frame knows a power less well than the design assumes, with hysteresis.

    The ratio itself where `exact`, else a power of two.
    """
    if exact is None and all_of(old <= 1.0) and all_of(error <= _WIDER * known):
        return old
    ratio = error / known
    keep = (ratio <= old * _WIDER) & (ratio * _WIDER >= old) & (old > _WIDER)
    raised = np.exp2(np.ceil(np.log2(np.maximum(ratio, 1.0))))
    new = np.where(keep, old, np.where(ratio > _WIDER, raised, 1.0))
    if exact is None:
        return new
    # A forecast states its own standard deviation; rounding it up would widen more than is stated.
    near = (ratio <= _SAME_RATIO * old) & (ratio * _WIDER >= old) & (old > 1.0)
    return np.where(exact, np.where(near, old, np.where(ratio > _SAME_RATIO, ratio, 1.0)), new)
