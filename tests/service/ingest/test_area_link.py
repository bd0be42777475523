"""Distributed estimation over real zenoh sessions on loopback."""

from __future__ import annotations

import time
from contextlib import ExitStack

import numpy as np

from feeders.model.site import load, load_doubt
from gridsec.estimators import distributed
from gridsec.estimators.distributed import Concentrator, exchange, laterals, verdict
from gridsec.grid.radial import Feeder
from gridsec.interface import Decision
from service.ingest.area_link import PREFIX, AreaLink
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient
from tests.service.running import free_port


def test_concentrators_agree_over_zenoh_and_refuse_others() -> None:
    site = load("simbench-lv-rural1")
    feeder = site.feeder
    assert isinstance(feeder, Feeder)
    noise = np.full(site.meters.size, 1e-6)
    areas = distributed.design(
        feeder, site.meters, noise, load_doubt(site), tops=laterals(feeder, 4), busbar=0.002
    )
    zero = np.zeros(len(feeder.customers))
    y = feeder.bus_voltages(zero, zero, 1.0)[feeder.bus[site.meters]]
    y[int(areas[1].meters[0])] += 0.05
    posts, alone = ([Concentrator(area, noise[area.meters]) for area in areas] for _ in range(2))
    for post in (*posts, *alone):
        mine = post.area.customers
        post.observe(y[post.area.meters], zero[mine], zero[mine])
    exchange(alone, 30)
    where = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as stack:
        first = stack.enter_context(AreaLink(BusConfig("peer", listen=(where,)), "village", posts[0]))
        links = [first]
        links += [
            stack.enter_context(AreaLink(BusConfig("client", connect=(where,)), "village", post))
            for post in posts[1:]
        ]
        stranger = stack.enter_context(MeterClient(BusConfig("client", connect=(where,)), PREFIX))
        end, settled = time.monotonic() + 15.0, False
        while not settled and time.monotonic() < end:
            stranger.put("village/1/0", b"no message")
            stranger.put("village/77/0", b"no neighbour")
            for link in links:
                link.round()
            time.sleep(0.02)
            settled = all(
                np.allclose(a.estimate().v2, b.estimate().v2, rtol=0, atol=1e-12)
                for a, b in zip(posts, alone, strict=True)
            )
    assert settled
    told = verdict({post.area.number: post.estimate() for post in posts}, areas)
    assert (told.decision, told.meters) == (Decision.ATTACKED, (int(areas[1].meters[0]),))
    assert first.refused
