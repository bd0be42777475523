"""Days without an attack on every feeder and in every season: how often the monitor raises an alarm.

    python -m benchmarks.clean_days [days] [--rate R] [--estimator NAME] [--feeder NAME ...]

Thirty days by default, shared evenly between all feeders and the four seasons. Every run
has its own seed (meters, loads, clouds, busbar) and begins at an hour of the season's profiles drawn at
random, so that weekdays and weekends, days and nights are all seen. The truth is full AC power flow with the
droop inverters; readings go through the whole chain of the service (`service.engine.replay`), with the alarm
delays of the feeder's file, every 10 s up to 50 customers and every 30 s above. In half of the runs, of all
feeders and seasons, the meters' fixed errors are learned over `commission_s` as the file has it, in the
others over a quarter of the run; the rest is watched with what was learned.

Counted are the ticks' verdicts after two minutes, meters suspected at any tick, and alarms. An alarm is a
false one unless it is about a voltage that truly is outside the limits. They are held against
`alarms_per_year` (1 in all files; --rate changes it): exits 1 if there are more than a Poisson variable of
that mean exceeds in one case of a hundred.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from time import process_time

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy.stats import poisson

from feeders.format.columns import ESTIMATORS
from feeders.model.site import Site, from_tables, load, names
from feeders.profiles import Season, library
from feeders.simulation.scenario import START, Scenario, SimulatedReading, simulate
from gridsec.arrays import Floats
from gridsec.interface import Decision
from service.alarms.conditions import AlarmKind
from service.alarms.state_machine import Change
from service.engine.feeder_monitor import TickResult
from service.engine.replay import ReplayCounts, replay

DAY_S, YEAR_S = 86_400.0, 365.25 * 86_400.0
SETTLED_S = 120.0
LARGE, SMALL_TICK_S, LARGE_TICK_S = 50, 10.0, 30.0
SOONER = 0.25
"""Part of a run after which half of them have learned their meters' errors."""
QUANTILE = 0.99
NOTES = 50
"""Ticks without the verdict CLEAN that are told one by one, at most."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run: a feeder set to it, and what is played on it."""

    site: Site
    scenario: Scenario


@dataclass
class Seen:
    """What was seen in one run, or in several together."""

    span_s: float = 0.0
    learned_s: float = 0.0
    ticks: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    suspects: set[str] = field(default_factory=set)
    false: Counter[str] = field(default_factory=Counter)
    rightly: int = 0
    truth_s: float = 0.0
    monitor_s: float = 0.0
    notes: list[str] = field(default_factory=list)

    def add(self, other: Seen) -> None:
        """Take in another run."""
        self.span_s += other.span_s
        self.learned_s += other.learned_s
        self.ticks += other.ticks
        self.verdicts += other.verdicts
        self.suspects |= other.suspects
        self.false += other.false
        self.rightly += other.rightly
        self.truth_s += other.truth_s
        self.monitor_s += other.monitor_s
        self.notes += other.notes


def plan(  # noqa: PLR0917  # what one run is of
    name: str, season: Season, number: int, span_s: float, rate: float | None, estimator: str | None = None
) -> Run:
    """One run of `span_s`, the `number`-th of all."""
    tables = load(name).tables
    own = tables.meta.monitor
    tick_s = LARGE_TICK_S if len(tables.customers) > LARGE else SMALL_TICK_S
    settings = replace(
        own,
        tick_s=tick_s,
        silence_s=max(own.silence_s, 3.0 * tick_s),
        commission_s=SOONER * span_s if sum(divmod(number, len(Season))) % 2 else own.commission_s,
        alarms_per_year=own.alarms_per_year if rate is None else rate,
        estimator=own.estimator if estimator is None else estimator,
    )
    site = from_tables(replace(tables, meta=replace(tables.meta, monitor=settings)))
    hours = library(season).t_s.size // 4
    hour = int(np.random.default_rng(number).integers(hours))
    scenario = Scenario(seed=number, duration_s=span_s, dt_s=tick_s, profile_s=3600.0 * hour, season=season)
    return Run(site, scenario)


