"""A street and its monitor, frame by frame."""

from __future__ import annotations

import numpy as np

from gridsec.estimators import exact_bank
from gridsec.estimators.exact_bank.step import MonitorDesign, MonitorState
from gridsec.interface import Decision, Estimate, Verdict
from tests.gridsec.street import Street

Answers = list[tuple[Estimate, Verdict]]


def watch(
    street: Street,
    design: MonitorDesign,
    frames: int,
    *,
    h: float = 1.0,
    state: MonitorState | None = None,
    lies: dict[int, float] | None = None,
    silent: tuple[int, ...] = (),
    change: object = None,
    sound: bool = True,
) -> tuple[MonitorState, Answers]:
    """Run the street and its monitor; check on every frame what must always hold."""
    state = exact_bank.init(design, street.t) if state is None else state
    answers = []
    for _ in range(frames):
        street.advance(h)
        frame = street.frame(lies, silent)
        if callable(change):
            frame = change(frame)
        state, estimate, verdict = exact_bank.step(design, state, frame)
        assert estimate.t == frame.t
        for values in (
            estimate.v2,
            estimate.bound,
            estimate.v2_bus,
            estimate.x,
            verdict.threshold,
            verdict.attack,
        ):
            assert np.isfinite(values).all()
        assert np.array_equal(np.isnan(verdict.score), ~frame.seen | ~np.isfinite(frame.y))
        assert not (estimate.trusted & verdict.suspects).any()
        assert not (estimate.trusted & ~frame.seen).any()
        assert (verdict.attack[~verdict.suspects] == 0).all()
        if sound:
            assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
            honest = np.setdiff1d(np.arange(frame.y.size), list(lies or {}))
            assert not (verdict.score[honest] > verdict.threshold[honest]).any()
            # Who lied before is cleared after `release` honest readings.
            cleared = state.tally.below >= design.options.release
            assert not (verdict.suspects & ((state.tally.below == 0) | cleared))[honest].any()
        answers.append((estimate, verdict))
    return state, answers


def decisions(answers: Answers) -> list[Decision]:
    return [verdict.decision for _, verdict in answers]
