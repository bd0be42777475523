"""A balanced street around loops, with AC truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.grid.meshed import MeshedFeeder
from tests.gridsec.meshes import ac
from tests.gridsec.street import Street


@dataclass
class MeshedStreet(Street):
    """A street around loops: its truth is that of power-grid-model."""

    def voltages(self) -> np.ndarray:
        feeder = self.plant.feeder
        assert isinstance(feeder, MeshedFeeder)
        q = self.p * self.tan
        np.add.at(q, self.plant.droop.customer, self.x)
        return np.sqrt(ac(feeder, self.p, q, self.v0**2))
