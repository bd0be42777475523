"""Devices of customers: droop inverters with their curves, and voltage meters with their accuracy.

An inverter injects reactive power by a piecewise linear curve with four breakpoints and saturation at both
ends. Inverters measure v, so their curve is linear in v between the breakpoints (`voltage_curve`). The model
runs on `z = vbar^2 - v^2`, where the curve K of chong2020 (17) is linear between the *mapped* breakpoints
(`Droop.__call__`). The two agree at the breakpoints; docs/theory-model.md bounds the difference between them.

Source: chong2020, equations (16) to (18). In (18) the slope restriction needs the larger of the two slopes,
not the smaller one. IEC 62053 for accuracy classes of meters; docs/theory-detection.md for the largest error
of a consistent reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import log

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen, frozen_ints, put
from gridsec.errors import FeederInvalid, Problem, raise_if_any, wrong_shapes


@dataclass(frozen=True, slots=True, eq=False)
class Droop:
    """A fleet of m droop inverters, `tau_i dx_i/dt = -x_i + K_i(z_i)`.

    K_i is piecewise linear and non-decreasing in z, constant outside the outer breakpoints, with slope
    in `[0, slope_i]`. Calling the object evaluates K.

    Raises FeederInvalid with every problem found.
    """

    customer: Ints  # (m,) customer of each inverter
    v: Floats  # (m, 4) breakpoints of the voltage, ascending, pu
    q: Floats  # (m, 4) reactive injection at the breakpoints, non-increasing, pu of the feeder's base
    tau: Floats  # (m,) first-order time constant, s
    vbar: float = 1.0  # reference voltage, pu; `z = vbar^2 - v^2`
    # (m,), or one number for all: largest injection of an inverter that does not follow its curve: its rated
    # apparent power, pu of the feeder's base; infinite where not stated
    rating: Floats = field(default_factory=lambda: np.array(np.inf))
    # (m,) largest slope of K, the d of chong2020 (18) as corrected
    slope: Floats = field(init=False, repr=False)
    limit: Floats = field(init=False, repr=False)  # (m,) largest `|q|`, the saturation limit
    # Ramp k of z is slope[k] * (clip(z, low[k], high[k]) - low_or_high[k]); see `_ramps`.
    _ramps: tuple[_Ramp, ...] = field(init=False, repr=False)
    _offset: Floats = field(init=False, repr=False)
    _shifted: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        put(self, customer=frozen_ints(self.customer))
        put(self, v=frozen(self.v), q=frozen(self.q), tau=frozen(self.tau))
        rating = np.asarray(self.rating, dtype=np.float64)
        put(self, rating=frozen(rating if rating.ndim else np.full(self.tau.shape, rating)))
        problems = _problems(self)
        if problems:
            raise FeederInvalid(problems)
        ramps, offset = _ramps(self.vbar**2 - self.v**2, self.q)
        steepest = np.zeros(self.tau.shape)
        for ramp in ramps:
            np.maximum(steepest, ramp.slope, out=steepest)
        put(self, _ramps=tuple(ramp.compact() for ramp in ramps), _offset=_compact(offset))
        put(self, _shifted=bool(np.any(offset)), slope=frozen(steepest))
        put(self, limit=frozen(np.max(np.abs(self.q), axis=1, initial=0.0)))

    def __call__(self, z: Floats, rows: Ints | None = None) -> Floats:
        """K(z), chong2020 (17): reactive set-points of the inverters.

        z (…, m), or the shape of `rows`: `vbar^2 - v^2` at each inverter, pu.
        rows (…): inverter of each entry of `z`; by default the last axis of `z` runs over all inverters.
        """
        total: Floats | None = None
        for ramp in self._ramps:
            part = np.maximum(z, _pick(ramp.low, rows))
            np.minimum(part, _pick(ramp.high, rows), out=part)
            part -= _pick(ramp.zero, rows)
            part *= _pick(ramp.slope, rows)
            total = part if total is None else np.add(total, part, out=total)
        if total is None:
            total = np.zeros(np.shape(z))
        if self._shifted:
            total += _pick(self._offset, rows)
        return total

    @property
    def span(self) -> Floats:
        """Distance between the saturated values of each curve, (m,) in pu."""
        return np.asarray(self.q[:, 0] - self.q[:, 3])

    def per_customer(self, of_inverters: Floats, customers: int) -> Floats:
        """Sums of values (m,) of the inverters over the inverters of each of N customers, (N,)."""
        return np.asarray(np.bincount(self.customer, weights=of_inverters, minlength=customers), np.float64)

    def saturated(self, customers: int) -> tuple[Floats, Floats]:
        """Smallest and largest total injection of each customer's inverters, (N,) each, in pu."""
        return self.per_customer(self.q[:, 3], customers), self.per_customer(self.q[:, 0], customers)

    def take(self, rows: Ints) -> Droop:
        """The droop of the inverters `rows` (k,), in that order and with repetitions."""
        # Derived and checked values of the fleet hold for any selection.
        out: Droop = object.__new__(Droop)
        own = {name: getattr(self, name)[rows] for name in ("v", "q", "tau", "rating", "slope", "limit")}
        ramps = tuple(ramp.take(rows) for ramp in self._ramps)
        put(out, customer=frozen_ints(self.customer[rows]), vbar=self.vbar, _ramps=ramps)
        put(out, **{name: frozen(values) for name, values in own.items()})
        put(out, _offset=_compact(_pick(self._offset, rows)))
        put(out, _shifted=bool(np.any(out._offset)))
        return out


