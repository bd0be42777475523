"""Assertions on the codes of errors; sentences are in golden/errors.txt beside the tests of each package."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import pytest

from gridsec.errors import GridsecError, InputInvalid, Problem

Coded = TypeVar("Coded", bound=GridsecError | InputInvalid)


def codes_of(problems: Iterable[Problem]) -> list[str]:
    """Codes of problems that a check returns."""
    return [problem.code for problem in problems]


@contextmanager
def refused(kind: type[Coded], *codes: str) -> Iterator[pytest.ExceptionInfo[Coded]]:
    """Assert that the block raises an error with exactly these codes, in this order.

    Parameters
    ----------
    kind
        Class of the error.
    codes
        One code for each problem; notes beside the problems have none here.
    """
    with pytest.raises(kind) as caught:
        yield caught
    found = tuple(code for code in caught.value.codes if code != "note")
    assert found == codes, str(caught.value)
