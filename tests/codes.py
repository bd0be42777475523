"""Assertions on the codes of errors; sentences are in tests/gridsec/golden/errors.txt."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import pytest

from gridsec.errors import DesignInfeasible, FeederInvalid, InputInvalid, NotObservable

Coded = TypeVar("Coded", bound=FeederInvalid | InputInvalid | NotObservable | DesignInfeasible)


def codes_of(error: FeederInvalid | InputInvalid | NotObservable | DesignInfeasible) -> tuple[str, ...]:
    """Codes of an error, one for each problem."""
    return (error.code,) if isinstance(error, NotObservable | DesignInfeasible) else error.codes


@contextmanager
def refused(kind: type[Coded], *codes: str) -> Iterator[pytest.ExceptionInfo[Coded]]:
    """Assert that the block raises an error with exactly these codes, in this order.

    Parameters
    ----------
    kind
        Class of the error.
    codes
        One code for each problem.
    """
    with pytest.raises(kind) as caught:
        yield caught
    assert codes_of(caught.value) == codes, str(caught.value)
