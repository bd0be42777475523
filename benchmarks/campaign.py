"""Campaigns on SimBench rural 3, 118 customers: scenarios per hour, and how they grow with processes.

    python -m benchmarks.campaign [scenes] [--full]

Ten-minute scenarios at one reading per second, 16 in a scene, full AC power flow as truth, the default kinds
of lies, watched by the sequential monitor: with one process, with two, and on a local Dask cluster of two
workers; the tables have to be equal. Then what 10 000 of them would take with two processes. `--full` plays
10 000 with two processes, keeping them in campaign-10000.journal.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from distributed import LocalCluster

from feeders.load import load
from feeders.studies.campaign import Campaign, campaign
from feeders.studies.campaign_plan import Plan
from feeders.studies.campaign_run import Dask, Processes, Runner

FEEDER, SCENES, FULL = "simbench-lv-rural3", 4, 10_000
JOURNAL = Path("campaign-10000.journal")


def measure(name: str, runner: Runner, plan: Plan) -> tuple[Campaign, float, float]:
    """Play a plan; print and return scenarios per hour, and the processor time of each, s.

    Parameters
    ----------
    name, runner, plan
        Where, for people and for the campaign, and what.
    """
    begun, used = time.monotonic(), _processor_s()
    found = campaign(load(FEEDER), plan, runner=runner)
    took, used = time.monotonic() - begun, _processor_s() - used
    rate = 3600.0 * plan.scenarios / took
    told = f", {used / plan.scenarios:.2f} s of processor time each" if used else ""
    print(f"{name:24} {plan.scenarios} scenarios in {took:5.0f} s: {rate:7.0f} per hour{told}", flush=True)
    return found, rate, used / plan.scenarios


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
    plan = Plan(scenes=scenes)
    one, alone, each_s = measure("one process", Processes(1), plan)
    two, double, _ = measure("two processes", Processes(2), plan)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster:
        far, dask, _ = measure("Dask, two workers", Dask(cluster.scheduler_address), plan)
    print(
        f"two processes are {double / alone:.2f} times as fast as one, the cluster {dask / alone:.2f} times"
    )
    same = all(one.tables[name].equals(other.tables[name]) for other in (two, far) for name in one.tables)
    print(f"tables are {'equal to the last bit' if same else 'DIFFERENT'}")
    hours = FULL / double
    print(f"{FULL} scenarios with two processes: {60.0 * hours:.0f} minutes, extrapolated")
    print(f"and {FULL * each_s / 120.0:.0f} minutes by the processor time, where nobody else asks for it")
    if full:
        begun = time.monotonic()
        plan = replace(plan, scenes=FULL // plan.together)
        found = campaign(load(FEEDER), plan, runner=Processes(2), journal=JOURNAL)
        hours = (time.monotonic() - begun) / 3600.0
        print(f"{plan.scenarios} scenarios with two processes: {60.0 * hours:.0f} minutes")
        print(found.by_kind.to_string())
    return 0 if same and hours < 1.0 else 1


if __name__ == "__main__":
    numbers = [int(each) for each in sys.argv[1:] if each.isdigit()]
    sys.exit(main(numbers[0] if numbers else SCENES, full="--full" in sys.argv))
