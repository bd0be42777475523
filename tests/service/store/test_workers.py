"""Stores of several workers: each writes the feeders of its leases, and readers miss no event."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from multiprocessing.synchronize import Barrier
from random import Random
from typing import Any

import psycopg
import pytest
import sqlalchemy as sa

from service.alarms.incidents import Shelf
from service.metrics import Metrics
from service.store import HistoryRules, Rejected, Store, StoreUnavailable, WriterLost, connect, leases, schema
from service.store import store as store_module
from service.store.committer import Committer
from service.store.leases import Leases
from service.store.schema import LeaseLost
from service.store.state_codec import StateSnapshot
from tests.codes import refused
from tests.service.databases import Cluster
from tests.service.store.test_leases import settle
from tests.service.store.test_store_failures import put_back_workers
from tests.service.stored import T0, a_report, an_alarm, raised

pytestmark = pytest.mark.postgresql
NAMES = [f"f{k}" for k in range(40)]


@pytest.fixture
def url(cluster: Cluster) -> str:
    return cluster.database()


class Worker:
    """A worker with its store; all workers of a test divide the shards."""

    def __init__(self, url: str, name: str) -> None:
        self.leases = Leases(url, name)
        self.leases.register()
        self.store = Store(url, leases=self.leases)

    def feeders(self, count: int = 1) -> list[str]:
        """Feeders of its shards."""
        return [name for name in NAMES if self.store.mine(name)][:count]

    def close(self) -> None:
        self.store.close()
        self.leases.close()


Join = Callable[..., list[Worker]]


@pytest.fixture
def join(url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Join]:
    monkeypatch.setattr(leases, "SETTLE_S", 0.0)
    with ExitStack() as stack:

        def made(*names: str) -> list[Worker]:
            workers = [Worker(url, name) for name in names]
            for worker in workers:
                stack.callback(worker.close)
            settle(*(worker.leases for worker in workers))
            return workers

        yield made


def hand_over(url: str, loser: Worker, winner: Worker) -> None:
    """End the session of a worker's leases; another one claims them, and the first does not know."""
    held = loser.leases.held
    with psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as admin:
        admin.execute("UPDATE worker SET until = 0 WHERE name = %s", (loser.leases.worker,))
    winner.leases.claim()
    time.sleep(1.1 * leases.GRACE_S)
    winner.leases.claim()
    assert winner.leases.held.keys() >= held.keys()


def contents(url: str) -> dict[str, list[tuple[object, ...]]]:
    """All rows that a worker writes."""
    engine = sa.create_engine(url)
    tables = [table for table in schema.META.sorted_tables if table.name not in {"worker", "shard"}]
    with engine.connect() as connection:
        found = {t.name: sorted(map(tuple, connection.execute(sa.select(t))), key=repr) for t in tables}
    engine.dispose()
    return found


def test_workers_write_their_own_feeders(join: Join) -> None:
    workers = join("a", "b", "c")
    for k, worker in enumerate(workers):
        (feeder,) = worker.feeders()
        report = replace(a_report(T0), feeder=feeder)
        numbers = worker.store.commit(
            [raised(an_alarm(k, feeder=feeder))],
            reports=[report],
            rejected=[Rejected(T0, "k", "r")],
            kept=[StateSnapshot(feeder, T0, "{}")],
            put=(feeder, {"meta": {"name": feeder}}),
            key=1,
        )
        assert numbers == (k + 1,)
    for worker in workers:
        assert len(worker.store.active()) == len(worker.store.feeders()) == 3
        (pending,) = worker.store.outbox_pending()
        assert worker.store.mine(pending.alarm.feeder)
        (event,) = worker.store.incidents_unpublished()
        assert worker.store.mine(event.incident.feeder)
        assert worker.store.commit(key=1) == ()
    with workers[0].store._read() as connection:
        assert connection.scalar(sa.select(sa.func.count()).select_from(schema.LAYOUT)) == 1


