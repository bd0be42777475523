"""Growth of a front and its workers under constant load: memory, descriptors, threads, tables.

    python -m benchmarks.soak [SECONDS] [FEEDERS]

A front with two workers and PostgreSQL, as processes. Each meter reports once a second. Every 20 s one
meter is manipulated for 40 s. Readers ask for the resources of REST on kept and on new connections; each
alarm is acknowledged. One client follows the stream of alarms, another one opens and ends streams of states.

The first half of the time, at most 3900 s, is the warm-up of each process, also of a replaced one: memories
of some minutes to an hour fill in it, the readings of a monitor in 3840 ticks. The slopes of its resident and
private memory (/proc/PID/smaps_rollup) follow by least squares over the rest:

    slope = sum (t - mean t) (m - mean m) / sum (t - mean t)^2

Exit code 1: a slope above 5 MB/h with its doubled standard error subtracted, more descriptors at the end than
after the warm-up (minimum of 12 samples each), a replaced process, a failed request, or an attack without an
alarm. The standard error takes the residuals as independent. PostgreSQL's processes are printed as one.
"""

from __future__ import annotations

import json
import math
import os
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import psycopg

from benchmarks._arguments import arguments
from feeders.model.site import load
from tests.service.clusters import LIE_VOLT, Process, ServedCluster, served_cluster
from tests.service.databases import Cluster, installed_postgresql, running
from tests.service.running import until

