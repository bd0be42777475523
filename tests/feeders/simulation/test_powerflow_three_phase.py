"""Asymmetric AC power flow against pandapower, power-grid-model, nodal admittances, and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandapower as pp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pandapower import networks

from feeders.convert.from_pandapower import read_pandapower
from feeders.convert.network import feeder_of
from feeders.format.tables import LineRow
from feeders.model.site import find, load
from feeders.model.three_phase import spanned, three_phase, three_phase_names
from feeders.simulation.powerflow import (
    PowerFlow,
    PowerFlowDiverged,
    UnbalancedGrid,
    UnbalancedPowerFlow,
    sequence_ohm,
)
from gridsec.errors import InputInvalid
from tests.codes import refused
from tests.feeders import asymmetric
from tests.gridsec.unbalanced import power_flow, random_three_phase

BUNDLED = ["kerber-landnetz", "kerber-dorfnetz", "kerber-vorstadtnetz", "cigre-lv", "simbench-lv-rural3"]


@pytest.mark.canary("off_peak_1")
@pytest.mark.parametrize("scenario", ["on_peak_566", "off_peak_1", "off_peak_1440"])
def test_agrees_with_pandapower(scenario: str) -> None:
    net = networks.ieee_european_lv_asymmetric(scenario)
    net.trafo["tap_dependency_table"] = False  # the file is older than this column
    pp.runpp_3ph(net, tolerance_mva=1e-10, numba=False)
    tables = feeder_of(read_pandapower(net), "european").tables
    site = three_phase(tables)
    root = int(net.trafo.lv_bus.iloc[0])
    angle = {phase: np.deg2rad(net.res_bus_3ph.at[root, f"va_{phase}_degree"]) for phase in "abc"}
    v0 = np.array([net.res_bus_3ph.at[root, f"vm_{phase}_pu"] * np.exp(1j * angle[phase]) for phase in "abc"])
    loads = net.asymmetric_load.set_index(net.asymmetric_load.name.astype(str))
    p, q = (
        np.array([loads.at[row.customer, f"{what}_{row.phases}_{unit}"] for row in tables.customers]) * 1e3
        for what, unit in (("p", "mw"), ("q", "mvar"))
    )
    nominal = tables.meta.voltage_volt
    _, volts = UnbalancedPowerFlow(site).solve(p, q, v0 * nominal)
    bus = {str(name): index for index, name in net.bus.name.items()}
    rows = [bus[name] for name in site.feeder.buses]
    expected = net.res_bus_3ph.loc[rows, ["vm_a_pu", "vm_b_pu", "vm_c_pu"]].to_numpy()
    assert len(rows) == 906
    assert np.ptp(expected, axis=0).max() > (0.05 if scenario == "on_peak_566" else 1e-4)
    np.testing.assert_allclose(volts / nominal, expected, rtol=0, atol=1e-5)


@pytest.mark.canary("kerber-landnetz-ends3")
@pytest.mark.parametrize(
    ("name", "ends"),
    [
        ("kerber-landnetz", None),
        ("kerber-dorfnetz", None),
        ("cigre-lv", None),
        ("kerber-landnetz", ("bus_1_13", "main_busbar")),
    ],
)
def test_agrees_with_pandapower_on_other_feeders(name: str, ends: tuple[str, str] | None) -> None:
    tables = asymmetric.unbalanced(name)
    if ends is not None:
        ring = LineRow("ring", *ends, 0.05, 0.01, r0_ohm=0.2, x0_ohm=0.03)
        tables = replace(tables, meta=replace(tables.meta, meshed=True), lines=(*tables.lines, ring))
    site, ties = spanned(tables)
    assert len(ties.ends) == (ends is not None)
    nominal = tables.meta.voltage_volt
    net = pp.create_empty_network(f_hz=50.0)
    names = list(site.bus_of_file)
    bus = {file_bus: pp.create_bus(net, nominal * np.sqrt(3.0) / 1e3) for file_bus in names}
    pp.create_ext_grid(
        net, bus[tables.meta.busbar], vm_pu=1.02, s_sc_max_mva=1e3, rx_max=0.1, r0x0_max=0.1, x0x_max=1.0
    )
    for line in (line for line in tables.lines if line.closed):
        nf = line.b_us * 1e3 / (2 * np.pi * 50.0)
        pp.create_line_from_parameters(
            net, bus[line.from_bus], bus[line.to_bus], 1.0, line.r_ohm, line.x_ohm, nf, 1.0,
            r0_ohm_per_km=line.r0_ohm, x0_ohm_per_km=line.x0_ohm, c0_nf_per_km=nf,
        )  # fmt: skip
    rng = np.random.default_rng(8)
    p = np.array([row.load_kw for row in tables.customers]) * rng.uniform(0.0, 0.4, len(tables.customers))
    q = 0.2 * p
    for row, own_p, own_q in zip(tables.customers, p / 1e3, q / 1e3, strict=True):
        share = {f"p_{phase}_mw": own_p / len(row.phases) for phase in row.phases}
        share |= {f"q_{phase}_mvar": own_q / len(row.phases) for phase in row.phases}
        pp.create_asymmetric_load(net, bus[row.bus], **share)
    pp.runpp_3ph(net, tolerance_mva=1e-10, numba=False)
    found = net.res_bus_3ph.loc[[bus[file_bus] for file_bus in names]]
    size, angle = (
        found[[f"{what}_{phase}_{unit}" for phase in "abc"]].to_numpy()
        for what, unit in (("vm", "pu"), ("va", "degree"))
    )
    root = names.index(tables.meta.busbar)
    v0 = nominal * size[root] * np.exp(1j * np.deg2rad(angle[root]))
    volts = UnbalancedPowerFlow(site).solve(p, q, v0)[1][[site.bus_of_file[file_bus] for file_bus in names]]
    assert np.ptp(size) > 3e-3
    np.testing.assert_allclose(volts / nominal, size, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", [*BUNDLED, *three_phase_names()])
def test_agrees_with_power_grid_model(name: str) -> None:
    tables = asymmetric.unbalanced(name) if name in BUNDLED else find(name)
    site = three_phase(tables)
    rng = np.random.default_rng(5)
    load = np.array([row.load_kw for row in tables.customers])
    p = load * rng.uniform(-0.15, 0.3, load.size)
    q = 0.3 * np.abs(p)
    expected = asymmetric.solve(tables, p, q, 1.02)
    nominal = tables.meta.voltage_volt
    connections, volts = UnbalancedPowerFlow(site).solve(p, q, 1.02 * nominal)
    unequal = 0.0
    for file_bus, bus in site.bus_of_file.items():
        np.testing.assert_allclose(volts[bus] / nominal, expected[file_bus], rtol=0, atol=1e-8)
        unequal = max(unequal, float(np.ptp(expected[file_bus])))
    assert unequal > 3e-3  # the case would prove nothing on a balanced feeder
    np.testing.assert_array_equal(connections, volts[site.feeder.at, site.feeder.phase])


def test_a_transformer_is_its_sequence_impedances() -> None:
    """Dyn5, star grounded: the same short-circuit impedance for both sequences."""
    tables = asymmetric.unbalanced("kerber-landnetz")
    low = tables.meta.voltage_volt * np.sqrt(3.0)
    sn, uk, pk = 160e3, 0.04, 2350.0
    transformer = {
        "u1": 20e3, "u2": low, "sn": sn, "uk": uk, "pk": pk, "i0": 0.0, "p0": 0.0, "winding_from": 2,
        "winding_to": 1, "clock": 5, "tap_side": 0, "tap_pos": 0, "tap_min": 0, "tap_max": 0, "tap_size": 0.0,
    }  # fmt: skip
    rng = np.random.default_rng(6)
    p = np.array([row.load_kw for row in tables.customers]) * rng.uniform(0.2, 0.6, len(tables.customers))
    q = 0.2 * p
    expected = asymmetric.solve(tables, p, q, 1.03, transformer)
    base = low**2 / sn
    z = base * complex(pk / sn, np.sqrt(uk**2 - (pk / sn) ** 2))
    site = three_phase(tables)
    flow = UnbalancedPowerFlow(site, source_ohm=sequence_ohm(z, z))
    _, volts = flow.solve(p, q, 1.03 * tables.meta.voltage_volt)
    for file_bus, bus in site.bus_of_file.items():
        # Which phase is called a behind a delta is a convention.
        got, wants = np.sort(volts[bus]) / tables.meta.voltage_volt, np.sort(expected[file_bus])
        np.testing.assert_allclose(got, wants, rtol=0, atol=1e-7)
    assert np.all(np.abs(expected[tables.meta.busbar] - 1.03) > 1e-3)


def test_zero_sequence_of_the_source_is_its_own() -> None:
    """A source's impedance is a line more, with the given voltage at its far end."""
    grid = of_model(3, branches=5)
    z = sequence_ohm(0.02 + 0.03j, 0.05 + 0.01j)
    behind = replace(grid, source_ohm=z)
    shifted = replace(
        grid,
        ends=np.vstack([[grid.bus_count, grid.busbar], grid.ends]),
        present=np.vstack([[True] * 3, grid.present]),
        z_ohm=np.concatenate([z[None], grid.z_ohm]),
        b_siemens=np.concatenate([np.zeros((1, 3, 3)), grid.b_siemens]),
        busbar=grid.bus_count,
        bus_count=grid.bus_count + 1,
    )
    count = grid.customer_bus.size
    p, q = np.full(count, 2.0), np.full(count, 0.7)
    v0 = np.array([231.0, 228.0, 234.0])
    one, its = UnbalancedPowerFlow.of(behind).solve(p, q, v0)
    other, buses = UnbalancedPowerFlow.of(shifted).solve(p, q, v0)
    np.testing.assert_allclose(one, other, rtol=1e-10)
    np.testing.assert_allclose(its, buses[:-1], rtol=1e-10)
    assert np.all(np.abs(its[grid.busbar] - v0) > 1e-3)