@dataclass(frozen=True, slots=True, eq=False)
class _Ramp:
    """`slope (clip(z, low, high) - zero)`, one for each inverter; `zero` is `low` or `high`."""

    low: Floats
    high: Floats
    zero: Floats
    slope: Floats

    def take(self, rows: Ints) -> _Ramp:
        return _Ramp(*(frozen(_pick(part, rows)) for part in (self.low, self.high, self.zero, self.slope)))

    def compact(self) -> _Ramp:
        return _Ramp(_compact(self.low), _compact(self.high), _compact(self.zero), _compact(self.slope))


def _compact(values: Floats) -> Floats:
    """One entry for m equal ones; a gathered evaluation then skips the gather."""
    if values.size > 1 and np.all(values == values[0]):
        return frozen(values[:1])
    return frozen(values)


def _pick(values: Floats, rows: Ints | None) -> Floats:
    return values if rows is None or values.size == 1 else np.asarray(values[rows])


def _ramps(z: Floats, q: Floats) -> tuple[list[_Ramp], Floats]:
    """Ramps with sum K, and the value of K between its two middle breakpoints."""
    # (upper breakpoint, lower breakpoint, zero of the ramp): injecting, middle, absorbing.
    ramps = []
    for left, right, zero in ((0, 1, 1), (1, 2, 2), (2, 3, 2)):
        rise = q[:, left] - q[:, right]
        if not rise.any():
            continue
        width = z[:, left] - z[:, right]
        slope = np.divide(rise, width, out=np.zeros_like(rise), where=rise > 0)
        ramps.append(_Ramp(low=z[:, right], high=z[:, left], zero=z[:, zero], slope=slope))
    return ramps, q[:, 2]


def _problems(droop: Droop) -> list[Problem]:
    """Problems of the fields of `droop`."""
    count = droop.customer.size
    out = wrong_shapes(
        ("droop: v", droop.v.shape, (count, 4)),
        ("droop: q", droop.q.shape, (count, 4)),
        ("droop: tau", droop.tau.shape, (count,)),
        ("droop: rating", droop.rating.shape, (count,)),
    )
    if out:
        return out
    if not (np.isfinite(droop.vbar) and droop.vbar > 0):
        out.append(Problem("not-positive", f"droop: vbar is {droop.vbar}; it must be a positive number"))
    for wrong, text in _row_problems(droop):
        for i in np.flatnonzero(wrong):
            given = f"v {droop.v[i].tolist()}, q {droop.q[i].tolist()}, tau {droop.tau[i]} s"
            out.append(Problem(text.code, f"inverter {i}: {text}; {given}"))
    if np.any(droop.customer < 0):
        out.append(Problem("unknown-index", "droop: a customer index is negative"))
    return out


