"""Observation of the database by a front: changes by other processes, and their leases."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Collection
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import pytest

from service.cluster import forward
from service.cluster.catalogue import Catalogue
from service.cluster.forward import Workers
from service.cluster.front import Front, ObservedStore
from service.cluster.messages import WorkerState

CHANGES = {
    "added": "INSERT INTO {} VALUES ('b', 'village', 20.0, '{{}}')",
    "moved": "UPDATE {} SET t_next = 12.0",
    "ended": "UPDATE {} SET t_next = NULL",
}


@pytest.mark.parametrize("table", ["shelf", "planned_work"])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_shelves_and_works_of_other_processes_are_counted(tmp_path: Path, table: str, change: str) -> None:
    path = tmp_path / "g.db"
    with (
        ObservedStore(f"sqlite:///{path}") as store,
        closing(sqlite3.connect(path, isolation_level=None)) as other,
    ):
        other.execute(f"INSERT INTO {table} VALUES ('a', 'village', 10.0, '{{}}')")
        store.refresh()
        before = store.suppression_changes
        store.refresh()
        assert store.suppression_changes == before
        other.execute(change.format(table))
        store.refresh()
        assert store.suppression_changes == before + 1


class Asked:
    """Workers that a front asks for their states."""

    def __init__(self) -> None:
        self.names: set[str] = set()

    def follow(self, names: Collection[str]) -> None:
        self.names = set(names)


def test_heard_workers_are_asked_also_while_their_leases_are_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registered, asked, workers = ["w0"], Asked(), Workers()

    def live_workers() -> list[str]:
        return list(registered)

    async def run(front: Front) -> None:
        await front.refresh()
        assert asked.names == {"w0"}
        workers.take(WorkerState("w0", (1, 1), {}, {}, 0, None, ()))
        # After a restart of the database no worker has renewed its leases yet.
        registered.clear()
        await front.refresh()
        assert asked.names == {"w0"}
        monkeypatch.setattr(forward, "HEARD_S", 0.0)
        await front.refresh()
        assert asked.names == set()

    with ObservedStore(f"sqlite:///{tmp_path}/g.db") as store:
        front = Front(store, workers, Catalogue(store), {}, live_workers=live_workers, shelve_most_s=3600.0)
        front.attach(cast(Any, None), cast(Any, asked))
        asyncio.run(run(front))
