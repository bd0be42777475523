"""Suspects over a restart: alarms, failed writes, damaged texts, removed meters, other estimators."""

from __future__ import annotations

import json
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load
from feeders.simulation.plant import MeterErrors
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, simulate
from gridsec.attack import Scaling
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.engine.replay import ReplayCounts, replay
from service.ingest.align import Clock
from service.report.report import to_json
from service.store import Store, StoreUnavailable
from service.store.state_codec import MonitorState
from tests.service.engine.test_commissioning import START, feed, samples, variant
from tests.service.running import FEEDER, Outlet

LIARS = ("m01", "m03", "m04", "m09")
END = 40.0
"""When the service ends, s after the beginning; it has named the liars by then."""


def stored(store: Store) -> list[dict[str, Any]]:
    """Suspects in the database."""
    kept = store.distrust(FEEDER)
    assert kept is not None
    return list(json.loads(kept.text)["meters"])


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


@pytest.fixture(scope="module")
def lying(site: Site) -> list[SimulatedReading]:
    """A third of the meters reads 2 % too much."""
    at = np.array([site.meter_ids.index(meter) for meter in LIARS])
    lie = Scaling(at, START + 10.0, START + 1e6, np.full(at.size, 0.02))
    scenario = Scenario(
        seed=3, start=START, duration_s=END + 45.0, attacks=(lie,), errors=MeterErrors(bias=0.0)
    )
    return list(by_arrival(simulate(site, scenario)))


class Told(Outlet):
    """What a service publishes."""

    @property
    def verdicts(self) -> list[str]:
        return [report["verdict"] for report in self.estimates]

    def suspects(self, k: int) -> tuple[str, ...]:
        return tuple(m["meter"] for m in self.estimates[k]["meters"] if m["suspect"])


def watching(store: Store, site: Site) -> tuple[Engine, Told]:
    made = Engine(RuntimeConfig(clock=Clock.EVENTS), store, [site], wall=lambda: START, stored=lambda: None)
    made.committer.publisher = told = Told()
    made.monitors[site.feeder.name].install(design(site))
    made.begin()
    return made, told


def until_the_end(url: str, site: Site, readings: list[SimulatedReading]) -> None:
    """A service that has named the liars, and ends."""
    with Store(url) as store:
        live, told = watching(store, site)
        feed(live, samples(readings, 0, END))
        assert told.suspects(-1) == LIARS
        assert {meter["scale_s"] for meter in stored(store)} == {60.0}


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory, site: Site, lying: list[SimulatedReading]) -> Path:
    """The folder of its database."""
    folder = tmp_path_factory.mktemp("ended")
    until_the_end(f"sqlite:///{folder}/s.db", site, lying)
    return folder


@pytest.fixture
def left(ended: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(ended, tmp_path / "copy")) / "s.db"


@pytest.mark.postgresql
@pytest.mark.parametrize("family", ["postgresql"])
def test_in_postgresql_too(site: Site, lying: list[SimulatedReading], url: str) -> None:
    until_the_end(url, site, lying)
    with Store(url) as store:
        live, told = watching(store, site)
        feed(live, samples(lying, END, END + 5))
        assert told.suspects(0) == LIARS


def test_a_restart_clears_no_true_alarm(site: Site, lying: list[SimulatedReading], left: Path) -> None:
    with Store(f"sqlite:///{left}") as store:
        standing = [alarm.id for alarm in store.active(FEEDER)]
        assert len(standing) == len(LIARS)
        last = store.last_event
        live, told = watching(store, site)
        feed(live, samples(lying, END, END + 40))
        assert set(told.verdicts) == {"attacked"}
        assert {told.suspects(k) for k in range(len(told.estimates))} == {LIARS}
        assert store.last_event == last
        assert [alarm.id for alarm in store.active(FEEDER)] == standing


def test_what_could_not_be_stored_is_not_forgotten(site: Site, left: Path) -> None:
    with Store(f"sqlite:///{left}") as store:
        live, _ = watching(store, site)
        other = sqlite3.connect(left, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreUnavailable):
            live.recommission(FEEDER, [], "Ada", "all new").result()
        other.close()
        assert np.isfinite(live.monitors[FEEDER].suspicions.known.scale_s).sum() == len(LIARS)


def test_a_meter_that_is_gone_is_not_missed(site: Site, lying: list[SimulatedReading], left: Path) -> None:
    gone, *others = LIARS
    rows = tuple(replace(row, meter="" if row.meter == gone else row.meter) for row in site.tables.customers)
    smaller = from_tables(replace(site.tables, customers=rows))
    with Store(f"sqlite:///{left}") as store:
        live, told = watching(store, smaller)
        feed(live, samples([r for r in lying if r.meter != gone], END, END + 4))
        assert told.suspects(0) == tuple(others)


def test_a_damaged_text_costs_the_suspicions_and_nothing_else(
    site: Site, lying: list[SimulatedReading], left: Path
) -> None:
    with sqlite3.connect(left) as raw:
        raw.execute("UPDATE distrust SET data = replace(data, '60.0', '-60.0')")
    raw.close()
    with Store(f"sqlite:///{left}") as store:
        live, told = watching(store, site)
        feed(live, samples(lying, END, END + 1))
        monitor = live.monitors[FEEDER]
        assert "damaged" in monitor.suspicions.note
        assert monitor.commissioning.restored
        assert told.suspects(0) == ()
        assert not any(meter["named"] for meter in stored(store))


def test_a_replay_with_what_was_kept_is_what_the_restarted_service_said(
    site: Site, lying: list[SimulatedReading], left: Path
) -> None:
    later = [r for r in lying if START + END <= r.t < START + END + 20]
    with Store(f"sqlite:///{left}") as store:
        past = MonitorState(store.commission(FEEDER), store.distrust(FEEDER), store.observer(FEEDER))
        live, told = watching(store, site)
        feed(live, samples(later, END, END + 20))
    results = replay(site, later, ReplayCounts(), past=past)
    said = [json.loads(json.dumps(to_json(result.report))) for result in results]
    assert len(told.estimates) >= 18
    assert said[: len(told.estimates)] == told.estimates


def test_another_estimator_begins_as_it_always_did(
    site: Site, lying: list[SimulatedReading], left: Path, tmp_path: Path
) -> None:
    bank = variant(site, estimator="windowed-bank", max_attacked=1)
    said = []
    for path in (left, tmp_path / "new.db"):
        with Store(f"sqlite:///{path}") as store:
            live, told = watching(store, bank)
            feed(live, samples(lying, END, END + 4))
            said.append(told.estimates)
    assert said[0] == said[1]
    assert said[0]
