"""The store when it fails: databases that are locked, full, gone, old or killed; and what is kept then."""

from __future__ import annotations

import json
import signal
import sqlite3
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
import sqlalchemy as sa

from service.alarms.state_machine import AlarmState, acknowledged
from service.report.report import FeederReport
from service.store import Store, StoreUnavailable, WriterLost, connect, schema
from service.store.schema import CommissioningChange, CommissioningEvent
from service.store.series import pack
from service.store.state_codec import SnapshotKind, StateSnapshot
from tests.codes import refused
from tests.service.databases import Cluster, both
from tests.service.reports import meter, report
from tests.service.stored import T0, a_report, an_alarm, raised, writable


@pytest.mark.parametrize(
    ("url", "code"),
    [
        ("nonsense", "wrong-address"),
        ("mysql://localhost/x", "unsupported"),
        ("sqlite://", "in-memory"),
        ("sqlite:///:memory:", "in-memory"),
        ("sqlite:////nonexistent-folder/x.db", "open-failed"),
        ("sqlite:////proc/x.db", "open-failed"),
        ("postgresql+psycopg://gridsec:secret@/x?host=/nonexistent-folder", "open-failed"),
    ],
)
def test_a_database_that_cannot_be_used_is_a_clear_error(url: str, code: str) -> None:
    with refused(StoreUnavailable, code) as caught:
        Store(url)
    assert "secret" not in str(caught.value)


def test_a_file_that_is_no_database_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "notes.db"
    path.write_text("These are my notes, not a database. " * 200)
    before = path.read_bytes()
    with refused(StoreUnavailable, "not-a-database"):
        Store(f"sqlite:///{path}")
    assert path.read_bytes() == before


@both
def test_only_one_process_writes(url: str, family: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connect, "LOCK_S", 1.0)
    code = "other-writer" if family == "sqlite" else "database-locked"
    with Store(url), refused(StoreUnavailable, code):
        Store(url)
    with Store(url) as again:
        again.check()


def test_a_database_of_two_names_has_one_writer(tmp_path: Path) -> None:
    (tmp_path / "link.db").symlink_to("gridsec.db")
    file, link = f"sqlite:///{tmp_path}/gridsec.db", f"sqlite:///{tmp_path}/link.db"
    for one, other in ((file, link), (link, file)):
        with Store(one), refused(StoreUnavailable, "other-writer"):
            Store(other)
    assert not (tmp_path / "link.db.lock").exists()


def test_a_writer_whose_lock_was_removed_writes_no_more(tmp_path: Path) -> None:
    """Without its file the lock keeps nobody away: there would be two writers."""
    with Store(f"sqlite:///{tmp_path}/gridsec.db") as first:
        first.commit([raised(an_alarm())])
        (tmp_path / "gridsec.db.lock").unlink()
        with refused(WriterLost, "lock-moved") as caught:
            first.check()
        assert f"{tmp_path}/gridsec.db.lock" in str(caught.value)
        with Store(f"sqlite:///{tmp_path}/gridsec.db") as second:
            second.check()
            with refused(WriterLost, "lock-moved"):
                first.commit([raised(an_alarm(1))])
            assert [alarm.id for alarm in first.active()] == [an_alarm().id]