FEEDER = "cigre-lv"
SERVER = "postgresql"
WORKERS = 2
WARM_MOST_S, WARM_SHARE = 3900.0, 0.5
"""Longest warm-up, s, and its share of the time."""
SAMPLE_S = 5.0
"""Interval of the samples, s."""
EDGE = 12
"""Samples at each end whose least number of descriptors and threads counts."""
LIMIT_MB_H = 5.0
"""Largest slope of the memory of a process, MB/h."""
ATTACK_EVERY_S, ATTACK_S = 20.0, 40.0
"""Interval of the attacks, and time of each, s."""
READ_S, STREAM_S = 0.5, 7.0
"""Pause of a reader, and time of a stream that is opened again, s."""
PATHS = (
    "/readyz",
    "/metrics",
    "/",
    "/api/v1/feeders",
    "/api/v1/feeders?limit=5&status=attacked",
    "/api/v1/feeders/{feeder}",
    "/api/v1/feeders/{feeder}/state",
    "/api/v1/feeders/{feeder}/history",
    "/api/v1/feeders/{feeder}/commissioning",
    "/api/v1/alarms?limit=50",
    "/api/v1/incidents",
    "/api/v1/bad-readings",
)


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources of one process, or the sum over several: MB, numbers."""

    rss: float
    private: float
    descriptors: int
    threads: int


def usage(pids: list[int]) -> Usage:
    """Resources of processes. An ended process counts as nothing."""
    rss = private = 0.0
    descriptors = threads = 0
    for pid in pids:
        place = Path(f"/proc/{pid}")
        try:
            fields = dict(
                line.split(":", 1) for line in (place / "smaps_rollup").read_text().splitlines()[1:]
            )
            size = {name: int(text.split()[0]) / 1024.0 for name, text in fields.items()}
            descriptors += len(os.listdir(place / "fd"))
            threads += len(os.listdir(place / "task"))
        except (FileNotFoundError, ProcessLookupError):
            continue
        rss += size["Rss"]
        private += size["Private_Clean"] + size["Private_Dirty"]
    return Usage(rss, private, descriptors, threads)


def slope(t: np.ndarray, m: np.ndarray) -> tuple[float, float]:
    """Slope by least squares, and its standard error; NaN for less than three samples."""
    if len(t) < 3:
        return math.nan, math.nan
    t, m = t - t.mean(), m - m.mean()
    found = float(t @ m / (t @ t))
    error = math.sqrt(float(np.sum((m - found * t) ** 2)) / (len(t) - 2) / float(t @ t))
    return found, error


class Load:
    """Attacks, readers and streams of a cluster, in threads, until `ended` is set."""

    def __init__(self, live: ServedCluster) -> None:
        self.live, self.ended = live, threading.Event()
        self.rng = random.Random(1)
        self.counts: Counter[str] = Counter()
        self.failures: Counter[str] = Counter()
        self.missed: list[str] = []
        tasks: tuple[Callable[[], None], ...] = (
            self.attack,
            self.read_kept,
            self.read_new,
            self.follow_alarms,
            self.follow_states,
        )
        self.threads = [threading.Thread(target=self._guarded, args=(one,), daemon=True) for one in tasks]

    def _guarded(self, task: Callable[[], None]) -> None:
        try:
            task()
        except Exception as error:  # noqa: BLE001 - reported at the end
            if not self.ended.is_set():
                self.failures[f"{task.__name__}: {error!r}"] += 1

    def attack(self) -> None:
        """Manipulate meters in turn; every attack has an alarm, which is acknowledged."""
        names, meters = self.live.names, self.live.site.meter_ids
        with httpx.Client(base_url=self.live.http.base_url, timeout=20.0) as http:
            for number in range(1 << 30):
                # A feeder has one attack at a time.
                name = names[number % len(names)]
                key = name, self.rng.choice(meters)
                self.live.fleet.lies[key] = LIE_VOLT
                began = time.time()
                if self.ended.wait(ATTACK_EVERY_S):
                    return
                found = http.get("/api/v1/alarms", params={"feeder": name, "state": "raised"}).json()
                raised = [one for one in found["alarms"] if one["meter"] == key[1]]
                self.counts["attacks"] += 1
                if not raised:
                    self.missed.append(f"{key} at {began:.0f}")
                for one in raised:
                    body = {"who": "Ada", "comment": "seen"}
                    self._check(http.post(f"/api/v1/alarms/{one['id']}/ack", json=body))
                threading.Timer(ATTACK_S - ATTACK_EVERY_S, self.live.fleet.lies.pop, (key, None)).start()

    def _check(self, answer: httpx.Response) -> None:
        self.counts["requests"] += 1
        if answer.status_code != 200:
            self.failures[f"{answer.request.url.path}: {answer.status_code} {answer.text[:200]}"] += 1

    def _paths(self) -> Iterator[str]:
        while not self.ended.wait(READ_S):
            yield self.rng.choice(PATHS).format(feeder=self.rng.choice(self.live.names))

    def read_kept(self) -> None:
        """Read on one connection."""
        with httpx.Client(base_url=self.live.http.base_url, timeout=20.0) as http:
            for path in self._paths():
                self._check(http.get(path))

    def read_new(self) -> None:
        """Read on a new connection each time."""
        for path in self._paths():
            self._check(httpx.get(f"{self.live.http.base_url}".rstrip("/") + path, timeout=20.0))

    def _events(self, path: str, until_s: float) -> Iterator[str]:
        with (
            httpx.Client(base_url=self.live.http.base_url, timeout=60.0) as http,
            http.stream("GET", path) as answer,
        ):
            if answer.status_code != 200:
                self.failures[f"{path}: {answer.status_code}"] += 1
                return
            for line in answer.iter_lines():
                yield line
                if self.ended.is_set() or time.monotonic() > until_s:
                    return

    def follow_alarms(self) -> None:
        """Follow the stream of alarms until the end."""
        for line in self._events("/api/v1/alarms/stream?after=0", math.inf):
            self.counts["streamed alarms"] += line.startswith("data: ")

    def follow_states(self) -> None:
        """Open and end streams of states."""
        while not self.ended.is_set():
            path = f"/api/v1/feeders/{self.rng.choice(self.live.names)}/stream"
            for line in self._events(path, time.monotonic() + STREAM_S):
                self.counts["streamed states"] += line.startswith("data: ")
            self.counts["streams"] += 1

    @contextmanager
    def running(self) -> Iterator[None]:
        """Run until the block ends."""
        for one in self.threads:
            one.start()
        try:
            yield
        finally:
            self.ended.set()
            for one in self.threads:
                one.join(30.0)


def pids_of(live: ServedCluster, server: Cluster) -> dict[str, list[int]]:
    """Processes by name: the front, its workers, and those of PostgreSQL together."""
    assert isinstance(live.front, Process)
    front = live.front.pid
    children = Path(f"/proc/{front}/task/{front}/children").read_text().split()
    workers = {f"worker {pid}": [int(pid)] for pid in children}
    return {"front": [front], **workers, SERVER: server.processes()}


def tables(live: ServedCluster) -> dict[str, tuple[int, float]]:
    """Rows, and size with indices in MB, of every table."""
    with psycopg.connect(live.database.replace("+psycopg", "")) as connection:
        query = "SELECT relname, pg_total_relation_size(oid) / 1048576.0 FROM pg_class WHERE relkind = 'r' "
        query += "AND relnamespace = 'public'::regnamespace ORDER BY relname"
        sizes = connection.execute(query).fetchall()
        found = {}
        for name, size in sizes:
            row = connection.execute(f'SELECT count(*) FROM "{name}"').fetchone()
            found[str(name)] = (int(row[0]) if row else 0, float(size))
    return found


def ticks(live: ServedCluster) -> Counter[str]:
    """Ticks by verdict, over all feeders."""
    found: Counter[str] = Counter()
    for line in live.http.get("/metrics").text.splitlines():
        if line.startswith("gridsec_ticks_total{"):
            verdict = line.partition('verdict="')[2].partition('"')[0]
            found[verdict] += int(float(line.rpartition(" ")[2]))
    return found


Samples = dict[str, list[tuple[float, Usage]]]
"""Time since the start, s, and usage, by name of the process."""


def observe(live: ServedCluster, server: Cluster, seconds: float, samples: Samples) -> None:
    """Add samples of each process for a time; print a line each minute."""
    began, shown = time.monotonic(), 0.0
    first = max((each[-1][0] for each in samples.values()), default=0.0)
    while (now := time.monotonic() - began) < seconds:
        now_of = {name: usage(pids) for name, pids in pids_of(live, server).items()}
        for name, used in now_of.items():
            samples.setdefault(name, []).append((first + now, used))
        if now >= shown:
            text = ", ".join(f"{name} {used.private:.1f}" for name, used in now_of.items())
            print(f"{first + now:5.0f} s, private MB: {text}", flush=True)
            shown += 60.0
        time.sleep(max(0.0, began + now + SAMPLE_S - time.monotonic()))


def print_processes(samples: Samples, warm_s: float) -> list[str]:
    """Print slopes and numbers after the warm-up of each process; the violations."""
    violations = []
    samples = {name: [one for one in each if one[0] >= each[0][0] + warm_s] for name, each in samples.items()}
    print("\n| process | RSS, MB | slope, MB/h | private, MB | slope, MB/h | descriptors | threads |")
    print("|---|---|---|---|---|---|---|")
    for name, each in samples.items():
        if len(each) < EDGE:
            print(f"| {name} | ended after {len(each)} samples | | | | | |")
            continue
        t = np.array([at for at, _ in each]) / 3600.0
        cells = []
        for field in ("rss", "private"):
            m = np.array([getattr(one, field) for _, one in each])
            found, error = slope(t, m)
            cells += [f"{m[0]:.1f} to {m[-1]:.1f}", f"{found:+.2f} (se {error:.2f})"]
            if name != SERVER and found - 2.0 * error > LIMIT_MB_H:
                violations.append(f"{name}: {field} grows by {found:.1f} MB/h")
        for field in ("descriptors", "threads"):
            first, last = (
                min(getattr(one, field) for _, one in part) for part in (each[:EDGE], each[-EDGE:])
            )
            cells.append(f"{first} to {last}")
            if field == "descriptors" and last > first and name != SERVER:
                violations.append(f"{name}: {last - first} more descriptors")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    return violations


def print_tables(before: dict[str, tuple[int, float]], after: dict[str, tuple[int, float]]) -> None:
    """Print the growth of the tables."""
    print("\n| table | rows after the warm-up, at the end | MB |\n|---|---|---|")
    for name, (rows, size) in after.items():
        first = before.get(name, (0, 0.0))
        print(f"| {name} | {first[0]}, {rows} | {first[1]:.2f}, {size:.2f} |")


def soak(live: ServedCluster, server: Cluster, seconds: float) -> list[str]:
    """Run and print; the violations."""
    warm_s = min(WARM_MOST_S, WARM_SHARE * seconds)
    until(lambda: live.http.get("/readyz").status_code == 200, "readiness", 120.0)
    live.judged_within(live.names, time.time() - 1.0, 60.0)
    load, samples = Load(live), Samples()
    with load.running():
        observe(live, server, warm_s, samples)
        size, begun, judged = tables(live), time.monotonic(), ticks(live)
        observe(live, server, seconds - warm_s, samples)
        judged = ticks(live) - judged
        lasted = time.monotonic() - begun
    violations = print_processes(samples, warm_s)
    print_tables(size, tables(live))
    due = lasted * len(live.names)
    shares = ", ".join(f"{verdict} {number / due:.4f}" for verdict, number in sorted(judged.items()))
    print(f"\nticks of those due in {lasted:.0f} s: {shares}")
    print(json.dumps(load.counts | {"alarms": len(live.alarms(limit=1000))}))
    violations += [f"failed {number} times: {one}" for one, number in load.failures.items()]
    violations += [f"no alarm: {one}" for one in load.missed]
    if (replaced := len(samples) - 2 - WORKERS) > 0:
        violations.append(f"{replaced} replaced processes")
    return violations


def main() -> int:
    """Measure."""
    asked = arguments(__doc__, seconds=3600.0, feeders=12)
    with (
        running(installed_postgresql()) as server,
        tempfile.TemporaryDirectory(prefix="gridsec-soak-") as folder,
        served_cluster(
            Path(folder),
            server.database(),
            load(FEEDER),
            asked.feeders,
            0,
            options=("--workers", str(WORKERS)),
            period_s=asked.seconds + 120.0,
        ) as live,
    ):
        violations = soak(live, server, asked.seconds)
        print("log of the front and its workers: ", end="")
        print(len((Path(folder) / "front.log").read_text().splitlines()), "lines")
    for one in violations:
        print(f"- {one}")
    print(f"violations: {len(violations)}")
    return int(bool(violations))


if __name__ == "__main__":
    sys.exit(main())
