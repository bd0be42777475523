"""Transformers inside a feeder: two nominal voltages in one model, against AC power flows that have both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandapower
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from feeders.format.tables import FeederTables, LineRow, from_json, read, to_json, validate, write
from feeders.model.site import Site, Snapshot, from_tables, to_frame, volts
from feeders.model.three_phase import three_phase
from feeders.simulation.plant import ClosedLoop, Loads
from feeders.simulation.powerflow import PowerFlow, UnbalancedPowerFlow, power_flow
from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid
from gridsec.grid.devices import preset
from tests.feeders import stations
from tests.feeders.stations import LV, MV

P_KW = np.array([210.0, 90.0, 120.0, 12.0, -6.0, 9.0, 14.0, -11.0, 10.0, 5.0, 13.0])
Q_KVAR = np.array([80.0, 25.0, 60.0, 3.0, 2.0, -4.0, 5.0, 6.0, 2.0, 1.0, 4.0])
NOMINAL = {"works": MV, "m1": MV, "m2": MV, "m3": MV} | dict.fromkeys(
    ("s1", "a1", "a2", "s2", "b1", "b2"), LV
)


@pytest.fixture(scope="module")
def site() -> Site:
    return from_tables(stations.tables())


def pandapower_net(tables: FeederTables) -> Any:
    """The same feeder, built in pandapower's own terms: transformers by rated voltages, vk and tap steps."""
    net = pandapower.create_empty_network(f_hz=50.0)
    at = {bus: pandapower.create_bus(net, volt * 3**0.5 / 1e3, name=bus) for bus, volt in NOMINAL.items()}
    pandapower.create_ext_grid(net, at["works"], vm_pu=1.02)
    for row in tables.lines:
        ends = at[row.from_bus], at[row.to_bus]
        if row.to_volt is None:
            pandapower.create_line_from_parameters(
                net, *ends, 1.0, row.r_ohm, row.x_ohm, row.b_us * 1e3 / (2 * np.pi * 50.0), 1.0
            )
            continue
        percent = 100.0 * 0.4 / 0.4**2  # of the rated impedance of 400 kVA, at the lower voltage
        size = float(np.hypot(row.r_ohm, row.x_ohm))
        pandapower.create_transformer_from_parameters(
            net, *ends, sn_mva=0.4, vn_hv_kv=20.0, vn_lv_kv=0.4, vkr_percent=percent * row.r_ohm,
            vk_percent=percent * size, pfe_kw=0.0, i0_percent=0.0, tap_side="hv", tap_neutral=0,
            tap_step_percent=2.5, tap_pos=round((row.tap - 1.0) / 0.025), tap_changer_type="Ratio",
        )  # fmt: skip
    for row, p, q in zip(tables.customers, P_KW, Q_KVAR, strict=True):
        pandapower.create_load(net, at[row.bus], p / 1e3, q / 1e3)
    pandapower.runpp(net, numba=False, tolerance_mva=1e-11)
    return net


def test_every_bus_has_its_nominal_voltage(site: Site) -> None:
    nominal = np.array([NOMINAL[bus] for bus in site.feeder.buses])
    np.testing.assert_array_equal(site.nominal_volt, nominal)
    step_up = np.array([1 / 0.975 if bus in ("s2", "b1", "b2") else 1.0 for bus in site.feeder.buses])
    np.testing.assert_allclose(site.base_volt, nominal * step_up, rtol=1e-15)
    np.testing.assert_array_equal(site.customer_nominal, site.nominal_volt[site.feeder.bus])
    whole = three_phase(stations.in_phases())
    np.testing.assert_array_equal(whole.nominal_volt, site.nominal_volt)
    phases = from_tables(stations.in_phases())
    np.testing.assert_array_equal(phases.nominal_volt, np.repeat(site.nominal_volt, 3))


