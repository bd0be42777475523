"""Sizes on the statistical core against dense covariances, its own steps, draws of errors, and all sets."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog

from gridsec.arrays import Bools, Floats
from gridsec.estimators.front.posterior import LoadDoubt
from gridsec.estimators.modal import classes, core, doubts, estimate, full, monitor, rivals, signatures
from gridsec.estimators.modal.core import Core, CoreState
from gridsec.estimators.modal.costs import SearchProblem, cost
from gridsec.estimators.modal.doubts import WIDER, Unknown
from gridsec.estimators.modal.search import DOUBT
from gridsec.estimators.plant import Plant
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.planning.collusion import furthest
from gridsec.planning.detectability import (
    INITIAL,
    QUIET,
    ROOM,
    SINCE,
    Known,
    MonitorTests,
    NamedSizes,
    StepTests,
    acceptance_region,
    hidden_norm,
    hidden_step,
    known,
    noticed,
    step_tests,
)
from tests.gridsec.planning.small import tree

METERS, RISK, HELD = 5, 1e-3, 40


@cache
def made(seed: int, *, classes_apart: bool = False) -> Core:
    """Core of a small feeder; its loads are known badly enough to matter."""
    feeder, rng = tree(seed)[0], np.random.default_rng(seed)
    meters = np.sort(rng.choice(7, METERS, replace=False))
    droop = fleet(meters[:2], "ieee1547-b", np.array([5.0, 9.0]), 100.0, tau=np.array([2.0, 3.1]))
    fraction = np.full(METERS, 0.003)
    if classes_apart:
        fraction[:2] = 0.005
    accuracy = MeterAccuracy(fraction, np.full(METERS, 4e-4), np.full(METERS, 5e-4), 1e-3, 4e-4, 2e-4)
    doubt = LoadDoubt(rng.uniform(0.0, 0.02, 7), rng.uniform(0.0, 0.01, 7), 600.0)
    return monitor.design(Plant(feeder, droop, meters, accuracy), doubt=doubt, step_s=1.0).core


def few(kernel: Core, *ages: int, jump: float = 0.0) -> tuple[StepTests, ...]:
    """Tests of a step after `QUIET` honest readings."""
    return step_tests(kernel, known(kernel, QUIET, 1.0), ages or (SINCE,), 1.0, jump=jump)


def covariance(kernel: Core, ticks: int) -> Floats:
    """Dense covariance of honest residuals of the first ticks, (ticks p, ticks p): docs/theory-core.md, 1."""
    model, at = kernel.model, kernel.modes.at
    S, D, H = model.loads(at), model.noise(at), model.phases(at)
    aging = model.aging(at)
    lag = np.abs(np.subtract.outer(np.arange(ticks), np.arange(ticks)))
    whole = np.kron(np.exp(-lag / model.time_s), S) + np.kron(np.exp(-lag / model.fixed_s), aging)
    lasting = np.diag(model.fixed[at]) + model.busbar * H @ H.T - aging
    return whole + np.kron(np.ones((ticks, ticks)), lasting) + np.kron(np.eye(ticks), D)


def draws(kernel: Core, rng: np.random.Generator, ticks: int, count: int) -> Floats:
    """Honest residuals of the first ticks, (count, ticks, p)."""
    half = np.linalg.cholesky(covariance(kernel, ticks))
    return (rng.standard_normal((count, len(half))) @ half.T).reshape(count, ticks, METERS)


def watched(kernel: Core, m: Floats, step: Floats, onset: int) -> list[CoreState]:
    """States of the core after each tick of residuals (T, p), with a step from a tick on."""
    state, out = core.init(kernel, 0.0), list[CoreState]()
    for k, row in enumerate(m):
        state, _ = core.step(kernel, state, k + 1.0, row + step * (k >= onset))
        out.append(state)
    return out


# --- One age ------------------------------------------------------------------------------------


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_information_of_a_step_is_that_of_dense_covariances(seed: int, apart: bool) -> None:
    kernel = made(seed, classes_apart=apart)
    for tests in few(kernel, 1, SINCE):
        ticks = QUIET + tests.age
        X = np.kron((np.arange(ticks) >= QUIET)[:, None], np.eye(METERS))
        dense = X.T @ np.linalg.solve(covariance(kernel, ticks), X)
        np.testing.assert_allclose(tests.information, dense, rtol=1e-6, atol=1e-6 * np.abs(dense).max())
        np.testing.assert_allclose(tests.rows[:METERS], dense, rtol=1e-6, atol=1e-6 * np.abs(dense).max())


@pytest.mark.parametrize("seed", range(3))
def test_information_with_unknown_directions_is_that_of_dense_covariances(seed: int) -> None:
    kernel, rng = made(seed), np.random.default_rng(seed)
    unknown = unknown_directions(kernel, rng)
    ticks = QUIET + SINCE
    V = covariance(kernel, ticks) + np.kron(np.eye(ticks), unknown.wide @ unknown.wide.T)
    X = np.kron((np.arange(ticks) >= QUIET)[:, None], np.eye(METERS))
    before = known(kernel, QUIET, 1.0, unknown=unknown)
    (tests,) = step_tests(kernel, before, (SINCE,), 1.0)
    np.testing.assert_allclose(tests.information, X.T @ np.linalg.solve(V, X), rtol=1e-6)


def unknown_directions(kernel: Core, random: np.random.Generator) -> Unknown:
    """Two unknown directions at all places."""
    places = 0.003 * random.standard_normal((kernel.effect.shape[0], 2))
    meters = places[kernel.model.meters]
    return Unknown(places, meters, np.full(2, WIDER), np.zeros(METERS, np.bool_), 2)


@pytest.mark.parametrize("seed", range(3))
def test_weights_beside_unknown_directions_are_the_change_of_the_estimate(seed: int) -> None:
    """Oracle: the filter and the unknown errors by its last tick, of readings with and without a step."""
    kernel, random = made(seed), np.random.default_rng(seed)
    unknown, modes = unknown_directions(kernel, random), kernel.modes
    before = known(kernel, QUIET, 1.0, unknown=unknown)
    (tests,) = step_tests(kernel, before, (SINCE,), 1.0)
    step = random.standard_normal(METERS)
    after, info = before.filter, before.static
    for _ in range(SINCE):
        after, info, _ = full.step(modes, after, info, after.t + 1.0, step, stay=True, unknown=unknown.wide)
    found, whole = estimate.honest(modes, kernel.estimator, after, info), after.full
    assert whole is not None
    assert found.rest is not None
    off, variance = doubts.estimated(modes.noise + whole.whole, unknown, found.rest, whole.seen)
    np.testing.assert_allclose(tests.weights @ step, found.mean + off, rtol=1e-6, atol=1e-9)
    late = Known(after, info, unknown)
    np.testing.assert_allclose(late.variance(kernel), found.variance + variance, rtol=1e-9)


@pytest.mark.parametrize("onset", [0, QUIET])
@pytest.mark.parametrize("seed", range(3))
def test_rows_are_the_parts_of_the_detector(seed: int, onset: int) -> None:
    """At the limit of one row the core's own M is beyond gamma; below `1 - ROOM` of all it is not."""
    kernel, p = made(seed), METERS
    age = 16 - onset
    (tests,) = step_tests(kernel, known(kernel, onset, 1.0), (age,), 1.0)
    still = np.zeros((16, p))
    for direction in np.random.default_rng(seed).standard_normal((4, p)):
        # The scores: the rows of own errors are not a part of M.
        scores = (tests.rows @ direction / tests.limits)[: p + kernel.faults.powers + 1]
        size = 1.0 / np.abs(scores).max()
        beyond = watched(kernel, still, 1.001 * size * direction, onset)[-1]
        assert beyond.detector.log_m >= kernel.limit
        quiet = (1.0 - ROOM) / tests.region.statistic(direction)
        assert watched(kernel, still, quiet * direction, onset)[-1].detector.log_m < kernel.limit


