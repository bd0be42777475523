"""Time until the feeders of a cluster are judged again after a fault, and lost or doubled alarms.

`python -m benchmarks.failover [repetitions] [feeders]`: three workers, every second feeder under attack, each
fault at a random moment; PostgreSQL and zenoh on this machine.
"""

from __future__ import annotations

import random
import tempfile
import time
from pathlib import Path

from benchmarks._arguments import arguments
from feeders.model.site import load
from tests.service.clusters import served_cluster
from tests.service.databases import find_postgresql, running
from tests.service.failovers import OUTAGE_S, Fault, Trial

WORKERS = 3


def main() -> None:
    """Measure, and print a table."""
    given = arguments(__doc__ or "", repetitions=5, feeders=12)
    binaries = find_postgresql()
    if binaries is None:
        raise SystemExit("PostgreSQL's initdb, pg_ctl and postgres are not installed")
    with (
        running(binaries) as server,
        tempfile.TemporaryDirectory(prefix="gridsec-failover-") as folder,
        served_cluster(Path(folder), server.database(), load("cigre-lv"), given.feeders, WORKERS) as live,
    ):
        trial = Trial(live, server, random.Random(int(time.time())))
        trial.begin()
        for _ in range(given.repetitions):
            for fault in (Fault.STOP, Fault.KILL, Fault.FREEZE, Fault.TERMINATE, Fault.ROUTER):
                print(f"{fault}: {trial.strike(fault):.1f} s", flush=True)
        print(f"{Fault.OUTAGE} of {OUTAGE_S:g} s: {trial.strike(Fault.OUTAGE):.1f} s", flush=True)
    print(
        "\nTimes in s, median and largest.\n\n| fault | repetitions | judged | decided |\n|---|---|---|---|"
    )
    for fault, seconds in trial.seconds.items():
        both = (seconds, trial.decided[fault])
        cells = [f"{sorted(each)[len(each) // 2]:.1f}, {max(each):.1f}" for each in both]
        print(f"| {fault} | {len(seconds)} | {' | '.join(cells)} |")
    print(f"\nAlarms lost, doubled or cleared, wrong verdicts: {len(trial.violations)}")
    for one in trial.violations:
        print(f"- {one}")


if __name__ == "__main__":
    main()