def of_model(seed: int, *, branches: int | None = None, charging: float = 0.0) -> UnbalancedGrid:
    """A random feeder with laterals and full matrices in SI: 230 V, 100 kVA."""
    feeder = random_three_phase(seed, branches=branches, charging=charging)
    base = 3 * feeder.base_volt**2 / (1e3 * feeder.base_kva)
    return UnbalancedGrid(
        ends=np.column_stack([feeder.parent, np.arange(1, feeder.parent.size + 1)]),
        present=feeder.phases[1:],
        z_ohm=feeder.z * base,
        b_siemens=feeder.charging / base,
        busbar=0,
        customer_bus=feeder.bus,
        connected=feeder.connected,
        bus_count=len(feeder.buses),
        nominal_volt=feeder.base_volt,
    )


@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.03]))
@settings(max_examples=40)
def test_laterals_and_full_matrices(seed: int, charging: float) -> None:
    feeder = random_three_phase(seed, charging=charging)
    flow = UnbalancedPowerFlow.of(of_model(seed, charging=charging))
    rng = np.random.default_rng(seed)
    p, q = 1.5 * rng.normal(size=(2, feeder.bus.size))
    v0 = np.array([1.03, 1.0, 0.98])
    per_phase = feeder.base_kva / 3
    truth = power_flow(feeder, feeder.connections(-p) / per_phase, feeder.connections(-q) / per_phase, v0**2)
    phasors = flow.phasors(p[None], q[None], v0[None] * feeder.base_volt)[0] / feeder.base_volt
    np.testing.assert_allclose(phasors.T, truth, rtol=0, atol=1e-9)
    assert np.array_equal(np.isnan(phasors), ~feeder.phases)


