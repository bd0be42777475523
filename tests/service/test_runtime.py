"""Rounds over a real database: what is stored, what is kept when it cannot be, and what is published."""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from feeders.estimators import Watcher
from feeders.load import Site, load
from feeders.scenario import Scenario, by_arrival, random_attacks, simulate
from gridsec.online import Cause, Frame
from service.alarms import (
    AlarmKind,
    AlarmState,
    AlarmUnknown,
    AlreadyAcknowledged,
    Change,
    Condition,
    Transition,
    conditions,
)
from service.align import Clock
from service.bus import Sample
from service.crowd import BAD_PER_ROUND, BAD_PER_SOURCE
from service.errors import FeederUnknown
from service.keeper import Done
from service.report import FeederReport
from service.rounds import NOT_WATCHED, Rounds, RuntimeConfig
from service.runtime import Runtime
from service.simulate import key_of, payload_of
from service.store import Store, StoreUnavailable, connect
from service.watch import Phase, design
from service.wire import Decoded, Wire
from tests.service.running import Outlet

FEEDER = "simbench-lv-rural1"
START = 1_795_212_000.0


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


@pytest.fixture(scope="module")
def attacked(site: Site) -> list[Sample]:
    """Forty seconds with two liars from the tenth to the twentieth."""
    attacks = random_attacks(site, 2, "bias", 2, 0.03, t_on=START + 10, t_off=START + 20)
    scenario = Scenario(seed=1, start=START, duration_s=40.0, attacks=attacks)
    return [
        Sample(f"gridsec/{key_of(FEEDER, r.meter)}", payload_of(r), "", r.arrival, 1)
        for r in by_arrival(simulate(site, scenario))
    ]


def rounds(
    store: Store, site: Site, outlet: Outlet | None = None, stored: Callable[[], None] = lambda: None
) -> Rounds:
    made = Rounds(RuntimeConfig(clock=Clock.EVENTS), store, [site], wall=lambda: START, stored=stored)
    made.keeper.publisher = outlet
    made.watches[FEEDER].install(design(site))
    made.begin()
    return made


def until(samples: list[Sample], t: float) -> tuple[list[Sample], list[Sample]]:
    return [s for s in samples if s.arrival < START + t], [s for s in samples if s.arrival >= START + t]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "gridsec.db"


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
        live.round(before)
        assert [a["state"] for a, _ in outlet.events] == ["raised", "raised"]
        assert {a["id"] for a, _ in outlet.events} == {a.id for a in store.active(FEEDER)}
        assert woken
        live.round(after)
        assert [(a["state"], last) for a, last in outlet.events[2:]] == [("cleared", True)] * 2
        live.round([])
        assert store.outbox_pending() == []
        assert [e["t"] for e in outlet.estimates] == [START + k for k in range(len(outlet.estimates))]
        assert len(outlet.estimates) >= 39


@pytest.mark.parametrize("late_s", [0.0, 30.0])
def test_a_backlog_makes_no_tick_blind(site: Site, attacked: list[Sample], path: Path, late_s: float) -> None:
    """The service has fallen behind: of all that arrived each round takes a part, at a much later time."""
    wall = START - 0.5
    with Store(f"sqlite:///{path}") as store:
        live = Rounds(RuntimeConfig(clock=Clock.WALL), store, [site], wall=lambda: wall, stored=lambda: None)
        live.keeper.publisher = outlet = Outlet()
        live.watches[FEEDER].install(design(site))
        live.begin()
        live.round([])
        for first in range(0, len(attacked), 100):
            rest = attacked[first + 100 :]
            wall = max(wall, attacked[first : first + 100][-1].arrival + late_s)
            oldest = rest[0].arrival if rest else None
            live.round(attacked[first : first + 100], lambda oldest=oldest: oldest)
        assert live.watches[FEEDER].aligner.restarts == 0
        heard = [e for e in outlet.estimates if e["t"] < START + 39]
        assert [e["t"] for e in heard] == [START + k for k in range(39)]
        assert all(meter["seen"] for e in heard for meter in e["meters"])
        told = [(alarm["state"], last) for alarm, last in outlet.events[:4]]
        assert told == [("raised", False)] * 2 + [("cleared", True)] * 2


