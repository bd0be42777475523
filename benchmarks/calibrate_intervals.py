"""Coverage of the 95 % intervals of a calibration, on recordings of feeders with correct files.

    python -m benchmarks.calibrate_intervals [recordings] [feeder ...] [--days 4] [--step 900]

Days of readings by full AC power flow, 2 % of them lost, hidden loads (`--hidden-kw`, half as many kvar) and
meters with errors within their class; every other recording has reactive powers. Counted are the intervals of
the meters' biases and of the lines' lengths that hold the truth, the root mean square of their errors in
standard errors, the largest, and the recordings in which anything is proposed at all.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from benchmarks._arguments import count, positive
from feeders.model.site import Site, load
from feeders.simulation.demand import Variation
from feeders.simulation.plant import Channel, MeterErrors, SimulatedMeters
from feeders.simulation.recording import record
from feeders.simulation.scenario import Scenario
from feeders.studies.calibrate.study import calibrate
from gridsec.arrays import Floats

FEEDERS = ("cigre-lv", "simbench-lv-rural1")
# Quantile of the normal distribution that 95 % are within.
SURE = 1.959964


@dataclass(frozen=True, slots=True)
class Recorded:
    """Length of a recording, days, interval of the readings, s, and hidden loads, kW."""

    days: float
    step_s: float
    hidden_kw: float

    def scenario(self, seed: int) -> Scenario:
        """Clean readings with 2 % losses; reactive powers are reported with odd seeds."""
        return Scenario(
            seed=seed,
            duration_s=self.days * 86_400.0,
            dt_s=self.step_s,
            profile_s=0.0,
            variation=Variation(hidden_kw=self.hidden_kw, hidden_kvar=0.5 * self.hidden_kw),
            errors=MeterErrors(report_q=seed % 2 == 1),
            channel=Channel(loss=0.02),
        )


def errors(site: Site, what: Recorded, seed: int, folder: Path) -> tuple[Floats, bool]:
    """Errors of one calibration's estimates in their standard errors, and whether anything was proposed."""
    given = what.scenario(seed)
    found = calibrate(site, record(site, given, folder / "readings.parquet"))
    meters = SimulatedMeters(site, given.errors, given.channel, seed)
    bias = 100.0 * (meters.bias - meters.busbar_bias)
    known = found.meters["std_percent"].to_numpy() > 0.0
    of_meters = ((found.meters["bias_percent"] - bias) / found.meters["std_percent"]).to_numpy()[known]
    lines = found.lines[found.lines["verdict"] != "cannot be told"]
    return np.concatenate([of_meters, (lines["factor"] - 1.0) / lines["std"]]), not found.proposals.empty


def main(recordings: int, feeders: list[str], what: Recorded) -> None:
    """Count and print."""
    each_way = max(1, recordings // 2)
    print("| feeder | q metered | recordings | intervals that hold, % | rms | largest | with a proposal |")
    print("|---|---|---|---|---|---|---|")
    for feeder in feeders:
        site = load(feeder)
        for told in (False, True):
            z, proposed = [], 0
            for k in range(each_way):
                with tempfile.TemporaryDirectory() as folder:
                    each, any_ = errors(site, what, 2 * k + told, Path(folder))
                z.append(each)
                proposed += any_
            all_ = np.concatenate(z)
            held, rms = 100.0 * np.mean(np.abs(all_) < SURE), np.sqrt(np.mean(all_**2))
            largest = f"{np.abs(all_).max():.1f}"
            cells = (feeder, "yes" if told else "no", each_way, f"{held:.0f}", f"{rms:.2f}", largest)
            print("| " + " | ".join(map(str, (*cells, proposed))) + " |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibrate_intervals", description=__doc__)
    parser.add_argument("recordings", type=count, nargs="?", default=16)
    parser.add_argument("feeders", nargs="*", default=list(FEEDERS))
    parser.add_argument("--days", type=positive, default=4.0)
    parser.add_argument("--step", type=positive, default=900.0, help="interval of the readings, s")
    parser.add_argument("--hidden-kw", type=float, default=0.2)
    wanted = parser.parse_args()
    main(wanted.recordings, wanted.feeders, Recorded(wanted.days, wanted.step, wanted.hidden_kw))
