"""What the reports of the tests say of themselves, and names that try to become markup."""

from __future__ import annotations

from feeders.report.html import About

HOSTILE = "\"><script>alert('x')</script>&amp;<img src=x onerror=alert(1)>"
ABOUT = About(
    made="2026-11-21 12:00 UTC",
    command="gridsec study report cigre-lv",
    versions={"gridsec": "0.1.0"},
    seeds={"campaign": 3},
    folder="report-files",
)
