"""Unbalanced feeders: three phases with mutual impedance, customers on one phase or on all.

`ThreePhaseFeeder` is the radial tree of 3x3 blocks in per unit, `lindist3flow` its linear power flow of
squared phase voltages, `loss_correction` the correction of that, and `PhasedFeeder` the form for estimators.
"""

from gridsec.phases.feeder import PHASES, ROTATION, ThreePhaseFeeder, sequence_matrix
from gridsec.phases.flow import (
    CustomerFlow,
    LinDist3Flow,
    bus_voltages,
    corrected,
    lindist3flow,
    loss_correction,
    model_error_bound,
    per_customer,
    sensitivities,
    squared_voltages,
)
from gridsec.phases.places import PhasedFeeder

__all__ = [
    "PHASES",
    "ROTATION",
    "CustomerFlow",
    "LinDist3Flow",
    "PhasedFeeder",
    "ThreePhaseFeeder",
    "bus_voltages",
    "corrected",
    "lindist3flow",
    "loss_correction",
    "model_error_bound",
    "per_customer",
    "sensitivities",
    "sequence_matrix",
    "squared_voltages",
]
