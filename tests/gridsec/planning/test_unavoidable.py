"""Unavoidable errors and hidden errors, against simulation and another solver."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import ncx2, norm

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
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
