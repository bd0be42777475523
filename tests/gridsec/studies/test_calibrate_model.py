"""Regressors and moves against the linear power flow of feeders that really are different."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Floats
from gridsec.feeder import Feeder, bus_voltages, lindistflow
from gridsec.studies.calibrate_model import Doubts, Places, Series, lengthened, regressors, steps
from tests.gridsec.studies.small import tree

T = 6


def scene(seed: int) -> tuple[Feeder, Places, Series]:
    """A small feeder without losses, so that everything is exactly linear."""
    feeder, _, meters, _ = tree(seed)
    rng = np.random.default_rng(seed)
    buses = np.arange(len(feeder.buses))
    flow = lindistflow(replace(feeder, bus=buses, customers=tuple(map(str, buses))))
    weight = np.zeros((feeder.bus.size, buses.size))
    weight[np.arange(feeder.bus.size), feeder.bus] = 1.0
    start = feeder.start[:, None]
    behind = (feeder.start[1:] <= start) & (start < feeder.stop[1:])
    places = Places(2.0 * flow.R, 2.0 * flow.X, np.zeros(buses.size, dtype=np.intp), behind, weight, meters)
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
    return bus_voltages(feeder, p, q, np.ones(len(p)), steps=0)


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
    doubts = Doubts(np.ones(meters), *(np.ones(count) for _ in range(6)), np.ones(feeder.parent.size))
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
