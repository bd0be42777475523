"""The default estimator where readings are few: half of the meters silent, and every interval.

    python -m benchmarks.sparse_readings [seeds] [feeder]

Kerber Vorstadtnetz with 146 customers unless another feeder is asked for, loads of customers that are read
known within 0.6 kW and 0.2 kvar (600 s), meters with white noise of 0.2 %. A third of the meters that
report at all lies by 3 % with random signs. Intervals of 1 s, 60 s and 900 s from a sunny noon on; all
meters, half of them (chosen at random, silent from the start), or every meter at random moments of its own,
on average at every second tick. A customer that is not read tells no powers either: they are what
`feeders.model.site.to_frame` makes of a reading that is not there, the range of what the customer can draw
and feed in, or the forecast from the library's profiles. Customers follow the very profiles whose means
over the season are their forecasts, as the files have them.

Counted are those named within the limit, of the manipulated meters, in readings of the meter's own; those
never named; honest meters ever named; the median delay; the 95th percentile of the error of the
reconstructed voltage at lying meters and at those that are not read at that tick, in % of nominal, of the
worst seed; the 95th percentile of the latter in the standard deviations given with it; and the median
processor time of a step in the last ten ticks before the manipulation.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import Site, from_tables, load
from feeders.registry import design
from feeders.simulation.plant import Channel, MeterOutage
from feeders.simulation.scenario import START
from feeders.simulation.trial import FrameTruth, Trial, frames
from gridsec.arrays import Bools
from gridsec.interface import Frame

FEEDER = "kerber-vorstadtnetz"
INTERVALS_S = (1.0, 60.0, 900.0)
PATTERNS = (
    ("all", "none"),
    *((pattern, forecast) for pattern in ("half silent", "own moments") for forecast in ("none", "profiles")),
)
BEFORE, AFTER, LIMIT, SIZE = 40, 60, 8, 0.03


def watched(feeder: str, forecast: str) -> Site:
    """The feeder, with forecasts of unread powers or without."""
    tables = load(feeder).tables
    meta = replace(tables.meta, load=replace(tables.meta.load, forecast=forecast))
    return from_tables(replace(tables, meta=meta))


def heard(pattern: str, meters: int, rng: np.random.Generator) -> Bools:
    """Which meters are heard at each tick, (T, p)."""
    ticks = BEFORE + AFTER
    if pattern == "all":
        return np.ones((ticks, meters), dtype=np.bool_)
    if pattern == "half silent":
        return np.tile(rng.permutation(meters) < meters // 2, (ticks, 1))
    return rng.random((ticks, meters)) < 0.5


def channel(site: Site, there: Bools, step_s: float) -> Channel:
    """One that loses whatever is not heard, voltages and powers."""
    lost = np.argwhere(~there).tolist()
    begins = [(START + (tick - 0.5) * step_s, site.meter_ids[j]) for tick, j in lost]
    return Channel(silences=tuple(MeterOutage(meter, t, t + step_s) for t, meter in begins))


def played(trial: Trial, pattern: str) -> Iterator[tuple[Frame, FrameTruth, Bools]]:
    """Frames of what is heard, the truth, and the manipulated meters."""
    rng = np.random.default_rng([3, trial.seed])
    count = trial.site.meters.size
    there = heard(pattern, count, rng)
    ever = np.flatnonzero(there.any(axis=0))
    liars = np.zeros(count, dtype=np.bool_)
    liars[rng.choice(ever, ever.size // 3, replace=False)] = True
    factor = np.where(liars, (1.0 + SIZE * rng.choice([-1.0, 1.0], count)) ** 2, 1.0)
    scenario = replace(trial.scenario, channel=channel(trial.site, there, trial.step_s))
    for tick, (frame, truth) in enumerate(frames(trial, scenario)):
        yield replace(frame, y=frame.y * (factor if tick >= BEFORE else 1.0)), truth, liars


@dataclass(frozen=True, slots=True)
class Run:
    """What came of one run: counts of meters, median delay, 95th percentiles of errors, and ms per step."""

    named: int
    missed: int
    liars: int
    honest: int
    delay: float
    at_liars: float
    at_silent: float
    relative: float
    quiet_ms: float


def run(site: Site, pattern: str, step_s: float, seed: int) -> Run:
    """Watch one run."""
    trial = Trial(site, seed, duration_s=(BEFORE + AFTER) * step_s, step_s=step_s)
    watcher, at = design(trial.stated), trial.site.meters
    state, named_at, honest = None, np.full(at.size, np.inf), np.zeros(at.size, np.bool_)
    count, errors, blind, relative, took = np.zeros(at.size), [], [], [], []
    for tick, (frame, truth, liars) in enumerate(played(trial, pattern)):
        state = watcher.init(frame.t - step_s) if state is None else state
        begun = time.thread_time()
        state, estimate, verdict = watcher.step(state, frame)
        took.append(1e3 * (time.thread_time() - begun))
        lies = tick >= BEFORE
        count += frame.seen & lies
        fresh = verdict.suspects & liars & lies & np.isinf(named_at)
        named_at[fresh] = count[fresh]
        honest |= verdict.suspects & ~(liars & lies)
        if tick >= BEFORE + 2 * LIMIT:
            error = 100.0 * np.abs(np.sqrt(estimate.v2) - np.sqrt(truth.v2))[at]
            errors.append(error[liars])
            blind.append(error[~frame.seen])
            relative.append((np.abs(estimate.v2 - truth.v2) / estimate.std)[at][~frame.seen])
    late = named_at[liars]
    at_liars, at_silent, sized = (
        float(np.percentile(values, 95)) if values.size else np.nan
        for values in map(np.concatenate, (errors, blind, relative))
    )
    return Run(
        named=int((late <= LIMIT).sum()),
        missed=int(np.isinf(late).sum()),
        liars=int(liars.sum()),
        honest=int(honest.sum()),
        delay=float(np.median(late)),
        at_liars=at_liars,
        at_silent=at_silent,
        relative=sized,
        quiet_ms=float(np.median(took[BEFORE - 10 : BEFORE])),
    )


def line(step_s: float, pattern: str, forecast: str, runs: list[Run]) -> str:
    """One row of the table."""
    named, missed, liars, honest = (
        sum(getattr(one, name) for one in runs) for name in ("named", "missed", "liars", "honest")
    )
    delay = np.median([one.delay for one in runs])
    at_liars = max(one.at_liars for one in runs)
    silent = [max(getattr(one, name) for one in runs) for name in ("at_silent", "relative")]
    told, *blind = ("", "", "") if pattern == "all" else (forecast, f"{silent[0]:.3f}", f"{silent[1]:.2f}")
    found = (f"{named} of {liars}", missed, honest, f"{delay:g}")
    took = f"{np.median([one.quiet_ms for one in runs]):.1f}"
    cells = [pattern, told, *found, f"{at_liars:.3f}", *blind, took]
    return f"| {step_s:g} | {' | '.join(map(str, cells))} |"


def main(seeds: int, feeder: str = FEEDER) -> None:
    """Count and print."""
    head = (
        f"forecast | named within {LIMIT} readings | never | honest named | median delay "
        "| error at liars, % | where not read, % | in standard deviations | quiet step, ms"
    )
    print(f"| interval, s | readings | {head} |\n|---|---|---|---|---|---|---|---|---|---|---|")
    for step_s in INTERVALS_S:
        for pattern, forecast in PATTERNS:
            site = watched(feeder, forecast)
            runs = [run(site, pattern, step_s, seed) for seed in range(seeds)]
            print(line(step_s, pattern, forecast, runs), flush=True)


if __name__ == "__main__":
    asked = arguments(__doc__, seeds=5, feeder=FEEDER)
    main(asked.seeds, asked.feeder)
