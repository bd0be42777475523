"""Rounds over a real database: what is stored, what is kept when it cannot be, and what is published."""

from __future__ import annotations

import asyncio
import json
import sqlite3
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import Site, from_tables
from feeders.registry import DesignedEstimator
from gridsec.interface import Frame
from service.alarms.state_machine import (
    AlarmState,
    AlarmTransition,
    AlarmUnknown,
    AlreadyAcknowledged,
    Change,
    RaisedAgain,
)
from service.engine.engine import NOT_WATCHED, Engine, RuntimeConfig
from service.engine.feeder_monitor import FeederMonitor, design
from service.engine.runtime import Runtime
from service.errors import FeederUnknown
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.store import Store, StoreUnavailable, connect
from service.store.committer import WriteResult
from tests.codes import refused
from tests.service.liars import FEEDER, START, rounds, until
from tests.service.running import Outlet
from tests.service.stored import an_alarm


@pytest.fixture
def locked(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], sqlite3.Connection]]:
    """Let somebody else hold the database's lock, as a backup gone wrong would."""
    monkeypatch.setattr(connect, "BUSY_S", 0.1)
    open_ones: list[sqlite3.Connection] = []

    def lock() -> sqlite3.Connection:
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        open_ones.append(other)
        return other

    yield lock
    for one in open_ones:
        one.close()


def test_alarms_are_stored_before_they_are_published(site: Site, attacked: list[Sample], path: Path) -> None:
    outlet, woken = Outlet(), []
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet, stored=lambda: woken.append(store.last_event))
        before, after = until(attacked, 15.0)
        live.cycle(before)
        assert [a["state"] for a, _ in outlet.events] == ["raised", "raised"]
        assert {a["id"] for a, _ in outlet.events} == {a.id for a in store.active(FEEDER)}
        assert woken
        live.cycle(after)
        assert [(a["state"], last) for a, last in outlet.events[2:]] == [("cleared", True)] * 2
        live.cycle([])
        assert store.outbox_pending() == []
        assert [e["t"] for e in outlet.estimates] == [START + k for k in range(len(outlet.estimates))]
        assert len(outlet.estimates) >= 39


@pytest.mark.canary("0.0")
@pytest.mark.parametrize("late_s", [0.0, 30.0])
def test_a_backlog_makes_no_tick_blind(site: Site, attacked: list[Sample], path: Path, late_s: float) -> None:
    """The service has fallen behind: of all that arrived each round takes a part, at a much later time."""
    wall = START - 0.5
    with Store(f"sqlite:///{path}") as store:
        config = RuntimeConfig(clock=Clock.WALL)
        # A clock at rest: no time budget skips ticks on a busy machine.
        live = Engine(config, store, [site], wall=lambda: wall, stored=lambda: None, clock=lambda: 0.0)
        live.committer.publisher = outlet = Outlet()
        live.monitors[FEEDER].install(design(site))
        live.begin()
        live.cycle([])
        for first in range(0, len(attacked), 100):
            rest = attacked[first + 100 :]
            wall = max(wall, attacked[first : first + 100][-1].arrival + late_s)
            oldest = {FEEDER: rest[0].arrival} if rest else {}
            live.cycle(attacked[first : first + 100], lambda oldest=oldest: oldest)
        assert live.monitors[FEEDER].aligner.restarts == 0
        heard = [e for e in outlet.estimates if e["t"] < START + 39]
        assert [e["t"] for e in heard] == [START + k for k in range(39)]
        assert all(meter["seen"] for e in heard for meter in e["meters"])
        told = [(alarm["state"], last) for alarm, last in outlet.events[:4]]
        assert told == [("raised", False)] * 2 + [("cleared", True)] * 2


