"""Compare: named meters, delays and costs of estimators under the same attacks.

Six meters on the European low-voltage benchmark of CIGRE, two of them manipulated. The truth is full AC power
flow. All estimators have the uncertainty of meters and loads that the plan states.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd

from feeders.model.site import load
from feeders.simulation.trial import LoadError, TrialMeterErrors
from feeders.studies.comparison import ComparisonPlan, compare, markdown, write_csv

site = load("cigre-lv")
plan = ComparisonPlan(
    max_attacked=2,
    seeds=2,  # a real comparison has dozens, of eight minutes each
    duration_s=75.0,
    load_error=LoadError(p_kw=0.1, q_kvar=0.05),
    meters=TrialMeterErrors.SITE,  # a fixed error within the class of each, rounding and jitter
    families=("modal", "exact-bank", "weighted-least-squares"),
    cases=("clean", "bias", "coordinated"),
)
rows = compare(site, plan)
shown = ["case", "family", "named", "liars", "falsely_named", "delay_s", "error_all", "step_ms", "observers"]
print(pd.DataFrame(rows)[shown].round(3).to_string(index=False))

# An estimator that does not apply to this feeder keeps its row, with the reason.
(refused,) = compare(site, replace(plan, max_attacked=3, families=("exact-bank",), cases=("clean",)))
print(refused.reason)

# For a spreadsheet, and as the tables of a page.
write_csv(rows, Path("comparison.csv"))
print("\n".join(markdown(rows, plan).splitlines()[3:8]))
