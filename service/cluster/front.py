"""The front of a cluster: REST, web page, event streams and notifications; no engine.

Alarms, incidents and history come from the database. Lists of feeders come from the states of the workers:
a feeder without an owner is in them as undecided, cause `no-owner`. Requests for one feeder go to its owner.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import time
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Final, TypeVar

import structlog
from pydantic import TypeAdapter

from feeders.format.tables import to_json
from feeders.model.site import Site
from gridsec.errors import GridsecError
from gridsec.interface import Cause, Decision
from service.access.identity import OPEN
from service.alarms.state_machine import Alarm, AlarmUnknown
from service.cluster.catalogue import Catalogue, digest
from service.cluster.forward import DESIGN_S, Forwarder, StateCalls, Workers, get
from service.cluster.messages import Call
from service.engine.commissioning import CommissioningProgress
from service.engine.operators import Operators
from service.engine.runtime import WakeUps
from service.errors import FeederUnknown, NoOwner, WorkerBusy
from service.metrics import Metrics
from service.report.feeder_info import Ownership
from service.report.report import FeederReport
from service.store import Store, StoreUnavailable
from service.store.incidents import suppression_mark
from service.store.leases import clock_problem

_SAMPLE = re.compile(rb"^([A-Za-z_:][A-Za-z0-9_:]*)(?:\{(.*)\})? (.+)$")
"""A sample: name, labels, value with an optional time."""


def merged(parts: Mapping[str, bytes]) -> bytes:
    """Return the samples of all parts, those of one metric together; its help is that of the first part.

    parts: text by worker; samples of the worker "" get no label.
    """
    heads: dict[bytes, list[bytes]] = {}
    samples: dict[bytes, list[bytes]] = {}
    for worker, text in parts.items():
        family = b""
        first: set[bytes] = set()
        for line in text.splitlines():
            if line.startswith((b"# HELP ", b"# TYPE ")):
                family = line.split(b" ")[2]
                if family not in heads:
                    first.add(family)
                if family in first:
                    heads.setdefault(family, []).append(line)
                samples.setdefault(family, [])
            elif line and not line.startswith(b"#"):
                samples.setdefault(family, []).append(_labelled(line, worker))
    lines = [line for family, own in samples.items() for line in (*heads.get(family, ()), *own)]
    return b"\n".join(lines) + b"\n" if lines else b""


def _labelled(line: bytes, worker: str) -> bytes:
    found = _SAMPLE.match(line)
    if not worker or found is None:
        return line
    name, labels, value = found.groups()
    both = b",".join(part for part in (labels, f'worker="{worker}"'.encode()) if part)
    return b"%s{%s} %s" % (name, both, value)


POLL_S: Final = 0.2
"""Interval of the reads of the newest event, s."""
REFRESH_S: Final = 1.0
"""Interval of the reads of the feeders in the database, s."""
METRICS_S: Final = 5.0
"""Time limit of a worker's answer to a request for its metrics, s."""
PUT_AGAIN_S: Final = 0.5
"""Wait before a feeder of the command line is put again, s."""
PUT_AT_ONCE: Final = 8
"""Number of feeders of the command line that are put at the same time."""
T = TypeVar("T")
_REPORT = TypeAdapter(FeederReport)
_log = structlog.get_logger("gridsec.cluster")


class ObservedStore(Store):
    """Database of a front, which writes nothing."""

    _mark: tuple[tuple[float, ...], ...] = ()

    def refresh(self) -> None:
        """Read the newest events, and count changes of shelves and planned works."""
        super().refresh()
        with self._read() as connection:
            mark = suppression_mark(connection)
        if mark != self._mark:
            self._mark = mark
            self._suppression_changes += 1

    def check(self) -> None:
        """Test a read. Raises StoreUnavailable if the database does not answer."""
        self.refresh()


