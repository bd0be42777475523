"""The modal filter against the dense Kalman filter of all states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Dense, Source, model_of, tree
from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal import full, static
from gridsec.estimators.modal.model import Modes, ResidualModel, modes

EXACT = 1e-9
"""Largest difference between two exact filters, relative to the largest number."""


def close(one: Floats, other: Floats, scale: Floats | None = None) -> bool:
    """Equality within `EXACT` of the largest entry."""
    size = np.abs(other if scale is None else scale).max()
    return bool(np.abs(one - other).max() <= EXACT * size)


def proportional(size: int = 12, **given: float) -> ResidualModel:
    """A model with B proportional to D beside the loads that last."""
    feeder = tree(size, np.random.default_rng(size))
    model = model_of(feeder, **given)
    return replace(model, busbar=model.fixed[0] / model.white[0] * model.flicker)


def mixed(size: int = 12, **given: float) -> ResidualModel:
    """A model of two accuracy classes and two jitters."""
    random = np.random.default_rng(size)
    classes = np.where(random.random(size) < 0.5, 0.002, 0.01)
    jitter = np.where(random.random(size) < 0.5, 3e-4, 8e-4)
    return model_of(tree(size, random), classes=classes, jitter=jitter, **given)


def covariance(made: Modes, state: modal.FilterState) -> Floats:
    """Covariance of (w, b) in the coordinates of the meters."""
    T = made.back
    blocks = [[(T * c) @ T.T for c in state.cov[:2]], [(T * c) @ T.T for c in state.cov[1:]]]
    return np.block(blocks)


@pytest.mark.parametrize("fixed_s", [np.inf, 3000.0])
def test_equals_the_dense_filter_where_b_is_proportional(fixed_s: float) -> None:
    """Innovations, their covariance, means and covariances; intervals that change."""
    model = proportional(fixed_s=fixed_s)
    made, random = modes(model), np.random.default_rng(1)
    assert made.sign.size == 0
    state, dense, t = modal.start(made, 0.0), Dense(model), 0.0
    for k in range(60):
        h = 0.0 if k == 0 else float(random.choice([0.3, 1.0, 60.0, 900.0]))
        t += h
        m = 0.01 * random.standard_normal(made.size)
        state, update = modal.step(made, state, t, m)
        nu, V = dense.step(h, m)
        assert close(made.back @ update.innovation, nu)
        assert close((made.back * update.variance) @ made.back.T, V)
    assert close(np.concatenate(list(state.mean @ made.back.T)), dense.mean[: 2 * made.size])
    assert close(covariance(made, state), dense.cov[: 2 * made.size, : 2 * made.size])


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_loads_that_jump_are_those_of_the_dense_filter(share: float) -> None:
    """The variance of the loads' errors gains up to three times its prior; also with missing readings."""
    model, random = mixed(), np.random.default_rng(4)
    made = modes(model)
    state, more, dense = modal.start(made, 0.0), static.start(made), Dense(model)
    for k in range(60):
        jump, seen = float(random.choice([0.0, 0.1, 3.0])), random.random(made.size) >= share
        m = 0.01 * random.standard_normal(made.size)
        state, more, update = full.step(
            made, state, more, float(k), m, None if seen.all() else seen, jump=jump
        )
        nu, V = dense.step(float(k > 0), m, seen, jump=jump)
        assert np.isclose(more.square, nu @ np.linalg.solve(V, nu), rtol=1e-7)
        if update.exact is not None:
            assert close(update.exact.half @ update.exact.white, nu)
            assert close(update.exact.half @ update.exact.half.T, V)
    assert (state.full is None) == (share == 0.0)
    if state.full is None:
        g_w = state.mean[0] - more.signature[0] * (made.directions @ more.theta)
        assert close(made.back @ g_w, dense.varies, dense.varies)
    else:
        assert close(state.full.mean[0], dense.varies)


@pytest.mark.parametrize("make", [model_of, mixed])
@pytest.mark.parametrize("fixed_s", [np.inf, 3000.0])
def test_directions_make_it_exact_for_every_b(make: object, fixed_s: float) -> None:
    """A busbar class, and two classes of meters: innovations and the mean of what lasts."""
    of_tree = tree(12, np.random.default_rng(3))
    model = mixed(fixed_s=fixed_s) if make is mixed else model_of(of_tree, fixed_s=fixed_s)
    made, random = modes(model), np.random.default_rng(2)
    assert made.sign.size > 0
    state, more, dense, t = modal.start(made, 0.0), static.start(made), Dense(model), 0.0
    for k in range(80):
        h = 0.0 if k == 0 else float(random.choice([1.0, 60.0]))
        t += h
        m = 0.01 * random.standard_normal(made.size)
        known, cov = made.directions @ more.theta, more.cov
        state, more, update = full.step(made, state, more, t, m)
        nu, V = dense.step(h, m)
        assert close(made.back @ (update.innovation - more.gamma * known), nu)
        assert np.isclose(more.square, nu @ np.linalg.solve(V, nu), rtol=1e-7)
        if made.sign.size <= static.FEW:
            side = made.back @ (more.gamma[:, None] * made.directions)
            assert close((made.back * update.variance) @ made.back.T + side @ cov @ side.T, V)
    lasts = state.mean[1] + (1.0 - more.signature[1]) * (made.directions @ more.theta)
    assert close(made.back @ lasts, dense.lasts)
    varies = state.mean[0] - more.signature[0] * (made.directions @ more.theta)
    assert close(made.back @ varies, dense.varies, dense.mean)


