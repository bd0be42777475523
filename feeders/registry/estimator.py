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
    """Options of a design that do not change its result.

    Attributes
    ----------
    workers
        Processes for designs by matrix inequality.
    where
        Folder of the cache of such designs; None: that of `feeders.registry.design_cache.folder`.
    progress
        Called with (done, total) during such designs.
    """

    workers: int = 1
    where: Path | None = None
    progress: Callable[[int, int], None] | None = None


@dataclass(frozen=True, slots=True)
class BiasLearning:
    """Functions of an estimator that learns the fixed errors of its meters.

    Attributes
    ----------
    needed_s
        `needed_s(design)`: learning time, s; 0 for never.
    init
        `init(design, t, commission)`: initial state with earlier knowledge of the fixed errors.
    commission
        `commission(state)`: present knowledge of the fixed errors.
    renew
        `renew(design, state, which)`: state after replacement of meters; their learning restarts.
    read
        `read(design, arrays)`: inverse of `gridsec.estimators.sequential.to_arrays`; a `ValueError` names
        every contradiction to the design.
    progress
        `progress(design, commission)`: state and reason of each meter, and the expected time.
    """

    needed_s: Callable[[Any], float]
    init: Callable[[Any, float, Commission], Any]
    commission: Callable[[Any], Commission]
    renew: Callable[[Any, Any, Bools], Any]
    read: Callable[[Any, Mapping[str, Floats]], Commission]
    progress: Callable[[Any, Commission], LearningProgress]


@dataclass(frozen=True, slots=True)
class WarmStart:
    """Functions of an estimator that keeps suspects over a restart.

    Attributes
    ----------
    distrusted
        `distrusted(design, state)`: present suspicion record.
    warm_start
        `restore(design, state, distrust)`: state from `init` with these devices distrusted.
    """

    distrusted: Callable[[Any, Any], SuspicionRecord]
    warm_start: Callable[[Any, Any, SuspicionRecord], Any]


@dataclass(frozen=True, slots=True)
class Estimator:
    """Estimator: three functions, a name, and optional abilities.

    Attributes
    ----------
    name
        As in `feeder.toml`.
    summary
        One-line description.
    design
        `design(site, job)`: the design; raises `NotObservable` or `DesignInfeasible`. Any other exception of
        an external estimator becomes `EstimatorUnusable` in `feeders.registry.registry.design`.
    init
        `init(design, t)`: initial state.
    step
        `step(design, state, frame)`: next state, estimate and verdict; never raises on data.
    observers
        Number of observers, or candidate sets, of a design.
    proof
        One-line proof of convergence of a design's estimate; empty without one.
    withstands
        Number of manipulated meters that a design identifies; None: `max_attacked` of the feeder's file.
    bias_learning
        Learning of the meters' fixed errors; None without it.
    warm_start
        Restoring of suspects after a restart; None without it.
    """

    name: str
    summary: str
    design: Callable[[Site, DesignOptions], Any]
    init: Callable[[Any, float], Any]
    step: Callable[[Any, Any, Frame], tuple[Any, Estimate, Verdict]]
    observers: Callable[[Any], int]
    proof: Callable[[Any], str]
    withstands: Callable[[Any], int] | None = None
    bias_learning: BiasLearning | None = None
    warm_start: WarmStart | None = None


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
