"""Lies of the sizes that `gridsec study detectable` promises, watched by the monitor `modal` itself.

    python -m benchmarks.promised_lies [trials] [feeder ...]

10 000 lies up to the hidden size, in the worst collusion of two meters, and 10 000 from the named size on,
half of them with another liar. Exits 1 if a meter is named for one of the former, or one of the latter is
missed. Figures are printed every 1 000 trials.
"""

from __future__ import annotations

import os
import sys
import time

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks._arguments import arguments
from feeders.model.site import load
from feeders.studies.campaign.guarantees import rehearse
from feeders.studies.detectable import detectable

FEEDERS, TRIALS, LIARS, TOGETHER = ("cigre-lv", "simbench-lv-rural1"), 10_000, 2, 1_000


def main(trials: int, feeders: list[str]) -> int:
    """Print what became of the lies; 1 if a promise was broken.

    Parameters
    ----------
    trials, feeders
        How many lies of each size, and where.
    """
    broken = 0
    for name in feeders:
        site = load(name)
        found = detectable(site, max_attacked=LIARS)
        begun, hidden, missed, honest, done = time.monotonic(), 0, 0, 0, 0
        while done < trials:
            seen = rehearse(site, found, trials=min(TOGETHER, trials - done), seed=done)
            done += seen.trials
            hidden, missed = hidden + seen.hidden_named, missed + seen.large_missed
            honest += seen.honest_named
            print(
                f"{name}: {done} hidden lies, {hidden} named; {done} large ones, {missed} missed, "
                f"{honest} with an honest meter named; {time.monotonic() - begun:.0f} s",
                flush=True,
            )
        broken += hidden + missed
    return int(broken > 0)


if __name__ == "__main__":
    asked = arguments(__doc__, trials=TRIALS, feeders=FEEDERS)
    sys.exit(main(asked.trials, list(asked.feeders)))
