"""Ticks that are due at once: judged within a second, the others skipped, counted and never CLEAN."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from feeders.model.site import Site
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, random_attacks, simulate
from service.alarms.state_machine import AlarmState
from service.cli.simulate import key_of, payload_of
from service.engine.engine import BUDGET_S, Engine, RuntimeConfig
from service.engine.feeder_monitor import FeederMonitor, TickResult, design
from service.engine.replay import ReplayCounts, replay
from service.ingest.align import LEAP_TICKS, Clock
from service.ingest.queues import Sample
from service.report.report import FeederReport, to_json
from service.store import Store
from tests.service.liars import FEEDER, START
from tests.service.running import Outlet

HOURS = 7200.0
TICK_COST_S = 0.05
"""Time that the clock of these tests lets a judged tick take, s."""


class Scene:
    """Rounds of one feeder under clocks that the test moves."""

    def __init__(self, store: Store, site: Site, monkeypatch: pytest.MonkeyPatch, clock: Clock) -> None:
        self.wall, self.monotonic, self.alive = START - 0.5, 0.0, True
        self.reports: list[FeederReport] = []
        judge = FeederMonitor.judge

        def judged(monitor: FeederMonitor) -> TickResult:
            self.monotonic += TICK_COST_S
            result = judge(monitor)
            self.reports.append(result.report)
            return result

        monkeypatch.setattr(FeederMonitor, "judge", judged)
        self.rounds = Engine(
            RuntimeConfig(clock=clock),
            store,
            [site],
            wall=lambda: self.wall,
            stored=lambda: None,
            clock=lambda: self.monotonic,
            go_on=lambda: self.alive,
        )
        self.rounds.committer.publisher = Outlet()
        self.watch = self.rounds.monitors[FEEDER]
        self.watch.install(design(site))
        self.rounds.begin()
        self.rounds.cycle([])

    def play(self, readings: list[SimulatedReading], shift: float = 0.0) -> None:
        """One round per reading time."""
        for t in sorted({r.t for r in readings}):
            now = [replace(r, t=r.t + shift, arrival=r.t + shift + 0.1) for r in readings if r.t == t]
            self.wall = t + shift + 0.2
            self.rounds.cycle([sample(r) for r in now])


def sample(r: SimulatedReading) -> Sample:
    return Sample(f"gridsec/{key_of(FEEDER, r.meter)}", payload_of(r), "", float(r.arrival or r.t), 1)


@pytest.fixture
def scene(site: Site, path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Clock], Scene]]:
    with Store(f"sqlite:///{path}") as store:
        yield lambda clock: Scene(store, site, monkeypatch, clock)


@pytest.fixture(scope="module")
def readings(site: Site) -> list[SimulatedReading]:
    attacks = random_attacks(site, 2, "bias", 1, 0.03, t_on=START + 13, t_off=START + 100)
    return list(by_arrival(simulate(site, Scenario(seed=1, start=START, duration_s=40.0, attacks=attacks))))


def seconds(readings: list[SimulatedReading], first: float, last: float) -> list[SimulatedReading]:
    return [r for r in readings if START + first <= r.t < START + last]


def test_a_leap_costs_a_second_of_catching_up_and_skips_the_rest(
    scene: Callable[[Clock], Scene], readings: list[SimulatedReading]
) -> None:
    live = scene(Clock.WALL)
    live.play(seconds(readings, 0, 9))
    assert [str(r.verdict) for r in live.reports[-5:]] == ["clean"] * 5
    before, begun = len(live.reports), live.monotonic
    live.wall += HOURS
    live.rounds.cycle([])
    new = live.reports[before:]
    # What was begun within the budget is finished, and the newest tick is judged in any case.
    assert live.monotonic - begun <= BUDGET_S + 2 * TICK_COST_S
    assert len(new) <= BUDGET_S / TICK_COST_S + 2
    assert new[-1].t == START + 8 + HOURS
    assert not live.watch.pending
    gaps = [round(b.t - a.t) - 1 for a, b in zip([live.reports[before - 1], *new], new, strict=False)]
    assert [r.skipped for r in new] == gaps
    assert sum(gaps) == HOURS - len(new) >= HOURS - LEAP_TICKS
    assert {str(r.verdict) for r in new} == {"undecided"}
    assert f"The {new[-1].skipped} ticks before were skipped." in new[-1].reason
    assert to_json(new[-1])["skipped"] == new[-1].skipped
    assert f'ticks_skipped_total{{feeder="{FEEDER}"}} {sum(gaps):.1f}' in (
        live.rounds.metrics.exposition().decode()
    )
    live.play(seconds(readings, 9, 12), HOURS)
    assert (str(live.reports[-1].verdict), live.reports[-1].skipped) == ("clean", 0)


def test_skipped_ticks_neither_clear_nor_raise_an_alarm(
    scene: Callable[[Clock], Scene], site: Site, readings: list[SimulatedReading]
) -> None:
    """Both sides of a gap say absent: the off-delay does not count the gap."""
    live = scene(Clock.WALL)
    live.play(seconds(readings, 0, 20))
    (alarm,) = live.watch.book.active
    honest = seconds(list(by_arrival(simulate(site, Scenario(seed=1, start=START, duration_s=60.0)))), 20, 60)
    played = 20
    while live.reports[-1].suspects:
        live.play(seconds(honest, played, played + 1))
        played += 1
    assert alarm.id in {one.id for one in live.watch.book.active}
    live.wall += HOURS
    live.play(seconds(honest, played, played + 1), HOURS)
    assert live.reports[-1].skipped
    assert not live.reports[-1].suspects
    standing = {one.id: one.state for one in live.watch.book.alarms}
    assert standing[alarm.id] is AlarmState.RAISED
    live.play(seconds(honest, played + 1, played + 9), HOURS)
    standing = {one.id: one.state for one in live.watch.book.alarms}
    assert standing[alarm.id] is AlarmState.CLEARED


@pytest.mark.parametrize("back_s", [HOURS, 60.0])
def test_a_clock_set_back_is_judged_from_there_on(
    scene: Callable[[Clock], Scene], readings: list[SimulatedReading], back_s: float
) -> None:
    live = scene(Clock.WALL)
    live.play(seconds(readings, 0, 5))
    live.wall = START + 5.2 - back_s
    live.rounds.cycle([])
    before = len(live.reports)
    live.play(seconds(readings, 6, 9), -back_s)
    assert [r.t for r in live.reports[before:]] == [START + k - back_s for k in (6, 7, 8)]
    assert all(meter.seen for meter in live.reports[-1].meters)
    assert live.watch.skipped == 0


def test_a_budget_is_refilled_only_when_all_is_judged(
    scene: Callable[[Clock], Scene], readings: list[SimulatedReading]
) -> None:
    live = scene(Clock.WALL)
    live.play(seconds(readings, 0, 3))
    judged = []
    for _ in range(4):
        before = len(live.reports)
        live.wall += 40.0
        live.rounds.cycle([])
        judged.append(len(live.reports) - before)
    assert judged[0] > 10
    assert judged[1:] == [1, 1, 1]
    live.wall += 1.0
    live.rounds.cycle([])
    live.wall += 40.0
    before = len(live.reports)
    live.rounds.cycle([])
    assert len(live.reports) - before > 10


def test_where_the_readings_tell_the_time_ticks_wait_and_none_is_skipped(
    scene: Callable[[Clock], Scene], readings: list[SimulatedReading]
) -> None:
    live = scene(Clock.EVENTS)
    live.rounds.cycle([sample(r) for r in seconds(readings, 0, 38)])
    assert live.rounds.behind
    assert len(live.reports) <= BUDGET_S / TICK_COST_S + 1
    while live.rounds.behind:
        live.rounds.cycle([])
    assert [r.t for r in live.reports] == [START + k for k in range(len(live.reports))]
    assert len(live.reports) >= 37
    assert live.watch.skipped == 0


def test_a_round_ends_between_two_ticks_when_the_service_stops(
    scene: Callable[[Clock], Scene], readings: list[SimulatedReading]
) -> None:
    live = scene(Clock.WALL)
    live.play(seconds(readings, 0, 3))
    live.alive, before = False, len(live.reports)
    live.wall += HOURS
    live.rounds.cycle([sample(r) for r in seconds(readings, 3, 4)])
    assert len(live.reports) == before


def test_a_replay_without_the_skipped_ticks_says_what_was_live(
    scene: Callable[[Clock], Scene], site: Site, readings: list[SimulatedReading]
) -> None:
    """A recording does not hold the service's stalls; given them, a replay is live to the last bit."""
    live = scene(Clock.WALL)
    live.play(seconds(readings, 0, 12))
    later = 30.0
    live.wall = START + 12 + later
    live.rounds.cycle([])
    live.play(seconds(readings, 12, 25), later)
    gaps = [(r.t - r.skipped, r.t - 1.0) for r in live.reports if r.skipped]
    assert gaps
    recorded = [replace(r, arrival=r.t + 0.1) for r in seconds(readings, 0, 12)]
    recorded[0] = replace(recorded[0], arrival=START - 0.5)
    recorded += [replace(r, t=r.t + later, arrival=r.t + later + 0.1) for r in seconds(readings, 12, 25)]
    told, tally = [to_json(r) for r in live.reports], ReplayCounts()
    again = [to_json(r.report) for r in replay(site, recorded, tally, clock=Clock.WALL, skipped=gaps)]
    assert again[: len(told)] == told
    assert tally.skipped == live.watch.skipped > 0
    whole = ReplayCounts()
    assert len(list(replay(site, recorded, whole, clock=Clock.WALL))) == len(again) + tally.skipped
    assert whole.skipped == 0


def test_states_are_kept_when_a_tick_was_judged(
    scene: Callable[[Clock], Scene], readings: list[SimulatedReading], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, asked = scene(Clock.WALL), []
    monkeypatch.setattr(type(live.watch.suspicions), "due", lambda _: asked.append(1) or ())
    live.wall = START + 0.1
    for r in seconds(readings, 0, 1):
        live.rounds.cycle([sample(replace(r, arrival=START + 0.1))])
    assert len(asked) == len(live.reports) == 1
