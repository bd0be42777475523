"""Monitors that are designed in threads of their own while the service goes on."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from functools import partial

import structlog

from feeders.estimators import Watcher
from gridsec.errors import GridsecError
from service.watch import Watch, design

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
        problem = ""
        try:
            finished = design(watch.site, _progress(watch.name))
        except GridsecError as error:
            problem = str(error)
        except Exception as error:  # noqa: BLE001 - shown to the operator as the feeder's problem
            problem = f"{type(error).__name__}: {error}"
            _log.exception("design failed", feeder=watch.name)
        finally:
            hand_over(partial(install, watch, finished, problem))
        seconds = round(time.monotonic() - started, 3)
        _log.info("design finished", feeder=watch.name, seconds=seconds, problem=problem or None)

    threading.Thread(target=run, name=f"gridsec-design-{watch.name}", daemon=True).start()


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
