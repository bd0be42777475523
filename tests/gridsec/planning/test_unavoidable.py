"""Unavoidable errors and hidden errors, against simulation, enumeration and another solver."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog, minimize
from scipy.stats import ncx2, norm

from gridsec.arrays import Floats, Ints
from gridsec.errors import InputInvalid
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential import LoadDoubt, SequentialDesign, design
from gridsec.estimators.sequential.posterior import condition, leave_one_out
from gridsec.estimators.sequential.time_scales import Scales, inconsistent, load_scores, scale_test
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.planning.detectability import (
    ROOM,
    MonitorTests,
    acceptance_region,
    honest_covariance,
    learned_scales,
)
from gridsec.planning.unavoidable import (
    AcceptanceRegion,
    ConeProgram,
    Faults,
    blind_norm,
    deviations,
    every_test,
    unavoidable,
)
from tests.codes import refused
from tests.gridsec.planning.small import tree

METERS = 5


def monitor(seed: int) -> SequentialDesign:
    feeder, rng = tree(seed)[0], np.random.default_rng(seed)
    meters = np.sort(rng.choice(7, METERS, replace=False))
    droop = fleet(meters[:2], "ieee1547-b", np.array([5.0, 9.0]), 100.0, tau=np.array([2.0, 3.1]))
    accuracy = MeterAccuracy(
        np.full(METERS, 0.003), np.full(METERS, 4e-4), np.full(METERS, 5e-4), 1e-3, 4e-4, 2e-4
    )
    doubt = LoadDoubt(rng.uniform(0.0, 0.02, 7), rng.uniform(0.0, 0.01, 7), 600.0)
    return design(Plant(feeder, droop, meters, accuracy), doubt=doubt, step_s=1.0)


def moment(seed: int, *, learned: bool = True) -> Scales:
    return learned_scales(monitor(seed), learned=learned, model=np.full(METERS, 1e-6))


def told(scales: Scales, displacement: Floats) -> bool:
    """True if a test of the monitor's own code rejects a displacement of all residuals, all scales full."""
    made, every = scales.design, np.ones(METERS, dtype=np.bool_)
    for s in range(len(made.lengths)):
        here = scales[s]
        now = condition(here.prior, here.noise, every)
        view = scale_test(made, here, leave_one_out(now, displacement))
        if (np.abs(view.loo.residual) > view.limit).any():
            return True
        scores = load_scores(made, now, None, view.loo)
        if inconsistent(now, view.loo, scales.model, made.tails[s], scores):
            return True
        d = made.busbar_incidence[:, 0]
        weights = now.Q @ displacement
        if (d @ weights) ** 2 > made.sigmas[s] ** 2 * (d @ now.Q @ d):
            return True
    return False


def boundary(scales: Scales, direction: Floats) -> float:
    """Size along a direction at which the monitor's own tests begin to reject, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if told(scales, middle * direction) else (middle, high)
    return low


# --- every test -------------------------------------------------------------------------------


def random_case(seed: int) -> tuple[Floats, Floats, Faults]:
    """Covariance, prior of two places, and faults of three of six meters."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((6, 8))
    cross = rng.standard_normal((2, 6))
    faults = Faults(
        rng.standard_normal((6, 3)), rng.standard_normal((2, 3)), np.full(3, -9.0), np.full(3, 9.0)
    )
    return root @ root.T, cross, faults


@pytest.mark.parametrize("seed", range(4))
def test_the_unavoidable_error_is_the_largest_on_the_ellipsoid(seed: int) -> None:
    V, cross, faults = random_case(seed)
    errors = unavoidable(V, cross, faults, 4.0)
    gain = faults.gain(cross @ np.linalg.inv(V))
    F = faults.signature.T @ np.linalg.inv(V) @ faults.signature
    for x in range(2):
        best = max(
            -minimize(
                lambda theta, g=gain[x]: -g @ theta,
                start,
                constraints={"type": "ineq", "fun": lambda theta: 16.0 - theta @ F @ theta},
                options={"maxiter": 500, "ftol": 1e-12},
            ).fun
            for start in np.random.default_rng(9).standard_normal((3, 3))
        )
        assert errors[x] == pytest.approx(best, rel=1e-5)
    wide = Faults(faults.signature, faults.effect, np.full(3, -1e4), np.full(3, 1e4))
    found = ConeProgram(every_test(V, cross, 4.0), wide)(gain[1])
    assert found.size == pytest.approx(errors[1], rel=1e-6)


def test_no_test_detects_the_unavoidable_fault_more_often_than_every_second_time() -> None:
    """The most powerful test by its simulated power, with its simulated rate of false alarms."""
    V, cross, faults = random_case(3)
    z = float(norm.isf(0.01))
    found = ConeProgram(every_test(V, cross, z), faults)(faults.gain(cross @ np.linalg.inv(V))[0])
    a = faults.signature @ found.amounts
    weights = np.linalg.solve(V, a)
    honest = np.random.default_rng(0).standard_normal((200_000, 6)) @ np.linalg.cholesky(V).T @ weights
    limit = np.quantile(honest, 0.99)
    assert (honest + a @ weights > limit).mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("dimensions", [1, 5, 48])
