"""Directions of the residuals that one frame leaves unknown: unread powers, late ones, the busbar, clocks.

The model of the residuals is fixed by the feeder's files. A frame may know less: a power without a reading,
an interval far wider than the files state, an inverter that has not settled, a missing busbar voltage, a
clock offset. Where the files state that powers are older than their voltages (`LoadDoubt.sudden_p`), each
frame does. Each such error d moves the residuals along one known column a, with unknown time dependence:

    m_t = w_t + b_t + e_t + f_t + A_t d_t

The filter treats ``A_t d_t`` as white with a multiple of its standard deviation, `WIDER` or `FOLLOWS`. A tick
then says nothing along A_t. For one column, with ``q = a' V^-1 a``, a lasting error d leaves

    a' (V + s^2 a a')^-1 a d = q d / (1 + s^2 q)  <=  d / s^2

per tick in the score, in place of ``q d``, s including the factor: next to nothing accumulates, whatever the
correlation in time. The price
is evidence against a fault along a. It is unavoidable where the error may last.

The estimate uses the standard deviations themselves: d is estimated from the residuals of the same tick,

    d_hat = A_n' (A_n A_n' + D_n)^-1 u_n,   u = m - E[w + b],

n being the meters with a reading.

Powers that nothing tells are wrong together: low by night, and too high where customers collude. The share
`COMMON_SHARE` of their variance is common, and a direction of its own.

**Loads that jump.** The error of a power follows the power. Its half-width l is that of the frame; for a
reactive power that the model adds, it is that power as well. Let l rise by d_j in a tick, and by m_j shortly
before. The error has changed by a number of the variance ``(m_j + d_j)^2 / 3``. The part ``m_j^2 / 3`` has
been accounted for. With the design's deviations s_j, without common parts,

    sum_j a_j a_j' (d_j^2 + 2 m_j d_j) / 3  <=  r S,   r = max_j (d_j^2 + 2 m_j d_j) / (3 s_j^2),

where ``m_j <- max(0, exp(-h / RISE_S) m_j + d_j)``, and the same for falls. The variance of w gains r S in
such a tick. Movements below `NOTICED` do not count; the first one above counts as a whole. r is at most
`FARTHEST`. The mean of w stays: what lasts is not renewed with a power. Where frames are more than `SUDDEN_S`
apart by design, all powers change from one to the next, and w as its model has it. A reactive power with a
reading and one that the model adds are not compared.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import exp, sqrt

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, indices, submatrix
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.measurements import (
    COMMON_SHARE,
    ClockSkew,
    FrameUncertainty,
    Measurements,
    unread_powers,
)
from gridsec.estimators.front.posterior import EXACT, UNMETERED
from gridsec.estimators.plant import usual
from gridsec.interface import PowerOrigin

WIDER = 10.0
"""Factor on the standard deviations of unknown directions, 1: a lasting error leaves 1 % of its evidence."""
UNSETTLED = 4.0
"""Ratio of an injection's error to the design's from which on the injection is unknown, 1."""
FOLLOWS = 3.0
"""Factor on the standard deviation of an injection that follows the estimate, 1. It lasts, and hides faults.

With `WIDER` an injection hides the lies of its neighbours (31 of 39 named on SimBench rural3); with 1 a third
that drifts moves it farther than that, and an honest meter is named. The estimate takes the deviation itself.
"""
NOTICED = 0.5
"""Change of a voltage, in white deviations, from which on a changed power counts as a load that jumps, 1."""
SUDDEN_S = 60.0
"""Longest step of a feeder at which powers jump, s. Over longer ones loads change as the AR(1) has it."""
RISE_S = 10.0
"""Time in which a movement is forgotten, s: cars and heat pumps start within several seconds."""
FARTHEST = 10.0
"""Largest variance of a jump of one tick, in that of the loads, 1: a power over three times the usual."""
SKEWED = 0.5
"""Change of a voltage within a clock offset from which on the reading is unknown, in white deviations, 1."""
CLOCKS = 3.0
"""Factor on the change of a voltage within a clock offset, 1: it lasts for 32 ticks, and hides faults.

