"""The feeder that is watched, two liars on it, and where its database is."""

from __future__ import annotations

from pathlib import Path

import pytest

from feeders.model.site import Site, load
from service.ingest.queues import Sample
from tests.service.liars import FEEDER, two_liars


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


@pytest.fixture(scope="module")
def attacked(site: Site) -> list[Sample]:
    return two_liars(site)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "gridsec.db"