def _row_problems(droop: Droop) -> tuple[tuple[Bools, Problem], ...]:
    """Masks of inverters with wrong breakpoints, time constants or ratings, each with its problem."""
    v, q, tau = droop.v, droop.q, droop.tau
    most = np.abs(q).max(axis=1, initial=0.0)
    finite = np.all(np.isfinite(v), axis=1) & np.all(np.isfinite(q), axis=1)
    # Infinite entries are reported as such, and not again for their differences.
    steps = np.diff(np.where(finite[:, None], v, 1.0), axis=1)
    falls = np.diff(np.where(finite[:, None], q, 0.0), axis=1)
    return (
        (~finite, Problem("not-finite", "breakpoints must be finite")),
        (
            finite & ((v[:, 0] <= 0) | np.any(steps < 0, axis=1)),
            Problem("order", "voltages must be positive and ascending"),
        ),
        (
            np.any(falls > 0, axis=1),
            Problem("not-monotone", "reactive power must not increase with the voltage"),
        ),
        (
            np.any((steps == 0) & (falls < 0), axis=1),
            Problem("not-monotone", "reactive power jumps where two voltages are equal"),
        ),
        (~(np.isfinite(tau) & (tau > 0)), Problem("not-positive", "time constant must be positive")),
        (
            finite & ~(droop.rating >= most),
            Problem("above-rating", "the curve asks for more than the rating"),
        ),
    )


@dataclass(frozen=True, slots=True)
class DroopCurve:
    """Preset curve in the units of standards."""

    name: str
    v: tuple[float, float, float, float]  # breakpoints of the voltage, pu of nominal
    q: tuple[float, float, float, float]  # reactive injection, fraction of the rated apparent power
    tau: float  # time constant of the first-order response, s
    source: str  # Source of the numbers


def _volts(*volts: float) -> tuple[float, float, float, float]:
    """Voltages in pu from volts of a 230 V system, as in AS/NZS 4777.2."""
    a, b, c, d = volts
    return (a / 230.0, b / 230.0, c / 230.0, d / 230.0)


# A first-order response reaches 90 % of its final value, the 'open loop response time' of IEEE 1547,
# after tau ln 10.
_NINETY_PERCENT = log(10.0)
# VDE-AR-N 4105 requires a PT1 with 3 tau = 10 s. AS/NZS 4777.2 requires the complete response within 10 s;
# 'complete' is read as the same 95 %.
_THREE_TAU = 3.0

_1547 = "pyUL1741SB (IEEE 1547.1-2020, tables 25 to 27, characteristic 1) and CIMHub's OpenDSS models"
_4777 = "DR_AS-NZS-Scripts of CSIRO and CanmetENERGY, written against the 2020 draft"
_4105 = (
    "Sungrow SH10T manual (first three voltages), pandapower and SIMONA test curves (fourth), SolaX manuals "
    "(limits); time constant from memory"
)

