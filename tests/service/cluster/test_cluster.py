"""A front and workers as processes, over PostgreSQL and zenoh: fail-over after a kill, a freeze and more."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from feeders.format.tables import to_json
from feeders.model.site import Site, load
from service.cli.console import LEASE_LOST
from tests.service.clusters import LIE_VOLT, Process, ServedCluster, Writes, served_cluster
from tests.service.databases import Cluster
from tests.service.failovers import Fault, Trial
from tests.service.running import until

pytestmark = pytest.mark.postgresql

KILLED_S = 6.0
"""Time limit from a kill of a worker until its feeders are judged, s: twice 3 s, for a busy machine."""
FROZEN_S = 15.0
"""Time limit from a freeze of a worker until its feeders are judged, s."""


@pytest.fixture(scope="module")
def site() -> Site:
    return load("cigre-lv")


def shared(live: ServedCluster) -> None:
    """Wait until both workers have feeders, and every one is decided."""
    until(lambda: set(live.owners().values()) == {"w0", "w1"}, "the distribution")
    live.judged_within(live.names, time.time() - 1.0)


def attack(live: ServedCluster, feeder: str) -> dict[str, Any]:
    """Manipulate a meter; the alarm that is raised."""
    meter = live.site.meter_ids[0]
    live.fleet.lies[feeder, meter] = LIE_VOLT
    until(lambda: live.alarms(state="raised", feeder=feeder), "the alarm")
    (alarm,) = live.alarms(feeder=feeder)
    assert (alarm["kind"], alarm["meter"]) == ("meter-manipulated", meter)
    return alarm


def acknowledge(live: ServedCluster, alarm: dict[str, Any]) -> None:
    answer = live.http.post(f"/api/v1/alarms/{alarm['id']}/ack", json={"who": "Ada", "comment": "seen"})
    assert (answer.status_code, answer.json()["acknowledged_by"]) == (200, "Ada")


def suspects(state: dict[str, Any]) -> list[str]:
    return [meter["meter"] for meter in state["meters"] if meter["suspect"]]


def changes(live: ServedCluster, alarm: dict[str, Any]) -> list[str]:
    return [one["change"] for one in live.get(f"/alarms/{alarm['id']}/events")["events"]]


def test_a_killed_workers_feeders_are_judged_again(cluster: Cluster, tmp_path: Path, site: Site) -> None:
    with served_cluster(tmp_path, cluster.database(), site, 2, 2, here=True) as live:
        alarm = attack(live, "copy-0")
        acknowledge(live, alarm)
        before = live.state("copy-0")
        victim = before["owner"]
        gone = live.owned(victim)
        killed = time.time()
        live.workers[victim].send(signal.SIGKILL)
        assert live.judging_within(gone, killed) < KILLED_S
        after = live.state("copy-0")
        assert (after["verdict"], suspects(after)) == ("attacked", suspects(before))
        stream = Events(live, "/feeders/copy-0/stream")
        assert stream.next("state")["owner"] == after["owner"]
        stream.close()
        assert after["owner"] != victim
        assert after["epoch"] > before["epoch"]
        assert [one["id"] for one in live.alarms()] == [alarm["id"]]
        assert changes(live, alarm) == ["raised", "acknowledged"]


@pytest.mark.acceptance
def test_a_frozen_worker_writes_nothing_more_and_ends(cluster: Cluster, tmp_path: Path, site: Site) -> None:
    database = cluster.database()
    with served_cluster(tmp_path, database, site, 4, 2) as live:
        writes = Writes(database)
        shared(live)
        alarm = attack(live, "copy-0")
        victim = live.state("copy-0")["owner"]
        gone = live.owned(victim)
        frozen = time.time()
        live.workers[victim].send(signal.SIGSTOP)
        # Its feeders are undecided, never clean, as soon as the front misses it.
        until(lambda: live.listed()["copy-0"]["status"] == "undecided", "the front's notice", 6.0)
        assert live.judging_within(gone, frozen) < FROZEN_S
        assert writes.of(victim, 0.0) > 0
        continued = time.time()
        live.workers[victim].send(signal.SIGCONT)
        assert live.workers[victim].popen.wait(timeout=10.0) == LEASE_LOST
        assert writes.of(victim, continued) == 0
        assert [one["id"] for one in live.alarms()] == [alarm["id"]]
        assert changes(live, alarm) == ["raised"]


@pytest.mark.acceptance
@pytest.mark.timeout(900)
def test_no_fault_loses_or_doubles_an_alarm(cluster: Cluster, tmp_path: Path, site: Site) -> None:
    with served_cluster(tmp_path, cluster.database(), site, 6, 3) as live:
        trial = Trial(live, cluster, random.Random(1))
        trial.begin()
        faults = [Fault.STOP, Fault.KILL, Fault.FREEZE, Fault.TERMINATE, Fault.ROUTER]
        for fault in (*faults, *trial.rng.sample(faults, 2), Fault.OUTAGE):
            lasted, _ = trial.strike(fault)
            assert lasted < {Fault.STOP: KILLED_S, Fault.KILL: KILLED_S}.get(fault, FROZEN_S), fault
            assert trial.violations == []


@pytest.mark.acceptance
def test_feeders_and_alarms_of_several_workers(cluster: Cluster, tmp_path: Path, site: Site) -> None:
    with served_cluster(tmp_path, cluster.database(), site, 4, 2) as live:
        shared(live)
        # A feeder over REST goes to the owner of its shard, which subscribes to its readings.
        meta = replace(site.tables.meta, name="extra")
        tables = to_json(replace(site.tables, meta=meta))
        answer = live.http.put("/api/v1/feeders/extra", json=tables)
        assert (answer.status_code, answer.json()["name"]) == (200, "extra")
        assert "extra" in live.listed()
        live.fleet.names.append("extra")
        live.judged_within(["extra"], time.time())
        alarms = [attack(live, name) for name in live.names]
        assert len({live.state(one["feeder"])["owner"] for one in alarms}) == 2
        everyone = [one["id"] for one in alarms]
        body = {"who": "Ada", "comment": "seen", "alarms": everyone}
        answer = live.http.post("/api/v1/alarms/ack", json=body)
        assert [one["id"] for one in answer.json()] == everyone
        assert {one["state"] for one in live.alarms()} == {"acknowledged"}
        shelf = {"who": "Ada", "alarm": everyone[0], "duration_s": 60.0, "reason": "known"}
        made = live.http.post("/api/v1/shelves", json=shelf)
        assert made.status_code == 201
        number = made.json()["id"]
        ended = live.http.post(f"/api/v1/shelves/{number}/end", json={"who": "Ada", "comment": "done"})
        assert ended.json()["t_ended"] is not None
        live.fleet.names.remove("extra")
        assert live.http.delete("/api/v1/feeders/extra").status_code == 204
        assert "extra" not in live.listed()
        assert live.http.get("/api/v1/feeders/extra").status_code == 404


@pytest.mark.acceptance
def test_the_streams_of_a_front(cluster: Cluster, tmp_path: Path, site: Site) -> None:
    with served_cluster(tmp_path, cluster.database(), site, 2, 1) as live:
        live.judged_within(live.names, time.time() - 1.0)
        states, alarms = (Events(live, path) for path in ("/feeders/copy-0/stream", "/alarms/stream?after=0"))
        try:
            first, second = states.next("state"), states.next("state")
            assert (first["feeder"], first["owner"]) == ("copy-0", "w0")
            assert second["t"] == first["t"] + 1.0
            alarm = attack(live, "copy-1")
            assert alarms.next("alarm")["alarm"]["id"] == alarm["id"]
            acknowledge(live, alarm)
            assert alarms.next("alarm")["change"] == "acknowledged"
        finally:
            states.close()
            alarms.close()


class Events:
    """A client of one stream of server-sent events."""

    def __init__(self, live: ServedCluster, path: str) -> None:
        self.client = httpx.Client(base_url=live.http.base_url, timeout=20.0)
        self.context = self.client.stream("GET", f"/api/v1{path}")
        self.lines = self.context.__enter__().iter_lines()

    def next(self, kind: str) -> dict[str, Any]:
        """Data of the next event of a kind."""
        seen = ""
        for line in self.lines:
            name, _, value = line.partition(": ")
            if name == "event":
                seen = value
            elif name == "data" and seen == kind:
                return dict(json.loads(value))
        raise AssertionError(f"the stream has ended before {kind}")

    def close(self) -> None:
        self.context.__exit__(None, None, None)
        self.client.close()


@pytest.mark.acceptance
def test_a_front_with_workers_of_its_own(cluster: Cluster, tmp_path: Path, site: Site) -> None:
    with served_cluster(tmp_path, cluster.database(), site, 3, 0, options=("--workers", "2")) as live:
        until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
        alarm = attack(live, "copy-0")
        until(lambda: len(set(live.owners().values())) == 2, "the distribution")
        front = live.front
        assert isinstance(front, Process)
        listed = Path(f"/proc/{front.pid}/task/{front.pid}/children").read_text()
        children = [int(pid) for pid in listed.split()]
        assert len(children) == 2
        os.kill(children[0], signal.SIGKILL)
        live.judging_within(live.names, time.time())
        assert changes(live, alarm) == ["raised"]
        # Metrics of all workers, with the worker as a label.
        lines = live.http.get("/metrics").text.splitlines()
        assert all('worker="' in line for line in lines if line.startswith("gridsec_ticks_total{"))
        live.fleet.ended.set()
        assert front.end() == 0
        assert [pid for pid in children if Path(f"/proc/{pid}").exists()] == []
