"""Values without a voltage reading: marked as model only, judged by nothing, and no ground for an alarm."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load, to_frame
from feeders.registry import choose
from feeders.simulation.plant import BUSBAR as BUSBAR_SOURCE
from gridsec.interface import Cause, Decision
from service.alarms.conditions import AlarmKind, conditions
from service.api.models import HistoryPoint
from service.engine.feeder_monitor import design
from service.ingest.align import Tick
from service.ingest.reading import Reading
from service.report.report import BUSBAR, FeederReport, blind, build, snapshot, to_json
from service.store import Store
from tests.service.engine.test_silence import QUIET_VOLT, START, Street
from tests.service.running import FEEDER, service, until
from tests.service.ticks import tick_of

EUROPEAN = "ieee-european-lv"
LISTS = ("meters", "customers", "inverters", "buses")
SILENT_S = 12
"""Longer than `silence_s` of the feeder."""


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


def every(_second: int, _meter: str) -> tuple[float, float]:
    return 0.0, QUIET_VOLT


def silence(_second: int, _meter: str) -> None:
    return None


def busbar_alone(_second: int, meter: str) -> tuple[float, float] | None:
    return (0.0, QUIET_VOLT) if meter == BUSBAR_SOURCE else None


def one_meter(_second: int, meter: str) -> tuple[float, float] | None:
    return (0.0, QUIET_VOLT) if meter == "m05" else None


def marked(report: FeederReport | None) -> set[bool]:
    """Return every marker of a report, the feeder's included."""
    assert report is not None
    state = to_json(report)
    entries = [entry for name in LISTS for entry in state[name]]
    return {entry["model_only"] for entry in [*entries, state["busbar"], state]}


def tight(site: Site, v_max_pu: float) -> Site:
    """The same feeder with another upper limit."""
    meta = site.tables.meta
    limits = replace(meta.limits, v_max_pu=v_max_pu)
    return from_tables(replace(site.tables, meta=replace(meta, limits=limits)))


# ------------------------------------------------------------------------------------------------ one feeder


@pytest.mark.parametrize(
    ("estimator", "judges", "uses_one"),
    [
        ("modal", True, True),
        ("weighted-least-squares", True, True),
        ("set-search", False, True),
        # No observer of this bank runs on one meter.
        ("exact-bank", False, False),
    ],
)
def test_without_any_reading_each_value_is_model_only(
    site: Site, tmp_path: Path, estimator: str, *, judges: bool, uses_one: bool
) -> None:
    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(choose(site, estimator=estimator), store)
        watch = street.watch

        def now() -> tuple[set[bool], float | None, bool]:
            assert watch.report is not None
            return marked(watch.report), watch.report.t_measured, watch.report.busbar.judged

        street.go_on(3, silence)
        assert now() == ({True}, None, False)
        street.go_on(20, every)
        assert now() == ({False}, START + 22, judges)
        # The busbar's voltage is the level of all values; no meter judges it here.
        street.go_on(4, busbar_alone)
        assert now() == ({False}, START + 26, False)
        street.go_on(4, one_meter)
        assert (now()[0], now()[2]) == ({not uses_one}, False)
        street.go_on(4, every)
        street.go_on(SILENT_S, silence)
        # A reading serves for two and a half ticks.
        assert now() == ({True}, START + 36, False)


def test_history_marks_what_is_model_only_and_leaves_it_out_of_the_extremes(
    site: Site, tmp_path: Path
) -> None:
    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(site, store)
        street.go_on(30, every)
        street.go_on(30, silence)
        rows = [HistoryPoint.model_validate(row) for row in store.history(FEEDER, meter="m05", limit=500)]
        kept = {row.t - START: row for row in rows}
        live, gone = kept[20.0], kept[50.0]
        assert live.meter is not None
        assert gone.meter is not None
        assert (live.model_only, live.meter.model_only) == (False, False)
        assert live.v_volt_lowest is not None
        assert (gone.model_only, gone.meter.model_only) == (True, True)
        assert (gone.v_volt_lowest, gone.v_volt_highest) == (None, None)


