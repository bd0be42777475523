"""Meters against their data sheets, and the channel against its statistics."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from feeders.model.site import Site, from_tables
from feeders.simulation.plant import BUSBAR, Channel, MeterErrors, MeterOutage, SimulatedMeters
from gridsec.errors import InputInvalid
from tests.codes import refused
from tests.feeders.villages import tables, village

START = 1_780_272_000.0
TICKS = np.arange(600)


@cache
def unlike() -> Site:
    """A village whose meters are of another class for each power."""
    plain = tables()
    meters = replace(plain.meta.meters, p_error_percent=2.0, q_error_percent=0.5)
    return from_tables(replace(plain, meta=replace(plain.meta, meters=meters)))


def truth(ticks: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    count = len(village().tables.customers)
    v = random.uniform(205.0, 255.0, (ticks, count))
    p, q = random.uniform(-20.0, 20.0, (2, ticks, count))
    return v, p, q, random.uniform(225.0, 240.0, ticks)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32))
def test_honest_meters_keep_their_promise(seed: int) -> None:
    site = unlike()
    meters = SimulatedMeters(site, MeterErrors(report_q=True), Channel(), seed)
    accuracy, nominal = site.accuracy, site.tables.meta.voltage_volt
    v, p, q, v0 = truth(TICKS.size, seed)
    read = meters.read(TICKS, v, p, q, v0)
    v, p, q = v[:, site.meters], p[:, site.meters], q[:, site.meters]

    assert np.all(np.abs(meters.bias) <= accuracy.class_fraction)
    assert abs(meters.busbar_bias) <= accuracy.busbar_class
    # Class and half a step always; jitter is Gaussian, and 6 sigma happen once in 500 million readings.
    slack = nominal * (0.5 * accuracy.resolution + 6.0 * accuracy.jitter)
    assert np.all(np.abs(read.v_volt - v) <= accuracy.class_fraction * v + slack + 1e-9)
    slack0 = nominal * (0.5 * accuracy.busbar_resolution + 6.0 * accuracy.busbar_jitter)
    assert np.all(np.abs(read.v0_volt - v0) <= accuracy.busbar_class * v0 + slack0 + 1e-9)
    loads = site.loads
    for values, true, fraction in ((read.p_kw, p, loads.p_fraction), (read.q_kvar, q, loads.q_fraction)):
        allowed = fraction[site.meters]
        half_step = loads.p_floor[site.meters] * site.feeder.base_kva
        assert np.all(np.abs(values - true) <= allowed * np.abs(values) + (1 + allowed) * half_step + 1e-9)


def test_bias_is_fixed_and_jitter_has_its_size() -> None:
    site = village()
    ticks = np.arange(20_000)
    v = np.full((ticks.size, len(site.tables.customers)), 231.234)
    zero = np.zeros_like(v)
    meters = SimulatedMeters(site, MeterErrors(), Channel(), 1)
    error = meters.read(ticks, v, zero, zero, v[:, 0]).v_volt - 231.234
    bound = 5.0 / np.sqrt(ticks.size)
    sigma = site.accuracy.jitter * 230.0
    # The mean is the bias; rounding adds next to none, because the jitter dithers it.
    np.testing.assert_allclose(error.mean(0), meters.bias * 231.234, atol=bound * 2 * sigma.max())
    expected = np.sqrt(sigma**2 + (site.accuracy.resolution * 230.0) ** 2 / 12.0)
    np.testing.assert_allclose(error.std(0), expected, rtol=0.05)
    assert np.all(np.abs(np.corrcoef(error.T) - np.eye(error.shape[1])) < 2 * bound)
    assert abs(np.mean(error[1:, 0] * error[:-1, 0]) - error[:, 0].mean() ** 2) < bound * sigma.max()


def test_biases_fill_the_class_evenly() -> None:
    site = unlike()
    drawn = [SimulatedMeters(site, MeterErrors(), Channel(), seed) for seed in range(400)]
    p_fraction, q_fraction = (of[site.meters] for of in (site.loads.p_fraction, site.loads.q_fraction))
    assert not np.isclose(p_fraction, q_fraction, rtol=0.5).any()
    shares = [
        np.array(each).ravel()
        for each in (
            [made.bias / site.accuracy.class_fraction for made in drawn],
            [made.p_gain / p_fraction for made in drawn],
            [made.q_gain / q_fraction for made in drawn],
        )
    ]
    bound = 5.0 / np.sqrt(shares[0].size)
    for share in shares:
        assert np.abs(share).max() <= 1.0
        assert abs(share.mean()) < bound
        assert abs((share**2).mean() - 1 / 3) < bound
    for one, other in combinations(shares, 2):
        assert abs(np.mean(one * other)) < bound


def test_registers_have_their_resolution() -> None:
    site = village()
    v, p, q, v0 = truth(50)
    read = SimulatedMeters(site, MeterErrors(report_q=True), Channel(), 2).read(np.arange(50), v, p, q, v0)
    for values, step in ((read.v_volt, 0.1), (read.v0_volt, 0.1), (read.p_kw, 0.01), (read.q_kvar, 0.01)):
        np.testing.assert_allclose(values / step, np.round(values / step), atol=1e-6)
    assert all(len(repr(float(value))) <= 6 for value in read.v_volt.ravel())  # 231.4, not 231.40000000000003


def test_ideal_meters_read_the_truth() -> None:
    site = village()
    v, p, q, v0 = truth(50)
    ideal = MeterErrors(bias=0.0, jitter=0.0, resolution=0.0, power=0.0, report_q=True)
    read = SimulatedMeters(site, ideal, Channel(), 3).read(np.arange(50), v, p, q, v0)
    np.testing.assert_array_equal(read.v_volt, v[:, site.meters])
    np.testing.assert_array_equal(read.p_kw, p[:, site.meters])
    np.testing.assert_array_equal(read.q_kvar, q[:, site.meters])
    np.testing.assert_array_equal(read.v0_volt, v0)
    silent = SimulatedMeters(site, MeterErrors(), Channel(), 3).read(np.arange(50), v, p, q, v0)
    assert np.isnan(silent.q_kvar).all()  # by default meters report no reactive power


def test_what_a_tick_draws_depends_on_its_number_alone() -> None:
    site = village()
    meters = SimulatedMeters(site, MeterErrors(), Channel(loss=0.3, delay_mean_s=1.0, duplicate=0.3), 4)
    ticks = np.arange(-300, 700)
    v, p, q, v0 = truth(ticks.size)
    t = START + ticks
    whole, delivery = meters.read(ticks, v, p, q, v0), meters.deliver(ticks, t)
    for part in (slice(0, 1), slice(290, 310), slice(555, 1000)):
        some = meters.read(ticks[part], v[part], p[part], q[part], v0[part])
        np.testing.assert_array_equal(some.v_volt, whole.v_volt[part])
        again = meters.deliver(ticks[part], t[part])
        np.testing.assert_array_equal(again.arrival, delivery.arrival[part])
        np.testing.assert_array_equal(again.copy, delivery.copy[part])


def test_losses_delays_and_duplicates_have_their_rates() -> None:
    site, ticks = village(), np.arange(20_000)
    channel = Channel(
        loss=0.05, delay_s=0.2, delay_mean_s=0.5, late=0.02, late_s=30.0, duplicate=0.1, clock_s=2.0
    )
    delivery = SimulatedMeters(site, MeterErrors(), channel, 5).deliver(ticks, START + ticks)
    arrived = np.isfinite(delivery.arrival)
    n = arrived.size
    assert abs(1 - arrived.mean() - 0.05) < 5 * np.sqrt(0.05 / n)
    delay = (delivery.arrival - (START + ticks)[:, None])[arrived]
    assert delay.min() >= 0.2 - 1e-6
    late = delay > 20.0
    assert abs(late.mean() - 0.02) < 5 * np.sqrt(0.02 / n)
    prompt = delay[~late] - 0.2
    assert prompt.mean() == pytest.approx(0.5, rel=0.02)
    assert prompt.std() == pytest.approx(0.5, rel=0.03)
    copied = np.isfinite(delivery.copy)
    assert not np.any(copied & ~arrived)
    assert abs(copied[arrived].mean() - 0.1) < 5 * np.sqrt(0.1 / n)
    assert np.all(delivery.copy[copied] >= delivery.arrival[copied])
    clock = delivery.stamp - (START + ticks)[:, None]
    np.testing.assert_allclose(clock, np.broadcast_to(clock[0], clock.shape), atol=1e-6)
    assert np.all(np.abs(clock[0]) <= 2.0)
    assert np.ptp(clock[0]) > 0.5


def test_a_perfect_channel_delivers_at_once() -> None:
    ticks = np.arange(10)
    delivery = SimulatedMeters(village(), MeterErrors(), Channel(), 6).deliver(ticks, START + ticks)
    expected = np.broadcast_to((START + ticks)[:, None], delivery.arrival.shape)
    np.testing.assert_array_equal(delivery.arrival, expected)
    np.testing.assert_array_equal(delivery.stamp, expected)
    assert np.isinf(delivery.copy).all()


def test_silences_silence_their_meter_and_no_other() -> None:
    site, ticks = village(), np.arange(100)
    channel = Channel(
        silences=(MeterOutage("m-c3", START + 20, START + 40), MeterOutage(BUSBAR, START + 90, np.inf))
    )
    arrived = np.isfinite(
        SimulatedMeters(site, MeterErrors(), channel, 7).deliver(ticks, START + ticks).arrival
    )
    expected = np.ones_like(arrived)
    expected[20:40, site.meter_ids.index("m-c3")] = False
    expected[90:, -1] = False
    np.testing.assert_array_equal(arrived, expected)


def test_nonsense_is_refused() -> None:
    with refused(InputInvalid, "unknown-name"):
        SimulatedMeters(village(), MeterErrors(), Channel(silences=(MeterOutage("m-nobody", 0.0, 1.0),)), 0)
    with refused(InputInvalid, "out-of-range"):
        Channel(loss=1.5)
    with refused(InputInvalid, "negative"):
        Channel(late_s=np.inf)
