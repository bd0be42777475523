"""Ticks of the next owner of a feeder until CLEAN, with the stored observer and without.

`python -m benchmarks.handover [kills] [feeder]`: a service that is killed at some tick, and one that gets its
stored observer and the readings from 2, 3 and 4 s later on. Time is that of the readings, not of the machine.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence

from benchmarks._arguments import arguments
from feeders.model.site import Site, load
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, simulate
from gridsec.interface import Decision
from service.cli.simulate import key_of, payload_of
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.engine.replay import ReplayCounts, replay
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.store import Store
from service.store.state_codec import MonitorState, StateSnapshot

START, FIRST_S, WATCHED_S = 1_795_212_000.0, 30.0, 14.0


def main() -> None:
    """Measure, and print a table."""
    given = arguments(__doc__, kills=6, feeder="cigre-lv")
    print("| gap, s | ticks until CLEAN with the stored observer | without |\n|---|---|---|")
    site = load(given.feeder)
    scenario = Scenario(seed=4, start=START, duration_s=FIRST_S + 3.0 * given.kills + 20.0)
    recorded = list(by_arrival(simulate(site, scenario)))
    kills = [START + FIRST_S + 3.0 * k for k in range(given.kills)]
    stored = [_stored(site, [one for one in recorded if one.t <= kill]) for kill in kills]
    for gap_s in (2.0, 3.0, 4.0):
        cells = []
        for resumed in (True, False):
            ticks = [
                _until_clean(site, recorded, kill + gap_s, kept if resumed else None)
                for kill, kept in zip(kills, stored, strict=True)
            ]
            cells.append(f"{min(ticks)} to {max(ticks)}")
        print(f"| {gap_s:.0f} | {' | '.join(cells)} |", flush=True)


def _stored(site: Site, recorded: Sequence[SimulatedReading]) -> StateSnapshot | None:
    """Observer in the database of a service that is killed after these readings."""
    name = site.feeder.name
    with tempfile.TemporaryDirectory() as folder, Store(f"sqlite:///{folder}/s.db") as store:
        config = RuntimeConfig(clock=Clock.EVENTS)
        engine = Engine(config, store, [site], wall=lambda: START, stored=lambda: None)
        engine.monitors[name].install(design(site))
        engine.begin()
        for one in recorded:
            key = f"{config.prefix}/{key_of(name, one.meter)}"
            engine.cycle([Sample(key, payload_of(one), "", one.arrival, 1)])
        return store.observer(name)


def _until_clean(
    site: Site, recorded: Sequence[SimulatedReading], since: float, observer: StateSnapshot | None
) -> int:
    """Ticks before the first CLEAN verdict from a time on; all of them if none is CLEAN."""
    later = [one for one in recorded if since <= one.t < since + WATCHED_S]
    results = replay(site, later, ReplayCounts(), past=MonitorState(observer=observer))
    verdicts = [one.state.verdict for one in results]
    return verdicts.index(Decision.CLEAN) if Decision.CLEAN in verdicts else len(verdicts)


if __name__ == "__main__":
    main()
