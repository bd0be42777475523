"""Feeders some of whose customers have no meter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from feeders.model.site import Site, from_tables, load, to_frame
from feeders.simulation.scenario import Scenario, SimulatedTick, simulate, snapshots
from gridsec.arrays import Bools
from gridsec.interface import Frame

HOURS = 3600.0 * np.array([3.0, 8.0, 12.5, 18.0, 21.0])


def without(name: str, *customers: str) -> Site:
    """A feeder that comes with the project, these customers without meters."""
    tables = load(name).tables
    rows = tuple(replace(row, meter="") if row.customer in customers else row for row in tables.customers)
    return from_tables(replace(tables, customers=rows))


CIGRE = without("cigre-lv", "Load R15", "Load R16", "Load R17")
"""Three of six customers, at the ends of the feeder; the other three have meters."""


def unmetered(site: Site) -> Bools:
    """Who has no meter, (N,)."""
    out = np.ones(site.feeder.bus.size, dtype=np.bool_)
    out[site.meters] = False
    return out


def played(site: Site, seed: int, duration_s: float) -> Iterator[tuple[SimulatedTick, Frame]]:
    """Some hour of the summer's profiles by AC power flow, and what the service makes of its readings."""
    when = float(HOURS[seed % HOURS.size] + 86400.0 * (seed % 14))
    samples = list(simulate(site, Scenario(seed=seed, duration_s=duration_s, profile_s=when)))
    for sample, snapshot in zip(samples, snapshots(samples), strict=True):
        yield sample, to_frame(site, snapshot)
