"""Time of a step of `modal` and `sequential` against the number of customers, up to 2 000.

    python -m benchmarks.core_growth [--runs 2] [picture.png]

The streets of `benchmarks.sequential_step`, one frame per second, all meters honest at first. Calm: median of
`CALM` steps after `BEFORE` steps, a fourth of both beyond `SEARCHED` customers. Silent: the same while a
tenth of the meters never reports, from the first step on. Attack: a third of the meters is off by 3 % from
one step on, the longest of `ATTACK` steps; `modal` up to `SEARCHED` customers. Memory: peak of the process.
Processor times of the one thread, ms; of several runs the least counts. Each size and estimator has a
process of its own.
"""

from __future__ import annotations

import argparse
import gc
import os
import subprocess
import sys
from dataclasses import astuple, dataclass

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import count
from benchmarks.limits import head, row
from benchmarks.sequential_step import SIZES, Watched, peak_mb
from feeders.registry import MODAL, SEQUENTIAL
from gridsec.estimators import sequential
from gridsec.estimators.modal import monitor

BEFORE, CALM, ATTACK = 40, 60, 6
"""Steps before the measurement, calm steps, and steps after an onset."""
SEARCHED = 600
"""Largest number of customers with an attack watched by `modal`: a search takes the cube of the number."""
FAMILIES = {SEQUENTIAL: sequential, MODAL: monitor}


@dataclass(frozen=True, slots=True)
class Measured:
    """Times of one size, ms, and memory, MB; NaN for an attack that is not played."""

    calm: float
    silent: float
    attack: float
    memory: float


def measure(customers: int, estimator: str) -> Measured:
    """Times of one size, in this process."""
    part = 1 if customers <= SEARCHED else 4
    before, calm, attack = BEFORE // part, CALM // part, np.nan
    street, seen = Watched(customers, FAMILIES[estimator]), np.arange(customers) % 10 != 0
    start = street.state
    gc.freeze()  # as the service does
    street.play(0, before, seen=seen)
    silent = float(np.median(street.play(before, calm, seen=seen)))
    street.state = start
    street.play(0, before)
    complete = float(np.median(street.play(before, calm)))
    if estimator == SEQUENTIAL or customers <= SEARCHED:
        attack = float(street.play(before + calm, ATTACK, street.lies()).max())
    return Measured(complete, silent, attack, peak_mb())


def measured(customers: int, estimator: str, runs: int) -> Measured:
    """Least times of some runs, each in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.core_growth", "--one", str(customers), estimator]
    each = []
    for _ in range(runs):
        done = subprocess.run(command, capture_output=True, check=True, text=True)
        each.append([float(cell) for cell in done.stdout.split()])
    return Measured(*np.min(each, axis=0).tolist())


def main(picture: str | None, runs: int) -> None:
    """One table, and the exponents of growth from 146 customers on."""
    names = ("calm", "silent", "attack", "MB")
    head("customers", *(f"{name}, {short}" for short in FAMILIES for name in names))
    found: dict[str, list[Measured]] = {name: [] for name in FAMILIES}
    for size in SIZES:
        for name, each in found.items():
            each.append(measured(size, name, runs))
        now = [astuple(each[-1]) for each in found.values()]
        row(size, *("-" if np.isnan(cell) else f"{cell:.2f}" for one in now for cell in one))
    sizes = np.array(SIZES, dtype=np.float64)
    for name, each in found.items():
        for of in ("calm", "silent"):
            times = np.array([getattr(one, of) for one in each])
            power = float(np.polyfit(np.log(sizes[sizes >= 146]), np.log(times[sizes >= 146]), 1)[0])
            print(f"{name}, {of}: N^{power:.2f} from 146 customers on")
    if picture is not None:
        _draw(picture, found)


def _draw(picture: str, found: dict[str, list[Measured]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for name, line in zip(found, ("--", "-"), strict=True):
        for of, label, marker in (
            ("calm", "calm", "o"),
            ("silent", "a tenth silent", "s"),
            ("attack", "a third lies, longest step", "^"),
        ):
            times = [getattr(one, of) for one in found[name]]
            axes.loglog(SIZES, times, line, marker=marker, label=f"{name}: {label}")
    axes.set_xlabel("customers")
    axes.set_ylabel("ms per step")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(picture, dpi=110)


def _asked() -> argparse.Namespace:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("picture", nargs="?", help="draw the times into this file")
    parser.add_argument("--runs", type=count, default=1, help="of each size; the least of each time counts")
    parser.add_argument("--one", nargs=2, metavar=("N", "NAME"), help="measure one size, print numbers")
    return parser.parse_args()


if __name__ == "__main__":
    asked = _asked()
    if asked.one is not None:
        print(*astuple(measure(int(asked.one[0]), asked.one[1])))
    else:
        main(asked.picture, asked.runs)
