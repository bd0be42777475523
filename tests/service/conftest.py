"""A small service around the real alarms, store and HTTP application, for tests of what stands on top."""

from __future__ import annotations

import asyncio
import math
import os
import secrets
import shutil
import threading
import time
from collections.abc import AsyncGenerator, Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import uvicorn
from anyio import CapacityLimiter
from fastapi import FastAPI
from playwright.sync_api import Browser, expect, sync_playwright
from pydantic import TypeAdapter

from gridsec.errors import FeederInvalid
from gridsec.interface import Cause, Decision
from service.alarms.state_machine import (
    Alarm,
    AlarmBook,
    AlarmRules,
    AlarmUnknown,
    advance,
    carry,
    conditions,
)
from service.api.routes import ACCESS_THREADS, MAX_STREAMS, create_api
from service.api.system import Probe
from service.engine.commissioning import CommissioningProgress
from service.engine.operators import SHELVE_MOST_S, Operators
from service.errors import FeederFixed, FeederUnknown, TooManyFeeders
from service.report.feeder_info import SHED_TICK_S, numbers, revision
from service.report.report import BusState, FeederReport, MeterState, Silence
from service.store import Store
from service.store.committer import Wish
from service.store.schema import CommissioningChange, CommissioningEvent
from tests.service.asking import T0, Setup
from tests.service.databases import Cluster, find_postgresql, running
from tests.service.looking import Site
from tests.service.reports import acknowledge

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
"""Programs, the first one that is present: the headless shell takes a third of the processor time."""
CHROMIUM = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]

PAGE_PATIENCE_MS = 30_000.0
"""Time limit of an expectation on a page, ms: that of actions, for machines with little processor time."""

NOMINAL = 230.94
STALE_S = 120.0
"""Age at which a tick is stale, s: a busy machine opens a page within it."""


class Village:
    """A feeder of a given number of customers: lines of ten from the busbar, each house on a drop."""

    def __init__(self, name: str = "village", customers: int = 13, prefix: str = "H") -> None:
        self.name = name
        self.buses, self.parent = ["busbar"], [None]
        self.customers: list[dict[str, Any]] = []
        for k in range(customers):
            pole = len(self.buses)
            self.buses += [f"pole-{k}", f"drop-{k}"]
            self.parent += [0 if k % 10 == 0 else pole - 2, pole]
            self.customers.append({"customer": f"{prefix}{k}", "bus": f"drop-{k}", "meter": f"{prefix}{k}"})
        self.meters = [c["meter"] for c in self.customers]

    @property
    def title(self) -> str:
        return f"{self.name.capitalize()}, {len(self.customers)} customers"

    def detail(self) -> dict[str, Any]:
        fields = {
            "name": self.name,
            "title": self.title,
            "v_nominal_volt": NOMINAL,
            "v_min_volt": 0.9 * NOMINAL,
            "v_max_volt": 1.1 * NOMINAL,
            "tick_s": 1.0,
            "patience_s": STALE_S,
            "patience_shed_s": STALE_S + SHED_TICK_S,
            "layout": {"buses": self.buses, "parent": self.parent, "xy": None, "customers": self.customers},
            "tables": {"meta": {"name": self.name}, "lines": [], "customers": []},
        }
        return {**fields, "revision": revision(fields)}

    def report(
        self,
        t: float,
        *,
        lies: dict[str, float] | None = None,
        silent: tuple[str, ...] = (),
        cause: Cause | None = None,
        volts: dict[str, float] | None = None,
        sag: float = 0.6,
    ) -> FeederReport:
        """Return a tick: voltages sag along the lines; `lies` are added to what meters report."""
        lies, volts = lies or {}, volts or {}
        cause = cause or (Cause.RESIDUALS if lies else Cause.SILENT_METERS if silent else Cause.AGREEMENT)
        true = [NOMINAL]
        for k, parent in enumerate(self.parent[1:], start=1):
            assert parent is not None
            true.append(true[parent] - sag * (0.3 if k % 2 == 0 else 1.0) + 0.2 * math.sin(t / 7 + k))
        at = dict(zip(self.buses, true, strict=True))
        meters = []
        for c in self.customers:
            name = c["meter"]
            v = volts.get(name, at[c["bus"]])
            lie = lies.get(name, 0.0)
            seen = name not in silent
            score = abs(2 * v * lie + lie * lie) / NOMINAL**2 + 1e-4
            meters.append(
                MeterState(
                    meter=name,
                    bus=c["bus"],
                    seen=seen,
                    suspect=bool(lie),
                    score=score if seen else None,
                    threshold=1.2e-2,
                    v_volt_reported=v + lie if seen else None,
                    v_volt_estimated=v,
                    v_volt_std=0.15,
                    v2_pu_estimated=(v / NOMINAL) ** 2,
                    attack_volt_estimated=lie,
                    v_min_volt=0.9 * NOMINAL,
                    v_max_volt=1.1 * NOMINAL,
                )
            )
        decision = {Cause.AGREEMENT: Decision.CLEAN, Cause.RESIDUALS: Decision.ATTACKED}
        verdict = decision.get(cause, Decision.UNDECIDED)
        reason = {
            Decision.CLEAN: "All meters agree with the feeder.",
            Decision.ATTACKED: f"{len(lies)} of {len(meters)} meters contradict the rest of the feeder.",
            Decision.UNDECIDED: f"No verdict: {cause.value.replace('-', ' ')}.",
        }[verdict]
        return FeederReport(
            feeder=self.name,
            t=t,
            verdict=verdict,
            reason=reason,
            cause=cause,
            max_attacked=2,
            meters=tuple(meters),
            buses=tuple(BusState(bus, v) for bus, v in at.items()),
            silent=tuple(Silence(name, 12.0) for name in silent),
            v_min_volt=0.9 * NOMINAL,
            v_max_volt=1.1 * NOMINAL,
        )


