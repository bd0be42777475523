"""The whole service: real zenoh, real HTTP, real database, virtual meters by full AC power flow."""

from __future__ import annotations

import json
import shutil
import sqlite3
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cbor2
import httpx
import numpy as np
import pytest

from feeders.format.tables import to_json, write
from feeders.model.site import Site, from_tables, load
from feeders.simulation.plant import Channel, MeterOutage
from feeders.simulation.scenario import Scenario, SimulatedTick, random_attacks, simulate
from service.cli.simulate import Pace, key_of, payload_of, play
from service.store import Store
from tests.service.databases import both
from tests.service.running import FEEDER, InProcess, service, until
from tests.service.stored import an_alarm, raised

START = 1_795_212_000.0
STEP = Pace(float("inf"), ahead=3)


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


def run(live: InProcess, site: Site, scenario: Scenario) -> list[SimulatedTick]:
    """Play a scenario in step with the service and wait until it has seen the end."""
    samples = list(play(site, scenario, live.meters, STEP))
    until(lambda: live.state(site.feeder.name).get("t", 0.0) >= samples[-1].t - 2 * scenario.dt_s, "the end")
    return samples


def variant(site: Site, folder: Path, **monitor: Any) -> Site:
    """Write a variant of a feeder into a folder and load it."""
    meta = replace(site.tables.meta, monitor=replace(site.tables.meta.monitor, **monitor))
    write(replace(site.tables, meta=meta), folder)
    return load(folder)


def test_from_readings_to_the_right_alarm_and_back(site: Site, tmp_path: Path) -> None:
    attacks = random_attacks(site, 5, "scaling", 2, 0.03, t_on=START + 20, t_off=START + 40)
    scenario = Scenario(seed=4, start=START, duration_s=80.0, attacks=attacks)
    with service(tmp_path, clock="events") as live:
        events: list[tuple[str, dict[str, Any]]] = []
        listening = threading.Event()
        listener = threading.Thread(target=lambda: _listen(live, events, listening))
        listener.start()
        assert listening.wait(10.0)
        samples = list(play(site, scenario, live.meters, STEP))
        lying = {site.meter_ids[k] for k in np.flatnonzero(samples[25].manipulated)}
        alarms = until(lambda: _all_cleared(live))
        until(lambda: live.state()["t"] >= samples[-1].t - 2.0, "the end")
        assert {a["meter"] for a in alarms} == lying
        assert {a["kind"] for a in alarms} == {"meter-manipulated"}
        for alarm in alarms:
            assert START + 20 <= alarm["t_event"] <= alarm["t_raised"] <= START + 25
            # Released after 12 readings that agree: six are the least, and their mean is not as sharp as the
            # forecast of the unlearned meter. The alarm clears 5 s after that.
            assert START + 40 <= alarm["t_cleared"] <= START + 40 + 12 + 5 + 1
            k = site.meter_ids.index(alarm["meter"])
            true = samples[22].v_volt[site.meters[k]]
            assert alarm["evidence"]["v_volt_estimated"] == pytest.approx(true, abs=0.003 * 230.94)
            assert abs(alarm["evidence"]["attack_volt_estimated"]) > 0.02 * 230.94
        assert live.state()["verdict"] == "clean"
        assert json.loads(live.meters.query(f"{FEEDER}/estimate", 2.0)[f"gridsec/{FEEDER}/estimate"])[
            "t"
        ] >= (samples[-1].t - 2.0)
        assert live.meters.query(f"{FEEDER}/alarm/*", 2.0) == {}
        until(lambda: len([1 for kind, _ in events if kind == "alarm"]) >= 4, "events of both alarms")
        assert [e["change"] for kind, e in events if kind == "alarm"] == ["raised"] * 2 + ["cleared"] * 2
        until(
            lambda: live.metric("gridsec_readings_total", outcome="accepted") >= 14 * 80, "the last readings"
        )
        assert live.metric("gridsec_readings_total") == 14 * 80
        assert live.metric("gridsec_readings_lost_total") == 0
        begin = time.monotonic()
    # It waits for nobody, though the stream is still listened to; a busy machine takes its time.
    assert time.monotonic() - begin < 15.0
    listener.join(20.0)
    assert not listener.is_alive()


