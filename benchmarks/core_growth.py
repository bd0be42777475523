"""Time of a step of `modal` against the number of customers, up to 2 000.

    python -m benchmarks.core_growth [--runs 2] [picture.png]

Streets of one long feeder with side branches; every customer has a meter, every second one a droop inverter;
one frame per second, all meters honest at first. Calm: median of `CALM` steps after `BEFORE` steps, a fourth
of both beyond `SEARCHED` customers. Silent: the same while a tenth of the meters never reports, from the
first step on. Attack: a third of the meters is off by 3 % from one step on, the longest of `ATTACK` steps, up
to `SEARCHED` customers; exactly these meters must be named. Memory: peak of the process. Processor times of
the one thread, ms; of several runs the least counts. Each size has a process of its own.
"""

from __future__ import annotations

import argparse
import gc
import os
import resource
import subprocess
import sys
import time
from dataclasses import astuple, dataclass
from pathlib import Path

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import count
from benchmarks._table import head, row
from gridsec.arrays import Bools, Floats
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.modal import monitor
from gridsec.estimators.plant import Plant
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.grid.radial import Feeder
from gridsec.interface import Frame

SIZES = (13, 30, 60, 146, 300, 600, 1000, 2000)
BEFORE, CALM, ATTACK = 40, 60, 6
"""Steps before the measurement, calm steps, and steps after an onset."""
SEARCHED = 1000
"""Largest number of customers with an attack: a search takes the cube of the number."""
BASE_KVA = 100.0


@dataclass(frozen=True, slots=True)
class Measured:
    """Times of one size, ms, and memory, MB; NaN for an attack that is not played."""

    calm: float
    silent: float
    attack: float
    memory: float


def peak_mb() -> float:
    """Largest memory of this process, MB; `ru_maxrss` includes that of its parent."""
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
    # Thicker cables for longer streets: 5 % of drop in any case.
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
    """A street with meters and inverters, and the uncertainty of its loads.

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


class Watched:
    """A street, its monitor, and the time of each step.

    Parameters
    ----------
    customers
        N.
    """

    def __init__(self, customers: int) -> None:
        self.rng = np.random.default_rng(customers)
        made, doubt = plant(customers)
        self.made = monitor.design(made, doubt=doubt, step_s=1.0)
        self.state = monitor.init(self.made, 0.0)
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
        """Time of each of some ticks, ms; `state` is that after them.

        Parameters
        ----------
        first, ticks
            Number of the first tick, and number of ticks.
        lies : (N,)
            Excess of each reading, parts of the voltage.
        seen : (N,)
            Meters with a reading; None: all.
        """
        made, p, size, took = self.made, self.p, self.p.size, np.empty(ticks)
        none, zero = np.full(size, np.nan), np.zeros(size)
        seen = np.ones(size, dtype=np.bool_) if seen is None else seen
        for k in range(ticks):
            injected = self.state.front.x
            x: Floats = zero if injected is None else np.bincount(made.plant.droop.customer, injected, size)
            v: Floats = np.sqrt(made.plant.feeder.bus_voltages(p, x, 1.0, steps=3)[1:])
            y = np.square(v * (1.0 + lies) + 5e-4 * self.rng.normal(size=size))
            frame = Frame(float(first + k), y, seen, 1.0, p, zero, zero, zero, none, none)
            begun = time.thread_time()
            self.state, *_ = monitor.step(made, self.state, frame)
            took[k] = 1e3 * (time.thread_time() - begun)
        return took


def measure(customers: int) -> Measured:
    """Times of one size, in this process."""
    part = 1 if customers <= SEARCHED else 4
    before, calm, attack = BEFORE // part, CALM // part, np.nan
    street, seen = Watched(customers), np.arange(customers) % 10 != 0
    start = street.state
    gc.freeze()  # as the service does
    street.play(0, before, seen=seen)
    silent = float(np.median(street.play(before, calm, seen=seen)))
    street.state = start
    street.play(0, before)
    complete = float(np.median(street.play(before, calm)))
    if customers <= SEARCHED:
        attack = float(street.play(before + calm, ATTACK, street.lies()).max())
        if not np.array_equal(np.flatnonzero(street.state.core.masked.meters), street.liars):
            raise RuntimeError(f"{customers} customers: not exactly the manipulated meters are named")
    return Measured(complete, silent, attack, peak_mb())


def measured(customers: int, runs: int) -> Measured:
    """Least times of some runs, each in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.core_growth", "--one", str(customers)]
    each = []
    for _ in range(runs):
        done = subprocess.run(command, capture_output=True, check=True, text=True)
        each.append([float(cell) for cell in done.stdout.split()])
    return Measured(*np.min(each, axis=0).tolist())


def main(picture: str | None, runs: int) -> None:
    """One table, and the exponents of growth from 146 customers on."""
    head("customers", "calm", "silent", "attack", "MB")
    found: list[Measured] = []
    for size in SIZES:
        found.append(measured(size, runs))
        row(size, *("-" if np.isnan(cell) else f"{cell:.2f}" for cell in astuple(found[-1])))
    sizes = np.array(SIZES, dtype=np.float64)
    for of in ("calm", "silent"):
        times = np.array([getattr(one, of) for one in found])
        power = float(np.polyfit(np.log(sizes[sizes >= 146]), np.log(times[sizes >= 146]), 1)[0])
        print(f"{of}: N^{power:.2f} from 146 customers on")
    if picture is not None:
        _draw(picture, found)


def _draw(picture: str, found: list[Measured]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for of, label, marker in (
        ("calm", "calm", "o"),
        ("silent", "a tenth silent", "s"),
        ("attack", "a third manipulated, longest step", "^"),
    ):
        axes.loglog(SIZES, [getattr(one, of) for one in found], marker=marker, label=label)
    axes.set_xlabel("customers")
    axes.set_ylabel("ms per step")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(picture, dpi=110)


def _asked() -> argparse.Namespace:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("picture", nargs="?", help="draw the times into this file")
    parser.add_argument("--runs", type=count, default=1, help="of each size; the least of each time counts")
    parser.add_argument("--one", type=count, metavar="N", help="measure one size, print numbers")
    return parser.parse_args()


if __name__ == "__main__":
    asked = _asked()
    if asked.one is not None:
        print(*astuple(measure(asked.one)))
    else:
        main(asked.picture, asked.runs)
