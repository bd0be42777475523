"""Left inverses of Phi_I: given in closed form and extended by saturation, or by the nearest point.

A left inverse Psi^I maps every z_I to a state in the box, and Phi_I(x) back to x. Its `factor` bounds the
ratio of the residual `|z_I - Phi_I(Psi^I(z_I))|` of a set without attack to the observers' error:

- given: `1 + Lip^(Phi_I) Lip^(Psi^I)`, kim2018's bound on `Lip^(id - Phi_I Psi^I)`;
- nearest point: `sqrt(N_I)`, because no state in the box, and so not the true one either, has a smaller
  Euclidean residual. No Lipschitz constant is needed (docs/theory-high-gain.md, Theorem 2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible
from gridsec.observers.high_gain.form import System, sat


@dataclass(frozen=True, slots=True, eq=False)
class Inverse:
    """Left inverse of Phi_I, defined everywhere.

    Attributes
    ----------
    sensors
        I, ascending.
    function
        Psi^I: from z_I (…, N_I) to states (…, n) inside the box.
    factor
        A residual above `factor` times the observers' error bound proves an attack within I.
    origin
        "given" or "nearest".
    """

    sensors: tuple[int, ...]
    function: Callable[[Floats], Floats]
    factor: float
    origin: str

    def __call__(self, z: Floats) -> Floats:
        """Psi^I(z_I)."""
        return self.function(z)


def given(
    system: System,
    sensors: Sequence[int],
    function: Callable[[Floats], Floats],
    *,
    factor: float,
    z_bound: float | None = None,
) -> Inverse:
    """Left inverse in closed form, extended by saturation: `sat(f(sat(z, M_z)), M_x)`.

    Parameters
    ----------
    sensors
        I, ascending.
    function
        A smooth map from (…, N_I) to (…, n) with `f(Phi_I(x)) = x` in the box of states.
    factor
        Bound on `Lip^(id - Phi_I Psi^I)`.
    z_bound
        M_z; by default the largest bound of the sensors.

    References
    ----------
    kim2018 (10), (11); lee2018 (5.3.4), (5.3.5).
    """
    chosen = tuple(int(i) for i in sensors)
    level = float(np.max(system.z_bound[list(chosen)])) if z_bound is None else z_bound
    return Inverse(chosen, lambda z: sat(function(sat(z, level)), system.x_bound), factor, "given")


def nearest(system: System, sensors: Sequence[int], *, accept: float = 0.0, iterations: int = 60) -> Inverse:
    """Left inverse by least squares: the state of the box with Phi_I nearest to z_I.

    Damped Gauss-Newton (Levenberg-Marquardt) projected onto the box, from the centre; for residuals above
    `accept` also from the middles of the orthants (up to eight states), with the best result. The factor
    sqrt(N_I) presumes a global minimum.

    Parameters
    ----------
    system
        The system; its Jacobians are used.
    sensors
        I, ascending.
    accept
        Residual (largest entry) without further starts. Values up to the threshold in use change no decision:
        a set that passes with a local minimum would pass with the global one.
    """
    chosen = tuple(int(i) for i in sensors)
    bound = system.x_bound
    level = np.concatenate([np.full(system.partials[i].size, system.partials[i].bound) for i in chosen])
    grid = np.zeros((0, system.n))
    if system.n <= _MANY:
        grid = 0.5 * bound * np.array(list(product((-1.0, 1.0), repeat=system.n)))

    def descend(z: Floats, starts: Floats) -> tuple[Floats, Floats]:
        x = np.broadcast_to(starts, (len(z), *starts.shape))
        goals = np.broadcast_to(z[:, None, :], (*x.shape[:2], z.shape[-1]))
        x, left = _descend(system, chosen, goals, x, iterations)
        best = np.argmin(np.sum(left**2, axis=-1), axis=1)
        each = np.arange(len(z))
        return x[each, best], left[each, best]

    def function(z: Floats) -> Floats:
        flat = sat(np.asarray(z, dtype=np.float64), level)
        batch = flat.reshape(-1, flat.shape[-1])
        x, left = descend(batch, np.zeros((1, system.n)))
        again = np.flatnonzero(np.max(np.abs(left), axis=-1) > accept)
        if again.size and len(grid):
            other, rest = descend(batch[again], grid)
            better = np.sum(rest**2, axis=-1) < np.sum(left[again] ** 2, axis=-1)
            x[again[better]] = other[better]
        return np.asarray(x.reshape(*flat.shape[:-1], system.n))

    size = int(sum(system.partials[i].size for i in chosen))
    return Inverse(chosen, function, float(np.sqrt(size)), "nearest")


# Largest number of states for starts from all orthants.
_MANY = 8


def _descend(
    system: System, sensors: tuple[int, ...], z: Floats, x: Floats, iterations: int
) -> tuple[Floats, Floats]:
    """Projected Levenberg-Marquardt for a batch; returns points and residuals."""
    bound, eye = system.x_bound, np.eye(system.n)
    residual = system.phi(x, sensors) - z
    cost = np.sum(residual**2, axis=-1)
    damping = np.full(cost.shape, 1e-3)
    for _ in range(iterations):
        J = system.jacobian(x, sensors)
        slope = np.einsum("...ki,...k->...i", J, residual)
        # At a face of the box only coordinates that point inwards may move.
        stuck = ((x >= bound) & (slope < 0.0)) | ((x <= -bound) & (slope > 0.0))
        J, slope = np.where(stuck[..., None, :], 0.0, J), np.where(stuck, 0.0, slope)
        normal = np.einsum("...ki,...kj->...ij", J, J)
        scale = np.trace(normal, axis1=-2, axis2=-1) / system.n + np.finfo(np.float64).tiny
        normal = normal + ((damping + 1e-14) * scale)[..., None, None] * eye
        move = np.linalg.solve(normal, slope[..., None])[..., 0]
        trial = np.clip(x - move, -bound, bound)
        ahead = system.phi(trial, sensors) - z
        reached = np.sum(ahead**2, axis=-1)
        better = reached < cost
        x = np.where(better[..., None], trial, x)
        residual = np.where(better[..., None], ahead, residual)
        cost = np.where(better, reached, cost)
        damping = np.clip(np.where(better, 0.1 * damping, 10.0 * damping), 1e-12, 1e12)
        if np.max(np.abs(move) / bound) <= _SHORT:
            break
    return x, residual


# Step, relative to the box, below the resolution of double precision.
_SHORT = 1e-13


def check(system: System, inverse: Inverse, points: Floats, *, tolerance: float) -> float:
    """Largest `|Psi^I(Phi_I(x)) - x|` over points of the box.

    Parameters
    ----------
    points : (k, n)
        States in the box.
    tolerance
        Largest acceptable error.

    Raises
    ------
    DesignInfeasible
        If the error exceeds `tolerance`.
    """
    worst = float(np.max(np.abs(inverse(system.phi(points, inverse.sensors)) - points)))
    if not worst <= tolerance:
        what = f"left inverse for the sensors {list(inverse.sensors)}"
        raise DesignInfeasible(
            what, f"misses the state by {worst:.3g}", tolerance - worst, code="not-verified"
        )
    return worst


def corners_and_interior(system: System, *, samples: int = 500, seed: int = 0) -> Floats:
    """Points of the box of states for checks: random ones and (up to ten states) all corners."""
    inner = np.random.default_rng(seed).uniform(-system.x_bound, system.x_bound, (samples, system.n))
    if system.n > 10:
        return inner
    corners = np.array(list(product((-1.0, 1.0), repeat=system.n))) * system.x_bound
    return np.concatenate([inner, corners])