def masks(kind: str, size: int, ticks: int) -> Bools:
    """Patterns of members with a reading, (ticks, size)."""
    seen, random = np.ones((ticks, size), dtype=np.bool_), np.random.default_rng(9)
    if kind == "half":
        seen[:, ::2] = False
    elif kind == "random":
        seen = random.random((ticks, size)) >= 0.5
    elif kind == "alternating":
        seen = (np.arange(ticks)[:, None] + np.arange(size)) % 4 == 0
    else:
        seen[20:40, 3], seen[25, :5], seen[30] = False, False, False
    return seen


@pytest.mark.parametrize("make", [proportional, model_of, mixed])
@pytest.mark.parametrize("kind", ["outage", "half", "random", "alternating"])
def test_missing_readings_are_exact(make: object, kind: str) -> None:
    """Scores of the innovations, means and covariance of the dense filter; intervals that change."""
    tree12 = tree(12, np.random.default_rng(3))
    model = model_of(tree12) if make is model_of else make()  # type: ignore[operator]
    made, source = modes(model), Source(model, np.random.default_rng(5))
    seen, dense, p = masks(kind, made.size, 60), Dense(model), made.size
    state, more = modal.start(made, 0.0), static.start(made)
    merged = np.kron([[1, 0, 0], [0, 1, 1]], np.eye(p))
    for k in range(60):
        m, h = source.tick(), (0.0, 1.0, 30.0, 0.5)[min(k, 1 + k % 3)]
        state, more, _ = full.step(made, state, more, state.t + h, np.where(seen[k], m, 1e3), seen[k])
        nu, V = dense.step(h, m, seen[k])
        assert close(more.score, np.linalg.solve(V, nu) @ made.back[seen[k]]) or not nu.size
    assert state.full is not None
    assert close(state.full.mean.ravel(), merged @ dense.mean)
    assert close(state.full.cov, merged @ dense.cov @ merged.T)


@pytest.mark.parametrize("make", [model_of, mixed])
def test_the_return_to_the_modes_is_an_upper_bound(make: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """After readings without a gap the modes take over: means exact, covariance up to 1.1 times as large."""
    monkeypatch.setattr(full, "COMPLETE", 10)
    model = model_of(tree(12, np.random.default_rng(3))) if make is model_of else mixed()
    made, source = modes(model), Source(model, np.random.default_rng(5))
    dense, seen = Dense(model), np.ones(made.size, dtype=np.bool_)
    state, more = modal.start(made, 0.0), static.start(made)
    merged = np.kron([[1, 0, 0], [0, 1, 1]], np.eye(made.size))
    for k in range(600):
        m = source.tick()
        seen[4] = not 200 <= k < 203
        before = state.full
        state, more, _ = full.step(made, state, more, float(k), m, seen)
        dense.step(1.0 if k else 0.0, m, seen)
        assert (state.full is not None) == (k >= 200) or k > 203
        if before is not None and state.full is None:
            break
    assert state.full is None
    again = full.expanded(made, state, more)
    assert np.allclose(again.mean.ravel(), merged @ dense.mean, atol=1e-3 * np.abs(dense.mean).max())
    exact = merged @ dense.cov @ merged.T
    assert np.linalg.eigvalsh(again.cov - exact).min() >= -1e-12 * np.trace(exact)
    assert (np.diag(again.cov) <= 1.2 * np.diag(exact)).all()
    for _ in range(50):
        m = source.tick()
        state, more, _ = full.step(made, state, more, state.t + 1.0, m)
        nu, V = dense.step(1.0, m)
    assert np.allclose(more.score, np.linalg.solve(V, nu) @ made.back, atol=0.01 * np.abs(more.score).max())


def test_no_reading_at_all_is_a_prediction() -> None:
    made = modes(proportional())
    state, more, _ = full.step(made, modal.start(made, 0.0), static.start(made), 0.0, np.ones(12) * 1e-3)
    none = np.zeros(made.size, dtype=np.bool_)
    after, more, _ = full.step(made, state, more, 60.0, np.full(made.size, 7.0), none)
    assert after.full is not None
    assert close(after.full.mean[0], np.exp(-60.0 / 600.0) * made.back @ state.mean[0])
    assert (more.score == 0.0).all()
    with pytest.raises(ValueError, match="full covariance"):
        modal.step(made, state, 60.0, np.zeros(made.size), none)


def test_time_does_not_run_backwards() -> None:
    made = modes(proportional())
    with pytest.raises(ValueError, match="before"):
        modal.step(made, modal.start(made, 5.0), 4.0, np.zeros(made.size))
    with pytest.raises(ValueError, match="before"):
        modal.step(made, modal.start(made, 5.0), np.nan, np.zeros(made.size))
