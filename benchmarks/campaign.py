"""Campaigns on SimBench rural 3, 118 customers: scenarios per hour, and how they grow with processes.

    python -m benchmarks.campaign [scenes] [--full]

Ten-minute scenarios at one reading per second, 16 in a scene, full AC power flow as truth, the default kinds
of manipulations, the default estimator: with one process, with two, and on a local Dask cluster of two
workers; the tables have to be equal. Then what 10 000 of them would take with two processes. `--full` plays
10 000 with two processes, keeping them in campaign-10000.journal.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from distributed import LocalCluster

from benchmarks._arguments import arguments
from feeders.model.site import load
from feeders.studies.campaign.plan import CampaignPlan
from feeders.studies.campaign.study import Campaign, campaign
from feeders.studies.running import Dask, Processes, Runner

FEEDER, SCENES, FULL = "simbench-lv-rural3", 4, 10_000
JOURNAL = Path("campaign-10000.journal")


@dataclass(frozen=True, slots=True)
class Measured:
    """What a campaign took.

    Attributes
    ----------
    found
        Its tables.
    per_hour
        Scenarios, by the clock.
    each_s
        Processor time of a scenario, s, the start of the processes included.
    """

    found: Campaign
    per_hour: float
    each_s: float


def measure(name: str, where: AbstractContextManager[Runner], plan: CampaignPlan) -> Measured:
    """Play a plan, and print what it took.

    Parameters
    ----------
    name, where, plan
        Where, for people and for the campaign, and what.
    """
    used = _processor_s()
    with where as runner:
        begun = time.monotonic()
        found = campaign(load(FEEDER), plan, runner=runner)
        took = time.monotonic() - begun
    each_s = (_processor_s() - used) / plan.scenarios
    rate = 3600.0 * plan.scenarios / took
    print(
        f"{name:18} {plan.scenarios} scenarios in {took:4.0f} s, {rate:6.0f} per hour, "
        f"{each_s:.2f} s of processor time each",
        flush=True,
    )
    return Measured(found, rate, each_s)


@contextmanager
def dask() -> Iterator[Runner]:
    """Two workers of one thread each on this machine."""
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster:
        yield Dask(cluster.scheduler_address)


def _processor_s() -> float:
    ended = getrusage(RUSAGE_CHILDREN)
    return ended.ru_utime + ended.ru_stime


def main(scenes: int, *, full: bool) -> int:
    """Print rates and ratios; 1 if tables differ, or 10 000 take more than an hour.

    Parameters
    ----------
    scenes
        How many.
    full
        Whether to play 10 000 scenarios rather than to extrapolate.
    """
    plan = CampaignPlan(scenes=scenes)
    one = measure("one process", nullcontext(Processes(1)), plan)
    two = measure("two processes", nullcontext(Processes(2)), plan)
    far = measure("Dask, two workers", dask(), plan)
    for name, other in (("two processes", two), ("Dask", far)):
        print(
            f"{name}: {other.per_hour / one.per_hour:.2f} times as fast as one process by the clock, "
            f"{2 * one.each_s / other.each_s:.2f} by the processor time"
        )
    tables = [each.found.tables for each in (one, two, far)]
    same = all(tables[0][name].equals(other[name]) for other in tables[1:] for name in other)
    print(f"tables are {'equal to the last bit' if same else 'DIFFERENT'}")
    hours = FULL / two.per_hour
    print(
        f"{FULL} scenarios with two processes: {60.0 * hours:.0f} minutes by the clock, "
        f"{FULL * two.each_s / 120.0:.0f} by the processor time, extrapolated"
    )
    if full:
        begun = time.monotonic()
        plan = replace(plan, scenes=FULL // plan.together)
        found = campaign(load(FEEDER), plan, runner=Processes(2), journal=JOURNAL)
        hours = (time.monotonic() - begun) / 3600.0
        print(f"{plan.scenarios} scenarios with two processes: {60.0 * hours:.0f} minutes")
        print(found.by_kind.to_string())
    return 0 if same and hours < 1.0 else 1


if __name__ == "__main__":
    asked = arguments(__doc__, scenes=SCENES, full=False)
    sys.exit(main(asked.scenes, full=asked.full))
