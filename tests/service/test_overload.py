"""Overload, leaps of the clock and signals: real zenoh sessions, the real service, real time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest

from feeders.format.tables import write
from feeders.model.site import Site, load
from feeders.simulation.plant import BUSBAR
from feeders.simulation.scenario import Scenario, SimulatedReading, simulate
from service.cli.simulate import key_of
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient
from tests.service.databases import Cluster
from tests.service.running import FEEDER, InProcess, free_port, service, until

HOURS = 7200.0
STOP_S = 3.0
RECOVERY_S = 10.0


class Fleet(threading.Thread):
    """All meters of feeders, each at `hertz` readings per second, at a clock that may be set."""

    def __init__(self, zenoh: str, site: Site, names: list[str], wall: Any = time.time) -> None:
        super().__init__(daemon=True)
        self.zenoh, self.names, self.wall = zenoh, names, wall
        self.hertz, self.sent = 1.0, 0
        self.ended = threading.Event()
        self.samples = [s.readings for s in simulate(site, Scenario(seed=1, duration_s=60.0, dt_s=1.0))]

    def run(self) -> None:
        with MeterClient(BusConfig("client", connect=(self.zenoh,)), "gridsec") as meters:
            due = time.monotonic()
            for number in count():
                readings = self.samples[int(self.wall()) % len(self.samples)]
                for reading in readings:
                    for name in self.names:
                        if self.ended.is_set():
                            return
                        self._put(meters, name, reading, number)
                due = max(due + 1.0 / self.hertz, time.monotonic() - 0.1)
                time.sleep(max(0.0, due - time.monotonic()))

    def _put(self, meters: MeterClient, name: str, reading: SimulatedReading, number: int) -> None:
        fields = {"t": self.wall(), "v_volt": reading.v_volt + 1e-4 * (number % 100)}
        if reading.meter != BUSBAR:
            fields["p_kw"] = reading.p_kw or 0.0
        meters.put(key_of(name, reading.meter), json.dumps(fields).encode())
        self.sent += 1


@contextmanager
def fleet(zenoh: str, site: Site, names: list[str], wall: Any = time.time) -> Iterator[Fleet]:
    meters = Fleet(zenoh, site, names, wall)
    meters.start()
    try:
        yield meters
    finally:
        meters.ended.set()
        meters.join(10.0)


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


def copies(site: Site, folder: Path, number: int) -> list[str]:
    names = [f"copy-{k}" for k in range(number)]
    for name in names:
        write(replace(site.tables, meta=replace(site.tables.meta, name=name)), folder / name)
    return names


def judged(live: InProcess, name: str) -> dict[str, Any]:
    """The state if all its meters are seen, it is CLEAN and not stale."""
    state = live.state(name)
    good = bool(state) and state["verdict"] == "clean" and all(meter["seen"] for meter in state["meters"])
    return state if good and state["age_s"] < 5.0 else {}


def used(live: InProcess) -> float:
    lines = live.http.get("/metrics").text.splitlines()
    return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith("gridsec_readings_total"))


@pytest.mark.acceptance
def test_three_times_what_is_sustained_is_judged_and_over_within_ten_seconds(
    tmp_path: Path, site: Site
) -> None:
    names = copies(site, tmp_path, 3)
    with (
        service(tmp_path, [str(tmp_path / name) for name in names]) as live,
        fleet(live.zenoh, site, names) as meters,
    ):
        until(lambda: all(judged(live, name) for name in names), "a verdict of every feeder")
        # As fast as the fleet can: what is used of it is what the service can take.
        meters.hertz = 1e6
        time.sleep(1.0)
        begun, before = time.monotonic(), used(live)
        time.sleep(2.0)
        rate = (used(live) - before) / (time.monotonic() - begun)
        meters.hertz = 3.0 * rate / (len(names) * (len(site.meter_ids) + 1))
        before_ticks = {name: live.state(name)["t"] for name in names}
        time.sleep(4.0)
        for name in names:
            state = live.state(name)
            assert state["t"] > before_ticks[name]
            assert any(meter["seen"] for meter in state["meters"])
        meters.hertz, begun = 1.0, time.monotonic()
        until(lambda: all(judged(live, name) for name in names), "recovery", RECOVERY_S)
        assert time.monotonic() - begun < RECOVERY_S


@pytest.mark.canary("7200.0")
@pytest.mark.parametrize("leap_s", [HOURS, -HOURS])
def test_a_leap_of_two_hours_is_over_within_ten_seconds(tmp_path: Path, site: Site, leap_s: float) -> None:
    shift = [0.0]

    def wall() -> float:
        return time.time() + shift[0]

    with service(tmp_path, wall=wall) as live, fleet(live.zenoh, site, [FEEDER], wall) as meters:
        until(lambda: judged(live, FEEDER), "a verdict")
        standing = live.alarms(state="raised")
        shift[0], begun = leap_s, time.time()

        def after() -> bool:
            state = live.state()
            # A report from before the leap is never one of now.
            assert state["age_s"] >= abs(leap_s) / 2 or abs(state["t"] - wall()) < 60.0 or leap_s < 0
            return abs(state["t"] - begun - leap_s) < 60.0 and bool(judged(live, FEEDER))

        until(after, "a verdict after the leap", RECOVERY_S)
        summary = live.get("/api/v1/feeders")["feeders"][0]
        skipped = live.metric("gridsec_ticks_skipped_total", feeder=FEEDER)
        assert summary["ticks_skipped"] == skipped
        assert (skipped > HOURS - 100.0) is (leap_s > 0)
        assert live.alarms(state="raised") == standing
        assert meters.is_alive()


LEAPING = """
import asyncio, os, sys, time
from service.app import serve
from service.engine.design_jobs import abandon
from service.settings import settings
flag = sys.argv[1]
wall = lambda: time.time() + (7200.0 if os.path.exists(flag) else 0.0)
chosen = settings({"feeders": tuple(sys.argv[5:]), "zenoh_listen": (sys.argv[2],), "http": sys.argv[3],
                   "database": sys.argv[4]})
