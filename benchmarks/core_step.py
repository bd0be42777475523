"""Time of a step of the estimator `modal`.

    python -m benchmarks.core_step [RUNS] [OTHER_TREE] [--feeder NAME ...]

AC power flow, errors of 0.6 kW and 0.2 kvar known as such, meters as the files state, one frame per second,
no learned errors. Calm: median and mean of `CALM` steps after `BEFORE` steps with the same pattern of missing
readings. `silent`: 30 % never report. `in turn`: another 30 % are silent in every minute. `10 %` and `30 %`:
missing at random, independently at every step. Attack: a random third of the meters is off by 3 % from one
step on; the longest step of the `ATTACK` steps after the onset, and their mean. All readings are there.

All times are processor times of the one thread, ms, in a process for each run; of several runs the least
counts. With another source tree its estimator takes the same frames, run by run in turn. The ratios are those
of this tree to the other one, of the first times and of the means. The last column is the ratio of the first
time to that of the calm steps with all readings.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import pickle
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks._arguments import count
from benchmarks._residuals import present
from benchmarks._scenes import Model, Setting, play, site
from benchmarks._table import head, row
from gridsec.arrays import Bools, Floats
from gridsec.interface import Frame

BEFORE, CALM, ATTACK = 70, 120, 20
"""Steps before the measurement, calm steps, and steps after an onset."""
LIE = 0.03
"""Manipulation of the readings, parts of the voltage."""
OWN = Path(__file__).resolve().parents[1]
"""This source tree."""


def missing(pattern: str, meters: int, ticks: int) -> Bools:
    """Meters with a reading at each step, (ticks, p)."""
    random = np.random.default_rng(5)
    if pattern == "30 %":
        return random.random((ticks, meters)) >= 0.3
    if pattern == "silent":
        seen = np.ones((ticks, meters), dtype=np.bool_)
        seen[:, random.permutation(meters)[: round(0.3 * meters)]] = False
        return seen
    return present(pattern, meters, ticks, random)


def cases(feeder: str) -> dict[str, list[Frame]]:
    """Frames of all cases of a feeder, the calm one with all readings first."""
    setting, p = Setting(feeder, Model.LOADS, False, 0), site(feeder).meters.size
    frames = [frame for frame, _ in play(setting, float(BEFORE + CALM))]
    out = {}
    for pattern in ("complete", "silent", "in turn", "10 %", "30 %"):
        seen = missing(pattern, p, len(frames))
        out[pattern] = [
            replace(frame, seen=frame.seen & there) for frame, there in zip(frames, seen, strict=True)
        ]
    lying = np.random.default_rng(6).permutation(p)[: p // 3]
    factor = np.where(np.isin(np.arange(p), lying), (1.0 + LIE) ** 2, 1.0)
    wrong = [replace(frame, y=frame.y * factor) for frame in frames[BEFORE : BEFORE + ATTACK]]
    out["attack, longest"] = [*frames[:BEFORE], *wrong]
    return out


def steps(feeder: str, every: Sequence[list[Frame]], tree: Path) -> list[Floats]:
    """Time of each step over each list of frames with the estimator of a source tree, ms."""
    done = subprocess.run(
        [sys.executable, str(OWN / "benchmarks" / "_core_steps.py")],
        input=pickle.dumps((feeder, list(every))),
        env=os.environ | {"PYTHONPATH": str(tree)},
        stdout=subprocess.PIPE,
        check=True,
    )
    return [np.array(each) for each in json.loads(done.stdout)]


def summary(name: str, runs: list[Floats]) -> Floats:
    """Median, or longest step of an attack, and mean of the steps from `BEFORE` on; least of the runs."""
    each = [one[BEFORE:] for one in runs]
    first = [float(one.max() if name.startswith("attack") else np.median(one)) for one in each]
    return np.array([min(first), min(float(one.mean()) for one in each)])


def main(runs: int, other: Path | None, names: Sequence[str]) -> None:
    """One table."""
    more = () if other is None else (other.name, "mean", "ratio", "of means")
    head("feeder, meters", "steps", "`modal`", "mean", *more, "to calm")
    trees = (OWN,) if other is None else (OWN, other)
    for feeder in names:
        played = cases(feeder)
        # Trees by turns: the load of the machine changes with time.
        every = [[steps(feeder, list(played.values()), tree) for tree in trees] for _ in range(runs)]
        calm = 0.0
        for k, name in enumerate(played):
            now, *others = (summary(name, [one[t][k] for one in every]) for t in range(len(trees)))
            calm = calm or now[0]
            cells = [*now, *(cell for old in others for cell in (*old, *(now / old)))]
            texts = [f"{each:.2f}" for each in (*cells, now[0] / calm)]
            row(f"{feeder}, {site(feeder).meters.size}", name, *texts)


def _tree(text: str) -> Path:
    """Folder of a source tree."""
    if not (Path(text) / "gridsec").is_dir():
        raise argparse.ArgumentTypeError(f"{text}: expected the folder of a source tree")
    return Path(text).resolve()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("runs", nargs="?", type=count, default=3)
    parser.add_argument("other", nargs="?", type=_tree, metavar="OTHER_TREE")
    parser.add_argument("--feeder", action="append", help="a feeder of the project; may be repeated")
    asked = parser.parse_args()
    main(asked.runs, asked.other, asked.feeder or ("kerber-vorstadtnetz",))
