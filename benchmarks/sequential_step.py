"""How long one step of the sequential monitor takes, from 13 to 2 000 customers, and its memory.

    python -m benchmarks.sequential_step [--runs 5] [picture.png]

Streets of one long feeder with side branches; every customer has a meter, every second one a droop inverter.
Steady state: the median over 200 steps after the first minute. Attack: a third of the meters lie by 3 % for
a minute; median and mean of its steps. Search: the longest step of an attack, that in which they are named;
its median, and the largest, over 120 onsets one second apart (fewer where there are more than 300 customers).
All in processor time of the one thread, modules and design out of the garbage collector's sight as in the
service. Of several runs of a size the least of each time counts, and the most memory: a machine that does
something else meanwhile takes longer, never less. Limits: 146 customers in 0.5 ms in steady state and in 5 ms
while 48 lie, the step in which they are named as well; steady state no worse than with the square of the
number; 500 MB for 2 000.
"""

from __future__ import annotations

import argparse
import gc
import os
import resource
import subprocess
import sys
import time
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import count
from gridsec.arrays import Bools, Floats
from gridsec.estimators import sequential
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential import LoadDoubt
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.grid.radial import Feeder
from gridsec.interface import Frame

SIZES = (13, 30, 60, 146, 300, 600, 1000, 2000)
STEADY_MS, ATTACK_MS, MEMORY_MB, POWER = 0.5, 5.0, 500.0, 2.0
AT = 146
BASE_KVA = 100.0
# Ticks after which these liars are named at the latest.
FOUND = 5


def peak_mb() -> float:
    """Largest memory of this process, MB; the system's other number includes what its parent had."""
    status = Path("/proc/self/status")
    if status.exists():
        return next(int(line.split()[1]) for line in status.open() if line.startswith("VmHWM")) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def street(customers: int) -> Feeder:
    """One long feeder, a side branch of up to four customers at every fifth bus.

    Parameters
    ----------
    customers
        N.
    """
    k = np.arange(customers)
    parent = np.where(k % 5 == 0, np.maximum(k - 4, 0), k)
    # The longer the street, the thicker the cable: 5 % of drop in any case.
    r = np.full(customers, 0.2 / customers**2 * BASE_KVA)
    return Feeder(
        name="street",
        parent=parent,
        r=r,
        x=0.4 * r,
        bus=k + 1,
        customers=tuple(f"c{i}" for i in k),
        buses=tuple(f"b{i}" for i in range(customers + 1)),
        base_volt=230.0,
        base_kva=BASE_KVA,
        charging=np.zeros(customers),
    )


def plant(customers: int) -> tuple[Plant, LoadDoubt]:
    """A street with meters and inverters, and the knowledge of its loads.

    Parameters
    ----------
    customers
        N.
    """
    own = np.arange(0, customers, 2)
    droop = fleet(own, ["ieee1547-b"] * own.size, np.full(own.size, 6.0), BASE_KVA)
    accuracy = MeterAccuracy(
        np.full(customers, 0.005),
        np.full(customers, 0.1 / 230.0),
        np.full(customers, 0.0005),
        0.001,
        0.0,
        2e-4,
    )
    made = Plant(street(customers), droop, np.arange(customers), accuracy, 1)
    return made, LoadDoubt(np.full(customers, 0.006), np.full(customers, 0.002), 600.0)


@dataclass(frozen=True, slots=True)
class Measured:
    """What one size takes, ms and MB.

    Attributes
    ----------
    steady
        Median of the steps without manipulation.
    median, mean
        Of the steps of an attack.
    search, largest
        The longest step of an attack: median and largest over its onsets.
    memory
        Peak of the process.
    """

    steady: float
    median: float
    mean: float
    search: float
    largest: float
    memory: float


