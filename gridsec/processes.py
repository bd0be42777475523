"""Worker pools and signals: only the first process handles interruptions, and it ends its pool."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Final

__all__ = ["deaf", "listen", "stop"]

# Signals that end a command. A terminal sends SIGINT to all processes of the command.
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def deaf() -> Iterator[None]:
    """Start worker processes with signals blocked; this process handles late signals afterwards.

    The workers unblock theirs in `listen`. A worker interrupted before that would print a traceback.
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
    """In a worker started under `deaf`: ignore SIGINT, handled by the first process, and accept SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


def stop(pool: ProcessPoolExecutor) -> None:
    """Kill the processes of a pool at once and discard their work.

    Use it after normal completion too: a graceful shutdown hangs if a process was killed while it waited
    for work.
    """
    for process in list(pool._processes.values()) if pool._processes else []:
        process.kill()
    pool.shutdown(cancel_futures=True)
