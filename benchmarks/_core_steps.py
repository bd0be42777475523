"""Times of the steps of `benchmarks.core_step`, as a process of its own.

    python benchmarks/_core_steps.py

Standard input is a pickle of the feeder's name and of lists of frames; standard output is JSON, the processor
times of the steps over each list, ms. The program is run by its path, so that PYTHONPATH chooses the source
tree under test.
"""

from __future__ import annotations

import gc
import json
import pickle
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from feeders.model.site import from_tables, load
from feeders.registry import MODAL, DesignedEstimator, design
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors
from gridsec.interface import Frame


def estimator(feeder: str) -> DesignedEstimator:
    """The estimator without learned errors, for loads known to 0.6 kW and 0.2 kvar."""
    stated = Trial(load(feeder), load_error=LoadError(), meters=TrialMeterErrors.SITE).stated
    meta = stated.tables.meta
    settings = replace(meta.monitor, estimator=MODAL, commission_s=0.0)
    return design(from_tables(replace(stated.tables, meta=replace(meta, monitor=settings))))


def steps(made: DesignedEstimator, frames: Sequence[Frame]) -> list[float]:
    """Time of each step, ms."""
    state, took = made.init(frames[0].t), []
    gc.freeze()
    for frame in frames:
        begun = time.thread_time()
        state, *_ = made.step(state, frame)
        took.append(1e3 * (time.thread_time() - begun))
    return took


if __name__ == "__main__":
    name, every = pickle.load(sys.stdin.buffer)
    of_feeder = estimator(name)
    print(json.dumps([steps(of_feeder, frames) for frames in every]))
