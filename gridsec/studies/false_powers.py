"""Largest attacks of meters that report false powers with false voltages.

As in `gridsec.studies.lies`, but a customer's powers are known within the meter's errors only while that
meter is unmanipulated. The powers of a manipulated meter are anywhere in the customer's range, the true ones
and the reported ones:

    |b_j c| <= e_j  for all meters j outside J,    |c_i| <= n_i  for unknowns i with a meter outside J.

With a binary for every meter this is a mixed-integer program again.

References
----------
docs/theory-studies.md, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.studies.lies import Box, Fit, largest_lie

__all__ = ["FalsePowers", "largest_of", "largest_story"]

# Excess over an unmanipulated share that counts as the solver's rounding.
_HONEST = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class FalsePowers:
    """Errors of meters and customers, manipulated or not. k unknowns, p meters.

    Attributes
    ----------
    box
        Unknowns at the ends of their ranges under manipulated meters.
    owner : (k,)
        Meter that determines each unknown; -1 for none.
    honest : (k,)
        Share of that range while its meter is unmanipulated, 0 to 1.
    """

    box: Box
    owner: Ints
    honest: Floats

    def told(self, liars: Bools) -> Box:
        """The box while the meters in the mask (p,) may report any powers."""
        free = (self.owner >= 0) & liars[self.owner]
        return replace(self.box, effect=self.box.effect * np.where(free, 1.0, self.honest))


def largest_story(given: FalsePowers, meter: int, liars: int, *, honest: Bools | None = None) -> Fit:
    """Largest attack on a meter consistent with an unmanipulated feeder, with false powers of such meters.

    Parameters
    ----------
    meter, liars, honest
        As in `gridsec.studies.lies.largest_lie`. Protected meters report true powers, too.

    Raises
    ------
    DesignInfeasible
        If the solver fails.
    """
    p = given.box.meters.size
    honest = np.zeros(p, dtype=np.bool_) if honest is None else honest
    chosen, bound = np.arange(p) == meter, 0.0
    if liars > 1 and not honest[meter]:
        chosen, bound = _choose(given, meter, liars, honest)
    box = given.told(chosen)
    found = largest_lie(box, meter, liars, honest=honest | ~chosen)
    if honest[meter] or liars < 1:
        return found
    # A meter with false powers is manipulated at any voltage. Powers without effect are not false.
    free = (given.owner >= 0) & chosen[given.owner] & box.effect.any(axis=0)
    false = free & (np.abs(found.unknowns) > given.honest + _HONEST)
    who = np.union1d(found.liars, given.owner[false]).astype(np.intp)
    return replace(found, bound=max(found.size, bound), liars=who)


def largest_of(given: Box | FalsePowers, meter: int, liars: int, *, honest: Bools | None = None) -> Fit:
    """`largest_lie` of a box, and `largest_story` of false powers."""
    if isinstance(given, FalsePowers):
        return largest_story(given, meter, liars, honest=honest)
    return largest_lie(given, meter, liars, honest=honest)


def _choose(given: FalsePowers, meter: int, liars: int, honest: Bools) -> tuple[Bools, float]:
    """Choice of manipulated meters by HiGHS, and its bound of the meter's attack."""
    box = given.box
    p, k = box.meters.size, box.effect.shape[1]
    row = box.effect[box.meters[meter]]
    size, own = float(np.abs(row).sum()) or 1.0, 2.0 * float(box.reading[meter])
    scaled = box.effect[box.meters] / box.reading[:, None]
    slack = np.diag(np.maximum(np.abs(scaled).sum(axis=1) - 1.0, 0.0))
    freed = np.flatnonzero((given.owner >= 0) & (given.honest < 1.0))
    unit, gain = np.eye(k)[freed], np.zeros((freed.size, p))
    gain[np.arange(freed.size), given.owner[freed]] = 1.0 - given.honest[freed]
    most = np.concatenate([np.where(given.owner < 0, given.honest, 1.0), ~honest])
    least = (np.arange(p) == meter).astype(np.float64)
    found = milp(
        np.concatenate([-row / size, np.zeros(p)]),
        constraints=[
            LinearConstraint(np.hstack([sign * scaled, -slack]), ub=np.ones(p)) for sign in (1.0, -1.0)
        ]
        + [LinearConstraint(np.hstack([sign * unit, -gain]), ub=given.honest[freed]) for sign in (1.0, -1.0)]
        + [LinearConstraint(np.concatenate([np.zeros(k), np.ones(p)])[None, :], ub=float(liars))],
        bounds=Bounds(np.concatenate([-most[:k], least]), most),
        integrality=np.concatenate([np.zeros(k), np.ones(p)]),
        # Presolve has nothing to remove, and a solution without it needs no postsolve.
        options={"mip_rel_gap": 1e-6, "presolve": False},
    )
    if found.x is None:
        raise DesignInfeasible(
            "largest attack with false powers consistent with the feeder", found.message, code="no-solution"
        )
    return found.x[k:] > 0.5, 2.0 * size * float(-found.mip_dual_bound) + own
