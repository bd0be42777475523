"""Weights of the statistical core's explanations against the share of them that is right.

    python -m benchmarks.calibration_core [runs] [seed]

Random trees of 8 to 20 customers, residuals drawn from the model of `gridsec.estimators.modal`, meters of the
class 0.5 % with a jitter of 0.05 or 0.2 %. After 100 honest ticks, 0 to 4 meters are manipulated, at most a
third, random or neighbours, with independent amounts, as in the prior of the search, or by one amount; their
standard deviation is 0.3, 1 or 3 %. In half of the runs two customers switch 1 to 11 kW besides, which no
report shows. Five to sixty ticks later there is one look, if there is an alarm.

First table: the likeliest explanation, by its weight: number of looks, mean weight, and share in which its
meters are exactly the manipulated ones. Second table: single meters, by the weight of all explanations with
the meter. Last line: looks with a name, and looks with an honest meter named.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from benchmarks._arguments import arguments
from benchmarks._residuals import BASE_KVA, Source, power_columns, tree_core
from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import core
from gridsec.estimators.modal.core import Core

QUIET, EARLIEST, LATEST = 100, 5, 60
"""Honest ticks, and ticks from the onset to the look."""
MOST = 4
"""Largest number of manipulated meters; more than a third have a penalty in the search."""
TREES = 24
"""Number of trees."""
SIZES = (0.006, 0.02, 0.06)
"""Standard deviations of the amounts, squared pu: 0.3, 1 and 3 % of the voltage."""
EDGES = np.array([0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.999, 1.0 + 1e-9])
"""Edges of the bins of weights."""


@lru_cache(maxsize=TREES)
def kernel_of(number: int) -> tuple[Core, Floats]:
    """Core of one tree, and the effect of its customers' active powers on the meters."""
    kernel, feeder = tree_core(number, 3, (8, 21))
    return kernel, power_columns(feeder)[:, : feeder.bus.size]


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One look at an alarm: weights, meters of the likeliest explanation, named and manipulated meters."""

    weight: float
    likeliest: Bools
    marginal: Floats
    named: Bools
    liars: Bools


def manipulated(kernel: Core, random: np.random.Generator) -> Floats:
    """Manipulation of each meter, squared pu, (p,)."""
    p, size = kernel.modes.size, float(random.choice(SIZES))
    count = int(random.integers(0, min(MOST, p // 3) + 1))
    which = random.permutation(p)[:count]
    if random.random() < 0.5:
        S = kernel.model.loads(np.arange(p))
        near = S.diagonal() + S.diagonal()[:, None] - 2.0 * S
        which = np.argsort(near[int(random.integers(p))])[:count]
    out = np.zeros(p)
    alike = random.random() < 0.5
    out[which] = size * (random.standard_normal() if alike else random.standard_normal(count))
    return out


def run(seed: int) -> Look | None:
    """One run; None without an alarm."""
    random = np.random.default_rng([seed, 70])
    kernel, effect = kernel_of(int(random.integers(TREES)))
    source, lie = Source(kernel.model, random), manipulated(kernel, random)
    look, p = QUIET + int(random.integers(EARLIEST, LATEST)), kernel.modes.size
    steps = np.zeros((look + 1, p))
    if random.random() < 0.5:
        for j in random.permutation(p)[:2]:
            steps[int(random.integers(QUIET, look)) :, j] = -random.uniform(1.0, 11.0) / BASE_KVA
    state = core.init(kernel, 0.0)
    for k in range(look + 1):
        m = source.tick() + lie * (k >= QUIET) + effect @ steps[k]
        state, evidence = core.step(kernel, state, float(k), m)
    if not core.alarmed(kernel, evidence):
        return None
    found = core.identify(kernel, state, evidence).found
    sets = found.chosen[:, :p]
    # Explanations that differ by powers or by the model of the loads are the same for meters.
    same = (sets == sets[0]).all(axis=1)
    return Look(float(found.weight[same].sum()), sets[0], found.weight @ sets, found.named, lie != 0.0)


def table(weight: Floats, right: Bools, what: str) -> None:
    """One table."""
    print(f"\n| weight | {what} | mean weight, % | right, % |\n|---|---|---|---|")
    for low, high in pairwise(EDGES):
        inside = (weight >= low) & (weight < high)
        if inside.any():
            text = f"{100 * weight[inside].mean():.1f} | {100 * right[inside].mean():.1f}"
            print(f"| {low:g} to {min(high, 1.0):g} | {np.count_nonzero(inside)} | {text} |", flush=True)


def main(runs: int, seed: int) -> int:
    """Both tables; 1 if an honest meter is named in more than one look of a hundred."""
    looks = [look for look in map(run, range(seed, seed + runs)) if look is not None]
    right = np.array([bool((each.likeliest == each.liars).all()) for each in looks])
    table(np.array([each.weight for each in looks]), right, "looks")
    marginal = np.concatenate([each.marginal for each in looks])
    table(marginal, np.concatenate([each.liars for each in looks]), "meters")
    named = sum(bool(each.named.any()) for each in looks)
    honest = sum(bool((each.named & ~each.liars).any()) for each in looks)
    print(f"\n{len(looks)} looks of {runs} runs; a meter is named in {named}, an honest one in {honest}")
    return int(honest > 0.01 * len(looks))


if __name__ == "__main__":
    asked = arguments(__doc__, runs=2000, seed=1)
    sys.exit(main(asked.runs, asked.seed))
