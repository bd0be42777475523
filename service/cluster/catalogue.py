"""Feeders of the database: names, tables and loaded sites, by their revisions.

A worker loads the feeders of its shards when it claims them, and the others ahead of time for a fail-over.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import structlog

from feeders.format.tables import from_json
from feeders.model.site import Site, from_tables
from gridsec.errors import FeederInvalid, GridsecError
from service.store.store import Reader

AHEAD_MOST: Final = 500
"""Largest number of feeders that are loaded ahead of time."""
_log = structlog.get_logger("gridsec.cluster")


@dataclass(frozen=True, slots=True)
class Listed:
    """One feeder of the database."""

    name: str
    tables: Mapping[str, Any]
    digest: str

    @property
    def title(self) -> str:
        """Title of the feeder, or its name."""
        return str(self.tables.get("feeder", {}).get("title") or self.name)

    @property
    def meters(self) -> tuple[str, ...]:
        """Names of its meters."""
        rows = self.tables.get("customers") or ()
        return tuple(row["meter"] for row in rows if row.get("meter"))


@dataclass(slots=True)
class Changes:
    """Difference of two states of the catalogue."""

    added: list[str] = field(default_factory=list)  # or changed
    removed: list[str] = field(default_factory=list)


def load(listed: Listed) -> Site | str:
    """Site of a feeder, or the reason why its tables cannot be loaded."""
    try:
        return from_tables(from_json(dict(listed.tables)))
    except GridsecError as error:
        # The tables were valid when they were added; after an update the other feeders must still start.
        return "; ".join(error.problems) if isinstance(error, FeederInvalid) else str(error)


class Catalogue:
    """Feeders of the database. Thread-safe.

    store: database.
    """

    def __init__(self, store: Reader) -> None:
        self._store = store
        self._change: int | None = None
        self._lock = threading.Lock()
        self._feeders: dict[str, Listed] = {}
        self._sites: dict[str, tuple[str, Site | str]] = {}

    @property
    def feeders(self) -> Mapping[str, Listed]:
        """All feeders by name, as of the last `refresh`."""
        return self._feeders

    def refresh(self) -> Changes:
        """Read the feeders after a change; return what has changed. Raises StoreUnavailable."""
        change = self._store.feeder_changes()
        if change == self._change:
            return Changes()
        read = self._store.feeders()
        found = {name: Listed(name, tables, _digest(tables)) for name, tables in read.items()}
        self._change = change
        with self._lock:
            before, self._feeders = self._feeders, found
            self._sites = {name: kept for name, kept in self._sites.items() if name in found}
        changed = [
            name for name, one in found.items() if name not in before or before[name].digest != one.digest
        ]
        return Changes(changed, [name for name in before if name not in found])

    def site(self, name: str) -> Site | str:
        """Site of a feeder, or the reason why it cannot be loaded."""
        listed = self._feeders[name]
        with self._lock:
            kept = self._sites.get(name)
        if kept is not None and kept[0] == listed.digest:
            return kept[1]
        made = load(listed)
        if isinstance(made, str):
            _log.error("a stored feeder is not monitored", feeder=name, problem=made)
        with self._lock:
            self._sites[name] = (listed.digest, made)
        return made

    def sites(self, names: Iterable[str]) -> dict[str, Site | str]:
        """Sites of feeders that exist, as of `site`."""
        return {name: self.site(name) for name in names if name in self._feeders}

    def next_ahead(self, owned: Collection[str]) -> str | None:
        """Feeder of another worker to load ahead of time, or None."""
        with self._lock:
            if len(self._sites) >= AHEAD_MOST:
                return None
            return next((one for one in self._feeders if one not in self._sites and one not in owned), None)


def _digest(tables: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(tables, sort_keys=True).encode()).hexdigest()
