"""A small nonlinear system with three equal sensors, and its course."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from gridsec.observers import high_gain
from gridsec.observers.high_gain import Partial, Polynomial, System, affine, groups, nearest


def bent() -> System:
    """Oscillator `x1' = x2, x2' = -x1 - x2 + 0.3 x1^2 + u` with three equal sensors of x1."""
    force = Polynomial(np.array([[1, 0], [0, 1], [2, 0]]), np.array([-1.0, -1.0, 0.3]))
    first = Partial(
        phi=lambda x: [x[0], x[1]],
        jacobian=lambda _: [[1.0, 0.0], [0.0, 1.0]],
        alpha=force,
        beta=((affine(0.0, [0.0, 0.0]),), (affine(1.0, [0.0, 0.0]),)),
        bound=1.0,
    )
    return System(np.array([1.0, 1.0]), (first, first, first))


def oscillator(x: Any) -> list[Any]:
    return [x[1], -x[0] - x[1] + 0.3 * x[0] ** 2]


def oscillator_input(x: Any) -> list[list[Any]]:
    return [[0.0 * x[0]], [1.0 + 0.0 * x[0]]]


def estimator(**options: Any) -> high_gain.HighGainDesign:
    model = bent()
    given: dict[str, Any] = {
        "theta": 12.0, "noise": 2e-4, "max_attacked": 1, "u_low": -0.4, "u_high": 0.4, "step_s": 0.02,
        "whole": nearest(model, (0, 1, 2), accept=1e-4), "lowest": 1.0,
    }  # fmt: skip
    return high_gain.design(
        model, [nearest(model, group, accept=1e-4) for group in groups(3, 1)], **{**given, **options}
    )


def truth(seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instants, states and inputs."""
    t = np.arange(0.0, seconds, 0.02)
    u = 0.3 * np.sin(t)
    path = solve_ivp(
        lambda s, x: np.array(oscillator(x)) + np.array([0.0, 0.3 * np.sin(s)]),
        (0.0, t[-1]), [0.4, -0.3], t_eval=t, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return t, path.y.T, u
