"""Attack signals: reported values of a manipulated meter in place of the measured ones.

An attack is a frozen value. It names its meters and its active interval ``[t_on, t_off)``, and `apply` turns
unmanipulated reports into manipulated ones. Time is an argument and no state is kept: an attack that needs
the past (a stuck or a replaying meter) requests it from the caller. So one tick, a whole day at once and a
repetition give the same numbers. Attacks are for simulation; no estimator reads this module.

Voltages are magnitudes per unit of the nominal voltage, as a meter displays them (not squared). Powers are
in the unit of the reports; imports are positive, as on the wire.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import Problem, require

Past: TypeAlias = Callable[[Floats], Floats]
"""Unmanipulated reports of all p meters at earlier times: (T,) s -> (T, p) pu."""

_Bits: TypeAlias = NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class Reports:
    """Reports of p meters at T times."""

    v: Floats  # (T, p): voltage magnitude, pu of nominal
    p: Floats  # (T, p): net active import, kW or pu
    q: Floats  # (T, p): net reactive import, kvar or pu; NaN where it is not reported


@dataclass(frozen=True, slots=True, eq=False)
class _Attack:
    """Common fields of all attacks."""

    meters: Ints  # (k,): indices of the manipulated meters, each once
    # The attack is active while t_on <= t < t_off, Unix s.
    t_on: float
    t_off: float

    def __post_init__(self) -> None:
        _check_meters(self.meters, self.t_on, self.t_off)
        for each in fields(self):
            if each.type == "Floats":
                _check_per_meter(self.meters, each.name, getattr(self, each.name))


@dataclass(frozen=True, slots=True, eq=False)
class Bias(_Attack):
    """Constant bias: v~ = v + size."""

    size: Floats  # (k,): signed displacement, pu


@dataclass(frozen=True, slots=True, eq=False)
class Scaling(_Attack):
    """Scaled reading: v~ = (1 + factor) v."""

    factor: Floats  # (k,): signed relative change, 1


@dataclass(frozen=True, slots=True, eq=False)
class Drift(_Attack):
    """Drifting reading: v~ = v + sign(rate) min(abs(rate) (t - t_on), limit)."""

    rate: Floats  # (k,): signed speed, pu/s
    limit: Floats  # (k,): largest displacement, pu, >= 0

    def __post_init__(self) -> None:
        _Attack.__post_init__(self)
        require(
            not np.any(self.limit < 0.0),
            Problem("negative", "limit of a drift is a magnitude and cannot be negative"),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Stuck(_Attack):
    """Reading frozen at its value at the begin of the attack: v~(t) = v(t_on)."""


@dataclass(frozen=True, slots=True, eq=False)
class Replay(_Attack):
    """Replay of an earlier interval: v~(t) = v(t - delay_s)."""

    delay_s: float  # delay of the replayed interval, s, > 0

    def __post_init__(self) -> None:
        _Attack.__post_init__(self)
        require(
            self.delay_s > 0.0,
            Problem("not-positive", f"a replay needs a positive delay, got {self.delay_s}"),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Random(_Attack):
    """Random displacement, redrawn every `hold_s`: v~ = v + s u with s = +-1 and low <= u <= high."""

    # (k,): smallest and largest magnitude of the displacement, pu.
    low: Floats
    high: Floats
    hold_s: float  # duration of one draw, s, > 0
    seed: int  # seed of the draws

    def __post_init__(self) -> None:
        _Attack.__post_init__(self)
        ordered = not (np.any(self.low < 0.0) or np.any(self.high < self.low))
        require(ordered, Problem("order", "a random attack needs 0 <= low <= high for every meter"))
        held = self.hold_s > 0.0
        require(
            held, Problem("not-positive", f"a random attack needs a positive hold time, got {self.hold_s}")
        )


@dataclass(frozen=True, slots=True, eq=False)
class Coordinated(_Attack):
    """Consistent displacement of several meters: the voltage pattern of a load that does not exist.

    ``v~ = v + shift``, ``p~ = p + p_shift``, ``q~ = q + q_shift``. `coordinate` sizes the pattern.
    """

    shift: Floats  # (k,): signed displacement of the voltage, pu; negative for a fake load
    # (k,): displacement of the reported import, unit of the reports; zero if only voltages are manipulated.
    p_shift: Floats
    q_shift: Floats


Attack: TypeAlias = Bias | Scaling | Drift | Stuck | Replay | Random | Coordinated


@dataclass(frozen=True, slots=True, eq=False)
class InverterAttack:
    """Injection `x + q` of inverters in place of the droop curve's x: a_u of yang2021 (1)."""

    inverters: Ints  # (k,): indices of the manipulated inverters, each once
    q: Floats  # (k,): additional injection of each, pu
    # Active while t_on <= t < t_off, Unix s.
    t_on: float
    t_off: float

    def __post_init__(self) -> None:
        _check_meters(self.inverters, self.t_on, self.t_off, what="inverters")
        require(
            self.q.shape == self.inverters.shape and np.all(np.isfinite(self.q)),
            Problem(
                "shape", f"q has shape {self.q.shape} or is not finite; one number per inverter is needed"
            ),
        )


def apply(attack: Attack, t: Floats, honest: Reports, past: Past) -> Reports:
    """Replace the reports (T, p) of `attack.meters` at times t (T,), Unix s, inside [t_on, t_off).

    `past` gives unmanipulated voltage reports at earlier times, pu. It is called for `Stuck` and `Replay`
    only, never for a time after the newest of `t`.
    """
    rows = np.flatnonzero(active(attack, t))
    if rows.size == 0:
        return honest
    cells = np.ix_(rows, attack.meters)
    v = honest.v.copy()
    v[cells] = _voltage(attack, t[rows], honest.v[cells], past)
    if not isinstance(attack, Coordinated):
        return replace(honest, v=v)
    p, q = honest.p.copy(), honest.q.copy()
    p[cells] += attack.p_shift
    q[cells] += attack.q_shift  # NaN stays NaN: a meter without reported q gets none
    return Reports(v=v, p=p, q=q)


