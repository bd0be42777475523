"""How long the design of a whole bank by matrix inequalities takes, and what the cache saves.

    python -m benchmarks.lmi_bank [--customers 10] [--max-attacked 2] [--workers 2]

Limit: 10 customers, M = 2 (45 + 210 observers) in two minutes on two cores.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import tempfile
import time
from pathlib import Path

# One thread of linear algebra per process, as in the service; before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from feeders.registry import bank_gains
from gridsec.grid.devices import fleet
from gridsec.grid.radial import Feeder
from gridsec.observers.gains import CircleOptions, margin, options_for
from gridsec.observers.lmi import circle
from gridsec.observers.lure import Lure, close_loop

LIMIT_S = 120.0


def street(customers: int) -> tuple[Lure, CircleOptions]:
    """A cable with a house every 30 m, an inverter of 10 kVA and a meter in each."""
    branches = np.arange(customers)
    ohm = 3.0 * 230.0**2 / 100e3
    feeder = Feeder(
        name="benchmark",
        parent=branches,
        r=np.full(customers, 0.03 * 0.32 / ohm),
        x=np.full(customers, 0.03 * 0.08 / ohm),
        bus=branches + 1,
        customers=tuple(f"house-{k}" for k in branches),
        buses=tuple(f"bus-{k}" for k in range(customers + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(customers),
    )
    lure = close_loop(feeder, fleet(branches, "ieee1547-b", np.full(customers, 10.0), 100.0), branches)
    model = feeder.linear()
    # Loads are known within 0.6 kW and 0.2 kvar, meters within 0.05 % of the voltage.
    shape = 2.0 * np.hstack([model.R * 6e-3, model.X * 2e-3])
    load = np.linalg.cholesky(shape @ shape.T)
    return lure, options_for(lure, rate=0.2, noise=5e-4, load=load)


def bar(done: int, total: int) -> None:
    """Progress on the error stream."""
    print(f"\r  {done:4d} of {total}", end="\n" if done == total else "", file=sys.stderr, flush=True)


def once_or_each_time(lure: Lure, options: CircleOptions, size: int, count: int) -> float:
    """Seconds per design when every problem is stated anew."""
    subsets = list(itertools.islice(itertools.combinations(range(len(lure.C)), size), count))
    begin = time.perf_counter()
    for subset in subsets:
        circle(
            lure,
            subset,
            rate=options.rate,
            noise=options.noise,
            load=options.load,
            weight=options.weight,
            floor=options.floor,
        )
    return (time.perf_counter() - begin) / len(subsets)


def main() -> int:
    """Run it; 1 if the limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--customers", type=int, default=10)
    parser.add_argument("--max-attacked", type=int, default=2)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    lure, options = street(asked.customers)
    size = asked.customers - asked.max_attacked
    circle(lure, range(size), rate=options.rate, noise=options.noise, load=options.load)  # load the solver
    each = once_or_each_time(lure, options, size, 5)
    with tempfile.TemporaryDirectory() as folder:
        spent = []
        for _ in range(2):
            begin = time.perf_counter()
            got = bank_gains(
                lure, asked.max_attacked, options, workers=asked.workers, where=Path(folder), progress=bar
            )
            spent.append(time.perf_counter() - begin)
        kilobytes = sum(entry.stat().st_size for entry in Path(folder).iterdir()) / 1e3
    worst = min(margin(lure, one.J, one) for one in got.designs)
    print(f"customers {asked.customers}, M {asked.max_attacked}, observers {len(got.designs)}")
    print(f"  one design stated anew        {each:8.3f} s")
    print(
        f"  whole bank, {asked.workers} processes      {spent[0]:8.2f} s   (limit {LIMIT_S:.0f} s for 10, 2)"
    )
    print(f"  per observer                  {spent[0] / len(got.designs):8.3f} s")
    print(f"  from the cache, proven again  {spent[1]:8.3f} s   ({kilobytes:.0f} kB, {got.origin})")
    print(f"  smallest margin {worst:.2e}, largest back-off {max(one.backoff for one in got.designs):g}")
    return int(spent[0] > LIMIT_S)


if __name__ == "__main__":
    sys.exit(main())
