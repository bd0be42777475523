"""The monitor that scales: one observer, correlated loads, evidence on several time scales.

    design(plant, doubt=..., step_s=...) -> SequentialDesign
    init(design, t) -> SequentialState
    step(design, state, frame) -> (SequentialState, Estimate, Verdict)

One circle-criterion observer carries the inverters, certified for every set of trusted meters and every
switching between them. What the readings then deviate from it is explained by loads that are wrong in a
way that neighbours share, by meters' errors, and, where these do not suffice, by as few liars as possible.
"""

from gridsec.estimators.sequential.commission import (
    Commission,
    Learning,
    LearningReason,
    from_arrays,
    to_arrays,
)
from gridsec.estimators.sequential.design import SequentialDesign, SequentialOptions, design
from gridsec.estimators.sequential.distrust import SuspicionRecord, distrusted, warm_start
from gridsec.estimators.sequential.learning import LearningProgress, LearningState, progress
from gridsec.estimators.sequential.loads import LoadDoubt
from gridsec.estimators.sequential.state import SequentialState, init, renew
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
