"""Comparison with open tools: `python -m benchmarks.peers [--trials N] [--write docs]`.

Without `--write` a short run that prints its tables. With it, docs/peers.md and its figures are written.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from benchmarks.peers import report
from benchmarks.peers.grid_model import Greedy
from benchmarks.peers.measure import FALSE, SERVED, beaten, cells, measure, prepared, too_many, votes, watched

FEEDERS = ("rural1-behind", "rural3-behind")


def main() -> int:
    """Measure, print, and write if asked for.

    Exits 1 if ours names a meter too often in any clean cell, or if a peer is exact more often in any other
    one; in both beyond what may be chance.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--panda", type=int, default=3, help="trials of pandapower, the slowest")
    parser.add_argument("--clean", type=int, default=100, help="trials of clean snapshots")
    parser.add_argument("--minute", type=int, default=4, help="trials with 60 s of data")
    parser.add_argument("--feeders", nargs="*", default=list(FEEDERS))
    parser.add_argument("--save", type=Path, help="keep the numbers in a file")
    parser.add_argument("--load", type=Path, nargs="*", help="take the numbers from files instead")
    parser.add_argument("--speed", type=Path, help="the table that benchmarks.peers.speed printed")
    parser.add_argument("--write", type=Path, help="folder for peers.md and its figure")
    wanted = parser.parse_args()
    single, minute = report.load(wanted.load) if wanted.load else _run(wanted)
    if wanted.save:
        report.save(wanted.save, single, minute)
    print(report.tables(single, minute))
    if wanted.write:
        speed = wanted.speed.read_text(encoding="utf-8") if wanted.speed else "Not measured.\n"
        report.write(wanted.write, single, minute, speed)
    often, worse = too_many(single), beaten(single)
    for cell in often:
        print(
            f"{cell.feeder} {cell.std_v:g}: more than {100 * FALSE:g} % of clean snapshots", file=sys.stderr
        )
    for cell in worse:
        print(f"{cell.feeder} {cell.std_v:g} {cell.attack} {cell.liars}: a peer is better", file=sys.stderr)
    return int(bool(often or worse))


def _run(wanted: argparse.Namespace) -> tuple[report.Scores, report.Scores]:
    logging.disable(logging.CRITICAL)
    single: report.Scores = {}
    minute: report.Scores = {}
    for feeder in wanted.feeders:
        here, every = prepared(feeder)
        voter = Greedy(here, 3.5)
        for cell in cells((feeder,)):
            clean = cell.attack == "clean"
            trials = wanted.clean if clean else wanted.trials
            single[cell] = measure(cell, here, every, trials=trials, panda=min(trials, wanted.panda))
            print(report.line(cell, single[cell]), flush=True)
            if wanted.minute:
                few = min(wanted.minute, wanted.panda)
                minute[cell] = measure(cell, here, every, trials=wanted.minute, panda=few, seconds=60)
                minute[cell]["pgm votes"] = votes(cell, here, voter, trials=wanted.minute, seconds=60)
                minute[cell][SERVED] = watched(cell, here, trials=wanted.minute, seconds=60)
                print("60 s", report.line(cell, minute[cell]), flush=True)
    return single, minute


if __name__ == "__main__":
    sys.exit(main())
