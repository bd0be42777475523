"""How long one step of the sequential monitor takes, from 13 to 2 000 customers, and its memory.

    python -m benchmarks.sequential_step [picture.png]

Streets of one long feeder with side branches; every customer has a meter, every second one a droop inverter.
Steady state: the median over 200 steps after the first minute. Attack: a third of the meters lie by 3 % for a
minute; median and largest step. All in processor time of the one thread. Limits: 146 customers in 0.5 ms in
steady state and in 5 ms (median) while 48 lie; steady state no worse than with the square of the number;
500 MB for 2 000.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from gridsec import sequential
from gridsec.arrays import Floats
from gridsec.detect import MeterAccuracy
from gridsec.droop import fleet
from gridsec.feeder import Feeder, bus_voltages
from gridsec.online import Frame
from gridsec.plant import Plant
from gridsec.sequential import LoadDoubt

SIZES = (13, 30, 60, 146, 300, 600, 1000, 2000)
STEADY_MS, ATTACK_MS, MEMORY_MB, POWER = 0.5, 5.0, 500.0, 2.0
AT = 146
BASE_KVA = 100.0


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


def design(customers: int) -> sequential.SequentialDesign:
    """The monitor of a street.

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
    plant = Plant(street(customers), droop, np.arange(customers), accuracy, 1)
    doubt = LoadDoubt(np.full(customers, 0.006), np.full(customers, 0.002), 600.0)
    return sequential.design(plant, doubt=doubt, step_s=1.0)


def measure(customers: int) -> tuple[float, float, float, float]:
    """Steady state and attack, median and largest, in ms; and the peak of the memory, MB.

    Parameters
    ----------
    customers
        N.
    """
    rng = np.random.default_rng(customers)
    made = design(customers)
    state = sequential.init(made, 0.0)
    p = np.full(customers, -0.01)
    lies = np.zeros(customers)
    liars = rng.choice(customers, customers // 3, replace=False)
    none, zero = np.full(customers, np.nan), np.zeros(customers)
    seen = np.ones(customers, dtype=np.bool_)
    took: list[float] = []
    # The largest is watched until all it remembers is there.
    quiet, attack = (200, 60) if customers <= 1000 else (1700, 20)
    for k in range(60 + quiet + attack):
        if k == 60 + quiet:
            lies[liars] = 0.03 * rng.choice([-1.0, 1.0], liars.size)
        x: Floats = zero if state.x is None else np.bincount(made.plant.droop.customer, state.x, customers)
        v = np.sqrt(bus_voltages(made.plant.feeder, p, x, 1.0, steps=3)[1:])
        y = (v * (1.0 + lies) + 5e-4 * rng.normal(size=customers)) ** 2
        frame = Frame(float(k), y, seen, 1.0, p, zero, zero, zero, none, none)
        begun = time.thread_time()
        state, _, verdict = sequential.step(made, state, frame)
        took.append(1e3 * (time.thread_time() - begun))
    if not np.array_equal(np.flatnonzero(verdict.suspects), np.sort(liars)):
        raise RuntimeError(f"{customers} customers: not exactly the liars were named")
    steady, lying = np.array(took[60 : 60 + quiet]), np.array(took[60 + quiet :])
    memory = peak_mb()
    return float(np.median(steady)), float(np.median(lying)), float(lying.max()), memory


def main(picture: str | None) -> int:
    """Every size in a process of its own; 1 if a limit is missed."""
    print(f"{'customers':>9}{'steady ms':>11}{'attack ms':>11}{'largest ms':>12}{'memory MB':>11}")
    rows = []
    for size in SIZES:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.sequential_step", "--one", str(size)],
            capture_output=True,
            check=True,
            text=True,
        )
        row = tuple(float(cell) for cell in done.stdout.split())
        rows.append(row)
        print(f"{size:>9}{row[0]:>11.2f}{row[1]:>11.2f}{row[2]:>12.1f}{row[3]:>11.0f}", flush=True)
    table = np.array(rows)
    sizes = np.array(SIZES, dtype=np.float64)
    large = sizes >= AT
    power = float(np.polyfit(np.log(sizes[large]), np.log(table[large, 0]), 1)[0])
    print(f"steady state grows with N^{power:.2f} from {AT} customers on")
    if picture is not None:
        _draw(picture, sizes, table)
    at = SIZES.index(AT)
    good = table[at, 0] <= STEADY_MS and table[at, 1] <= ATTACK_MS
    return 0 if good and table[-1, 3] <= MEMORY_MB and power <= POWER else 1


def _draw(picture: str, sizes: Floats, table: Floats) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for column, label, marker in (
        (0, "steady state", "o"),
        (1, "a third lies, median", "s"),
        (2, "largest", "^"),
    ):
        axes.loglog(sizes, table[:, column], marker=marker, label=label)
    axes.loglog(sizes, table[3, 0] * (sizes / sizes[3]) ** 2, "k:", label="square of the number")
    axes.set_xlabel("customers")
    axes.set_ylabel("ms per step")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(*measure(int(sys.argv[2])))
        sys.exit(0)
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else None))