def test_the_norm_of_an_unknown_direction_is_the_median_of_noncentral_chi_square(dimensions: int) -> None:
    rho = blind_norm(dimensions, 4.5)
    assert ncx2.sf(ncx2.isf(norm.sf(4.5), dimensions, 1e-12), dimensions, rho**2) == pytest.approx(
        0.5, abs=1e-4
    )
    assert rho >= 4.5 if dimensions > 1 else rho == pytest.approx(4.63, abs=0.05)
    assert blind_norm(3, 0.0) == 0.0


def test_one_look_a_year_has_the_rate_itself() -> None:
    assert deviations(0.01, 365.25 * 86400.0) == pytest.approx(norm.isf(0.01))
    assert deviations(1.0, 60.0) > deviations(1.0, 600.0) > deviations(100.0, 600.0)
    with refused(InputInvalid, "not-positive"):
        deviations(0.0, 60.0)


# --- given tests ------------------------------------------------------------------------------


def test_faults_are_joined_and_ranges_hold() -> None:
    region = AcceptanceRegion(np.eye(3), (0.01 * np.eye(3),), np.eye(3))
    other = Faults(np.ones((3, 1)), -np.ones((3, 1)), np.array([-0.25]), np.array([0.1]))
    both = Faults.voltages(np.array([1]), (3, 3), 0.5).joined(other)
    program = ConeProgram(region, both)
    assert program(np.array([1.0, 0.0])).size == pytest.approx(0.5, rel=1e-6)
    found = program(np.array([0.0, -1.0]), 0.2)
    assert found.amounts[1] == pytest.approx(-0.2, rel=1e-6)
    assert region.statistic(both.signature @ found.amounts) <= 0.2
    assert program(np.zeros(2)).size == 0.0
    assert ConeProgram(region, other)(np.array([-1.0])).size == pytest.approx(0.25, rel=1e-6)


@pytest.mark.parametrize("learned", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_the_acceptance_region_is_that_of_the_monitor(seed: int, learned: bool) -> None:
    """Random directions: the monitor's own code rejects where the statistic passes 1."""
    scales = moment(seed, learned=learned)
    region = acceptance_region(scales)
    for direction in np.random.default_rng(seed).standard_normal((4, METERS)):
        assert boundary(scales, direction) * region.statistic(direction) == pytest.approx(1.0, rel=1e-6)
    short = acceptance_region(scales, levels=[1.0] + [0.0] * (len(scales.design.lengths) - 1))
    assert len(short.forms) == 1
    linear = acceptance_region(scales, misfit=False, busbar=False)
    assert not linear.forms
    assert len(linear.rows) == METERS * len(scales.design.lengths)


def sets_of(count: int) -> list[Ints]:
    return [np.array(some) for some in combinations(range(METERS), count)]


@pytest.mark.parametrize("seed", range(3))
def test_thresholds_equal_enumeration(seed: int) -> None:
    """Alone by the monitor's own tests; pairs by linear programs of all pairs."""
    scales = moment(seed)
    tests = MonitorTests.of(scales)
    V, prior = honest_covariance(scales, scales.design.lengths[-1])
    for j in range(METERS):
        unit = np.eye(METERS)[j]
        edge = boundary(scales, unit)
        alone = tests.threshold(tests.corridor(1), unit, must=j)
        assert alone.undetected == pytest.approx((1.0 - ROOM) * edge, rel=1e-4)
        assert alone.found == pytest.approx((1.0 + ROOM) * edge, rel=1e-4)
        assert alone.unavoidable == pytest.approx(tests.z / np.sqrt(np.linalg.inv(V)[j, j]), rel=1e-9)
        pair = tests.threshold(tests.corridor(2), unit, must=j)
        best = 0.0
        for some in sets_of(2):
            if j in some:
                part = tests.region.rows[:, some]
                goal = -(some == j).astype(np.float64)
                both, ones = np.vstack([part, -part]), np.ones(2 * len(part))
                # The misfit alone bounds each lie.
                ends = [(-tests.reach[k], tests.reach[k]) for k in some]
                best = max(best, -linprog(goal, A_ub=both, b_ub=ones, bounds=ends).fun)
        assert pair.found == pytest.approx((1.0 + ROOM) * best, rel=1e-4)
        assert alone.undetected <= pair.undetected * (1 + 1e-6)
        assert pair.undetected / (1.0 - ROOM) <= pair.found / (1.0 + ROOM) * (1 + 1e-6)
        assert np.count_nonzero(pair.lies) <= 2
        assert not told(scales, pair.lies / (1.0 - ROOM) * (1 - 1e-6))
    error = tests.threshold(tests.corridor(2), tests.region.weights[tests.region.weights.any(axis=1)][0])
    assert error.unavoidable > 0.0
    assert error.undetected < error.found
    assert prior.shape == tests.region.weights.shape
    none = tests.threshold(tests.corridor(1), np.zeros(METERS))
    assert none.undetected == none.unavoidable == 0.0