With `WIDER` a load of 0.6 kW that cycles behind a clock offset hides a lasting lie of three times the class.
"""
LATER = 3.0
"""Change after a reading for which the kept readings are replayed, in white deviations, 1: it takes time."""
GROWN = 1.5
"""Growth of such a change from which on they are replayed again, 1: a step has one or two."""


@dataclass(frozen=True, slots=True, eq=False)
class Unknown:
    """Unknown directions of one frame, times their standard deviations. n places, p meters, k directions.

    Attributes
    ----------
    places : (n, k)
        Effect on the true voltages beyond the model, squared pu.
    meters : (p, k)
        Effect on the residuals, squared pu.
    factor : (k,)
        Factor of the filter on the standard deviations, 1.
    unchecked : (p,)
        Meters with a reading that no known power checks.
    powers
        Number of the first directions, those of powers and injections.
    """

    places: Floats = field(repr=False)
    meters: Floats = field(repr=False)
    factor: Floats
    unchecked: Bools
    powers: int

    @property
    def wide(self) -> Floats:
        """Directions for the filter, (p, k)."""
        return self.meters * self.factor


def unknown(  # noqa: PLR0917  # the state, and one frame
    design: FrontDesign,
    measured: Measurements,
    uncertainty: FrameUncertainty,
    injected: Floats,
    free: Bools,
    skew: ClockSkew | None,
) -> Unknown | None:
    """Directions that a frame leaves unknown; None for none.

    Parameters
    ----------
    design, measured
        The front end, and the measurements of the frame.
    uncertainty
        Uncertainty of the frame beyond that of the design.
    injected : (m,)
        Half-widths of the errors of the injections, pu.
    free : (m,)
        Inverters that follow the estimate: an error of that lasts.
    skew
        Changes of the voltages within clock offsets.
    """
    columns, factor = _powers(design, measured, uncertainty, injected, free)
    metered = np.asarray(measured.busbar_metered)
    places = design.prior.variance.size
    if not all_of(metered):
        for phase in indices(~np.atleast_1d(metered)).tolist():
            at = np.arange(places) % metered.size == phase
            columns.append(UNMETERED * at[:, None].astype(np.float64))
    clocks = _clocks(design, measured, skew)
    if not columns and clocks is None:
        return None
    whole, powers = np.hstack([np.zeros((places, 0)), *columns]), factor.size
    meters = whole[design.prior.meters]
    if clocks is not None:
        whole = np.hstack([whole, np.zeros((places, clocks.shape[1]))])
        meters = np.hstack([meters, clocks])
    factor = np.concatenate([factor, np.full(whole.shape[1] - factor.size, WIDER)])
    if clocks is not None:
        factor[-clocks.shape[1] :] = CLOCKS
    return Unknown(whole, meters, factor, measured.available & ~uncertainty.vouched, powers)


def reach(design: FrontDesign) -> Floats:
    """Largest effect of each power on a meter, in its white deviations per pu, (2 N,).

    Parameters
    ----------
    design
        The front end.
    """
    columns = design.sensitivities.numbered(np.arange(2 * design.customers))[design.prior.meters]
    return np.asarray((np.abs(columns) / np.sqrt(design.white)[:, None]).max(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class Movements:
    """Half-widths of the powers' errors, active then reactive, pu. N customers.

    Attributes
    ----------
    level : (2 N,)
        l of the last reading of each power, with the sign of the reactive power; NaN before the first.
    moved : (2, 2 N)
        m of rises and of falls.
    metered : (N,)
        Reactive powers that the model takes from a reading.
    """

    level: Floats
    moved: Floats
    metered: Bools


def jump(
    design: FrontDesign, reach: Floats, before: Movements | None, measured: Measurements, h: float
) -> tuple[float, Movements]:
    """Variance of a jump of the loads' errors, in that of the loads, 1, and the movements with this frame.

    The reactive error of a load that is switched on may be all of the reactive power that the model adds.

    Parameters
    ----------
    design, reach
        The front end, and the reach of its powers.
    before
        Movements up to the last frame; None before the first.
    measured, h
        The measurements of this frame, and the interval from the last one, s.
    """
    frame, doubt, N, metered = usual(measured.frame), design.doubt, design.customers, measured.uses_q
    level = np.concatenate([frame.p_error, frame.q + np.copysign(frame.q_error, frame.q)])
    if any_of(metered):
        level[N:][metered] = np.copysign(frame.q_net_error, frame.q)[metered]
    if doubt.sudden_p is not None:
        # Unknown directions of every frame.
        level[np.tile(doubt.sudden_p > 0.0, 2)] = 0.0
    if frame.p_origin is not None and any_of(frame.p_origin):
        # Not all are `READ`, which is 0. Powers that come back are compared with their last reading.
        read = np.tile(frame.p_origin == PowerOrigin.READ, 2)
        level = np.where(read, level, np.nan if before is None else before.level)
    if before is None:
        return 0.0, Movements(level, np.zeros((2, 2 * N)), metered)
    change = level - before.level
    missing = np.isnan(change)
    if any_of(missing):
        change[missing] = 0.0
    if any_of(metered) or any_of(before.metered):
        change[N:][metered != before.metered] = 0.0
    old = exp(-h / RISE_S) * before.moved
    now = Movements(level, np.maximum(old + change * _SIGNS, 0.0), metered)
    least = sqrt(3.0) * NOTICED
    noticed = now.moved * reach > least
    if design.step_s > SUDDEN_S or not any_of(noticed):
        return 0.0, now
    # The movement in the direction of the change; what was too small to count before counts now.
    counted = np.where(old * reach > least, np.abs(change) * (np.abs(change) + 2.0 * old), now.moved**2)
    gained = (counted * (noticed & (change * _SIGNS > 0.0))).max(axis=0)
    ratio = gained / (3.0 * np.maximum(doubt.own.ravel(), EXACT) ** 2)
    return min(float(ratio.max()), FARTHEST), now


_SIGNS = np.array([[1.0], [-1.0]])


def _powers(
    design: FrontDesign,
    measured: Measurements,
    uncertainty: FrameUncertainty,
    injected: Floats,
    free: Bools,
) -> tuple[list[Floats], Floats]:
    """Directions of powers and injections, none or (n, k), and their factors, (k,)."""
    unsettled, doubt = _unsettled(design, injected, free, measured.uses_q), design.doubt
    if uncertainty.usual and unsettled is None and doubt.sudden_p is None:
        return [], np.zeros(0)
    frame = usual(measured.frame)
    p = _wider(frame.p_error, doubt.smooth_p, uncertainty.p > 1.0, doubt.sudden_p)
    q = _wider(frame.q_error, doubt.smooth_q, uncertainty.q > 1.0, doubt.sudden_q)
    power, columns, factors = np.concatenate([p, q]), list[Floats](), list[Floats]()
    unread = np.tile(unread_powers(design, uncertainty), 2)
    which = indices((power > 0.0) & unread)
    if which.size:
        shared = design.sensitivities.numbered(which) @ power[which]
        columns, factors = [np.sqrt(COMMON_SHARE) * shared[:, None]], [np.array([WIDER])]
        power[which] *= np.sqrt(1.0 - COMMON_SHARE)
    wide = WIDER * power
    if unsettled is not None:
        more, factor = unsettled
        q = power[p.size :]
        power[p.size :], wide[p.size :] = np.hypot(q, more), np.hypot(WIDER * q, factor * more)
    which = indices(power > 0.0)
    if which.size:
        columns.append(design.sensitivities.numbered(which) * power[which])
        factors.append(wide[which] / power[which])
    return columns, np.concatenate([np.zeros(0), *factors])


def _wider(error: Floats, known: Floats, wider: Bools, sudden: Floats | None) -> Floats:
    """Standard deviations of the parts of powers' errors that the model does not contain, (N,), pu.

    error, known: half-widths of the frame, and standard deviations of the model, (N,), pu. They count where
    the frame is wider than the design, and where a part of the power is sudden.
    """
    more = np.maximum(error * error / 3.0 - np.maximum(known, EXACT) ** 2, 0.0)
    return np.where(wider if sudden is None else wider | (sudden > 0.0), np.sqrt(more), 0.0)


def _unsettled(
    design: FrontDesign, injected: Floats, free: Bools, metered: Bools
) -> tuple[Floats, Floats] | None:
    """Standard deviations of injections that are known badly, (N,), pu, and factors on them, (N,); or None.

    Known badly: far less well than the design supposes, or by the estimate.
    """
    droop, N = design.plant.droop, design.customers
    error = droop.per_customer(injected, N) / np.sqrt(3.0)
    usually = design.injections + droop.per_customer(design.mismatch, N)
    far = error > UNSETTLED * np.maximum(usually, EXACT)
    out = far
    if any_of(free):
        out = far | (droop.per_customer(free.astype(np.float64), N) > 0.0)
    out = out & ~metered
    return (np.where(out, error, 0.0), np.where(far, WIDER, FOLLOWS)) if any_of(out) else None


def _clocks(design: FrontDesign, measured: Measurements, skew: ClockSkew | None) -> Floats | None:
    """Directions of meters with a voltage that changes within their clock offset, (p, k); None for none."""
    if skew is None:
        return None
    moved = measured.available & skewed(design, skew)
    if not any_of(moved):
        return None
    return singly(np.where(moved, skew.change, 0.0))


def skewed(design: FrontDesign, skew: ClockSkew) -> Bools:
    """Meters with a voltage that changes within their clock offset by more than noise, (p,)."""
    return np.asarray(skew.change > SKEWED * np.sqrt(design.white))


def singly(std: Floats) -> Floats:
    """Directions of the meters with a standard deviation (p,), one for each, (p, k)."""
    at = np.flatnonzero(std)
    out = np.zeros((std.size, at.size))
    out[at, np.arange(at.size)] = std[at]
    return out


def earlier(design: FrontDesign, skew: ClockSkew | None) -> Floats | None:
    """Deviations by changes of the voltages after a reading; None where no replay is due.

    Parameters
    ----------
    design
        The front end.
    skew
        Changes of the voltages.

    Returns
    -------
    (k, p)
        Standard deviations that the readings before the last one gain, the newest last, squared pu.
    """
    if skew is None or not skew.due:
        return None
    later, known = skew.later[:-1], skew.known[:-1]
    new: Bools = np.asarray((later > LATER * np.sqrt(design.white)) & (later > GROWN * known))
    if not any_of(new):
        return None
    return CLOCKS * np.where(new, later, 0.0)[int(np.flatnonzero(new.any(axis=1))[0]) :]


def estimated(
    noise: Floats, given: Unknown, u: Floats, seen: Bools, *, hidden: bool = False
) -> tuple[Floats, Floats]:
    """Mean and variance of the unknown errors at all places, (n,) each, squared pu and squared pu^2.

    A reading that no known power checks may be false. Let m' and V' be the mean and the variance without all
    of these readings, and m the mean with them: the variance is ``V' + (m - m')^2`` about m. Where meters may
    hide behind powers, m' and V' are those without any knowledge of the powers.

    Parameters
    ----------
    noise : (p, p)
        Covariance of the residuals without the unknown errors, given the means of w and b, squared pu^2.
    given
        The unknown directions.
    u : (p,)
        Residuals less the posterior means of w and b.
    seen : (p,)
        Meters with a reading in use.
    hidden
        No reading narrows the variance of powers and injections.
    """
    mean, variance = regressed(noise, given, u, seen)
    if hidden:
        powers, others = given.places[:, : given.powers], given.places.copy()
        others[:, : given.powers] = 0.0
        other, variance = regressed(noise, replace(given, places=others), u, seen)
        variance = variance + (powers**2).sum(axis=1) + (mean - other) ** 2
    elif any_of(given.unchecked & seen):
        other, variance = regressed(noise, given, u, seen & ~given.unchecked)
        variance = variance + (mean - other) ** 2
    return mean, variance


def regressed(noise: Floats, given: Unknown, u: Floats, seen: Bools) -> tuple[Floats, Floats]:
    """Mean and variance of the unknown errors at all places by the readings of some meters, (n,) each.

    Parameters
    ----------
    noise, given, u
        As in `estimated`.
    seen : (p,)
        The meters.
    """
    n, variance = indices(seen), (given.places**2).sum(axis=1)
    gain, cross = regression(noise, given, n)
    return gain.T @ u[n], np.maximum(variance - (gain * cross).sum(axis=0), 0.0)


def regression(noise: Floats, given: Unknown, n: Ints) -> tuple[Floats, Floats]:
    """Regression ``(A_n A_n' + D_n)^-1 A_n A_x'`` of the unknown errors at all places x, and ``A_n A_x'``.

    Parameters
    ----------
    noise, given
        As in `estimated`.
    n : (k,)
        Meters with a reading in use.

    Returns
    -------
    (k, n) each
    """
    A = given.meters[n]
    cross = A @ given.places.T
    if not n.size:
        return cross, cross
    return cho_solve(cho_factor(submatrix(noise, n, n) + A @ A.T), cross), cross
