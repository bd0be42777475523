"""Droop fleets behind taps and on closed loops, against feeders without and AC simulation in volts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from feeders.format.tables import FeederTables, LineRow
from feeders.model.site import Site, from_tables
from feeders.simulation.plant import ClosedLoop, Loads
from feeders.simulation.powerflow import PowerFlow, PowerFlowDiverged, power_flow
from feeders.studies.droop.fleets import Equipped, box, equip, made, point
from feeders.studies.droop.limits import (
    BandGuarantee,
    Conditions,
    DroopPlan,
    capacity,
    ratings_pu,
    safety,
    shares_of,
)
from feeders.studies.droop.study import DroopOptions, droop, presets_of
from feeders.studies.droop.verdict import (
    FleetOutcome,
    FleetVerdict,
    Subject,
    judge,
    simulate,
    step_rows,
    trajectories,
)
from feeders.studies.operating import Bases
from gridsec.arrays import Floats
from gridsec.grid.devices import Droop
from gridsec.grid.devices import fleet as fleet_of
from gridsec.planning.droop.ac_sensitivity import currents, region, solve
from gridsec.planning.droop.stability import Update
from tests.codes import refused
from tests.feeders.studies.droop.test_droop import near_the_edge, random_site, run_together
from tests.feeders.villages import tables as village_tables

KINDS = ["taps", "taps in phases", "taps and loops", "loops in phases"]


def changed(site: Site, kind: str, rng: np.random.Generator) -> Site:
    """The street with taps anywhere, from either end, or closed loops, or a tap at the head of loops."""
    tables, count = site.tables, len(site.tables.lines)
    lines = list(tables.lines)
    if "loops" in kind:
        for k in range(2):
            one, other = rng.choice(count, 2, replace=False)
            r, x = rng.uniform(0.01, 0.08, 2)
            zero = {"r0_ohm": 3 * r, "x0_ohm": 3 * x} if "phases" in kind else {}
            lines.append(LineRow(f"tie{k}", f"n{one}", f"n{other}", r, x, b_us=10.0, **zero))
        if "taps" in kind:
            lines[0] = replace(lines[0], tap=float(rng.uniform(0.93, 1.07)))
        meta = replace(tables.meta, meshed=True)
        return from_tables(replace(tables, meta=meta, lines=tuple(lines)))
    for k, line in enumerate(lines):
        taps = rng.uniform(0.93, 1.07, 3)
        if "phases" in kind and rng.random() < 0.5:
            own = dict(zip(("tap_a", "tap_b", "tap_c"), map(float, taps), strict=True))
            lines[k] = replace(line, **own)
        else:
            lines[k] = replace(line, tap=float(taps[0]))
        if rng.random() < 0.3:
            lines[k] = replace(lines[k], from_bus=line.to_bus, to_bus=line.from_bus)
    return from_tables(replace(tables, lines=tuple(lines)))


def volts_by_hand(tables: FeederTables) -> Floats:
    """Voltage of every customer's phase if nothing flowed anywhere, by the tables alone."""
    v = {"bb": np.full(3, 230.0)}
    for _ in tables.lines:
        for line in tables.lines:
            taps = np.array([getattr(line, f"tap_{f}") or line.tap for f in "abc"])
            if line.from_bus in v:
                v.setdefault(line.to_bus, v[line.from_bus] / taps)
            elif line.to_bus in v:
                v[line.from_bus] = v[line.to_bus] * taps
    return np.array([v[row.bus]["abc".index(row.phases[0])] for row in tables.customers])


