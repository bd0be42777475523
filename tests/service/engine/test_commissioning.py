"""What was learned of meters is kept, restored where it fits, and begun anew where they were replaced."""

from __future__ import annotations

import asyncio
import json
import os
import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from feeders.format.tables import write
from feeders.model.site import Site, from_tables, load
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, simulate
from gridsec.attack import Scaling
from gridsec.estimators.front import Commission, LearningReason, LearningState
from gridsec.estimators.front.meter_bias import to_arrays
from service.alarms.state_machine import Alarm, AlarmKind, AlarmState, Severity
from service.cli.simulate import Pace, key_of, payload_of, play
from service.engine.commissioning import FeederCommissioning, NothingToLearn, Stage
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.engine.replay import ReplayCounts, replay
from service.engine.runtime import Runtime
from service.ingest.align import Clock
from service.ingest.queues import BusConfig, Sample
from service.ingest.zenoh_bus import MeterClient
from service.report.report import LearningReport, StalledMeter, to_json
from service.store import Store, StoreUnavailable
from service.store.schema import CommissioningChange
from service.store.state_codec import MonitorState
from tests.codes import refused
from tests.service.databases import both
from tests.service.running import FEEDER, InProcess, Outlet, free_port, service, until

START = 1_795_212_000.0
NEEDED = 60.0
STEP = Pace(float("inf"), ahead=3)


def variant(site: Site, **monitor: Any) -> Site:
    """The feeder, watched differently."""
    meta = site.tables.meta
    return from_tables(replace(site.tables, meta=replace(meta, monitor=replace(meta.monitor, **monitor))))


@pytest.fixture(scope="module")
def site() -> Site:
    return variant(load(FEEDER), commission_s=NEEDED)


@pytest.fixture(scope="module")
def honest(site: Site) -> list[SimulatedReading]:
    """A hundred and sixty seconds without a liar."""
    return list(by_arrival(simulate(site, Scenario(seed=1, start=START, duration_s=160.0))))


def samples(readings: list[SimulatedReading], begin: float, end: float) -> list[Sample]:
    return [
        Sample(f"gridsec/{key_of(FEEDER, r.meter)}", payload_of(r), "", r.arrival, 1)
        for r in readings
        if START + begin <= r.t < START + end
    ]


def rounds(store: Store, site: Site, *, install: bool = True) -> Engine:
    made = Engine(RuntimeConfig(clock=Clock.EVENTS), store, [site], wall=lambda: START, stored=lambda: None)
    if install:
        made.monitors[FEEDER].install(design(site))
    made.begin()
    return made


def feed(live: Engine, some: list[Sample]) -> None:
    for k in range(0, len(some), 50):
        live.cycle(some[k : k + 50])


def report_ahead(live: Engine) -> None:
    """Date the latest report to 11 days ahead, as before a clock that is set back."""
    monitor = live.monitors[FEEDER]
    assert monitor.latest is not None
    monitor.latest = replace(monitor.latest, tick=replace(monitor.latest.tick, t=START + 1e6))


def known(live: Engine) -> Commission:
    found = live.monitors[FEEDER].commissioning.known
    assert found is not None
    return found


def same(one: Commission, other: Commission) -> bool:
    a, b = to_arrays(one), to_arrays(other)
    return all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)


# ------------------------------------------------------------------- restarts


@both
def test_what_was_learned_survives_a_restart(site: Site, honest: list[SimulatedReading], url: str) -> None:
    with Store(url) as store:
        live = rounds(store, site)
        feed(live, samples(honest, 0, 70))
        before = known(live)
        assert before.learning is None
        assert [(e.change, len(e.meters)) for e in store.commission_events(FEEDER)] == [
            (CommissioningChange.BEGUN, 13),
            (CommissioningChange.LEARNED, 13),
        ]
    with Store(url) as store:
        live = rounds(store, site)
        assert same(known(live), before)  # to the last bit, before the first tick
        feed(live, samples(honest, 100, 120))
        assert same(known(live), before)
        progress = live.monitors[FEEDER].commissioning.progress()
        assert (progress.state, progress.restored, progress.note) == (Stage.LEARNED, True, "")
        assert len(store.commission_events(FEEDER)) == 2


