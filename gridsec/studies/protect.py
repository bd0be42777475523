"""The fewest meters to protect, by constraint generation: exact, or greedy with a bound of what is lost.

Every attack that succeeds is a set S of liars; a protection withstands it if and only if it protects one of
S. So the fewest meters are a smallest hitting set, of which rows are made as they are needed: protect what
hits all attacks known so far, ask for an attack on that, until there is none.

References
----------
docs/theory-studies.md, section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from gridsec.arrays import Bools, Floats, Ints, frozen_ints
from gridsec.errors import DesignInfeasible
from gridsec.studies.false_powers import FalsePowers, largest_of
from gridsec.studies.lies import Box
from gridsec.studies.patterns import Patterns, fewest_meters

__all__ = ["Attacker", "Protection", "Unprotectable", "fewest_protected", "hides", "lies_beyond"]


class Unprotectable(DesignInfeasible):
    """An attack succeeds whatever is protected.

    Parameters
    ----------
    liars
        Who it needs: none of them can be protected.
    """

    def __init__(self, liars: Ints) -> None:
        self.liars = liars
        super().__init__(
            "protection of meters",
            f"an attack by meters {liars.tolist()} succeeds, and none of them can be protected",
            code="unprotectable",
        )


Attacker = Callable[[Bools], Ints | None]
"""The liars of an attack that succeeds while these meters, (p,), are protected; None if there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Protection:
    """Meters that suffice, and how many are needed at least.

    Attributes
    ----------
    meters
        Which to protect, ascending.
    least
        No fewer suffice; equal to their number where they are proven the fewest.
    attacks
        Sets of liars that rule out everything cheaper.
    """

    meters: Ints
    least: int
    attacks: tuple[Ints, ...]

    @property
    def gap(self) -> int:
        """How many more than necessary there can be."""
        return int(self.meters.size) - self.least


def hides(given: Patterns, liars: int) -> Attacker:
    """An attacker who imitates a pattern with at most so many liars.

    Parameters
    ----------
    given
        The patterns.
    liars
        2M, if M liars are to be identified: two explanations of M liars each differ by such an attack. M,
        if they are to be noticed only.
    """

    def attack(protected: Bools) -> Ints | None:
        found = fewest_meters(given, honest=protected, below=liars + 1.0)
        return found.sensors if found.count <= liars else None

    return attack


def lies_beyond(box: Box | FalsePowers, liars: int, size: Floats | float) -> Attacker:
    """An attacker whose largest lie is larger than a bound and fits to an honest feeder.

    Parameters
    ----------
    box, liars
        As in `gridsec.studies.lies.largest_lie`, or in `gridsec.studies.false_powers.largest_story`.
    size : float or (p,)
        The bound of each meter's lie, squared pu.
    """
    p = (box.box if isinstance(box, FalsePowers) else box).meters.size
    limit = np.broadcast_to(size, p)
    # Protection only lowers lies: whoever is below the bound without any need not be asked again, and who
    # is furthest above it refutes soonest.
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

    Parameters
    ----------
    attacker
        Knows an attack on every protection that is not enough.
    count
        p.
    never : (p,), optional
        Meters that cannot be protected.
    exact
        Solve each hitting set to optimality; otherwise take, of all meters, the one in most attacks that are
        not met yet, and leave out in the end what is not needed.
    progress
        Told how many attacks are known and how many meters are protected against them.

    Raises
    ------
    Unprotectable
        If an attack needs none but meters that cannot be protected.
    DesignInfeasible
        If a solver fails.
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
    """A smallest set of meters that meets all attacks, by HiGHS."""
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
    """Leave out, one after the other, what is not needed."""
    out = protected.copy()
    for j in np.flatnonzero(protected):
        out[j] = False
        if attacker(out) is not None:
            out[j] = True
    return out


def _least(attacks: list[Ints], never: Bools) -> int:
    """How many meters the known attacks ask for at least, by linear programming."""
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
