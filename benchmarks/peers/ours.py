"""Ours on the same snapshot: loss-corrected linear power flow, correlated loads, likeliest explanation."""

from __future__ import annotations

import numpy as np

from benchmarks.peers.answer import Answer
from benchmarks.peers.scene import Reading, Scene
from gridsec.arrays import Bools, Floats
from gridsec.feeder import bus_voltages, lindistflow
from gridsec.sequential.conditional import Prior
from gridsec.sequential.snapshot import Lies, identify

_STEPS = 2


class Ours:
    """One feeder, prepared once."""

    def __init__(self, here: Scene, lies: Lies | None = None, *, false_powers: bool = True) -> None:
        self.feeder, model = here.feeder, lindistflow(here.feeder)
        self.lies = Lies() if lies is None else lies
        self.R, self.X = 2.0 * model.R, 2.0 * model.X
        self.false_powers = false_powers

    def __call__(self, told: Reading) -> Answer:
        """One snapshot."""
        v, v0, p, q, std_v = told.v, told.v0, told.p, told.q, told.std_v
        feeder = self.feeder
        spread = np.hstack([self.R * told.std_p, self.X * told.std_q])
        K = spread @ spread.T + (2.0 * v0 * std_v) ** 2
        known = Prior(K, np.arange(v.size), K.diagonal())
        noise, v2 = (2.0 * v * std_v) ** 2, v**2
        R, X = self.R, self.X
        var_p, var_q = told.std_p**2, told.std_q**2
        # False powers are most of what is claimed.
        false = np.stack([R * np.abs(p), X * np.abs(q)], axis=2) if self.false_powers else None

        def injected(weights: Floats, powers: Bools) -> tuple[Floats, Floats]:
            return (var_p + powers * p**2) * (weights @ R), (var_q + powers * q**2) * (weights @ X)

        def curved(weights: Floats, powers: Bools) -> Floats:
            dp, dq = injected(weights, powers)
            w = bus_voltages(feeder, dp - p, dq - q, v0**2, steps=_STEPS)[feeder.bus]
            return np.asarray(v2 - w + R @ dp + X @ dq)

        live = np.ones(v.size, dtype=np.bool_)
        m = v2 - bus_voltages(feeder, -p, -q, v0**2, steps=_STEPS)[feeder.bus]
        found = identify(known, noise, m, live, lies=self.lies, false=false, curved=curved)
        best = found[0]
        error = np.where(best.liars, self.lies.size**2, 0.0) + noise
        estimate = v2 - error * best.weights
        others = tuple((each.liars, each.probability) for each in found[1:])
        return Answer(best.liars, others, np.sqrt(np.maximum(estimate, 0.0)))
