"""Messages between zenoh and the service, and the bounded queues of both directions."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice
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


class Sample(NamedTuple):
    """One put, copied from zenoh.

    A payload above the limit is cut to its beginning. An oversized key is cut, too.
    """

    key: str
    payload: bytes
    encoding: str
    arrival: float  # wall time of its arrival, Unix s
    size: int  # length of the whole payload, bytes
    attachment: bytes = b""


@dataclass(slots=True)
class BusCounts:
    """Counters: deletions on reading keys, puts and deletions of the service, failures, queries."""

    deleted: int = 0
    published: int = 0
    publish_failed: int = 0
    queries: int = 0


_OVERHEAD = 256


LANE_SAMPLES = 1024
"""Samples of one feeder in one round; a flood of one feeder delays the others by no more."""

THINNED_FROM = 512
"""Length of a feeder's queue from which its keys are thinned to equal numbers."""

THINNED = 8
"""Divisor of the length of such a queue: this part is dropped at once. A drop reads the whole queue."""


class Counts(NamedTuple):
    """Numbers of samples of a feeder so far."""

    offered: int  # all of them, discarded and dropped ones included
    dropped: int  # those that a full queue has dropped


@dataclass(slots=True)
class _Lane:
    """Queue of one feeder."""

    waiting: deque[Sample] = field(default_factory=deque)
    bytes: int = 0  # memory of the waiting samples
    offered: int = 0  # number of all samples so far
    dropped: int = 0  # those of them that a full queue has dropped

    def drop(self) -> int:
        """Drop the oldest sample; of a long queue a part, of the keys with the most. Return the number."""
        if len(self.waiting) <= THINNED_FROM:
            self.bytes -= _size(self.waiting.popleft())
            return 1
        counts = Counter(sample.key for sample in self.waiting)
        due = len(self.waiting) // THINNED
        left = _level(counts.values(), due)
        over = {key: number - left for key, number in counts.items() if number > left}
        # The last level is not needed of all keys.
        for key in islice(over, sum(over.values()) - due):
            over[key] -= 1
        kept: deque[Sample] = deque()
        for sample in self.waiting:
            if over.get(sample.key):
                over[sample.key] -= 1
                self.bytes -= _size(sample)
            else:
                kept.append(sample)
        self.waiting = kept
        return due


def _level(counts: Iterable[int], due: int) -> int:
    """Return the largest number such that the parts of some counts above it sum up to at least `due`."""
    keys = Counter(counts)
    level, reached, above = max(keys), 0, 0
    while reached < due:
        above += keys[level]
        reached += above
        level -= 1
    return level