@pytest.mark.parametrize("name", BUNDLED[:2])
def test_balanced_customers_give_the_balanced_power_flow(name: str) -> None:
    site = load(name)
    tables = asymmetric.unbalanced(name)
    everywhere = tuple(replace(row, phases="abc") for row in tables.customers)
    three = three_phase(replace(tables, customers=everywhere))
    p = np.array([row.load_kw for row in tables.customers]) * 0.4
    expected = PowerFlow(site).solve(p, 0.3 * p, 232.0)[1]
    volts = UnbalancedPowerFlow(three).solve(p, 0.3 * p, 232.0)[1]
    assert three.feeder.buses == site.feeder.buses
    for phase in range(3):
        np.testing.assert_allclose(volts[:, phase], expected, rtol=0, atol=1e-6)


def test_currents_balance_in_a_closed_ring() -> None:
    """The power flow takes a mesh; Kirchhoff's law holds in every phase of every bus."""
    z = np.stack([sequence_ohm(0.1 * k + 0.05j, 0.3 * k + 0.2j) for k in (1, 2, 3)])
    grid = UnbalancedGrid(
        ends=np.array([[0, 1], [1, 2], [2, 0]]),
        present=np.ones((3, 3), dtype=bool),
        z_ohm=z,
        b_siemens=np.full((3, 3, 3), 1e-5) * np.eye(3),
        busbar=0,
        customer_bus=np.array([1, 2, 0]),
        connected=np.array([[0, 1, 0], [1, 1, 1], [0, 0, 1]], dtype=bool),
        bus_count=3,
        nominal_volt=230.0,
    )
    p, q = np.array([5.0, 9.0, 3.0]), np.array([1.0, -2.0, 0.0])
    u = UnbalancedPowerFlow.of(grid).phasors(p[None], q[None], np.array([230.0]))[0]
    drawn = np.zeros((3, 3), dtype=complex)
    drawn[1, 1] = np.conj(1e3 * (5 + 1j) / u[1, 1])
    drawn[2] = np.conj(1e3 * (9 - 2j) / 3 / u[2])
    for k, (a, b) in enumerate(grid.ends):
        series = np.linalg.solve(z[k], u[a] - u[b])
        drawn[a] += series + 0.5j * grid.b_siemens[k] @ u[a]
        drawn[b] += -series + 0.5j * grid.b_siemens[k] @ u[b]
    assert np.abs(drawn[1:]).max() < 1e-7


