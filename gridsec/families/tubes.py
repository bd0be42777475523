"""Intervals of unmanipulated inverters' injections under any attack: the observers of `unknown_input`.

An inverter follows ``tau x' = -x + K(z)`` with K non-decreasing, so that an interval for z over a step gives
one for x after it:

    x in [keep low + (1 - keep) K(z_low), keep high + (1 - keep) K(z_high)],    keep = exp(-h / tau)

for any h, without an integrator, a gain or a certificate. Every inverter has two such intervals: `driven` by
the customer's own meter, valid while that meter is unmanipulated, and `free` of it, from the feeder model,
always valid.

References
----------
yang2021 (2) and (17), with zero innovation under direct injection; docs/theory-unknown-input.md, 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.detect import ErrorModel, largest


@dataclass(frozen=True, slots=True, eq=False)
class Tube:
    """Intervals [low, high] of m inverters, (m,) each."""

    low: Floats
    high: Floats

    @property
    def middle(self) -> Floats:
        """Centres; (m,)."""
        return np.asarray(0.5 * (self.low + self.high))

    @property
    def half(self) -> Floats:
        """Half-widths; (m,)."""
        return np.asarray(0.5 * (self.high - self.low))

    def hull(self, other: Tube) -> Tube:
        """Hull of these and the other intervals."""
        return Tube(np.minimum(self.low, other.low), np.maximum(self.high, other.high))

    def where(self, this: Bools, other: Tube) -> Tube:
        """These intervals where `this` (m,) is True, the others elsewhere."""
        return Tube(np.where(this, self.low, other.low), np.where(this, self.high, other.high))


@dataclass(frozen=True, slots=True, eq=False)
class Tubes:
    """Intervals of unmanipulated inverters at one tick.

    Attributes
    ----------
    driven, free : Tube
        Their injections if their own meter is unmanipulated, and in any case, pu.
    z_driven, z_free : Tube
        The same of `vbar^2 - v^2` at their customers, squared pu.
    metered : (m,)
        Inverters with a reading of their own meter; elsewhere `driven` is `free`.
    """

    driven: Tube
    free: Tube
    z_driven: Tube
    z_free: Tube
    metered: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One tick at the places of inverters. m inverters, p meters.

    Attributes
    ----------
    z : (m,)
        By the own meters; arbitrary where not metered.
    z_error : (m,)
        Error of an unmanipulated meter.
    metered : (m,)
        Inverters with a reading of their own meter.
    rest, rest_error : (m,)
        `vbar^2 - v^2` without any inverter, and its error.
    """

    z: Floats
    z_error: Floats
    metered: Bools
    rest: Floats
    rest_error: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """Assumed number and size of attacks.

    Attributes
    ----------
    meters, inverters
        Largest numbers of simultaneous attacks.
    reach : (m,)
        Largest injection of an attacked inverter: its rating, pu.
    coupling : (m, m)
        2X between the inverters' customers.
    """

    meters: int
    inverters: int
    reach: Floats
    coupling: Floats


def saturated(errors: ErrorModel) -> Tube:
    """Intervals between the ends of the curves, valid for all unmanipulated inverters."""
    return Tube(errors.droop.q[:, 3].copy(), errors.droop.q[:, 0].copy())


def spread(errors: ErrorModel, doubt: Doubt, known: Tube, free: Tube, gain: Floats) -> Floats:
    """Largest distance of voltages from those with the middle injections, under any attack; (r,).

    Unmanipulated inverters are in `known`; those of the worst M meters in `free`; the worst of all inverters
    inject up to their rating.

    Parameters
    ----------
    known, free
        Intervals of all inverters if their own meters are unmanipulated, and in any case.
    gain : (r, m)
        |2X| from inverters to the r voltages.
    """
    swing = np.maximum(free.high - known.middle, known.middle - free.low) - known.half
    far = doubt.reach + np.abs(known.middle) - known.half
    p = errors.meters.size
    group = np.zeros((gain.shape[1], p))
    driven = errors.meter_of >= 0
    group[np.flatnonzero(driven), errors.meter_of[driven]] = 1.0
    by_meter = (gain * np.maximum(swing, 0.0)) @ group
    return np.asarray(
        gain @ known.half
        + largest(by_meter, doubt.meters)
        + largest(gain * np.maximum(far, 0.0), doubt.inverters)
    )


# Every round gives a valid interval; more rounds only narrow it.
_ROUNDS = 4


def advance(errors: ErrorModel, doubt: Doubt, before: Tubes | None, seen: Seen, h: float) -> Tubes:
    """Intervals after a step.

    Voltages between two ticks are assumed within the extremes of their intervals at both.

    Parameters
    ----------
    before
        Intervals of the last tick; None at the first one, with inverters anywhere on their curves.
    h
        Length of the step, s.
    """
    z_own = Tube(seen.z - seen.z_error, seen.z + seen.z_error)
    driven = free = saturated(errors)
    if before is None:
        known = _z_free(errors, doubt, seen, free, free)
        return Tubes(driven, free, z_own.where(seen.metered, known), known, seen.metered)
    # An inverter without a reading at either end of the step is not driven over it.
    both = seen.metered & before.metered
    z_free = before.z_free
    for _ in range(_ROUNDS):
        known = driven.where(seen.metered, free)
        z_free = _z_free(errors, doubt, seen, known, free)
        free = _follow(errors, before.free, before.z_free.hull(z_free), h)
        held = before.z_driven.hull(z_own).where(both, before.z_free.hull(z_free))
        driven = _follow(errors, before.driven, held, h)
    return Tubes(driven, free, z_own.where(seen.metered, z_free), z_free, seen.metered)


def _z_free(errors: ErrorModel, doubt: Doubt, seen: Seen, known: Tube, free: Tube) -> Tube:
    """`z = rest - 2X x` at the inverters' customers, without their own meters."""
    z = seen.rest - doubt.coupling @ known.middle
    wide = seen.rest_error + spread(errors, doubt, known, free, errors.inverters_own)
    return Tube(z - wide, z + wide)


def _follow(errors: ErrorModel, x: Tube, z: Tube, h: float) -> Tube:
    droop = errors.droop
    keep, (low, high) = np.exp(-h / droop.tau), droop(np.stack([z.low, z.high]))
    low = np.maximum(low - errors.mismatch, droop.q[:, 3])
    high = np.minimum(high + errors.mismatch, droop.q[:, 0])
    return Tube(keep * x.low + (1.0 - keep) * low, keep * x.high + (1.0 - keep) * high)
