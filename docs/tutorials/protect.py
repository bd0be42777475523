"""Protect: the fewest meters to seal, so that attacks on the others are small, or are identified.

SimBench rural 1, and then the same feeder with two unknown loads.
"""

from __future__ import annotations

from feeders.model.site import load
from feeders.studies.protect import Goal, protect
from gridsec.errors import GridsecError

site = load("simbench-lv-rural1")

# Any two meters, with any reported voltages and powers.
usual = protect(site, max_attacked=2)
print(f"{usual.goal}: protect {usual.meters['meter'].tolist()}")
print(f"attacks of {usual.before:.2f} V fit an honest feeder before, of {usual.after:.2f} V after")

unknown = ["LV1.101 Load 4", "LV1.101 Load 8"]
found = protect(site, max_attacked=2, unknown=unknown)
print(f"{len(found.meters)} to protect, and no fewer than {found.least} suffice")
print(f"manipulated meters that stay invisible: {found.before:g} before, {found.after:g} after")
print(found.meters)

# Lower bound: each of these sets needs a protected meter.
print(found.attacks)

# A weaker goal: attacks are detected, not identified.
noticed = protect(site, max_attacked=2, unknown=unknown, goal=Goal.NOTICE)
print(noticed.meters[["meter", "customer"]])

# An impossible goal raises an error with the reason.
try:
    protect(site, max_attacked=2, unknown=["LV1.101 Load 8"], never=["m08"])
except GridsecError as error:
    print(error)
