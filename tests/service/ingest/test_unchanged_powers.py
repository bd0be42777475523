"""Powers that stay unchanged beyond `[meters] p_interval_s`, from readings to the report."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.late_powers import site as without_inverters
from feeders.model.site import Site
from feeders.simulation.powerflow import PowerFlow
from gridsec.interface import Cause, Decision
from service.alarms.state_machine import AlarmBook
from service.engine.feeder_monitor import FeederMonitor, align_rules, design
from service.ingest.align import Clock
from service.ingest.reading import Reading

T0 = 1_795_212_000.0
INTERVAL_S, RENEWALS, JITTER_V = 10.0, 40, 0.05


@pytest.fixture(scope="module")
def site() -> Site:
    """Kerber Dorfnetz without inverters."""
    return without_inverters(INTERVAL_S)


@pytest.mark.canary("renewed-agreement", "unchanged-missing-powers")
@pytest.mark.parametrize(
    ("how", "cause"),
    [
        ("renewed", Cause.AGREEMENT),
        ("timed", Cause.AGREEMENT),
        ("unchanged", Cause.MISSING_POWERS),
    ],
)
def test_unchanged_powers_of_all_meters_are_missing_powers(site: Site, how: str, cause: Cause) -> None:
    """Loads of 1 kW, AC power flow. Renewed powers differ in their last digit."""
    watch = FeederMonitor(site, align_rules(site, Clock.EVENTS), AlarmBook(site.feeder.name))
    watch.install(design(site))
    busbar, load = site.tables.meta.voltage_volt, np.ones((1, len(site.tables.customers)))
    rng = np.random.default_rng(1)
    volts, _ = PowerFlow(site).solve_batch(load, 0.2 * load, np.array([busbar]))
    for k in range(round(RENEWALS * INTERVAL_S)):
        kw = 1.0 + 0.001 * (k // round(INTERVAL_S) % 2) if how == "renewed" else 1.0
        stamp = T0 + k if how == "timed" else float("nan")
        read = np.append(volts[0, site.meters], busbar) + JITTER_V * rng.standard_normal(site.meters.size + 1)
        for one, volt in zip((*site.meter_ids, None), read.tolist(), strict=True):
            watch.place(Reading(site.feeder.name, one, T0 + k, volt, kw, t_power=stamp), T0 + k)
    watch.finish()
    results = [watch.judge() for _ in range(len(watch.pending))]
    report = results[-1].report if results else watch.report
    assert report is not None
    assert report.cause is cause
    assert (report.verdict is Decision.CLEAN) == (cause is Cause.AGREEMENT)
