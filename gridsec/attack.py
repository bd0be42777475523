"""Attack signals: what a manipulated meter reports instead of what it measured.

An attack is a frozen value. It names its meters and the interval ``[t_on, t_off)`` in which it lies, and
`apply` turns honest reports into manipulated ones. Time is an argument and nothing is remembered: an
attack that needs the past (a stuck or a replaying meter) asks the caller for it, so that one tick, a whole
day at once, and a second run all give the same numbers. Attacks are for simulation; no estimator reads
this module.

Voltages are magnitudes per unit of the nominal voltage, as a meter displays them (not squared). Powers are
in whatever unit the reports use; imports are positive, as on the wire.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from gridsec.arrays import Bools, Floats, Ints

Past: TypeAlias = Callable[[Floats], Floats]
"""Honest reports of all p meters at earlier times: (T,) s -> (T, p) pu."""

_Bits: TypeAlias = NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class Reports:
    """What p meters report at T times.

    Attributes
    ----------
    v : (T, p)
        Voltage magnitude, pu of nominal.
    p : (T, p)
        Net active import, kW or pu.
    q : (T, p)
        Net reactive import, kvar or pu; NaN where it is not reported.
    """

    v: Floats
    p: Floats
    q: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Attack:
    """What every attack has.

    Attributes
    ----------
    meters : (k,)
        Index of each manipulated meter, every one once.
    t_on, t_off
        The attack lies while t_on <= t < t_off, Unix s.
    """

    meters: Ints
    t_on: float
    t_off: float

    def __post_init__(self) -> None:
        _check_meters(self.meters, self.t_on, self.t_off)

    def voltage(self, t: Floats, v: Floats, past: Past) -> Floats:
        """What the k meters report while the attack is on.

        Parameters
        ----------
        t : (T,)
            Times inside [t_on, t_off), Unix s.
        v : (T, k)
            What they would report otherwise, pu.
        past
            The honest reports of all meters at earlier times, pu.

        Returns
        -------
        (T, k)
            Reported voltages, pu.
        """
        raise AssertionError(f"{type(self).__name__} has no signal")

    def load_pattern(R: Floats, X: Floats, target: int, ratio: float, v: Floats) -> Floats:
    """Voltage change at every customer per unit of extra load at one of them, to first order.

    From v^2 = v0^2 + 2 R p + 2 X q with a load P + j ratio P at customer k:
    dv_i / dP = -(R_ik + ratio X_ik) / v_i.

    Parameters
    ----------
    R, X : (N, N)
        Shared path resistance and reactance of LinDistFlow, pu.
    target
        The customer k with the extra load.
    ratio
        Reactive over active power of that load, 1.
    v : (N,)
        Present voltage magnitudes, pu.

    Returns
    -------
    (N,)
        Change of the voltage magnitude per pu of load; never positive on an inductive feeder.
    """
    return -(R[:, target] + ratio * X[:, target]) / v


def most_affected(pattern: Floats, count: int) -> Ints:
    """The `count` entries of largest magnitude, in ascending order of index; ties go to the lower index."""
    if not 0 < count <= pattern.size:
        raise ValueError(f"cannot choose {count} of {pattern.size} meters")
    order = np.argsort(-np.abs(pattern), kind="stable")
    return np.sort(order[:count])


def coordinate(pattern: Floats, meters: Ints, size: float) -> float:
    """Scale at which a pattern moves every chosen meter by at least `size`.

    Parameters
    ----------
    pattern : (p,)
        Voltage change at each meter per unit of what is faked, pu.
    meters : (k,)
        The meters that will lie.
    size
        Smallest displacement asked for, pu, > 0.

    Returns
    -------
    float
        ``size / min_j |pattern_j|``, so that the least affected of the meters moves by just `size`.

    Raises
    ------
    ValueError
        When a chosen meter is not affected at all: no size of load would move it.
    """
    weakest = float(np.min(np.abs(pattern[meters])))
    if not weakest > 0.0:
        raise ValueError("a chosen meter does not feel the fake load at all")
    return size / weakest


def _random(attack: Random, t: Floats) -> Floats:
    """Displacement (T, k) of a random attack."""
    draw = np.floor((t - attack.t_on) / attack.hold_s).astype(np.uint64)[:, None]
    meter = attack.meters.astype(np.uint64)[None, :]
    # A hash of (seed, meter, draw) instead of a generator: any stretch of time can be asked for, in any
    # order and any chunks, and gives the same numbers.
    start = np.full((1, 1), attack.seed % 2**64, dtype=np.uint64)
    bits = _scramble(_scramble(_scramble(start) ^ meter) ^ draw)
    sign = np.where(bits & np.uint64(1), 1.0, -1.0)
    fraction = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return sign * (attack.low + (attack.high - attack.low) * fraction)


def _scramble(bits: _Bits) -> _Bits:
    """Mix 64 bits thoroughly: the output function of the SplitMix64 generator, arithmetic modulo 2^64.

    References
    ----------
    G. L. Steele, D. Lea, C. H. Flood: Fast splittable pseudorandom number generators. OOPSLA 2014, figure 16
    (constants of Stafford's variant 13).
    """
    z = bits + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def _check_meters(meters: Ints, t_on: float, t_off: float) -> None:
    if meters.ndim != 1 or meters.size == 0:
        raise ValueError("an attack needs a one-dimensional, non-empty array of meters")
    if np.unique(meters).size != meters.size or np.any(meters < 0):
        raise ValueError(f"meters of an attack must be different indices from 0, got {meters.tolist()}")
    if not t_on < t_off:
        raise ValueError(f"an attack must begin before it ends, got t_on={t_on} and t_off={t_off}")


def _check_per_meter(meters: Ints, **values: Floats) -> None:
    for name, value in values.items():
        if value.shape != meters.shape:
            raise ValueError(f"{name} has shape {value.shape}, but there are {meters.size} meters")
        if not np.all(np.isfinite(value)):
            raise ValueError(f"{name} must be finite")
