"""Store of alarms, their events, the outbox, history, rejected readings, monitor state and feeder tables.

SQLite or PostgreSQL, by SQLAlchemy's Core. One transaction contains an alarm's state, its event and the
outbox entry for its publication; readers see all three or none.

There is one writer, or several workers with leases of feeders on PostgreSQL (`leases`). The writer is one
connection in one process, protected by a lock that ends with the process. SQLite
before 3.51.3 can corrupt a WAL database that two connections write or checkpoint at once; the readers here
have connections of their own, which cannot write. Every commit is durable when `commit` returns
(`synchronous=FULL`, `synchronous_commit=on`).

All methods block; asynchronous code calls them in a thread. They are thread-safe.

A call to PostgreSQL has a time limit. `OutcomeUnknown` is a commit without an answer; `Store.commit` with the
same key again stores it, or finds it stored. After `WriterLost` a store writes nothing more.
"""

from service.store.schema import AlarmEvent, LeaseLost, OutcomeUnknown, Rejected, StoreUnavailable, WriterLost
from service.store.series import HistoryRules
from service.store.store import BAD_READINGS_KEPT, AlarmCounts, Store

__all__ = [
    "BAD_READINGS_KEPT",
    "AlarmCounts",
    "AlarmEvent",
    "HistoryRules",
    "LeaseLost",
    "OutcomeUnknown",
    "Rejected",
    "Store",
    "StoreUnavailable",
    "WriterLost",
]
