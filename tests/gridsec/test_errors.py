"""What errors carry, and that they read well."""

from __future__ import annotations

import pickle

import pytest

from gridsec.errors import (
    DesignInfeasible,
    FeederInvalid,
    GridsecError,
    InputInvalid,
    NotObservable,
    Problem,
    raise_if_any,
)
from tests.codes import refused


def test_a_problem_is_its_sentence_with_a_code() -> None:
    problem = Problem("shape", "A has shape (2,)")
    assert problem == "A has shape (2,)"
    again = pickle.loads(pickle.dumps(problem))
    assert (again, again.code) == (problem, "shape")


@pytest.mark.parametrize("kind", [FeederInvalid, InputInvalid])
def test_codes_follow_the_problems(kind: type[FeederInvalid | InputInvalid]) -> None:
    error = kind([Problem("shape", "first"), "second", Problem("order", "third")])
    assert error.codes == ("shape", "", "order")
    assert error.problems == ("first", "second", "third")


@pytest.mark.parametrize("kind", [FeederInvalid, InputInvalid])
def test_a_pickled_error_keeps_problems_codes_and_sentence(kind: type[FeederInvalid | InputInvalid]) -> None:
    error = kind([Problem("shape", "first"), Problem("order", "second")])
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (again.problems, again.codes, str(again)) == (error.problems, error.codes, str(error))


@pytest.mark.parametrize(
    "error",
    [
        NotObservable((1, 3), 2, "two meters", code="too-few-meters"),
        DesignInfeasible("observer", "not definite", -0.5, code="not-definite"),
    ],
)
def test_a_pickled_error_needs_no_arguments_of_its_constructor(error: GridsecError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), again.__dict__) == (str(error), error.__dict__)


def test_the_code_of_one_sentence_is_that_of_its_class_or_its_own() -> None:
    class Late(GridsecError):
        code = "late"

    assert Late("no answer").codes == ("late",)
    other = GridsecError("no answer", code="other")
    again = pickle.loads(pickle.dumps(other))
    assert (other.code, Late.code, str(other)) == ("other", "late", "no answer")
    assert (again.codes, str(again)) == (("other",), "no answer")


def test_refuse_raises_only_with_problems() -> None:
    raise_if_any([])
    with refused(InputInvalid, "shape", "order") as caught:
        raise_if_any(Problem(code, f"{code} is wrong") for code in ("shape", "order"))
    assert str(caught.value) == "shape is wrong; order is wrong"
    assert isinstance(caught.value, ValueError)


def test_feeder_invalid_names_every_problem() -> None:
    error = FeederInvalid(name for name in ("first", "second"))
    assert error.problems == ("first", "second")
    assert str(error) == "2 problems with the feeder:\n  - first\n  - second"
    assert str(FeederInvalid(["only"])).startswith("1 problem with the feeder:")


def test_not_observable_carries_the_subset() -> None:
    error = NotObservable((3, 1), 2, "needs three meters")
    assert (error.subset, error.rank, str(error)) == ((3, 1), 2, "needs three meters")
    assert error.code == "not-observable"
    assert NotObservable((), 0, "no meters", code="too-few-meters").code == "too-few-meters"


def test_design_infeasible_says_what_and_by_how_much() -> None:
    error = DesignInfeasible("small gain", "too large", -0.25)
    assert (error.what, error.status, error.margin) == ("small gain", "too large", -0.25)
    assert str(error) == "small gain: too large, margin -0.25"
    assert str(DesignInfeasible("a", "b")) == "a: b"
    assert error.code == "design-infeasible"
    assert DesignInfeasible("a", "b", code="unstable").code == "unstable"


@pytest.mark.parametrize("kind", [FeederInvalid, NotObservable, DesignInfeasible])
def test_one_tree(kind: type[Exception]) -> None:
    assert issubclass(kind, GridsecError)
