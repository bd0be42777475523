"""One worker: a runtime over the feeders of its leases, without HTTP of its own.

It claims shards, keeps them, and starts and ends the monitoring of their feeders. A lost lease ends the
process: another worker has the feeder and has written its state. After a freeze, the process does not act
before a renewal has shown that all leases are still held.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import secrets
import socket
import time
from collections.abc import Awaitable, Callable, Collection, Coroutine, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, Final, Protocol

import structlog

from feeders.model.site import Site
from service import systemd
from service.api.listener import Shares, raise_limit
from service.api.routes import create_api
from service.app import bus_of, runtime_config, stop_on_signals
from service.cluster.catalogue import Catalogue
from service.cluster.messages import (
    CallServer,
    Entry,
    Envelope,
    RestCalls,
    StateReports,
    WorkerState,
    rest_key,
    state_key,
)
from service.engine.runtime import Runtime
from service.report.feeder_info import Ownership
from service.settings import Settings
from service.store import Store, StoreUnavailable
from service.store.cluster_secret import cluster_secret
from service.store.leases import POLL_S, RENEW_S, Leases, clock_problem, shard_of
from service.store.schema import LeaseLost, WriterLost

REFRESH_S: Final = 1.0
"""Interval of the reads of the feeders in the database, s."""
BALANCE_S: Final = 1.0
"""Interval of voluntary releases to workers with less weight, s."""
BEAT_S: Final = 0.1
"""Interval at which the process notes that it runs, s."""
FREEZE_S: Final = 2.0
"""Time without a beat after which leases may have expired, s; below `EXPIRY_S - RENEW_S`."""
_log = structlog.get_logger("gridsec.cluster")


class Host(Protocol):
    """Monitoring of feeders, such as `Runtime`."""

    async def adopt(self, sites: Sequence[Site]) -> None:
        """Go on with feeders of another process."""

    async def resign(self, names: Collection[str]) -> None:
        """End the monitoring of feeders; their state is stored when this returns."""

    def known(self, name: str) -> bool:
        """True if the feeder is monitored."""

    def set_unloaded(self, reasons: Mapping[str, str]) -> None:
        """Note the feeders of this process that cannot be loaded, with the reasons."""


class Member:
    """Membership of one worker in the cluster; runs in the event loop of its runtime.

    leases: leases of this process.
    catalogue: feeders of the database.
    """

    def __init__(self, leases: Leases, catalogue: Catalogue) -> None:
        self._leases, self._catalogue = leases, catalogue
        self._ours: set[str] = set()
        self._unloaded: dict[str, str] = {}
        self._beat_at = time.monotonic()
        # End of the latest freeze, monotonic s, until a later renewal has ended; None without one.
        self._woke: float | None = None
        self._renew = asyncio.Event()
        self._messages = 0
        self.problem: str | None = None

    # ------------------------------------------------------------ state, without a call to the database

    def acts(self) -> bool:
        """True unless the process was frozen and no renewal has been tried since.

        While the database does not answer, no other worker can claim a lease, and monitoring continues.
        """
        return self._woke is None and time.monotonic() - self._beat_at < FREEZE_S

    def ownership(self, feeder: str) -> Ownership | None:
        """Owner of a feeder: this worker, or None."""
        lease = self._leases.lease_of(feeder)
        return None if lease is None else Ownership(self._leases.worker, lease.epoch)

    @property
    def name(self) -> str:
        """Name of the worker."""
        return self._leases.worker

    def order(self) -> tuple[int, int]:
        """Order of the next message: later ones, also of a later process with this name, are larger."""
        self._messages += 1
        return self._leases.number, self._messages

    def shards(self) -> dict[int, int]:
        """Epochs of the held leases by shard."""
        return {lease.shard: lease.epoch for lease in self._leases.held.values()}

    # ------------------------------------------------------------------------------------------- tasks

    async def run(self, host: Host) -> None:
        """Hold leases until cancelled. Raises LeaseLost."""
        self._beat_at = time.monotonic()
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._beat())
            tasks.create_task(self._keep())
            tasks.create_task(self._share(host))
            tasks.create_task(self._load_ahead())

    async def _beat(self) -> None:
        """Note that the process runs, and when it has been frozen."""
        while True:
            now = time.monotonic()
            if now - self._beat_at >= FREEZE_S:
                _log.warning("the process was frozen", seconds=round(now - self._beat_at, 1))
                self._woke = now
                self._renew.set()
            self._beat_at = now
            await asyncio.sleep(BEAT_S)

    async def _keep(self) -> None:
        """Renew the leases. Raises LeaseLost if one is lost."""
        while True:
            began = time.monotonic()
            lost = await self._asked("renew", self._leases.renew)
            if lost:
                shards = {lease.shard for lease in lost}
                raise LeaseLost(self._leases.worker, [one for one in self._ours if shard_of(one) in shards])
            if self._woke is not None and began >= self._woke:
                self._woke = None
            self._renew.clear()
            if self._woke is None:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._renew.wait(), RENEW_S)

    async def _share(self, host: Host) -> None:
        """Claim free shards, release superfluous ones, and follow changes of the feeders."""
        refresh_at, balance_at = 0.0, time.monotonic() + BALANCE_S
        while True:
            now = time.monotonic()
            if now >= refresh_at:
                await self._asked("read the feeders of", self._refresh)
                refresh_at = now + REFRESH_S
            await self._asked("claim shards in", self._leases.claim)
            await self._reconcile(host)
            if now >= balance_at:
                await self._release(host)
                balance_at = time.monotonic() + BALANCE_S
            await asyncio.sleep(POLL_S)

    def _refresh(self) -> bool:
        """Read the feeders of the database; True after success."""
        self._catalogue.refresh()
        # The time of a tick grows with the meters.
        self._leases.weigh({name: 1.0 + len(one.meters) for name, one in self._catalogue.feeders.items()})
        return True

    def _wanted(self) -> set[str]:
        held = self._leases.held
        return {name for name in self._catalogue.feeders if shard_of(name) in held}

    async def _reconcile(self, host: Host) -> None:
        """Monitor exactly the feeders of the held shards."""
        wanted = self._wanted()
        # A command that ends after the release of its shard leaves a monitor without a lease.
        monitored = {name for name in self._catalogue.feeders if host.known(name)}
        gone, new = (self._ours | monitored) - wanted, wanted - self._ours - self._unloaded.keys()
        self._ours -= gone
        for name in [one for one in self._unloaded if one not in wanted or host.known(one)]:
            del self._unloaded[name]
        host.set_unloaded(self._unloaded)
        if gone:
            await self._attempt(host.resign(gone))
        for name in [one for one in new if host.known(one)]:  # put over REST
            self._ours.add(name)
            new.remove(name)
        if new:
            await self._adopt(host, new)

    async def _adopt(self, host: Host, names: Collection[str]) -> None:
        began = time.monotonic()
        # An earlier owner may have stored newer tables before the claim.
        if not await self._asked("read the feeders of", self._refresh):
            return
        found = await self._asked("read the tables of feeders of", self._catalogue.sites, names)
        if found is None:
            return
        self._unloaded |= {name: one for name, one in found.items() if isinstance(one, str)}
        sites = [one for one in found.values() if isinstance(one, Site)]
        if sites and await self._attempt(host.adopt(sites)):
            self._ours |= {site.feeder.name for site in sites}
            lasted = round(time.monotonic() - began, 3)
            _log.info("feeders are taken over", feeders=len(sites), seconds=lasted)

    async def _release(self, host: Host) -> None:
        """Release shards that a worker with less weight is due, after their feeders' state is stored."""
        shards = await self._asked("plan shards in", self._leases.excess)
        if not shards:
            return
        leaving = [name for name in self._ours if shard_of(name) in set(shards)]
        # After a failure they are taken back as new ones.
        self._ours -= set(leaving)
        if leaving and not await self._attempt(host.resign(leaving)):
            return
        await self._asked("release shards in", self._leases.release, shards)
        _log.info("shards are released", shards=len(shards), feeders=leaving)

    async def _load_ahead(self) -> None:
        """Load the feeders of other workers, one at a time."""
        while True:
            name = self._catalogue.next_ahead(self._ours)
            if name is None:
                await asyncio.sleep(REFRESH_S)
            else:
                await self._asked("read the tables of feeders of", self._catalogue.sites, [name])
                await asyncio.sleep(POLL_S)

    async def _asked(self, doing: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Result of a call to the database; None while it does not answer."""
        try:
            found = await asyncio.to_thread(call, *arguments)
        except LeaseLost:
            raise
        except StoreUnavailable as error:
            if self.problem is None:
                _log.error("the leases cannot be used", doing=doing, problem=str(error))
            self.problem = f"leases: {error}"
            return None
        if self.problem is not None:
            _log.info("the leases can be used again")
            self.problem = None
        return found

    @staticmethod
    async def _attempt(call: Awaitable[None]) -> bool:
        """True if a change of the monitoring succeeds; it is tried again otherwise."""
        try:
            await call
        except LeaseLost:
            raise
        except StoreUnavailable as error:
            _log.warning("feeders cannot be taken or handed over now", problem=str(error))
            return False
        return True


NO_LIMIT: Final = 1 << 31
"""Largest number of feeders of a worker; the front has the limit."""


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
        envelope = Envelope(cluster_secret(settings.database), leases.clock)
        leases.register()
        store = stack.enter_context(Store(settings.database, leases=leases))
        member = Member(leases, Catalogue(store))
        config = replace(
            runtime_config(settings),
            max_feeders=NO_LIMIT,
            ownership=member.ownership,
            rejects_unknown=False,
            acts=member.acts,
        )
        runtime = Runtime(config, store, (), given=(), wall=wall, settled=settled)
        bus = bus_of(settings, shares, runtime, missed=None, wall=wall, everything=False)
        stack.enter_context(bus)
        runtime.attach(bus)
        loop = asyncio.get_running_loop()
        news = asyncio.Event()
        content = partial(_content, runtime, member, lambda: clock_problem(wall(), leases.clock()))
        reports = StateReports(content, news)
        calls = {rest_key(name): RestCalls(create_api(runtime)).take, state_key(name): reports.take}
        for key, take in calls.items():
            bus.serve(key, CallServer(key, envelope, loop, take))
        stop = asyncio.Event()
        announce(stop.set)
        _log.info("working", worker=name)
        with stop_on_signals(stop, active=signals):
            side = {
                "leases": member.run(runtime),
                "states": reports.run(),
                "news": _note_news(runtime, news),
            }
            await _until_stopped(runtime, side, stop, stopping=stopping, lost=lost)


async def _until_stopped(
    runtime: Runtime,
    tasks: Mapping[str, Coroutine[Any, Any, None]],
    stop: asyncio.Event,
    *,
    stopping: Callable[[], None],
    lost: Callable[[BaseException], None],
) -> None:
    """Run a runtime and tasks beside it until `stop`, or until one of them fails; raise its error."""
    running = asyncio.create_task(runtime.run(), name="runtime")
    stopped = asyncio.create_task(stop.wait(), name="stop")
    side = [asyncio.create_task(run, name=name) for name, run in tasks.items()]
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


def _content(runtime: Runtime, member: Member, clock: Callable[[], str | None]) -> dict[str, Any]:
    """Content of the state of a worker. `clock` returns the problem of its clock."""
    unstored, problem = runtime.unstored()
    reasons = runtime.ready()[1] + [one for one in (member.problem, clock()) if one is not None]
    found = WorkerState(
        member.name,
        member.order(),
        member.shards(),
        {fields["name"]: Entry(fields, runtime.summary(fields["name"])) for fields in runtime.feeders()},
        unstored,
        problem,
        tuple(reasons),
    )
    return found.content()
