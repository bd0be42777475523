"""A feeder's droop fleet, or one of a preset; its operating points, and the box of its loads."""

from __future__ import annotations

import math
from dataclasses import replace
from enum import StrEnum
from typing import Final

import numpy as np

from feeders.model.site import Site
from feeders.studies.operating import Bases
from gridsec.arrays import Floats, Ints
from gridsec.errors import FeederInvalid, Problem, raise_if_any
from gridsec.grid.devices import Droop, fleet
from gridsec.planning.droop.ac_sensitivity import InjectionBox

__all__ = [
    "KVA_PER_KW",
    "NOTHING",
    "Equipped",
    "NoInverters",
    "box",
    "chosen_fleet",
    "equip",
    "inverter_names",
    "made",
    "point",
    "points",
]

KVA_PER_KW: Final = 1.1  # rating of an inverter per kW of generation: at full sun 0.46 of it remains for q

SMALLEST_KVA: Final = 5.0  # rating of inverters of customers without generation, kVA
NOTHING: Final = "no inverters: stability does not apply"  # statement for a feeder without inverters


class NoInverters(FeederInvalid):
    """A feeder without droop inverters: no fleet to study."""


class Equipped(StrEnum):
    """Customers with an inverter of a preset."""

    PV = "pv"
    ALL = "all"


_POINTS: Final = {"evening": (1.0, 0.0), "noon": (0.2, 1.0), "half": (0.5, 0.5)}  # load, generation


def equip(site: Site, preset: str, who: Equipped = Equipped.PV) -> Droop:
    """Equip customers of a feeder with inverters of one preset, in place of its own fleet.

    A customer's own inverter keeps its rating; others get 1.1 kVA for each kW of generation, or 5 kVA.

    Raises FeederInvalid for an unknown preset, or without a customer to equip.
    """
    rows = site.tables.customers
    own = [k for k, row in enumerate(rows) if who is Equipped.ALL or row.pv_kw > 0 or row.inverter_kva > 0]
    if not own:
        text = f"{site.feeder.name}: no customer has generation; equip all (--who all)"
        raise FeederInvalid([Problem("nothing-to-design", text)])
    rated = [rows[k].inverter_kva or KVA_PER_KW * rows[k].pv_kw or SMALLEST_KVA for k in own]
    return made(site, np.array(own, dtype=np.intp), preset, np.array(rated))


def made(site: Site, own: Ints, preset: str, kva: Floats) -> Droop:
    """Inverters of a preset at customers `own`, (m,), with curves in the nominal voltage; `kva` is (m,)."""
    usual = fleet(own, preset, kva, site.feeder.base_kva)
    ratio = Bases.of(site).ratio[own]
    return usual if (ratio == 1.0).all() else replace(usual, v=usual.v / ratio[:, None])


def chosen_fleet(site: Site, preset: str | None, who: Equipped = Equipped.PV) -> Droop:
    """The feeder's own fleet, or one of a preset as in `equip`.

    Raises NoInverters without inverters and without a preset; FeederInvalid if a preset has no customer to
        equip.
    """
    if preset is not None:
        return equip(site, preset, who)
    if not site.droop.tau.size:
        text = (
            f"{site.feeder.name} has no droop inverters: fill the columns inverter_kva and droop of its "
            "customers.csv, or give a preset (--preset ieee1547-b) to equip customers with generation, or "
            "all (--who all)"
        )
        raise NoInverters([Problem("nothing-to-design", text)])
    return site.droop


def points(site: Site, v0: float = 1.0) -> dict[str, InjectionBox]:
    """Operating points of the study, each a box without width, at a busbar voltage `v0`, pu.

    Evening: full load, no generation. Noon: a fifth of the load, full generation. Half: half of both.
    """
    return {name: point(site, load, pv, v0) for name, (load, pv) in _POINTS.items()}


def point(site: Site, load: Floats | float, pv: Floats | float, v0: float = 1.0) -> InjectionBox:
    """Operating point without the inverters' reactive power, the loads at their expected power factor.

    `load` and `pv` are shares of the peaks, (N,) or scalar; `v0` is the busbar voltage, pu.
    """
    meta, rows = site.tables.meta, site.tables.customers
    usual = [meta.load.power_factor if row.power_factor is None else row.power_factor for row in rows]
    drawn = load * site.loads.load_peak
    p, q = pv * site.loads.pv_peak - drawn, -drawn * np.tan(np.arccos(np.array(usual)))
    return InjectionBox(p, p, q, q, v0, v0)


def box(
    site: Site,
    *,
    load_low: float = 0.0,
    load_high: float = 1.0,
    pv_low: float = 0.0,
    pv_high: float = 1.0,
    v0_low: float = 1.0,
    v0_high: float = 1.0,
) -> InjectionBox:
    """Box of all powers within the feeder's files, independent for each customer.

    Loads from `load_low load_kw` to `load_high load_kw`, with q from `load tan_min - floor` to `load tan_max
    + floor`; generation from `pv_low pv_kw` to `pv_high pv_kw` at unity power factor; busbar voltage in pu.

    Raises ValueError for limits in the wrong order.
    """
    problems = [
        *range_problem("load", load_low, load_high),
        *range_problem("generation", pv_low, pv_high),
        *range_problem("busbar voltage", v0_low, v0_high),
    ]
    raise_if_any(problems)
    known = site.loads
    return InjectionBox(
        p_low=pv_low * known.pv_peak - load_high * known.load_peak,
        p_high=pv_high * known.pv_peak - load_low * known.load_peak,
        q_low=-(load_high * known.load_peak * known.tan_max + known.q_floor),
        q_high=-(load_low * known.load_peak * known.tan_min - known.q_floor),
        v0_low=v0_low,
        v0_high=v0_high,
    )


def range_problem(what: str, low: float, high: float) -> list[Problem]:
    """Problem of two limits of a quantity; empty without one."""
    if 0.0 <= low <= high < math.inf:
        return []
    return [Problem("order", f"{what}: from {low:g} to {high:g}; expected two ascending numbers from 0 on")]


def inverter_names(site: Site, droop: Droop, rows: Ints) -> list[str]:
    """Customers of inverters, by rows of the fleet."""
    return [site.feeder.customers[int(k)] for k in droop.customer[rows]]