def test_three_power_flows_agree(site: Site) -> None:
    net = pandapower_net(site.tables)
    theirs = dict(zip(net.bus.name, net.res_bus.vm_pu * net.bus.vn_kv * 1e3 / 3**0.5, strict=True))
    expected = np.array([theirs[bus] for bus in site.feeder.buses])
    customers, buses = PowerFlow(site).solve(P_KW, Q_KVAR, 1.02 * MV)
    np.testing.assert_allclose(buses / site.nominal_volt, expected / site.nominal_volt, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(customers, buses[site.feeder.bus])
    rows = tuple(replace(row, r0_ohm=2 * row.r_ohm, x0_ohm=3 * row.x_ohm) for row in site.tables.lines)
    whole = three_phase(replace(site.tables, lines=rows))
    _, phases = UnbalancedPowerFlow(whole).solve(P_KW, Q_KVAR, 1.02 * MV)
    per_unit = site.nominal_volt[:, None]
    np.testing.assert_allclose(
        phases / per_unit, np.repeat(buses[:, None], 3, 1) / per_unit, rtol=0, atol=1e-8
    )


def test_the_model_is_that_power_flow(site: Site) -> None:
    _, buses = PowerFlow(site).solve(P_KW, Q_KVAR, 1.02 * MV)
    p, q, v0 = -P_KW / 1000.0, -Q_KVAR / 1000.0, 1.02**2
    settled = volts(site.base_volt, site.balanced.bus_voltages(p, q, v0, steps=40))
    np.testing.assert_allclose(settled / site.nominal_volt, buses / site.nominal_volt, rtol=0, atol=1e-9)
    once, bound = site.balanced.bus_voltages(p, q, v0), site.balanced.model_error_bound(p, q, v0)
    assert (np.abs(once - (buses / site.base_volt) ** 2)[site.feeder.bus] <= bound + 1e-9).all()


def test_sensitivities_are_finite_differences_in_true_volts(site: Site) -> None:
    """``dv/dp = (a V)^2 R / (v S)`` at every pair of customers, through the transformers both ways."""
    flow, count = PowerFlow(site), len(site.tables.customers)
    nothing = np.zeros(count)
    here, _ = flow.solve(nothing, nothing, MV)
    model = site.balanced.linear()
    for matrix, axis in ((model.R, 0), (model.X, 1)):
        for k in range(count):
            step = np.zeros((2, count))
            step[axis, k] = -0.5
            up, _ = flow.solve(*step, MV)
            down, _ = flow.solve(*-step, MV)
            slope = matrix[:, k] * (site.customer_volt / here) * site.customer_volt / 1000.0
            np.testing.assert_allclose(up - down, slope, rtol=0.02, atol=1e-7 * MV)


@pytest.mark.parametrize("tables", [stations.tables(), stations.in_phases()], ids=["balanced", "phases"])
def test_readings_are_in_true_volts_on_both_levels(tables: FeederTables) -> None:
    site = from_tables(tables)
    nominal = site.customer_nominal[site.meters]
    read = nominal * np.linspace(0.96, 1.05, nominal.size)
    v0 = 1.01 * MV * (np.ones(3) if tables.in_phases else 1.0)
    frame = to_frame(site, Snapshot(0.0, read, np.ones(read.size), np.zeros(read.size), v0))
    np.testing.assert_allclose(volts(site.customer_volt[site.meters], frame.y), read, rtol=1e-14)
    assert frame.v0_squared == pytest.approx(1.01**2)
    base = site.customer_volt[site.meters]
    np.testing.assert_allclose(
        site.accuracy.resolution * base, np.where(nominal > 1000, 1.0, 0.1), rtol=1e-12
    )
    np.testing.assert_allclose(site.accuracy.jitter * base, 0.0005 * nominal, rtol=1e-12)


def test_inverters_follow_the_standards_curve_of_their_own_level(site: Site) -> None:
    p_kw = np.array([row.load_kw * 0.1 - row.pv_kw for row in site.tables.customers])
    loop = ClosedLoop(power_flow(site), site.droop, 1000.0, site.customer_volt)
    rest = loop.equilibrium(Loads(p_kw, 0.1 * np.abs(p_kw), 1.04 * MV))
    own = site.droop.customer
    expected = []
    for k, v in zip(own, (rest.v_volt / site.customer_nominal)[own], strict=True):
        curve, row = preset(site.tables.customers[k].droop), site.tables.customers[k]
        expected.append(np.interp(v, curve.v, curve.q) * row.inverter_kva / 1000.0)
    assert np.abs(expected).min() > 1e-3
    np.testing.assert_allclose(rest.x, expected, rtol=0, atol=1e-7)


# --- the format ---------------------------------------------------------------------------------


def test_files_and_json_keep_it(site: Site, tmp_path: Any) -> None:
    write(site.tables, tmp_path / "two")
    assert read(tmp_path / "two") == site.tables
    assert from_json(to_json(site.tables)) == site.tables
    plain = replace(site.tables, lines=site.tables.lines[:3], customers=site.tables.customers[:3])
    assert all("to_volt" not in row for row in to_json(plain)["lines"])  # their digests stay what they were


def changed(**rows: dict[str, object]) -> FeederTables:
    made = stations.tables()
    lines = tuple(replace(row, **rows.get(row.line, {})) for row in made.lines)  # type: ignore[arg-type]
    return replace(made, lines=lines)


def test_all_that_is_wrong_is_told_at_once() -> None:
    wrong = changed(
        T1={"r_ohm": 0.0, "x_ohm": 0.0},
        T2={"from_bus": "s2", "to_bus": "m3", "to_volt": 5.0},
        A1={"r_ohm": 9.0},
        M1={"r_ohm": 9.0},
    )
    wanted = [
        ("(T1), column to_volt", "zero-impedance"),
        ("(T2), column to_volt", "backwards"),
        ("(T2), column to_volt", "doubtful"),
    ]
    found = [(problem.partition(": ")[0], problem.code) for problem in validate(wrong)]
    for place, code in wanted:
        assert any(where.endswith(place) and own == code for where, own in found), (place, found)


def test_a_transformer_given_from_its_far_end_is_refused_although_its_voltage_is_right() -> None:
    """Taken as it stands it would be a line of 20 kV, and the whole street behind it too."""
    wrong = changed(T1={"from_bus": "s1", "to_bus": "m2", "to_volt": MV, "r_ohm": 8.75, "x_ohm": 24.0})
    (problem,) = validate(wrong)
    assert (problem.code, "(T1), column to_volt: 11547" in problem) == ("backwards", True)
    (problem,) = validate(changed(B1={"to_volt": LV}))  # nothing says what is before it
    assert (problem.code, "(B1), column to_volt: 230.94" in problem) == ("backwards", True)
    assert validate(changed(A1={"to_volt": LV}, M2={"to_volt": MV})) == ()


@pytest.mark.parametrize(
    ("rows", "doubt"),
    [
        ({"T1": {"to_volt": 400.0}}, "phase-to-phase voltage; expected phase to neutral, 230.94"),
        ({"T1": {"r_ohm": 8.75, "x_ohm": 24.0}}, "8.75 ohm is very large"),  # of its other side
        ({"A1": {"r_ohm": 5.5, "x_ohm": 4.0}}, "5.5 ohm is very large"),
        ({"T2": {"tap": 48.75}}, "48.75 is not near 1"),
        ({"A2": {"r_ohm": 4.9, "x_ohm": 0.5}, "A1": {"r_ohm": 4.9, "x_ohm": 0.5}}, "the voltage at bus 'a2'"),
    ],
)
def test_doubts_are_those_of_the_own_level(rows: dict[str, dict[str, object]], doubt: str) -> None:
    problems = validate(changed(**rows))
    assert any(problem.code == "doubtful" and doubt in problem for problem in problems)


def test_what_is_usual_on_its_own_level_is_not_doubted() -> None:
    made = changed(M1={"r_ohm": 6.0, "x_ohm": 4.0}, T1={"r_ohm": 0.0002, "x_ohm": 0.0096})
    customers = tuple(replace(row, load_kw=1500.0) if row.bus == "m1" else row for row in made.customers)
    assert validate(replace(made, customers=customers)) == ()
    too_much = tuple(replace(row, load_kw=1500.0) if row.bus == "a1" else row for row in made.customers)
    doubts = validate(replace(made, customers=too_much))
    assert any(problem.code == "doubtful" and ": 1500 " in problem for problem in doubts)


def meshed(**tie: object) -> FeederTables:
    made = stations.tables()
    one = LineRow("T3", "m2", "s2", 0.005, 0.0152, to_volt=LV, tap=0.975)
    return replace(
        made,
        meta=replace(made.meta, meshed=True),
        lines=(*made.lines, replace(one, **tie)),  # type: ignore[arg-type]
    )


def test_a_loop_through_two_transformers() -> None:
    site = from_tables(meshed())
    assert site.ties.shape == (1, 2)
    _, buses = PowerFlow(site).solve(P_KW, Q_KVAR, MV)
    p, q = -P_KW / 1000.0, -Q_KVAR / 1000.0
    frame_volts = _meshed_volts(site, p, q)
    np.testing.assert_allclose(frame_volts / site.nominal_volt, buses / site.nominal_volt, rtol=0, atol=1e-6)
    with pytest.raises(FeederInvalid, match=r"'T3' closes a loop around which the taps multiply to 0\.975"):
        from_tables(meshed(tap=1.0))
    with pytest.raises(FeederInvalid, match=r"to_volt: 230\.94 V at 's2', 220 V around the loop"):
        from_tables(meshed(to_volt=220.0))
    with pytest.raises(FeederInvalid, match=r"at 's2', .* V around the loop"):
        from_tables(meshed(to_volt=None))


def test_a_loop_in_which_a_transformer_leads_back_up() -> None:
    """The tree depends on the order of the lines; what a bus's nominal voltage is does not."""
    made = meshed()
    order = ("M1", "T1", "T2", "A1", "A2", "B1", "B2", "T3", "M3", "M2")
    lines = {row.line: row for row in made.lines}
    through = LineRow("C", "s1", "s2", 0.01, 0.004)
    rows = (*(lines[name] for name in order[:-1]), replace(through, to_bus="a2", from_bus="s2"), lines["M2"])
    tables = replace(made, lines=tuple(replace(row, tap=1.0) for row in rows))
    site = from_tables(tables)
    buses = site.feeder.buses
    assert buses[site.spanning.parent[buses.index("m3") - 1]] == "s2"
    nominal = np.array([NOMINAL[bus] for bus in buses])
    np.testing.assert_array_equal(site.nominal_volt, nominal)
    _, v = PowerFlow(site).solve(P_KW, Q_KVAR, MV)
    np.testing.assert_allclose(
        _meshed_volts(site, -P_KW / 1000.0, -Q_KVAR / 1000.0) / nominal, v / nominal, rtol=0, atol=1e-6
    )


@given(volt=st.floats(60.0, 5000.0))
@settings(max_examples=20, deadline=None)
def test_a_level_of_any_voltage_is_the_same_in_per_unit(volt: float) -> None:
    """Behind a transformer to another voltage, ``z`` grown with its square: nothing in per unit changes."""
    made, ratio = stations.tables(), (volt / LV) ** 2
    low = [row for row in made.lines if row.line not in ("M1", "M2", "M3")]
    other = {
        row.line: {
            "r_ohm": row.r_ohm * ratio,
            "x_ohm": row.x_ohm * ratio,
            "to_volt": None if row.to_volt is None else volt,
        }
        for row in low
    }
    meta = replace(made.meta, accept=("voltage", "impedance"))
    one, two = from_tables(made), from_tables(replace(changed(**other), meta=meta))
    for name in ("r", "x", "charging"):
        np.testing.assert_allclose(getattr(two.balanced, name), getattr(one.balanced, name), rtol=1e-12)
    _, here = PowerFlow(one).solve(P_KW, Q_KVAR, MV)
    _, there = PowerFlow(two).solve(P_KW, Q_KVAR, MV)
    np.testing.assert_allclose(there / two.nominal_volt, here / one.nominal_volt, rtol=0, atol=1e-9)


def _meshed_volts(site: Site, p: Floats, q: Floats) -> Floats:

    return volts(site.base_volt, site.feeder.bus_voltages(p, q, 1.0, steps=40))  # type: ignore[arg-type]