@pytest.mark.canary("taps in phases")
@pytest.mark.parametrize("kind", KINDS)
def test_the_verdict_is_that_of_the_simulation_in_volts(kind: str) -> None:
    told: dict[tuple[FleetVerdict, bool], int] = {}
    for seed in range(2):
        rng = np.random.default_rng([seed, 1])
        site = changed(random_site(seed, phased="phases" in kind), kind, rng)
        volt = volts_by_hand(site.tables)
        assert bool(np.ptp(volt) > 1.0) is (kind in KINDS[:2])
        subject = Subject.of(site)
        updates = [
            Update(float(rng.choice([0.5, 1.0, 3.0, 60.0])), int(rng.choice([0, 2]))) for _ in range(15)
        ]
        loads = [
            point(site, rng.uniform(0, 1), rng.uniform(0, 1), float(rng.uniform(0.98, 1.02))) for _ in updates
        ]
        fleets = [near_the_edge(site, rng, at, u) for at, u in zip(loads, updates, strict=True)]
        moves = run_together(site, fleets, updates, loads, seed, volt=volt)
        for fleet, update, at, moved in zip(fleets, updates, loads, moves, strict=True):
            verdict, moves_on = judge(subject, fleet, update, at, seed=seed).verdict, moved > 1e-5
            if verdict is FleetVerdict.STABLE and moves_on:  # it may be slow
                alone = run_together(site, [fleet], [update], [at], seed, volt=volt, steps=8000)
                moves_on = alone[0] > 1e-5
            key = verdict, bool(moves_on)
            told[key] = told.get(key, 0) + 1
    assert sum(told.values()) == 30
    assert told.get((FleetVerdict.STABLE, True), 0) == told.get((FleetVerdict.UNSTABLE, False), 0) == 0
    assert min(told[FleetVerdict.STABLE, False], told[FleetVerdict.UNSTABLE, True]) >= 5


@pytest.mark.canary("taps in phases")
@pytest.mark.parametrize("kind", KINDS)
def test_curves_and_limits_are_those_of_the_nominal_voltage(kind: str) -> None:
    """Whether a band is kept, and what is hosted, by a fleet whose curves are simulated in volts."""
    verdicts = set()
    for seed in range(2):
        rng = np.random.default_rng([seed, 2])
        site = changed(random_site(seed, phased="phases" in kind), kind, rng)
        subject, loads = Subject.of(site), box(site, load_high=0.5, pv_high=0.3)
        own = np.arange(len(site.feeder.customers))
        loop = ClosedLoop(subject.flow, fleet_of(own, "vde4105", np.full(own.size, 5.0), 100.0), 100.0, 230.0)
        fleet = made(site, own, "vde4105", np.full(own.size, 5.0))
        volts = [rest_volts(loop, loads, u) for u in (np.zeros(own.size), np.ones(own.size))]
        volts += [rest_volts(loop, loads, rng.uniform(0.0, 1.0, own.size)) for _ in range(10)]
        low, high = min(v.min() for v in volts), max(v.max() for v in volts)
        for limits in ((0.9, 1.1), (0.93 * low / 230.0, 1.07 * high / 230.0), (0.98, high / 230.0 - 0.001)):
            found = safety(subject, fleet, loads, limits)
            verdicts.add(found.rest)
            assert found.low_rest_volt <= low + 1e-4
            assert found.high_rest_volt >= high - 1e-4
            if low < 230.0 * limits[0] or high > 230.0 * limits[1]:
                assert found.rest is not BandGuarantee.KEPT
            if found.rest is BandGuarantee.VIOLATED:
                v = np.array([row["v_volt"] for row in found.witness])
                assert v.min() < 230.0 * limits[0] or v.max() > 230.0 * limits[1]
                assert [row["beyond"] for row in found.witness] == [
                    bool(each < 230.0 * limits[0] or each > 230.0 * limits[1]) for each in v
                ]
        hosted(site, subject, rng)
    assert {BandGuarantee.KEPT, BandGuarantee.VIOLATED} <= verdicts


def rest_volts(loop: ClosedLoop, loads: object, u: Floats) -> Floats:
    p = loads.p_low + u * (loads.p_high - loads.p_low)  # type: ignore[attr-defined]
    q = loads.q_low + u * (loads.q_high - loads.q_low)  # type: ignore[attr-defined]
    return loop.equilibrium(Loads(-100.0 * p, -100.0 * q, 230.0)).v_volt


