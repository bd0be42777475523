"""A front and its workers as processes, with meters that report by the wall clock."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import psycopg

from feeders.format.tables import write
from feeders.model.site import Site
from feeders.simulation.plant import BUSBAR
from feeders.simulation.scenario import Scenario, simulate
from service.app import Running
from service.cli.simulate import key_of
from service.cluster.run import serve_front
from service.ingest.queues import BusConfig, BusUnavailable
from service.ingest.zenoh_bus import MeterClient
from service.settings import Settings, settings
from tests.service.running import PATIENCE_S, free_port, until

PROGRAM = """
import mmap, struct, sys, time
with open(sys.argv.pop(1), "rb") as file:
    leap = mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)
real = time.time
time.time = lambda: real() + struct.unpack("d", leap)[0]
from service.cli.main import main
main()
"""
"""The command `gridsec` with a wall clock that the file of its first argument shifts."""
ROUTER = """
import signal, sys
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import session
with session(BusConfig("router", listen=(sys.argv[1],), connect=(sys.argv[2],))):
    signal.pause()
"""
"""A zenoh router: listens on the first endpoint, and connects to the router of the second one."""
NO_WORKERS = ("--workers", "0")
LIE_VOLT = 20.0
"""Error of a manipulated meter, V."""
JUDGING = {"agreement", "residuals", "settling", "ambiguous", "misfit", "too-many-suspects"}
"""Causes of an estimator with readings. It settles for some seconds where inverters regulate."""


class Fleet(threading.Thread):
    """All meters of feeders with the tables of one site, one reading per second, by the wall clock.

    period_s: time after which the simulated readings repeat, s.
    """

    def __init__(self, zenoh: str, site: Site, names: list[str], period_s: float = 60.0) -> None:
        super().__init__(daemon=True)
        self.zenoh, self.names = zenoh, names
        self.lies: dict[tuple[str, str], float] = {}
        self.ahead_s = 0.0  # shift of the meters' clocks
        self.ended = threading.Event()
        self.samples = [s.readings for s in simulate(site, Scenario(seed=1, duration_s=period_s, dt_s=1.0))]

    def run(self) -> None:
        while not self.ended.is_set():
            with (
                suppress(BusUnavailable),
                MeterClient(BusConfig("client", connect=(self.zenoh,)), "gridsec") as meters,
            ):
                self._report(meters)
            time.sleep(0.2)

    def _report(self, meters: MeterClient) -> None:
        while not self.ended.is_set():
            now = time.time() + self.ahead_s
            for reading in self.samples[int(now) % len(self.samples)]:
                for name in self.names:
                    lie = self.lies.get((name, reading.meter), 0.0)
                    fields = {"t": now, "v_volt": reading.v_volt + lie}
                    if reading.meter != BUSBAR:
                        fields["p_kw"] = reading.p_kw or 0.0
                    meters.put(key_of(name, reading.meter), json.dumps(fields).encode())
            self.ended.wait(max(0.0, 1.0 - (time.time() + self.ahead_s - now)))


class Process:
    """A command of gridsec, or another program, as a process, with its log in a file."""

    def __init__(self, log: Path, *arguments: str, program: str = PROGRAM, **environment: str) -> None:
        self.log, self.clock = log, log.with_suffix(".clock")
        if program is PROGRAM:
            self.leap(0.0)
            arguments = (str(self.clock), *arguments)
        with log.open("ab") as file:
            self.popen = subprocess.Popen(
                [sys.executable, "-c", program, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
                env={**os.environ, **environment},
            )

    @property
    def pid(self) -> int:
        return self.popen.pid

    def leap(self, ahead_s: float) -> None:
        """Shift the wall clock of the process against that of the machine, s."""
        with self.clock.open("r+b" if self.clock.exists() else "wb") as file:
            file.write(struct.pack("d", ahead_s))

    def send(self, number: signal.Signals) -> None:
        self.popen.send_signal(number)

    def end(self) -> int:
        """End the process; its exit code."""
        with suppress(ProcessLookupError):
            self.send(signal.SIGCONT)
            self.send(signal.SIGTERM)
        try:
            return self.popen.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            return self.popen.wait()
        finally:
            if self.popen.stdout is not None:
                self.popen.stdout.close()


class FrontHere(threading.Thread):
    """A front in this process, with a thread of its own."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(name="front under test", daemon=True)
        self.settings = settings
        self.up = threading.Event()
        self.running: Running | None = None
        self.loop: asyncio.AbstractEventLoop | None = None
        self.error: Exception | None = None
        self.start()
        assert self.up.wait(PATIENCE_S)
        if self.error is not None:
            raise self.error

    def run(self) -> None:
        def announce(running: Running) -> None:
            self.running, self.loop = running, asyncio.get_running_loop()
            self.up.set()

        try:
            asyncio.run(serve_front(self.settings, announce=announce, signals=False))
        except Exception as error:  # noqa: BLE001 - handed over to the test
            self.error = error
        self.up.set()

    @property
    def url(self) -> str:
        assert self.running is not None
        return self.running.url

    def end(self) -> None:
        if self.loop is not None and self.running is not None and self.is_alive():
            self.loop.call_soon_threadsafe(self.running.stop)
        self.join(PATIENCE_S)
        assert not self.is_alive()


