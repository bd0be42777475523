"""What waits to be published: events in their order, none lost; of telemetry what is new."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

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
