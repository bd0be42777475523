"""Ours on the same snapshot: loss-corrected linear power flow, correlated loads, likeliest explanation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.peers.answer import Answer
from benchmarks.peers.scene import Reading, Scene
from gridsec.arrays import Bools, Floats
from gridsec.estimators.front.posterior import Prior
from gridsec.estimators.snapshot.identification import ErrorPrior, FalsePowers, identify
from gridsec.grid.radial import Feeder

_STEPS = 2


class Flow:
    """`Feeder.bus_voltages` at the customers, by matrices made once: on few buses that is faster."""

    def __init__(self, feeder: Feeder) -> None:
        at = feeder.walk.start
        self.under = ((at[1:, None] <= at) & (at < feeder.walk.stop[1:, None])).astype(np.float64)
        self.loads = np.ascontiguousarray(self.under[:, feeder.bus])
        self.path = np.ascontiguousarray(self.under.T)
        self.behind = self.under[:, 1:] - np.eye(feeder.parent.size)
        self.r, self.x, self.z2 = feeder.r, feeder.x, feeder.r**2 + feeder.x**2
        ends = 0.5 * feeder.charging
        self.half = np.bincount(feeder.parent, weights=ends, minlength=len(feeder.buses))
        self.half[1:] += ends
        self.charges, self.bus = bool(ends.any()), feeder.bus

    def __call__(self, p: Floats, q: Floats, v0: float) -> Floats:
        """Squared voltages, pu, of the customers' imports."""
        r, x = self.r, self.x
        P0, Q0 = self.loads @ p, self.loads @ q
        v2 = v0**2 - self.path @ (2.0 * (r * P0 + x * Q0))
        P, Q = P0, Q0 - self._charging(v2)
        for _ in range(_STEPS):
            current = (P**2 + Q**2) / v2[1:]
            P = P0 + self.behind @ (r * current)
            Q = Q0 + self.behind @ (x * current) - self._charging(v2)
            v2 = v0**2 - self.path @ (2.0 * (r * P + x * Q) + self.z2 * current)
        return np.asarray(v2[self.bus])

    def _charging(self, v2: Floats) -> Floats | float:
        return self.under @ (self.half * v2) if self.charges else 0.0


class Covariance:
    """``R diag(var_p) R^T + X diag(var_q) X^T`` between the customers, by matrices made once; O(N^2).

    Of any three customers i, j, c of a tree two pairs part at the same bus. With m where i and j part,

        R_ic R_jc = R_ij (R_ic + R_jc) + R_mc^2 - 2 R_ij R_mc

    so that the sum over c takes two products with R, and one number for each bus m.
    """

    def __init__(self, feeder: Feeder, R: Floats, X: Floats) -> None:
        self.R, self.X = R, X
        on_path = np.zeros((len(feeder.buses),) * 2, dtype=np.bool_)
        on_path[0, 0] = True
        for k, above in enumerate(feeder.parent, 1):
            on_path[k] = on_path[above]
            on_path[k, k] = True
        # The common bus that comes last is where they part.
        paths, last = on_path[feeder.bus], len(feeder.buses) - 1
        self.part = last - np.argmax((paths[:, None] & paths)[:, :, ::-1], axis=2)
        everywhere = replace(feeder, bus=np.arange(last + 1), customers=feeder.buses)
        model = everywhere.linear()
        at_bus = [2.0 * each for each in (model.R, model.X)]
        self.of_bus = np.hstack(
            [(each**2 - 2.0 * each.diagonal()[:, None] * each)[:, feeder.bus] for each in at_bus]
        )

    def __call__(self, var_p: Floats, var_q: Floats, busbar: float) -> Floats:
        """(N, N); `busbar` is the variance of the squared busbar voltage."""
        alone = self.R * (self.R @ var_p)[:, None] + self.X * (self.X @ var_q)[:, None]
        together = self.of_bus @ np.concatenate([var_p, var_q]) + busbar
        K = together.take(self.part)
        K += alone
        K += alone.T
        return K


class Ours:
    """One feeder, prepared once: matrices of the feeder, nothing of any reading or its noise."""

    def __init__(self, here: Scene, lies: ErrorPrior | None = None, *, false_powers: bool = True) -> None:
        self.flow, model = Flow(here.feeder), here.feeder.linear()
        self.lies = ErrorPrior() if lies is None else lies
        self.R, self.X = (np.ascontiguousarray(2.0 * each) for each in (model.R, model.X))
        self.covariance = Covariance(here.feeder, self.R, self.X)
        none = np.zeros(len(self.R))
        self.false = FalsePowers(self.R, self.X, none, none).claimed(none, none) if false_powers else None
        self.live = np.ones(len(self.R), dtype=np.bool_)
        self.buses = np.arange(len(self.R))

    def __call__(self, told: Reading) -> Answer:
        """One snapshot."""
        v, v0, p, q, R, X = told.v, told.v0, told.p, told.q, self.R, self.X
        var_p, var_q = told.std_p**2, told.std_q**2
        K = self.covariance(var_p, var_q, (2.0 * v0 * told.std_v) ** 2)
        known = Prior(K, self.buses, K.diagonal())
        noise, v2 = (2.0 * v * told.std_v) ** 2, v**2
        # False powers are most of what is claimed.
        false = None if self.false is None else self.false.claimed(np.abs(p), np.abs(q))

        def curved(weights: Floats, powers: Bools) -> Floats:
            dp = (var_p + powers * p**2) * (weights @ R)
            dq = (var_q + powers * q**2) * (weights @ X)
            return np.asarray(v2 - self.flow(p - dp, q - dq, v0) + R @ dp + X @ dq)

        m = v2 - self.flow(p, q, v0)
        found = identify(known, noise, m, self.live, error_prior=self.lies, false=false, curved=curved)
        best = found[0]
        estimate = v2 - best.errors - noise * best.weights
        others = tuple((each.meters, each.probability) for each in found[1:])
        return Answer(best.meters, others, np.sqrt(np.maximum(estimate, 0.0)))