class ServedCluster:
    """A front, workers by name, and the meters of their feeders."""

    def __init__(
        self,
        folder: Path,
        database: str,
        site: Site,
        count: int,
        *,
        period_s: float = 60.0,
        two_routers: bool = False,
    ) -> None:
        self.folder, self.database, self.site = folder, database, site
        self.names = [f"copy-{k}" for k in range(count)]
        for name in self.names:
            write(replace(site.tables, meta=replace(site.tables.meta, name=name)), folder / name)
        self.zenoh = f"tcp/127.0.0.1:{free_port()}"
        self.second = f"tcp/127.0.0.1:{free_port()}" if two_routers else None
        self.router: Process | None = None
        self.workers: dict[str, Process] = {}
        self.front: Process | FrontHere | None = None
        self.http = httpx.Client()
        self.fleet = Fleet(self.zenoh, site, self.names, period_s)

    def start_front_here(self) -> None:
        """Start a front without workers of its own in this process."""
        chosen = settings(
            {
                "feeders": tuple(str(self.folder / name) for name in self.names),
                "zenoh_listen": (self.zenoh,),
                "http": "127.0.0.1:0",
                "database": self.database,
                "workers": 0,
            }
        )
        front = self.front = FrontHere(chosen)
        self.http = httpx.Client(base_url=front.url, timeout=20.0)

    def start_router(self) -> None:
        """Start the second router as a process; the workers prefer it to the front."""
        assert self.second is not None
        self.router = Process(self.folder / "router.log", self.second, self.zenoh, program=ROUTER)

    def start_front(self, options: tuple[str, ...] = NO_WORKERS) -> None:
        """Start a front as a process, by default without workers of its own; without options a service."""
        feeders = [part for name in self.names for part in ("--feeder", str(self.folder / name))]
        address = f"127.0.0.1:{free_port()}"
        front = self.front = Process(
            self.folder / "front.log",
            "serve",
            *options,
            *feeders,
            *("--zenoh-listen", self.zenoh, "--http", address, "--database", self.database),
        )
        assert front.popen.stdout is not None
        line = front.popen.stdout.readline().strip()
        assert line.startswith("http://"), front.log.read_text()
        self.http = httpx.Client(base_url=line, timeout=20.0)

    def start_worker(self, name: str) -> Process:
        routers = [end for end in (self.second, self.zenoh) if end is not None]
        made = self.workers[name] = Process(
            self.folder / f"{name}.log",
            *("worker", "--name", name, "--database", self.database),
            *(part for end in routers for part in ("--zenoh-connect", end)),
            PGAPPNAME=name,
        )
        return made

    def end(self) -> None:
        self.fleet.ended.set()
        if self.fleet.is_alive():
            self.fleet.join(10.0)
        for process in (*self.workers.values(), self.front, self.router):
            if process is not None:
                process.end()
        self.http.close()

    # -------------------------------------------------------------------------------------------- requests

    def get(self, path: str, **params: Any) -> Any:
        answer = self.http.get(f"/api/v1{path}", params=params)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def state(self, name: str) -> dict[str, Any]:
        answer = self.http.get(f"/api/v1/feeders/{name}/state")
        return dict(answer.json()) if answer.status_code == 200 else {}

    def listed(self) -> dict[str, dict[str, Any]]:
        return {one["name"]: one for one in self.get("/feeders")["feeders"]}

    def owners(self) -> dict[str, str | None]:
        return {name: one.get("owner") for name, one in self.listed().items()}

    def owned(self, worker: str) -> list[str]:
        return [name for name, owner in self.owners().items() if owner == worker]

    def alarms(self, **params: Any) -> list[dict[str, Any]]:
        return list(self.get("/alarms", **params)["alarms"])

    def judged(self, name: str, since: float, verdict: str | None = None) -> bool:
        """True if a feeder has a decided tick that is later than a time."""
        state = self.state(name)
        wanted = {"clean", "attacked"} if verdict is None else {verdict}
        return bool(state) and state["t"] > since and state["verdict"] in wanted

    def judging(self, name: str, since: float) -> bool:
        """True if the estimator of a feeder has processed a tick that is later than a time."""
        state = self.state(name)
        return bool(state) and state["t"] > since and state["cause"] in JUDGING

    def judging_within(self, names: list[str], since: float, patience_s: float = 30.0) -> float:
        """Time from `since` until the estimators of all feeders process ticks, s."""
        left = set(names)

        def done() -> bool:
            left.difference_update([name for name in left if self.judging(name, since)])
            return not left

        until(done, f"ticks of {sorted(left)}", patience_s)
        return time.time() - since

    def judged_within(self, names: list[str], since: float, patience_s: float = 30.0) -> float:
        """Time from `since` until all feeders have a later decided tick, s."""
        left = set(names)

        def done() -> bool:
            left.difference_update([name for name in left if self.judged(name, since)])
            return not left

        until(done, f"ticks of {sorted(left)}", patience_s)
        return time.time() - since