def test_what_was_not_published_is_published_after_a_restart(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    with Store(f"sqlite:///{path}") as store:
        rounds(store, site, Outlet(confirms=False)).cycle(until(attacked, 15.0)[0])
        assert len(store.outbox_pending()) == 2
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        assert [a["state"] for a, _ in outlet.events] == ["raised", "raised"]
        assert len(outlet.answers) == 2
        live.cycle([])
        assert store.outbox_pending() == []
        # The alarms are known: the attack that goes on raises no new ones.
        live.cycle(until(attacked, 15.0)[1])
        assert len(store.alarms()[0]) == 2


def test_a_database_that_goes_away_and_comes_back_loses_nothing(
    site: Site,
    attacked: list[Sample],
    path: Path,
    locked: Callable[[], sqlite3.Connection],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.store.committer.RETRY_S", 0.0)
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        before, rest = until(attacked, 8.0)
        live.cycle(before)
        assert live.committer.problem is None
        other = locked()
        during, after = until(rest, 30.0)
        for k in range(0, len(during), 100):
            live.cycle(during[k : k + 100])
        assert live.committer.problem is not None
        assert "locked" in live.committer.problem
        assert outlet.events == []
        assert live.monitors[FEEDER].book.alarms
        assert outlet.estimates[-1]["t"] >= START + 28
        with pytest.raises(StoreUnavailable):
            live.acknowledge(live.monitors[FEEDER].book.alarms[0].id, "Ada", "").result()
        assert all(a.state is not AlarmState.ACKNOWLEDGED for a in live.monitors[FEEDER].book.alarms)
        other.close()
        live.cycle(after)
        assert live.committer.problem is None
        assert [a["state"] for a, _ in outlet.events] == ["raised"] * 2 + ["cleared"] * 2
        assert len(store.alarms()[0]) == 2
        stored = [e.t for e in store.events_after(0)]
        assert max(stored) - min(stored) > 8.0
        metrics = live.metrics.exposition().decode()
        assert "gridsec_store_failures_total 0.0" not in metrics
        assert "gridsec_transitions_unstored 0.0" in metrics


def test_nobody_who_watches_waits_for_a_locked_database(
    site: Site,
    attacked: list[Sample],
    path: Path,
    locked: Callable[[], sqlite3.Connection],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the wall clock, rounds go on while a write waits; commands wait for it, and nothing is lost."""
    monkeypatch.setattr(connect, "BUSY_S", 60.0)
    some = [sample for sample in attacked if START + 4 <= sample.arrival < START + 20]
    wall = START + 3.5

    async def scene(store: Store) -> None:
        nonlocal wall
        runtime = Runtime(RuntimeConfig(grace_s=0.0), store, [site], wall=lambda: wall)
        outlet = Outlet()
        runtime.attach(outlet)
        task = asyncio.create_task(runtime.run())
        while not runtime.ready()[0]:  # noqa: ASYNC110 - readiness is what is tested
            await asyncio.sleep(0.01)
        other = locked()
        for k in range(0, len(some), 28):
            wall = some[k : k + 28][-1].arrival
            runtime.deliver(some[k : k + 28])
            # Ticks of several batches in one round would exceed its time budget on a busy machine.
            while not outlet.estimates or outlet.estimates[-1]["t"] < int(wall):  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        assert len(outlet.estimates) >= 8
        # The first write is still waiting: it has not been given up either.
        monkeypatch.setattr("service.store.committer.SLOW_S", 0.01)
        assert "gridsec_store_failures_total 0.0" in runtime.metrics().decode()
        assert "under way" in runtime.ready()[1][0]
        assert runtime.healthy()[0]
        assert outlet.events == []
        assert store.alarms()[0] == []
        other.close()
        while len(store.alarms()[0]) < 2:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        name = store.alarms()[0][0].id
        assert (await runtime.acknowledge(name, "Ada", "")).acknowledged_by == "Ada"
        runtime.stop()
        await asyncio.wait_for(task, 20.0)
        assert [alarm["state"] for alarm, _ in outlet.events[:2]] == ["raised", "raised"]
        assert store.alarm(name).acknowledged_by == "Ada"  # type: ignore[union-attr]

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(asyncio.wait_for(scene(store), 120.0))


def test_the_delay_of_a_report_ends_when_it_is_stored(
    site: Site, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, wall = DesignedEstimator.step, START - 0.5
    writes: list[tuple[Callable[[], WriteResult], Callable[[WriteResult], None]]] = []

    def slow(self: DesignedEstimator, state: Any, frame: Frame) -> Any:
        nonlocal wall
        wall += 0.25
        return step(self, state, frame)

    with Store(f"sqlite:///{path}") as store:
        live = Engine(
            RuntimeConfig(),
            store,
            [site],
            wall=lambda: wall,
            stored=lambda: None,
            apart=lambda write, then: writes.append((write, then)),
        )
        live.monitors[FEEDER].install(design(site))
        live.begin()
        monkeypatch.setattr(DesignedEstimator, "step", slow)
        for begin in (START - 0.5, START + 0.5):
            wall = begin
            payload = json.dumps({"t": begin, "v_volt": 230.0}).encode()
            key = f"gridsec/{FEEDER}/meter/{site.meter_ids[0]}/reading"
            live.cycle([Sample(key, payload, "application/json", begin, len(payload))])
            assert "gridsec_report_delay_seconds_sum" not in live.metrics.exposition().decode()
            wall += 2.0
            while writes:
                write, then = writes.pop(0)
                then(write())
                live.committer.commit()
        told = f'gridsec_report_delay_seconds_sum{{feeder="{FEEDER}"}} 2.75'
        assert told in live.metrics.exposition().decode()


def test_an_outbox_of_any_length_is_published_in_order_also_after_a_failed_read(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.store.committer.OUTBOX_PAGE", 7)
    monkeypatch.setattr("service.store.committer.RETRY_S", 0.0)
    with Store(f"sqlite:///{path}") as store:
        rounds(store, site, Outlet(confirms=False)).cycle(until(attacked, 15.0)[0])
        first, second = store.active(FEEDER)
        for k in range(50):
            store.commit(
                [AlarmTransition(first, Change.RAISED, float(k)), AlarmTransition(second, Change.RAISED, 0.0)]
            )
        expected = [event.alarm.id for event in store.outbox_pending()]
        assert len(expected) == 102
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        with monkeypatch.context() as patch:
            patch.setattr(store, "outbox_pending", _refuse)
            live = rounds(store, site, outlet)
            live.cycle([])
            assert outlet.events == []
            assert "(database-unavailable)" in live.committer.problems()[0]
        # What is stored meanwhile is published after what has been waiting.
        live.cycle(until(attacked, 15.0)[1])
        for _ in range(20):
            live.cycle([])
        assert [alarm["id"] for alarm, _ in outlet.events][:102] == expected
        assert [alarm["state"] for alarm, _ in outlet.events][102:] == ["cleared", "cleared"]
        assert store.outbox_pending() == []


def _refuse(*_: object, **__: object) -> None:
    raise StoreUnavailable("no reading today")


def test_events_that_zenoh_does_not_take_wait_in_the_outbox(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.store.committer.UNPUBLISHED_KEPT", 1)
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        with monkeypatch.context() as patch:
            patch.setattr(outlet, "event", lambda *_, **__: False)
            live.cycle(until(attacked, 15.0)[0])
            live.cycle(until(attacked, 15.0)[1])
        for _ in range(3):
            live.cycle([])
        assert [alarm["state"] for alarm, _ in outlet.events] == ["raised"] * 2 + ["cleared"] * 2
        assert store.outbox_pending() == []


def test_a_deleted_feeder_leaves_cleared_alarms_and_its_history(
    site: Site,
    attacked: list[Sample],
    path: Path,
    locked: Callable[[], sqlite3.Connection],
) -> None:
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        store.commit(put=(FEEDER, {}))
        live.cycle(until(attacked, 15.0)[0])
        other = locked()
        with pytest.raises(StoreUnavailable):
            live.remove(FEEDER).result()
        assert FEEDER in live.monitors
        assert len(live.monitors[FEEDER].book.active) == 2
        other.close()
        live.committer.commit(at_once=True)
        live.remove(FEEDER).result()
        assert (live.monitors, store.feeders(), store.active(FEEDER)) == ({}, {}, [])
        alarms = store.alarms()[0]
        assert {alarm.state for alarm in alarms} == {AlarmState.CLEARED}
        assert store.events(alarms[0].id)[-1].comment == NOT_WATCHED
        assert [(a["state"], last) for a, last in outlet.events[2:]] == [("cleared", True)] * 2
        assert outlet.withdrawn == [FEEDER]
        assert store.history(FEEDER)
        assert "gridsec_alarms_active{" not in live.metrics.exposition().decode()
        live.cycle(until(attacked, 15.0)[1][:1])
        assert store.rejected()[0].reason.startswith("unknown-feeder")
        with pytest.raises(FeederUnknown):
            live.remove(FEEDER).result()


def test_alarms_of_a_feeder_that_was_left_out_are_cleared_at_the_start(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    with Store(f"sqlite:///{path}") as store:
        rounds(store, site, Outlet(confirms=False)).cycle(until(attacked, 15.0)[0])
        first, second = store.active(FEEDER)
        elsewhere = replace(first, id="0" * 26, feeder="elsewhere")
        store.outbox_done(store.commit([AlarmTransition(elsewhere, Change.RAISED, START)]))
        store.incidents_published([store.last_incident_event])
        store.commit(put=("elsewhere", {"tables": "of another version, which cannot be loaded"}))
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = Engine(RuntimeConfig(), store, [], wall=lambda: START + 60, stored=lambda: None)
        live.committer.publisher = outlet
        live.begin()
        alarms = {alarm.id: alarm for alarm in store.alarms()[0]}
        assert alarms.pop(elsewhere.id) == elsewhere
        assert alarms.keys() == {first.id, second.id}
        assert {(one.state, one.t_cleared) for one in alarms.values()} == {(AlarmState.CLEARED, START + 60)}
        assert store.events(first.id)[-1].comment == NOT_WATCHED
        live.cycle([])
        assert [one["state"] for one, _ in outlet.events] == ["raised"] * 2 + ["cleared"] * 2
    with Store(f"sqlite:///{path}") as store:
        number = store.last_event
        rounds(store, site)
        assert store.last_event == number


def test_another_feeder_leaves_the_decoders_of_the_others(site: Site, path: Path) -> None:
    meta = site.tables.meta
    other = from_tables(replace(site.tables, meta=replace(meta, name="other", voltage_volt=240.0)))
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        before = live._wire.known[FEEDER]
        live.add(other)
        assert live._wire.known.keys() == {FEEDER, "other"}
        assert live._wire.known[FEEDER] is before
        assert live._wire.known["other"].nominal_volt == 240.0
        live.resign(["other"]).result()
        assert live._wire.known == {FEEDER: before}


def test_of_two_alarms_that_tell_the_same_none_stands_for_ever(site: Site, path: Path) -> None:
    """Another version left them so: one is in the feeder's book; the other goes, or both with the feeder."""
    one = an_alarm(feeder=FEEDER, meter="m01")
    both = (one, replace(one, id="Z" * 26), replace(one, id="1" * 26, t_raised=one.t_raised + 1))

    def after(name: str, run: Callable[[Store], None]) -> list[str]:
        with Store(f"sqlite:///{path}-{name}") as store:
            store.commit([AlarmTransition(each, Change.RAISED, START) for each in both])
            run(store)
            return [each.id for each in store.active()]

    def watched(store: Store) -> None:
        rounds(store, site)

    def unloaded(store: Store) -> None:
        why = {FEEDER: "of another version"}
        live = Engine(RuntimeConfig(), store, [], wall=lambda: START, stored=lambda: None, unloaded=why)
        live.remove(FEEDER).result()

    def left_out(store: Store) -> None:
        Engine(RuntimeConfig(), store, [], wall=lambda: START, stored=lambda: None).begin()

    assert after("watched", watched) == ["1" * 26]
    assert after("unloaded", unloaded) == after("left-out", left_out) == []


def test_what_cleared_lately_is_remembered_by_the_readings_clock(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    """However long ago that is for the wall clock."""
    with Store(f"sqlite:///{path}") as store:
        rounds(store, site).cycle(attacked)
        before = store.alarms()[0]
        config = RuntimeConfig(clock=Clock.EVENTS)
        live = Engine(config, store, [site], wall=lambda: START + 1e8, stored=lambda: None)
        assert {alarm.state for alarm in before} == {AlarmState.CLEARED}
        assert sorted(live.monitors[FEEDER].book.alarms, key=lambda alarm: alarm.id) == before[::-1]


def test_an_idle_service_notices_that_the_database_is_back(
    site: Site,
    attacked: list[Sample],
    path: Path,
    locked: Callable[[], sqlite3.Connection],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.store.committer.RETRY_S", 0.0)
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        other = locked()
        live.cycle(until(attacked, 5.0)[0])
        live.cycle([])
        assert live.committer.problem is not None
        other.close()
        live.cycle([])
        assert live.committer.problem is None


def test_acknowledgements(site: Site, attacked: list[Sample], path: Path) -> None:
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        live.cycle(until(attacked, 15.0)[0])
        first, second = (a.id for a in store.active(FEEDER))
        assert live.acknowledge(first, "Ada", "on my way").result().acknowledged_by == "Ada"
        with pytest.raises(AlreadyAcknowledged):
            live.acknowledge(first, "Bob", "").result()
        with pytest.raises(RaisedAgain):
            live.acknowledge(second, "Bob", "", count=2).result()
        with pytest.raises(AlarmUnknown):
            live.acknowledge("0" * 26, "Ada", "").result()
        live.cycle(until(attacked, 15.0)[1])
    with Store(f"sqlite:///{path}") as store:
        # The feeder is not watched any more: the store alone knows its alarm.
        live = Engine(RuntimeConfig(), store, [], wall=lambda: START + 100, stored=lambda: None)
        live.committer.publisher = outlet
        live.begin()
        known = store.alarm(second)
        assert known is not None
        assert known.state is AlarmState.CLEARED
        with pytest.raises(RaisedAgain):
            live.acknowledge(second, "Bob", "", count=2).result()
        assert live.acknowledge(second, "Bob", "", count=1).result().acknowledged_by == "Bob"
        assert outlet.events[-1][0]["acknowledged_by"] == "Bob"


def test_an_old_report_is_told_to_be_old(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A round hangs for a minute of the service's clock: the last report stays, and says how old it is."""
    wall, hangs_now, goes_on = START + 3.5, threading.Event(), threading.Event()
    reach = FeederMonitor.reach
    some = [sample for sample in attacked if START + 4 <= sample.arrival < START + 6]

    def hangs(self: FeederMonitor, now: float) -> Any:
        hangs_now.set()
        goes_on.wait(60.0)
        return reach(self, now)

    async def scene(store: Store) -> None:
        nonlocal wall
        runtime = Runtime(RuntimeConfig(), store, [site], wall=lambda: wall)
        task = asyncio.create_task(runtime.run())
        runtime.deliver(some)
        wall = START + 6.0
        while runtime.report(FEEDER) is None or not runtime.ready()[0]:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        monkeypatch.setattr(FeederMonitor, "reach", hangs)
        wall += 1.0
        await asyncio.to_thread(hangs_now.wait, 20.0)
        report = runtime.report(FEEDER)
        assert report is not None
        assert runtime.age(report) < 5.0
        wall += 60.0
        assert runtime.age(report) > 60.0
        assert runtime.ready()[1] == [f"feeder {FEEDER}: the latest report is {wall - report.t:.0f} s old"]
        goes_on.set()
        while not runtime.ready()[0]:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        runtime.stop()
        await asyncio.wait_for(task, 20.0)

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(scene(store))


def test_the_task_ends_cleanly_and_refuses_commands_afterwards(site: Site, path: Path) -> None:
    async def scene(store: Store) -> None:
        runtime = Runtime(RuntimeConfig(clock=Clock.EVENTS), store, [site])
        assert not runtime.ready()[0]
        task = asyncio.create_task(runtime.run())
        while not runtime.ready()[0]:  # noqa: ASYNC110 - readiness is what is tested
            await asyncio.sleep(0.01)
        assert runtime.healthy() == (True, [])
        wakes = runtime.subscribe()
        waiting = asyncio.ensure_future(anext(wakes, None))
        await asyncio.sleep(0)
        with pytest.raises(AlarmUnknown):
            await runtime.acknowledge("0" * 26, "Ada", "")
        runtime.stop()
        assert await waiting is None
        await asyncio.wait_for(task, 20.0)
        with refused(StoreUnavailable, "stopping"):
            await runtime.acknowledge("0" * 26, "Ada", "")

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(scene(store))
