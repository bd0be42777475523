"""Estimates at all places against the joint Gaussian of all readings, and their coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Source, model_of, power_columns, root, tree
from gridsec.arrays import Floats
from gridsec.estimators.modal import estimate, full, replay, signatures, static
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.costs import SearchProblem, amounts
from gridsec.estimators.modal.model import ResidualModel, modes
from gridsec.estimators.modal.search import Identification
from gridsec.grid.network import Power

FEEDER = tree(9, np.random.default_rng(1))


def some_meters(meters: int = 5, **given: float) -> ResidualModel:
    """A model with meters at some of the customers only."""
    whole = model_of(FEEDER, **given)
    at = np.sort(np.random.default_rng(2).choice(9, meters, replace=False))
    return replace(
        whole,
        of_meters=whole.of_meters[:, at],
        meters=whole.meters[at],
        white=whole.white[at] * np.linspace(1.0, 2.0, meters),
        fixed=whole.fixed[at],
    )


def joint(  # noqa: PLR0917  # everything that moves the readings
    model: ResidualModel,
    m: Floats,
    G: Floats,
    effect: Floats,
    onset: int,
    std: float,
    unknown: dict[int, Floats] | None = None,
) -> tuple[Floats, Floats]:
    """Mean and variance at all places from the joint Gaussian of all readings at intervals of 1 s.

    unknown: directions of some ticks, (p, k) each, with independent amounts N(0, 1); not part of the mean.
    """
    at, T = np.arange(model.meters.size), len(m)
    p, n = at.size, model.variance.size
    rho = np.exp(-1.0 / model.time_s)
    S, D, B = model.loads(at), model.noise(at), model.static(at)
    V, cross = np.empty((T, p, T, p)), np.empty((n, T, p))
    u = (np.arange(T) >= onset).astype(np.float64)
    H = model.phases(at)
    lasts = model.busbar * model.busbar_of @ H.T
    for t in range(T):
        for s in range(T):
            V[t, :, s] = rho ** abs(t - s) * S + B + (t == s) * D
            V[t, :, s] += std**2 * u[t] * u[s] * G @ G.T
        cross[:, t] = rho ** (T - 1 - t) * model.of_meters + lasts
        cross[:, t] += std**2 * u[t] * effect @ G.T
    for t, A in (unknown or {}).items():
        V[t, :, t] += A @ A.T
    cross[:, T - 1] += model.flicker * model.busbar_of @ H.T
    flat = cross.reshape(n, T * p)
    gain = np.linalg.solve(V.reshape(T * p, T * p), flat.T).T
    own = model.variance + model.busbar + model.flicker + std**2 * (effect**2).sum(axis=1)
    return gain @ m.ravel(), own - (gain * flat).sum(axis=1)


@pytest.mark.parametrize("fault", ["none", "meter", "power", "busbar"])
def test_equals_the_joint_gaussian(fault: str) -> None:
    """Mean and variance at all buses, without a fault and with a known one; two classes by the jitter."""
    model = some_meters()
    made, onset, std = modes(model), 4, 0.01
    assert made.sign.size > 0
    every, n = np.arange(9), model.variance.size
    G, effect = np.zeros((5, 1)), np.zeros((n, 1))
    if fault == "meter":
        G[2] = 1.0
    elif fault == "power":
        effect = FEEDER.columns(Power.ACTIVE, every[3:4])
        G, std = effect[model.meters], 0.05
    elif fault == "busbar":
        effect = model.busbar_of
        G = effect[model.meters]
    m = 0.01 * np.random.default_rng(3).standard_normal((12, 5))
    state, more, rows = modal.start(made, 0.0), static.start(made), signatures.empty(made, 1)
    for k, reading in enumerate(m):
        state, more, update = full.step(made, state, more, float(k), reading)
        rows = signatures.follow(made, rows, update, more, 1.0, begun=[0] if k == onset else [])
    prepared = estimate.estimator(made)
    found = estimate.honest(made, prepared, state, more)
    if fault != "none":
        W = made.U.T @ G
        now = signatures.joint(made, rows, more, 0)
        y, F = now.of(W)
        problem = SearchProblem(y, F, np.array([std]), 1, np.zeros(1), np.full(1, np.inf))
        T = estimate.moves(made, prepared, state, now, G, effect)
        one = Identification(
            np.ones((1, 1), bool), np.zeros(1, np.intp), np.ones(1), np.ones(1, bool), (problem,)
        )
        found = estimate.corrected([found], [T], one)
        assert amounts(problem, np.ones(1, bool))[0].shape == (1,)
    mean, variance = joint(model, m, G, effect, onset, std if fault != "none" else 0.0)
    if made.sign.size <= static.FEW:
        assert np.abs(found.mean - mean).max() <= 1e-9 * np.abs(mean).max()
        assert np.abs(found.variance - variance).max() <= 1e-8 * variance.max()


FAULTS = {
    "meter": (np.eye(5)[:, [2]], None, 0.01),
    "power": (None, FEEDER.columns(Power.ACTIVE, np.array([3])), 0.05),
    "busbar": (None, some_meters().busbar_of, 0.01),
}
"""Columns at the meters and at all places, and prior standard deviation of the amount."""


@pytest.mark.parametrize("fault", ["none", *FAULTS])
@pytest.mark.parametrize("wide", [0.01, 1.0])
def test_equals_the_joint_gaussian_beside_unknown_directions(fault: str, wide: float) -> None:
    """Unknown powers at some ticks and at the last one; a false meter, power, and busbar's meter."""
    model, onset, random = some_meters(), 4, np.random.default_rng(6)
    made, n = modes(model), model.variance.size
    G, effect, std = np.zeros((5, 1)), np.zeros((n, 1)), 0.0
    if fault != "none":
        of_meters, of_places, std = FAULTS[fault]
        effect = effect if of_places is None else of_places
        G = effect[model.meters] if of_meters is None else of_meters
    unknown = {k: wide * random.standard_normal((5, 3)) for k in (2, 6, 7, 11)}
    m = 0.01 * random.standard_normal((12, 5))
    state, more, since = modal.start(made, 0.0), static.start(made), replay.begun(made, 0, ramp=False)
    state = replace(state, full=full.expanded(made, state, more))
    for k, reading in enumerate(m):
        state, more, update = full.step(
            made, state, more, float(k), reading, stay=True, unknown=unknown.get(k)
        )
        assert update.exact is not None
        if k >= onset:
            since = replay.follow(made, since, update.exact, update.gap)
    prepared = estimate.estimator(made)
    found = estimate.honest(made, prepared, state, more)
    assert found.rest is not None
    amount = np.zeros(1)
    if fault != "none":
        y, F = G.T @ since.score, G.T @ since.information @ G
        problem = SearchProblem(y, F, np.array([std]), 1, np.zeros(1), np.full(1, np.inf))
        T = estimate.moves(made, prepared, state, since, G, effect)
        one = Identification(
            np.ones((1, 1), bool), np.zeros(1, np.intp), np.ones(1), np.ones(1, bool), (problem,)
        )
        found, amount = estimate.corrected([found], [T], one), amounts(problem, np.ones(1, bool))[0]
    mean, variance = joint(model, m, G, effect, onset, std, unknown)
    assert np.abs(found.mean - mean).max() <= 1e-9 * np.abs(mean).max()
    assert np.abs(found.variance - variance).max() <= 1e-8 * variance.max()
    # The rest by the filter of the readings less the fault.
    state, more = modal.start(made, 0.0), static.start(made)
    state = replace(state, full=full.expanded(made, state, more))
    for k, reading in enumerate(m):
        less = reading - (G @ amount if k >= onset else 0.0)
        state, more, _ = full.step(made, state, more, float(k), less, stay=True, unknown=unknown.get(k))
    assert state.full is not None
    assert found.rest is not None
    assert np.abs(found.rest - (less - state.full.mean.sum(axis=0))).max() <= 1e-9