def test_a_voltage_alarm_is_neither_raised_nor_cleared_by_the_model_alone(site: Site, tmp_path: Path) -> None:
    """The limit lies below what the model says without a reading."""
    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(tight(site, 0.93), store)
        street.go_on(20, silence)
        assert AlarmKind.VOLTAGE_LIMIT not in {kind for kind, _ in street.standing()}
        street.go_on(20, every)
        raised = {alarm for alarm in street.standing() if alarm[0] is AlarmKind.VOLTAGE_LIMIT}
        assert len(raised) == len(site.meter_ids)
        street.go_on(20, silence)
        assert raised <= street.standing()


def test_a_sound_verdict_raises_no_voltage_alarm_from_the_model_alone(site: Site) -> None:
    """Whatever an estimator promises: the report decides by the readings."""
    estimator = design(site)
    state = estimator.init(START, None)
    readings = tuple(Reading(FEEDER, meter, START, QUIET_VOLT, 0.0, 0.0) for meter in site.meter_ids)
    live = tick_of(START, readings, Reading(FEEDER, None, START, QUIET_VOLT), ())
    _, estimate, verdict = estimator.step(state, to_frame(site, snapshot(site, live)))
    sound = replace(verdict, cause=Cause.SILENT_METERS)
    high = replace(estimate, v2=estimate.v2 * 1.3, v2_bus=estimate.v2_bus * 1.3)
    none = replace(live, values=np.full_like(live.values, np.nan))
    alarms = {}
    for tick in (live, none):
        found = conditions(build(site, tick, 2, high, sound))
        alarms[not tick.seen.any()] = {c.known for c in found if c.kind is AlarmKind.VOLTAGE_LIMIT}
    assert alarms == {False: {True}, True: {False}}


def test_readings_that_are_not_trusted_are_no_ground(site: Site) -> None:
    """Only a named meter reports: its alarm rests on nothing beside it, and says so."""
    estimator = design(site)
    state = estimator.init(START, None)
    k = 4
    readings = tuple(
        Reading(FEEDER, meter, START, 245.0) if i == k else None for i, meter in enumerate(site.meter_ids)
    )
    tick = tick_of(START, readings, None, ())
    _, estimate, verdict = estimator.step(state, to_frame(site, snapshot(site, tick)))
    which = np.arange(len(readings)) == k
    accusing = replace(verdict, decision=Decision.ATTACKED, suspects=which)
    named = build(site, tick, 2, replace(estimate, trusted=~which), accusing)
    assert marked(named) == {True}
    (found,) = (c for c in conditions(named) if (c.kind, c.meter) == (AlarmKind.METER_MANIPULATED, "m05"))
    assert found.evidence.v_volt_estimated is None
    assert found.reason == "reports 245.0 V, no other trusted meter is available"
    trusted = build(site, tick, 2, replace(estimate, trusted=which), verdict)
    assert marked(trusted) == {False}


# ---------------------------------------------------------------------------------------------- three phases


def in_phases(site: Site, phases: str, v_phases: tuple[float, ...] | None) -> Tick:
    """The meters of some phases report nominal voltage, and the busbar's meter its own."""
    base = site.feeder.base_volt
    rows = [site.tables.customers[int(k)].phases for k in site.meters]
    readings = tuple(
        Reading(site.feeder.name, meter, START, base) if phase in phases else None
        for meter, phase in zip(site.meter_ids, rows, strict=True)
    )
    busbar = None
    if v_phases is not None:
        busbar = Reading(site.feeder.name, None, START, base, v_phases=v_phases)
    return tick_of(START, readings, busbar, ())


