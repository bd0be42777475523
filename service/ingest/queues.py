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
    """zenoh cannot be used as configured."""

    code = "bus-unavailable"


@dataclass(frozen=True, slots=True)
class BusConfig:
    """Configuration of a zenoh session."""

    # `router` for the service (it routes between clients and needs no separate router process), `client` for
    # meters and tools, `peer` if an existing network requires it. None: the mode of the file, or `router`
    # without a file.
    mode: str | None = None
    # listen, connect: endpoints such as `tcp/127.0.0.1:7447`.
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    # A zenoh configuration in json5 (TLS, users, access control, ...). Mode and endpoints given here override
    # it.
    file: Path | None = None
    # max_sessions, accept_pending: largest number of sessions, and of sessions that are being opened; ignored
    # with a file. Each session takes a file descriptor.
    max_sessions: int = 100_000
    accept_pending: int = 1_000


@dataclass(frozen=True, slots=True)
class Sample:
    """One put, copied from zenoh: key, bytes, encoding, wall time of its arrival (Unix s), attachment.

    A payload above the limit is cut to its beginning; `size` is the whole length. An oversized key is cut,
    too.
    """

    key: str
    payload: bytes
    encoding: str
    arrival: float
    size: int
    attachment: bytes = b""


@dataclass(slots=True)
class BusCounts:
    """Counters: deletions on reading keys, puts and deletions of the service, failures, queries."""

    deleted: int = 0
    published: int = 0
    publish_failed: int = 0
    queries: int = 0


_OVERHEAD = 256


class Inbox:
    """Queue of samples before the runtime, bounded in number and bytes.

    max_samples, max_bytes: the bounds.
    lossless: when full, block the sender instead of dropping the oldest sample. For `Clock.EVENTS`, where no
        sample gets stale; with the wall clock the oldest samples are worthless.
    wake: called from the sender's thread after samples have been added.
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
        """Number of waiting samples."""
        return len(self._waiting)

    def oldest(self) -> float | None:
        """Return the arrival time of the oldest waiting sample, Unix s; None if the queue is empty."""
        with self._room:
            return self._waiting[0].arrival if self._waiting else None

    def put(self, batch: list[Sample]) -> int:
        """Add samples; called from any thread. Returns the number of dropped samples."""
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
        """Remove and return up to `limit` samples, oldest first."""
        with self._room:
            count = min(limit, len(self._waiting))
            taken = [self._waiting.popleft() for _ in range(count)]
            self._bytes -= sum(map(_size, taken))
            self._room.notify_all()
        return taken

    def close(self) -> None:
        """Release blocked senders; later samples are discarded."""
        with self._room:
            self._closed = True
            self._room.notify_all()

    def _full(self, more: int) -> bool:
        return len(self._waiting) + (more > 0) > self._max_samples or self._bytes + more > self._max_bytes


def _size(sample: Sample) -> int:
    """Memory of a waiting sample, bytes: the sender chooses the key and the encoding, too."""
    texts = len(sample.payload) + len(sample.attachment)
    return texts + sys.getsizeof(sample.key) + sys.getsizeof(sample.encoding) + _OVERHEAD


EVENTS_WAITING = 10_000
TELEMETRY_WAITING = 2_000
RETRY_S = 1.0
"""Time until the next attempt to publish a refused event, s."""


class Publication(NamedTuple):
    """A put, or (without a payload) a deletion, that must not be lost; `done` is called after it."""

    key: str
    payload: bytes | None
    done: Callable[[], None] | None


class Outgoing:
    """Queue before the publishing thread; any thread may add to it.

    retry_at: time of the next attempt, by the monotonic clock, s, while the first event is a refused one.
    """

    def __init__(self) -> None:
        self.retry_at: float | None = None
        self._telemetry: deque[tuple[str, Callable[[], bytes]]] = deque(maxlen=TELEMETRY_WAITING)
        self._events: deque[Publication] = deque()
        self._closing = False
        self._wakeup = threading.Condition()

    def add_telemetry(self, key: str, payload: Callable[[], bytes]) -> None:
        """Add a value; a full queue drops the oldest."""
        with self._wakeup:
            self._telemetry.append((key, payload))
            self._wakeup.notify()

    def add_events(self, *events: Publication) -> bool:
        """Add all events and return True, or none if the queue is full."""
        with self._wakeup:
            if len(self._events) >= EVENTS_WAITING:
                return False
            self._events.extend(events)
            self._wakeup.notify()
        return True

    def close(self) -> None:
        """End `next` after the waiting items."""
        with self._wakeup:
            self._closing = True
            self._wakeup.notify()

    def next(self) -> Publication | tuple[str, Callable[[], bytes]] | None:
        """Wait for the next item and remove it; events come first. None after the last one."""
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

    def put_back(self, event: Publication) -> None:
        """Queue a refused event again; after `close`, discard all events."""
        with self._wakeup:
            if self._closing:
                self._events.clear()
                return
            self._events.appendleft(event)
            self.retry_at = time.monotonic() + RETRY_S
