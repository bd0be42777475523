"""Hostile clients and wrong clocks of a served cluster, and observation of its feeders meanwhile."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import httpx

from tests.service.clusters import Process, ServedCluster
from tests.service.running import until

LATE_S = 5.0
"""Age of a feeder's tick from which it is late, s: ticks of 1 s on a busy machine."""
POLL_S = 0.25
CONNECTIONS, STREAMS = 1_100, 200
"""Numbers of idle connections and of stalled streams: above the limits of a process."""
KEPT = 8
"""Descriptors that may remain: connections of the database and of readers."""
KINDS = {"single": (), "workers": ("--workers", "2")}
"""Options of `gridsec serve`: one process, or a front with workers."""
FORMS = ("garbage", "oversized", "stranger", "wildcard")
"""Floods of readings: no JSON, payloads above the limit, keys without a feeder, a pattern of keys."""
FORGERIES = ("call", "answer")
"""Kinds of floods between front and workers without the secret of the cluster: calls of a worker, and answers
in its place that keep the calls open."""
FLOOD = """
import collections, itertools, sys
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import session
form, feeder, worker = sys.argv[2:5]
with session(BusConfig("client", connect=(sys.argv[1],))) as live:
    print("up", flush=True)
    for number in itertools.count():
        if form == "garbage":
            live.put(f"gridsec/{feeder}/meter/m{number % 7:02d}/reading", b"{]" * 20 + str(number).encode())
        elif form == "oversized":
            live.put(f"gridsec/{feeder}/meter/m01/reading", bytes(400_000))
        elif form == "stranger":
            live.put(f"gridsec/stranger-{number}/meter/m01/reading", b"{}")
        elif form == "wildcard":
            live.put("gridsec/*/meter/m01/reading", b"{}")
        elif form == "call":
            kind = "state" if number % 2 else "rest"
            live.get(f"gridsec/@worker/{worker}/{kind}", payload=b"0" * 200, timeout=1.0)
        else:
            key, kept = f"gridsec/@worker/{worker}/**", collections.deque(maxlen=1000)
            for query in live.declare_queryable(key, complete=True):
                query.reply(query.key_expr, b"0" * 200)
                kept.append(query)
"""
"""Flood of one peer, as fast as the router takes it: endpoint, form, feeder, worker."""


@dataclass
class Watch:
    """Feeders during a time: what a reader of the list and of the readiness sees."""

    polls: int = 0
    slowest_s: float = 0.0  # longest answer to a request for the list, s
    failed: list[str] = field(default_factory=list)  # requests for the list
    ages_s: dict[str, float] = field(default_factory=dict)  # largest age of the tick, by feeder
    verdicts: dict[str, set[str]] = field(default_factory=dict)
    reasons: set[str] = field(default_factory=set)  # of the readiness

    def late(self, names: Sequence[str]) -> list[str]:
        """Those of some feeders that had a late tick, or none."""
        return [name for name in names if self.ages_s.get(name, float("inf")) > LATE_S]

    def changed(self, names: Sequence[str]) -> list[str]:
        """Those of some feeders that were not CLEAN all the time."""
        return [name for name in names if self.verdicts.get(name) != {"clean"}]


def decided(live: ServedCluster) -> None:
    """Wait until every feeder is displayed as clean."""
    until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
    until(lambda: {one["status"] for one in live.listed().values()} == {"clean"}, "verdicts")


@contextmanager
def watched(live: ServedCluster) -> Iterator[Watch]:
    """Watch the feeders until the block ends, on connections of its own."""
    found, ended = Watch(), threading.Event()

    def run() -> None:
        with httpx.Client(base_url=live.http.base_url, timeout=20.0) as http:
            while not ended.is_set():
                _poll(http, found)
                ended.wait(POLL_S)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join(30.0)


def _poll(http: httpx.Client, found: Watch) -> None:
    began = time.monotonic()
    try:
        answer = http.get("/api/v1/feeders")
        ready = http.get("/readyz")
    except httpx.HTTPError as error:
        found.failed.append(repr(error))
        return
    found.polls += 1
    found.slowest_s = max(found.slowest_s, time.monotonic() - began)
    if answer.status_code != 200:
        found.failed.append(f"{answer.status_code} {answer.text[:200]}")
        return
    if ready.status_code != 200:
        found.reasons |= set(ready.json().get("reasons", ()))
    for one in answer.json()["feeders"]:
        age_s = float("inf") if one.get("age_s") is None else float(one["age_s"])
        found.ages_s[one["name"]] = max(found.ages_s.get(one["name"], 0.0), age_s)
        found.verdicts.setdefault(one["name"], set()).add(str(one["status"]))


def _connect(live: ServedCluster, buffer: int | None = None) -> socket.socket:
    made = socket.socket()
    if buffer is not None:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    made.settimeout(20.0)
    base = live.http.base_url
    made.connect((base.host, base.port or 80))
    return made


@contextmanager
def idle_connections(live: ServedCluster, number: int) -> Iterator[None]:
    """Connections that send nothing, or half a header, in turn."""
    with ExitStack() as stack:
        for k in range(number):
            one = stack.enter_context(_connect(live))
            if k % 2:
                one.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX-")
        yield


