"""Array types and small numerics that several modules share; copies of frozen values.

Nothing here has a hidden tolerance: every number that decides is an argument.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from gridsec.errors import InputInvalid, Problem

__all__ = [
    "PENDING",
    "Bools",
    "Deferred",
    "Floats",
    "Ints",
    "Phasors",
    "all_of",
    "any_of",
    "changed",
    "deferred",
    "exponential_integrals",
    "frozen",
    "frozen_ints",
    "indices",
    "keys_of",
    "not_negative",
    "perron_bound",
    "put",
    "sets_of",
    "spectral_radius",
    "submatrix",
    "symmetry_defect",
    "unit_rows",
]


Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
Phasors = NDArray[np.complex128]


def frozen(values: Floats) -> Floats:
    """Copy of `values` as contiguous, read-only doubles of the same shape."""
    out = np.array(values, dtype=np.float64, order="C")
    out.flags.writeable = False
    return out


def frozen_ints(values: Ints) -> Ints:
    """Copy of `values` as contiguous, read-only indices of the same shape.

    Doubles and booleans are refused, because a rounded index is a wrong index.

    Raises TypeError if `values` are not integers.
    """
    given = np.asarray(values)
    if given.size and given.dtype.kind not in "iu":
        raise TypeError(f"indices must be integers, not {given.dtype}")
    out = np.array(given, dtype=np.intp, order="C")
    out.flags.writeable = False
    return out


def put(target: object, **values: object) -> None:
    """Set fields of a frozen dataclass in its `__post_init__`; arrays become read-only."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(target, name, value)


def not_negative(name: str, values: Floats | float) -> Floats:
    """`values` as doubles; negative values and NaN are refused, infinity passes.

    Raises ValueError if one is negative or NaN.
    """
    out = np.asarray(values, dtype=np.float64)
    wrong = out[~(out >= 0.0)]
    if wrong.size:
        raise InputInvalid(
            [Problem("negative", f"{name} is {wrong[0]}; it must be a number that is not negative")]
        )
    return out


_BOOL = np.dtype(np.bool_)


def any_of(mask: Bools | Ints | Floats) -> bool:
    """``mask.any()``, in a tenth of the time where the array is small."""
    # A truth value is one byte, 0 or 1.
    return 1 in mask.tobytes() if mask.dtype is _BOOL else bool(np.count_nonzero(mask))


def indices(mask: Bools | Ints) -> Ints:
    """``np.flatnonzero(mask)`` for one dimension, in a third of the time where the array is small."""
    return mask.nonzero()[0]


def all_of(mask: Bools) -> bool:
    """``mask.all()``, in a tenth of the time where the array is small."""
    return 0 not in mask.tobytes() if mask.dtype is _BOOL else bool(np.count_nonzero(mask) == mask.size)


def keys_of(sets: Bools) -> list[bytes]:
    """Bytes of each of some sets, (k, q), as keys of a dictionary."""
    data, q = sets.tobytes(), sets.shape[1]
    return [data[k * q : (k + 1) * q] for k in range(len(sets))]


def sets_of(keys: Iterable[bytes], q: int) -> Bools:
    """Sets of q members from their bytes, (k, q)."""
    return np.frombuffer(bytearray().join(keys), dtype=np.bool_).reshape(-1, q)


def submatrix(matrix: Floats, rows: Ints, columns: Ints) -> Floats:
    """``matrix[np.ix_(rows, columns)]``, several times as fast where most of a matrix is picked.

    The indices `rows` (k,) and `columns` (l,) may have any order and repetitions. Returns a copy (k, l).
    """
    n, m = matrix.shape
    if rows.size * m <= n * columns.size:
        return matrix.take(rows, axis=0).take(columns, axis=1)
    return matrix.take(columns, axis=1).take(rows, axis=0)


def unit_rows(matrix: Floats, *, tol: float) -> Floats:
    """Rows scaled to length one; rows at the level of rounding are set to zero.

    tol: rows up to this fraction of the longest are zero. An exact zero row comes out of a decomposition at
        about 1e-17; scaled to length one it would have an arbitrary direction.
    """
    length = np.linalg.norm(matrix, axis=1, keepdims=True)
    nothing = length <= tol * np.max(length, initial=0.0)
    return np.asarray(np.where(nothing, 0.0, matrix) / np.where(nothing, 1.0, length))


def symmetry_defect(matrix: Floats) -> float:
    """Largest `|M - M^T|` of a square matrix, relative to the largest `|M|`; 0 for the zero matrix."""
    scale = float(np.max(np.abs(matrix), initial=0.0))
    if scale == 0.0:
        return 0.0
    return float(np.max(np.abs(matrix - matrix.T))) / scale


