"""Time of one snapshot beside power-grid-model with greedy removal: `python -m benchmarks.peers.speed`.

The same snapshots of 118 customers in one run, in turns; the fastest of many repetitions of each.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.peers.answer import Method
from benchmarks.peers.grid_model import Greedy
from benchmarks.peers.ours import Ours
from benchmarks.peers.scene import Cell, Reading, mean, scene, snapshot

FEEDER = "rural3-behind"
REPEATS, SNAPSHOTS = 15, 12
CASES = (("clean", 0), ("bias", 1), ("bias", 3), ("bias", 6), ("coord", 3), ("coord+pq", 3))


def fastest(methods: tuple[Method, ...], told: Reading) -> list[float]:
    """Seconds of the fastest repetition of each."""
    best = [np.inf] * len(methods)
    for _ in range(REPEATS):
        for k, method in enumerate(methods):
            start = time.perf_counter()
            method(told)
            best[k] = min(best[k], time.perf_counter() - start)
    return best


def main() -> None:
    """Measure and print as a table."""
    here = scene(FEEDER)
    methods: tuple[Method, ...] = (Greedy(here, 3.5), Ours(here))
    print("| 118 customers | power-grid-model + greedy, ms | ours, ms | ratio |\n|---|---|---|---|")
    for attack, liars in CASES:
        cell = Cell(FEEDER, 0.001, 0.1, attack, liars)
        told = (mean(snapshot(here, cell, np.random.default_rng([i, liars]))) for i in range(SNAPSHOTS))
        times = np.median([fastest(methods, each) for each in told], axis=0) * 1e3
        name = f"{attack} {liars}" if liars else attack
        print(f"| {name} | {times[0]:.2f} | {times[1]:.2f} | {times[0] / times[1]:.2f} |", flush=True)


if __name__ == "__main__":
    main()
