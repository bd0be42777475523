"""Rounds that meet floods and defects: what they cost, and what goes on."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import Site, load
from feeders.registry import DesignedEstimator
from gridsec.interface import Cause, Frame
from service.alarms.state_machine import AlarmKind, Condition, conditions
from service.engine.engine import BAD_PER_ROUND, BAD_PER_SOURCE, Engine, RuntimeConfig
from service.engine.feeder_monitor import Phase, design
from service.engine.runtime import Runtime
from service.ingest.align import Clock
from service.ingest.decode import DecodedPayload, Wire
from service.ingest.queues import Sample
from service.report.report import FeederReport
from service.store import Store
from tests.service.liars import FEEDER, START, rounds, until
from tests.service.running import Outlet


@pytest.mark.acceptance
def test_a_write_that_fails_in_an_unforeseen_way_is_shown_and_tried_again(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("service.store.committer.RETRY_S", 0.0)
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site)
        with monkeypatch.context() as patch:
            patch.setattr(store, "commit", broken)
            live.cycle(until(attacked, 15.0)[0])
            assert "(defect)" in live.committer.problems()[0]
            assert "2 changes of alarms wait" in live.committer.problems()[1]
        live.cycle([])
        assert live.committer.problems() == []
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
            patch.setattr("service.store.committer._write", broken)
            task = asyncio.create_task(runtime.run())
            while not any("(defect)" in problem for problem in runtime.ready()[1]):  # noqa: ASYNC110
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

    def broken(self: Wire, key: str, payload: bytes, *more: Any, **named: Any) -> DecodedPayload:
        if b"boom" in payload:
            raise ZeroDivisionError("a def\x00ect")
        return decode(self, key, payload, *more, **named)

    monkeypatch.setattr(Wire, "decode", broken)
    bad = Sample(f"gridsec/{FEEDER}/meter/m01/reading", b'{"boom": 1}\x00', "", START, 1)
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        before, after = until(attacked, 5.0)
        live.cycle([*before, bad, *after])
        assert outlet.estimates[-1]["t"] >= START + 38
        (kept,) = store.rejected()
        assert (kept.key, kept.reason) == (bad.key, "internal: ZeroDivisionError: a def\\x00ect")
        assert b"boom" in kept.payload
        assert 'gridsec_bad_readings_total{feeder="",reason="internal"} 1.0' in (
            live.metrics.exposition().decode()
        )


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
        live.cycle(flood + quiet)
        kept = Counter(one.key.split("/")[3] for one in store.rejected(1000))
        assert kept == {"m01": BAD_PER_SOURCE + 1, "m02": 1, "m03": 1}
        assert "syntax: 395 more on this key at the same time" in {r.reason for r in store.rejected(1000)}
        live.cycle(others + flood + quiet)
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
        live.cycle(before)
        with monkeypatch.context() as patch:
            patch.setattr(DesignedEstimator, "step", broken)
            live.cycle(after[:100])
        live.cycle(after[100:])
        monitor = live.monitors[FEEDER]
        assert monitor.phase is Phase.FAILED
        assert "a defect" in monitor.problem
        assert other.phase is Phase.WATCHING
        assert outlet.estimates[-1]["cause"] == "design-invalid"
        assert outlet.estimates[-1]["verdict"] == "undecided"


@pytest.mark.acceptance
def test_what_was_found_before_a_defect_is_not_lost(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All ticks go at once, and the monitor breaks at one of them, while two lie."""
    step, wall = DesignedEstimator.step, START - 0.5

    def breaks(self: DesignedEstimator, state: Any, frame: Frame) -> Any:
        if frame.t >= START + 17:
            raise ZeroDivisionError("a defect")
        return step(self, state, frame)

    monkeypatch.setattr(DesignedEstimator, "step", breaks)
    with Store(f"sqlite:///{path}") as store:
        live = Engine(
            RuntimeConfig(clock=Clock.WALL),
            store,
            [site],
            wall=lambda: wall,
            stored=lambda: None,
            clock=lambda: 0.0,
        )
        live.committer.publisher = outlet = Outlet()
        live.monitors[FEEDER].install(design(site))
        live.begin()
        live.cycle([sample._replace(arrival=wall) for sample in attacked])
        assert not outlet.estimates
        wall = START + 30.5
        live.cycle([])
        assert live.monitors[FEEDER].phase is Phase.FAILED
        kinds = [alarm.kind for alarm in store.active(FEEDER)]
        assert kinds.count(AlarmKind.METER_MANIPULATED) == 2
        assert [e["t"] for e in outlet.estimates] == [START + k for k in range(31)]
        assert {e["cause"] for e in outlet.estimates[17:]} == {"design-invalid"}
        assert "a defect" in live.monitors[FEEDER].problem


@pytest.mark.canary("False")
@pytest.mark.parametrize("for_ever", [True, False])
def test_alarms_of_before_a_defect_in_the_alarms_reach_the_database(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch, for_ever: bool
) -> None:
    """All ticks go at once, and what makes alarms of them breaks at one or from one on."""

    def breaks(now: FeederReport, **given: Any) -> list[Condition]:
        if now.t >= START + 17 and (for_ever or now.cause is not Cause.DESIGN_INVALID):
            raise ZeroDivisionError("a defect")
        return conditions(now, **given)

    monkeypatch.setattr("service.engine.feeder_monitor.conditions", breaks)
    wall = START - 0.5
    with Store(f"sqlite:///{path}") as store:
        live = Engine(
            RuntimeConfig(clock=Clock.WALL),
            store,
            [site],
            wall=lambda: wall,
            stored=lambda: None,
            clock=lambda: 0.0,
        )
        live.committer.publisher = outlet = Outlet()
        live.monitors[FEEDER].install(design(site))
        live.begin()
        live.cycle([sample._replace(arrival=wall) for sample in attacked])
        wall = START + 30.5
        live.cycle([])
        monitor = live.monitors[FEEDER]
        assert "a defect" in monitor.problem
        assert set(monitor.book.active) == set(store.active(FEEDER))
        kinds = [alarm.kind for alarm in monitor.book.active]
        assert kinds.count(AlarmKind.METER_MANIPULATED) == 2
        assert kinds.count(AlarmKind.UNDECIDED) == (not for_ever)
        assert [e["t"] for e in outlet.estimates] == [START + k for k in range(31)]
        assert {e["cause"] for e in outlet.estimates[17:]} == {"design-invalid"}


def test_a_dead_task_is_not_healthy(site: Site, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    async def scene(store: Store) -> None:
        runtime = Runtime(RuntimeConfig(), store, [site])
        monkeypatch.setattr(Engine, "cycle", broken)
        with pytest.raises(ZeroDivisionError):
            await asyncio.wait_for(runtime.run(), 20.0)
        alive, problems = runtime.healthy()
        assert not alive
        assert "a defect" in problems[0]

    with Store(f"sqlite:///{path}") as store:
        asyncio.run(scene(store))
