"""Exchanged phases in a feeder's files beside the accusation: reports, alarms, REST, replay, restarts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from benchmarks.calibrate_exchanges import truth_of
from feeders import registry
from feeders.format.tables import FeederTables, write
from feeders.model.site import Site, from_tables, load, to_frame
from feeders.simulation.recording import read_recording, record
from feeders.simulation.scenario import Scenario, simulate, snapshots
from gridsec.estimators import data_errors
from gridsec.estimators.data_errors import DataErrorKind
from gridsec.interface import Cause
from service.alarms.state_machine import (
    Alarm,
    AlarmBook,
    AlarmKind,
    AlarmRules,
    Change,
    advance,
    conditions,
)
from service.alarms.state_machine import from_json as alarm_from_json
from service.alarms.state_machine import to_json as alarm_to_json
from service.api.models import State
from service.cli.simulate import Pace, play
from service.engine.feeder_monitor import TickResult
from service.engine.replay import ReplayCounts, replay
from service.report.data_errors import DataErrorReport, DataErrors
from service.report.report import to_json, with_data_error
from tests.service.reports import FEEDER, T0, acknowledge, meter, report
from tests.service.running import service, until

NAME = "simbench-lv-rural1"
ONE, OTHER = "LV1.101 Load 3", "LV1.101 Load 4"
STUDY = f"gridsec study calibrate {NAME} --readings FILE --look-for phase --look-for swap"
TICK_S = 10.0

ERROR = DataErrorReport(
    DataErrorKind.BUS, ("m1",), ("Miller",), ("bus b2",), "study", "An error of the files."
)


def tables(*, exchanged: bool) -> FeederTables:
    """The feeder with single-phase customers; with the phases of two of them exchanged."""
    made = truth_of(NAME)
    phases = {row.customer: row.phases for row in made.customers}
    if exchanged:
        phases |= {ONE: phases[OTHER], OTHER: phases[ONE]}
    rows = tuple(replace(row, phases=phases[row.customer]) for row in made.customers)
    monitor = replace(made.meta.monitor, tick_s=TICK_S, silence_s=3 * TICK_S)
    return replace(made, meta=replace(made.meta, monitor=monitor), customers=rows)


SCENE = Scenario(seed=2, duration_s=900.0, dt_s=TICK_S)


@pytest.fixture(scope="module")
def files() -> Site:
    return from_tables(tables(exchanged=True))


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of a quarter of an hour of the true feeder."""
    path = tmp_path_factory.mktemp("day") / "day.parquet"
    return record(from_tables(tables(exchanged=False)), SCENE, path).path


@pytest.fixture(scope="module")
def results(files: Site, day: Path) -> list[TickResult]:
    """Results of the service for the recording with these files."""
    return list(replay(files, read_recording(day).readings(), ReplayCounts()))


def test_the_hint_is_in_the_report_its_reason_and_the_evidence(results: list[TickResult]) -> None:
    named = [one.report for one in results if one.report.data_error is not None]
    assert named
    assert named[0].t - results[0].report.t >= 600.0  # ten minutes of changing loads first
    for now in named:
        error = now.data_error
        assert error is not None
        assert set(error.customers) == {ONE, OTHER}
        assert (error.kind, error.study) == ("exchanged-phases", STUDY)
        assert now.reason.endswith(error.text)
        assert STUDY in error.text
    last = TypeAdapter(State).validate_python(to_json(named[-1]) | {"age_s": 0.0})
    assert last.data_error is not None
    assert last.data_error.study == STUDY


def test_the_alarm_that_stands_is_updated_once(results: list[TickResult]) -> None:
    transitions = [
        t for one in results for t in one.transitions if t.alarm.kind is AlarmKind.METER_MANIPULATED
    ]
    updated = [t for t in transitions if t.change is Change.UPDATED]
    assert updated
    assert len({t.alarm.id for t in updated}) == len(updated)
    for t in updated:
        error = t.alarm.evidence.data_error
        assert error is not None
        assert t.alarm.meter in error.meters
        assert STUDY in t.alarm.reason
        assert alarm_from_json(alarm_to_json(t.alarm)) == t.alarm
        TypeAdapter(Alarm).validate_python(alarm_to_json(t.alarm))


@pytest.mark.acceptance
def test_rest_shows_the_hint_of_a_live_feeder(tmp_path: Path, results: list[TickResult]) -> None:
    """A feeder folder with exchanged phases, readings over zenoh: the same hint as in the replay."""
    write(tables(exchanged=True), tmp_path / NAME)
    truth = from_tables(tables(exchanged=False))
    with service(tmp_path, (str(tmp_path / NAME),), clock="events") as live:
        samples = list(play(truth, SCENE, live.meters, Pace(float("inf"), ahead=3)))
        until(lambda: live.state(NAME).get("t", 0.0) >= samples[-1].t - 2.0 * TICK_S, "the end")
        page = live.get("/api/v1/alarms", kind="meter-manipulated")
        hints = [a["evidence"]["data_error"] for a in page["alarms"] if a["evidence"]["data_error"]]
        state = live.state(NAME)
    assert hints
    assert all(set(hint["customers"]) == {ONE, OTHER} and hint["study"] == STUDY for hint in hints)
    replayed = {one.report.t: one.report for one in results}[state["t"]]
    assert state["data_error"] == to_json(replayed)["data_error"]
    assert state["reason"] == replayed.reason