class InlineCommitter:
    """Writes and reads at once."""

    def __init__(self, service: SmallService) -> None:
        self.service = service

    def look(self, read: Callable[[Store], Any], landed: Callable[[Any], None], _: object) -> None:
        landed(read(self.service.store))

    def store(self, wish: Wish, landed: Callable[[], None], refused: object) -> None:
        self.store_and_read(wish, lambda _: None, lambda _: landed(), refused)

    def store_and_read(
        self, wish: Wish, read: Callable[[Store], Any], landed: Callable[[Any], None], _: object
    ) -> None:
        service = self.service
        service.store.commit(wish.transitions, actions=wish.actions, now=service.wall())
        landed(read(service.store))


class InlineEngine:
    """The part of an engine that actions of operators use."""

    def __init__(self, service: SmallService) -> None:
        self.service, self.store, self.committer = service, service.store, InlineCommitter(service)

    @property
    def monitors(self) -> dict[str, Any]:
        return {name: SimpleNamespace(book=book) for name, book in self.service.books.items()}

    def carry_over(self, alarm: Alarm) -> None:
        self.service.books[alarm.feeder] = carry(self.service.books[alarm.feeder], alarm) or AlarmBook("")


class SmallService:
    """A backend of the HTTP application: real alarms, real store, reports from the test."""

    def __init__(self, url: str, *villages: Village) -> None:
        self.store = Store(url)
        self.villages = {village.name: village for village in villages}
        self.reports: dict[str, FeederReport] = {}
        self.rules = AlarmRules()
        self.books = {name: AlarmBook(name) for name in self.villages}
        self.learning: set[str] = set()
        self.stalled: dict[str, str] = {}
        self.note = ""
        self.heard: dict[str, float] = {}
        self.delay_s = 0.0
        self.cannot_load: dict[str, str] = {}
        self.waits: tuple[int, str | None] = (0, None)
        self.is_ready: tuple[bool, list[str]] = (True, [])
        self.is_healthy: tuple[bool, list[str]] = (True, [])
        self.loop: asyncio.AbstractEventLoop | None = None
        self.queues: set[asyncio.Queue[dict[str, Any] | None]] = set()
        self.lock = threading.Lock()
        self.wall: Callable[[], float] = time.time
        self.operators = Operators(InlineEngine(self), self._now, SHELVE_MOST_S)  # type: ignore[arg-type]

    def _now(self) -> float:
        return self.wall()

    def tick(self, report: FeederReport) -> None:
        report = replace(report, revision=self.villages[report.feeder].detail()["revision"])
        with self.lock:
            book, transitions = advance(self.books[report.feeder], self.rules, conditions(report), report.t)
            self.store.commit(transitions, reports=[report])
            self.books[report.feeder], self.reports[report.feeder] = book, report
            self.heard[report.feeder] = time.monotonic()
        self.wake({"type": "state", "data": report})
        for _ in transitions:
            self.wake({"type": "alarm", "data": None})

    def wake(self, event: dict[str, Any] | None) -> None:
        def put() -> None:
            for queue in self.queues:
                if queue.full() and event is not None:
                    queue.get_nowait()
                queue.put_nowait(event)

        if self.loop is not None:
            self.loop.call_soon_threadsafe(put)

    def feeders(self) -> list[dict[str, Any]]:
        watched = [{"name": v.name, "title": v.title} for v in self.villages.values()]
        return watched + [{"name": name, "problem": why} for name, why in self.cannot_load.items()]

    def feeder(self, name: str) -> dict[str, Any] | None:
        return self.villages[name].detail() if name in self.villages else None

    def known(self, name: str) -> bool:
        return name in self.villages

    def unloaded(self, name: str) -> str | None:
        return self.cannot_load.get(name)

    def summary(self, name: str) -> dict[str, Any]:
        report = self.report(name)
        return {} if report is None else numbers(report, self.age(report))

    def report(self, name: str) -> FeederReport | None:
        return self.reports.get(name)

    async def latest(self, name: str) -> FeederReport | None:
        return self.report(name)

    def ownership(self, _: str) -> None:
        return None

    def age(self, report: FeederReport) -> float:
        return self.delay_s + time.monotonic() - self.heard[report.feeder]

    def commissioning(self, name: str) -> CommissioningProgress | None:
        village = self.villages.get(name)
        if village is None:
            return None
        open_ones = [m for m in village.meters if m in self.learning]
        now = self.reports[name].t if name in self.reports else None
        return TypeAdapter(CommissioningProgress).validate_python({
            "feeder": name, "estimator": "modal", "state": "learning" if open_ones else "learned",
            "t": now, "tick_s": 1.0, "needed_s": 86400.0, "gathered_s": 18_000.0 if open_ones else None,
            "since": T0 - 18_000.0 if open_ones else None, "expected": T0 + 68_400.0 if open_ones else None,
            "learned_at": None if len(open_ones) == len(village.meters) else T0 - 9e5,
            "held": False, "restored": True, "note": self.note,
            "expected_s": 86_401.0, "stalled": len(self.stalled),
            "meters": [
                {
                    "meter": m, "state": "learning" if m in open_ones else "learned",
                    "since": T0 - 18_000.0 if m in open_ones else None,
                    "learned_at": None if m in open_ones else T0 - 9e5,
                    "gathered_s": 18_000.0 if m in open_ones else None,
                    "expected": T0 + 68_400.0 if m in open_ones else None,
                    "error_volt": 0.0 if m in open_ones else 0.41,
                    "error_volt_std": 0.67 if m in open_ones else 0.09,
                    "allowed_volt": 1.15 if m in open_ones else 0.27,
                    "learning_state": "stalled" if m in self.stalled
                    else "learning" if m in open_ones else "learned",
                    "learning_reason": self.stalled.get(m),
                    "watched_s": 18_000.0 if m in open_ones else None,
                    "lost_s": {},
                }
                for m in village.meters
            ],
        })  # fmt: skip

    async def recommission(
        self, name: str, meters: Sequence[str], who: str, reason: str
    ) -> CommissioningProgress:
        chosen = tuple(meters) or tuple(self.villages[name].meters)
        event = CommissioningEvent(name, T0, CommissioningChange.RECOMMISSIONED, chosen, who, reason)
        await asyncio.to_thread(partial(self.store.commit, happened=[event]))
        self.learning.update(chosen)
        progress = self.commissioning(name)
        assert progress is not None
        return progress

    def unstored(self) -> tuple[int, str | None]:
        return self.waits

    def metrics(self) -> bytes:
        return b"# HELP gridsec_up Whether it runs.\n# TYPE gridsec_up gauge\ngridsec_up 1.0\n"

    def ready(self) -> tuple[bool, list[str]]:
        return self.is_ready

    def healthy(self) -> tuple[bool, list[str]]:
        return self.is_healthy

    async def put_feeder(self, name: str, tables: dict[str, Any]) -> None:
        if "customers" not in tables:
            raise FeederInvalid(["customers.csv: missing", "lines.csv: missing"])
        if len(self.villages) >= 3 and name not in self.villages:
            raise TooManyFeeders(3)
        self.villages[name] = Village(name, int(tables["customers"]))
        self.books[name] = AlarmBook(name)

    async def delete_feeder(self, name: str) -> None:
        if name == "village":
            raise FeederFixed(name)
        if name not in self.villages:
            raise FeederUnknown(name)
        del self.villages[name], self.books[name]
        self.reports.pop(name, None)
        self.wake({"type": "state", "data": None})

    async def acknowledge(self, alarm_id: str, who: str, comment: str, *, count: int | None = None) -> Alarm:
        for name, book in self.books.items():
            if any(alarm.id == alarm_id for alarm in book.alarms):
                t = self.reports[name].t
                self.books[name], transition = acknowledge(book, alarm_id, who, comment, t, count=count)
                await asyncio.to_thread(self.store.commit, [transition])
                self.wake({"type": "alarm", "data": None})
                return transition.alarm
        raise AlarmUnknown(alarm_id)

    @property
    def shelve_most_s(self) -> float:
        return self.operators.shelve_most_s

    async def operate(self, action: Callable[[Operators], Future[Any]]) -> Any:
        def run() -> Any:
            with self.lock:
                return action(self.operators).result(timeout=5)

        found = await asyncio.to_thread(run)
        self.wake({"type": "alarm", "data": None})
        return found

    async def subscribe(self) -> AsyncGenerator[dict[str, Any], None]:
        queue: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue(8)
        self.queues.add(queue)
        try:
            while (event := await queue.get()) is not None:
                yield event
        finally:
            self.queues.discard(queue)

    def close(self) -> None:
        self.store.close()


