"""Effect of hostile clients on a single service and on a front with two workers.

    python -m benchmarks.hostile [SECONDS] [FEEDERS]

Idle connections, stalled streams, and floods of one peer by form (`tests.service.hostile`), each for SECONDS.
For each attack: slowest list of the feeders, largest age of a tick of the other feeders, late ones (age above
5 s), those with another verdict, failed requests, growth of private memory and of the logs. Exit code 1 if a
feeder is late or changes its verdict, or a request fails.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from benchmarks._arguments import arguments
from feeders.model.site import load
from tests.service import hostile
from tests.service.clusters import ServedCluster, served_cluster
from tests.service.databases import installed_postgresql, running
from tests.service.running import until

FEEDER = "cigre-lv"


def decided(live: ServedCluster) -> None:
    """Wait until every feeder is displayed as clean."""
    until(lambda: {one["status"] for one in live.listed().values()} == {"clean"}, "verdicts")


def main() -> int:
    """Measure, and print a table."""
    asked = arguments(__doc__, seconds=20.0, feeders=4)
    missed = False
    print(
        "| processes | attack | list, s | age, s | late | changed | failed | memory, MB | log lines |",
        flush=True,
    )
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    with running(installed_postgresql()) as server:
        for kind, options in hostile.KINDS.items():
            with (
                tempfile.TemporaryDirectory(prefix="gridsec-hostile-") as folder,
                served_cluster(
                    *(Path(folder), server.database(), load(FEEDER), asked.feeders, 0), options=options
                ) as live,
            ):
                until(lambda: live.http.get("/readyz").status_code == 200, "readiness")
                decided(live)
                for name, (attack, names) in hostile.attacks(live).items():
                    cost = hostile.attacked(live, attack(), asked.seconds)
                    watch, late = cost.watch, cost.watch.late(names)
                    age_s = max(watch.ages_s.get(name, float("inf")) for name in names)
                    changed = [name for name in names if watch.verdicts.get(name) != {"clean"}]
                    counts = f"{len(late)} | {len(changed)} | {len(watch.failed)}"
                    cells = f"{watch.slowest_s:.2f} | {age_s:.1f} | {counts}"
                    print(f"| {kind} | {name} | {cells} | {cost.memory_mb:+.1f} | {cost.lines} |", flush=True)
                    missed |= bool(late or changed or watch.failed)
                    decided(live)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
