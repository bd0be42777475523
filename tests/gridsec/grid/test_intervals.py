"""Bounds for all powers within intervals, against AC power flows that share no code with them."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from gridsec.arrays import Floats
from gridsec.grid.intervals import Sweeps, bounds
from gridsec.grid.meshed import MeshedFeeder
from gridsec.grid.phased import InPhases, PhasedFeeder
from tests.gridsec.meshes import ac, random_mesh
from tests.gridsec.unbalanced import ac_places, random_phased_mesh, random_three_phase


def exact(feeder: InPhases | MeshedFeeder, p: Floats, q: Floats, v0: Floats | float) -> Floats:
    """Squared voltages of the customers by an AC power flow."""
    if isinstance(feeder, MeshedFeeder):
        return ac(feeder, p, q, float(v0))[feeder.bus]
    return np.asarray(ac_places(feeder, p, q, v0)[feeder.bus])


def contained(
    feeder: InPhases | MeshedFeeder, rng: np.random.Generator, v0: Floats | float, size: float
) -> None:
    """Corners of random intervals, and points within, stay inside both bounds."""
    count = feeder.bus.size
    p, q = size * rng.normal(-0.5, 1.0, (2, count))
    p_error, q_error = size * rng.uniform(0.0, 0.6, (2, count))
    moved, rest = feeder.interval_bounds(p, q, v0, p_error=p_error, q_error=q_error)
    assert np.isfinite(rest).all()
    centre = feeder.loss_correction(p, q, v0, steps=1)[feeder.bus]
    for k in range(12):
        sign = rng.choice([-1.0, 1.0], (2, count)) if k else np.ones((2, count))
        sign = sign if k % 3 else sign * rng.uniform(0.0, 1.0, (2, count))
        there = p + sign[0] * p_error, q + sign[1] * q_error
        found = feeder.loss_correction(*there, v0, steps=1)[feeder.bus]
        assert (np.abs(found - centre) <= moved + 1e-13).all()
        for steps in (1, 2):
            v2 = feeder.bus_voltages(*there, v0, steps=steps)[feeder.bus]
            assert (np.abs(v2 - exact(feeder, *there, v0)) <= rest + 2e-9).all()


@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.02]))
@settings(max_examples=15, deadline=None)
def test_three_phases(seed: int, charging: float) -> None:
    rng = np.random.default_rng(seed)
    feeder = PhasedFeeder(random_three_phase(seed, single=True, charging=charging))
    contained(feeder, rng, rng.uniform(0.95, 1.05, 3) ** 2, 0.01)


@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.02]))
@settings(max_examples=5, deadline=None)
def test_loops(seed: int, charging: float) -> None:
    rng = np.random.default_rng(seed)
    contained(random_mesh(seed, charging=charging, customers=6), rng, rng.uniform(0.95, 1.05) ** 2, 0.01)


@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.02]))
@settings(max_examples=12, deadline=None)
def test_loops_in_three_phases(seed: int, charging: float) -> None:
    rng = np.random.default_rng(seed)
    contained(random_phased_mesh(seed, charging=charging), rng, rng.uniform(0.95, 1.05, 3) ** 2, 0.01)


@pytest.mark.parametrize(("load", "shrink"), [(0.1, 0.11), (0.8, 0.9)])
def test_one_place_by_hand(load: float, shrink: float) -> None:
    """The formulas of a scalar, for which the sum of all further changes is a geometric series."""
    flat, first, second, Z, e = 1.01 + 0.0j, 1.0 - 0.01j, 1.0 - 0.011j, 0.9, 2e-3
    place = Sweeps(
        *(np.array([v]) for v in (flat, first, second)),
        power=np.array([load]),
        reach=lambda currents: Z * currents,
        charge=np.zeros_like,
    )
    (moved,), (rest,) = bounds(place, np.array([e]))
    d = Z * e / abs(flat)
    low = abs(first) - d
    c = Z * (e * (abs(first - flat) + d) / (low * abs(flat)) + load * d / (low * abs(first)))
    m = 0.9 * (abs(second) - d - c)
    ratio = Z * (load + e) / (m * min(m, low))
    assert ratio == pytest.approx(shrink, abs=0.01)
    assert moved == pytest.approx(
        2.0 * abs(second - flat) * d + 2.0 * abs(second) * c + (d + c) ** 2, rel=1e-12
    )
    off = ratio / (1.0 - ratio) * (abs(second - first) + c)
    assert rest == pytest.approx(off * (2.0 * (abs(second) + d + c) + off), rel=1e-12)


def test_without_intervals_only_the_model_is_left() -> None:
    """Near collapse, and with powers of which nothing is known, the bounds are infinite."""
    feeder = PhasedFeeder(random_three_phase(3, single=True))
    none, p = np.zeros(feeder.bus.size), np.full(feeder.bus.size, -0.01)
    moved, rest = feeder.interval_bounds(p, p, 1.0, p_error=none, q_error=none)
    np.testing.assert_array_equal(moved, none)
    assert (rest < 1e-3).all()
    for q, error in ((p, none + 1e4), (100.0 * p, none)):
        for bound in feeder.interval_bounds(q, q, 1.0, p_error=error, q_error=error):
            assert np.isinf(bound).all()


def test_an_end_where_all_err_alike_is_not_the_worst() -> None:
    """A load on another phase may lift the correction: why corners with one sign do not do."""
    rng = np.random.default_rng(0)
    beaten = 0
    for seed in range(20):
        feeder = PhasedFeeder(random_three_phase(seed, single=True, branches=6))
        count = feeder.bus.size
        p, q, error = *0.01 * rng.normal(-0.5, 1.0, (2, count)), np.full(count, 0.005)
        centre = feeder.loss_correction(p, q, 1.0, steps=1)[feeder.bus]

        def moved(sign: Floats) -> Floats:
            found = feeder.loss_correction(p + sign * error, q + sign * error, 1.0, steps=1)  # noqa: B023
            return np.abs(found[feeder.bus] - centre)  # noqa: B023

        alike = np.maximum(moved(np.ones(count)), moved(-np.ones(count)))
        beaten += any((moved(rng.choice([-1.0, 1.0], count)) > alike).any() for _ in range(30))
    assert beaten >= 10
