"""Time until the feeders of a cluster are judged again after a fault, and lost or doubled alarms.

`python -m benchmarks.failover [repetitions] [feeders] [faults ...]`: three workers, every second feeder under
attack, each fault at a random moment; PostgreSQL and zenoh on this machine. `faults` are names of
`tests.service.failovers.Fault`, by default all. The table is printed after each repetition, and at the end of
an interrupted run; a fault without an answer is a violation, and the run continues.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import httpx

from benchmarks._arguments import arguments
from feeders.model.site import load
from tests.service.clusters import served_cluster
from tests.service.databases import installed_postgresql, running
from tests.service.failovers import Fault, Trial

WORKERS = 3


def main() -> None:
    """Measure, and print a table."""
    given = arguments(__doc__ or "", repetitions=5, feeders=12, faults=())
    unknown = set(given.faults) - set(Fault)
    if unknown:
        raise SystemExit(f"unknown: {', '.join(sorted(unknown))}; faults: {', '.join(Fault)}")
    faults = [Fault(name) for name in given.faults] or list(Fault)
    with (
        running(installed_postgresql()) as server,
        tempfile.TemporaryDirectory(prefix="gridsec-failover-") as folder,
        served_cluster(
            *(Path(folder), server.database(), load("cigre-lv"), given.feeders, WORKERS),
            two_routers=Fault.SECOND in faults,
        ) as live,
    ):
        trial = Trial(live, server, random.Random(int(time.time())))
        trial.begin()
        try:
            for _ in range(given.repetitions):
                _strike_each(trial, faults)
                _print_table(trial)
        finally:
            _print_table(trial)
            print(f"\nAlarms lost, doubled or cleared, wrong verdicts: {len(trial.violations)}")
            for one in trial.violations:
                print(f"- {one}")


def _strike_each(trial: Trial, faults: Sequence[Fault]) -> None:
    """Cause each fault once, and print its times."""
    for fault in faults:
        try:
            judged, decided = trial.strike(fault)
        except (AssertionError, httpx.HTTPError) as error:
            trial.violations.append(f"{fault}: {error}")
            print(f"{fault}: {error}", flush=True)
            trial.restart_workers()
        else:
            print(f"{fault}: judged {judged:.1f} s, decided {decided:.1f} s", flush=True)


def _print_table(trial: Trial) -> None:
    """Print median and largest time of each fault, s."""
    print("\n| fault | repetitions | judged, s | decided, s |\n|---|---|---|---|")
    for fault, seconds in trial.seconds.items():
        both = (seconds, trial.decided[fault])
        cells = [f"{sorted(each)[len(each) // 2]:.1f}, {max(each):.1f}" for each in both]
        print(f"| {fault} | {len(seconds)} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
