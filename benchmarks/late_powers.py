"""Powers that are older than the voltages beside them, with kettles and charging cars, and no manipulation.

    python -m benchmarks.late_powers [runs] [minutes]
    python -m benchmarks.late_powers [runs] [minutes] --unchanged

Kerber Dorfnetz without inverters, one reading per second, AC power flow as the truth. Every household
switches a kettle of 2 kW for 150 s, every ten minutes on average; every fifth customer, with a connection of
14 kW, charges a car with 11 kW from a random moment on. Meters have fixed errors within their class, and
registers of 1 %.

Powers: `fresh`, of the moment of the voltage; `rising`, the same where kettles and cars need 4 s to reach
their power; `late`, 60 s old; `held`, read every 60 s at a moment of the
customer's own and repeated. Stated: nothing; `t_power` on the wire; `p_interval_s` = 60 s in the files.

Columns: runs; runs with an honest meter named; honest meters named; ticks CLEAN, UNDECIDED and ATTACKED, %;
largest error of a voltage over its standard deviation and over its bound; named of a third of the meters that
reads 3 % wrong, with random signs, in the last two minutes. Exits 1 when an honest meter is named although
the age is stated, or an error is beyond the bound.

With `--unchanged`: `held` powers, rounded to 10 W, `p_interval_s` = 60 s, no manipulation. Registers of some
customers are stuck from the third minute on or read 50 W (empty houses). Exits 1 if an honest meter is named,
an error is beyond the bound, or all registers are stuck and the verdict stays CLEAN.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from dataclasses import dataclass, replace
from functools import lru_cache

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import PowerAges, Site, Snapshot, from_tables, load, to_frame
from feeders.registry import DesignedEstimator, design
from feeders.simulation.demand import Customers, Variation
from feeders.simulation.powerflow import PowerFlow
from feeders.simulation.scenario import START
from gridsec.arrays import Floats
from gridsec.interface import Decision

LATE_S = 60.0
"""Age of late powers and interval of held ones, s."""
KETTLE_KW, KETTLE_S, KETTLE_EVERY_S = 2.0, 150.0, 600.0
CAR_KW, CAR_CONNECTION_KW, CAR_OF = 11.0, 14.0, 5
"""Power of a charging car, connection of its customer, kW, and customers for each car."""
TAP_EVERY_S = 120.0
"""Interval with one step of the tap changer, s."""
LIES_S = 120.0
"""Length of the manipulation at the end, s."""
LIE = 0.03
RISE_S = 4.0
"""Time in which rising loads reach their power, s."""
STUCK_S, EMPTY_KW, RESOLUTION_KW = 120.0, 0.05, 0.01
"""Last renewal of stuck registers, s; power of an empty house and resolution of a register, kW."""
UNCHANGED = (("empty", 1), ("empty", 6), ("stuck", 6), ("stuck", 28), ("stuck", 57))
"""Kinds of unchanged powers and their number of customers, of 57."""
CASES = (
    ("fresh", ""),
    ("rising", ""),
    ("late", ""),
    ("late", "t_power"),
    ("late", "p_interval_s"),
    ("held", ""),
    ("held", "t_power"),
    ("held", "p_interval_s"),
)


@lru_cache(maxsize=4)
def site(interval_s: float) -> Site:
    """The feeder whose files state an age of the powers, s."""
    tables = load("kerber-dorfnetz").tables
    rows = tuple(
        replace(
            row,
            inverter_kva=0.0,
            droop="",
            load_kw=CAR_CONNECTION_KW if k % CAR_OF == 0 else row.load_kw,
        )
        for k, row in enumerate(tables.customers)
    )
    meters = replace(tables.meta.meters, p_interval_s=interval_s)
    return from_tables(replace(tables, customers=rows, meta=replace(tables.meta, meters=meters)))


@lru_cache(maxsize=4)
def watcher(interval_s: float) -> DesignedEstimator:
    """The monitor of that feeder."""
    return design(site(interval_s))


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Honest truth and readings of one run. T ticks, N customers, all of them metered.

    t: (T,) s. p_kw: (T + 60, N), from 60 s before. v, read, v0: (T, N), (T, N) and (T,) V. register: (N,).
    """

    t: Floats
    p_kw: Floats
    v: Floats
    read: Floats
    v0: Floats
    register: Floats


