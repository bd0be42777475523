"""Streets with AC power flow for the tests of the front end and of the estimator `modal`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gridsec.estimators import front
from gridsec.estimators.front import FrontDesign, FrontOptions, LoadDoubt
from gridsec.estimators.modal import monitor
from gridsec.estimators.modal.monitor import ModalDesign, ModalState
from gridsec.estimators.plant import Plant
from gridsec.interface import Estimate, Frame, Verdict
from tests.gridsec.street import BASE_KVA, Street

Answers = list[tuple[Estimate, Verdict]]


def doubt(plant: Plant) -> LoadDoubt:
    """For the street's loads: p metered within 1 %, power factors known within limits."""
    n = len(plant.feeder.customers)
    return LoadDoubt(np.full(n, 0.03 / BASE_KVA), np.full(n, 0.6 / BASE_KVA), 600.0, common_q=0.5)


def front_end(plant: Plant, *, step_s: float = 1.0, commission_s: float = 0.0) -> FrontDesign:
    """The front end of a street."""
    options = FrontOptions(commission_s=commission_s)
    return front.design(plant, doubt=doubt(plant), step_s=step_s, options=options)


def prepare(plant: Plant, *, step_s: float = 1.0, commission_s: float = 0.0) -> ModalDesign:
    """The monitor of a street."""
    options = FrontOptions(commission_s=commission_s)
    return monitor.design(plant, doubt=doubt(plant), step_s=step_s, options=options)


def watch(
    street: Street,
    design: ModalDesign,
    frames: int,
    *,
    h: float = 1.0,
    state: ModalState | None = None,
    lies: dict[int, float] | None = None,
    silent: tuple[int, ...] = (),
    change: Callable[[Frame], Frame] | None = None,
) -> tuple[ModalState, Answers]:
    """Run the street and its monitor; check on every frame what must always hold."""
    state = monitor.init(design, street.t) if state is None else state
    answers = []
    for _ in range(frames):
        street.advance(h)
        frame = street.frame(lies, silent)
        frame = frame if change is None else change(frame)
        state, estimate, verdict = monitor.step(design, state, frame)
        assert estimate.t == frame.t
        for values in (
            estimate.v2,
            estimate.bound,
            estimate.std,
            estimate.v2_bus,
            estimate.x,
            verdict.threshold,
            verdict.attack,
        ):
            assert np.isfinite(values).all()
        assert not (estimate.trusted & verdict.suspects).any()
        assert not (estimate.trusted & ~frame.seen).any()
        assert (verdict.attack[~verdict.suspects] == 0).all()
        assert (estimate.bound > 0).all()
        answers.append((estimate, verdict))
    return state, answers
