"""Random plants with prescribed modes, some of which some sensors do not see."""

from __future__ import annotations

import numpy as np


def modal(
    seed: int, n: int = 5, p: int = 5, blind: float = 0.35, growth: float = 1.2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C with well separated real modes, the first equal to `growth`, some repeated.

    Each sensor sees each mode only with probability 1 - blind.
    """
    rng = np.random.default_rng(seed)
    modes = rng.choice([-0.6, 0.2, 0.5, 0.85, growth], size=n)
    modes[0] = growth
    T = np.linalg.qr(rng.standard_normal((n, n)))[0] @ np.diag(rng.uniform(0.5, 2.0, n))
    T = T @ (np.eye(n) + 0.3 * np.triu(rng.standard_normal((n, n)), 1))
    inverse = np.linalg.inv(T)
    rows = (
        rng.choice([-1.0, 1.0], (p, n)) * rng.uniform(0.5, 1.5, (p, n)) * (rng.uniform(size=(p, n)) >= blind)
    )
    return T @ np.diag(modes) @ inverse, rng.standard_normal((n, 1)), rows @ inverse
