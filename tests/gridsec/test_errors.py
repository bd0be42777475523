"""What errors carry, and that they read well."""

from __future__ import annotations

import pytest

from gridsec.errors import DesignInfeasible, FeederInvalid, GridsecError, NotObservable


def test_feeder_invalid_names_every_problem() -> None:
    error = FeederInvalid(name for name in ("first", "second"))
    assert error.problems == ("first", "second")
    assert str(error) == "2 problems with the feeder:\n  - first\n  - second"
    assert str(FeederInvalid(["only"])).startswith("1 problem with the feeder:")


def test_not_observable_carries_the_subset() -> None:
    error = NotObservable((3, 1), 2, "needs three meters")
    assert (error.subset, error.rank, str(error)) == ((3, 1), 2, "needs three meters")


def test_design_infeasible_says_what_and_by_how_much() -> None:
    error = DesignInfeasible("small gain", "too large", -0.25)
    assert (error.what, error.status, error.margin) == ("small gain", "too large", -0.25)
    assert str(error) == "small gain: too large, margin -0.25"
    assert str(DesignInfeasible("a", "b")) == "a: b"


@pytest.mark.parametrize("kind", [FeederInvalid, NotObservable, DesignInfeasible])
def test_one_tree(kind: type[Exception]) -> None:
    assert issubclass(kind, GridsecError)
