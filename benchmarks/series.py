"""Cost of a series over REST, and size of the history: 14 days of a feeder with 146 meters, SQLite.

    python -m benchmarks.series

Rows are stored every 10 s. The request is that of the page: six meters, 720 buckets, over HTTP. Times are
processor times of service and client, median of five. Limits: 14 days take at most 1 s, and roll-ups at most
a fifth of the size of the rows.
"""

from __future__ import annotations

import sqlite3
import sys
import tempfile
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np

from gridsec.interface import Cause, Decision
from service.report.report import FeederReport, MeterState
from service.store import Store
from service.store.series import pack
from tests.service.conftest import Server, SmallService, Village

BEGIN, DAYS, METERS, STEP_S, DISTINCT = 1_795_200_000.0, 14, 146, 10.0, 500
LIMIT_S, SHARE = 1.0, 0.2
SPANS = {"1 h": 3600.0, "6 h": 21_600.0, "24 h": 86_400.0, "7 d": 604_800.0, "14 d": 1_209_600.0}


def a_report(t: float, draw: np.random.Generator) -> FeederReport:
    """Return a report with the noise of real meters."""
    v = 230.0 + 3.0 * np.sin(t / 9000.0) + np.cumsum(draw.normal(0.0, 0.1, METERS))
    reported, score = v + draw.normal(0.0, 0.3, METERS), np.abs(draw.normal(0.0, 1e-3, METERS))
    std = 0.15 + 0.01 * draw.random(METERS)
    numbers = (score, np.full(METERS, 2e-3), reported, v, std)
    meters = tuple(
        MeterState(f"m{k}", "b", True, False, *(float(n[k]) for n in numbers), 1.0, 0.0)
        for k in range(METERS)
    )
    return FeederReport("village", t, Decision.CLEAN, "", Cause.AGREEMENT, 2, meters, (), (), 207.0, 253.0)


def filled(path: Path) -> float:
    """Write the history; return the time of one commit that adds roll-ups, s."""
    draw = np.random.default_rng(1)
    made = [a_report(BEGIN + 7.0 * k, draw) for k in range(DISTINCT)]
    packed = [pack(one.row) for one in made]
    count = int(DAYS * 86_400 / STEP_S)
    with Store(f"sqlite:///{path}") as store:
        store.commit(reports=[replace(made[0], t=BEGIN)])
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executemany(
            "INSERT INTO history VALUES ('village', ?, 'clean', 'agreement', 1, ?)",
            ((BEGIN + STEP_S * k, packed[k % DISTINCT]) for k in range(1, count)),
        )
    end = BEGIN + DAYS * 86_400.0
    with Store(f"sqlite:///{path}") as store:
        start, commits = time.process_time(), 0
        while not commits or store._rolled["village"] < end:
            store.commit(reports=[replace(made[0], t=end + STEP_S * commits)])
            commits += 1
        return (time.process_time() - start) / commits


def sizes(path: Path) -> tuple[int, int]:
    """Return the bytes of the rows and of the roll-ups."""
    with closing(sqlite3.connect(path)) as connection:
        query = (
            "SELECT (SELECT sum(length(data)) FROM history), (SELECT sum(length(data)) FROM history_rollup)"
        )
        one, two = connection.execute(query).fetchone()
        return one, two


def main() -> int:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gridsec.db"
        commit = filled(path)
        of_rows, of_rollups = sizes(path)
        print(f"commit with 20 roll-ups: {1e3 * commit:.0f} ms")
        print(f"rows {of_rows / 1e6:.0f} MB, roll-ups {of_rollups / 1e6:.0f} MB ({of_rollups / of_rows:.0%})")
        service = SmallService(f"sqlite:///{path}", Village("village", METERS, "m"))
        server = Server(service)
        end, slowest = BEGIN + DAYS * 86_400.0, 0.0
        meters = [f"m{k}" for k in range(0, METERS, 25)]
        with httpx.Client(base_url=server.url, timeout=60) as http:
            for name, span in SPANS.items():
                query = {"meter": meters, "since": end - span, "until": end, "buckets": 720}
                times, answer = [], None
                for _ in range(5):
                    start = time.process_time()
                    answer = http.get("/api/v1/feeders/village/series", params=query)
                    times.append(time.process_time() - start)
                assert answer is not None
                found, took = answer.json(), float(np.median(times))
                slowest = max(slowest, took)
                sent = int(answer.headers.get("content-length", 0))
                ticks, count = sum(found["ticks"]), len(found["t"])
                print(
                    f"{name:>4}: {1e3 * took:4.0f} ms, {ticks} ticks in {count} buckets of "
                    f"{found['bucket_s']:g} s, {sent / 1e3:.0f} kB"
                )
        server.stop()
        service.close()
    return int(slowest > LIMIT_S or of_rollups > SHARE * of_rows)


if __name__ == "__main__":
    sys.exit(main())
