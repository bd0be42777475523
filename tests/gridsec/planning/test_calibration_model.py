"""Regressors and moves against the linear power flow of feeders that really are different."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Floats
from gridsec.grid.radial import Feeder
from gridsec.planning.calibration import Places, PriorUncertainty, Series, lengthened, regressors, steps
from tests.gridsec.planning.small import tree

T = 6


def scene(seed: int) -> tuple[Feeder, Places, Series]:
    """A small feeder without losses, so that everything is exactly linear."""
    feeder, _, meters, _ = tree(seed)
    rng = np.random.default_rng(seed)
    buses = np.arange(len(feeder.buses))
    flow = replace(feeder, bus=buses, customers=tuple(map(str, buses))).linear()
    weight = np.zeros((feeder.bus.size, buses.size))
    weight[np.arange(feeder.bus.size), feeder.bus] = 1.0
    start = feeder.walk.start[:, None]
    behind = (feeder.walk.start[1:] <= start) & (start < feeder.walk.stop[1:])
    one = np.zeros(buses.size, dtype=np.intp), behind.astype(np.float64), weight, meters
    places = Places(2.0 * flow.R, 2.0 * flow.X, *one, np.full(buses.size, 230.0), np.full(meters.size, 230.0))
    p, q = rng.normal(0.0, 0.1, (2, T, feeder.bus.size))
    U = voltages(feeder, p, q)
    y = U[:, feeder.bus[meters]] + rng.normal(0.0, 1e-3, (T, meters.size))
    load = np.abs(p)
    series = Series(
        t=60.0 * np.arange(T),
        y=y,
        seen=rng.random(y.shape) > 0.2,
        p=p,
        q=q,
        load=load,
        roof=0.5 * load,
        steep=np.zeros_like(p),
        places=U,
        drop=(U[:, feeder.parent] - U[:, 1:])[:, None, :],
    )
    return feeder, places, series


def voltages(feeder: Feeder, p: Floats, q: Floats) -> Floats:
    return feeder.bus_voltages(p, q, np.ones(len(p)), steps=0)


@pytest.mark.parametrize("seed", range(3))
def test_moves_and_swaps_are_the_flow_of_the_other_feeder(seed: int) -> None:
    feeder, places, series = scene(seed)
    one, other = int(places.meters[0]), int(places.meters[-1])
    for change in ({one: 3}, {one: int(feeder.bus[other]), other: int(feeder.bus[one])}):
        bus = feeder.bus.copy()
        for customer, new in change.items():
            bus[customer] = new
        after = voltages(replace(feeder, bus=bus), series.p, series.q)[:, bus[places.meters]]
        before = series.places[:, feeder.bus[places.meters]]
        weights = {customer: np.eye(len(feeder.buses))[new] for customer, new in change.items()}
        np.testing.assert_allclose(places.moved(series, weights), after - before, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_who_is_elsewhere_reads_the_volts_of_there(seed: int) -> None:
    """Places of any bases: in volts a move is the other feeder's flow, in the meter's own unit."""
    feeder, places, series = scene(seed)
    volt = np.random.default_rng(seed).uniform(200.0, 260.0, len(feeder.buses))
    unit = volt[feeder.bus[places.meters]]
    places = replace(places, volt=volt, unit=unit)
    one = int(places.meters[0])
    bus = feeder.bus.copy()
    bus[one] = 3
    after = voltages(replace(feeder, bus=bus), series.p, series.q) * volt**2
    before = series.places * volt**2
    there, here = bus[places.meters], feeder.bus[places.meters]
    moved = places.moved(series, {one: np.eye(len(feeder.buses))[3]})
    np.testing.assert_allclose(moved * unit**2, after[:, there] - before[:, here], rtol=1e-10, atol=1e-8)
    plain = replace(places, volt=np.ones_like(volt), unit=np.ones_like(unit))
    for own, same in zip(places.at_meters, plain.at_meters, strict=True):
        np.testing.assert_allclose(own, same, rtol=1e-14)


def test_a_mean_of_phases_of_different_bases() -> None:
    """To first order in what phases differ by; unequal taps alone are no residual."""
    _, places, _ = scene(0)
    volt, count = np.array([230.0, 236.0, 225.0]), places.active.shape[0]
    of_three = replace(places, volt=np.resize(volt, count), unit=np.array([volt.mean()]))
    weight = np.zeros((1, count))
    weight[0, :3] = 1.0 / 3.0
    v = np.ones(count)
    assert of_three.read(weight) @ v**2 == pytest.approx(1.0, abs=1e-14)
    v[:3] += 0.01 * np.array([1.0, -0.5, 0.3])
    exact = (np.mean(volt * v[:3]) / volt.mean()) ** 2
    assert of_three.read(weight) @ v**2 == pytest.approx(exact, abs=1e-4)


def test_a_longer_line_is_its_drop() -> None:
    feeder, places, series = scene(1)
    columns = lengthened(places, series)
    for k in range(feeder.parent.size):
        factor = np.ones(feeder.parent.size)
        factor[k] = 1.3
        longer = replace(feeder, r=feeder.r * factor, x=feeder.x * factor)
        change = voltages(longer, series.p, series.q) - series.places
        np.testing.assert_allclose(0.3 * columns[:, :, k], change[:, feeder.bus[places.meters]], atol=1e-12)


def test_columns_of_powers_are_differences_of_the_flow() -> None:
    feeder, places, series = scene(2)
    count, meters = feeder.bus.size, places.meters.size
    doubts = PriorUncertainty(
        np.ones(meters), *(np.ones(count) for _ in range(6)), np.ones(feeder.parent.size)
    )
    made = regressors(places, series, doubts)
    base = voltages(feeder, series.p, series.q)
    grow = np.zeros((T, count))
    grow[:, 3] = 1.0
    changes = {
        "p_gain": (series.p * grow, 0.0),
        "q_gain": (0.0, series.q * grow),
        "tan": (0.0, -series.load * grow),
        "roof": (0.0, -series.roof * grow),
        "p_level": (grow, 0.0),
        "q_level": (0.0, grow),
    }
    for name, (more_p, more_q) in changes.items():
        after = voltages(feeder, series.p + more_p, series.q + more_q)
        expected = (after - base)[:, feeder.bus[places.meters]] * series.seen
        np.testing.assert_allclose(made.columns[:, :, made.where[name][3]], expected, atol=1e-12)
    midday = np.cos(2.0 * np.pi / 86400.0 * series.t)[:, None]
    first, course = (made.columns[:, :, made.where["roof"][k]] for k in (3, count + 3))
    np.testing.assert_allclose(course, first * midday, atol=1e-12)
    assert not made.columns[~series.seen].any()
    bias = made.columns[:, :, made.where["bias"][1]]
    np.testing.assert_allclose(bias[:, 1], 2.0 * series.y[:, 1] * series.seen[:, 1])
    assert not np.delete(bias, 1, axis=1).any()


def test_steps_cover_all_of_the_time_of_one_meter() -> None:
    _, _, series = scene(0)
    columns, times = steps(series, 2, 3)
    assert not np.delete(columns, 2, axis=1).any()
    np.testing.assert_allclose(columns[:, 2, :3].sum(axis=1), 2.0 * series.y[:, 2] * series.seen[:, 2])
    assert times[0] == (0.0, 60.0)
    assert all(since < until for since, until in times)
