"""Standing alarms of feeders that are neither monitored nor stored, among those of claimed shards.

A worker has no shards at its start, and the front puts the feeders of its command line one after another. A
feeder counts as removed when leases and stored feeders are the same at two reads `ORPHAN_S` apart.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

from service.alarms.state_machine import Alarm
from service.store import Store
from service.store.leases import Lease

ORPHAN_S: Final = 60.0
"""Interval of the reads after a claim, s; longer than the design of one feeder."""


@dataclass(frozen=True, slots=True)
class Standing:
    """Active alarms of the feeders of this process, with its leases and all stored feeders."""

    held: Mapping[int, Lease]
    feeders: Mapping[str, int]  # number of the last change by name
    alarms: tuple[Alarm, ...]


def read_standing(store: Store) -> Standing:
    """Read the active alarms of this process. Raises StoreUnavailable."""
    held, feeders = store.held, store.feeder_versions()
    return Standing(held, feeders, tuple(one for one in store.active() if store.mine(one.feeder)))


class Orphans:
    """Schedule of the reads, and comparison with the read before."""

    def __init__(self) -> None:
        self._done: Mapping[int, Lease] | None = None
        self._before: Standing | None = None
        self._next_s = -math.inf

    def due(self, held: Mapping[int, Lease], now: float) -> bool:
        """True if a read is due at the monotonic time `now`, s; the next one follows after `ORPHAN_S`."""
        if not held or held is self._done or now < self._next_s:
            return False
        self._next_s = now + ORPHAN_S
        return True

    def found(self, read: Standing, monitored: Collection[str]) -> list[Alarm]:
        """Return the alarms of removed feeders; empty after a change since the read before."""
        before, self._before = self._before, read
        if before is None or before.held is not read.held or before.feeders != read.feeders:
            return []
        self._done = read.held
        return [one for one in read.alarms if one.feeder not in read.feeders.keys() | set(monitored)]
