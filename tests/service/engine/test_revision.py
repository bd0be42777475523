"""A state says which feeder it is about: meters are not read with the customers of other tables."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from feeders.model.site import Site, from_tables, load
from service.alarms.state_machine import AlarmBook
from service.engine.feeder_monitor import FeederMonitor, align_rules
from service.ingest.align import Clock
from service.ingest.reading import Reading
from service.report.feeder_info import detail
from service.report.report import to_json
from tests.service.played import ingest

FEEDER = "simbench-lv-rural1"
T = 1_795_212_000.0


def swapped(site: Site) -> Site:
    """Two customers have changed meters, which the model's numbers do not show."""
    rows = list(site.tables.customers)
    rows[1], rows[8] = replace(rows[1], meter=rows[8].meter), replace(rows[8], meter=rows[1].meter)
    return from_tables(replace(site.tables, customers=tuple(rows)))


def ticking(site: Site, seconds: float) -> Site:
    meta = site.tables.meta
    monitor = replace(meta.monitor, tick_s=seconds)
    return from_tables(replace(site.tables, meta=replace(meta, monitor=monitor)))


def told(site: Site, grace_s: float | None = None) -> dict[str, Any]:
    """The first state of a feeder whose meters all read."""
    monitor = FeederMonitor(site, align_rules(site, Clock.WALL, grace_s=grace_s), AlarmBook(site.feeder.name))
    monitor.reach(T)
    for meter in (*site.meter_ids, None):
        ingest(monitor, Reading(FEEDER, meter, T, 230.0), T)
    assert monitor.report is not None
    assert monitor.report.revision == detail(site, monitor.patience_s)["revision"]
    return to_json(monitor.report)


def test_the_same_feeder_has_the_same_revision_and_every_other_another() -> None:
    site = load(FEEDER)
    first = told(site)["revision"]
    assert first == told(load(FEEDER))["revision"]
    others = [told(swapped(site)), told(ticking(site, 2.0)), told(site, grace_s=30.0)]
    assert len({first, *(other["revision"] for other in others)}) == 4


def test_a_defect_takes_no_revision_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.engine.feeder_monitor.conditions", lambda _: 1 / 0)
    assert told(load(FEEDER))["revision"] == told(load(FEEDER))["revision"]