@contextmanager
def stalled_streams(live: ServedCluster, number: int) -> Iterator[None]:
    """Clients that ask for streams of states, and never read."""
    with ExitStack() as stack:
        for k in range(number):
            one = stack.enter_context(_connect(live, buffer=2048))
            path = f"/api/v1/feeders/{live.names[k % len(live.names)]}/stream"
            one.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        yield


@contextmanager
def flood(live: ServedCluster, form: str, feeder: str) -> Iterator[None]:
    """A peer that publishes, calls or answers as fast as it can, as a process of its own."""
    worker = live.owners().get(feeder) or "w0"
    peer = subprocess.Popen(
        [sys.executable, "-c", FLOOD, live.zenoh, form, feeder, worker],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
    )
    try:
        assert peer.stdout is not None
        assert peer.stdout.readline() == b"up\n"
        yield
    finally:
        peer.kill()
        peer.communicate()


def endure(live: ServedCluster, seconds: float) -> Watch:
    """Watch the feeders for a time, s."""
    with watched(live) as found:
        time.sleep(seconds)
    return found


@dataclass(frozen=True, slots=True)
class Cost:
    """Effect of an attack: feeders meanwhile, growth of memory in MB and of the logs in lines."""

    watch: Watch
    memory_mb: float
    lines: int


def attacked(live: ServedCluster, attack: AbstractContextManager[None], seconds: float) -> Cost:
    """Watch the feeders during an attack; wait until its descriptors are free again."""
    front = live.front
    assert isinstance(front, Process)
    lines, memory, before = log_lines(live), memory_mb(front), descriptors(front)
    with attack:
        watch = endure(live, seconds)
        memory = memory_mb(front) - memory
    lines = log_lines(live) - lines
    until(lambda: descriptors(front) <= before + KEPT, "freed descriptors", 20.0)
    return Cost(watch, memory, lines)


def attacks(live: ServedCluster) -> dict[str, tuple[Callable[[], AbstractContextManager[None]], list[str]]]:
    """Attacks by name, and the feeders that none of them concerns."""
    found: dict[str, tuple[Callable[[], AbstractContextManager[None]], list[str]]] = {
        "connections": (partial(idle_connections, live, CONNECTIONS), live.names),
        "streams": (partial(stalled_streams, live, STREAMS), live.names),
    }
    for form in FORMS + (FORGERIES if live.owners() else ()):
        found[form] = partial(flood, live, form, live.names[0]), live.names[1:]
    return found


HOUR_S = 3600.0
"""Leap of a clock, s."""
RECOVERY_S = 10.0
"""Longest time until every feeder is decided after an attack or a leap, s."""


def front_leaps(live: ServedCluster, leap_s: float) -> tuple[Watch, Watch]:
    """Feeders while the clock of the front is wrong, and after it."""
    assert isinstance(live.front, Process)
    live.front.leap(leap_s)
    wrong = endure(live, 6.0)
    live.front.leap(0.0)
    return wrong, endure(live, 4.0)


def worker_leaps(live: ServedCluster, worker: str, leap_s: float) -> tuple[Watch, float]:
    """Feeders while the clock of a worker is wrong, and time after it until its feeders are decided, s."""
    live.workers[worker].leap(leap_s)
    # The last verdict from before the leap is valid until its age is too large.
    time.sleep(LATE_S)
    wrong = endure(live, 6.0)
    its = live.owned(worker)
    live.workers[worker].leap(0.0)
    return wrong, live.judged_within(its, time.time(), RECOVERY_S)


def all_leap(live: ServedCluster, leap_s: float) -> float:
    """Shift the clocks of all processes and meters; time until all feeders are CLEAN at the new time, s."""
    assert isinstance(live.front, Process)
    live.fleet.ahead_s = leap_s
    for process in (live.front, *live.workers.values()):
        process.leap(leap_s)
    began = time.time() + leap_s

    def over() -> bool:
        states = [live.state(name) for name in live.names]
        return all(
            bool(one) and began < one["t"] < began + 60.0 and one["verdict"] == "clean" for one in states
        ) and all(one["age_s"] < LATE_S for one in states)

    until(over, "verdicts after the leap", RECOVERY_S)
    return time.time() + leap_s - began


def log_lines(live: ServedCluster) -> int:
    """Lines in the logs of all processes of gridsec."""
    return sum(len(path.read_text().splitlines()) for path in Path(live.folder).glob("*.log"))


def _family(process: Process) -> list[int]:
    """Process and its children."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
    return [process.pid, *map(int, children.split())]


def descriptors(process: Process) -> int:
    """Descriptors of a process and its children."""
    return sum(len(os.listdir(f"/proc/{pid}/fd")) for pid in _family(process))


def memory_mb(process: Process) -> float:
    """Private memory of a process and its children, MB."""
    total = 0
    for pid in _family(process):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith(("Private_Clean:", "Private_Dirty:")):
                total += int(line.split()[1])
    return total / 1024.0