def test_a_worker_without_the_lease_writes_nothing(url: str, join: Join) -> None:
    first, second = join("a", "b")
    (feeder,), (other,) = first.feeders(), second.feeders()
    first.store.commit([raised(an_alarm(feeder=feeder))])
    (pending,) = first.store.outbox_pending()
    hand_over(url, first, second)
    before = contents(url)
    report = replace(a_report(T0), feeder=feeder)
    held = first.leases.held
    attempts: list[dict[str, object]] = [
        {"transitions": [raised(an_alarm(1, feeder=feeder))]},
        {"reports": [report]},
        {"kept": [StateSnapshot(feeder, T0, "{}")]},
        {"put": (feeder, {})},
        {"without": feeder},
        {"put": (other, {})},
    ]
    for number, attempt in enumerate(attempts, 1):
        first.leases._held = dict(held)
        with refused(LeaseLost, "lease-lost"):
            first.store.commit(**attempt, rejected=[Rejected(T0, "k", "r")], key=number)  # type: ignore[arg-type]
    first.leases._held = dict(held)
    first.store.outbox_done([pending.seq])
    first.store.incidents_published([1])
    assert contents(url) == before
    assert not first.store.mine(feeder)
    second.store.commit([raised(an_alarm(1, feeder=feeder))], reports=[report])
    assert first.leases.renew() == set(held.values())


def test_the_next_owner_publishes_the_outbox(url: str, join: Join) -> None:
    first, second = join("a", "b")
    (feeder,), (other,) = first.feeders(), second.feeders()
    assert first.store.take_over() == second.store.take_over() == ([], [])
    first.store.commit([raised(an_alarm(1, feeder=feeder))])
    second.store.commit([raised(an_alarm(2, feeder=other))])
    hand_over(url, first, second)
    assert second.store.due(0.0)
    alarms, incidents = second.store.take_over()
    assert [event.alarm.feeder for event in alarms] == [feeder]
    assert [event.incident.feeder for event in incidents] == [feeder]
    assert second.store.take_over() == ([], [])
    second.store.commit()
    assert not second.store.due(0.0)
    second.store.outbox_done([event.seq for event in alarms])
    assert [event.alarm.feeder for event in second.store.outbox_pending()] == [other]


def committer_of(store: Store, published: list[str]) -> Committer:
    made = Committer(store, Metrics(), lambda: None, lambda _: None)
    made._publish_waiting()

    class Publisher:
        def event(self, key: str, _payload: bytes, *, done: Callable[[], None], **_: object) -> bool:
            published.append(key)
            done()
            return True

    made.publisher = Publisher()  # type: ignore[assignment]
    return made


def test_a_committer_drops_lost_feeders_and_publishes_those_taken_over(url: str, join: Join) -> None:
    first, second = join("a", "b")
    (feeder,), (other,) = first.feeders(), second.feeders()
    mine: list[str] = []
    theirs: list[str] = []
    one, two = committer_of(first.store, mine), committer_of(second.store, theirs)
    one.publisher = None
    two.waiting.add(transitions=[raised(an_alarm(2, feeder=other))])
    for _ in range(3):
        one.commit()
        two.commit()
    assert [key.split("/")[:2] for key in theirs] == [[other, "alarm"], [other, "incident"]]
    first.store.commit([raised(an_alarm(1, feeder=feeder))])
    held = first.leases.held
    hand_over(url, first, second)
    for _ in range(3):
        two.commit()
    assert [key.split("/")[:2] for key in theirs[2:]] == [[feeder, "alarm"], [feeder, "incident"]]
    assert second.store.outbox_pending() == second.store.incidents_unpublished() == []
    # The earlier owner still believes in its lease: its data go, and nothing else is wrong.
    assert held == first.leases.held
    one.waiting.add(transitions=[raised(an_alarm(3, feeder=feeder))])
    one.commit()
    assert (one.problem, len(one.waiting)) == (None, 1)
    one.commit()
    assert len(one.waiting) == 0
    assert [alarm.id for alarm in first.store.active(feeder)] == [an_alarm(1).id]


def lose_the_answer(store: Store) -> None:
    """Break the connection of the writer after its next commit has been executed."""
    dialect: Any = store._connections._engines[0].dialect
    commit = dialect.do_commit

    def do_commit(connection: Any) -> None:
        dialect.do_commit = commit
        commit(connection)
        connection.dbapi_connection.close()
        raise psycopg.OperationalError("the connection is closed")

    dialect.do_commit = do_commit


