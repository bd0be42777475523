"""Random processes against their statistics; loads against what the feeder's files promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load
from feeders.profiles import Season, library
from feeders.simulation.demand import CHUNK_CORRELATIONS, STAGGER_S, Customers, Fluctuation, Stream, Variation
from feeders.simulation.scenario import SUNNY_NOON_S
from tests.feeders.villages import tables, village

START = 1_780_272_000.0
CALM = Variation(load_spread=0.0, cloud_spread=0.0, busbar_spread_pu=0.0, tap_step_pu=0.0)


def test_fluctuation_is_an_ornstein_uhlenbeck_process() -> None:
    correlation, copies = 50.0, 400
    path = Fluctuation(1, Stream.LOAD, copies, correlation)
    t = START + np.arange(0.0, 4000.0, 5.0)  # several chunks
    z = path.at(t)
    effective = copies * t[-1] / (2 * correlation) * 0 + copies * (t[-1] - t[0]) / (2 * correlation)
    bound = 5.0 / np.sqrt(effective)
    assert abs(z.mean()) < bound
    assert abs(z.var() - 1.0) < 2 * bound
    for lag in (5.0, 50.0, 100.0):
        k = int(lag / 5.0)
        assert abs(np.mean(z[k:] * z[:-k]) - np.exp(-lag / correlation)) < 2 * bound
    others = np.corrcoef(z[:, :20].T)
    assert np.max(np.abs(others - np.eye(20))) < 5.0 / np.sqrt((t[-1] - t[0]) / (2 * correlation))


@pytest.mark.acceptance
def test_variance_is_even_across_the_ends_of_chunks() -> None:
    correlation, copies = 20.0, 20_000
    path = Fluctuation(2, Stream.LOAD, copies, correlation)
    length = CHUNK_CORRELATIONS * correlation
    seam = np.ceil(START / length) * length
    near = path.at(seam + np.array([-30.0, -10.0, -1.0, 0.0, 1.0, 10.0, 30.0]))
    np.testing.assert_allclose(near.var(axis=1), 1.0, atol=5 * np.sqrt(2 / copies))
    across = np.mean(near[2] * near[4])
    assert abs(across - np.exp(-2.0 / correlation)) < 5 / np.sqrt(copies)


def test_fluctuation_does_not_depend_on_how_it_is_asked() -> None:
    whole = Fluctuation(3, Stream.CLOUD, 3, 10.0)
    t = START + np.arange(0.0, 2000.0, 0.7)
    expected = whole.at(t)
    other = Fluctuation(3, Stream.CLOUD, 3, 10.0)
    shuffled = np.random.default_rng(0).permutation(t.size)
    np.testing.assert_array_equal(other.at(t[shuffled]), expected[shuffled])
    np.testing.assert_array_equal(other.at(t[100:101]), expected[100:101])
    assert np.any(Fluctuation(4, Stream.CLOUD, 3, 10.0).at(t) != expected)
    assert np.any(Fluctuation(3, Stream.LOAD, 3, 10.0).at(t) != expected)


@pytest.mark.acceptance
def test_loads_stay_inside_what_the_files_promise() -> None:
    site = village()
    base = site.feeder.base_kva
    t = START + np.arange(0.0, 14 * 86400.0, 613.0)
    for seed in range(3):
        demand = Customers(site, Variation(load_scale=1.3), seed, START, 0.0).at(t)
        load_kw = np.array([row.load_kw for row in site.tables.customers])
        pv_kw = np.array([row.pv_kw for row in site.tables.customers])
        assert np.all(demand.p_kw <= load_kw)
        assert np.all(demand.p_kw >= -pv_kw)
        assert np.any(demand.p_kw < -0.5 * pv_kw.max())  # the sun does shine
        low = site.loads.tan_min * np.maximum(demand.p_kw, 0.0) - site.loads.q_floor * base
        high = site.loads.tan_max * np.minimum(demand.p_kw + pv_kw, load_kw) + site.loads.q_floor * base
        assert np.all(demand.q_kvar >= low - 1e-9)
        assert np.all(demand.q_kvar <= high + 1e-9)


def test_the_ratio_of_reactive_power_is_each_customers_own_and_constant() -> None:
    rows = tuple(replace(row, pv_kw=0.0, inverter_kva=0.0, droop="") for row in tables().customers)
    site = from_tables(replace(tables(), customers=rows))
    demand = Customers(site, Variation(), 5, START, 0.0).at(START + np.arange(0.0, 86400.0, 60.0))
    ratios = []
    for i in range(len(rows)):
        slope, offset = np.polyfit(demand.p_kw[:, i], demand.q_kvar[:, i], 1)
        residual = demand.q_kvar[:, i] - (slope * demand.p_kw[:, i] + offset)
        assert np.max(np.abs(residual)) < 1e-9
        assert site.loads.tan_min[i] <= slope <= site.loads.tan_max[i]
        assert abs(offset) <= site.loads.q_floor[i] * site.feeder.base_kva
        ratios.append(slope)
    assert np.ptp(ratios) > 0.05


def with_profiles(wave: str, pv: str) -> Site:
    rows = tuple(
        replace(row, load_profile=wave, pv_profile=pv if row.pv_kw > 0 else "") for row in tables().customers
    )
    return from_tables(replace(tables(), customers=rows))


@pytest.mark.canary("spring")
@pytest.mark.parametrize("season", Season)
def test_without_fast_variation_the_profiles_come_back(season: Season) -> None:
    profiles = library(season)
    period = 900.0 * profiles.t_s.size
    wave_name, pv = next(iter(profiles.load_p)), next(iter(profiles.pv))
    site = with_profiles(wave_name, pv)
    profile_s = 3 * 86400.0
    t = START + np.arange(-7200.0, 15 * 86400.0, 1800.0)  # beyond both ends of the profiles
    demand = Customers(site, CALM, 0, START, profile_s, season=season).at(t)
    place = np.mod(t - START + profile_s, period)
    times = np.append(profiles.t_s, period)
    sun = np.interp(place, times, np.append(profiles.pv[pv], profiles.pv[pv][0]))
    wave = np.append(profiles.load_p[wave_name], profiles.load_p[wave_name][0])
    reach = np.linspace(-STAGGER_S, STAGGER_S, 61)
    around = np.array([np.interp(np.mod(place + s, period), times, wave) for s in reach])
    for i, row in enumerate(site.tables.customers):
        drawn = demand.p_kw[:, i] + row.pv_kw * np.clip(sun, 0.0, 1.0)
        low, high = around.min(0) * row.load_kw, around.max(0) * row.load_kw
        slack = 0.02 * row.load_kw
        assert np.all(drawn >= low - slack)
        assert np.all(drawn <= np.minimum(high, row.load_kw) + slack)


def test_numbers_of_the_default_season_have_not_changed() -> None:
    """As they were when there was summer only."""
    t = START + np.array([0.0, 3600.0, 43_200.0, 13 * 86_400.0])
    demand = Customers(load("simbench-lv-rural1"), Variation(), 7, START, SUNNY_NOON_S).at(t)
    then_kw = [-86.60834967445527, -72.64941094148463, 11.513360966594913, -27.216796056518046]
    then_kvar = [8.067709383992423, 7.98264625735612, 2.601637945946422, 7.393853983083182]
    np.testing.assert_allclose(demand.p_kw.sum(axis=1), then_kw, rtol=1e-12)
    np.testing.assert_allclose(demand.q_kvar.sum(axis=1), then_kvar, rtol=1e-12)


def test_a_season_changes_profiles_and_nothing_random() -> None:
    """Same seed, same noise, same customers: only the curves differ."""
    site, t = village(), START + np.arange(0.0, 86_400.0, 900.0)
    summer = Customers(site, Variation(), 5, START, 0.0).at(t)
    winter = Customers(site, Variation(), 5, START, 0.0, season=Season.WINTER).at(t)
    again = Customers(site, Variation(), 5, START, 0.0, season=Season.WINTER).at(t)
    np.testing.assert_array_equal(winter.p_kw, again.p_kw)
    np.testing.assert_array_equal(winter.v0_volt, summer.v0_volt)
    night = (t - START) / 3600.0 > 17.0
    assert np.all(winter.p_kw[night] >= 0.0)  # no sun after five in January
    assert summer.p_kw.sum() < 0.8 * winter.p_kw.sum()


def test_readings_of_a_second_are_no_staircase() -> None:
    demand = Customers(village(), Variation(), 0, START, 43_200.0).at(START + np.arange(600.0))
    drawing = np.abs(demand.p_kw).max(axis=0) > 0.1
    assert drawing.sum() >= 6
    assert np.all(np.diff(demand.p_kw[:, drawing], axis=0) != 0.0)


@pytest.mark.acceptance
def test_busbar_keeps_its_mean_and_steps_with_the_taps() -> None:
    site = village()
    t = START + np.arange(0.0, 3 * 86400.0, 10.0)
    still = replace(CALM, busbar_pu=1.02)
    np.testing.assert_allclose(Customers(site, still, 0, START, 0.0).at(t).v0_volt, 1.02 * 230.0)

    stepped = Customers(site, replace(still, tap_step_pu=0.0125), 0, START, 0.0).at(t).v0_volt
    position = (stepped / 230.0 - 1.02) / 0.0125
    np.testing.assert_allclose(position, np.round(position), atol=1e-9)
    assert set(np.round(position)) == {-1.0, 0.0, 1.0}
    assert 5 <= np.count_nonzero(np.diff(np.round(position))) <= 36  # at most one event in two hours

    slow = replace(still, busbar_spread_pu=0.003)
    v0 = np.concatenate([Customers(site, slow, seed, START, 0.0).at(t).v0_volt for seed in range(10)])
    assert v0.std() / 230.0 == pytest.approx(0.003, rel=0.15)
    assert v0.mean() / 230.0 == pytest.approx(1.02, abs=0.0006)


def test_times_about_1970_are_like_others() -> None:
    t = np.arange(-20_000.0, 20_000.0)
    process = Fluctuation(0, Stream.LOAD, 200, 20.0).at(t)
    assert process.std() == pytest.approx(1.0, rel=0.02)
    lag = np.mean(process[20:] * process[:-20])
    assert lag == pytest.approx(np.exp(-1.0), abs=0.02)
    site, stepped = village(), replace(CALM, tap_step_pu=0.0125)
    whole = Customers(site, stepped, 1, 0.0, 0.0).at(np.arange(-200_000.0, 200_000.0, 50.0)).v0_volt
    steps = np.flatnonzero(np.diff(whole))
    assert min(np.count_nonzero(steps < 4000), np.count_nonzero(steps > 4000)) >= 10
    never = replace(stepped, tap_interval_s=np.inf)
    both = Customers(site, never, 1, 0.0, 0.0).at(np.array([-1e6, -1.0, 0.0, 1e9])).v0_volt
    assert np.unique(both).size == 1
