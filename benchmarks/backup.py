"""Latency of commits while `gridsec backup` copies a database of 120 000 ticks, 0.5 GB.

    python -m benchmarks.backup

Alarms are committed every 10 ms, for 4 s without a backup and then until a backup in another process ends.
Limit: the slowest commit beside the backup takes at most 1 s.
"""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from itertools import count
from pathlib import Path

import numpy as np

from service.store import Store
from tests.service.stored import T0, a_report, an_alarm, raised

TICKS, ROW_BYTES, ALONE_S, PAUSE_S, LIMIT_S = 120_000, 2_300, 4.0, 0.01, 1.0
COMMAND = "from service.cli.main import main; main()"


def filled(path: Path) -> None:
    """Write a database with a history of rows that do not compress."""
    with Store(f"sqlite:///{path}") as store:
        store.commit(reports=[a_report(T0)])
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executemany(
            "INSERT INTO history VALUES ('village', ?, 'clean', 'agreement', 1, ?)",
            ((T0 + 10.0 * k, os.urandom(ROW_BYTES)) for k in range(1, TICKS)),
        )


def commits(store: Store, numbers: count[int], going: Callable[[], bool]) -> np.ndarray:
    """Return the duration of each commit, ms."""
    out = []
    while going():
        start = time.perf_counter()
        store.commit([raised(an_alarm(next(numbers)))])
        out.append(1e3 * (time.perf_counter() - start))
        time.sleep(PAUSE_S)
    return np.array(out)


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        path, file = Path(folder) / "gridsec.db", Path(folder) / "backup"
        filled(path)
        url, numbers = f"sqlite:///{path}", count(1)
        with Store(url) as store:
            end = time.monotonic() + ALONE_S
            alone = commits(store, numbers, lambda: time.monotonic() < end)
            start = time.monotonic()
            child = subprocess.Popen([sys.executable, "-c", COMMAND, "backup", str(file), "--database", url])
            beside = commits(store, numbers, lambda: child.poll() is None)
        print(f"backup of {path.stat().st_size / 1e6:.0f} MB: {time.monotonic() - start:.1f} s")
        for name, found in (("alone", alone), ("beside the backup", beside)):
            print(f"{name}: {found.size} commits, median {np.median(found):.1f} ms, "
                  f"99 % {np.quantile(found, 0.99):.0f} ms, slowest {found.max():.0f} ms")  # fmt: skip
        assert child.returncode == 0
        assert beside.max() < 1e3 * LIMIT_S


if __name__ == "__main__":
    main()
