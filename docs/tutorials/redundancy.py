"""Redundancy: number of manipulated meters that a feeder withstands, and the effect of a silent one.

Thirteen customers of SimBench rural 1 in four streets. The attacker has exact knowledge of the feeder.
"""

from __future__ import annotations

from feeders.model.site import load
from feeders.studies.redundancy import redundancy

site = load("simbench-lv-rural1")
found = redundancy(site, silent=["m04"])

# The fewest manipulated meters that stay invisible while all meters report, and without m04 and its load.
print(found.summary[["case", "attack", "index", "detected", "identified", "liars"]])

# Parts of the feeder with another result.
print(found.changes)

# Meter by meter: the fewest meters that hide an attack on it, and the number identified without it.
print(
    found.meters.query("case == 'all live'")[["meter", "index_any", "critical", "identified_without"]].head()
)

# The same for a feeder without a busbar meter: all voltages may be shifted alike.
shifted = redundancy(site, busbar_known=False)
print(shifted.summary[["attack", "index", "liars"]])
