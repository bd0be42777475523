"""The whole online chain for one feeder: from a frame of readings to an estimate and a verdict.

    design(plant, *, max_attacked, step_s, gains="direct") -> MonitorDesign     offline, may raise
    init(design, t) -> MonitorState
    step(design, state, frame) -> (MonitorState, Estimate, Verdict)             online, never raises on data

`step_s` is the expected interval between frames, s; any other interval works too. `gains` is "direct"
or stacked circle-criterion gains.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gridsec.arrays import Ints
from gridsec.detect import MeterAccuracy
from gridsec.feeder import Feeder

if TYPE_CHECKING:
    from gridsec.droop import Droop


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """The feeder as it stands in the street. N customers, m inverters, p meters.

    Attributes
    ----------
    feeder
        Radial tree with its customers.
    droop
        The customers' inverters and their curves.
    meters : (p,)
        Index of the customer at which each voltage meter sits; at most one meter per customer.
    accuracy
        What the meters promise.
    loss_correction
        DistFlow fixed-point steps that correct LinDistFlow for branch losses; 0 leaves it linear.
    """

    feeder: Feeder
    droop: Droop
    meters: Ints
    accuracy: MeterAccuracy
    loss_correction: int = 1