def test_batch_equals_single() -> None:
    flow = UnbalancedPowerFlow.of(of_model(21, branches=9, charging=0.02))
    rng = np.random.default_rng(2)
    p, q = rng.normal(1.0, 1.0, (2, 7, flow.grid.customer_bus.size))
    v0 = rng.uniform(225.0, 240.0, (7, 3))
    connections, buses = flow.solve_batch(p, q, v0)
    for k in range(7):
        one, its = flow.solve(p[k], q[k], v0[k])
        np.testing.assert_allclose(connections[k], one, rtol=1e-10)
        np.testing.assert_allclose(buses[k], its, rtol=1e-10)
    turned = v0 * np.exp(-2j * np.pi / 3 * np.arange(3))
    np.testing.assert_array_equal(flow.solve_batch(p, q, turned)[0], connections)
    none = flow.solve_batch(p[:0], q[:0], v0[:0])
    assert none[0].shape == (0, connections.shape[1])


def test_an_impossible_load_is_an_error_of_its_own() -> None:
    flow = UnbalancedPowerFlow.of(of_model(21, branches=9))
    count = flow.grid.customer_bus.size
    good, bad = np.full(count, 0.5), np.full(count, 1e4)
    with pytest.raises(PowerFlowDiverged, match="set 0"):
        flow.solve(bad, bad, 230.0)
    with pytest.raises(PowerFlowDiverged, match="set 1"):
        flow.solve_batch(np.array([good, bad]), np.array([good, bad]), np.full(2, 230.0))
    assert flow.solve(good, good, 230.0)[0].max() < 231.0  # still usable


def test_a_customer_needs_his_phase() -> None:
    grid = of_model(3, branches=5)
    lame = replace(grid, present=grid.present & np.array([True, True, False]))
    all_three = replace(lame, connected=np.ones_like(grid.connected), customer_bus=grid.customer_bus * 0 + 5)
    with refused(InputInvalid, "absent-phase"):
        UnbalancedPowerFlow.of(all_three)


def test_a_feeder_without_customers_is_at_the_voltage_of_its_busbar() -> None:
    grid = of_model(3, branches=5)
    idle = replace(grid, customer_bus=np.zeros(0, dtype=np.intp), connected=np.zeros((0, 3), dtype=bool))
    for source in (None, sequence_ohm(0.02 + 0.03j, 0.05 + 0.01j)):
        flow = UnbalancedPowerFlow.of(replace(idle, source_ohm=source))
        connections, buses = flow.solve(np.zeros(0), np.zeros(0), 231.0)
        assert connections.shape == (0,)
        np.testing.assert_allclose(buses[~np.isnan(buses)], 231.0, rtol=1e-12)
    nothing = slice(0)
    alone = replace(
        idle,
        ends=idle.ends[nothing],
        present=idle.present[nothing],
        z_ohm=idle.z_ohm[nothing],
        b_siemens=idle.b_siemens[nothing],
        bus_count=1,
    )
    _, buses = UnbalancedPowerFlow.of(alone).solve(np.zeros(0), np.zeros(0), 231.0)
    np.testing.assert_allclose(buses, np.full((1, 3), 231.0), rtol=1e-14)
