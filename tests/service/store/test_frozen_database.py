"""Databases that give no answer: judging, probes and acknowledgements while nothing comes back."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from feeders.format.tables import to_json
from feeders.model.site import Site, load
from feeders.simulation.plant import BUSBAR
from service.alarms.state_machine import AlarmState, acknowledged
from service.cli.simulate import key_of
from service.engine.engine import Engine
from service.store import OutcomeUnknown, Rejected, Store, StoreUnavailable, connect
from tests.codes import refused
from tests.service.asking import is_problem
from tests.service.databases import Cluster
from tests.service.running import FEEDER, InProcess, service, until
from tests.service.stored import T0, a_report, an_alarm, raised

FREEZE_S = 9.0
"""Longer than the time limit of a call, and shorter than a test may take, s."""
PROBE_S = 1.0
"""Time limit of `/readyz`, s."""


class Looker:
    """Asks a service for its state and its readiness four times a second, in a thread of its own."""

    def __init__(self, url: str) -> None:
        self.ticks: list[tuple[float, float]] = []
        self.probes: list[tuple[float, float, int, list[str]]] = []
        self._url = url
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Looker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        with httpx.Client(base_url=self._url, timeout=60.0) as http:
            while not self._end.wait(0.25):
                self.ticks.append((time.monotonic(), http.get(f"/api/v1/feeders/{FEEDER}/state").json()["t"]))
                begin = time.monotonic()
                answer = http.get("/readyz")
                took = time.monotonic() - begin
                self.probes.append((begin, took, answer.status_code, answer.json().get("reasons", [])))

    def longest_pause_s(self) -> float:
        """Return the longest time between two new ticks, s."""
        new = [now for k, (now, t) in enumerate(self.ticks) if k == 0 or t > self.ticks[k - 1][1]]
        return max(b - a for a, b in zip(new, [*new[1:], self.ticks[-1][0]], strict=True))


@contextmanager
def watching(folder: Path, url: str) -> Iterator[tuple[InProcess, str]]:
    """Run a service with the wall clock on a database with one alarm that stands."""
    alarm = an_alarm(feeder=FEEDER, meter="m01")
    with Store(url) as store:
        store.commit([raised(alarm)])
    with service(folder, database=url) as live:
        until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
        until(lambda: live.state().get("t"), "the first tick")
        yield live, alarm.id


def acknowledge(live: InProcess, alarm_id: str, **more: Any) -> httpx.Response:
    answer = {"who": "Ada", "comment": "van sent", **more}
    return live.http.post(f"/api/v1/alarms/{alarm_id}/ack", json=answer, timeout=60.0)


def changes(live: InProcess, alarm_id: str) -> list[str]:
    return [event["change"] for event in live.get(f"/api/v1/alarms/{alarm_id}/events")["events"]]


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_an_acknowledgement_in_a_frozen_postgresql_stops_nothing(cluster: Cluster, tmp_path: Path) -> None:
    with watching(tmp_path, cluster.database()) as (live, alarm_id):
        with Looker(str(live.http.base_url)) as looker:
            time.sleep(2.0)
            with cluster.frozen():
                frozen = time.monotonic()
                refused = acknowledge(live, alarm_id)
                took = time.monotonic() - frozen
                time.sleep(max(0.0, FREEZE_S - took))
            time.sleep(2.0)
        assert looker.longest_pause_s() < 3.0
        assert max(took for _, took, _, _ in looker.probes) < PROBE_S
        during = [p for p in looker.probes if frozen + 1.0 < p[0] < frozen + FREEZE_S - 0.5]
        assert len(during) > 3
        assert {status for _, _, status, _ in during} == {503}
        assert all("database" in " ".join(reasons) for _, _, _, reasons in during)
        assert not any("postgresql" in " ".join(reasons) for _, _, _, reasons in during)
        assert took < 11.0
        is_problem(refused, 503)
        until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
        again = acknowledge(live, alarm_id)
        assert again.status_code == 200, again.text
        assert again.json()["acknowledged_by"] == "Ada"
        assert changes(live, alarm_id).count("acknowledged") == 1


class FreezeAtCommit:
    """Freezes the server between the last statement of the next acknowledgement and its COMMIT."""

    def __init__(self, cluster: Cluster) -> None:
        self.done = threading.Event()
        self._frozen = cluster.frozen()
        self._armed = self._seen = False

    def __enter__(self) -> FreezeAtCommit:
        self._armed = True
        sa.event.listen(sa.Engine, "before_cursor_execute", self._execute)
        sa.event.listen(sa.Engine, "commit", self._commit)
        return self

    def __exit__(self, *_: object) -> None:
        sa.event.remove(sa.Engine, "before_cursor_execute", self._execute)
        sa.event.remove(sa.Engine, "commit", self._commit)
        if self.done.is_set():
            self._frozen.__exit__(None, None, None)

    def _execute(self, _connection: object, _cursor: object, statement: str, values: Any, *_: object) -> None:
        if "INSERT INTO event" in statement and "acknowledged" in str(values):
            self._seen = True

    def _commit(self, _connection: object) -> None:
        if self._armed and self._seen:
            self._armed = False
            self._frozen.__enter__()
            self.done.set()


@pytest.mark.postgresql
@pytest.mark.acceptance
def test_a_commit_without_an_answer_is_told_by_its_key(cluster: Cluster) -> None:
    """The server gets the COMMIT and executes it when it goes on."""
    alarm = an_alarm()
    with Store(cluster.database()) as store:
        store.commit([raised(alarm)], key=1)
        answer = acknowledged(alarm, "Ada", "", T0 + 1)
        batch = {"reports": [a_report(T0)], "rejected": [Rejected(T0, "k", "r")], "key": 2}
        with FreezeAtCommit(cluster) as freeze:
            begin = time.monotonic()
            with refused(OutcomeUnknown, "outcome-unknown"):
                store.commit([answer], **batch)
            assert freeze.done.is_set()
            assert time.monotonic() - begin < 7.0
        assert store.commit([answer], **batch) == (2,)
        assert [event.seq for event in store.events(alarm.id)] == [1, 2]
        assert store.alarm(alarm.id) == answer.alarm
        assert len(store.rejected()) == len(store.history("village")) == 1
        assert store.commit([raised(an_alarm(1))], key=3)[0] > 2


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_a_call_before_the_commit_is_not_stored(cluster: Cluster) -> None:
    alarm = an_alarm()
    with Store(cluster.database()) as store:
        with cluster.frozen():
            with refused(StoreUnavailable, "no-answer") as caught:
                store.commit([raised(alarm)], key=1)
            with refused(StoreUnavailable, "read-failed"):
                store.alarm(alarm.id)
        assert not isinstance(caught.value, OutcomeUnknown)
        assert store.alarm(alarm.id) is None
        store.commit([raised(alarm)], key=2)
        assert store.active() == [alarm]


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_an_acknowledgement_of_unknown_outcome_is_repeated(cluster: Cluster, tmp_path: Path) -> None:
    with watching(tmp_path, cluster.database()) as (live, alarm_id):
        with Looker(str(live.http.base_url)) as looker, FreezeAtCommit(cluster):
            begin = time.monotonic()
            unknown = is_problem(acknowledge(live, alarm_id), 503)
            took = time.monotonic() - begin
            # The database is known to be away: refused at once.
            begin = time.monotonic()
            refused = is_problem(acknowledge(live, alarm_id), 503)
            assert time.monotonic() - begin < 2.0
        assert (unknown["outcome"], "(outcome-unknown)" in unknown["detail"]) == ("unknown", True)
        assert "outcome" not in refused or refused["detail"] == unknown["detail"]
        assert took < 11.0
        assert looker.longest_pause_s() < 3.0
        assert max(took for _, took, _, _ in looker.probes) < PROBE_S
        until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
        until(lambda: changes(live, alarm_id).count("acknowledged"), "the acknowledgement")
        again = acknowledge(live, alarm_id)
        assert again.status_code == 200, again.text
        assert is_problem(acknowledge(live, alarm_id, who="Bob"), 409)
        assert changes(live, alarm_id).count("acknowledged") == 1
        assert live.metric("gridsec_transitions_unstored") == 0


@pytest.mark.acceptance
def test_a_locked_sqlite_file_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that hangs, as on a disk that does not answer: there the wait for it has the limit."""
    monkeypatch.setattr(connect, "BUSY_S", 30.0)
    monkeypatch.setattr("service.engine.runtime.COMMAND_S", 3.0)
    path = tmp_path / "g.db"
    with watching(tmp_path, f"sqlite:///{path}") as (live, alarm_id):
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        with Looker(str(live.http.base_url)) as looker:
            begin = time.monotonic()
            answer = is_problem(acknowledge(live, alarm_id), 503)
            assert time.monotonic() - begin < 4.0
            time.sleep(3.0)
        other.close()
        # Sent or still waiting for the write before: unknown, or not stored.
        assert answer.get("outcome", "no") in {"unknown", "no"}
        assert looker.longest_pause_s() < 3.0
        assert max(took for _, took, _, _ in looker.probes) < PROBE_S
        assert {status for _, _, status, _ in looker.probes[2:]} == {503}
        until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
        assert acknowledge(live, alarm_id).status_code == 200
        assert changes(live, alarm_id).count("acknowledged") == 1


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_an_alarm_that_changes_while_its_acknowledgement_is_stored(cluster: Cluster, tmp_path: Path) -> None:
    """It clears by the judging that goes on: what is stored after the acknowledgement still has it."""
    with watching(tmp_path, cluster.database()) as (live, alarm_id):
        silent = until(lambda: live.alarms(kind="data-loss"), "the loss of data")[0]
        assert silent["meter"] is None
        with FreezeAtCommit(cluster):
            is_problem(acknowledge(live, silent["id"]), 503)
            for _ in range(8):
                for meter in silent["evidence"]["silent"][:-1]:
                    live.put(f"{FEEDER}/meter/{meter}/reading", {"t": time.time(), "v_volt": 230.0})
                time.sleep(1.0)
        after = until(lambda: live.alarms(kind="data-loss", state="cleared"), "the clearing")[0]
        assert (after["id"], after["acknowledged_by"]) == (silent["id"], "Ada")
        assert changes(live, silent["id"]) == ["raised", "acknowledged", "cleared"]
        assert alarm_id != silent["id"]


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_a_feeder_is_put_and_deleted_around_a_freeze(cluster: Cluster, tmp_path: Path, site: Site) -> None:
    tables = to_json(site.tables)
    tables = {**tables, "feeder": {**tables["feeder"], "name": "other"}}
    with watching(tmp_path, cluster.database()) as (live, _):
        with cluster.frozen():
            is_problem(live.http.put("/api/v1/feeders/other", json=tables, timeout=60.0), 503)
        until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
        assert live.http.get("/api/v1/feeders/other").status_code == 404
        for _ in range(2):  # put, and replaced
            assert live.http.put("/api/v1/feeders/other", json=tables, timeout=60.0).status_code == 200
            until(lambda: live.state("other").get("t"), "a tick")
        until(lambda: live.alarms(feeder="other", state="raised"), "an alarm")
        with cluster.frozen():
            is_problem(live.http.delete("/api/v1/feeders/other", timeout=60.0), 503)
        until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
        assert live.http.delete("/api/v1/feeders/other", timeout=60.0).status_code == 204
        time.sleep(2.0)
        assert {alarm["state"] for alarm in live.alarms(feeder="other")} == {str(AlarmState.CLEARED)}


@pytest.mark.parametrize("clock", ["wall", "events"])
def test_the_database_is_written_apart_from_judging(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: str
) -> None:
    """Threads of judging and of writing differ with every clock, and what is judged is stored."""
    judging, writing = set[str](), set[str]()
    round_, commit = Engine.cycle, Store.commit

    def judged(self: Engine, *given: Any) -> bool:
        judging.add(threading.current_thread().name)
        return round_(self, *given)

    def stored(self: Store, *given: Any, **more: Any) -> tuple[int, ...]:
        writing.add(threading.current_thread().name)
        return commit(self, *given, **more)

    monkeypatch.setattr(Engine, "cycle", judged)
    monkeypatch.setattr(Store, "commit", stored)
    now = time.time()
    with service(tmp_path, clock=clock) as live:
        for k in range(6):
            for meter in (*load(FEEDER).meter_ids, BUSBAR):
                live.put(key_of(FEEDER, meter), {"t": now + k, "v_volt": 230.0})
        until(lambda: live.get(f"/api/v1/feeders/{FEEDER}/history")["points"], "a stored tick")
    assert judging
    assert writing
    assert not judging & writing
