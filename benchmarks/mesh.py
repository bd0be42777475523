"""Feeders with closed ties: the model against the AC power flow, and a third of the meters lying.

The monitor is the default one.

`python -m benchmarks.mesh`; the numbers of docs/theory-mesh.md. Half a minute.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from feeders.format.tables import FeederTables, LineRow
from feeders.model.site import Site, from_tables, load
from feeders.registry import design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.powerflow import power_flow
from feeders.simulation.trial import LoadError, Trial, TrialResult, judge
from gridsec.arrays import Floats
from gridsec.grid.meshed import Meshed

LOADS = (0.25, 0.5, 1.0)
SEEDS = range(5)
LOAD_KW = {"kerber-landnetz": 0.3, "simbench-lv-rural3": 0.6, "case33bw": 2.0, "ieee-european-lv": 0.6}
# A third, but where phases hardly vouch for each other a tenth: a third of all may be most of one phase.
LIARS = {"ieee-european-lv": 6}
STEP_KW = 0.01


def closed(tables: FeederTables, *ties: LineRow) -> FeederTables:
    """The same feeder with every line closed, and some more lines."""
    lines = tuple(replace(row, closed=True) for row in (*tables.lines, *ties))
    return replace(tables, meta=replace(tables.meta, meshed=True), lines=lines)


@cache
def landnetz() -> Site:
    """A line of thirteen houses, closed to a ring: its far end is connected to the busbar as well."""
    return from_tables(
        closed(load("kerber-landnetz").tables, LineRow("ring", "bus_1_13", "main_busbar", 0.05, 0.01))
    )


@cache
def rural3() -> Site:
    """The village of 118 customers, the ends of its two longest lines joined."""
    site = load("simbench-lv-rural3")
    x, y = site.xy[site.bus_of_file["LV3.101 Bus 125"]] if site.xy is not None else (0.0, 0.0)
    tie = LineRow("ring", "LV3.101 Bus 36", "LV3.101 Bus 125", 0.01, 0.004, to_x=float(x), to_y=float(y))
    return from_tables(closed(site.tables, tie))


@cache
def baran_wu() -> Site:
    """The feeder of Baran and Wu with its five tie switches closed."""
    return from_tables(closed(load("case33bw").tables))


@cache
def european() -> Site:
    """The European feeder, 55 customers of one phase each: 22 m of its thickest cable join two far ends."""
    tie = LineRow("ring", "681", "906", 0.00196, 0.00149, r0_ohm=0.00702, x0_ohm=0.00167)
    return from_tables(closed(load("ieee-european-lv").tables, tie))


def opened(tables: FeederTables) -> FeederTables:
    """The same feeder with the ties taken as open: the last line of each loop."""
    site = from_tables(tables)
    ends = {frozenset(pair) for pair in site.ties.tolist()}

    def is_tie(row: LineRow) -> bool:
        return frozenset((site.bus_of_file[row.from_bus], site.bus_of_file[row.to_bus])) in ends

    lines = tuple(replace(row, closed=not is_tie(row)) for row in tables.lines)
    return replace(tables, meta=replace(tables.meta, meshed=False), lines=lines)


def errors(site: Site, part: float) -> str:
    """One row: drop, errors of |v| without and with a correction, its bound, and with the ties left out."""
    feeder, radial = site.feeder, from_tables(opened(site.tables)).feeder
    p_kw = part * site.loads.load_peak * feeder.base_kva
    q_kvar = 0.33 * p_kw
    truth = power_flow(site).solve(p_kw, q_kvar, feeder.base_volt)[0] / feeder.base_volt
    p, q = -p_kw / feeder.base_kva, -q_kvar / feeder.base_kva

    def off(v2: Floats, bus: Floats) -> float:
        return float(np.abs(np.sqrt(v2[bus]) - truth).max())

    found = [off(feeder.bus_voltages(p, q, 1.0, steps=steps), feeder.bus) for steps in (0, 1)]
    found.append(float((feeder.model_error_bound(p, q, 1.0) / (2.0 * truth)).max()))
    found.append(off(radial.bus_voltages(p, q, 1.0), radial.bus))
    return f"| {feeder.name} | {part:g} | {100 * (1 - truth.min()):.1f} % | " + " | ".join(
        f"{value:.1e}" for value in found
    )


def sensitivity(site: Site, part: float) -> str:
    """One row: how far R and X are from differences of the AC power flow, in parts of the largest entry.

    At a part of the peaks: those of the linear power flow, and then those of that operating point.
    """
    feeder, flow, v0 = site.feeder, power_flow(site), site.feeder.base_volt
    assert isinstance(feeder, Meshed)
    p_kw = part * site.loads.load_peak * feeder.base_kva
    p, there = -p_kw / feeder.base_kva, np.arange(p_kw.size)
    models = feeder.linear(), feeder.sensitivities(p, 0.33 * p, 1.0)
    cells = []
    for power, name in enumerate("RX"):
        moved = np.zeros((2, p_kw.size, 2, p_kw.size))
        moved[0, there, power, there], moved[1, there, power, there] = STEP_KW, -STEP_KW
        loads = (np.stack([p_kw, 0.33 * p_kw]) + moved).reshape(-1, 2, p_kw.size)
        v = flow.solve_batch(loads[:, 0], loads[:, 1], np.full(len(loads), v0))[0] / v0
        down, up = (v**2).reshape(2, p_kw.size, -1)
        slope = (up - down).T * feeder.base_kva / (4.0 * STEP_KW)
        cells.append([np.abs(getattr(model, name) - slope).max() / np.abs(slope).max() for model in models])
    return f"| {feeder.name} | {part:g} | " + " | ".join(f"{100 * v:.2g} %" for v in np.ravel(cells, "F"))


def judged(trial: Trial) -> TrialResult:
    """Verdicts of the default estimator on one trial."""
    return judge(design(trial.stated), trial, settling_s=3.0)


def named(site: Site, trick: AttackKind, percent: float) -> str:
    """One row: liars, those missed, the slowest, honest meters named, time of a step."""
    kw, count = LOAD_KW[site.feeder.name], LIARS.get(site.feeder.name, site.meters.size // 3)
    outcomes = []
    for seed in SEEDS:
        lie = AttackSpec(trick, count, percent, onset_s=10.0)
        trial = Trial(site, seed, 30.0, load_error=LoadError(kw, kw / 3.0), lie=lie)
        outcomes.append(judged(trial))
    missed, accused = sum(o.missed for o in outcomes), sum(int(o.accused.sum()) for o in outcomes)
    slowest = max(float(o.delay_s.max()) for o in outcomes)
    step = np.median(np.concatenate([o.step_ms for o in outcomes]))
    words = f"±{percent:g} %" if trick is AttackKind.BIAS else f"{percent:g} % all"
    return (
        f"| {site.feeder.name} | {count} of {site.meters.size} | {words} | "
        f"{missed} | {slowest:g} s | {accused} | {step:.1f} ms |"
    )


def clean(site: Site) -> str:
    """One row without manipulation: honest meters named, and the seconds without an answer."""
    kw = LOAD_KW[site.feeder.name]
    trials = [Trial(site, seed, 30.0, load_error=LoadError(kw, kw / 3.0)) for seed in SEEDS]
    outcomes = [judged(trial) for trial in trials]
    accused = sum(int(o.accused.sum()) for o in outcomes)
    undecided = sum(int(o.undecided[15:].sum()) for o in outcomes)
    return f"| {site.feeder.name} | nobody | | | | {accused} | {undecided} undecided |"


def main() -> None:
    """Print the tables."""
    sites = [make() for make in (landnetz, rural3, baran_wu, european)]
    for site in sites:
        for part in LOADS:
            print(errors(site, part), "|")
    for site in sites:
        for part in (0.0, 0.25, 1.0):
            print(sensitivity(site, part), "|")
    for site in sites:
        for trick, percent in ((AttackKind.BIAS, 3.0), (AttackKind.TOGETHER, -2.0)):
            print(named(site, trick, percent))
        print(clean(site))


if __name__ == "__main__":
    main()
