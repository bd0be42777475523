"""Front end of the estimators that carry the inverters by one observer: from a frame to residuals.

    design(plant, doubt=..., step_s=...) -> FrontDesign
    init(design, t) -> FrontState

By module:

    measurements   plausibility of the frame, clock offsets, uncertainty of the powers
    observer       injections of the inverters, voltages by the model (prediction)
    device_checks  a named busbar meter, and metered reactive powers against the droop curves
    attack_kind    kinds of the named manipulations
    reading_history
                   repeated readings: stuck meters and replays
    meter_bias     times of the commissioning, and the record of the meters' fixed errors
    output         bound of the estimate, sentences for the operator

`posterior` is the prior of the load errors with its posterior. `state` is the memory between ticks, and the
records that survive a restart.

One circle-criterion observer carries the inverters. Its certificate holds for every set of trusted meters and
every switching between them.
"""

from gridsec.estimators.front.design import FrontDesign, FrontOptions, design
from gridsec.estimators.front.meter_bias import (
    Commission,
    Learning,
    LearningProgress,
    LearningReason,
    LearningState,
    to_arrays,
)
from gridsec.estimators.front.posterior import LoadDoubt
from gridsec.estimators.front.state import (
    FrontState,
    ObserverRecord,
    SuspicionRecord,
    init,
    settling_s,
)

__all__ = [
    "Commission",
    "FrontDesign",
    "FrontOptions",
    "FrontState",
    "Learning",
    "LearningProgress",
    "LearningReason",
    "LearningState",
    "LoadDoubt",
    "ObserverRecord",
    "SuspicionRecord",
    "design",
    "init",
    "settling_s",
    "to_arrays",
]