asyncio.run(serve(chosen, wall=wall, announce=lambda running: print(running.url, flush=True)))
abandon()
"""


def ended_after(process: subprocess.Popen[bytes]) -> float:
    begun = time.monotonic()
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(STOP_S + 10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    return time.monotonic() - begun


@pytest.mark.acceptance
@pytest.mark.parametrize("wait_s", [1.2, 2.0])
def test_sigterm_while_a_leap_is_caught_up(tmp_path: Path, site: Site, wait_s: float) -> None:
    """A machine that does much else ends slowly without a leap as well."""
    calm = end_of_leap(site, tmp_path / "calm", None)
    assert end_of_leap(site, tmp_path / "leap", wait_s) < max(STOP_S, 1.5 * calm)


def end_of_leap(site: Site, folder: Path, wait_s: float | None) -> float:
    """Time from SIGTERM to the end of a service of 20 feeders, s, `wait_s` after a leap; None: no leap."""
    names, flag = copies(site, folder, 20), folder / "leap"
    http, zenoh = f"127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-c", LEAPING, str(flag), zenoh, http, f"sqlite:///{folder / 'gridsec.db'}"]
    process = subprocess.Popen([*command, *(str(folder / name) for name in names)])
    try:
        with httpx.Client(base_url=f"http://{http}", timeout=10.0) as client:
            until(lambda: ready(client), "readiness")
        if wait_s is not None:
            flag.touch()
            time.sleep(wait_s)
        lasted = ended_after(process)
        assert process.returncode == 0
        return lasted
    finally:
        process.kill()
        process.wait()


def ready(client: httpx.Client) -> bool:
    try:
        return client.get("/readyz").status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.acceptance
@pytest.mark.postgresql
def test_sigterm_while_a_commit_hangs(tmp_path: Path, cluster: Cluster) -> None:
    """The database's processes stand still: the last commit is given up, and the end is on time."""
    http, database = f"127.0.0.1:{free_port()}", cluster.database()
    command = [str(Path(sys.executable).parent / "gridsec"), "serve", "--feeder", FEEDER, "--http", http]
    command += ["--zenoh-listen", f"tcp/127.0.0.1:{free_port()}", "--database", database]
    dsn = database.replace("+psycopg", "")
    backends: list[int] = []
    with (tmp_path / "log").open("wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    try:
        with httpx.Client(base_url=f"http://{http}", timeout=10.0) as client:
            until(lambda: ready(client), "readiness")
        with psycopg.connect(dsn) as admin:
            found = "SELECT pid FROM pg_stat_activity WHERE datname = %s AND pid <> pg_backend_pid()"
            backends = [row[0] for row in admin.execute(found, [dsn.partition("@/")[2].partition("?")[0]])]
        assert backends
        for backend in backends:
            os.kill(backend, signal.SIGSTOP)
        time.sleep(3.0)
        assert ended_after(process) < STOP_S + 0.3
    finally:
        process.kill()
        process.wait()
        for backend in backends:
            os.kill(backend, signal.SIGCONT)
    assert "did not" in (tmp_path / "log").read_text()


@pytest.mark.canary("0.3")
@pytest.mark.parametrize("wait_s", [0.3, 1.5, 3.0, 4.5])
def test_sigterm_during_the_start_and_the_design(tmp_path: Path, wait_s: float) -> None:
    command = [str(Path(sys.executable).parent / "gridsec"), "serve", "--feeder", "kerber-vorstadtnetz"]
    command += ["--estimator", "exact-bank", "--http", f"127.0.0.1:{free_port()}"]
    command += [
        "--zenoh-listen",
        f"tcp/127.0.0.1:{free_port()}",
        "--database",
        f"sqlite:///{tmp_path / 'a.db'}",
    ]
    environment = {**os.environ, "GRIDSEC_CACHE_DIR": str(tmp_path / "cache")}
    with (tmp_path / "log").open("wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment)
        time.sleep(wait_s)
        assert process.poll() is None, (tmp_path / "log").read_text()
        assert ended_after(process) < STOP_S
    assert process.returncode in {0, -signal.SIGTERM}
