"""A feeder served with the estimator `modal`: alarms, restarts, replay equals live."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from feeders.model.site import Site, load
from feeders.registry import MODAL, choose
from feeders.simulation.plant import Channel
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, simulate
from gridsec.attack import Scaling
from gridsec.estimators.modal import record
from gridsec.estimators.modal.monitor import ModalCommission
from service.alarms.state_machine import AlarmKind
from service.engine.commissioning import Stage
from service.engine.replay import ReplayCounts, replay
from service.report.report import to_json
from service.store import Store
from tests.service.engine.test_commissioning import START, feed, known, report_ahead, samples, variant
from tests.service.engine.test_suspicions import Told, stored, watching
from tests.service.running import FEEDER

LIARS = ("m02", "m05", "m09")
LEARNED_S, ONSET_S, END_S = 40.0, 60.0, 90.0
ROUGH = Channel(loss=0.02, delay_mean_s=0.2, late=0.02, late_s=1.5, duplicate=0.02, clock_s=0.1)


@pytest.fixture(scope="module")
def site() -> Site:
    return variant(choose(load(FEEDER), estimator=MODAL), commission_s=LEARNED_S)


@pytest.fixture(scope="module")
def readings(site: Site) -> list[SimulatedReading]:
    """Three meters read 1.5 % too little from a minute on."""
    at = np.array([site.meter_ids.index(meter) for meter in LIARS])
    lie = Scaling(at, START + ONSET_S, START + 1e6, np.full(3, -0.015))
    scenario = Scenario(seed=6, start=START, duration_s=END_S + 20.0, attacks=(lie,), channel=ROUGH)
    return list(by_arrival(simulate(site, scenario)))


@pytest.fixture(scope="module")
def served(
    site: Site, readings: list[SimulatedReading], tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Told]:
    """Database of a service that has learned, has named the liars and has ended, and what it published."""
    url = f"sqlite:///{tmp_path_factory.mktemp('modal')}/s.db"
    with Store(url) as store:
        live, told = watching(store, site)
        feed(live, samples(readings, 0, END_S))
        live.keep_states(at_once=True)
        live.committer.commit(at_once=True)
    return url, told


def test_liars_raise_alarms_and_no_other_meter_does(served: tuple[str, Told]) -> None:
    """One alarm for each, raised after the onset."""
    url, told = served
    assert told.suspects(-1) == LIARS
    assert {meter for k in range(len(told.estimates)) for meter in told.suspects(k)} == set(LIARS)
    with Store(url) as store:
        alarms = [a for a in store.active(FEEDER) if a.kind is AlarmKind.METER_MANIPULATED]
        assert tuple(sorted(str(alarm.meter) for alarm in alarms)) == LIARS
        assert all(alarm.t_raised >= START + ONSET_S for alarm in alarms)


def test_a_replay_gives_the_same_reports(
    site: Site, readings: list[SimulatedReading], served: tuple[str, Told]
) -> None:
    """To the last bit, with late, lost and repeated readings."""
    _, told = served
    some = [one for one in readings if START <= one.t < START + END_S]
    results = list(replay(site, iter(some), ReplayCounts()))
    reports = [json.loads(json.dumps(to_json(each.report))) for each in results]
    same = {report["t"]: report for report in reports}
    assert len(told.estimates) > END_S - 10
    for report in told.estimates:
        assert report == same[report["t"]]


def test_named_meters_and_learned_errors_survive_a_restart(
    site: Site, readings: list[SimulatedReading], served: tuple[str, Told], tmp_path: Path
) -> None:
    """The first report after the restart names the same meters; the posterior of the filter is back."""
    url, _ = served
    copy = shutil.copytree(Path(url.removeprefix("sqlite:///")).parent, tmp_path / "copy")
    with Store(f"sqlite:///{copy}/s.db") as store:
        live, told = watching(store, site)
        before = known(live)
        assert isinstance(before, ModalCommission)
        assert before.kept is not None
        # Recorded before the onset: nothing of the lie is in it.
        assert before.kept.filter.t <= START + ONSET_S + 3.0
        assert live.monitors[FEEDER].commissioning.progress().state is Stage.LEARNED
        feed(live, samples(readings, END_S, END_S + 10.0))
        assert {told.suspects(k) for k in range(len(told.estimates))} == {LIARS}
        live.recommission(FEEDER, [LIARS[0]], "Ada", "new meter").result()
        assert live.monitors[FEEDER].commissioning.progress().state is Stage.LEARNING


@pytest.fixture
def left(served: tuple[str, Told], tmp_path: Path) -> str:
    """A copy of the database of the service that has ended."""
    folder = Path(served[0].removeprefix("sqlite:///")).parent
    return f"sqlite:///{shutil.copytree(folder, tmp_path / 'copy')}/s.db"


def test_a_meter_that_has_become_honest_is_cleared_after_a_restart(site: Site, left: str) -> None:
    """From the restart on all readings are true: 12 of them clear all meters, and the first five none."""
    honest = Scenario(seed=6, start=START, duration_s=END_S + 80.0, channel=ROUGH)
    later = [one for one in by_arrival(simulate(site, honest)) if one.t >= START + END_S]
    with Store(left) as store:
        live, told = watching(store, site)
        feed(live, samples(later, END_S, END_S + 80.0))
        assert told.suspects(0) == LIARS
        assert set(told.verdicts[:5]) == {"attacked"}
        assert told.verdicts[-1] == "clean"
        assert told.suspects(-1) == ()
        assert not [alarm for alarm in store.active(FEEDER) if alarm.active]
        assert stored(store) == []


def test_a_clock_that_is_set_back_clears_no_meter(
    site: Site, readings: list[SimulatedReading], left: str
) -> None:
    with Store(left) as store:
        live, told = watching(store, site)
        feed(live, samples(readings, END_S, END_S + 6.0))
        report_ahead(live)
        feed(live, samples(readings, END_S + 6.0, END_S + 20.0))
        assert {told.suspects(k) for k in range(len(told.estimates))} == {LIARS}


@pytest.mark.parametrize("ticks", [0, 3])
def test_a_replaced_meter_is_trusted_after_a_restart(
    site: Site, readings: list[SimulatedReading], left: str, ticks: int
) -> None:
    """A second restart after the replacement: the new meter has no part of the suspicion."""
    with Store(left) as store:
        live, _ = watching(store, site)
        feed(live, samples(readings, END_S, END_S + ticks))
        live.recommission(FEEDER, [LIARS[1]], "Ada", "new meter").result()
    with Store(left) as store:
        live, told = watching(store, site)
        feed(live, samples(readings, END_S + ticks, END_S + ticks + 4))
        assert told.suspects(0) == (LIARS[0], LIARS[2])


def test_a_record_of_a_removed_estimator_keeps_the_suspects(
    site: Site, readings: list[SimulatedReading], left: str
) -> None:
    """State that `sequential` stored before its removal: learning begins anew, named meters stay suspects."""
    with Store(left) as store:
        learned, suspects = store.commission(FEEDER), store.distrust(FEEDER)
        assert learned is not None
        assert suspects is not None
        text = json.loads(learned.text)
        text["fingerprint"]["estimator"] = "0" * 32
        # Its own arrays are those of the time of commissioning; the record of the filter is of `modal`.
        text["arrays"] = {name: each for name, each in text["arrays"].items() if not record.is_own(name)}
        before = json.loads(suspects.text)
        before["meters"] = [meter | {"scale_s": 15.0, "repeats_s": 100.0} for meter in before["meters"]]
        before["meters"].append({"meter": "m00", "scale_s": 5.0, "named": False, "repeats_s": None})
        before["busbar"] = [{"phase": None, "scale_s": 60.0, "named": False, "off": 0.0}]
        changed = [replace(learned, text=json.dumps(text)), replace(suspects, text=json.dumps(before))]
        store.commit(kept=changed)
    with Store(left) as store:
        live, told = watching(store, site)
        feed(live, samples(readings, END_S, END_S + 4.0))
        progress = live.monitors[FEEDER].commissioning.progress()
        assert (progress.state, progress.restored) == (Stage.LEARNING, False)
        assert "estimator" in progress.note
        assert told.suspects(0) == LIARS
