"""Monitors that are designed in threads of their own while the service goes on."""

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
from feeders.registry.registry import Watcher
from gridsec.errors import FeederInvalid, GridsecError, Problem
from service.engine.feeder_monitor import Watch, design

_log = structlog.get_logger("gridsec.runtime")


def begin(watch: Watch, hand_over: Callable[[Callable[[], None]], None]) -> None:
    """Design in a thread of its own, which does not keep the process from ending.

    Parameters
    ----------
    watch
        The feeder.
    hand_over
        Called from that thread with what is left to do between two rounds: `install`.
    """

    def run() -> None:
        started = time.monotonic()
        finished: Watcher | None = None
        defect: Exception | None = None
        problem = ""
        try:
            finished = design(watch.site, _progress(watch.name))
        except GridsecError as error:
            problem = str(error)
        except Exception as error:  # noqa: BLE001 - shown to the operator as the feeder's problem
            problem, defect = f"{type(error).__name__}: {error}", error
        seconds = round(time.monotonic() - started, 3)

        def end() -> None:
            if defect is not None:
                _log.error("design failed", feeder=watch.name, exc_info=defect)
            _log.info("design finished", feeder=watch.name, seconds=seconds, problem=problem or None)
            install(watch, finished, problem)

        hand_over(end)

    _apart(watch.name, run)


def prepare(name: str, tables: dict[str, Any]) -> asyncio.Future[tuple[Site, Watcher]]:
    """Load and design a feeder as `begin` does; called from the event loop.

    Parameters
    ----------
    name, tables
        Its name, and JSON of the columns of its files.

    Returns
    -------
    asyncio.Future
        The feeder and its design, or FeederInvalid, NotObservable or DesignInfeasible. Who does not want to
        wait any more ends it in another way; the thread then works for nobody.
    """
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[tuple[Site, Watcher]] = loop.create_future()

    def work() -> tuple[Site, Watcher]:
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
    """End all processes that this one has begun: Python would wait at its end for designs under way."""
    for process in multiprocessing.active_children():
        process.kill()


def _apart(name: str, run: Callable[[], None]) -> None:
    threading.Thread(target=run, name=f"gridsec-design-{name}", daemon=True).start()


def install(watch: Watch, finished: Watcher | None, problem: str) -> None:
    """Watch with a finished design, or give up.

    Parameters
    ----------
    watch, finished, problem
        The feeder, and its design, or without one why there is none.
    """
    if finished is None:
        watch.fail(problem)
        return
    watch.install(finished)
    if watch.commissioning.restored:
        _log.info("commissioning goes on from what was kept", feeder=watch.name)
    elif watch.commissioning.note:
        _log.warning("commissioning begins anew", feeder=watch.name, reason=watch.commissioning.note)
    if watch.suspicions.note:
        _log.warning("nobody is suspected from before", feeder=watch.name, reason=watch.suspicions.note)


def settle() -> None:
    """Take all that stays, modules and designs, out of sight of Python's garbage collector.

    Each of its full passes over them stops every thread for some 20 ms. What was taken out before is looked
    at once more, so that a feeder that is gone leaves nothing behind.
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()


def _progress(feeder: str) -> Callable[[int, int], None]:
    """Say how far a design of many parts is, ten times on the way."""

    def said(done: int, total: int) -> None:
        if done * 10 // total > (done - 1) * 10 // total:
            _log.info("designing", feeder=feeder, done=done, total=total)

    return said
