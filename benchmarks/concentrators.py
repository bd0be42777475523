"""Distributed estimation between concentrators against one estimator with all readings.

    python -m benchmarks.concentrators [FEEDER] [SEEDS] [CUSTOMERS]

AC power flow is the truth; loads, inverters and meters are simulated. The feeder is cut into areas of at least
CUSTOMERS customers. Rows: nothing wrong, manipulated meters, lost links, and one manipulated concentrator, at an
end or at the busbar. Columns: verdicts, manipulated meters named, honest meters named, largest error of a
concentrator that is not manipulated in volts and in its standard deviations, and largest distance to the
estimate of the central estimator with the same trusted meters, in volts.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.load_uncertainty import load_doubt
from feeders.model.site import Site, load, plant, to_frame
from feeders.simulation.scenario import Scenario, simulate, snapshots
from gridsec.arrays import Bools, Floats
from gridsec.estimators import distributed, sequential
from gridsec.estimators.distributed import Area, Carry, Concentrator, Message, exchange, laterals, verdict
from gridsec.estimators.sequential.load_uncertainty import LoadDoubt, prior
from gridsec.grid.radial import Feeder
from gridsec.interface import Frame

ROUNDS = 60
"""Rounds of the concentrators per tick that is judged: more than the longest search needs."""
SIZE_PU = 0.03
"""Manipulation of a squared voltage, pu: 3.4 V."""


@dataclass
class Row:
    """Results of one situation."""

    decisions: Counter[str] = field(default_factory=Counter)
    named: int = 0
    manipulated: int = 0
    honest: int = 0
    error_v: float = 0.0
    error_std: float = 0.0
    distance_v: float = 0.0

    def text(self, name: str) -> str:
        """Return the row of the table."""
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(self.decisions.items()))
        return (
            f"| {name} | {told} | {self.named} of {self.manipulated} | {self.honest} "
            f"| {self.error_v:.2f} | {self.error_std:.1f} | {self.distance_v:.1e} |"
        )


class Setting:
    """A feeder, cut into areas, and its central oracle."""

    def __init__(self, name: str, customers: int) -> None:
        self.site: Site = load(name)
        assert isinstance(self.site.feeder, Feeder)
        self.feeder = self.site.feeder
        whole = sequential.design(plant(self.site), doubt=load_doubt(self.site), step_s=1.0)
        self.noise: Floats = whole.white + whole.fixed
        self.busbar = 2.0 * self.site.accuracy.busbar_class / np.sqrt(3.0)
        self.doubt: LoadDoubt = load_doubt(self.site)
        self.areas: tuple[Area, ...] = distributed.design(
            self.feeder, self.site.meters, self.noise, self.doubt, tops=laterals(self.feeder, customers), busbar=self.busbar
        )
        self.covariance = prior(
            self.feeder, np.arange(len(self.feeder.buses)), self.doubt, busbar=self.busbar
        ).covariance
        self.at = self.feeder.bus[self.site.meters]

    def tick(self, seed: int) -> tuple[Frame, Floats, Floats]:
        """Frame of a tick, reactive powers with those of the inverters, and true squared voltages."""
        scenario = Scenario(seed=seed, duration_s=30.0, dt_s=10.0)
        sample = list(simulate(self.site, scenario))[-1]
        frame = to_frame(self.site, list(snapshots([sample]))[0])
        own = np.ones(self.feeder.bus.size)
        own[self.site.meters] = np.where(np.isnan(frame.y), 1.0, frame.y)
        droop = self.site.droop
        x = droop.per_customer(droop(droop.vbar**2 - own[droop.customer]), own.size)
        return frame, np.where(np.isnan(frame.q_net), frame.q + x, frame.q_net), np.asarray(sample.v2)

    def central(self, frame: Frame, q: Floats, y: Floats, trusted: Bools) -> Floats:
        """Squared voltages of all buses by one dense estimator."""
        model = self.feeder.bus_voltages(frame.p, q, frame.v0_squared)
        use = np.flatnonzero(trusted & np.isfinite(y))
        S, at = self.covariance, self.at[use]
        gain = np.linalg.solve(S[np.ix_(at, at)] + np.diag(self.noise[use]), y[use] - model[at])
        return np.asarray(model + S[:, at] @ gain)