def _all_cleared(live: InProcess) -> list[dict[str, Any]]:
    alarms = live.alarms()
    return alarms if alarms and all(a["state"] == "cleared" for a in alarms) else []


def _listen(live: InProcess, events: list[tuple[str, dict[str, Any]]], listening: threading.Event) -> None:
    base = str(live.http.base_url).rstrip("/")
    with httpx.stream("GET", f"{base}/api/v1/alarms/stream", timeout=30.0) as stream:
        kind = ""
        listening.set()
        for line in stream.iter_lines():
            if line.startswith("event:"):
                kind = line[6:].strip()
            elif line.startswith("data:"):
                events.append((kind, json.loads(line[5:])))


def test_acknowledged_published_and_found_by_query(site: Site, tmp_path: Path) -> None:
    attacks = random_attacks(site, 6, "bias", 1, 0.03, t_on=START + 10, t_off=START + 1000)
    with service(tmp_path, clock="events") as live:
        run(live, site, Scenario(seed=4, start=START, duration_s=25.0, attacks=attacks))
        (alarm,) = live.alarms()
        key = f"gridsec/{FEEDER}/alarm/{alarm['id']}"
        assert json.loads(live.meters.query(f"{FEEDER}/alarm/*", 2.0)[key]).items() <= alarm.items()
        incident = f"gridsec/{FEEDER}/incident/{alarm['incident']}"
        event = json.loads(live.meters.query(f"{FEEDER}/incident/*", 2.0)[incident])
        assert (event["change"], event["incident"]["active"], event["notify"]) == ("opened", 1, True)
        answer = live.http.post(f"/api/v1/alarms/{alarm['id']}/ack", json={"who": "Ada", "comment": "seen"})
        assert answer.status_code == 200, answer.text
        assert (answer.json()["state"], answer.json()["acknowledged_by"]) == ("acknowledged", "Ada")
        assert live.alarms() == [alarm | answer.json()]
        until(lambda: json.loads(live.meters.query(f"{FEEDER}/alarm/*", 2.0)[key]) == answer.json())
        again = live.http.post(f"/api/v1/alarms/{alarm['id']}/ack", json={"who": "Bob"})
        assert again.status_code == 409
    with service(tmp_path, clock="events") as live:
        assert live.alarms() == [alarm | answer.json()]
        assert json.loads(live.meters.query(f"{FEEDER}/alarm/*", 2.0)[key]) == answer.json()
        event = json.loads(live.meters.query(f"{FEEDER}/incident/*", 2.0)[incident])
        assert (event["change"], event["who"]) == ("acknowledged", "Ada")


BAD = {
    "syntax": (f"{FEEDER}/meter/m01/reading", b'{"t": 1795212001.0, "v_volt": 230', "application/json"),
    "type": (f"{FEEDER}/meter/m01/reading", b'{"t": "now", "v_volt": "230"}', "application/json"),
    "value": (f"{FEEDER}/meter/m01/reading", b'{"t": 1795212001.0, "v_volt": NaN}', "application/json"),
    "oversize": (f"{FEEDER}/meter/m01/reading", b"x" * (1 << 20), "application/json"),
    "empty": (f"{FEEDER}/concentrator/k1/readings", b"[]", "application/json"),
    "encoding": (f"{FEEDER}/meter/m01/reading", b"1", "image/png"),
    "unknown-meter": (f"{FEEDER}/meter/m99/reading", b'{"t": 1795212001.0, "v_volt": 230}', ""),
    "unknown-feeder": ("nowhere/meter/m01/reading", b'{"t": 1795212001.0, "v_volt": 230}', ""),
    "key": (f"{FEEDER}/meter/*/reading", b'{"t": 1795212001.0, "v_volt": 230}', ""),
    "clock-off": (f"{FEEDER}/meter/m01/reading", b'{"t": 1795912001.0, "v_volt": 230}', ""),
}


