"""A simulation in step with a service, whatever the meters' interval and the feeder's tick are."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import count
from typing import Any, cast

import pytest

from feeders.model.site import from_tables, load
from feeders.simulation.plant import Channel
from feeders.simulation.scenario import Scenario
from service.cli.simulate import OutOfStep, Pace, play
from service.ingest.align import Aligner, Clock, rules
from service.ingest.reading import Reading
from service.ingest.zenoh_bus import MeterClient

FEEDER = "simbench-lv-rural1"
START = 1_795_212_000.0


class Aligned:
    """What a service makes of the readings: its ticks, without anybody who judges them."""

    def __init__(self, ids: tuple[str, ...], tick_s: float) -> None:
        self.aligner = Aligner(ids, rules(tick_s, 10.0 * tick_s, clock=Clock.EVENTS))
        self.waiting: list[bytes] = []
        self.reached = -math.inf

    def watch(self, feeder: str) -> None:
        assert feeder == FEEDER

    def put(self, key: str, payload: bytes) -> None:
        fields, parts = json.loads(payload), key.split("/")
        meter = None if parts[1] == "substation" else parts[2]
        for tick in self.aligner.take(Reading(FEEDER, meter, fields["t"], fields["v_volt"]), 0.0)[1]:
            self.reached = tick.t
            self.waiting.append(json.dumps({"t": tick.t}).encode())

    def estimates(self) -> list[bytes]:
        waiting, self.waiting = self.waiting, []
        return waiting


def lags(dt_s: float, tick_s: float, ahead: int, offset_s: float = 0.0, loss: float = 0.0) -> list[float]:
    """How far every step of a simulation is ahead of the ticks, s."""
    tables = load(FEEDER).tables
    monitor = replace(tables.meta.monitor, tick_s=tick_s)
    site = from_tables(replace(tables, meta=replace(tables.meta, monitor=monitor)))
    service, now = Aligned(site.meter_ids, tick_s), count()
    scenario = Scenario(
        seed=2,
        start=START + offset_s,
        duration_s=12.0 * max(dt_s, tick_s),
        dt_s=dt_s,
        channel=Channel(loss=loss),
    )
    pace = Pace(speed=math.inf, ahead=ahead)
    played = play(
        site, scenario, cast(MeterClient, service), pace, clock=lambda: float(next(now)), sleep=lambda _: None
    )
    out: list[Any] = [sample.t - service.reached for sample in played]
    return [lag for lag in out if math.isfinite(lag)]


@pytest.mark.parametrize("ahead", [1, 3])
@pytest.mark.parametrize(
    ("dt_s", "tick_s", "offset_s"),
    [(0.2, 1.0, 0.0), (1.0, 1.0, 0.0), (2.0, 1.0, 0.0), (1.0, 3.0, 2.0), (2.0, 2.0, 1.0)],
)
def test_steps_are_kept_at_any_interval(dt_s: float, tick_s: float, offset_s: float, ahead: int) -> None:
    found = lags(dt_s, tick_s, ahead, offset_s)
    assert len(found) > 8
    assert max(found) < ahead * max(dt_s, tick_s)


def test_steps_are_kept_with_readings_that_are_lost() -> None:
    assert max(lags(0.2, 1.0, 2, loss=0.1)) < 2.0


def test_a_service_that_says_nothing_is_waited_for_and_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Aligned, "estimates", lambda _: [])
    with pytest.raises(OutOfStep):
        lags(0.2, 1.0, 3)
