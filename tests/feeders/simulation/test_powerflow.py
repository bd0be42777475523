"""AC power flow against pandapower, against Kirchhoff's law, and against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from pandapower import networks, runpp

from feeders.simulation.powerflow import Grid, PowerFlow, PowerFlowDiverged

OMEGA = 2.0 * np.pi * 50.0


@cache
def solved_pandapower(build: Callable[[], Any], busbar: int | None) -> tuple[Grid, Any, list[int]]:
    """A pandapower network, solved by pandapower, and the part of it below `busbar` as SI arrays."""
    net = build()
    runpp(net, init="dc", tolerance_mva=1e-12, numba=False)
    root = int(net.trafo.lv_bus.iloc[0]) if busbar is None else busbar
    lines = net.line[net.line.in_service]
    open_ends = set(net.switch[(net.switch.et == "l") & ~net.switch.closed].element)
    lines = lines[~lines.index.isin(open_ends)]
    reached, grown = {root}, True
    while grown:
        here = lines[lines.from_bus.isin(reached) ^ lines.to_bus.isin(reached)]
        grown = not here.empty
        reached |= set(here.from_bus) | set(here.to_bus)
    buses = sorted(reached)
    lines = lines[lines.from_bus.isin(reached)]
    number = {bus: i for i, bus in enumerate(buses)}
    loads = net.load[net.load.bus.isin(reached) & net.load.in_service]
    length = lines.length_km / lines.parallel
    grid = Grid(
        ends=np.array([[number[a], number[b]] for a, b in zip(lines.from_bus, lines.to_bus, strict=True)]),
        r_ohm=(lines.r_ohm_per_km * length).to_numpy(),
        x_ohm=(lines.x_ohm_per_km * length).to_numpy(),
        b_siemens=(lines.c_nf_per_km * 1e-9 * lines.length_km * lines.parallel).to_numpy() * OMEGA,
        busbar=number[root],
        customer_bus=np.array([number[bus] for bus in loads.bus]),
        bus_count=len(buses),
        nominal_volt=float(net.bus.vn_kv[root]) * 1e3 / np.sqrt(3.0),
    )
    return grid, net, buses


NETWORKS: dict[str, tuple[Callable[[], Any], int | None]] = {
    "kerber-landnetz-freileitung": (networks.create_kerber_landnetz_freileitung_1, None),
    "kerber-landnetz-kabel": (networks.create_kerber_landnetz_kabel_2, None),
    "kerber-dorfnetz": (networks.create_kerber_dorfnetz, None),
    "kerber-vorstadtnetz": (networks.create_kerber_vorstadtnetz_kabel_1, None),
    "cigre-lv": (networks.create_cigre_network_lv, None),
    "case33bw": (networks.case33bw, 0),
}


@pytest.mark.canary("cigre-lv")
@pytest.mark.parametrize("name", NETWORKS)
def test_agrees_with_pandapower(name: str) -> None:
    grid, net, buses = solved_pandapower(*NETWORKS[name])
    loads = net.load[net.load.bus.isin(buses) & net.load.in_service]
    v0 = float(net.res_bus.vm_pu[buses[grid.busbar]]) * grid.nominal_volt
    customers, volts = PowerFlow.of(grid).solve(
        loads.p_mw.to_numpy() * 1e3, loads.q_mvar.to_numpy() * 1e3, v0
    )
    expected = net.res_bus.vm_pu.loc[buses].to_numpy()
    assert len(buses) > 10
    assert np.ptp(expected) > 5e-3  # the case would prove nothing without a voltage drop
    np.testing.assert_allclose(volts / grid.nominal_volt, expected, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(customers, volts[grid.customer_bus])


@pytest.mark.canary("cigre-lv")
@pytest.mark.parametrize("name", NETWORKS)
def test_currents_balance_at_every_bus(name: str) -> None:
    grid, net, buses = solved_pandapower(*NETWORKS[name])
    random = np.random.default_rng(1)
    loads = net.load[net.load.bus.isin(buses) & net.load.in_service]
    p = loads.p_mw.to_numpy() * 1e3 * random.uniform(-0.5, 1.0, len(loads))
    q = loads.q_mvar.to_numpy() * 1e3 * random.uniform(-0.5, 1.0, len(loads))
    v0 = 1.02 * grid.nominal_volt
    u = PowerFlow.of(grid).phasors(p, q, v0)

    current = np.zeros(grid.bus_count, dtype=complex)  # into each bus, per phase, A
    a, b = grid.ends.T
    series = (u[a] - u[b]) / (grid.r_ohm + 1j * grid.x_ohm)
    np.add.at(current, b, series)
    np.subtract.at(current, a, series)
    for end in (a, b):
        np.subtract.at(current, end, u[end] * 0.5j * grid.b_siemens)
    np.subtract.at(current, grid.customer_bus, np.conj((p + 1j * q) * 1e3 / 3.0 / u[grid.customer_bus]))
    current[grid.busbar] = 0.0  # what the busbar feeds in is free
    assert abs(u[grid.busbar] - v0) / v0 < 1e-8
    assert np.max(np.abs(current)) < 1e-6 * np.max(np.abs(series))


def one_line(r: float = 0.2, x: float = 0.1) -> Grid:
    return Grid(
        ends=np.array([[0, 1]]),
        r_ohm=np.array([r]),
        x_ohm=np.array([x]),
        b_siemens=np.zeros(1),
        busbar=0,
        customer_bus=np.array([1, 0]),
        bus_count=2,
        nominal_volt=230.0,
    )


def test_one_line_has_a_closed_form() -> None:
    r, x, p, q, v0 = 0.2, 0.1, 15.0, 4.0, 235.0
    customers, _ = PowerFlow.of(one_line(r, x)).solve(np.array([p, 50.0]), np.array([q, 9.0]), v0)
    # v^4 + (2 (r P + x Q) - v0^2) v^2 + (r^2 + x^2)(P^2 + Q^2) = 0 with P, Q per phase.
    per_phase = 1e3 / 3.0
    b = 2 * (r * p + x * q) * per_phase - v0**2
    c = (r**2 + x**2) * (p**2 + q**2) * per_phase**2
    expected = np.sqrt((-b + np.sqrt(b**2 - 4 * c)) / 2)
    np.testing.assert_allclose(customers, [expected, v0], rtol=1e-9)


def test_batch_equals_single() -> None:
    grid, _, _ = solved_pandapower(*NETWORKS["kerber-dorfnetz"])
    flow = PowerFlow.of(grid)
    random = np.random.default_rng(2)
    count = grid.customer_bus.size
    p, q = random.normal(2.0, 2.0, (7, count)), random.normal(0.5, 0.5, (7, count))
    v0 = random.uniform(220.0, 240.0, 7)
    customers, buses = flow.solve_batch(p, q, v0)
    assert customers.shape == (7, count)
    for k in range(7):
        one_customers, one_buses = flow.solve(p[k], q[k], float(v0[k]))
        np.testing.assert_allclose(customers[k], one_customers, rtol=1e-12)
        np.testing.assert_allclose(buses[k], one_buses, rtol=1e-12)


def test_a_solve_does_not_depend_on_the_one_before() -> None:
    flow = PowerFlow.of(one_line())
    p, q = np.array([12.0, 1.0]), np.array([3.0, 0.0])
    first = flow.solve(p, q, 230.0)[0].copy()
    flow.solve(-5 * p, 2 * q, 250.0)
    np.testing.assert_array_equal(flow.solve(p, q, 230.0)[0], first)


def test_empty_batch() -> None:
    customers, buses = PowerFlow.of(one_line()).solve_batch(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    assert customers.shape == (0, 2)
    assert buses.shape == (0, 2)


def test_an_impossible_load_is_an_error_of_its_own() -> None:
    flow = PowerFlow.of(one_line())
    # Beyond v0^4 / 4 of the discriminant above there is no solution.
    with pytest.raises(PowerFlowDiverged):
        flow.solve(np.array([5e3, 0.0]), np.zeros(2), 230.0)
    with pytest.raises(PowerFlowDiverged, match="set 1"):
        flow.solve_batch(np.array([[5.0, 0.0], [5e3, 0.0]]), np.zeros((2, 2)), np.array([230.0, 230.0]))
    assert flow.solve(np.array([5.0, 0.0]), np.zeros(2), 230.0)[0][0] < 230.0  # still usable
