"""Estimators that learn the fixed errors of the meters, and those that do not."""

from __future__ import annotations

from feeders.model.site import load
from feeders.registry import MODAL, DesignedEstimator, choose, design


def test_families_that_learn_nothing_say_so() -> None:
    site = load("simbench-lv-rural1")
    meta = site.tables.meta
    assert meta.monitor.estimator == MODAL
    assert design(site).bias_learning is not None
    for other in ("exact-bank", "weighted-least-squares", "set-search"):
        made = design(choose(site, estimator=other))
        assert isinstance(made, DesignedEstimator)
        assert made.bias_learning is None
        assert made.init(0.0) is not None
