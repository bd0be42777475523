from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from gridsec.online import Cause, Decision
from service.alarms import (
    Alarm,
    AlarmKind,
    AlarmState,
    AlarmUnknown,
    AlreadyAcknowledged,
    Change,
    Evidence,
    Severity,
    Transition,
    acknowledged,
)
from service.commissioning import Happened, Step
from service.kept import Kept
from service.report import FeederReport, MeterReport
from service.store import BAD_READINGS_KEPT, HistoryRules, Rejected, Store, StoreUnavailable, connect, schema
from tests.service.databases import Cluster, both

T0 = 1_795_212_000.0


@pytest.fixture
def store(url: str) -> Iterator[Store]:
    with Store(url) as made:
        yield made


# ------------------------------------------------------------------ material


def an_alarm(number: int = 0, **changes: object) -> Alarm:
    t = T0 + number
    made = Alarm(
        id=f"{number:026d}",
        kind=AlarmKind.METER_MANIPULATED,
        feeder="village",
        meter="m1",
        severity=Severity.CRITICAL,
        state=AlarmState.RAISED,
        count=1,
        t_event=t - 2,
        t_raised=t,
        t_cleared=None,
        reason="reports 240.0 V – «quoted» ' \" \\ 雪",
        evidence=Evidence(1e-3 / 3, None, 0.1 + 0.2, 230.0, -5e-324),
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def raised(alarm: Alarm) -> Transition:
    return Transition(alarm, Change.RAISED, alarm.t_raised)


def cleared(alarm: Alarm, t: float) -> Transition:
    return Transition(replace(alarm, state=AlarmState.CLEARED, t_cleared=t), Change.CLEARED, t)


def a_report(
    t: float, suspects: tuple[str, ...] = (), *, count: int = 3, volt: float = 230.0
) -> FeederReport:
    meters = tuple(
        MeterReport(f"m{i}", "b1", i != 2, f"m{i}" in suspects, 1e-4, 2e-3, volt, volt - 0.5, 0.1, 1.0, 0.0)
        for i in range(count)
    )
    verdict = (Decision.ATTACKED, Cause.RESIDUALS) if suspects else (Decision.CLEAN, Cause.AGREEMENT)
    return FeederReport("village", t, verdict[0], "", verdict[1], 2, meters, (), (), 207.0, 253.0)


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
    with pytest.raises(StoreUnavailable, match="cannot write"):
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
    item = store.acknowledge(alarm.id, "Ada", "on my way", T0 + 3)
    assert item.alarm.state is AlarmState.ACKNOWLEDGED
    (_, event) = store.events(alarm.id)
    assert (event.change, event.who, event.comment) == (Change.ACKNOWLEDGED, "Ada", "on my way")
    assert event.alarm == item.alarm == store.alarm(alarm.id)
    with pytest.raises(AlreadyAcknowledged, match="Ada"):
        store.acknowledge(alarm.id, "Grace", "", T0 + 4)
    with pytest.raises(AlarmUnknown):
        store.acknowledge("0" * 25 + "9", "Grace", "", T0 + 4)


@both
def test_everything_survives_closing(url: str) -> None:
    alarm = an_alarm()
    answer = acknowledged(alarm, "Ada", "", T0 + 1)
    with Store(url) as one:
        one.commit([raised(alarm), answer], reports=[a_report(T0)], rejected=[Rejected(T0, "k", "r", b"x")])
        one.put_feeder("village", {"meta": {"name": "village"}})
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
            "v_volt_reported": 230.0,
            "v_volt_estimated": 229.5,
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
        for k in range(500):
            store.commit(reports=[a_report(T0 + k)])
        kept = [p["t"] - T0 for p in store.history("village", limit=10_000)]
    assert kept == list(range(399, 500))


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
def test_feeders_are_replaced_by_name(store: Store) -> None:
    assert store.feeders() == {}
    store.put_feeder("village", {"lines": [1.5, None, "ü"]})
    store.put_feeder("town", {})
    store.put_feeder("village", {"lines": []})
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


# --------------------------------------------------------------- when it fails


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("nonsense", "no database address"),
        ("mysql://localhost/x", "only sqlite and postgresql"),
        ("sqlite://", "name a file"),
        ("sqlite:///:memory:", "name a file"),
        ("sqlite:////nonexistent-folder/x.db", "No such file or directory"),
        ("sqlite:////proc/x.db", "cannot open"),
        ("postgresql+psycopg://gridsec:secret@/x?host=/nonexistent-folder", "cannot open"),
    ],
)
def test_a_database_that_cannot_be_used_is_a_clear_error(url: str, words: str) -> None:
    with pytest.raises(StoreUnavailable, match=words) as caught:
        Store(url)
    assert "secret" not in str(caught.value)


def test_a_file_that_is_no_database_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "notes.db"
    path.write_text("These are my notes, not a database. " * 200)
    before = path.read_bytes()
    with pytest.raises(StoreUnavailable, match="not a database"):
        Store(f"sqlite:///{path}")
    assert path.read_bytes() == before


