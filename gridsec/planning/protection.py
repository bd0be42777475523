"""Smallest set of meters to protect, by constraint generation: exact, or greedy with a bound of the loss.

Every successful attack is a set S of manipulated meters; a protection withstands it if and only if it
protects a meter of S. So the solution is a smallest hitting set with rows generated on demand: protect a set
that hits all attacks known so far, search for an attack against it, and repeat until there is none.

Source: docs/theory-studies.md, section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from gridsec.arrays import Bools, Floats, Ints, frozen_ints
from gridsec.errors import DesignInfeasible
from gridsec.planning.redundancy import Patterns, fewest_meters
from gridsec.planning.stealthy_attacks import ErrorBox, PowerErrorModel, largest_of

__all__ = ["Attacker", "Protection", "Unprotectable", "fewest_protected", "hides", "lies_beyond"]


class Unprotectable(DesignInfeasible):
    """An attack succeeds against every possible protection.

    liars: meters of the attack, none of which can be protected.
    """

    def __init__(self, liars: Ints) -> None:
        self.liars = liars
        super().__init__(
            "protection of meters",
            f"an attack by meters {liars.tolist()} succeeds, and none of them can be protected",
            code="unprotectable",
        )


Attacker = Callable[[Bools], Ints | None]
"""Meters of a successful attack while the meters in the mask (p,) are protected; None if there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Protection:
    """Sufficient set of meters, and the smallest necessary number."""

    meters: Ints  # meters to protect, ascending
    least: int  # lower bound of their number; equal to it if they are proven minimal
    attacks: tuple[Ints, ...]  # sets of manipulated meters that rule out every smaller protection

    @property
    def gap(self) -> int:
        """Upper bound of the number of unnecessary meters."""
        return int(self.meters.size) - self.least


def hides(given: Patterns, liars: int) -> Attacker:
    """Attacker that imitates a pattern with at most `liars` meters.

    liars: 2M to identify M manipulated meters: two explanations of M meters each differ by such an attack. M
        to detect them only.
    """

    def attack(protected: Bools) -> Ints | None:
        found = fewest_meters(given, honest=protected, below=liars + 1.0)
        return found.sensors if found.count <= liars else None

    return attack


def lies_beyond(box: ErrorBox | PowerErrorModel, liars: int, size: Floats | float) -> Attacker:
    """Attacker with an attack above a bound that is consistent with an unmanipulated feeder.

    box, liars: as in `gridsec.planning.stealthy_attacks.largest_lie`, or in
        `gridsec.planning.stealthy_attacks.largest_story`.
    size float or (p,): bound of the attack on each meter, squared pu.
    """
    p = (box.box if isinstance(box, PowerErrorModel) else box).meters.size
    limit = np.broadcast_to(size, p)
    # Protection only reduces attacks: meters below the bound without any are skipped, and the one furthest
    # above it refutes first.
    alone = np.array([largest_of(box, j, liars).bound for j in range(p)]) - limit
    order = [int(j) for j in np.argsort(-alone) if alone[j] > 0.0]

    def attack(protected: Bools) -> Ints | None:
        for j in order:
            found = largest_of(box, j, liars, honest=protected)
            if found.bound > limit[j]:
                return found.liars
        return None

    return attack


def fewest_protected(
    attacker: Attacker,
    count: int,
    *,
    never: Bools | None = None,
    exact: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Protection:
    """Protect the fewest meters such that no attack succeeds.

    attacker: returns an attack on every insufficient protection.
    exact: solve each hitting set to optimality; otherwise repeatedly take the meter in most of the remaining
        attacks, and remove unnecessary meters at the end.
    progress: called with the number of known attacks and the number of meters protected against them.
    Raises Unprotectable if no meter of an attack can be protected; DesignInfeasible if a solver fails.
    """
    never = np.zeros(count, dtype=np.bool_) if never is None else never
    protected = np.zeros(count, dtype=np.bool_)
    attacks: list[Ints] = []
    while (liars := attacker(protected)) is not None:
        if never[liars].all():
            raise Unprotectable(liars)
        attacks.append(frozen_ints(liars))
        protected = _hit(attacks, never) if exact else _hit_greedily(attacks, never)
        if progress is not None:
            progress(len(attacks), int(np.count_nonzero(protected)))
    if not exact:
        protected = _pruned(protected, attacker)
    meters = np.flatnonzero(protected)
    return Protection(meters, meters.size if exact else _least(attacks, never), tuple(attacks))


def _matrix(attacks: list[Ints], count: int) -> Floats:
    out: Floats = np.zeros((len(attacks), count))
    for row, liars in zip(out, attacks, strict=True):
        row[liars] = 1.0
    return out


def _hit(attacks: list[Ints], never: Bools) -> Bools:
    """Smallest set of meters that hits all attacks, by HiGHS."""
    p = never.size
    found = milp(
        np.ones(p),
        constraints=LinearConstraint(_matrix(attacks, p), lb=1.0),
        bounds=Bounds(0.0, (~never).astype(np.float64)),
        integrality=np.ones(p, dtype=np.intp),
        options={"mip_rel_gap": 0.0},
    )
    if found.x is None or found.status != 0:
        raise DesignInfeasible("protection of meters", found.message, code="no-solution")
    return np.asarray(found.x > 0.5)


def _hit_greedily(attacks: list[Ints], never: Bools) -> Bools:
    matrix = _matrix(attacks, never.size)
    out = np.zeros(never.size, dtype=np.bool_)
    while matrix.size:
        counts = np.where(never, -1.0, matrix.sum(axis=0))
        j = int(np.argmax(counts))
        out[j] = True
        matrix = matrix[matrix[:, j] == 0.0]
    return out


def _pruned(protected: Bools, attacker: Attacker) -> Bools:
    """Remove unnecessary meters, one after the other."""
    out = protected.copy()
    for j in np.flatnonzero(protected):
        out[j] = False
        if attacker(out) is not None:
            out[j] = True
    return out


def _least(attacks: list[Ints], never: Bools) -> int:
    """Lower bound of the number of meters that hit the known attacks, by linear programming."""
    if not attacks:
        return 0
    matrix = _matrix(attacks, never.size)
    found = linprog(
        np.ones(never.size),
        A_ub=-matrix,
        b_ub=-np.ones(len(attacks)),
        bounds=[(0.0, 0.0 if fixed else 1.0) for fixed in never],
    )
    if found.fun is None:
        raise DesignInfeasible("protection of meters", found.message, code="no-solution")
    return int(np.ceil(found.fun - 1e-6))
