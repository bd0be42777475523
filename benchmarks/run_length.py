"""Average run length of the detector of `modal` to a false alarm, against gamma over several decades.

    python -m benchmarks.run_length [runs] [largest gamma] [picture.png]

Honest residuals are drawn from the model of `gridsec.estimators.modal` on a random tree of 12 customers: one
accuracy class, two classes, and readings that are missing. Each run lasts until log M has passed the largest
gamma, or `CUT` times as many ticks; a run that is cut counts with the ticks that it lasted. The passages of
all gammas are taken from the same run, with M evaluated as for the least gamma, which is more often than for
the others. Cells: mean run length over gamma, and its standard error; the picture shows the means against
gamma. Exits 1 where the mean plus 2.33 standard errors, 99 %, is below gamma.
"""

from __future__ import annotations

import os

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from math import log

import numpy as np

from benchmarks._arguments import arguments
from benchmarks._residuals import Source, model_of, power_columns, present, tree
from benchmarks._table import head, row
from gridsec.arrays import Floats
from gridsec.estimators.modal import detector, full, signatures, static
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.core import CALM
from gridsec.estimators.modal.model import ResidualModel, modes

CUSTOMERS, CUT = 12, 8
"""Customers of the tree, and largest length of a run in units of the largest gamma."""
FEEDER = tree(CUSTOMERS, np.random.default_rng(CUSTOMERS))


def models() -> dict[str, tuple[ResidualModel, str]]:
    """Models and patterns of missing readings by name."""
    one, random = model_of(FEEDER), np.random.default_rng(1)
    classes = np.where(random.random(CUSTOMERS) < 0.5, 0.002, 0.01)
    two = model_of(FEEDER, classes=classes, jitter=np.where(classes < 0.005, 3e-4, 8e-4))
    return {
        "one class": (one, "complete"),
        "two classes": (two, "complete"),
        "one class, 30 % in turn": (one, "in turn"),
        "one class, 50 % at random": (one, "50 %"),
    }


def passages(model: ResidualModel, pattern: str, gammas: Floats, seed: int) -> Floats:
    """Ticks to the first M of at least each gamma, (k,)."""
    made, random = modes(model), np.random.default_rng(seed)
    of = signatures.columns(made, power_columns(FEEDER), np.full(2 * CUSTOMERS, 0.05), detector.SIZE)
    source, longest, k = Source(model, random), int(CUT * gammas[-1]), 0
    state, more, test = modal.start(made, 0.0), static.start(made), detector.start(made)
    out, limits, alert = np.full(gammas.size, float(longest)), np.log(gammas), CALM * log(gammas[0])
    block = 600
    while k < longest:
        seen = present(pattern, CUSTOMERS, block, random)
        for there in seen:
            whole = None if there.all() else there
            state, more, update = full.step(made, state, more, float(k), source.tick(), whole)
            test, evidence = detector.step(made, of, test, update, more, h=1.0, alert=alert)
            k += 1
            out = np.where((evidence.log_m >= limits) & (out > k), float(k), out)
        if out[-1] < longest:
            break
    return out


def main(runs: int, largest: float, picture: str) -> int:
    """One table; 1 if a mean run length is below gamma."""
    gammas = 10.0 ** np.arange(1.0, log(largest, 10.0) + 0.25, 0.5)
    head("readings", *(f"{gamma:.0f}" for gamma in gammas))
    found: dict[str, tuple[Floats, Floats]] = {}
    for name, (model, pattern) in models().items():
        lengths = np.stack([passages(model, pattern, gammas, seed) for seed in range(runs)]) / gammas
        mean, error = lengths.mean(axis=0), lengths.std(axis=0, ddof=1) / np.sqrt(runs)
        found[name] = mean, error
        row(name, *(f"{a:.1f} ± {b:.1f}" for a, b in zip(mean, error, strict=True)))
    if picture:
        _draw(picture, gammas, found)
    return int(any((mean + 2.33 * error < 1.0).any() for mean, error in found.values()))


def _draw(picture: str, gammas: Floats, found: dict[str, tuple[Floats, Floats]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log")
    for (name, (mean, error)), marker in zip(found.items(), "os^v", strict=True):
        axes.errorbar(gammas, mean * gammas, error * gammas, marker=marker, capsize=2.0, label=name)
    axes.plot(gammas, gammas, color="black", linestyle="--", label="guarantee: gamma")
    axes.plot(gammas, CUT * gammas[-1] * np.ones_like(gammas), color="gray", linestyle=":", label="cut")
    axes.set_xlabel("gamma, ticks")
    axes.set_ylabel("average run length, ticks")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    asked = arguments(__doc__, runs=20, gamma=3000.0, picture="")
    sys.exit(main(asked.runs, asked.gamma, asked.picture))