@lru_cache(maxsize=64)
def world(seed: int, duration_s: int, tap_step_pu: float = 0.0, rise_s: float = 0.0) -> World:
    """One run.

    Parameters
    ----------
    seed
        Chooses everything random.
    duration_s
        Length, s.
    tap_step_pu
        Height of the steps of the transformer's tap changer, one in each interval of `TAP_EVERY_S`.
    rise_s
        Time in which a load reaches its power, s.
    """
    where, random = site(0.0), np.random.default_rng([seed, 60])
    t = START + np.arange(-LATE_S, duration_s)
    profile_s = float(random.uniform(0.0, 13.0 * 86_400.0))
    variation = Variation(tap_step_pu=tap_step_pu, tap_interval_s=TAP_EVERY_S)
    honest = Customers(where, variation, seed, START, profile_s).at(t)
    peak, count = np.array([row.load_kw for row in where.tables.customers]), len(where.tables.customers)
    on = np.zeros((t.size, count))
    for k in range(count):
        for begin in random.uniform(t[0] - KETTLE_S, t[-1], random.poisson(t.size / KETTLE_EVERY_S)):
            on[(t >= begin) & (t < begin + KETTLE_S), k] = KETTLE_KW
        if k % CAR_OF == 0:
            on[t >= random.uniform(START, t[-1]), k] += CAR_KW
    if rise_s > 0.0:
        sums = np.cumsum(np.vstack([np.repeat(on[:1], round(rise_s), axis=0), on]), axis=0)
        on = (sums[round(rise_s) :] - sums[: -round(rise_s)]) / round(rise_s)
    p_kw = np.minimum(0.5 * honest.p_kw + on, peak)
    late = round(LATE_S)
    v, _ = PowerFlow(where).solve_batch(p_kw[late:], honest.q_kvar[late:] + 0.0, honest.v0_volt[late:])
    meta = where.tables.meta
    fixed = 1.0 + random.uniform(-1.0, 1.0, count) * meta.meters.class_percent / 100.0
    jitter = meta.meters.jitter_percent / 100.0 * meta.voltage_volt * random.standard_normal(v.shape)
    step = meta.meters.resolution_volt
    read = step * np.round((v * fixed + jitter) / step)
    register = 1.0 + random.uniform(-1.0, 1.0, count) * meta.meters.p_error_percent / 100.0
    return World(t[late:], p_kw, v, read, honest.v0_volt[late:], register)


def ages(seed: int, how: str, ticks: int, count: int) -> Floats:
    """Age of every power, (T, N), s."""
    if how == "held":
        moment = np.random.default_rng([seed, 61]).integers(0, round(LATE_S), count)
        return (np.arange(ticks)[:, None] + moment) % LATE_S
    return np.full((ticks, count), LATE_S if how == "late" else 0.0)


def run(seed: int, duration_s: int, how: str, stated: str) -> tuple[Counter[str], float, float]:
    """Counts of one run, and its largest error over the standard deviation and over the bound.

    Parameters
    ----------
    seed, duration_s
        As in `world`.
    how, stated
        Ages of the powers, and the place that states them.
    """
    interval = LATE_S if stated == "p_interval_s" else 0.0
    where, made, truth = (
        site(interval),
        watcher(interval),
        world(seed, duration_s, rise_s=RISE_S * (how == "rising")),
    )
    age, random = ages(seed, how, truth.t.size, truth.v.shape[1]), np.random.default_rng([seed, 62])
    liars, sign = (
        random.permutation(truth.v.shape[1]) < truth.v.shape[1] // 3,
        random.choice([-1.0, 1.0], truth.v.shape[1]),
    )
    state, seen, named = made.init(START), Counter[str](), np.zeros((2, liars.size), dtype=np.bool_)
    of_std = of_bound = 0.0
    for k, t in enumerate(truth.t):
        old = np.round(k + LATE_S - age[k]).astype(np.intp)
        p = truth.register * truth.p_kw[old, np.arange(liars.size)]
        lies = k >= duration_s - LIES_S
        v = truth.read[k] * np.where(liars & lies, 1.0 + LIE * sign, 1.0)
        told = age[k] if stated == "t_power" else None
        said = Snapshot(t, v, p, np.full(p.size, np.nan), truth.v0[k], told)
        state, estimate, verdict = made.step(state, to_frame(where, said))
        if lies:
            named[1] |= verdict.suspects & liars
            named[0] |= verdict.suspects & ~liars
            continue
        named[0] |= verdict.suspects
        seen[verdict.decision] += 1
        error = np.abs(estimate.v2 - (truth.v[k] / where.customer_volt) ** 2)
        of_std = max(of_std, float((error / estimate.std).max()))
        of_bound = max(of_bound, float((error / estimate.bound).max()))
    seen["ticks"], seen["honest"], seen["named"] = (
        truth.t.size - round(LIES_S),
        int(named[0].sum()),
        int(named[1].sum()),
    )
    seen["liars"], seen["false"] = int(liars.sum()), int(named[0].any())
    return seen, of_std, of_bound


