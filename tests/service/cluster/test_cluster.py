"""A front and workers as processes, over PostgreSQL and zenoh: fail-over after a kill, a freeze and more."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import Site, load
from service.cli.console import LEASE_LOST
from tests.service.clusters import LIE_VOLT, Process, ServedCluster, Writes, served_cluster
from tests.service.databases import Cluster
from tests.service.failovers import Fault, Trial
from tests.service.running import until

pytestmark = pytest.mark.postgresql

KILLED_S = 3.0
"""Time limit from a kill of a worker until its feeders are judged, s."""
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
        faults = [Fault.KILL, Fault.FREEZE, Fault.TERMINATE, Fault.ROUTER]
        for fault in (*faults, *trial.rng.sample(faults, 4), Fault.OUTAGE):
            lasted = trial.strike(fault)
            assert lasted < {Fault.KILL: KILLED_S}.get(fault, FROZEN_S), fault
            assert trial.violations == []


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
