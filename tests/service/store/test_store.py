"""What the store keeps, in either kind of database."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from service.alarms.state_machine import (
    Alarm,
    AlarmKind,
    AlarmState,
    AlarmTransition,
    Change,
    Severity,
    acknowledged,
)
from service.report.report import FeederReport
from service.store import BAD_READINGS_KEPT, HistoryRules, Rejected, Store, StoreUnavailable
from tests.codes import refused
from tests.service.databases import both
from tests.service.stored import T0, a_report, an_alarm, raised


def cleared(alarm: Alarm, t: float) -> AlarmTransition:
    return AlarmTransition(replace(alarm, state=AlarmState.CLEARED, t_cleared=t), Change.CLEARED, t)


# --------------------------------------------------- alarms, events and outbox


@both
def test_state_event_and_outbox_come_together(store: Store) -> None:
    alarm = an_alarm()
    assert store.commit([raised(alarm)]) == (1,)
    assert store.commit([cleared(alarm, T0 + 9)]) == (2,)
    assert store.last_event == 2
    stored = store.alarm(alarm.id)
    assert stored == replace(alarm, state=AlarmState.CLEARED, t_cleared=T0 + 9)
    first, second = store.events(alarm.id)
    assert (first.seq, first.change, first.alarm) == (1, Change.RAISED, alarm)
    assert (second.seq, second.t, second.alarm) == (2, T0 + 9, stored)
    assert [event.seq for event in store.outbox_pending()] == [1, 2]
    store.outbox_done([1])
    assert [event.seq for event in store.outbox_pending()] == [2]
    store.outbox_done([])
    store.outbox_done([2])
    assert store.outbox_pending() == []
    assert len(store.events_after(0)) == 2


@both
def test_a_transaction_is_all_or_nothing(store: Store) -> None:
    too_long = an_alarm(2, id="Z" * 26, feeder=None)
    with refused(StoreUnavailable, "write-failed"):
        store.commit([raised(an_alarm(1)), raised(too_long)], reports=[a_report(T0)])
    assert store.alarms() == ([], None)
    assert store.outbox_pending() == []
    assert store.history("village") == []
    assert store.last_event == 0
    # The store goes on, and the report that was lost is still worth keeping.
    store.commit([raised(an_alarm(1))], reports=[a_report(T0)])
    assert len(store.history("village")) == 1


@both
def test_events_know_who_and_why(store: Store) -> None:
    alarm = an_alarm()
    store.commit([raised(alarm)])
    item = acknowledged(alarm, "Ada", "on my way", T0 + 3)
    store.commit([item])
    (_, event) = store.events(alarm.id)
    assert (event.change, event.who, event.comment) == (Change.ACKNOWLEDGED, "Ada", "on my way")
    assert event.alarm == item.alarm == store.alarm(alarm.id)


@both
def test_everything_survives_closing(url: str) -> None:
    alarm = an_alarm()
    answer = acknowledged(alarm, "Ada", "", T0 + 1)
    with Store(url) as one:
        one.commit([raised(alarm), answer], reports=[a_report(T0)], rejected=[Rejected(T0, "k", "r", b"x")])
        one.commit(put=("village", {"meta": {"name": "village"}}))
    with Store(url) as two:
        assert two.alarm(alarm.id) == answer.alarm
        assert two.last_event == 2
        assert two.active("village") == [answer.alarm]
        assert two.feeders() == {"village": {"meta": {"name": "village"}}}
        assert len(two.history("village")) == len(two.rejected()) == 1
        assert two.commit([cleared(answer.alarm, T0 + 8)]) == (3,)


@both
def test_active_gives_what_a_restart_needs(store: Store) -> None:
    stands, old, young = an_alarm(1), an_alarm(2), an_alarm(3)
    elsewhere = an_alarm(4, feeder="town")
    store.commit([raised(a) for a in (stands, old, young, elsewhere)])
    store.commit([cleared(old, T0 + 10), cleared(young, T0 + 100)])
    assert [a.id for a in store.active("village")] == [stands.id]
    assert [a.id for a in store.active("village", cleared_since=T0 + 50)] == [stands.id, young.id]
    assert store.active("nowhere") == []


@both
def test_filters_find_what_a_plain_search_finds(store: Store) -> None:
    kinds, severities, states = list(AlarmKind), list(Severity), list(AlarmState)
    made = [
        an_alarm(
            k,
            kind=kinds[k % 4],
            severity=severities[k % 3],
            state=states[(k // 2) % 3],
            feeder=("village", "town")[k % 2],
            meter=(None, "m1", "m2")[(k // 4) % 3],
        )
        for k in range(60)
    ]
    store.commit([raised(a) for a in made])
    wanted: list[tuple[dict[str, object], Callable[[Alarm], bool]]] = [
        ({}, lambda a: True),  # noqa: ARG005
        ({"state": [AlarmState.RAISED]}, lambda a: a.state == "raised"),
        ({"state": ["raised", "cleared"]}, lambda a: a.state in {"raised", "cleared"}),
        (
            {"kind": ["data-loss"], "feeder": "village"},
            lambda a: (a.kind, a.feeder) == ("data-loss", "village"),
        ),
        ({"severity": ["minor"], "meter": "m2"}, lambda a: a.severity == "minor" and a.meter == "m2"),
        ({"since": T0 + 10, "until": T0 + 20}, lambda a: T0 + 10 <= a.t_raised < T0 + 20),
        (
            {"feeder": "town", "state": ["acknowledged"]},
            lambda a: a.feeder == "town" and a.state == states[1],
        ),
    ]
    for arguments, keep in wanted:
        expected = [a.id for a in reversed(made) if keep(a)]
        found, cursor = store.alarms(**arguments)  # type: ignore[arg-type]
        assert [a.id for a in found] == expected, arguments
        assert cursor is None


@both
def test_pages_neither_repeat_nor_skip_while_alarms_come_and_change(store: Store) -> None:
    made = [an_alarm(k) for k in range(25)]
    store.commit([raised(a) for a in made])
    seen: list[str] = []
    cursor, new = None, 100
    while True:
        page, cursor = store.alarms(cursor=cursor, limit=7)
        seen += [a.id for a in page]
        store.commit([raised(an_alarm(new)), cleared(made[new % 25], T0 + 500)])
        new += 1
        if cursor is None:
            break
    assert seen == [a.id for a in reversed(made)]
    exact, cursor = store.alarms(limit=25 + new - 100)
    assert len(exact) == 25 + new - 100
    assert cursor is None


@both
def test_events_after_a_number_in_order(store: Store) -> None:
    for k in range(12):
        store.commit([raised(an_alarm(k, feeder=("village", "town")[k % 2]))])
    assert [event.seq for event in store.events_after(8)] == [9, 10, 11, 12]
    assert [event.seq for event in store.events_after(0, limit=3)] == [1, 2, 3]
    assert [event.seq for event in store.events_after(4, feeder="town")] == [6, 8, 10, 12]


# ---------------------------------------------- history, bad readings, feeders


@both
def test_history_keeps_a_grid_and_every_change(url: str) -> None:
    with Store(url, history=HistoryRules(step_s=10.0)) as store:
        for k in range(35):
            store.commit(reports=[a_report(T0 + k, ("m1",) if 13 <= k < 16 else ())])
        points = store.history("village")
        assert [p["t"] - T0 for p in points] == [0, 10, 13, 16, 20, 30]
        assert [p["verdict"] for p in points] == ["clean", "clean", "attacked", "clean", "clean", "clean"]
        one = store.history("village", meter="m1", since=T0 + 13, until=T0 + 16)
        assert one[0]["meter"] == {
            "meter": "m1",
            "seen": True,
            "suspect": True,
            "model_only": False,
            "v_volt_reported": 230.0,
            "v_volt_estimated": 229.5,
            "v_volt_std": 0.1,
            "score": 1e-4,
            "threshold": 2e-3,
        }
        assert (one[0]["seen"], one[0]["suspects"]) == (2, ["m1"])
        assert [p["t"] - T0 for p in store.history("village", limit=2)] == [20, 30]
        assert {p["meter"] for p in store.history("village", meter="nobody")} == {None}
        assert store.history("nowhere") == []


@both
def test_history_reads_rows_from_before_a_meter_was_added(store: Store) -> None:
    store.commit(reports=[a_report(T0, count=2)])
    store.commit(reports=[a_report(T0 + 60, count=4)])
    assert [p["seen"] for p in store.history("village")] == [2, 3]
    first, second = (p["meter"] for p in store.history("village", meter="m3"))
    assert first is None
    assert second["meter"] == "m3"


@both
def test_history_of_a_replay_replaces(store: Store) -> None:
    store.commit(reports=[a_report(T0, volt=230.0)])
    store.commit(reports=[a_report(T0 - 100)])
    store.commit(reports=[a_report(T0, volt=240.0)])
    points = store.history("village", meter="m1")
    assert [(p["t"] - T0, p["meter"]["v_volt_reported"]) for p in points] == [(-100, 230.0), (0, 240.0)]


def test_history_forgets_what_is_too_old(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/h.db", history=HistoryRules(step_s=0.0, keep_s=100.0)) as store:
        for k in range(501):
            store.commit(reports=[a_report(T0 + k)])
        kept = [p["t"] - T0 for p in store.history("village", limit=10_000)]
    assert kept == list(range(400, 501))


def every(step_s: float, begin: float, end: float, feeder: str = "village") -> list[FeederReport]:
    count = round((end - begin) / step_s)
    return [replace(a_report(T0 + begin + k * step_s), feeder=feeder) for k in range(count)]


SHORT = HistoryRules(step_s=0.0, keep_s=100.0)


@pytest.mark.canary("150.0-sqlite", "10000000.0-sqlite")
@both
@pytest.mark.parametrize("leap_s", [150.0, 1e7])
def test_a_clock_that_leaps_costs_no_history_unless_it_goes_on(
    url: str, leap_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.store.store._PRUNE_EVERY", 100)
    with Store(url, history=SHORT) as store:
        store.commit(reports=every(0.5, 0.0, 50.0))
        leap = 50.0 + leap_s
        store.commit(reports=every(0.25, leap, leap + 40.0))
        assert len(store.history("village", until=T0 + 50.0, limit=10_000)) == 100
    with Store(url, history=SHORT) as store:
        store.commit(reports=every(0.25, leap + 40.0, leap + 45.0))
        assert len(store.history("village", until=T0 + 50.0, limit=10_000)) == 100
        store.commit(reports=every(0.25, leap + 45.0, leap + 210.0))
        assert store.history("village", limit=10_000)[0]["t"] > T0 + leap


def test_history_is_pruned_however_often_the_service_begins_anew(tmp_path: Path) -> None:
    for begin in range(0, 300, 20):
        with Store(f"sqlite:///{tmp_path}/h.db", history=SHORT) as store:
            store.commit(reports=every(1.0, begin, begin + 20.0))
            assert len(store.history("village", limit=10_000)) <= 120


@both
def test_history_of_a_feeder_that_is_watched_no_more_is_pruned_too(url: str) -> None:
    with Store(url, history=SHORT) as store:
        store.commit(reports=[*every(1.0, 0.0, 20.0, "gone"), *every(1.0, 0.0, 20.0)])
    with Store(url, history=SHORT) as store:
        store.commit(reports=every(1.0, 20.0, 100.0))
        assert len(store.history("gone")) == 20
        store.commit(reports=every(1.0, 100.0, 600.0))
        assert store.history("gone") == []
        assert store.history("village") != []


@both
def test_bad_readings_are_kept_but_not_for_ever(store: Store) -> None:
    store.commit(rejected=[Rejected(T0, "gridsec/x", "no JSON", b"\xff" * 10_000)])
    (one,) = store.rejected()
    assert (one.t, one.key, one.reason, one.payload) == (T0, "gridsec/x", "no JSON", b"\xff" * 256)
    for k in range(4):
        store.commit(rejected=[Rejected(T0 + k, f"k{k}-{i}", "r") for i in range(400)])
    found = store.rejected(5000)
    assert len(found) == BAD_READINGS_KEPT
    assert (found[0].key, found[-1].key) == ("k3-399", "k1-200")


@both
def test_bad_readings_that_cannot_be_kept_hold_up_no_alarm(store: Store) -> None:
    """No database keeps half a surrogate, and PostgreSQL no NUL."""
    store.commit(rejected=[Rejected(T0, "gridsec/x", "no JSON")])
    alarm = an_alarm()
    bad = [Rejected(T0, "gridsec/y", "no JSON"), Rejected(T0, "gridsec/\0/\ud800", "no JSON")]
    with capture_logs() as logs:
        assert store.commit([raised(alarm)], reports=[a_report(T0)], rejected=bad) == (1,)
    assert [(line["event"], line["count"]) for line in logs] == [("bad readings could not be kept", 2)]
    assert store.alarm(alarm.id) == alarm
    assert len(store.history("village")) == 1
    assert [one.key for one in store.rejected()] == ["gridsec/x"]
    store.commit(rejected=[Rejected(T0, "gridsec/z", "no JSON")])
    assert [one.key for one in store.rejected()] == ["gridsec/z", "gridsec/x"]


@both
def test_feeders_are_replaced_by_name(store: Store) -> None:
    assert store.feeders() == {}
    store.commit(put=("village", {"lines": [1.5, None, "ü"]}))
    store.commit(put=("town", {}))
    store.commit(put=("village", {"lines": []}))
    assert store.feeders() == {"town": {}, "village": {"lines": []}}


@both
def test_readers_see_whole_transactions_while_the_writer_writes(store: Store) -> None:
    stop, wrong = threading.Event(), []

    def read() -> None:
        while not stop.is_set():
            try:
                pairs = {a.id: a for a in store.alarms()[0]}
                for event in store.events_after(0, limit=1000)[: len(pairs)]:
                    assert event.alarm.id in {*pairs, *(a.id for a in store.alarms()[0])}
            except Exception as error:  # noqa: BLE001 - whatever it is, the test must show it
                wrong.append(error)

    readers = [threading.Thread(target=read) for _ in range(3)]
    for thread in readers:
        thread.start()
    for k in range(60):
        store.commit([raised(an_alarm(k))])
    stop.set()
    for thread in readers:
        thread.join()
    assert wrong == []
    assert len(store.alarms(limit=100)[0]) == 60