def unchanged(seed: int, duration_s: int, kind: str, count: int) -> tuple[Counter[str], float, float]:
    """Counts of a run with unchanged powers; its largest error over the standard deviation and the bound.

    Parameters
    ----------
    seed, duration_s
        As in `world`.
    kind, count
        "empty" or "stuck", and the number of its customers.
    """
    where, made, truth = site(LATE_S), watcher(LATE_S), world(seed, duration_s)
    customers = truth.v.shape[1]
    which = np.random.default_rng([seed, 63]).permutation(customers)[:count]
    age, ages_of, state = ages(seed, "held", truth.t.size, customers), PowerAges(where), made.init(START)
    seen, of_std, of_bound = Counter[str](), 0.0, 0.0
    for k, t in enumerate(truth.t):
        old = np.round(k + LATE_S - age[k]).astype(np.intp)
        p = truth.register * truth.p_kw[old, np.arange(customers)]
        last = round(min(k, STUCK_S))
        p[which] = EMPTY_KW if kind == "empty" else (truth.register * truth.p_kw[last])[which]
        p = RESOLUTION_KW * np.round(p / RESOLUTION_KW)
        said = Snapshot(t, truth.read[k], p, np.full(p.size, np.nan), truth.v0[k])
        state, estimate, verdict = made.step(state, to_frame(where, ages_of.apply(said)))
        seen[verdict.decision] += 1
        seen["honest"] += int(np.count_nonzero(verdict.suspects))
        error = np.abs(estimate.v2 - (truth.v[k] / where.customer_volt) ** 2)
        of_std = max(of_std, float((error / estimate.std).max()))
        of_bound = max(of_bound, float((error / estimate.bound).max()))
    return seen, of_std, of_bound


def without_change(runs: int, minutes: int) -> int:
    """Print the table of unchanged powers; 1 if a limit is missed."""
    print(
        "| unchanged | customers | runs | honest named | CLEAN % | UNDECIDED % | in std | in bounds |\n|",
        end="",
    )
    print("---|" * 8)
    good = True
    for kind, count in UNCHANGED:
        all_, of_std, of_bound = Counter[str](), 0.0, 0.0
        for seed in range(runs):
            seen, std, bound = unchanged(seed, 60 * minutes, kind, count)
            all_ += seen
            of_std, of_bound = max(of_std, std), max(of_bound, bound)
        ticks = runs * minutes * 60
        share = [f"{100.0 * all_[each] / ticks:.1f}" for each in (Decision.CLEAN, Decision.UNDECIDED)]
        cells = [kind, f"{count}", f"{runs}", f"{all_['honest']}", *share, f"{of_std:.1f}", f"{of_bound:.2f}"]
        print(f"| {' | '.join(cells)} |", flush=True)
        good &= not all_["honest"] and of_bound <= 1.0
        good &= (kind, count) != UNCHANGED[-1] or all_[Decision.UNDECIDED] > 0
    return 0 if good else 1


def main(runs: int, minutes: int) -> int:
    """Print a table; 1 if a limit is missed."""
    print(
        "| powers | stated | runs | with honest named | honest named | CLEAN % | UNDECIDED % | ATTACKED % |",
        end="",
    )
    print(" in std | in bounds | liars named |\n|" + "---|" * 11)
    good = True
    for how, stated in CASES:
        all_, of_std, of_bound = Counter[str](), 0.0, 0.0
        for seed in range(runs):
            seen, std, bound = run(seed, 60 * minutes, how, stated)
            all_ += seen
            of_std, of_bound = max(of_std, std), max(of_bound, bound)
        share = [f"{100.0 * all_[each] / all_['ticks']:.1f}" for each in Decision]
        cells = [how, stated or "-", f"{runs}", f"{all_['false']}", f"{all_['honest']}"]
        cells += [share[0], share[2], share[1], f"{of_std:.1f}", f"{of_bound:.2f}"]
        cells += [f"{all_['named']} of {all_['liars']}"]
        print(f"| {' | '.join(cells)} |", flush=True)
        good &= not stated or (not all_["honest"] and of_bound <= 1.0)
    return 0 if good else 1


if __name__ == "__main__":
    asked = arguments(__doc__, runs=20, minutes=10, unchanged=False)
    sys.exit((without_change if asked.unchanged else main)(asked.runs, asked.minutes))
