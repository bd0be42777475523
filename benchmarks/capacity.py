"""Processor, memory, disk and network of a fleet for each meter, and the sizes of larger fleets.

    python -m benchmarks.capacity [FEEDERS] [TICK_S] [SECONDS] [--workers]

Feeders are copies of the Kerber suburban network, 146 meters and the busbar each. All meters of a feeder
report in one batch in Arrow once in TICK_S; the feeders are spread over three tenths of it. The service is a
process of its own with SQLite, or a front with two workers and PostgreSQL.

Cost model: cores, proportional set size of all processes, bytes/s of the database and bytes/s of the payloads
are a fixed part and a part for each feeder. Both are measured with two small fleets, the larger of which has
a fifth of the feeders, at most twice `LEAST`. The whole fleet is measured too, and compared with the model.

The last table extrapolates to 1, 10 and 30 million meters at several ticks: cores with a load of `TARGET`,
memory, disk a day, network. The cost of a feeder follows from the smallest and the whole fleet.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks._arguments import arguments
from benchmarks.fleet import FEEDER, OWN, WORKERS, Fleet, spent_s
from benchmarks.overload import Service, metrics, renamed, running
from feeders.format.tables import write
from feeders.model.site import Site, load
from tests.service.databases import installed_postgresql
from tests.service.databases import running as running_server

LEAST = 64
"""Largest number of feeders of the small fleet."""
WARM_TICKS = 4
"""Ticks before the measurement: the first report of all meters and the states after it."""
START_S = 900.0
TARGET = 0.7
"""Load of a core that leaves room for restarts, late readings and other fluctuations."""
MILLIONS = (1, 10, 30)
TICKS_S = (1.0, 10.0, 60.0, 900.0)
"""Reporting intervals of the table, s."""


@dataclass(frozen=True)
class Cost:
    """One fleet: feeders, cores, bytes of memory, bytes/s on disk and network, late or undecided ticks."""

    feeders: int
    cores: float
    memory: float
    disk: float
    network: float
    start_s: float
    clean: float
    lost: float
    delay_s: float


def memory(process: int) -> float:
    """Proportional set size of a process and its living children, bytes."""
    text = Path(f"/proc/{process}/smaps_rollup").read_text()
    own = next(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return 1024.0 * own + sum(memory(int(one)) for one in children)


def size(folder: Path) -> float:
    """Bytes of all files of a database, without the segments of PostgreSQL's log, which are reused."""
    found = 0
    for one in folder.rglob("*"):
        # A temporary file may end meanwhile.
        with suppress(FileNotFoundError):
            found += one.stat().st_size if one.is_file() and "pg_wal" not in one.parts else 0
    return float(found)


def cost(site: Site, feeders: int, tick_s: float, seconds: float, *, workers: bool) -> Cost:
    """Measure one fleet."""
    tables = replace(
        site.tables, meta=replace(site.tables.meta, monitor=replace(site.tables.meta.monitor, tick_s=tick_s))
    )
    names = [f"feeder-{k:05d}" for k in range(feeders)]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gridsec-capacity-")))
        for name in names:
            write(renamed(tables, name), folder / "feeders" / name)
        database, place = None, folder / "state"
        place.mkdir()
        if workers:
            server = stack.enter_context(running_server(installed_postgresql()))
            database, place = server.database(), server.folder
        begun = time.monotonic()
        service = stack.enter_context(
            running(
                OWN,
                place if not workers else folder,
                [f"{folder}/feeders/{name}" for name in names],
                workers=WORKERS if workers else 0,
                database=database,
                start_s=START_S,
            )
        )
        start_s = time.monotonic() - begun
        reports = Fleet(site, names, "arrow", service.zenoh, tick_s=tick_s)
        reports.start()
        stack.callback(reports.join, 10.0)
        stack.callback(reports.ended.set)
        return _measured(service, reports, place, feeders, tick_s, seconds, start_s)


