"""Time of a step of the estimators `modal` and `sequential` on the same frames, in one run.

    python -m benchmarks.core_step [runs] [feeder ...]

AC power flow, errors of 0.6 kW and 0.2 kvar known as such, meters as the files state, one frame per second,
no learned errors. Calm: median and mean of `CALM` steps after `BEFORE` steps with the same pattern of missing
readings. `silent`: 30 % never report. `in turn`: another 30 % are silent in every minute. `10 %` and `30 %`:
missing at random, independently at every step. Attack: a random third of the meters is off by 3 % from one
step on; the longest step of the `ATTACK` steps after the onset, and their mean. All readings are there.

All times are processor times of the one thread, ms. Of several runs the least counts. The ratio is that of
`modal` to `sequential` on the same frames; the last column is that of `modal` to the median calm step of
`sequential` with all readings.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import gc
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks._arguments import arguments
from benchmarks._residuals import present
from benchmarks._scenes import Model, Setting, begin, play, site
from benchmarks.limits import head, row
from feeders.registry import MODAL, SEQUENTIAL
from gridsec.arrays import Bools, Floats
from gridsec.interface import Frame

BEFORE, CALM, ATTACK = 70, 120, 20
"""Steps before the measurement, calm steps, and steps after an onset."""
LIE = 0.03
"""Manipulation of the readings, parts of the voltage."""
NAMES = (SEQUENTIAL, MODAL)


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


def steps(setting: Setting, frames: Sequence[Frame], estimator: str) -> Floats:
    """Time of each step of an estimator, ms."""
    made, state = begin(setting, estimator)
    took = np.empty(len(frames))
    gc.freeze()
    for k, frame in enumerate(frames):
        begun = time.thread_time()
        state, *_ = made.step(state, frame)
        took[k] = 1e3 * (time.thread_time() - begun)
    return took


def cells(setting: Setting, frames: Sequence[Frame], runs: int, first: int, name: str) -> list[Floats]:
    """Summary of the steps from `first` on by each estimator: median or maximum, and mean, (2,) each."""
    out = []
    for estimator in NAMES:
        each = [steps(setting, frames, estimator)[first:] for _ in range(runs)]
        middle = [float(np.median(one) if name == "calm" else one.max()) for one in each]
        out.append(np.array([min(middle), min(float(one.mean()) for one in each)]))
    return out


def main(runs: int, names: tuple[str, ...]) -> None:
    """One table."""
    head("feeder, meters", "steps", "sequential", "mean", "modal", "mean", "ratio", "of means", "to calm")
    for feeder in names:
        setting, p = Setting(feeder, Model.LOADS, False, 0), site(feeder).meters.size
        frames = [frame for frame, _ in play(setting, float(BEFORE + CALM))]
        calm = 0.0
        for pattern in ("complete", "silent", "in turn", "10 %", "30 %"):
            seen = missing(pattern, p, len(frames))
            some = [
                replace(frame, seen=frame.seen & there) for frame, there in zip(frames, seen, strict=True)
            ]
            now, new = cells(setting, some, runs, BEFORE, "calm")
            calm = calm or now[0]
            _print(f"{feeder}, {p}", pattern, now, new, calm)
        lying = np.random.default_rng(6).permutation(p)[: p // 3]
        factor = np.where(np.isin(np.arange(p), lying), (1.0 + LIE) ** 2, 1.0)
        wrong = [replace(frame, y=frame.y * factor) for frame in frames[BEFORE : BEFORE + ATTACK]]
        now, new = cells(setting, [*frames[:BEFORE], *wrong], runs, BEFORE, "attack")
        _print(f"{feeder}, {p}", "attack, longest", now, new, calm)


def _print(feeder: str, name: str, now: Floats, new: Floats, calm: float) -> None:
    texts = [f"{each:.2f}" for each in (*now, *new)]
    row(feeder, name, *texts, *(f"{each:.2f}" for each in new / now), f"{new[0] / calm:.2f}")


if __name__ == "__main__":
    asked = arguments(__doc__, runs=3, feeders=("kerber-vorstadtnetz",))
    main(asked.runs, tuple(asked.feeders))