_FREE: list[FastAPI] = []
"""Applications of stopped servers. Making one takes longer than most tests: all routes are described."""


def _application(service: SmallService) -> FastAPI:
    """Return an application with the state of a new one."""
    if not _FREE:
        return create_api(service, ["grid.example"])
    api = _FREE.pop()
    api.state.backend, api.state.probe = service, Probe(service.store, None)
    api.state.run, api.state.access_threads = secrets.token_hex(4), CapacityLimiter(ACCESS_THREADS)
    api.state.streams, api.state.viewers, api.state.max_streams = 0, 0, MAX_STREAMS
    return api


class Server:
    """The HTTP application of a SmallService on a free port of this machine, in a thread."""

    def __init__(self, service: SmallService, port: int = 0) -> None:
        self.service = service
        self.api = _application(service)
        config = uvicorn.Config(
            self.api,
            host="127.0.0.1",
            port=port,
            log_level="critical",
            timeout_graceful_shutdown=1,
            lifespan="off",
        )
        self.uvicorn = uvicorn.Server(config)
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()
        deadline = time.monotonic() + 20
        while not self.uvicorn.started:
            assert self.thread.is_alive()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        self.port: int = self.uvicorn.servers[0].sockets[0].getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"

    def _run(self) -> None:
        async def serve() -> None:
            self.service.loop = asyncio.get_running_loop()
            await self.uvicorn.serve()

        asyncio.run(serve())

    def stop(self) -> None:
        self.service.wake(None)
        self.uvicorn.should_exit = True
        self.thread.join(timeout=20)
        assert not self.thread.is_alive()
        self.service.loop = None
        _FREE.append(self.api)


