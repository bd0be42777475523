"""Inverters in closed loop with AC power flow, against scipy's root finder and ODE solver."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import root

from feeders.model.site import Site, from_tables
from feeders.simulation.plant import TOLERANCE_PU, ClosedLoop, Loads, NoEquilibrium, Point
from feeders.simulation.powerflow import PowerFlow, PowerFlowDiverged
from gridsec.grid.devices import PRESETS, Droop, fleet, voltage_curve
from tests.codes import refused
from tests.feeders.villages import tables, village


def closed_loop(site: Site, droop: Droop | None = None) -> ClosedLoop:
    droop = site.droop if droop is None else droop
    return ClosedLoop(PowerFlow(site), droop, site.feeder.base_kva, site.feeder.base_volt)


def some_loads(v0: float, level: float = 1.0) -> Loads:
    load = np.array([row.load_kw for row in tables().customers])
    pv = np.array([row.pv_kw for row in tables().customers])
    return Loads(level * (0.1 * load - 0.9 * pv), 0.3 * load, v0)


def strong(gain: float) -> Site:
    """The village with larger inverters."""
    rows = tuple(replace(row, inverter_kva=gain * row.inverter_kva) for row in tables().customers)
    return from_tables(replace(tables(), customers=rows))


def loop_gain(loop: ClosedLoop, loads: Loads) -> float:
    """Spectral radius of d(set-point)/dx, measured by AC power flow."""
    x = loop.equilibrium(loads).x
    h = 1e-4
    columns = [
        (loop.point(loads, x + h * e).setpoint - loop.point(loads, x - h * e).setpoint) / (2 * h)
        for e in np.eye(loop.count)
    ]
    return float(np.max(np.abs(np.linalg.eigvals(np.array(columns).T))))


@given(v=st.lists(st.floats(0.8, 1.2), min_size=len(PRESETS), max_size=len(PRESETS)))
def test_curves_are_those_of_the_fleet(v: list[float]) -> None:
    site = village()
    customers = np.arange(len(PRESETS))
    droop = fleet(customers, list(PRESETS), np.linspace(5.0, 30.0, len(PRESETS)), 100.0)
    volts = np.append(np.array(v), 1.0) * site.feeder.base_volt
    expected = voltage_curve(droop, np.array(v))
    np.testing.assert_allclose(closed_loop(site, droop).setpoint(volts), expected, atol=1e-14)


@pytest.mark.parametrize("v0", [205.0, 230.0, 238.0, 244.0, 252.0])
def test_equilibrium_is_the_fixed_point_that_scipy_finds(v0: float) -> None:
    site, loads = village(), some_loads(v0)
    loop, flow, droop = closed_loop(site), PowerFlow(site), site.droop

    def defect(x: np.ndarray) -> np.ndarray:
        q = loads.q_kvar.copy()
        for i, customer in enumerate(droop.customer):
            q[customer] -= x[i] * site.feeder.base_kva
        v, _ = flow.solve(loads.p_kw, q, v0)
        return voltage_curve(droop, v[droop.customer] / site.feeder.base_volt) - x

    found = root(defect, np.zeros(droop.tau.size), method="hybr", tol=1e-12)
    assert found.success
    point = loop.equilibrium(loads)
    np.testing.assert_allclose(point.x, found.x, atol=5 * TOLERANCE_PU)
    np.testing.assert_allclose(point.setpoint, point.x, atol=TOLERANCE_PU)


@pytest.mark.parametrize("gain", [12.0, 25.0])
def test_equilibrium_where_plain_iteration_diverges(gain: float) -> None:
    loads, loop = some_loads(244.0), closed_loop(strong(gain))
    assert loop_gain(loop, loads) > 1.4
    x, size = np.zeros(loop.count), []
    try:
        for _ in range(60):
            point = loop.point(loads, x)
            size.append(float(np.max(np.abs(point.setpoint - x))))
            x = point.setpoint
    except PowerFlowDiverged:  # it even leaves the region where the feeder has voltages
        size.append(np.inf)
    assert size[-1] > 1e-2  # x <- K(v(x)) goes round and round
    settled = loop.equilibrium(loads)
    assert np.max(np.abs(settled.setpoint - settled.x)) <= TOLERANCE_PU
    # The same point from another start.
    np.testing.assert_allclose(loop.equilibrium(loads, np.full(loop.count, 0.1)).x, settled.x, atol=1e-5)


def reference(loop: ClosedLoop, before: Loads, after: Loads, times: np.ndarray) -> np.ndarray:
    """x at `times` after a step of the loads from equilibrium, by an ODE solver on AC power flow."""
    start = loop.equilibrium(before).x

    def rate(_: float, x: np.ndarray) -> np.ndarray:
        return (loop.point(after, x).setpoint - x) / loop.tau

    solution = solve_ivp(rate, (0.0, times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-11, max_step=0.1)
    return solution.y.T


def course(loop: ClosedLoop, before: Loads, after: Loads, times: np.ndarray) -> np.ndarray:
    """The same by our own steps."""
    h = float(times[1] - times[0])
    now = replace(loop.equilibrium(before), setpoint=loop.point(after, loop.equilibrium(before).x).setpoint)
    last: Point | None = None
    out = [now.x]
    for _ in times[1:]:
        last, now = now, loop.advance(after, now, last, h)
        out.append(now.x)
    return np.array(out)


@pytest.mark.canary("1.0-8.0")
@pytest.mark.parametrize(("gain", "order"), [(1.0, 8.0), (12.0, 3.0)])
def test_steps_follow_the_differential_equation_in_second_order(gain: float, order: float) -> None:
    loop = closed_loop(strong(gain))
    before, after = some_loads(233.0), some_loads(245.0)
    worst = []
    for h in (0.5, 0.25, 0.125):
        times = np.arange(0.0, 10.0 + h / 2, h)
        error = course(loop, before, after, times) - reference(loop, before, after, times)
        worst.append(np.max(np.abs(error)) / np.max(np.abs(loop.equilibrium(after).x)))
    assert worst[0] < 2e-2
    assert worst[-1] < 1.5e-3
    # Halving twice divides by 16 while no kink is crossed; strong inverters cross several.
    assert worst[0] / worst[-1] > order


@pytest.mark.parametrize("h", [30.0, 900.0])
def test_long_steps_end_in_the_equilibrium(h: float) -> None:
    loop = closed_loop(strong(12.0))
    before, after = some_loads(233.0), some_loads(245.0)
    now = loop.equilibrium(before)
    gaps = []
    target = loop.equilibrium(after).x
    for _ in range(8):
        now = loop.advance(after, now, None, h)
        gaps.append(float(np.max(np.abs(now.x - target))))
    assert gaps[-1] < 2e-6
    assert all(later <= earlier + 1e-6 for earlier, later in pairwise(gaps))


def test_no_inverters_at_all() -> None:
    site = village()
    empty = Droop(np.zeros(0, dtype=np.intp), np.zeros((0, 4)), np.zeros((0, 4)), np.zeros(0))
    loop = closed_loop(site, empty)
    loads = some_loads(230.0)
    point = loop.equilibrium(loads)
    expected, _ = PowerFlow(site).solve(loads.p_kw, loads.q_kvar, 230.0)
    np.testing.assert_array_equal(point.v_volt, expected)
    assert loop.advance(loads, point, None, 1.0).x.shape == (0,)


def test_what_cannot_settle_is_an_error_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("feeders.simulation.plant.MAX_ITERATIONS", 1)
    with refused(NoEquilibrium, "not-converged"):
        closed_loop(strong(25.0)).equilibrium(some_loads(244.0))