_CURVES = (
    DroopCurve(
        "ieee1547-a", (0.90, 1.00, 1.00, 1.10), (0.25, 0.0, 0.0, -0.25), 10.0 / _NINETY_PERCENT, _1547
    ),
    DroopCurve("ieee1547-b", (0.92, 0.98, 1.02, 1.08), (0.44, 0.0, 0.0, -0.44), 5.0 / _NINETY_PERCENT, _1547),
    DroopCurve("asnzs4777-a", _volts(207, 220, 240, 258), (0.44, 0.0, 0.0, -0.60), 10.0 / _THREE_TAU, _4777),
    DroopCurve("asnzs4777-b", _volts(205, 220, 235, 255), (0.30, 0.0, 0.0, -0.40), 10.0 / _THREE_TAU, _4777),
    DroopCurve("asnzs4777-c", _volts(215, 230, 240, 255), (0.44, 0.0, 0.0, -0.60), 10.0 / _THREE_TAU, _4777),
    DroopCurve("vde4105", (0.93, 0.97, 1.03, 1.07), (0.436, 0.0, 0.0, -0.436), 10.0 / _THREE_TAU, _4105),
    DroopCurve(
        "vde4105-small", (0.93, 0.97, 1.03, 1.07), (0.312, 0.0, 0.0, -0.312), 10.0 / _THREE_TAU, _4105
    ),
)

PRESETS: tuple[str, ...] = tuple(curve.name for curve in _CURVES)


def preset(name: str) -> DroopCurve:
    """Default curve of a standard by name.

    The numbers come from secondary sources, listed in `DroopCurve.source`, not from the standards themselves.
    `vde4105` is for inverters above 4.6 kVA, `vde4105-small` for the others. Open-loop response times T (90
    %) become `tau = T / ln 10`; a PT1 of 10 s in VDE-AR-N 4105 means `3 tau = 10 s`; AS/NZS 4777.2 requires
    the complete response within 10 s, read here as 95 %, the same `3 tau = 10 s`.

    Raises FeederInvalid if `name` is not a preset.
    """
    for curve in _CURVES:
        if curve.name == name:
            return curve
    raise FeederInvalid(
        [Problem("unknown-name", f"droop preset {name!r} does not exist; there are {', '.join(PRESETS)}")]
    )


def fleet(
    customer: Ints,
    names: str | Sequence[str],
    rated_kva: Floats,
    base_kva: float,
    *,
    tau: Floats | None = None,
    capability: str = "fixed",
    p_gen: Floats | None = None,
    vbar: float = 1.0,
) -> Droop:
    """Fleet of inverters with standard curves.

    rated_kva (m,): rated apparent power s, kVA.
    tau (m,): time constants, s; those of the presets for NaN or without the array.
    capability: `fixed`: limits of the preset. `circular`: the output is capped at `sqrt(s^2 - p_gen^2)`,
        chong2020 after (17); the slopes stay.
    p_gen (m,): active power that each inverter generates, pu of the feeder's base; required for `circular`.
    Raises FeederInvalid if a preset does not exist, a rating is not positive, or an inverter generates above
        its rating.
    """
    index = frozen_ints(customer)
    rated = np.asarray(rated_kva, dtype=np.float64)
    each = [names] * index.size if isinstance(names, str) else list(names)
    if len(each) != index.size or rated.shape != index.shape:
        raise FeederInvalid(
            [
                Problem(
                    "shape",
                    f"{index.size} inverters, {len(each)} presets, {rated.size} ratings: lengths differ",
                )
            ]
        )
    if not np.all(np.isfinite(rated) & (rated > 0)):
        raise FeederInvalid(
            [Problem("not-positive", "rated apparent power of every inverter must be positive, in kVA")]
        )
    curves = [preset(name) for name in each]
    v = np.array([curve.v for curve in curves], dtype=np.float64).reshape(index.size, 4)
    q = np.array([curve.q for curve in curves], dtype=np.float64).reshape(index.size, 4)
    own = np.array([curve.tau for curve in curves], dtype=np.float64)
    if tau is not None:
        given = np.asarray(tau, dtype=np.float64)
        own = np.where(np.isnan(given), own, given)
    rating = rated / base_kva
    droop = Droop(index, v, q * rating[:, None], own, vbar, rating)
    if capability == "fixed":
        return droop
    if capability != "circular" or p_gen is None:
        raise FeederInvalid(
            [
                Problem(
                    "missing" if capability == "circular" else "unknown-name",
                    f"capability {capability!r} must be 'fixed', or 'circular' together with p_gen",
                )
            ]
        )
    headroom = rating**2 - np.asarray(p_gen, dtype=np.float64) ** 2
    if not np.all(headroom >= 0):
        raise FeederInvalid(
            [
                Problem("above-rating", f"inverter {i} generates above its rating")
                for i in np.flatnonzero(~(headroom >= 0))
            ]
        )
    return capped(droop, np.sqrt(headroom))


