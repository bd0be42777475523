"""Time from the restart of a single process until its feeders are judged, and CLEAN.

`python -m benchmarks.restart [repetitions] [feeders]`: `gridsec serve` with SQLite, stopped by SIGTERM and by
`kill -9` in turn, and started at once; honest meters report by the wall clock over zenoh on this machine.
"""

from __future__ import annotations

import random
import signal
import tempfile
import time
from pathlib import Path

from benchmarks._arguments import arguments
from feeders.model.site import load
from tests.service.clusters import Process, ServedCluster

PATIENCE_S = 240.0


def main() -> None:
    """Measure, and print a table."""
    given, rng = arguments(__doc__ or "", repetitions=5, feeders=6), random.Random(1)
    print("Seconds from the start of the new process until every feeder is judged, and CLEAN.\n")
    print("| end of the old one | judged, s | CLEAN, s | CLEAN after judged, s |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory(prefix="gridsec-restart-") as folder:
        live = ServedCluster(Path(folder), f"sqlite:///{folder}/s.db", load("cigre-lv"), given.feeders)
        try:
            live.start_front("--clock", "wall")
            live.fleet.start()
            live.judged_within(live.names, time.time(), PATIENCE_S)
            for _ in range(given.repetitions):
                for number in (signal.SIGTERM, signal.SIGKILL):
                    time.sleep(4.0 + rng.random())
                    judged, clean = _restart(live, number)
                    print(
                        f"| {number.name} | {judged:.1f} | {clean:.1f} | {clean - judged:.1f} |", flush=True
                    )
        finally:
            live.end()


def _restart(live: ServedCluster, number: signal.Signals) -> tuple[float, float]:
    """End the process and start it again; times until all feeders are judged, and CLEAN, s."""
    front = live.front
    assert isinstance(front, Process)
    front.send(number)
    front.popen.wait()
    front.end()
    live.http.close()
    began = time.time()
    live.start_front("--clock", "wall")
    judged = live.judging_within(live.names, began, PATIENCE_S)
    return judged, max(judged, live.judged_within(live.names, began, PATIENCE_S))


if __name__ == "__main__":
    main()
