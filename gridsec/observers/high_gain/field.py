"""Right-hand sides and steps of all partial observers at once, padded to one size.

Sensor i occupies the first n_i of n_max places of its row; the rest stays zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from gridsec.arrays import Floats
from gridsec.observers.high_gain.constants import gain
from gridsec.observers.high_gain.form import Partial, Polynomial, System, sat

Field = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, slots=True, eq=False)
class Transition:
    """One step of the linear parts, exact for forcing that is linear in time.

    Attributes
    ----------
    h
        Length of the step, s.
    whole : (p, n_max, n_max)
        `e^{M h}` with `M = A - K C`.
    held, slope : (p, n_max, n_max)
        `z(h) = whole z(0) + held g(0) + slope (g(h) - g(0))`.
    """

    h: float
    whole: Floats
    held: Floats
    slope: Floats


def gains(system: System, theta: Floats) -> Floats:
    """K of every sensor, padded with zeros; (p, n_max).

    Parameters
    ----------
    theta : (p,)
        High-gain parameters, 1/s.
    """
    out = np.zeros(system.mask.shape)
    for i, partial in enumerate(system.partials):
        out[i, : partial.size] = gain(partial.size, float(theta[i]))
    return out


def transition(system: System, K: Floats, h: float) -> Transition:
    """Matrices of one step of length h, s, for the gains K (p, n_max)."""
    p, n = K.shape
    M = np.zeros((p, n, n))
    M[:, np.arange(n - 1), np.arange(1, n)] = system.mask[:, 1:]
    M[:, :, 0] -= K
    block = np.zeros((p, 3 * n, 3 * n))
    block[:, :n, :n] = M * h
    block[:, :n, n : 2 * n] = np.eye(n) * h
    block[:, n : 2 * n, 2 * n :] = np.eye(n)
    out = np.asarray(expm(block), dtype=np.float64)
    return Transition(h, out[:, :n, :n], out[:, :n, n : 2 * n], out[:, :n, 2 * n :])


def field(system: System) -> Field:
    """`e alpha(sat(z)) + beta(sat(z)) u` of all sensors as one function of z (p, n_max) and u (m,).

    If every alpha and beta is a `Polynomial`, all sensors share one table of monomials and one
    product; otherwise they are evaluated one after the other.
    """
    functions = [
        *(partial.alpha for partial in system.partials),
        *(entry for partial in system.partials for row in partial.beta for entry in row),
    ]
    if all(isinstance(function, Polynomial) for function in functions):
        return _stacked(system)
    return _looped(system)


def _stacked(system: System) -> Field:
    (p, n), m = system.mask.shape, system.partials[0].inputs
    places: dict[tuple[int, ...], int] = {}
    entries: list[tuple[int, int, int, int, float]] = []

    def collect(i: int, row: int, column: int, function: object) -> None:
        if not isinstance(function, Polynomial):
            raise TypeError("only polynomials can be stacked")
        for powers, factor in zip(function.exponents.tolist(), function.coefficients.tolist(), strict=True):
            key = (*powers, *[0] * (n - len(powers)))
            entries.append((i, places.setdefault(key, len(places)), row, column, factor))

    for i, partial in enumerate(system.partials):
        collect(i, partial.size - 1, 0, partial.alpha)
        for row, functions in enumerate(partial.beta):
            for column, function in enumerate(functions):
                collect(i, row, column + 1, function)
    table = np.zeros((p, len(places), n, m + 1))
    for i, place, row, column, factor in entries:
        table[i, place, row, column] += factor
    powers = np.array(list(places), dtype=np.intp)
    level = system.z_bound[:, None]

    def evaluate(z: Floats, u: Floats) -> Floats:
        monomials = np.prod(sat(z, level)[:, None, :] ** powers, axis=-1)
        rows = np.einsum("pk,pknc->pnc", monomials, table)
        return np.asarray(rows @ np.concatenate([[1.0], u]))

    return evaluate


def _looped(system: System) -> Field:
    def one(partial: Partial, z: Floats, u: Floats) -> list[float]:
        parts = list(sat(z[: partial.size], partial.bound))
        rows = [sum(float(f(parts)) * v for f, v in zip(row, u, strict=True)) for row in partial.beta]
        rows[-1] += float(partial.alpha(parts))
        return rows

    def evaluate(z: Floats, u: Floats) -> Floats:
        out = np.zeros(z.shape)
        for i, partial in enumerate(system.partials):
            out[i, : partial.size] = one(partial, z[i], u)
        return out

    return evaluate


def advance(
    right: Field,
    K: Floats,
    move: Transition,
    z: Floats,
    *,
    y: tuple[Floats, Floats],
    u: tuple[Floats, Floats],
) -> Floats:
    """One step of the observers (5): exponential, of second order in the nonlinear part.

    Readings and inputs are interpolated linearly between the two instants. The stiff linear part is exact for
    every `theta h`.

    Parameters
    ----------
    right
        From `field`.
    K : (p, n_max)
        Gains.
    move
        From `transition`.
    z : (p, n_max)
        Estimates at the start.
    y : pair of (p,)
        Readings at the start and the end.
    u : pair of (m,)
        Inputs at the start and the end.

    Returns
    -------
    Floats
        (p, n_max), estimates at the end; not finite on overflow by extreme readings.

    References
    ----------
    kim2018 (5); lee2018 (5.2.6).
    """
    before = right(z, u[0])
    forced = before + K * y[0][:, None]
    rise = K * (y[1] - y[0])[:, None]
    # Products row by row: the overflow of one sensor must not affect the others.
    trial = _apply(move.whole, z) + _apply(move.held, forced) + _apply(move.slope, rise)
    return trial + _apply(move.slope, right(trial, u[1]) - before)


def _apply(matrices: Floats, rows: Floats) -> Floats:
    return np.asarray(np.einsum("pij,pj->pi", matrices, rows))