@both
def test_only_one_process_writes(url: str, family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connect, "WAIT_S", 1.0)
    words = "another process writes it" if family == "sqlite" else "lock timeout"
    with Store(url), pytest.raises(StoreUnavailable, match=words):
        Store(url)
    with Store(url) as again:
        again.check()


@both
def test_readers_cannot_write(store: Store, family: str) -> None:
    words = "readonly" if family == "sqlite" else "read-only"
    with pytest.raises(StoreUnavailable, match=words), store._read() as connection:
        connection.execute(schema.FEEDER.delete())


def test_reports_of_one_commit_are_thinned_out_like_those_of_many(tmp_path: Path) -> None:
    suspects = [("m1",) if 13 <= k < 15 or k == 33 else () for k in range(40)]
    reports = [a_report(T0 + k, named) for k, named in enumerate(suspects)]
    with Store(f"sqlite:///{tmp_path}/one.db") as one, Store(f"sqlite:///{tmp_path}/many.db") as many:
        one.commit(reports=reports)
        for report in reports:
            many.commit(reports=[report])
        rows = one.history("village")
        assert rows == many.history("village")
    assert [row["t"] - T0 for row in rows] == [0, 10, 13, 15, 20, 30, 33, 34]


def test_a_file_that_was_taken_away_is_missed_and_found_again(tmp_path: Path) -> None:
    """An unlinked file takes every write and keeps none: that must not look like success."""
    path, elsewhere = tmp_path / "s.db", tmp_path / "elsewhere"
    elsewhere.mkdir()
    with Store(f"sqlite:///{path}") as store:
        store.commit([raised(an_alarm(1))])
        for name in ("s.db", "s.db-wal", "s.db-shm"):
            (tmp_path / name).rename(elsewhere / name)
        with pytest.raises(StoreUnavailable, match="removed"):
            store.commit([raised(an_alarm(2))])
        with pytest.raises(StoreUnavailable, match="removed"):
            store.alarms()
        assert not store.writable()
        path.write_bytes(b"")
        with pytest.raises(StoreUnavailable, match="replaced"):
            store.check()
        for name in ("s.db", "s.db-wal", "s.db-shm"):
            (elsewhere / name).rename(tmp_path / name)
        store.commit([raised(an_alarm(2))])
        assert [alarm.id for alarm in store.alarms()[0]] == [an_alarm(2).id, an_alarm(1).id]