def hosted(site: Site, subject: Subject, rng: np.random.Generator) -> None:
    """A little less than the capacity is within the band by simulation, a little more is not."""
    plan = DroopPlan(shares_of(site, None), "ieee1547-b")
    at = Conditions(0.1, 1.0, 0.8, float(rng.uniform(1.08, 1.2)), Update())
    found = capacity(subject, plan, at)
    if found["limit"] != "voltage high":
        assert found["limit"]
        return
    assert found["confirmed_volt"] < 1e-5
    own, drawn = np.flatnonzero(plan.share), point(site, 0.1, 0.0)
    for times, inside in ((0.998, True), (1.004, False)):
        pv = times * found["capacity_kw"] * plan.share
        loop = ClosedLoop(subject.flow, fleet_of(own, "ieee1547-b", 1.1 * pv[own], 100.0), 100.0, 230.0)
        v = loop.equilibrium(Loads(-100.0 * drawn.p_low - pv, -100.0 * drawn.q_low, 230.0)).v_volt
        assert bool(v.max() <= 230.0 * at.v_max) is inside


OPTIONS = DroopOptions(
    v0_low=0.98,
    v0_high=1.03,
    presets=("vde4105",),
    tau_factors=(),
    hosting=True,
    hosting_presets=("ieee1547-b",),
    draws=1,
)
SAME = ["stability", "inverters", "band", "customers", "presets", "hosting", "hosting_curve", "hosting_draws"]


def headed(tap: float) -> FeederTables:
    """The village's right half behind a tap in its first line, rated; nobody at the busbar."""
    tables = village_tables()
    lines = (
        LineRow("l1", "bb", "n1", 0.03, 0.012, b_us=5.0, rating_a=150.0, tap=tap),
        LineRow("l4", "n5", "n1", 0.06, 0.02, rating_a=60.0),
        LineRow("l5", "n5", "n6", 0.045, 0.018, b_us=2.0),
    )
    customers = tuple(row for row in tables.customers if row.bus in {"n1", "n5", "n6"})
    return replace(tables, lines=lines, customers=customers)


def in_phases(tables: FeederTables) -> FeederTables:
    lines = tuple(replace(line, r0_ohm=3 * line.r_ohm, x0_ohm=4 * line.x_ohm) for line in tables.lines)
    customers = (
        replace(
            row,
            phases=phases,
            load_kw=row.load_kw / 3,
            pv_kw=row.pv_kw / 3,
            inverter_kva=row.inverter_kva / 3,
        )
        for row, phases in zip(tables.customers, ("abc", "b", "c", "a"), strict=True)
    )
    return replace(tables, lines=lines, customers=tuple(customers))


def stepped(tables: FeederTables) -> FeederTables:
    """The first line is a transformer from 6.35 kV; the nominal voltage behind it is that of before."""
    lines = (replace(tables.lines[0], to_volt=tables.meta.voltage_volt), *tables.lines[1:])
    return replace(tables, meta=replace(tables.meta, voltage_volt=6350.0), lines=lines)


@pytest.mark.canary("stepped")
@pytest.mark.parametrize("change", [lambda tables: tables, in_phases, stepped])
def test_a_tap_at_the_head_is_another_voltage_of_the_busbar(
    change: Callable[[FeederTables], FeederTables],
) -> None:
    tapped = change(headed(0.96))
    plain = headed(1.0) if change is stepped else change(headed(1.0))
    raised = replace(OPTIONS, v0_low=OPTIONS.v0_low / 0.96, v0_high=OPTIONS.v0_high / 0.96)
    one, other = droop(from_tables(tapped), OPTIONS), droop(from_tables(plain), raised)
    assert (one.verdict, one.rest, one.always) == (other.verdict, other.rest, other.always)
    for name in SAME:
        pd.testing.assert_frame_equal(one.tables[name], other.tables[name], rtol=2e-6, atol=1e-6)
    columns = ["customer", "p_kw", "q_kvar", "inverter_kvar", "v_volt", "beyond"]
    pd.testing.assert_frame_equal(one.tables["witness"][columns], other.tables["witness"][columns], rtol=1e-6)
    steps = (each.tables["steps"].query("step != 'tap'") for each in (one, other))
    pd.testing.assert_frame_equal(*steps, rtol=1e-6)


