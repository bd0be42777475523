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
READ_AT_ONCE: Final = 50
"""Number of feeders of one read of tables: each has tens of kilobytes."""
_log = structlog.get_logger("gridsec.cluster")


@dataclass(frozen=True, slots=True)
class Listed:
    """One feeder of the database.

    version: number of the last change of its tables.
    digest: SHA-256 of its tables.
    meters: names of its meters.
    """

    name: str
    version: int
    digest: str
    title: str
    meters: tuple[str, ...]


def listed(name: str, version: int, tables: Mapping[str, Any]) -> Listed:
    """Return the entry of a feeder with these tables."""
    rows = tables.get("customers") or ()
    title = str(tables.get("feeder", {}).get("title") or name)
    meters = tuple(row["meter"] for row in rows if row.get("meter"))
    return Listed(name, version, digest(tables), title, meters)


def digest(tables: Mapping[str, Any]) -> str:
    """Return the SHA-256 of tables, hexadecimal."""
    return hashlib.sha256(json.dumps(tables, sort_keys=True).encode()).hexdigest()


@dataclass(slots=True)
class Changes:
    """Difference of two states of the catalogue."""

    added: list[str] = field(default_factory=list)  # or changed
    removed: list[str] = field(default_factory=list)


def load(tables: Mapping[str, Any]) -> Site | str:
    """Site of a feeder, or the reason why its tables cannot be loaded."""
    try:
        return from_tables(from_json(dict(tables)))
    except GridsecError as error:
        # The tables were valid when they were added; after an update the other feeders must still start.
        return "; ".join(error.problems) if isinstance(error, FeederInvalid) else str(error)


def _differ(before: Listed | None, now: Listed) -> bool:
    return before is None or before.digest != now.digest


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
        """Read the changed feeders; return what has changed. Raises StoreUnavailable.

        The tables are read in parts, and are not kept.
        """
        change = self._store.feeder_changes()
        if change == self._change:
            return Changes()
        versions, before = self._store.feeder_versions(), self._feeders
        new = [name for name in versions if name not in before or before[name].version != versions[name]]
        found = {name: one for name, one in before.items() if name in versions}
        for begin in range(0, len(new), READ_AT_ONCE):
            read = self._store.feeders(new[begin : begin + READ_AT_ONCE])
            found |= {name: listed(name, versions[name], tables) for name, tables in read.items()}
        self._change = change
        with self._lock:
            self._feeders = dict(sorted(found.items()))
            self._sites = {name: kept for name, kept in self._sites.items() if name in found}
        changed = [name for name in new if name in found and _differ(before.get(name), found[name])]
        return Changes(changed, [name for name in before if name not in found])

    def site(self, name: str) -> Site | str | None:
        """Site of a feeder, or the reason why it cannot be loaded; None if it exists no more.

        Raises StoreUnavailable.
        """
        entry = self._feeders[name]
        with self._lock:
            kept = self._sites.get(name)
        if kept is not None and kept[0] == entry.digest:
            return kept[1]
        tables = self._store.feeders((name,)).get(name)
        if tables is None:
            return None
        made = load(tables)
        if isinstance(made, str):
            _log.error("a stored feeder is not monitored", feeder=name, problem=made)
        with self._lock:
            self._sites[name] = (digest(tables), made)
        return made

    def sites(self, names: Iterable[str]) -> dict[str, Site | str]:
        """Sites of feeders that exist, as of `site`. Raises StoreUnavailable."""
        found = {name: self.site(name) for name in names if name in self._feeders}
        return {name: site for name, site in found.items() if site is not None}

    def next_ahead(self, owned: Collection[str]) -> str | None:
        """Feeder of another worker to load ahead of time, or None."""
        with self._lock:
            if len(self._sites) >= AHEAD_MOST:
                return None
            return next((one for one in self._feeders if one not in self._sites and one not in owned), None)