def test_a_mixture_contains_the_disagreement() -> None:
    """Variance of two explanations: the mean of the variances and the spread of the means."""
    F = np.diag([100.0, 100.0])
    problem = SearchProblem(np.array([50.0, 50.0]), F, np.ones(2), 2, np.zeros(2), np.full(2, np.inf))
    chosen = np.array([[True, False], [False, True]])
    found = Identification(chosen, np.zeros(2, np.intp), np.array([0.5, 0.5]), np.zeros(2, bool), (problem,))
    before = estimate.Estimated(np.zeros(1), lambda: np.array([1e-4]))
    after = estimate.corrected([before], [np.array([[1.0, -1.0]])], found)
    f, own = 50.0 / 101.0, 1.0 / 101.0
    assert np.allclose(after.mean, 0.0)
    assert np.allclose(after.variance, 1e-4 + own + f**2)


@pytest.mark.parametrize(("weight", "least"), [(2e-3, estimate.POSSIBLE), (2e-4, 0.0)])
def test_a_possible_explanation_has_a_least_share(weight: float, least: float) -> None:
    """An explanation that keeps a meter from being named counts with at least 5 %; others hardly."""
    F = np.diag([100.0, 100.0])
    problem = SearchProblem(np.array([50.0, 50.0]), F, np.ones(2), 2, np.zeros(2), np.full(2, np.inf))
    chosen, weights = np.array([[True, False], [False, True]]), np.array([1.0 - weight, weight])
    found = Identification(chosen, np.zeros(2, np.intp), weights, np.zeros(2, bool), (problem,))
    before = estimate.Estimated(np.zeros(1), lambda: np.array([1e-4]))
    after = estimate.corrected([before], [np.array([[1.0, -1.0]])], found)
    means = np.array([1.0, -1.0]) * 50.0 / 101.0
    apart = (means - weights @ means) ** 2
    mixed = 1e-4 + 1.0 / 101.0 + weights @ apart
    assert np.allclose(after.variance, max(mixed, least * apart[1]))


