"""What the store hands out besides alarms and reports."""

from __future__ import annotations

from dataclasses import dataclass

from gridsec.errors import GridsecError
from service.alarms import Alarm, Change


class StoreUnavailable(GridsecError):
    """The database cannot be opened, read or written; the message says which one and why."""

    code = "database-unavailable"


class OutcomeUnknown(StoreUnavailable):
    """The connection broke while a transaction was committed: it is stored as a whole, or not at all."""

    code = "outcome-unknown"


class WriterLost(StoreUnavailable):
    """The lock of the one writer is lost: another process may have written, and this one must end."""

    code = "writer-lost"


@dataclass(frozen=True, slots=True)
class Event:
    """One stored transition. `seq` rises by the order of commits and is never used twice."""

    seq: int
    t: float
    change: Change
    who: str | None
    comment: str | None
    alarm: Alarm


@dataclass(frozen=True, slots=True)
class Rejected:
    """A reading that could not be used: arrival time (Unix s), key, why, and the start of its bytes."""

    t: float
    key: str
    reason: str
    payload: bytes = b""
