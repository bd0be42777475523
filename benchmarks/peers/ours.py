"""Ours on the same snapshot: loss-corrected linear power flow, correlated loads, likeliest explanation."""

from __future__ import annotations

import numpy as np

from benchmarks.peers.answer import Answer
from benchmarks.peers.scene import Scene, Snapshot
from gridsec.arrays import Floats
from gridsec.feeder import bus_voltages, lindistflow
from gridsec.sequential.loads import LoadDoubt, prior
from gridsec.sequential.snapshot import Lies, identify

_STEPS = 2


class Ours:
    """One feeder, prepared once."""

    def __init__(self, here: Scene, lies: Lies | None = None, *, false_powers: bool = True) -> None:
        self.feeder, self.model = here.feeder, lindistflow(here.feeder)
        self.lies = Lies() if lies is None else lies
        R, X = 2.0 * self.model.R, 2.0 * self.model.X
        # False powers that would move the own voltage as much as a lie.
        scale = self.lies.size / np.hypot(R.diagonal(), X.diagonal())
        self.false = np.stack([R * scale, X * scale], axis=2) if false_powers else None

    def __call__(self, told: Snapshot, v: Floats, v0: float, p: Floats, q: Floats, std_v: float) -> Answer:
        """One snapshot."""
        feeder = self.feeder
        doubt = LoadDoubt(told.std_p, told.std_q, time_s=1.0)
        known = prior(self.model, feeder.bus, doubt, busbar=2.0 * v0 * std_v)
        w = bus_voltages(feeder, -p, -q, v0**2, steps=_STEPS)
        noise = (2.0 * v * std_v) ** 2
        live = np.ones(v.size, dtype=np.bool_)
        found = identify(known, noise, v**2 - w[feeder.bus], live, lies=self.lies, false=self.false)
        best = found[0]
        v2 = w[feeder.bus] + known.between @ best.weights
        if self.false is not None:
            for c in np.flatnonzero(best.powers).tolist():
                v2 = v2 + self.false[:, c] @ (self.false[:, c].T @ best.weights)
        others = tuple((each.liars, each.probability) for each in found[1:])
        return Answer(best.liars, others, np.sqrt(np.maximum(v2, 0.0)))
