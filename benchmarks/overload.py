"""Sustained rate of single readings, behaviour at three times that rate, and recovery.

    python -m benchmarks.overload [feeders] [seconds] [other source tree] [--workers] [--rated]

The real service runs as a process with copies of the Kerber suburban network, 146 meters and the busbar
each; with --workers it is a front with two workers and PostgreSQL. A zenoh client publishes single JSON
readings, and the figures come from `/metrics`. The rate rises by a quarter per stage of 6 s, from one reading
per meter and second on. The sustained rate is that of the last stage in which at least 95 % of the ticks due
had a verdict, CLEAN or ATTACKED; with --rated it is that of the first stage. Then follow `seconds` (60 s) at
three times that rate, and at most 10 s at one reading per meter and second. Recovery ends when every meter is
seen and every verdict is CLEAN. The share of `keep_states` is processor time of the judging thread in stage
one, without workers.

During the overload the list of feeders is read every 0.5 s, between two reads of the metrics. If these agree
on `gridsec_feeders_shed`, it is compared with the number of feeders with the cause `overload`. A monitored
feeder is on time if its latest tick is at most 3 s old; the first 3 s after its return are left out.

Limits: the recovery takes at most 10 s, during the overload a feeder is judged every 5 s on average, no
number of shed feeders differs, and 95 % of the monitored feeders are on time. With another source tree the
same is measured there first, and the ratios are printed. About three minutes per source tree.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import httpx

from benchmarks._arguments import arguments
from feeders.format.tables import FeederTables, write
from feeders.model.site import Site, load
from feeders.simulation.plant import BUSBAR
from feeders.simulation.scenario import Scenario, simulate
from service.cli.simulate import key_of
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient
from tests.service.databases import installed_postgresql
from tests.service.databases import running as running_server

FEEDER = "kerber-vorstadtnetz"
STAGE_S, SETTLE_S, RECOVERY_S = 6.0, 2.0, 10.0
"""Lengths of a stage, of its part that is not measured, and the longest recovery, s."""
WORKERS = 2
LATE_S, ON_TIME = 3.0, 0.95
"""Age of a tick, s, from which a monitored feeder is late; least share of the feeders on time."""
GROWTH, OVERLOAD = 1.25, 3.0
"""Ratio of the rates of two stages, and of the overload to the sustained rate."""
STAGES = 12
DECIDED = 0.95
"""Share of the ticks due that have a verdict at a sustained rate."""
JUDGED_EVERY_S = 5.0
"""Longest mean time between two judged ticks of a feeder during the overload, s."""
PHASE = 0.9
"""Part of a second at which a measurement begins and ends: between two ticks of 1 s."""
START_S, STOP_S = 120.0, 10.0
SECONDS = 60
"""Simulated seconds; the sender repeats them with other noise."""
NOISE_VOLT = 0.02
BURST = 16
"""Readings that the sender publishes between two looks at the clock: 0.2 ms at 80 000 per second."""


@dataclass(frozen=True)
class Load:
    """Readings of all meters: keys, and for each simulated second the fields besides the time."""

    keys: tuple[str, ...]
    fields: tuple[tuple[tuple[float, float | None], ...], ...]


@dataclass(frozen=True)
class Service:
    """A running service, and where it writes its totals."""

    process: subprocess.Popen[bytes]
    http: httpx.Client
    zenoh: str
    totals: Path
    feeders: int


@dataclass(frozen=True)
class Stage:
    """One stage: readings per second sent and used, shares of the ticks due, share of the meters seen."""

    offered: float
    used: float
    judged: float
    decided: float
    seen: float


@dataclass
class Shedding:
    """Feeders during the overload, by the list of feeders and by the metrics."""

    compared: int = 0  # numbers of shed feeders
    different: int = 0
    most: int = 0  # largest number of shed feeders
    monitored: int = 0  # feeders of all reads that are not shed, nor just returned
    late: int = 0

    @property
    def on_time(self) -> float:
        """Share of the monitored feeders with a recent tick; 0 without any."""
        return 1.0 - self.late / self.monitored if self.monitored else 0.0


@dataclass(frozen=True)
class Outcome:
    """One source tree: readings per second, share of `keep_states`, the overload, and the recovery in s."""

    sustained: float
    keep_states: float
    overload: Stage
    shedding: Shedding
    recovery_s: float


def free_ports(number: int) -> list[int]:
    """Ports that are free on the loopback interface."""
    sockets = [socket.socket() for _ in range(number)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports


def load_of(site: Site, names: Sequence[str]) -> Load:
    """Simulate one feeder, and let all its copies send the same."""
    samples = list(simulate(site, Scenario(seed=1, duration_s=float(SECONDS), dt_s=1.0)))
    meters = (*site.meter_ids, BUSBAR)
    keys = tuple(key_of(name, meter) for name in names for meter in meters)
    rows = []
    for sample in samples:
        by_meter = {reading.meter: (reading.v_volt, reading.p_kw) for reading in sample.readings}
        rows.append(tuple(by_meter[meter] for meter in meters))
    return Load(keys, tuple(rows))


PROGRAM = "from service.cli.main import main; main()"


@contextmanager
def running(
    tree: Path,
    folder: Path,
    names: Sequence[str],
    *,
    workers: int = 0,
    database: str | None = None,
    start_s: float = START_S,
) -> Iterator[Service]:
    """Run the service of a source tree until the block ends: one process, or a front with workers."""
    http, zenoh = free_ports(2)
    totals, log = folder / "totals.json", folder / "service.log"
    script = Path(__file__).with_name("_overload_service.py")
    command = [sys.executable, str(script), str(totals)]
    if workers:
        command = [sys.executable, "-c", PROGRAM, "serve", "--workers", str(workers)]
    for name in names:
        command += ["--feeder", str(folder / name)]
    command += ["--http", f"127.0.0.1:{http}", "--zenoh-listen", f"tcp/127.0.0.1:{zenoh}"]
    command += ["--database", database or f"sqlite:///{folder / f'{tree.name}.db'}"]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    with log.open("wb") as out, httpx.Client(base_url=f"http://127.0.0.1:{http}", timeout=30.0) as client:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment, cwd=tree)
        try:
            end = time.monotonic() + start_s
            while not _ready(client):
                if process.poll() is not None or time.monotonic() > end:
                    raise SystemExit(f"the service did not start:\n{log.read_text()[-2000:]}")
                time.sleep(0.1)
            yield Service(process, client, f"tcp/127.0.0.1:{zenoh}", totals, len(names))
        finally:
            process.terminate()
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _ready(client: httpx.Client) -> bool:
    try:
        return client.get("/readyz").status_code == 200
    except httpx.TransportError:
        return False


class Sender(threading.Thread):
    """Publishes the load in turn at `rate` readings per second until `ended` is set."""

    def __init__(self, load: Load, zenoh: str, rate: float) -> None:
        super().__init__(daemon=True)
        self.load, self.zenoh, self.rate = load, zenoh, rate
        self.sent = 0
        self.ended = threading.Event()

    def run(self) -> None:
        """Publish."""
        dice = random.Random(1)
        width = len(self.load.fields[0])
        with MeterClient(BusConfig("client", connect=(self.zenoh,)), "gridsec") as meters:
            begun = due = time.monotonic()
            for start in count(step=BURST):
                if self.ended.is_set():
                    return
                now = time.monotonic()
                if now < due:
                    time.sleep(due - now)
                # Late readings are dropped: a burst later would hide the overload.
                due = max(due, now - 0.1) + BURST / self.rate
                row = self.load.fields[int(now - begun) % len(self.load.fields)]
                stamp = f"{time.time():.3f}"
                for number in range(start, start + BURST):
                    place = number % len(self.load.keys)
                    v_volt, p_kw = row[place % width]
                    more = "" if p_kw is None else f',"p_kw":{p_kw}'
                    v_volt += dice.uniform(-NOISE_VOLT, NOISE_VOLT)
                    payload = f'{{"t":{stamp},"v_volt":{v_volt:.4f}{more}}}'
                    meters.put(self.load.keys[place], payload.encode())
                self.sent += BURST


_LINE = re.compile(r"^(gridsec_\w+?)(?:\{(.*)\})? (\S+)$")


def metrics(service: Service) -> Counter[str]:
    """Sums over all feeders; ticks by verdict."""
    found: Counter[str] = Counter()
    for line in service.http.get("/metrics").text.splitlines():
        match = _LINE.match(line)
        if match is None or match[1].endswith(("_bucket", "_created")):
            continue
        verdict = re.search(r'verdict="(\w+)"', match[2] or "")
        found[match[1] + (f" {verdict[1]}" if verdict else "")] += float(match[3])  # type: ignore[assignment]
    return found


def ticks(found: Mapping[str, float]) -> float:
    """Number of ticks of all verdicts in `metrics`."""
    return sum(found[f"gridsec_ticks_total {verdict}"] for verdict in ("clean", "attacked", "undecided"))


def renamed(tables: FeederTables, name: str) -> FeederTables:
    """Return tables of a feeder with another name."""
    return replace(tables, meta=replace(tables.meta, name=name))


def await_phase() -> None:
    """Wait until the next `PHASE` of a second."""
    time.sleep((PHASE - time.time()) % 1.0)


def stage(service: Service, sender: Sender, load: Load, rate: float, seconds: float) -> Stage:
    """Send at a rate and measure after `SETTLE_S`, over a whole number of ticks."""
    sender.rate = rate
    time.sleep(SETTLE_S)
    await_phase()
    begun, sent = time.monotonic(), sender.sent
    before = metrics(service)
    seen = []
    while time.monotonic() < begun + seconds - SETTLE_S:
        time.sleep(0.5)
        seen.append(metrics(service)["gridsec_meters_seen"])
    await_phase()
    lasted, sent = time.monotonic() - begun, sender.sent - sent
    more = metrics(service) - before
    due = round(lasted) * service.feeders
    decided = more["gridsec_ticks_total clean"] + more["gridsec_ticks_total attacked"]
    meters = service.feeders * (len(load.fields[0]) - 1)
    return Stage(
        sent / lasted,
        more["gridsec_readings_total"] / lasted,
        ticks(more) / due,
        decided / due,
        sum(seen) / len(seen) / meters,
    )


@contextmanager
def observed(service: Service) -> Iterator[Shedding]:
    """Compare the list of feeders with the metrics until the block ends."""
    found, ended = Shedding(), threading.Event()

    def run() -> None:
        returned: dict[str, float] = {}  # time of the latest read at which a feeder was shed, s
        with httpx.Client(base_url=service.http.base_url, timeout=30.0) as http:
            own = replace(service, http=http)
            while not ended.wait(0.5):
                before = metrics(own)["gridsec_feeders_shed"]
                feeders = http.get("/api/v1/feeders").json()["feeders"]
                now = time.monotonic()
                shed = [one["name"] for one in feeders if one.get("cause") == "overload"]
                returned |= dict.fromkeys(shed, now)
                found.most = max(found.most, len(shed))
                if metrics(own)["gridsec_feeders_shed"] == before:
                    found.compared += 1
                    found.different += len(shed) != before
                for one in feeders:
                    if now - returned.get(one["name"], float("-inf")) > LATE_S:
                        found.monitored += 1
                        found.late += one.get("age_s") is None or one["age_s"] > LATE_S

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join(30.0)


def settling(service: Service, names: Sequence[str], meters: int, limit_s: float) -> float:
    """Time until every meter is seen and every verdict is CLEAN, s; infinite if beyond the limit."""
    begun = time.monotonic()
    while time.monotonic() < begun + limit_s:
        feeders = {one["name"]: one for one in service.http.get("/api/v1/feeders").json()["feeders"]}
        clean = all(feeders[name].get("verdict") == "clean" for name in names)
        if clean and metrics(service)["gridsec_meters_seen"] == meters * len(names):
            return time.monotonic() - begun
        time.sleep(0.2)
    return float("inf")


def measure(
    tree: Path,
    folder: Path,
    names: Sequence[str],
    load: Load,
    *,
    seconds: float,
    stages: int = STAGES,
    database: str | None = None,
) -> Outcome:
    """Measure one source tree: one process, or with a database a front with workers."""
    workers = 0 if database is None else WORKERS
    base = float(len(load.keys))
    print(f"{tree}: {len(names)} feeders, {len(load.keys)} sources", flush=True)
    print("sent/s  used/s  judged  decided  seen", flush=True)
    with running(tree, folder, names, workers=workers, database=database) as service:
        sender = Sender(load, service.zenoh, base)
        sender.start()
        try:
            if settling(service, names, len(load.fields[0]) - 1, START_S) == float("inf"):
                raise SystemExit("not every feeder is judged")
            sustained, share = 0.0, {} if workers else _totals(service)
            for number in range(stages):
                found = stage(service, sender, load, base * GROWTH**number, STAGE_S)
                _print(found)
                if number == 0 and not workers:
                    share = {name: total - share[name] for name, total in _totals(service).items()}
                if found.decided < DECIDED:
                    break
                sustained = found.offered
            with observed(service) as shedding:
                overload = stage(service, sender, load, OVERLOAD * max(sustained, base), seconds)
            _print(overload)
            sender.rate = base
            recovery_s = settling(service, names, len(load.fields[0]) - 1, RECOVERY_S)
        finally:
            sender.ended.set()
            sender.join(STOP_S)
    kept = share["keep_states"] / share["cycle"] if share else 0.0
    print(f"sustained {sustained:.0f}/s, keep_states {kept:.1%}, recovery {recovery_s:.1f} s", flush=True)
    print(f"{shedding.different} of {shedding.compared} numbers of shed feeders differ", flush=True)
    print(
        f"at most {shedding.most} of {len(names)} shed, on time {shedding.on_time:.3f} of the others",
        flush=True,
    )
    return Outcome(sustained, kept, overload, shedding, recovery_s)


def _print(found: Stage) -> None:
    shares = f"{found.judged:7.2f} {found.decided:8.2f} {found.seen:5.2f}"
    print(f"{found.offered:6.0f} {found.used:7.0f} {shares}", flush=True)


def _totals(service: Service) -> dict[str, float]:
    service.totals.unlink(missing_ok=True)
    service.process.send_signal(signal.SIGUSR1)
    end = time.monotonic() + STOP_S
    while not service.totals.exists():
        if time.monotonic() > end:
            raise SystemExit("the service does not write its totals")
        time.sleep(0.01)
    totals: dict[str, float] = json.loads(service.totals.read_text())
    return totals


def main() -> int:
    """Measure, compare, and check the limits."""
    asked = arguments(__doc__, feeders=10, seconds=60.0, against="", workers=False, rated=False)
    site = load(FEEDER)
    names = [f"feeder-{k:03d}" for k in range(asked.feeders)]
    own = Path(__file__).parents[1]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        database = None
        if asked.workers:
            database = stack.enter_context(running_server(installed_postgresql())).database()
        for name in names:
            tables = site.tables
            write(renamed(tables, name), folder / name)
        said = load_of(site, names)
        stages = 1 if asked.rated else STAGES
        measured = partial(
            measure, folder=folder, names=names, load=said, seconds=asked.seconds, stages=stages
        )
        before = measured(Path(asked.against).resolve(), database=database) if asked.against else None
        now = measured(own, database=database)
    if before is not None:
        print(f"sustained rate, ratio to {asked.against}: {now.sustained / max(before.sustained, 1.0):.2f}")
        print(f"share of keep_states: {before.keep_states:.1%} before, {now.keep_states:.1%} now")
    held = [
        now.recovery_s <= RECOVERY_S,
        now.overload.judged * JUDGED_EVERY_S >= 1.0,
        now.shedding.different == 0,
        now.shedding.on_time >= ON_TIME,
    ]
    return int(not all(held))


if __name__ == "__main__":
    sys.exit(main())
