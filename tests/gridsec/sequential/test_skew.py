"""Changes of the voltages within measured clock offsets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.clock_offsets import TAP_PU, run
from gridsec.online import Decision
from gridsec.sequential import init, step
from gridsec.sequential.skew import follow
from tests.gridsec.sequential.test_monitor import prepare
from tests.gridsec.street import Street, make_plant

P = 8


def test_changes_means_and_scales_are_those_of_the_definition() -> None:
    """Against sums over all pairs of ticks, for random voltages."""
    made = prepare(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    rng = np.random.default_rng(2)
    offset = np.array([0.5, -0.9, 2.0, -3.0, 7.0, 40.0, np.nan, 0.0])
    v2, noise = 1.0 + 0.01 * rng.standard_normal((150, P)), np.full((len(made.lengths), P), 1e-9)
    skew, c = None, np.zeros(v2.shape)
    for t, now in enumerate(v2):
        skew = follow(made, skew, offset, now, noise)
        for j in range(P):
            ticks = int(np.ceil(abs(offset[j]))) + 1 if np.nan_to_num(offset[j]) else 0
            c[t, j] = max((abs(now[j] - v2[t - k, j]) for k in range(1, min(ticks, t) + 1)), default=0.0)
        assert skew is not None
        np.testing.assert_allclose(skew.moved[-1], c[t], rtol=1e-12)
    assert skew is not None
    for s, length in enumerate(made.lengths):
        square = c[-length:].mean(axis=0) ** 2
        assert (skew.variance[s] >= square * (1.0 - 1e-12))[square > 1e-10].all()
        assert (skew.variance[s] <= 16.0 * square * (1.0 + 1e-12)).all()
    longest = made.lengths[-1]
    for s, length in enumerate(made.lengths):
        expected = (length < 4.0 * np.abs(np.nan_to_num(offset))) & (length < longest)
        assert skew.aside[s].tolist() == expected.tolist()


@pytest.mark.parametrize("offset", [None, np.zeros(P), np.full(P, np.nan)])
def test_without_a_measured_offset_nothing_is_kept(offset: np.ndarray | None) -> None:
    made = prepare(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    noise = np.full((len(made.lengths), P), 1e-9)
    kept = follow(made, None, np.full(P, 1.0), np.ones(P), noise)
    assert kept is not None
    assert follow(made, kept, offset, np.ones(P), noise) is None


def test_all_clocks_off_and_a_still_feeder_is_clean_and_liars_are_named() -> None:
    """Offsets of 20 s: the longest scale alone judges, also at ticks without a look at it."""
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4))
    state, offset = init(made, street.t - 1.0), np.full(P, 20.0)
    said = []
    for k in range(200):
        frame = replace(street.frame(), t=street.t + k, clock_offset=offset)
        if k >= 100:
            frame = replace(frame, y=frame.y + 0.05 * (np.arange(P) == 2))
        state, _, verdict = step(made, state, frame)
        said.append(verdict)
    assert all(one.decision is Decision.CLEAN for one in said[70:100])
    assert said[-1].suspects.tolist() == [k == 2 for k in range(P)]
    state, _, verdict = step(made, state, replace(street.frame(), t=street.t + 200.0))
    assert state.skew is None


@pytest.mark.acceptance
def test_tap_steps_accuse_no_meter_with_a_measured_offset() -> None:
    """Clocks within 3 s, a tap step every two minutes: without the offsets honest meters are named."""
    unknown, _ = run(0, 480, TAP_PU, measured=False)
    measured, _ = run(0, 480, TAP_PU, measured=True)
    assert unknown["honest"] > 0
    assert measured["honest"] == 0
    assert measured["attacked"] == 0
    assert measured["named"] == measured["liars"]
