"""Colluding meters with a customer that also reports the power of the load that they pretend.

    python -m benchmarks.false_powers [seeds]

Two meters show the trace of a load that is not there, at least 3 % deep, and the customer's own meter
reports that load's power ("coordinated-power"). What is false fits together; only the honest neighbours
contradict. The reverse: one meter reports the power of a load that is not there and would be 2 % deep, and
all voltages are true ("power"); what is false is then told as a customer's power, never as an honest meter.
As a control the same feeders and seeds with the trace alone, and with two independent lies of 3 %. Counted
is, over the minute of the lie: exactly the manipulated meters named and no other; some of them named; none,
but the liars are among the explanations given; no meter named and UNDECIDED for another reason; an honest
meter named; CLEAN.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import Site, load, to_frame
from feeders.registry import DesignedEstimator, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec, NoSuchAttack, manipulations
from feeders.simulation.scenario import START, Scenario, simulate, snapshots

FEEDERS = ("cigre-lv", "simbench-lv-rural1", "kerber-landnetz", "simbench-lv-rural3")
DURATION_S, ONSET_S, MOST = 90.0, 30.0, 2
LIES = (
    AttackSpec(AttackKind.COORDINATED_POWER, 2, 3.0, ONSET_S),
    AttackSpec(AttackKind.POWER, 1, 2.0, ONSET_S),
    AttackSpec(AttackKind.COORDINATED, 2, 3.0, ONSET_S),
    AttackSpec(AttackKind.BIAS, 2, 3.0, ONSET_S),
)
OUTCOMES = ("exactly", "some", "explained", "undecided", "honest named", "clean")


def outcome(site: Site, watcher: DesignedEstimator, lie: AttackSpec, seed: int) -> str:
    """What came of one run.

    Parameters
    ----------
    site, watcher, lie, seed
        Feeder, estimator, manipulation, and number of the run.

    Raises
    ------
    NoSuchAttack
        Where there is no place for such a load.
    """
    profile = float(np.random.default_rng(seed).uniform(0.0, 13.9 * 86_400.0))
    quiet = Scenario(seed=seed, duration_s=DURATION_S, profile_s=profile)
    attacks, _ = manipulations(site, lie, quiet)
    truth = np.zeros(site.meters.size, dtype=np.bool_)
    truth[[int(j) for attack in attacks for j in attack.meters]] = True
    state, named, told = watcher.init(START - 1.0), np.zeros_like(truth), False
    decision = ""
    for snapshot in snapshots(simulate(site, replace(quiet, attacks=attacks))):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        if snapshot.t > START + ONSET_S:
            named |= verdict.suspects
            told |= any(np.array_equal(each.meters, truth) for each in verdict.explanations)
            decision = verdict.decision
    if (named & ~truth).any():
        return "honest named"
    if named.any():
        return "exactly" if np.array_equal(named, truth) else "some"
    return "explained" if told else str(decision)


def main(seeds: int) -> None:
    """Count and print."""
    print("| feeder | lie | " + " | ".join(OUTCOMES) + " |\n|---|---|" + "---|" * len(OUTCOMES))
    for name in FEEDERS:
        site = choose(load(name), max_attacked=MOST)
        watcher = design(site)
        for lie in LIES:
            tally: Counter[str] = Counter()
            for seed in range(seeds):
                try:
                    tally[outcome(site, watcher, lie, seed)] += 1
                except NoSuchAttack:
                    continue
            print(
                f"| {name} | {lie.trick} | " + " | ".join(str(tally[each]) for each in OUTCOMES) + " |",
                flush=True,
            )


if __name__ == "__main__":
    main(arguments(__doc__, seeds=30).seeds)
