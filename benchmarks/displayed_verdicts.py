"""Changes of the raw and of the displayed verdict with lost readings, in a replay of simulated time.

    python -m benchmarks.displayed_verdicts [FEEDER] [MINUTES] [PERCENT]

Without an attack, and with a meter that is manipulated from the middle on. Limit: a tenth of the changes of
the raw verdict. The delay is that of the displayed ATTACKED after the first raw one.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import Site, load
from feeders.simulation.plant import Channel
from feeders.simulation.recording import read_recording, record
from feeders.simulation.scenario import Scenario
from gridsec.attack import Bias
from gridsec.interface import Decision
from service.engine.replay import ReplayCounts, replay
from service.report.report import FeederReport

SHARE = 0.1
"""Limit of the changes of the displayed verdict, relative to those of the raw one."""


def reports(site: Site, scenario: Scenario) -> list[FeederReport]:
    """Return the reports of a replay."""
    with tempfile.TemporaryDirectory() as folder:
        recording = record(site, scenario, Path(folder) / "day.parquet")
        readings = read_recording(recording.path).readings()
        return [result.report for result in replay(site, readings, ReplayCounts())]


def changes(verdicts: list[Decision]) -> int:
    """Return the number of changes."""
    return sum(a is not b for a, b in pairwise(verdicts))


def main() -> int:
    """Measure and print."""
    given = arguments(__doc__, feeder="simbench-lv-rural1", minutes=20.0, percent=20.0)
    site, length = load(given.feeder), 60.0 * given.minutes
    calm = Scenario(duration_s=length, channel=Channel(loss=given.percent / 100.0))
    begin = calm.start + length / 2.0
    bias = Bias(np.array([1]), begin, calm.start + length, np.array([0.04]))
    attacked = Scenario(duration_s=length, channel=calm.channel, attacks=(bias,))
    missed = False
    for name, scenario in (("no attack", calm), ("an attack", attacked)):
        found = reports(site, scenario)
        shown = [one.displayed.verdict for one in found if one.displayed is not None]
        count = changes(shown)
        raw_count = changes([one.verdict for one in found])
        missed |= count > SHARE * raw_count
        shares = {
            what: ", ".join(f"{verdict} {n / len(all_):.0%}" for verdict, n in Counter(all_).most_common())
            for what, all_ in (("raw", [one.verdict for one in found]), ("displayed", shown))
        }
        print(f"{name}: raw {raw_count} changes ({shares['raw']}), ", end="")
        print(f"displayed {count} changes ({shares['displayed']})")
        if scenario is attacked:
            raw = next((one.t for one in found if one.verdict is Decision.ATTACKED), None)
            later = next(
                (one.t for one in found if one.displayed and one.displayed.verdict is Decision.ATTACKED), None
            )
            print(f"delay: {later - raw:g} s" if raw and later else "never displayed")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
