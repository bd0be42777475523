"""Backup beside a running service, and restore: alarms are equal; everything else is refused."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from feeders.model.site import load
from feeders.simulation.attacks import random_attacks
from feeders.simulation.scenario import Scenario
from service.cli.simulate import Pace, play
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient
from service.store import Store, StoreUnavailable
from service.store.backup import NEWEST, backup, restore
from service.store.deliveries import DeliveryStore, Position
from tests.service.databases import Cluster, both
from tests.service.running import FEEDER, free_port, until
from tests.service.stored import T0, a_report, an_alarm, raised

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("GRIDSEC_")}


def gridsec(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, timeout=60, check=False, env=ENVIRONMENT
    )


@contextmanager
def serving(folder: Path, database: str) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    zenoh = f"tcp/127.0.0.1:{free_port()}"
    with (
        (folder / "log").open("a") as log,
        subprocess.Popen(
            [*COMMAND, "serve", "--feeder", FEEDER, "--zenoh-listen", zenoh, "--http", "127.0.0.1:0",
             "--clock", "events", "--database", database],
            stdout=subprocess.PIPE, stderr=log, text=True, env=ENVIRONMENT,
        ) as child,
    ):  # fmt: skip
        try:
            assert child.stdout is not None
            url = child.stdout.readline().strip()
            assert url.startswith("http://"), (folder / "log").read_text()
            until(lambda: httpx.get(f"{url}/readyz").status_code == 200)
            yield child, url, zenoh
        finally:
            child.kill()


def alarms(url: str) -> list[dict[str, Any]]:
    return list(httpx.get(f"{url}/api/v1/alarms").json()["alarms"])


@pytest.mark.acceptance
def test_alarms_survive_kill_9_and_restore(tmp_path: Path) -> None:
    site, start = load(FEEDER), 1_795_212_000.0
    attacks = random_attacks(site, 2, "bias", 1, 0.03, t_on=start + 10, t_off=start + 1e6)
    scenario = Scenario(seed=1, start=start, duration_s=30.0, attacks=attacks)
    database, file = f"sqlite:///{tmp_path / 'g.db'}", tmp_path / "copies" / "g.backup"
    with serving(tmp_path, database) as (child, url, zenoh):
        with MeterClient(BusConfig("client", connect=(zenoh,)), "gridsec") as meters:
            for _ in play(site, scenario, meters, Pace(float("inf"), ahead=3)):
                pass
            (alarm,) = until(lambda: alarms(url))
            answer = httpx.post(f"{url}/api/v1/alarms/{alarm['id']}/ack", json={"who": "Ada"})
            assert answer.status_code == 200
            history = httpx.get(f"{url}/api/v1/feeders/{FEEDER}/history").json()["points"]
            done = gridsec("backup", str(file), "--database", database)
            assert (done.returncode, done.stderr) == (0, "")
            assert done.stdout.startswith(f"{file}: {file.stat().st_size} bytes, schema version {NEWEST}\n")
            refused = gridsec("restore", str(file), "--database", database)
            assert refused.returncode == 4
            assert "another process writes it; stop the service first" in refused.stderr
        child.kill()
    other = f"sqlite:///{tmp_path / 'restored.db'}"
    done = gridsec("restore", str(file), "--database", other)
    assert done.returncode == 0, done.stderr
    with serving(tmp_path, other) as (_, url, _zenoh):
        assert alarms(url) == [alarm | answer.json()]
        assert httpx.get(f"{url}/api/v1/feeders/{FEEDER}/history").json()["points"] == history
    again = gridsec("restore", str(file), "--database", other)
    assert again.returncode == 4
    assert "is not empty" in again.stderr


@both
def test_a_backup_beside_a_writer_is_one_state(
    url: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    file = tmp_path / "backup"
    with Store(url) as store:
        store.commit([raised(an_alarm(1))], reports=[a_report(T0)])
        backup(url, file)
        store.commit([raised(an_alarm(2))])
        with pytest.raises(StoreUnavailable, match="another process writes it") as caught:
            restore(url, file)
        assert caught.value.code == "other-writer"
    with pytest.raises(StoreUnavailable, match="is not empty") as caught:
        restore(url, file)
    assert caught.value.code == "not-empty"
    if url.startswith("sqlite"):
        other = f"sqlite:///{tmp_path / 'new' / 'g.db'}"
    else:
        cluster: Cluster = request.getfixturevalue("cluster")
        other = cluster.database()
    restore(other, file)
    with Store(other) as store:
        assert store.alarms()[0] == [an_alarm(1)]
        assert len(store.history("village")) == 1
        store.commit([raised(an_alarm(3))])


def test_keys_and_audit_log_go_along(tmp_path: Path) -> None:
    database, file = tmp_path / "g.db", tmp_path / "backup"
    Store(f"sqlite:///{database}").close()
    with sqlite3.connect(f"{database}.access") as keys:
        keys.execute("CREATE TABLE api_key (id TEXT)")
        keys.execute("INSERT INTO api_key VALUES ('k1')")
    keys.close()
    Path(f"{database}.access").chmod(0o600)
    assert [copy.name for copy in backup(f"sqlite:///{database}", file)] == [str(file), f"{file}.access"]
    restored = tmp_path / "restored.db"
    restore(f"sqlite:///{restored}", file)
    found = Path(f"{restored}.access")
    assert found.stat().st_mode & 0o777 == 0o600
    with sqlite3.connect(found) as keys:
        assert keys.execute("SELECT id FROM api_key").fetchall() == [("k1",)]
    keys.close()
    restored.unlink()
    with pytest.raises(StoreUnavailable, match=r"\.access exists; move it away first"):
        restore(f"sqlite:///{restored}", file)
    # A backup of a database without keys has none of an earlier one.
    Path(f"{database}.access").unlink()
    backup(f"sqlite:///{database}", file)
    assert not Path(f"{file}.access").exists()


def test_positions_of_notifications_go_along(tmp_path: Path) -> None:
    database, file = f"sqlite:///{tmp_path}/g.db", tmp_path / "backup"
    Store(database).close()
    with DeliveryStore(database) as store:
        store.keep("hook", Position(7))
    assert [copy.name for copy in backup(database, file)] == [str(file), f"{file}.notify"]
    restore(f"sqlite:///{tmp_path}/new.db", file)
    with DeliveryStore(f"sqlite:///{tmp_path}/new.db") as store:
        assert store.positions() == {"hook": Position(7)}


def test_what_is_no_backup_is_refused(tmp_path: Path) -> None:
    good, target = tmp_path / "good", f"sqlite:///{tmp_path / 'target.db'}"
    Store(f"sqlite:///{tmp_path / 'g.db'}").close()
    backup(f"sqlite:///{tmp_path / 'g.db'}", good)
    notes, foreign, newer = tmp_path / "notes", tmp_path / "foreign", tmp_path / "newer"
    notes.write_text("notes")
    newer.write_bytes(good.read_bytes())
    for path, change in ((foreign, "CREATE TABLE t (x)"), (newer, "UPDATE schema_version SET version = 99")):
        with sqlite3.connect(path) as connection:
            connection.execute(change)
        connection.close()
    for path, code in ((notes, "not-a-backup"), (foreign, "not-a-backup"), (newer, "newer-schema")):
        with pytest.raises(StoreUnavailable) as caught:
            restore(target, path)
        assert caught.value.code == code
    damaged = bytearray(good.read_bytes())
    damaged[4096:] = b"\xff" * (len(damaged) - 4096)
    good.write_bytes(damaged)
    with pytest.raises(StoreUnavailable):
        restore(target, good)
    assert not (tmp_path / "target.db").exists()
    (tmp_path / "target.db-wal").write_bytes(b"remains")
    with pytest.raises(StoreUnavailable, match=r"target\.db-wal is not empty"):
        restore(target, newer)
    with pytest.raises(StoreUnavailable, match="no such file"):
        backup(f"sqlite:///{tmp_path / 'nothing.db'}", tmp_path / "out")


@pytest.mark.postgresql
def test_a_server_needs_its_tools(cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url, file = cluster.database(), tmp_path / "backup"
    with pytest.raises(StoreUnavailable, match="is not a database of gridsec"):
        backup(url, file)
    Store(url).close()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(StoreUnavailable, match="pg_dump is not installed") as caught:
        backup(url, file)
    assert caught.value.code == "no-tool"
    assert not file.exists()
    (tmp_path / "pg_dump").symlink_to(Path("/bin/false").resolve())
    with pytest.raises(StoreUnavailable) as caught:
        backup(url, file)
    assert caught.value.code == "tool-failed"