# --------------------------------------------------------------- alarms

RULES = AlarmRules(on_delay_s=2.0, off_delay_s=5.0)


def accused(k: int, error: DataErrorReport | None) -> tuple[float, list]:  # type: ignore[type-arg]
    now = report(meter("m1", suspect=True), meter("m2"), cause=Cause.RESIDUALS, t=T0 + k)
    return now.t, conditions(with_data_error(now, error))


def test_an_error_found_later_updates_the_alarm_and_leaves_its_answer() -> None:
    book, seen = AlarmBook(FEEDER), []
    other = replace(ERROR, customers=("Lovelace",))
    for k, error in enumerate([None] * 4 + [ERROR] * 4 + [None] * 2 + [ERROR] + [other] * 2):
        t, now = accused(k, error)
        book, transitions = advance(book, RULES, now, t)
        seen += [(k, item.change) for item in transitions]
        if k == 3:
            book, _ = acknowledge(book, book.active[0].id, "Ada", "seen", t)
    assert seen == [(2, Change.RAISED), (4, Change.UPDATED), (11, Change.UPDATED)]
    (alarm,) = book.active
    assert (alarm.acknowledged_by, alarm.state.value, alarm.count) == ("Ada", "acknowledged", 1)
    assert alarm.evidence.data_error == other
    assert alarm.reason.endswith("An error of the files.")


def test_another_meter_s_alarm_and_a_silent_tick_have_no_hint() -> None:
    now = report(meter("m1", suspect=True), meter("m2", suspect=True), cause=Cause.RESIDUALS)
    by_meter = {c.meter: c for c in conditions(with_data_error(now, ERROR))}
    assert by_meter["m1"].evidence.data_error == ERROR
    assert by_meter["m2"].evidence.data_error is None
    undecided = with_data_error(report(meter("m1"), cause=Cause.AMBIGUOUS), ERROR)
    (alarm,) = (c for c in conditions(undecided) if c.kind is AlarmKind.UNDECIDED)
    assert alarm.evidence.data_error == ERROR
    assert with_data_error(now, None) is now


def test_the_window_begins_anew_with_a_new_design(files: Site) -> None:
    """A hint rests on readings since the design: the first tick after `renew` has none."""
    found, watcher = DataErrors(files), registry.design(files)
    state, hints = watcher.init(SCENE.start), []
    true = from_tables(tables(exchanged=False))
    assert true.meter_ids == files.meter_ids
    for one in snapshots(simulate(true, SCENE)):
        frame = to_frame(files, one)
        state, estimate, verdict = watcher.step(state, frame)
        hints.append(found.follow(frame, estimate, verdict))
        if hints[-1] is not None:
            found.renew()
    at = [k for k, hint in enumerate(hints) if hint is not None]
    assert at
    assert len(at) == 1


def test_an_absurd_register_beside_a_false_voltage_breaks_nothing() -> None:
    """The model's squared voltages by such a register are negative: these blocks decide nothing."""
    made = load("cigre-lv").tables
    monitor = replace(made.meta.monitor, tick_s=60.0, silence_s=180.0)
    site = from_tables(replace(made, meta=replace(made.meta, monitor=monitor)))
    credible = (site.loads.credible * site.feeder.base_kva)[site.meters]
    watcher, errors = registry.design(site), DataErrors(site)
    taken = list(snapshots(simulate(site, Scenario(seed=1, duration_s=1200.0, dt_s=60.0))))
    state = watcher.init(taken[0].t - 60.0)
    for k, each in enumerate(taken):
        v, q = each.v_volt.copy(), each.q_kvar.copy()
        if k > 2:
            v[2], q[2] = 1.05 * v[2], 0.99 * credible[2]
        frame = to_frame(site, replace(each, v_volt=v, q_kvar=q))
        state, estimate, verdict = watcher.step(state, frame)
        errors.follow(frame, estimate, verdict)
    rows = errors._window.rows
    assert rows is not None
    assert rows.model.min() < 0.0
    assert errors._design is not None


def test_a_defect_of_the_comparison_costs_no_verdict(
    files: Site, results: list[TickResult], day: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise FloatingPointError("a defect")

    monkeypatch.setattr(data_errors, "follow", broken)
    without = list(replay(files, read_recording(day).readings(), ReplayCounts()))
    assert [one.report.verdict for one in without] == [one.report.verdict for one in results]
    assert any(one.report.data_error is not None for one in results)
    assert not any(one.report.data_error is not None for one in without)


def test_the_alarm_follows_a_hint_at_another_place_of_the_same_customer() -> None:
    book, changes = AlarmBook(FEEDER), []
    moved = replace(ERROR, proposed=("bus b3",))
    for k, error in enumerate([ERROR] * 5 + [moved] * 2):
        t, now = accused(k, error)
        book, transitions = advance(book, RULES, now, t)
        changes += [(k, item.change) for item in transitions]
    assert changes == [(2, Change.RAISED), (5, Change.UPDATED)]
