"""Settings that every test shares."""

from __future__ import annotations

import os
from collections.abc import Generator
from fnmatch import fnmatch
from pathlib import Path

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

TESTS = Path(__file__).parent
MEASURED = (
    *("gridsec/*", "contracts/*", "service/test_alarms.py"),
    *("feeders/studies/test_calibrate*", "feeders/studies/test_droop*"),
)
"""The tests that by themselves, without the slow ones, have to cover what coverage is asked of."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than there are processors: services, browsers and databases are waited for."""
    return (os.cpu_count() or 1) + 1


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let coverage trace no other tests: that takes half as much time again."""
    if not config.pluginmanager.hasplugin("_cov"):
        return
    for item in items:
        name = item.path.relative_to(TESTS).as_posix()
        if item.get_closest_marker("slow") or not any(fnmatch(name, one) for one in MEASURED):
            item.add_marker("no_cover")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Where every system part has been installed, a test skipped for want of one has failed."""
    report = yield
    wanted = SYSTEM_PARTS & {mark.name for mark in item.iter_markers()}
    if report.skipped and wanted and os.environ.get("GRIDSEC_TESTS_REQUIRE_ALL"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid}: skipped, but {', '.join(sorted(wanted))} must be present here"
    return report
