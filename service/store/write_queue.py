"""Queue of data that wait for the database, within stated bounds; dropped data are counted. Pure.

Reports, bad readings and changes of commissionings are records: a full queue drops the oldest. Transitions
are state: beyond the limit, each alarm keeps its newest one, which contains its whole state. If that does not
suffice, alarms are dropped that were raised and cleared without the database. Active alarms, alarms that are
active in the database and acknowledgements are kept in any case; their number is bounded by a few alarms for
each meter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

from service.alarms.state_machine import Alarm, AlarmTransition, Change, carried
from service.report.report import FeederReport
from service.store import Rejected
from service.store.schema import CommissioningEvent
from service.store.state_codec import SnapshotKind, StateSnapshot

TRANSITIONS_KEPT = 10_000
"""Number of waiting transitions beyond which they are thinned out."""
RECORDS_KEPT = 3600
"""Largest number of waiting records of each kind; a full queue drops the oldest."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Batch:
    """Contents of one transaction."""

    transitions: tuple[AlarmTransition, ...] = ()
    reports: tuple[FeederReport, ...] = ()
    rejected: tuple[Rejected, ...] = ()
    kept: tuple[StateSnapshot, ...] = ()
    happened: tuple[CommissioningEvent, ...] = ()

    def __bool__(self) -> bool:
        """True if it has any contents."""
        return any((self.transitions, self.reports, self.rejected, self.kept, self.happened))


class WriteQueue:
    """Queue of data that wait for the database. Used by one thread at a time.

    given_up: transitions dropped since the last successful write.
    forgotten: called with the kind (a label) and the number of dropped data.
    """

    def __init__(self, forgotten: Callable[[str, int], None]) -> None:
        self.given_up = 0
        self._forgotten = forgotten
        self._transitions: list[AlarmTransition] = []
        self._reports: deque[FeederReport] = deque()
        self._rejected: deque[Rejected] = deque()
        self._kept: dict[tuple[str, SnapshotKind], StateSnapshot] = {}
        self._happened: deque[CommissioningEvent] = deque()
        # Alarms that are not in the database; those of the batch in progress may be stored at any moment.
        self._unheard: set[str] = set()
        self._on_the_way: set[str] = set()
        self._taken = 0
        self._thin_at = TRANSITIONS_KEPT

    def __len__(self) -> int:
        """Number of waiting transitions, including those of the batch in progress."""
        return len(self._transitions) + self._taken

    def add(
        self,
        *,
        transitions: Iterable[AlarmTransition] = (),
        reports: Iterable[FeederReport] = (),
        rejected: Iterable[Rejected] = (),
        kept: Iterable[StateSnapshot] = (),
        happened: Iterable[CommissioningEvent] = (),
    ) -> None:
        """Add data."""
        for item in transitions:
            if item.change is Change.RAISED and item.alarm.count == 1:
                self._unheard.add(item.alarm.id)
            self._transitions.append(item)
        self._reports.extend(reports)
        self._rejected.extend(rejected)
        self._kept.update(((item.feeder, item.matter), item) for item in kept)
        self._happened.extend(happened)
        self._bound()

    def take(self) -> Batch:
        """Remove and return all data; `stored` or `give_back` must follow."""
        batch = Batch(
            tuple(self._transitions),
            tuple(self._reports),
            tuple(self._rejected),
            tuple(self._kept.values()),
            tuple(self._happened),
        )
        self._transitions.clear()
        self._reports.clear()
        self._rejected.clear()
        self._kept.clear()
        self._happened.clear()
        self._unheard, self._on_the_way = set(), self._unheard
        self._taken = len(batch.transitions)
        return batch

    def stored(self) -> None:
        """Confirm that the batch of `take` is stored."""
        self._on_the_way = set()
        self._taken = 0
        self.given_up, self._thin_at = 0, TRANSITIONS_KEPT

    def give_back(self, batch: Batch) -> None:
        """Put a batch that was not stored before all later data."""
        self._unheard |= self._on_the_way
        self._on_the_way = set()
        self._taken = 0
        self._transitions[:0] = batch.transitions
        self._reports.extendleft(reversed(batch.reports))
        self._rejected.extendleft(reversed(batch.rejected))
        # Only the newest text of each feeder and subject is needed.
        self._kept = {(item.feeder, item.matter): item for item in batch.kept} | self._kept
        self._happened.extendleft(reversed(batch.happened))
        self._bound()

    def carry(self, answered: Alarm) -> None:
        """Copy a stored acknowledgement to the transitions collected since the start of its write."""
        self._transitions = [replace(item, alarm=carried(item.alarm, answered)) for item in self._transitions]

    def forget(self, feeder: str) -> None:
        """Drop all data of a feeder: its stored removal is its last change."""
        self._transitions = [item for item in self._transitions if item.alarm.feeder != feeder]
        self._reports = deque(item for item in self._reports if item.feeder != feeder)
        self._kept = {key: item for key, item in self._kept.items() if item.feeder != feeder}
        self._happened = deque(item for item in self._happened if item.feeder != feeder)

    def _bound(self) -> None:
        self._drop_oldest(self._reports, "report")
        self._drop_oldest(self._rejected, "bad-reading")
        self._drop_oldest(self._happened, "commissioning")
        if len(self._transitions) > self._thin_at:
            before = len(self._transitions)
            most = TRANSITIONS_KEPT * 3 // 4
            self._thin(most)
            gone = before - len(self._transitions)
            self.given_up += gone
            self._forgotten("transition", gone)
            left = len(self._transitions)
            self._thin_at = TRANSITIONS_KEPT if left <= most else max(TRANSITIONS_KEPT, 2 * left)

    def _drop_oldest(self, queue: deque[T], what: str) -> None:
        over = len(queue) - RECORDS_KEPT
        for _ in range(over):
            queue.popleft()
        if over > 0:
            self._forgotten(what, over)

    def _thin(self, most: int) -> None:
        newest = {item.alarm.id: index for index, item in enumerate(self._transitions)}
        kept = [
            item
            for index, item in enumerate(self._transitions)
            if newest[item.alarm.id] == index or item.change is Change.ACKNOWLEDGED
        ]
        passed = [
            item.alarm.id
            for item in kept
            if item.alarm.id in self._unheard and not item.alarm.active and item.alarm.acknowledged_by is None
        ]
        gone = set(passed[: max(0, len(kept) - most)])
        self._unheard -= gone
        self._transitions = [item for item in kept if item.alarm.id not in gone]