def capped(droop: Droop, limit: Floats) -> Droop:
    """The same fleet with capped `|q|`; the curve keeps its slopes in v and saturates earlier.

    limit (m,): largest `|q|` of each inverter, pu, not negative.
    """
    v, q = droop.v.copy(), np.clip(droop.q, -limit[:, None], limit[:, None])
    # Breakpoints 0 and 3 move inwards to the intersection of the outer ramps with the cap.
    for outer, inner in ((0, 1), (3, 2)):
        rise = droop.q[:, outer] - droop.q[:, inner]
        kept = q[:, outer] - q[:, inner]
        share = np.divide(kept, rise, out=np.ones_like(rise), where=rise != 0)
        v[:, outer] = droop.v[:, inner] + share * (droop.v[:, outer] - droop.v[:, inner])
    return replace(droop, v=v, q=q)


def voltage_curve(droop: Droop, v: Floats) -> Floats:
    """Reactive set-points of real inverters: curves piecewise linear in the voltage.

    v (…, m): voltage at each inverter, pu.
    Returns (…, m): reactive set-points, pu of the feeder's base.
    """
    # The same ramps with -v in the place of z: descending breakpoints, non-decreasing curve.
    ramps, offset = _ramps(-droop.v, droop.q)
    total = np.zeros(np.shape(v)) + offset
    for ramp in ramps:
        total += ramp.slope * (np.clip(-v, ramp.low, ramp.high) - ramp.zero)
    return total


# --- Meters ---


@dataclass(frozen=True, slots=True, eq=False)
class MeterAccuracy:
    """Accuracy of the voltage meters by their data sheets. p meters.

    A reading is ``v (1 + c) + r + n`` with a fixed unknown relative bias ``|c| <= class_fraction``,
    rounding ``|r| <= resolution / 2`` and white jitter ``n`` of standard deviation ``jitter``.

    Raises ValueError with every problem found.
    """

    class_fraction: Floats  # (p,) accuracy class as a fraction of the reading: 0.005 for class 0.5
    resolution: Floats  # (p,) step of the register, pu of the nominal voltage
    jitter: Floats  # (p,) standard deviation from one reading to the next, pu of the nominal voltage
    busbar_class: float  # class of the busbar meter, fraction of the reading
    busbar_resolution: float  # its resolution, pu
    busbar_jitter: float  # its jitter, pu

    def __post_init__(self) -> None:
        """Check shapes and signs; a wrong description is a programming error, not an online outcome."""
        p, problems = np.shape(self.class_fraction), []
        for name in ("class_fraction", "resolution", "jitter"):
            value = frozen(getattr(self, name))
            put(self, **{name: value})
            if value.ndim != 1 or value.shape != p:
                problems.append(
                    Problem("shape", f"{name} must have one entry per meter, got shape {value.shape}")
                )
            if not (np.isfinite(value).all() and (value >= 0).all()):
                problems.append(Problem("negative", f"{name} must be finite and not negative"))
        for name in ("busbar_class", "busbar_resolution", "busbar_jitter"):
            number = float(getattr(self, name))
            if not (np.isfinite(number) and number >= 0):
                problems.append(Problem("negative", f"{name} must be finite and not negative, got {number}"))
        raise_if_any(problems)


