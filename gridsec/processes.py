"""Processes of a pool and signals: an interruption is the first process's own, and its pool ends with it."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Final

__all__ = ["deaf", "listen", "stop"]

# What ends a command. At a terminal all of its processes are interrupted at once.
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def deaf() -> Iterator[None]:
    """Begin processes undisturbed: signals to this one come after it, and theirs when they `listen`.

    One that is interrupted before it knows what to do would tell of it at length.
    """
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield
        return
    late: list[int] = []
    handlers = {
        number: signal.signal(number, lambda heard, _: late.append(heard))
        for number in _SIGNALS
        if callable(signal.getsignal(number))
    }
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if late:
            signal.raise_signal(late[0])


def listen() -> None:
    """In a process that was begun `deaf`: leave interruptions to the first process, and end when told to."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


def stop(pool: ProcessPoolExecutor) -> None:
    """End a pool at once: what its processes have in hand is not wanted any more.

    Where all is done, too: processes that are asked to end wait for ever where one of them was killed while
    it waited for work.

    Parameters
    ----------
    pool
        The pool.
    """
    for process in list(pool._processes.values()) if pool._processes else []:
        process.kill()
    pool.shutdown(cancel_futures=True)
