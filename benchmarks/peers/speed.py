"""Time of one snapshot beside power-grid-model with greedy removal: `python -m benchmarks.peers.speed`.

All cells of 118 customers in one run, every method on the same snapshots in turns, the fastest of some
repetitions each. Beside it the served monitor, which gathers evidence second by second: the step in which it
names the liars, and its steps once nothing changes any more. Exits 1 if ours is slower in any cell.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from benchmarks.peers import served
from benchmarks.peers.grid_model import Greedy
from benchmarks.peers.measure import cells
from benchmarks.peers.ours import Ours
from benchmarks.peers.scene import Scene, Snapshot, mean, scene, snapshot
from gridsec.estimators.modal import monitor

FEEDER = "rural3-behind"
REPEATS, SNAPSHOTS, SECONDS, STEADY = 12, 15, 30, 5
_SEED = 5


def fastest(calls: tuple[Callable[[], object], ...]) -> list[float]:
    """Milliseconds of the fastest repetition of each, in turns."""
    best = [np.inf] * len(calls)
    for _ in range(REPEATS):
        for k, call in enumerate(calls):
            start = time.thread_time()
            call()
            best[k] = min(best[k], time.thread_time() - start)
    return [1e3 * each for each in best]


def steps(here: Scene, told: Snapshot) -> tuple[float | None, float]:
    """Milliseconds of the served monitor's step that names first, if one does, and of a steady one."""
    design = served.watch(here, told)
    state, named, times = monitor.init(design, 0.0), False, []
    naming: float | None = None
    for t in range(len(told.v)):
        frame, before = served.frame(told, t), state
        after, _, verdict = monitor.step(design, before, frame)
        now = bool(verdict.suspects.any())
        if (now and not named) or t >= len(told.v) - STEADY:
            times.append(fastest((lambda: monitor.step(design, before, frame),))[0])  # noqa: B023
        if now and not named:
            naming, named = times.pop(), True
        state = after
    return naming, float(np.median(times))


def main() -> int:
    """Measure and print as a table."""
    here = scene(FEEDER)
    greedy, ours = Greedy(here, 3.5), Ours(here)
    print(
        "| 118 customers | power-grid-model + greedy, ms | ours, ms | ratio | served, naming step, ms "
        "| served, steady step, ms |\n|---|---|---|---|---|---|"
    )
    least = np.inf
    for cell in cells((FEEDER,)):
        rows = []
        for trial in range(SNAPSHOTS):
            rng = np.random.default_rng([_SEED, trial, cell.liars])
            told = mean(snapshot(here, cell, rng))
            rows.append(fastest((lambda: greedy(told), lambda: ours(told))))  # noqa: B023
        watched = [
            steps(here, snapshot(here, cell, np.random.default_rng([_SEED, trial, cell.liars]), SECONDS))
            for trial in range(3)
        ]
        peer, own = np.median(rows, axis=0)
        first, steady = ([each[k] for each in watched if each[k] is not None] for k in (0, 1))
        least = min(least, peer / own)
        name = f"{cell.attack} {cell.liars}" if cell.liars else cell.attack
        named, quiet = (f"{np.median(each):.2f}" if each else "-" for each in (first, steady))
        place = f"{100 * cell.std_v:g} % V, {100 * cell.std_pq:g} % PQ, {name}"
        print(f"| {place} | {peer:.2f} | {own:.2f} | {peer / own:.2f} | {named} | {quiet} |", flush=True)
    return int(least <= 1.0)


if __name__ == "__main__":
    sys.exit(main())
