"""Readings that come but cannot be used: never CLEAN without a word, and no way out of an alarm."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from feeders.model.site import Site, load
from feeders.simulation.plant import BUSBAR
from gridsec.interface import Cause
from service.alarms.state_machine import AlarmKind
from service.cli.simulate import key_of
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.report.report import Silence
from service.store import Store

FEEDER = "simbench-lv-rural1"
START = 1_795_212_000.0
QUIET_VOLT = 230.9

Says = Callable[[int, str], tuple[float, float] | None]
"""What a meter says in a second: how old it is, s, and the voltage, V; None: nothing."""


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


class Street:
    """A feeder at no load, watched by the wall clock."""

    def __init__(self, site: Site, store: Store) -> None:
        self.site, self.store, self.second = site, store, 0
        self.wall = START - 0.5
        self.rounds = Engine(
            RuntimeConfig(clock=Clock.WALL), store, [site], wall=lambda: self.wall, stored=lambda: None
        )
        self.watch = self.rounds.monitors[FEEDER]
        self.watch.install(design(site))
        self.rounds.begin()
        self.rounds.cycle([])

    def go_on(self, seconds: int, says: Says) -> None:
        """Let everybody say something each second."""
        for second in range(self.second, self.second + seconds):
            t = START + second
            self.wall = t + 0.05
            self.rounds.cycle(list(self._samples(second, says)))
            self.wall = t + 0.9
            self.rounds.cycle([])
        self.second += seconds

    def _samples(self, second: int, says: Says) -> Iterable[Sample]:
        for meter in (BUSBAR, *self.site.meter_ids):
            if (said := says(second, meter)) is not None:
                power = {"p_kw": 0.0, "q_kvar": 0.0} if meter else {}
                payload = {"t": START + second - said[0], "v_volt": said[1], **power}
                yield Sample(
                    f"gridsec/{key_of(FEEDER, meter)}", json.dumps(payload).encode(), "", self.wall, 1
                )

    def standing(self) -> set[tuple[AlarmKind, str | None]]:
        return {(alarm.kind, alarm.meter) for alarm in self.store.active(FEEDER)}


@pytest.mark.parametrize("who", ["m03", BUSBAR])
def test_a_slow_clock_is_told_as_data_loss(site: Site, tmp_path: Path, who: str) -> None:
    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(site, store)
        street.go_on(20, lambda _, meter: (5.0 if meter == who else 0.0, QUIET_VOLT))
        source = who or "substation"
        assert street.standing() == {(AlarmKind.DATA_LOSS, source), (AlarmKind.CLOCK_OFFSET, source)}
        assert street.watch.report is not None
        assert street.watch.report.silent == (Silence(who or "substation", None),)


def test_meters_that_are_missing_in_turn_leave_nobody_without_a_word(site: Site, tmp_path: Path) -> None:
    """None of them is silent, one of them always is missing, and there is no verdict all the time."""
    ids = site.meter_ids

    def says(second: int, meter: str) -> tuple[float, float] | None:
        gone = (ids[second // 6 % len(ids)], ids[(second - 3) // 6 % len(ids)])
        return None if second >= 5 and meter in gone else (0.0, QUIET_VOLT)

    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(site, store)
        street.go_on(40, says)
        assert street.watch.report is not None
        assert street.watch.report.cause is Cause.SILENT_METERS
        assert street.standing() == {(AlarmKind.UNDECIDED, None)}


def test_a_liar_who_is_heard_at_every_other_tick_only_raises_an_alarm(site: Site, tmp_path: Path) -> None:
    def says(second: int, meter: str) -> tuple[float, float] | None:
        if meter != "m05":
            return 0.0, QUIET_VOLT
        return (1.6, 245.0) if second % 2 else None

    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(site, store)
        street.go_on(30, says)
        assert (AlarmKind.METER_MANIPULATED, "m05") in street.standing()