def test_a_locked_database_is_given_up_soon(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        other = sqlite3.connect(tmp_path / "s.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        begin = time.monotonic()
        with pytest.raises(StoreUnavailable, match="locked"):
            store.commit([raised(an_alarm())])
        assert time.monotonic() - begin < 2.0
        other.close()
        store.commit([raised(an_alarm())])


def test_whoever_asks_for_health_does_not_hold_up_a_commit(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store:
        entered, leave = threading.Event(), threading.Event()

        def write() -> None:
            with store._lock:
                entered.set()
                assert leave.wait(10.0)

        busy = threading.Thread(target=write)
        busy.start()
        assert entered.wait(10.0)
        begin = time.monotonic()
        store.check(wait=False)
        assert time.monotonic() - begin < 1.0
        leave.set()
        busy.join()


def test_sqlite_is_as_safe_as_it_says(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/s.db") as store, store._write() as connection:
        pragma = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys")
        }
        assert pragma == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}


@both
def test_what_was_learned_is_kept_as_it_is(store: Store) -> None:
    assert store.commission("village") is None
    assert store.commission_events("village") == []
    other = Kept("town", T0, "{}")
    begun = Happened("village", T0, Step.BEGUN, ("m1", "m2"), None, "")
    store.commit(kept=[Kept("village", T0, '{"a": 1.0}'), other], happened=[begun])
    wish = Happened("village", T0 + 5, Step.RECOMMISSIONED, ("m2",), "Ada", 'm2 replaced; it "hummed"')
    store.commit(kept=[Kept("village", T0 + 5, '{"a": 2.0}')], happened=[wish])
    assert store.commission("village") == Kept("village", T0 + 5, '{"a": 2.0}')
    assert store.commission_events("village") == [begun, wish]
    assert store.commission_events("village", 1) == [wish]
    # A feeder that is deleted is forgotten, what happened to it is not, and others stay.
    store.commit(without="village")
    assert store.commission("village") is None
    assert store.commission_events("village") == [begun, wish]
    assert store.commission("town") == other


@both
def test_a_database_from_before_commissioning_was_kept_is_brought_forward(url: str) -> None:
    with Store(url) as old, old._write() as connection:
        for table in (schema.COMMISSION, schema.COMMISSION_EVENT):
            table.drop(connection)
        connection.execute(schema.VERSION.update().values(version=1))
    with Store(url) as new:
        new.commit(kept=[Kept("village", T0, "{}")])
        assert new.commission("village") == Kept("village", T0, "{}")


@both
def test_older_schemas_are_brought_forward_and_newer_ones_refused(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(url) as one:
        one.commit([raised(an_alarm())])

    def step(connection: object) -> None:
        connection.exec_driver_sql("ALTER TABLE feeder ADD COLUMN note TEXT")  # type: ignore[attr-defined]

    known = schema.MIGRATIONS
    monkeypatch.setattr(schema, "MIGRATIONS", (*known, step))
    for _ in range(2):  # the second time there is nothing left to do, and the step would fail
        with Store(url) as two:
            assert two.alarm(an_alarm().id) == an_alarm()
    monkeypatch.setattr(schema, "MIGRATIONS", known)
    with pytest.raises(StoreUnavailable, match=r"version 3.* too old"):
        Store(url)


def test_a_failed_migration_leaves_the_database_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"sqlite:///{tmp_path}/m.db"
    Store(url).close()

    def step(connection: object) -> None:
        connection.exec_driver_sql("ALTER TABLE feeder ADD COLUMN note TEXT")  # type: ignore[attr-defined]
        connection.exec_driver_sql("nonsense")  # type: ignore[attr-defined]

    known = schema.MIGRATIONS
    monkeypatch.setattr(schema, "MIGRATIONS", (*known, step))
    with pytest.raises(StoreUnavailable, match="syntax error"):
        Store(url)
    monkeypatch.setattr(schema, "MIGRATIONS", known)
    with Store(url) as store:
        store.put_feeder("village", {})
    with sqlite3.connect(tmp_path / "m.db") as raw:
        assert [row[1] for row in raw.execute("PRAGMA table_info(feeder)")] == ["name", "tables"]
    raw.close()


FULL_DISK = """
    import resource, sys
    sys.path.insert(0, {tests!r})
    from service.store import Rejected, Store, StoreUnavailable
    store = Store({url!r})
    bad = [Rejected(0.0, "k" * 500, "r" * 500) for _ in range(100)]
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
    done = 0
    try:
        while True:
            store.commit(rejected=bad)
            done += 1
    except StoreUnavailable as error:
        print(error)
    assert not store.writable() or store.rejected()
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert store.writable()
    assert len(store.rejected(5000)) == 100 * done
    store.commit(rejected=bad)
    assert len(store.rejected(5000)) == 100 * (done + 1)
    store.close()
"""


def test_a_full_disk_is_a_clear_error_and_passes(tmp_path: Path) -> None:
    code = textwrap.dedent(FULL_DISK).format(url=f"sqlite:///{tmp_path}/full.db", tests=str(Path.cwd()))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "cannot write sqlite:///" in done.stdout


@pytest.mark.postgresql
def test_a_restart_of_postgresql_is_survived(cluster: Cluster) -> None:
    with Store(cluster.database()) as store:
        store.commit([raised(an_alarm(1))])
        cluster.stop()
        try:
            assert not store.writable()
            with pytest.raises(StoreUnavailable, match="cannot write"):
                store.commit([raised(an_alarm(2))])
            with pytest.raises(StoreUnavailable, match="cannot read"):
                store.alarms()
        finally:
            cluster.start()
        store.commit([raised(an_alarm(3))])
        assert [a.id for a in store.alarms()[0]] == [an_alarm(3).id, an_alarm(1).id]


WRITER = """
    import sys, uuid
    sys.path.insert(0, {tests!r})
    from dataclasses import replace
    from service.alarms import *
    from service.store import Store
    store = Store({url!r})
    number = store.last_event
    while True:
        number += 1
        alarm = Alarm(uuid.uuid4().hex[:26], AlarmKind.DATA_LOSS, "village", None, Severity.MINOR,
                      AlarmState.RAISED, 1, 0.0, 1.0, None, "", Evidence())
        over = replace(alarm, state=AlarmState.CLEARED, t_cleared=2.0)
        a = store.commit([Transition(alarm, Change.RAISED, 1.0)])
        print(alarm.id, a[0], "raised", flush=True)
        b = store.commit([Transition(over, Change.CLEARED, 2.0)])
        print(alarm.id, b[0], "cleared", flush=True)
"""


@both
def test_nothing_acknowledged_is_lost_by_a_kill(url: str, family: str) -> None:
    code = textwrap.dedent(WRITER).format(url=url, tests=str(Path.cwd()))
    told: dict[int, tuple[str, str]] = {}
    for wanted in (1, 20, 57, 90) if family == "sqlite" else (3, 40):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        lines = []
        with process.stdout:
            for line in process.stdout:
                lines.append(line)
                if len(lines) == wanted:
                    process.send_signal(signal.SIGKILL)
                    break
            lines += process.stdout.readlines()
        assert process.wait(timeout=30) == -signal.SIGKILL
        assert len(lines) >= wanted
        told |= {
            int(number): (name, change)
            for name, number, change in (line.split() for line in lines if line.endswith("\n"))
        }
    with Store(url) as store:
        events = store.events_after(0, limit=1_000_000)
        kept = {event.seq: (event.alarm.id, str(event.change)) for event in events}
        assert told.items() <= kept.items()
        # At most the last transaction before each kill was stored without being told.
        assert len(kept) <= len(told) + 4
        assert {event.seq for event in store.outbox_pending(1_000_000)} == set(kept)
        latest = {event.alarm.id: event.alarm for event in events}
        assert {a.id: a for a in store.alarms(limit=1_000_000)[0]} == latest
