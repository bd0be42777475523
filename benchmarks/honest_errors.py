"""Errors of the honest voltages, with lines that are longer than in the files.

    python -m benchmarks.honest_errors [runs] [feeder ...]

AC power flow on a feeder with lines `LONGER` times as long as in the files, designs for those of the files.
No manipulation, one frame in `STEP_S`, errors of powers and meters as the files say, no learned errors.

Columns: root mean square error of all customers' voltages after `SETTLING` frames, mV; root mean square of
the errors over their stated standard deviations; those frames that are not CLEAN, and honest meters that are
named.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks._arguments import arguments
from benchmarks._table import head, row
from benchmarks.limits import unlearned
from feeders.model.site import Site, from_tables, load
from feeders.model.site import names as library
from feeders.registry import DesignedEstimator
from feeders.simulation.trial import Trial, TrialMeterErrors, frames
from feeders.studies.calibrate.search import longer
from gridsec.arrays import Floats
from gridsec.interface import Decision

LONGER = (1.0, 1.1, 1.2)
"""Lengths of the lines over those of the files."""
STEP_S, FRAMES, SETTLING = 5.0, 240, 60
"""Interval of the frames, s; their number; those before the first error that counts."""


@dataclass(slots=True)
class Errors:
    """Squared errors, their ratios to the stated variances, and wrong answers."""

    squares: list[Floats] = field(default_factory=list)
    ratios: list[Floats] = field(default_factory=list)
    not_clean: int = 0
    named: int = 0

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean squares of the errors, V, and over the standard deviations."""
        return float(np.sqrt(np.mean(self.squares))), float(np.sqrt(np.mean(self.ratios)))


def errors(where: Site, factor: float, seed: int, made: DesignedEstimator, out: Errors) -> None:
    """Add the errors of one run."""
    lines = tuple(longer(line, factor) for line in where.tables.lines)
    truth = from_tables(replace(where.tables, lines=lines))
    played = list(frames(replace(trial(truth), seed=seed)))
    volt = where.customer_volt
    state = made.init(played[0][0].t)
    for k, (frame, exact) in enumerate(played):
        state, estimate, verdict = made.step(state, frame)
        if k < SETTLING:
            continue
        apart = estimate.v2 - exact.v2
        out.squares.append((volt * 0.5 * apart / np.sqrt(exact.v2)) ** 2)
        out.ratios.append((apart / estimate.std) ** 2)
        out.not_clean += verdict.decision is not Decision.CLEAN
        out.named += int(verdict.suspects.sum())


def trial(where: Site) -> Trial:
    """Honest trial with the errors of a feeder's files."""
    return Trial(
        where, duration_s=STEP_S * FRAMES, step_s=STEP_S, load_error=None, meters=TrialMeterErrors.SITE
    )


def main(runs: int, names: tuple[str, ...]) -> None:
    """One table."""
    head("feeder", "lines", "error, mV", "over std", "not CLEAN", "named")
    for name in names:
        where = load(name)
        made = unlearned(trial(where).stated)
        for factor in LONGER:
            found = Errors()
            for seed in range(runs):
                errors(where, factor, seed, made, found)
            volt, ratio = found.rms
            row(name, f"{factor:g}", f"{1e3 * volt:.0f}", f"{ratio:.2f}", found.not_clean, found.named)


if __name__ == "__main__":
    asked = arguments(__doc__, runs=2, feeders=tuple(library(balanced=False)))
    main(asked.runs, tuple(asked.feeders))
