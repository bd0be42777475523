"""Common parts of systems in Lur'e form, in continuous and in discrete time.

    x' or x+ = A x + G phi(H x + F u) + B u,     y = C x + D u

References
----------
chong2020 (9), (10); yang2019 (1), (2).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from gridsec.arrays import Floats, frozen
from gridsec.errors import Problem
from gridsec.newton import Nonlinearity

_MATRICES = ("A", "G", "H", "F", "B", "C", "D")


class Readout(Protocol):
    """Matrices of `z = H x + F u` and `y = C x + D u`, in continuous or discrete time."""

    @property
    def H(self) -> Floats: ...  # noqa: D102, N802
    @property
    def F(self) -> Floats: ...  # noqa: D102, N802
    @property
    def C(self) -> Floats: ...  # noqa: D102, N802
    @property
    def D(self) -> Floats: ...  # noqa: D102, N802


class Form(Readout, Protocol):
    """Complete system in Lur'e form, in continuous or discrete time."""

    @property
    def A(self) -> Floats: ...  # noqa: D102, N802
    @property
    def G(self) -> Floats: ...  # noqa: D102, N802
    @property
    def B(self) -> Floats: ...  # noqa: D102, N802
    @property
    def phi(self) -> Nonlinearity: ...  # noqa: D102


def as_floats(*given: ArrayLike) -> tuple[Floats, ...]:
    """Nested lists as arrays of floats."""
    return tuple(np.asarray(one, dtype=np.float64) for one in given)


def input_matrices(
    heights: tuple[int, int, int], F: ArrayLike | None, B: ArrayLike | None, D: ArrayLike | None
) -> tuple[Floats, ...]:
    """F, B and D as arrays, zero where not given; the given ones determine l.

    Parameters
    ----------
    heights
        Their numbers of rows: nonlinearities, states and meters.
    """
    found = [None if one is None else np.asarray(one, dtype=np.float64) for one in (F, B, D)]
    inputs = max((one.shape[-1] for one in found if one is not None and one.ndim), default=0)
    rows = zip(found, heights, strict=True)
    return tuple(np.zeros((count, inputs)) if one is None else one for one, count in rows)


def freeze(system: object, *slopes: str) -> list[Problem]:
    """Freeze the arrays of a new system and return their problems.

    Parameters
    ----------
    system
        Object with the seven matrices and the bounds of the slopes as attributes.
    slopes
        Attribute names of these bounds, (m,).

    Returns
    -------
    list of str
        One clause for every inconsistent shape, and one if an entry is not finite.
    """
    given: dict[str, Floats] = {name: frozen(getattr(system, name)) for name in (*_MATRICES, *slopes)}
    for name, array in given.items():
        object.__setattr__(system, name, array)
    if wrong := [
        Problem("shape", f"{name} has shape {array.shape}; expected {count} axes")
        for name, array in given.items()
        if array.ndim != (count := 1 if name in slopes else 2)
    ]:
        return wrong
    n, m, inputs, p = len(given["A"]), given[slopes[0]].size, given["F"].shape[1], len(given["C"])
    wanted = {"A": (n, n), "G": (n, m), "H": (m, n), "F": (m, inputs), "B": (n, inputs), "C": (p, n)}
    wanted |= {"D": (p, inputs)}
    wrong = [
        Problem("shape", f"{name} has shape {given[name].shape}; expected {shape}")
        for name, shape in (wanted | dict.fromkeys(slopes, (m,))).items()
        if given[name].shape != shape
    ]
    if not all(np.isfinite(array).all() for array in given.values()):
        wrong.append(Problem("not-finite", "every entry must be finite"))
    return wrong


def without_lower(system: Form, lower: Floats) -> tuple[Floats, Floats, Nonlinearity]:
    """Loop transform: the lower slopes of phi move into the linear part.

    `phi(z) = lower z + phi~(z)`, with slopes of phi~ in [0, upper - lower], and `A~ = A + G diag(lower) H`,
    `B~ = B + G diag(lower) F`. Trajectories do not change.

    Parameters
    ----------
    system
        System with slopes of phi from `lower` on.
    lower : (m,)
        The lower slopes.

    Returns
    -------
    A~, B~, phi~
        Of the same system; phi itself if `lower` is zero.
    """
    if not np.any(lower):
        return system.A, system.B, system.phi
    phi, pushed = system.phi, system.G * lower
    return (
        system.A + pushed @ system.H,
        system.B + pushed @ system.F,
        lambda z: np.asarray(phi(z) - lower * z),
    )
