"""Latest messages of the workers: the owner of each feeder, and its entry in the list.

The newest message with the highest epoch of a shard counts. A worker is silent after `HEARD_S` without a
message: its feeders then have no owner, until another worker reports their shards.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import structlog

from service.cluster.envelope import Envelope, MessageRefused
from service.cluster.status import STATES, Entry, WorkerState
from service.store.leases import shard_of

HEARD_S: Final = 3.0
"""Age of a worker's last message after which it is silent, s."""
FORGET_S: Final = 3600.0
"""Age after which its last message is forgotten, s."""
_log = structlog.get_logger("gridsec.cluster")


@dataclass(frozen=True, slots=True)
class _Heard:
    at: float  # monotonic s
    state: WorkerState


class Workers:
    """The heard workers. Thread-safe.

    changed: called from another thread after a message.
    """

    def __init__(self, envelope: Envelope) -> None:
        self._envelope = envelope
        self.changed: Callable[[], None] = lambda: None
        self._lock = threading.Lock()
        self._heard: dict[str, _Heard] = {}
        self._owners: dict[int, tuple[int, str]] = {}

    def take(self, payload: bytes) -> None:
        """Take a message."""
        try:
            state = WorkerState.of(self._envelope.open(STATES, payload))
        except (MessageRefused, ValueError, KeyError, TypeError) as error:
            _log.warning("a message of a worker is refused", problem=str(error))
            return
        now = time.monotonic()
        with self._lock:
            before = self._heard.get(state.worker)
            if before is not None and state.t <= before.state.t:
                return  # repeated, or overtaken
            self._heard[state.worker] = _Heard(now, state)
            for name in [one for one, kept in self._heard.items() if now - kept.at > FORGET_S]:
                del self._heard[name]
            for shard, epoch in state.shards.items():
                if epoch >= self._owners.get(shard, (0, ""))[0]:
                    self._owners[shard] = (epoch, state.worker)
        self.changed()

    def states(self) -> list[WorkerState]:
        """Latest states of the workers that are not silent."""
        limit = time.monotonic() - HEARD_S
        with self._lock:
            return [one.state for one in self._heard.values() if one.at >= limit]

    def owner(self, feeder: str) -> tuple[WorkerState, int] | None:
        """State of the worker that monitors a feeder, and its epoch; None if no worker does."""
        shard = shard_of(feeder)
        with self._lock:
            epoch, name = self._owners.get(shard, (0, ""))
            heard = self._heard.get(name)
        if heard is None or time.monotonic() - heard.at > HEARD_S or heard.state.shards.get(shard) != epoch:
            return None
        return heard.state, epoch

    def entry(self, feeder: str) -> Entry | None:
        """Entry of a feeder by its owner; None without an owner, or before it has taken over."""
        found = self.owner(feeder)
        return None if found is None else found[0].feeders.get(feeder)

    def last_entry(self, feeder: str) -> Entry | None:
        """Latest entry of a feeder, also of a silent worker; None before the first one."""
        with self._lock:
            found = [one for one in self._heard.values() if feeder in one.state.feeders]
        return max(found, key=lambda one: one.at).state.feeders[feeder] if found else None
