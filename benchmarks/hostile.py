"""Effect of hostile clients and wrong clocks on a single service and on a front with two workers.

    python -m benchmarks.hostile [SECONDS] [FEEDERS]

Idle connections, stalled streams, and floods of one peer by form (`tests.service.hostile`), each for SECONDS.
For each attack: slowest list of the feeders, largest age of a tick of the other feeders, late ones (age above
5 s), those with another verdict, failed requests, growth of private memory and of the logs. Exit code 1 if a
feeder is late or changes its verdict, or a request fails.

Wrong clocks: those of the front, of one worker, and of all processes and meters leap by an hour, forward and
back. For each: other feeders with another verdict meanwhile, and time until all are decided after it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from benchmarks._arguments import arguments
from feeders.model.site import load
from tests.service import hostile
from tests.service.clusters import served_cluster
from tests.service.databases import Cluster, installed_postgresql, running
from tests.service.running import until

FEEDER = "cigre-lv"


def print_attacks(server: Cluster, seconds: float, feeders: int) -> bool:
    """Print the effect of the attacks; True if a limit is missed."""
    missed = False
    print("| processes | attack | list, s | age, s | late | changed | failed | memory, MB | log lines |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for kind, options in hostile.KINDS.items():
        with (
            tempfile.TemporaryDirectory(prefix="gridsec-hostile-") as folder,
            served_cluster(
                *(Path(folder), server.database(), load(FEEDER), feeders, 0), options=options
            ) as live,
        ):
            hostile.decided(live)
            for name, (attack, names) in hostile.attacks(live).items():
                cost = hostile.attacked(live, attack(), seconds)
                watch, late = cost.watch, cost.watch.late(names)
                age_s = max(watch.ages_s.get(name, float("inf")) for name in names)
                changed = watch.changed(names)
                counts = f"{len(late)} | {len(changed)} | {len(watch.failed)}"
                cells = f"{watch.slowest_s:.2f} | {age_s:.1f} | {counts}"
                print(f"| {kind} | {name} | {cells} | {cost.memory_mb:+.1f} | {cost.lines} |", flush=True)
                missed |= bool(late or changed or watch.failed)
                hostile.decided(live)
    return missed


def print_leaps(server: Cluster, feeders: int) -> bool:
    """Print the effect of wrong clocks; True if another feeder changed its verdict."""
    missed = False
    print("\n| clock | leap, s | others changed | decided after, s |\n|---|---|---|---|", flush=True)
    with (
        tempfile.TemporaryDirectory(prefix="gridsec-hostile-") as folder,
        served_cluster(Path(folder), server.database(), load(FEEDER), feeders, 2) as live,
    ):
        until(lambda: set(live.owners().values()) == {"w0", "w1"}, "the distribution")
        hostile.decided(live)
        for leap_s in (hostile.HOUR_S, -hostile.HOUR_S):
            wrong, after = hostile.front_leaps(live, leap_s)
            changed = {*wrong.changed(live.names), *after.changed(live.names)}
            print(f"| front | {leap_s:+.0f} | {len(changed)} | |", flush=True)
            others = live.owned("w1")
            wrong, over_s = hostile.worker_leaps(live, "w0", leap_s)
            changed_others = wrong.changed(others)
            print(f"| one worker | {leap_s:+.0f} | {len(changed_others)} | {over_s:.1f} |", flush=True)
            missed |= bool(changed or changed_others)
            hostile.decided(live)
        for ahead_s in (hostile.HOUR_S, 0.0):
            leap_s = ahead_s - live.fleet.ahead_s
            over_s = hostile.all_leap(live, ahead_s)
            print(f"| all | {leap_s:+.0f} | | {over_s:.1f} |", flush=True)
    return missed


def main() -> int:
    """Measure, and print two tables."""
    asked = arguments(__doc__, seconds=20.0, feeders=4)
    with running(installed_postgresql()) as server:
        missed = print_attacks(server, asked.seconds, asked.feeders)
        missed |= print_leaps(server, asked.feeders)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
