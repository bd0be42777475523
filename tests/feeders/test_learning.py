"""What a day of readings teaches of the meters of real feeders: the numbers of docs/operations.md."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.estimators import SEQUENTIAL, Watcher, choose, design
from feeders.load import load
from gridsec.sequential.commission import conclude, nothing, ripe


@pytest.mark.parametrize("name", ["simbench-lv-rural1", "kerber-vorstadtnetz"])
def test_a_day_of_readings_leaves_what_the_operator_is_told(name: str) -> None:
    site = choose(load(name), estimator=SEQUENTIAL)
    made = design(site)
    assert made.learner is not None
    begun = made.learner.commission(made.init(0.0)).learning
    assert begun is not None
    day, every = 86_400.0, np.ones(len(site.meter_ids), dtype=bool)
    gathered = replace(begun, count=86_400 * every.astype(np.intp), time_s=day * every)
    assert ripe(made.design, gathered).all()
    found = conclude(made.design, nothing(made.design), gathered, every, day).learned
    std, allowed = 0.5 * site.feeder.base_volt * np.stack([np.sqrt(found.variance), found.allowed])
    assert 0.07 <= std.min() <= std.max() <= 0.08
    assert 0.18 <= allowed.min() <= allowed.max() <= 0.215
    assert 0.5 * site.feeder.base_volt * made.design.allowed.max() == pytest.approx(1.19, abs=0.005)


def test_families_that_learn_nothing_say_so() -> None:
    site = load("simbench-lv-rural1")
    meta = site.tables.meta
    assert meta.monitor.estimator == SEQUENTIAL
    for other in ("exact-bank", "weighted-least-squares", "set-search"):
        made = design(choose(site, estimator=other))
        assert isinstance(made, Watcher)
        assert made.learner is None
        assert made.init(0.0) is not None
