"""Rounds of a small feeder in which two meters lie for a while."""

from __future__ import annotations

from collections.abc import Callable

from feeders.model.site import Site
from feeders.simulation.scenario import Scenario, by_arrival, random_attacks, simulate
from service.cli.simulate import key_of, payload_of
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.store import Store
from tests.service.running import Outlet

FEEDER = "simbench-lv-rural1"
START = 1_795_212_000.0


def two_liars(site: Site) -> list[Sample]:
    """Forty seconds with two liars from the tenth to the twentieth."""
    attacks = random_attacks(site, 2, "bias", 2, 0.03, t_on=START + 10, t_off=START + 20)
    scenario = Scenario(seed=1, start=START, duration_s=40.0, attacks=attacks)
    return [
        Sample(f"gridsec/{key_of(FEEDER, r.meter)}", payload_of(r), "", r.arrival, 1)
        for r in by_arrival(simulate(site, scenario))
    ]


def rounds(
    store: Store, site: Site, outlet: Outlet | None = None, stored: Callable[[], None] = lambda: None
) -> Engine:
    # A clock at rest: no time budget ends a round early on a busy machine.
    config = RuntimeConfig(clock=Clock.EVENTS)
    made = Engine(config, store, [site], wall=lambda: START, stored=stored, clock=lambda: 0.0)
    made.committer.publisher = outlet
    made.monitors[FEEDER].install(design(site))
    made.begin()
    return made


def until(samples: list[Sample], t: float) -> tuple[list[Sample], list[Sample]]:
    return [s for s in samples if s.arrival < START + t], [s for s in samples if s.arrival >= START + t]
