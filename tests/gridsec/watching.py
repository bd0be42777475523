"""A street and an estimator of it, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from gridsec.arrays import Bools, Ints
from gridsec.estimators import exact_bank
from gridsec.interface import Decision, Estimate, Verdict
from tests.gridsec.street import Street

Answers = list[tuple[Estimate, Verdict]]
Honest = Callable[[Any, Any, Verdict, Ints], Bools]
"""Mask of honest meters that are wrongly accused, from design, state, verdict and the honest meters."""


def watcher(family: ModuleType, wronged: Honest | None) -> Callable[..., tuple[Any, Answers]]:
    """Runs of a family; `wronged` is None where its bounds hold for no honest meter alone."""

    def watch(
        street: Street,
        made: Any,
        frames: int,
        *,
        h: float = 1.0,
        state: Any = None,
        lies: dict[int, float] | None = None,
        silent: tuple[int, ...] = (),
        change: object = None,
        sound: bool = True,
    ) -> tuple[Any, Answers]:
        """Run the street and its estimator; check on every frame what must always hold."""
        state = family.init(made, street.t) if state is None else state
        answers = []
        for _ in range(frames):
            street.advance(h)
            frame = street.frame(lies, silent)
            if callable(change):
                frame = change(frame)
            state, estimate, verdict = family.step(made, state, frame)
            assert estimate.t == frame.t
            finite = (
                estimate.v2,
                estimate.bound,
                estimate.v2_bus,
                estimate.x,
                verdict.threshold,
                verdict.attack,
            )
            assert all(np.isfinite(values).all() for values in finite)
            assert np.array_equal(np.isnan(verdict.score), ~frame.seen | ~np.isfinite(frame.y))
            assert not (estimate.trusted & (verdict.suspects | ~frame.seen)).any()
            assert (verdict.attack[~verdict.suspects] == 0).all()
            np.testing.assert_array_equal(estimate.v2, estimate.v2_bus[street.plant.feeder.bus])
            if sound and wronged is not None:
                assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
                honest = np.setdiff1d(np.arange(frame.y.size), list(lies or {}))
                assert not wronged(made, state, verdict, honest).any()
            answers.append((estimate, verdict))
        return state, answers

    return watch


def _above_or_not_cleared(made: Any, state: Any, verdict: Verdict, honest: Ints) -> Bools:
    """A meter that lied before is cleared after `release` honest readings."""
    above = verdict.score[honest] > verdict.threshold[honest]
    cleared = state.tally.below >= made.options.release
    return np.asarray(above | (verdict.suspects & ((state.tally.below == 0) | cleared))[honest])


watch = watcher(exact_bank, _above_or_not_cleared)


def decisions(answers: Answers) -> list[Decision]:
    return [verdict.decision for _, verdict in answers]
