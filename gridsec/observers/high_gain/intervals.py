"""Interval arithmetic for NumPy functions, and rigorous suprema over boxes by bisection.

An `Interval` passes through the ufuncs (`np.sin`, `**`, `+`, …), so that one Python function serves
points and boxes. Every operation rounds outwards by two units in the last place, which covers the
rounding of the operation itself and the last-bit errors of the mathematical library.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid

_ULPS = 2


class Interval(NDArrayOperatorsMixin):
    """Arrays of closed intervals `[lo, hi]`, elementwise; ends of one shape, `lo <= hi`."""

    __slots__ = ("hi", "lo")

    def __init__(self, lo: Floats, hi: Floats) -> None:
        self.lo = np.asarray(lo, dtype=np.float64)
        self.hi = np.asarray(hi, dtype=np.float64)

    def __repr__(self) -> str:
        return f"Interval({self.lo!r}, {self.hi!r})"

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: object, **kwargs: object) -> Any:
        """Dispatch of NumPy's functions; unsupported functions are refused, never guessed."""
        rule = _RULES.get(ufunc)
        if rule is None or method != "__call__" or kwargs:
            return NotImplemented
        # Infinite bounds at the ends of domains are legitimate results, since bisection splits there.
        with np.errstate(all="ignore"):
            return rule(*inputs)


def interval(value: object) -> Interval:
    """`value` as an interval; numbers and arrays become points."""
    if isinstance(value, Interval):
        return value
    point = np.asarray(value, dtype=np.float64)
    return Interval(point, point)


def _outward(lo: Floats, hi: Floats) -> Interval:
    for _ in range(_ULPS):
        lo, hi = np.nextafter(lo, -np.inf), np.nextafter(hi, np.inf)
    return Interval(lo, hi)


def _hull(*candidates: Floats) -> Interval:
    stack = np.stack(np.broadcast_arrays(*candidates))
    # 0 * inf: the product of an unbounded factor with zero is zero.
    stack = np.where(np.isnan(stack), 0.0, stack)
    return _outward(stack.min(axis=0), stack.max(axis=0))


def _add(a: object, b: object) -> Interval:
    p, q = interval(a), interval(b)
    return _outward(p.lo + q.lo, p.hi + q.hi)


def _subtract(a: object, b: object) -> Interval:
    p, q = interval(a), interval(b)
    return _outward(p.lo - q.hi, p.hi - q.lo)


def _multiply(a: object, b: object) -> Interval:
    p, q = interval(a), interval(b)
    return _hull(p.lo * q.lo, p.lo * q.hi, p.hi * q.lo, p.hi * q.hi)


def _divide(a: object, b: object) -> Interval:
    q = interval(b)
    away = (q.lo > 0.0) | (q.hi < 0.0)
    ends = 1.0 / np.where(away, q.lo, 1.0), 1.0 / np.where(away, q.hi, 1.0)
    inverse = _outward(np.minimum(*ends), np.maximum(*ends))
    return _multiply(a, Interval(np.where(away, inverse.lo, -np.inf), np.where(away, inverse.hi, np.inf)))


def _negative(a: object) -> Interval:
    p = interval(a)
    return Interval(-p.hi, -p.lo)


def _absolute(a: object) -> Interval:
    p = interval(a)
    low = np.maximum(np.maximum(p.lo, -p.hi), 0.0)
    return Interval(low, np.maximum(np.abs(p.lo), np.abs(p.hi)))


def _power(a: object, b: object) -> Interval:
    p, exponent = interval(a), float(np.asarray(b, dtype=np.float64))
    if exponent != int(exponent):
        raise InputInvalid.of("not-integer", f"only integer powers of intervals are defined, not {exponent}")
    k = int(exponent)
    if k < 0:
        return _divide(1.0, _power(a, -k))
    if k % 2 == 0:
        p = _absolute(p)
    # Integer powers are monotone on the remaining range, but NumPy's pow is only accurate to a few ulps.
    result = _outward(p.lo**k, p.hi**k)
    result = _outward(result.lo, result.hi)
    if k % 2 == 0:
        return Interval(np.maximum(result.lo, 0.0), result.hi)
    return result


def _rising(function: np.ufunc) -> Callable[[object], Interval]:
    def rule(a: object) -> Interval:
        p = interval(a)
        return _outward(function(p.lo), function(p.hi))

    return rule


