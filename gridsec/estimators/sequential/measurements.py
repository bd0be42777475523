"""Measurements of one frame: plausibility, clock offsets, and the uncertainty of the powers.

A meter with a clock that is o ahead reports at tick t its reading of t - o. Its residual is off by at most
the change of its voltage meanwhile, by the model

    c_j(t) = max over k = 1 .. K_j of |v2_j(t) - v2_j(t - k h)|,   K_j = ceil(|o_j| / h) + 1,

h being the interval of the ticks. The squared mean of c_j over a scale is added to the variance of the
meter's mean. Around a step of the busbar's voltage all these meters are off together, so a scale shorter than
`_OFFSETS` offsets does not test the meter. A reading that no scale tests counts as missing.

A busbar reading with an offset o is left out while the busbar's squared voltage u changed within K ticks by
more than the meter's accuracy class. u is the meter's own reading, which changes first where the clock is
behind, or the median change of the trusted meters of the phase, which changes first where it is ahead.

A mean over several ticks contains residuals of all of them. On each scale a power is therefore as uncertain
as at the worst of its ticks, and the busbar is known only if it is metered at all of them.

References
----------
docs/theory-sequential.md, sections 1 and 3.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from math import ceil

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.plant import NO_VOLTAGE, Plant, busbar_errors, losses, usual
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.posterior import EXACT, FALSE_Q, UNMETERED, Prior, voltage_prior
from gridsec.interface import Frame, PowerOrigin


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
    # NaN is not within.
    if all_of(np.maximum(np.abs(power), error) <= most) and all_of(error >= 0.0):
        return power, error
    good = np.abs(power) <= most
    known = good & (error >= 0.0) & (error <= most)
    return np.where(good, power, 0.0), np.where(known, error, most)


def measurements(
    design: SequentialDesign, frame: Frame, trusted: Bools, busbar: Bools, v0_before: Floats | float
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
    design: SequentialDesign, frame: Frame, trusted: Bools, before: Floats | float
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
    sizes: Floats  # (k,) standard deviation of each fault of the dictionary, pu

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

    def report_effect(self, plant: Plant, which: Bools) -> Floats:
        """Effect of customers' reports `which` (N,) at each meter, without that of active power, (p,).

        This remains of a false report beside its direction in the fault dictionary: reactive power and
        losses.
        """
        if not any_of(which):
            return np.zeros(plant.meters.size)
        p, q = (np.stack([of, np.where(which, 0.0, of)]) for of in (self.frame.p, self.q))
        with np.errstate(all="ignore"):
            all_ = plant.feeder.bus_voltages(p, q, self.v0_squared, steps=plant.loss_correction)
            active = plant.feeder.bus_voltages(p, q[0], self.v0_squared, steps=0)
            off: Floats = np.abs((all_[1] - all_[0]) - (active[1] - active[0]))
        at = plant.feeder.bus[plant.meters]
        return np.minimum(np.nan_to_num(off[at], nan=NO_VOLTAGE), NO_VOLTAGE)

    def errors(self, plant: Plant, injected: Floats) -> tuple[Floats, Floats]:
        """Largest errors of the net powers, (N,) each."""
        frame = self.frame
        p_error, q_error = frame.p_error.copy(), np.where(self.uses_q, frame.q_net_error, frame.q_error)
        suspects = plant.meters[~self.trusted]
        p_error[suspects] += self.sizes[suspects]
        q_error[suspects] += np.abs(frame.q[suspects]) + FALSE_Q * self.sizes[suspects]
        return p_error, q_error + np.where(self.uses_q, 0.0, injected)


# --- Clock offsets ---


_OFFSETS = 4.0
"""Shortest scale that tests a meter, in offsets of its clock."""


_NEGLIGIBLE = 0.1
"""Variance of a change, as a part of that of a mean, below which it is left out."""


_VARIANCE_RANGE = 4.0
"""Largest ratio of a used variance to the found one: each other one is a new factorisation."""


_FALL_TICKS = 4
"""Smallest number of ticks from one fall of the variances of a scale to the next."""


def largest_offset(design: SequentialDesign) -> float:
    """Largest clock offset with a scale that tests the meter, s."""
    return design.lengths[-1] * design.step_s / _OFFSETS


def unusable_offsets(design: SequentialDesign, offset_s: Floats | None) -> Bools | None:
    """Meters with clock offsets (p,), s, that no scale covers, (p,); None for none. NaN: not measurable."""
    if offset_s is None:
        return None
    far: Bools = np.asarray(np.abs(offset_s) > largest_offset(design))  # False for NaN
    return far if any_of(far) else None


@dataclass(frozen=True, slots=True, eq=False)
class ClockSkew:
    """Changes of the voltages within the clock offsets. p meters, s scales."""

    model: Floats  # (k, p) squared voltages of the model at the last ticks, the newest last, pu
    change: Floats  # (longest, p) c at the last ticks, the newest last, squared pu
    variance: Floats  # (s, p) added variance of the means, squared pu^2
    aside: Bools  # (s, p) meters that a scale does not test

    def tested(self, counts: Ints, needed: Ints) -> Bools:
        """Meters with enough readings, (s, p) counts and (s,) needed, on a scale that tests them, (p,)."""
        enough = (counts >= needed[:, None]) & ~self.aside
        return np.asarray(enough.any(axis=0) & self.aside.any(axis=0))


def update_skew(  # noqa: PLR0917
    design: SequentialDesign,
    before: ClockSkew | None,
    tick: int,
    offset_s: Floats | None,
    v2: Floats,
    noise: Floats,
) -> ClockSkew | None:
    """Changes with one more tick; None while no offset is measured and no added variance is left.

    tick: its number; variances of a scale change only when it is due. offset_s: (p,) lead of each clock, s,
    NaN if not measurable; offsets beyond `largest_offset` count as none. v2: (p,) voltages of the model,
    squared pu. noise: (s, p) variances of the means without offsets, squared pu^2.
    """
    size = np.zeros(v2.size) if offset_s is None else np.abs(np.nan_to_num(offset_s))
    size = np.where(size <= largest_offset(design), size, 0.0)
    if not any_of(size) and (before is None or not any_of(before.variance)):
        return None
    lengths, step = np.array(design.lengths), design.step_s
    ticks = np.where(size > 0.0, np.ceil(size / step) + 1.0, 0.0)
    old = np.zeros((0, v2.size)) if before is None else before.model
    change = np.zeros(v2.size)
    for k in range(1, min(int(ticks.max()), len(old)) + 1):
        change = np.where(ticks >= k, np.maximum(change, np.abs(v2 - old[-k])), change)
    change_history = np.zeros((lengths[-1], v2.size)) if before is None else before.change
    change_history = np.vstack([change_history[1:], change])
    aside = lengths[:, None] * step < _OFFSETS * size
    variance = np.zeros_like(noise) if before is None else before.variance.copy()
    for s, length in enumerate(design.lengths):
        if tick % design.look_every[s] == 0:
            mean = change_history[-length:].mean(axis=0)
            # The variance of a meter that the scale does not test is not used.
            found = np.where((size > 0.0) & ~aside[s], mean * mean, 0.0)
            looks = -(-_FALL_TICKS // design.look_every[s])
            falls = tick % (looks * design.look_every[s]) == 0
            variance[s] = _variance(found, noise[s], variance[s], falls=falls)
    kept = ceil(largest_offset(design) / step) + 1
    return ClockSkew(np.vstack([old, v2])[-kept:], change_history, variance, aside)


def _variance(found: Floats, noise: Floats, before: Floats, *, falls: bool) -> Floats:
    """Variances of one scale: the present ones while they are 1 to `_VARIANCE_RANGE` times those found, (p,).

    Each other variance is a new factorisation of the scale. One out of its range therefore renews all of
    them, to the middle of the range, and a variance falls at most once in `_FALL_TICKS` ticks.
    """
    little = _NEGLIGIBLE * noise
    wanted = np.where(found > np.where(before > 0.0, little / _VARIANCE_RANGE, little), found, 0.0)
    rises, removed = wanted > before, wanted * _VARIANCE_RANGE < before
    if not any_of(rises) and not (falls and any_of(removed)):
        return before
    wanted = wanted * np.sqrt(_VARIANCE_RANGE)
    return np.asarray(wanted if falls else np.maximum(wanted, before))


# --- Busbar readings ---


_LONGEST = 64
"""Largest number of ticks over which changes are taken."""


@dataclass(frozen=True, slots=True, eq=False)
class BusbarHistory:
    """Readings of the last k ticks, the newest last, squared pu, NaN where missing. p meters, b phases."""

    busbar: Floats  # (k, b) of the busbar's meter
    y: Floats  # (k, p) of the meters


def without_shifted_busbar(
    design: SequentialDesign,
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
    allowed = np.atleast_1d(np.asarray(busbar_errors(design.plant, v0_squared, design.sigmas[0])))
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
    """Uncertainty of the frames beyond that of the design. N customers, p meters, s scales, b busbar phases.

    A `_ticks` field counts the consecutive ticks for which the better state of its field would hold.
    """

    p: Floats  # (s, N) factors on the design's standard deviations: exact where withheld, else powers of 2
    q: Floats  # (s, N) likewise
    p_ticks: Ints  # (s, N)
    q_ticks: Ints  # (s, N)
    p_next: Floats  # (s, N) largest factor needed within these ticks
    q_next: Floats  # (s, N)
    busbar: Bools  # (s, b) a busbar voltage at all ticks of the scale
    busbar_ticks: Ints  # (s, b)
    priors: tuple[Prior, ...]  # (s,) resulting priors
    sizes: Floats  # (k,) standard deviation of each fault, pu: false powers as large as the claims
    vouched: Bools  # (s, p) no residual of the mean lacks a usable active power of the meter's customer
    vouched_ticks: Ints  # (s, p)
    read: Bools  # (s, p) as `vouched`, with late powers as readings
    read_ticks: Ints  # (s, p)
    before_silence: FrameUncertainty | None = (
        None  # while no meter reports: the uncertainty at the last report
    )
    usual: bool = field(init=False)  # derived: all powers as in the design, on every scale

    def __post_init__(self) -> None:
        object.__setattr__(self, "usual", all_of(self.p <= 1.0) and all_of(self.q <= 1.0))


def nominal_uncertainty(design: SequentialDesign) -> FrameUncertainty:
    """Uncertainty of the design."""
    scales, phases = len(design.lengths), design.busbar_incidence.shape[1]
    one, never = np.ones((scales, design.customers)), np.zeros((scales, design.customers), dtype=np.intp)
    known, unbroken = np.ones((scales, phases), dtype=np.bool_), np.zeros((scales, phases), dtype=np.intp)
    priors, meters = (design.prior,) * scales, design.plant.meters.size
    vouched, calm = np.ones((scales, meters), dtype=np.bool_), np.zeros((scales, meters), dtype=np.intp)
    sizes = design.faults.std
    return FrameUncertainty(
        one, one, never, never, one, one, known, unbroken, priors, sizes, vouched, calm, vouched, calm
    )


_WIDER = 4.0
"""Ratio of a frame's uncertainty to the design's beyond which it is used, unless a power is withheld."""


_SAME_RATIO = 1.0 + 1e-9
"""Ratio up to which two uncertainties differ by rounding only."""


_LEAST_EFFECT = 0.5
"""Part of the accuracy class by which late or excessive powers must be able to move a voltage to count."""


COMMON_SHARE = 0.5
"""Common share of the variance of unread powers."""


def update_uncertainty(
    design: SequentialDesign, before: FrameUncertainty, frame: Frame, available: Bools, busbar: Bools | bool
) -> FrameUncertainty:
    """Uncertainty of this frame and of the residuals in the means.

    Without any reading, (p,) `available`, no residual is made: at the next reading the uncertainty before
    counts again. busbar: a trusted busbar voltage; (3,) in three phases.
    """
    last = before if before.before_silence is None else before.before_silence
    if any_of(available):
        return _updated(design, last, frame, available, busbar)
    found = _updated(design, before, frame, available, busbar)
    return found if found.before_silence is last else replace(found, before_silence=last)


def checked(design: SequentialDesign, frame: Frame) -> Bools:
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


def _withheld(design: SequentialDesign, frame: Frame, available: Bools) -> tuple[Bools | None, Bools | None]:
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


def _updated(
    design: SequentialDesign, before: FrameUncertainty, frame: Frame, available: Bools, busbar: Bools | bool
) -> FrameUncertainty:
    """Uncertainty with this frame; new priors only where factors changed."""
    # Intervals in units of the design's standard deviations.
    frame, lengths = usual(frame), design.lengths
    withheld, unread = _withheld(design, frame, available)
    exact = None if unread is None else _customers(design, unread)
    calm_p, calm_q = (before.p, before.p_ticks, before.p_next), (before.q, before.q_ticks, before.q_next)
    if not (before.usual and exact is None and _within(design, frame)):
        calm_p = _factors(frame.p_error, design.doubt.even_p, calm_p, lengths, exact)
        calm_q = _factors(frame.q_error, design.doubt.even_q, calm_q, lengths, exact)
    (p, p_calm, p_rest), (q, q_calm, q_rest) = calm_p, calm_q
    sizes = _claim_sizes(np.abs(frame.p), design.options.hidden_power, before.sizes)
    metered, calm = _known_scales(busbar, before.busbar, before.busbar_ticks, lengths)
    before = _update_checks(before, withheld, unread, lengths)
    if metered is before.busbar and p is before.p and q is before.q:
        return before if sizes is before.sizes else replace(before, sizes=sizes)
    same = np.ones(len(lengths), dtype=np.bool_)
    for new, old in ((p, before.p), (q, before.q), (metered, before.busbar)):
        if new is not old:
            same &= (new == old).all(axis=1)
    if all_of(same):
        return replace(
            before,
            sizes=sizes,
            p_ticks=p_calm,
            q_ticks=q_calm,
            p_next=p_rest,
            q_next=q_rest,
            busbar_ticks=calm,
        )
    priors: list[Prior] = []
    for s, known in enumerate(before.priors):
        if same[s]:
            priors.append(known)
            continue
        # Scales with equal factors share a prior.
        parts = (p, q, metered, before.read)
        shared = (k for k in range(s) if all(np.array_equal(of[k], of[s]) for of in parts))
        k = next(shared, None)
        priors.append(_prior(design, p[s], q[s], metered[s], before.read[s]) if k is None else priors[k])
    return replace(
        before,
        p=p,
        q=q,
        p_ticks=p_calm,
        q_ticks=q_calm,
        p_next=p_rest,
        q_next=q_rest,
        busbar=metered,
        busbar_ticks=calm,
        priors=tuple(priors),
        sizes=sizes,
        before_silence=None,
    )


def _within(design: SequentialDesign, frame: Frame) -> bool:
    """All powers known about as well as the design supposes."""
    doubt = design.doubt
    return all_of(frame.p_error <= _WIDER * doubt.even_p) and all_of(frame.q_error <= _WIDER * doubt.even_q)


def _update_checks(
    before: FrameUncertainty, withheld: Bools | None, unread: Bools | None, lengths: tuple[int, ...]
) -> FrameUncertainty:
    """Uncertainty with `vouched` and `read` of this tick."""
    if withheld is None and all_of(before.vouched):
        return before
    vouched, vouched_calm = _known_scales(
        True if withheld is None else ~withheld, before.vouched, before.vouched_ticks, lengths
    )
    read, read_calm = _known_scales(
        True if unread is None else ~unread, before.read, before.read_ticks, lengths
    )
    return replace(before, vouched=vouched, vouched_ticks=vouched_calm, read=read, read_ticks=read_calm)


def _customers(design: SequentialDesign, meters: Bools) -> Bools:
    """Customers of some meters, (N,)."""
    out = np.zeros(design.customers, dtype=np.bool_)
    out[design.plant.meters] = meters
    return out


def unread_powers(design: SequentialDesign, p: Floats, read: Bools) -> Bools:
    """Customers with a power that nothing tells, (N,): p and read are those of one scale."""
    return np.asarray((p > 1.0) & _customers(design, ~read))


def _prior(design: SequentialDesign, p: Floats, q: Floats, busbar: Bools, read: Bools) -> Prior:
    if all_of(busbar) and all_of(p == 1.0) and all_of(q == 1.0):
        return design.prior
    unknown = np.where(busbar, design.busbar, UNMETERED)
    together = design.doubt.together
    if not all_of(read):
        # Unread powers are low together by night, with a meter as without.
        together = np.where(unread_powers(design, p, read), np.maximum(together, COMMON_SHARE), together)
    doubt = replace(
        design.doubt,
        together=together,
        p=np.where(p > 1.0, np.maximum(design.doubt.p, EXACT) * p, design.doubt.p),
        q=np.where(q > 1.0, np.maximum(design.doubt.q, EXACT) * q, design.doubt.q),
    )
    return voltage_prior(
        design.plant.feeder,
        design.prior.meters,
        doubt,
        busbar=unknown if unknown.size > 1 else float(unknown[0]),
        inverters=design.injections,
    )


def _claim_sizes(power: Floats, least: float, before: Floats) -> Floats:
    """Standard deviations of false powers: the claims in powers of two, with hysteresis."""
    old = before[: power.size]
    fine = (power <= old) & ((old <= least) | (4.0 * power >= old))
    if all_of(fine):
        return before
    new = np.where(fine, old, np.exp2(np.ceil(np.log2(np.maximum(power, least)))))
    return np.concatenate([new, before[power.size :]])


def _known_scales(
    busbar: Bools | bool, old: Bools, calm: Ints, lengths: tuple[int, ...]
) -> tuple[Bools, Ints]:
    """Scales without a residual made while the busbar was unknown, and the ticks since."""
    now = np.asarray(busbar)
    if all_of(now) and all_of(old):
        return old, calm
    known = now & (old | (calm + 1 >= np.array(lengths)[:, None]))
    return known, np.where(now & ~known, calm + 1, 0)


def _factors(
    error: Floats,
    known: Floats,
    before: tuple[Floats, Ints, Floats],
    lengths: tuple[int, ...],
    exact: Bools | None,
) -> tuple[Floats, Ints, Floats]:
    """Factors held while the means contain residuals made with larger ones, then the largest since."""
    old, calm, rest = before
    new = _factor(error, known, old, exact)
    if new is old:
        return before
    lower = new < old
    rest = np.where(lower, np.maximum(rest, new), 1.0)
    falls = lower & (calm + 1 >= np.array(lengths)[:, None])
    held = lower & ~falls
    after = np.where(held, old, np.where(falls, rest, new))
    return after, np.where(held, calm + 1, 0), np.where(held, rest, 1.0)


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
