"""A third of the meters lies about voltages, and about powers as well.

    python -m benchmarks.lying_powers [seeds] [feeder ...]

Every liar reads 3 % high or low, and reports an active power that is off by a constant of its own, evenly
drawn up to the size in the second column: nothing that is false fits together. Full AC power flow as truth,
meters of class 0.5, loads known to 0.3 kW and 0.1 kvar (standard deviation) otherwise, one reading a second;
the lie begins after 20 s and lasts for 40. Counted are liars named at the end, honest meters named at any
time, ticks of the lie without the verdict ATTACKED, and the error of the reconstructed voltages at the liars,
in per cent of nominal and in its stated standard deviations (95th percentiles).
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import load
from feeders.registry import design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.scenario import START
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, frames
from gridsec.arrays import Floats
from gridsec.interface import Decision

FEEDERS = ("cigre-lv", "simbench-lv-rural1", "kerber-landnetz", "kerber-dorfnetz")
SIZES_KW = (0.0, 3.0, 6.0, 15.0)
ONSET_S, DURATION_S = 20.0, 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One minute. k liars, T ticks of the lie."""

    liars: int
    named: int
    accused: int
    open: int
    ticks: int
    error: Floats  # (T, k) % of nominal
    ratio: Floats  # (T, k) in standard deviations


def play(feeder: str, size_kw: float, seed: int) -> Run:
    """Play and watch a minute.

    Parameters
    ----------
    feeder, size_kw, seed
        Which.
    """
    site = load(feeder)
    at, count = site.meters, max(1, site.meters.size // 3)
    lie = AttackSpec(AttackKind.BIAS, count, 3.0, onset_s=ONSET_S)
    trial = Trial(
        site,
        seed=seed,
        duration_s=DURATION_S,
        load_error=LoadError(0.3, 0.1),
        meters=TrialMeterErrors.REAL,
        lie=lie,
    )
    watcher = design(trial.stated)
    state = watcher.init(START)
    false = np.random.default_rng(seed).uniform(-1.0, 1.0, at.size) * size_kw / site.feeder.base_kva
    accused, undecided, error, ratio = np.zeros(at.size, dtype=np.bool_), 0, [], []
    for frame, truth in frames(trial):
        p = frame.p.copy()
        p[at] += np.where(truth.liars, false, 0.0)
        state, estimate, verdict = watcher.step(state, replace(frame, p=p))
        accused |= verdict.suspects & ~truth.liars
        if truth.liars.any():
            off, manipulated = np.abs(estimate.v2 - truth.v2), at[truth.liars]
            undecided += verdict.decision is not Decision.ATTACKED
            error.append(50.0 * off[manipulated])
            ratio.append(off[manipulated] / estimate.std[manipulated])
    named = int((verdict.suspects & truth.liars).sum())
    return Run(count, named, int(accused.sum()), undecided, len(error), np.array(error), np.array(ratio))


def main(seeds: int, feeders: tuple[str, ...]) -> int:
    """Print a table; 1 if an honest meter was named."""
    print("| feeder | false kW up to | named | honest named | ticks not ATTACKED | error % | in std |")
    print("|---|---|---|---|---|---|---|")
    worst = 0
    for feeder in feeders:
        for size in SIZES_KW:
            runs = [play(feeder, size, seed) for seed in range(seeds)]
            sums = {name: sum(getattr(run, name) for run in runs) for name in ("named", "liars", "accused")}
            missed = sum(run.open for run in runs) / sum(run.ticks for run in runs)
            error, ratio = (
                np.percentile(np.concatenate([getattr(run, name).ravel() for run in runs]), 95)
                for name in ("error", "ratio")
            )
            cells = f"{sums['named']} of {sums['liars']} | {sums['accused']} | {100.0 * missed:.0f} %"
            print(f"| {feeder} | {size:.0f} | {cells} | {error:.3f} | {ratio:.2f} |", flush=True)
            worst = max(worst, sums["accused"])
    return int(worst > 0)


if __name__ == "__main__":
    asked = arguments(__doc__, seeds=10, feeders=FEEDERS)
    sys.exit(main(asked.seeds, tuple(asked.feeders)))
