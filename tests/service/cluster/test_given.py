"""Feeders of the command line: the front puts each one, also after a refused one."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from pathlib import Path

import pytest

from feeders.model.site import Site, load
from service.cluster import front as module
from service.cluster.catalogue import Catalogue
from service.cluster.forward import DESIGN_S, StateCalls, Workers
from service.cluster.front import Front, ObservedStore
from service.cluster.messages import Answer, Call, Caller, Envelope
from service.errors import NoOwner


class Owners:
    """Answers of the owners in turn, by feeder; None without an owner."""

    def __init__(self, **answers: list[int | None]) -> None:
        self.answers = answers
        self.limits: set[float] = set()

    async def ask(self, feeder: str, call: Call, limit_s: float) -> Answer:
        assert (call.method, call.path) == ("PUT", f"/api/v1/feeders/{feeder}")
        self.limits.add(limit_s)
        status = self.answers[feeder].pop(0)
        if status is None:
            raise NoOwner(feeder)
        return Answer(status, (), b'{"detail": "a reason"}')


def copies(site: Site, *names: str) -> dict[str, Site]:
    tables = site.tables
    return {
        name: replace(site, tables=replace(tables, meta=replace(tables.meta, name=name))) for name in names
    }


def test_a_refused_feeder_does_not_block_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PUT_AGAIN_S", 0.0)
    owners = Owners(a=[None, 422], b=[503, None, 200])
    with ObservedStore(f"sqlite:///{tmp_path}/g.db") as store:
        front = Front(
            store,
            Workers(),
            Catalogue(store),
            copies(load("cigre-lv"), "a", "b"),
            live_workers=list,
            shelve_most_s=3600.0,
            wall=time.time,
        )
        states = StateCalls(Workers(), Caller(lambda *_: [], Envelope(b"secret")))
        front.attach(owners, states)  # type: ignore[arg-type]

        async def run() -> None:
            await front.refresh()
            await front._put_given()

        asyncio.run(run())
        assert (owners.answers, owners.limits) == ({"a": [], "b": []}, {DESIGN_S})
        reasons = front.ready()[1]
    assert "feeder a: it is not in the database yet" in reasons
    assert "feeder b: it is not in the database yet" not in reasons
