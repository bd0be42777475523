"""What the study of a droop fleet is asked, and what cannot be asked."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Final

from feeders.studies.droop_fleets import Who, range_problem
from gridsec.droop import PRESETS
from gridsec.errors import InputInvalid, Problem, refuse
from gridsec.studies.droop_stability import Update

__all__ = ["DroopOptions", "band_problem"]

HOSTING: Final = {
    "hosting_presets": "--hosting-preset",
    "hosting_load": "--hosting-load",
    "hosting_customers": "--at",
    "unit_kw": "--unit-kw",
    "draws": "--draws",
}
"""What only the search for hosting capacities asks, and the options of the command line for it."""


@dataclass(frozen=True, slots=True)
class DroopOptions:
    """What is studied.

    Attributes
    ----------
    preset
        Preset of all inverters; None: the feeder's own fleet.
    who
        Whom a preset equips: customers with generation (`pv`), or `all`.
    interval_s, dead
        Sampling interval of the inverters, s (0: continuous), and dead time in whole intervals.
    v0_low, v0_high
        Limits of the busbar's voltage, pu; points of operation have the middle, hosting the upper one.
    v_min, v_max
        The band, parts of the nominal voltage; None: the limits of the feeder's files.
    load_high, pv_high
        Largest shares of the peaks in the box of all loads.
    presets
        Presets to compare, each instead of the feeder's own.
    tau_factors
        Factors on all time constants to compare.
    hosting
        Whether to look for hosting capacities.
    hosting_presets
        Fleets that new generation comes with; empty: without reactive power.
    hosting_load
        Share of their peak that loads draw meanwhile.
    hosting_customers
        Who gets the generation; None: who has some, in proportion.
    unit_kw
        Size of a unit that comes to a random customer, kW.
    draws
        How many random orders of customers.

    Raises
    ------
    ValueError
        With everything that is out of range, or would be ignored.
    """

    preset: str | None = None
    who: Who = Who.PV
    interval_s: float = 1.0
    dead: int = 0
    v0_low: float = 1.0
    v0_high: float = 1.0
    v_min: float | None = None
    v_max: float | None = None
    load_high: float = 1.0
    pv_high: float = 1.0
    presets: tuple[str, ...] = PRESETS
    tau_factors: tuple[float, ...] = (0.01, 0.1, 0.3, 1.0, 3.0)
    hosting: bool = False
    hosting_presets: tuple[str, ...] = ("", "ieee1547-b")
    hosting_load: float = 0.1
    hosting_customers: tuple[str, ...] | None = None
    unit_kw: float = 5.0
    draws: int = 30

    def __post_init__(self) -> None:
        problems = [*self._fleet_problems(), *self._limit_problems(), *self._hosting_problems()]
        refuse(problems)

    def _fleet_problems(self) -> Iterator[str]:
        presets = [name for name in (self.preset, *self.presets) if name is not None]
        for name in dict.fromkeys([*presets, *filter(None, self.hosting_presets)]):
            if name not in PRESETS:
                yield Problem(
                    "unknown-name", f"there is no preset {name!r}; expected one of {', '.join(PRESETS)}"
                )
        if self.who not in tuple(Who):
            yield Problem("unknown-name", f"who: {self.who!r}; expected one of {', '.join(Who)}")
        try:
            Update(self.interval_s, self.dead)
        except InputInvalid as error:
            yield from error.problems
        for times in self.tau_factors:
            if not 0.0 < times < math.inf:
                yield Problem(
                    "not-positive", f"a factor on time constants is {times:g}; it must be a positive number"
                )

    def _limit_problems(self) -> Iterator[Problem]:
        yield from range_problem("busbar voltage", self.v0_low, self.v0_high)
        if self.v0_low == 0.0:
            yield Problem("not-positive", "a busbar at 0 pu feeds nothing")
        if self.v_min is not None and self.v_max is not None:
            yield from band_problem(self.v_min, self.v_max)
        shares = {"load": self.load_high, "generation": self.pv_high, "load while hosting": self.hosting_load}
        for what, share in shares.items():
            if not 0.0 <= share < math.inf:
                yield Problem(
                    "negative", f"share of the {what} is {share:g}; it must be a number that is not negative"
                )

    def _hosting_problems(self) -> Iterator[Problem]:
        if not 0.0 < self.unit_kw < math.inf:
            yield Problem(
                "not-positive", f"a unit of generation is {self.unit_kw:g} kW; it must be a positive number"
            )
        if self.draws < 0:
            yield Problem("negative", f"{self.draws} random orders; the number must not be negative")
        if self.hosting_customers == ():
            yield Problem("missing", "new generation has no customer")
        if not self.hosting:
            usual = {each.name: each.default for each in fields(self)}
            given = [
                f"{name} ({option})" for name, option in HOSTING.items() if getattr(self, name) != usual[name]
            ]
            if given:
                yield Problem("inconsistent", f"{', '.join(given)}: only with hosting (--hosting)")


def band_problem(low: float, high: float) -> list[Problem]:
    """What is wrong with a band of voltages; empty if nothing is.

    Parameters
    ----------
    low, high
        Its limits, parts of the nominal voltage.
    """
    if 0.0 < low < high < math.inf:
        return []
    text = f"the band from {low:g} to {high:g} is none; expected two ascending voltages, pu"
    return [Problem("order", text)]
