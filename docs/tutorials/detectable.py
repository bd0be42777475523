"""Detectable: the smallest attacks that are surely named, the largest that stay undetected, in V.

Six meters on the European low-voltage benchmark of CIGRE, two of them colluding.
"""

from __future__ import annotations

import numpy as np

from feeders.model.site import load
from feeders.studies.campaign.guarantees import rehearse
from feeders.studies.detectable import detectable

site = load("cigre-lv")
found = detectable(site, max_attacked=2)

# Up to `hidden` no limit is exceeded, beyond `noticed` one is, beyond `named` the manipulated meter is named.
print(found.meters[["meter", "hidden", "noticed", "named", "fits"]].round(2))

# Sizes with a second manipulated meter, relative to those of each meter alone.
print((found.meters["noticed"] / found.meters["noticed_alone"]).round(2).describe()[["min", "max"]])

# Largest error of a displayed voltage without an alarm.
worst = found.customers.loc[int(np.argmax(found.customers["error"]))]
print(f"{worst['customer']}: {worst['error']:.2f} V")

# The monitor under attacks just below the one and just above the other size.
print(rehearse(site, found, trials=10, seed=1))
