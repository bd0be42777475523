"""How long one step of the exact bank takes, and how much that is against a loop over its observers.

    python -m benchmarks.bank_step

One step: all observers, the consistency measure (6), the selection (7). One thread of linear algebra.
Limits: 13 customers, M = 2 in 0.5 ms; 30 customers, M = 2 in 20 ms; at least 50 times faster than the
loop in the same run, with equal numbers.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from gridsec.arrays import Floats
from gridsec.estimators import exact_bank
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.plant import Plant
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.grid.radial import Feeder
from gridsec.interface import Frame
from gridsec.observers.lure import Lure, close_loop, transition

FACTOR = 50.0
TOLERANCE = 1e-12


@dataclass(frozen=True, slots=True)
class Case:
    """A feeder's size, and the limit for one step, s."""

    customers: int
    max_attacked: int
    limit: float


CASES = (Case(13, 2, 0.5e-3), Case(30, 2, 20e-3), Case(57, 1, 5e-3), Case(146, 1, 10e-3))


def street(customers: int) -> Plant:
    """A random tree with an inverter and a meter at every customer; curves and time constants differ."""
    rng = np.random.default_rng(customers)
    presets = ("ieee1547-a", "ieee1547-b", "vde4105")
    feeder = Feeder(
        name="benchmark",
        parent=np.array([rng.integers(max(0, k - 3), k + 1) for k in range(customers)]),
        r=rng.uniform(0.5, 2.0, customers) * 0.12 / customers,
        x=rng.uniform(0.5, 2.0, customers) * 0.06 / customers,
        bus=np.arange(1, customers + 1),
        customers=tuple(f"house-{k}" for k in range(customers)),
        buses=tuple(f"bus-{k}" for k in range(customers + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(customers),
    )
    every = np.arange(customers)
    droop = fleet(every, [presets[k % 3] for k in every], rng.uniform(3.0, 10.0, customers), 100.0)
    accuracy = MeterAccuracy(
        np.full(customers, 0.005), np.full(customers, 4e-4), np.full(customers, 5e-4), 0.001, 4e-4, 1e-4
    )
    return Plant(feeder, droop, every, accuracy)


def fastest(run: Callable[[], object], *, least: int, longest: float) -> float:
    """Seconds of the median of many calls, at least `least` of them, for `longest` seconds."""
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < least or time.perf_counter() - begin < longest:
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


class Loop:
    """The same observers, one after the other: each its own matrices, NumPy inside."""

    def __init__(self, lure: Lure, bank: banks.Bank, h: float) -> None:
        prepared = transition(lure, h, bank.policy)
        rate = -np.diagonal(lure.A)
        self.substeps, self.decay = prepared.substeps, prepared.decay
        self.first, self.second = prepared.first * rate, prepared.second * rate
        self.phi, self.masks = lure.phi, bank.masks
        self.H = [np.where(mask[:, None], 0.0, lure.H) for mask in bank.masks]
        self.large = bank.sets.count_large
        self.within = bank.sets.pairs % bank.sets.count_small + self.large

    def step(self, x: list[Floats], y: Floats, u: Floats) -> list[Floats]:
        """One step of every observer."""
        out = []
        for mask, H, state in zip(self.masks, self.H, x, strict=True):
            known = np.where(mask, y, u)
            for _ in range(self.substeps):
                here = self.phi(H @ state + known)
                ahead = self.decay * state + self.first * here
                state = ahead + self.second * (self.phi(H @ ahead + known) - here)  # noqa: PLW2901
            out.append(state)
        return out

    def consistency(self, x: list[Floats]) -> Floats:
        """Equation (6), comparison by comparison."""
        return np.array(
            [max(np.abs(x[S] - x[P]).max() for P in within) for S, within in enumerate(self.within)]
        )


def run(case: Case) -> bool:
    """Measure one case; whether it meets its limits."""
    plant = street(case.customers)
    n, h = case.customers, 1.0
    lure = close_loop(plant.feeder, plant.droop, plant.meters)
    begin = time.perf_counter()
    bank = banks.design(lure, case.max_attacked)
    designed = time.perf_counter() - begin
    rng = np.random.default_rng(1)
    u = rng.uniform(-0.03, 0.12, n)
    rest = banks.estimate(bank, banks.init(bank, u, u, np.zeros(n, dtype=bool)), -1)
    y, seen = lure.C @ rest + u + rng.normal(0.0, 0.005, n), np.ones(n, dtype=bool)
    state = banks.step(bank, banks.init(bank, y, u, seen), y + 0.01, u, seen, h)

    def whole(bank: banks.Bank = bank, state: banks.BankState = state) -> tuple[banks.BankState, Floats, int]:
        after = banks.step(bank, state, y, u, seen, h)
        pi = banks.consistency(bank, after)
        return after, pi, banks.select(pi)

    loop = Loop(lure, bank, h)
    before = [banks.estimate(bank, state, i) for i in range(bank.masks.shape[0])]
    begin = time.perf_counter()
    slow = loop.step(before, y, u)
    slow_pi = loop.consistency(slow)
    looped = time.perf_counter() - begin
    after, pi, chosen = whole()
    wrong = max(np.abs(banks.estimate(bank, after, i) - x).max() for i, x in enumerate(slow))
    wrong = max(float(wrong), float(np.abs(pi - slow_pi).max()))
    equal = wrong <= TOLERANCE and chosen == int(np.argmin(slow_pi))
    once = fastest(whole, least=20, longest=1.0)
    count, pairs = bank.masks.shape[0], bank.sets.pairs.shape[1]
    print(
        f"customers {n}, M {case.max_attacked}: {count} observers, {pairs} comparisons for each of the larger"
    )
    print(f"  design                {designed * 1e3:10.2f} ms")
    print(f"  step, (6) and (7)     {once * 1e3:10.3f} ms   limit {case.limit * 1e3:g} ms")
    print(
        f"  loop over observers   {looped * 1e3:10.1f} ms   {looped / once:.0f} times as long, "
        f"at least {FACTOR:g} wanted"
    )
    print(f"  largest difference    {wrong:10.1e}      {'equal numbers' if equal else 'NOT EQUAL'}")
    long = fastest(lambda: banks.step(bank, state, y, u, seen, 900.0), least=3, longest=0.5)
    print(f"  step of 15 minutes    {long * 1e3:10.2f} ms")
    if count * n * n * 8 < 1 << 28:
        stacked = banks.design(lure, case.max_attacked, gains=banks.direct_gains(lure, bank.masks))
        wide = banks.init(stacked, y, u, seen)
        general = fastest(lambda: whole(stacked, wide), least=3, longest=0.5)
        print(f"  with stacked gains    {general * 1e3:10.2f} ms   {general / once:.1f} times as long")
    print(f"  monitor, whole step   {watched(plant, case.max_attacked) * 1e3:10.3f} ms")
    return equal and once <= case.limit and looped >= FACTOR * once


def watched(plant: Plant, max_attacked: int) -> float:
    """Seconds of one step of the whole chain."""
    n = plant.meters.size
    design = exact_bank.design(plant, max_attacked=max_attacked, step_s=1.0)
    p, nothing = np.full(n, -0.3 / n), np.full(n, np.nan)
    y = plant.feeder.bus_voltages(p, 0.3 * p, 1.0, steps=0)[plant.feeder.bus]
    state = exact_bank.init(design, 0.0)

    def frame(t: float) -> Frame:
        return Frame(
            t,
            y,
            np.ones(n, dtype=bool),
            0.98,
            p,
            0.01 * np.abs(p),
            0.3 * p,
            0.2 * np.abs(p),
            nothing,
            nothing,
        )

    for k in range(30):
        state, _, _ = exact_bank.step(design, state, frame(float(k)))
    return fastest(lambda: exact_bank.step(design, state, frame(30.0)), least=20, longest=0.5)


def main() -> int:
    """Run it; 1 if a limit is missed."""
    met = [run(case) for case in CASES]
    print("all limits met" if all(met) else "A LIMIT IS MISSED")
    return int(not all(met))


if __name__ == "__main__":
    sys.exit(main())
