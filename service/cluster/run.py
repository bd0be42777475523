"""Assembly of a front: database, zenoh, workers on this machine, HTTP.

A local worker is started again after its end, and ended with the front. It ends by itself when its standard
input ends, so also after the front was killed.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import ExitStack, asynccontextmanager
from functools import partial
from typing import Final

import structlog

from feeders.registry import choose
from gridsec.errors import Problem
from service.api.listener import Shares, raise_limit
from service.app import HttpSide, Running, bus_of, load_sites, read_notify
from service.cluster.catalogue import Catalogue
from service.cluster.forward import Forwarder, StateCalls, Workers
from service.cluster.front import Front, ObservedStore
from service.cluster.messages import Caller, Envelope
from service.ingest.align import Clock
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import fixed_listeners
from service.settings import ENV_PREFIX, Settings, SettingsInvalid
from service.store.cluster_secret import cluster_secret
from service.store.committer import missed
from service.store.leases import Leases

AGAIN_S: Final = 1.0
"""Wait before a worker is started again, s; it doubles with each end within `STEADY_S`."""
AGAIN_MOST_S: Final = 30.0
"""Longest wait, s."""
STEADY_S: Final = 60.0
"""Time after which a worker counts as started, s."""
END_S: Final = 2.0
"""Time from SIGTERM to SIGKILL, s; the front ends within 3 s."""
WORKER: Final = (sys.executable, "-c", "from service.cli.main import main; main()", "worker", "--until-eof")
"""Command line of a local worker."""
_log = structlog.get_logger("gridsec.cluster")
_PASSED: Final = (
    "prefix",
    "database",
    "max_skew_s",
    "grace_s",
    "max_payload",
    "queue",
    "max_shelve_h",
    "meter_keys",
    "unsigned",
    "plaintext_network",
    "log_level",
    "log_format",
)
"""Settings that the workers share with their front."""


def worker_environment(settings: Settings) -> dict[str, str]:
    """Return the environment of the local workers of a front.

    They are clients of its zenoh router, or use its zenoh configuration file.
    """
    given = {name: getattr(settings, name) for name in _PASSED}
    if settings.zenoh_config is not None:
        given |= {"zenoh_config": settings.zenoh_config, "zenoh_mode": settings.zenoh_mode}
        given["zenoh_connect"] = ",".join(settings.zenoh_connect) or None
    else:
        ends = settings.listen or settings.zenoh_connect
        given |= {"zenoh_mode": "client", "zenoh_connect": ",".join(ends)}
    own = {ENV_PREFIX + name.upper(): str(value) for name, value in given.items() if value is not None}
    other = {key: value for key, value in os.environ.items() if not key.upper().startswith(ENV_PREFIX)}
    kept = {key: os.environ[key] for key in ("GRIDSEC_CACHE_DIR",) if key in os.environ}
    # systemd's messages are those of the front.
    for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"):
        other.pop(name, None)
    return {**other, **kept, **own}


class Supervisor:
    """Keeps a number of local workers running.

    count: number of workers.
    environment: their environment.
    command: their command line.
    """

    def __init__(self, count: int, environment: Mapping[str, str], command: Sequence[str] = WORKER) -> None:
        self._count, self._environment, self._command = count, dict(environment), tuple(command)
        self._running: dict[int, asyncio.subprocess.Process] = {}
        self._ending = asyncio.Event()

    @property
    def pids(self) -> list[int]:
        """Process ids of the running workers."""
        return [process.pid for _, process in sorted(self._running.items())]

    async def run(self) -> None:
        """Keep the workers running until cancelled; they have ended when this returns."""
        try:
            async with asyncio.TaskGroup() as tasks:
                for number in range(self._count):
                    tasks.create_task(self._keep(number))
        finally:
            await self._end()

    async def _keep(self, number: int) -> None:
        loop, wait_s = asyncio.get_running_loop(), AGAIN_S
        while not self._ending.is_set():
            began = loop.time()
            process = await self._start()
            self._running[number] = process
            code = await process.wait()
            del self._running[number]
            if self._ending.is_set():
                return
            wait_s = AGAIN_S if loop.time() - began > STEADY_S else wait_s
            _log.error("a worker has ended and is started again", pid=process.pid, code=code, wait_s=wait_s)
            await asyncio.sleep(wait_s)
            wait_s = min(2.0 * wait_s, AGAIN_MOST_S)

    async def _start(self) -> asyncio.subprocess.Process:
        return await asyncio.create_subprocess_exec(
            *self._command, stdin=asyncio.subprocess.PIPE, env=self._environment
        )

    async def _end(self) -> None:
        """Pass on SIGTERM, and end workers that do not end in time."""
        self._ending.set()
        left = list(self._running.values())
        for process in left:
            _send(process, signal.SIGTERM)
        waits = [asyncio.create_task(process.wait()) for process in left]
        if waits:
            await asyncio.wait(waits, timeout=END_S)
        for process in left:
            if process.returncode is None:
                _log.error("a worker is ended by force", pid=process.pid)
                _send(process, signal.SIGKILL)
                await process.wait()


def _send(process: asyncio.subprocess.Process, number: signal.Signals) -> None:
    try:
        process.send_signal(number)
    except ProcessLookupError:
        return


OBSERVER: Final = "front"
"""Name of the front for the leases, of which it holds none."""


def check_cluster(settings: Settings) -> None:
    """Refuse settings that several processes cannot have. Raises SettingsInvalid, BusUnavailable."""
    problems = []
    if not settings.database.startswith("postgresql"):
        text = (
            f"--database or {ENV_PREFIX}DATABASE: workers need a PostgreSQL database, such as "
            "postgresql+psycopg://gridsec@/gridsec"
        )
        problems.append(Problem("needs-postgresql", text))
    if settings.clock is Clock.EVENTS:
        text = f"--clock or {ENV_PREFIX}CLOCK: workers need the clock `wall`"
        problems.append(Problem("needs-wall-clock", text))
    if settings.workers and settings.zenoh_config is not None:
        own = BusConfig(settings.zenoh_mode, (), settings.zenoh_connect, settings.zenoh_config)
        if ends := fixed_listeners(own):
            text = (
                f"--zenoh-config or {ENV_PREFIX}ZENOH_CONFIG: local workers would listen on "
                f"{', '.join(ends)} as well; expected a file that connects to a router, or --workers 0"
            )
            problems.append(Problem("shared-endpoint", text))
    if problems:
        raise SettingsInvalid(problems)


async def serve_front(
    settings: Settings,
    *,
    announce: Callable[[Running], None] = lambda _: None,
    signals: bool = True,
    stopping: Callable[[], None] = lambda: None,
    wall: Callable[[], float] = time.time,
) -> None:
    """Run a front with `Settings.workers` local workers until SIGINT, SIGTERM or `Running.stop`.

    Raises SettingsInvalid, FeederInvalid, StoreUnavailable, BusUnavailable, AddressUnavailable if it cannot
    start.
    """
    check_cluster(settings)
    shares = Shares.of(raise_limit())
    targets = read_notify(settings)
    sites = {
        name: choose(site, estimator=settings.estimator)
        for name, site in load_sites(settings.feeders).items()
    }
    with ExitStack() as stack:
        leases = stack.enter_context(Leases(settings.database, OBSERVER))
        envelope = Envelope(cluster_secret(settings.database), leases.clock)
        store = stack.enter_context(ObservedStore(settings.database, leases=leases))
        http = HttpSide.open(stack, settings, shares, targets, wall)
        workers = Workers()
        front = Front(
            store,
            workers,
            Catalogue(store),
            sites,
            live_workers=leases.live_workers,
            cluster_time=leases.clock,
            shelve_most_s=3600.0 * settings.max_shelve_h,
            wall=wall,
        )
        workers.changed = front.heard
        bus = bus_of(settings, shares, None, missed=partial(missed, store), wall=wall, everything=False)
        stack.enter_context(bus)
        caller = Caller(bus.ask, envelope)
        forwarder = Forwarder(
            workers,
            store,
            caller,
            names=front.names,
            refresh=front.refresh,
            given=frozenset(sites),
            max_feeders=settings.max_feeders,
        )
        front.attach(forwarder, StateCalls(workers, caller))
        async with _supervised(settings):
            await http.serve(
                stack,
                front,
                tuple(sites),
                forward=forwarder,
                announce=announce,
                signals=signals,
                stopping=stopping,
            )


@asynccontextmanager
async def _supervised(settings: Settings) -> AsyncIterator[None]:
    """Keep local workers running until the block ends."""
    supervisor = Supervisor(settings.workers or 0, worker_environment(settings))
    task = asyncio.create_task(supervisor.run(), name="workers")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
