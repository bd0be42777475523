"""Leases of shards: one owner for each, even distribution, fail-over, and the check of epochs."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from random import Random

import psycopg
import pytest
import sqlalchemy as sa

from service.store import Store, StoreUnavailable, connect, leases
from service.store.leases import SHARDS, Lease, Leases, clock_problem, shard_of
from service.store.schema import LeaseLost
from tests.codes import refused
from tests.service.databases import Cluster
from tests.service.running import until

pytestmark = pytest.mark.postgresql


@pytest.fixture
def url(cluster: Cluster) -> str:
    return cluster.database()


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "SETTLE_S", 0.0)


Join = Callable[..., Leases]


@pytest.fixture
def join(url: str, request: pytest.FixtureRequest) -> Iterator[Join]:
    """Register workers; each is closed at the end."""
    request.getfixturevalue("at_once")
    with ExitStack() as stack:

        def made(name: str, weights: dict[str, float] | None = None) -> Leases:
            worker = stack.enter_context(Leases(url, name, weights=weights))
            worker.register()
            return worker

        yield made


def terminate_leases(url: str, *, but: int = 0) -> None:
    """End the sessions of leases, except the newest `but`."""
    query = (
        "SELECT pg_terminate_backend(pid, 5000) FROM (SELECT pid FROM pg_stat_activity WHERE datname = "
        "current_database() AND application_name = 'gridsec leases' ORDER BY backend_start DESC OFFSET %s) s"
    )
    with psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as admin:
        admin.execute(query, (but,))


def settle(*workers: Leases) -> int:
    """Claim and release until nothing changes; return the number of released shards with feeders."""
    moved = 0
    while True:
        changed = [worker.claim() for worker in workers]
        for worker in workers:
            excess = worker.excess()
            moved += sum(worker._weights[shard] > 1 for shard in excess)
            worker.release(excess)
            changed.append([Lease(shard, 0) for shard in excess])
        if not any(changed):
            return moved


def load(worker: Leases, feeders: dict[str, float]) -> float:
    return sum(weight for feeder, weight in feeders.items() if worker.lease_of(feeder))


def disjoint(*workers: Leases) -> bool:
    """True if each shard has exactly one owner, in the workers and in the database."""
    held = [shard for worker in workers for shard in worker.held]
    owners = {shard: owner.worker for shard, owner in workers[0].owners().items()}
    return sorted(held) == list(range(SHARDS)) and all(
        owners[shard] == worker.worker for worker in workers for shard in worker.held
    )


# ------------------------------------------------------------------ distribution


def test_the_shard_of_a_feeder_never_changes() -> None:
    assert [shard_of(name) for name in ("village", "town", "")] == [184, 62, 20]
    counts = [0] * SHARDS
    for k in range(20_000):
        counts[shard_of(f"feeder-{k}")] += 1
    assert 40 < min(counts) <= max(counts) < 125


def test_the_clock_is_that_of_the_database(join: Join, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = join("a")

    def ahead() -> float:
        with psycopg.connect(url.replace("+psycopg", "")) as other:
            row = other.execute("SELECT extract(epoch FROM clock_timestamp())").fetchone()
        assert row is not None
        return worker.clock() - float(row[0])

    assert abs(ahead()) < 0.5
    # A leap of the database is found by the next call.
    monkeypatch.setattr(leases, "_NOW", leases._NOW - 3600.0)
    worker.live_workers()
    assert abs(ahead() + 3600.0) < 0.5


@pytest.mark.parametrize(("ahead_s", "found"), [(3600.0, "3600 s ahead of"), (-31.0, "31 s behind")])
def test_a_wrong_clock_is_a_problem(ahead_s: float, found: str) -> None:
    assert found in (clock_problem(1e9 + ahead_s, 1e9) or "")
    assert clock_problem(1e9 + 0.1 * ahead_s / abs(ahead_s), 1e9) is None


def test_one_worker_holds_all(join: Join) -> None:
    worker = join("a")
    claimed = worker.claim()
    assert claimed == [Lease(shard, 1) for shard in range(SHARDS)] == sorted(worker.held.values())
    assert (worker.claim(), worker.renew(), worker.excess()) == ([], set(), [])
    assert worker.live_workers() == ["a"]
    assert set(worker.owners()) == set(range(SHARDS))


@pytest.mark.canary("2")
@pytest.mark.parametrize("seed", range(3))
def test_weights_are_even_and_each_shard_has_one_owner(join: Join, seed: int) -> None:
    random = Random(seed)
    feeders = {f"f{k}": random.choice([0.5, 1.0, 4.0]) for k in range(120)}
    heaviest = max(sum(w for f, w in feeders.items() if shard_of(f) == s) for s in range(SHARDS))
    workers = [join(name, feeders) for name in "abc"]
    assert settle(*workers) == 0
    assert disjoint(*workers)
    loads = [load(worker, feeders) for worker in workers]
    assert max(loads) - min(loads) <= heaviest
    # A further worker receives its part; hardly more shards with feeders move than it then has.
    workers.append(join("d", feeders))
    moved = settle(*workers)
    assert disjoint(*workers)
    loads = [load(worker, feeders) for worker in workers]
    assert max(loads) - min(loads) <= heaviest
    received = {shard_of(feeder) for feeder in feeders if workers[3].lease_of(feeder)}
    assert 0 < moved <= len(received) + 3


def test_shards_with_feeders_move_one_after_the_other(join: Join) -> None:
    feeders = {f"f{k}": 1.0 for k in range(8)}
    first = join("a", feeders)
    first.claim()
    second = join("b", feeders)
    occupied = {shard_of(feeder) for feeder in feeders}
    for _ in range(4):
        excess = first.excess()
        assert len(occupied & set(excess)) == 1
        first.release(excess)
        second.claim()
    assert not occupied & set(first.excess())
    assert load(first, feeders) == load(second, feeders) == 4.0


def test_all_workers_of_a_start_get_their_part(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "SETTLE_S", 0.3)
    with Leases(url, "a") as first, Leases(url, "b") as second:
        first.register()
        assert first.claim() == []
        second.register()
        until(first.claim, "the first claim")
        assert len(first.held) == SHARDS // 2
        assert len(second.claim()) == SHARDS // 2


def test_claims_at_once_give_each_shard_one_owner(join: Join) -> None:
    workers = [join(name) for name in "abcd"]
    threads = [threading.Thread(target=worker.claim) for worker in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    settle(*workers)
    assert disjoint(*workers)


def test_epochs_increase_with_every_claim(join: Join) -> None:
    worker = join("a")
    worker.claim()
    worker.release([3])
    assert worker.owners().keys() == set(range(SHARDS)) - {3}
    assert worker.claim() == [Lease(3, 2)]


# --------------------------------------------------------------------- fail-over


WORKER = """
    import sys, time
    from service.store import leases
    leases.SETTLE_S, leases.EXPIRY_S = 0.0, float(sys.argv[2])
    with leases.Leases(sys.argv[1], "other") as worker:
        worker.register()
        worker.claim()
        print(len(worker.held), flush=True)
        while True:
            time.sleep(0.1)
            lost = worker.renew()
            if lost:
                print(len(lost), flush=True)
                sys.exit(7)