def test_volts_of_a_simulation_are_those_of_the_power_flow() -> None:
    tables = headed(0.9)
    lines = tuple(replace(line, tap=1.08) if line.line == "l5" else line for line in tables.lines)
    site = from_tables(replace(tables, lines=lines))
    fleet, loads = equip(site, "vde4105"), point(site, 0.4, 0.9, 1.01)
    run = simulate((site, power_flow(site)), fleet, Update(), loads, np.zeros(fleet.tau.size))
    assert run.outcome is FleetOutcome.SETTLES
    curves = fleet_of(fleet.customer, "vde4105", np.array([22.0, 30.0]), 100.0)
    loop = ClosedLoop(PowerFlow(site), curves, 100.0, 230.0)
    still = loop.equilibrium(Loads(-100.0 * loads.p_low, -100.0 * loads.q_low, 1.01 * 230.0)).v_volt
    first = loop.point(Loads(-100.0 * loads.p_low, -100.0 * loads.q_low, 1.01 * 230.0), run.x[0]).v_volt
    seen = trajectories(site, {"here": run}).pivot_table("v_volt", "t_s", "customer")
    np.testing.assert_allclose(seen.iloc[-1], still, atol=2e-3)
    row = step_rows(site, {"here": run})[0]
    assert row["change_volt"] == pytest.approx(np.abs(still - first).max(), abs=2e-3)
    assert [row["end_low_volt"], row["end_high_volt"]] == pytest.approx([still.min(), still.max()], abs=2e-3)
    assert row["worst_customer"] == site.feeder.customers[int(np.argmax(np.abs(still - 230.0)))]


@pytest.mark.acceptance
def test_two_lines_in_parallel_are_one_of_half_the_impedance() -> None:
    """Every line closes a loop with its twin, behind a tap; each carries half, and may."""
    tables = village_tables()
    lines = [replace(row, rating_a=100.0, tap=0.97 if row.line == "l1" else 1.0) for row in tables.lines[:-1]]
    again = [replace(row, line=f"{row.line} again") for row in lines]
    one = [
        replace(row, r_ohm=0.5 * row.r_ohm, x_ohm=0.5 * row.x_ohm, b_us=2.0 * row.b_us, rating_a=200.0)
        for row in lines
    ]
    meta = replace(tables.meta, meshed=True)
    twice = from_tables(replace(tables, meta=meta, lines=(*lines, *again)))
    once = from_tables(replace(tables, lines=tuple(one)))
    assert len(twice.ties) == 5
    options = replace(OPTIONS, draws=0)
    found, other = droop(twice, options), droop(once, options)
    assert (found.verdict, found.rest, found.always) == (other.verdict, other.rest, other.always)
    for name in (*SAME[:-1], "steps"):
        pd.testing.assert_frame_equal(found.tables[name], other.tables[name], rtol=1e-5, atol=1e-5)
    assert presets_of([twice], options)["verdict"].tolist() == ["stable"]


