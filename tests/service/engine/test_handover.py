"""A new owner continues the stored observer of a feeder, and refuses one that does not fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, simulate
from gridsec.arrays import Floats
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import RECORDS, design
from service.engine.replay import ReplayCounts, replay
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.report.report import to_json
from service.store import Store
from service.store.state_codec import MonitorState, SnapshotKind, StateSnapshot
from tests.service.engine.test_commissioning import START, samples
from tests.service.engine.test_suspicions import Told
from tests.service.running import FEEDER

TAU_S = 6.0
END = 25
"""End of the first service, s after the beginning."""


def watched() -> Site:
    """A feeder with slow inverters: a start takes about ten seconds."""
    tables = load(FEEDER).tables
    rows = (replace(row, tau_s=TAU_S if row.inverter_kva else None) for row in tables.customers)
    return from_tables(replace(tables, customers=tuple(rows)))


@pytest.fixture(scope="module")
def readings() -> list[SimulatedReading]:
    scenario = Scenario(seed=2, start=START, duration_s=END + 30.0)
    return list(by_arrival(simulate(watched(), scenario)))


def feed(live: Engine, some: list[Sample]) -> None:
    """Process samples in rounds shorter than a tick."""
    for k in range(0, len(some), 7):
        live.cycle(some[k : k + 7])


def watching(store: Store, site: Site) -> tuple[Engine, Told]:
    made = Engine(RuntimeConfig(clock=Clock.EVENTS), store, [site], wall=lambda: START, stored=lambda: None)
    made.committer.publisher = told = Told()
    made.monitors[FEEDER].install(design(site))
    made.begin()
    return made, told


@pytest.fixture(scope="module")
def killed(
    readings: list[SimulatedReading], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Site, Told]:
    """Database of a service that was killed, its feeder, and what it published."""
    site, folder = watched(), tmp_path_factory.mktemp("killed")
    with Store(f"sqlite:///{folder}/s.db") as store:
        live, told = watching(store, site)
        feed(live, samples(readings, 0, END))
    return folder, site, told


@pytest.fixture
def left(killed: tuple[Path, Site, Told], tmp_path: Path) -> str:
    """Address of a copy of the database."""
    return f"sqlite:///{shutil.copytree(killed[0], tmp_path / 'copy')}/s.db"


def restarted(url: str, site: Site, some: list[Sample]) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Reports of a restarted service, and its counted starts of the observer by state."""
    with Store(url) as store:
        live, told = watching(store, site)
        feed(live, some)
        found = live.metrics.observers.collect()[0].samples
    starts = {one.labels["state"]: one.value for one in found if one.name.endswith("_total")}
    return told.estimates, starts


def test_the_first_tick_after_a_kill_is_decided(
    killed: tuple[Path, Site, Told], left: str, readings: list[SimulatedReading]
) -> None:
    """The first service needed some seconds for that."""
    _, site, told = killed
    assert told.estimates[0]["cause"] == "settling"
    assert told.verdicts.index("clean") > 1
    said, starts = restarted(left, site, samples(readings, END + 2, END + 12))
    assert [report["verdict"] for report in said[:3]] == ["clean"] * 3
    assert starts == {"resumed": 1.0}
    assert told.estimates[0]["verdict"] == "undecided"


def test_a_replay_with_the_stored_observer_gives_the_same_reports(
    killed: tuple[Path, Site, Told], left: str, readings: list[SimulatedReading]
) -> None:
    _, site, _ = killed
    with Store(left) as store:
        past = MonitorState(store.commission(FEEDER), observer=store.observer(FEEDER))
    later = [one for one in readings if START + END + 2 <= one.t < START + END + 12]
    said, _ = restarted(left, site, samples(readings, END + 2, END + 12))
    results = replay(site, later, ReplayCounts(), past=past)
    assert len(said) >= 8
    assert [json.loads(json.dumps(to_json(one.report))) for one in results][: len(said)] == said


def _text(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[StateSnapshot], StateSnapshot]:
    return lambda kept: replace(kept, text=json.dumps(change(json.loads(kept.text))))


@pytest.mark.parametrize(
    ("spoil", "state"),
    [
        (_text(lambda text: text | {"x": text["x"][:-8]}), "refused"),
        (_text(lambda text: text | {"format": 99}), "refused"),
        (_text(lambda text: text | {"fingerprint": "0" * 32}), "refused"),
        (lambda kept: replace(kept, text=kept.text[:40]), "refused"),
        (_text(lambda text: text | {"t": text["t"] - 60.0}), "old"),
        (_text(lambda text: text | {"t": text["t"] + 60.0}), "old"),
    ],
    ids=["short", "newer", "changed", "torn", "old", "future"],
)
def test_an_unusable_observer_is_counted_and_begins_anew(
    killed: tuple[Path, Site, Told],
    left: str,
    readings: list[SimulatedReading],
    spoil: Callable[[StateSnapshot], StateSnapshot],
    state: str,
) -> None:
    _, site, _ = killed
    later = samples(readings, END + 2, END + 6)
    with Store(left) as store:
        kept = store.observer(FEEDER)
        assert kept is not None
        store.commit(kept=[spoil(kept)])
    said, starts = restarted(left, site, later)
    assert starts == {state: 1.0}
    assert said[0]["cause"] == "settling"


def test_no_observer_is_used_twice(left: str, killed: tuple[Path, Site, Told]) -> None:
    """After a clock was set back, the observer starts without the record of later times."""
    _, site, _ = killed
    with Store(left) as store:
        live, _ = watching(store, site)
        observer, finished = live.monitors[FEEDER].observer, design(site)
        state = finished.init(START + END + 1.0)
        assert observer.restore(state) is not state
        assert observer.restore(state) is state


def test_an_observer_is_stored_a_few_times_per_settling(
    readings: list[SimulatedReading], tmp_path: Path
) -> None:
    """And the newest one at the end."""
    site, times = watched(), []
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        live, told = watching(store, site)
        add = live.committer.waiting.add

        def noted(*, kept: Any = (), **others: Any) -> None:
            times.extend(one.t for one in kept if one.matter is SnapshotKind.OBSERVER)
            add(kept=kept, **others)

        live.committer.waiting.add = noted  # type: ignore[method-assign]
        feed(live, samples(readings, 0, END))
        gaps: Floats = np.diff(times)[1:]
        watcher = design(site)
        memory = watcher.family.observer_memory
        assert memory is not None
        every_s = memory.settling_s(watcher.design) / RECORDS
        assert set(gaps) <= {np.floor(every_s), np.ceil(every_s)}
        assert gaps.mean() == pytest.approx(every_s, rel=0.2)
        live.keep_states(at_once=True)
        live.committer.commit(at_once=True)
        kept = store.observer(FEEDER)
        assert kept is not None
        assert kept.t == told.estimates[-1]["t"]
        assert not live.monitors[FEEDER].observer.due(at_once=True)
        live.remove(FEEDER).result()
        assert store.observer(FEEDER) is None
