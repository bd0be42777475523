"""Replay runs the live chain: the same readings give the same reports."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import Site, from_tables, load
from feeders.registry import DesignedEstimator
from feeders.simulation.plant import Channel
from feeders.simulation.recording import read_recording, record
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, random_attacks, simulate
from gridsec.interface import Frame
from service.cli.simulate import key_of, payload_of
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.engine.replay import ReplayCounts, replay
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.report.report import to_json
from service.store import Store
from tests.service.running import Outlet

FEEDER = "simbench-lv-rural1"
START = 1_795_212_000.0
ROUGH = Channel(loss=0.03, delay_mean_s=0.2, late=0.02, late_s=1.5, duplicate=0.02, clock_s=0.1)


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


@pytest.fixture(scope="module")
def scenario(site: Site) -> Scenario:
    attacks = random_attacks(site, 2, "bias", 2, 0.03, t_on=START + 20, t_off=START + 50)
    return Scenario(seed=5, start=START, duration_s=90.0, attacks=attacks, channel=ROUGH)


@pytest.mark.canary("profiles")
@pytest.mark.parametrize("forecast", ["none", "profiles"])
def test_the_live_rounds_and_a_replay_agree_to_the_last_bit(
    site: Site, scenario: Scenario, tmp_path: Path, forecast: str
) -> None:
    site = site if forecast == "none" else forecasting(site)
    readings = list(by_arrival(simulate(site, scenario)))
    samples = [
        Sample(f"gridsec/{key_of(FEEDER, r.meter)}", payload_of(r), "", r.arrival, 1) for r in readings
    ]
    outlet = Outlet()
    with Store(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        live = Engine(
            RuntimeConfig(clock=Clock.EVENTS), store, [site], wall=lambda: START, stored=lambda: None
        )
        live.monitors[FEEDER].install(design(site))
        live.committer.publisher = outlet
        for k in range(0, len(samples), 37):
            live.cycle(samples[k : k + 37])
        alarms = store.alarms()[0]
    tally = ReplayCounts()
    replayed = list(replay(site, readings, tally))
    assert len(outlet.estimates) >= 85
    told = [json.loads(json.dumps(to_json(r.report))) for r in replayed]
    assert told[: len(outlet.estimates)] == outlet.estimates
    assert {a.meter for a in alarms} == {t.alarm.meter for r in replayed for t in r.transitions}
    assert tally.lost > 0
    assert tally.readings["duplicate"] > 0
    assert tally.readings["late"] > 0
    assert sum(tally.ticks.values()) == len(replayed)


@pytest.mark.canary("strict")
@pytest.mark.parametrize("asked", [{}, {"grace_s": 0.1, "max_skew_s": 1.2}], ids=["default", "strict"])
def test_what_was_live_by_the_wall_clock_is_replayed_by_the_time_of_arrival(
    site: Site, scenario: Scenario, tmp_path: Path, asked: dict[str, float]
) -> None:
    """Grace is by the wall clock: who comes after it is late live, and in time where the readings tell it."""
    path = record(site, replace(scenario, duration_s=40.0), tmp_path / "day.parquet").path
    readings = list(read_recording(path).readings())
    clock, outlet, chance = [readings[0].arrival], Outlet(), random.Random(3)
    with Store(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        config = RuntimeConfig(**asked)
        live = Engine(config, store, [site], wall=lambda: clock[0], stored=lambda: None)
        live.monitors[FEEDER].install(design(site))
        live.committer.publisher = outlet
        while readings:
            clock[0] += chance.expovariate(2.0)  # rounds come when they come: between readings, or after many
            ready = [r for r in readings if r.arrival <= clock[0]]
            readings = readings[len(ready) :]
            live.cycle(
                [Sample(f"gridsec/{key_of(FEEDER, r.meter)}", payload_of(r), "", r.arrival, 1) for r in ready]
            )
        clock[0] += 1.0
        live.cycle([])
    told, tally = {}, ReplayCounts()
    for by in Clock:
        run = replay(site, read_recording(path).readings(), tally, clock=by, **asked)
        told[by] = [json.loads(json.dumps(to_json(one.report))) for one in run]
    count = len(told[Clock.WALL])
    assert len(outlet.estimates) >= count >= 39
    assert told[Clock.WALL] == outlet.estimates[:count]
    assert told[Clock.EVENTS] != told[Clock.WALL][: len(told[Clock.EVENTS])]
    assert (tally.readings["clock-off"] > 0) is bool(asked)


@pytest.mark.parametrize("arrival", [None, float("nan"), 5.0])
def test_readings_that_do_not_say_when_they_arrived_were_not_live(
    site: Site, scenario: Scenario, arrival: Any
) -> None:
    good = list(by_arrival(simulate(site, replace(scenario, duration_s=3.0, channel=Channel(), attacks=()))))
    bad = [replace(one, arrival=arrival) for one in good[:5]]
    for clock, refused in ((Clock.WALL, 5), (Clock.EVENTS, 0)):
        tally = ReplayCounts()
        assert len(list(replay(site, [*bad, *good[5:]], tally, clock=clock))) == 3
        assert (tally.readings["value"], tally.readings["accepted"]) == (refused, len(good) - refused)


def forecasting(site: Site) -> Site:
    """Three customers without meters, whose powers are those of the profiles."""
    meta, rows = site.tables.meta, site.tables.customers
    rows = tuple(replace(row, meter="") if k in (2, 6, 10) else row for k, row in enumerate(rows))
    meta = replace(meta, load=replace(meta.load, forecast="profiles"))
    return from_tables(replace(site.tables, meta=meta, customers=rows))


def test_a_file_and_the_stream_it_was_made_of_agree(site: Site, scenario: Scenario, tmp_path: Path) -> None:
    short = replace(scenario, duration_s=30.0)
    record(site, short, tmp_path / "short.parquet")
    from_file = list(replay(site, read_recording(tmp_path / "short.parquet").readings(), ReplayCounts()))
    from_stream = list(replay(site, by_arrival(simulate(site, short)), ReplayCounts()))
    assert [(one.report, one.transitions) for one in from_file] == [
        (one.report, one.transitions) for one in from_stream
    ]


def test_bad_readings_of_a_recording_are_counted(site: Site, scenario: Scenario) -> None:
    good = list(by_arrival(simulate(site, replace(scenario, duration_s=10.0, channel=Channel(), attacks=()))))
    bad = [
        SimulatedReading("m99", START, 1, START, 230.0, None, None),
        SimulatedReading("m01", START, 1, START, float("nan"), None, None),
        SimulatedReading("m01", START * 1000, 1, START, 230.0, None, None),
        SimulatedReading("m01", START + 1e6, 1, START, 230.0, None, None),
    ]
    tally = ReplayCounts()
    results = list(replay(site, [*good[:14], *bad, *good[14:]], tally))
    assert (tally.readings["unknown-meter"], tally.readings["value"], tally.readings["clock-off"]) == (
        1,
        2,
        1,
    )
    assert tally.readings["accepted"] == len(good)
    assert [r.report.t for r in results] == [START + k for k in range(10)]


@pytest.mark.canary("60")
@pytest.mark.parametrize("back", [60, 1])
def test_a_defect_ends_a_replay_also_at_its_last_tick(
    site: Site, scenario: Scenario, monkeypatch: pytest.MonkeyPatch, back: int
) -> None:
    # The last readings are missing but for a few: only the end lets their tick go.
    readings = list(by_arrival(simulate(site, scenario)))[:-10]
    at = list(replay(site, readings, ReplayCounts()))[-back].report.t
    step = DesignedEstimator.step

    def breaks(self: DesignedEstimator, state: Any, frame: Frame) -> Any:
        if frame.t >= at:
            raise ZeroDivisionError("a defect")
        return step(self, state, frame)

    monkeypatch.setattr(DesignedEstimator, "step", breaks)
    with pytest.raises(ZeroDivisionError, match="a defect"):
        list(replay(site, readings, ReplayCounts()))
