"""Share of planted file errors that `calibrate` repairs with default options, in three phases.

    python -m benchmarks.calibrate_exchanges [seeds] [feeder ...] [--first 1] [--errors phases ...]

One recording per feeder and seed: asymmetric AC power flow of the true feeder, meters with errors within
their class, hidden loads, 2 % of the readings lost. The files that `calibrate` receives carry one error:

- `none`: the true files;
- `phases`: the phases of two customers are exchanged;
- `rotated`: three customers, one of each phase, are each on the next phase;
- `phase`: one customer is on another phase;
- `meters`: the meters of two customers are exchanged;
- `bus`: one customer is at another bus;
- `length`: one line has 1 / 1.5 of its true length.

A repair is right if the corrected files equal the true ones: customers exactly, the planted line's length
within 15 %. Counted besides: proposed lengths of other lines, excluded meters, other wrong corrections.
Balanced feeders are made three-phase: customers take turns on the phases, r0 = 4 r, x0 = 3 x.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks import calibrate_intervals as intervals
from benchmarks._arguments import count, positive
from feeders.format.tables import FeederTables
from feeders.model.equipment import find
from feeders.model.site import from_tables
from feeders.model.three_phase import three_phase
from feeders.simulation.recording import Recording, record
from feeders.studies.calibrate.search import FileErrorKind, apply, longer
from feeders.studies.calibrate.study import Calibrate, calibrate

FEEDERS: Final = ("cigre-lv", "kerber-landnetz", "simbench-lv-rural1")
ERRORS: Final = ("none", "phases", "rotated", "phase", "meters", "bus", "length")
PHASES: Final = "abc"

LONGER: Final = 1.5
"""True length of the planted line, in lengths of the files."""

NEAR: Final = 0.15
"""Largest relative error of a repaired length."""


@dataclass(frozen=True, slots=True)
class Recorded(intervals.Recorded):
    """The same, and the searched kinds."""

    kinds: tuple[FileErrorKind, ...] = tuple(FileErrorKind)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one calibration.

    Attributes
    ----------
    right
        Corrected files equal the true ones.
    lengths, excluded, others
        Numbers of proposals: of lengths that are right in the files, of meters, of other wrong corrections.
    seconds
        Duration of the calibration, s.
    planted, proposed
        The error and the proposals.
    """

    right: bool
    lengths: int
    excluded: int
    others: int
    seconds: float
    planted: str
    proposed: str


def truth_of(name: str) -> FeederTables:
    """Tables of a feeder with single-phase customers."""
    tables = find(name)
    if tables.in_phases:
        return tables
    lines = [replace(row, r0_ohm=4.0 * row.r_ohm, x0_ohm=3.0 * row.x_ohm, b_us=0.0) for row in tables.lines]
    rows = [replace(row, phases=PHASES[k % 3]) for k, row in enumerate(tables.customers)]
    return replace(tables, lines=tuple(lines), customers=tuple(rows))


def recorded(truth: FeederTables, what: Recorded, seed: int, folder: Path) -> Recording:
    """Readings of the true feeder."""
    return record(from_tables(truth), what.scenario(seed), folder / "readings.parquet")


def planted(truth: FeederTables, error: str, seed: int) -> tuple[FeederTables, str]:
    """Files with one error, drawn by the seed, and its description."""
    rng = np.random.default_rng([seed, ERRORS.index(error)])
    rows = list(truth.customers)
    metered = [k for k, row in enumerate(rows) if row.meter]
    single = [k for k in metered if len(rows[k].phases) == 1]
    if error == "none":
        return truth, ""
    if error == "length":
        loaded = {row.bus for row in rows}
        at = [k for k, row in enumerate(truth.lines) if {row.from_bus, row.to_bus} & loaded and row.closed]
        k = int(rng.choice(at))
        lines = [longer(row, 1.0 / LONGER) if j == k else row for j, row in enumerate(truth.lines)]
        return replace(truth, lines=tuple(lines)), truth.lines[k].line
    if error == "phase":
        k = int(rng.choice(single))
        other = rng.choice([phase for phase in PHASES if phase != rows[k].phases])
        rows[k] = replace(rows[k], phases=str(other))
        return replace(truth, customers=tuple(rows)), f"{rows[k].customer} on {other}"
    if error == "bus":
        k = int(rng.choice(metered))
        bus = str(rng.choice(sorted({row.bus for row in rows} - {rows[k].bus})))
        rows[k] = replace(rows[k], bus=bus)
        return replace(truth, customers=tuple(rows)), f"{rows[k].customer} at {bus}"
    if error == "rotated":
        some = [int(rng.choice([k for k in single if rows[k].phases == phase])) for phase in PHASES]
        for k, phase in zip(some, "bca", strict=True):
            rows[k] = replace(rows[k], phases=phase)
        return replace(truth, customers=tuple(rows)), " and ".join(rows[k].customer for k in some)
    pairs = [
        (i, j)
        for i in (single if error == "phases" else metered)
        for j in (single if error == "phases" else metered)
        if i < j
        and (
            rows[i].phases != rows[j].phases
            if error == "phases"
            else (rows[i].bus, rows[i].phases) != (rows[j].bus, rows[j].phases)
        )
    ]
    i, j = pairs[int(rng.integers(len(pairs)))]
    one, other = rows[i], rows[j]
    if error == "phases":
        rows[i], rows[j] = replace(one, phases=other.phases), replace(other, phases=one.phases)
    else:
        rows[i], rows[j] = replace(one, meter=other.meter), replace(other, meter=one.meter)
    return replace(truth, customers=tuple(rows)), f"{one.customer} and {other.customer}"