def test_a_claim_before_a_repeated_commit_changes_no_number(url: str, join: Join) -> None:
    first, second = join("a", "b")
    (feeder,), (other,) = first.feeders(), second.feeders()
    theirs: list[str] = []
    committer = committer_of(second.store, theirs)
    committer.commit()
    committer.waiting.add(transitions=[raised(an_alarm(k, feeder=other)) for k in (1, 2)])
    lose_the_answer(second.store)
    committer.commit()
    assert committer.problems()
    first.store.commit([raised(an_alarm(3, feeder=feeder))])
    hand_over(url, first, second)
    for _ in range(3):
        committer.commit(at_once=True)
    assert committer.problem is None
    alarms = [key.split("/")[0] for key in theirs if "/alarm/" in key]
    assert sorted(alarms) == sorted([feeder, other, other])
    assert (second.store.outbox_pending(), second.store.incidents_unpublished()) == ([], [])
    assert len(second.store.active()) == 3


def test_shelves_end_with_the_owner_of_their_feeder(url: str, join: Join) -> None:
    first, second = join("a", "b")
    (feeder,) = first.feeders()
    alarm = an_alarm(1, feeder=feeder)
    first.store.commit([raised(alarm)], now=T0 + 1)
    shelf = Shelf(
        "S" * 26, feeder, alarm.id, None, None, None, alarm.severity, "Ada", "", t=T0 + 2, until=T0 + 10
    )
    first.store.commit(actions=[shelf], now=T0 + 2)
    assert first.store.due(T0 + 11)
    second.store.commit(now=T0 + 11)
    assert not second.store.due(T0 + 11)
    assert first.store.shelves(standing=True)
    hand_over(url, first, second)
    assert second.store.due(T0 + 11)
    second.store.commit(now=T0 + 11)
    assert second.store.shelves(standing=True) == []


def test_a_failed_commit_does_not_hide_the_shelves_of_new_feeders(url: str, join: Join) -> None:
    first, second = join("a", "b")
    (feeder,) = first.feeders()
    alarm = an_alarm(1, feeder=feeder)
    shelf = Shelf(
        "S" * 26, feeder, alarm.id, None, None, None, alarm.severity, "Ada", "", t=T0 + 2, until=T0 + 10
    )
    first.store.commit([raised(alarm)], actions=[shelf], now=T0 + 2)
    second.store.commit(now=T0 + 2)
    hand_over(url, first, second)
    with psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as admin:
        admin.execute("ALTER TABLE shelf RENAME TO away")
        with refused(StoreUnavailable, "write-failed"):
            second.store.commit(now=T0 + 3)
        admin.execute("ALTER TABLE away RENAME TO shelf")
    assert second.store.due(T0 + 3)
    second.store.commit(now=T0 + 3)
    assert not second.store.due(T0 + 3)
    second.store.commit(now=T0 + 11)
    assert second.store.shelves(standing=True) == []


def test_feeders_over_rest_are_seen_by_all(join: Join) -> None:
    first, second = join("a", "b")
    (feeder,) = first.feeders()
    seen = [second.store.feeder_changes()]
    for change in ({"put": (feeder, {"a": 1})}, {"put": (feeder, {"a": 2})}, {"without": feeder}):
        before = second.store.feeder_versions().get(feeder)
        first.store.commit(**change)  # type: ignore[arg-type]
        seen.append(second.store.feeder_changes())
        assert second.store.feeder_versions().get(feeder) != before
    assert seen == sorted(set(seen))
    assert second.store.feeders() == {}


def test_the_history_of_another_worker_is_not_pruned(join: Join) -> None:
    first, second = join("a", "b")
    (mine, silent), (other,) = first.feeders(2), second.feeders()
    rules = HistoryRules(step_s=0.0, keep_s=100.0)
    first.store._history_rules = second.store._history_rules = rules
    second.store.commit(reports=[replace(a_report(T0), feeder=other)])
    first.store.commit(reports=[replace(a_report(T0), feeder=silent)])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_module, "_PRUNE_EVERY", 1)
        first.store._marks.clear()
        for k in range(40):
            first.store.commit(reports=[replace(a_report(T0 + 10.0 * k), feeder=mine)])
    assert first.store.history(silent) == []
    assert len(first.store.history(other)) == 1
    assert len(first.store.history(mine)) < 20


