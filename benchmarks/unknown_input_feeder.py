"""Unknown inputs on real feeders: named devices under a manipulated meter and an inverter off its curve.

AC power flow, meters of class 0.5 with 0.1 V steps and 0.05 % jitter, loads known to the feeder's own limits,
1 reading per second, `max_attacked = 1`. From 15 s to 40 s a random meter is off by `--lie` and a random
inverter injects `--part` of its largest set point beside its curve, both with random signs; judged is the
last second.

    python benchmarks/unknown_input_feeder.py
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from feeders.model.site import Site, load, to_frame
from feeders.registry import DesignedEstimator, choose, design
from feeders.simulation.plant import MeterErrors
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.attack import Bias, InverterAttack
from gridsec.interface import Decision, Verdict

FEEDERS = ("cigre-lv", "simbench-lv-rural1", "kerber-landnetz")
ON_S, END_S = 15.0, 40.0


@dataclass
class Row:
    """What was counted over all seeds of one line of the table."""

    meter: int = 0
    inverter: int = 0
    false: int = 0
    listed: int = 0
    clean: int = 0
    error_kvar: list[float] = field(default_factory=list)
    decisions: Counter[str] = field(default_factory=Counter)
    ms: list[float] = field(default_factory=list)


def run(
    site: Site, watcher: DesignedEstimator, row: Row, seed: int, options: argparse.Namespace, *, q: bool
) -> None:
    """One scenario; counts go into the row."""
    rng = np.random.default_rng(seed)
    liar, wrong = int(rng.integers(site.meters.size)), int(rng.integers(site.droop.tau.size))
    lie = float(rng.choice([-1.0, 1.0])) * options.lie
    part = float(rng.choice([-1.0, 1.0])) * options.part * float(site.droop.limit[wrong])
    scenario = Scenario(
        seed=seed,
        duration_s=END_S,
        errors=MeterErrors(report_q=q),
        attacks=(Bias(np.array([liar]), START + ON_S, START + 99.0, np.array([lie])),) if lie else (),
        inverter_attacks=(InverterAttack(np.array([wrong]), np.array([part]), START + ON_S, START + 99.0),)
        if part
        else (),
    )
    state, verdict = watcher.init(START), None
    for k, snapshot in enumerate(snapshots(simulate(site, scenario))):
        frame = to_frame(site, snapshot)
        began = time.process_time()
        state, _, verdict = watcher.step(state, frame)
        row.ms.append(1e3 * (time.process_time() - began))
        row.clean += verdict.decision is Decision.CLEAN and k > ON_S + 1 and bool(lie or part)
        row.false += bool(
            np.delete(verdict.suspects, liar).any() or np.delete(verdict.inverters, wrong).any()
        )
        row.false += bool((not lie and verdict.suspects[liar]) or (not part and verdict.inverters[wrong]))
    assert isinstance(verdict, Verdict)
    row.meter += bool(verdict.suspects[liar])
    row.inverter += bool(verdict.inverters[wrong])
    row.listed += any(
        bool(e.inverters[wrong] or not part) and bool(e.meters[liar] or not lie) for e in verdict.explanations
    )
    row.decisions[str(verdict.decision)] += 1
    if verdict.inverters[wrong]:
        row.error_kvar.append(abs(float(verdict.inverter_attack[wrong]) - part) * site.feeder.base_kva)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--lie", type=float, default=0.04, help="pu")
    parser.add_argument("--part", type=float, default=1.0, help="of the largest set point")
    options = parser.parse_args()
    print(
        "| feeder | pairs | q reported | meter named | inverter named | truth among explanations | false | ",
        end="",
    )
    print("seconds called clean | last verdicts | kvar off, median | ms of CPU per step, median, 95 % |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name in FEEDERS:
        site = choose(load(name), estimator="unknown-input", max_attacked=1)
        watcher = design(site)
        for q in (True, False):
            row = Row()
            for seed in range(options.seeds):
                run(site, watcher, row, seed, options, q=q)
            off = f"{np.median(row.error_kvar):.2f}" if row.error_kvar else "–"
            ms = f"{np.median(row.ms):.1f}, {np.percentile(row.ms, 95):.0f}"
            said = ", ".join(f"{n} {d}" for d, n in row.decisions.most_common())
            print(
                f"| {name} | {watcher.observers} | {'yes' if q else 'no'} | {row.meter} | {row.inverter} | "
                f"{row.listed} | {row.false} | {row.clean} | {said} | {off} | {ms} |"
            )


if __name__ == "__main__":
    main()
