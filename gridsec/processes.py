"""Processes of a pool and signals: an interruption is the first process's own, and its pool ends with it."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Final

__all__ = ["deaf", "listen", "stop"]

# What ends a command. At a terminal all of its processes are interrupted at once.
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def deaf() -> Iterator[None]:
    """Let processes that begin now hear no signal until they `listen`: they would tell of it at length."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def listen() -> None:
    """In a process that was begun `deaf`: leave interruptions to the first process, and end when told to."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


def stop(pool: ProcessPoolExecutor) -> None:
    """End a pool at once: what its processes have in hand is not wanted any more.

    Parameters
    ----------
    pool
        The pool.
    """
    for process in list(pool._processes.values()) if pool._processes else []:
        process.kill()
    pool.shutdown(cancel_futures=True)
