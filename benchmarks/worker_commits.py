"""Duration of a worker's commits with and without the check of leases and the lock of event numbers.

    python -m benchmarks.worker_commits

Two variants of a commit of one alarm alternate in one store on PostgreSQL with `fsync`: with the check of the
epochs and the lock of the numbers, and without both. Then four workers store at once, with and without them.
Limit: the median difference of neighbouring commits is below a tenth of a commit.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import sqlalchemy as sa

from service.store import Store, leases
from service.store.leases import Leases
from tests.service.databases import Cluster, find_postgresql, running
from tests.service.stored import an_alarm, raised

PAIRS, BESIDE, WORKERS, LIMIT = 400, 200, 4, 0.1


class Durable(Cluster):
    """A server that waits for the disk."""

    def start(self) -> None:
        """Start with `fsync`."""
        options = f"-c listen_addresses='' -c unix_socket_directories='{self.folder}'"
        self.run("pg_ctl", "-D", self.data, "-w", "-l", self.folder / "log", "-o", options, "start")


def unchecked(store: Store) -> None:
    """Remove the check and the lock from a store."""
    store._check = lambda *_: None  # type: ignore[method-assign]
    store._numbering = sa.null  # type: ignore[method-assign,assignment]


def checked(store: Store) -> None:
    """Undo `unchecked`."""
    vars(store).pop("_check", None)
    vars(store).pop("_numbering", None)


def commit(store: Store, feeder: str, count: int) -> float:
    """Return the duration of a commit of one alarm, ms."""
    start = time.perf_counter()
    store.commit([raised(replace(an_alarm(hash(feeder) % 10**9, feeder=feeder), count=count))])
    return 1e3 * (time.perf_counter() - start)


def alternating(store: Store, feeder: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the durations with and without the check, ms."""
    out: list[list[float]] = [[], []]
    variants: tuple[Callable[[Store], None], ...] = (checked, unchecked)
    for count in range(1, PAIRS + 1):
        # The first of a pair alternates, too.
        for k in (0, 1) if count % 2 else (1, 0):
            variants[k](store)
            out[k].append(commit(store, feeder, 2 * count + k))
    checked(store)
    return np.array(out[0]), np.array(out[1])


def beside(stores: list[Store], feeders: list[str], variant: Callable[[Store], None]) -> float:
    """Return the commits per second of several workers at once."""

    def write(store: Store, feeder: str) -> None:
        variant(store)
        for count in range(1, BESIDE + 1):
            commit(store, feeder, count)

    threads = [threading.Thread(target=write, args=each) for each in zip(stores, feeders, strict=True)]
    start = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return BESIDE * len(stores) / (time.perf_counter() - start)


def main() -> None:
    """Measure and print."""
    binaries = find_postgresql()
    if binaries is None:
        print("PostgreSQL is not installed")
        return
    leases.SETTLE_S = 0.0  # type: ignore[misc]
    with running(binaries, Durable) as cluster:
        measure(cluster.database())


def measure(url: str) -> None:
    """Measure on a database, and print."""
    workers = [Leases(url, f"w{k}") for k in range(WORKERS)]
    for worker in workers:
        worker.register()
    for _ in range(2 * WORKERS):
        for worker in workers:
            worker.claim()
            worker.release(worker.excess())
    names = [f"f{k}" for k in range(200)]
    feeders = [next(name for name in names if worker.lease_of(name)) for worker in workers]
    stores = [Store(url, leases=worker) for worker in workers]
    with_check, without = alternating(stores[0], feeders[0])
    gap = float(np.median(with_check - without))
    draws = np.random.default_rng(1).choice(with_check - without, (2000, PAIRS))
    low_gap, high_gap = np.quantile(np.median(draws, axis=1), (0.025, 0.975))
    for name, found in (("with check and lock", with_check), ("without", without)):
        low, middle, high = np.quantile(found, (0.25, 0.5, 0.75))
        print(f"{name}: median {middle:.2f} ms, quartiles {low:.2f} to {high:.2f} ms ({found.size} commits)")
    share = 100 * gap / np.median(without)
    print(f"median difference of pairs: {gap:.2f} ms, {share:.1f} % of a commit (95 %: {low_gap:.2f} to "
          f"{high_gap:.2f} ms)")  # fmt: skip
    for name, variant in (
        ("with", checked),
        ("without", unchecked),
        ("with", checked),
        ("without", unchecked),
    ):
        print(f"{WORKERS} workers at once, {name}: {beside(stores, feeders, variant):.0f} commits/s")
    for store, worker in zip(stores, workers, strict=True):
        store.close()
        worker.close()
    assert gap < LIMIT * np.median(without), "the check costs more than a tenth of a commit"


if __name__ == "__main__":
    main()
