"""Messages to systemd as in sd_notify(3): readiness, watchdog, end.

Without the variable NOTIFY_SOCKET every message is dropped.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable

import structlog

_log = structlog.get_logger("gridsec.systemd")


def notify(message: str) -> None:
    """Send a message, such as `READY=1`; a failure is logged, and the service continues."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    name = "\0" + address[1:] if address.startswith("@") else address
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)
            sender.sendto(message.encode(), name)
    except OSError as error:
        _log.warning("systemd takes no message", problem=error.strerror)


def interval_s() -> float | None:
    """Return half of the time limit of the watchdog of this process, s; None without a watchdog."""
    limit_us, pid = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not limit_us.isdecimal() or int(limit_us) == 0 or pid not in {"", str(os.getpid())}:
        return None
    return int(limit_us) / 2e6


async def supervise(healthy: Callable[[], bool]) -> None:
    """Report readiness, then the watchdog's sign of life as long as the service is healthy.

    The messages are sent by the event loop of the service: a blocked loop sends none.
    """
    notify("READY=1")
    every_s = interval_s()
    while every_s is not None:
        if healthy():
            notify("WATCHDOG=1")
        await asyncio.sleep(every_s)