def test_nothing_malformed_stops_the_service(site: Site, tmp_path: Path) -> None:
    with service(tmp_path, clock="events") as live:
        run(live, site, Scenario(seed=1, start=START, duration_s=5.0))
        for key, payload, encoding in BAD.values():
            live.put(key, payload, encoding)
        for reason in BAD:
            until(
                lambda reason=reason: live.metric("gridsec_bad_readings_total", reason=reason) == 1.0, reason
            )

        def kept_reasons() -> dict[str, Any]:
            return {r["reason"].partition(":")[0]: r for r in live.rejected()}

        # Readings are counted before they are stored.
        until(lambda: set(kept_reasons()) == set(BAD))
        kept = kept_reasons()
        assert "v_volt = nan" in kept["value"]["reason"]
        assert "t is a string" in kept["type"]["reason"]
        assert "v_volt is a string" in kept["type"]["reason"]
        assert "1048576 bytes" in kept["oversize"]["reason"]
        assert kept["unknown-feeder"]["key"] == "gridsec/nowhere/meter/m01/reading"
        run(live, site, Scenario(seed=1, start=START + 5.0, duration_s=10.0))
        assert live.state()["verdict"] == "clean"
        # Of whatever time the readings are: it has just been made.
        assert live.state()["age_s"] < 60.0
        assert live.http.get("/readyz").status_code == 200
        assert live.alarms() == []


def test_concentrators(site: Site, tmp_path: Path) -> None:
    """A concentrator's columns give the same estimates as single readings."""
    states = []
    for name in ("single", "columns"):
        folder = tmp_path / name
        folder.mkdir()
        with service(folder, clock="events") as live:
            for sample in simulate(site, Scenario(seed=2, start=START, duration_s=5.0)):
                _send(live, sample, together=name == "columns")
            until(lambda live=live: live.state().get("t", 0.0) >= START + 4.0)
            states.append({**live.state(), "age_s": None})
    assert states[0] == states[1]
    assert states[0]["verdict"] == "clean"


def _send(live: InProcess, sample: SimulatedTick, *, together: bool) -> None:
    rows = [r for r in sample.readings if r.meter]
    for r in sample.readings:
        if not (r.meter and together):
            live.put(key_of(FEEDER, r.meter), payload_of(r))
    if together:
        names = ("meter", "t", "seq", "v_volt", "p_kw", "q_kvar")
        columns = {name: [getattr(r, name) for r in rows] for name in names}
        live.put(f"{FEEDER}/concentrator/k1/readings", cbor2.dumps(columns), "application/cbor")


def test_a_silent_meter_is_data_loss_and_never_clean(site: Site, tmp_path: Path) -> None:
    mute = site.meter_ids[4]
    channel = Channel(silences=(MeterOutage(mute, START + 10, START + 40),))
    verdicts = []
    with service(tmp_path, clock="events") as live:
        for sample in play(
            site, Scenario(seed=3, start=START, duration_s=70.0, channel=channel), live.meters, STEP
        ):
            state = live.state()
            if state and sample.t - START > 12:
                verdicts.append((state["t"] - START, state["verdict"]))
        (alarm,) = until(lambda: _all_cleared(live))
    assert (alarm["kind"], alarm["meter"]) == ("data-loss", mute)
    assert START + 20 <= alarm["t_raised"] <= START + 24
    assert START + 40 <= alarm["t_cleared"] <= START + 48
    assert {v for t, v in verdicts if 13 <= t < 39.5} == {"undecided"}
    assert verdicts[-1][1] == "clean"


