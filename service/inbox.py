"""The bounded queue between the receiving threads and the runtime."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable

from service.bus import Sample

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
