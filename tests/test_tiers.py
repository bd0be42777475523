"""Every file and every parametrized test of the acceptance tier has a representative in the fast tier."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import pytest

from tests.tiers import COLLECTED, TESTS, Case, defects

GOOD = (
    Case("test_a.py", "test_sweep", "0", False, ("0",)),
    Case("test_a.py", "test_sweep", "1", True, ("0",)),
    Case("test_a.py", "test_long", "", True, None),
    Case("test_b.py", "TestC::test_short", "", False, None),
)


def test_every_acceptance_case_has_a_representative(request: pytest.FixtureRequest) -> None:
    """On the cases of this session before -m and -k deselect any of them."""
    cases = request.config.stash[COLLECTED]
    files = {path.relative_to(TESTS).as_posix() for path in TESTS.rglob("test_*.py")}
    missing = files - {case.file for case in cases}
    if missing and not os.environ.get("GRIDSEC_TESTS_REQUIRE_ALL"):
        pytest.skip(f"needs the whole suite: {len(missing)} files are not collected")
    assert not missing
    assert defects(cases) == []
    assert sum(case.acceptance for case in cases) > 100
    assert sum(not case.acceptance for case in cases) > 1000


def test_well_formed_tiers_have_no_defect() -> None:
    assert defects(GOOD) == []


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (GOOD[1:3], ["test_a.py: no test in the fast tier", "test_a.py::test_sweep: no case '0'"]),
        ((replace(GOOD[3], acceptance=True),), ["test_b.py: no test in the fast tier"]),
        (
            [replace(case, canaries=("2",)) for case in GOOD[:2]],
            ["test_a.py::test_sweep: no case '2'"],
        ),
        (
            [*[replace(case, acceptance=True) for case in GOOD[:2]], replace(GOOD[3], file="test_a.py")],
            ["test_a.py::test_sweep: no case in the fast tier"],
        ),
        (GOOD[:1], ["test_a.py::test_sweep: no case in the acceptance tier"]),
        ([replace(case, canaries=None) for case in GOOD[:2]], ["parameters marked acceptance"]),
    ],
    ids=["sweep", "file", "unknown-canary", "no-canary", "needless-canary", "parameters"],
)
def test_defects_are_found(changed: list[Case], told: list[str]) -> None:
    found = "\n".join(defects(changed))
    for one in told:
        assert one in found


@pytest.mark.canary("not acceptance")
@pytest.mark.parametrize("tier", ["not acceptance", "acceptance"])
def test_a_tier_is_selected_by_its_marker(tier: str) -> None:
    """By pytest in a process of its own, on a file that imports nothing of the project."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"),
            *("-m", tier, "tests/test_tutorials.py"),
        ],
        capture_output=True,
        text=True,
        check=False,
        cwd=TESTS.parent,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    cases = {
        line.partition("[")[2].rstrip("]") for line in done.stdout.splitlines() if "says_something[" in line
    }
    tutorials = {path.stem for path in (TESTS.parent / "docs" / "tutorials").glob("*.py")}
    assert len(tutorials) > 1
    assert cases == ({"redundancy"} if tier == "not acceptance" else tutorials - {"redundancy"})