@both
def test_readers_cannot_write(store: Store) -> None:
    with refused(StoreUnavailable, "read-only"), store._read() as connection:
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
        with refused(StoreUnavailable, "file-removed"):
            store.commit([raised(an_alarm(2))])
        with refused(StoreUnavailable, "file-removed"):
            store.alarms()
        assert not writable(store)
        path.write_bytes(b"")
        with refused(StoreUnavailable, "file-replaced"):
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
        with refused(StoreUnavailable, "database-locked"):
            store.commit([raised(an_alarm())])
        assert time.monotonic() - begin < 2.0
        other.close()
        store.commit([raised(an_alarm())])


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
    other = StateSnapshot("town", T0, "{}")
    begun = CommissioningEvent("village", T0, CommissioningChange.BEGUN, ("m1", "m2"), None, "")
    store.commit(kept=[StateSnapshot("village", T0, '{"a": 1.0}'), other], happened=[begun])
    wish = CommissioningEvent(
        "village", T0 + 5, CommissioningChange.RECOMMISSIONED, ("m2",), "Ada", 'm2 replaced; it "hummed"'
    )
    store.commit(kept=[StateSnapshot("village", T0 + 5, '{"a": 2.0}')], happened=[wish])
    assert store.commission("village") == StateSnapshot("village", T0 + 5, '{"a": 2.0}')
    store.commit(kept=[StateSnapshot("village", T0, "{}", SnapshotKind.DISTRUST)])
    assert store.commission_events("village") == [begun, wish]
    assert store.commission_events("village", 1) == [wish]
    # A feeder that is deleted is forgotten, what happened to it is not, and others stay.
    store.commit(without="village")
    assert (store.commission("village"), store.distrust("village")) == (None, None)
    assert store.commission_events("village") == [begun, wish]
    assert store.commission("town") == other


OLD_LAYOUT = sa.Table(
    "history_layout",
    sa.MetaData(),
    sa.Column("id", schema.SEQ, primary_key=True, autoincrement=True),
    sa.Column("meters", sa.Text, nullable=False, unique=True),
)
"""As it was until version 3."""


def put_back_workers(connection: sa.Connection) -> None:
    """Make a database one of version 7."""
    for table in (schema.WORKER, schema.SHARD, schema.FEEDER_CHANGES, schema.SIGNED, schema.OBSERVER):
        table.drop(connection)
    connection.exec_driver_sql("ALTER TABLE writer DROP COLUMN worker")
    connection.exec_driver_sql("ALTER TABLE feeder DROP COLUMN version")
    connection.execute(schema.VERSION.update().values(version=7))


def put_back_incidents(connection: sa.Connection) -> None:
    """Make a database one of version 5."""
    incidents = (schema.INCIDENT_EVENT, schema.INCIDENT, schema.SHELF, schema.WORK)
    put_back_workers(connection)
    for table in (schema.ROLLUP, *incidents):
        table.drop(connection)
    connection.exec_driver_sql("DROP INDEX alarm_by_incident")
    for column in ("incident", "work", "words"):
        connection.exec_driver_sql(f"ALTER TABLE alarm DROP COLUMN {column}")
    connection.execute(schema.VERSION.update().values(version=5))


@both
def test_alarms_from_before_incidents_get_theirs(url: str) -> None:
    standing, over = an_alarm(1), an_alarm(2, state=AlarmState.CLEARED, t_cleared=T0 + 9)
    later = acknowledged(an_alarm(3, meter="Straße 5"), "Ada", "", T0 + 40)
    with Store(url) as old:
        old.commit([raised(standing), raised(over), raised(an_alarm(3)), later])
        with old._write() as connection:
            put_back_incidents(connection)
    for _ in range(2):
        with Store(url) as new:
            (incident,) = new.incidents()[0]
            assert (incident.alarms, incident.active, incident.unacknowledged) == (2, 2, 1)
            assert [one.id for one in new.alarms_of(incident.id)] == [standing.id, later.alarm.id]
            assert [event.change for event in new.incident_events_after(0)] == ["opened"]
            assert [one.id for one in new.alarms(text="straße")[0]] == [later.alarm.id]


def put_back(connection: sa.Connection, version: int, *later: sa.Table) -> None:
    """Make a database without history one of an earlier version, which did not have the later tables."""
    put_back_incidents(connection)
    for table in (schema.HISTORY, schema.LAYOUT, *later):
        table.drop(connection)
    for table in (OLD_LAYOUT, schema.HISTORY):
        table.create(connection)
    connection.execute(schema.VERSION.update().values(version=version))


@both
def test_a_database_from_before_signed_readings_were_kept_is_brought_forward(url: str) -> None:
    kept = StateSnapshot("village", T0, "{}", SnapshotKind.SIGNED)
    with Store(url) as old, old._write() as connection:
        put_back_workers(connection)
    with Store(url) as new:
        assert new.signed("village") is None
        new.commit(kept=[kept])
        # A deleted feeder that is put again must not accept a repetition.
        new.commit(without="village")
        assert (new.signed("village"), new.distrust("village")) == (kept, None)