@pytest.mark.acceptance
def test_readings_every_quarter_of_an_hour(site: Site, tmp_path: Path) -> None:
    slow = variant(site, tmp_path / "slow", tick_s=900.0, on_delay_s=0.0, off_delay_s=900.0)
    start = START - START % 900.0
    attacks = random_attacks(slow, 7, "bias", 2, 0.03, t_on=start + 20 * 900, t_off=start + 40 * 900)
    with service(tmp_path, [str(tmp_path / "slow")], clock="events") as live:
        samples = run(
            live, slow, Scenario(seed=8, start=start, duration_s=60 * 900.0, dt_s=900.0, attacks=attacks)
        )
        lying = {slow.meter_ids[k] for k in np.flatnonzero(samples[25].manipulated)}
        alarms = until(lambda: _all_cleared(live))
        # The first reading alone accuses nobody, and without an on-delay that is said at once.
        assert {a["kind"] for a in alarms if a["meter"] is None} <= {"undecided"}
        assert {a["meter"] for a in alarms if a["kind"] == "meter-manipulated"} == lying
        assert all(a["t_raised"] <= start + 21 * 900 for a in alarms)
        assert live.metric("gridsec_ticks_total", verdict="undecided") <= 3


@pytest.mark.acceptance
def test_wall_clock(site: Site, tmp_path: Path) -> None:
    """Readings in real time: reports follow; old readings are refused."""
    start = float(int(time.time())) + 1.0
    with service(tmp_path) as live:
        assert live.http.get("/healthz").status_code == 200
        time.sleep(max(0.0, start - time.time()))
        for sample in play(site, Scenario(seed=9, start=start, duration_s=60.0), live.meters, Pace(1.0)):
            if sample.t - start >= 5.0 and live.state()["verdict"] == "clean":
                assert sample.t - live.state()["t"] <= 2.0
                break
        else:
            raise AssertionError("not clean within a minute")
        live.put(f"{FEEDER}/meter/m01/reading", {"t": start - 3600.0, "v_volt": 230.0})
        until(lambda: live.metric("gridsec_bad_readings_total", reason="clock-off") == 1.0)
        until(lambda: live.metric("gridsec_report_delay_seconds_count") >= 5)
        # Nobody sends any more: reports go on, and none of them is clean for long.
        until(lambda: live.state()["verdict"] == "undecided", patience_s=10.0)


def test_feeders_over_rest(tmp_path: Path) -> None:
    other = load("kerber-landnetz")
    tables = to_json(other.tables)
    wrong = to_json(other.tables)
    wrong["feeder"]["voltage_volt"] = -1.0
    wrong["customers"][0]["load_kw"] = "much"
    wrong["customers"][1]["bus"] = "nowhere"
    with service(tmp_path, clock="events") as live:
        refused = live.http.put(f"/api/v1/feeders/{other.feeder.name}", json=wrong)
        assert refused.status_code == 422
        assert len(refused.json()["problems"]) >= 3
        wrong["customers"][0]["customer"] = "\ud800"
        unheard = live.http.put(
            f"/api/v1/feeders/{other.feeder.name}",
            content=json.dumps(wrong),
            headers={"Content-Type": "application/json"},
        )
        assert (unheard.status_code, "'\\ud800'" in unheard.json()["detail"]) == (422, True)
        misplaced = live.http.put("/api/v1/feeders/elsewhere", json=tables)
        assert misplaced.status_code == 422
        answer = live.http.put(f"/api/v1/feeders/{other.feeder.name}", json=tables)
        assert answer.status_code == 200, answer.text
    with service(tmp_path, clock="events") as live:
        names = {f["name"] for f in live.get("/api/v1/feeders")["feeders"]}
        assert names == {FEEDER, other.feeder.name}
        run(live, other, Scenario(seed=1, start=START, duration_s=8.0))
        assert live.state(other.feeder.name)["verdict"] == "clean"
        detail = live.get(f"/api/v1/feeders/{other.feeder.name}")
        given = live.http.delete(f"/api/v1/feeders/{FEEDER}")
        assert given.status_code == 409
        assert live.http.delete(f"/api/v1/feeders/{other.feeder.name}").status_code == 204
        assert live.meters.query(f"{other.feeder.name}/estimate", 2.0) == {}
        assert live.http.get(f"/api/v1/feeders/{other.feeder.name}/state").status_code == 404
        assert from_tables(load("kerber-landnetz").tables).digest == other.digest
        assert len(detail["layout"]["parent"]) == len(detail["layout"]["buses"]) == len(other.feeder.buses)