def apply_all(attacks: Sequence[Attack], t: Floats, honest: Reports, past: Past) -> Reports:
    """Apply several attacks to reports, in their order; see `apply`."""
    reports = honest
    for attack in attacks:
        reports = apply(attack, t, reports, past)
    return reports


def active(attack: Attack, t: Floats) -> Bools:
    """Mask of the times (T,) at which the attack is active: t_on <= t < t_off."""
    return (t >= attack.t_on) & (t < attack.t_off)


def manipulated(attacks: Sequence[Attack], t: Floats, meters: int) -> Bools:
    """Mask (T, p) of the manipulated meters at times t (T,), Unix s, displaced or not."""
    out = np.zeros((t.size, meters), dtype=np.bool_)
    for attack in attacks:
        out[np.ix_(active(attack, t), attack.meters)] = True
    return out


def reach(attack: Attack, t: float) -> float:
    """Time span into the past that the attack needs at time t, s; 0 for attacks without memory."""
    match attack:
        case Stuck():
            return max(t - attack.t_on, 0.0)
        case Replay():
            return attack.delay_s
        case _:
            return 0.0


def load_pattern(R: Floats, X: Floats, target: int, ratio: float, v: Floats) -> Floats:
    """Voltage change (N,) at every customer per pu of extra load at customer `target`, to first order.

    From v^2 = v0^2 + 2 R p + 2 X q with a load P + j ratio P at customer k: dv_i / dP = -(R_ik + ratio X_ik)
    / v_i. R and X (N, N) are the shared path resistance and reactance of LinDistFlow, v (N,) the present
    voltage, pu.
    """
    return -(R[:, target] + ratio * X[:, target]) / v


def most_affected(pattern: Floats, count: int) -> Ints:
    """The `count` entries of largest magnitude, ascending by index; ties go to the lower index."""
    require(
        0 < count <= pattern.size, Problem("out-of-range", f"cannot choose {count} of {pattern.size} meters")
    )
    order = np.argsort(-np.abs(pattern), kind="stable")
    return np.sort(order[:count])


def coordinate(pattern: Floats, meters: Ints, size: float) -> float:
    """Scale ``size / min_j |pattern_j|`` that displaces the least affected chosen meter by `size` pu.

    `pattern` (p,) is the voltage change at each meter per unit of the fake quantity, pu. A chosen meter
    without any effect is a ValueError.
    """
    weakest = float(np.min(np.abs(pattern[meters])))
    require(weakest > 0.0, Problem("no-effect", "a chosen meter is not affected by the fake load at all"))
    return size / weakest


def _voltage(attack: Attack, t: Floats, v: Floats, past: Past) -> Floats:
    """Reported voltage (T, k) of the attack's meters while active, from the unmanipulated one (T, k)."""
    lie: Floats
    match attack:
        case Bias():
            lie = v + attack.size
        case Scaling():
            lie = v * (1.0 + attack.factor)
        case Drift():
            grown = np.abs(attack.rate) * (t - attack.t_on)[:, None]
            lie = v + np.sign(attack.rate) * np.minimum(grown, attack.limit)
        case Stuck():
            lie = np.broadcast_to(past(np.array([attack.t_on]))[:, attack.meters], v.shape)
        case Replay():
            lie = past(t - attack.delay_s)[:, attack.meters]
        case Random():
            lie = v + _random(attack, t)
        case Coordinated():
            lie = v + attack.shift
    return lie


def _random(attack: Random, t: Floats) -> Floats:
    """Displacement (T, k) of a random attack."""
    draw = np.floor((t - attack.t_on) / attack.hold_s).astype(np.uint64)[:, None]
    meter = attack.meters.astype(np.uint64)[None, :]
    # A hash of (seed, meter, draw) in place of a generator: any time interval can be computed in any order
    # and any chunks, with the same numbers.
    start = np.full((1, 1), attack.seed % 2**64, dtype=np.uint64)
    bits = _scramble(_scramble(_scramble(start) ^ meter) ^ draw)
    sign = np.where(bits & np.uint64(1), 1.0, -1.0)
    fraction = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return sign * (attack.low + (attack.high - attack.low) * fraction)


def _scramble(bits: _Bits) -> _Bits:
    """Mix 64 bits: the output function of the SplitMix64 generator, arithmetic modulo 2^64.

    Source: G. L. Steele, D. Lea, C. H. Flood: Fast splittable pseudorandom number generators. OOPSLA 2014,
        figure 16 (constants of Stafford's variant 13).
    """
    z = bits + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def _check_meters(meters: Ints, t_on: float, t_off: float, *, what: str = "meters") -> None:
    one_each = meters.ndim == 1 and meters.size > 0
    require(one_each, Problem("shape", f"an attack needs a one-dimensional, non-empty array of {what}"))
    known = np.all(meters >= 0)
    require(
        known and np.unique(meters).size == meters.size,
        Problem(
            "duplicate" if known else "unknown-index",
            f"{what} of an attack must be different indices from 0, got {meters.tolist()}",
        ),
    )
    require(
        t_on < t_off,
        Problem("order", f"an attack must begin before it ends, got t_on={t_on} and t_off={t_off}"),
    )


def _check_per_meter(meters: Ints, name: str, value: Floats) -> None:
    same = value.shape == meters.shape
    require(same, Problem("shape", f"{name} has shape {value.shape}, but there are {meters.size} meters"))
    require(np.all(np.isfinite(value)), Problem("not-finite", f"{name} must be finite"))
