"""The patterns of a feeder in which lies can hide: what nobody knows of its loads, its silent meters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, unit_rows
from gridsec.errors import Problem, choice, no_choice, refuse
from gridsec.observers.lure import close_loop
from gridsec.planning.redundancy import Patterns, patterns, unknown_pair, unknown_voltages

if TYPE_CHECKING:
    from feeders.model.site import Site

__all__ = [
    "TOLERANCE",
    "Attack",
    "Curves",
    "Knowledge",
    "customer_indices",
    "knowledge",
    "meter_mask",
    "see_names",
]

TOLERANCE: Final = 1e-9
"""Products of unit vectors up to this count as zero, and rows up to this part of the longest.

Feeders' smallest singular values are above 1e-6.
"""


class Curves(StrEnum):
    """Where on their droop curves inverters work."""

    STEEPEST = "steepest"
    DEADBAND = "deadband"


class Attack(StrEnum):
    """Which attacks count: those whose effect stays, or those too that the inverters forget by themselves."""

    PERSISTENT = "persistent"
    ANY = "any"


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """Who knows what of a feeder. p meters.

    Attributes
    ----------
    unknown
        Customers whose powers nobody knows.
    silent : (p,)
        Meters that are not there.
    found
        The patterns for each kind of attack.
    everywhere : (N, n)
        What a meter at each customer would see, rows of length one; zero where nothing moves the voltage.
    """

    unknown: tuple[str, ...]
    silent: Bools
    found: dict[Attack, Patterns]
    everywhere: Floats

    def blind(self, attack: Attack) -> Bools:
        """Customers whose voltage some pattern moves that none of the live meters sees, (N,)."""
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
    curves: Curves,
) -> Knowledge:
    """Work out the patterns in which lies can hide.

    Parameters
    ----------
    site
        The feeder.
    unknown
        Customers whose active and reactive powers nobody knows; by default those without a meter, unless the
        file says how well they are known (`p_std_kw` and `q_std_kvar`), as of a transformer without load.
    silent
        Meters that are missing. Nobody knows the powers of their customers either.
    busbar_known
        Whether the busbar's voltage is metered and honest; in three phases all of them, or none.
    curves
        Where the inverters work.

    Raises
    ------
    ValueError
        If there is no such customer, meter or part of the curves.
    """
    curves = choice("curves", Curves, curves)
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
    # A meter for everybody: what is rounding is so by what the feeder does, not by what its meters see of it.
    lure = close_loop(site.feeder, site.droop, np.arange(metered.size))
    slope = lure.slope if curves is Curves.STEEPEST else np.zeros_like(lure.slope)
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
    """Indices of customers by name.

    Parameters
    ----------
    site, names
        The feeder, and ids of its customers.

    Raises
    ------
    ValueError
        If there is no such customer.
    """
    return _indices(site.feeder.customers, names, "customer")


def see_names(
    site: Site,
    *,
    unknown: Sequence[str] | None = None,
    meters: Sequence[str] = (),
    curves: Curves | str = "",
) -> None:
    """Refuse, all at once, names of what a feeder does not have.

    Parameters
    ----------
    site
        The feeder.
    unknown, meters
        Names of customers and of meters.
    curves
        Where the inverters work; empty: not asked.

    Raises
    ------
    ValueError
        If there is no such customer, meter or part of the curves.
    """
    refuse(
        [
            *_strange(site.feeder.customers, unknown or (), "customer"),
            *_strange(site.meter_ids, meters, "meter"),
            *no_choice("curves", Curves, *([curves] if curves else [])),
        ]
    )


def meter_mask(site: Site, names: Sequence[str]) -> Bools:
    """Which meters are named, (p,).

    Parameters
    ----------
    site, names
        The feeder, and ids of its meters.

    Raises
    ------
    ValueError
        If there is no such meter.
    """
    out = np.zeros(site.meters.size, dtype=np.bool_)
    out[_indices(site.meter_ids, names, "meter")] = True
    return out


def _indices(known: Sequence[str], names: Sequence[str], what: str) -> Ints:
    refuse(_strange(known, names, what))
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
