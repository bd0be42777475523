"""Settings that every test shares."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Generator
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

from tests.tiers import COLLECTED, assign

if TYPE_CHECKING:
    from coverage import Coverage

hypothesis.settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    database=None,
    print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("repeatable")

SYSTEM_PARTS = {"alertmanager", "browser", "postgresql"}

TESTS = Path(__file__).parent
MEASURED = (
    *("gridsec/*", "contracts/*", "service/alarms/*"),
    *("feeders/studies/calibrate/*", "feeders/studies/droop/*"),
)
"""Files of tests that coverage traces, except the tests that are marked `no_cover`."""


# Byte code is kept, whatever the environment says. Compiling tests and package again takes each worker 12 s,
# and all `gridsec` processes of tests would compile the package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than there are processors: services, browsers and databases are waited for."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Assign the tiers before -m selects one of them."""
    config.stash[COLLECTED] = assign(items)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without garbage collection, and leave modules and cases out of all later ones.

    Both live until the end. Searching them again and again takes 40 % of the time of the collection.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """End what pytest-cov begins in each of several processes before it knows that it is one of them.

    Otherwise that goes on wherever the process's own measurement pauses, and every test is traced.
    """
    if hasattr(session.config, "workerinput") and (early := _tracer(session.config)) is not None:
        early.stop()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Let coverage trace no other files' tests, nor their fixtures: that takes as much time again."""
    name, tracer = item.path.relative_to(TESTS).as_posix(), _tracer(item.config)
    # Of tests that are marked so pytest-cov takes care.
    left_out = item.get_closest_marker("no_cover") is None and not any(fnmatch(name, one) for one in MEASURED)
    if tracer is None or not left_out:
        return (yield)
    tracer.stop()
    try:
        return (yield)
    finally:
        tracer.start()


def _tracer(config: pytest.Config) -> Coverage | None:
    """What pytest-cov measures with in this process; None without it."""
    if not config.pluginmanager.hasplugin("_cov"):
        return None
    from coverage import Coverage

    return Coverage.current()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Where every system part has been installed, a test skipped for want of one has failed."""
    report = yield
    wanted = SYSTEM_PARTS & {mark.name for mark in item.iter_markers()}
    if report.skipped and wanted and os.environ.get("GRIDSEC_TESTS_REQUIRE_ALL"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid}: skipped, but {', '.join(sorted(wanted))} must be present here"
    return report