def test_an_observer_reads_and_writes_nothing(url: str, join: Join) -> None:
    (worker,) = join("a")
    with Leases(url, "front") as observer, Store(url, leases=observer) as front:
        worker.store.commit([raised(an_alarm())])
        assert [event.seq for event in front.events_after(0)] == [1]
        assert front.last_event == 0
        front.refresh()
        assert (front.last_event, front.last_incident_event) == (1, 1)
        with refused(StoreUnavailable, "read-only"):
            front.commit([raised(an_alarm(2))])
        with refused(StoreUnavailable, "read-only"):
            front.check()
        assert front.lost is None


# --------------------------------------------------- beside a service without workers


def test_a_service_without_workers_ends_all_leases(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "SETTLE_S", 0.0)
    monkeypatch.setattr(connect, "LOCK_S", 0.2)
    monkeypatch.setattr(connect, "RELOCK_S", 0.1)
    worker = Worker(url, "a")
    settle(worker.leases)
    with refused(StoreUnavailable, "workers-running"):
        Store(url)
    # Its sessions end, as those of a stopped process, and a service without workers comes and goes.
    end_sessions(url)
    with Store(url) as alone, refused(StoreUnavailable, "single-process"):
        alone.commit([raised(an_alarm(1))])
        Store(url, leases=worker.leases)
    with refused(WriterLost, "other-writer"):
        worker.store.commit([raised(an_alarm(2))])
    assert len(worker.leases.renew()) == leases.SHARDS
    assert [alarm.id for alarm in worker.store.active()] == [an_alarm(1).id]
    worker.close()


def end_sessions(url: str) -> None:
    others = "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"
    with psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as admin:
        admin.execute(f"{others} AND datname = current_database()")


def test_a_worker_goes_on_after_the_end_of_its_sessions(url: str, join: Join) -> None:
    (worker,) = join("a")
    for k in range(2):
        worker.store.commit([raised(an_alarm(k))], key=k + 1)
        end_sessions(url)
    assert worker.leases.renew() == set()
    worker.store.commit([raised(an_alarm(2))], key=3)
    assert len(worker.store.active()) == 3


# --------------------------------------------------------------------- migration


