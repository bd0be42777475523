"""Solver settings, and basis pursuit as a second-order cone program.

Source: lee2018 (2.1.4), with the Euclidean norm of every block in place of the absolute value of every entry.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import numpy as np

from gridsec.arrays import Floats, Ints
from gridsec.errors import DesignInfeasible

BACKOFF = (0.0, 1e-4, 1e-3, 1e-2, 5e-2)
"""Relaxations tried, in order, if a rebuilt inequality is violated."""

Design = TypeVar("Design")


def cvxpy_late() -> Any:
    """Import cvxpy late: it takes a second, and only a design needs it. Its annotations are incomplete."""
    import cvxpy

    return cvxpy


def solve(problem: Any, what: str, *, condition: str = "inequality") -> None:
    """Solve a problem by Clarabel; the margin of the rebuilt condition decides, not the solver's status.

    Raises DesignInfeasible if the solver fails or finds no solution.
    """
    cp = cvxpy_late()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate", category=UserWarning)
            problem.solve(solver=cp.CLARABEL)
    except cp.error.SolverError as failure:
        raise DesignInfeasible(what, f"the solver failed: {failure}", code="solver-failed") from failure
    if problem.status not in {cp.OPTIMAL, cp.OPTIMAL_INACCURATE}:
        raise DesignInfeasible(
            what, f"the {condition} has no solution ({problem.status})", code="no-solution"
        )


def first_proven(
    tries: Iterable[Design], margin: Callable[[Design], float], what: str, status: str
) -> tuple[Design, float]:
    """First design with a positive margin of the rebuilt inequality, and this margin.

    Raises DesignInfeasible if there is none.
    """
    best = -np.inf
    for tried in tries:
        reached = margin(tried)
        if reached > 0.0:
            return tried, reached
        best = max(best, reached)
    raise DesignInfeasible(
        what, f"solver: {status}, but the rebuilt inequality is violated", best, code="not-verified"
    )


def group_pursuit(F: Floats, y: Floats, heights: Ints) -> Floats:
    """Minimise `sum_i |e_i|_2` over e (N,) subject to `F e = y`.

    F (m, N), y (m,).
    heights (p,): entries of each block of e; they sum to N.
    Raises DesignInfeasible if the solver finds no solution, or its solution does not satisfy `F e = y` to
        1e-6 of y.
    """
    cp = cvxpy_late()
    size = float(np.max(np.abs(y), initial=0.0))
    if size == 0.0:
        return np.zeros(F.shape[1])
    e = cp.Variable(F.shape[1])
    parts = [part for part in np.split(np.arange(F.shape[1]), np.cumsum(heights)[:-1]) if part.size]
    problem = cp.Problem(cp.Minimize(sum(cp.norm(e[part], 2) for part in parts)), [F @ e == y / size])
    solve(problem, "stacked basis pursuit", condition="equation")
    found = size * np.asarray(e.value, dtype=np.float64)
    gap = float(np.max(np.abs(F @ found - y))) / size
    if not gap <= 1e-6:
        raise DesignInfeasible(
            "stacked basis pursuit",
            f"{problem.status}, but the equation is violated",
            -gap,
            code="not-verified",
        )
    return found