def _wave(function: np.ufunc, peak: float) -> Callable[[object], Interval]:
    """Sine or cosine with the maximum 1 at `peak + 2 pi k`; turning points are located with a margin."""

    def touches(p: Interval, at: float) -> Floats:
        slack = 1e-9 * (1.0 + np.maximum(np.abs(p.lo), np.abs(p.hi)))
        turn = 2.0 * np.pi
        return np.asarray(np.floor((p.hi - at + slack) / turn) >= np.ceil((p.lo - at - slack) / turn))

    def rule(a: object) -> Interval:
        p = interval(a)
        ends = function(p.lo), function(p.hi)
        # NaN ends (unbounded arguments) give the whole range.
        out = _outward(np.nan_to_num(np.minimum(*ends), nan=-1.0), np.nan_to_num(np.maximum(*ends), nan=1.0))
        low = np.where(touches(p, peak + np.pi), -1.0, np.maximum(out.lo, -1.0))
        high = np.where(touches(p, peak), 1.0, np.minimum(out.hi, 1.0))
        return Interval(low, high)

    return rule


def _extreme(function: np.ufunc) -> Callable[[object, object], Interval]:
    def rule(a: object, b: object) -> Interval:
        p, q = interval(a), interval(b)
        return Interval(function(p.lo, q.lo), function(p.hi, q.hi))

    return rule


_RULES: dict[np.ufunc, Callable[..., Interval]] = {
    np.add: _add,
    np.subtract: _subtract,
    np.multiply: _multiply,
    np.divide: _divide,
    np.negative: _negative,
    np.positive: interval,
    np.absolute: _absolute,
    np.power: _power,
    np.square: lambda a: _power(a, 2),
    np.sin: _wave(np.sin, 0.5 * np.pi),
    np.cos: _wave(np.cos, 0.0),
    np.exp: _rising(np.exp),
    np.tanh: _rising(np.tanh),
    np.arctan: _rising(np.arctan),
    np.sinh: _rising(np.sinh),
    np.maximum: _extreme(np.maximum),
    np.minimum: _extreme(np.minimum),
}

Boxed = Callable[[Sequence[Any]], Any]


@dataclass(frozen=True, slots=True)
class Bracket:
    """Bracket of a constant."""

    lower: float  # lower end; minus infinity or 0 if unknown
    upper: float  # upper end; infinite if unknown
    # "interval bisection" is a proof (up to the correctness of the outward rounding); "sampling" shows only
    # that no tried point exceeds one side
    method: str


def supremum(
    function: Boxed, lower: Floats, upper: Floats, *, gap: float = 1e-4, most: int = 200_000
) -> Bracket:
    """Proven supremum of a function over a box.

    Boxes are evaluated all at once; those without values above the best value at a centre are dropped, and
    the rest halved along their longest side.

    function: from n components (intervals or arrays) to one value per box or point.
    lower, upper (n,).
    gap: acceptable relative distance of `upper` and `lower`.
    most: largest number of boxes at a time; beyond it the bracket is wider, but still valid.
    """
    lo, hi = (np.array(np.atleast_1d(end), dtype=np.float64)[:, None] for end in (lower, upper))
    width = np.where(hi > lo, hi - lo, 1.0)
    best, settled = _at_corners(function, lo[:, 0], hi[:, 0]), -np.inf
    while True:
        centre = 0.5 * (lo + hi)
        values = np.broadcast_to(np.asarray(function(list(centre)), dtype=np.float64), centre.shape[1:])
        best = max(best, float(values.max()))
        tops = interval(function([Interval(a, b) for a, b in zip(lo, hi, strict=True)])).hi
        tops = np.broadcast_to(tops, centre.shape[1:])
        keep = tops > best + gap * abs(best)
        settled = max(settled, float(np.max(tops[~keep], initial=-np.inf)))
        lo, hi, tops = lo[:, keep], hi[:, keep], tops[keep]
        narrow = not np.any(hi - lo > 1e-12 * width)
        if not keep.any() or narrow or 2 * lo.shape[1] > most:
            top = float(np.max(tops, initial=settled))
            return Bracket(best, max(best, top), "interval bisection")
        lo, hi = _halved(lo, hi, width)


def _at_corners(function: Boxed, lower: Floats, upper: Floats) -> float:
    """Largest value at the corners of the box, the suprema of monotone functions."""
    n = len(lower)
    if n > _CORNERS:
        return -np.inf
    upwards = (np.arange(2**n)[None, :] >> np.arange(n)[:, None]) & 1 == 1
    values = function(list(np.where(upwards, upper[:, None], lower[:, None])))
    return float(np.max(np.asarray(values, dtype=np.float64)))


# Largest number of dimensions for which all corners are evaluated before the search.
_CORNERS = 12


def _halved(lo: Floats, hi: Floats, width: Floats) -> tuple[Floats, Floats]:
    longest = np.argmax((hi - lo) / width, axis=0)
    each = np.arange(lo.shape[1])
    middle = 0.5 * (lo + hi)[longest, each]
    first, second = hi.copy(), lo.copy()
    first[longest, each] = middle
    second[longest, each] = middle
    return np.concatenate([lo, second], axis=1), np.concatenate([first, hi], axis=1)
