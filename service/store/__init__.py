"""What must survive: alarms, their events, the outbox, history, rejected readings, feeder tables.

SQLite or PostgreSQL, by SQLAlchemy's Core. One transaction holds an alarm's state, its event and the
outbox entry for its publication, so that none of the three is ever seen without the others.

There is one writer: one connection in one process, held by a lock that ends with the process. SQLite
before 3.51.3 can corrupt a WAL database that two connections write or checkpoint at once; readers here have
connections of their own which cannot write. Every commit is on the disk when `commit` returns
(`synchronous=FULL`, `synchronous_commit=on`).

All methods block; from asynchronous code, call them in a thread. They are safe to call from any thread.
A call to PostgreSQL has a time limit. `OutcomeUnknown` is a commit without an answer; `Store.commit` with the
same key again tells or repeats it. After `WriterLost` a store writes nothing more.
"""

from service.store.history import HistoryRules
from service.store.schema import Event, OutcomeUnknown, Rejected, StoreUnavailable, WriterLost
from service.store.writes import BAD_READINGS_KEPT, Store

__all__ = [
    "BAD_READINGS_KEPT",
    "Event",
    "HistoryRules",
    "OutcomeUnknown",
    "Rejected",
    "Store",
    "StoreUnavailable",
    "WriterLost",
]
