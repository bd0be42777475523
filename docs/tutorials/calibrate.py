"""Calibration: recorded readings against a feeder's files, on the European low-voltage benchmark of CIGRE.

Full AC power flow simulates four days of readings at 15 min on the true feeder. The compared files have three
errors: a customer at another bus, two customers with each other's meters, and a cable that is 30 % longer in
reality.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from feeders.format.tables import read, write
from feeders.model.site import from_tables, load
from feeders.simulation.demand import Variation
from feeders.simulation.plant import MeterErrors
from feeders.simulation.recording import record
from feeders.simulation.scenario import Scenario
from feeders.studies.calibrate.study import calibrate

truth = load("cigre-lv")
loads = Variation(hidden_kw=0.2, hidden_kvar=0.1)  # loads beyond the meters' registers
days = Scenario(
    seed=1,
    duration_s=4 * 86400.0,
    dt_s=900.0,
    profile_s=0.0,
    variation=loads,
    errors=MeterErrors(report_q=True),
)

rows = {row.customer: row for row in truth.tables.customers}
rows["Load R15"] = replace(rows["Load R15"], bus="Bus R17")
rows["Load R11"] = replace(rows["Load R11"], meter="m04")
rows["Load R16"] = replace(rows["Load R16"], meter="m02")
lines = [
    replace(row, r_ohm=row.r_ohm / 1.3, x_ohm=row.x_ohm / 1.3) if row.line == "Line R6-R16" else row
    for row in truth.tables.lines
]
wrong = replace(truth.tables, customers=tuple(rows.values()), lines=tuple(lines))

with tempfile.TemporaryDirectory() as folder:
    recording = record(truth, days, Path(folder) / "readings.parquet")
    found = calibrate(from_tables(wrong), recording, risk=0.05)
    print(
        found.proposals[["kind", "what", "proposed", "estimate", "std", "log_factor", "verdict"]].to_string()
    )
    print(found.meters[["meter", "bias_percent", "std_percent", "verdict"]].to_string())
    print(found.lines[["lines", "factor", "std", "same", "verdict"]].to_string())
    print(found.errors.to_string())

    write(wrong, Path(folder) / "files")  # corrections are on request, and never in place
    found.corrected(Path(folder) / "files", Path(folder) / "corrected")
    print(read(Path(folder) / "corrected").customers == truth.tables.customers)
