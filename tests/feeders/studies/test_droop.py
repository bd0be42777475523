"""The study of droop fleets, against AC simulation that is written here and against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from feeders.load import Site, from_tables
from feeders.powerflow import PowerFlow, PowerFlowDiverged
from feeders.schema import CustomerRow, FeederMeta, FeederTables, LineRow
from feeders.studies.droop_fleets import point
from feeders.studies.droop_verdict import Subject, Verdict, judge
from gridsec.arrays import Floats
from gridsec.droop import Droop
from gridsec.studies.droop_network import Box, network, sensitivity, solve
from gridsec.studies.droop_stability import Update, growth, slopes

FEEDERS, FLEETS = 20, 10
"""The random fleets around the edge of stability: 200."""

STEPS = 300


def random_site(seed: int) -> Site:
    """A village street with forks: cable or overhead line, three to six customers."""
    rng = np.random.default_rng([seed, 7])
    count = int(rng.integers(3, 7))
    ratio = rng.uniform(0.3, 1.2)
    lines = []
    for k in range(count):
        above = "bb" if k == 0 else f"n{rng.integers(max(0, k - 2), k)}"
        r = rng.uniform(0.01, 0.08)
        lines.append(LineRow(f"l{k}", above, f"n{k}", r, ratio * r, b_us=10.0))
    customers = tuple(
        CustomerRow(f"c{k}", f"n{k}", float(rng.uniform(2, 10)), pv_kw=float(rng.uniform(0, 12)))
        for k in range(count)
    )
    meta = FeederMeta(format=1, name=f"street-{seed}", voltage_volt=230.0, busbar="bb", base_kva=100.0)
    return from_tables(FeederTables(meta, tuple(lines), customers))


def near_the_edge(site: Site, rng: np.random.Generator, loads: Box, update: Update) -> Droop:
    """A random fleet whose slopes, all at their steepest, are 0.5 to 2 times what makes it unstable."""
    count = len(site.feeder.customers)
    own = np.sort(rng.choice(count, int(rng.integers(1, count + 1)), replace=False))
    share = rng.uniform(0.5, 1.5, own.size)[:, None] * np.array([1.0, 0.0, 0.0, -1.0])
    tau = rng.uniform(1.0, 4.0) * rng.choice([1.0, 3.0]) ** rng.uniform(-1.0, 1.0, own.size)
    # Slow inverters may be steep; limits move voltages by one or a few percent.
    half = rng.uniform(0.005, 0.02) * float(np.mean(update.share(tau)))
    dead = rng.choice([0.0, 0.0, 0.3]) * half
    v = 1.0 + np.outer(np.ones(own.size), [-half - dead, -dead, dead, half + dead])
    net = network(site.feeder)
    s = loads.p_low + 1j * loads.q_low
    J = sensitivity(net, s, solve(net, s, loads.v0_low)).dv_dq[np.ix_(own, own)]
    low, high = 1e-6, 1e3
    for _ in range(40):
        size = np.sqrt(low * high)
        steep = slopes(Droop(own, v, size * share, tau), np.zeros(own.size), np.full(own.size, 9.0))
        low, high = (size, high) if growth(J, steep, tau, update) < 1.0 else (low, size)
    return Droop(own, v, low * 2.0 ** rng.uniform(-1.0, 1.0) * share, tau)


def run_together(
    site: Site, fleets: list[Droop], updates: list[Update], loads: list[Box], seed: int
) -> Floats:
    """Movement of every fleet in the end, part of its limit; from a random state, by AC power flow."""
    rng, base = np.random.default_rng(seed), site.feeder
    flow, count = PowerFlow(site), len(base.customers)
    p = np.array([-base.base_kva * b.p_low for b in loads])
    drawn = np.array([-base.base_kva * b.q_low for b in loads])
    v0 = np.array([base.base_volt * b.v0_low for b in loads])
    # Curves of customers without an inverter ask for nothing.
    low, high, start, ramp, alpha = (np.zeros((len(fleets), count, *k)) for k in ((3,), (3,), (), (3,), ()))
    for k, (d, u) in enumerate(zip(fleets, updates, strict=True)):
        low[k, d.customer], high[k, d.customer] = d.v[:, :-1], d.v[:, 1:]
        width = np.maximum(np.diff(d.v, axis=1), 1e-12)
        start[k, d.customer], ramp[k, d.customer] = d.q[:, 0], np.diff(d.q, axis=1) / width
        alpha[k, d.customer] = 1.0 - np.exp(-u.interval_s / d.tau)
    limit = np.abs(start) + 1e-300
    x = rng.uniform(-1.0, 1.0, start.shape) * start
    asked, dead = [x] * 3, np.array([u.dead for u in updates])
    collapsed = np.zeros(len(fleets), dtype=bool)
    last: list[Floats] = []
    for _ in range(STEPS):
        q = np.where(collapsed[:, None], 0.0, drawn - base.base_kva * x)
        try:
            v = flow.solve_batch(p, q, v0)[0] / base.base_volt
        except PowerFlowDiverged as error:
            collapsed[int(str(error).split("set ")[1].rstrip(")"))] = True
            continue
        asks = start + ((np.clip(v[..., None], low, high) - low) * ramp).sum(axis=-1)
        asked = [*asked[-2:], asks]
        due = np.array(asked)[2 - dead, np.arange(len(fleets))]
        x = (1.0 - alpha) * x + alpha * due
        last = [*last[-59:], x]
    moved = np.max(np.ptp(np.array(last), axis=0) / limit, axis=1)
    return np.where(collapsed, np.inf, moved)


@pytest.mark.slow
def test_the_verdict_is_that_of_the_simulation_in_200_fleets_around_the_edge() -> None:
    told: dict[tuple[Verdict, bool], int] = {}
    for seed in range(FEEDERS):
        site, rng = random_site(seed), np.random.default_rng(seed)
        subject = Subject.of(site)
        updates = [
            Update(float(rng.choice([0.5, 1.0, 3.0, 60.0])), int(rng.choice([0, 0, 1, 2])))
            for _ in range(FLEETS)
        ]
        loads = [
            point(site, rng.uniform(0, 1), rng.uniform(0, 1), float(rng.uniform(0.98, 1.02)))
            for _ in range(FLEETS)
        ]
        fleets = [near_the_edge(site, rng, b, u) for b, u in zip(loads, updates, strict=True)]
        moves = run_together(site, fleets, updates, loads, seed)
        for fleet, update, at, moved in zip(fleets, updates, loads, moves, strict=True):
            found = judge(subject, fleet, update, at, seed=seed)
            key = (found.verdict, bool(moved > 1e-3))
            told[key] = told.get(key, 0) + 1
    assert sum(told.values()) == 200
    assert told.get((Verdict.STABLE, True), 0) == 0
    assert told.get((Verdict.UNSTABLE, False), 0) == 0
    assert told[Verdict.STABLE, False] >= 50
    assert told[Verdict.UNSTABLE, True] >= 50
