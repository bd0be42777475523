"""Estimators: functions, optional abilities, and a design with its estimator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from feeders.model.site import Site
from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential import Commission, LearningProgress, SuspicionRecord
from gridsec.interface import Estimate, Frame, Verdict

__all__ = ["BiasLearning", "DesignOptions", "DesignedEstimator", "Estimator", "WarmStart"]


@dataclass(frozen=True, slots=True)
class DesignOptions:
    """Options of a design that do not change its result."""

    workers: int = 1  # processes for designs by matrix inequality
    # folder of the cache of such designs; None: that of `feeders.registry.design_cache.folder`
    where: Path | None = None
    progress: Callable[[int, int], None] | None = None  # called with (done, total) during such designs


@dataclass(frozen=True, slots=True)
class BiasLearning:
    """Functions of an estimator that learns the fixed errors of its meters."""

    needed_s: Callable[[Any], float]  # `needed_s(design)`: learning time, s; 0 for never
    # `init(design, t, commission)`: initial state with earlier knowledge of the fixed errors
    init: Callable[[Any, float, Commission], Any]
    commission: Callable[[Any], Commission]  # `commission(state)`: present knowledge of the fixed errors
    # `renew(design, state, which)`: state after replacement of meters; their learning restarts
    renew: Callable[[Any, Any, Bools], Any]
    # `read(design, arrays)`: inverse of `gridsec.estimators.sequential.to_arrays`; a `ValueError` names every
    # contradiction to the design
    read: Callable[[Any, Mapping[str, Floats]], Commission]
    # `progress(design, commission)`: state and reason of each meter, and the expected time
    progress: Callable[[Any, Commission], LearningProgress]


@dataclass(frozen=True, slots=True)
class WarmStart:
    """Functions of an estimator that keeps suspects over a restart."""

    distrusted: Callable[[Any, Any], SuspicionRecord]  # `distrusted(design, state)`: present suspicion record
    # `restore(design, state, distrust)`: state from `init` with these devices distrusted
    warm_start: Callable[[Any, Any, SuspicionRecord], Any]


@dataclass(frozen=True, slots=True)
class Estimator:
    """Estimator: three functions, a name, and optional abilities."""

    name: str  # as in `feeder.toml`
    summary: str  # one-line description
    # `design(site, job)`: the design; raises `NotObservable` or `DesignInfeasible`. Any other exception of an
    # external estimator becomes `EstimatorUnusable` in `feeders.registry.registry.design`.
    design: Callable[[Site, DesignOptions], Any]
    init: Callable[[Any, float], Any]  # `init(design, t)`: initial state
    # `step(design, state, frame)`: next state, estimate and verdict; never raises on data
    step: Callable[[Any, Any, Frame], tuple[Any, Estimate, Verdict]]
    observers: Callable[[Any], int]  # number of observers, or candidate sets, of a design
    proof: Callable[[Any], str]  # one-line proof of convergence of a design's estimate; empty without one
    # number of manipulated meters that a design identifies; None: `max_attacked` of the feeder's file
    withstands: Callable[[Any], int] | None = None
    bias_learning: BiasLearning | None = None  # learning of the meters' fixed errors; None without it
    warm_start: WarmStart | None = None  # restoring of suspects after a restart; None without it


@dataclass(frozen=True, slots=True, eq=False)
class DesignedEstimator:
    """Finished design of one feeder, with its estimator."""

    family: Estimator  # The estimator
    design: Any  # Design by the estimator
    asked: int = 0  # M of the feeder's file

    @property
    def max_attacked(self) -> int:
        """Number of manipulated meters that it identifies."""
        return self.asked if self.family.withstands is None else self.family.withstands(self.design)

    @property
    def observers(self) -> int:
        """Number of observers, or candidate sets."""
        return self.family.observers(self.design)

    @property
    def proof(self) -> str:
        """One-line proof of convergence; empty without one."""
        return self.family.proof(self.design)

    @property
    def bias_learning(self) -> BiasLearning | None:
        """Learning of the meters' fixed errors; None without it."""
        learner = self.family.bias_learning
        return learner if learner is not None and learner.needed_s(self.design) > 0 else None

    def init(self, t: float, commission: Commission | None = None) -> Any:
        """Initial state at a Unix time, s, with earlier knowledge of the meters' fixed errors."""
        if self.bias_learning is None or commission is None:
            return self.family.init(self.design, t)
        return self.bias_learning.init(self.design, t, commission)

    def step(self, state: Any, frame: Frame) -> tuple[Any, Estimate, Verdict]:
        """Process one frame."""
        return self.family.step(self.design, state, frame)