def test_in_three_phases_each_phase_needs_a_reading_of_its_own() -> None:
    site = load(EUROPEAN)
    estimator, nan, base = design(site), float("nan"), site.feeder.base_volt
    cases: list[tuple[str, tuple[float, ...] | None, list[str]]] = [
        ("", None, ["a", "b", "c"]),
        ("a", None, ["b", "c"]),
        ("a", (nan, base, nan), ["c"]),
        ("", (base, base, base), []),
    ]
    for phases, v_phases, alone in cases:
        tick = in_phases(site, phases, v_phases)
        state = estimator.init(START, None)
        _, estimate, verdict = estimator.step(state, to_frame(site, snapshot(site, tick)))
        for report in (build(site, tick, 2, estimate, verdict), blind(site, tick, 2, Cause.SETTLING, "")):
            assert list(report.model_only_phases) == alone
            assert report.model_only == (len(alone) == 3)
            of = {row.customer: row.phases for row in site.tables.customers}
            assert {of[c.customer] for c in report.customers if c.model_only} == set(alone)
            assert {m.phase for m in report.meters if m.model_only} == set(alone)
            assert report.buses[0].model_only == (len(alone) == 3)
            assert not report.busbar.judged or (phases == "a" and v_phases is not None)
        # A bus shows the voltage of a phase with a reading where it has one.
        assert all(bus.v_volt is not None for bus in build(site, tick, 2, estimate, verdict).buses)


def test_the_busbar_meter_is_judged_only_beside_a_meter_of_the_same_phase() -> None:
    site = load(EUROPEAN)
    estimator, nan, base = design(site), float("nan"), site.feeder.base_volt
    judged = {}
    for name, v_phases in (("same", (base, nan, nan)), ("other", (nan, base, base))):
        tick = in_phases(site, "a", v_phases)
        _, estimate, verdict = estimator.step(
            estimator.init(START, None), to_frame(site, snapshot(site, tick))
        )
        judged[name] = build(site, tick, 2, estimate, verdict).busbar.judged
    assert judged == {"same": True, "other": False}


# ---------------------------------------------------------------------------------------------- over the wire


def streamed(http: httpx.Client) -> dict[str, Any]:
    """Return the first state of the stream."""
    with http.stream("GET", f"/api/v1/feeders/{FEEDER}/stream") as answer:
        for line in answer.iter_lines():
            if line.startswith("data: "):
                found: dict[str, Any] = json.loads(line.removeprefix("data: "))
                return found
    raise AssertionError("no state")


def _markers(state: dict[str, Any]) -> Iterable[bool]:
    yield state["model_only"]
    yield state["busbar"]["model_only"]
    for name in LISTS:
        for entry in state[name]:
            yield entry["model_only"]


@pytest.mark.acceptance
def test_rest_streams_and_zenoh_mark_it_before_the_first_reading(tmp_path: Path) -> None:
    with service(tmp_path, clock="wall") as live:
        until(lambda: live.get("/readyz")["ok"] if live.http.get("/readyz").is_success else False)
        state = until(lambda: (now := live.state()) and now["cause"] != "settling" and now, "an estimate")
        estimates = live.meters.query(f"{FEEDER}/estimate", 5.0)
        (published,) = (json.loads(payload) for payload in estimates.values())
        for one in (state, streamed(live.http), published):
            assert set(_markers(one)) == {True}
            assert one["t_measured"] is None
            assert (one["busbar"]["judged"], one["busbar"]["seen"]) == (False, False)
            assert all(isinstance(meter["v_volt_estimated"], float) for meter in one["meters"])
        assert live.get(f"/api/v1/feeders/{FEEDER}/meters/m05")["model_only"] is True
        (summary,) = live.get("/api/v1/feeders")["feeders"]
        assert summary["model_only"] is True
        (point, *_) = live.get(f"/api/v1/feeders/{FEEDER}/history")["points"]
        assert (point["seen"], point["v_volt_lowest"]) == (0, None)
        t = live.state()["t"] + 1.0
        live.put(f"{FEEDER}/meter/m05/reading", {"t": t, "v_volt": 230.0})
        seen = until(lambda: (now := live.state())["model_only"] is False and now, "a value with a reading")
        assert seen["t_measured"] == seen["t"]
        gone = until(lambda: (now := live.state())["model_only"] and now, "silence")
        assert seen["t"] <= gone["t_measured"] < gone["t"]
        assert BUSBAR not in {meter["meter"] for meter in gone["meters"]}