def play(run: Run) -> Seen:
    """Play and watch a run."""
    site, meta = run.site, run.site.tables.meta
    seen = Seen(span_s=run.scenario.duration_s)
    seen.learned_s = max(seen.span_s - meta.monitor.commission_s, 0.0)
    truth: dict[float, Floats] = {}

    def readings() -> Iterator[SimulatedReading]:
        samples = simulate(site, run.scenario)
        while True:
            began = process_time()
            sample = next(samples, None)
            seen.truth_s += process_time() - began
            if sample is None:
                return
            truth[sample.t] = sample.v_volt[site.meters] / meta.voltage_volt
            yield from sample.readings

    began = process_time()
    for result in replay(site, readings(), ReplayCounts()):
        _count(seen, site, result, truth)
        for t in [t for t in truth if t <= result.report.t]:
            del truth[t]
    seen.monitor_s = process_time() - began - seen.truth_s
    return seen


def _count(seen: Seen, site: Site, result: TickResult, truth: dict[float, Floats]) -> None:
    """Take one tick into account."""
    report, limits = result.report, site.tables.meta.limits
    at = f"{site.feeder.name}, {(report.t - START) / 3600.0:.3f} h after the beginning"
    seen.ticks += 1
    if report.t >= START + SETTLED_S:
        seen.verdicts[str(report.verdict)] += 1
        if report.verdict is not Decision.CLEAN and len(seen.notes) < NOTES:
            seen.notes.append(f"{at}: {report.verdict}: {report.reason}")
    for meter in report.meters:
        if meter.suspect and meter.meter not in seen.suspects:
            seen.suspects.add(meter.meter)
            seen.notes.append(f"{at}: {meter.meter} is suspected")
    for transition in result.transitions:
        alarm = transition.alarm
        if transition.change is not Change.RAISED:
            continue
        if alarm.kind is AlarmKind.VOLTAGE_LIMIT:
            v = truth[report.t][site.meter_ids.index(str(alarm.meter))]
            if not limits.v_min_pu <= v <= limits.v_max_pu:
                seen.rightly += 1
                continue
        seen.false[str(alarm.kind)] += 1
        seen.notes.append(f"{at}: alarm {alarm.kind} of {alarm.subject or 'the feeder'}: {alarm.reason}")


def row(name: str, season: str, begins: str, seen: Seen) -> str:
    """One line of the table."""
    judged = max(sum(seen.verdicts[str(decision)] for decision in Decision), 1)
    shares = (f"{100.0 * seen.verdicts[str(each)] / judged:.2f}" for each in Decision)
    false = ", ".join(f"{count} {kind}" for kind, count in seen.false.items()) or "0"
    cells = (
        name,
        season,
        begins,
        f"{seen.span_s / DAY_S:.2f}",
        f"{seen.learned_s / DAY_S:.2f}",
        str(seen.ticks),
        *shares,
        str(len(seen.suspects)),
        false,
        str(seen.rightly),
        f"{seen.truth_s:.0f}",
        f"{seen.monitor_s:.0f}",
    )
    return "| " + " | ".join(cells) + " |"


def main(days: float, rate: float | None, estimator: str | None, feeders: list[str] | None) -> int:
    """Play all runs, print, and judge."""
    cells = list(product(feeders or names(balanced=False), Season))
    span_s = DAY_S * days / len(cells)
    shares = (f"{decision} %" for decision in Decision)
    counts = ("suspected", "false alarms", "true alarms", "truth s", "monitor s")
    head = ("feeder", "season", "begins", "days", "of these learned", "ticks", *shares, *counts)
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head), flush=True)
    total, asked = Seen(), 0.0
    for number, (name, season) in enumerate(cells):
        run = plan(name, season, number, span_s, rate, estimator)
        seen = play(run)
        day, hour = divmod(run.scenario.profile_s / 3600.0, 24.0)
        weekday = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")[int(day) % 7]
        print(row(name, season, f"{weekday} {hour:.0f} h", seen), flush=True)
        for note in seen.notes:
            print(f"    {note}", file=sys.stderr, flush=True)
        asked += run.site.tables.meta.monitor.alarms_per_year * seen.span_s / YEAR_S
        total.add(seen)
    print(row("all", "", "", total))
    alarms, allowed = total.false.total(), int(poisson.ppf(QUANTILE, asked))
    print(f"\n{alarms} false alarms; asked for at most {asked:.2f}, with 99 % certainty at most {allowed}")
    return int(alarms > allowed)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Days without an attack.")
    parser.add_argument("days", nargs="?", type=float, default=30.0, help="simulated days in total")
    parser.add_argument("--rate", type=float, help="alarms per feeder and year asked for")
    parser.add_argument("--estimator", choices=ESTIMATORS, help="estimator in place of that of the files")
    parser.add_argument("--feeder", action="append", choices=names(balanced=False), help="these feeders only")
    given = parser.parse_args()
    sys.exit(main(given.days, given.rate, given.estimator, given.feeder))
