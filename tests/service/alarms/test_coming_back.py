"""Alarms of lies that come back after a restart."""

from __future__ import annotations

from pathlib import Path

from feeders.model.site import load
from feeders.simulation.scenario import Scenario, by_arrival, random_attacks, simulate
from service.alarms.state_machine import AlarmKind, AlarmState, Change
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.ingest.align import Clock
from service.store import Store
from tests.service.engine.test_commissioning import START, feed, samples
from tests.service.running import FEEDER


def test_who_lies_again_soon_after_a_restart_raises_the_same_alarm(tmp_path: Path) -> None:
    site = load(FEEDER)
    first, second = (
        random_attacks(site, 2, "bias", 1, 0.03, t_on=START + on, t_off=START + off)
        for on, off in ((5.0, 9.0), (30.0, 36.0))
    )
    scenario = Scenario(seed=1, start=START, duration_s=36.0, attacks=first + second)
    readings = list(by_arrival(simulate(site, scenario)))
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        for begin, end in ((0.0, 25.0), (25.0, 36.0)):
            live = Engine(
                RuntimeConfig(clock=Clock.EVENTS),
                store,
                [site],
                wall=lambda: START + begin,  # noqa: B023
                stored=lambda: None,
            )
            live.monitors[FEEDER].install(design(site))
            live.begin()
            feed(live, samples(readings, begin, end))
            ((alarm,), _) = store.alarms()
            assert alarm.kind is AlarmKind.METER_MANIPULATED
            assert alarm.state is (AlarmState.CLEARED if begin == 0.0 else AlarmState.RAISED)
        assert alarm.count == 2
        changes = [event.change for event in store.events(alarm.id)]
        assert changes == [Change.RAISED, Change.CLEARED, Change.RAISED]