class Watched:
    """A street, a monitor, and what each of its steps takes.

    Parameters
    ----------
    customers
        N.
    family
        Module of the estimator, with `design`, `init` and `step`.
    """

    def __init__(self, customers: int, family: Any = sequential) -> None:
        self.rng, self.family = np.random.default_rng(customers), family
        made, doubt = plant(customers)
        self.made = family.design(made, doubt=doubt, step_s=1.0)
        self.state = family.init(self.made, 0.0)
        self.p = np.full(customers, -0.01)
        self.liars = np.sort(self.rng.choice(customers, customers // 3, replace=False))

    def lies(self) -> Floats:
        """A third of the meters, each 3 % too high or too low."""
        out = np.zeros(self.p.size)
        out[self.liars] = 0.03 * self.rng.choice([-1.0, 1.0], self.liars.size)
        return out

    def play(
        self, first: int, ticks: int, lies: Floats | float = 0.0, *, seen: Bools | None = None
    ) -> Floats:
        """How long some ticks take, each, ms; `state` is that after them.

        Parameters
        ----------
        first, ticks
            Number of the first tick, and how many.
        lies : (N,)
            What each meter reads too much, parts of the voltage.
        seen : (N,)
            Meters with a reading; None: all.
        """
        made, p, size, took = self.made, self.p, self.p.size, np.empty(ticks)
        none, zero = np.full(size, np.nan), np.zeros(size)
        seen = np.ones(size, dtype=np.bool_) if seen is None else seen
        for k in range(ticks):
            injected = getattr(self.state, "front", self.state).x
            x: Floats = zero if injected is None else np.bincount(made.plant.droop.customer, injected, size)
            v: Floats = np.sqrt(made.plant.feeder.bus_voltages(p, x, 1.0, steps=3)[1:])
            y = np.square(v * (1.0 + lies) + 5e-4 * self.rng.normal(size=size))
            frame = Frame(float(first + k), y, seen, 1.0, p, zero, zero, zero, none, none)
            begun = time.thread_time()
            self.state, *_ = self.family.step(made, self.state, frame)
            took[k] = 1e3 * (time.thread_time() - begun)
        return took


def measure(customers: int) -> Measured:
    """Steady state, attacks and memory.

    Parameters
    ----------
    customers
        N.
    """
    street = Watched(customers)
    # The largest is watched until all it remembers is there.
    quiet, attack, onsets = (200, 60, 120) if customers <= 300 else (200, 60, 8)
    if customers > 1000:
        quiet, attack, onsets = 1700, 20, 0
    street.play(0, 60)
    gc.freeze()  # as the service does: full collections stop every thread
    steady = street.play(60, quiet)
    longest = []
    for k in range(60 + quiet, 60 + quiet + onsets):
        # Longer means are looked at now and then: what coincides depends on the second of the onset.
        before = street.state
        longest.append(street.play(k, FOUND, street.lies()).max())
        street.state = before
        street.play(k, 1)
        del before
    lying = street.play(60 + quiet + onsets, attack, street.lies())
    if not np.array_equal(np.flatnonzero(street.state.trust.named), street.liars):
        raise RuntimeError(f"{customers} customers: not exactly the liars were named")
    longest.append(lying.max())
    return Measured(
        *(float(np.median(steady)), float(np.median(lying)), float(lying.mean())),
        *(float(np.median(longest)), float(max(longest))),
        peak_mb(),
    )


def measured(customers: int) -> Measured:
    """What one size takes, in a process of its own.

    Parameters
    ----------
    customers
        N.
    """
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.sequential_step", "--one", str(customers)],
        capture_output=True,
        check=True,
        text=True,
    )
    return Measured(*(float(cell) for cell in done.stdout.split()))


def main(picture: str | None, runs: int) -> int:
    """Every size, as often as asked for; 1 if a limit is missed."""
    print(f"{'':>9}{'steady':>10}{'attack, ms':>30}{'':>10}{'memory':>10}")
    print(f"{'customers':>9}{'ms':>10}{'median':>10}{'mean':>10}{'search':>10}{'largest':>10}{'MB':>10}")
    rows = []
    for size in SIZES:
        each = [measured(size) for _ in range(runs)]
        quickest = np.array([astuple(one) for one in each]).min(axis=0).tolist()
        row = replace(Measured(*quickest), memory=max(one.memory for one in each))
        rows.append(row)
        times = (row.steady, row.median, row.mean, row.search, row.largest)
        print(f"{size:>9}" + "".join(f"{each:>10.2f}" for each in times) + f"{row.memory:>10.0f}", flush=True)
    sizes, steady = np.array(SIZES, dtype=np.float64), np.array([row.steady for row in rows])
    large, at = sizes >= AT, rows[SIZES.index(AT)]
    power = float(np.polyfit(np.log(sizes[large]), np.log(steady[large]), 1)[0])
    print(f"steady state grows with N^{power:.2f} from {AT} customers on")
    if picture is not None:
        _draw(picture, sizes, rows)
    good = at.steady <= STEADY_MS and max(at.median, at.mean, at.search) <= ATTACK_MS
    return 0 if good and rows[-1].memory <= MEMORY_MB and power <= POWER else 1


def _draw(picture: str, sizes: Floats, rows: list[Measured]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for name, label, marker in (
        ("steady", "steady state", "o"),
        ("median", "a third lies, median", "s"),
        ("search", "the step in which they are named", "^"),
    ):
        axes.loglog(sizes, [getattr(row, name) for row in rows], marker=marker, label=label)
    square = rows[SIZES.index(AT)].steady * (sizes / AT) ** 2
    axes.loglog(sizes, square, "k:", label="square of the number")
    axes.set_xlabel("customers")
    axes.set_ylabel("ms per step")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(picture, dpi=110)


def _asked() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("picture", nargs="?", help="draw the times into this file")
    parser.add_argument("--runs", type=count, default=1, help="of each size; the least of each time counts")
    parser.add_argument("--one", type=count, metavar="N", help="measure N customers only, and print numbers")
    return parser.parse_args()


if __name__ == "__main__":
    asked = _asked()
    if asked.one is not None:
        print(*astuple(measure(asked.one)))
        sys.exit(0)
    sys.exit(main(asked.picture, asked.runs))
