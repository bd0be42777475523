"""Take-over of feeders by a worker: changed tables, repeated take-overs, monitors without a lease."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from feeders.format.tables import to_json
from feeders.model.site import Site, load
from service.cluster.catalogue import Catalogue
from service.cluster.worker import Member
from service.engine.engine import Engine, RuntimeConfig
from service.ingest.queues import Sample
from service.store import Store
from service.store.leases import Lease, shard_of

NAME = "cigre-lv"


@pytest.fixture(scope="module")
def site() -> Site:
    return load(NAME)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(f"sqlite:///{tmp_path}/g.db") as made:
        yield made


def titled(site: Site, title: str) -> dict[str, Any]:
    """Tables of the site with another title."""
    return to_json(replace(site.tables, meta=replace(site.tables.meta, title=title)))


def engine_of(store: Store, *, rejects_unknown: bool = True) -> Engine:
    return Engine(
        RuntimeConfig(rejects_unknown=rejects_unknown), store, (), wall=time.time, stored=lambda: None
    )


class Shards:
    """Leases of shards that the test sets."""

    worker = "w0"

    def __init__(self, *feeders: str) -> None:
        self.held = {shard_of(name): Lease(shard_of(name), 1) for name in feeders}

    def weigh(self, weights: dict[str, float]) -> None:
        self.weights = weights


class Monitors:
    """Monitored feeders of a process by name."""

    def __init__(self) -> None:
        self.sites: dict[str, Site] = {}

    async def adopt(self, sites: Sequence[Site]) -> None:
        self.sites |= {site.feeder.name: site for site in sites}

    async def resign(self, names: Collection[str]) -> None:
        for name in names:
            del self.sites[name]

    def known(self, name: str) -> bool:
        return name in self.sites

    def set_unloaded(self, reasons: object) -> None:
        assert reasons == {}


def member_of(shards: Shards, catalogue: Catalogue) -> Member:
    return Member(shards, catalogue)  # type: ignore[arg-type]


def test_a_late_take_over_keeps_the_newer_monitor(store: Store, site: Site) -> None:
    engine = engine_of(store)
    newer = replace(site)
    monitor = engine.add(newer)
    designs: list[str] = []
    answer = engine.adopt([site], lambda made: designs.append(made.name))
    assert answer.result() == []
    assert (engine.monitors[NAME], designs) == (monitor, [])


def test_a_repeated_take_over_restarts_nothing(store: Store, site: Site) -> None:
    engine = engine_of(store)
    designs: list[str] = []
    for _ in range(2):
        engine.adopt([site], lambda made: designs.append(made.name)).result()
    assert designs == [NAME]


def test_tables_stored_before_the_claim_are_taken_over(store: Store, site: Site) -> None:
    store.commit(put=(NAME, titled(site, "old")))
    catalogue, host = Catalogue(store), Monitors()
    catalogue.refresh()
    store.commit(put=(NAME, titled(site, "new")))
    asyncio.run(member_of(Shards(NAME), catalogue)._reconcile(host))
    assert host.sites[NAME].tables.meta.title == "new"


def test_a_monitor_without_a_lease_is_ended(store: Store, site: Site) -> None:
    store.commit(put=(NAME, titled(site, "put")))
    catalogue, host = Catalogue(store), Monitors()
    # A feeder that the catalogue does not list yet is the result of a command.
    host.sites = {NAME: site, "new": site}
    catalogue.refresh()
    asyncio.run(member_of(Shards(), catalogue)._reconcile(host))
    assert host.sites.keys() == {"new"}


@pytest.mark.parametrize("rejects", [True, False])
def test_readings_during_a_hand_over_are_not_rejected(store: Store, rejects: bool) -> None:
    now = time.time()
    readings = [
        Sample(f"gridsec/{source}/reading", b"{}", "application/json", now, 2)
        for source in ("gone/meter/m01", "gone/substation", "gone/substation/other")
    ]
    engine_of(store, rejects_unknown=rejects).cycle(readings)
    reasons = [one.reason.partition(":")[0] for one in store.rejected()]
    assert reasons == ["key", *(["unknown-feeder"] * 2 if rejects else [])]
