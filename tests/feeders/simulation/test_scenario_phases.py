"""Scenarios in three phases: every tick is an asymmetric power flow, and the busbar has three voltages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import Site, load, to_frame
from feeders.simulation.attacks import fake_load
from feeders.simulation.demand import Customers, Variation
from feeders.simulation.plant import Channel, MeterErrors, MeterOutage, SimulatedMeters
from feeders.simulation.powerflow import UnbalancedPowerFlow
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.arrays import Floats


@pytest.fixture(scope="module")
def site() -> Site:
    return load("ieee-european-lv")


def test_every_tick_solves_the_power_flow(site: Site) -> None:
    flow = UnbalancedPowerFlow(site)
    scenario = Scenario(seed=3, duration_s=8.0, variation=Variation(busbar_pu=1.04))
    samples = list(simulate(site, scenario))
    for sample in samples:
        v0 = sample.v_bus_volt[:3]
        customers, buses = flow.solve(sample.p_kw, sample.q_kvar, v0)
        np.testing.assert_allclose(sample.v_volt, customers, rtol=1e-9)
        np.testing.assert_allclose(sample.v_bus_volt, buses.ravel(), rtol=1e-9)
        assert np.ptp(v0) > 1e-4 * site.feeder.base_volt
        # Inverters see their own phase, and at this voltage they absorb.
        assert (sample.x_kvar < 0.0).all()
    again = list(simulate(site, scenario))
    assert [one.readings for one in again] == [one.readings for one in samples]


@pytest.mark.acceptance
def test_phases_of_the_busbar_differ_by_what_is_asked_for(site: Site) -> None:
    quiet = Variation(busbar_spread_pu=0.0, tap_step_pu=0.0, busbar_unbalance_pu=0.01)

    def busbar(seed: int, variation: Variation) -> Floats:
        return Customers(site, variation, seed, START, 0.0).at(np.array([START])).v0_volt[0]

    seen = np.array([busbar(seed, quiet) for seed in range(100)])
    off = seen / site.feeder.base_volt - 1.0
    assert 0.007 < off.std() < 0.013
    assert abs(np.corrcoef(off.T)[0, 1]) < 0.4
    equal = replace(quiet, busbar_unbalance_pu=0.0)
    np.testing.assert_allclose(busbar(0, equal), [site.feeder.base_volt] * 3, rtol=1e-12)


def test_a_balanced_feeder_has_one_busbar_whatever_the_unbalance() -> None:
    village = load("kerber-landnetz")
    runs = [
        list(simulate(village, Scenario(duration_s=5.0, variation=Variation(busbar_unbalance_pu=pu))))
        for pu in (0.0, 0.01)
    ]
    assert [one.readings for one in runs[0]] == [one.readings for one in runs[1]]
    (snapshot, *_) = snapshots(runs[0])
    assert np.ndim(snapshot.v0_volt) == 0
    assert to_frame(village, snapshot).v0_phases is None


def test_each_phase_of_the_busbar_is_metered_with_an_error_of_its_own(site: Site) -> None:
    meters = SimulatedMeters(site, MeterErrors(jitter=0.0, resolution=0.0), Channel(), 5)
    assert meters.busbar_bias.shape == (3,)
    assert np.ptp(meters.busbar_bias) > 0.0
    scenario = Scenario(seed=5, duration_s=2.0, errors=MeterErrors(jitter=0.0, resolution=0.0))
    sample = next(iter(simulate(site, scenario)))
    read = sample.reported.v0_volt[0] / sample.v_bus_volt[:3] - 1.0
    np.testing.assert_allclose(read, meters.busbar_bias, rtol=1e-6)
    (busbar,) = (reading for reading in sample.readings if not reading.meter)
    assert busbar.v_phases == pytest.approx(sample.reported.v0_volt[0])


def test_frames_have_the_phases_of_the_busbar_or_know_that_they_are_missing(site: Site) -> None:
    silent = Channel(silences=(MeterOutage("", START + 1.0, START + 2.0),))
    samples = list(simulate(site, Scenario(duration_s=2.0, channel=silent)))
    frames = [to_frame(site, snapshot) for snapshot in snapshots(samples)]
    expected = (samples[0].reported.v0_volt[0] / site.feeder.base_volt) ** 2
    np.testing.assert_allclose(frames[0].v0_phases, expected, rtol=1e-14)
    assert frames[0].v0_squared == pytest.approx(expected.mean())
    np.testing.assert_array_equal(frames[1].v0_phases, [np.nan] * 3)
    assert np.isnan(frames[1].v0_squared)


def test_the_trace_of_a_fake_load_is_the_difference_of_two_power_flows(site: Site) -> None:
    customer = int(site.meters[20])
    meters, fake = fake_load(site, customer, 5, 0.01)
    assert customer in site.meters[meters]
    own = site.tables.customers[customer].phases
    # Those that feel it most are in its phase, which it lowers; of the others it raises some.
    assert {site.tables.customers[site.meters[k]].phases for k in meters} == {own}
    assert np.abs(fake.shift[meters]).min() == pytest.approx(0.01, rel=1e-6)
    assert len(set(np.sign(fake.shift[meters]))) == 1
    assert len(set(np.sign(fake.shift))) == 2
