"""Coverage of the statistical core's 95 % intervals under manipulations, and honest meters named.

    python -m benchmarks.coverage_core [runs] [seed]

Random trees of 9 to 18 customers, residuals drawn from the model of `gridsec.estimators.modal`, meters of the
class 0.5 % with a jitter of 0.05 or 0.2 %. After 60 honest ticks there are 60 ticks of a manipulation, with
the searches, names and masks of `gridsec.estimators.modal.monitor`:

- drift: the nearest third of a random meter drifts to 0.5, 1 or 1.5 % within 90 ticks, in one direction.
- third: the nearest third of a random meter is off by 0.5 to 3 %.
- random: a random third is off by 0.5 to 3 %.
- majority: the nearest two thirds of a random meter, or random ones, are off by 0.5 to 3 %.
- busbar: the busbar's meter is off by 2 %; the run ends when it is named.
- loads: three customers switch 1 to 11 kW, which no report shows.

Columns: runs with an honest meter named; manipulated meters named, %; intervals of the true voltages that
hold them, over all places and ticks after the onset, and over the ticks with an alarm and no name, %; largest
error over the stated standard deviation; runs with an error above six of them. Exits 1 when an honest meter
is named.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from benchmarks._arguments import arguments
from benchmarks._residuals import BASE_KVA, root, tree_core
from gridsec.arrays import Floats, Ints
from gridsec.estimators.modal import core, verdict
from gridsec.estimators.modal.core import Core, CoreState, Suspicion
from gridsec.estimators.modal.detector import Evidence
from gridsec.estimators.modal.monitor import LOOKS
from gridsec.estimators.modal.naming import CONFIRM, YOUNG, confirmed
from gridsec.grid.network import Power

QUIET, WATCHED, RAMP = 60, 60, 90
"""Honest ticks, ticks of a manipulation, and ticks of a drift."""
TREES = 16
"""Number of trees."""
KINDS = ("drift", "third", "random", "majority", "busbar", "loads")
SIZES = (0.5, 1.0, 1.5, 3.0)
"""Sizes, % of the voltage; drifts take the first three."""
SURE, FAR = 1.959964, 6.0
"""Quantile of the 95 % interval, and errors that must not occur, standard deviations."""


@lru_cache(maxsize=TREES)
def kernel_of(number: int) -> tuple[Core, Floats]:
    """Core of one tree, and the effect of its customers' active powers on the places."""
    kernel, feeder = tree_core(number, 7, (9, 19))
    return kernel, np.asarray(feeder.columns(Power.ACTIVE, np.arange(feeder.bus.size)))


class World:
    """Errors of the model at the places, and the readings' residuals, tick by tick."""

    def __init__(self, kernel: Core, random: np.random.Generator) -> None:
        model = kernel.model
        at = np.arange(model.meters.size)
        self.model, self.random = model, random
        self.rho, self.loads = np.exp(-1.0 / model.time_s), root(model.loads(at))
        self.w = self.loads @ random.standard_normal(at.size)
        self.fixed = np.sqrt(model.fixed) * random.standard_normal(at.size)
        self.busbar = np.sqrt(model.busbar) * random.standard_normal()

    def tick(self) -> tuple[Floats, Floats]:
        """Errors of the model at all places (n,), and residuals (p,)."""
        model, random = self.model, self.random
        truth = np.full(model.variance.size, self.busbar + np.sqrt(model.flicker) * random.standard_normal())
        truth[model.meters] += self.w
        jitter = np.sqrt(model.white) * random.standard_normal(self.w.size)
        m = truth[model.meters] + self.fixed + jitter
        more = np.sqrt(1.0 - self.rho**2) * (self.loads @ random.standard_normal(self.w.size))
        self.w = self.rho * self.w + more
        return truth, m


