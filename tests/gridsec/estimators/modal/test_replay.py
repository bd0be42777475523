"""Exact scores of suspected onsets against dense filters, and identification with missing readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Dense, Source
from gridsec.estimators.modal import core, full, replay, signatures
from tests.gridsec.estimators.modal.test_core import LIAR, MODEL
from tests.gridsec.estimators.modal.test_detector import busbar
from tests.gridsec.estimators.modal.test_filter import masks, mixed, proportional

KINDS = ("outage", "half", "random", "alternating")


@pytest.mark.canary("half-proportional", "alternating-mixed", "outage-busbar", "random-proportional")
@pytest.mark.parametrize("make", [proportional, busbar, mixed])
@pytest.mark.parametrize("kind", KINDS)
def test_scores_and_means_equal_those_of_the_dense_filter(make: object, kind: str) -> None:
    """Posterior of faults N(0, 1) in all members: mean, information and effect on the means of w and b."""
    assert callable(make)
    model, onset, ticks = make(), 22, 50
    kernel = core.assemble(model, np.zeros((13, 12)), np.ones(12), gamma=1e6)
    made, seen, p = kernel.modes, masks(kind, 12, ticks), 12
    readings = Source(model, np.random.default_rng(5)).ticks(ticks)
    readings[onset:, 4] += 0.004
    dense, without = Dense(model, np.eye(p), 1.0), Dense(model)
    state, onsets = core.init(kernel, 0.0), signatures.empty(made, 1)
    for k in range(ticks):
        state, _ = core.step(kernel, state, float(k), readings[k], seen[k])
        begun = [0] if k == onset else []
        assert state.update is not None
        onsets = signatures.follow(made, onsets, state.update, state.static, 1.0, begun=begun)
        for each in (dense, without):
            each.step(1.0 if k else 0.0, readings[k], seen[k], level=float(k >= onset))
    (found,) = replay.replayed(made, state.history, onsets, [0])
    cov = dense.cov[3 * p :, 3 * p :]
    assert np.allclose(np.linalg.inv(cov), np.eye(p) + found.information, rtol=1e-6, atol=1e-3)
    assert np.allclose(cov @ found.score, dense.mean[3 * p :], atol=1e-8 * np.abs(dense.mean[3 * p :]).max())
    change = dense.mean[: 3 * p] - without.mean
    moved = -found.shift @ dense.mean[3 * p :]
    merged = np.concatenate([change[:p], change[p : 2 * p] + change[2 * p :]])
    assert np.allclose(moved, merged, atol=1e-6 * np.abs(merged).max())
    joint = found.joint(made)
    assert np.allclose(made.U @ joint.score, found.score)


@pytest.mark.parametrize("rows", [(0,), (1,), (2,), (1, 0), (2, 1, 0)])
def test_scores_from_the_latest_kept_state_are_those_from_the_first(rows: tuple[int, ...]) -> None:
    """Onsets 70, 20 and 9 ticks old of 90: each replay begins at a kept state, or at the start."""
    kernel, ticks, ages = core.assemble(MODEL, np.zeros((13, 12)), np.ones(12), gamma=1e6), 90, (9, 20, 70)
    made, seen = kernel.modes, masks("random", 12, 90)
    readings = Source(MODEL, np.random.default_rng(5)).ticks(ticks)
    state, onsets = core.init(kernel, 0.0), signatures.empty(made, 3)
    for k in range(ticks):
        state, _ = core.step(kernel, state, float(k), readings[k], seen[k])
        assert state.update is not None
        begun = [row for row, age in enumerate(ages) if k == ticks - age]
        onsets = signatures.follow(made, onsets, state.update, state.static, 1.0, begun=begun)
    history = state.history
    first = ticks - max(ages[row] for row in rows)
    assert len(history.until(first)[0].readings) == {81: 80, 70: 64, 20: 0}[first]
    found = replay.replayed(made, history, onsets, rows)
    whole = replace(history, middle=None, recent=())
    for one, other in zip(found, replay.replayed(made, whole, onsets, rows), strict=True):
        assert one.row == other.row
        for name in ("score", "information", "shift"):
            expected = getattr(other, name)
            assert np.allclose(getattr(one, name), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.canary("late")
@pytest.mark.parametrize("kind", [*KINDS, "late"])
def test_one_meter_is_named_with_missing_readings(kind: str) -> None:
    """A step of 1 % names this meter and no other; "late": readings are missing after the alarm only."""
    kernel = core.assemble(MODEL, np.zeros((13, 12)), np.full(12, 0.1), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    seen = np.ones((300, 12), dtype=np.bool_)
    liar = LIAR + 1 if kind == "half" else LIAR
    if kind == "late":
        seen[260:, :3] = False
    else:
        seen[:60] = seen[240:] = masks(kind, 12, 60)
    for k in range(300):
        m = source.tick() + 0.02 * (k >= 200) * np.eye(12)[liar]
        state, evidence = core.step(kernel, state, float(k), m, seen[k])
    assert core.alarmed(kernel, evidence)
    suspicion = core.identify(kernel, state, evidence)
    assert np.flatnonzero(suspicion.found.named).tolist() == [liar]
    place = MODEL.meters[liar]
    plain, right = core.estimate(kernel, state), core.estimate(kernel, state, suspicion)
    assert abs(right.mean[place] - plain.mean[place]) > 2.0 * np.sqrt(right.variance[place])


def test_readings_are_kept_up_to_twice_the_half() -> None:
    kernel = core.assemble(MODEL, np.zeros((13, 12)), np.ones(12), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    for k in range(5 * replay.HALF):
        state, _ = core.step(kernel, state, float(k), source.tick())
        count = len(state.history.readings)
        assert count <= 2 * replay.HALF
        assert k < replay.HALF or count >= replay.HALF
        assert state.history.start[0].t == max(0.0, float(k - count))


@pytest.mark.parametrize("make", [proportional, busbar, mixed])
@pytest.mark.parametrize("kind", ["complete", "random"])
def test_a_freed_filter_equals_the_dense_one_with_unknown_faults(make: object, kind: str) -> None:
    """Faults N(0, 1) of three members since an onset: means and covariance of w and b."""
    assert callable(make)
    model, onset, ticks, p = make(), 12, 40, 12
    kernel = core.assemble(model, np.zeros((13, 12)), np.ones(12), gamma=1e6)
    made, faults = kernel.modes, np.isin(np.arange(p), [1, 4, 5])
    seen = np.ones((ticks, p), dtype=np.bool_) if kind == "complete" else masks(kind, p, ticks)
    readings = Source(model, np.random.default_rng(5)).ticks(ticks)
    readings[onset:, faults] += 0.004
    dense = Dense(model, np.eye(p)[:, faults], 1.0)
    state, onsets = core.init(kernel, 0.0), signatures.empty(made, 1)
    for k in range(ticks):
        state, _ = core.step(kernel, state, float(k), readings[k], seen[k])
        assert state.update is not None
        begun = [0] if k == onset else []
        onsets = signatures.follow(made, onsets, state.update, state.static, 1.0, begun=begun)
        dense.step(1.0 if k else 0.0, readings[k], seen[k], level=float(k >= onset))
    if kind == "complete":
        now, whole = signatures.joint(made, onsets, state.static, 0), None
    else:
        now, whole = replay.replayed(made, state.history, onsets, [0])[0].joint(made), state.filter.full
    whole = full.expanded(made, state.filter, state.static) if whole is None else whole
    freed = replay.freed(made, whole, now, made.U.T[:, faults], np.ones(3))
    of_loads = replay.freed(made, whole, now, made.U.T[:, faults], np.ones(3), loads=True)
    for found, part in ((freed, 0.0), (of_loads, 1.0)):
        merged = np.kron([[1, 0, 0], [0, 1, 1]], np.eye(p))
        merged = np.hstack([merged, part * np.vstack([np.eye(p), np.zeros((p, p))])[:, faults]])
        mean, cov = merged @ dense.mean, merged @ dense.cov @ merged.T
        assert np.allclose(found.mean.ravel(), mean, atol=1e-6 * np.abs(mean).max())
        assert np.allclose(found.cov, cov, atol=1e-6 * np.abs(cov).max())