@pytest.fixture(scope="session")
def cluster() -> Iterator[Cluster]:
    binaries = find_postgresql()
    if binaries is None:
        pytest.skip("PostgreSQL's initdb, pg_ctl and postgres are not installed")
    if os.geteuid() == 0 and shutil.which("setpriv") is None:
        pytest.skip("PostgreSQL refuses to run as root, and there is no setpriv to become somebody else")
    with running(binaries) as made:
        yield made


@pytest.fixture
def url(family: str, tmp_path: Path, request: pytest.FixtureRequest) -> str:
    if family == "sqlite":
        return f"sqlite:///{tmp_path}/gridsec.db"
    made: Cluster = request.getfixturevalue("cluster")
    return made.database()


@pytest.fixture
def village() -> type[Village]:
    return Village


@pytest.fixture
def small_service(tmp_path: Path) -> Iterator[Callable[..., SmallService]]:
    """Make services; each is closed at the end."""
    made: list[SmallService] = []

    def make(*villages: Village) -> SmallService:
        made.append(SmallService(f"sqlite:///{tmp_path}/service-{len(made)}.db", *villages))
        return made[-1]

    yield make
    for service in made:
        service.close()


@pytest.fixture
def serve() -> Iterator[Callable[[SmallService], Server]]:
    """Serve services over HTTP; each server is stopped at the end."""
    made: list[Server] = []

    def make(service: SmallService, port: int = 0) -> Server:
        made.append(Server(service, port))
        return made[-1]

    yield make
    for server in made:
        if server.thread.is_alive():
            server.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("no Chromium on this machine")
    expect.set_options(timeout=PAGE_PATIENCE_MS)
    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=found, args=CHROMIUM)
        yield made
        made.close()


@pytest.fixture
def store(url: str) -> Iterator[Store]:
    """A store of its own, in each kind of database."""
    with Store(url) as made:
        yield made


@pytest.fixture
def setup(
    village: type[Village], small_service: Callable[..., Any], serve: Callable[..., Any]
) -> Iterator[Setup]:
    """A service of two feeders, and who asks it."""
    service = small_service(village("village"), village("town", 4))
    made = Setup(service, serve(service))
    with made.http:
        yield made


@pytest.fixture
def site_of(
    browser: Browser, small_service: Callable[..., Any], serve: Callable[..., Any]
) -> Iterator[Callable[..., Site]]:
    """Served feeders; their pages may not complain."""
    made: list[Site] = []

    def make(*villages: Any) -> Site:
        made.append(Site(browser, small_service(*villages), serve))
        return made[-1]

    yield make
    for site in made:
        site.close()
        wrong = [c for c in site.complaints if site.expected is None or site.expected not in c]
        assert wrong == []


@pytest.fixture
def site(site_of: Callable[..., Site], village: type[Village]) -> Site:
    """One served feeder."""
    return site_of(village())
