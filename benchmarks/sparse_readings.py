"""The sequential monitor where readings are few: half of the meters silent, and every interval.

    python -m benchmarks.sparse_readings [seeds]

Kerber Vorstadtnetz with 146 customers, loads known within 0.6 kW and 0.2 kvar (600 s), meters with white
noise of 0.2 %. A third of the meters that report at all lies by 3 % with random signs. Intervals of 1 s,
60 s and 900 s; all meters, half of them (chosen at random, silent from the start), or every meter at random
moments of its own, on average at every second tick. Counted are those named within the limit, of those who
lie; honest meters ever named; the median delay in readings of the meter's own; and the 95th percentile of the
error of the reconstructed voltage at lying and at silent meters, in % of nominal, of the worst seed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from feeders.estimators import design
from feeders.load import load
from feeders.trials import Trial, Truth, frames
from gridsec.arrays import Bools
from gridsec.online import Frame

FEEDER = "kerber-vorstadtnetz"
INTERVALS_S = (1.0, 60.0, 900.0)
PATTERNS = ("all", "half silent", "own moments")
BEFORE, AFTER, LIMIT, SIZE = 40, 60, 8, 0.03


def heard(pattern: str, meters: int, rng: np.random.Generator) -> Iterator[Bools]:
    """Which meters are heard at each tick, (p,) each."""
    fixed = rng.permutation(meters) < meters // 2
    while True:
        if pattern == "all":
            yield np.ones(meters, dtype=np.bool_)
        elif pattern == "half silent":
            yield fixed
        else:
            yield rng.random(meters) < 0.5


def played(trial: Trial, pattern: str) -> Iterator[tuple[Frame, Truth, Bools]]:
    """Frames with what is heard of them, the truth, and who lies."""
    rng = np.random.default_rng([3, trial.seed])
    count = trial.site.meters.size
    times = heard(pattern, count, rng)
    ever = next(times) if pattern == "half silent" else np.ones(count, dtype=np.bool_)
    liars = np.zeros(count, dtype=np.bool_)
    liars[rng.choice(np.flatnonzero(ever), int(ever.sum()) // 3, replace=False)] = True
    factor = np.where(liars, (1.0 + SIZE * rng.choice([-1.0, 1.0], count)) ** 2, 1.0)
    for tick, ((frame, truth), now) in enumerate(zip(frames(trial), times, strict=False)):
        lies = tick >= BEFORE
        y = np.where(now, frame.y * (factor if lies else 1.0), np.nan)
        yield replace(frame, y=y, seen=frame.seen & now), truth, liars


def run(pattern: str, step_s: float, seed: int) -> tuple[int, int, int, float, float, float]:
    """Named within the limit, liars, honest meters named, median delay, errors at liars and at the silent."""
    trial = Trial(load(FEEDER), seed, duration_s=(BEFORE + AFTER) * step_s, step_s=step_s)
    watcher, site = design(trial.stated), trial.site
    state, named_at, honest = None, np.full(site.meters.size, np.inf), np.zeros(site.meters.size, np.bool_)
    count, errors, blind = np.zeros(site.meters.size), [], []
    for tick, (frame, truth, liars) in enumerate(played(trial, pattern)):
        state = watcher.init(frame.t - step_s) if state is None else state
        state, estimate, verdict = watcher.step(state, frame)
        lies = tick >= BEFORE
        count += frame.seen & lies
        fresh = verdict.suspects & liars & lies & np.isinf(named_at)
        named_at[fresh] = count[fresh]
        honest |= verdict.suspects & ~(liars & lies)
        if tick >= BEFORE + 2 * LIMIT:
            error = 100.0 * np.abs(np.sqrt(estimate.v2) - np.sqrt(truth.v2))[site.meters]
            errors.append(error[liars])
            blind.append(error[~frame.seen])
    late = named_at[liars]
    silent = np.concatenate(blind)
    return (
        int((late <= LIMIT).sum()),
        int(liars.sum()),
        int(honest.sum()),
        float(np.median(late)),
        float(np.percentile(np.concatenate(errors), 95)),
        float(np.percentile(silent, 95)) if silent.size else np.nan,
    )


def main(seeds: int) -> None:
    """Count and print."""
    head = (
        f"named within {LIMIT} readings | honest named | median delay | error at liars, % | at silent ones, %"
    )
    print(f"| interval, s | readings | {head} |\n|---|---|---|---|---|---|---|")
    for step_s in INTERVALS_S:
        for pattern in PATTERNS:
            all_ = np.array([run(pattern, step_s, seed) for seed in range(seeds)])
            named, liars, honest = all_[:, :3].sum(axis=0).astype(int)
            delay, error, silent = np.median(all_[:, 3]), all_[:, 4].max(), all_[:, 5].max()
            print(
                f"| {step_s:g} | {pattern} | {named} of {liars} | {honest} | {delay:g} | {error:.3f} "
                f"| {'' if np.isnan(silent) else f'{silent:.3f}'} |",
                flush=True,
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
