"""The modal filter against the dense Kalman filter of all states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Dense, Source, model_of, tree
from gridsec.arrays import Floats
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal import static
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


@pytest.mark.parametrize("lasting", [0.0, 0.4])
@pytest.mark.parametrize("fixed_s", [np.inf, 3000.0])
def test_equals_the_dense_filter_where_b_is_proportional(lasting: float, fixed_s: float) -> None:
    """Innovations, their covariance, means and covariances; intervals that change."""
    model = proportional(lasting=lasting, fixed_s=fixed_s)
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


@pytest.mark.parametrize("make", [model_of, mixed])
@pytest.mark.parametrize(("lasting", "fixed_s"), [(0.0, np.inf), (0.4, np.inf), (0.4, 3000.0)])
def test_directions_make_it_exact_for_every_b(make: object, lasting: float, fixed_s: float) -> None:
    """A busbar class, and two classes of meters: innovations and the mean of what lasts."""
    given = {"lasting": lasting, "fixed_s": fixed_s}
    model = mixed(**given) if make is mixed else model_of(tree(12, np.random.default_rng(3)), **given)
    made, random = modes(model), np.random.default_rng(2)
    assert made.sign.size > 0
    state, more, dense, t = modal.start(made, 0.0), static.start(made), Dense(model), 0.0
    for k in range(80):
        h = 0.0 if k == 0 else float(random.choice([1.0, 60.0]))
        t += h
        m = 0.01 * random.standard_normal(made.size)
        known, cov = static.offset(made, more), more.cov
        state, update = modal.step(made, state, t, m)
        more = static.follow(made, more, update)
        nu, V = dense.step(h, m)
        assert close(made.back @ (update.innovation - more.gamma * known), nu)
        if made.sign.size <= static.FEW:
            side = made.back @ (more.gamma[:, None] * made.directions)
            assert close((made.back * update.variance) @ made.back.T + side @ cov @ side.T, V)
    lasts = state.mean[1] + (1.0 - more.signature[1]) * static.offset(made, more)
    assert close(made.back @ lasts, dense.lasts)
    varies = state.mean[0] - more.signature[0] * static.offset(made, more)
    assert close(made.back @ varies, dense.varies, dense.mean)


@pytest.mark.parametrize("lost", [1, 5, 11])
def test_the_means_after_missing_readings_are_exact(lost: int) -> None:
    """One tick with missing readings, then the means of the masked dense filter."""
    model = proportional()
    made, source = modes(model), Source(model, np.random.default_rng(5))
    state, dense = modal.start(made, 0.0), Dense(model)
    seen = np.ones(made.size, dtype=np.bool_)
    seen[np.random.default_rng(lost).choice(made.size, lost, replace=False)] = False
    for k in range(30):
        m = source.tick()
        state, _ = modal.step(made, state, float(k), m)
        dense.step(1.0 if k else 0.0, m)
    m = source.tick()
    state, update = modal.step(made, state, 30.0, np.where(seen, m, 1e3), seen)
    nu, V = dense.step(1.0, m, seen)
    assert close(np.concatenate(list(state.mean @ made.back.T)), dense.mean[: 2 * made.size])
    assert close((made.back @ update.innovation)[seen], nu)
    # The information that was read is that of the readings, and its diagonal in the modes is kept.
    assert update.kept is not None
    assert np.isclose(update.kept.sum(), made.size - lost)
    inside = made.back[seen].T @ np.linalg.solve(V, made.back[seen])
    assert close(update.precision, np.diag(inside))
    exact = np.linalg.solve(made.back, np.linalg.solve(made.back, dense.cov[: made.size, : made.size]).T)
    assert close(state.cov[0], np.diag(exact))


def test_no_reading_at_all_is_a_prediction() -> None:
    made = modes(proportional())
    state, _ = modal.step(made, modal.start(made, 0.0), 0.0, np.ones(made.size) * 1e-3)
    none = np.zeros(made.size, dtype=np.bool_)
    after, update = modal.step(made, state, 60.0, np.full(made.size, 7.0), none)
    assert close(after.mean[0], np.exp(-60.0 / 600.0) * state.mean[0])
    assert (update.precision == 0.0).all()


@pytest.mark.parametrize(("share", "limit"), [(0.1, 0.02), (0.5, 0.1)])
def test_readings_missing_at_random_cost_little(share: float, limit: float) -> None:
    """Difference to the exact masked filter over its standard deviation, root mean square."""
    model = proportional(24)
    made, random = modes(model), np.random.default_rng(6)
    source, off = Source(model, random), []
    state, dense = modal.start(made, 0.0), Dense(model)
    for k in range(600):
        m, seen = source.tick(), random.random(made.size) >= share
        state, _ = modal.step(made, state, float(k), m, seen)
        dense.step(1.0 if k else 0.0, m, seen)
        if k >= 300:
            known = made.back @ state.mean.sum(axis=0)
            read = dense.H @ dense.mean
            std = np.sqrt(np.einsum("ij,jk,ik->i", dense.H, dense.cov, dense.H))
            off.append((known - read) / std)
    assert np.sqrt(np.mean(np.square(off))) < limit


def test_restricting_to_the_same_members_changes_nothing() -> None:
    model = proportional()
    made, source = modes(model), Source(model, np.random.default_rng(7))
    state = modal.start(made, 0.0)
    for k in range(20):
        state, _ = modal.step(made, state, float(k), source.tick())
    same = modal.restrict(made, state, modes(model))
    assert np.allclose(made.back @ same.mean[0], made.back @ state.mean[0], atol=1e-12)
    assert np.allclose(same.cov, state.cov, rtol=1e-6)


def test_restricting_keeps_means_and_the_diagonal() -> None:
    """Means at the remaining meters are those of before; with them the filter goes on."""
    model = proportional()
    made, source = modes(model), Source(model, np.random.default_rng(8))
    state = modal.start(made, 0.0)
    for k in range(20):
        state, _ = modal.step(made, state, float(k), source.tick())
    rest = np.array([0, 2, 3, 7, 11])
    fewer = modes(model, rest)
    after = modal.restrict(made, state, fewer)
    assert np.allclose(fewer.back @ after.mean[0], (made.back @ state.mean[0])[rest], atol=1e-12)
    assert (after.cov[0] > 0.0).all()
    assert (after.cov[0] * after.cov[2] >= after.cov[1] ** 2).all()
    with pytest.raises(ValueError, match="member"):
        modal.restrict(fewer, after, made)


def test_time_does_not_run_backwards() -> None:
    made = modes(proportional())
    with pytest.raises(ValueError, match="before"):
        modal.step(made, modal.start(made, 5.0), 4.0, np.zeros(made.size))
    with pytest.raises(ValueError, match="before"):
        modal.step(made, modal.start(made, 5.0), np.nan, np.zeros(made.size))
