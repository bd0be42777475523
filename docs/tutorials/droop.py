"""The droop fleet of a feeder: stability, voltage band and hosting capacity.

Thirteen customers of a rural feeder, seven with generation and inverters after IEEE 1547, category B.
"""

from __future__ import annotations

from feeders.model.site import load
from feeders.studies.droop.study import DroopOptions, droop

site = load("kerber-landnetz")
found = droop(
    site,
    DroopOptions(
        dead=1,  # sampled once a second, and a second late
        v0_low=0.98,
        v0_high=1.03,
        v_min=0.94,
        v_max=1.06,
        presets=("ieee1547-b", "vde4105"),
        tau_factors=(0.01, 1.0),
        hosting=True,
        draws=4,
    ),
)
print(f"{found.feeder}: {found.verdict}; the band is {found.rest} at rest, {found.always} always")
print(found.tables["stability"][["point", "verdict", "proof", "gain", "margin"]])
print(found.tables["band"])
print(found.tables["presets"][["preset", "verdict", "margin", "settling_s", "v_low_volt", "v_high_volt"]])

# Loads that break the band, confirmed by AC power flow; none if the band is proven.
if "witness" in found.tables:
    print(found.tables["witness"].query("beyond")[["when", "customer", "v_volt"]])

# For a plot: the voltage at the last customer after a tap of the transformer.
curves = found.tables["trajectories"].query("step == 'tap' and customer == 'load-12'")
print(curves[["t_s", "v_volt"]].head(4))

print(found.tables["hosting"][["preset", "capacity_kw", "limit", "verdict"]])
print(found.tables["hosting_probability"])
