"""Observation of the database by a front: changes by another process."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from service.cluster.front import ObservedStore

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
