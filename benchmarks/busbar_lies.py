"""A manipulated busbar meter: names of it, and of no honest meter.

    python -m benchmarks.busbar_lies [seeds]

AC truth, a reading every second, loads known within 0.6 kW and 0.2 kvar (600 s), meters with white noise of
0.2 % or with real errors that are not learned. After 20 s the busbar's meter reads too much or too little for
a minute (in three phases that of phase a), by itself or while as many meters as can be told apart lie by 3 %
with random signs. In other runs that many meters lie in one direction, and the busbar's meter is honest.

Counted over all seeds: runs in which the busbar's meter is named, and the median delay; meters that lie and
are named; honest meters ever named, runs in which an honest busbar's is; and the 95th percentile of the error
of all voltages from 20 s after the onset on, % of nominal, of the worst run. For comparison the same error if
the busbar's meter does not lie.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import load
from feeders.registry import design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.trial import Trial, TrialMeterErrors, frames
from gridsec.interface import Frame

FEEDERS = ("simbench-lv-rural1", "kerber-dorfnetz", "kerber-vorstadtnetz", "ieee-european-lv")
ONSET, TICKS, SETTLED = 20, 80, 40
SIZES = (0.0, 0.5, -0.5, 1.0, -1.0, 3.0, -3.0)


@dataclass(frozen=True, slots=True)
class Run:
    """What came of one run."""

    named: float
    liars: int
    found: int
    honest: int
    error: float


def run(feeder: str, meters: TrialMeterErrors, percent: float, lie: AttackSpec | None, seed: int) -> Run:
    """Watch one run.

    Parameters
    ----------
    feeder, meters, seed
        Where, with which errors, and what is random.
    percent
        What the busbar's meter reads too much, % of its voltage.
    lie
        What the meters do meanwhile.
    """
    site = load(feeder)
    if lie is not None:
        lie = replace(lie, count=site.meters.size // 3, onset_s=float(ONSET))
    trial = Trial(site, seed, duration_s=float(TICKS), lie=lie, meters=meters)
    watcher, state = design(trial.stated), None
    at, late, errors = site.meters, np.inf, []
    ever, liars = np.zeros(at.size, dtype=np.bool_), np.zeros(at.size, dtype=np.bool_)
    honest = np.zeros(at.size, dtype=np.bool_)
    for tick, (said, truth) in enumerate(frames(trial)):
        frame = said if tick < ONSET else _lying(said, (1.0 + percent / 100.0) ** 2)
        state = watcher.init(frame.t - 1.0) if state is None else state
        state, estimate, verdict = watcher.step(state, frame)
        liars |= truth.liars
        ever |= verdict.suspects
        honest |= verdict.suspects & ~truth.liars
        if verdict.busbar.any() and np.isinf(late):
            late = tick - ONSET
        if tick >= SETTLED:
            errors.append(100.0 * np.abs(np.sqrt(estimate.v2) - np.sqrt(truth.v2)))
    counts = (int(which.sum()) for which in (liars, ever & liars, honest))
    return Run(late, *counts, float(np.percentile(errors, 95)))


def _lying(frame: Frame, factor: float) -> Frame:
    v0_phases = None if frame.v0_phases is None else frame.v0_phases * [factor, 1.0, 1.0]
    return replace(frame, v0_squared=frame.v0_squared * factor, v0_phases=v0_phases)


def row(case: tuple[str, TrialMeterErrors, float], what: str, lie: AttackSpec | None, seeds: int) -> str:
    """One line of the table."""
    feeder, meters, percent = case
    runs = [run(feeder, meters, percent, lie, seed) for seed in range(seeds)]
    named = [one.named for one in runs if np.isfinite(one.named)]
    found, liars, honest = (sum(getattr(one, name) for one in runs) for name in ("found", "liars", "honest"))
    error = max(one.error for one in runs)
    delay = f"{np.median(named):g}" if named else ""
    cells = [feeder, meters, f"{percent:+g}", what, f"{len(named)} of {seeds}", delay]
    cells += [f"{found} of {liars}" if liars else "", honest, f"{error:.3f}"]
    return f"| {' | '.join(map(str, cells))} |"


def main(seeds: int) -> None:
    """Print the table."""
    print("| feeder | meters | busbar, % | liars | named | after, s | liars named | honest | error, % |")
    print("|---|---|---|---|---|---|---|---|---|")
    for feeder in FEEDERS:
        for meters in (TrialMeterErrors.WHITE, TrialMeterErrors.REAL):
            for percent in SIZES:
                print(row((feeder, meters, percent), "honest", None, seeds), flush=True)
            for percent in (1.0, -3.0):
                print(
                    row((feeder, meters, percent), "a third, +-3 %", AttackSpec(AttackKind.BIAS), seeds),
                    flush=True,
                )
            for size in (3.0, -1.5):
                lie = AttackSpec(AttackKind.TOGETHER, size=size)
                print(row((feeder, meters, 0.0), f"a third, {size:+g} % all", lie, seeds), flush=True)


if __name__ == "__main__":
    main(arguments(__doc__, seeds=5).seeds)
