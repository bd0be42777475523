"""Read access that follows the events of other processes: the store of a process that monitors no feeder."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import sqlalchemy as sa
import structlog

from service.store.connect import Connections
from service.store.schema import EVENT, INCIDENT_EVENT, WRITER, StoreUnavailable
from service.store.store import Reader

POLL_S: Final = 0.2
"""Interval at which the numbers of the newest events are read, s."""
_log = structlog.get_logger("gridsec.store")


class FollowingStore(Reader):
    """Reader of a database that workers write.

    changed: called from another thread after the number of the newest event has changed.
    url: address, PostgreSQL.
    Raises StoreUnavailable if the database cannot be read.
    """

    def __init__(self, url: str) -> None:
        super().__init__(Connections(url))
        self.changed: Callable[[], None] = lambda: None
        self._closed = threading.Event()
        try:
            self._last_event, self._last_incident_event = self._newest()
        except BaseException:
            self._connections.close()
            raise
        self._thread = threading.Thread(target=self._follow, name="gridsec-store-follow", daemon=True)
        self._thread.start()

    def __enter__(self) -> FollowingStore:
        """Return the store."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self._closed.set()
        self._thread.join(timeout=1.0)
        self._connections.close()

    @property
    def last_event(self) -> int:
        """Number of the newest event, as of the last poll; without a call to the database."""
        return self._last_event

    @property
    def last_incident_event(self) -> int:
        """Number of the newest event of an incident, as of the last poll; without a call to the database."""
        return self._last_incident_event

    def check(self) -> None:
        """Test a read. Raises StoreUnavailable if the database does not answer."""
        with self._read() as connection:
            connection.execute(sa.select(WRITER.c.checks)).first()

    def _newest(self) -> tuple[int, int]:
        columns = (EVENT.c.seq, INCIDENT_EVENT.c.seq)
        newest = [sa.select(sa.func.max(column)).scalar_subquery() for column in columns]
        with self._read() as connection:
            row = connection.execute(sa.select(*newest)).one()
        return int(row[0] or 0), int(row[1] or 0)

    def _follow(self) -> None:
        failing = False
        while not self._closed.wait(POLL_S):
            try:
                found = self._newest()
            except StoreUnavailable as error:
                if not failing:
                    _log.error("new events cannot be read", problem=str(error))
                failing = True
                continue
            failing = False
            if found != (self._last_event, self._last_incident_event):
                self._last_event, self._last_incident_event = found
                self.changed()
