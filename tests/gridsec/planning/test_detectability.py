"""The monitor's rule as inequalities, against enumeration, draws of honest errors, and all explanations."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog

from gridsec.arrays import Floats
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential import LoadDoubt, design
from gridsec.estimators.sequential.posterior import chi_square
from gridsec.estimators.sequential.search import set_cost
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.planning.detectability import Rule, largest_shift, named_size, rule
from tests.gridsec.planning.small import tree


def made(seed: int) -> Rule:
    """The rule of a small feeder; its loads are known badly enough to matter."""
    feeder = tree(seed)[0]
    rng = np.random.default_rng(seed)
    meters = np.sort(rng.choice(7, 5, replace=False))
    droop = fleet(meters[:2], "ieee1547-b", np.array([5.0, 9.0]), 100.0, tau=np.array([2.0, 3.1]))
    accuracy = MeterAccuracy(np.full(5, 0.003), np.full(5, 4e-4), np.full(5, 5e-4), 1e-3, 4e-4, 2e-4)
    doubt = LoadDoubt(rng.uniform(0.0, 0.04, 7), rng.uniform(0.0, 0.02, 7), 600.0)
    monitor = design(Plant(feeder, droop, meters, accuracy), doubt=doubt, step_s=1.0)
    return rule(monitor, risk=1e-3, model=np.full(5, 1e-5))


def draws(given: Rule, rng: np.random.Generator, s: int, count: int) -> Floats:
    """Honest means on one scale: Gaussian loads and jitter, uniform fixed errors."""
    monitor = given.design
    p = monitor.fixed.size
    values, vectors = np.linalg.eigh(monitor.prior.between)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    white = np.sqrt(given.noise[s] - monitor.fixed)
    fixed = monitor.allowed * rng.uniform(-1.0, 1.0, (count, p))
    return rng.standard_normal((count, p)) @ root.T + white * rng.standard_normal((count, p)) + fixed


def offsets(given: Rule, m: Floats, s: int) -> Floats:
    return m @ given.inverse[s] / np.diagonal(given.inverse[s])


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_shifts_equal_enumeration(seed: int, seen: bool) -> None:
    given = made(seed)
    s, p = given.limit.shape
    width = given.limit + given.honest + 2 * given.model if seen else given.limit - given.honest
    rows = np.vstack([Q / (w * np.diagonal(Q))[:, None] for Q, w in zip(given.inverse, width, strict=True)])
    assert rows.shape == (s * p, p)
    along = np.random.default_rng(seed).standard_normal(p)
    for liars in (1, 2, 3):
        best = 0.0
        for some in combinations(range(p), liars):
            part = rows[:, some]
            found = linprog(
                -along[list(some)],
                A_ub=np.vstack([part, -part]),
                b_ub=np.ones(2 * s * p),
                bounds=(None, None),
            )
            best = max(best, -found.fun)
        shift = largest_shift(given, along, liars, seen=seen)
        assert shift.size == pytest.approx(best, rel=1e-4)
        assert shift.bound >= best * (1 - 1e-6)
        assert np.count_nonzero(shift.lies) <= liars
        assert np.abs(rows @ shift.lies).max() <= 1 + 1e-5


@pytest.mark.parametrize("seed", range(6))
def test_hidden_lies_are_within_the_limits_and_noticeable_ones_are_not(seed: int) -> None:
    given, rng = made(seed), np.random.default_rng(seed)
    p = given.model.size
    for j in range(p):
        hidden = largest_shift(given, np.eye(p)[j], 2, seen=False, must=j).lies
        over = np.zeros(500, dtype=np.bool_)
        for s in range(len(given.limit)):
            m = draws(given, rng, s, 500) + hidden
            over |= (np.abs(offsets(given, m, s)) > given.limit[s]).any(axis=1)
        assert not over.any()
        # A lie beyond the bound is seen on the scale where it is furthest beyond.
        large = 1.001 * largest_shift(given, np.eye(p)[j], 1, seen=True, must=j).bound * np.eye(p)[j]
        beyond = [
            np.abs(offsets(given, large, s)) / (given.limit + given.honest)[s]
            for s in range(len(given.limit))
        ]
        s = int(np.argmax(np.max(beyond, axis=1)))
        m = draws(given, rng, s, 500) + large
        assert (np.abs(offsets(given, m, s)) > given.limit[s]).any(axis=1).all()


@pytest.mark.canary("1")
@pytest.mark.parametrize("seed", range(4))
def test_no_explanation_that_believes_a_large_liar_is_a_rival(seed: int) -> None:
    """All sets of accused meters, a loosened power with each, in ten draws of errors and of other lies."""
    given, rng = made(seed), np.random.default_rng(seed)
    monitor, p = given.design, given.model.size
    claims = np.full(monitor.customers, monitor.options.hidden_power)
    std = np.concatenate([claims, monitor.faults.std[monitor.customers :]])
    columns = monitor.faults.columns(np.arange(std.size)) * std
    like = 2.0 * np.log(monitor.options.like)
    for k in range(p):
        size = named_size(given, k, 2, claims=claims)
        for _ in range(10):
            other = int(rng.choice(np.delete(np.arange(p), k)))
            lies = np.zeros(p)
            lies[other] = rng.uniform(-3.0, 3.0) * size
            lies[k] = rng.choice([-1.0, 1.0]) * size
            worst = -np.inf
            for s in range(len(given.noise)):
                m = draws(given, rng, s, 1)[0] + lies
                truth = chi_square(monitor.prior, given.noise[s], m, lies == 0.0) + set_cost(p, 2)
                rivals = [
                    _cost(given, s, m, accused, columns, direction=d)
                    for count in range(p)
                    for accused in combinations(np.delete(np.arange(p), k).tolist(), count)
                    for d in (None, *range(std.size))
                ]
                worst = max(worst, min(rivals) - truth)
            assert worst >= like


def _cost(
    given: Rule, s: int, m: Floats, accused: tuple[int, ...], columns: Floats, *, direction: int | None
) -> float:
    monitor, p = given.design, m.size
    trusted = np.ones(p, dtype=np.bool_)
    trusted[list(accused)] = False
    if direction is None:
        return chi_square(monitor.prior, given.noise[s], m, trusted) + set_cost(p, len(accused))
    charge = monitor.faults.charges(np.array([direction]), trusted, len(accused))[0] * set_cost(p, 1)
    loose = columns[:, [direction]]
    return (
        chi_square(monitor.prior, given.noise[s], m, trusted, loose)
        + set_cost(p, len(accused))
        + float(charge)
    )


def test_a_protected_meter_tells_no_lie() -> None:
    given = made(0)
    honest = np.array([True, False, False, False, False])
    assert largest_shift(given, np.eye(5)[0], 2, seen=True, must=0, honest=honest).size == 0.0
    assert largest_shift(given, np.eye(5)[0], 0, seen=True).size == 0.0
