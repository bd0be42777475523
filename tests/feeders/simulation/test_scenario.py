"""Scenarios end to end: physics, repeatability, attacks and deliveries."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from feeders.model.site import Site, load, names, to_frame
from feeders.simulation.demand import Customers, Variation
from feeders.simulation.plant import BUSBAR, Channel, ClosedLoop, Loads, MeterErrors, MeterOutage, substeps
from feeders.simulation.powerflow import PowerFlow
from feeders.simulation.scenario import (
    START,
    SUNNY_NOON_S,
    Scenario,
    Season,
    SimulatedTick,
    by_arrival,
    simulate,
    snapshots,
)
from gridsec.attack import Bias, Replay, Stuck
from gridsec.errors import InputInvalid
from gridsec.grid.devices import voltage_curve
from tests.codes import refused
from tests.feeders.villages import village, village_without_inverters

HIGH = Variation(busbar_pu=1.04)
"""A busbar voltage at which the inverters are busy."""


def play(site: Site, scenario: Scenario) -> list[SimulatedTick]:
    return list(simulate(site, scenario))


def same(a: SimulatedTick, b: SimulatedTick) -> bool:
    truth = all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in (
            "t",
            "seq",
            "v_volt",
            "v_bus_volt",
            "x_kvar",
            "p_kw",
            "q_kvar",
            "manipulated",
            "shift_volt",
        )
    )
    return truth and a.readings == b.readings


@pytest.mark.parametrize("site", [village(), village_without_inverters()], ids=["inverters", "none"])
def test_every_tick_solves_the_power_flow(site: Site) -> None:
    flow = PowerFlow(site)
    for sample in play(site, Scenario(duration_s=40.0, variation=HIGH)):
        customers, buses = flow.solve(sample.p_kw, sample.q_kvar, float(sample.v_bus_volt[0]))
        np.testing.assert_allclose(sample.v_volt, customers, rtol=1e-10)
        np.testing.assert_allclose(sample.v_bus_volt, buses, rtol=1e-10)


@pytest.mark.canary("case33bw", "simbench-lv-rural3")
@pytest.mark.parametrize("name", names())
def test_power_is_conserved_on_every_feeder(name: str) -> None:
    """What the busbar feeds in is what customers draw and lines lose, from phasors alone."""
    site = load(name)
    flow = PowerFlow(site)
    sample = next(simulate(site, Scenario()))
    u = flow.phasors(sample.p_kw, sample.q_kvar, float(sample.v_bus_volt[0]))
    a, b = flow.grid.ends.T
    current = (u[a] - u[b]) / (flow.grid.r_ohm + 1j * flow.grid.x_ohm)
    loss = 3e-3 * np.sum(flow.grid.r_ohm * np.abs(current) ** 2)
    at_busbar = np.where(a == flow.grid.busbar, 1.0, 0.0) - np.where(b == flow.grid.busbar, 1.0, 0.0)
    charge = 0.5j * flow.grid.b_siemens * u[flow.grid.busbar] * np.abs(at_busbar)
    fed = 3e-3 * (u[flow.grid.busbar] * np.conj(at_busbar @ current + charge.sum())).real
    own = sample.p_kw[flow.grid.customer_bus == flow.grid.busbar].sum()
    assert fed == pytest.approx(sample.p_kw.sum() - own + loss, abs=1e-6 * np.abs(sample.p_kw).sum())
    assert loss > 0.0


def test_inverters_begin_in_equilibrium_and_answer_to_the_true_voltage() -> None:
    site = village()
    lie = Bias(np.arange(site.meters.size), START, np.inf, size=np.full(site.meters.size, -0.05))
    samples = play(site, Scenario(duration_s=30.0, variation=HIGH, attacks=(lie,)))
    first = samples[0]
    v = first.v_volt[site.droop.customer] / site.feeder.base_volt
    asked = voltage_curve(site.droop, v) * site.feeder.base_kva
    np.testing.assert_allclose(first.x_kvar, asked, atol=2e-5)
    busy = np.array([0, 1, 3])  # the deadband of AS/NZS 4777 A reaches further
    assert np.all(first.x_kvar[busy] < -0.1)  # they absorb, because the voltage really is high
    # Lies do not change the truth.
    for attacked, honest in zip(
        samples, simulate(site, Scenario(duration_s=30.0, variation=HIGH)), strict=True
    ):
        np.testing.assert_array_equal(attacked.v_volt, honest.v_volt)
        np.testing.assert_array_equal(attacked.x_kvar, honest.x_kvar)


def test_substeps_are_small_enough() -> None:
    """The default is close to much shorter steps; only the second of a tap step is smeared."""
    site = village()
    jumpy = replace(HIGH, tap_interval_s=40.0, tap_step_pu=0.0125)
    scenario = Scenario(duration_s=200.0, variation=jumpy)
    assert substeps(site, scenario) == 1
    coarse = play(site, scenario)
    fine = play(site, replace(scenario, substep_s=0.1))
    finer = play(site, replace(scenario, substep_s=0.05))
    v = np.array([[s.v_volt for s in run] for run in (coarse, fine, finer)]) / site.feeder.base_volt
    assert np.ptp(v[0][:, 0]) > 0.01  # taps did move
    error = np.abs(v[0] - v[2]).max(axis=1)
    taps = np.flatnonzero(np.abs(np.diff(v[0][:, 6])) > 0.005) + 1  # c7 sits on the busbar
    calm = np.min(np.abs(np.arange(200)[:, None] - taps), axis=1) > 10
    calm |= np.arange(200) < taps[0]
    assert calm.sum() > 80
    assert error.max() < 5e-4
    assert error[calm].max() < 1e-5
    assert np.abs(v[1] - v[2]).max() < 3e-5


def test_stretches_and_single_steps_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    site, scenario = village(), Scenario(duration_s=300.0, variation=HIGH)
    together = play(site, scenario)
    monkeypatch.setattr("feeders.simulation.plant.MAX_SWEEPS", 0)
    alone = play(site, scenario)
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(one.x_kvar, other.x_kvar, atol=5e-5)
        np.testing.assert_allclose(one.v_volt, other.v_volt, atol=1e-4)


def test_readings_of_15_minutes_are_quasi_static() -> None:
    site = village()
    scenario = Scenario(duration_s=86_400.0, dt_s=900.0, profile_s=0.0, variation=HIGH)
    assert substeps(site, scenario) == 1
    loop = ClosedLoop(PowerFlow(site), site.droop, site.feeder.base_kva, site.feeder.base_volt)
    customers = Customers(site, scenario.variation, scenario.seed, scenario.start, scenario.profile_s)
    samples = play(site, scenario)
    assert len(samples) == 96
    worst = 0.0
    for sample in samples:
        demand = customers.at(np.array([sample.t]))
        still = loop.equilibrium(Loads(demand.p_kw[0], demand.q_kvar[0], float(demand.v0_volt[0])))
        worst = max(worst, float(np.max(np.abs(sample.v_volt - still.v_volt))) / site.feeder.base_volt)
    assert worst < 3e-5  # tau / h of the change from one reading to the next


def test_a_tick_of_a_minute_takes_substeps() -> None:
    site = replace(village(), droop=replace(village().droop, tau=np.full(4, 10.0)))
    scenario = Scenario(duration_s=600.0, dt_s=60.0, variation=HIGH)
    assert substeps(site, scenario) == 12
    slow = play(site, scenario)
    fast = play(site, replace(scenario, dt_s=1.0))[::60]
    for one, other in zip(slow, fast, strict=True):
        assert one.t == other.t
        np.testing.assert_allclose(one.p_kw, other.p_kw, rtol=1e-12)
        np.testing.assert_allclose(one.v_volt, other.v_volt, rtol=4e-5)


def test_same_seed_same_numbers_and_another_seed_others() -> None:
    site = village()
    noisy = Channel(loss=0.1, delay_mean_s=0.5, duplicate=0.1, clock_s=0.3)
    scenario = Scenario(seed=9, duration_s=300.0, channel=noisy, variation=HIGH)
    first, second = play(site, scenario), play(site, scenario)
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    other = play(site, replace(scenario, seed=10))
    assert not any(np.array_equal(a.v_volt, b.v_volt) for a, b in zip(first, other, strict=True))


def test_a_longer_scenario_begins_like_a_shorter_one() -> None:
    site = village()
    short = play(site, Scenario(duration_s=100.0, variation=HIGH))
    long = list(islice(simulate(site, Scenario(duration_s=np.inf, variation=HIGH)), 100))
    for a, b in zip(short, long, strict=True):
        np.testing.assert_allclose(a.v_volt, b.v_volt, rtol=1e-7)
        assert [r.seq for r in a.readings] == [r.seq for r in b.readings]


def test_ticks_readings_and_signs() -> None:
    site = village()
    samples = play(site, Scenario(duration_s=5.0, dt_s=0.5, errors=MeterErrors(report_q=True)))
    assert [s.t for s in samples] == [START + 0.5 * k for k in range(10)]
    for sample in samples:
        readings = {reading.meter: reading for reading in sample.readings}
        assert set(readings) == {*site.meter_ids, BUSBAR}
        busbar = readings.pop(BUSBAR)
        assert busbar.v_volt == pytest.approx(sample.v_bus_volt[0], rel=0.003)
        assert (busbar.p_kw, busbar.q_kvar) == (None, None)
        for j, meter in enumerate(site.meter_ids):
            reading, i = readings[meter], site.meters[j]
            assert (reading.t, reading.seq, reading.arrival) == (sample.t, sample.seq, sample.t)
            assert reading.v_volt == pytest.approx(sample.v_volt[i], rel=0.009)
            assert reading.p_kw == pytest.approx(sample.p_kw[i], rel=0.02, abs=0.01)
            assert reading.q_kvar == pytest.approx(sample.q_kvar[i], rel=0.03, abs=0.01)
    sunny = samples[0].p_kw[[1, 2, 4, 7]]
    assert np.count_nonzero(sunny < 0.0) >= 3  # noon: customers with generation export


def test_snapshots_hold_what_arrived() -> None:
    site = village()
    silences = (MeterOutage("m-c2", START + 2, START + 4), MeterOutage(BUSBAR, START + 6, START + 7))
    scenario = Scenario(duration_s=8.0, channel=Channel(silences=silences))
    samples = play(site, scenario)
    for sample, snapshot in zip(samples, snapshots(samples), strict=True):
        by_meter = {reading.meter: reading for reading in sample.readings}
        for j, meter in enumerate(site.meter_ids):
            if meter in by_meter:
                assert snapshot.v_volt[j] == by_meter[meter].v_volt
                assert snapshot.p_kw[j] == by_meter[meter].p_kw
            else:
                assert meter == "m-c2"
                assert np.isnan(snapshot.v_volt[j])
                assert np.isnan(snapshot.p_kw[j])
        assert np.isnan(snapshot.v0_volt) == (BUSBAR not in by_meter)
        assert np.isnan(snapshot.q_kvar).all()
        frame = to_frame(site, snapshot)
        assert frame.t == sample.t
        assert frame.seen.sum() == len(set(by_meter) - {BUSBAR})


@pytest.mark.canary("kerber-landnetz")
@pytest.mark.parametrize("name", ["village", *names()])
def test_the_truth_lies_inside_what_a_frame_claims(name: str) -> None:
    """Loads, powers and their stated intervals: what estimators build their thresholds on."""
    site = village() if name == "village" else load(name)
    base = site.feeder.base_kva
    inverters = np.zeros(len(site.tables.customers))
    for seed in range(2):
        scenario = Scenario(seed=seed, duration_s=2 * 86_400.0, dt_s=900.0, profile_s=0.0, variation=HIGH)
        samples = play(site, scenario)
        for sample, snapshot in zip(samples, snapshots(samples), strict=True):
            frame = to_frame(site, snapshot)
            metered = site.meters
            # The rounding of a reading is scaled with it: a hundredth of half a step.
            slack = (site.loads.p_fraction * site.loads.p_floor)[metered] + 1e-12
            assert np.all(np.abs(-sample.p_kw / base - frame.p)[metered] <= frame.p_error[metered] + slack)
            inverters[site.droop.customer] = sample.x_kvar
            load_q = sample.q_kvar + inverters
            assert np.all(np.abs(-load_q / base - frame.q)[metered] <= frame.q_error[metered] + 1e-12)


def test_replay_and_stuck_repeat_what_was_honestly_read() -> None:
    site = village()
    on, off = START + 30.0, START + 60.0
    replay = Replay(np.array([1]), on, off, delay_s=20.0)
    stuck = Stuck(np.array([4]), on, off)
    samples = play(site, Scenario(duration_s=70.0, attacks=(replay, stuck)))
    honest = [s.reported.v_volt[0] - s.shift_volt for s in samples]
    for k, sample in enumerate(samples):
        if 30 <= k < 60:
            assert sample.reported.v_volt[0, 1] == pytest.approx(honest[k - 20][1], abs=1e-9)
            assert sample.reported.v_volt[0, 4] == pytest.approx(honest[30][4], abs=1e-9)
        else:
            assert not sample.manipulated.any()


def test_an_hour_before_the_beginning_can_be_replayed() -> None:
    site = village()
    replay = Replay(np.array([0, 2]), START + 5.0, START + 15.0, delay_s=600.0)
    stuck = Stuck(np.array([3]), START - 50.0, START + 15.0)
    samples = play(site, Scenario(duration_s=20.0, attacks=(replay, stuck)))
    earlier = play(site, Scenario(start=START - 600.0, profile_s=SUNNY_NOON_S - 600.0, duration_s=600.0))
    # Loads and busbar are functions of time; meters' biases belong to the seed, jitter to the tick.
    for k in range(5, 15):
        told = samples[k].reported.v_volt[0, [0, 2]]
        np.testing.assert_allclose(told, earlier[k].reported.v_volt[0, [0, 2]], atol=8 * 0.0005 * 230)
        assert np.all(np.abs(told - earlier[k].v_volt[site.meters[[0, 2]]]) < 0.005 * 240 + 1.0)
    frozen = {float(sample.reported.v_volt[0, 3]) for sample in samples[:15]}
    assert len(frozen) == 1
    assert frozen.pop() == pytest.approx(earlier[550].v_volt[site.meters[3]], rel=0.009)
    # The truth does not notice.
    for a, b in zip(samples, simulate(site, Scenario(duration_s=20.0)), strict=True):
        np.testing.assert_array_equal(a.v_volt, b.v_volt)


def test_readings_come_in_the_order_of_arrival() -> None:
    site = village()
    channel = Channel(loss=0.05, delay_mean_s=0.8, late=0.05, late_s=7.0, duplicate=0.1)
    samples = play(site, Scenario(duration_s=120.0, channel=channel))
    ordered = list(by_arrival(samples))
    arrivals = [reading.arrival for reading in ordered]
    assert arrivals == sorted(arrivals)
    everything = [reading for sample in samples for reading in sample.readings]
    assert sorted(map(repr, ordered)) == sorted(map(repr, everything))
    seqs = [reading.seq for reading in ordered if reading.meter == "m-c1"]
    assert seqs != sorted(seqs)  # some were overtaken
    assert len(seqs) > len(set(seqs))  # some came twice
    assert len(set(seqs)) < 120  # some never came


def test_readings_come_out_as_soon_as_they_can() -> None:
    """A live publisher must not wait for the end of the scenario."""
    endless = simulate(village(), Scenario(duration_s=np.inf, channel=Channel(delay_s=2.5)))
    taken = 0

    def counted() -> object:
        nonlocal taken
        for sample in endless:
            taken += 1
            yield sample

    first = next(by_arrival(counted()))  # a generator of samples
    assert first.arrival == START + 2.5
    assert taken == 4


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"seed": -1}, "negative"),
        ({"start": np.nan}, "out-of-range"),
        ({"duration_s": 0.0}, "not-positive"),
        ({"dt_s": np.inf}, "not-positive"),
        ({"substep_s": 0.0}, "not-positive"),
    ],
)
def test_nonsense_is_refused(change: dict[str, float], code: str) -> None:
    with refused(InputInvalid, code):
        Scenario(**change)  # that is the point


def test_attacks_on_meters_that_are_not_there_are_refused() -> None:
    site = village()
    ghost = Bias(np.array([7]), START, START + 1.0, size=np.array([0.1]))
    with refused(InputInvalid, "unknown-index"):
        next(simulate(site, Scenario(attacks=(ghost,))))
    ancient = Replay(np.array([0]), START, START + 1.0, delay_s=1e7)
    with refused(InputInvalid, "out-of-range"):
        next(simulate(site, Scenario(attacks=(ancient,))))


def test_the_text_of_a_season_is_the_season() -> None:
    text, member = (Scenario(duration_s=2.0, season=season) for season in ("winter", Season.WINTER))
    assert text == member
    assert all(same(a, b) for a, b in zip(play(village(), text), play(village(), member), strict=True))
    with refused(InputInvalid, "unknown-name"):
        Scenario(season="dry")


def test_a_scenario_may_begin_in_1970() -> None:
    site = village()
    early, later = (play(site, Scenario(start=start, duration_s=3.0)) for start in (0.0, 2.0))
    assert len(early) == len(later) == 3
    assert early[2].v_bus_volt[0] == pytest.approx(later[0].v_bus_volt[0], rel=1e-12)