def judged(truth: FeederTables, files: FeederTables, line: str, found: Calibrate) -> tuple[bool, int, int]:
    """Corrected files equal the true ones; wrong lengths, and other wrong corrections."""
    tables = files
    for wrong in found.corrections:
        tables = apply(tables, wrong)
    lengths = found.proposals[found.proposals["kind"] == "length"]
    others = sum(1 for one, other in zip(tables.customers, truth.customers, strict=True) if one != other)
    false_lengths = int((lengths["what"] != line).sum())
    if not line:
        same = tables == truth
    else:
        factors = {
            wrong.names[0]: wrong.factor for wrong in found.corrections if wrong.kind is FileErrorKind.LENGTH
        }
        same = set(factors) == {line} and abs(factors[line] / LONGER - 1.0) < NEAR and others == 0
    return same, false_lengths, others


def outcome(name: str, error: str, seed: int, what: Recorded, recording: Recording) -> Outcome:
    """Calibrate files with one planted error."""
    truth = truth_of(name)
    files, told = planted(truth, error, seed)
    begun = time.perf_counter()
    found = calibrate(three_phase(files), recording, kinds=what.kinds)
    seconds = time.perf_counter() - begun
    right, lengths, others = judged(truth, files, told if error == "length" else "", found)
    shown = "; ".join(
        f"{row['kind']} {row['what']}: {row['proposed']} ({row['confidence']:.2f}, {row['verdict']})"
        for row in found.proposals.to_dict("records")
    )
    excluded = int((found.proposals["kind"] == "meter").sum())
    return Outcome(right, lengths, excluded, others, seconds, told, shown)


def main(seeds: Sequence[int], feeders: Sequence[str], errors: Sequence[str], what: Recorded) -> None:
    """Count and print."""
    total: dict[tuple[str, str], list[Outcome]] = {}
    for name in feeders:
        for seed in seeds:
            with tempfile.TemporaryDirectory() as folder:
                recording = recorded(truth_of(name), what, seed, Path(folder))
                for error in errors:
                    each = outcome(name, error, seed, what, recording)
                    total.setdefault((name, error), []).append(each)
                    mark = "right" if each.right else "wrong"
                    print(
                        f"{name} seed {seed} {error} [{each.planted}]: {mark}, {each.seconds:.1f} s: "
                        f"{each.proposed}",
                        flush=True,
                    )
    print("\n| feeder | error | repaired | false lengths | excluded meters | wrong customers |")
    print("|---|---|---|---|---|---|")
    for (name, error), all_ in total.items():
        sums = [
            sum(getattr(each, field) for each in all_) for field in ("right", "lengths", "excluded", "others")
        ]
        print(f"| {name} | {error} | {sums[0]} of {len(all_)} | {sums[1]} | {sums[2]} | {sums[3]} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibrate_exchanges", description=__doc__)
    parser.add_argument("seeds", type=count, nargs="?", default=5)
    parser.add_argument("feeders", nargs="*", default=list(FEEDERS))
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--errors", nargs="+", choices=ERRORS, default=list(ERRORS))
    parser.add_argument("--days", type=positive, default=1.0)
    parser.add_argument("--step", type=positive, default=900.0, help="interval of the readings, s")
    parser.add_argument("--hidden-kw", type=float, default=0.1)
    parser.add_argument(
        "--look-for", nargs="+", choices=list(map(str, FileErrorKind)), default=list(map(str, FileErrorKind))
    )
    wanted = parser.parse_args()
    main(
        range(wanted.first, wanted.first + wanted.seeds),
        wanted.feeders,
        wanted.errors,
        Recorded(
            wanted.days, wanted.step, wanted.hidden_kw, tuple(FileErrorKind(each) for each in wanted.look_for)
        ),
    )
