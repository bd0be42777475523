"""Sequential monitor: one observer, correlated load uncertainty, evidence on several time scales.

    design(plant, doubt=..., step_s=...) -> SequentialDesign
    init(design, t) -> SequentialState
    step(design, state, frame) -> (SequentialState, Estimate, Verdict)

Pipeline of `step`, by module:

    measurements   plausibility of the frame, clock offsets, uncertainty of the powers
    step           injections of the inverters, voltages by the model (prediction)
    time_scales    running means of the residuals and their limits (detection)
    identify       likeliest sets of manipulated meters by search, hypotheses and device_checks; confirmation
                   by lasting evidence without a likely rival
    attack_kind    kinds of the named manipulations
    reading_history
                   repeated readings: stuck meters and replays
    output         estimate with bounds, verdict with reason

`posterior` is the Gaussian model below all of them, `state` the memory between ticks, and `meter_bias`
the fixed errors learned at commissioning.

One circle-criterion observer carries the inverters. Its certificate holds for every set of trusted meters and
every switching between them. The residuals are explained by correlated load errors, by meter errors, and by
as few manipulated meters as possible.
"""

from gridsec.estimators.front.posterior import LoadDoubt
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
from gridsec.estimators.sequential.state import (
    ObserverRecord,
    SequentialState,
    SuspicionRecord,
    distrusted,
    init,
    observed,
    renew,
    resume,
    settling_s,
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
    "ObserverRecord",
    "SequentialDesign",
    "SequentialOptions",
    "SequentialState",
    "SuspicionRecord",
    "design",
    "distrusted",
    "from_arrays",
    "init",
    "observed",
    "progress",
    "renew",
    "resume",
    "settling_s",
    "step",
    "to_arrays",
    "warm_start",
]