def test_currents_of_a_loop_are_those_of_the_power_flow() -> None:
    """And ratings in amperes: what flows over a line is what its ends differ by, over its impedance."""
    tables = village_tables()
    rated = (replace(row, rating_a=100.0, tap=0.95 if row.line == "l1" else 1.0) for row in tables.lines[:-1])
    lines = (*rated, LineRow("tie", "n6", "n3", 0.02, 0.01, b_us=400.0, rating_a=30.0))
    site = from_tables(replace(tables, meta=replace(tables.meta, meshed=True), lines=lines))
    net, count = Subject.of(site).net, len(site.feeder.customers)
    p, q = np.random.default_rng(0).uniform(-0.1, 0.1, (2, count))
    amps = np.array(
        [30.0 if row.line == "tie" else 100.0 for row in [*site.tables.lines[:2], *site.tables.lines[3:]]]
    )
    found = currents(site.feeder, net, p + 1j * q, solve(net, p + 1j * q, 1.0), 1.0) / ratings_pu(site)
    flow = PowerFlow(site)
    V, grid = flow.phasors(-100.0 * p, -100.0 * q, 230.0), flow.grid
    above, behind = V[grid.ends[:, 0]] / grid.tap, V[grid.ends[:, 1]]
    series, half = (above - behind) / (grid.r_ohm + 1j * grid.x_ohm), 0.5j * grid.b_siemens
    percent = np.maximum(np.abs(series + half * above), np.abs(series - half * behind)) / amps
    np.testing.assert_allclose(np.sort(found[:, 0]), np.sort(percent), rtol=1e-6)
    # The fullest one is told by its name.
    names = [row.line for row in site.tables.lines if row.line != "link"]
    own = DroopPlan(shares_of(site, ["c8"]), "")
    limit = capacity(Subject.of(site), own, Conditions(0.0, 1.0, 0.5, 2.0, Update()))["limit"]
    assert limit == "line from n6 to n3"
    assert names[-1] == "tie"


def test_a_loop_whose_sensitivities_are_negative_is_bounded() -> None:
    """The bridge of docs/theory-mesh.md: a load at one end raises the voltage at the other."""
    tables = village_tables()
    lines = (
        LineRow("one", "bb", "n1", 0.001, 0.05),
        LineRow("two", "bb", "n2", 0.001, 0.05),
        LineRow("bridge", "n1", "n2", 0.05, 0.001),
    )
    customers = tuple(row for row in tables.customers if row.bus in {"n1", "n2"})
    meta = replace(tables.meta, meshed=True, accept=("ratio",))
    site = from_tables(replace(tables, meta=meta, lines=lines, customers=customers))
    subject, loads = Subject.of(site), box(site)
    found, rng = region(subject.net, loads), np.random.default_rng(0)
    assert (site.feeder.R < 0.0).any() or (site.feeder.X < 0.0).any()  # type: ignore[union-attr]
    fleet = equip(site, "ieee1547-b", Equipped.ALL)
    kept = safety(subject, fleet, loads, (0.5, 1.5))
    loop = ClosedLoop(subject.flow, fleet, 100.0, 230.0)
    for _ in range(30):
        u = (rng.uniform(0.0, 1.0, loads.p_low.size) > 0.5).astype(np.float64)
        p = loads.p_low + u * (loads.p_high - loads.p_low)
        q = loads.q_low + u * (loads.q_high - loads.q_low)
        v, _ = subject.flow.solve(-100.0 * p, -100.0 * q, 230.0)
        assert np.all(v >= 230.0 * found.low - 1e-6)
        assert np.all(v <= 230.0 * found.high + 1e-6)
        settled = rest_volts(loop, loads, u)
        assert kept.low_rest_volt - 1e-4 <= settled.min()
        assert settled.max() <= kept.high_rest_volt + 1e-4
    with refused(PowerFlowDiverged, "not-converged"):
        subject.flow.solve(np.full(p.size, 1e5), q, 230.0)


def test_extremes_are_relative_to_the_nominal_voltage() -> None:
    bases = Bases(np.array([12000.0, 230.0, 220.0]), np.array([11000.0, 230.0, 230.0]))
    assert bases.extremes(np.array([1.0, 1.05, 1.0])) == pytest.approx((220.0, 12000.0))
    low, high = bases.band(0.9, 1.1)
    np.testing.assert_allclose(low * bases.volt, [9900.0, 207.0, 207.0])
    np.testing.assert_allclose(high * bases.volt, [12100.0, 253.0, 253.0])


def test_a_preset_behind_a_tap_is_one_in_volts() -> None:
    site = from_tables(headed(0.9))
    fleet: Droop = equip(site, "vde4105")
    np.testing.assert_allclose(
        fleet.v * site.customer_volt[fleet.customer, None],
        230.0 * fleet_of(fleet.customer, "vde4105", np.ones(2), 100.0).v,
    )