@both
def test_a_database_from_before_commissioning_was_kept_is_brought_forward(url: str) -> None:
    with Store(url) as old, old._write() as connection:
        put_back(connection, 1, schema.COMMISSION, schema.COMMISSION_EVENT, schema.DISTRUST, schema.WRITER)
    with Store(url) as new:
        new.commit(kept=[StateSnapshot("village", T0, "{}")])
        assert new.commission("village") == StateSnapshot("village", T0, "{}")


@both
def test_a_database_from_before_suspicions_were_kept_is_brought_forward(url: str) -> None:
    learned, suspected = (
        StateSnapshot("village", T0, "{}"),
        StateSnapshot("village", T0, "[]", SnapshotKind.DISTRUST),
    )
    with Store(url) as old, old._write() as connection:
        old._put_kept(connection, [learned])
        put_back(connection, 2, schema.DISTRUST, schema.WRITER)
    with Store(url) as new:
        assert new.distrust("village") is None
        new.commit(kept=[suspected])
        assert (new.commission("village"), new.distrust("village")) == (learned, suspected)


def of_random_ids(t: float, count: int) -> FeederReport:
    """Meters whose ids no compression makes shorter."""
    random = Random(1)
    meters = tuple(meter(f"{random.getrandbits(128):032x}") for _ in range(count))
    return replace(report(*meters), t=t)


@both
def test_a_feeder_of_many_meters_costs_no_alarm(store: Store) -> None:
    """An index of PostgreSQL takes no text of more than 2704 bytes."""
    assert store.commit([raised(an_alarm())], reports=[of_random_ids(T0, 400)]) == (1,)
    store.commit(reports=[of_random_ids(T0 + 600, 400), of_random_ids(T0 + 1200, 401)])
    assert [tick["seen"] for tick in store.history("village")] == [400, 400, 401]
    with store._read() as connection:
        assert connection.scalar(sa.select(sa.func.count()).select_from(schema.LAYOUT)) == 2


@both
def test_a_database_whose_layouts_had_a_length_is_brought_forward(url: str) -> None:
    reports = [a_report(T0), a_report(T0 + 600, count=4)]
    with Store(url) as old, old._write() as connection:
        put_back(connection, 3, schema.WRITER)
        for number, each in enumerate(reports, 1):
            meters = json.dumps(each.row.meters)
            connection.execute(OLD_LAYOUT.insert().values(meters=meters))
            row = {"feeder": "village", "t": each.t, "verdict": "clean", "cause": "agreement"}
            connection.execute(schema.HISTORY.insert().values(**row, layout=number, data=pack(each.row)))
    with Store(url) as new:
        new.commit(reports=[replace(each, t=each.t + 6000) for each in reports])
        new.commit([raised(an_alarm())], reports=[of_random_ids(T0 + 9000, 400)])
        assert new.alarm(an_alarm().id) == an_alarm()
        assert [tick["seen"] for tick in new.history("village")] == [2, 3, 2, 3, 400]
        with new._read() as connection:
            found = connection.execute(sa.select(schema.HISTORY.c.layout).order_by(schema.HISTORY.c.t))
            assert [number for (number,) in found] == [1, 2, 1, 2, 3]


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
    with refused(StoreUnavailable, "newer-schema") as caught:
        Store(url)
    assert f"versions up to {1 + len(known)}" in str(caught.value)


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
    with refused(StoreUnavailable, "open-failed") as caught:
        Store(url)
    assert 'near "nonsense"' in str(caught.value)
    monkeypatch.setattr(schema, "MIGRATIONS", known)
    with Store(url) as store:
        store.commit(put=("village", {}))
    with sqlite3.connect(tmp_path / "m.db") as raw:
        assert "note" not in [row[1] for row in raw.execute("PRAGMA table_info(feeder)")]
    raw.close()


