"""Hints at wrong feeder files beside accusations: with errors in the files, and with manipulated meters.

    python -m benchmarks.data_errors [seeds] [--first 1] [--feeder NAME ...] [--part files attacks]

Every run has one hour and a reading every 10 s: AC power flow of the true feeder as the truth, meters with
errors within their class, 2 % of the readings lost, a random time of two weeks of summer. Files with an
error are those of `benchmarks.calibrate_exchanges`; with `attacks` the files are right, and one meter or a
third of the meters are manipulated from the first minute on. Feeders marked 3 have single-phase customers.

Files: runs; runs with an accused meter; of these runs with a hint for one, with a hint at the planted error,
at another error of the same customers; minutes from the first accusation to the first hint, median and
largest; ticks with an accusation after the first hint that carry a hint, %. Attacks: runs; runs with an
accused meter; runs with any hint. Exits 1 if an attack has a hint.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import count
from benchmarks.calibrate_exchanges import planted, truth_of
from feeders import registry
from feeders.format.tables import FeederTables
from feeders.model.equipment import find
from feeders.model.site import Site, Snapshot, from_tables, plant, to_frame
from feeders.simulation.plant import Channel, MeterErrors
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.attack import Attack, Bias, Drift, Random, Replay, Scaling, Stuck
from gridsec.estimators import data_errors

FEEDERS: Final = ("cigre-lv:3", "kerber-landnetz:3", "simbench-lv-rural1:3", "cigre-lv", "simbench-lv-rural1")
FILES: Final = ("phases", "phase", "meters", "bus")
ATTACKS: Final = ("bias", "scale", "ramp", "dither", "slow dither", "stuck", "replay")
SHARES: Final = ("one", "third")
STEP_S: Final = 10.0
DURATION_S: Final = 3600.0
ONSET_S: Final = 60.0
REPLAYED_S: Final = 6.0 * 3600.0
TWO_WEEKS_S: Final = 13.9 * 86_400.0

SIZES: Final = (0.015, 0.08)
"""Smallest and largest size of a manipulation, pu."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one run.

    Attributes
    ----------
    accused
        Ticks with an accused meter.
    hints
        Of these, ticks with a hint for one.
    after_s
        From the first accusation to the first hint, s; None without a hint.
    later
        Ticks with an accused meter from the first hint on.
    customers, right
        The last hint is about a planted customer; it restores the true files.
    told
        The last hint.
    """

    accused: int
    hints: int
    after_s: float | None
    later: int
    customers: bool
    right: bool
    told: str


def tables_of(feeder: str) -> FeederTables:
    """Tables of a feeder; with the mark 3 those with single-phase customers."""
    name, _, mark = feeder.partition(":")
    tables = truth_of(name) if mark else find(name)
    monitor = replace(
        tables.meta.monitor, tick_s=STEP_S, silence_s=max(tables.meta.monitor.silence_s, 3 * STEP_S)
    )
    return replace(tables, meta=replace(tables.meta, monitor=monitor))


def attack(site: Site, kind: str, share: str, seed: int) -> tuple[Attack, ...]:
    """A manipulation, drawn by the seed."""
    rng = np.random.default_rng([seed, ATTACKS.index(kind), SHARES.index(share)])
    p = len(site.meter_ids)
    k = 1 if share == "one" else max(p // 3, 2)
    at, on, off = np.sort(rng.choice(p, k, replace=False)), START + ONSET_S, START + DURATION_S
    size = rng.choice([-1.0, 1.0], k) * rng.uniform(*SIZES, k)
    match kind:
        case "bias":
            return (Bias(at, on, off, size),)
        case "scale":
            return (Scaling(at, on, off, size),)
        case "ramp":
            return (Drift(at, on, off, size / DURATION_S, np.abs(size)),)
        case "stuck":
            return (Stuck(at, on, off),)
        case "replay":
            return (Replay(at, on, off, REPLAYED_S),)
    hold = STEP_S if kind == "dither" else 300.0
    return (Random(at, on, off, np.zeros(k), np.abs(size), hold, seed),)


def run(truth: FeederTables, files: FeederTables, seed: int, attacks: Sequence[Attack] = ()) -> Outcome:
    """Watch one hour of the true feeder with these files."""
    true, site = from_tables(truth), from_tables(files)
    rng = np.random.default_rng([seed, 7])
    scene = Scenario(
        seed=seed,
        duration_s=DURATION_S,
        dt_s=STEP_S,
        profile_s=float(rng.uniform(0.0, TWO_WEEKS_S)),
        errors=MeterErrors(report_q=seed % 2 == 1),
        channel=Channel(loss=0.02),
        attacks=tuple(attacks),
    )
    order = [true.meter_ids.index(meter) for meter in site.meter_ids]
    watcher = registry.design(site)
    state, window = watcher.init(START), data_errors.begin()
    design = data_errors.design(plant(site), site.base_volt, STEP_S)
    assert design is not None  # these feeders are small
    first = first_hint = None
    ticks = hints = later = 0
    last: data_errors.DataError | None = None
    for one in snapshots(simulate(true, scene)):
        frame = to_frame(site, _ordered(one, order))
        state, estimate, verdict = watcher.step(state, frame)
        accused = data_errors.accused(verdict)
        window = data_errors.follow(design, window, frame, estimate.x, accused)
        ticks += bool(accused.any())
        first = frame.t if first is None and accused.any() else first
        if window.error is not None and accused[list(window.error.meters)].any():
            first_hint, last = first_hint or frame.t, window.error
            hints += 1
        later += bool(accused.any()) and first_hint is not None
    after = None if first_hint is None or first is None else first_hint - first
    return Outcome(ticks, hints, after, later, *_compared(truth, files, site, last))


def _ordered(one: Snapshot, order: list[int]) -> Snapshot:
    return replace(one, v_volt=one.v_volt[order], p_kw=one.p_kw[order], q_kvar=one.q_kvar[order])


def _compared(
    truth: FeederTables, files: FeederTables, site: Site, error: data_errors.DataError | None
) -> tuple[bool, bool, str]:
    """The hint is about a customer with an error; it restores the true places of the meters; its words."""
    if error is None:
        return False, False, ""
    bus_of, names = site.bus_of_file, site.feeder.customers
    phased = len(site.feeder.buses) > len(site.spanning.buses)

    def places(tables: FeederTables) -> dict[str, int]:
        each = {}
        for row in tables.customers:
            q = bus_of[row.bus]
            each[row.meter or row.customer] = 3 * q + "abc".index(row.phases) if phased else q
        return each

    wanted, now = places(truth), places(files)
    wrong = {meter for meter in wanted if wanted[meter] != now[meter]}
    ids = {row.customer: row.meter or row.customer for row in files.customers}
    moved = {ids[names[i]]: q for i, q in zip(error.customers, error.places, strict=True)}
    told = f"{error.kind} " + ", ".join(
        f"{names[i]} at {site.feeder.buses[q]}" for i, q in zip(error.customers, error.places, strict=True)
    )
    return bool(wrong & set(moved)), (now | moved) == wanted, told


def _files(feeder: str, seeds: range) -> str:
    truth, rows = tables_of(feeder), []
    for error in FILES:
        if error in {"phases", "phase"} and not feeder.endswith(":3"):
            continue
        found = []
        for seed in seeds:
            files, told = planted(truth, error, seed)
            one = run(truth, files, seed)
            found.append(one)
            after = "" if one.after_s is None else f"{one.after_s / 60:.1f} min"
            counted = f"{one.accused} accused, {one.hints} hints {after} {one.told}"
            print(f"  {feeder} {error} {seed} [{told}]: {counted}", flush=True)
        rows.append(f"| {feeder} | {error} | {_row(found)} |")
    return "\n".join(rows)


def _row(found: Sequence[Outcome]) -> str:
    """Cells of one kind of error."""
    hinted = [one for one in found if one.after_s is not None]
    minutes = [one.after_s / 60.0 for one in hinted if one.after_s is not None]
    cells = (
        len(found),
        sum(one.accused > 0 for one in found),
        len(hinted),
        sum(one.right for one in hinted),
        sum(one.customers and not one.right for one in hinted),
        f"{np.median(minutes):.0f}, {max(minutes):.0f}" if minutes else "-",
        f"{100.0 * sum(one.hints for one in hinted) / max(sum(one.later for one in hinted), 1):.0f}",
    )
    return " | ".join(map(str, cells))


def _attacks(feeder: str, seeds: range) -> tuple[str, int]:
    truth, rows, total = tables_of(feeder), [], 0
    site = from_tables(truth)
    for kind in ATTACKS:
        for share in SHARES:
            found = []
            for seed in seeds:
                found.append(run(truth, truth, seed, attack(site, kind, share, seed)))
                if found[-1].hints:
                    told = f"{found[-1].hints} hints {found[-1].told}"
                    print(f"  {feeder} {kind} {share} {seed}: {told}", flush=True)
            accused, hinted = sum(one.accused > 0 for one in found), sum(one.hints > 0 for one in found)
            total += hinted
            rows.append(f"| {feeder} | {kind} | {share} | {len(found)} | {accused} | {hinted} |")
    return "\n".join(rows), total


def main(seeds: range, feeders: Sequence[str], parts: Sequence[str]) -> int:
    """Print the tables; return the number of attacks with a hint."""
    wrong, tables = 0, list[str]()
    if "files" in parts:
        tables += [
            "\n| feeder | error | runs | accused | hint | right | same customers | min | kept, % |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        tables += [rows for feeder in feeders if (rows := _files(feeder, seeds))]
    if "attacks" in parts:
        tables += ["\n| feeder | attack | meters | runs | accused | hint |", "|---|---|---|---|---|---|"]
        for feeder in feeders:
            rows, hinted = _attacks(feeder, seeds)
            tables.append(rows)
            wrong += hinted
    print("\n".join(tables))
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.data_errors",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("seeds", type=count, nargs="?", default=3)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--feeder", nargs="+", default=list(FEEDERS))
    parser.add_argument("--part", nargs="+", choices=("files", "attacks"), default=["files", "attacks"])
    wanted = parser.parse_args()
    sys.exit(int(main(range(wanted.first, wanted.first + wanted.seeds), wanted.feeder, wanted.part) > 0))
