"""A writer that has lost its lock: it writes nothing more, and its process ends with a code of its own."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import psycopg
import pytest

from service.cli.console import WRITER_LOST
from service.store import Store, StoreUnavailable, WriterLost, connect
from tests.codes import refused
from tests.service.databases import Cluster
from tests.service.running import FEEDER, free_port, service, until
from tests.service.stored import an_alarm, raised

IDLE_S = 2.0
"""Shorter than in a service, so that the tests are, s."""


def terminate(url: str) -> None:
    """End all other sessions of a database."""
    others = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"
    with psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as admin:
        admin.execute(f"{others} AND datname = current_database()")


@pytest.mark.postgresql
def test_a_session_that_was_terminated_writes_no_more(cluster: Cluster) -> None:
    url = cluster.database()
    with Store(url) as store:
        store.commit([raised(an_alarm())])
        assert store.lost is None
        terminate(url)
        # Its heartbeat notices that by itself.
        until(lambda: store.lost, "the loss")
        for _ in range(2):
            with refused(WriterLost, "session-ended"):
                store.commit([raised(an_alarm(1))])
        assert [alarm.id for alarm in store.active()] == [an_alarm().id]


@pytest.mark.postgresql
def test_a_write_notices_the_loss_before_the_heartbeat(cluster: Cluster) -> None:
    url = cluster.database()
    with Store(url) as store:
        terminate(url)
        with refused(WriterLost, "session-ended"):
            store.commit([raised(an_alarm())])
        assert store.active() == []


@pytest.mark.canary("immediate")
@pytest.mark.postgresql
@pytest.mark.parametrize("mode", ["fast", "immediate"])
def test_a_restart_of_the_server_is_no_loss(cluster: Cluster, mode: str) -> None:
    with Store(cluster.database()) as store:
        store.commit([raised(an_alarm())])
        cluster.run("pg_ctl", "-D", cluster.data, "-w", "-m", mode, "stop")
        try:
            with pytest.raises(StoreUnavailable):
                store.commit([raised(an_alarm(1))])
        finally:
            cluster.start()
        store.commit([raised(an_alarm(1))])
        assert store.lost is None


@pytest.mark.postgresql
def test_a_restart_after_which_another_wrote_first_is_a_loss(cluster: Cluster) -> None:
    url = cluster.database()
    with Store(url) as first:
        cluster.stop()
        cluster.start()
        with Store(url) as second:
            second.commit([raised(an_alarm())])
        with refused(WriterLost, "other-writer"):
            first.commit([raised(an_alarm(1))])
        assert [alarm.id for alarm in first.active()] == [an_alarm().id]


def test_an_sqlite_writer_after_another_one(tmp_path: Path) -> None:
    """The lock file is back in its place, and the other process has ended."""
    url, lock, aside = f"sqlite:///{tmp_path}/g.db", tmp_path / "g.db.lock", tmp_path / "aside"
    with Store(url) as first:
        lock.rename(aside)
        with Store(url) as second:
            second.commit([raised(an_alarm())])
        aside.rename(lock)
        with refused(WriterLost, "other-writer"):
            first.commit([raised(an_alarm(1))])
        assert [alarm.id for alarm in first.active()] == [an_alarm().id]


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_a_heartbeat_keeps_an_idle_writer(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connect, "IDLE_S", IDLE_S)
    monkeypatch.setattr(connect, "BEAT_S", 0.25 * IDLE_S)
    with Store(cluster.database()) as store:
        time.sleep(2.0 * IDLE_S)
        store.commit([raised(an_alarm())])
        assert store.lost is None


SERVICE = """
    import sys
    sys.path.insert(0, {tests!r})
    from service.store import connect
    connect.IDLE_S, connect.BEAT_S = {idle_s}, {idle_s} / 4
    from service.cli.main import main
    sys.argv = ["gridsec", "serve", *{arguments!r}]
    main()
"""


@contextmanager
def process(url: str, log: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a service as a process of its own until it answers; kill what is left of it."""
    arguments = ["--feeder", FEEDER, "--database", url, "--http", "127.0.0.1:0"]
    arguments += ["--zenoh-listen", f"tcp/127.0.0.1:{free_port()}"]
    code = SERVICE.format(tests=str(Path.cwd()), idle_s=IDLE_S, arguments=arguments)
    with log.open("w") as errors:
        made = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, stderr=errors, text=True
        )
    try:
        assert made.stdout is not None
        assert made.stdout.readline().startswith("http://"), log.read_text()
        yield made
    finally:
        made.send_signal(signal.SIGCONT)
        made.kill()
        made.communicate()


def settled(url: str) -> int:
    """Return the last event of a database that somebody else writes, read beside it."""
    with psycopg.connect(url.replace("+psycopg", "")) as reader:
        row = reader.execute("SELECT coalesce(max(seq), 0) FROM event").fetchone()
        return 0 if row is None else int(row[0])


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_a_stopped_service_ends_when_it_goes_on_after_the_next_one(cluster: Cluster, tmp_path: Path) -> None:
    url, log = cluster.database(), tmp_path / "log"
    with process(url, log) as first:
        until(lambda: settled(url), "the first alarm")
        first.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        with Store(url) as second:
            # The server has ended the stopped session, and not later than it should.
            assert time.monotonic() - stopped < 3.0 * IDLE_S
            second.commit([raised(an_alarm(1))])
        last = settled(url)
        first.send_signal(signal.SIGCONT)
        assert first.wait(timeout=20.0) == WRITER_LOST, log.read_text()
        assert settled(url) == last
    assert "processes may have written" in log.read_text() or "another process" in log.read_text()
    with Store(url) as third:
        assert an_alarm(1) in third.active()


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_a_service_whose_session_was_terminated_ends(cluster: Cluster, tmp_path: Path) -> None:
    url, log = cluster.database(), tmp_path / "log"
    with process(url, log) as first:
        until(lambda: settled(url), "the first alarm")
        terminate(url)
        assert first.wait(timeout=20.0) == WRITER_LOST, log.read_text()
    with Store(url) as next_one:
        next_one.check()


def test_a_service_whose_lock_file_was_removed_ends(tmp_path: Path) -> None:
    with refused(WriterLost, "lock-moved"), service(tmp_path) as live:
        until(lambda: live.state().get("t"), "the first tick")
        (tmp_path / "gridsec.db.lock").unlink()
        until(lambda: _ended(live.http), "the end")


def _ended(http: httpx.Client) -> bool:
    """Ask for readiness, which writes; say whether there is no service any more."""
    try:
        http.get("/readyz")
    except httpx.TransportError:
        return True
    return False
