"""Common use of the solver's library."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def solver_warnings_as_status() -> Iterator[None]:
    """Suppress the warning about inaccurate solutions; the margin of a design decides."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solution may be inaccurate", category=UserWarning)
        yield


def cvxpy_late() -> Any:
    """Import cvxpy late: it takes a second, and only a design needs it. Its annotations are incomplete."""
    import cvxpy

    return cvxpy
