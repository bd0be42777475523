"""Random radial feeders with their inverters, and the exact bank as one plain observer per subset."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from gridsec.estimators.exact_bank import bank as banks
from gridsec.grid.devices import Droop, fleet
from gridsec.grid.radial import Feeder
from gridsec.observers import lure as lures
from gridsec.observers.lure import Lure, close_loop

PRESETS = ("ieee1547-a", "ieee1547-b", "vde4105")


def tree(customers: int, rng: np.random.Generator, *, impedance: float = 0.01) -> Feeder:
    """A random radial feeder with one customer at every bus but the busbar."""
    parent = np.array([rng.integers(max(0, k - 3), k + 1) for k in range(customers)])
    return Feeder(
        name="random",
        parent=parent,
        r=rng.uniform(0.5, 2.0, customers) * impedance,
        x=rng.uniform(0.5, 2.0, customers) * impedance,
        bus=np.arange(1, customers + 1),
        customers=tuple(f"c{i}" for i in range(customers)),
        buses=tuple(f"b{i}" for i in range(customers + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(customers),
    )


def mixed_fleet(customer: np.ndarray, rng: np.random.Generator) -> Droop:
    names = [PRESETS[i % 3] for i in range(customer.size)]
    return fleet(customer, names, rng.uniform(3.0, 10.0, customer.size), 100.0)


def plant(
    rng: np.random.Generator, *, customers: int = 6, inverters: object = None, meters: object = None
) -> Lure:
    every = np.arange(customers)
    own = every if inverters is None else np.asarray(inverters)
    where = every if meters is None else np.asarray(meters)
    return close_loop(tree(customers, rng), mixed_fleet(own, rng), where)


def one_observer(lure: Lure, trusted: np.ndarray) -> Lure:
    """The observer of one subset, written as a plant of its own with the input (u, y)."""
    n, p = lure.A.shape[0], lure.C.shape[0]
    H, F, from_meter = lure.H.copy(), lure.F.copy(), np.zeros((n, p))
    for i in range(n):
        for j in range(p):
            same = np.array_equal(lure.H[i], lure.C[j]) and np.array_equal(lure.F[i], lure.D[j])
            if same and trusted[j]:
                H[i], F[i] = 0.0, 0.0
                from_meter[i, j] = 1.0
                break
    wide = np.hstack([F, from_meter])
    return Lure(
        A=lure.A,
        G=lure.G,
        H=H,
        F=wide,
        B=np.hstack([lure.B, np.zeros((n, p))]),
        C=lure.C,
        D=np.hstack([lure.D, np.zeros((p, p))]),
        slope=lure.slope,
        phi=lure.phi,
    )


def loop_step(
    bank: banks.Bank, x: np.ndarray, y: np.ndarray, u: np.ndarray, *, seen: np.ndarray, h: float
) -> np.ndarray:
    """What `bank.step` computes, one observer after the other."""
    if not x.shape[1]:
        return x
    prepared = lures.transition(bank.lure, h, bank.policy)
    known = np.concatenate([u, np.where(seen, y, 0.0)])
    return np.stack(
        [
            lures.step(prepared, one_observer(bank.lure, mask & seen), state, known)
            for mask, state in zip(bank.masks, x, strict=True)
        ]
    )


def loop_consistency(bank: banks.Bank, x: np.ndarray) -> np.ndarray:
    """Equation (6) read aloud."""
    p, M = bank.masks.shape[1], bank.sets.max_attacked
    number = {tuple(np.flatnonzero(mask)): i for i, mask in enumerate(bank.masks)}
    if M == 0:
        return np.zeros(1)
    return np.array(
        [
            max(np.abs(x[number[S]] - x[number[P]]).max(initial=0.0) for P in combinations(S, p - 2 * M))
            for S in combinations(range(p), p - M)
        ]
    )


def large_order(bank: banks.Bank) -> list[tuple[int, ...]]:
    return [tuple(np.flatnonzero(mask)) for mask in bank.masks[: bank.sets.count_large]]


def states(bank: banks.Bank, state: banks.BankState) -> np.ndarray:
    return np.stack([banks.estimate(bank, state, i) for i in range(bank.masks.shape[0])])


def readings(lure: Lure, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    u = rng.uniform(-0.05, 0.15, lure.F.shape[1])
    x = rng.uniform(-1.0, 1.0, lure.A.shape[0]) * 0.03
    return lure.C @ x + lure.D @ u + rng.normal(0.0, 0.01, lure.C.shape[0]), u


CASES = {
    "all customers have inverter and meter": {},
    "some customers have no inverter": {"inverters": [0, 2, 5]},
    "some inverters have no meter": {"meters": [0, 1, 3, 4, 5]},
    "two inverters at one customer": {"inverters": [0, 1, 1, 4]},
    "no inverters": {"inverters": []},
}


def ordered(bank: banks.Bank, x: np.ndarray) -> np.ndarray:
    """`loop_consistency` in the bank's own order of sets."""
    p, M = bank.masks.shape[1], bank.sets.max_attacked
    by_set = dict(zip(combinations(range(p), p - M), loop_consistency(bank, x), strict=True))
    return np.array([by_set[S] for S in large_order(bank)])
