"""The running service: one task owns all state.

Rounds run one after the other in one worker thread, so that the event loop stays free for HTTP.
Acknowledgements, new feeders and finished designs are executed between them. No other code changes the state.
With the wall clock that thread makes no call to the database: a command starts one, and its result is
processed between two later rounds.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, Protocol, TypeVar

import structlog

from feeders.model.site import Site
from feeders.registry import DesignedEstimator
from gridsec.errors import GridsecError
from service.alarms.state_machine import Alarm
from service.engine import design_jobs
from service.engine.commissioning import CommissioningProgress
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import FeederMonitor, Phase
from service.engine.operators import Operators
from service.errors import FeederFixed, TooManyFeeders
from service.ingest.align import Clock
from service.ingest.queues import Inbox, Sample
from service.metrics import Metrics
from service.report import feeder_info
from service.report.feeder_info import Ownership
from service.report.report import FeederReport
from service.report.tick_state import TickState
from service.store import OutcomeUnknown, Store, StoreUnavailable
from service.store.committer import Publisher, WriteResult

SAMPLES_PER_ROUND = 512
"""Payloads of one round if senders wait. With the wall clock a round takes all waiting samples."""
GATHER_S = 0.005
"""Pause after a wake-up by readings, s: a round costs the same for one reading as for dozens."""
LAST_COMMIT_S = 1.5
"""Time limit of the last commit after `stop`, s: the service ends within 3 s."""
IDLE_S = 1.0
STUCK_S = 30.0
SETTLED_S = 5.0
"""Time after the latest design until `settled` is called, s: its cost grows with the number of feeders."""
COMMAND_S = 10.0
"""Time limit of a command with the database, s: an earlier write and its own."""
WAITING = 4
"""Wake-ups that wait for one reader: a later one replaces the oldest."""
STOPPING = "the service is stopping"

T = TypeVar("T")

_log = structlog.get_logger("gridsec.runtime")


class WakeUps:
    """Wake-ups of streams. A slow reader finds the latest `WAITING`. Used from the event loop only."""

    def __init__(self) -> None:
        self._queues: set[asyncio.Queue[str]] = set()
        self._ended = False

    def notify(self, kind: str) -> None:
        """Wake all subscribers."""
        for queue in self._queues:
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(kind)

    def end(self) -> None:
        """End every subscription soon."""
        self._ended = True
        self.notify("stop")

    async def subscribe(self) -> AsyncGenerator[dict[str, Any], None]:
        """Yield each wake-up until `end`."""
        queue: asyncio.Queue[str] = asyncio.Queue(maxsize=WAITING)
        self._queues.add(queue)
        try:
            while not self._ended:
                kind = await queue.get()
                if kind == "stop":
                    return
                yield {"type": kind, "data": None}
        finally:
            self._queues.discard(queue)


class Network(Publisher, Protocol):
    """Source of readings and destination of results, such as `zenoh_bus.Bus`."""

    def follow(self, feeder: str) -> None:
        """Receive the readings of a feeder; idempotent."""

    def unfollow(self, feeder: str) -> None:
        """End the effect of `follow`; idempotent."""

    def discard(self, feeders: Collection[str]) -> None:
        """Count the readings of exactly these followed feeders, and deliver none, from the next look on."""


class Runtime:
    """The running service; backend of the API.

    sites: the monitored feeders.
    given: names of the feeders that REST cannot delete; None: all of them.
    unloaded: stored feeders that cannot be loaded and are not monitored, with the reason.
    wall: wall clock, Unix s.
    settled: called between two rounds, `SETTLED_S` after the last design.
    """

    def __init__(
        self,
        config: RuntimeConfig,
        store: Store,
        sites: Iterable[Site],
        *,
        given: Iterable[str] | None = None,
        unloaded: Mapping[str, str] | None = None,
        wall: Callable[[], float] = time.time,
        settled: Callable[[], None] = lambda: None,
    ) -> None:
        self._wall, self._settled = wall, settled
        # Time of the latest design, monotonic s, until `settled` is called.
        self._installed: float | None = None
        self._stopping = False
        self._engine = Engine(
            config,
            store,
            sites,
            wall=wall,
            stored=lambda: self._in_loop(partial(self._streams.notify, "alarm")),
            apart=self._write_apart,
            unloaded=unloaded,
            go_on=lambda: not self._stopping and config.acts(),
        )
        # With `Clock.EVENTS` samples wait for ticks and for the database.
        self._waits = config.clock is Clock.EVENTS
        self._given = frozenset(self._engine.monitors) if given is None else frozenset(given)
        self._inbox = Inbox(
            lambda: self._in_loop(self._wake.set),
            max_samples=config.max_samples,
            lossless=self._waits,
            feeder_of=self._feeder_of,
        )
        self._prefix = f"{config.prefix}/"
        self._bus: Network | None = None
        self._followed: Mapping[str, FeederMonitor] = {}
        self._commands: deque[tuple[Callable[[], Future[Any]], asyncio.Future[Any]]] = deque()
        self._prepared: set[asyncio.Future[tuple[Site, DesignedEstimator]]] = set()
        self._streams = WakeUps()
        self._outcomes: deque[Callable[[], None]] = deque()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="gridsec-round")
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="gridsec-store")
        self._loop: asyncio.AbstractEventLoop | None = None
        self._wake = asyncio.Event()
        self._last_round: float | None = None
        self._died: str | None = None

    # ---------------------------------------------------------------- the task

    def _feeder_of(self, key: str) -> str | None:
        """Monitored feeder of a zenoh key, or None."""
        name = key.removeprefix(self._prefix).partition("/")[0]
        return name if name in self._engine.monitors else None

    def attach(self, bus: Network) -> None:
        """Set the source of readings and destination of estimates and alarms; called before `run`."""
        self._bus = self._engine.committer.publisher = bus

    def deliver(self, batch: list[Sample]) -> int:
        """Take samples from the receiving thread; return the number of dropped ones.

        Dropped samples without a feeder are no sign of overload, and are not among them.
        """
        before = self._inbox.surplus
        dropped = self._inbox.put(batch)
        self._engine.metrics.samples.inc(len(batch))
        self._engine.metrics.dropped.inc(dropped + self._inbox.surplus - before)
        return dropped

    def count(self, feeder: str, offered: int, dropped: int) -> None:
        """Count samples of a feeder that the receiving thread does not deliver; some of them are dropped."""
        self._inbox.count(feeder, offered, dropped)
        self._engine.metrics.samples.inc(offered)
        self._engine.metrics.dropped.inc(dropped)

    def expects(self, key: str) -> bool:
        """True for a zenoh key of single readings of a monitored meter."""
        return self._engine.expects(key)

    async def run(self) -> None:
        """Run rounds until `stop`.

        Raises WriterLost if another process may have written the database; nothing more is stored.
        """
        self._loop = asyncio.get_running_loop()
        try:
            await self._loop.run_in_executor(self._writer, self._engine.begin, self._given)
            for monitor in self._engine.monitors.values():
                self._design(monitor)
            while not self._stopping:
                self._check_writer()
                if not self._engine.config.acts():
                    await asyncio.sleep(GATHER_S)
                    continue
                await self._execute_commands()
                self._follow()
                news = await self._in_worker(self._round)
                self._last_round = time.monotonic()
                self._engine.metrics.queue.set(len(self._inbox))
                if news:
                    self._streams.notify("state")
                await self._pause()
            await self._end()
            self._check_writer()
        except BaseException as error:
            text = error.public if isinstance(error, StoreUnavailable) else str(error)
            self._died = f"{type(error).__name__}: {text}"
            raise
        finally:
            self.stop()
            for _, answer in self._commands:
                answer.cancel()
            self._worker.shutdown(wait=False)
            self._writer.shutdown(wait=False)

    def _follow(self) -> None:
        """Subscribe to the readings of exactly the monitored feeders."""
        monitored = self._engine.monitors
        if self._bus is None or monitored is self._followed:
            return
        for name in self._followed.keys() - monitored.keys():
            self._bus.unfollow(name)
        for name in monitored.keys() - self._followed.keys():
            self._bus.follow(name)
        self._followed = monitored

    def _design(self, monitor: FeederMonitor) -> None:
        design_jobs.begin(monitor, lambda install: self._in_loop(partial(self._hand_over, install)))

    def _round(self) -> bool:
        news = self._engine.cycle(self._samples(), self._inbox.oldest)
        if not self._waits:
            self._engine.control(self._inbox)
            if self._bus is not None:
                self._bus.discard(self._inbox.shed)
        self._settle()
        return news

    def _check_writer(self) -> None:
        if (lost := self.store.lost) is not None:
            raise lost

    def stop(self) -> None:
        """End `run` and every subscription soon; called from the event loop."""
        self._stopping = True
        self._inbox.close()
        for prepared in self._prepared:
            if not prepared.done():
                prepared.set_exception(StoreUnavailable(STOPPING, code="stopping"))
        self._wake.set()
        self._streams.end()

    def _samples(self) -> list[Sample]:
        """Return the samples of the next round; with `Clock.EVENTS` none before the last ones are stored."""
        if not self._waits:
            return self._inbox.drain(len(self._inbox))
        busy = self._engine.behind or self._engine.committer.storing
        return [] if busy else self._inbox.drain(SAMPLES_PER_ROUND)

    async def _pause(self) -> None:
        """Wait for samples, commands or the next tick."""
        commands = self._commands and self._engine.committer.takes_commands
        if self._stopping or self._outcomes or commands or self._engine.behind:
            await asyncio.sleep(0)
            return
        if len(self._inbox) and not (self._waits and self._engine.committer.storing):
            await asyncio.sleep(0.0 if self._waits else GATHER_S)
            return
        now = self._wall()
        timeout = min(IDLE_S, self._engine.wake - now)
        if timeout > 0.0:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), timeout)
        self._wake.clear()
        if len(self._inbox) and not self._waits:
            await asyncio.sleep(GATHER_S)

    async def _in_worker(self, run: Callable[..., T], *arguments: Any) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._worker, run, *arguments)

    def _write_apart(self, write: Callable[[], WriteResult], then: Callable[[WriteResult], None]) -> None:
        """Write in a separate thread; its result is processed between two rounds."""

        def run() -> None:
            try:
                done = write()
            except Exception as error:  # noqa: BLE001 - without a result nothing would be stored any more
                done = WriteResult(error=StoreUnavailable(f"{type(error).__name__}: {error}", code="defect"))
            self._in_loop(partial(self._take_in, partial(then, done)))

        self._writer.submit(run)

    def _take_in(self, outcome: Callable[[], None]) -> None:
        self._outcomes.append(outcome)
        self._wake.set()

    async def _end(self) -> None:
        """Store the remaining data, if the database answers in time."""
        try:
            await asyncio.wait_for(self._last_commit(), LAST_COMMIT_S)
        except TimeoutError:
            # Requests are answered with success only after their commit.
            waiting = len(self._engine.committer.waiting)
            _log.error("the database did not answer before the end", transitions=waiting, s=LAST_COMMIT_S)

    async def _last_commit(self) -> None:
        """Store the remaining data, after the write in progress."""
        await self._wait_for_write()
        await self._in_worker(partial(self._engine.keep_states, at_once=True))
        await self._in_worker(partial(self._engine.committer.commit, at_once=True))
        await self._wait_for_write()

    async def _wait_for_write(self) -> None:
        """Wait for the write in progress, and process its result."""
        await self._take_outcomes()
        while self._engine.committer.storing:
            await self._wake.wait()
            self._wake.clear()
            await self._take_outcomes()

    async def _take_outcomes(self) -> None:
        while self._outcomes:
            await self._in_worker(self._outcomes.popleft())

    async def _execute_commands(self) -> None:
        await self._take_outcomes()
        # Only one write is in progress at a time; one before a command comes first.
        while self._commands and self._engine.committer.takes_commands:
            command, answer = self._commands.popleft()
            try:
                found = await self._in_worker(command)
            except GridsecError as error:
                if not answer.done():
                    answer.set_exception(error)
            else:
                found.add_done_callback(partial(self._pass_on, answer))

    def _pass_on(self, answer: asyncio.Future[T], found: Future[T]) -> None:
        """Pass a command's result to the waiting request; called in any thread."""

        def give() -> None:
            if answer.done():
                return
            if (error := found.exception()) is not None:
                answer.set_exception(error)
            else:
                answer.set_result(found.result())

        self._in_loop(give)

    async def _command(self, run: Callable[[], Future[T]]) -> T:
        """Execute a command between two rounds, and wait for its result within a time limit."""
        self._go_on()
        answer: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        entry = (run, answer)
        self._commands.append(entry)
        self._wake.set()
        await asyncio.wait({answer}, timeout=COMMAND_S)
        if answer.done():
            return answer.result()
        answer.cancel()
        name = self.store.name
        if entry in self._commands:
            self._commands.remove(entry)
            text = f"{name}: the previous write has not ended within {COMMAND_S:g} s"
            raise StoreUnavailable(text, code="write-under-way")
        raise OutcomeUnknown(f"{name}: no answer within {COMMAND_S:g} s; its outcome is not known yet")

    def _go_on(self) -> None:
        if self._stopping:
            raise StoreUnavailable(STOPPING, code="stopping")

    def _in_loop(self, run: Callable[[], object]) -> None:
        """Call a function in the event loop, from any thread; ignored after the end of the loop."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(run)

    def _hand_over(self, install: Callable[[], None]) -> None:
        def run() -> None:
            install()
            self._installed = time.monotonic()

        self._take_in(run)

    def _settle(self) -> None:
        """Call `settled` once no design has been installed for `SETTLED_S`."""
        if self._installed is None or time.monotonic() - self._installed < SETTLED_S:
            return
        if all(monitor.phase is not Phase.DESIGNING for monitor in self._engine.monitors.values()):
            self._installed = None
            self._settled()

    # ---------------------------------------------------------------- the backend of the API

    @property
    def store(self) -> Store:
        """The database."""
        return self._engine.store

    def feeders(self) -> list[dict[str, Any]]:
        """Return the summary of every feeder, with the phase of its monitor and of the commissioning."""
        watched = [
            {
                **feeder_info.summary(monitor.site),
                "max_attacked": monitor.max_attacked,
                "phase": str(monitor.phase),
                "problem": monitor.problem or None,
                "patience_s": monitor.patience_s,
                "ticks_skipped": monitor.skipped,
                "commissioning": str(monitor.commissioning.stage),
            }
            for monitor in self._engine.monitors.values()
        ]
        failed = [
            {"name": name, "phase": str(Phase.FAILED), "problem": problem}
            for name, problem in self._engine.unloaded.copy().items()
        ]
        return watched + failed

    def feeder(self, name: str) -> dict[str, Any] | None:
        """Return all properties of a feeder, or None."""
        monitor = self._engine.monitors.get(name)
        if monitor is None:
            return None
        fields = feeder_info.detail(monitor.site, monitor.patience_s)
        return {**fields, "max_attacked": monitor.max_attacked}

    def known(self, name: str) -> bool:
        """True if a feeder is monitored."""
        return name in self._engine.monitors

    def unloaded(self, name: str) -> str | None:
        """Return the reason why the stored tables of a feeder cannot be loaded, or None."""
        return self._engine.unloaded.get(name)

    def report(self, name: str) -> FeederReport | None:
        """Return a feeder's latest report, or None."""
        monitor = self._engine.monitors.get(name)
        return None if monitor is None else monitor.report

    async def latest(self, name: str) -> FeederReport | None:
        """Return a feeder's latest report, or None."""
        return self.report(name)

    def ownership(self, name: str) -> Ownership | None:
        """Return the worker that monitors a feeder: this process, or None without workers."""
        return self._engine.config.ownership(name)

    def summary(self, name: str) -> dict[str, Any]:
        """Return the numbers of a feeder in the list of feeders; empty before its first tick."""
        monitor = self._engine.monitors.get(name)
        latest = None if monitor is None else monitor.latest
        return {} if latest is None else {**latest.summary, "age_s": self.age(latest)}

    def age(self, report: FeederReport | TickState) -> float:
        """Return the age of a feeder's latest report by the service's clock, s.

        With `Clock.EVENTS` the age counts from the creation of the report.
        """
        now = time.monotonic()
        since = now - self._engine.reported.get(report.feeder, now)
        return since if self._engine.config.clock is Clock.EVENTS else max(since, self._wall() - report.t)

    def commissioning(self, name: str) -> CommissioningProgress | None:
        """Return the progress of a feeder's commissioning, or None."""
        monitor = self._engine.monitors.get(name)
        return None if monitor is None else monitor.commissioning.progress()

    def unstored(self) -> tuple[int, str | None]:
        """Return the number of alarm changes that wait for the database, and its problem or None."""
        keeper = self._engine.committer
        return len(keeper.waiting), "; ".join(keeper.problems()) or None

    @property
    def counters(self) -> Metrics:
        """Counters and gauges of the service."""
        return self._engine.metrics

    def metrics(self) -> bytes:
        """Return the metrics in Prometheus's text format."""
        return self._engine.metrics.exposition()

    def healthy(self) -> tuple[bool, list[str]]:
        """Return True if the process can continue, and the problems otherwise."""
        problems = []
        if self._died is not None:
            problems.append(f"the runtime has ended: {self._died}")
        elif self._last_round is not None and time.monotonic() - self._last_round > STUCK_S:
            problems.append(f"the runtime has been stuck for {time.monotonic() - self._last_round:.0f} s")
        return not problems, problems

    def ready(self) -> tuple[bool, list[str]]:
        """Return True if everything needed for monitoring works, and the problems otherwise."""
        engine = self._engine
        problems = self.healthy()[1]
        if self._last_round is None:
            problems.append("the runtime is starting")
        problems.extend(engine.committer.problems())
        publisher = engine.committer.publisher
        if publisher is not None and publisher.failure is not None:
            problems.append(f"zenoh: {publisher.failure}")
        for monitor in engine.monitors.values():
            if monitor.phase is Phase.DESIGNING:
                problems.append(f"feeder {monitor.name}: the design of the monitor is not finished")
            elif monitor.phase is Phase.FAILED:
                problems.append(f"feeder {monitor.name}: {monitor.problem}")
            # With `Clock.EVENTS` the time may stand still.
            told, waits = monitor.latest, engine.config.clock is Clock.WALL
            if waits and told is not None and monitor.stale(age := self.age(told)):
                problems.append(f"feeder {monitor.name}: the latest report is {age:.0f} s old")
        # The list follows the decision with a tick, and stays after the return until a verdict is sure.
        if shed := max(len(self._inbox.shed), engine.shed_displayed()):
            problems.append(f"overload: {shed} of {len(engine.monitors)} feeders are not monitored")
        for name, problem in engine.unloaded.copy().items():
            problems.append(f"feeder {name}: {problem}")
        return not problems, problems

    async def put_feeder(self, name: str, tables: dict[str, Any]) -> None:
        """Take over a feeder's tables: check, design, store, start monitoring; all or nothing.

        Raises FeederInvalid, NotObservable, DesignInfeasible, TooManyFeeders, StoreUnavailable if it cannot
        be taken over; the feeder stays unchanged.
        """
        self._go_on()
        self._make_room(name)
        prepared = design_jobs.prepare(name, tables)
        self._prepared.add(prepared)
        prepared.add_done_callback(self._prepared.discard)
        site, finished = await prepared

        def installed(monitor: FeederMonitor) -> None:
            design_jobs.install(monitor, finished, "")
            self._installed = time.monotonic()

        def put() -> Future[None]:
            self._make_room(name)
            return self._engine.put(site, tables, installed)

        await self._command(put)

    async def adopt(self, sites: Sequence[Site]) -> None:
        """Go on with feeders of another process as `Engine.adopt` does; their designs follow."""
        await self._command(partial(self._engine.adopt, sites, self._design))
        self._streams.notify("state")

    async def resign(self, names: Collection[str]) -> None:
        """End the monitoring of feeders as `Engine.resign` does; their state is stored when this returns."""
        await self._command(partial(self._engine.resign, names))
        for name in names:
            self._inbox.forget(name)
        self._streams.notify("state")

    def set_unloaded(self, reasons: Mapping[str, str]) -> None:
        """Note the feeders of this process that cannot be loaded, with the reasons."""
        self._engine.unloaded = dict(reasons)

    def _make_room(self, name: str) -> None:
        """Check the limit of feeders before one more is added."""
        put = (self._engine.monitors.keys() | self._engine.unloaded.keys()) - self._given
        most = self._engine.config.max_feeders
        if name not in put | self._given and len(put) >= most:
            raise TooManyFeeders(most)

    async def delete_feeder(self, name: str) -> None:
        """Stop monitoring a feeder that was added over REST; its alarms are cleared, its history stays.

        Raises FeederUnknown, FeederFixed, StoreUnavailable if it cannot be deleted; monitoring then
        continues.
        """
        if name in self._given:
            raise FeederFixed(name)
        await self._command(partial(self._engine.remove, name))
        self._streams.notify("state")

    async def acknowledge(self, alarm_id: str, who: str, comment: str, *, count: int | None = None) -> Alarm:
        """Acknowledge an alarm as `Engine.acknowledge` does; it is stored when this returns."""
        return await self._command(partial(self._engine.acknowledge, alarm_id, who, comment, count=count))

    async def operate(self, action: Callable[[Operators], Future[T]]) -> T:
        """Execute an action of an operator between two rounds; it is stored when this returns."""
        return await self._command(partial(action, self._engine.operators))

    @property
    def shelve_most_s(self) -> float:
        """Longest time of a shelf, s."""
        return self._engine.operators.shelve_most_s

    async def recommission(
        self, name: str, meters: Sequence[str], who: str, reason: str
    ) -> CommissioningProgress:
        """Restart the learning as `Engine.recommission` does; it is stored when this returns."""
        return await self._command(partial(self._engine.recommission, name, meters, who, reason))

    def subscribe(self) -> AsyncGenerator[dict[str, Any], None]:
        """Yield a wake-up after each stored alarm and each new report, until the service stops."""
        return self._streams.subscribe()
