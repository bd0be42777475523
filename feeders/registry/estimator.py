"""What an estimator family is: its functions, what it can do besides, and a design ready to watch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from feeders.model.site import Site
from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential import Commission, Distrust, LearningProgress
from gridsec.interface import Estimate, Frame, Verdict

__all__ = ["Family", "Job", "Learner", "Memory", "Watcher"]


@dataclass(frozen=True, slots=True)
class Job:
    """How a design is made, apart from what for.

    Attributes
    ----------
    workers
        Processes for designs by matrix inequality.
    where
        Folder of the cache of such designs; None: that of `feeders.registry.design_cache.folder`.
    progress
        Called with (done, total) while such designs are made.
    """

    workers: int = 1
    where: Path | None = None
    progress: Callable[[int, int], None] | None = None


@dataclass(frozen=True, slots=True)
class Learner:
    """What a family can do besides that learns the fixed errors of its meters.

    Attributes
    ----------
    needed_s
        `needed_s(design)`: over what time they are learned, s; 0 for never.
    init
        `init(design, t, commission)` begins to watch with what is known from before.
    commission
        `commission(state)`: what is known now.
    renew
        `renew(design, state, which)`: some meters were replaced and are learned anew.
    read
        `read(design, arrays)`: what `gridsec.estimators.sequential.to_arrays` gave, if it fits the design; a
        `ValueError` names every problem.
    progress
        `progress(design, commission)`: state and reason of each meter, and the time expected.
    """

    needed_s: Callable[[Any], float]
    init: Callable[[Any, float, Commission], Any]
    commission: Callable[[Any], Commission]
    renew: Callable[[Any, Any, Bools], Any]
    read: Callable[[Any, Mapping[str, Floats]], Commission]
    progress: Callable[[Any, Commission], LearningProgress]


@dataclass(frozen=True, slots=True)
class Memory:
    """What a family can do besides that can go on distrusting who was.

    Attributes
    ----------
    distrusted
        `distrusted(design, state)`: who is not believed now.
    restore
        `restore(design, state, distrust)`: a state from `init`, in which these are not believed.
    """

    distrusted: Callable[[Any, Any], Distrust]
    restore: Callable[[Any, Any, Distrust], Any]


@dataclass(frozen=True, slots=True)
class Family:
    """An estimator family: three functions and a name.

    Attributes
    ----------
    name
        As in `feeder.toml`.
    summary
        One line for people.
    design
        `design(site, job)` prepares; raises `NotObservable` or `DesignInfeasible`. Whatever else another
        package's raises becomes `EstimatorUnusable` in `feeders.registry.registry.design`.
    init
        `init(design, t)` begins to watch.
    step
        `step(design, state, frame)` takes one frame in and never raises on data.
    observers
        How many observers, or candidate sets, a design runs.
    proof
        One line on why its estimate converges; empty where nothing is proven.
    withstands
        How many manipulated meters a design tells apart; None: as many as the feeder's file asks for.
    learner
        How it learns its meters' fixed errors; None: it does not.
    memory
        How it goes on distrusting who was; None: it begins anew.
    """

    name: str
    summary: str
    design: Callable[[Site, Job], Any]
    init: Callable[[Any, float], Any]
    step: Callable[[Any, Any, Frame], tuple[Any, Estimate, Verdict]]
    observers: Callable[[Any], int]
    proof: Callable[[Any], str]
    withstands: Callable[[Any], int] | None = None
    learner: Learner | None = None
    memory: Memory | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Watcher:
    """A finished design, ready to watch one feeder.

    Attributes
    ----------
    family
        What kind.
    design
        The family's own design.
    asked
        M of the feeder's file.
    """

    family: Family
    design: Any
    asked: int = 0

    @property
    def max_attacked(self) -> int:
        """How many manipulated meters it tells apart."""
        return self.asked if self.family.withstands is None else self.family.withstands(self.design)

    @property
    def observers(self) -> int:
        """How many observers, or candidate sets, run."""
        return self.family.observers(self.design)

    @property
    def proof(self) -> str:
        """One line on why the estimate converges; empty where nothing is proven."""
        return self.family.proof(self.design)

    @property
    def learner(self) -> Learner | None:
        """How the meters' fixed errors are learned; None where they are not."""
        learner = self.family.learner
        return learner if learner is not None and learner.needed_s(self.design) > 0 else None

    def init(self, t: float, commission: Commission | None = None) -> Any:
        """Begin to watch.

        Parameters
        ----------
        t
            Unix time, s.
        commission
            What is known of the meters' fixed errors from before, for families that learn them.
        """
        if self.learner is None or commission is None:
            return self.family.init(self.design, t)
        return self.learner.init(self.design, t, commission)

    def step(self, state: Any, frame: Frame) -> tuple[Any, Estimate, Verdict]:
        """Take one frame in.

        Parameters
        ----------
        state
            From `init` or the last step.
        frame
            Everything known at one tick.
        """
        return self.family.step(self.design, state, frame)
