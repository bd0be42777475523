"""Feeders with closed ties, balanced or in three phases.

`MeshedFeeder` and `PhasedMesh` are a tree and the lines that close loops in it. Both are represented by the
inverse of their admittances, so that `bus_voltages`, `model_error_bound` and `interval_bounds` are the same.
"""

from gridsec.mesh.balanced import MeshedFeeder, admittance, impedances
from gridsec.mesh.flow import Meshed, bus_voltages, interval_bounds, model_error_bound, sensitivities
from gridsec.mesh.phased import PhasedMesh

__all__ = [
    "Meshed",
    "MeshedFeeder",
    "PhasedMesh",
    "admittance",
    "bus_voltages",
    "impedances",
    "interval_bounds",
    "model_error_bound",
    "sensitivities",
]
