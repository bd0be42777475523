"""Notifications of several fronts: one of them sends."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.settings import settings
from service.store.deliveries import DeliveryStore
from tests.service.clusters import FrontHere
from tests.service.databases import Cluster
from tests.service.running import free_port, until

TARGETS = '[[alertmanager]]\nname = "a"\nurl = "http://127.0.0.1:9"\nprivate_addresses = true\n'


@pytest.mark.postgresql
def test_a_front_is_the_only_sender(cluster: Cluster, tmp_path: Path) -> None:
    database, file = cluster.database(), tmp_path / "targets.toml"
    file.write_text(TARGETS)
    chosen = {
        "database": database,
        "notify": file,
        "http": "127.0.0.1:0",
        "zenoh_listen": (f"tcp/127.0.0.1:{free_port()}",),
        "workers": 0,
    }

    def refused() -> bool:
        with DeliveryStore(database, shared=True) as other:
            return not other.sends()

    front = FrontHere(settings(chosen))
    try:
        until(refused, "the sender", 5.0)
    finally:
        front.end()
