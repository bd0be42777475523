"""Agreement of the names by `modal` and by the exact bank.

    python -m benchmarks.agreement [scenarios]

Random minutes on the feeders that are small enough for the bank with M = 2 (CIGRE LV, SimBench rural 1,
Kerber Landnetz): any time of the fourteen days, no meter, one or two meters manipulated by bias, scaling or
a fake load of 1 to 6 %. Compared are the meters named at the end, half a minute after the onset. Where they
differ, the residual of the meter in question is put beside both limits: the bank's is a worst case, the
monitor's a statistical one.
"""

from __future__ import annotations

import os
import sys
from collections import Counter

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import Site, load, to_frame
from feeders.registry import DIRECT, DesignedEstimator, choose, design
from feeders.simulation.attacks import NoSuchAttack
from feeders.simulation.scenario import START, Scenario, random_attacks, simulate, snapshots
from gridsec.interface import Verdict

FEEDERS = ("cigre-lv", "simbench-lv-rural1", "kerber-landnetz")
KINDS = ("bias", "scaling", "coordinated")
DURATION_S, ONSET_S = 90.0, 60.0


def scenario(site: Site, seed: int) -> Scenario:
    """One minute and a half, the last half minute with liars, or without.

    Parameters
    ----------
    site, seed
        Where, and which.
    """
    rng = np.random.default_rng([7, seed])
    quiet = Scenario(seed=seed, duration_s=DURATION_S, profile_s=float(rng.uniform(0.0, 13.9 * 86_400.0)))
    count = int(rng.integers(0, 3))
    if not count:
        return quiet
    kind, size = KINDS[int(rng.integers(len(KINDS)))], float(rng.uniform(0.01, 0.06))
    try:
        attacks = random_attacks(
            site, seed, kind, count, size, t_on=START + ONSET_S, t_off=START + DURATION_S, scenario=quiet
        )
    except NoSuchAttack:
        return quiet
    return Scenario(seed=seed, duration_s=DURATION_S, profile_s=quiet.profile_s, attacks=attacks)


def compare(
    site: Site, watchers: tuple[DesignedEstimator, DesignedEstimator], seed: int
) -> tuple[list[Verdict], set[int]]:
    """The last verdicts of both on the same readings, and the manipulated meters.

    Parameters
    ----------
    site, watchers, seed
        Feeder, estimators, and number of the run.
    """
    what = scenario(site, seed)
    states = [watcher.init(START - 1.0) for watcher in watchers]
    verdicts: list[Verdict] = []
    for snapshot in snapshots(simulate(site, what)):
        frame = to_frame(site, snapshot)
        verdicts = []
        for k, watcher in enumerate(watchers):
            states[k], _, verdict = watcher.step(states[k], frame)
            verdicts.append(verdict)
    return verdicts, {int(j) for attack in what.attacks for j in attack.meters}


def main(count: int) -> int:
    """Compare; 1 if one of them ever names an honest meter."""
    sites = [choose(load(name), max_attacked=2) for name in FEEDERS]
    both = [(design(site), design(choose(site, estimator=DIRECT))) for site in sites]
    tally: Counter[str] = Counter()
    wrong = 0
    for seed in range(count):
        at = seed % len(sites)
        (ours, bank), liars = compare(sites[at], both[at], seed)
        named = [set(np.flatnonzero(verdict.suspects).tolist()) for verdict in (ours, bank)]
        wrong += any(each - liars for each in named)
        if named[0] == named[1]:
            tally["the same meters" if named[0] == liars else "the same, liars below both limits"] += 1
            continue
        more, less, verdict, side = (
            (0, 1, bank, "the bank's") if named[0] > named[1] else (1, 0, ours, "ours")
        )
        tally[f"one more below {side} limit" if named[more] > named[less] else "other meters"] += 1
        for j in sorted(named[more] - named[less]):
            print(
                f"{FEEDERS[at]} {seed}: meter {j} {'lies' if j in liars else 'IS HONEST'}, named with "
                f"{(ours, bank)[more].score[j]:.4f} > {(ours, bank)[more].threshold[j]:.4f}; "
                f"other: {verdict.score[j]:.4f}, limit {verdict.threshold[j]:.4f} ({verdict.decision})"
            )
    for what, times in tally.most_common():
        print(f"{times:5} of {count}: {what}")
    print(f"{wrong:5} of {count}: an honest meter named by either")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(arguments(__doc__, scenarios=1000).scenarios))
