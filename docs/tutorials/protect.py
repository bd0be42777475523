"""Protect: the fewest meters to seal, so that the others can only lie a little, or are identified.

SimBench rural 1, and then where nobody knows what two customers draw.
"""

from __future__ import annotations

from feeders.load import load
from feeders.studies.protect import Goal, protect
from gridsec.errors import GridsecError

site = load("simbench-lv-rural1")

# Any two meters, whatever voltages and powers they report.
usual = protect(site, max_attacked=2)
print(f"{usual.goal}: protect {usual.meters['meter'].tolist()}")
print(f"lies of {usual.before:.2f} V fit to an honest feeder before, of {usual.after:.2f} V after")

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