class Inbox:
    """Queue of samples before the runtime, bounded in number and bytes.

    Each feeder has a queue of its own. When full, the largest one drops the oldest samples of the keys with
    the most: a flood displaces its own samples first. Samples without a monitored feeder, which become bad
    readings only, wait in a short queue: of no more than one round.

    wake: called from the sender's thread after samples have been added.
    max_samples, max_bytes: the bounds.
    lossless: when full, block the sender instead of dropping the oldest sample. For `Clock.EVENTS`, where no
        sample gets stale; with the wall clock the oldest samples are worthless. There is one queue then.
    feeder_of: feeder of a key; None for a key without a monitored feeder.
    shed: feeders with samples that are counted and discarded.
    surplus: number of samples without a feeder that were dropped beyond the length of their queue.
    """

    def __init__(
        self,
        wake: Callable[[], None],
        *,
        max_samples: int = 20_000,
        max_bytes: int = 64 << 20,
        lossless: bool,
        feeder_of: Callable[[str], str | None] = lambda _: None,
    ) -> None:
        self.shed: frozenset[str] = frozenset()
        self.surplus = 0
        self._wake = wake
        self._max_samples = max_samples
        self._max_bytes = max_bytes
        self._lossless = lossless
        self._feeder_of = feeder_of
        self._lanes: dict[str | None, _Lane] = {}
        self._length = 0
        self._bytes = 0
        self._closed = False
        self._room = threading.Condition()

    def __len__(self) -> int:
        """Number of waiting samples."""
        return self._length

    def oldest(self) -> dict[str, float]:
        """Return the arrival time of the oldest waiting sample of each feeder, Unix s."""
        with self._room:
            each = self._lanes.items()
            return {name: lane.waiting[0].arrival for name, lane in each if name is not None and lane.waiting}

    def counts(self) -> dict[str, Counts]:
        """Return the numbers of samples of each feeder so far."""
        with self._room:
            each = self._lanes.items()
            return {name: Counts(lane.offered, lane.dropped) for name, lane in each if name is not None}

    def count(self, feeder: str, offered: int, dropped: int) -> None:
        """Count samples of a feeder that do not reach the queue."""
        with self._room:
            lane = self._lanes.setdefault(feeder, _Lane())
            lane.offered += offered
            lane.dropped += dropped

    def put(self, batch: list[Sample]) -> int:
        """Add samples; called from any thread. Returns the number of dropped ones beside the surplus."""
        dropped = 0
        with self._room:
            for sample in batch:
                size = _size(sample)
                while self._lossless and not self._closed and self._length and self._full(size):
                    self._wake()
                    self._room.wait(timeout=1.0)
                if self._closed:
                    return dropped
                name = None if self._lossless else self._feeder_of(sample.key)
                lane = self._lanes.get(name)
                if lane is None:
                    lane = self._lanes[name] = _Lane()
                lane.offered += 1
                if name in self.shed:
                    continue
                lane.waiting.append(sample)
                lane.bytes += size
                self._length += 1
                self._bytes += size
                if name is None and not self._lossless and len(lane.waiting) > LANE_SAMPLES:
                    self.surplus += self._drop(lane)
                while self._length > 1 and self._full(0):
                    dropped += self._drop(max(self._lanes.values(), key=lambda one: one.bytes))
        self._wake()
        return dropped

    def _drop(self, lane: _Lane) -> int:
        before = lane.bytes
        dropped = lane.drop()
        lane.dropped += dropped
        self._bytes -= before - lane.bytes
        self._length -= dropped
        return dropped

    def drain(self, limit: int) -> list[Sample]:
        """Remove and return up to `limit` samples, and `LANE_SAMPLES` of a feeder, oldest first in each."""
        taken: list[Sample] = []
        with self._room:
            for lane in self._lanes.values():
                count = min(limit - len(taken), len(lane.waiting), limit if self._lossless else LANE_SAMPLES)
                some = [lane.waiting.popleft() for _ in range(count)]
                size = sum(map(_size, some))
                lane.bytes -= size
                self._bytes -= size
                taken += some
            self._length -= len(taken)
            self._room.notify_all()
        return taken

    def forget(self, feeder: str) -> None:
        """Discard the waiting samples of a feeder."""
        with self._room:
            lane = self._lanes.pop(feeder, None)
            if lane is not None:
                self._length -= len(lane.waiting)
                self._bytes -= lane.bytes
                self._lanes[feeder] = _Lane(offered=lane.offered, dropped=lane.dropped)

    def close(self) -> None:
        """Release blocked senders; later samples are discarded."""
        with self._room:
            self._closed = True
            self._room.notify_all()

    def _full(self, more: int) -> bool:
        return self._length + (more > 0) > self._max_samples or self._bytes + more > self._max_bytes


def _size(sample: Sample) -> int:
    """Memory of a waiting sample, bytes: the sender chooses the key and the encoding, too."""
    texts = len(sample.payload) + len(sample.attachment)
    return texts + sys.getsizeof(sample.key) + sys.getsizeof(sample.encoding) + _OVERHEAD


EVENTS_WAITING = 10_000
TELEMETRY_WAITING = 2_000
RETRY_S = 1.0
"""Time until the next attempt to publish a refused event, s."""


Value = bytes | Callable[[], bytes]
"""JSON, or a function that builds it; the function is called only if something receives the value."""


class Publication(NamedTuple):
    """A put, or (without a payload) a deletion, that must not be lost; `done` is called after it.

    number: number of the event, its attachment; 0 for none.
    """

    key: str
    payload: bytes | None
    done: Callable[[], None] | None
    number: int = 0


class StoredEvent(NamedTuple):
    """A stored event for a query: key without the prefix, JSON, number."""

    key: str
    payload: bytes
    number: int


class Outgoing:
    """Queue before the publishing thread; any thread may add to it.

    retry_at: time of the next attempt, by the monotonic clock, s, while the first event is a refused one.
    """

    def __init__(self) -> None:
        self.retry_at: float | None = None
        self._telemetry: deque[tuple[str, Value]] = deque(maxlen=TELEMETRY_WAITING)
        self._events: deque[Publication] = deque()
        self._closing = False
        self._wakeup = threading.Condition()

    def add_telemetry(self, key: str, payload: Value) -> None:
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

    def next(self) -> Publication | tuple[str, Value] | None:
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
