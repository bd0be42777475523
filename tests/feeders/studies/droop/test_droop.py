"""The study of droop fleets, against AC simulation that is written here and against brute force."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from feeders.format.tables import CustomerRow, FeederMeta, FeederTables, LineRow
from feeders.model.site import Site, from_tables
from feeders.simulation.plant import ClosedLoop, Loads
from feeders.simulation.powerflow import PowerFlow, PowerFlowDiverged, power_flow
from feeders.studies.droop.fleets import Equipped, box, equip, point
from feeders.studies.droop.limits import (
    BandGuarantee,
    Conditions,
    DroopPlan,
    capacity,
    draw,
    safety,
    shares_of,
)
from feeders.studies.droop.study import DroopOptions, droop, presets_of
from feeders.studies.droop.verdict import (
    FleetOutcome,
    FleetVerdict,
    Subject,
    edge,
    inverter_rows,
    judge,
    longest_interval,
    margin,
    simulate,
    step_rows,
    steps,
    trajectories,
)
from feeders.studies.running import OtherStudy
from gridsec.arrays import Floats
from gridsec.errors import FeederInvalid, InputInvalid
from gridsec.grid.devices import Droop
from gridsec.grid.devices import fleet as fleet_of
from gridsec.planning.droop.ac_sensitivity import InjectionBox, sensitivity, solve
from gridsec.planning.droop.equilibrium import rest
from gridsec.planning.droop.stability import Update, enlarged, growth, slopes
from tests.codes import refused
from tests.feeders.villages import village, village_without_inverters
from tests.journals import edit, rows

FEEDERS, FLEETS = 10, 20
"""The random fleets around the edge of stability: 200, and half as many in three phases."""

STEPS = 260


def random_site(seed: int, *, phased: bool = False) -> Site:
    """A village street with forks: cable or overhead line, three to six customers; on any phases if asked."""
    rng = np.random.default_rng([seed, 7])
    count = int(rng.integers(3, 7))
    ratio = rng.uniform(0.3, 1.2)
    lines = []
    for k in range(count):
        above = "bb" if k == 0 else f"n{rng.integers(max(0, k - 2), k)}"
        r = rng.uniform(0.01, 0.08)
        lines.append(LineRow(f"l{k}", above, f"n{k}", r, ratio * r, b_us=10.0))
    customers = tuple(
        CustomerRow(f"c{k}", f"n{k}", load_kw=float(rng.uniform(2, 10)), pv_kw=float(rng.uniform(0, 12)))
        for k in range(count)
    )
    meta = FeederMeta(format=1, name=f"street-{seed}", voltage_volt=230.0, busbar="bb", base_kva=100.0)
    if phased:
        r0, x0 = rng.uniform(1.0, 4.0, 2)
        lines = [replace(row, r0_ohm=r0 * row.r_ohm, x0_ohm=x0 * row.x_ohm) for row in lines]
        customers = tuple(replace(row, phases=str(rng.choice(list("abc")))) for row in customers)
    return from_tables(FeederTables(meta, tuple(lines), customers))


def near_the_edge(site: Site, rng: np.random.Generator, loads: InjectionBox, update: Update) -> Droop:
    """A random fleet whose slopes, all at their steepest, are 0.5 to 2 times what makes it unstable."""
    count = len(site.feeder.customers)
    own = np.sort(rng.choice(count, int(rng.integers(1, count + 1)), replace=False))
    share = rng.uniform(0.5, 1.5, own.size)[:, None] * np.array([1.0, 0.0, 0.0, -1.0])
    tau = rng.uniform(1.0, 4.0) * rng.choice([1.0, 3.0]) ** rng.uniform(-1.0, 1.0, own.size)
    # Slow inverters may be steep; limits move voltages by one or a few percent.
    half = rng.uniform(0.005, 0.02) * float(np.mean(update.share(tau)))
    dead = rng.choice([0.0, 0.0, 0.3]) * half
    v = 1.0 + np.outer(np.ones(own.size), [-half - dead, -dead, dead, half + dead])
    net = Subject.of(site).net
    s = loads.p_low + 1j * loads.q_low
    J = sensitivity(net, s, solve(net, s, loads.v0_low)).dv_dq[np.ix_(own, own)]
    steep = slopes(Droop(own, v, share, tau), np.zeros(own.size), np.full(own.size, 9.0))
    low, high = 1e-6, 1e3
    for _ in range(24):
        size = np.sqrt(low * high)
        low, high = (size, high) if growth(J, size * steep, tau, update) < 1.0 else (low, size)
    return Droop(own, v, low * 2.0 ** rng.uniform(-1.0, 1.0) * share, tau)


def run_together(
    site: Site,
    fleets: list[Droop],
    updates: list[Update],
    loads: list[InjectionBox],
    seed: int,
    *,
    volt: Floats | float = 230.0,
    steps: int = STEPS,
) -> Floats:
    """Movement of every fleet that does not die out, part of its limit; from a random state, by AC.

    The fleets' curves are in parts of `volt`.
    """
    rng, base = np.random.default_rng(seed), site.feeder
    flow, count = power_flow(site), len(base.customers)
    p = np.array([-base.base_kva * b.p_low for b in loads])
    drawn = np.array([-base.base_kva * b.q_low for b in loads])
    v0 = np.array([base.base_volt * b.v0_low for b in loads])
    # Curves of customers without an inverter ask for nothing.
    low, high, start, ramp, alpha = (np.zeros((len(fleets), count, *k)) for k in ((3,), (3,), (), (3,), ()))
    for k, (d, u) in enumerate(zip(fleets, updates, strict=True)):
        low[k, d.customer], high[k, d.customer] = d.v[:, :-1], d.v[:, 1:]
        width = np.maximum(np.diff(d.v, axis=1), 1e-12)
        start[k, d.customer], ramp[k, d.customer] = d.q[:, 0], np.diff(d.q, axis=1) / width
        alpha[k, d.customer] = 1.0 - np.exp(-u.interval_s / d.tau)
    limit = np.abs(start) + 1e-300
    x = rng.uniform(-1.0, 1.0, start.shape) * start
    asked, dead = [x] * 3, np.array([u.dead for u in updates])
    collapsed = np.zeros(len(fleets), dtype=bool)
    last: list[Floats] = []
    for _ in range(steps):
        q = np.where(collapsed[:, None], 0.0, drawn - base.base_kva * x)
        try:
            v = flow.solve_batch(p, q, v0)[0] / volt
        except PowerFlowDiverged as error:
            collapsed[int(str(error).split("set ")[1].rstrip(")"))] = True
            continue
        asks = start + ((np.clip(v[..., None], low, high) - low) * ramp).sum(axis=-1)
        asked = [*asked[-2:], asks]
        due = np.array(asked)[2 - dead, np.arange(len(fleets))]
        x = (1.0 - alpha) * x + alpha * due
        last = [*last[-119:], x]
    before, moved = (
        np.max(np.ptp(np.array(part), axis=0) / limit, axis=1) for part in (last[:60], last[60:])
    )
    # What has become much smaller meanwhile is a slow filter on its way, and no oscillation.
    return np.where(collapsed, np.inf, np.where(moved < 0.5 * before, 0.0, moved))


@pytest.mark.canary("2-True")
@pytest.mark.no_cover  # a long run of what other tests cover
@pytest.mark.parametrize(("feeders", "phased"), [(2, True), (FEEDERS, False), (FEEDERS // 2, True)])
def test_the_verdict_is_that_of_the_simulation_in_200_fleets_around_the_edge(
    feeders: int, phased: bool
) -> None:
    told: dict[tuple[FleetVerdict, bool], int] = {}
    for seed in range(feeders):
        site, rng = random_site(seed, phased=phased), np.random.default_rng(seed)
        subject = Subject.of(site)
        updates = [
            Update(float(rng.choice([0.5, 1.0, 3.0, 60.0])), int(rng.choice([0, 0, 1, 2])))
            for _ in range(FLEETS)
        ]
        loads = [
            point(site, rng.uniform(0, 1), rng.uniform(0, 1), float(rng.uniform(0.98, 1.02)))
            for _ in range(FLEETS)
        ]
        fleets = [near_the_edge(site, rng, b, u) for b, u in zip(loads, updates, strict=True)]
        moves = run_together(site, fleets, updates, loads, seed)
        for fleet, update, at, moved in zip(fleets, updates, loads, moves, strict=True):
            found = judge(subject, fleet, update, at, seed=seed)
            key = (found.verdict, bool(moved > 1e-5))
            told[key] = told.get(key, 0) + 1
    assert sum(told.values()) == feeders * FLEETS
    assert told.get((FleetVerdict.STABLE, True), 0) == 0
    assert told.get((FleetVerdict.UNSTABLE, False), 0) == 0
    assert told[FleetVerdict.STABLE, False] >= 5 * feeders
    assert told[FleetVerdict.UNSTABLE, True] >= 5 * feeders


# --- the parts --------------------------------------------------------------------------------------------


def unsettled(interval: float = 60.0) -> tuple[Site, Droop, Update]:
    """The village with inverters so large that they over-correct when they jump to their set-points."""
    site = village()
    return site, enlarged(equip(site, "ieee1547-b", Equipped.ALL), 12.0), Update(interval)


def test_an_unstable_fleet_is_told_and_seen_to_oscillate() -> None:
    site, fleet, update = unsettled()
    subject, at = Subject.of(site), point(site, 0.0, 0.4, 1.04)
    found = judge(subject, fleet, update, at)
    assert found.verdict is FleetVerdict.UNSTABLE
    assert found.growth > 1.0
    assert found.outcome == "oscillates"
    slow = judge(subject, fleet, Update(0.0), at)
    assert slow.growth < 1.0
    assert slow.verdict is not FleetVerdict.UNSTABLE


def test_collapse_is_an_outcome_and_not_an_error() -> None:
    site, fleet, update = unsettled()
    drawn = point(site, 300.0, 0.0)
    run = simulate((site, PowerFlow(site)), fleet, update, drawn, np.zeros(fleet.tau.size))
    assert run.outcome is FleetOutcome.COLLAPSES
    assert step_rows(site, {"load": run})[0]["outcome"] == "collapses"
    found = judge(Subject.of(site), fleet, update, drawn)
    assert found.verdict is FleetVerdict.UNDECIDED
    assert "no equilibrium" in found.why


def test_edges_and_margins_of_one_customer_are_those_of_the_formula() -> None:
    """One inverter that jumps to its set-point is stable up to a loop gain of 1."""
    meta = FeederMeta(format=1, name="one", voltage_volt=230.0, busbar="bb", base_kva=100.0)
    row = CustomerRow("c", "n", load_kw=2.0, inverter_kva=10.0, droop="ieee1547-b")
    site = from_tables(FeederTables(meta, (LineRow("l", "bb", "n", 0.2, 0.16),), (row,)))
    subject, update, at = Subject.of(site), Update(100.0), point(site, 0.0, 0.0, 1.05)
    sure, over = edge(subject, site.droop, update, at, enlarged)
    flow = subject.flow
    v = [flow.solve(np.zeros(1), np.array([q]), 1.05 * 230.0)[0][0] / 230.0 for q in (0.05, -0.05)]
    gain = (v[1] - v[0]) / (0.1 / 100.0) * slopes(site.droop, np.array([1.04]), np.array([1.06]))[0]
    assert sure <= over
    assert 0.8 / gain < sure
    assert over < 1.3 / gain
    first = judge(subject, site.droop, update, at)
    assert first.verdict is FleetVerdict.STABLE
    assert first.gain == pytest.approx(gain, rel=0.1)
    assert margin(subject, site.droop, update, at) == pytest.approx(1.0 / gain, rel=0.2)
    assert longest_interval(subject, site.droop, update, at) == np.inf
    rows = inverter_rows(subject, site.droop, update, at, "here")
    assert [(r["customer"], r["part"]) for r in rows] == [("c", 1.0)]
    assert rows[0]["alone"] == pytest.approx(1.0 / gain, rel=0.2)


def test_steps_end_where_the_inverters_of_the_simulator_rest() -> None:
    site = village()
    subject, fleet = Subject.of(site), equip(site, "vde4105", Equipped.ALL)
    step = steps(site, 1.06)["tap"]
    x, _ = rest(subject.net, fleet, step.before.p_low + 1j * step.before.q_low, 1.06)
    base = site.feeder.base_kva
    loads = Loads(-base * step.after.p_low, -base * step.after.q_low, 230.0 * step.after.v0_low)
    still = ClosedLoop(subject.flow, fleet, base, 230.0).equilibrium(loads)
    for update in (Update(1.0), Update(1.0, 2), Update(0.0)):
        run = simulate((site, subject.flow), fleet, update, step.after, x, updates=2000)
        assert run.outcome is FleetOutcome.SETTLES
        np.testing.assert_allclose(230.0 * run.v[-1], still.v_volt, atol=2e-3)
        told = step_rows(site, {"tap": run})[0]
        # A first-order response is within 2 % after ln 50 time constants, sooner with feedback.
        assert 0.0 < told["settling_s"] <= 3.92 * 10.0 / 3.0 + 3.0
        assert told["overshoot_percent"] < 5.0
        assert set(trajectories(site, {"tap": run})) == {"step", "t_s", "customer", "v_volt"}


@pytest.mark.parametrize("limits", [(0.9, 1.1), (0.95, 1.05), (0.99, 1.01)])
def test_the_band_is_kept_in_all_random_profiles_or_broken_by_the_witness(
    limits: tuple[float, float],
) -> None:
    site = village()
    subject, fleet, loads = Subject.of(site), site.droop, box(site, v0_low=0.99, v0_high=1.02)
    found = safety(subject, fleet, loads, limits)
    rng, base = np.random.default_rng(0), site.feeder
    loop = ClosedLoop(subject.flow, fleet, base.base_kva, base.base_volt)
    lowest, highest = np.inf, -np.inf
    for k in range(40):
        u = np.clip(rng.uniform(-0.5, 1.5, (3, loads.p_low.size)), 0.0, 1.0)
        u = np.full_like(u, k % 2) if k < 2 else u
        p = loads.p_low + u[0] * (loads.p_high - loads.p_low)
        q = loads.q_low + u[1] * (loads.q_high - loads.q_low)
        v0 = 230.0 * (loads.v0_low + u[2, 0] * (loads.v0_high - loads.v0_low))
        v = loop.equilibrium(Loads(-base.base_kva * p, -base.base_kva * q, float(v0))).v_volt
        lowest, highest = min(lowest, v.min()), max(highest, v.max())
    assert found.low_volt <= found.low_rest_volt <= lowest + 1e-4
    assert found.high_volt >= found.high_rest_volt >= highest - 1e-4
    broken = lowest < 230.0 * limits[0] or highest > 230.0 * limits[1]
    assert found.rest is (BandGuarantee.VIOLATED if broken else BandGuarantee.KEPT)
    if found.rest is BandGuarantee.VIOLATED:
        row = {r["customer"]: r for r in found.witness}
        names = list(base.customers)
        p, q = (np.array([row[n][key] for n in names]) for key in ("p_kw", "q_kvar"))
        v = loop.equilibrium(Loads(p, q, found.witness[0]["busbar_volt"])).v_volt
        assert v.min() < 230.0 * limits[0] or v.max() > 230.0 * limits[1]
        assert np.all(-p >= base.base_kva * loads.p_low - 1e-9)
        assert np.all(-p <= base.base_kva * loads.p_high + 1e-9)


def test_a_jump_breaks_a_band_that_slow_loads_keep() -> None:
    site = village()
    subject, loads = Subject.of(site), box(site, v0_low=1.05, v0_high=1.05)
    fleet = equip(site, "vde4105", Equipped.ALL)
    wide = safety(subject, fleet, loads, (0.5, 1.5))
    volts = (wide.low_volt, wide.low_rest_volt)
    assert volts[0] < volts[1] - 1.0
    limits = ((0.7 * volts[1] + 0.3 * volts[0]) / 230.0, 1.5)
    found = safety(subject, fleet, loads, limits)
    assert found.rest is BandGuarantee.KEPT
    assert found.always is not BandGuarantee.KEPT
    if found.always is BandGuarantee.VIOLATED:
        assert found.witness[0]["when"] == "after a jump of all loads"


def test_hosting_capacity_is_where_the_simulator_breaks_the_band() -> None:
    site = village()
    subject, at = Subject.of(site), Conditions(0.1, 1.0, 0.9, 1.05, Update())
    for preset in ("", "ieee1547-b"):
        plan = DroopPlan(shares_of(site, None), preset)
        found = capacity(subject, plan, at)
        assert found["limit"] == "voltage high"
        assert found["confirmed_volt"] < 1e-5
        for times, inside in ((0.998, True), (1.004, False)):
            pv = times * found["capacity_kw"] * plan.share
            own = np.flatnonzero(plan.share)
            loads = point(site, 0.1, 0.0)
            drawn = Loads(-100.0 * loads.p_low - pv, -100.0 * loads.q_low, 230.0)
            v, _ = subject.flow.solve(drawn.p_kw, drawn.q_kvar, 230.0)
            if preset:
                made = fleet_of(own, preset, 1.1 * pv[own], 100.0)
                v = ClosedLoop(subject.flow, made, 100.0, 230.0).equilibrium(drawn).v_volt
            assert bool(v.max() <= 1.05 * 230.0) is inside
    rows = [draw(subject, "", 5.0, at, 3, k) for k in range(4)]
    assert rows == [draw(subject, "", 5.0, at, 3, k) for k in range(4)]
    assert len({row["units"] for row in rows}) > 1


def test_hosting_is_for_the_highest_busbar() -> None:
    site = village()
    options = DroopOptions(
        v0_low=0.98, v0_high=1.02, presets=(), tau_factors=(), hosting=True, hosting_presets=("",), draws=0
    )
    limits = site.tables.meta.limits
    at = Conditions(0.1, 1.02, limits.v_min_pu, limits.v_max_pu, Update(1.0))
    expected = capacity(Subject.of(site), DroopPlan(shares_of(site, None), ""), at)
    assert droop(site, options).tables["hosting"]["capacity_kw"].tolist() == [expected["capacity_kw"]]


def test_line_ratings_limit_what_is_hosted() -> None:
    site = village()
    lines = tuple(replace(row, rating_a=20.0 if row.line == "l1" else None) for row in site.tables.lines)
    tight = from_tables(replace(site.tables, lines=lines))
    found = capacity(
        Subject.of(tight), DroopPlan(shares_of(tight, None), ""), Conditions(0.0, 1.0, 0.5, 2.0, Update())
    )
    assert found["limit"] == "line to n1"
    # 20 A of 230 V on three phases, and all but losses and what sits elsewhere comes through l1.
    assert found["capacity_kw"] == pytest.approx(3 * 0.230 * 20.0, rel=0.05)
    assert found["line_percent"] == pytest.approx(100.0, abs=0.5)


@pytest.mark.acceptance
def test_the_study_has_all_tables_and_goes_on_from_its_journal(tmp_path: Path) -> None:
    site = village()
    options = DroopOptions(presets=("vde4105",), tau_factors=(0.1,), hosting=True, draws=2)
    told: list[tuple[int, int]] = []
    journal = tmp_path / "journal"
    found = droop(site, options, seed=3, journal=journal, progress=lambda done, of: told.append((done, of)))
    assert found.verdict is FleetVerdict.STABLE
    assert found.always in {BandGuarantee.KEPT, BandGuarantee.VIOLATED}
    assert {
        "stability",
        "steps",
        "trajectories",
        "band",
        "customers",
        "presets",
        "hosting_probability",
    } <= set(found.tables)
    assert told[-1][0] == told[-1][1]
    edit(journal, keep=len(rows(journal)) - 3)
    again = droop(site, options, seed=3, journal=journal)
    for name, table in found.tables.items():
        pd.testing.assert_frame_equal(table, again.tables[name])
    with pytest.raises(OtherStudy):
        droop(site, options, seed=4, journal=journal)
    several = presets_of([site, random_site(1)], options)
    assert several["feeder"].tolist() == ["village", "street-1"]


def test_what_cannot_be_is_said() -> None:
    plain = village_without_inverters()
    with refused(FeederInvalid, "nothing-to-design"):
        droop(plain)
    bare = tuple(replace(row, pv_kw=0.0) for row in plain.tables.customers)
    none = from_tables(replace(plain.tables, customers=bare))
    with refused(FeederInvalid, "nothing-to-design"):
        droop(none, DroopOptions(preset="vde4105"))
    assert equip(none, "vde4105", Equipped.ALL).tau.size == len(bare)
    with refused(InputInvalid, "order"):
        droop(village(), DroopOptions(v_min=1.2))


def test_options_that_make_no_study_are_named_all_at_once() -> None:
    names, limits = ["unknown-name"] * 3, ["order", "order", "negative"]
    numbers = ["negative", "not-positive", "not-positive", *limits, "not-positive", "negative"]
    with refused(InputInvalid, *names, *numbers, "missing") as caught:
        DroopOptions(
            preset="x",
            presets=("y",),
            interval_s=-1.0,
            v0_low=1.1,
            v0_high=0.9,
            v_min=1.2,
            v_max=math.nan,
            load_high=math.inf,
            tau_factors=(1.0, 0.0, math.nan),
            hosting=True,
            hosting_presets=("", "z"),
            hosting_customers=(),
            unit_kw=math.nan,
            draws=-1,
        )
    told = str(caught.value)
    wanted = (
        "'x'",
        "'y'",
        "'z'",
        "interval",
        "constants is 0;",
        "constants is nan;",
        "busbar",
        "band",
        "load is inf",
    )
    wanted += ("unit of generation is nan", "-1 random orders", "no customer")
    assert [told.count(part) for part in wanted] == [1] * len(wanted)
    for unit in (0.0, -5.0, math.inf):
        with refused(InputInvalid, "not-positive"):
            DroopOptions(hosting=True, unit_kw=unit)


def test_what_only_hosting_asks_is_not_ignored_without_it() -> None:
    with refused(InputInvalid, "inconsistent"):
        DroopOptions(hosting_customers=("home",), unit_kw=3.0)