class Writes:
    """Record of all changes of a database, by triggers: worker and time of each."""

    TABLES = (
        "alarm",
        "event",
        "outbox",
        "history",
        "incident",
        "incident_event",
        "commission",
        "distrust",
        "observer",
    )

    def __init__(self, database: str) -> None:
        self.address = database.replace("+psycopg", "")
        with psycopg.connect(self.address, autocommit=True) as connection:
            connection.execute("CREATE TABLE writes (worker text, t double precision)")
            connection.execute(
                "CREATE FUNCTION note() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
                "INSERT INTO writes VALUES "
                "(current_setting('application_name'), extract(epoch FROM clock_timestamp())); "
                "RETURN NULL; END $$"
            )
            for table in self.TABLES:
                connection.execute(
                    f"CREATE TRIGGER note AFTER INSERT OR UPDATE OR DELETE ON {table} "
                    "FOR EACH ROW EXECUTE FUNCTION note()"
                )

    def of(self, worker: str, since: float) -> int:
        """Number of committed changes by a worker since a time."""
        with psycopg.connect(self.address) as connection:
            query = "SELECT count(*) FROM writes WHERE worker = %s AND t > %s"
            row = connection.execute(query, (worker, since)).fetchone()
        assert row is not None
        return int(row[0])


@contextmanager
def served_cluster(
    folder: Path,
    database: str,
    site: Site,
    feeders: int,
    workers: int,
    *,
    here: bool = False,
    options: tuple[str, ...] = NO_WORKERS,
    period_s: float = 60.0,
    two_routers: bool = False,
) -> Iterator[ServedCluster]:
    """A front (with `here` in this process) and workers w0, w1, ...; ended with the block."""
    made = ServedCluster(folder, database, site, feeders, period_s=period_s, two_routers=two_routers)
    try:
        if two_routers:
            made.start_router()
        for k in range(workers):
            made.start_worker(f"w{k}")
        if here:
            made.start_front_here()
        else:
            made.start_front(options)
        made.fleet.start()
        yield made
    finally:
        made.end()


def wait_for(condition: Callable[[], Any], what: str, patience_s: float = 30.0) -> float:
    """Time until a condition holds, s."""
    began = time.monotonic()
    until(condition, what, patience_s)
    return time.monotonic() - began
