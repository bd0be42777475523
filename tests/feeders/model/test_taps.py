"""Taps inside a feeder: the model referred to the busbar against AC power flows that have the transformer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from feeders.format.tables import FeederTables, LineRow, from_json, to_json, validate
from feeders.model.site import Site, Snapshot, from_tables, load, to_frame, volts
from feeders.model.three_phase import three_phase
from feeders.simulation.attacks import fake_load
from feeders.simulation.plant import Channel, ClosedLoop, Loads, MeterErrors, SimulatedMeters
from feeders.simulation.powerflow import Grid, PlacesFlow, PowerFlow, UnbalancedPowerFlow, power_flow
from feeders.studies.detectable import detectable
from feeders.studies.protect import Goal, protect
from gridsec.errors import FeederInvalid
from gridsec.grid.devices import preset
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.three_phase import bus_voltages as phase_voltages
from gridsec.grid.three_phase import model_error_bound as phase_error_bound
from tests.codes import codes_of, refused
from tests.feeders import villages

TAPS = {"l2": 0.95, "l4": 1.04, "l5": 1.02}
"""The second is given from the far end, so that it raises the voltage beyond it."""

A = np.array([1.0, 1.0, 1 / 0.95, 1 / 0.95, 1.04, 1.04 / 1.02])
"""By hand: bases of bb, n1, n2, n3, n5, n6 by the nominal voltage."""


def tapped(tables: FeederTables, taps: dict[str, float]) -> FeederTables:
    rows = (replace(line, tap=taps.get(line.line, 1.0)) for line in tables.lines)
    return replace(tables, lines=tuple(rows))


def village() -> Site:
    return from_tables(tapped(villages.tables(), TAPS))


def village_in_phases() -> Site:
    tables = villages.tables()
    lines = tuple(replace(line, r0_ohm=3 * line.r_ohm, x0_ohm=4 * line.x_ohm) for line in tables.lines)
    phases = dict(zip("12345678", "abcabcab", strict=True))
    customers = tuple(replace(row, phases=phases.get(row.customer[1], "abc")) for row in tables.customers)
    customers = (replace(customers[0], phases="abc"), *customers[1:])
    customers = tuple(replace(row, load_kw=row.load_kw / 3) for row in customers)
    return from_tables(tapped(replace(tables, lines=lines, customers=customers), TAPS))


def test_every_bus_has_its_base() -> None:
    site = village()
    assert site.tree.buses == ("bb", "n1", "n2", "n3", "n5", "n6")
    np.testing.assert_allclose(site.base_volt, 230.0 * A, rtol=1e-15)
    np.testing.assert_array_equal(site.customer_volt, site.base_volt[site.feeder.bus])
    np.testing.assert_array_equal(village_in_phases().base_volt, np.repeat(site.base_volt, 3))


def test_without_taps_nothing_changes() -> None:
    plain = from_tables(villages.tables())
    assert (plain.base_volt == 230.0).all()
    z_base = 3.0 * 230.0**2 / (1000.0 * 100.0)
    assert plain.tree.r[0] == 0.030 / z_base  # to the last bit
    np.testing.assert_array_equal(plain.accuracy.resolution, 0.1 / 230.0)


@pytest.mark.parametrize("reverse", [False, True])
def test_one_tap_in_closed_form(reverse: bool) -> None:
    """Two buses, unity power: with E the voltage behind the tap, ``V (E - V) = r P`` per phase, x = 0."""
    ends = [[1, 0]] if reverse else [[0, 1]]
    one = np.array([0.1])
    grid = Grid(np.array(ends), one, 0.0 * one, 0.0 * one, 0, np.array([1]), 2, 230.0, np.array([0.95]))
    _, (_, found) = PowerFlow.of(grid).solve(np.array([9.0]), np.zeros(1), 230.0)
    ohm = 0.1 * (0.95**2 if reverse else 1.0)  # as seen from the customer's side
    behind = 230.0 * 0.95 if reverse else 230.0 / 0.95
    assert found == pytest.approx(0.5 * (behind + np.sqrt(behind**2 - 4 * ohm * 3000.0)), abs=1e-6)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_two_power_flows_and_the_model_agree(seed: int) -> None:
    rng = np.random.default_rng(seed)
    taps = {name: float(rng.uniform(0.9, 1.1)) for name in ("l1", "l2", "l3", "l4", "l5")}
    tables = tapped(villages.tables(), taps)
    lines = tuple(replace(line, r0_ohm=3 * line.r_ohm, x0_ohm=4 * line.x_ohm) for line in tables.lines)
    site, whole = from_tables(tables), three_phase(replace(tables, lines=lines))
    p_kw, q_kvar = rng.uniform(-5.0, 10.0, (2, 8))
    customers, buses = PowerFlow(site).solve(p_kw, q_kvar, 233.0)
    _, phases = UnbalancedPowerFlow(whole).solve(p_kw, q_kvar, 233.0)
    np.testing.assert_allclose(phases, np.repeat(buses[:, None], 3, axis=1), rtol=0, atol=1e-6)
    p, q, v0 = -p_kw / 100.0, -q_kvar / 100.0, (233.0 / 230.0) ** 2
    np.testing.assert_allclose(
        volts(site.base_volt, site.balanced.bus_voltages(p, q, v0, steps=40)), buses, rtol=0, atol=1e-6
    )
    once, bound = site.balanced.bus_voltages(p, q, v0), site.balanced.model_error_bound(p, q, v0)
    assert (np.abs(once - (buses / site.base_volt) ** 2)[site.feeder.bus] <= bound + 1e-9).all()
    np.testing.assert_array_equal(customers, buses[site.feeder.bus])


OWN = {"tap_a": 0.95, "tap_b": 1.0, "tap_c": 1.03}


@pytest.mark.parametrize("own", [{}, OWN], ids=["together", "each"])
def test_three_phases_within_the_bound(own: dict[str, float]) -> None:
    tables = village_in_phases().tables
    changed = {"l2": {"tap": 1.0} | own, "l4": {"tap": 1.0} | own} if own else {}
    lines = tuple(replace(line, **changed.get(line.line, {})) for line in tables.lines)
    site = from_tables(replace(tables, lines=lines))
    if own:
        ratios = 230.0 / site.base_volt.reshape(-1, 3)
        np.testing.assert_allclose(ratios[2], list(own.values()), rtol=1e-14)
        np.testing.assert_allclose(ratios[4], [1 / tap for tap in own.values()], rtol=1e-14)
        assert np.isfinite(site.accuracy.jitter).all()
    assert isinstance(site.feeder, PhasedFeeder)
    flow = power_flow(site)
    assert isinstance(flow, PlacesFlow)
    p_kw = np.array([row.load_kw for row in site.tables.customers])
    _, places = flow.solve(p_kw, 0.3 * p_kw, np.array([229.0, 231.0, 234.0]))
    tree, third = site.feeder.tree, 100.0 / 3.0
    v0 = (np.array([229.0, 231.0, 234.0]) / 230.0) ** 2
    drawn = -p_kw / third, -0.3 * p_kw / third
    exact = (places / site.base_volt) ** 2
    settled = phase_voltages(tree, *drawn, v0, steps=40).T.ravel()
    np.testing.assert_allclose(settled, exact, rtol=0, atol=1e-8)
    once, bound = phase_voltages(tree, *drawn, v0).T.ravel(), phase_error_bound(tree, *drawn, v0)
    assert (np.abs(once - exact)[site.feeder.bus] <= bound + 1e-9).all()


@pytest.mark.parametrize("site", [village(), village_in_phases()], ids=["balanced", "phases"])
def test_readings_are_per_unit_of_their_own_base(site: Site) -> None:
    count = site.meters.size
    read = np.linspace(210.0, 250.0, count)
    v0 = 231.0 if isinstance(site.feeder.buses, tuple) and site.base_volt.size == 6 else np.full(3, 231.0)
    frame = to_frame(site, Snapshot(0.0, read, np.ones(count), np.zeros(count), v0))
    np.testing.assert_allclose(volts(site.customer_volt[site.meters], frame.y), read, rtol=1e-14)
    assert frame.v0_squared == pytest.approx((231.0 / 230.0) ** 2)
    # Meters are as accurate in volts behind a tap as before it: class 0.5, 0.1 V, 0.05 % of nominal.
    accuracy, base = site.accuracy, site.customer_volt[site.meters]
    np.testing.assert_allclose(accuracy.resolution * base, 0.1, rtol=1e-14)
    np.testing.assert_allclose(accuracy.jitter * base, 0.0005 * 230.0, rtol=1e-14)
    np.testing.assert_array_equal(accuracy.class_fraction, 0.005)
    errors = MeterErrors(bias=0.0, power=0.0)
    meters, rows = SimulatedMeters(site, errors, Channel(), 1), len(site.tables.customers)
    true = np.full((4000, rows), 231.04)
    registers = meters.read(
        np.arange(4000), true, 0.0 * true, 0.0 * true, np.full((4000, *np.shape(v0)), 231.0)
    )
    assert np.abs(np.round(registers.v_volt / 0.1) * 0.1 - registers.v_volt).max() < 1e-9
    spread = np.hypot(0.0005 * 230.0, 0.1 / np.sqrt(12.0))
    np.testing.assert_allclose(registers.v_volt.std(axis=0), spread, rtol=0.05)


def test_inverters_follow_the_standards_curve_in_true_volts() -> None:
    site = village()
    p_kw = np.array([1.0, -12.0, -8.0, 2.0, -15.0, 1.0, 2.0, -20.0])
    loop = ClosedLoop(power_flow(site), site.droop, 100.0, site.customer_volt)
    rest = loop.equilibrium(Loads(p_kw, 0.1 * np.abs(p_kw), 238.0))
    rows = [site.tables.customers[k] for k in site.droop.customer]
    expected = []
    for row, v in zip(rows, rest.v_volt[site.droop.customer] / 230.0, strict=True):
        curve = preset(row.droop)
        expected.append(np.interp(v, curve.v, curve.q) * row.inverter_kva / 100.0)
    assert np.abs(expected).min() > 0.01
    np.testing.assert_allclose(rest.x, expected, rtol=0, atol=1e-6)
    # At its breakpoints the curve that the model runs on is the same one.
    for k, row in enumerate(rows):
        true = np.array(preset(row.droop).v) * 230.0 / site.customer_volt[site.droop.customer[k]]
        at = site.droop(1.0 - true[:, None] ** 2, np.full((4, 1), k))[:, 0]
        np.testing.assert_allclose(at, np.array(preset(row.droop).q) * row.inverter_kva / 100.0, atol=1e-12)


@pytest.mark.parametrize("own", [OWN, {"tap_a": 1.03, "tap_b": 1.0, "tap_c": 0.95}])
def test_a_customer_of_three_phases_is_in_the_mean_of_its_phases(own: dict[str, float]) -> None:
    """Curve and accuracy in the volts that its meter reads, whichever phase is the first."""
    tables = villages.tables()
    lines = [replace(line, r0_ohm=3 * line.r_ohm, x0_ohm=4 * line.x_ohm) for line in tables.lines]
    lines = [replace(line, **own) if line.line == "l2" else line for line in lines]  # type: ignore[arg-type]
    site = three_phase(replace(tables, lines=tuple(lines)))
    base = site.customer_volt
    behind = np.array([230.0 / tap for tap in own.values()]).mean()
    assert set(np.round(base / behind, 12)) == {1.0, round(230.0 / behind, 12)}
    np.testing.assert_allclose(site.accuracy.resolution * base[site.meters], 0.1, rtol=1e-14)
    np.testing.assert_allclose(site.accuracy.jitter * base[site.meters], 0.0005 * 230.0, rtol=1e-14)
    for k, customer in enumerate(site.droop.customer):
        curve = preset(site.tables.customers[customer].droop)
        np.testing.assert_allclose(site.droop.v[k] * base[customer], np.array(curve.v) * 230.0, rtol=1e-14)


def test_the_trace_of_a_load_that_is_not_there_is_in_volts() -> None:
    tables = villages.village_without_inverters().tables
    site, customers = from_tables(tapped(tables, TAPS)), len(tables.customers)
    loads = Loads(np.ones(customers), np.full(customers, 0.2), 231.0)
    chosen, fake = fake_load(site, 3, 3, 0.02, loads=loads)
    assert np.abs(fake.shift[chosen]).min() == pytest.approx(0.02, rel=1e-3)
    more = np.zeros(customers)
    more[3] = 1.0
    flow = power_flow(site)
    before, _ = flow.solve(loads.p_kw, loads.q_kvar, 231.0)
    after, _ = flow.solve(loads.p_kw + fake.p_kw * more, loads.q_kvar + fake.q_kvar * more, 231.0)
    np.testing.assert_allclose(230.0 * fake.shift, (after - before)[site.meters], rtol=0.03)


def test_a_tap_at_the_head_is_another_nominal_voltage() -> None:
    """Everything behind 0.96: the same lies in volts as on a feeder whose nominal voltage is V/0.96."""
    plain = villages.village_without_inverters().tables
    plain = replace(plain, customers=tuple(row for row in plain.customers if row.bus != "bb"))
    behind = from_tables(tapped(plain, {"l1": 0.96}))
    meters = replace(plain.meta.meters, jitter_percent=0.96 * plain.meta.meters.jitter_percent)
    meta = replace(
        plain.meta,
        voltage_volt=plain.meta.voltage_volt / 0.96,
        busbar_resolution_volt=plain.meta.busbar_resolution_volt / 0.96,
        meters=meters,
    )
    other = from_tables(replace(plain, meta=meta))
    one, two = detectable(behind, max_attacked=1), detectable(other, max_attacked=1)
    for mine, its in ((one.meters, two.meters), (one.customers, two.customers)):
        for name in mine.columns:
            if mine[name].dtype == np.float64:
                np.testing.assert_allclose(mine[name], its[name], rtol=1e-9, err_msg=name)
    volt = float(one.meters["identified_alone"].median())
    sites = (behind, other)
    mine, its = (protect(site, max_attacked=1, goal=Goal.BOUND, lie_volt=volt) for site in sites)
    assert list(mine.meters["meter"]) == list(its.meters["meter"])
    np.testing.assert_allclose([mine.before, mine.after], [its.before, its.after], rtol=1e-9)


@pytest.mark.parametrize(
    "wrong", [{"tap_a": 0.9}, OWN | {"tap": 1.1}, OWN | {"phases": "a"}, {"tap_b": 1.0, "phases": "a"}]
)
def test_taps_of_single_phases_are_those_of_its_phases(wrong: dict[str, object]) -> None:
    tables = village_in_phases().tables
    tables = tapped(tables, {})
    lines = (replace(tables.lines[0], **wrong), *tables.lines[1:])
    problems = [problem for problem in validate(replace(tables, lines=lines)) if "tap_" in problem]
    assert codes_of(problems) == ["inconsistent"]
    assert "expected" in problems[0]
    right = replace(tables, lines=(replace(tables.lines[0], **OWN), *tables.lines[1:]))
    assert validate(right) == ()
    assert from_json(to_json(right)) == right


def test_where_no_tap_can_be() -> None:
    tables = villages.tables()
    with refused(FeederInvalid, "zero-impedance") as caught:
        from_tables(tapped(tables, {"link": 1.1}))
    assert "line 'link', column tap: 1.1 " in str(caught.value)
    closed = replace(
        tables,
        meta=replace(tables.meta, meshed=True),
        lines=tuple(replace(line, closed=True) for line in tables.lines),
    )
    assert from_tables(closed).ties.size == 2
    with pytest.raises(
        FeederInvalid, match=r"line 'tie' closes a loop around which the taps multiply to 1\.03"
    ):
        from_tables(tapped(closed, TAPS))


def test_a_long_feeder_with_a_regulator() -> None:
    """Kerber Vorstadtnetz with 5 % more in the middle of every street: nothing else of it moves."""
    plain = load("kerber-vorstadtnetz")
    half = plain.tree.parent.size // 2
    tables = plain.tables
    line = next(row for row in tables.lines if row.closed and plain.bus_of_file[row.to_bus] == half)
    assert isinstance(line, LineRow)
    site = from_tables(tapped(tables, {line.line: 0.95}))
    behind = site.base_volt > 240.0
    assert 0 < behind.sum() < behind.size
    p_kw = np.zeros(site.feeder.bus.size)
    for one, factor in ((plain, 1.0), (site, 1.0 / 0.95)):
        _, buses = power_flow(one).solve(p_kw, p_kw, one.feeder.base_volt)
        np.testing.assert_allclose(buses[behind] / one.feeder.base_volt, factor, rtol=1e-5)
        np.testing.assert_allclose(buses[~behind] / one.feeder.base_volt, 1.0, rtol=1e-5)