def test_names_given_are_names_of_the_service(tmp_path: Path) -> None:
    with service(tmp_path, clock="events", http_hosts=("grid.example",)) as live:
        asked = [
            live.http.delete(f"/api/v1/feeders/{FEEDER}", headers={"Host": host}).status_code
            for host in ("grid.example:8000", "evil.example:8000")
        ]
        assert asked == [409, 421]


@pytest.mark.acceptance
def test_feeders_over_rest_have_an_end_and_stay_deleted(tmp_path: Path) -> None:
    tables = [to_json(load("kerber-landnetz").tables) for _ in range(3)]
    for k, one in enumerate(tables):
        one["feeder"]["name"] = f"village-{k}"
    with service(tmp_path, clock="events", max_feeders=2) as live:
        answers = [live.http.put(f"/api/v1/feeders/village-{k}", json=one) for k, one in enumerate(tables)]
        assert [answer.status_code for answer in answers] == [200, 200, 409]
        assert "2 feeders" in answers[2].json()["detail"]
        assert live.http.put("/api/v1/feeders/village-0", json=tables[0]).status_code == 200
        assert live.http.delete("/api/v1/feeders/village-1").status_code == 204
        assert live.http.put("/api/v1/feeders/village-2", json=tables[2]).status_code == 200
    with service(tmp_path, clock="events") as live:
        names = {f["name"] for f in live.get("/api/v1/feeders")["feeders"]}
        assert names == {FEEDER, "village-0", "village-2"}


