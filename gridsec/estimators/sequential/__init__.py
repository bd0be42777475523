"""Default monitor: one observer, correlated load uncertainty, evidence on several time scales.

    design(plant, doubt=..., step_s=...) -> SequentialDesign
    init(design, t) -> SequentialState
    step(design, state, frame) -> (SequentialState, Estimate, Verdict)

Pipeline of `step`, by module:

    measurements    plausibility of the frame; clock_offsets: readings of another moment
    observer        injections of the inverters, voltages by the model (prediction)
    time_scales     running means of the residuals and their limits (detection)
    identify        likeliest sets of manipulated meters: search, hypotheses, busbar_meter
    confirmation    lasting evidence without a likely rival; inverter_check, attack_kind, replay
    output          estimate with bounds, verdict with reason

One circle-criterion observer carries the inverters. Its certificate holds for every set of trusted meters and
every switching between them. The residuals are explained by correlated load errors, by meter errors, and by
as few manipulated meters as possible.
"""

from gridsec.estimators.sequential.design import SequentialDesign, SequentialOptions, design
from gridsec.estimators.sequential.meter_bias import (
    Commission,
    Learning,
    LearningProgress,
    LearningReason,
    LearningState,
    from_arrays,
    progress,
    to_arrays,
)
from gridsec.estimators.sequential.posterior import LoadDoubt
from gridsec.estimators.sequential.state import (
    SequentialState,
    SuspicionRecord,
    distrusted,
    init,
    renew,
    warm_start,
)
from gridsec.estimators.sequential.step import step

__all__ = [
    "Commission",
    "Learning",
    "LearningProgress",
    "LearningReason",
    "LearningState",
    "LoadDoubt",
    "SequentialDesign",
    "SequentialOptions",
    "SequentialState",
    "SuspicionRecord",
    "design",
    "distrusted",
    "from_arrays",
    "init",
    "progress",
    "renew",
    "step",
    "to_arrays",
    "warm_start",
]
