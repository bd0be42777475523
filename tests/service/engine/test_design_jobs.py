"""Monitors designed while the service runs, and what is done once all of them stand."""

from __future__ import annotations

import asyncio
import gc
import multiprocessing
import signal
import threading
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from feeders.format.tables import from_json, to_json
from feeders.model.site import Site, from_tables
from service.engine.design_jobs import abandon, settle
from service.engine.engine import RuntimeConfig
from service.engine.feeder_monitor import Phase, design
from service.engine.runtime import Runtime
from service.store import Store, StoreUnavailable
from tests.codes import refused
from tests.service.commands import command
from tests.service.liars import FEEDER
from tests.service.running import Outlet

OTHER = "another"


class Ring:
    """Nothing but the collector frees it."""

    def __init__(self) -> None:
        self.itself = self


def called(site: Site, name: str) -> dict[str, Any]:
    """The tables of a feeder under another name."""
    tables = to_json(site.tables)
    return {**tables, "feeder": {**tables["feeder"], "name": name}}


def test_what_stays_is_out_of_the_collectors_sight_and_what_is_gone_is_freed() -> None:
    ring = Ring()
    there = weakref.ref(ring)
    try:
        settle()
        assert gc.get_freeze_count() > 10_000
        del ring
        gc.collect()
        assert there() is not None
        settle()
        assert there() is None
    finally:
        gc.unfreeze()


def test_settled_follows_the_last_design_by_a_pause(
    site: Site, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two feeders at the start, one of which takes longer; then two are put, and counted once."""
    other = from_tables(from_json(called(site, OTHER)))
    goes_on, told = threading.Event(), list[dict[str, str]]()

    def slow(asked: Site, progress: Callable[[int, int], None]) -> Any:
        if asked.feeder.name == OTHER:
            goes_on.wait(20.0)
        return design(asked, progress)

    monkeypatch.setattr("service.engine.design_jobs.design", slow)
    monkeypatch.setattr("service.engine.runtime.SETTLED_S", 0.3)

    async def scene(store: Store) -> None:
        runtime = Runtime(RuntimeConfig(), store, [site, other], settled=lambda: told.append(phases()))

        def phases() -> dict[str, str]:
            return {each["name"]: each["phase"] for each in runtime.feeders()}

        task = asyncio.create_task(runtime.run())
        while phases()[FEEDER] != Phase.WATCHING:  # noqa: ASYNC110 - the phase is what is tested
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.1)
        assert told == []
        goes_on.set()
        while not told:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        assert told == [{FEEDER: Phase.WATCHING, OTHER: Phase.WATCHING}]
        for name in ("third", "fourth"):
            await runtime.put_feeder(name, called(site, name))
        assert len(told) == 1
        while len(told) == 1:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        assert told[1:] == [dict.fromkeys((FEEDER, OTHER, "third", "fourth"), Phase.WATCHING)]
        runtime.stop()
        await task

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(asyncio.wait_for(scene(store), 30.0))


def test_readings_of_the_monitored_feeders_are_followed(site: Site, path: Path) -> None:
    tables = called(site, "third")
    third, fourth = (from_tables(from_json(called(site, name))) for name in ("third", "fourth"))

    async def scene(store: Store) -> None:
        outlet = Outlet()
        runtime = Runtime(RuntimeConfig(), store, [site], given=())
        runtime.attach(outlet)
        task = asyncio.create_task(runtime.run())

        async def follows(*names: str) -> None:
            while outlet.followed != set(names):  # noqa: ASYNC110
                await asyncio.sleep(0.01)

        await follows(FEEDER)
        await runtime.put_feeder("third", tables)
        await follows(FEEDER, "third")
        # Put again: its subscription stays.
        await runtime.put_feeder("third", tables)
        await runtime.adopt([third, fourth])
        await follows(FEEDER, "third", "fourth")
        await runtime.resign(["fourth"])
        await runtime.delete_feeder("third")
        await follows(FEEDER)
        runtime.stop()
        await task

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(asyncio.wait_for(scene(store), 30.0))


def test_stopping_waits_for_no_feeder_that_is_being_put(
    site: Site, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, goes_on = threading.Event(), threading.Event()

    def slow(asked: Site, progress: Callable[[int, int], None]) -> Any:
        if asked.feeder.name == OTHER:
            begun.set()
            goes_on.wait(20.0)
        return design(asked, progress)

    monkeypatch.setattr("service.engine.design_jobs.design", slow)
    monkeypatch.setattr("service.engine.runtime.SETTLED_S", 0.3)

    async def scene(store: Store) -> None:
        runtime = Runtime(RuntimeConfig(), store, [site])
        task = asyncio.create_task(runtime.run())
        put = asyncio.create_task(runtime.put_feeder(OTHER, called(site, OTHER)))
        while not begun.is_set():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        runtime.stop()
        for answer in (put, runtime.put_feeder("third", called(site, "third"))):
            with refused(StoreUnavailable, "stopping"):
                await answer
        await task
        assert store.feeders() == {}

    with Store(f"sqlite:///{path}") as store:
        started = time.monotonic()
        asyncio.run(asyncio.wait_for(scene(store), 15.0))
        assert time.monotonic() - started < 10.0
    goes_on.set()


def test_processes_of_a_design_are_not_waited_for_at_the_end() -> None:
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60.0,))
    worker.start()
    abandon()
    worker.join(10.0)
    assert worker.exitcode == -signal.SIGKILL


def test_the_service_settles_and_abandons(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr("service.engine.design_jobs.abandon", lambda: given.update(abandoned=True))

    async def serve(*_: object, **named: Any) -> None:
        given.update(named)

    monkeypatch.setattr("service.app.serve", serve)
    monkeypatch.setattr("service.logs.set_up", lambda *_: None)
    assert command("serve")(monkeypatch, capsys, "--feeder", FEEDER)[0] == 0
    assert (given["settled"], given["abandoned"]) == (settle, True)
