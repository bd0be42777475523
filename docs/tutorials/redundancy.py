"""Redundancy: how many lying meters a feeder withstands, and what a silent one changes.

Thirteen customers of SimBench rural 1 in four streets. The attacker knows everything.
"""

from __future__ import annotations

from feeders.load import load
from feeders.studies.redundancy import redundancy

site = load("simbench-lv-rural1")
found = redundancy(site, silent=["m04"])

# The fewest liars that stay invisible while all meters report, and without m04: nobody then knows its load.
print(found.summary[["case", "attack", "index", "detected", "identified", "liars"]])

# Where in the feeder that makes a difference.
print(found.changes)

# Meter by meter: the fewest liars that hide a lie of this one, and what the others identify without it.
print(
    found.meters.query("case == 'all live'")[["meter", "index_any", "critical", "identified_without"]].head()
)

# The same for a feeder whose busbar is not metered: all voltages may be shifted alike.
shifted = redundancy(site, busbar_known=False)
print(shifted.summary[["attack", "index", "liars"]])
