"""The droop study in three phases, against asymmetric AC power flow and against three balanced feeders."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from feeders.model.site import Site, from_tables, load
from feeders.simulation.powerflow import UnbalancedPowerFlow
from feeders.studies.droop.fleets import Equipped, box, equip, point
from feeders.studies.droop.limits import BandGuarantee, Conditions, DroopPlan, checked, ratings_pu, safety
from feeders.studies.droop.verdict import FleetVerdict, Subject, inverter_rows, judge, longest_interval
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, FeederInvalid
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.grid.phased import PhasedFeeder
from gridsec.planning.droop.ac_sensitivity import InjectionBox, currents, network, region, sensitivity, solve
from gridsec.planning.droop.equilibrium import always, at_rest, injected, rest
from gridsec.planning.droop.stability import Update, enlarged, loop, proof, reach
from tests.codes import refused
from tests.feeders.studies.droop.test_droop import random_site
from tests.feeders.studies.three_phases import apart

FEW = settings(max_examples=12)
WHOLE, ALONE = apart("simbench-lv-rural1")


@lru_cache(maxsize=4)
def asymmetric(site: Site) -> UnbalancedPowerFlow:
    return UnbalancedPowerFlow(site)


def kw(site: Site, values: Floats) -> Floats:
    return -site.feeder.base_kva * values


def volts(site: Site, p: Floats, q: Floats, v0: Floats | float) -> Floats:
    """Voltages of the customers by the other power flow, pu; the busbar's voltages as they are."""
    base = site.feeder.base_volt
    given = np.broadcast_to(np.asarray(v0, dtype=np.float64), 3) * base
    return asymmetric(site).solve(kw(site, p), kw(site, q), given)[0] / base


def random_box(site: Site, rng: np.random.Generator, size: float) -> InjectionBox:
    count = len(site.feeder.customers)
    p, q = rng.uniform(-0.03, 0.03, (2, count))
    dp, dq = size * rng.uniform(0.0, 0.02, (2, count))
    return InjectionBox(p - dp, p + dp, q - dq, q + dq, 0.99, 1.02)


