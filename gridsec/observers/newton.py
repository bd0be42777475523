"""Damped semismooth Newton method for `x = gain phi(H x + drive) + bias`, batched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible

Nonlinearity = Callable[[Floats], Floats]


def settle(
    phi: Nonlinearity,
    gain: Floats,
    H: Floats,
    *,
    drive: Floats,
    bias: Floats,
    x0: Floats,
    tol: float,
    max_iter: int,
) -> Floats:
    """Solve `x = gain phi(H x + drive) + bias` by a damped semismooth Newton method.

    The Jacobian `I - gain Delta H` takes Delta, the slopes of phi, from difference quotients, which are
    elements of the generalised Jacobian except within rounding of a kink. The step is halved until the
    residual falls. Plain iteration would need a loop gain below 1; this method does not.

    phi: nonlinearity, entry by entry, non-decreasing.
    gain (n, m): gain behind phi.
    H (m, n) or (…, m, n): feedback, possibly one for every leading index (one observer each).
    drive (…, m).
    bias (…, n): constant parts.
    x0 (…, n): initial value.
    tol: largest entry of the residual, in the unit of x.
    Raises DesignInfeasible if the residual is still above `tol` after `max_iter` steps.
    """
    lead = np.broadcast_shapes(x0.shape[:-1], drive.shape[:-1], bias.shape[:-1], H.shape[:-2])
    (n, m), count = gain.shape, prod(lead)
    x = np.array(np.broadcast_to(x0, (*lead, n)), dtype=np.float64).reshape(count, n)
    c = np.broadcast_to(drive, (*lead, m)).reshape(count, m)
    e = np.broadcast_to(bias, (*lead, n)).reshape(count, n)
    every = np.broadcast_to(H, (*lead, m, n)).reshape(count, m, n) if H.ndim > 2 else H[None]
    open_rows = np.arange(count)
    for _ in range(max_iter):
        loop = _Loop(
            phi, gain, every if every.shape[0] == 1 else every[open_rows], c[open_rows], e[open_rows]
        )
        now = x[open_rows]
        residual = loop.residual(now)
        rough = np.max(np.abs(residual), axis=-1, initial=0.0) > tol
        if not rough.any():
            return x.reshape(*lead, n)
        loop = loop.rows(rough)
        open_rows, now, residual = open_rows[rough], now[rough], residual[rough]
        x[open_rows] = loop.newton(now, residual)
    raise DesignInfeasible(
        "equilibrium of the droop loop",
        f"residual above {tol:g} after {max_iter} Newton steps",
        None,
        code="not-converged",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Loop:
    """The equation `x - gain phi(H x + drive) - bias = 0` for k rows at once."""

    phi: Nonlinearity
    gain: Floats
    H: Floats  # (1 or k, m, n)
    drive: Floats
    bias: Floats

    def rows(self, keep: Bools) -> _Loop:
        H = self.H if self.H.shape[0] == 1 else self.H[keep]
        return _Loop(self.phi, self.gain, H, self.drive[keep], self.bias[keep])

    def outputs(self, x: Floats) -> Floats:
        if self.H.shape[0] == 1:
            return np.asarray(x @ self.H[0].T + self.drive)
        return np.asarray(np.einsum("kmn,kn->km", self.H, x) + self.drive)

    def residual(self, x: Floats) -> Floats:
        return np.asarray(x - self.phi(self.outputs(x)) @ self.gain.T - self.bias)

    def newton(self, x: Floats, residual: Floats) -> Floats:
        """One damped Newton step from `x` (k, n) with residual `residual`."""
        z = self.outputs(x)
        width = _QUOTIENT * np.maximum(1.0, np.abs(z))
        slopes = (self.phi(z + width) - self.phi(z - width)) / (2.0 * width)
        jacobian = np.eye(x.shape[1]) - (self.gain * slopes[:, None, :]) @ self.H
        direction = -np.linalg.solve(jacobian, residual[..., None])[..., 0]
        size = np.linalg.norm(residual, axis=-1)
        length = np.ones(x.shape[0])
        for _ in range(_HALVINGS):
            trial = x + length[:, None] * direction
            worse = np.linalg.norm(self.residual(trial), axis=-1) > (1.0 - 1e-4 * length) * size
            if not worse.any():
                break
            length = np.where(worse, 0.5 * length, length)
        return np.asarray(x + length[:, None] * direction)


# Half-width of the difference quotients, relative: far above rounding, far below any deadband.
_QUOTIENT = 1e-7
_HALVINGS = 30
