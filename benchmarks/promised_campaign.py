"""Lies of the sizes that `gridsec study detectable` promises, played as a campaign against AC power flow.

    python -m benchmarks.promised_campaign [lies] [--feeder NAME] [--journal FILE]

Lies that are to stay hidden, of two meters in the worst collusion or of one alone, and lies that are to be
named: 10 000 of each by default, on all cores. A scene has three scenarios of 26 s; the
first is without a lie, and the others, 12 s of a lie each, are compared with it. Exits 1 if a meter is named
because of one of the former, or one of the latter is missed. With a journal an interrupted run goes on. The
feeder is SimBench rural 1, 13 customers, unless another is asked for.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from feeders.model.site import load
from feeders.studies.campaign.guarantees import promised
from feeders.studies.campaign.plan import CampaignPlan, Place
from feeders.studies.campaign.study import campaign
from feeders.studies.detectable import detectable
from feeders.studies.running import Here, Processes

FEEDER, LIES, LIARS = "simbench-lv-rural1", 10_000, 2
PLAN = CampaignPlan(
    estimator="modal",  # the guarantees are those of its limits
    together=3,
    duration_s=26.0,
    onset_s=(12.0, 14.0),
    lying_s=12.0,
    settling_s=1.0,
    places=(Place.RANDOM,),
)


def main(lies: int, feeder: str, journal: Path | None) -> int:
    """Play the lies and print what became of them; 1 if a promise was broken.

    Parameters
    ----------
    lies, feeder
        How many of each promise, and where.
    journal
        Keeps finished scenes.
    """
    site, cores = load(feeder), os.cpu_count() or 1
    plan = replace(PLAN, scenes=lies)
    stated = plan.trial(site, plan.moment(0)).stated
    plan = replace(plan, kinds=promised(stated, detectable(stated, max_attacked=LIARS)))
    done: list[tuple[float, int]] = []
    found = campaign(
        site,
        plan,
        runner=Processes(cores) if cores > 1 else Here(),
        journal=journal,
        progress=lambda scenarios, _: done.append((time.monotonic(), scenarios // plan.together)),
    )
    for row in found.promises.to_dict("records"):
        what = "with a device named because of it" if row["promise"] == "hidden" else "with a liar missed"
        print(
            f"{feeder}: {row['lies']} lies to be {row['promise']}, {row['broken']} {what} "
            f"({row['by_chance']} with a liar named without it too, {row['honest_named']} with an honest one "
            f"named); probability below {row['probability_high']:.1e} (95 %, {row['scenes']} scenes)"
        )
    # By the clock without the start of the processes: from the first scene that was done here to the last.
    (begun, first), (ended, last) = done[min(1, len(done) - 1)], done[-1]
    each = (ended - begun) / max(last - first, 1)
    used = [getrusage(part) for part in (RUSAGE_SELF, RUSAGE_CHILDREN)]
    cost = sum(one.ru_utime + one.ru_stime for one in used) / max(last - done[0][1], 1) / cores
    print(
        f"{cores} processes, {each:.3f} s per scene; {LIES} lies of each: {each * LIES / 60.0:.0f} min by "
        f"the clock, {cost * LIES / 60.0:.0f} min by the processor time, with nothing else to do"
    )
    return int(found.promises["broken"].sum() > 0)


if __name__ == "__main__":
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    asked.add_argument("lies", nargs="?", type=int, default=LIES)
    asked.add_argument("--feeder", default=FEEDER)
    asked.add_argument("--journal", type=Path)
    given = asked.parse_args()
    sys.exit(main(given.lies, given.feeder, given.journal))
