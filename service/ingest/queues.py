"""Messages between zenoh and the service, and the bounded queues of both directions."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from gridsec.errors import GridsecError


class BusUnavailable(GridsecError):
    """zenoh cannot be used as configured; the message says which endpoint and why."""

    code = "bus-unavailable"


@dataclass(frozen=True, slots=True)
class BusConfig:
    """How to take part in zenoh.

    Attributes
    ----------
    mode
        `router` for the service (it routes between clients and needs no separate router process), `client`
        for meters and tools, `peer` if an existing network asks for it. None: what the file says, or
        `router` without a file.
    listen, connect
        Endpoints such as `tcp/127.0.0.1:7447`.
    file
        A user's own json5 configuration (TLS, users, access control, ...). What it says is kept; mode and
        endpoints given here are put on top.
    max_sessions, accept_pending
        Sessions at most, and those that are being opened; not where a file is given. Each takes a descriptor.
    """

    mode: str | None = None
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    file: Path | None = None
    max_sessions: int = 100_000
    accept_pending: int = 1_000


@dataclass(frozen=True, slots=True)
class Sample:
    """One put, copied out of zenoh: key, bytes, encoding, wall time of its arrival (Unix s).

    Of a payload above the limit only the beginning is kept; `size` is its whole length. Of an absurdly long
    key only the beginning is kept, too.
    """

    key: str
    payload: bytes
    encoding: str
    arrival: float
    size: int


@dataclass(slots=True)
class BusCounts:
    """What went through and what did not: deletions on reading keys, puts and deletes of ours, queries."""

    deleted: int = 0
    published: int = 0
    publish_failed: int = 0
    queries: int = 0


_OVERHEAD = 256


class Inbox:
    """Samples that wait for the runtime, bounded in number and bytes.

    Parameters
    ----------
    max_samples, max_bytes
        The bounds.
    lossless
        When full, let the sender wait instead of dropping the oldest: right where time is told by the
        readings (nothing gets stale), wrong where it is the wall clock's.
    wake
        Called, from the sender's thread, when something has come.
    """

    def __init__(
        self,
        wake: Callable[[], None],
        *,
        max_samples: int = 20_000,
        max_bytes: int = 64 << 20,
        lossless: bool,
    ) -> None:
        self._wake = wake
        self._max_samples = max_samples
        self._max_bytes = max_bytes
        self._lossless = lossless
        self._waiting: deque[Sample] = deque()
        self._bytes = 0
        self._closed = False
        self._room = threading.Condition()

    def __len__(self) -> int:
        """Return how many samples wait."""
        return len(self._waiting)

    def oldest(self) -> float | None:
        """Return when the oldest of the waiting samples arrived, Unix s; None if none waits."""
        with self._room:
            return self._waiting[0].arrival if self._waiting else None

    def put(self, batch: list[Sample]) -> int:
        """Add samples; called from any thread.

        Parameters
        ----------
        batch
            In the order of arrival.

        Returns
        -------
        int
            How many samples were dropped for it.
        """
        dropped = 0
        for sample in batch:
            size = _size(sample)
            with self._room:
                while self._lossless and not self._closed and self._waiting and self._full(size):
                    self._wake()
                    self._room.wait(timeout=1.0)
                if self._closed:
                    return dropped
                self._waiting.append(sample)
                self._bytes += size
                while len(self._waiting) > 1 and self._full(0):
                    self._bytes -= _size(self._waiting.popleft())
                    dropped += 1
        self._wake()
        return dropped

    def drain(self, limit: int) -> list[Sample]:
        """Take out up to `limit` samples, oldest first.

        Parameters
        ----------
        limit
            At most so many.
        """
        with self._room:
            count = min(limit, len(self._waiting))
            taken = [self._waiting.popleft() for _ in range(count)]
            self._bytes -= sum(map(_size, taken))
            self._room.notify_all()
        return taken

    def close(self) -> None:
        """Let waiting senders go; what they bring is not wanted any more."""
        with self._room:
            self._closed = True
            self._room.notify_all()

    def _full(self, more: int) -> bool:
        return len(self._waiting) + (more > 0) > self._max_samples or self._bytes + more > self._max_bytes


def _size(sample: Sample) -> int:
    """What a waiting sample takes, bytes: its sender chooses the key and the encoding, too."""
    return len(sample.payload) + sys.getsizeof(sample.key) + sys.getsizeof(sample.encoding) + _OVERHEAD


EVENTS_WAITING = 10_000
TELEMETRY_WAITING = 2_000
RETRY_S = 1.0
"""An event that was refused is tried again after this time, s."""


class Event(NamedTuple):
    """A put, or (without a payload) a delete, that must not be lost; `done` is called once it is out."""

    key: str
    payload: bytes | None
    done: Callable[[], None] | None


class Outgoing:
    """The queue before the thread that publishes; whoever adds may be any thread.

    Attributes
    ----------
    retry_at
        Set while the first event is one that was refused: when to try again, by the monotonic clock, s.
    """

    def __init__(self) -> None:
        self.retry_at: float | None = None
        self._telemetry: deque[tuple[str, bytes]] = deque(maxlen=TELEMETRY_WAITING)
        self._events: deque[Event] = deque()
        self._closing = False
        self._wakeup = threading.Condition()

    def add_telemetry(self, key: str, payload: bytes) -> None:
        """Add a value; of too many the oldest go.

        Parameters
        ----------
        key, payload
            What to put.
        """
        with self._wakeup:
            self._telemetry.append((key, payload))
            self._wakeup.notify()

    def add_events(self, *events: Event) -> bool:
        """Add events, all or, if too many wait, none: False then.

        Parameters
        ----------
        events
            In their order.
        """
        with self._wakeup:
            if len(self._events) >= EVENTS_WAITING:
                return False
            self._events.extend(events)
            self._wakeup.notify()
        return True

    def close(self) -> None:
        """Let `next` come to its end with what waits."""
        with self._wakeup:
            self._closing = True
            self._wakeup.notify()

    def next(self) -> Event | tuple[str, bytes] | None:
        """Wait for what is to be published next, and take it out; events go first. None: the end."""
        with self._wakeup:
            while True:
                pause = 0.0
                if self.retry_at is not None and not self._closing:
                    pause = self.retry_at - time.monotonic()
                if self._events and pause <= 0.0:
                    return self._events.popleft()
                if self._telemetry:
                    return self._telemetry.popleft()
                if self._closing:
                    return None
                self._wakeup.wait(pause if self._events else None)

    def put_back(self, event: Event) -> None:
        """Let an event that was refused be tried again; at the end, give up all of them.

        Parameters
        ----------
        event
            What `next` returned.
        """
        with self._wakeup:
            if self._closing:
                self._events.clear()
                return
            self._events.appendleft(event)
            self.retry_at = time.monotonic() + RETRY_S
