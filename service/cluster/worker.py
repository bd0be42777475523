"""One worker: a runtime over the feeders of its leases, without HTTP of its own."""

from __future__ import annotations

import asyncio
import os
import re
import secrets
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, Final

import structlog

from service import systemd
from service.api.listener import Shares, raise_limit
from service.api.routes import create_api
from service.app import bus_of, runtime_config, stop_on_signals
from service.cluster.catalogue import Catalogue
from service.cluster.envelope import Envelope
from service.cluster.member import Member
from service.cluster.rest import RestServer, rest_key
from service.cluster.status import Entry, WorkerState, report_states
from service.engine.runtime import Runtime
from service.ingest.zenoh_bus import Bus
from service.settings import Settings
from service.store import Store
from service.store.cluster_secret import cluster_secret
from service.store.leases import Leases
from service.store.schema import LeaseLost, WriterLost

NO_LIMIT: Final = 1 << 31
"""Largest number of feeders of a worker; the front has the limit."""
_log = structlog.get_logger("gridsec.cluster")


def worker_name() -> str:
    """Name of a worker by default: host and process, unique at any time."""
    host = re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname())[:40]
    return f"{host}-{os.getpid()}-{secrets.token_hex(2)}"


async def work(
    settings: Settings,
    name: str,
    *,
    announce: Callable[[Callable[[], None]], None] = lambda _: None,
    signals: bool = True,
    settled: Callable[[], None] = lambda: None,
    stopping: Callable[[], None] = lambda: None,
    lost: Callable[[BaseException], None] = lambda _: None,
    wall: Callable[[], float] = time.time,
) -> None:
    """Run a worker until SIGINT, SIGTERM or the function that `announce` gets is called.

    `lost` is called at once after the loss of a lease: nothing more may be written.

    Raises LeaseLost if another worker has its feeders, StoreUnavailable, BusUnavailable if it cannot start.
    """
    shares = Shares.of(raise_limit())
    with ExitStack() as stack:
        leases = stack.enter_context(Leases(settings.database, name))
        envelope = Envelope(cluster_secret(settings.database), wall)
        leases.register()
        store = stack.enter_context(Store(settings.database, leases=leases))
        member = Member(leases, Catalogue(store))
        config = replace(
            runtime_config(settings), max_feeders=NO_LIMIT, ownership=member.ownership, acts=member.acts
        )
        runtime = Runtime(config, store, (), given=(), wall=wall, settled=settled)
        bus = bus_of(settings, shares, runtime.deliver, missed=None, wall=wall, everything=False)
        stack.enter_context(bus)
        runtime.attach(bus)
        loop = asyncio.get_running_loop()
        key = rest_key(name)
        bus.serve(key, RestServer(create_api(runtime), key, envelope, loop))
        stop = asyncio.Event()
        announce(stop.set)
        _log.info("working", worker=name)
        with stop_on_signals(stop, active=signals):
            await _until_stopped(runtime, member, bus, envelope, stop, stopping=stopping, lost=lost)


async def _until_stopped(
    runtime: Runtime,
    member: Member,
    bus: Bus,
    envelope: Envelope,
    stop: asyncio.Event,
    *,
    stopping: Callable[[], None],
    lost: Callable[[BaseException], None],
) -> None:
    """Run runtime, member and messages until `stop`, or until one of them fails; raise its error."""
    news = asyncio.Event()
    running = asyncio.create_task(runtime.run(), name="runtime")
    stopped = asyncio.create_task(stop.wait(), name="stop")
    side = [
        asyncio.create_task(member.run(runtime, bus), name="leases"),
        asyncio.create_task(_note_news(runtime, news), name="news"),
        asyncio.create_task(
            report_states(partial(_content, runtime, member), bus.tell, member.name, envelope, news),
            name="states",
        ),
    ]
    supervised = asyncio.create_task(systemd.supervise(lambda: runtime.healthy()[0]), name="systemd")
    done, _ = await asyncio.wait({running, stopped, *side}, return_when=asyncio.FIRST_COMPLETED)
    errors = [error for task in done if (error := _error(task)) is not None]
    for error in errors:
        if isinstance(error, LeaseLost | WriterLost):
            lost(error)
    stopping()
    systemd.notify("STOPPING=1")
    for task in (*side, stopped, supervised):
        task.cancel()
    runtime.stop()
    await asyncio.gather(running, *side, stopped, supervised, return_exceptions=True)
    if not errors and (failed := _error(running)) is not None:
        errors.append(failed)
    if errors:
        raise errors[0]


def _error(task: asyncio.Task[Any]) -> BaseException | None:
    """Error of an ended task, out of its groups; None without one."""
    if task.cancelled():
        return None
    error = task.exception()
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


async def _note_news(runtime: Runtime, news: asyncio.Event) -> None:
    async for _ in runtime.subscribe():
        news.set()


def _content(runtime: Runtime, member: Member) -> dict[str, Any]:
    """Content of the message of a worker."""
    unstored, problem = runtime.unstored()
    reasons = runtime.ready()[1]
    if member.problem is not None:
        reasons.append(member.problem)
    found = WorkerState(
        member.name,
        0.0,
        member.shards(),
        {fields["name"]: Entry(fields, runtime.summary(fields["name"])) for fields in runtime.feeders()},
        unstored,
        problem,
        tuple(reasons),
    )
    return found.content()
