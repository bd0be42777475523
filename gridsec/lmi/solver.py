"""What all designs share about the solver's library."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def solver_warnings_as_status() -> Iterator[None]:
    """An inaccurate solution is judged by its margin, not by a warning that nobody reads."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solution may be inaccurate", category=UserWarning)
        yield


def cvxpy_late() -> Any:
    """Import cvxpy late: it takes a second, and only a design needs it. Its annotations are incomplete."""
    import cvxpy

    return cvxpy
