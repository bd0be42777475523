"""Detectable: the smallest lies that are surely named, the largest that stay unnoticed, in V.

Six meters on the European low-voltage benchmark of CIGRE, two of them lying together.
"""

from __future__ import annotations

import numpy as np

from feeders.load import load
from feeders.studies.detectable import detectable
from feeders.studies.rehearsal import rehearse

site = load("cigre-lv")
found = detectable(site, max_attacked=2)

# Up to `hidden` nobody is named, beyond `noticed` somebody is, beyond `named` it is the liar.
print(found.meters[["meter", "hidden", "noticed", "named", "fits"]].round(2))

# A second liar helps: what each meter alone could do, beside that.
print((found.meters["noticed"] / found.meters["noticed_alone"]).round(2).describe()[["min", "max"]])

# How wrong the voltage shown of a customer can become without an alarm.
worst = found.customers.loc[int(np.argmax(found.customers["error"]))]
print(f"{worst['customer']}: {worst['error']:.2f} V")

# The monitor itself, with lies just below the one and just above the other size.
print(rehearse(site, found, trials=10, seed=1))