def _measured(  # noqa: PLR0917
    service: Service,
    reports: Fleet,
    place: Path,
    feeders: int,
    tick_s: float,
    seconds: float,
    start_s: float,
) -> Cost:
    time.sleep((WARM_TICKS + 1) * tick_s)
    before, begun = metrics(service), time.monotonic()
    spent, sent, stored = spent_s(service.process.pid), reports.sent, size(place)
    time.sleep(seconds)
    cores = spent_s(service.process.pid) - spent
    after, lasted = metrics(service) - before, time.monotonic() - begun
    delay = after["gridsec_report_delay_seconds_sum"] / max(1.0, after["gridsec_report_delay_seconds_count"])
    return Cost(
        feeders=feeders,
        cores=cores / lasted,
        memory=memory(service.process.pid),
        disk=(size(place) - stored) / lasted,
        network=(reports.sent - sent) / lasted,
        start_s=start_s,
        clean=after["gridsec_ticks_total clean"] * tick_s / (lasted * feeders),
        lost=after["gridsec_samples_dropped_total"] + after["gridsec_ticks_skipped_total"],
        delay_s=delay,
    )


def main() -> int:
    """Measure three fleets, compare the largest with the model of the others, and print the sizes."""
    asked = arguments(__doc__, feeders=69, tick_s=1.0, seconds=60.0, workers=False)
    site, tick_s = load(FEEDER), asked.tick_s
    meters = len(site.meter_ids)
    few = max(1, min(LEAST, asked.feeders // 10))
    one, two, all_ = (
        cost(site, number, tick_s, asked.seconds, workers=asked.workers)
        for number in (few, 2 * few, asked.feeders)
    )
    print(
        "| feeders | meters | cores | memory, MB | disk, kB/s | sent, kB/s | start | clean | lost | delay |",
        "|---|---|---|---|---|---|---|---|---|---|",
        sep="\n",
    )
    for now in (one, two, all_):
        print(
            f"| {now.feeders} | {now.feeders * meters} | {now.cores:.3f} | {now.memory / 1e6:.0f} | "
            f"{now.disk / 1e3:.1f} | {now.network / 1e3:.1f} | {now.start_s:.1f} | {now.clean:.3f} | "
            f"{now.lost:.0f} | {now.delay_s:.2f} |"
        )
    lines = {name: line(one, two, name) for name in ("cores", "memory", "disk", "network")}
    print("\nMeasured over predicted by the line through the two small fleets:")
    for name, (fixed, each) in lines.items():
        print(f"- {name}: {getattr(all_, name) / (fixed + each * all_.feeders):.2f}")
    print_sizes(one, all_, tick_s, meters)
    return int(not (all_.clean > 0.98 and all_.lost == 0))


def line(one: Cost, two: Cost, name: str) -> tuple[float, float]:
    """Fixed part of a figure, and its part for each feeder."""
    each = (getattr(two, name) - getattr(one, name)) / (two.feeders - one.feeders)
    return getattr(one, name) - each * one.feeders, each


def print_sizes(small: Cost, whole: Cost, tick_s: float, meters: int) -> None:
    """Print cores, memory, disk and network of larger fleets, by the line through the measured fleets."""
    cores, stored, bytes_, sent = (
        line(small, whole, name)[1] / meters for name in ("cores", "memory", "disk", "network")
    )
    kept_s = max(10.0, tick_s)
    print("\nEach meter:")
    print(f"- {1e6 * cores * tick_s:.1f} us of a core for a tick")
    print(f"- {stored / 1e3:.1f} kB of memory")
    print(f"- {bytes_ * kept_s:.1f} bytes on disk for a kept tick")
    print(f"- {sent * tick_s:.0f} bytes of network for a reading\n")
    print("| meters | tick, s | cores at the target load | memory, GB | disk a day, GB | network, MB/s |")
    print("|---|---|---|---|---|---|")
    for million in MILLIONS:
        number = 1e6 * million
        for each in TICKS_S:
            need = math.ceil(number * cores * tick_s / each / TARGET)
            disk = number * bytes_ * kept_s / max(10.0, each) * 86400.0
            print(
                f"| {million} M | {each:g} | {need} | {number * stored / 1e9:.0f} | {disk / 1e9:.0f} | "
                f"{number * sent * tick_s / each / 1e6:.2f} |"
            )


if __name__ == "__main__":
    sys.exit(main())
