"""Protect: the fewest meters to seal, so that liars among the others are identified.

SimBench rural 1, where nobody knows what two customers draw.
"""

from __future__ import annotations

from feeders.load import load
from feeders.studies.protect import Goal, protect
from gridsec.errors import GridsecError

site = load("simbench-lv-rural1")
unknown = ["LV1.101 Load 4", "LV1.101 Load 8"]
found = protect(site, max_attacked=2, unknown=unknown)
print(f"{len(found.meters)} to protect, and no fewer than {found.least} suffice")
print(f"liars that stay invisible: {found.before:g} before, {found.after:g} after")
print(found.meters)

# Why nothing cheaper does: in each of these sets somebody has to be protected.
print(found.attacks)

# It is enough that a lie is noticed, whoever it is.
noticed = protect(site, max_attacked=2, unknown=unknown, goal=Goal.NOTICE)
print(noticed.meters[["meter", "customer"]])

# What cannot be done is an error that says why.
try:
    protect(site, max_attacked=2, unknown=["LV1.101 Load 8"], never=["m08"])
except GridsecError as error:
    print(error)
