"""Patterns of a feeder that hide attacks: unknown powers, unknown busbar voltages, silent meters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from feeders.model.site import Site
from gridsec.arrays import Bools, Floats, Ints, unit_rows
from gridsec.errors import Problem, choice, no_choice, raise_if_any
from gridsec.observers.lure import close_loop
from gridsec.planning.redundancy import Patterns, patterns, unknown_pair, unknown_voltages

__all__ = [
    "Attack",
    "CurvePositions",
    "Knowledge",
    "customer_indices",
    "knowledge",
    "meter_mask",
    "see_names",
]

TOLERANCE: Final = 1e-9
"""Tolerance for zero of products of unit vectors, and of rows relative to the longest.

Feeders' smallest singular values are above 1e-6.
"""


class CurvePositions(StrEnum):
    """Operating region of the inverters on their droop curves."""

    STEEPEST = "steepest"
    DEADBAND = "deadband"


class Attack(StrEnum):
    """Attacks that count: those with a lasting effect, or also those that the inverters forget."""

    PERSISTENT = "persistent"
    ANY = "any"


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """Unknowns of a feeder, and patterns that they hide. N customers, n states, p meters."""

    unknown: tuple[str, ...]  # customers with unknown powers
    silent: Bools  # (p,) meters without readings
    found: dict[Attack, Patterns]  # patterns for each kind of attack
    everywhere: Floats  # (N, n) effect at a meter of each customer, rows of length one or zero

    def blind(self, attack: Attack) -> Bools:
        """Mask (N,) of customers with a voltage moved by some pattern that no live meter sees."""
        lost = self.found[attack].blind(~self.silent)
        if not lost.size:
            return np.zeros(len(self.everywhere), dtype=np.bool_)
        return np.asarray(np.abs(self.everywhere @ lost).max(axis=1) > np.sqrt(TOLERANCE))


def knowledge(
    site: Site,
    *,
    unknown: Sequence[str] | None,
    silent: Sequence[str],
    busbar_known: bool,
    curves: CurvePositions,
) -> Knowledge:
    """Compute the patterns that hide attacks.

    unknown: customers with unknown active and reactive powers; by default those without a meter, except those
        with `p_std_kw` and `q_std_kvar`, such as no-load powers of transformers.
    silent: meters without readings. The powers of their customers are unknown, too.
    busbar_known: True: the busbar voltage is metered and honest; in three phases all of them, or none.
    curves: operating region of the inverters.
    Raises ValueError for an unknown customer, meter or region of the curves.
    """
    curves = choice("curves", CurvePositions, curves)
    gone = meter_mask(site, silent)
    metered = np.zeros(site.feeder.bus.size, dtype=np.bool_)
    metered[site.meters] = True
    told = [row.p_std_kw is not None and row.q_std_kvar is not None for row in site.tables.customers]
    open_ = ~metered & ~np.array(told, dtype=np.bool_)
    if unknown is not None:
        open_ = np.zeros(metered.size, dtype=np.bool_)
        open_[customer_indices(site, unknown)] = True
    open_[site.meters[gone]] = True
    which = np.flatnonzero(open_)
    W = unknown_voltages(site.feeder, which, busbar=not busbar_known, tol=TOLERANCE)
    # A meter at every customer: rounding limits depend on the feeder, not on its meters.
    lure = close_loop(site.feeder, site.droop, np.arange(metered.size))
    slope = lure.slope if curves is CurvePositions.STEEPEST else np.zeros_like(lure.slope)
    A, every = unknown_pair(lure, slope, W)
    everywhere = unit_rows(every, tol=TOLERANCE)
    C = everywhere[site.meters]
    return Knowledge(
        tuple(site.feeder.customers[k] for k in which),
        gone,
        {each: patterns(A, C, persistent=each is Attack.PERSISTENT, tol=TOLERANCE) for each in Attack},
        everywhere,
    )


def customer_indices(site: Site, names: Sequence[str]) -> Ints:
    """Indices of customers by id.

    Raises ValueError for an unknown customer.
    """
    return _indices(site.feeder.customers, names, "customer")


def see_names(
    site: Site,
    *,
    unknown: Sequence[str] | None = None,
    meters: Sequence[str] = (),
    curves: CurvePositions | str = "",
) -> None:
    """Check ids of customers and meters, and the region of the curves if it is given, all at once.

    Raises ValueError for an unknown customer, meter or region of the curves.
    """
    raise_if_any(
        [
            *_strange(site.feeder.customers, unknown or (), "customer"),
            *_strange(site.meter_ids, meters, "meter"),
            *no_choice("curves", CurvePositions, *([curves] if curves else [])),
        ]
    )


def meter_mask(site: Site, names: Sequence[str]) -> Bools:
    """Mask of meters by id, (p,).

    Raises ValueError for an unknown meter.
    """
    out = np.zeros(site.meters.size, dtype=np.bool_)
    out[_indices(site.meter_ids, names, "meter")] = True
    return out


def _indices(known: Sequence[str], names: Sequence[str], what: str) -> Ints:
    raise_if_any(_strange(known, names, what))
    place = {name: k for k, name in enumerate(known)}
    return np.array([place[name] for name in names], dtype=np.intp)


def _strange(known: Sequence[str], names: Sequence[str], what: str) -> list[Problem]:
    there = set(known)
    strange = [name for name in names if name not in there]
    few = ", ".join(list(known)[:5])
    return (
        [Problem("unknown-name", f"there is no {what} {', '.join(map(repr, strange))}; there are {few}, ...")]
        if strange
        else []
    )
