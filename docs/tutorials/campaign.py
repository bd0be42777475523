"""A campaign: hundreds of simulated attacks on a feeder, and the results of its monitor.

Six meters on the European low-voltage benchmark of CIGRE. A scene is a moment of the profiles, here of summer
and winter, with its own errors of loads and meters. The truth is full AC power flow with all inverters.
"""

from __future__ import annotations

from dataclasses import replace

from feeders.model.site import load
from feeders.profiles import Season
from feeders.simulation.attacks import AttackKind
from feeders.studies.campaign.plan import AttackClass, CampaignPlan, Place
from feeders.studies.campaign.study import campaign

site = load("cigre-lv")
plan = CampaignPlan(
    scenes=2,  # a real campaign has hundreds, of ten minutes each
    together=7,
    seed=1,
    kinds=(AttackClass("bias", AttackKind.BIAS, (0.5, 3.0)), AttackClass("drift", AttackKind.DRIFT, (3.0,))),
    liars=(1, 2),
    places=(Place.RANDOM, Place.COLLUDING),
    seasons=(Season.SUMMER, Season.WINTER),
    duration_s=60.0,
    onset_s=(10.0, 15.0),
    lying_s=35.0,
)
found = campaign(site, plan)  # on all cores: runner=Processes(4), under `if __name__ == "__main__"`

print(found.by_size[["kind", "size", "scenarios", "named", "named_low", "named_high", "delay_median_s"]])
print(found.scenarios.query("kind == 'bias' and missed != ''")[["scenario", "size", "place", "missed"]])

# The same attacks with the observer banks of chong2020.
other = campaign(site, replace(plan, estimator="exact-bank", settings=(("max_attacked", 2),)))
both = found.by_size.merge(other.by_size, on=["kind", "size"], suffixes=("", " exact bank"))
print(both[["kind", "size", "named", "named exact bank", "false", "false exact bank"]])