FULL_DISK = """
    import resource, sys
    sys.path.insert(0, {tests!r})
    from service.store import Rejected, Store, StoreUnavailable
    from tests.service.stored import writable
    store = Store({url!r})
    bad = [Rejected(0.0, "k" * 500, "r" * 500) for _ in range(100)]
    resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, resource.RLIM_INFINITY))
    done = 0
    try:
        while True:
            store.commit(rejected=bad)
            done += 1
    except StoreUnavailable as error:
        print(error)
    # What was too large left room for something small.
    assert done and writable(store)
    assert len(store.rejected(5000)) == 100 * done
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    assert not writable(store)
    assert len(store.rejected(5000)) == 100 * done
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert writable(store)
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
            assert not writable(store)
            with refused(StoreUnavailable, "write-failed"):
                store.commit([raised(an_alarm(2))])
            with refused(StoreUnavailable, "read-failed"):
                store.alarms()
        finally:
            cluster.start()
        store.commit([raised(an_alarm(3))])
        assert [a.id for a in store.alarms()[0]] == [an_alarm(3).id, an_alarm(1).id]


WRITER = """
    import sys, uuid
    sys.path.insert(0, {tests!r})
    from dataclasses import replace
    from service.alarms.state_machine import *
    from service.store import Store
    store = Store({url!r})
    number = store.last_event
    while True:
        number += 1
        alarm = Alarm(uuid.uuid4().hex[:26], AlarmKind.DATA_LOSS, "village", None, Severity.MINOR,
                      AlarmState.RAISED, 1, 0.0, 1.0, None, "", AlarmEvidence(), None, None, None)
        over = replace(alarm, state=AlarmState.CLEARED, t_cleared=2.0)
        a = store.commit([AlarmTransition(alarm, Change.RAISED, 1.0)])
        print(alarm.id, a[0], "raised", flush=True)
        b = store.commit([AlarmTransition(over, Change.CLEARED, 2.0)])
        print(alarm.id, b[0], "cleared", flush=True)
"""


GROUPER = """
    import sys, time
    sys.path.insert(0, {tests!r})
    from dataclasses import replace
    from service.alarms.state_machine import *
    from service.store import Store
    from tests.service.stored import an_alarm, raised
    store = Store({url!r})
    number = 1000 * store.last_event
    while True:
        number += 100
        alarms = [an_alarm(number + k, t_event=number + k, t_raised=number + k) for k in range(3)]
        store.commit([raised(alarm) for alarm in alarms])
        print(number, flush=True)
        over = [replace(alarm, state=AlarmState.CLEARED, t_cleared=number + 5.0) for alarm in alarms]
        store.commit([AlarmTransition(alarm, Change.CLEARED, number + 5.0) for alarm in over])
        print(number, flush=True)
"""


@pytest.mark.acceptance
@both
def test_a_kill_loses_and_doubles_no_incident(url: str) -> None:
    """Each alarm has one incident with the right numbers; events and states agree; a restart goes on."""
    code = textwrap.dedent(GROUPER).format(url=url, tests=str(Path.cwd()))
    for wanted in (1, 4):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        with process.stdout:
            for number, _ in enumerate(process.stdout, 1):
                if number == wanted:
                    process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=30) == -signal.SIGKILL
    with Store(url) as store:
        alarms = store.alarms(limit=1000)[0]
        incidents = {one.id: one for one in store.incidents(limit=1000)[0]}
        assert len(incidents) == len(alarms) / 3 >= 3
        home = {name: mark.incident for name, mark in store.alarm_marks(one.id for one in alarms).items()}
        for name, incident in incidents.items():
            own = [one for one in alarms if home[one.id] == name]
            assert (incident.alarms, incident.active) == (3, sum(one.active for one in own))
            events = store.incident_events(name)
            assert events[-1].incident == incident
            changes = ["opened"] if incident.open else ["opened", "cleared"]
            assert [str(event.change) for event in events] == changes
        numbers = [event.seq for event in store.incident_events_after(0, limit=1000)]
        assert numbers == sorted(set(numbers))


@pytest.mark.canary("postgresql")
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