class Front:
    """Backend of the API over workers.

    store: database, which the front observes.
    workers: the heard workers.
    catalogue: feeders of the database.
    given: feeders of the command line.
    live_workers: names of the workers with a lease in the database.
    cluster_time: time of the database, Unix s.
    shelve_most_s: longest time of a shelf, s.
    wall: wall clock, Unix s.
    """

    def __init__(
        self,
        store: Store,
        workers: Workers,
        catalogue: Catalogue,
        given: Mapping[str, Site],
        *,
        live_workers: Callable[[], list[str]],
        cluster_time: Callable[[], float] = time.time,
        shelve_most_s: float,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.store = store
        self.shelve_most_s = shelve_most_s
        self._workers, self._catalogue = workers, catalogue
        self._way: Forwarder | None = None
        self._states: StateCalls | None = None
        self._given, self._live_workers = given, live_workers
        self._wall, self._cluster_time = wall, cluster_time
        self._metrics = Metrics()
        self._missing = set(given)
        self._problem: str | None = None
        self._registered: list[str] = []
        self._newest = (store.last_event, store.last_incident_event)
        self._read = asyncio.Event()
        self._streams = WakeUps()
        self._stopping = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._latest: dict[str, tuple[tuple[str, int, float], FeederReport]] = {}
        self._fetching: dict[str, asyncio.Lock] = {}

    def attach(self, forwarder: Forwarder, states: StateCalls) -> None:
        """Set the ways to the workers; called before `run`."""
        self._way, self._states = forwarder, states

    @property
    def _forwarder(self) -> Forwarder:
        if self._way is None:
            raise NoOwner("")
        return self._way

    # ------------------------------------------------------------------------------------------------ tasks

    async def run(self) -> None:
        """Follow the database, and put the feeders of the command line, until `stop`."""
        self._loop = asyncio.get_running_loop()
        side = [
            asyncio.create_task(self._put_given(), name="given feeders"),
            asyncio.create_task(self._follow(), name="new events"),
        ]
        try:
            while not self._stopping.is_set():
                await self.refresh()
                try:
                    await asyncio.wait_for(self._stopping.wait(), REFRESH_S)
                except TimeoutError:
                    continue
        finally:
            if self._states is not None:
                self._states.follow(())
            for task in side:
                task.cancel()
            await asyncio.gather(*side, return_exceptions=True)

    async def _follow(self) -> None:
        """Read the numbers of the newest events, and wake streams after a change."""
        while True:
            with contextlib.suppress(StoreUnavailable):  # `refresh` reports it
                await self._read_events()
            await asyncio.sleep(POLL_S)

    async def _read_events(self) -> None:
        await asyncio.to_thread(self.store.refresh)
        newest = (self.store.last_event, self.store.last_incident_event)
        if newest != self._newest:
            self._newest = newest
            self._streams.notify("alarm")

    async def refresh(self) -> None:
        """Read the feeders and the newest events of the database."""
        try:
            await self._read_events()
            changes = await asyncio.to_thread(self._catalogue.refresh)
            self._registered = await asyncio.to_thread(self._live_workers)
        except StoreUnavailable as error:
            self._problem = f"database: {error}"
            return
        if self._states is not None and not self._stopping.is_set():
            # After an outage of the database the leases of all workers are absent for some seconds.
            self._states.follow({*self._registered, *(one.worker for one in self._workers.states())})
        self._problem = None
        self._read.set()
        if changes.added or changes.removed:
            self._streams.notify("state")

    async def _put_given(self) -> None:
        """Put the feeders of the command line into the database, through the owners of their shards."""
        await self._read.wait()
        left = iter(self._given.items())

        async def put_next() -> None:
            for name, site in left:
                await self._put_one(name, site)

        # The owners store one after the other while the next designs are made.
        await asyncio.gather(*(put_next() for _ in range(PUT_AT_ONCE)))

    async def _put_one(self, name: str, site: Site) -> None:
        """Put one feeder until its owner takes or refuses it."""
        tables = to_json(site.tables)
        ours = digest(tables)
        while True:
            entry = self._catalogue.feeders.get(name)
            same = entry is not None and entry.digest == ours
            stored = True if same else await self._put(name, tables)
            if stored:
                self._missing.discard(name)
            if stored is not None:
                return
            await asyncio.sleep(PUT_AGAIN_S)

    async def _put(self, name: str, tables: Mapping[str, Any]) -> bool | None:
        """True if the owner has stored the tables, False if it refuses them, None without an outcome."""
        body = json.dumps(tables).encode()
        headers = (("content-type", "application/json"), ("accept", "application/json"))
        try:
            call = Call("PUT", f"/api/v1/feeders/{name}", "", headers, body, OPEN)
            answer = await self._forwarder.ask(name, call, DESIGN_S)
        except (NoOwner, WorkerBusy, StoreUnavailable):
            return None
        if 400 <= answer.status < 500:
            detail = json.loads(answer.body or b"{}").get("detail")
            _log.error("a feeder of the command line is refused", feeder=name, problem=detail)
            return False
        return True if answer.status == 200 else None

    def stop(self) -> None:
        """End `run` and every subscription soon; called from the event loop."""
        self._stopping.set()
        self._streams.end()

    def heard(self) -> None:
        """Wake streams after a state of a worker; called from any thread."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._streams.notify, "state")

    def subscribe(self) -> AsyncGenerator[dict[str, Any], None]:
        """Yield a wake-up after each stored alarm and each state of a worker, until the service stops."""
        return self._streams.subscribe()

    # ---------------------------------------------------------------------------------------------- feeders

    def names(self) -> Mapping[str, Any]:
        """All feeders: of the command line first, then of the database."""
        return {**self._given, **self._catalogue.feeders}

    def feeders(self) -> list[dict[str, Any]]:
        """Return the entry of every feeder, with its worker; without one its phase is `no-owner`."""
        found = []
        for name in self.names():
            entry = self._workers.entry(name)
            if entry is not None:
                owned = self.ownership(name)
                worker = None if owned is None else owned.worker
                found.append({**entry.fields, "owner": worker})
                continue
            listed, last = self._catalogue.feeders.get(name), self._workers.last_entry(name)
            title = name if listed is None else listed.title
            known = {"title": title} if last is None else last.fields
            found.append({**known, "name": name, "phase": str(Cause.NO_OWNER), "owner": None})
        return found

    def summary(self, name: str) -> dict[str, Any]:
        """Return the numbers of a feeder in the list of feeders."""
        entry = self._workers.entry(name)
        if entry is not None:
            return dict(entry.now)
        before = self._workers.last_entry(name)
        now = {} if before is None else dict(before.now)
        undecided = {
            "verdict": str(Decision.UNDECIDED),
            "displayed_verdict": str(Decision.UNDECIDED),
            "cause": str(Cause.NO_OWNER),
            "model_only": False,
            "suspects": 0,
            "since": None,
            "displayed_since": None,
            "age_s": None,
        }
        return {**now, **undecided}

    def feeder(self, name: str) -> dict[str, Any] | None:
        """Return the meters of a feeder as in its layout, or None."""
        listed, site = self._catalogue.feeders.get(name), self._given.get(name)
        if listed is None and site is None:
            return None
        meters = listed.meters if listed is not None else () if site is None else site.meter_ids
        return {"name": name, "layout": {"customers": [{"meter": meter} for meter in meters]}}

    def known(self, name: str) -> bool:
        """True if a feeder exists and its tables can be loaded."""
        return name in self.names() and self.unloaded(name) is None

    def unloaded(self, name: str) -> str | None:
        """Return the reason why the stored tables of a feeder cannot be loaded, or None."""
        entry = self._workers.entry(name)
        if entry is None or "tick_s" in entry.fields:
            return None
        return str(entry.fields.get("problem"))

    def report(self, name: str) -> FeederReport | None:
        """Return the latest report that this process has fetched for a stream, or None."""
        kept = self._latest.get(name)
        return None if kept is None else kept[1]

    async def latest(self, name: str) -> FeederReport | None:
        """Return the latest report of a feeder from its owner; the same object until the next tick."""
        found, entry = self._workers.owner(name), self._workers.entry(name)
        if found is None or entry is None or entry.t is None:
            return None
        tag = (found[0].worker, found[1], entry.t)
        async with self._fetching.setdefault(name, asyncio.Lock()):
            kept = self._latest.get(name)
            if kept is not None and kept[0] == tag:
                return kept[1]
            try:
                answer = await self._forwarder.ask(name, get(f"/api/v1/feeders/{name}/state"))
            except GridsecError:
                return None
            if answer.status != 200:
                return None
            made = _REPORT.validate_json(answer.body)
            self._latest[name] = (tag, made)
            return made

    def ownership(self, name: str) -> Ownership | None:
        """Return the worker that monitors a feeder, or None."""
        found = self._workers.owner(name)
        return None if found is None else Ownership(found[0].worker, found[1])

    def age(self, report: FeederReport) -> float:
        """Return the age of a feeder's latest report by the clock of its worker, s."""
        entry = self._workers.entry(report.feeder)
        if entry is None or entry.t is None:
            return max(0.0, self._wall() - report.t)
        return max(0.0, float(entry.now["age_s"]) + entry.t - report.t)

    def commissioning(self, name: str) -> CommissioningProgress | None:
        """Return None: the owner of a feeder answers requests for its commissioning."""
        del name
        return None

    # --------------------------------------------------------------------------------------------- operation

    def unstored(self) -> tuple[int, str | None]:
        """Return the number of alarm changes that wait in all workers, and their problems or None."""
        states = self._workers.states()
        problems = [f"{one.worker}: {one.problem}" for one in states if one.problem]
        return sum(one.unstored for one in states), "; ".join(problems) or None

    @property
    def counters(self) -> Metrics:
        """Counters and gauges of this process."""
        return self._metrics

    def metrics(self) -> bytes:
        """Return the metrics of this process and of all workers, with the label `worker`. Blocks."""
        parts = {"": self._metrics.exposition()}
        for one in self._workers.states():
            answer = self._forwarder.ask_blocking(one.worker, get("/metrics"), METRICS_S)
            if answer is not None and answer.status == 200:
                parts[one.worker] = answer.body
        return merged(parts)

    def healthy(self) -> tuple[bool, list[str]]:
        """Return True if the process can continue."""
        return True, []

    def ready(self) -> tuple[bool, list[str]]:
        """Return True if every feeder has an owner that is ready, and the problems otherwise."""
        states = self._workers.states()
        heard = {one.worker for one in states}
        problems = [] if states else ["no worker answers"]
        problems += [f"worker {name}: silent on zenoh" for name in self._registered if name not in heard]
        if self._problem is not None:
            problems.append(self._problem)
        elif (problem := clock_problem(self._wall(), self._cluster_time())) is not None:
            problems.append(f"front: {problem}")
        problems += [f"feeder {name}: it is not in the database yet" for name in sorted(self._missing)]
        problems += [
            f"feeder {name}: no worker monitors it"
            for name in self._catalogue.feeders
            if self._workers.entry(name) is None
        ]
        problems += [f"{one.worker}: {reason}" for one in states for reason in one.reasons]
        return not problems, problems

    # ------------------------------------------------- commands: the owners execute them, see `Forwarder`

    async def put_feeder(self, name: str, tables: dict[str, Any]) -> None:
        """Raise NoOwner: the owner takes over tables."""
        del tables
        raise NoOwner(name)

    async def delete_feeder(self, name: str) -> None:
        """Raise FeederUnknown: the owner of a known feeder deletes it."""
        raise FeederUnknown(name)

    async def acknowledge(self, alarm_id: str, who: str, comment: str, *, count: int | None = None) -> Alarm:
        """Raise AlarmUnknown: the owner of a known alarm acknowledges it."""
        del who, comment, count
        raise AlarmUnknown(alarm_id)

    async def operate(self, action: Callable[[Operators], Future[T]]) -> T:
        """Raise AlarmUnknown: owners execute the actions on known subjects."""
        del action
        raise AlarmUnknown("of this action")

    async def recommission(
        self, name: str, meters: Sequence[str], who: str, reason: str
    ) -> CommissioningProgress:
        """Raise FeederUnknown: the owner of a known feeder restarts the learning."""
        del meters, who, reason
        raise FeederUnknown(name)