@pytest.mark.parametrize("apart", [False, True])
def test_the_omnibus_is_that_of_the_detector(apart: bool) -> None:
    kernel = made(1, classes_apart=apart)
    (tests,) = few(kernel)
    for direction in np.random.default_rng(1).standard_normal((4, METERS)):
        step = direction / np.linalg.norm(tests.form @ direction)
        state = watched(kernel, np.zeros((QUIET + SINCE, METERS)), step, QUIET)[-1]
        row = int(np.flatnonzero(state.detector.onsets.used & (state.detector.onsets.age == SINCE))[0])
        now = signatures.scores(kernel.modes, state.detector.onsets, state.static, np.array([row]))
        found = core.detector.omnibus(now, core.SIZE**2 / kernel.modes.white)[0]
        weight = np.log(core.detector.WEIGHTS[1] * (1.0 - core.detector.RAMPS))
        assert found + weight == pytest.approx(kernel.limit, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_kept_onset_has_the_region_of_its_age(seed: int) -> None:
    kernel = made(seed)
    state = watched(kernel, np.zeros((QUIET + SINCE, METERS)), np.zeros(METERS), QUIET)[-1]
    onsets = core.detector.followed(kernel.modes, state.detector).onsets
    row = int(np.flatnonzero(onsets.used & ~onsets.ramp & (onsets.age == SINCE))[0])
    one, other = acceptance_region(kernel, state, row), few(kernel)[0].region
    np.testing.assert_allclose(one.rows, other.rows, rtol=1e-9, atol=1e-9 * np.abs(one.rows).max())
    np.testing.assert_allclose(one.weights, other.weights, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_classes_are_compared_as_the_core_does(seed: int) -> None:
    kernel = made(seed)
    kernel = replace(kernel, classes=classes.classes(kernel.modes, np.sqrt(3.0 * kernel.classes.fixed)))
    (tests,) = step_tests(kernel, known(kernel, 0, 1.0), INITIAL, 1.0)
    rows = len(tests.rows) - METERS
    assert rows == METERS + kernel.faults.powers + 1
    for j in range(METERS):
        step = np.eye(METERS)[j] * tests.limits[rows + j] / tests.rows[rows + j, j]
        state = watched(kernel, np.zeros((INITIAL[0], METERS)), step, 0)[-1]
        told = classes.log_lambda(
            kernel.classes, kernel.modes, state.filter, state.static, np.ones(METERS, dtype=np.bool_)
        )
        assert told[j] == pytest.approx(kernel.limit + np.log(METERS), rel=1e-6)


def test_weights_are_the_change_of_the_estimate() -> None:
    kernel = made(2)
    (tests,) = few(kernel)
    rng = np.random.default_rng(2)
    m, step = draws(kernel, rng, QUIET + SINCE, 1)[0], 1e-3 * rng.standard_normal(METERS)
    with_, without = (watched(kernel, m, each, QUIET)[-1] for each in (step, 0.0 * step))
    moved = core.estimate(kernel, with_).mean - core.estimate(kernel, without).mean
    np.testing.assert_allclose(tests.weights @ step, moved, atol=1e-9)


# --- Hidden and noticed -------------------------------------------------------------------------


def alarms(kernel: Core, honest: Floats, step: Floats) -> Bools:
    """Draws with log M beyond its limit at the last tick, every onset evaluated then, (count,)."""
    return np.array([watched(kernel, m, step, QUIET)[-1].detector.log_m >= kernel.limit for m in honest])


@pytest.mark.canary("40-2")
@pytest.mark.parametrize("liars", [1, 2])
@pytest.mark.parametrize("count", [40, 200])
def test_hidden_steps_stay_hidden_and_noticed_ones_do_not(count: int, liars: int) -> None:
    """Gaussian errors of the model, at the moment for which both are stated."""
    kernel = made(0)
    (tests,) = few(kernel)
    honest = draws(kernel, np.random.default_rng(3), QUIET + SINCE, count)
    norm = hidden_norm(1.0, 1.0, RISK)
    step = hidden_step(tests.information, 0, liars, norm)
    assert step @ tests.information @ step == pytest.approx(norm**2)
    assert np.count_nonzero(step) == liars
    assert not alarms(kernel, honest, step).any()
    away = noticed(tests, liars, risk=RISK)
    found = furthest(away, np.eye(METERS)[0], must=0)
    assert alarms(kernel, honest, 1.001 * found.lies).all()
    assert not alarms(kernel, honest[:40], 0.3 * found.lies).all()


def test_hidden_pairs_are_the_largest() -> None:
    (tests,) = few(made(3))
    best = max(
        hidden_norm(1.0, 1.0, RISK) * np.sqrt(np.linalg.inv(tests.information[np.ix_(some, some)])[0, 0])
        for some in ([0, other] for other in range(1, METERS))
    )
    assert hidden_step(tests.information, 0, 2, hidden_norm(1.0, 1.0, RISK))[0] == pytest.approx(best)
    assert hidden_norm(1e4, 1.0, RISK) == 0.0


# --- All tests together -------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_thresholds_equal_enumeration(seed: int) -> None:
    """Alone by the tests of each age; pairs by linear programs of all pairs."""
    kernel = made(seed)
    steps = step_tests(kernel, known(kernel, HELD, 1.0, learned_s=3600.0), (4, HELD), 1.0)
    tests = MonitorTests.of(steps, 1.0, 1.0)
    for j in range(METERS):
        unit = np.eye(METERS)[j]
        alone = tests.threshold(tests.corridor(1), unit, must=j)
        assert alone.undetected == pytest.approx(1.0 / tests.quiet.statistic(unit), rel=1e-4)
        assert alone.found == pytest.approx(
            min(1.0 / np.abs(tests.loud[:, j]).max(), tests.reach[j]), rel=1e-4
        )
        least = tests.z / np.sqrt(steps[-1].information[j, j])
        assert alone.unavoidable == pytest.approx(least, rel=1e-9)
        pair, best = tests.threshold(tests.corridor(2), unit, must=j), 0.0
        for some in (list(each) for each in combinations(range(METERS), 2) if j in each):
            part = tests.loud[:, some]
            both = np.vstack([part, -part])
            ends = [(-tests.reach[k], tests.reach[k]) for k in some]
            goal = -(np.array(some) == j).astype(np.float64)
            best = max(best, -linprog(goal, A_ub=both, b_ub=np.ones(len(both)), bounds=ends).fun)
        assert pair.found == pytest.approx(best, rel=1e-4)
        assert alone.undetected <= pair.undetected * (1 + 1e-6)
        assert pair.undetected / (1.0 - ROOM) <= pair.found / (1.0 + ROOM) * (1 + 1e-6)
        assert np.count_nonzero(pair.lies) <= 2
        for each in steps:
            assert each.region.statistic(pair.lies) <= (1.0 - ROOM) * (1 + 1e-6)
    weights = tests.quiet.weights
    error = tests.threshold(tests.corridor(2), weights[weights.any(axis=1)][0])
    assert error.unavoidable > 0.0
    assert error.undetected < error.found
    none = tests.threshold(tests.corridor(1), np.zeros(METERS))
    assert none.undetected == none.unavoidable == 0.0


@pytest.mark.canary("1")
@pytest.mark.parametrize("seed", range(3))
def test_the_core_agrees_with_thresholds(seed: int) -> None:
    """A step of *undetected* leaves its own M below gamma at all ages, and one of *found* does not."""
    kernel = made(seed)
    before = known(kernel, HELD, 1.0)
    tests = MonitorTests.of(step_tests(kernel, before, (16, HELD), 1.0), 1.0, 1.0)
    still = np.zeros((2 * HELD, METERS))
    for j in range(METERS):
        told = tests.threshold(tests.corridor(1), np.eye(METERS)[j], must=j)
        quiet = watched(kernel, still, told.lies, HELD)
        assert max(state.detector.log_m for state in quiet) < kernel.limit
        loud = watched(kernel, still, told.lies * told.found / told.undetected, HELD)
        assert max(state.detector.log_m for state in loud) >= kernel.limit


# --- Names --------------------------------------------------------------------------------------


@pytest.mark.canary("1")
@pytest.mark.parametrize("seed", range(3))
def test_no_set_without_a_named_meter_is_a_rival(seed: int) -> None:
    """All sets of meters with at most one power or phase, in ten draws of errors and of the other's step."""
    kernel, rng = made(seed), np.random.default_rng(seed)
    (plain,) = few(kernel)
    sizes, W, p = NamedSizes(kernel, plain, plain, RISK), kernel.modes.back @ kernel.faults.W, METERS
    q, half = W.shape[1], np.linalg.cholesky(np.linalg.inv(plain.information))
    charge = np.where(np.arange(q) < p, 0.0, 2.0 * np.log(p))
    F, none = W.T @ plain.information @ W, 0
    for k in range(p):
        least = furthest(noticed(plain, 1, risk=RISK), np.eye(p)[k], must=k).bound
        size, alone = sizes(k, 2, least), sizes(k, 1, least)
        assert size >= alone >= least
        if np.isinf(size):
            # Beside other faults a false power explains a step of any size.
            none += 1
            continue
        for _ in range(10):
            step = np.zeros(p)
            second = int(rng.choice(np.delete(np.arange(p), k)))
            step[second] = rng.uniform(-2.0, 2.0) * size
            step[k] = rng.choice([-1.0, 1.0]) * size
            y = W.T @ plain.information @ (step + half @ rng.standard_normal(p))
            std = np.where(np.arange(q) < p, np.maximum(core.SIZE, size), kernel.faults.std)
            problem = SearchProblem(y, F, std, p, charge, kernel.bound)
            true = min(cost(problem, step_set(q, [k])), cost(problem, step_set(q, [k, second])))
            without = (
                cost(problem, step_set(q, [*some, *more]))
                for count in range(p)
                for some in combinations(np.delete(np.arange(p), k).tolist(), count)
                for more in ([], *([f] for f in range(p, q)))
            )
            assert min(without) - true >= -2.0 * np.log(DOUBT)
    assert none <= 2


def test_no_size_is_named_where_a_jump_of_the_loads_explains_any_step() -> None:
    """Loads known to 0.3 % of the voltage may jump by ten times as much."""
    kernel = made(2)
    (plain,) = few(kernel)
    (jumped,) = few(kernel, jump=max(rivals.jumps(kernel.modes)))
    sizes = NamedSizes(kernel, plain, jumped, RISK)
    found = [sizes(k, 1, 0.007) for k in range(METERS)]
    assert np.isinf(found[0])
    assert np.isfinite(found[2])
    less = NamedSizes(kernel, plain, plain, RISK)
    assert all(less(k, 1, 0.007) <= each for k, each in enumerate(found))


def step_set(faults: int, chosen: list[int]) -> Bools:
    out = np.zeros(faults, dtype=np.bool_)
    out[chosen] = True
    return out


def test_the_filter_before_a_step_is_that_of_the_core() -> None:
    kernel = made(0)
    state = core.init(kernel, 0.0)
    for k in range(QUIET):
        state, _ = core.step(kernel, state, k + 1.0, np.zeros(METERS))
    found: Known = known(kernel, QUIET, 1.0)
    np.testing.assert_allclose(found.filter.cov, state.filter.cov)
    np.testing.assert_allclose(found.static.information, state.static.information)
