"""A report: studies of a feeder on one page, with figures and tables, without the command line.

Six meters on the European low-voltage benchmark of CIGRE. A failed study is part of the report: it states
that there is no answer, and never looks like a good result.
"""

from __future__ import annotations

from pathlib import Path

from feeders.model.site import load
from feeders.report.build import report
from feeders.report.html import About, StudyOutcome
from feeders.studies.protect import Goal, protect
from feeders.studies.redundancy import redundancy

site = load("cigre-lv")
outcomes = [
    StudyOutcome("protect", protect(site, max_attacked=2, goal=Goal.BOUND, lie_volt=4.6)),
    StudyOutcome("redundancy", redundancy(site, silent=["m02"]), command="gridsec study redundancy cigre-lv"),
    StudyOutcome("droop", None, problem="left out of this tutorial"),
]
about = About(
    made="2026-11-21 12:00 UTC",  # time is an argument: the same arguments give the same bytes
    command="python report.py",
    versions={},
    seeds={},
)
made = report(site, outcomes, about)

Path("report.html").write_text(made.html, encoding="utf-8")
for name, data in made.pictures.items():
    Path(name).write_bytes(data)
print(f"report.html: {len(made.html) // 1000} kB, {len(made.pictures)} pictures")
print(made.tables["protect-meters"])
