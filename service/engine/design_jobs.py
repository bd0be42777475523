"""Design of monitors in separate threads while the service runs."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import multiprocessing
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import structlog

from feeders.format.tables import from_json
from feeders.model.site import Site, from_tables
from feeders.registry import DesignedEstimator
from gridsec.errors import FeederInvalid, GridsecError, Problem
from service.engine.feeder_monitor import FeederMonitor, design

_log = structlog.get_logger("gridsec.runtime")


def begin(monitor: FeederMonitor, on_designed: Callable[[Callable[[], None]], None]) -> None:
    """Design in a daemon thread, which does not delay the end of the process.

    `on_designed` is called from that thread with the remaining step, to run between two rounds.
    """

    def run() -> None:
        started = time.monotonic()
        finished: DesignedEstimator | None = None
        defect: Exception | None = None
        problem = ""
        try:
            finished = design(monitor.site, _progress(monitor.name))
        except GridsecError as error:
            problem = str(error)
        except Exception as error:  # noqa: BLE001 - shown to the operator as the feeder's problem
            problem, defect = f"{type(error).__name__}: {error}", error
        seconds = round(time.monotonic() - started, 3)

        def end() -> None:
            if defect is not None:
                _log.error("design failed", feeder=monitor.name, exc_info=defect)
            _log.info("design finished", feeder=monitor.name, seconds=seconds, problem=problem or None)
            install(monitor, finished, problem)

        on_designed(end)

    _apart(monitor.name, run)


def prepare(name: str, tables: dict[str, Any]) -> asyncio.Future[tuple[Site, DesignedEstimator]]:
    """Load and design a feeder as `begin` does; called from the event loop.

    Returns the feeder and its design, or FeederInvalid, NotObservable or DesignInfeasible. A caller that
    stops waiting completes it in another way; the result of the thread is then discarded.
    """
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[tuple[Site, DesignedEstimator]] = loop.create_future()

    def work() -> tuple[Site, DesignedEstimator]:
        parsed = from_json(tables)
        if parsed.meta.name != name:
            text = f"feeder: name {parsed.meta.name!r} does not fit the address {name!r}"
            raise FeederInvalid([Problem("inconsistent", text)])
        site = from_tables(parsed)
        return site, design(site, _progress(name))

    def run() -> None:
        tell: Callable[[], None]
        try:
            tell = partial(answer.set_result, work())
        except Exception as error:  # noqa: BLE001 - raised where the answer is awaited
            tell = partial(answer.set_exception, error)
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(lambda: None if answer.done() else tell())

    _apart(name, run)
    return answer


def abandon() -> None:
    """End all child processes of this process: at its exit Python would wait for unfinished designs."""
    for process in multiprocessing.active_children():
        process.kill()


def _apart(name: str, run: Callable[[], None]) -> None:
    threading.Thread(target=run, name=f"gridsec-design-{name}", daemon=True).start()


def install(monitor: FeederMonitor, finished: DesignedEstimator | None, problem: str) -> None:
    """Start monitoring with a finished design, or mark the feeder as failed."""
    if finished is None:
        monitor.fail(problem)
        return
    monitor.install(finished)
    if monitor.commissioning.restored:
        _log.info("commissioning goes on from what was kept", feeder=monitor.name)
    elif monitor.commissioning.note:
        _log.warning("commissioning begins anew", feeder=monitor.name, reason=monitor.commissioning.note)
    if monitor.suspicions.note:
        _log.warning("stored suspicions are not used", feeder=monitor.name, reason=monitor.suspicions.note)


def settle() -> None:
    """Exclude all permanent objects, modules and designs, from Python's garbage collection.

    A full pass over them stops every thread for about 20 ms. Objects excluded earlier are collected once
    more, so that removed feeders leave nothing in memory.
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()


def _progress(feeder: str) -> Callable[[int, int], None]:
    """Return a callback that logs the progress of a design of many parts in ten steps."""

    def said(done: int, total: int) -> None:
        if done * 10 // total > (done - 1) * 10 // total:
            _log.info("designing", feeder=feeder, done=done, total=total)

    return said
