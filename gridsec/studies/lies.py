"""The largest lies that fit to honest meters: what no test without false alarms can notice.

Squared voltages are off the model by ``w = B c``, c in the box [-1, 1]^k, and honest readings by at most e.
Lies ``a`` of the meters J stay unnoticed if some other c', e' of an honest feeder give the same readings;
halving the differences,

    a_k / 2 = b_k c + e_k (-1 .. 1),    |b_j c| <= e_j  for all meters j outside J.

So the largest lie of meter k that fits is ``2 max (b_k c + e_k)`` over c and over J with k in J, |J| <= M: a
mixed-integer program whose big-M constants, ``sum |b_j| - e_j``, are tight. What it lets a customer's voltage
be off by is the same program with ``2 max b_i c``.

References
----------
docs/theory-studies.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible, InputInvalid, Problem

__all__ = ["Box", "Fit", "largest_lie", "worst_error"]


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """What honest customers and meters can be off by. N customers, k unknowns, p meters.

    Attributes
    ----------
    effect : (N, k)
        B: what each unknown, at the end of its interval, does to the squared voltages, pu.
    meters : (p,)
        Customer of each meter.
    reading : (p,)
        e: largest error of an honest squared reading, pu; positive.

    Raises
    ------
    ValueError
        If numbers of meters differ, an effect is not finite, or an error of a reading not positive.
    """

    effect: Floats
    meters: Ints
    reading: Floats

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
class Fit:
    """The largest lie, or error, that fits to an honest feeder.

    Attributes
    ----------
    size
        Squared pu; reached by `liars` with the unknowns at `unknowns`. 0 where nobody may lie.
    bound
        Nothing larger fits, by the solver's bound; at least `size`.
    liars
        Who must lie for it.
    unknowns : (k,)
        c.
    """

    size: float
    bound: float
    liars: Ints
    unknowns: Floats


def largest_lie(box: Box, meter: int, liars: int, *, honest: Bools | None = None) -> Fit:
    """The largest lie of a meter in collusion with others that fits to an honest feeder.

    Parameters
    ----------
    box
        What honest ones can be off by.
    meter
        The meter.
    liars
        How many lie at most, this one among them.
    honest : (p,), optional
        Protected meters: they cannot lie.

    Raises
    ------
    DesignInfeasible
        If the solver fails.
    """
    honest = np.zeros(box.meters.size, dtype=np.bool_) if honest is None else honest
    if honest[meter] or liars < 1:
        return Fit(0.0, 0.0, np.zeros(0, dtype=np.intp), np.zeros(box.effect.shape[1]))
    found = _most(box, box.effect[box.meters[meter]], liars, honest, meter)
    own = 2.0 * float(box.reading[meter])
    return Fit(found.size + own, found.bound + own, found.liars, found.unknowns)


def worst_error(box: Box, customer: int, liars: int, *, honest: Bools | None = None) -> Fit:
    """How far a customer's voltage can be from another that fits to the same readings.

    Parameters
    ----------
    box, liars, honest
        As in `largest_lie`; with no liars, what honest meters leave open.
    customer
        The customer.
    """
    honest = np.zeros(box.meters.size, dtype=np.bool_) if honest is None else honest
    return _most(box, box.effect[customer], liars, honest, None)


# What is this little beyond its own error needs no lie: the solver's rounding.
_HONEST = 1e-6


def _most(box: Box, row: Floats, liars: int, honest: Bools, must: int | None) -> Fit:
    """Maximise ``2 row c``; solved with integers, and again with the liars fixed, so that it is reached."""
    scaled = box.effect[box.meters] / box.reading[:, None]
    slack = np.maximum(np.abs(scaled).sum(axis=1) - 1.0, 0.0)
    able = ~honest & (slack > 0.0)
    if must is not None:
        able[must] = True
    size = float(np.abs(row).sum())
    # Whoever can never be beyond its own error needs no binary, and without any it is a linear program.
    if not size:
        liar = np.zeros(0, dtype=np.intp) if must is None else np.array([must], dtype=np.intp)
        return Fit(0.0, 0.0, liar, np.zeros(row.size))
    chosen, bound = able, 0.0
    if int(np.count_nonzero(able)) > liars:
        chosen, bound = _choose(scaled, slack, row / size, liars, able, must=must)
    c = _reach(scaled[~chosen], row / size)
    reached = 2.0 * float(row @ c)
    beyond = chosen & (np.abs(scaled @ c) > 1.0 + _HONEST)
    if must is not None:
        beyond[must] = True
    return Fit(reached, max(reached, 2.0 * size * bound), np.flatnonzero(beyond), c)


def _choose(
    scaled: Floats, slack: Floats, row: Floats, liars: int, able: Bools, *, must: int | None
) -> tuple[Bools, float]:
    """Who lies, by HiGHS, and its bound of the maximum of ``row c``."""
    p, k = scaled.shape
    who = np.flatnonzero(able)
    open_ = np.zeros((p, who.size))
    open_[who, np.arange(who.size)] = slack[who]
    least = (who == must).astype(np.float64)
    found = milp(
        np.concatenate([-row, np.zeros(who.size)]),
        constraints=[
            LinearConstraint(np.hstack([scaled, -open_]), ub=np.ones(p)),
            LinearConstraint(np.hstack([-scaled, -open_]), ub=np.ones(p)),
            LinearConstraint(np.concatenate([np.zeros(k), np.ones(who.size)])[None, :], ub=float(liars)),
        ],
        bounds=Bounds(np.concatenate([-np.ones(k), least]), np.concatenate([np.ones(k), np.ones(who.size)])),
        integrality=np.concatenate([np.zeros(k), np.ones(who.size)]),
        options={"mip_rel_gap": 1e-6},
    )
    if found.x is None:
        raise DesignInfeasible("largest lie that fits to an honest feeder", found.message, code="no-solution")
    chosen = np.zeros(p, dtype=np.bool_)
    chosen[who] = found.x[k:] > 0.5
    return chosen, float(-found.mip_dual_bound)


def _reach(scaled: Floats, row: Floats) -> Floats:
    """The c that reaches the maximum while these meters are honest."""
    if not row.size:
        return row
    found = linprog(
        -row,
        A_ub=np.vstack([scaled, -scaled]) if scaled.size else None,
        b_ub=np.ones(2 * scaled.shape[0]) if scaled.size else None,
        bounds=(-1.0, 1.0),
    )
    if found.x is None:
        raise DesignInfeasible("largest lie that fits to an honest feeder", found.message, code="no-solution")
    return np.asarray(found.x)
