"""Largest manipulations that no test without false alarms detects, with true or with false powers.

Squared voltages differ from the model by ``w = B c``, c in the box [-1, 1]^k, and unmanipulated readings by
at most e. Attacks ``a`` on the meters J stay undetected if some other c', e' of an unmanipulated feeder give
the same readings; halving the differences,

    a_k / 2 = b_k c + e_k (-1 .. 1),    |b_j c| <= e_j  for all meters j outside J.

So the largest consistent attack on meter k is ``2 max (b_k c + e_k)`` over c and over J with k in J and
|J| <= M: a mixed-integer program with tight big-M constants, ``sum |b_j| - e_j``. The resulting error of a
customer's voltage is the same program with ``2 max b_i c``.

With false powers (`PowerErrorModel`), a customer's powers are known within the meter's errors only while that
meter is unmanipulated. The powers of a manipulated meter are anywhere in the customer's range, the true ones
and the reported ones:

    |b_j c| <= e_j  for all meters j outside J,    |c_i| <= n_i  for unknowns i with a meter outside J.

With a binary for every meter this is a mixed-integer program again.

Source: docs/theory-studies.md, sections 3 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible, InputInvalid, Problem

__all__ = [
    "ErrorBox",
    "PowerErrorModel",
    "StealthyAttack",
    "largest_lie",
    "largest_of",
    "largest_story",
    "worst_error",
]


@dataclass(frozen=True, slots=True, eq=False)
class ErrorBox:
    """Errors of unmanipulated customers and meters. N customers, k unknowns, p meters.

    Raises ValueError if numbers of meters differ, an effect is not finite, or an error of a reading not
        positive.
    """

    # (N, k) B: effect of each unknown, at the end of its interval, on the squared voltages, pu
    effect: Floats
    meters: Ints  # (p,) customer of each meter
    reading: Floats  # (p,) e: largest error of an unmanipulated squared reading, pu; positive

    def __post_init__(self) -> None:
        if self.reading.shape != self.meters.shape or self.effect.ndim != 2:
            raise InputInvalid(
                [Problem("shape", f"{self.reading.size} errors of {self.meters.size} readings")]
            )
        if not (
            np.isfinite(self.effect).all() and np.isfinite(self.reading).all() and (self.reading > 0).all()
        ):
            raise InputInvalid(
                [
                    Problem(
                        "not-positive", "effects must be finite, and errors of readings finite and positive"
                    )
                ]
            )


@dataclass(frozen=True, slots=True, eq=False)
class StealthyAttack:
    """Largest attack, or error, consistent with an unmanipulated feeder."""

    size: float  # Squared pu; reached by `liars` with the unknowns at `unknowns`. 0 without possible attacks.
    bound: float  # upper bound of the solver; at least `size`
    liars: Ints  # meters that must be manipulated for it
    unknowns: Floats  # (k,) c


def largest_lie(box: ErrorBox, meter: int, liars: int, *, honest: Bools | None = None) -> StealthyAttack:
    """Largest attack on a meter, in collusion with others, that is consistent with an unmanipulated feeder.

    liars: largest number of manipulated meters, this one among them.
    honest (p,): protected meters: they cannot be manipulated.
    Raises DesignInfeasible if the solver fails.
    """
    honest = np.zeros(box.meters.size, dtype=np.bool_) if honest is None else honest
    if honest[meter] or liars < 1:
        return StealthyAttack(0.0, 0.0, np.zeros(0, dtype=np.intp), np.zeros(box.effect.shape[1]))
    found = _most(box, box.effect[box.meters[meter]], liars, honest, meter)
    own = 2.0 * float(box.reading[meter])
    return StealthyAttack(found.size + own, found.bound + own, found.liars, found.unknowns)


def worst_error(box: ErrorBox, customer: int, liars: int, *, honest: Bools | None = None) -> StealthyAttack:
    """Largest difference of a customer's voltage between two states with the same readings.

    box, liars, honest: as in `largest_lie`; with `liars` = 0, the uncertainty under unmanipulated meters.
    """
    honest = np.zeros(box.meters.size, dtype=np.bool_) if honest is None else honest
    return _most(box, box.effect[customer], liars, honest, None)


# Relative excess over an error, or over an unmanipulated share, that counts as the solver's rounding.
_HONEST = 1e-6


def _most(box: ErrorBox, row: Floats, liars: int, honest: Bools, must: int | None) -> StealthyAttack:
    """Maximise ``2 row c`` with integers, then again with fixed meters, so that the maximum is attained."""
    scaled = box.effect[box.meters] / box.reading[:, None]
    slack = np.maximum(np.abs(scaled).sum(axis=1) - 1.0, 0.0)
    able = ~honest & (slack > 0.0)
    if must is not None:
        able[must] = True
    size = float(np.abs(row).sum())
    # Meters that cannot exceed their own error need no binary; without binaries it is a linear program.
    if not size:
        liar = np.zeros(0, dtype=np.intp) if must is None else np.array([must], dtype=np.intp)
        return StealthyAttack(0.0, 0.0, liar, np.zeros(row.size))
    chosen, bound = able, 0.0
    if int(np.count_nonzero(able)) > liars:
        chosen, bound = _choose(scaled, slack, row / size, liars, able, must=must)
    c = _reach(scaled[~chosen], row / size)
    reached = 2.0 * float(row @ c)
    beyond = chosen & (np.abs(scaled @ c) > 1.0 + _HONEST)
    if must is not None:
        beyond[must] = True
    return StealthyAttack(reached, max(reached, 2.0 * size * bound), np.flatnonzero(beyond), c)


def _choose(
    scaled: Floats, slack: Floats, row: Floats, liars: int, able: Bools, *, must: int | None
) -> tuple[Bools, float]:
    """Choice of manipulated meters by HiGHS, and its bound of the maximum of ``row c``."""
    p, k = scaled.shape
    who = np.flatnonzero(able)
    slacks = np.diag(slack)[:, who]
    least, most = np.concatenate([-np.ones(k), who == must]), np.ones(k + who.size)
    within = [LinearConstraint(np.hstack([sign * scaled, -slacks]), ub=np.ones(p)) for sign in (1.0, -1.0)]
    lying, bound = _solved("largest attack", row, within, (least, most), liars)
    chosen = np.zeros(p, dtype=np.bool_)
    chosen[who] = lying
    return chosen, bound


def _solved(  # the program, part by part
    what: str,
    row: Floats,
    within: list[LinearConstraint],
    bounds: tuple[Floats, Floats],
    liars: int,
    *,
    presolve: bool = True,
) -> tuple[Bools, float]:
    """Maximise ``row c`` over c and binaries with a sum of at most `liars`, by HiGHS: binaries and bound."""
    binary = (np.arange(bounds[0].size) >= row.size).astype(np.intp)
    found = milp(
        np.concatenate([-row, np.zeros(binary.size - row.size)]),
        constraints=[*within, LinearConstraint(binary[None, :], ub=float(liars))],
        bounds=Bounds(*bounds),
        integrality=binary,
        options={"mip_rel_gap": 1e-6, "presolve": presolve},
    )
    if found.x is None:
        raise DesignInfeasible(f"{what} consistent with the feeder", found.message, code="no-solution")
    return found.x[row.size :] > 0.5, float(-found.mip_dual_bound)


def _reach(scaled: Floats, row: Floats) -> Floats:
    """The c that attains the maximum while the rows `scaled` are unmanipulated."""
    if not row.size:
        return row
    found = linprog(
        -row,
        A_ub=np.vstack([scaled, -scaled]) if scaled.size else None,
        b_ub=np.ones(2 * scaled.shape[0]) if scaled.size else None,
        bounds=(-1.0, 1.0),
    )
    if found.x is None:
        raise DesignInfeasible("largest attack consistent with the feeder", found.message, code="no-solution")
    return np.asarray(found.x)


@dataclass(frozen=True, slots=True, eq=False)
class PowerErrorModel:
    """Errors of meters and customers, manipulated or not. k unknowns, p meters."""

    box: ErrorBox  # unknowns at the ends of their ranges under manipulated meters
    owner: Ints  # (k,) meter that determines each unknown; -1 for none
    honest: Floats  # (k,) share of that range while its meter is unmanipulated, 0 to 1

    def told(self, liars: Bools) -> ErrorBox:
        """The box while the meters in the mask (p,) may report any powers."""
        free = (self.owner >= 0) & liars[self.owner]
        return replace(self.box, effect=self.box.effect * np.where(free, 1.0, self.honest))


def largest_story(
    given: PowerErrorModel, meter: int, liars: int, *, honest: Bools | None = None
) -> StealthyAttack:
    """Largest attack on a meter consistent with an unmanipulated feeder, with false powers of such meters.

    meter, liars, honest: as in `gridsec.planning.stealthy_attacks.largest_lie`. Protected meters report true
        powers, too.
    Raises DesignInfeasible if the solver fails.
    """
    p = given.box.meters.size
    honest = np.zeros(p, dtype=np.bool_) if honest is None else honest
    chosen, bound = np.arange(p) == meter, 0.0
    if liars > 1 and not honest[meter]:
        chosen, bound = _choose_reports(given, meter, liars, honest)
    box = given.told(chosen)
    found = largest_lie(box, meter, liars, honest=honest | ~chosen)
    if honest[meter] or liars < 1:
        return found
    # A meter with false powers is manipulated at any voltage. Powers without effect are not false.
    free = (given.owner >= 0) & chosen[given.owner] & box.effect.any(axis=0)
    false = free & (np.abs(found.unknowns) > given.honest + _HONEST)
    who = np.union1d(found.liars, given.owner[false]).astype(np.intp)
    return replace(found, bound=max(found.size, bound), liars=who)


def largest_of(
    given: ErrorBox | PowerErrorModel, meter: int, liars: int, *, honest: Bools | None = None
) -> StealthyAttack:
    """`largest_lie` of a box, and `largest_story` of false powers."""
    if isinstance(given, PowerErrorModel):
        return largest_story(given, meter, liars, honest=honest)
    return largest_lie(given, meter, liars, honest=honest)


def _choose_reports(given: PowerErrorModel, meter: int, liars: int, honest: Bools) -> tuple[Bools, float]:
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
    least = np.concatenate([-most[:k], np.arange(p) == meter])
    within = [LinearConstraint(np.hstack([sign * scaled, -slack]), ub=np.ones(p)) for sign in (1.0, -1.0)] + [
        LinearConstraint(np.hstack([sign * unit, -gain]), ub=given.honest[freed]) for sign in (1.0, -1.0)
    ]
    # Presolve has nothing to remove, and a solution without it needs no postsolve.
    chosen, bound = _solved(
        "largest attack with false powers", row / size, within, (least, most), liars, presolve=False
    )
    return chosen, 2.0 * size * bound + own