@both
def test_half_of_a_commissioning_survives_but_for_the_last_interval(
    site: Site, honest: list[SimulatedReading], url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.engine.commissioning.SAVE_S", 10.0)
    with Store(url) as store:
        live = rounds(store, site)
        feed(live, samples(honest, 0, 38))
        kept = store.commission(FEEDER)
        assert kept is not None
        latest = live.monitors[FEEDER].report
        assert latest is not None
        assert latest.t - 10.0 <= kept.t <= latest.t
        # Whoever stops the service properly loses nothing at all.
        live.keep_states(at_once=True)
        live.committer.commit(at_once=True)
        assert (store.commission(FEEDER) or kept).t == latest.t
        gathered = known(live)
    with Store(url) as store:
        live = rounds(store, site)
        assert same(known(live), gathered)
        feed(live, samples(honest, 100, 130))
        progress = live.monitors[FEEDER].commissioning.progress()
        assert progress.state is Stage.LEARNED
        assert gathered.learning is not None
        assert progress.learned_at == pytest.approx(
            START + 100 + NEEDED - gathered.learning.time_s[0], abs=2.0
        )


def test_a_stopped_runtime_keeps_all_that_was_gathered(
    site: Site, honest: list[SimulatedReading], tmp_path: Path
) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store:

        async def run() -> float:
            runtime = Runtime(RuntimeConfig(clock=Clock.EVENTS), store, [site])
            running = asyncio.create_task(runtime.run())
            await _patiently(lambda: runtime.ready()[0])
            runtime.deliver(samples(honest, 0, 20))
            await _patiently(lambda: _tick(runtime) >= START + 18)
            runtime.stop()
            await running
            return _tick(runtime)

        t = asyncio.run(run())
        kept = store.commission(FEEDER)
        assert kept is not None
        assert kept.t >= t


async def _patiently(condition: Callable[[], bool]) -> None:
    await asyncio.to_thread(until, condition)


def _tick(runtime: Runtime) -> float:
    report = runtime.report(FEEDER)
    return 0.0 if report is None else report.t


@contextmanager
def serving(folder: Path, feeder: Path) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    zenoh = f"tcp/127.0.0.1:{free_port()}"
    with (folder / "log").open("a") as log:
        child = subprocess.Popen(
            [sys.executable, "-c", "from service.cli.main import main; main()", "serve",
             "--feeder", str(feeder),
             "--zenoh-listen", zenoh, "--http", "127.0.0.1:0", "--clock", "events",
             "--database", f"sqlite:///{folder / 'gridsec.db'}"],
            stdout=subprocess.PIPE, stderr=log, text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        try:
            assert child.stdout is not None
            url = child.stdout.readline().strip()
            assert url.startswith("http://"), (folder / "log").read_text()
            until(lambda: httpx.get(f"{url}/readyz").status_code == 200)
            yield child, url, zenoh
        finally:
            child.kill()
            child.wait()
            if child.stdout is not None:
                child.stdout.close()


@pytest.mark.acceptance
def test_kill_9_does_not_make_it_forget(site: Site, tmp_path: Path) -> None:
    folder = tmp_path / FEEDER
    write(site.tables, folder)
    path = f"/api/v1/feeders/{FEEDER}/commissioning"
    with serving(tmp_path, folder) as (child, url, zenoh):
        with MeterClient(BusConfig("client", connect=(zenoh,)), "gridsec") as meters:
            for _ in play(site, Scenario(seed=1, start=START, duration_s=75.0), meters, STEP):
                pass
            before = until(lambda: _learned(httpx.get(url + path).json()))
            child.kill()
            child.wait()
        assert before["kept"] >= before["learned_at"]
    with serving(tmp_path, folder) as (_child, url, zenoh):
        after = httpx.get(url + path).json()
        assert after["restored"]
        assert after["meters"] == before["meters"]
        assert after["learned_at"] == before["learned_at"]
    assert "commissioning goes on from what was kept" in (tmp_path / "log").read_text()


def _learned(found: dict[str, Any]) -> dict[str, Any] | None:
    return found if found["state"] == "learned" and found["kept"] else None


# ---------------------------------------------------------------- does it fit?


def _longer(site: Site) -> Site:
    first, *others = site.tables.lines
    return from_tables(replace(site.tables, lines=(replace(first, r_ohm=1.1 * first.r_ohm), *others)))


def _coarser(site: Site) -> Site:
    first = next(k for k, row in enumerate(site.tables.customers) if row.meter)
    rows = list(site.tables.customers)
    rows[first] = replace(rows[first], class_percent=1.0)
    return from_tables(replace(site.tables, customers=tuple(rows)))


CHANGES = {
    "lines": _longer,
    "customers": _coarser,
    "commission_s": lambda site: variant(site, commission_s=90.0),
}


@pytest.mark.parametrize("what", list(CHANGES))
def test_a_changed_feeder_begins_anew_and_says_why(
    site: Site, honest: list[SimulatedReading], tmp_path: Path, what: str
) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        feed(rounds(store, site), samples(honest, 0, 5))
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        live = rounds(store, CHANGES[what](site))
        assert live.monitors[FEEDER].commissioning.progress().state is Stage.WAITING
        feed(live, samples(honest, 100, 110))
        progress = live.monitors[FEEDER].commissioning.progress()
        assert (progress.state, progress.restored) == (Stage.LEARNING, False)
        assert progress.note.endswith(f"the feeder has changed since ({what})")
        assert progress.gathered_s is not None
        assert progress.gathered_s < 10.0
        last = store.commission_events(FEEDER)[-1]
        assert (last.change, last.reason) == (CommissioningChange.BEGUN, progress.note)


def test_a_damaged_text_in_the_database_costs_the_commissioning_and_nothing_else(
    site: Site, honest: list[SimulatedReading], tmp_path: Path
) -> None:
    path = tmp_path / "s.db"
    with Store(f"sqlite:///{path}") as store:
        feed(rounds(store, site), samples(honest, 0, 5))
        kept = store.commission(FEEDER)
    assert kept is not None
    content = json.loads(kept.text)
    content["arrays"]["bias"][3] = 5.0
    with sqlite3.connect(path) as raw:
        raw.execute("UPDATE commission SET data = ?", (json.dumps(content),))
    raw.close()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        feed(live, samples(honest, 10, 20))
        progress = live.monitors[FEEDER].commissioning.progress()
        assert "bias is beyond the class (meters 3)" in progress.note
        assert progress.state is Stage.LEARNING


# ------------------------------------------------------------- replay is live


def test_a_replay_with_what_was_known_is_what_the_restarted_service_said(
    site: Site, honest: list[SimulatedReading], tmp_path: Path
) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        feed(rounds(store, site), samples(honest, 0, 70))
        past = MonitorState(store.commission(FEEDER))
    outlet = Outlet()
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        live = rounds(store, site)
        live.committer.publisher = outlet
        feed(live, samples(honest, 100, 130))
    later = [r for r in honest if START + 100 <= r.t < START + 130]
    told = [json.loads(json.dumps(to_json(r.report))) for r in replay(site, later, ReplayCounts(), past=past)]
    assert len(outlet.estimates) >= 28
    assert told[: len(outlet.estimates)] == outlet.estimates
    # And it matters: without what was learned the numbers are others.
    fresh = [json.loads(json.dumps(to_json(r.report))) for r in replay(site, later, ReplayCounts())]
    assert fresh[5]["meters"] != told[5]["meters"]


def test_a_clock_that_is_set_back_costs_nothing_that_was_learned(
    site: Site, honest: list[SimulatedReading], tmp_path: Path
) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        live = rounds(store, site)
        feed(live, samples(honest, 0, 70))
        before = known(live)
        report_ahead(live)
        feed(live, samples(honest, 70, 80))
        assert same(known(live), before)


# ------------------------------------------------------------ replaced meters


@pytest.mark.acceptance
def test_a_replaced_meter_is_learned_anew_and_the_others_stay(tmp_path: Path) -> None:
    """One reading a minute; the old meter reads 0.45 % too much, the new one 0.1 % too little."""
    slow = variant(load(FEEDER), tick_s=60.0, silence_s=180.0, commission_s=5 * 3600.0)
    hours = 3600.0
    new_meter = Scaling(np.array([4]), START + 6 * hours, START + 1e6, np.array([-0.0055]))
    scenario = Scenario(seed=2, start=START, duration_s=13 * hours, dt_s=60.0, attacks=(new_meter,))
    readings = list(by_arrival(simulate(slow, scenario)))
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        live = rounds(store, slow)
        feed(live, samples(readings, 0, 6 * hours))
        old = known(live).learned
        assert known(live).learning is None
        feed(live, samples(readings, 6 * hours, 7 * hours))
        report = live.monitors[FEEDER].report
        assert report is not None
        named = [k for k, meter in enumerate(report.meters) if meter.suspect]
        assert named == [4], "replaced without a word, it counts as manipulated"
        who = slow.meter_ids[4]
        answer = live.recommission(FEEDER, [who], "Ada", "new meter").result()
        assert {m.meter: m.state for m in answer.meters}[who] == "learning"
        feed(live, samples(readings, 7 * hours, 13 * hours))
        new = known(live).learned
        assert known(live).learning is None
        others = np.arange(len(slow.meter_ids)) != 4
        for name in ("bias", "variance", "allowed", "at"):
            np.testing.assert_array_equal(getattr(new, name)[others], getattr(old, name)[others])
        change, std = new.bias[4] - old.bias[4], np.sqrt(new.variance[4] + old.variance[4])
        assert change == pytest.approx(-2.0 * 0.0055, abs=3.0 * std)
        assert std < 0.003
        assert not [alarm for alarm in store.active(FEEDER) if alarm.active]
        changes = [(e.change, e.who, e.reason, e.meters) for e in store.commission_events(FEEDER)[2:]]
        assert changes == [
            (CommissioningChange.RECOMMISSIONED, "Ada", "new meter", (who,)),
            (CommissioningChange.LEARNED, None, "", (who,)),
        ]


def test_what_cannot_be_stored_is_not_begun(
    site: Site, honest: list[SimulatedReading], tmp_path: Path
) -> None:
    path = tmp_path / "s.db"
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        feed(live, samples(honest, 0, 70))
        before = known(live)
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreUnavailable):
            live.recommission(FEEDER, [], "Ada", "all new").result()
        other.close()
        assert same(known(live), before)
        live.committer.problem = None
        feed(live, samples(honest, 70, 80))
        assert same(known(live), before)
        assert [e.change for e in store.commission_events(FEEDER)] == [
            CommissioningChange.BEGUN,
            CommissioningChange.LEARNED,
        ]


def test_before_the_first_tick_and_where_nothing_is_learned(site: Site, tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        live = rounds(store, site, install=False)
        with refused(NothingToLearn, "no-monitor"):
            live.recommission(FEEDER, [], "Ada", "new").result()
        live.monitors[FEEDER].install(design(site))
        live.recommission(FEEDER, ["m03"], "Ada", "new").result()
        begun = known(live)
        assert begun.learning is not None
        assert begun.learning.open.all()
        never = FeederCommissioning(variant(site, commission_s=0.0))
        never.install(design(variant(site, commission_s=0.0)))
        assert never.progress().state is Stage.OFF
        with refused(NothingToLearn, "learning-off"):
            never.renew(None, [], START, "Ada", "new")


# ------------------------------------------------------------------- stalled


def learning_counts(live: Engine) -> dict[str, float]:
    """Metrics of learning that are not zero, by state and by reason."""
    pattern = re.compile(rf'gridsec_meters_learning(?:_delayed)?{{feeder="{FEEDER}",\w+="([\w-]+)"}} (\S+)')
    found = pattern.findall(live.metrics.exposition().decode())
    assert len(found) == len(LearningState) + len(LearningReason)
    return {name: float(value) for name, value in found if float(value)}


def test_a_stalled_meter_raises_an_alarm_that_ends_when_the_meter_is_learned(
    site: Site, tmp_path: Path
) -> None:
    """Learning takes 61 s: a tick without an interval and 60 more. The alarm is held without a monitor."""
    late, begin, end = site.meter_ids[4], 160.0, 230.0
    scenario = Scenario(seed=1, start=START, duration_s=end)
    readings = [r for r in by_arrival(simulate(site, scenario)) if r.meter != late or r.t >= START + begin]
    url = f"sqlite:///{tmp_path}/s.db"

    def stalled(store: Store) -> list[Alarm]:
        return [a for a in store.alarms()[0] if a.kind is AlarmKind.LEARNING_STALLED]

    with Store(url) as store:
        live = rounds(store, site)
        feed(live, samples(readings, 0, 120))
        assert stalled(store) == []
        feed(live, samples(readings, 120, 140))
        (alarm,) = stalled(store)
        assert (alarm.state, alarm.severity, alarm.meter) == (AlarmState.RAISED, Severity.MINOR, None)
        begun = store.commission_events(FEEDER)[0].t
        assert (alarm.t_event, alarm.t_raised) == (begun + 122.0, begun + 124.0)
        assert late in alarm.reason
        assert alarm.reason.endswith("lost time: silent (1)")
        assert alarm.evidence.learning == (StalledMeter(late, "silent", 0.0),)
        report = live.monitors[FEEDER].report
        assert report is not None
        shown = to_json(report)["meters"]
        assert [m["learning_state"] for m in shown].count("learned") == 12
        assert (shown[4]["learning_state"], shown[4]["learning_reason"]) == ("stalled", "silent")
        progress = live.monitors[FEEDER].commissioning.progress()
        assert (progress.expected_s, progress.stalled) == (61.0, 1)
        one = progress.meters[4]
        assert one.watched_s == report.t - begun
        assert one.lost_s == {"silent": one.watched_s}
        assert learning_counts(live) == {"learned": 12.0, "stalled": 1.0, "silent": 1.0}
        live.keep_states(at_once=True)
        live.committer.commit(at_once=True)
    with Store(url) as store:
        live = rounds(store, site, install=False)
        feed(live, samples(readings, 140, 155))
        blind = live.monitors[FEEDER].report
        assert blind is not None
        assert blind.learning is None
        assert stalled(store) == [alarm]
        live.monitors[FEEDER].install(design(site))
        feed(live, samples(readings, 155, begin + 50))
        assert stalled(store) == [alarm]
        feed(live, samples(readings, begin + 50, end))
        (ended,) = stalled(store)
        learned = known(live).learned.at[4]
        assert learned == pytest.approx(START + begin + NEEDED, abs=2.0)
        assert (ended.id, ended.state) == (alarm.id, AlarmState.CLEARED)
        assert ended.t_cleared == learned + 5.0
        assert learning_counts(live) == {"learned": 13.0}
        live.metrics.count_learning(FEEDER, None)
        assert learning_counts(live) == {"learned": 13.0}
        live.metrics.count_learning(FEEDER, LearningReport())
        assert learning_counts(live) == {}
        live.metrics.forget(FEEDER)
        assert "gridsec_meters_learning{" not in live.metrics.exposition().decode()
        assert "gridsec_meters_learning_delayed{" not in live.metrics.exposition().decode()


def test_a_text_of_an_earlier_version_goes_on(
    site: Site, honest: list[SimulatedReading], tmp_path: Path
) -> None:
    """Without the times that later versions keep: the time that counted stays."""
    path = tmp_path / "s.db"
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        feed(live, samples(honest, 0, 20))
        live.keep_states(at_once=True)
        live.committer.commit(at_once=True)
        before, kept = known(live), store.commission(FEEDER)
    assert kept is not None
    content = json.loads(kept.text)
    later = [name for name in content["arrays"] if name == "watched_s" or name.startswith("lost_s.")]
    assert len(later) == 9
    for name in later:
        del content["arrays"][name]
    with sqlite3.connect(path) as raw:
        raw.execute("UPDATE commission SET data = ?", (json.dumps(content),))
    raw.close()
    with Store(f"sqlite:///{path}") as store:
        progress = rounds(store, site).monitors[FEEDER].commissioning.progress()
        assert (progress.restored, progress.note) == (True, "")
        assert before.learning is not None
        assert [m.gathered_s for m in progress.meters] == before.learning.time_s.tolist()
        assert [m.watched_s for m in progress.meters] == before.learning.time_s.tolist()
        assert {m.learning_state for m in progress.meters} == {"learning"}


# ----------------------------------------------------------------- over HTTP


@pytest.fixture(scope="module")
def live(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Iterator[InProcess]:
    """A service whose feeder has been learned, and another one whose estimator learns nothing."""
    folder = tmp_path_factory.mktemp("live")
    write(site.tables, folder / FEEDER)
    bank = variant(site, estimator="exact-bank")
    meta = replace(bank.tables.meta, name="bank")
    write(replace(bank.tables, meta=meta), folder / "bank")
    with service(folder, (str(folder / FEEDER), str(folder / "bank")), clock="events") as made:
        until(lambda: made.http.get("/readyz").status_code == 200)
        for _ in play(site, Scenario(seed=1, start=START, duration_s=75.0), made.meters, STEP):
            pass
        until(lambda: _learned(made.get(f"/api/v1/feeders/{FEEDER}/commissioning")))
        yield made


def test_rest_tells_what_was_learned(live: InProcess) -> None:
    found = live.get(f"/api/v1/feeders/{FEEDER}/commissioning")
    assert (found["estimator"], found["needed_s"], found["tick_s"]) == ("modal", NEEDED, 1.0)
    assert (found["note"], found["held"], found["restored"]) == ("", False, False)
    assert [m["meter"] for m in found["meters"]] == [f"m{k:02d}" for k in range(1, 14)]
    for meter in found["meters"]:
        assert meter["state"] == "learned"
        assert abs(meter["error_volt"]) <= 0.005 * 1.03 * 230.94 * 1.01
        assert 0.0 < meter["error_volt_std"] < 1.0
        assert 0.0 < meter["allowed_volt"] <= 0.005 * 1.03 * 230.94 * 1.01
        assert (meter["learning_state"], meter["learning_reason"]) == ("learned", None)
        assert (meter["watched_s"], meter["lost_s"]) == (None, {})
    assert (found["expected_s"], found["stalled"]) == (NEEDED + 1.0, 0)
    one = live.get(f"/api/v1/feeders/{FEEDER}/meters/m03")
    assert one["commissioning"] == found["meters"][2]
    assert (one["learning_state"], one["learning_reason"]) == ("learned", None)
    state = live.get(f"/api/v1/feeders/{FEEDER}/state")
    assert {m["learning_state"] for m in state["meters"]} == {"learned"}
    assert live.metric("gridsec_meters_learning", feeder=FEEDER, state="learned") == 13.0
    assert live.metric("gridsec_meters_learning", feeder=FEEDER, state="stalled") == 0.0
    assert live.metric("gridsec_meters_learning_delayed", feeder=FEEDER, reason="silent") == 0.0
    assert live.metric("gridsec_meters_learned", feeder=FEEDER) == 13.0
    listed = {row["name"]: row["commissioning"] for row in live.get("/api/v1/feeders")["feeders"]}
    assert listed == {FEEDER: "learned", "bank": "off"}
    off = live.get("/api/v1/feeders/bank/commissioning")
    assert (off["state"], off["meters"], off["estimator"]) == ("off", [], "exact-bank")
    assert (off["expected_s"], off["stalled"]) == (None, 0)


def _post(live: InProcess, body: Any, feeder: str = FEEDER) -> httpx.Response:
    return live.http.post(f"/api/v1/feeders/{feeder}/commissioning", json=body)


def test_rest_begins_a_replaced_meter_anew(live: InProcess) -> None:
    before = live.get(f"/api/v1/feeders/{FEEDER}/commissioning")
    answer = _post(live, {"who": " Ada ", "reason": "m03 replaced", "meters": ["m03"]})
    assert answer.status_code == 200, answer.text
    after = answer.json()
    assert after == live.get(f"/api/v1/feeders/{FEEDER}/commissioning")
    assert (after["state"], after["gathered_s"]) == ("learning", 0.0)
    changed = [m["meter"] for m, was in zip(after["meters"], before["meters"], strict=True) if m != was]
    assert changed == ["m03"]
    assert (after["meters"][2]["error_volt"], after["meters"][2]["learned_at"]) == (0.0, None)
    assert after["expected"] == after["t"] + NEEDED
    assert (after["meters"][2]["learning_state"], after["meters"][2]["learning_reason"]) == ("waiting", None)
    assert (after["meters"][2]["watched_s"], after["meters"][2]["lost_s"]) == (0.0, {})
    events = live.get(f"/api/v1/feeders/{FEEDER}/commissioning/events")["events"]
    assert [(e["change"], e["who"], e["reason"], e["meters"]) for e in events[-1:]] == [
        ("recommissioned", "Ada", "m03 replaced", ["m03"])
    ]
    assert len(live.get(f"/api/v1/feeders/{FEEDER}/commissioning/events", limit=1)["events"]) == 1


def test_rest_begins_a_whole_feeder_anew(live: InProcess) -> None:
    answer = _post(live, {"who": "Ada", "reason": "other transformer"})
    assert answer.status_code == 200, answer.text
    assert {m["state"] for m in answer.json()["meters"]} == {"learning"}


def test_rest_names_all_problems_at_once(live: InProcess) -> None:
    answer = _post(live, {"reason": " ", "meters": ["m03", "m99", "m03", 5], "more": 1})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    where = {(e["where"], e["what"]) for e in answer.json()["errors"]}
    assert {place for place, _ in where} == {
        "body.who", "body.reason", "body.more", "body.meters.1", "body.meters.2", "body.meters.3",
    }  # fmt: skip
    assert ("body.meters.1", "there is no meter 'm99'") in where
    assert ("body.meters.2", "meter 'm03' occurs twice") in where
    for body in (
        [],
        {"who": "Ada", "reason": "x", "meters": []},
        {"who": "Ada", "reason": "x", "meters": "m03"},
    ):
        assert _post(live, body).status_code == 422


def test_rest_refuses_in_words(live: InProcess) -> None:
    good = {"who": "Ada", "reason": "new"}
    path = f"/api/v1/feeders/{FEEDER}/commissioning"
    assert live.http.post(path, content=b"{", headers={"Content-Type": "application/json"}).status_code == 400
    assert live.http.post(path, content=json.dumps(good)).status_code == 415
    assert _post(live, good, "nowhere").status_code == 404
    assert live.http.get("/api/v1/feeders/nowhere/commissioning").status_code == 404
    answer = _post(live, good, "bank")
    assert answer.status_code == 409
    assert "exact-bank, does not learn" in answer.json()["detail"]
