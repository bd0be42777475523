"""Who was not believed is not believed after a restart either, until there is something to judge by."""

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
from feeders.registry import SEQUENTIAL, choose
from feeders.simulation.plant import MeterErrors
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, simulate
from gridsec.attack import Scaling
from gridsec.estimators.sequential import Commission, to_arrays
from gridsec.estimators.sequential.meter_bias import class_only
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.engine.replay import ReplayCounts, replay
from service.ingest.align import Clock
from service.report.report import to_json
from service.store import Store, StoreUnavailable
from service.store.state_codec import MonitorState, StateSnapshot, encode, fingerprint
from tests.service.engine.test_commissioning import START, feed, report_ahead, samples, variant
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
    """The feeder watched by `sequential`: time scales of suspects are its own. `modal`: test_modal.py."""
    return choose(load(FEEDER), estimator=SEQUENTIAL)


@pytest.fixture(scope="module")
def learned(site: Site) -> StateSnapshot:
    """What a long commissioning leaves of meters without fixed errors: a tenth of the class is allowed."""
    made = design(site).design
    known = class_only(made)
    small = replace(
        known,
        variance=0.01 * known.variance,
        allowed=0.1 * known.allowed,
        at=np.full(known.at.size, START - 1e5),
    )
    return encode(site, fingerprint(site), START - 1.0, to_arrays(Commission(small, None)))


def _readings(site: Site, until: float) -> list[SimulatedReading]:
    """A third of the meters reads 0.2 % too much, well inside their class."""
    at = np.array([site.meter_ids.index(meter) for meter in LIARS])
    lie = Scaling(at, START + 3.0, START + until, np.full(at.size, 0.002))
    scenario = Scenario(
        seed=3, start=START, duration_s=END + 45.0, attacks=(lie,), errors=MeterErrors(bias=0.0)
    )
    return list(by_arrival(simulate(site, scenario)))


@pytest.fixture(scope="module")
def lying(site: Site) -> list[SimulatedReading]:
    return _readings(site, 1e6)


@pytest.fixture(scope="module")
def honest(site: Site) -> list[SimulatedReading]:
    """They stop when the service ends."""
    return _readings(site, END)


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


def until_the_end(url: str, site: Site, learned: StateSnapshot, readings: list[SimulatedReading]) -> None:
    """A service that has named the liars, and ends."""
    with Store(url) as store:
        store.commit(kept=[learned])
        live, told = watching(store, site)
        feed(live, samples(readings, 0, END))
        assert told.suspects(-1) == LIARS
        # On means over many ticks, which are empty after a restart.
        assert {meter["scale_s"] for meter in stored(store)} == {15.0}


@pytest.fixture(scope="module")
def ended(
    tmp_path_factory: pytest.TempPathFactory,
    site: Site,
    learned: StateSnapshot,
    lying: list[SimulatedReading],
) -> Path:
    """The folder of its database."""
    folder = tmp_path_factory.mktemp("ended")
    until_the_end(f"sqlite:///{folder}/s.db", site, learned, lying)
    return folder


@pytest.fixture
def left(ended: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(ended, tmp_path / "copy")) / "s.db"


@pytest.mark.postgresql
@pytest.mark.parametrize("family", ["postgresql"])
def test_in_postgresql_too(
    site: Site, learned: StateSnapshot, lying: list[SimulatedReading], url: str
) -> None:
    until_the_end(url, site, learned, lying)
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


def test_who_has_become_honest_meanwhile_is_cleared(
    site: Site, honest: list[SimulatedReading], left: Path
) -> None:
    with Store(f"sqlite:///{left}") as store:
        live, told = watching(store, site)
        feed(live, samples(honest, END, END + 40))
        first = told.verdicts.index("clean")
        # Four fifths of fifteen readings, and six without evidence.
        assert set(told.verdicts[:first]) == {"attacked"}
        assert 12 <= first <= 12 + 6 + 2
        assert set(told.verdicts[first:]) == {"clean"}
        assert not [alarm for alarm in store.active(FEEDER) if alarm.active]
        assert stored(store) == []


@pytest.mark.parametrize("ticks", [0, 3])
def test_a_replaced_meter_is_believed(
    site: Site, lying: list[SimulatedReading], left: Path, ticks: int
) -> None:
    with Store(f"sqlite:///{left}") as store:
        live, _ = watching(store, site)
        feed(live, samples(lying, END, END + ticks))
        live.recommission(FEEDER, [LIARS[1]], "Ada", "new meter").result()
    with Store(f"sqlite:///{left}") as store:
        live, told = watching(store, site)
        feed(live, samples(lying, END + ticks, END + ticks + 4))
        assert told.suspects(0) == (LIARS[0], *LIARS[2:])


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
        raw.execute("UPDATE distrust SET data = replace(data, '15.0', '-15.0')")
    raw.close()
    with Store(f"sqlite:///{left}") as store:
        live, told = watching(store, site)
        feed(live, samples(lying, END, END + 4))
        monitor = live.monitors[FEEDER]
        assert "damaged" in monitor.suspicions.note
        assert monitor.commissioning.restored
        assert told.suspects(0) == ()
        assert stored(store) == []


def test_a_clock_that_is_set_back_clears_nobody(
    site: Site, lying: list[SimulatedReading], left: Path
) -> None:
    with Store(f"sqlite:///{left}") as store:
        live, told = watching(store, site)
        feed(live, samples(lying, END, END + 6))
        report_ahead(live)
        feed(live, samples(lying, END + 6, END + 40))
        assert {told.suspects(k) for k in range(len(told.estimates))} == {LIARS}


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
