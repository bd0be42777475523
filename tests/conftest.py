"""Settings that every test shares."""

from __future__ import annotations

import os
from collections.abc import Generator

import hypothesis
import pytest

hypothesis.settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    database=None,
    print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("repeatable")

SYSTEM_PARTS = {"browser", "postgresql"}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Where every system part has been installed, a test skipped for want of one has failed."""
    report = yield
    wanted = SYSTEM_PARTS & {mark.name for mark in item.iter_markers()}
    if report.skipped and wanted and os.environ.get("GRIDSEC_TESTS_REQUIRE_ALL"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid}: skipped, but {', '.join(sorted(wanted))} must be present here"
    return report
