"""Journals of studies, read and changed as the SQLite files that they are."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any


def rows(path: Path) -> dict[str, str]:
    """Finished work by key, also of a journal that another process has; empty if it is being created."""
    try:
        with closing(sqlite3.connect(f"file:{path}?immutable=1", uri=True)) as database:
            return dict(database.execute("SELECT key, value FROM journal ORDER BY rowid"))
    except sqlite3.Error:
        return {}


def head_of(path: Path) -> dict[str, Any]:
    """The subject of a journal."""
    with closing(sqlite3.connect(path)) as database:
        ((head,),) = database.execute("SELECT subject FROM study")
    found: dict[str, Any] = json.loads(head)
    return found


def edit(path: Path, *, head: dict[str, Any] | None = None, keep: int | None = None) -> None:
    """Give a journal another subject, or leave its first pieces of work only."""
    with closing(sqlite3.connect(path)) as database, database:
        if head is not None:
            told = (json.dumps(head, sort_keys=True),)
            database.execute("UPDATE study SET subject = ?", told)
        if keep is not None:
            database.execute("DELETE FROM journal WHERE rowid > ?", (keep,))