def test_what_was_not_published_is_published_after_a_restart(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    with Store(f"sqlite:///{path}") as store:
        rounds(store, site, Outlet(confirms=False)).round(until(attacked, 15.0)[0])
        assert len(store.outbox_pending()) == 2
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        assert [a["state"] for a, _ in outlet.events] == ["raised", "raised"]
        assert len(outlet.answers) == 2
        live.round([])
        assert store.outbox_pending() == []
        # The alarms are known: the attack that goes on raises no new ones.
        live.round(until(attacked, 15.0)[1])
        assert len(store.alarms()[0]) == 2


def test_a_database_that_goes_away_and_comes_back_loses_nothing(
    site: Site,
    attacked: list[Sample],
    path: Path,
    locked: Callable[[], sqlite3.Connection],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.keeper.RETRY_S", 0.0)
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        before, rest = until(attacked, 8.0)
        live.round(before)
        assert live.keeper.problem is None
        other = locked()
        during, after = until(rest, 30.0)
        for k in range(0, len(during), 100):
            live.round(during[k : k + 100])
        assert live.keeper.problem is not None
        assert "locked" in live.keeper.problem
        assert outlet.events == []
        assert live.watches[FEEDER].book.alarms
        assert outlet.estimates[-1]["t"] >= START + 28
        with pytest.raises(StoreUnavailable):
            live.acknowledge(live.watches[FEEDER].book.alarms[0].id, "Ada", "")
        assert all(a.state is not AlarmState.ACKNOWLEDGED for a in live.watches[FEEDER].book.alarms)
        other.close()
        live.round(after)
        assert live.keeper.problem is None
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
    monkeypatch.setattr(connect, "BUSY_S", 3.0)
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
        begin = time.monotonic()
        for k in range(0, len(some), 28):
            wall = some[k : k + 28][-1].arrival
            runtime.deliver(some[k : k + 28])
            await asyncio.sleep(0.02)
        while len(outlet.estimates) < 8:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        assert time.monotonic() - begin < 2.0
        monkeypatch.setattr("service.keeper.SLOW_S", 0.01)
        assert "under way" in runtime.ready()[1][0]
        assert runtime.healthy()[0]
        assert outlet.events == []
        assert store.alarms()[0] == []
        other.close()
        while len(store.alarms()[0]) < 2:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        name = store.alarms()[0][0].id
        assert (await runtime.acknowledge(name, "Ada", ""))["acknowledged_by"] == "Ada"
        runtime.stop()
        await asyncio.wait_for(task, 5.0)
        assert [alarm["state"] for alarm, _ in outlet.events[:2]] == ["raised", "raised"]
        assert store.alarm(name).acknowledged_by == "Ada"  # type: ignore[union-attr]

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(asyncio.wait_for(scene(store), 20.0))


def test_the_delay_of_a_report_ends_when_it_is_stored(
    site: Site, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, wall = Watcher.step, START - 0.5
    writes: list[tuple[Callable[[], Done], Callable[[Done], None]]] = []

    def slow(self: Watcher, state: Any, frame: Frame) -> Any:
        nonlocal wall
        wall += 0.25
        return step(self, state, frame)

    with Store(f"sqlite:///{path}") as store:
        live = Rounds(
            RuntimeConfig(),
            store,
            [site],
            wall=lambda: wall,
            stored=lambda: None,
            apart=lambda write, then: writes.append((write, then)),
        )
        live.watches[FEEDER].install(design(site))
        live.begin()
        monkeypatch.setattr(Watcher, "step", slow)
        for begin in (START - 0.5, START + 0.5):
            wall = begin
            live.round([])
            assert "gridsec_report_delay_seconds_sum" not in live.metrics.exposition().decode()
            wall += 2.0
            while writes:
                write, then = writes.pop(0)
                then(write())
                live.keeper.commit()
        told = f'gridsec_report_delay_seconds_sum{{feeder="{FEEDER}"}} 2.75'
        assert told in live.metrics.exposition().decode()


def test_a_write_that_fails_in_an_unforeseen_way_is_shown_and_tried_again(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("service.keeper.RETRY_S", 0.0)
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        with monkeypatch.context() as patch:
            patch.setattr(store, "commit", broken)
            live.round(until(attacked, 15.0)[0])
            assert "a defect" in live.keeper.problems()[0]
            assert "2 changes of alarms wait" in live.keeper.problems()[1]
        live.round([])
        assert live.keeper.problems() == []
        assert len(store.alarms()[0]) == 2


def test_a_write_without_an_outcome_is_a_failed_one(
    site: Site, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where writing fails beyond what it was written for: nothing would ever be stored again."""

    def broken(*_: object) -> None:
        raise BrokenPipeError("a defect")

    async def scene(store: Store) -> None:
        runtime = Runtime(RuntimeConfig(), store, [site])
        with monkeypatch.context() as patch:
            patch.setattr("service.keeper._write", broken)
            task = asyncio.create_task(runtime.run())
            while not any("a defect" in problem for problem in runtime.ready()[1]):  # noqa: ASYNC110
                await asyncio.sleep(0.02)
        while not runtime.ready()[0]:  # noqa: ASYNC110 - readiness is what is tested
            await asyncio.sleep(0.02)
        runtime.stop()
        await task

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(asyncio.wait_for(scene(store), 20.0))


def test_a_defect_of_the_decoder_costs_one_payload(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decode = Wire.decode

    def broken(self: Wire, key: str, payload: bytes, *more: Any, **named: Any) -> Decoded:
        if b"boom" in payload:
            raise ZeroDivisionError("a def\x00ect")
        return decode(self, key, payload, *more, **named)

    monkeypatch.setattr(Wire, "decode", broken)
    bad = Sample(f"gridsec/{FEEDER}/meter/m01/reading", b'{"boom": 1}\x00', "", START, 1)
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        before, after = until(attacked, 5.0)
        live.round([*before, bad, *after])
        assert outlet.estimates[-1]["t"] >= START + 38
        (kept,) = store.rejected()
        assert (kept.key, kept.reason) == (bad.key, "internal: ZeroDivisionError: a def\\x00ect")
        assert b"boom" in kept.payload
        assert 'gridsec_bad_readings_total{feeder="",reason="internal"} 1.0' in (
            live.metrics.exposition().decode()
        )


def test_an_outbox_of_any_length_is_published_in_order_also_after_a_failed_read(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.keeper.OUTBOX_PAGE", 7)
    monkeypatch.setattr("service.keeper.RETRY_S", 0.0)
    with Store(f"sqlite:///{path}") as store:
        rounds(store, site, Outlet(confirms=False)).round(until(attacked, 15.0)[0])
        first, second = store.active(FEEDER)
        for k in range(50):
            store.commit([Transition(first, Change.RAISED, float(k)), Transition(second, Change.RAISED, 0.0)])
        expected = [event.alarm.id for event in store.outbox_pending()]
        assert len(expected) == 102
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        with monkeypatch.context() as patch:
            patch.setattr(store, "outbox_pending", _refuse)
            live = rounds(store, site, outlet)
            live.round([])
            assert outlet.events == []
            assert "reading" in live.keeper.problems()[0]
        # What is stored meanwhile is published after what has been waiting.
        live.round(until(attacked, 15.0)[1])
        for _ in range(20):
            live.round([])
        assert [alarm["id"] for alarm, _ in outlet.events][:102] == expected
        assert [alarm["state"] for alarm, _ in outlet.events][102:] == ["cleared", "cleared"]
        assert store.outbox_pending() == []


def _refuse(*_: object, **__: object) -> None:
    raise StoreUnavailable("no reading today")


def test_events_that_zenoh_does_not_take_wait_in_the_outbox(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.keeper.UNPUBLISHED_KEPT", 1)
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        with monkeypatch.context() as patch:
            patch.setattr(outlet, "event", lambda *_, **__: False)
            live.round(until(attacked, 15.0)[0])
            live.round(until(attacked, 15.0)[1])
        for _ in range(3):
            live.round([])
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
        store.put_feeder(FEEDER, {})
        live.round(until(attacked, 15.0)[0])
        other = locked()
        with pytest.raises(StoreUnavailable):
            live.remove(FEEDER)
        assert FEEDER in live.watches
        assert len(live.watches[FEEDER].book.active) == 2
        other.close()
        live.keeper.commit(at_once=True)
        live.remove(FEEDER)
        assert (live.watches, store.feeders(), store.active(FEEDER)) == ({}, {}, [])
        alarms = store.alarms()[0]
        assert {alarm.state for alarm in alarms} == {AlarmState.CLEARED}
        assert store.events(alarms[0].id)[-1].comment == NOT_WATCHED
        assert [(a["state"], last) for a, last in outlet.events[2:]] == [("cleared", True)] * 2
        assert outlet.withdrawn == [f"{FEEDER}/estimate"]
        assert store.history(FEEDER)
        assert "gridsec_alarms_active{" not in live.metrics.exposition().decode()
        live.round(until(attacked, 15.0)[1][:1])
        assert store.rejected()[0].reason.startswith("unknown-feeder")
        with pytest.raises(FeederUnknown):
            live.remove(FEEDER)


def test_alarms_of_a_feeder_that_was_left_out_are_cleared_at_the_start(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    with Store(f"sqlite:///{path}") as store:
        rounds(store, site, Outlet(confirms=False)).round(until(attacked, 15.0)[0])
        first, second = store.active(FEEDER)
        elsewhere = replace(first, id="0" * 26, feeder="elsewhere")
        store.outbox_done(store.commit([Transition(elsewhere, Change.RAISED, START)]))
        store.put_feeder("elsewhere", {"tables": "of another version, which cannot be loaded"})
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = Rounds(RuntimeConfig(), store, [], wall=lambda: START + 60, stored=lambda: None)
        live.keeper.publisher = outlet
        live.begin()
        alarms = {alarm.id: alarm for alarm in store.alarms()[0]}
        assert alarms.pop(elsewhere.id) == elsewhere
        assert alarms.keys() == {first.id, second.id}
        assert {(one.state, one.t_cleared) for one in alarms.values()} == {(AlarmState.CLEARED, START + 60)}
        assert store.events(first.id)[-1].comment == NOT_WATCHED
        live.round([])
        assert [one["state"] for one, _ in outlet.events] == ["raised"] * 2 + ["cleared"] * 2
    with Store(f"sqlite:///{path}") as store:
        number = store.last_event
        rounds(store, site)
        assert store.last_event == number


def test_an_idle_service_notices_that_the_database_is_back(
    site: Site,
    attacked: list[Sample],
    path: Path,
    locked: Callable[[], sqlite3.Connection],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.keeper.RETRY_S", 0.0)
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        other = locked()
        live.round(until(attacked, 5.0)[0])
        live.round([])
        assert live.keeper.problem is not None
        other.close()
        live.round([])
        assert live.keeper.problem is None


def test_acknowledgements(site: Site, attacked: list[Sample], path: Path) -> None:
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        live.round(until(attacked, 15.0)[0])
        first, second = (a.id for a in store.active(FEEDER))
        assert live.acknowledge(first, "Ada", "on my way")["acknowledged_by"] == "Ada"
        with pytest.raises(AlreadyAcknowledged):
            live.acknowledge(first, "Bob", "")
        with pytest.raises(AlarmUnknown):
            live.acknowledge("0" * 26, "Ada", "")
        live.round(until(attacked, 15.0)[1])
    with Store(f"sqlite:///{path}") as store:
        # The feeder is not watched any more: the store alone knows its alarm.
        live = Rounds(RuntimeConfig(), store, [], wall=lambda: START + 100, stored=lambda: None)
        live.keeper.publisher = outlet
        live.begin()
        known = store.alarm(second)
        assert known is not None
        assert known.state is AlarmState.CLEARED
        assert live.acknowledge(second, "Bob", "")["acknowledged_by"] == "Bob"
        assert outlet.events[-1][0]["acknowledged_by"] == "Bob"


def test_a_flood_of_bad_readings_is_counted_in_full_and_leaves_room_for_others(
    site: Site, path: Path
) -> None:
    def bad(key: str, payload: bytes, count: int = 1) -> list[Sample]:
        return [Sample(f"gridsec/{key}", payload, "", START, len(payload))] * count

    flood = bad(f"{FEEDER}/meter/m01/reading", b"{", 400)
    quiet = bad(f"{FEEDER}/meter/m02/reading", b"{}") + bad(f"{FEEDER}/meter/m03/reading", b"{")
    others = [one for k in range(200) for one in bad(f"nowhere-{k}/substation/reading", b"{}")]
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        live.round(flood + quiet)
        kept = Counter(one.key.split("/")[3] for one in store.rejected(1000))
        assert kept == {"m01": BAD_PER_SOURCE + 1, "m02": 1, "m03": 1}
        assert "syntax: 395 more on this key at the same time" in {r.reason for r in store.rejected(1000)}
        live.round(others + flood + quiet)
        kept = Counter(one.key.split("/")[1] for one in store.rejected(1000)[:BAD_PER_ROUND])
        assert kept == {FEEDER: 8} | dict.fromkeys([f"nowhere-{k}" for k in range(BAD_PER_ROUND - 8)], 1)
        told = live.metrics.exposition().decode()
        assert f'gridsec_bad_readings_total{{feeder="{FEEDER}",reason="syntax"}} 802.0' in told
        assert 'gridsec_records_forgotten_total{what="bad-reading"} 158.0' in told


def test_a_defect_in_one_feeder_s_monitor_is_shown_and_blinds_no_other(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        other = live.add(load("kerber-landnetz"))
        other.install(design(other.site))
        before, after = until(attacked, 5.0)
        live.round(before)
        with monkeypatch.context() as patch:
            patch.setattr(Watcher, "step", broken)
            live.round(after[:100])
        live.round(after[100:])
        watch = live.watches[FEEDER]
        assert watch.phase is Phase.FAILED
        assert "a defect" in watch.problem
        assert other.phase is Phase.WATCHING
        assert outlet.estimates[-1]["cause"] == "design-invalid"
        assert outlet.estimates[-1]["verdict"] == "undecided"


def test_what_was_found_before_a_defect_is_not_lost(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All ticks go at once, and the monitor breaks at one of them, while two lie."""
    step, wall = Watcher.step, START - 0.5

    def breaks(self: Watcher, state: Any, frame: Frame) -> Any:
        if frame.t >= START + 17:
            raise ZeroDivisionError("a defect")
        return step(self, state, frame)

    monkeypatch.setattr(Watcher, "step", breaks)
    with Store(f"sqlite:///{path}") as store:
        live = Rounds(RuntimeConfig(clock=Clock.WALL), store, [site], wall=lambda: wall, stored=lambda: None)
        live.keeper.publisher = outlet = Outlet()
        live.watches[FEEDER].install(design(site))
        live.begin()
        live.round([replace(sample, arrival=wall) for sample in attacked])
        assert not outlet.estimates
        wall = START + 30.5
        live.round([])
        assert live.watches[FEEDER].phase is Phase.FAILED
        kinds = [alarm.kind for alarm in store.active(FEEDER)]
        assert kinds.count(AlarmKind.METER_MANIPULATED) == 2
        assert [e["t"] for e in outlet.estimates] == [START + k for k in range(31)]
        assert {e["cause"] for e in outlet.estimates[17:]} == {"design-invalid"}
        assert "a defect" in live.watches[FEEDER].problem


@pytest.mark.parametrize("for_ever", [True, False])
def test_alarms_of_before_a_defect_in_the_alarms_reach_the_database(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch, for_ever: bool
) -> None:
    """All ticks go at once, and what makes alarms of them breaks at one or from one on."""

    def breaks(now: FeederReport) -> list[Condition]:
        if now.t >= START + 17 and (for_ever or now.cause is not Cause.DESIGN_INVALID):
            raise ZeroDivisionError("a defect")
        return conditions(now)

    monkeypatch.setattr("service.watch.conditions", breaks)
    wall = START - 0.5
    with Store(f"sqlite:///{path}") as store:
        live = Rounds(RuntimeConfig(clock=Clock.WALL), store, [site], wall=lambda: wall, stored=lambda: None)
        live.keeper.publisher = outlet = Outlet()
        live.watches[FEEDER].install(design(site))
        live.begin()
        live.round([replace(sample, arrival=wall) for sample in attacked])
        wall = START + 30.5
        live.round([])
        watch = live.watches[FEEDER]
        assert "a defect" in watch.problem
        assert set(watch.book.active) == set(store.active(FEEDER))
        kinds = [alarm.kind for alarm in watch.book.active]
        assert kinds.count(AlarmKind.METER_MANIPULATED) == 2
        assert kinds.count(AlarmKind.UNDECIDED) == (not for_ever)
        assert [e["t"] for e in outlet.estimates] == [START + k for k in range(31)]
        assert {e["cause"] for e in outlet.estimates[17:]} == {"design-invalid"}


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
        await asyncio.wait_for(task, 2.0)
        with pytest.raises(StoreUnavailable, match="stopping"):
            await runtime.acknowledge("0" * 26, "Ada", "")

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(scene(store))


def test_a_dead_task_is_not_healthy(site: Site, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    async def scene(store: Store) -> None:
        runtime = Runtime(RuntimeConfig(), store, [site])
        monkeypatch.setattr(Rounds, "round", broken)
        with pytest.raises(ZeroDivisionError):
            await asyncio.wait_for(runtime.run(), 5.0)
        alive, problems = runtime.healthy()
        assert not alive
        assert "a defect" in problems[0]

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(scene(store))
