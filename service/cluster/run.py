"""Assembly of a front: database, zenoh, workers on this machine, HTTP."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager
from functools import partial
from typing import Final

from feeders.registry import choose
from gridsec.errors import Problem
from service.api.listener import Shares, raise_limit
from service.app import HttpSide, Running, bus_of, load_sites, read_notify
from service.cluster.catalogue import Catalogue
from service.cluster.envelope import Envelope
from service.cluster.forward import Forwarder
from service.cluster.front import Front, ObservedStore
from service.cluster.status import STATES
from service.cluster.supervisor import Supervisor, worker_environment
from service.cluster.workers import Workers
from service.ingest.align import Clock
from service.settings import ENV_PREFIX, Settings, SettingsInvalid
from service.store.cluster_secret import cluster_secret
from service.store.committer import missed
from service.store.leases import Leases

OBSERVER: Final = "front"
"""Name of the front for the leases, of which it holds none."""


def check_cluster(settings: Settings) -> None:
    """Refuse settings that several processes cannot have. Raises SettingsInvalid."""
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
        envelope = Envelope(cluster_secret(settings.database), wall)
        store = stack.enter_context(ObservedStore(settings.database, leases=leases))
        http = HttpSide.open(stack, settings, shares, targets, wall)
        workers = Workers(envelope)
        front = Front(
            store,
            workers,
            Catalogue(store),
            sites,
            live_workers=leases.live_workers,
            shelve_most_s=3600.0 * settings.max_shelve_h,
            wall=wall,
        )
        workers.changed = front.heard
        bus = bus_of(
            settings, shares, lambda _: None, missed=partial(missed, store), wall=wall, everything=False
        )
        stack.enter_context(bus)
        forwarder = Forwarder(
            workers,
            store,
            bus.ask,
            envelope,
            names=front.names,
            refresh=front.refresh,
            given=frozenset(sites),
            max_feeders=settings.max_feeders,
        )
        front.attach(forwarder)
        bus.hear(STATES, workers.take)
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
