"""Array types and the small numerics that several modules share.

Nothing here has a hidden tolerance: where a number decides, it is an argument.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


def frozen(values: Floats) -> Floats:
    """Copy of `values` as contiguous, read-only doubles.

    Parameters
    ----------
    values : (…)
        Anything that converts to an array of doubles.

    Returns
    -------
    Floats
        Same shape; writing into it raises ValueError.
    """
    out = np.array(values, dtype=np.float64, order="C")
    out.flags.writeable = False
    return out


def frozen_ints(values: Ints) -> Ints:
    """Copy of `values` as contiguous, read-only indices.

    Parameters
    ----------
    values : (…)
        Integers. Doubles and booleans are refused, because a rounded index is a wrong index.

    Returns
    -------
    Ints
        Same shape; writing into it raises ValueError.

    Raises
    ------
    TypeError
        If `values` are no integers.
    """
    given = np.asarray(values)
    if given.size and given.dtype.kind not in "iu":
        raise TypeError(f"indices must be integers, not {given.dtype}")
    out = np.array(given, dtype=np.intp, order="C")
    out.flags.writeable = False
    return out


def symmetry_defect(matrix: Floats) -> float:
    """Largest `|M - M^T|`, relative to the largest `|M|`; 0 for the zero matrix.

    Parameters
    ----------
    matrix : (n, n)
        Any square matrix.
    """
    scale = float(np.max(np.abs(matrix), initial=0.0))
    if scale == 0.0:
        return 0.0
    return float(np.max(np.abs(matrix - matrix.T))) / scale


def spectral_radius(matrix: Floats) -> float:
    """Largest modulus of an eigenvalue; 0 for an empty matrix.

    Parameters
    ----------
    matrix : (n, n)
        Any square matrix, not necessarily symmetric.
    """
    if matrix.size == 0:
        return 0.0
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))
