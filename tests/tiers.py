"""Two tiers of tests: `make test` runs the fast tier, `make acceptance` runs every test.

The marker `acceptance` on a test keeps all its cases out of the fast tier. The marker `canary(id, ...)` on a
parametrized test keeps the cases with these ids in the fast tier and marks all others as `acceptance`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

TESTS = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Case:
    """One collected test case.

    Attributes
    ----------
    file
        Path below the folder of the tests.
    test
        Name with its classes.
    parameters
        Id of the parameters; empty for a test without parameters.
    acceptance
        True outside the fast tier.
    canaries
        Arguments of the marker `canary`; None without the marker.
    """

    file: str
    test: str
    parameters: str
    acceptance: bool
    canaries: tuple[str, ...] | None


COLLECTED = pytest.StashKey[tuple[Case, ...]]()


def assign(items: Iterable[pytest.Item]) -> tuple[Case, ...]:
    """Mark the cases beside the canaries as `acceptance`, and return all cases."""
    cases = []
    for item in items:
        parameters = item.callspec.id if hasattr(item, "callspec") else ""
        canary = item.get_closest_marker("canary")
        if canary is not None and parameters not in canary.args:
            item.add_marker("acceptance")
        file, _, test = item.nodeid.partition("::")
        cases.append(
            Case(
                Path(item.path).relative_to(TESTS).as_posix() if item.path.is_relative_to(TESTS) else file,
                test.partition("[")[0],
                parameters,
                item.get_closest_marker("acceptance") is not None,
                None if canary is None else canary.args,
            )
        )
    return tuple(cases)


def defects(cases: Sequence[Case]) -> list[str]:
    """Files and parametrized tests without a case in the fast tier, and canaries without a case."""
    files: defaultdict[str, list[Case]] = defaultdict(list)
    tests: defaultdict[tuple[str, str], list[Case]] = defaultdict(list)
    for case in cases:
        files[case.file].append(case)
        tests[case.file, case.test].append(case)
    found = [
        f"{file}: no test in the fast tier"
        for file, those in files.items()
        if all(case.acceptance for case in those)
    ]
    for (file, test), those in tests.items():
        canaries, name = those[0].canaries, f"{file}::{test}"
        if canaries is None:
            if len({case.acceptance for case in those}) == 2:
                found.append(f"{name}: parameters marked acceptance; the marker canary names those that stay")
            continue
        ids = {case.parameters for case in those}
        found += [f"{name}: no case {one!r}" for one in canaries if one not in ids]
        if all(case.acceptance for case in those):
            found.append(f"{name}: no case in the fast tier")
        if not any(case.acceptance for case in those):
            found.append(f"{name}: no case in the acceptance tier")
    return found
