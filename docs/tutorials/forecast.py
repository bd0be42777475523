"""Unread powers: forecasts from the library's profiles, and their learned errors.

Three of the six customers of CIGRE's low-voltage benchmark have no meter. Loggers measure their powers for a
week of June; the errors of the forecasts go into the feeder's files.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from feeders.format.tables import write
from feeders.model.site import forecast_errors, from_history, from_tables, load, load_doubt, tell
from feeders.simulation.demand import Customers, Variation
from feeders.simulation.scenario import START

tables = load("cigre-lv").tables
without = ("Load R15", "Load R16", "Load R17")
rows = [replace(row, meter="") if row.customer in without else row for row in tables.customers]
plain = from_tables(replace(tables, customers=tuple(rows)))
meta = replace(tables.meta, load=replace(tables.meta.load, forecast="profiles"))
site = from_tables(replace(plain.tables, meta=meta))

step_s = 900.0
t = START + step_s * np.arange(7 * 96)
drawn = Customers(site, Variation(), seed=1, start=START, profile_s=0.0).at(t)

learned = from_history(*forecast_errors(site, t, drawn.p_kw, drawn.q_kvar), step_s)
updated = from_tables(tell(site.tables, learned, site.feeder.base_kva))
write(updated.tables, Path("with-forecasts"))

print("1 sigma, kW   no forecast  library  learned")
stds = [site.feeder.base_kva * load_doubt(each).p for each in (plain, site, updated)]
for k, row in enumerate(tables.customers):
    if row.customer in without:
        print(f"{row.customer:12s}" + "".join(f"{std[k]:10.1f}" for std in stds))
print(f"errors last {learned.time_s:.0f} s")