@dataclass(slots=True)
class Watch:
    """Searches, names and masks of the monitor."""

    kernel: Core
    state: CoreState
    suspicion: Suspicion | None = None
    streak: Ints | int = 0
    phases: int = 0
    due: int = 0

    def look(self, tick: int, evidence: Evidence) -> None:
        """Search if one is due, and mask the confirmed meters."""
        pinned = self.state.detector.pinned
        if self.suspicion is not None and not pinned[self.suspicion.row]:
            self.suspicion = None
        if not pinned.any() or tick < self.due or not core.alarmed(self.kernel, evidence):
            return
        found = core.identify(self.kernel, self.state, evidence)
        named = found.found.named & ~self.state.masked.meters
        streak = np.where(found.accused[: named.size], self.streak + 1, 0)
        self.phases = self.phases + 1 if verdict.certain_phases(self.kernel, found).any() else 0
        age = int(self.state.detector.onsets.age[found.row])
        earlier, self.suspicion, self.streak = found.earlier(self.suspicion), found, streak
        self.due = tick + (1 if (streak[named] == 1).any() or self.phases == 1 else max(1, age // LOOKS))
        since = () if self.state.masked.meters.any() else self.state.history.readings[-age:]
        settled = found.settled or age <= YOUNG
        sure = confirmed(found.found, earlier, named, streak, since, settled=settled)
        if sure.any():
            final = replace(found, found=replace(found.found, named=sure))
            self.state, _ = core.mask(self.kernel, self.state, final)
            self.suspicion, self.streak, self.due = None, 0, tick + 1


@dataclass(slots=True)
class Run:
    """One run: honest meters named, manipulated ones and those named; error over deviation by tick."""

    honest: int
    named: int
    liars: int
    ratios: list[Floats] = field(default_factory=list)
    open: list[bool] = field(default_factory=list)


def manipulation(
    kind: str, kernel: Core, effect: Floats, random: np.random.Generator
) -> tuple[Floats, Floats]:
    """Manipulation of each meter (p,), and change of the model's error at the places (n,), squared pu."""
    p = kernel.modes.size
    S = kernel.model.loads(np.arange(p))
    near = np.argsort((S.diagonal() - 2.0 * S)[int(random.integers(p))], kind="stable")
    lie, moved = np.zeros(p), np.zeros(kernel.model.variance.size)
    size = (
        0.02 * float(random.choice([-1.0, 1.0])) * float(random.choice(SIZES[: 3 if kind == "drift" else 4]))
    )
    if kind in {"drift", "third"}:
        lie[near[: p // 3]] = size
    elif kind == "random":
        lie[random.permutation(p)[: p // 3]] = size
    elif kind == "majority":
        order = near if random.random() < 0.5 else random.permutation(p)
        lie[order[: 2 * p // 3]] = size
    elif kind == "busbar":
        moved[:] = -0.04 * np.sign(size)
    else:
        for j in random.permutation(p)[:3]:
            moved += effect[:, j] * -random.uniform(1.0, 11.0) / BASE_KVA
    return lie, moved


def run(kind: str, seed: int) -> Run:
    """One run."""
    random = np.random.default_rng([seed, KINDS.index(kind), 71])
    kernel, effect = kernel_of(int(random.integers(TREES)))
    world, (lie, moved) = World(kernel, random), manipulation(kind, kernel, effect, random)
    watch, liars = Watch(kernel, core.init(kernel, 0.0)), lie != 0.0
    out, ever = Run(0, 0, int(liars.sum())), np.zeros_like(liars)
    for k in range(QUIET + WATCHED):
        truth, m = world.tick()
        if k >= QUIET:
            truth = truth + moved
            level = min(1.0, (k - QUIET) / RAMP) if kind == "drift" else 1.0
            m = m + moved[kernel.model.meters] + level * lie
        watch.state, evidence = core.step(kernel, watch.state, float(k), m)
        watch.look(k, evidence)
        ever |= watch.state.masked.meters
        if watch.phases >= CONFIRM:
            break
        if k >= QUIET:
            found = core.estimate(kernel, watch.state, watch.suspicion)
            out.ratios.append(np.abs(found.mean - truth) / np.sqrt(found.variance))
            out.open.append(bool(watch.state.detector.pinned.any()) and not watch.state.masked.meters.any())
    out.honest, out.named = int((ever & ~liars).sum()), int((ever & liars).sum())
    return out


def held(ratios: list[Floats]) -> str:
    """Share of the intervals that hold the truth, %."""
    return f"{100.0 * np.mean(np.concatenate(ratios) < SURE):.1f}" if ratios else "-"


def main(runs: int, seed: int) -> int:
    """Print the table; 1 if an honest meter is named."""
    print("| manipulation | runs | accusing | named, % | held, % | held while open, % | largest | above 6 |")
    print("|" + "---|" * 8, flush=True)
    honest = 0
    for kind in KINDS:
        every = [run(kind, each) for each in range(seed, seed + runs)]
        honest += sum(bool(each.honest) for each in every)
        liars = sum(each.liars for each in every)
        named = f"{100.0 * sum(each.named for each in every) / liars:.0f}" if liars else "-"
        all_ = [one for each in every for one in each.ratios]
        open_ = [
            one for each in every for one, not_named in zip(each.ratios, each.open, strict=True) if not_named
        ]
        largest = [max((float(one.max()) for one in each.ratios), default=0.0) for each in every]
        cells = (kind, runs, sum(bool(each.honest) for each in every), named, held(all_), held(open_))
        print(
            f"| {' | '.join(map(str, cells))} | {max(largest):.1f} | {sum(one > FAR for one in largest)} |",
            flush=True,
        )
    return int(honest > 0)


if __name__ == "__main__":
    asked = arguments(__doc__, runs=20, seed=1)
    sys.exit(main(asked.runs, asked.seed))