def spectral_radius(matrix: Floats) -> float:
    """Largest modulus of an eigenvalue of any square matrix; 0 for an empty matrix."""
    if matrix.size == 0:
        return 0.0
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def exponential_integrals(y: Floats) -> tuple[Floats, Floats, Floats]:
    """`exp(y)`, `(exp(y) - 1) / y` and `(exp(y) - 1 - y) / y^2`, entry by entry.

    The latter two use their power series near 0, where the formulas cancel.

    Source: M. Hochbruck, A. Ostermann, "Exponential integrators", Acta Numerica 19, 2010, equation (2.10).
    """
    near = np.abs(y) < 1e-2
    small = np.where(near, y, 0.0)
    safe = np.where(near, 1.0, y)
    # Truncated after y^5: the first term left out is below 1e-15 of the sum for |y| < 1e-2.
    first = 1 + small * (1 / 2 + small * (1 / 6 + small * (1 / 24 + small * (1 / 120 + small / 720))))
    second = 1 / 2 + small * (1 / 6 + small * (1 / 24 + small * (1 / 120 + small * (1 / 720 + small / 5040))))
    grown = np.expm1(y)
    return (
        np.exp(y),
        np.where(near, first, grown / safe),
        np.where(near, second, (grown - safe) / safe**2),
    )


def perron_bound(matrix: Floats, rounds: int) -> float:
    """Upper bound of the spectral radius of `|M|`, hence of every `M` with smaller entries.

    The quotient of Collatz and Wielandt, `max_i (|M| v)_i / v_i`, is a bound for every positive v; power
    iteration only tightens it.
    """
    if matrix.size == 0:
        return 0.0
    size = np.abs(matrix)
    v = np.ones(size.shape[0])
    best = np.inf
    for _ in range(rounds + 1):
        image = size @ v
        best = min(best, float(np.max(image / v)))
        top = float(image.max())
        if top == 0.0:
            return 0.0
        # The floor keeps v positive in rows without entries.
        v = image / top + 1e-3
    return best


PENDING: Floats = np.zeros(0)
"""Value of a deferred field before the first access."""


class Deferred:
    """Field of a class with slots that its subclass computes on first access, where it is `PENDING`."""

    def __init__(self, slot: Any, compute: Callable[[Any], Floats]) -> None:
        self._slot, self._compute, self.__doc__ = slot, compute, compute.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> Deferred: ...

    @overload
    def __get__(self, instance: object, owner: type) -> Floats: ...

    def __get__(self, instance: object, owner: type) -> Deferred | Floats:
        if instance is None:
            return self
        found: Floats = self._slot.__get__(instance)
        if found is PENDING:
            found = self._compute(instance)
            self._slot.__set__(instance, found)
        return found

    def __set__(self, instance: object, value: Floats) -> None:
        self._slot.__set__(instance, value)


def deferred(parent: type) -> Callable[[Callable[[Any], Floats]], Deferred]:
    """Return the decorator of a method that computes the field of the same name of a parent class."""
    return lambda compute: Deferred(parent.__dict__[compute.__name__], compute)


if TYPE_CHECKING:
    # Type checkers know `replace` and the type of each field.
    from dataclasses import replace as changed
else:
    from dataclasses import fields, replace
    from functools import cache
    from operator import attrgetter
    from types import MemberDescriptorType

    def changed(value: Any, /, **new: Any) -> Any:
        """Copy of a frozen dataclass with other values in some fields.

        Raises TypeError if a field does not exist or is derived.
        """
        plan = _plan(type(value), tuple(new))
        if plan is None:
            return replace(value, **new)
        kept, put, put_new = plan
        out = object.__new__(type(value))
        for write, each in zip(put, kept(value), strict=False):
            write(out, each)
        for write, each in zip(put_new, new.values(), strict=True):
            write(out, each)
        return out

    _Writers = tuple[Callable[[Any, Any], None], ...]

    @cache
    def _plan(kind: type, new: tuple[str, ...]) -> tuple[attrgetter, _Writers, _Writers] | None:
        """Getter and setters of the other fields, and setters of `new`; None where construction does more."""
        slots = {each.name: getattr(kind, each.name, None) for each in fields(kind)}
        plain = all(isinstance(slot, MemberDescriptorType) for slot in slots.values())
        others = [name for name in slots if name not in new]
        known = set(new) <= slots.keys() and all(each.init for each in fields(kind))
        if not (plain and known and others) or hasattr(kind, "__post_init__"):
            return None
        # attrgetter returns a tuple from two names on only.
        return (
            attrgetter(*others, others[0]),
            tuple(slots[name].__set__ for name in others),
            tuple(slots[name].__set__ for name in new),
        )
