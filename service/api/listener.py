"""Limits of HTTP connections: their number, the time for a header and a body, and descriptors.

uvicorn limits the idle time after a response only. This module adds a limit of open connections, time-outs
for incomplete requests and for stalled responses, and an accept loop that waits when the process has no
descriptor left. asyncio's own loop would log each of `backlog` failed accepts with a traceback.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import resource
import socket
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import h11
import structlog
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_S = 10.0
"""Time limit from the connection, or from the last response, to a complete header, s."""
BODY_S = 60.0
"""Time limit from the header to a complete body, s: 4 MiB at 0.6 Mbit/s."""
STALLED_S = 60.0
"""Time limit of a full buffer of a response, streams included, s."""
CLOSE_S = 10.0
"""Time limit of the rest of a response after the end of the connection, s."""
ACCEPT_PAUSE_S = 0.2
"""Pause after an accept that failed for lack of a resource, s."""

RESERVE = 96
"""Descriptors reserved for the database, zenoh's own threads, files of the page and the log."""
HTTP_MOST = 512
"""Largest number of HTTP connections, for any number of descriptors."""
SESSIONS_MOST = 100_000
"""Largest number of zenoh sessions, for any number of descriptors."""
PENDING_MOST = 1_000
"""Largest number of zenoh sessions that are being opened, for any number of descriptors."""

_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/problem+json\r\nretry-after: 5\r\n"
    b"connection: close\r\ncontent-length: 98\r\n\r\n"
    b'{"type":"about:blank","title":"Service Unavailable","status":503,"detail":"too many connections."}'
)
_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_log = structlog.get_logger("gridsec.http")


@dataclass(frozen=True, slots=True)
class Shares:
    """Descriptors by use; their sum with `RESERVE` is at most the limit of the process."""

    http: int  # HTTP connections
    # sessions, pending: zenoh sessions, and those that are being opened.
    sessions: int
    pending: int

    @classmethod
    def of(cls, limit: int) -> Shares:
        """Divide the descriptors of a process. `limit` is the soft limit of open descriptors."""
        left = max(limit - RESERVE, 24)
        http = min(HTTP_MOST, left // 3)
        pending = min(PENDING_MOST, (left - http) // 8)
        return cls(http, min(SESSIONS_MOST, left - http - pending), pending)

    @property
    def streams(self) -> int:
        """Largest number of event streams: half of the connections stay for requests."""
        return max(1, self.http // 2)


def raise_limit() -> int:
    """Raise the soft limit of open descriptors to the hard limit, and return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # above the kernel's limit of one process
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        soft = hard
    return (1 << 20) if soft == resource.RLIM_INFINITY else soft


class Connection(H11Protocol):
    """One HTTP connection with time-outs; beyond the limit, the longest incomplete one is closed.

    most: largest number of connections.
    *args, **kwargs: as in uvicorn.
    """

    def __init__(self, most: int, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._most = most
        self._phase = ""
        self._since = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection; beyond the limit, close an incomplete one or refuse the new one."""
        super().connection_made(transport)
        if len(self.connections) > self._most and not self._make_room():
            transport.write(_FULL)
            transport.close()
        self._watch()

    def _make_room(self) -> bool:
        others = (one for one in self.connections if one is not self and isinstance(one, Connection))
        waiting = [one for one in others if one.incomplete]
        if not waiting:
            return False
        oldest = min(waiting, key=lambda one: one._since)
        _log.warning("http connection ended for a new one", most=self._most, phase=oldest._phase)
        # Frees its place at once; otherwise it would be free only in the next turn of the loop.
        self.connections.discard(oldest)
        oldest.transport.abort()
        return True

    @property
    def incomplete(self) -> bool:
        """True before the end of a request's header or body."""
        return self._phase in {"header", "body"}

    def data_received(self, data: bytes) -> None:
        """Process received data and update the timer."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Start the wait for the next request."""
        super().on_response_complete()
        self._phase = ""
        self._watch()

    def timeout_keep_alive_handler(self) -> None:
        """Close an idle connection."""
        super().timeout_keep_alive_handler()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers."""
        for timer in (self._timer, self._stalled):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Start the time limit of a stalled response."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALLED_S, self._end, "response")

    def resume_writing(self) -> None:
        """Cancel the time limit of a stalled response."""
        super().resume_writing()
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def _watch(self) -> None:
        """Set the timer of the present phase; an unchanged phase keeps its timer."""
        phase, seconds = "answer", 0.0
        if self.transport.is_closing():
            phase, seconds = "closing", CLOSE_S
        elif self.conn.their_state is h11.IDLE:
            phase, seconds = "header", HEADER_S
        elif self.conn.their_state is h11.SEND_BODY:
            phase, seconds = "body", BODY_S
        if phase == self._phase:
            return
        self._phase, self._since = phase, self.loop.time()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_later(seconds, self._end, phase) if seconds else None

    def _end(self, phase: str) -> None:
        _log.info("http connection timed out", phase=phase)
        self.transport.abort()


class _Accepting:
    """Replacement of asyncio's server in uvicorn: a task that accepts connections."""

    def __init__(self, listener: socket.socket, make: Callable[[], asyncio.Protocol]) -> None:
        self.sockets = (listener,)
        self._task = asyncio.create_task(_accept(listener, make), name="http accept")

    def close(self) -> None:
        """Stop accepting."""
        self._task.cancel()

    async def wait_closed(self) -> None:
        """Wait for the end of the task."""
        await asyncio.gather(self._task, return_exceptions=True)


async def _accept(listener: socket.socket, make: Callable[[], asyncio.Protocol]) -> None:
    """Accept connections until cancelled. Without a free descriptor, a spare one serves to refuse clients."""
    loop = asyncio.get_running_loop()
    spare = _spare()
    try:
        while True:
            try:
                accepted, _ = await loop.sock_accept(listener)
            except OSError as error:
                if error.errno in _EXHAUSTED:
                    _log.error("http cannot accept", problem=error.strerror)
                    if spare is not None:
                        os.close(spare)
                        with contextlib.suppress(OSError):
                            turned_away, _ = listener.accept()
                            turned_away.close()
                    spare = _spare()
                    await asyncio.sleep(ACCEPT_PAUSE_S)
                continue
            accepted.setblocking(False)
            try:
                await loop.connect_accepted_socket(make, accepted)
            except OSError:  # the client has disconnected
                accepted.close()
            if spare is None:
                spare = _spare()
    finally:
        if spare is not None:
            os.close(spare)


def _spare() -> int | None:
    try:
        return os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None


class BoundedServer(uvicorn.Server):
    """uvicorn with limited connections.

    most: largest number of connections.
    **options: options of uvicorn.
    """

    def __init__(self, app: Callable[..., Any], most: int, **options: Any) -> None:
        made = cast(type[asyncio.Protocol], partial(Connection, most))
        super().__init__(uvicorn.Config(app, http=made, ws="none", **options))

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start accepting on listening sockets."""
        await self.lifespan.startup()
        config, state = self.config, self.lifespan.state

        def make() -> asyncio.Protocol:
            return config.http_protocol_class(  # type: ignore[call-arg]
                config=config, server_state=self.server_state, app_state=state
            )

        self.servers = cast(Any, [_Accepting(listener, make) for listener in sockets or ()])
        self.started = True
