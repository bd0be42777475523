"""Answers where several explanations fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gridsec.estimators.modal import monitor
from gridsec.interface import Frame
from tests.gridsec.estimators.modal.streets import prepare
from tests.gridsec.street import make_plant


def test_a_customer_on_the_busbar_is_known_as_well_as_its_meter_reads() -> None:
    """A busbar's meter of class 0.5 among twelve exact ones: what is reported there is that reading."""
    plant = make_plant(
        np.random.default_rng(1), customers=12, drop=0.03, inverters=np.zeros(0, dtype=np.intp)
    )
    bus, rng, none = np.arange(12), np.random.default_rng(2), np.zeros(12)
    plant = replace(
        plant,
        feeder=replace(plant.feeder, bus=bus),
        accuracy=replace(plant.accuracy, busbar_class=0.005),
    )
    made, off = prepare(plant), []
    for _ in range(60):
        v0_squared = (1.0 + 0.005 * rng.uniform(-1.0, 1.0)) ** 2
        y, seen = np.ones(12), np.ones(12, dtype=np.bool_)
        frame = Frame(1.0, y, seen, v0_squared, none, none, none, none, np.full(12, np.nan), none)
        estimate = monitor.step(made, monitor.init(made, 0.0), frame)[1]
        off.append((estimate.v2 - 1.0) / estimate.std)
    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 1.1).all()
