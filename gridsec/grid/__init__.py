"""Feeders as linear and AC models: radial, meshed, in three phases."""

from gridsec.grid.meshed import MeshedFeeder, PhasedMesh
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder

AnyNetwork = Feeder | MeshedFeeder | PhasedFeeder | PhasedMesh
"""All classes with the methods of `gridsec.grid.network.Network`."""

__all__ = ["AnyNetwork", "Feeder", "MeshedFeeder", "PhasedFeeder", "PhasedMesh"]