@pytest.mark.acceptance
def test_a_stored_feeder_that_cannot_be_loaded_any_more_is_shown_until_somebody_sees_to_it(
    tmp_path: Path,
) -> None:
    """Two of them, as after an update that has become stricter: one is deleted, one is put again."""
    tables = {}
    with Store(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        for k, name in enumerate(("town", "village")):
            tables[name] = to_json(load("kerber-landnetz").tables)
            tables[name]["feeder"]["name"] = name
            limits = {**tables[name]["feeder"]["limits"], "v_min_pu": "x"}
            store.commit(put=(name, {**tables[name], "feeder": {**tables[name]["feeder"], "limits": limits}}))
            store.commit([raised(an_alarm(k, feeder=name))])
    with service(tmp_path, clock="events") as live:
        ready = live.http.get("/readyz")
        assert ready.status_code == 503
        assert [reason.partition(":")[0] for reason in ready.json()["reasons"]] == [
            "feeder town",
            "feeder village",
        ]
        assert all("v_min_pu" in reason for reason in ready.json()["reasons"])
        shown = {f["name"]: f for f in live.get("/api/v1/feeders")["feeders"]}
        assert [shown[name].get("phase") for name in (FEEDER, "town", "village")] == [
            "watching",
            "failed",
            "failed",
        ]
        assert "v_min_pu" in shown["town"]["problem"]
        state = live.http.get("/api/v1/feeders/town/state")
        assert (state.status_code, "v_min_pu" in state.json()["detail"]) == (503, True)
        assert live.metric("gridsec_alarms_active", feeder="town") == 1.0
        assert len(live.meters.query("town/alarm/*", 2.0)) == 1
        assert live.http.delete("/api/v1/feeders/town").status_code == 204
        assert live.http.put("/api/v1/feeders/village", json=tables["village"]).status_code == 200
        assert live.http.get("/readyz").status_code == 200
        assert [a["state"] for a in live.alarms(feeder="town")] == ["cleared"]
        assert [a["state"] for a in live.alarms(feeder="village")] == ["raised"]
        assert live.http.delete("/api/v1/feeders/town").status_code == 404
    with service(tmp_path, clock="events") as live:
        assert {f["name"] for f in live.get("/api/v1/feeders")["feeders"]} == {FEEDER, "village"}


@pytest.mark.acceptance
def test_alarms_that_the_database_does_not_take_are_not_hidden(site: Site, tmp_path: Path) -> None:
    """While it refuses, the list says that it does not know all, and why."""
    attacks = random_attacks(site, 6, "bias", 1, 0.03, t_on=START + 10, t_off=START + 1000)
    with service(tmp_path, clock="events") as live:
        assert live.get("/api/v1/alarms")["problem"] is None
        other = sqlite3.connect(tmp_path / "gridsec.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        run(live, site, Scenario(seed=4, start=START, duration_s=25.0, attacks=attacks))
        assert live.state()["verdict"] == "attacked"
        first = live.http.get("/api/v1/alarms")
        assert (first.json()["alarms"], first.json()["unstored"]) == ([], 1)
        assert "locked" in first.json()["problem"]
        other.close()
        until(live.alarms, "the alarm")
        again = live.http.get("/api/v1/alarms", headers={"If-None-Match": first.headers["etag"]})
        assert (again.json()["unstored"], again.json()["problem"]) == (0, None)


@pytest.mark.canary("sqlite")
@both
def test_garbage_on_an_odd_key_holds_up_no_alarm(site: Site, url: str, tmp_path: Path) -> None:
    attacks = random_attacks(site, 6, "bias", 1, 0.03, t_on=START + 10, t_off=START + 1000)
    with service(tmp_path, clock="events", database=url) as live:
        live.put(f"{FEEDER}/concentrator/a\0b/readings", b"{\0")
        until(lambda: live.metric("gridsec_bad_readings_total", reason="syntax") == 1.0, "the bad reading")
        run(live, site, Scenario(seed=4, start=START, duration_s=25.0, attacks=attacks))
        (alarm,) = until(live.alarms, "the alarm")
        until(lambda: live.meters.query(f"{FEEDER}/alarm/{alarm['id']}", 2.0), "its publication")
        (kept,) = live.rejected()
        assert kept["key"] == f"gridsec/{FEEDER}/concentrator/a\\x00b/readings"
        assert live.metric("gridsec_store_failures_total") == 0.0


@pytest.fixture
def impossible(site: Site, tmp_path: Path) -> Iterator[Path]:
    """A feeder that asks for more than 13 meters can give: N > 2 M does not hold."""
    meta = replace(site.tables.meta, name="impossible")
    meta = replace(meta, monitor=replace(meta.monitor, estimator="exact-bank", max_attacked=7))
    write(replace(site.tables, meta=meta), tmp_path / "impossible")
    yield tmp_path / "impossible"
    shutil.rmtree(tmp_path / "impossible")


def test_a_feeder_that_cannot_be_watched_is_undecided_and_stops_no_other(
    site: Site, impossible: Path, tmp_path: Path
) -> None:
    with service(tmp_path, [FEEDER, str(impossible)], clock="events") as live:
        run(live, site, Scenario(seed=1, start=START, duration_s=8.0))
        assert live.state()["verdict"] == "clean"
        for r in next(simulate(site, Scenario(seed=1, start=START))).readings:
            live.put(key_of("impossible", r.meter), payload_of(r))
        state = until(lambda: live.state("impossible"))
        assert (state["verdict"], state["cause"]) == ("undecided", "design-invalid")
        ready = live.http.get("/readyz")
        assert ready.status_code == 503
        assert "impossible" in ready.text
        listed = {f["name"]: f for f in live.get("/api/v1/feeders")["feeders"]}
        assert {f["name"]: f["phase"] for f in listed.values()} == {
            FEEDER: "watching",
            "impossible": "failed",
        }
        # M of the design is one number everywhere; that of the file is another one.
        guaranteed, stated = (
            {FEEDER: live.state()["max_attacked"], "impossible": 0},
            {FEEDER: 2, "impossible": 7},
        )
        assert guaranteed[FEEDER] > stated[FEEDER]
        assert state["max_attacked"] == 0
        for one in (*listed.values(), *(live.get(f"/api/v1/feeders/{name}") for name in listed)):
            assert one["max_attacked"] == guaranteed[one["name"]]
            assert one["max_attacked_stated"] == stated[one["name"]]
        before = live.http.get(f"/api/v1/feeders/{FEEDER}")
        known = {"If-None-Match": before.headers["etag"]}
        assert live.http.get(f"/api/v1/feeders/{FEEDER}", headers=known).status_code == 304