def corner(given: InjectionBox, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """A point of the box, often on its edges; the phases of the busbar each on their own."""
    u = np.clip(rng.uniform(-0.5, 1.5, (2, given.p_low.size)), 0.0, 1.0)
    p = given.p_low + u[0] * (given.p_high - given.p_low)
    q = given.q_low + u[1] * (given.q_high - given.q_low)
    return p, q, rng.choice([given.v0_low, given.v0_high], 3)


@pytest.mark.parametrize("charged", [True, False])
def test_the_power_flow_of_proofs_is_the_asymmetric_one(charged: bool) -> None:
    site = random_site(3, phased=True)
    assert isinstance(site.feeder, PhasedFeeder)
    assert site.feeder.tree.charging.any()
    feeder, tree = site.feeder, site.feeder.tree
    rng = np.random.default_rng(3)
    p, q = rng.uniform(-0.05, 0.05, (2, feeder.bus.size))
    if not charged:
        feeder = PhasedFeeder(replace(tree, charging=0.0 * tree.charging))
        np.testing.assert_allclose(network(feeder).Z_bus, feeder.R + 1j * feeder.X, rtol=0, atol=1e-15)
        return
    net = network(feeder)
    V = solve(net, p + 1j * q, 1.02)
    np.testing.assert_allclose(np.abs(V), volts(site, p, q, 1.02), rtol=0, atol=1e-9)
    # Currents: from the phasors of the other power flow, over each line's impedance.
    flow, base = UnbalancedPowerFlow(site), site.feeder.base_volt
    phasors = flow.phasors(kw(site, p)[None], kw(site, q)[None], np.array([1.02 * base]))[0] / base
    order = [site.bus_of_file[name] for name in site.bus_of_file]
    assert order == list(range(len(tree.buses)))
    amps = []
    for k, above in enumerate(tree.parent):
        series = np.linalg.solve(tree.z[k], phasors[above] - phasors[k + 1])
        half = 0.5j * tree.charging[k]
        ends = (series + half @ phasors[above], series - half @ phasors[k + 1])
        amps.append(max(np.abs(end).max() for end in ends))
    found = currents(feeder, net, p + 1j * q, V, 1.02)
    np.testing.assert_allclose(found.max(axis=1), amps, rtol=0, atol=1e-8)


@FEW
@given(seed=st.integers(0, 100))
def test_sensitivities_are_differences_of_the_asymmetric_power_flow(seed: int) -> None:
    site = random_site(seed, phased=True)
    rng, count = np.random.default_rng(seed), site.feeder.bus.size
    p, q = rng.uniform(-0.03, 0.03, (2, count))
    net = Subject.of(site).net
    found = sensitivity(net, p + 1j * q, solve(net, p + 1j * q, 1.0))
    j, phase, h = int(rng.integers(count)), int(rng.integers(3)), 1e-4
    one, busbar = h * (np.arange(count) == j), h * (np.arange(3) == phase)
    dq = (volts(site, p, q + one, 1.0) - volts(site, p, q - one, 1.0)) / (2.0 * h)
    np.testing.assert_allclose(found.dv_dq[:, j], dq, atol=1e-6)
    dp = (volts(site, p + one, q, 1.0) - volts(site, p - one, q, 1.0)) / (2.0 * h)
    np.testing.assert_allclose((found.v[:, None] * found.p.real)[:, j], dp, atol=1e-6)
    d0 = (volts(site, p, q, 1.0 + busbar) - volts(site, p, q, 1.0 - busbar)) / (2.0 * h)
    np.testing.assert_allclose(found.v * found.busbar[:, phase].real, d0, atol=1e-6)


@FEW
@given(seed=st.integers(0, 200), size=st.sampled_from([0.1, 1.0]))
def test_nothing_in_a_box_is_outside_of_its_bounds(seed: int, size: float) -> None:
    site = random_site(seed, phased=True)
    rng = np.random.default_rng([seed, 1])
    net, given_box = Subject.of(site).net, random_box(site, rng, size)
    found = region(net, given_box)
    before: tuple[Floats, Floats, Floats, Floats] | None = None
    for _ in range(5):
        p, q, v0 = corner(given_box, rng)
        v = volts(site, p, q, v0)
        assert np.all(v >= found.low)
        assert np.all(v <= found.high)
        if before is not None:
            steps = [new - old for new, old in zip((p, q, v0), before, strict=False)]
            middle = (found.dv_dp, found.dv_dq, found.dv_dv0)
            off = v - before[3] - sum(J @ d for J, d in zip(middle, steps, strict=True))
            errors = (found.p_error, found.q_error, found.v0_error)
            most = sum(E @ np.abs(d) for E, d in zip(errors, steps, strict=True))
            assert np.all(np.abs(off) <= most + 1e-9)
        before = p, q, v0, v


def settled(site: Site, fleet: Droop, p: Floats, q: Floats, v0: Floats) -> tuple[Floats, Floats]:
    """Injections and voltages at rest by damped steps, the phases of the busbar as they are."""
    x = np.zeros(fleet.customer.size)
    for _ in range(60):
        own = np.bincount(fleet.customer, weights=x, minlength=p.size)
        v = volts(site, p, q + own, v0)
        x = x + 0.5 * (voltage_curve(fleet, v[fleet.customer]) - x)
    return x, v


def test_no_voltage_leaves_its_proven_band() -> None:
    told: Counter[str] = Counter()

    @FEW
    @given(seed=st.integers(0, 200))
    def holds(seed: int) -> None:
        site = random_site(seed, phased=True)
        rng = np.random.default_rng([seed, 2])
        subject, fleet = Subject.of(site), equip(site, "ieee1547-b", Equipped.ALL)
        loads = random_box(site, rng, 1.0)
        told["drawn"] += 1
        ever = always(subject.net, fleet, loads)
        try:
            still = at_rest(subject.net, fleet, loads)
        except DesignInfeasible:
            return
        told["at rest"] += 1
        assert np.all(still.low >= ever.low)
        before: Floats | None = None
        for _ in range(4):
            p, q, v0 = corner(loads, rng)
            x, v = settled(site, fleet, p, q, v0)
            assert np.all(v >= still.low - 1e-7)
            assert np.all(v <= still.high + 1e-7)
            if np.ptp(v0) == 0.0:
                found, V = rest(subject.net, fleet, p + 1j * q, float(v0[0]))
                np.testing.assert_allclose(found, x, atol=1e-6)
                np.testing.assert_allclose(np.abs(V), v, atol=1e-6)
            if before is not None:  # a jump of all loads
                s = injected(fleet, p + 1j * q, before)
                jumped = volts(site, s.real, s.imag, v0)
                assert np.all(jumped >= ever.low - 1e-7)
                assert np.all(jumped <= ever.high + 1e-7)
            before = x

    holds()
    # Few fleets are too steep: of the seeds 7 %.
    assert told["at rest"] >= 0.7 * told["drawn"]


def test_phases_that_do_not_touch_are_three_fleets() -> None:
    whole, alone = Subject.of(WHOLE), [Subject.of(site) for site in ALONE]

    def fleet(site: Site) -> Droop:
        return equip(site, "vde4105", Equipped.ALL)

    for update in (Update(1.0), Update(60.0), Update(0.0)):
        for at in (lambda site: point(site, 0.3, 1.0, 1.05), box):
            found = judge(whole, fleet(WHOLE), update, at(WHOLE))
            each = [judge(s, fleet(s.site), update, at(s.site)) for s in alone]
            assert found.verdict is FleetVerdict.STABLE
            assert {one.verdict for one in each} == {FleetVerdict.STABLE}
            assert found.gain == pytest.approx(max(one.gain for one in each), rel=1e-3)
            if not np.isnan(found.growth):
                assert found.growth == pytest.approx(max(one.growth for one in each), rel=1e-9)
    bands = [safety(s, fleet(s.site), box(s.site), (0.9, 1.1)) for s in (whole, *alone)]
    limits = {row["customer"]: row for one in bands[1:] for row in one.rows}
    for row in bands[0].rows:
        same = limits[row["customer"]]
        for name in ("low_volt", "high_volt", "low_rest_volt", "high_rest_volt"):
            assert row[name] == pytest.approx(same[name], abs=0.02)
    assert bands[0].always is BandGuarantee.KEPT
    # The fullest conductor of a line is that of its fullest phase.
    at = Conditions(0.1, 1.0, 0.9, 1.1, Update())
    share = np.full(len(WHOLE.feeder.customers), 1.0 / len(WHOLE.feeder.customers))
    found_lines = checked(whole, DroopPlan(share, ""), 60.0, at, ratings_pu(WHOLE))["line_percent"]
    parts = []
    for s in alone:
        count = len(s.site.feeder.customers)
        plan = DroopPlan(np.full(count, 1.0 / count), "")
        amps = checked(s, plan, 60.0 * count / share.size, at, ratings_pu(s.site))["line_percent"]
        # One pu of current is a third of a phase's own power as three phases count it.
        parts.append(3.0 * amps)
    assert found_lines == pytest.approx(max(parts), rel=1e-6)


def test_what_one_inverter_may_do_alone_is_still_proved() -> None:
    site = random_site(2, phased=True)
    subject = Subject.of(site)
    at, update = point(site, 0.2, 0.6, 1.04), Update()
    fleet = enlarged(equip(site, "ieee1547-b", Equipped.ALL), 0.9)
    rows = inverter_rows(subject, fleet, update, at, "here")
    made = loop(fleet, reach(subject.net, fleet, at), update)
    assert proof(made).gain < 1.0
    assert sum(row["part"] for row in rows) == pytest.approx(1.0)
    for row in rows:
        k = [site.feeder.customers[int(i)] for i in fleet.customer[made.rows]].index(row["customer"])
        root = np.sqrt(np.where(np.arange(made.tau.size) == k, 0.99 * row["alone"], 1.0))
        both = root[:, None] * root
        steeper = replace(made, S=both * made.S, error=both * made.error)
        assert proof(steeper).kind
    assert longest_interval(subject, fleet, update, at) == np.inf


def test_the_european_feeder_is_stable_and_its_witness_is_one() -> None:
    site = load("ieee-european-lv")
    subject = Subject.of(site)
    found = judge(subject, site.droop, Update(), box(site))
    assert (found.verdict, found.proof) == (FleetVerdict.STABLE, "small-gain")
    rows = safety(subject, site.droop, box(site), (0.9, 1.1)).witness
    p, q, x = (np.array([row[name] for row in rows]) for name in ("p_kw", "q_kvar", "inverter_kvar"))
    v = UnbalancedPowerFlow(site).solve(p, q - x, rows[0]["busbar_volt"])[0]
    np.testing.assert_allclose(v, [row["v_volt"] for row in rows], atol=1e-6)
    low, high = (each * site.feeder.base_volt for each in (0.9, 1.1))
    assert v.min() < low or v.max() > high


def test_charging_that_cannot_be_is_refused() -> None:
    site = random_site(1, phased=True)
    assert isinstance(site.feeder, PhasedFeeder)
    tree = site.feeder.tree
    heavy = PhasedFeeder(replace(tree, charging=1e6 * tree.charging))
    with refused(DesignInfeasible, "no-solution"):
        network(heavy)
    rows = tuple(replace(row, pv_kw=0.0, inverter_kva=0.0, droop="") for row in site.tables.customers)
    without = from_tables(replace(site.tables, customers=rows))
    with refused(FeederInvalid, "nothing-to-design"):
        equip(without, "ieee1547-b")
