"""Honest meters named by the statistical core while loads change without a report, and by groups of meters.

    python -m benchmarks.core_rivals [runs] [feeder ...]

Residuals are drawn from the model of `gridsec.estimators.modal` as in `benchmarks.limits`, with what no
report shows added by the linear model. The first 180 ticks are honest, and nothing is switched in them. The
core is looked at every tenth tick of the 240 ticks after them.

Loads: a kettle of 2 kW runs for 150 s at every customer, every ten minutes on average; every fifth customer,
with a connection of 14 kW, charges a car with 11 kW from a random moment on. `late`: every power is 60 s old;
a step lasts 60 s in the residuals. `unread`: 5 or 30 % of the customers report no power; their loads change
for good. `liar`: one random meter is off by 1 % from tick 180 on, besides.

Groups: a contiguous third reads wrong by one amount, from tick 180 on or in a ramp of 1 200 s from the start
on, or has a fixed error before learning, with 5 or 30 % of the powers unread, which kettles change.

Loads with meters of class 0.5 %, 0.1 V and 0.05 %, groups with white errors of 0.2 %. Columns: runs with an
honest meter named, honest meters ever named, manipulated meters named at the end of those that there are,
ticks evaluated without an alarm after the onset, %, and mean time of an identification. Exits 1 when an
honest meter is named.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import time
from dataclasses import dataclass

import numpy as np

from benchmarks._arguments import arguments
from benchmarks._table import head, row
from benchmarks.limits import QUIET, World, kernel_of, site, squared, third, watcher
from feeders.simulation.trial import TrialMeterErrors
from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import core
from gridsec.estimators.modal.core import Core
from gridsec.grid.network import Power

WATCHED, LOOK = 240, 10
"""Ticks after the onset, and ticks from one look to the next."""
LATE = 60
"""Age of late powers, ticks."""
KETTLE_KW, KETTLE, KETTLE_EVERY = 2.0, 150, 600.0
CAR_KW, CAR_OF = 11.0, 5
"""Power of a charging car, kW, and customers for each car."""
RAMP = 1200
"""Ticks of a ramp."""


@dataclass(frozen=True, slots=True)
class Case:
    """One situation.

    Attributes
    ----------
    name
        For people.
    late, unread
        Powers are `LATE` ticks old; share of the customers without a power.
    kettles, cars
        Loads that change.
    group, amount
        Kind of group and its amount, parts of the voltage; "" for none.
    liar
        Amount of one manipulated meter, parts of the voltage.
    """

    name: str
    late: bool = False
    unread: float = 0.0
    kettles: bool = True
    cars: bool = True
    group: str = ""
    amount: float = 0.0
    liar: float = 0.0


LOADS = (
    Case("late, kettles", late=True, cars=False),
    Case("late, cars", late=True, kettles=False),
    Case("late, both", late=True),
    Case("5 % unread", unread=0.05),
    Case("30 % unread", unread=0.3),
    Case("late, both, liar", late=True, liar=0.01),
    Case("30 % unread, liar", unread=0.3, liar=0.01),
)
GROUPS = tuple(
    Case(
        f"{kind} {100 * amount:g} %, {100 * unread:g} % unread",
        unread=unread,
        kettles=unread > 0.0,
        cars=False,
        group=kind,
        amount=amount,
    )
    for kind, amounts in (("step", (0.005, 0.03)), ("ramp", (-0.01,)), ("fixed", (-0.01, -0.03)))
    for amount in amounts
    for unread in (0.05, 0.3)
)


def unreported(case: Case, customers: int, base_kva: float, random: np.random.Generator) -> Floats:
    """Net injection that no report shows, pu, (ticks, N)."""
    ticks = QUIET + WATCHED
    on = np.zeros((ticks, customers))
    for k in range(customers):
        if case.kettles:
            for begin in random.uniform(QUIET, ticks, random.poisson(WATCHED / KETTLE_EVERY)).astype(int):
                on[begin : begin + KETTLE, k] = KETTLE_KW
        if case.cars and k % CAR_OF == 0:
            on[int(random.uniform(QUIET, ticks)) :, k] += CAR_KW
    if case.late:
        before = np.vstack([np.zeros((LATE, customers)), on[:-LATE]])
        return -(on - before) / base_kva
    silent = random.permutation(customers) < round(case.unread * customers)
    return -(on * silent) / base_kva


def manipulation(case: Case, kernel: Core, seed: int) -> tuple[Floats, Floats]:
    """Manipulation of each meter at full level, squared pu, (p,), and its level at each tick."""
    ticks, p = np.arange(QUIET + WATCHED), kernel.modes.size
    if case.group:
        lie = third(kernel, "contiguous", case.amount, seed)
        level = {"step": ticks >= QUIET, "ramp": np.minimum(ticks / RAMP, 1.0), "fixed": ticks >= 0}
        return lie, np.asarray(level[case.group], np.float64)
    liar = int(np.random.default_rng([seed, 1]).integers(p))
    return squared(case.liar) * (np.arange(p) == liar), (ticks >= QUIET).astype(np.float64)


@dataclass
class Result:
    """Result of one run: meters named, manipulated ones, ticks without an alarm, and time, ms."""

    honest: int
    named: int
    liars: int
    quiet: float
    took: float


def run(case: Case, feeder: str, meters: TrialMeterErrors, seed: int) -> Result:
    """One run."""
    kernel, front = kernel_of(feeder, meters), watcher(feeder, meters).design.front
    world, random = World(front, seed), np.random.default_rng([seed, 5])
    lie, level = manipulation(case, kernel, seed)
    liars: Bools = lie != 0.0
    change = unreported(case, front.customers, site(feeder).feeder.base_kva, random)
    effect = front.sensitivities.columns(Power.ACTIVE, np.arange(front.customers))[kernel.model.meters]
    state, ever, named = core.init(kernel, 0.0), np.zeros_like(liars), np.zeros_like(liars)
    took, quiet = list[float](), 0
    for k in range(QUIET + WATCHED):
        _, m, _ = world.tick(lie * level[k] + effect @ change[k])
        state, evidence = core.step(kernel, state, float(k), m)
        alarm = core.alarmed(kernel, evidence)
        if k >= QUIET and evidence.log_m > -np.inf:
            quiet += not alarm
        if k % LOOK == LOOK - 1:
            named = np.zeros_like(liars)
            if alarm:
                begun = time.thread_time()
                found = core.identify(kernel, state, evidence).found
                took.append(time.thread_time() - begun)
                named = found.named
            ever |= named
    return Result(
        int((ever & ~liars).sum()),
        int((named & liars).sum()),
        int(liars.sum()),
        100.0 * quiet / WATCHED,
        1e3 * float(np.mean(took)) if took else 0.0,
    )


def table(cases: tuple[Case, ...], feeder: str, meters: TrialMeterErrors, runs: int) -> int:
    """One table; honest meters named."""
    total = 0
    for case in cases:
        found = [run(case, feeder, meters, seed) for seed in range(runs)]
        honest = [one.honest for one in found]
        total += sum(honest)
        cells = (
            f"{np.count_nonzero(honest)} of {runs}",
            sum(honest),
            f"{sum(one.named for one in found)} of {sum(one.liars for one in found)}",
            f"{np.mean([one.quiet for one in found]):.0f}",
            f"{np.mean([one.took for one in found]):.0f}",
        )
        row(feeder, case.name, *cells)
    return total


def main(runs: int, names: tuple[str, ...]) -> int:
    """Both tables; 1 if an honest meter is named."""
    honest = 0
    for cases, meters in ((LOADS, TrialMeterErrors.REAL), (GROUPS, TrialMeterErrors.WHITE)):
        head("feeder", "case", "runs", "honest named", "named", "no alarm, %", "ms")
        for feeder in names:
            honest += table(cases, feeder, meters, runs)
    return int(honest > 0)


if __name__ == "__main__":
    asked = arguments(__doc__, runs=10, feeders=("kerber-landnetz", "kerber-dorfnetz", "simbench-lv-rural3"))
    sys.exit(main(asked.runs, tuple(asked.feeders)))