"""


@contextmanager
def process(url: str, expiry_s: float) -> Iterator[subprocess.Popen[str]]:
    """Run a worker that holds all shards."""
    made = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(WORKER), url, str(expiry_s)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path.cwd(),
    )
    try:
        assert made.stdout is not None
        assert made.stdout.readline() == f"{SHARDS}\n"
        yield made
    finally:
        made.send_signal(signal.SIGCONT)
        made.kill()
        made.communicate()


def wait_for_all(worker: Leases) -> float:
    """Poll as a worker does; return the time until it holds all shards, s."""
    began = time.monotonic()
    while len(worker.held) < SHARDS:
        worker.renew()
        worker.claim()
        assert time.monotonic() - began < 20.0
        time.sleep(leases.POLL_S)
    return time.monotonic() - began


@pytest.mark.acceptance
@pytest.mark.usefixtures("at_once")
def test_the_shards_of_a_killed_process_are_claimed(url: str) -> None:
    with process(url, leases.EXPIRY_S) as other, Leases(url, "b") as worker:
        worker.register()
        assert worker.claim() == []
        other.kill()
        assert wait_for_all(worker) < leases.GRACE_S + 3.0 * leases.POLL_S + 1.0
        assert {lease.epoch for lease in worker.held.values()} == {2}


@pytest.mark.acceptance
@pytest.mark.usefixtures("at_once")
def test_the_shards_of_a_stopped_process_are_claimed_and_it_learns_that(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "EXPIRY_S", 0.6)
    with process(url, 0.6) as other, Leases(url, "b") as worker:
        worker.register()
        other.send_signal(signal.SIGSTOP)
        assert 0.5 < wait_for_all(worker) < 4.0
        other.send_signal(signal.SIGCONT)
        assert other.stdout is not None
        assert other.stdout.readline() == f"{SHARDS}\n"
        assert other.wait(timeout=5.0) == 7


@pytest.mark.acceptance
@pytest.mark.usefixtures("at_once")
def test_a_stopped_process_is_replaced_after_its_expiry(url: str) -> None:
    with process(url, leases.EXPIRY_S) as other, Leases(url, "b") as worker:
        worker.register()
        other.send_signal(signal.SIGSTOP)
        assert leases.EXPIRY_S - 1.0 < wait_for_all(worker) < leases.EXPIRY_S + leases.GRACE_S + 2.0


def test_a_worker_that_reconnects_at_once_keeps_its_shards(url: str, join: Join) -> None:
    first, second = join("a"), join("b")
    settle(first, second)
    before = dict(first.held)
    terminate_leases(url, but=1)
    assert second.claim() == []
    assert second.live_workers() == ["b"]
    assert first.claim() == []
    assert second.live_workers() == ["a", "b"]
    time.sleep(1.2 * leases.GRACE_S)
    assert second.claim() == []
    assert (first.renew(), first.held) == (set(), before)


def test_a_restart_of_the_server_moves_no_shard(
    cluster: Cluster, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "EXPIRY_S", 0.5)
    first, second = join("a"), join("b")
    settle(first, second)
    before = dict(first.held), dict(second.held)
    cluster.stop()
    try:
        with pytest.raises(StoreUnavailable):
            first.renew()
        time.sleep(0.5)
        assert not first.fresh
    finally:
        cluster.start()
    # The second worker reconnects later than the grace of an absence.
    assert (first.renew(), first.claim()) == (set(), [])
    time.sleep(1.2 * leases.GRACE_S)
    assert first.claim() == []
    for worker in (first, second):
        assert (worker.renew(), worker.claim()) == (set(), [])
        assert worker.fresh
    assert (first.held, second.held) == before


def test_absent_workers_lose_their_shards_after_a_restart_of_the_server(
    cluster: Cluster, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "EXPIRY_S", 0.4)
    monkeypatch.setattr(leases, "RETURN_S", 2.0)
    first, second = join("a"), join("b")
    settle(first, second)
    cluster.stop()
    cluster.start()
    began = time.monotonic()
    with contextlib.suppress(StoreUnavailable):
        first.renew()
    assert first.renew() == set()
    wait_for_all(first)
    assert time.monotonic() - began >= 2.0
    assert second.renew()


def test_the_shards_of_a_worker_without_a_session_are_claimed(url: str, join: Join) -> None:
    first, second = join("a"), join("b")
    settle(first, second)
    terminate_leases(url, but=1)
    assert wait_for_all(second) < leases.GRACE_S + 3.0 * leases.POLL_S + 0.5


def test_the_shards_of_a_worker_that_does_not_renew_are_claimed(
    join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "EXPIRY_S", 0.4)
    first, second = join("a"), join("b")
    settle(first, second)
    before = set(first.held.values())
    wait_for_all(second)
    assert not first.fresh
    assert (first.renew(), first.held) == (before, {})


def test_a_closed_worker_leaves_its_shards_at_once(url: str, join: Join) -> None:
    first = join("a")
    with Leases(url, "b") as second:
        second.register()
        settle(first, second)
        assert len(first.held) == SHARDS // 2
    assert len(first.claim()) == SHARDS // 2
    assert first.live_workers() == ["a"]


# ------------------------------------------------------------- check of the epochs


def test_a_transaction_of_an_earlier_epoch_is_refused(url: str, join: Join) -> None:
    first = join("a")
    first.claim()
    engine = sa.create_engine(url)
    with engine.begin() as connection:
        first.check(connection, ["village", "town"])
        first.check(connection, [])
    terminate_leases(url)
    second = join("b")
    second.claim()
    time.sleep(1.2 * leases.GRACE_S)
    second.claim()
    with engine.begin() as connection, refused(LeaseLost, "lease-lost") as caught:
        first.check(connection, ["village"])
    assert caught.value.feeders == {"village"}
    assert {lease.shard for lease in first.renew()} == set(range(SHARDS))
    assert not first.held
    engine.dispose()


def test_a_claim_leaves_shards_in_a_transaction(url: str, join: Join) -> None:
    first, second = join("a"), join("b")
    settle(first, second)
    feeder = next(name for name in (f"f{k}" for k in range(99)) if first.lease_of(name))
    engine = sa.create_engine(url)
    with engine.begin() as connection:
        first.check(connection, [feeder])
        terminate_leases(url, but=1)
        second.claim()
        time.sleep(1.2 * leases.GRACE_S)
        second.claim()
        assert set(range(SHARDS)) - set(second.held) == {shard_of(feeder)}
    assert [lease.shard for lease in second.claim()] == [shard_of(feeder)]
    engine.dispose()


def test_a_released_shard_is_written_no_more(url: str, join: Join) -> None:
    worker = join("a")
    worker.claim()
    worker.release([shard_of("village")])
    engine = sa.create_engine(url)
    with engine.begin() as connection, refused(LeaseLost, "lease-lost"):
        worker.check(connection, ["village"])
    engine.dispose()


# -------------------------------------------------------------------- refusals


def test_a_service_without_workers_excludes_workers(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connect, "LOCK_S", 0.2)
    with Store(url), refused(StoreUnavailable, "single-process"):
        Leases(url, "a")
    with Leases(url, "a"), refused(StoreUnavailable, "workers-running"):
        Store(url)
    Store(url).close()


def test_a_name_of_a_worker_is_unique(url: str, join: Join) -> None:
    join("a")
    with Leases(url, "a") as other:
        with refused(StoreUnavailable, "worker-exists"):
            other.register()
        assert other.live_workers() == ["a"]
        assert other.claim() == []


def test_workers_need_postgresql(tmp_path: Path) -> None:
    with refused(StoreUnavailable, "unsupported"):
        Leases(f"sqlite:///{tmp_path}/g.db", "a")