def steady_rounding(accuracy: MeterAccuracy) -> Floats:
    """Largest rounding error that persists while the voltage is constant and that jitter does not average.

    To steps D, ``round(x) - x`` is ``sum_k (-1)^k D / (pi k) sin(2 pi k x / D)``; in the mean over jitter of
    standard deviation s its k-th harmonic shrinks by ``exp(-2 pi^2 k^2 s^2 / D^2)``. So the error is at most
    ``D / pi sum_k exp(-2 pi^2 k^2 s^2 / D^2) / k``, and never more than half a step.

    Returns (p,): bounds, pu of the nominal voltage; at the level of floating-point rounding for 0.1 V and
        0.05 %.
    """
    step = accuracy.resolution
    ratio = accuracy.jitter / np.where(step > 0.0, step, 1.0)
    # Where further harmonics matter, the sum exceeds half a step anyway.
    k = np.arange(1.0, 13.0)
    harmonics = (np.exp(-2.0 * (np.pi * np.multiply.outer(ratio, k)) ** 2) / (np.pi * k)).sum(axis=-1)
    return np.asarray(step * np.minimum(0.5, harmonics))


def reading_error(accuracy: MeterAccuracy, v2: Floats, sigmas: float) -> Floats:
    """Largest error of a squared reading without manipulation, per meter.

    `(v + e)^2 - v^2 = 2 v e + e^2` with `e = class v + resolution / 2 + sigmas jitter`.

    v2 (p,): largest possible squared voltage at the meter, pu.
    sigmas: jitter allowance in standard deviations.
    Returns (p,): bounds, squared pu.
    """
    v = np.sqrt(np.maximum(v2, 0.0))
    e = accuracy.class_fraction * v + 0.5 * accuracy.resolution + sigmas * accuracy.jitter
    return np.asarray(e * (2.0 * v + e))


def busbar_error(accuracy: MeterAccuracy, v0_squared: float, sigmas: float) -> float:
    """Largest error of the squared busbar voltage without manipulation.

    The class is relative to the true voltage, and only the reading r is known: `r = v (1 + c) + n` gives
    `|r - v| = |c r + n| / (1 + c) <= e = (class |r| + resolution / 2 + sigmas jitter) / (1 - class)`,
    and `|r^2 - v^2| <= e (2 r + e)`.

    v0_squared: squared reading, pu.
    """
    if accuracy.busbar_class >= 1.0:
        return float("inf")  # no bound from a class of 100 % or more
    v = float(np.sqrt(max(v0_squared, 0.0)))
    e = accuracy.busbar_class * v + 0.5 * accuracy.busbar_resolution + sigmas * accuracy.busbar_jitter
    e /= 1.0 - accuracy.busbar_class
    return e * (2.0 * v + e)


def told_error(accuracy: MeterAccuracy, y: Floats, sigmas: float) -> Floats:
    """Largest distance of the true voltage from a squared reading, per meter; compare `busbar_error`.

    y (p,): squared readings, pu.
    Returns (p,): bounds, squared pu; larger than any voltage for a class of 100 % or more.
    """
    return ToldError.over(accuracy, np.arange(y.size), sigmas).of(y)


# Voltage error assumed for an accuracy class of 100 % or more, pu.
_NOTHING = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class ToldError:
    """Bound of the true voltage around readings, prepared for repeated use; k meters."""

    # slope, floor (k,): voltage error in pu: `slope v + floor` for a reading v
    slope: Floats
    floor: Floats

    @classmethod
    def over(cls, accuracy: MeterAccuracy, which: Ints, sigmas: float) -> ToldError:
        """Prepare the bound for a selection of meters.

        which (k,): indices of meters; repetitions allowed.
        """
        part = accuracy.class_fraction[which]
        even = 0.5 * accuracy.resolution[which] + sigmas * accuracy.jitter[which]
        told = part < 1.0
        rest = np.where(told, 1.0 - part, 1.0)
        return cls(np.where(told, part / rest, 0.0), np.where(told, even / rest, _NOTHING))

    def of(self, y: Floats) -> Floats:
        """Bounds, squared pu, for squared readings `y` (k,), pu."""
        v = np.sqrt(np.maximum(y, 0.0))
        e = self.slope * v + self.floor
        return np.asarray(e * (2.0 * v + e))