def test_the_variance_is_evaluated_once_and_where_asked_for() -> None:
    asked = []

    def spread() -> Floats:
        asked.append(True)
        return np.array([4.0])

    found = estimate.Estimated(np.zeros(1), spread)
    assert not asked
    assert (found.variance == 4.0).all()
    assert (found.variance == 4.0).all()
    assert len(asked) == 1


def test_coverage_in_simulation() -> None:
    """Errors over their standard deviations at buses without meters: root mean square near 1."""
    model = some_meters()
    made, random, z = modes(model), np.random.default_rng(4), []
    prepared = estimate.estimator(made)
    places = model.variance.size
    whole = replace(
        model,
        of_meters=covariance_of_all(),
        meters=np.arange(places),
        white=np.full(places, 1e-9),
        fixed=np.zeros(places),
    )
    draw = root(whole.of_meters)
    rho = np.exp(-1.0 / model.time_s)
    for _ in range(120):
        w = draw @ random.standard_normal(places)
        b = np.sqrt(model.fixed) * random.standard_normal(5)
        busbar = np.sqrt(model.busbar) * random.standard_normal()
        state, more = modal.start(made, 0.0), static.start(made)
        for k in range(40):
            flick = np.sqrt(model.flicker) * random.standard_normal()
            truth = w + busbar + flick
            m = truth[model.meters] + b + np.sqrt(model.white) * random.standard_normal(5)
            state, more, _ = full.step(made, state, more, float(k), m)
            w = rho * w + np.sqrt(1 - rho**2) * (draw @ random.standard_normal(places))
        found = estimate.honest(made, prepared, state, more)
        z.append((found.mean - truth) / np.sqrt(found.variance))
    spread = np.sqrt(np.mean(np.square(z), axis=0))
    assert ((spread > 0.75) & (spread < 1.3)).all()


def covariance_of_all() -> Floats:
    """Covariance of the voltages at all buses."""
    effect = np.hstack([FEEDER.columns(power, np.arange(9)) for power in Power])
    return np.asarray((effect * np.repeat([0.006**2, 0.002**2], 9)) @ effect.T)


def test_the_honest_source_agrees_with_its_model() -> None:
    """The simulation of the tests: second moments of residuals."""
    model = model_of(FEEDER)
    m = np.stack([Source(model, np.random.default_rng(seed)).tick() for seed in range(4000)])
    at = np.arange(9)
    exact = model.loads(at) + model.static(at) + model.noise(at)
    assert np.abs(np.cov(m.T) - exact).max() < 0.1 * exact.max()
    assert power_columns(FEEDER).shape == (9, 18)


def test_factors_of_the_regression_are_the_whole() -> None:
    """The regression on (b, e) by a few directions: the busbar's, and those of unequal meters."""
    model = some_meters()
    made = modes(model)
    prepared, at, H = estimate.estimator(made), made.at, model.phases(made.at)
    C = model.busbar * (model.busbar_of @ H.T)
    of_w = model.of_meters[:, at] @ made.U / made.loads
    of_b = np.linalg.solve(model.static(at), C.T).T @ made.back
    of_e = model.flicker * (model.busbar_of @ H.T @ made.U)
    for found, exact in ((prepared.of_w, of_w), (prepared.of_b, of_b), (prepared.of_e, of_e)):
        assert np.allclose(found, exact, rtol=0.0, atol=1e-12)
    w, b, e = np.random.default_rng(4).standard_normal((3, 5))
    expected = of_w @ w + of_b @ b + of_e @ e
    assert np.allclose(estimate._mean(prepared, w, b, e), expected, rtol=0.0, atol=1e-12)
    even = some_meters()
    even = replace(even, white=np.full(5, 1e-5), fixed=np.full(5, 2e-5))
    assert estimate.estimator(modes(even)).right.shape[0] <= 2
