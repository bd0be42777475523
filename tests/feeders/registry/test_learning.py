"""What a day of readings teaches of the meters of real feeders: the numbers of docs/operations.md."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import from_tables, load
from feeders.registry import MODAL, SEQUENTIAL, DesignedEstimator, choose, design
from gridsec.estimators.sequential.meter_bias import class_only, learn, no_readings, ready_meters


@pytest.mark.parametrize(
    ("name", "least", "most", "change"),
    [("simbench-lv-rural1", 0.145, 0.16, 0.55), ("kerber-vorstadtnetz", 0.085, 0.135, 0.47)],
)
def test_a_day_of_readings_leaves_what_the_operator_is_told(
    name: str, least: float, most: float, change: float
) -> None:
    site = choose(load(name), estimator=SEQUENTIAL)
    made = design(site)
    assert made.bias_learning is not None
    begun = made.bias_learning.commission(made.init(0.0)).learning
    assert begun is not None
    day, every = 86_400.0, np.ones(len(site.meter_ids), dtype=bool)
    gathered = replace(begun, count=86_400 * every.astype(np.intp), time_s=day * every)
    assert ready_meters(made.design, gathered).all()
    found = learn(made.design, class_only(made.design), gathered, every, day).learned
    std, allowed = 0.5 * site.feeder.base_volt * np.stack([np.sqrt(found.variance), found.allowed])
    assert least <= std.min() <= std.max() <= most
    assert 0.25 <= allowed.min() <= allowed.max() <= change
    assert 0.5 * site.feeder.base_volt * made.design.allowed.max() == pytest.approx(1.19, abs=0.005)


def test_errors_that_come_and_go_are_learned_away_and_lasting_ones_are_not() -> None:
    """Power factors that nobody knows are wrong in the same direction all day: a mean does not help."""
    plain = load("kerber-vorstadtnetz").tables
    told = tuple(replace(row, p_std_kw=0.6, q_std_kvar=0.2) for row in plain.customers)
    left = {}
    for name, tables in (("limits", plain), ("told", replace(plain, customers=told))):
        made = design(choose(from_tables(tables), estimator=SEQUENTIAL)).design
        assert made.doubt.lasting == (1.0 if name == "limits" else 0.0)
        day, every = 86_400.0, np.ones(made.allowed.size, dtype=bool)
        gathered = replace(no_readings(every, 0.0), count=86_400 * every.astype(np.intp), time_s=day * every)
        left[name] = learn(made, class_only(made), gathered, every, day).learned.variance
    assert (left["told"] < left["limits"]).all()


def test_families_that_learn_nothing_say_so() -> None:
    site = load("simbench-lv-rural1")
    meta = site.tables.meta
    assert meta.monitor.estimator == MODAL
    assert all(design(choose(site, estimator=name)).bias_learning is not None for name in (MODAL, SEQUENTIAL))
    for other in ("exact-bank", "weighted-least-squares", "set-search"):
        made = design(choose(site, estimator=other))
        assert isinstance(made, DesignedEstimator)
        assert made.bias_learning is None
        assert made.init(0.0) is not None