def test_an_old_database_is_migrated_once_by_workers_that_open_it_at_once(url: str) -> None:
    with Store(url) as old, old._write() as connection:
        put_back_workers(connection)
    problems: list[Exception] = []

    def open_it(name: str) -> None:
        try:
            Leases(url, name).close()
        except StoreUnavailable as error:
            problems.append(error)

    threads = [threading.Thread(target=open_it, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert problems == []
    with Store(url) as new:
        assert (new.feeder_changes(), new.feeder_versions()) == (0, {})


def test_a_worker_goes_on_after_a_newer_one_has_migrated(
    url: str, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    def step(connection: sa.Connection) -> None:
        for table in ("alarm", "event", "incident", "incident_event", "history", "feeder", "worker", "shard"):
            connection.exec_driver_sql(f"ALTER TABLE {table} ADD COLUMN note TEXT")
            connection.exec_driver_sql(f"ALTER TABLE {table} ADD COLUMN size BIGINT NOT NULL DEFAULT 7")
        connection.exec_driver_sql("CREATE TABLE later (id BIGINT PRIMARY KEY)")

    (old,) = join("old")
    feeder = old.feeders()[0]
    old.store.commit([raised(an_alarm(1, feeder=feeder))], key=1)
    known = schema.MIGRATIONS
    monkeypatch.setattr(schema, "MIGRATIONS", (*known, step))
    (new,) = join("new")
    monkeypatch.setattr(schema, "MIGRATIONS", known)
    settle(old.leases, new.leases)
    for k, worker in enumerate((old, new), 2):
        (own,) = worker.feeders()
        report = replace(a_report(T0), feeder=own)
        worker.store.commit([raised(an_alarm(k, feeder=own))], reports=[report], put=(own, {}), key=k)
        worker.store.outbox_done([event.seq for event in worker.store.outbox_pending()])
        assert worker.leases.renew() == set()
    assert len(old.store.active()) == len(new.store.active()) == 3
    assert len(old.store.feeders()) == 2
    with refused(StoreUnavailable, "newer-schema"):
        Leases(url, "older")


# ------------------------------------------------------------------ numbers of events


class Follower:
    """A reader that follows the numbers of events, as streams and notifications do."""

    def __init__(self, url: str) -> None:
        self.seen: list[int] = []
        self._leases = Leases(url, "follower")
        self._store = Store(url, leases=self._leases)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._follow)
        self._thread.start()

    def _follow(self) -> None:
        last, done = 0, False
        while True:
            page = self._store.events_after(last, limit=1000)
            self.seen += [event.seq for event in page]
            if page:
                last = page[-1].seq
            elif done:
                return
            else:
                time.sleep(0.001)
            done = self._done.is_set()

    def missed(self) -> int:
        """Stop; return the number of events that it has not seen."""
        self._done.set()
        self._thread.join()
        with self._store._read() as connection:
            stored = set(connection.scalars(sa.select(schema.EVENT.c.seq)))
        self._store.close()
        self._leases.close()
        assert len(self.seen) == len(set(self.seen))
        return len(stored - set(self.seen))


def write_events(worker: Worker, first: int, commits: int) -> None:
    """Store commits of one to three events. Some wait before the end of their transaction."""
    random = Random(first)
    alarms = [an_alarm(first + k, feeder=feeder) for k, feeder in enumerate(worker.feeders(8))]
    original = worker.store._put_events

    def slow(*arguments: object) -> tuple[tuple[int, ...], int]:
        found = original(*arguments)  # type: ignore[arg-type]
        if random.random() < 0.2:
            time.sleep(0.004 * random.random())
        return found

    worker.store._put_events = slow  # type: ignore[method-assign,assignment]
    for count in range(1, commits + 1):
        chosen = random.sample(alarms, random.randint(1, 3))
        with suppress(StoreUnavailable):
            worker.store.commit([raised(replace(alarm, count=count)) for alarm in chosen])


def run_threads(url: str, workers: list[Worker], commits: int) -> tuple[int, int]:
    """Write with one thread for each worker; return the numbers of missed and of seen events."""
    follower = Follower(url)
    threads = [
        threading.Thread(target=write_events, args=(worker, 100_000 * k, commits))
        for k, worker in enumerate(workers, 1)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return follower.missed(), len(follower.seen)


def test_a_reader_that_follows_misses_no_event(url: str, join: Join) -> None:
    missed, seen = run_threads(url, join("a", "b", "c", "d"), 20)
    assert (missed, seen > 100) == (0, True)


@pytest.mark.acceptance
def test_a_reader_misses_events_without_the_lock(
    url: str, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Store, "_numbering", staticmethod(sa.null))
    missed, seen = run_threads(url, join("a", "b", "c", "d"), 300)
    print(f"{missed} events missed, {seen} seen")
    assert missed > 0


def write_in_process(url: str, name: str, first: int, commits: int, together: Barrier) -> None:
    leases.SETTLE_S = 2.0  # type: ignore[misc]
    worker = Worker(url, name)
    ended = threading.Event()

    def keep() -> None:
        while not ended.wait(0.5):
            with suppress(StoreUnavailable):  # On a busy machine a transaction may be too slow.
                worker.leases.renew()

    thread = threading.Thread(target=keep)
    thread.start()
    end = time.monotonic() + 60.0
    while len(worker.leases.held) != leases.SHARDS // 4:
        assert time.monotonic() < end
        with suppress(StoreUnavailable):
            worker.leases.release(worker.leases.excess())
            worker.leases.claim()
        time.sleep(0.1)
    together.wait(60.0)
    write_events(worker, first, commits)
    together.wait(120.0)
    ended.set()
    thread.join()
    worker.close()


@pytest.mark.acceptance
def test_a_reader_misses_no_event_of_four_processes(url: str) -> None:
    spawn = multiprocessing.get_context("spawn")
    follower, together = Follower(url), spawn.Barrier(4)
    processes = [
        spawn.Process(target=write_in_process, args=(url, name, 100_000 * k, 300, together))
        for k, name in enumerate("abcd", 1)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(timeout=240.0)
    assert [process.exitcode for process in processes] == [0, 0, 0, 0]
    assert follower.missed() == 0
    assert len(follower.seen) > 2000
