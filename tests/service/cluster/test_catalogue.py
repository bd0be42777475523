"""Feeders of the database: changes, sites, and tables that cannot be loaded."""

from __future__ import annotations

from pathlib import Path

from feeders.format.tables import to_json
from feeders.model.site import Site, load
from service.cluster.catalogue import Catalogue
from service.store import Store


def test_changes_of_the_database_are_followed(tmp_path: Path) -> None:
    tables = to_json(load("cigre-lv").tables)
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        catalogue = Catalogue(store)
        assert catalogue.refresh().added == []
        store.commit(put=("cigre-lv", tables))
        store.commit(put=("village", {"feeder": {"name": "village"}}))
        assert catalogue.refresh().added == ["cigre-lv", "village"]
        assert catalogue.refresh().added == []
        listed = catalogue.feeders["cigre-lv"]
        site = catalogue.site("cigre-lv")
        assert isinstance(site, Site)
        assert listed.meters == site.meter_ids
        assert listed.title == site.tables.meta.title
        # Loaded once, until its tables change.
        assert catalogue.site("cigre-lv") is site
        assert isinstance(catalogue.site("village"), str)
        assert catalogue.sites(["village", "nowhere"]).keys() == {"village"}
        other = {**tables["feeder"], "title": "Another title"}
        store.commit(put=("cigre-lv", {**tables, "feeder": other}))
        store.commit(without="village")
        changes = catalogue.refresh()
        assert (changes.added, changes.removed) == (["cigre-lv"], ["village"])
        assert catalogue.site("cigre-lv") is not site


def test_feeders_of_other_workers_are_loaded_ahead(tmp_path: Path) -> None:
    tables = to_json(load("cigre-lv").tables)
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        catalogue = Catalogue(store)
        for name in ("a", "b"):
            store.commit(put=(name, {**tables, "feeder": {**tables["feeder"], "name": name}}))
        catalogue.refresh()
        assert catalogue.next_ahead({"a"}) == "b"
        catalogue.sites(["b"])
        assert catalogue.next_ahead({"a"}) is None
